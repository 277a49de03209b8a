"""Episodes of N robots: random starts and goals, steps of the plant, rewards and ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.batch import InitialStates, SensorErrors, SteppedFlights
from spacerobot_ros.campaign.config import Campaign, load_campaign
from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.targets import DrawnFlight, description_of
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
from spacerobot_ros.parameters import as_numbers
from spacerobot_ros.scenario import Scenario, scenario_or_robot
from spacerobot_ros.simulation.config import OrbitConfig, PlantConfig, TableConfig
from spacerobot_ros.simulation.faults import FAULT_KINDS
from spacerobot_ros.simulation.plant import InitialState

if TYPE_CHECKING:
    from spacerobot_ros.environments.rendering import Camera

_MAX_DRAWS = 10_000
_MAX_REFUSED_DRAWS = 100
_GOALS = ("random", "scenario")

_CHANGEABLE = ("reward", "spread", "time_limit", "tolerance")
"""Arguments that may change from episode to episode."""

_BEYOND_LANES = "faults", "plant.thrusters", "plant.disturbances", "plant.orbit.", "plant.table."
"""Prefixes of dispersions for which each robot needs its own plant."""

Counts = npt.NDArray[np.int64]


@dataclass(frozen=True)
class EpisodeConfig:
    """The configuration of episodes: the keyword arguments of the environments.

    Attributes
    ----------
    task
        Name in :data:`.TASKS`, such as ``reorient`` (the joints rotate the base) or ``reach`` (a
        link reaches a position), or a class derived from :class:`.Task`.
    scenario
        Name or file of a scenario, or of a robot; empty: the task's own.
    campaign
        File of a campaign, whose draws determine the starts, masses and goals; empty: none.
    hold
        Ticks of the plant per step, during which the action is held.
    time_limit
        Simulated time after which an episode is truncated, s.
    tolerance
        Error within which the goal is reached, rad or m; 0: the task's own.
    goals
        ``random``: around the start; ``scenario``: the goal of the scenario or of the draw; empty:
        random without a campaign.
    spread
        Size of random goals, rad or m; 0: the task's own.
    link
        Link of the goal; empty: the scenario's link, else the robot's end-effector.
    max_force, max_torque
        Force (N) and torque (N m) on the base for an action of 1 under efforts; 0: the limits of
        the scenario's controller; without them actions have no wrench.
    action_scale
        Command for an action of ones; empty: limits of joints, force and torque.
    reward
        Changed weights of :class:`.RewardWeights`.
    """

    task: str | type[Task] = ""
    scenario: str = ""
    campaign: str = ""
    hold: int = 1
    time_limit: float = 60.0
    tolerance: float = 0.0
    goals: str = ""
    spread: float = 0.0
    link: str = ""
    max_force: float = 0.0
    max_torque: float = 0.0
    action_scale: Sequence[float] = ()
    reward: Mapping[str, float] | None = None

    @classmethod
    def of(cls, arguments: Mapping[str, Any]) -> EpisodeConfig:
        """Return the configuration of keyword arguments.

        Raises
        ------
        ParameterError
            There is no such argument, or a value is invalid.
        """
        known = [each.name for each in fields(cls)]
        for name in arguments:
            if name not in known:
                raise ParameterError(
                    f"There is no argument '{name}' of environments; there are {', '.join(known)}."
                )
        return cls(**arguments)

    def __post_init__(self) -> None:
        if isinstance(self.task, type):
            object.__setattr__(self, "task", TASKS.register(self.task).name)
        for name in ("task", "scenario", "campaign", "goals", "link"):
            value = getattr(self, name)
            if not isinstance(value, str | PathLike):
                raise ParameterError(f"Argument '{name}' is {value!r}; it must be a text.")
            object.__setattr__(self, name, fspath(value))
        for name, choices in (("task", tuple(TASKS)), ("goals", ("", *_GOALS))):
            value = getattr(self, name)
            if value not in choices:
                raise ParameterError(
                    f"Argument '{name}' is '{value}'; it may be {', '.join(filter(None, choices))}."
                )
        if not isinstance(self.hold, int | np.integer) or self.hold < 1:
            raise ParameterError(
                f"Argument 'hold' is {self.hold!r}; it must be a whole number of ticks above 0."
            )
        for name in ("time_limit", "tolerance", "spread", "max_force", "max_torque"):
            value = getattr(self, name)
            if not (
                isinstance(value, int | float | np.integer | np.floating)
                and np.isfinite(value)
                and value >= 0.0
            ):
                raise ParameterError(
                    f"Argument '{name}' is {value!r}; it must be finite, at least 0."
                )
        if not isinstance(self.reward, Mapping | None):
            raise ParameterError(
                f"Argument 'reward' is {self.reward!r}; it must be a dictionary of weights."
            )
        if not self.time_limit:
            raise ParameterError("Argument 'time_limit' is 0; it must be above 0 s.")
        if self.link and not self.kind.has_link:
            raise ParameterError(
                f"Argument 'link' is '{self.link}', but task '{self.task}' has no link: "
                "leave it out, or use spacerobot/Reach-v0."
            )
        if self.scenario and self.campaign:
            raise ParameterError(
                "Arguments 'scenario' and 'campaign' are both given: a campaign names its scenario."
            )

    @property
    def kind(self) -> type[Task]:
        """Class of the task."""
        assert isinstance(self.task, str)
        return TASKS[self.task]


@dataclass(frozen=True)
class _Start:
    """Start of an episode: its initial state, also as a row, masses, and its scenario."""

    initial: InitialState
    starts: InitialStates
    inertial: InertialParameters | None
    scenario: Scenario

    @classmethod
    def of(
        cls, robot: SpaceRobot, scenario: Scenario, inertial: InertialParameters | None = None
    ) -> _Start:
        initial = InitialState.of(scenario.plant)
        return cls(initial, InitialStates.of(robot, [initial]), inertial, scenario)


class EpisodeStarts:
    """Starts of episodes, from a scenario or from the draws of a campaign.

    Draws without a valid robot or start are omitted, with a warning.

    Raises
    ------
    ParameterError
        The scenario or campaign is invalid, or has parts that environments do not support.
    """

    def __init__(self, config: EpisodeConfig) -> None:
        self._campaign: Campaign | None = None
        if config.campaign:
            self._campaign = load_campaign(Path(config.campaign))
            self.scenario = self._campaign.scenario
            draws = Draws(self._campaign)
            self._draws = [draws[number] for number in range(min(len(draws), _MAX_DRAWS))]
        else:
            self.scenario = scenario_or_robot(config.scenario or config.kind.scenario)
        self.robot = SpaceRobot(description_of(self.scenario))
        _require_steppable(self.scenario)
        plant, dispersed = self.scenario.plant, self._campaign.names if self._campaign else ()
        self.needs_plants = (
            bool(plant.faults or plant.thrusters or plant.disturbances)
            or (plant.orbit, plant.table) != (OrbitConfig(), TableConfig())
            or any(name.startswith(_BEYOND_LANES) for name in dispersed)
        )
        """Whether each robot needs its own plant, for features that lanes lack."""
        self.has_sensor_errors = bool(
            SensorErrors.of(self.robot, [plant.sensors]).is_active[0]
        ) or any(name.startswith("plant.sensors.") for name in dispersed)
        self.nominal = _Start.of(self.robot, self.scenario)
        self._made: dict[int, _Start | str] = {}
        """Starts of the draws by number; texts are the reasons for refusals."""

    def draw(self, rng: np.random.Generator, flights: SteppedFlights) -> _Start:
        """Return the start of an episode: the scenario's, or a random draw's of the campaign.

        Raises
        ------
        ParameterError
            A draw has a part that environments do not support, or too many draws are refused.
        """
        if self._campaign is None:
            return self.nominal
        start: _Start | str = ""
        for _ in range(_MAX_REFUSED_DRAWS):
            number = int(rng.integers(len(self._draws)))
            if number not in self._made:
                self._made[number] = self._drawn(self._campaign, number, flights)
            start = self._made[number]
            if isinstance(start, _Start):
                return start
        raise ParameterError(
            f"{_MAX_REFUSED_DRAWS} successive draws of the campaign are refused, the last one "
            f"because: {start} Restrict the dispersions to values that the robot permits."
        )

    def _drawn(self, campaign: Campaign, number: int, flights: SteppedFlights) -> _Start | str:
        """Return the start of a draw, or the reason why there is none."""
        try:
            flight = drawn_flight(campaign, self._draws[number], DrawnFlight.of(self.scenario))
            masses = flight.inertial or self.robot.inertial
            start = _Start.of(self.robot, flight.scenario, masses)
            flights.require_startable(start.starts, InertialParameters.stacked([masses]))
        except (ParameterError, RobotDescriptionError) as refusal:
            if not any(isinstance(each, str) for each in self._made.values()):
                warn_once(
                    f"Draw {number} of the campaign is omitted, as are other refused draws: "
                    f"{refusal}"
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
    """N episodes that are stepped together.

    Attributes are arrays of N rows: ``observations``, and after :meth:`step` ``rewards``,
    ``terminations`` and ``truncations``; ``errors`` are rad or m.

    Parameters
    ----------
    config
        The goals and errors of the episodes.
    count
        Their number N.
    in_lanes
        Whether the robots are in SIMD lanes; otherwise each robot has a plant.
    """

    def __init__(self, config: EpisodeConfig, count: int, *, in_lanes: bool) -> None:
        if not isinstance(count, int | np.integer) or count < 1:
            raise ParameterError(f"The number of environments is {count!r}; it must be at least 1.")
        self._config = config
        self._source = EpisodeStarts(config)
        scenario, self.robot = self._source.scenario, self._source.robot
        plant = scenario.plant
        self._goals_of_scenario = (config.goals or _GOALS[bool(config.campaign)]) == "scenario"
        self._link = self._reaching_link(scenario) if config.kind.has_link else ""
        self._plants = [plant] * count if self._source.needs_plants else []
        self._flights = SteppedFlights(
            self.robot,
            plant.actuation,
            plant.control_period,
            self._source.nominal.starts[np.zeros(count, dtype=np.int64)],
            integration_step=plant.integration_step,
            link=self._link,
            in_lanes=in_lanes,
            plants=self._plants,
        )
        self.scale, self.taken = self._action_scale(scenario)
        wrench = self.taken[self.taken >= self.robot.n] - self.robot.n
        pushed = bool((wrench < 3).any()), bool((wrench >= 3).any())
        self._camera: Camera | None = None
        self.task: Task = config.kind(self.robot, self._link, pushed)
        self._weights = self.task.weights.of(config.reward)
        self._goals = np.zeros((count, self.task.goal_size))
        self._goals[:, -1] = 1.0
        self._sensors = SensorErrors.of(self.robot, [plant.sensors] * count)
        self._generators: Sequence[np.random.Generator] = ()
        self.step_duration = config.hold * plant.control_period
        self.rewards, self.errors = np.zeros(count), np.zeros(count)
        self.observations = np.zeros((count, len(self.task.observation_bounds()[0])))
        self.terminations = np.zeros(count, dtype=np.bool_)
        self.truncations = np.zeros(count, dtype=np.bool_)
        self.reached = np.zeros(count, dtype=np.bool_)
        if not self._source.has_sensor_errors:
            self._observe()

    @property
    def spread(self) -> float:
        """Size of random goals."""
        return self._config.spread or self.task.spread

    @property
    def tolerance(self) -> float:
        """Error within which the goal is reached."""
        return self._config.tolerance or self.task.tolerance

    @property
    def time_limit(self) -> float:
        """Simulated time after which an episode is truncated, s."""
        return self._config.time_limit

    @property
    def reward(self) -> Mapping[str, float]:
        """Weights of the reward."""
        return vars(self._weights)

    def has_attribute(self, name: str) -> bool:
        """Return whether :meth:`change` accepts a name."""
        return name in _CHANGEABLE or (hasattr(self.task, name) and not name.startswith("_"))

    def attribute(self, name: str) -> Any:
        """Return the value that :meth:`change` changes."""
        return getattr(self if name in _CHANGEABLE else self.task, name)

    def change(self, name: str, value: Any) -> None:
        """Change ``reward``, ``spread``, ``time_limit``, ``tolerance`` or an attribute of the task.

        Raises
        ------
        ParameterError
            There is no such attribute, or the value is invalid.
        """
        if not self.has_attribute(name):
            raise ParameterError(
                f"There is no attribute '{name}' to change; there are {', '.join(_CHANGEABLE)}, "
                "and attributes of the task."
            )
        if name not in _CHANGEABLE:
            setattr(self.task, name, value)
            return
        config = replace(self._config, **{name: value})
        self._weights = self.task.weights.of(config.reward)
        self._config = config

    def _reaching_link(self, scenario: Scenario) -> str:
        link = self._config.link or scenario.plant.end_effector_frame
        link = self.robot.description.end_effector(link)
        if not link:
            raise ParameterError(
                f"Robot '{self.robot.description.name}' has no end-effector: give argument 'link'."
            )
        return link

    def _action_scale(self, scenario: Scenario) -> tuple[Array, Counts]:
        """Return the command of an action of ones, and the entries that actions have."""
        config, size, actuation = self._config, self._flights.command_size, scenario.plant.actuation
        force, torque = config.max_force, config.max_torque
        if "coordinated_control" in scenario.commanders:
            force = force or scenario.controller.max_force
            torque = torque or scenario.controller.max_torque
        scale = as_numbers(config.action_scale, "Argument 'action_scale'")
        if scale.shape != (0,):
            if scale.shape != (size,) or not np.isfinite(scale).all():
                raise ParameterError(
                    f"Argument 'action_scale' is {config.action_scale!r}; robot "
                    f"'{self.robot.description.name}' takes a list of {size} finite numbers."
                )
            if not scale.any():
                raise ParameterError(
                    "Argument 'action_scale' is all zeros, so no action moves the robot: use "
                    "larger values."
                )
        else:
            scale = action_scale(self.robot, actuation, force, torque)
        return scale, np.flatnonzero(scale != 0.0)

    @property
    def action_size(self) -> int:
        """Number of entries of an action."""
        return len(self.taken)

    @property
    def engine(self) -> str:
        """Name of the engine that steps the flights."""
        return self._flights.engine

    @property
    def flights(self) -> SteppedFlights:
        """The flights; read their states only."""
        return self._flights

    @property
    def goals(self) -> Array:
        """Goals (N, goal_size)."""
        return self._goals

    def begin(
        self,
        rows: Sequence[int] | Counts,
        generators: Sequence[np.random.Generator],
        goal: Any = None,
        start: Any = None,
    ) -> None:
        """Restart the episodes of some rows, with the random generators of all rows.

        ``goal``, one for all (goal_size,) or one per row (N, goal_size), replaces the drawn goals.
        ``start``, a dictionary or one per row, replaces some values of :class:`.InitialState`.

        Raises
        ------
        ParameterError
            A draw, the goal or the start is invalid.
        """
        chosen = np.asarray(rows, dtype=np.int64)
        goals = None if goal is None else self._checked_goals(goal)
        changes = None if start is None else self._checked_starts(start)
        self._generators = generators
        drawn = [self._source.draw(generators[row], self._flights) for row in chosen.tolist()]
        starts = [
            self._start(each, generators[row], changes[row] if changes else {})
            for row, each in zip(chosen.tolist(), drawn, strict=True)
        ]
        masses = [each.inertial for each in drawn if each.inertial is not None]
        for row, each in zip(chosen.tolist(), drawn, strict=True):
            if self._plants:
                self._plants[row] = _with_seed(each.scenario.plant, generators[row])
            if self._source.has_sensor_errors:
                errors = SensorErrors.of(self.robot, [each.scenario.plant.sensors])
                for part in fields(errors):
                    getattr(self._sensors, part.name)[row] = getattr(errors, part.name)[0]
        self._flights.reset(
            chosen,
            InitialStates(
                *(
                    np.concatenate([getattr(each, part.name) for each in starts])
                    for part in fields(InitialStates)
                )
            ),
            InertialParameters.stacked(masses) if masses else None,
        )
        for row, each in zip(chosen.tolist(), drawn, strict=True):
            if goals is not None:
                self._goals[row] = goals[row]
            elif self._goals_of_scenario:
                self._goals[row] = self.task.goal_of(each.scenario)
            else:
                at = self._states(slice(row, row + 1))
                self._goals[row] = self.task.random_goal(at, self.spread, generators[row])
        self.terminations[chosen] = self.truncations[chosen] = False
        self.rewards[chosen] = 0.0
        self._observe(chosen)

    def _start(
        self, drawn: _Start, rng: np.random.Generator, changes: Mapping[str, Array]
    ) -> InitialStates:
        initial = self.task.start(drawn.initial, rng)
        if initial is drawn.initial and not changes:
            return drawn.starts
        return InitialStates.of(self.robot, [replace(initial, **changes)])

    def _checked_starts(self, start: Any) -> list[dict[str, Array]]:
        """Return the given changes of the starts of all rows."""
        count, n = len(self._goals), self.robot.n
        each = list(start) if isinstance(start, list | tuple) else [start] * count
        if len(each) != count or not all(isinstance(one, Mapping) for one in each):
            raise ParameterError(
                f"The start is {start!r}: give a dictionary, or a list of {count} of them."
            )
        known = {part.name: 3 for part in fields(InitialState)}
        known |= {"quaternion": 4, "joint_positions": n, "joint_velocities": n}
        made: list[dict[str, Array]] = []
        for one in each:
            made.append({})
            for name, given in one.items():
                if name not in known:
                    raise ParameterError(f"A start has no '{name}'; it has {', '.join(known)}.")
                values = as_numbers(given, f"The start's {name}")
                if values.shape != (known[name],) or not np.isfinite(values).all():
                    raise ParameterError(
                        f"The start's {name} is {given!r}; it must be {known[name]} finite numbers."
                    )
                made[-1][name] = values
        return made

    def _checked_goals(self, goal: Any) -> Array:
        """Return the given goals (N, goal_size) of all rows."""
        values, count, size = as_numbers(goal, "The goal"), len(self._goals), self.task.goal_size
        if values.shape not in ((size,), (count, size)) or not np.isfinite(values).all():
            raise ParameterError(
                f"The goal has shape {values.shape}; task '{self.task.name}' takes {size} finite "
                f"numbers, or ({count}, {size}) with one row per robot."
            )
        goals = np.broadcast_to(values, (count, size))
        return self.task.checked_goals(goals)

    def picture(self, row: int) -> npt.NDArray[np.uint8]:
        """Return a picture (rows, columns, 3) of a robot and its goal."""
        # Slow to import, and few environments are drawn.
        from spacerobot_ros.environments.rendering import Camera

        if self._camera is None:
            self._camera = Camera(self.task)
        at = slice(row, row + 1)
        return self._camera.picture(self._states(at), self._goals[at])

    def end(self, rows: Counts) -> None:
        """End episodes; they are not stepped until they are restarted."""
        self._flights.end(rows)

    def step(self, actions: Any) -> None:
        """Step all episodes that have not ended, for ``hold`` ticks.

        ``actions`` (N, action_size) are shares of the largest command, clipped to -1 and 1.

        Raises
        ------
        CommandError
            The shape is wrong, or an action is not a finite number.
        """
        count, size = len(self._flights), self.action_size
        shares = as_numbers(actions, "The array of actions", CommandError)
        if shares.shape != (count, size):
            raise CommandError(f"The actions are {shares.shape}, not ({count}, {size}).")
        under_way, errors = self._flights.has_not_ended.copy(), self.errors.copy()
        states = self._states(slice(None))  # Views, which have the states after the step, too.
        before = states.copy()
        self._flights.step(command_of(shares, self.scale, self.taken), self._config.hold)
        # Robots that stand still are not measured: they take no random numbers.
        self._observe(np.flatnonzero(under_way) if self._source.has_sensor_errors else slice(None))
        task, alive, duration = self.task, self._flights.has_not_ended, self.step_duration
        reached = alive & task.reached(states, self.errors, self.tolerance)
        failed = (under_way & ~alive) | (alive & ~reached & task.failed(states, self._goals))
        shares = np.clip(shares, -1.0, 1.0)
        done = (before, states, self._goals, shares, errors, self.errors, reached, failed, duration)
        self.rewards = np.where(under_way, task.reward(Step(*done), self._weights), 0.0)
        self.reached, self.terminations = reached, reached | failed
        late = self._flights.time > self.time_limit - 0.5 * duration
        self.truncations = alive & late & ~self.terminations

    def _observe(self, rows: Any = slice(None)) -> None:
        states, goals = self._states(rows), self._goals[rows]
        remaining = self.task.remaining(states, goals)
        self.errors[rows] = self.task.errors(remaining)
        if self._source.has_sensor_errors:
            states = self._measured(states, rows)
            remaining = self.task.remaining(states, goals)
        self.observations[rows] = self.task.observe(states, remaining)

    def _measured(self, states: RobotStates, rows: Counts) -> RobotStates:
        size = 12 + 2 * self.robot.n
        normals = [self._generators[row].standard_normal(size) for row in rows.tolist()]
        parts = states.pose, states.twist, states.q, states.qdot
        measured = self._sensors[rows].measure(np.array(normals).reshape(-1, size), *parts)
        if not self._link:
            return RobotStates(*measured)
        places = self.robot.function("link_poses")(measured[2].T)[1].full()
        link = self.robot.link_names.index(self._link)
        return RobotStates(*measured, places.reshape(3, len(rows), -1)[:, :, link].T)

    def _states(self, rows: Any) -> RobotStates:
        flights = self._flights
        link_r = flights.link_r[rows] if self._link else None
        pose, twist = flights.pose[rows], flights.twist[rows]
        return RobotStates(pose, twist, flights.q[rows], flights.qdot[rows], link_r)


def _with_seed(plant: PlantConfig, rng: np.random.Generator) -> PlantConfig:
    """Return the configuration of a plant whose actuators have another noise in each episode."""
    return replace(plant, sensors=replace(plant.sensors, seed=int(rng.integers(2**31))))
