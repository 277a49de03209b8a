"""Planning result: the shape at every tick, the predicted base path, and the joint efforts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import get_args

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import PlanningError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.goal import POSE, Controlled, Goal, PoseError

Notes = dict[str, list[float] | float | str]
"""Named method results, for reports."""


@dataclass(frozen=True)
class BasePath:
    """Predicted base: ``time`` (K,) from the start, ``position`` (K, 3), ``quaternion`` (K, 4).

    ``mass_derivatives`` (K, 6, P) are those of the poses with respect to relative mass and inertia
    errors; None if these errors are not estimated.
    """

    time: Array
    position: Array
    quaternion: Array
    mass_derivatives: Array | None = None

    def at(self, times: Array) -> tuple[Array, Array]:
        """Return positions (N, 3) and quaternions (N, 4) at times (N,), s, interpolated."""
        signs = np.cumprod(
            np.sign((self.quaternion[1:] * self.quaternion[:-1]).sum(axis=1) + 1e-300)
        )
        quaternions = self.quaternion * np.append(1.0, signs)[:, np.newaxis]
        position, quaternion = (
            interpolated(times, self.time, each) for each in (self.position, quaternions)
        )
        return position, quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)


def interpolated(at: Array, known: Array, values: Array) -> Array:
    """Interpolate ``values`` (M, ...) at ascending ``known`` (M,) linearly to ``at`` (N,)."""
    columns = values.reshape(len(known), -1).T
    found = np.column_stack([np.interp(at, known, each) for each in columns])
    return found.reshape(len(at), *values.shape[1:])


@dataclass(frozen=True, repr=False)
class GaitSchedule:
    """A gait as held commands: shapes at the ticks, with constant joint velocities in between.

    Attributes
    ----------
    method
        Registry name of the method that produced the gait.
    joint_names
        Joint names, one per column of ``positions``.
    control_period
        s.
    positions
        (N + 1, n) shapes at ticks 0..N, m or rad.
    end_velocities
        (n,) joint velocities held after the end, m/s or rad/s, of reaction wheels; None: all rest.
    path
        Predicted base path at instants chosen by the method, including the first and the last.
    goal
        The goal for which the gait was planned.
    notes
        Named results of the method, for reports (with its paper's symbols).
    partial
        Whether the gait ends short of the goal, so that the next one begins from a measured pose.
    remaining
        Expected duration, s, of the schedules that follow a partial one until the goal is reached.
    controls
        Goal components controlled by the gait; only these are evaluated at its end.
    progress
        Method-specific state for the next schedule to the same goal; see ``PlanRequest.previous``.
    """

    method: str
    joint_names: tuple[str, ...]
    control_period: float
    positions: Array
    path: BasePath
    goal: Goal
    notes: Notes = field(default_factory=dict)
    partial: bool = False
    remaining: float = 0.0
    controls: frozenset[Controlled] = POSE
    progress: object = None
    end_velocities: Array | None = None

    def __post_init__(self) -> None:
        # Only known components are evaluated: with a misspelt one alone, any goal would be reached.
        if unknown := ", ".join(sorted(set(self.controls) - set(get_args(Controlled)))):
            known = ", ".join(get_args(Controlled))
            raise PlanningError(
                f"The method '{self.method}' controls '{unknown}', but goals have only {known}."
            )

    def __repr__(self) -> str:
        error = PoseError.between(self.path.position[-1], self.path.quaternion[-1], self.goal)
        return (
            f"<GaitSchedule by {self.method}: {self.duration:.6g} s in {self.ticks} ticks of "
            f"{self.control_period:g} s for {counted(len(self.joint_names), 'joint')}, ends "
            f"{error.distance:.3g} m and {error.angle:.3g} rad from the goal>"
        )

    @property
    def title(self) -> str:
        """Method and duration for messages, such as "an optimal gait of 12 s"."""
        article = "an" if self.method[:1] in tuple("aeiou") else "a"
        return f"{article} {self.method} gait of {self.duration:.6g} s"

    @property
    def ticks(self) -> int:
        """Number of held commands N."""
        return len(self.positions) - 1

    @property
    def duration(self) -> float:
        """Gait duration, s."""
        return self.ticks * self.control_period

    @property
    def expected_duration(self) -> float:
        """Expected time until the goal is reached, s, including later schedules for this goal."""
        return self.duration + self.remaining

    @cached_property
    def velocities(self) -> Array:
        """Held joint velocities (N, n), m/s or rad/s; they move the shape from tick to tick."""
        return np.diff(self.positions, axis=0) / self.control_period


@dataclass(frozen=True)
class HeldMotion:
    """Shapes at ticks, between which joint velocities are held.

    Attributes
    ----------
    positions
        (N + 1, n) shapes at the ticks, m or rad.
    period
        Time between ticks, s.
    before, after
        (n,) velocities held before the first tick and after the last, m/s or rad/s.
    L_B
        (N + 1, 3) angular momentum about the centre of mass in B, kg m^2/s; None: it is zero.
    """

    positions: Array
    period: float
    before: Array | float = 0.0
    after: Array | float = 0.0
    L_B: Array | None = None

    @cached_property
    def velocities(self) -> Array:
        """Joint velocities (N + 2, n) before, between and after the ticks."""
        ends = np.zeros((2, self.positions.shape[1]))
        ends[0], ends[1] = self.before, self.after
        between = np.diff(self.positions, axis=0) / self.period
        return np.vstack([ends[:1], between, ends[1:]])

    @property
    def rates(self) -> Array:
        """Joint rates (N + 1, n) at the ticks: the means of the velocities before and after."""
        return np.asarray((self.velocities[:-1] + self.velocities[1:]) / 2)

    @cached_property
    def accelerations(self) -> Array:
        """Changes in velocity at the ticks (N + 1, n), per second."""
        return np.asarray(np.diff(self.velocities, axis=0) / self.period)


_MIN_JOINT_MOTION = 1e-9  # m or rad


def straight_motion(
    robot: SpaceRobot,
    start: Array,
    ends: Sequence[tuple[Array, float]],
    control_period: float,
    longest: float,
    swings: int = 1,
) -> Array:
    """Return the shapes (N + 1, n) at the ticks of a path from ``start`` (n,) through ``ends``.

    Every leg is a straight line in shape space, from rest to rest (paper 3, section III): under
    ``u = (2 pi D / T^2) sin(2 pi t / T)``, eqs (12) to (18), a displacement D is traversed as
    ``D (t/T - sin(2 pi t/T) / (2 pi))``, whose peak speed is twice the mean. With k ``swings``, the
    joints also rest k - 1 times on the way: ``2 pi`` becomes ``2 pi k``. ``ends`` are shapes (n,),
    each with the duration, s, of the leg that leads to it. A leg takes a whole number of ticks:
    more if a joint is slow, none if no joint moves.

    Raises
    ------
    PlanningError
        Together, the legs take more than ``longest`` s.
    """
    starts = [start, *(end for end, _ in ends)]
    legs = [
        (before, end, _leg_duration(robot, end - before, wanted))
        for before, (end, wanted) in zip(starts, ends, strict=False)
    ]
    total = sum(duration for _, _, duration in legs)
    if total > longest:
        slowest = int(np.argmin(robot.velocity_limit))
        joint = robot.description.movable_joints[slowest]
        raise PlanningError(
            f"A motion of {counted(len(legs), 'straight leg')} would take {total:.4g} s, more than "
            f"longest = {longest:.6g} s; the slowest joint is '{joint.name}', whose velocity limit "
            f"is {robot.velocity_limit[slowest]:.3g} {joint.unit}/s."
        )
    pieces = [start[np.newaxis]]
    for before, end, duration in legs:
        tau = np.linspace(0.0, 1.0, 1 + math.ceil(duration / control_period - 1e-9))[1:]
        whole = 2 * math.pi * swings
        progress = tau - np.sin(whole * tau) / whole
        pieces.append(before + progress[:, np.newaxis] * (end - before))
        pieces[-1][-1:] = end
    return np.vstack(pieces)


def _leg_duration(robot: SpaceRobot, move: Array, wanted: float) -> float:
    """Return the duration of a leg, s: infinity if a joint with zero speed limit must move."""
    active = np.abs(move) > _MIN_JOINT_MOTION
    if not active.any():
        return 0.0
    with np.errstate(divide="ignore"):
        slowest = np.max(2 * np.abs(move[active]) / robot.velocity_limit[active])
    return max(wanted, float(slowest))


# -- joint efforts ---------------------------------------------------------------------------------

_MAX_EXCESS = 1e-6
"""Fraction of a limit by which an effort may exceed it through rounding errors."""

_MAX_CHECKED_TICKS = 4000
"""Number of ticks up to which all efforts are compared with the limits."""


class JointEfforts:
    """Efforts of a robot whose joints follow held commands, and their limits.

    Between two commands, the joints are assumed to move at the mean of the two velocities, with the
    acceleration that changes the first velocity into the second within a control period. The
    efforts follow from inverse dynamics (the model's :func:`.joint_efforts`), as in the plant under
    velocity actuation.

    Parameters
    ----------
    robot
        The model.
    limit
        (n,) largest effort of every joint in a motion, N or N m; infinite: no limit.
    """

    def __init__(self, robot: SpaceRobot, limit: Array) -> None:
        self._joints = robot.description.movable_joints
        self.limit = limit
        self._function = robot.function("joint_efforts", compile=False)
        self._robot = robot

    def shares(self, motion: HeldMotion) -> Array:
        """Return the efforts (N + 1, n) at the ticks, as fractions of their limits."""
        state = motion.positions, motion.rates, motion.accelerations
        return self._effort_shares(*state, motion.L_B)

    def excess(self, motion: HeldMotion) -> float:
        """Return the factor by which commands must be slowed down; at most 1 if they need not be.

        For a drifting robot this is an estimate, as the efforts are not quadratic in the speed.
        """
        return math.sqrt(float(np.abs(self.shares(motion)).max(initial=0.0)))

    def beyond_limits(self, motion: HeldMotion) -> str:
        """Return a clause that names the joints exceeding their effort limits; empty if none do.

        If there are many ticks, those with the largest accelerations and some others are checked.
        """
        positions, L_B = motion.positions, motion.L_B
        rates, changes = motion.rates, motion.accelerations
        if len(positions) > _MAX_CHECKED_TICKS:
            scale = np.maximum(np.abs(changes).max(axis=0), np.finfo(float).tiny)
            most = np.argsort(-np.abs(changes / scale).max(axis=1))[: _MAX_CHECKED_TICKS // 2]
            between = np.linspace(0, len(positions) - 1, _MAX_CHECKED_TICKS // 2).astype(int)
            chosen = np.union1d(most, between)
            positions, rates, changes = positions[chosen], rates[chosen], changes[chosen]
            L_B = None if L_B is None else L_B[chosen]
        peaks = np.abs(self._effort_shares(positions, rates, changes, L_B)).max(axis=0)
        clauses = []
        for joint, share, limit in zip(self._joints, peaks, self.limit, strict=True):
            if share > 1 + _MAX_EXCESS:
                unit = "N" if joint.unit == "m" else "N m"
                taken, allowed = f"{share * limit:.4g} {unit}", f"{limit:.4g} {unit}"
                clauses.append(
                    f"{joint.name} requires {taken}, {share:.3g} times its limit of {allowed}"
                )
        return ", ".join(clauses)

    def _effort_shares(
        self, q: npt.NDArray[np.float64], qdot: Array, qddot: Array, L_B: Array | None = None
    ) -> npt.NDArray[np.float64]:
        if L_B is None:
            tau = self._function(q.T, qdot.T, qddot.T).full().T
        else:
            tau = self._drifting_function(q.T, qdot.T, qddot.T, L_B.T).full().T
        return np.asarray(tau / self.limit)

    @cached_property
    def _drifting_function(self) -> ca.Function:
        """The efforts by shape, rates, accelerations, and angular momentum in the base frame."""
        n = self._robot.n
        q, qdot, qddot, L_B = (
            ca.SX.sym(name, k) for name, k in zip("qvaL", (n, n, n, 3), strict=True)
        )
        servo_efforts = self._robot.function("servo_efforts", compile=False)
        base = ca.DM([0.0, 0.0, 0.0, 1.0])
        tau = servo_efforts(base, q, qdot - qddot / 2, qdot + qddot / 2, L_B, 1.0)
        return ca.Function("drifting_efforts", [q, qdot, qddot, L_B], [tau])


def given_effort_limits(robot: SpaceRobot) -> Array | None:
    """Return the URDF effort limits (n,); None if the URDF has none.

    A limit of zero means that the limit is unknown, because no joint could move without effort.
    """
    limit = np.where(robot.effort_limit > 0, robot.effort_limit, np.inf)
    return limit if np.isfinite(limit).any() else None
