"""Schedules that a trajectory server of the robot flies: with lag, violations and aborts.

``test_layouts.py`` builds control_msgs and runs these tests with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future
from sensor_msgs.msg import JointState
from support.planner_flight import NEAR, TURNED, Flight, values_of
from support.ros_harness import Harness, nanoseconds

from spacerobot_ros.nodes.common.messages import interface_class

Array = npt.NDArray[np.float64]
FOLLOW: Any = interface_class("control_msgs.action", "FollowJointTrajectory")

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(FOLLOW is None, reason="the package is not built"),
]


class TrajectoryServer:
    """Tracks trajectories by velocities, late by ``lag`` (s), and judges tolerances."""

    def __init__(self, harness: Harness) -> None:
        self.lag = 0.13
        self.path_tolerance, self.goal_time = 0.2, 3.0
        self.freezes_at: float | None = None
        """Time of a trajectory from which on the first joint does not move, once, s."""
        self.falls_short = 0.0
        """Error of the last point, as long as it is not zero, m."""
        self.goals: list[Any] = []
        self.ends: list[str] = []
        self.node = harness.probe({}, name="trajectory_server")
        self.commands = self.node.create_publisher(JointState, "joint_commands", 10)
        self._handle: ServerGoalHandle | None = None
        self._result: Future = Future()
        self._begin = -1
        self._frozen = False
        self.node.create_subscription(JointState, "joint_states", self._on_state, 10)
        self.server = ActionServer(
            self.node,
            FOLLOW,
            "joint_trajectory_controller/follow_joint_trajectory",
            lambda handle: None,
            handle_accepted_callback=self._on_goal,
            cancel_callback=lambda _: CancelResponse.ACCEPT,
        )

    def close(self) -> None:
        """Serve it no more, and let the joints rest."""
        self._handle = None
        self.server.destroy()

    def _on_goal(self, handle: ServerGoalHandle) -> None:
        self._end("aborted", -1, "Replaced.")
        result = self._result = Future(executor=self.node.executor)

        async def followed(_: ServerGoalHandle) -> Any:
            return await result

        handle.execute(followed)
        self.goals.append(handle.request)
        self._handle, self._begin, self._frozen = handle, -1, False

    def _end(self, outcome: str, code: int = 0, text: str = "") -> None:
        handle, self._handle = self._handle, None
        if handle is None:
            return
        {"succeeded": handle.succeed, "aborted": handle.abort, "canceled": handle.canceled}[
            outcome
        ]()
        self.ends.append(outcome)
        self._result.set_result(FOLLOW.Result(error_code=code, error_string=text))

    def _on_state(self, state: JointState) -> None:
        now, q = nanoseconds(state.header.stamp), np.array(state.position)
        command = JointState(name=state.name, velocity=[0.0] * len(q))
        command.header.stamp = state.header.stamp
        if self._handle is not None and self._handle.is_cancel_requested:
            self._end("canceled")
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
        rates = 8.0 * error + (at(since - self.lag + 0.05) - at(since - self.lag)) / 0.05
        if self._frozen:
            rates[0] = 0.0
        goal = np.array(trajectory.points[-1].positions)[order]
        if np.abs(at(since) - q).max() > self.path_tolerance and since < times[-1]:
            self.freezes_at = None
            self._end("aborted", -4, f"{state.name[0]} is off.")
        elif np.abs(goal - q).max() <= 1e-5 and since >= times[-1]:
            self._end("succeeded")
        elif since >= times[-1] + self.goal_time:
            self.falls_short = 0.0
            self._end("aborted", -5, "Not there.")
        else:
            return [float(rate) for rate in rates]
        return [0.0] * len(q)


class DrivenFlight(Flight):
    """A plant, a server that drives it, and a planner that sends it schedules."""

    def __init__(self, harness: Harness, **planner: Any) -> None:
        self.server = TrajectoryServer(harness)
        super().__init__(harness, {"output": "trajectory", **planner})
        self.start()
        self.find_server()

    def find_server(self) -> None:
        output = self.planner.commander.trajectories
        assert output is not None
        self.harness.spin_until(output._server.is_available, "the server")

    def ended(self, place: Any) -> tuple[str, str, str]:
        """Return state, corrections and message of the end of a goal."""
        status = self.decide(place)
        values = values_of(status)
        return values["state"], values["corrections"], status.message


@pytest.fixture
def flight(harness: Harness) -> Iterator[DrivenFlight]:
    flight = DrivenFlight(harness)
    yield flight
    flight.server.close()


def test_a_robot_that_lags_reaches_its_goals(flight: DrivenFlight) -> None:
    # The lag rounds off the corners of a gait that turns the base; a straight motion has none.
    for place, needed in ((NEAR, "0"), (TURNED, "1")):
        state, corrections, message = flight.ended(place)
        assert (state, corrections) == ("reached", needed), message
        distance, angle = flight.error_to(place)
        assert distance <= 1e-3
        assert angle <= 1e-3
    assert flight.server.ends == ["succeeded"] * 3
    goal = flight.server.goals[0].trajectory
    assert goal.header.stamp.sec == goal.header.stamp.nanosec == 0
    assert not goal.points[0].velocities
    assert flight.planner.count_publishers("joint_commands") == 1  # The server's.


def test_violated_tolerances_are_corrected(flight: DrivenFlight) -> None:
    flight.server.freezes_at, flight.server.path_tolerance = 0.5, 0.05
    flight.server.lag = 0.0
    state, corrections, message = flight.ended(NEAR)
    assert (state, corrections) == ("reached", "1"), message
    assert flight.server.ends == ["aborted", "succeeded"]
    flight.server.falls_short, flight.server.goal_time = 0.04, 0.7
    state, corrections, message = flight.ended(TURNED)
    assert (state, corrections) == ("reached", "1"), message
    assert flight.server.ends[2:] == ["aborted", "succeeded"]
    assert max(flight.error_to(TURNED)) <= 1e-3


def test_an_abort_and_another_goal_cancel_the_trajectory(flight: DrivenFlight) -> None:
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(20)
    assert flight.planner.commander.abort() is not None
    flight.harness.spin_until(lambda: flight.server.ends == ["canceled"], "the cancellation")
    flight.ticks(3)
    assert np.abs(flight.plant.plant.qdot).max() == 0.0
    flight.ticks(40)
    flight.send(TURNED)
    flight.wait("executing")
    flight.ticks(10)
    assert flight.ended(NEAR)[0] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


def test_a_node_that_is_cleaned_up_leaves_the_robot_at_rest(flight: DrivenFlight) -> None:
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(20)
    flight.planner.trigger_deactivate()
    flight.harness.spin_until(lambda: flight.server.ends == ["canceled"], "the cancellation")
    flight.planner.trigger_cleanup()
    flight.planner.start()
    flight.find_server()
    assert flight.ended(NEAR)[0] == "reached"


class Lost(DrivenFlight):
    """Its planner looks for a server of another name."""

    def find_server(self) -> None:
        pass


def test_a_goal_without_a_server_fails_and_names_the_action(harness: Harness) -> None:
    flight = Lost(harness, trajectory_action="arm/follow")
    state, _, message = flight.ended(NEAR)
    flight.server.close()
    assert state == "failed"
    assert "the action '/arm/follow' has no server" in message
