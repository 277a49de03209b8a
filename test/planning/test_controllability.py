"""What closed motions turn: papers 1 to 3, against curvature by differences of another engine."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from planning.sliding_robots import SlidingRobot, paper_robot, random_sliding_robot
from support.oracles import PinocchioOracle
from support.planner_loop import robot_of
from support.random_robots import random_robot_urdf

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import METHODS, GaitMethod
from spacerobot_ros.planning.core.controllability import (
    best_sampled_brackets,
    best_triple,
    brackets_at,
    check_sliding_masses,
    curvature_matrices,
    curvatures,
    independent_slots,
    sample_shapes,
)
from spacerobot_ros.planning.methods.square_path import check_planar_chain


def bracket(oracle: PinocchioOracle, q: Array, i: int, j: int) -> Array:
    """Return ``dF_j/dq_i - dF_i/dq_j + F_i x F_j`` (3,), F the base rate of unit joint rates."""
    h, unit = 1e-5, np.eye(oracle.n)

    def F(at: Array, column: int) -> Array:
        return oracle.base_twist(at, unit[column])[3:]

    def slope(column: int, along: int) -> Array:
        return (F(q + h * unit[along], column) - F(q - h * unit[along], column)) / (2 * h)

    return slope(j, i) - slope(i, j) + np.cross(F(q, i), F(q, j))


@pytest.mark.parametrize(("seed", "joints"), [(1, 3), (2, 5)])
def test_curvatures_of_many_shapes_at_once(seed: int, joints: int) -> None:
    urdf = random_robot_urdf(np.random.default_rng(seed), joints)
    robot = SpaceRobot.from_urdf(urdf)
    oracle = PinocchioOracle(urdf, robot.joint_names)
    shapes = sample_shapes(robot, 3)
    K = curvatures(robot, shapes)
    assert K.shape == (3, 3, joints, joints)
    for k, q in enumerate(shapes):
        for i, j in itertools.permutations(range(joints), 2):
            np.testing.assert_allclose(K[k, :, i, j], bracket(oracle, q, i, j), atol=1e-7)
        M = curvature_matrices(K[k], (0, 2, 1))
        columns = [K[k, :, 0, 2], K[k, :, 2, 1], K[k, :, 1, 0]]
        np.testing.assert_array_equal(M, np.column_stack(columns))


def test_samples_are_within_the_limits_and_spread() -> None:
    robot = robot_of("three_joint_arm")
    shapes = sample_shapes(robot, 200)
    assert np.all(shapes >= robot.lower)
    assert np.all(shapes <= robot.upper)
    for column, low, high in zip(shapes.T, robot.lower, robot.upper, strict=True):
        counts, _ = np.histogram(column, 5, (low, high))
        assert counts.min() > 30
    # A joint that turns for ever is looked at once round.
    chain = sample_shapes(robot_of("planar_chain"), 200)
    assert np.ptp(chain, axis=0) == pytest.approx(2 * np.pi, rel=0.05)


def test_the_best_three_brackets_have_the_smallest_condition_number() -> None:
    robot = SpaceRobot.from_urdf(random_robot_urdf(np.random.default_rng(4), 5))
    shape = sample_shapes(robot, 1)[0]
    K = robot.curvature(shape)[3:]
    conditions = {
        (i, j, k): np.linalg.cond(np.column_stack([K[:, i, j], K[:, j, k], K[:, k, i]]))
        for i, j, k in itertools.combinations(range(5), 3)
    }
    triple, M = best_triple(K, range(5))
    assert triple == min(conditions, key=lambda names: conditions[names])
    found = brackets_at(robot, shape)
    assert found.controllable
    assert found.condition == pytest.approx(conditions[triple])
    assert found.joints == tuple(robot.joint_names[i] for i in triple)
    assert found.condition == pytest.approx(np.linalg.cond(M))
    assert f"at the shape {np.round(shape, 4).tolist()}" in found.message
    assert "at the best of 24 shapes" in best_sampled_brackets(robot).message


def test_the_papers_sliding_masses() -> None:
    # Paper 1, section 4.2: at z = 0 without offsets the brackets span, J^-1 times the body axes.
    at_rest = brackets_at(robot_of("sliding_masses"), np.zeros(3))
    assert at_rest.controllable
    np.testing.assert_allclose(at_rest.singular_values, 0.5 / np.array([1, 1.5, 1.5]), rtol=1e-9)
    assert check_sliding_masses(robot_of("sliding_masses")).controllable


@pytest.mark.parametrize("seed", range(3))
def test_almost_all_offsets_are_controllable(seed: int) -> None:
    robot = random_sliding_robot(np.random.default_rng(seed), 3)
    found = check_sliding_masses(SpaceRobot.from_urdf(robot.urdf))
    assert (found.rank, found.required_rank, found.controllable) == (3, 3, True)


def test_planar_robots_turn_about_one_axis() -> None:
    chain = check_planar_chain(robot_of("planar_chain"))
    assert (chain.rank, chain.required_rank, chain.controllable) == (1, 1, True)
    # At the paper's peak, the entries of its pair in the right order.
    assert chain.singular_values[0] == pytest.approx(0.5376, abs=5e-5)
    np.testing.assert_allclose(np.degrees(np.abs(chain.shape)), [153, 121], atol=0.6)
    assert str(np.round(chain.shape, 3).tolist()) in chain.message
    assert best_sampled_brackets(robot_of("planar_chain")).rank == 1
    arm = check_planar_chain(robot_of("three_joint_arm"))
    assert not arm.controllable
    assert "not planar" in arm.message


def test_a_robot_of_one_joint_encloses_no_area() -> None:
    one = SpaceRobot.from_urdf(random_robot_urdf(np.random.default_rng(0), 1))
    found = best_sampled_brackets(one)
    assert (found.rank, found.controllable, found.condition) == (0, False, np.inf)
    assert "no loop encloses an area" in found.message


def objection(method: type[GaitMethod], robot: SpaceRobot) -> str:
    try:
        method.require_suitable(robot)
    except PlanningError as refusal:
        return str(refusal)
    return ""


@pytest.mark.parametrize(
    ("name", "suits"),
    [
        ("sliding_masses", {"lie_bracket", "area_loop"}),
        ("three_joint_arm", {"area_loop"}),
        ("planar_chain", {"square_path"}),
        ("planar_manipulator", {"square_path"}),
    ],
)
def test_which_methods_suit_the_robots_of_the_papers(name: str, suits: set[str]) -> None:
    robot = robot_of(name)
    methods = ("lie_bracket", "square_path", "area_loop")
    objections = {method: objection(METHODS[method], robot) for method in methods}
    assert {method for method in methods if not objections[method]} == suits
    for sentence in filter(None, objections.values()):
        assert name in sentence
        assert sentence.endswith(".")


@pytest.mark.parametrize("robot", ["planar_chain", "sliding_masses"])
def test_with_one_joint_none_of_the_three_axes_is_spanned(robot: str) -> None:
    found = best_sampled_brackets(robot_of(robot), among=[1])
    assert (found.rank, found.required_rank, found.joints) == (0, 3, ())
    assert not found.controllable
    assert found.singular_values.tolist() == [0.0, 0.0, 0.0]
    assert found.condition == np.inf
    with pytest.raises(PlanningError, match=r"has 1 joint: no loop encloses an area"):
        found.require()


def with_third_slot(tilt: float) -> SlidingRobot:
    """Return the robot with its third slot tilted out of the plane of the other two."""
    robot = paper_robot()
    slots = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.6, 0.8, tilt]])
    sliders = tuple(
        replace(slider, direction=slot / np.linalg.norm(slot))
        for slider, slot in zip(robot.sliders, slots, strict=True)
    )
    return replace(robot, sliders=sliders)


def test_slots_count_by_their_directions_and_not_by_their_size() -> None:
    heavy = replace(paper_robot(), mass=1e10 * paper_robot().mass)
    slots = independent_slots(SpaceRobot.from_urdf(heavy.urdf))
    assert 0.0 < np.abs(slots).max() < 1e-9
    independent_slots(SpaceRobot.from_urdf(with_third_slot(1e-7).urdf))
    for thin in (1e-10, 0.0):
        with pytest.raises(PlanningError, match="have rank 2"):
            independent_slots(SpaceRobot.from_urdf(with_third_slot(thin).urdf))


def test_brackets_count_by_their_directions_and_not_by_their_size() -> None:
    """A base that is a thousand times as heavy turns as little, and still about three axes; where
    all slots are almost in one plane, the brackets turn it about one, however much."""
    q = np.array([0.3, -0.2, 0.25])
    robot = paper_robot()
    heavy = replace(robot, mass=1e3 * robot.mass, inertia=1e3 * robot.inertia)
    found = brackets_at(SpaceRobot.from_urdf(heavy.urdf), q)
    assert found.rank == 3
    assert found.singular_values.max() < 1e-5
    for tilt, rank in ((1e-2, 3), (1e-8, 1)):
        flat = SpaceRobot.from_urdf(with_third_slot(tilt).urdf)
        assert brackets_at(flat, q).rank == rank, tilt


@pytest.mark.parametrize("joints", [3, 4, 6])
def test_the_best_three_of_any_curvature_have_the_smallest_condition_number(joints: int) -> None:
    rng = np.random.default_rng(joints)
    for _ in range(20):
        K = rng.normal(size=(3, joints, joints))
        K -= K.transpose(0, 2, 1)
        triple, M = best_triple(K, range(joints))
        conditions = [
            np.linalg.cond(np.column_stack([K[:, i, j], K[:, j, k], K[:, k, i]]))
            for i, j, k in itertools.combinations(range(joints), 3)
        ]
        assert np.linalg.cond(M) == pytest.approx(min(conditions))
        assert triple in set(itertools.combinations(range(joints), 3))
