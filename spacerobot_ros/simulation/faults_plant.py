"""A plant with faults: commands are what the broken actuators make of them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.simulation.faults import KINDS, WRENCH_AXES, Fault, FaultTimeline, Targets
from spacerobot_ros.simulation.plant import Plant, WrappedPlant
from spacerobot_ros.simulation.thrusters import thrusters_in

_ROUNDING = 1e-6
"""Share of a tick by which the time of a fault may be off by rounding."""


class FaultyPlant(WrappedPlant):
    """A :class:`Plant` whose actuators have the faults of a timeline.

    Everything it reports is that of the plant within, in the same arrays; a reset turns neither
    time nor faults back. A tick under no fault costs one comparison more.

    Bias and noise are added to a joint's command, then a slow joint's is scaled, then a stuck
    joint is held where it is (:meth:`Plant.hold`).

    Parameters
    ----------
    plant
        The plant within.
    faults
        What goes wrong and when, a fault a line (:func:`parse_fault`).
    tick_period
        Duration of a tick, s.
    wrench
        Whether steps take a wrench.
    seed
        Of the actuators' noise.

    Raises
    ------
    ParameterError
        A line is no fault of this plant.
    """

    def __init__(
        self,
        plant: Plant,
        faults: Iterable[str],
        tick_period: float,
        *,
        wrench: bool,
        seed: int = 0,
    ) -> None:
        super().__init__(plant)
        self._thrusters = thrusters_in(plant)
        nozzles = self._thrusters.table.names if self._thrusters is not None else ()
        self.timeline = FaultTimeline(faults, Targets(plant.robot.joint_names, wrench, nozzles))
        self.tick = 0
        """Ticks since the beginning."""
        self.step: Callable[..., bool] = self._step
        self._tick_period = tick_period
        self._rng = np.random.default_rng(seed)
        self._index = {name: i for i, name in enumerate(self.robot.joint_names)}
        n = self.robot.n
        self._bias, self._noise, self._factor = np.zeros(n), np.zeros(n), np.ones(n)
        self._wrench_factor, self._wrench_held = np.ones(6), np.zeros(6)
        self._actuators_sound = True
        self._seen: tuple[Fault, ...] = ()
        self.look()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self.tick * self._tick_period

    @property
    def active(self) -> tuple[Fault, ...]:
        """The faults that are active now; another tuple whenever they change."""
        return self._seen

    def inject(self, text: str) -> None:
        """Add faults while the plant runs, one a line; the text ``clear`` repairs everything.

        Raises
        ------
        ParameterError
            A line is no fault of this robot; none is added.
        """
        if text.strip() == "clear":
            self.timeline.clear()
        else:
            self.timeline.read(text.splitlines(), self.time)
        self.look()

    def look(self) -> None:
        """Take up the faults of this moment."""
        active = self.timeline.at(self.time + _ROUNDING * self._tick_period)
        self._next_tick = self.timeline.next_change / self._tick_period - _ROUNDING
        if active is self._seen:
            return
        self._seen = active
        self._bias[:], self._noise[:], self._factor[:] = 0.0, 0.0, 1.0
        self._wrench_factor[:], self._wrench_held[:] = 1.0, 0.0
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
            elif fault.kind == "thruster_weak":
                self._wrench_factor[axes] *= fault.value
        self._noise[:] = np.sqrt(variances)
        self.plant.hold(held)
        self._disturb_nozzles(active)
        self._actuators_sound = all(KINDS[f.kind].sensor for f in active)

    def _disturb_nozzles(self, active: tuple[Fault, ...]) -> None:
        thrusters = self._thrusters
        if thrusters is None:
            return
        thrusters.thruster_health[:], thrusters.stuck_on[:] = 1.0, False
        for fault in active:
            if fault.kind.startswith("nozzle_"):
                nozzle = thrusters.table.names.index(fault.target)
                if fault.kind == "nozzle_open":
                    thrusters.stuck_on[nozzle] = True
                else:
                    thrusters.thruster_health[nozzle] *= fault.value

    def _step(self, *commands: Any) -> bool:
        """Advance a tick under commands as the plant within takes them."""
        if self._actuators_sound:
            limited = self.plant.step(*commands)
        else:
            limited = self.plant.step(*self._realised(*commands))
        self.tick += 1
        if self.tick >= self._next_tick:
            self.look()
        return limited

    def _realised(self, joints: Array, *wrench: Array) -> list[Array]:
        """Return what the actuators make of the commands, which stay as they are."""
        disturbed = joints + self._bias
        if self._noise.any():
            disturbed += self._noise * self._rng.standard_normal(self.robot.n)
        realised = [self._factor * disturbed]
        if wrench:
            realised.append(self._wrench_factor * wrench[0] + self._wrench_held)
        return realised
