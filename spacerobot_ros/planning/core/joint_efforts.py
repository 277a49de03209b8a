"""Joint efforts under held commands, compared with their limits."""

from __future__ import annotations

import math
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.schedule import held_velocities

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
    control_period
        Command duration, s.
    """

    def __init__(self, robot: SpaceRobot, limit: Array, control_period: float) -> None:
        self._period = control_period
        self._joints = robot.description.movable_joints
        self.limit = limit
        self._function = robot.function("joint_efforts", compile=False)
        self._robot = robot

    def shares(
        self,
        positions: Array,
        velocity: Array | float = 0.0,
        L_B: Array | None = None,
        after: Array | float = 0.0,
    ) -> Array:
        """Return the efforts (N + 1, n) at the ticks under held commands, as fractions of their
        limits.

        ``positions`` (N + 1, n) are the shapes at the ticks; the velocities ``velocity`` and
        ``after`` (n,) are held before and after the motion. ``L_B`` (N + 1, 3) is the angular
        momentum about the centre of mass in the base frame, kg m^2/s; None: zero.
        """
        return self._effort_shares(positions, *self._rates(positions, velocity, after), L_B)

    def excess(
        self,
        positions: Array,
        velocity: Array | float = 0.0,
        L_B: Array | None = None,
        after: Array | float = 0.0,
    ) -> float:
        """Return the factor by which held commands must be slowed down; at most 1 if no slowdown is
        needed.

        Arguments are as in :meth:`shares`. For a drifting robot this is an estimate, as the
        efforts are not quadratic in the speed.
        """
        shares = self.shares(positions, velocity, L_B, after)
        return math.sqrt(float(np.abs(shares).max(initial=0.0)))

    def beyond_limits(
        self,
        positions: Array,
        velocity: Array | float = 0.0,
        L_B: Array | None = None,
        after: Array | float = 0.0,
    ) -> str:
        """Return a clause that names the joints exceeding their effort limits; empty if none do.

        Arguments are as in :meth:`shares`. If there are many ticks, only the ticks with the largest
        accelerations and some in between are checked.
        """
        rates, changes = self._rates(positions, velocity, after)
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

    def _rates(
        self, positions: Array, velocity: Array | float, after: Array | float
    ) -> tuple[Array, Array]:
        """Return the joint rates and their changes per second (N + 1, n) at the ticks."""
        held = held_velocities(positions, self._period, velocity, after)
        return (held[:-1] + held[1:]) / 2, np.diff(held, axis=0) / self._period

    def _effort_shares(
        self,
        q: npt.NDArray[np.float64],
        qdot: Array,
        qddot: Array,
        L_B: Array | None = None,
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
