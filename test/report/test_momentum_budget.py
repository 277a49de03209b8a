"""The figure of the momentum budget, and the flights that have it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from spacerobot_ros.errors import RobotDescriptionError, SpaceRobotError
from spacerobot_ros.model.payload_estimation import PayloadEstimate
from spacerobot_ros.report import flight as report_flight
from spacerobot_ros.report import tables as report_tables
from spacerobot_ros.report.figures import ReportFigure, drawing
from spacerobot_ros.report.figures_over_time import momentum_budget_figure
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.tables import payload_text, result_table
from spacerobot_ros.report.writing import _REPORT_FIGURES, FIGURES

BAGS = Path(__file__).parents[2] / "bags"


@pytest.fixture(scope="module", autouse=True)
def _few_states() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPACEROBOT_COMPILE", "0")
        patch.setattr(report_flight, "_MAX_BUDGET_STATES", 30)
        yield


def figure_of(name: str) -> ReportFigure | str | None:
    with drawing():
        return momentum_budget_figure(read_report(BAGS / f"{name}.mcap"))


def test_a_robot_with_wheels_has_four_traces() -> None:
    figure = figure_of("wheels")
    assert isinstance(figure, ReportFigure)
    assert (figure.name, figure.heading) == ("momentum_budget", "Momentum budget")
    (group,) = figure.groups
    assert list(group.names) == ["base", "arm", "wheels", "sum"]
    assert (group.label, group.unit) == ("angular momentum", "N m s")
    assert len(set(group.colours)) == 4
    assert len(group.signal) == 30
    assert group.signal.time[0] == 0.0
    assert "of the wheels about their axes" in figure.caption


def test_a_robot_that_captures_has_no_trace_of_wheels_that_it_lacks() -> None:
    figure = figure_of("capture")
    assert isinstance(figure, ReportFigure)
    (group,) = figure.groups
    assert list(group.names) == ["base", "arm", "sum"]
    assert "wheels" not in figure.caption
    report = read_report(BAGS / "capture.mcap")
    np.testing.assert_array_equal(group.signal.values, report.momentum_budget.values[:, [0, 1, 3]])


def test_the_table_has_the_estimated_body(monkeypatch: pytest.MonkeyPatch) -> None:
    report = read_report(BAGS / "capture.mcap")
    (text,) = (value for name, value in result_table(report).rows if name == "Held body, estimated")
    assert re.fullmatch(
        r"mass (10|9\.9999\d*) ± \de-\d\d kg; centre of mass \(0\.27\d+, -0\.1\d+, -?0[.0]*\) m in "
        "end_effector; not shown by its motion: Ixx, Iyy, Ixy",
        text,
    ), text

    def refuse(*_: object) -> None:
        raise SpaceRobotError("Loads acted.")

    monkeypatch.setattr(report_tables, "payload_estimates", refuse)
    rows = result_table(read_report(BAGS / "capture.mcap")).rows
    assert ("Held body, estimated", "Loads acted.") in rows


def test_the_text_of_an_estimate_leaves_out_unknown_parameters() -> None:
    numbers = np.array([2.0, 0.2, -0.4, 0.6, 1.2, 1.4, 1.3, 0.05, -0.1, 0.2])
    spread = np.full(10, 0.03)
    whole = PayloadEstimate("hand", numbers, spread, np.zeros((0, 10)), True)
    # By the parallel-axis theorem: centre (0.1, -0.2, 0.3) m.
    assert payload_text(whole) == (
        "mass 2 ± 0.03 kg; centre of mass (0.10000, -0.20000, 0.30000) m in hand; inertia about it "
        "(0.94, 1.2, 1.2, 0.01, -0.04, 0.08) kg m² (xx, yy, zz, xy, xz, yz); corrected "
        "to the nearest parameters of a body"
    )
    some = np.where(np.arange(10) == 2, np.nan, numbers)
    assert payload_text(PayloadEstimate("hand", some, spread, np.zeros((0, 10)), False)) == (
        "mass 2 ± 0.03 kg; not shown by its motion: m cy"
    )
    none = np.full(10, np.nan)
    assert payload_text(PayloadEstimate("hand", none, none, np.eye(10), False)).startswith(
        "not shown by its motion: m, m cx"
    )


def test_other_flights_have_none() -> None:
    assert figure_of("planar_chain") is None
    assert _REPORT_FIGURES[-1] is FIGURES["momentum_budget"] is momentum_budget_figure


def test_a_robot_without_inertia_has_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RobotDescriptionError("The robot has no inertia.")

    monkeypatch.setattr(report_flight, "momentum_budget_over_time", refuse)
    assert figure_of("capture") == "The momentum budget is not drawn. The robot has no inertia."
