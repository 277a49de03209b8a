"""Flights with one parameter changed, and which of their quantities change with it.

``test/passage/parameters.yaml`` has an entry for each parameter of plant, planner and controller:
another value, its flight, and the quantities of that flight that it changes. Run as a
module this writes the quantities anew: ``PYTHONPATH=.:test python -m support.passage``; the
difference shows which parameters reach other quantities than before.
"""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import yaml

import spacerobot_ros
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight import api
from spacerobot_ros.planning.execution.status import PlannerStatus

FILE = Path(__file__).resolve().parents[1] / "passage" / "parameters.yaml"

FLIGHTS: dict[str, dict[str, Any]] = {
    "slide": {
        "what": "sliding_masses",
        "goal": (0.05, -0.04, 0.02),
        "rotvec": (0.04, -0.02, 0.03),
    },
    "swing": {
        "what": "sliding_masses",
        "method": "lie_bracket",
        "goal": (0.05, -0.04, 0.02),
        "rotvec": (0.01, -0.005, 0.008),
        "parameters": {
            "plant.tick_rate": 10.0,
            "planner.tick_rate": 10.0,
            "planner.lie_bracket.t1": 10.0,
            "planner.lie_bracket.cycle_period": 4.0,
            "planner.attitude_tolerance": 1e-4,
        },
    },
    "loops": {
        "what": "arm_attitude",
        "rotvec": (0.01, 0.012, 0.008),
        "parameters": {
            "plant.tick_rate": 5.0,
            "planner.tick_rate": 5.0,
            "planner.attitude_tolerance": 0.006,
        },
    },
    "arm": {
        "what": "arm_attitude",
        "method": "optimal",
        "rotvec": (0.1, -0.05, 0.07),
        "parameters": {"planner.attitude_tolerance": 1e-4},
    },
    "square": {
        "what": "planar_chain",
        "rotvec": (0.0, 0.0, 0.9),
        "parameters": {
            "plant.tick_rate": 25.0,
            "planner.tick_rate": 25.0,
            "coordinated_control.tick_rate": 25.0,
        },
    },
    "hand": {
        "what": "coordinated_control",
        "parameters": {
            "coordinated_control.settle_time": 0.5,
            "coordinated_control.position_tolerance": 0.02,
            "coordinated_control.attitude_tolerance": 0.02,
        },
    },
    "servicer": {
        "what": "servicer",
        "parameters": {"coordinated_control.time_limit": 6.0},
    },
    "nozzles": {
        "what": "servicer_thrusters",
        "parameters": {"coordinated_control.time_limit": 3.0},
    },
}
"""Arguments of :func:`spacerobot_ros.fly`: short flights that differ in robot and method."""


@dataclass(frozen=True)
class Case:
    """A parameter, the value that it is given, and the quantities of a flight that change.

    Attributes
    ----------
    parameter
        With its node: ``plant.sensors.seed``.
    flight
        One of :data:`FLIGHTS`.
    value
        That differs from the one of the flight.
    beside
        Further parameters, without which it would have no effect; the flight that it is compared
        with has them too.
    """

    parameter: str
    flight: str
    value: Any
    beside: Mapping[str, Any]
    changes: tuple[str, ...]

    def found(self) -> tuple[str, ...]:
        """Return the quantities that differ between the flights with and without the value."""
        before = _prints(self.flight, json.dumps(dict(self.beside), sort_keys=True))
        after = prints(self.flight, {**self.beside, self.parameter: self.value})
        names = before.keys() | after.keys()
        return tuple(sorted(name for name in names if before.get(name) != after.get(name)))


def cases() -> list[Case]:
    """Return the entries that are tried in flights."""
    return [
        Case(
            parameter,
            entry["flight"],
            entry["value"],
            entry.get("beside", {}),
            tuple(entry.get("changes", ())),
        )
        for parameter, entry in table().items()
        if "flight" in entry
    ]


def table() -> dict[str, dict[str, Any]]:
    """Return the entries by parameter."""
    return dict(yaml.safe_load(FILE.read_text("utf-8")))


@cache
def _prints(flight: str, beside: str) -> dict[str, str]:
    return prints(flight, json.loads(beside))


def prints(flight: str, parameters: Mapping[str, Any]) -> dict[str, str]:
    """Return a fingerprint of every quantity of a flight by its name; a refusal is one."""
    words = dict(FLIGHTS[flight])
    words["parameters"] = {**words.get("parameters", {}), **parameters}
    try:
        # The flight of a refused goal has quantities as well.
        with patch.object(api, "_raise_if_refused", lambda flight: flight):
            flown = spacerobot_ros.fly(words.pop("what"), words.pop("goal", None), **words)
    except SpaceRobotError as error:
        return {"refused": str(error)}
    found: dict[str, Any] = {
        "duration": flown.time[-1],
        "outcome": flown.outcome,
        "message": flown.message,
        "events": [str(event) for event in flown.events],
        "statuses": [(stamp, _repeatable(status)) for stamp, status in flown.statuses],
        "refusals": [str(refusal) for refusal in flown.refusals],
        "schedules": [
            (stamp, s.method, s.velocities, s.path.position) for stamp, s in flown.schedules
        ],
    }
    series = {"pose": flown.pose, "twist": flown.twist, "q": flown.q, "qdot": flown.qdot}
    series |= {"effort": flown.effort, "momentum": flown.momentum, **flown.quantities}
    found |= series
    found |= {topic: (c.tick, c.values) for topic, c in flown.commands.items()}
    return {name: _fingerprint(value) for name, value in found.items()}


def _repeatable(status: Status) -> Status:
    """Return a status without the notes, which say where a plan is from."""
    if isinstance(status, PlannerStatus):
        return replace(status, notes={})
    return status


def _fingerprint(value: Any) -> str:
    digest = hashlib.sha256()

    def feed(part: Any) -> None:
        if isinstance(part, np.ndarray):
            digest.update(np.ascontiguousarray(part).tobytes())
        elif isinstance(part, (list, tuple)):
            for each in part:
                feed(each)
        else:
            digest.update(repr(part).encode())
        digest.update(b"|")

    feed(value)
    return digest.hexdigest()[:16]


def main() -> None:
    """Write the quantities that change into the table anew."""
    wanted, entries = sys.argv[1:], table()
    for case in cases():
        if not wanted or any(word in case.parameter for word in wanted):
            entries[case.parameter]["changes"] = list(case.found())
            print(case.parameter, *entries[case.parameter]["changes"], flush=True)
    head = "".join(
        f"{line}\n" for line in FILE.read_text("utf-8").splitlines() if line.startswith("#")
    )
    body = yaml.safe_dump(entries, sort_keys=False, width=100, default_flow_style=None)
    FILE.write_text(f"{head}\n{body}", "utf-8")


if __name__ == "__main__":
    main()
