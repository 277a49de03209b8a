"""Joint efforts during a motion, and their limits.

The efforts under held commands (:class:`.JointEfforts`) are those of servos that follow the
commands; if the plant is driven by efforts, they are the efforts that a controller would command
without feedback. At zero momentum, efforts are quadratic in the speed: a motion whose efforts are
f^2 times their limits satisfies the limits if it takes f times as long.
"""

from __future__ import annotations

import math

import casadi as ca
import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.joint_efforts import JointEfforts, given_effort_limits
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    OptimalOptions,
    Trajectory,
    per_joint,
)

_PLANNED_EFFORT_SHARE = 0.98
"""Fraction of the limits that a solution may use; the rest is reserved for path changes."""


class LimitedEfforts(JointEfforts):
    """Efforts of one robot, with limits that manoeuvres must satisfy."""

    @classmethod
    def of(cls, robot: SpaceRobot, options: OptimalOptions) -> LimitedEfforts | None:
        """Return the efforts that the options limit; None if there are none.

        Raises
        ------
        ParameterError
            A joint effort limit is not positive.
        """
        if options.effort_limits == 2:
            return None
        limit = robot.effort_limit.copy()
        if options.effort_limits == 0:
            given = given_effort_limits(robot)
            limit = np.full(robot.n, np.inf) if given is None else given
        most = per_joint(robot, "max_effort", options.max_effort, np.full(robot.n, np.inf))
        limit = np.minimum(limit, most)
        if options.effort_limits == 1:
            limit *= 1 - options.effort_reserve
        for name, value in zip(robot.joint_names, limit, strict=True):
            if not value > 0:
                raise ParameterError(
                    f"Joint '{name}' is limited to an effort of {value:g}, which cannot move it; "
                    "with optimal.effort_limits 2, efforts are not limited."
                )
        return cls(robot, limit) if np.any(np.isfinite(limit)) else None

    def slowed(self, trajectory: Trajectory, boundary: BoundaryConditions) -> Trajectory:
        """Return the trajectory, slowed along its path until its efforts satisfy the limits."""
        q, v = trajectory.shapes, trajectory.velocities
        a = np.diff(v, axis=0) / trajectory.step
        L_B = boundary.momenta_in_base(trajectory.quaternions)
        before, after = (None, None) if L_B is None else (L_B[:-1], L_B[1:])
        ends = np.vstack(
            [
                self._effort_shares(q[:-1], v[:-1], a, before),
                self._effort_shares(q[1:], v[1:], a, after),
            ]
        )
        peak = float(np.abs(ends).max()) / _PLANNED_EFFORT_SHARE
        return trajectory if peak <= 1 else trajectory.stretched(math.sqrt(peak))

    def inequality(self, *, drifting: bool = False) -> ca.Function:
        """Return the limits as an inequality of :meth:`.Stages.of`."""
        n = len(self.limit)
        q, qdot, qddot = (ca.SX.sym(name, n) for name in ("q", "qdot", "qddot"))
        arguments = [q, qdot, qddot, ca.SX.sym("L_B", 3)] if drifting else [q, qdot, qddot]
        limited = np.flatnonzero(np.isfinite(self.limit))
        efforts = self._drifting_function if drifting else self._function
        tau = efforts(*arguments)[limited.tolist()]
        share = tau / (_PLANNED_EFFORT_SHARE * self.limit[limited])
        return ca.Function("efforts", arguments, [ca.vertcat(1 - share, 1 + share)])
