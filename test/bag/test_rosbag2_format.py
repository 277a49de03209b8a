from __future__ import annotations

import struct
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml
import zstandard
from mcap.reader import make_reader
from mcap.records import Channel, Chunk, Message, MessageIndex, Schema
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory
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

from spacerobot_ros.bag import LATCHED, BagWriter, QosProfile, type_hash

Sample = tuple[str, str, Any]
AssertSame = Callable[[Any, Any], None]

STRING = "std_msgs/msg/String"


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


def test_mcap_ros2_decodes_every_type(
    bag: Path, samples: list[Sample], assert_same: AssertSame
) -> None:
    with bag.open("rb") as file:
        found = list(
            make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        )
    assert len(found) == 3 * len(samples)
    for n, (schema, channel, message, decoded) in enumerate(found):
        topic, type_name, expected = samples[n % len(samples)]
        assert schema is not None
        assert (channel.topic, schema.name) == (topic, type_name)
        assert message.log_time == 10**18 + n * 10_000_000
        assert message.publish_time == message.log_time - 1000
        assert message.sequence == 0
        assert_same(expected, decoded)


def test_the_summary_agrees_with_the_data(bag: Path, samples: list[Sample]) -> None:
    with bag.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        header, summary = reader.get_header(), reader.get_summary()
    assert header.profile == "ros2"
    assert summary is not None
    statistics = summary.statistics
    assert statistics is not None
    with bag.open("rb") as file:
        everything = list(StreamReader(file, validate_crcs=True).records)
    messages = [record for record in everything if isinstance(record, Message)]
    assert statistics.message_count == len(messages) == 3 * len(samples)
    assert statistics.channel_message_counts == Counter(m.channel_id for m in messages)
    assert statistics.message_start_time == messages[0].log_time
    assert statistics.message_end_time == messages[-1].log_time
    assert statistics.chunk_count == len(summary.chunk_indexes) > 3
    assert statistics.schema_count == len(summary.schemas)
    assert statistics.channel_count == len(summary.channels) == len(samples)
    # Each schema and channel stands in the data before the first message that needs it.
    known: set[tuple[str, int]] = set()
    for record in everything:
        if isinstance(record, Schema):
            assert record == summary.schemas[record.id]
            known.add(("schema", record.id))
        elif isinstance(record, Channel):
            assert record == summary.channels[record.id]
            assert ("schema", record.schema_id) in known
            known.add(("channel", record.id))
        elif isinstance(record, Message):
            assert ("channel", record.channel_id) in known


def test_the_indexes_point_at_the_messages(bag: Path, samples: list[Sample]) -> None:
    indexed = 0
    with bag.open("rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        for index in summary.chunk_indexes:
            record = _record_at(file, index.chunk_start_offset)
            assert isinstance(record, Chunk)
            assert record.message_start_time == index.message_start_time
            assert record.message_end_time == index.message_end_time
            inner = _chunk_data(record)
            end = index.chunk_start_offset + index.chunk_length + index.message_index_length
            for channel_id, offset in index.message_index_offsets.items():
                assert index.chunk_start_offset + index.chunk_length <= offset < end
                message_index = _record_at(file, offset)
                assert isinstance(message_index, MessageIndex)
                assert message_index.channel_id == channel_id
                for log_time_ns, start in message_index.records:
                    opcode, _, channel, _, time_ns = struct.unpack_from("<BQHIQ", inner, start)
                    assert (opcode, channel, time_ns) == (5, channel_id, log_time_ns)
                    indexed += 1
    assert indexed == 3 * len(samples)


def test_one_topic_and_one_span_of_time_are_found_by_the_index(bag: Path) -> None:
    with bag.open("rb") as file:
        found = list(make_reader(file).iter_messages("/odom", starting_at=10**18 + 1))
    assert [message.log_time - 10**18 for _, _, message in found] == [120_000_000, 240_000_000]


def test_the_checksum_of_the_summary(bag: Path) -> None:
    content = bag.read_bytes()
    start, _, checksum = struct.unpack("<QQI", content[-28:-8])
    assert checksum == zlib.crc32(content[start:-12])


def test_the_channel_metadata_are_those_of_rosbag2(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap") as writer:
        writer.add_topic("/robot_description", STRING, LATCHED)
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
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


def _record_at(file: Any, offset: int) -> Any:
    file.seek(offset)
    return next(StreamReader(file, skip_magic=True, emit_chunks=True).records)


def _chunk_data(chunk: Chunk) -> bytes:
    assert chunk.compression == "zstd"
    data = zstandard.decompress(chunk.data, chunk.uncompressed_size)
    assert zlib.crc32(data) == chunk.uncompressed_crc
    return data
