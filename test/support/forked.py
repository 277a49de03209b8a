"""A plugin of pytest: collects once, then runs some tests for each error in a fork of the process.

:mod:`support.fork_server` loads it, with SPACEROBOT_FORK_PIPES set to two file descriptors. Each
line of the first is a job in JSON, answered on the second by a line with the exit code. Starting
Python, importing what the tests need and collecting them takes longer than most errors take to be
noticed.

In the fork, functions that are imported already get the code of their file as it is by then, so
that whoever holds one has the changed one; defaults and constants are taken over likewise. What
other files have computed from them while they were imported stays.
"""

from __future__ import annotations

import ast
import faulthandler
import gc
import json
import os
import re
import resource
import signal
import struct
import sys
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from enum import EnumMeta
from functools import lru_cache
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import Any

import _pytest.main
import numpy as np
import pytest

WAITED = 120.0
"""Wall time (s) beyond which a test that does not use the processor hangs; a multiple of what it
takes otherwise comes on top."""

_MAX_MEMORY = 12 * 2**30
"""Address space of a fork, in bytes."""

_limits: dict[str, tuple[float, float]] = {}
"""CPU and wall time (s) that each test of a job may take."""

_log = Path(os.devnull)

_CACHED = type(lru_cache(int))

_caches: list[Any] = []
"""Functions of the package that remember results."""

NOT_EXCHANGED = 4
"""The exit code where a module has to be imported anew."""

ENDED = "-"
"""The line of the log after each test that came to its end."""


Live = dict[str, dict[CodeType, list[FunctionType]]]
"""Functions by the file and the code that they have."""


def live_functions() -> Live:
    """Return all functions there are; take note of those that remember results."""
    live: Live = defaultdict(lambda: defaultdict(list))
    # Objects that conftest.py has taken out of the garbage collection are not listed otherwise.
    gc.unfreeze()
    for thing in gc.get_objects():
        if type(thing) is FunctionType:
            live[thing.__code__.co_filename][thing.__code__].append(thing)
        elif isinstance(thing, _CACHED) and thing.__module__.startswith("spacerobot_ros."):
            _caches.append(thing)
    return live


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool:
    jobs, answers = (int(n) for n in os.environ.pop("SPACEROBOT_FORK_PIPES").split())
    items = {item.nodeid: item for item in session.items}
    live = live_functions()
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
    live: Live,
) -> None:
    """Run the tests of a job until one fails, and end the process."""
    global _log
    code = 3
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_AS, (_MAX_MEMORY, _MAX_MEMORY))
        os.environ.update(job["environment"])
        _log = Path(job["log"])
        _forget()
        if job["exchange"]:
            path, before = job["exchange"]
            try:
                exchange(before, Path(path).read_text(), path, live[path])
            except NotExchangedError:
                os._exit(NOT_EXCHANGED)
        for test, limits in job["tests"].items():
            parts = (f"{test}[", f"{test}::")
            named = [test] if test in items else [n for n in items if n.startswith(parts)]
            _limits.update(dict.fromkeys(named, tuple(limits)))
        session.items = [items[name] for name in _limits]
        session.testscollected = len(session.items)
        with suppress(session.Failed, session.Interrupted):
            _pytest.main.pytest_runtestloop(session)
        code = 1 if session.testsfailed else 0
        faulthandler.dump_traceback_later(WAITED, exit=True)
        # Fixtures of modules and of the session, where a failure has ended the run.
        session._setupstate.teardown_exact(None)
    except BaseException:
        sys.excepthook(*sys.exc_info())
    finally:
        os._exit(code)


def _forget() -> None:
    """Forget what was computed while tests were collected: an error is to show in it."""
    for cached in _caches:
        cached.cache_clear()


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


# -- modules that are imported ----------------------------------------------------------------


def exchange(
    before: str, after: str, path: str, live: Mapping[CodeType, Sequence[FunctionType]]
) -> None:
    """Have a module that is imported be that of another text of its file.

    What other modules have computed from it while they were imported stays as it is.

    Parameters
    ----------
    before, after
        The texts.
    path
        The file.
    live
        The functions of the file, by the code that they have.

    Raises
    ------
    NotExchangedError
        They differ in more than bodies of functions, defaults and constants, or no function that
        differs is known to be alive.
    """
    pairs = _differing_code(before, after, path)
    if pairs is None:
        modules = [m for m in sys.modules.values() if getattr(m, "__file__", None) == path]
        for module in modules:
            _Definitions(module, before, after, path).exchange()
        return
    if pairs and not any(live.get(old) for old, _ in pairs):
        raise NotExchangedError("no function that differs is alive")
    for old, new in pairs:
        for function in live.get(old, ()):
            function.__code__ = new


def _differing_code(before: str, after: str, path: str) -> list[tuple[CodeType, CodeType]] | None:
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
    """Return the code without that of the functions in it, and without its places in the text."""
    return code.replace(
        co_consts=tuple(c.co_name if isinstance(c, CodeType) else c for c in code.co_consts),
        co_linetable=b"",
    )


class NotExchangedError(Exception):
    """A module has to be imported anew."""


class _Definitions:
    """Defaults of functions, and constants of a module and its classes, taken from a second one.

    The other text of the file is executed beside the module; only what is defined by statements
    that differ is taken from there.
    """

    def __init__(self, module: ModuleType, before: str, after: str, path: str) -> None:
        self._module = module
        self._before, self._after = ast.parse(before), ast.parse(after)
        self._new: dict[str, Any] = {
            name: getattr(module, name) for name in ("__name__", "__file__", "__package__")
        }
        exec(compile(after, path, "exec", dont_inherit=True), self._new)

    def exchange(self) -> None:
        """Take what differs."""
        for old, new in _differing_statements(self._before.body, self._after.body):
            match new:
                case ast.FunctionDef(name=name):
                    _require_same_decorators(old, new)
                    _take_defaults(getattr(self._module, name), self._new[name])
                case ast.ClassDef(name=name):
                    self._take_class(old, new, getattr(self._module, name), self._new[name])
                case _:
                    self._take_constant(_target(new))

    def _take_constant(self, name: str) -> None:
        value = _simple(self._new[name])
        before = getattr(self._module, name)
        for module in list(sys.modules.values()):
            # Where it was imported from here, too.
            if getattr(module, "__dict__", {}).get(name) is before:
                setattr(module, name, value)

    def _take_class(self, old: ast.stmt, new: ast.ClassDef, live: Any, other: Any) -> None:
        _require_same_decorators(old, new)
        if isinstance(live, EnumMeta) or live.__subclasses__():
            raise NotExchangedError("the members of an enum, or what others inherit")
        assert isinstance(old, ast.ClassDef)
        for a, b in _differing_statements(old.body, new.body):
            if isinstance(b, ast.FunctionDef):
                _require_same_decorators(a, b)
                _take_defaults(vars(live)[b.name], vars(other)[b.name])
                continue
            name = _target(b)
            fields = getattr(live, "__dataclass_fields__", {})
            if name in fields:
                fields[name] = other.__dataclass_fields__[name]
                live.__init__ = other.__init__
            if name in vars(other):
                setattr(live, name, _simple(vars(other)[name]))


def _differing_statements(
    before: Sequence[ast.stmt], after: Sequence[ast.stmt]
) -> list[tuple[ast.stmt, ast.stmt]]:
    if len(before) != len(after):
        raise NotExchangedError("there are more or fewer statements")
    pairs = list(zip(before, after, strict=True))
    return [(a, b) for a, b in pairs if ast.dump(a) != ast.dump(b)]


def _require_same_decorators(old: ast.stmt, new: ast.FunctionDef | ast.ClassDef) -> None:
    lists = [getattr(each, "decorator_list", None) for each in (old, new)]
    lists += [getattr(each, "bases", None) for each in (old, new)]
    texts = [[ast.dump(item) for item in each or ()] for each in lists]
    if texts[0] != texts[1] or texts[2] != texts[3]:
        raise NotExchangedError("decorators or bases differ")


def _take_defaults(live: Any, other: Any) -> None:
    functions = [getattr(f, "__func__", getattr(f, "__wrapped__", f)) for f in (live, other)]
    if not all(isinstance(function, FunctionType) for function in functions):
        raise NotExchangedError("a function in another thing")
    function, new = functions
    if function.__code__ != new.__code__ or function.__closure__ or new.__closure__:
        raise NotExchangedError("its body differs, too")
    function.__defaults__ = _simple(new.__defaults__)
    function.__kwdefaults__ = _simple(new.__kwdefaults__)


def _target(statement: ast.stmt) -> str:
    """Return the one name that a statement assigns to."""
    match statement:
        case ast.AnnAssign(target=ast.Name(id=name)) | ast.Assign(targets=[ast.Name(id=name)]):
            return name
    raise NotExchangedError("a statement that is no assignment")


def _simple(value: Any) -> Any:
    """Return a value that means the same whichever module has made it."""
    match value:
        case None | bool() | int() | float() | str() | bytes() | re.Pattern() | struct.Struct():
            return value
        case tuple() | list() | set() | frozenset():
            for item in value:
                _simple(item)
            return value
        case dict():
            _simple([*value.keys(), *value.values()])
            return value
        case np.ndarray() | np.generic():
            return value
    raise NotExchangedError(f"a {type(value).__name__}")
