"""Where in the plane of two joints the curvature is largest (paper 3, remark 2).

Small loops turn the base most there. Boxes (2, 2) are lower over upper bounds of the two joints,
rad.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.ndimage import maximum_filter

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.methods.geometric_phase import PhasePlane

_GRID_STEP = math.radians(15.0)
_REFINEMENTS = 8
_MOST_PEAKS = 4

_EQUAL = 1e-4
"""Peaks of the curvature that differ by less than this share are equally good, ..."""

_EQUALLY_NEAR = 1e-2
"""... and equally near where their distances differ by less than this, rad."""

_AROUND = np.array([[x, y] for x in (0.0, -1.0, 1.0) for y in (0.0, -1.0, 1.0)])
"""A point and its eight neighbours; the point itself comes first and wins a tie."""


def centre_box(at: Array, lower: Array, upper: Array) -> Array:
    """Return the box in which every point within the limits (2,) is found once.

    Shapes repeat after a turn: a joint that goes further than once round has all its points within
    half a turn of ``at`` (2,), or of the end of its range that is nearest to that.
    """
    width = np.minimum(upper - lower, 2 * math.pi)
    start = np.clip(at - width / 2, lower, upper - width)
    return np.stack([start, start + width])


def curvature_peaks(plane: PhasePlane, at: Array, boxes: Array) -> Array:
    """Return the points (R, 2) of the largest |curvature| in boxes (R, 2, 2).

    Of equally good points it is the one that is nearest to ``at`` (2,).
    """
    # Joints without limits have the same box for squares of all sizes.
    flat, row = np.unique(boxes.reshape(-1, 4), axis=0, return_inverse=True)
    boxes = flat.reshape(-1, 2, 2)
    tops = [_tops(plane, box) for box in boxes]
    points = np.vstack(tops)
    owner = np.repeat(np.arange(len(boxes)), [len(found) for found in tops])
    lower, upper = boxes[owner, :1], boxes[owner, 1:]
    step = _GRID_STEP
    for _ in range(_REFINEMENTS):
        step /= 2
        near = np.clip(points[:, np.newaxis] + step * _AROUND, lower, upper)
        around = np.abs(plane.curvature(near))
        points = near[np.arange(len(points)), np.argmax(around, axis=1)]
    heights = around.max(axis=1)
    distances = np.linalg.norm(points - at, axis=1)
    chosen = []
    for k in range(len(boxes)):
        mine = np.flatnonzero(owner == k)
        good = mine[heights[mine] >= (1 - _EQUAL) * heights[mine].max()]
        nearest = good[distances[good] <= distances[good].min() + _EQUALLY_NEAR]
        # The last one in order, so that rounding does not choose between mirror images.
        chosen.append(max(points[nearest].tolist()))
    return np.array(chosen)[row.ravel()]


def _tops(plane: PhasePlane, box: Array) -> Array:
    """Return the highest local maxima (P, 2) of |curvature| on a grid over a box."""
    axes = [np.linspace(low, high, 1 + math.ceil((high - low) / _GRID_STEP)) for low, high in box.T]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    heights = np.abs(plane.curvature(grid))
    tops = np.flatnonzero(heights == maximum_filter(heights, size=3, mode="nearest"))
    order = np.argsort(-heights.ravel()[tops], kind="stable")
    return grid.reshape(-1, 2)[tops[order[:_MOST_PEAKS]]]
