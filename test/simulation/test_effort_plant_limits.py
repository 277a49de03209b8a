"""The plant under efforts: clipped commands, start and reset, refusals."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.effort_flights import random_urdf, robot_of, thrusts, tumbling, with_effort_limit

from spacerobot_ros.errors import CommandError, ParameterError, SpaceRobotError
from spacerobot_ros.simulation import EffortPlant

TICK = 0.01


def test_efforts_are_clipped_and_counted() -> None:
    urdf = with_effort_limit(random_urdf(0), 0.5)
    limited, plant = (EffortPlant(robot_of(text), TICK) for text in (urdf, random_urdf(0)))
    assert limited.step([0.5, -2.0, math.sqrt(2)], [1, 2, 3, 4, 5, 6]) is True
    assert plant.step([0.5, -0.5, 0.5], [1, 2, 3, 4, 5, 6]) is False
    assert limited.effort.tolist() == plant.effort.tolist() == [0.5, -0.5, 0.5]
    assert limited.wrench.tolist() == [1, 2, 3, 4, 5, 6]
    assert limited.qdot.tolist() == plant.qdot.tolist()
    assert limited.step([0.0, -2.0, 0.0]) is True
    assert limited.wrench.tolist() == [0.0] * 6
    assert limited.effort_limited.tolist() == [0, 2, 1]
    assert plant.effort_limited.tolist() == [0, 0, 0]
    assert limited.stroke_limited.tolist() == [0, 0, 0]


def test_no_limit_is_none() -> None:
    urdf = with_effort_limit(random_urdf(0), math.inf)
    plant = EffortPlant(robot_of(urdf), 1e-4)
    assert plant.step([1e6, -1e6, 1e6]) is False
    assert plant.effort.tolist() == [1e6, -1e6, 1e6]


def test_reset_brings_the_same_flight_again() -> None:
    robot = robot_of(random_urdf(2))
    rng = np.random.default_rng(91)
    plant = EffortPlant(robot, TICK, tumbling(robot, rng))
    commands = list(thrusts(rng, robot.n, 20))
    flights = []
    for _ in range(2):
        plant.reset()
        assert plant.effort.tolist() == [0.0] * robot.n
        flights.append([plant.pose.tolist()])
        for effort, wrench in commands:
            plant.step(effort, wrench)
            flights[-1].append(plant.pose.tolist() + plant.momentum.tolist())
    assert flights[0] == flights[1]


def test_start_is_as_given() -> None:
    robot = robot_of(random_urdf(3))
    start = tumbling(robot, np.random.default_rng(95))
    plant = EffortPlant(robot, TICK, start)
    np.testing.assert_allclose(plant.pose[:3], start.position, atol=1e-14)
    assert plant.q.tolist() == np.asarray(start.joint_positions).tolist()
    assert plant.qdot.tolist() == np.asarray(start.joint_velocities).tolist()
    np.testing.assert_allclose(plant.momentum[:3], start.linear_momentum, atol=1e-13)
    np.testing.assert_allclose(plant.momentum[3:6], start.angular_momentum, atol=1e-13)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_commands_that_are_not_finite_are_refused(bad: float) -> None:
    plant = EffortPlant(robot_of(random_urdf(0)), TICK)
    plant.step([0.1, 0.2, -0.1], [0.3, 0, 0, 0, 0, 0.1])
    before = plant.pose.tolist() + plant.momentum.tolist()
    for effort, wrench in (([0.1, bad, 0.1], np.zeros(6)), (np.zeros(3), [0, 0, bad, 0, 0, 0])):
        with pytest.raises(CommandError, match="not finite"):
            plant.step(effort, wrench)
        assert plant.pose.tolist() + plant.momentum.tolist() == before
        assert plant.effort.tolist() == [0.0] * 3
    plant.step([0.1, 0.2, -0.1])
    assert np.all(np.isfinite(plant.pose))
    assert plant.effort_limited.tolist() == [0, 0, 0]


def test_commands_of_the_wrong_length_are_refused() -> None:
    plant = EffortPlant(robot_of(random_urdf(0)), TICK)
    with pytest.raises(ValueError, match="could not broadcast"):
        plant.step([0.1, 0.2])
    with pytest.raises(ValueError, match="could not broadcast"):
        plant.step([0.1, 0.2, 0.3], [1, 2, 3])


def test_a_tick_without_limits_is_taken_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stops are only looked at where a joint touches one: a tick is one compiled function."""
    plant = EffortPlant(robot_of(random_urdf(0)), TICK)
    taken: list[Any] = []
    advance = plant._stops.advance

    def counted(*arguments: Any) -> Any:
        taken.append(arguments)
        return advance(*arguments)

    monkeypatch.setattr(plant._stops, "advance", counted)
    for _ in range(20):
        assert plant.step([0.01, -0.02, 0.01], [0.1, 0, 0, 0, 0, 0]) is False
    assert taken == []
    plant.hold(np.array([False, True, False]))
    plant.step([0.01, -0.02, 0.01])
    assert len(taken) == 1


def test_motion_beyond_numbers_is_refused_and_undone() -> None:
    plant = EffortPlant(robot_of(with_effort_limit(random_urdf(0), math.inf)), TICK)
    before = plant.pose.tolist()
    with pytest.raises(SpaceRobotError, match="no longer finite"):
        plant.step([1e200, 1e200, 1e200])
    assert plant.pose.tolist() == before


@pytest.mark.parametrize("value", [0.0, -1.0, math.nan, math.inf])
def test_durations_must_be_positive(value: float) -> None:
    robot = robot_of(random_urdf(0))
    with pytest.raises(ParameterError, match="control period must be positive"):
        EffortPlant(robot, value)
    with pytest.raises(ParameterError, match="integration step must be positive"):
        EffortPlant(robot, TICK, integration_step=value)
