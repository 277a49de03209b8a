"""The draws of a campaign: which values each flight has.

A draw is known by its number alone: it depends neither on the number of workers nor on the order in
which flights end, and with the samplers ``random``, ``sobol`` and ``halton`` not on the number of
flights.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.targets import DrawnFlight
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array

_SMALLEST = 1e-12
"""Least distance of shares from 0 and 1, where many distributions are infinite."""


_BLOCK = 256
"""Draws that are made at once."""


@dataclass(frozen=True)
class Draw:
    """The values that are drawn for one flight.

    Attributes
    ----------
    number
        The number of the flight.
    seed
        The seed of the noise of its sensors and actuators.
    values
        The values by the names of the dispersions.
    """

    number: int
    seed: int
    values: Mapping[str, Any]


class Draws:
    """All draws of a campaign.

    Raises
    ------
    ParameterError
        The sampler cannot make so few.
    """

    def __init__(self, campaign: Campaign) -> None:
        self._campaign = campaign
        self._block, self._made = -1, list[Draw]()
        """The block of draws that was made last."""
        self.shares = self._spread()
        """(N, D) the shares of the distributions below the values; None with the sampler
        ``random``, with which each flight draws from a generator of its own."""

    def __len__(self) -> int:
        return self._campaign.flights if self.shares is None else len(self.shares)

    def __getitem__(self, number: int) -> Draw:
        """Return a draw by its number."""
        if not 0 <= number < len(self):
            raise IndexError(f"There is no draw {number} of {len(self)}.")
        block, place = divmod(number, _BLOCK)
        if block != self._block:
            self._made, self._block = self._drawn(block * _BLOCK), block
        return self._made[place]

    def _drawn(self, first: int) -> list[Draw]:
        """Return the draws of a block, whose values are computed at once.

        The block is whole even where the campaign ends within it: what a value is does not depend
        on how many there are.
        """
        campaign = self._campaign
        numbers = range(first, first + _BLOCK)
        seeds = [np.random.SeedSequence(campaign.seed, spawn_key=(number,)) for number in numbers]
        shares = np.full((_BLOCK, len(campaign.dispersions)), 0.5)
        if self.shares is None:
            for row, own in zip(shares, seeds, strict=True):
                row[:] = np.random.default_rng(own.spawn(1)[0]).random(len(row))
        else:
            given = self.shares[first : first + _BLOCK]
            shares[: len(given)] = given
        shares = np.clip(shares, _SMALLEST, 1.0 - _SMALLEST)
        columns = [
            each.distribution.at(u) for each, u in zip(campaign.dispersions, shares.T, strict=True)
        ]
        made = []
        for place, own in enumerate(seeds):
            values = dict(zip(campaign.names, (column[place] for column in columns), strict=True))
            made.append(Draw(first + place, int(own.generate_state(1)[0] >> 1), values))
        return made

    def __iter__(self) -> Iterator[Draw]:
        return (self[number] for number in range(len(self)))

    def _spread(self) -> Array | None:
        campaign, size = self._campaign, len(self._campaign.dispersions)
        if campaign.sampler == "random" or not size:
            return None
        if campaign.sampler == "saltelli":
            return self._saltelli(size)
        from scipy.stats import qmc

        kinds = {
            "latin_hypercube": qmc.LatinHypercube,
            "sobol": qmc.Sobol,
            "halton": qmc.Halton,
        }
        rng = np.random.default_rng(np.random.SeedSequence(campaign.seed))
        # The name before scipy 1.15, which later ones take, too.
        engine = kinds[campaign.sampler](d=size, seed=rng)
        if campaign.sampler == "sobol":
            # Any number of them: only a power of two is balanced.
            power = int(np.ceil(np.log2(max(1, campaign.flights))))
            return np.asarray(engine.random_base2(power))[: campaign.flights]
        return np.asarray(engine.random(campaign.flights))

    def _saltelli(self, size: int) -> Array:
        from spacerobot_ros.campaign.extras import salib, sobol_problem

        base = self._campaign.flights // (size + 2)
        if base < 2:
            raise ParameterError(
                f"the sampler 'saltelli' needs at least {2 * (size + 2)} flights for {size} "
                "dispersion(s)."
            )
        base = 2 ** int(np.log2(base))
        problem = sobol_problem(self._campaign.names)
        sample = salib("sample.sobol").sample
        seed = int(np.random.SeedSequence(self._campaign.seed).generate_state(1)[0] >> 1)
        return np.asarray(sample(problem, base, calc_second_order=False, seed=seed))


def drawn_flight(campaign: Campaign, draw: Draw, common: DrawnFlight | None = None) -> DrawnFlight:
    """Return the flight of a draw; ``common`` is what :meth:`.DrawnFlight.of` has of the scenario.

    Raises
    ------
    ParameterError
        A parameter refuses its value.
    RobotDescriptionError
        No body weighs what was drawn.
    """
    flight = common or DrawnFlight.of(campaign.scenario)
    flight = replace(
        flight, scenario=flight.scenario.with_overrides("plant", {"sensors.seed": draw.seed})
    )
    for dispersion in campaign.dispersions:
        value = draw.values[dispersion.name]
        if not dispersion.target.text and not math.isfinite(value):
            raise ParameterError(f"What was drawn of '{dispersion.name}' is {value}.")
        flight = dispersion.target.apply(flight, value)
    inertial = flight.inertial
    if inertial is not None:
        inertial.require_physical([body.name for body in flight.nominal.bodies])
    return flight
