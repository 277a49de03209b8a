"""Joints that run into the ends of their strokes: inelastic stops.

A stop acts between the two links of its joint, along the joint's coordinate: an internal force,
which changes neither total momentum. It does two things, both by one principle: with ``K`` the
inertia matrix of the shape (:mod:`spacerobot_ros.model.composite_rigid_body`), of all that does
not lead out of a stroke, what happens is nearest to what would happen without stops, in the metric
of K. The other joints and the base take their share.

* Arrival: ``qdot+ = nearest(qdot-)``, by impulses of the stops that are touched. The joint does not
  rebound; the energy ``(qdot+ - qdot-)' K (qdot+ - qdot-) / 2`` is lost (Carnot).
* Holding: ``qddot = nearest(K^-1 Q)`` for joints at rest on a stop (Gauss's principle of least
  constraint). A joint is held while effort and motion push it outwards, and leaves when they do
  not, to within one integration step.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.free_flight import state_slices

Flags = npt.NDArray[np.bool_]

_BISECTIONS = 40
"""They leave 1e-12 of an integration step of the time of arrival."""

_BEYOND = 1e-12
"""How far beyond its end a joint counts as outside: relative, and in m or rad below one."""


class JointStops:
    """Advances the state of :mod:`spacerobot_ros.model.free_flight` with stops.

    Parameters
    ----------
    robot
        The model.
    integration_step
        Longest Runge-Kutta step, s.
    """

    def __init__(self, robot: SpaceRobot, integration_step: float) -> None:
        self._integration_step = integration_step
        self._lower, self._upper = robot.lower, robot.upper
        self._below = robot.lower - _BEYOND * np.maximum(1.0, np.abs(robot.lower))
        self._above = robot.upper + _BEYOND * np.maximum(1.0, np.abs(robot.upper))
        self._q, _, self._qdot, *_ = state_slices(robot.n)
        self._step = robot.buffered("holding_step")
        self._equations = robot.buffered("shape_equations")

    def advance(self, state: Array, command: Array, duration: float) -> tuple[Array, Flags]:
        """Return the state after ``duration`` s under a held command, and the joints that were
        stopped or held.

        Raises
        ------
        SpaceRobotError
            The motion is no longer finite.
        """
        x, left = state.copy(), duration
        stopped = np.zeros(self._lower.size, dtype=np.bool_)
        while left > 1e-12 * duration:
            step = min(self._integration_step, left)
            held = self._held(x, command)
            after = self._move(x, command, held, step)
            hit = np.zeros_like(held)
            if self._outside(after):
                step = self._arrival(x, command, held, step)
                after, hit = self._stop(self._move(x, command, held, step), command)
            stopped |= held | hit
            x, left = after, left - step
        return x, stopped

    def _move(self, x: Array, command: Array, held: Flags, step: float) -> Array:
        after = self._step(x, command, np.where(held, 0.0, 1.0), step)[0]
        if not np.all(np.isfinite(after)):
            raise SpaceRobotError(
                "The motion is no longer finite: the commands drive the robot beyond what an "
                "integration step can follow."
            )
        return after

    def _outside(self, x: Array) -> bool:
        q = x[self._q]
        return bool(np.any((q < self._below) | (q > self._above)))

    def _arrival(self, x: Array, command: Array, held: Flags, step: float) -> float:
        """Return after which part of a step (s) the first joint is outside."""
        early, late = 0.0, step
        for _ in range(_BISECTIONS):
            middle = (early + late) / 2
            if self._outside(self._move(x, command, held, middle)):
                late = middle
            else:
                early = middle
        return late

    def _stop(self, x: Array, command: Array) -> tuple[Array, Flags]:
        x[self._q] = np.clip(x[self._q], self._lower, self._upper)
        K, _ = self._equations(x, command)
        x[self._qdot], stopped = nearest(K, x[self._qdot], self._inward(x))
        return x, stopped

    def _held(self, x: Array, command: Array) -> Flags:
        inward = np.where(x[self._qdot] == 0.0, self._inward(x), 0.0)
        if not inward.any():
            return np.zeros(inward.size, dtype=np.bool_)
        K, Q = self._equations(x, command)
        return nearest(K, np.linalg.solve(K, Q), inward)[1]

    def _inward(self, x: Array) -> Array:
        """Return the direction into the stroke of each joint (n,): 1, -1, or 0 away from stops."""
        q = x[self._q]
        return np.where(q <= self._lower, 1.0, np.where(q >= self._upper, -1.0, 0.0))


def nearest(K: Array, unhindered: Array, inward: Array) -> tuple[Array, Flags]:
    """Return the x (n,) nearest to ``unhindered`` in the metric of K (n, n) with
    ``inward * x >= 0``, and which joints it stops: those with ``x = 0`` that pull at the others.

    The linear complementarity problem of this projection is solved by Murty's least-index pivoting,
    which ends for every positive definite K.
    """
    stopped = np.zeros(unhindered.size, dtype=np.bool_)
    compliance = np.linalg.inv(K)
    while True:
        x, impulse = unhindered.copy(), np.zeros_like(unhindered)
        if stopped.any():
            block = compliance[np.ix_(stopped, stopped)]
            impulse[stopped] = np.linalg.solve(block, -unhindered[stopped])
            x += compliance @ impulse
            x[stopped] = 0.0
        wrong = np.flatnonzero(inward * np.where(stopped, impulse, x) < 0.0)
        if not wrong.size:
            return x, stopped
        stopped[wrong[0]] = ~stopped[wrong[0]]
