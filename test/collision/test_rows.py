"""Smooth distances against exact ones, and their derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from support.slow import some_fast

from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.collision.rows import DistanceRows
from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import robot_file


def shapes(geometry: CollisionGeometry, count: int) -> Array:
    robot = geometry.robot
    low = np.maximum(robot.limits("lower"), -3.0)
    high = np.minimum(robot.limits("upper"), 3.0)
    return np.random.default_rng(11).uniform(low, high, (count, len(low)))


@pytest.mark.parametrize(
    "name",
    some_fast(
        ["three_joint_arm", "seven_joint_arm", "dual_arm", "free_flyer", "solar_booms"],
        *("three_joint_arm", "dual_arm", "solar_booms"),
    ),
)
def test_rows_are_near_to_the_distances(name: str) -> None:
    geometry = CollisionGeometry(load_robot(robot_file(name)))
    pairs = list(range(0, len(geometry.pairs), 1 + len(geometry.pairs) // 5))
    rows, at = DistanceRows.of(geometry, pairs), shapes(geometry, 300)
    found = rows.values(at.T).full()
    poses = geometry.poses(at)
    for row, pair in zip(found, pairs, strict=True):
        exact = geometry.distances(pair, poses)
        assert np.all(np.isfinite(row))
        size = min(geometry.solids[i].enclosure.bounding_radius for i in geometry.pairs[pair])
        near = np.abs(exact) < 0.05
        # The signs agree but for a margin, and rows of pairs that are far away are large.
        assert np.abs(row[near] - exact[near]).max(initial=0.0) < 0.02 + 0.15 * size
        assert np.all(row[exact > 0.5] > 0.25)


def test_derivatives_are_those_of_differences() -> None:
    geometry = CollisionGeometry(load_robot(robot_file("seven_joint_arm")))
    pairs = [0, 7, 20, 31]
    rows, step = DistanceRows.of(geometry, pairs), 1e-6
    multipliers = np.array([0.7, -1.3, 2.1, 0.4])
    for q in shapes(geometry, 4):
        moves = step * np.eye(len(q))
        J = rows.jacobian(q).full()
        differences = [rows.values(q + e).full() - rows.values(q - e).full() for e in moves]
        assert np.hstack(differences) / (2 * step) == pytest.approx(J, abs=2e-5)
        H = rows.hessian(q, multipliers).full()
        of_gradient = [
            (rows.jacobian(q + e).full() - rows.jacobian(q - e).full()).T @ multipliers
            for e in moves
        ]
        scale = 1 + np.abs(H).max()
        assert np.column_stack(of_gradient) / (2 * step) / scale == pytest.approx(
            H / scale, abs=1e-4
        )
