"""Where a node takes its robot from: a URDF text, a file, or a robot of this package by name."""

from __future__ import annotations

from collections.abc import Mapping

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.uncertainty import with_model_error
from spacerobot_ros.model.urdf import load_robot, parse_robot
from spacerobot_ros.nodes.common.parameters import ParameterSpec, Value
from spacerobot_ros.resources import robot_file

ROBOT_SPECS = (
    ParameterSpec("robot_description", "", "", "URDF text of the robot; goes before 'robot'"),
    ParameterSpec(
        "robot", "", "", "URDF file, or the name of a robot of this package (sliding_masses, ...)"
    ),
)


MODEL_ERROR_SPECS = (
    ParameterSpec(
        "model_error", 0.0, "", "masses and inertias are believed wrong by up to this share", 0, 0.9
    ),
    ParameterSpec("model_error_seed", 0, "", "of the draw of the wrong factors", 0),
)
"""Of nodes whose model may differ from the plant's."""


def robot_of(parameters: Mapping[str, Value]) -> SpaceRobot | None:
    """Return the robot that the parameters name, or None when they name none.

    A node with a ``model_error`` gets the robot that it believes in.

    Raises
    ------
    ParameterError
        There is no such file or robot.
    RobotDescriptionError
        Its URDF is refused.
    """
    text, name = str(parameters["robot_description"]), str(parameters["robot"])
    if text:
        return robot_from_text(text, parameters)
    if not name:
        return None
    try:
        path = robot_file(name)
    except ParameterError as error:
        raise ParameterError(f"Parameter 'robot' is '{name}'. {error}") from None
    return _believed(load_robot(path), parameters)


def robot_from_text(text: str, parameters: Mapping[str, Value]) -> SpaceRobot:
    """Return the robot of a URDF text, as a node with a ``model_error`` believes it to be.

    Raises
    ------
    RobotDescriptionError
        The URDF is refused.
    """
    return _believed(parse_robot(text), parameters)


def _believed(robot: RobotDescription, parameters: Mapping[str, Value]) -> SpaceRobot:
    error, seed = parameters.get("model_error", 0.0), parameters.get("model_error_seed", 0)
    if isinstance(error, float) and isinstance(seed, int) and error > 0.0:
        robot = with_model_error(robot, error, seed)
    return SpaceRobot(robot)
