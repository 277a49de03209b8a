"""Allocation of wrenches to thrusters against linear programmes and bounded least squares."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, lsq_linear
from support.oracles import Array

from spacerobot_ros.model.thrusters import ThrusterAllocation, thrusters_of_urdf
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import share_directory

SERVICER = thrusters_of_urdf(load_robot(share_directory() / "urdf" / "servicer.urdf"))
ALWAYS = np.full(24, np.inf)
WHOLE = np.ones(24)


def random_table(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Return wrenches (6, count) of thrusters anywhere, and costs."""
    force = rng.normal(size=(count, 3)) * rng.uniform(0.5, 20.0, (count, 1))
    place = rng.uniform(-2.0, 2.0, (count, 3))
    return np.vstack([force.T, np.cross(place, force).T]), rng.uniform(0.5, 2.0, count)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31),
    count=st.integers(1, 24),
    scale=st.sampled_from([1e-6, 1.0, 1e4]),
)
def test_what_thrusters_can_give_is_given(seed: int, count: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    wrenches, cost = random_table(rng, count)
    # Some thrusters at random levels: a wrench of the cone, also of its faces.
    levels = scale * rng.uniform(0.0, 1.0, count) * rng.integers(0, 2, count)
    wanted = wrenches @ levels
    found = ThrusterAllocation(wrenches, cost).allocate(wanted, np.full(count, np.inf))
    assert found.levels.min() >= 0.0
    np.testing.assert_array_equal(found.achieved, wrenches @ found.levels)
    assert np.linalg.norm(found.achieved - wanted) <= 1e-9 * (np.linalg.norm(wanted) + scale)
    assert cost @ found.levels <= cost @ levels * (1 + 1e-9)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_every_wrench_of_the_servicer_is_given_at_the_least_propellant(seed: int) -> None:
    wanted = np.random.default_rng(seed).normal(size=6) * [5.0, 5.0, 5.0, 2.0, 2.0, 2.0]
    cost = SERVICER.mass_flow
    found = ThrusterAllocation(SERVICER.wrenches, cost).allocate(wanted, ALWAYS)
    cheapest = linprog(cost / cost[0], A_eq=SERVICER.wrenches, b_eq=wanted).fun * cost[0]
    assert np.abs(found.achieved - wanted).max() <= 1e-9
    assert found.levels.min() >= 0.0
    assert cost @ found.levels == pytest.approx(cheapest, rel=1e-7)


@pytest.mark.parametrize("seed", range(8))
def test_beyond_the_thrust_the_wrench_keeps_its_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wanted = rng.normal(size=6) * [60.0, 60.0, 60.0, 30.0, 30.0, 30.0]
    most = rng.uniform(0.2, 1.0, 24)
    found = ThrusterAllocation(SERVICER.wrenches, SERVICER.mass_flow).allocate(wanted, most)
    assert np.all((found.levels >= 0.0) & (found.levels <= most))
    part = float(found.achieved @ wanted / (wanted @ wanted))
    np.testing.assert_allclose(
        found.achieved, part * wanted, atol=1e-9 * float(np.linalg.norm(wanted))
    )
    # max part subject to wrenches @ levels = part * wanted, scaled otherwise than in the package
    largest = linprog(
        np.append(np.zeros(24), -1.0),
        A_eq=np.column_stack([SERVICER.wrenches, -wanted]),
        b_eq=np.zeros(6),
        bounds=[*((0.0, x) for x in most), (0.0, None)],
    ).x[-1]
    assert part == pytest.approx(min(largest, 1.0), rel=1e-7)
    assert part < 1.0


def test_redundant_thrusters_share_what_is_too_much_for_the_cheapest() -> None:
    """Two push along x; the cheaper by the newton gives its 2 N, the rest is the other's."""
    wrenches = np.zeros((6, 2))
    wrenches[0] = 2.0, 1.0
    allocation = ThrusterAllocation(wrenches, np.array([1.0, 1.0]))
    np.testing.assert_allclose(
        allocation.allocate(np.array([1.5, 0, 0, 0, 0, 0]), np.ones(2)).levels,
        [0.75, 0.0],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        allocation.allocate(np.array([2.5, 0, 0, 0, 0, 0]), np.ones(2)).levels,
        [1.0, 0.5],
        atol=1e-12,
    )


@pytest.mark.parametrize("seed", range(6))
def test_the_nearest_is_given_of_what_cannot_be_given(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    wrenches, cost = random_table(rng, 5)
    wanted = rng.normal(size=6)
    found = ThrusterAllocation(wrenches, cost).allocate(wanted, np.full(5, np.inf))
    weights = np.ones(6)
    weights[3:] = np.linalg.norm(wrenches[:3]) / np.linalg.norm(wrenches[3:])
    other = lsq_linear(
        weights[:, None] * wrenches, weights * wanted, (0.0, np.inf), method="bvls", tol=1e-14
    )
    np.testing.assert_allclose(found.achieved, wrenches @ other.x, atol=1e-6)
    assert np.linalg.norm(found.achieved - wanted) > 1e-3


def test_of_a_wrench_in_an_unreachable_direction_the_bounds_leave_what_can_be_given() -> None:
    """Two push along x, one weakly along y, none along z: z is lost, x and y keep their ratio."""
    wrenches = np.zeros((6, 3))
    wrenches[0, :2], wrenches[1, 2] = 2.0, 1.0
    allocation = ThrusterAllocation(wrenches, np.array([1.0, 1.5, 1.0]))
    for size in (1.0, 8.0, 1e3):
        found = allocation.allocate(size * np.array([1.0, 0.5, 0.7, 0, 0, 0]), np.ones(3))
        given_ = min(size, 2.0)
        np.testing.assert_allclose(found.achieved, [given_, given_ / 2, 0, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_bounded_thrusters_give_the_direction_that_unbounded_ones_would(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrenches, cost = random_table(rng, 5)
    allocation = ThrusterAllocation(wrenches, cost)
    wanted = rng.normal(size=6) * 100.0
    free = allocation.allocate(wanted, np.full(5, np.inf))
    most = rng.uniform(0.2, 1.0, 5) * float(free.levels.max()) / 3.0
    found = allocation.allocate(wanted, most)
    part = float(found.achieved @ free.achieved / (free.achieved @ free.achieved))
    np.testing.assert_allclose(found.achieved, part * free.achieved, atol=1e-6)
    used = free.levels > 1e-9 * free.levels.max()
    assert part == pytest.approx(min(1.0, *(most / np.maximum(free.levels, 1e-12))[used]), rel=1e-6)


def test_excluded_thrusters_are_replaced_as_long_as_the_others_suffice() -> None:
    rng = np.random.default_rng(3)
    allocation = ThrusterAllocation(SERVICER.wrenches, SERVICER.mass_flow)
    for dead in (0, 7, 20):
        allocation.exclude(dead)
    for _ in range(20):
        wanted = rng.normal(size=6)
        found = allocation.allocate(wanted, WHOLE)
        np.testing.assert_allclose(found.achieved, wanted, atol=1e-9)
        assert found.levels[[0, 7, 20]].tolist() == [0.0, 0.0, 0.0]


def test_without_thrusters_there_is_nothing() -> None:
    allocation = ThrusterAllocation(np.ones((6, 1)), np.ones(1))
    allocation.exclude(0)
    assert allocation.allocate(np.ones(6), np.ones(1)).achieved.tolist() == [0.0] * 6
    assert allocation.allocate(np.zeros(6), np.ones(1)).levels.tolist() == [0.0]
