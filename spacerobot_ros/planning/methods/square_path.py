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

All joints of a planar robot rotate about parallel axes, and nothing tilts its base. The attitude is
a single angle theta about the robot axis. At zero angular momentum, ``theta_dot = -s(psi)'
psi_dot`` (eq. 3), where ``s_i = N_i / D`` is the component of the mechanical connection about the
axis, ``D`` the inertia of the locked robot about the axis, and ``N_i`` the coupling to joint i. The
rotation along a shape path is the line integral of ``-s`` (eq. 11), at any speed.

Small loops rotate the base most where the curvature is largest (remark 2). Boxes (2, 2) contain the
lower, then the upper bounds of two joints, rad.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from typing_extensions import override

from spacerobot_ros.errors import ParameterError, PlanningError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.model.rotations import quaternion_inverse, quaternion_multiply, swing_angle
from spacerobot_ros.parameters import nonnegative, parameter
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.controllability import (
    ZERO_TURN_PER_AREA,
    Controllability,
    curvatures,
    tilted_goal_error,
)
from spacerobot_ros.planning.core.goal import Controlled, PoseError
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule, Notes, straight_motion

_MAX_AXIS_TILT = 1e-5
"""Largest axis tilt, and largest rotation about other axes per radian of a joint, of a robot that
is considered planar: the rounding error of angles with six digits."""

_SAMPLED_SHAPE_COUNT = 8

_MAX_PANEL_ANGLE = 0.5
"""Longest part of a leg integrated by one Gauss rule, rad."""

_GAUSS_NODES, _GAUSS_WEIGHTS = np.polynomial.legendre.leggauss(10)
_GAUSS_NODES, _GAUSS_WEIGHTS = (_GAUSS_NODES + 1) / 2, _GAUSS_WEIGHTS / 2

_UNIT_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
"""Corners of the unit square, counter-clockwise."""

_GRID_STEP = math.radians(15.0)
_GRID_REFINEMENTS = 8
_MAX_PEAKS = 4

_EQUAL_PEAK_TOLERANCE = 1e-4
"""Relative difference below which curvature peaks are considered equal."""

_EQUAL_DISTANCE_TOLERANCE = 1e-2  # rad

_NEIGHBOUR_OFFSETS = np.array([[x, y] for x in (0.0, -1.0, 1.0) for y in (0.0, -1.0, 1.0)])
"""Offsets of a grid point and its eight neighbours; the first, for the point itself, wins ties."""


# -- planar robots, and their base rotation along shape paths -------------------------------------


def planar_axis(robot: SpaceRobot) -> Array:
    """Return the axis (3,) of a planar robot with three links, a unit vector in the base frame.

    Its largest component is positive, regardless of joint orientation.

    Raises
    ------
    PlanningError
        The robot has fewer than three links or is not planar; the message names the joint.
    """
    name, bodies = robot.description.name, robot.description.bodies
    if len(bodies) < 3:
        raise PlanningError(
            f"Robot '{name}' has {counted(len(bodies), 'moving link')}: with "
            "fewer than three, joint loops do not reorient a planar robot (paper 3, section III)."
        )
    axes: list[Array] = []
    rotations = [np.eye(3)]
    for body, joint in zip(bodies[1:], robot.description.moving_joints, strict=True):
        if joint.kind is JointKind.PRISMATIC:
            raise PlanningError(
                f"Robot '{name}' is not planar in the sense of paper 3: joint '{joint.name}' is "
                "prismatic, but all joints must rotate about parallel axes."
            )
        # Rotations about parallel axes do not tilt the axes, so one shape suffices for the test.
        rotations.append(rotations[body.parent] @ body.origin.R)
        axes.append(rotations[-1] @ joint.axis)
        if np.linalg.norm(np.cross(axes[0], axes[-1])) > _MAX_AXIS_TILT:
            raise PlanningError(
                f"Robot '{name}' is not planar: the axis of joint '{joint.name}' is not parallel "
                f"to that of joint '{robot.joint_names[0]}'."
            )
    axis = axes[0] * math.copysign(1.0, axes[0][np.argmax(np.abs(axes[0]))])
    _require_turn_about(robot, axis)
    return axis


def _require_turn_about(robot: SpaceRobot, axis: Array) -> None:
    """Reject masses off the plane and products of inertia that tilt the base."""
    # The tilt is a ratio of trigonometric polynomials of the shape: it is zero everywhere or
    # almost nowhere, so a few shapes in general position suffice for the test.
    shapes = np.outer(np.arange(1, _SAMPLED_SHAPE_COUNT + 1), np.sqrt(np.arange(2, robot.n + 2)))
    A = robot.function("connection", compile=False)(shapes.T).full()[3:]
    tilts = np.linalg.norm(A - np.outer(axis, axis @ A), axis=0).reshape(
        _SAMPLED_SHAPE_COUNT, robot.n
    )
    worst = np.unravel_index(np.argmax(tilts), tilts.shape)
    if tilts[worst] > _MAX_AXIS_TILT:
        raise PlanningError(
            f"Robot '{robot.description.name}' is not planar: joint "
            f"'{robot.joint_names[worst[1]]}' also rotates the base about axes other than its own, "
            f"by up to {tilts[worst]:.2g} rad per rad; the causes are centres of mass that do not "
            f"lie in one plane, or products of inertia."
        )


def check_planar_chain(robot: SpaceRobot) -> Controllability:
    """Test a robot as in paper 3: a planar robot with three or more links and nonzero curvature."""
    names, rest = robot.joint_names, np.zeros(robot.n)
    try:
        phase = PlanarPhase(robot)
    except PlanningError as refusal:
        return Controllability(0, 1, np.zeros(3), names, rest, str(refusal))
    box = np.stack(robot.description.shape_box)
    middle = box.mean(axis=0)
    tops = []
    for i, j in itertools.combinations(range(robot.n), 2):
        plane, shape = PhasePlane(phase, middle, i, j), middle.copy()
        shape[[i, j]] = curvature_peaks(plane, middle[[i, j]], box[np.newaxis, :, [i, j]])[0]
        tops.append((abs(float(plane.curvature(shape[[i, j]]))), (names[i], names[j]), shape))
    largest, pair, shape = max(tops, key=lambda top: top[0])
    message = (
        f"{robot.n + 1} links in a plane: loops of joints '{pair[0]}' and '{pair[1]}' rotate the "
        f"base by up to {largest:.3g} rad per unit of area, around {np.round(shape, 3).tolist()} "
        "(paper 3)."
    )
    if largest <= ZERO_TURN_PER_AREA:
        message = f"Joint loops of robot '{robot.description.name}' do not rotate its base."
    values = np.array([largest, 0.0, 0.0])
    return Controllability(int(largest > ZERO_TURN_PER_AREA), 1, values, pair, shape, message)


class PlanarPhase:
    """Base rotations of a planar robot about its axis, rad, along shape paths.

    Parameters
    ----------
    robot
        The model.

    Raises
    ------
    PlanningError
        The robot is not planar; see :func:`planar_axis`.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        self.axis = planar_axis(robot)
        """Axis (3,) of positive rotations, a unit vector in the base frame."""
        self.robot = robot.interpreted
        """The model, not compiled: that would take longer than planning."""

    def turns_by_legs(self, starts: Array, ends: Array) -> Array:
        """Return the rotations (L,) along straight legs in shape space, starts to ends (L, n)."""
        moves = ends - starts
        count = max(1, math.ceil(np.abs(moves).max(initial=0.0) / _MAX_PANEL_ANGLE))
        along = ((np.arange(count)[:, np.newaxis] + _GAUSS_NODES) / count).ravel()
        weights = np.tile(_GAUSS_WEIGHTS, count) / count
        shapes = starts[:, np.newaxis] + along[:, np.newaxis] * moves[:, np.newaxis]
        A = self.robot.function("connection")(shapes.reshape(-1, self.robot.n).T).full()[3:]
        s = (self.axis @ A).reshape(shapes.shape)
        return np.asarray(-np.einsum("p,lpn,ln->l", weights, s, moves))


class PhasePlane:
    """Base rotations due to two joints i and j.

    Parameters
    ----------
    phase
        Base rotations of the robot.
    psi
        (n,) shape at which the other joints rest, rad.
    i, j
        Indices of the two joints.
    """

    def __init__(self, phase: PlanarPhase, psi: Array, i: int, j: int) -> None:
        self._phase, self._psi, self._pair = phase, psi, [i, j]

    def curvature(self, points: Array) -> Array:
        """Return the base rotation per area of small loops, 1/rad, (...), at points (..., 2).

        Loops are counter-clockwise in the plane (psi_i, psi_j): the result is ``-H``, eq. (10),
        with ``H = ds_j/dpsi_i - ds_i/dpsi_j``.
        """
        i, j = self._pair
        K = curvatures(self._phase.robot, self._shapes(points))[:, :, i, j]
        return np.asarray(K @ self._phase.axis).reshape(points.shape[:-1])

    def turns_by_squares(self, centres: Array, sides: Array) -> Array:
        """Return the rotations (R,) by counter-clockwise squares around centres (R, 2)."""
        corners = square_corners(centres, sides)
        ends = self._shapes(np.roll(corners, -1, axis=1))
        return self._phase.turns_by_legs(self._shapes(corners), ends).reshape(-1, 4).sum(axis=1)

    def _shapes(self, points: Array) -> Array:
        """Return the shapes (N, n) at points (..., 2)."""
        shapes = np.tile(self._psi, (points.size // 2, 1))
        shapes[:, self._pair] = points.reshape(-1, 2)
        return shapes


def square_corners(centres: Array, sides: Array) -> Array:
    """Return the corners (R, 4, 2) of squares, counter-clockwise; centres (R, 2), sides (R,)."""
    return centres[:, np.newaxis] + np.multiply.outer(sides, _UNIT_SQUARE)


def centre_box(at: Array, lower: Array, upper: Array) -> Array:
    """Return the box that contains every distinct point within the limits (2,) once.

    Shapes repeat after a revolution: for a joint with a larger range, all points are within half a
    revolution of ``at`` (2,), or within one revolution of the range end nearest to it.
    """
    width = np.minimum(upper - lower, 2 * math.pi)
    start = np.clip(at - width / 2, lower, upper - width)
    return np.stack([start, start + width])


def curvature_peaks(plane: PhasePlane, at: Array, boxes: Array) -> Array:
    """Return the points (R, 2) of largest |curvature| in boxes (R, 2, 2).

    Among equally good points, the one nearest to ``at`` (2,) is returned.
    """
    # Boxes of joints without limits do not depend on the size of the square.
    flat, row = np.unique(boxes.reshape(-1, 4), axis=0, return_inverse=True)
    boxes = flat.reshape(-1, 2, 2)
    tops = [_find_grid_maxima(plane, box) for box in boxes]
    points = np.vstack(tops)
    owner = np.repeat(np.arange(len(boxes)), [len(found) for found in tops])
    lower, upper = boxes[owner, :1], boxes[owner, 1:]
    step = _GRID_STEP
    for _ in range(_GRID_REFINEMENTS):
        step /= 2
        near = np.clip(points[:, np.newaxis] + step * _NEIGHBOUR_OFFSETS, lower, upper)
        around = np.abs(plane.curvature(near))
        points = near[np.arange(len(points)), np.argmax(around, axis=1)]
    heights = around.max(axis=1)
    distances = np.linalg.norm(points - at, axis=1)
    chosen = []
    for k in range(len(boxes)):
        mine = np.flatnonzero(owner == k)
        good = mine[heights[mine] >= (1 - _EQUAL_PEAK_TOLERANCE) * heights[mine].max()]
        nearest = good[distances[good] <= distances[good].min() + _EQUAL_DISTANCE_TOLERANCE]
        # The last of equal peaks in order, so that rounding does not choose between mirror images.
        chosen.append(max(points[nearest].tolist()))
    return np.array(chosen)[row.ravel()]


def _find_grid_maxima(plane: PhasePlane, box: Array) -> Array:
    """Return the highest local maxima (P, 2) of |curvature| on a grid over a box."""
    axes = [np.linspace(low, high, 1 + math.ceil((high - low) / _GRID_STEP)) for low, high in box.T]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    heights = np.abs(plane.curvature(grid))
    around = np.lib.stride_tricks.sliding_window_view(np.pad(heights, 1, mode="edge"), (3, 3))
    tops = np.flatnonzero(heights == around.max(axis=(2, 3)))
    order = np.argsort(-heights.ravel()[tops], kind="stable")
    return grid.reshape(-1, 2)[tops[order[:_MAX_PEAKS]]]


# -- the method -----------------------------------------------------------------------------------

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
