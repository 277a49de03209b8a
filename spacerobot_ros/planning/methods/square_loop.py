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
from spacerobot_ros.planning.methods.curvature_peak import centre_box, curvature_peaks
from spacerobot_ros.planning.methods.geometric_phase import PhasePlane, PlanarPhase, square_corners

_LARGEST_SIDE = math.pi
"""rad. Over a whole turn of both joints the curvature has mean zero: beyond about half a turn a
larger square adds curvature of the other sign."""

_SIDES = 8
"""Sides that are tried between zero and the largest that fits."""

_LARGEST_WITHIN = 1.0 - 1e-9
"""Share of the room that the largest square takes: rounding must not put a corner beyond it."""

_NO_TURN = 1e-9


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
    plane: PhasePlane
    centres: Array
    sides: Array
    phases: Array

    @property
    def largest(self) -> float:
        """The largest turn of the base by one loop, rad."""
        return float(np.abs(self.phases).max())


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
        pairs = itertools.combinations(self._movable, 2)
        found = [candidates for pair in pairs if (candidates := self._candidates(psi_e, pair))]
        largest = max(found, key=lambda candidates: candidates.largest, default=None)
        if largest is None or largest.largest * self._most_loops < abs(wanted):
            raise PlanningError(self._why_not(wanted, largest))
        loops = math.ceil(abs(wanted) / largest.largest)
        target = abs(wanted) / loops
        solved = [
            (candidates, *_solve(candidates, target))
            for candidates in found
            if candidates is largest or candidates.largest >= target
        ]
        candidates, row, side = min(solved, key=lambda square: square[2])
        clockwise = candidates.phases[row] * wanted < 0
        corners = np.tile(psi_e, (4, 1))
        corners[:, candidates.pair] = square_corners(candidates.centres[[row]], np.array([side]))[0]
        corners = corners[::-1] if clockwise else corners
        nearest = int(np.argmin(np.linalg.norm(corners - psi_e, axis=1)))
        return SquareLoop(
            candidates.pair,
            candidates.centres[row],
            side,
            loops,
            clockwise,
            np.roll(corners, -nearest, axis=0),
        )

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

    def _candidates(self, psi_e: Array, pair: tuple[int, int]) -> _Candidates | None:
        """Return squares of growing side within the limits; None if there is no room."""
        at, lower, upper = (x[list(pair)] for x in (psi_e, self._robot.lower, self._robot.upper))
        room = float(np.min(upper - lower))
        if self._centre is not None:
            room = 2 * float(np.minimum(self._centre - lower, upper - self._centre).min())
        if room <= 0:
            return None
        plane = self._phase.plane(psi_e, *pair)
        sides = np.linspace(0.0, min(room, _LARGEST_SIDE) * _LARGEST_WITHIN, _SIDES + 1)[1:]
        if self._centre is not None:
            centres = np.tile(self._centre, (_SIDES, 1))
        else:
            boxes = [centre_box(at, lower + side / 2, upper - side / 2) for side in sides]
            centres = curvature_peaks(plane, at, np.array(boxes))
        return _Candidates(pair, plane, centres, sides, plane.squares(centres, sides))


def _solve(candidates: _Candidates, wanted: float) -> tuple[int, float]:
    """Return the row of the smallest candidate that turns far enough, and ``z*`` round its centre.

    ``wanted`` is the turn of one loop in either sense, rad, at most the largest there is.
    """
    # Rounding must not leave the largest out.
    enough = np.abs(candidates.phases) >= min(wanted, candidates.largest)
    row = int(np.argmax(enough))
    centre, side = candidates.centres[[row]], float(candidates.sides[row])
    sign = math.copysign(1.0, candidates.phases[row])

    def excess(z: float) -> float:
        return sign * float(candidates.plane.squares(centre, np.array([z]))[0]) - wanted

    # The last digit of a phase depends on how many legs are integrated together.
    if excess(side) <= 0:
        return row, side
    return row, float(brentq(excess, 0.0, side, xtol=1e-13, rtol=1e-14))
