"""Robots of other people's kind, from their file to tables of their flight."""

from __future__ import annotations

import json
import os
import re
import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import pytest
from foreign_robots.run import ROBOTS, TABLE
from planning.drifting import angle_between, flown_by_pinocchio
from scipy.spatial.transform import Rotation
from support.command_line import CliRunner
from support.urdf_text import link, numbers

from spacerobot_ros.bag import RecordedRobot, read_bag
from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.planning import RobotState, plan
from spacerobot_ros.planning.core.clearance import Clearance
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
    "one_link": Stranger("one_link.urdf", said="has no joints and uses thrusters"),
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
    "impossible": Stranger("impossible.urdf", ("--nearest-inertia",), "link 'hull' is changed by "),
    "package": Stranger("probe_arm/urdf/arm.urdf.xacro"),
}


def call(*words: str) -> str:
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 0, f"{words}: {result.output}"
    return result.output


class Momentum:
    """Momentum about the centre of mass by Pinocchio, which reads the URDF by itself."""

    def __init__(self, urdf: str, names: list[str]) -> None:
        # Its parser knows no capsules.
        bare = re.sub(r"<(visual|collision)\b.*?</\1>", "", urdf, flags=re.DOTALL)
        root = ElementTree.fromstring(bare)
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
    "name", [each if each == "root_world" else pytest.param(each, marks=SLOW) for each in STRANGERS]
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
        (deviations,) = re.findall(r"deviates +(\S+) m, (\S+) rad, joints (\S+)", second)
        assert max(map(float, deviations)) < 1e-9
    call("report", "flight.mcap")
    call("export", "flight.mcap", "-o", "tables")
    assert (tmp_path / "flight.html").stat().st_size > 10_000
    assert any((tmp_path / "tables").glob("*odom*.csv"))
    assert len(caplog.messages) == len(set(caplog.messages)), "each cause is printed once"

    bag = read_bag(tmp_path / "flight.mcap")
    robot = RecordedRobot(bag, "")
    odom, joints_of = robot["odom"], robot["joint_states"]
    position = columns(odom, "pose.pose.position", "x y z")
    poses = np.hstack([position, columns(odom, "pose.pose.orientation", "x y z w")])
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


JOINTS = dict(zip(ROBOTS, (6, 6, 7, 7, 12, 14), strict=True))


def test_the_table_is_of_the_robots_that_there_are() -> None:
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


SEED = int(os.environ.get("SPACEROBOT_WRITTEN_SEED", "46"))

LONGEST_SEARCH = 30.0
"""Processor time of a plan, s; a busy machine takes longer than an idle one."""

TURN = np.array([0.2, -0.15, 0.25])


@dataclass(frozen=True)
class Limb:
    """A chain of boxes.

    Attributes
    ----------
    at, way
        (3,) where it begins in the base, m, and the direction of the links.
    axes
        Axes of its joints, as letters.
    length, width, mass
        Of each link: m, m and kg.
    """

    at: Sequence[float]
    way: Sequence[float]
    axes: str
    length: float
    width: float
    mass: float


def robot_urdf(
    size: Sequence[float], mass: float, limbs: Sequence[Limb], rate: float, reach: float
) -> str:
    """Return a robot whose joints turn by ``reach``, rad, either way, at a ``rate``, rad/s."""
    parts = [box_link("base_link", size, mass, np.zeros(3))]
    for number, limb in enumerate(limbs):
        parent, at, way = "base_link", np.asarray(limb.at), np.asarray(limb.way)
        for k, axis in enumerate(limb.axes):
            name = f"limb_{number}_{k}"
            # Neighbours nearly touch.
            box = limb.width + (0.96 * limb.length - limb.width) * np.abs(way)
            parts.append(box_link(name, box, limb.mass, limb.length / 2 * way))
            unit = " ".join("1" if letter == axis else "0" for letter in "xyz")
            parts.append(
                f'<joint name="{name}" type="revolute"><parent link="{parent}"/>'
                f'<child link="{name}"/><origin xyz="{numbers(at)}"/><axis xyz="{unit}"/>'
                f'<limit lower="{-reach}" upper="{reach}" velocity="{rate}" effort="1e6"/></joint>'
            )
            parent, at = name, limb.length * way
    return f'<robot name="written">{"".join(parts)}</robot>'


def box_link(name: str, size: Sequence[float] | Array, mass: float, center: Array) -> str:
    squares = np.square(size)
    moments = np.diag(mass / 12 * (squares.sum() - squares))
    solid = f'<geometry><box size="{numbers(size)}"/></geometry>'
    collision = f'<collision><origin xyz="{numbers(center)}"/>{solid}</collision>'
    return link(name, mass, moments, center).replace("</link>", f"{collision}</link>")


LEGS = [
    Limb((0.22 * x, 0.16 * y, 0.0), (0, 0, -1), "xyy", 0.2, 0.05, 0.8)
    for x in (-1, 1)
    for y in (-1, 1)
]
ARMS = [Limb((0.45, 0.3 * y, 0.0), (1, 0, 0), "xyzyxyx", 0.3, 0.1, 4.0) for y in (-1, 1)]
SNAKE = Limb((0.12, 0.0, 0.0), (1, 0, 0), "yzyzyzyzyz", 0.15, 0.08, 1.0)
HEAVY_ARM = Limb((0.1, 0.0, 0.0), (1, 0, 0), "yzy", 0.4, 0.08, 4.0)

WRITTEN = {
    "legs": robot_urdf((0.5, 0.2, 0.12), 8.0, LEGS, rate=1000.0, reach=1.2),
    "two_arms": robot_urdf((0.8, 0.8, 0.8), 150.0, ARMS, rate=1.0, reach=2.5),
    "snake": robot_urdf((0.2, 0.1, 0.1), 2.0, [SNAKE], rate=2.0, reach=1.3),
    "light_base": robot_urdf((0.1, 0.1, 0.1), 0.004, [HEAVY_ARM], rate=1.0, reach=2.0),
}


@pytest.mark.study
@pytest.mark.parametrize("kind", ["attitude", "position", "shape"])
@pytest.mark.parametrize("name", WRITTEN)
def test_a_robot_is_planned_for_in_time_and_ends_where_its_plan_says(
    name: str, kind: str, tmp_path: Path
) -> None:
    path = tmp_path / "written.urdf"
    path.write_text(WRITTEN[name], encoding="utf-8")
    robot = SpaceRobot.from_file(path)
    geometry = Clearance(robot.description, 0.02).geometry
    rng = np.random.default_rng([SEED, list(WRITTEN).index(name)])

    def clear_shape() -> Array:
        while True:
            q = rng.uniform(-0.8, 0.8, robot.n)
            if geometry.nearest_along(q[np.newaxis])[0] >= 0.02:
                return q

    start, final, turn = clear_shape(), clear_shape(), Rotation.from_rotvec(TURN)
    goal: dict[str, Any] = {"rotvec": TURN}
    if kind == "position":
        # The centre of mass rests, so that the base is there in some shape.
        there = robot.center_of_mass(start) - turn.apply(robot.center_of_mass(final))
        goal |= {"position": there, "base_position": 1}
    if kind == "shape":
        goal["joint_positions"] = final
    began = time.process_time()
    try:
        schedule = plan(robot, start=start, cache=0, **goal)
    except UnreachableError as refusal:
        print(f"  {name}, {kind}: {refusal}")
        return
    finally:
        cpu = time.process_time() - began
        print(f"  {name}, {kind}: {cpu:.1f} s of CPU time", flush=True)
        assert cpu < LONGEST_SEARCH
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), start)
    _, quaternion = flown_by_pinocchio(WRITTEN[name], schedule, state, longest_step=0.00125)
    missed = angle_between(quaternion, turn.as_quat())
    said = schedule.notes["predicted_attitude_error"]
    assert isinstance(said, float)
    print(
        f"  {schedule.duration:.4g} s, misses by {missed:.2e} rad and says {said:.2e}", flush=True
    )
    assert abs(missed - said) < 1e-8
