"""Draws flown one by one, without ROS."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache

from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.draws import Draw, drawn_flight
from spacerobot_ros.campaign.rows import Row
from spacerobot_ros.campaign.targets import DrawnFlight, description_of
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import Robots, fly_scenario, require_flyable
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.shared_parameters import AssumedRobotConfig, RobotConfig, robot_of
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.registry import build_method
from spacerobot_ros.scenario import Scenario


class FlightsEngine:
    """Engine that flies draws one by one; an invalid draw does not affect the other draws."""

    name = "flights"
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
                flown = self.fly_draw(campaign, drawn_flight(campaign, draw, common), stopped)
                if stopped() and flown.outcome is Outcome.INTERRUPTED:
                    return
                yield Row.of(campaign, draw, flown, self.name)
            except Exception as error:  # The error becomes a row with its message as the reason.
                yield Row.of_error(draw, error, self.name)

    def fly_draw(
        self, campaign: Campaign, flight: DrawnFlight, stopped: Callable[[], bool] = lambda: False
    ) -> Flight:
        """Fly one draw; raise :class:`.SpaceRobotError` if it is refused."""
        return fly_scenario(
            flight.seeded_scenario,
            robots=robots_of(flight),
            progress=lambda now, end: stopped(),
            longest=campaign.max_flight_time,
        )


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
        text = config.robot_description
        if not (config.robot or text):
            text = plant  # Commanders without a robot parameter use the plant's robot.
        error, seed = 0.0, 0
        if isinstance(config, AssumedRobotConfig):
            error, seed = config.model_error, config.model_error_seed
        return _build_robot(node, text, config.robot, config.world, error, seed)

    return Robots.of(scenario, build)


_last_planner_method: tuple[SpaceRobot, PlannerConfig, GaitMethod] | None = None
"""Robot, configuration and gait method of the last planner; all flights share the solvers of the
method, but no plan depends on another plan."""


def _method_of_planner(robot: SpaceRobot, config: PlannerConfig) -> GaitMethod:
    """Return the gait method of a planner; an equal planner reuses the last flight's method."""
    global _last_planner_method
    if _last_planner_method is not None and _last_planner_method[0] is robot:
        known, method = _last_planner_method[1:]
        if known is config or known == config:
            return method
    method = build_method(
        *(config.method, robot, config.control_period, config.integration_step),
        config.method_options,
        Clearance.wanted(robot.description, config.clearance),
    )
    _last_planner_method = robot, config, method
    return method


def plant_robot(flight: DrawnFlight) -> SpaceRobot:
    """Return the plant's robot without mass dispersions."""
    robot = _build_robot("plant", flight.nominal.urdf, "", "", 0.0, 0)
    assert robot is not None
    return robot


@lru_cache(maxsize=32)
def _build_robot(
    node: str, text: str, name: str, world: str, error: float, seed: int
) -> SpaceRobot | None:
    # Each node has its own robot, because a robot's functions have buffers.
    if error:
        return robot_of(AssumedRobotConfig(text, name, world, error, seed))
    return robot_of(RobotConfig(text, name, world))
