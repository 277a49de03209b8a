"""Distributions of the dispersed quantities, and the draws: the random values of each flight.

A distribution is one of scipy's, a choice, a covariance, or rows of a table.

A draw is determined by its number; it depends neither on the number of workers nor on the order in
which flights finish. With the samplers ``random``, ``sobol`` and ``halton``, it does not depend on
the number of flights either.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.campaign.targets import DispersionTarget, DrawnFlight, MassFactors, targets_of
from spacerobot_ros.errors import ParameterError, RobotDescriptionError, counted, reason
from spacerobot_ros.files import read_regular
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.resources import optional_module, suggestion
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.scenario_files import number_in

if TYPE_CHECKING:
    from spacerobot_ros.campaign.config import Campaign

_MIN_PROBABILITY = 1e-12
"""Smallest distance of cumulative probabilities from 0 and 1, at which many quantiles are
infinite."""

_BLOCK_SIZE = 256
"""Number of draws computed together."""

_SEED = "plant.sensors.seed"
"""Name of the flight seed, which campaigns can disperse in the same way as other parameters."""

_TABLE, _CORRELATED = "table", "multivariate_normal"


@dataclass(frozen=True)
class Distribution:
    """Probability distribution of a value: one of scipy.stats, a choice, or table rows.

    Attributes
    ----------
    name
        Name in ``scipy.stats``, ``choice``, or ``table``.
    arguments
        Arguments by name, as in ``scipy.stats``.
    choices
        Equally likely values of a ``choice``, or the values in a ``table``, one per flight.
    """

    name: str
    arguments: Mapping[str, float] = field(default_factory=dict)
    choices: tuple[Any, ...] = ()

    def values(self, flights: Sequence[int], shares: Array) -> list[Any]:
        """Return the values (N,) for flights with the given numbers and cumulative probabilities
        (N,)."""
        if self.name == _TABLE:
            # Draws are made in blocks; the last block extends beyond the table.
            return [self.choices[flight % len(self.choices)] for flight in flights]
        return self.quantiles(shares)

    def quantiles(self, shares: Array) -> list[Any]:
        """Return the quantiles (N,) for cumulative probabilities (N,), 0 to 1."""
        if self.choices:
            last = len(self.choices) - 1
            return [self.choices[min(int(u * (last + 1)), last)] for u in shares.tolist()]
        # Values that are not finite are refused when a flight draws them.
        with np.errstate(all="ignore"):
            found = _load_scipy_distribution(self.name).ppf(shares, **self.arguments)
        return list(np.asarray(found, dtype=float).tolist())

    def __str__(self) -> str:
        if self.name == _TABLE:
            return f"{len(self.choices)} rows of the table"
        if self.choices:
            return f"one of {', '.join(map(str, self.choices))}"
        given = ", ".join(f"{name} {value:g}" for name, value in self.arguments.items())
        return f"{self.name} ({given})"


@dataclass(frozen=True)
class Dispersion:
    """A quantity that varies between flights, and its distribution.

    For a correlated quantity, ``weights`` are the weights of independent standard normal variables,
    by dispersion name; the weighted sum of these variables is the standard normal variable of the
    quantity. Empty if the quantity is independent.
    """

    target: DispersionTarget
    distribution: Distribution
    weights: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the quantity."""
        return self.target.name

    @property
    def is_independent(self) -> bool:
        """Whether the quantity is drawn independently."""
        return not self.weights and self.distribution.name != _TABLE

    def __str__(self) -> str:
        others = ", ".join(name for name in self.weights if name != self.name)
        return f"{self.distribution}{f', correlated with {others}' if others else ''}"


def read_real_number(key: str, value: Any, least: float = -math.inf) -> float:
    """Return a finite number of at least ``least``, or raise ParameterError."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not (math.isfinite(number) and number >= least):
        bound = f" of at least {least:g}" if math.isfinite(least) else ""
        raise ParameterError(f"'{key}' is {value!r}; it must be a finite number{bound}.")
    return number


def read_distributions(section: Mapping[str, Any], scenario: Scenario) -> Iterator[Dispersion]:
    """Yield the dispersions under ``disperse``.

    Raises
    ------
    ParameterError
        A name, a distribution, or one of its arguments is invalid.
    """
    for names, given in section.items():
        parts = (name.strip() for name in str(names).split(","))
        targets = [target for name in parts for target in targets_of(name, scenario)]
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
        raise ParameterError(f"'{names}' includes a string: {_CORRELATED} accepts only numbers.")
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
            f"'{names}': {_CORRELATED} of {count} values is invalid: {str(error).rstrip('.')}."
        ) from error
    values, vectors = np.linalg.eigh(covariance / np.outer(spread, spread))
    factor = vectors * np.sqrt(np.clip(values, 0.0, None))
    for target, middle, scale, row in zip(targets, mean, spread, factor, strict=True):
        normal = Distribution("norm", {"loc": float(middle), "scale": float(scale)})
        weights = zip((each.name for each in targets), row.tolist(), strict=True)
        yield Dispersion(target, normal, dict(weights))


def read_table_text(given: Any, folder: Path) -> str:
    """Return the CSV content of a table, from a file or from the campaign file itself.

    Raises
    ------
    ParameterError
        The file cannot be read.
    """
    if not isinstance(given, str):
        raise ParameterError("'table' must be the name or the content of a CSV file.")
    if "\n" in given:
        return given
    try:
        return read_regular(folder / given).decode("utf-8-sig")
    except (OSError, ValueError) as error:
        raise ParameterError(f"the table '{given}' cannot be read: {reason(error)}.") from error


def read_table(text: str, scenario: Scenario) -> list[Dispersion]:
    """Return the columns of a table with one row per flight.

    Raises
    ------
    ParameterError
        A name or a value is invalid.
    """
    lines = csv.reader(text.splitlines(), skipinitialspace=True)
    names, *rows = [row for row in lines if row] or [[]]
    if not rows:
        raise ParameterError("the table must consist of one line of names and one line per flight.")
    for number, row in enumerate(rows, 1):
        if len(row) != len(names):
            raise ParameterError(
                f"table row {number} has {len(row)} values for {len(names)} names."
            )
    found = []
    for name, column in zip(names, zip(*rows, strict=True), strict=True):
        targets = targets_of(name.strip(), scenario)
        if len(targets) > 1:
            raise ParameterError(
                f"'{name}' in the table refers to {len(targets)} values: name one of them."
            )
        values = tuple(_read_choice(targets[0], each.strip(), _TABLE) for each in column)
        for text in set(values) if targets[0].is_text else ():
            _require_node_accepts(targets[0], text, scenario)
        found.append(Dispersion(targets[0], Distribution(_TABLE, {}, values)))
    return found


def checked_dispersions(drawn: Sequence[Dispersion]) -> tuple[Dispersion, ...]:
    """Return dispersions in the order in which they are applied.

    Raises
    ------
    ParameterError
        Two dispersions set the same value.
    """
    found: dict[str, Dispersion] = {}
    for each in drawn:
        if each.name in found:
            raise ParameterError(f"'{each.name}' is dispersed twice.")
        for other in found.values():
            if other.target.assigned_parameters & each.target.assigned_parameters:
                raise ParameterError(
                    f"'{other.name}' and '{each.name}' set the same values: omit one of them."
                )
        found[each.name] = each
    return tuple(sorted(found.values(), key=lambda each: each.target.order))


_SCIPY_NAMES = {"normal": "norm", "gauss": "norm", "gaussian": "norm", "exponential": "expon"}

_ARGUMENT_HELP = {
    "norm": "loc is the mean and scale is the standard deviation",
    "uniform": "loc is the smallest value and scale is the width of the range; [a, b] ranges from "
    "a to b",
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
        raise ParameterError(f"'{name}' is a string: it must have a 'choice' of strings.")
    distribution = _load_scipy_distribution(str(kind))
    shapes = (distribution.shapes or "").replace(" ", "").split(",")
    words = [*filter(None, shapes), "loc", *(["scale"] if hasattr(distribution, "pdf") else [])]
    if isinstance(arguments, list) and kind == "uniform":
        if len(arguments) != 2:
            raise ParameterError(f"'{name}': uniform takes two numbers, [smallest, largest].")
        least, most = (read_real_number(f"{name}: uniform", each) for each in arguments)
        if not least < most:
            raise ParameterError(
                f"'{name}': uniform ranges from {least:g} to {most:g}; the first number must "
                "be smaller."
            )
        arguments = [least, most - least]
    if isinstance(arguments, list) and len(arguments) <= len(words):
        arguments = dict(zip(words, arguments, strict=False))
    required = set(filter(None, shapes))
    if not isinstance(arguments, dict) or not required <= arguments.keys() <= set(words):
        named = arguments if isinstance(arguments, dict) else {}
        unknown = [str(word) for word in named if word not in words]
        raise ParameterError(
            f"'{name}': {kind} takes {', '.join(words)}, not {arguments!r}"
            f"{': ' + _ARGUMENT_HELP[kind] if kind in _ARGUMENT_HELP else ''}."
            f"{suggestion(unknown[0], words) if unknown else ''}"
        )
    values = {word: read_real_number(f"{name}: {word}", value) for word, value in arguments.items()}
    with np.errstate(all="ignore"):
        middle = float(distribution.ppf(0.5, **values))
    if not math.isfinite(middle):
        raise ParameterError(
            f"'{name}': {kind} is not defined for these arguments: "
            f"{', '.join(f'{word} {value:g}' for word, value in values.items())}."
        )
    return Distribution(str(kind), values)


def _read_choice(target: DispersionTarget, value: Any, where: str = "choice") -> Any:
    if not target.is_text:
        number = number_in(value) if isinstance(value, str) else value
        return read_real_number(f"{target.name}: {where}", number)
    if not isinstance(value, str):
        raise ParameterError(f"'{target.name}' is a string; the {where} has {value!r}.")
    return value


def _require_node_accepts(target: DispersionTarget, value: Any, scenario: Scenario) -> None:
    flight = target.apply(DrawnFlight.of(scenario), value)
    for node in ("plant", *scenario.commanders):
        flight.scenario.config(node)


def _load_scipy_distribution(name: str) -> Any:
    """Return a distribution of scipy.stats, which takes a second to load."""
    from scipy import stats

    kinds = stats.rv_continuous, stats.rv_discrete
    known = {each: value for each, value in vars(stats).items() if isinstance(value, kinds)}
    if name not in known:
        raise ParameterError(
            f"scipy.stats has no distribution '{name}'."
            f"{suggestion(_SCIPY_NAMES.get(name.lower(), name), [*known, 'choice'])}"
        )
    return known[name]


# -- draws ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Draw:
    """The drawn values of one flight.

    Attributes
    ----------
    number
        Flight number.
    seed
        Seed of sensor and actuator noise.
    values
        Values by dispersion name.
    fallback
        Reason why engine ``flights`` flies the draw instead of the campaign's engine, which
        completes "the flight ..." (for example "needed corrections"), or is an error message; empty
        for the campaign's engine.
    """

    number: int
    seed: int
    values: Mapping[str, Any]
    fallback: str = ""


class Draws:
    """All draws in a campaign.

    Raises
    ------
    ParameterError
        The sampler requires more flights than the campaign has.
    """

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        self._block, self._made = -1, list[Draw]()
        """The last computed block of draws."""
        self.shares = self._sampler_shares()
        """(N, D) cumulative probabilities of the values; None for the sampler ``random``, which
        uses a separate random generator for each flight."""

    def __len__(self) -> int:
        return self._campaign.flights if self.shares is None else len(self.shares)

    def __getitem__(self, number: int) -> Draw:
        """Return a draw by its number."""
        if not 0 <= number < len(self):
            raise IndexError(f"There is no draw {number}: there are only {len(self)}.")
        block, place = divmod(number, _BLOCK_SIZE)
        if block != self._block:
            self._made, self._block = self._draw_block(block * _BLOCK_SIZE), block
        return self._made[place]

    def _draw_block(self, first: int) -> list[Draw]:
        campaign = self._campaign
        numbers = range(first, first + _BLOCK_SIZE)
        seeds = [np.random.SeedSequence(campaign.seed, spawn_key=(number,)) for number in numbers]
        shares = np.full((_BLOCK_SIZE, len(campaign.dispersions)), 0.5)
        if self.shares is None:
            for row, own in zip(shares, seeds, strict=True):
                row[:] = np.random.default_rng(own.spawn(1)[0]).random(len(row))
        else:
            given = self.shares[first : first + _BLOCK_SIZE]
            shares[: len(given)] = given
        shares = np.clip(shares, _MIN_PROBABILITY, 1.0 - _MIN_PROBABILITY)
        if campaign.correlation_factor is not None:
            from scipy.special import ndtr, ndtri

            shares = ndtr(ndtri(shares) @ campaign.correlation_factor.T)
            shares = np.clip(shares, _MIN_PROBABILITY, 1.0 - _MIN_PROBABILITY)
        columns = [
            each.distribution.values(numbers, u)
            for each, u in zip(campaign.dispersions, shares.T, strict=True)
        ]
        made = []
        for place, own in enumerate(seeds):
            values = dict(zip(campaign.names, (column[place] for column in columns), strict=True))
            made.append(Draw(first + place, int(own.generate_state(1)[0] >> 1), values))
        return made

    def __iter__(self) -> Iterator[Draw]:
        return (self[number] for number in range(len(self)))

    def _sampler_shares(self) -> Array | None:
        campaign, size = self._campaign, len(self._campaign.dispersions)
        if campaign.sampler == "random" or not size:
            return None
        if campaign.sampler == "saltelli":
            return self._saltelli_shares(size)
        from scipy.stats import qmc

        kinds = {"latin_hypercube": qmc.LatinHypercube, "sobol": qmc.Sobol, "halton": qmc.Halton}
        rng = np.random.default_rng(np.random.SeedSequence(campaign.seed))
        # Argument name before scipy 1.15; later versions also accept it.
        engine = kinds[campaign.sampler](d=size, seed=rng)
        if campaign.sampler == "sobol":
            # Any number of flights is allowed, though only powers of two are balanced.
            power = int(np.ceil(np.log2(max(1, campaign.flights))))
            return np.asarray(engine.random_base2(power))[: campaign.flights]
        return np.asarray(engine.random(campaign.flights))

    def _saltelli_shares(self, size: int) -> Array:
        base = self._campaign.flights // (size + 2)
        if base < 2:
            raise ParameterError(
                f"the sampler 'saltelli' requires at least {2 * (size + 2)} flights for "
                f"{counted(size, 'dispersion')}."
            )
        base = 2 ** int(np.log2(base))
        problem = sobol_problem(self._campaign.names)
        sample = require_module("SALib.sample.sobol").sample
        seed = int(np.random.SeedSequence(self._campaign.seed).generate_state(1)[0] >> 1)
        return np.asarray(sample(problem, base, calc_second_order=False, seed=seed))


def drawn_flight(campaign: Campaign, draw: Draw, common: DrawnFlight | None = None) -> DrawnFlight:
    """Return the flight for a draw; ``common`` is :meth:`.DrawnFlight.of` for the scenario, if
    known.

    Raises
    ------
    ParameterError
        A parameter value is invalid.
    RobotDescriptionError
        A drawn mass or inertia is not physical.
    """
    ((_, flight),) = drawn_flights(campaign, [draw], common or DrawnFlight.of(campaign.scenario))
    if isinstance(flight, Exception):
        raise flight
    return flight


def drawn_flights(
    campaign: Campaign, draws: Iterable[Draw], common: DrawnFlight
) -> Iterator[tuple[Draw, DrawnFlight | Exception]]:
    """Yield draws with their flights, or with the error raised by :func:`drawn_flight`.

    Mass properties are computed for many draws at once.
    """
    has_own_seed = _SEED not in campaign.names
    nominal = InertialParameters.of(common.nominal)
    bodies = [body.name for body in common.nominal.bodies]
    remaining = iter(draws)
    while block := list(islice(remaining, _BLOCK_SIZE)):
        factors = MassFactors.of(len(block), len(bodies))
        for dispersion in campaign.dispersions:
            if dispersion.target.weigh is not None:
                drawn = np.array([draw.values[dispersion.name] for draw in block])
                # Other values are refused below.
                dispersion.target.weigh(factors, np.where(np.isfinite(drawn), drawn, 1.0))
        parameters, differ = factors.applied_to(nominal), factors.differ.tolist()
        suspicious = any(differ)
        with suppress(RobotDescriptionError):
            parameters.require_physical(bodies)
            suspicious = False
        for row, draw in enumerate(block):
            seed = draw.seed if has_own_seed else None
            flight = replace(common, inertial=parameters[row] if differ[row] else None, seed=seed)
            try:
                for dispersion in campaign.dispersions:
                    value, target = draw.values[dispersion.name], dispersion.target
                    if not target.is_text and not math.isfinite(value):
                        raise ParameterError(f"The value drawn for '{dispersion.name}' is {value}.")
                    flight = target.apply(flight, value)
                if suspicious and flight.inertial is not None:
                    flight.inertial.require_physical(bodies)
            except Exception as error:
                yield draw, error
            else:
                yield draw, flight


def require_module(module: str) -> Any:
    """Return a module from the extra ``campaign``; see :func:`.optional_module`."""
    return optional_module(module, "campaign", "Campaigns need")


def sobol_problem(names: Sequence[str]) -> dict[str, Any]:
    """Return the SALib problem definition for quantities from 0 to 1 with the given names."""
    # The names are an array, because pandas 3 accepts no list from SALib 1.5.
    listed = np.array(list(names), dtype=object)
    return {"num_vars": len(listed), "names": listed, "bounds": [[0, 1]] * len(listed)}
