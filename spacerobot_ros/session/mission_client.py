"""Client that sends the goals of a flight and tracks their statuses until the outcome is known."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.clock import Clock, ClockType
from rclpy.duration import Duration
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.topic_endpoint_info import TopicEndpointInfo
from sensor_msgs.msg import JointState

from spacerobot_ros.commanding.goal_follower import STATUS_TOPICS, GoalFollower, Status
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.measures import Outcome
from spacerobot_ros.messages.builders import goal_messages
from spacerobot_ros.messages.diagnostics import read_status
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR
from spacerobot_ros.nodes.common.messages import shape_message
from spacerobot_ros.nodes.common.node import LATCHED_QUEUE, STREAM, UNKNOWN_NODE
from spacerobot_ros.nodes.common.process import spin_until
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import GoalIds
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.times import LATEST_NS, SECOND
from spacerobot_ros.topics import link_topic

_STATUS_CHECK_PERIOD = 0.2  # wall s

_LONGEST_DELIVERY = 5.0  # wall s

_SHAPE = "goal_joint_states"

_WITHOUT_GOAL = "idle", "holding"
"""States of a planner and of a controller without a goal."""

_VERDICTS = {f"goal_{each.value}": each.value for each in Outcome}
"""State of a status by the kind of the event with the same verdict."""


class MissionClient:
    """A node that sends the goals of one flight and waits for their outcome.

    Parameters
    ----------
    decider
        The commander whose status is tracked: the planner if there is one.
    world_frame
        Frame of the goals.
    now
        Function that returns the time for goal stamps, ns: simulated time if available.
    joint_names
        The robot joints if this or an earlier goal may require joint positions; None if no goal in
        this stack requires them.
    goal, end_effector
        Goals of the kinds that will be sent, as for :meth:`send`; they determine the topics.
    name, namespace, context
        Node name, namespace and rclpy context.
    """

    def __init__(
        self,
        decider: str,
        world_frame: str,
        now: Callable[[], int],
        goal: Goal,
        end_effector: Goal | None = None,
        *,
        joint_names: Sequence[str] | None = None,
        name: str = "mission_client",
        namespace: str = "",
        context: rclpy.Context | None = None,
    ) -> None:
        self.node: Node = rclpy.create_node(name, namespace=namespace, context=context)
        self.status: Status | None = None
        """Last status from the commander that pursues the goal."""
        self.message = ""
        """Message in the last status about this goal; empty before the first."""
        self.on_message: Callable[[str], None] = lambda message: None
        """Called with each such message on arrival, because a later message may soon replace it."""
        self.decider = decider
        """The commander that decides."""
        self._done = rclpy.task.Future(executor=None)
        self._decision: Status | None = None
        """The verdict in an event. The status with the verdict may be lost: latched topics keep one
        message for a busy reader, and that may be about a later goal."""
        self._last: Status | None = None
        """Last status about the goal, or without any goal after one about it."""
        self._frame, self._now = world_frame, now
        self._joint_names = joint_names
        self._sent = 0
        self._follower = GoalFollower()
        base = "goal_pose" if goal.waypoints is None else "goal_path"
        aims = goal_messages(goal, end_effector, world_frame, 0)
        self.goal_topics = [base, *(topic for topic in aims if topic != base)]
        """Topics of the goal, that of the base first."""
        self._sends: dict[str, Publisher] = {}
        for topic in self.goal_topics:
            kind = Path if topic.endswith("path") else PoseStamped
            self._sends[topic] = self.node.create_publisher(kind, topic, STREAM)
        self._goal_topic = self._sends[self.goal_topics[0]].topic_name
        if joint_names is not None:
            self._sends[_SHAPE] = self.node.create_publisher(JointState, _SHAPE, STREAM)
        self.failures: dict[str, str] = {}
        """Messages from failed nodes, by the last part of their names."""
        self.node.create_subscription(DiagnosticStatus, "events", self._on_event, STREAM)
        topic, self._read = STATUS_TOPICS[decider]
        # The end of a goal and the status of the next goal arrive at the same time.
        self._status_topic = self.node.create_subscription(
            DiagnosticStatus, topic, self._on_status, LATCHED_QUEUE
        )

    @property
    def goal_id(self) -> str | None:
        """Id of the last goal sent; None before the first."""
        return self._follower.goal_id

    @property
    def gait(self) -> PlannerStatus | None:
        """The planner status at the start of its first schedule for the goal."""
        return self._follower.gait

    @property
    def outcome(self) -> Outcome | None:
        """Outcome of the goal; None until the goal has ended."""
        return self._done.result()

    @property
    def ends_at(self) -> float:
        """Simulated time at which the planner's current schedule ends, s; 0 if there is no
        schedule.
        """
        return self.status.ends_at_s if isinstance(self.status, PlannerStatus) else 0.0

    def is_connected(self, readers: int = 1) -> bool:
        """Whether the goal topics have ``readers`` subscribers, and all known subscribers are
        matched.

        A commander may be known but not matched yet, while a viewer or a recorder is already
        matched. Third-party planners need not accept joint positions.
        """
        return all(
            publisher.get_subscription_count()
            >= max(
                self.node.count_subscribers(publisher.topic_name), 0 if topic == _SHAPE else readers
            )
            for topic, publisher in self._sends.items()
        )

    def has_goal_commander(self) -> bool:
        """Whether a commander that publishes its status and subscribes to goals is connected.

        A recorder also subscribes to goals, and may be discovered first, before its node's name.
        The default end-effector may be the controller's while the planner decides.
        """
        if not self._status_topic.get_publisher_count():
            return False
        deciders = self.node.get_publishers_info_by_topic(self._status_topic.topic_name)
        named = [each for each in deciders if each.node_name != UNKNOWN_NODE]
        own = set(self._sends) - {_SHAPE, link_topic(DEFAULT_END_EFFECTOR, "goal_pose")}
        return all(_names_of(named) & self._readers(self._sends[each].topic_name) for each in own)

    def knows_commander(self) -> bool:
        """Whether a publisher of the commander's status has been discovered."""
        return self.node.count_publishers(self._status_topic.topic_name) > 0

    @property
    def lost(self) -> str:
        """Sentence that explains why the goal, once pursued, has no commander; empty: it has one.

        A verdict may still be under way.
        """
        if self._last is None or self.outcome is not None:
            return ""
        if not self._follower.is_about_goal(self._last):
            return f"'{self.decider}' was started again and has no goal: send the goal again."
        if not self.knows_commander():
            return f"'{self.decider}' has ended: start it again, and send the goal again."
        return ""

    def has_late_recorder(self) -> bool:
        """Whether a node that follows events and states has not yet subscribed to goals: a recorder
        does so once it has discovered this client.
        """
        followers = self._readers("events") & self._readers("odom")
        return bool(followers - self._readers(self._goal_topic))

    def _readers(self, topic: str) -> set[tuple[str, str]]:
        return _names_of(self.node.get_subscriptions_info_by_topic(topic))

    def send(self, goal: Goal, end_effector: Goal | None = None) -> None:
        """Publish base and end-effector goal poses, if any.

        All messages share one stamp, unique to this goal; the status identifies the goal by this
        stamp. A planner uses received joint positions for all later goals, so every goal is sent
        together with its joint positions, or with an empty message.
        """
        self._sent += 1
        time_ns = self._now() + self._sent
        self._follower = GoalFollower(GoalIds().of(*divmod(min(time_ns, LATEST_NS), SECOND)))
        self.message, self._decision = "", None
        self._last = None
        if self._joint_names is not None:
            self._sends[_SHAPE].publish(shape_message(goal, self._joint_names))
        for topic, aim in goal_messages(goal, end_effector, self._frame, time_ns).items():
            self._sends[topic].publish(aim)

    def await_delivery(self) -> None:
        """Wait until all subscribers have received the last goal."""
        end = time.monotonic() + _LONGEST_DELIVERY
        for publisher in self._sends.values():
            publisher.wait_for_all_acked(Duration(seconds=max(0.0, end - time.monotonic())))

    def follow(
        self,
        executor: EventsExecutor,
        look: Callable[[], bool],
        period: float = _STATUS_CHECK_PERIOD,
    ) -> Outcome:
        """Spin until the goal has ended, or until ``look``, called every ``period`` s, returns
        true.

        A busy events executor ignores spin timeouts, so a timer calls ``look``.

        Raises
        ------
        SpaceRobotError
            Raised by ``look``.
        """
        failures: list[SpaceRobotError] = []
        decision: Status | None = None

        def on_look() -> None:
            nonlocal decision
            try:
                stop = look()
            except SpaceRobotError as error:
                failures.append(error)
                stop = True
            # The status, which says more than the event, may arrive within a period after it.
            if decision is not None and self.outcome is None:
                self._take(decision)
            decision = self._decision
            if stop:
                self._end(Outcome.INTERRUPTED)

        timer = self.node.create_timer(
            period, on_look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        spin_until(executor, self._done)
        self.node.destroy_timer(timer)
        if failures:
            raise failures[0]
        return self._done.result()

    def _end(self, outcome: Outcome) -> None:
        if not self._done.done():
            self._done.set_result(outcome)

    def _on_event(self, received: DiagnosticStatus) -> None:
        event = read_status(received)
        kind, node = event.values.get("event", ""), event.name.rpartition("/")[2]
        if kind == EventKind.FAILED.value:
            self.failures[node] = event.message
        elif node == self.decider and kind in _VERDICTS:
            values = {"state": _VERDICTS[kind], "goal_id": event.values.get("goal_id", "")}
            decision = self._read(values, event.message)
            if self._follower.is_about_goal(decision):
                self._decision = decision

    def _on_status(self, received: DiagnosticStatus) -> None:
        message = read_status(received)
        self._take(self._read(dict(message.values), message.message))

    def _take(self, status: Status) -> None:
        self.status = status
        # Others, such as the verdict on an earlier goal, say nothing about this one.
        concerns = self.goal_id is None or self._follower.is_about_goal(status)
        if self.outcome is None and (concerns or not (status.goal_id or status.state.decided)):
            self.message = status.message
            self.on_message(self.message)
        idle = not status.goal_id and status.state.value in _WITHOUT_GOAL
        if self._follower.is_about_goal(status) or (idle and self._last is not None):
            self._last = status
        if self._follower.update(status):
            self._end(Outcome(status.state.value))


def _names_of(endpoints: Sequence[TopicEndpointInfo]) -> set[tuple[str, str]]:
    """Return the node namespaces and names of endpoints."""
    return {(each.node_namespace, each.node_name) for each in endpoints}
