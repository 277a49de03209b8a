"""Every parameter reaches the quantities of a flight that it is to change, and no others."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.passage import FLIGHTS, Case, cases, table

from spacerobot_ros.parameters import declared
from spacerobot_ros.scenario import CONFIGS

TESTS = Path(__file__).resolve().parents[1]

NODES = ("plant", "planner", "coordinated_control")

_QUICK = ("hand", "square")
"""Flights that need no solver and take a few tenths of a second."""

_LONG = {
    "plant.actuation",
    "plant.initial_orientation",
    "plant.integration_step",
    "plant.initial_joint_velocities",
    "planner.area_loop.cycles_per_plan",
    "planner.attitude_tolerance",
    "planner.integration_step",
    "planner.joint_tolerance",
    "planner.method",
    "planner.square_path.t1",
    "coordinated_control.estimation_time",
    "coordinated_control.model_error",
    "coordinated_control.model_error_seed",
    "coordinated_control.model_based.singular_value_threshold",
}
"""Parameters with which even these take seconds."""


def test_parameters_of_the_table_exist() -> None:
    every = {f"{node}.{p.name}" for node in NODES for p in declared(CONFIGS[node])}
    assert set(table()) <= every


def test_named_tests_name_the_parameter() -> None:
    for parameter, entry in table().items():
        if "test" in entry:
            file, _, name = entry["test"].partition("::")
            text = (TESTS / file).read_text("utf-8")
            assert parameter.rpartition(".")[2] in text, parameter
            assert f"def {name}" in text, parameter


def test_flights_are_short_and_all_are_used() -> None:
    assert {case.flight for case in cases()} == set(FLIGHTS)


def _marked(case: Case) -> object:
    quick = case.flight in _QUICK and case.parameter not in _LONG
    marks = () if quick else (pytest.mark.slow,)
    return pytest.param(case, id=case.parameter, marks=marks)


@pytest.mark.parametrize("case", [_marked(case) for case in cases()])
def test_a_parameter_changes_these_quantities_and_no_others(case: Case) -> None:
    assert case.changes, "it changes nothing"
    assert "refused" not in case.changes
    assert case.found() == case.changes
