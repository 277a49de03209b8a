"""The Python API: plan and fly a scenario, or a robot, without ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from pathlib import Path
from typing import Any

import numpy.typing as npt

from spacerobot_ros import planning
from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.errors import GoalError, ParameterError, PlanningError
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.flight.trials import PlanningProblem, robot_state_of
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import as_numbers, require_known
from spacerobot_ros.planning import GaitSchedule, Goal
from spacerobot_ros.planning.api import EndEffectorValues, end_effector_goals
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.registry import method_options
from spacerobot_ros.resources import resource_names
from spacerobot_ros.scenario import (
    Scenario,
    load_scenario,
    scenario_names,
    scenario_of,
    scenario_or_robot,
)
from spacerobot_ros.scenario_files import changed_goal

_ORIGIN = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]
"""The default base pose."""


def fly(
    what: SpaceRobot | Scenario | str | Path,
    goal: Goal | npt.ArrayLike | None = None,
    *,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    end_effector_position: EndEffectorValues | None = None,
    end_effector_pose: EndEffectorValues | None = None,
    end_effector: str = "",
    method: str | None = None,
    law: type[ControlLaw] | None = None,
    law_options: Mapping[str, Any] | None = None,
    seed: int | None = None,
    parameters: Mapping[str, Any] | None = None,
) -> Flight:
    """Fly a scenario or a robot to a goal without ROS, like ``spacerobot run``.

    Examples: ``fly("sliding_masses")``, ``fly("planar_chain", rotvec=(0, 0, 1))``,
    ``fly("my.urdf", (0.1, 0, 0), parameters={"planner.position_tolerance": 1e-3})``.

    Parameters
    ----------
    what
        A scenario (its name, its file, or the result of
        :func:`~spacerobot_ros.scenario.load_scenario`) or a robot (its name, its URDF file, or its
        model). If a name denotes both a scenario and a robot, the scenario is used.
    goal
        Base goal: a pose, a position (3,), m, or a position and quaternion (7,). By default, the
        goal in the scenario.
    position, rotvec
        Position (3,), m, and attitude (3,), rad, as exponential coordinates; they override
        ``goal``.
    end_effector_position, end_effector_pose, end_effector
        End-effector goal, as for :func:`plan`.
    method
        A gait method or a control law; by default, the one in the scenario.
    law, law_options
        Class of a user-defined control law, and its options by name. The law uses the gains of the
        scenario's controller, so the scenario must have a controller.
    seed
        Seed of the sensor and actuator noise.
    parameters
        Node parameters by name: ``{"plant.sensors.position_noise": 0.001}``.

    Raises
    ------
    ParameterError
        There is no such scenario, robot, method or parameter, or the scenario requires ROS nodes.
    GoalError
        The goal is not a pose.
    PlanningError
        The goal is rejected by the planner, as in :func:`plan`, or by the controller.
    """
    hands = end_effector_goals(end_effector_position, end_effector_pose, end_effector)
    scenario = scenario_to_fly(what, goal, position, rotvec, hands)
    _require_goal(scenario)
    if isinstance(law, str):
        raise ParameterError(f"law={law!r} is not a class: to select a law by name, use method=.")
    if law is not None:
        LAWS.register(law)
        require_known(law.name, law.Options, law_options or {})
        options = {f"{law.name}.{name}": value for name, value in (law_options or {}).items()}
        scenario = scenario.with_method(law.name)
        scenario = scenario.with_overrides("coordinated_control", options)
    elif law_options is not None:
        raise ParameterError("law_options requires a law: pass it as law=MyLaw.")
    if method is not None:
        scenario = scenario.with_method(method)
    scenario = scenario.with_parameters({} if parameters is None else parameters)
    if seed is not None:
        scenario = scenario.with_overrides("plant", {"sensors.seed": seed})
    return _raise_if_refused(fly_scenario(scenario))


def _require_goal(scenario: Scenario) -> None:
    if not scenario.has_goal and not scenario.goal.end_effectors:
        raise ParameterError(
            f"'{scenario.name}' has no goal: give one, for instance rotvec=(0, 0, 0.1)."
        )


def _raise_if_refused(flight: Flight) -> Flight:
    """Return a flight whose goal was accepted; otherwise raise PlanningError with the reason."""
    if flight.outcome is Outcome.REFUSED:
        raise PlanningError(flight.message)
    return flight


def plan(
    what: SpaceRobot | Scenario | str | Path,
    goal: Goal | npt.ArrayLike | None = None,
    *,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    end_effector_position: EndEffectorValues | None = None,
    end_effector_pose: EndEffectorValues | None = None,
    end_effector: str = "",
    method: str | None = None,
    parameters: Mapping[str, Any] | None = None,
    **options: Any,
) -> GaitSchedule:
    """Plan a gait for a scenario or for a robot.

    A scenario defines the start, the limits, the tolerances, the control period, the method and the
    default goal: ``plan("arm_attitude")``, or, for another goal,
    ``plan(load_scenario("sliding_masses"), rotvec=(0, 0, 0.1))``. A robot uses the defaults of
    :func:`spacerobot_ros.planning.plan`, which has more arguments: ``plan("sliding_masses",
    rotvec=(0.5, 0, 0), start=(0, 1, 0))``.

    Parameters
    ----------
    what
        A robot (its model, URDF file or name), or a scenario (or its file or name). If a scenario
        and a robot have the same name, the name denotes the robot if a goal is given, and the
        scenario otherwise.
    goal, position, rotvec
        Base goal, as for :func:`fly`.
    end_effector_position, end_effector_pose, end_effector
        End-effector goal: a position (3,), m, or a position and quaternion (7,), with the link
        name; for several end-effectors, their positions or poses by link name. Only the given
        components of the base pose are constrained.
    method
        Name of a gait method; by default, the one in the scenario. For a robot the default is
        ``auto``, or ``optimal`` if method options are given.
    parameters
        Node parameters by name, as for :func:`fly`, such as
        ``{"planner.attitude_tolerance": 0.001}``; if they are given, a robot is handled as in
        :func:`fly`.
    options
        Method options by name; for a robot, other arguments of :func:`spacerobot_ros.planning.plan`
        are also accepted.

    Raises
    ------
    PlanningError
        The goal is rejected or unreachable; the message gives the reason.
    ParameterError
        There is no such scenario, robot, method or option, or one of them is invalid.
    """
    hands = end_effector_goals(end_effector_position, end_effector_pose, end_effector)
    if parameters is not None:
        what = scenario_to_fly(what).with_parameters(parameters)
    aimed = bool(hands) or any(each is not None for each in (goal, position, rotvec))
    if not _is_scenario(what, aimed=aimed):
        assert not isinstance(what, Scenario)
        if goal is not None:
            start = Goal.checked(*_ORIGIN)
            goal, position, rotvec = changed_goal(start, goal, position, rotvec), None, None
            if (shape := options.pop("joint_positions", None)) is not None:
                goal = replace(goal, joint_positions=Goal.checked(*_ORIGIN, shape).joint_positions)
            if hands:
                goal = replace(goal, end_effectors=hands)
        chosen = {
            name: as_numbers(value, f"The {name}", GoalError).reshape(-1).tolist()
            for name, value in (("position", position), ("rotvec", rotvec))
            if value is not None
        }
        if goal is None and hands:
            options["end_effector_position"] = end_effector_position
            options["end_effector_pose"] = end_effector_pose
            options["end_effector"] = end_effector
        if method is None:
            # Without a method name, the options are those of `optimal`.
            of_method = options.keys() - signature(planning.plan).parameters.keys()
            method = "optimal" if of_method else PlannerConfig().method
        return planning.plan(what, goal, method=method, **{**chosen, **options})
    scenario = what if isinstance(what, Scenario) else load_scenario(str(what))
    scenario = scenario.with_goal(goal, rotvec, position=position, end_effectors=hands)
    _require_goal(scenario)
    settings: dict[str, Any] = {} if method is None else {"method": method}
    name = method or scenario.planner.method
    method_options(name, options)  # Checked here, so that messages contain the names as given.
    settings |= {f"{name}.{option}": value for option, value in options.items()}
    problem = PlanningProblem.of(scenario.with_overrides("planner", settings))
    state, tolerance = robot_state_of(problem.plant()), problem.config.tolerance
    request = planning.PlanRequest(state, problem.goal, tolerance)
    return problem.method(name).plan(request)


def _is_scenario(what: SpaceRobot | Scenario | str | Path, *, aimed: bool) -> bool:
    """Whether a name denotes a scenario; with a goal, a shared name denotes the robot."""
    if isinstance(what, SpaceRobot | Scenario):
        return isinstance(what, Scenario)
    name = str(what)
    if name.endswith((".yaml", ".yml")):
        return True
    return name in scenario_names() and not (aimed and name in resource_names("urdf", ".urdf"))


def scenario_to_fly(
    what: SpaceRobot | Scenario | str | Path,
    goal: Goal | npt.ArrayLike | None = None,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    hands: Sequence[EndEffectorGoal] = (),
) -> Scenario:
    """Return the scenario to fly, with the given goals; a robot becomes a scenario whose only goals
    are the given ones.

    Raises
    ------
    ParameterError
        There is no such scenario or robot.
    GoalError
        A goal is not a pose.
    """
    match what:
        case Scenario():
            scenario = what
        case SpaceRobot():
            scenario = scenario_of(what.description)
        case _:
            scenario = scenario_or_robot(str(what))
    return scenario.with_goal(goal, rotvec, position=position, end_effectors=hands)
