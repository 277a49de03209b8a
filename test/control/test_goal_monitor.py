"""The goal monitor: each decision, and numbers that agree with compiled symbols."""

from __future__ import annotations

import dataclasses

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.goal_monitor import AUTOMATIC_TIME_LIMIT, Decision, GoalMonitor
from spacerobot_ros.control.reference import OutputErrors

CONFIG = dataclasses.replace(
    ControllerConfig(),
    settle_time=0.3,
    time_limit=1.0,
    position_tolerance=0.02,
    attitude_tolerance=0.03,
    joint_tolerance=0.05,
)
WITHIN, ASTRAY = OutputErrors(0.02, 0.03, 0.05), OutputErrors(0.02, 0.031, 0.05)


def decisions(
    states: list[tuple[float, OutputErrors, float, float]],
    config: ControllerConfig = CONFIG,
    ends: float = 0.0,
) -> list[int]:
    """Return the decision at each state of (at rest, errors, rate share, error share)."""
    monitor, found = GoalMonitor(), []
    for tick, (at_rest, errors, rate, error) in enumerate(states):
        found.append(int(monitor.decide(0.1 * tick, at_rest, ends, errors, rate, error, config)))
    return found


def test_a_goal_is_reached_after_the_settling_time_within_all_tolerances() -> None:
    found = decisions([(1.0, ASTRAY, 0.0, 0.0), *[(1.0, WITHIN, 0.0, 0.0)] * 4])
    assert found == [0, 0, 0, 0, Decision.REACHED]
    moving = decisions([(0.0, WITHIN, 0.0, 0.0)] * 5)
    assert moving == [0] * 5
    again = [(1.0, WITHIN, 0.0, 0.0)] * 3
    assert decisions([*again, (1.0, ASTRAY, 0.0, 0.0), *again])[-1] == Decision.NONE
    at_once = dataclasses.replace(CONFIG, settle_time=0.0)
    assert decisions([(1.0, WITHIN, 0.0, 0.0)], at_once) == [Decision.REACHED]


@pytest.mark.parametrize("kind", ["position", "attitude", "joints"])
def test_each_kind_has_its_own_tolerance(kind: str) -> None:
    beyond = dataclasses.replace(WITHIN, **{kind: getattr(WITHIN, kind) + 1e-6})
    at_once = dataclasses.replace(CONFIG, settle_time=0.0)
    assert decisions([(1.0, beyond, 0.0, 0.0)], at_once) == [Decision.NONE]


def test_a_goal_fails_at_its_time_limit_unless_it_is_reached_then() -> None:
    assert decisions([(1.0, ASTRAY, 0.0, 0.0)] * 11) == [0] * 10 + [Decision.FAILED]
    last = [(1.0, ASTRAY, 0.0, 0.0)] * 7 + [(1.0, WITHIN, 0.0, 0.0)] * 4
    assert decisions(last)[-1] == Decision.REACHED


def test_without_a_time_limit_a_goal_fails_300_s_after_the_end_of_its_reference() -> None:
    automatic = dataclasses.replace(CONFIG, time_limit=0.0)
    found = decisions([(1.0, ASTRAY, 0.0, 0.0)] * 3030, automatic, ends=2.5)
    assert found == [0] * 3025 + [Decision.FAILED] * 5


def test_the_time_limit_counts_from_the_beginning_of_the_goal_and_not_through_jumps() -> None:
    monitor = GoalMonitor()
    monitor.begin(5.0)
    assert monitor.decide_by_errors(5.9, 1.0, 5.0, ASTRAY, CONFIG) == Decision.NONE
    monitor.decide_by_errors(5.95, 1.0, 5.0, WITHIN, CONFIG)
    monitor.shift_time(100.0)
    assert monitor.decide_by_errors(105.9, 1.0, 105.0, WITHIN, CONFIG) == Decision.NONE, (
        "it settles anew"
    )
    assert monitor.decide_by_errors(106.0, 1.0, 105.0, ASTRAY, CONFIG) == Decision.FAILED


@pytest.mark.parametrize(("rate", "error"), [(1.51, 0.0), (0.0, 1.01)])
def test_control_is_lost_in_the_third_consecutive_state(rate: float, error: float) -> None:
    bad, good = (1.0, WITHIN, rate, error), (1.0, ASTRAY, 1.5, 1.0)
    assert decisions([bad, bad, good, bad, bad, bad]) == [0, 0, 0, 0, 0, Decision.LOST]


def test_a_new_goal_forgets_errors_and_not_joints_that_are_too_fast() -> None:
    monitor = GoalMonitor()
    for _ in range(2):
        assert not monitor.check_errors(2.0)
        assert not monitor.check_rates(2.0)
    monitor.begin(1.0)
    assert not monitor.check_errors(2.0)
    assert monitor.check_rates(2.0)


@pytest.mark.parametrize("limit", [1.0, 0.0])
def test_symbols_give_the_decisions_of_numbers(limit: float) -> None:
    """As SIMD lanes compile it: memory in, memory and decision out."""
    config, ends = dataclasses.replace(CONFIG, time_limit=limit), 1.0 - AUTOMATIC_TIME_LIMIT
    memory, state = ca.SX.sym("memory", 4), ca.SX.sym("state", 7)
    monitor = GoalMonitor(*ca.vertsplit(memory))
    time, at_rest, *errors, rate, error = ca.vertsplit(state)
    decision = monitor.decide(time, at_rest, ends, OutputErrors(*errors), rate, error, config)
    after = ca.vertcat(*dataclasses.astuple(monitor))
    function = ca.Function("monitor", [memory, state], [after, decision])
    rng = np.random.default_rng(7)
    seen = set()
    for _ in range(60):
        numbers, symbols = GoalMonitor(), np.array(dataclasses.astuple(GoalMonitor()))
        bad, lost = rng.uniform(0.0, 0.2), int(rng.integers(5, 20))
        for tick in range(14):
            sizes = [*(rng.uniform(0.5, 1.0, 3) * [0.02, 0.03, 0.05]), *rng.uniform(0, [1.5, 1])]
            values = np.array(sizes) * np.where(rng.uniform(size=5) < bad, 2.5, 1.0)
            if tick >= lost:
                values[3:] = [1.6, 0.9] if lost % 2 else [1.4, 1.1]
            rest = float(tick > 2)
            position, attitude, joints, rate_, error_ = values.tolist()
            found = numbers.decide(
                0.1 * tick,
                rest,
                ends,
                OutputErrors(position, attitude, joints),
                rate_,
                error_,
                config,
            )
            symbols, other = function(symbols, [0.1 * tick, rest, *values])
            assert int(found) == int(other)
            np.testing.assert_array_equal(symbols.full()[:, 0], dataclasses.astuple(numbers))
            seen.add(Decision(int(found)))
    assert seen == set(Decision)
