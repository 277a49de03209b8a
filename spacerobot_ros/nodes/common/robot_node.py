"""Nodes that know their robot from their parameters, or from robot_description later."""

from __future__ import annotations

from abc import abstractmethod

from std_msgs.msg import String

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.robot_source import robot_from_text, robot_of
from spacerobot_ros.nodes.common.node import LATCHED, FlightNode


class RobotNode(FlightNode):
    """A node that can do nothing without a robot, and may be given it after its start."""

    _robot: SpaceRobot | None = None

    def find_robot(self) -> None:
        """Use the robot that the parameters name; without one wait for robot_description.

        Raises
        ------
        SpaceRobotError
            The robot is refused.
        """
        # What was built for the robot before belongs to topics that are gone.
        self._robot = None
        robot = robot_of(self.config)
        if robot is None:
            self.create_subscription(String, "robot_description", self._on_description, LATCHED)
        else:
            self._use(robot)

    @abstractmethod
    def _use(self, robot: SpaceRobot) -> None:
        """Build what depends on the robot."""

    @abstractmethod
    def _on_part(self) -> None:
        """Answer a state that may have waited for the robot."""

    def _on_description(self, message: String) -> None:
        if self._robot is None:
            try:
                self._use(robot_from_text(message.data, self.config))
            except SpaceRobotError as error:
                self.get_logger().error(f"robot_description: {error}")
                return
            self._on_part()
