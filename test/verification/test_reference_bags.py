"""The reference bags: every scenario has one, every reader reads it, and it can be flown again."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState
from support.altered_bags import altered
from support.slow import some_fast

from spacerobot_ros.bag import iterate_raw, read_bag
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.resources import resource_names, share_directory

BAGS = share_directory() / "bags"
NAMES = resource_names("config", ".yaml")

QUICK = ("sliding_masses", "arm_attitude", "planar_chain", "coordinated_control")
"""Bags of which all tests are quick."""

MIN_TICKS = {"reach": 30, "two_hands": 25, "strut": 50, "capture": 150, "gravity_gradient": 200}
"""Flights of these are short, or have few ticks a second."""


def test_every_scenario_has_a_bag_and_they_are_small() -> None:
    assert resource_names("bags", ".mcap") == NAMES
    assert sum(path.stat().st_size for path in BAGS.iterdir()) < 5_500_000


@pytest.mark.parametrize("name", some_fast(NAMES, *QUICK))
def test_the_commands_in_it_give_the_states_in_it(name: str) -> None:
    # Where this fails, the plant behaves in another way than before: `make bags` if that is meant.
    result = verify_bag(BAGS / f"{name}.mcap")
    assert result.difference is None, str(result.difference)
    assert result.ticks > MIN_TICKS.get(name, 300)
    # Clock, end-effector and base pose apart, three messages tell the state of every tick.
    assert result.messages > 3 * result.ticks


def pushed(message: JointState) -> JointState:
    """Change what one joint is commanded, velocity or effort, by little."""
    values = message.effort if any(message.effort) else message.velocity
    values[-1] += 1e-3
    return message


@pytest.mark.parametrize("name", some_fast(NAMES, *QUICK))
def test_one_altered_command_is_found_at_its_time(name: str, tmp_path: Path) -> None:
    bag = read_bag(BAGS / f"{name}.mcap")
    stamps = bag["/joint_commands"].stamp
    number = len(stamps) // 2
    copy = altered(bag.path, tmp_path / "b.mcap", "/joint_commands", number, pushed)
    difference = verify_bag(copy).difference
    assert difference is not None
    assert difference.time == pytest.approx(stamps[number + 1], abs=1e-9)
    joints = next(bag.messages("/joint_states"))[1].name
    # The effect on the other joints comes first where efforts drive them.
    assert difference.topic == "/joint_states"
    assert difference.field in {f"{what} of {j}" for what in ("position", "effort") for j in joints}


@pytest.mark.parametrize("name", some_fast(NAMES, "planar_chain", "servicer_thrusters"))
def test_every_reader_reads_every_message(name: str) -> None:
    path = BAGS / f"{name}.mcap"
    own = [(topic, time_ns) for topic, _, time_ns, _, _ in iterate_raw(path)]
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        decoded = [
            (channel.topic, message.log_time)
            for _, channel, message, _ in reader.iter_decoded_messages(log_time_order=False)
        ]
        counts = {
            summary.channels[channel].topic: count
            for channel, count in summary.statistics.channel_message_counts.items()
        }
        assert summary.statistics.message_count == len(own)
        assert {record.name for record in reader.iter_metadata()} >= {"rosbag2", "scenario"}
        attached = ["robot_description.urdf"]
        if name in ("capture", "servicing"):
            attached.append("target.robot_description.urdf")
        assert [record.name for record in reader.iter_attachments()] == attached
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    assert decoded == own
    assert counts == Counter(topic for topic, _ in own)
    with AnyReader([path]) as any_reader:
        assert any_reader.message_count == len(own)
        read: Counter[str] = Counter()
        for connection, _, data in any_reader.messages():
            any_reader.deserialize(data, connection.msgtype)
            read[connection.topic] += 1
    assert read == counts
