"""A plan as messages: schedule, predicted path, markers."""

from __future__ import annotations

from nav_msgs.msg import Path
from rclpy.node import Node
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.nodes.common.markers import goal_markers
from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.nodes.planner.trajectory_message import path_message, serialised_trajectory
from spacerobot_ros.planning import GaitSchedule


class PlanTopics:
    """Publishers of what a planner is about to fly."""

    def __init__(self, node: Node, world_frame: str) -> None:
        self._world_frame = world_frame
        self._schedule = node.create_publisher(JointTrajectory, "gait_schedule", LATCHED)
        self._path = node.create_publisher(Path, "planned_path", LATCHED)
        self._markers = node.create_publisher(MarkerArray, "markers", STREAM)

    def publish(self, robot: RobotDescription, schedule: GaitSchedule, stamp: int) -> None:
        """Publish a schedule that begins at a stamp (ns), its path and its goal."""
        frame = self._world_frame
        self._schedule.publish(serialised_trajectory(schedule, stamp, robot.base_link))
        self._path.publish(path_message(schedule.path, stamp, frame))
        shapes = robot.links[0].shapes
        self._markers.publish(goal_markers(schedule.goal, schedule.path, shapes, frame))
