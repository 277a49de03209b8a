"""Campaign file: scenario, number of flights, dispersions and criteria."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.batch.targets import is_device_name
from spacerobot_ros.campaign.draws import (
    Dispersion,
    checked_dispersions,
    read_distributions,
    read_real_number,
    read_table,
    read_table_text,
)
from spacerobot_ros.campaign.metrics import OWN_METRICS, metric_of
from spacerobot_ros.campaign.targets import description_of, self_contained
from spacerobot_ros.errors import ParameterError, printable, reason
from spacerobot_ros.files import load_yaml, read_regular
from spacerobot_ros.measures import CLEARANCE, METRICS, metric_names
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import suggestion
from spacerobot_ros.scenario import Scenario, scenario_or_robot

SAMPLERS = ("random", "latin_hypercube", "sobol", "halton", "saltelli")
"""Sampler names; saltelli (for sensitivity indices) is provided by SALib, and the others by
scipy."""

FIXED_SIZE_SAMPLERS = ("latin_hypercube", "saltelli")
"""Samplers whose draws depend on the number of flights."""

_CAMPAIGN_KEYS = (
    *("scenario", "flights", "seed", "sampler", "method", "set", "longest", "disperse", "table"),
    *("criteria", "metrics", "engine", "description"),
)
_MAX_FLIGHTS = 10_000_000
FLIGHTS = "flights"
"""Name of the engine that flies draws one by one, the fallback for other engines."""

ENGINES = ("auto", "lanes", FLIGHTS, "cuda")
"""Names of engines that can fly a campaign, besides other devices."""


@dataclass(frozen=True)
class Criterion:
    """Permitted metric range, from ``minimum`` to ``maximum``."""

    metric: str
    minimum: float = -math.inf
    maximum: float = math.inf

    def __str__(self) -> str:
        unit = metric_of(self.metric).unit
        parts = [f"at least {self.minimum:g}"] if math.isfinite(self.minimum) else []
        parts += [f"at most {self.maximum:g}"] if math.isfinite(self.maximum) else []
        return f"{self.metric} {' and '.join(parts)} {unit}".rstrip()


@dataclass(frozen=True)
class Campaign:
    """A campaign, as in its file, whose content is ``section``.

    Attributes
    ----------
    scenario
        Scenario, including the parameters common to all flights.
    flights
        Number of draws.
    max_flight_time
        Simulated time after which a flight is interrupted, s.
    dispersions
        Quantities that vary.
    criteria
        Requirements on metrics, in addition to reaching the goal.
    metrics
        Names of metrics that are reported in addition to those in the criteria.
    engine
        Name of the engine: ``auto``, ``lanes``, ``flights``, or of a device
        (:func:`.device_named`).
    """

    name: str
    scenario: Scenario
    flights: int
    seed: int
    sampler: str
    max_flight_time: float
    dispersions: tuple[Dispersion, ...]
    criteria: tuple[Criterion, ...]
    metrics: tuple[str, ...] = ()
    engine: str = "auto"
    description: str = ""
    section: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the drawn quantities, in column order."""
        return tuple(dispersion.name for dispersion in self.dispersions)

    @property
    def correlation_factor(self) -> Array | None:
        """(D, D) factor by which independent standard normal variables are correlated; None: no
        correlations."""
        if not any(each.weights for each in self.dispersions):
            return None
        rows = (each.weights or {each.name: 1.0} for each in self.dispersions)
        return np.array([[row.get(name, 0.0) for name in self.names] for row in rows])

    @property
    def description_lines(self) -> list[str]:
        """Terminal output lines: the ranges of the drawn values, grouped by identical range."""
        together: dict[str, list[str]] = {}
        for each in self.dispersions:
            if not each.distribution.choices:
                low, high = each.distribution.quantiles(np.array([0.01, 0.99]))
                unit = "" if each.target.unit in ("", "1") else f" {each.target.unit}"
                text = f"{low:.4g} to {high:.4g}{unit} in 98 % of the flights"
                together.setdefault(text, []).append(each.name)
        return [
            f"drawn       {names[0]}{f' and {len(names) - 1} more' * (len(names) > 1)}: {text}"
            for text, names in together.items()
        ]

    @property
    def named_metrics(self) -> list[str]:
        """Metrics named by a criterion or in ``metrics``."""
        return list(dict.fromkeys([*(each.metric for each in self.criteria), *self.metrics]))

    @property
    def own_metrics(self) -> list[str]:
        """User-defined metrics named by a criterion or in ``metrics``."""
        return [name for name in self.named_metrics if name in OWN_METRICS]

    @property
    def measures_clearance(self) -> bool:
        """Whether the smallest distance between links is measured."""
        return CLEARANCE in self.named_metrics


def load_campaign(path: Path, flights: int | None = None) -> Campaign:
    """Read a campaign file; ``flights`` overrides the number of flights in the file.

    Raises
    ------
    ParameterError
        The file cannot be read, or contains an invalid value; the message states its location.
    """
    try:
        content = load_yaml(read_regular(path).decode("utf-8"))
    except (OSError, ValueError) as error:
        raise ParameterError(
            f"The campaign file {path} cannot be read: {reason(error)}."
        ) from error
    section = content.get("campaign") if isinstance(content, dict) else None
    if not isinstance(section, dict):
        raise ParameterError(f"The campaign file {path} has no section 'campaign:'.")
    if flights is not None:
        section = {**section, "flights": flights}
    try:
        return parse_campaign(path.stem, section, path.parent)
    except ParameterError as error:
        raise ParameterError(f"The campaign file {path} is refused: {error}") from error


def parse_campaign(
    name: str, section: Mapping[str, Any], folder: Path = Path(), scenario: Scenario | None = None
) -> Campaign:
    """Return the campaign described by a file's content.

    Parameters
    ----------
    name
        Name of the campaign.
    section
        Content of ``campaign:``.
    folder
        Folder in which to search for the scenario file.
    scenario
        Scenario, including the parameters under ``set``; by default, the scenario that the section
        names.

    Raises
    ------
    ParameterError
        A key or value is invalid.
    """
    for key in section:
        _require_known("key", key, _CAMPAIGN_KEYS)
    if scenario is None:
        given = section.get("scenario")
        if not isinstance(given, str):
            raise ParameterError("'scenario' must be a scenario name or file.")
        beside = folder / given
        found = scenario_or_robot(str(beside) if beside.is_file() else given)
        scenario = scenario_of_section(found, section)
    scenario = self_contained(scenario)
    drawn = [*read_distributions(_read_mapping(section, "disperse"), scenario)]
    rows = None
    if section.get("table") is not None:
        section = {**section, "table": read_table_text(section["table"], folder)}
        columns = read_table(section["table"], scenario)
        rows, drawn = len(columns[0].distribution.choices), [*columns, *drawn]
    flights = _read_whole_number(section, "flights", rows or 100, 1, _MAX_FLIGHTS)
    if rows is not None and flights > rows:
        raise ParameterError(f"'flights' is {flights}, but the table has only {rows} rows.")
    sampler = str(section.get("sampler", "random"))
    engine = str(section.get("engine", "auto"))
    _require_known("sampler", sampler, SAMPLERS)
    require_engine(engine)
    dispersions = checked_dispersions(drawn)
    if sampler == "saltelli" and not dispersions:
        raise ParameterError("the sampler 'saltelli' requires at least one dispersion.")
    if sampler == "saltelli" and not all(each.is_independent for each in dispersions):
        raise ParameterError(
            "the sampler 'saltelli' requires independent values: use another sampler with a table "
            "or multivariate_normal."
        )
    return Campaign(
        name=name,
        scenario=scenario,
        flights=flights,
        seed=_read_whole_number(section, "seed", 0, 0, 2**63 - 1),
        sampler=sampler,
        max_flight_time=read_real_number("longest", section.get("longest", 100_000.0), 0.0),
        dispersions=dispersions,
        criteria=_read_criteria(_read_mapping(section, "criteria"), scenario),
        metrics=_read_metrics(section.get("metrics"), scenario),
        engine=engine,
        description=printable(str(section.get("description", ""))),
        section=dict(section),
    )


def require_engine(name: str) -> None:
    """Raise ParameterError if no engine has the given name."""
    if not is_device_name(name):
        _require_known("engine", name, ENGINES)


def _require_known(kind: str, name: Any, known: Sequence[str]) -> None:
    if name not in known:
        raise ParameterError(
            f"there is no {kind} '{name}'; available: {', '.join(known)}."
            f"{suggestion(str(name), known)}"
        )


def scenario_of_section(scenario: Scenario, section: Mapping[str, Any]) -> Scenario:
    """Return a scenario with the parameters under ``set`` in a section, and with the section's
    ``method``.

    Raises
    ------
    ParameterError
        The scenario has no goal or is not supported by campaigns, or a parameter is invalid.
    """
    scenario.require_goal()
    scenario = scenario.with_parameters(_read_mapping(section, "set"))
    if "method" in section:
        scenario = scenario.with_method(str(section["method"]))
    for node in ("plant", *scenario.commanders):
        scenario.config(node)  # Invalid parameters are refused before the first flight.
    if not scenario.lockstep:
        raise ParameterError("campaigns are flown in lockstep: omit plant.time_mode.")
    return scenario


def _read_mapping(section: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = section.get(key)
    value = {} if value is None else value
    if not isinstance(value, dict):
        raise ParameterError(f"'{key}' must map names to values.")
    return value


def _read_whole_number(
    section: Mapping[str, Any], key: str, default: int, least: int, most: int
) -> int:
    value = section.get(key, default)
    if isinstance(value, bool) or not isinstance(value, int) or not least <= value <= most:
        raise ParameterError(
            f"'{key}' is {value!r}; it must be a whole number from {least} to {most}."
        )
    return value


# -- criteria ---------------------------------------------------------------------------------


def _read_criteria(section: Mapping[str, Any], scenario: Scenario) -> tuple[Criterion, ...]:
    found = []
    for name, given in section.items():
        _require_metric(str(name), scenario)
        if not isinstance(given, dict) or not given or set(given) - {"min", "max"}:
            raise ParameterError(f"the criterion for '{name}' must have 'min', 'max' or both.")
        least = read_real_number(f"{name}: min", given["min"]) if "min" in given else -math.inf
        most = read_real_number(f"{name}: max", given["max"]) if "max" in given else math.inf
        if least > most:
            raise ParameterError(f"the criterion for '{name}' has min {least} above max {most}.")
        found.append(Criterion(str(name), least, most))
    return tuple(found)


def _read_metrics(given: Any, scenario: Scenario) -> tuple[str, ...]:
    if not isinstance(given, list | None):
        raise ParameterError("'metrics' must be a list of names.")
    names = tuple(map(str, given or ()))
    for name in names:
        _require_metric(name, scenario)
    return names


def _require_metric(name: str, scenario: Scenario) -> None:
    known = [*metric_names(description_of(scenario).joint_names), *OWN_METRICS]
    if name not in known:
        raise ParameterError(
            f"there is no metric '{name}'; available: {', '.join([*METRICS, *OWN_METRICS])}, joint "
            f"metrics of a single joint, and metrics from --plugin.{suggestion(name, known)}"
        )


def passes_criteria(
    criteria: Sequence[Criterion], outcome: str, metrics: Mapping[str, float]
) -> bool:
    """Return whether a flight reached its goal and met every criterion."""
    return outcome == "reached" and all(
        each.minimum <= metrics.get(each.metric, math.nan) <= each.maximum for each in criteria
    )
