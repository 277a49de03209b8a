"""The state that a flight goes on from, and the truth beside noise, in bags written by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from std_msgs.msg import String
from support.made_bags import Say, array, joint_states, made_bag, odometry

from spacerobot_ros.bag import RecordedRobot, RecordingError, read_bag
from spacerobot_ros.bag.salvage import last_state
from spacerobot_ros.flight.reading import FlightBag

NAMES = ["elbow", "wrist"]
STILL = (0.0,) * 6


def position(k: float) -> tuple[float, ...]:
    """Return a pose by its number, and a twist."""
    return (k, 10.0 + k, 20.0 + k, 0.0, 0.6, 0.0, 0.8, *STILL)


def say_momentum(say: Say, time: float, k: float, prefix: str = "") -> None:
    say(f"{prefix}/momentum", array(*(100.0 * (i + 1) + k for i in range(7))), time)


def say_odom(say: Say, time: float, k: float, prefix: str = "") -> None:
    say(f"{prefix}/odom", odometry(time, *position(k)), time)


def say_joints(say: Say, time: float, k: float, prefix: str = "") -> None:
    joints = joint_states(time, NAMES, [0.1 + k, 0.2 + k], [0.3 + k, 0.4 + k])
    say(f"{prefix}/joint_states", joints, time)


def say_state(say: Say, time: float, k: float, prefix: str = "") -> None:
    """Write a state as a plant does: momenta first."""
    for part in (say_momentum, say_odom, say_joints):
        part(say, time, k, prefix)


def assert_state(bag: Path, time: float, k: float, namespace: str = "") -> None:
    state = last_state(bag, namespace)
    assert state.time_ns == round(time * 1e9)
    assert state.position.tolist() == [k, 10.0 + k, 20.0 + k]
    assert state.quaternion.tolist() == [0.0, 0.6, 0.0, 0.8]
    assert state.joint_names == NAMES
    assert state.joints.tolist() == [0.1 + k, 0.2 + k]
    assert state.rates.tolist() == [0.3 + k, 0.4 + k]
    assert state.momenta.tolist() == [100.0 * (i + 1) + k for i in range(6)]


@pytest.mark.parametrize("parts", range(4))
def test_the_last_state_is_the_last_whole_one(tmp_path: Path, parts: int) -> None:
    """A recorder that is killed leaves a state of which only some messages are there."""
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for k in range(4):
            say_state(say, 0.5 * k, k)
        for part in (say_momentum, say_odom, say_joints)[:parts]:
            part(say, 2.0, 4.0)
    last = 4 if parts == 3 else 3
    assert_state(tmp_path / "a.mcap", 0.5 * last, last)


def test_a_gap_in_odom_leaves_the_state_before_it(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        say_state(say, 0.0, 0)
        say_state(say, 0.5, 1)
        for k in (2, 3):
            say_joints(say, 0.5 * k, k)
    assert_state(tmp_path / "a.mcap", 0.5, 1)


def test_joints_and_poses_are_found_by_their_stamps_and_not_by_their_numbers(
    tmp_path: Path,
) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        say_joints(say, 0.0, 7)
        say_state(say, 0.5, 1)
        say_state(say, 1.0, 2)
        say_joints(say, 1.5, 9)
    assert_state(tmp_path / "a.mcap", 1.0, 2)


def test_of_a_state_that_was_reset_the_later_counts(tmp_path: Path) -> None:
    """A plant that is reset publishes its tick once more."""
    with made_bag(tmp_path / "a.mcap") as (_, say):
        say_state(say, 0.0, 0)
        say_state(say, 0.5, 1)
        say_state(say, 0.5, 8)
    assert_state(tmp_path / "a.mcap", 0.5, 8)


def test_each_robot_has_its_own(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        say_state(say, 0.5, 1, "/a")
        say_state(say, 1.0, 2, "/b")
    assert_state(tmp_path / "a.mcap", 0.5, 1, "/a")
    assert_state(tmp_path / "a.mcap", 1.0, 2, "/b")
    with pytest.raises(RecordingError, match="nothing is on /odom"):
        last_state(tmp_path / "a.mcap")


def test_a_bag_that_was_cut_off_has_one_too_and_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with made_bag(path) as (bag, say):
        for k in range(3):
            say_state(say, 0.5 * k, k)
            bag.flush()
        whole = path.read_bytes()
        for k in range(3, 6):
            say_state(say, 0.5 * k, k)
    path.write_bytes(whole + b"\x06\x00")
    assert_state(path, 1.0, 2)
    assert path.read_bytes() == whole + b"\x06\x00"
    assert list(tmp_path.iterdir()) == [path]


def test_states_that_never_meet_are_none(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        say_momentum(say, 0.0, 0)
        say_odom(say, 0.0, 0)
        say_joints(say, 0.5, 0)
    with pytest.raises(RecordingError, match="no state with all its parts"):
        last_state(tmp_path / "a.mcap")


def test_the_truth_is_what_was_measured_until_the_sensors_err(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for k in range(5):
            noise = 1000.0 if k >= 2 else 0.0
            if noise:
                say("/odom_true", odometry(0.5 * k, *position(k)), 0.5 * k)
            say_odom(say, 0.5 * k, k + noise)
    pose = FlightBag([read_bag(tmp_path / "a.mcap")]).true_signal("odom", 0)
    np.testing.assert_array_equal(pose.time, [0.0, 0.5, 1.0, 1.5, 2.0])
    np.testing.assert_array_equal(pose.values[:, 0], range(5))


def test_a_robot_is_described_by_its_file_or_else_by_the_last_message(tmp_path: Path) -> None:
    for attached in (False, True):
        path = tmp_path / f"{attached}.mcap"
        with made_bag(path) as (bag, say):
            if attached:
                bag.add_attachment("a.robot_description.urdf", b"<file/>", "application/xml", 0)
                bag.add_attachment("b.robot_description.urdf", b"<other/>", "application/xml", 0)
            for k, text in enumerate(("<old/>", "<new/>")):
                say("/a/robot_description", String(data=text), 0.1 * k)
        expected = b"<file/>" if attached else b"<new/>"
        assert RecordedRobot(read_bag(path), "/a").urdf == expected
    assert RecordedRobot(read_bag(path)).urdf is None
