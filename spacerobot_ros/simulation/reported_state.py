"""What a plant reports of itself: the quantities behind its state topics."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import FaultyPlant
from spacerobot_ros.simulation.sensors import Sensors
from spacerobot_ros.simulation.thrusters import thrusters_in
from spacerobot_ros.topics import Topic, state_topics


class ReportedState:
    """The state of a plant as its topics carry it: measured, and true.

    Parameters
    ----------
    plant
        Whose state it is.
    config
        Its configuration: sensors and end-effector.

    Attributes
    ----------
    sensors
        What they measure is what odom and joint_states carry.
    quantities
        By the names of :attr:`StateField.quantity`: arrays, those of the plant itself, which change
        in place. Another dictionary as soon as the sensors begin to err. What a plant does not have
        (thrusters, an end-effector, a truth beside its measurements) is not in it.

    Raises
    ------
    ParameterError
        The robot has no link of the name ``end_effector_frame``, or the sensors are refused.
    """

    def __init__(self, plant: FaultyPlant, config: PlantConfig) -> None:
        self._plant = plant
        self.sensors = Sensors(plant, config.sensors, config.control_period)
        self._link = _end_effector(plant.robot, config.end_effector_frame)
        self._end_effector_pose = np.zeros(7)
        self._thrusters = thrusters_in(plant)
        self._sensors_used = self.sensors.used
        self.quantities = self._quantities()

    @property
    def topics(self) -> list[Topic]:
        """The state topics that this plant publishes now, in the order of publication."""
        return [
            topic
            for topic in state_topics()
            if all(field.quantity in self.quantities for field in topic.state)
        ]

    def names(self, topic: Topic) -> tuple[str, ...]:
        """Return what the arrays of a topic have entries for."""
        if topic.of == "thrusters" and self._thrusters is not None:
            return tuple(self._thrusters.table.names)
        return tuple(self._plant.robot.joint_names)

    def update(self) -> bool:
        """Measure the present state of the plant.

        Returns
        -------
        bool
            Whether :attr:`quantities` are others than before.
        """
        self.sensors.measure()
        if self._link is not None:
            self._place_end_effector(self._link)
        if self.sensors.used == self._sensors_used:
            return False
        self._sensors_used = self.sensors.used
        self.quantities = self._quantities()
        return True

    def _quantities(self) -> dict[str, Array]:
        plant, thrusters = self._plant, self._thrusters
        measured = self.sensors if self._sensors_used else plant
        quantities = {
            "pose": plant.pose,
            "effort": plant.effort,
            "momentum": plant.momentum,
            "measured_pose": measured.pose,
            "measured_twist": measured.twist,
            "measured_q": measured.q,
            "measured_qdot": measured.qdot,
        }
        if self._link is not None:
            quantities["end_effector_pose"] = self._end_effector_pose
        if plant.takes_wrench:
            quantities["expected_momenta"] = plant.expected_momenta
        if self._sensors_used:
            quantities |= {
                "true_pose": plant.pose,
                "true_twist": plant.twist,
                "true_q": plant.q,
                "true_qdot": plant.qdot,
            }
        if thrusters is not None:
            quantities |= {
                "thruster_wrench": thrusters.wrench,
                "thruster_on_time": thrusters.on_time,
                "thruster_duty": thrusters.duty,
                "thruster_force": thrusters.thrust,
            }
        return quantities

    def _place_end_effector(self, index: int) -> None:
        plant, target = self._plant, self._end_effector_pose
        R_WB, r_WB = matrix_from_quaternion(plant.pose[3:]), plant.pose[:3]
        target[:3] = r_WB + R_WB @ plant.link_r[:, index]
        target[3:] = quaternion_from_matrix(R_WB @ plant.link_R[:, 3 * index : 3 * index + 3])


def _end_effector(robot: SpaceRobot, name: str) -> int | None:
    """Return the number of the link whose pose is published, if one is."""
    links = list(robot.link_names)
    link = robot.description.end_effector(name)
    if link and link not in links:
        raise ParameterError(
            f"Parameter 'end_effector_frame' is '{link}', but the robot has no such link; "
            f"it has {', '.join(links)}."
        )
    return links.index(link) if link else None
