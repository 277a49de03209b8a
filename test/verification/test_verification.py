"""A reference bag, tampered with: what its verification says of every change."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.altered_bags import altered
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.resources import share_directory

BAG = share_directory() / "bags" / "sliding_masses.mcap"
TICK = 0.1
TICKS = 340


def scaled(message: JointState) -> JointState:
    message.velocity[1] += 1e-4
    return message


@pytest.mark.parametrize("tick", [1, 80, 333])
def test_an_altered_command_is_found_where_it_acts(tmp_path: Path, tick: int) -> None:
    bag = altered(BAG, tmp_path / "b.mcap", "/joint_commands", tick, scaled)
    difference = verify_bag(bag).difference
    assert difference is not None
    assert difference.time == pytest.approx((tick + 1) * TICK)
    assert (difference.topic, difference.field) == ("/joint_states", "position of slider_2")
    # What the slider does in a tick.
    assert difference.expected - difference.recorded == pytest.approx(1e-4 * TICK, rel=1e-6)
    assert_one_sentence(str(difference), "position of slider_2", f"{(tick + 1) * TICK:g} s")


def moved(message: Any) -> Any:
    if isinstance(message, JointState):
        message.velocity[2] += 1e-6
    elif isinstance(message, Odometry):
        message.twist.twist.angular.y += 1e-6
    elif isinstance(message, PoseStamped):
        message.pose.orientation.x += 1e-6
    elif isinstance(message, Float64MultiArray):
        message.data[6] += 1e-6
    return message


@pytest.mark.parametrize(
    ("topic", "field"),
    [
        ("/joint_states", "velocity of slider_3"),
        ("/odom", "twist.twist.angular.y"),
        ("/base_pose", "pose.orientation.x"),
        ("/momentum", "kinetic energy"),
    ],
)
def test_an_altered_state_is_found(tmp_path: Path, topic: str, field: str) -> None:
    bag = altered(BAG, tmp_path / "b.mcap", topic, 33, moved)
    difference = verify_bag(bag).difference
    assert difference is not None
    assert (difference.topic, difference.field) == (topic, field)
    assert difference.time == pytest.approx(read_bag(BAG)[topic].stamp[33])
    assert difference.recorded - difference.expected == pytest.approx(1e-6, rel=1e-6)
    assert verify_bag(bag, tolerance=2e-6).difference is None


def moved_thrust(message: Any) -> Any:
    if isinstance(message, JointState):
        message.effort[3] += 1e-6
    else:
        message.wrench.torque.y += 1e-6
    return message


@pytest.mark.slow
@pytest.mark.parametrize(
    ("topic", "field"),
    [("/thrusters", "effort of plus_x_4"), ("/base_wrench_realised", "wrench.torque.y")],
)
def test_an_altered_thrust_is_found(tmp_path: Path, topic: str, field: str) -> None:
    source = BAG.with_name("servicer_thrusters.mcap")
    bag = altered(source, tmp_path / "b.mcap", topic, 33, moved_thrust)
    difference = verify_bag(bag).difference
    assert difference is not None
    assert (difference.topic, difference.field) == (topic, field)
    assert difference.recorded - difference.expected == pytest.approx(1e-6, rel=1e-6)


@pytest.mark.slow
def test_another_robot_is_found(tmp_path: Path) -> None:
    text = b'<mass value="10"/>', b'<mass value="10.01"/>'
    difference = verify_bag(altered(BAG, tmp_path / "b.mcap", urdf=text)).difference
    assert difference is not None
    # The joints go as commanded; the base is the first to differ.
    assert difference.topic == "/odom"
    assert difference.time == pytest.approx(TICK)


def test_a_missing_command_is_named(tmp_path: Path) -> None:
    bag = altered(BAG, tmp_path / "b.mcap", "/joint_commands", 5, lambda _: None)
    difference = verify_bag(bag).difference
    assert difference is not None
    assert difference.time == pytest.approx(6 * TICK)
    assert "no message on /joint_commands is stamped 0.5 s" in str(difference)


def without_number(message: JointState) -> JointState:
    message.velocity[1] = math.nan
    return message


def test_a_refused_command_is_named_with_the_reason(tmp_path: Path) -> None:
    bag = altered(BAG, tmp_path / "b.mcap", "/joint_commands", 120, without_number)
    difference = verify_bag(bag).difference
    assert difference is not None
    assert difference.time == pytest.approx(121 * TICK)
    assert "that on /joint_commands stamped 12 s is refused: a value is not finite" in str(
        difference
    )


def test_a_latched_fault_is_named_with_its_time(tmp_path: Path) -> None:
    latching = {"latched_faults": '"not_finite"'}
    bag = altered(
        BAG, tmp_path / "b.mcap", "/joint_commands", 120, without_number, parameters=latching
    )
    difference = verify_bag(bag).difference
    assert difference is not None
    assert difference.time == pytest.approx(121 * TICK)
    assert "a fault latched at 12 s; rearming is not in a bag" in str(difference)


@pytest.mark.parametrize("tick", [0, 33])
def test_faults_that_were_injected_are_injected_again(tmp_path: Path, tick: int) -> None:
    """Into a flight that was sound: it differs from the tick on in which the fault begins."""
    lines = {
        round(tick * TICK * 1e9) + 7: "joint_slow slider_2 0.5",
        round((tick + 40) * TICK * 1e9): "joint_broken nothing",
    }
    difference = verify_bag(altered(BAG, tmp_path / "b.mcap", injected=lines)).difference
    assert difference is not None
    assert difference.time == pytest.approx((tick + 1) * TICK)
    assert difference.field == "position of slider_2"
    way = difference.recorded - difference.expected
    assert way == pytest.approx(difference.recorded - states_at(tick)[1] - way, rel=1e-6)
    assert (
        verify_bag(
            altered(BAG, tmp_path / "c.mcap", injected={0: "joint_stuck slider_2 at 900"})
        ).difference
        is None
    )


def states_at(tick: int) -> list[float]:
    """Return the recorded joint positions of a tick."""
    positions = read_bag(BAG)["/joint_states"].field("position")
    return [float(x) for x in positions[tick]]


def test_a_joint_that_the_robot_does_not_have_is_refused(tmp_path: Path) -> None:
    text = b'joint name="slider_2"', b'joint name="slider_two"'
    with pytest.raises(SpaceRobotError) as refusal:
        verify_bag(altered(BAG, tmp_path / "b.mcap", urdf=text))
    assert_one_sentence(str(refusal.value), "slider_2", "slider_two")


def test_a_bag_that_begins_in_mid_flight(tmp_path: Path) -> None:
    bag = BAG
    for topic in ("/odom", "/joint_states", "/momentum", "/base_pose"):
        name = f"{topic.strip('/')}.mcap"
        bag = altered(bag, tmp_path / name, topic, 0, lambda _: None)
    result = verify_bag(bag)
    assert result.difference is None
    assert result.ticks == TICKS - 1
    bag = altered(bag, tmp_path / "changed.mcap", "/odom", 7, moved)
    difference = verify_bag(bag).difference
    assert difference is not None
    assert difference.time == pytest.approx(8 * TICK)


def test_a_flight_under_efforts_that_begins_in_mid_flight_has_its_joint_rates(
    tmp_path: Path,
) -> None:
    whole = share_directory() / "bags" / "coordinated_control.mcap"
    # The robot starts at rest; half a second later its joints move.
    bag = altered(whole, tmp_path / "late.mcap", begin_ns=500_000_000)
    assert np.abs(read_bag(bag)["/joint_states"].field("velocity")[0]).min() > 1e-3
    result = verify_bag(bag, tolerance=1e-9)
    assert result.difference is None
    assert result.ticks == 842, "of 892 ticks, 50 come before"


@pytest.mark.parametrize(
    ("parameters", "mention"),
    [
        ({"time_mode": '"realtime"'}, "in real time"),
        ({"actuation": '"magic"'}, "'magic'"),
        ({"tick_rate": "not a number"}, "cannot be used: Expecting value"),
        ({"initial_position": '"here"'}, "cannot be used"),
        ({"tick_rate": "30.01"}, "between the ticks"),
    ],
)
def test_what_cannot_be_flown_again_is_refused(
    tmp_path: Path, parameters: dict[str, str], mention: str
) -> None:
    bag = altered(BAG, tmp_path / "b.mcap", parameters=parameters)
    with pytest.raises(SpaceRobotError) as refusal:
        verify_bag(bag)
    assert_one_sentence(str(refusal.value), mention)
