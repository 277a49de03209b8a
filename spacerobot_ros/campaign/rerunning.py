"""One flight of a campaign again, through the whole ROS stack, with a bag."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.dataset import Dataset
from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.rows import LANES, Row
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.reading import read_run
from spacerobot_ros.measures import Outcome

TOLERANCE = 1e-9
"""Deviation that is no difference, absolute below 1 (SI units) and relative above."""


@dataclass(frozen=True)
class Rerun:
    """A flight beside what the dataset has of it.

    Attributes
    ----------
    row
        What came of it now.
    deviation
        The largest deviation of a metric; None where the dataset does not have the flight.
    at
        Of which metric it is.
    outcome
        What the dataset says became of the goal; empty where it does not have the flight.
    bag
        Where its bag is.
    note
        Why it need not be the flight in the dataset, number for number; empty: it is to be.
    """

    row: Row
    deviation: float | None
    at: str
    outcome: str
    bag: Path
    note: str = ""

    @property
    def same(self) -> bool:
        """Whether it is the flight in the dataset, not known there, or not comparable."""
        if self.deviation is None or self.note:
            return True
        return self.outcome == self.row.outcome and self.deviation <= TOLERANCE

    @property
    def lines(self) -> list[str]:
        """What people read."""
        row = self.row
        drawn = ", ".join(
            f"{name} {value:.6g}" if isinstance(value, float) else f"{name} {value}"
            for name, value in row.draw.values.items()
        )
        lines = [
            f"flight {row.draw.number}: {row.outcome}. {row.reason}",
            f"drawn       {drawn or 'nothing'}; seed {row.draw.seed}",
            f"bag         {self.bag}",
        ]
        if self.deviation is not None:
            where = f" ({self.at})" if self.at else ""
            deviation = f"largest deviation {self.deviation:.2g}{where}"
            lines.append(f"dataset     {self.outcome}; {deviation}")
        else:
            lines.append("dataset     has no such flight yet")
        if self.note:
            lines.append(self.note)
        return lines


def rerun_flight(folder: Path, number: int, bag: Path) -> Rerun:
    """Fly one draw of a campaign through the ROS stack.

    Raises
    ------
    ParameterError
        The folder holds no campaign, or it has no such flight.
    SpaceRobotError
        What was drawn is refused, or the bag cannot be written.
    """
    from spacerobot_ros.session.run import run_scenario  # Loads ROS.

    dataset = Dataset(folder)
    campaign = dataset.campaign()
    draws = Draws(campaign)
    if number >= len(draws):
        raise ParameterError(
            f"The campaign in {folder} has {len(draws)} flights, 0 to {len(draws) - 1}, and no "
            f"flight {number}."
        )
    draw = draws[number]
    scenario = drawn_flight(campaign, draw).finished().scenario
    run_scenario(scenario, bag, longest=campaign.longest)
    row = Row.of(campaign, draw, read_run(bag).measures, "ros")
    known = known_flight(dataset, campaign, number)
    if known is None:
        return Rerun(row, None, "", "", bag)
    outcome, engine, metrics = known
    deviation, at = largest_deviation(metrics, row.metrics)
    note = ""
    if engine == LANES and campaign.scenario.plant.thrusters:
        note = "It was flown in lanes: thrusters that are on or off multiply rounding."
    elif outcome == Outcome.INTERRUPTED.value:
        note = "It was interrupted: the stack flies on for up to a fifth of a second of wall time."
    return Rerun(row, deviation, at, outcome, bag, note)


def known_flight(
    dataset: Dataset, campaign: Campaign, number: int
) -> tuple[str, str, dict[str, float]] | None:
    """Return outcome, engine and metrics of a flight in a dataset; None if it is not there."""
    if number not in dataset.done():
        return None
    table = dataset.table()
    (record,) = [row for row in table.to_pylist() if row["flight"] == number]
    names = [
        name
        for name in table.column_names
        if isinstance(record[name], float) and not name.startswith(("draw.", "wall_", "plan_"))
    ]
    return record["outcome"], record["engine"], {name: record[name] for name in names}


def largest_deviation(
    expected: Mapping[str, float], found: Mapping[str, float]
) -> tuple[float, str]:
    """Return the largest deviation of a metric, a share of it above 1, and its name."""
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
