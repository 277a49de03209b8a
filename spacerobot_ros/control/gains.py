"""Gains by group of outputs."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np

from spacerobot_ros.control.selection import OutputSelection
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array
from spacerobot_ros.parameters import group, parameter


@dataclass(frozen=True)
class GainPair:
    """Proportional and derivative gain of each output of a group, a diagonal of Kp and Kd.

    Their units are the law's: a force (or torque) per error and per error rate, N/m and N s/m (N m
    per rad, N m s per rad) for ``transposed_jacobian``; an acceleration per error, 1/s^2 and 1/s,
    for the laws that know the inertia.

    Commands are held for a tick. A derivative gain that takes more than its velocity within one
    makes the loop unstable: Kd times the tick must stay well below 2 (with ``transposed_jacobian``,
    below twice the least inertia that the output meets, which for the attitude of an end-effector
    is that of the last wrist link about its joint).
    """

    kp: float = parameter(
        30.0, "proportional gain", unit="of the law", minimum=1e-9, read_only=False
    )
    kd: float = parameter(60.0, "derivative gain", unit="of the law", minimum=1e-9, read_only=False)


@dataclass(frozen=True)
class Gains:
    """The diagonals of Kp and Kd (paper 4, eqs 27 and 29), positive definite.

    Raises
    ------
    ParameterError
        A gain is not positive and finite; the sentence names it.
    """

    base_position: GainPair = group(GainPair(30.0, 60.0))
    base_attitude: GainPair = group(GainPair(30.0, 60.0))
    end_effector_position: GainPair = group(GainPair(30.0, 60.0))
    end_effector_attitude: GainPair = group(GainPair(30.0, 60.0))
    joints: GainPair = group(GainPair(4.0, 4.0))

    def __post_init__(self) -> None:
        for each in fields(self):
            pair: GainPair = getattr(self, each.name)
            for name, value in (("kp", pair.kp), ("kd", pair.kd)):
                if not (math.isfinite(value) and value > 0):
                    raise ParameterError(
                        f"The gain {each.name}.{name} is {value}; it must be positive and finite."
                    )

    @classmethod
    def uniform(cls, kp: float, kd: float) -> Gains:
        """Return the same gains for every group."""
        return cls(*(GainPair(kp, kd) for _ in fields(cls)))

    def diagonals(self, selection: OutputSelection) -> tuple[Array, Array]:
        """Return the diagonals of Kp and Kd (m,) of the selected outputs."""
        pairs = [
            *(_pair(axis, self.base_position, self.base_attitude) for axis in selection.base),
            *(
                _pair(axis, self.end_effector_position, self.end_effector_attitude)
                for axis in selection.end_effector
            ),
            *(self.joints for _ in selection.joints),
        ]
        return np.array([pair.kp for pair in pairs]), np.array([pair.kd for pair in pairs])


def _pair(axis: str, position: GainPair, attitude: GainPair) -> GainPair:
    return attitude if axis.startswith("r") else position
