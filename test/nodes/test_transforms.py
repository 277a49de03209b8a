"""Frames: what bags hold on /tf against odom and Pinocchio, and goals in frames of the robot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio
import pytest
from geometry_msgs.msg import Point, Quaternion
from nav_msgs.msg import Odometry
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.made_bags import stamped
from support.planner_flight import Flight, goal_at, values_of
from support.ros_harness import Harness, nanoseconds

from spacerobot_ros.bag import Bag, RecordedRobot, read_bag, type_hash
from spacerobot_ros.bag.reader import columns
from spacerobot_ros.messages.builders import TRANSFORM_TYPE, TRANSFORMS, RobotTransforms
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import compose_poses, matrix_from_quaternion
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.nodes import PlantNode, RecorderNode
from spacerobot_ros.nodes.common.messages import KnownFrames, pose_array
from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.nodes.plant import publisher
from spacerobot_ros.resources import robot_file

TOLERANCE = 1e-12


def placed(transform: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation matrix and position of a geometry_msgs/Transform."""
    r, o = transform.translation, transform.rotation
    R = matrix_from_quaternion([o.x, o.y, o.z, o.w])
    return R, np.array([r.x, r.y, r.z])


def world_poses(
    messages: list[Any], world: str = "world"
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return rotation and position in the world of every frame, the root's parent first."""
    parents = {t.child_frame_id: t for message in messages for t in message.transforms}
    found: dict[str, tuple[np.ndarray, np.ndarray]] = {}

    def of(frame: str) -> tuple[np.ndarray, np.ndarray]:
        if frame == world:
            return np.eye(3), np.zeros(3)
        R, r = of(parents[frame].header.frame_id)
        step_R, step_r = placed(parents[frame].transform)
        return R @ step_R, r + R @ step_r

    for frame in parents:
        found[frame] = of(frame)
    return found


def record_states(
    harness: Harness, bag: Path, robot: str, recorded: Mapping[str, Any] = {}, **plant: Any
) -> Bag:
    """Record some states of a robot whose joints are where none of them is at zero."""
    n = len(load_robot(robot_file(robot)).joint_names)
    shape = [0.02 + 0.013 * i for i in range(n)]
    values = {
        "robot": robot,
        "actuation": "effort",
        "tick_rate": 50.0,
        "initial_position": [0.3, -0.2, 0.7],
        "initial_orientation": [0.1, -0.3, 0.2, 0.9],
        "initial_joint_positions": shape,
        "initial_joint_velocities": [0.01 + 0.003 * i for i in range(n)],
        "angular_momentum": [0.3, 0.1, -0.2],
        **plant,
    }
    node = harness.make(PlantNode, values, autostart=False)
    node.require_transition(node.trigger_configure)
    recorder = harness.make(RecorderNode, {"bag": str(bag), **recorded}, autostart=False)
    recorder.start()
    harness.spin_until(lambda: {"/odom", "/joint_states", "/robot_description"} <= recorder.topics)
    node.require_transition(node.trigger_activate)
    harness.spin_until(lambda: node.tick > 25)
    node.trigger_deactivate()
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    return read_bag(bag)


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["servicer", "sliding_masses"])
def test_a_bag_has_the_frames_of_odom_and_of_pinocchio(
    harness: Harness, tmp_path: Path, robot: str
) -> None:
    bag = record_states(harness, tmp_path / "bag.mcap", robot)
    assert bag.topics["/tf"] == "tf2_msgs/msg/TFMessage"
    recorded = RecordedRobot(bag)
    odom, joints = recorded["odom"], recorded["joint_states"]
    poses = odom.table(columns("odom", "pose.pose"))
    positions = np.asarray(joints.field("position"))
    static = [m for _, m in bag["/tf_static"].messages()] if "/tf_static" in bag.topics else []
    model = pinocchio.buildModelFromXML(
        robot_file(robot).read_text(), pinocchio.JointModelFreeFlyer()
    )
    data = model.createData()
    names = recorded.joint_names
    seen = 0
    for _, message in bag["/tf"].messages():
        stamps = {(t.header.stamp.sec, t.header.stamp.nanosec) for t in message.transforms}
        ((sec, nanosec),) = stamps
        (k,) = np.flatnonzero(odom.stamp_ns == sec * 10**9 + nanosec)
        (j,) = np.flatnonzero(joints.stamp_ns == sec * 10**9 + nanosec)
        q = pinocchio.neutral(model)
        q[:7] = poses[k]
        for name, value in zip(names, positions[j], strict=True):
            joint = model.joints[model.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                [value] if joint.nq == 1 else [np.cos(value), np.sin(value)]
            )
        pinocchio.framesForwardKinematics(model, data, q)
        found = world_poses([message, *static])
        links = {link.name for link in load_robot(robot_file(robot)).links}
        assert set(found) == links
        for link in links:
            oracle = data.oMf[model.getFrameId(link)]
            R, r = found[link]
            assert np.abs(r - oracle.translation).max() < TOLERANCE
            assert np.abs(R - oracle.rotation).max() < TOLERANCE
        base = next(t for t in message.transforms if t.header.frame_id == "world").transform
        r, o = base.translation, base.rotation
        assert [r.x, r.y, r.z, o.x, o.y, o.z, o.w] == poses[k].tolist()
        seen += 1
    assert seen >= 3
    # One every 0.1 s: every fifth state.
    gaps = np.diff([t for t, _ in bag["/tf"].messages()])
    assert set(gaps) == {100_000_000}


@pytest.mark.slow
def test_frames_have_the_prefix_that_they_are_given(harness: Harness, tmp_path: Path) -> None:
    bag = record_states(
        harness, tmp_path / "bag.mcap", "planar_chain", frame_prefix="one/", world_frame="orbit"
    )
    _, message = next(iter(bag["/tf"].messages()))
    for transform in message.transforms:
        assert transform.child_frame_id.startswith("one/")
        assert transform.header.frame_id == "orbit" or transform.header.frame_id.startswith("one/")
    _, odom = next(iter(bag["/odom"].messages()))
    assert (odom.header.frame_id, odom.child_frame_id) == ("orbit", "one/base_link")


def test_a_link_that_is_called_like_the_world_is_another_frame(
    harness: Harness, tmp_path: Path
) -> None:
    text = robot_file("planar_chain").read_text("utf-8").replace("base_link", "world")
    file = tmp_path / "chain.urdf"
    file.write_text(text, "utf-8")
    bag = record_states(harness, tmp_path / "bag.mcap", str(file))
    _, message = next(iter(bag["/tf"].messages()))
    frames = [(each.header.frame_id, each.child_frame_id) for each in message.transforms]
    assert frames[0] == ("world", "robot/world")
    assert all(child.startswith("robot/") for _, child in frames)
    _, odom = next(iter(bag["/odom"].messages()))
    assert (odom.header.frame_id, odom.child_frame_id) == frames[0]


@pytest.mark.slow
def test_a_recorder_writes_frames_as_often_as_it_is_to(harness: Harness, tmp_path: Path) -> None:
    every = {"tf_period": 0.2}
    bag = record_states(harness, tmp_path / "bag.mcap", "planar_chain", every, tf_period=0.0)
    assert set(np.diff([time for time, _ in bag["/tf"].messages()])) == {200_000_000}


def test_frames_need_no_order_between_topics(harness: Harness, tmp_path: Path) -> None:
    """Positions come late, two states at once, then early; one state has no pose."""
    robot, bag = robot_file("planar_chain"), tmp_path / "bag.mcap"
    names = [joint.name for joint in load_robot(robot).joints if joint.name]
    recorder = harness.make(RecorderNode, {"bag": str(bag), "tf_period": 0.0001}, autostart=False)
    recorder.start()
    source = harness.probe({"joint_states": JointState})
    description = source.create_publisher(String, "robot_description", LATCHED)
    odoms = source.create_publisher(Odometry, "odom", STREAM)
    joints = source.create_publisher(JointState, "joint_states", STREAM)
    for each in (description, odoms, joints):
        harness.matched(each)
    harness.spin_until(lambda: {"/odom", "/joint_states", "/robot_description"} <= recorder.topics)
    description.publish(String(data=robot.read_text("utf-8")))
    harness.settle(source)
    for sender, states in ((odoms, (0, 1)), (joints, (0, 1, 2, 3)), (odoms, (3,))):
        for k in states:
            odom = Odometry(child_frame_id="base_link")
            odom.pose.pose.position.x, odom.pose.pose.orientation.w = 0.1 * k, 1.0
            rates = [0.0] * len(names)
            shape = JointState(name=names, position=[0.1 * k] * len(names), velocity=rates)
            sender.publish(stamped(odom if sender is odoms else shape, 0.05 * k, "world"))
        harness.settle(source)
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    frames = [message.transforms[0] for _, message in read_bag(bag)["/tf"].messages()]
    found = [(each.header.stamp.nanosec, each.transform.translation.x) for each in frames]
    assert found == [(0, 0.0), (50_000_000, 0.1), (150_000_000, pytest.approx(0.3))]


class Frames:
    """A plant whose frames are heard as if the package of their message were installed."""

    def __init__(
        self, harness: Harness, monkeypatch: pytest.MonkeyPatch, robot: str, **given: Any
    ) -> None:
        # Bytes pass as they are, whatever the type of their topic is called.
        monkeypatch.setattr(publisher, "interface_class", lambda *_: Odometry)
        self.sent: list[bytes] = []
        probe = harness.probe({"odom": Odometry, "joint_states": JointState})
        probe.create_subscription(Odometry, TRANSFORMS, self.sent.append, 100, raw=True)
        values = {"robot": robot, "tick_rate": 50.0, "actuation": "effort", **given}
        node = harness.make(PlantNode, values, autostart=False)
        node.require_transition(node.trigger_configure)
        harness.connect()
        node.require_transition(node.trigger_activate)
        harness.spin_until(lambda: node.tick > 12, "some ticks")
        node.trigger_deactivate()
        harness.settle(probe)
        store = get_typestore(Stores.ROS2_JAZZY)
        self.messages: list[Any] = [store.deserialize_cdr(raw, TRANSFORM_TYPE) for raw in self.sent]
        self.states = {
            nanoseconds(odom.header.stamp): (odom.pose.pose, joints)
            for odom, joints in zip(
                probe.messages["odom"], probe.messages["joint_states"], strict=True
            )
        }


def test_a_plant_sends_frames_as_often_and_of_as_many_links_as_it_is_to(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent = Frames(harness, monkeypatch, "planar_chain", tf_period=0.06, tf_links=False).messages
    frames = [transform for message in sent for transform in message.transforms]
    assert [each.child_frame_id for each in frames] == ["base_link"] * len(sent)
    assert set(np.diff([nanoseconds(each.header.stamp) for each in frames])) == {60_000_000}


def test_transforms_have_the_measured_pose_and_shape_and_not_the_true_ones(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    noise = dict.fromkeys(("position_noise", "attitude_noise", "joint_noise"), 0.05)
    frames = Frames(
        harness,
        monkeypatch,
        "three_joint_arm",
        initial_position=[0.4, -0.2, 0.3],
        **{f"sensors.{name}": value for name, value in noise.items()},
    )
    kinematics = ForwardKinematics(load_robot(robot_file("three_joint_arm")))
    assert frames.messages
    for message in frames.messages:
        base, *links = message.transforms
        pose, joints = frames.states[nanoseconds(base.header.stamp)]
        R, r = placed(base.transform)
        o = pose.orientation
        assert r.tolist() == [pose.position.x, pose.position.y, pose.position.z]
        np.testing.assert_allclose(R, matrix_from_quaternion([o.x, o.y, o.z, o.w]), atol=TOLERANCE)
        assert np.linalg.norm(r - [0.4, -0.2, 0.3]) > 1e-3, "that is the true pose"
        children = (child for _, child in kinematics.moving)
        transforms = kinematics.transforms_at(np.array(joints.position))
        places = dict(zip(children, transforms, strict=True))
        for link in links:
            R, r = placed(link.transform)
            place = places[link.child_frame_id]
            np.testing.assert_allclose(r, place[:3], atol=TOLERANCE)
            np.testing.assert_allclose(R, matrix_from_quaternion(place[3:]), atol=TOLERANCE)


@pytest.mark.parametrize("links", [False, True])
def test_frames_of_many_states_are_those_of_each_state(links: bool) -> None:
    robot = load_robot(robot_file("servicer"))
    frames, rng = RobotTransforms(robot, "world", "r/", links=links), np.random.default_rng(4)
    times, poses = np.array([1, 10_000_000_007, 5]), rng.normal(size=(3, 7))
    q = rng.normal(size=(3, len(robot.joint_names)))
    each = [frames.message(*state) for state in zip(times.tolist(), poses, q, strict=True)]
    assert frames.messages(times, poses, q) == each
    assert len(set(each)) == 3


def test_chains_of_frames_end_in_the_world_or_nowhere() -> None:
    class Deaf:
        def create_subscription(self, *given: Any, **options: Any) -> None: ...

    frames = KnownFrames(Deaf())
    half = np.sqrt(0.5)
    up = np.array([0.0, 0.0, 1.0, 0.0, 0.0, half, half])
    own = {"a": ("world", up), "b": ("a", up), "x": ("y", up), "y": ("x", up)}
    assert frames.pose("world", "world", own) == pytest.approx([0, 0, 0, 0, 0, 0, 1])
    assert frames.pose("b", "world", own) == pytest.approx([0, 0, 2, 0, 0, 1, 0])
    assert frames.pose("x", "world", own) is None
    assert frames.pose("moon", "world", own) is None
    aside = compose_poses(up, np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    assert aside == pytest.approx([0, 1, 1, 0, 0, half, half])


@pytest.mark.parametrize(
    ("quaternion", "found"),
    [
        ([0.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]),
        ([0.0, 3.0, 0.0, 4.0], [0.0, 0.6, 0.0, 0.8]),
        ([0.0, 0.0, 0.5e-6, 0.0], None),
        ([0.0, math.inf, 0.0, 1.0], None),
    ],
)
def test_poses_of_messages_have_quaternions_of_norm_one(
    quaternion: list[float], found: list[float] | None
) -> None:
    x, y, z, w = quaternion
    pose = pose_array(Point(x=1.0, y=-2.0, z=3.0), Quaternion(x=x, y=y, z=z, w=w))
    assert pose == (None if found is None else pytest.approx([1.0, -2.0, 3.0, *found]))


def test_the_topic_has_the_frames_of_odom(harness: Harness) -> None:
    messages = pytest.importorskip("tf2_msgs.msg")
    assert type_hash(TRANSFORM_TYPE) == get_typestore(Stores.ROS2_JAZZY).hash_rihs01(TRANSFORM_TYPE)
    plant = harness.make(
        PlantNode, {"robot": "servicer", "tick_rate": 50.0, "initial_position": [1.0, 2.0, 3.0]}
    )
    probe = harness.probe(
        {"/tf": messages.TFMessage, "/tf_static": messages.TFMessage, "odom": Odometry},
        latched=("/tf_static",),
    )
    harness.spin_until(lambda: probe.count("/tf") >= 3 and probe.count("odom") >= 30)
    assert probe.count("/tf_static") == 1
    poses = {nanoseconds(m.header.stamp): m.pose.pose for m in probe.messages["odom"]}
    seen = 0
    for message in probe.messages["/tf"]:
        base = next(t for t in message.transforms if t.header.frame_id == "world")
        pose = poses.get(nanoseconds(base.header.stamp))
        if pose is None:
            continue  # Of before odom was met.
        t, o = base.transform.translation, base.transform.rotation
        assert [t.x, t.y, t.z] == [pose.position.x, pose.position.y, pose.position.z]
        assert [o.x, o.w] == [pose.orientation.x, pose.orientation.w]
        seen += 1
    assert seen >= 2
    assert plant.is_active


LINK = next(joint for joint in load_robot(robot_file("sliding_masses")).joints).child


@pytest.mark.parametrize("frame", ["/base_link", LINK])
def test_a_goal_in_a_frame_of_the_robot_is_one_in_the_world(harness: Harness, frame: str) -> None:
    away, turned = [0.4, -0.2, 0.3], [0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)]
    flight = Flight(harness, None, {"initial_position": away, "initial_orientation": turned})
    flight.start()
    flight.ticks(2)
    base = np.array([*away, *turned])
    links = ForwardKinematics(load_robot(robot_file("sliding_masses")))
    pose = base if frame != LINK else compose_poses(base, links.transforms_at(np.zeros(3))[0])
    # The base where it is now, as it looks from the frame, and 3 cm ahead of that.
    there = np.linalg.inv(homogeneous(pose)) @ homogeneous(base)
    there[:3, 3] += 0.03 * there[:3, 0]
    goal = goal_at((there[:3, 3], Rotation.from_matrix(there[:3, :3]).as_rotvec()), frame)
    values = values_of(flight.decide(goal))
    assert values["state"] != "refused", values
    position = [float(x) for x in values["goal"].split()[:3]]
    expected = homogeneous(pose) @ there
    assert position == pytest.approx(expected[:3, 3].tolist(), abs=1e-9)


def homogeneous(pose: Any) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = Rotation.from_quat(pose[3:]).as_matrix(), pose[:3]
    return matrix
