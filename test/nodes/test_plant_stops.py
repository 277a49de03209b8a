"""Goals when the plant does not obey, states of other times, and a plant in real time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.publisher import Publisher
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from support.control_loop import Loop, pose
from support.planner_flight import NEAR, PLANNER, Flight, stamp_of, values_of
from support.plant_rig import BAD_COMMANDS, SLIDERS, TICK, TICK_NS, Rig
from support.ros_harness import LATCHED, Harness, Probe, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.messages.diagnostics import StatusRecord, timing_record
from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.simulation.time_modes import RealTime

REAL_TIME = {"time_mode": "realtime", "real_time_factor": 10.0, "command_timeout": 0.5}
BACKGROUND = {"plan_in_background": True}
OTHER = ([-0.03, 0.0, 0.01], [0.0, 0.0, 0.0])
SLOW = {**PLANNER, "lie_bracket.t1": 4.0}
"""A slide of 4 s."""


def pause(flight: Flight, paused: bool) -> None:
    client = flight.probe.create_client(SetBool, "plant/pause")
    assert flight.harness.call(client, SetBool.Request(data=paused)).success


def place(flight: Flight) -> list[float]:
    return list(flight.probe.last("joint_states").position)


def flies_again(flight: Flight, *states: str) -> None:
    """Check which states there have been, and that the next goal is reached."""
    assert flight.states == list(states)
    flight.decide(NEAR)
    assert flight.states[-1] == "reached"


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_an_abort_of_the_plant_ends_the_goal_until_there_is_another(
    harness: Harness, tmp_path: Path, mode: str
) -> None:
    plant = REAL_TIME if mode == "realtime" else {}
    file = tmp_path / "goal.json"
    flight = Flight(harness, {**SLOW, "resume_file": str(file)}, plant)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(15)
    assert file.exists()
    flight.trigger("plant/abort")
    status = flight.wait("aborted")
    assert_one_sentence(status.message, "Aborted by the plant: stopped on request.")
    assert not file.exists()
    flight.ticks(60)
    rest = place(flight)
    flight.send(OTHER)
    refused = flight.wait("refused")
    assert_one_sentence(refused.message, "'/plant' is latched", "rearm it")
    flight.trigger("plant/rearm")
    # As long as any watch for joints that do not follow could take.
    flight.ticks(60)
    assert place(flight) == rest
    flies_again(flight, "idle", "executing", "aborted", "refused")


def test_a_plant_that_ends_in_flight_is_named(harness: Harness) -> None:
    flight = Flight(harness, {**SLOW, **BACKGROUND}, REAL_TIME)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(10)
    flight.plant.trigger_shutdown()
    status = flight.wait("waiting")
    assert_one_sentence(status.message.removesuffix(" The goal is then pursued."), "has ended")
    flight.planner.trigger_deactivate()
    status = flight.wait("aborted")
    assert_one_sentence(status.message, "deactivated", "the plant, which has ended")


def test_only_the_last_of_the_states_that_wait_is_answered(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a loaded machine the plant makes up for late ticks: that is no jump of its time here.
    monkeypatch.setattr("spacerobot_ros.commanding.plant_state._PACE_SLACK", 1000.0)
    flight = Flight(harness, {**SLOW, **BACKGROUND}, REAL_TIME)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(10)
    seen = stamp_of(flight.probe.last("joint_states"))
    harness.executor.remove_node(flight.planner)
    flight.ticks(12)
    before = flight.probe.count("joint_commands")
    harness.executor.add_node(flight.planner)

    def answered() -> list[int]:
        stamps = [stamp_of(m) for m in flight.probe.messages["joint_commands"][before:]]
        # Answers to earlier states were on their way.
        return [stamp for stamp in stamps if stamp > seen]

    harness.spin_until(lambda: len(answered()) > 2, "commands after a standstill")
    # The last ones may be on their way to the planner still.
    waiting = [s for s in map(stamp_of, flight.probe.messages["joint_states"]) if s > seen]
    assert min(answered()) >= waiting[6]
    assert answered() == sorted(set(answered()))


def test_a_goal_on_file_is_not_resumed_while_the_plant_is_latched(
    harness: Harness, tmp_path: Path
) -> None:
    file = tmp_path / "goal.json"
    file.write_text('{"base": {"position": [0.05, 0, 0], "quaternion": [0, 0, 0, 1], '
                    '"joint_positions": null, "id": "7.000000000"}}')  # fmt: skip
    flight = Flight(harness, {"resume_file": str(file)})
    flight.start()
    flight.trigger("plant/abort")
    flight.planner.trigger_deactivate()
    flight.planner.trigger_activate()
    flight.ticks(5)
    assert not file.exists()
    assert not np.any(place(flight))


# -- statuses of others -----------------------------------------------------------------------


def forged(harness: Harness, name: str) -> tuple[Probe, Publisher]:
    """Return a node that publishes statuses in the name of the plant, and its publisher."""
    forger = harness.probe({}, name=name)
    topic = forger.create_publisher(DiagnosticStatus, "plant/status", LATCHED)
    harness.matched(topic)
    return forger, topic


LATCHED_PLANT = PlantStatus(PlantState.LATCHED, "Nothing moves: a fuse.", "abort", "a fuse")


def message_of(status: PlantStatus) -> bytes:
    return StatusRecord("/plant", status.level, status.message, status.to_values()).encoded()


def test_a_status_of_another_node_stops_nothing_and_is_reported(harness: Harness) -> None:
    flight = Flight(harness, SLOW)
    flight.probe.watch("/rosout", Log, latched=True)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(5)
    pause(flight, True)  # In lockstep the goal may be reached before the forger is connected.
    forger, topic = forged(harness, "forger")
    topic.publish(message_of(LATCHED_PLANT))
    harness.spin_until(
        lambda: any(
            "more publishers than odom" in line.msg for line in flight.probe.messages["/rosout"]
        )
    )
    pause(flight, False)
    flight.ticks(5)
    assert flight.states == ["idle", "executing"]
    pause(flight, True)
    # The plant's own statuses count again, the one that was not heard first, once it is alone.
    flight.trigger("plant/abort")
    harness.remove(forger)
    status = flight.wait("aborted")
    assert_one_sentence(status.message, "stopped on request")
    flight.trigger("plant/rearm")
    pause(flight, False)
    flies_again(flight, "idle", "executing", "aborted")


def test_a_status_of_a_node_that_has_left_locks_nothing(harness: Harness) -> None:
    """It ends the goal if it is heard after its node has left; the plant's last one counts then."""
    flight = Flight(harness, SLOW)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(5)
    harness.executor.remove_node(flight.planner)
    forger, topic = forged(harness, "forger")
    topic.publish(message_of(LATCHED_PLANT))
    harness.remove(forger)
    own = flight.planner.resolve_topic_name("plant/status")
    harness.spin_until(lambda: len(flight.planner.get_publishers_info_by_topic(own)) == 1)
    harness.executor.add_node(flight.planner)
    flight.wait("aborted", "reached")
    plant = flight.planner.commander.plant
    harness.spin_until(lambda: not plant.refusal_of_goals, "the plant's own status")
    flies_again(flight, *flight.states)


HOSTILE = "A fuse: \x1b[2J\x1b]0;title\x07 it is\rblown.\n"
"""Clears the terminal of whoever reads the controller's log."""


@pytest.mark.parametrize(
    "stopped",
    [
        PlantStatus(PlantState.FAILED, HOSTILE, "model"),
        PlantStatus(PlantState.LATCHED, "Nothing moves.", "abort", HOSTILE),
    ],
)
def test_control_characters_of_a_status_reach_no_status_and_no_log(
    harness: Harness, stopped: PlantStatus
) -> None:
    loop = Loop(harness)
    logs = harness.probe({"/rosout": Log}, name="reader")
    topic = loop.probe.create_publisher(DiagnosticStatus, "plant/status", LATCHED)
    harness.matched(topic)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.answer()
    loop.wait_for("tracking")
    topic.publish(message_of(stopped))
    status = loop.wait_for("aborted")
    assert_one_sentence(status.message, "Aborted by the plant: A fuse")
    harness.spin_until(
        lambda: any("blown" in line.msg for line in logs.messages["/rosout"]), "the log of the end"
    )
    texts = [status.message, *(line.msg for line in logs.messages["/rosout"])]
    texts += [text for pair in status.values for text in (pair.key, pair.value)]
    assert all(text.isprintable() for text in texts)


# -- real time ------------------------------------------------------------------------------------


REALTIME = {"time_mode": "realtime", "real_time_factor": 10.0, "command_timeout": 1.0}


def test_time_runs_at_the_real_time_factor(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, "diagnostics_period": 0.0})
    rig.wait("/clock", 20)
    began = rig.probe.count("/clock")
    rig.wait("/clock", began + 120)
    clocks = [nanoseconds(m.clock) / 1e9 for m in rig.probe.messages["/clock"][began:]]
    arrivals = rig.probe.arrivals["/clock"][began:]
    factor = (clocks[-1] - clocks[0]) / (arrivals[-1] - arrivals[0])
    assert 5.0 < factor < 13.0
    np.testing.assert_allclose(np.diff(clocks), TICK)


def test_joints_come_to_rest_when_the_commander_falls_silent(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    stamp = rig.now_ns
    rig.send([0.3, -0.2, 0.1])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion")
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.0, "rest")
    rest = nanoseconds(rig.probe.last("joint_states").header.stamp)
    # A tick carries the command for as long as it is not older than the timeout at its start.
    assert stamp + 1_000_000_000 < rest <= stamp + 1_000_000_000 + 2 * TICK_NS
    moving = [m for m in rig.probe.messages["joint_states"] if any(m.velocity)]
    for message in moving:
        np.testing.assert_array_equal(message.velocity, [0.3, -0.2, 0.1])
    at_rest = rig.probe.last("joint_states")
    np.testing.assert_allclose(
        at_rest.position, np.array([0.3, -0.2, 0.1]) * TICK * len(moving), rtol=1e-12
    )
    rig.wait_for_log("No command on 'joint_commands' for 1 s")
    assert rig.diagnosed("commands", "timeouts") == 1
    # It moves again with the next command, and is counted again.
    rig.send([0.3, 0.0, 0.0])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion again")
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.0, "rest again")
    assert rig.diagnosed("commands", "timeouts") == 2


def test_real_time_holds_the_last_good_command(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, "command_timeout": 0.0})
    rig.send([0.1, 0.0, -0.1])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.1, "motion")
    for count, (velocity, names, reason) in enumerate(BAD_COMMANDS.values(), start=1):
        rig.send(velocity, names)
        rig.wait_for_refusals(count)
        warned = [
            status.message
            for status in rig.probe.diagnoses("plant: commands")
            if status.level == DiagnosticStatus.WARN
        ]
        assert_one_sentence(warned[-1], "refused", reason)
    np.testing.assert_array_equal(rig.probe.last("joint_states").velocity, [0.1, 0.0, -0.1])


@pytest.mark.parametrize("timeout", [1.0, 0.0])
def test_deactivation_stops_time_publication_and_joints(harness: Harness, timeout: float) -> None:
    rig = Rig(harness, {**REALTIME, "command_timeout": timeout})
    rig.send([0.3, 0.0, 0.0])
    harness.spin_until(lambda: rig.probe.last("joint_states").velocity[0] == 0.3, "motion")
    assert rig.plant.trigger_deactivate() is TransitionCallbackReturn.SUCCESS
    harness.settle(rig.probe)
    before, stamp = rig.probe.count("joint_states"), rig.now_ns
    harness.spin_for(0.2)
    assert rig.probe.count("joint_states") == before
    rig.activate()
    rig.wait("joint_states", before + 6)
    states = rig.probe.messages["joint_states"][before:]
    stamps = [nanoseconds(state.header.stamp) for state in states]
    assert stamps[:3] == [stamp, stamp + TICK_NS, stamp + 2 * TICK_NS]
    # The first state is the one that was left.
    assert all(list(state.velocity) == [0.0] * 3 for state in states[1:])


def test_pause_stops_real_time_and_nothing_is_made_up_afterwards(harness: Harness) -> None:
    rig = Rig(harness, REALTIME)
    rig.wait("joint_states", 5)
    rig.pause(True)
    harness.settle(rig.probe)
    before = rig.probe.count("joint_states")
    harness.spin_for(0.2)
    assert rig.probe.count("joint_states") == before
    rig.pause(False)
    rig.wait("joint_states", before + 2)
    assert rig.diagnosed("commands", "deadlines_missed") == 0
    stamps = [nanoseconds(m.header.stamp) for m in rig.probe.messages["joint_states"]]
    assert set(np.diff(stamps)) == {TICK_NS}


def test_a_busy_machine_misses_deadlines_and_no_tick(harness: Harness) -> None:
    rig = Rig(harness, {**REALTIME, "real_time_factor": 100.0})

    def hog(_: Any) -> None:
        del rig.probe.react["odom"]
        began = time.monotonic()
        while time.monotonic() - began < 0.05:
            pass  # 100 ticks of wall time in which no callback runs.

    rig.wait("joint_states", 5)
    rig.probe.react["odom"] = hog
    harness.spin_until(
        lambda: (
            rig.probe.count("/diagnostics")
            and any(
                pair.key == "deadlines_missed" and int(pair.value) >= 50
                for pair in rig.probe.last("/diagnostics").status[0].values
            )
        ),
        "missed deadlines in the diagnostics",
    )
    stamps = [nanoseconds(m.header.stamp) for m in rig.probe.messages["joint_states"]]
    assert set(np.diff(stamps)) == {TICK_NS}


@pytest.mark.parametrize("period", [pytest.param(20.0, marks=pytest.mark.slow), 0.0])
def test_diagnostics_come_once_a_second_whatever_simulated_time_says(
    harness: Harness, period: float
) -> None:
    rig = Rig(harness, {**REALTIME, "real_time_factor": 1.0, "diagnostics_period": period})
    began = time.monotonic()
    rig.wait("/diagnostics", rig.probe.count("/diagnostics") + 4)
    # The first may have waited to be heard; on a busy machine the others may be late, never early.
    assert 1.9 < time.monotonic() - began < 8.0


@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_a_paused_plant_goes_on_to_report(harness: Harness, mode: str) -> None:
    rig = Rig(harness, {**REALTIME, "time_mode": mode, "diagnostics_period": 1000.0})
    status = harness.probe({"plant/status": DiagnosticStatus}, latched=("plant/status",), name="s")
    rig.pause(True)
    harness.settle(rig.probe, status)
    before, states = rig.probe.count("/diagnostics"), rig.probe.count("joint_states")
    assert rig.trigger("plant/abort").success
    harness.spin_until(
        lambda: "stopped on request" in status.last("plant/status").message, "the abort"
    )
    assert status.last("plant/status").level == DiagnosticStatus.ERROR
    rig.wait("/diagnostics", before + 2)
    shown = rig.probe.last("/diagnostics").status[0]
    assert shown.level == DiagnosticStatus.ERROR
    assert "stopped on request" in shown.message
    assert rig.probe.count("joint_states") == states, "time stands still"


def test_commanders_of_a_remapped_topic_are_counted(harness: Harness) -> None:
    remapped = ["--ros-args", "-r", "joint_commands:=/arm/commands"]
    plant = harness.make(PlantNode, {"robot": "sliding_masses", **REALTIME}, cli_args=remapped)
    harness.spin_until(lambda: "no node publishes" in plant.status.message, "that nobody commands")
    harness.matched(harness.probe({}).create_publisher(JointState, "/arm/commands", 10))
    harness.spin_until(lambda: "no node publishes" not in plant.status.message, "the commander")
    assert plant.status.reason == "no_command"


MS = 1_000_000


def test_what_is_late_is_counted_with_the_worst() -> None:
    time = RealTime(10 * MS)
    time.start(0, 0)
    # Ticks are due at 20, 30, 40 ms; the third is taken 4 ms after the fourth is due.
    for tick, now in ((1, 20), (2, 39), (3, 54)):
        time.count_tick(now * MS, tick)
    # The states of 10, 20, 30 ms are to be answered by 20, 30, 40 ms.
    # The first answer to a state counts.
    for now, stamp in ((19, 10), (33, 20), (47, 30), (48, 30)):
        time.count_command(now * MS, stamp * MS)
    status = timing_record("/plant", "robot", time)
    assert status.level == 1
    assert status.values == {
        "tick_rate_Hz": "55.5556",
        "ticks": "3",
        "ticks_late": "1",
        "worst_tick_ms": "4.000",
        "commands": "3",
        "commands_late": "2",
        "worst_command_ms": "7.000",
        "command_age_s": "0",
    }
    assert timing_record("/plant", "robot", time).level == 0, "nothing new is late"


def test_a_plant_in_real_time_tells_its_timing(harness: Harness) -> None:
    given = {"time_mode": "realtime", "diagnostics_period": 0.1, "tick_rate": 50.0}
    rig = Rig(harness, given, activate=False)

    def answer(state: JointState) -> None:
        rig.commands.publish(
            JointState(header=state.header, name=state.name, velocity=[0.01, 0.0, 0.0])
        )

    rig.probe.react["joint_states"] = answer
    rig.activate()
    rig.wait("joint_states", 41)
    rig.plant.trigger_deactivate()
    status = {s.name: values_of(s) for s in rig.probe.last("/diagnostics").status}
    timing = status["plant: timing"]
    ticks = int(timing["ticks"])
    assert 30 <= ticks <= 45
    # Every state is answered, the first one too, whose stamp is zero: nothing is out of order.
    assert status["plant: commands"]["refused"] == "0"
    assert int(timing["commands"]) in (ticks - 2, ticks - 1)
    assert set(status["plant: strokes"]) == set(SLIDERS)
    left = float(status["plant: strokes"]["slider_2"])
    assert left == pytest.approx(rig.plant.plant.robot.upper[1], abs=1e-9), "it has not moved"
