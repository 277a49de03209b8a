"""Options of the gait methods: unknown ones and numbers out of range are refused by name."""

from __future__ import annotations

import math
from typing import Any

import pytest
from support.effort_flights import robot_of

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.parameters import Parameter, declared
from spacerobot_ros.planning import METHODS, plan
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
