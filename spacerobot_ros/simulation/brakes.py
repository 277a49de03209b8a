"""What brings the joints of an effort-driven robot to rest when nobody commands them."""

from __future__ import annotations

from spacerobot_ros.control.laws.computed_torque import ComputedTorqueLaw
from spacerobot_ros.control.laws.law import Gains
from spacerobot_ros.control.state import ControlState, JointReference, Reference
from spacerobot_ros.model.description import Array
from spacerobot_ros.simulation.plant import Plant

_RATE = 20.0
"""Joint rates decay as exp(-20 t/s) while the motors are strong enough."""

_LARGEST_RATE_PER_TICK = 0.5
"""A held effort must not stop a joint in less than two ticks: it would swing back."""


class JointBrakes:
    """Motor efforts against the joint rates of a plant; inner forces, which leave its momenta be.

    Parameters
    ----------
    plant
        Whose joints are braked.
    tick_period
        How long an effort is held, s.
    """

    def __init__(self, plant: Plant, tick_period: float) -> None:
        robot = plant.robot
        rate = min(_RATE, _LARGEST_RATE_PER_TICK / tick_period)
        outputs = ComputedTorqueLaw.default_outputs(robot, "")
        # Only the damping acts: the reference is always where the joints are.
        self._law = ComputedTorqueLaw(robot, outputs, Gains.uniform(1.0, rate))
        self._plant = plant

    def efforts(self) -> Array:
        """Return the efforts (n,) to hold for the next tick, N or N m, before limits."""
        plant = self._plant
        state = ControlState(
            plant.pose[:3], plant.pose[3:], plant.twist[:3], plant.twist[3:], plant.q, plant.qdot
        )
        return self._law.command(state, Reference(joints=JointReference.at_rest(plant.q))).tau
