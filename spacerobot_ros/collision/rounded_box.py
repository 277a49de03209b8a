"""Rounded boxes, which enclose the solids of a robot, and bounds on the distances between them.

A rounded box is the set of all points within a radius of a box, its core. The core is a point for a
sphere and a line for a capsule, so one formula bounds all distances. The gap between the
projections of two convex bodies onto any direction is at most their distance, and equal to it along
the line between their nearest points. The nearest points are found by alternating projections; if
cores overlap, the depth is found along the axes of the separating axis theorem.

S. Gottschalk, M. Lin, D. Manocha, "OBBTree: a hierarchical structure for rapid interference
detection", SIGGRAPH, 1996. W. Cheney, A. Goldstein, "Proximity maps for convex sets", Proceedings
of the American Mathematical Society 10, 1959.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model.description import Array, Pose, Shape

_MAX_PROJECTIONS = 60
"""Number of alternating projections; the bound is valid after any number."""

_PARALLEL_TOLERANCE = 1e-9
"""Length of the cross product of two unit vectors below which they are considered parallel."""


@dataclass(frozen=True)
class RoundedBox:
    """All points within ``radius`` (m) of a box.

    Attributes
    ----------
    pose
        Pose of the box in its link frame: origin at the centre, axes along the edges.
    half
        (3,) half edge lengths of the core, m.
    radius
        m.
    """

    pose: Pose
    half: Array
    radius: float = 0.0

    @property
    def bounding_radius(self) -> float:
        """Radius of the bounding sphere around the centre of the box, m."""
        return float(np.linalg.norm(self.half)) + self.radius

    @property
    def volume(self) -> float:
        """m^3 (Steiner's formula)."""
        a, b, c = 2 * self.half
        r = self.radius
        faces = 2 * (a * b + b * c + c * a) * r
        edges = math.pi * r**2 * (a + b + c)
        return float(a * b * c + faces + edges + 4 / 3 * math.pi * r**3)

    @classmethod
    def around(cls, shape: Shape, vertices: Array | None = None) -> RoundedBox:
        """Return the smaller of two rounded boxes that enclose a shape.

        ``vertices`` (V, 3), m, are mesh vertices in the link frame.
        """
        match shape.kind:
            case "sphere":
                return cls(shape.pose, np.zeros(3), shape.size[0])
            case "box":
                return cls(shape.pose, np.array(shape.size) / 2)
            case "cylinder":
                radius, length = shape.size
                capsule = cls(shape.pose, np.array([0.0, 0.0, length / 2]), radius)
                box = cls(shape.pose, np.array([radius, radius, length / 2]))
                return min(capsule, box, key=lambda each: each.volume)
            case "capsule":
                radius, length = shape.size
                return cls(shape.pose, np.array([0.0, 0.0, length / 2]), radius)
            case _:
                assert vertices is not None
                return _around_points(vertices, shape.pose.R)


def _around_points(points: Array, R: Array) -> RoundedBox:
    """Return the smallest of boxes along the axes ``R`` or the principal axes, and a capsule."""
    principal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2].T
    if np.linalg.det(principal) < 0:
        principal = -principal
    found = []
    for axes in (R, principal):
        local = points @ axes
        low, high = local.min(axis=0), local.max(axis=0)
        middle, half = (low + high) / 2, (high - low) / 2
        found.append(RoundedBox(Pose(axes, axes @ middle), half))
        longest = int(np.argmax(half))
        across = np.delete(local - middle, longest, axis=1)
        radius = float(np.linalg.norm(across, axis=1).max())
        found.append(RoundedBox(found[-1].pose, half * (np.arange(3) == longest), radius))
    return min(found, key=lambda each: each.volume)


def support(box: RoundedBox, R: Array, directions: Array) -> Array:
    """Return the points (N, 3) of a box, rotated by R, that lie farthest in directions (N, 3)."""
    axes = R @ box.pose.R
    corner = box.half * np.sign(np.round(np.einsum("nba,nb->na", axes, directions), 9))
    of_core = np.einsum("nab,nb->na", axes, corner)
    return np.asarray(R @ box.pose.r + of_core + box.radius * directions)


def widest_gaps(
    first: RoundedBox, R_1: Array, r_1: Array, second: RoundedBox, R_2: Array, r_2: Array
) -> tuple[Array, Array]:
    """Return lower bounds (N,) on the distances between two rounded boxes, m (negative: penetration
    depths), and the directions (N, 3) that attain them, from first to second.

    Parameters
    ----------
    first, second
        The rounded boxes, in their link frames.
    R_1, r_1, R_2, r_2
        Poses of these link frames in a common frame: attitudes (N, 3, 3), and positions (N, 3), m.
    """
    c_1, c_2 = r_1 + R_1 @ first.pose.r, r_2 + R_2 @ second.pose.r
    A, B = R_1 @ first.pose.R, R_2 @ second.pose.R
    radii = first.radius + second.radius
    between = c_2 - c_1
    edges = np.cross(A[:, :, :, np.newaxis], B[:, :, np.newaxis, :], axis=1).reshape(-1, 3, 9)
    lengths = np.linalg.norm(edges, axis=1, keepdims=True)
    parallel = lengths[:, 0] < _PARALLEL_TOLERANCE
    edges = edges / np.where(lengths < _PARALLEL_TOLERANCE, 1.0, lengths)
    axes = np.concatenate([A, B, edges], axis=2)

    def gaps(directions: Array) -> Array:
        """Return the gaps (N, k) of the boxes projected onto unit vectors (N, 3, k)."""
        apart = np.abs(np.einsum("na,nak->nk", between, directions))
        for R, half in ((A, first.half), (B, second.half)):
            apart = apart - np.einsum("a,nak->nk", half, np.abs(np.swapaxes(R, 1, 2) @ directions))
        return np.asarray(apart)

    found = gaps(axes)
    found[:, 6:][parallel] = -np.inf
    widest = found.argmax(axis=1)
    rows = np.arange(len(found))
    best, directions = found[rows, widest], axes[rows, :, widest]
    apart = best > 0
    if apart.any():
        x, y = _nearest_points(c_1, A, c_2, B, first.half, second.half)
        nearest = (y - x) / np.maximum(np.linalg.norm(y - x, axis=1, keepdims=True), 1e-300)
        cores = np.where(apart, gaps(nearest[:, :, np.newaxis])[:, 0], -np.inf)
        directions = np.where((cores > best)[:, np.newaxis], nearest, directions)
        best = np.maximum(best, cores)
    toward = np.where(np.einsum("na,na->n", between, directions) < 0, -1.0, 1.0)
    return np.asarray(best - radii), directions * toward[:, np.newaxis]


def nearest_points(
    first: RoundedBox, R_1: Array, r_1: Array, second: RoundedBox, R_2: Array, r_2: Array
) -> Array:
    """Return the points (N, 3) on the second core that are approximately nearest to the first box.

    Parameters are as in :func:`widest_gaps`.
    """
    c_1, c_2 = r_1 + R_1 @ first.pose.r, r_2 + R_2 @ second.pose.r
    cores = R_1 @ first.pose.R, R_2 @ second.pose.R
    return _nearest_points(c_1, cores[0], c_2, cores[1], first.half, second.half)[1]


def _nearest_points(
    c_1: Array, A: Array, c_2: Array, B: Array, a: Array, b: Array
) -> tuple[Array, Array]:
    """Return approximately the nearest points (N, 3) of two boxes, by alternating projections."""
    x, y = c_1, c_2
    for _ in range(_MAX_PROJECTIONS):
        x = _projected(y, c_1, A, a)
        y = _projected(x, c_2, B, b)
    return x, y


def _projected(points: Array, c: Array, R: Array, half: Array) -> Array:
    local = np.clip(np.einsum("nba,nb->na", R, points - c), -half, half)
    return np.asarray(c + np.einsum("nab,nb->na", R, local))
