"""A plant from the values of its parameters, as a node is given them and a bag keeps them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot, integration
from spacerobot_ros.simulation import effort_plant
from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.simulation.faults_plant import FaultyPlant
from spacerobot_ros.simulation.initial_state import InitialState
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.thrusters import with_thrusters
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

_SECOND = 10**9

_SHORTEST_STEP = 1e-5
"""Shorter Runge-Kutta steps lose more to rounding than they gain, s."""


_MOST_STEPS = 1e6
"""More steps in a tick take minutes."""


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
    "velocity": PlantKind(VelocityPlant, integration.DEFAULT_INTEGRATION_STEP, False),
    "effort": PlantKind(EffortPlant, effort_plant.DEFAULT_INTEGRATION_STEP, True),
}
"""By what joint commands carry: the parameter ``actuation``."""


def period_ns(tick_rate: float) -> int:
    """Return the duration of a tick in ns: stamps are whole multiples of it."""
    return round(_SECOND / tick_rate)


def build_plant(
    robot: SpaceRobot, values: Mapping[str, Any], initial: InitialState | None = None
) -> FaultyPlant:
    """Build the plant that these parameters describe, with its faults.

    Parameters
    ----------
    robot
        The model.
    values
        ``actuation``, ``tick_rate`` (Hz), ``integration_step`` (s; 0: by the actuation), what
        :func:`initial_state` takes, and optionally ``faults`` (lines), ``sensors.seed``,
        and ``thrusters`` with ``thrusters_excluded`` (:func:`with_thrusters`).
    initial
        Where to start instead.

    Raises
    ------
    ParameterError
        The integration step is too short, or the initial state, a thruster or a fault is refused.
    """
    kind, step = PLANTS[values["actuation"]], values["integration_step"]
    thrusters = values.get("thrusters", "")
    if 0.0 < step < _SHORTEST_STEP:
        raise ParameterError(
            f"Parameter 'integration_step' is {step}; it must be 0 (by the actuation) or at least "
            f"{_SHORTEST_STEP:g} s."
        )
    if thrusters and not kind.thrusters:
        raise ParameterError(
            f"Parameter 'thrusters' is '{thrusters}', but under actuation '{values['actuation']}' "
            "nothing pushes the base: set actuation to effort, or thrusters to ''."
        )
    tick_period = period_ns(values["tick_rate"]) / _SECOND
    if step and tick_period / step > _MOST_STEPS:
        raise ParameterError(
            f"Parameter 'integration_step' is {step:g} s, which is more than {_MOST_STEPS:.0e} "
            f"steps in a tick of {tick_period:g} s; choose longer steps or shorter ticks."
        )
    plant = kind.plant(
        robot,
        tick_period,
        initial_state(values) if initial is None else initial,
        step or kind.integration_step,
    )
    plant = with_thrusters(plant, tick_period, thrusters, values.get("thrusters_excluded", ""))
    return FaultyPlant(
        plant,
        values.get("faults", ()),
        tick_period,
        wrench=kind.thrusters,
        seed=values.get("sensors.seed", 0),
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
