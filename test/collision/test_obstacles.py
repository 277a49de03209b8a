"""Distances to obstacles: of balls at any pose of the base, in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.crossing import RADII, URDF

from spacerobot_ros.collision import BasePoses, CollisionGeometry, ObstaclePair, nearest_approaches
from spacerobot_ros.collision.planes import PlaneDistances
from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.urdf import parse_world, with_world
from spacerobot_ros.planning import RobotState
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.kept_distances import KeptDistances
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions
from spacerobot_ros.simulation.clearance import FlightClearance

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
MIDDLE, RADIUS = np.array([0.4, -0.3, 0.7]), 0.11
WORLD = f"""<robot name="world"><link name="w"/><link name="rock"><collision>
<origin xyz="0 0.2 0"/><geometry><sphere radius="{RADIUS}"/></geometry></collision></link>
<joint name="j" type="fixed"><parent link="w"/><child link="rock"/>
<origin xyz="{MIDDLE[0] + 0.2} {MIDDLE[1]} {MIDDLE[2]}" rpy="0 0 1.5707963267948966"/></joint>
</robot>"""


@pytest.fixture(scope="module")
def geometry() -> CollisionGeometry:
    return CollisionGeometry(with_world(parse_robot(URDF), parse_world(WORLD)))


def pair_of(geometry: CollisionGeometry, link: str) -> int:
    pairs = [geometry.links_of(k) for k in range(len(geometry.pairs))]
    return pairs.index(ObstaclePair(link, "rock"))


def left_ball_to_rock(shapes: Array, base: BasePoses) -> Array:
    """Return the distances (N,) of the ball on the slider x and the rock, m."""
    middles = left_middles(shapes, base)
    return np.asarray(np.linalg.norm(middles - MIDDLE, axis=1) - RADII[0] - RADIUS)


def moving(count: int) -> tuple[Array, BasePoses]:
    """Return shapes (N, 2) and poses of a base that turns and travels by the rock."""
    s = np.linspace(0.0, 1.0, count)[:, np.newaxis]
    shapes = np.hstack([0.4 - 0.3 * s, 0.2 + 0.5 * s])
    turns = Rotation.from_rotvec(np.array([0.3, -0.9, 0.4]) + s * np.array([0.2, -1.1, 0.5]))
    position = np.array([0.1, -0.5, -0.1]) + s * np.array([0.2, 0.15, 0.3])
    return shapes, BasePoses(position, turns.as_quat())


def test_pairs_with_obstacles_are_of_every_link(geometry: CollisionGeometry) -> None:
    pairs = [geometry.links_of(k) for k in range(len(geometry.pairs))]
    assert [each.subject for each in pairs] == [
        "links 'left' and 'right'",
        "link 'left' and obstacle 'rock'",
        "link 'right' and obstacle 'rock'",
    ]
    assert geometry.with_obstacles.tolist() == [False, True, True]
    # Without the pose of the base they are far away.
    assert geometry.nearest_along(np.array([[1.0, 1.0]]))[1] == 0


def test_distances_are_those_of_balls(geometry: CollisionGeometry) -> None:
    shapes, base = moving(40)
    pair = pair_of(geometry, "left")
    poses = geometry.poses(shapes, base)
    expected = left_ball_to_rock(shapes, base)
    assert geometry.distances(pair, poses) == pytest.approx(expected, abs=1e-9)
    assert (geometry.lower_bounds(poses)[:, pair] <= expected + 1e-12).all()


@pytest.mark.parametrize("ticks", [2, 3, 11])
def test_the_nearest_approach_is_between_the_ticks(geometry: CollisionGeometry, ticks: int) -> None:
    shapes, base = moving(ticks)
    pair = pair_of(geometry, "left")
    at = np.linspace(0.0, ticks - 1.0, 20001)
    before = np.minimum(at.astype(int), ticks - 2)
    share = (at - before)[:, np.newaxis]
    dense = (1 - share) * shapes[before] + share * shapes[before + 1]
    least = left_ball_to_rock(dense, base.between(before, share)).min()
    found = {each.pair: each for each in nearest_approaches(geometry, shapes, np.full(3, 9), base)}
    assert found[pair].distance == pytest.approx(least, abs=3e-4)
    place = found[pair].place_on_obstacle
    assert place is not None
    assert place == pytest.approx(MIDDLE)
    assert "link 'left' and obstacle 'rock' come within" in str(found[pair])
    assert str(found[pair]).endswith("near (0.400, -0.300, 0.700) m")
    none = nearest_approaches(geometry, shapes, np.full(3, least - 1e-3), base)
    assert pair not in [each.pair for each in none]


def test_planes_follow_the_turn_of_the_base(geometry: CollisionGeometry) -> None:
    robot = SpaceRobot(geometry.robot)
    pair = pair_of(geometry, "left")
    row = PlaneDistances.of(geometry, [pair])
    shapes, base = moving(7)
    start = Rotation.from_quat(base.quaternion[0])
    r_WC = base.position[0] + start.apply(robot.center_of_mass(shapes[0]))
    state = RobotState(base.position[0], base.quaternion[0], shapes[0])
    boundary = BoundaryConditions(shapes[0], IDENTITY, shapes[-1], state=state)
    prediction = BasePrediction(robot, 0.05, 0.05)
    clearance = Clearance(geometry.robot, 0.01)
    kept = KeptDistances(clearance, robot, prediction, boundary, turn_is_known=False)
    rng = np.random.default_rng(3)

    def distance(y: Array) -> float:
        R_WB = start * Rotation.from_quat(y[2:])
        r_WB = r_WC - R_WB.apply(robot.center_of_mass(y[:2]))
        at = BasePoses(r_WB[np.newaxis], R_WB.as_quat()[np.newaxis])
        return float(left_ball_to_rock(y[np.newaxis, :2], at)[0])

    for q, x in zip(shapes, rng.normal(size=(7, 4)), strict=True):
        R_WB = start * Rotation.from_quat(x)
        r_WB = r_WC - R_WB.apply(robot.center_of_mass(q))
        at = BasePoses(r_WB[np.newaxis], R_WB.as_quat()[np.newaxis])
        y = np.concatenate([q, x])
        (found,), (plane,) = kept.planes(pair, geometry.poses(q[np.newaxis], at))
        assert found == pytest.approx(distance(y), abs=1e-6)
        assert float(row.values(y, plane)) == pytest.approx(found, abs=1e-6)
        steps = 1e-6 * np.eye(6)
        # Of balls the distance from the plane changes as that of the balls does.
        slope = [(distance(y + e) - distance(y - e)) / 2e-6 for e in steps]
        assert row.jacobian(y, plane)[1].full()[0] == pytest.approx(slope, abs=1e-5)
        bend = [
            (row.jacobian(y + e, plane)[1] - row.jacobian(y - e, plane)[1]).full()[0] / 2e-6
            for e in steps
        ]
        assert row.hessian(y, plane, 2.0)[1].full() == pytest.approx(2 * np.array(bend), abs=1e-5)


def test_a_flight_by_an_obstacle_is_measured_and_touches_it(geometry: CollisionGeometry) -> None:
    """Poses come a tick later than shapes, and have one more: states of equal times count."""
    shapes, base = moving(81)
    # Before the rock the base goes straight on, so that the ball passes through it.
    toward = MIDDLE - np.array([0.05, 0.0, 0.02]) - left_middles(shapes, base)[40]
    base = BasePoses(base.position + toward, base.quaternion)
    time = np.linspace(0.0, 20.0, 81)
    poses = np.hstack([base.position, base.quaternion])
    found = FlightClearance.of(
        geometry.robot,
        ("y", "x"),
        (time, shapes),
        (np.append(time[1:], 30.0), np.vstack([poses[1:], poses[:1]])),
    )
    assert found is not None
    np.testing.assert_array_equal(found.time, time[1:])
    truth = left_ball_to_rock(shapes, base)
    assert found.nearest.links == ObstaclePair("left", "rock")
    assert found.nearest.distance == pytest.approx(truth.min(), abs=2e-3)
    touching = np.flatnonzero(truth <= 0)
    statuses = found.statuses(1)
    near = np.array([each.distance for each in statuses])
    np.testing.assert_allclose(near[touching - 1], truth[touching], atol=1e-6)
    assert statuses[touching[0] - 1].message.startswith("Link 'left' and obstacle 'rock' touch, ")


def left_middles(shapes: Array, base: BasePoses) -> Array:
    slid = np.column_stack([shapes[:, 1], np.zeros((len(shapes), 2))])
    return np.asarray(base.position + Rotation.from_quat(base.quaternion).apply(slid))
