"""Initial guesses for the manoeuvre search: loops on the direct path.

The direct path from one shape to the other is a saddle point: to first order, no small path change
alters the base rotation. So guesses are the direct path with random loops, sized so that their
areas times the curvature approximate the desired rotation.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator

import casadi as ca
import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrices_from_quaternions,
    matrix_from_quaternion,
    quaternion_inverse,
    quaternion_multiply,
    quaternions_from_rotvecs,
    rotvecs_from_quaternions,
)
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.schedule import interpolated
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    PossibleEnd,
    Trajectory,
)

_CANDIDATES_PER_GUESS, _CANDIDATES_PER_CLEAR_GUESS = 24, 240
"""Number of random loops, of which the one closest to the goal becomes the guess; more for clear
guesses, which are one in ten for two arms."""

_MIN_LOOP_SIZE = 0.1
"""Smallest loop size to a possible end, in half ranges of the joints, except in first guesses."""

_MAX_RANGE_SHARE = 0.85

_SIZED_LOOPS = 5
"""Number of loops, each as large as the drift during the one before requires, that give the size of
loops of a drifting base: during smaller ones, it drifts farther than they rotate it."""

_LEAST_TURN_TIME, _TURN_STRETCHES = 0.5, tuple(1.15**k for k in range(16))
"""Shortest guess with reaction wheels, s, and the factors by which other guesses are longer."""

_TURNED_GUESSES = 3

_BRAKING_TIME_FACTOR = 4.0
"""Multiple of a joint's braking time after which it is back on the path of its guess."""


class InitialGuesses:
    """Generates an endless, reproducible sequence of guesses for boundary conditions.

    Parameters
    ----------
    turn
        Step function (:func:`turn_function`), for drifting robots if there is angular momentum.
    curvature
        Model function ``q -> K``.
    angular_momentum
        (3,) total angular momentum, in the initial base frame, kg m^2/s; None: zero.
    """

    def __init__(
        self,
        turn: ca.Function,
        curvature: ca.Function,
        intervals: int,
        angular_momentum: Array | None = None,
    ) -> None:
        self._turn, self._curvature = turn, curvature
        self._instants = np.linspace(0.0, 1.0, intervals + 1)
        self._angular_momentum = angular_momentum

    def generate(
        self,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        is_clear: Callable[[Trajectory], bool] | None = None,
    ) -> Iterator[Trajectory]:
        """Yield guesses that end in the most likely final shape, or in each possible one in turn.

        ``is_clear``: whether a guess is clear; if given, all guesses are, unless no candidate is.
        """
        rng = np.random.default_rng(1)
        half = limits.joint_ranges(boundary.start)[1]
        likely = PossibleEnd(boundary.likely_final_shape, boundary.goal_rotation)
        ends = boundary.possible_ends or (likely,)
        sizes = [self._size_of_loops(rng, boundary, end, limits, half) for end in ends]
        for number in itertools.count():
            around, place = divmod(number, len(ends))
            final, turn = ends[place].shape, ends[place].base_rotation
            # The direct path to an end may suffice; it is used as a guess only once.
            size = max(sizes[place], _MIN_LOOP_SIZE if boundary.possible_ends and around else 0.0)
            rounds = [
                size * rng.uniform(0.3, 1.5) * _loop(rng, self._instants, len(half))
                for _ in range(_CANDIDATES_PER_CLEAR_GUESS if is_clear else _CANDIDATES_PER_GUESS)
            ]
            shapes = self._add_loops(np.array(rounds), boundary.start, final, limits)
            candidates = self._build_trajectories(shapes, limits)
            # The cosine of half the remaining angle.
            near = np.abs([each.quaternions[-1] @ turn for each in candidates])
            nearest_first = [candidates[k] for k in np.argsort(-near, kind="stable")]
            clear = (each for each in nearest_first if is_clear is None or is_clear(each))
            yield next(clear, nearest_first[0])

    def generate_with_wheels(
        self,
        wheels: ReactionWheels,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        robot: SpaceRobot,
    ) -> Iterator[Trajectory]:
        """Yield guesses in which reaction wheels rotate the base to its goal.

        The base rotates about a fixed axis, in either direction, and slows down from its current
        rate to rest. The other joints move to their final positions; later guesses add loops to
        their path. The wheel rates follow from the momentum.
        """
        direct = self._direct_path(boundary.start, boundary.likely_final_shape)
        loops = self.generate(boundary, limits)
        for number in itertools.count():
            shapes = next(loops).shapes if number else direct
            found = self._turned_by_wheels(wheels, boundary, limits, robot, shapes)
            yield from (trajectory for _, trajectory in found[:_TURNED_GUESSES])

    def _turned_by_wheels(
        self,
        wheels: ReactionWheels,
        boundary: BoundaryConditions,
        limits: MotionLimits,
        robot: SpaceRobot,
        shapes: Array,
    ) -> list[tuple[float, Trajectory]]:
        """Return guesses along shapes (N + 1, n) in which wheels rotate the base, with their
        largest fraction of a limit, at least one: smallest fraction, then shortest first.

        If wheel rates changed linearly, the base would stop, but at another attitude. So attitudes
        are blended from that motion forwards from the start to that motion backwards from the goal,
        in either direction, and the wheel rates follow. Durations are tried one after the other: in
        a longer one, a rotating base only rotates farther.
        """
        s = self._instants[:, np.newaxis]
        index, other = wheels.index, wheels.other
        ends = boundary.velocity, boundary.final_velocity
        first, last = (np.broadcast_to(each, robot.n)[index] for each in ends)
        D, D_q = (
            each.full().reshape(3, len(shapes), -1).transpose(1, 0, 2)
            for each in robot.function("locked_inertia", compile=False)(shapes.T)
        )
        by_instant = np.gradient(shapes[:, other], self._instants, axis=0, edge_order=2)
        by_instant[0] = by_instant[-1] = 0.0
        steady = np.zeros_like(shapes)
        steady[:, index] = first + s * (last - first)
        to_wheels = np.linalg.pinv(wheels.axes_B * wheels.inertia).T
        fastest = np.abs(last - first) / limits.acceleration[index] / _MAX_RANGE_SHARE
        found = []
        for factor, turns in itertools.product(_TURN_STRETCHES, (0, -1, 1)):
            step = factor * max(float(fastest.max()), _LEAST_TURN_TIME) / (len(s) - 1)
            velocities = steady.copy()
            velocities[:, other] = by_instant / (step * (len(s) - 1))
            quaternions = self._blended_attitudes(boundary, shapes, velocities, step, turns)
            w = rates_between(quaternions, step)
            L_B = boundary.angular_momentum @ matrices_from_quaternions(quaternions)
            left = L_B - np.einsum("kij,kj->ki", D, w) - np.einsum("kij,kj->ki", D_q, velocities)
            velocities[1:-1, index] += (left @ to_wheels)[1:-1]
            speed = np.abs(velocities / limits.velocity).max()
            change = np.abs(np.diff(velocities, axis=0) / step / limits.acceleration).max()
            means = (velocities[1:, index] + velocities[:-1, index]) / 2
            guess = shapes.copy()
            guess[1:, index] = guess[0, index] + step * np.cumsum(means, axis=0)
            share = max(1.0, float(speed), float(change))
            found.append((share, Trajectory(step, guess, velocities, quaternions)))
        return sorted(found, key=lambda each: (each[0], each[1].step))

    def _blended_attitudes(
        self,
        boundary: BoundaryConditions,
        shapes: Array,
        velocities: Array,
        step: float,
        turns: int,
    ) -> Array:
        """Return attitudes (N + 1, 4) blended from motions forwards from start, back from goal."""
        forwards = np.tile([0.0, 0.0, 0.0, 1.0], (len(shapes), 1))
        backwards = forwards.copy()
        if self._angular_momentum is not None:
            u, L_0 = step * velocities, self._angular_momentum
            parts = shapes[:-1], u[:-1], u[1:]
            forwards = self._integrate_drift(*parts, np.asarray(step), L_0)
            L_f = L_0 @ matrix_from_quaternion(boundary.goal_rotation)
            parts = shapes[:0:-1], -u[:0:-1], -u[-2::-1]
            backwards = self._integrate_drift(*parts, np.asarray(step), -L_f)[::-1]
        backwards = quaternion_multiply(boundary.goal_rotation, backwards)
        between = rotvecs_from_quaternions(
            quaternion_multiply(quaternion_inverse(forwards), backwards)
        )
        # Without jumps by a full revolution.
        for k in range(1, len(between)):
            angle = float(np.linalg.norm(between[k]))
            if angle > 0:
                axis = between[k] / angle
                whole = round(float(axis @ (between[k - 1] - between[k])) / (2 * math.pi))
                between[k] += 2 * math.pi * whole * axis
        angles = np.linalg.norm(between, axis=1, keepdims=True)
        axes = np.where(angles > 0, between / np.maximum(angles, 1e-300), [0.0, 0.0, 1.0])
        s = self._instants[:, np.newaxis]
        late = s**3 * (10 - 15 * s + 6 * s**2)
        added = late * (between + 2 * math.pi * turns * axes)
        return np.asarray(quaternion_multiply(forwards, quaternions_from_rotvecs(added)))

    def _direct_path(self, start: Array, final: Array) -> Array:
        s = self._instants
        return start + np.outer(s**3 * (10 - 15 * s + 6 * s**2), final - start)

    def _add_loops(self, rounds: Array, start: Array, final: Array, limits: MotionLimits) -> Array:
        """Return shapes (K, N + 1, n) of the direct path with loops added, in half ranges."""
        direct = self._direct_path(start, final)
        middle, half = limits.joint_ranges(start)
        # Shapes stay within most of the joint range, or within the extent of the direct path.
        room = np.maximum(_MAX_RANGE_SHARE * half, np.abs(direct - middle))
        shapes = np.clip(direct + half * rounds, middle - room, middle + room)
        return np.clip(shapes, limits.lower, limits.upper)

    def _size_of_loops(
        self,
        rng: np.random.Generator,
        boundary: BoundaryConditions,
        end: PossibleEnd,
        limits: MotionLimits,
        half: Array,
    ) -> float:
        """Return the size, in half ranges, of loops that rotate the base by the angle by which the
        direct path to an end misses its goal, and by the angle by which it drifts meanwhile.
        """
        q, direct = end.shape, self._direct_path(boundary.start, end.shape)[np.newaxis]
        reached = self._build_trajectories(direct, limits)[0].quaternions[-1]
        angle = float(np.linalg.norm(attitude_error(reached, end.base_rotation)))
        size, rest = self._loop_size(q, half, angle), np.tile(q, (2, 1))
        for _ in range(_SIZED_LOOPS if self._angular_momentum is not None else 0):
            loop = size * _loop(rng, self._instants, len(half))[np.newaxis]
            shapes = self._add_loops(loop, boundary.start, q, limits)
            (looped,) = self._build_trajectories(shapes, limits)
            drifted = self._integrate_attitudes(rest, 0.0 * rest, looped.duration)[-1]
            drift = 2 * math.acos(min(1.0, abs(float(drifted[3]))))
            size = self._loop_size(q, half, angle + drift)
        return size

    def _loop_size(self, q: Array, half: Array, angle: float) -> float:
        """Return the size, in half ranges, of a loop that rotates the base by ``angle``."""
        n = len(q)
        K = np.abs(self._curvature(q).full()[3:]).sum(axis=0).reshape(n, n)
        largest = float((K * np.outer(half, half)).max())
        return min(1.0, math.sqrt(angle / (math.pi * largest))) if largest > 0 else 1.0

    def _build_trajectories(self, shapes: Array, limits: MotionLimits) -> list[Trajectory]:
        """Return shapes (K, N + 1, n) as trajectories, as fast as the limits allow."""
        u = np.gradient(shapes, axis=1)
        u[:, 0] = u[:, -1] = 0.0
        speed = (np.abs(u) / limits.velocity).max(axis=(1, 2))
        change = (np.abs(np.diff(u, axis=1)) / limits.acceleration).max(axis=(1, 2))
        steps = np.maximum(np.maximum(speed, np.sqrt(change)), 1e-6)
        return [
            Trajectory(float(h), q, step / h, X)
            for h, q, step, X in zip(
                steps, shapes, u, self._integrate_attitudes(shapes, u, steps), strict=True
            )
        ]

    def _integrate_attitudes(self, shapes: Array, steps: Array, durations: Array | float) -> Array:
        """Return the attitudes (..., N + 1, 4) that shapes and steps (..., N + 1, n) lead to.

        ``durations`` (...) are those of a step, s.
        """
        parts = shapes[..., :-1, :], steps[..., :-1, :], steps[..., 1:, :]
        if self._angular_momentum is not None:
            return self._integrate_drift(*parts, np.asarray(durations), self._angular_momentum)
        return attitudes_along(self._turn, *parts)

    def _integrate_drift(
        self, q: Array, u: Array, u_next: Array, durations: Array, L_0: Array
    ) -> Array:
        """Return the attitudes (..., N + 1, 4), each from the previous one, at an angular momentum.

        ``q``, ``u`` and ``u_next`` (..., N, n) are those of the steps.
        """
        N, n = q.shape[-2:]
        parts = [each.reshape(-1, N, n) for each in (q, u, u_next)]
        h = np.broadcast_to(durations, q.shape[:-2]).reshape(-1, 1)
        X = np.tile([0.0, 0.0, 0.0, 1.0], (len(h), N + 1, 1))
        Omega = np.zeros((len(h), 3))
        for k in range(N):
            # Approximate midpoint: half of the previous rotation ahead.
            ahead = quaternion_multiply(X[:, k], quaternions_from_rotvecs(Omega / 2))
            impulse = h * (L_0 @ matrices_from_quaternions(ahead))
            arguments = (*(each[:, k] for each in parts), impulse)
            Omega = self._turn(*(each.T for each in arguments)).full().T
            X[:, k + 1] = quaternion_multiply(X[:, k], quaternions_from_rotvecs(Omega))
        return np.asarray(X.reshape(*q.shape[:-2], N + 1, 4))

    def resample(self, solution: Trajectory) -> Trajectory:
        """Return a solution, resampled on the grid of the guesses."""
        intervals = len(self._instants) - 1
        coarse = np.linspace(0.0, 1.0, len(solution.shapes))
        shapes = solution.at_ticks(intervals)
        velocities = interpolated(self._instants, coarse, solution.velocities)
        return self._trajectory(solution.duration / intervals, shapes, velocities)

    def _trajectory(self, step: float, shapes: Array, velocities: Array) -> Trajectory:
        attitudes = self._integrate_attitudes(shapes, step * velocities, step)
        return Trajectory(step, shapes, velocities, attitudes)

    def from_ticks(self, positions: Array, velocity: Array, period: float) -> Trajectory:
        """Return the trajectory through shapes (M + 1, n) at ticks, from velocity (n,) to rest."""
        ticks = np.linspace(0.0, 1.0, len(positions))
        step = period * (len(positions) - 1) / (len(self._instants) - 1)
        rates = np.gradient(positions, period, axis=0)
        rates[0], rates[-1] = velocity, 0.0
        shapes, velocities = (
            interpolated(self._instants, ticks, values) for values in (positions, rates)
        )
        return self._trajectory(step, shapes, velocities)

    def with_initial_velocity(
        self, guess: Trajectory, velocity: Array, limits: MotionLimits
    ) -> Trajectory:
        """Return a guess from rest, modified to begin with a velocity (n,)."""
        brakes = float((np.abs(velocity) / limits.acceleration).max(initial=0.0))
        back = min(guess.duration, _BRAKING_TIME_FACTOR * brakes)
        if back == 0:
            return guess
        x = np.clip(self._instants * guess.duration / back, 0.0, 1.0)[:, np.newaxis]
        shapes = guess.shapes + back * x * (1 - x) ** 2 * velocity
        velocities = guess.velocities + (1 - x) * (1 - 3 * x) * velocity
        shapes = np.clip(shapes, limits.lower, limits.upper)
        return self._trajectory(guess.step, shapes, velocities)


def attitudes_along(turn: ca.Function, q: Array, u: Array, u_next: Array) -> Array:
    """Return the attitudes (..., N + 1, 4) along N steps (..., N, n) from rest, each from the
    previous one; ``turn`` is the function that computes one step (:func:`.turn_function`).
    """
    Omega = turn(*(x.reshape(-1, x.shape[-1]).T for x in (q, u, u_next))).full().T
    rotations = quaternions_from_rotvecs(Omega).reshape(*q.shape[:-1], 4)
    quaternions = np.empty((*q.shape[:-2], q.shape[-2] + 1, 4))
    quaternions[..., 0, :] = [0.0, 0.0, 0.0, 1.0]
    for k in range(rotations.shape[-2]):
        quaternions[..., k + 1, :] = quaternion_multiply(
            quaternions[..., k, :], rotations[..., k, :]
        )
    return quaternions


def rates_between(quaternions: Array, step: float) -> Array:
    """Return angular velocities (N + 1, 3) in B at attitudes (N + 1, 4) ``step`` seconds apart."""
    turns = rotvecs_from_quaternions(
        quaternion_multiply(quaternion_inverse(quaternions[:-1]), quaternions[1:])
    )
    rates = np.vstack([turns[:1], (turns[:-1] + turns[1:]) / 2, turns[-1:]]) / step
    return np.asarray(rates)


def _loop(rng: np.random.Generator, s: Array, n: int) -> Array:
    """Return a closed random path (N + 1, n) of about unit size at instants (N + 1,) in [0, 1]."""
    rounds = rng.integers(1, 4)
    path = np.zeros((len(s), n))
    for harmonic in range(rounds, rounds + 3):
        phase = 2 * math.pi * harmonic * s[:, np.newaxis]
        a, b = rng.normal(size=(2, n)) / (harmonic - rounds + 1)
        path += a * np.sin(phase) + b * np.cos(phase)
    return np.asarray(path * np.sin(math.pi * s)[:, np.newaxis] ** 2)
