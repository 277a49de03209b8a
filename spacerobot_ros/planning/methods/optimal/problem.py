"""Optimal control problem: options, boundary conditions, constraints, and trajectories."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from spacerobot_ros.errors import ParameterError, PlanningError, counted
from spacerobot_ros.model import SpaceRobot, symbolic_rotations
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrices_from_quaternions
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.parameters import for_each_joint, nonnegative, parameter
from spacerobot_ros.planning.core.goal import RobotState
from spacerobot_ros.planning.core.schedule import HeldMotion
from spacerobot_ros.resources import suggestion


@dataclass(frozen=True)
class MotionOptions:
    """Options for methods that keep joint velocities and accelerations within limits."""

    max_velocity: tuple[float, ...] = for_each_joint(
        "speed limit of every joint, if below the URDF limit; []: the URDF limit", "m/s or rad/s"
    )
    max_acceleration: tuple[float, ...] = for_each_joint(
        "acceleration limit of every joint; []: determined by ramp_time", "m/s^2 or rad/s^2"
    )
    ramp_time: float = parameter(
        0.5,
        "time from rest to full speed, if max_acceleration is not given",
        "s",
        minimum=1e-6,
        maximum=1e9,
    )


@dataclass(frozen=True)
class OptimalOptions(MotionOptions):
    """The options of ``optimal``."""

    duration: float = nonnegative(
        0.0, "duration of a least-effort manoeuvre; 0: as fast as possible", "s", maximum=1e9
    )
    effort_limits: int = nonnegative(
        0,
        "joint effort limits: 0: enforced if a manoeuvre within them is found, with effort_reserve "
        "if a controller tracks the manoeuvre, 1: enforced, with effort_reserve, 2: ignored",
        maximum=2,
    )
    max_effort: tuple[float, ...] = for_each_joint(
        "effort limit of every joint, if below the URDF limit; []: the URDF limit",
        "N or N m",
        maximum=1e12,
    )
    effort_reserve: float = nonnegative(
        0.15, "fraction of the effort limits reserved for the controller's feedback", maximum=0.95
    )
    joint_margin: tuple[float, ...] = for_each_joint(
        "margin of every joint to its limits, except in corrections; []: none", "m or rad"
    )
    base_position: int = nonnegative(
        0,
        "goal position: 0: reached if sliders allow it or nothing else is requested, 1: reached, "
        "2: ignored",
        maximum=2,
    )
    base_attitude: int = nonnegative(1, "1: reached, 0: ignored", maximum=1)
    final_shape: int = nonnegative(
        0, "final joint positions if the goal has none: 0: any, 1: the current positions", maximum=1
    )
    max_base_rate: float = nonnegative(0.0, "largest base rate; 0: no limit", "rad/s", maximum=1e9)
    keep_axis: tuple[float, ...] = parameter(
        (), "base axis that stays away from keep_direction; []: none", minimum=-1e9, maximum=1e9
    )
    keep_direction: tuple[float, ...] = parameter(
        (), "world direction from which keep_axis stays away", minimum=-1e9, maximum=1e9
    )
    keep_angle: float = nonnegative(
        0.0, "smallest angle between keep_axis and keep_direction", "rad", maximum=math.pi
    )
    keep_out: tuple[float, ...] = parameter(
        (),
        "boxes of joint positions to avoid: lower, then upper corner",
        "m or rad",
        minimum=-1e9,
        maximum=1e9,
    )
    intervals: int = parameter(
        80, "number of steps in the optimal control problem", minimum=10, maximum=10000
    )
    starts: int = parameter(24, "largest number of guesses", minimum=1, maximum=10000)
    answers: int = parameter(
        16,
        "number of solutions to find, unless enough starts agree; several solutions are computed "
        "on a coarse grid, and the best one is refined",
        minimum=1,
        maximum=10000,
    )
    agreeing: int = nonnegative(
        4,
        "number of starts that must find the best solution to end the search; 0: not used",
        maximum=10000,
    )
    iterations: int = parameter(
        300, "largest number of solver steps for a guess", minimum=1, maximum=100000
    )
    time_budget: float = nonnegative(
        0.0,
        "wall time for the search, five times as long if nothing is found; 0: no limit. If the "
        "budget ends the search, the plan depends on the machine load",
        "s",
        maximum=1e9,
    )
    longest: float = parameter(3600.0, "longest permitted manoeuvre", "s", minimum=1.0, maximum=1e9)
    cache: int = nonnegative(1, "1: cache manoeuvres on disk", maximum=1)


_UNLIMITED_HALF_RANGE = np.pi
"""Half of the range that guesses use for an unlimited joint, rad or m."""

_SMOOTH_BODY_EXPONENT = 8

_UNBOUNDED_FROM = 1e6
"""Box bounds beyond this value, m or rad, are ignored for joints without limits."""

_CONSTRAINT_RESERVE = 0.02
"""Relative margin of a solution to its path constraints, which are imposed only at the steps."""


class UnusableCandidateError(PlanningError):
    """A solution or state is unusable; the message is a clause that says why."""


@dataclass(frozen=True)
class PossibleEnd:
    """An end of a guess: a ``shape`` (n,), and the ``base_rotation`` (4,) since the start."""

    shape: Array
    base_rotation: Array


@dataclass(frozen=True)
class BoundaryConditions:
    """Both ends of a motion, relative to its initial attitude.

    Attributes
    ----------
    start
        (n,) first shape, m or rad.
    goal_rotation
        (4,) quaternion of the goal attitude relative to the initial attitude.
    likely_final_shape
        (n,) last shape, as far as known before the search.
    final
        (n,) last shape; None: any. NaN for reaction wheels: any position.
    center
        (3,) system's centre of mass in the base frame at the end, m; None: anywhere.
    direction
        (3,) ``keep_direction`` of the path constraints, in the initial base frame.
    velocity
        (n,) initial joint velocities, m/s or rad/s; a scalar applies to all.
    final_velocity
        (n,) velocities that the joints keep after the end, rad/s or m/s.
    end_effectors
        (7 k,) goals of k links (:meth:`.EndEffectorRows.pack`).
    possible_ends
        Ends that the guesses use in turn; none: only the likely shape and the goal rotation.
    state
        State at the start.
    angular_momentum
        (3,) total angular momentum about the centre of mass, in the initial base frame, kg m^2/s.
    """

    start: Array
    goal_rotation: Array
    likely_final_shape: Array
    final: Array | None = None
    center: Array | None = None
    direction: Array = field(default_factory=lambda: np.zeros(3))
    velocity: Array | float = 0.0
    final_velocity: Array | float = 0.0
    end_effectors: Array = field(default_factory=lambda: np.zeros(0))
    possible_ends: tuple[PossibleEnd, ...] = ()
    state: RobotState | None = None
    angular_momentum: Array = field(default_factory=lambda: np.zeros(3))

    @property
    def drifts(self) -> bool:
        """Whether the angular momentum is nonzero."""
        return bool(self.angular_momentum.any())

    @property
    def is_timed(self) -> bool:
        """Whether the end depends on the duration: the robot drifts, or joints move at an end."""
        return self.drifts or bool(np.any(self.velocity) or np.any(self.final_velocity))

    def momenta_in_base(self, quaternions: Array) -> Array | None:
        """Return the angular momentum (..., 3) in B at rotations (..., 4); None: it is zero."""
        if not self.drifts:
            return None
        # R_0B' multiplied from the left.
        return np.asarray(self.angular_momentum @ matrices_from_quaternions(quaternions))


@dataclass(frozen=True)
class MotionLimits:
    """Joint bounds (n,): ``lower`` and ``upper`` in m or rad, ``velocity`` per second,
    ``acceleration`` per second squared; ``distances`` (N, M) are the planes that keep link pairs
    apart in N intervals (:meth:`.KeptDistances.within`).
    """

    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    distances: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def of(cls, robot: SpaceRobot, options: MotionOptions, method: str = "optimal") -> MotionLimits:
        """Return the robot's limits, narrowed by a method's options.

        Without ``max_acceleration``, wheels accelerate by their motor torque with the base at rest.

        Raises
        ------
        ParameterError
            A list does not have one number per joint, or a joint has no speed limit and no
            acceleration limit.
        """
        velocity = robot.velocity_limit
        for i in np.flatnonzero(velocity == 0)[:1]:
            raise ParameterError(
                f"Joint '{robot.joint_names[i]}' has a velocity limit of 0, but {method} requires "
                'that all joints can move: give it <limit velocity="..."/> in the URDF, or make it '
                "fixed."
            )
        fastest = per_joint(robot, "max_velocity", options.max_velocity, velocity, method)
        velocity = np.minimum(velocity, fastest)
        acceleration = velocity / options.ramp_time
        wheels = ReactionWheels.of(robot.description)
        acceleration[wheels.index] = wheels.torque / wheels.inertia
        given = options.max_acceleration
        acceleration = per_joint(robot, "max_acceleration", given, acceleration, method)
        for name, v, a in zip(robot.joint_names, velocity, acceleration, strict=True):
            if np.isinf(v) and not np.isfinite(a):
                raise ParameterError(
                    f"Joint '{name}' has no velocity limit, which {method} requires: give it "
                    f'<limit velocity="..." effort="..."/> in the URDF, or {method}.max_velocity.'
                )
            if not (v > 0 and np.isfinite(a) and a > 0):
                raise ParameterError(
                    f"Joint '{name}' is limited to {v:.4g} per second and {a:.4g} per second "
                    f"squared; {method} needs a positive speed and a finite acceleration: see "
                    f"{method}.max_acceleration."
                )
        return cls(robot.lower.copy(), robot.upper.copy(), velocity, acceleration)

    def within(self, margin: Array, *shapes: Array) -> MotionLimits:
        """Return limits narrowed by ``margin`` (n,) from the ends of the joint ranges.

        The given ``shapes`` (n,) always stay within the limits.
        """
        # Where two margins overlap, the joint stays in the middle of its range.
        kept = np.minimum(margin, (self.upper - self.lower) / 2)
        lower = np.min([self.lower + kept, *shapes], axis=0)
        upper = np.max([self.upper - kept, *shapes], axis=0)
        return replace(
            self, lower=np.maximum(lower, self.lower), upper=np.minimum(upper, self.upper)
        )

    def joint_ranges(self, q: Array) -> tuple[Array, Array]:
        """Return middles and half widths (n,) of joint ranges; unlimited ones lie around ``q``."""
        lower = np.maximum(self.lower, q - 2 * _UNLIMITED_HALF_RANGE)
        upper = np.minimum(self.upper, q + 2 * _UNLIMITED_HALF_RANGE)
        middle = np.where(np.isfinite(self.lower) & np.isfinite(self.upper), (lower + upper) / 2, q)
        return middle, np.minimum((upper - lower) / 2, _UNLIMITED_HALF_RANGE)

    def speeds(self, q: Array) -> Array:
        """Return finite speeds (n,): half the range around ``q`` (n,) per second if unlimited."""
        return np.where(np.isfinite(self.velocity), self.velocity, self.joint_ranges(q)[1])

    def excess(self, motion: HeldMotion) -> tuple[float, float]:
        """Return the factor by which held commands must be slowed down, and the largest overrun.

        The factor is at most 1 if velocities and accelerations are within their limits; the overrun
        is the largest distance of a joint beyond its limits, m or rad.
        """
        beyond = np.maximum(self.lower - motion.positions, motion.positions - self.upper)
        factor = self.slowdown(motion.velocities, motion.accelerations)
        return factor, float(beyond.max(initial=0.0))

    def slowdown(self, velocities: Array, accelerations: Array) -> float:
        """Return the factor by which a motion must be slowed down to satisfy the velocity and
        acceleration limits: at most 1 if it satisfies them; values are (..., n).
        """
        speed = (np.abs(velocities) / self.velocity).max(initial=0.0)
        change = (np.abs(accelerations) / self.acceleration).max(initial=0.0)
        return max(float(speed), math.sqrt(float(change)))


@dataclass(frozen=True)
class Trajectory:
    """N steps of ``step`` seconds with constant accelerations.

    ``shapes``, ``velocities`` (N + 1, n) at the knots; ``quaternions`` (N + 1, 4) since the start.
    """

    step: float
    shapes: Array
    velocities: Array
    quaternions: Array

    @property
    def duration(self) -> float:
        """s."""
        return self.step * (len(self.shapes) - 1)

    def at_ticks(self, ticks: int) -> Array:
        """Return the shapes (ticks + 1, n) at equal intervals from the start to the end."""
        steps = len(self.shapes) - 1
        place = np.linspace(0.0, steps, ticks + 1)
        k = np.minimum(place.astype(int), steps - 1)
        tau = (place - k)[:, np.newaxis]
        q, v0, v1 = self.shapes[k], self.velocities[k], self.velocities[k + 1]
        return np.asarray(q + self.step * (v0 * tau + (v1 - v0) * tau**2 / 2))

    def within_intervals(self, instants: int) -> tuple[Array, Array]:
        """Return shapes (N K, n), attitudes (N K, 4) at K instants a step, the last at its end."""
        X, tau = self.quaternions[:, np.newaxis], np.arange(1, instants + 1)[:, np.newaxis]
        attitudes = (1 - tau / instants) * X[:-1] + tau / instants * X[1:]
        attitudes /= np.linalg.norm(attitudes, axis=2, keepdims=True)
        return self.at_ticks(len(X[1:]) * instants)[1:], attitudes.reshape(-1, 4)

    def stretched(self, factor: float) -> Trajectory:
        """Return the trajectory along the same path in ``factor`` times its duration."""
        return replace(self, step=self.step * factor, velocities=self.velocities / factor)

    def at_full_speed(self, limits: MotionLimits, shortest: float) -> Trajectory:
        """Return the trajectory along the same path at full speed, in at least ``shortest`` s."""
        factor = limits.slowdown(self.velocities, np.diff(self.velocities, axis=0) / self.step)
        return self.stretched(max(factor, shortest / self.duration))


@dataclass(frozen=True)
class _SmoothBody:
    """A smooth body of shapes around a box, through its corners.

    ``box_center`` and ``box_half_sizes`` are those of the box, for the ``joints`` that it bounds.
    """

    joints: list[int]
    box_center: Array
    box_half_sizes: Array

    @classmethod
    def of(cls, robot: SpaceRobot, lower: Array, upper: Array) -> _SmoothBody:
        bounded = [
            i
            for i in range(robot.n)
            if lower[i] > max(robot.lower[i], -_UNBOUNDED_FROM)
            or upper[i] < min(robot.upper[i], _UNBOUNDED_FROM)
        ]
        if not bounded:
            raise ParameterError("A box in optimal.keep_out contains all shapes of the robot.")
        # No joint exceeds its limits, so a distant side may move to a finite distance.
        width = robot.upper - robot.lower
        lower = np.maximum(lower, robot.lower - width)[bounded]
        upper = np.minimum(upper, robot.upper + width)[bounded]
        return cls(bounded, (upper + lower) / 2, (upper - lower) / 2 * (1 + _CONSTRAINT_RESERVE))


@dataclass(frozen=True)
class PathConstraints:
    """Path constraints, each absent by default.

    Attributes
    ----------
    base_rate_limit
        Largest base rate, rad/s; infinite: no limit.
    axis_B, direction_W, cone_half_angle
        The direction ``axis_B`` (3,), fixed in the base, stays out of the cone with half angle
        ``cone_half_angle`` (rad) around ``direction_W`` (3,): an instrument that avoids the Sun.
    keep_out_boxes
        (K, 2, n) lower and upper corners of shape boxes that the joints must not enter.
    smooth_keep_out_bodies
        Smooth bodies that replace the boxes in the program.
    """

    base_rate_limit: float = math.inf
    axis_B: Array | None = None
    direction_W: Array | None = None
    cone_half_angle: float = 0.0
    keep_out_boxes: Array = field(default_factory=lambda: np.zeros((0, 2, 0)))
    smooth_keep_out_bodies: tuple[_SmoothBody, ...] = ()

    @classmethod
    def of(cls, robot: SpaceRobot, options: OptimalOptions) -> PathConstraints:
        """Return the constraints specified by the options.

        Raises
        ------
        ParameterError
            A list has the wrong length, a direction is zero, or a box is empty.
        """
        axis = _unit_direction("axis", options.keep_axis)
        direction = _unit_direction("direction", options.keep_direction)
        if len({axis is None, direction is None, options.keep_angle == 0}) > 1:
            raise ParameterError(
                "A direction to keep away from requires all of optimal.keep_axis, "
                "optimal.keep_direction and optimal.keep_angle."
            )
        joints, boxes = robot.n, options.keep_out
        if len(boxes) % (2 * joints or 1):
            raise ParameterError(
                f"optimal.keep_out has {len(boxes)} numbers; a shape box has {joints} lower and "
                f"{joints} upper bounds."
            )
        corners = np.reshape(np.asarray(boxes, dtype=float), (-1, 2, max(joints, 1)))
        if np.any(corners[:, 0] >= corners[:, 1]):
            raise ParameterError(
                "optimal.keep_out has a box whose lower bound is not below its upper bound."
            )
        bodies = tuple(_SmoothBody.of(robot, *box) for box in corners)
        rate = options.max_base_rate or math.inf
        return cls(rate, axis, direction, options.keep_angle, corners, bodies)

    def symbolic(self, q: ca.SX, quaternion: ca.SX, direction: ca.SX) -> ca.SX:
        """Return the inequality constraints (nonnegative if satisfied) at a shape and an attitude.

        ``direction`` (3,) is ``keep_direction`` in the reference frame of the quaternion.
        """
        rows = [ca.SX(0, 1)]
        for body in self.smooth_keep_out_bodies:
            x = (q[body.joints] - body.box_center) / body.box_half_sizes
            rows.append(ca.log(ca.sum1(x**_SMOOTH_BODY_EXPONENT) / len(body.joints) + 1e-3))
        if self.axis_B is not None:
            R_WB = symbolic_rotations.matrix_from_quaternion(quaternion)
            seen = ca.dot(R_WB @ ca.DM(self.axis_B), direction)
            rows.append(np.cos(min(self.cone_half_angle * (1 + _CONSTRAINT_RESERVE), np.pi)) - seen)
        return ca.vertcat(*rows)

    def check(self, positions: Array, quaternions: Array, period: float) -> None:
        """Check a path: shapes (N + 1, n) and quaternions (N + 1, 4) of R_WB at the ticks.

        Raises
        ------
        UnusableCandidateError
            The path violates a constraint.
        """
        for box in self.keep_out_boxes:
            inside = np.all((positions > box[0]) & (positions < box[1]), axis=1)
            if inside.any():
                raise UnusableCandidateError(
                    f"the shape enters a keep_out box at {np.argmax(inside) * period:.4g} s"
                )
        if self.axis_B is not None and self.direction_W is not None:
            seen = matrices_from_quaternions(quaternions) @ self.axis_B @ self.direction_W
            angle = np.arccos(np.clip(np.max(seen), -1.0, 1.0))
            if angle < self.cone_half_angle - 1e-9:
                raise UnusableCandidateError(
                    f"the axis comes within {angle:.4g} rad of keep_direction"
                )
        rate = _largest_base_rate(quaternions, period)
        if rate > self.base_rate_limit * (1 + 1e-6):
            raise UnusableCandidateError(f"the base rotates at {rate:.4g} rad/s")

    @property
    def imposed_base_rate(self) -> float:
        """Base rate bound at the steps of a solution, rad/s."""
        return self.base_rate_limit * (1 - _CONSTRAINT_RESERVE)

    def excess_rate(self, quaternions: Array, period: float) -> float:
        """Return the largest base rate at attitudes (N + 1, 4) over its bound."""
        return _largest_base_rate(quaternions, period) / self.base_rate_limit

    def slowed(self, guess: Trajectory) -> Trajectory:
        """Return a guess slowed to satisfy the base rate bound."""
        factor = _largest_base_rate(guess.quaternions, guess.step) / self.imposed_base_rate
        return guess if factor <= 1 else guess.stretched(factor)


def _unit_direction(name: str, values: Sequence[float]) -> Array | None:
    if not values:
        return None
    vector = np.asarray(values, dtype=float)
    length = float(np.linalg.norm(vector))
    if vector.shape != (3,) or length == 0:
        raise ParameterError(
            f"optimal.keep_{name} is {values}; it must be three numbers, not all zero."
        )
    return np.asarray(vector / length)


def _largest_base_rate(quaternions: Array, period: float) -> float:
    """Return the largest mean rate (rad/s) between attitudes (N + 1, 4) a ``period`` apart."""
    # |a - b| is twice the sine of a quarter of the angle.
    apart = np.linalg.norm(np.diff(quaternions, axis=0), axis=1)
    angles = 4 * np.arcsin(np.minimum(apart / 2, 1.0))
    return float(angles.max(initial=0.0)) / period


def per_joint(
    robot: SpaceRobot,
    option: str,
    values: Sequence[float] | Sequence[str],
    default: Array,
    method: str = "optimal",
) -> Array:
    """Return a list-valued method option as (n,) numbers.

    ``default`` (n,) are the values for joints that a list of ``NAME:VALUE`` omits, or for all.

    Raises
    ------
    ParameterError
        A list of numbers has the wrong length, or a name is not a joint name.
    """
    names = robot.joint_names
    if not values or any(isinstance(each, str) for each in values):
        given = default.copy()
        for name, _, number in (str(each).rpartition(":") for each in values):
            if name not in names:
                raise ParameterError(
                    f"{method}.{option} names '{name}', which is not a joint of robot "
                    f"'{robot.description.name}'; its joints are {', '.join(names)}."
                    f"{suggestion(name, names)}"
                )
            given[names.index(name)] = float(number)
        return given
    if len(values) != robot.n:
        raise ParameterError(
            f"{method}.{option} has {counted(len(values), 'number')}; robot "
            f"'{robot.description.name}' has {counted(robot.n, 'joint')} ({', '.join(names)})."
        )
    return np.asarray(values, dtype=float)
