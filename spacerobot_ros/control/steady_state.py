"""Steady-state errors of a controlled robot under a constant external wrench."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.control.state import ControlState
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion

_MAX_ROUNDING_SHARE = 1e-6
"""Largest fraction of a disturbance outside the outputs that is attributed to rounding."""


def steady_errors(
    law: ControlLaw, state: ControlState, link: str, wrench_W: npt.ArrayLike
) -> Array:
    """Return the steady-state output errors (m,) under a wrench on a link.

    At rest, the actuators balance the wrench: ``[f; n; tau] = -J_q^-T Q_d``, where
    ``Q_d = J_link' F`` is its generalised force (paper 4, eqs 18 and 21). With eq. (29) the errors
    are
    ``e = -Kp^-1 J_z^-T Q_d``, with eq. (27) ``e = -Kp^-1 J_z H+^-1 Q_d``. An integral gain makes
    its output's error zero.

    Parameters
    ----------
    law
        The law with its gains.
    state
        A state with the robot's attitude and shape at rest.
    link
        Name of the link.
    wrench_W
        (6,) force (N) over torque (N m) at the link frame origin, in W components.

    Returns
    -------
    numpy.ndarray
        (m,) errors ``z_des - z`` in the order of ``law.outputs.labels``, m and rad.

    Raises
    ------
    ParameterError
        The outputs do not resist the wrench.
    KeyError
        There is no such link.
    """
    robot, q = law.robot, state.q
    R_BW = matrix_from_quaternion(state.quaternion_WB).T
    force_W, torque_W = np.split(np.asarray(wrench_W, dtype=float), 2)
    Q_d = robot.jacobian(link, q).T @ np.concatenate([R_BW @ force_W, R_BW @ torque_W])
    balanced = Q_d.copy()
    balanced[3:] -= robot.jacobian(robot.base_link, q)[:3, 3:].T @ Q_d[:3]
    per_error = law.command_per_error(state)
    pull = -np.linalg.lstsq(per_error, balanced, rcond=None)[0]
    unheld = np.linalg.norm(per_error @ pull + balanced)
    if unheld > _MAX_ROUNDING_SHARE * np.linalg.norm(balanced):
        raise ParameterError(
            f"The wrench on link '{link}' causes a motion that the outputs of the law "
            f"'{law.name}' do not resist: there is no steady state. "
            f"The outputs are {', '.join(law.outputs.labels)}."
        )
    errors = law.errors_under(state, pull)
    return np.where(law.integral_gains > 0.0, 0.0, errors)
