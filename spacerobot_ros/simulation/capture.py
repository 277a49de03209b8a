"""A free-floating target and its capture: an inelastic impact, after which the target moves with
the robot as one body.

Until the capture, the robot and the target move independently, each with its own momenta. The
capture (:mod:`spacerobot_ros.model.grasp`) occurs between two ticks. The plant then integrates the
robot and the target as one system. The total momenta are exactly the sums of the momenta of the
robot and the target, without rounding errors from the impact. A release separates the robot and the
target without changing poses or velocities.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from spacerobot_ros.errors import CommandError, ParameterError, RobotDescriptionError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.grasp import (
    BodyMotion,
    GraspImpact,
    Payload,
    RelativeMotion,
    RobotMotion,
    TargetBody,
    combined_momenta,
    frame_motion,
    grasp_impact,
    separated_momenta,
)
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    unit_quaternion,
)
from spacerobot_ros.model.urdf import parse_robot, with_held_joints
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.config import PlantConfig, TargetConfig
from spacerobot_ros.simulation.loads import PlantLoads
from spacerobot_ros.simulation.plant import Flags, InitialState, Plant, WrappedPlant
from spacerobot_ros.simulation.velocity_plant import VelocityPlant


def load_target(config: TargetConfig) -> RobotDescription | None:
    """Return the configured target; None if there is no target.

    Raises
    ------
    ParameterError
        The file does not exist, or the target or its joint positions are invalid.
    """
    if not config.given:
        return None
    try:
        if config.robot_description:
            target = parse_robot(config.robot_description)
        else:
            target = load_robot(robot_file(config.robot))
        at = np.array(config.joint_positions) if config.joint_positions else None
        target = with_held_joints(target, at)
    except (ParameterError, RobotDescriptionError) as error:
        raise ParameterError(f"The target is refused: {error}") from error
    try:
        TargetBody.of(target, config.grapple_frame)
    except RobotDescriptionError as error:
        raise ParameterError(str(error)) from None
    return target


def target_parameters(text: str) -> dict[str, Any]:
    """Return the plant's target parameters from the URDF string of a loaded target, whose joints
    are already locked.
    """
    return {"target.robot_description": text, "target.joint_positions": []}


class Target:
    """A free rigid body: it moves with constant momenta, or under orbit or table loads.

    Attributes
    ----------
    description
        The body.
    inertia
        Mass properties in the root link frame T.
    grapple
        Grapple frame pose in T.
    initial
        Its initial motion.
    """

    def __init__(
        self,
        description: RobotDescription,
        config: TargetConfig,
        period: float,
        step: float,
        robot: SpaceRobot | None = None,
    ) -> None:
        self.description = description
        self.inertia = description.bodies[0].inertia
        self.grapple = description.frames[config.grapple_frame][1]
        try:
            self._model = robot.derived(description) if robot else SpaceRobot(description)
            quaternion = unit_quaternion(config.orientation or (0.0, 0.0, 0.0, 1.0))
        except RobotDescriptionError as error:
            raise ParameterError(f"The target is refused: {error}") from error
        except ValueError as error:
            raise ParameterError(f"Parameter 'target.orientation' is refused: {error}.") from None
        self.initial = BodyMotion(
            matrix_from_quaternion(quaternion),
            *(
                np.array(values or (0.0, 0.0, 0.0))
                for values in (config.position, config.velocity, config.angular_velocity)
            ),
        )
        self._plant = VelocityPlant(self._model, period, self._start(self.initial), step)
        self.pose, self.twist = self._plant.pose, self._plant.twist
        self.loads: PlantLoads | None = None
        """External loads on the target; None: none."""
        self._clock: PlantLoads | None = None

    @property
    def motion(self) -> BodyMotion:
        """Its current motion."""
        return BodyMotion.of(self.pose, self.twist)

    @property
    def momenta(self) -> Array:
        """Linear and angular momentum (6,) about its centre of mass, in W."""
        return self._plant.expected_momenta

    def reset(self) -> None:
        """Return to the initial state."""
        self.release(self.initial)

    def release(self, motion: BodyMotion) -> None:
        """Continue in free flight from a given motion."""
        self._plant.initial = self._start(motion)
        self._plant.reset()

    def load(self, loads: PlantLoads) -> None:
        """From now on, also apply the robot's orbit or table loads to the target; wrenches on
        robot links do not act on the target.

        Raises
        ------
        ParameterError
            The target would leave the table plane.
        """
        loads.surroundings.require_flat(self.description.name, self.motion, self.inertia)
        if loads.surroundings.has_loads:
            self.loads, self._clock = PlantLoads(self._model, loads.surroundings), loads
            self._plant.load(self.loads)

    def step(self) -> None:
        """Advance a tick."""
        if self.loads is not None and self._clock is not None:
            self.loads.time = self._clock.time
        self._plant.step(np.zeros(0))

    def _start(self, motion: BodyMotion) -> InitialState:
        p, L = motion.momenta(self.inertia)
        return InitialState(
            position=motion.r_WT,
            quaternion=quaternion_from_matrix(motion.R_WT),
            linear_momentum=p,
            angular_momentum=L,
        )


def capture_values(about: Mapping[str, str]) -> dict[str, Any]:
    """Return the object ``capture`` that ``spacerobot run --json`` prints, from a capture event;
    empty for other events.

    Vectors are in W; numbers are restored exactly.
    """
    try:
        return {name: json.loads(text) for name, text in about.items()}
    except (ValueError, RecursionError):
        return {}


class CapturePlant(WrappedPlant):
    """A plant with a target that it can capture and release.

    This plant has its own state arrays: the robot's state, alone or joined with the target, is
    copied into them after each tick. Links, joints and commands are unchanged.

    Attributes
    ----------
    target_pose
        (7,) root link position (m) and quaternion (x, y, z, w) in W.
    target_twist
        (6,) linear (m/s) and angular velocity (rad/s) of the root link, in its frame.
    payload
        The held target; None if the target floats freely.
    events
        Captures and releases since the list was last cleared, without their times.

    Parameters
    ----------
    build
        Function that builds a robot's plant from an initial state.
    robot, initial
        The robot alone, and its initial state.

    Raises
    ------
    ParameterError
        The robot has no end-effector, or the initial state is invalid.
    """

    def __init__(
        self,
        build: Callable[[SpaceRobot, InitialState], Plant],
        robot: SpaceRobot,
        initial: InitialState,
        target: Target,
        config: PlantConfig,
    ) -> None:
        self.link = capturing_link(robot.description, config)
        self._link_index = robot.link_names.index(self.link)
        self._alone = build(robot, initial)
        super().__init__(self._alone)
        self.target, self._build, self._config = target, build, config.capture
        self._moving_start = config.actuation == "effort"
        self.pose, self.twist = self.pose.copy(), self.twist.copy()
        self.q, self.qdot = self.q.copy(), self.qdot.copy()
        self.effort, self.momentum = self.effort.copy(), self.momentum.copy()
        self.link_R, self.link_r = self.link_R.copy(), self.link_r.copy()
        self.expected_momenta = self.expected_momenta.copy()
        self.target_pose, self.target_twist = target.pose.copy(), target.twist.copy()
        self.payload: Payload | None = None
        self.events: list[Event] = []
        self._held_joints: Flags = np.zeros(robot.n, dtype=np.bool_)
        self._loads: PlantLoads | None = None
        self._changed: RobotMotion | None = None
        """Motion after a capture or release, until the next tick."""
        self._ready = True
        """Whether an automatic capture takes place as soon as its conditions hold."""
        # Call all functions of a capture once: compiling them later would delay the flight.
        motion, inertia = self._motion(), self.target.inertia
        grasp_impact(robot, self.link, motion, self._body(), inertia)
        joined = Payload.in_generic_pose(self.link, inertia).attached_to(robot)
        _summed_momenta(joined, motion)
        self._build(joined, InitialState(joint_positions=initial.shape(robot)))

    # -- the plant ----------------------------------------------------------------------------

    def hold(self, joints: Flags) -> None:
        """Lock the marked joints (n,) at their positions, and release all others."""
        self._held_joints = joints.copy()
        self.plant.hold(joints)

    def load(self, loads: PlantLoads) -> None:
        """Apply external loads to the robot from now on, whether or not the robot holds the target;
        the load values may change before each step. Orbit and table loads also act on a free
        target.
        """
        self._loads = loads
        self.target.load(loads)
        self._alone.load(loads)
        if self.plant is not self._alone:
            self.plant.load(loads)

    def reset(self) -> None:
        """Return the robot and the target to their initial states."""
        self._use(self._alone)
        self._alone.reset()
        self.target.reset()
        self.payload, self._changed, self._ready = None, None, True
        self._update()

    def resume(self, state: InitialState, payload: Payload | None, body: BodyMotion) -> None:
        """Continue from a later state of a flight.

        Parameters
        ----------
        state
            Robot state; its momenta include the held body.
        payload
            The body that the robot holds; None if the target floats freely.
        body
            Target motion.

        Raises
        ------
        ParameterError
            Another link holds the body, or the state does not match this robot.
        """
        robot = self._alone.robot
        if payload is not None and payload.link != self.link:
            raise ParameterError(
                f"The link '{payload.link}' holds the target, but this plant captures it with "
                f"'{self.link}': set parameter 'capture.end_effector'."
            )
        joined = robot if payload is None else payload.attached_to(robot)
        quaternion, momenta, q = state.attitude(), state.momenta(), state.shape(robot)
        rates = state.rates(robot)
        twist = joined.base_twist(quaternion, q, rates, momenta[:3], momenta[3:])
        motion = RobotMotion(
            np.concatenate([state.position, quaternion]), np.concatenate(twist), q, rates
        )
        self.payload = payload
        self._grasp = _relative_pose(frame_motion(robot, self.link, motion), body)
        self._resume_dynamics(joined, motion, momenta, body)
        self._changed = None
        self._update()
        # Conditions that prevent a capture now already did so before.
        self._ready = bool(self._config.misses(self.approach()))

    def _resume_dynamics(
        self, robot: SpaceRobot, motion: RobotMotion, momenta: Array, body: BodyMotion
    ) -> None:
        """Integrate the robot, and the target if it is free, from these motions on."""
        if self.payload is None:
            self.target.release(body)
        self._continue(robot, motion, momenta)

    def step(self, *commands: Any) -> bool:
        """Advance one tick under the robot's commands, after capturing the target if captures are
        automatic and the conditions hold. Returns whether a joint was limited.
        """
        if self._config.mode == "automatic" and self.payload is None:
            far = self._distance() > self._config.distance
            if far or self._config.misses(self.approach()):
                self._ready = True
            elif self._ready:
                self._capture(requested=False)
        limited: bool = self.plant.step(*commands)
        if self.payload is None:
            self.target.step()
        self._changed = None
        self._update()
        return limited

    def _distance(self) -> float:
        """Return the distance of the grapple frame from the end-effector, m."""
        R_WB, R_WT = (matrix_from_quaternion(pose[3:]) for pose in (self.pose, self.target_pose))
        grapple = self.target_pose[:3] + R_WT @ self.target.grapple.r
        hand = self.pose[:3] + R_WB @ self.link_r[:, self._link_index]
        return math.dist(grapple, hand)

    # -- captures -----------------------------------------------------------------------------

    def approach(self) -> RelativeMotion:
        """Return the current motion of the grapple frame relative to the end-effector."""
        end_effector = frame_motion(self.robot, self.link, self._motion())
        return RelativeMotion.between(end_effector, self._body().at(self.target.grapple))

    def capture(self) -> Event:
        """Capture the target and return the event; the next tick starts from the motion after the
        impact.

        Raises
        ------
        CommandError
            The target is already held, too far away or too fast; the message states by how much.
        """
        if self.payload is not None:
            raise CommandError(
                f"'{self.link}' already holds the target '{self.target.description.name}': call "
                "'~/release' first."
            )
        misses = self._config.misses(self.approach())
        if misses:
            raise CommandError(f"The target cannot be captured: its {'; its '.join(misses)}.")
        return self._capture(requested=True)

    def release(self) -> Event:
        """Release the target, which keeps its velocity, and return the event.

        Raises
        ------
        CommandError
            Nothing is held.
        """
        if self.payload is None:
            raise CommandError(f"'{self.link}' does not hold a target.")
        motion, body, robot = self._motion(), self._body(), self._alone.robot
        # The target keeps its share of the momenta, and the robot the rest.
        self.target.release(body)
        momenta = separated_momenta(
            (robot.total_mass, self.target.inertia.mass),
            self._centers(motion, body),
            self.plant.expected_momenta,
            self.target.momenta,
        )
        self._continue(robot, motion, momenta)
        # An automatic capture waits until the target has left.
        self.payload, self._ready = None, False
        speed, rate = np.linalg.norm(body.v), np.linalg.norm(body.omega)
        message = f"The target is released; it moves at {speed:.4g} m/s and {rate:.4g} rad/s."
        vectors = {"velocity_mps": body.v.tolist(), "rate_radps": body.omega.tolist()}
        return self._report(EventKind.RELEASED, message, 0, vectors)

    def _describe(self, impact: GraspImpact) -> tuple[str, int]:
        """Return the message about an impact, and its level: a warning if a joint impulse exceeds
        its limit."""
        limit, impulses = self._config.joint_impulse_limit, np.abs(impact.joint_impulses)
        force, moment = np.linalg.norm(impact.impulse[:3]), np.linalg.norm(impact.impulse[3:])
        message = (
            f"The target is captured by an impulse of {force:.4g} N s and {moment:.4g} N m s; "
            f"{impact.energy_lost:.4g} J of {impact.energy_before:.4g} J are lost"
        )
        if not 0.0 < limit < impulses.max(initial=0.0):
            return f"{message}.", 0
        worst = int(impulses.argmax())
        return (
            f"{message}, and joint '{self.robot.joint_names[worst]}' takes {impulses[worst]:.4g} "
            f"N m s, more than 'capture.joint_impulse_limit', {limit:g}."
        ), 1

    def _report(
        self, kind: EventKind, message: str, level: int, values: Mapping[str, Any]
    ) -> Event:
        about = {name: json.dumps(value) for name, value in values.items()}
        self.events.append(Event(kind, message, level, about=about))
        return self.events[-1]

    def _capture(self, *, requested: bool) -> Event:
        robot, motion, body = self._alone.robot, self._motion(), self._body()
        inertia = self.target.inertia
        impact = grasp_impact(robot, self.link, motion, body, inertia)
        momenta = combined_momenta(
            (robot.total_mass, inertia.mass),
            self._centers(motion, body),
            (self.plant.expected_momenta, self.target.momenta),
        )
        grasp = _relative_pose(frame_motion(robot, self.link, motion), body)
        payload = Payload(self.link, inertia.moved(grasp))
        joined = payload.attached_to(robot)
        after = RobotMotion(motion.pose, impact.twist, motion.q, impact.qdot)
        self._continue(joined, after, momenta)
        self.payload, self._grasp = payload, grasp
        values = {
            "captured": True,
            "requested": requested,
            "base_velocity_mps": (motion.R_WB @ impact.twist[:3]).tolist(),
            "base_rate_radps": (motion.R_WB @ impact.twist[3:]).tolist(),
            "joint_rates_radps": impact.qdot.tolist(),
            "impulse_Ns": impact.impulse.tolist(),
            "joint_impulses_Nms": impact.joint_impulses.tolist(),
            "joint_impulse_limit_Nms": self._config.joint_impulse_limit,
            "energy_before_J": impact.energy_before,
            "energy_lost_J": impact.energy_lost,
            # About the common centre of mass, and differing from the sum over the joined bodies
            # after the impact.
            "linear_momentum_kgmps": momenta[:3].tolist(),
            "angular_momentum_Nms": momenta[3:].tolist(),
            "total_momentum_residual": _relative_difference(
                _summed_momenta(joined, after), momenta
            ),
        }
        return self._report(EventKind.CAPTURED, *self._describe(impact), values)

    def _continue(self, robot: SpaceRobot, motion: RobotMotion, momenta: Array) -> None:
        q = np.clip(motion.q, robot.lower, robot.upper)
        rates = motion.qdot if self._moving_start else None
        start = InitialState.of_motion(motion.pose, q, rates, momenta)
        self._use(self._build(robot, start))
        # Servos bring the joints from these rates to the commanded ones in the next tick.
        self.plant.qdot[:] = motion.qdot
        self._changed = motion

    def _use(self, plant: Plant) -> None:
        if plant is not self._alone and self._loads is not None:
            plant.load(self._loads)
        self.plant, plant.limit_counts = plant, self.limit_counts
        plant.hold(self._held_joints)

    def _motion(self) -> RobotMotion:
        if self._changed is not None:
            return self._changed
        return RobotMotion(self.pose.copy(), self.twist.copy(), self.q.copy(), self.qdot.copy())

    def _body(self) -> BodyMotion:
        if self.payload is None:
            return self.target.motion
        return frame_motion(self.robot, self.link, self._motion()).at(self._grasp)

    def _centers(self, motion: RobotMotion, body: BodyMotion) -> tuple[Array, Array]:
        """Return the centres of mass of robot and target in W, m."""
        r_BC_B = self._alone.robot.center_of_mass(motion.q)
        of_target = body.at(Pose(r=self.target.inertia.com))
        return motion.pose[:3] + motion.R_WB @ r_BC_B, of_target.r_WT

    def _update(self) -> None:
        plant = self.plant
        self.pose[:], self.twist[:] = plant.pose, plant.twist
        self.q[:], self.qdot[:], self.effort[:] = plant.q, plant.qdot, plant.effort
        self.momentum[:], self.expected_momenta[:] = plant.momentum, plant.expected_momenta
        self.link_R[:], self.link_r[:] = plant.link_R, plant.link_r
        if self.payload is None:
            self.target_pose[:], self.target_twist[:] = self.target.pose, self.target.twist
            return
        body = self._body()
        self.target_pose[:3] = body.r_WT
        self.target_pose[3:] = quaternion_from_matrix(body.R_WT)
        self.target_twist[:3] = body.R_WT.T @ body.v
        self.target_twist[3:] = body.R_WT.T @ body.omega


def capturing_link(robot: RobotDescription, config: PlantConfig) -> str:
    """Return the name of the link that captures targets.

    Raises
    ------
    ParameterError
        The robot has no such link.
    """
    link = robot.end_effector(config.capture.end_effector or config.end_effector_frame)
    if link not in robot.frames:
        missing = f"has no link '{link}'" if link else "has no link 'end_effector'"
        raise ParameterError(
            f"The robot '{robot.name}' {missing} to capture a target with; it has "
            f"{', '.join(robot.frames)}: set parameter 'capture.end_effector'."
        )
    return link


def _relative_pose(first: BodyMotion, second: BodyMotion) -> Pose:
    return Pose(first.R_WT.T @ second.R_WT, first.R_WT.T @ (second.r_WT - first.r_WT))


def _summed_momenta(robot: SpaceRobot, motion: RobotMotion) -> Array:
    twist = motion.twist
    p, L, _ = robot.momentum(motion.pose[3:], motion.q, twist[:3], twist[3:], motion.qdot)
    return np.concatenate([p, L])


def _relative_difference(actual: Array, expected: Array) -> float:
    """Return the larger relative difference of linear and angular momentum."""
    shares = [0.0]
    for part in (slice(0, 3), slice(3, 6)):
        change = float(np.linalg.norm(actual[part] - expected[part]))
        size = float(np.linalg.norm(expected[part]))
        shares.append(change / size if size else (math.inf if change else 0.0))
    return max(shares)
