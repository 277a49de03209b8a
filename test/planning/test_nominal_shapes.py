"""Nominal shapes of loops for a robot whose curvature is a formula, and ranks of few joints."""

from __future__ import annotations

import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model.description import JointKind
from spacerobot_ros.planning.core.controllability import _span_of_brackets, sample_shapes
from spacerobot_ros.planning.methods import nominal_shape as module
from spacerobot_ros.planning.methods.nominal_shape import (
    NominalShape,
    NominalShapeChooser,
    best_nominal,
    nominal_at_shape,
)

Array = npt.NDArray[np.float64]

FREE = np.inf
LEVI_CIVITA = np.zeros((3, 3, 3))
for _i, _j, _k in itertools.permutations(range(3)):
    LEVI_CIVITA[_i, _j, _k] = np.linalg.det(np.eye(3)[[_i, _j, _k]])


def robot_with(
    lower: list[float], upper: list[float], peak: list[float], still: int | None = None
) -> Any:
    """Return a robot of revolute joints whose loops turn the base most at a shape.

    Loops of joints i, j of the first three turn it about the third axis by
    ``exp(-|q - peak|^2)`` per area, loops with others by a tenth of that.
    """
    n, middle = len(lower), np.array(peak)

    def curvature(shapes: Array) -> Any:
        weight = np.exp(-np.sum((shapes.T - middle) ** 2, axis=1))
        K = np.zeros((len(weight), 3, n, n))
        for number, triple in enumerate(itertools.combinations(range(n), 3)):
            share = 1.0 if number == 0 else 0.1 / number
            for a, b in itertools.permutations(range(3), 2):
                K[:, :, triple[a], triple[b]] += share * LEVI_CIVITA[:, a, b] * weight[:, None]
        columns = K.transpose(1, 0, 3, 2).reshape(3, -1)
        return SimpleNamespace(full=lambda: np.vstack([np.zeros_like(columns), columns]))

    names = tuple(f"joint_{k}" for k in range(n))
    velocity = np.ones(n)
    if still is not None:
        velocity[still] = 0.0
    joints = [SimpleNamespace(name=name, kind=JointKind.REVOLUTE) for name in names]
    return SimpleNamespace(
        n=n,
        joint_names=names,
        lower=np.array(lower),
        upper=np.array(upper),
        velocity_limit=velocity,
        description=SimpleNamespace(name="formula", movable_joints=joints),
        function=lambda *_, **__: curvature,
    )


def three(peak: list[float] | None = None) -> Any:
    return robot_with([-1.0, -2.0, -0.5], [1.4, 2.0, 2.5], peak or [0.31, -0.47, 0.82])


def test_the_best_shape_of_three_joints_is_found_to_a_thousandth_of_their_ranges() -> None:
    found = best_nominal(three(), np.zeros(3), [(0, 1, 2)], 0.4)
    np.testing.assert_allclose(found.shape, [0.31, -0.47, 0.82], atol=2e-3)
    np.testing.assert_allclose(found.longest, 0.4)
    # Pairs (1, 2), (2, 3) and (3, 1) turn it about the third, first and second axis.
    np.testing.assert_allclose(found.M, np.eye(3)[[1, 2, 0]], atol=1e-4)
    assert found.condition == pytest.approx(1.0)
    np.testing.assert_allclose(found.singular_values, 1.0, atol=1e-4)


def test_near_the_end_of_a_joint_room_for_loops_counts_as_well() -> None:
    """Edges are at most twice the way to the end, so the best shape is away from it."""
    robot = three([1.4, 0.0, 1.0])
    found = best_nominal(robot, np.zeros(3), [(0, 1, 2)], 2.0)
    edge = 2 * (1.4 - found.shape[0])
    assert found.longest[0] == pytest.approx(edge)
    assert 0.3 < edge < 1.5
    np.testing.assert_allclose(found.longest[1:], 2.0)
    # The worst axis is turned by edges 0 and 1 or 0 and 2: e^(-x^2) 2 x is largest at x^2 = 1/2.
    assert found.shape[0] == pytest.approx(1.4 - np.sqrt(0.5), abs=5e-3)


def test_of_equally_good_shapes_the_most_central_one_is_taken() -> None:
    at = np.array([[0.0, 0, 0], [0.5, 0.1, 0], [0.5, 0, 0], [1.0, 0, 0], [0.45, 0, 0]])
    measures = np.array([1.0, 1.0, 1.0 - 0.9e-6, 1.0, 1.0 - 1.1e-6])
    assert module._most_central_index(at, measures, np.array([0.46, 0.0, 0.0])) == 2


@pytest.mark.parametrize(("triples", "points"), [(1, 11), (2, 7), (3, 5), (8, 5)])
def test_grids_are_coarser_for_more_triples(
    triples: int, points: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []

    def best(*given: Any) -> NominalShape:
        asked.append(given[4])
        return NominalShape(np.zeros(3), given[2], np.eye(3), np.ones(3))

    monkeypatch.setattr(module, "_best_shape_of_triple", best)
    best_nominal(three(), np.zeros(3), [(0, 1, 2)] * triples, 1.0)
    assert asked == [points] * triples


def test_of_many_triples_the_eight_best_are_looked_at_closely() -> None:
    robot = robot_with([-1.0] * 5, [1.2] * 5, [0.1, 0.2, -0.1, 0.0, 0.3])
    triples = list(itertools.combinations(range(5), 3))
    assert len(triples) == 10
    chosen = module._select_best_triples(robot, triples[::-1], 0.5)
    assert len(chosen) == 8
    assert chosen[0] == (0, 1, 2)
    assert len(set(chosen)) == 8
    assert module._select_best_triples(robot, triples[:8], 0.5) == triples[:8]
    found = best_nominal(robot, np.full(5, 0.05), triples, 0.5)
    assert found.joints == (0, 1, 2)
    np.testing.assert_allclose(found.shape[3:], 0.05)


def test_shapes_without_room_are_passed_over_if_there_are_others() -> None:
    def roomy(shapes: Array) -> npt.NDArray[np.bool_]:
        return np.asarray(shapes[:, 0] < 0.0)

    found = best_nominal(three(), np.zeros(3), [(0, 1, 2)], 0.4, roomy)
    assert -0.01 < found.shape[0] < 0.0
    np.testing.assert_allclose(found.shape[1:], [-0.47, 0.82], atol=5e-3)
    nowhere = best_nominal(three(), np.zeros(3), [(0, 1, 2)], 0.4, lambda s: s[:, 0] > 9)
    assert nowhere.shape[0] == pytest.approx(0.31, abs=2e-3)


def test_a_given_shape_has_the_triple_that_turns_the_base_most_and_edges_of_the_ranges() -> None:
    robot = robot_with([-1.0, -2.0, -0.1, -1.0], [1.4, 2.0, 0.2, 1.0], [0.0] * 4)
    shape = np.array([0.1, 0.0, 0.15, -0.2])
    found = nominal_at_shape(robot, shape, [(1, 2, 3), (0, 1, 2)], 1.5)
    assert found.joints == (0, 1, 2)
    # Not those round the shape: boxes are moved into the limits.
    np.testing.assert_allclose(found.longest, [1.5, 1.5, 0.3])


def test_the_worst_axis_is_that_of_the_smallest_area() -> None:
    longest = np.array([0.5, 0.8, 2.0])
    M = np.diag([1.0, 2.0, 3.0])
    # Areas 0.4, 1.6 and 1.0, times 1, 2 and 3 rad per area.
    assert module._worst_axis_turn(M, longest) == pytest.approx(0.4)
    assert module._worst_axis_turn(np.diag([9.0, 2.0, 3.0]), longest) == pytest.approx(3.0)


def test_edges_reach_as_far_as_the_nearer_end_on_both_sides() -> None:
    at = np.array([[0.0, 0.0, 2.4], [-1.2, 1.9, 1.0]])
    found = module._centred_edges(three(), [0, 1, 2], at, 1.8)
    np.testing.assert_allclose(found, [[1.8, 1.8, 0.2], [0.0, 0.2, 1.8]])


def test_joints_and_shapes_of_users_are_checked() -> None:
    robot = robot_with([-1.0] * 4, [1.2] * 4, [0.0] * 4, still=1)
    assert module._list_triples(robot, []) == [(0, 2, 3)]
    assert module._list_triples(robot, ["joint_3", "joint_0", "joint_1"]) == [(3, 0, 1)]
    for names in (["joint_0", "joint_1"], ["joint_0", "joint_0", "joint_1"], ["joint_0", "a", "b"]):
        with pytest.raises(ParameterError, match="it must name three of the joints joint_0, joint"):
            module._list_triples(robot, names)
    with pytest.raises(ParameterError, match=r"has 3 number\(s\); robot 'formula' has 4 joints"):
        NominalShapeChooser(robot, 1.0, "", (0.0, 0.0, 0.0))
    for number, limit in ((2, 1.21), (3, -1.01)):
        shape = np.zeros(4)
        shape[number] = limit
        with pytest.raises(ParameterError) as refusal:
            NominalShapeChooser(robot, 1.0, "", shape.tolist())
        assert str(refusal.value) == (
            f"area_loop.nominal has joint 'joint_{number}' at {limit:.4g}, and its limits are "
            "[-1, 1.2]."
        )
    chosen = NominalShapeChooser(robot, 1.0, "joint_0 joint_2 joint_3", (1.2, -1.0, 0.0, 0.0))
    assert chosen.at(np.full(4, 9.0)).joints == (0, 2, 3)


def test_a_choice_is_kept_while_the_other_joints_rest() -> None:
    robot = robot_with([-1.0] * 4, [1.2] * 4, [0.0] * 4)
    chooser = NominalShapeChooser(robot, 1.0, "joint_0 joint_1 joint_2", ())
    first = chooser.at(np.array([0.3, 0.3, 0.3, 0.5]))
    assert chooser.at(np.array([0.9, -0.9, 0.0, 0.5009]), first) is first
    other = chooser.at(np.array([0.9, -0.9, 0.0, 0.5011]), first)
    assert other is not first
    assert other.shape[3] == 0.5011


def test_three_joints_have_one_choice() -> None:
    chooser = NominalShapeChooser(three(), 1.0, "", ())
    chooser.prepare()
    assert chooser.at(np.ones(3)) is chooser.at(np.zeros(3))
    four = NominalShapeChooser(robot_with([-1.0] * 4, [1.2] * 4, [0.0] * 4), 1.0, "", ())
    four.prepare()
    assert four._only_choice is None


def test_joints_that_turn_for_ever_are_moved_to_the_nearest_turn() -> None:
    robot = robot_with([-FREE, -FREE, -1.0], [FREE, 1.0, FREE], [0.0] * 3)
    chooser = NominalShapeChooser(robot, 1.0, "", ())
    nominal = NominalShape(np.array([0.5, 0.5, 0.5]), (0, 1, 2), np.eye(3), np.ones(3))
    moved = chooser.move_to_nearest_turn(nominal, np.array([13.5, -13.0, 13.0]))
    # 13.5 - 0.5 are 2.07 turns; joints with one limit stay.
    np.testing.assert_allclose(moved.shape, [0.5 + 4 * np.pi, 0.5, 0.5])
    back = chooser.move_to_nearest_turn(nominal, np.array([-2.7, 0.0, 0.0]))
    np.testing.assert_allclose(back.shape[0], 0.5 - 2 * np.pi)


def test_loops_need_three_joints_with_room_and_a_regular_matrix(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    two = robot_with([-1.0] * 3, [1.2] * 3, [0.0] * 3, still=1)
    with pytest.raises(PlanningError, match="'formula' has 2 with a velocity limit above zero"):
        NominalShapeChooser(two, 1.0, "", ()).at(np.zeros(3))
    narrow = robot_with([-1.0, 0.3, -1.0], [1.2, 0.30009, 1.2], [0.0] * 3)
    with pytest.raises(PlanningError, match=r"\[0.3, 0.3001\] leave joint 'joint_1' no room for"):
        NominalShapeChooser(narrow, 1.0, "", ()).at(np.full(3, 0.3))
    for condition, refused in ((0.9e4, False), (1.1e8, True)):
        M = np.diag([1.0, 0.5, 1 / condition])
        nominal = NominalShape(np.array([0.1, 0.2, -0.3]), (0, 2, 1), M, np.ones(3))
        monkeypatch.setattr(module, "best_nominal", lambda *_, n=nominal: n)
        chooser = NominalShapeChooser(three(), 1.0, "", ())
        if not refused:
            assert chooser.at(np.zeros(3)) is nominal
            continue
        with pytest.raises(PlanningError) as refusal:
            chooser.at(np.zeros(3))
        assert str(refusal.value) == (
            "The curvature matrix of joints joint_0, joint_2, joint_1 is singular at the nominal "
            "shape [0.1, 0.2, -0.3] (condition number 1.1e+08): loops there do not turn the base "
            "about all axes."
        )


def test_two_joints_turn_the_base_about_one_axis_and_one_about_none() -> None:
    robot = robot_with([-1.0] * 3, [1.2] * 3, [0.0] * 3)
    shapes = sample_shapes(robot, 4)
    one = _span_of_brackets(robot, shapes, [2])
    assert (one.rank, one.required_rank, one.joints) == (0, 3, ())
    assert one.message == "Robot 'formula' has 1 joint(s): no loop encloses an area."
    two = _span_of_brackets(robot, shapes, [2, 0])
    assert (two.rank, two.required_rank, two.joints) == (1, 3, ("joint_2", "joint_0"))
    weight = np.exp(-np.sum(shapes[0] ** 2))
    np.testing.assert_allclose(two.singular_values, [weight, 0.0, 0.0])
    np.testing.assert_array_equal(two.shape, shapes[0])
    assert (
        two.message
        == "Loops of two joints of robot 'formula' turn its base about one axis at a time."
    )
    all_ = _span_of_brackets(robot, shapes, None)
    assert all_.rank == 3
