"""The Python API: plan and fly a scenario, or a robot, without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros import planning
from spacerobot_ros.errors import GoalError, ParameterError
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.flight.parameter_files import CONFIGS
from spacerobot_ros.flight.scenario import (
    Scenario,
    load_scenario,
    scenario_names,
    scenario_or_robot,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import GaitSchedule, Goal
from spacerobot_ros.planning.methods.registry import method_options
from spacerobot_ros.resources import resource_names
from spacerobot_ros.simulation.trials import state_of


def fly(
    what: Scenario | str | Path,
    goal: Goal | npt.ArrayLike | None = None,
    *,
    rotvec: npt.ArrayLike | None = None,
    method: str | None = None,
    seed: int | None = None,
    parameters: Mapping[str, Any] | None = None,
) -> Flight:
    """Fly a scenario or a robot to a goal, without ROS: the same flight as ``spacerobot run``.

    ``fly("sliding_masses")``, ``fly("planar_chain", rotvec=(0, 0, 1))``,
    ``fly("my.urdf", (0.1, 0, 0), parameters={"planner.position_tolerance": 1e-3})``.

    Parameters
    ----------
    what
        A scenario: its name, its file, or :func:`~spacerobot_ros.flight.scenario.load_scenario`'s;
        or a robot: its name or its URDF file. A name that is both is the scenario.
    goal
        Where the base is to be; or its position (3,), m, or position and quaternion (7,). None: the
        goal of the scenario.
    rotvec
        Its attitude (3,), rad, as exponential coordinates.
    method
        A gait method or a control law; None: that of the scenario.
    seed
        Of the noise of sensors and actuators.
    parameters
        Parameters of the nodes by name: ``{"plant.sensors.position_noise": 0.001}``.

    Raises
    ------
    ParameterError
        There is no such scenario, robot, method or parameter, or only the nodes can fly this.
    GoalError
        The goal is none.
    """
    scenario = _scenario(what, goal, rotvec, parameters or {})
    scenario.require_goal()
    if method is not None:
        scenario = scenario.with_method(method)
    if seed is not None:
        scenario = scenario.with_overrides("plant", {"sensors.seed": seed})
    return fly_scenario(scenario)


def plan(
    what: SpaceRobot | Scenario | str | Path,
    goal: Goal | None = None,
    *,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    method: str | None = None,
    **options: Any,
) -> GaitSchedule:
    """Plan a gait for a scenario or for a robot.

    A scenario gives the start, the limits, the tolerances, the control period, the method and,
    where none is given, the goal: ``plan("arm_attitude")``, or for another goal
    ``plan(load_scenario("sliding_masses"), rotvec=(0, 0, 0.1))``.
    With a robot all that is as :func:`spacerobot_ros.planning.plan` has it, which takes more
    arguments: ``plan("sliding_masses", rotvec=(0.5, 0, 0), start=(0, 1, 0))``.

    Parameters
    ----------
    what
        The model, a URDF file or the name of a robot; or a scenario, its file, or its name. A name
        that is both is the scenario where no goal is given, and else the robot.
    goal, position, rotvec
        Where the base is to be: a goal, or a position (3,), m, and exponential coordinates (3,),
        rad.
    method
        Name of a gait method; None: that of the scenario, or ``optimal``.
    options
        Those of the method by name, and for a robot the other arguments of
        :func:`spacerobot_ros.planning.plan`.

    Raises
    ------
    PlanningError
        The goal is refused or cannot be reached; the sentence says why.
    ParameterError
        There is no such scenario, robot, method or option, or one is refused.
    """
    scenario = None if isinstance(what, SpaceRobot) else _planned(what, goal, position, rotvec)
    if scenario is None:
        assert not isinstance(what, Scenario)
        given = {"position": position, "rotvec": rotvec, "method": method}
        chosen = {name: value for name, value in given.items() if value is not None}
        return planning.plan(what, goal, **{**chosen, **options})
    settings: dict[str, Any] = {} if method is None else {"method": method}
    name = method or scenario.planner.method
    method_options(name, options)  # Refused here, by the names that were given.
    settings |= {f"{name}.{option}": value for option, value in options.items()}
    problem = scenario.with_overrides("planner", settings).problem()
    state, tolerance = state_of(problem.plant()), problem.config.tolerance
    request = planning.PlanRequest(state, problem.goal, tolerance)
    return problem.method(name).plan(request)


def _planned(
    what: Scenario | str | Path, goal: Goal | None, position: Any, rotvec: Any
) -> Scenario | None:
    """Return the scenario that is meant, with the goal; None where it is a robot."""
    given = [each for each in (goal, position, rotvec) if each is not None]
    if not isinstance(what, Scenario):
        name = str(what)
        file = name.endswith((".yaml", ".yml"))
        if not file and (name not in scenario_names() or (given and _is_robot(name))):
            return None
        what = load_scenario(name)
    scenario = what if goal is None else replace(what, goal=goal, has_goal=True)
    if position is None and rotvec is None:
        return scenario
    pose = None if position is None else [*_floats(position), *scenario.goal.quaternion.tolist()]
    return scenario.with_goal(pose, None if rotvec is None else _floats(rotvec))


def _floats(values: npt.ArrayLike) -> list[float]:
    return [float(x) for x in np.asarray(values, dtype=float).reshape(-1)]


def _is_robot(name: str) -> bool:
    return name in resource_names("urdf", ".urdf")


def _scenario(
    what: Scenario | str | Path,
    goal: Goal | npt.ArrayLike | None,
    rotvec: npt.ArrayLike | None,
    settings: Mapping[str, Any],
) -> Scenario:
    """Return what is flown, with another goal and other parameters."""
    scenario = what if isinstance(what, Scenario) else scenario_or_robot(str(what))
    if isinstance(goal, Goal):
        scenario = replace(scenario, goal=goal, has_goal=True)
    elif goal is not None:
        pose = _floats(goal)
        if len(pose) == 3:
            pose += scenario.goal.quaternion.tolist()
        if len(pose) != 7:
            raise GoalError(f"A goal is 3 or 7 numbers, not {len(pose)}: position, quaternion.")
        scenario = scenario.with_goal(pose)
    if rotvec is not None:
        scenario = scenario.with_goal(rotvec=_floats(rotvec))
    for key, value in settings.items():
        node, dot, name = key.partition(".")
        if not dot or node not in CONFIGS:
            raise ParameterError(
                f"'{key}' is no parameter: it is called node.parameter with one of the nodes "
                f"{', '.join(CONFIGS)}."
            )
        scenario = scenario.with_overrides(node, {name: value})
    return scenario
