"""What a robot can do by moving its joints: its parts, what loops turn, which methods suit it."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.planning import METHODS
from spacerobot_ros.planning.core.controllability import (
    Controllability,
    brackets_anywhere,
    brackets_at,
    curvatures,
    planar_chain,
    sample_shapes,
    sliders_of,
    sliding_masses,
)
from spacerobot_ros.planning.methods.auto import AutoGait
from spacerobot_ros.planning.methods.nominal_shape import NominalShape, best_nominal, given_nominal

_SHAPES = 300
"""Shapes over which conditioning is summed up."""

_EDGE = 1.0
"""Edges of the loops for which the nominal shape is the best, m or rad: those of area_loop."""

_MOST_ROWS = 12
"""Joints that are listed; of more the rest is counted."""


@dataclass(frozen=True)
class Analysis:
    """The findings about one robot.

    Attributes
    ----------
    robot
        The model.
    shape
        (n,) the shape that is looked at: as given, the best nominal one, or the middle.
    nominal
        The three joints and their M there; None with fewer than three joints, or where loops turn
        the base about fewer than three axes everywhere.
    at_shape, anywhere
        What first-order brackets span at ``shape``, and at the best of many.
    conditions
        (300,) condition numbers of the best three brackets, shapes all over the shape space.
    planar, sliding
        The tests of papers 3 and 1.
    objections
        Why each method does not suit the robot, by name; "" if it does.
    """

    robot: SpaceRobot
    shape: Array
    nominal: NominalShape | None
    at_shape: Controllability
    anywhere: Controllability
    conditions: Array
    planar: Controllability
    sliding: Controllability
    objections: dict[str, str]

    @property
    def chosen(self) -> str:
        """The method that ``auto`` tries first; "" if none suits."""
        return next((name for name, objection in self.objections.items() if not objection), "")


def analyze(robot: SpaceRobot, shape: Sequence[float] | None = None) -> Analysis:
    """Return the findings about a robot, at a shape (n,) or the best one for loops.

    Raises
    ------
    ParameterError
        The shape is none of this robot.
    """
    given = None if shape is None else _checked(robot, shape)
    anywhere = brackets_anywhere(robot)
    nominal = None
    if robot.n >= 3 and anywhere.controllable:
        triples = list(itertools.combinations(range(robot.n), 3))
        if given is None:
            middle = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
            nominal = best_nominal(robot, middle, triples, _EDGE)
        else:
            nominal = given_nominal(robot, given, triples, _EDGE)
    planar = planar_chain(robot)
    if given is None:
        best = planar if planar.controllable else anywhere
        given = best.shape if nominal is None else nominal.shape
    return Analysis(
        robot,
        given,
        nominal,
        brackets_at(robot, given),
        anywhere,
        _conditions(robot),
        planar,
        sliding_masses(robot),
        {
            name: method.objection(robot)
            for name, method in METHODS.items()
            if method is not AutoGait
        },
    )


def lines_of(found: Analysis) -> list[str]:
    """Return the findings as lines that fit a screen."""
    robot = found.robot
    base = robot.description.bodies[0].inertia.mass
    n, name = robot.n, robot.description.name
    lines = [f"{name}: {n} joint(s), {robot.total_mass:.6g} kg, of which the base {base:.6g} kg"]
    lines += _joint_rows(robot)
    lines += ["", *_rotation_lines(found)]
    lines += [f"{'position':<13}{_position(found)}", ""]
    for method, objection in found.objections.items():
        lines.append(f"{method:<13}{'no: ' + objection if objection else 'yes'}")
    lines.append(f"{'auto':<13}{found.chosen or 'no method suits this robot'}")
    return lines


def json_of(found: Analysis) -> dict[str, Any]:
    """Return the findings as what JSON can hold; infinite condition numbers and limits are null."""
    robot = found.robot
    finite = found.conditions[np.isfinite(found.conditions)]
    return {
        "robot": robot.description.name,
        "mass_kg": robot.total_mass,
        "bodies": {body.name: body.inertia.mass for body in robot.description.bodies},
        "joints": [
            {
                "name": joint.name,
                "kind": joint.kind.value,
                "lower": _number(joint.limits.lower),
                "upper": _number(joint.limits.upper),
                "velocity": _number(joint.limits.velocity),
                "effort": _number(joint.limits.effort),
            }
            for joint in robot.description.movable_joints
        ],
        "shape": found.shape.tolist(),
        "at_shape": _finding(found.at_shape),
        "anywhere": _finding(found.anywhere),
        "curvature_matrix": None if found.nominal is None else found.nominal.M.tolist(),
        "condition_over_shapes": {
            "shapes": len(found.conditions),
            "spanning": len(finite),
            "best": _number(float(np.min(found.conditions, initial=math.inf))),
            "median": _number(float(np.median(finite))) if finite.size else None,
        },
        "planar": _finding(found.planar),
        "sliding": _finding(found.sliding),
        "methods": {name: objection or None for name, objection in found.objections.items()},
        "auto": found.chosen or None,
    }


def _checked(robot: SpaceRobot, shape: Sequence[float]) -> Array:
    values = np.asarray(shape, dtype=float)
    if values.shape != (robot.n,) or not np.all(np.isfinite(values)):
        raise ParameterError(
            f"The shape has {values.size} number(s), and a finite one is wanted for each of the "
            f"{robot.n} joints of robot '{robot.description.name}': {', '.join(robot.joint_names)}."
        )
    return values


def _conditions(robot: SpaceRobot) -> Array:
    if robot.n < 3:
        return np.full(_SHAPES, np.inf)
    # The matrices of all triples at once: the best one at each shape.
    K = curvatures(robot, sample_shapes(robot, _SHAPES))
    i, j, k = np.array(list(itertools.combinations(range(robot.n), 3))).T
    M = np.stack([K[:, :, i, j], K[:, :, j, k], K[:, :, k, i]], axis=-1).transpose(0, 2, 1, 3)
    values = np.linalg.svd(M, compute_uv=False)
    inverse = (values[..., 2] / np.maximum(values[..., 0], 1e-300)).max(axis=1)
    return np.asarray(np.where(inverse > 1e-6, 1 / np.maximum(inverse, 1e-300), np.inf))


def _joint_rows(robot: SpaceRobot) -> list[str]:
    joints, bodies = robot.description.movable_joints, robot.description.bodies[1:]
    width = max([5, *(len(joint.name) for joint in joints[:_MOST_ROWS])])
    head = f"{'joint':<{width}}  {'kind':<11}{'on':<16}{'stroke':>19}{'speed':>12}{'effort':>10}"
    rows = [f"{head}{'mass':>12}"]
    for joint, body in list(zip(joints, bodies, strict=True))[:_MOST_ROWS]:
        unit, of_effort = ("m", "N") if joint.kind is JointKind.PRISMATIC else ("rad", "N m")
        limits = joint.limits
        stroke = f"{limits.lower:.4g} .. {limits.upper:.4g} {unit}"
        if math.isinf(limits.lower):
            stroke = "free"
        speed, effort = f"{limits.velocity:.3g} {unit}/s", f"{limits.effort:.4g} {of_effort}"
        rows.append(
            f"{joint.name:<{width}}  {joint.kind.value:<11}{joint.parent[:15]:<16}{stroke:>19}"
            f"{speed:>12}{effort:>10}{body.inertia.mass:>9.4g} kg"
        )
    if len(joints) > _MOST_ROWS:
        rows.append(f"and {len(joints) - _MOST_ROWS} more")
    return rows


def _rotation_lines(found: Analysis) -> list[str]:
    lines = [f"{'rotation':<13}{found.anywhere.sentence}"]
    if found.planar.controllable:
        lines = [f"{'rotation':<13}{found.planar.sentence}"]
    if found.nominal is not None:
        at, values = found.nominal, ", ".join(f"{x:.3g}" for x in found.nominal.singular_values)
        names = ", ".join(found.robot.joint_names[i] for i in at.joints)
        shape = ", ".join(f"{x:.4g}" for x in found.shape)
        lines += [
            f"{'at shape':<13}({shape}): rank {found.at_shape.rank}, condition {at.condition:.3g}",
            f"{'':<13}singular values ({values}) rad a unit of area, joints {names}",
        ]
        finite = found.conditions[np.isfinite(found.conditions)]
        lines.append(
            f"{'shape space':<13}rank 3 at {len(finite)} of {len(found.conditions)} shapes; "
            f"condition {finite.min():.3g} at best, {np.median(finite):.3g} the median"
        )
    return lines


def _position(found: Analysis) -> str:
    count = len(sliders_of(found.robot))
    if found.sliding.controllable:
        return f"{count} sliders with independent slots put the base where it is to be (paper 1)"
    return "follows from attitude and shape: the centre of mass rests"


def _finding(found: Controllability) -> dict[str, Any]:
    return {
        "controllable": found.controllable,
        "rank": found.rank,
        "wanted": found.wanted,
        "condition": _number(found.condition),
        "singular_values": found.singular_values.tolist(),
        "joints": list(found.joints),
        "shape": found.shape.tolist(),
        "sentence": found.sentence,
    }


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
