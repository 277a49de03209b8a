"""A plant goes on from the last state of a bag: its tick, its pose, its momenta."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.lifecycle import TransitionCallbackReturn
from support.made_bags import array, joint_states, made_bag, odometry
from support.odometry import pose_of, twist_of
from support.plant_rig import SLIDERS, TICK_NS, Rig
from support.ros_harness import Harness, nanoseconds

from spacerobot_ros.nodes import PlantNode

MASS = 10 + 3 * 2.0
P, L = [0.8, -0.4, 0.2], [0.03, 0.02, -0.01]
POSE = (1.0, -2.0, 3.0, 0.0, 0.6, 0.0, 0.8)
JOINTS, RATES = [0.5, -0.25, 0.125], [0.01, 0.02, 0.03]


def bag_of(path: Path, names: list[str] = SLIDERS, prefix: str = "", L: list[float] = L) -> Path:
    """Write a flight that ends at 1.15 s, in tick 23, with another state before."""
    with made_bag(path) as (_, say):
        for time, more in ((1.1, 1.0), (1.15, 0.0)):
            momenta = [x + more for x in (*P, *L, 9.0)]
            say(f"{prefix}/momentum", array(*momenta), time)
            pose = (POSE[0] + more, *POSE[1:])
            say(f"{prefix}/odom", odometry(time, *pose, *([0.7] * 6)), time)
            joints = [q + more for q in JOINTS[: len(names)]]
            rates = [q + more for q in RATES[: len(names)]]
            say(f"{prefix}/joint_states", joint_states(time, names, joints, rates), time)
    return path


def resumed(harness: Harness, bag: Path, **parameters: Any) -> Rig:
    return Rig(harness, {"resume_bag": str(bag), **parameters})


def test_the_first_state_is_the_last_of_the_bag(harness: Harness, tmp_path: Path) -> None:
    rig = resumed(harness, bag_of(tmp_path / "a.mcap"))
    harness.settle(rig.probe)
    joints, odom = rig.probe.last("joint_states"), rig.probe.last("odom")
    assert nanoseconds(joints.header.stamp) == nanoseconds(odom.header.stamp) == 23 * TICK_NS
    assert nanoseconds(rig.probe.last("/clock").clock) == 23 * TICK_NS
    np.testing.assert_allclose(joints.position, JOINTS, atol=1e-15)
    position, quaternion = pose_of(odom)
    np.testing.assert_allclose([*position, *quaternion], POSE, atol=1e-15)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:6], [*P, *L], atol=1e-14)


def test_time_goes_on_from_there_tick_by_tick(harness: Harness, tmp_path: Path) -> None:
    # Without angular momentum the base coasts and does not turn: by hand, r + p t / m.
    rig = resumed(harness, bag_of(tmp_path / "a.mcap", L=[0.0] * 3))
    assert rig.plant.tick == 23
    for k in (1, 2):
        joints = rig.step([0.0] * 3)
        assert nanoseconds(joints.header.stamp) == (23 + k) * TICK_NS
    harness.settle(rig.probe)
    odom = rig.probe.last("odom")
    expected = np.array(POSE[:3]) + np.array(P) / MASS * 0.1
    np.testing.assert_allclose(pose_of(odom)[0], expected, atol=1e-13)
    np.testing.assert_allclose(pose_of(odom)[1], POSE[3:], atol=1e-13)
    np.testing.assert_allclose(joints.position, JOINTS, atol=1e-15)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:3], P, atol=1e-13)


@pytest.mark.parametrize(("actuation", "rates"), [("velocity", [0.0] * 3), ("effort", RATES)])
def test_only_motors_leave_joints_moving(
    harness: Harness, tmp_path: Path, actuation: str, rates: list[float]
) -> None:
    rig = resumed(harness, bag_of(tmp_path / "a.mcap"), actuation=actuation)
    joints = rig.probe.last("joint_states")
    np.testing.assert_allclose(joints.velocity, rates, atol=1e-14)
    harness.settle(rig.probe)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:6], [*P, *L], atol=1e-14)
    assert np.linalg.norm(np.concatenate(twist_of(rig.probe.last("odom")))) > 0.01


def test_a_bag_of_another_robot_is_refused(harness: Harness, tmp_path: Path) -> None:
    bags = {
        "others": bag_of(tmp_path / "a.mcap", ["slider_2", "slider_1", "slider_3"]),
        "fewer": bag_of(tmp_path / "b.mcap", SLIDERS[:2]),
        "elsewhere": bag_of(tmp_path / "c.mcap", prefix="/a"),
    }
    for bag, mention in zip(
        bags.values(), ("slider_2, slider_1", "slider_1, slider_2;", "nothing is on"), strict=True
    ):
        plant = harness.make(
            PlantNode,
            {"robot": "sliding_masses", "resume_bag": str(bag)},
            name=f"plant_{bag.stem}",
            autostart=False,
        )
        assert plant.trigger_configure() is TransitionCallbackReturn.FAILURE
        assert mention in str(plant.fault)


def test_a_plant_in_a_namespace_goes_on_from_its_own_robot(
    harness: Harness, tmp_path: Path
) -> None:
    bag = bag_of(tmp_path / "a.mcap", prefix="/a")
    plant = harness.make(
        PlantNode,
        {"robot": "sliding_masses", "resume_bag": str(bag), "tick_rate": 20.0},
        name="plant",
        namespace="/a",
        autostart=False,
    )
    assert plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
    assert plant.tick == 23
