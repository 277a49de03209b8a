"""Goals as they come in messages: checked, and refused with a sentence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal


def goal_of(
    message: PoseStamped, frame: str, what: str = "The goal pose", shape: Array | None = None
) -> Goal:
    """Return the goal of a pose message, which is taken in ``frame``; ``shape`` goes with it.

    Raises
    ------
    PlanningError
        It is in another frame, or no pose; ``what`` names it.
    """
    given = message.header.frame_id
    if given not in ("", frame):
        raise PlanningError(f"{what} is in frame '{given}'; goals are taken in '{frame}'.")
    p, o = message.pose.position, message.pose.orientation
    return Goal.checked([p.x, p.y, p.z], [o.x, o.y, o.z, o.w], shape)


def shape_of(message: JointState, joint_names: Sequence[str]) -> Array:
    """Return the positions (n,) of a message in the order of the robot's joints.

    Raises
    ------
    PlanningError
        A joint is missing, or a position is not finite.
    """
    values = dict(zip(message.name, message.position, strict=False))
    missing = set(joint_names) - set(values)
    if missing:
        raise PlanningError(f"The goal shape is refused: joint '{min(missing)}' is missing.")
    if not np.all(np.isfinite(list(values.values()))):
        raise PlanningError("The goal shape is refused: a position is not finite.")
    return np.array([values[name] for name in joint_names])
