"""Parameters shared by several nodes: robot and model, watchdog, goals and tolerances."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.model_functions import SymbolicModels
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.urdf import load_robot, load_world, parse_robot, with_world
from spacerobot_ros.parameters import WatchdogConfig, nonnegative, parameter
from spacerobot_ros.resources import robot_file
from spacerobot_ros.times import SECOND

DEFAULT_TICK_RATE = 20.0
"""Default plant tick rate, Hz."""

_MIN_RATE = 0.001  # Hz

_MAX_STATE_GAP, _MAX_STATE_GAP_PERIODS = 1.0, 10
"""Longest gap between two states, in s and in control periods; longer gaps are considered time
jumps."""

DEFAULT_POSITION_TOLERANCE = 1e-3
"""Automatic position tolerance if no robot is known, m."""

_TOLERANCE_SHARE = 1e-3
"""Automatic position tolerance as a fraction of the robot size."""

_SMALLEST_TOLERANCE, _LARGEST_TOLERANCE = 1e-4, 1e-2
"""Bounds on automatic position tolerances, m."""

Config = TypeVar("Config", bound="CommanderConfig")


def automatic_tolerance(robot: RobotDescription) -> float:
    """Return the automatic position tolerance for a robot, m, to one significant digit."""
    tolerance = min(max(_TOLERANCE_SHARE * robot.size, _SMALLEST_TOLERANCE), _LARGEST_TOLERANCE)
    return float(f"{tolerance:.1g}")


@dataclass(frozen=True)
class RobotConfig:
    """The robot used by a node."""

    robot_description: str = parameter(
        "", "URDF string of the robot; takes precedence over 'robot'"
    )
    robot: str = parameter(
        "", "URDF file, or the name of a robot in this package (sliding_masses, ...)"
    )
    world: str = parameter(
        "", "URDF file with fixed obstacles; '': the obstacles in the robot's description"
    )

    def described(self, robot: RobotDescription) -> RobotDescription:
        """Return the robot with the obstacles and disabled pairs from this configuration.

        Raises
        ------
        ParameterError
            The obstacles are invalid.
        """
        if not self.world:
            return robot
        try:
            return with_world(robot, load_world(self.world))
        except RobotDescriptionError as error:
            raise ParameterError(f"Parameter 'world' is invalid: {error}") from error

    def assumed_robot(self, robot: RobotDescription) -> RobotDescription:
        """Return the robot with the mass properties assumed by the configured node."""
        return robot


@dataclass(frozen=True)
class AssumedRobotConfig(RobotConfig):
    """The robot model used by flight software; it may differ from the plant's model."""

    model_error: float = nonnegative(
        0.0, "largest relative error in masses and inertias", maximum=0.9
    )
    model_error_seed: int = nonnegative(0, "random seed for the mass and inertia errors")

    def assumed_robot(self, robot: RobotDescription) -> RobotDescription:
        """Return the robot with random relative mass and inertia errors of at most
        ``model_error``."""
        if self.model_error > 0.0:
            return robot.with_model_error(self.model_error, self.model_error_seed)
        return robot


def robot_of(config: RobotConfig) -> SpaceRobot | None:
    """Return the robot named in a configuration; None if no robot is named.

    Raises
    ------
    ParameterError
        There is no such file or robot.
    RobotDescriptionError
        Its URDF is refused.
    """
    if config.robot_description:
        return robot_from_text(config.robot_description, config)
    if not config.robot:
        return None
    try:
        path = robot_file(config.robot)
    except ParameterError as error:
        raise ParameterError(f"Parameter 'robot' is '{config.robot}'. {error}") from None
    return _with_model_error(load_robot(path), config)


def robot_from_text(text: str, config: RobotConfig) -> SpaceRobot:
    """Return the robot described by a URDF string, with the mass properties assumed by the node.

    Raises
    ------
    RobotDescriptionError
        The URDF is refused.
    """
    return _with_model_error(parse_robot(text), config)


def _with_model_error(true: RobotDescription, config: RobotConfig) -> SpaceRobot:
    true = config.described(true)
    believed = config.assumed_robot(true)
    # Models with other mass properties share their compiled functions.
    return SpaceRobot(believed, None if believed is true else SymbolicModels.of(true))


@dataclass(frozen=True)
class CommanderConfig(WatchdogConfig, AssumedRobotConfig):
    """Parameters of nodes that command a plant: rate, goals, tolerances."""

    tick_rate: float = nonnegative(
        0.0, "number of commands per second; 0: the tick rate of the plant", "Hz", maximum=100000.0
    )
    world_frame: str = parameter("world", "frame assumed for goals without a known frame")
    state_reliability: str = parameter(
        "auto",
        "reliability of the subscriptions to odom and joint_states; auto: reliable, or best "
        "effort if a publisher offers nothing else",
        choices=("auto", "reliable", "best_effort"),
    )
    diagnostics_period: float = nonnegative(
        1.0,
        "simulated time between diagnostics; 0: only when states are ignored. Also published once "
        "per second of wall time, except in single-process runs",
        "s",
    )
    position_tolerance: float = nonnegative(
        0.0,
        "largest position error at which a goal is considered reached; 0: a thousandth of the "
        "robot's diameter of gyration",
        "m",
        read_only=False,
    )
    attitude_tolerance: float = nonnegative(
        0.001,
        "largest attitude error at which a goal is considered reached",
        "rad",
        read_only=False,
    )
    joint_tolerance: float = nonnegative(
        0.001,
        "largest joint error at which a goal is considered reached",
        "m or rad",
        read_only=False,
    )
    resume_file: str = parameter(
        "", "file with the current goals, from which a restarted node resumes; '': none"
    )
    plan_in_background: bool = parameter(
        True,
        "plan in a thread while the robot keeps moving; if false, or with a lockstep plant, "
        "states are not processed until the plan is ready",
    )
    stop_when_decided: bool = parameter(
        False, "send no commands once a goal has finished; a lockstep plant then stays at that tick"
    )
    watchdog_action: str = parameter(
        "report",
        "reaction to a silent plant: report only, or also abort",
        choices=("report", "abort"),
    )

    def __post_init__(self) -> None:
        if 0.0 < self.tick_rate < _MIN_RATE:
            raise ParameterError(
                f"Parameter 'tick_rate' is {self.tick_rate}; it must be 0 (the plant's rate) or "
                f"at least {_MIN_RATE:g} Hz."
            )

    def for_robot(self: Config, robot: RobotDescription) -> Config:
        """Return the configuration with the automatic tolerance resolved for the robot."""
        if self.position_tolerance:
            return self
        return replace(self, position_tolerance=automatic_tolerance(robot))

    @property
    def longest_gap(self) -> float:
        """Largest time between two states that is not considered a time jump, s."""
        return max(_MAX_STATE_GAP, _MAX_STATE_GAP_PERIODS * self.control_period)

    @property
    def control_period(self) -> float:
        """Duration for which a command is held, s: a whole number of nanoseconds."""
        return round(SECOND / (self.tick_rate or DEFAULT_TICK_RATE)) / SECOND
