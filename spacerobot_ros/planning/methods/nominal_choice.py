"""Which three joints of a robot go round which nominal shape: as given, or the best there is."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.planning.core.controllability import WORST_CONDITION
from spacerobot_ros.planning.methods.nominal_shape import NominalShape, best_nominal, given_nominal

_NO_ROOM = 1e-4
"""Edges shorter than this, m or rad, are none."""

_SAME_SHAPE = 1e-3
"""Joints that are held may be this far from where they were, m or rad."""


class NominalChoice:
    """The nominal shapes of one robot.

    Parameters
    ----------
    robot
        The model.
    largest_edge
        Longest edge of a loop, m or rad.
    joints
        Names of the three joints, separated by spaces; empty: the best three.
    nominal
        The shape (n,), m or rad; empty: the best one.

    Raises
    ------
    ParameterError
        ``joints`` does not name three joints, or ``nominal`` is no shape of the robot.
    """

    def __init__(
        self, robot: SpaceRobot, largest_edge: float, joints: str, nominal: Sequence[float]
    ) -> None:
        self._robot = robot
        self._largest_edge = largest_edge
        self._triples = _triples(robot, joints.split())
        self._given = _checked(robot, np.array(nominal, dtype=float)) if len(nominal) else None
        self._only: NominalShape | None = None
        kinds = [joint.kind for joint in robot.description.movable_joints]
        turning = np.array([kind is not JointKind.PRISMATIC for kind in kinds], dtype=bool)
        self._repeating = turning & np.isinf(robot.lower) & np.isinf(robot.upper)

    def prepare(self) -> None:
        """Choose beforehand where the choice depends on no shape: for robots with three joints."""
        if self._robot.n == 3:
            with suppress(PlanningError):
                self._only = self._choose(np.zeros(3))

    def at(self, q: Array, kept: NominalShape | None = None) -> NominalShape:
        """Return the nominal shape to use from shape ``q`` (n,).

        Of a robot with more than three joints the others rest where they are; ``kept``, an earlier
        choice, holds as long as they do.

        Raises
        ------
        PlanningError
            Limits leave no room for loops, or loops there do not turn the base about all axes.
        """
        if self._only is not None:
            return self._only
        return kept if kept is not None and self._holds(kept, q) else self._choose(q)

    def nearest_turn(self, nominal: NominalShape, q: Array) -> NominalShape:
        """Return the nominal shape with joints without limits at their turn nearest to ``q``."""
        turns = np.where(self._repeating, np.round((q - nominal.shape) / (2 * math.pi)), 0.0)
        return replace(nominal, shape=nominal.shape + 2 * math.pi * turns)

    def _holds(self, chosen: NominalShape, q: Array) -> bool:
        moved = np.abs(np.delete(q - chosen.shape, chosen.joints)).max(initial=0.0)
        return self._given is not None or bool(moved <= _SAME_SHAPE)

    def _choose(self, q: Array) -> NominalShape:
        robot = self._robot
        if not self._triples:
            raise PlanningError(
                f"area_loop needs three joints that move; robot '{robot.description.name}' has "
                f"{int(np.sum(robot.velocity_limit > 0))} with a velocity limit above zero."
            )
        if self._given is not None:
            chosen = given_nominal(robot, self._given, self._triples, self._largest_edge)
        else:
            chosen = best_nominal(robot, q, self._triples, self._largest_edge)
        names = [robot.joint_names[i] for i in chosen.joints]
        least = int(np.argmin(chosen.longest))
        if chosen.longest[least] < _NO_ROOM:
            joint = chosen.joints[least]
            raise PlanningError(
                f"The joint limits [{robot.lower[joint]:.4g}, {robot.upper[joint]:.4g}] leave "
                f"joint '{names[least]}' no room for the loops of area_loop."
            )
        largest, _, smallest = chosen.singular_values
        if not smallest * WORST_CONDITION > largest:
            raise PlanningError(
                f"The curvature matrix of joints {', '.join(names)} is singular at the nominal "
                f"shape {np.round(chosen.shape, 4).tolist()} (condition number "
                f"{chosen.condition:.2g}): loops there do not turn the base about all axes."
            )
        return chosen


def _triples(robot: SpaceRobot, names: Sequence[str]) -> list[tuple[int, int, int]]:
    """Return the triples of joints to choose from; joints without speed are no choice."""
    if not names:
        movable = np.flatnonzero(robot.velocity_limit > 0).tolist()
        return list(itertools.combinations(movable, 3))
    if len(names) != 3 or len(set(names) & set(robot.joint_names)) != 3:
        raise ParameterError(
            f"area_loop.joints is '{' '.join(names)}'; it must name three of the joints "
            f"{', '.join(robot.joint_names)}."
        )
    i, j, k = (robot.joint_names.index(name) for name in names)
    return [(i, j, k)]


def _checked(robot: SpaceRobot, shape: Array) -> Array:
    if len(shape) != robot.n:
        raise ParameterError(
            f"area_loop.nominal has {len(shape)} number(s); robot '{robot.description.name}' has "
            f"{robot.n} joints."
        )
    outside = np.flatnonzero((shape < robot.lower) | (shape > robot.upper))
    if outside.size:
        i = int(outside[0])
        raise ParameterError(
            f"area_loop.nominal has joint '{robot.joint_names[i]}' at {shape[i]:.4g}, and its "
            f"limits are [{robot.lower[i]:.4g}, {robot.upper[i]:.4g}]."
        )
    return shape
