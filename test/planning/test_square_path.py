"""Square paths of planar robots: goals met by another integration."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planar_manoeuvres import (
    DEPLOYED,
    FOLDED,
    PERIOD,
    TIGHT,
    URDF,
    about_z,
    at_rest,
    check_flight,
    closed_forms,
    goal_of,
    paper_gait,
    planner,
    random_case,
    turns,
)
from support.planar_trees import random_tree
from support.planners import planner_of

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Tolerance
from spacerobot_ros.planning.methods.geometric_phase import PlanarPhase, planar_axis


@pytest.mark.parametrize("branched", [False, True])
def test_the_curvature_in_the_plane_of_two_joints(branched: bool) -> None:
    rng = np.random.default_rng(8)
    tree = random_tree(rng, 5, branched=branched)
    robot = SpaceRobot.from_urdf(tree.urdf)
    phase, h = PlanarPhase(robot), 1e-5 * np.eye(4)
    for i, j in itertools.combinations(range(4), 2):
        psi = rng.uniform(-np.pi, np.pi, 4)
        curl = (tree.s(psi + h[i]) - tree.s(psi - h[i]))[j]
        curl -= (tree.s(psi + h[j]) - tree.s(psi - h[j]))[i]
        # The plane knows where the other joints are, and not where these two were.
        plane = phase.plane(np.where(np.isin(np.arange(4), [i, j]), 9.0, psi), i, j)
        K = plane.curvature(psi[[i, j]]) * phase.axis
        np.testing.assert_allclose(K, -curl / 2e-5 * tree.plane[:, 2], atol=1e-8)
        # The model's is one of three dimensions: here it has no more than this.
        np.testing.assert_allclose(K, robot.curvature(psi)[3:, i, j], atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "links", "branched"),
    [(1, 3, False), (2, 3, True), (3, 4, False), (4, 4, True), (5, 5, True), (6, 6, True)],
)
def test_random_goals_of_random_robots(seed: int, links: int, branched: bool) -> None:
    case = random_case(seed, links, branched=branched)
    check_flight(case, planner(case.robot).plan(case.state, case.goal))


@pytest.mark.parametrize("degrees", [-170.0, 170.0, 15.0])
def test_a_chain_of_five_links(degrees: float) -> None:
    case = random_case(11, 5, float(np.radians(degrees)))
    gait = planner(case.robot).plan(case.state, case.goal)
    check_flight(case, gait)
    # Two joints go round; the others wait in their final position.
    names = str(gait.notes["joints"]).split(", ")
    others = [k for k, name in enumerate(gait.joint_names) if name not in names]
    assert (len(names), len(others)) == (2, 2)
    waiting = gait.positions[round(8.0 / PERIOD) :, others]
    assert case.goal.joint_positions is not None
    np.testing.assert_allclose(
        waiting, np.tile(case.goal.joint_positions[others], (len(waiting), 1)), atol=1e-12
    )


def test_all_loops_are_the_same_square(chain: SpaceRobot) -> None:
    method = planner(chain, t3=24.0, t4=28.0)
    gait = method.plan(at_rest(DEPLOYED), goal_of(about_z(np.radians(-170))))
    assert gait.notes["loops"] == 2
    assert gait.notes["direction"] == "counter-clockwise"
    # 4 s there, 12 s a loop and 4 s back; nothing for step 1.
    assert gait.duration == pytest.approx(32.0)
    first, second = gait.positions[80:320], gait.positions[320:560]
    np.testing.assert_allclose(first, second, atol=1e-12)
    np.testing.assert_allclose(gait.positions[:81], gait.positions[560:][::-1], atol=1e-12)
    theta = turns(closed_forms, gait.positions)
    assert theta.sum() == pytest.approx(np.radians(-170), abs=1e-9)
    assert theta[80:320].sum() == pytest.approx(np.radians(-85), abs=1e-9)


def test_the_phase_does_not_depend_on_the_ticks(chain: SpaceRobot) -> None:
    goal = goal_of(about_z(np.pi / 2), DEPLOYED)
    coarse = planner_of("square_path", chain, 0.7, TIGHT).plan(at_rest(FOLDED), goal)
    fine = paper_gait(chain)
    assert coarse.notes["z_star"] == fine.notes["z_star"]
    assert turns(closed_forms, coarse.positions).sum() == pytest.approx(np.pi / 2, abs=1e-9)


@pytest.mark.slow
def test_the_pair_with_the_smallest_square_goes_round() -> None:
    case = random_case(21, 4, 0.8)
    best = planner(case.robot).plan(case.state, case.goal).notes
    found = {}
    for pair in itertools.combinations(range(1, 4), 2):
        # Joints without speed go round no square; they are where they are to be.
        parts = tuple(
            replace(part, rate=2.0 if k in pair else 0.0) for k, part in enumerate(case.tree.parts)
        )
        robot = SpaceRobot.from_urdf(replace(case.tree, parts=parts).urdf)
        assert case.goal.joint_positions is not None
        state = at_rest(case.goal.joint_positions, Rotation.from_quat(case.state.quaternion))
        axis = case.tree.plane[:, 2]
        turn = Rotation.from_rotvec(float(best["wanted_phase"]) * axis)  # type: ignore[arg-type]
        goal = goal_of(Rotation.from_quat(case.state.quaternion) * turn)
        notes = planner(robot).plan(state, goal).notes
        found[f"j{pair[0]}, j{pair[1]}"] = (notes["loops"], notes["z_star"])
    winner = min(found, key=lambda names: found[names])
    assert best["joints"] == winner
    assert best["z_star"] == pytest.approx(found[winner][1], abs=1e-6)


def test_the_sense_of_the_axes_is_no_matter(chain: SpaceRobot) -> None:
    text = URDF.read_text().replace('<axis xyz="0 0 1"/>', '<axis xyz="0 0 -1"/>')
    mirrored = SpaceRobot.from_urdf(text)
    np.testing.assert_allclose(planar_axis(mirrored), [0, 0, 1], atol=1e-15)
    goal = goal_of(about_z(np.pi / 2), DEPLOYED)
    gait = planner(mirrored).plan(at_rest(-FOLDED), goal)
    assert gait.notes["wanted_phase"] == pytest.approx(0.571293, abs=5e-7)
    assert turns(closed_forms, -gait.positions).sum() == pytest.approx(np.pi / 2, abs=1e-9)


def test_without_a_shape_the_present_one_is_kept() -> None:
    case = random_case(31, 3, 1.0)
    case = replace(case, goal=replace(case.goal, joint_positions=None))
    gait = planner(case.robot).plan(case.state, case.goal)
    check_flight(case, gait)
    assert gait.notes["psi_e"] == case.state.q.tolist()


def test_a_goal_that_is_met_takes_no_time(chain: SpaceRobot) -> None:
    gait = planner(chain).plan(at_rest(FOLDED), goal_of(Rotation.identity()), correction=True)
    assert (gait.ticks, gait.duration, gait.notes["loops"]) == (0, 0.0, 0.0)
    np.testing.assert_array_equal(gait.positions, [FOLDED])
    np.testing.assert_array_equal(gait.path.position, [at_rest(FOLDED).position])


def test_a_turn_well_within_the_tolerance_is_left_as_it_is(chain: SpaceRobot) -> None:
    method = planner(chain, Tolerance(1e-3, 1e-3))
    assert method.plan(at_rest(FOLDED), goal_of(about_z(9e-5))).ticks == 0
    gait = method.plan(at_rest(FOLDED), goal_of(about_z(2e-4)), correction=True)
    assert turns(closed_forms, gait.positions).sum() == pytest.approx(2e-4, abs=1e-10)
