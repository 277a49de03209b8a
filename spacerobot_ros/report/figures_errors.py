"""Figures of what is off: poses from their goals, and sensors from what they measure."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spacerobot_ros.model.rotations import (
    quaternion_inverse,
    quaternion_multiply,
    rotvecs_from_quaternions,
)
from spacerobot_ros.report.figures_motion import JOINTS_A_PANEL, axis_groups, joint_groups
from spacerobot_ros.report.flight import Flight, Target
from spacerobot_ros.report.over_time import time_plate
from spacerobot_ros.report.plates import Group, Plate
from spacerobot_ros.report.signals import Indices, Signal
from spacerobot_ros.report.style import PALETTE

_SMALLEST_ERROR = 1e-12
"""Errors of sensors that are rounding errors, m or rad."""


def errors_plate(flight: Flight) -> Plate | None:
    """Goal minus pose of base and end-effector, in the components under control."""
    if not flight.outputs and not flight.tool_goals:
        return None
    groups = []
    base = Signal(flight.position.time, np.hstack([flight.position.values, flight.quaternion]))
    for part, pose, targets in (
        ("base", base, flight.targets),
        ("end_effector", flight.tool, flight.tool_targets),
    ):
        errors = pose_errors(pose, targets)
        chosen = flight.controls(part)
        name = part.replace("_", "-")
        for unit, what, members in (("m", "position", (0, 1, 2)), ("rad", "attitude", (3, 4, 5))):
            axes = [i for i in members if i in chosen]
            if len(errors) and axes:
                signal = Signal(errors.time, errors.values[:, axes])
                names = ["xyz"[i % 3] for i in axes]
                colours = [PALETTE[i % 3] for i in axes]
                groups.append(Group(signal, names, f"{name} {what}", unit, colours))
    if not groups:
        return None
    what = (
        "Goal minus pose, in the world frame, for the components under control; attitude as the "
        "remaining rotation vector"
    )
    return time_plate(flight, "errors", "Output errors", what, groups)


def pose_errors(pose: Signal, targets: Sequence[Target]) -> Signal:
    """Return the goal minus poses (N, 7) while there is one: position, rotation vector (M, 6)."""
    times, values = [np.empty(0)], [np.empty((0, 6))]
    for target in targets:
        part = pose.between(target.start, target.end)
        if len(part):
            inverse = quaternion_inverse(part.values[:, 3:])
            turn = quaternion_multiply(target.goal.quaternion, inverse)
            left = target.goal.position - part.values[:, :3]
            times.append(part.time)
            values.append(np.hstack([left, rotvecs_from_quaternions(turn)]))
    return Signal(np.concatenate(times), np.concatenate(values))


def sensors_plate(flight: Flight) -> Plate | None:
    """How far measured poses and joints are from what they were; None where sensors do not err."""
    true = Signal(flight.position.time, np.hstack([flight.position.values, flight.quaternion]))
    pose, at = _at_the_same_times(flight.sensed_pose, true)
    turn = quaternion_multiply(pose.values[:, 3:], quaternion_inverse(true.values[at, 3:]))
    offset = pose.values[:, :3] - true.values[at, :3]
    errors = Signal(pose.time, np.hstack([offset, rotvecs_from_quaternions(turn)]))
    groups = axis_groups(errors, (("base position", "m"), ("base attitude", "rad")))
    shape, at = _at_the_same_times(flight.sensed_shape, flight.shape)
    if len(shape):
        bent = Signal(shape.time, shape.values - flight.shape.values[at])
        units = {"m": "m", "rad": "rad"}
        groups += joint_groups(flight, bent, "joints", units, lambda joint: [], JOINTS_A_PANEL)
    groups = [g for g in groups if np.abs(g.signal.values).max(initial=0.0) > _SMALLEST_ERROR]
    if not groups:
        return None
    what = "Measured minus true, at the stamps of what was measured"
    return time_plate(flight, "sensors", "Errors of the sensors", what, groups)


def _at_the_same_times(measured: Signal, true: Signal) -> tuple[Signal, Indices]:
    """Return the samples that have a true one of their time, and which that is."""
    if not len(true):
        return Signal.none(measured.width), np.zeros(0, int)
    at = np.clip(np.searchsorted(true.time, measured.time - 1e-9), 0, len(true) - 1)
    same = np.abs(true.time[at] - measured.time) < 1e-9
    return Signal(measured.time[same], measured.values[same]), at[same]
