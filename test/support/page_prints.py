"""Pages of campaigns as users read them, and fingerprints of their pictures.

The datasets are made up: no flight is flown. Some flights are missing, some have not all metrics,
some were refused, and two engines have flown.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

from matplotlib.figure import Figure
from support.campaigns import section
from support.figure_prints import prints_of, words_of

from spacerobot_ros.campaign import report
from spacerobot_ros.campaign.config import Campaign, parse_campaign, passes_criteria
from spacerobot_ros.campaign.dataset import Dataset, Row
from spacerobot_ros.campaign.draws import Draws

DISPERSED: dict[str, Any] = {
    "mass.mass_1": {"uniform": {"loc": 0.9, "scale": 0.2}},
    "mass.mass_2": {"norm": {"loc": 1.0, "scale": 0.05}},
    "planner.position_tolerance": {"choice": [0.05, 0.06]},
}
CRITERIA = {"position_error_m": {"max": 0.03}, "manoeuvre_time_s": {"min": 3.9, "max": 4.35}}
_FLIGHTS, _MISSING = 72, (9, 33)


def made_up(name: str = "sliders", **given: Any) -> Campaign:
    """Return a campaign with two numbers and a choice that vary."""
    about = {"flights": _FLIGHTS, "seed": 8, "description": "Sliders of <other> masses."}
    content = section(disperse=DISPERSED, **{**about, "criteria": CRITERIA, **given})
    return parse_campaign(name, content)


def write_flights(folder: Path, made: Campaign, better: float = 0.0) -> None:
    """Write flights whose errors follow from what was drawn; ``better`` by so much, m."""
    rows = []
    for draw in Draws(made):
        number = draw.number
        if number in _MISSING:
            continue
        mass, other = draw.values["mass.mass_1"], draw.values["mass.mass_2"]
        outcome, reason, left = "reached", f"At the goal after {4 + number / 64} s.", ""
        metrics = {
            "position_error_m": 0.01 + 0.25 * abs(mass - 1.0) - better * (1 + number % 3),
            "attitude_error_rad": 0.002 * (1 + number % 7) + 0.01 * (other - 1.0),
            "manoeuvre_time_s": 3.8 + 2.5 * abs(other - 1.0) + (number % 5) / 64,
        }
        if number % 24 == 7:
            outcome, reason = "error", "The mass is -1.5 kg & wrong."
            metrics = {}
        elif number % 24 == 11:
            outcome, reason = "failed", f"Off by {number} m."
            del metrics["manoeuvre_time_s"]
        if number % 10 == 3:
            left = "needed corrections" if number < 50 else "It is too far."
        passed = passes_criteria(made.criteria, outcome, metrics)
        engine = "flights" if left else "lanes"
        draw = replace(draw, fallback=left)
        rows.append(Row(draw, outcome, reason, metrics, passed, engine, 0.125, number / 256))
    dataset = Dataset(folder)
    dataset.begin(made)
    dataset.add(rows)
    dataset.close()


@contextmanager
def _pictures() -> Iterator[dict[str, Any]]:
    """Yield the fingerprints of the pictures that are made within, by their names."""
    found: dict[str, Any] = {}

    def part(drawn: Figure, name: str, caption: str) -> str:
        found[name] = {"caption": caption, **prints_of(drawn)}
        return f"<figure>{name}</figure>"

    with patch.object(report, "_picture_part", part):
        yield found


def campaign_prints(**given: Any) -> dict[str, Any]:
    """Return the report of a campaign, what the terminal shows, and its pictures."""
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as name, _pictures() as pictures:
        folder, page = Path(name), Path(name, "report.html")
        write_flights(folder, made_up(**given))
        lines = report.write_campaign_report(folder, page)
        found = {
            "page": words_of(page.read_text("utf-8").replace(str(folder), "FOLDER")),
            "terminal": lines,
            **pictures,
        }
    return dict(json.loads(json.dumps(found)))


def comparison_prints() -> dict[str, Any]:
    """Return the comparison of two campaigns, what the terminal shows, and its picture."""
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as name, _pictures() as pictures:
        folders = Path(name, "one"), Path(name, "two")
        for folder, better in zip(folders, (0.0, 0.002), strict=True):
            write_flights(folder, made_up("lighter" if better else "sliders"), better)
        page = Path(name, "report.html")
        lines = report.write_comparison(folders, page)
        found = {"page": words_of(page.read_text("utf-8")), "terminal": lines, **pictures}
    return dict(json.loads(json.dumps(found)))


CAMPAIGNS = {
    "with requirements": campaign_prints,
    "without requirements": lambda: campaign_prints(criteria={}),
    "comparison": comparison_prints,
}
"""Pages of campaigns by name."""
