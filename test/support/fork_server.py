"""Tests that are run again and again with small errors in the package: a fork each time.

How tests are collected and run is in :mod:`support.forked`, a plugin of the process that this
module starts.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from enum import Enum
from pathlib import Path

from support.forked import ENDED, NOT_EXCHANGED, NotExchangedError

_MARK = "SPACEROBOT_FORK"
"""Variable by which processes that a fork leaves behind are found."""


def environment_of(project: Path, cache: Path) -> dict[str, str]:
    """Return the variables with which the tests of a copy of the project run."""
    paths = os.pathsep.join((str(project), str(project / "test")))
    return os.environ | {"PYTHONPATH": paths, "SPACEROBOT_CACHE_DIR": str(cache)}


def write_source(file: Path, source: str) -> None:
    """Write a file such that Python cannot take bytecode of the one before for it."""
    file.write_text(source)
    for compiled in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        compiled.unlink()


class How(str, Enum):
    """How a test notices an error."""

    FAILED = "failed"
    ENDLESS = "used more CPU time than an endless loop only"
    WAITED = "waited without an end, twice"
    CRASHED = "crashed"
    NOT_IMPORTED = "could not be imported"


class ForkServer:
    """A process that has collected tests and runs some of them in a fork at a time.

    Parameters
    ----------
    folder
        Where it writes what it prints.
    project, environment
        Where the tests are, and the variables that they run with; see :func:`environment_of`.
    files
        Files with tests; none: all.
    """

    def __init__(
        self, folder: Path, project: Path, environment: Mapping[str, str], files: Sequence[str]
    ) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        jobs, answers = os.pipe(), os.pipe()
        pipes = {"SPACEROBOT_FORK_PIPES": f"{jobs[0]} {answers[1]}"}
        options = ("-q", "-x", "-p", "no:cacheprovider", "-p", "support.forked")
        with (folder / "output").open("w") as output:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "pytest", *options, f"--basetemp={folder / 'tmp'}", *files],
                cwd=project,
                env={**environment, **pipes},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                pass_fds=(jobs[0], answers[1]),
                start_new_session=True,
            )
        os.close(jobs[0])
        os.close(answers[1])
        self._jobs, self._answers = os.fdopen(jobs[1], "w"), os.fdopen(answers[0])
        self.ready = self._answers.readline() == "ready\n"
        """False where tests could not be collected."""

    def run(
        self,
        limits: Mapping[str, tuple[float, float]],
        exchange: tuple[str, str] | None = None,
        **variables: str,
    ) -> tuple[str, How | None, list[str]]:
        """Run tests until one fails.

        Parameters
        ----------
        limits
            CPU and wall time (s) that each test may take, in the order in which they are run. A
            name without parameters stands for the test with all of them.
        exchange
            A file whose functions are to be those that it has now, and its text before.
        variables
            Of the environment, for these tests.

        Returns
        -------
        tuple
            The test that failed ("": none), how it did, and all that were begun.

        Raises
        ------
        NotExchangedError
            The file has to be imported anew for what differs.
        """
        log = self._folder / "log"
        log.write_text("")
        mark = f"{os.getpid()}-{id(self)}-{time.monotonic_ns()}"
        job = {
            "tests": dict(limits),
            "exchange": exchange,
            "environment": {**variables, _MARK: mark},
            "log": str(log),
        }
        self._jobs.write(json.dumps(job) + "\n")
        self._jobs.flush()
        answer = self._answers.readline()
        _end_what_is_left(mark)
        if not answer:
            raise RuntimeError(f"the process with the tests has ended; see {self._folder}")
        lines = log.read_text().splitlines()
        begun = [line for line in lines if line != ENDED]
        code = int(answer)
        if code == NOT_EXCHANGED:
            raise NotExchangedError(exchange)
        if code == 0 or not begun:
            return "", None, begun
        if lines[-1] == ENDED:
            how = How.FAILED
        elif code == -signal.SIGPROF:
            how = How.ENDLESS
        else:
            how = How.WAITED if code == 1 else How.CRASHED
        return begun[-1], how, begun

    def close(self) -> None:
        """End the process."""
        self._jobs.close()
        self._answers.close()
        try:
            self._process.wait(30.0)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()


def _end_what_is_left(mark: str) -> None:
    """End processes that a test has started and an error has kept from ending."""
    wanted = f"{_MARK}={mark}".encode()
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            if wanted in (entry / "environ").read_bytes().split(b"\0"):
                os.kill(int(entry.name), signal.SIGKILL)
        except OSError:
            continue
