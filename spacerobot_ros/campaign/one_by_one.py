"""Draws flown one by one, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from spacerobot_ros.campaign.config import FLIGHTS, Campaign
from spacerobot_ros.campaign.dataset import Row
from spacerobot_ros.campaign.draws import Draw, drawn_flight
from spacerobot_ros.campaign.targets import DrawnFlight, description_of
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.lockstep import Robots, fly_scenario, require_flyable
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.shared_parameters import AssumedRobotConfig, RobotConfig, robot_of
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.registry import METHODS, build_method
from spacerobot_ros.scenario import Scenario


class FlightsEngine:
    """Engine that flies draws one by one; an invalid draw does not affect the other draws."""

    name = FLIGHTS
    efficient_flights = 1

    def refusal(self, campaign: Campaign) -> str:
        """Return the reason why this engine cannot fly a campaign, as a clause."""
        try:
            require_flyable(campaign.scenario)
        except SpaceRobotError as error:
            return str(error)
        return ""

    def fly(
        self, campaign: Campaign, draws: Iterable[Draw], stopped: Callable[[], bool]
    ) -> Iterator[Row]:
        """Yield a row for each draw until the campaign is stopped."""
        common = DrawnFlight.of(campaign.scenario)
        for draw in draws:
            if stopped():
                return
            try:
                flight = drawn_flight(campaign, draw, common)
                flown = fly_scenario(
                    flight.seeded_scenario,
                    robots=robots_of(flight),
                    progress=lambda now, end: stopped(),
                    longest=campaign.max_flight_time,
                )
                if stopped() and flown.outcome is Outcome.INTERRUPTED:
                    return
                yield Row.of(campaign, draw, flown, self.name)
            except Exception as error:  # The error becomes a row with its message as the reason.
                yield Row.of_error(draw, error, self.name)


def robots_of(flight: DrawnFlight) -> Robots:
    """Return the models for a flight; draws that differ only in masses share the models."""
    scenario = flight.scenario
    robots = nominal_robots(scenario)
    if "planner" in scenario.commanders:
        robots = replace(robots, method=_method_of_planner(robots.planner, scenario.planner))
    weighing = plant_robot(flight)
    if flight.inertial is not None:
        weighing = weighing.with_inertial(flight.inertial)
    elif flight.has_target_masses:
        # Robots that share their functions have targets that share them, too.
        weighing = weighing.with_masses_of(weighing.description)
    else:
        return robots
    return replace(robots, plant=weighing)


def nominal_robots(scenario: Scenario) -> Robots:
    """Return the models for a scenario without mass dispersions; every call returns the same
    objects."""
    plant = description_of(scenario).urdf

    def build(node: str, config: RobotConfig) -> SpaceRobot | None:
        # Commanders without a robot parameter use the plant's robot.
        text = config.robot_description or ("" if config.robot else plant)
        errors: tuple[float, int] | tuple[()] = ()
        if isinstance(config, AssumedRobotConfig):
            errors = config.model_error, config.model_error_seed
        return _build_robot(node, AssumedRobotConfig(text, config.robot, config.world, *errors))

    return Robots.of(scenario, build)


_last_planner_method: tuple[tuple[Any, ...], GaitMethod] | None = None
"""What determines the last planner's gait method (robot, configuration, classes), and the method;
all flights share the solvers of the method, but no plan depends on another plan."""


def _method_of_planner(robot: SpaceRobot, config: PlannerConfig) -> GaitMethod:
    """Return the gait method of a planner; an equal planner reuses the last flight's method."""
    global _last_planner_method
    last, key = _last_planner_method, (robot, config, dict(METHODS))
    if last is None or last[0] != key:
        times = config.control_period, config.integration_step
        clearance = Clearance.wanted(robot.description, config.clearance)
        method = build_method(config.method, robot, *times, config.method_options, clearance)
        last = _last_planner_method = key, method
    return last[1]


def plant_robot(flight: DrawnFlight) -> SpaceRobot:
    """Return the plant's robot without mass dispersions."""
    robot = _build_robot("plant", AssumedRobotConfig(flight.nominal.urdf))
    assert robot is not None
    return robot


@lru_cache(maxsize=32)
def _build_robot(node: str, config: AssumedRobotConfig) -> SpaceRobot | None:
    # Each node has its own robot, because a robot's functions have buffers.
    return robot_of(config)


class FirstPlans:
    """The planner's schedules for the first states of draws.

    A schedule is reused for the next draw if all values that determine it are equal.
    """

    def __init__(self) -> None:
        self._last_scenario: tuple[Scenario, Any] | None = None
        """The last scenario, common to many draws, and its :func:`_planned_values`."""
        self._last_plan: tuple[Any, GaitSchedule | None] | None = None
        """The last plan made from a noise-free state, and the values that determine this plan."""

    def schedule(self, flight: DrawnFlight) -> GaitSchedule | None:
        """Return the schedule from the first state; None if no complete schedule begins there."""
        if self._last_scenario is None or self._last_scenario[0] is not flight.scenario:
            self._last_scenario = flight.scenario, _planned_values(flight.scenario)
        values = self._last_scenario[1]
        if values is None:
            return _first_plan(flight)
        others, depends_on_masses = values
        masses = flight.inertial if depends_on_masses else None
        key = others, None if masses is None else masses.vector.tolist()
        if self._last_plan is None or self._last_plan[0] != key:
            self._last_plan = key, _first_plan(flight)
        return self._last_plan[1]


def _planned_values(scenario: Scenario) -> tuple[Any, bool] | None:
    """Return all values that determine a plan for the first state, except the masses of the plant's
    robot, and whether the plan depends on these; None if the first measured state has noise."""
    plant, goal = scenario.plant, scenario.goal
    sensors = {name: value for name, value in vars(plant.sensors).items() if name != "seed"}
    if any(np.any(value) for value in sensors.values()):
        return None
    # Plans from rest do not depend on the masses of the plant's robot.
    moving = any(plant.linear_momentum) or any(plant.angular_momentum)
    shape = None if goal.joint_positions is None else goal.joint_positions.tolist()
    pose = goal.position.tolist(), goal.quaternion.tolist()
    others = scenario.planner, {**vars(plant), "sensors": sensors}, *pose, shape
    return others, bool(moving or plant.initial_center_of_mass)


def _first_plan(flight: DrawnFlight) -> GaitSchedule | None:
    """Let the executive plan for the first state; None if there is no complete schedule."""
    period = flight.scenario.plant.control_period
    first = fly_scenario(flight.seeded_scenario, robots=robots_of(flight), longest=period)
    if len(first.schedules) != 1 or first.gait is None:
        return None
    ((begins_ns, schedule),) = first.schedules
    return None if begins_ns or schedule.partial or not schedule.ticks else schedule
