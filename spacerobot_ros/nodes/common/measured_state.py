"""What odom and joint_states say of a robot, as planners take it."""

from __future__ import annotations

from nav_msgs.msg import Odometry

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.common.cdr import TemplateReader
from spacerobot_ros.nodes.common.joint_command import JointReader
from spacerobot_ros.planning.execution.state_average import StateAverage


class MeasuredState(StateAverage):
    """A :class:`StateAverage` that is filled from serialised messages."""

    def __init__(self, robot: SpaceRobot, count: int, rest_tolerance: float) -> None:
        super().__init__(robot, count, rest_tolerance)
        self._odom = TemplateReader(
            Odometry, lambda _: {"pose.pose.position.x": 7, "twist.twist.linear.x": 6}
        )
        self._joints = JointReader(robot.joint_names, ["position", "velocity"], complete=True)

    def read(self, odom: bytes, joint_states: bytes) -> None:
        """Add the state of two messages of one stamp.

        Raises
        ------
        CommandError
            The joints are not those of the robot.
        """
        self._odom.accept(odom)
        self._joints.accept(joint_states)
        self.add(
            self._odom.floats("pose.pose.position.x"),
            self._odom.floats("twist.twist.linear.x"),
            self._joints.values["position"],
            self._joints.values["velocity"],
        )
