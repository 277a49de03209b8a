"""Small campaigns: a flight of four seconds that takes a tenth of one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spacerobot_ros.campaign.config import Campaign, parse_campaign
from spacerobot_ros.campaign.dataset import Dataset, Row
from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.one_by_one import robots_of
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario

SHORT = {
    "scenario": "faults/stuck_slider",
    "set": {"plant.faults": [], "planner.position_tolerance": 0.05},
}
"""Three sliders move their base by 4 cm, without the fault of the scenario."""


def section(**given: Any) -> dict[str, Any]:
    """Return the content of a campaign's file; ``set`` adds to what the short flight has."""
    return {**SHORT, **given, "set": {**SHORT["set"], **given.get("set", {})}}  # type: ignore[dict-item]


def campaign(**given: Any) -> Campaign:
    """Return a campaign of short flights."""
    return parse_campaign("short", section(**given))


def flown(made: Campaign, number: int = 0) -> tuple[Flight, dict[str, Any]]:
    """Fly one draw; return the flight and what was drawn."""
    draw = Draws(made)[number]
    drawn = drawn_flight(made, draw)
    robots, longest = robots_of(drawn), made.max_flight_time
    return fly_scenario(drawn.seeded_scenario, robots=robots, longest=longest), dict(draw.values)


def written(folder: Path, made: Campaign, rows: Sequence[Row]) -> Dataset:
    """Return a dataset with such rows."""
    dataset = Dataset(folder)
    dataset.begin(made)
    dataset.add(rows)
    dataset.close()
    return dataset
