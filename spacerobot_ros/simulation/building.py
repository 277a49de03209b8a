"""A plant from its configuration, as a node is given it and a bag keeps it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot, integration
from spacerobot_ros.simulation import effort_plant
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.simulation.faults import FaultyPlant
from spacerobot_ros.simulation.initial_state import InitialState
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.thrusters import with_thrusters
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

_SHORTEST_STEP = 1e-5
"""Shorter Runge-Kutta steps lose more to rounding than they gain, s."""

_MOST_STEPS = 1e6
"""More steps in a tick take minutes."""


@dataclass(frozen=True)
class PlantKind:
    """A way to drive a robot.

    Attributes
    ----------
    plant
        The class, called with robot, control period (s), initial state and integration step (s).
    integration_step
        The longest Runge-Kutta step unless the configuration gives one, s.
    wrench
        Whether the plant takes a wrench on its base.
    """

    plant: Callable[..., Plant]
    integration_step: float
    wrench: bool


PLANTS: dict[str, PlantKind] = {
    "velocity": PlantKind(VelocityPlant, integration.DEFAULT_INTEGRATION_STEP, wrench=False),
    "effort": PlantKind(EffortPlant, effort_plant.DEFAULT_INTEGRATION_STEP, wrench=True),
}
"""By what joint commands carry: the parameter ``actuation``."""


def build_plant(
    robot: SpaceRobot, config: PlantConfig, initial: InitialState | None = None
) -> FaultyPlant:
    """Build the plant that a configuration describes, with its thrusters and faults.

    Parameters
    ----------
    robot
        The model.
    config
        The parameters of the plant.
    initial
        Where to start instead of the configuration's initial state.

    Raises
    ------
    ParameterError
        The integration step is too short, or the initial state, a thruster or a fault is refused.
    """
    kind, step = PLANTS[config.actuation], config.integration_step
    control_period = config.control_period
    if 0.0 < step < _SHORTEST_STEP:
        raise ParameterError(
            f"Parameter 'integration_step' is {step}; it must be 0 (by the actuation) or at least "
            f"{_SHORTEST_STEP:g} s."
        )
    if config.thrusters and not kind.wrench:
        raise ParameterError(
            f"Parameter 'thrusters' is '{config.thrusters}', but under actuation "
            f"'{config.actuation}' nothing pushes the base: set actuation to effort, or thrusters "
            "to ''."
        )
    if step and control_period / step > _MOST_STEPS:
        raise ParameterError(
            f"Parameter 'integration_step' is {step:g} s, which is more than {_MOST_STEPS:.0e} "
            f"steps in a tick of {control_period:g} s; choose longer steps or shorter ticks."
        )
    start = InitialState.of(config) if initial is None else initial
    plant = kind.plant(robot, control_period, start, step or kind.integration_step)
    plant = with_thrusters(plant, control_period, config.thrusters, config.thrusters_excluded)
    return FaultyPlant(
        plant, config.faults, control_period, wrench=kind.wrench, seed=config.sensors.seed
    )
