"""Fingerprints of the reports of the reference flights, and of the pictures of robots.

Of each panel of a figure there is one of its frame, lines, areas and texts; tables are kept word
for word.

A change of a figure is seen in the panel and the kind of artist whose fingerprint differs. Numbers
count to five digits, so that other versions of numpy and matplotlib draw the same figures.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.analysis import analyze
from spacerobot_ros.report.figures import WIDTH, ReportFigure, drawing
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.planning_figures import _planar_figure, _spatial_figure
from spacerobot_ros.report.scene import scene_of
from spacerobot_ros.report.tables import (
    headline,
    joint_table,
    published_table,
    result_table,
    runs_table,
)
from spacerobot_ros.report.writing import FIGURES
from spacerobot_ros.resources import robot_file

ROOT = Path(__file__).resolve().parents[2]
NARROW = 88.0 / 25.4
"""Width of a figure in a column of a paper, inches."""


def report_prints(name: str) -> dict[str, Any]:
    """Return figures, tables and 3D view of the report of a reference flight."""
    flight = read_report(ROOT / "bags" / f"{name}.mcap", None)
    found: dict[str, Any] = {
        "numbers on top": [list(row) for row in headline(flight)],
        "results": result_table(flight).rows,
        "joints": getattr(joint_table(flight), "rows", None),
        "published": getattr(published_table(flight), "rows", None),
        "runs": runs_table([flight, flight]).rows,
        "3D view": _digest(map(_command, getattr(scene_of(flight), "commands", ["none"]))),
    }
    for width, style in ((WIDTH, "report"), (NARROW, "paper")):
        with drawing(width, style):
            for figure, draw in FIGURES.items():
                drawn = draw(flight)
                if isinstance(drawn, ReportFigure):
                    key = f"figure {figure}, {style}"
                    found[key] = {"caption": drawn.caption, **prints_of(drawn.figure)}
    return dict(json.loads(json.dumps(found)))


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
    return f"{bounds} {axes.get_xscale()} {axes.get_yscale()} {axes.get_aspect()} {labels}"


def _line(line: Line2D) -> str:
    style = f"{to_hex(line.get_color())} {line.get_linewidth():g} {line.get_linestyle()}"
    style += f" {line.get_marker()} {line.get_markersize():g} {line.get_drawstyle()}"
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
    style = f"{to_hex(text.get_color())} {text.get_fontsize():.4g}"
    return f"{text.get_text()} {place} {style} {_look(text)}"
