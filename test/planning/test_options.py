"""Options of the gait methods: unknown ones and numbers out of range are refused by name."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from support.effort_flights import robot_of

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import Parameter, declared
from spacerobot_ros.planning import METHODS, RobotState, Tolerance, plan
from spacerobot_ros.resources import share_directory

ARM = (share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8")
OPTIONED = [name for name, method in METHODS.items() if declared(method.Options)]
NUMBERS = [
    (name, option)
    for name in OPTIONED
    for option in declared(METHODS[name].Options)
    if not isinstance(option.default, str)
]


@pytest.mark.parametrize("method", OPTIONED)
def test_an_option_that_no_method_has_is_refused(method: str) -> None:
    with pytest.raises(ParameterError, match=rf"^{method} has no option 'thrust'\.$"):
        plan(robot_of(ARM), method=method, thrust=1.0)


@pytest.mark.parametrize(
    ("method", "option"), [pytest.param(*x, id=f"{x[0]}.{x[1].name}") for x in NUMBERS]
)
def test_numbers_out_of_range_are_refused(method: str, option: Parameter) -> None:
    for number in (option.minimum - 1.0, option.maximum * 2 + 1.0, math.nan):
        value = [number] if isinstance(option.default, tuple) else number
        options: dict[str, Any] = {option.name: value}
        with pytest.raises(ParameterError, match=f"'{option.name}' is .* it must be "):
            plan(robot_of(ARM), method=method, **options)


def test_a_call_without_ros_checks_its_options_too() -> None:
    with pytest.raises(
        ParameterError, match=r"'starts' is 0; it must be a number from 1 to 10000\."
    ):
        plan("sliding_masses", starts=0)
    with pytest.raises(ParameterError, match="auto has no option 'starts'"):
        plan("sliding_masses", method="auto", starts=3)


def test_a_start_has_a_position_for_every_joint_and_a_method_is_one_of_the_registry() -> None:
    with pytest.raises(ParameterError, match=r"start has 2 joint position\(s\); .* has 3 joints"):
        plan(robot_of(ARM), start=(0.1, 0.2))
    with pytest.raises(ParameterError, match="no gait method 'magic'; there are: lie_bracket, "):
        plan(robot_of(ARM), method="magic")


def test_a_start_is_a_shape_or_a_state_and_otherwise_the_shape_nearest_to_zero() -> None:
    robot = SpaceRobot.from_urdf(
        ARM.replace('lower="-2.9" upper="0.4"', 'lower="-2.9" upper="-0.1"')
    )
    options: dict[str, Any] = {"method": "area_loop", "joint_positions": (0.0, -0.5, 1.0)}
    loose: dict[str, Any] = {"tolerance": Tolerance(9.0, 3.0, 1e-6)}
    np.testing.assert_array_equal(plan(robot, **options, **loose).positions[0], [0.0, -0.1, 0.0])
    shape = (0.2, -0.3, 0.4)
    np.testing.assert_array_equal(plan(robot, start=shape, **options, **loose).positions[0], shape)
    turned = np.array([0.0, 0.0, 0.6, 0.8])
    state = RobotState(np.array([1.0, 2.0, 3.0]), turned, np.array(shape))
    path = plan(robot, start=state, **options, **loose).path
    np.testing.assert_allclose(path.position[0], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(path.quaternion[0], turned)


def test_a_goal_shape_may_lie_beyond_a_limit_by_rounding_alone() -> None:
    loose: dict[str, Any] = {
        "method": "area_loop",
        "tolerance": Tolerance(9.0, 3.0, 1e-6),
        "start": (0.0, 0.3, 0.0),
    }
    schedule = plan(robot_of(ARM), joint_positions=(0.0, 0.4 + 1e-10, 0.5), **loose)
    assert schedule.positions[-1].tolist() == [0.0, 0.4, 0.5]
    with pytest.raises(PlanningError, match=r"'shoulder_pitch' at 0\.41 rad"):
        plan(robot_of(ARM), joint_positions=(0.0, 0.41, 0.5), **loose)
