"""ROS 2 nodes around the modules of the stack, with their parameters, topics and services."""

from __future__ import annotations

from typing import TYPE_CHECKING

from spacerobot_ros.lazy import lazy_names

if TYPE_CHECKING:
    from spacerobot_ros.nodes.common.node import FlightNode
    from spacerobot_ros.nodes.controller import CoordinatedControlNode
    from spacerobot_ros.nodes.node_types import NODE_TYPES
    from spacerobot_ros.nodes.planner import PlannerNode
    from spacerobot_ros.nodes.plant.node import PlantNode
    from spacerobot_ros.nodes.recorder import RecorderNode
    from spacerobot_ros.nodes.replay import ReplayNode
    from spacerobot_ros.nodes.viewer.node import ViewerNode

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

# A node starts in half of the time without the modules of the others.
__getattr__ = lazy_names(
    __name__,
    {
        "NODE_TYPES": "spacerobot_ros.nodes.node_types",
        "CoordinatedControlNode": "spacerobot_ros.nodes.controller",
        "FlightNode": "spacerobot_ros.nodes.common.node",
        "PlannerNode": "spacerobot_ros.nodes.planner",
        "PlantNode": "spacerobot_ros.nodes.plant.node",
        "RecorderNode": "spacerobot_ros.nodes.recorder",
        "ReplayNode": "spacerobot_ros.nodes.replay",
        "ViewerNode": "spacerobot_ros.nodes.viewer.node",
    },
)
