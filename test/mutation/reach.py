"""A plugin of pytest: writes down which test reaches which line, and how long each takes.

A fixture of a module or class is made for the first test that uses it; all that use it reach its
lines. Loaded by `-p` with SPACEROBOT_REACH set to the folder that gets the files of each worker.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from coverage import Coverage

_FOLDER = Path(os.environ["SPACEROBOT_REACH"])
_WORKER = os.environ.get("PYTEST_XDIST_WORKER", "main")

_SHARED_SCOPES = ("module", "class")

_measured: dict[str, tuple[float, float, bool]] = {}
"""CPU and wall time (s) of each test with its fixtures, and whether it passed."""

_users: dict[str, list[str]] = {}
"""Tests that use each shared fixture."""

_shared: dict[str, tuple[str, float]] = {}
"""The test for which each shared fixture was made, and the CPU time (s) that this took."""

_context = ""

_coverage = Coverage(
    data_file=str(_FOLDER / f"lines-{_WORKER}"),
    source=[os.environ["SPACEROBOT_REACH_SOURCE"]],
    config_file=False,
)
# When the plugin is imported, so that the lines of modules that are imported later are seen.
_coverage.start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    for fixtures in getattr(item, "_fixtureinfo").name2fixturedefs.values():  # noqa: B009
        if fixtures[-1].scope in _SHARED_SCOPES:
            _users.setdefault(_name_of(fixtures[-1]), []).append(item.nodeid)
    begin = _spent()
    try:
        with _reaching(item.nodeid):
            return (yield)
    finally:
        _, wall, passed = _measured.get(item.nodeid, (0.0, 0.0, False))
        _measured[item.nodeid] = (_spent() - begin, wall, passed)


@pytest.hookimpl(wrapper=True)
def pytest_fixture_setup(
    fixturedef: pytest.FixtureDef[object], request: pytest.FixtureRequest
) -> Iterator[None]:
    if fixturedef.scope not in _SHARED_SCOPES:
        return (yield)
    begin, name = _spent(), _name_of(fixturedef)
    try:
        with _reaching(name):
            return (yield)
    finally:
        _shared[name] = os.environ["PYTEST_CURRENT_TEST"].rpartition(" ")[0], _spent() - begin


def _name_of(fixture: pytest.FixtureDef[object]) -> str:
    return f"fixture {fixture.baseid}::{fixture.argname}"


@contextmanager
def _reaching(name: str) -> Iterator[None]:
    """Note the lines that are reached on behalf of a test or a shared fixture."""
    global _context
    before, _context = _context, name
    _coverage.switch_context(name)
    try:
        yield
    finally:
        _context = before
        _coverage.switch_context(before)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    cpu, wall, passed = _measured.get(report.nodeid, (0.0, 0.0, True))
    _measured[report.nodeid] = (cpu, wall + report.duration, passed and report.passed)


def _spent() -> float:
    """Return the CPU time of this process and of those that it has waited for, s."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def pytest_sessionfinish(session: pytest.Session) -> None:
    _coverage.stop()
    if _WORKER == "main" and session.config.getoption("numprocesses", None):
        return  # It has run no test: its workers have.
    _coverage.save()
    for name, users in _users.items():
        first, seconds = _shared.get(name, ("", 0.0))
        for user in users:
            cpu, wall, passed = _measured[user]
            # Without the first one, as when it runs alone, a test has to make the fixture.
            _measured[user] = (cpu + seconds * (user != first), wall, passed)
    (_FOLDER / f"tests-{_WORKER}.json").write_text(json.dumps(_measured))
    (_FOLDER / f"users-{_WORKER}.json").write_text(json.dumps(_users))
