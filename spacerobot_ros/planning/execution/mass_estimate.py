"""Estimation of errors of masses and inertias from the measured motion of the base.

At zero momentum the path of the shape and ratios of masses and inertias alone determine how the
base turns. Where it turns otherwise than predicted, the model's masses and inertias are wrong. To
first order the deviation of the base path is linear in their relative errors: a sensitivity of the
path multiplies each. Linear least squares over many noisy poses, with a prior on the errors, give
the estimate (one step of Gauss-Newton about the model).
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
"""Largest number of shapes along a path for which the model is evaluated."""

_STEP = 1e-6
"""Relative step of the finite differences."""

_SPREAD = 0.1
"""Standard deviation of the relative errors of masses and inertias, before any measurement."""

_NOISE = 1e-3
"""Standard deviation of each component of a measured pose, m or rad."""

_LARGEST = 6 * _SPREAD
"""Relative errors beyond this have another cause, such as a jump of what is measured."""


class PathSensitivity:
    """Derivatives of a base path by P parameters: relative errors of masses and inertias.

    The first P / 2 are those of the masses of the bodies, the others those of their inertia
    tensors.

    Parameters
    ----------
    robot
        The model by which the path is predicted.
    """

    def __init__(self, robot: SpaceRobot) -> None:
        self._robot = robot
        self.count = 2 * len(robot.description.bodies)

    @cached_property
    def _model(self) -> tuple[ca.Function, Array]:
        """A function of shape and inertial arguments, and the arguments (k, 1 + P) of variants.

        The function returns the angular velocity of the base per joint rate (3 n,) and the centre
        of mass (3,), both in base components. The variants are the model itself, then the model
        with each parameter changed by a small step.
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
        """Return derivatives by the parameters, for shapes (M, n), in base components.

        They are those of the turn by each joint (M, n, 3, P) and of the centre of mass (M, 3, P).
        """
        model, arguments = self._model
        variants = arguments.shape[1]
        of_all = model.map(len(shapes) * variants)(
            np.repeat(shapes, variants, axis=0).T, np.tile(arguments, len(shapes))
        )
        turns, centers = (np.asarray(each).T.reshape(len(shapes), variants, -1) for each in of_all)
        by_turn, by_center = (
            (each[:, 1:] - each[:, :1]).transpose(0, 2, 1) / _STEP for each in (turns, centers)
        )
        return by_turn.reshape(len(shapes), self._robot.n, 3, self.count), by_center

    def along(self, schedule: GaitSchedule) -> Array:
        """Return the derivatives (K, 6, P) of the K poses of a schedule's predicted path.

        The first three components are those of the position, m, the others those of the attitude
        (rotation vector, rad), all in W. The derivatives of the first pose are zero, because it is
        measured.
        """
        path = schedule.path
        knots = len(path.time)
        ticks = (path.time / schedule.control_period).round().astype(int)
        shapes = schedule.positions[ticks]
        R_WB = np.array([matrix_from_quaternion(each) for each in path.quaternion])
        # The model changes little from shape to shape: it is evaluated for some of them, and
        # interpolated in between.
        instants: Array = np.arange(knots, dtype=float)
        called = np.unique(np.linspace(0, knots - 1, _SHAPES).round().astype(int))
        turns, centers = self._derivatives(shapes[called])
        by_joint = _interpolated(instants[:-1] + 0.5, called, turns)
        in_base = np.einsum("kjap,kj->kap", by_joint, np.diff(shapes, axis=0))
        steps = (R_WB[:-1] + R_WB[1:]) / 2 @ in_base
        turned = np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])
        # The centre of mass C of the system stays where it is: r_WB = r_WC - R_WB r_BC_B.
        r_BC_W = [R @ self._robot.center_of_mass(q) for R, q in zip(R_WB, shapes, strict=True)]
        arms = np.array([hat(each) for each in r_BC_W])
        moved = arms @ turned - R_WB @ _interpolated(instants, called, centers)
        return np.concatenate([moved - moved[0], turned], axis=1)


def _interpolated(at: Array, known: Array, values: Array) -> Array:
    """Return values at instants, linearly between those (M, ...) at M known instants."""
    place = np.interp(at, known, np.arange(len(known)))
    before = np.clip(place.astype(int), 0, max(len(known) - 2, 0))
    share = (place - before).reshape(-1, *[1] * (values.ndim - 1))
    after = np.minimum(before + 1, len(known) - 1)
    return np.asarray((1 - share) * values[before] + share * values[after])


class MassEstimate:
    """Estimate of the relative errors of masses and inertias (P,), from deviations of base paths.

    The first pose of each path is measured with an error. So each path has an unknown constant
    offset, which is eliminated from the normal equations. Deviations that only implausible errors
    explain (a sensor that fails, say) do not count: the estimate is zero, and their path is
    forgotten.

    Parameters
    ----------
    count
        P, the number of parameters.
    """

    def __init__(self, count: int) -> None:
        # Information of the prior and of all earlier paths: matrix and vector.
        self._information = (_NOISE / _SPREAD) ** 2 * np.eye(count)
        self._vector = np.zeros(count)
        self._errors: Array | None = None
        self._begin()

    def _begin(self) -> None:
        count = len(self._vector)
        self._poses = 0
        self._sum_J, self._sum_y = np.zeros((6, count)), np.zeros(6)
        self._squares, self._products = np.zeros((count, count)), np.zeros(count)
        self._errors = None

    def next_path(self) -> None:
        """Begin with another path; the information of the earlier ones is kept."""
        if self.errors.any():
            self._information, self._vector = self._normal_equations()
        self._begin()

    def add(self, sensitivity: Array, deviation: Array) -> None:
        """Add the deviation (6,) of a pose, where the path has the sensitivity (6, P)."""
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
            errors = np.asarray(np.linalg.solve(*self._normal_equations()))
            plausible = np.abs(errors).max(initial=0.0) <= _LARGEST
            self._errors = errors if plausible else np.zeros_like(errors)
        return self._errors

    def _normal_equations(self) -> tuple[Array, Array]:
        """Return their matrix and right side, without the part that a constant offset explains."""
        n = max(self._poses, 1)
        squares = self._squares - self._sum_J.T @ self._sum_J / n
        products = self._products - self._sum_J.T @ self._sum_y / n
        return self._information + squares, self._vector + products
