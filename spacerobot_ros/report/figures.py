"""Figures over time: base pose, shape, and the momentum ledger.

Each function returns a plate, or one sentence on why the bag has no such figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from matplotlib.axes import Axes

from spacerobot_ros.model.description import JointKind
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.signals import Cycles, Signal
from spacerobot_ros.report.style import (
    FAINT,
    MUTED,
    PALETTE,
    SLICES,
    Plate,
    colour,
    draw_traces,
    end_labels,
    key,
    legend_above,
    room_for,
    scaled,
    set_range,
    set_time,
    sheet,
    short,
    svg_of,
    upper_edge,
)

SHOWN_CYCLES = 3
"""Cycles in a close-up."""

DASHES, DOTS = (5.0, 2.5), (1.0, 1.5)
_DECADES = 4
_JOINTS_A_PANEL = 6
BAND = (
    "Where a trace has more samples than the picture has columns, the band spans the smallest and "
    "the largest value in each slice of time."
)
NO_STATES = "The bag holds no base poses (odom), so there is no picture of them."
NO_JOINTS = "The robot has no joints in this bag."


@dataclass
class Group:
    """Traces that share a panel, called by ``names``, ``label`` and ``unit``.

    ``goals`` are (start, end, trace, value), ``limits`` (trace, value).
    """

    signal: Signal
    names: Sequence[str]
    label: str
    unit: str
    colours: Sequence[str]
    goals: list[tuple[float, float, int, float]] = field(default_factory=list)
    limits: list[tuple[int, float]] = field(default_factory=list)


def position_group(flight: Flight) -> Group:
    """Return the base position and its goals."""
    goals = [
        (t.start, t.end, i, x)
        for t in flight.targets
        for i, x in enumerate(t.goal.position)
        if flight.position_counts
    ]
    return Group(flight.position, ["x", "y", "z"], "base position", "m", PALETTE[:3], goals)


def attitude_group(flight: Flight) -> Group:
    """Return the base attitude as exponential coordinates, and its goals."""
    goals = [
        (t.start, t.end, i, x)
        for t in flight.targets
        for i, x in enumerate(flight.goal_rotvec(t.goal))
    ]
    return Group(flight.attitude, ["x", "y", "z"], "rotation vector", "rad", PALETTE[:3], goals)


def shape_groups(flight: Flight) -> list[Group]:
    """Return the joint positions, those of one unit and at most six joints together."""
    units = [joint_unit(flight, name) for name in flight.joint_names]
    groups = []
    for unit in dict.fromkeys(units):
        members = [i for i, other in enumerate(units) if other == unit]
        for first in range(0, len(members), _JOINTS_A_PANEL):
            chosen = members[first : first + _JOINTS_A_PANEL]
            names = [flight.joint_names[i] for i in chosen]
            signal = Signal(flight.shape.time, flight.shape.values[:, chosen])
            limits = [
                (k, bound)
                for k, name in enumerate(names)
                if (joint := flight.joint(name)) is not None
                for bound in (joint.limits.lower, joint.limits.upper)
            ]
            colours = [colour(i) for i in chosen]
            labels = [short(name) for name in names]
            groups.append(Group(signal, labels, "joint position", unit, colours, limits=limits))
    return groups


def joint_unit(flight: Flight, name: str) -> str:
    """Return m or rad; without a robot description, that it is one of them."""
    joint = flight.joint(name)
    if joint is None:
        return "m or rad"
    return "m" if joint.kind is JointKind.PRISMATIC else "rad"


def position_plate(flight: Flight) -> Plate | str:
    """Base position against the goal."""
    if not len(flight.position):
        return NO_STATES
    what = "Position of the base link in the world frame"
    return time_plate(flight, "position", "Base position", what, [position_group(flight)])


def attitude_plate(flight: Flight) -> Plate | str:
    """Base attitude against the goal."""
    if not len(flight.attitude):
        return NO_STATES
    what = (
        "Attitude of the base link as exponential coordinates: the rotation vector, of the length "
        "of the angle turned, about the axis of rotation"
    )
    if np.linalg.norm(flight.attitude.values, axis=1).max() > np.pi:
        what += ", counted on continuously beyond half a turn"
    return time_plate(flight, "attitude", "Base attitude", what, [attitude_group(flight)])


def shape_plate(flight: Flight) -> Plate | str:
    """Joint positions, with the limits of the URDF that are in range."""
    if not len(flight.shape) or not flight.joint_names:
        return NO_JOINTS
    return time_plate(flight, "shape", "Shape", "Joint positions", shape_groups(flight))


def draw_whole(axes: Axes, flight: Flight, group: Group, share: float = 1.0) -> bool:
    """Draw a group over the whole flight; return whether traces were summed up as bands."""
    colours = group.colours
    values = np.concatenate([group.signal.values.ravel(), [g[3] for g in group.goals]])
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
    ends = group.signal.values[-1].tolist()
    labels = list(zip(ends, group.names, colours, strict=True))
    end_labels(axes, labels)
    return dense


def time_plate(flight: Flight, name: str, heading: str, what: str, groups: list[Group]) -> Plate:
    """Return groups over time, one panel each, with close-ups where there are cycles.

    ``what`` is the first words of the caption.
    """
    cycles = flight.cycles
    rows, heights = [[1.0]], [2.3]
    if cycles is not None:
        rows, heights = [[1.0], [1.0, 1.0]], [2.0, 1.35]
    right = room_for([name for group in groups for name in group.names])
    figure, panels = sheet(rows * len(groups), heights * len(groups), right=right)
    share = min(1.0, 4 / len(groups))
    dense = []
    for number, group in enumerate(groups):
        whole, *below = panels[number * len(rows) : (number + 1) * len(rows)]
        dense.append(draw_whole(whole[0], flight, group, share))
        if cycles is not None:
            whole[0].set_title("whole flight")
            dense.append(_first_part(below[0][0], group, cycles))
            _last_cycles(below[0][1], group, cycles)
    caption = f"{what}"
    if any(group.goals for group in groups):
        caption += "; dashed, the goal"
    if any(group.limits for group in groups):
        caption += "; dotted, the limits of the URDF, where they are in range"
    caption += "."
    if cycles is not None:
        caption += (
            f" The flight ends with {cycles.count} equal cycles of {cycles.period:.4g} s; below, "
            f"what comes before them, and {_close_up(cycles)}."
        )
    return Plate(name, heading, caption + (f" {BAND}" if any(dense) else ""), svg_of(figure))


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
    ends = part.values[-1].tolist()
    labels = list(zip(ends, group.names, group.colours, strict=True))
    end_labels(axes, labels)
    return dense


def _last_cycles(axes: Axes, group: Group, cycles: Cycles) -> None:
    start, end = cycles.last(SHOWN_CYCLES)
    part = group.signal.between(start, end).since_first()
    factor, unit = scaled(group.unit, float(np.abs(part.values).max(initial=0.0)))
    set_range(axes, factor * part.values)
    draw_traces(axes, part, group.colours, factor=factor)
    set_time(axes, start, end)
    axes.set_title(f"last {SHOWN_CYCLES} cycles, change")
    axes.set_ylabel(unit)


def momentum_plate(flight: Flight) -> Plate | str:
    """Change of the total momenta, and the kinetic energy."""
    if not len(flight.momentum):
        return "The bag holds no momentum ledger."
    time, ledger = flight.momentum.time, flight.momentum.values
    changes = np.column_stack(
        [np.linalg.norm(ledger[:, k : k + 3] - ledger[0, k : k + 3], axis=1) for k in (0, 3)]
    )
    figure, ((above,), (below,)) = sheet([[1.0], [1.0]], [1.6, 1.1])
    largest = float(changes.max())
    top = np.ceil(np.log10(largest)) if largest > 0 else -15.0
    above.set_yscale("log")
    above.set_ylim(10.0 ** (top - _DECADES), 10.0**top)
    # What is below the axis, zero above all, stands on its lower edge.
    shown = np.maximum(changes, 10.0 ** (top - _DECADES))
    for i in range(2):
        above.plot(
            *upper_edge(Signal(time, shown), i),
            color=colour(i),
            lw=2.6 - 1.3 * i,
            marker="o" if len(time) == 1 else "",
            clip_on=False,
        )
    set_time(above, 0.0, flight.end, label=False)
    above.set_title("change of the total momenta since the start")
    above.set_ylabel("SI units")
    above.minorticks_off()
    above.yaxis.set_major_formatter(lambda value, _: power_of_ten(value))
    names = ("|p − p₀| (kg m/s)", "|L − L₀| (kg m²/s)")
    legend_above(above, [key(colour(i), name) for i, name in enumerate(names)])
    energy = ledger[:, 6:7]
    set_range(below, np.append(energy, 0.0))
    dense = draw_traces(below, Signal(time, energy), [colour(2)])
    below.set_title("kinetic energy")
    below.set_ylabel("J")
    set_time(below, 0.0, flight.end)
    largest_of = ", the largest in each slice of time" if len(time) > 2 * SLICES else ""
    caption = (
        "The ledger that the plant keeps of the whole system. Top: how far the linear momentum p "
        "and the angular momentum L about the centre of mass are from their values at the start, "
        f"what thrusters have put in taken off{largest_of}, on a logarithmic axis; less than it "
        "shows, and zero, lies on its lower edge. Bottom: kinetic energy."
    )
    caption += f" {BAND}" if dense else ""
    return Plate("momentum", "Momentum ledger", caption, svg_of(figure))


def power_of_ten(value: float) -> str:
    """Return a power of ten as it is written, for a logarithmic axis."""
    exponent = str(round(np.log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{exponent}"
