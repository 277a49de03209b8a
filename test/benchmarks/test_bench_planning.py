"""Benchmarks of planning: goals, durations, and the cost of first plans."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros.benchmarks.measurements import CASES, first_plan, plans, requests
from spacerobot_ros.benchmarks.planning import duration_figures, first_plan_benchmark
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file

MOST_CPU = {7: 8.0, 12: 20.0, 14: 40.0}
"""From an empty cache to the first plan, s, by the number of joints."""


def test_durations_are_compared_goal_by_goal() -> None:
    """One equal, one 1.5 % and one 4 % longer, one shorter; refused here, there and by both."""
    here = np.array([1.0, 1.015, 2.08, 0.9, np.nan, 1.0, np.nan])
    there = np.array([1.0, 1.0, 2.0, 1.0, 1.0, np.nan, np.nan])
    figures = duration_figures(here, there)
    assert figures["share_below_1.01"] == pytest.approx(4 / 7)
    assert figures["share_below_1.02"] == pytest.approx(5 / 7)
    assert figures["share_below_1.03"] == pytest.approx(5 / 7)
    assert (figures["worst"], figures["best"]) == (np.inf, 0.0)


@pytest.mark.parametrize("name", CASES)
def test_goals_are_the_same_ones_every_time(name: str) -> None:
    robot = SpaceRobot.from_file(robot_file(name))
    first, second = (list(requests(robot, CASES[name], 3, 7)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.goal.quaternion, other.goal.quaternion)
        np.testing.assert_array_equal(one.state.q, other.state.q)
        np.testing.assert_array_equal(one.goal.position, other.goal.position)
        assert np.all((one.state.q >= robot.lower) & (one.state.q <= robot.upper))


@pytest.mark.slow
def test_plans_are_measured() -> None:
    found = plans(str(robot_file("planar_chain")), "planar_chain", 1, 7, {"answers": 1})
    assert found["cpu_s"][0] > 0
    assert 0.5 < found["duration_s"][0] < 10


@pytest.mark.slow
def test_a_first_plan_is_measured() -> None:
    found = first_plan(str(robot_file("three_joint_arm")))
    assert found["joints"] == 3
    assert 0 < found["plan_cpu_s"] < found["cpu_s"]


@pytest.mark.slow
def test_robots_of_many_joints_are_planned_for_soon() -> None:
    lines: list[str] = []
    figures = first_plan_benchmark(None, lines.append)
    assert len(lines) == len(figures)
    assert {found["joints"] for found in figures.values()} == set(MOST_CPU)
    for found in figures.values():
        assert found["first_cpu_s"] <= MOST_CPU[found["joints"]]
        # The next process finds what the first has compiled.
        assert found["next_cpu_s"] < found["first_cpu_s"]
        assert 0 < found["more_cpu_s"] < found["next_cpu_s"]
