"""The benchmark of this checkout and of another one, run alternately on the same machine."""

from __future__ import annotations

import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.termination import child_options

_OURS = "spacerobot_ros.cli:start"
_ENTRY = re.compile(r"""["']\s*spacerobot\s*=\s*([\w.]+:\w+)\s*["']""")

Figures = Mapping[str, float]


@dataclass(frozen=True)
class Checkout:
    """A folder with the package, and the function that its command ``spacerobot`` calls.

    Attributes
    ----------
    folder
        What Python is to find the package in.
    entry
        ``module:function``.
    """

    folder: Path
    entry: str

    @classmethod
    def ours(cls) -> Checkout:
        """Return the one that this module is of."""
        return cls(Path(__file__).resolve().parents[2], _OURS)

    @classmethod
    def at(cls, folder: Path) -> Checkout:
        """Return a checkout, whose ``setup.py`` says what its command is.

        Raises
        ------
        ParameterError
            There is none in the folder.
        """
        declaration = folder / "setup.py"
        if not declaration.is_file():
            raise ParameterError(f"There is no checkout in {folder}: it has no setup.py.")
        entry = _ENTRY.search(declaration.read_text("utf-8"))
        if entry is None:
            raise ParameterError(f"{declaration} declares no command 'spacerobot'.")
        return cls(folder.resolve(), entry[1])

    @classmethod
    def pair(cls, other: Path | None) -> tuple[Checkout, Checkout | None]:
        """Return ours, and the one in another folder if there is one to compare with.

        Raises
        ------
        ParameterError
            There is none in the folder.
        """
        return cls.ours(), None if other is None else cls.at(other)

    def measure(self, words: Sequence[str]) -> Figures:
        """Return the numbers that ``spacerobot bench`` with these words writes as JSON.

        Raises
        ------
        SpaceRobotError
            The benchmark fails; the sentence is its last.
        """
        module, _, function = self.entry.partition(":")
        call = f"import {module} as m; m.{function}(prog_name='spacerobot')"
        figures = self.run(["-c", call, "bench", *words, "--json"])
        return {
            name: float(value) for name, value in figures.items() if isinstance(value, (int, float))
        }

    def run(self, arguments: Sequence[str]) -> Any:
        """Run Python with this package and return what it writes to its last argument as JSON.

        Parameters
        ----------
        arguments
            Those of Python; the name of a file, in a folder of its own, is added.

        Raises
        ------
        SpaceRobotError
            It fails; the sentence is its last.
        """
        # Away from any checkout: Python looks for packages in the current folder first.
        with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
            result = Path(folder, "figures.json")
            run = subprocess.run(
                [sys.executable, *arguments, str(result)],
                cwd=folder,
                **child_options({**os.environ, "PYTHONPATH": str(self.folder)}),
                capture_output=True,
                text=True,
                check=False,
            )
            if run.returncode != 0:
                last = (run.stderr.strip().splitlines() or ["it gave no reason."])[-1]
                raise SpaceRobotError(f"The benchmark of {self.folder} failed: {last}")
            return json.loads(result.read_text("utf-8"))


def compare_checkouts(
    other: Path, words: Sequence[str], show: Callable[[str], None], rounds: int
) -> dict[str, Figures]:
    """Measure this checkout and another one alternately.

    Both are run by this interpreter; medians of the rounds are compared, figure by figure, where
    both have it.

    Parameters
    ----------
    other
        Folder of the other checkout.
    words
        Options of ``spacerobot bench`` that both understand.
    show
        Called with lines for people.
    rounds
        How often each is measured.

    Returns
    -------
    The medians ``here`` and ``there`` by name, and the ``ratio`` of what both have.

    Raises
    ------
    SpaceRobotError
        There is no such checkout, or a benchmark fails.
    """
    here, there = Checkout.ours(), Checkout.at(other)
    found: dict[Checkout, list[Figures]] = {here: [], there: []}
    for number in range(rounds):
        # Each goes first in turn: what warms up falls on both.
        for checkout in (here, there) if number % 2 == 0 else (there, here):
            found[checkout].append(checkout.measure(words))
        show(f"round {number + 1} of {rounds} measured")
    ours, others = (_medians(found[checkout]) for checkout in (here, there))
    ratios = {
        name: value / others[name] for name, value in ours.items() if others.get(name, 0.0) != 0.0
    }
    width = max(map(len, ratios), default=0)
    show(f"{'':<{width}}{'here':>14}{'there':>14}{'here/there':>12}")
    for name, ratio in ratios.items():
        show(f"{name:<{width}}{ours[name]:>14.6g}{others[name]:>14.6g}{ratio:>12.3f}")
    return {"here": ours, "there": others, "ratio": ratios}


def _medians(rounds: Sequence[Figures]) -> dict[str, float]:
    """Return the median of every figure that all rounds have."""
    names = [name for name in rounds[0] if all(name in each for each in rounds)]
    return {name: statistics.median(each[name] for each in rounds) for name in names}
