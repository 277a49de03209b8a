"""Key figures of a flight as table rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from spacerobot_ros.errors import SpaceRobotError, numbers, quantity
from spacerobot_ros.flight.captures import payload_estimates
from spacerobot_ros.flight.series import pose_error
from spacerobot_ros.measures import peak, peak_wrench
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import INERTIA_ENTRIES
from spacerobot_ros.model.payload_estimation import PayloadEstimate
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.planning import PoseError
from spacerobot_ros.planning.execution.status import PlannerStatus, time_to_end
from spacerobot_ros.report.flight import FlightReport, joint_unit, labels_of
from spacerobot_ros.scenario import Published

_NO_VALUE = "–"
_LEAST_ANGLE_IN_DEGREES = 1e-4  # rad
_EQUAL_TIME_TICKS = 1.5
"""Largest difference between times that are considered equal, in control periods."""


class Table(NamedTuple):
    """Rows of text below a header; ``numeric`` contains the columns that are aligned as numbers."""

    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    numeric: tuple[int, ...] = ()


def headline(flight: FlightReport) -> list[tuple[str, str, str]]:
    """Return the label, value and note of each key figure."""
    rows: list[tuple[str, str, str]] = []
    error, sensed = flight.error, pose_error(flight.signal("measured_pose"), flight.base_goal)
    if error is not None:
        measured = "" if sensed is None else f"measured: {quantity(sensed.distance, 'm')}"
        near = quantity(error.distance, "m"), measured
        rows.append(("Position error", *_error_with_tolerance(flight, "position", *near)))
        measured = "" if sensed is None else f"measured: {quantity(sensed.angle, 'rad')}"
        if error.angle >= _LEAST_ANGLE_IN_DEGREES:
            measured = "; ".join(filter(None, (f"{math.degrees(error.angle):.3g}°", measured)))
        turned = quantity(error.angle, "rad"), measured
        rows.append(("Attitude error", *_error_with_tolerance(flight, "attitude", *turned)))
    if flight.tool_goals and (tool := flight.end_effector_error) is not None:
        turns = bool(set(flight.controls("end_effector")) & {3, 4, 5})
        rows.append(_end_effector_row(flight, "End-effector error", tool, turns))
    for link, left in flight.end_effector_errors.items():
        turns = flight.link_goals[link].quaternion is not None
        rows.append(_end_effector_row(flight, f"Error of {link}", left, turns))
    if flight.time_flown is not None:
        schedules = len(flight.executing)
        notes = [f"{schedules} schedules in the whole flight"] if schedules > 1 else []
        notes += _time_to_end_texts(flight)
        rows.append(("Manoeuvre", f"{flight.time_flown:.6g} s", "; ".join(notes)))
    if len(flight.unexplained_momentum) > 1:
        linear, angular = flight.momentum_drift.tolist()
        label = "Momentum not explained by thrusters" if flight.has_thrust else "Momentum drift"
        rows.append((label, quantity(linear, "kg m/s"), f"angular {quantity(angular, 'kg m²/s')}"))
    if (propellant := flight.propellant) is not None:
        planned = flight.planned_propellant
        notes = [] if planned is None else [f"planned: {1e3 * planned:.3g} g"]
        notes += ["since the reset"] * bool(flight.resets)
        rows.append(("Propellant", f"{1e3 * propellant:.3g} g", "; ".join(notes)))
    if capture := flight.capture:
        distance = flight.capture_metrics.get("capture_distance_m")
        done = f"at {capture['time_s']:.4g} s" if capture["captured"] else "no"
        nearest = "" if distance is None else f"{quantity(distance, 'm')} from the grapple"
        rows.append(("Target captured", done, nearest))
    if len(time := flight.time) > 1:
        ticks = f"{time[-1] - time[0]:.6g} s, ticks of {flight.tick:.4g} s"
        rows.append(("Recorded", f"{len(time) - 1} ticks", ticks))
    return rows


def _end_effector_row(
    flight: FlightReport, label: str, error: PoseError, turns: bool
) -> tuple[str, str, str]:
    """Return the row of an end-effector: distance, angle if relevant, and tolerances."""
    limits = _tolerance_text(flight, "position")
    if limits and turns:
        limits += f", {_tolerance_text(flight, 'attitude')}"
    notes = [quantity(error.angle, "rad")] if turns else []
    notes += [f"tolerance {limits}"] if limits else []
    return label, quantity(error.distance, "m"), "; ".join(notes)


def _error_with_tolerance(
    flight: FlightReport, part: Literal["position", "attitude"], error: str, note: str
) -> tuple[str, str]:
    if part in flight.not_controlled:
        return "not controlled", f"{error} from the goal"
    limit = _tolerance_text(flight, part)
    return error, "; ".join(filter(None, (note, limit and f"tolerance {limit}")))


def runs_table(flights: Sequence[FlightReport]) -> Table:
    """Return the outcome, key figures and extreme values of several flights, one column each."""
    found = [
        {"Outcome": flight.verdict.word}
        | {label: value for label, value, _ in headline(flight)}
        | _extreme_values(flight)
        for flight in flights
    ]
    labels = list(dict.fromkeys(label for values in found for label in values))
    rows = [(label, *(values.get(label, _NO_VALUE) for values in found)) for label in labels]
    return Table(("Flight", *labels_of(flights)), rows)


def _extreme_values(flight: FlightReport) -> dict[str, str]:
    """Return the clearance, and the peaks of thrust and effort with the total impulse."""
    found = [("Clearance", flight.smallest_distance, "m")]
    for label, value in zip(("force", "torque"), peak_wrench(flight.wrench.values), strict=True):
        found.append((f"Peak thruster {label}", value, "N" if label == "force" else "N m"))
    found.append(("Thrust impulse", flight.thrust_impulse, "N s"))
    units = np.array([joint_unit(flight, name) for name in flight.joint_names])
    for label, of, unit in (("torque", "rad", "N m"), ("force", "m", "N")):
        largest = peak(flight.efforts.values)[units == of].max(initial=0.0)
        found.append((f"Peak joint {label}", largest, unit))
    return {label: quantity(x, unit) for label, x, unit in found if x and math.isfinite(x)}


def result_table(flight: FlightReport) -> Table:
    """Return goals, final poses, the estimated held body and the clearance, each if it is in the
    bag."""
    rows: list[tuple[str, ...]] = []
    last = flight.reports[-1][1].state.value if flight.reports else ""
    refused = " (refused)" if last == "refused" and not flight.executing else ""
    for part, text in _base_goal_texts(flight).items():
        rows.append((f"Goal {part}{refused if part != _FREE_BASE else ''}", text))
    if len(flight.time):
        rows.append(("Final position", _position_text(flight.pose[-1, :3])))
        rows.append(("Final attitude", _attitude_text(flight.pose[-1, 3:])))
    if flight.tool_goals and len(flight.tool):
        goal, final = flight.tool_goals[-1].goal, flight.tool.values[-1]
        rows.append(("End-effector goal", _tool_text(flight, goal.position, goal.quaternion)))
        rows.append(("End-effector, final", _tool_text(flight, final[:3], final[3:])))
    for link, aim in flight.link_goals.items():
        rows.append((f"Goal of {link}", _pose_text(aim.position, aim.quaternion)))
        if (error := flight.end_effector_errors.get(link)) is not None:
            at = aim.position - error.position
            rows.append((f"Final position of {link}", _position_text(at)))
    rows += _payload_rows(flight)
    if (clearance := flight.clearance) is not None:
        nearest = clearance.nearest
        where = f"between {nearest.links} at {clearance.nearest_time:.4g} s"
        rows.append(("Clearance", f"{quantity(nearest.distance, 'm')} {where}"))
    return Table(("Quantity", "Value"), rows)


_FREE_BASE = "of the base"


def _base_goal_texts(flight: FlightReport) -> dict[str, str]:
    """Return the components of the base goal as strings; empty if there is none."""
    goal = flight.base_goal
    if goal is None:
        return {_FREE_BASE: "not controlled"} if flight.link_goals else {}
    if not flight.controls("base") and flight.outputs:
        return {}
    poses = goal.path_values[:-1]
    through = {f"waypoint {i + 1}": _pose_text(x[:3], x[3:]) for i, x in enumerate(poses)}
    attitude = _attitude_text(goal.quaternion)
    return through | {"position": _position_text(goal.position), "attitude": attitude}


def _pose_text(position: Array, quaternion: Array | None) -> str:
    return f"{_position_text(position)}, {_attitude_text(quaternion)}"


def _tool_text(flight: FlightReport, position: Array, quaternion: Array) -> str:
    """Return an end-effector pose, with its attitude if the controller controls it."""
    turns = set(flight.controls("end_effector")) & {3, 4, 5}
    return _pose_text(position, quaternion) if turns else _position_text(position)


def different_goals(flights: Sequence[FlightReport]) -> list[tuple[str, ...]]:
    """Return a row for each goal component that differs between flights: name and values."""
    goals = [
        _base_goal_texts(flight)
        | {f"of {x.link}": _pose_text(x.position, x.quaternion) for x in flight.link_goals.values()}
        for flight in flights
    ]
    for texts, flight in zip(goals, flights, strict=True):
        for sent in flight.tool_goals[-1:]:
            pose = sent.goal.position, sent.goal.quaternion
            texts["of end_effector"] = _tool_text(flight, *pose)
    parts = dict.fromkeys(part for each in goals for part in each)
    rows = [(part, *(each.get(part, _NO_VALUE) for each in goals)) for part in parts]
    return [row for row in rows if len({*row[1:]}) > 1]


def _payload_rows(flight: FlightReport) -> list[tuple[str, ...]]:
    try:
        estimates = payload_estimates(flight)
    except SpaceRobotError as error:
        return [("Held body, estimated", str(error))]
    return [("Held body, estimated", payload_text(each)) for each in estimates]


def payload_text(estimate: PayloadEstimate) -> str:
    """Return the parameters of a held body that are determined by its motion."""
    parts = []
    mass, spread = estimate.parameters[0], estimate.deviations[0]
    if not math.isnan(mass):
        # A smaller deviation changes none of the six digits.
        about = f" ± {spread:.1g}" if spread > 1e-6 * mass else ""
        parts.append(f"mass {mass:.6g}{about} kg")
    if not np.isnan(estimate.parameters[:4]).any():
        center = numbers(estimate.parameters[1:4] / mass)
        parts.append(f"centre of mass ({center}) m in {estimate.link}")
    if (payload := estimate.payload) is not None:
        inertia = payload.inertia.about_com
        moments = ", ".join(f"{inertia[i, j]:.4g}" for i, j in INERTIA_ENTRIES)
        parts.append(f"inertia about the centre of mass ({moments}) kg m² (xx, yy, zz, xy, xz, yz)")
    if estimate.undetermined:
        parts.append(f"not determined by the motion: {', '.join(estimate.undetermined)}")
    if estimate.corrected:
        parts.append("corrected to the nearest physical parameters")
    return "; ".join(parts)


def joint_table(flight: FlightReport) -> Table | None:
    """Return the first and last joint positions and peak joint velocities, with limits."""
    if not flight.joint_names or not len(flight.q):
        return None
    rows = []
    for i, name in enumerate(flight.joint_names):
        joint = flight.joint(name)
        unit = joint_unit(flight, name)
        ends = [numbers([x]) for x in flight.q[[0, -1], i].tolist()]
        if i in flight.wheel_columns:
            ends = [_NO_VALUE] * 2  # The angle of a body of revolution is meaningless.
        limits = limit = share = peak_text = _NO_VALUE
        if joint is not None:
            if math.isfinite(joint.limits.lower) and math.isfinite(joint.limits.upper):
                limits = f"{joint.limits.lower:.5g} to {joint.limits.upper:.5g}"
            if math.isfinite(joint.limits.velocity):
                limit = f"{joint.limits.velocity:.5g} {unit}/s"
        if len(flight.qdot):
            peak = float(np.abs(flight.qdot[:, i]).max())
            peak_text = f"{peak:.5f} {unit}/s"
            if joint is not None and 0 < joint.limits.velocity < math.inf:
                share = f"{100 * peak / joint.limits.velocity:.1f} %"
        kind = joint.kind.value if joint is not None else _NO_VALUE
        rows.append((name, kind, unit, *ends, limits, peak_text, limit, share))
    head = ["Joint", "Type", "Unit", "Start", "Final", "Limits", "Peak velocity", "Limit", "Used"]
    return Table(tuple(head), rows, (3, 4, 5, 6, 7, 8))


def published_table(flight: FlightReport) -> Table | None:
    """Return the published values and the corresponding values of this flight; None if no values
    are published for the scenario."""
    if not flight.scenario.published:
        return None
    rows = []
    for row in flight.scenario.published:
        measured, source = _measured_values(flight, row)
        ours = _NO_VALUE
        if measured:
            decimals = [_count_decimals(x) for x in row.printed]
            decimals += [max(decimals, default=4)] * (len(measured) - len(decimals))
            ours = ", ".join(f"{x:.{d}f}" for x, d in zip(measured, decimals, strict=False))
        printed = ", ".join(f"{x:.{_count_decimals(x)}f}" for x in row.printed)
        rows.append((row.quantity, printed, ours, source, row.note))
    return Table(("Quantity", "Printed", "Measured", "Source", "Note"), rows)


def _measured_values(flight: FlightReport, row: Published) -> tuple[list[float], str]:
    whole = flight.error is not None and len(flight.q) and len(flight.qdot)
    value = flight.summary().get(row.quantity) if whole else None
    if isinstance(value, float | list):
        return np.atleast_1d(value).tolist(), "flight"
    notes = flight.executing[0][1].notes if flight.executing else {}
    value = notes.get(row.quantity, "")
    noted: list[float] = [] if isinstance(value, str) else np.atleast_1d(value).tolist()
    return noted, "planner" if noted else ""


def _count_decimals(x: float) -> int:
    text = repr(x)
    return 0 if "e" in text or text.endswith(".0") else len(text.partition(".")[2])


def _position_text(position: Array) -> str:
    return f"({numbers(position)}) m"


def _attitude_text(quaternion: Array | None) -> str:
    if quaternion is None:
        return "any attitude"
    rotvec = rotvec_from_quaternion(quaternion)
    angle = math.degrees(math.hypot(*rotvec))
    return f"rotation vector ({numbers(rotvec)}) rad, {angle:.3f}° in total"


def _tolerance_text(flight: FlightReport, part: Literal["position", "attitude"]) -> str:
    value, unit = flight.tolerance(part), "m" if part == "position" else "rad"
    return "" if value is None else quantity(value, unit)


def _time_to_end_texts(flight: FlightReport) -> list[str]:
    """Return the time to the end if it differs from that of the schedules; otherwise nothing."""
    planned = [(time, each) for time, each in flight.reports if isinstance(each, PlannerStatus)]
    whole, flown = time_to_end(planned, flight.end), flight.time_flown
    if whole is None or flown is None or abs(whole - flown) < _EQUAL_TIME_TICKS * flight.tick:
        return []
    return [f"{whole:.6g} s from the first schedule to the end"]
