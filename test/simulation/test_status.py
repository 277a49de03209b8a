"""What a plant reports of itself, and who drives its time."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import PLANTS, build_plant
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.status import PlantMonitor, PlantState, PlantStatus
from spacerobot_ros.simulation.time_modes import RealTime

SECOND = 10**9
SLIDERS = SpaceRobot.from_file(robot_file("sliding_masses"))
FAST = np.array([0.1, 0.2, -0.3])


class Rig:
    """A plant, its commands and what follows them."""

    def __init__(self, time_mode: str = "realtime", **parameters: Any) -> None:
        config = PlantConfig(time_mode=time_mode, command_timeout=0.5, **parameters)
        self.plant = build_plant(SLIDERS, config)
        self.commands = CommandValidator(self.plant, config)
        self.monitor = PlantMonitor(self.commands, self.plant, config)
        self.now = 0

    def events(self, activity: PlantState = PlantState.RUNNING) -> list[EventKind]:
        """Update at this moment; what is true already is never reported again."""
        events = self.monitor.update(activity, self.now / SECOND)
        assert all(event.time_s == self.now / SECOND for event in events)
        assert self.monitor.update(activity, self.now / SECOND + 1.0) == []
        return [event.kind for event in events]

    @property
    def state(self) -> tuple[PlantState, str]:
        return self.monitor.status.state, self.monitor.status.reason

    def command(self) -> None:
        assert (
            self.commands.accept_or_refuse(self.commands.sources[0], self.now, FAST, self.now)
            is None
        )


def test_a_plant_in_real_time_rests_until_commanded_and_again_when_commands_are_old() -> None:
    rig = Rig()
    assert rig.events() == [EventKind.RESTING]
    assert rig.state == (PlantState.RESTING, "no_command")
    assert rig.monitor.status.level == 0
    rig.now = SECOND
    rig.command()
    assert rig.events() == [EventKind.RUNNING]
    assert rig.state == (PlantState.RUNNING, "")
    rig.now = 2 * SECOND
    rig.commands.drop_old(rig.now)
    assert rig.events() == [EventKind.RESTING]
    assert rig.state == (PlantState.RESTING, "timeout")
    assert rig.monitor.status.level == 1
    assert rig.monitor.status.time_s == 2.0
    rig.commands.rest()
    assert rig.events() == [EventKind.RESTING], "another reason"
    assert rig.state == (PlantState.RESTING, "no_command")


def test_a_latched_fault_shows_in_every_state() -> None:
    rig = Rig()
    rig.command()
    rig.events()
    rig.commands.latch("abort", "aborted on request", rig.now)
    assert rig.events() == [EventKind.LATCHED]
    assert rig.state == (PlantState.LATCHED, "abort")
    rig.commands.latch("watchdog", "a second fault", rig.now)
    assert rig.events() == [], "the first one stays"
    assert rig.events(PlantState.PAUSED) == [EventKind.PAUSED]
    assert rig.state == (PlantState.PAUSED, "abort")
    assert rig.monitor.status.latched_fault == "aborted on request"
    assert rig.monitor.status.level == 2
    assert rig.events(PlantState.INACTIVE) == []
    assert rig.state == (PlantState.INACTIVE, "abort")
    assert rig.events() == []
    assert rig.state == (PlantState.LATCHED, "abort")
    rig.commands.rearm()
    rig.monitor.rearms += 1
    assert rig.events() == [EventKind.REARMED, EventKind.RESTING]
    assert rig.monitor.status.rearms == 1
    assert rig.monitor.status.latched_fault == ""


def test_a_fault_that_latches_while_time_stands_still_is_reported_at_once() -> None:
    rig = Rig()
    rig.events(PlantState.PAUSED)
    rig.commands.latch("abort", "aborted on request", rig.now)
    assert rig.events(PlantState.PAUSED) == [EventKind.LATCHED]
    assert rig.state == (PlantState.PAUSED, "abort")
    message = "Time is stopped until it is resumed, and a fault is latched: aborted on request."
    assert rig.monitor.status.message == message, "names no service, for the page has a button"
    assert rig.events() == [EventKind.RESUMED]
    assert rig.state == (PlantState.LATCHED, "abort")


def test_a_reset_is_reported_even_where_the_state_stays() -> None:
    rig = Rig("lockstep")
    rig.events()
    rig.monitor.resets += 1
    assert rig.events() == [EventKind.RESET]
    assert rig.monitor.status.resets == 1


def test_faults_begin_and_end_one_by_one() -> None:
    rig = Rig("lockstep", faults=("joint_slow slider_1 0.5 at 0 until 0.1",))
    assert rig.events() == [EventKind.FAULT_INJECTED, EventKind.RUNNING]
    assert len(rig.monitor.status.faults) == 1
    rig.plant.inject("joint_stuck slider_2\njoint_slow slider_3 0.25")
    assert rig.events() == [EventKind.FAULT_INJECTED] * 2
    rig.plant.step(FAST)
    rig.plant.step(FAST)
    assert rig.events() == [EventKind.FAULT_ENDED]
    assert list(rig.monitor.status.faults) == [
        "joint_stuck slider_2 at 0",
        "joint_slow slider_3 0.25 at 0",
    ]
    rig.plant.inject("clear")
    assert rig.events() == [EventKind.FAULT_ENDED] * 2 + [EventKind.FAULTS_CLEARED]
    assert not rig.monitor.status.faults


@pytest.mark.parametrize("state", PlantState)
def test_a_status_survives_its_message(state: PlantState) -> None:
    status = PlantStatus(
        state, "Why.", "abort", "aborted on request", 1.25, 3, 4, ("a at 0", "b at 1 until 2")
    )
    assert PlantStatus.from_values(status.to_values(), "Why.") == status
    assert PlantStatus.from_values(PlantStatus(state).to_values()) == PlantStatus(state)


@pytest.mark.parametrize("values", [{}, {"state": "asleep"}, {"state": "paused", "resets": "x"}])
def test_what_is_no_status_is_refused(values: dict[str, str]) -> None:
    with pytest.raises(SpaceRobotError, match="No status of a plant"):
        PlantStatus.from_values(values)


def test_the_stamp_of_the_last_command_is_exact_also_after_a_long_time() -> None:
    rig = Rig()
    rig.now = 4_000_000 * SECOND + 50_000_000
    rig.events()
    rig.command()
    assert rig.monitor.status.last_command_s is None
    rig.now += SECOND
    rig.commands.drop_old(rig.now)
    rig.events()
    assert rig.monitor.status.last_command_s == 4_000_000.05
    assert rig.monitor.status.timeouts == 1
    assert rig.monitor.status.time_s == 4_000_001.05


@pytest.mark.parametrize("state", list(PlantState))
@pytest.mark.parametrize("faults", [(), ("joint_stuck slider_1",), ("a", "b")])
@pytest.mark.parametrize(("reason", "latched"), [("", ""), ("timeout", ""), ("abort", "abort")])
def test_a_status_is_ok_only_without_faults_timeouts_and_latches(
    state: PlantState, faults: tuple[str, ...], reason: str, latched: str
) -> None:
    status = PlantStatus(state, reason=reason, latched_fault=latched, faults=faults)
    stopped = state in (PlantState.LATCHED, PlantState.FAILED) or bool(latched)
    assert status.level == (2 if stopped else 1 if faults or reason == "timeout" else 0)
    assert PlantStatus.from_values(status.to_values()).level == status.level


# -- the bookkeeping of a plant in real time ----------------------------------------------------


MS = 1_000_000


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


# -- plants from their configuration: which steps are refused, and what the steps do -------------


ARM = SpaceRobot.from_file(robot_file("three_joint_arm"))


def config(**parameters: Any) -> PlantConfig:
    return PlantConfig(**{"tick_rate": 10.0, **parameters})


@pytest.mark.parametrize("step", [0.9e-5, 1e-300])
def test_steps_that_lose_more_than_they_gain_are_refused(step: float) -> None:
    with pytest.raises(ParameterError, match=r"must be 0 .* or at least 1e-05 s"):
        build_plant(ARM, config(integration_step=step))


def test_more_steps_in_a_tick_than_anybody_waits_for_are_refused() -> None:
    with pytest.raises(ParameterError, match=r"more than 1e\+06 steps in a tick of 10.1 s"):
        build_plant(ARM, config(tick_rate=1 / 10.1, integration_step=1e-5))


def test_steps_of_the_configuration_are_taken() -> None:
    """One Runge-Kutta step of half a second is off by its fifth power; shorter ones are not."""
    ends = {}
    for step in (0.0, 0.5, 0.25, 0.01):
        plant = build_plant(
            ARM, config(tick_rate=2.0, integration_step=step, angular_momentum=(30.0, -50.0, 40.0))
        )
        for _ in range(4):
            plant.step(np.array([0.4, -0.3, 0.45]))
        ends[step] = plant.pose[3:].copy()
    exact = ends[0.01]
    errors = {step: float(np.abs(end - exact).max()) for step, end in ends.items()}
    assert errors[0.5] > 4 * errors[0.25] > 4e-9
    assert errors[0.0] < errors[0.25], "the default is a short step"


def test_thrusters_need_a_plant_that_takes_a_wrench() -> None:
    assert {name: kind.takes_wrench for name, kind in PLANTS.items()} == {
        "velocity": False,
        "effort": True,
    }
    with pytest.raises(ParameterError, match="has no base wrench"):
        build_plant(ARM, config(actuation="velocity", thrusters="urdf"))
