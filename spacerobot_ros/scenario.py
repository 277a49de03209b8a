"""Scenarios: ROS parameter files for the nodes of a flight, with a section for the goals."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import yaml

from spacerobot_ros.control.config import ControllerConfig, waypoints_refusal
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.errors import GoalError, ParameterError, RobotDescriptionError, counted
from spacerobot_ros.model import RobotDescription, SpaceRobot, load_robot
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR
from spacerobot_ros.model.shared_parameters import DEFAULT_POSITION_TOLERANCE, automatic_tolerance
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.parameters import Value, configured, declared, is_of_every_node, values_of
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import Controlled, EndEffectorGoal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.registry import METHODS
from spacerobot_ros.resources import (
    is_path,
    resource_names,
    robot_file,
    share_directory,
    suggestion,
)
from spacerobot_ros.scenario_files import COMMANDERS as COMMANDERS
from spacerobot_ros.scenario_files import CONFIGS as CONFIGS
from spacerobot_ros.scenario_files import (
    GOAL_KEYS,
    KEYS_OF_PARTS,
    changed_goal,
    number_in,
    parse_goals,
    parse_kills,
    parse_published,
    parse_setting,
    read_scenario,
)
from spacerobot_ros.scenario_files import Kill as Kill
from spacerobot_ros.scenario_files import Published as Published
from spacerobot_ros.simulation.config import PlantConfig

_LONGEST_TF_PERIOD = 0.1  # wall s

_END_EFFECTOR_FRAME = "end_effector_frame"

NO_GOAL = replace(Goal.checked([0, 0, 0], [0, 0, 0, 1]), asked=frozenset())
"""Goal of a scenario without one: the initial pose, of which nothing is requested."""


@dataclass(frozen=True)
class Scenario:
    """The nodes of a flight with their parameters, and the flight's goals.

    Attributes
    ----------
    name, path, description
        Name, path and description of the parameter file.
    goal, end_effector_goal
        Base and end-effector goal poses.
    commanders
        Nodes that command the robot.
    published, published_method
        Published figures, and the gait method to which they apply (empty: any method).
    kills
        The nodes that are killed during the flight, in order of time.
    in_file, overrides
        Parameters by node and full name; overrides take precedence over the file.
    has_goal
        Whether a goal was given; otherwise ``goal`` is the initial pose.
    """

    name: str
    path: Path
    in_file: Mapping[str, Mapping[str, Any]]
    description: str = ""
    goal: Goal = NO_GOAL
    end_effector_goal: Goal | None = None
    commanders: tuple[str, ...] = ("planner",)
    published: tuple[Published, ...] = ()
    published_method: str = ""
    kills: tuple[Kill, ...] = ()
    overrides: Mapping[str, Mapping[str, Any]] = field(
        default_factory=lambda: {"plant": {"time_mode": "lockstep"}}
    )
    has_goal: bool = False
    _configs: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)
    """Configurations by node, shared by all scenarios with the same parameters."""

    def __getstate__(self) -> dict[str, Any]:
        # Another process may not know a user's laws and methods: it checks the parameters again.
        return {**vars(self), "_configs": {}}

    def config(self, node: str) -> Any:
        """Return the configuration of a node, from defaults, parameters in the file, and overrides.

        Raises
        ------
        ParameterError
            The node has no such parameter, or a value is invalid; the message names the node and
            the parameter.
        """
        if node not in self._configs:
            known = {parameter.name: parameter for parameter in declared(CONFIGS[node])}
            values = self._parameters_as_written(node)
            for name, value in values.items():
                if name not in known and not is_of_every_node(name):
                    raise ParameterError(
                        f"Node '{node}' has no parameter '{name}'.{suggestion(name, known)}"
                    )
                if isinstance(value, str) and name in known:
                    is_number = isinstance(known[name].default, (int, float))
                    values[name] = number_in(value) if is_number else value
            try:
                self._configs[node] = configured(CONFIGS[node], values)
            except ParameterError as error:
                raise ParameterError(f"Node '{node}': {error}") from error
        # Automatic values are replaced by what nodes learn from others.
        config, changes = self._configs[node], dict[str, Any]()
        if node == "plant" and config.actuation == "auto":
            efforts = "coordinated_control" in self.commanders
            return config.decided("effort" if efforts else "")
        if node in COMMANDERS and not config.tick_rate:
            changes["tick_rate"] = self.plant.tick_rate
        if node in COMMANDERS and config.plan_in_background and self.lockstep:
            changes["plan_in_background"] = False
        if node in COMMANDERS and not config.position_tolerance:
            changes["position_tolerance"] = self._automatic_tolerance(config)
        return replace(config, **changes) if changes else config

    def _automatic_tolerance(self, config: Any) -> float:
        """Return the automatic position tolerance for a commander's robot, m."""
        named = config if config.robot_description or config.robot else self.plant
        try:
            text = named.robot_description
            file = Path() if text else robot_file(named.robot)
            changed = 0.0 if text else file.stat().st_mtime
            return automatic_tolerance(_described(text, file, changed))
        except (OSError, ParameterError, RobotDescriptionError):
            return DEFAULT_POSITION_TOLERANCE  # The robot is rejected when it is built.

    def _parameters_as_written(self, node: str) -> dict[str, Any]:
        values = {**self.in_file.get(node, {}), **self.overrides.get(node, {})}
        if node == "plant" and "coordinated_control" in self.commanders:
            # Without the pose of the controlled link, its goal could not be judged.
            frame = self._parameters_as_written("coordinated_control").get(_END_EFFECTOR_FRAME)
            if frame and not values.get(_END_EFFECTOR_FRAME):
                values[_END_EFFECTOR_FRAME] = frame
        return values

    @property
    def plant(self) -> PlantConfig:
        """The plant's configuration; see :meth:`config`."""
        return self.config("plant")

    @property
    def planner(self) -> PlannerConfig:
        """The planner's configuration; see :meth:`config`."""
        return self.config("planner")

    @property
    def controller(self) -> ControllerConfig:
        """The controller's configuration; see :meth:`config`."""
        return self.config("coordinated_control")

    @property
    def lockstep(self) -> bool:
        """Whether the plant waits for commands instead of the wall clock."""
        return self.plant.time_mode == "lockstep"

    @property
    def comparable(self) -> tuple[Published, ...]:
        """The published figures, if they apply to the method used."""
        return self.published if self.published_method in ("", self.planner.method) else ()

    def parameters(self, node: str) -> dict[str, Value]:
        """Return a node's parameters from the file and the overrides, in their declared types.

        Raises
        ------
        ParameterError
            A node parameter is invalid.
        """
        values = values_of(self.config(node))
        written = self._parameters_as_written(node)
        # ROS cannot infer the type of an empty list, which is the default of every list anyway.
        typed = {name: values[name] for name in written if values.get(name, ()) != ()}
        if "use_sim_time" in written:
            typed["use_sim_time"] = bool(written["use_sim_time"])
        return typed

    def records(self, nodes: Sequence[str]) -> dict[str, dict[str, str]]:
        """Return the metadata records for a bag of the flight, by name.

        ``scenario`` contains the name, the description, the goals and the published figures;
        ``parameters/<node>`` contains all parameters of a node as a JSON string.
        """
        scenario = {"name": self.name, "description": self.description}
        scenario |= {key: " ".join(map(repr, pose)) for key, pose in self._goal_poses().items()}
        scenario["goal_asked"] = " ".join(sorted(self.goal.asked))
        if self.goal.waypoints is not None:
            scenario["goal_waypoints"] = json.dumps(self.goal.waypoints.tolist())
        if self.goal.end_effectors:
            scenario["end_effector_goals"] = json.dumps(_end_effector_values(self.goal))
        scenario["published"] = json.dumps([asdict(row) for row in self.comparable])
        parameters = {
            f"parameters/{node}": {
                name: json.dumps(value) for name, value in values_of(self.config(node)).items()
            }
            for node in nodes
        }
        return {"scenario": scenario, **parameters}

    @property
    def goal_links(self) -> tuple[str, ...]:
        """Names of the end-effectors that have goals, as in their topics."""
        default = () if self.end_effector_goal is None else (DEFAULT_END_EFFECTOR,)
        links = (each.link or DEFAULT_END_EFFECTOR for each in self.goal.end_effectors)
        return (*default, *links)

    def _goal_poses(self) -> dict[str, list[float]]:
        goals = zip(GOAL_KEYS, (self.goal, self.end_effector_goal), strict=True)
        poses = {name: goal for name, goal in goals if goal is not None and goal.base}
        return {
            f"{name}_{part}": values.tolist()
            for name, goal in poses.items()
            for part, values in (("position", goal.position), ("orientation", goal.quaternion))
        }

    def require_shape_of(self, robot: SpaceRobot) -> None:
        """Raise an error if the goal's joint positions do not fit the robot.

        Raises
        ------
        GoalError
            The number of joint positions differs from the number of joints.
        """
        shape = self.goal.joint_positions
        if shape is not None and len(shape) != robot.n:
            raise GoalError(
                f"The goal has {counted(len(shape), 'joint position')}; robot "
                f"'{robot.description.name}' has {counted(robot.n, 'joint')}."
            )

    def with_overrides(self, node: str, values: Mapping[str, Any]) -> Scenario:
        """Return the scenario with additional parameters set for one node."""
        merged = {**self.overrides, node: {**self.overrides.get(node, {}), **values}}
        # The plant may take its end-effector from the controller.
        changed = {node, "plant"} if _END_EFFECTOR_FRAME in values else {node}
        others = {name: config for name, config in self._configs.items() if name not in changed}
        return replace(self, overrides=merged, _configs=others)

    def in_real_time(self, factor: float) -> Scenario:
        """Return the scenario at ``factor`` times real time."""
        pace = {"time_mode": "realtime", "real_time_factor": factor}
        scenario = self.with_overrides("plant", pace)
        # Viewers follow wall time, which limits the period of recorded transforms; the plant limits
        # the periods of its own topics.
        shown = {"diagnostics_period": 1.0}
        period = self.config("recorder").tf_period
        if period:
            shown["tf_period"] = min(period, _LONGEST_TF_PERIOD * factor)
        return scenario.with_overrides("recorder", shown)

    def with_method(self, method: str) -> Scenario:
        """Return the scenario with another gait method, or another control law.

        A robot without a scenario uses the node of the method or law.

        Raises
        ------
        ParameterError
            The scenario has no planner or controller that could use this method or law.
        """
        if method not in (*LAWS, *METHODS):
            known = [*METHODS, *LAWS]
            raise ParameterError(
                f"There is no gait method or control law '{method}'.{suggestion(method, known)} "
                f"There are: {', '.join(known)}."
            )
        kind, node, parameter = "gait method", "planner", "method"
        if method in LAWS:
            kind, node, parameter = "control law", "coordinated_control", "law"
        robot = self.in_file.get("plant", {})
        # A robot alone, as scenario_or_robot returns it, has no other parameters.
        if len(robot) == 1 and all(each == robot for each in self.in_file.values()):
            nodes = {"plant": robot, node: {**robot, parameter: method}}
            return replace(self, in_file=nodes, commanders=(node,), _configs={})
        if node not in self.commanders:
            raise ParameterError(
                f"'{method}' is a {kind}, and the scenario '{self.name}' has no section "
                f"'{node}' that could use it: this scenario flies with "
                f"{' and '.join(self.commanders)}."
            )
        return self.with_overrides(node, {parameter: method})

    def with_settings(self, texts: Sequence[str]) -> Scenario:
        """Return the scenario with each ``node.parameter=value`` set; see :func:`parse_setting`.

        Raises
        ------
        ParameterError
            A string has a different format, does not name a node, or names a commander that is not
            running.
        """
        scenario = self
        for text in texts:
            node, name, value = parse_setting(text)
            if node in COMMANDERS and node not in self.commanders:
                raise ParameterError(
                    f"'{text}' is for the node '{node}', which is not running: the scenario "
                    f"'{self.name}' flies with {' and '.join(self.commanders)}."
                )
            scenario = scenario.with_overrides(node, {name: value})
        return scenario

    def with_parameters(self, values: Mapping[str, Any]) -> Scenario:
        """Return the scenario with parameters set by their names, ``node.parameter``.

        Raises
        ------
        ParameterError
            A name does not begin with a node.
        """
        if not isinstance(values, Mapping):
            raise ParameterError(
                "Parameters must be given by name, such as {'plant.sensors.position_noise': "
                f"0.001}}, not as {values!r}."
            )
        scenario = self
        for key, value in values.items():
            node, _, name = str(key).partition(".")
            if node not in CONFIGS or not name:
                raise ParameterError(
                    f"'{key}' is not a parameter: write it as node.parameter, with one of the "
                    f"nodes {', '.join(CONFIGS)}."
                )
            # The caller may change an array afterwards.
            scenario = scenario.with_overrides(node, {name: deepcopy(value)})
        return scenario

    def with_goal(
        self,
        pose: Goal | npt.ArrayLike | None = None,
        rotvec: npt.ArrayLike | None = None,
        rpy_deg: npt.ArrayLike | None = None,
        *,
        position: npt.ArrayLike | None = None,
        end_effectors: Sequence[EndEffectorGoal] = (),
    ) -> Scenario:
        """Return the scenario with the given goals; see :func:`changed_goal` and
        :meth:`with_other_goal`.

        With ``end_effectors``, only the given components of the base pose are requested.

        Raises
        ------
        GoalError
            The pose or the attitude is not finite, the attitude is given twice, or a link has two
            goals.
        """
        scenario = self
        if any(each is not None for each in (pose, position, rotvec, rpy_deg)):
            goal = changed_goal(self.goal, pose, position, rotvec, rpy_deg)
            scenario = self.with_other_goal(goal)
        if not end_effectors:
            return scenario
        asked: set[Controlled] = set()
        if pose is not None or position is not None:
            asked.add("position")
        whole = isinstance(pose, Goal) or (pose is not None and np.size(pose) == 7)
        if whole or rotvec is not None or rpy_deg is not None:
            asked.add("attitude")
        return scenario.with_end_effectors(end_effectors, frozenset(asked))

    def with_other_goal(self, goal: Goal) -> Scenario:
        """Return the scenario with another goal and a description that mentions this goal.

        The published figures, which apply only to the published goal, are dropped.
        """
        made = replace(self, goal=goal, published=(), has_goal=True)
        return made.described_for_other_goal() if self.has_goal else made

    def described_for_other_goal(self) -> Scenario:
        """Return the scenario with a description that mentions another goal."""
        other = "Flown to a goal other than the scenario's"
        return replace(self, description=self.description and other)

    def with_end_effectors(
        self, goals: Sequence[EndEffectorGoal], base: frozenset[Controlled] = frozenset()
    ) -> Scenario:
        """Return the scenario with other end-effector goals, and with the components of its
        base goal limited to ``base``.

        Raises
        ------
        GoalError
            A link has two goals.
        """
        made = Goal.of_end_effectors(goals)
        goal = replace(self.goal, joint_positions=None, base=base)
        aimed = replace(goal, end_effectors=made.end_effectors)
        return replace(self.with_other_goal(aimed), end_effector_goal=None)._with_goal_topics()

    def _with_goal_topics(self) -> Scenario:
        """Return the scenario with a planner that takes goals of all its end-effectors, whose poses
        the plant publishes.
        """
        links = [each.link for each in self.goal.end_effectors if each.link]
        if not links or "planner" not in self.commanders:
            return self
        listed = self.planner.end_effectors
        missing = [link for link in links if link not in (*listed, DEFAULT_END_EFFECTOR)]
        if not missing:
            return self
        heard = self.with_overrides("planner", {"end_effectors": [*listed, *missing]})
        published = heard.plant.end_effectors
        more = [link for link in missing if link not in published]
        return heard.with_overrides("plant", {"end_effectors": [*published, *more]})

    def require_goal(self) -> None:
        """Raise an error if the scenario has no goal, for example because it was created from a
        robot file or a dump, or if its controller does not pass the goal's waypoints.

        Raises
        ------
        ParameterError
            There is no goal, or its waypoints require another profile.
        """
        if not self.has_goal:
            raise ParameterError(
                f"'{self.name}' has no goal: give one, for instance --goal-rpy-deg 0 0 10, or "
                "write a scenario with a goal (`spacerobot new` writes one for a robot)."
            )
        waypoints = self.goal.waypoints
        controlled = "coordinated_control" in self.commanders
        if waypoints is not None and controlled and not self.controller.plans:
            raise ParameterError(waypoints_refusal(len(waypoints)))


@lru_cache(maxsize=64)
def _described(text: str, file: Path, changed: float) -> RobotDescription:
    """Return the robot in a URDF string, or in a file with the modification time ``changed``."""
    return parse_robot(text) if text else load_robot(file)


def scenario_text(scenario: Scenario) -> str:
    """Return the scenario as parameter file text, including its overrides, but not the published
    values or node kills.
    """
    about: dict[str, Any] = {"description": scenario.description, **scenario._goal_poses()}
    for part, keys in KEYS_OF_PARTS.items():
        if part not in scenario.goal.asked:
            about = {key: value for key, value in about.items() if key not in keys}
    if scenario.goal.end_effectors:
        about["end_effector_goals"] = _end_effector_values(scenario.goal)
    if scenario.goal.joint_positions is not None:
        about["goal_joint_positions"] = scenario.goal.joint_positions.tolist()
    if scenario.goal.waypoints is not None:
        about["goal_waypoints"] = scenario.goal.waypoints.ravel().tolist()
    content = {"scenario": {"ros__parameters": about}}
    for node in ("plant", *scenario.commanders, "recorder"):
        values = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in scenario.parameters(node).items()
        }
        if values or node != "recorder":
            content[f"/**/{node}"] = {"ros__parameters": values}
    return str(yaml.safe_dump(content, sort_keys=False, allow_unicode=True))


def _end_effector_values(goal: Goal) -> dict[str, list[float] | list[list[float]]]:
    """Return the end-effector goals as numbers by link; the numbers of a path are nested."""
    return {each.link: each.numbers for each in goal.end_effectors}


def load_scenario(name: str | os.PathLike[str]) -> Scenario:
    """Return a packaged scenario by name, or any parameter file by path.

    A file whose plant has a robot, such as a file from ``ros2 param dump``, needs no ``scenario``
    section; the scenario then has no goal.

    Raises
    ------
    ParameterError
        There is no such scenario, or the file cannot be used; the message names the file.
    """
    name = os.fspath(name)
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        if not path.is_file():
            raise ParameterError(f"There is no scenario file '{name}'.")
    else:
        path = share_directory() / "config" / f"{name}.yaml"
    if not path.is_file():
        known, robots = scenario_names(), resource_names("urdf", ".urdf")
        raise ParameterError(
            f"There is no scenario '{name}'.{suggestion(name, [*known, *robots])} "
            f"There are: {', '.join(known)}, or any YAML file."
        )
    in_file, values = read_scenario(path)
    commanders = tuple(name for name in COMMANDERS if name in in_file) or COMMANDERS[:1]
    if values is None:
        return Scenario(path.stem, path.resolve(), in_file, commanders=commanders)
    goal, end_effector_goal = parse_goals(values, path)
    return Scenario(
        name=path.stem,
        path=path.resolve(),
        description=str(values.get("description", "")),
        goal=goal,
        end_effector_goal=end_effector_goal,
        commanders=commanders,
        published=parse_published(values.get("published", {}), path),
        published_method=str(values.get("published_method", "")),
        kills=parse_kills(values.get("kills", []), f"the file {path}"),
        in_file=in_file,
        has_goal=any("goal" in key for key in values),
    )._with_goal_topics()


def scenario_or_robot(name: str) -> Scenario:
    """Return a scenario by name, or a scenario without a goal for a robot (name or URDF file).

    If only a robot is given, the planner selects the method; a robot without joints is flown by a
    controller.

    Raises
    ------
    ParameterError
        There is no such scenario or robot, or its file is invalid.
    RobotDescriptionError
        The robot is invalid.
    """
    path = Path(name)
    is_robot = path.suffix not in (".yaml", ".yml") and (
        path.is_file() or is_path(path.name) or name in resource_names("urdf", ".urdf")
    )
    if name in scenario_names() or not is_robot:
        return load_scenario(name)
    path = path if path.is_file() else robot_file(name)
    # A file that is not a robot is rejected before the missing goal.
    description = load_robot(path)
    robot = {"robot": str(path.resolve()) if path == Path(name) else name}
    return _robot_alone(path.name.split(".")[0], path, robot, description)


def scenario_of(robot: RobotDescription) -> Scenario:
    """Return a scenario without a goal for a robot, like :func:`scenario_or_robot`."""
    return _robot_alone(robot.name, Path(), {"robot_description": robot.urdf}, robot)


def _robot_alone(
    name: str, path: Path, robot: dict[str, str], description: RobotDescription
) -> Scenario:
    node = "planner" if description.movable_joints else "coordinated_control"
    return Scenario(name, path, {"plant": robot, node: robot}, commanders=(node,))


def scenario_names() -> list[str]:
    """Return the names of the packaged scenarios; scenarios with faults are last."""
    faults = resource_names("config/faults", ".yaml")
    return [*resource_names("config", ".yaml"), *(f"faults/{name}" for name in faults)]


def different_parameters(scenarios: Sequence[Scenario]) -> list[tuple[str, ...]]:
    """Return each parameter that differs between the scenarios, with its unit and values.

    Values are strings; a value is ``–`` if the scenario uses the default. Robot
    descriptions are omitted.
    """
    given = [{(n, p): v for n in CONFIGS for p, v in s.parameters(n).items()} for s in scenarios]
    known = {(n, each.name): each for n in CONFIGS for each in declared(CONFIGS[n])}
    rows = []
    for key in dict.fromkeys(key for each in given for key in each):
        parameter = known.get(key)
        default = None if parameter is None else parameter.default
        values = {_value_text(each.get(key, default)) for each in given}
        if len(values) > 1 and not key[1].endswith("robot_description"):
            unit = f" ({parameter.unit})" if parameter is not None and parameter.unit else ""
            texts = (_value_text(each[key]) if key in each else "–" for each in given)
            rows.append((f"{key[0]}.{key[1]}{unit}", *texts))
    return rows


def _value_text(value: Any) -> str:
    """Return a string that is equal for a list and a tuple, or a number and an equal integer."""
    match value:
        case bool():
            return "yes" if value else "no"
        case list() | tuple():
            return ", ".join(map(_value_text, value)) or "none"
        case int() | float():
            return f"{value:.9g}"
    return str(value)
