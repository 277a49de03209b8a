"""Square paths in shape space for planar chains: the reorientation of paper 3, section III.

Step 1 moves to the desired shape ``psi_e``. Step 2 moves to the nearest corner of a
square, step 3 follows the square, and step 4 returns along the path of step 2. The geometric phase
of the square is the base rotation that remains after step 1; steps 2 and 4 cancel.

Every leg is a straight line in shape space, from rest to rest; the paper's laws also start from
nonzero joint rates (its property 3), for which this method does not plan. The plant holds each
velocity for a tick. So the shape moves along the same straight lines, at different speeds within a
tick, and the geometric phase, which depends only on the path, is exactly that of the smooth motion.

The side ``z*`` of the square solves ``phase(z*) = wanted phase``; its centre ``psi*`` is where the
curvature is largest (remark 2) among the centres around which it fits within the joint limits.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import override

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_inverse, quaternion_multiply, swing_angle
from spacerobot_ros.parameters import nonnegative, parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.controllability import tilted_goal_error
from spacerobot_ros.planning.core.goal import Controlled, PoseError
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule, Notes, straight_motion
from spacerobot_ros.planning.methods.geometric_phase import (
    PhasePlane,
    PlanarPhase,
    centre_box,
    curvature_peaks,
    planar_axis,
    square_corners,
)

_MIN_CORRECTED_SHARE = 0.1
"""Fraction of the tolerance below which a remaining rotation is not corrected."""

_ZERO_ROTATION_ANGLE = 1e-9

_MAX_SIDE = math.pi
"""rad. Over a revolution of both joints, the curvature has zero mean: beyond about half a
revolution, a larger square adds curvature of opposite sign."""

_SIDE_SAMPLES = 8
"""Number of side lengths tried between zero and the largest length that fits."""

_USED_RANGE_SHARE = 1.0 - 1e-9
"""Fraction of the free range used by the largest square, so that rounding does not exceed it."""


@dataclass(frozen=True)
class SquarePathOptions:
    """The options of ``square_path``."""

    t1: float = parameter(
        8.0, "end of step 1, the motion to the final shape", "s", minimum=1e-3, maximum=1e9
    )
    t2: float = parameter(
        12.0, "end of step 2, the motion to the square", "s", minimum=1e-3, maximum=1e9
    )
    t3: float = parameter(
        20.0,
        "end of step 3, one loop; each further loop takes the same time",
        "s",
        minimum=1e-3,
        maximum=1e9,
    )
    t4: float = parameter(24.0, "end of step 4, the motion back", "s", minimum=1e-3, maximum=1e9)
    most_loops: int = parameter(20, "largest number of loops", minimum=1, maximum=1000000)
    given_centre: int = nonnegative(
        0, "1: squares around (centre_1, centre_2); 0: squares around the best centre", maximum=1
    )
    centre_1: float = parameter(
        0.0, "first coordinate of a given centre", "rad", minimum=-1000.0, maximum=1000.0
    )
    centre_2: float = parameter(
        0.0, "second coordinate of a given centre", "rad", minimum=-1000.0, maximum=1000.0
    )
    longest: float = parameter(3600.0, "longest permitted manoeuvre", "s", minimum=1.0, maximum=1e9)


@dataclass(frozen=True)
class _SquareFamily:
    """Squares for a pair of joints by side: centres (R, 2), sides (R,), ccw phases (R,)."""

    pair: tuple[int, int]
    plane: PhasePlane
    centres: Array
    sides: Array
    geometric_phases: Array

    @property
    def largest(self) -> float:
        """Largest base rotation produced by one loop, rad."""
        return float(np.abs(self.geometric_phases).max())


class SquarePathGait(GaitMethod):
    """Controls the attitude and shape of planar trees with three or more links and revolute joints.

    The base position follows from attitude and shape (the centre of mass is at rest).
    """

    name: ClassVar[str] = "square_path"
    repeats_cycles: ClassVar[bool] = True
    controls: frozenset[Controlled] = frozenset({"attitude", "shape"})
    Options: ClassVar[type[SquarePathOptions]] = SquarePathOptions
    options: SquarePathOptions

    @override
    def setup(self) -> None:
        robot, chosen = self.robot, self.options
        t1, t2, t3, t4 = chosen.t1, chosen.t2, chosen.t3, chosen.t4
        instants = (0.0, t1, t2, t3, t4)
        if not np.all(np.diff(instants) > 0):
            raise ParameterError(
                f"The times t1 to t4 of square_path are {t1:g}, {t2:g}, {t3:g} and {t4:g} s; "
                "each must be later than the one before."
            )
        self._durations = tuple(float(x) for x in np.diff(instants))
        self._phase = PlanarPhase(robot)
        centre = np.array([chosen.centre_1, chosen.centre_2])
        self._centre = centre if chosen.given_centre else None
        self._movable: list[int] = np.flatnonzero(robot.velocity_limit > 0).tolist()

    @classmethod
    @override
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Reject robots that are not planar, or have fewer than three links."""
        planar_axis(robot)

    @override
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan steps 1 to 4; see :meth:`GaitMethod.plan`."""
        cancellation.raise_if_requested()
        state, goal, tolerance = request.state, request.goal, request.tolerance
        self.require_rest(state)
        self.require_goal_of_base(goal)
        turn = self._requested_turn(request)
        psi_e = self._clear_goal_shape(request)
        if psi_e is None:
            psi_e = np.clip(state.q, self.robot.lower, self.robot.upper)
        step_1 = float(self._phase.turns_by_legs(state.q[np.newaxis], psi_e[np.newaxis])[0])
        # Full revolutions do not change the attitude, so the shorter rotation is chosen.
        wanted = math.remainder(turn - step_1, 2 * math.pi)
        duration_1, duration_2, duration_3, duration_4 = self._durations
        legs = [(psi_e, duration_1)]
        loop_notes: Notes = {"loops": 0.0}
        if abs(wanted) > max(_ZERO_ROTATION_ANGLE, _MIN_CORRECTED_SHARE * tolerance.attitude):
            corners, loops, loop_notes = self._find_loop(psi_e, wanted)
            around = [(corner, duration_3 / 4) for corner in np.roll(corners, -1, axis=0)]
            legs += [(corners[0], duration_2), *loops * around, (psi_e, duration_4)]
        longest = self.options.longest
        positions = straight_motion(self.robot, state.q, legs, self.control_period, longest)
        path = self._prediction.path(state, positions)
        left = PoseError.between(path.position[-1], path.quaternion[-1], goal)
        notes: Notes = {
            "psi_e": psi_e.tolist(),
            "turn_of_step_1": step_1,
            "wanted_phase": wanted,
            **loop_notes,
            "final_position": path.position[-1].tolist(),
            "predicted_attitude_error": left.angle,
        }
        return self.schedule_of(goal, positions, path, notes)

    def _requested_turn(self, request: PlanRequest) -> float:
        """Return the angle to the goal attitude about the robot's axis, in [-pi, pi]."""
        start, wanted = request.state.quaternion, request.goal.quaternion
        axis = self._phase.axis
        turn = quaternion_multiply(quaternion_inverse(start), wanted)
        tilt = swing_angle(turn, axis[np.newaxis])
        if tilt > max(request.tolerance.attitude, _ZERO_ROTATION_ANGLE):
            raise tilted_goal_error(self.robot, axis, tilt)
        twist = 2 * math.atan2(float(axis @ turn[:3]), float(turn[3]))
        return math.remainder(twist, 2 * math.pi)

    def _find_loop(self, psi_e: Array, wanted: float) -> tuple[Array, int, Notes]:
        """Return the square for a rotation ``wanted`` (rad), with other joints at ``psi_e`` (n,):
        its corners (4, n) in order of travel from the one nearest to ``psi_e``, loops, and notes.

        Among all joint pairs, the one with the fewest loops is chosen, and among those the one with
        the smallest square; if links come too close on all of these, more loops around smaller
        squares are used. PlanningError if no square within the joint limits does.
        """
        pairs = itertools.combinations(self._movable, 2)
        found = [
            candidates for pair in pairs if (candidates := self._squares_within_limits(psi_e, pair))
        ]
        largest = max(found, key=lambda candidates: candidates.largest, default=None)
        if largest is None or largest.largest * self.options.most_loops < abs(wanted):
            raise PlanningError(self._describe_refusal(wanted, largest))
        obstacle = ""
        fewest = math.ceil(abs(wanted) / largest.largest)
        for loops in range(fewest, self.options.most_loops + 1):
            target = abs(wanted) / loops
            solved = [
                (candidates, *self._solve_for_side(candidates, target))
                for candidates in found
                if candidates is largest or candidates.largest >= target
            ]
            for candidates, row, side in sorted(solved, key=lambda square: square[2]):
                centre = candidates.centres[row]
                clockwise = bool(candidates.geometric_phases[row] * wanted < 0)
                corners = np.tile(psi_e, (4, 1))
                corners[:, candidates.pair] = square_corners(centre[np.newaxis], np.array([side]))
                corners = corners[::-1] if clockwise else corners
                nearest = int(np.argmin(np.linalg.norm(corners - psi_e, axis=1)))
                corners = np.roll(corners, -nearest, axis=0)
                shapes = np.vstack([psi_e, corners, corners[0], psi_e])
                if too_near := self._too_near(shapes, at_ticks=False):
                    obstacle = obstacle or too_near
                    continue
                notes: Notes = {
                    "joints": ", ".join(self.robot.joint_names[i] for i in candidates.pair),
                    "psi_star": centre.tolist(),
                    "z_star": side,
                    "loops": float(loops),
                    "direction": "clockwise" if clockwise else "counter-clockwise",
                    "corner": corners[0].tolist(),
                }
                return corners, loops, notes
        raise PlanningError(
            f"On square loops within the joint limits, links come too close to each other with up "
            f"to most_loops = {self.options.most_loops} loops: {obstacle}."
        )

    def _describe_refusal(self, wanted: float, largest: _SquareFamily | None) -> str:
        """Return the message for a rotation without a loop; ``largest`` rotates it farthest."""
        if len(self._movable) < 2:
            return (
                f"Fewer than two joints of robot '{self.robot.description.name}' have a velocity "
                "limit above zero: they cannot follow a loop."
            )
        given = ""
        if self._centre is not None:
            given = f" around the given centre {np.round(self._centre, 4).tolist()} rad"
        if largest is None:
            return f"No square loop{given} fits within the joint limits."
        i, j = largest.pair
        names = self.robot.joint_names
        most = (
            f"square loops of joints '{names[i]}' and '{names[j]}'{given} rotate it by at most "
            f"about {largest.largest:.3g} rad each"
        )
        if largest.sides[-1] < _MAX_SIDE * _USED_RANGE_SHARE:
            most += f", with sides of up to {largest.sides[-1]:.3g} rad within the joint limits"
        if largest.largest < _ZERO_ROTATION_ANGLE:
            return f"The base cannot be rotated by {wanted:.4g} rad by square loops: {most}."
        return (
            f"A rotation of the base by {wanted:.4g} rad takes "
            f"{math.ceil(abs(wanted) / largest.largest)} loops, more than most_loops = "
            f"{self.options.most_loops}: {most}."
        )

    def _squares_within_limits(self, psi_e: Array, pair: tuple[int, int]) -> _SquareFamily | None:
        """Return squares of increasing side within the joint limits; None without room for any."""
        at, lower, upper = (x[list(pair)] for x in (psi_e, self.robot.lower, self.robot.upper))
        room = float(np.min(upper - lower))
        if self._centre is not None:
            room = 2 * float(np.minimum(self._centre - lower, upper - self._centre).min())
        if room <= 0:
            return None
        plane = PhasePlane(self._phase, psi_e, *pair)
        sides = np.linspace(0.0, min(room, _MAX_SIDE) * _USED_RANGE_SHARE, _SIDE_SAMPLES + 1)[1:]
        if self._centre is not None:
            centres = np.tile(self._centre, (_SIDE_SAMPLES, 1))
        else:
            boxes = [centre_box(at, lower + side / 2, upper - side / 2) for side in sides]
            centres = curvature_peaks(plane, at, np.array(boxes))
        return _SquareFamily(pair, plane, centres, sides, plane.turns_by_squares(centres, sides))

    def _solve_for_side(self, candidates: _SquareFamily, wanted: float) -> tuple[int, float]:
        """Return the row of the smallest square that rotates the base enough, and its ``z*``."""
        from scipy.optimize import brentq

        # The slack keeps rounding from excluding the largest square.
        enough = np.abs(candidates.geometric_phases) >= min(wanted, candidates.largest)
        row = int(np.argmax(enough))
        centre, side = candidates.centres[[row]], float(candidates.sides[row])
        sign = math.copysign(1.0, candidates.geometric_phases[row])

        def excess(z: float) -> float:
            return (
                sign * float(candidates.plane.turns_by_squares(centre, np.array([z]))[0]) - wanted
            )

        # The last digit of a phase depends on the number of legs in one call of the integration.
        if excess(side) <= 0:
            return row, side
        return row, float(brentq(excess, 0.0, side, xtol=1e-13, rtol=1e-14))
