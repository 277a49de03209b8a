"""Base propulsion: a thruster table, or a wrench in any direction with bounded force and torque
norms."""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.thrusters import ThrusterTable


@dataclass(frozen=True)
class Propulsion:
    """Levels (m,) whose wrench on the base is ``wrenches @ levels``, and their cost.

    Attributes
    ----------
    wrenches
        (6, m) force (N), then torque (N m) at the base link origin, in base components, at level
        one.
    cost
        (m,) cost per second at level one: kg of propellant if there is a table, else N s of
        impulse.
    norms
        Groups of levels with a Euclidean norm of at most one; these levels range from -1 to 1. All
        other levels range from 0 to 1.
    """

    wrenches: Array
    cost: Array
    norms: tuple[tuple[int, ...], ...] = ()

    @property
    def size(self) -> int:
        """m."""
        return int(self.wrenches.shape[1])

    @property
    def lowest(self) -> Array:
        """Lowest levels (m,): -1 in norm groups, else 0."""
        lowest = np.zeros(self.size)
        lowest[[i for group in self.norms for i in group]] = -1.0
        return lowest

    @classmethod
    def of_table(cls, table: ThrusterTable, reserve: float = 0.0) -> Propulsion:
        """Return the propulsion for a thruster table, with a fraction of the levels reserved for
        feedback.

        Raises
        ------
        ParameterError
            The thrusters cannot produce every wrench.
        """
        missing = table.missing()
        if missing:
            raise ParameterError(
                f"The thrusters cannot produce {missing}; motions under thrust are planned for "
                "bases that can be pushed and rotated in every direction."
            )
        share = 1.0 - reserve
        return cls(share * table.wrenches, share * table.mass_flow)

    @classmethod
    def within(cls, force: float, torque: float, reserve: float = 0.0) -> Propulsion:
        """Return the propulsion for a largest force (N) and torque (N m), each in Euclidean norm.

        Raises
        ------
        ParameterError
            A limit is not positive, or not finite.
        """
        for name, value in (("force", force), ("torque", torque)):
            if not (value > 0 and math.isfinite(value)):
                raise ParameterError(
                    f"The thruster {name} limit is {value:g}; motions under thrust require a "
                    f"finite limit: set max_{name}."
                )
        limits = (1.0 - reserve) * np.repeat([force, torque], 3)
        return cls(np.diag(limits), limits, ((0, 1, 2), (3, 4, 5)))

    def largest_force(self) -> float:
        """Return a bound on the force in any direction, N."""
        force = self.wrenches[:3]
        if self.norms:
            return float(np.abs(force).max())
        one_way = np.maximum(force.clip(0.0).sum(axis=1), -force.clip(None, 0.0).sum(axis=1))
        return float(np.linalg.norm(one_way))

    def cost_of(self, levels: ca.MX | ca.DM, rounding: ca.MX | float = 0.0) -> ca.MX | ca.DM:
        """Return the cost of levels (m, N) that each last for a second; norms are smoothed at a
        level.
        """
        single = np.delete(np.arange(self.size), [i for group in self.norms for i in group])
        cost = ca.sum2(ca.DM(self.cost[single]).T @ levels[single.tolist(), :])
        for group in self.norms:
            sizes = ca.sqrt(ca.sum1(levels[list(group), :] ** 2) + rounding**2)
            cost += self.cost[group[0]] * ca.sum2(sizes - rounding)
        return cost
