"""Nominal shape for area loops: where three joints rotate the base best (paper 2).

Loops run around the nominal shape. The shape is good if the curvature matrix M is well conditioned,
rotations are large, and the joint limits leave room for loop edges. The measure is the smallest
singular value of M times the largest areas, that is, the rotation about the worst axis by the
largest loops.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.planning.core.controllability import (
    MAX_CONDITION,
    curvature_matrices,
    curvatures,
    sample_shapes,
)
from spacerobot_ros.planning.methods.optimal.problem import per_joint

JOINT_PLANES = ((0, 1), (1, 2), (2, 0))
"""The planes of three joints in which loops enclose areas."""

_GRID_POINTS = {1: 11, 2: 7}
"""Points per joint in the first grid, by number of triples; 5 for more triples."""

_MAX_TRIPLES, _SAMPLED_SHAPE_COUNT = 8, 48
"""Largest number of joint triples to examine closely, and of shapes at which triples are chosen."""

_GRID_REFINEMENTS = 10
_EQUAL_MEASURE_TOLERANCE = 1e-6
"""Relative difference between equally good shapes; the most central one is chosen."""

_MIN_EDGE = 1e-4  # m or rad

_HELD_JOINT_TOLERANCE = 1e-3
"""Motion of held joints up to which a chosen nominal shape still applies, m or rad."""

_NEIGHBOUR_OFFSETS = np.array(list(itertools.product((0.0, -1.0, 1.0), repeat=3)))

_BOX_SHARES = (1.0, 0.5, 0.25, 0.125)
"""Edges of the boxes in which links keep the clearance, as fractions of the longest loop edges."""

_BOX_GRID_POINTS = 7

_MAX_BOXES = 300

Triple = tuple[int, int, int]

ClearanceTest = Callable[[Array], bool]
"""Whether links keep the clearance at all shapes (N, n)."""

LoopRoomTest = Callable[[Array], npt.NDArray[np.bool_]]
"""Whether links have room to move, (N,), at each of the shapes (N, n)."""


@dataclass(frozen=True)
class NominalShape:
    """A shape, and the three joints whose loops run around it.

    Attributes
    ----------
    shape
        (n,), m or rad.
    joints
        Indices of the three joints.
    M
        (3, 3) base rotation, rad, in the base frame, per area of the pairs (1, 2), (2, 3), (3, 1).
    longest
        (3,) longest edges that fit within the joint limits, m or rad.
    """

    shape: Array
    joints: Triple
    M: Array
    longest: Array

    @property
    def singular_values(self) -> Array:
        """(3,) singular values of M, descending."""
        return np.asarray(np.linalg.svd(self.M, compute_uv=False))

    @property
    def condition(self) -> float:
        """Condition number of M."""
        return float(np.linalg.cond(self.M))


class NominalShapeChooser:
    """Chooses nominal shapes for a robot, and the three joints of loops around them.

    Parameters
    ----------
    robot
        The model.
    largest_edge
        Longest edge of a loop, m or rad.
    joints
        Names of the three joints, separated by spaces; empty: the best three.
    nominal
        The nominal shape (n,), m or rad; empty: the best shape.
    is_roomy
        Returns, for each shape (N, n), whether links have room to move (N,); None: everywhere.

    Attributes
    ----------
    triples
        Triples of joints to choose from, without joints of zero velocity limit.

    Raises
    ------
    ParameterError
        ``joints`` does not name three joints, or ``nominal`` is not a valid shape.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        largest_edge: float,
        joints: str = "",
        nominal: Sequence[float] = (),
        is_roomy: LoopRoomTest | None = None,
    ) -> None:
        self._robot, self._largest_edge, self._is_roomy = robot, largest_edge, is_roomy
        self.triples = _list_triples(robot, joints.split())
        self._given_shape = _nominal_shape(robot, nominal) if len(nominal) else None
        kinds = [joint.kind for joint in robot.description.movable_joints]
        turning = np.array([kind is not JointKind.PRISMATIC for kind in kinds], dtype=bool)
        self._repeating = turning & np.isinf(robot.lower) & np.isinf(robot.upper)

    def at(self, q: Array, kept: NominalShape | None = None) -> NominalShape:
        """Return the nominal shape to use when starting from shape ``q`` (n,).

        The other joints rest; ``kept``, an earlier choice, is returned unless they have moved.

        Raises
        ------
        PlanningError
            Joint limits leave no room for loops, or loops do not rotate the base about all axes.
        """
        if kept is not None:
            moved = np.abs(np.delete(q - kept.shape, kept.joints)).max(initial=0.0)
            if self._given_shape is not None or moved <= _HELD_JOINT_TOLERANCE:
                return kept
        robot = self._robot
        if not self.triples:
            raise PlanningError(
                f"area_loop needs three moving joints; robot '{robot.description.name}' has "
                f"{int(np.sum(robot.velocity_limit > 0))} with a velocity limit above zero."
            )
        chosen = self.best(q) if self._given_shape is None else self.around(self._given_shape)
        names = [robot.joint_names[i] for i in chosen.joints]
        least = int(np.argmin(chosen.longest))
        if chosen.longest[least] < _MIN_EDGE:
            joint = chosen.joints[least]
            raise PlanningError(
                f"The joint limits [{robot.lower[joint]:.4g}, {robot.upper[joint]:.4g}] leave "
                f"joint '{names[least]}' no room for the loops of area_loop."
            )
        largest, _, smallest = chosen.singular_values
        if not smallest * MAX_CONDITION > largest:
            raise PlanningError(
                f"The curvature matrix of joints {', '.join(names)} is singular at the nominal "
                f"shape {np.round(chosen.shape, 4).tolist()} (condition number "
                f"{chosen.condition:.2g}): loops around this shape do not rotate the base about "
                f"all axes."
            )
        return chosen

    def move_to_nearest_turn(self, nominal: NominalShape, q: Array) -> NominalShape:
        """Return the nominal shape with unlimited joints moved close to ``q``, by whole turns."""
        turns = np.where(self._repeating, np.round((q - nominal.shape) / (2 * math.pi)), 0.0)
        return replace(nominal, shape=nominal.shape + 2 * math.pi * turns)

    def around(self, shape: Array) -> NominalShape:
        """Return a given shape (n,) with the best joint triple.

        Boxes that do not fit around it are shifted into the limits; see :class:`NominalShape`.
        """
        K = curvatures(self._robot, shape[np.newaxis])[0]
        width = np.minimum(self._largest_edge, self._robot.upper - self._robot.lower)
        return _best(
            NominalShape(shape, triple, curvature_matrices(K, triple), width[list(triple)])
            for triple in self.triples
        )

    def best(self, held: Array) -> NominalShape:
        """Return the best nominal shape over all triples; other joints are as in ``held`` (n,).

        Boxes with the longest edges fit within the limits. Links have room there, if at any shape.
        """
        triples = self._best_triples()
        points = _GRID_POINTS.get(len(triples), 5)
        return _best(self._best_of_triple(held, triple, points) for triple in triples)

    def shapes_with_more_room(self, held: Array, is_clear: ClearanceTest) -> Iterator[NominalShape]:
        """Yield other nominal shapes, around which loops have room; see :meth:`with_clearance`.

        The edges of the first box are as long as loop edges may be, those of the next box half as
        long, and so on. Nothing is yielded if the user has specified the nominal shape.
        """
        if self._given_shape is None:
            found = (self.with_clearance(held, share, is_clear) for share in _BOX_SHARES)
            yield from (each for each in found if each is not None)

    def with_clearance(
        self, held: Array, share: float, is_clear: ClearanceTest
    ) -> NominalShape | None:
        """Return the best nominal shape on a grid at which links keep the clearance, or None.

        Links keep the clearance in a box around the shape. The box edges are a fraction of the
        longest edges, and bound the loop edges. Other joints are as in ``held`` (n,).
        """
        ranked: list[tuple[float, NominalShape]] = []
        for triple in self._best_triples():
            at = _grid(*self._box(triple), _BOX_GRID_POINTS)
            shapes, matrices, longest = self._loops_at(held, triple, at)
            edges = share * longest
            turns = _worst_axis_turn(matrices, edges).tolist()
            ranked += [
                (turn, NominalShape(shape, triple, M, box))
                for turn, shape, M, box in zip(turns, shapes, matrices, edges, strict=True)
            ]
        ranked.sort(key=lambda each: -each[0])
        for turn, nominal in ranked[:_MAX_BOXES]:
            too_small = turn <= 0.0 or nominal.longest.min() < _MIN_EDGE
            if too_small or nominal.condition >= MAX_CONDITION:
                continue
            corners = np.tile(nominal.shape, (len(_NEIGHBOUR_OFFSETS), 1))
            corners[:, list(nominal.joints)] += 0.5 * nominal.longest * _NEIGHBOUR_OFFSETS
            if is_clear(corners):
                return nominal
        return None

    def _best_triples(self) -> Sequence[Triple]:
        robot = self._robot
        if len(self.triples) <= _MAX_TRIPLES:
            return self.triples
        shapes = sample_shapes(robot, _SAMPLED_SHAPE_COUNT)
        K = curvatures(robot, shapes)

        def best(triple: Triple) -> float:
            longest = self._centred_edges(triple, shapes[:, list(triple)])
            return float(_worst_axis_turn(curvature_matrices(K, triple), longest).max())

        return sorted(self.triples, key=best, reverse=True)[:_MAX_TRIPLES]

    def _best_of_triple(self, held: Array, triple: Triple, points: int) -> NominalShape:
        lower, upper = self._box(triple)
        step, at = (upper - lower) / (points - 1), _grid(lower, upper, points)
        for _ in range(_GRID_REFINEMENTS):
            shapes, matrices, longest = self._loops_at(held, triple, at)
            measures = _worst_axis_turn(matrices, longest)
            if self._is_roomy is not None:
                roomy = self._is_roomy(shapes)
                if roomy.any():
                    measures = np.where(roomy, measures, 0.0)
            # Of equally good shapes, the most central one.
            good = np.flatnonzero(measures >= (1 - _EQUAL_MEASURE_TOLERANCE) * measures.max())
            off_centre = np.linalg.norm(at[good] - (lower + upper) / 2, axis=1)
            best = int(good[np.argmin(off_centre)])
            step = step / 2
            at = np.clip(at[best] + step * _NEIGHBOUR_OFFSETS, lower, upper)
        # The search ends with the best point in the centre of its neighbourhood.
        shape = held.copy()
        shape[list(triple)] = at[0]
        return NominalShape(shape, triple, matrices[best], longest[best])

    def _box(self, triple: Triple) -> tuple[Array, Array]:
        lower, upper = self._robot.description.shape_box
        return lower[list(triple)], upper[list(triple)]

    def _loops_at(self, held: Array, triple: Triple, at: Array) -> tuple[Array, Array, Array]:
        """Return shapes (N, n) with joints ``at`` (N, 3), M (N, 3, 3) and longest edges (N, 3)."""
        shapes = np.tile(held, (len(at), 1))
        shapes[:, list(triple)] = at
        M = curvature_matrices(curvatures(self._robot, shapes), triple)
        return shapes, M, self._centred_edges(triple, at)

    def _centred_edges(self, triple: Triple, at: Array) -> Array:
        """Return the longest edges (N, 3) of boxes around points (N, 3) within joint limits."""
        chosen = list(triple)
        room = np.minimum(at - self._robot.lower[chosen], self._robot.upper[chosen] - at)
        return np.clip(2 * room, 0.0, self._largest_edge)


def _best(candidates: Iterable[NominalShape]) -> NominalShape:
    return max(candidates, key=lambda each: float(_worst_axis_turn(each.M, each.longest)))


def _grid(lower: Array, upper: Array, points: int) -> Array:
    """Return the points (points^3, 3) of a grid over a box."""
    axes = [np.linspace(low, high, points) for low, high in zip(lower, upper, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _worst_axis_turn(M: Array, longest: Array) -> Array:
    """Return the base rotation (...) about the worst axis by the largest loops, rad."""
    areas = np.stack([longest[..., i] * longest[..., j] for i, j in JOINT_PLANES], axis=-1)
    return np.asarray(np.linalg.svd(M * areas[..., np.newaxis, :], compute_uv=False)[..., 2])


def _list_triples(robot: SpaceRobot, names: Sequence[str]) -> list[Triple]:
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


def _nominal_shape(robot: SpaceRobot, values: Sequence[float]) -> Array:
    shape = per_joint(robot, "nominal", values, np.zeros(robot.n), "area_loop")
    outside = np.flatnonzero((shape < robot.lower) | (shape > robot.upper))
    if outside.size:
        i = int(outside[0])
        raise ParameterError(
            f"area_loop.nominal has joint '{robot.joint_names[i]}' at {shape[i]:.4g}, but its "
            f"limits are [{robot.lower[i]:.4g}, {robot.upper[i]:.4g}]."
        )
    return shape
