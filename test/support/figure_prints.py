"""Fingerprints of the reports of the reference flights, and of the pictures of robots.

Of each panel of a figure there is one of its frame, lines, areas and texts; tables are kept word
for word.

A change of a figure is seen in the panel and the kind of artist whose fingerprint differs. Numbers
count to five digits, so that other versions of numpy and matplotlib draw the same figures.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation, Text

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.analysis import analyze
from spacerobot_ros.report.figures import WIDTH, ReportFigure, drawing
from spacerobot_ros.report.figures_over_time import momentum_figure, shape_figure, thrusters_figure
from spacerobot_ros.report.flight import FlightReport, read_report
from spacerobot_ros.report.page_parts import PagePart
from spacerobot_ros.report.planning_figures import _planar_figure, _spatial_figure
from spacerobot_ros.report.player import view_of_flight
from spacerobot_ros.report.tables import (
    headline,
    joint_table,
    published_table,
    result_table,
    runs_table,
)
from spacerobot_ros.report.writing import FIGURES, _overview_figure, charts_of, page
from spacerobot_ros.resources import robot_file

ROOT = Path(__file__).resolve().parents[2]


@cache
def _flight(name: str) -> FlightReport:
    return read_report(ROOT / "bags" / f"{name}.mcap", None)


def _figure(flight: FlightReport, figure: str) -> dict[str, str] | None:
    with drawing(WIDTH, "report"):
        drawn = FIGURES[figure](flight)
        if not isinstance(drawn, ReportFigure):
            return None
        return {"caption": drawn.caption, **prints_of(drawn.figure)}


def _page(flight: FlightReport) -> list[str]:
    """Return the page with a picture that stands in for its figures, which are parts themselves."""
    missing = "It has no <errors>."
    stand_in = ReportFigure("pose", "Pose", "Shown too.", Figure())
    player = PagePart("<p>3D view</p>")
    with patch.object(ReportFigure, "svg", b"<svg/>"):
        return words_of(page(flight, player, [stand_in, missing, None, missing], [flight]))


def _charts(flight: FlightReport) -> dict[str, Any]:
    """Return the charts of two figures; the numbers of their samples as fingerprints."""
    with drawing():
        figures = [draw(flight) for draw in (momentum_figure, thrusters_figure, shape_figure)]
    content = charts_of(flight, figures).data.get("charts")
    if content is None:
        return {}
    for chart in content["charts"]:
        for name, kind in (("time", "<f8"), ("values", "<f4")):
            texts = chart[name] if isinstance(chart[name], list) else [chart[name]]
            numbers = [np.frombuffer(base64.b64decode(text), kind) for text in texts]
            chart[name] = [f"{len(each)}:{_digest([_numbers(each)])}" for each in numbers]
    return {"end": content["end"], "charts": content["charts"], "events": content["events"]}


PARTS: dict[str, Callable[[FlightReport], Any]] = {
    "numbers on top": lambda flight: [list(row) for row in headline(flight)],
    "results": lambda flight: result_table(flight).rows,
    "joints": lambda flight: getattr(joint_table(flight), "rows", None),
    "published": lambda flight: getattr(published_table(flight), "rows", None),
    "runs": lambda flight: runs_table([flight, flight]).rows,
    "page": _page,
    "charts": _charts,
    "3D view": lambda flight: _digest(
        map(_command, getattr(view_of_flight(flight), "commands", ["none"]))
    ),
    "overview": lambda flight: prints_of(_overview_figure(flight)),
    **{f"figure {figure}, report": partial(_figure, figure=figure) for figure in FIGURES},
}
"""The parts of a report by name; None where a bag has nothing for one."""


def report_part(name: str, part: str) -> Any:
    """Return a part of the report of a reference flight: a table, a figure or the 3D view."""
    return json.loads(json.dumps(PARTS[part](_flight(name))))


def report_prints(name: str) -> dict[str, Any]:
    """Return the parts that the report of a reference flight has."""
    found = {part: report_part(name, part) for part in PARTS}
    return {part: content for part, content in found.items() if content is not None}


def words_of(text: str) -> list[str]:
    """Return the lines of a page's body, without pictures, licences and footer."""
    body = text.partition("<main>\n")[2].partition("<footer>")[0]
    body = re.sub(r"<img [^>]*>", "<img>", body)
    return re.sub(
        r'<details id="licences">.*?</details>\n?', "", body, flags=re.DOTALL
    ).splitlines()


def analysis_prints(name: str) -> dict[str, str]:
    """Return the picture of what loops of a robot's joints do."""
    found = analyze(SpaceRobot.from_file(robot_file(name)))
    with drawing():
        draw = _planar_figure if found.planar.controllable else _spatial_figure
        return prints_of(draw(found))


def _command(command: Any) -> str:
    """Return a command of the 3D view, its numbers to five digits."""
    if isinstance(command, dict):
        return " ".join(f"{key}: {_command(value)}" for key, value in sorted(command.items()))
    if isinstance(command, (list, tuple)):
        return " ".join(map(_command, command))
    return f"{command:.5g}" if isinstance(command, float) else str(command)


def prints_of(figure: Figure) -> dict[str, str]:
    """Return a fingerprint for each kind of artist in each panel: ``"0 lines"``."""
    width, height = figure.get_size_inches()
    found = {"size": f"{width:.3f} x {height:.3f}", "texts": _digest(map(_text, figure.texts))}
    for number, axes in enumerate(figure.axes):
        kinds = {
            "frame": [_frame(axes)],
            "lines": map(_line, axes.lines),
            "areas": [*map(_area, axes.collections), *map(_patch, axes.patches)],
            "texts": map(_text, _texts(axes)),
            "ticks": map(_ticks, (axes.xaxis, axes.yaxis)),
            "legend": [] if (legend := axes.get_legend()) is None else _legend(legend),
        }
        found |= {f"{number} {kind}": _digest(parts) for kind, parts in kinds.items()}
    return found


def _digest(parts: Iterable[str]) -> str:
    lines = list(parts)
    return f"{len(lines)}:{hashlib.sha256('|'.join(lines).encode()).hexdigest()[:10]}"


def _numbers(values: Any) -> str:
    numbers: Any = np.ravel(np.ma.filled(np.ma.asarray(values, dtype=float), np.nan))
    return " ".join("0" if abs(x) < 1e-9 else f"{x:.5g}" for x in numbers.tolist())


def _look(artist: Artist) -> str:
    alpha = artist.get_alpha()
    return f"{artist.get_zorder():g} {'' if alpha is None else f'{alpha:g}'} {artist.get_visible()}"


def _frame(axes: Axes) -> str:
    bounds = _numbers([*axes.get_position().bounds, *axes.get_xlim(), *axes.get_ylim()])
    labels = [
        axes.get_xlabel(),
        axes.get_ylabel(),
        *(axes.get_title(each) for each in ("left", "center", "right")),
    ]
    spines = [
        f"{side} {spine.get_visible()} {_numbers(spine.get_edgecolor())}"
        for side, spine in axes.spines.items()
    ]
    looks = f"{_numbers(axes.get_facecolor())} {axes.axison} {axes.get_visible()} {spines}"
    scales = f"{axes.get_xscale()} {axes.get_yscale()} {axes.get_aspect()} {axes.get_box_aspect()}"
    return f"{bounds} {scales} {labels} {looks}"


def _ticks(axis: Axis) -> str:
    """Return where the ticks of an axis are, as far as they are chosen, and their looks."""
    locator: Any = axis.get_major_locator()
    chosen = getattr(locator, "locs", ())
    looks: Any = axis._major_tick_kw  # type: ignore[attr-defined]
    keys = ("gridOn", "tick1On", "label1On", "size", "labelsize")
    return (
        f"{type(locator).__name__} {getattr(locator, '_nbins', '')} "
        f"{_numbers(getattr(locator, '_steps', ()))} {_numbers(chosen)} "
        f"{[str(looks.get(key)) for key in keys]} {len(axis.get_minorticklocs()) > 0}"
    )


def _legend(legend: Legend) -> list[str]:
    """Return where a legend is, its distances, and its entries."""
    anchor = legend.get_bbox_to_anchor().transformed(legend.axes.transAxes.inverted())
    distances = (
        legend.borderaxespad,
        legend.handlelength,
        legend.handletextpad,
        legend.columnspacing,
    )
    place = f"{legend._loc} {_numbers(anchor.get_points())} {legend._ncols}"  # type: ignore[attr-defined]
    handles = [
        _line(handle) if isinstance(handle, Line2D) else _look(handle)
        for handle in legend.get_patches() + legend.get_lines()
    ]
    return [f"{place} {_numbers(distances)}", *handles]


def _line(line: Line2D) -> str:
    style = f"{to_hex(line.get_color())} {line.get_linewidth():g} {line.get_linestyle()}"
    style += f" {line.get_marker()} {line.get_markersize():g} {line.get_drawstyle()}"
    style += f" {line.get_markeredgewidth():g}" if line.get_marker() != "None" else ""
    return f"{style} {_look(line)} {_numbers(line.get_xydata())}"


def _area(area: Collection) -> str:
    colours = [_numbers(area.get_facecolor()), _numbers(area.get_edgecolor())]
    paths = " ".join(_numbers(path.vertices) for path in area.get_paths())
    return f"{colours} {_numbers(area.get_linewidth())} {_look(area)} {paths}"


def _patch(patch: Patch) -> str:
    colours = [_numbers(patch.get_facecolor()), _numbers(patch.get_edgecolor())]
    points = _numbers(patch.get_patch_transform().transform(patch.get_path().vertices))
    return f"{colours} {patch.get_linewidth():g} {_look(patch)} {points}"


def _texts(axes: Axes) -> list[Text]:
    legend = axes.get_legend()
    return [*axes.texts, *(legend.get_texts() if legend is not None else [])]


def _text(text: Text) -> str:
    place = _numbers(text.get_position())
    style = f"{to_hex(text.get_color())} {text.get_fontsize():.4g} {text.get_fontweight()}"
    style += (
        f" {text.get_horizontalalignment()} {text.get_verticalalignment()} {text.get_rotation():g}"
    )
    if isinstance(text, Annotation):
        arrow = text.arrowprops or {}
        style += f" {_numbers(text.xy)} {text.xycoords} {sorted(arrow.items())}"
    return f"{text.get_text()} {place} {style} {_look(text)}"
