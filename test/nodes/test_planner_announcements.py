"""What the planner node announces, against what is flown: schedule, path, status, markers."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_flight import NEAR, TOPICS, Flight, pose_arrays, stamp_of, values_of
from support.plant_rig import SLIDERS, TICK_NS
from support.ros_harness import Harness, nanoseconds
from visualization_msgs.msg import Marker, MarkerArray

pytestmark = pytest.mark.usefixtures("one_plant")


@pytest.fixture
def flown(harness: Harness) -> Flight:
    """Return a flight with a slide and a turn, from a pose and a shape that are not zero."""
    flight = Flight(
        harness,
        {"position_tolerance": 2e-3, "attitude_tolerance": 2e-3},
        {
            "initial_position": [1.0, -0.5, 0.25],
            "initial_orientation": Rotation.from_rotvec([0.4, -0.3, 0.2]).as_quat().tolist(),
            "initial_joint_positions": [0.2, -0.1, 0.15],
        },
    )
    status = flight.decide(([1.01, -0.52, 0.26], [0.41, -0.31, 0.215]))
    assert values_of(status)["state"] == "reached", status.message
    return flight


def test_the_schedule_is_what_is_flown(flown: Flight) -> None:
    (schedule,) = flown.probe.messages["gait_schedule"]
    assert list(schedule.joint_names) == SLIDERS
    assert schedule.header.frame_id == "base_link"
    measured = {stamp_of(m): m for m in flown.probe.messages["joint_states"]}
    start = stamp_of(schedule)
    assert len(schedule.points) > 100
    for k, point in enumerate(schedule.points):
        assert nanoseconds(point.time_from_start) == k * TICK_NS
        state = measured[start + k * TICK_NS]
        np.testing.assert_allclose(point.positions, state.position, rtol=0, atol=1e-9)
        if k:
            held = schedule.points[k - 1].velocities
            np.testing.assert_allclose(held, state.velocity, rtol=0, atol=1e-9)
    assert list(schedule.points[-1].velocities) == [0.0] * 3


def test_the_path_is_what_is_flown(flown: Flight) -> None:
    (path,) = flown.probe.messages["planned_path"]
    measured = {stamp_of(m): m.pose.pose for m in flown.probe.messages["odom"]}
    assert path.header.frame_id == "world"
    assert len(path.poses) > 20
    for knot in path.poses:
        assert knot.header.frame_id == "world"
        planned, flown_there = pose_arrays(knot.pose), pose_arrays(measured[stamp_of(knot)])
        np.testing.assert_allclose(planned[0], flown_there[0], rtol=0, atol=1e-9)
        assert (planned[1].inv() * flown_there[1]).magnitude() <= 1e-9


def test_schedule_and_path_fit_each_other(flown: Flight) -> None:
    (schedule,), (path,) = (flown.probe.messages[t] for t in ("gait_schedule", "planned_path"))
    assert path.header.stamp == schedule.header.stamp
    assert stamp_of(path.poses[0]) == stamp_of(schedule)
    times = [stamp_of(knot) - stamp_of(schedule) for knot in path.poses]
    assert times == sorted(set(times))
    assert times[-1] == nanoseconds(schedule.points[-1].time_from_start)
    status = next(
        values_of(s)
        for s in flown.probe.messages["planner/status"]
        if values_of(s)["state"] == "executing"
    )
    assert float(status["duration_s"]) == pytest.approx(times[-1] / 1e9)
    assert status["method"] == "lie_bracket"
    # Three 2 kg masses on the axes of a 10 kg base: the centre of mass is at q / 8, and it rests.
    centres = []
    for time, knot in zip(times, path.poses, strict=True):
        position, attitude = pose_arrays(knot.pose)
        shape = np.array(schedule.points[time // TICK_NS].positions)
        centres.append(position + attitude.apply(shape / 8))
    np.testing.assert_allclose(centres, np.tile(centres[0], (len(centres), 1)), atol=1e-12)


def test_schedule_path_and_status_are_there_for_a_late_reader(flown: Flight) -> None:
    latched = ("gait_schedule", "planned_path", "planner/status")
    late = flown.harness.probe({t: TOPICS[t] for t in latched}, latched=latched, name="late")
    flown.harness.spin_until(lambda: all(late.count(t) for t in latched), "the latched topics")
    for topic in latched:
        assert late.count(topic) == 1
        assert late.last(topic) == flown.probe.last(topic)


def test_markers_show_the_goal_and_the_path(harness: Harness) -> None:
    flight = Flight(harness)
    flight.probe.watch("markers", MarkerArray)
    harness.connect()
    flight.decide(NEAR)
    (array,) = flight.probe.messages["markers"]
    ghosts = [m for m in array.markers if m.ns == "goal"]
    assert ghosts
    for ghost in ghosts:
        position, attitude = pose_arrays(ghost.pose)
        np.testing.assert_allclose(position, NEAR[0])
        assert attitude.magnitude() == 0.0
    (line,) = (m for m in array.markers if m.type == Marker.LINE_STRIP)
    path = flight.probe.last("planned_path")
    assert [(p.x, p.y, p.z) for p in line.points] == [
        (k.pose.position.x, k.pose.position.y, k.pose.position.z) for k in path.poses
    ]
