"""What the plant node does with a command, a reset and a pause in lockstep."""

from __future__ import annotations

import math

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from support.bad_commands import BAD_COMMANDS
from support.odometry import pose_of, twist_of
from support.plant_rig import SLIDERS, STATE, TICK, TICK_NS, Rig
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence

RATE_LIMIT, STROKE = 0.7, 2.5  # of each slider, as its <limit> says


# -- commands ---------------------------------------------------------------------------------


def test_a_command_of_the_right_stamp_steps_exactly_once(harness: Harness) -> None:
    rig = Rig(harness)
    for k in range(1, 4):
        joints = rig.step([0.1, -0.2, 0.3])
        assert nanoseconds(joints.header.stamp) == k * TICK_NS
        np.testing.assert_allclose(joints.position, k * TICK * np.array([0.1, -0.2, 0.3]))
        np.testing.assert_array_equal(joints.velocity, [0.1, -0.2, 0.3])
    # The same stamp three times is one step.
    stamp = rig.now_ns
    for _ in range(3):
        rig.send([0.1, 0.0, 0.0], stamp_ns=stamp)
    rig.wait("joint_states", 5)
    rig.step([0.0, 0.0, 0.0])
    harness.settle(rig.probe)
    assert {topic: rig.probe.count(topic) for topic in STATE} == dict.fromkeys(STATE, 6)
    assert rig.diagnosed("commands", "refused") == 2


@pytest.mark.slow
def test_time_is_a_whole_number_of_ticks(harness: Harness) -> None:
    rig = Rig(harness, {"tick_rate": 3.0})
    for k in range(1, 5):
        stamp = nanoseconds(rig.step([0.0, 0.0, 0.0]).header.stamp)
        assert stamp == k * 333_333_333
    harness.settle(rig.probe)
    clocks = [nanoseconds(m.clock) for m in rig.probe.messages["/clock"]]
    assert clocks == [nanoseconds(m.header.stamp) for m in rig.probe.messages["odom"]]


@pytest.mark.parametrize(
    ("offset_ns", "word"), [(-TICK_NS, "stale"), (-1, "stale"), (1, "ahead"), (10**12, "ahead")]
)
def test_a_command_of_another_stamp_is_refused_and_time_waits(
    harness: Harness, offset_ns: int, word: str
) -> None:
    rig = Rig(harness)
    rig.step([0.0, 0.0, 0.0])
    rig.send([0.1, 0.1, 0.1], stamp_ns=rig.now_ns + offset_ns)
    rig.wait_for_log(word)
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 2
    rig.step([0.1, 0.0, 0.0])
    status = rig.diagnosis("commands")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message, "refused", word)
    assert rig.diagnosed("commands", "refused") == 1
    # The next diagnostics are about what is new.
    rig.step([0.1, 0.0, 0.0])
    assert rig.diagnosis("commands").level == DiagnosticStatus.OK


def test_a_bad_command_is_a_tick_at_rest_with_a_reason(harness: Harness) -> None:
    rig = Rig(harness)
    for count, (velocity, names, reason) in enumerate(BAD_COMMANDS.values(), start=1):
        before = rig.step([0.2, 0.2, 0.2])
        joints = rig.step(velocity, names)
        assert nanoseconds(joints.header.stamp) == nanoseconds(before.header.stamp) + TICK_NS
        np.testing.assert_array_equal(joints.velocity, np.zeros(3))
        np.testing.assert_array_equal(joints.position, before.position)
        status = rig.diagnosis("commands")
        assert status.level == DiagnosticStatus.WARN
        assert_one_sentence(status.message, reason)
        assert rig.diagnosed("commands", "refused") == count
        # The stack goes on.
        np.testing.assert_array_equal(rig.step([0.3, 0.2, 0.1]).velocity, [0.3, 0.2, 0.1])
        assert rig.diagnosis("commands").level == DiagnosticStatus.OK


@pytest.mark.parametrize(
    ("velocity", "names", "reason"),
    [BAD_COMMANDS["NaN"], BAD_COMMANDS["unknown joint"]],
    ids=["NaN", "unknown joint"],
)
def test_a_bad_command_is_logged(
    harness: Harness, velocity: list[float], names: list[str], reason: str
) -> None:
    rig = Rig(harness)
    rig.step(velocity, names)
    rig.wait_for_log(reason)


@pytest.mark.parametrize(
    ("velocity", "names", "missing"),
    [
        ([0.2], ["slider_2"], "slider_1"),
        ([0.5, -0.5], ["slider_3", "slider_1"], "slider_2"),
        ([], [], "slider_1"),
    ],
)
def test_a_command_that_leaves_a_joint_out_is_a_tick_at_rest(
    harness: Harness, velocity: list[float], names: list[str], missing: str
) -> None:
    rig = Rig(harness)
    rig.step([0.3, 0.2, 0.1])
    np.testing.assert_array_equal(rig.step(velocity, names).velocity, np.zeros(3))
    assert_one_sentence(rig.diagnosis("commands").message, f"joint '{missing}' is missing")
    assert rig.diagnosed("commands", "refused") == 1


def test_joints_go_by_name_and_not_by_place(harness: Harness) -> None:
    rig = Rig(harness)
    rng = np.random.default_rng(2)
    for _ in range(6):
        wanted = dict(zip(SLIDERS, rng.uniform(-0.5, 0.5, 3), strict=True))
        names = [str(name) for name in rng.permutation(SLIDERS)]
        joints = rig.step([wanted[name] for name in names], names)
        assert dict(zip(joints.name, joints.velocity, strict=True)) == wanted


def test_positions_and_efforts_of_a_command_are_not_looked_at(harness: Harness) -> None:
    rig = Rig(harness)
    joints = rig.step([0.1, 0.2, 0.3], position=[math.nan], effort=[math.inf] * 5)
    np.testing.assert_array_equal(joints.velocity, [0.1, 0.2, 0.3])
    assert rig.diagnosed("commands", "refused") == 0


def test_rates_are_limited_as_the_urdf_says_and_counted(harness: Harness) -> None:
    rig = Rig(harness)
    joints = rig.step([1.0, -5.0, RATE_LIMIT])
    np.testing.assert_array_equal(joints.velocity, [RATE_LIMIT, -RATE_LIMIT, RATE_LIMIT])
    np.testing.assert_allclose(joints.position, np.array([1, -1, 1]) * RATE_LIMIT * TICK)
    status = rig.diagnosis("actuators")
    assert status.level == DiagnosticStatus.WARN
    counts = {pair.key: int(pair.value) for pair in status.values}
    assert counts == {
        "rate_limited.slider_1": 1,
        "rate_limited.slider_2": 1,
        "rate_limited.slider_3": 0,
        "stroke_limited.slider_1": 0,
        "stroke_limited.slider_2": 0,
        "stroke_limited.slider_3": 0,
    }
    rig.wait_for_log("slider_1")
    rig.step([0.1, 0.1, 0.1])
    assert rig.diagnosis("actuators").level == DiagnosticStatus.OK


def test_strokes_are_limited_as_the_urdf_says_and_counted(harness: Harness) -> None:
    rig = Rig(harness, {"initial_joint_positions": [2.48, -2.48, 0.0]})
    joints = rig.step([0.6, -0.5, 0.1])
    # 0.02 m are left, in 0.05 s.
    np.testing.assert_allclose(joints.velocity, [0.4, -0.4, 0.1], rtol=1e-12)
    np.testing.assert_allclose(joints.position, [STROKE, -STROKE, 0.005], rtol=1e-14)
    joints = rig.step([0.6, 0.5, 0.1])
    np.testing.assert_allclose(joints.velocity, [0.0, 0.5, 0.1], atol=1e-12)
    np.testing.assert_allclose(joints.position, [STROKE, -STROKE + 0.025, 0.01], rtol=1e-14)
    assert rig.diagnosed("actuators", "stroke_limited.slider_1") == 2
    assert rig.diagnosed("actuators", "stroke_limited.slider_2") == 1
    assert rig.diagnosed("actuators", "stroke_limited.slider_3") == 0
    assert rig.diagnosed("actuators", "rate_limited.slider_1") == 0


# -- services ---------------------------------------------------------------------------------


def test_reset_brings_the_initial_state_back_and_time_goes_on(harness: Harness) -> None:
    rig = Rig(harness, {"initial_joint_positions": [0.1, 0.2, 0.3], "initial_position": [1, 2, 3]})
    for _ in range(3):
        rig.step([0.5, 0.5, -0.5])
    assert pose_of(rig.probe.last("odom"))[0].tolist() != [1, 2, 3]
    before = rig.now_ns
    answer = rig.trigger("plant/reset")
    assert answer.success
    joints = rig.wait("joint_states", 5)
    np.testing.assert_array_equal(joints.position, [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(joints.velocity, np.zeros(3))
    np.testing.assert_array_equal(pose_of(rig.probe.last("odom"))[0], [1, 2, 3])
    np.testing.assert_array_equal(np.concatenate(twist_of(rig.probe.last("odom"))), np.zeros(6))
    assert nanoseconds(joints.header.stamp) >= before
    joints = rig.step([0.5, 0.0, 0.0])
    assert nanoseconds(joints.header.stamp) > before
    np.testing.assert_allclose(joints.position, [0.125, 0.2, 0.3])


def test_pause_stops_time_until_it_is_taken_back(harness: Harness) -> None:
    rig = Rig(harness)
    rig.step([0.1, 0.0, 0.0])
    answer = rig.pause(True)
    assert (answer.success, answer.message) == (True, "paused")
    rig.send([0.2, 0.0, 0.0])
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 2
    answer = rig.pause(False)
    assert (answer.success, answer.message) == (True, "running")
    # The command that came meanwhile is carried out, once.
    joints = rig.wait("joint_states", 3)
    np.testing.assert_array_equal(joints.velocity, [0.2, 0.0, 0.0])
    np.testing.assert_array_equal(rig.step([0.3, 0, 0]).velocity, [0.3, 0.0, 0.0])
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 4
    assert rig.diagnosed("commands", "refused") == 0


def test_a_command_from_before_a_reset_is_forgotten(harness: Harness) -> None:
    rig = Rig(harness)
    rig.pause(True)
    rig.send([0.2, 0.0, 0.0])
    harness.settle(rig.probe)
    assert rig.trigger("plant/reset").success
    rig.wait("joint_states", 2)
    # The answer to the state that is shown now.
    rig.send([0.3, 0.0, 0.0])
    harness.settle(rig.probe)
    rig.pause(False)
    np.testing.assert_array_equal(rig.wait("joint_states", 3).velocity, [0.3, 0.0, 0.0])


def test_pause_without_a_command_changes_nothing(harness: Harness) -> None:
    rig = Rig(harness)
    for on in (False, True, True, False, False):
        assert rig.pause(on).success
    joints = rig.step([0.2, 0.0, 0.0])
    assert nanoseconds(joints.header.stamp) == TICK_NS
    harness.settle(rig.probe)
    assert rig.probe.count("joint_states") == 2
