"""Episodes of N robots: starts and goals that are drawn, steps of the plant, rewards and ends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from os import PathLike, fspath
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.batch import InitialStates, SensorErrors, SteppedFlights
from spacerobot_ros.campaign.config import Campaign, load_campaign
from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.targets import DrawnFlight, description_of
from spacerobot_ros.environments.tasks import (
    TASKS,
    Reorient,
    RewardWeights,
    RobotStates,
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
from spacerobot_ros.simulation.config import OrbitConfig, TableConfig
from spacerobot_ros.simulation.plant import InitialState

_MAX_DRAWS = 10_000
_MAX_REFUSED_DRAWS = 100
_DEFAULT_SCENARIOS = {"reorient": "arm_attitude", "reach": "reach"}

_GOALS = ("random", "scenario")

Counts = npt.NDArray[np.int64]


@dataclass(frozen=True)
class EpisodeConfig:
    """What episodes are about: the keyword arguments of the environments.

    Attributes
    ----------
    task
        ``reorient``: the joints turn the base; ``reach``: a link goes to a position.
    scenario
        Name or file of a scenario, or of a robot; empty: the task's own.
    campaign
        File of a campaign, whose draws are the starts, masses and goals; empty: none.
    hold
        Ticks of the plant in a step, in which the action is held.
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
        Link that reaches; empty: that of the scenario, else the robot's end-effector.
    max_force, max_torque
        Force (N) and torque (N m) on the base of an action of one under efforts; 0: those of the
        scenario's controller, and if it has none, actions have no wrench.
    action_scale
        Command of an action of ones; empty: limits of joints, force and torque.
    reward
        Changed weights of :class:`.RewardWeights`.
    """

    task: str
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
            There is no such argument, or a value is refused.
        """
        known = [each.name for each in fields(cls)]
        for name in arguments:
            if name not in known:
                raise ParameterError(
                    f"There is no argument '{name}' of environments; there are {', '.join(known)}."
                )
        return cls(**arguments)

    def __post_init__(self) -> None:
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
                f"Argument 'hold' is {self.hold!r}; it is a whole number of ticks, one at least."
            )
        for name in ("time_limit", "tolerance", "spread", "max_force", "max_torque"):
            value = getattr(self, name)
            if not (
                isinstance(value, int | float | np.integer | np.floating)
                and np.isfinite(value)
                and value >= 0.0
            ):
                raise ParameterError(f"Argument '{name}' is {value!r}; it must be finite, from 0.")
        if not isinstance(self.reward, Mapping | None):
            raise ParameterError(
                f"Argument 'reward' is {self.reward!r}; it must be a dictionary of weights."
            )
        if not self.time_limit:
            raise ParameterError("Argument 'time_limit' is 0; episodes take longer, in s.")
        if self.link and self.task != "reach":
            raise ParameterError(
                f"Argument 'link' is '{self.link}', and in task '{self.task}' no link reaches: "
                "leave it out, or take spacerobot/Reach-v0."
            )
        if self.scenario and self.campaign:
            raise ParameterError(
                "Arguments 'scenario' and 'campaign' are both given: a campaign names its scenario."
            )


@dataclass(frozen=True)
class _Start:
    """Start of an episode: a row of :class:`.InitialStates`, masses, and its scenario."""

    starts: InitialStates
    inertial: InertialParameters | None
    scenario: Scenario


class EpisodeStarts:
    """Starts of episodes: of a scenario, or of the draws of a campaign.

    Draws that are no robot or no start are omitted, with a warning.

    Raises
    ------
    ParameterError
        Scenario or campaign is refused, or has parts that environments do not have.
    """

    def __init__(self, config: EpisodeConfig) -> None:
        self._campaign: Campaign | None = None
        if config.campaign:
            self._campaign = load_campaign(Path(config.campaign))
            self.scenario = self._campaign.scenario
            draws = Draws(self._campaign)
            self._draws = [draws[number] for number in range(min(len(draws), _MAX_DRAWS))]
        else:
            self.scenario = scenario_or_robot(config.scenario or _DEFAULT_SCENARIOS[config.task])
        self.robot = SpaceRobot(description_of(self.scenario))
        _require_steppable(self.scenario, self.robot)
        self.nominal = _Start(self._row(self.scenario), None, self.scenario)
        self._made: dict[int, _Start | str] = {}
        """Starts of the draws by their numbers; texts are the reasons of refusals."""

    def _row(self, scenario: Scenario) -> InitialStates:
        return InitialStates.of(self.robot, [InitialState.of(scenario.plant)])

    def draw(self, rng: np.random.Generator, flights: SteppedFlights) -> _Start:
        """Return a start of one of the flights; of a campaign, one of its draws at random.

        Raises
        ------
        ParameterError
            A draw has a part that environments do not have, or too many are refused.
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
            f"{_MAX_REFUSED_DRAWS} draws of the campaign in succession are refused, the last "
            f"because: {start} Disperse within what the robot can have."
        )

    def _drawn(self, campaign: Campaign, number: int, flights: SteppedFlights) -> _Start | str:
        """Return the start of a draw, or the reason why there is none."""
        try:
            flight = drawn_flight(campaign, self._draws[number], DrawnFlight.of(self.scenario))
            start = self._row(flight.scenario)
            masses = flight.inertial or self.robot.inertial
            flights.require_startable(start, InertialParameters.stacked([masses]))
        except (ParameterError, RobotDescriptionError) as refusal:
            if not any(isinstance(each, str) for each in self._made.values()):
                warn_once(
                    f"Draw {number} of the campaign is left out, as are others that are refused: "
                    f"{refusal}"
                )
            return str(refusal)
        _require_steppable(flight.scenario, self.robot)
        return _Start(start, masses, flight.scenario)


def _require_steppable(scenario: Scenario, robot: SpaceRobot) -> None:
    plant = scenario.plant
    parts = {
        "faults": bool(plant.faults),
        "a target": plant.target.given,
        "a plant in MuJoCo": plant.engine == "mujoco",
        "disturbances, an orbit or a table": (plant.disturbances, plant.orbit, plant.table)
        != ((), OrbitConfig(), TableConfig()),
        "thrusters that are on or off": bool(plant.thrusters),
        "errors of sensors": bool(SensorErrors.of(robot, [plant.sensors]).is_active[0]),
    }
    for part, given in parts.items():
        if given:
            raise ParameterError(
                f"Scenario '{scenario.name}' has {part}, which environments do not have: leave "
                "them out by another scenario or campaign."
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
        Whether the robots are in SIMD lanes, or in a plant each.
    """

    def __init__(self, config: EpisodeConfig, count: int, *, in_lanes: bool) -> None:
        if not isinstance(count, int | np.integer) or count < 1:
            raise ParameterError(f"There are {count!r} environments to make; take at least one.")
        self._config, self._weights = config, RewardWeights.of(config.reward)
        self._source = EpisodeStarts(config)
        scenario, self.robot = self._source.scenario, self._source.robot
        plant = scenario.plant
        self._goals_of_scenario = (config.goals or _GOALS[bool(config.campaign)]) == "scenario"
        self._link = self._reaching_link(scenario) if config.task == "reach" else ""
        first = self._source.nominal.starts
        self._flights = SteppedFlights(
            self.robot,
            plant.actuation,
            plant.control_period,
            InitialStates(
                *(np.repeat(getattr(first, each.name), count, axis=0) for each in fields(first))
            ),
            integration_step=plant.integration_step,
            link=self._link,
            in_lanes=in_lanes,
        )
        self.scale, self.taken = self._action_scale(scenario)
        wrench = self.taken[self.taken >= self.robot.n] - self.robot.n
        pushed = bool((wrench < 3).any()), bool((wrench >= 3).any())
        self.task: Task = TASKS[config.task](self.robot, self._link, pushed)
        self._tolerance = config.tolerance or self.task.tolerance
        self._spread = config.spread or self.task.spread
        self._goals = np.zeros((count, self.task.goal_size))
        self._goals[:, -1] = 1.0
        self.step_duration = config.hold * plant.control_period
        self.rewards = np.zeros(count)
        self.terminations = np.zeros(count, dtype=np.bool_)
        self.truncations = np.zeros(count, dtype=np.bool_)
        self.reached = np.zeros(count, dtype=np.bool_)
        self._observe()

    def _reaching_link(self, scenario: Scenario) -> str:
        link = self._config.link or scenario.plant.end_effector_frame
        link = self.robot.description.end_effector(link)
        if not link:
            raise ParameterError(
                f"Robot '{self.robot.description.name}' has no end-effector that reaches: give "
                "argument 'link'."
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
        """Name of the engine that steps."""
        return self._flights.engine

    @property
    def flights(self) -> SteppedFlights:
        """The flights, whose states may be read."""
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
    ) -> None:
        """Begin the episodes of some rows again, by the random generators of all rows.

        ``goal``, one for all (goal_size,) or one for each row (N, goal_size), replaces the goals
        that are drawn.

        Raises
        ------
        ParameterError
            A draw or the goal is refused.
        """
        chosen = np.asarray(rows, dtype=np.int64)
        given = None if goal is None else self._checked_goals(goal)
        drawn = [self._source.draw(generators[row], self._flights) for row in chosen.tolist()]
        starts = InitialStates(
            *(
                np.concatenate([getattr(each.starts, part.name) for each in drawn])
                for part in fields(InitialStates)
            )
        )
        masses = [each.inertial for each in drawn if each.inertial is not None]
        self._flights.reset(chosen, starts, InertialParameters.stacked(masses) if masses else None)
        for row, each in zip(chosen.tolist(), drawn, strict=True):
            if given is not None:
                self._goals[row] = given[row]
            elif self._goals_of_scenario:
                self._goals[row] = self._goal_of(each.scenario)
            else:
                start = self._states(slice(row, row + 1))
                self._goals[row] = self.task.random_goal(start, self._spread, generators[row])
        self.terminations[chosen] = self.truncations[chosen] = False
        self.rewards[chosen] = 0.0
        self._observe()

    def _checked_goals(self, goal: Any) -> Array:
        """Return the given goals (N, goal_size) of all rows."""
        values, count, size = as_numbers(goal, "The goal"), len(self._goals), self.task.goal_size
        if values.shape not in ((size,), (count, size)) or not np.isfinite(values).all():
            raise ParameterError(
                f"The goal is {values.shape}; task '{self.task.name}' takes {size} finite numbers, "
                f"or ({count}, {size}) for the robots one by one."
            )
        goals = np.broadcast_to(values, (count, size))
        if isinstance(self.task, Reorient):
            sizes = np.linalg.norm(goals, axis=1, keepdims=True)
            if sizes.min() < 1e-3:
                raise ParameterError("The goal is a quaternion of zeros, which is not an attitude.")
            return np.asarray(goals / sizes)
        return goals

    def _goal_of(self, scenario: Scenario) -> Array:
        if isinstance(self.task, Reorient):
            return scenario.goal.quaternion
        for each in scenario.goal.end_effectors:
            if each.link == self._link:
                return each.position
        if scenario.end_effector_goal is None:
            raise ParameterError(
                f"Scenario '{scenario.name}' has no goal of link '{self._link}': take random goals."
            )
        return scenario.end_effector_goal.position

    def end(self, rows: Counts) -> None:
        """End episodes: they are not stepped until they begin again."""
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
        under_way, before = self._flights.has_not_ended.copy(), self.errors
        self._flights.step(command_of(shares, self.scale, self.taken), self._config.hold)
        self._observe()
        weights, seconds = self._weights, self.step_duration
        reached = self._flights.has_not_ended & (self.errors <= self._tolerance)
        failed = under_way & ~self._flights.has_not_ended
        square = np.mean(np.clip(shares, -1.0, 1.0) ** 2, axis=1)
        reward = weights.progress * (before - self.errors)
        reward -= seconds * (weights.time + weights.action * square)
        reward += weights.reached * reached - weights.failed * failed
        self.rewards = np.where(under_way, reward, 0.0)
        self.reached = reached
        self.terminations = reached | failed
        late = self._flights.time > self._config.time_limit - 0.5 * seconds
        self.truncations = self._flights.has_not_ended & late & ~reached

    def _observe(self) -> None:
        states = self._states(slice(None))
        remaining = self.task.remaining(states, self._goals)
        self.errors = self.task.errors(remaining)
        self.observations = self.task.observe(states, remaining)

    def _states(self, rows: slice) -> RobotStates:
        flights = self._flights
        link_r = flights.link_r[rows] if self._link else None
        pose, twist = flights.pose[rows], flights.twist[rows]
        return RobotStates(pose, twist, flights.q[rows], flights.qdot[rows], link_r)
