"""A new gait that begins while another is flown, without a jump in velocity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.goal import RobotState
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.braking import BrakingFollower


def stitched(
    flown: BrakingFollower,
    stamp_ns: int,
    state: RobotState,
    robot: SpaceRobot,
    integration_step: float,
    plan: Callable[[RobotState], GaitSchedule],
) -> GaitSchedule:
    """Return one schedule: to rest along the gait that is flown, then what is planned from there.

    Parameters
    ----------
    flown
        What is flown, coming to rest.
    stamp_ns
        Now, ns.
    state
        Measured now.
    robot, integration_step
        Predict where the base will be at rest; the longest step in s.
    plan
        Returns a gait from a state at rest.

    Raises
    ------
    PlanningError
        Nothing can be planned from where the robot will rest.
    """
    tick_period = flown.schedule.control_period
    shapes = flown.shapes(stamp_ns)
    shapes[0] = state.q
    prediction = BasePrediction(robot, tick_period, integration_step)
    attitudes = prediction.attitudes(shapes, state.quaternion, state.angular_momentum)
    time: Array = tick_period * np.arange(len(shapes), dtype=float)
    positions = prediction.positions(state, time, shapes, attitudes)
    gait = plan(
        replace(state, position=positions[-1], quaternion=attitudes[-1], q=shapes[-1].copy())
    )
    path = BasePath(
        np.append(time[:-1], time[-1] + gait.path.time),
        np.vstack([positions[:-1], gait.path.position]),
        np.vstack([attitudes[:-1], gait.path.quaternion]),
    )
    return replace(gait, positions=np.vstack([shapes[:-1], gait.positions]), path=path)
