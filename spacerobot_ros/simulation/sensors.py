"""Plant sensors, and the measured and true state as published on topics."""

from __future__ import annotations

from collections import deque

import numpy as np

from spacerobot_ros.errors import ParameterError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.kinematics import LinkPlacement
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.capture import CapturePlant
from spacerobot_ros.simulation.config import PlantConfig, TargetSensorConfig
from spacerobot_ros.simulation.faults import FAULT_KINDS, POSE_AXES, Fault
from spacerobot_ros.topics import Topic, pose_topic, require_own_topics, state_topics

NOISE_PARAMETERS = {
    "position": "position_noise",
    "attitude": "attitude_noise",
    "velocity": "velocity_noise",
    "angular_velocity": "angular_velocity_noise",
    "joints": "joint_noise",
    "joint_rates": "joint_rate_noise",
}
"""Noise parameters by sensor group (:data:`~spacerobot_ros.simulation.faults.SENSOR_GROUPS`)."""

_MEASURED = ("pose", "twist", "q", "qdot")
"""Arrays of a plant that sensors measure."""

_ROWS_DRAWN_TOGETHER = 32


class NormalNumbers:
    """Independent standard normal numbers, computed only from a seed and their position.

    Row k has the numbers of Philox 4x64 for the counters k B + 1 to (k + 1) B, where B is a quarter
    of the row's size, rounded up. Pairs become normal by the Box-Muller transform. So programs for
    lanes and devices (``batch/driver.hpp``) can compute the numbers of any tick.

    Parameters
    ----------
    seed
        Key of the generator.
    size
        Numbers in a row.
    """

    def __init__(self, seed: int, size: int) -> None:
        self._bits, self._size = np.random.Philox(key=seed), size
        self._rows: deque[Array] = deque()

    def next_row(self) -> Array:
        """Return the next row, (size,)."""
        if not self._rows:
            blocks = -(-self._size // 4)
            raw = self._bits.random_raw(_ROWS_DRAWN_TOGETHER * blocks * 4)
            shares = ((raw >> 11) + 0.5) * 2.0**-53
            sizes, turns = np.sqrt(-2.0 * np.log(shares[::2])), 2.0 * np.pi * shares[1::2]
            normals = np.stack([sizes * np.cos(turns), sizes * np.sin(turns)], axis=1)
            self._rows.extend(normals.reshape(_ROWS_DRAWN_TOGETHER, -1)[:, : self._size])
        return self._rows.popleft()


class Sensors:
    """Plant state measurements, with bias, noise, delay and dropouts.

    ``pose`` (7,), ``twist`` (6,), ``q`` and ``qdot`` (n,) are the last measurements, in the same
    arrangement as the plant state. Each call of :meth:`measure` draws new noise; flights with the
    same seed are identical.

    When a delay begins, pose and twist are frozen until the delay has elapsed.

    Raises
    ------
    ParameterError
        The joint bias has the wrong length.
    """

    def __init__(self, plant: PlantWithFaults, config: PlantConfig) -> None:
        n, errors = plant.robot.n, config.sensors
        if len(errors.joint_bias) not in (0, n):
            raise ParameterError(
                f"Parameter 'sensors.joint_bias' has {counted(len(errors.joint_bias), 'value')}; "
                f"the robot has {counted(n, 'joint')}."
            )
        self._plant, self._config = plant, errors
        self._normals = NormalNumbers(errors.seed, 12 + 2 * n)
        self._joint_index = {name: i for i, name in enumerate(plant.robot.joint_names)}
        self.pose, self.twist = plant.pose.copy(), plant.twist.copy()
        self.q, self.qdot = plant.q.copy(), plant.qdot.copy()
        self.dropout = False
        """Whether the pose is missing due to a dropout."""
        self._pose_bias, self._joint_bias = np.zeros(6), np.zeros(n)
        self._noise = dict.fromkeys(NOISE_PARAMETERS, 0.0)
        self.pose_covariance, self.twist_covariance = np.zeros(36), np.zeros(36)
        """Covariances of pose and twist, each 6 x 6 in row-major order, for the noise only; bias
        and delay are not included."""
        self._delay = 0
        self._past: deque[tuple[Array, Array]] = deque(maxlen=1)
        """Copies of the true poses and twists during the last few ticks."""
        self._apply_faults(plant.active)
        self.used = self.is_imperfect or any(
            FAULT_KINDS[f.kind].sensor for f in plant.timeline.entries
        )
        """Whether measurements differ from the truth now, or at another time because of a known
        fault."""

    @property
    def is_imperfect(self) -> bool:
        """Whether measurements currently differ from the true values."""
        return bool(
            self.dropout
            or self._delay
            or self._pose_bias.any()
            or self._joint_bias.any()
            or any(self._noise.values())
        )

    def measure(self) -> None:
        """Measure the plant's current state; do nothing if the sensors have no errors."""
        if self._plant.active is not self._faults:
            self._apply_faults(self._plant.active)
            self.used = self.used or self.is_imperfect
        if not self.used:
            return
        plant, noise, errors = self._plant, self._noise, self._normals.next_row()
        self._past.append((plant.pose.copy(), plant.twist.copy()))
        # At the beginning of a delay, fewer past states than its ticks exist.
        pose, twist = self._past[max(0, len(self._past) - 1 - self._delay)]
        n = len(self.q)
        turn = self._pose_bias[3:] + noise["attitude"] * errors[3:6]
        self.pose[:3] = pose[:3] + self._pose_bias[:3] + noise["position"] * errors[:3]
        self.pose[3:] = pose[3:]
        if turn.any():
            self.pose[3:] = quaternion_multiply(pose[3:], quaternion_from_rotvec(turn))
        self.twist[:3] = twist[:3] + noise["velocity"] * errors[6:9]
        self.twist[3:] = twist[3:] + noise["angular_velocity"] * errors[9:12]
        self.q[:] = plant.q + self._joint_bias + noise["joints"] * errors[12 : 12 + n]
        self.qdot[:] = plant.qdot + noise["joint_rates"] * errors[12 + n :]

    def _apply_faults(self, faults: tuple[Fault, ...]) -> None:
        self._faults = faults
        config = self._config
        self._pose_bias[:3] = config.position_bias or 0.0
        self._pose_bias[3:] = config.attitude_bias or 0.0
        self._joint_bias[:] = config.joint_bias or 0.0
        variances = {group: getattr(config, name) ** 2 for group, name in NOISE_PARAMETERS.items()}
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
        # The noise of a group is isotropic, so its covariance does not depend on the frame.
        for covariance, linear, angular in (
            (self.pose_covariance, "position", "attitude"),
            (self.twist_covariance, "velocity", "angular_velocity"),
        ):
            covariance[[0, 7, 14]], covariance[[21, 28, 35]] = variances[linear], variances[angular]
        self._delay = round(delay / self._plant.control_period)
        self._past = deque(self._past, maxlen=self._delay + 1)


class TargetSensors:
    """Target motion measurements, with bias, noise, delay, loss and a rate.

    ``pose`` (7,) and ``twist`` (6,) are the last measurements, in the same arrangement as the
    target's pose and twist. Each call of :meth:`measure` draws the same number of random values,
    from a separate random stream.

    When a delay begins, pose and twist are frozen until the delay has elapsed.
    """

    def __init__(self, capturing: CapturePlant, config: PlantConfig) -> None:
        self._capturing, errors = capturing, config.target.sensors
        self._config, control_period = errors, config.control_period
        # Robot sensors have the stream of the seed itself, actuators that of its first child.
        seeds = np.random.SeedSequence(config.sensors.seed, spawn_key=(1,))
        self._rng = np.random.default_rng(seeds)
        self.pose, self.twist = capturing.target_pose.copy(), capturing.target_twist.copy()
        self.used = errors != TargetSensorConfig()
        """Whether measurements differ from the truth."""
        self.missing = False
        """Whether there is no measurement in this tick."""
        self._position_bias = np.array(errors.position_bias or (0.0, 0.0, 0.0))
        self._attitude_bias = np.array(errors.attitude_bias or (0.0, 0.0, 0.0))
        self._delay = round(errors.delay / control_period)
        self._every = max(1, round(1.0 / (errors.rate * control_period))) if errors.rate else 1
        self._count = 0
        self._past: deque[tuple[Array, Array]] = deque(maxlen=self._delay + 1)

    def measure(self) -> None:
        """Measure the target's current state; do nothing if the sensors have no errors."""
        if not self.used:
            return
        config, truth = self._config, self._capturing
        errors, chance = self._rng.standard_normal(12), self._rng.random()
        self._past.append((truth.target_pose.copy(), truth.target_twist.copy()))
        self.missing = self._count % self._every != 0 or chance < config.loss
        self._count += 1
        if self.missing:
            return
        pose, twist = self._past[0]
        turn = self._attitude_bias + config.attitude_noise * errors[3:6]
        offset = matrix_from_quaternion(pose[3:]) @ self._position_bias
        self.pose[:3] = pose[:3] + offset + config.position_noise * errors[:3]
        self.pose[3:] = quaternion_multiply(pose[3:], quaternion_from_rotvec(turn))
        self.twist[:3] = twist[:3] + config.velocity_noise * errors[6:9]
        self.twist[3:] = twist[3:] + config.angular_velocity_noise * errors[9:]


class ReportedState:
    """A plant's measured and true state, as published on its topics.

    Parameters
    ----------
    plant
        The plant.
    config
        The plant configuration: sensors and end-effector.

    Attributes
    ----------
    sensors
        Sources of odom and joint_states.
    target_sensors
        Source of target/odom; None if there is no target.
    quantities
        Arrays by :attr:`StateField.quantity` name, updated in place. The dictionary is replaced
        when measurements begin to deviate from the truth. The dictionary omits quantities that the
        plant does not have (thrusters, an end-effector, true values that differ from measurements).

    Raises
    ------
    ParameterError
        The robot has no link ``end_effector_frame``, or the sensors are invalid.
    """

    def __init__(self, plant: PlantWithFaults, config: PlantConfig) -> None:
        self._plant = plant
        self.sensors = Sensors(plant, config)
        robot, count = plant.robot, len(plant.robot.link_names)
        link = robot.description.end_effector(config.end_effector_frame)
        self._end_effector: LinkPlacement | None = None
        if link:
            index = _link_index(robot, link, "'end_effector_frame' is")
            self._end_effector = LinkPlacement(count, [(index, Pose())])
        names = self._end_effectors = config.end_effectors
        named = [(_link_index(robot, name, "'end_effectors' names"), Pose()) for name in names]
        require_own_topics(names)
        self._named_links = LinkPlacement(count, named) if named else None
        self._link_poses = robot.buffered("link_poses") if named else None
        capturing = plant.capturing
        self.target = None if capturing is None else capturing.target.description
        """The target; None if there is no target."""
        self.target_sensors: TargetSensors | None = None
        if capturing is not None:
            self.target_sensors = TargetSensors(capturing, config)
        self._sensors_used, self._loaded = self.sensors.used, plant.loads is not None
        self.quantities = self._quantities()

    @property
    def topics(self) -> list[Topic]:
        """The state topics that this plant currently publishes, in publication order."""
        return [
            topic
            for topic in state_topics(self._end_effectors)
            if all(field.quantity in self.quantities for field in topic.state)
        ]

    def names(self, topic: Topic) -> tuple[str, ...]:
        """Return the entry names of a topic's arrays: joints or thrusters."""
        if topic.array_entries_of == "thrusters" and self._plant.thrusters is not None:
            return tuple(self._plant.thrusters.table.names)
        return tuple(self._plant.robot.joint_names)

    @property
    def misses_target(self) -> bool:
        """Whether the target is not measured in this tick."""
        return self.target_sensors is not None and self.target_sensors.missing

    def update(self) -> bool:
        """Measure the plant's current state.

        Returns
        -------
        bool
            Whether :attr:`quantities` has been replaced.
        """
        self.sensors.measure()
        if self.target_sensors is not None:
            self.target_sensors.measure()
        if self._end_effector is not None:
            plant = self._plant
            self._end_effector.update(plant.pose, plant.link_R, plant.link_r)
        if self._named_links is not None and self._link_poses is not None:
            measured = self.sensors if self.sensors.used else self._plant
            self._named_links.update(measured.pose, *self._link_poses(measured.q))
        loaded = self._plant.loads is not None
        if self.sensors.used == self._sensors_used and loaded == self._loaded:
            return False
        self._sensors_used, self._loaded = self.sensors.used, loaded
        self.quantities = self._quantities()
        return True

    def _quantities(self) -> dict[str, Array]:
        plant, thrusters = self._plant, self._plant.thrusters
        measured = self.sensors if self._sensors_used else plant
        quantities = {
            "pose": plant.pose,
            "effort": plant.effort,
            "momentum": plant.momentum,
            **{f"measured_{name}": getattr(measured, name) for name in _MEASURED},
        }
        if self._end_effector is not None:
            quantities["end_effector_pose"] = self._end_effector.poses[0]
        if self._named_links is not None:
            for name, pose in zip(self._end_effectors, self._named_links.poses, strict=True):
                quantities[pose_topic(name).state[0].quantity] = pose
        capturing = plant.capturing
        if capturing is not None:
            assert self.target_sensors is not None
            true = {"target_pose": capturing.target_pose, "target_twist": capturing.target_twist}
            quantities |= true
            if self.target_sensors.used:
                quantities["target_pose"] = self.target_sensors.pose
                quantities["target_twist"] = self.target_sensors.twist
                quantities |= {f"true_{name}": values for name, values in true.items()}
        if plant.takes_wrench or self._loaded or capturing is not None:
            quantities["expected_momenta"] = plant.expected_momenta
        if self._sensors_used:
            quantities |= {f"true_{name}": getattr(plant, name) for name in _MEASURED}
        if thrusters is not None:
            quantities |= {
                "thruster_wrench": thrusters.wrench,
                "thruster_on_time": thrusters.on_time,
                "thruster_duty": thrusters.duty,
                "thruster_force": thrusters.thrust,
            }
        return quantities


def _link_index(robot: SpaceRobot, name: str, parameter: str) -> int:
    links = list(robot.link_names)
    if name not in links:
        raise ParameterError(
            f"Parameter {parameter} '{name}', but the robot has no such link; it has "
            f"{', '.join(links)}."
        )
    return links.index(name)
