"""Controller without topics: goals, references, law, limits, and missing measurements."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from enum import Enum

import numpy as np
from typing_extensions import Unpack

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.detumbling import Detumbling
from spacerobot_ros.control.laws.law import ControlLaw, Gains
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.limits import (
    REFERENCE_SHARE,
    ActuatorLimits,
    JointRateLimits,
    Saturated,
)
from spacerobot_ros.control.outputs import OutputDistance, OutputSelection
from spacerobot_ros.control.planned_reference import (
    Aims,
    GoalMotion,
    GrappleReference,
    PlannedReference,
    ReferencePlanner,
)
from spacerobot_ros.control.reference import (
    PROFILES,
    QuinticReference,
    ReferenceProfile,
    StepReference,
)
from spacerobot_ros.control.state import (
    Actuation,
    ControlState,
    DeadReckoning,
    JointReference,
    PoseReference,
    Reference,
)
from spacerobot_ros.control.wheels import WheelControl
from spacerobot_ros.errors import ParameterError, PlanningError, SpaceRobotError, describe_exception
from spacerobot_ros.files import warn_once
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.rotations import compose_poses, matrix_from_quaternion, relative_pose
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningJob
from spacerobot_ros.planning.methods.thrust.problem import Grapple

_LONGEST_MOTION = 1e9
"""Longest duration of a reference, s, equal to that of the longest flights."""

_EFFORT_SAMPLES = 21
"""Number of times at which the joint efforts of a reference are computed."""

_BRAKE_RATE = 2.0
"""Decay rate of joint motion if the base state is unknown, 1/s."""


_MAX_HELD_PERIODS = 20
"""Longest gap between commands, in control periods; longer gaps are time jumps."""


class Mode(str, Enum):
    """Source of the base state."""

    MEASURED = "measured"
    ESTIMATED = "estimated"
    STOPPED = "stopped"


class CoordinatedController:
    """Controls the spacecraft and the arm together, with one command per state.

    Until a goal is set, the robot holds its pose in the first state. A goal starts a new reference
    profile from the current reference, for the base and the end-effector together.

    Parameters
    ----------
    law
        The control law, with its outputs.
    limits
        Thruster and joint effort limits; commands that exceed them are reported.
    config
        Control period, joint rate limits, and reference profile and limits; the available thrust
        may lower accelerations further. ``estimation_time`` is the longest time, s, for which the
        base state is estimated by integration after base measurements have stopped (paper 4,
        section IV). After that, the thrusters are off and the joints are brought to rest.
    wheels
        The reaction wheels, if the robot has any; the law then controls the robot's gyrostat.
    planner
        Planner of goal references; if None, the profile is used.
    """

    def __init__(
        self,
        law: ControlLaw,
        limits: ActuatorLimits,
        config: ControllerConfig,
        wheels: WheelControl | None,
        planner: ReferencePlanner | None,
    ) -> None:
        self.law, self.wheels, self.planner = law, wheels, planner
        self.limits, self._motion = limits, config.motion
        rates = config.joint_rates * law.robot.velocity_limit
        self.joint_rate_limits = JointRateLimits(law.robot, rates, config.control_period)
        self._profile_type = PROFILES.get(config.profile, QuinticReference)
        self._control_period = config.control_period
        self._estimation_time = config.estimation_time
        self.mode = Mode.MEASURED
        self.profile: ReferenceProfile | None = None
        """Profile of the current goals; None before the first state."""
        self._began = 0.0
        self.followed = Reference()
        """External references; groups without one follow the profile."""
        self._sent: Actuation | None = None
        self._commanded_at = -math.inf
        """Time of the last command, s."""
        self._estimator: DeadReckoning | None = None
        self.gains_checked = False
        """Whether the gains were checked against the control period."""
        self._stopped_at: Array | None = None
        """Joint positions (n,) at which the robot stops while its base is unknown."""
        self.coming_to_rest = False
        """Whether the robot is being brought to rest, in any pose."""
        self._to_rest: Callable[[ControlState], Actuation] = self.detumbling(None, 0.0).command

    def reset(self) -> None:
        """Discard goals and measurements; the next state is treated as the first."""
        self.law.reset_integral()
        self.profile, self.followed = None, Reference()
        self.coming_to_rest = False
        self._sent = self._estimator = self._stopped_at = None
        self.mode = Mode.MEASURED
        if self.wheels is not None:
            self.wheels.reset()

    def take_over_goals(self, other: CoordinatedController) -> None:
        """Pursue another controller's goals from now on."""
        self.profile, self._began = other.profile, other._began
        self.followed, self.coming_to_rest = other.followed, other.coming_to_rest

    def set_gains(self, gains: Gains) -> None:
        """Change the gains from the next command on."""
        self.law.set_gains(gains)
        self.gains_checked = False

    def set_goals(self, time: float, state: ControlState, **aims: Unpack[Aims]) -> None:
        """Start towards new goals; a group without a new goal keeps its previous one.

        If the end-effector has had no goal since the robot was held or brought to rest, the base
        carries the end-effector along and the arm keeps its shape. The error integral is reset. The
        reference follows the profile; it is not planned.
        """
        start, goal, carries, _ = self.motion_to(time, state, **aims)
        self.begin(time, self._profile(state, start, goal, carries=carries))

    def motion_to(self, time: float, state: ControlState, **aims: Unpack[Aims]) -> GoalMotion:
        """Return the motion from the reference at a given time to goals as in
        :meth:`set_goals`, and the base poses (7,) at which it rests on the way."""
        base, end_effector = aims.get("base"), aims.get("end_effector")
        joints = aims.get("joints")
        if self.coming_to_rest:
            self.profile, self.coming_to_rest = None, False
        start = self.reference_at(time, state)
        goal = start if self.profile is None else self.profile.goal
        carries = end_effector is None and (self.profile is None or self.profile.carries)
        if base is not None:
            if carries:
                goal = replace(goal, end_effector=self._carried_end_effector(goal, base, state))
            goal = replace(goal, base=base)
        if end_effector is not None:
            goal = replace(goal, end_effector=end_effector)
        if joints is not None:
            goal = replace(goal, joints=JointReference.at_rest(joints))
        return GoalMotion(self._in_motion(start, state), goal, carries, aims.get("waypoints", ()))

    def _in_motion(self, start: Reference, state: ControlState) -> Reference:
        """Return the start of a reference; the first one that is planned while the plant waits
        begins with the measured velocities."""
        if self.profile is not None or self.planner is None or self.planner.in_background:
            return start
        state = state.copied()
        pose = state.r_WB, state.quaternion_WB
        base = PoseReference.with_body_twist(*pose, state.v_WB_B, state.omega_WB_B)
        joints = JointReference(state.q, state.qdot, np.zeros(len(state.q)))
        return replace(start, base=base, joints=joints)

    def plan_grapple(
        self, time: float, state: ControlState, grapple: Grapple, lead: float
    ) -> PlanningJob[GrappleReference]:
        """Return a job that plans a reference to a target with known motion from ``time`` on. The
        plan begins ``lead`` s later, from the reference and the target predicted for that time.
        """
        planner = self.planner
        assert planner is not None
        if self.coming_to_rest:
            self.profile, self.coming_to_rest = None, False
        start = self._in_motion(self.reference_at(time + lead, state), state)
        later = replace(grapple, motion=grapple.motion.later(lead))

        def work(cancellation: Cancellation) -> GrappleReference:
            return planner.plan_grapple(start, state, later, cancellation)

        return PlanningJob(work, time + lead)

    def begin(self, time: float, profile: ReferenceProfile) -> None:
        """Follow a profile from a given time on."""
        self.profile, self._began = profile, time
        with self._failures_of_law(time):
            self.law.start(time, profile.start, profile.goal)

    def require_bounded_duration(self, state: ControlState, goals: Reference) -> None:
        """Reject goals whose reference would take too long.

        Raises
        ------
        PlanningError
            The reference takes too long; the message states its duration.
        """
        here = Reference.present(
            self.law.robot, state, self.law.outputs.selection.end_effector_link
        )
        duration = self._profile(state, here, goals).duration
        if duration > _LONGEST_MOTION:
            raise PlanningError(
                f"The reference to the goal would take {duration:.3g} s, and the longest is "
                f"{_LONGEST_MOTION:g} s: choose a nearer goal, or raise motion.speed, "
                "motion.acceleration or the limits of thrusters and joint efforts."
            )

    def _profile(
        self, state: ControlState, start: Reference, goal: Reference, *, carries: bool = False
    ) -> ReferenceProfile:
        """Return the motion to a goal that thrusters, wheels and joint motors can follow."""
        robot, actuators = self.law.robot, self.limits
        motion = self._motion.within_thruster_limits(actuators, robot, state.q)
        if self.wheels is not None:
            motion = self.wheels.limits_with_wheels(motion, state.q)
        profile = self._profile_type(start, goal, motion, carries=carries)
        # Efforts are inversely proportional to the square of the duration.
        has_motor, share = actuators.effort > 0, 1.0
        for time in np.linspace(0.0, profile.duration, _EFFORT_SAMPLES):
            base = profile.at(time).base
            if base is not None:
                efforts = self.joint_rate_limits.holding_efforts(state.q, base)
                shares = np.abs(efforts[has_motor] / actuators.effort[has_motor])
                share = max(share, shares.max(initial=0.0) / REFERENCE_SHARE)
        profile.duration *= math.sqrt(share)
        return profile

    @contextmanager
    def _failures_of_law(self, time: float) -> Iterator[None]:
        """Name the law in errors from its code, which may be user code and may even end Python."""
        try:
            yield
        except SpaceRobotError:
            raise
        except (Exception, SystemExit) as error:
            raise SpaceRobotError(
                f"The law '{self.law.name}' has failed at {time:g} s: {describe_exception(error)}."
            ) from error

    def _carried_end_effector(
        self, before: Reference, base: PoseReference, state: ControlState
    ) -> PoseReference | None:
        """Return an end-effector pose with the base at a goal and the arm shape unchanged."""
        carrier, carried = before.base, before.end_effector
        if carrier is None or carried is None:
            return carried
        position = base.position
        if all(axis.startswith("r") for axis in self.law.outputs.selection.base):
            c_B = self.law.robot.center_of_mass(state.q)
            turned = matrix_from_quaternion(base.quaternion)
            present = matrix_from_quaternion(carrier.quaternion)
            position = carrier.position + (present - turned) @ c_B
        begins = np.concatenate([position, base.quaternion])
        pose = compose_poses(begins, relative_pose(carrier.values, carried.values))
        return PoseReference(pose[:3], pose[3:])

    def restart_motion(self, time: float, state: ControlState) -> None:
        """Restart towards the current goals from the measured pose instead of the reference."""
        profile, self.profile, self.coming_to_rest = self.profile, None, False
        start = self.reference_at(time, state)
        goal, carries = (start, True) if profile is None else (profile.goal, profile.carries)
        self.begin(time, self._profile(state, start, goal, carries=carries))

    def hold_here(self, time: float, state: ControlState) -> None:
        """Hold the measured pose and shape; the previous reference is dropped."""
        self.profile = None
        self.set_goals(time, state)

    def come_to_rest(self, law: Callable[[ControlState], Actuation] | None = None) -> None:
        """Bring the whole robot to rest, in any pose, until there is a new goal or reference.

        ``law`` returns the command for a state; None: that of a robot without a held body.
        """
        self.coming_to_rest = True
        self._to_rest = law or self.detumbling(None, 0.0).command

    def detumbling(self, payload: Payload | None, torque_limit: float) -> Detumbling:
        """Return the law that brings the robot to rest with its thrusters, wheels and joints.

        ``payload`` is the body that the robot holds, ``torque_limit`` the largest grasp torque, N
        m; 0: no limit.
        """
        torque, wheels = self.limits.torque, self.wheels
        if wheels is not None:
            torque += wheels.torque_about_every_axis
        force, period = self.limits.force, self._control_period
        return Detumbling(self.law.robot, payload, force, torque, torque_limit, period)

    def reference_at(self, time: float, state: ControlState) -> Reference:
        """Return the reference at a given time; before the first reference, the pose of the robot
        at rest."""
        if self.profile is not None:
            return self.profile.at(time - self._began)
        link = self.law.outputs.selection.end_effector_link
        return Reference.present(self.law.robot, state, link)

    def shift_time(self, seconds: float) -> None:
        """Shift the reference start by a time jump (s)."""
        self._began += seconds

    def follow(self, reference: Reference) -> None:
        """Track an external reference at the next command; output groups without an external
        reference follow the profile."""
        self.followed = reference
        self.coming_to_rest = False

    def command(
        self, time: float, measured: ControlState | None, q: Array, qdot: Array
    ) -> Saturated:
        """Return the actuation at ``time`` (s), within limits.

        ``measured`` is the state, or None without a base measurement; ``q`` and ``qdot`` (n,) are
        the joint positions and rates, which are always measured.

        Raises
        ------
        NotFiniteError
            A measurement is not finite.
        """
        state, around_B, period = self._known_state(measured, q, qdot), None, self._control_period
        if state is None:
            if self._stopped_at is None:
                # The joints stop where a smooth deceleration from their current rates ends.
                self._stopped_at = q + qdot / _BRAKE_RATE
            qddot = _BRAKE_RATE**2 * (self._stopped_at - q) - 2 * _BRAKE_RATE * qdot
            efforts = self.joint_rate_limits.efforts(q, qdot, qddot)
            result = self.limits.apply(Actuation(np.zeros(6), efforts))
            if self.wheels is not None:
                self.wheels.coast()
            self._sent = result.realised
            return result
        if self.profile is None:
            here = self.reference_at(time, state)
            self.begin(time, StepReference(here, here, carries=True))
        # The law is always evaluated, for its errors and status.
        self.law.time = time
        with self._failures_of_law(time):
            commanded = self.law.command(state, self._followed_reference(time))
        if not self.gains_checked:
            self.gains_checked = True
            if warning := self.law.sampling_warning():
                warn_once(warning)
        profile, follows = self.profile, self.law.follows_accelerations
        if self.coming_to_rest:
            commanded = self._to_rest(state)
        elif isinstance(profile, PlannedReference) and (profile.uses_table or not follows):
            planned = profile.actuation(time - self._began, period, self.law.joint_damping)
            around_B = planned.wrench_B if profile.uses_table else None
            if not follows:
                commanded = Actuation(*(a + b for a, b in zip(commanded, planned, strict=True)))
        # This command will probably be held for as many periods as the last one: an overloaded
        # machine does not answer every state.
        elapsed, self._commanded_at = (time - self._commanded_at) / period, time
        periods = round(elapsed) if 1.0 < elapsed < _MAX_HELD_PERIODS else 1
        result = self.apply_limits(state, commanded, periods, around_B)
        if self.law.integrates and not self.coming_to_rest:
            self.law.integrate_error(periods * period, limited=result.limited)
        self._sent = result.realised
        return result

    def apply_limits(
        self,
        state: ControlState,
        commanded: Actuation,
        periods: int = 1,
        around_B: Array | None = None,
    ) -> Saturated:
        """Return the realised part of a command held for several control periods.

        Thruster limits apply to the difference from a wrench ``around_B`` (6,), which was planned
        for the actual thrusters and may exceed these limits.
        """
        given = self._realised(commanded, around_B)
        kept = self.joint_rate_limits.apply(state, given, self.limits.effort, periods)
        if self.wheels is not None and kept is not given:
            # The wrench is lowered if joints are too fast.
            kept = self._realised(kept, around_B)
        return Saturated.of(commanded, kept)

    def _realised(self, wanted: Actuation, around_B: Array | None = None) -> Actuation:
        """Return the part of a command realised by wheels, if any, then by thrusters and joints."""
        if around_B is not None:
            correction = self._realised(wanted._replace(wrench_B=wanted.wrench_B - around_B))
            if self.wheels is not None:
                self.wheels.thrust = self.wheels.thrust + around_B
            return correction._replace(wrench_B=correction.wrench_B + around_B)
        wheels = self.wheels
        if wheels is None:
            return self.limits.apply(wanted).realised
        torque = wheels.command_torque(wanted.wrench_B[3:])
        rest = wanted.wrench_B.copy()
        rest[3:] -= torque
        limited = self.limits.apply(Actuation(rest, wanted.tau)).realised
        wheels.thrust = limited.wrench_B
        return Actuation(wanted.wrench_B - (rest - limited.wrench_B), limited.tau)

    @property
    def goal(self) -> Reference:
        """Pose and shape at the end of the references; empty before the first state."""
        return Reference() if self.profile is None else self.profile.goal

    @property
    def time_since_measurement(self) -> float:
        """Time since the last base measurement, s."""
        return self._estimator.elapsed if self._estimator is not None else 0.0

    def time_until_blocked(self, time: float) -> float:
        """Return the time, s, for which the planned reference stays clear of obstacles from
        ``time`` on."""
        if self.planner is None or not isinstance(self.profile, PlannedReference):
            return math.inf
        return self.planner.time_until_blocked(self.profile, time - self._began)

    def waypoints_passed(self, time: float) -> int:
        """Return the number of waypoints that the reference has passed at ``time`` (s)."""
        if not isinstance(self.profile, PlannedReference):
            return 0
        return self.profile.waypoints_passed(time - self._began)

    def reference_at_rest(self, time: float) -> bool:
        """Whether the reference has reached its goal at ``time`` (s)."""
        return self.profile is not None and time - self._began >= self.profile.duration

    @property
    def reference_ends(self) -> float | None:
        """Time at which the reference reaches its goal, s; None without a reference."""
        return None if self.profile is None else self._began + self.profile.duration

    def errors(self) -> OutputDistance:
        """Return the errors of the last command's outputs relative to the reference; 0 for kinds
        that are not controlled."""
        return self.law.outputs.selection.distance(self.law.error, other=0.0)

    def distance_from_reference(self) -> OutputDistance:
        """Return the distance of the last command's outputs from the reference."""
        return self.law.outputs.selection.distance(self.law.error)

    def distance_between(self, state: ControlState, goal: Reference) -> OutputDistance:
        """Return the distance of the outputs in a state from a goal for all outputs."""
        outputs = self.law.outputs
        return outputs.selection.distance(outputs.errors(state, goal))

    def error_bounds(self, margins: OutputDistance) -> Array:
        """Return the output errors (m,) beyond which control is lost.

        Call this after the first command towards the current goals. All outputs of a kind have the
        same bound: a margin (m, rad) plus twice the larger of two values. These are the distance
        covered by the reference, and the largest current error plus the distance by which its rate
        increases it before the rate is damped.
        """
        assert self.profile is not None
        law, far = self.law, self.profile.distances()
        Kp, Kd = law.gain_diagonals
        reach = np.abs(law.error) + Kd / Kp * np.abs(law.error_rate)
        bounds = np.empty(len(reach))
        distances = law.outputs.selection.distances
        for kind in {kind for kind, _ in distances}:
            of_kind = [i for each, places in distances if each == kind for i in places]
            largest = max(getattr(far, kind), float(reach[of_kind].max()))
            bounds[of_kind] = 2 * largest + getattr(margins, kind)
        return bounds

    # -- parts --------------------------------------------------------------------------------

    def _followed_reference(self, time: float) -> Reference:
        assert self.profile is not None
        own, given = self.profile.at(time - self._began), self.followed
        if given.base is None and given.joints is None and given.end_effector is None:
            return own
        return Reference(
            given.base or own.base,
            given.end_effector or own.end_effector,
            given.joints or own.joints,
            of_one_motion=own.of_one_motion and given.joints is None,
        )

    def _known_state(
        self, measured: ControlState | None, q: Array, qdot: Array
    ) -> ControlState | None:
        """Return the measured state, its estimate, or None if it is no longer known."""
        if measured is not None:
            if self._estimator is not None:
                self._estimator.reset(measured)
            self.mode, self._stopped_at = Mode.MEASURED, None
            return measured
        if self._sent is None or self.mode is Mode.STOPPED:
            self.mode = Mode.STOPPED
            return None
        if self._estimator is None:
            self._estimator = DeadReckoning(self.law.robot, self._control_period)
            # The last measured state is copied, as callers may reuse its arrays.
            self._estimator.reset(self.law.state)
        if self._estimator.elapsed + self._control_period > self._estimation_time + 1e-9:
            self.mode = Mode.STOPPED
            return None
        self.mode = Mode.ESTIMATED
        return self._estimator.step(self._sent, q, qdot)


def build_controller(robot: SpaceRobot, config: ControllerConfig) -> CoordinatedController:
    """Return the controller for a robot, as described by a configuration.

    If the robot has reaction wheels, the law controls its gyrostat, in which the wheels are not
    joints.

    Raises
    ------
    ParameterError
        The robot does not have the selected outputs, or the law cannot control them.
    """
    law_type = LAWS[config.law]
    thrust = config.use_thrusters
    force, torque = config.max_force or math.inf, config.max_torque or math.inf
    if not thrust:
        force = torque = 0.0
    wheels = None
    if robot.description.wheel_names:
        wheels = WheelControl(robot, config.wheels, config.control_period, torque)
        robot = wheels.gyrostat
    outputs = controlled_outputs(robot, config, law_type)
    if not thrust:
        _require_torque(outputs, robot, wheels)
    try:
        law = law_type(
            robot,
            outputs,
            config.gains,
            config.options[config.law],
            thrust=thrust,
            control_period=config.control_period,
        )
    except SpaceRobotError:
        raise
    except (Exception, SystemExit) as error:
        raise ParameterError(
            f"The control law '{config.law}' cannot be built: {describe_exception(error)}."
        ) from error
    limits = ActuatorLimits(force, torque, robot.effort_limit)
    planner = ReferencePlanner(robot, outputs, limits, config) if config.plans else None
    return CoordinatedController(law, limits, config, wheels, planner)


def controlled_outputs(
    robot: SpaceRobot, config: ControllerConfig, law_type: type[ControlLaw]
) -> OutputSelection:
    """Return the outputs selected in a configuration, or the law's default outputs.

    The robot has no wheels, or is the gyrostat.
    """
    link = robot.description.end_effector(config.end_effector_frame)
    outputs = OutputSelection(
        tuple(config.base_outputs.split()),
        tuple(config.end_effector_outputs.split()),
        tuple(config.joint_outputs.split()),
        link,
    )
    if outputs.labels:
        return outputs
    outputs = law_type.default_outputs(robot, link)
    if not config.use_thrusters:
        turns = tuple(axis for axis in outputs.base if axis.startswith("r"))
        outputs = replace(outputs, base=turns)
    return outputs


def _require_torque(
    outputs: OutputSelection, robot: SpaceRobot, wheels: WheelControl | None
) -> None:
    """Reject outputs of a base without thrusters that its wheels do not move."""
    name, turns = robot.description.name, [axis for axis in outputs.base if axis.startswith("r")]
    if len(turns) < len(outputs.base):
        raise ParameterError(
            f"The base position of robot '{name}' cannot be controlled without thrusters "
            "(use_thrusters is false): remove x, y and z from base_outputs."
        )
    rank = 0 if wheels is None else wheels.rank
    if len(turns) > rank:
        raise ParameterError(
            f"Robot '{name}' has no thrusters (use_thrusters is false), and its reaction wheels "
            f"can rotate it about only {rank} of {len(turns)} controlled axes: remove rx, ry or "
            "rz from base_outputs."
        )
