"""The graphical report of a flight, created from its bag alone."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from spacerobot_ros.errors import SpaceRobotError, counted, enumeration, sentence_case
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.files import warn_once, write_output
from spacerobot_ros.measures import Outcome
from spacerobot_ros.report import figures_over_time as over_time
from spacerobot_ros.report import figures_space as space
from spacerobot_ros.report.events import event_style, event_text
from spacerobot_ros.report.figures import (
    WIDTH,
    PictureFormat,
    ReportFigure,
    TraceGroup,
    drawing,
    legend_above,
    letter_panels,
    log_range,
    panel,
    picture_of,
    room_for,
    sheet,
    widen_panels,
)
from spacerobot_ros.report.flight import FlightReport, labels_of, read_report
from spacerobot_ros.report.page_parts import (
    PagePart,
    facts,
    figure,
    folded,
    html_page,
    missing,
    package_file,
    table,
    tiles,
    unbroken,
)
from spacerobot_ros.report.player import player_of, view_of_flight
from spacerobot_ros.report.scene import (
    MAX_MESH_FACES,
    bodies_of,
    corner_points,
    obstacles_of,
    placed_solids,
)
from spacerobot_ros.report.tables import (
    different_goals,
    headline,
    joint_table,
    published_table,
    result_table,
    runs_table,
)
from spacerobot_ros.resources import suggestion
from spacerobot_ros.scenario import different_parameters

_PAPER_WIDTHS = (40.0, 400.0)
"""Smallest and largest figure width for a paper, mm."""

_PICTURE_PIXELS = 1000

_ROBOT_PANEL_WIDTH = 3.9
"""Robot width in a picture, inches."""

Draw = Callable[[FlightReport], ReportFigure | str | None]

FIGURES: dict[str, Draw] = {
    "robot": space.configurations_figure,
    "pose": over_time.pose_figure,
    "position": over_time.position_figure,
    "attitude": over_time.attitude_figure,
    "cycles": space.cycles_figure,
    "joints": over_time.shape_figure,
    "velocities": over_time.rates_figure,
    "loops": space.loops_figure,
    "errors": over_time.errors_figure,
    "link_errors": over_time.link_errors_figure,
    "sensors": over_time.sensors_figure,
    "efforts": over_time.efforts_figure,
    "thrusters": over_time.thrusters_figure,
    "twist": over_time.twist_figure,
    "clearance": over_time.clearance_figure,
    "momentum": over_time.momentum_figure,
    "momentum_budget": over_time.momentum_budget_figure,
    "path": space.path_figure,
}
"""The figures that :func:`write_figures` can write, by name."""

_REPORT_FIGURES = tuple(draw for name, draw in FIGURES.items() if name not in ("pose", "path"))
"""Report figures, with separate position and attitude figures and a figure of all paths."""


def write_report(
    bag: Path, html: Path, beside: Sequence[Path] = (), *, namespace: str | None = None
) -> None:
    """Write the report of a bag as one self-contained HTML file.

    A page is created for any bag: if data are missing, the affected sections are omitted, and the
    page states this. Bags in ``beside``, for example from other methods for the same goal, are
    added as columns in a table and as paths in the path figure. If the bag has several robots,
    ``namespace`` selects one.

    Raises
    ------
    SpaceRobotError
        There is no such bag or robot, a bag is damaged, or the file cannot be written.
    """
    flight = read_report(bag, namespace)
    others = [read_report(other) for other in beside]
    with drawing():
        figures = [_report_figure(draw, [flight, *others]) for draw in _REPORT_FIGURES]
        figures.append(space.path_figure(flight, others))
        text = page(flight, player_of(view_of_flight(flight)), figures, others)
    write_output(html, text)
    for topic, values in (("odom", flight.time), ("joint_states", flight.q)):
        if not len(values) and (instead := flight.bag.instead_of(topic)):
            warn_once(f"The bag {bag} contains no {topic}{instead}.")


def _report_figure(draw: Draw, flights: Sequence[FlightReport]) -> ReportFigure | str | None:
    """Return a figure of the first flight, with the traces of the others over time."""
    figure = draw(flights[0])
    if len(flights) < 2 or not isinstance(figure, ReportFigure) or not figure.groups:
        return figure
    if any(group.rows for group in figure.groups):
        return figure
    drawn = [figure, *(draw(each) for each in flights[1:])]
    merged = over_time.figure_of_flights(flights, drawn)
    assert isinstance(merged, ReportFigure)
    first, *others = labels_of(flights)
    styles = f"Solid lines: {first}; other line styles: {enumeration(others)}."
    return replace(merged, caption=f"{figure.caption} {styles}")


def write_figures(
    bag: Path,
    folder: Path,
    only: Sequence[str] = (),
    *,
    beside: Sequence[Path] = (),
    format: PictureFormat = PictureFormat.PDF,
    width: float = 88.0,
    style: Path | None = None,
    events: bool = False,
    degrees: bool = False,
    namespace: str | None = None,
) -> dict[str, Path | str]:
    """Write a flight's figures for a paper, one file each.

    Parameters
    ----------
    bag
        The flight.
    folder
        Output folder for the files (``pose.pdf`` and so on); existing files are replaced.
    only
        Names of :data:`FIGURES`; empty for all figures for which the bag has data, with position
        and attitude in one figure.
    beside
        Other flights, whose traces and paths are added to the same panels; figures that show a
        single flight are omitted.
    format
        Format of the files. Text in PDF and SVG files remains editable text.
    width
        Figure width, mm.
    style
        A matplotlib style file (for fonts, and for sizes and colours of lines and axes), the name
        of a matplotlib style, or ``serif``.
    events
        Whether to show events below time axes.
    degrees
        Whether angles over time are in degrees instead of rad.
    namespace
        Robot namespace, if the bag has several robots.

    Returns
    -------
    For each figure its file, or a sentence on why the bag has none.

    Raises
    ------
    SpaceRobotError
        There is no such figure or bag, or a file cannot be read or written.
    """
    unknown = [name for name in only if name not in FIGURES]
    if unknown:
        known, meant = ", ".join(FIGURES), suggestion(unknown[0], FIGURES)
        raise SpaceRobotError(f"There is no figure '{unknown[0]}': the figures are {known}.{meant}")
    if not _PAPER_WIDTHS[0] <= width <= _PAPER_WIDTHS[1]:
        least, most = _PAPER_WIDTHS
        raise SpaceRobotError(f"A figure must be {least:g} to {most:g} mm wide, not {width:g} mm.")
    if folder.suffix.lower() in {f".{each.value}" for each in PictureFormat}:
        raise SpaceRobotError(
            f"Figures are written to a folder, with one file per figure; '{folder.name}' is a "
            "file name."
        )
    flight, *others = (read_report(each, namespace) for each in (bag, *beside))
    if others or not events:
        flight = replace(flight, draws_events=False)
    made: dict[str, Path | str] = {}
    with drawing(width / 25.4, "paper", style, degrees=degrees):
        for name in only or [name for name in FIGURES if name not in ("position", "attitude")]:
            try:
                drawn = [FIGURES[name](each) for each in (flight, *others)]
                figure = over_time.figure_of_flights([flight, *others], drawn)
                if name == "path":
                    figure = space.path_figure(flight, others)
                if not isinstance(figure, ReportFigure):
                    made[name] = figure or "The bag has no data for this figure."
                    continue
                letter_panels(figure.figure)
                widen_panels(figure.figure)
                picture = picture_of(figure.figure, format)
            except (ValueError, ArithmeticError, RuntimeError, TypeError) as error:
                if style is None:
                    raise
                # matplotlib rejects some style file settings only when it draws.
                raise SpaceRobotError(
                    f"Figures cannot be drawn with the style file {style}: {error}."
                ) from error
            made[name] = path = folder / f"{name}.{format.value}"
            write_output(path, picture)
    return made


def write_picture(bag: Path, picture: Path, *, namespace: str | None = None) -> None:
    """Write one picture of a flight: pose and shape over time, and the robot.

    Depending on the file suffix, it is a PNG (1000 pixels wide), an SVG or a PDF.

    Raises
    ------
    SpaceRobotError
        There is no such bag, the bag is damaged or contains no base poses, or the file cannot be
        written.
    """
    format = PictureFormat.of(picture)
    flight = read_report(bag, namespace)
    if not len(flight.time):
        raise SpaceRobotError(flight.no_poses_text)
    with drawing():
        write_output(picture, picture_of(_overview_figure(flight), format, _PICTURE_PIXELS))


def _overview_figure(flight: FlightReport) -> Figure:
    groups = [over_time.position_group(flight), over_time.attitude_group(flight)]
    if len(flight.q):
        groups += over_time.shape_groups(flight)[:1]
    robot, around = [], placed_solids(obstacles_of(flight), 0)
    if not flight.hidden_links_text:
        last = [len(flight.time) - 1]
        robot = placed_solids(bodies_of(flight, last, MAX_MESH_FACES), 0)
    right = room_for([name for group in groups for name in group.names])
    beside = _ROBOT_PANEL_WIDTH if robot else 0.1
    rows = [[1.0]] * len(groups)
    figure, panels = sheet(rows, [1.25] * len(groups), right=right + beside, top=0.77, gap=0.42)
    for number, (group, (axes,)) in enumerate(zip(groups, panels, strict=True)):
        over_time.draw_group(axes, group, flight.end, [t for t, _ in flight.executing[1:]])
        if number < len(groups) - 1:
            axes.set_xlabel("")
            axes.tick_params(labelbottom=False)
    up = float(figure.get_size_inches()[1])
    if robot:
        size = _ROBOT_PANEL_WIDTH - 0.15
        axes = panel(figure, WIDTH - size - 0.1, 0.2, size, up - 1.0)
        view = space.view_of(flight)
        points = space.with_near(corner_points(robot), corner_points(around), view)
        space.draw_robot(axes, [*robot, *around], points, view)
        legend_above(axes, space.draw_goal_and_path(axes, flight, view))
    title = ": ".join(filter(None, (flight.scenario.name, flight.scenario.description)))
    figure.text(0.1 / WIDTH, 1 - 0.24 / up, title, size=10.5, weight="bold")
    return figure


# -- the page -------------------------------------------------------------------------------------

_CHART_HELP = (
    '<p class="facts" id="use">Drag across a chart to zoom all charts; double-click for the whole '
    "flight. Click once to see the robot at that instant above; the vertical line marks the "
    "instant shown there. Click a name to hide its trace.</p>"
)
_MAX_EVENT_ROWS, _MAX_UNFOLDED_ROWS = 200, 20
"""Largest number of events in the table, and the largest number for which the table is not
collapsed."""

_BREAK_SHARE = 0.005
"""Fraction of the time axis for which a trace pauses after a break."""

_CHART_SLICES = 500
"""Number of time slices in a chart of a dense trace."""

_MAX_CHART_EVENTS = 500

_IDLE = ("waiting", "idle", "holding")
"""States without a goal."""

_EVENTS_CAPTION = (
    " Events below the time axis: goals and plans in the upper row, robot and faults below."
)
"""Caption of the strip below the first chart."""

_FIRST_ALONE = (
    '<p class="facts">The charts and the paths below show all runs; numbers, events, the 3D view '
    "and other figures show the first one.</p>"
)

_FOLDED = ("velocities", "efforts", "twist")
"""Names of the collapsed figures."""

Figures = Sequence[ReportFigure | str | None]
"""Figures on a page; a string explains why a figure is missing."""


def page(
    flight: FlightReport, player: PagePart, figures: Figures, beside: Sequence[FlightReport] = ()
) -> str:
    """Return the whole page; each flight in ``beside`` gets a column in a table."""
    charts = charts_of(flight, figures, beside)
    scenario = flight.scenario.described_for_other_goal() if flight.other_goal else flight.scenario
    name, description = scenario.name, scenario.description
    robot_name = "" if flight.robot is None else flight.robot.name
    title = ", ".join(filter(None, (name, flight.flown_method, robot_name)))
    body = [
        "<header>",
        f"<h1>{escape(name)}</h1>",
        f"<p>{escape(description)}</p>" if description else "",
        _facts_html(flight),
        _outcome_html(flight),
        tiles(headline(flight)),
        "</header>",
        *_runs_html(flight, beside),
        player.markup,
        *_numbers_html(flight),
        *_published_html(flight),
        *_events_html(flight.timed_events),
        "<h2>Figures</h2>",
        _CHART_HELP if charts.data else "",
        *_figures_html(figures, has_events=bool(flight.timed_events)),
        *_parameters_html(flight),
    ]
    return html_page(title, body, _footer_text([flight, *beside]), (player, charts))


def _facts_html(flight: FlightReport) -> str:
    found = []
    if flight.flown_method:
        found.append(f"method {flight.flown_method}")
    if flight.robot is not None:
        joints = counted(len(flight.robot.joint_names), "joint")
        found.append(f"robot {flight.robot.name}: {joints}, {flight.robot.total_mass:.5g} kg")
    if flight.bag.namespace:
        found.append(f"namespace {flight.bag.namespace}")
    if flight.other_robots:
        found.append(f"the bag also contains {', '.join(flight.other_robots)}")
    return facts(found)


def _outcome_html(flight: FlightReport) -> str:
    if not flight.timed_statuses:
        return (
            '<p class="outcome">The bag contains no planner or controller status '
            "(planner/status, controller/status).</p>"
        )
    statuses, verdict = [each for _, each in flight.timed_statuses], flight.verdict
    # A controller holds the pose after it has refused a goal.
    of_goals = (x for x in reversed(statuses) if isinstance(x, str) or x.state.value not in _IDLE)
    last = next(of_goals, statuses[-1])
    tone = "" if isinstance(last, str) else last.state.value
    word, sentence = tone.capitalize(), last if isinstance(last, str) else last.message
    if tone in ("executing", "tracking") and flight.outcome is Outcome.INTERRUPTED:
        sentence = flight.message
    if tone in ("reached", "reached_partly", "failed", flight.outcome.value):
        word, sentence = verdict.word, verdict.sentence
    if tone.startswith("reached"):
        tone = "reached" if verdict.complete else "reached partly"
    sentence = sentence_case(sentence.removeprefix(f"{word}: "))  # Such as 'Aborted: '.
    state = f"<b>{escape(word)}</b>" if word else ""
    return f'<p class="outcome {escape(tone)}">{state}{unbroken(sentence)}</p>'


def _runs_html(flight: FlightReport, beside: Sequence[FlightReport]) -> list[str]:
    if not beside:
        return []
    flights = [flight, *beside]
    parts = ["<h2>Runs side by side</h2>", table("runs", *runs_table(flights)), _FIRST_ALONE]
    files = labels_of(flights)
    if goals := different_goals(flights):
        parts += ["<h3>Goals that differ</h3>", table("goals", ("Goal", *files), goals)]
    if rows := different_parameters([each.scenario for each in flights]):
        head = ("Parameter", *files)
        parts += ["<h3>Parameters that differ</h3>", table("different", head, rows)]
    return parts


def _numbers_html(flight: FlightReport) -> list[str]:
    result, joints = result_table(flight), joint_table(flight)
    parts = ["<h2>Numbers of the run</h2>"]
    if flight.goal is None and not flight.tool_goals:
        parts.append(missing("The bag contains no goal pose."))
    if result.rows:
        parts.append(table("numbers", (), result.rows))
    if joints is not None:
        parts.append(table("joints", *joints))
    return parts


def _published_html(flight: FlightReport) -> list[str]:
    found = published_table(flight)
    if found is None:
        return []
    return [
        "<h2>Published and measured values</h2>",
        table("published", *found),
        '<p class="facts">Source: “planner”, values of the first schedule; “flight”, '
        "measured values.</p>",
    ]


def _figures_html(figures: Figures, *, has_events: bool) -> list[str]:
    first_chart = 0
    sentences = dict.fromkeys(each for each in figures if isinstance(each, str))
    parts = [missing(each) for each in sentences]
    drawn = [each for each in figures if isinstance(each, ReportFigure)]
    for number, each in enumerate(drawn, start=1):
        numbers = " ".join(str(first_chart + k) for k in range(len(each.groups)))
        charts = f' data-charts="{numbers}"' if numbers else ""
        caption = f"<b>Figure {number}. {escape(each.heading)}.</b> {escape(each.caption)}"
        if has_events and each.groups and first_chart == 0:
            caption += _EVENTS_CAPTION
        first_chart += len(each.groups)
        shown = figure(each.name, each.svg, each.heading, caption, charts)
        parts.append(folded(each.heading, shown) if each.name in _FOLDED else shown)
    return parts


def _events_html(events: Sequence[tuple[float, Event]]) -> list[str]:
    """Return the table of events by time; if there are very many, only the first rows."""
    if not events:
        return []
    rows = [(f"{time:.6g}", event_text(event), event.message, event.node) for time, event in events]
    more = len(rows) - _MAX_EVENT_ROWS
    head = ("Time (s)", "Event", "Message", "Node")
    note = f'<p class="facts">{more} more events are in the bag.</p>' if more > 0 else ""
    shown = table("events", head, rows[:_MAX_EVENT_ROWS], (0,)) + note
    if len(rows) > _MAX_UNFOLDED_ROWS:
        shown = folded(f"{len(rows)} events", shown)
    return ["<h2>Events</h2>", shown]


def _parameters_html(flight: FlightReport) -> list[str]:
    parts = []
    for name, values in flight.bag.metadata.items():
        kind, _, node = name.partition("/")
        if kind == "parameters":
            parts.append(folded(node, table(f"parameters-{node}", (), list(values.items()))))
    return ["<h2>Parameters</h2>", *parts] if parts else []


def _footer_text(flights: Sequence[FlightReport]) -> str:
    bag = flights[0].bag
    version = bag.metadata.get("spacerobot", {}).get("version", "")
    by = f", recorded by spacerobot_ros {version}" if version else ""
    names = " and ".join(each.bag.path.name for each in flights)
    return f"Created from {names} alone; {bag.path.name} has {bag.message_count} messages{by}."


# -- charts -------------------------------------------------------------------------------------


def charts_of(
    flight: FlightReport, figures: Figures, beside: Sequence[FlightReport] = ()
) -> PagePart:
    """Return the charts of all figures over time, with the traces of flights ``beside``.

    Each figure element lists its chart numbers in ``data-charts``.
    """
    groups = [group for each in figures if isinstance(each, ReportFigure) for group in each.groups]
    if not groups:
        return PagePart()
    charts = {
        "end": max(each.end for each in (flight, *beside)),
        "charts": [_chart_data(group, labels_of([flight, *beside])) for group in groups],
        "events": _chart_events(flight),
    }
    return PagePart(
        data={"charts": charts},
        programs=(package_file("vendor/uPlot.iife.min.js"), package_file("charts.js")),
        style=package_file("vendor/uPlot.min.css"),
        notices=(("uPlot", package_file("vendor/uPlot.LICENSE.txt")),),
    )


def _chart_events(flight: FlightReport) -> list[dict[str, Any]]:
    """Return the events of a flight; simultaneous events of one kind are numbered."""
    found = []
    together: dict[tuple[float, EventKind], list[str]] = {}
    for time, event in flight.timed_events[:_MAX_CHART_EVENTS]:
        sentences = together.setdefault((time, event.kind), [])
        text = f"{event_text(event)} (+{len(sentences)})" if sentences else event_text(event)
        sentences.append(event.message)
        shown = {"time": time, "sentence": " ".join(sentences), "text": text}
        found.append(shown | event_style(event.kind))
    return found


def _chart_data(group: TraceGroup, labels: Sequence[str]) -> dict[str, Any]:
    signals = [each.thinned(_CHART_SLICES) for each in (group.signal, *group.beside)]
    time, values = signals[0].time, signals[0].values
    names, flights = list(group.names), len(signals)
    if group.beside:
        time = np.unique(np.concatenate([each.time for each in signals]))
        values = np.hstack([each.at(time) for each in signals])
        names = [f"{name}, {label}" for label in labels for name in group.names]
    for row in np.flatnonzero(np.isnan(values).all(axis=1))[::-1]:
        # uPlot shows a break only if it is some pixels wide.
        end = np.searchsorted(time, time[row] + _BREAK_SHARE * np.ptp(time))
        time = np.delete(time, slice(row + 1, end))
        values = np.delete(values, slice(row + 1, end), axis=0)
    if group.decades:
        # uPlot's own logarithmic axes fail with numbers as small as rounding errors.
        floor, _ = log_range(values, group.decades)
        values = np.log10(np.maximum(values, floor))
        limits = [[k, float(np.log10(each))] for k, each in group.limits if each > floor]
    else:
        numbers = np.append(group.values, [goal[3] for goal in group.goals])
        low, high = group.window or (float(np.min(numbers)), float(np.max(numbers)))
        room = 0.2 * max(high - low, 1e-6)
        limits = [[k, x] for k, x in group.limits if low - room < x < high + room]
    if group.rows:
        values = values * 0.8 + np.arange(values.shape[1])[::-1]
    return {
        "label": group.label,
        "unit": group.unit,
        "names": names,
        "own": len(group.names),
        "colours": list(group.colours) * flights,
        "time": _encode_numbers(time, "<f8"),
        "values": [_encode_numbers(column, "<f4") for column in values.T],
        "goals": [list(map(float, goal)) for goal in group.goals],
        "limits": limits,
        "window": group.window,
        "log": group.decades > 0,
        "rows": group.rows,
    }


def _encode_numbers(values: Any, kind: str) -> str:
    """Return the bytes of numbers, little-endian, as base64."""
    return base64.b64encode(np.ascontiguousarray(values, kind).tobytes()).decode()
