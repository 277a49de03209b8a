"""Metrics of campaigns by name: those of every flight, and those of users."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import METRICS, Metric
from spacerobot_ros.registry import Registry

if TYPE_CHECKING:
    from spacerobot_ros.flight.flight import Flight


class FlightMetric(ABC):
    """A metric of your own, computed for each flight of a campaign that names it.

    A class that is derived from it becomes known as the control laws do: by ``--plugin``, by an
    entry point ``spacerobot_ros.metrics``, or by :meth:`.Registry.register` of ``OWN_METRICS``.
    """

    name: ClassVar[str]
    """Name of its column, and under ``metrics`` or ``criteria``."""

    unit: ClassVar[str] = ""
    """SI unit, for people."""

    yes_or_no: ClassVar[bool] = False
    """Whether it is 1 for yes and 0 for no, so that reports have no distribution of it."""

    @abstractmethod
    def evaluate(self, flight: Flight) -> float:
        """Return the value for a flight; NaN if it has none."""


OWN_METRICS: Registry[FlightMetric] = Registry(
    "metric", "spacerobot_ros.metrics", FlightMetric, (), reserved=METRICS
)
"""The metrics of users by name."""


def metric_of(name: str) -> Metric | type[FlightMetric]:
    """Return a metric by its name, which may be that of one of its joints."""
    return OWN_METRICS.get(name) or METRICS[name.partition(".")[0]]


def own_metrics_of(flight: Flight, names: Iterable[str]) -> dict[str, float]:
    """Return the metrics of users for a flight.

    Raises
    ------
    SpaceRobotError
        One of them raises an exception, or is no number.
    """
    found: dict[str, float] = {}
    for name in names:
        try:
            found[name] = float(OWN_METRICS[name]().evaluate(flight))
        except Exception as error:
            raise SpaceRobotError(
                f"The metric '{name}' cannot be computed: {type(error).__name__}: {error}."
            ) from error
    return found


OWN_METRICS.load()
