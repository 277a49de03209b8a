"""The file of a campaign: scenario, number of flights, dispersions and criteria."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from spacerobot_ros.campaign.metrics import OWN_METRICS, metric_of
from spacerobot_ros.campaign.targets import (
    DispersionTarget,
    DrawnFlight,
    description_of,
    targets_of,
)
from spacerobot_ros.errors import ParameterError, printable, reason
from spacerobot_ros.files import load_yaml
from spacerobot_ros.measures import CLEARANCE, METRICS, metric_names
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import suggestion
from spacerobot_ros.scenario import CONFIGS, Scenario, number_in, scenario_or_robot

SAMPLERS = ("random", "latin_hypercube", "sobol", "halton", "saltelli")
"""Names of samplers; saltelli, for sensitivity indices, is from SALib, the others from scipy."""

FIXED_SIZE_SAMPLERS = ("latin_hypercube", "saltelli")
"""Samplers whose draws depend on the number of flights."""

_CAMPAIGN_KEYS = (
    *("scenario", "flights", "seed", "sampler", "method", "set", "longest", "disperse", "table"),
    *("criteria", "metrics", "engine", "description"),
)
_MAX_FLIGHTS = 10_000_000
ENGINES = ("auto", "lanes", "flights")
"""Names of the engines that may fly a campaign."""

_TABLE, _CORRELATED = "table", "multivariate_normal"


@dataclass(frozen=True)
class Distribution:
    """Probability distribution of a value: one of scipy.stats, a choice, or the rows of a table.

    Attributes
    ----------
    name
        Name in ``scipy.stats``, ``choice``, or ``table``.
    arguments
        Arguments by name, as ``scipy.stats`` takes them.
    choices
        Equally likely values of a ``choice``, or the values of a ``table`` flight by flight.
    """

    name: str
    arguments: Mapping[str, float] = field(default_factory=dict)
    choices: tuple[Any, ...] = ()

    def values(self, flights: Sequence[int], shares: Array) -> list[Any]:
        """Return the values (N,) of flights by their numbers and cumulative probabilities (N,)."""
        if self.name == _TABLE:
            # Draws are made in blocks, whose last one reaches beyond the table.
            return [self.choices[flight % len(self.choices)] for flight in flights]
        return self.quantiles(shares)

    def quantiles(self, shares: Array) -> list[Any]:
        """Return the quantiles (N,) of cumulative probabilities (N,), 0 to 1."""
        if self.choices:
            last = len(self.choices) - 1
            return [self.choices[min(int(u * (last + 1)), last)] for u in shares.tolist()]
        # Values that are not finite are refused when a flight draws them.
        with np.errstate(all="ignore"):
            found = np.asarray(
                _load_scipy_distribution(self.name).ppf(shares, **self.arguments), dtype=float
            )
        return list(found.tolist())

    def __str__(self) -> str:
        if self.name == _TABLE:
            return f"{len(self.choices)} rows of the table"
        if self.choices:
            return f"one of {', '.join(map(str, self.choices))}"
        given = ", ".join(f"{name} {value:g}" for name, value in self.arguments.items())
        return f"{self.name} ({given})"


@dataclass(frozen=True)
class Dispersion:
    """A quantity that varies from flight to flight, and its distribution.

    ``weights`` are those of the independent standard normals, by the name of their dispersion,
    whose sum is the standard normal of a correlated quantity; empty: it is independent.
    """

    target: DispersionTarget
    distribution: Distribution
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the quantity."""
        return self.target.name

    def __str__(self) -> str:
        others = ", ".join(name for name in self.weights if name != self.name)
        return f"{self.distribution}{f', correlated with {others}' if others else ''}"


@dataclass(frozen=True)
class Criterion:
    """Range that a metric must be in: from ``minimum`` to ``maximum``."""

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
    """A campaign.

    Attributes
    ----------
    name
        Name of its file.
    scenario
        Scenario with the parameters that all flights share.
    flights, seed, sampler
        Number of draws, their seed, and their sampler.
    max_flight_time
        Simulated time after which a flight is interrupted, s.
    dispersions
        Quantities that vary.
    criteria
        Requirements on metrics, beside a goal that is reached.
    metrics
        Names of metrics that are measured and reported, beside those of the criteria.
    engine
        Name of the engine: ``auto``, ``lanes`` or ``flights``.
    description
        Text for the reader of the report.
    section
        Content of the file.
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
        """Names of the drawn quantities, in the order of the columns."""
        return tuple(dispersion.name for dispersion in self.dispersions)

    @property
    def correlation_factor(self) -> Array | None:
        """(D, D) factor by which independent standard normals become correlated; None: none are."""
        if not any(each.weights for each in self.dispersions):
            return None
        rows = (each.weights or {each.name: 1.0} for each in self.dispersions)
        return np.array([[row.get(name, 0.0) for name in self.names] for row in rows])

    @property
    def description_lines(self) -> list[str]:
        """Lines for the terminal: the range of the drawn numbers, those of one range together."""
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
        """Metrics that a criterion or ``metrics`` names."""
        return list(dict.fromkeys([*(each.metric for each in self.criteria), *self.metrics]))

    @property
    def own_metrics(self) -> list[str]:
        """Those of the named metrics that are of users."""
        return [name for name in self.named_metrics if name in OWN_METRICS]

    @property
    def measures_clearance(self) -> bool:
        """Whether the smallest distance between links is measured."""
        return CLEARANCE in self.named_metrics


class _UniqueKeyLoader(yaml.SafeLoader):
    """Refuses duplicate keys, of which YAML would silently keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        known: set[str] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue  # An unhashable key is refused elsewhere with its own message.
            if key.value in known:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key '{key.value}' is there twice", key.start_mark
                )
            known.add(key.value)
        return super().construct_mapping(node, deep)


def load_campaign(path: Path, flights: int | None = None) -> Campaign:
    """Read the file of a campaign; ``flights`` replaces its number of flights.

    Raises
    ------
    ParameterError
        It cannot be read, or a value in it is refused; the message names the place.
    """
    try:
        content = load_yaml(path.read_text(encoding="utf-8"), _UniqueKeyLoader)
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
    """Return a campaign from the content of its file.

    Parameters
    ----------
    name
        Name of the campaign.
    section
        Content of ``campaign:``.
    folder
        Folder in which the file of a scenario is looked for.
    scenario
        Scenario with the parameters under ``set``; None: the one that the section names.

    Raises
    ------
    ParameterError
        A key or value is refused.
    """
    for key in section:
        _require_known("key", key, _CAMPAIGN_KEYS)
    scenario = scenario or _read_scenario(section, folder)
    drawn = [*_read_distributions(_read_mapping(section, "disperse"), scenario)]
    rows = None
    if section.get("table") is not None:
        section = {**section, "table": _table_text(section["table"], folder)}
        columns = _read_table(section["table"], scenario)
        rows, drawn = len(columns[0].distribution.choices), [*columns, *drawn]
    flights = _read_whole_number(section, "flights", rows or 100, 1, _MAX_FLIGHTS)
    if rows is not None and flights > rows:
        raise ParameterError(f"'flights' is {flights}, but the table has {rows}, one a row.")
    sampler = str(section.get("sampler", "random"))
    engine = str(section.get("engine", "auto"))
    _require_known("sampler", sampler, SAMPLERS)
    _require_known("engine", engine, ENGINES)
    dispersions = _checked_dispersions(drawn)
    if sampler == "saltelli" and not dispersions:
        raise ParameterError("the sampler 'saltelli' needs at least one dispersion.")
    if sampler == "saltelli" and any(
        each.weights or each.distribution.name == _TABLE for each in dispersions
    ):
        raise ParameterError(
            "the sampler 'saltelli' is for independent values: take another one with a table or "
            f"{_CORRELATED}."
        )
    return Campaign(
        name=name,
        scenario=scenario,
        flights=flights,
        seed=_read_whole_number(section, "seed", 0, 0, 2**63 - 1),
        sampler=sampler,
        max_flight_time=_read_real_number("longest", section.get("longest", 100_000.0), 0.0),
        dispersions=dispersions,
        criteria=_read_criteria(_read_mapping(section, "criteria"), scenario),
        metrics=_read_metrics(section.get("metrics"), scenario),
        engine=engine,
        description=printable(str(section.get("description", ""))),
        section=dict(section),
    )


def _require_known(kind: str, name: Any, known: Sequence[str]) -> None:
    if name not in known:
        raise ParameterError(
            f"there is no {kind} '{name}'; there are {', '.join(known)}."
            f"{suggestion(str(name), known)}"
        )


def _read_scenario(section: Mapping[str, Any], folder: Path) -> Scenario:
    given = section.get("scenario")
    if not isinstance(given, str):
        raise ParameterError("'scenario' must be the name or the file of a scenario.")
    beside = folder / given
    scenario = scenario_or_robot(str(beside) if beside.is_file() else given)
    return scenario_of_section(scenario, section)


def scenario_of_section(scenario: Scenario, section: Mapping[str, Any]) -> Scenario:
    """Return a scenario with the parameters under ``set`` and the ``method`` of a section.

    Raises
    ------
    ParameterError
        It has no goal, a parameter is refused, or campaigns do not fly it.
    """
    scenario.require_goal()
    for key, value in _read_mapping(section, "set").items():
        node, _, parameter = str(key).partition(".")
        if node not in CONFIGS or not parameter:
            raise ParameterError(
                f"'{key}' under 'set' is no parameter: it is called node.parameter with one of the "
                f"nodes {', '.join(CONFIGS)}."
            )
        scenario = scenario.with_overrides(node, {parameter: value})
    if "method" in section:
        scenario = scenario.with_method(str(section["method"]))
    for node in ("plant", *scenario.commanders):
        scenario.config(node)  # Invalid parameters are refused before the first flight.
    if not scenario.lockstep:
        raise ParameterError("campaigns are flown in lockstep: leave plant.time_mode out.")
    return scenario


def _read_mapping(section: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = section.get(key)
    value = {} if value is None else value
    if not isinstance(value, dict):
        raise ParameterError(f"'{key}' must have names with values under it.")
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


def _read_real_number(key: str, value: Any, least: float = -math.inf) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number >= least):
        bound = f" of at least {least:g}" if math.isfinite(least) else ""
        raise ParameterError(f"'{key}' is {value!r}; it must be a finite number{bound}.")
    return number


# -- dispersions ------------------------------------------------------------------------------


def _read_distributions(section: Mapping[str, Any], scenario: Scenario) -> Iterator[Dispersion]:
    for names, given in section.items():
        targets = [
            target
            for name in str(names).split(",")
            for target in targets_of(name.strip(), scenario)
        ]
        if isinstance(given, dict) and set(given) == {_CORRELATED}:
            yield from _read_correlated(str(names), targets, given[_CORRELATED])
            continue
        for target in targets:
            distribution = _read_distribution(target, given)
            for choice in distribution.choices:
                _require_node_accepts(target, choice, scenario)
            yield Dispersion(target, distribution)


def _read_correlated(
    names: str, targets: Sequence[DispersionTarget], given: Any
) -> Iterator[Dispersion]:
    """Yield normal dispersions, whose standard normals are sums of independent ones."""
    from scipy.stats import multivariate_normal

    if not isinstance(given, dict) or set(given) - {"mean", "cov"} or "cov" not in given:
        raise ParameterError(f"'{names}': {_CORRELATED} must have 'cov' and may have 'mean'.")
    if any(target.is_text for target in targets):
        raise ParameterError(f"'{names}' has a text: {_CORRELATED} is of numbers.")
    count = len(targets)
    try:
        mean = np.array(given.get("mean", np.zeros(count)), dtype=float)
        covariance = np.array(given["cov"], dtype=float)
        if mean.shape != (count,) or covariance.shape != (count, count):
            raise ValueError(f"mean must have {count} numbers, cov {count} x {count}")
        multivariate_normal(mean, covariance, allow_singular=True)
        spread = np.sqrt(np.diag(covariance))
        if not (np.isfinite(mean).all() and spread.all()):
            raise ValueError("means must be finite and variances positive")
        if not np.allclose(covariance, covariance.T, atol=0.0):
            raise ValueError("cov must be symmetric")
    except (TypeError, ValueError) as error:
        raise ParameterError(
            f"'{names}': {_CORRELATED} of {count} values is refused: {str(error).rstrip('.')}."
        ) from error
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    factor = vectors * np.sqrt(np.clip(values, 0.0, None))
    for target, middle, scale, row in zip(targets, mean, spread, factor, strict=True):
        normal = Distribution("norm", {"loc": float(middle), "scale": float(scale)})
        weights = zip((each.name for each in targets), row.tolist(), strict=True)
        yield Dispersion(target, normal, dict(weights))


def _table_text(given: Any, folder: Path) -> str:
    """Return the CSV text of a table: of a file, or as it is in the campaign's file."""
    if not isinstance(given, str):
        raise ParameterError("'table' must be the name of a CSV file, or its lines.")
    if "\n" in given:
        return given
    try:
        return (folder / given).read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise ParameterError(f"the table '{given}' cannot be read: {reason(error)}.") from error


def _read_table(text: str, scenario: Scenario) -> list[Dispersion]:
    names, *rows = [row for row in csv.reader(text.splitlines(), skipinitialspace=True) if row]
    if not rows:
        raise ParameterError("the table needs a line of names, and a line for each flight.")
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise ParameterError(
                f"row {number} of the table has {len(row)} values for {len(names)} names."
            )
    found = []
    for name, column in zip(names, zip(*rows, strict=True), strict=True):
        targets = targets_of(name.strip(), scenario)
        if len(targets) > 1:
            raise ParameterError(f"'{name}' in the table is of {len(targets)} values: name one.")
        values = tuple(_read_choice(targets[0], each.strip(), _TABLE) for each in column)
        for text in set(values) if targets[0].is_text else ():
            _require_node_accepts(targets[0], text, scenario)
        found.append(Dispersion(targets[0], Distribution(_TABLE, {}, values)))
    return found


def _checked_dispersions(drawn: Sequence[Dispersion]) -> tuple[Dispersion, ...]:
    """Return dispersions in the order in which they are applied; no two set the same number."""
    found: dict[str, Dispersion] = {}
    for each in drawn:
        if each.name in found:
            raise ParameterError(f"'{each.name}' is dispersed twice.")
        for other in found.values():
            if other.target.assigned_parameters & each.target.assigned_parameters:
                raise ParameterError(
                    f"'{other.name}' and '{each.name}' set the same numbers: leave one out."
                )
        found[each.name] = each
    return tuple(sorted(found.values(), key=lambda each: each.target.order))


_SCIPY_NAMES = {"normal": "norm", "gauss": "norm", "gaussian": "norm", "exponential": "expon"}

_ARGUMENT_HELP = {
    "norm": "loc is its mean and scale its standard deviation",
    "uniform": "loc is its least value and scale its width; [a, b] is from a to b",
}


def _read_distribution(target: DispersionTarget, given: Any) -> Distribution:
    name = target.name
    if not isinstance(given, dict) or len(given) != 1:
        raise ParameterError(
            f"'{name}' must have one distribution, such as 'norm: {{loc: 1, scale: 0.05}}'."
        )
    ((kind, arguments),) = given.items()
    if kind == "choice":
        if not isinstance(arguments, list) or not arguments:
            raise ParameterError(f"'{name}' must have a list of values to choose from.")
        return Distribution("choice", {}, tuple(_read_choice(target, each) for each in arguments))
    if target.is_text:
        raise ParameterError(f"'{name}' is a text: it must have a 'choice' of texts.")
    distribution = _load_scipy_distribution(str(kind))
    shapes = (distribution.shapes or "").replace(" ", "").split(",")
    words = [*filter(None, shapes), "loc", *(["scale"] if hasattr(distribution, "pdf") else [])]
    if isinstance(arguments, list):
        if kind == "uniform":
            if len(arguments) != 2:
                raise ParameterError(f"'{name}': uniform takes [least, largest], two numbers.")
            least, most = (_read_real_number(f"{name}: uniform", each) for each in arguments)
            arguments = [least, most - least]
        if len(arguments) > len(words):
            raise ParameterError(
                f"'{name}': {kind} takes {', '.join(words)}, not {len(arguments)} numbers."
            )
        arguments = dict(zip(words, arguments, strict=False))
    if not isinstance(arguments, dict):
        raise ParameterError(f"'{name}': {kind} must have its arguments: {', '.join(words)}.")
    for word in arguments:
        if word not in words:
            raise ParameterError(
                f"'{name}': {kind} has no argument '{word}'; it takes {', '.join(words)}"
                f"{': ' + _ARGUMENT_HELP[kind] if kind in _ARGUMENT_HELP else ''}."
                f"{suggestion(str(word), words)}"
            )
    missing = [word for word in filter(None, shapes) if word not in arguments]
    if missing:
        raise ParameterError(f"'{name}': {kind} needs its argument '{missing[0]}'.")
    values = {
        word: _read_real_number(f"{name}: {word}", value) for word, value in arguments.items()
    }
    with np.errstate(all="ignore"):
        middle = float(distribution.ppf(0.5, **values))
    if not math.isfinite(middle):
        raise ParameterError(
            f"'{name}': {kind} takes no such arguments: "
            f"{', '.join(f'{word} {value:g}' for word, value in values.items())}."
        )
    return Distribution(str(kind), values)


def _read_choice(target: DispersionTarget, value: Any, where: str = "choice") -> Any:
    if target.is_text:
        if not isinstance(value, str):
            raise ParameterError(f"'{target.name}' is a text; the {where} has {value!r}.")
        return value
    return _read_real_number(
        f"{target.name}: {where}", number_in(value) if isinstance(value, str) else value
    )


def _require_node_accepts(target: DispersionTarget, value: Any, scenario: Scenario) -> None:
    flight = target.apply(DrawnFlight.of(scenario), value)
    for node in ("plant", *scenario.commanders):
        flight.scenario.config(node)


def _load_scipy_distribution(name: str) -> Any:
    """Return a distribution of scipy.stats, which takes a second to load."""
    from scipy import stats

    found = getattr(stats, name, None)
    if not isinstance(found, (stats.rv_continuous, stats.rv_discrete)):
        known = [
            each
            for each, value in vars(stats).items()
            if isinstance(value, (stats.rv_continuous, stats.rv_discrete))
        ]
        raise ParameterError(
            f"scipy.stats has no distribution '{name}'."
            f"{suggestion(_SCIPY_NAMES.get(name.lower(), name), [*known, 'choice'])}"
        )
    return found


# -- criteria ---------------------------------------------------------------------------------


def _read_criteria(section: Mapping[str, Any], scenario: Scenario) -> tuple[Criterion, ...]:
    found = []
    for name, given in section.items():
        _require_metric(str(name), scenario)
        if not isinstance(given, dict) or not given or set(given) - {"min", "max"}:
            raise ParameterError(f"the criterion of '{name}' must have 'min' or 'max', or both.")
        least = _read_real_number(f"{name}: min", given["min"]) if "min" in given else -math.inf
        most = _read_real_number(f"{name}: max", given["max"]) if "max" in given else math.inf
        if least > most:
            raise ParameterError(f"the criterion of '{name}' has min {least} above max {most}.")
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
            f"there is no metric '{name}'; there are {', '.join([*METRICS, *OWN_METRICS])}, those "
            f"of joints also for one, and yours by --plugin.{suggestion(name, known)}"
        )


def passes_criteria(
    criteria: Sequence[Criterion], outcome: str, metrics: Mapping[str, float]
) -> bool:
    """Return whether a flight has reached its goal and met every criterion."""
    return outcome == "reached" and all(
        meets_criterion(criterion, metrics) for criterion in criteria
    )


def meets_criterion(criterion: Criterion, metrics: Mapping[str, float]) -> bool:
    """Return whether a metric has a value that meets the criterion."""
    return criterion.minimum <= metrics.get(criterion.metric, math.nan) <= criterion.maximum
