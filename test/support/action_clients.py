"""Clients of the actions of commander nodes: they send goals, and keep all that they are told."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionClient
from rclpy.node import Node
from support.ros_harness import Harness

STATES = {
    GoalStatus.STATUS_SUCCEEDED: "succeeded",
    GoalStatus.STATUS_ABORTED: "aborted",
    GoalStatus.STATUS_CANCELED: "canceled",
}


@dataclass
class SentGoal:
    """A goal that was sent: its id in statuses, its feedback, and its results."""

    goal_id: str
    handle: Any = None
    feedback: list[Any] = field(default_factory=list)
    results: list[tuple[str, Any]] = field(default_factory=list)
    """State and message of each result: there is to be one."""

    @property
    def ended(self) -> bool:
        return bool(self.results)

    @property
    def state(self) -> str:
        return self.results[0][0]

    @property
    def result(self) -> Any:
        return self.results[0][1]


class Sender:
    """A client of one action.

    Parameters
    ----------
    harness, node
        The node that has the client, and where it is.
    kind, name
        Class and name of the action.
    """

    def __init__(self, harness: Harness, node: Node, kind: Any, name: str) -> None:
        self.harness, self.kind = harness, kind
        self.client = ActionClient(node, kind, name)

    def connect(self) -> None:
        """Wait until the server is there."""
        self.harness.spin_until(self.client.server_is_ready, f"the action {self.kind}")

    def send(self, **fields: Any) -> SentGoal:
        """Send a goal, and return it once the server has accepted it."""
        sent = self.post(**fields)
        self.harness.spin_until(lambda: sent.handle is not None, "the goal is accepted")
        return sent

    def post(self, **fields: Any) -> SentGoal:
        """Send a goal without waiting."""
        sent = SentGoal("")

        def on_result(future: Any) -> None:
            response = future.result()
            sent.results.append((STATES[response.status], response.result))

        def on_answer(future: Any) -> None:
            sent.handle = future.result()
            sent.goal_id = bytes(sent.handle.goal_id.uuid).hex()
            if sent.handle.accepted:
                sent.handle.get_result_async().add_done_callback(on_result)

        future = self.client.send_goal_async(
            self.kind.Goal(**fields),
            feedback_callback=lambda message: sent.feedback.append(message.feedback),
        )
        future.add_done_callback(on_answer)
        return sent

    def end_of(self, sent: SentGoal) -> Any:
        """Wait for a result, and return its message."""
        self.harness.spin_until(lambda: sent.ended, "the result")
        return sent.result


def base_at(pose: PoseStamped) -> dict[str, Any]:
    """Return the fields of a goal of FlyTo for the base."""
    return {"base_pose": [pose]}
