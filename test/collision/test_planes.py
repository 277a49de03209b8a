"""Distances from planes against exact ones, and their derivatives against differences."""

from __future__ import annotations

import numpy as np
import pytest
from support.slow import some_fast

from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.collision.distances import EnclosureDistances
from spacerobot_ros.collision.planes import PlaneDistance
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import robot_file

ROBOTS = some_fast(
    ["three_joint_arm", "seven_joint_arm", "dual_arm", "free_flyer", "solar_booms", "quadruped"],
    *("three_joint_arm", "dual_arm", "solar_booms"),
)


def shapes(geometry: CollisionGeometry, count: int) -> Array:
    robot = geometry.robot
    low = np.maximum(robot.limits("lower"), -3.0)
    high = np.minimum(robot.limits("upper"), 3.0)
    return np.random.default_rng(11).uniform(low, high, (count, len(low)))


def y_of(q: Array) -> Array:
    """Return what rows are functions of: without obstacles, the base may have any attitude."""
    return np.concatenate([q, [0.0, 0.0, 0.0, 1.0]])


def rows_of(geometry: CollisionGeometry, pair: int) -> PlaneDistance:
    center_of_mass = SpaceRobot(geometry.robot).function("center_of_mass", compile=False)
    return PlaneDistance.of(geometry, pair, center_of_mass)


def some_pairs(geometry: CollisionGeometry) -> list[int]:
    return list(range(0, len(geometry.pairs), 1 + len(geometry.pairs) // 5))


@pytest.mark.parametrize("enclosures", [False, True])
@pytest.mark.parametrize("name", ROBOTS)
def test_a_row_is_the_distance_where_its_plane_is_made(name: str, enclosures: bool) -> None:
    geometry = CollisionGeometry(load_robot(robot_file(name)))
    if enclosures:
        geometry.__dict__["distance_function"] = EnclosureDistances(geometry.solids)
    at, contacts = shapes(geometry, 120), 0
    poses = geometry.poses(at)
    for pair in some_pairs(geometry):
        row = rows_of(geometry, pair)
        distances, planes = geometry.planes(pair, poses)
        exact = geometry.distances(pair, poses)
        contacts += int((exact < 0).sum())
        np.testing.assert_allclose(distances, exact, atol=1e-12)
        np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0, atol=1e-9)
        found = [float(row.values(y_of(q), plane)) for q, plane in zip(at, planes, strict=True)]
        # Depths by coal are those of an iteration.
        np.testing.assert_allclose(found, exact, atol=2e-5)
    assert contacts or name != "dual_arm"


@pytest.mark.parametrize("name", ROBOTS)
def test_a_row_changes_as_the_distance_does(name: str) -> None:
    """Where solids are apart, and where their distance has a derivative at all."""
    geometry = CollisionGeometry(load_robot(robot_file(name)))
    at, step, compared = shapes(geometry, 12), 1e-5, 0
    for pair in some_pairs(geometry):
        row = rows_of(geometry, pair)
        distances, planes = geometry.planes(pair, geometry.poses(at))
        for q, d, plane in zip(at, distances, planes, strict=True):
            J = row.jacobian(y_of(q), plane).full()[0, : len(q)]
            moves = step * np.eye(len(q))
            after = geometry.distances(pair, geometry.poses(np.vstack([q + moves, q - moves])))
            ahead, behind = (after[: len(q)] - d) / step, (d - after[len(q) :]) / step
            if d > 0.02 and np.abs(ahead - behind).max() < 1e-3:
                compared += 1
                np.testing.assert_allclose((ahead + behind) / 2, J, atol=2e-3)
    assert compared > 5


def test_derivatives_are_those_of_differences() -> None:
    geometry = CollisionGeometry(load_robot(robot_file("seven_joint_arm")))
    step = 1e-6
    for pair in (0, 7, 20, 31):
        row, at = rows_of(geometry, pair), shapes(geometry, 4)
        _, planes = geometry.planes(pair, geometry.poses(at))
        # Away from the shapes that the planes were made for, too.
        for q, plane in zip(at[::-1], planes, strict=True):
            y = y_of(q)
            moves = step * np.eye(len(y))
            J = row.jacobian(y, plane).full()
            slope = [float(row.values(y + e, plane) - row.values(y - e, plane)) for e in moves]
            assert np.array([slope]) / (2 * step) == pytest.approx(J, abs=1e-7)
            bend = [
                (row.jacobian(y + e, plane) - row.jacobian(y - e, plane)).full()[0] for e in moves
            ]
            H = row.hessian(y, plane, -1.3).full()
            assert -1.3 * np.array(bend) / (2 * step) == pytest.approx(H, abs=1e-7)
