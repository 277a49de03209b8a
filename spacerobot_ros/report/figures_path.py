"""The paths of base and end-effector, in three views where they are not in a plane."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from spacerobot_ros.model.description import Array
from spacerobot_ros.report.figures import DASHES, NO_STATES
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.style import (
    COLUMNS,
    GHOST,
    PALETTE,
    Plate,
    key,
    sheet,
    svg_of,
)

_PLAN, _TOOL = PALETTE[1], PALETTE[4]
_OTHERS = (PALETTE[0], PALETTE[2], PALETTE[5], *PALETTE[6:])
"""Colors of the flights, this one first."""


def path_plate(flight: Flight, beside: Sequence[Flight] = ()) -> Plate | str:
    """The path of the base in three views, with that of the end-effector and of other flights."""
    if not len(flight.position):
        return NO_STATES
    goals = [flight.goal] if flight.goal is not None and flight.position_counts else []
    goals += [goal for _, goal in flight.tool_goals[-1:]]
    # Beside the reach of an arm, the path of a base that nobody pushes would be a dot.
    shows_tool = len(flight.tool) > 0 and len(flight.tool_goals) > 0
    flown = [flight, *(other for other in beside if len(other.position))]
    tints = [_OTHERS[k % len(_OTHERS)] for k in range(len(flown))]
    paths = [(each.position.values, tint) for each, tint in zip(flown, tints, strict=True)]
    names = [each.label for each in flown] if beside else ["base"]
    keys = [key(tint, name) for tint, name in zip(tints, names, strict=True)]
    if shows_tool:
        paths.append((flight.tool.values[:, :3], _TOOL))
        keys.append(key(_TOOL, "end-effector"))
    if flight.planned:
        keys.append(key(_PLAN, "planned", DASHES))
    everything = np.concatenate(
        [path for path, _ in paths] + flight.planned + [goal.position[np.newaxis] for goal in goals]
    )
    middle = (everything.max(axis=0) + everything.min(axis=0)) / 2
    half = 0.56 * max(float(np.ptp(everything, axis=0).max()), 1e-6)
    views = {"from above": (0, 1), "from the front": (0, 2), "from the side": (1, 2)}
    if float(np.ptp(everything[:, 2])) < 1e-9:
        views = {"from above": (0, 1)}
    height = 2.35 if len(views) > 1 else 4.2
    figure, (row, *_) = sheet([[1.0] * len(views)], [height])
    for axes, (title, (i, j)) in zip(row, views.items(), strict=True):
        for path, tint in paths:
            dense = len(path) > 2 * COLUMNS
            axes.plot(path[:, i], path[:, j], color=tint, lw=0.9, rasterized=dense)
            axes.plot(*path[0, [i, j]], "o", color=tint, mfc="white", ms=5, zorder=4)
            axes.plot(*path[-1, [i, j]], "o", color=tint, ms=5, zorder=4)
        for planned in flight.planned:
            axes.plot(planned[:, i], planned[:, j], color=_PLAN, lw=1.3, ls=(0, DASHES), zorder=3)
        for goal in goals:
            axes.plot(*goal.position[[i, j]], "x", color=GHOST, ms=8, mew=2, zorder=5)
        _square(axes, middle[[i, j]], half)
        axes.set_xlabel(f"{'xyz'[i]} (m)")
        axes.set_ylabel(f"{'xyz'[j]} (m)")
        axes.set_title(title)
    if len(keys) > 1:
        row[0].legend(handles=keys, loc="best", handlelength=1.6)
    caption = (
        "Path of the base origin"
        + (" and of the end-effector" if shows_tool else "")
        + f" in the world frame{', three views to one scale' if len(views) > 1 else ''}: open "
        "circle, start; full circle, end"
        + ("; cross, goal" if goals else "")
        + ("; dashed, the path of the base that the planner published" if flight.planned else "")
        + ". Every recorded state is drawn."
    )
    return Plate("path", "Paths", caption, svg_of(figure))


def _square(axes: Axes, middle: Array, half: float) -> None:
    axes.set_xlim(middle[0] - half, middle[0] + half)
    axes.set_ylim(middle[1] - half, middle[1] + half)
    axes.set_box_aspect(1.0)
    axes.locator_params(nbins=5)
