"""Square paths of the robot of paper 3: the printed numbers."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy.integrate import dblquad, quad
from support.planar_manoeuvres import (
    DEPLOYED,
    FOLDED,
    PERIOD,
    about_z,
    at_rest,
    closed_forms,
    goal_of,
    paper_gait,
    phase_density,
    planner,
    turns,
)

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.methods.geometric_phase import PlanarPhase

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


def test_step_1_of_the_paper_turns_the_base_by_one_radian(chain: SpaceRobot) -> None:
    phase = PlanarPhase(chain).turns_by_legs(FOLDED[np.newaxis], DEPLOYED[np.newaxis])
    assert phase[0] == pytest.approx(0.999503, abs=5e-7)
    gait = paper_gait(chain)
    assert gait.notes["turn_of_step_1"] == pytest.approx(0.999503, abs=5e-7)
    assert gait.notes["wanted_phase"] == pytest.approx(0.571293, abs=5e-7)


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
    assert step_2 == pytest.approx(-step_4, abs=1e-12)
    assert step_3 == pytest.approx(0.571293, abs=5e-7)


def test_the_centre_is_where_the_phase_density_is_largest(chain: SpaceRobot) -> None:
    grid = np.radians(np.arange(-180.0, 180.0, 1.0))
    heights = np.abs(phase_density(np.stack(np.meshgrid(grid, grid), axis=-1)))
    centre = np.array(paper_gait(chain).notes["psi_star"])
    np.testing.assert_allclose(np.degrees(np.abs(centre)), [153, 121], atol=0.6)
    assert centre[0] * centre[1] > 0
    top = abs(phase_density(centre))
    assert top == pytest.approx(0.5376, abs=5e-5)
    assert top >= heights.max() - 1e-6


def test_the_nearer_of_two_equal_centres_is_taken(chain: SpaceRobot) -> None:
    for sign in (1, -1):
        shape = sign * np.array([2.0, 1.5])
        gait = planner(chain).plan(at_rest(shape), goal_of(about_z(0.3)))
        centre = np.array(gait.notes["psi_star"])
        np.testing.assert_allclose(sign * np.degrees(centre), [153, 121], atol=0.6)
    # A turn further it is the image a turn further.
    shape = np.array([2.0 + 2 * np.pi, 1.5])
    gait = planner(chain).plan(at_rest(shape), goal_of(about_z(0.3)))
    np.testing.assert_allclose(np.degrees(gait.notes["psi_star"]), [513, 121], atol=0.6)


def test_velocities_are_the_mean_of_the_papers_over_each_tick(chain: SpaceRobot) -> None:
    gait = paper_gait(chain, **RIGHT)
    T, D = 4.0, np.array(gait.notes["corner"]) - DEPLOYED

    def speed(t: float) -> float:
        # The integral of u = (2 pi D / T^2) sin(2 pi t / T), for D = 1.
        return quad(lambda tau: 2 * np.pi / T**2 * np.sin(2 * np.pi * tau / T), 0, t)[0]

    for k in (0, 1, 39, 40, 60, 79):
        mean = quad(speed, k * PERIOD, (k + 1) * PERIOD)[0] / PERIOD
        np.testing.assert_allclose(gait.velocities[160 + k], mean * D, atol=1e-9)


def test_the_paper_chain_turns_by_minus_170_degrees(chain: SpaceRobot) -> None:
    goal = goal_of(about_z(np.radians(-170)), DEPLOYED)
    gait = planner(chain).plan(at_rest(FOLDED), goal)
    theta = turns(closed_forms, gait.positions).sum()
    # -170 deg less the 57 of step 1 are -227: it goes on by 133 instead.
    assert gait.notes["wanted_phase"] == pytest.approx(np.radians(190) - 0.999503, abs=1e-6)
    assert theta == pytest.approx(np.radians(190), abs=1e-9)
    assert gait.notes["loops"] == 2


def test_times_are_the_options(chain: SpaceRobot) -> None:
    gait = paper_gait(chain, t1=10.0, t2=16.0, t3=36.0, t4=40.0)
    assert gait.duration == pytest.approx(40.0)
    corner = np.array(gait.notes["corner"])
    for seconds, shape in ((10, DEPLOYED), (16, corner), (36, corner), (40, DEPLOYED)):
        np.testing.assert_allclose(gait.positions[round(seconds / PERIOD)], shape, atol=1e-9)
