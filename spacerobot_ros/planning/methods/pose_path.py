"""End-effector paths given by poses: straight lines, rounded at the corners.

Within a distance ``d`` of a corner, both lines are blended: the position is ``c - a l_1 + b l_2``,
with the lines ``l_1`` and ``l_2`` to and from the corner ``c``, ``a = (1 - t)^2 d / |l_1|``, and
``b = t^2 d / |l_2|``, for t from 0 to 1. The tangent is continuous, and the position deviates from
the lines by at most ``d / 4``. The attitude is blended in the same way, using rotations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_inverse,
    quaternion_multiply,
    quaternions_from_rotvecs,
    rotvec_from_quaternion,
    rotvecs_from_quaternions,
)

MAX_CORNERS = 500
"""Largest number of corners in a path, which limits planning time."""

_SAME_POSE = 1e-10  # m or rad

_MIN_BLEND_COSINE = -0.5
"""Cosine of the largest corner angle that is rounded; at sharper corners, the motion stops."""

_BLEND_PARTS = 4
"""Number of parts into which a blend is divided; the path is checked at the ends of these parts."""


@dataclass(frozen=True)
class PosePath:
    """Straight lines through poses; along each, the attitude rotates about one axis.

    Attributes
    ----------
    positions
        (K, 3), m.
    quaternions
        (K, 4), (x, y, z, w).
    """

    positions: Array
    quaternions: Array

    @classmethod
    def from_poses(cls, positions: Array, quaternions: Array) -> PosePath:
        """Return the path through poses; identical successive poses are merged."""
        path = cls(positions, quaternions)
        kept = np.append(True, path.lengths > _SAME_POSE)
        return path if kept.all() else cls(positions[kept], quaternions[kept])

    @cached_property
    def chords(self) -> Array:
        """Displacements (K - 1, 3) from pose to pose, m."""
        return np.asarray(np.diff(self.positions, axis=0))

    @cached_property
    def turns(self) -> Array:
        """Rotation vectors (K - 1, 3) between attitudes, rad, in the frame of the positions."""
        between = quaternion_multiply(
            self.quaternions[1:], quaternion_inverse(self.quaternions[:-1])
        )
        return rotvecs_from_quaternions(between)

    @cached_property
    def lengths(self) -> Array:
        """(K - 1,) length of each line: metres plus radians."""
        return np.asarray(np.linalg.norm(self.chords, axis=1) + np.linalg.norm(self.turns, axis=1))

    @cached_property
    def lengths_at_poses(self) -> Array:
        """(K,) path length up to each pose: metres plus radians."""
        return np.append(0.0, np.cumsum(self.lengths))

    def line_at(self, length: float) -> int:
        """Return the index of the line that continues after a given length of the path."""
        i = np.searchsorted(self.lengths_at_poses, length, side="right") - 1
        return int(np.clip(i, 0, len(self.chords) - 1))

    def remaining_after(self, length: float) -> PosePath:
        """Return the rest of the path after a given length; at the end, a single pose."""
        length = min(max(length, 0.0), float(self.lengths_at_poses[-1]))
        if len(self.positions) == 1:
            return self
        i = self.line_at(length)
        share = (length - self.lengths_at_poses[i]) / self.lengths[i]
        r = self.positions[i] + share * self.chords[i]
        turned = quaternion_multiply(
            quaternion_from_rotvec(share * self.turns[i]), self.quaternions[i]
        )
        return PosePath.from_poses(
            np.vstack([r, self.positions[i + 1 :]]), np.vstack([turned, self.quaternions[i + 1 :]])
        )

    def simplified(self, tolerance: float) -> PosePath:
        """Return a path through fewer poses that deviates from the others by at most a tolerance.

        ``tolerance`` is in m and rad. (Douglas and Peucker; positions are compared at equal
        fractions of the length, so that an out-and-back path is preserved.)

        Raises
        ------
        PlanningError
            The path has too many corners.
        """
        kept, open_parts = {0, len(self.positions) - 1}, [(0, len(self.positions) - 1)]
        while open_parts:
            first, last = open_parts.pop()
            if last - first < 2:
                continue
            off = self._distances_from_line(first, last)
            worst = int(np.argmax(off))
            if off[worst] <= max(tolerance, _SAME_POSE):
                continue
            kept.add(first + 1 + worst)
            if len(kept) > MAX_CORNERS + 2:
                raise PlanningError(
                    f"The path has more than {MAX_CORNERS} corners: give fewer poses, or a larger "
                    "resolved_rate.corner_tolerance."
                )
            open_parts += [(first, first + 1 + worst), (first + 1 + worst, last)]
        order = sorted(kept)
        return PosePath(self.positions[order], self.quaternions[order])

    def _distances_from_line(self, first: int, last: int) -> Array:
        """Return the deviations of the poses between two poses from their line, m or rad."""
        inner = slice(first + 1, last)
        shares = (self.lengths_at_poses[inner] - self.lengths_at_poses[first]) / (
            self.lengths_at_poses[last] - self.lengths_at_poses[first]
        )
        r = self.positions[first] + shares[:, np.newaxis] * (
            self.positions[last] - self.positions[first]
        )
        start = self.quaternions[first]
        turn = rotvec_from_quaternion(
            quaternion_multiply(self.quaternions[last], quaternion_inverse(start))
        )
        turned = quaternion_multiply(quaternions_from_rotvecs(shares[:, np.newaxis] * turn), start)
        left = rotvecs_from_quaternions(
            quaternion_multiply(self.quaternions[inner], quaternion_inverse(turned))
        )
        off = np.linalg.norm(self.positions[inner] - r, axis=1)
        return np.asarray(np.maximum(off, np.linalg.norm(left, axis=1)))

    def split_at_reversals(self, tolerance: float) -> Iterator[PosePath]:
        """Yield the parts between sharp corners, or between all corners without a tolerance."""
        directions = np.hstack([self.chords, self.turns])
        size = np.linalg.norm(directions, axis=1)
        cosines = (directions[1:] * directions[:-1]).sum(axis=1) / (size[1:] * size[:-1])
        stops = 1 + np.flatnonzero((cosines < _MIN_BLEND_COSINE) | (tolerance <= 0.0))
        for first, last in zip([0, *stops], [*stops, len(self.positions) - 1], strict=True):
            yield PosePath(self.positions[first : last + 1], self.quaternions[first : last + 1])


class RoundedPath:
    """Motion along a path with rounded corners: displacement and rotation from its start.

    Parameters
    ----------
    path
        The path, with at least two poses.
    tolerance
        Largest deviation from the lines, m, and from their attitudes, rad.
    before, whole
        Path length before the start of this motion, and length of the whole path, m, for messages.

    Attributes
    ----------
    total_length
        Length of the whole path, m.
    is_straight
        Whether the path is one straight line.
    curvature_breaks
        Fractions of the path at which the curvature changes.
    """

    def __init__(
        self, path: PosePath, tolerance: float, before: float = 0.0, whole: float | None = None
    ) -> None:
        self._path, self._total = path, float(path.lengths_at_poses[-1])
        self._metres_at_poses = np.append(0.0, np.cumsum(np.linalg.norm(path.chords, axis=1)))
        length = float(self._metres_at_poses[-1])
        self._length_before, self.total_length = before, length if whole is None else whole
        self.is_straight = len(path.positions) == 2
        near = np.minimum(path.lengths[1:], path.lengths[:-1]) / 2
        self._blends = np.concatenate([[0.0], np.minimum(near, 4 * tolerance), [0.0]])
        """(K,) distances from the corners at which blends begin and end."""
        parts = np.linspace(-1.0, 1.0, _BLEND_PARTS + 1)
        inner = slice(1, -1)
        marks = path.lengths_at_poses[inner, np.newaxis] + np.outer(self._blends[inner], parts)
        self.curvature_breaks = np.unique(marks) / self._total

    def pose(self, share: float) -> tuple[Array, Array]:
        """Return displacement (3,), m, and rotation (4,) from the start at a share of the way."""
        base, before, after, a, b, _, _ = self._blend_at(share)
        path, start = self._path, quaternion_inverse(self._path.quaternions[0])
        place = path.positions[base] - path.positions[0]
        to_base = quaternion_multiply(path.quaternions[base], start)
        back = quaternion_multiply(quaternion_from_rotvec(-a * path.turns[before]), to_base)
        turned = quaternion_multiply(quaternion_from_rotvec(b * path.turns[after]), back)
        return np.asarray(place - a * path.chords[before] + b * path.chords[after]), turned

    def derivative(self, share: float) -> tuple[Array, Array]:
        """Return their derivatives by the share: velocity (3,), m, angular velocity (3,), rad."""
        _, before, after, _, b, a_rate, b_rate = self._blend_at(share)
        chords, turns = self._path.chords, self._path.turns
        carried = matrix_from_quaternion(quaternion_from_rotvec(b * turns[after]))
        turn = b_rate * turns[after] - a_rate * (carried @ turns[before])
        return np.asarray(b_rate * chords[after] - a_rate * chords[before]), np.asarray(turn)

    def travelled_length(self, share: float) -> float:
        """Return the length along the whole path, m, after a fraction of this motion."""
        return self._length_before + float(
            np.interp(share * self._total, self._path.lengths_at_poses, self._metres_at_poses)
        )

    def _blend_at(self, share: float) -> tuple[int, int, int, float, float, float, float]:
        """Return a pose, the lines to and from it, the fractions ``a`` of the first remaining and
        ``b`` of the second completed, and the derivatives of both by the fraction of the path.
        """
        along, lengths, total = self._path.lengths_at_poses, self._path.lengths, self._total
        s = share * total
        i = self._path.line_at(s)
        corner = i + 1 if s > along[i + 1] - self._blends[i + 1] else i
        d = self._blends[corner]
        if abs(s - along[corner]) >= d:
            return i, max(i - 1, 0), i, 0.0, (s - along[i]) / lengths[i], 0.0, total / lengths[i]
        t = (s - along[corner] + d) / (2 * d)
        before, after = corner - 1, corner
        to, on = d / lengths[before], d / lengths[after]
        scale = total / (2 * d)
        a, b = to * (1 - t) ** 2, on * t**2
        return corner, before, after, a, b, -2 * to * (1 - t) * scale, 2 * on * t * scale
