"""The graphical report of a flight, created from its bag alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from matplotlib.figure import Figure

from spacerobot_ros.errors import SpaceRobotError, enumeration
from spacerobot_ros.files import write_output
from spacerobot_ros.report import figures_over_time as over_time
from spacerobot_ros.report import figures_space as space
from spacerobot_ros.report.figures import (
    WIDTH,
    PictureFormat,
    ReportFigure,
    drawing,
    legend_above,
    letter_panels,
    panel,
    picture_of,
    room_for,
    sheet,
    widen_panels,
)
from spacerobot_ros.report.flight import FlightReport, labels_of, read_report
from spacerobot_ros.report.page import page
from spacerobot_ros.report.player import player_of, view_of_flight
from spacerobot_ros.report.scene import bodies_of, obstacles_of
from spacerobot_ros.report.solids import MAX_MESH_FACES, corner_points, placed_solids
from spacerobot_ros.resources import suggestion

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
        raise SpaceRobotError(over_time.NO_POSES_TEXT)
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
