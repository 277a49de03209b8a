"""Square paths of planar robots: goals by another integration, paper 3, limits and refusals."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from scipy.spatial.transform import Rotation
from support.planar_manoeuvres import (
    DEPLOYED,
    FOLDED,
    PERIOD,
    URDF,
    Case,
    about_z,
    at_rest,
    check_flight,
    closed_forms,
    goal_of,
    paper_gait,
    phase_density,
    planner,
    random_case,
    turns,
    wrapped,
)
from support.planar_trees import Part, PlanarTree, random_tree
from support.planners import refusal_in

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal, RobotState, Tolerance
from spacerobot_ros.planning.methods.square_path import (
    PhasePlane,
    PlanarPhase,
    check_planar_chain,
    curvature_peaks,
    planar_axis,
)


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
        plane = PhasePlane(phase, np.where(np.isin(np.arange(4), [i, j]), 9.0, psi), i, j)
        K = plane.curvature(psi[[i, j]]) * phase.axis
        np.testing.assert_allclose(K, -curl / 2e-5 * tree.plane[:, 2], atol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "links", "branched"),
    [(1, 3, False), (2, 3, True), (3, 4, False), (4, 4, True), (5, 5, True), (6, 6, True)],
)
def test_random_goals_of_random_robots(seed: int, links: int, branched: bool) -> None:
    case = random_case(seed, links, branched=branched)
    check_flight(case, planner(case.robot).plan(case.state, case.goal))


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


def test_without_a_shape_the_present_one_is_kept() -> None:
    case = random_case(31, 3, 1.0)
    case = replace(case, goal=replace(case.goal, joint_positions=None))
    gait = planner(case.robot).plan(case.state, case.goal)
    check_flight(case, gait)
    assert gait.notes["psi_e"] == case.state.q.tolist()


# -- square paths within joint limits, or the true reason why there is none ----------------------


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
        if "more than most_loops = 5" not in str(refusal):
            raise
        assert too_small(case, 5)
        return
    check_flight(case, gait)
    assert np.all(gait.positions >= robot.lower - 1e-12)
    assert np.all(gait.positions <= robot.upper + 1e-12)
    assert np.all(np.abs(gait.velocities) <= robot.velocity_limit * (1 + 1e-9))
    assert float(gait.notes["loops"]) <= 5  # type: ignore[arg-type]


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


# -- square paths of the robot of paper 3: the printed numbers -----------------------------------


RIGHT = {"given_centre": 1, "centre_1": 5 * np.pi / 6, "centre_2": 2 * np.pi / 3}
SWAPPED = {"given_centre": 1, "centre_1": 2 * np.pi / 3, "centre_2": 5 * np.pi / 6}
"""Centres of the square: the printed coordinates in the right order, and in the printed one."""


@pytest.mark.parametrize(
    ("centre", "printed"),
    [((5 * np.pi / 6, 2 * np.pi / 3), -0.464153), ((2 * np.pi / 3, 5 * np.pi / 6), -0.276306)],
)
def test_phase_of_a_unit_square(
    chain: SpaceRobot, centre: tuple[float, float], printed: float
) -> None:
    corners = np.array(centre) + np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    phase = float(PlanarPhase(chain).turns_by_legs(corners, np.roll(corners, -1, axis=0)).sum())
    assert phase == pytest.approx(printed, abs=5e-7)
    # Eq. (11) with the printed functions, and Stokes' surface integral.
    along = sum(
        quad(lambda t, a=a, b=b: -closed_forms(a + t * (b - a)) @ (b - a), 0, 1, epsabs=1e-13)[0]
        for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)
    )
    assert phase == pytest.approx(along, abs=1e-12)
    (left, low), (right, high) = corners[0], corners[2]
    over = dblquad(lambda y, x: float(phase_density([x, y])), left, right, low, high, epsabs=1e-6)[
        0
    ]
    assert phase == pytest.approx(-over, abs=1e-6)


@pytest.mark.parametrize(("options", "side"), [(RIGHT, 1.130702), (SWAPPED, 1.525774)])
def test_the_square_of_the_paper(chain: SpaceRobot, options: dict[str, float], side: float) -> None:
    gait = paper_gait(chain, **options)
    assert gait.notes["z_star"] == pytest.approx(side, abs=5e-7)
    assert gait.notes["psi_star"] == [options["centre_1"], options["centre_2"]]
    assert gait.notes["direction"] == "clockwise"
    assert gait.notes["joints"] == "pin_1, pin_2"
    assert gait.notes["loops"] == 1
    # The corner nearest to (0, 0), and the four sides clockwise from it: t = 8, 12, 14, .. 20, 24.
    low, high = np.array(gait.notes["psi_star"]) + side * np.array([[-0.5], [0.5]])
    assert gait.duration == pytest.approx(24.0)
    ends = [low, [low[0], high[1]], high, [high[0], low[1]], low, DEPLOYED]
    ticks = np.round(np.array([12, 14, 16, 18, 20, 24]) / PERIOD).astype(int)
    np.testing.assert_allclose(gait.positions[ticks], ends, atol=1e-6)
    np.testing.assert_allclose(gait.positions[160], DEPLOYED, atol=1e-12)
    np.testing.assert_allclose(gait.notes["corner"], low, atol=1e-6)  # type: ignore[arg-type]


@pytest.mark.parametrize("options", [RIGHT, SWAPPED, {}])
def test_the_manoeuvre_of_the_paper_ends_on_its_goal(
    chain: SpaceRobot, options: dict[str, float]
) -> None:
    gait = paper_gait(chain, **options)
    theta = turns(closed_forms, gait.positions)
    assert theta.sum() == pytest.approx(np.pi / 2, abs=1e-9)
    np.testing.assert_allclose(gait.positions[-1], DEPLOYED, atol=1e-12)
    # Steps 2 and 4 cancel; the square makes the phase.
    step_1, step_2, step_3, step_4 = (
        theta[a:b].sum() for a, b in itertools.pairwise([0, 160, 240, 400, 480])
    )
    assert step_1 == pytest.approx(0.999503, abs=5e-7)
    assert gait.notes["turn_of_step_1"] == pytest.approx(0.999503, abs=5e-7)
    assert step_2 == pytest.approx(-step_4, abs=1e-12)
    assert step_3 == pytest.approx(0.571293, abs=5e-7)
    assert gait.notes["wanted_phase"] == pytest.approx(0.571293, abs=5e-7)


def test_the_centre_is_where_the_phase_density_is_largest(chain: SpaceRobot) -> None:
    grid = np.radians(np.arange(-180.0, 180.0, 1.0))
    heights = np.abs(phase_density(np.stack(np.meshgrid(grid, grid), axis=-1)))
    centre = np.array(paper_gait(chain).notes["psi_star"])
    np.testing.assert_allclose(np.degrees(np.abs(centre)), [153, 121], atol=0.6)
    assert centre[0] * centre[1] > 0
    top = abs(phase_density(centre))
    assert top == pytest.approx(0.5376, abs=5e-5)
    assert top >= heights.max() - 1e-6
    words = check_planar_chain(chain).message
    assert words.startswith("3 links in a plane: loops of joints 'pin_1' and 'pin_2' rotate")
    assert float(words.split(" rad per unit")[0].rsplit(" ", 1)[1]) == pytest.approx(top, rel=5e-3)


def test_a_box_without_width_has_its_largest_curvature_in_it(chain: SpaceRobot) -> None:
    """As for the largest square that the limits of one joint leave room for."""
    plane = PhasePlane(PlanarPhase(chain), np.zeros(2), 0, 1)
    boxes = np.array([[[0.4, -2.0], [0.4, 2.0]], [[-0.3, 0.7], [-0.3, 0.7]]])
    line, point = curvature_peaks(plane, np.array([0.4, 0.1]), boxes)
    assert point.tolist() == [-0.3, 0.7]
    assert line[0] == 0.4
    along = np.column_stack([np.full(801, 0.4), np.linspace(-2.0, 2.0, 801)])
    top = np.abs(phase_density(along)).max()
    assert abs(phase_density(line)) == pytest.approx(top, rel=1e-4)


def test_the_paper_chain_turns_by_minus_170_degrees(chain: SpaceRobot) -> None:
    goal = goal_of(about_z(np.radians(-170)), DEPLOYED)
    gait = planner(chain).plan(at_rest(FOLDED), goal)
    theta = turns(closed_forms, gait.positions).sum()
    # -170 deg less the 57 of step 1 are -227: it goes on by 133 instead.
    assert gait.notes["wanted_phase"] == pytest.approx(np.radians(190) - 0.999503, abs=1e-6)
    assert theta == pytest.approx(np.radians(190), abs=1e-9)
    assert gait.notes["loops"] == 2


# -- robots and goals that no square path will do for --------------------------------------------


def refusal_of(robot: SpaceRobot, state: RobotState, goal: Goal, **options: Any) -> str:
    return refusal_in(lambda: planner(robot, **options).plan(state, goal))


NEAR = goal_of(about_z(0.2))


@pytest.mark.parametrize("links", [1, 2])
def test_fewer_than_three_links_are_refused(links: int) -> None:
    tree = random_tree(np.random.default_rng(5), links)
    tree = replace(tree, plane=np.eye(3))
    text = refusal_of(SpaceRobot.from_urdf(tree.urdf), at_rest(np.zeros(links - 1)), NEAR)
    assert f"has {links} moving link" in text
    assert "fewer than three" in text


@pytest.mark.parametrize(
    ("old", "new", "mention"),
    [
        ('"pin_2" type="continuous"', '"pin_2" type="prismatic"', "joint 'pin_2' is prismatic"),
        ('<axis xyz="0 0 1"/>', '<axis xyz="0 0.02 1"/>', "axis of joint 'pin_2' is not parallel"),
        (
            '<origin xyz="0.5 0 0"/>\n      <mass',
            '<origin xyz="0.5 0 0.05"/>\n      <mass',
            "plane",
        ),
        ('ixz="0" iyy="1"', 'ixz="0.05" iyy="1"', "products of inertia"),
        ('<origin xyz="1 0 0"/>', '<origin xyz="1 0 0.1"/>', "that do not lie in one plane"),
    ],
)
def test_what_is_not_planar_is_refused(old: str, new: str, mention: str) -> None:
    before, last, after = URDF.read_text().rpartition(old)
    assert last
    text = f"{before}{new}{after}".replace(
        "<limit velocity", '<limit lower="-1" upper="1" velocity'
    )
    reason = refusal_of(SpaceRobot.from_urdf(text), at_rest(np.zeros(2)), NEAR)
    assert "not planar" in reason
    assert mention in reason


def test_angles_written_with_six_digits_are_planar() -> None:
    text = URDF.read_text()
    # The whole chain turned about x, the joint's frame by 1.5708.
    text = text.replace(
        '<origin xyz="0.5 0 0"/>\n    <axis', '<origin xyz="0.5 0 0" rpy="1.5708 0 0"/>\n    <axis'
    )
    text = text.replace('iyy="10" iyz="0" izz="10"', 'iyy="10" iyz="0" izz="9"')
    axis = planar_axis(SpaceRobot.from_urdf(text))
    np.testing.assert_allclose(np.abs(axis), [0, 1, 0], atol=1e-5)


@pytest.mark.parametrize("tilt", [0.3, 0.01])
def test_a_goal_out_of_the_plane_is_refused(chain: SpaceRobot, tilt: float) -> None:
    goal = goal_of(about_z(1.0) * Rotation.from_rotvec([0.6 * tilt, 0.8 * tilt, 0.0]))
    text = refusal_of(chain, at_rest(FOLDED), goal)
    assert f"{tilt:.4g} rad away from any rotation about the axis [0.0, 0.0, 1.0]" in text
    assert "base_link" in text
    # Within the tolerance it is as good as in the plane.
    gait = planner(chain, Tolerance(1e-3, 1.01 * tilt)).plan(at_rest(FOLDED), goal)
    assert turns(closed_forms, gait.positions).sum() == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize(
    ("shape", "mention"),
    [
        ([0.0], "1 joint position, but robot 'planar_chain' has 2 joints"),
        ([0.0, 1.2], "joint 'pin_2' at 1.2 rad, but its limits are [-1, 1] rad"),
        ([-1.001, 0.0], "joint 'pin_1' at -1.001 rad"),
    ],
)
def test_a_shape_that_the_robot_cannot_take_is_refused(shape: list[float], mention: str) -> None:
    robot = limited(1.0)
    assert mention in refusal_of(robot, at_rest(np.zeros(2)), goal_of(about_z(0.1), shape))


def limited(reach: float, middle: float = 0.0) -> SpaceRobot:
    """Return the paper's chain with joints that go so far to either side of the middle, rad."""
    text = URDF.read_text().replace('type="continuous"', 'type="revolute"')
    limit = f'<limit lower="{middle - reach!r}" upper="{middle + reach!r}" velocity'
    return SpaceRobot.from_urdf(text.replace("<limit velocity", limit))


def test_limits_too_narrow_for_a_square_are_refused() -> None:
    text = refusal_of(limited(0.01, 1.5), at_rest(np.full(2, 1.5)), NEAR)
    assert "more than most_loops = 20" in text
    assert "sides of up to 0.02 rad within the joint limits" in text
    assert "'pin_1' and 'pin_2'" in text
    # The curvature times the largest square, and how many of those.
    phase = 0.02**2 * abs(phase_density([1.5, 1.5]))
    loops = int(text.split(" loops, more")[0].rsplit(" ", 1)[1])
    assert loops == pytest.approx(0.2 / phase, rel=0.05)


@pytest.mark.parametrize("centre", [(2.0, 0.0), (0.0, -1.0)])
def test_a_given_centre_beyond_the_limits_is_refused(centre: tuple[float, float]) -> None:
    options: dict[str, Any] = {"given_centre": 1, "centre_1": centre[0], "centre_2": centre[1]}
    text = refusal_of(limited(1.0), at_rest(np.zeros(2)), NEAR, **options)
    assert "given centre" in text
    assert "joint limits" in text


def test_wheels_on_their_mass_centres_turn_the_base_by_no_loop() -> None:
    base = Part(-1, np.zeros(2), np.zeros(2), 50.0, 5.0)
    wheels = [Part(0, np.array([x, 0.0]), np.zeros(2), 5.0, 1.0) for x in (0.5, -0.5)]
    tree = PlanarTree((base, *wheels), np.eye(3))
    text = refusal_of(SpaceRobot.from_urdf(tree.urdf), at_rest(np.zeros(2)), NEAR)
    assert "cannot be rotated" in text
    assert "joint limits" not in text


def test_joints_without_speed_are_refused(chain: SpaceRobot) -> None:
    head, tail = URDF.read_text().rsplit('velocity="2"', 1)
    robot = SpaceRobot.from_urdf(f'{head}velocity="0"{tail}')
    assert "velocity limit above zero" in refusal_of(robot, at_rest(DEPLOYED), NEAR)
    # No loop is needed here, and step 1 takes for ever.
    shape = np.array([np.pi, 0.0])
    turn = float(PlanarPhase(chain).turns_by_legs(FOLDED[np.newaxis], shape[np.newaxis])[0])
    text = refusal_of(robot, at_rest(FOLDED), goal_of(about_z(turn), shape))
    assert "'pin_2'" in text
    assert "inf s" in text


def test_a_manoeuvre_that_takes_too_long_is_refused(chain: SpaceRobot) -> None:
    text = refusal_of(chain, at_rest(FOLDED), goal_of(about_z(1.0), DEPLOYED), longest=20.0)
    assert "24 s" in text
    assert "longest = 20 s" in text


@pytest.mark.parametrize("times", [{"t2": 8.0}, {"t3": 11.0}, {"t1": 30.0}, {"t4": 20.0}])
def test_times_that_do_not_follow_each_other_are_refused(
    chain: SpaceRobot, times: dict[str, Any]
) -> None:
    with pytest.raises(ParameterError, match="t1 to t4") as refusal:
        planner(chain, **times)
    assert f"{next(iter(times.values())):g}" in str(refusal.value)
