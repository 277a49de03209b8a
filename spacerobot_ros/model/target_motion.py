"""Predicted motion of a free target, and of a frame approaching it.

If no force or torque acts on a target, its centre of mass moves at constant velocity and its
angular momentum ``L_W`` about the centre of mass is constant, so that its attitude obeys Euler's
equations,

    omega_T = I^-1 R_WT' L_W,    dR_WT/dt = R_WT hat(omega_T).

All quantities are arrays over times (K,): positions (K, 3) and attitudes (K, 3, 3).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.model.compilation import BufferedFunction, dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.grasp import BodyMotion, TargetBody
from spacerobot_ros.model.integration import runge_kutta
from spacerobot_ros.model.rotations import (
    cross,
    hat,
    matrices_from_quaternions,
    quaternion_from_matrix,
    quaternions_from_rotvecs,
    rotvec_from_quaternion,
)
from spacerobot_ros.model.symbolic_rotations import matrix_from_quaternion, quaternion_rate

_STEP_ANGLE = 0.2  # rad, of the target between nodes
_LONGEST_STEP = 4.0  # s, between nodes
_SMALL_ANGLE = 1e-3  # rad; below it, functions of an angle are series


class FrameMotion(NamedTuple):
    """Motion of a frame in W at given times (K,).

    Attributes
    ----------
    R, r
        Attitude (K, 3, 3) and position (K, 3), m.
    v, omega
        Velocity (K, 3), m/s, and angular velocity (K, 3), rad/s.
    a, alpha
        Accelerations (K, 3), m/s^2 and rad/s^2.
    """

    R: Array
    r: Array
    v: Array
    omega: Array
    a: Array
    alpha: Array

    def rows(self, chosen: slice | npt.NDArray[np.int64]) -> FrameMotion:
        """Return the motion at selected times."""
        return FrameMotion(*(each[chosen] for each in self))

    def body_motion(self) -> BodyMotion:
        """Return the motion at the first time, without accelerations."""
        return BodyMotion(self.R[0], self.r[0], self.v[0], self.omega[0])

    def with_relative_motion(self, path: RelativeMotionOverTime) -> FrameMotion:
        """Return the motion of a frame that moves relative to this frame."""
        parts = *(each[:, :3] for each in path), *path.rotation
        R_rel = matrices_from_quaternions(quaternions_from_rotvecs(path.values[:, 3:]))
        return self._composed(self.R @ R_rel, *(_rotate_vectors(self.R, each) for each in parts))

    def with_motion_beside(self, frame: FrameMotion, moving: FrameMotion) -> FrameMotion:
        """Return the motion of a frame that moves relative to this frame as ``moving`` does
        relative to ``frame``."""
        turn = self.R @ np.swapaxes(frame.R, 1, 2)
        parts = (
            *frame.relative_translation(moving.r, moving.v, moving.a),
            moving.omega - frame.omega,
            moving.alpha - frame.alpha - cross(frame.omega, moving.omega),
        )
        return self._composed(turn @ moving.R, *(_rotate_vectors(turn, each) for each in parts))

    def _composed(
        self, R: Array, arm: Array, v_rel: Array, a_rel: Array, w_rel: Array, wdot_rel: Array
    ) -> FrameMotion:
        """Return the motion of a frame with attitudes ``R`` and a motion (K, 3) relative to this
        frame, in W."""
        omega, alpha = self.omega, self.alpha
        return FrameMotion(
            R,
            self.r + arm,
            self.v + cross(omega, arm) + v_rel,
            omega + w_rel,
            self.a
            + cross(alpha, arm)
            + cross(omega, cross(omega, arm))
            + 2 * cross(omega, v_rel)
            + a_rel,
            alpha + cross(omega, w_rel) + wdot_rel,
        )

    def relative_translation(self, r: Array, v: Array, a: Array) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration (K, 3) of points relative to this frame, in
        W, given their position, velocity and acceleration (K, 3) in W.
        """
        omega, arm = self.omega, r - self.r
        v_rel = v - self.v - cross(omega, arm)
        a_rel = a - self.a - cross(self.alpha, arm) - cross(omega, cross(omega, arm))
        return arm, v_rel, a_rel - 2 * cross(omega, v_rel)


class RelativeMotionOverTime(NamedTuple):
    """Motion of a frame E relative to a frame G at given times (K,), in G.

    Attributes
    ----------
    values, rates, accelerations
        (K, 6) position, m, and rotation vector of ``R_GE``, rad, and their first and second
        derivatives.
    """

    values: Array
    rates: Array
    accelerations: Array

    @property
    def rotation(self) -> tuple[Array, Array]:
        """Angular velocity (K, 3), rad/s, and acceleration (K, 3), rad/s^2, of E relative to G.

        The velocity is ``J(phi) phidot``, with the rotation vector phi and the left Jacobian of
        SO(3).
        """
        phi, phidot, phiddot = (each[:, 3:] for each in self)
        B, C, B_rate, C_rate = _jacobian_terms(phi, phidot)
        first, second = cross(phi, phidot), cross(phi, phiddot)
        twice = cross(phi, first)
        w = phidot + B * first + C * twice
        wdot = (
            phiddot
            + B_rate * first
            + B * second
            + C_rate * twice
            + C * (cross(phidot, first) + cross(phi, second))
        )
        return np.asarray(w), np.asarray(wdot)

    @classmethod
    def at_rest(cls, position: Array) -> RelativeMotionOverTime:
        """Return no motion (K = 1) at a position (3,), with the attitude of G."""
        zero = np.zeros((1, 6))
        return cls(np.append(position, np.zeros(3))[np.newaxis], zero, zero)

    @classmethod
    def between(cls, frame: FrameMotion, moving: FrameMotion) -> RelativeMotionOverTime:
        """Return the motion of ``moving`` relative to ``frame``, both at a single time (K = 1)."""
        R, omega = frame.R[0], frame.omega[0]
        motion = cls(*(np.zeros((1, 6)) for _ in range(3)))
        translation = frame.relative_translation(moving.r, moving.v, moving.a)
        for part, vectors in zip(motion, translation, strict=True):
            part[0, :3] = R.T @ vectors[0]
        w_W = moving.omega[0] - omega
        wdot = R.T @ (moving.alpha[0] - frame.alpha[0] - cross(omega, w_W))
        phi = rotvec_from_quaternion(quaternion_from_matrix(R.T @ moving.R[0]))
        B, C, _, _ = _jacobian_terms(phi[np.newaxis], phi[np.newaxis])
        J = np.eye(3) + B * hat(phi) + C * hat(phi) @ hat(phi)
        motion.values[0, 3:], motion.rates[0, 3:] = phi, np.linalg.solve(J, R.T @ w_W)
        motion.accelerations[0, 3:] = np.linalg.solve(J, wdot - motion.rotation[1][0])
        return motion


def _jacobian_terms(phi: Array, phidot: Array) -> tuple[Array, Array, Array, Array]:
    """Return ``(1 - cos t) / t^2`` and ``(t - sin t) / t^3`` (K, 1) of the angle t, and their
    rates.
    """
    t = np.linalg.norm(phi, axis=1, keepdims=True)
    small = t < _SMALL_ANGLE
    t = np.where(small, 1.0, t)
    along = np.sum(phi * phidot, axis=1, keepdims=True)
    sine, versine = np.sin(t), 1 - np.cos(t)
    B = np.where(small, 0.5, versine / t**2)
    C = np.where(small, 1 / 6, (t - sine) / t**3)
    B_rate = np.where(small, -1 / 12, (t * sine - 2 * versine) / t**4)
    C_rate = np.where(small, -1 / 60, (t * versine - 3 * (t - sine)) / t**5)
    return B, C, B_rate * along, C_rate * along


class RelativePath:
    """A path of a frame E relative to a frame G, from a given motion to rest at a pose.

    Position and rotation vector are fifth-order polynomials in time.

    Parameters
    ----------
    start
        Initial motion (K = 1).
    position
        (3,) position at the end, m, where the attitudes of E and G coincide.
    duration
        Duration, s.
    """

    def __init__(self, start: RelativeMotionOverTime, position: Array, duration: float) -> None:
        self.duration = duration
        self._end, zero = np.concatenate([position, np.zeros(3)]), np.zeros(6)
        begin = [each[0] for each in start]
        self._coefficients = _quintic(begin, (self._end, zero, zero), duration)

    def at(self, times: npt.ArrayLike) -> RelativeMotionOverTime:
        """Return the motion at times (K,), s since the start; at rest after the end."""
        t = np.minimum(np.asarray(times, dtype=float), self.duration)
        parts = _evaluate_polynomials(self._coefficients, t)
        rested = np.asarray(times, dtype=float) >= self.duration
        parts[0][rested], parts[1][rested], parts[2][rested] = self._end, 0.0, 0.0
        return RelativeMotionOverTime(*parts)


def _quintic(start: Sequence[Array], end: Sequence[Array], T: float) -> Array:
    """Return the coefficients (6, m) of fifth-order polynomials in time."""
    (y, v, a), (y_1, v_1, a_1) = (
        (value, rate * T, acceleration * T**2) for value, rate, acceleration in (start, end)
    )
    d = y_1 - y
    scaled = [
        y,
        v,
        a / 2,
        10 * d - 6 * v - 1.5 * a - 4 * v_1 + 0.5 * a_1,
        -15 * d + 8 * v + 1.5 * a + 7 * v_1 - a_1,
        6 * d - 3 * v - 0.5 * a - 3 * v_1 + 0.5 * a_1,
    ]
    return np.array([c / T**i for i, c in enumerate(scaled)])


def _evaluate_polynomials(coefficients: Array, t: Array) -> list[Array]:
    """Return values, rates and accelerations (K, m) of polynomials at times (K,)."""
    powers, c, parts = t[:, np.newaxis] ** np.arange(6), coefficients, []
    for _ in range(3):
        parts.append(powers[:, : len(c)] @ c)
        c = c[1:] * np.arange(1, len(c))[:, np.newaxis]
    return parts


class TorqueFreeMotion:
    """Motion of a free target, starting from a measured state.

    Parameters
    ----------
    body
        The target.
    motion
        State of the target's root link frame.

    Attributes
    ----------
    velocity
        Centre-of-mass velocity (3,) in W, m/s.
    arm_length
        Distance of the grapple frame from the centre of mass, m.
    """

    def __init__(self, body: TargetBody, motion: BodyMotion) -> None:
        self._body, inertia, R = body, body.inertia, motion.R_WT
        arm = R @ inertia.com
        self._r = motion.r_WT + arm
        self.velocity = motion.v + cross(motion.omega, arm)
        self.arm_length = float(np.linalg.norm(body.grapple.r - inertia.com))
        self._L = R @ inertia.about_com @ R.T @ motion.omega
        fastest = float(np.linalg.norm(self._L)) / body.least_inertia
        self._step = min(_LONGEST_STEP, _STEP_ANGLE / fastest if fastest > 0 else _LONGEST_STEP)
        self._nodes = [self._numbers(0.0, quaternion_from_matrix(R))]

    def numbers(self, time: float) -> Array:
        """Return the parameters of the motion from a given time on, for
        :class:`TargetExpression`."""
        return self._numbers(time, self._at(np.array([time]))[0, :4])

    def _numbers(self, time: float, quaternion: Array) -> Array:
        r = self.center_of_mass(time)
        return np.concatenate([[time], quaternion, self._L, r, self.velocity, self._body.numbers])

    def center_of_mass(self, time: float) -> Array:
        """Return the centre of mass (3,) in W, m."""
        return np.asarray(self._r + time * self.velocity)

    @property
    def grapple_in_target(self) -> Array:
        """Grapple frame pose (7,) in the root link frame."""
        grapple = self._body.grapple
        return np.concatenate([grapple.r, quaternion_from_matrix(grapple.R)])

    def body_poses(self, times: npt.ArrayLike) -> tuple[Array, Array]:
        """Return quaternions (K, 4) and positions (K, 3), m, of the root link frame in W."""
        t = np.asarray(times, dtype=float)
        X = self._at(t)[:, :4]
        arm = matrices_from_quaternions(X) @ self._body.inertia.com
        return X, self._r + t[:, np.newaxis] * self.velocity - arm

    def later(self, elapsed: float) -> TorqueFreeMotion:
        """Return the same motion starting at a later time."""
        X, r = self.body_poses([elapsed])
        R, omega = matrices_from_quaternions(X)[0], self.grapple([elapsed]).omega[0]
        v = self.velocity - cross(omega, R @ self._body.inertia.com)
        return TorqueFreeMotion(self._body, BodyMotion(R, r[0], v, omega))

    def grapple(self, times: npt.ArrayLike) -> FrameMotion:
        """Return the motion of the grapple frame at times (K,), s since the measured state."""
        found = self._at(np.asarray(times, dtype=float))
        vectors = (found[:, k : k + 3] for k in range(13, 28, 3))
        return FrameMotion(found[:, 4:13].reshape(-1, 3, 3), *vectors)

    def _at(self, t: Array) -> Array:
        """Return the attitudes (K, 4), and the grapple frames (K, 24) as in
        :class:`FrameMotion`."""
        target = _target_function(threading.get_ident())
        found = np.empty((len(t), 28))
        for row, time in enumerate(t.tolist()):
            index = int(time // self._step)
            for k in range(len(self._nodes), index + 1):
                X = target(self._nodes[-1], k * self._step)[0][:4]
                self._nodes.append(self._numbers(k * self._step, X))
            (found[row],) = target(self._nodes[index], time)
        return found


TARGET_SIZE = 28
"""Length of the :meth:`TorqueFreeMotion.numbers` vector."""

_EXPRESSION_STEPS = 4
"""Number of Runge-Kutta steps in an expression."""


class TargetExpression(NamedTuple):
    """A target at one time, in W: the quaternion (4,) of its root link; its grapple frame's
    attitude (3, 3), position, velocity, angular velocity and their accelerations (3,); its mass;
    the position and velocity of its centre of mass, and the angular momentum about that point (3,).
    """

    X: ca.SX
    R: ca.SX
    r: ca.SX
    v: ca.SX
    omega: ca.SX
    a: ca.SX
    alpha: ca.SX
    mass: ca.SX
    center: ca.SX
    center_velocity: ca.SX
    L: ca.SX

    @classmethod
    def at(cls, numbers: ca.SX, time: ca.SX) -> TargetExpression:
        """Return the target at a time near that of ``numbers`` (:meth:`TorqueFreeMotion.numbers`),
        predicted by Euler's equations.
        """
        began, X, L, r, v, mass, about, arm, turn = ca.vertsplit(
            numbers, np.cumsum([0, 1, 4, 3, 3, 3, 1, 6, 3, 4]).tolist()
        )
        J = ca.SX(3, 3)
        for k, (i, j) in enumerate(zip(*np.triu_indices(3), strict=True)):
            J[i, j] = J[j, i] = about[k]

        def rate(_: float, X: ca.SX) -> ca.SX:
            R = matrix_from_quaternion(X / ca.norm_2(X))
            return quaternion_rate(X, solve_positive_definite(J, R.T @ L))

        elapsed = time - began
        h = elapsed / _EXPRESSION_STEPS
        for _ in range(_EXPRESSION_STEPS):
            X = runge_kutta(rate, X, h)
        X = X / ca.norm_2(X)
        R = matrix_from_quaternion(X)
        omega, center = R @ solve_positive_definite(J, R.T @ L), r + elapsed * v
        alpha = R @ solve_positive_definite(J, R.T @ ca.cross(L, omega))
        to_grapple = R @ arm
        turning = ca.cross(omega, to_grapple)
        return cls(
            X,
            R @ matrix_from_quaternion(turn),
            center + to_grapple,
            v + turning,
            omega,
            ca.cross(alpha, to_grapple) + ca.cross(omega, turning),
            alpha,
            mass,
            center,
            v,
            L,
        )


@lru_cache
def _target_function(thread: int) -> BufferedFunction:
    """Return the function of ``numbers`` and a time that returns the first seven parts (28,) of
    the expression, attitudes by rows; each thread has its own memory."""
    numbers, time = ca.SX.sym("numbers", TARGET_SIZE), ca.SX.sym("time")
    X, R, *vectors = TargetExpression.at(numbers, time)[:7]
    found = {"found": ca.vertcat(X, ca.vec(R.T), *vectors)}
    return BufferedFunction(dense_function("target", {"numbers": numbers, "time": time}, found))


def _rotate_vectors(R: Array, vectors: Array) -> Array:
    """Return vectors (K, 3) rotated by matrices (K, 3, 3)."""
    return np.asarray(np.einsum("kij,kj->ki", R, vectors))


class PathInWorld:
    """A path that is short in W; relative to the rotating frame G, it leads around the body.

    The position is a fifth-order polynomial in W, from a given motion to the motion of a point
    fixed in G; the attitude relative to G follows ``relative``.

    Parameters
    ----------
    relative
        Path relative to G with the same endpoints.
    target
        The target with grapple frame G.
    start
        Start time, s since the state from which the target motion is predicted.
    moving
        Initial motion in W (K = 1).
    position
        (3,) end point in G, m.
    """

    def __init__(
        self,
        relative: RelativePath,
        target: TorqueFreeMotion,
        start: float,
        moving: FrameMotion,
        position: Array,
    ) -> None:
        self.duration = relative.duration
        self._relative, self._target, self._start = relative, target, start
        end = target.grapple([start + self.duration]).with_relative_motion(
            RelativeMotionOverTime.at_rest(position)
        )
        first, last = ((each.r[0], each.v[0], each.a[0]) for each in (moving, end))
        self._coefficients = _quintic(first, last, self.duration)

    def at(self, times: npt.ArrayLike) -> RelativeMotionOverTime:
        """Return the motion relative to G at times (K,), s since the start."""
        t = np.asarray(times, dtype=float)
        found = self._relative.at(t)
        on_way = t < self.duration
        if not on_way.any():
            return found
        frame = self._target.grapple(self._start + t[on_way])
        in_W = frame.relative_translation(*_evaluate_polynomials(self._coefficients, t[on_way]))
        R_GW = np.swapaxes(frame.R, 1, 2)
        for part, vectors in zip(found, in_W, strict=True):
            part[on_way, :3] = _rotate_vectors(R_GW, vectors)
        return found
