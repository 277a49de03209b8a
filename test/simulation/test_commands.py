"""The rules for commands without ROS: each reason to refuse one, what is in force, what latches."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from support.wheels import wheeled_robot

from spacerobot_ros.errors import CommandError, ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator, Reason, Refusal
from spacerobot_ros.simulation.config import PlantConfig

SECOND = 10**9
TICK = 50_000_000
SLIDERS = SpaceRobot.from_file(robot_file("sliding_masses"))
ARM = SpaceRobot.from_file(robot_file("three_joint_arm"))
FAST = np.array([0.1, 0.2, -0.3])


class Rig:
    """A plant and its commands in one time mode."""

    def __init__(self, robot: SpaceRobot = SLIDERS, **parameters: Any) -> None:
        self.config = PlantConfig(**{"time_mode": "lockstep", **parameters})
        self.plant = build_plant(robot, self.config)
        self.commands = CommandValidator(self.plant, self.config)
        self.joints: CommandSource = self.commands.sources[0]

    def offer(
        self, stamp_ns: int, now_ns: int, values: npt.NDArray[np.float64] | CommandError = FAST
    ) -> Refusal | None:
        return self.commands.accept_or_refuse(self.joints, stamp_ns, values, now_ns)

    def reason(self, *args: Any) -> Reason:
        refusal = self.offer(*args)
        assert refusal is not None
        assert self.commands.counts[refusal.reason] > 0
        return refusal.reason

    def in_force(self) -> list[float]:
        return list(self.commands.begin_step()[0])


def real_time(**parameters: Any) -> Rig:
    return Rig(time_mode="realtime", command_timeout=0.5, **parameters)


def test_a_tick_is_answered_once_and_by_its_own_stamp() -> None:
    rig = Rig()
    assert not rig.commands.complete
    assert rig.offer(TICK, TICK) is None
    assert rig.commands.complete
    assert rig.reason(TICK, TICK, -FAST) is Reason.STALE, "it has been answered"
    assert rig.in_force() == list(FAST)
    assert not rig.commands.complete, "the next tick wants a command of its own"
    assert rig.reason(TICK, 2 * TICK) is Reason.STALE
    assert rig.reason(3 * TICK, 2 * TICK) is Reason.EARLY
    assert rig.reason(2 * TICK + 1, 2 * TICK) is Reason.EARLY
    assert not rig.commands.complete, "commands of other ticks answer nothing"
    assert rig.commands.counts == {Reason.STALE: 2, Reason.EARLY: 2}


def test_a_tick_takes_no_second_command_also_after_a_bad_one() -> None:
    rig = Rig(beyond_limits="refuse")
    assert rig.reason(0, 0, np.array([0.0, 0.0, -9.0])) is Reason.BEYOND_LIMITS
    assert rig.reason(0, 0, FAST) is Reason.STALE
    assert rig.in_force() == [0.0, 0.0, 0.0]
    assert rig.offer(TICK, TICK, FAST) is None
    assert rig.reason(TICK, TICK, -FAST) is Reason.STALE
    assert rig.in_force() == list(FAST)


def test_beyond_the_limits_is_for_the_plant_to_clip_unless_it_is_refused() -> None:
    assert Rig().offer(0, 0, np.array([0.0, 0.0, -9.0])) is None
    limit = np.array(SLIDERS.velocity_limit)
    assert Rig(beyond_limits="refuse").offer(0, 0, -limit) is None


def test_real_time_refuses_what_is_old_early_or_out_of_order() -> None:
    rig, now = real_time(), 10 * SECOND
    assert rig.reason(now - SECOND, now) is Reason.STALE
    assert rig.reason(now + SECOND, now) is Reason.EARLY
    assert rig.offer(now, now) is None
    assert rig.reason(now - TICK, now) is Reason.OUT_OF_ORDER
    assert rig.offer(now, now, -FAST) is None, "one commander may correct itself"
    rig.joints.commanders = 2
    refusal = rig.offer(now, now)
    assert refusal is not None
    assert refusal.reason is Reason.SECOND_COMMANDER
    assert refusal.latches, "by default"
    latched = Refusal(Reason.LATCHED, f"the plant is latched: {rig.commands.fault}")
    assert rig.offer(now + TICK, now + TICK) == latched


@pytest.mark.parametrize("timeout", [0.5, 0.0])
@pytest.mark.parametrize("ahead_ns", [2_000, TICK, 493_000_000, SECOND, 2_000_000_000 * SECOND])
def test_a_stamp_ahead_of_the_plant_is_refused_however_old_commands_may_be(
    timeout: float, ahead_ns: int
) -> None:
    rig, now = Rig(time_mode="realtime", command_timeout=timeout), 10 * SECOND
    assert rig.reason(now + ahead_ns, now) is Reason.EARLY
    assert not rig.commands.in_force
    assert rig.offer(now, now) is None, "it does not lock others out"
    assert rig.commands.counts == {Reason.EARLY: 1}


def test_a_stamp_between_two_states_is_refused() -> None:
    rig, now = real_time(), 10 * SECOND
    for offset in (TICK // 2, 7_000_000, 2_000, TICK - 2_000):
        assert rig.reason(now - offset, now) is Reason.UNKNOWN_STATE
    assert not rig.commands.in_force


@pytest.mark.parametrize("tick_rate", [20.0, 3.0, 1000.0])
def test_a_stamp_that_went_through_floating_point_is_that_of_its_state(tick_rate: float) -> None:
    rig = real_time(tick_rate=tick_rate)
    period = rig.config.period_ns
    for tick in (1_000, 1_001, 77_777, 3_000_000):
        stamp = int(tick * period / SECOND * 1e9)
        for off in (-900, -1, 0, 1, 900):
            assert rig.offer(stamp + off, tick * period) is None
            assert rig.joints.stamp_ns == tick * period
    # Rounding away from the plant's time is that of this state, and not of the next one.
    assert rig.reason((tick + 1) * period, tick * period) is Reason.EARLY


@pytest.mark.parametrize("ahead_ns", [-2 * TICK, 0, 493_000_000])
def test_of_two_that_send_by_turns_the_second_never_moves_a_joint(ahead_ns: int) -> None:
    rig = real_time()
    rig.joints.commanders = 2
    for tick in range(200, 240):
        now = tick * TICK
        assert rig.offer(now, now) is None
        assert rig.offer(now + ahead_ns, now, -FAST) is not None
        if ahead_ns == 0:
            assert rig.commands.fault_reason == "second_commander"
            assert not rig.commands.in_force
            assert rig.reason(now + TICK, now + TICK) is Reason.LATCHED
            return
        assert rig.in_force() == list(FAST)


def test_where_it_does_not_latch_the_second_commander_is_counted_and_refused() -> None:
    rig = real_time(latched_faults="")
    rig.joints.commanders = 2
    for tick in range(200, 225):
        assert rig.offer(tick * TICK, tick * TICK) is None
        assert rig.reason(0, tick * TICK, -FAST) is Reason.SECOND_COMMANDER, "now is that state"
        assert rig.in_force() == list(FAST)
    assert rig.commands.fault == ""
    assert rig.commands.counts[Reason.SECOND_COMMANDER] == 25


def test_commanders_that_hand_over_or_are_started_again_are_no_second_ones() -> None:
    # The middleware counts a killed publisher for some time.
    rig = real_time()
    rig.joints.commanders = 2
    for tick in range(200, 240):
        assert rig.offer(tick * TICK, tick * TICK, FAST if tick // 10 % 2 else -FAST) is None


def test_commands_from_before_a_start_a_reset_or_a_fault_are_refused() -> None:
    rig, now = real_time(), 10 * SECOND
    assert rig.offer(now, now) is None
    rig.commands.revoke_before(now + TICK)
    assert rig.reason(now, now + TICK) is Reason.STALE
    assert rig.offer(now + TICK, now + TICK) is None
    rig.commands.latch("abort", "aborted on request", now + TICK)
    rig.commands.rearm()
    assert rig.reason(now + TICK, now + 2 * TICK) is Reason.STALE, "sent before the abort"
    assert rig.offer(0, now + 2 * TICK) is None, "an unset stamp means now"
    assert rig.offer(now + 2 * TICK, now + 2 * TICK) is None


def test_in_lockstep_what_was_sent_before_a_fault_is_a_tick_at_rest() -> None:
    rig = Rig()
    rig.commands.latch("abort", "aborted on request", TICK)
    rig.commands.rearm()
    assert rig.reason(TICK, TICK) is Reason.STALE
    assert rig.commands.complete, "time goes on"
    assert rig.in_force() == [0.0, 0.0, 0.0]
    assert rig.offer(2 * TICK, 2 * TICK) is None


def test_two_commanders_may_be_accepted() -> None:
    rig, now = real_time(second_commander="accept"), 10 * SECOND
    rig.joints.commanders = 2
    assert rig.offer(now, now) is None
    assert rig.offer(now, now, -FAST) is None
    assert rig.in_force() == list(-FAST)


def test_an_unset_stamp_means_now() -> None:
    rig, now = real_time(), 10 * SECOND
    assert rig.offer(now - TICK, now) is None
    assert rig.offer(0, now) is None
    assert rig.joints.stamp_ns == now
    # At the start it is the stamp of the first state.
    for timeout in (0.5, 0.0):
        early = Rig(time_mode="realtime", command_timeout=timeout)
        assert early.offer(0, TICK) is None
        assert early.joints.stamp_ns == 0


def test_commands_are_taken_and_hold_until_they_are_older_than_the_timeout() -> None:
    period = 1_000_000
    rig, now = real_time(tick_rate=SECOND / period), 10 * SECOND
    assert rig.commands.drop_old(now) == [], "there has been none"
    assert rig.offer(now - SECOND // 2, now) is None
    assert rig.reason(now - SECOND // 2 - period, now) is Reason.STALE
    assert rig.commands.drop_old(now) == []
    assert rig.in_force() == list(FAST)
    assert rig.commands.drop_old(now + 1) == [rig.joints]
    assert rig.in_force() == [0.0, 0.0, 0.0]
    assert rig.commands.drop_old(now + SECOND) == [], "it is counted once"
    assert (rig.commands.timeouts, rig.commands.timed_out) == (1, True)
    assert rig.commands.last_stamp_ns == now - SECOND // 2
    for_ever = Rig(time_mode="realtime", command_timeout=0.0)
    assert for_ever.offer(1, now) is None
    assert for_ever.commands.drop_old(10**18) == []


def test_a_latched_fault_refuses_everything_until_it_is_rearmed() -> None:
    rig = Rig(latched_faults="not_finite stale")
    bad = np.full(3, np.nan)
    refusal = rig.offer(0, 0, bad)
    assert refusal is not None
    assert refusal.latches
    assert "not finite" in rig.commands.fault
    rig.commands.begin_step()
    assert rig.reason(TICK, TICK) is Reason.LATCHED
    assert rig.in_force() == [0.0, 0.0, 0.0]
    again = rig.offer(2 * TICK, 2 * TICK, bad)
    assert again is not None
    assert again.reason is Reason.NOT_FINITE
    assert not again.latches, "the first fault stays"
    first = rig.commands.fault
    assert rig.commands.rearm() == first
    assert rig.commands.rearm() == ""
    rig.commands.begin_step()
    assert rig.offer(3 * TICK, 3 * TICK) is None


def test_the_first_of_several_latched_faults_is_the_one_shown() -> None:
    rig = Rig(latched_faults="not_finite malformed")
    rig.commands.latch("abort", "An operator has aborted.", 0)
    rig.commands.latch("watchdog", "A joint is too hot.", 0)
    assert rig.reason(0, 0, np.full(3, np.nan)) is Reason.NOT_FINITE
    assert rig.commands.fault == "An operator has aborted."
    assert rig.commands.fault_reason == "abort"
    assert rig.commands.rearm() == "An operator has aborted."
    rig.commands.latch("watchdog", "A joint is too hot.", 0)
    assert rig.commands.fault == "A joint is too hot."


def test_latching_takes_back_what_was_accepted_in_the_same_tick() -> None:
    rig = Rig(ARM, actuation="effort", latched_faults="malformed")
    wrench = rig.commands.sources[1]
    assert rig.commands.accept_or_refuse(wrench, 0, np.ones(6), 0) is None
    assert rig.reason(0, 0, CommandError("a joint is missing")) is Reason.MALFORMED
    assert rig.commands.complete
    assert not rig.commands.begin_step()[1].any()


def test_an_unknown_reason_to_latch_is_refused() -> None:
    with pytest.raises(ParameterError, match="'latched_faults' has 'bad_luck'"):
        Rig(latched_faults="stale bad_luck")


def test_a_wrench_is_waited_for_only_while_somebody_publishes_it() -> None:
    rig = Rig(ARM, actuation="effort")
    joints, wrench = rig.commands.sources
    joints.commanders = wrench.commanders = 0
    assert rig.commands.accept_or_refuse(wrench, 0, np.ones(6), 0) is None
    rig.commands.require_commanded()
    assert (joints.required, wrench.required) == (True, False)
    assert not rig.commands.begin_step()[1].any(), "nobody is left who could end the thrust"
    wrench.commanders = 1
    rig.commands.require_commanded()
    assert wrench.required


def test_motors_brake_and_leave_the_momenta() -> None:
    rig = Rig(ARM, actuation="effort", tick_rate=100.0, initial_joint_velocities=(0.2, -0.3, 0.25))
    momenta = rig.plant.momentum[:6].copy()
    assert not rig.commands.begin_step()[0].any(), "nobody has commanded it to rest yet"
    rig.commands.rest()
    for _ in range(200):
        rig.plant.step(*rig.commands.begin_step())
    assert np.abs(rig.plant.qdot).max() < 1e-9
    np.testing.assert_allclose(rig.plant.momentum[:6], momenta, atol=1e-12)


@pytest.mark.parametrize("tick_rate", [4.0, 10.0, 35.0])
def test_slow_plants_brake_without_a_joint_turning_back(tick_rate: float) -> None:
    """Efforts are held over a tick: half of a rate a tick is what they may take."""
    rates = (0.2, -0.3, 0.25)
    rig = Rig(ARM, actuation="effort", tick_rate=tick_rate, initial_joint_velocities=rates)
    rig.commands.rest()
    before = rig.plant.qdot.copy()
    for _ in range(20):
        rig.plant.step(*rig.commands.begin_step())
        share = rig.plant.qdot / before
        assert np.all((share > 0.3) & (share < 0.7)), share
        before = rig.plant.qdot.copy()
    assert np.abs(before).max() < 1e-5


@pytest.mark.parametrize(
    ("stamp", "now", "clause"),
    [
        (3.15, 7.4, "it is stale: stamped 3.15 s, while the plant is at 7.4 s"),
        (7.45, 7.4, "it is ahead of time: stamped 7.45 s, while the plant is at 7.4 s"),
    ],
)
def test_in_lockstep_a_refusal_names_both_times(stamp: float, now: float, clause: str) -> None:
    assert clause_of(Rig(), stamp, now) == clause


@pytest.mark.parametrize(
    ("stamp", "now", "clause"),
    [
        (6.65, 7.4, "it is 0.75 s old"),
        (7.65, 7.4, "it is 0.25 s ahead of time"),
        (7.12, 7.4, "it is stamped 7.12 s, but state stamps are multiples of 0.05 s"),
    ],
)
def test_in_real_time_a_refusal_says_how_far_off_it_is(
    stamp: float, now: float, clause: str
) -> None:
    rig = real_time()
    assert clause_of(rig, stamp, now) == clause
    assert rig.offer(round(7.4 * SECOND), round(7.4 * SECOND)) is None
    assert clause_of(rig, 7.15, 7.4) == "it is 0.25 s older than the active command"
    rig.joints.commanders = 3
    same = "a command for the same state is active, and 3 nodes send commands"
    assert clause_of(rig, 7.4, 7.4) == same
    assert rig.commands.fault == f"a command on 'joint_commands' was refused: {same}"


def clause_of(rig: Rig, stamp: float, now: float) -> str:
    refusal = rig.offer(round(stamp * SECOND), round(now * SECOND))
    assert refusal is not None
    return refusal.clause


def test_a_stamp_is_rounded_by_a_microsecond_and_no_further() -> None:
    rig, now = real_time(), 10 * SECOND
    for off in (1000, -1000):
        assert rig.offer(now - TICK + off, now) is None
        assert rig.joints.stamp_ns == now - TICK
        rig.joints.rest()
        assert rig.reason(now - TICK + off + off // 1000, now) is Reason.UNKNOWN_STATE


def test_a_limit_is_named_beside_what_is_beyond_it() -> None:
    refusal = Rig(beyond_limits="refuse").offer(0, 0, np.array([0.0, 0.5, -9.0]))
    assert refusal is not None
    limits = SLIDERS.velocity_limit.tolist()
    assert refusal.clause == f"[0.0, 0.5, -9.0] exceeds the limits {limits}"


def test_wheels_keep_their_rates_where_commands_end_until_a_reset() -> None:
    robot = wheeled_robot()
    rig = Rig(robot, time_mode="realtime", command_timeout=0.5, tick_rate=20.0)
    spin = [30.0, -20.0, 0.3, 10.0]
    assert rig.offer(0, 0, np.array(spin)) is None
    rig.plant.step(*rig.commands.begin_step())
    assert rig.commands.drop_old(SECOND)
    rig.plant.step(*rig.commands.begin_step())
    np.testing.assert_allclose(rig.plant.qdot, [30.0, -20.0, 0.0, 10.0], err_msg="the elbow rests")
    rig.commands.latch("abort", "somebody aborted", SECOND)
    assert rig.in_force() == [30.0, -20.0, 0.0, 10.0]
    rig.commands.reset(SECOND)
    assert rig.in_force() == [0.0] * 4
