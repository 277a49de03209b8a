"""Steps the plant: integration, actuator limits."""

from spacerobot_ros.simulation.velocity_plant import InitialState, VelocityPlant

__all__ = ["InitialState", "VelocityPlant"]
