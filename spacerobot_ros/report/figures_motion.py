"""Figures of motion over time: base pose and velocity, joints and their rates.

Each function returns a plate, one sentence on why the bag has no such figure, or None where the
flight is of another kind.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spacerobot_ros.model.description import Joint
from spacerobot_ros.report.events import LANE, draw_events
from spacerobot_ros.report.flight import Flight, joint_unit
from spacerobot_ros.report.over_time import BAND, DOTS, EVENTS, SHOWN_CYCLES, time_plate
from spacerobot_ros.report.plates import Group, Plate
from spacerobot_ros.report.signals import Signal
from spacerobot_ros.report.style import (
    INK,
    MUTED,
    PALETTE,
    colour,
    draw_traces,
    narrow,
    set_range,
    set_time,
    sheet,
    short,
)

JOINTS_A_PANEL = 6

NO_STATES = "The bag holds no base poses (odom), so there is no picture of them."

NO_JOINTS = "The bag holds no joint positions (joint_states)."


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

    def bounds(joint: Joint) -> list[float]:
        return [joint.limits.lower, joint.limits.upper]

    units = {"m": "m", "rad": "rad"}
    return joint_groups(flight, flight.shape, "joint position", units, bounds, most=JOINTS_A_PANEL)


def joint_groups(
    flight: Flight,
    signal: Signal,
    label: str,
    units: dict[str, str],
    bounds: Callable[[Joint], list[float]],
    most: int,
) -> list[Group]:
    """Group the columns of a signal of all joints by their unit, given that of their position."""
    unknown = " or ".join(units.values())
    each = [units.get(joint_unit(flight, name), unknown) for name in flight.joint_names]
    groups = []
    for unit in dict.fromkeys(each):
        members = [i for i, other in enumerate(each) if other == unit]
        for first in range(0, len(members), most):
            chosen = members[first : first + most]
            names = [flight.joint_names[i] for i in chosen]
            limits = [
                (k, bound)
                for k, name in enumerate(names)
                if (joint := flight.joint(name)) is not None
                for bound in bounds(joint)
            ]
            part = Signal(signal.time, signal.values[:, chosen])
            colours = [colour(i) for i in chosen]
            groups.append(Group(part, list(map(short, names)), label, unit, colours, limits=limits))
    return groups


def axis_groups(signal: Signal, parts: Sequence[tuple[str, str]]) -> list[Group]:
    """Return a group of x, y and z for each label and unit, from columns side by side."""
    return [
        Group(
            Signal(signal.time, signal.values[:, 3 * k : 3 * k + 3]),
            list("xyz"),
            label,
            unit,
            PALETTE[:3],
        )
        for k, (label, unit) in enumerate(parts)
    ]


def position_plate(flight: Flight) -> Plate | str:
    """Base position against the goal."""
    if not len(flight.position):
        return NO_STATES
    what = "Position of the base link in the world frame"
    return time_plate(flight, "position", "Base position", what, [position_group(flight)])


def pose_plate(flight: Flight) -> Plate | str:
    """Base position over base attitude, against the goal."""
    if not len(flight.position):
        return NO_STATES
    what = "Position of the base link in the world frame, and its attitude as a rotation vector"
    groups = [position_group(flight), attitude_group(flight)]
    return time_plate(flight, "pose", "Base pose", what, groups)


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
        return _no_joints(flight)
    return time_plate(flight, "shape", "Shape", "Joint positions", shape_groups(flight))


def _no_joints(flight: Flight) -> str:
    """Return why there is no picture of the joints."""
    jointless = flight.robot is not None and not flight.robot.joint_names
    return "The robot has no joints." if jointless else NO_JOINTS


def rates_plate(flight: Flight) -> Plate | str:
    """Joint velocities, one panel a joint."""
    if not flight.joint_names:
        return _no_joints(flight)
    if not len(flight.rates):
        return "The bag holds no joint velocities."
    names, cycles = flight.joint_names, flight.cycles
    height = 1.0 if len(names) <= 4 else 0.75
    widths = [1.0] if cycles is None else [2.2, 1.0]
    lane = LANE if flight.events else 0.0
    bottom = 0.5 + lane
    figure, panels = sheet([widths] * len(names), [height] * len(names), gap=0.36, bottom=bottom)
    dense, groups = [], []
    for i, (row, name) in enumerate(zip(panels, names, strict=True)):
        signal = Signal(flight.rates.time, flight.rates.values[:, i : i + 1])
        spans = [(0.0, flight.end)]
        if cycles is not None:
            spans.append(cycles.last(SHOWN_CYCLES))
        joint = flight.joint(name)
        limit = joint.limits.velocity if joint is not None else np.inf
        unit = f"{joint_unit(flight, name)}/s"
        bounds = [(0, limit), (0, -limit)]
        groups.append(Group(signal, [name], short(name), unit, [colour(i)], limits=bounds))
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
        if not narrow():
            row[0].set_title(text, loc="right", color=INK)
        row[0].set_ylabel(unit)
    figure.align_ylabels([row[0] for row in panels])
    if cycles is not None:
        panels[0][1].set_title(f"last {SHOWN_CYCLES} cycles")
    if flight.events:
        for axes in panels[-1]:
            draw_events(axes, flight.events)
    caption = "Velocity of each joint; dotted, its limit in the URDF, where that is in range."
    aside = ""
    if cycles is not None:
        aside += f" Right: the last {SHOWN_CYCLES} of {cycles.count} cycles, to the same scale."
    aside += f" {BAND}" if any(dense) else ""
    caption += aside + (f" {EVENTS}" if flight.events else "")
    return Plate("velocities", "Joint velocities", caption, figure, groups, aside)


def twist_plate(flight: Flight) -> Plate | None:
    """Velocity and angular velocity of the base link.

    None where it rests, and of a gait of many equal cycles: there it shakes.
    """
    if flight.cycles is not None or not flight.twist.values.any():
        return None
    groups = axis_groups(flight.twist, (("velocity", "m/s"), ("rate", "rad/s")))
    what = "Velocity of the base link's origin and its angular velocity, in the base link's frame"
    return time_plate(flight, "twist", "Base velocity", what, groups)
