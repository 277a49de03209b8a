"""Pair distances as smooth functions of the configuration for a solver, from separating planes.

For two convex solids at given poses, a plane touches the first solid at its point nearest to the
second solid, and moves with the first solid. The distance of the second solid's nearest point from
this plane equals the distance between the solids (or minus the penetration depth) at these poses
and, to first order, near them. This distance is cheap to compute. The planes are recomputed for
every path that a solver finds.

Distances between links depend only on the configuration q. The distance of a link from an obstacle
also depends on the rotation X of the base since the start: without external force, the system's
centre of mass C is at rest or drifts steadily. In a frame at C with the initial base attitude, the
point ``r_BP(q)`` of a link is at ``X (r_BP(q) - r_BC(q))``, and the obstacle is at rest.

J. Schulman et al., "Motion planning with sequential convex optimization and convex collision
checking", International Journal of Robotics Research 33, 2014.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from spacerobot_ros.collision.distances import Solid
from spacerobot_ros.collision.geometry import CollisionGeometry
from spacerobot_ros.model import symbolic_rotations
from spacerobot_ros.model.description import JointKind, RobotDescription
from spacerobot_ros.model.kinematics import joint_positions

PLANE_SIZE = 7
"""Number of entries for a plane and a point."""


@dataclass(frozen=True)
class PlaneDistance:
    """Distance between two solids, measured from a plane between them, with derivatives.

    ``w`` (7,) is the unit normal (3,) of the plane and its distance from the origin, m, in the
    first link frame, and the point (3,), m, in the second link frame. For an
    obstacle, the plane is given in the centre-of-mass frame with the initial base attitude, and the
    point in the link frame.

    Attributes
    ----------
    values
        ``(y, w) -> d``, m, of ``y = [q; X]`` (n + 4) with a quaternion X of any norm; only the
        distance from an obstacle depends on X.
    jacobian
        ``(y, w) -> dd/dy`` (1, n + 4).
    hessian
        ``(y, w, lambda) -> `` the Hessian (n + 4, n + 4) of ``lambda d``.
    """

    values: ca.Function
    jacobian: ca.Function
    hessian: ca.Function

    @classmethod
    def of(
        cls, geometry: CollisionGeometry, pair: int, center_of_mass: ca.Function
    ) -> PlaneDistance:
        """Derive the distance function of a pair, given by index; ``center_of_mass`` is
        ``q -> r_BC``."""
        robot, n = geometry.robot, len(geometry.robot.joint_names)
        y, plane = ca.SX.sym("y", n + 4), ca.SX.sym("plane", PLANE_SIZE)
        multiplier, q = ca.SX.sym("lambda"), y[:n]
        normal, offset, point = plane[:3], plane[3], plane[4:]
        first, second = (geometry.solids[i] for i in geometry.pairs[pair])
        if geometry.with_obstacles[pair]:
            chain, X = _chain_of(robot, first.body), y[n:]
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
        )


_EDGE_ROUNDING = 0.03
"""Length, m, over which projection corners are smoothed; smoothing makes the distance slightly
smaller."""


def support_distance(
    geometry: CollisionGeometry, pair: int, center_of_mass: ca.Function
) -> ca.Function:
    """Return ``(y, plane) -> d``, m: the distance of the entire second solid from a plane.

    The plane is given as in :class:`PlaneDistance`, the point is not used, and ``y = q``. For an
    obstacle the plane is in W, and ``y = [q; X; r]`` (n + 7) contains the rotation of the base and
    the position of the centre of mass. The solid is represented by its rounded box, whose extent
    along the normal is ``sum h_i |n e_i| + radius``. So the distance is valid for any rotation, and
    underestimates the distance of the shape in the box.
    """
    robot, of_obstacle = geometry.robot, bool(geometry.with_obstacles[pair])
    n = len(robot.joint_names)
    y, plane = ca.SX.sym("y", n + 7 if of_obstacle else n), ca.SX.sym("plane", PLANE_SIZE)
    q, normal = y[:n], plane[:3]
    first, second = (geometry.solids[i] for i in geometry.pairs[pair])
    if of_obstacle:
        X, r_C = y[n : n + 4], y[n + 4 :]
        solid = first
        R, r = _pose_of_link(robot, first, _chain_of(robot, first.body), joint_positions(robot, q))
        R_X = symbolic_rotations.matrix_from_quaternion(X / ca.norm_2(X))
        R, r = R_X @ R, r_C + R_X @ (r - center_of_mass(q))
    else:
        solid = second
        (R_A, r_A), (R_P, r_P) = _relative_poses(robot, first, second, q)
        R, r = R_A.T @ R_P, R_A.T @ (r_P - r_A)
    box = solid.enclosure
    along = ca.DM(box.pose.R).T @ R.T @ normal
    extent = ca.dot(ca.DM(box.half), ca.sqrt(along**2 + _EDGE_ROUNDING**2)) + box.radius
    d = ca.dot(normal, r + R @ ca.DM(box.pose.r)) - extent - plane[3]
    return ca.Function("support", [y, plane], [ca.cse(d)])


def _relative_poses(
    robot: RobotDescription, first: Solid, second: Solid, q: ca.SX
) -> list[tuple[ca.SX, ca.SX]]:
    """Return the link poses of two solids in the outermost body that carries both."""
    theta = joint_positions(robot, q)
    chains = [_chain_of(robot, each.body) for each in (first, second)]
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


def _chain_of(robot: RobotDescription, body: int) -> list[int]:
    """Return the bodies from the base to a given body."""
    chain = []
    while body >= 0:
        chain.append(body)
        body = robot.bodies[body].parent
    return chain[::-1]
