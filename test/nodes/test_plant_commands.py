"""Commands of a plant: taken, limited, refused, and latched."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from support.bad_commands import BAD_COMMANDS
from support.odometry import pose_of, twist_of
from support.plant_rig import SLIDERS, STATE, TICK, TICK_NS, Rig
from support.ros_harness import Harness, construction, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.simulation.status import PlantState

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


REALTIME = {"time_mode": "realtime", "real_time_factor": 10.0, "command_timeout": 0.0}
ARM = ["joint_1", "joint_2", "joint_3"]


def velocity(rig: Rig) -> float:
    return float(rig.probe.last("joint_states").velocity[0])


def wait_for_velocity(rig: Rig, wanted: float) -> None:
    rig.harness.spin_until(lambda: velocity(rig) == wanted, f"a velocity of {wanted} m/s")


def started(rig: Rig) -> int:
    """Return the time of a state after the first: a stamp of zero is none."""
    rig.harness.spin_until(lambda: rig.now_ns > 0, "a second state")
    return rig.now_ns


def assert_nothing_moves(rig: Rig, states: int = 5) -> None:
    before = rig.probe.count("joint_states")
    rig.wait("joint_states", before + states)
    assert not any(any(m.velocity) for m in rig.probe.messages["joint_states"][before + 1 :])


def assert_state(rig: Rig, state: PlantState) -> None:
    assert rig.plant.state is state


def test_a_command_older_than_the_one_in_force_is_refused(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    stamp = started(rig)
    harness.spin_until(lambda: rig.now_ns > stamp, "a third state")
    rig.send([0.1, 0.0, 0.0], stamp_ns=stamp + TICK_NS)
    wait_for_velocity(rig, 0.1)
    rig.send([0.3, 0.0, 0.0], stamp_ns=stamp)
    rig.wait_for_log("0.05 s older than the one in force")
    rig.wait_for_refusals(1)
    assert rig.diagnosed("commands", "refused.out_of_order") == 1
    assert velocity(rig) == 0.1


def test_a_second_commander_latches_a_fault_until_it_is_rearmed(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    intruder = harness.probe({}, name="intruder")
    other = intruder.create_publisher(JointState, "joint_commands", 100)
    harness.connect()
    stamp = started(rig)
    rig.send([0.1, 0.0, 0.0], stamp_ns=stamp)
    wait_for_velocity(rig, 0.1)
    # Until the plant has counted its commanders, a repeated stamp is one commander's own.
    rig.harness.spin_until(
        lambda: (other.publish(command_at(stamp)), rig.diagnosed("commands", "refused"))[1],
        "a refusal",
    )
    wait_for_velocity(rig, 0.0)
    status = rig.diagnosis("commands")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "rearm", "answered before", "2 nodes")
    rig.send([0.2, 0.0, 0.0])
    rig.wait_for_refusals(int(rig.diagnosed("commands", "refused")))
    assert_nothing_moves(rig)
    assert "answered before" in rig.trigger("plant/rearm").message
    rig.send([0.2, 0.0, 0.0])
    wait_for_velocity(rig, 0.2)


@pytest.mark.parametrize("ahead_s", [0.493, 0.0, -0.1])
def test_a_second_one_that_sends_by_turns_moves_nothing(harness: Harness, ahead_s: float) -> None:
    """If it answers the states that are answered already, the plant latches a fault."""
    rig = Rig(harness, {**REALTIME, "command_timeout": 0.5, "real_time_factor": 1.0})
    rogue = harness.probe({}, name="rogue")
    other = rogue.create_publisher(JointState, "joint_commands", 100)
    harness.connect()
    started(rig)
    # The first answers every state, the second one in eight of them.
    rig.probe.react["joint_states"] = lambda _: rig.send([0.0, 0.0, 0.0])

    def intrude(state: JointState) -> None:
        answer(state)
        if rig.probe.count("joint_states") % 8 == 0:
            message = command_at(rig.now_ns + round(ahead_s * 1e9))
            message.velocity = [0.3, 0.0, 0.0]
            other.publish(message)

    answer = rig.probe.react["joint_states"]
    rig.probe.react["joint_states"] = intrude
    rig.wait_for_refusals(1)
    if ahead_s == 0.0:
        harness.spin_until(lambda: rig.plant.state is PlantState.LATCHED, "a latched fault")
        assert rig.plant.status.reason == "second_commander"
    assert_nothing_moves(rig)
    moved = sum(any(m.velocity) for m in rig.probe.messages["joint_states"])
    assert moved <= 2


@pytest.mark.parametrize("timeout", [0.0, 1.0])
def test_a_stamp_ahead_of_time_never_moves_a_joint(harness: Harness, timeout: float) -> None:
    rig = Rig(harness, {**REALTIME, "command_timeout": timeout})
    stamp = started(rig)
    for count, ahead in enumerate((2 * 10**9, 3600, 100), 1):
        rig.send([0.3, 0.3, 0.3], stamp_ns=(stamp // 10**9 + ahead) * 10**9)
        rig.wait_for_refusals(count)
    assert rig.diagnosed("commands", "refused.early") == 3
    assert_nothing_moves(rig, 15)
    rig.send([0.2, 0.0, 0.0])
    wait_for_velocity(rig, 0.2)


def command_at(stamp_ns: int) -> JointState:
    message = JointState(name=["slider_1", "slider_2", "slider_3"], velocity=[0.1, 0.0, 0.0])
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
    return message


def test_two_commanders_may_be_accepted(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, "second_commander": "accept"})
    intruder = harness.probe({}, name="intruder")
    other = intruder.create_publisher(JointState, "joint_commands", 100)
    harness.connect()
    stamp = started(rig)
    rig.send([0.3, 0.0, 0.0], stamp_ns=stamp)
    wait_for_velocity(rig, 0.3)
    other.publish(command_at(stamp))
    wait_for_velocity(rig, 0.1)
    assert rig.diagnosed("commands", "refused") == 0


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_abort_holds_everything_until_rearm(harness: Harness, mode: str) -> None:
    rig = Rig(harness, {**REALTIME, "time_mode": mode})
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.3)
    assert_state(rig, PlantState.RUNNING)
    assert rig.trigger("plant/abort").success
    assert_state(rig, PlantState.LATCHED)
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.0)
    status = rig.diagnosis("commands")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "stopped on request")
    rig.pause(True)
    assert_state(rig, PlantState.PAUSED)
    rig.pause(False)
    assert_state(rig, PlantState.LATCHED)
    assert "stopped" in rig.trigger("plant/rearm").message
    # In real time no command is in force yet; lockstep waits for one.
    assert_state(rig, PlantState.RUNNING if mode == "lockstep" else PlantState.RESTING)
    rig.send([0.3, 0.0, 0.0])
    wait_for_velocity(rig, 0.3)
    assert "No fault" in rig.trigger("plant/rearm").message
    rig.plant.trigger_deactivate()
    assert_state(rig, PlantState.INACTIVE)


@pytest.mark.parametrize(
    ("reason", "command"),
    [("not_finite", [float("nan"), 0.0, 0.0]), ("malformed", [0.1, 0.1])],
)
def test_chosen_reasons_latch(harness: Harness, reason: str, command: list[float]) -> None:
    rig = Rig(harness, {"latched_faults": "not_finite malformed"})
    assert rig.step([0.2, 0.0, 0.0]).velocity[0] == 0.2
    assert not any(rig.step(command).velocity)
    assert rig.diagnosed("commands", f"refused.{reason}") == 1
    assert not any(rig.step([0.2, 0.0, 0.0]).velocity)
    assert rig.diagnosed("commands", "refused.latched") == 1
    rig.trigger("plant/rearm")
    assert rig.step([0.2, 0.0, 0.0]).velocity[0] == 0.2


def test_commands_beyond_limits_may_be_refused_as_a_whole(harness: Harness) -> None:
    rig = Rig(harness, {"beyond_limits": "refuse"})
    assert not any(rig.step([0.1, 0.71, 0.0]).velocity)
    status = rig.diagnosis("commands")
    assert_one_sentence(status.message, "0.71", "beyond the limits", "0.7")
    assert rig.diagnosed("commands", "refused.beyond_limits") == 1
    assert list(rig.step([0.1, 0.7, 0.0]).velocity) == [0.1, 0.7, 0.0]


def test_an_unknown_reason_to_latch_is_refused(ros_context: rclpy.Context) -> None:
    given = {"robot": "sliding_masses", "latched_faults": "stale bad_luck"}
    with pytest.raises(SpaceRobotError) as refusal:
        PlantNode(**construction(ros_context, given))
    assert_one_sentence(str(refusal.value), "'latched_faults'", "bad_luck", "stale")


ARM_MOVES = {
    "robot": "three_joint_arm",
    "actuation": "effort",
    "tick_rate": 100.0,
    "initial_joint_velocities": [0.2, -0.3, 0.25],
}


def rates(rig: Rig) -> Any:
    return np.abs(np.array(rig.probe.last("joint_states").velocity))


@pytest.mark.slow
def test_motors_bring_the_joints_to_rest_when_their_commander_falls_silent(
    harness: Harness,
) -> None:
    rig = Rig(harness, {**REALTIME, **ARM_MOVES, "real_time_factor": 2.0, "command_timeout": 0.5})
    momentum = np.array(rig.wait("momentum", 1).data[:6])
    assert rates(rig).max() > 0.2
    names = list(rig.probe.last("joint_states").name)
    effort = JointState(name=names, effort=[0.0, 0.0, 0.0])
    rig.commands.publish(effort)
    rig.wait_for_log("No command on 'joint_commands' for 0.5 s")
    stopped = rig.now_ns
    harness.spin_until(lambda: rates(rig).max() < 1e-4, "rest")
    assert rig.now_ns - stopped < 1_000_000_000
    # What brakes is inside the robot: the momenta are what they were.
    np.testing.assert_allclose(rig.probe.last("momentum").data[:6], momentum, atol=1e-9)


@pytest.mark.slow
def test_a_latched_fault_ends_thrust_and_brakes_joints(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, **ARM_MOVES, "real_time_factor": 2.0})
    thrust = rig.probe.create_publisher(WrenchStamped, "base_wrench", 10)
    harness.connect()
    push = WrenchStamped()
    push.wrench.force.x = 10.0
    thrust.publish(push)
    names = list(rig.probe.last("joint_states").name)
    rig.commands.publish(JointState(name=names, effort=[0.0, 0.0, 0.0]))
    rig.wait("momentum", 1)
    harness.spin_until(lambda: rig.probe.last("momentum").data[0] > 1.0, "thrust")
    rig.trigger("plant/abort")
    harness.spin_until(lambda: rates(rig).max() < 1e-4, "rest")
    given = np.array(rig.probe.last("momentum").data[:3])
    before = rig.probe.count("momentum")
    rig.wait("momentum", before + 20)
    np.testing.assert_allclose(rig.probe.last("momentum").data[:3], given, rtol=1e-9)
