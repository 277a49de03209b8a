"""Flies campaigns and stores the results in datasets; repeats single flights and records a bag.

:func:`sweep` runs a small campaign from Python, with the arguments of ``fly``.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.campaign.config import FLIGHTS, Campaign, parse_campaign, scenario_of_section
from spacerobot_ros.campaign.dataset import ERROR, Dataset, Row
from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.workers import (
    KILLED,
    TaskDistributor,
    engine_by_name,
    fly_all,
    open_workers,
    select_engine,
)
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.api import scenario_to_fly
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.api import EndEffectorValues, end_effector_goals
from spacerobot_ros.scenario import Scenario


@dataclass(frozen=True)
class Progress:
    """Progress of a campaign.

    Attributes
    ----------
    flown, total
        Flights.
    flights_per_second
        Flights per second of wall time, in this process.
    seconds
        Wall time so far.
    unflown
        Number of flights in the dataset whose draw or goal was refused or that ended with an error;
        counted at the end of the campaign.
    """

    flown: int
    total: int
    flights_per_second: float
    seconds: float
    unflown: int = 0

    @property
    def seconds_left(self) -> float:
        """Estimated remaining wall time, s; infinite until the first flight has finished."""
        rate = self.flights_per_second
        return (self.total - self.flown) / rate if rate else math.inf


def run_campaign(
    campaign: Campaign,
    folder: Path,
    *,
    engine: str = "auto",
    workers: int = 0,
    scheduler: str = "",
    show: Callable[[Progress], None] = lambda progress: None,
    stopped: Callable[[], bool] = lambda: False,
) -> Progress:
    """Fly all draws of a campaign that have no row in the folder yet.

    Parameters
    ----------
    campaign
        The campaign.
    folder
        Dataset folder.
    engine
        Engine name, or ``auto``.
    workers
        Number of worker processes on this machine; 0: only this process is used.
    scheduler
        Address of a dask.distributed scheduler, whose workers fly instead; empty: none.
    show
        Function that is called with the progress after each task and a few times per second.
    stopped
        Function that returns whether to stop; it is called a few times per second. Finished flights
        are kept.

    Returns
    -------
    Progress
        The final progress.

    Raises
    ------
    SpaceRobotError
        The engine cannot fly the campaign, the folder contains another campaign, or a package is
        missing.
    """
    draws, dataset = Draws(campaign), Dataset(folder)
    # A gait method may have changed since an engine planned with it.
    engine_by_name.cache_clear()
    wanted = campaign.engine if engine == "auto" else engine
    chosen = select_engine(campaign, wanted, local=not scheduler)
    with ExitStack() as opened:
        crew = None
        left = len(set(range(len(draws))) - dataset.flown_numbers())
        if (workers or scheduler) and left:
            # Before the folder is created, so that a missing scheduler leaves no folder behind.
            crew = opened.enter_context(open_workers(left, workers, scheduler))
        done = dataset.begin(campaign)
        numbers = [number for number in range(len(draws)) if number not in done]
        began, before = time.monotonic(), len(draws) - len(numbers)

        def progress(flown: int) -> Progress:
            seconds = time.monotonic() - began
            rate = flown / seconds if seconds > 0 else 0.0
            return Progress(before + flown, len(draws), rate, seconds)

        flown = 0
        selected = (draws[number] for number in numbers)  # Each draw is created when it is flown.
        try:
            batches: Iterator[list[Row]]
            if crew is None:
                batches = ([row] for row in fly_all(chosen, campaign, selected, stopped))
            else:
                batches = TaskDistributor(crew, campaign, draws, chosen.name, stopped).rows(numbers)
            for batch in batches:
                dataset.add(batch)
                flown += len(batch)
                show(progress(flown))
        finally:
            dataset.close()
        outcomes = dataset.table(["outcome"])["outcome"].to_pylist() if before + flown else []
        unflown = (ERROR, KILLED, Outcome.REFUSED)
        return replace(progress(flown), unflown=sum(each in unflown for each in outcomes))


RERUN_TOLERANCE = 1e-9
"""Largest deviation between identical flights: absolute for values below 1 (SI units), relative for
larger values."""


@dataclass(frozen=True)
class Rerun:
    """A repeated flight, compared with its row in the dataset.

    Attributes
    ----------
    row
        Row of the repeated flight.
    deviation
        Largest deviation of a metric; None if the flight is not in the dataset.
    worst_metric
        Name of that metric.
    outcome
        Outcome in the dataset; empty if the flight is not in the dataset.
    bag
        Path of the bag.
    note
        Reason why the metrics may differ from those in the dataset; empty if both must agree.
    """

    row: Row
    deviation: float | None
    worst_metric: str
    outcome: str
    bag: Path
    note: str = ""

    @property
    def agrees(self) -> bool:
        """Whether the metrics agree with the dataset or cannot be compared with it."""
        if self.deviation is None or self.note:
            return True
        return self.outcome == self.row.outcome and self.deviation <= RERUN_TOLERANCE

    @property
    def report_lines(self) -> list[str]:
        """Output lines for the user."""
        row = self.row
        drawn = ", ".join(
            f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in row.draw.values.items()
        )
        passed = "passed" if row.passed else "not passed"
        lines = [
            f"flight {row.draw.number}: {row.outcome}, {passed}. {row.reason}",
            f"drawn       {drawn or 'nothing'}; seed {row.draw.seed}",
            f"bag         {self.bag}",
        ]
        comparison = "has no such flight yet"
        if self.deviation is not None:
            where = f" ({self.worst_metric})" if self.worst_metric else ""
            comparison = f"{self.outcome}; largest deviation {self.deviation:.2g}{where}"
        lines.append(f"dataset     {comparison}")
        return [*lines, self.note] if self.note else lines


def rerun_flight(folder: Path, number: int, bag: Path) -> Rerun:
    """Repeat one campaign flight and record a bag.

    Raises
    ------
    ParameterError
        The folder contains no campaign, or the campaign has no such flight.
    SpaceRobotError
        The drawn values are invalid, or the bag cannot be written.
    """
    dataset = Dataset(folder)
    campaign = dataset.campaign()
    draws = Draws(campaign)
    if number >= len(draws):
        raise ParameterError(
            f"The campaign in {folder} has {len(draws)} flights, 0 to {len(draws) - 1}, and no "
            f"flight {number}."
        )
    draw = draws[number]
    flight = drawn_flight(campaign, draw)
    flown = fly_scenario(flight.scenario_with_draws, longest=campaign.max_flight_time)
    flown.save(bag)
    row = Row.of(campaign, draw, flown, FLIGHTS)
    known = stored_flight(dataset, number)
    if known is None:
        return Rerun(row, None, "", "", bag)
    outcome, _, metrics = known
    deviation, at = largest_deviation(metrics, row.metrics)
    note = ""
    if campaign.scenario.plant.thrusters and flight.inertial is not None:
        note = (
            "The masses are random, so rounding differs between the campaign's plant and the "
            "plant of this flight, and on/off thrusters amplify the difference."
        )
    return Rerun(row, deviation, at, outcome, bag, note)


def stored_flight(dataset: Dataset, number: int) -> tuple[str, str, dict[str, float]] | None:
    """Return the outcome, engine and metrics of a flight; None if it is not in the dataset."""
    if number not in dataset.flown_numbers():
        return None
    record = next(row for row in dataset.table().to_pylist() if row["flight"] == number)
    metrics = {
        name: value
        for name, value in record.items()
        if isinstance(value, float) and not name.startswith(("draw.", "wall_", "plan_"))
    }
    return record["outcome"], record["engine"], metrics


def largest_deviation(
    expected: Mapping[str, float], found: Mapping[str, float]
) -> tuple[float, str]:
    """Return the largest deviation of a metric (relative for values above 1), and the name of that
    metric."""
    largest, at = 0.0, ""
    for name, value in expected.items():
        other = found.get(name, math.nan)
        if math.isnan(value) and math.isnan(other):
            continue
        deviation = abs(value - other) / max(1.0, abs(value)) if value != other else 0.0
        deviation = math.inf if math.isnan(deviation) else deviation
        if deviation > largest:
            largest, at = deviation, name
    return largest, at


# -- from Python ----------------------------------------------------------------------------------


def sweep(
    what: SpaceRobot | Scenario | str | Path,
    disperse: Mapping[str, Any],
    goal: Goal | npt.ArrayLike | None = None,
    *,
    position: npt.ArrayLike | None = None,
    rotvec: npt.ArrayLike | None = None,
    end_effector_position: EndEffectorValues | None = None,
    end_effector_pose: EndEffectorValues | None = None,
    end_effector: str = "",
    method: str | None = None,
    parameters: Mapping[str, Any] | None = None,
    seed: int = 0,
    flights: int = 100,
    folder: str | os.PathLike[str] | None = None,
    **section: Any,
) -> Any:
    """Fly a small campaign, and return one row per flight.

    For example: ``sweep("coordinated_control", {"plant.sensors.position_noise": {"uniform": [0,
    0.01]}})``.

    Parameters
    ----------
    what, goal, position, rotvec, method, parameters
        See :func:`~spacerobot_ros.flight.api.fly`.
    end_effector_position, end_effector_pose, end_effector
        The same.
    disperse
        Distributions by quantity name, as in a campaign file.
    seed, flights
        Seed and number of draws.
    folder
        Dataset folder, from which a later call resumes; by default, no dataset is written.
    section
        Other campaign file keys: ``sampler``, ``criteria``, ``engine``, ``longest``;
        ``set`` is equivalent to ``parameters``.

    Returns
    -------
    A pyarrow table with the columns of a dataset; ``to_pandas`` converts it to a data frame.

    Raises
    ------
    SpaceRobotError
        A key or value is invalid, or pyarrow or scipy is not installed.
    """
    hands = end_effector_goals(end_effector_position, end_effector_pose, end_effector)
    scenario = scenario_to_fly(what, goal, position, rotvec, hands)
    if method is not None:
        section["method"] = method
    if parameters is not None:
        section["set"] = {**parameters, **section.get("set", {})}
    scenario = scenario_of_section(scenario, section)
    given = _plain({**section, "disperse": disperse, "flights": flights, "seed": seed})
    campaign = parse_campaign(scenario.name, given, scenario=scenario)
    with TemporaryDirectory() as left_nowhere:
        kept = Path(left_nowhere) / "sweep" if folder is None else Path(folder)
        run_campaign(campaign, kept)
        return Dataset(kept).table()


def _plain(value: Any) -> Any:
    """Return a campaign section with the types that a file has, instead of those of numpy."""
    if isinstance(value, Mapping):
        return {key: _plain(each) for key, each in value.items()}
    value = value.tolist() if isinstance(value, (np.ndarray, np.generic)) else value
    return [*map(_plain, value)] if isinstance(value, (list, tuple)) else value
