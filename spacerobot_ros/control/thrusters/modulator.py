"""A wanted wrench as pulses of thrusters that are either on or off: allocation and modulation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from spacerobot_ros.control.thrusters.table import ThrusterTable
from spacerobot_ros.model.description import Array

_THRIFT = 1e-5
"""Weight of the cost beside the wrench. What it takes from the wrench, some 1e-10 of it, is given
back afterwards; a much smaller weight would be lost in the rounding of the solver."""

_MET = 1e-9
"""Largest missing share of a wrench that counts as given."""

_PREFERENCE = 1e4
"""Weight of the part of the wrench that is given, relative to its cost."""

_ROUNDING = 1e-9
"""Shorter parts of a time count as zero."""

_FAVOUR = 0.01
"""By how much of its cost a thruster may be favoured. Thrusters placed symmetrically have many
allocations of the same cost, and rounding, which differs between machines, would choose."""

_UNMET = 1e-6
"""Smaller parts of a wrench are not counted as missing, N or N m."""


@dataclass(frozen=True)
class Allocation:
    """``levels`` (m,): how much of each thruster; ``met`` (6,): the wrench that they make."""

    levels: Array
    met: Array


class ThrusterAllocation:
    """Distributes wrenches over thrusters that only push, at the least cost.

    The levels solve ``wrenches @ levels = wanted`` with ``0 <= levels <= most``. They are found by
    non-negative least squares (Lawson and Hanson) with one more row for the cost: as its weight
    goes to zero the solution goes to the cheapest of the exact ones. Where a level would exceed
    its upper bound, a linear programme finds the largest part of the wrench that can be given, and
    its cheapest allocation: the wrench keeps its direction as it does in
    :class:`spacerobot_ros.control.ActuatorLimits`. Of a wrench that no levels make, the nearest
    that can be made is allocated, torques weighed by the thrusters' mean lever.

    Parameters
    ----------
    wrenches
        (6, m) force (N) over torque (N m) of each thruster at level one.
    cost
        (m,) what level one of each costs, positive.
    """

    def __init__(self, wrenches: Array, cost: Array) -> None:
        self._wrenches = wrenches
        force, torque = np.linalg.norm(wrenches[:3]), np.linalg.norm(wrenches[3:])
        lever = torque / force if torque > 0 and force > 0 else 1.0
        self._weights = np.repeat([1.0, 1.0 / lever], 3)
        self._matrix = self._weights[:, None] * wrenches
        size = float(np.linalg.norm(self._matrix, axis=0).max())
        self._matrix, self._weights = self._matrix / size, self._weights / size
        self._cost = cost / cost.max()
        # Imported where thrusters are used: scipy.optimize loads slowly.
        from scipy.optimize import nnls

        self._nnls = nnls
        self._usable: npt.NDArray[np.int64] = np.arange(cost.size)
        self._use(self._usable)

    def exclude(self, index: int) -> None:
        """Never use a thruster from now on."""
        self._use(self._usable[self._usable != index])

    def _use(self, usable: npt.NDArray[np.int64]) -> None:
        self._usable = usable
        self._columns = self._matrix[:, usable]
        self._extended = np.vstack([self._columns, _THRIFT * self._cost[usable]])

    @property
    def problem(self) -> tuple[Array, Array]:
        """What is solved for a wanted wrench: the matrix (7, m) of the levels, whose last row is
        their cost, and the weights (6,) of the wrench on the other side.
        """
        return self._extended, self._weights

    def allocate(self, wanted: Array, most: Array) -> Allocation:
        """Return the levels (m,), each within ``most`` (m,), that make ``wanted`` (6,), or as much
        of it as they can.
        """
        levels = np.zeros(self._cost.size)
        target = self._weights * wanted
        size = float(np.linalg.norm(target))
        if size > 0.0 and self._usable.size:
            target = target / size
            share, _ = self._nnls(self._extended, np.append(target, 0.0))
            share = self._completed(share, target, share > 0.0)
            bounds = most[self._usable] / size
            if np.any(share > bounds):
                made = self._columns @ share
                if np.linalg.norm(made - target) > _MET:
                    target = made
                share = self._largest_part(target, bounds)
            levels[self._usable] = np.minimum(size * share, most[self._usable])
        return Allocation(levels, self._wrenches @ levels)

    def _completed(self, levels: Array, target: Array, free: npt.NDArray[np.bool_]) -> Array:
        """Return the levels after the free ones have made up for what is missing, never below 0."""
        columns = self._columns[:, free]
        completed = levels.copy()
        completed[free] += np.linalg.lstsq(columns, target - self._columns @ levels, rcond=None)[0]
        return np.maximum(completed, 0.0)

    def _largest_part(self, target: Array, bounds: Array) -> Array:
        """Return the cheapest levels within bounds that make the largest part of the target."""
        from scipy.optimize import linprog

        cost = np.append(self._cost[self._usable], -_PREFERENCE)
        equations = np.column_stack([self._columns, -target])
        limits = [*((0.0, bound) for bound in bounds), (0.0, 1.0)]
        solution = linprog(cost, A_eq=equations, b_eq=np.zeros(6), bounds=limits).x
        levels, part = solution[:-1], solution[-1]
        inside = (levels > 0.0) & (levels < bounds)
        return np.minimum(self._completed(levels, part * target, inside), bounds)


class ThrusterModulator:
    """Turns a wanted wrench into on-times of thrusters, one control period after the other.

    Sigma-delta modulation with shortest pulses. The outstanding impulse ``owed`` grows by the
    wanted wrench times the period and shrinks by the impulses of the pulses fired. In every period
    it is allocated anew, so that opposite contributions cancel; a thruster that is off opens once
    its share is a whole shortest pulse, one that is on stays on as long as it has a share. What
    remains outstanding is therefore at most one shortest pulse of each thruster: with ``t`` that
    time and ``h`` the period, ``allocation <= t + h - (remaining part of a shortest pulse)`` holds
    in every period if the wanted wrench is within the thrust. A wrench beyond it is dropped, not
    made up for later.

    Within a period a valve opens and closes at any time; a pulse begins with a period.

    Parameters
    ----------
    table
        The thrusters.
    control_period
        Time between two calls of :meth:`fire`, s.
    excluded
        Names of thrusters that are never fired.

    Raises
    ------
    ParameterError
        There is no thruster of an excluded name.
    """

    def __init__(
        self, table: ThrusterTable, control_period: float, excluded: Sequence[str] = ()
    ) -> None:
        self.table, self._control_period = table, control_period
        self._wrenches, self._shortest = table.wrenches, table.min_on_time
        count = len(table.names)
        # Numbers without rational relations: no sums of costs are equal either.
        favour = np.sin(np.arange(1.0, count + 1.0) ** 2)
        self.allocation = ThrusterAllocation(
            self._wrenches, table.mass_flow * (1.0 + _FAVOUR * favour)
        )
        """How wrenches are distributed over the thrusters."""
        self._excluded: list[str] = []
        for name in excluded:
            self.exclude(name)
        self.unmet = np.zeros(6)
        """Part of the wrench wanted in the last period that the thrusters cannot give, N, N m."""
        self.unmet_periods = 0
        """Number of periods in which a part of the wrench was not given."""
        self.begun = np.zeros(count, dtype=np.bool_)
        """Whether a pulse of each thruster (m,) began with the last period."""
        self.pulses = np.zeros(count, dtype=np.int64)
        """Number of pulses of each thruster (m,) so far."""
        self.on_time = np.zeros(count)
        """Time that each thruster (m,) was commanded on so far, s."""
        self.reset()

    @property
    def missing(self) -> str:
        """Names of the wrenches that the thrusters in use cannot give; empty if there are none."""
        return self.table.missing(self._excluded)

    @property
    def propellant(self) -> float:
        """Propellant that the commanded on-times have used, kg."""
        return float(self.table.mass_flow @ self.on_time)

    def exclude(self, name: str) -> None:
        """Fire a (broken) thruster no more; the others give the wrench, if they can.

        Raises
        ------
        ParameterError
            There is no thruster of that name.
        """
        self.allocation.exclude(self.table.index(name))
        self._excluded.append(name)

    def reset(self) -> None:
        """Close all thrusters, nothing outstanding; the counts go on."""
        self.owed = np.zeros(6)
        """Impulse (6,) that was wanted and is still to be given, N s, N m s."""
        self._left = np.zeros(len(self.table.names))
        self._on: npt.NDArray[np.bool_] = np.zeros(len(self.table.names), dtype=np.bool_)
        self.unmet[:] = 0.0
        self.begun[:] = False

    @property
    def under_way(self) -> Array:
        """Impulse (6,) left in the shortest pulses that have begun, N s and N m s."""
        return self._wrenches @ self._left

    def fire(self, wrench: Array) -> Array:
        """Return for how long each thruster (m,) is on in the next period, s.

        ``wrench`` (6,) is force (N) over torque (N m) at the origin of the base link, base
        components.
        """
        h, shortest = self._control_period, self._shortest
        wanted = self.owed + h * wrench
        shares = self.allocation.allocate(wanted, shortest + h - self._left)
        self.unmet[:] = (wanted - shares.met) / h
        self.unmet_periods += bool(np.any(np.abs(self.unmet) > _UNMET))
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
        self.pulses += self.begun
        self.on_time += on_time
        return on_time
