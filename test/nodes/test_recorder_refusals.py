"""What the recorder node cannot write, and what it refuses: a sentence, and the flight goes on."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rclpy.lifecycle import TransitionCallbackReturn
from support.recorded_stack import LATCHED_TOPICS, STREAMS, BagContent, Stack, message_class
from support.ros_harness import Harness, Probe, construction
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import BagWriter, RecordingError
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import RecorderNode

ERROR = 40  # of rcl_interfaces/msg/Log


def errors(probe: Probe) -> list[str]:
    return [m.msg for m in probe.messages["/rosout"] if m.level >= ERROR]


def test_a_full_disk_ends_the_recording_with_one_sentence_and_not_the_flight(
    harness: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, room = BagWriter.write, 100

    def write(self: BagWriter, *message: Any) -> None:
        nonlocal room
        room -= 1
        if room < 0:
            raise RecordingError(f"The bag {self.path} cannot be written: no space left.")
        whole(self, *message)

    monkeypatch.setattr(BagWriter, "write", write)
    stack = Stack(harness, tmp_path / "flight.mcap")
    stack.configure(*STREAMS, *LATCHED_TOPICS)
    stack.recorder.trigger_activate()
    for x in (0.05, 0.0, 0.05):
        stack.fly(x)
    stack.stop()
    harness.spin_until(lambda: errors(stack.probe), "the failure of the next flush")
    (sentence,) = errors(stack.probe)
    assert_one_sentence(sentence, "Recording has ended", str(stack.bag), "no space left")
    assert str(stack.recorder.failure) in sentence
    assert stack.recorder.messages_recorded == 100
    assert stack.recorder.trigger_shutdown() is TransitionCallbackReturn.SUCCESS
    assert BagContent(stack.bag).count == 100


def test_a_device_is_refused_in_a_sentence(harness: Harness) -> None:
    stack = Stack(harness, Path("/dev/full"))
    assert stack.recorder.trigger_configure() is not TransitionCallbackReturn.SUCCESS
    assert_one_sentence(str(stack.recorder.fault), "/dev/full", "it is a device")
    stack.probe.watch("/planner/status", message_class("diagnostic_msgs/msg/DiagnosticStatus"))
    harness.connect()
    stack.fly()


def test_a_bag_that_cannot_be_made_is_refused_in_a_sentence(
    ros_context: rclpy.Context, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    for bag in (tmp_path, tmp_path / "file" / "flight.mcap"):
        with pytest.raises(SpaceRobotError) as refusal:
            RecorderNode(**construction(ros_context, {"bag": str(bag)}))
        assert_one_sentence(str(refusal.value), str(bag))


@pytest.mark.parametrize(
    ("name", "value"),
    [("compression", "zip"), ("flush_period", 0.0), ("flush_period", "often"), ("topics", 3)],
)
def test_a_bad_parameter_is_refused_with_a_sentence_that_names_it(
    ros_context: rclpy.Context, tmp_path: Path, name: str, value: Any
) -> None:
    parameters = {"bag": str(tmp_path / "flight.mcap"), name: value}
    with pytest.raises(SpaceRobotError) as refusal:
        RecorderNode(**construction(ros_context, parameters))
    assert_one_sentence(str(refusal.value), f"'{name}'", str(value))
    assert not (tmp_path / "flight.mcap").exists()


def test_a_recorder_that_is_to_refuse_a_bag_that_is_there_does(
    ros_context: rclpy.Context, tmp_path: Path
) -> None:
    bag = tmp_path / "flight.mcap"
    bag.write_bytes(b"the record of the crash")
    parameters = {"bag": str(bag), "when_exists": "refuse"}
    with pytest.raises(SpaceRobotError) as refusal:
        RecorderNode(**construction(ros_context, parameters))
    assert_one_sentence(str(refusal.value), str(bag), "File exists")
    assert bag.read_bytes() == b"the record of the crash"


def test_a_bag_that_goes_is_reported_within_a_second(
    harness: Harness, ros_domain: int, tmp_path: Path
) -> None:
    kinds = {"/diagnostics": DiagnosticArray, "/events": DiagnosticStatus}
    probe = harness.probe(kinds)
    bag = tmp_path / "folder" / "flight.mcap"
    with subprocess.Popen(
        [
            *(sys.executable, "-m", "spacerobot_ros.nodes.recorder", "--ros-args"),
            *("-p", f"bag:={bag}", "-p", "flush_period:=60.0"),
        ],
        cwd=Path(__file__).parents[2],
        env={**os.environ, "ROS_DOMAIN_ID": str(ros_domain)},
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            change = probe.create_client(ChangeState, "recorder/change_state")
            while not probe.messages["/events"]:  # Until these have met: paused, and on again.
                for transition in (
                    Transition.TRANSITION_DEACTIVATE,
                    Transition.TRANSITION_ACTIVATE,
                ):
                    request = ChangeState.Request(transition=Transition(id=transition))
                    assert harness.call(change, request).success
            bag.unlink()
            bag.parent.rmdir()
            gone = time.monotonic()
            harness.spin_until(lambda: probe.messages["/diagnostics"], "it is reported")
            seconds = time.monotonic() - gone
            harness.spin_until(
                lambda: any(
                    "recording_failed" in [pair.value for pair in event.values]
                    for event in probe.messages["/events"]
                ),
                "the event",
            )
        finally:
            process.send_signal(signal.SIGINT)
            errors = process.communicate(timeout=20)[1]
    (status,) = probe.last("/diagnostics").status
    assert status.level == DiagnosticStatus.ERROR
    assert "is lost while it is written: it was removed or moved" in status.message
    assert seconds < 1.0
    assert process.returncode == 1
    assert "is lost while it is written" in errors.splitlines()[-1]
    assert "Traceback" not in errors
