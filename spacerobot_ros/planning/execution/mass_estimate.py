"""What the motion of a base tells of the masses of its robot, and of where it will be at the end.

At zero momentum the base turns by the shape's path and by ratios of masses and inertias alone. So
where it turns otherwise than predicted, these are not quite the model's. The estimate is linear
(Gauss-Newton about the model): to first order in the errors of masses and inertias, all deviations
of a base path are sums of their sensitivities, and the least squares of many noisy poses say which.
"""

from __future__ import annotations

from functools import cached_property

import casadi as ca
import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import hat, matrix_from_quaternion
from spacerobot_ros.planning.core.schedule import GaitSchedule

_SHAPES = 48
"""The model is called for so many shapes along a path, at most."""

_STEP = 1e-6
"""Relative step of the difference quotients."""

_SPREAD = 0.1
"""Standard deviation of the factors by which masses and inertias differ from the model's."""

_NOISE = 1e-3
"""Standard deviation of a measured pose, rad and m."""


class PathSensitivity:
    """How a base path depends on masses and inertias: P parameters, two a body.

    Each is a relative error, of the mass or of the tensor of inertia of one body.

    Parameters
    ----------
    robot
        The model that has predicted the path.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        self._robot = robot
        self.count = 2 * len(robot.description.bodies)

    @cached_property
    def _model(self) -> tuple[ca.Function, Array]:
        """What turns the base by its shape, and the centre of mass, of robots that weigh otherwise;
        and the arguments (k, 1 + P) that make them so.
        """
        robot, bodies = self._robot, self.count // 2
        factors = 1 + np.vstack([np.zeros(self.count), _STEP * np.eye(self.count)])
        weighing = robot.inertial.scaled(factors[:, :bodies], factors[:, bodies:])
        model, arguments = robot.symbolic_model(weighing)
        q, p = ca.SX.sym("q", robot.n), ca.SX.sym("p", arguments.shape[1])
        connection = ca.reshape(model.function("connection", compile=False)(q, p), 6, robot.n)
        center = model.function("center_of_mass", compile=False)(q, p)
        return ca.Function("model", [q, p], [ca.vec(-connection[3:, :]), center]), arguments.T

    def _derivatives(self, shapes: Array) -> tuple[Array, Array]:
        """Return the derivatives, by the parameters, of the turn by each joint (M, n, 3, P), in
        base components, and of the centre of mass (M, 3, P) in shapes (M, n).
        """
        model, arguments = self._model
        robots = arguments.shape[1]
        of_all = model.map(len(shapes) * robots)(
            np.repeat(shapes, robots, axis=0).T, np.tile(arguments, len(shapes))
        )
        turns, centers = (np.asarray(each).T.reshape(len(shapes), robots, -1) for each in of_all)
        by_turn, by_center = (
            (each[:, 1:] - each[:, :1]).transpose(0, 2, 1) / _STEP for each in (turns, centers)
        )
        return by_turn.reshape(len(shapes), self._robot.n, 3, self.count), by_center

    def along(self, schedule: GaitSchedule) -> Array:
        """Return the derivatives (K, 6, P) of the poses of a schedule's predicted path.

        Displacements (m) over turns (rotation vectors, rad), all in W; where the path begins is
        known.
        """
        path = schedule.path
        knots = len(path.time)
        ticks = (path.time / schedule.control_period).round().astype(int)
        shapes = schedule.positions[ticks]
        R = np.array([matrix_from_quaternion(each) for each in path.quaternion])
        # The model changes little from shape to shape: it is called for some, and interpolated.
        instants: Array = np.arange(knots, dtype=float)
        called = np.unique(np.linspace(0, knots - 1, _SHAPES).round().astype(int))
        turns, centers = self._derivatives(shapes[called])
        by_joint = _interpolated(instants[:-1] + 0.5, called, turns)
        in_base = np.einsum("kjap,kj->kap", by_joint, np.diff(shapes, axis=0))
        by_way = (R[:-1] + R[1:]) / 2 @ in_base
        turned = np.concatenate([np.zeros((1, *by_way.shape[1:])), np.cumsum(by_way, axis=0)])
        # The centre of mass of the system stays where it is: r = r_cm - R c.
        arms = [hat(A @ self._robot.center_of_mass(q)) for A, q in zip(R, shapes, strict=True)]
        moved = np.array(arms) @ turned - R @ _interpolated(instants, called, centers)
        return np.concatenate([moved - moved[0], turned], axis=1)


def _interpolated(at: Array, known: Array, values: Array) -> Array:
    """Return values (M, ...) that are known at M instants, linearly in between."""
    place = np.interp(at, known, np.arange(len(known)))
    before = np.clip(place.astype(int), 0, max(len(known) - 2, 0))
    share = (place - before).reshape(-1, *[1] * (values.ndim - 1))
    after = np.minimum(before + 1, len(known) - 1)
    return np.asarray((1 - share) * values[before] + share * values[after])


class MassEstimate:
    """The errors of masses and inertias (P,) that explain the deviations from paths so far.

    Each path has an offset of its own, as where it begins is measured; it is left out of account.

    Parameters
    ----------
    count
        P.
    """

    def __init__(self, count: int) -> None:
        self._known = (_NOISE / _SPREAD) ** 2 * np.eye(count)
        self._told = np.zeros(count)
        self._errors: Array | None = None
        self._begin()

    def _begin(self) -> None:
        count = len(self._told)
        self._poses = 0
        self._sum_J, self._sum_y = np.zeros((6, count)), np.zeros(6)
        self._squares, self._products = np.zeros((count, count)), np.zeros(count)

    def next_path(self) -> None:
        """Begin with another path; what was learnt is kept."""
        self._known, self._told = self._sums()
        self._begin()

    def add(self, sensitivity: Array, deviation: Array) -> None:
        """Add a pose that deviates by (6,) where the path has the sensitivity (6, P)."""
        self._poses += 1
        self._sum_J += sensitivity
        self._sum_y += deviation
        self._squares += sensitivity.T @ sensitivity
        self._products += sensitivity.T @ deviation
        self._errors = None

    @property
    def errors(self) -> Array:
        """The relative errors (P,) of masses, then of inertias."""
        if self._errors is None:
            self._errors = np.asarray(np.linalg.solve(*self._sums()))
        return self._errors

    def _sums(self) -> tuple[Array, Array]:
        """Return the normal equations, without what an offset explains."""
        n = max(self._poses, 1)
        squares = self._squares - self._sum_J.T @ self._sum_J / n
        products = self._products - self._sum_J.T @ self._sum_y / n
        return self._known + squares, self._told + products
