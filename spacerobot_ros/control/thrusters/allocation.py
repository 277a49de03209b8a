"""What each thruster is to give so that together they give a wrench."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import linprog, nnls

from spacerobot_ros.model.description import Array

_THRIFT = 1e-5
"""Weight of the cost beside the wrench. What it takes from the wrench, some 1e-10 of it, is given
back afterwards; much less would drown in the rounding of the solver."""

_MET = 1e-9
"""A wrench is met if what is missing is less than this part of it."""

_PREFERENCE = 1e4
"""How much more a larger part of the wrench counts than its cost."""


@dataclass(frozen=True)
class Allocation:
    """``levels`` (m,): how much of each thruster; ``met`` (6,): the wrench that they make."""

    levels: Array
    met: Array


class ThrusterAllocation:
    """Shares wrenches out to thrusters that only push: ``wrenches @ levels = wanted``, none
    negative, none above its most, at the least cost.

    Non-negative least squares (Lawson and Hanson) with one more row for the cost: as its weight
    goes to zero the solution goes to the cheapest of the exact ones. Where a level would be above
    its most, a linear programme finds the largest part of the wrench that can be given, and its
    cheapest allocation: the wrench keeps its direction as it does in
    :class:`spacerobot_ros.control.saturation.ActuatorLimits`. Of a wrench that no levels make,
    the nearest that can be made is taken, torques weighed by the thrusters' mean lever.

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
        self._usable: npt.NDArray[np.int64] = np.arange(cost.size)
        self._use(self._usable)

    def exclude(self, index: int) -> None:
        """Never use a thruster from now on."""
        self._use(self._usable[self._usable != index])

    def _use(self, usable: npt.NDArray[np.int64]) -> None:
        self._usable = usable
        self._columns = self._matrix[:, usable]
        self._extended = np.vstack([self._columns, _THRIFT * self._cost[usable]])

    def allocate(self, wanted: Array, most: Array) -> Allocation:
        """Return the levels (m,), each within ``most`` (m,), that make ``wanted`` (6,), or as much
        of it as they can.
        """
        levels = np.zeros(self._cost.size)
        target = self._weights * wanted
        size = float(np.linalg.norm(target))
        if size > 0.0 and self._usable.size:
            target = target / size
            share, _ = nnls(self._extended, np.append(target, 0.0))
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
        cost = np.append(self._cost[self._usable], -_PREFERENCE)
        equations = np.column_stack([self._columns, -target])
        limits = [*((0.0, bound) for bound in bounds), (0.0, 1.0)]
        solution = linprog(cost, A_eq=equations, b_eq=np.zeros(6), bounds=limits).x
        levels, part = solution[:-1], solution[-1]
        inside = (levels > 0.0) & (levels < bounds)
        return np.minimum(self._completed(levels, part * target, inside), bounds)
