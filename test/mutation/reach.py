"""A plugin of pytest: writes down which test reaches which line, and how long each takes.

Loaded by `-p` with SPACEROBOT_REACH set to the folder that gets the files of each worker.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from coverage import Coverage

_FOLDER = Path(os.environ["SPACEROBOT_REACH"])
_WORKER = os.environ.get("PYTEST_XDIST_WORKER", "main")

_measured: dict[str, tuple[float, float, bool]] = {}
"""CPU and wall time (s) of each test with its fixtures, and whether it passed."""

_coverage = Coverage(
    data_file=str(_FOLDER / f"lines-{_WORKER}"),
    source=[os.environ["SPACEROBOT_REACH_SOURCE"]],
    config_file=False,
)
# When the plugin is imported, so that the lines of modules that are imported later are seen.
_coverage.start()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    _coverage.switch_context(item.nodeid)
    begin = _spent()
    try:
        return (yield)
    finally:
        _coverage.switch_context("")
        _, wall, passed = _measured.get(item.nodeid, (0.0, 0.0, False))
        _measured[item.nodeid] = (_spent() - begin, wall, passed)


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
    (_FOLDER / f"tests-{_WORKER}.json").write_text(json.dumps(_measured))
