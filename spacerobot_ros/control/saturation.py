"""What the actuators can do of what a law commands."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.control.state import Actuation
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array


@dataclass(frozen=True)
class Saturated:
    """``realised``: what the actuators give; ``loss``: commanded minus realised."""

    realised: Actuation
    loss: Actuation

    @property
    def limited(self) -> bool:
        """Whether anything was limited."""
        return bool(self.loss.wrench_B.any() or self.loss.tau.any())


@dataclass(frozen=True)
class ActuatorLimits:
    """Limits of the thrusters and of the joints.

    The thrusters give any force up to ``force`` (N) and any torque up to ``torque`` (N m), both in
    Euclidean norm and independently of each other. Beyond, the force is scaled to its limit, and
    so is the torque: each keeps its direction, so that a limited spacecraft is pushed where it is
    wanted, only less. Each joint gives up to its ``effort`` (n,), N m or N, by itself. Infinite
    where there is no limit.

    Raises
    ------
    ParameterError
        A limit is negative or not a number.
    """

    force: float
    torque: float
    effort: Array

    def __post_init__(self) -> None:
        for name, value, unit in (("force", self.force, "N"), ("torque", self.torque, "N m")):
            if math.isnan(value) or value < 0:
                raise ParameterError(
                    f"The {name} limit of the thrusters is {value} {unit}; it must not be negative."
                )
        if not np.all(self.effort >= 0):
            raise ParameterError(
                f"The effort limits of the joints are {self.effort.tolist()}; "
                "none must be negative."
            )

    def apply(self, commanded: Actuation) -> Saturated:
        """Return what the actuators give of a command, and what is lost."""
        wrench = np.concatenate(
            [
                _scaled(commanded.wrench_B[:3], self.force),
                _scaled(commanded.wrench_B[3:], self.torque),
            ]
        )
        tau = np.clip(commanded.tau, -self.effort, self.effort)
        loss = Actuation(commanded.wrench_B - wrench, commanded.tau - tau)
        return Saturated(Actuation(wrench, tau), loss)


def _scaled(vector: Array, limit: float) -> Array:
    size = math.sqrt(vector.dot(vector))
    return vector if size <= limit else vector * (limit / size)
