"""What imperfect sensors measure: noise, bias, delay, dropout, and nothing else when perfect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.effort_flights import robot_of
from support.oracles import Array

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import InitialState, VelocityPlant
from spacerobot_ros.simulation.actuators import PlantWithFaults, build_plant
from spacerobot_ros.simulation.config import PlantConfig, SensorConfig
from spacerobot_ros.simulation.sensors import Sensors

TICK = 0.05
URDF = (share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8")
START = InitialState(
    position=np.array([1.0, -2.0, 0.5]),
    quaternion=Rotation.from_rotvec([0.4, -1.0, 0.7]).as_quat(),
    joint_positions=np.array([0.2, -0.4, 0.9]),
    angular_momentum=np.array([0.5, -0.2, 0.3]),
)


class Flight:
    """A plant, its sensors, and everything they said beside the truth."""

    def __init__(self, config: SensorConfig, *faults: str, ticks: int, moving: bool = True) -> None:
        inner = VelocityPlant(robot_of(URDF), TICK, START)
        self.plant = PlantWithFaults(inner, faults, TICK, wrench=False)
        self.sensors = Sensors(self.plant, config, TICK)
        self.dropouts: list[bool] = []
        measured: list[Array] = []
        true: list[Array] = []
        for tick in range(ticks):
            self.sensors.measure()
            for rows, source in ((measured, self.sensors), (true, self.plant)):
                rows.append(np.concatenate([source.pose, source.twist, source.q, source.qdot]))
            self.dropouts.append(self.sensors.dropout)
            # To and fro: strokes are short.
            self.plant.step(np.array([0.1, -0.05, 0.1]) * (moving * (-1) ** (tick // 5)))
        self.measured, self.true = np.array(measured), np.array(true)

    def errors(self) -> dict[str, Array]:
        """Return what each group is off by, tick by tick; attitudes as rotation vectors in B."""
        off = self.measured - self.true
        turn = Rotation.from_quat(self.true[:, 3:7]).inv() * Rotation.from_quat(
            self.measured[:, 3:7]
        )
        return {
            "position": off[:, :3],
            "attitude": turn.as_rotvec(),
            "velocity": off[:, 7:10],
            "angular_velocity": off[:, 10:13],
            "joints": off[:, 13:16],
            "joint_rates": off[:, 16:],
        }


SIGMAS = {
    "position": 1e-3,
    "attitude": 9e-4,
    "velocity": 2e-3,
    "angular_velocity": 3e-3,
    "joints": 4e-3,
    "joint_rates": 5e-3,
}
NOISY = SensorConfig(
    position_noise=SIGMAS["position"],
    attitude_noise=SIGMAS["attitude"],
    velocity_noise=SIGMAS["velocity"],
    angular_velocity_noise=SIGMAS["angular_velocity"],
    joint_noise=SIGMAS["joints"],
    joint_rate_noise=SIGMAS["joint_rates"],
    seed=3,
)


def test_perfect_sensors_do_nothing_at_all() -> None:
    flight = Flight(SensorConfig(), ticks=5)
    assert not flight.sensors.used
    # They have not even looked.
    np.testing.assert_array_equal(flight.measured, np.tile(flight.true[0], (5, 1)))


def test_every_component_has_its_noise_and_no_mean() -> None:
    ticks = 3000
    flight = Flight(NOISY, ticks=ticks)
    assert flight.sensors.used
    np.testing.assert_allclose(np.linalg.norm(flight.measured[:, 3:7], axis=1), 1.0, atol=1e-12)
    for group, errors in flight.errors().items():
        sigma = SIGMAS[group]
        np.testing.assert_allclose(errors.std(axis=0), sigma, rtol=5 / np.sqrt(2 * ticks))
        assert np.abs(errors.mean(axis=0)).max() < 5 * sigma / np.sqrt(ticks)
        # No tick knows of the one before.
        lagged = np.sum(errors[1:] * errors[:-1], axis=0) / np.sum(errors**2, axis=0)
        assert np.abs(lagged).max() < 5 / np.sqrt(ticks)


def test_one_noise_leaves_the_rest_exact() -> None:
    flight = Flight(SensorConfig(attitude_noise=1e-3), ticks=20)
    errors = flight.errors()
    assert np.abs(errors.pop("attitude")).min() > 0.0
    assert all(not error.any() for error in errors.values())


def test_a_seed_is_a_flight() -> None:
    once, again, other = (Flight(replace(NOISY, seed=s), ticks=50) for s in (5, 5, 6))
    np.testing.assert_array_equal(once.measured, again.measured)
    np.testing.assert_array_equal(once.true, other.true)
    assert np.abs(once.measured - other.measured).max() > 1e-3


def test_biases_are_added_and_attitudes_turned_in_the_base() -> None:
    config = SensorConfig(
        position_bias=(0.1, 0.0, -0.2),
        attitude_bias=(0.0, 0.01, 0.0),
        joint_bias=(0.0, 0.003, -0.004),
    )
    flight = Flight(config, "sensor_bias position_y 0.5 at 0.5", ticks=20)
    errors = flight.errors()
    step = np.where(np.arange(20) >= 10, 0.5, 0.0)
    np.testing.assert_allclose(errors["position"][:, [0, 2]], np.tile([0.1, -0.2], (20, 1)))
    np.testing.assert_allclose(errors["position"][:, 1], step, atol=1e-15)
    np.testing.assert_allclose(errors["attitude"], np.tile([0.0, 0.01, 0.0], (20, 1)), atol=1e-12)
    np.testing.assert_allclose(errors["joints"], np.tile([0.0, 0.003, -0.004], (20, 1)), atol=1e-15)


def test_faults_of_sensors_come_and_go() -> None:
    flight = Flight(
        SensorConfig(position_noise=3e-3),
        "sensor_noise position 4e-3 at 50 until 100",
        "sensor_dropout odom at 10 until 11",
        "sensor_bias elbow_pitch 0.2 at 20 until 21",
        ticks=3000,
    )
    position = flight.errors()["position"]
    assert position[:1000].std() == pytest.approx(3e-3, rel=0.05)
    assert position[1000:2000].std() == pytest.approx(5e-3, rel=0.05), "variances add up"
    assert position[2000:].std() == pytest.approx(3e-3, rel=0.05)
    assert np.flatnonzero(flight.dropouts).tolist() == list(range(200, 220))
    biased = flight.errors()["joints"][:, 2]
    assert np.flatnonzero(biased).tolist() == list(range(400, 420))


def test_a_late_pose_is_that_of_as_many_ticks_before() -> None:
    flight = Flight(SensorConfig(), "sensor_delay odom 0.2 at 1 until 3", ticks=80)
    pose, late = flight.true[:, :13], flight.measured[:, :13]
    np.testing.assert_array_equal(late[:20], pose[:20])
    # As long as less is known of the past, it is the oldest that is.
    np.testing.assert_array_equal(late[24:60], pose[20:56])
    np.testing.assert_array_equal(late[60:], pose[60:])
    np.testing.assert_array_equal(
        flight.measured[:, 13:], flight.true[:, 13:], "joints are on time"
    )


def test_a_bias_of_other_joints_is_refused() -> None:
    with pytest.raises(ParameterError, match=r"'sensors.joint_bias' has 2 number.*has 3 joints"):
        Flight(SensorConfig(joint_bias=(0.1, 0.2)), ticks=1)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *((f"sensors.{group}_noise", 1e7) for group in ("position", "attitude", "joint_rate")),
        ("sensors.joint_noise", 1e200),
        ("sensors.position_bias", (0.0, -1e7, 0.0)),
        ("sensors.joint_bias", (1e300,)),
        ("command_timeout", 1e300),
        ("marker_period", 1e308),
        ("initial_position", (1e200, 0.0, 0.0)),
        ("angular_momentum", (0.0, 1e200, 0.0)),
    ],
)
def test_parameters_that_would_overflow_are_refused_by_name(name: str, value: object) -> None:
    with pytest.raises(ParameterError, match=name):
        configured(PlantConfig, {name: value})


@pytest.mark.parametrize(
    "fault",
    [
        "sensor_bias position_x 0.1",
        "sensor_noise joints 0.1",
        "sensor_dropout odom",
        "sensor_delay odom 0.1",
    ],
)
def test_sensors_that_will_fail_are_in_use_from_the_begin(fault: str) -> None:
    flight = Flight(SensorConfig(), f"{fault} at 5", ticks=1)
    assert flight.sensors.used
    assert not flight.sensors.is_imperfect
    assert not Flight(SensorConfig(), "joint_stuck elbow_pitch at 5", ticks=1).sensors.used


@pytest.mark.parametrize("config", [SensorConfig(), SensorConfig(position_bias=(0.3, -0.2, 0.1))])
@pytest.mark.parametrize(("tick", "delay"), [(0.05, 0.15), (0.1, 0.3)])
def test_a_delay_that_begins_in_flight_holds_the_present_pose_and_follows_it(
    config: SensorConfig, tick: float, delay: float
) -> None:
    """Whatever quotients round to, a delay of three ticks lasts three; a bias does not add up."""
    plant = PlantWithFaults(VelocityPlant(robot_of(URDF), tick, START), (), tick, wrench=False)
    sensors = Sensors(plant, config, tick)
    bias = np.array(config.position_bias)
    true, measured = [], []
    for number in range(14):
        if number == 6:
            plant.inject(f"sensor_delay odom {delay}")
        sensors.measure()
        true.append(plant.pose.copy())
        pose = sensors.pose if sensors.used else plant.pose
        measured.append(np.concatenate([pose[:3] - bias * sensors.used, pose[3:]]))
        plant.step(np.array([0.1, -0.05, 0.1]))
    held = 5 if bias.any() else 6  # Sensors in use remember the state before.
    expected = [*true[:6], *[true[max(held, number - 3)] for number in range(6, 14)]]
    np.testing.assert_allclose(measured, expected, rtol=0, atol=1e-15)
    assert np.ptp([pose[0] for pose in true]) > 1e-4


def test_actuators_and_sensors_draw_from_different_streams() -> None:
    """With one seed, no draw of one is among the first thousands of the other."""
    config = PlantConfig(
        faults=tuple(f"actuator_noise {name} 0.001" for name in robot_of(URDF).joint_names),
        sensors=SensorConfig(position_noise=1.0, seed=11),
    )
    plant = build_plant(robot_of(URDF), config, START)
    sensors = Sensors(plant, config.sensors, config.control_period)
    noises, errors = [], []
    for _ in range(300):
        sensors.measure()
        errors.append(sensors.pose[:3] - plant.pose[:3])
        plant.step(np.zeros(3))
        noises.append(plant.qdot / 0.001)
    of_actuators, of_sensors = np.ravel(noises), np.ravel(errors)
    assert of_actuators.std() == pytest.approx(1.0, abs=0.15)
    assert np.abs(of_actuators[:, None] - of_sensors).min() > 1e-9
    assert abs(np.corrcoef(of_actuators, of_sensors)[0, 1]) < 0.15
