"""Base motion of a gait, predicted by the plant's integration steps."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import count_steps
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrices_from_quaternions,
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.planning.core.goal import RobotState
from spacerobot_ros.planning.core.schedule import BasePath

_MIN_PATH_POSES = 200
"""Smallest number of poses in a predicted base path; a path has at most twice as many."""

_LARGE_ERROR, _MAX_HALVINGS = 1e-7, 8
"""Integration error, rad, above which the extrapolated value is off by more than a nanoradian, and
the largest number of step halvings."""


def coasting_positions(
    robot: SpaceRobot, state: RobotState, time: Array, shapes: Array, quaternions: Array
) -> Array:
    """Return the base position (K, 3) in W, m: at -c(q) relative to the drifting centre of mass.

    Parameters
    ----------
    robot, state
        The model, and its state at time zero.
    time, shapes, quaternions
        Times (K,), s; shapes (K, n), m or rad; and quaternions (K, 4) of R_WB, (x, y, z, w).
    """
    start = matrix_from_quaternion(state.quaternion) @ robot.center_of_mass(state.q)
    drift = np.multiply.outer(time, state.linear_momentum / robot.total_mass)
    c = robot.function("center_of_mass", compile=False)(shapes.T).full().T
    R_WB = matrices_from_quaternions(quaternions)
    return np.asarray(state.position + start + drift - np.einsum("nab,nb->na", R_WB, c))


class BasePrediction:
    """Predicts the base attitude and position under held joint velocities.

    Parameters
    ----------
    robot
        The model.
    control_period
        Command duration, s.
    integration_step
        Longest Runge-Kutta step for the attitude, s; the plant's value gives the same results.

    Raises
    ------
    ParameterError
        A duration is not positive.
    """

    def __init__(self, robot: SpaceRobot, control_period: float, integration_step: float) -> None:
        self._robot = robot
        self._control_period = control_period
        substeps = count_steps(control_period, integration_step)
        self._step = robot.buffered(f"velocity_step:{substeps}")

    def true_end(self, positions: Array, attitudes: Array, L_W: Array) -> Array:
        """Return the attitude (4,) after motion at any speed through the shapes (N + 1, n).

        ``attitudes`` (N + 1, 4) are computed with the plant's integration steps. Their fourth-order
        error is estimated with halved steps (Richardson extrapolation); while the error is large,
        steps are halved again.
        """
        coarse, path, period = attitudes[-1], positions, self._control_period
        for _ in range(_MAX_HALVINGS):
            halves = np.empty((2 * len(path) - 1, path.shape[1]))
            halves[::2], halves[1::2] = path, (path[1:] + path[:-1]) / 2
            path, period = halves, period / 2
            fine = self.attitudes(path, attitudes[0], L_W, period)[-1]
            error = attitude_error(coarse, fine) / 15
            if np.linalg.norm(error) < _LARGE_ERROR:
                break
            coarse = fine
        return quaternion_multiply(fine, quaternion_from_rotvec(error))

    def attitudes(
        self, positions: Array, quaternion: Array, L_W: Array, period: float | None = None
    ) -> Array:
        """Return the attitudes (N + 1, 4) at shapes (N + 1, n), a ``period``, s, or tick apart."""
        period = period or self._control_period
        state, qdot, momentum, h = self._step.inputs
        result = self._step.outputs[0]
        momentum[:], h[:] = L_W, period
        n = self._robot.n
        attitudes = np.empty((len(positions), 4))
        attitudes[0] = quaternion
        state[n:] = quaternion
        rates = np.diff(positions, axis=0) / period
        for k, rate in enumerate(rates):
            state[:n] = positions[k]
            qdot[:] = rate
            self._step.evaluate()
            state[n:] = attitudes[k + 1] = result[n:]
        return attitudes

    def positions(self, state: RobotState, time: Array, shapes: Array, quaternions: Array) -> Array:
        """Return the base position (K, 3) in W; see :func:`coasting_positions`."""
        return coasting_positions(self._robot, state, time, shapes, quaternions)

    def poses(
        self, state: RobotState, positions: Array, attitudes: Array | None = None
    ) -> BasePoses:
        """Return the base poses at every tick for the shapes (N + 1, n), at zero linear momentum.

        ``attitudes`` (N + 1, 4) at the ticks may be given if already known.
        """
        if attitudes is None:
            attitudes = self.attitudes(positions, state.quaternion, state.angular_momentum)
        return BasePoses(self.positions(state, np.zeros(1), positions, attitudes), attitudes)

    def path(self, state: RobotState, positions: Array, attitudes: Array | None = None) -> BasePath:
        """Return the base path for the shapes ``positions`` (N + 1, n), at some of the ticks.

        ``attitudes`` (N + 1, 4) at the ticks may be given if already known.
        """
        if attitudes is None:
            attitudes = self.attitudes(positions, state.quaternion, state.angular_momentum)
        last = len(positions) - 1
        chosen = np.append(np.arange(0, last, max(1, last // _MIN_PATH_POSES)), last)
        time, quaternions = chosen * self._control_period, attitudes[chosen]
        positions_W = self.positions(state, time, positions[chosen], quaternions)
        return BasePath(time, positions_W, quaternions)
