"""Goals as actions: a commander node's action servers and their message conversion.

The types are imported at run time if installed: ``spacerobot_msgs/action/FlyTo`` from this project
and ``nav2_msgs/action/NavigateToPose``.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from geometry_msgs.msg import PoseStamped
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.clock import Clock, ClockType
from rclpy.serialization import deserialize_message

from spacerobot_ros.commanding.fly_to import FlyTo, GoalErrors, Progress
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.errors import PlanningError, counted
from spacerobot_ros.messages.builders import goal_message
from spacerobot_ros.nodes.common.messages import (
    end_effector_goal,
    goal_of,
    interface_class,
    shape_of,
)
from spacerobot_ros.planning.core.goal import Goal, Tolerance
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    from spacerobot_ros.nodes.common.commander import CommanderNode

_RESULT_TIMEOUT = 60
"""Time, s, for which a server keeps the result of a completed goal.

Each stored result slows down the processing of later goals.
"""

_NAV2_FAILURE = 9000
"""NavigateToPose's error code for an unknown error."""

_BASE_GOAL_NAME = "The goal of the base"


@dataclass(frozen=True)
class FlyToAction:
    """``spacerobot_msgs/action/FlyTo``: goals of any kind."""

    kind: Any
    """Class of the action."""

    module: ClassVar = "spacerobot_msgs.action"
    type_name: ClassVar = "FlyTo"
    name: ClassVar = "~/fly_to"

    def read(self, request: Any, node: CommanderNode) -> FlyTo:
        """Return the goal in a request; raise PlanningError if the goal is rejected."""
        links, poses = list(request.end_effectors), list(request.end_effector_poses)
        if len(links) != len(poses):
            raise PlanningError(
                f"The goal has {counted(len(links), 'end-effector')} and "
                f"{counted(len(poses), 'pose')}: give exactly one pose for each end-effector."
            )
        joints = request.joint_positions
        if len(joints.name) != len(joints.position):
            raise PlanningError(
                f"The goal has {counted(len(joints.name), 'joint name')} and "
                f"{counted(len(joints.position), 'joint position')}: give exactly one position "
                "for each joint."
            )
        if not links and not request.base_pose:
            alone = "has only joint positions" if joints.name else "is empty"
            raise PlanningError(f"The goal {alone}: add a base pose or end-effector poses.")
        shape = None
        if joints.name:
            if node.commander.robot is None:
                raise PlanningError(
                    "The goal has joint positions, but no robot_description has been received yet."
                )
            shape = shape_of(joints, node.commander.robot.joint_names)
        goal, frame = None, node.config.world_frame
        if request.base_pose:
            goal = goal_of(request.base_pose[0], frame, _BASE_GOAL_NAME, shape, node.pose_of)
        if links:
            goal = Goal.of_end_effectors(
                [
                    end_effector_goal(
                        link, pose, frame, f"The goal of the end-effector '{link}'", node.pose_of
                    )
                    for link, pose in zip(links, poses, strict=True)
                ],
                position=goal.position if goal and "position" in goal.asked else None,
                quaternion=goal.quaternion if goal and "attitude" in goal.asked else None,
                joint_positions=shape,
            )
        assert goal is not None
        tolerance = Tolerance(
            request.position_tolerance, request.attitude_tolerance, request.joint_tolerance
        )
        limit = request.time_limit
        return FlyTo(goal, tolerance, limit.sec + limit.nanosec / SECOND)

    def feedback(self, progress: Progress, world_frame: str) -> Any:
        """Return a goal's progress as a message."""
        message = self.kind.Feedback(phase=progress.phase)
        set_duration(message.remaining_time, progress.remaining_time or 0.0)
        _set_errors(message.errors, progress.errors)
        return message

    def result(self, status: Status, errors: GoalErrors) -> Any:
        """Return a result as a message."""
        message = self.kind.Result(outcome=status.state.value, message=status.message)
        _set_errors(message.errors, errors)
        return message


@dataclass(frozen=True)
class NavigateToPoseAction:
    """``nav2_msgs/action/NavigateToPose``: base poses only."""

    kind: Any
    """Class of the action."""

    module: ClassVar = "nav2_msgs.action"
    type_name: ClassVar = "NavigateToPose"
    name: ClassVar = "~/navigate_to_pose"

    def read(self, request: Any, node: CommanderNode) -> FlyTo:
        """Return the goal in a request; raise PlanningError if the goal is rejected."""
        if request.behavior_tree:
            raise PlanningError(
                f"The goal names the behavior tree '{request.behavior_tree}': behavior trees are "
                f"not supported, so leave it empty."
            )
        frame = node.config.world_frame
        return FlyTo(goal_of(request.pose, frame, _BASE_GOAL_NAME, pose_of=node.pose_of))

    def feedback(self, progress: Progress, world_frame: str) -> Any:
        """Return a goal's progress as a message."""
        message = self.kind.Feedback()
        if progress.pose is not None:
            here = Goal(progress.pose[:3], progress.pose[3:])
            raw = goal_message(here, world_frame, progress.stamp_ns)
            message.current_pose = deserialize_message(raw, PoseStamped)
        set_duration(message.navigation_time, progress.elapsed_time)
        set_duration(message.estimated_time_remaining, progress.remaining_time or 0.0)
        distance = progress.errors.position
        message.distance_remaining = 0.0 if math.isnan(distance) else distance
        return message

    def result(self, status: Status, errors: GoalErrors) -> Any:
        """Return a result as a message; in ROS 2 Humble, the message is empty."""
        message, reached = self.kind.Result(), status.state.value == "reached"
        if hasattr(message, "error_code"):
            message.error_code = 0 if reached else _NAV2_FAILURE
        if hasattr(message, "error_msg"):
            message.error_msg = "" if reached else status.message
        return message


GoalAction = FlyToAction | NavigateToPoseAction
"""An action for goals; ``name`` is the name of the action server, relative to the node name."""


class _Server(ActionServer):
    """An action server whose goals end when the commander decides, not when a callback returns."""

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        """Do nothing: plant states advance the goal."""

    def end(self, handle: ServerGoalHandle, result: Any) -> None:
        """Send the result of a completed goal to its client."""
        response = self.action_type.Impl.GetResultService.Response()
        response.status, response.result = handle.status, result
        self._result_futures[bytes(handle.goal_id.uuid)].set_result(response)


class GoalClient:
    """The client of one goal of a server; a :class:`.FlyToClient`."""

    def __init__(
        self, server: _Server, handle: ServerGoalHandle, action: GoalAction, world_frame: str
    ) -> None:
        self._server, self._handle, self._action = server, handle, action
        self._world_frame = world_frame

    def feedback(self, progress: Progress) -> None:
        """Publish the progress of the goal."""
        self._handle.publish_feedback(self._action.feedback(progress, self._world_frame))

    def end(self, status: Status, errors: GoalErrors) -> None:
        """Send the result with the matching ROS 2 goal state."""
        handle = self._handle
        if status.state.value == "reached":
            handle.succeed()
        elif handle.is_cancel_requested:
            handle.canceled()
        else:
            handle.abort()
        self._server.end(handle, self._action.result(status, errors))


class GoalActions:
    """The action servers of a commander node, which exist as long as the node does.

    Therefore, if a cleanup of the node ends a goal, the client still receives the result. While the
    node is not configured, goals are rejected.
    """

    def __init__(self, node: CommanderNode) -> None:
        self._node = node
        self._servers: list[_Server] = []
        for kind in (FlyToAction, NavigateToPoseAction):
            found = interface_class(kind.module, kind.type_name)
            if found is not None:
                self._servers.append(self._create_server(kind(found)))
        if not self._servers:
            node.get_logger().info(
                "Goals are accepted only on topics: actions need spacerobot_msgs or nav2_msgs, "
                "and neither is installed."
            )

    def _create_server(self, action: GoalAction) -> _Server:
        node = self._node

        def on_request(_: Any) -> GoalResponse:
            return GoalResponse.ACCEPT if node.has_entities else GoalResponse.REJECT

        def on_goal(handle: ServerGoalHandle) -> None:
            handle.execute()
            node.commander.receive_fly_to(
                _goal_id(handle),
                lambda: action.read(handle.request, node),
                GoalClient(server, handle, action, node.config.world_frame),
            )

        def on_cancel(handle: ServerGoalHandle) -> CancelResponse:
            # The goal state changes after this callback, before the result may arrive.
            def cancel() -> None:
                node.destroy_timer(timer)
                node.commander.cancel_fly_to(_goal_id(handle))

            timer = node.create_timer(0.0, cancel, clock=Clock(clock_type=ClockType.STEADY_TIME))
            return CancelResponse.ACCEPT

        server = _Server(
            node,
            action.kind,
            action.name,
            lambda handle: None,
            goal_callback=on_request,
            handle_accepted_callback=node.guarded(on_goal, f"a goal of '{action.name}'"),
            cancel_callback=on_cancel,
            result_timeout=_RESULT_TIMEOUT,
        )
        return server

    def destroy(self) -> None:
        """Destroy the servers when the node is destroyed."""
        servers, self._servers = self._servers, []
        for server in servers:
            server.destroy()


def _goal_id(handle: ServerGoalHandle) -> str:
    """Return the id of a goal in statuses, as `ros2 action` prints it."""
    return bytes(handle.goal_id.uuid).hex()


def set_duration(message: Any, seconds: float) -> None:
    """Set a builtin_interfaces/Duration."""
    message.sec, message.nanosec = divmod(round(seconds * SECOND), SECOND)


def _set_errors(message: Any, errors: GoalErrors) -> None:
    for name, value in asdict(errors).items():
        setattr(message, name, float(value))
