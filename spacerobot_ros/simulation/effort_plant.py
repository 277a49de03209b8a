"""The effort-driven plant: free-flying dynamics under joint efforts and a base wrench.

The total momenta are states (:mod:`spacerobot_ros.model.integration`): without thrust and
external loads they are constant to the last bit. If a joint reaches a limit during a tick, the tick
is repeated with inelastic stops.

A stop acts between the two links of its joint, along the joint's coordinate. Because this force is
internal, it leaves both total momenta unchanged; the other joints and the base react. ``K`` is the
inertia matrix in the configuration. Stops have two effects:

* Arrival: ``qdot+`` is nearest to ``qdot-``, in the metric of K, among all rates that violate no
  limit. The joint does not rebound; the energy ``(qdot+ - qdot-)' K (qdot+ - qdot-) / 2`` is lost
  (Carnot). The time of arrival is exact up to rounding.
* Holding: a joint that is on its stop stays there during an integration step if it is pushed
  outwards. This is the case if its rate is zero in the vector of admissible rates nearest to
  ``qdot + h K^-1 Q`` (Gauss's principle of least constraint over a step, Moreau's time stepping).
  The joint leaves its stop with a delay of at most one step. This delay ends the sequence of ever
  shorter rebounds between joints that push each other off their stops.

A locked joint (by a brake or a jam) is brought to rest by the same kind of impulse and held.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt
from typing_extensions import override

from spacerobot_ros.errors import CommandError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import LoadLayout, repeat_step, state_slices
from spacerobot_ros.model.model_functions import Composition
from spacerobot_ros.simulation.loads import PlantLoads
from spacerobot_ros.simulation.plant import CompiledPlant, Flags, body_outputs

BISECTIONS = 40
"""Number of bisection steps for the arrival time: the error is 1e-12 of an integration step."""

_STOP_TOLERANCE = 1e-12
"""Distance beyond a limit at which a joint is considered out of range: relative, or absolute (m or
rad) for limits below one."""


FAILURES = tuple(
    f"{what}: the commands drive the robot too fast for the integration step. Reduce the commands, "
    "or parameter 'integration_step'."
    for what in ("The motion is no longer finite", "Joints hit their stops endlessly")
)
"""Reasons why :class:`JointStops` cannot advance a state."""

MAX_ARRIVALS_PER_STEP = 2
"""Largest number of stop arrivals per joint and integration step, averaged over a tick:
strongly driven joints push each other off their stops ever more often."""


class JointStops:
    """Advances the state of :mod:`spacerobot_ros.model.integration`, and enforces joint
    stops.

    Parameters
    ----------
    robot
        The model.
    integration_step
        Longest Runge-Kutta step, s.
    loaded
        Whether external loads act; if so, the state vector ends with the time, and the command
        vector ends with the loads.
    """

    def __init__(self, robot: SpaceRobot, integration_step: float, *, loaded: bool = False) -> None:
        self._integration_step = integration_step
        self._lower, self._upper, self._below, self._above = self.limits(robot).values()
        self._q, _, self._qdot, *_ = state_slices(robot.n)
        prefix = "loaded_" if loaded else ""
        self._step = robot.buffered(f"{prefix}holding_step")
        self._equations = robot.buffered(f"{prefix}shape_equations")

    @staticmethod
    def limits(robot: SpaceRobot) -> dict[str, Array]:
        """Return the joint limits (n,), and the limits beyond which joints are considered out of
        range."""
        return {
            "LOWER": robot.lower,
            "UPPER": robot.upper,
            "BELOW": robot.lower - _STOP_TOLERANCE * np.maximum(1.0, np.abs(robot.lower)),
            "ABOVE": robot.upper + _STOP_TOLERANCE * np.maximum(1.0, np.abs(robot.upper)),
        }

    def advance(
        self, state: Array, command: Array, duration: float, locked: Flags | None = None
    ) -> tuple[Array, Flags]:
        """Return the state after ``duration`` s under a constant command, and whether each joint
        (n,) was stopped or held by its stop.

        ``locked`` (n,) joints are brought to rest immediately and held at the position where they
        stop.

        Raises
        ------
        SpaceRobotError
            The motion is no longer finite, or joints hit their stops endlessly.
        """
        x, left = state.copy(), duration
        steps = duration / self._integration_step
        arrivals_left = MAX_ARRIVALS_PER_STEP * self._lower.size * math.ceil(steps)
        none = np.zeros(self._lower.size, dtype=np.bool_)
        locked = none if locked is None else locked
        held, stopped = self._bring_to_rest(x, command, none, locked)
        while left > 1e-12 * duration:
            step = min(self._integration_step, left)
            fixed = held | locked
            after = self._integrate_step(x, command, fixed, step)
            if self._is_outside_limits(after):
                arrivals_left -= 1
                if arrivals_left < 0:
                    raise SpaceRobotError(FAILURES[1])
                # The step ends when the first joint leaves its limits.
                early = 0.0
                for _ in range(BISECTIONS):
                    middle = (early + step) / 2
                    after = self._integrate_step(x, command, fixed, middle)
                    outside = self._is_outside_limits(after)
                    early, step = (early, middle) if outside else (middle, step)
                after = self._integrate_step(x, command, fixed, step)
                after[self._q] = np.clip(after[self._q], self._lower, self._upper)
            x, left = after, left - step
            held, touched = self._bring_to_rest(x, command, held, locked)
            stopped |= touched
        return x, stopped

    def _bring_to_rest(
        self, x: Array, command: Array, held: Flags, locked: Flags
    ) -> tuple[Flags, Flags]:
        """Bring locked joints and joints on their stops to rest, in ``x``.

        Returns the joints that their stops hold through the next step, and these with the joints
        that have arrived. ``held`` are the joints that stops held until now.
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
                qdot[:], _ = stop_joints(np.asarray(np.linalg.inv(K)), qdot, locked)
                _, Q = self._equations(x, command)
            # Joints at rest on their stops are fixed joints from here on.
            free = np.where(locked, 0.0, 1.0)
            K, Q = np.where(np.eye(q.size) > 0, K, K * np.outer(free, free)), Q * free
        compliance: Array = np.asarray(np.linalg.inv(K))
        if np.any(inward * qdot < 0.0):
            touched = joints_stopped(compliance, qdot, inward, touched)
            qdot[:], _ = stop_joints(compliance, qdot, touched)
        pushed = qdot + self._integration_step * (compliance @ Q)
        held = joints_stopped(compliance, pushed, inward, held)
        if qdot[held].any():
            qdot[:], _ = stop_joints(compliance, qdot, held)
        return held, held | touched

    def _integrate_step(self, x: Array, command: Array, held: Flags, step: float) -> Array:
        after = self._step(x, command, np.where(held, 0.0, 1.0), step)[0]
        if not np.all(np.isfinite(after)):
            raise SpaceRobotError(FAILURES[0])
        return after

    def _is_outside_limits(self, x: Array) -> bool:
        q = x[self._q]
        return bool(np.any((q < self._below) | (q > self._above)))


def stop_joints(compliance: Array, rates: Array, joints: Flags) -> tuple[Array, Array]:
    """Return the rates (n,) after the impulses that stop some joints, and the impulses (n,).

    ``compliance`` (n, n) is the inverse of K.
    """
    after, impulses = rates.copy(), np.zeros_like(rates)
    if joints.any():
        impulses[joints] = np.linalg.solve(compliance[np.ix_(joints, joints)], -rates[joints])
        after += compliance @ impulses
        after[joints] = 0.0
    return after, impulses


def joints_stopped(compliance: Array, rates: Array, inward: Array, guess: Flags) -> Flags:
    """Return which joints (n,) are brought to rest by their stops, so that ``inward * rates >= 0``.

    ``inward`` is 1 or -1 on a stop and 0 elsewhere. The rates after the impulses are those nearest
    to the previous rates, in the metric of K. The linear complementarity problem is solved by
    Murty's least-index pivoting, which terminates for every positive definite K from any ``guess``.
    """
    joints = guess.copy()
    tried: set[bytes] = set()
    # A repeated set of joints differs from the other by rounding only: both are right.
    while joints.tobytes() not in tried:
        tried.add(joints.tobytes())
        after, impulses = stop_joints(compliance, rates, joints)
        wrong = np.flatnonzero(inward * np.where(joints, impulses, after) < 0.0)
        if not wrong.size:
            break
        joints[wrong[0]] = ~joints[wrong[0]]
    return joints


DEFAULT_INTEGRATION_STEP = 0.001
"""Longest Runge-Kutta step, s.

With this step, the energy of a tumbling six-joint arm at several rad/s has a relative drift of
about 1e-12 in 100 s; with steps four times as long, the drift is 2e-10. A step takes a few
microseconds.
"""

_MAX_FINITE_STATE = 1e100
"""Magnitude (SI units) beyond which a state is considered diverged."""


class EffortPlant(CompiledPlant):
    """A free-flying robot whose joint efforts and base wrench are constant during each tick.

    After :meth:`step`, the attributes are those of :class:`Plant`, where ``effort`` is the last
    tick's effort after clipping, without stop efforts, and

    ``wrench``
        (6,) force (N) and torque (N m) of the last tick at the base link origin, in base
        components.

    See :class:`.CompiledPlant` for the parameters and errors of the constructor.
    """

    actuation: ClassVar[str] = "effort"
    default_integration_step: ClassVar[float] = DEFAULT_INTEGRATION_STEP
    takes_wrench: ClassVar[bool] = True
    limits: ClassVar[tuple[str, str]] = "effort", "stroke"

    @override
    def _bind(self, inputs: Sequence[Array], outputs: Sequence[Array]) -> None:
        robot, n = self.robot, self.robot.n
        self._stops = JointStops(robot, self.control_period / self._substeps)
        self._loads: PlantLoads | None = None
        self._state, self._command, self._h = inputs
        self._next_state, self.pose, self.twist, self._realised = outputs[:4]
        self.momentum, self.link_R, self.link_r, self._limited = outputs[4:]
        shape, _, rates, p_W, L_W, _ = state_slices(n)
        self.q, self.qdot = self._next_state[shape], self._next_state[rates]
        self.expected_momenta = self._next_state[p_W.start : L_W.stop]
        self.effort, self.wrench = self._realised[:n], self._realised[n:]
        self._held = np.zeros(n, dtype=np.bool_)
        self._holding = False

    def reset(self) -> None:
        """Return to the initial state, with zero efforts; the limit counters are kept."""
        start, robot = self.initial, self.robot
        self._state[:] = np.concatenate(
            [
                start.shape(robot),
                start.attitude(),
                start.rates(robot),
                start.momenta(),
                start.system_position(robot),
            ]
        )
        self._command[:] = 0.0
        self._update_outputs()

    @property
    def state(self) -> Array:
        """The state (2 n + 13,) of :mod:`spacerobot_ros.model.integration` from which the
        next step starts; it may be modified in place.
        """
        return self._next_state

    def hold(self, joints: Flags) -> None:
        """Lock the marked joints (n,) at their positions, and release all others.

        A moving joint is stopped by an internal impulse; both total momenta are unchanged.
        """
        self._held[:] = joints
        self._holding = bool(joints.any())

    def load(self, loads: PlantLoads) -> None:
        """Apply external loads; their values may change before each step."""
        self._loads = loads
        self._use_loads(loads)
        self._stops = JointStops(self.robot, self.control_period / self._substeps, loaded=True)

    def step(self, effort: npt.ArrayLike, wrench: npt.ArrayLike = 0.0) -> bool:
        """Advance one tick under joint efforts (n,), clipped to their limits, and under a base
        wrench.

        ``wrench`` (6,) is force (N) and torque (N m) at the base link origin, in the base frame;
        it rotates with the base during the tick. A joint that reaches its limit stops there without
        rebound and is held while something pushes it outwards. Returns whether any joint was
        limited.

        Raises
        ------
        CommandError
            A command is not finite; the plant does not advance.
        SpaceRobotError
            The motion is no longer finite; the plant does not advance.
        """
        n = self.robot.n
        self._state[:] = self._next_state
        self._command[:n] = effort
        self._command[n:] = wrench
        self._tick.evaluate()
        if self._limited[0] == 0.0 and not self._holding:
            return False
        return self._apply_limits()

    def _apply_limits(self) -> bool:
        n = self.robot.n
        clipped, touched = self._limited[1 : 1 + n] != 0.0, self._limited[1 + n] != 0.0
        stopped = np.zeros(n, dtype=np.bool_)
        try:
            if not np.all(np.isfinite(self._command)):
                raise CommandError(f"A command is not finite: {self._command.tolist()}.")
            if touched or self._holding:
                state, command, loads = self._state, self._realised, self._loads
                if loads is not None:
                    state = np.append(state, loads.time)
                    command = np.concatenate([command, loads.vector])
                after, stopped = self._stops.advance(
                    state, command, self.control_period, self._held
                )
                self._state[:] = after[: self._state.size]
                self._update_outputs()
        except SpaceRobotError:
            # The plant keeps the state from before the tick.
            self._command[:] = 0.0
            self._update_outputs()
            raise
        self.limit_counts["effort"] += clipped
        self.limit_counts["stroke"] += stopped
        return bool(clipped.any() or stopped.any())

    @staticmethod
    @override
    def tick_function(
        robot: SpaceRobot, model: Composition, substeps: int, *, loaded: bool = False
    ) -> ca.Function:
        n = robot.n
        parts = state_slices(n)
        state, command = ca.MX.sym("state", parts[-1].stop), ca.MX.sym("command", n + 6)
        h = ca.MX.sym("h")
        lowest, highest = -robot.effort_limit, robot.effort_limit
        if wheels := robot.description.wheel_names:
            is_wheel = np.array([name in wheels for name in robot.joint_names])
            rate, qdot = np.where(is_wheel, robot.velocity_limit, np.inf), state[parts[2]]
            lowest = ca.if_else(qdot <= -rate, 0.0, lowest)
            highest = ca.if_else(qdot >= rate, 0.0, highest)
        effort = ca.fmin(ca.fmax(command[:n], lowest), highest)
        realised = ca.vertcat(effort, command[n:])
        march = repeat_step(_step_counting_stops(robot, model, loaded=loaded), substeps)
        p, touching = list(model.inputs.values()), _count_touching_joints(robot, state)
        layout = LoadLayout(len(robot.link_names))
        loads = [ca.MX.sym("loads", layout.size)] if loaded else []
        x = ca.vertcat(state, *(each[layout.time] for each in loads), touching)
        marched = march(x, ca.vertcat(realised, *loads), h / substeps, *p)
        next_state = marched[: parts[-1].stop]

        q, quaternion, qdot, p_W, L_W, r_WC_W = (next_state[part] for part in parts)
        pose, twist, bodies = body_outputs(model, q, quaternion, qdot, (p_W, L_W), r_WC_W)
        clipped = command[:n] != effort
        # A comparison with NaN is false.
        diverged = parts[-1].stop - ca.sum1(ca.fabs(next_state) < _MAX_FINITE_STATE)
        touched = marched[-1] + diverged
        return model.function(
            f"loaded_effort_tick_{substeps}" if loaded else f"effort_tick_{substeps}",
            [state, command, h, *loads],
            [
                next_state,
                pose,
                twist,
                realised,
                *bodies,
                ca.densify(ca.vertcat(ca.sum1(clipped) + touched, clipped, touched)),
            ],
        )


def _step_counting_stops(
    robot: SpaceRobot, model: Composition, *, loaded: bool = False
) -> ca.Function:
    """Return the integration step with one more state, a count of joints on or beyond stops.

    The count grows at the end of each step: a joint cannot swing beyond its limit and back in one.
    """
    state_size, command_size = state_slices(robot.n)[-1].stop, robot.n + 6
    if loaded:
        state_size, command_size = (
            state_size + 1,
            command_size + LoadLayout(len(robot.link_names)).size,
        )
    watched = ca.MX.sym("x", state_size + 1)
    command, h = ca.MX.sym("command", command_size), ca.MX.sym("h")
    x = model("loaded_flight_step" if loaded else "flight_step", watched[:-1], command, h)
    counted = ca.vertcat(x, watched[-1] + _count_touching_joints(robot, x))
    return model.function("watched_step", [watched, command, h], [counted])


def _count_touching_joints(robot: SpaceRobot, state: ca.MX) -> ca.MX:
    """Return the number of joints that are not strictly inside their limits."""
    q = state[: robot.n]
    return robot.n - ca.sum1(ca.logic_and(q > ca.DM(robot.lower), q < ca.DM(robot.upper)))
