"""Sources of a robot: a URDF text, a file, or the name of a robot of this package."""

from __future__ import annotations

from dataclasses import dataclass

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.model_functions import SymbolicModels
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.urdf import load_robot, parse_robot
from spacerobot_ros.parameters import parameter
from spacerobot_ros.resources import robot_file


@dataclass(frozen=True)
class RobotConfig:
    """Which robot it is."""

    robot_description: str = parameter("", "URDF text of the robot; takes precedence over 'robot'")
    robot: str = parameter(
        "", "URDF file, or the name of a robot of this package (sliding_masses, ...)"
    )

    def believed(self, robot: RobotDescription) -> RobotDescription:
        """Return the robot as the owner of this configuration models it."""
        return robot


@dataclass(frozen=True)
class BelievedRobotConfig(RobotConfig):
    """Which robot it is, for flight software whose model may differ from the plant's."""

    model_error: float = parameter(
        0.0, "masses and inertias are wrong by up to this share", minimum=0.0, maximum=0.9
    )
    model_error_seed: int = parameter(0, "seed of the draw of the wrong factors", minimum=0)

    def believed(self, robot: RobotDescription) -> RobotDescription:
        """Return the robot with its masses and inertias wrong by ``model_error``."""
        if self.model_error > 0.0:
            return robot.with_model_error(self.model_error, self.model_error_seed)
        return robot


def robot_of(config: RobotConfig) -> SpaceRobot | None:
    """Return the robot that a configuration names, None where it names none.

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
    return _believed(load_robot(path), config)


def robot_from_text(text: str, config: RobotConfig) -> SpaceRobot:
    """Return the robot of a URDF text, as the configuration's owner models it.

    Raises
    ------
    RobotDescriptionError
        The URDF is refused.
    """
    return _believed(parse_robot(text), config)


def _believed(true: RobotDescription, config: RobotConfig) -> SpaceRobot:
    believed = config.believed(true)
    # Robots that are believed to weigh something else share their compiled functions.
    return SpaceRobot(believed, None if believed is true else SymbolicModels.of(true))
