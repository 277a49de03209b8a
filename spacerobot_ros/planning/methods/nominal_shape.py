"""The nominal shape of the area loops: where three joints turn the base best (paper 2).

Loops go round the nominal shape. It is good where the curvature matrix M is well conditioned,
turns are large, and limits leave room for edges: the measure is the smallest singular value of M
times the largest areas, the turn about the worst axis by loops as large as they may be.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.core.controllability import (
    curvature_matrices,
    curvatures,
    sample_shapes,
    shape_box,
)
from spacerobot_ros.planning.methods.edge_path import PLANES

_GRID = {1: 11, 2: 7}
"""Points a joint of the first grid, by the number of triples; 5 with more."""

_MOST_TRIPLES, _SAMPLES = 8, 48
"""Of more triples of joints the best of these are looked at closely: at so many shapes."""

_REFINEMENTS = 10
_EQUAL = 1e-6
"""Shapes whose measures differ by less than this share are equally good; the middle one wins."""

_AROUND = np.array(list(itertools.product((0.0, -1.0, 1.0), repeat=3)))


@dataclass(frozen=True)
class NominalShape:
    """A shape with the three joints that go round it.

    Attributes
    ----------
    shape
        (n,), m or rad.
    joints
        Indices of the three.
    M
        (3, 3) turn of the base, rad, base components, per area of the pairs (1, 2), (2, 3), (3, 1).
    longest
        (3,) longest edges that fit into the joint limits, m or rad.
    """

    shape: Array
    joints: tuple[int, int, int]
    M: Array
    longest: Array

    @property
    def singular_values(self) -> Array:
        """(3,) of M, descending."""
        return np.asarray(np.linalg.svd(self.M, compute_uv=False))

    @property
    def condition(self) -> float:
        """Condition number of M."""
        return float(np.linalg.cond(self.M))


def given_nominal(
    robot: SpaceRobot, shape: Array, triples: Sequence[tuple[int, int, int]], largest_edge: float
) -> NominalShape:
    """Return a given shape (n,) with the best of the triples of joints.

    Boxes that do not fit round it are moved into the limits; see :class:`NominalShape`.
    """
    K = curvatures(robot, shape[np.newaxis])[0]
    lower, upper = robot.lower, robot.upper
    candidates = []
    for triple in triples:
        longest = np.minimum(largest_edge, (upper - lower)[list(triple)])
        candidates.append(NominalShape(shape, triple, curvature_matrices(K, triple), longest))
    return max(candidates, key=lambda nominal: float(_measure(nominal.M, nominal.longest)))


def best_nominal(
    robot: SpaceRobot, held: Array, triples: Sequence[tuple[int, int, int]], largest_edge: float
) -> NominalShape:
    """Return the best nominal shape of any of the triples; other joints stay as in ``held`` (n,).

    Boxes of the longest edges fit round it into the limits.
    """
    triples = _promising(robot, triples, largest_edge)
    points = _GRID.get(len(triples), 5)
    return max(
        (_best_of(robot, held, triple, largest_edge, points) for triple in triples),
        key=lambda nominal: float(_measure(nominal.M, nominal.longest)),
    )


def _promising(
    robot: SpaceRobot, triples: Sequence[tuple[int, int, int]], largest_edge: float
) -> Sequence[tuple[int, int, int]]:
    """Return the triples of joints that are best somewhere in the shape space."""
    if len(triples) <= _MOST_TRIPLES:
        return triples
    shapes = sample_shapes(robot, _SAMPLES)
    K = curvatures(robot, shapes)

    def best(triple: tuple[int, int, int]) -> float:
        longest = _centred_edges(robot, list(triple), shapes[:, list(triple)], largest_edge)
        return float(_measure(curvature_matrices(K, triple), longest).max())

    return sorted(triples, key=best, reverse=True)[:_MOST_TRIPLES]


def _best_of(
    robot: SpaceRobot, held: Array, triple: tuple[int, int, int], largest_edge: float, points: int
) -> NominalShape:
    chosen = list(triple)
    lower, upper = (bound[chosen] for bound in shape_box(robot))
    step = (upper - lower) / (points - 1)
    axes = [np.linspace(low, high, points) for low, high in zip(lower, upper, strict=True)]
    at = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    for _ in range(_REFINEMENTS):
        matrices, longest = _at(robot, held, chosen, at, largest_edge)
        best = _most_central(at, _measure(matrices, longest), (lower + upper) / 2)
        step = step / 2
        at = np.clip(at[best] + step * _AROUND, lower, upper)
    # The centre of the last neighbourhood is what was best.
    shape = held.copy()
    shape[chosen] = at[0]
    return NominalShape(shape, triple, matrices[best], longest[best])


def _at(
    robot: SpaceRobot, held: Array, chosen: list[int], at: Array, largest_edge: float
) -> tuple[Array, Array]:
    """Return M (N, 3, 3) and the longest centred edges (N, 3) with three joints at (N, 3)."""
    shapes = np.tile(held, (len(at), 1))
    shapes[:, chosen] = at
    M = curvature_matrices(curvatures(robot, shapes), chosen)
    return M, _centred_edges(robot, chosen, at, largest_edge)


def _centred_edges(robot: SpaceRobot, chosen: list[int], at: Array, largest_edge: float) -> Array:
    """Return the longest edges (N, 3) of boxes round (N, 3) that the limits leave room for."""
    room = np.minimum(at - robot.lower[chosen], robot.upper[chosen] - at)
    return np.clip(2 * room, 0.0, largest_edge)


def _measure(M: Array, longest: Array) -> Array:
    """Return the turn (...) about the worst axis by the largest loops, rad."""
    areas = np.stack([longest[..., i] * longest[..., j] for i, j in PLANES], axis=-1)
    return np.asarray(np.linalg.svd(M * areas[..., np.newaxis, :], compute_uv=False)[..., 2])


def _most_central(at: Array, measures: Array, middle: Array) -> int:
    good = np.flatnonzero(measures >= (1 - _EQUAL) * measures.max())
    return int(good[np.argmin(np.linalg.norm(at[good] - middle, axis=1))])
