"""The client of a mission: sends its goals and follows the status until they are decided."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from enum import Enum

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.nodes.common.process import spin_until
from spacerobot_ros.planning import Goal

STATUS = {"planner": "planner/status", "coordinated_control": "controller/status"}
"""By commander: where it reports what becomes of a goal."""

_LOOK_PERIOD = 0.2
"""Wall s from one look of a follower to the next."""


class Outcome(str, Enum):
    """What became of a goal; the values are those of ``state`` in the status, but the last."""

    REACHED = "reached"
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"
    INTERRUPTED = "interrupted"
    """The client stopped following it."""


class MissionClient:
    """A node that sends the goals of one flight and listens until they are decided.

    Parameters
    ----------
    decider
        The commander that decides: the planner where there is one.
    world_frame
        Frame of the goals.
    joint_names
        Returns the robot's joints, where goals have a shape; None: they have none.
    end_effector
        Whether there will be goals for the end-effector.
    on_end
        Called, within the callback, when the goal is decided or no longer followed.
    name, namespace, context
        Of the node.
    """

    def __init__(
        self,
        decider: str,
        world_frame: str,
        *,
        joint_names: Callable[[], Sequence[str]] | None = None,
        end_effector: bool = False,
        on_end: Callable[[], None] = lambda: None,
        name: str = "mission_client",
        namespace: str = "",
        context: rclpy.Context | None = None,
    ) -> None:
        self.node: Node = rclpy.create_node(name, namespace=namespace, context=context)
        self.status: dict[str, str] = {}
        """Values of the last status."""
        self.sentence = ""
        """Message of the last status."""
        self.gait: dict[str, str] = {}
        """The planner's status when its first schedule for the goal began."""
        self._done = rclpy.task.Future(executor=None)
        self._frame, self._joint_names, self._on_end = world_frame, joint_names, on_end
        self._sent = ""
        # A controller's status does not name the goal: what it reported before of another is over
        # when it reports that it flies.
        self._answered = decider == "planner"
        self._goal_topic = self.node.create_publisher(PoseStamped, "goal_pose", STREAM)
        if joint_names is not None:
            self._shape_topic = self.node.create_publisher(JointState, "goal_joint_states", STREAM)
        if end_effector:
            self._end_effector_topic = self.node.create_publisher(
                PoseStamped, "end_effector/goal_pose", STREAM
            )
        self._status_topic = self.node.create_subscription(
            DiagnosticStatus, STATUS[decider], self._on_status, LATCHED
        )

    @property
    def outcome(self) -> Outcome | None:
        """What became of the goal; None as long as it is followed."""
        outcome: Outcome | None = self._done.result()
        return outcome

    @property
    def ends_at(self) -> float:
        """Simulated time at which the present schedule of the planner ends, s; else 0."""
        return float(self.status.get("ends_at_s", 0.0))

    def is_connected(self, readers: int = 1) -> bool:
        """Whether everything that this node publishes has that many readers."""
        return all(
            publisher.get_subscription_count() >= readers
            for publisher in self.node.publishers
            if publisher.topic_name not in ("/rosout", "/parameter_events")
        )

    def has_decider(self) -> bool:
        """Whether a commander reports what becomes of goals."""
        return bool(self._status_topic.get_publisher_count())

    def send(self, goal: Goal, end_effector: Goal | None = None) -> None:
        """Publish goal poses of the base and, where there is one, of the end-effector."""
        self._sent = " ".join(f"{x:.9g}" for x in (*goal.position, *goal.quaternion))
        if goal.joint_positions is not None and self._joint_names is not None:
            self._shape_topic.publish(
                JointState(name=list(self._joint_names()), position=goal.joint_positions.tolist())
            )
        self._goal_topic.publish(self._pose(goal))
        if end_effector is not None:
            self._end_effector_topic.publish(self._pose(end_effector))

    def follow(
        self, executor: EventsExecutor, look: Callable[[], bool], period: float = _LOOK_PERIOD
    ) -> Outcome:
        """Spin until the goal is decided, or until ``look``, called every ``period`` s, is true.

        A busy events executor does not heed the time limit of a spin: the look is a timer's.

        Raises
        ------
        SpaceRobotError
            What ``look`` raises.
        """
        failures: list[SpaceRobotError] = []

        def on_look() -> None:
            try:
                stop = look()
            except SpaceRobotError as error:
                failures.append(error)
                stop = True
            if stop:
                self._end(Outcome.INTERRUPTED)

        timer = self.node.create_timer(
            period, on_look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        spin_until(executor, self._done)
        self.node.destroy_timer(timer)
        if failures:
            raise failures[0]
        assert self.outcome is not None
        return self.outcome

    def _end(self, outcome: Outcome) -> None:
        if not self._done.done():
            # Here and not when the spin returns: a run ends at the same tick every time.
            self._on_end()
            self._done.set_result(outcome)

    def _pose(self, goal: Goal) -> PoseStamped:
        message = PoseStamped()
        message.header.frame_id = self._frame
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = goal.position.tolist()
        o.x, o.y, o.z, o.w = goal.quaternion.tolist()
        return message

    def _on_status(self, message: DiagnosticStatus) -> None:
        self.status = {pair.key: pair.value for pair in message.values}
        self.sentence = message.message
        state = self.status.get("state")
        if not self._sent or self.status.get("goal", self._sent) != self._sent:
            return  # Of an earlier goal.
        if state == "executing" and not self.gait:
            self.gait = dict(self.status)
        decided = state in _ENDED
        self._answered = self._answered or not decided or state == "refused"
        if self._answered and decided:
            self._end(Outcome(state))


_ENDED = {outcome.value for outcome in Outcome} - {Outcome.INTERRUPTED.value}
