"""Nearest approaches along held commands against dense samples."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros.collision import CollisionGeometry, PathCheck
from spacerobot_ros.model import load_robot, parse_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import robot_file


def wandering(low: Array, high: Array, ticks: int, seed: int) -> Array:
    """Return shapes (ticks + 1, n) that move by up to a tenth of the range in a tick."""
    rng = np.random.default_rng(seed)
    low, high = np.maximum(low, -2.5), np.minimum(high, 2.5)
    knots = rng.uniform(low, high, (ticks // 8 + 2, len(low)))
    place = np.linspace(0, len(knots) - 1, ticks + 1)
    return np.column_stack([np.interp(place, np.arange(len(knots)), each) for each in knots.T])


@pytest.mark.parametrize("name", ["three_joint_arm", "free_flyer", "seven_joint_arm"])
def test_the_nearest_approach_is_that_of_dense_samples(name: str) -> None:
    robot = load_robot(robot_file(name))
    geometry = CollisionGeometry(robot)
    check = PathCheck(geometry)
    low, high = robot.limits("lower"), robot.limits("upper")
    for seed in (1, 2):
        positions = wandering(low, high, 24, seed)
        ticks = np.linspace(0, 24, 24 * 60 + 1)
        dense = np.column_stack([np.interp(ticks, np.arange(25), each) for each in positions.T])
        poses = geometry.poses(dense)
        sampled = np.array([geometry.distances(p, poses) for p in range(len(geometry.pairs))])
        nearest = check.nearest(positions)
        assert nearest is not None
        assert nearest.distance <= sampled.min() + 1e-9
        assert nearest.distance > sampled.min() - 0.02
        assert nearest.tick == pytest.approx(ticks[sampled.min(axis=0).argmin()], abs=0.3)
        at = geometry.distances(nearest.pair, geometry.poses(nearest.shape[np.newaxis]))
        assert at[0] == pytest.approx(nearest.distance, abs=1e-9)
        required = np.full(len(geometry.pairs), 0.03)
        required[nearest.pair] = -np.inf
        found = check.approaches(positions, required)
        assert [each.distance for each in found] == sorted(each.distance for each in found)
        below = {p for p in np.flatnonzero(sampled.min(axis=1) < 0.029) if p != nearest.pair}
        assert below <= {each.pair for each in found}
        assert all(each.distance < 0.03 for each in found)


CROSSING = """<robot name="crossing">
<link name="base"><inertial><mass value="9"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial></link>
<link name="left"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial><collision><geometry><sphere radius="0.05"/></geometry></collision></link>
<link name="right"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0"
 iyz="0"/></inertial><collision><geometry><sphere radius="0.07"/></geometry></collision></link>
<joint name="x" type="prismatic"><parent link="base"/><child link="left"/><axis xyz="1 0 0"/>
<limit lower="-2" upper="2" velocity="9" effort="1"/></joint>
<joint name="y" type="prismatic"><parent link="base"/><child link="right"/>
<origin xyz="0 0 0.15"/><axis xyz="0 1 0"/><limit lower="-2" upper="2" velocity="9" effort="1"/>
</joint></robot>"""


def test_a_contact_between_two_ticks_is_found() -> None:
    geometry = CollisionGeometry(parse_robot(CROSSING))
    # Both balls pass the middle at 1.4 ticks, 0.15 m apart, and are far away at every tick.
    positions = np.array([[-1.4, -0.7], [-0.4, -0.2], [0.6, 0.3], [0.7, 0.3]])
    found = PathCheck(geometry).approaches(positions, np.array([0.05]))
    assert [str(each) for each in found] == ["links 'left' and 'right' come within 0.03 m"]
    assert found[0].distance == pytest.approx(0.15 - 0.12, abs=1e-5)
    assert found[0].tick == pytest.approx(1.4, abs=0.01)
    assert PathCheck(geometry).approaches(positions, np.array([0.029])) == []


def test_a_single_shape_is_a_path() -> None:
    check = PathCheck(CollisionGeometry(parse_robot(CROSSING)))
    (found,) = check.approaches(np.zeros((1, 2)), np.array([0.05]))
    assert found.distance == pytest.approx(0.03, abs=1e-6)
    assert check.approaches(np.ones((1, 2)), np.array([0.05])) == []
