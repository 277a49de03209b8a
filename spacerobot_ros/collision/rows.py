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

Rows of a second kind are distances from planes (:meth:`DistanceRows.of_planes`). Between two convex
solids at given poses there is a plane that touches the first one where it is nearest to the second,
and moves with it. The distance of the nearest point of the second one from that plane is that of
the solids at these poses, or less the depth of their contact, and near them to first order. Such
rows are exact and cheap, and are made anew along every path that a solver has found (J. Schulman
and others, "Motion planning with sequential convex optimization and convex collision checking",
International Journal of Robotics Research 33, 2014).

Smooth rows of links are in C, too: ``rows.c`` with the tables of one robot, for all of its pairs.
Its formulas are the same with derivatives by hand, which take a tenth of the time of CasADi's.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.collision.geometry import CollisionGeometry, Solid
from spacerobot_ros.collision.rounded_box import RoundedBox
from spacerobot_ros.model import symbolic_rotations
from spacerobot_ros.model.compilation import compiled_functions
from spacerobot_ros.model.description import Array, JointKind, Pose, RobotDescription
from spacerobot_ros.model.kinematics import joint_positions

SHARPNESS_OF_MINIMUM, SHARPNESS_OF_FACES = 300.0, 150.0
"""Sharpness of smooth minima over balls and of smooth maxima over faces, 1/m."""

PLANE_SIZE = 7
"""Numbers of a plane and a point."""

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
class SmoothForm:
    """The form of a solid in rows: a rounded box in the frame of its link, and balls in it.

    ``ball_centers`` are the middles (K, 3), m, in the frame of the link, of balls of ``radius``.
    """

    box: RoundedBox
    ball_centers: Array
    radius: float

    @property
    def is_rod(self) -> bool:
        """Whether the box is a rod: it has a length alone."""
        return bool(np.count_nonzero(self.box.half) < 2)

    @classmethod
    def of(cls, solid: Solid) -> SmoothForm:
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
    def _rod(cls, box: RoundedBox) -> SmoothForm:
        longest = int(np.argmax(box.half))
        half = box.half[longest]
        count = int(
            np.clip(np.ceil(2 * half / (_BALL_SPACING * box.radius + 1e-9)), 0, _MAX_BALLS - 1)
        )
        points = np.zeros((count + 1, 3))
        points[:, longest] = np.linspace(-half, half, count + 1) if count else 0.0
        return cls(box, _moved(box.pose, points), box.radius)

    def smooth_distance(self, x: ca.SX) -> ca.SX:
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
        place of q, with a quaternion X of any norm, and the numbers ``w``
        (:func:`world_pose_parameters`) after that.
    is_plane
        Whether the row is the distance from a plane: ``w`` are then its numbers (7,), a unit normal
        (3,) and the distance from the origin, m, in the frame of the first link, and the point
        (3,), m, in that of the second one. Of an obstacle the plane is in the frame of the centre
        of mass with the attitude of the base at the start, and the point in that of the link.
    """

    values: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    is_of_obstacle: bool = False
    is_plane: bool = False

    @classmethod
    def of(cls, geometry: CollisionGeometry, pairs: Sequence[int]) -> DistanceRows:
        """Derive the rows of pairs, given by their numbers."""
        robot = geometry.robot
        q = ca.SX.sym("q", len(robot.joint_names))
        multipliers = ca.SX.sym("lambda", len(pairs))
        solids = geometry.solids
        rows = [
            _distance_row(robot, solids[i], solids[j], q)
            for i, j in geometry.pairs[list(pairs)].tolist()
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
    def of_planes(
        cls, geometry: CollisionGeometry, pair: int, center_of_mass: ca.Function
    ) -> DistanceRows:
        """Derive the distance of a pair from its plane; ``center_of_mass`` as for obstacles."""
        robot, of_obstacle = geometry.robot, bool(geometry.with_obstacles[pair])
        n = len(robot.joint_names)
        y, plane = ca.SX.sym("y", n + 4 if of_obstacle else n), ca.SX.sym("plane", PLANE_SIZE)
        multiplier, q = ca.SX.sym("lambda"), y[:n]
        normal, offset, point = plane[:3], plane[3], plane[4:]
        first, second = (geometry.solids[i] for i in geometry.pairs[pair])
        if of_obstacle:
            chain, X = chain_of(robot, first.body), y[n:]
            R_BL, r_BL = _pose_of_link(robot, first, chain, joint_positions(robot, q))
            R_X = symbolic_rotations.matrix_from_quaternion(X / ca.norm_2(X))
            x = R_X @ (r_BL + R_BL @ point - center_of_mass(q))
        else:
            (R_A, r_A), (R_P, r_P) = _relative_poses(robot, first, second, q)
            x = R_A.T @ (r_P + R_P @ point - r_A)
        d = ca.dot(normal, x) - offset
        hessian = ca.hessian(multiplier * d, y)[0]
        return cls(
            ca.Function("distances", [y, plane], [ca.cse(d)]),
            ca.Function("distances_jac", [y, plane], [ca.cse(ca.jacobian(d, y))]),
            ca.Function("distances_hess", [y, plane, multiplier], [ca.cse(hessian)]),
            of_obstacle,
            is_plane=True,
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
        d = _smooth_distance((SmoothForm.of(link), SmoothForm.of(obstacle)), [of_link, of_world])
        hessian = ca.hessian(multiplier * d, y)[0]
        return cls(
            ca.Function("distances", [y, w], [ca.cse(d)]),
            ca.Function("distances_jac", [y, w], [ca.cse(ca.jacobian(d, y))]),
            ca.Function("distances_hess", [y, w, multiplier], [ca.cse(hessian)]),
            is_of_obstacle=True,
        )


def world_pose_parameters(R_0W: Array, r_0W: Array) -> Array:
    """Return the numbers (12,) of a pose of the world, seen from the centre of mass at the start:
    ``R_0W`` (3, 3), column after column, and ``r_0W`` (3,), m.
    """
    return np.concatenate([R_0W.T.ravel(), r_0W])


def _distance_row(robot: RobotDescription, first: Solid, second: Solid, q: ca.SX) -> ca.SX:
    forms = SmoothForm.of(first), SmoothForm.of(second)
    return _smooth_distance(forms, _relative_poses(robot, first, second, q))


def _smooth_distance(
    forms: tuple[SmoothForm, SmoothForm], poses: Sequence[tuple[ca.SX, ca.SX]]
) -> ca.SX:
    """Return the approximate distance of two forms, whose links are at poses in one frame, m."""
    values = []
    for balls, field in ball_and_field_roles(*forms):
        R_a, r_a = poses[balls]
        R_b, r_b = poses[field]
        for point in forms[balls].ball_centers:
            x = R_b.T @ (r_a + R_a @ ca.DM(point) - r_b)
            values.append(forms[field].smooth_distance(x) - forms[balls].radius)
    return _smooth_minimum(ca.vertcat(*values), SHARPNESS_OF_MINIMUM)


def ball_and_field_roles(first: SmoothForm, second: SmoothForm) -> list[tuple[int, int]]:
    """Return which of two forms are balls and which are fields."""
    if first.is_rod and second.is_rod:
        return [(0, 1)] if len(first.ball_centers) <= len(second.ball_centers) else [(1, 0)]
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


# -- in C -----------------------------------------------------------------------------------------

_SOURCE = Path(__file__).with_name("rows.c")

_STRUCTURES = """
#include <math.h>
typedef struct { int joint, slides; double factor, offset, axis[3], R[9], r[3]; } Step;
typedef struct {
  int rod, first_step, steps, first_ball, balls;
  double radii, half[3], R[9], r[3];
} Role;
typedef struct { int first_role, roles; } Pair;
"""
"""The structures of the tables: a joint and the pose behind it; balls in a field; a pair."""


@dataclass(frozen=True)
class _JointStep:
    """A joint on the way from a field to balls, and the fixed pose behind it.

    Attributes
    ----------
    index
        Number of the body that the joint carries.
    forward
        Whether the way goes from the parent to the body; else back.
    behind
        The next frame in that behind the joint.
    """

    index: int
    is_outward: bool
    fixed_pose_after_joint: Pose


class CompiledRows:
    """Rows of pairs of links of one robot in C."""

    def __init__(self, geometry: CollisionGeometry, functions: Sequence[ca.Function]) -> None:
        self._geometry, self._functions = geometry, functions

    @classmethod
    def of(cls, geometry: CollisionGeometry) -> CompiledRows | None:
        """Compile the rows of all link pairs, or take them from the cache; None: no compiler."""
        pairs = np.flatnonzero(~geometry.with_obstacles).tolist()
        if not pairs:
            return None
        names = ("link_distance", "link_distance_jac", "link_distance_hess")
        functions = compiled_functions(
            _source(geometry), names, lambda: _rows_of_pair(geometry, pairs[0], names)
        )
        return None if functions is None else cls(geometry, functions)

    def rows(self, pair: int) -> DistanceRows:
        """Return the rows of a pair, by its number."""
        robot, solids = self._geometry.robot, self._geometry.solids
        q, multiplier = ca.MX.sym("q", len(robot.joint_names)), ca.MX.sym("lambda")
        value, jacobian, hessian = self._functions
        first, second = (solids[i] for i in self._geometry.pairs[pair])
        bodies = [index for index, _ in _joints_between(robot, first.body, second.body)]
        moving = np.abs(robot.coupling[0][np.array(bodies) - 1]).any(axis=0)
        return DistanceRows(
            ca.Function("distances", [q], [value(q, pair)]),
            ca.Function(
                "distances_jac", [q], [_without_zero_entries(jacobian(q, pair), moving[np.newaxis])]
            ),
            ca.Function(
                "distances_hess",
                [q, multiplier],
                [_without_zero_entries(hessian(q, pair, multiplier), np.outer(moving, moving))],
            ),
        )


def _rows_of_pair(
    geometry: CollisionGeometry, pair: int, names: tuple[str, str, str]
) -> list[ca.Function]:
    """Return functions of CasADi, by their names in C, that are right for one pair."""
    rows = DistanceRows.of(geometry, [pair])
    q, number = ca.MX.sym("q", len(geometry.robot.joint_names)), ca.MX.sym("pair")
    multiplier = ca.MX.sym("lambda")
    curvature = ca.densify(rows.hessian(q, multiplier))
    return [
        ca.Function(names[0], [q, number], [rows.values(q)]),
        ca.Function(names[1], [q, number], [ca.densify(rows.jacobian(q))]),
        ca.Function(names[2], [q, number, multiplier], [curvature]),
    ]


def _source(geometry: CollisionGeometry) -> str:
    """Return the C of one robot."""
    tables = _Tables(geometry.robot)
    for pair, of_obstacle in enumerate(geometry.with_obstacles):
        links = [] if of_obstacle else [geometry.solids[i] for i in geometry.pairs[pair]]
        tables.add(links)
    return f"{_STRUCTURES}{tables.text()}\n{_SOURCE.read_text('utf-8')}"


class _Tables:
    """The tables of ``rows.c``: each line is a structure."""

    def __init__(self, robot: RobotDescription) -> None:
        self._robot = robot
        self._pairs: list[str] = []
        self._roles: list[str] = []
        self._steps: list[str] = []
        self._balls: list[str] = []
        self._most_steps = self._most_balls = 1

    def add(self, links: Sequence[Solid]) -> None:
        """Add a pair of links; of none, one without rows."""
        forms = [SmoothForm.of(each) for each in links]
        roles = ball_and_field_roles(forms[0], forms[1]) if forms else []
        self._pairs.append(_structure([len(self._roles), len(roles)]))
        for balls, field in roles:
            self._add_role(links[balls], forms[balls], links[field], forms[field])

    def _add_role(
        self, solid: Solid, form: SmoothForm, field_solid: Solid, field: SmoothForm
    ) -> None:
        first, way = _joints_between_links(self._robot, field_solid, field, solid)
        places = [len(self._steps), len(way), len(self._balls), len(form.ball_centers)]
        numbers = [field.box.radius + form.radius, *field.box.half, *first.R.ravel(), *first.r]
        self._roles.append(_structure([int(field.is_rod), *places], numbers))
        self._steps += [self._step(each) for each in way]
        self._balls += [_structure([], each) for each in form.ball_centers]
        self._most_steps = max(self._most_steps, len(way))
        self._most_balls = max(self._most_balls, len(form.ball_centers))

    def _step(self, step: _JointStep) -> str:
        joint, (G, b) = self._robot.bodies[step.index].joint, self._robot.coupling
        assert joint is not None
        row, sign = step.index - 1, 1.0 if step.is_outward else -1.0
        coordinate = int(np.argmax(np.abs(G[row])))
        slides = joint.kind is JointKind.PRISMATIC
        moved = [sign * G[row, coordinate], sign * b[row], *joint.axis]
        behind = [*step.fixed_pose_after_joint.R.ravel(), *step.fixed_pose_after_joint.r]
        return _structure([coordinate, int(slides)], [*moved, *behind])

    def text(self) -> str:
        """Return the C."""
        numbers = {
            "JOINTS": len(self._robot.joint_names),
            "MOST_STEPS": self._most_steps,
            "MOST_BALLS": self._most_balls,
            "SHARPNESS_OF_MINIMUM": SHARPNESS_OF_MINIMUM,
            "SHARPNESS_OF_FACES": SHARPNESS_OF_FACES,
            "SQUARE_ROOT_OFFSET": SQUARE_ROOT_OFFSET,
        }
        tables = {
            "Pair PAIRS[]": self._pairs,
            "Role ROLES[]": self._roles,
            "Step STEPS[]": self._steps,
            "double BALLS[][3]": self._balls,
        }
        lines = [f"#define {name} {number!r}" for name, number in numbers.items()]
        for name, entries in tables.items():
            lines += [f"static const {name} = {{", *(f"  {each}," for each in entries), "};"]
        return "\n".join(lines)


def _structure(integers: Sequence[int], numbers: Iterable[float] = ()) -> str:
    """Return a structure, or an array of numbers, with no digit lost."""
    values = [str(each) for each in integers] + [float(each).hex() for each in numbers]
    return f"{{{', '.join(values)}}}"


def _joints_between_links(
    robot: RobotDescription, field_solid: Solid, field: SmoothForm, solid: Solid
) -> tuple[Pose, list[_JointStep]]:
    """Return the way from the frame of a field to the link of a solid: a pose, and the joints."""
    pose_of_field = robot.frames[field_solid.link][1] @ field.box.pose
    way = _joints_between(robot, field_solid.body, solid.body)
    # Poses between the joints: those of bodies whose joints are passed outwards or back.
    fixed = [_inverse(pose_of_field)]
    for index, forward in way:
        origin = robot.bodies[index].origin
        if forward:
            fixed[-1] = fixed[-1] @ origin
            fixed.append(Pose())
        else:
            fixed.append(_inverse(origin))
    fixed[-1] = fixed[-1] @ robot.frames[solid.link][1]
    steps = [
        _JointStep(index, forward, behind)
        for (index, forward), behind in zip(way, fixed[1:], strict=True)
    ]
    return fixed[0], steps


def _joints_between(robot: RobotDescription, start: int, end: int) -> list[tuple[int, bool]]:
    """Return the bodies whose joints lie between two bodies, and whether they are passed outwards,
    from the parent to the body.
    """
    back, out = chain_of(robot, start), chain_of(robot, end)
    common = len([1 for a, b in zip(back, out, strict=False) if a == b])
    return [(i, False) for i in reversed(back[common:])] + [(i, True) for i in out[common:]]


def _without_zero_entries(matrix: ca.MX, kept: npt.NDArray[np.bool_]) -> ca.MX:
    """Return a matrix without entries that are always zero."""
    return ca.project(matrix, ca.sparsify(ca.DM(kept.astype(float))).sparsity())


def _inverse(pose: Pose) -> Pose:
    return Pose(pose.R.T, -pose.R.T @ pose.r)
