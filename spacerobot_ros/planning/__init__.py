"""Planning: from a goal to a gait, by one of several methods."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.goal import Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.core.method import GaitMethod, InitialMotion, PlanRequest
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.resources import lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.planning.api import plan
    from spacerobot_ros.planning.methods.registry import METHODS, build_method, method_options

__all__ = [
    "METHODS",
    "NEVER",
    "BasePath",
    "Cancellation",
    "GaitMethod",
    "GaitSchedule",
    "Goal",
    "InitialMotion",
    "PlanRequest",
    "PlanningCancelled",
    "PoseError",
    "RobotState",
    "Tolerance",
    "build_method",
    "method_options",
    "plan",
]

# The methods take as long to import as everything else that a plant needs.
__getattr__ = lazy_names(
    __name__,
    {
        "planning.api": ["plan"],
        "planning.methods.registry": ["METHODS", "build_method", "method_options"],
    },
)
