"""Campaign draws: the random values of each flight.

A draw is determined by its number; it depends neither on the number of workers nor on the order in
which flights finish. With the samplers ``random``, ``sobol`` and ``halton``, it does not depend on
the number of flights either.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.targets import DrawnFlight, MassFactors
from spacerobot_ros.errors import ParameterError, RobotDescriptionError, counted
from spacerobot_ros.lazy import optional_module
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.inertial_parameters import InertialParameters

_MIN_PROBABILITY = 1e-12
"""Smallest distance of cumulative probabilities from 0 and 1, at which many quantiles are
infinite."""

_BLOCK_SIZE = 256
"""Number of draws computed together."""

_SEED = "plant.sensors.seed"
"""Name of the flight seed, which campaigns can disperse in the same way as other parameters."""


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
