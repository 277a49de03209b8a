"""Who drives the time: looks of a plant in lockstep, and the bookkeeping of one in real time."""

from __future__ import annotations

import pytest

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.time_modes import Lockstep, RealTime

MS = 1_000_000


def test_a_plant_without_a_pose_steps_at_its_second_look_in_a_tick() -> None:
    config = PlantConfig(time_mode="lockstep")
    plant = build_plant(SpaceRobot.from_file(robot_file("sliding_masses")), config)
    commands = CommandValidator(plant, config)
    for first in (0, 1, 2):
        assert not Lockstep(commands).must_step_at_check(first, pose_lost=True), "its first look"
    time = Lockstep(commands)
    assert not time.may_step
    assert [time.must_step_at_check(3, pose_lost=True), time.waits] == [False, False]
    assert [time.must_step_at_check(3, pose_lost=False), time.waits] == [False, True]
    assert [time.must_step_at_check(3, pose_lost=True), time.waits] == [True, True]
    assert [time.must_step_at_check(4, pose_lost=True), time.waits] == [False, False]
    commands.sources[0].arrived = True
    assert time.may_step
    assert time.must_step_at_check(5, pose_lost=False)


def test_ticks_are_due_by_the_clock_two_at_a_time_and_ten_at_most() -> None:
    time = RealTime(10 * MS, factor=2.0)
    assert time.period == pytest.approx(0.005)
    time.start(1000 * MS, 7)
    # The state of tick 7 is due at 1000 ms, the next ones every 5 ms.
    for now, tick, wanted in (
        (1000, 7, 0),
        (1004, 7, 0),
        (1005, 7, 1),
        (1009, 8, 0),
        (1010, 7, 2),
        (1015, 7, 2),
        (1015, 9, 1),
        (1050, 7, 2),
    ):
        assert time.due_ticks(now * MS, tick) == wanted, (now, tick)
    assert time.ticks_lost == 0
    assert time.due_ticks(1065 * MS, 7) == 2
    assert time.ticks_lost == 3, "13 behind, ten are made up"
    assert time.due_ticks(1065 * MS, 17) == 0
    assert time.due_ticks(1070 * MS, 17) == 1


def test_reports_count_ticks_and_answers_since_the_start_and_the_rate_since_the_last() -> None:
    time = RealTime(10 * MS)
    time.start(0, 0)
    for tick in range(5):
        # After tick k its successor is due at 10 (k + 1) ms, and late from 10 (k + 2) ms on.
        time.count_tick((10 * (tick + 1) + (12 if tick == 3 else 0)) * MS, tick)
    first = time.report()
    assert first.tick_rate == pytest.approx(5 / 0.05)
    assert (first.ticks, first.ticks_late) == (5, 1)
    assert first.worst_tick == pytest.approx(0.002)
    assert first.worse
    time.count_command(45 * MS, 40 * MS)
    time.count_command(46 * MS, 40 * MS)
    time.count_command(66 * MS, 50 * MS)
    for tick in range(5, 9):
        time.count_tick((50 + 20 * (tick - 4)) * MS, tick)
    second = time.report()
    assert second.tick_rate == pytest.approx(4 / 0.08)
    assert second.ticks == 9
    assert (second.commands, second.commands_late) == (2, 1)
    assert second.worst_command == pytest.approx(0.006)
    assert second.command_age == pytest.approx(0.03)
    assert second.worse
    third = time.report()
    assert (third.tick_rate, third.ticks, third.worse) == (0.0, 9, False)
