"""Reference profiles from current poses and joint positions to the goals.

In the paper, the reference is a step to the goal (:class:`StepReference`), which is simple, but
requires the largest actuator command at the start. :class:`QuinticReference` moves the reference to
the goal smoothly.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cached_property
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.outputs import OutputDistance
from spacerobot_ros.control.state import JointReference, PoseReference, Reference
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_quaternion,
    quaternion_multiply,
)

_QUINTIC_PEAK_RATE = 15 / 8
"""Largest ds/dt of a one-second quintic."""

_QUINTIC_PEAK_ACCELERATION = 10 / math.sqrt(3)
"""Largest d2s/dt2 of a one-second quintic."""


class ReferenceProfile(ABC):
    """A reference over time from ``start`` to ``goal``, at rest at both ends.

    Parameters
    ----------
    start
        Current poses and joint positions; velocities are ignored.
    goal
        Desired poses and joint positions; missing groups are not controlled.
    limits
        Limits of a motion by interpolation; other profiles ignore them.
    carries
        Whether the end-effector has no goal and moves with the base, so that the arm keeps its
        shape.
    """

    name: ClassVar[str]

    def __init__(
        self,
        start: Reference,
        goal: Reference,
        limits: MotionLimits | None = None,
        *,
        carries: bool = False,
    ) -> None:
        self.start, self.goal, self.carries = start, goal, carries
        self.duration = 0.0
        """Time after which the reference equals the goal, s."""

    @abstractmethod
    def at(self, time: float) -> Reference:
        """Return the reference at ``time`` s after the start."""

    def distances(self) -> OutputDistance:
        """Return the distances between the start and the goal."""
        start, goal, joints = self.start, self.goal, 0.0
        if start.joints is not None and goal.joints is not None:
            joints = float(np.abs(goal.joints.q - start.joints.q).max(initial=0.0))
        lines = [line for line in self.lines if line is not None]
        return OutputDistance(
            max((line.length for line in lines), default=0.0),
            max((line.angle for line in lines), default=0.0),
            joints,
        )

    @cached_property
    def lines(self) -> tuple[_PoseInterpolation | None, _PoseInterpolation | None]:
        """The base and end-effector paths; None for a group that is not controlled."""
        start, goal, base, hand = self.start, self.goal, None, None
        if start.base is not None and goal.base is not None:
            base = _PoseInterpolation(start.base, goal.base)
        if start.end_effector is not None and goal.end_effector is not None:
            carrier = start.base if self.carries else None
            hand = _PoseInterpolation(start.end_effector, goal.end_effector, carrier)
        return base, hand


class StepReference(ReferenceProfile):
    """Step to the goal, as in paper 4, section V; it has no limits."""

    name: ClassVar[str] = "step"

    def at(self, time: float) -> Reference:
        """Return the goal."""
        return self.goal


class QuinticReference(ReferenceProfile):
    """Positions along straight lines, attitudes along geodesics (one fixed axis), in W.

    An end-effector carried by the base rotates about the base origin, which moves along its line.
    All motions share one profile, ``s = 10 u^3 - 15 u^4 + 6 u^5`` with ``u = t / T``: rest to rest,
    without acceleration jumps. T is the shortest time for which all motions are within their
    limits: the slowest motion determines T, and all motions reach their goals together.
    """

    name: ClassVar[str] = "quintic"

    def __init__(
        self, start: Reference, goal: Reference, limits: MotionLimits, *, carries: bool = False
    ) -> None:
        super().__init__(start, goal, carries=carries)
        self._joints = np.zeros(0)
        if goal.joints is not None and start.joints is not None:
            self._joints = goal.joints.q - start.joints.q
        needs = [
            quintic_duration(float(abs(d)), limits.joint_speed, limits.joint_acceleration)
            for d in self._joints
        ]
        for line in self.lines:
            if line is not None:
                needs.append(quintic_duration(line.length, limits.speed, limits.acceleration))
                needs.append(
                    quintic_duration(line.angle, limits.angular_speed, limits.angular_acceleration)
                )
        self.duration = max(needs, default=0.0)

    def at(self, time: float) -> Reference:
        """Return the reference at ``time`` s after the start; for earlier times, the reference at
        the start."""
        time = max(time, 0.0)
        if time >= self.duration:
            return self.goal
        s, rate, acceleration = _quintic(time / self.duration, self.duration)
        joints = None
        if self.start.joints is not None and self.goal.joints is not None:
            d = self._joints
            joints = JointReference(self.start.joints.q + s * d, rate * d, acceleration * d)
        base, hand = (
            None if line is None else line.at(s, rate, acceleration) for line in self.lines
        )
        return Reference(base, hand, joints)


def _quintic(u: Any, T: Any) -> tuple[Any, Any, Any]:
    """Return ``s`` at ``u = t / T``, its rate (1/s) and acceleration (1/s^2)."""
    s = u**3 * (10 + u * (6 * u - 15))
    return s, 30 * u**2 * (1 - u) ** 2 / T, 60 * u * (1 - u) * (1 - 2 * u) / T**2


def profile_numbers(profile: ReferenceProfile, base: bool, end_effector: bool, n: int) -> Array:
    """Return a profile as the values required by :func:`profile_expression`.

    Parameters
    ----------
    profile
        A profile whose goal includes the controlled groups.
    base, end_effector
        Whether these poses are controlled.
    n
        Number of joints with references; 0 if joints are not controlled.
    """
    start, goal = profile.start, profile.goal
    parts: list[npt.ArrayLike] = [[profile.duration]]
    for wanted, line in zip((base, end_effector), profile.lines, strict=True):
        if wanted and line is not None:
            parts += line.numbers
    if n and start.joints is not None and goal.joints is not None:
        parts += [start.joints.q, goal.joints.q - start.joints.q, goal.joints.q]
    return np.concatenate(parts)


def profile_expression(
    numbers: ca.SX, time: ca.SX, base: bool, end_effector: bool, n: int
) -> ca.SX:
    """Return :meth:`ReferenceProfile.at` as an argument of a law's function.

    ``numbers`` come from :func:`profile_numbers`; ``time`` is counted from the start, s.
    """
    sizes = _profile_sizes(base, end_effector, n)
    duration, *rest = ca.vertsplit(numbers, np.cumsum([0, *sizes]).tolist())
    # The time of a restarted plant is before the start, even of a zero-duration profile.
    time = ca.fmax(time, 0)
    s, rate, acceleration = _quintic(time / duration, duration)
    moving, resting = [], []
    for k in range(base + end_effector):
        path, (angle, *end) = rest[10 * k : 10 * k + 7], rest[10 * k + 7 : 10 * k + 10]
        moving += _pose_along(path, angle, s, rate, acceleration, ca)
        resting += [*end, ca.SX.zeros(12)]
    if n:
        r, d, goal = rest[-3:]
        moving += [r + s * d, rate * d, acceleration * d]
        resting += [goal, ca.SX.zeros(2 * n)]
    return ca.if_else(time < duration, ca.vertcat(*moving), ca.vertcat(*resting))


def profile_size(base: bool, end_effector: bool, n: int) -> int:
    """Return the size of the :func:`profile_numbers` array."""
    return sum(_profile_sizes(base, end_effector, n))


def _profile_sizes(base: bool, end_effector: bool, n: int) -> list[int]:
    return [1, *([3, 3, 3, 3, 4, 4, 3, 1, 3, 4] * (base + end_effector)), *([n, n, n] if n else [])]


class HeldVelocityReference:
    """Joint references from commands whose velocities are held over a control period.

    At a command, the velocity jumps: the reference has the mean of the velocities before and after,
    and the acceleration that changes one into the other within one period.

    Parameters
    ----------
    control_period
        Time between commands, s.
    """

    def __init__(self, control_period: float) -> None:
        self._control_period = control_period
        self._before: Array | None = None

    def at_command(self, position: Array, velocity: Array) -> JointReference:
        """Return the reference at the instant of a command with positions and velocities (n,)."""
        held = velocity.copy()
        before = self._before if self._before is not None else held
        self._before = held
        return JointReference(
            position.copy(), (before + held) / 2, (held - before) / self._control_period
        )


PROFILES: dict[str, type[StepReference | QuinticReference]] = {
    StepReference.name: StepReference,
    QuinticReference.name: QuinticReference,
}
"""The profiles by name; their arguments are start, goal and limits."""

PLANNED_PROFILE = "planned"
"""Name of the profile that is planned (:mod:`.planned_reference`), whose imports take time."""


class _PoseInterpolation:
    """A straight line and a geodesic in W, from one pose to another, m and rad.

    With the pose of a ``carrier`` at the start, the line is that of the carrier's origin, about
    which the pose rotates: ``r(s) = r_C + s d + e cos(s phi) + c sin(s phi)``.
    """

    def __init__(
        self, start: PoseReference, goal: PoseReference, carrier: PoseReference | None = None
    ) -> None:
        turn_B = attitude_error(start.quaternion, goal.quaternion)
        # The rotation axis is fixed both in the body and in W.
        turn_W: Array = matrix_from_quaternion(start.quaternion) @ turn_B
        self.angle = float(np.linalg.norm(turn_B))
        axis = turn_W / self.angle if self.angle > 0 else np.zeros(3)
        r, d = start.position, goal.position - start.position
        e, c = np.zeros(3), np.zeros(3)
        if carrier is not None:
            arm = start.position - carrier.position
            e, c = arm - axis * (axis @ arm), np.cross(axis, arm)
            r = start.position - e
            d = goal.position - r - (math.cos(self.angle) * e + math.sin(self.angle) * c)
        self.length = float(np.linalg.norm(d))
        half_turn = quaternion_multiply(np.append(axis, 0.0), start.quaternion)
        self._path = r, d, e, c, start.quaternion, half_turn, turn_W
        self.numbers: list[npt.ArrayLike] = [
            *self._path,
            [self.angle],
            goal.position,
            goal.quaternion,
        ]
        """All parameters of the line, and its end pose."""

    def at(self, s: float, rate: float, acceleration: float) -> PoseReference:
        return PoseReference(*_pose_along(self._path, self.angle, s, rate, acceleration, math))


def _pose_along(
    path: Sequence[Any], angle: Any, s: Any, rate: Any, acceleration: Any, functions: Any
) -> list[Any]:
    """Return the parts of the :class:`.PoseReference` on a path at ``s``, and its rate and
    acceleration, as numbers or symbols; ``functions`` has the sine and cosine for them."""
    r, d, e, c, quaternion, half_turn, turn_W = path
    half, speed = s * angle / 2, rate * angle
    sine, cosine = functions.sin(s * angle), functions.cos(s * angle)
    arm, beside = cosine * e + sine * c, cosine * c - sine * e
    return [
        r + s * d + arm,
        # The quaternion of a rotation by phi is linear in sin(phi/2) and cos(phi/2).
        functions.sin(half) * half_turn + functions.cos(half) * quaternion,
        rate * d + speed * beside,
        rate * turn_W,
        acceleration * d + acceleration * angle * beside - speed**2 * arm,
        acceleration * turn_W,
    ]


def quintic_duration(distance: float, speed: float, acceleration: float) -> float:
    """Return the shortest duration (s) of a quintic over a distance, given its limits."""
    return max(
        _QUINTIC_PEAK_RATE * distance / speed,
        math.sqrt(_QUINTIC_PEAK_ACCELERATION * distance / acceleration),
    )
