"""What the specification demands of motion that nobody has asked for."""

from __future__ import annotations

import numpy as np
from support.random_actions.expectations import SECOND, Goals, Situation, State
from support.random_actions.setups import Setup

from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.simulation.status import PlantState

_ROUNDING = 1e-12
"""Rates and steps that are none: what is left of a rate that is braked to zero."""


class RestCheck:
    """Nothing moves under a latch, nor after it before another goal, nor without a goal at all."""

    def __init__(self, setup: Setup, situation: Situation, goals: Goals) -> None:
        self._setup, self._situation, self._goals = setup, situation, goals
        self._names = setup.model.joint_names
        self._braked = ReactionWheels.of(setup.model.description).other
        self._fastest: float | None = None
        """Largest joint rate since motors began to brake."""
        self._since = 0

    def look(self, now: State, before: State | None) -> str | None:
        if before is not None and now.time_ns == before.time_ns and now.equals(before):
            return None  # The state is shown again; the rates are those of the tick before it.
        if self._setup.servos:
            why = self._must_rest(now)
            return self._servos_rest(now, before, why) if why else None
        return self._motors_brake(now)

    def _must_rest(self, now: State) -> str:
        situation = self._situation
        if situation.latched and now.time_ns > situation.latched_at:
            return "under a latch"
        if not situation.goal_since_stop:
            return "after a latch, without another goal"
        if situation.status.state is not PlantState.RUNNING:
            return f"while the plant says that it is {situation.status.state.value}"
        if not self._goals.pursued and now.time_ns > situation.stopping_until:
            return f"without a goal (the planner is {self._goals.last})"
        return ""

    def _servos_rest(self, now: State, before: State | None, why: str) -> str | None:
        period = self._setup.period_ns
        free = self._situation.acting(now.time_ns, period, "actuator_noise", "actuator_bias")
        for name, rate in zip(self._names, now.qdot, strict=True):
            if abs(rate) > _ROUNDING and name not in free:
                return f"joint {name} moves at {rate:.3g} {why}"
        if before is None or now.time_ns != before.time_ns + period:
            return None
        for name, step in zip(self._names, now.q - before.q, strict=True):
            if abs(step) > _ROUNDING and name not in free:
                return f"joint {name} goes on by {step:.3g} {why}"
        return None

    def _motors_brake(self, now: State) -> str | None:
        """Rates fall as exp(-5 t) at least; brakes that are strong enough do four times better."""
        situation = self._situation
        disturbed = any(
            not d.kind.startswith("sensor") and d.end + 5.0 > now.time_ns / SECOND
            for d in situation.disturbances
        )
        if not situation.latched or disturbed or now.time_ns <= situation.latched_at:
            self._fastest = None
            return None
        rate = float(np.abs(now.qdot[self._braked]).max(initial=0.0))  # Wheels spin on.
        if self._fastest is None:
            self._fastest, self._since = rate, now.time_ns
        elapsed = (now.time_ns - self._since) / SECOND
        bound = 1.5 * self._fastest * np.exp(-5.0 * elapsed) + 1e-5
        if rate > bound:
            return f"joints move at {rate:.3g} {elapsed:.3g} s after a latch ({bound:.3g} at most)"
        return None


def energy_of_pulses(setup: Setup) -> float:
    """Return the kinetic energy of one shortest pulse of every thruster that pushes one way, J.

    No modulator owes more (:class:`.ThrusterModulator`): of each axis of force and torque, the half
    of the thrusters that pushes more that way fires on, from rest.
    """
    robot = setup.model
    table = find_thrusters(str(setup.plant["thrusters"]), robot.description)
    impulses = table.wrenches * table.min_on_time
    most = np.maximum(np.maximum(impulses, 0.0).sum(axis=1), np.maximum(-impulses, 0.0).sum(axis=1))
    D = np.array(robot.function("locked_inertia")(setup.home)[0])
    least = float(np.linalg.eigvalsh(D).min())
    force, torque = most[:3].max(), most[3:].max()
    return float(0.5 * force**2 / robot.total_mass + 0.5 * torque**2 / least)


class EnergyCheck:
    """From a latch on, and after the rearm until there is a goal, kinetic energy is not made.

    For robots that efforts drive. Under the latch nothing thrusts, both momenta stay, and brakes
    take energy away. After the rearm a controller holds the robot where it is: thrusters may brake
    the base, and the arm may swing with it, but a spring that begins where the robot is and a
    damper never give more than there was. Thrusters that are on or off push too much, and so do
    commands that a busy machine holds longer than their control period, in real time. Reaction
    wheels hold a base still with the energy of their motors.
    """

    FLOOR = 1e-12
    """Energy that is none, J. A robot at rest is held by a spring and a damper of nothing: what is
    left is rounding of its state, of order 1e-16 m and rad, and with gains up to 1e3 N/m and times
    of 1 s, 1e-13 m/s. Of 1e3 kg that is 1e-23 J; measured in lockstep: 3e-34 J."""

    FLOOR_OF_LATENESS = 1e-4
    """The same in real time, J. A command that is held for a time t instead of a control period has
    the dampers push on by their force: a speed v becomes v (1 - kd t / m), so energy grows where t
    is beyond 2 m / kd, 0.1 s of the lightest load here, by the share that there was of it. What
    begins with less than a tenth of a mJ may become that much on a machine that is so late; beside
    sixteen processes on two processors nothing of it was measured."""

    SHARE = 1.02

    def __init__(self, setup: Setup, situation: Situation, *, lockstep: bool) -> None:
        self._setup, self._situation = setup, situation
        self._has_wheels = len(ReactionWheels.of(setup.model.description).index) > 0
        self._floor = self.FLOOR if lockstep else self.FLOOR_OF_LATENESS
        if setup.plant.get("thrusters"):
            self._floor += energy_of_pulses(setup)
        self._most: float | None = None
        """Kinetic energy under the latch at first, J."""
        self._latched_at = -1
        self.states, self.rearmed = 0, 0
        """States that were compared, and those of them that came after the rearm."""

    def look(self, now: State, before: State | None) -> str | None:
        situation = self._situation
        stopped = situation.latched or not situation.goal_since_stop
        if self._setup.servos or self._has_wheels:
            return None
        if self._disturbed(now) or self._latched_at != situation.latched_at:
            self._most, self._latched_at = None, situation.latched_at
            return None
        if not stopped:
            # A goal may still be refused. Otherwise it is one for good, until the next latch.
            return None
        energy = float(now.momentum[6])
        if situation.latched and now.time_ns <= situation.latched_at:
            return None
        if self._most is None or (before is not None and now.time_ns <= before.time_ns):
            # Energy is compared from a latch on alone: later there may be a spring already.
            self._most = energy if situation.latched else None
            return None
        self.states += 1
        self.rearmed += situation.rearmed
        if energy > self.SHARE * self._most + self._floor:
            return f"energy is {energy:.3g} J after a latch, where it was {self._most:.3g} J"
        return None

    def _disturbed(self, now: State) -> bool:
        """Whether a fault may have acted on the robot since the latch."""
        time, latched = now.time_ns / SECOND, self._situation.latched_at / SECOND
        return any(
            d.start - 1.0 < time and d.end + 0.5 > latched for d in self._situation.disturbances
        )
