"""Parts of the plant by themselves: events of statuses, stops, approaches, reports and poses."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.model.grasp import GraspImpact
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import capture, sensors
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.capture import CaptureReport, GrappleMotion, ReleaseReport
from spacerobot_ros.simulation.config import CaptureConfig, PlantConfig, TargetConfig
from spacerobot_ros.simulation.status import PlantState, PlantStatus

RUNNING = PlantStatus(PlantState.RUNNING, "It runs.", time_s=7.5)


# -- status -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({}, 0),
        ({"reason": "no_command", "state": PlantState.RESTING}, 0),
        ({"reason": "timeout", "state": PlantState.RESTING}, 1),
        ({"faults": ("a",)}, 1),
        ({"disturbances": ("a",)}, 1),
        ({"latched_fault": "a"}, 2),
        ({"state": PlantState.LATCHED}, 2),
        ({"state": PlantState.FAILED}, 2),
        ({"state": PlantState.PAUSED}, 0),
    ],
)
def test_a_status_has_the_level_of_its_worst_part(changes: dict[str, Any], level: int) -> None:
    assert replace(RUNNING, **changes).level == level


def test_a_status_is_pairs_of_words() -> None:
    bare = {
        "state": "running",
        "reason": "",
        "latched_fault": "",
        "time_s": "7.500000000",
        "rearms": "0",
        "resets": "0",
        "timeouts": "0",
        "faults": "",
    }
    assert RUNNING.to_values() == bare
    whole = PlantStatus(
        *(PlantState.RESTING, "", "timeout", "hot", 0.25, 3, 4, ("a", "b"), ("c", "d"), 5, 0.0, "x")
    )
    values = whole.to_values()
    assert values["faults"] == "a; b"
    assert {name: values[name] for name in ("rearms", "resets", "timeouts", "payload")} == {
        **{"rearms": "3", "resets": "4", "timeouts": "5", "payload": "x"}
    }
    assert (values["last_command_s"], values["latched_fault"]) == ("0.000000000", "hot")
    assert PlantStatus.from_values(values) == whole
    assert PlantStatus.from_values({"state": "failed"}, "m") == PlantStatus(PlantState.FAILED, "m")


# -- captures ------------------------------------------------------------------------------------


IMPACT = GraspImpact(
    twist=np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
    qdot=np.array([0.7, -0.8]),
    impulse=np.array([2.0, -3.0, 6.0, 1.0, 2.0, -2.0]),
    joint_impulses=np.array([0.5, -1.25]),
    energy_before=4.5,
    energy_lost=1.5,
)


def report(limit: float, names: tuple[str, ...] = ("elbow", "wrist"), **others: Any) -> Any:
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    return CaptureReport(IMPACT, turned, np.arange(1.0, 7.0), 1e-15, True, names, limit, **others)


def test_a_capture_warns_of_the_joint_that_takes_most() -> None:
    plain = "The target is captured by an impulse of 7 N s and 3 N m s; 1.5 J of 4.5 J are lost"
    warning = (
        f"{plain}, and joint 'wrist' takes 1.25 N m s, more than "
        "'capture.joint_impulse_limit', 1.2."
    )
    for limit, message, level in (
        (0.0, f"{plain}.", 0),
        (1.25, f"{plain}.", 0),
        (1.2, warning, 1),
    ):
        event = report(limit).event(9.5)
        assert (event.message, event.level, event.time_s) == (message, level, 9.5)
        assert event.kind is EventKind.CAPTURED
    assert report(0.1, names=()).event(1.0).level == 0
    one = replace(
        report(0.1, names=("only",)), impact=replace(IMPACT, joint_impulses=np.array([-1]))
    )
    assert "joint 'only' takes 1 N m s" in one.event(1.0).message


def test_the_facts_of_a_capture_survive_their_event() -> None:
    made = report(2.5)
    values = made.to_values()
    np.testing.assert_allclose(values.pop("base_velocity_mps"), [-0.2, 0.1, 0.3])
    np.testing.assert_allclose(values.pop("base_rate_radps"), [-0.5, 0.4, 0.6])
    assert values == {
        "captured": True,
        "requested": True,
        "joint_rates_radps": [0.7, -0.8],
        "impulse_Ns": [2.0, -3.0, 6.0, 1.0, 2.0, -2.0],
        "joint_impulses_Nms": [0.5, -1.25],
        "joint_impulse_limit_Nms": 2.5,
        "energy_before_J": 4.5,
        "energy_lost_J": 1.5,
        "linear_momentum_kgmps": [1.0, 2.0, 3.0],
        "angular_momentum_Nms": [4.0, 5.0, 6.0],
        "total_momentum_residual": 1e-15,
    }
    assert capture.capture_values(made.event(0.0).about) == made.to_values()
    assert capture.capture_values({"a": "1", "b": "{"}) == {}
    default = CaptureReport(IMPACT, np.eye(3), np.zeros(6), 0.0, requested=False)
    assert (default.joint_names, default.joint_impulse_limit) == ((), 0.0)


def test_a_release_says_how_the_target_moves() -> None:
    event = ReleaseReport(np.array([0.3, 0.0, -0.4]), np.array([0.0, -1.2, 0.5])).event(2.0)
    assert event.message == "The target is released; it moves at 0.5 m/s and 1.3 rad/s."
    assert (event.kind, event.level, event.time_s) == (EventKind.RELEASED, 0, 2.0)
    assert json.loads(event.about["velocity_mps"]) == [0.3, 0.0, -0.4]
    assert json.loads(event.about["rate_radps"]) == [0.0, -1.2, 0.5]


def test_an_approach_may_be_at_its_limits() -> None:
    limits = CaptureConfig(distance=0.5, angle=0.25, speed=0.125, rate=0.0625)
    assert GrappleMotion(0.5, 0.25, 0.125, 0.0625).misses(limits) == []
    assert GrappleMotion(0.75, 0.2, 0.375, math.nan).misses(limits) == [
        "distance is 0.75 m, 0.25 m more than 'capture.distance', 0.5",
        "speed is 0.375 m/s, 0.25 m/s more than 'capture.speed', 0.125",
        "rate is nan rad/s, nan rad/s more than 'capture.rate', 0.0625",
    ]
    assert GrappleMotion(0.0, 0.5, 0.0, 0.125).misses(limits) == [
        "angle is 0.5 rad, 0.25 rad more than 'capture.angle', 0.25",
        "rate is 0.125 rad/s, 0.0625 rad/s more than 'capture.rate', 0.0625",
    ]


def test_targets_float_where_no_parameter_says_otherwise() -> None:
    config = configured(TargetConfig, {})
    assert not config.given
    assert (config.position, config.velocity, config.angular_velocity) == ((0.0, 0.0, 0.0),) * 3
    assert config.orientation == (0.0, 0.0, 0.0, 1.0)
    assert configured(TargetConfig, {"robot": "a.urdf"}).given
    assert configured(TargetConfig, {"robot_description": "<robot/>"}).given
    body = parse_robot(
        '<robot name="b"><link name="hull"><inertial><mass value="2"/><inertia ixx="1" iyy="1" '
        'izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    made = capture.Target(
        body,
        replace(config, orientation=(), grapple_frame="hull", velocity=(1.0, 0.0, -2.0)),
        0.1,
        0.1,
    )
    assert made.pose.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(made.twist, [1.0, 0.0, -2.0, 0.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(made.momenta, [2.0, 0.0, -4.0, 0.0, 0.0, 0.0], atol=1e-15)
    made.step()
    np.testing.assert_allclose(made.pose[:3], [0.1, 0.0, -0.2], atol=1e-15)
    made.reset()
    assert not made.pose[:3].any()


# -- sensors -------------------------------------------------------------------------------------


def test_covariances_are_those_of_the_noise_on_the_diagonals() -> None:
    config = PlantConfig(
        robot="sliding_masses",
        sensors=replace(
            PlantConfig().sensors,
            position_noise=2.0,
            attitude_noise=3.0,
            velocity_noise=4.0,
            angular_velocity_noise=5.0,
        ),
    )
    plant = build_plant(SpaceRobot.from_file(robot_file("sliding_masses")), config)
    made = sensors.Sensors(plant, config.sensors, 0.05)
    for found, diagonal in (
        (made.pose_covariance, [4.0] * 3 + [9.0] * 3),
        (made.twist_covariance, [16.0] * 3 + [25.0] * 3),
    ):
        np.testing.assert_array_equal(found.reshape(6, 6), np.diag(diagonal))
    assert made.used
    assert not made.dropout
