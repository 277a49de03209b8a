"""Where a node takes its robot from: a URDF text, a file, or a robot of this package by name."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes.parameters import ParameterSpec, Value
from spacerobot_ros.resources import resource_names, share_directory

ROBOT_SPECS = (
    ParameterSpec("robot_description", "", "", "URDF text of the robot; goes before 'robot'"),
    ParameterSpec(
        "robot", "", "", "URDF file, or the name of a robot of this package (sliding_masses, ...)"
    ),
)


def robot_of(parameters: Mapping[str, Value]) -> SpaceRobot | None:
    """Return the robot that the parameters name, or None when they name none.

    Raises
    ------
    ParameterError
        There is no such file or robot.
    RobotDescriptionError
        Its URDF is refused.
    """
    text, name = str(parameters["robot_description"]), str(parameters["robot"])
    if text:
        return SpaceRobot.from_urdf(text)
    if not name:
        return None
    path = Path(name)
    if path.suffix != ".urdf":
        path = share_directory() / "urdf" / f"{name}.urdf"
    if not path.is_file():
        known = ", ".join(resource_names("urdf", ".urdf"))
        raise ParameterError(
            f"Parameter 'robot' is '{name}': there is no such URDF file, nor a robot of that name "
            f"(known: {known})."
        )
    return SpaceRobot.from_file(path)
