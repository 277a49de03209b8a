"""What is measured of a flight, by name."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.flight.arrays import FlightArrays
from spacerobot_ros.flight.scenario import Scenario
from spacerobot_ros.model.description import Array


@dataclass(frozen=True)
class Metric:
    """A number of a flight.

    Attributes
    ----------
    unit, description
        For people.
    of
        Returns it, NaN where a flight has none; or a number for each joint.
    by_joint
        Whether ``<name>.<joint>`` is one of a joint, and the name itself the worst of all.
    least
        Whether the smallest is the worst.
    """

    unit: str
    description: str
    of: Callable[[FlightArrays], float | Array]
    by_joint: bool = False
    least: bool = False


def _tool(part: str) -> Callable[[FlightArrays], float]:
    def of(flight: FlightArrays) -> float:
        error = flight.end_effector_error
        return math.nan if error is None else getattr(error, part)

    return of


def _thrust(first: int) -> Callable[[FlightArrays], float]:
    def of(flight: FlightArrays) -> float:
        sent = flight.commands.get("base_wrench")
        if sent is None or not len(sent.values):
            return 0.0
        return float(np.linalg.norm(sent.values[:, first : first + 3], axis=1).max())

    return of


def _propellant(flight: FlightArrays) -> float:
    used = flight.propellant
    return math.nan if used is None else used


def _peak(rows: Array) -> Array:
    return np.asarray(np.abs(rows).max(axis=0))


def _ends(flight: FlightArrays) -> Array:
    lower, upper = flight.robot.limits("lower"), flight.robot.limits("upper")
    return np.minimum(flight.q - lower, upper - flight.q).min(axis=0)


def _margin(what: str, limit: str, rows: Callable[[FlightArrays], Array]) -> Metric:
    return Metric(
        "",
        f"what remains of the {what} limit of a joint, as a share of it",
        lambda f: 1.0 - _peak(rows(f)) / f.robot.limits(limit),
        by_joint=True,
        least=True,
    )


METRICS: dict[str, Metric] = {
    "position_error_m": Metric(
        "m", "from the true position of the base at the end to the goal", lambda f: f.error.distance
    ),
    "attitude_error_rad": Metric(
        "rad", "from the true attitude of the base at the end to the goal", lambda f: f.error.angle
    ),
    "end_effector_position_error_m": Metric(
        "m", "likewise, of the end-effector", _tool("distance")
    ),
    "end_effector_attitude_error_rad": Metric(
        "rad", "likewise, of the end-effector", _tool("angle")
    ),
    "duration_s": Metric("s", "simulated time of the flight", lambda f: f.duration),
    "manoeuvre_time_s": Metric("s", "duration of all schedules", lambda f: f.manoeuvre_time),
    "corrections": Metric("", "plans after the first", lambda f: float(f.corrections)),
    "propellant_kg": Metric("kg", "propellant of the thrusters", _propellant),
    "peak_rate": Metric(
        "m/s or rad/s", "largest rate of a joint", lambda f: _peak(f.qdot), by_joint=True
    ),
    "peak_effort": Metric(
        "N or N m", "largest effort of a joint", lambda f: _peak(f.effort), by_joint=True
    ),
    "peak_force_N": Metric("N", "largest force that was commanded of the thrusters", _thrust(0)),
    "peak_torque_Nm": Metric("N m", "largest torque likewise", _thrust(3)),
    "joint_margin": Metric(
        "m or rad", "least distance of a joint from its ends", _ends, by_joint=True, least=True
    ),
    "rate_margin": _margin("rate", "velocity", lambda f: f.qdot),
    "effort_margin": _margin("effort", "effort", lambda f: f.effort),
    "momentum_drift": Metric(
        "kg m/s, kg m^2/s",
        "largest change of a momentum that thrust does not explain",
        lambda f: max(f.momentum_changes),
    ),
}
"""Every metric by its name."""


def is_metric(name: str, scenario: Scenario) -> bool:
    """Whether a name is that of a metric, or of one of a joint of the scenario's robot."""
    kind, dot, joint = name.partition(".")
    if kind not in METRICS:
        return False
    return not dot or (METRICS[kind].by_joint and joint in joint_names(scenario))


def joint_names(scenario: Scenario) -> tuple[str, ...]:
    """Return the joints of the plant's robot."""
    from spacerobot_ros.campaign.targets import description_of

    return tuple(description_of(scenario).joint_names)


def measured(flight: FlightArrays) -> dict[str, float]:
    """Return every metric of a flight by name, those of joints too; NaN where it has none."""
    found: dict[str, float] = {}
    with np.errstate(divide="ignore", invalid="ignore"):
        for name, metric in METRICS.items():
            value = metric.of(flight)
            if not metric.by_joint:
                found[name] = float(value)
                continue
            each = np.asarray(value, dtype=float)
            worst = each.min if metric.least else each.max
            found[name] = float(worst()) if each.size else math.nan
            for joint, number in zip(flight.joint_names, each.tolist(), strict=True):
                found[f"{name}.{joint}"] = number
    return found


def metric_names(joints: tuple[str, ...]) -> list[str]:
    """Return the names that :func:`measured` gives for a robot with these joints, in order."""
    names: list[str] = []
    for name, metric in METRICS.items():
        names.append(name)
        names += [f"{name}.{joint}" for joint in joints] if metric.by_joint else []
    return names
