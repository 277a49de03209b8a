"""Events of a bag below the time axes of its report."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from support.command_line import CliRunner
from support.flight_bags import GOAL, TICK, Story, goal_value, still, tell

from spacerobot_ros.cli.main import main
from spacerobot_ros.events import EventKind
from spacerobot_ros.report import figures_over_time
from spacerobot_ros.report.events import _MARKS
from spacerobot_ros.report.flight import FlightReport, read_report

EVENTS = [
    (0.05, {"event": "goal_accepted", "time": "0.05"}),
    (0.10, {"event": "plan_ready", "time": "0.1", "wall_time": "1.7e9"}),
    # The recorder was late: the node knows when it was.
    (0.90, {"event": "fault_injected", "time": "0.4"}),
    (0.60, {"event": "latched"}),
    (0.70, {"event": "rearmed", "time": "0.7"}),
    (0.72, {"event": "plan_taken_over", "time": "0.72"}),
    (0.75, {"event": "goal_aborted", "time": "0.75"}),
    (0.80, {"event": "activated", "time": "0.8"}),
    (0.80, {"event": "of another version", "time": "0.8"}),
    (0.80, {"event": "latched", "time": "nan"}),
    (0.80, {"event": "latched", "time": "1e300"}),
    (0.80, {}),
]
TIMES = {
    "goal_accepted": 0.05,
    "plan_ready": 0.1,
    "fault_injected": 0.4,
    "latched": 0.6,
    "rearmed": 0.7,
    "plan_taken_over": 0.72,
    "goal_aborted": 0.75,
}


def story(tmp_path: Path, events: Any = EVENTS, **options: Any) -> Path:
    executing = {"state": "executing", "method": "lie_bracket", **goal_value()}
    shapes = still(count=21)
    shapes[:, 0] = [0.01 * k for k in range(21)]
    return tell(
        tmp_path / "a.mcap",
        Story(
            shapes,
            statuses=[(0.1, "Executing.", executing)],
            goals=[(0.05, *GOAL)],
            events=events,
            **options,
        ),
    )


def lanes(figure: Figure) -> list[Any]:
    return [axes for axes in figure.axes if axes.get_label() == "events"]


def test_events_have_the_time_that_their_node_gave(tmp_path: Path) -> None:
    flight = read_report(story(tmp_path))
    found = {each.event.kind.value: each.time for each in flight.timed_events}
    assert found == pytest.approx(TIMES)
    assert {each.node for each in flight.timed_events} == {"/node"}


@pytest.mark.parametrize(
    "draw",
    [
        figures_over_time.position_figure,
        figures_over_time.attitude_figure,
        figures_over_time.shape_figure,
        figures_over_time.rates_figure,
        figures_over_time.momentum_figure,
    ],
)
def test_a_lane_below_every_time_axis_has_every_event(
    tmp_path: Path, draw: Callable[[FlightReport], Any]
) -> None:
    made = draw(read_report(story(tmp_path)))
    assert "Below the time axis" in made.caption
    figure = made.figure
    timed = [axes for axes in figure.axes if axes.get_xlabel() == "time (s)"]
    below = lanes(figure)
    assert len(below) == len(timed) >= 1
    for lane, axes in zip(below, timed, strict=True):
        assert lane.get_xlim() == axes.get_xlim() == pytest.approx((0.0, 20 * TICK))
        assert lane.get_position().y1 < axes.get_position().y0
        assert lane.get_position().y0 > 0
        drawn = sorted(x for line in lane.lines for x in line.get_xdata())
        assert drawn == pytest.approx(sorted(TIMES.values()))
        labels = {text.get_text() for text in lane.get_legend().get_texts()}
        assert labels == {_MARKS[EventKind(kind)].label for kind in TIMES}


@pytest.mark.parametrize("events", [[], EVENTS[7:]])
def test_a_bag_without_events_has_no_lane(tmp_path: Path, events: list[Any]) -> None:
    made = figures_over_time.position_figure(read_report(story(tmp_path, events)))
    assert not isinstance(made, str)
    assert "Below the time axis" not in made.caption
    assert not lanes(made.figure)


def test_figures_for_papers_show_events_only_if_asked(tmp_path: Path) -> None:
    words = ["figures", str(story(tmp_path)), "--only", "position", "--format", "svg"]
    for option in ([], ["--events"]):
        folder = tmp_path / "_".join(["figures", *option])
        result = CliRunner().invoke(main, [*words, *option, "-o", str(folder)])
        assert result.exit_code == 0, result.output
        text = (folder / "position.svg").read_text("utf-8")
        # The goal has an entry in the legend of the figure itself.
        labels = {_MARKS[EventKind(kind)].label for kind in TIMES} - {"goal"}
        assert len(labels) > 3
        for label in labels:
            assert (f">{label}<" in text) == bool(option), (label, option)


def test_every_kind_is_a_mark_of_its_own() -> None:
    looks = [(m.marker, m.colour, m.hollow, m.row) for m in _MARKS.values()]
    different = set(looks)
    # Faults that end and faults that are cleared are one thing to the eye.
    assert len(different) == len(looks) - 1
    wanted = {
        *(EventKind.GOAL_ACCEPTED, EventKind.PLAN_READY, EventKind.FAULT_INJECTED),
        *(EventKind.FAULT_ENDED, EventKind.FAULTS_CLEARED, EventKind.LATCHED, EventKind.REARMED),
        *(EventKind.STUCK_JOINT, EventKind.GOAL_ABORTED),
    }
    assert wanted <= _MARKS.keys()
