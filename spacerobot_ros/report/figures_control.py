"""Figures of controlled flight: output errors, velocity of the base, wrench and joint efforts.

Each function returns a plate, or None where the flight is of another kind.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from spacerobot_ros.model.rotations import (
    quaternion_inverse,
    quaternion_multiply,
    rotvecs_from_quaternions,
)
from spacerobot_ros.report.figures import Group, joint_unit, time_plate
from spacerobot_ros.report.flight import Flight, Target
from spacerobot_ros.report.signals import Signal
from spacerobot_ros.report.style import PALETTE, Plate, colour, short

_SMALLEST = 1e-9
"""Forces and torques that are rounding errors, N or N m."""


def errors_plate(flight: Flight) -> Plate | None:
    """Goal minus measured pose of base and end-effector, in the components under control."""
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
        "Goal minus measured, in the world frame, for the components under control; attitude as "
        "the rotation vector that is left"
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


def twist_plate(flight: Flight) -> Plate | None:
    """Velocity and angular velocity of the base link.

    None where it rests, and of a gait of many equal cycles: there it shakes.
    """
    if flight.cycles is not None or not flight.twist.values.any():
        return None
    groups = []
    for label, unit, columns in (("velocity", "m/s", slice(0, 3)), ("rate", "rad/s", slice(3, 6))):
        signal = Signal(flight.twist.time, flight.twist.values[:, columns])
        groups.append(Group(signal, list("xyz"), label, unit, PALETTE[:3]))
    what = "Velocity of the base link's origin and its angular velocity, in the base link's frame"
    return time_plate(flight, "twist", "Base velocity", what, groups)


def efforts_plate(flight: Flight) -> Plate | None:
    """Commanded thruster wrench and joint efforts."""
    groups = []
    for label, unit, columns in (("force", "N", slice(0, 3)), ("torque", "N m", slice(3, 6))):
        signal = Signal(flight.wrench.time, flight.wrench.values[:, columns])
        if np.abs(signal.values).max(initial=0.0) > _SMALLEST:
            groups.append(Group(signal, list("xyz"), f"thruster {label}", unit, PALETTE[:3]))
    if np.abs(flight.efforts.values).max(initial=0.0) > _SMALLEST:
        groups += _joint_groups(flight)
    if not groups:
        return None
    what = (
        "What was commanded: thruster force and torque at the base link's origin, in its frame, "
        "and the efforts of the joints"
    )
    if not any(group.label.startswith("thruster") for group in groups):
        what = "Commanded efforts of the joints; the thrusters gave nothing"
    return time_plate(flight, "efforts", "Wrench and efforts", what, groups)


def _joint_groups(flight: Flight) -> list[Group]:
    """Joint efforts, forces and torques apart, with the limits of the URDF."""
    units = {"m": "N", "rad": "N m"}
    kinds = [units.get(joint_unit(flight, name), "N or N m") for name in flight.joint_names]
    groups = []
    for unit in dict.fromkeys(kinds):
        members = [i for i, kind in enumerate(kinds) if kind == unit]
        names = [flight.joint_names[i] for i in members]
        limits = [
            (k, sign * joint.limits.effort)
            for k, name in enumerate(names)
            if (joint := flight.joint(name)) is not None and np.isfinite(joint.limits.effort)
            for sign in (-1.0, 1.0)
        ]
        signal = Signal(flight.efforts.time, flight.efforts.values[:, members])
        colours = [colour(i) for i in members]
        groups.append(
            Group(signal, [short(name) for name in names], "joints", unit, colours, limits=limits)
        )
    return groups
