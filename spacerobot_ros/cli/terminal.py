"""Terminal output of a command: exit codes, one-sentence error messages, and progress."""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NoReturn

import click

from spacerobot_ros.errors import GoalError, PlanningError, SpaceRobotError
from spacerobot_ros.termination import Terminated, announce, guarded, termination

if TYPE_CHECKING:
    from spacerobot_ros.planning.core.progress import SearchProgress


_NOT_REACHED = 1
"""Exit code: the goal was not reached or is unreachable, or the bag differs from its
re-simulation. It is 0 on success, and 128 plus the number of a signal that ended the command."""

_BAD_INPUT = 2
"""Exit code: the input is invalid, or a required program or package is missing."""

_ROS_MODULES = ("rclpy", "rosidl_parser", "ament_index_python")

_LABEL = re.compile(r"\S+(?: \S+)* {2,}")
"""Words in front of a column."""

_UNBROKEN = re.compile(r"`[^`]*`|\d [a-zA-Zµ]")
"""A command, which can then be copied, or a number with its unit."""


def say(text: str, *, err: bool = False) -> None:
    """Print a line; on a terminal, wrap a long line and align it after its label, if any.

    Commands in backticks stay whole, and numbers stay with their units.
    """
    if (sys.stderr if err else sys.stdout).isatty():
        text = "\n".join(map(_wrapped, text.splitlines()))
    click.echo(text, err=err)


def _wrapped(line: str) -> str:
    width = shutil.get_terminal_size().columns
    label = _LABEL.match(line)
    kept = _UNBROKEN.sub(lambda found: found[0].replace(" ", "\0"), line)
    return textwrap.fill(
        kept,
        width,
        subsequent_indent=" " * (label.end() if label and 2 * label.end() < width else 0),
        break_long_words=False,
        break_on_hyphens=False,
    ).replace("\0", " ")


def fail(message: str = "") -> NoReturn:
    """End a failed command with a message."""
    if message:
        say(message, err=True)
    sys.exit(_NOT_REACHED)


def end(ending: Terminated) -> NoReturn:
    """Print one line and end a command stopped by a signal."""
    announce(ending)
    sys.exit(ending.exit_code)


def exit_if_terminated() -> None:
    """End a command interrupted by a signal, after its output is written."""
    ending = termination()
    if ending is not None:
        end(ending)


@contextmanager
def sentences() -> Iterator[None]:
    """Convert exceptions from this package into a one-sentence message and an exit code.

    An unreachable goal does not count as invalid input; all other rejections do. A signal ends the
    command with one line and exit code 128 plus the signal number, even if a library has replaced
    the exception.
    """
    try:
        with guarded():
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
        say(str(error), err=True)
        sys.exit(_NOT_REACHED if out_of_reach else _BAD_INPUT)
    except BrokenPipeError:
        # The reader, such as `head`, has ended. The interpreter flushes standard output at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(128 + signal.SIGPIPE)
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        say("Standard output cannot be written: no space is left on its device.", err=True)
        sys.exit(_BAD_INPUT)
    except ImportError as error:
        if not error.name or error.name.split(".")[0] not in _ROS_MODULES:
            raise
        say(
            f"ROS 2 was not found ({error}); source its setup file, or install spacerobot_ros "
            "with its extra [jazzy].",
            err=True,
        )
        sys.exit(_BAD_INPUT)


_PERIOD, _PERIOD_WITHOUT_TERMINAL = 1.0, 10.0
"""Wall time between two progress lines, s."""


class Display:
    """A progress line for long tasks: the task, the elapsed time, and the best result so far.

    On a terminal, each line replaces the previous line. Searches report from other threads and may
    be silent for a long time, so a separate thread writes the line.

    Parameters
    ----------
    label
        Name of the scenario or robot.
    period
        Wall time before the first line and between lines, s; None: 1 s, or 10 s if standard error
        is not a terminal.
    """

    def __init__(self, label: str, period: float | None = None) -> None:
        self._label, self._terminal = label, sys.stderr.isatty()
        usual = _PERIOD if self._terminal else _PERIOD_WITHOUT_TERMINAL
        self._period = usual if period is None else period
        self._work, self._course = "preparing", ""
        self._began, self._ended = time.monotonic(), threading.Event()
        self._lock = threading.Lock()
        self._thread = threading.Thread(target=self._write_lines, daemon=True)
        self._thread.start()

    def search(self, progress: SearchProgress) -> None:
        """Show the progress of a search before the flight."""
        if self._work != "flying":
            self._work, self._course = "planning", f": {progress.message}"

    def fly(self, now: float, end: float) -> None:
        """Show the simulated time and the end of the schedule in s, unless it has passed."""
        if end > 0.0 or now > 0.0:
            of_end = f" of {end:.1f}" if end >= now else ""
            self._work, self._course = "flying", f": {now:.1f}{of_end} s"

    def show_line(self, message: str) -> None:
        """Print a permanent line, if standard error is a terminal."""
        with self._lock:
            if self._terminal:
                click.echo(f"{_CLEAR}{message}", err=True)

    def close(self) -> None:
        """End the progress output; on a terminal, the last line is cleared."""
        self._ended.set()
        self._thread.join()

    def _write_lines(self) -> None:
        written = False
        while not self._ended.wait(self._period):
            elapsed = time.monotonic() - self._began
            line = f"{self._work} {self._label} for {elapsed:.0f} s{self._course}"
            with self._lock, suppress(OSError):  # The terminal may be closed.
                if self._terminal:
                    width = shutil.get_terminal_size().columns - 1
                    line = f"{_CLEAR}{line[:width]}"
                click.echo(line, err=True, nl=not self._terminal)
                written = True
        if written and self._terminal:
            click.echo(_CLEAR, err=True, nl=False)


_CLEAR = "\r\x1b[K"
"""Clears the last line on a terminal."""


@contextmanager
def display(label: str) -> Iterator[Display]:
    """Show the progress of a long task in a ``with`` block."""
    from spacerobot_ros.planning.core.progress import report_progress

    shown = Display(label)
    try:
        with report_progress(shown.search, shown.show_line):
            yield shown
    finally:
        shown.close()
