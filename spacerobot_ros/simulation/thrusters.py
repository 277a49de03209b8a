"""A plant whose base wrench comes from thrusters as they are: discrete, one way, on or off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.thrusters import ThrusterModulator, ThrusterTable, find_thrusters
from spacerobot_ros.errors import CommandError
from spacerobot_ros.simulation.plant import Plant, WrappedPlant


class ThrusterPlant(WrappedPlant):
    """A plant under efforts, its wanted base wrench realised by pulses of thrusters.

    Everything of the plant within is as it was; its momentum balance stays exact because what the
    thrusters put in is the wrench that it is stepped with. A thruster that is on for part of a tick
    gives its impulse evenly over the tick. Besides, there are

    ``wrench``
        (6,) force (N) over torque (N m) at the origin of the base link, base components, that the
        thrusters gave in the last tick, on the average.
    ``on_time``, ``duty``, ``thrust``
        (m,) for how long each was on since the beginning (s), for what part of the last tick, and
        its mean force in it (N).
    ``pulses``
        (m,) how often each was turned on.
    ``propellant``
        Used since the beginning, kg. The mass of the robot does not change by it.
    ``unmet``, ``unmet_ticks``
        (6,) what the last tick's wanted wrench lost to the thrusters' limits, and in how many ticks
        it lost anything.
    ``thruster_health``, ``stuck_on``
        (m,) thrust over what the table says, 1 unless set, and whether a thruster is on whatever is
        commanded, false unless set. The allocation takes neither into account; see
        :meth:`exclude`.

    Parameters
    ----------
    plant
        The plant within; its steps take efforts and a wrench.
    control_period
        Duration of a tick, s.
    table
        The thrusters.
    excluded
        Names of thrusters that are not used.

    Raises
    ------
    ParameterError
        There is no thruster of an excluded name.
    """

    def __init__(
        self,
        plant: Plant,
        control_period: float,
        table: ThrusterTable,
        excluded: Sequence[str] = (),
    ) -> None:
        super().__init__(plant)
        self.table = table
        self._control_period = control_period
        self._modulator = ThrusterModulator(table, control_period, excluded)
        self._wrenches, self._mass_flow = table.wrenches, table.mass_flow
        count = len(table.names)
        self.wrench = np.zeros(6)
        self.on_time, self.duty, self.thrust = (np.zeros(count) for _ in range(3))
        self.pulses, self.unmet = self._modulator.pulses, self._modulator.unmet
        self.propellant = 0.0
        self.thruster_health = np.ones(count)
        self.stuck_on: npt.NDArray[np.bool_] = np.zeros(count, dtype=np.bool_)

    @property
    def missing(self) -> str:
        """What the thrusters in use cannot give; empty if they give every wrench."""
        return self._modulator.missing

    @property
    def unmet_ticks(self) -> int:
        """In how many ticks the wanted wrench lost anything to the thrusters' limits."""
        return self._modulator.unmet_periods

    def exclude(self, name: str) -> None:
        """Use a thruster no more, because it is dead; the others give the wrench, if they can.

        Raises
        ------
        ParameterError
            There is no thruster of that name.
        """
        self._modulator.exclude(name)

    def reset(self) -> None:
        """Return to the initial state, thrusters off; what was used and counted goes on."""
        super().reset()
        self._modulator.reset()
        self.wrench[:] = self.duty[:] = self.thrust[:] = 0.0

    def step(self, effort: npt.ArrayLike, wrench: npt.ArrayLike = 0.0) -> bool:
        """Advance one tick under joint efforts (n,) and the wrench (6,) that is wanted on the base.

        Returns whether any joint was limited.

        Raises
        ------
        CommandError
            A command is not finite; the tick is not taken.
        SpaceRobotError
            The plant within refuses.
        """
        wanted = np.broadcast_to(np.asarray(wrench, dtype=float), (6,))
        for command in (effort, wanted):
            if not np.all(np.isfinite(command)):
                raise CommandError(f"A command is not finite: {np.asarray(command).tolist()}.")
        tick = self._control_period
        on_time = self._modulator.fire(wanted)
        on_time[self.stuck_on] = tick
        self.duty[:] = on_time / tick
        works = self.thruster_health * self.duty
        self.thrust[:] = self.table.force * works
        self.wrench[:] = self._wrenches @ works
        self.on_time += on_time
        self.propellant += tick * float(self._mass_flow @ works)
        limited: bool = self.plant.step(effort, self.wrench)
        return limited


def with_thrusters(plant: Plant, control_period: float, source: str, excluded: str = "") -> Plant:
    """Give a plant under efforts the thrusters of its URDF, of a YAML file, or none.

    Parameters
    ----------
    plant
        The plant, which takes any wrench.
    control_period
        Duration of a tick, s.
    source
        ``urdf``, the path of a file, or empty: then the plant is returned as it is.
    excluded
        Names of thrusters that are not used, separated by spaces.

    Raises
    ------
    ParameterError
        The file or a thruster in it is refused, or an excluded thruster is unknown.
    RobotDescriptionError
        A thruster of the URDF is refused, or there is none.
    """
    if not source:
        return plant
    robot = plant.robot.description
    return ThrusterPlant(plant, control_period, find_thrusters(source, robot), excluded.split())


def thrusters_in(plant: Plant) -> ThrusterPlant | None:
    """Return the thrusters of a plant, which may be wrapped; None without."""
    while isinstance(plant, WrappedPlant) and not isinstance(plant, ThrusterPlant):
        plant = plant.plant
    return plant if isinstance(plant, ThrusterPlant) else None
