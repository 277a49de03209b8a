"""A wanted wrench as pulses of thrusters that are either on or off."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.thrusters.allocation import ThrusterAllocation
from spacerobot_ros.control.thrusters.table import ThrusterTable
from spacerobot_ros.model.description import Array

_ROUNDING = 1e-9
"""Part of a time that is none."""

_FAVOUR = 0.01
"""By how much of its cost a thruster may be favoured. Thrusters placed symmetrically have many
allocations of the same cost, and rounding, which differs between machines, would choose."""


class ThrusterPulses:
    """Sigma-delta modulation of a wrench, tick by tick, with shortest pulses.

    The impulse that is owed grows by the wanted wrench times the tick and shrinks by the impulses
    of the pulses fired. Every tick what is owed is allocated anew, so that debts of opposite
    thrusters cancel, and a thruster that is off goes on once its share is a whole shortest pulse;
    one that is on stays on as long as it has a share. So nothing is fired that is not owed, and
    what remains owed is at most one shortest pulse of each thruster: with ``t`` that time and ``h``
    the tick, ``allocation <= t + h - (still to be fired of a shortest pulse)`` holds every tick if
    the wanted wrench is within the thrust. What is beyond is dropped, not remembered.

    Within a tick a valve opens and closes at any time; a pulse begins with a tick.

    Parameters
    ----------
    table
        The thrusters.
    tick_period
        Duration of a tick, s.
    excluded
        Names of thrusters that are never fired.

    Raises
    ------
    ParameterError
        There is no thruster of an excluded name.
    """

    def __init__(
        self, table: ThrusterTable, tick_period: float, excluded: Sequence[str] = ()
    ) -> None:
        self._table, self._tick_period = table, tick_period
        self._wrenches, self._shortest = table.wrenches, table.min_on_time
        # Numbers without rational relations: no sums of costs are equal either.
        favour = np.sin(np.arange(1.0, len(table.names) + 1.0) ** 2)
        self._allocation = ThrusterAllocation(
            self._wrenches, table.mass_flow * (1.0 + _FAVOUR * favour)
        )
        for name in excluded:
            self.exclude(name)
        self.unmet = np.zeros(6)
        """Part of the wrench wanted in the last tick that the thrusters cannot give, N, N m."""
        self.begun = np.zeros(len(table.names), dtype=np.bool_)
        """Whether a pulse of each thruster (m,) began with the last tick."""
        self.reset()

    def exclude(self, name: str) -> None:
        """Fire a thruster no more, dead as it is; the others give the wrench, if they can."""
        self._allocation.exclude(self._table.index(name))

    def reset(self) -> None:
        """Owe nothing, all thrusters off."""
        count = len(self._table.names)
        self.owed = np.zeros(6)
        self._left = np.zeros(count)
        self._on: npt.NDArray[np.bool_] = np.zeros(count, dtype=np.bool_)
        self.unmet[:] = 0.0
        self.begun[:] = False

    @property
    def under_way(self) -> Array:
        """Impulse (6,) of the shortest pulses that have begun and are to be ended, N s, N m s."""
        return self._wrenches @ self._left

    def fire(self, wrench: Array) -> Array:
        """Return for how long each thruster (m,) is on in this tick, s."""
        h, shortest = self._tick_period, self._shortest
        wanted = self.owed + h * wrench
        shares = self._allocation.allocate(wanted, shortest + h - self._left)
        self.unmet[:] = (wanted - shares.met) / h
        levels = np.where(shares.levels > _ROUNDING * h, shares.levels, 0.0)
        self.begun[:] = ~self._on & (levels > 0.0) & (levels >= (1.0 - _ROUNDING) * shortest)
        longer = np.minimum(levels, np.maximum(h - self._left, 0.0))
        new = np.where(
            self._on, longer, np.where(self.begun, np.maximum(np.minimum(levels, h), shortest), 0.0)
        )
        on_time: Array = np.minimum(self._left + new, h)
        self._left = self._left + new - on_time
        self._left[self._left <= _ROUNDING * h] = 0.0
        self._on = on_time >= (1.0 - _ROUNDING) * h
        self.owed = shares.met - self._wrenches @ new
        return on_time
