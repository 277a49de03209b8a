"""Capabilities of a robot: base rotations by joint motions, and suitable gait methods."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.errors import ParameterError, PlanningError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.controllability import (
    MAX_CONDITION,
    Controllability,
    best_sampled_brackets,
    best_triple,
    brackets_at,
    check_sliding_masses,
    curvatures,
    sample_shapes,
)
from spacerobot_ros.planning.core.workspaces import Workspaces, workspaces
from spacerobot_ros.planning.methods.auto import AutoGait
from spacerobot_ros.planning.methods.geometric_phase import check_planar_chain
from spacerobot_ros.planning.methods.nominal_shape import NominalShape, NominalShapeChooser
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.registry import METHODS

_CONDITION_SAMPLE_COUNT = 300

_LOOP_EDGE_LENGTH = 1.0
"""Loop edge length for which the nominal shape is optimised, m or rad, as in area_loop."""


@dataclass(frozen=True)
class Analysis:
    """Controllability of a robot, and the gait methods suitable for it.

    Attributes
    ----------
    robot
        The model.
    shape
        (n,) examined configuration: as given, the best nominal one, or the middle of the ranges.
    nominal
        The three nominal joints and their matrix M at this configuration; None if there are fewer
        than three joints, or if no loops rotate the base about three axes.
    at_shape, anywhere
        The span of first-order brackets at ``shape``, and at the best of many configurations.
    conditions
        (300,) condition numbers of the best three brackets, at configurations spread evenly.
    planar, sliding
        Results of the tests in papers 3 and 1.
    objections
        Reason why a method is unsuitable for the robot, by method name; None if it is suitable.
    geometry
        The robot's solids, and the pairs of solids whose distances are checked.
    end_effector
        The link whose workspaces are computed; "" if not given and the default link does not exist.
    """

    robot: SpaceRobot
    shape: Array
    nominal: NominalShape | None
    at_shape: Controllability
    anywhere: Controllability
    conditions: Array
    planar: Controllability
    sliding: Controllability
    objections: dict[str, str | None]
    geometry: CollisionGeometry
    end_effector: str = ""

    @cached_property
    def workspaces(self) -> tuple[Workspaces, ...]:
        """Workspaces of the end-effector, without and with joint limits.

        Empty if there is no end-effector or there are no joints.
        """
        if not self.end_effector or self.robot.n == 0:
            return ()
        return workspaces(self.robot, self.end_effector)

    @property
    def chosen(self) -> str:
        """Method usually chosen by ``auto``: ``optimal`` if suitable; "" if no method is."""
        suits = [
            name
            for name, objection in self.objections.items()
            if not objection and METHODS[name].plans_for_base
        ]
        return OptimalGait.name if OptimalGait.name in suits else next(iter(suits), "")


def analyze(
    robot: SpaceRobot, shape: Sequence[float] | None = None, end_effector: str = ""
) -> Analysis:
    """Analyse a robot at a shape (n,), or at the best shape for loops.

    ``end_effector`` names the link whose workspaces are computed; "": the default one.

    Raises
    ------
    ParameterError
        The shape or the link does not belong to this robot.
    """
    link = robot.description.end_effector(end_effector)
    names = [each.name for each in robot.description.links if each.name != robot.base_link]
    if link and link not in names:
        raise ParameterError(
            f"Robot '{robot.description.name}' has no link '{link}' other than its base; its links "
            f"are {', '.join(names)}."
        )
    given = None if shape is None else np.asarray(shape, dtype=float)
    if given is not None and not (given.shape == (robot.n,) and np.all(np.isfinite(given))):
        raise ParameterError(
            f"The shape has {counted(given.size, 'number')}; robot '{robot.description.name}' "
            f"needs a finite value for each joint: {', '.join(robot.joint_names)}."
        )
    anywhere = best_sampled_brackets(robot)
    nominal, loops = None, NominalShapeChooser(robot, _LOOP_EDGE_LENGTH)
    if loops.triples and anywhere.controllable:
        middle = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
        nominal = loops.best(middle) if given is None else loops.around(given)
    planar = check_planar_chain(robot)
    if given is None:
        best = planar if planar.controllable else anywhere
        given = best.shape if nominal is None else nominal.shape
    objections: dict[str, str | None] = {}
    for name, method in METHODS.items():
        try:
            method.require_suitable(robot)
            objections[name] = None
        except PlanningError as refusal:
            objections[name] = str(refusal)
    del objections[AutoGait.name]
    return Analysis(
        robot,
        given,
        nominal,
        brackets_at(robot, given),
        anywhere,
        _condition_numbers(robot),
        planar,
        check_sliding_masses(robot),
        objections,
        CollisionGeometry(robot.description),
        link,
    )


def _condition_numbers(robot: SpaceRobot) -> Array:
    if robot.n < 3:
        return np.full(_CONDITION_SAMPLE_COUNT, np.inf)
    K = curvatures(robot, sample_shapes(robot, _CONDITION_SAMPLE_COUNT))
    matrices = np.array([best_triple(at, range(robot.n))[1] for at in K])
    conditions = np.linalg.cond(matrices)
    return np.where(conditions < MAX_CONDITION, conditions, np.inf)
