"""Exit codes of commands, and one sentence where a command does not succeed."""

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
    """The goal was reached within tolerance; the bag is as it should be; nothing was refused."""

    NOT_REACHED = 1
    """The goal was not reached or cannot be reached; the bag differs."""

    BAD_INPUT = 2
    """The input is refused, or a program or package that the command needs is missing."""

    INTERRUPTED = 130
    """By SIGINT, that is Ctrl-C; 128 plus the number of another signal: 129 SIGHUP, 143 SIGTERM."""


_ROS_MODULES = ("rclpy", "rosidl_parser", "ament_index_python")


def fail(message: str = "") -> NoReturn:
    """End a command without success, with a message."""
    if message:
        click.echo(message, err=True)
    sys.exit(ExitCode.NOT_REACHED)


def end(ending: Terminated) -> NoReturn:
    """End a command that a signal has ended, with one line."""
    announce(ending)
    sys.exit(ending.exit_code)


def end_if_requested() -> None:
    """End a command whose work a signal has cut short, after its output is written."""
    ending = termination()
    if ending is not None:
        end(ending)


@contextmanager
def sentences() -> Iterator[None]:
    """End the process with one sentence and its exit code where an exception of ours is raised.

    A goal that a method cannot reach is no bad input; everything else that is refused is. A signal
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
