"""Closed paths along joint axes that enclose given areas (paper 2, figure 5).

Three joints, their planes in the order (1, 2), (2, 3), (3, 1); an area is positive where the path
goes round counter-clockwise. All three at once are enclosed by six edges of a box, one by one by a
rectangle each.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model.description import Array

PLANES = ((0, 1), (1, 2), (2, 0))
"""The planes of the three areas."""

_NEGLIGIBLE = 1e-3
"""An area below this share of the largest counts as zero: a later cycle makes up for it."""


@dataclass(frozen=True)
class EdgePath:
    """Closed polygons, to be gone round one after the other.

    Attributes
    ----------
    loops
        Each (V, 3): the vertices in the order of travel, the first again at the end; the middle of
        the box that holds them is the origin.
    excess
        By how much the longest edge is too long; 1: as long as it may be.
    """

    loops: tuple[Array, ...]
    excess: float

    @property
    def kind(self) -> str:
        """``cube``, ``rectangles`` or ``nothing``."""
        if not self.loops:
            return "nothing"
        return "cube" if len(self.loops[0]) == 7 else "rectangles"


def edge_path(areas: Array, longest: Array) -> EdgePath:
    """Return the path that encloses ``areas`` (3,), its edges at most ``longest`` (3,) if possible.

    The cube-like path is taken where its edges are short enough, or shorter than those of
    rectangles. Areas that are too large give a path with ``excess`` over 1: edges go as the root
    of the areas.
    """
    areas = np.where(np.abs(areas) > _NEGLIGIBLE * np.abs(areas).max(), areas, 0.0)
    rectangles = _rectangles(areas, longest)
    if np.all(areas != 0.0):
        cube = _cube(areas, longest)
        if cube.excess <= max(1.0, rectangles.excess):
            return cube
    return rectangles


def cube_edges(areas: Array) -> tuple[Array, bool]:
    """Return the edges ``d`` (3,) of the box, and whether its path is gone backwards.

    Edges +d1, +d2, +d3, -d1, -d2, -d3 have the projected areas (d1 d2, d2 d3, -d1 d3); backwards
    these change sign. No area may be zero.
    """
    S12, S23, S31 = areas
    # The product of the projected areas is -(d1 d2 d3)^2.
    backwards = bool(S12 * S23 * S31 > 0)
    sense = -1.0 if backwards else 1.0
    d1 = np.sqrt(abs(S12)) * np.sqrt(abs(S31 / S23))
    d2 = sense * S12 / d1
    return np.array([d1, d2, sense * S23 / d2]), backwards


def _cube(areas: Array, longest: Array) -> EdgePath:
    d, backwards = cube_edges(areas)
    corners = np.vstack([np.zeros(3), np.cumsum(np.vstack([np.diag(d), -np.diag(d)]), axis=0)])
    corners[-1] = 0.0
    loop = corners - d / 2
    excess = float(np.max(np.abs(d) / longest))
    return EdgePath((loop[::-1] if backwards else loop,), excess)


def _rectangles(areas: Array, longest: Array) -> EdgePath:
    loops, excess = [], 0.0
    for area, (i, j) in zip(areas, PLANES, strict=True):
        if area == 0.0:
            continue
        # Both edges take the same share of what they may be.
        share = np.sqrt(abs(area) / (longest[i] * longest[j]))
        excess = max(excess, float(share))
        loop = np.zeros((5, 3))
        loop[:, i] = share * longest[i] * np.array([-0.5, 0.5, 0.5, -0.5, -0.5])
        loop[:, j] = share * longest[j] * np.array([-0.5, -0.5, 0.5, 0.5, -0.5])
        loops.append(loop if area > 0 else loop[::-1])
    return EdgePath(tuple(loops), excess)
