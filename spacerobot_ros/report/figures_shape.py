"""Figures of the shape space: the loops that turn the base, and what each did to the attitude."""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.axes import Axes

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import PoseError
from spacerobot_ros.report.figures_forces import power_of_ten
from spacerobot_ros.report.figures_motion import NO_JOINTS
from spacerobot_ros.report.flight import Flight, joint_unit
from spacerobot_ros.report.over_time import DASHES, SHOWN_CYCLES
from spacerobot_ros.report.plates import Plate
from spacerobot_ros.report.signals import Indices, Signal
from spacerobot_ros.report.style import (
    COLUMNS,
    MUTED,
    PALETTE,
    colour,
    end_labels,
    key,
    legend_above,
    narrow,
    set_range,
    sheet,
)

_LOOP_JOINTS = 3


def loops_plate(flight: Flight) -> Plate | str:
    """Joint positions against each other, for the first three joints in pairs."""
    names = flight.joint_names[:_LOOP_JOINTS]
    if len(names) < 2:
        return "A loop in shape space takes two joints or more."
    if not len(flight.shape):
        return NO_JOINTS
    pairs = list(itertools.combinations(range(len(names)), 2))
    cycles = flight.cycles
    part = flight.shape
    if cycles is not None:
        part = part.between(*cycles.last(SHOWN_CYCLES))
    one = len(pairs) == 1
    if narrow():
        figure, panels = sheet([[1.0]] * len(pairs), [2.0] * len(pairs), gap=0.75)
    else:
        figure, panels = sheet([[1.0] * (2 if one else _LOOP_JOINTS)], [3.4 if one else 2.35])
    places = [axes for row in panels for axes in row]
    for axes in places[len(pairs) :]:
        axes.set_visible(False)
    for axes, (i, j) in zip(places[: len(pairs)], pairs, strict=True):
        x, y = part.values[:, i], part.values[:, j]
        axes.plot(x, y, color=colour(0), rasterized=len(part) > 4 * COLUMNS)
        axes.plot(x[:1], y[:1], "o", color=colour(0), mfc="white", ms=5, zorder=4)
        axes.plot(x[-1:], y[-1:], "o", color=colour(0), ms=2.5, zorder=4)
        set_range(axes, y)
        _set_across(axes, x)
        units = [joint_unit(flight, names[k]) for k in (i, j)]
        axes.set_xlabel(f"{names[i]} ({units[0]})")
        axes.set_ylabel(f"{names[j]} ({units[1]})")
        if cycles is not None:
            last = part.between(cycles.end - cycles.period, cycles.end).values
            area = _signed_area(last[:, i], last[:, j])
            unit = {"m": "m²", "rad": "rad²"}.get(units[0] if units[0] == units[1] else "", "SI")
            axes.set_title(f"area {area:+.4g} {unit}")
            _arrow(axes, x, y)
    if cycles is None:
        caption = (
            "Joint positions against each other; a circle marks the first shape, a dot the last."
        )
    else:
        caption = (
            f"The last {SHOWN_CYCLES} of {cycles.count} cycles in shape space. Each begins and "
            "ends at the circle and, to first order, displaces the base in proportion to the areas "
            "it encloses: those of one cycle are given, positive where it runs counter-clockwise."
        )
    if len(flight.joint_names) > _LOOP_JOINTS:
        caption += f" The first three of {len(flight.joint_names)} joints are shown."
    heading = "Path in shape space" if cycles is None else "Loops in shape space"
    return Plate("loops", heading, caption, figure)


def _set_across(axes: Axes, values: Array) -> None:
    low, high = float(values.min()), float(values.max())
    half = (high - low if high - low > 1e-6 else 0.1) / 2
    axes.set_xlim((low + high) / 2 - 1.12 * half, (low + high) / 2 + 1.12 * half)
    axes.locator_params(axis="x", nbins=4)


def _signed_area(x: Array, y: Array) -> float:
    """Area inside a closed curve, positive where it runs counter-clockwise."""
    return float(x @ np.roll(y, -1) - y @ np.roll(x, -1)) / 2


def _arrow(axes: Axes, x: Array, y: Array) -> None:
    """Show the sense of a loop where it is fastest."""
    low, high = np.array([axes.get_xlim(), axes.get_ylim()]).T
    steps = np.hypot(np.diff(x) / (high - low)[0], np.diff(y) / (high - low)[1])
    k = int(np.argmax(steps))
    axes.annotate(
        "",
        (x[k + 1], y[k + 1]),
        (x[k], y[k]),
        arrowprops={"arrowstyle": "-|>", "color": colour(0), "mutation_scale": 12},
    )


_BACK = 0.02
"""A shape this near to where the loops begin, in their extent, has come round."""

_FEWEST = 4
_DECADE = 10.0


def cycles_plate(flight: Flight) -> Plate | None:
    """Attitude, and the remaining angle to the goal, at the end of each loop in shape space.

    None where the shape does not come round again and again.
    """
    if not len(flight.shape) or len(flight.attitude) != len(flight.shape):
        return None
    ends = returns(flight.shape)
    if len(ends) < _FEWEST:
        return None
    number = np.arange(len(ends))
    attitude = flight.attitude.values[ends]
    goal = flight.goal
    figure, panels = sheet([[1.0], [1.0]] if goal else [[1.0]], [2.0, 1.3] if goal else [2.0])
    above = panels[0][0]
    dots = "." if len(ends) <= 60 else ""
    wanted = flight.goal_rotvec(goal) if goal is not None else np.empty(0)
    set_range(above, np.concatenate([attitude.ravel(), wanted]))
    for i in range(3):
        above.plot(number, attitude[:, i], color=PALETTE[i], marker=dots)
    for i, value in enumerate(wanted):
        above.axhline(value, color=PALETTE[i], ls=(0, DASHES), lw=1.2, zorder=1.8)
    if goal is not None:
        legend_above(above, [key(MUTED, "goal", DASHES)])
    above.set_ylabel("rotation vector (rad)")
    end_labels(above, list(zip(attitude[-1].tolist(), "xyz", PALETTE[:3], strict=True)))
    caption = (
        f"Attitude of the base link at the {len(ends)} instants at which the shape is back where "
        "its loops begin, number 0 before the first of them"
    )
    if goal is not None:
        below = panels[1][0]
        poses = zip(flight.position.values[ends], flight.quaternion[ends], strict=True)
        left = np.array([PoseError.between(r, q, goal).angle for r, q in poses])
        below.plot(number, left, color=PALETTE[0], marker=dots)
        below.set_ylabel("remaining angle (rad)")
        caption += "; dashed, the goal. Below, the remaining angle to the goal"
        if left.min() > 0 and left.max() > _DECADE * left.min():
            below.set_yscale("log")
            below.minorticks_off()
            below.yaxis.set_major_formatter(lambda value, _: power_of_ten(value))
            caption += ", on a logarithmic axis"
        else:
            set_range(below, np.append(left, 0.0))
    for axes in (row[0] for row in panels):
        axes.set_xlim(0, len(ends) - 1)
    panels[-1][0].set_xlabel("cycle")
    return Plate("cycles", "Attitude cycle by cycle", f"{caption}.", figure)


def returns(shape: Signal) -> Indices:
    """Return the samples at which the shape is back where its loops begin and end, the last shape.

    A stay there counts once, with its last sample; a stay at the very end with its first.
    """
    values = shape.values
    moving = np.flatnonzero((np.abs(np.diff(values, axis=0)) > 0).any(axis=1))
    if not len(moving):
        return np.empty(0, np.int64)
    end = int(moving[-1]) + 1
    extent = np.ptp(values[end // 2 : end + 1], axis=0)
    used = extent > 1e-3 * extent.max(initial=0.0)
    off = np.abs(values[: end + 1, used] - values[end, used]) / extent[used]
    distance = off.max(axis=1)
    near = np.flatnonzero(distance < _BACK)
    runs = np.split(near, np.flatnonzero(np.diff(near) > 1) + 1)
    nearest = [int(run[np.argmin(distance[run])]) for run in runs[:-1]]
    return np.array([*nearest, end], np.int64)
