"""A server of FollowJointTrajectory that drives a plant as a robot's own controller would."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from sensor_msgs.msg import JointState
from support.ros_harness import Harness, nanoseconds

from spacerobot_ros.nodes.common.fly_to import _Server

Array = npt.NDArray[np.float64]

NAME = "joint_trajectory_controller/follow_joint_trajectory"


class _GoalServer(_Server):
    """A server that does not answer requests of goals while it is silent."""

    silent = False

    async def _execute_goal_request(self, request: Any) -> None:
        if not self.silent:
            await super()._execute_goal_request(request)


class TrajectoryServer:
    """Tracks trajectories by velocities, late by ``lag``, and judges tolerances.

    Parameters
    ----------
    harness, kind
        Where the server is; the class of the action.
    lag
        Time by which the joints are behind, s.
    gain
        Of the feedback, 1/s.
    """

    def __init__(self, harness: Harness, kind: Any, lag: float = 0.13, gain: float = 8.0) -> None:
        self.kind, self.lag, self.gain = kind, lag, gain
        self.path_tolerance, self.goal_tolerance, self.goal_time = 0.2, 1e-5, 3.0
        self.freezes_at: float | None = None
        """Time of a trajectory from which on the first joint does not move, once, s."""
        self.finishes_at: float | None = None
        """Time of a trajectory at which it is said to be followed to its end, s."""
        self.falls_short = 0.0
        """Error of the last point, as long as it is not zero, m."""
        self.rejects, self.answer, self.text = False, 0, "told so"
        """Whether goals are rejected; error code and text with which they are aborted at once."""
        self.loses_results = False
        """Whether it ends no goal by itself."""
        self.goals: list[Any] = []
        self.ends: list[str] = []
        self.node = harness.probe({}, name="trajectory_server")
        self.commands = self.node.create_publisher(JointState, "joint_commands", 10)
        self._handle: ServerGoalHandle | None = None
        self._begin = -1
        self._frozen = False
        self.node.create_subscription(JointState, "joint_states", self._on_state, 10)
        self.open()

    def open(self) -> None:
        """Serve the action."""
        self.server = _GoalServer(
            self.node,
            self.kind,
            NAME,
            lambda handle: None,
            goal_callback=lambda _: GoalResponse.REJECT if self.rejects else GoalResponse.ACCEPT,
            handle_accepted_callback=self._on_goal,
            cancel_callback=self._on_cancel,
        )

    def close(self) -> None:
        """Serve it no more, and let the joints rest."""
        self._handle = None
        self.server.destroy()

    def _on_goal(self, handle: ServerGoalHandle) -> None:
        self._end("aborted", -1, "Replaced.")
        handle.execute()
        self.goals.append(handle.request)
        self._handle, self._begin, self._frozen = handle, -1, False

    def _on_cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        return CancelResponse.ACCEPT

    def _end(self, outcome: str, code: int = 0, text: str = "") -> None:
        handle, self._handle = self._handle, None
        if handle is None:
            return
        {"succeeded": handle.succeed, "aborted": handle.abort, "canceled": handle.canceled}[
            outcome
        ]()
        self.ends.append(outcome)
        result = self.kind.Result(error_code=code, error_string=text)
        self.server.end(handle, result)

    def _on_state(self, state: JointState) -> None:
        now, q = nanoseconds(state.header.stamp), np.array(state.position)
        command = JointState(name=state.name, velocity=[0.0] * len(q))
        command.header.stamp = state.header.stamp
        if self._handle is not None and self._handle.is_cancel_requested:
            self._end("canceled")
        if self._handle is not None and self.answer:
            self._end("aborted", self.answer, self.text)
        if self._handle is not None:
            command.velocity = self._follow(self._handle.request.trajectory, state, now, q)
        self.commands.publish(command)

    def _follow(self, trajectory: Any, state: JointState, now: int, q: Array) -> list[float]:
        if self._begin < 0:
            self._begin = now
        since = (now - self._begin) * 1e-9
        times = np.array([nanoseconds(p.time_from_start) for p in trajectory.points]) * 1e-9
        order = [trajectory.joint_names.index(name) for name in state.name]
        shapes = np.array([point.positions for point in trajectory.points])[:, order]
        shapes[-1, 0] += self.falls_short

        def at(time: float) -> Array:
            return np.array([np.interp(time, times, column) for column in shapes.T])

        error = at(since - self.lag) - q
        self._frozen |= self.freezes_at is not None and since >= self.freezes_at
        rates = self.gain * error + (at(since - self.lag + 0.05) - at(since - self.lag)) / 0.05
        if self._frozen:
            rates[0] = 0.0
        goal = np.array(trajectory.points[-1].positions)[order]
        if np.abs(at(since) - q).max() > self.path_tolerance and since < times[-1]:
            self.freezes_at = None
            self._end("aborted", -4, f"{state.name[0]} is off.")
            return [0.0] * len(q)
        if self.finishes_at is not None and since >= self.finishes_at:
            self._end("succeeded")
            return [0.0] * len(q)
        if since >= times[-1] and not self.loses_results:
            if np.abs(goal - q).max() <= self.goal_tolerance:
                self._end("succeeded")
                return [0.0] * len(q)
            if since >= times[-1] + self.goal_time:
                self.falls_short = 0.0
                self._end("aborted", -5, "Not there.")
                return [0.0] * len(q)
        return [float(rate) for rate in rates]
