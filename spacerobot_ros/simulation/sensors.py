"""What a robot measures of itself: the truth with bias, noise, delay, and now and then nothing."""

from __future__ import annotations

from collections import deque

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.simulation.actuators import FaultyPlant, thrusters_in
from spacerobot_ros.simulation.config import PlantConfig, SensorConfig
from spacerobot_ros.simulation.faults import KINDS, POSE_AXES, Fault
from spacerobot_ros.topics import Topic, state_topics

_NOISES = {
    "position": "position_noise",
    "attitude": "attitude_noise",
    "velocity": "velocity_noise",
    "angular_velocity": "angular_velocity_noise",
    "joints": "joint_noise",
    "joint_rates": "joint_rate_noise",
}
"""The parameter of the noise of each group (:data:`~spacerobot_ros.simulation.faults.GROUPS`)."""


class Sensors:
    """The measured state of a plant beside the true one.

    ``pose`` (7,), ``twist`` (6,), ``q`` and ``qdot`` (n,) are what was measured last, arranged as
    those of the plant. Each call of :meth:`measure` draws new noise from the seed, so a flight of
    as many ticks is the same again.

    Parameters
    ----------
    plant
        Whose state is measured, and whose faults the sensors share.
    config
        How they err without faults.
    control_period
        s.

    Raises
    ------
    ParameterError
        The bias of the joints has the wrong length.
    """

    def __init__(self, plant: FaultyPlant, config: SensorConfig, control_period: float) -> None:
        n = plant.robot.n
        if len(config.joint_bias) not in (0, n):
            raise ParameterError(
                f"Parameter 'sensors.joint_bias' has {len(config.joint_bias)} number(s); the robot "
                f"has {n} joints."
            )
        self._plant, self._config, self._control_period = plant, config, control_period
        self._rng = np.random.default_rng(config.seed)
        self._joint_index = {name: i for i, name in enumerate(plant.robot.joint_names)}
        self.pose, self.twist = plant.pose.copy(), plant.twist.copy()
        self.q, self.qdot = plant.q.copy(), plant.qdot.copy()
        self.dropout = False
        """Whether the pose was not measured at all."""
        self._pose_bias, self._joint_bias = np.zeros(6), np.zeros(n)
        self._noise = dict.fromkeys(_NOISES, 0.0)
        self.pose_covariance, self.twist_covariance = np.zeros(36), np.zeros(36)
        """Of what odom measures: position and attitude, velocities, each 6 x 6 in a row. Noise
        alone counts: a bias and a delay are unknown to who measures."""
        self._delay = 0
        self._past: deque[tuple[Array, Array]] = deque([(self.pose, self.twist)], maxlen=1)
        self._adopt(plant.active)
        self.used = self.imperfect or any(KINDS[f.kind].sensor for f in plant.timeline.faults)
        """Whether what is measured has ever been, or will be, another thing than the truth."""

    @property
    def imperfect(self) -> bool:
        """Whether what is measured now differs from the truth."""
        return bool(
            self.dropout
            or self._delay
            or self._pose_bias.any()
            or self._joint_bias.any()
            or any(self._noise.values())
        )

    def measure(self) -> None:
        """Measure the present state of the plant; perfect sensors that were never used do not."""
        if self._plant.active is not self._faults:
            self._adopt(self._plant.active)
            self.used = self.used or self.imperfect
        if not self.used:
            return
        plant, normal, noise = self._plant, self._rng.standard_normal, self._noise
        self._past.append((plant.pose.copy(), plant.twist.copy()))
        # After a change of the delay the past may still be shorter than it.
        pose, twist = self._past[max(0, len(self._past) - 1 - self._delay)]
        n = len(self.q)
        errors = normal(12)
        turn = self._pose_bias[3:] + noise["attitude"] * errors[3:6]
        self.pose[:3] = pose[:3] + self._pose_bias[:3] + noise["position"] * errors[:3]
        self.pose[3:] = pose[3:]
        if turn.any():
            self.pose[3:] = quaternion_multiply(pose[3:], quaternion_from_rotvec(turn))
        self.twist[:3] = twist[:3] + noise["velocity"] * errors[6:9]
        self.twist[3:] = twist[3:] + noise["angular_velocity"] * errors[9:]
        self.q[:] = plant.q + self._joint_bias + noise["joints"] * normal(n)
        self.qdot[:] = plant.qdot + noise["joint_rates"] * normal(n)

    def _adopt(self, faults: tuple[Fault, ...]) -> None:
        """Take over the sensors' share of the faults that are active now."""
        self._faults = faults
        config = self._config
        self._pose_bias[:3] = config.position_bias or 0.0
        self._pose_bias[3:] = config.attitude_bias or 0.0
        self._joint_bias[:] = config.joint_bias or 0.0
        variances = {group: getattr(config, name) ** 2 for group, name in _NOISES.items()}
        self.dropout, delay = False, 0.0
        for fault in faults:
            if fault.kind == "sensor_bias" and fault.target in POSE_AXES:
                self._pose_bias[POSE_AXES.index(fault.target)] += fault.value
            elif fault.kind == "sensor_bias":
                self._joint_bias[self._joint_index[fault.target]] += fault.value
            elif fault.kind == "sensor_noise":
                variances[fault.target] += fault.value**2
            elif fault.kind == "sensor_dropout":
                self.dropout = True
            elif fault.kind == "sensor_delay":
                delay = max(delay, fault.value)
        self._noise = {group: variance**0.5 for group, variance in variances.items()}
        # The noise of a group is the same in all directions: so it is in any frame.
        for covariance, linear, angular in (
            (self.pose_covariance, "position", "attitude"),
            (self.twist_covariance, "velocity", "angular_velocity"),
        ):
            covariance[[0, 7, 14]], covariance[[21, 28, 35]] = variances[linear], variances[angular]
        self._delay = round(delay / self._control_period)
        self._past = deque(self._past, maxlen=self._delay + 1)


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
