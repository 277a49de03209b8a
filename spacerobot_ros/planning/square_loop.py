"""Square loops in the plane of two joints: where to put one, and how large (paper 3, section III).

The side ``z*`` solves ``phase(z*) = wanted phase``; the centre ``psi*`` is where the curvature is
largest, remark 2, among the centres round which the square fits into the joint limits.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.curvature_peak import centre_box, curvature_grid, curvature_peaks
from spacerobot_ros.planning.planar import PlanarPhase

_LARGEST_SIDE = math.pi
"""rad. Over a whole turn of both joints the curvature has mean zero: beyond about half a turn a
larger square adds curvature of the other sign."""

_SIDES = 8
"""Sides that are tried between zero and the largest that fits."""

_LARGEST_WITHIN = 1.0 - 1e-9
"""Share of the room that the largest square takes: rounding must not put a corner beyond it."""

_MARGIN = 1.1
"""What |curvature| on a grid is raised by to bound it between the points."""

_NO_TURN = 1e-9

_CORNERS = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of the unit square, counter-clockwise."""


@dataclass(frozen=True)
class SquareLoop:
    """A square in shape space that turns the base by what was wanted.

    Attributes
    ----------
    pair
        Indices (i, j) of the joints that move.
    centre
        (2,) ``psi*``, rad.
    side
        ``z*``, rad.
    loops
        How often it is gone round.
    clockwise
        Sense of travel in the plane (psi_i, psi_j).
    corners
        (4, n) shapes in the order of travel; the first is the corner nearest to ``psi_e``.
    """

    pair: tuple[int, int]
    centre: Array
    side: float
    loops: int
    clockwise: bool
    corners: Array


@dataclass(frozen=True)
class _Candidates:
    """Growing squares of one pair: centres (R, 2), sides (R,), phases (R,) counter-clockwise."""

    pair: tuple[int, int]
    centres: Array
    sides: Array
    phases: Array

    @property
    def largest(self) -> float:
        """The largest turn of the base by one loop, rad."""
        return float(np.abs(self.phases).max())


@dataclass(frozen=True)
class _Plane:
    """A pair of joints, its limits (2,), the largest side that fits, and bounds on the curvature
    and on the phase of any square in it.
    """

    pair: tuple[int, int]
    lower: Array
    upper: Array
    side: float
    steepest: float
    largest: float

    def at_best(self, wanted: float) -> tuple[int, float]:
        """Return the fewest loops that may turn the base by ``wanted``, rad, and their side."""
        loops = math.ceil(wanted / max(self.largest, _NO_TURN))
        return loops, math.sqrt(wanted / loops / max(self.steepest, _NO_TURN))


class SquareSearch:
    """Finds the square loop for a wanted turn.

    Parameters
    ----------
    robot
        The model; it gives joint names and limits.
    phase
        Its geometric phase.
    most_loops
        The wanted turn may take this many loops.
    centre
        (2,) where all squares are centred, rad; None: where the curvature is largest.
    """

    def __init__(
        self, robot: SpaceRobot, phase: PlanarPhase, most_loops: int, centre: Array | None
    ) -> None:
        self._robot = robot
        self._phase = phase
        self._most_loops = most_loops
        self._centre = centre
        self._movable: list[int] = np.flatnonzero(robot.velocity_limit > 0).tolist()

    def loop(self, psi_e: Array, wanted: float) -> SquareLoop:
        """Return the loop that turns the base by ``wanted`` (rad), other joints at ``psi_e`` (n,).

        Of all pairs of joints it is the one that takes the fewest loops, and of those the one
        with the smallest square.

        Raises
        ------
        PlanningError
            No square within the joint limits turns the base far enough.
        """
        best: SquareLoop | None = None
        largest: _Candidates | None = None
        for plane in sorted(self._planes(psi_e), key=lambda plane: -plane.steepest):
            # What cannot be better need not be looked at closely.
            if best is not None and plane.at_best(abs(wanted)) > (best.loops, best.side):
                continue
            candidates = self._candidates(psi_e, plane)
            if largest is None or candidates.largest > largest.largest:
                largest = candidates
            loops = math.ceil(abs(wanted) / max(candidates.largest, _NO_TURN))
            if loops <= self._most_loops:
                found = self._solve(psi_e, candidates, wanted, loops)
                if best is None or (loops, found.side) < (best.loops, best.side):
                    best = found
        if best is None:
            raise PlanningError(self._why_not(wanted, largest))
        return best

    def _why_not(self, wanted: float, largest: _Candidates | None) -> str:
        """Return why no loop will do; ``largest`` is the best there is."""
        if len(self._movable) < 2:
            return (
                f"Fewer than two joints of robot '{self._robot.description.name}' have a velocity "
                "limit above zero: they cannot go round a loop."
            )
        given = ""
        if self._centre is not None:
            given = f" round the given centre {np.round(self._centre, 4).tolist()} rad"
        if largest is None:
            return f"No square loop{given} fits into the joint limits."
        i, j = largest.pair
        names = self._robot.joint_names
        most = (
            f"square loops of joints '{names[i]}' and '{names[j]}'{given} turn it by at most about "
            f"{largest.largest:.3g} rad each"
        )
        if largest.sides[-1] < _LARGEST_SIDE * _LARGEST_WITHIN:
            most += f", with sides of up to {largest.sides[-1]:.3g} rad within the joint limits"
        if largest.largest < _NO_TURN:
            return f"The base cannot be turned by {wanted:.4g} rad: {most}."
        return (
            f"A turn of the base by {wanted:.4g} rad takes "
            f"{math.ceil(abs(wanted) / largest.largest)} loops, more than most_loops = "
            f"{self._most_loops}: {most}."
        )

    def _planes(self, psi_e: Array) -> list[_Plane]:
        """Return the planes of all pairs of joints that have room for a square."""
        planes = []
        for i, j in itertools.combinations(self._movable, 2):
            lower, upper = self._robot.lower[[i, j]], self._robot.upper[[i, j]]
            room = float(np.min(upper - lower))
            if self._centre is not None:
                room = 2 * float(np.minimum(self._centre - lower, upper - self._centre).min())
            if room > 0:
                box = centre_box(psi_e[[i, j]], lower, upper)
                heights = _MARGIN * curvature_grid(self._phase, psi_e, (i, j), box)
                side = min(room, _LARGEST_SIDE) * _LARGEST_WITHIN
                steepest, total = heights.max(), heights.mean() * np.prod(box[1] - box[0])
                bound = float(min(steepest * side**2, total))
                planes.append(_Plane((i, j), lower, upper, side, float(steepest), bound))
        return planes

    def _candidates(self, psi_e: Array, plane: _Plane) -> _Candidates:
        """Return squares of growing side within the limits."""
        sides = np.linspace(0.0, plane.side, _SIDES + 1)[1:]
        if self._centre is not None:
            centres = np.tile(self._centre, (_SIDES, 1))
        else:
            psi = psi_e[list(plane.pair)]
            boxes = [centre_box(psi, plane.lower + z / 2, plane.upper - z / 2) for z in sides]
            centres = curvature_peaks(self._phase, psi_e, plane.pair, np.array(boxes))
        phases = self._phases(psi_e, plane.pair, centres, sides)
        return _Candidates(plane.pair, centres, sides, phases)

    def _solve(
        self, psi_e: Array, candidates: _Candidates, wanted: float, loops: int
    ) -> SquareLoop:
        """Return the loop round the smallest candidate that is large enough, with its ``z*``."""
        target = abs(wanted) / loops
        # Rounding of the division must not leave the largest out.
        enough = np.abs(candidates.phases) >= min(target, candidates.largest)
        pair, row = candidates.pair, int(np.argmax(enough))
        centre, side = candidates.centres[row], float(candidates.sides[row])
        sign = math.copysign(1.0, candidates.phases[row])

        def excess(z: float) -> float:
            return sign * float(self._phases(psi_e, pair, centre, np.array([z]))[0]) - target

        # The last digit of the phase depends on how many legs are integrated together.
        if excess(side) > 0:
            side = float(brentq(excess, 0.0, side, xtol=1e-13, rtol=1e-14))
        clockwise = sign * wanted < 0
        corners = self._corners(psi_e, pair, centre, np.array([side]))[0]
        corners = corners[::-1] if clockwise else corners
        nearest = int(np.argmin(np.linalg.norm(corners - psi_e, axis=1)))
        return SquareLoop(pair, centre, side, loops, clockwise, np.roll(corners, -nearest, axis=0))

    def _phases(self, psi_e: Array, pair: tuple[int, int], centres: Array, sides: Array) -> Array:
        """Return the turns (R,) of the base by squares gone round counter-clockwise."""
        corners = self._corners(psi_e, pair, centres, sides)
        n = len(psi_e)
        legs = self._phase.legs(corners.reshape(-1, n), np.roll(corners, -1, axis=1).reshape(-1, n))
        return legs.reshape(-1, 4).sum(axis=1)

    @staticmethod
    def _corners(psi_e: Array, pair: tuple[int, int], centres: Array, sides: Array) -> Array:
        """Return the corners (R, 4, n) of squares, counter-clockwise."""
        corners = np.tile(psi_e, (len(sides), 4, 1))
        corners[:, :, pair] = np.reshape(centres, (-1, 1, 2)) + np.multiply.outer(sides, _CORNERS)
        return corners
