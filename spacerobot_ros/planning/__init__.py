"""Goal to gait: one module a method, one common type."""

from spacerobot_ros.planning.api import plan
from spacerobot_ros.planning.core.goal import Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.methods.registry import METHODS, build_method

__all__ = [
    "METHODS",
    "BasePath",
    "GaitMethod",
    "GaitSchedule",
    "Goal",
    "PoseError",
    "RobotState",
    "Tolerance",
    "build_method",
    "plan",
]
