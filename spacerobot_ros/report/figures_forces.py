"""Figures of what drives a robot over time: wrench and efforts, thrusters, momentum.

Each function returns a plate, one sentence on why the bag has no such figure, or None where the
flight is of another kind.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spacerobot_ros.model.description import Joint
from spacerobot_ros.report.events import LANE, draw_events
from spacerobot_ros.report.figures_motion import axis_groups, joint_groups
from spacerobot_ros.report.flight import Flight
from spacerobot_ros.report.over_time import BAND, EVENTS, time_plate
from spacerobot_ros.report.plates import Group, Plate
from spacerobot_ros.report.signals import Signal
from spacerobot_ros.report.style import (
    PALETTE,
    SLICES,
    colour,
    draw_traces,
    key,
    legend_above,
    narrow,
    set_range,
    set_time,
    sheet,
    short,
    upper_edge,
)

_DECADES = 4

_PEAKS = 0.02
"""Part of the samples that may be beyond the axis: the peaks."""

_FAR = (3.0, 1e4)
"""Least and largest ratio of the span of all samples to that of all but the peaks, between which
the axis leaves the peaks out. Below it they can be read together; above it all but the peaks is a
robot at rest, and the peaks are what happens.
"""

_SMALLEST = 1e-9
"""Forces and torques that are rounding errors, N or N m."""


def efforts_plate(flight: Flight) -> Plate | None:
    """Commanded thruster wrench and joint efforts."""

    def bounds(joint: Joint) -> list[float]:
        limit = joint.limits.effort
        return [-limit, limit] if np.isfinite(limit) else []

    def readable(groups: list[Group]) -> list[Group]:
        return [replace(group, window=window_of(group.signal)) for group in groups]

    wrench = axis_groups(flight.wrench, (("thruster force", "N"), ("thruster torque", "N m")))
    wrench = [g for g in wrench if np.abs(g.signal.values).max(initial=0.0) > _SMALLEST]
    joints: list[Group] = []
    if np.abs(flight.efforts.values).max(initial=0.0) > _SMALLEST:
        units, count = {"m": "N", "rad": "N m"}, len(flight.joint_names)
        joints = joint_groups(flight, flight.efforts, "joints", units, bounds, most=count)
    groups = readable(wrench + joints)
    if not groups:
        return None
    what = (
        "What was commanded: thruster force and torque at the base link's origin, in its frame, "
        "and the efforts of the joints"
    )
    if not wrench:
        what = "Commanded efforts of the joints; the thrusters gave nothing"
    if any(group.window is not None for group in groups):
        what += ". Axes leave out short peaks, so that the rest can be read"
    return time_plate(flight, "efforts", "Wrench and efforts", what, groups)


def window_of(signal: Signal) -> tuple[float, float] | None:
    """Return lower and upper end of what can be read, where a few peaks are far beyond it."""
    if not len(signal):
        return None
    low, high = (float(np.min(signal.values)), float(np.max(signal.values)))
    inner = np.quantile(signal.values, (_PEAKS / 2, 1 - _PEAKS / 2), axis=0)
    inner_low, inner_high = float(inner[0].min()), float(inner[1].max())
    span = inner_high - inner_low
    if not _FAR[0] * span < high - low < _FAR[1] * span:
        return None
    return max(low, inner_low - 0.3 * span), min(high, inner_high + 0.3 * span)


def thrusters_plate(flight: Flight) -> Plate | None:
    """When each thruster was on, and what that took."""
    names = flight.thruster_names
    if not len(flight.duty) or not flight.duty.values.any():
        return None
    used = [k for k in range(len(names)) if flight.duty.values[:, k].any()]
    duty = Signal(flight.duty.time, flight.duty.values[:, used])
    tints = [colour(k) for k in range(len(used))]
    label, unit = "thrusters", "part of each tick that they are on"
    groups = [Group(duty, [short(names[k]) for k in used], label, unit, tints, rows=True)]
    impulse, propellant = flight.impulse, flight.propellant
    groups.append(Group(impulse, ["impulse"], "impulse given", "N s", [PALETTE[0]]))
    what = "How much of each tick each thruster was on; below, the impulse that all gave"
    if propellant is not None:
        grams = Signal(propellant.time, 1e3 * propellant.values)
        groups.append(Group(grams, ["propellant"], "propellant", "g", [PALETTE[1]]))
        what += " and the propellant that they took, by their specific impulse"
    if len(used) < len(names):
        what += f". {len(names) - len(used)} of {len(names)} thrusters were never on"
    return time_plate(flight, "thrusters", "Thruster firings", what, groups)


def momentum_plate(flight: Flight) -> Plate | str:
    """Change of the total momenta, and the kinetic energy."""
    if not len(flight.momentum):
        return "The bag holds no momentum."
    time, balance = flight.momentum.time, flight.momentum.values
    changes = np.column_stack(
        [np.linalg.norm(balance[:, k : k + 3] - balance[0, k : k + 3], axis=1) for k in (0, 3)]
    )
    bottom = 0.5 + (LANE if flight.events else 0.0)
    figure, ((above,), (below,)) = sheet([[1.0], [1.0]], [1.6, 1.1], bottom=bottom)
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
    if not narrow():
        above.set_title("change of the total momenta since the start")
    above.set_ylabel("SI units")
    above.minorticks_off()
    above.yaxis.set_major_formatter(lambda value, _: power_of_ten(value))
    names = ("|p − p₀| (kg m/s)", "|L − L₀| (kg m²/s)")
    legend_above(above, [key(colour(i), name) for i, name in enumerate(names)])
    energy = balance[:, 6:7]
    set_range(below, np.append(energy, 0.0))
    dense = draw_traces(below, Signal(time, energy), [colour(2)])
    below.set_title("kinetic energy")
    below.set_ylabel("J")
    set_time(below, 0.0, flight.end)
    if flight.events:
        draw_events(below, flight.events)
    largest_of = ", the largest in each slice of time" if len(time) > 2 * SLICES else ""
    caption = (
        "The momentum balance of the whole system. Top: how far the linear momentum p "
        "and the angular momentum L about the centre of mass are from their values at the start, "
        f"what thrusters have put in taken off{largest_of}, on a logarithmic axis; less than it "
        "shows, and zero, lies on its lower edge. Bottom: kinetic energy."
    )
    aside = f" {BAND}" if dense else ""
    caption += aside + (f" {EVENTS}" if flight.events else "")
    groups = [
        Group(
            Signal(time, changes),
            ["|p − p₀| (kg m/s)", "|L − L₀| (kg m²/s)"],
            "change of the total momenta",
            "SI units",
            PALETTE[:2],
            decades=_DECADES,
        ),
        Group(Signal(time, energy), ["energy"], "kinetic energy", "J", [colour(2)]),
    ]
    return Plate("momentum", "Momentum balance", caption, figure, groups, aside)


def power_of_ten(value: float) -> str:
    """Return a power of ten as it is written, for a logarithmic axis."""
    exponent = str(round(np.log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{exponent}"
