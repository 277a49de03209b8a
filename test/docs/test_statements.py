"""Statements of the documents that were once wrong are there, and have a check that exists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

HELD_BY_TESTS = [
    (
        "docs/records.md",
        "two runs in lockstep record messages of equal values in the same order",
        "session/test_run.py::test_two_runs_are_the_same_to_the_last_message",
    ),
    (
        "docs/records.md",
        "each of the thirteen scenarios without faults",
        "verification/test_second_opinion.py::test_every_scenario_has_a_bag_and_they_are_small",
    ),
    (
        "docs/campaigns.md",
        "`rerun` repeats within 1e-9",
        "campaign/test_running.py::test_rows_flown_again_are_the_same",
    ),
    (
        "docs/campaigns.md",
        "two to eight flights at once in [SIMD lanes](theory/lanes.md) (eight with AVX-512)",
        "batch/test_lanes.py::test_narrower_registers_give_the_same_flights",
    ),
    (
        "docs/theory/coordinated_control.md",
        "15.3 mm; 3e-10 m from the line through the true start",
        "control/test_computed_torque.py::test_end_effector_path_is_a_straight_line",
    ),
    (
        "docs/theory/coordinated_control.md",
        "As printed, (27) does fail there",
        "control/test_laws.py::test_eq_27_as_printed_fails_at_a_singularity",
    ),
    (
        "docs/theory/square_path.md",
        "The paper's laws also start from joint rates that are not zero (its property 3), and so "
        "do these",
        "flight/test_lockstep_flight.py::test_the_chain_is_turned_from_moving_joints",
    ),
    (
        "docs/theory/wheels.md",
        "A robot with wheels ends with the base at rest",
        "planning/test_wheels_in_plans.py::test_wheels_stop_a_base_that_turns",
    ),
    (
        "docs/theory/wheels.md",
        "The warning comes at 4.6 s with 6 s left; the dump starts at 8.4 s and takes 23 s.",
        "session/test_scenario_flights.py::"
        "test_the_base_is_held_while_saturation_is_announced_and_momentum_dumped",
    ),
    (
        "docs/theory/coordinated_control.md",
        "The paper prints $\\theta_1$ there.",
        "control/test_laws.py::test_eq_12_has_the_third_angle_in_its_second_column",
    ),
]
"""Page, statement, and the test that holds it."""


def text_of(page: str) -> str:
    return " ".join((ROOT / page).read_text("utf-8").split())


@pytest.mark.parametrize(("page", "statement", "test"), HELD_BY_TESTS)
def test_a_statement_is_there_and_has_its_test(page: str, statement: str, test: str) -> None:
    assert statement in text_of(page)
    file, _, name = test.partition("::")
    assert re.search(rf"^def {name}\(", (ROOT / "test" / file).read_text("utf-8"), re.MULTILINE)
