"""The planner node, which converts goal poses to joint velocities. The node itself only converts
messages.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from threading import Thread
from typing import Any, ClassVar

import numpy as np
from geometry_msgs.msg import TwistStamped
from nav_msgs.msg import Path
from rclpy.action import ActionClient
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.commanding.planner import PlannerCommander, TrajectoryOutput
from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.messages.builders import goal_markers, path_message, trajectory_message
from spacerobot_ros.messages.readers import joint_template
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.common.commander import CommanderNode
from spacerobot_ros.nodes.common.messages import interface_class, path_poses, shape_of
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, described_robot
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.planning.core.cancellation import MAX_THREAD_END_TIME
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Goal
from spacerobot_ros.planning.core.schedule import BasePath, GaitSchedule
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus, ScheduleStart
from spacerobot_ros.planning.execution.tracker import Setpoint
from spacerobot_ros.times import stamp_bytes
from spacerobot_ros.topics import link_topic


class PlannerNode(CommanderNode):
    """Converts goal poses to gaits and publishes the gait velocities, one command for every state.

    A goal is planned from the next measured state. When the schedule has ended, the measured pose
    is compared with the goal. If it is not within tolerance, the remaining motion is replanned, at
    most ``max_corrections`` times. The later segments of a gait that is planned segment by
    segment (*partial* schedules) do not count as corrections. A new goal replaces the current one.
    If a joint does not follow, the remaining motion is planned with the other joints.

    A :class:`PlannerCommander` and its
    :class:`~spacerobot_ros.planning.execution.executive.Executive` make these decisions.
    """

    Config: ClassVar = PlannerConfig
    default_name: ClassVar = "planner"
    config: PlannerConfig
    commander: PlannerCommander
    _trajectory_clients: Mapping[str, ActionClient] = {}
    """FollowJointTrajectory clients by action, for ``output: trajectory``. They exist as long as
    the node: after a cleanup, an executor might still hold a response for one of them."""
    _announcement: Thread | None = None
    """Publishes the latest schedule."""
    _last_pursued: Status | None = None
    """The last status that is not final, which is published again if another goal is dropped."""

    # -- life cycle ---------------------------------------------------------------------------

    def make_commander(self) -> PlannerCommander:
        """Return the ROS-independent planner used by this node."""
        return PlannerCommander(self.config, self, long_work=self.long_work)

    def configure(self) -> None:
        """Create the topics; if no robot is configured, the planner waits for robot_description."""
        self.goal_shape = None
        self._commands: Publisher | None = None
        if self.config.output != "trajectory":
            topic = "joint_commands" if self.config.output == "commands" else "joint_reference"
            self._commands = self.create_publisher(JointState, topic, STREAM)
        self._schedule_topic = self.create_publisher(JointTrajectory, "gait_schedule", LATCHED)
        self._path_topic = self.create_publisher(Path, "planned_path", LATCHED)
        self._markers_topic = self.create_publisher(MarkerArray, "markers", STREAM)
        self.listen("planner/status")
        if self.config.output == "trajectory":
            self.commander.trajectories = self._connect(self.config.trajectory_action)
        self.subscribe_to_goals("goal_pose")
        for name in self.config.goal_links:
            self.subscribe_to_goals(link_topic(name, "goal_pose"), name)
            for kind, topic, take in (
                (TwistStamped, link_topic(name, "twist"), self._on_twist),
                (Path, link_topic(name, "path"), self._on_path),
            ):
                self.create_subscription(kind, topic, partial(take, name), STREAM)
        self.create_subscription(JointState, "goal_joint_states", self._on_goal_shape, STREAM)
        self.listen_to_obstacles()
        self.offer("~/statistics", lambda: self.commander.statistics.to_json())

    def _connect(self, action: str) -> TrajectoryOutput:
        kind = interface_class("control_msgs.action", "FollowJointTrajectory")
        if kind is None:
            raise ParameterError(
                "Parameter 'output' is 'trajectory', which requires the package control_msgs: "
                "install it (apt: ros-$ROS_DISTRO-control-msgs), or set another output."
            )
        clients = dict(self._trajectory_clients)
        if action not in clients:
            clients[action] = ActionClient(self, kind, action)
        self._trajectory_clients = clients
        connection = _Connection(kind, clients[action])
        name, on_end = self.resolve_topic_name(action), self.commander.end_schedule
        connection.output = TrajectoryOutput(connection, name, on_end)
        return connection.output

    def start_message(self) -> str:
        """Return a log message with the method, the robot and the goal topic."""
        config, topic = self.config, self.resolve_topic_name("goal_pose")
        return (
            f"Plans by '{config.method}' for {described_robot(self.commander.robot)}; goals on "
            f"'{topic}' in '{config.world_frame}'."
        )

    def deactivate(self) -> None:
        """Drop the current goal and stop sending commands; the goal file is kept."""
        super().deactivate()
        self._await_announcement()

    def _await_announcement(self) -> None:
        if self._announcement is not None:
            self._announcement.join(MAX_THREAD_END_TIME)

    def destroy_node(self) -> None:
        """Destroy the node, whatever its state, and its trajectory clients."""
        self._await_announcement()
        for client in self._trajectory_clients.values():
            client.destroy()
        self._trajectory_clients = {}
        super().destroy_node()

    def use(self, robot: SpaceRobot) -> None:
        """Set the robot for planning."""
        self.goal_shape = None
        super().use(robot)
        self._message = joint_template(robot.joint_names)
        self._setpoint: Setpoint | None = None
        """The setpoint whose arrays provide the values of the message."""

    # -- inputs -------------------------------------------------------------------------------

    def _on_twist(self, link: str, message: TwistStamped) -> None:
        twist, frame = message.twist, message.header.frame_id
        linear, angular = (np.array([v.x, v.y, v.z]) for v in (twist.linear, twist.angular))
        self.commander.receive_twist(link, frame, linear, angular)

    def _on_path(self, link: str, message: Path) -> None:
        def read() -> Goal:
            what, frame = f"The path of the end-effector '{link}'", self.config.world_frame
            poses = path_poses(message, frame, what, self.pose_of)
            return self.goal_of_link(EndEffectorGoal.along(link, poses))

        self.receive(link, message, read)

    def _on_goal_shape(self, message: JointState) -> None:
        """Keep the joint positions in which later goals must end, for methods that support them."""
        robot = self.commander.robot
        if robot is None:
            return
        try:
            self.goal_shape = shape_of(message, robot.joint_names) if message.name else None
        except PlanningError as error:
            self.publish_status(PlannerStatus(PlannerState.REFUSED, str(error)))

    # -- outputs ------------------------------------------------------------------------------

    def send_command(self, stamp_ns: int) -> None:
        """Publish the setpoint for the state with this stamp."""
        if self._commands is not None:
            setpoint = self.commander.setpoint
            if setpoint is not self._setpoint and len(setpoint.position):
                self._setpoint = setpoint
                self._message.feed("position", setpoint.position)
                self._message.feed("velocity", setpoint.velocity)
            self._commands.publish(self._message.serialised(stamp_bytes(stamp_ns)))

    def publish_status(self, status: Status) -> None:
        """Publish a goal status, and log it unless it repeats that of the pursued goal."""
        repeats = status is self._last_pursued
        super().publish_status(status)
        if not repeats:
            self.log("warning" if status.state.level else "info", status.message)
        if not status.state.decided:
            self._last_pursued = status

    def publish_plan(
        self, path: BasePath, stamp_ns: int, schedule: GaitSchedule | None = None
    ) -> None:
        """Publish a schedule, its path and its goal, in a thread if planning runs in a thread."""
        assert schedule is not None
        if not self.commander.config.plan_in_background:
            self._publish_schedule(schedule, stamp_ns)
            return
        self._await_announcement()
        # Serialising a long schedule takes longer than a tick, and nothing waits for it.
        self._announcement = Thread(
            target=self._publish_schedule, args=(schedule, stamp_ns), daemon=True
        )
        self._announcement.start()

    def _publish_schedule(self, schedule: GaitSchedule, stamp_ns: int) -> None:
        assert self.commander.robot is not None
        robot, frame = self.commander.robot.description, self.config.world_frame
        self._schedule_topic.publish(trajectory_message(schedule, stamp_ns, robot.base_link))
        self._path_topic.publish(path_message(schedule.path, stamp_ns, frame))
        self._markers_topic.publish(goal_markers(schedule.goal, schedule.path, robot, frame))


class _Connection:
    output: TrajectoryOutput

    def __init__(self, kind: Any, client: Any) -> None:
        self._kind, self._client = kind, client
        self._handles: dict[int, Any] = {}
        """Accepted schedules without a result, by number."""
        self._cancelled: set[int] = set()
        """Schedules that are cancelled as soon as they are accepted."""

    def is_available(self) -> bool:
        return bool(self._client.server_is_ready())

    def send(self, number: int, start: ScheduleStart) -> None:
        schedule = deserialize_message(trajectory_message(start.schedule, 0, ""), JointTrajectory)
        # With positions alone, controllers interpolate linearly. This reproduces the schedule,
        # whose velocities are constant over a tick. It starts when it is received.
        for point in schedule.points:
            point.velocities = []
        goal = self._kind.Goal(trajectory=schedule)
        answer = self._client.send_goal_async(goal)
        answer.add_done_callback(lambda future: self._on_answer(number, future.result()))

    def cancel(self, number: int) -> None:
        handle = self._handles.get(number)
        if handle is None:
            self._cancelled.add(number)
        else:
            handle.cancel_goal_async()

    def _on_answer(self, number: int, handle: Any) -> None:
        if not handle.accepted:
            self._cancelled.discard(number)
            self.output.rejected(number)
            return
        self._handles[number] = handle
        if number in self._cancelled:
            self._cancelled.discard(number)
            handle.cancel_goal_async()
        self.output.accepted(number)
        handle.get_result_async().add_done_callback(
            lambda future: self._on_result(number, future.result())
        )

    def _on_result(self, number: int, response: Any) -> None:
        self._handles.pop(number, None)
        result = response.result
        self.output.ended(number, response.status, result.error_code, result.error_string)


main = partial(run_node, PlannerNode)
"""Run the planner until SIGINT or SIGTERM."""

if __name__ == "__main__":
    sys.exit(main())
