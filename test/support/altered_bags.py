"""Copies of bags in which messages are changed or left out, made with nothing of this package."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.writer import Writer
from rclpy.serialization import deserialize_message, serialize_message
from std_msgs.msg import String

Change = Callable[[Any], Any]
"""Takes a message and gives the one in its place, or None to leave it out."""


def message_class(type_name: str) -> Any:
    package, _, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), name)


def altered(
    bag: Path,
    out: Path,
    topic: str = "",
    number: int = 0,
    change: Change | None = None,
    parameters: dict[str, str] | None = None,
    urdf: tuple[bytes, bytes] = (b"", b""),
    injected: dict[int, str] | None = None,
    begin_ns: int = 0,
    end_ns: int = 2**63,
    node: str = "plant",
    log_time: Callable[[int], int] = lambda time_ns: time_ns,
    packed: Callable[[bytes], bytes] = bytes,
) -> Path:
    """Copy a bag with something changed.

    The message of that number on a topic, some of the parameters of a ``node``, or one text in the
    URDF that another takes the place of. ``injected`` adds messages on /fault_injection, by log
    time; messages are kept from ``begin_ns`` to before ``end_ns``. ``log_time`` gives messages
    other log times, ns. ``packed`` gives every message that is kept other bytes.
    """
    count = 0
    with bag.open("rb") as source, out.open("wb") as target:
        reader = make_reader(source)
        writer = Writer(target)
        writer.start("ros2")
        channels: dict[int, int] = {}
        for attachment in reader.iter_attachments():
            data = attachment.data.replace(*urdf) if urdf[0] else attachment.data
            assert not urdf[0] or data != attachment.data
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, data)
        for metadata in reader.iter_metadata():
            values = dict(metadata.metadata)
            if metadata.name == f"parameters/{node}":
                values |= parameters or {}
            if metadata.name != "rosbag2":
                writer.add_metadata(metadata.name, values)
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if not begin_ns <= message.log_time < end_ns:
                continue
            if channel.id not in channels:
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            data = message.data
            if channel.topic == topic:
                count += 1
                if count - 1 == number and change is not None:
                    kind = message_class(schema.name)
                    new = change(deserialize_message(data, kind))
                    if new is None:
                        continue
                    data = bytes(serialize_message(new))
            writer.add_message(
                channels[channel.id],
                log_time(message.log_time),
                packed(data),
                message.publish_time,
                message.sequence,
            )
        if injected:
            text = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
            channel_id = writer.register_channel("/fault_injection", "cdr", text)
            for time, line in injected.items():
                data = bytes(serialize_message(String(data=line)))
                writer.add_message(channel_id, time, data, time)
        writer.finish()
    assert not topic or count > number
    return out
