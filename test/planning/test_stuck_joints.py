"""Stuck joints are found, and others are not taken for stuck."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.planning.execution.tracker import StuckJointWatch

Array = npt.NDArray[np.float64]

TICK = 0.05
NEEDED = 20
GAIN = 2.0


def ramp(time: float) -> Array:
    return np.array([0.1 * time, -0.05 * time, 0.0])


def swing(time: float) -> Array:
    """Return a gait of small circles, as sliders go round: amplitude 0.02."""
    return 0.02 * np.array([np.sin(2 * np.pi * time), np.cos(2 * np.pi * time) - 1.0, 0.0])


def watched(
    gait: Callable[[float], Array],
    follows: Callable[[float], Any],
    *,
    seconds: float = 60.0,
    noise: float = 0.0,
    band: float = 0.0,
    least: int = NEEDED,
) -> dict[int, float]:
    """Fly a gait with the planner's feedback; return when which joint was found stuck, s.

    ``follows`` tells, at a time, which share of its commanded velocity each joint does.
    """
    watch = StuckJointWatch(3, least, TICK, band)
    rng = np.random.default_rng(7)
    q = np.zeros(3)
    found: dict[int, float] = {}
    for tick in range(round(seconds / TICK)):
        time = tick * TICK
        measured = q + noise * rng.standard_normal(3)
        wanted = gait(time)
        error = wanted - measured
        error -= np.clip(error, -band / 2, band / 2)
        velocity = (gait(time + TICK) - wanted) / TICK + GAIN * error
        for joint in watch.find_stuck(measured, wanted, velocity):
            found.setdefault(joint, time)
        q += np.asarray(follows(time)) * velocity * TICK
    return found


def from_time(begin: float, joint: int, share: float = 0.0) -> Callable[[float], Array]:
    """Return that one joint does only a share of what it is told from a time on."""
    sound, broken = np.ones(3), np.ones(3)
    broken[joint] = share
    return lambda time: broken if time >= begin else sound


@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("joint", [0, 1])
def test_a_stuck_joint_is_found_soon(gait: Callable[[float], Array], joint: int) -> None:
    found = watched(gait, from_time(10.0, joint))
    assert list(found) == [joint]
    assert NEEDED * TICK <= found[joint] - 10.0 <= 3 * NEEDED * TICK


def test_two_stuck_joints_are_both_found() -> None:
    assert set(watched(ramp, lambda _: [0.0, 0.0, 1.0])) == {0, 1}


@pytest.mark.slow
@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("share", [0.1, 0.3, 0.8])
def test_a_slow_joint_is_not_stuck(gait: Callable[[float], Array], share: float) -> None:
    assert watched(gait, from_time(5.0, 0, share), seconds=200.0) == {}


def test_a_joint_that_is_not_commanded_is_not_stuck() -> None:
    assert watched(ramp, from_time(0.0, 2)) == {}


@pytest.mark.slow
@pytest.mark.parametrize("gait", [ramp, swing])
@pytest.mark.parametrize("band", [0.0, 8e-3])
def test_noise_makes_no_joint_stuck(gait: Callable[[float], Array], band: float) -> None:
    assert watched(gait, lambda _: np.ones(3), noise=1e-3, band=band, seconds=300.0) == {}


@pytest.mark.parametrize("band", [0.0, 8e-3])
def test_a_stuck_joint_is_found_in_noise(band: float) -> None:
    found = watched(ramp, from_time(10.0, 0), noise=1e-3, band=band)
    assert list(found) == [0]
    assert found[0] < 20.0


def found_at(goes: Callable[[int], float], ticks: int = 10 * NEEDED) -> int | None:
    """Return the tick at which the first joint is found stuck, counted from the first one watched.

    It is commanded 1 mm a tick and goes, from tick 0, as the function of the tick says (mm); the
    second joint follows.
    """
    watch = StuckJointWatch(3, NEEDED, TICK)
    velocity = np.array([1e-3, 1e-3, 0.0]) / TICK
    for tick in range(-15, ticks):
        q = np.array([goes(max(tick, 0)), tick, 0.0]) * 1e-3
        wanted = np.array([tick + 30.0, tick + 1e-3, 0.0]) * 1e-3
        stuck = watch.find_stuck(q, wanted, velocity)
        assert stuck in ([], [0])
        if stuck:
            return tick + 1
    return None


def test_noise_that_hides_a_stuck_joint_for_a_while_does_not_hide_it_for_ever() -> None:
    """Noise of a tenth of the way is not following: twice the way is waited for, then more."""
    assert found_at(lambda _: 0.0) == NEEDED
    assert found_at(lambda tick: 0.09 * NEEDED * (tick % 2)) == 2 * NEEDED
    assert found_at(lambda tick: 0.19 * NEEDED * (tick % 2)) == 4 * NEEDED


def test_what_a_slow_joint_has_gone_counts_until_it_has_followed() -> None:
    """One that stops after a while is compared with all the way since it was last seen to follow:
    slow until then, it is given longer; having followed, it is not."""
    for share, found in ((0.18, 4), (0.45, 16), (0.55, 2)):
        assert found_at(lambda tick, s=share: s * min(tick, NEEDED), 20 * NEEDED) == found * NEEDED  # type: ignore[misc]


def test_nobody_looks_when_told_not_to() -> None:
    assert watched(ramp, from_time(0.0, 0), least=0) == {}


@pytest.mark.parametrize("gait", [ramp, swing])
def test_commands_that_do_not_arrive_for_a_while_jam_no_joint(
    gait: Callable[[float], Array],
) -> None:
    def away(time: float) -> float:
        return 0.0 if 10.0 <= time < 10.0 + 4 * NEEDED * TICK else 1.0

    assert not watched(gait, away)


@pytest.mark.parametrize("gait", [ramp, swing])
def test_joints_that_never_follow_again_are_found_in_the_end(
    gait: Callable[[float], Array],
) -> None:
    found = watched(gait, lambda time: 0.0 if time >= 10.0 else 1.0)
    assert set(found) == {0, 1}
    assert 10.0 + 4 * NEEDED * TICK < min(found.values()) < 10.0 + 20 * NEEDED * TICK


@pytest.mark.parametrize("commanded_too", [0.05, 0.0])
@pytest.mark.parametrize("jump", [0.0, 0.004, 0.02])
def test_a_plant_that_is_restarted_and_gets_no_commands_yet_has_no_stuck_joint(
    jump: float, commanded_too: float
) -> None:
    """It resumes at an earlier state, where one joint was elsewhere: that is no motion."""
    watch = StuckJointWatch(3, NEEDED, TICK)
    velocity, q = np.array([0.05, 0.05, commanded_too]), np.zeros(3)
    for tick in range(7 * NEEDED):
        if tick == NEEDED:
            q = np.array([0.0, -jump, 0.0])
        assert watch.find_stuck(q, velocity * (tick + 1) * TICK, velocity) == [], tick
