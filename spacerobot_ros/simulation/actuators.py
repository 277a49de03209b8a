"""Plant actuators: thrusters, actuator faults and disturbances.

:func:`build_plant` builds a plant from its configuration: a :class:`.VelocityPlant` or
:class:`.EffortPlant`, wrapped in a :class:`.CapturePlant` if there is a target, in a
:class:`ThrusterPlant` if thrusters are modelled, and in a :class:`PlantWithFaults`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import CommandError, ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.thrusters import ThrusterModulator, find_thrusters
from spacerobot_ros.simulation.capture import CapturePlant, Target, load_target
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.simulation.faults import (
    FAULT_KINDS,
    WRENCH_AXES,
    Disturbance,
    Fault,
    FaultTargets,
    Timeline,
    parse_disturbance,
    parse_fault,
)
from spacerobot_ros.simulation.loads import PlantLoads, Surroundings
from spacerobot_ros.simulation.plant import InitialState, Plant, WrappedPlant
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

_FAULT_TIME_ROUNDING = 1e-6
"""Allowed rounding error in a fault time, as a fraction of a tick."""

_MIN_STEP = 1e-5
"""Shortest Runge-Kutta step, s; shorter steps increase rounding errors more than accuracy."""

_MAX_STEPS_PER_TICK = 1e6
"""Largest number of Runge-Kutta steps in a tick; with more steps, a tick would take minutes."""


class ThrusterPlant(WrappedPlant):
    """An effort-driven plant whose base wrench is realised by thruster on/off pulses.

    The dynamics are stepped with the actual thruster wrench, averaged over the tick, so the
    momentum balance stays exact. Attributes in addition to those of :class:`Plant`:

    ``wrench``
        (6,) mean force (N) and torque (N m) of the thrusters in the last tick, at the base link
        origin, in the base frame.
    ``on_time``, ``duty``, ``thrust``
        (m,) total on-time of each thruster (s), and its duty cycle (0 to 1) and mean force (N) in
        the last tick.
    ``propellant``
        Total consumption, kg; the robot mass does not change.
    ``modulator``
        The flight software that opens and closes the thrusters, and counts pulses and unmet
        wrenches.
    ``thruster_health``, ``stuck_on``
        (m,) ratio of actual to nominal thrust (1 unless set), and whether a thruster is stuck open.
        The allocation ignores both attributes; see :meth:`.ThrusterModulator.exclude`.
    ``wrench_fault``
        Factors (6,) by which the thruster wrench is multiplied, and wrench (6,) added to the
        product; None if there is no fault. The modulation ignores it.

    Raises
    ------
    ParameterError
        A thruster is invalid, or a disabled thruster does not exist.
    """

    def __init__(self, plant: Plant, config: PlantConfig) -> None:
        super().__init__(plant)
        self.table = table = find_thrusters(config.thrusters, plant.robot.description)
        disabled = config.thrusters_excluded.split()
        self.modulator = ThrusterModulator(table, self.control_period, disabled)
        self._wrenches, self._mass_flow = table.wrenches, table.mass_flow
        count = len(table.names)
        self.wrench = np.zeros(6)
        self.on_time, self.duty, self.thrust = (np.zeros(count) for _ in range(3))
        self.propellant = 0.0
        self.thruster_health = np.ones(count)
        self.stuck_on: npt.NDArray[np.bool_] = np.zeros(count, dtype=np.bool_)
        self.wrench_fault: tuple[Array, Array] | None = None

    def reset(self) -> None:
        """Return to the initial state with thrusters off; totals and counters are kept."""
        super().reset()
        self.modulator.reset()
        self.wrench[:] = self.duty[:] = self.thrust[:] = 0.0

    def step(self, effort: npt.ArrayLike, wrench: npt.ArrayLike = 0.0) -> bool:
        """Advance one tick under joint efforts (n,) and a commanded base wrench (6,).

        Returns whether any joint was limited.

        Raises
        ------
        CommandError
            A command is not finite; the plant does not advance.
        SpaceRobotError
            The wrapped plant cannot advance.
        """
        wanted = np.broadcast_to(np.asarray(wrench, dtype=float), (6,))
        for command in (effort, wanted):
            if not np.all(np.isfinite(command)):
                raise CommandError(f"A command is not finite: {np.asarray(command).tolist()}.")
        tick = self.control_period
        on_time = self.modulator.fire(wanted)
        on_time[self.stuck_on] = tick
        self.duty[:] = on_time / tick
        works = self.thruster_health * self.duty
        self.thrust[:] = self.table.force * works
        self.wrench[:] = self._wrenches @ works
        if self.wrench_fault is not None:
            factor, added = self.wrench_fault
            self.wrench[:] = factor * self.wrench + added
        self.on_time += on_time
        self.propellant += tick * float(self._mass_flow @ works)
        limited: bool = self.plant.step(effort, self.wrench)
        return limited


class PlantWithFaults(WrappedPlant):
    """A :class:`Plant` with scheduled actuator faults and disturbances.

    This plant shares the wrapped plant's state arrays. A reset preserves the time, the faults and
    the disturbances. Until the first disturbance is known, the plant steps without external loads.

    Bias and noise are added to a joint command, which is then scaled if the joint is slow; a
    stuck joint is held in place (:meth:`Plant.hold`). Wrench faults act on the commanded wrench, or
    on the thrusters' wrench if thrusters are modelled.

    The orbit or table loads of the ``surroundings`` act during the whole flight.

    Raises
    ------
    ParameterError
        A line is not a valid fault or disturbance for this plant.
    """

    def __init__(
        self, plant: Plant, config: PlantConfig, surroundings: Surroundings | None = None
    ) -> None:
        super().__init__(plant)
        self.thrusters = plant if isinstance(plant, ThrusterPlant) else None
        """The wrapped plant with thrusters; None if thrusters are not modelled."""
        inner = plant if self.thrusters is None else self.thrusters.plant
        self.capturing = inner if isinstance(inner, CapturePlant) else None
        """The plant that captures the target; None if there is no target."""
        nozzles = self.thrusters.table.names if self.thrusters is not None else ()
        self.takes_wrench = PLANTS[config.actuation].takes_wrench
        """Whether a step accepts a base wrench in addition to the joint commands."""
        targets = FaultTargets(plant.robot.joint_names, self.takes_wrench, nozzles)
        self.timeline = Timeline(config.faults, lambda line, now: parse_fault(line, targets, now))
        self.tick = 0
        """Ticks since the beginning."""
        # The random stream differs from the sensors' stream, which has the seed itself.
        self._rng = np.random.default_rng(np.random.SeedSequence(config.sensors.seed).spawn(1)[0])
        self._index = {name: i for i, name in enumerate(self.robot.joint_names)}
        n = self.robot.n
        self._bias, self._noise, self._factor = np.zeros(n), np.zeros(n), np.ones(n)
        self._wrench_factor, self._wrench_held = np.ones(6), np.zeros(6)
        self._actuators_sound = True
        self.active: tuple[Fault, ...] = ()
        """Active faults; a new tuple object after every change."""
        self.disturbances: tuple[Disturbance, ...] = ()
        """Active disturbances; a new tuple object after every change."""
        self.injected: tuple[Fault | Disturbance, ...] = ()
        """Active faults and disturbances; a new tuple object after every change."""
        self.loads: PlantLoads | None = None
        """External loads; None if no load has acted so far."""
        self._disturbances = Timeline(
            config.disturbances,
            lambda line, now: parse_disturbance(line, plant.robot.link_names, now),
        )
        self._surroundings = surroundings or Surroundings()
        self._update_active()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.tick * self.control_period

    def start_at(self, tick: int) -> None:
        """Continue from another time, given as the number of ticks since the beginning."""
        self.tick = tick
        self._update_active()

    def inject(self, text: str) -> None:
        """Add faults, one per line, while the plant runs; ``clear`` removes all faults.

        Raises
        ------
        ParameterError
            A line is not a valid fault for this robot; none of the lines is added.
        """
        self.timeline.inject(text, self.time)
        self._update_active()

    def disturb(self, text: str) -> None:
        """Add disturbances, one per line, while the plant runs; ``clear`` removes them all.

        Raises
        ------
        ParameterError
            A line is not a valid disturbance for this robot; none of the lines is added.
        """
        self._disturbances.inject(text, self.time)
        self._update_active()

    def succeed(self, before: PlantWithFaults) -> None:
        """Take over the time, faults and disturbances of the robot's previous plant."""
        self.timeline.copy_from(before.timeline)
        self._disturbances.copy_from(before._disturbances)
        self.start_at(before.tick)

    def step(self, *commands: Any) -> bool:
        """Advance one tick under commands as for the wrapped plant; return whether a joint was
        limited."""
        if self.loads is not None:
            self.loads.time = self.time
            self.loads.last[:] = self.loads.vector
        if self._actuators_sound:
            limited = self.plant.step(*commands)
        else:
            limited = self.plant.step(*self._faulty_commands(*commands))
        self.tick += 1
        if self.tick >= self._next_tick:
            self._update_active()
        return limited

    def _update_active(self) -> None:
        """Apply the faults and disturbances that are active at the current time."""
        period, timelines = self.control_period, (self.timeline, self._disturbances)
        now = self.time + _FAULT_TIME_ROUNDING * period
        faults, disturbances = self.timeline.at(now), self._disturbances.at(now)
        next_change = min(each.next_change for each in timelines)
        self._next_tick = next_change / period - _FAULT_TIME_ROUNDING
        if self.loads is None and (self._disturbances.entries or self._surroundings.has_loads):
            self.loads = PlantLoads(self.robot, self._surroundings)
            self.plant.load(self.loads)
        if faults is not self.active:
            self.active = faults
            self._apply_faults(faults)
        if disturbances is not self.disturbances and self.loads is not None:
            self.disturbances = disturbances
            loads = self.loads
            loads.in_link[:] = loads.in_world[:] = 0.0
            for each in disturbances:
                wrenches = loads.in_link if each.in_link else loads.in_world
                wrenches[self.robot.link_names.index(each.link)] += (*each.force, *each.torque)
        if self.injected != (*faults, *disturbances):
            self.injected = (*faults, *disturbances)

    def _apply_faults(self, active: tuple[Fault, ...]) -> None:
        self._bias[:], self._noise[:], self._factor[:] = 0.0, 0.0, 1.0
        self._wrench_factor[:], self._wrench_held[:] = 1.0, 0.0
        wrench_faulty, thrusters = False, self.thrusters
        if thrusters is not None:
            thrusters.thruster_health[:], thrusters.stuck_on[:] = 1.0, False
        held = np.zeros(self.robot.n, dtype=np.bool_)
        variances = np.zeros_like(self._noise)
        for fault in active:
            axes = [fault.target in (axis, "all") for axis in WRENCH_AXES]
            joint = self._index.get(fault.target, -1)
            if fault.kind == "joint_stuck":
                held[joint] = True
            elif fault.kind == "joint_slow":
                self._factor[joint] *= fault.value
            elif fault.kind == "actuator_bias":
                self._bias[joint] += fault.value
            elif fault.kind == "actuator_noise":
                variances[joint] += fault.value**2
            elif fault.kind in ("thruster_off", "thruster_stuck"):
                self._wrench_factor[axes] = 0.0
                self._wrench_held[axes] = fault.value
                wrench_faulty = True
            elif fault.kind == "thruster_weak":
                self._wrench_factor[axes] *= fault.value
                wrench_faulty = True
            elif fault.kind.startswith("nozzle_") and thrusters is not None:
                nozzle = thrusters.table.names.index(fault.target)
                if fault.kind == "nozzle_open":
                    thrusters.stuck_on[nozzle] = True
                else:
                    thrusters.thruster_health[nozzle] *= fault.value
        self._noise[:] = np.sqrt(variances)
        self.plant.hold(held)
        if thrusters is not None:
            fault_of_wrench = self._wrench_factor, self._wrench_held
            thrusters.wrench_fault = fault_of_wrench if wrench_faulty else None
        self._actuators_sound = all(FAULT_KINDS[f.kind].sensor for f in active)

    def _faulty_commands(self, joints: Array, *wrench: Array) -> list[Array]:
        """Return the commands as the faulty actuators realise them (new arrays)."""
        disturbed = joints + self._bias
        if self._noise.any():
            disturbed += self._noise * self._rng.standard_normal(self.robot.n)
        realised = [self._factor * disturbed]
        if wrench and self.thrusters is None:
            realised.append(self._wrench_factor * wrench[0] + self._wrench_held)
        elif wrench:  # The thrusters apply wrench faults themselves.
            realised.append(wrench[0])
        return realised


PLANTS: dict[str, type[VelocityPlant | EffortPlant]] = {
    each.actuation: each for each in (VelocityPlant, EffortPlant)
}
"""Plant classes by the value of parameter ``actuation``."""


def build_plant(
    robot: SpaceRobot, config: PlantConfig, initial: InitialState | None = None
) -> PlantWithFaults:
    """Build a plant from its configuration, including thrusters and faults.

    Parameters
    ----------
    robot
        The model.
    config
        The plant parameters.
    initial
        Initial state, if it differs from the one in the configuration.

    Raises
    ------
    ParameterError
        The integration step is too short, or the initial state, the target, a thruster, a fault or
        a disturbance is invalid.
    RobotDescriptionError
        MuJoCo rejects the robot or the target.
    SpaceRobotError
        MuJoCo is not installed.
    """
    config = config.decided()
    kind, step = PLANTS[config.actuation], config.integration_step
    control_period = config.control_period
    if 0.0 < step < _MIN_STEP:
        raise ParameterError(
            f"Parameter 'integration_step' is {step}; it must be 0 (automatic) or at least "
            f"{_MIN_STEP:g} s."
        )
    if config.thrusters and not kind.takes_wrench:
        raise ParameterError(
            f"Parameter 'thrusters' is '{config.thrusters}', but actuation "
            f"'{config.actuation}' has no base wrench: set actuation to effort, or "
            "thrusters to ''."
        )
    if step and control_period / step > _MAX_STEPS_PER_TICK:
        raise ParameterError(
            f"Parameter 'integration_step' is {step:g} s, which is more than "
            f"{_MAX_STEPS_PER_TICK:.0e} steps in a tick of {control_period:g} s; "
            "use longer steps or shorter ticks."
        )
    start = InitialState.of(config) if initial is None else initial
    surroundings = Surroundings.of(config.orbit, config.table)
    surroundings.require_suitable(robot, start.attitude())
    description = load_target(config.target)
    plant: Plant
    if config.engine == "mujoco":
        # Slow to import, and few plants need it.
        from spacerobot_ros.simulation import mujoco_plant

        step = step or mujoco_plant.DEFAULT_INTEGRATION_STEP
        if description is None:
            plant = mujoco_plant.MujocoPlant(
                robot, control_period, start, step, actuation=config.actuation
            )
        else:
            plant = mujoco_plant.MujocoCapturePlant(robot, start, step, description, config)
    else:
        step = step or kind.default_integration_step

        def dynamics(of: SpaceRobot, at: InitialState) -> Plant:
            return kind(of, control_period, at, step)

        if description is None:
            plant = dynamics(robot, start)
        else:
            target = Target(description, config.target, control_period, step, robot)
            plant = CapturePlant(dynamics, robot, start, target, config)
    if config.thrusters:
        plant = ThrusterPlant(plant, config)
    return PlantWithFaults(plant, config, surroundings)
