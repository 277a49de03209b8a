"""Joints that run into their limits: inelastic stops.

A stop acts between the two links of its joint, along the joint's coordinate: an internal force,
which changes neither total momentum; the other joints and the base take their share. With ``K`` the
inertia matrix of the shape (:mod:`spacerobot_ros.model.composite_rigid_body`), stops do two things:

* Arrival: of all rates that lead beyond no limit, ``qdot+`` is the nearest to ``qdot-`` in the
  metric of K. The joint does not rebound; ``(qdot+ - qdot-)' K (qdot+ - qdot-) / 2`` of energy is
  lost (Carnot). The time of arrival is found to rounding.
* Holding: a joint on its stop stays there through an integration step if it is pushed outwards,
  that is, if the nearest to ``qdot + h K^-1 Q`` that leads beyond no limit has it at rest (Gauss's
  principle of least constraint over a step, Moreau's time stepping). So it leaves with a delay of
  at most one step, and the endless shorter and shorter hops of joints that knock each
  other off their stops end.

A joint that is locked where it is (a brake, a jam) is brought to rest by the same impulse and held.
"""

from __future__ import annotations

import numpy as np

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.composite_rigid_body import state_slices
from spacerobot_ros.model.description import Array
from spacerobot_ros.simulation.plant import Flags

_BISECTIONS = 40
"""They leave 1e-12 of an integration step of the time of arrival."""

_BEYOND = 1e-12
"""Distance beyond its end at which a joint counts as outside: relative, in m or rad below one."""


class JointStops:
    """Advances the state of :mod:`spacerobot_ros.model.composite_rigid_body` with stops.

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

    def advance(
        self, state: Array, command: Array, duration: float, locked: Flags | None = None
    ) -> tuple[Array, Flags]:
        """Return the state after ``duration`` s under a held command, and the joints that stops
        stopped or held.

        ``locked`` (n,) are joints that something holds wherever they are; moving ones are brought
        to rest at once, as by a stop.

        Raises
        ------
        SpaceRobotError
            The motion is no longer finite.
        """
        x, left = state.copy(), duration
        none = np.zeros(self._lower.size, dtype=np.bool_)
        locked = none if locked is None else locked
        held, stopped = self._rest(x, command, none, locked)
        while left > 1e-12 * duration:
            step = min(self._integration_step, left)
            fixed = held | locked
            after = self._move(x, command, fixed, step)
            if self._outside(after):
                step = self._arrival(x, command, fixed, step)
                after = self._move(x, command, fixed, step)
                after[self._q] = np.clip(after[self._q], self._lower, self._upper)
            x, left = after, left - step
            held, touched = self._rest(x, command, held, locked)
            stopped |= touched
        return x, stopped

    def _rest(self, x: Array, command: Array, held: Flags, locked: Flags) -> tuple[Flags, Flags]:
        """Bring locked joints and joints on their stops to rest, in ``x``; return which stops hold
        through the next step, and these with those that have arrived. ``held`` are the joints that
        stops held until now.
        """
        q, qdot = x[self._q], x[self._qdot]
        inward = np.where(q <= self._lower, 1.0, np.where(q >= self._upper, -1.0, 0.0))
        inward[locked] = 0.0
        touched = np.zeros(q.size, dtype=np.bool_)
        if not inward.any() and not qdot[locked].any():
            return touched, touched
        flat, Q = self._equations(x, command)
        K: Array = flat.reshape(q.size, q.size)
        if locked.any():
            if qdot[locked].any():
                qdot[:], _ = at_rest(np.asarray(np.linalg.inv(K)), qdot, locked)
                _, Q = self._equations(x, command)
            # From here on they are as good as part of the bodies they join.
            free = np.where(locked, 0.0, 1.0)
            K, Q = np.where(np.eye(q.size) > 0, K, K * np.outer(free, free)), Q * free
        compliance: Array = np.asarray(np.linalg.inv(K))
        if np.any(inward * qdot < 0.0):
            touched = pushed_out(compliance, qdot, inward, touched)
            qdot[:], _ = at_rest(compliance, qdot, touched)
        pushed = qdot + self._integration_step * (compliance @ Q)
        held = pushed_out(compliance, pushed, inward, held)
        if qdot[held].any():
            qdot[:], _ = at_rest(compliance, qdot, held)
        return held, held | touched

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


def at_rest(compliance: Array, rates: Array, joints: Flags) -> tuple[Array, Array]:
    """Return the rates (n,) after the impulses (n,) that bring some joints to rest, and these.

    ``compliance`` (n, n) is the inverse of K.
    """
    after, impulses = rates.copy(), np.zeros_like(rates)
    if joints.any():
        impulses[joints] = np.linalg.solve(compliance[np.ix_(joints, joints)], -rates[joints])
        after += compliance @ impulses
        after[joints] = 0.0
    return after, impulses


def pushed_out(compliance: Array, rates: Array, inward: Array, guess: Flags) -> Flags:
    """Return which joints (n,) their stops bring to rest, so that ``inward * rates >= 0`` for all.

    ``inward`` is 1 or -1 on a stop and 0 elsewhere. These joints make the rates after the impulses
    the nearest to those before in the metric of K. The linear complementarity problem is solved
    by Murty's least-index pivoting, which ends for every positive definite K from every ``guess``.
    """
    joints = guess.copy()
    tried: set[bytes] = set()
    # What comes up again is a tie to rounding: either answer is right.
    while joints.tobytes() not in tried:
        tried.add(joints.tobytes())
        after, impulses = at_rest(compliance, rates, joints)
        wrong = np.flatnonzero(inward * np.where(joints, impulses, after) < 0.0)
        if not wrong.size:
            break
        joints[wrong[0]] = ~joints[wrong[0]]
    return joints
