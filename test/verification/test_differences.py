"""What counts as a difference between a bag and its re-simulation, at the borders of the rule.

The bags are reference bags in which single numbers are changed by the mcap library.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from support.altered_bags import altered

from spacerobot_ros.flight.verification import Difference, verify_bag
from spacerobot_ros.resources import share_directory

BAGS = share_directory() / "bags"
BAG = BAGS / "sliding_masses.mcap"


def found(tmp_path: Path, topic: str, number: int, change: Any) -> Difference | None:
    return verify_bag(altered(BAG, tmp_path / "altered.mcap", topic, number, change)).difference


def test_a_quaternion_means_the_same_with_either_sign(tmp_path: Path) -> None:
    def negated(message: Any) -> Any:
        q = message.pose.pose.orientation
        assert q.w > 0.5
        q.x, q.y, q.z, q.w = -q.x, -q.y, -q.z, -q.w
        return message

    assert found(tmp_path, "/odom", 120, negated) is None


def test_the_opposite_rotation_is_a_difference(tmp_path: Path) -> None:
    def conjugated(message: Any) -> Any:
        q = message.pose.pose.orientation
        assert abs(q.x) > 1e-4
        q.x, q.y, q.z = -q.x, -q.y, -q.z
        return message

    difference = found(tmp_path, "/odom", 120, conjugated)
    assert difference is not None
    assert difference.field == "pose.pose.orientation.x"


def test_a_number_that_is_none_is_a_difference(tmp_path: Path) -> None:
    def lost(message: Any) -> Any:
        message.twist.twist.linear.z = math.nan
        return message

    difference = found(tmp_path, "/odom", 120, lost)
    assert difference is not None
    assert difference.topic == "/odom"
    assert difference.time == pytest.approx(12.0)


def test_the_very_first_state_is_compared(tmp_path: Path) -> None:
    def moved(message: Any) -> Any:
        message.position[1] += 1e-6
        return message

    difference = found(tmp_path, "/joint_states", 0, moved)
    assert difference is not None
    assert (difference.time, difference.field) == (0.0, "position of slider_2")


@pytest.mark.parametrize(("row", "least", "most"), [(256, 7.0, 9.0), (32, 0.2, 0.3)])
@pytest.mark.parametrize(("share", "differs"), [(0.9, False), (1.1, True)])
def test_deviations_count_as_a_share_above_one_and_as_they_are_below(
    row: int, least: float, most: float, share: float, differs: bool, tmp_path: Path
) -> None:
    tolerance = 1e-6

    def changed(message: Any) -> Any:
        energy = message.data[6]
        assert least < energy < most
        message.data[6] += share * tolerance * max(1.0, energy)
        return message

    planar = BAGS / "planar_chain.mcap"
    result = verify_bag(
        altered(planar, tmp_path / "altered.mcap", "/momentum", row, changed), tolerance
    )
    assert (result.difference is not None) == differs
    if not differs:
        assert result.largest == pytest.approx(share * tolerance, rel=1e-6)
        assert result.largest_at is not None
        assert result.largest_at.field == "kinetic energy"
