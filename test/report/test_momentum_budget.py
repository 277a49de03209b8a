"""The figure of the momentum budget, and the flights that have it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.report import flight as report_flight
from spacerobot_ros.report.figures import ReportFigure, drawing
from spacerobot_ros.report.figures_over_time import momentum_budget_figure
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.writing import _REPORT_FIGURES, FIGURES

BAGS = Path(__file__).parents[2] / "bags"


@pytest.fixture(scope="module", autouse=True)
def _few_states() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SPACEROBOT_COMPILE", "0")
        patch.setattr(report_flight, "_BUDGET_STATES", 30)
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


def test_other_flights_have_none() -> None:
    assert figure_of("planar_chain") is None
    assert _REPORT_FIGURES[-1] is FIGURES["momentum_budget"] is momentum_budget_figure


def test_a_robot_without_inertia_has_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RobotDescriptionError("The robot has no inertia.")

    monkeypatch.setattr(report_flight, "momentum_budget_over_time", refuse)
    assert figure_of("capture") == "The momentum budget is not drawn. The robot has no inertia."
