"""The recorder's files: split, with what was lost, and after a kill at any moment."""

from __future__ import annotations

import itertools
import os
import random
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from mcap.reader import make_reader
from std_msgs.msg import String
from support.ros_harness import Harness

from spacerobot_ros.bag import RecordingError, read_bag
from spacerobot_ros.bag.salvage import salvage_bag
from spacerobot_ros.nodes import RecorderNode
from spacerobot_ros.nodes.recorder import loss_events

ROOT = Path(__file__).parents[2]


def test_a_recording_is_split_by_size(harness: Harness, tmp_path: Path) -> None:
    probe = harness.probe({})
    publisher = probe.create_publisher(String, "/talk", 1000)
    recorder = harness.make(
        RecorderNode,
        {
            "bag": str(tmp_path / "flight.mcap"),
            "topics": "/talk",
            "max_size": 0.05,
            "clock_wait": 0.0,
            "compression": "none",
        },
    )
    harness.matched(publisher)
    for n in range(300):
        publisher.publish(String(data=f"{n:04d}" + "x" * 1000))
        if n % 50 == 49:
            harness.spin_until(lambda n=n: recorder.messages_recorded > n, "they are recorded")  # type: ignore[misc]
            recorder.flush()
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    files = sorted(tmp_path.iterdir(), key=lambda path: int(path.stem.split("_")[1]))
    assert len(files) >= 3
    texts = [m.data[:4] for path in files for _, m in read_bag(path).messages("/talk")]
    assert texts == [f"{n:04d}" for n in range(300)]
    assert all("spacerobot" in read_bag(path).metadata for path in files)
    assert read_bag(files[-1]).metadata["recorder"] == {"messages": "300", "messages_lost": "0"}


def test_a_recording_is_split_by_time_and_flushed_as_often_as_it_is_to(
    harness: Harness, tmp_path: Path
) -> None:
    publisher = harness.probe({}).create_publisher(String, "/talk", 10)
    parameters = {"topics": "/talk", "clock_wait": 0.0, "flush_period": 0.375}
    bag = str(tmp_path / "flight.mcap")
    # The third message comes more than a nanosecond after the first.
    recorder = harness.make(RecorderNode, {**parameters, "bag": bag, "max_duration": 1e-9})
    assert 375_000_000 in {timer.timer_period_ns for timer in recorder.timers}
    harness.matched(publisher)
    for n in range(3):
        publisher.publish(String(data=f"{n}"))
        harness.spin_until(lambda n=n: recorder.messages_recorded > n, "it is recorded")  # type: ignore[misc]
        recorder.flush()
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    files = sorted(tmp_path.iterdir())
    assert len(files) > 1
    assert [m.data for path in files for _, m in read_bag(path).messages("/talk")] == list("012")


def test_lost_messages_are_published_and_stay_in_the_bag(harness: Harness, tmp_path: Path) -> None:
    probe = harness.probe({"/diagnostics": DiagnosticArray})
    publisher = probe.create_publisher(String, "/talk", 10)
    # Its watchdog has diagnostics of its own.
    parameters = {"bag": str(tmp_path / "flight.mcap"), "watchdog_timeout": 0.0}
    recorder = harness.make(RecorderNode, parameters)
    harness.matched(publisher)
    assert recorder.recording is not None
    assert recorder.recording.lost.total() == 0
    assert recorder.count_publishers("/diagnostics") == 0
    for count in (3, 4):
        events = loss_events(recorder.recording, "/talk")
        events.message_lost(SimpleNamespace(total_count_change=count))
    harness.spin_until(lambda: probe.messages["/diagnostics"], "the loss is published")
    (status,) = probe.last("/diagnostics").status
    assert status.level == DiagnosticStatus.WARN
    assert [(pair.key, pair.value) for pair in status.values] == [("/talk", "7")]
    recorder.trigger_deactivate()
    recorder.trigger_cleanup()
    assert read_bag(tmp_path / "flight.mcap").metadata["recorder"]["messages_lost"] == "7"


def written(bag: Path) -> bool:
    """Whether more than the head of a bag is on the disk."""
    return bag.is_file() and bag.stat().st_size > 4000


@pytest.mark.slow
def test_a_kill_at_any_moment_leaves_all_but_the_last_second(
    harness: Harness, tmp_path: Path, ros_domain: int
) -> None:
    probe = harness.probe({})
    chance = random.Random(20)
    for turn in range(20):
        # A topic of its own: the dead reader of the last one is missed after 20 s only.
        publisher = probe.create_publisher(String, f"/talk_{turn}", 1000)
        numbers = itertools.count()

        def talk(publisher: Any = publisher, numbers: Iterator[int] = numbers) -> None:
            publisher.publish(String(data=f"{next(numbers):06d}" + "x" * 300))

        timer = probe.create_timer(0.002, talk)
        bag = tmp_path / f"{turn}.mcap"
        parameters = ["-p", f"bag:={bag}", "-p", "clock_wait:=0.0", "-p", f"topics:=/talk_{turn}"]
        with subprocess.Popen(
            [sys.executable, "-m", "spacerobot_ros.nodes.recorder", "--ros-args", *parameters],
            cwd=ROOT,
            env={**os.environ, "ROS_DOMAIN_ID": str(ros_domain)},
            stderr=subprocess.DEVNULL,
        ) as process:
            try:
                harness.matched(publisher)
                # The recorder may meet the publisher seconds after it was met.
                harness.spin_until(partial(written, bag), "something is written")
                harness.spin_for(chance.uniform(0.0, 2.0))
            finally:
                killed = time.time_ns()
                process.kill()
        with pytest.raises(RecordingError, match="spacerobot salvage"):
            read_bag(bag)
        saved = salvage_bag(bag)
        with saved.path.open("rb") as file:
            messages = [message for _, _, message in make_reader(file).iter_messages()]
        assert len(messages) == saved.messages
        assert killed - messages[-1].log_time < 1e9
        # Without a gap since the recorder listened.
        found = [int(message.data[8:14]) for message in messages]
        assert found == list(range(found[0], found[0] + len(found)))
        probe.destroy_timer(timer)
