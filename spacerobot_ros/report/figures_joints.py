"""Figures of the joints: velocities over time, and the loops in shape space that turn the base.

Each function returns a plate, or one sentence on why the bag has no such figure.
"""

from __future__ import annotations

import itertools

import numpy as np
from matplotlib.axes import Axes

from spacerobot_ros.model.description import Array
from spacerobot_ros.report.figures import BAND, DOTS, NO_JOINTS, SHOWN_CYCLES, joint_unit
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.signals import Signal
from spacerobot_ros.report.style import (
    COLUMNS,
    INK,
    MUTED,
    Plate,
    colour,
    draw_traces,
    set_range,
    set_time,
    sheet,
    svg_of,
)

_LOOP_JOINTS = 3


def rates_plate(flight: Flight) -> Plate | str:
    """Joint velocities, one panel a joint."""
    if not flight.joint_names:
        return NO_JOINTS
    if not len(flight.rates):
        return "The bag holds no joint velocities."
    names, cycles = flight.joint_names, flight.cycles
    height = 1.0 if len(names) <= 4 else 0.75
    widths = [1.0] if cycles is None else [2.2, 1.0]
    figure, panels = sheet([widths] * len(names), [height] * len(names), gap=0.36)
    dense = []
    for i, (row, name) in enumerate(zip(panels, names, strict=True)):
        signal = Signal(flight.rates.time, flight.rates.values[:, i : i + 1])
        spans = [(0.0, flight.end)]
        if cycles is not None:
            spans.append(cycles.last(SHOWN_CYCLES))
        joint = flight.joint(name)
        limit = joint.limits.velocity if joint is not None else np.inf
        unit = f"{joint_unit(flight, name)}/s"
        for axes, (start, end) in zip(row, spans, strict=True):
            set_range(axes, signal.values, [limit, -limit])
            low, high = axes.get_ylim()
            for bound in (limit, -limit):
                if low < bound < high:
                    axes.axhline(bound, color=MUTED, lw=1.0, ls=(0, DOTS), zorder=1.8)
            part = signal.between(start, end)
            dense.append(draw_traces(axes, part, [colour(i)], min(1.0, 6 / len(names))))
            last = i == len(names) - 1
            set_time(axes, start, end, last)
            if not last:
                axes.tick_params(labelbottom=False)
        peak = float(np.abs(signal.values).max())
        text = f"peak {peak:.4g} {unit}"
        if np.isfinite(limit) and limit > 0:
            text += f", {100 * peak / limit:.3g} % of the limit {limit:.4g} {unit}"
        row[0].set_title(name, color=colour(i))
        row[0].set_title(text, loc="right", color=INK)
        row[0].set_ylabel(unit)
    if cycles is not None:
        panels[0][1].set_title(f"last {SHOWN_CYCLES} cycles")
    caption = "Velocity of each joint; dotted, its limit in the URDF, where that is in range."
    if cycles is not None:
        caption += f" Right: the last {SHOWN_CYCLES} of {cycles.count} cycles, to the same scale."
    caption += f" {BAND}" if any(dense) else ""
    return Plate("velocities", "Joint velocities", caption, svg_of(figure))


def loops_plate(flight: Flight) -> Plate | str:
    """Joint positions against each other, for the first three joints in pairs."""
    names = flight.joint_names[:_LOOP_JOINTS]
    if len(names) < 2:
        return "A loop in shape space takes two joints or more."
    if not len(flight.shape):
        return "The bag holds no joint positions."
    pairs = list(itertools.combinations(range(len(names)), 2))
    cycles = flight.cycles
    part = flight.shape
    if cycles is not None:
        part = part.between(*cycles.last(SHOWN_CYCLES))
    one = len(pairs) == 1
    figure, (row, *_) = sheet([[1.0] * (2 if one else _LOOP_JOINTS)], [3.4 if one else 2.35])
    for axes in row[len(pairs) :]:
        axes.set_visible(False)
    for axes, (i, j) in zip(row[: len(pairs)], pairs, strict=True):
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
    return Plate("loops", heading, caption, svg_of(figure))


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
