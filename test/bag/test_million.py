"""A million messages in one bag: memory stays flat, everything is read back."""

from __future__ import annotations

import resource
import struct
import time
from pathlib import Path

import numpy as np
import pytest

from spacerobot_ros.bag import BagWriter, Recording, iterate_raw, read_bag

COUNT = 1_000_000
TOPICS = 8
PAGE = resource.getpagesize()


def megabytes() -> float:
    """Return how much memory this process has now."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE / 1e6


def array(number: int) -> bytes:
    """Serialise a std_msgs/Float64MultiArray of seven numbers by hand."""
    numbers = [number + k / 7 for k in range(7)]
    return b"\0\1\0\0" + struct.pack("<III4x7d", 0, 0, 7, *numbers)


@pytest.mark.slow
def test_a_million_messages_in_one_bag(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    recording = Recording(BagWriter(path, chunk_size=262_144), 0.0)
    channels = [
        recording.writer.add_topic(f"/t{k}", "std_msgs/msg/Float64MultiArray")
        for k in range(TOPICS)
    ]
    recording.start()
    sizes = []
    began = time.perf_counter()
    for number in range(COUNT):
        if not number % TOPICS:
            recording.set_clock(number * 1000)
        recording.record(channels[number % TOPICS], array(number))
        if not number % 20_000:
            recording.flush(True)
            recording.check()
            sizes.append(megabytes())
    recording.close()
    wrote = time.perf_counter() - began
    assert recording.failure is None
    # What remains of a chunk is its index.
    assert sizes[-1] - sizes[4] < 15.0

    base, most = megabytes(), 0.0
    began = time.perf_counter()
    for number, (topic, _, log_ns, _, data) in enumerate(iterate_raw(path)):
        if not number % 50_000:
            most = max(most, megabytes())
            assert (topic, log_ns) == (f"/t{number % TOPICS}", number // TOPICS * TOPICS * 1000)
            assert data == array(number)
    assert number == COUNT - 1
    streamed = time.perf_counter() - began
    last = -1
    for number, (_, log_ns, _, _) in enumerate(read_bag(path).raw_messages(set(channels))):
        assert log_ns >= last
        last = log_ns
        if not number % 50_000:
            most = max(most, megabytes())
    assert number == COUNT - 1
    assert most - base < 40.0

    began = time.perf_counter()
    data = read_bag(path)["/t3"].field("data")
    column = time.perf_counter() - began
    assert np.array_equal(data[:, 0], np.arange(3, COUNT, TOPICS))
    print(
        f"written {COUNT / wrote:.0f} a second, streamed {COUNT / streamed:.0f} a second, one of "
        f"{TOPICS} topics as numbers in {column:.1f} s; memory grew by {sizes[-1] - sizes[4]:.1f} "
        f"MB while writing and {most - base:.1f} MB while reading"
    )
