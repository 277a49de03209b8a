"""Planar robots, and how far a path of shapes turns their base: the geometric phase of paper 3.

All joints turn about parallel axes and nothing couples to other axes. The attitude is then one
angle theta about that axis, and at zero angular momentum ``theta_dot = -s(psi)' psi_dot`` (eq. 3):
``s`` is the component about the axis of the mechanical connection. The turn along a path of shapes
is the line integral of ``-s``, eq. (11): it depends on the path and not on the speed.
"""

from __future__ import annotations

import itertools
import math

import casadi as ca
import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, JointKind

_OUT_OF_PLANE = 1e-5
"""Largest tilt of an axis, and turn about other axes a radian of a joint, that counts as planar:
as much as angles written with six digits leave."""

_SAMPLES = 8
"""Shapes at which a robot is asked whether it stays in its plane."""

_PANEL = 0.5
"""Longest piece of a leg that one Gauss rule integrates, rad."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(10)
_NODES, _WEIGHTS = (_NODES + 1) / 2, _WEIGHTS / 2


def planar_axis(robot: SpaceRobot) -> Array:
    """Return the unit vector (3,), base components, that a planar robot of three links turns about.

    Its largest component is positive, however the joints are oriented.

    Raises
    ------
    PlanningError
        The robot has fewer than three links or is not planar; the sentence names the joint.
    """
    name, bodies = robot.description.name, robot.description.bodies
    if len(bodies) < 3:
        raise PlanningError(
            f"Robot '{name}' has {len(bodies)} link(s) that move against each other: with fewer "
            "than three, motions of the joints cannot reorient a planar robot (paper 3, section "
            "III)."
        )
    axes: list[Array] = []
    rotations = [np.eye(3)]
    for body, joint in zip(bodies[1:], robot.description.movable_joints, strict=True):
        if joint.kind is JointKind.PRISMATIC:
            raise PlanningError(
                f"Robot '{name}' is not planar in the sense of paper 3: joint '{joint.name}' "
                "slides, and all joints must turn about parallel axes."
            )
        # Joints about parallel axes leave all axes where they are: one shape tells.
        rotations.append(rotations[body.parent] @ body.origin.R)
        axes.append(rotations[-1] @ joint.axis)
        if np.linalg.norm(np.cross(axes[0], axes[-1])) > _OUT_OF_PLANE:
            raise PlanningError(
                f"Robot '{name}' is not planar: the axis of joint '{joint.name}' is not parallel "
                f"to that of joint '{robot.joint_names[0]}'."
            )
    axis = axes[0] * math.copysign(1.0, axes[0][np.argmax(np.abs(axes[0]))])
    _require_turn_about(robot, axis)
    return axis


def _require_turn_about(robot: SpaceRobot, axis: Array) -> None:
    """Refuse masses off the plane and products of inertia that tilt the base."""
    # The tilt is a ratio of trigonometric polynomials of the shape: it is zero everywhere or
    # almost nowhere, and a few shapes in general position tell which.
    shapes = np.outer(np.arange(1, _SAMPLES + 1), np.sqrt(np.arange(2, robot.n + 2)))
    A = robot.function("connection", compile=False)(shapes.T).full()[3:]
    tilts = np.linalg.norm(A - np.outer(axis, axis @ A), axis=0).reshape(_SAMPLES, robot.n)
    worst = np.unravel_index(np.argmax(tilts), tilts.shape)
    if tilts[worst] > _OUT_OF_PLANE:
        raise PlanningError(
            f"Robot '{robot.description.name}' is not planar: joint "
            f"'{robot.joint_names[worst[1]]}' also turns the base about other axes than its own, "
            f"by up to {tilts[worst]:.2g} rad a rad; mass centres outside of one plane or products "
            "of inertia do that."
        )


class PlanarPhase:
    """Turns of the base of a planar robot about its axis, rad, by paths of the shape.

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
        """Unit vector (3,) that positive angles turn about, base components."""
        psi = ca.SX.sym("psi", robot.n)
        D, D_q = robot.function("locked_inertia", compile=False)(psi)
        axis = ca.DM(self.axis)
        # A = D^-1 D_q, where nothing couples the axis to the others: s_i = N_i / D, as printed.
        s = (axis.T @ D_q).T / (axis.T @ D @ axis)
        slope = ca.jacobian(s, psi)
        self._s = ca.Function("s", [psi], [ca.densify(s)])
        # Rotations about one axis commute: the curvature is the curl alone.
        self._curl = {
            (i, j): ca.Function("curl", [psi], [ca.densify(slope[i, j] - slope[j, i])])
            for i, j in itertools.combinations(range(robot.n), 2)
        }

    def curvature(self, shapes: Array, i: int, j: int) -> Array:
        """Return the turn of the base an area of small loops in (psi_i, psi_j), 1/rad, (K,).

        ``shapes`` (K, n), i < j, loops counter-clockwise. It is ``-H``,
        ``H = ds_j/dpsi_i - ds_i/dpsi_j`` (eq. 10).
        """
        curl: Array = self._curl[i, j](shapes.T).full()
        return curl[0]

    def legs(self, starts: Array, ends: Array) -> Array:
        """Return the turns (L,) along straight legs of the shape, ``starts`` and ``ends`` (L, n).

        Gauss-Legendre quadrature of ``-s' dpsi`` in pieces of at most half a radian.
        """
        moves = ends - starts
        count = max(1, math.ceil(np.abs(moves).max(initial=0.0) / _PANEL))
        along = ((np.arange(count)[:, np.newaxis] + _NODES) / count).ravel()
        weights = np.tile(_WEIGHTS, count) / count
        shapes = starts[:, np.newaxis] + along[:, np.newaxis] * moves[:, np.newaxis]
        s = self._s(shapes.reshape(-1, starts.shape[1]).T).full().T.reshape(shapes.shape)
        return np.asarray(-np.einsum("p,lpn,ln->l", weights, s, moves))
