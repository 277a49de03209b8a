"""Schedules that a trajectory server of the robot flies: with lag, violations and aborts.

``test_layouts.py`` builds control_msgs and runs these tests with it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from support.planner_flight import NEAR, TURNED, Flight, values_of
from support.ros_harness import Harness
from support.trajectory_server import TrajectoryServer

from spacerobot_ros.nodes.common.messages import interface_class

FOLLOW = interface_class("control_msgs.action", "FollowJointTrajectory")

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(FOLLOW is None, reason="the package is not built"),
]


class DrivenFlight(Flight):
    """A plant, a server that drives it, and a planner that sends it schedules."""

    def __init__(self, harness: Harness, **planner: Any) -> None:
        self.server = TrajectoryServer(harness, FOLLOW)
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
