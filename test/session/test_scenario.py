"""Scenarios: their parameters are those that the nodes declare, and are read the same way."""

from __future__ import annotations

from pathlib import Path

import pytest

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.session.scenario import CONFIGS, NODES, load_scenario, scenario_names


def test_the_configurations_are_those_of_the_nodes() -> None:
    assert {name: kind.Config for name, kind in NODE_TYPES.items()} == CONFIGS


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_of_the_package_is_declared(name: str) -> None:
    scenario = load_scenario(name)
    for node in NODES:
        scenario.config(node)
    assert scenario.lockstep, "unless it is asked to run in real time"
    assert not scenario.in_real_time(2.0).lockstep


def test_groups_and_numbers_without_a_dot_are_read_as_ros_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        """
scenario: {ros__parameters: {}}
plant: {ros__parameters: {robot: planar_chain, tick_rate: 1e1, autostart: true}}
planner: {ros__parameters: {lie_bracket: {t1: 5}, world_frame: "1e1"}}
"""
    )
    scenario = load_scenario(str(path))
    assert scenario.plant.tick_rate == 10.0
    assert scenario.planner.options["lie_bracket"].t1 == 5.0
    assert scenario.planner.world_frame == "1e1"
    changed = scenario.with_settings(["planner.lie_bracket.t1=7"])
    assert changed.planner.options["lie_bracket"].t1 == 7.0


def test_overrides_go_before_the_file_and_have_the_declared_types() -> None:
    scenario = load_scenario("sliding_masses").with_settings(
        ["plant.tick_rate=10", "plant.initial_position=[1, 2.5, 0]"]
    )
    assert scenario.checked_overrides("plant") == {
        "time_mode": "lockstep",
        "tick_rate": 10.0,
        "initial_position": (1.0, 2.5, 0.0),
    }
    with pytest.raises(ParameterError, match="Node 'plant' has no parameter 'tick_rte'"):
        scenario.with_settings(["plant.tick_rte=10"]).checked_overrides("plant")


def test_another_goal_has_no_published_figures() -> None:
    scenario = load_scenario("sliding_masses")
    assert scenario.published
    assert scenario.with_goal() is scenario
    other = scenario.with_goal(rotvec=(0.0, 0.0, 0.1))
    assert not other.published
    assert other.goal.position.tolist() == scenario.goal.position.tolist()
