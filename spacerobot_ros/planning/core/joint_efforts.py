"""Joint efforts under held commands, compared with their limits."""

from __future__ import annotations

import math
from functools import cached_property

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.schedule import HeldMotion

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
