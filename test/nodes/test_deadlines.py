"""Deadlines of a plant in real time, against a time line written by hand."""

from __future__ import annotations

from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from support.ros_harness import DEEP, Harness

from spacerobot_ros.messages.diagnostics import timing_record
from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.simulation.time_modes import RealTime

MS = 1_000_000


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_what_is_late_is_counted_with_the_worst() -> None:
    time = RealTime(10 * MS)
    time.start(0, 0)
    # Ticks are due at 20, 30, 40 ms; the third is taken 4 ms after the fourth is due.
    for tick, now in ((1, 20), (2, 39), (3, 54)):
        time.count_tick(now * MS, tick)
    # The states of 10, 20, 30 ms are to be answered by 20, 30, 40 ms.
    for now, stamp in ((19, 10), (33, 20), (47, 30)):
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


def test_a_command_in_force_counts_once() -> None:
    time = RealTime(10 * MS)
    time.start(0, 0)
    for now in (15, 18, 95):
        time.count_command(now * MS, 10 * MS)
    timing = time.report()
    assert timing.commands == 1
    assert timing.commands_late == 0


def test_a_late_plant_catches_up_in_small_steps_and_gives_up_what_is_far_behind() -> None:
    time = RealTime(20 * MS, factor=2.0)
    time.start(5 * MS, 100)
    assert time.period == pytest.approx(0.01)
    assert time.due_ticks(14 * MS, 100) == 0
    assert time.due_ticks(16 * MS, 100) == 1
    assert time.due_ticks(46 * MS, 100) == 2, "commands get a word in between"
    # 30 ticks behind, of which 10 are made up: time goes on as if the others had never been due.
    assert time.due_ticks(306 * MS, 100) == 2
    assert time.ticks_lost == 20
    assert [time.due_ticks(306 * MS, tick) for tick in (108, 109, 110)] == [2, 1, 0]
    assert time.due_ticks(316 * MS, 110) == 1
    assert time.ticks_lost == 20


def real_time_plant(harness: Harness, **parameters: Any) -> PlantNode:
    return harness.make(
        PlantNode,
        {"robot": "sliding_masses", "diagnostics_period": 0.1, "tick_rate": 50.0, **parameters},
        autostart=False,
    )


def test_a_plant_in_real_time_tells_its_timing(harness: Harness) -> None:
    plant = real_time_plant(harness)
    assert plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
    probe = harness.probe({"/diagnostics": DiagnosticArray, "joint_states": JointState})
    commands = probe.create_publisher(JointState, "joint_commands", DEEP)

    def answer(state: JointState) -> None:
        commands.publish(
            JointState(header=state.header, name=state.name, velocity=[0.01, 0.0, 0.0])
        )

    probe.react["joint_states"] = answer
    harness.connect()
    plant.trigger_activate()
    harness.spin_until(lambda: probe.count("joint_states") > 40, "forty ticks")
    plant.trigger_deactivate()
    status = {s.name: values(s) for s in probe.last("/diagnostics").status}
    timing = status["plant: timing"]
    ticks = int(timing["ticks"])
    assert 30 <= ticks <= 45
    # Every state is answered, the first one too, whose stamp is zero: nothing is out of order.
    assert status["plant: commands"]["refused"] == "0"
    assert int(timing["commands"]) in (ticks - 2, ticks - 1)
    assert set(status["plant: strokes"]) == set(plant.plant.robot.joint_names)
    left = float(status["plant: strokes"]["slider_2"])
    assert left == pytest.approx(plant.plant.robot.upper[1], abs=1e-9), "it has not moved"


def test_lockstep_has_no_deadlines(harness: Harness) -> None:
    plant = real_time_plant(harness, time_mode="lockstep")
    assert plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
    probe = harness.probe({"/diagnostics": DiagnosticArray})
    harness.connect()
    plant.trigger_activate()
    harness.spin_until(lambda: probe.count("/diagnostics"), "the first diagnostics")
    assert not any("timing" in s.name for s in probe.last("/diagnostics").status)
