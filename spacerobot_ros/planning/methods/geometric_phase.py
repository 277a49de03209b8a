"""Planar robots, and their base rotation along shape paths (the geometric phase of paper 3).

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

import numpy as np

from spacerobot_ros.errors import PlanningError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind
from spacerobot_ros.planning.core.controllability import (
    ZERO_TURN_PER_AREA,
    Controllability,
    curvatures,
)

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
