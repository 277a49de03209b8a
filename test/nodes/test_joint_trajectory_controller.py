"""gait_schedule against what ros2_controllers' joint_trajectory_controller asks of a message.

The rules are facts: those of JointTrajectoryController::validate_trajectory_msg and
validate_trajectory_point_field at 94e74de (August 2026), with the parameters' defaults.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from support.planner_flight import TURNED, Flight
from support.ros_harness import Harness, nanoseconds
from trajectory_msgs.msg import JointTrajectory

_FLOAT_EPSILON = float(np.finfo(np.float32).eps)


def refusal(message: JointTrajectory, joints: Sequence[str], now_ns: int) -> str:
    """Return why the controller refuses a trajectory, empty if it accepts it."""
    names, points = list(message.joint_names), list(message.points)
    # allow_partial_joints_goal is false.
    if len(names) != len(joints):
        return "not the controller's joints"
    if not names or not points:
        return "empty"
    if not set(names) <= set(joints):
        return "an unknown joint"
    # allow_nonzero_velocity_at_trajectory_end is false.
    if any(abs(velocity) > _FLOAT_EPSILON for velocity in points[-1].velocities):
        return "a velocity at the end"
    start = nanoseconds(message.header.stamp)
    if start and start + nanoseconds(points[-1].time_from_start) < now_ns:
        return "over already"
    previous = 0
    for number, point in enumerate(points):
        time = nanoseconds(point.time_from_start)
        if number and time <= previous:
            return "times that do not increase"
        previous = time
        # allow_integration_in_goal_trajectories is false: positions of all, the others if at all.
        if len(point.positions) != len(names):
            return "positions"
        if len(point.velocities) not in (0, len(names)):
            return "velocities"
        if len(point.accelerations) not in (0, len(names)):
            return "accelerations"
        # Without the command interface "effort".
        if len(point.effort):
            return "efforts"
    return ""


@pytest.fixture
def schedule(harness: Harness) -> tuple[JointTrajectory, list[str], int]:
    """Return the schedule of a gait, the joints, and when it has come."""
    flight = Flight(harness)
    flight.start()
    flight.send(TURNED)
    flight.wait("executing")
    harness.spin_until(lambda: flight.probe.messages["gait_schedule"], "the schedule")
    now = nanoseconds(flight.probe.last("joint_states").header.stamp)
    names = list(flight.plant.plant.robot.joint_names)
    return flight.probe.last("gait_schedule"), names, now


def test_a_gait_passes_the_checks_of_a_joint_trajectory_controller(
    schedule: tuple[JointTrajectory, list[str], int],
) -> None:
    message, names, now = schedule
    assert refusal(message, names, now) == ""
    assert sorted(message.joint_names) == sorted(names)  # Each once
    assert all(len(point.velocities) == len(names) for point in message.points)
    assert np.isfinite([point.positions for point in message.points]).all()

    # The rules themselves refuse what they are about.
    last = message.points[-1].time_from_start
    cases: dict[str, Callable[[JointTrajectory], object]] = {
        "not the controller's joints": lambda m: m.joint_names.pop(),
        "empty": lambda m: m.points.clear(),
        "an unknown joint": lambda m: m.joint_names.__setitem__(0, "nobody"),
        "a velocity at the end": lambda m: m.points[-1].velocities.__setitem__(0, 1e-3),
        "times that do not increase": lambda m: setattr(m.points[1], "time_from_start", last),
        "positions": lambda m: m.points[0].positions.pop(),
        "velocities": lambda m: m.points[0].velocities.pop(),
        "efforts": lambda m: setattr(m.points[0], "effort", [0.0]),
    }
    for reason, damage in cases.items():
        damaged = copy.deepcopy(message)
        damage(damaged)
        assert refusal(damaged, names, now) == reason
    # A stamp of zero begins whenever it is received.
    message.header.stamp.sec += 1
    late = nanoseconds(message.header.stamp) + nanoseconds(last) + 1
    assert refusal(message, names, late) == "over already"
