"""What a planar robot is: all its joints turn about parallel axes, and nothing tilts the base."""

from __future__ import annotations

import math

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind

_OUT_OF_PLANE = 1e-5
"""Largest tilt of an axis, and turn about other axes a radian of a joint, that counts as planar:
as much as angles written with six digits leave."""

_SAMPLES = 8
"""Shapes at which a robot is asked whether it stays in its plane."""


def planar_axis(robot: SpaceRobot) -> Array:
    """Return the unit vector (3,), base components, that a planar robot of three links turns about.

    Its largest component is positive, however the joints are oriented.

    Raises
    ------
    PlanningError
        The robot has fewer than three links or is not planar; the sentence names the joint.
    """
    name, bodies = robot.description.name, robot.description.bodies
    if len(bodies) < 3:
        raise PlanningError(
            f"Robot '{name}' has {len(bodies)} link(s) that move against each other: with fewer "
            "than three, motions of the joints cannot reorient a planar robot (paper 3, section "
            "III)."
        )
    axes: list[Array] = []
    rotations = [np.eye(3)]
    for body, joint in zip(bodies[1:], robot.description.movable_joints, strict=True):
        if joint.kind is JointKind.PRISMATIC:
            raise PlanningError(
                f"Robot '{name}' is not planar in the sense of paper 3: joint '{joint.name}' "
                "slides, and all joints must turn about parallel axes."
            )
        # Joints about parallel axes leave all axes where they are: one shape tells.
        rotations.append(rotations[body.parent] @ body.origin.R)
        axes.append(rotations[-1] @ joint.axis)
        if np.linalg.norm(np.cross(axes[0], axes[-1])) > _OUT_OF_PLANE:
            raise PlanningError(
                f"Robot '{name}' is not planar: the axis of joint '{joint.name}' is not parallel "
                f"to that of joint '{robot.joint_names[0]}'."
            )
    axis = axes[0] * math.copysign(1.0, axes[0][np.argmax(np.abs(axes[0]))])
    _require_turn_about(robot, axis)
    return axis


def _require_turn_about(robot: SpaceRobot, axis: Array) -> None:
    """Refuse masses off the plane and products of inertia that tilt the base."""
    # The tilt is a ratio of trigonometric polynomials of the shape: it is zero everywhere or
    # almost nowhere, and a few shapes in general position tell which.
    shapes = np.outer(np.arange(1, _SAMPLES + 1), np.sqrt(np.arange(2, robot.n + 2)))
    A = robot.function("connection", compile=False)(shapes.T).full()[3:]
    tilts = np.linalg.norm(A - np.outer(axis, axis @ A), axis=0).reshape(_SAMPLES, robot.n)
    worst = np.unravel_index(np.argmax(tilts), tilts.shape)
    if tilts[worst] > _OUT_OF_PLANE:
        raise PlanningError(
            f"Robot '{robot.description.name}' is not planar: joint "
            f"'{robot.joint_names[worst[1]]}' also turns the base about other axes than its own, "
            f"by up to {tilts[worst]:.2g} rad a rad; mass centres outside of one plane or products "
            "of inertia do that."
        )
