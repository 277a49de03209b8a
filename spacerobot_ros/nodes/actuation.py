"""How a plant is driven: which model integrates, which commands it takes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from spacerobot_ros.model import SpaceRobot, reconstruction
from spacerobot_ros.nodes.command_channel import CommandChannel, JointChannel, WrenchChannel
from spacerobot_ros.simulation import EffortPlant, VelocityPlant, effort_plant
from spacerobot_ros.simulation.plant import Plant


@dataclass(frozen=True)
class Actuation:
    """A plant and the channels whose commands are the arguments of its steps, in that order.

    ``integration_step`` is its longest Runge-Kutta step unless told otherwise, s; ``thrusters``
    whether it takes a wrench on its base.
    """

    plant: Callable[..., Plant]
    integration_step: float
    thrusters: bool
    channels: Callable[[SpaceRobot], list[CommandChannel]]


ACTUATIONS: dict[str, Actuation] = {
    "velocity": Actuation(
        VelocityPlant,
        reconstruction.DEFAULT_INTEGRATION_STEP,
        False,
        lambda robot: [JointChannel(robot, "velocity")],
    ),
    "effort": Actuation(
        EffortPlant,
        effort_plant.DEFAULT_INTEGRATION_STEP,
        True,
        lambda robot: [JointChannel(robot, "effort"), WrenchChannel(robot)],
    ),
}
