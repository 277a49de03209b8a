"""Pair distances as smooth functions of the configuration for a solver, from separating planes.

For two convex solids at given poses, a plane touches the first solid at its point nearest to the
second solid, and moves with the first solid. The distance of the second solid's nearest point from
this plane equals the distance between the solids (or minus the penetration depth) at these poses
and, to first order, near them. The planes are recomputed for every path that a solver finds.

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
from spacerobot_ros.model.kinematics import TreeKinematics, tree_kinematics

PLANE_SIZE = 7
"""Number of entries for a plane and a point."""


@dataclass(frozen=True)
class PlaneDistances:
    """Distances of pairs of solids, measured from planes between them, with derivatives.

    ``w`` (7, P) contains, for each pair, the unit normal (3,) of the plane and its distance from
    the origin, m, in the first link frame, and the point (3,), m, in the second link frame. For an
    obstacle, the plane is given in the centre-of-mass frame with the initial base attitude, and the
    point in the link frame.

    Attributes
    ----------
    values
        ``(y, w) -> d`` (P,), m, of ``y = [q; X]`` (n + 4), X of any norm and for obstacles only.
    jacobian
        ``(y, w) -> d, J``, with ``J = dd/dy`` (P, n + 4).
    hessian
        ``(y, w, lambda) -> lambda' J, H``, with the Hessian H (n + 4, n + 4) of ``lambda' d``.
    """

    values: ca.Function
    jacobian: ca.Function
    hessian: ca.Function

    @classmethod
    def of(cls, geometry: CollisionGeometry, pairs: Sequence[int]) -> PlaneDistances:
        """Derive the distances of pairs, given by index.

        They are derived together: they share kinematics, and a call costs as much as a distance.
        """
        tree, count = tree_kinematics(geometry.robot), len(pairs)
        size, X = tree.n + 4, ca.SX.sym("X", 4)
        y, w = ca.SX.sym("y", size), ca.SX.sym("w", PLANE_SIZE, count)
        multipliers = ca.SX.sym("lambda", count)
        d, J, H = ca.SX(count, 1), ca.SX(count, size), ca.SX(size, size)
        for row, (pair, plane) in enumerate(zip(pairs, ca.horzsplit(w), strict=True)):
            first, second = (geometry.solids[i] for i in geometry.pairs[pair])
            if geometry.with_obstacles[pair]:
                d[row], J[row, :], bend = _from_obstacle(tree, X, first, plane)
            else:
                d[row], J[row, : tree.n], bend = _between_links(tree, first, second, plane)
            H[: bend.size1(), : bend.size1()] += multipliers[row] * bend
        q_X_w, at = [tree.q, X, w], [y[: tree.n], y[tree.n :], w]
        of = ca.Function("distances", [*q_X_w, multipliers], [d, J, multipliers.T @ J, H])
        d, J, slope, H = of(*at, multipliers)
        return cls(
            ca.Function("distances", [y, w], [d]),
            ca.Function("distances_jac", [y, w], [d, J]),
            ca.Function("distances_hess", [y, w, multipliers], [slope, H]),
        )


Derivatives = tuple[ca.SX, ca.SX, ca.SX]
"""A distance, its derivatives (1, ...), and its Hessian."""


def _from_obstacle(tree: TreeKinematics, X: ca.SX, link: Solid, plane: ca.SX) -> Derivatives:
    """Return the distance of a link from the plane of an obstacle, and derivatives by [q; X]."""
    R, r, _ = tree.frame(link.link)
    R_X = symbolic_rotations.matrix_from_quaternion(X / ca.norm_2(X))
    d = ca.dot(plane[:3], R_X @ (r + R @ plane[4:] - tree.r_BC_B)) - plane[3]
    hessian, gradient = ca.hessian(d, ca.vertcat(tree.q, X))
    return d, gradient.T, hessian


def _between_links(tree: TreeKinematics, first: Solid, second: Solid, plane: ca.SX) -> Derivatives:
    """Return the distance of the second link from the plane of the first, and derivatives by q.

    The joints between the links form a chain, along which the first link is at rest: joint i moves
    the point P by ``a_i x (P - p_i)``, and turns the motions by the joints after it.
    """
    (R_A, r_A, body_A), (R_P, r_P, body_P) = tree.frame(first.link), tree.frame(second.link)
    normal, point = R_A @ plane[:3], r_P + R_P @ plane[4:]
    chain_A, chain_P = tree.ancestors(body_A), tree.ancestors(body_P)
    chain = [(k, -1) for k in reversed(chain_A) if k not in chain_P]
    chain += [(k, 1) for k in chain_P if k not in chain_A]
    slope = ca.SX(tree.moving_body_count, 1)
    bend = ca.SX(tree.moving_body_count, tree.moving_body_count)
    turned: list[tuple[int, ca.SX]] = []
    for k, sign in chain:
        motion = axis = sign * tree.axis[k]
        if tree.is_revolute(k):
            motion = ca.cross(axis, point - tree.p[k])
            turned.append((k, ca.cross(normal, axis)))
        slope[k - 1] = ca.dot(normal, motion)
        for before, turning in turned:
            bend[before - 1, k - 1] = bend[k - 1, before - 1] = ca.dot(turning, motion)
    d = ca.dot(normal, point - r_A) - plane[3]
    return d, tree.gather(slope).T, tree.gather(tree.gather(bend).T)


_EDGE_ROUNDING = 0.03
"""Length, m, over which projection corners are smoothed; distances become slightly smaller."""


def support_distance(
    geometry: CollisionGeometry, pair: int, center_of_mass: ca.Function
) -> ca.Function:
    """Return ``(y, plane) -> d``, m: the distance of the entire second solid from a plane.

    The plane is given as in :class:`PlaneDistances`, the point is not used, and ``y = q``. For an
    obstacle the plane is in W, and ``y = [q; X; r]`` (n + 7) contains the rotation of the base and
    the position of the centre of mass. The solid is represented by its rounded box, whose extent
    along the normal is ``sum h_i |n e_i| + radius``. So the distance is valid for any rotation, and
    underestimates the distance of the shape in the box.
    """
    tree, of_obstacle = tree_kinematics(geometry.robot), bool(geometry.with_obstacles[pair])
    n = tree.n
    y, plane = ca.SX.sym("y", n + 7 if of_obstacle else n), ca.SX.sym("plane", PLANE_SIZE)
    first, second = (geometry.solids[i] for i in geometry.pairs[pair])
    solid = first if of_obstacle else second
    R, r, _ = tree.frame(solid.link)
    if of_obstacle:
        X, r_C = y[n : n + 4], y[n + 4 :]
        R_X = symbolic_rotations.matrix_from_quaternion(X / ca.norm_2(X))
        R, r = R_X @ R, r_C + R_X @ (r - center_of_mass(tree.q))
    else:
        R_A, r_A, _ = tree.frame(first.link)
        R, r = R_A.T @ R, R_A.T @ (r - r_A)
    R, r = ca.substitute([R, r], [tree.q], [y[:n]])
    normal = plane[:3]
    box = solid.enclosure
    along = ca.DM(box.pose.R).T @ R.T @ normal
    extent = ca.dot(ca.DM(box.half), ca.sqrt(along**2 + _EDGE_ROUNDING**2)) + box.radius
    d = ca.dot(normal, r + R @ ca.DM(box.pose.r)) - extent - plane[3]
    return ca.Function("support", [y, plane], [ca.cse(d)])
