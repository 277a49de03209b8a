"""The simulated plant: integration and actuator limits."""

from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.simulation.plant import InitialState
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

__all__ = ["EffortPlant", "InitialState", "VelocityPlant"]
