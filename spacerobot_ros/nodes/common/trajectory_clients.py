"""FollowJointTrajectory clients, which send schedules to a robot's own controller.

Its type ``control_msgs/action/FollowJointTrajectory`` is imported at run time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient
from rclpy.serialization import deserialize_message
from trajectory_msgs.msg import JointTrajectory

from spacerobot_ros.commanding.trajectory_output import Outcome, TrajectoryEnd, TrajectoryOutput
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.messages.builders import trajectory_message
from spacerobot_ros.nodes.common.fly_to import action_class
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.status import ScheduleStart

_OUTCOMES = {
    GoalStatus.STATUS_SUCCEEDED: Outcome.SUCCEEDED,
    GoalStatus.STATUS_ABORTED: Outcome.ABORTED,
    GoalStatus.STATUS_CANCELED: Outcome.CANCELED,
}


class TrajectoryClients:
    """A planner node's FollowJointTrajectory clients; they exist as long as the node.

    If a node cleanup destroyed them, an executor might still hold a response for one of them.

    Raises
    ------
    ParameterError
        The action package is not installed.
    """

    def __init__(self, node: Any) -> None:
        kind = action_class("control_msgs", "FollowJointTrajectory")
        if kind is None:
            raise ParameterError(
                "Parameter 'output' is 'trajectory', which needs the package control_msgs: install "
                "it (apt: ros-$ROS_DISTRO-control-msgs), or set another output."
            )
        self._kind, self._node = kind, node
        self._clients: dict[str, ActionClient] = {}

    def connect(self, name: str, on_end: Callable[[TrajectoryEnd], None]) -> TrajectoryOutput:
        """Return an output to an action server; it calls `on_end` when a schedule ends."""
        if name not in self._clients:
            self._clients[name] = ActionClient(self._node, self._kind, name)
        connection = _Connection(self._kind, self._clients[name])
        output = TrajectoryOutput(connection, self._node.resolve_topic_name(name), on_end)
        connection.output = output
        return output

    def destroy(self) -> None:
        """Destroy the clients when the node is destroyed."""
        for client in self._clients.values():
            client.destroy()
        self._clients.clear()


class _Connection:
    """Connects one :class:`TrajectoryOutput` with a client."""

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
        goal = self._kind.Goal(trajectory=joint_trajectory(start.schedule))
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
        outcome = _OUTCOMES.get(response.status, Outcome.ABORTED)
        result = response.result
        self.output.ended(number, outcome, result.error_code, result.error_string)


def joint_trajectory(schedule: GaitSchedule) -> JointTrajectory:
    """Return a schedule as a trajectory that begins when it arrives.

    Its points have only positions, so that controllers interpolate linearly. This reproduces the
    schedule, whose velocities are constant over a tick.
    """
    message = deserialize_message(trajectory_message(schedule, 0, ""), JointTrajectory)
    for point in message.points:
        point.velocities = []
    return message
