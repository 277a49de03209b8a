"""The nodes: thin ROS 2 wrappers, parameters in, topics out."""

from spacerobot_ros.nodes.coordinated_control import CoordinatedControlNode
from spacerobot_ros.nodes.flight_node import FlightNode
from spacerobot_ros.nodes.planner import PlannerNode
from spacerobot_ros.nodes.plant import PlantNode
from spacerobot_ros.nodes.recorder import RecorderNode

__all__ = ["CoordinatedControlNode", "FlightNode", "PlannerNode", "PlantNode", "RecorderNode"]
