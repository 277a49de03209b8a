"""Exit codes of commands, and the one-sentence messages of commands that fail."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import NoReturn

import click

from spacerobot_ros.errors import GoalError, PlanningError, SpaceRobotError
from spacerobot_ros.termination import Terminated, announce, guarded, termination


class ExitCode(IntEnum):
    """Exit codes of the command line."""

    DONE = 0
    """Success: the goal was reached within tolerance, or the bag is verified."""

    NOT_REACHED = 1
    """The goal was not or cannot be reached, or the bag differs from its re-simulation."""

    BAD_INPUT = 2
    """The input is refused, or a program or package that the command needs is missing."""

    INTERRUPTED = 130
    """The command was ended by SIGINT (Ctrl-C); other signals give 128 plus their number."""


_ROS_MODULES = ("rclpy", "rosidl_parser", "ament_index_python")


def fail(message: str = "") -> NoReturn:
    """End a failed command with a message."""
    if message:
        click.echo(message, err=True)
    sys.exit(ExitCode.NOT_REACHED)


def end(ending: Terminated) -> NoReturn:
    """End a command that a signal has ended, with one line."""
    announce(ending)
    sys.exit(ending.exit_code)


def exit_if_terminated() -> None:
    """End a command whose work a signal has cut short, after its output is written."""
    ending = termination()
    if ending is not None:
        end(ending)


@contextmanager
def sentences() -> Iterator[None]:
    """Turn exceptions of this package into one sentence and an exit code.

    An unreachable goal is no bad input; every other refusal is. A signal
    ends it with one line and 128 plus its number, even if a library has replaced its exception.
    """
    try:
        with guarded(announcing=True):
            try:
                yield
            except Exception as error:
                ending = termination()
                if ending is None:
                    raise
                raise ending from error
    except Terminated as ending:
        end(ending)
    except SpaceRobotError as error:
        out_of_reach = isinstance(error, PlanningError) and not isinstance(error, GoalError)
        click.echo(str(error), err=True)
        sys.exit(ExitCode.NOT_REACHED if out_of_reach else ExitCode.BAD_INPUT)
    except ImportError as error:
        if not error.name or error.name.split(".")[0] not in _ROS_MODULES:
            raise
        click.echo(
            f"ROS 2 was not found ({error}); source its setup file, or install spacerobot_ros "
            "with its extra [jazzy].",
            err=True,
        )
        sys.exit(ExitCode.BAD_INPUT)
