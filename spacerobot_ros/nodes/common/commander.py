"""Base class of the nodes that command a plant: converts messages for a commander."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from spacerobot_ros.commanding.commander import Commander
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.commanding.plant_state import Stamped
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.errors import CommandError, SpaceRobotError
from spacerobot_ros.messages.builders import StateFrames
from spacerobot_ros.messages.diagnostics import (
    StatusRecord,
    encode_diagnostics,
    read_status,
    state_diagnostics,
)
from spacerobot_ros.messages.readers import MessageDecoder
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array
from spacerobot_ros.model.shared_parameters import robot_from_text, robot_of
from spacerobot_ros.nodes.common.fly_to import GoalActions
from spacerobot_ros.nodes.common.messages import (
    KnownFrames,
    LatchedSubscription,
    end_effector_goal,
    goal_description,
    goal_of,
)
from spacerobot_ros.nodes.common.node import BEST_EFFORT, LATCHED, LATCHED_QUEUE, STREAM, FlightNode
from spacerobot_ros.nodes.common.watchdog import Role, SilenceReport
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.planning.execution.status import LogLevel
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND, first_time_ns

_WAITING_STATE_CHECK_PERIOD = 0.1  # wall s
_STATUS_LOG_PERIOD = 5.0  # wall s, for ignored statuses

_LONGEST_DIAGNOSTICS_PERIOD = 1.0
"""Maximum wall time, s, between diagnostics in runs that need not be repeatable."""


class CommanderNode(FlightNode):
    """A node that wraps a :class:`Commander`: the node converts messages and owns topics,
    services and timers.

    If no robot is configured, the node uses the latest robot_description.
    """

    role = Role.COMMANDER
    depends_on = (Role.PLANT,)

    config: PlannerConfig | ControllerConfig
    commander: Commander
    """The node's commander, created whenever the node is configured."""

    goal_shape: Array | None = None
    """Joint positions (n,) required at the end of goals; None: any."""

    _decoder: MessageDecoder | None = None
    _goal_actions: GoalActions | None = None
    _descriptions: LatchedSubscription | None = None

    # -- life cycle ---------------------------------------------------------------------------

    def prepare(self) -> None:
        """Create an inactive commander and the action servers."""
        self.commander = self.make_commander()
        self._goal_actions = GoalActions(self)

    @abstractmethod
    def make_commander(self) -> Commander:
        """Return a commander that has the current parameters and this node as its host."""

    def listen(self, status_topic: str) -> None:
        """Subscribe to the topics common to all commanders, and use the configured robot.

        Raises
        ------
        SpaceRobotError
            The robot is invalid.
        """
        self.commander, config = self.make_commander(), self.config
        self._status_topic = self.create_publisher(DiagnosticStatus, status_topic, LATCHED)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        self._last_status: StatusRecord | None = None
        self._diagnostics_period_ns = (config.diagnostics_period or math.inf) * SECOND
        self._diagnosed_ns, self._diagnosed = 0, time.monotonic()
        self._known_frames = KnownFrames(self)
        self._statuses = LatchedSubscription(
            self, DiagnosticStatus, "plant/status", self._on_plant_status, LATCHED_QUEUE
        )
        self._best_effort = config.state_reliability == "best_effort"
        self._unheard = ""
        """Name of a state topic with a QoS-incompatible publisher."""
        self.inputs: dict[str, Subscription] = {}
        self._subscribe_states()
        self.create_timer(
            _WAITING_STATE_CHECK_PERIOD,
            self._process_waiting_messages,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        self.offer("~/abort", self._abort)
        self._description, self._decoder, self._descriptions = "", None, None
        robot = robot_of(config)
        if robot is None:
            self._descriptions = LatchedSubscription(
                self, String, "robot_description", self._on_description
            )
        else:
            self.use(robot)

    def subscribe_to_goals(self, topic: str, key: str = BASE_GOAL_KEY) -> None:
        """Subscribe to goal poses for the base or another link."""

        def take(message: PoseStamped) -> None:
            self.receive(key, message, lambda: self._read_goal(key, message))

        self.create_subscription(PoseStamped, topic, take, STREAM)

    def listen_to_obstacles(self) -> None:
        """Subscribe to the obstacles that plans avoid."""
        self.create_subscription(
            String,
            "obstacles",
            lambda message: self.commander.receive_obstacles(message.data),
            LATCHED,
        )

    def use(self, robot: SpaceRobot) -> None:
        """Set the robot, and the decoder that also merges its partial joint states."""
        joints = robot.description.moving_joints
        followers = [joint.name for joint in joints if joint.mimic is not None]
        self._decoder = MessageDecoder(robot.joint_names, followers)
        self.commander.use_robot(robot, self._decoder)

    def activate(self) -> None:
        """Start sending a command for each state."""
        self.commander.activate()

    def deactivate(self) -> None:
        """Drop all goals and stop sending commands."""
        self.commander.deactivate(self._failure)

    def parameters_changed(self) -> None:
        """Apply the new tolerances, times and gains."""
        self.commander.reconfigure(self.config)

    def interrupt(self) -> None:
        """Cancel the plan in progress."""
        self.commander.interrupt()

    def destroy_node(self) -> None:
        """Destroy the node with its action servers."""
        if self._goal_actions is not None:
            self._goal_actions.destroy()
        super().destroy_node()

    @property
    def simulated_time_s(self) -> float | None:
        """Simulated time of the last state, s; None before the first state."""
        now_ns = self.commander.stamps.now_ns
        return now_ns / SECOND if now_ns else None

    def on_silence(self, silence: SilenceReport) -> None:
        """Drop all goals if the plant is silent and the parameters require this."""
        super().on_silence(silence)
        if self.config.watchdog_action == "abort" and not silence.over:
            self.commander.give_up_goals(silence.message)

    # -- the host of the commander ------------------------------------------------------------

    def publish_status(self, status: Status) -> None:
        """Publish a goal status."""
        name = self.get_fully_qualified_name()
        self._last_status = StatusRecord.of(name, status, status.state.level)
        self._status_topic.publish(self._last_status.encoded())

    def log(self, level: LogLevel, message: str) -> None:
        """Write a line to the log."""
        logger = self.get_logger()
        # Each severity has its own call, as rclpy rejects call sites with varying severity.
        match level:
            case "debug":
                logger.debug(message)
            case "info":
                logger.info(message)
            case "warning":
                logger.warning(message)
            case "error":
                logger.error(message)

    def has_publisher(self, topic: str) -> bool:
        """Whether a publisher of this state or reference topic is connected."""
        return bool(self.inputs[topic].get_publisher_count())

    def waiting_states(self) -> tuple[list[Stamped], list[Stamped]]:
        """Return the messages queued in the subscriptions to odom and joint_states; statuses of the
        plant are processed before them.

        If no joint state is queued, odom messages stay queued.
        """
        self._process_waiting_statuses()
        joints = [*map(self._joined, self.waiting("joint_states"))]
        odoms = self.waiting("odom") if joints else []
        return (
            [Stamped(first_time_ns(raw), raw) for raw in odoms],
            [Stamped(first_time_ns(raw), raw) for raw in joints if raw is not None],
        )

    def waiting(self, topic: str) -> list[bytes]:
        """Return the messages queued in an input, serialised."""
        found: list[bytes] = []
        handle, kind = self.inputs[topic].handle, self.inputs[topic].msg_type
        with handle:
            while (taken := handle.take_message(kind, True)) is not None:
                found.append(taken[0])
        return found

    # -- inputs -------------------------------------------------------------------------------

    def _on_description(self, message: String) -> None:
        if message.data == self._description:
            return
        self._description = message.data
        self.commander.drop_robot("robot_description now describes another robot.")
        try:
            with self.long_work():
                self.use(robot_from_text(message.data, self.config))
        except SpaceRobotError as error:
            self.get_logger().error(f"robot_description: {error}")
            self.commander.refuse_robot(str(error))
            return
        self.commander.answer_latest()

    def receive(self, key: str, message: PoseStamped | Path, read: Callable[[], Goal]) -> None:
        """Pass the goal returned by ``read`` to the commander; log the goal if it is accepted."""
        stamp, part = message.header.stamp, "the base" if key == BASE_GOAL_KEY else f"'{key}'"
        accepted = self.commander.receive_goal(key, stamp.sec, stamp.nanosec, read)
        if accepted is not None:
            line = goal_description(part, accepted.goal_id, message, accepted.goal)
            self.get_logger().info(line)

    def _read_goal(self, key: str, message: PoseStamped) -> Goal:
        """Return the goal from a message for the base or an end-effector; an orientation of zeros
        accepts any attitude of an end-effector."""
        frame = self.config.world_frame
        if key == BASE_GOAL_KEY:
            return goal_of(message, frame, "The goal of the base", self.goal_shape, self.pose_of)
        link = "" if key == DEFAULT_END_EFFECTOR else f" '{key}'"
        what = f"The goal of the end-effector{link}"
        return self.goal_of_link(end_effector_goal(key, message, frame, what, self.pose_of))

    def goal_of_link(self, aim: EndEffectorGoal) -> Goal:
        """Return the goal of one end-effector; the default end-effector has no name."""
        if aim.link == DEFAULT_END_EFFECTOR:
            aim = replace(aim, link="")
        return Goal.of_end_effectors([aim], joint_positions=self.goal_shape)

    def pose_of(self, frame: str) -> Array | None:
        """Return the pose (7,) of a frame in the world; None if the pose is unknown."""
        own: dict[str, tuple[str, Array]] = {}
        robot, states = self.commander.robot, self.commander.states
        if robot is not None and states.odom and states.joints:
            state = StateFrames(robot.description)
            with suppress(CommandError):  # The state is of another robot, so no frame is known.
                state.accept(states.odom, states.joints)
                own = state.frames
        return self._known_frames.pose(frame, self.config.world_frame, own)

    def _abort(self) -> str:
        answer = self.commander.abort()
        if answer is None:
            raise CommandError("There is no goal to abort.")
        return answer

    def _on_plant_status(self, message: DiagnosticStatus) -> None:
        """React to a status of the plant, unless another node also publishes statuses."""
        if self._has_foreign_statuses():
            self._statuses.outdated = True
            self.get_logger().warning(
                "plant/status has more publishers than odom has. The topic is ignored until only "
                "the plant publishes it.",
                throttle_duration_sec=_STATUS_LOG_PERIOD,
            )
            return
        record = read_status(message)
        try:
            status = PlantStatus.from_values(record.values, record.message)
        except SpaceRobotError as error:
            self.get_logger().warning(
                f"plant/status: {error}", throttle_duration_sec=_STATUS_LOG_PERIOD
            )
            return
        self.commander.receive_plant_status(status, record.name or "plant")

    def _has_foreign_statuses(self) -> bool:
        """Whether more nodes publish plant/status than odom; every plant publishes both."""
        topics = map(self.resolve_topic_name, ("plant/status", "odom"))
        statuses, odoms = map(self.count_publishers, topics)
        return bool(statuses > odoms > 0)

    def _joined(self, raw: bytes) -> bytes | None:
        """Return joint states of all joints; None: some have not arrived yet."""
        if self._decoder is None:
            return raw
        try:
            whole = self._decoder.joined(raw)
        except CommandError:
            return raw  # The commander rejects it.
        if whole is None:
            self.commander.inputs.refusal = self._decoder.incomplete
        return whole

    def _on_joints(self, raw: bytes) -> None:
        commander, whole = self.commander, self._joined(raw)
        if whole is None:
            return
        commander.receive_joints(first_time_ns(whole), whole)
        now_ns = commander.stamps.now_ns
        if not 0 <= now_ns - self._diagnosed_ns < self._diagnostics_period_ns:
            self._publish_diagnostics()

    def _subscribe_states(self) -> None:
        """Subscribe to the state; with automatic reliability, detect publishers of another QoS."""
        auto = self.config.state_reliability == "auto" and not self._best_effort
        for kind, topic, callback in (
            (Odometry, "odom", lambda raw: self.commander.receive_odom(first_time_ns(raw), raw)),
            (JointState, "joint_states", self._on_joints),
        ):

            def on_incompatible(_: Any, topic: str = topic) -> None:
                self._unheard = topic

            self.inputs[topic] = self.create_subscription(
                kind,
                topic,
                callback,
                BEST_EFFORT if self._best_effort else STREAM,
                raw=True,
                event_callbacks=(
                    SubscriptionEventCallbacks(incompatible_qos=on_incompatible) if auto else None
                ),
            )

    def _process_waiting_statuses(self) -> None:
        handle = self._statuses.subscription.handle
        # A busy executor may lose a callback.
        with handle:
            while (taken := handle.take_message(DiagnosticStatus, False)) is not None:
                self._on_plant_status(taken[0])

    def _process_waiting_messages(self) -> None:
        """Process waiting statuses, and a deferred state once its time is accepted."""
        commander = self.commander
        self._process_waiting_statuses()
        if self._statuses.outdated and not self._has_foreign_statuses():
            self._statuses.renew()
        if self._descriptions is not None:
            self._descriptions.renew()
        if self._unheard:
            self.get_logger().info(
                f"A publisher of '{self._unheard}' uses best effort; the subscription is changed "
                f"to match."
            )
            self._unheard, self._best_effort = "", True
            for topic in ("odom", "joint_states"):
                self.destroy_subscription(self.inputs[topic])
            self._subscribe_states()
        ignored = commander.take_accepted_jump()
        if ignored or (
            self.config.diagnostics_period
            and self.is_active
            and time.monotonic() - self._diagnosed >= _LONGEST_DIAGNOSTICS_PERIOD
        ):
            self._publish_diagnostics(ignored)

    def _publish_diagnostics(self, warning: str = "") -> None:
        robot, stamps = self.commander.robot, self.commander.stamps
        ignored: dict[str, object] = {"ignored": stamps.ignored}
        if self._decoder is not None:
            ignored |= {f"ignored: {what}": count for what, count in self._decoder.ignored.items()}
        records = state_diagnostics(
            self.get_fully_qualified_name(),
            robot.description.name if robot is not None else "",
            ignored,
            self._last_status,
            warning=warning,
            missing=self.commander.missing,
        )
        self._diagnosed_ns, self._diagnosed = stamps.now_ns, time.monotonic()
        self._diagnostics.publish(encode_diagnostics(records, stamps.now_ns))
