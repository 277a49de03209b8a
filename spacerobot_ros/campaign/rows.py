"""Campaign rows, one per draw."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING

from spacerobot_ros.campaign.config import Campaign, passes_criteria
from spacerobot_ros.campaign.draws import Draw
from spacerobot_ros.campaign.metrics import own_metrics_of
from spacerobot_ros.campaign.targets import description_of
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import Measures, metrics_of_each

if TYPE_CHECKING:
    from spacerobot_ros.flight.flight import Flight

FLIGHTS = "flights"
"""Name of the engine that flies draws one by one, the fallback for other engines."""

ERROR = "error"
"""Outcome of a draw that could not be flown."""


@dataclass(frozen=True)
class Row:
    """The result of one draw.

    Attributes
    ----------
    draw
        The drawn values.
    outcome, reason
        Goal outcome, or ``error``, and the message.
    metrics
        Metrics by name; empty if nothing was flown.
    passed
        Whether the goal was reached and all criteria were met.
    engine
        Name of the engine used.
    wall_time, plan_time
        Wall time of the flight, and wall time of its planning, s.
    """

    draw: Draw
    outcome: str
    reason: str
    metrics: Mapping[str, float] = field(default_factory=dict)
    passed: bool = False
    engine: str = ""
    wall_time: float = math.nan
    plan_time: float = math.nan

    @classmethod
    def of(cls, campaign: Campaign, draw: Draw, flight: Flight, engine: str) -> Row:
        """Return a flight's row, including the campaign's user-defined metrics."""
        measures = flight.measured(clearance=campaign.measures_clearance)
        own_metrics = own_metrics_of(flight, campaign.own_metrics)
        (row,) = cls.of_each(campaign, [(draw, measures)], engine, own_metrics)
        return row

    @classmethod
    def of_each(
        cls,
        campaign: Campaign,
        flown: Sequence[tuple[Draw, Measures]],
        engine: str,
        own_metrics: Mapping[str, float] = MappingProxyType({}),
    ) -> list[Row]:
        """Return the rows of flights with the same user-defined metrics."""
        found = metrics_of_each([each for _, each in flown], description_of(campaign.scenario))
        rows = []
        for (draw, measures), metrics in zip(flown, found, strict=True):
            outcome, metrics = measures.outcome.value, {**metrics, **own_metrics}
            passed = passes_criteria(campaign.criteria, outcome, metrics)
            times = measures.wall_time, measures.plan_time
            rows.append(cls(draw, outcome, measures.message, metrics, passed, engine, *times))
        return rows

    @classmethod
    def of_error(cls, draw: Draw, error: BaseException, engine: str) -> Row:
        """Return the row for a draw that could not be flown."""
        reason = str(error)
        if not isinstance(error, SpaceRobotError):
            reason = f"{type(error).__name__}: {' '.join(reason.split())}"
        return cls(draw, ERROR, reason, engine=engine)
