"""The measures of a flight: key figures for the whole flight, each defined once.

Campaigns, the summary of ``spacerobot run``, reports and the live page use these measures. A
:class:`~spacerobot_ros.flight.flight.Flight` computes them from its arrays over time; SIMD lanes,
which store only extreme values and the last state, return the measures directly.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import Any

import numpy as np

from spacerobot_ros.control.status import ControllerState, ControllerStatus, tracking_time
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.planning.core.goal import PoseError
from spacerobot_ros.planning.execution.status import PlannerStatus, manoeuvre_time


class Outcome(str, Enum):
    """Outcome of a goal; each value except the last is also a ``state`` in status messages."""

    REACHED = "reached"
    REACHED_PARTLY = "reached_partly"
    """The goal was reached except for a required component of the base pose that is not
    controlled.
    """
    FAILED = "failed"
    REFUSED = "refused"
    ABORTED = "aborted"
    INTERRUPTED = "interrupted"
    """The flight ended before the goal was decided."""


@dataclass(frozen=True, eq=False)
class Measures:
    """The measures of one flight; poses, joints and momenta are true values.

    Attributes
    ----------
    outcome, message
        Outcome of the goal, and its description in one sentence.
    duration
        Simulated time, s.
    manoeuvre_time
        Duration, s, of the schedules flown for the goal, or of the tracking by a controller; see
        :func:`flown_time`.
    error
        Error of the last base pose relative to its goal; None without a goal or a pose.
    end_effector_distance, end_effector_angle
        Final distance (m) and angle (rad) of the end-effector from its goal; with several
        end-effectors, the largest values; NaN without a goal or a pose. The angle is also NaN if
        the attitude is free or not controlled.
    peak_rate, peak_effort
        (n,) largest absolute rates (m/s or rad/s) and actuator efforts (N or N m) of the joints.
    peak_wrench
        (2,) largest norms of the commanded force (N) and torque (N m) on the base.
    lowest, highest
        (n,) joint position ranges, m or rad.
    momentum_drift
        (2,) momentum drift, kg m/s and kg m^2/s; see :func:`momentum_drift`.
    corrections
        Number of corrections, that is, plans after the first one.
    propellant
        Propellant used by the thrusters, kg; NaN without thrusters.
    plan_time, wall_time
        Wall times of the planning and of the whole flight, s; NaN if unknown.
    clearance
        Smallest distance between two links, m; a negative value is the penetration depth. Infinite
        for a robot without pairs that could touch, NaN if not measured.
    capture
        The metrics of the capture that have a value, by name; none without a target.
    """

    outcome: Outcome
    message: str
    duration: float
    manoeuvre_time: float
    error: PoseError | None
    peak_rate: Array
    peak_effort: Array
    peak_wrench: Array
    lowest: Array
    highest: Array
    momentum_drift: Array
    end_effector_distance: float = math.nan
    end_effector_angle: float = math.nan
    corrections: int = 0
    propellant: float = math.nan
    plan_time: float = math.nan
    wall_time: float = math.nan
    clearance: float = math.nan
    capture: Mapping[str, float] = field(default_factory=dict)


def momentum_change(momenta: Array, reference: Array) -> Array:
    """Return the norms (..., 2) of linear and angular momentum differences.

    Parameters
    ----------
    momenta, reference
        (..., 6) linear (kg m/s), then angular momentum (kg m^2/s).
    """
    difference = momenta - reference
    return np.asarray(np.linalg.norm(difference.reshape(*difference.shape[:-1], 2, 3), axis=-1))


def momentum_drift(momenta: Array) -> Array:
    """Return the largest change (..., 2) in linear and angular momentum.

    The change is ``max |m(t) - m(0)|`` over each flight, where ``m`` are the momenta without the
    contribution of the thrusters.

    Parameters
    ----------
    momenta
        (..., N, 6) or more columns, the momenta first: kg m/s and kg m^2/s. Rows that are not
        finite are ignored.
    """
    m = momenta[..., :6]
    finite = np.asarray(np.isfinite(m).all(axis=-1, keepdims=True))
    if not finite.any():
        return np.full((*m.shape[:-2], 2), np.nan)
    m = np.where(finite, m, 0.0)
    first = np.take_along_axis(m, finite.argmax(axis=-2, keepdims=True), axis=-2)
    changes = np.where(finite, momentum_change(m, first), 0.0)
    return np.where(finite.any(axis=-2), changes.max(axis=-2), np.nan)


def peak(values: Array) -> Array:
    """Return the largest absolute value (k,) of each column of values (N, k), or 0 if there are no
    rows.
    """
    return np.asarray(np.abs(values).max(axis=0, initial=0.0))


def peak_wrench(wrenches: Array) -> Array:
    """Return the largest force and torque norms (2,) of wrenches (N, 6), or 0 if there are no
    wrenches.
    """
    return peak(np.linalg.norm(wrenches.reshape(-1, 2, 3), axis=2))


def flown_time(
    statuses: Iterable[tuple[float, PlannerStatus | ControllerStatus]], end: float
) -> float | None:
    """Return the flight time, s, for the last goal.

    With a planner, this is the duration of the flown schedules
    (:func:`~spacerobot_ros.planning.execution.status.manoeuvre_time`); otherwise, it is the time
    from the first state that a controller tracked for its last completed goal to the end of this
    goal.

    Parameters
    ----------
    statuses
        Time (s) and status, in order of time.
    end
        End of the flight, s.

    Returns
    -------
    float | None
        None if neither is reported.
    """
    all_statuses = list(statuses)
    planner = [(time, each) for time, each in all_statuses if isinstance(each, PlannerStatus)]
    if planner:
        end = max(end, planner[-1][0])
    controller = [(time, each) for time, each in all_statuses if isinstance(each, ControllerStatus)]
    decided = [
        each.goal_id
        for _, each in controller
        if each.state.decided and each.state is not ControllerState.REFUSED
    ]
    of_last = [(time, each.state) for time, each in controller if each.goal_id in decided[-1:]]
    return manoeuvre_time(planner, end) or tracking_time(of_last)


# -- the measures by name ---------------------------------------------------------------------


@dataclass(frozen=True)
class Metric:
    """A measure of a flight as a number with a unit.

    Attributes
    ----------
    unit, description
        SI unit (empty: none) and a short description for the user.
    evaluate
        Function of the measures and the robot. The function returns one number (NaN if not
        applicable), or one number per joint: (..., n) for joint measures (..., n) of several
        flights.
    by_joint
        Whether there is a value ``<name>.<joint>`` for each joint, and ``<name>`` is the worst of
        these.
    smallest_is_worst
        Whether the smallest value is the worst.
    yes_or_no
        Whether the value is a flag (1 for yes, 0 for no).
    """

    unit: str
    description: str
    evaluate: Callable[[Measures, RobotDescription], float | Array]
    by_joint: bool = False
    smallest_is_worst: bool = False
    yes_or_no: bool = False


def _capture_metric(name: str, unit: str, description: str) -> Metric:
    return Metric(unit, description, lambda m, _: m.capture.get(name, math.nan), yes_or_no=not unit)


def _error_metric(part: str, unit: str, description: str) -> Metric:
    """Return the metric for one part (``distance`` or ``angle``) of the base error."""
    return Metric(unit, description, lambda m, _: float(getattr(m.error, part, math.nan)))


def _joint_margin(measures: Measures, robot: RobotDescription) -> Array:
    lower, upper = robot.limits("lower"), robot.limits("upper")
    return np.minimum(measures.lowest - lower, upper - measures.highest)


def _margin_metric(quantity: str, limit: str, peak_of: Callable[[Measures], Array]) -> Metric:
    return Metric(
        "",
        f"unused fraction of a joint's {quantity} limit",
        lambda measures, robot: 1.0 - peak_of(measures) / robot.limits(limit),
        by_joint=True,
        smallest_is_worst=True,
    )


_OF_JOINTS = ("peak_rate", "peak_effort", "lowest", "highest")
"""Fields of :class:`Measures` with one number per joint."""

_CAPTURE_METRICS = {
    "captured": ("", "whether the target was captured, 1 or 0"),
    "placed": ("", "whether the goal was reached with the target, 1 or 0"),
    "capture_time_s": ("s", "time of the capture"),
    "capture_distance_m": (
        "m",
        "distance between end-effector and grapple frame at the capture; without a capture, the "
        "smallest distance",
    ),
    "capture_impulse_Ns": ("N s", "impulse of the capture"),
    "capture_angular_impulse_Nms": ("N m s", "moment of the capture impulse at the end-effector"),
    "capture_joint_impulse": (
        "N m s or N s",
        "largest component of the capture impulse along a joint coordinate",
    ),
    "detumbling_time_s": ("s", "time until the robot and the target came to rest"),
    "detumbling_bound_s": ("s", "shortest time to rest with the available torques"),
}
"""Unit and description of each metric of a capture; those without a unit are flags."""

CLEARANCE = "clearance_m"
"""Name of the metric that campaigns measure only on request."""

METRICS: dict[str, Metric] = {
    "position_error_m": _error_metric(
        "distance", "m", "distance of the last true base position from the goal"
    ),
    "attitude_error_rad": _error_metric(
        "angle", "rad", "angle between the last true attitude of the base and the goal"
    ),
    "end_effector_position_error_m": Metric(
        "m",
        "final distance of the end-effector from its goal (the largest if there are several "
        "end-effectors)",
        lambda m, _: m.end_effector_distance,
    ),
    "end_effector_attitude_error_rad": Metric(
        "rad",
        "final angle of the end-effector from its goal if its attitude is controlled (the "
        "largest if there are several end-effectors)",
        lambda m, _: m.end_effector_angle,
    ),
    "duration_s": Metric("s", "simulated time of the flight", lambda m, _: m.duration),
    "manoeuvre_time_s": Metric("s", "flight time for the last goal", lambda m, _: m.manoeuvre_time),
    "corrections": Metric("", "number of corrections", lambda m, _: float(m.corrections)),
    "propellant_kg": Metric("kg", "propellant of the thrusters", lambda m, _: m.propellant),
    "peak_rate": Metric(
        "m/s or rad/s", "largest joint rate", lambda m, _: m.peak_rate, by_joint=True
    ),
    "peak_effort": Metric(
        "N or N m", "largest joint effort", lambda m, _: m.peak_effort, by_joint=True
    ),
    "peak_force_N": Metric(
        "N", "largest commanded thruster force", lambda m, _: float(m.peak_wrench[0])
    ),
    "peak_torque_Nm": Metric(
        "N m", "largest commanded thruster torque", lambda m, _: float(m.peak_wrench[1])
    ),
    "joint_margin": Metric(
        "m or rad",
        "smallest distance between a joint position and its limits",
        _joint_margin,
        by_joint=True,
        smallest_is_worst=True,
    ),
    "rate_margin": _margin_metric("rate", "velocity", lambda m: m.peak_rate),
    "effort_margin": _margin_metric("effort", "effort", lambda m: m.peak_effort),
    "momentum_drift": Metric(
        "kg m/s, kg m^2/s",
        "largest momentum change not explained by thrust",
        lambda m, _: float(m.momentum_drift.max()),
    ),
    CLEARANCE: Metric(
        "m",
        "smallest distance between two links, measured if named in the campaign; negative: "
        "penetration depth",
        lambda m, _: m.clearance,
        smallest_is_worst=True,
    ),
    **{name: _capture_metric(name, *about) for name, about in _CAPTURE_METRICS.items()},
}
"""Every metric by name."""


def metrics_of_each(
    measures: Sequence[Measures], robot: RobotDescription
) -> list[dict[str, float]]:
    """Return all metrics by name, with joint metrics, for flights of one robot; NaN: no value."""
    if not measures:
        return []
    joints: dict[str, Any] = {
        name: np.array([getattr(each, name) for each in measures]) for name in _OF_JOINTS
    }
    of_joints = replace(measures[0], **joints)
    columns: dict[str, list[float]] = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        for name, metric in METRICS.items():
            if not metric.by_joint:
                columns[name] = [float(metric.evaluate(each, robot)) for each in measures]
                continue
            by_joint = np.asarray(metric.evaluate(of_joints, robot), dtype=float)
            worst = np.full(len(measures), math.nan)
            if robot.joint_names:
                worst = (np.min if metric.smallest_is_worst else np.max)(by_joint, axis=1)
            columns[name] = worst.tolist()
            for joint, numbers in zip(robot.joint_names, by_joint.T.tolist(), strict=True):
                columns[f"{name}.{joint}"] = numbers
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def metric_names(joints: Sequence[str]) -> list[str]:
    """Return the names that :func:`metrics_of_each` returns for these joints, in order."""
    names: list[str] = []
    for name, metric in METRICS.items():
        names.append(name)
        names += [f"{name}.{joint}" for joint in joints] if metric.by_joint else []
    return names
