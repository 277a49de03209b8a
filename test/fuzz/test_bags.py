"""Damaged bags: read, salvaged, verified, gone on from and replayed, or refused with a sentence."""

from __future__ import annotations

import json
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from sensor_msgs.msg import JointState
from support.fuzzing import NUMBERS, TEXTS, VALUES, attempt, damaged, fuzz
from support.planners import planner_of

from spacerobot_ros.bag import Playback, read_bag
from spacerobot_ros.bag.salvage import last_state, salvage_bag
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.common.messages import goal_of, shape_of
from spacerobot_ros.parameters import declared
from spacerobot_ros.planning import Goal, RobotState, Tolerance
from spacerobot_ros.report import write_report
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation.config import PlantConfig

WHOLE = (share_directory() / "bags" / "sliding_masses.mcap").read_bytes()
_MESSAGES = 120


def rewritten(parameters: dict[str, str] | None = None, *, guarded: bool = False) -> bytes:
    """Return the first messages of a reference bag; unless guarded, no checksum is in it."""
    out = BytesIO()
    reader = make_reader(BytesIO(WHOLE))
    writer = Writer(
        out,
        compression=CompressionType.ZSTD if guarded else CompressionType.NONE,
        enable_crcs=guarded,
        enable_data_crcs=guarded,
    )
    writer.start("ros2")
    for attachment in reader.iter_attachments():
        writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
    for metadata in reader.iter_metadata():
        given = parameters if metadata.name == "parameters/plant" else None
        writer.add_metadata(metadata.name, {**metadata.metadata, **(given or {})})
    channels: dict[int, int] = {}
    for count, (schema, channel, message) in enumerate(reader.iter_messages()):
        if count == _MESSAGES:
            break
        assert schema is not None
        if channel.id not in channels:
            number = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, number, channel.metadata
            )
        writer.add_message(
            channels[channel.id], message.log_time, message.data, message.publish_time
        )
    writer.finish()
    return out.getvalue()


@lru_cache
def unguarded() -> bytes:
    return rewritten()


@lru_cache
def guarded() -> bytes:
    return rewritten(guarded=True)


def read_all(path: Path) -> None:
    """Read everything that a bag says it holds."""
    bag = read_bag(path)
    for topic in bag.topics:
        bag.qos(topic)
        series = bag[topic]
        assert len(series.time) == len(list(series.messages()))
    _ = (bag.metadata, bag.attachments, bag.start_time, bag.end_time)


def replay_all(path: Path) -> None:
    playback = Playback(read_bag(path), rate=1e9)
    playback.run(0)
    while not playback.ended:
        assert playback.step(0) is not None


def go_on(path: Path) -> None:
    state = last_state(path)
    for numbers in (state.position, state.quaternion, state.joints, state.rates, state.momenta):
        assert np.all(np.isfinite(numbers))


def exercise(kind: str, path: Path) -> None:
    """Do to a bag all that the package does with bags."""
    attempt(kind, read_all, path)
    attempt(kind, verify_bag, path)
    attempt(kind, go_on, path)
    attempt(kind, replay_all, path)
    target = path.with_name("salvaged.mcap")
    target.unlink(missing_ok=True)
    if attempt(kind, salvage_bag, path, target) is not None:
        attempt(kind, read_all, target)


@fuzz("damaged bag", st.deferred(lambda: damaged(guarded())), fast=12, long=250)
def test_a_damaged_bag(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "b.mcap"
    path.write_bytes(content)
    exercise("damaged bag", path)


@fuzz("damaged bag, no checksum", st.deferred(lambda: damaged(unguarded())), fast=12, long=400)
def test_a_damaged_bag_without_checksums(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "b.mcap"
    path.write_bytes(content)
    exercise("damaged bag, no checksum", path)


@fuzz(
    "bag's parameters",
    st.dictionaries(
        st.sampled_from([spec.name for spec in declared(PlantConfig)]),
        st.one_of(
            VALUES.map(json.dumps), st.lists(NUMBERS, min_size=3, max_size=4).map(json.dumps)
        ),
        min_size=1,
        max_size=2,
    ),
    fast=10,
    long=200,
)
def test_a_bag_with_other_parameters_of_its_plant(tmp_path: Path, given: dict[str, Any]) -> None:
    path = tmp_path / "b.mcap"
    path.write_bytes(rewritten(given))
    attempt("bag's parameters", verify_bag, path)


@fuzz("report", st.deferred(lambda: damaged(unguarded())), fast=1, long=30)
def test_a_report_of_a_damaged_bag(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "b.mcap"
    path.write_bytes(content)
    attempt("report", write_report, path, tmp_path / "b.html")


ROBOTS = {
    "lie_bracket": "sliding_masses",
    "square_path": "three_joint_arm",
    "area_loop": "planar_chain",
}
VECTORS = st.lists(NUMBERS, min_size=3, max_size=3)
NEAR = st.lists(st.floats(-0.2, 0.2), min_size=3, max_size=3)
QUATERNIONS = st.lists(NUMBERS, min_size=4, max_size=4)


@lru_cache
def robot(name: str) -> SpaceRobot:
    return SpaceRobot.from_file(robot_file(name))


def assert_sound(goal: Goal | None) -> None:
    if goal is not None:
        assert np.all(np.isfinite(goal.position))
        assert abs(np.linalg.norm(goal.quaternion) - 1.0) < 1e-9
        assert goal.joint_positions is None or np.all(np.isfinite(goal.joint_positions))


@fuzz("goal message", VECTORS, QUATERNIONS, TEXTS, fast=30, long=800)
def test_a_goal_pose_message(position: list[float], orientation: list[float], frame: str) -> None:
    pose = Pose(
        position=Point(**dict(zip("xyz", position, strict=True))),
        orientation=Quaternion(**dict(zip("xyzw", orientation, strict=True))),
    )
    message = PoseStamped(pose=pose)
    message.header.frame_id = frame
    assert_sound(attempt("goal message", goal_of, message, "world"))


@fuzz("goal shape", st.lists(TEXTS, max_size=4), st.lists(NUMBERS, max_size=4), fast=30, long=800)
def test_a_goal_shape_message(names: list[str], positions: list[float]) -> None:
    joints = robot("sliding_masses").joint_names
    message = JointState(name=[*joints, *names], position=positions)
    shape = attempt("goal shape", shape_of, message, joints)
    assert shape is None or (shape.shape == (3,) and np.all(np.isfinite(shape)))


@fuzz("goal of a program", VALUES, VALUES, VALUES, fast=30, long=800)
def test_a_goal_of_anything(position: object, quaternion: object, shape: object) -> None:
    assert_sound(attempt("goal of a program", Goal.checked, position, quaternion, shape))


@fuzz("goal of a program", VECTORS, st.lists(NUMBERS, max_size=5), fast=30, long=400)
def test_a_goal_of_a_rotation_vector(position: list[float], rotvec: list[float]) -> None:
    assert_sound(attempt("goal of a program", Goal.from_rotvec, position, rotvec))


@pytest.mark.parametrize("method", ROBOTS)
@fuzz(
    "planned goal",
    st.one_of(NEAR, NEAR, VECTORS, st.just([0.0, 0.0, 0.0])),
    st.one_of(
        st.tuples(NEAR, st.just(1.0)).map(lambda parts: [*parts[0], parts[1]]),
        st.floats(-1.0, 1.0).map(lambda z: [0.0, 0.0, z, 1.0]),
        QUATERNIONS,
    ),
    st.none() | st.lists(st.floats(-0.4, 0.4), min_size=2, max_size=3) | VECTORS,
    st.lists(st.floats(-0.3, 0.3), min_size=3, max_size=3),
    fast=6,
    long=100,
)
def test_a_plan_for_a_goal(
    method: str,
    position: list[float],
    quaternion: list[float],
    shape: list[float] | None,
    start: list[float],
) -> None:
    goal = attempt("planned goal", Goal.checked, position, quaternion, shape)
    if goal is None:
        return
    model = robot(ROBOTS[method])
    planner = planner_of(method, model, 0.05, Tolerance(1e-3, 1e-3), 0.01)
    q = np.clip(start[: model.n], model.lower, model.upper)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
    schedule = attempt("planned goal", planner.plan, state, goal)
    if schedule is not None:
        for numbers in (schedule.positions, schedule.path.position, schedule.path.quaternion):
            assert np.all(np.isfinite(numbers))
        assert np.all(schedule.positions >= model.lower - 1e-9)
        assert np.all(schedule.positions <= model.upper + 1e-9)
