"""The methods by name: a new one is one file and one line here."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.methods.area_loop import AreaLoopGait
from spacerobot_ros.planning.methods.auto import AutoGait, Candidate
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.square_path import SquarePathGait

METHODS: dict[str, type[GaitMethod]] = {
    # In the order in which `auto` tries them: those made for a kind of robot first.
    LieBracketGait.name: LieBracketGait,
    SquarePathGait.name: SquarePathGait,
    AreaLoopGait.name: AreaLoopGait,
    OptimalGait.name: OptimalGait,
    AutoGait.name: AutoGait,
}


def build_method(
    name: str,
    robot: SpaceRobot,
    tick_period: float,
    tolerance: Tolerance,
    integration_step: float,
    options: Mapping[str, Any],
) -> GaitMethod:
    """Return a method for a robot; ``options`` are keyed ``<method>.<option>``.

    Raises
    ------
    KeyError
        There is no such method.
    ParameterError
        An option does not go with the robot or with another option.
    """
    method = METHODS[name]
    if method is AutoGait:
        candidates = {
            other: Candidate(
                entry,
                partial(
                    build_method, other, robot, tick_period, tolerance, integration_step, options
                ),
            )
            for other, entry in METHODS.items()
            if entry is not AutoGait
        }
        return AutoGait(robot, tick_period, tolerance, integration_step, candidates=candidates)
    own = f"{name}."
    chosen = {key.removeprefix(own): value for key, value in options.items() if key.startswith(own)}
    return method(robot, tick_period, tolerance, integration_step, **chosen)
