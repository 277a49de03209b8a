"""Square paths within joint limits, or the true reason why there is none."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from support.planar_manoeuvres import (
    PERIOD,
    URDF,
    Case,
    about_z,
    at_rest,
    check_flight,
    closed_forms,
    goal_of,
    paper_gait,
    planner,
    random_case,
    turns,
    wrapped,
)
from support.planar_trees import PlanarTree

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot

Array = npt.NDArray[np.float64]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
def test_limits_are_kept_or_the_goal_is_refused_with_the_reason(seed: int) -> None:
    rng = np.random.default_rng(seed)
    case = random_case(seed, 3 + seed % 2)
    middle, width = rng.uniform(-1, 1, 4), rng.uniform(0.5, 6.0, 4)
    parts = [case.tree.parts[0]]
    for k, part in enumerate(case.tree.parts[1:]):
        limits = float(middle[k] - width[k] / 2), float(middle[k] + width[k] / 2)
        parts.append(replace(part, limits=limits, rate=float(rng.uniform(0.1, 2.0))))
    tree = replace(case.tree, parts=tuple(parts))
    robot = SpaceRobot.from_urdf(tree.urdf)
    state = replace(case.state, q=rng.uniform(robot.lower, robot.upper))
    goal = replace(case.goal, joint_positions=rng.uniform(robot.lower, robot.upper))
    case = Case(tree, robot, state, goal, case.angle)
    try:
        gait = planner(robot, most_loops=5).plan(state, goal)
    except PlanningError as refusal:
        reason = str(refusal)
    else:
        reason = ""
        check_flight(case, gait)
        assert np.all(gait.positions >= robot.lower - 1e-12)
        assert np.all(gait.positions <= robot.upper + 1e-12)
        assert np.all(np.abs(gait.velocities) <= robot.velocity_limit * (1 + 1e-9))
        assert float(gait.notes["loops"]) <= 5  # type: ignore[arg-type]
    if reason:
        assert "more than most_loops = 5" in reason
        assert too_small(case, 5)


def too_small(case: Case, loops: int) -> bool:
    """Whether no square among many within the limits turns the base far enough in some loops."""
    psi_e = case.goal.joint_positions
    assert psi_e is not None
    squares = []
    for i, j in itertools.combinations(range(case.robot.n), 2):
        lower, upper = case.robot.lower[[i, j]], case.robot.upper[[i, j]]
        for share in (0.4, 0.7, 1.0):
            side = share * float((upper - lower).min())
            axes = [np.linspace(lower[k], upper[k] - side, 5) for k in range(2)]
            for low in itertools.product(*axes):
                corners = np.tile(psi_e, (4, 1))
                corners[:, [i, j]] = low + side * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
                squares.append(corners)
    starts = np.array(squares)
    phases = gauss_turns(case.tree, starts, np.roll(starts, -1, axis=1)).sum(axis=1)
    step_1 = float(gauss_turns(case.tree, case.state.q, psi_e))
    return abs(wrapped(case.angle - step_1)) > 0.97 * loops * float(np.abs(phases).max())


def gauss_turns(tree: PlanarTree, starts: Array, ends: Array) -> Array:
    """Return the turns (...) along straight legs of the shape, starts and ends (..., n)."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    moves = ends - starts
    rates = [np.sum(tree.s(starts + (x + 1) / 2 * moves) * moves, axis=-1) for x in nodes]
    return -np.tensordot(weights / 2, np.array(rates), axes=1)


def test_slow_joints_take_longer(chain: SpaceRobot) -> None:
    text = URDF.read_text().replace('velocity="2"', 'velocity="0.1"')
    gait = paper_gait(SpaceRobot.from_urdf(text))
    side = float(gait.notes["z_star"])  # type: ignore[arg-type]
    corner = float(np.max(np.abs(gait.notes["corner"])))
    # The peak speed is twice the mean, on each leg.
    expected = [2 * np.pi / 0.1, 2 * corner / 0.1, *[2 * side / 0.1] * 4, 2 * corner / 0.1]
    ticks = np.ceil(np.array(expected) / PERIOD).sum()
    assert gait.ticks == ticks
    assert np.abs(gait.velocities).max() == pytest.approx(0.1, rel=1e-3)
    assert np.abs(gait.velocities).max() <= 0.1
    assert gait.notes["z_star"] == pytest.approx(paper_gait(chain).notes["z_star"], abs=1e-9)


def test_a_wide_range_is_used_round_the_shape(chain: SpaceRobot) -> None:
    # Three turns of room; the shape is near one end of it.
    kind = 'type="revolute"'
    text = URDF.read_text().replace('type="continuous"', kind)
    text = text.replace("<limit velocity", '<limit lower="-9.5" upper="9.5" velocity')
    robot = SpaceRobot.from_urdf(text)
    gait = planner(robot).plan(at_rest(np.array([9.3, 9.0])), goal_of(about_z(1.0)))
    assert np.abs(gait.positions).max() <= 9.5
    assert turns(closed_forms, gait.positions).sum() == pytest.approx(1.0, abs=1e-9)
    free = planner(chain).plan(at_rest(np.array([9.3, 9.0])), goal_of(about_z(1.0)))
    # The same square up to whole turns and the mirror image.
    assert gait.notes["z_star"] == pytest.approx(free.notes["z_star"], abs=1e-3)
