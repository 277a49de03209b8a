"""What a plant reports by topic, and that a new topic is an entry in the table and a quantity."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from scipy.spatial.transform import Rotation
from std_msgs.msg import Float64MultiArray
from support.oracles import PinocchioOracle

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.plant.publisher import StatePublisher
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig, SensorConfig
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.topics import TOPICS, StateField, Topic

SLIDERS = SpaceRobot.from_file(robot_file("sliding_masses"))
ARM = SpaceRobot.from_file(robot_file("three_joint_arm"))


def reported(robot: SpaceRobot, **parameters: Any) -> ReportedState:
    config = PlantConfig(**parameters)
    return ReportedState(build_plant(robot, config), config)


def names(state: ReportedState) -> list[str]:
    return [topic.name for topic in state.topics]


def test_topics_follow_from_the_plant() -> None:
    perfect = ["base_pose", "momentum", "odom", "joint_states"]
    assert [n for n in names(reported(SLIDERS)) if n != "end_effector_pose"] == perfect
    assert "momentum_expected" in names(reported(SLIDERS, actuation="effort"))
    noisy = names(reported(SLIDERS, sensors=SensorConfig(joint_noise=1e-3)))
    assert noisy[-4:] == ["odom_true", "joint_states_true", "odom", "joint_states"]
    with pytest.raises(ParameterError, match="'end_effector_frame' is 'claw'"):
        reported(SLIDERS, end_effector_frame="claw")


def test_the_truth_goes_to_its_own_topics_once_the_sensors_err() -> None:
    config = PlantConfig()
    plant = build_plant(ARM, config)
    state = ReportedState(plant, config)
    assert not state.update()
    assert state.quantities["measured_q"] is plant.q
    plant.inject(f"sensor_bias {ARM.joint_names[0]} 0.5")
    assert state.update()
    assert "odom_true" in names(state)
    assert state.quantities["true_q"] is plant.q
    assert state.quantities["measured_q"][0] == plant.q[0] + 0.5
    assert not state.update()


def test_the_end_effector_is_where_the_link_is() -> None:
    link = ARM.link_names[-1]
    config = PlantConfig(
        end_effector_frame=link,
        initial_position=(1.0, 2.0, 3.0),
        initial_orientation=(0.0, 0.0, 1.0, 1.0),
    )
    plant = build_plant(ARM, config)
    state = ReportedState(plant, config)
    state.update()
    in_base = plant.link_r[:, -1]
    # A quarter turn about z.
    expected = [1.0 - in_base[1], 2.0 + in_base[0], 3.0 + in_base[2]]
    np.testing.assert_allclose(state.quantities["end_effector_pose"][:3], expected, atol=1e-12)


def test_named_links_are_where_pinocchio_sees_them_in_the_measured_state() -> None:
    named = ("link_3", "base_link", "link_1")
    config = PlantConfig(
        end_effectors=named,
        initial_position=(1.0, 2.0, 3.0),
        initial_orientation=(0.1, -0.5, 0.3, 0.8),
        initial_joint_positions=(0.3, -0.7, 0.5),
    )
    plant = build_plant(ARM, config)
    state = ReportedState(plant, config)
    oracle = PinocchioOracle(robot_file("three_joint_arm").read_text("utf-8"), ARM.joint_names)
    for fault in ("clear", f"sensor_bias {ARM.joint_names[1]} 0.4", "sensor_bias position_x 0.7"):
        plant.inject(fault)
        plant.step(np.array([0.1, -0.3, 0.2]))
        state.update()
        pose, q = state.quantities["measured_pose"], state.quantities["measured_q"]
        oracle.set_configuration(q, pose[3:], pose[:3])
        for name in named:
            R_WE, r_WE = oracle.frame_W(name)
            published = state.quantities[f"pose_of_{name}"]
            np.testing.assert_allclose(published[:3], r_WE, atol=1e-12)
            R = Rotation.from_quat(published[3:]).as_matrix()
            np.testing.assert_allclose(R, R_WE, atol=1e-12)
    assert names(state)[:3] == [f"{name}/pose" for name in named]
    with pytest.raises(ParameterError, match="'end_effectors' names 'claw'"):
        reported(ARM, end_effectors=("link_1", "claw"))
    with pytest.raises(ParameterError, match="name each once"):
        reported(ARM, end_effectors=("link_1", "link_1"))


class _Streams:
    """In place of a node: keeps what is published."""

    def __init__(self) -> None:
        self.sent: dict[str, list[bytes]] = {}

    def send_raw(self, kind: type[Any], topic: str) -> Any:
        sent = self.sent.setdefault(topic, [])
        return type("Output", (), {"take": staticmethod(sent.append), "readers": lambda _: 0})()

    def create_publisher(self, *_: Any) -> None:
        return None


def test_a_new_topic_is_an_entry_in_the_table_and_a_quantity(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = Topic(
        "energy",
        "std_msgs/msg/Float64MultiArray",
        ("plant",),
        "kinetic energy (J)",
        state=(StateField("data", "kinetic_energy", array_entry_names=("kinetic_energy",)),),
    )
    monkeypatch.setitem(TOPICS, "energy", entry)
    quantities = ReportedState._quantities
    monkeypatch.setattr(
        ReportedState,
        "_quantities",
        lambda self: {**quantities(self), "kinetic_energy": self._plant.momentum[6:7]},
    )
    config = PlantConfig(angular_momentum=(0.0, 0.0, 2.0))
    plant = build_plant(SLIDERS, config)
    state = ReportedState(plant, config)
    streams: Any = _Streams()
    publisher = StatePublisher(streams, SLIDERS, state, PlantConfig())
    publisher.publish(0, all_topics=True)
    plant.step(np.array([0.1, 0.0, 0.0]))
    publisher.publish(50_000_000, all_topics=False)
    messages = [deserialize_message(raw, Float64MultiArray) for raw in streams.sent["energy"]]
    assert messages[-1].data[0] == plant.momentum[6] > messages[0].data[0] > 0.0
    assert messages[0].layout.dim[0].label == "kinetic_energy"
    assert len(streams.sent["base_pose"]) == 1, "not in every tick"
    assert len(streams.sent["odom"]) == 2
