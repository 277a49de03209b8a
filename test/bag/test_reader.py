"""Bags are read: what they hold, what others wrote, and files that are no whole bag."""

from __future__ import annotations

import math
import random
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String, UInt8, UInt8MultiArray
from support.hostile.records import string
from support.made_bags import STRING, joint_states, made_bag, odometry
from support.raw_messages import Content
from support.sentences import assert_one_sentence
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from spacerobot_ros.bag import BagWriter, RecordedRobot, RecorderConfig, RecordingError, read_bag
from spacerobot_ros.bag.mcap_reading import BagFile, blocks_in_time_order
from spacerobot_ros.flight.reading import FlightBag

Sample = tuple[str, str, Any]
AssertSame = Callable[[Any, Any], None]

N = 500


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two topics from 5 s on, messages 1 ms apart and stamped half a millisecond before."""
    path = tmp_path_factory.mktemp("bags") / "flight.mcap"
    with made_bag(path, chunk_size=20_000) as (writer, say):
        writer.add_topic("/silent", STRING)
        for k in range(N):
            time = 5.0 + 1e-3 * k
            odom = odometry(time - 5e-4, math.sin(0.01 * k), *range(6))
            odom.child_frame_id, odom.pose.covariance = "base_link", np.arange(36.0) + k
            names = ["slider_1", "slider_2"]
            joints = joint_states(time - 5e-4, names, [0.1 * k, -0.2 * k], [1.0, 2.0])
            joints.effort = [0.0, float(k)]
            say("/odom", odom, time)
            say("/joint_states", joints, time)
        writer.add_metadata("parameters", {"plant.seed": "7"})
        writer.add_attachment("robot.urdf", b"<robot/>", "application/xml", 1)
    return path


def test_what_a_bag_holds(path: Path) -> None:
    bag = read_bag(path)
    assert bag.topics == {
        "/silent": STRING,
        "/odom": "nav_msgs/msg/Odometry",
        "/joint_states": "sensor_msgs/msg/JointState",
    }
    assert bag.message_count() == 2 * N
    assert bag.message_count("/odom") == N
    assert bag.message_count("/silent") == 0
    assert bag.start_time == 5.0
    assert bag.end_time == pytest.approx(5.0 + 1e-3 * (N - 1), abs=1e-12)
    assert bag.metadata["parameters"] == {"plant.seed": "7"}
    assert "message_count: 1000" in bag.metadata["rosbag2"]["serialized_metadata"]
    assert bag.attachments == {"robot.urdf": b"<robot/>"}


def test_times(path: Path) -> None:
    bag = read_bag(path)
    expected = 5.0 + 1e-3 * np.arange(N)
    assert bag["/odom"].time == pytest.approx(expected, abs=1e-12)
    assert bag["/odom"].time.dtype == np.float64
    assert bag["/odom"].time_ns.tolist() == [5 * 10**9 + k * 10**6 for k in range(N)]
    assert bag["/odom"].stamp == pytest.approx(expected - 5e-4, abs=1e-12)
    assert len(bag["/odom"]) == N


def test_a_topic_without_headers_is_stamped_by_its_log_time(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.write(writer.add_topic("/a", STRING), string("a"), 1_500_000_000, 0)
    assert read_bag(tmp_path / "a.mcap")["/a"].stamp.tolist() == [1.5]


def test_fields_of_every_message(path: Path) -> None:
    odom, joints = (read_bag(path)[topic] for topic in ("/odom", "/joint_states"))
    x = odom.field("pose.pose.position.x")
    assert x.dtype == np.float64
    assert x.tolist() == [math.sin(0.01 * k) for k in range(N)]
    assert [p.x for p in odom.field("pose.pose.position")] == x.tolist()
    assert np.array_equal(odom.field("pose.covariance"), np.arange(36.0) + np.arange(N)[:, None])
    assert np.array_equal(joints.field("position"), [[0.1 * k, -0.2 * k] for k in range(N)])
    assert odom.field("child_frame_id") == ["base_link"] * N
    assert joints.field("name") == [["slider_1", "slider_2"]] * N
    seconds = odom.field("header.stamp.sec")
    assert (seconds.dtype, (seconds * 10**9)[-1]) == (np.int64, 5 * 10**9), "without overflow"


def test_a_list_of_messages_is_looked_into(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for count in (2, 0, 3):
            points = [JointTrajectoryPoint(positions=[1.0 * k, 2.0]) for k in range(count)]
            say("/a", JointTrajectory(points=points), count)
    series = read_bag(tmp_path / "a.mcap")["/a"]
    found = [[list(point) for point in points] for points in series.field("points.positions")]
    assert found == [[], [[0.0, 2.0], [1.0, 2.0]], [[0.0, 2.0], [1.0, 2.0], [2.0, 2.0]]]
    assert series.field("points.time_from_start.sec") == [[], [0, 0], [0, 0, 0]]


def test_lists_that_differ_in_length(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for k in range(4):
            say("/a", JointState(position=[0.5] * k, header=Header(frame_id="f" * k)), k)
    series = read_bag(tmp_path / "a.mcap")["/a"]
    assert [list(p) for p in series.field("position")] == [[0.5] * k for k in range(4)]
    assert series.field("velocity").shape == (4, 0)
    assert series.field("header.frame_id") == ["", "f", "ff", "fff"]


def test_a_topic_without_messages(path: Path, tmp_path: Path) -> None:
    assert read_bag(path)["/silent"].field("data") == []
    assert list(read_bag(path)["/silent"].messages()) == []
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/odom", "nav_msgs/msg/Odometry")
    bag = read_bag(tmp_path / "a.mcap")
    assert bag["/odom"].field("pose.pose.position.x").shape == (0,)
    assert bag["/odom"].field("pose.covariance").shape == (0, 0)
    assert bag["/odom"].time.shape == bag["/odom"].stamp.shape == (0,)
    assert math.isnan(bag.start_time)
    assert math.isnan(bag.end_time)


def test_every_type(tmp_path: Path, samples: list[Sample], assert_same: AssertSame) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        for topic, type_name, message in samples:
            writer.write(writer.add_topic(topic, type_name), serialize_message(message), 1, 1)
    bag = read_bag(tmp_path / "a.mcap")
    for topic, _, message in samples:
        ((time_ns, decoded),) = bag[topic].messages()
        assert time_ns == 1
        assert_same(message, decoded)


def test_meaningless_bytes_at_the_end_do_no_harm(tmp_path: Path) -> None:
    data = serialize_message(JointState(name=["a", "b"], position=[1.0, 2.0]))
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", "sensor_msgs/msg/JointState")
        writer.write(channel, data + b"\xff" * 8, 1, 1)
        writer.write(channel, data, 2, 2)
    read = list(read_bag(tmp_path / "a.mcap")["/a"].messages())
    assert len(read) == 2
    for _, decoded in read:
        assert decoded.position.tolist() == [1.0, 2.0]
        assert decoded.effort.tolist() == []


def test_a_table_has_a_row_for_every_message_and_nan_where_numbers_are_missing(
    tmp_path: Path,
) -> None:
    shapes = [[1.0, 2.0], [3.0], [], [4.0, 5.0], [6.0, 7.0, 8.0]]
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for k, position in enumerate(shapes):
            say("/joint_states", joint_states(k, [], position, [-x for x in position]), k)
        for k in range(3):
            say("/odom", odometry(k, 0.5 * k, 0, -1.0 * k, 0, 0, 0, 1), k)
    bag = read_bag(tmp_path / "a.mcap")
    nan = math.nan
    expected = [[1, 2, -1, -2], [nan] * 4, [nan] * 4, [4, 5, -4, -5], [nan] * 4]
    joints = bag["/joint_states"]
    np.testing.assert_array_equal(joints.table(["position", "velocity"], 4), expected)
    assert joints.table(["position"], 0).shape == joints.table([], 0).shape == (5, 0)
    fields = ["pose.pose.position.x", "pose.pose.position.z"]
    np.testing.assert_array_equal(bag["/odom"].table(fields), [[0, 0], [0.5, -1], [1, -2]])


def test_the_topics_of_one_robot_are_found_by_their_names(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (writer, say):
        say("/joint_states", JointState(name=["c"]), 0)
        say("/craft/joint_states", JointState(name=["a", "b"]), 0)
        writer.add_topic("/craft/odom", "nav_msgs/msg/Odometry")
        say("/odom", String(data="another thing"), 0)
        say("/craft/robot_description", String(data="<robot/>"), 0)
    bag = read_bag(tmp_path / "a.mcap")
    craft = RecordedRobot(bag, "/craft")
    assert craft.joint_names == ["a", "b"]
    assert RecordedRobot(bag).joint_names == ["c"]
    assert craft.urdf == b"<robot/>"
    assert RecordedRobot(bag).urdf is None
    assert craft.get("odom") is None, "it has no message"
    assert RecordedRobot(bag).get("odom") is None, "it is of another type"
    with pytest.raises(RecordingError, match="no messages on /craft/odom"):
        craft["odom"]


def test_the_truth_is_what_was_measured_until_it_is_published(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for topic, values in {
            "/joint_states": {0: 0.1, 1: 1.1, 2: 2.1, 3: 3.1},
            "/joint_states_true": {2: 2.0, 3: 3.0},
            "/perfect/joint_states": {0: 5.0},
            "/alone/joint_states_true": {0: 6.0},
        }.items():
            for second, value in values.items():
                say(topic, joint_states(second, ["c"], [value], [-value]), second)
    bag = read_bag(tmp_path / "a.mcap")

    def truth(namespace: str) -> list[list[float]]:
        flight = FlightBag(bag, namespace)
        q, qdot = (flight.series()[name] for name in ("q", "qdot"))
        return np.column_stack([q.time, q.values, qdot.values]).tolist()

    assert truth("") == [[0, 0.1, -0.1], [1, 1.1, -1.1], [2, 2.0, -2.0], [3, 3.0, -3.0]]
    assert truth("/perfect") == [[0, 5.0, -5.0]]
    assert truth("/alone") == [[0, 6.0, -6.0]]
    with pytest.raises(RecordingError, match="no messages on /nobody/joint_states"):
        RecordedRobot(bag, "/nobody")["joint_states"]


# -- bags that other programs wrote, and files that are no whole bag ---------------------------


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "good.mcap"
    with BagWriter(path, chunk_size=2000) as writer:
        writer.add_topic("/silent", STRING)
        odom = writer.add_topic("/odom", "nav_msgs/msg/Odometry")
        for n in range(100):
            writer.write(odom, b"\0\1\0\0" + n.to_bytes(800, "little"), n, n)
    return path


def written(
    path: Path, times: list[int], topics: Sequence[str] = ("/a", "/b"), **options: Any
) -> Path:
    """Write messages on channels in turn, with publish times of their own, by the MCAP library."""
    with path.open("wb") as file:
        writer = Writer(file, **{"chunk_size": 300, **options})
        writer.start("ros2")
        schema = writer.register_schema(STRING, "ros2msg", b"string data")
        channels = [writer.register_channel(topic, "cdr", schema) for topic in topics]
        for n, time in enumerate(times):
            writer.add_message(channels[n % len(channels)], time, string(f"{n:03d}"), 1000 + n)
        writer.finish()
    return path


@pytest.mark.parametrize(
    "options",
    [
        {"compression": CompressionType.ZSTD},
        {"compression": CompressionType.LZ4},
        {"compression": CompressionType.NONE, "enable_crcs": False},
        {"use_chunking": False},
        {"index_types": IndexType.NONE},
        {"index_types": IndexType.CHUNK},
    ],
)
def test_bags_of_the_mcap_library(tmp_path: Path, options: dict[str, Any]) -> None:
    """Two channels are of one topic, as of two publishers."""
    times = [(n * 7) % 60 for n in range(60)]
    path = written(tmp_path / "a.mcap", times, topics=("/a", "/a", "/b"), **options)
    bag, order = read_bag(path), sorted(range(60), key=times.__getitem__)
    raw = bag.raw_messages(["/a", "/b"])
    assert [(t, topic) for topic, t, _ in raw] == [
        (times[n], "/b" if n % 3 == 2 else "/a") for n in order
    ]
    assert bag.message_count() == 60
    for topic in ("/a", "/b"):
        expected = [n for n in order if (n % 3 == 2) == (topic == "/b")]
        assert bag.message_count(topic) == len(expected)
        assert bag[topic].time_ns.tolist() == [times[n] for n in expected]
        assert bag[topic].field("data") == [f"{n:03d}" for n in expected]


def test_a_folder_with_one_bag(good: Path, tmp_path: Path) -> None:
    (tmp_path / "rosbag2").mkdir()
    with pytest.raises(RecordingError, match="rosbag2 contains no bag: name an MCAP file"):
        read_bag(tmp_path / "rosbag2")
    (tmp_path / "rosbag2" / "rosbag2_0.mcap").write_bytes(good.read_bytes())
    (tmp_path / "rosbag2" / "metadata.yaml").touch()
    assert read_bag(tmp_path / "rosbag2").message_count() == 100
    (tmp_path / "rosbag2" / "rosbag2_1.mcap").touch()
    with pytest.raises(RecordingError, match="contains 2 MCAP files: name one of them"):
        read_bag(tmp_path / "rosbag2")


def without_summary() -> bytes:
    """Return a bag of the MCAP library that has as little as it may have."""
    out = BytesIO()
    options = ("repeat_channels", "repeat_schemas", "use_statistics", "use_summary_offsets")
    without: dict[str, Any] = dict.fromkeys(options, False)
    writer = Writer(out, index_types=IndexType.NONE, **without)
    writer.start("ros2")
    writer.finish()
    return out.getvalue()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "There is no bag at"),
        (b"", "is empty"),
        (b"x", "is not an MCAP file"),
        (b"\x89MCAP1\r\n" * 3, "is not an MCAP file"),
        (without_summary(), "has no summary"),
        *((kept, "was cut short") for kept in (1, 8, 9, 50, 0.1, 0.5, 0.99, -1)),
    ],
)
def test_files_that_are_no_whole_bag(
    good: Path, tmp_path: Path, content: bytes | float | None, words: str
) -> None:
    """A number is how much of a good bag is left, in bytes or as a share."""
    path = tmp_path / "a.mcap"
    if isinstance(content, int | float):
        whole = good.read_bytes()
        content = whole[: int(content * len(whole)) if 0 < content < 1 else int(content)]
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecordingError) as caught:
        read_bag(path)
    assert_one_sentence(str(caught.value), words, str(path))


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_a_chunk_that_is_damaged(tmp_path: Path, compression: str) -> None:
    path = tmp_path / "a.mcap"
    with BagWriter(path, RecorderConfig(compression=compression)) as writer:
        channel = writer.add_topic("/a", STRING)
        for n in range(100):
            writer.write(channel, string("x" * 100), n, n)
    content = bytearray(path.read_bytes())
    index = Content(path).summary.chunk_indexes[0]
    middle = index.chunk_start_offset + index.chunk_length // 2
    for position in range(middle, middle + 8):
        content[position] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="is damaged"):
        read_bag(path)["/a"]
    with pytest.raises(RecordingError, match="is damaged"):
        list(read_bag(path).raw_messages(["/a"]))


def test_a_message_that_is_damaged(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        for data in (b"", b"\0\1\0\0", b"\0\1\0\0\xff\xff\xff\xff", string("good")):
            writer.write(channel, data, 1, 1)
    series = read_bag(tmp_path / "a.mcap")["/a"]
    with pytest.raises(RecordingError, match=r"A message on /a is not a std_msgs/msg/String"):
        series.field("data")
    with pytest.raises(RecordingError, match=r"A message on /a is not a std_msgs/msg/String"):
        next(series.messages())


@pytest.mark.parametrize(
    ("field", "words"),
    [
        ("pose.pose.positon.x", "no field 'pose.pose.positon.x': .*Pose has position, orientation"),
        ("", "no field ''"),
        ("child_frame_id.x", "no field 'child_frame_id.x': it goes too far"),
    ],
)
def test_a_field_that_is_not_there(good: Path, field: str, words: str) -> None:
    with pytest.raises(RecordingError, match=words):
        read_bag(good)["/odom"].field(field)


def test_a_topic_that_is_not_there(good: Path) -> None:
    bag = read_bag(good)
    for ask in (bag.__getitem__, bag.qos, bag.table, bag.message_count):
        with pytest.raises(RecordingError, match="has no topic /odm: it has /silent, /odom"):
            ask("/odm")


# -- equal times, ends of windows -------------------------------------------------------------


@pytest.mark.parametrize("chunked", [True, False])
@pytest.mark.parametrize("spread", [2, 5, 40])
def test_messages_come_by_time_and_those_of_one_time_as_they_were_written(
    tmp_path: Path, chunked: bool, spread: int
) -> None:
    """Against a stable sort; many of the times are equal, within chunks and across them."""
    chance = random.Random(spread)
    for turn in range(12):
        times = [chance.randrange(spread) for _ in range(40)]
        size = chance.choice([60, 150, 400])
        path = written(tmp_path / f"{turn}.mcap", times, use_chunking=chunked, chunk_size=size)
        order = sorted(range(len(times)), key=times.__getitem__)
        found = list(read_bag(path).raw_messages(["/a", "/b"]))
        assert [data[8:-1] for *_, data in found] == [b"%03d" % n for n in order]
        assert [log for _, log, _ in found] == [times[n] for n in order]
        assert [topic for topic, _, _ in found] == ["/b" if n % 2 else "/a" for n in order]
        # A window holds both of its ends, and one topic is every second message.
        start, end = sorted(chance.sample(range(2 + spread), 2))
        part = read_bag(path).raw_messages(["/b"], start, end)
        wanted = [n for n in order if start <= times[n] <= end and n % 2]
        assert [data[8:-1] for *_, data in part] == [b"%03d" % n for n in wanted]


@pytest.mark.parametrize("chunked", [True, False])
def test_topics_that_are_read_together_are_the_same(tmp_path: Path, chunked: bool) -> None:
    times = [random.Random(1).randrange(30) for _ in range(60)]
    bag = read_bag(written(tmp_path / "bag.mcap", times, use_chunking=chunked, chunk_size=150))
    # One that is not there is left out; leading slashes do not count.
    bag.load(["a", "/b", "/c"])
    for topic, first in (("/a", 0), ("/b", 1)):
        order = sorted(range(first, 60, 2), key=times.__getitem__)
        assert [message.data for _, message in bag[topic].messages()] == [f"{n:03d}" for n in order]
        np.testing.assert_array_equal(bag[topic].time_ns, [times[n] for n in order])
    with pytest.raises(RecordingError, match="no topic /c"):
        bag["/c"]


def test_messages_in_order_are_read_chunk_by_chunk(tmp_path: Path) -> None:
    """Chunks that share one time are no reason to hold all of them in memory."""
    file = BagFile(written(tmp_path / "a.mcap", [n // 3 for n in range(300)], chunk_size=200))
    chunks = file.summary.chunk_indexes
    assert len(chunks) > 30
    assert len(list(blocks_in_time_order([file], ["/a", "/b"]))) == len(chunks)


def test_of_many_topics_some_are_named(tmp_path: Path) -> None:
    for count, more in ((3, ""), (400, " more")):
        with BagWriter(tmp_path / f"{count}.mcap") as writer:
            for n in range(count):
                writer.add_topic(f"/topic_{n:03d}", STRING)
        with pytest.raises(RecordingError, match="has no topic /none") as refusal:
            read_bag(tmp_path / f"{count}.mcap")["/none"]
        sentence = str(refusal.value)
        named = sentence.count("/topic_")
        assert sentence.endswith(f" and {count - named} more." if more else "/topic_002.")
        assert named < 100
        assert len(sentence) < 1000


def test_bytes_are_not_signed(tmp_path: Path) -> None:
    with made_bag(tmp_path / "a.mcap") as (_, say):
        for n in (0, 127, 128, 255):
            say("/one", UInt8(data=n), 0.0)
            say("/many", UInt8MultiArray(data=[n, 255 - n]), 0.0)
    bag = read_bag(tmp_path / "a.mcap")
    np.testing.assert_array_equal(bag["/one"].field("data"), [0, 127, 128, 255])
    many = bag["/many"].field("data")
    np.testing.assert_array_equal(many, [[0, 255], [127, 128], [128, 127], [255, 0]])
