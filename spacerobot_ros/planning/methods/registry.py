"""Methods by name; a new method needs one file and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured, require_known
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.methods.area_loop import AreaLoopGait
from spacerobot_ros.planning.methods.auto import AutoGait
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.resolved_rate import ResolvedRateGait
from spacerobot_ros.planning.methods.square_path import SquarePathGait
from spacerobot_ros.registry import Registry

METHODS: Registry[GaitMethod] = Registry(
    "gait method",
    "spacerobot_ros.gait_methods",
    GaitMethod,
    (
        # Specialised methods come first: `auto` takes the first of equally long manoeuvres.
        LieBracketGait,
        SquarePathGait,
        AreaLoopGait,
        OptimalGait,
        ResolvedRateGait,
        AutoGait,
    ),
)


def build_method(
    name: str,
    robot: SpaceRobot,
    control_period: float,
    integration_step: float,
    options: Mapping[str, Any],
    clearance: Clearance | None = None,
) -> GaitMethod:
    """Return a method for a robot; ``options`` contains instances of ``Options`` by method.

    A method without an entry uses its defaults. Schedules keep the clearance, if given.

    Raises
    ------
    KeyError
        There is no such method.
    ParameterError
        An option is incompatible with the robot or with another option.
    """
    method = METHODS[name]
    if method is not AutoGait:
        return method(robot, control_period, integration_step, options.get(name), clearance)
    return AutoGait(
        robot,
        control_period,
        integration_step,
        candidates={other: each for other, each in METHODS.items() if each is not AutoGait},
        build=lambda other: build_method(
            other, robot, control_period, integration_step, options, clearance
        ),
    )


def method_options(name: str, values: Mapping[str, Any]) -> Any:
    """Return a method's ``Options`` from values by name, with defaults for missing names.

    Raises
    ------
    ParameterError
        There is no such method or option, or a value is invalid.
    """
    if name not in METHODS:
        raise ParameterError(
            f"There is no gait method '{name}'; the methods are: {', '.join(METHODS)}."
        )
    require_known(name, METHODS[name].Options, values)
    return configured(METHODS[name].Options, values)


# Last: a plugin may import this module.
METHODS.load()
