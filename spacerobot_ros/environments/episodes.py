"""Episodes of N robots: random starts and goals, plant steps, rewards and ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.batch import InitialStates, SensorErrors, SteppedFlights
from spacerobot_ros.batch.flights import Counts, assign_rows, joined_rows
from spacerobot_ros.batch.targets import device_named
from spacerobot_ros.campaign.config import Campaign, load_campaign
from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.targets import DrawnFlight, description_of, self_contained
from spacerobot_ros.environments.tasks import (
    TASKS,
    RobotStates,
    Step,
    Task,
    action_scale,
    command_of,
)
from spacerobot_ros.errors import CommandError, ParameterError, RobotDescriptionError
from spacerobot_ros.files import warn_once
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.parameters import as_numbers, configured, nonnegative, parameter, require_names
from spacerobot_ros.scenario import Scenario, scenario_or_robot
from spacerobot_ros.simulation.config import OrbitConfig, TableConfig
from spacerobot_ros.simulation.faults import FAULT_KINDS
from spacerobot_ros.simulation.plant import InitialState

_MAX_DRAWS = 10_000
_MAX_REFUSED_DRAWS = 100
_GOALS = ("random", "scenario")

_CHANGEABLE = ("reward", "spread", "time_limit", "tolerance")
"""Arguments that may change between episodes."""

_BEYOND_LANES = "faults", "plant.thrusters", "plant.disturbances", "plant.orbit.", "plant.table."
"""Prefixes of the names of dispersions that require a separate plant for each robot."""


@dataclass(frozen=True)
class EpisodeConfig:
    """Episode configuration: the keyword arguments of the environments.

    ``reward`` contains the weights that differ from the defaults in :class:`.RewardWeights`.
    """

    task: str = parameter("", "name in TASKS, such as 'reorient', or a class derived from Task")
    scenario: str = parameter("", "name or file of a scenario or robot; empty: the task's default")
    campaign: str = parameter("", "file of a campaign, which draws starts, masses and goals")
    hold: int = parameter(1, "time for which an action is held", "ticks", minimum=1)
    time_limit: float = parameter(
        60.0, "time after which episodes are truncated", "s", minimum=1e-6
    )
    tolerance: float = nonnegative(
        0.0, "largest error at which a goal is reached; 0: the task's default", "rad or m"
    )
    goals: str = parameter(
        "",
        "random: goals around the start; scenario: goals from the scenario or draw; empty: "
        "random unless there is a campaign",
        choices=_GOALS,
    )
    spread: float = nonnegative(
        0.0, "largest displacement to random goals; 0: the task's default", "rad or m"
    )
    link: str = parameter(
        "", "link with a goal; empty: the link in the scenario, or else the end-effector"
    )
    max_force: float = nonnegative(
        0.0, "base force for an action of 1; 0: limit of the controller", "N"
    )
    max_torque: float = nonnegative(
        0.0, "base torque for an action of 1; 0: limit of the controller", "N m"
    )
    action_scale: Sequence[float] = parameter(
        (), "command for an action whose entries are all 1; empty: limits"
    )
    device: str = parameter(
        "", "device of a vector environment, such as cuda; its arrays are CuPy arrays; empty: lanes"
    )
    reward: Mapping[str, float] | None = None

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> EpisodeConfig:
        """Return the configuration for keyword arguments; raise ParameterError if invalid."""
        require_names("An environment has no argument", arguments, [x.name for x in fields(cls)])
        values, reward = dict(arguments), arguments.get("reward")
        for name, value in arguments.items():
            if isinstance(value, PathLike):
                values[name] = fspath(value)
        if isinstance(task := arguments.get("task"), type):
            values["task"] = TASKS.register(task).name
        if not isinstance(reward, Mapping | None):
            raise ParameterError(
                f"Argument 'reward' is {reward!r}; it must be a dictionary of weights."
            )
        return replace(configured(cls, values), reward=reward)

    def __post_init__(self) -> None:
        if self.scenario and self.campaign:
            raise ParameterError(
                "Arguments 'scenario' and 'campaign' are both given: a campaign file already "
                "names a scenario."
            )

    @property
    def kind(self) -> type[Task]:
        """Task class; raises ParameterError if it does not exist or does not support ``link``."""
        if self.task not in TASKS:
            raise ParameterError(f"Argument 'task' is '{self.task}'; it may be {', '.join(TASKS)}.")
        kind = TASKS[self.task]
        if self.link and not kind.has_link:
            raise ParameterError(
                f"Argument 'link' is '{self.link}', but task '{self.task}' has no link: omit it, "
                "or use spacerobot/Reach-v0."
            )
        return kind


ARGUMENTS = frozenset(each.name for each in fields(EpisodeConfig))
"""Names of the arguments with which an environment is made."""


@dataclass(frozen=True)
class _Start:
    """Start of an episode; ``states`` and ``sensors`` are rows of one flight."""

    states: InitialStates
    sensors: SensorErrors
    inertial: InertialParameters | None
    scenario: Scenario

    @classmethod
    def of(
        cls, robot: SpaceRobot, scenario: Scenario, inertial: InertialParameters | None = None
    ) -> _Start:
        states = InitialStates.of(robot, [InitialState.of(scenario.plant)])
        sensors = SensorErrors.of(robot, [scenario.plant.sensors])
        return cls(states, sensors, inertial, scenario)


class _Starts:
    """Episode starts, from a scenario or from campaign draws.

    Draws without a valid robot or start are omitted, with a warning.
    """

    def __init__(self, config: EpisodeConfig) -> None:
        kind, self._campaign = config.kind, None
        if config.campaign:
            self._campaign = load_campaign(Path(config.campaign))
            self.scenario = self._campaign.scenario
            draws = Draws(self._campaign)
            self._draws = [draws[number] for number in range(min(len(draws), _MAX_DRAWS))]
        else:
            self.scenario = self_contained(scenario_or_robot(config.scenario or kind.scenario))
        self.robot = SpaceRobot(description_of(self.scenario))
        _require_steppable(self.scenario)
        plant, dispersed = self.scenario.plant, self._campaign.names if self._campaign else ()
        self.needs_plants = (
            bool(plant.faults or plant.thrusters or plant.disturbances)
            or (plant.orbit, plant.table) != (OrbitConfig(), TableConfig())
            or any(name.startswith(_BEYOND_LANES) for name in dispersed)
        )
        """Whether each robot needs its own plant because lanes do not support some feature."""
        self.nominal = _Start.of(self.robot, self.scenario)
        self.has_sensor_errors = bool(self.nominal.sensors.is_active[0]) or any(
            name.startswith("plant.sensors.") for name in dispersed
        )
        self._made: dict[int, _Start | str] = {}
        """Starts by draw number; a string is the reason why the draw was rejected."""

    def first(self, count: int, flights: SteppedFlights) -> list[_Start]:
        """Return the starts of the scenario or of the first ``count`` draws."""
        if self._campaign is None:
            return [self.nominal]
        for number in range(min(count, len(self._draws))):
            self._made[number] = self._drawn(self._campaign, number, flights)
        starts = [each for each in self._made.values() if isinstance(each, _Start)]
        if not starts:
            raise ParameterError(
                f"{len(self._made)} campaign draws were rejected, the first one because: "
                f"{self._made[0]} Restrict the dispersions to values that the robot permits."
            )
        return starts

    def draw(
        self, generators: Sequence[np.random.Generator], flights: SteppedFlights
    ) -> tuple[list[_Start], Counts]:
        """Draw episode starts: return the distinct starts, and the index of the start of each
        episode.
        """
        if self._campaign is None:
            return [self.nominal], np.zeros(len(generators), np.int64)
        drawn = [self._draw_number(self._campaign, rng, flights) for rng in generators]
        numbers, which = np.unique(drawn, return_inverse=True)
        made = (self._made[number] for number in numbers.tolist())
        return [each for each in made if isinstance(each, _Start)], which

    def _draw_number(
        self, campaign: Campaign, rng: np.random.Generator, flights: SteppedFlights
    ) -> int:
        for _ in range(_MAX_REFUSED_DRAWS):
            number = int(rng.integers(len(self._draws)))
            if number not in self._made:
                self._made[number] = self._drawn(campaign, number, flights)
            if isinstance(self._made[number], _Start):
                return number
        raise ParameterError(
            f"{_MAX_REFUSED_DRAWS} successive campaign draws were rejected, the last one "
            f"because: {self._made[number]} Restrict the dispersions to values that the robot "
            "permits."
        )

    def _drawn(self, campaign: Campaign, number: int, flights: SteppedFlights) -> _Start | str:
        """Return the start of a draw, or the reason why there is none."""
        try:
            flight = drawn_flight(campaign, self._draws[number], DrawnFlight.of(self.scenario))
            masses = flight.inertial or self.robot.inertial
            start = _Start.of(self.robot, flight.scenario, masses)
            flights.require_startable(start.states, InertialParameters.stacked([masses]))
        except (ParameterError, RobotDescriptionError) as refusal:
            if not any(isinstance(each, str) for each in self._made.values()):
                warn_once(
                    f"Campaign draw {number} is omitted, as are other rejected draws: {refusal}"
                )
            return str(refusal)
        _require_steppable(flight.scenario)
        return start


def _require_steppable(scenario: Scenario) -> None:
    plant = scenario.plant
    kinds = FAULT_KINDS.keys() & {line.split(maxsplit=1)[0] for line in plant.faults}
    parts = {
        "faults of sensors": any(FAULT_KINDS[kind].sensor for kind in kinds),
        "a target": plant.target.given,
        "a plant in MuJoCo": plant.engine == "mujoco",
    }
    for part, given in parts.items():
        if given:
            raise ParameterError(
                f"Scenario '{scenario.name}' has {part}, which environments do not support: use "
                "another scenario or campaign."
            )


class Episodes:
    """N episodes that are advanced together.

    Attributes are arrays with N rows: ``observations``, ``goals``, and after :meth:`step`
    ``rewards``, ``terminations`` and ``truncations``; ``errors`` are in rad or m. ``flights``
    contains the robot states; do not change them.

    Parameters
    ----------
    config
        Goals and errors of the episodes.
    count
        Their number N.
    in_lanes
        Whether the robots are in SIMD lanes; otherwise, each robot has its own plant.
    """

    def __init__(self, config: EpisodeConfig, count: int, *, in_lanes: bool) -> None:
        if not isinstance(count, int | np.integer) or count < 1:
            raise ParameterError(f"The number of environments is {count!r}; it must be at least 1.")
        self._source = _Starts(config)
        scenario, self.robot = self._source.scenario, self._source.robot
        plant, every = scenario.plant, np.zeros(count, dtype=np.int64)
        self._goals_of_scenario = (config.goals or _GOALS[bool(config.campaign)]) == "scenario"
        self._on_device = bool(config.device)
        if self._on_device:
            self._require_device_support(config, in_lanes)
        self._link = ""
        if config.kind.has_link:
            described = self.robot.description
            self._link = described.end_effector(config.link or plant.end_effector_frame)
            if not self._link:
                raise ParameterError(
                    f"Robot '{described.name}' has no end-effector: set argument 'link'."
                )
        self._plants = [plant] * count if self._source.needs_plants else []
        self.flights = SteppedFlights(
            self.robot,
            plant.actuation,
            plant.control_period,
            self._source.nominal.states[every],
            integration_step=plant.integration_step,
            link=self._link,
            in_lanes=in_lanes,
            plants=self._plants,
            target=device_named(config.device) if self._on_device else None,
        )
        self._arrays = self.flights.arrays
        link_r = self.flights.link_r if self._link else None
        parts = self.flights.pose, self.flights.twist, self.flights.q, self.flights.qdot
        self._states = RobotStates(*parts, link_r)
        self.scale, self.taken = self._action_scale(config, scenario)
        self._scale, self._taken = map(self._arrays.asarray, (self.scale, self.taken))
        wrench = self.taken[self.taken >= self.robot.n] - self.robot.n
        pushed = bool((wrench < 3).any()), bool((wrench >= 3).any())
        self.task: Task = config.kind(self.robot, self._link, pushed)
        self._apply(config)
        zeros, dtype = self._arrays.zeros, self.flights.pose.dtype
        self.goals = zeros((count, self.task.goal_size), dtype)
        self.goals[:, -1] = 1.0
        self._sensors = self._source.nominal.sensors[every]
        self._generators: Any = ()
        self.step_duration = config.hold * plant.control_period
        self.rewards, self.errors = zeros((2, count), dtype)
        self.observations = zeros((count, len(self.task.observation_bounds()[0])), dtype)
        self.terminations, self.truncations, self.reached = zeros((3, count), np.bool_)
        if self._on_device:
            self._remember_starts()
        if not self._source.has_sensor_errors:
            self._observe()

    def _require_device_support(self, config: EpisodeConfig, in_lanes: bool) -> None:
        kind, source = config.kind, self._source
        draws_together = self._goals_of_scenario or kind.random_goals is not Task.random_goals
        for part, given in {
            "single environments; use gymnasium.make_vec": not in_lanes,
            "sensor errors of links": source.has_sensor_errors and kind.has_link,
            "actuator faults, on/off thrusters, disturbances, orbits and tables": (
                source.needs_plants
            ),
            f"task '{config.task}', which has no random_goals": not draws_together,
            f"task '{config.task}', which has a start of its own": kind.start is not Task.start,
        }.items():
            if given:
                raise ParameterError(
                    f"Argument 'device' is '{config.device}', but devices do not support {part}."
                )

    def _remember_starts(self) -> None:
        """Start each robot from the scenario or its own draw in all later episodes."""
        every = np.arange(len(self.goals))
        starts = self._source.first(len(every), self.flights)
        which = every % len(starts)
        masses = [each.inertial for each in starts if each.inertial is not None]
        inertial = InertialParameters.stacked(masses)[which] if masses else None
        self.flights.reset(every, joined_rows([each.states for each in starts])[which], inertial)
        self.flights.remember_starts()
        sensors = joined_rows([each.sensors for each in starts])[which]
        parts = (self._arrays.asarray(getattr(sensors, x.name)) for x in fields(SensorErrors))
        self._first_sensors = SensorErrors(*parts)
        self._sensors = self._first_sensors[self._arrays.arange(len(every))]
        if self._goals_of_scenario:
            goals = np.array([self.task.goal_of(each.scenario) for each in starts])[which]
            self._first_goals = self._arrays.asarray(goals)

    def _apply(self, config: EpisodeConfig) -> None:
        self._weights = self.task.weights.of(config.reward)
        self._config, self.reward, self.time_limit = config, vars(self._weights), config.time_limit
        self.spread = config.spread or self.task.spread
        self.tolerance = config.tolerance or self.task.tolerance

    def has_attribute(self, name: str) -> bool:
        """Return whether :meth:`change` accepts an attribute name."""
        return name in _CHANGEABLE or (hasattr(self.task, name) and not name.startswith("_"))

    def attribute(self, name: str) -> Any:
        """Return the value of an attribute that :meth:`change` can set."""
        return getattr(self if name in _CHANGEABLE else self.task, name)

    def change(self, name: str, value: Any) -> None:
        """Change ``reward``, ``spread``, ``time_limit``, ``tolerance`` or a task attribute.

        Raises
        ------
        ParameterError
            There is no such attribute, or the value is invalid.
        """
        if name in _CHANGEABLE:
            checked = getattr(EpisodeConfig.of({name: value}), name)
            self._apply(replace(self._config, **{name: checked}))
        elif self.has_attribute(name) and name not in ARGUMENTS:
            setattr(self.task, name, value)
        else:
            known = *_CHANGEABLE, "attributes of the task"
            require_names("An environment has no changeable attribute", [name], known)

    def _action_scale(self, config: EpisodeConfig, scenario: Scenario) -> tuple[Array, Counts]:
        """Return the command for an action of ones, and the command entries set by actions."""
        size, force, torque = self.flights.command_size, config.max_force, config.max_torque
        scale = np.array(config.action_scale)
        if not scale.size:
            if "coordinated_control" in scenario.commanders:
                force = force or scenario.controller.max_force
                torque = torque or scenario.controller.max_torque
            scale = action_scale(self.robot, scenario.plant.actuation, force, torque)
        elif len(scale) != size:
            raise ParameterError(
                f"Argument 'action_scale' is {config.action_scale!r}; robot "
                f"'{self.robot.description.name}' takes a list of {size} finite numbers."
            )
        elif not scale.any():
            raise ParameterError(
                "Argument 'action_scale' is all zeros, so no action moves the robot: use larger "
                "values."
            )
        return scale, np.flatnonzero(scale)

    def begin(self, rows: Any, generators: Any, goal: Any = None, start: Any = None) -> None:
        """Restart the episodes in some rows, given the random generators of all rows, or a device's
        single generator.

        ``goal``, either (goal_size,) for all rows or (N, goal_size) with one goal per row,
        overrides the drawn goals. ``start``, either one dictionary for all rows or one per row,
        overrides values of :class:`.InitialState`.

        Raises
        ------
        ParameterError
            A draw, the goal or the start is invalid.
        """
        goals = None if goal is None else self._checked_goals(goal)
        if self._on_device:
            if start is not None:
                raise ParameterError("Environments on a device take no option 'start': omit it.")
            self._begin_on_device(rows, generators, goals)
            return
        chosen, task = np.asarray(rows, dtype=np.int64), self.task
        changes = None if start is None else self._checked_starts(start)
        self._generators, numbers = generators, chosen.tolist()
        own = [generators[row] for row in numbers]
        drawn, which = self._source.draw(own, self.flights)
        states = joined_rows([each.states for each in drawn])[which]
        if changes is not None or type(task).start is not Task.start:
            initial = [task.start(states.initial_state(i), rng) for i, rng in enumerate(own)]
            if changes is not None:
                given = (changes[row] for row in numbers)
                initial = [replace(x, **some) for x, some in zip(initial, given, strict=True)]
            states = InitialStates.of(self.robot, initial)
        if self._plants:
            for row, k, rng in zip(numbers, which.tolist(), own, strict=True):
                # Each episode has different actuator noise.
                sensors = drawn[k].scenario.plant.sensors
                seeded = replace(sensors, seed=int(rng.integers(2**31)))
                self._plants[row] = replace(drawn[k].scenario.plant, sensors=seeded)
        assign_rows(self._sensors, chosen, joined_rows([each.sensors for each in drawn])[which])
        masses = [each.inertial for each in drawn if each.inertial is not None]
        inertial = InertialParameters.stacked(masses)[which] if masses else None
        self.flights.reset(chosen, states, inertial)
        if goals is not None:
            self.goals[chosen] = goals[chosen]
        elif self._goals_of_scenario:
            self.goals[chosen] = np.array([task.goal_of(each.scenario) for each in drawn])[which]
        else:
            self.goals[chosen] = self._random_goals(chosen, own)
        self._observe(chosen)

    def _begin_on_device(self, rows: Any, rng: Any, goals: Array | None) -> None:
        self._generators, starts = rng, rng.integers(0, len(self.goals), size=len(rows))
        self.flights.restart(rows, starts)
        assign_rows(self._sensors, rows, self._first_sensors[starts])
        if goals is not None:
            self.goals[rows] = self._arrays.asarray(goals)[rows]
        elif self._goals_of_scenario:
            self.goals[rows] = self._first_goals[starts]
        else:
            self.goals[rows] = self._random_goals(rows, rng)
        self._observe(rows)

    def _random_goals(self, rows: Any, rngs: Any) -> Array:
        goals = self.task.random_goals(self._states[rows], self.spread, rngs)
        return self._checked("random_goals", goals, len(rows), self.task.goal_size)

    def _checked_starts(self, start: Any) -> list[dict[str, Array]]:
        count, n = len(self.goals), self.robot.n
        each = list(start) if isinstance(start, list | tuple) else [start] * count
        if len(each) != count or not all(isinstance(one, Mapping) for one in each):
            raise ParameterError(
                f"The start is {start!r}: pass a dictionary, or a list of {count} dictionaries."
            )
        sizes = {part.name: 3 for part in fields(InitialState)}
        sizes |= {"quaternion": 4, "joint_positions": n, "joint_velocities": n}
        checked: list[dict[str, Array]] = [{} for _ in each]
        for one, values in zip(each, checked, strict=True):
            require_names("A start has no", one, sizes)
            for name, given in one.items():
                values[name] = as_numbers(given, f"The start's {name}")
                if values[name].shape != (sizes[name],) or not np.isfinite(values[name]).all():
                    raise ParameterError(
                        f"The start's {name} is {given!r}; it must be {sizes[name]} finite numbers."
                    )
        return checked

    def _checked_goals(self, goal: Any) -> Array:
        values, (count, size) = as_numbers(goal, "The goal"), self.goals.shape
        if values.shape not in ((size,), (count, size)) or not np.isfinite(values).all():
            raise ParameterError(
                f"The goal has shape {values.shape}; task '{self.task.name}' takes {size} finite "
                f"numbers, or ({count}, {size}) with one row per robot."
            )
        goals = np.broadcast_to(values, (count, size))
        return self.task.checked_goals(goals)

    @cached_property
    def _camera(self) -> Any:
        # Slow to import, and few environments are rendered.
        from spacerobot_ros.environments.rendering import Camera

        return Camera(self.task)

    def picture(self, row: int) -> npt.NDArray[np.uint8]:
        """Return a picture (rows, columns, 3) of a robot and its goal."""
        at = slice(row, row + 1)
        return np.asarray(self._camera.picture(self._states[at], self.goals[at]))

    def step(self, actions: Any) -> None:
        """Step all unfinished episodes by ``hold`` ticks.

        ``actions`` (one row per robot, one column per action entry) are fractions of the largest
        command, clipped to the range from -1 to 1.

        Raises
        ------
        CommandError
            The shape is wrong, or an action is not finite.
        """
        flights, task, wanted = self.flights, self.task, (len(self.goals), len(self.taken))
        if self._arrays is np:
            actions = as_numbers(actions, "The array of actions", CommandError)
        shares = self._arrays.asarray(actions, dtype=self.observations.dtype)
        if shares.shape != wanted:
            raise CommandError(f"The actions have shape {shares.shape}, not {wanted}.")
        under_way, errors = flights.has_not_ended.copy(), self.errors.copy()
        # Indexing makes the first one a copy.
        before, after = self._states[self._arrays.arange(len(shares))], self._states
        flights.step(command_of(shares, self._scale, self._taken), self._config.hold)
        # Robots that are not stepped are not measured, so they draw no random numbers.
        measured = self._arrays.flatnonzero(under_way)
        self._observe(measured if self._source.has_sensor_errors else slice(None))
        alive = flights.has_not_ended
        arrived = task.reached(after, self.errors, self.tolerance)
        reached = alive & self._checked("reached", arrived, len(shares))
        failed = self._checked("failed", task.failed(after, self.goals), len(shares))
        failed = (under_way & ~alive) | (alive & ~reached & failed)
        shares = np.clip(shares, -1.0, 1.0)
        done = (before, after, self.goals, shares, errors, self.errors, reached, failed)
        step = Step(*done, self.step_duration)
        rewards = self._checked("reward", task.reward(step, self._weights), len(shares))
        rewards = np.where(under_way, rewards, 0.0)
        self.rewards = rewards.astype(self.errors.dtype, copy=False)
        self.reached, self.terminations = reached, reached | failed
        late = flights.time > self.time_limit - 0.5 * self.step_duration
        self.truncations = alive & late & ~self.terminations

    def _observe(self, rows: Any = slice(None)) -> None:
        states, goals = self._states[rows], self.goals[rows]
        remaining = self.task.remaining(states, goals)
        self._checked("remaining", remaining, len(goals), self.task.error_size)
        self.errors[rows] = self._checked("errors", self.task.errors(remaining), len(goals))
        if self._source.has_sensor_errors and len(rows):
            states = self._measured(states, rows)
            remaining = self.task.remaining(states, goals)
        seen, size = self.task.observe(states, remaining), self.observations.shape[1]
        self.observations[rows] = self._checked("observe", seen, len(goals), size)

    def _checked(self, function: str, found: Any, *wanted: int) -> Any:
        """Return what a function of the task returned; raise a ParameterError for other shapes."""
        shape = getattr(found, "shape", None)
        if shape != wanted:
            what = found if shape is None else f"an array of shape {shape}"
            raise ParameterError(
                f"{function} of task '{self.task.name}' returned {what}; it must return an array "
                f"of shape {wanted}, with one row per robot."
            )
        return found

    def _measured(self, states: RobotStates, rows: Any) -> RobotStates:
        size = 12 + 2 * self.robot.n
        if self._on_device:
            normals = self._generators.standard_normal((len(rows), size))
        else:
            each = [self._generators[row].standard_normal(size) for row in rows.tolist()]
            normals = np.array(each)
        parts = states.pose, states.twist, states.q, states.qdot
        measured = self._sensors[rows].measure(normals, *parts)
        if not self._link:
            return RobotStates(*measured)
        places = self.robot.function("link_poses")(measured[2].T)[1].full()
        link = self.robot.link_names.index(self._link)
        return RobotStates(*measured, places.reshape(3, len(rows), -1)[:, :, link].T)
