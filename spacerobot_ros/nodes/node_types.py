"""The nodes of a stack by their names."""

from __future__ import annotations

from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.controller import CoordinatedControlNode
from spacerobot_ros.nodes.planner import PlannerNode
from spacerobot_ros.nodes.plant.node import PlantNode
from spacerobot_ros.nodes.recorder import RecorderNode
from spacerobot_ros.nodes.viewer.node import ViewerNode

NODE_TYPES: dict[str, type[FlightNode]] = {
    "plant": PlantNode,
    "planner": PlannerNode,
    "coordinated_control": CoordinatedControlNode,
    "recorder": RecorderNode,
    "viewer": ViewerNode,
}
"""The nodes of a stack by their names in parameter files."""
