"""Flight events drawn below the time axes of figures: goals, plans, faults, latches."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.lines import Line2D
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D

from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.report.figures import (
    EVENTS,
    PALETTE,
    SECONDARY_COLOUR,
    TEXT_COLOUR,
    fit_legend,
    inches,
    panel,
)
from spacerobot_ros.simulation.faults import with_seconds

EVENT_STRIP_HEIGHT = 0.62
"""Height of an event strip with its legend below a time axis, inches."""

_MAX_MARKS = 2000
"""Largest number of marks in a strip: more marks would overlap."""

_STRIP_DISTANCE = 0.44
"""Distance from the axis to the strip's upper edge, inches, including space for labels."""

_STRIP_HEIGHT = 0.24
_GOOD, _BAD, _WARN, _PLAIN = PALETTE[2], "#c62f2f", PALETTE[1], PALETTE[0]


@dataclass(frozen=True)
class _Mark:
    """How events of a kind are drawn.

    ``row`` 0 is for goals and plans, 1 for faults, 2 for the robot; ``strong`` marks span the full
    height of a chart.
    """

    label: str
    glyph: str
    colour: str
    row: int
    strong: bool = False


_MARKS = {
    EventKind.GOAL_ACCEPTED: _Mark("goal", "▼", _PLAIN, 0),
    EventKind.GOAL_REFUSED: _Mark("goal refused", "▽", _BAD, 0),
    EventKind.PLAN_STARTED: _Mark("plan begun", "○", _PLAIN, 0),
    EventKind.PLAN_READY: _Mark("plan", "●", _PLAIN, 0),
    EventKind.PLAN_TAKEN_OVER: _Mark("takeover", "▶", _PLAIN, 0),
    EventKind.PLAN_LATE: _Mark("plan late", "▷", _WARN, 0),
    EventKind.PLAN_DISTURBED: _Mark("plan disturbed", "◁", _WARN, 0),
    EventKind.CORRECTION: _Mark("correction", "□", _PLAIN, 0),
    EventKind.GOAL_REACHED: _Mark("goal reached", "★", _GOOD, 0),
    EventKind.GOAL_REACHED_PARTLY: _Mark("goal reached in part", "★", _WARN, 0),
    EventKind.GOAL_FAILED: _Mark("goal failed", "✖", _BAD, 0),
    EventKind.GOAL_ABORTED: _Mark("aborted", "✖", _WARN, 0, strong=True),
    EventKind.FAULT_INJECTED: _Mark("fault on", "▲", _WARN, 1, strong=True),
    EventKind.FAULT_ENDED: _Mark("fault off", "△", _WARN, 1, strong=True),
    EventKind.FAULTS_CLEARED: _Mark("faults off", "△", _WARN, 1, strong=True),
    EventKind.DISTURBANCE: _Mark("disturbance", "◀", _WARN, 1, strong=True),
    EventKind.DISTURBANCE_ENDED: _Mark("disturbance over", "◁", _WARN, 1, strong=True),
    EventKind.WHEEL_NEAR_LIMIT: _Mark("wheel near its limit", "○", _WARN, 2),
    EventKind.WHEEL_SATURATED: _Mark("wheel saturated", "●", _WARN, 2),
    EventKind.WHEEL_FAILED: _Mark("wheel failed", "●", _BAD, 2, strong=True),
    EventKind.DUMP_STARTED: _Mark("momentum dump", "●", _PLAIN, 2),
    EventKind.DUMP_ENDED: _Mark("momentum dumped", "●", _GOOD, 2),
    EventKind.CONTACT: _Mark("contact", "✚", _BAD, 2, strong=True),
    EventKind.CONTACT_ENDED: _Mark("contact over", "✙", _BAD, 2),
    EventKind.APPROACH_STARTED: _Mark("approach", "▷", _PLAIN, 2),
    EventKind.DETUMBLE_STARTED: _Mark("detumbling", "▽", _PLAIN, 2),
    EventKind.DETUMBLED: _Mark("detumbled", "▼", _GOOD, 2),
    EventKind.CAPTURED: _Mark("captured", "◆", _GOOD, 2, strong=True),
    EventKind.RELEASED: _Mark("released", "◇", _GOOD, 2),
    EventKind.LATCHED: _Mark("latched", "■", _BAD, 2, strong=True),
    EventKind.REARMED: _Mark("rearmed", "□", _GOOD, 2),
    EventKind.STUCK_JOINT: _Mark("stuck joint", "◆", _BAD, 2, strong=True),
    EventKind.FAILED: _Mark("node failed", "✖", _BAD, 2),
    EventKind.RESTING: _Mark("at rest", "❙", SECONDARY_COLOUR, 2),
    EventKind.RUNNING: _Mark("running", "❙", _GOOD, 2),
    EventKind.PAUSED: _Mark("paused", "❙", TEXT_COLOUR, 2),
    EventKind.RESUMED: _Mark("resumed", "❙", _PLAIN, 2),
    EventKind.RESET: _Mark("reset", "✚", TEXT_COLOUR, 2),
    EventKind.RECORDING_FAILED: _Mark("recording failed", "⧫", _BAD, 2),
    EventKind.FILE_SPLIT: _Mark("next file", "◊", SECONDARY_COLOUR, 2),
    EventKind.NODE_SILENT: _Mark("node silent", "⬢", _BAD, 2),
    EventKind.NODE_BACK: _Mark("node back", "⬡", _GOOD, 2),
    EventKind.NODE_RESTARTED: _Mark("node restarted", "⬢", _WARN, 2),
}
"""Event marks by kind; other kinds, such as node starts and stops, are not drawn."""


def event_style(kind: EventKind) -> dict[str, Any]:
    """Return the appearance of an event kind on a page."""
    shown = ("glyph", "colour", "row", "strong")
    return {"kind": kind.value} | {name: getattr(_MARKS[kind], name) for name in shown}


_ABOUT = ("fault", "disturbance", "joints", "reason", "method", "node", "first", "second", "wheel")


def event_text(event: Event) -> str:
    """Return an event in a few words, such as ``fault on: joint_stuck elbow at 5 s``."""
    label, about = _MARKS[event.kind].label, event.about
    details = [with_seconds(about[key]) for key in _ABOUT if about.get(key)]
    return f"{label}: {', '.join(details)}" if details else label


def shown_events(events: Iterable[Event]) -> list[tuple[float, Event]]:
    """Return the events that are drawn with their times, s, in chronological order."""
    # The comparison is false for NaN.
    timed = [(each.time_s, each) for each in events if each.kind in _MARKS]
    found = [(time, each) for time, each in timed if time is not None and abs(time) < 1e12]
    return sorted(found, key=lambda pair: pair[0])


def draw_events(axes: Axes, events: Sequence[tuple[float, Event]]) -> None:
    """Draw a strip below a time axis, with the events in the time span of the axis and a legend of
    the event marks."""
    start, end = axes.get_xlim()
    shown = [(time, each) for time, each in events if start <= time <= end][:_MAX_MARKS]
    figure = axes.figure
    assert isinstance(figure, Figure)
    across, up = figure.get_size_inches()
    box = axes.get_position()
    x, width = box.x0 * across, box.width * across
    height = inches(_STRIP_HEIGHT)
    lane = panel(figure, x, box.y0 * up - inches(_STRIP_DISTANCE) - height, width, height)
    lane.set_xlim(start, end)
    lane.set_ylim(-0.6, 1.6)
    lane.grid(False)
    lane.spines[:].set_visible(False)
    lane.set_facecolor("#f4f5f7")
    lane.tick_params(left=False, bottom=False, labelleft=False, labelbottom=False)
    lane.set_label(EVENTS)
    for kind, mark in _MARKS.items():
        times = [time for time, each in shown if each.kind is kind]
        if times:
            # Without labels, faults need no separate row.
            height = 0 if mark.row else 1
            lane.plot(times, [height] * len(times), clip_on=False, **_marker_style(mark))
    kinds = {each.kind for _, each in shown}
    keys = [
        Line2D([], [], label=mark.label, **_marker_style(mark))
        for kind, mark in _MARKS.items()
        if kind in kinds
    ]
    if keys:
        legend = lane.legend(
            handles=keys,
            loc="upper left",
            bbox_to_anchor=(0.0, 0.02),
            ncols=len(keys) if width > inches(4) else 4,
            borderaxespad=0.0,
            handletextpad=0.2,
            columnspacing=0.9,
            fontsize=7.0 if len(keys) <= 8 else 5.5,
        )
        fit_legend(legend, figure.bbox.width - lane.bbox.x0)


def _marker_style(mark: _Mark) -> dict[str, Any]:
    path = TextPath((0.0, 0.0), mark.glyph, prop=FontProperties(family="DejaVu Sans"))
    (x0, y0), (x1, y1) = path.get_extents().get_points()
    centered = path.transformed(Affine2D().translate(-(x0 + x1) / 2, -(y0 + y1) / 2))
    look = {"color": mark.colour, "markeredgewidth": 0.0, "linestyle": "none"}
    return {"marker": centered, "markersize": 6.0, **look}
