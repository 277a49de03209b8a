"""A plant from the values of its parameters, as a node is given them and a bag keeps them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot, reconstruction
from spacerobot_ros.simulation import effort_plant
from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.simulation.initial_state import InitialState
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

_SECOND = 10**9

_SHORTEST_STEP = 1e-5
"""Shorter Runge-Kutta steps lose more to rounding than they gain, s."""


@dataclass(frozen=True)
class PlantKind:
    """A way to drive a robot.

    ``integration_step`` is the longest Runge-Kutta step unless told otherwise, s; ``thrusters``
    whether the plant takes a wrench on its base.
    """

    plant: Callable[..., Plant]
    integration_step: float
    thrusters: bool


PLANTS: dict[str, PlantKind] = {
    "velocity": PlantKind(VelocityPlant, reconstruction.DEFAULT_INTEGRATION_STEP, False),
    "effort": PlantKind(EffortPlant, effort_plant.DEFAULT_INTEGRATION_STEP, True),
}
"""By what joint commands carry: the parameter ``actuation``."""


def period_ns(tick_rate: float) -> int:
    """Return the duration of a tick in ns: stamps are whole multiples of it."""
    return round(_SECOND / tick_rate)


def build_plant(
    robot: SpaceRobot, values: Mapping[str, Any], initial: InitialState | None = None
) -> Plant:
    """Build the plant that these parameters describe.

    Parameters
    ----------
    robot
        The model.
    values
        ``actuation``, ``tick_rate`` (Hz), ``integration_step`` (s; 0: by the actuation) and what
        :func:`initial_state` takes.
    initial
        Where to start instead.

    Raises
    ------
    ParameterError
        The integration step is too short, or the initial state is refused.
    """
    kind, step = PLANTS[values["actuation"]], values["integration_step"]
    if 0.0 < step < _SHORTEST_STEP:
        raise ParameterError(
            f"Parameter 'integration_step' is {step}; it must be 0 (by the actuation) or at least "
            f"{_SHORTEST_STEP:g} s."
        )
    return kind.plant(
        robot,
        period_ns(values["tick_rate"]) / _SECOND,
        initial_state(values) if initial is None else initial,
        step or kind.integration_step,
    )


def initial_state(values: Mapping[str, Any]) -> InitialState:
    """Return where the parameters have a run start; an empty list leaves a choice open.

    Raises
    ------
    ParameterError
        The position is given twice.
    """

    def optional(name: str) -> Any:
        return np.array(values[name]) if values.get(name) else None

    return InitialState(
        position=np.array(values["initial_position"]),
        quaternion=np.array(values["initial_orientation"]),
        joint_positions=optional("initial_joint_positions"),
        linear_momentum=np.array(values["linear_momentum"]),
        angular_momentum=np.array(values["angular_momentum"]),
        joint_velocities=optional("initial_joint_velocities"),
        center_of_mass=optional("initial_center_of_mass"),
    )
