"""ROS 2 nodes that wrap the modules of the stack, with their parameters, topics and services."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from spacerobot_ros.lazy import lazy_names

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

_CLASSES_BY_NODE = {
    "plant": "PlantNode",
    "planner": "PlannerNode",
    "coordinated_control": "CoordinatedControlNode",
    "recorder": "RecorderNode",
    "viewer": "ViewerNode",
}

# Without the modules of the other nodes, a node starts in half the time.
_class_named = lazy_names(
    __name__,
    {
        "CoordinatedControlNode": "spacerobot_ros.nodes.controller",
        "FlightNode": "spacerobot_ros.nodes.common.node",
        "PlannerNode": "spacerobot_ros.nodes.planner",
        "PlantNode": "spacerobot_ros.nodes.plant.node",
        "RecorderNode": "spacerobot_ros.nodes.recorder",
        "ReplayNode": "spacerobot_ros.nodes.replay",
        "ViewerNode": "spacerobot_ros.nodes.viewer.node",
    },
)


def __getattr__(name: str) -> Any:
    if name == "NODE_TYPES":
        return {node: _class_named(each) for node, each in _CLASSES_BY_NODE.items()}
    return _class_named(name)
