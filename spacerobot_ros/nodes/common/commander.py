"""Base class of the nodes that command a plant: they listen to its state and its status."""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.errors import CommandError, SpaceRobotError
from spacerobot_ros.flight.plant_listener import Change, PlantListener, Stopped
from spacerobot_ros.flight.state_synchroniser import StateSynchroniser
from spacerobot_ros.messages.readers import JointReader
from spacerobot_ros.messages.statuses import read_status
from spacerobot_ros.messages.transforms import StateFrames, robot_frames
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.shared_parameters import robot_from_text, robot_of
from spacerobot_ros.nodes.common.messages import KnownFrames, diagnostic_name, diagnostic_status
from spacerobot_ros.nodes.common.node import BEST_EFFORT, LATCHED, STREAM, FlightNode
from spacerobot_ros.nodes.common.state_times import StateTimes
from spacerobot_ros.nodes.common.watchdog import Role, Silence
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND, first_time_ns, set_stamp

_LOOK_PERIOD = 0.1
"""Wall s between two looks at states that were set aside."""

_STANDSTILL = 0.005
"""Wall s without an answer after which only the last of the states that wait is answered."""

_REPORT_PERIOD = 1.0
"""Least wall s between two diagnostics about ignored states."""

_DIAGNOSED = 1.0
"""Longest wall s between two diagnostics, where a run need not be repeatable."""

_STATUSES = QoSProfile(
    depth=20, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
"""Every status counts, not only the last: deeper than what latecomers get."""


class CommanderNode(FlightNode):
    """A node that answers the states of a plant with commands.

    It can do nothing without a robot, and may be given it after its start.

    It answers only states of the plant's present time (:class:`StateTimes`), and gives up its goals
    when the plant reports that it does not obey (:class:`PlantListener`).
    """

    role = Role.COMMANDER
    depends_on = (Role.PLANT,)

    config: PlannerConfig | ControllerConfig
    _states: StateSynchroniser
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

    def listen(self, control_period: float) -> None:
        """Subscribe to what the plant publishes; to be called while the node is configured."""
        self._times = StateTimes(control_period)
        self._plant = PlantListener()
        self._joint_reader: JointReader | None = None
        """Reads joint_states; None before the robot is known."""
        self._ignored_reported, self._next_report = 0, 0.0
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", STREAM)
        self._statuses = self.create_subscription(
            DiagnosticStatus, "plant/status", self._on_plant_status, _STATUSES
        )
        self._best_effort = self.config.state_reliability == "best_effort"
        self._unheard = ""
        """A topic of the state with a publisher that this node cannot hear as it subscribes."""
        self._odom_input = self._subscribe_state(Odometry, "odom", self._on_odom)
        self._joints_input = self._subscribe_state(JointState, "joint_states", self._on_joints)
        self._said: DiagnosticStatus | None = None
        """The last status of the node."""
        period = self.config.diagnostics_period or math.inf
        self._diagnostics_period_ns = period * SECOND
        self._diagnosed_ns, self._diagnosed = 0, time.monotonic()
        self._known_frames = KnownFrames(self)
        self._answered = time.monotonic()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(_LOOK_PERIOD, self._look_at_times, clock=steady)

    # -- hooks --------------------------------------------------------------------------------

    @abstractmethod
    def _use(self, robot: SpaceRobot) -> None:
        """Build what depends on the robot."""

    @abstractmethod
    def _on_part(self) -> None:
        """Answer a state that may have waited for the robot."""

    @abstractmethod
    def _take_odom(self, raw: bytes) -> None:
        """Take up an odom message of the present time."""

    @abstractmethod
    def _take_joints(self, raw: bytes) -> None:
        """Take up a joint_states message of the present time."""

    @abstractmethod
    def _plant_stopped(self, stopped: Stopped) -> None:
        """Give up the goals."""

    @abstractmethod
    def _plant_changed(self, change: Change) -> None:
        """React to a change of the plant."""

    @abstractmethod
    def _plant_reported(self) -> None:
        """Take up what ``self._plant`` knows of the plant now."""

    @property
    def simulated_time_s(self) -> float | None:
        """Time of the last state, s; None before the first."""
        times = getattr(self, "_times", None)
        return None if times is None or not times.now_ns else times.now_ns / SECOND

    def on_silence(self, silence: Silence) -> None:
        """Give up the goals for a silent plant, where that is asked for."""
        super().on_silence(silence)
        if self.config.watchdog_action == "abort" and not silence.over:
            self._plant_stopped(Stopped(silence.sentence))

    def _pose_of(self, frame: str) -> Array | None:
        """Return the pose (7,) of a frame in the world, None if that is not known.

        The robot's own frames are where they were measured last, the others where /tf had them.
        """
        own: dict[str, tuple[str, Array]] = {}
        robot, states = self._robot, self._states
        if robot is not None and states.odom and states.joint_states:
            state = StateFrames(robot.description)
            with suppress(CommandError):  # Of another robot: nothing is known then.
                state.accept(states.odom, states.joint_states)
                own = robot_frames(robot.description, state)
        return self._known_frames.pose(frame, self.config.world_frame, own)

    # -- what the plant publishes -------------------------------------------------------------

    def _on_description(self, message: String) -> None:
        if self._robot is None:
            try:
                with self.long_work():
                    self._use(robot_from_text(message.data, self.config))
            except SpaceRobotError as error:
                self.get_logger().error(f"robot_description: {error}")
                return
            self._on_part()

    def _on_odom(self, raw: bytes) -> None:
        if self._times.admits_odom(raw):
            self._take_odom(raw)

    def _on_joints(self, raw: bytes) -> None:
        if time.monotonic() - self._answered > _STANDSTILL:
            self._take_last(raw)
        elif self._is_of_the_robot(raw) and self._times.admits(raw):
            self._take_joints(raw)
        self._answered = time.monotonic()
        now_ns = self._times.now_ns
        if not 0 <= now_ns - self._diagnosed_ns < self._diagnostics_period_ns:
            self._publish_diagnostics(self._times)

    def _take_last(self, raw: bytes) -> None:
        """Answer only the last of the states that wait after this node stood still.

        An answer to one before it comes too late, and what the joints did in states from before the
        first answer says nothing about whether they obey it.
        """
        odoms = list(self._drained(self._odom_input, Odometry))
        others = []
        for newer in self._drained(self._joints_input, JointState):
            if self._is_later(newer, raw):
                raw = newer
            else:
                others.append(newer)
        for joint_states in (raw, *others):
            if self._is_of_the_robot(joint_states) and self._times.admits(joint_states):
                for odom in odoms:
                    if first_time_ns(odom) >= self._times.now_ns:
                        self._on_odom(odom)
                odoms = []
                self._take_joints(joint_states)

    def _is_of_the_robot(self, raw: bytes) -> bool:
        # Those of another robot neither tell the time nor take the place of this one's.
        try:
            if self._joint_reader is not None:
                self._joint_reader.require(raw)
        except CommandError as error:
            self.get_logger().error(f"joint_states: {error}.", throttle_duration_sec=5.0)
            return False
        return True

    def _is_later(self, newer: bytes, raw: bytes) -> bool:
        """Whether a state that waits takes the place of one before it."""
        ahead = first_time_ns(newer) - first_time_ns(raw)
        return ahead > 0 and self._times.would_admit(newer) and self._is_of_the_robot(newer)

    @staticmethod
    def _drained(subscription: Subscription, kind: type[Any]) -> Iterator[bytes]:
        """Yield the serialised messages that wait in a subscription."""
        handle = subscription.handle
        with handle:
            while (taken := handle.take_message(kind, True)) is not None:
                yield taken[0]

    def _subscribe_state(
        self, kind: type[Any], topic: str, callback: Callable[[bytes], None]
    ) -> Subscription:
        def on_incompatible(_: Any) -> None:
            self._unheard = topic

        auto = self.config.state_reliability == "auto" and not self._best_effort
        events = SubscriptionEventCallbacks(incompatible_qos=on_incompatible) if auto else None
        return self.create_subscription(
            kind,
            topic,
            callback,
            BEST_EFFORT if self._best_effort else STREAM,
            raw=True,
            event_callbacks=events,
        )

    def _hear_everybody(self) -> None:
        """Subscribe to the state as drivers of sensors publish it."""
        self.get_logger().info(
            f"A publisher of '{self._unheard}' offers best effort: the state is subscribed so."
        )
        self._unheard, self._best_effort = "", True
        for old in (self._odom_input, self._joints_input):
            self.destroy_subscription(old)
        self._odom_input = self._subscribe_state(Odometry, "odom", self._on_odom)
        self._joints_input = self._subscribe_state(JointState, "joint_states", self._on_joints)

    def _look_at_times(self) -> None:
        """Take up what waits: statuses, and a state that was set aside once it is believed."""
        self._take_waiting_statuses()
        if self._unheard:
            self._hear_everybody()
        times = self._times
        # A plant that is paused publishes nothing that could contradict it.
        believed = None if self._plant.paused else times.believed()
        if believed is not None:
            odom, joint_states = believed
            if odom:
                self._take_odom(odom)
            self._take_joints(joint_states)
        if times.ignored > self._ignored_reported and time.monotonic() >= self._next_report:
            self._ignored_reported = times.ignored
            self._next_report = time.monotonic() + _REPORT_PERIOD
            self.get_logger().warning(times.last_ignored)
            self._publish_diagnostics(times, ignored=True)
        elif (
            # In a run that is to be repeatable only simulated time counts.
            self.events_have_wall_time
            and self.config.diagnostics_period
            and self.is_active
            and time.monotonic() - self._diagnosed >= _DIAGNOSED
        ):
            self._publish_diagnostics(times)

    def _take_waiting_statuses(self) -> None:
        """Take up statuses that no callback came for: an executor that is busy may lose one."""
        handle = self._statuses.handle
        with handle:
            while (taken := handle.take_message(DiagnosticStatus, False)) is not None:
                self._on_plant_status(taken[0])

    def _publish_diagnostics(self, times: StateTimes, *, ignored: bool = False) -> None:
        """Publish the status, the number of ignored states, and why the last one was ignored."""
        full, robot = self.get_fully_qualified_name(), self._robot
        hardware = robot.description.name if robot is not None else ""
        level = DiagnosticStatus.WARN if ignored else DiagnosticStatus.OK
        sentence = times.last_ignored if ignored else "states are answered"
        name, values = diagnostic_name(full, "states"), {"ignored": times.ignored}
        array = DiagnosticArray(status=[diagnostic_status(name, level, sentence, values, hardware)])
        said = self._said
        if said is not None and not ignored:
            array.status.append(
                DiagnosticStatus(
                    level=said.level,
                    name=diagnostic_name(full, "goal"),
                    message=said.message,
                    hardware_id=hardware,
                    values=said.values,
                )
            )
        self._diagnosed_ns, self._diagnosed = times.now_ns, time.monotonic()
        set_stamp(array.header.stamp, times.now_ns)
        self._diagnostics.publish(array)

    def _on_plant_status(self, received: DiagnosticStatus) -> None:
        message = read_status(received)
        try:
            status = PlantStatus.from_values(message.values, message.message)
        except SpaceRobotError as error:
            self.get_logger().warning(f"plant/status: {error}", throttle_duration_sec=5.0)
            return
        for news in self._plant.take(status, message.name or "plant"):
            match news:
                case Stopped():
                    self._plant_stopped(news)
                case Change():
                    self._plant_changed(news)
        self._plant_reported()
