"""Nearest approaches along commands, beside bodies that spin, and bounds by rounded boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.crossing import HEIGHT, RADII, URDF

from spacerobot_ros.collision import (
    BasePoses,
    CollisionGeometry,
    nearest_approach,
    nearest_approaches,
)
from spacerobot_ros.collision.distances import RoundedBox, widest_gaps
from spacerobot_ros.model import RobotDescription, load_robot, parse_robot
from spacerobot_ros.model.description import Array, Pose, Shape
from spacerobot_ros.model.rotations import matrix_from_rpy
from spacerobot_ros.model.urdf import parse_world, with_world
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
    low, high = robot.limits("lower"), robot.limits("upper")
    for seed in (1, 2):
        positions = wandering(low, high, 24, seed)
        ticks = np.linspace(0, 24, 24 * 60 + 1)
        dense = np.column_stack([np.interp(ticks, np.arange(25), each) for each in positions.T])
        poses = geometry.poses(dense)
        sampled = np.array([geometry.distances(p, poses) for p in range(len(geometry.pairs))])
        nearest = nearest_approach(geometry, positions)
        assert nearest is not None
        assert nearest.distance <= sampled.min() + 1e-9
        assert nearest.distance > sampled.min() - 0.02
        assert nearest.tick == pytest.approx(ticks[sampled.min(axis=0).argmin()], abs=0.3)
        at = geometry.distances(nearest.pair, geometry.poses(nearest.shape[np.newaxis]))
        assert at[0] == pytest.approx(nearest.distance, abs=1e-9)
        required = np.full(len(geometry.pairs), 0.03)
        required[nearest.pair] = -np.inf
        found = nearest_approaches(geometry, positions, required)
        assert [each.distance for each in found] == sorted(each.distance for each in found)
        below = {p for p in np.flatnonzero(sampled.min(axis=1) < 0.029) if p != nearest.pair}
        assert below <= {each.pair for each in found}
        assert all(each.distance < 0.03 for each in found)


def test_a_contact_between_two_ticks_is_found() -> None:
    geometry = CollisionGeometry(parse_robot(URDF))
    # One ball passes the other at 1.4 ticks, 0.15 m apart, and is far away at every tick.
    beside = math.sqrt(0.15**2 - HEIGHT**2)
    positions = np.array([[beside, -1.4], [beside, -0.4], [beside, 0.6], [beside, 0.7]])
    found = nearest_approaches(geometry, positions, np.array([0.05]))
    assert [str(each) for each in found] == ["links 'left' and 'right' come within 30 mm"]
    assert found[0].distance == pytest.approx(0.15 - 0.12, abs=1e-5)
    assert found[0].tick == pytest.approx(1.4, abs=0.01)
    assert nearest_approaches(geometry, positions, np.array([0.029])) == []


def test_a_single_shape_is_a_path() -> None:
    geometry = CollisionGeometry(parse_robot(URDF))
    (found,) = nearest_approaches(geometry, np.zeros((1, 2)), np.array([0.05]))
    assert found.distance == pytest.approx(HEIGHT - sum(RADII), abs=1e-6)
    assert nearest_approaches(geometry, np.ones((1, 2)), np.array([0.05])) == []


INERTIA = (
    '<inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="2" ixy="0" ixz="0" iyz="0"/>'
    "</inertial>"
)


def telescope() -> RobotDescription:
    """Return a ball on a slider on a turntable, and another ball on the base, 2 m from its axis."""
    ball = '<collision><origin xyz="{}"/><geometry><sphere radius="0.1"/></geometry></collision>'
    post = ball.format(f"{2 * math.cos(0.3)} {2 * math.sin(0.3)} 0")
    limit = '<limit lower="-3" upper="3" velocity="9" effort="1"/>'
    return parse_robot(
        f"""<robot name="telescope"><link name="base">{INERTIA}{post}</link>
<link name="table">{INERTIA}</link><link name="ball">{INERTIA}{ball.format("0 0 0")}</link>
<joint name="turn" type="revolute"><parent link="base"/><child link="table"/>
<axis xyz="0 0 1"/>{limit}</joint>
<joint name="slide" type="prismatic"><parent link="table"/><child link="ball"/>
<axis xyz="1 0 0"/>{limit}</joint></robot>"""
    )


def test_what_a_slider_carries_out_sweeps_farther_in_a_tick() -> None:
    """Both ends of the tick are far from the post; the ball on the extended slider passes it."""
    geometry = CollisionGeometry(telescope())
    (found,) = nearest_approaches(geometry, np.array([[0.0, 2.0], [0.6, 2.0]]), np.array([0.01]))
    assert (found.tick, found.distance) == pytest.approx((0.5, -0.2), abs=1e-4)


@pytest.mark.parametrize(
    ("place", "turn"), [((1.0, 0.0, 0.0), 0.0), ((0.0, 0.0, 0.0), 0.6)], ids=["moves", "turns"]
)
def test_obstacles_are_met_between_ticks_where_the_base_moves_or_turns(
    place: tuple[float, float, float], turn: float
) -> None:
    """A contact 5 cm deep in the middle of a tick, at whose ends 0.2 m and more are free."""
    path = np.array([[0.0, -2.0], [0.0, -2.0]])
    # The middle of the way of the ball, and 0.25 m beyond it, across the way.
    middle = np.array([-1.5, 0.25, 0.0])
    if turn:
        middle = -2.25 * np.array([math.cos(turn / 2), math.sin(turn / 2), 0.0])
    world = parse_world(
        f"""<robot name="world"><link name="rock"><collision>
<origin xyz="{middle[0]} {middle[1]} {middle[2]}"/><geometry><sphere radius="0.2"/></geometry>
</collision></link></robot>"""
    )
    geometry = CollisionGeometry(with_world(telescope(), world))
    turned = [0.0, 0.0, math.sin(turn / 2), math.cos(turn / 2)]
    base = BasePoses(np.array([[0.0, 0.0, 0.0], place]), np.array([[0.0, 0.0, 0.0, 1.0], turned]))
    required = np.full(len(geometry.pairs), 0.01)
    found = nearest_approaches(geometry, path, required, base)
    assert [each.links.subject for each in found] == ["link 'ball' and obstacle 'rock'"]
    assert (found[0].tick, found[0].distance) == pytest.approx((0.5, -0.05), abs=1e-4)


# -- bodies of revolution that spin in place come no nearer -------------------------------------


def robot(origin: str = "0 0 0.2", rpy: str = "0 0 0", shape: str = "") -> RobotDescription:
    """Return a disc that turns about z of its joint, beside a post on a slider."""
    shape = shape or '<cylinder radius="0.3" length="0.1"/>'
    return parse_robot(
        f"""<robot name="spinner">
<link name="base">{INERTIA}</link>
<link name="disc">{INERTIA}<collision><origin xyz="{origin}" rpy="{rpy}"/><geometry>{shape}
</geometry></collision></link>
<link name="post">{INERTIA}<collision><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="spin" type="continuous"><parent link="base"/><child link="disc"/>
<origin xyz="0.4 0 0"/><axis xyz="0 0 1"/><limit velocity="9" effort="1"/></joint>
<joint name="slide" type="prismatic"><parent link="base"/><child link="post"/>
<origin xyz="1.0 0 0.2"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="9" effort="1"/></joint></robot>"""
    )


@pytest.mark.parametrize(
    ("changes", "reach"),
    [
        ({}, 0.0),
        ({"shape": '<sphere radius="0.3"/>', "rpy": "0.4 0.3 0"}, 0.0),
        ({"rpy": "0.2 0 0"}, 0.3),
        ({"origin": "0.05 0 0.2"}, 0.3),
        ({"shape": '<box size="0.5 0.5 0.1"/>'}, 0.3),
    ],
)
def test_only_what_leaves_its_place_can_come_nearer(changes: dict[str, str], reach: float) -> None:
    geometry = CollisionGeometry(robot(**changes))
    ((spin, slide),), _ = geometry.largest_lever_arms(np.array([[0.0, 0.3], [50.0, -0.2]]))
    assert slide == 1.0
    assert spin == 0.0 if reach == 0.0 else spin > reach


def test_a_joint_that_moves_both_bodies_brings_none_nearer() -> None:
    """The disc spins in place, and the arm on it goes round with it."""
    arm = parse_robot(
        f"""<robot name="turret">
<link name="base">{INERTIA}</link>
<link name="disc">{INERTIA}<collision><geometry><cylinder radius="0.3" length="0.1"/></geometry>
</collision></link>
<link name="upper">{INERTIA}</link>
<link name="tip">{INERTIA}<collision><geometry><sphere radius="0.1"/></geometry></collision></link>
<joint name="turn" type="continuous"><parent link="base"/><child link="disc"/><axis xyz="0 0 1"/>
<limit velocity="9" effort="1"/></joint>
<joint name="lift" type="revolute"><parent link="disc"/><child link="upper"/>
<origin xyz="0.2 0 0.3"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="9" effort="1"/>
</joint>
<joint name="bend" type="revolute"><parent link="upper"/><child link="tip"/>
<origin xyz="0.5 0 0"/><axis xyz="0 1 0"/><limit lower="-1" upper="1" velocity="9" effort="1"/>
</joint></robot>"""
    )
    geometry = CollisionGeometry(arm)
    ((turn, lift, bend),), _ = geometry.largest_lever_arms(np.zeros((1, 3)))
    assert turn == 0.0
    assert lift > 0.5
    assert bend == 0.0, "a ball about its joint stays where it is"


def test_the_nearest_approach_beside_a_fast_wheel_is_found_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    geometry = CollisionGeometry(robot())
    ticks = np.arange(41)
    path = np.column_stack([300.0 * ticks, np.linspace(-1.1, 1.5, 41)])
    asked: list[int] = []
    distances = geometry.distances

    def counted(pair: int, poses: object) -> object:
        found = distances(pair, poses)  # type: ignore[arg-type]
        asked.append(len(found))
        return found

    monkeypatch.setattr(geometry, "distances", counted)
    nearest = nearest_approach(geometry, path)
    assert nearest is not None
    # Between disc and post along x, 0.6 m apart: their radii are 0.3 m and 0.1 m.
    assert nearest.distance == pytest.approx(0.2, abs=1e-3)
    assert sum(asked) < 400


# -- bounds by rounded boxes against distances by coal and by geometry ---------------------------


coal = pytest.importorskip("coal")

Triple = tuple[float, float, float]
Form = tuple[str, tuple[float, ...]]

SIZES = st.floats(0.02, 1.5)
PLACES = st.tuples(*[st.floats(-2.0, 2.0)] * 3)
TURNS = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
SHAPES = st.one_of(
    st.tuples(st.just("box"), st.tuples(SIZES, SIZES, SIZES)),
    st.tuples(st.just("sphere"), st.tuples(SIZES)),
    st.tuples(st.just("cylinder"), st.tuples(SIZES, SIZES)),
)
OFFSET = Pose(matrix_from_rpy([0.3, -0.7, 1.1]), np.array([0.2, -0.1, 0.4]))


def exact(kind: str, size: tuple[float, ...]) -> object:
    return {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}[kind](*size)


def coal_distance(one: object, at: Pose, other: object, there: Pose) -> float:
    poses = [coal.Transform3s(pose.R, pose.r) for pose in (at, there)]
    return float(
        coal.distance(one, poses[0], other, poses[1], coal.DistanceRequest(), coal.DistanceResult())
    )


def bound(one: RoundedBox, at: Pose, other: RoundedBox, there: Pose) -> float:
    R_1, r_1, R_2, r_2 = (x[np.newaxis] for x in (at.R, at.r, there.R, there.r))
    return float(widest_gaps(one, R_1, r_1, other, R_2, r_2)[0][0])


@settings(max_examples=150, deadline=None)
@given(SHAPES, SHAPES, PLACES, TURNS)
def test_the_bound_is_not_above_the_exact_distance(
    one: Form, other: Form, place: Triple, turn: Triple
) -> None:
    shapes = [Shape(kind, size, OFFSET) for kind, size in (one, other)]
    link = Pose(matrix_from_rpy(turn), np.array(place))
    found = bound(RoundedBox.around(shapes[0]), Pose(), RoundedBox.around(shapes[1]), link)
    true = coal_distance(exact(*one), OFFSET, exact(*other), link @ OFFSET)
    # Depths of coal are those of an iteration.
    assert found <= max(true, 0.0) + 1e-5


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.tuples(SIZES, SIZES, SIZES), st.tuples(SIZES, SIZES, SIZES), PLACES, TURNS)
def test_the_bound_of_boxes_that_are_apart_is_their_distance(
    one: Triple, other: Triple, place: Triple, turn: Triple
) -> None:
    boxes = [RoundedBox(OFFSET, np.array(size) / 2) for size in (one, other)]
    link = Pose(matrix_from_rpy(turn), np.array(place))
    true = coal_distance(coal.Box(*one), OFFSET, coal.Box(*other), link @ OFFSET)
    found = bound(boxes[0], Pose(), boxes[1], link)
    assert found <= max(true, 0.0) + 1e-5
    if true > 0.05:
        assert found == pytest.approx(true, rel=0.05)


def test_capsules_at_right_angles_are_as_far_as_their_lines() -> None:
    one = RoundedBox(Pose(), np.array([0.5, 0.0, 0.0]), 0.1)
    other = RoundedBox(Pose(), np.array([0.0, 0.7, 0.0]), 0.2)
    assert bound(one, Pose(), other, Pose(r=np.array([0.3, 0.4, 0.9]))) == pytest.approx(0.6)
    # Beyond the end of the first: a corner of a triangle with sides 0.4 and 0.9.
    beyond = bound(one, Pose(), other, Pose(r=np.array([0.9, 0.1, -0.9])))
    assert beyond == pytest.approx(math.hypot(0.4, 0.9) - 0.3)


def test_the_bound_of_overlapping_boxes_is_minus_their_depth() -> None:
    one = RoundedBox(Pose(), np.array([1.0, 2.0, 3.0]))
    other = RoundedBox(Pose(), np.array([0.5, 0.4, 0.3]))
    assert bound(one, Pose(), other, Pose(r=np.array([1.3, 0.2, 0.1]))) == pytest.approx(-0.2)


def test_a_capsule_is_its_own_bound() -> None:
    radius, length = 0.2, 0.6
    box = RoundedBox.around(Shape("capsule", (radius, length), OFFSET))
    assert box.volume == pytest.approx(math.pi * radius**2 * (length + 4 / 3 * radius))
    # End to end, its balls are 0.9 m apart.
    along = Pose(r=OFFSET.R @ [0.0, 0.0, 0.9 + length])
    assert bound(box, Pose(), box, along) == pytest.approx(0.9 - 2 * radius)


def test_edges_that_cross_overlap_by_their_heights() -> None:
    """Beams that lie on their edges, one across the other at 30 degrees."""
    rest = Pose(matrix_from_rpy([math.pi / 4, 0.0, 0.0]))
    beam = RoundedBox(rest, np.array([2.0, 0.1, 0.1]))
    height = 0.1 * math.sqrt(2)
    for depth in (0.01, 0.03):
        above = Pose(matrix_from_rpy([0, 0, math.pi / 6]), np.array([0, 0, 2 * height - depth]))
        assert bound(beam, Pose(), beam, above) == pytest.approx(-depth)


@pytest.mark.parametrize("squash", [(1.0, 1.0, 1.0), (0.05, 0.05, 1.0), (1.0, 0.4, 0.0)])
def test_a_mesh_is_enclosed(squash: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(5)
    points: Array = rng.normal(size=(40, 3)) * squash @ OFFSET.R.T + OFFSET.r
    box = RoundedBox.around(Shape("mesh", (1.0, 1.0, 1.0), OFFSET), points)
    local = (points - box.pose.r) @ box.pose.R
    outside = np.linalg.norm(np.maximum(np.abs(local) - box.half, 0.0), axis=1)
    assert outside.max() <= box.radius + 1e-12
    ball = np.linalg.norm(points - box.pose.r, axis=1).max()
    assert ball <= box.bounding_radius + 1e-12
    # As small as a box along the axes that the points were drawn along.
    plain = np.prod(np.ptp((points - OFFSET.r) @ OFFSET.R, axis=0))
    assert box.volume <= plain + 1e-12
