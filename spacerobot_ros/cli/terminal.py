"""The terminal of a command: exit codes, one-sentence messages of failures, and progress bars."""

from __future__ import annotations

import errno
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from enum import IntEnum
from typing import TYPE_CHECKING, Any, NoReturn

import click

from spacerobot_ros.errors import GoalError, PlanningError, SpaceRobotError
from spacerobot_ros.termination import Terminated, announce, guarded, termination

if TYPE_CHECKING:
    from spacerobot_ros.planning.core.progress import SearchProgress


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
        click.echo(str(error), err=True)
        sys.exit(ExitCode.NOT_REACHED if out_of_reach else ExitCode.BAD_INPUT)
    except OSError as error:
        if error.errno != errno.ENOSPC or error.filename is not None:
            raise
        click.echo("Standard output cannot be written: no space is left on its device.", err=True)
        sys.exit(ExitCode.BAD_INPUT)
    except ImportError as error:
        if not error.name or error.name.split(".")[0] not in _ROS_MODULES:
            raise
        click.echo(
            f"ROS 2 was not found ({error}); source its setup file, or install spacerobot_ros "
            "with its extra [jazzy].",
            err=True,
        )
        sys.exit(ExitCode.BAD_INPUT)


_BAR_STEPS = 1000


class Display:
    """Progress bars: one for the search, with the best result so far, then one for the flight.

    Searches report in threads of their own.

    Parameters
    ----------
    label
        Name of the scenario or robot.
    visible
        Whether anything is shown.
    """

    def __init__(self, label: str, *, visible: bool) -> None:
        self._label, self._visible = label, visible
        self._bar: Any = None
        self._flies = False
        self._lock = threading.Lock()

    def search(self, progress: SearchProgress) -> None:
        """Show the progress of a search before the flight."""
        with self._lock:
            if self._flies or not self._visible:
                return
            if self._bar is None or progress.starts < self._bar.pos:
                self._begin_bar(f"planning {self._label}", progress.max_starts)
            self._bar.length = progress.max_starts
            self._bar.update(progress.starts - self._bar.pos, progress.message)
            self._bar.render_progress()

    def fly(self, now: float, end: float) -> None:
        """Show simulated time against the end of the schedule, s; 0: there is none yet."""
        with self._lock:
            if not self._visible or end <= 0.0:
                return
            if not self._flies:
                self._flies = True
                self._begin_bar(f"flying {self._label}", _BAR_STEPS)
            steps = max(0, round(_BAR_STEPS * min(now / end, 1.0)) - self._bar.pos)
            self._bar.update(steps, f"{now:.1f} of {end:.1f} s")

    def show_line(self, message: str) -> None:
        """Print a line above the progress bar."""
        with self._lock:
            if self._visible:
                self._finish_bar()
                click.echo(message, err=True)

    def close(self) -> None:
        """Finish the progress bar."""
        with self._lock:
            self._finish_bar()

    def _begin_bar(self, label: str, length: int) -> None:
        self._finish_bar()
        self._bar = click.progressbar(
            length=length,
            label=label,
            file=sys.stderr,
            show_eta=False,
            show_percent=False,
            item_show_func=lambda item: item or "",
            bar_template="%(label)s  [%(bar)s]  %(info)s",
            width=24,
        )
        self._bar.__enter__()

    def _finish_bar(self) -> None:
        bar, self._bar = self._bar, None
        if bar is not None:
            bar.__exit__(None, None, None)


@contextmanager
def display(label: str) -> Iterator[Display]:
    """Show progress bars during a block; without a terminal they are not imported."""
    shown = Display(label, visible=sys.stderr.isatty())
    try:
        if not sys.stderr.isatty():
            yield shown
            return
        from spacerobot_ros.planning.core.progress import report_progress

        with report_progress(shown.search, shown.show_line):
            yield shown
    finally:
        shown.close()
