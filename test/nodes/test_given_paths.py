"""Paths on topics: the hand follows them by Pinocchio's momentum, and bad ones are refused."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from nodes.test_end_effector_goals import (
    ATTITUDE,
    NAMES,
    PLACE,
    START,
    TOLERANCE,
    URDF,
    await_reached,
    flight_of,
    flown_to,
)
from planning.test_given_paths import distance_from
from scipy.spatial.transform import Rotation
from support.hand_motion import end_of_motion
from support.planner_flight import Flight, values_of
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.nodes.common.messages import path_poses

HAND = "end_effector"
WAY = np.array([[0.05, 0.0, 0.02], [0.12, -0.1, 0.03], [0.12, -0.15, 0.08]])
"""From the start of the hand, m."""


def path_through(positions: npt.ArrayLike, sec: int = 0, frame: str = "world") -> Path:
    """Return a path of positions (K, 3); the orientations of zeros ask for no attitude."""
    message = Path()
    message.header.frame_id, message.header.stamp.sec = frame, sec
    for x, y, z in np.reshape(positions, (-1, 3)).astype(float).tolist():
        each = PoseStamped()
        p, o = each.pose.position, each.pose.orientation
        p.x, p.y, p.z, o.w = x, y, z, 0.0
        message.poses.append(each)
    return message


def places_of_hand(flight: Flight) -> npt.NDArray[np.float64]:
    """Return where some of the published joint states put the hand."""
    shapes = np.array(
        [
            [dict(zip(m.name, m.position, strict=True))[name] for name in NAMES]
            for m in flight.probe.messages["joint_states"]
        ]
    )
    urdf, ends = URDF.read_text("utf-8"), range(1, len(shapes) + 1, 3)
    return np.array(
        [end_of_motion(urdf, NAMES, shapes[:k], [HAND], PLACE, ATTITUDE)[HAND][0] for k in ends]
    )


def test_a_path_on_a_topic_is_followed_and_another_takes_its_place(harness: Harness) -> None:
    flight = flight_of(
        harness,
        method="auto",
        **{"resolved_rate.corner_tolerance": 0.01, "resolved_rate.ramp_time": 0.3},
    )
    sender = flight.probe.create_publisher(Path, "end_effector/path", 10)
    harness.connect()
    flight.start()
    urdf = URDF.read_text("utf-8")
    start = end_of_motion(urdf, NAMES, np.array([START]), [HAND], PLACE, ATTITUDE)[HAND][0]
    for message, said in (
        (path_through([]), "The path of 'end_effector' has no poses."),
        (path_through([start, start * np.nan]), "Pose 2 of the path of 'end_effector' is [nan"),
        (path_through(start + WAY, frame="moon"), "is in frame 'moon'; goals are taken in 'world'"),
    ):
        flight.probe.messages["planner/status"].clear()
        sender.publish(message)
        assert_one_sentence(flight.wait("refused").message, said)
    sender.publish(path_through(start + WAY, 3))

    def executing() -> list[DiagnosticStatus]:
        found = flight.probe.messages["planner/status"]
        return [each for each in found if values_of(each)["state"] == "executing"]

    harness.spin_until(lambda: bool(executing()), "the path is followed")
    values = values_of(executing()[0])
    assert (values["method"], values["waypoints_of_end_effector"]) == ("resolved_rate", "2")
    assert values["goal_of_end_effector"].split() == [f"{x:.9g}" for x in start + WAY[-1]]
    await_reached(flight, "3.000000000")
    lines = np.vstack([start, start + WAY])
    off = [distance_from(lines, each) for each in places_of_hand(flight)]
    assert 1e-4 < max(off) < 0.01
    # The next path begins elsewhere; it is replaced while the hand moves to its first pose.
    sender.publish(path_through(start + WAY + 0.05, 4))
    harness.spin_until(lambda: len(executing()) > 1, "the second path is followed")
    sender.publish(path_through([start + WAY[1], start + WAY[0]], 5))
    await_reached(flight, "5.000000000")
    np.testing.assert_allclose(flown_to(flight, HAND), start + WAY[0], atol=TOLERANCE)
    decided = [values_of(each) for each in flight.probe.messages["planner/status"]]
    assert {v["goal_id"] for v in decided if v["state"] == "reached"} == {
        "3.000000000",
        "5.000000000",
    }


# -- messages -----------------------------------------------------------------------------------


def test_poses_of_a_path_are_moved_from_their_own_frames() -> None:
    message = path_through([[1, 2, 3], [4, 5, 6], [7, 8, 9]], frame="/world")
    message.poses[1].header.frame_id = "hub"
    turns = Rotation.from_rotvec([[0.1, 0.2, 0.3], [0.3, 0.0, -0.4], [0.0, 0.7, 0.0]])
    for each, (x, y, z, w) in zip(message.poses, turns.as_quat().tolist(), strict=True):
        o = each.pose.orientation
        o.x, o.y, o.z, o.w = x, y, z, w
    hub = np.array([0.5, -1.0, 2.0, *Rotation.from_rotvec([0.2, -0.6, 0.4]).as_quat()])
    found = path_poses(message, "world", "The path", {"hub": hub}.get)
    np.testing.assert_allclose(found[[0, 2], :3], [[1, 2, 3], [7, 8, 9]])
    np.testing.assert_allclose(
        found[1, :3], hub[:3] + Rotation.from_quat(hub[3:]).apply([4, 5, 6]), atol=1e-12
    )
    wanted = [turns[0], Rotation.from_quat(hub[3:]) * turns[1], turns[2]]
    for row, each in zip(found[:, 3:], wanted, strict=True):
        assert (each.inv() * Rotation.from_quat(row)).magnitude() < 1e-12


def test_orientations_of_zeros_ask_for_positions_alone() -> None:
    message = path_through([[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(path_poses(message, "world", "It"), [[1, 2, 3], [4, 5, 6]])
    message.poses[0].pose.orientation.w = 2.0
    np.testing.assert_array_equal(
        path_poses(message, "world", "It"), [[1, 2, 3, 0, 0, 0, 2], [4, 5, 6, 0, 0, 0, 0]]
    )
    assert path_poses(path_through([]), "world", "It").shape == (0, 3)


def test_stamps_may_be_left_out_and_go_on_but_not_back() -> None:
    message = path_through([[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    for each, (sec, nanosec) in zip(
        message.poses, ((2, 500_000_000), (2, 500_000_000), (3, 0)), strict=True
    ):
        each.header.stamp.sec, each.header.stamp.nanosec = sec, nanosec
    assert len(path_poses(message, "world", "It")) == 3
    message.poses[2].header.stamp.sec = 1
    message.poses[2].header.stamp.nanosec = 250_000_000
    with pytest.raises(PlanningError) as refusal:
        path_poses(message, "world", "The path")
    assert_one_sentence(
        str(refusal.value),
        "The path goes back in time: pose 3 is stamped 1.25 s, after 2.5 s; leave the "
        "stamps out, or put the poses in order.",
    )
    far = path_through([[1, 2, 3]], frame="moon")
    with pytest.raises(PlanningError, match=r"^It is in frame .moon.; goals are taken in .world."):
        path_poses(far, "world", "It")
