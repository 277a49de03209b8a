"""The coordinated-control node: converts goal poses and references to thrust and efforts."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from spacerobot_ros.commanding.controller import (
    BASE_REFERENCE,
    JOINT_REFERENCE,
    TARGET_ODOMETRY,
    ControllerCommander,
)
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.commanding.plant_state import Stamped
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.goals import END_EFFECTOR
from spacerobot_ros.control.servicing import Task
from spacerobot_ros.control.status import ControllerState
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.messages.builders import path_message
from spacerobot_ros.messages.definitions import encode
from spacerobot_ros.messages.readers import WRENCH, MessageTemplate, joint_template
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.nodes.common.commander import CommanderNode
from spacerobot_ros.nodes.common.messages import path_poses
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, described_robot
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.nodes.common.watchdog import HEARTBEAT_QOS, HeartbeatState, Role
from spacerobot_ros.nodes.common.watchdog import TOPIC as HEARTBEAT
from spacerobot_ros.planning.core.goal import Goal
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.times import first_time_ns, stamp_bytes
from spacerobot_ros.topics import link_topic


class CoordinatedControlNode(CommanderNode):
    """Closed-loop control of spacecraft and arm (paper 4): one command for every measured state.

    ``goal_pose`` is the base goal, ``end_effector/goal_pose`` the end-effector goal (also
    ``NAME/goal_pose`` for the link NAME of ``end_effector_frame``), and ``goal_path`` a base goal
    with waypoints.
    If a planner publishes ``joint_reference`` (or ``base_reference``), the node tracks it. Until
    a goal arrives, the robot holds the pose of its first state. The node converts messages; a
    :class:`ControllerCommander` and its :class:`~spacerobot_ros.control.executive.ControlExecutive`
    evaluate the goals.
    """

    Config: ClassVar = ControllerConfig
    default_name: ClassVar = "coordinated_control"
    config: ControllerConfig
    commander: ControllerCommander

    # -- life cycle ---------------------------------------------------------------------------

    def make_commander(self) -> ControllerCommander:
        """Return the ROS-independent controller used by this node."""
        self._published: Any = None
        """State and goal in the last status."""
        self._busy: set[str] = set()
        """Nodes that plan or compile, according to their heartbeats."""
        return ControllerCommander(self.config, self, partner_is_busy=lambda: bool(self._busy))

    def configure(self) -> None:
        """Create the topics; if no robot is configured, the node waits for robot_description."""
        self._joint_commands = self.create_publisher(JointState, "joint_commands", STREAM)
        self._base_wrench = self.create_publisher(WrenchStamped, "base_wrench", STREAM)
        self.listen("controller/status")
        commander = self.commander
        self.offer("~/dump_momentum", commander.dump_momentum)
        self.offer("~/approach", lambda: commander.request(Task.APPROACH))
        self.offer("~/detumble", lambda: commander.request(Task.DETUMBLE))
        self.create_subscription(
            String, "target/robot_description", self._on_target_description, LATCHED
        )
        self.inputs[TARGET_ODOMETRY] = self.create_subscription(
            Odometry,
            TARGET_ODOMETRY,
            lambda raw: commander.receive_target(first_time_ns(raw), raw),
            STREAM,
            raw=True,
        )
        if self.config.plans:
            self.listen_to_obstacles()
            self._path_topic = self.create_publisher(Path, "planned_path", LATCHED)
        self.subscribe_to_goals("goal_pose")
        self.subscribe_to_goals("end_effector/goal_pose", END_EFFECTOR)
        if (link := self.config.end_effector_frame) not in ("", END_EFFECTOR):
            topic = link_topic(link, "goal_pose")
            self.create_subscription(PoseStamped, topic, self._on_goal_of_link, STREAM)
        self.create_subscription(Path, "goal_path", self._on_goal_path, STREAM)
        if self.config.watchdog_timeout:
            self.create_subscription(DiagnosticStatus, HEARTBEAT, self._on_heartbeat, HEARTBEAT_QOS)
        for kind, topic in ((JointState, JOINT_REFERENCE), (Odometry, BASE_REFERENCE)):

            def take(raw: bytes, topic: str = topic) -> None:
                self.commander.receive_reference(topic, first_time_ns(raw), raw)

            self.inputs[topic] = self.create_subscription(kind, topic, take, STREAM, raw=True)

    def waiting_states(self) -> tuple[list[Stamped], list[Stamped]]:
        """Return the messages queued in the subscriptions to odom and joint_states; queued target
        odometry is processed before them, which callbacks of a busy executor come too late for."""
        for raw in self.waiting(TARGET_ODOMETRY):
            self.commander.receive_target(first_time_ns(raw), raw)
        return super().waiting_states()

    def start_message(self) -> str:
        """Return a log message with the robot, the law and the goal topic."""
        config, topic = self.config, self.resolve_topic_name("goal_pose")
        return (
            f"Controls {described_robot(self.commander.robot)} with law '{config.law}'; goals on "
            f"'{topic}' in '{config.world_frame}'."
        )

    def use(self, robot: SpaceRobot) -> None:
        """Set the robot to control."""
        super().use(robot)
        commander = self.commander
        commander.rehearse()
        self._joint_message = joint_template(robot.joint_names)
        if robot.n:
            self._joint_message.feed("effort", commander.effort)
        header = {"frame_id": robot.base_link}
        self._wrench_message = MessageTemplate(WRENCH, encode(WRENCH, {"header": header}))
        self._wrench_message.feed("wrench.force.x", commander.wrench)

    def _on_goal_of_link(self, message: PoseStamped) -> None:
        # A planner whose reference is tracked takes the goals of named links.
        if not self.has_publisher(JOINT_REFERENCE):
            self.receive(END_EFFECTOR, message, lambda: self._read_goal(END_EFFECTOR, message))

    def _on_goal_path(self, message: Path) -> None:
        def read() -> Goal:
            frame = self.config.world_frame
            return Goal.through(path_poses(message, frame, "The path of the base", self.pose_of))

        self.receive(BASE_GOAL_KEY, message, read)

    def _on_heartbeat(self, message: DiagnosticStatus) -> None:
        if (
            message.hardware_id == Role.COMMANDER.value
            and message.name != self.get_fully_qualified_name()
        ):
            if message.message == HeartbeatState.BUSY.value:
                self._busy.add(message.name)
            else:
                self._busy.discard(message.name)

    def _on_target_description(self, message: String) -> None:
        try:
            self.commander.use_target(parse_robot(message.data))
            self.commander.rehearse()
        except SpaceRobotError as error:
            self.get_logger().error(f"target/robot_description: {error}")

    # -- outputs ------------------------------------------------------------------------------

    def send_command(self, stamp_ns: int) -> None:
        """Publish the wrench and the efforts for the state with this stamp."""
        stamp = stamp_bytes(stamp_ns)
        self._base_wrench.publish(self._wrench_message.serialised(stamp))
        self._joint_commands.publish(self._joint_message.serialised(stamp))

    def publish_status(self, status: Status) -> None:
        """Publish a goal status; log warnings, errors, reached goals and what the node awaits."""
        super().publish_status(status)
        awaited = status.message if status.state is ControllerState.WAITING else ""
        decision = status.state, status.goal_id, awaited
        lasts = self._published == decision
        if status.state is not ControllerState.REFUSED:  # The earlier goal is still pursued.
            self._published = decision
        # A single lost message is not logged.
        if status.state is ControllerState.ESTIMATING:
            if lasts:
                self.get_logger().warning(status.message, throttle_duration_sec=5.0)
        elif status.state.level and not lasts:
            self.get_logger().warning(status.message)
        elif (awaited or status.state is ControllerState.REACHED) and not lasts:
            self.get_logger().info(status.message)

    def publish_plan(
        self, path: BasePath, stamp_ns: int, schedule: GaitSchedule | None = None
    ) -> None:
        """Publish the path of a planned reference."""
        self._path_topic.publish(path_message(path, stamp_ns, self.config.world_frame))


main = partial(run_node, CoordinatedControlNode)
"""Run coordinated control until SIGINT or SIGTERM."""

if __name__ == "__main__":
    sys.exit(main())
