"""Options with a number a joint that are given by the names of joints."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from spacerobot_ros.campaign.targets import _list_values
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.common.ros_parameters import _ros_parameter
from spacerobot_ros.parameters import Parameter, configured, declared, values_of
from spacerobot_ros.planning.methods.optimal.joint_efforts import LimitedEfforts
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits, OptimalOptions
from spacerobot_ros.planning.methods.remaining_joints import _options_of_remaining
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario

ARM = SpaceRobot.from_file(robot_file("three_joint_arm"))
FIRST, SECOND, THIRD = ARM.joint_names


def option(name: str) -> Parameter:
    return next(each for each in declared(OptimalOptions) if each.name == name)


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"a": 1, "b": 0.25}, ("a:1.0", "b:0.25")),
        (["a:1", "b: 0.25"], ("a:1.0", "b:0.25")),
        ("b:0.25; a:1e-3", ("b:0.25", "a:0.001")),
        (("b:0.25",), ("b:0.25",)),
        ([0.5, 2], (0.5, 2.0)),
        (["0.5", "2"], (0.5, 2.0)),
        ([], ()),
    ],
)
def test_values_by_name_become_texts(given: Any, expected: tuple[Any, ...]) -> None:
    declaration = option("max_velocity")
    assert declaration.by_name
    assert declaration.checked(given) == expected
    assert declaration.checked(expected) == expected


@pytest.mark.parametrize(
    "given",
    [["a:1", "2"], ["a:1", 2.0], "text", ["a:x"], {"a": "x"}, {"a": [1]}, ["a:1", "a:2"]],
)
def test_other_values_are_refused(given: Any) -> None:
    with pytest.raises(ParameterError, match="must be a list of numbers"):
        option("max_velocity").checked(given)


def test_the_refusal_of_a_text_names_both_forms() -> None:
    with pytest.raises(ParameterError, match="numbers, or of texts NAME:VALUE with names of joint"):
        option("joint_margin").checked("text")


@pytest.mark.parametrize("value", [-1.0, 1e10, float("nan")])
def test_numbers_by_name_keep_their_range(value: float) -> None:
    with pytest.raises(ParameterError, match=r"finite numbers from 0 to 1e\+09"):
        option("max_acceleration").checked({"a": value})


def test_lists_without_names_of_joints_take_numbers_alone() -> None:
    assert not option("keep_out").by_name
    with pytest.raises(ParameterError, match=r"it must be a list of numbers \(m or rad\)\.$"):
        option("keep_out").checked({"a": 1.0})


def test_limits_are_given_by_name_and_others_stay() -> None:
    slow = {"max_velocity": {THIRD: 0.125}, "max_acceleration": {SECOND: 0.0625, FIRST: 0.5}}
    limits = MotionLimits.of(ARM, configured(OptimalOptions, {**slow, "ramp_time": 0.25}))
    first, second, _ = ARM.velocity_limit
    assert limits.velocity.tolist() == [first, second, 0.125]
    assert limits.acceleration.tolist() == [0.5, 0.0625, 0.125 / 0.25]


def test_a_faster_velocity_than_that_of_the_robot_is_not_taken() -> None:
    limits = MotionLimits.of(ARM, configured(OptimalOptions, {"max_velocity": {FIRST: 1e3}}))
    assert limits.velocity.tolist() == ARM.velocity_limit.tolist()


def test_efforts_are_given_by_name_and_others_stay() -> None:
    options = configured(OptimalOptions, {"max_effort": {SECOND: 0.375}, "effort_limits": 1})
    efforts = LimitedEfforts.of(ARM, options, 0.05)
    assert efforts is not None
    expected = ARM.effort_limit.copy()
    expected[1] = 0.375
    np.testing.assert_allclose(efforts.limit, 0.85 * expected)


@pytest.mark.parametrize("name", ["max_velocity", "max_acceleration"])
def test_an_unknown_joint_is_refused(name: str) -> None:
    with pytest.raises(ParameterError) as refusal:
        MotionLimits.of(ARM, configured(OptimalOptions, {name: {f"{FIRST}x": 1.0}}), "planned")
    assert str(refusal.value) == (
        f"planned.{name} names '{FIRST}x', which is no joint of robot 'three_joint_arm'; its "
        f"joints are {FIRST}, {SECOND}, {THIRD}. Did you mean '{FIRST}'?"
    )


def test_options_of_stuck_joints_are_left_out_by_name() -> None:
    options = configured(OptimalOptions, {"max_velocity": {THIRD: 0.1, FIRST: 0.2}})
    kept = _options_of_remaining(options, np.array([True, False, False]), ARM.joint_names)
    assert kept.max_velocity == (f"{THIRD}:0.1",)


def test_options_by_name_are_ros_parameters_of_texts() -> None:
    declaration = option("max_velocity")
    assert _ros_parameter(declaration, (0.5,)).type_.name == "DOUBLE_ARRAY"
    named = _ros_parameter(declaration, ("a:0.5",))
    assert (named.type_.name, named.value) == ("STRING_ARRAY", ["a:0.5"])


def test_options_by_name_are_not_dispersed() -> None:
    scenario = load_scenario("sliding_masses").with_overrides(
        "planner", {"optimal.max_velocity": {"slider_2": 0.1}}
    )
    assert values_of(scenario.planner)["optimal.max_velocity"] == ("slider_2:0.1",)
    declaration = Parameter("optimal.max_velocity", ())
    with pytest.raises(ParameterError, match="the list has texts NAME:VALUE: give a number for ea"):
        _list_values("n", "planner", declaration, scenario)
