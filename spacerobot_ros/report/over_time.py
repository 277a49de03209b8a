"""Quantities over the time of a flight, as panels: all of it, and close-ups of its cycles.

Traces of one unit share a panel; below the time axes stands what happened.
"""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes

from spacerobot_ros.report.events import LANE, draw_events
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.plates import Group, Plate
from spacerobot_ros.report.signals import Cycles, Signal, envelope
from spacerobot_ros.report.style import (
    COLUMNS,
    FAINT,
    MUTED,
    draw_traces,
    end_labels,
    key,
    legend_above,
    narrow,
    room_for,
    scaled,
    set_range,
    set_time,
    sheet,
)

SHOWN_CYCLES = 3
"""Cycles in a close-up."""

DASHES, DOTS = (5.0, 2.5), (1.0, 1.5)

_ROW = 0.8
"""Height of a trace that is always on, in its row."""

BAND = (
    "Where a trace has more samples than the picture has columns, the band spans the smallest and "
    "the largest value in each slice of time."
)

EVENTS = (
    "Below the time axis, what happened: goals and plans above, the robot and its faults below."
)


def draw_whole(axes: Axes, flight: Flight, group: Group, share: float = 1.0) -> bool:
    """Draw a group over the whole flight; return whether traces were summed up as bands."""
    if group.rows:
        return _draw_rows(axes, flight, group, share)
    colours = group.colours
    values = np.concatenate([group.signal.values.ravel(), [g[3] for g in group.goals]])
    if group.window is not None:
        text = f"peaks of {np.abs(values).max():.3g} {group.unit} are beyond the axis"
        axes.set_title(text, loc="right" if group.limits else "left", color=MUTED)
        values = np.array(group.window)
    set_range(axes, values, [bound for _, bound in group.limits])
    low, high = axes.get_ylim()
    keys = []
    shown = [(k, bound) for k, bound in group.limits if low < bound < high]
    for bound in {bound for _, bound in shown}:
        owners = [k for k, other in shown if other == bound]
        tint = MUTED if len(owners) == len(group.names) else colours[owners[0]]
        axes.axhline(bound, color=tint, lw=1.0, ls=(0, DOTS), zorder=1.8)
    if shown:
        keys.append(key(MUTED, "limit (URDF)", DOTS))
    dense = draw_traces(axes, group.signal, colours, share)
    for start, end, index, value in group.goals:
        axes.hlines(value, start, end, color=colours[index], ls=(0, DASHES), lw=1.2, zorder=3)
    if group.goals:
        keys.append(key(MUTED, "goal", DASHES))
    later = [status.time for status in flight.executing[1:]]
    for time in later:
        axes.axvline(time, color=FAINT, lw=1.0, zorder=1.5)
    if later:
        keys.append(key(FAINT, "new schedule"))
    legend_above(axes, keys)
    set_time(axes, 0.0, flight.end)
    axes.set_ylabel(f"{group.label} ({group.unit})")
    _name_traces(axes, group.signal, group)
    return dense


def time_plate(flight: Flight, name: str, heading: str, what: str, groups: list[Group]) -> Plate:
    """Return groups over time, one panel each, with close-ups where there are cycles.

    ``what`` is the first words of the caption.
    """
    cycles = flight.cycles
    rows, heights = [[1.0]], [2.3]
    if any(group.rows for group in groups):
        cycles = None
        heights = [0.4 + 0.14 * len(group.names) if group.rows else 1.6 for group in groups]
    elif cycles is not None and narrow():
        rows, heights = [[1.0]] * 3, [2.0, 1.35, 1.35]
    elif cycles is not None:
        rows, heights = [[1.0], [1.0, 1.0]], [2.0, 1.35]
    if len(heights) != len(rows) * len(groups):
        heights = heights * len(groups)
    right = room_for([name for group in groups for name in group.names])
    lane = LANE if flight.events else 0.0
    left = max([0.72, *(room_for(group.names) + 0.1 for group in groups if group.rows)])
    figure, panels = sheet(rows * len(groups), heights, left=left, right=right, lane=lane)
    share = min(1.0, 4 / len(groups))
    dense = []
    for number, group in enumerate(groups):
        whole, *below = panels[number * len(rows) : (number + 1) * len(rows)]
        dense.append(draw_whole(whole[0], flight, group, share))
        if cycles is not None:
            whole[0].set_title("whole flight")
            first, last = (axes for row in below for axes in row)
            dense.append(_first_part(first, group, cycles))
            _last_cycles(last, group, cycles)
    if flight.events:
        for axes in (each for row in panels for each in row):
            draw_events(axes, flight.events)
    caption = f"{what}"
    if any(group.goals for group in groups):
        caption += "; dashed, the goal"
    if any(group.limits for group in groups):
        caption += "; dotted, the limits of the URDF, where they are in range"
    caption += "."
    aside = ""
    if cycles is not None:
        aside += (
            f" The flight ends with {cycles.count} equal cycles of {cycles.period:.4g} s; below, "
            f"what comes before them, and {_close_up(cycles)}."
        )
    aside += f" {BAND}" if any(dense) else ""
    caption += aside + (f" {EVENTS}" if flight.events else "")
    return Plate(name, heading, caption, figure, groups, aside)


def _draw_rows(axes: Axes, flight: Flight, group: Group, share: float) -> bool:
    """Draw each trace as a band in a row of its own, the first on top."""
    columns = max(int(COLUMNS * share), 20)
    count, signal = len(group.names), group.signal
    dense = len(signal) > 2 * columns
    for index, tint in enumerate(group.colours):
        time, high = signal.time, signal.values[:, index]
        if dense:
            time, _, high = envelope(signal, index, columns)
        foot = count - 1 - index
        # From the sample before, which the value reaches back to.
        on = high > 0
        on[:-1] |= on[1:]
        axes.fill_between(time, foot, foot + _ROW * high, on, step="pre", color=tint, linewidth=0.3)
    axes.set_ylim(-0.2, count)
    axes.set_yticks([count - 1 - k + _ROW / 2 for k in range(count)], group.names)
    axes.tick_params(axis="y", length=0, labelsize="small")
    axes.grid(axis="y", visible=False)
    axes.set_title(f"{group.label} ({group.unit})")
    set_time(axes, 0.0, flight.end)
    return dense


def _close_up(cycles: Cycles) -> str:
    return f"the last {SHOWN_CYCLES} of them, as change since the first instant shown"


def _first_part(axes: Axes, group: Group, cycles: Cycles) -> bool:
    """Draw what comes before the cycles, or the first cycles where nothing does."""
    end = cycles.start if cycles.start > 0 else SHOWN_CYCLES * cycles.period
    part = group.signal.between(0.0, end)
    whole = group.signal.values
    set_range(axes, part.values, least=0.05 * float(np.ptp(whole)))
    dense = draw_traces(axes, part, group.colours, 0.5)
    set_time(axes, 0.0, end)
    axes.set_title(f"first {end:.4g} s")
    axes.set_ylabel(group.unit)
    _name_traces(axes, part, group)
    return dense


def _name_traces(axes: Axes, part: Signal, group: Group) -> None:
    if not len(part):
        return
    ends = part.values[-1].tolist()
    end_labels(axes, list(zip(ends, group.names, group.colours, strict=True)))


def _last_cycles(axes: Axes, group: Group, cycles: Cycles) -> None:
    start, end = cycles.last(SHOWN_CYCLES)
    part = group.signal.between(start, end).since_first()
    factor, unit = scaled(group.unit, float(np.abs(part.values).max(initial=0.0)))
    set_range(axes, factor * part.values)
    draw_traces(axes, part, group.colours, factor=factor)
    set_time(axes, start, end)
    axes.set_title(f"last {SHOWN_CYCLES} cycles, change")
    axes.set_ylabel(unit)
