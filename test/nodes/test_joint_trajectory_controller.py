"""gait_schedule against what ros2_controllers' joint_trajectory_controller asks of a message."""

from __future__ import annotations

import numpy as np
from support.planner_flight import TURNED, Flight
from support.ros_harness import Harness, nanoseconds


def test_a_gait_passes_the_checks_of_a_joint_trajectory_controller(harness: Harness) -> None:
    flight = Flight(harness)
    flight.start()
    flight.send(TURNED)
    flight.wait("executing")
    harness.spin_until(lambda: flight.probe.messages["gait_schedule"], "the schedule")
    message = flight.probe.last("gait_schedule")
    names = list(flight.plant.plant.robot.joint_names)
    # The checks of validate_trajectory_msg: names known and each once, points there, times that
    # increase strictly, positions and velocities of every joint, none of another size.
    assert sorted(message.joint_names) == sorted(names)
    assert message.points
    times = [nanoseconds(point.time_from_start) for point in message.points]
    assert times[0] >= 0
    assert all(np.diff(times) > 0)
    for point in message.points:
        assert len(point.positions) == len(point.velocities) == len(names)
        assert len(point.accelerations) in (0, len(names))
        assert not len(point.effort)
    # allow_nonzero_velocity_at_trajectory_end is false by default.
    assert not np.any(message.points[-1].velocities)
    # A stamp that is not zero must not lie so far back that the trajectory has ended.
    start = nanoseconds(message.header.stamp)
    assert start + times[-1] > nanoseconds(flight.probe.last("joint_states").header.stamp)
