"""Whoever sends goals and follows what becomes of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState

from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.planning import Goal

STATUS = {"planner": "planner/status", "coordinated_control": "controller/status"}
"""By commander: where it says what becomes of a goal."""

_ENDED = ("reached", "failed", "refused", "aborted")


class Operator:
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
        Called, within the callback, when the goal is decided.
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
        name: str = "operator",
        namespace: str = "",
        context: rclpy.Context | None = None,
    ) -> None:
        self.node: Node = rclpy.create_node(name, namespace=namespace, context=context)
        self.done = rclpy.task.Future(executor=None)
        """Done, with the last state, when the goal is decided."""
        self.status: dict[str, str] = {}
        """Values of the last status."""
        self.sentence = ""
        """Message of the last status."""
        self.gait: dict[str, str] = {}
        """What the planner said of its first schedule for the goal."""
        self._frame, self._joint_names, self._on_end = world_frame, joint_names, on_end
        self._sent = ""
        # A controller's status does not name the goal: what it said before of another is over
        # when it says that it flies.
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
    def ends_at(self) -> float:
        """Simulated time at which the flight ends as far as the planner has said, s; else 0."""
        return float(self.status.get("ends_at_s", 0.0))

    def heard(self, readers: int = 1) -> bool:
        """Whether everything that this node publishes has that many readers."""
        return all(
            publisher.get_subscription_count() >= readers
            for publisher in self.node.publishers
            if publisher.topic_name not in ("/rosout", "/parameter_events")
        )

    def answers(self) -> bool:
        """Whether somebody says what becomes of goals."""
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
        self._answered = self._answered or state not in _ENDED or state == "refused"
        if self._answered and state in _ENDED and not self.done.done():
            # Here and not when the spin returns: a run ends at the same tick every time.
            self._on_end()
            self.done.set_result(state)
