"""How a command ends: its exit codes, and one sentence where its input is refused."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import wraps
from typing import Any

import click

from spacerobot_ros.errors import SpaceRobotError

GOAL_NOT_REACHED = 1
BAD_INPUT = 2

_ROS = ("rclpy", "rosidl_parser", "ament_index_python")


def sentences(command: Callable[..., None]) -> Callable[..., None]:
    """End a command with one sentence and exit code 2 where its input is refused."""

    @wraps(command)
    def wrapped(*arguments: Any, **options: Any) -> None:
        try:
            command(*arguments, **options)
        except SpaceRobotError as error:
            click.echo(str(error), err=True)
            sys.exit(BAD_INPUT)
        except ImportError as error:
            if error.name and error.name.split(".")[0] in _ROS:
                click.echo(
                    f"ROS 2 was not found ({error}); source its setup file, or install "
                    "spacerobot_ros with its extra [jazzy].",
                    err=True,
                )
                sys.exit(BAD_INPUT)
            raise

    return wrapped
