"""Goal to gait: one module a method, one common type."""

from spacerobot_ros.planning.goal import Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.method import GaitMethod
from spacerobot_ros.planning.one_call import plan
from spacerobot_ros.planning.registry import METHODS, build_method
from spacerobot_ros.planning.schedule import BasePath, GaitSchedule

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
