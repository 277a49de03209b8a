"""The nodes: thin ROS 2 wrappers, parameters in, topics out."""

from spacerobot_ros.nodes.coordinated_control import CoordinatedControlNode
from spacerobot_ros.nodes.flight_node import FlightNode
from spacerobot_ros.nodes.planner import PlannerNode
from spacerobot_ros.nodes.plant import PlantNode
from spacerobot_ros.nodes.recorder import RecorderNode
from spacerobot_ros.nodes.replay import ReplayNode

NODE_TYPES: dict[str, type[FlightNode]] = {
    "plant": PlantNode,
    "planner": PlannerNode,
    "coordinated_control": CoordinatedControlNode,
    "recorder": RecorderNode,
}
"""The nodes of a stack by their names in parameter files."""

__all__ = [
    "NODE_TYPES",
    "CoordinatedControlNode",
    "FlightNode",
    "PlannerNode",
    "PlantNode",
    "RecorderNode",
    "ReplayNode",
]
