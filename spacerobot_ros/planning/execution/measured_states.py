"""Measured states: their average at rest, their deviation from the predicted base path, and mass
errors that explain it.

At zero momentum, the base rotation depends only on the shape path and on ratios of masses and
inertias. A rotation that differs from the prediction indicates errors in these model
parameters. To first order, the deviation of the base path is linear in the relative errors of these
parameters, each multiplied by a path sensitivity. Linear least squares over many noisy poses, with
a prior on the errors, yields the estimate (one Gauss-Newton step about the model).
"""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    hat,
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.goal import (
    Controlled,
    Goal,
    PoseError,
    RobotState,
    Tolerance,
    end_effector_pose,
)
from spacerobot_ros.planning.core.schedule import GaitSchedule, interpolated
from spacerobot_ros.planning.execution.config import PlannerConfig

# -- averages --------------------------------------------------------------------------------------

_REST_RATE = 1e-9  # m/s or rad/s


class BaseMeasurement(NamedTuple):
    """A measured base: ``pose`` (7,), ``twist`` (6,), and the joint rates ``qdot`` (n,)."""

    pose: Array
    twist: Array
    qdot: Array


class MeasuredState(NamedTuple):
    """A measured state: stamp, shape ``q`` (n,), m or rad, and base, if measured at this time."""

    stamp_ns: int
    q: Array
    base: BaseMeasurement | None


class StateAverage:
    """Averages measured states, and estimates the total momenta from states at rest.

    While joints move, the momentum of a robot with uncertain masses is uncertain; at rest, it
    follows from the base motion alone, and without thrust it is constant. So a state is given the
    last momenta measured at rest, if there are any.

    Parameters
    ----------
    robot
        The model.
    count
        States to average.
    rest_tolerance
        Averaged base and joint rates up to this value, m/s or rad/s, are treated as noise at rest,
        and the momentum as zero. 0: every measured momentum is used.
    """

    def __init__(self, robot: SpaceRobot, count: int = 1, rest_tolerance: float = 0.0) -> None:
        self._robot, self._full_count, self._tolerance = robot, count, rest_tolerance
        wheels = ReactionWheels.of(robot.description)
        self._wheels, self._braked = wheels.index, wheels.other
        self.forget()

    @property
    def count(self) -> int:
        """Number of states since the last restart."""
        return len(self._states)

    @property
    def complete(self) -> bool:
        """Whether the average includes as many states as requested."""
        return self.count >= self._full_count

    def restart(self) -> None:
        """Discard the averaged states, but keep the momenta."""
        self._states: list[tuple[Array, Array, Array]] = []
        """Poses (7,), rates (6 + n,) and shapes (n,)."""

    def forget(self) -> None:
        """Discard the states and the momenta, because the robot state has changed."""
        self.restart()
        self._momenta: tuple[Array, Array] | None = None
        """Momenta last measured at rest, (3,) each; None: none were."""

    def add(self, pose: Array, twist: Array, q: Array, qdot: Array) -> None:
        """Add a state: pose (7,), twist (6,), shape and joint rates (n,), as reported by plants."""
        self._states.append((pose.copy(), np.concatenate([twist, qdot]), q.copy()))

    def take(self, measured: MeasuredState, *, alone: bool = False) -> bool:
        """Add a state, or use it alone; return false if its base is not measured."""
        base = measured.base
        if base is None:
            return False
        if alone:
            self.restart()
        self.add(base.pose, base.twist, measured.q, base.qdot)
        return True

    def state(self) -> RobotState:
        """Return the average of the states, of which there must be at least one.

        Raises
        ------
        PlanningError
            The average is not finite.
        """
        poses, measured_rates, shapes = map(np.array, zip(*self._states, strict=True))
        rates, q = measured_rates.mean(axis=0), shapes.mean(axis=0)
        if not (np.all(np.isfinite(poses)) and np.all(np.isfinite(np.concatenate([q, rates])))):
            raise PlanningError("The measured state is not finite; see odom and joint_states.")
        # Attitudes differ by noise: the mean of small rotations from the first is exact enough.
        first = poses[0, 3:]
        quaternion = first
        if len(poses) > 1:
            turn = np.mean([attitude_error(first, pose[3:]) for pose in poses], axis=0)
            quaternion = quaternion_multiply(first, quaternion_from_rotvec(turn))
        twist, qdot = rates[:6], rates[6:]
        momenta = self._momenta
        # Wheels keep spinning at rest.
        at_rest = np.abs(qdot[self._braked]).max(initial=0.0) <= max(_REST_RATE, self._tolerance)
        if at_rest or momenta is None:
            noise = np.abs(np.concatenate([twist, qdot[self._wheels]])).max() <= self._tolerance
            if at_rest and self._tolerance and noise:
                momenta = np.zeros(3), np.zeros(3)
            else:
                momenta = self._robot.momentum(quaternion, q, twist[:3], twist[3:], qdot)[:2]
        if at_rest:
            self._momenta = momenta
        return RobotState(poses[:, :3].mean(axis=0), quaternion, q, *momenta, qdot)


# -- deviation from the path -----------------------------------------------------------------------

_MAX_EVALUATED_SHAPES = 48
_DIFFERENCE_STEP = 1e-6

_PRIOR_DEVIATION = 0.1
"""Prior standard deviation of relative mass and inertia errors."""

_POSE_NOISE = 1e-3
"""Standard deviation of each component of a measured pose, m or rad."""

_MAX_PLAUSIBLE_ERROR = 6 * _PRIOR_DEVIATION
"""Largest plausible relative error; beyond it, another cause is likely, such as a sensor jump."""

_NEAR_SHARES, _AIM_SHARES = (0.6, 0.8), (0.4, 0.6)
"""Fractions of the tolerances, with one value each for the early and the late phase of a motion:
the remaining motion is replanned if its expected error exceeds the first fraction, and the expected
error of the new plan may be at most the second fraction. Base rotations that are postponed until
late in a motion take a long time."""


class PathCheck:
    """Compares measured states with a schedule's predicted base path.

    At zero momentum, the base motion relative to the current base pose depends only on the shape
    path. So a base that deviates from the predicted path continues along that path, rotated and
    displaced by the mean deviation of the latest measured poses.

    Call the other methods only for a state that is :meth:`due`.

    Parameters
    ----------
    robot
        The model.
    schedule
        The tracked schedule.
    start_ns
        Stamp of the schedule's first tick, ns.
    config
        Planner parameters: tracking error bounds, and the shape deadband.
    average
        Number of poses whose mean deviation is used for plans that begin in motion; 0: none.
    masses
        Estimate of mass and inertia errors, improved by the measurements if the schedule's path has
        derivatives with respect to them.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        schedule: GaitSchedule,
        start_ns: int,
        config: PlannerConfig,
        average: int = 0,
        masses: MassEstimate | None = None,
    ) -> None:
        # Do not compile in flight.
        self._robot = robot.interpreted
        self._path, self._positions = schedule.path, schedule.positions
        self._period, self._deadband = schedule.control_period, config.shape_deadband
        self._max_distance = config.drift_position or np.inf
        self._max_angle = config.drift_attitude or np.inf
        self._stamps = start_ns + (schedule.path.time * 1e9).round().astype(np.int64)
        self._stamp_slack = round(schedule.control_period * 0.5e9)
        self._next_pose = 0
        self._checks_base_path = (
            config.drift_position > 0 or config.drift_attitude > 0 or average > 0
        )
        self._recent_deviations: deque[tuple[int, Array]] = deque(maxlen=average)
        sensitivity = schedule.path.mass_derivatives
        if sensitivity is None or masses is None:
            sensitivity, masses = np.zeros((len(schedule.path.time), 6, 0)), MassEstimate(0)
        self._sensitivity, self._masses = sensitivity, masses
        masses.begin_path()

    def due(self, stamp_ns: int) -> bool:
        """Whether the path has a predicted pose at a stamp."""
        if not self._checks_base_path:
            return False
        stamps, slack = self._stamps, self._stamp_slack
        while self._next_pose < len(stamps) and stamps[self._next_pose] < stamp_ns - slack:
            self._next_pose += 1
        return self._next_pose < len(stamps) and stamps[self._next_pose] <= stamp_ns + slack

    def error(self, state: RobotState) -> PoseError | None:
        """Return the error of a state relative to the path; None if within bounds."""
        k = self._next_pose
        turn = attitude_error(state.quaternion, self._path.quaternion[k])
        error = PoseError(self._path.position[k] - state.position, turn)
        too_far = error.distance > self._max_distance or error.angle > self._max_angle
        return error if too_far else None

    def average_pose(self, state: RobotState) -> RobotState:
        """Add a state to the mean deviation; return the state with the averaged pose.

        The deviation by joints that lag behind vanishes as they catch up, so it is not in the mean.
        """
        k, predicted = self._next_pose, self._path.quaternion[self._next_pose]
        behind = state.q - self._positions[round(self._path.time[k] / self._period)]
        behind[np.abs(behind) <= self._deadband] = 0.0
        moved_B = -self._robot.connection(state.q) @ behind
        R_WB = matrix_from_quaternion(state.quaternion)
        lag = np.concatenate([R_WB @ moved_B[:3], R_WB @ moved_B[3:]])
        turn = matrix_from_quaternion(predicted) @ attitude_error(predicted, state.quaternion)
        deviation = np.concatenate([state.position - self._path.position[k], turn]) - lag
        self._recent_deviations.append((k, deviation))
        self._masses.add(self._sensitivity[k], deviation)
        position, quaternion = self._displaced_pose(self._mean_deviation() + lag)
        return replace(state, position=position, quaternion=quaternion)

    @property
    def end(self) -> tuple[Array, Array]:
        """End of the path according to the mean deviation: position (3,), attitude (4,)."""
        k, mean = self._next_pose, self._mean_deviation()
        position, quaternion = self._displaced_pose(mean)
        turn = quaternion_from_rotvec(mean[3:])
        way = self._path.position[-1] - self._path.position[k]
        ahead = attitude_error(self._path.quaternion[k], self._path.quaternion[-1])
        return (
            position + matrix_from_quaternion(turn) @ way,
            quaternion_multiply(quaternion, quaternion_from_rotvec(ahead)),
        )

    @property
    def expected_end(self) -> tuple[Array, Array]:
        """End of the path according to the estimated mass errors: position (3,), attitude (4,)."""
        k, (position, quaternion) = self._next_pose, self.end
        more = self._deviation_by_masses(k, -1)
        turn = quaternion_from_rotvec(more[3:])
        return position + more[:3], quaternion_multiply(turn, quaternion)

    def _displaced_pose(self, deviation: Array) -> tuple[Array, Array]:
        turn, k = quaternion_from_rotvec(deviation[3:]), self._next_pose
        position = self._path.position[k] + deviation[:3]
        return position, quaternion_multiply(turn, self._path.quaternion[k])

    def _deviation_by_masses(self, begin: int, end: int) -> Array:
        """Return the change in deviation (6,) between instants due to mass errors."""
        return np.asarray((self._sensitivity[end] - self._sensitivity[begin]) @ self._masses.errors)

    def _mean_deviation(self) -> Array:
        k, recent = self._next_pose, self._recent_deviations
        changed = [d + self._deviation_by_masses(i, k) for i, d in recent]
        return np.asarray(np.mean(changed, axis=0)) if changed else np.zeros(6)

    def shift_goal(
        self, goal: Goal, within: Tolerance, controls: frozenset[Controlled], *, late: bool
    ) -> Goal | None:
        """Return the goal for a new plan; None if the path is expected to end close to its goal.

        Plans use the URDF masses. So the goal is shifted by the part of the error expected from the
        estimated masses that exceeds a fraction of the tolerance.
        """
        last = self._positions[-1]
        error = PoseError.between(*self.expected_end, goal, last, self._robot)
        near = Tolerance(*(_NEAR_SHARES[late] * x for x in (within.position, within.attitude)))
        if near.admits(error, controls):
            return None
        allowed = Tolerance(*(_AIM_SHARES[late] * x for x in (within.position, within.attitude)))
        position, quaternion = _aim(self.end, error, allowed)
        hands = []
        for each, missing in zip(goal.end_effectors, error.end_effectors, strict=True):
            end = end_effector_pose(self._robot, each.link, *self.end, last)
            r, turned = _aim(end, missing, allowed)
            attitude = None if each.quaternion is None else turned
            hands.append(replace(each, position=r, quaternion=attitude))
        return replace(goal, position=position, quaternion=quaternion, end_effectors=tuple(hands))


def _aim(end: tuple[Array, Array], error: PoseError, allowed: Tolerance) -> tuple[Array, Array]:
    """Return an end pose (3,), (4,) shifted by the part of its error beyond the allowed error."""
    position, quaternion = end
    moved = error.position * _excess_share(error.distance, allowed.position)
    turn = error.rotvec * _excess_share(error.angle, allowed.attitude)
    return position + moved, quaternion_multiply(quaternion, quaternion_from_rotvec(turn))


def _excess_share(error: float, allowed: float) -> float:
    return max(0.0, 1.0 - allowed / error) if error > 0 else 0.0


class PathSensitivity:
    """Derivatives of a base path with respect to P parameters: relative mass and inertia errors.

    The first P / 2 are errors in the body masses, the others in the inertia tensors.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        self._robot = robot.interpreted
        self.count = 2 * len(robot.description.bodies)

    @cached_property
    def _model(self) -> tuple[ca.Function, Array]:
        """A function of shape and inertial parameters, and the parameters (k, 1 + P) of variants.

        The function returns the angular velocity of the base per joint rate (3 n,) and the centre
        of mass (3,), in the base frame. Variants: the model, then each parameter changed by a step.
        """
        robot, bodies = self._robot, self.count // 2
        factors = 1 + np.vstack([np.zeros(self.count), _DIFFERENCE_STEP * np.eye(self.count)])
        weighing = robot.inertial.scaled(factors[:, :bodies], factors[:, bodies:])
        model, arguments = robot.symbolic_model(weighing)
        q, p = ca.SX.sym("q", robot.n), ca.SX.sym("p", arguments.shape[1])
        connection = ca.reshape(model.function("connection", compile=False)(q, p), 6, robot.n)
        center = model.function("center_of_mass", compile=False)(q, p)
        return ca.Function("model", [q, p], [ca.vec(-connection[3:, :]), center]), arguments.T

    def _derivatives(self, shapes: Array) -> tuple[Array, Array]:
        """Return derivatives with respect to the parameters, for shapes (M, n), in the base frame.

        They are those of rotations by each joint (M, n, 3, P) and of the centre of mass (M, 3, P).
        """
        model, arguments = self._model
        variants = arguments.shape[1]
        outputs = model.map(len(shapes) * variants)(
            np.repeat(shapes, variants, axis=0).T, np.tile(arguments, len(shapes))
        )
        turns, centers = (np.asarray(each).T.reshape(len(shapes), variants, -1) for each in outputs)
        by_turn, by_center = (
            (each[:, 1:] - each[:, :1]).transpose(0, 2, 1) / _DIFFERENCE_STEP
            for each in (turns, centers)
        )
        return by_turn.reshape(len(shapes), self._robot.n, 3, self.count), by_center

    def path_derivatives(self, schedule: GaitSchedule) -> Array:
        """Return the derivatives (K, 6, P) of the K poses of a schedule's predicted path.

        The first three components are position, m, the others attitude (rotation vector, rad), all
        in W. The derivatives of the first pose are zero, because this pose is measured.
        """
        path = schedule.path
        knots = len(path.time)
        ticks = (path.time / schedule.control_period).round().astype(int)
        shapes = schedule.positions[ticks]
        R_WB = np.array([matrix_from_quaternion(each) for each in path.quaternion])
        # The model changes little between shapes: it is evaluated for some, and interpolated.
        instants: Array = np.arange(knots, dtype=float)
        called = np.unique(np.linspace(0, knots - 1, _MAX_EVALUATED_SHAPES).round().astype(int))
        turns, centers = self._derivatives(shapes[called])
        by_joint = interpolated(instants[:-1] + 0.5, called, turns)
        in_base = np.einsum("kjap,kj->kap", by_joint, np.diff(shapes, axis=0))
        steps = (R_WB[:-1] + R_WB[1:]) / 2 @ in_base
        turned = np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
        # The system's centre of mass C is at rest: r_WB = r_WC - R_WB r_BC_B.
        r_BC_W = [R @ self._robot.center_of_mass(q) for R, q in zip(R_WB, shapes, strict=True)]
        arms = np.array([hat(each) for each in r_BC_W])
        moved = arms @ turned - R_WB @ interpolated(instants, called, centers)
        return np.concatenate([moved - moved[0], turned], axis=1)


class MassEstimate:
    """Estimate of P = ``count`` relative mass and inertia errors from base path deviations.

    The first pose of each path has a measurement error. So each path has an unknown constant
    offset, which is eliminated from the normal equations. Deviations that only implausible errors
    would explain (of a failing sensor) are ignored: the estimate is zero, the path is discarded.
    """

    def __init__(self, count: int) -> None:
        # Information matrix and vector of the prior and of all earlier paths.
        self._information = (_POSE_NOISE / _PRIOR_DEVIATION) ** 2 * np.eye(count)
        self._vector = np.zeros(count)
        self._clear_path()

    def _clear_path(self) -> None:
        count = len(self._vector)
        self._poses = 0
        self._sum_J, self._sum_y = np.zeros((6, count)), np.zeros(6)
        self._squares, self._products = np.zeros((count, count)), np.zeros(count)
        self._errors: Array | None = None

    def begin_path(self) -> None:
        """Start a new path, but keep the information from earlier paths."""
        if self.errors.any():
            self._information, self._vector = self._normal_equations()
        self._clear_path()

    def add(self, sensitivity: Array, deviation: Array) -> None:
        """Add the deviation (6,) of a pose with path sensitivity (6, P)."""
        self._poses += 1
        self._sum_J += sensitivity
        self._sum_y += deviation
        self._squares += sensitivity.T @ sensitivity
        self._products += sensitivity.T @ deviation
        self._errors = None

    @property
    def errors(self) -> Array:
        """Relative errors (P,) in masses, then in inertias."""
        if self._errors is None:
            errors = np.asarray(np.linalg.solve(*self._normal_equations()))
            plausible = np.abs(errors).max(initial=0.0) <= _MAX_PLAUSIBLE_ERROR
            self._errors = errors if plausible else np.zeros_like(errors)
        return self._errors

    def _normal_equations(self) -> tuple[Array, Array]:
        """Return the matrix and right-hand side of the estimate, without a constant offset."""
        n = max(self._poses, 1)
        squares = self._squares - self._sum_J.T @ self._sum_J / n
        products = self._products - self._sum_J.T @ self._sum_y / n
        return self._information + squares, self._vector + products
