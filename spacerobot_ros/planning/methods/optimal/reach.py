"""What the joints of a robot can do to its base: along which axes they turn it, where they put it.

At zero momentum ``omega_WB_B = F(q) qdot``. Where all columns of F are along one axis the base
turns about that axis only, by an angle. Otherwise the brackets of the columns fill up the
rotations, provided that the curvature of the connection is not zero everywhere (paper 1,
section 4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.planning.core.controllability import (
    curvatures,
    sample_shapes,
    shape_box,
    sliders_of,
    slot_matrix,
    slot_objection,
)
from spacerobot_ros.planning.methods.optimal.limits import MotionLimits

_SAMPLES = 12
"""Shapes in general position at which a robot is asked what it can do."""

_NONE = 1e-7
"""Singular values below this share of the largest count as zero."""

_STILL = 1e-12
"""Turn of the base a metre or radian of the joints that is none, rad."""

_TRIES = 8
"""Shapes from which one that puts the base somewhere is looked for."""

_BEYOND = 1e-9
"""Rounding that a joint may be beyond its stroke by, m or rad."""

_ON_THE_SPOT = 1e-10
"""Distance from where the base is to be that counts as there, m."""


@dataclass(frozen=True)
class Turning:
    """How motions of the joints turn the base.

    ``axes`` (m, 3) in base components: one unit vector for a planar robot, the unit matrix where
    all attitudes can be reached, none where the joints do not turn the base or only to and fro
    along one curve of attitudes. ``moves`` says whether they turn it at all, ``loops`` whether the
    base is turned when the shape is what it was again.
    """

    axes: Array
    moves: bool
    loops: bool

    @classmethod
    def of(cls, robot: SpaceRobot) -> Turning:
        """Find out from a few shapes in general position."""
        none = np.zeros((0, 3))
        if robot.n == 0:
            return cls(none, moves=False, loops=False)
        shapes = sample_shapes(robot, _SAMPLES)
        A = robot.function("connection", compile=False)(shapes.T).full()[3:]
        U, sizes, _ = np.linalg.svd(A, full_matrices=False)
        if sizes[0] <= _STILL:
            return cls(none, moves=False, loops=False)
        loops = bool(np.abs(curvatures(robot, shapes)).max() > _NONE * sizes[0])
        if np.sum(sizes > _NONE * sizes[0]) == 1:
            axis = U[:, 0] * np.sign(U[np.argmax(np.abs(U[:, 0])), 0])
            return cls(axis[np.newaxis], moves=True, loops=loops)
        return cls(np.eye(3) if loops else none, moves=True, loops=loops)


def slides_anywhere(robot: SpaceRobot) -> bool:
    """Whether sliders can put the base anywhere: their slots are along three directions."""
    P = slot_matrix(robot, np.mean(shape_box(robot), axis=0), sliders_of(robot))
    return not slot_objection(robot, P)


def center_rate(robot: SpaceRobot, q: Array) -> Array:
    """Return ``dc/dq`` (3, n) of the centre of mass in base components: ``-A_v + c x A_omega``."""
    A = robot.connection(q)
    return np.asarray(A[:3] - np.cross(robot.center_of_mass(q), A[3:], axisb=0, axisc=0))


def shape_for_center(robot: SpaceRobot, limits: MotionLimits, start: Array, wanted: Array) -> Array:
    """Return the shape (n,), near ``start``, whose centre of mass is at ``wanted`` (3,), m, in B.

    Raises
    ------
    PlanningError
        None was found within the limits: the base cannot be where the goal wants it.
    """
    lower, upper = limits.lower, limits.upper
    # The solver wants room between its bounds.
    room = 1e-9 * (1 + np.abs(start))
    middle, half = limits.span(start)
    rng = np.random.default_rng(0)
    best, miss = start, np.inf
    for attempt in range(_TRIES):
        guess = start if attempt == 0 else middle + half * rng.uniform(-0.9, 0.9, robot.n)
        found = least_squares(
            lambda q: robot.center_of_mass(q) - wanted,
            np.clip(guess, lower, upper),
            lambda q: center_rate(robot, q),
            bounds=(lower - room, upper + room),
            xtol=1e-15,
            ftol=1e-15,
            gtol=1e-15,
        )
        q = np.clip(found.x, lower, upper)
        distance = float(np.linalg.norm(robot.center_of_mass(q) - wanted))
        if distance < miss:
            best, miss = q, distance
        if miss <= 1e-6:
            break
    found = nearest_for_center(robot, limits, best, wanted)
    if found is not None:
        return found
    raise PlanningError(_refusal(robot, limits, best, wanted))


def nearest_for_center(
    robot: SpaceRobot, limits: MotionLimits, near: Array, wanted: Array
) -> Array | None:
    """Return the shape (n,) next to ``near`` whose centre of mass is at ``wanted`` (3,) exactly."""
    q = _free_shape(robot, near, wanted)
    if np.maximum(limits.lower - q, q - limits.upper).max() > _BEYOND:
        return near if _distance(robot, near, wanted) <= _ON_THE_SPOT else None
    q = np.clip(q, limits.lower, limits.upper)
    return q if _distance(robot, q, wanted) <= _ON_THE_SPOT else None


def _free_shape(robot: SpaceRobot, near: Array, wanted: Array) -> Array:
    """Newton's way to a shape, whatever the limits."""
    q = near.copy()
    for _ in range(20):
        miss = wanted - robot.center_of_mass(q)
        if np.linalg.norm(miss) <= 1e-14:
            break
        q = q + np.linalg.lstsq(center_rate(robot, q), miss, rcond=1e-9)[0]
    return q


def _distance(robot: SpaceRobot, q: Array, wanted: Array) -> float:
    return float(np.linalg.norm(robot.center_of_mass(q) - wanted))


def _refusal(robot: SpaceRobot, limits: MotionLimits, near: Array, wanted: Array) -> str:
    free = _free_shape(robot, near, wanted)
    far = float(np.linalg.norm(free - near))
    if _distance(robot, free, wanted) <= _ON_THE_SPOT and far < 10 * np.linalg.norm(
        limits.span(near)[1]
    ):
        beyond = np.maximum(limits.lower - free, free - limits.upper)
        worst = int(np.argmax(beyond))
        joint = robot.description.movable_joints[worst]
        unit = "m" if joint.kind is JointKind.PRISMATIC else "rad"
        return (
            f"The goal is beyond stroke: it needs joint '{joint.name}' at {free[worst]:.4g} "
            f"{unit}, and optimal keeps it in [{limits.lower[worst]:.4g}, "
            f"{limits.upper[worst]:.4g}] {unit}."
        )
    return (
        "The goal position is out of reach: without thrust the centre of mass stays where it is, "
        f"and the nearest that the joints of '{robot.description.name}' were found to put the base "
        f"is {_distance(robot, near, wanted):.3g} m from it."
    )
