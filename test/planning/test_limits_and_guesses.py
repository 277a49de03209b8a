"""Limits of joints, constraints on paths, and initial guesses, as functions of numbers alone."""

from __future__ import annotations

import re
from typing import Any

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.methods.optimal.problem import (
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    Trajectory,
)
from spacerobot_ros.resources import robot_file

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("three_joint_arm"))


# -- limits -------------------------------------------------------------------------------------


def test_limits_are_the_robots_narrowed_by_options(arm: SpaceRobot) -> None:
    own = arm.velocity_limit
    plain = MotionLimits.of(arm, OptimalOptions(ramp_time=0.25))
    assert plain.velocity.tolist() == own.tolist()
    assert plain.acceleration == pytest.approx(own * 4.0)
    options = OptimalOptions(
        max_velocity=tuple(own * [0.5, 2.0, 1.0]), max_acceleration=(1.0, 2.0, 3.0)
    )
    found = MotionLimits.of(arm, options)
    assert found.velocity == pytest.approx(own * [0.5, 1.0, 1.0])
    assert found.acceleration.tolist() == [1.0, 2.0, 3.0]
    for wrong, words in (
        ({"max_velocity": (1.0,)}, "1 number(s); robot 'three_joint_arm' has 3 joints ("),
        ({"max_velocity": (1.0, 0.0, 1.0)}, f"'{arm.joint_names[1]}' is limited to 0 a second"),
        ({"max_acceleration": (1.0, 0.0, 1.0)}, "and 0 a second squared; area_loop needs"),
    ):
        with pytest.raises(ParameterError, match=re.escape(words)):
            MotionLimits.of(arm, OptimalOptions(**wrong), "area_loop")


# -- trajectories -------------------------------------------------------------------------------


def parabola(steps: int, acceleration: float, first: float) -> Trajectory:
    """Return constant acceleration of one joint in steps of half a second."""
    time = 0.5 * np.arange(steps + 1.0)[:, np.newaxis]
    shapes = first * time + acceleration * time**2 / 2
    return Trajectory(0.5, shapes, first + acceleration * time, np.tile(IDENTITY, (steps + 1, 1)))


# -- constraints on paths -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"keep_axis": (0.0, 0.0, 2.0)}, "takes all of optimal.keep_axis, optimal.keep_direction"),
        ({"keep_angle": 0.5}, "takes all of optimal.keep_axis"),
        (
            {"keep_axis": (0.0, 0.0, 0.0), "keep_direction": (1.0, 0.0, 0.0), "keep_angle": 0.5},
            "optimal.keep_axis is (0.0, 0.0, 0.0); it must be three numbers, not all zero.",
        ),
        (
            {"keep_axis": (1.0, 0.0, 0.0), "keep_direction": (1.0, 0.0), "keep_angle": 0.5},
            "optimal.keep_direction is (1.0, 0.0); it must be three numbers",
        ),
        (
            {"keep_out": (1.0, 2.0, 3.0)},
            "has 3 numbers; a box of shapes has 3 lower and 3 upper ones.",
        ),
        ({"keep_out": (0.0, 0.0, 0.0, 1.0, 0.0, 1.0)}, "lower bound is not below its upper."),
        ({"keep_out": (-9e6,) * 3 + (9e6,) * 3}, "holds all shapes of the robot."),
    ],
)
def test_constraints_that_make_no_sense_are_refused(
    arm: SpaceRobot, options: dict[str, Any], words: str
) -> None:
    with pytest.raises(ParameterError, match=re.escape(words)):
        PathConstraints.of(arm, OptimalOptions(**options))


def test_no_constraint_is_none(arm: SpaceRobot) -> None:
    none = PathConstraints.of(arm, OptimalOptions())
    assert none.knot_inequality_count == 0
    assert none.symbolic(ca.SX.sym("q", 3), ca.SX.sym("x", 4), ca.SX.sym("d", 3)).shape[0] == 0
    none.check(np.zeros((2, 3)), np.tile(IDENTITY, (2, 1)), 0.5)
    guess = parabola(4, -3.0, 2.0)
    assert none.slowed(guess) is guess
