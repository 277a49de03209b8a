"""What a first plan costs: of a small robot here, of those with many joints in the slow test."""

from __future__ import annotations

import pytest

from spacerobot_ros.benchmarks import first_plans
from spacerobot_ros.resources import robot_file

MOST_CPU = {7: 8.0, 12: 20.0, 14: 40.0}
"""From an empty cache to the first plan, s, by the number of joints."""


@pytest.mark.slow
def test_a_first_plan_is_measured() -> None:
    found = first_plans.first_plan(robot_file("three_joint_arm"))
    assert found["joints"] == 3
    assert 0 < found["plan_cpu_s"] < found["cpu_s"]


@pytest.mark.slow
def test_robots_of_many_joints_are_planned_for_soon() -> None:
    lines: list[str] = []
    figures = first_plans.run_first_plan_benchmark(None, lines.append)
    assert len(lines) == len(figures)
    assert {found["joints"] for found in figures.values()} == set(MOST_CPU)
    for found in figures.values():
        assert found["first_cpu_s"] <= MOST_CPU[found["joints"]]
        # The next process finds what the first has compiled.
        assert found["next_cpu_s"] < found["first_cpu_s"]
        assert 0 < found["more_cpu_s"] < found["next_cpu_s"]
