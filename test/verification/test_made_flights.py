"""Flights written by hand, command by command, and what their verification makes of them."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.altered_bags import Change, altered
from support.made_bags import Say, array, made_bag, odometry, stamped
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import RecordingError, SpaceRobotError
from spacerobot_ros.flight import verification
from spacerobot_ros.flight.verification import Difference, Verification, verify_bag
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import values_of
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig

NAMES = ["slider_1", "slider_2", "slider_3"]
TICK = 0.1
RATES = np.array([0.1, -0.05, 0.02])
REST = np.zeros(3)


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


def config_of(**more: Any) -> PlantConfig:
    return PlantConfig(robot="sliding_masses", time_mode="lockstep", tick_rate=1 / TICK, **more)


Hear = Callable[[Say, str, Any, float], None]
"""Takes what writes a message, and the message with its topic and time, s."""


class Made:
    """A bag of ten ticks.

    ``moved`` are the rates of the sliders in each tick, ``commands`` what was commanded (by default
    the same): of a tick, or of a time in ticks. ``injected`` are faults by time in ticks.
    ``efforts`` are errors of the efforts that the plant publishes, by tick; None: it publishes
    zeros. ``disturbed`` are disturbances by time in ticks, which the plant has, ``told`` those
    that are published (by default the same).
    """

    def __init__(
        self,
        moved: Sequence[Any],
        commands: Mapping[Any, Any] | None = None,
        injected: Sequence[tuple[float, str]] = (),
        config: PlantConfig | None = None,
        prefix: str = "",
        without_pose: Sequence[int] = (),
        first: int = 0,
        error: float = 0.0,
        efforts: Mapping[int, float] | None = None,
        disturbed: Sequence[tuple[float, str]] = (),
        told: Sequence[tuple[float, str]] | None = None,
    ) -> None:
        self.config = config or config_of()
        self.prefix, self.first, self.error = prefix, first, error
        self.moved = [np.array(rates, dtype=float) for rates in moved]
        self.commands = dict(enumerate(self.moved)) if commands is None else dict(commands)
        self.injected, self.without_pose = injected, without_pose
        self.efforts, self.disturbed = efforts, disturbed
        self.told = disturbed if told is None else told

    def write(
        self, path: Path, hear: Hear | None = None, recorder: dict[str, str] | None = None
    ) -> Path:
        """Write the bag; ``hear`` decides what is written, ``recorder`` is what was counted."""
        with made_bag(path) as (bag, say):
            if recorder is not None:
                bag.add_metadata("recorder", recorder)
            self.add(bag, say if hear is None else partial(hear, say))
        return path

    def add(self, bag: Any, say: Any) -> None:
        robot = SpaceRobot.from_file(robot_file("sliding_masses"))
        texts = {name: json.dumps(value) for name, value in values_of(self.config).items()}
        bag.add_metadata(f"parameters{self.prefix}/plant", texts)
        name = f"{self.prefix}/robot_description".strip("/").replace("/", ".")
        bag.add_attachment(f"{name}.urdf", robot.description.urdf.encode(), "application/xml", 0)
        plant = build_plant(robot, self.config, None)
        shape = plant.q.copy()
        for tick in range(len(self.moved) + 1):
            self._say_state(say, tick, plant, shape)
            if tick == len(self.moved):
                break
            for time, text in self.disturbed:
                if tick <= time < tick + 1:
                    plant.disturb(text)  # A begin without a time is that of the tick.
            plant.step(self.moved[tick].copy())
            shape = shape + TICK * self.moved[tick]
            np.testing.assert_allclose(plant.q, shape, atol=1e-12)
        for time, text in self.injected:
            say(f"{self.prefix}/fault_injection", String(data=text), time * TICK)
        for time, text in self.told:
            say(f"{self.prefix}/disturbance_injection", String(data=text), time * TICK)
        for time, rates in self.commands.items():
            message = JointState(name=NAMES, velocity=[float(x) for x in rates])
            say(f"{self.prefix}/joint_commands", stamped(message, time * TICK), time * TICK)

    def _say_state(self, say: Any, tick: int, plant: Any, shape: Any) -> None:
        if tick < self.first:
            return
        time = tick * TICK
        if tick not in self.without_pose:
            say(f"{self.prefix}/odom", odometry(time, *plant.pose, *plant.twist), time)
        say(f"{self.prefix}/momentum", array(*plant.momentum), time)
        joints = JointState(name=NAMES, position=(shape + self.error).tolist(), effort=[0.0] * 3)
        joints.velocity = plant.qdot.tolist()
        if self.efforts is not None:
            joints.effort = (plant.effort + self.efforts.get(tick, 0.0)).tolist()
        say(f"{self.prefix}/joint_states", stamped(joints, time, "base_link"), time)


def verified(path: Path, *args: Any, **options: Any) -> Verification:
    return verify_bag(Made(*args, **options).write(path / f"{len(os.listdir(path))}.mcap"))


def difference_in(result: Verification) -> Difference:
    assert result.difference is not None
    return result.difference


def held(stuck: int, since: int) -> list[Any]:
    """Return rates of which one slider's is zero from a tick on."""
    return [RATES * [float(i != stuck or k < since) for i in range(3)] for k in range(10)]


ALL = dict.fromkeys(range(10), RATES)


def test_a_flight_without_faults(tmp_path: Path) -> None:
    result = verified(tmp_path, [RATES] * 10)
    assert result.difference is None, str(result.difference)
    assert (result.ticks, result.duration, result.messages) == (10, 1.0, 33)


@pytest.mark.parametrize("first", [0, 4])
def test_efforts_are_compared_where_the_plant_of_the_bag_published_them(
    tmp_path: Path, first: int
) -> None:
    moved = [RATES * math.sin(0.7 * k) for k in range(10)]
    exact: dict[int, float] = {}
    for efforts in (exact, None):
        right = verified(tmp_path, moved, first=first, efforts=efforts)
        assert right.difference is None, str(right.difference)
    difference = difference_in(verified(tmp_path, moved, first=first, efforts={6: 1e-6}))
    assert difference.time == pytest.approx(6 * TICK)
    assert difference.field == "effort of slider_1"
    assert difference.recorded - difference.expected == pytest.approx(1e-6)


@pytest.mark.parametrize("time", [3.0, 3.4, 3.99])
def test_a_fault_acts_in_the_tick_that_it_came_in(tmp_path: Path, time: float) -> None:
    fault = [(time, "joint_stuck slider_2")]
    right = verified(tmp_path, held(1, 3), ALL, fault)
    assert right.difference is None, str(right.difference)
    difference = difference_in(verified(tmp_path, held(1, 4), ALL, fault))
    assert difference.time == pytest.approx(4 * TICK)


def test_all_faults_of_a_tick_act(tmp_path: Path) -> None:
    moved = [RATES if k < 3 else RATES * [0.0, 0.0, 1.0] for k in range(10)]
    faults = [(3.0, "joint_stuck slider_1"), (3.0, "joint_stuck slider_2")]
    assert verified(tmp_path, moved, ALL, faults).difference is None
    repaired = [RATES if k < 3 or k >= 6 else RATES * [0.0, 0.0, 1.0] for k in range(10)]
    faults += [(6.0, "clear"), (8.0, "nonsense")]
    assert verified(tmp_path, repaired, ALL, faults).difference is None


PUSH = "mass_2 force 0.5 -1 2 torque 0 0.2 0 in link"


def test_disturbances_are_flown_again(tmp_path: Path) -> None:
    moved = [RATES] * 10
    config = config_of(disturbances=(f"{PUSH} at 0.25 until 0.75",))
    result = verified(tmp_path, moved, config=config)
    assert (result.difference, result.messages) == (None, 33)
    injected = [(4.0, PUSH), (6.7, f"{PUSH} until 0.9"), (8.0, "clear"), (9.0, "nonsense")]
    assert verified(tmp_path, moved, disturbed=injected[:3], told=injected).difference is None


def test_a_disturbance_counts_for_the_tick_that_it_came_in(tmp_path: Path) -> None:
    moved, push = [RATES] * 10, [(3.6, PUSH)]
    assert verified(tmp_path, moved, disturbed=push, told=[(3.9, PUSH)]).difference is None
    difference = difference_in(verified(tmp_path, moved, disturbed=push, told=[(4.0, PUSH)]))
    assert difference.topic == "/odom"
    assert difference.time == pytest.approx(4 * TICK)


def test_a_command_between_ticks_is_stale(tmp_path: Path) -> None:
    moved = [RATES if k != 3 else REST for k in range(10)]
    commands = {k if k != 3 else 3.4: RATES for k in range(10)}
    assert verified(tmp_path, moved, commands).difference is None


def test_a_tick_without_a_command_rests_and_the_difference_says_so(tmp_path: Path) -> None:
    commands = {k: RATES for k in range(10) if k != 3}
    moved = [RATES if k != 3 else REST for k in range(10)]
    assert verified(tmp_path, moved, commands).difference is None
    difference = difference_in(verified(tmp_path, [RATES] * 10, commands))
    assert difference.time == pytest.approx(4 * TICK)
    assert difference.remark == " (no message on /joint_commands is stamped 0.3 s)"


def test_to_a_lost_pose_nobody_need_answer(tmp_path: Path) -> None:
    """The last command is held while poses are lost; without, the joints would rest."""
    commands = {k: RATES for k in range(10) if k not in (4, 5)}
    lost = [(3.0, "sensor_dropout odom until 0.55")]
    result = verified(tmp_path, [RATES] * 10, commands, lost, without_pose=(4, 5))
    assert result.difference is None, str(result.difference)


def test_what_follows_a_latched_fault_is_said_to(tmp_path: Path) -> None:
    config = config_of(beyond_limits="refuse", latched_faults="beyond_limits")
    fast = np.array([50.0, 0.0, 0.0])
    commands = {k: RATES if k != 4 else fast for k in range(10)}
    moved = [RATES if k < 4 else REST for k in range(10)]
    assert verified(tmp_path, moved, commands, config=config).difference is None
    # As if somebody had rearmed it at once.
    rearmed = [RATES if k != 4 else REST for k in range(10)]
    # In the tick after it latched that is why it rests.
    for moved, tick in ((rearmed, 6), ([RATES] * 10, 5)):
        difference = difference_in(verified(tmp_path, moved, commands, config=config))
        assert difference.time == pytest.approx(tick * TICK)
        assert difference.remark == " (a fault latched at 0.4 s; rearming is not recorded)"


@pytest.mark.parametrize("prefix", ["", "/a"])
def test_the_refusal_of_a_command_is_named(tmp_path: Path, prefix: str) -> None:
    commands = {k: RATES if k != 4 else [np.nan, 0.0, 0.0] for k in range(10)}
    difference = difference_in(verified(tmp_path, [RATES] * 10, commands, prefix=prefix))
    assert difference.time == pytest.approx(5 * TICK)
    assert f"the command on {prefix}/joint_commands stamped 0.4 s is rejected:" in difference.remark


def test_states_after_the_end_of_its_plant_are_differences(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bag = Made([REST] * 10).write(tmp_path / "a.mcap")
    assert verify_bag(bag).difference is None

    def failing(*args: Any) -> Any:
        plant = build_plant(*args)
        step = plant.step

        def stop(*commands: Any) -> Any:
            if plant.tick == 5:
                raise SpaceRobotError("It came apart.")
            return step(*commands)

        monkeypatch.setattr(plant, "step", stop)
        return plant

    monkeypatch.setattr(verification, "build_plant", failing)
    result = verify_bag(bag)
    assert result.ticks == 5
    assert difference_in(result).time == pytest.approx(6 * TICK)
    assert difference_in(result).remark == " (its plant had stopped: It came apart)"


def test_the_robot_of_one_plant_is_verified(tmp_path: Path) -> None:
    with made_bag(tmp_path / "two.mcap") as (bag, say):
        for prefix in ("/a", "/b"):
            Made([RATES] * 4, prefix=prefix).add(bag, say)
    with pytest.raises(RecordingError, match=r"contains states of 2 plants \(/a, /b\)"):
        verify_bag(tmp_path / "two.mcap")
    assert verified(tmp_path, [RATES] * 4, prefix="/a").difference is None


def test_the_earliest_difference_is_named_wherever_it_is_in_the_file(tmp_path: Path) -> None:
    def alter(say: Say, topic: str, message: Any, time: float) -> None:
        tick = round(time / TICK)
        if topic == "/joint_states" and tick in (4, 6):
            message.position[0 if tick == 4 else 1] += 1e-3
            message.velocity[2] += 1e-3
            # Recorded out of order.
            time = 1.0 - time
        say(topic, message, time)

    result = verify_bag(Made([RATES] * 10).write(tmp_path / "a.mcap", alter))
    assert difference_in(result).time == pytest.approx(4 * TICK)
    assert difference_in(result).field == "position of slider_1"
    # What is found different is not the largest deviation before it.
    assert result.largest < 1e-12


def test_a_flight_that_begins_at_a_limit_but_for_rounding(tmp_path: Path) -> None:
    lower = SpaceRobot.from_file(robot_file("sliding_masses")).lower
    config = config_of(initial_joint_positions=(float(lower[0]) + 0.04, 0.0, 0.0))
    moved = [[-0.1, 0.0, 0.0]] * 4 + [[0.0, 0.0, 0.0]] * 6
    result = verified(tmp_path, moved, config=config, first=5, error=-1e-10)
    assert result.difference is None, str(result.difference)
    assert result.ticks == 5


@pytest.mark.parametrize("at", [4, 7])
def test_a_reset_is_refused_with_the_time_of_its_state(tmp_path: Path, at: int) -> None:
    """The plant's time goes on, and its first state is published once more."""
    start = JointState(name=NAMES, position=[0.0] * 3, velocity=[0.0] * 3, effort=[0.0] * 3)

    def again(say: Say, topic: str, message: Any, time: float) -> None:
        say(topic, message, time)
        if topic == "/joint_states" and round(time / TICK) == at:
            say(topic, stamped(start, time - 2 * TICK, "base_link"), time)

    bag = Made([RATES] * 10).write(tmp_path / "a.mcap", again)
    with pytest.raises(RecordingError) as refusal:
        verify_bag(bag)
    assert f"the plant was reset at {(at - 2) * TICK:.9g} s; only flights" in str(refusal.value)


def test_a_message_between_two_ticks_is_refused_with_its_time(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with made_bag(path) as (bag, say):
        Made([RATES] * 3).add(bag, say)
        late = JointState(name=NAMES, position=[0.0] * 3, velocity=[0.0] * 3, effort=[0.0] * 3)
        say("/joint_states", stamped(late, 0.25, "base_link"), 0.25)
        say("/joint_states", stamped(late, 0.27, "base_link"), 0.27)
    words = "is stamped 0.25 s, between the plant's ticks"
    with pytest.raises(RecordingError, match=words):
        verify_bag(path)


def test_how_much_was_verified_is_told(tmp_path: Path) -> None:
    result = verified(tmp_path, [RATES] * 10, without_pose=(3, 4))
    assert result.topics == ("/joint_states", "/odom", "/momentum")
    assert result.messages == 11 + 9 + 11
    assert (result.ticks, result.missing) == (10, "")


@pytest.mark.parametrize("kept", [1, 2, 6])
def test_a_bag_whose_states_were_removed_is_not_verified(tmp_path: Path, kept: int) -> None:
    """Its commands are all there: each answers a state."""

    def hear(say: Say, topic: str, message: Any, time: float) -> None:
        if topic == "/joint_commands" or time < (kept - 0.5) * TICK:
            say(topic, message, time)

    bag = Made([RATES] * 10).write(tmp_path / "a.mcap", hear)
    if kept == 1:
        with pytest.raises(RecordingError, match="the states of only one tick: there is nothing"):
            verify_bag(bag)
        return
    result = verify_bag(bag)
    assert result.difference is None
    assert result.ticks == kept - 1
    first = f"the first at {kept * TICK:g} s."
    assert result.missing == f"it has commands for {10 - kept} states that are missing, {first}"


@pytest.mark.parametrize(("counted", "lost"), [(42, 0), (43, 0), (43, 5)])
def test_a_bag_with_fewer_messages_than_its_recorder_wrote_is_not_whole(
    tmp_path: Path, counted: int, lost: int
) -> None:
    # Three messages of each of eleven states, and ten commands.
    whole, lacking = (
        verify_bag(
            Made([RATES] * 10).write(
                tmp_path / f"{messages}.mcap",
                recorder={"messages": str(messages), "messages_lost": str(lost)},
            )
        )
        for messages in (counted, 44)
    )
    assert whole.missing == ""
    assert lacking.missing == "its recorder wrote 44 messages, but it contains 43."


@pytest.mark.parametrize(("lost", "missing"), [(1, False), (0, True)])
def test_a_state_that_was_lost_on_its_way_to_the_recorder_is_counted(
    tmp_path: Path, lost: int, missing: bool
) -> None:
    def hear(say: Say, topic: str, message: Any, time: float) -> None:
        if not (topic == "/joint_states" and time == 5 * TICK):
            say(topic, message, time)

    counts = {"messages": "1", "messages_lost": str(lost)}
    bag = Made([RATES] * 10).write(tmp_path / "a.mcap", hear, counts)
    assert bool(verify_bag(bag).missing) is missing


# -- reference bags of which something is altered -----------------------------------------------


BAGS = share_directory() / "bags"
REFERENCE = BAGS / "sliding_masses.mcap"
TICKS = 340


def added(path: str, amount: float) -> Change:
    """Return what adds to the number at a path such as ``velocity.2`` of a message."""
    *parts, last = path.split(".")

    def change(message: Any) -> Any:
        part = reduce(getattr, parts, message)
        if last.isdigit():
            part[int(last)] += amount
        else:
            setattr(part, last, getattr(part, last) + amount)
        return message

    return change


def test_a_quaternion_means_the_same_with_either_sign(tmp_path: Path) -> None:
    """The opposite rotation is a difference."""

    def of_sign(w: float) -> Change:
        def change(message: Any) -> Any:
            q = message.pose.pose.orientation
            assert abs(q.x) > 1e-4
            assert q.w > 0.5
            q.x, q.y, q.z, q.w = -q.x, -q.y, -q.z, w * q.w
            return message

        return change

    same, opposite = (
        verify_bag(altered(REFERENCE, tmp_path / f"{w}.mcap", "/odom", 120, of_sign(w)))
        for w in (-1.0, 1.0)
    )
    assert same.difference is None
    assert difference_in(opposite).field == "pose.pose.orientation.x"


def test_a_number_that_is_none_is_a_difference(tmp_path: Path) -> None:
    lost = added("twist.twist.linear.z", math.nan)
    bag = altered(REFERENCE, tmp_path / "b.mcap", "/odom", 120, lost)
    difference = difference_in(verify_bag(bag))
    assert difference.topic == "/odom"
    assert difference.time == pytest.approx(12.0)


@pytest.mark.parametrize(("row", "least", "most"), [(256, 7.0, 9.0), (32, 0.2, 0.3)])
@pytest.mark.parametrize(("share", "differs"), [(0.9, False), (1.1, True)])
def test_deviations_count_as_a_share_above_one_and_as_they_are_below(
    row: int, least: float, most: float, share: float, differs: bool, tmp_path: Path
) -> None:
    tolerance = 1e-6

    def changed(message: Any) -> Any:
        energy = message.data[6]
        assert least < energy < most
        message.data[6] += share * tolerance * max(1.0, energy)
        return message

    planar = BAGS / "planar_chain.mcap"
    result = verify_bag(
        altered(planar, tmp_path / "altered.mcap", "/momentum", row, changed), tolerance
    )
    assert (result.difference is not None) == differs
    if not differs:
        assert result.largest == pytest.approx(share * tolerance, rel=1e-6)
        assert result.largest_at is not None
        assert result.largest_at.field == "kinetic energy"


@pytest.mark.parametrize("tick", [1, 80, 333])
def test_an_altered_command_is_found_where_it_acts(tmp_path: Path, tick: int) -> None:
    faster = added("velocity.1", 1e-4)
    bag = altered(REFERENCE, tmp_path / "b.mcap", "/joint_commands", tick, faster)
    difference = difference_in(verify_bag(bag))
    assert difference.time == pytest.approx((tick + 1) * TICK)
    assert (difference.topic, difference.field) == ("/joint_states", "position of slider_2")
    # What the slider does in a tick.
    assert difference.expected - difference.recorded == pytest.approx(1e-4 * TICK, rel=1e-6)
    assert_one_sentence(str(difference), "position of slider_2", f"{(tick + 1) * TICK:g} s")


@pytest.mark.parametrize(
    ("name", "topic", "number", "path", "field"),
    [
        ("sliding_masses", "/joint_states", 0, "position.1", "position of slider_2"),
        ("sliding_masses", "/joint_states", 33, "velocity.2", "velocity of slider_3"),
        ("sliding_masses", "/odom", 33, "twist.twist.angular.y", "twist.twist.angular.y"),
        ("sliding_masses", "/base_pose", 33, "pose.orientation.x", "pose.orientation.x"),
        ("sliding_masses", "/momentum", 33, "data.6", "kinetic energy"),
        pytest.param(
            *("servicer_thrusters", "/thrusters", 33, "effort.3", "effort of plus_x_4"),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            *("servicer_thrusters", "/base_wrench_realised", 33),
            *("wrench.torque.y", "wrench.torque.y"),
            marks=pytest.mark.slow,
        ),
    ],
)
def test_an_altered_number_is_found(
    tmp_path: Path, name: str, topic: str, number: int, path: str, field: str
) -> None:
    source = BAGS / f"{name}.mcap"
    bag = altered(source, tmp_path / "b.mcap", topic, number, added(path, 1e-6))
    difference = difference_in(verify_bag(bag))
    assert (difference.topic, difference.field) == (topic, field)
    assert difference.time == pytest.approx(read_bag(source)[topic].stamp[number])
    assert difference.recorded - difference.expected == pytest.approx(1e-6, rel=1e-6)
    assert verify_bag(bag, tolerance=2e-6).difference is None


@pytest.mark.slow
def test_another_robot_is_found(tmp_path: Path) -> None:
    text = b'<mass value="10" />', b'<mass value="10.01" />'
    difference = difference_in(verify_bag(altered(REFERENCE, tmp_path / "b.mcap", urdf=text)))
    # The joints go as commanded, but with other efforts.
    assert difference.topic == "/joint_states"
    assert difference.time == pytest.approx(TICK)


def test_a_joint_that_the_robot_does_not_have_is_refused(tmp_path: Path) -> None:
    text = b'joint name="slider_2"', b'joint name="slider_two"'
    with pytest.raises(SpaceRobotError) as refusal:
        verify_bag(altered(REFERENCE, tmp_path / "b.mcap", urdf=text))
    assert_one_sentence(str(refusal.value), "slider_2", "slider_two")


def test_a_bag_that_begins_in_mid_flight(tmp_path: Path) -> None:
    bag = REFERENCE
    for topic in ("/odom", "/joint_states", "/momentum", "/base_pose"):
        name = f"{topic.strip('/')}.mcap"
        bag = altered(bag, tmp_path / name, topic, 0, lambda _: None)
    result = verify_bag(bag)
    assert result.difference is None
    assert result.ticks == TICKS - 1
    turned = added("twist.twist.angular.y", 1e-6)
    bag = altered(bag, tmp_path / "changed.mcap", "/odom", 7, turned)
    difference = difference_in(verify_bag(bag))
    assert difference.time == pytest.approx(8 * TICK)


def test_a_flight_under_efforts_that_begins_in_mid_flight_has_its_joint_rates(
    tmp_path: Path,
) -> None:
    whole = BAGS / "coordinated_control.mcap"
    # The robot starts at rest; half a second later its joints move.
    bag = altered(whole, tmp_path / "late.mcap", begin_ns=500_000_000)
    assert np.abs(read_bag(bag)["/joint_states"].field("velocity")[0]).min() > 1e-3
    result = verify_bag(bag, tolerance=1e-9)
    assert result.difference is None
    assert result.ticks == 842, "of 892 ticks, 50 come before"


@pytest.mark.parametrize(
    ("parameters", "mention"),
    [
        ({"time_mode": '"realtime"'}, "in real time"),
        ({"actuation": '"magic"'}, "'magic'"),
        ({"tick_rate": "not a number"}, "cannot be used: Expecting value"),
        ({"initial_position": '"here"'}, "cannot be used"),
        ({"tick_rate": "30.01"}, "between the plant's ticks"),
    ],
)
def test_what_cannot_be_flown_again_is_refused(
    tmp_path: Path, parameters: dict[str, str], mention: str
) -> None:
    bag = altered(REFERENCE, tmp_path / "b.mcap", parameters=parameters)
    with pytest.raises(SpaceRobotError) as refusal:
        verify_bag(bag)
    assert_one_sentence(str(refusal.value), mention)
