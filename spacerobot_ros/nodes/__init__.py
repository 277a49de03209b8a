"""ROS 2 nodes that wrap the modules of the stack, with their parameters, topics and services."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from spacerobot_ros.resources import lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.nodes.common.node import FlightNode
    from spacerobot_ros.nodes.controller import CoordinatedControlNode
    from spacerobot_ros.nodes.planner import PlannerNode
    from spacerobot_ros.nodes.plant.node import PlantNode
    from spacerobot_ros.nodes.recorder import RecorderNode
    from spacerobot_ros.nodes.replay import ReplayNode
    from spacerobot_ros.nodes.viewer.node import ViewerNode

    NODE_TYPES: dict[str, type[FlightNode]]
    """The nodes of a stack by their names in parameter files."""

__all__ = [
    "NODE_TYPES",
    "CoordinatedControlNode",
    "FlightNode",
    "PlannerNode",
    "PlantNode",
    "RecorderNode",
    "ReplayNode",
    "ViewerNode",
]

# Without the modules of the other nodes, a node starts in half the time.
_class_named = lazy_names(
    __name__,
    {
        "nodes.common.node": ["FlightNode"],
        "nodes.controller": ["CoordinatedControlNode"],
        "nodes.planner": ["PlannerNode"],
        "nodes.plant.node": ["PlantNode"],
        "nodes.recorder": ["RecorderNode"],
        "nodes.replay": ["ReplayNode"],
        "nodes.viewer.node": ["ViewerNode"],
    },
)


def __getattr__(name: str) -> Any:
    if name == "NODE_TYPES":
        return {
            "plant": _class_named("PlantNode"),
            "planner": _class_named("PlannerNode"),
            "coordinated_control": _class_named("CoordinatedControlNode"),
            "recorder": _class_named("RecorderNode"),
            "viewer": _class_named("ViewerNode"),
        }
    return _class_named(name)
