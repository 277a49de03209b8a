"""Distances of pairs as smooth functions of the shape, for a solver.

One solid of a pair is a set of balls: a rod has a row of them along its axis, a box the points of a
grid on its surface. The other one is a field, a function of a point that is about its distance:
from the axis of a rod, less the radius; or, of a box, the largest distance from its six faces,
smoothed, which tells the depth inside as well. A row is the smooth minimum of the field over the
balls. So rows are near to the distances but are no bounds of them: a path that keeps them is
checked exactly afterwards.

Rows of two links depend on the shape q alone. Those of a link and an obstacle depend on the turn X
of the base since the start, too: at zero momentum the centre of mass C of the system rests, and a
point of the link at ``r_BP(q)`` in the base is, seen from C in the attitude of the base at the
start, at ``X (r_BP(q) - r_BC(q))``, where the obstacle is at rest.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.collision.geometry import CollisionGeometry, Solid
from spacerobot_ros.collision.rounded_box import RoundedBox
from spacerobot_ros.model import symbolic_rotations
from spacerobot_ros.model.description import Array, JointKind, Pose, RobotDescription
from spacerobot_ros.model.kinematics import joint_positions

SHARPNESS_OF_MINIMUM, SHARPNESS_OF_FACES = 300.0, 150.0
"""Sharpness of smooth minima over balls and of smooth maxima over faces, 1/m."""

_MAX_ROD_WIDTH_RATIO = 0.35
"""Ratio of width to length below which a box of about square section is a rod, and its sections'
least ratio of sides."""
_MIN_ROD_SECTION_RATIO = 0.6

_MIN_CYLINDER_LENGTH_RATIO = 1.2
"""Ratio of length to radius below which a cylinder is a box."""

_END_BALL_DISTANCE = 0.6
"""Distance of the last ball of a cylinder from its end, in radii: its rim is covered about as much
as the ball protrudes."""

_BALL_SPACING, _MAX_BALLS = 1.0, 12
"""Distance of the balls of a rod in radii, and their largest number."""

_MAX_GRID_POINTS, _MIN_EDGE_RATIO = 3, 0.1
"""Points of a grid along an edge of a box at most, and the ratio of an edge to the longest below
which there is one."""

SQUARE_ROOT_OFFSET = 1e-10
"""Added below square roots, m^2: their derivative is infinite at zero."""


@dataclass(frozen=True)
class Form:
    """The form of a solid in rows: a rounded box in the frame of its link, and balls in it.

    ``balls`` are the middles (K, 3), m, in the frame of the link, of balls of ``radius``.
    """

    box: RoundedBox
    balls: Array
    radius: float

    @property
    def is_rod(self) -> bool:
        """Whether the box is a rod: it has a length alone."""
        return bool(np.count_nonzero(self.box.half) < 2)

    @classmethod
    def of(cls, solid: Solid) -> Form:
        """Return the form of a solid."""
        shape = solid.shape
        if shape.kind == "cylinder" and shape.size[1] >= _MIN_CYLINDER_LENGTH_RATIO * shape.size[0]:
            radius, length = shape.size
            end = max(length / 2 - _END_BALL_DISTANCE * radius, 0.0)
            return cls._rod(RoundedBox(shape.pose, np.array([0.0, 0.0, end]), radius))
        box = solid.enclosure
        half = np.sort(box.half)
        if np.count_nonzero(box.half) < 2:
            return cls._rod(box)
        if half[1] < _MAX_ROD_WIDTH_RATIO * half[2] and half[0] > _MIN_ROD_SECTION_RATIO * half[1]:
            # Between the circles in and around the section.
            radius = (half[1] + float(np.hypot(half[0], half[1]))) / 2
            longest = np.arange(3) == int(np.argmax(box.half))
            core = np.where(longest, box.half - _END_BALL_DISTANCE * radius, 0.0)
            return cls._rod(RoundedBox(box.pose, core, radius + box.radius))
        # A plate is one layer of balls.
        thin = box.half < _MIN_EDGE_RATIO * box.half.max()
        counts = np.clip(np.ceil(2 * box.half / box.half.max()) + 1, 2, _MAX_GRID_POINTS).astype(
            int
        )
        lines = [
            np.zeros(1) if flat else np.linspace(-x, x, k)
            for x, k, flat in zip(box.half, counts, thin, strict=True)
        ]
        points = np.array(list(itertools.product(*lines)))
        surface = np.any(np.isclose(np.abs(points), box.half) & ~thin, axis=1) | thin.any()
        radius = box.radius + float(box.half[thin].max(initial=0.0))
        return cls(box, _moved(box.pose, points[surface]), radius)

    @classmethod
    def _rod(cls, box: RoundedBox) -> Form:
        longest = int(np.argmax(box.half))
        half = box.half[longest]
        count = int(
            np.clip(np.ceil(2 * half / (_BALL_SPACING * box.radius + 1e-9)), 0, _MAX_BALLS - 1)
        )
        points = np.zeros((count + 1, 3))
        points[:, longest] = np.linspace(-half, half, count + 1) if count else 0.0
        return cls(box, _moved(box.pose, points), box.radius)

    def field(self, x: ca.SX) -> ca.SX:
        """Return the approximate distance of a point (3,) in the frame of the link, m."""
        local = ca.sparsify(ca.DM(self.box.pose.R.T)) @ (x - ca.DM(self.box.pose.r))
        half = self.box.half
        if self.is_rod:
            beyond = [
                ca.fmax(ca.fabs(local[i]) - half[i], 0.0) if half[i] else local[i] for i in range(3)
            ]
            return ca.sqrt(ca.sumsqr(ca.vertcat(*beyond)) + SQUARE_ROOT_OFFSET) - self.box.radius
        faces = ca.vertcat(local - ca.DM(half), -local - ca.DM(half))
        return -_smooth_minimum(-faces, SHARPNESS_OF_FACES) - self.box.radius


def _moved(pose: Pose, points: Array) -> Array:
    return np.asarray(points @ pose.R.T + pose.r)


def _smooth_minimum(values: ca.SX, sharpness: float) -> ca.SX:
    """Return a smooth function that is at most the least of the values."""
    # Shifted by the least one: far from it, exponentials would all be zero.
    least = ca.mmin(values)
    return least - ca.log(ca.sum1(ca.exp(-sharpness * (values - least)))) / sharpness


@dataclass(frozen=True)
class DistanceRows:
    """Smooth distances of some pairs of a robot, with derivatives.

    Attributes
    ----------
    values
        ``q -> d`` (K,), m.
    jacobian
        ``q -> dd/dq`` (K, n).
    hessian
        ``(q, lambda) -> `` the Hessian (n, n) of ``lambda' d``.
    is_of_obstacle
        Whether one of each pair is an obstacle: the functions then take ``y = [q; X]`` (n + 4) in
        place of q, with a quaternion X of any norm, and the numbers ``w`` (:func:`world_values`)
        after that.
    """

    values: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    is_of_obstacle: bool = False

    @classmethod
    def of(cls, geometry: CollisionGeometry, pairs: Sequence[int]) -> DistanceRows:
        """Derive the rows of pairs, given by their numbers."""
        robot = geometry.robot
        q = ca.SX.sym("q", len(robot.joint_names))
        multipliers = ca.SX.sym("lambda", len(pairs))
        solids = geometry.solids
        rows = [
            _row(robot, solids[i], solids[j], q) for i, j in geometry.pairs[list(pairs)].tolist()
        ]
        d = ca.vertcat(*rows)
        hessian = ca.SX(q.numel(), q.numel())
        for row, multiplier in zip(rows, ca.vertsplit(multipliers), strict=True):
            hessian += multiplier * ca.hessian(row, q)[0]
        return cls(
            ca.Function("distances", [q], [ca.cse(d)]),
            ca.Function("distances_jac", [q], [ca.cse(ca.jacobian(d, q))]),
            ca.Function("distances_hess", [q, multipliers], [ca.cse(hessian)]),
        )

    @classmethod
    def from_obstacles(
        cls, geometry: CollisionGeometry, pair: int, center_of_mass: ca.Function
    ) -> DistanceRows:
        """Derive the row of a link and an obstacle; ``center_of_mass`` is ``q -> r_BC``, of SX."""
        robot = geometry.robot
        n = len(robot.joint_names)
        y, w, multiplier = ca.SX.sym("y", n + 4), ca.SX.sym("w", 12), ca.SX.sym("lambda")
        q, X = y[:n], y[n:]
        link, obstacle = (geometry.solids[i] for i in geometry.pairs[pair])
        R_BL, r_BL = _pose_of_link(
            robot, link, chain_of(robot, link.body), joint_positions(robot, q)
        )
        R_X = symbolic_rotations.matrix_from_quaternion(X / ca.norm_2(X))
        of_link = R_X @ R_BL, R_X @ (r_BL - center_of_mass(q))
        of_world = ca.reshape(w[:9], 3, 3), w[9:]
        d = _smooth_distance((Form.of(link), Form.of(obstacle)), [of_link, of_world])
        hessian = ca.hessian(multiplier * d, y)[0]
        return cls(
            ca.Function("distances", [y, w], [ca.cse(d)]),
            ca.Function("distances_jac", [y, w], [ca.cse(ca.jacobian(d, y))]),
            ca.Function("distances_hess", [y, w, multiplier], [ca.cse(hessian)]),
            is_of_obstacle=True,
        )


def world_values(R_0W: Array, r_0W: Array) -> Array:
    """Return the numbers (12,) of a pose of the world, seen from the centre of mass at the start:
    ``R_0W`` (3, 3), column after column, and ``r_0W`` (3,), m.
    """
    return np.concatenate([R_0W.T.ravel(), r_0W])


def _row(robot: RobotDescription, first: Solid, second: Solid, q: ca.SX) -> ca.SX:
    forms = Form.of(first), Form.of(second)
    return _smooth_distance(forms, _relative_poses(robot, first, second, q))


def _smooth_distance(forms: tuple[Form, Form], poses: Sequence[tuple[ca.SX, ca.SX]]) -> ca.SX:
    """Return the approximate distance of two forms, whose links are at poses in one frame, m."""
    values = []
    for balls, field in ball_and_field_roles(*forms):
        R_a, r_a = poses[balls]
        R_b, r_b = poses[field]
        for point in forms[balls].balls:
            x = R_b.T @ (r_a + R_a @ ca.DM(point) - r_b)
            values.append(forms[field].field(x) - forms[balls].radius)
    return _smooth_minimum(ca.vertcat(*values), SHARPNESS_OF_MINIMUM)


def ball_and_field_roles(first: Form, second: Form) -> list[tuple[int, int]]:
    """Return which of two forms are balls and which are fields."""
    if first.is_rod and second.is_rod:
        return [(0, 1)] if len(first.balls) <= len(second.balls) else [(1, 0)]
    if first.is_rod or second.is_rod:
        return [(0, 1)] if first.is_rod else [(1, 0)]
    # An edge of either may be inside the other.
    return [(0, 1), (1, 0)]


def _relative_poses(
    robot: RobotDescription, first: Solid, second: Solid, q: ca.SX
) -> list[tuple[ca.SX, ca.SX]]:
    """Return the poses of the links of two solids in the last body that carries both."""
    theta = joint_positions(robot, q)
    chains = [chain_of(robot, each.body) for each in (first, second)]
    common = len([1 for a, b in zip(*chains, strict=False) if a == b])
    return [
        _pose_of_link(robot, solid, chain[common:], theta)
        for solid, chain in zip((first, second), chains, strict=True)
    ]


def _pose_of_link(
    robot: RobotDescription, solid: Solid, chain: Sequence[int], theta: ca.SX
) -> tuple[ca.SX, ca.SX]:
    """Return the pose of a solid's link in the body that carries the first of a chain."""
    R, r = ca.SX.eye(3), ca.SX(3, 1)
    for index in chain:
        body = robot.bodies[index]
        joint = body.joint
        if joint is None:
            continue
        r = r + R @ ca.sparsify(ca.DM(body.origin.r))
        R = R @ ca.sparsify(ca.DM(body.origin.R))
        if joint.kind is JointKind.PRISMATIC:
            r = r + R @ ca.sparsify(ca.DM(joint.axis)) * theta[index - 1]
        else:
            R = R @ symbolic_rotations.matrix_about_axis(joint.axis, theta[index - 1])
    _, pose = robot.frames[solid.link]
    return R @ ca.sparsify(ca.DM(pose.R)), r + R @ ca.DM(pose.r)


def chain_of(robot: RobotDescription, body: int) -> list[int]:
    """Return the bodies from the base out to one."""
    chain = []
    while body >= 0:
        chain.append(body)
        body = robot.bodies[body].parent
    return chain[::-1]
