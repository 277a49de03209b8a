"""Fixtures that measure this checkout and another one in turns, by processor time."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]

_MEASURED = Path(__file__).with_name("measured.py")

Measure = Callable[..., None]


class Clock:
    """The clock of pytest-benchmark: it goes on by the processor time that was measured."""

    def __init__(self) -> None:
        self._now = 0.0

    def __call__(self) -> float:
        """Return the sum of all times so far, s."""
        return self._now

    def advance(self, seconds: float) -> None:
        """Let the clock go on."""
        self._now += seconds


CLOCK = Clock()

TAKEN: dict[str, dict[str, list[float]]] = {}
"""The times by benchmark and checkout: those of all checkouts are measured together, in turns."""


class Checkout:
    """A process that has imported the package of a checkout, with a cache of its own."""

    def __init__(self, folder: Path, own: Path) -> None:
        if not (folder / "spacerobot_ros" / "__init__.py").is_file():
            raise pytest.UsageError(f"There is no checkout in {folder}: it has no spacerobot_ros/.")
        self._folder = folder
        variables = {
            "PYTHONPATH": str(folder.resolve()),
            "SPACEROBOT_CACHE_DIR": str(own / "cache"),
            "PYTHONPYCACHEPREFIX": str(own / "byte_code"),
            "PYTHONDONTWRITEBYTECODE": "",
            "OPENBLAS_NUM_THREADS": "1",
        }
        # In an empty folder: Python looks for packages in the current folder first.
        self._process = subprocess.Popen(
            [sys.executable, str(_MEASURED)],
            env=os.environ | variables,
            cwd=own,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def measure(self, name: str, arguments: dict[str, Any]) -> float:
        """Return the processor time of a measurement, s."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        print(json.dumps([name, arguments]), file=self._process.stdin, flush=True)
        answer = json.loads(self._process.stdout.readline())
        if isinstance(answer, str):
            raise RuntimeError(f"{self._folder}: {answer}")
        return float(answer)

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option that names the other checkout."""
    parser.addoption("--against", type=Path, metavar="CHECKOUT", help="compare with a checkout")


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Measure each benchmark here, and there if another checkout is named."""
    places = ["here"] + ["there"] * (metafunc.config.getoption("against") is not None)
    metafunc.parametrize("place", places)


@pytest.fixture(scope="session")
def checkouts(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Checkout]]:
    """Start the processes of the checkouts."""
    folders = {"here": ROOT, "there": request.config.getoption("against")}
    with ExitStack() as closing:
        started = {}
        for place, folder in folders.items():
            if folder is not None:
                started[place] = Checkout(folder, tmp_path_factory.mktemp(place))
                closing.callback(started[place].close)
        yield started


@pytest.fixture
def measure(benchmark: Any, place: str, checkouts: dict[str, Checkout]) -> Measure:
    """Return a function that measures: all checkouts in turns, after a call that is not counted."""

    def run(name: str, rounds: int = 5, **arguments: Any) -> None:
        group = f"{name} {next(iter(arguments.values()))}"
        if group not in TAKEN:
            times: dict[str, list[float]] = {each: [] for each in checkouts}
            for number in range(rounds + 1):
                # The first of a round changes, so that warming up affects all alike.
                for each in sorted(checkouts, reverse=number % 2 == 1):
                    seconds = checkouts[each].measure(name, arguments)
                    times[each] += [seconds] * (number > 0)
            TAKEN[group] = times
        samples = iter(TAKEN[group][place])
        benchmark.group = group
        benchmark.pedantic(lambda: CLOCK.advance(next(samples)), rounds=rounds)

    return run


def ratios() -> dict[str, float]:
    """Return the ratios of the medians, there to here, by benchmark."""
    medians = {
        group: {place: statistics.median(times) for place, times in by_place.items() if times}
        for group, by_place in TAKEN.items()
    }
    return {group: x["there"] / x["here"] for group, x in medians.items() if len(x) == 2}


def pytest_benchmark_update_json(output_json: dict[str, Any]) -> None:
    """Add the ratios to the JSON file."""
    output_json["there_to_here"] = ratios()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Write the ratios: above 1 where this checkout is faster."""
    if found := ratios():
        terminalreporter.section("processor time there / here, of medians of turns")
        for group, ratio in found.items():
            terminalreporter.write_line(f"{ratio:6.2f}  {group}")
