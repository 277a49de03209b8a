"""Measurements of this checkout and of another one, taken in turns on the same machine."""

from __future__ import annotations

import json
import os
import statistics
import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spacerobot_ros.benchmarks import measurements
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.termination import run_child

Figures = Mapping[str, float]


@dataclass(frozen=True)
class Checkout:
    """A folder that contains the package."""

    folder: Path

    @classmethod
    def pair(cls, other: Path | None) -> tuple[Checkout, Checkout | None]:
        """Return this checkout and the checkout in another folder; None without a folder.

        Raises
        ------
        ParameterError
            The folder contains no checkout.
        """
        ours = cls(Path(__file__).resolve().parents[2])
        if other is None:
            return ours, None
        if not (other / "spacerobot_ros" / "__init__.py").is_file():
            raise ParameterError(f"There is no checkout in {other}: it has no spacerobot_ros/.")
        return ours, cls(other.resolve())

    def measure(
        self, name: str, *, cache: str | None = None, byte_code: str | None = None, **arguments: Any
    ) -> Any:
        """Call a function of :mod:`.measurements` with this checkout's package, in a process.

        ``cache`` is a folder to use in place of the user's cache, and ``byte_code`` one for the
        byte code of modules, which is kept there also where PYTHONDONTWRITEBYTECODE is set.
        """
        words = [str(measurements.__file__), name, json.dumps(arguments)]
        variables = {} if cache is None else {"SPACEROBOT_CACHE_DIR": cache}
        if byte_code is not None:
            variables |= {"PYTHONPYCACHEPREFIX": byte_code, "PYTHONDONTWRITEBYTECODE": ""}
        return self.run(words, variables)

    def run(self, arguments: Sequence[str], variables: Mapping[str, str] | None = None) -> Any:
        """Run Python with this checkout's package and return the JSON file that it writes.

        Parameters
        ----------
        arguments
            Arguments of Python; the name of the JSON file is added at the end.
        variables
            Environment variables besides those of this process.

        Raises
        ------
        SpaceRobotError
            The process fails; the message quotes its last line.
        """
        # In an empty folder: Python looks for packages in the current folder first.
        with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
            result = Path(folder, "figures.json")
            environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **(variables or {})}
            environment["PYTHONPATH"] = str(self.folder)
            run = run_child([*arguments, str(result)], environment, cwd=folder)
            if run.returncode != 0:
                last = (run.stderr.strip().splitlines() or ["it gave no reason."])[-1]
                raise SpaceRobotError(f"The benchmark of {self.folder} failed: {last}")
            return json.loads(result.read_text("utf-8"))


def compare(
    other: Path,
    measure: Callable[[Checkout], Mapping[str, Any]],
    show: Callable[[str], None],
    rounds: int,
) -> dict[str, Figures]:
    """Measure this checkout and another one alternately, and show a table of the medians.

    Parameters
    ----------
    other
        Folder of the other checkout.
    measure
        Returns the figures of a checkout. Of most figures (times, losses) less is better.
    show
        Called with lines for the user.
    rounds
        Number of measurements of each checkout.

    Returns
    -------
    The medians ``here`` and ``there`` by name, and the ratio ``there_to_here`` of the figures that
    both have: of times, above 1 where this checkout is faster.

    Raises
    ------
    SpaceRobotError
        The other folder contains no checkout, or a measurement fails.
    """
    here, there = Checkout.pair(other)
    assert there is not None
    found: dict[Checkout, list[Figures]] = {here: [], there: []}
    for number in range(rounds):
        # The checkouts take turns to be first, so that warming up affects both alike.
        for checkout in (here, there) if number % 2 == 0 else (there, here):
            figures = measure(checkout)
            found[checkout].append(
                {name: float(x) for name, x in figures.items() if isinstance(x, (int, float))}
            )
        show(f"round {number + 1} of {rounds} measured")
    ours, others = (_medians(found[checkout]) for checkout in (here, there))
    ratios = {name: others[name] / x for name, x in ours.items() if name in others and x != 0.0}
    width = max(map(len, ratios), default=0)
    show(f"{'':<{width}}{'here':>14}{'there':>14}{'there/here':>12}")
    for name, ratio in ratios.items():
        show(f"{name:<{width}}{ours[name]:>14.6g}{others[name]:>14.6g}{ratio:>12.3f}")
    return {"here": ours, "there": others, "there_to_here": ratios}


def _medians(rounds: Sequence[Figures]) -> dict[str, float]:
    """Return the median over all rounds of each figure."""
    names = [name for name in rounds[0] if all(name in each for each in rounds)]
    return {name: statistics.median(each[name] for each in rounds) for name in names}
