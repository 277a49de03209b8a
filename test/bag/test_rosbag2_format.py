from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
from mcap.reader import make_reader
from rclpy.serialization import serialize_message
from rosbags.highlevel import AnyReader
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from support.hostile.records import string
from support.made_bags import STRING
from support.raw_messages import Content

from spacerobot_ros.bag import LATCHED, BagWriter, QosProfile, type_hash

Sample = tuple[str, str, Any]
AssertSame = Callable[[Any, Any], None]


@pytest.fixture
def bag(tmp_path: Path, samples: list[Sample]) -> Path:
    """Three of every message, 10 ms apart, published 1 us before they were recorded."""
    path = tmp_path / "all_types.mcap"
    with BagWriter(path, chunk_size=4000) as writer:
        channels = [writer.add_topic(topic, type_name) for topic, type_name, _ in samples]
        for k in range(3):
            for n, (channel, (_, _, message)) in enumerate(zip(channels, samples, strict=True)):
                time_ns = 10**18 + (k * len(samples) + n) * 10_000_000
                writer.write(channel, serialize_message(message), time_ns, time_ns - 1000)
    return path


def test_rosbags_decodes_every_type(
    bag: Path, samples: list[Sample], assert_same: AssertSame
) -> None:
    with AnyReader([bag]) as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        assert types == {topic: type_name for topic, type_name, _ in samples}
        found = [
            (connection.topic, time_ns, reader.deserialize(data, connection.msgtype))
            for connection, time_ns, data in reader.messages()
        ]
        assert reader.message_count == 3 * len(samples)
        assert reader.start_time == 10**18
        assert reader.end_time == 10**18 + (3 * len(samples) - 1) * 10_000_000 + 1
    for n, (topic, time_ns, message) in enumerate(found):
        expected_topic, _, expected = samples[n % len(samples)]
        assert (topic, time_ns) == (expected_topic, 10**18 + n * 10_000_000)
        assert_same(expected, message)


def test_the_channel_metadata_are_those_of_rosbag2(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/robot_description", STRING, LATCHED)
    summary = Content(tmp_path / "a.mcap").summary
    (channel,) = summary.channels.values()
    (schema,) = summary.schemas.values()
    assert (schema.name, schema.encoding, channel.message_encoding) == (STRING, "ros2msg", "cdr")
    assert channel.metadata == {
        # rosbag2 writes the same to the byte, being given the same QoS.
        "offered_qos_profiles": (
            "- history: keep_last\n"
            "  depth: 1\n"
            "  reliability: reliable\n"
            "  durability: transient_local\n"
            "  deadline:\n"
            "    sec: 9223372036\n"
            "    nsec: 854775807\n"
            "  lifespan:\n"
            "    sec: 9223372036\n"
            "    nsec: 854775807\n"
            "  liveliness: automatic\n"
            "  liveliness_lease_duration:\n"
            "    sec: 9223372036\n"
            "    nsec: 854775807\n"
            "  avoid_ros_namespace_conventions: false"
        ),
        "topic_type_hash": (
            "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
        ),
    }


def test_rosbags_reads_the_quality_of_service(tmp_path: Path) -> None:
    qos = QosProfile(
        history="keep_all",
        depth=7,
        reliability="best_effort",
        durability="volatile",
        liveliness="manual_by_topic",
    )
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.write(writer.add_topic("/a", STRING, qos), string("a"), 1, 1)
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        extension: Any = reader.connections[0].ext
        assert extension.offered_qos_profiles == [
            Qos(
                QosHistory.KEEP_ALL,
                7,
                QosReliability.BEST_EFFORT,
                QosDurability.VOLATILE,
                QosTime(9223372036, 854775807),
                QosTime(9223372036, 854775807),
                QosLiveliness.MANUAL_BY_TOPIC,
                QosTime(9223372036, 854775807),
                False,
            )
        ]


def test_the_bag_metadata_are_those_of_rosbag2(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DISTRO", "jazzy")
    with BagWriter(tmp_path / "flight_0.mcap") as writer:
        channel = writer.add_topic("/a", STRING)
        writer.add_topic("/b", STRING)
        for time_ns in (300, 100, 250):
            writer.write(channel, string("a"), time_ns, time_ns)
    with (tmp_path / "flight_0.mcap").open("rb") as file:
        first, last = (m for m in make_reader(file).iter_metadata() if m.name == "rosbag2")
    begun = yaml.safe_load(first.metadata["serialized_metadata"])
    assert (begun["version"], begun["message_count"]) == (9, 0)
    assert begun["topics_with_message_count"] == []
    infinite = {"sec": 9223372036, "nsec": 854775807}
    qos = {
        "history": "keep_last",
        "depth": 10,
        "reliability": "reliable",
        "durability": "volatile",
        "deadline": infinite,
        "lifespan": infinite,
        "liveliness": "automatic",
        "liveliness_lease_duration": infinite,
        "avoid_ros_namespace_conventions": False,
    }
    content = {
        "duration": {"nanoseconds": 200},
        "starting_time": {"nanoseconds_since_epoch": 100},
        "message_count": 3,
    }
    # As in the metadata.yaml of a bag recorded by `ros2 bag record` of Jazzy.
    assert yaml.safe_load(last.metadata["serialized_metadata"]) == {
        "version": 9,
        "storage_identifier": "mcap",
        **content,
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": name,
                    "type": STRING,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": [qos],
                    "type_description_hash": type_hash(STRING),
                },
                "message_count": count,
            }
            for name, count in (("/a", 3), ("/b", 0))
        ],
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": ["flight_0.mcap"],
        "files": [{"path": "flight_0.mcap", **content}],
        "custom_data": None,
        "ros_distro": "jazzy",
    }


@pytest.mark.parametrize("name", ["a b: c.mcap", "12.5", "é\"'.mcap", "true", "-", "1e3.mcap"])
def test_any_file_name_survives_yaml(tmp_path: Path, name: str) -> None:
    with BagWriter(tmp_path / name):
        pass
    with (tmp_path / name).open("rb") as file:
        records = list(make_reader(file).iter_metadata())
    assert records
    for record in records:
        metadata = yaml.safe_load(record.metadata["serialized_metadata"])
        assert metadata["relative_file_paths"] == [name]
        assert metadata["files"][0]["path"] == name
