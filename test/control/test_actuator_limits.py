"""Limits of thrusters and joints."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros.control import Actuation, ActuatorLimits
from spacerobot_ros.errors import ParameterError

COMMAND = Actuation(np.array([3.0, 4.0, 12.0, -1.0, 2.0, 2.0]), np.array([5.0, -7.0]))


def test_force_and_torque_keep_their_directions() -> None:
    limits = ActuatorLimits(6.5, 1.5, np.array([6.0, 6.0]))
    saturated = limits.apply(COMMAND)
    wrench = saturated.realised.wrench_B
    np.testing.assert_allclose(wrench[:3], COMMAND.wrench_B[:3] / 2)
    np.testing.assert_allclose(wrench[3:], COMMAND.wrench_B[3:] / 2)
    np.testing.assert_array_equal(saturated.realised.tau, [5.0, -6.0])
    assert saturated.limited
    np.testing.assert_allclose(saturated.excess.wrench_B, COMMAND.wrench_B - wrench)
    np.testing.assert_array_equal(saturated.excess.tau, [0.0, -1.0])


def test_force_and_torque_are_limited_apart() -> None:
    saturated = ActuatorLimits(1.3, np.inf, np.full(2, np.inf)).apply(COMMAND)
    np.testing.assert_allclose(saturated.realised.wrench_B[:3], COMMAND.wrench_B[:3] / 10)
    np.testing.assert_array_equal(saturated.realised.wrench_B[3:], COMMAND.wrench_B[3:])
    np.testing.assert_array_equal(saturated.realised.tau, COMMAND.tau)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_efforts_of_all_joints_beyond_their_limits_are_lowered(sign: float) -> None:
    limits = ActuatorLimits(np.inf, np.inf, np.array([2.0, 3.0]))
    saturated = limits.apply(Actuation(np.zeros(6), sign * np.array([2.5, 7.0])))
    np.testing.assert_array_equal(saturated.realised.tau, [sign * 2.0, sign * 3.0])
    np.testing.assert_array_equal(saturated.excess.tau, [sign * 0.5, sign * 4.0])


@pytest.mark.parametrize("limits", [(13.0, 3.0, 7.0), (np.inf, np.inf, np.inf)])
def test_what_is_possible_passes(limits: tuple[float, float, float]) -> None:
    force, torque, effort = limits
    saturated = ActuatorLimits(force, torque, np.full(2, effort)).apply(COMMAND)
    np.testing.assert_array_equal(saturated.realised.wrench_B, COMMAND.wrench_B)
    np.testing.assert_array_equal(saturated.realised.tau, COMMAND.tau)
    assert not saturated.limited


def test_without_thrusters_or_motors() -> None:
    saturated = ActuatorLimits(0.0, 0.0, np.zeros(2)).apply(COMMAND)
    np.testing.assert_array_equal(saturated.realised.wrench_B, 0.0)
    np.testing.assert_array_equal(saturated.realised.tau, 0.0)
    still = ActuatorLimits(0.0, 0.0, np.zeros(2)).apply(Actuation(np.zeros(6), np.zeros(2)))
    assert not still.limited


@pytest.mark.parametrize(
    ("force", "torque", "effort", "sentence"),
    [
        (-1.0, 1.0, 1.0, "force limit"),
        (1.0, np.nan, 1.0, "torque limit"),
        (1.0, 1.0, -1.0, "effort limits"),
        (1.0, 1.0, np.nan, "effort limits"),
    ],
)
def test_limits_that_are_refused(force: float, torque: float, effort: float, sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        ActuatorLimits(force, torque, np.array([1.0, effort]))
