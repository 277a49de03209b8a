"""A plugin of pytest: collects once, then runs some tests for each error in a fork of the process.

Loaded by `-p` with SPACEROBOT_MUTANT_PIPES set to two file descriptors. Each line of the first is a
job in JSON, answered on the second by a line with the exit code. Starting Python, importing
what the tests need and collecting them takes longer than most errors take to be noticed.

In the fork, functions that are imported already get the code of their file as it is by then, so
that whoever holds one has the changed one. What is executed while a file is imported cannot be
changed that way (:func:`can_be_exchanged`).
"""

from __future__ import annotations

import faulthandler
import gc
import json
import os
import resource
import signal
import sys
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any

import _pytest.main
import pytest

_WAITED = 120.0
"""Wall time (s) beyond which a test that does not use the processor hangs; a multiple of what it
takes otherwise comes on top."""

_MOST_MEMORY = 12 * 2**30
"""Address space of a fork, in bytes."""

_limits: dict[str, tuple[float, float]] = {}
"""CPU and wall time (s) that each test of a job may take."""

_log = Path(os.devnull)

ENDED = "-"
"""The line of the log after each test that came to its end."""


def limits_of(cpu: float, wall: float) -> tuple[float, float]:
    """Return the CPU and wall time (s) that a test may take which takes so much without an error.

    Load of the machine does not use CPU time of the test: only an endless loop does.
    """
    return 10.0 + 8.0 * cpu, _WAITED + 10.0 * wall


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool:
    jobs, answers = (int(n) for n in os.environ.pop("SPACEROBOT_MUTANT_PIPES").split())
    items = {item.nodeid: item for item in session.items}
    live: dict[str, dict[CodeType, list[FunctionType]]] = defaultdict(lambda: defaultdict(list))
    for thing in gc.get_objects():
        if type(thing) is FunctionType:
            live[thing.__code__.co_filename][thing.__code__].append(thing)
    gc.freeze()
    os.write(answers, b"ready\n")
    with os.fdopen(jobs) as lines:
        for line in lines:
            job = json.loads(line)
            child = os.fork()
            if child == 0:
                os.close(answers)
                _run(session, items, job, live)
            _, status = os.waitpid(child, 0)
            code = os.waitstatus_to_exitcode(status)
            os.write(answers, f"{code}\n".encode())
    return True


def _run(
    session: pytest.Session,
    items: dict[str, pytest.Item],
    job: dict[str, Any],
    live: dict[str, dict[CodeType, list[FunctionType]]],
) -> None:
    """Run the tests of a job until one fails, and end the process."""
    global _log
    code = 3
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (_MOST_MEMORY, _MOST_MEMORY))
        os.environ["SPACEROBOT_MUTANT"] = job["mark"]
        _log = Path(job["log"])
        _limits.update({name: tuple(limits) for name, limits in job["tests"].items()})
        if job["exchange"]:
            path, before = job["exchange"]
            exchange(before, Path(path).read_text(), path, live[path])
        session.items = [items[name] for name in job["tests"] if name in items]
        session.testscollected = len(session.items)
        with suppress(session.Failed, session.Interrupted):
            _pytest.main.pytest_runtestloop(session)
        code = 1 if session.testsfailed else 0
        faulthandler.dump_traceback_later(_WAITED, exit=True)
        # Fixtures of modules and of the session, where a failure has ended the run.
        session._setupstate.teardown_exact(None)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        os._exit(code)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    # Past pytest's capture, so that the driver reads it wherever the process ends.
    with _log.open("a") as log:
        log.write(f"{item.nodeid}\n")
    cpu, wall = _limits[item.nodeid]
    # SIGPROF ends the process, whatever it computes: Python or not.
    signal.setitimer(signal.ITIMER_PROF, cpu)
    faulthandler.dump_traceback_later(wall, exit=True)
    try:
        return (yield)
    finally:
        faulthandler.cancel_dump_traceback_later()
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        with _log.open("a") as log:
            log.write(f"{ENDED}\n")


# -- code of functions that are imported ------------------------------------------------------


def can_be_exchanged(before: str, after: str) -> bool:
    """Whether two texts of a file differ in the bodies of functions only."""
    return _differing(before, after, "") is not None


def exchange(before: str, after: str, path: str, live: dict[CodeType, list[FunctionType]]) -> None:
    """Give functions of a module that is imported the code of another text of its file."""
    for old, new in _differing(before, after, path) or ():
        for function in live.get(old, ()):
            function.__code__ = new


def _differing(before: str, after: str, path: str) -> list[tuple[CodeType, CodeType]] | None:
    """Return the functions that differ, or None where that is not all that differs."""
    pairs: list[tuple[CodeType, CodeType]] = []

    def compare(old: CodeType, new: CodeType) -> bool:
        inner_old, inner_new = _inner(old), _inner(new)
        if [c.co_name for c in inner_old] != [c.co_name for c in inner_new]:
            return False
        if old.co_freevars != new.co_freevars:
            return False
        if old != new:
            pairs.append((old, new))
        is_function = bool(old.co_flags & 0x2)  # CO_NEWLOCALS: neither a module nor a class.
        if not is_function and _alone(old) != _alone(new):
            return False
        return all(compare(a, b) for a, b in zip(inner_old, inner_new, strict=True))

    codes = [compile(text, path, "exec", dont_inherit=True) for text in (before, after)]
    return pairs if compare(codes[0], codes[1]) else None


def _inner(code: CodeType) -> list[CodeType]:
    return [c for c in code.co_consts if isinstance(c, CodeType)]


def _alone(code: CodeType) -> CodeType:
    """Return the code without that of the functions in it."""
    return code.replace(
        co_consts=tuple(c.co_name if isinstance(c, CodeType) else c for c in code.co_consts)
    )
