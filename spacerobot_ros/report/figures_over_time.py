"""Figures over flight time: motion, efforts, thrusters, momentum, errors.

Traces with the same unit share a panel; events are shown below the time axes. A function named
after a figure returns the figure, a sentence explaining why the bag has no such figure, or None if
it does not apply to the flight.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from matplotlib.axes import Axes

from spacerobot_ros.control.wheels import BUDGET_PARTS
from spacerobot_ros.errors import RobotDescriptionError, enumeration, sentence_case, shortened
from spacerobot_ros.flight.captures import momentum_budget_over_time
from spacerobot_ros.flight.reading import impulse
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.measures import momentum_change
from spacerobot_ros.model.description import Array, JointLimits
from spacerobot_ros.model.rotations import (
    quaternion_inverse,
    quaternion_multiply,
    rotvecs_from_quaternions,
)
from spacerobot_ros.planning import Goal
from spacerobot_ros.report.events import EVENT_STRIP_HEIGHT, draw_events
from spacerobot_ros.report.figures import (
    LIMIT,
    LINE_COLOUR,
    PALETTE,
    SECONDARY_COLOUR,
    TRACE_TIME_SLICES,
    ReportFigure,
    TraceGroup,
    colour,
    draw_traces,
    end_labels,
    flight_dashes,
    legend_above,
    legend_entry,
    log_range,
    room_for,
    set_range,
    set_time,
    sheet,
)
from spacerobot_ros.report.flight import FlightReport, GoalSpan, joint_unit, labels_of, pose_errors

DASHES, DOTS = (5.0, 2.5), (1.0, 1.5)

_MAX_MARKED_SCHEDULES = 10
"""Largest number of schedules marked with lines; more lines would look like hatching."""

_LABEL_HEIGHT = 0.17
"""Label height for one of several flights, inches."""

_DUTY_ROW_HEIGHT = 0.8
"""Height of a duty cycle of 1, relative to the row height."""


def draw_group(axes: Axes, group: TraceGroup, end: float, later: Sequence[float] = ()) -> None:
    """Draw traces from zero to an end time, s, and marks at the start times ``later`` of further
    schedules, s.
    """
    set_time(axes, 0.0, max([end, *(float(each.time[-1]) for each in group.signals)]))
    if group.rows:
        _draw_rows(axes, group)
        return
    _set_value_axis(axes, group)
    low, high = axes.get_ylim()
    keys = []
    shown = [(k, bound) for k, bound in group.limits if low < bound < high]
    for bound in {bound for _, bound in shown}:
        owners = [k for k, other in shown if other == bound]
        shared = len(owners) == len(group.names) > 1
        tint = SECONDARY_COLOUR if shared else group.colours[owners[0]]
        axes.axhline(bound, color=tint, lw=1.0, ls=(0, DOTS), zorder=1.8)
    if shown:
        keys.append(legend_entry(SECONDARY_COLOUR, group.limit_name, DOTS))
    for number, signal in enumerate((group.signal, *group.beside)):
        drawn = Signal(signal.time, np.maximum(signal.values, low)) if group.decades else signal
        draw_traces(axes, drawn, group.colours, flight_dashes(number))
    for start, stop, index, value in group.goals:
        axes.hlines(
            value, start, stop, color=group.colours[index], ls=(0, DASHES), lw=1.2, zorder=3
        )
    if group.goals:
        keys.append(legend_entry(SECONDARY_COLOUR, "goal", DASHES))
    if len(later) > _MAX_MARKED_SCHEDULES or group.beside or group.decades:
        later = ()
    for time in later:
        axes.axvline(time, color=LINE_COLOUR, lw=1.0, zorder=1.5)
    if later:
        keys.append(legend_entry(LINE_COLOUR, "new schedule"))
    legend_above(axes, keys)
    axes.set_ylabel(f"{group.label} ({group.unit})")
    if len(group.signal):
        ends = np.maximum(group.signal.values[-1], low).tolist()
        end_labels(axes, list(zip(ends, group.names, group.colours, strict=True)))


def _set_value_axis(axes: Axes, group: TraceGroup) -> None:
    """Set the y axis to the values of a group; on a logarithmic axis, smaller values are at the
    lower edge.
    """
    if group.decades:
        axes.set_yscale("log")
        axes.set_ylim(log_range(group.values, group.decades))
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(lambda value, _: _power_of_ten(value))
        return
    values = np.concatenate([group.values, [goal[3] for goal in group.goals]])
    if group.window is not None:
        text = f"peaks of {np.abs(values).max():.3g} {group.unit} exceed the axis"
        axes.text(
            0.02, 0.97, text, transform=axes.transAxes, va="top", color=SECONDARY_COLOUR,
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.0}, zorder=4,
        )  # fmt: skip
        values = np.array(group.window)
    set_range(axes, values, [bound for _, bound in group.limits])


ONE_STATE_TEXT = "The bag contains only one state: there are no figures over time."


def time_figure(
    flight: FlightReport,
    name: str,
    heading: str,
    caption: str,
    groups: list[TraceGroup],
    *,
    flights: Sequence[str] = (),
) -> ReportFigure | str:
    """Return a figure with one panel per group; a sentence if nothing was recorded over time.

    ``caption`` is the beginning of its caption. ``flights``: labels of the flights whose traces
    the groups contain.
    """
    if all(len(signal) < 2 for group in groups for signal in group.signals):
        return ONE_STATE_TEXT
    if not flights:
        groups = [replace(each, signal=each.signal.broken_at(flight.resets)) for each in groups]
    groups = [group.in_unit_of_angles() for group in groups]
    left = max([0.72, *(room_for(group.names) + 0.1 for group in groups if group.rows)])
    figure, panels = sheet(
        [[1.0]] * len(groups),
        [group.height for group in groups],
        left=left,
        right=room_for([name for group in groups for name in group.names]),
        lane=EVENT_STRIP_HEIGHT if flight.timed_events else 0.0,
        top=0.3 + _LABEL_HEIGHT * len(flights),
    )
    if flights:
        named = enumerate(flights)
        keys = [legend_entry(SECONDARY_COLOUR, text, flight_dashes(k)) for k, text in named]
        figure.legend(handles=keys, loc="upper center", borderaxespad=0.1, handlelength=3.0)
    for group, (axes,) in zip(groups, panels, strict=True):
        draw_group(axes, group, flight.end, [time for time, _ in flight.executing[1:]])
    if flight.timed_events:
        for (axes,) in panels:
            draw_events(axes, flight.timed_events)
    if any(group.goals for group in groups):
        caption += "; dashed: goal"
    if any(group.limits and group.limit_name == LIMIT for group in groups):
        caption += "; dotted: URDF limits, if in range"
    return ReportFigure(name, heading, f"{caption}.", figure, groups)


def figure_of_flights(
    flights: Sequence[FlightReport], drawn: Sequence[ReportFigure | str | None]
) -> ReportFigure | str | None:
    """Return a figure over time with the traces from the figures ``drawn`` of several flights, or
    an explanatory sentence if no flight has such a figure or if the figure does not show values
    over time.

    Traces with the same label, unit and name share a panel. Cycles, duty cycles and the events of
    later flights are omitted, since they apply to single flights.
    """
    figures = [each for each in drawn if isinstance(each, ReportFigure)]
    if not figures or len(flights) < 2:
        return drawn[0]
    found = [each.groups if isinstance(each, ReportFigure) else () for each in drawn]
    groups = [{(x.label, x.unit, *x.names): x for x in each if not x.rows} for each in found]
    merged = []
    for key in dict.fromkeys(key for each in groups for key in each):
        same = [each[key] for each in groups if key in each]
        empty = replace(same[0], signal=Signal.empty(same[0].signal.width))
        signals = [each.get(key, empty).signal for each in groups]
        # Only efforts have windows, which contain zero.
        spans = [each.window or np.quantile(np.append(each.values, 0.0), [0, 1]) for each in same]
        low, high = np.transpose(spans)
        merged.append(
            replace(
                same[0],
                signal=signals[0],
                beside=signals[1:],
                goals=[goal for each in same for goal in each.goals],
                limits=list(dict.fromkeys(limit for each in same for limit in each.limits)),
                window=(low.min(), high.max()) if any(each.window for each in same) else None,
                decades=max(each.decades for each in same),
            )
        )
    if not merged:
        return "This figure shows a single flight: specify one bag."
    first, labels = figures[0], labels_of(flights)
    return time_figure(flights[0], first.name, first.heading, first.heading, merged, flights=labels)


def _draw_rows(axes: Axes, group: TraceGroup) -> None:
    """Draw each trace as a band in its own row, the first on top."""
    count = len(group.names)
    signal = group.signal.thinned(TRACE_TIME_SLICES)
    for index, tint in enumerate(group.colours):
        values, foot = signal.values[:, index], count - 1 - index
        # A value applies from the previous sample on.
        on = values > 0
        on[:-1] |= on[1:]
        top = foot + _DUTY_ROW_HEIGHT * values
        axes.fill_between(signal.time, foot, top, on, step="pre", color=tint, linewidth=0.3)
    axes.set_ylim(-0.2, count)
    axes.set_yticks([count - 1 - k + _DUTY_ROW_HEIGHT / 2 for k in range(count)], group.names)
    axes.tick_params(axis="y", length=0, labelsize="small")
    axes.grid(axis="y", visible=False)
    axes.set_title(f"{group.label} ({group.unit})")


_JOINTS_PER_PANEL = 6


def position_group(flight: FlightReport) -> TraceGroup:
    """Return the base position and its goals."""
    targets = flight.targets if flight.position_counts else []
    goals = _goal_lines(targets, lambda goal: goal.position)
    path = Signal(flight.time, flight.pose[:, :3])
    return TraceGroup(path, "xyz", "base position", "m", goals=goals)


def attitude_group(flight: FlightReport) -> TraceGroup:
    """Return the base attitude as a rotation vector, and its goals."""
    goals = _goal_lines(flight.targets, flight.goal_rotvec)
    return TraceGroup(flight.attitude, "xyz", "rotation vector", "rad", goals=goals)


def _goal_lines(
    targets: Sequence[GoalSpan], values: Callable[[Goal], Array]
) -> list[tuple[float, float, int, float]]:
    return [(t.start, t.end, i, x) for t in targets for i, x in enumerate(values(t.goal))]


def shape_groups(flight: FlightReport) -> list[TraceGroup]:
    """Return the joint positions, in groups of at most six joints with the same unit, and reaction
    wheel rates (the wheel angles are omitted).
    """
    groups = joint_groups(flight, flight.signal("q"), "joint position", flight.shape_columns)
    if len(flight.qdot):
        groups += joint_groups(flight, flight.signal("qdot"), "wheel rate", flight.wheel_columns)
    return groups


_LENGTHS, _RATES = {"m": "m", "rad": "rad"}, {"m": "m/s", "rad": "rad/s"}

_JOINT_QUANTITIES: dict[str, tuple[dict[str, str], Callable[[JointLimits], list[float]]]] = {
    "joint position": (_LENGTHS, lambda limits: [limits.lower, limits.upper]),
    "joint position error": (_LENGTHS, lambda limits: []),
    "velocity": (_RATES, lambda limits: [-limits.velocity, limits.velocity]),
    "wheel rate": (_RATES, lambda limits: [-limits.velocity, limits.velocity]),
    "joint effort": (
        {"m": "N", "rad": "N m"},
        lambda limits: [-limits.effort, limits.effort] if np.isfinite(limits.effort) else [],
    ),
}
"""Unit by the unit of the joint's position, and bounds, of each quantity of joints."""


def joint_groups(
    flight: FlightReport,
    signal: Signal,
    label: str,
    columns: Sequence[int] | None = None,
    most: int = _JOINTS_PER_PANEL,
) -> list[TraceGroup]:
    """Group the columns (N, n) of a signal, or the selected ``columns``, by unit; ``label`` is the
    name of their quantity."""
    units, bounds = _JOINT_QUANTITIES[label]
    unknown = " or ".join(units.values())
    each = [units.get(joint_unit(flight, name), unknown) for name in flight.joint_names]
    groups = []
    for unit in dict.fromkeys(each):
        shown = range(len(each)) if columns is None else columns
        members = [i for i in shown if each[i] == unit]
        for first in range(0, len(members), most):
            chosen = members[first : first + most]
            names = [flight.joint_names[i] for i in chosen]
            limits = [
                (k, bound)
                for k, name in enumerate(names)
                if (joint := flight.joint(name)) is not None
                for bound in bounds(joint.limits)
            ]
            part, labels = Signal(signal.time, signal.values[:, chosen]), [*map(shortened, names)]
            colours = [colour(i) for i in chosen]
            groups.append(TraceGroup(part, labels, label, unit, colours, limits=limits))
    return groups


def axis_groups(signal: Signal, parts: Sequence[tuple[str, str]]) -> list[TraceGroup]:
    """Return a group of the adjacent columns x, y and z for each label and unit."""
    columns = [signal.values[:, 3 * k : 3 * k + 3] for k in range(len(parts))]
    return [
        TraceGroup(Signal(signal.time, values), "xyz", label, unit)
        for values, (label, unit) in zip(columns, parts, strict=True)
    ]


def position_figure(flight: FlightReport) -> ReportFigure | str:
    """Base position and goal."""
    if not len(flight.time):
        return flight.no_poses_text
    caption = "Base link position in the world frame"
    return time_figure(flight, "position", "Base position", caption, [position_group(flight)])


def pose_figure(flight: FlightReport) -> ReportFigure | str:
    """Base position (top), base attitude (bottom), and goals."""
    if not len(flight.time):
        return flight.no_poses_text
    caption = "Base link position in the world frame, and base attitude as a rotation vector"
    groups = [position_group(flight), attitude_group(flight)]
    return time_figure(flight, "pose", "Base pose", caption, groups)


def attitude_figure(flight: FlightReport) -> ReportFigure | str:
    """Base attitude and goal."""
    if not len(flight.attitude):
        return flight.no_poses_text
    caption = (
        "Base link attitude as exponential coordinates: a rotation vector along the rotation "
        "axis, with the angle as its length"
    )
    if np.linalg.norm(flight.attitude.values, axis=1).max() > np.pi:
        caption += ", continuous beyond half a revolution"
    return time_figure(flight, "attitude", "Base attitude", caption, [attitude_group(flight)])


def shape_figure(flight: FlightReport) -> ReportFigure | str:
    """Joint positions, with the URDF limits that lie within the axis range."""
    if not len(flight.q) or not flight.joint_names:
        return _why_no_joints(flight)
    caption = "Joint positions" + (", and wheel rates" if flight.wheel_columns else "")
    return time_figure(flight, "shape", "Shape", caption, shape_groups(flight))


def _why_no_joints(flight: FlightReport) -> str:
    jointless = flight.robot is not None and not flight.robot.joint_names
    return "The robot has no joints." if jointless else flight.no_joints_text


def rates_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Joint velocities; None if all joints are wheels, whose rates are shown instead of their
    angles."""
    if not flight.joint_names:
        return _why_no_joints(flight)
    if not len(flight.qdot):
        return "The bag contains no joint velocities."
    groups = joint_groups(flight, flight.signal("qdot"), "velocity", flight.shape_columns)
    if not groups:
        return None
    return time_figure(flight, "velocities", "Joint velocities", "Velocity of each joint", groups)


def twist_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Linear and angular velocity of the base link.

    None if the base is at rest, or if it oscillates in a gait with many equal cycles.
    """
    if flight.cycles is not None or not flight.signal("twist").values.any():
        return None
    groups = axis_groups(flight.signal("twist"), (("velocity", "m/s"), ("rate", "rad/s")))
    caption = "Linear and angular velocity of the base link, in the base link frame"
    return time_figure(flight, "twist", "Base velocity", caption, groups)


_MOMENTUM_DECADES = 4
_MAX_BUDGET_STATES = 2000

_MAX_PEAK_SHARE = 0.02
"""Largest fraction of samples that may be clipped as peaks."""

_PEAK_RATIOS = (3.0, 1e4)
"""Peaks are clipped if the ratio of the full range to the range without peaks is between these
limits.

Below the lower limit, all values are readable; above the upper limit, the robot is at rest except
at peaks.
"""

_EFFORT_ROUNDING = 1e-9
"""Forces and torques up to this value are considered rounding errors, N or N m."""


def efforts_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Commanded thruster wrench and joint efforts."""
    wrench = axis_groups(flight.wrench, (("thruster force", "N"), ("thruster torque", "N m")))
    wrench = [g for g in wrench if np.abs(g.signal.values).max(initial=0.0) > _EFFORT_ROUNDING]
    joints: list[TraceGroup] = []
    if np.abs(flight.efforts.values).max(initial=0.0) > _EFFORT_ROUNDING:
        count = len(flight.joint_names)
        joints = joint_groups(flight, flight.efforts, "joint effort", most=count)
    groups = [replace(x, window=range_without_peaks(x.signal)) for x in wrench + joints]
    if not groups:
        return None
    caption = (
        "Commanded thruster force and torque at the base link origin, in the base link frame, and "
        "joint efforts"
    )
    if not wrench:
        caption = "Commanded joint efforts; no thrust was commanded"
    if any(group.window is not None for group in groups):
        caption += ". Short peaks are clipped to keep the rest readable"
    return time_figure(flight, "efforts", "Wrench and efforts", caption, groups)


def range_without_peaks(signal: Signal) -> tuple[float, float] | None:
    """Return the signal range without its highest peaks; None if there are no high peaks."""
    if not len(signal):
        return None
    low, high = (float(np.min(signal.values)), float(np.max(signal.values)))
    inner = np.quantile(signal.values, (_MAX_PEAK_SHARE / 2, 1 - _MAX_PEAK_SHARE / 2), axis=0)
    inner_low, inner_high = float(inner[0].min()), float(inner[1].max())
    span = inner_high - inner_low
    if not _PEAK_RATIOS[0] * span < high - low < _PEAK_RATIOS[1] * span:
        return None
    return max(low, inner_low - 0.3 * span), min(high, inner_high + 0.3 * span)


def thrusters_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Thruster duty cycles, impulse and propellant."""
    names = flight.bag.names("thrusters")
    if not len(flight.signal("thruster_duty")) or not flight.signal("thruster_duty").values.any():
        return None
    whole = flight.signal("thruster_duty")
    used = [k for k in range(len(names)) if whole.values[:, k].any()]
    duty = Signal(whole.time, whole.values[:, used])
    label, unit = "thrusters", "fraction of each tick during which they are on"
    groups = [TraceGroup(duty, [shortened(names[k]) for k in used], label, unit, rows=True)]
    thrust, propellant = flight.signal("thruster_force"), flight.series.get("propellant")
    total = impulse(thrust, np.ones(thrust.width), flight.resets)
    groups.append(TraceGroup(total, ["impulse"], "impulse given", "N s"))
    caption = "Fraction of each tick during which each thruster was on; lower panel: total impulse"
    on = whole.values > 0
    # A closed nozzle gives no thrust.
    vain = (on & (thrust.values == 0)).sum(axis=0) > on.sum(axis=0) / 2 if len(thrust) else ()
    failed = [name for name, each in zip(names, vain, strict=False) if each]
    if failed:
        caption = caption.replace(";", f", although {enumeration(failed)} mostly gave no thrust;")
    if propellant is not None:
        grams = Signal(propellant.time, 1e3 * propellant.values)
        groups.append(TraceGroup(grams, ["propellant"], "propellant", "g", [PALETTE[1]]))
        caption += " and the propellant consumed, according to the specific impulse"
    if flight.resets:
        caption += "; totals begin anew at a reset"
    if len(used) < len(names):
        caption += f". {len(names) - len(used)} of {len(names)} thrusters were never on"
    return time_figure(flight, "thrusters", "Thruster firings", caption, groups)


def momentum_figure(flight: FlightReport) -> ReportFigure | str:
    """Change in total momenta, and kinetic energy."""
    balance = flight.unexplained_momentum
    if not len(balance):
        return "The bag contains no momentum."
    values = momentum_change(balance.values[:, :6], balance.values[0, :6])
    changes, energy = Signal(balance.time, values), Signal(balance.time, balance.values[:, 6:7])
    names, unit = ["|p − p₀| (kg m/s)", "|L − L₀| (kg m²/s)"], "kg m/s, kg m²/s"
    groups = [
        TraceGroup(changes, names, "change", unit, decades=_MOMENTUM_DECADES),
        TraceGroup(energy, ["energy"], "kinetic energy", "J", [colour(2)]),
    ]
    caption = (
        "The momentum balance of the whole system. Top: change in the linear momentum p and in the "
        "angular momentum L about the centre of mass since the start, minus the thruster impulse, "
        "on a logarithmic axis; zero and smaller changes are shown at the lower edge of the axis. "
        "Bottom: kinetic energy"
    )
    return time_figure(flight, "momentum", "Momentum balance", caption, groups)


def momentum_budget_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Angular momentum of the base, the arm and the wheels, and their total; None if there are
    neither wheels nor a capture."""
    robot, captured = flight.robot, flight.capture.get("captured", False)
    if robot is None or not (robot.wheel_names or captured):
        return None
    try:
        budget = momentum_budget_over_time(flight, _MAX_BUDGET_STATES)
    except RobotDescriptionError as error:
        return f"The momentum budget is not drawn. {error}"
    if not len(budget):
        return None
    parts = [part for part in BUDGET_PARTS if part != "wheels" or robot.wheel_names]
    columns = [BUDGET_PARTS.index(part) for part in parts]
    signal = Signal(budget.time, budget.values[:, columns])
    tints = [colour(column) for column in columns]
    group = TraceGroup(signal, parts, "angular momentum", "N m s", tints)
    caption = (
        "Components of the angular momentum about the centre of mass: that of the base, as if the "
        "robot rotated with its joints at rest; that of the arm, due to joint motion relative to "
        "the base, including a held body; "
    )
    caption += "that of the wheels about their axes; " if "wheels" in parts else ""
    caption += "and the total, which only external loads change "
    caption += "(the norms are shown; the vectors add up)"
    return time_figure(flight, "momentum_budget", "Momentum budget", caption, [group])


_MAX_CLEARANCE_SAMPLES = 2000


def clearance_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Smallest distance between two links; None if no links of the robot can touch."""
    clearance = flight.clearance
    if clearance is None:
        return None
    time, distances = clearance.over_time(_MAX_CLEARANCE_SAMPLES)
    signal = Signal(time, distances[:, np.newaxis])
    touching = bool(distances.min() <= 0)
    limits = [(0, 0.0)] if touching else []
    group = TraceGroup(
        signal, ["distance"], "smallest distance", "m", limits=limits, limit_name="contact"
    )
    nearest = clearance.nearest
    sentence = f"{sentence_case(str(nearest))} at {clearance.nearest_time:.4g} s"
    caption = f"Smallest distance between two links not connected by a joint. {sentence}"
    if touching:
        caption += "; below the dotted line, links touch according to the URDF geometry"
    if not clearance.geometry.exact:
        caption += "; distances are lower bounds, since coal is not installed"
    return time_figure(flight, "clearance", "Clearance", caption, [group])


def _power_of_ten(value: float) -> str:
    """Return a power of ten as a string with an exponent, for a logarithmic axis."""
    exponent = str(round(np.log10(value))).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"10{exponent}"


_SENSOR_ROUNDING = 1e-12
"""Sensor errors up to this value are considered rounding errors, m or rad."""


_MAX_DECADES = 8

_ERROR_PARTS: dict[Literal["position", "attitude"], tuple[str, str]] = {
    "position": ("distance", "m"),
    "attitude": ("angle", "rad"),
}
"""Name and unit of the error norm of each goal component."""


def errors_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Distance and angle between the base and its goal, and between a controller's end-effector and
    its goal, counting only the controlled components.
    """
    base = flight.signal("pose")
    groups = []
    for number, (part, pose, targets) in enumerate(
        (("base", base, flight.targets), ("end_effector", flight.tool, flight.tool_targets))
    ):
        errors, of = pose_errors(pose, targets), part.replace("_", "-")
        free = flight.not_controlled if part == "base" else ()
        for k, half in enumerate(_ERROR_PARTS):
            chosen = [i for i in flight.controls(part) if i // 3 == k]
            if len(errors) and chosen and half not in free:
                signal = errors.norms(chosen)
                groups.append(error_group(flight, signal, half, of, colour(number)))
    if not groups:
        return None
    caption = (
        "Distance and angle from the goal, in the controlled components, on logarithmic axes; "
        "smaller values are drawn at the lower edge; dotted line: tolerance"
    )
    if left_out := [part for part in _ERROR_PARTS if part in flight.not_controlled]:
        caption += f"; the base {' and '.join(left_out)} is not controlled"
    return time_figure(flight, "errors", "Errors", caption, groups)


def error_group(
    flight: FlightReport,
    signal: Signal,
    part: Literal["position", "attitude"],
    of: str,
    line_colour: str,
) -> TraceGroup:
    """Return the panel of a distance or an angle (N, 1) with its tolerance; its axis shows the
    largest error and the tolerance."""
    quantity, unit = _ERROR_PARTS[part]
    tolerance = flight.tolerance(part)
    _, top = log_range(signal.values, 0)
    down_to = 0.1 * tolerance if tolerance else 1e-4 * top
    return TraceGroup(
        signal,
        [quantity],
        f"{quantity} of {of}",
        unit,
        [line_colour],
        limits=[] if not tolerance else [(0, tolerance)],
        limit_name="tolerance",
        decades=int(np.clip(np.ceil(np.log10(top / down_to)), 3, _MAX_DECADES)),
    )


def link_errors_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Distance and angle between each link and its goals; None if no link had a goal."""
    if not flight.link_errors:
        return flight.hidden_links_text or None if flight.link_goals else None
    groups: list[TraceGroup] = []
    for number, (link, errors) in enumerate(flight.link_errors.items()):
        for part, signal in zip(_ERROR_PARTS, errors, strict=True):
            if len(signal):
                groups.append(error_group(flight, signal, part, shortened(link), colour(number)))
    caption = (
        "Distance between each link and its goal position, and angle from its goal attitude if "
        "required, on logarithmic axes; smaller values are drawn at the lower edge; dotted line: "
        "tolerance"
    )
    if flight.base_goal is None:
        caption += "; the base is not controlled"
    return time_figure(flight, "link_errors", "Errors of end-effectors", caption, groups)


def sensors_figure(flight: FlightReport) -> ReportFigure | str | None:
    """Measured minus true poses and joint positions; None if sensors have no errors."""
    time, pose, true = _at_same_times(flight.signal("measured_pose"), flight.signal("pose"))
    turn = quaternion_multiply(pose[:, 3:], quaternion_inverse(true[:, 3:]))
    errors = np.hstack([pose[:, :3] - true[:, :3], rotvecs_from_quaternions(turn)])
    parts = (("base position error", "m"), ("base attitude error", "rad"))
    groups = axis_groups(Signal(time, errors), parts)
    time, shape, true = _at_same_times(flight.signal("measured_q"), flight.signal("q"))
    if len(shape):
        groups += joint_groups(flight, Signal(time, shape - true), "joint position error")
    groups = [g for g in groups if np.abs(g.signal.values).max(initial=0.0) > _SENSOR_ROUNDING]
    if not groups:
        return None
    caption = "Measured minus true values at the measurement times"
    return time_figure(flight, "sensors", "Errors of the sensors", caption, groups)


def _at_same_times(measured: Signal, true: Signal) -> tuple[Array, Array, Array]:
    """Return the times of both signals, and the values of each at these times."""
    time, rows, at = np.intersect1d(measured.time, true.time, return_indices=True)
    return time, measured.values[rows], true.values[at]
