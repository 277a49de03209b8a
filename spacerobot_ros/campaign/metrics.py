"""Built-in and user-defined campaign metrics, by name."""

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
    """A user-defined metric, computed for each flight in campaigns that name it.

    Derived classes are registered like control laws: with ``--plugin``, with an entry point
    ``spacerobot_ros.metrics``, or with :meth:`.Registry.register` of ``OWN_METRICS``.
    """

    name: ClassVar[str]
    """Column name, used under ``metrics`` or ``criteria``."""

    unit: ClassVar[str] = ""
    """SI unit, for people."""

    yes_or_no: ClassVar[bool] = False
    """Whether the value is a flag, 1 or 0; if so, reports show no distribution."""

    @abstractmethod
    def evaluate(self, flight: Flight) -> float:
        """Return the value for a flight; NaN if the metric has no value for the flight."""


OWN_METRICS: Registry[FlightMetric] = Registry(
    "metric", "spacerobot_ros.metrics", FlightMetric, (), reserved=METRICS
)
"""User-defined metrics by name."""


def metric_of(name: str) -> Metric | type[FlightMetric]:
    """Return a metric by name; the name may include a joint."""
    return OWN_METRICS.get(name) or METRICS[name.partition(".")[0]]


def own_metrics_of(flight: Flight, names: Iterable[str]) -> dict[str, float]:
    """Return a flight's user-defined metrics.

    Raises
    ------
    SpaceRobotError
        A metric raises an exception or does not return a number.
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
