"""Robots of other people's kind, from their file to tables of their flight."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from foreign_robots.run import (
    OUT_OF_REACH,
    ROBOTS,
    TABLE,
    Outcome,
    classes,
    tasks,
)
from scipy.spatial.transform import Rotation
from support.command_line import CliRunner

from spacerobot_ros.bag import RecordedRobot, read_bag
from spacerobot_ros.cli.main import main
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import robot_file

SLOW = pytest.mark.slow
FOLDER_OF_ROBOTS = Path(__file__).parent / "robots"


@dataclass(frozen=True)
class Stranger:
    """What a robot is asked and expected."""

    file: str
    options: tuple[str, ...] = ()
    said: str = ""
    """What `new` says, beside what it says of every robot."""
    second_engine: bool = True
    """Whether MuJoCo reads it."""


STRANGERS = {
    "one_link": Stranger("one_link.urdf", said="It has no joints and flies by thrusters"),
    "wheels_only": Stranger("wheels_only.urdf"),
    "rotors": Stranger("rotors.urdf"),
    "sliders_only": Stranger("sliders_only.urdf"),
    "root_world": Stranger("root_world.urdf"),
    "gripper": Stranger("gripper.urdf", second_engine=False),
    "missing_meshes": Stranger(
        "missing_meshes.urdf", said="'package://gone_description/meshes/link.stl' was not found"
    ),
    "quaternions": Stranger("quaternions.urdf"),
    "endless": Stranger("endless.urdf"),
    "impossible": Stranger(
        "impossible.urdf", ("--nearest-inertia",), "that of link 'hull' is changed by "
    ),
    "package": Stranger("probe_arm/urdf/arm.urdf.xacro"),
}


def call(*words: str) -> str:
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, f"{words}: {result.output}"
    return result.output


class Momentum:
    """Momentum about the centre of mass by Pinocchio, which reads the URDF by itself."""

    def __init__(self, urdf: str, names: list[str]) -> None:
        root = ElementTree.fromstring(urdf)
        for link in root.findall("link"):
            for tag in ("visual", "collision"):  # Its parser knows no capsules.
                for each in link.findall(tag):
                    link.remove(each)
        self.followers: dict[str, tuple[str, float, float]] = {}
        for joint in root.findall("joint"):
            if (mimic := joint.find("mimic")) is not None:
                k, b = (
                    float(mimic.get(name, d)) for name, d in (("multiplier", "1"), ("offset", "0"))
                )
                self.followers[joint.get("name", "")] = mimic.get("joint", ""), k, b
                joint.remove(mimic)
        text = ElementTree.tostring(root, encoding="unicode")
        self.model = pin.buildModelFromXML(text, pin.JointModelFreeFlyer())
        self.data, self.names = self.model.createData(), names

    def of(self, pose: Any, twist: Any, q: Any, qdot: Any) -> Any:
        positions = dict(zip(self.names, q, strict=True))
        rates = dict(zip(self.names, qdot, strict=True))
        for name, (leader, k, b) in self.followers.items():
            positions[name], rates[name] = k * positions[leader] + b, k * rates[leader]
        at, v = pin.neutral(self.model), np.zeros(self.model.nv)
        at[:7], v[:6] = pose, twist
        for name, position in positions.items():
            joint = self.model.joints[self.model.getJointId(name)]
            own = [position] if joint.nq == 1 else [np.cos(position), np.sin(position)]
            at[joint.idx_q : joint.idx_q + joint.nq] = own
            v[joint.idx_v] = rates[name]
        return np.array(pin.computeCentroidalMomentum(self.model, self.data, at, v))


def columns(topic: Any, path: str, names: str) -> Any:
    return np.stack([topic.field(f"{path}.{name}") for name in names.split()], axis=1)


@pytest.mark.parametrize(
    "name",
    [each if each == "root_world" else pytest.param(each, marks=SLOW) for each in STRANGERS],
)
def test_a_robot_of_others_flies_from_its_file_to_tables(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(FOLDER_OF_ROBOTS, tmp_path, dirs_exist_ok=True)
    stranger = STRANGERS[name]
    new = call("new", stranger.file, *stranger.options)
    assert stranger.said in new
    made = re.findall(r"^  spacerobot run (.*)$", new, re.MULTILINE)
    assert len(made) == 1
    assert "The goal is reached" in call("run", *made, "--bag", "flight.mcap")
    assert "verified" in call("verify", "flight.mcap")
    if stranger.second_engine:
        second = call("verify", "flight.mcap", "--engine", "mujoco")
        metres, radians, joints = re.findall(r"deviates +(\S+) m, (\S+) rad, joints (\S+)", second)[
            0
        ]
        assert max(map(float, (metres, radians, joints))) < 1e-9
    call("report", "flight.mcap")
    call("export", "flight.mcap", "-o", "tables")
    assert (tmp_path / "flight.html").stat().st_size > 10_000
    assert any((tmp_path / "tables").glob("*odom*.csv"))
    assert len(caplog.messages) == len(set(caplog.messages)), "each cause is printed once"

    bag = read_bag(tmp_path / "flight.mcap")
    robot = RecordedRobot(bag, "")
    odom, joints_of = robot["odom"], robot["joint_states"]
    poses = np.hstack(
        [
            columns(odom, "pose.pose.position", "x y z"),
            columns(odom, "pose.pose.orientation", "x y z w"),
        ]
    )
    twists = np.hstack([columns(odom, f"twist.twist.{x}", "x y z") for x in ("linear", "angular")])
    _, urdf = next(iter(robot["robot_description"].messages()))
    _, first = next(iter(joints_of.messages()))
    q, qdot = (joints_of.field(x).reshape(len(poses), -1) for x in ("position", "velocity"))
    oracle = Momentum(urdf.data, list(first.name))
    published = robot["momentum"].field("data")
    for k in np.linspace(0, len(poses) - 1, 9).astype(int):
        expected = oracle.of(poses[k], twists[k], q[k], qdot[k])
        np.testing.assert_allclose(published[k][:6], expected, atol=1e-9)
        if name != "one_link":
            np.testing.assert_allclose(expected, 0.0, atol=1e-9)
    # Every frame of /tf has one parent, up to the world.
    parents = {}
    for topic in ("/tf", "/tf_static"):
        if topic in bag.topics:
            _, message = next(iter(bag[topic].messages()))
            for each in message.transforms:
                assert each.child_frame_id not in parents
                parents[each.child_frame_id] = each.header.frame_id
    for frame in parents:
        seen = [frame]
        while seen[-1] in parents:
            assert parents[seen[-1]] not in seen
            seen.append(parents[seen[-1]])
        assert seen[-1] == "world"


JOINTS = {
    "free_flyer": 6,
    "solar_booms": 6,
    "seven_joint_arm": 7,
    "station_arm": 7,
    "quadruped": 12,
    "dual_arm": 14,
}


def test_the_table_is_of_the_robots_that_there_are() -> None:
    assert set(ROBOTS) == set(JOINTS)
    rows = json.loads(TABLE.read_text("utf-8"))
    assert [row["robot"] for row in rows] == list(ROBOTS)
    for row in rows:
        assert row["met"] + sum(row["refused"].values()) == row["goals"] > 0
        assert sum(row["methods"].values()) == row["met"]
        # Whatever is planned is right.
        assert "missed" not in row["refused"]
        assert row["joints"] == JOINTS[row["robot"]]


@pytest.mark.parametrize("name", JOINTS)
def test_the_robots_are_read_as_another_library_reads_them(name: str) -> None:
    robot = load_robot(robot_file(name))
    model = pin.buildModelFromUrdf(str(robot_file(name)), pin.JointModelFreeFlyer())
    assert len(robot.movable_joints) == JOINTS[name] == model.nv - 6
    mass = sum(body.inertia.mass for body in robot.bodies)
    assert mass == pytest.approx(pin.computeTotalMass(model))
    for body in robot.bodies:
        assert np.linalg.eigvalsh(body.inertia.about_com).min() > 0
    for joint in robot.movable_joints:
        assert 0 < joint.limits.velocity < np.inf
        assert 0 < joint.limits.effort < np.inf


def test_tasks_are_the_same_every_time_and_of_all_kinds() -> None:
    robot = SpaceRobot.from_file(Path(robot_file("solar_booms")))
    first, again = list(tasks(robot, 9)), list(tasks(robot, 6))
    assert [task.kind for task in first] == ["attitude", "shape", "position"] * 3
    for one, two in zip(first, again, strict=False):
        np.testing.assert_array_equal(one.goal.quaternion, two.goal.quaternion)
        np.testing.assert_array_equal(one.state.q, two.state.q)
        turn = Rotation.from_quat(one.state.quaternion).inv() * Rotation.from_quat(
            one.goal.quaternion
        )
        assert turn.magnitude() == pytest.approx(one.size)


def test_positions_that_no_search_reaches_are_counted_apart() -> None:
    outcomes = [
        Outcome(0, "position", 0.1, "not found", beyond=0.02),
        Outcome(1, "position", 0.1, "not found", beyond=1e-5),
        Outcome(2, "attitude", 0.1, "not found"),
        Outcome(3, "attitude", 0.1, "met"),
    ]
    assert classes(outcomes) == {OUT_OF_REACH: 1, "not found": 2, "met": 1}
