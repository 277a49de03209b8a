"""Campaign rows as columns, and the report data."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import groupby, islice
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.campaign.config import Campaign, Criterion
from spacerobot_ros.campaign.dataset import DRAW_PREFIX, Dataset
from spacerobot_ros.campaign.draws import Draws, require_module
from spacerobot_ros.campaign.metrics import metric_of
from spacerobot_ros.campaign.statistics import (
    Bin,
    Flags,
    Influence,
    Share,
    corrected_for_multiple_tests,
    influences,
    share,
    sobol_indices,
    success_by_bins,
)
from spacerobot_ros.measures import METRICS
from spacerobot_ros.model.description import Array

PASSING = "passing"
"""Name of the pseudo-metric for whether a flight passed."""

_WORST_FLIGHTS_SHOWN = 10
_MESSAGES_SHOWN = 4
_MAX_BOUND_DISTANCE = 100.0
"""Distance from a bound, in standard deviations, beyond which flights are considered equal in this
order."""

_ROW_COLUMNS = ("flight", "passed", "outcome", "reason", "engine", "fallback", "wall_time_s")

_MAIN_METRICS = (
    *("position_error_m", "attitude_error_rad", "manoeuvre_time_s", "propellant_kg"),
    *("capture_time_s", "capture_distance_m", "capture_impulse_Ns"),
    *("detumbling_time_s", "detumbling_bound_s"),
)

_FLAG_METRICS = [name for name, metric in METRICS.items() if metric.yes_or_no]

_NOT_CONTROLLED = re.compile(r"[(; ]([a-z]+(?: and [a-z]+)*) not controlled\)")
"""Uncontrolled goal components in a flight's message."""


@dataclass(frozen=True)
class Results:
    """Campaign rows as columns.

    Attributes
    ----------
    campaign
        The campaign.
    folder
        Folder of the dataset.
    columns
        The report's columns (N,) by name, in flight order: numbers, with NaN for missing values,
        or strings.
    messages
        Each outcome with a message and its number of flights, the most frequent first. Numbers are
        omitted from a message unless they are the same in all these flights.
    planned_flights
        Number of flights in the whole campaign.
    """

    campaign: Campaign
    folder: Path
    columns: Mapping[str, Any]
    messages: Sequence[tuple[str, int, str]]
    planned_flights: int

    @classmethod
    def of(cls, folder: Path, others: Sequence[str] = ()) -> Results:
        """Read a dataset, including the columns of other metrics.

        Raises
        ------
        ParameterError
            The folder contains no campaign, or no flights yet.
        """
        dataset = Dataset(folder)
        campaign = dataset.campaign()
        metrics = dict.fromkeys([*_MAIN_METRICS, *campaign.named_metrics, *_FLAG_METRICS, *others])
        draws = [f"{DRAW_PREFIX}{name}" for name in campaign.names]
        table = dataset.table([*_ROW_COLUMNS, *draws, *metrics])
        messages = _messages(table.select(["outcome", "reason"]))
        table = table.drop_columns(["reason"])  # A million messages take 300 MB as strings.
        columns = {name: _values(table[name]) for name in table.column_names}
        return cls(campaign, folder, columns, messages, len(Draws(campaign)))

    @property
    def flight_numbers(self) -> Array:
        """(N,) flight numbers."""
        return np.asarray(self.columns["flight"])

    def __len__(self) -> int:
        return len(self.flight_numbers)

    @property
    def incompleteness_warning(self) -> str:
        """Warning that missing flights bias the results; empty if none are missing.

        Long flights finish late and are underrepresented in an incomplete campaign.
        """
        missing = int(self.flight_numbers.max()) + 1 - len(self) if len(self) else 0
        if not missing:
            return ""
        draws = "1 draw is" if missing == 1 else f"{missing} draws are"
        return (
            f"{draws} not flown yet although later draws have been, usually because they take "
            "longer: shares and distributions may change."
        )

    @property
    def passed(self) -> Flags:
        """(N,) whether each flight reached its goal and met every criterion."""
        return np.asarray(self.columns["passed"] > 0)

    @property
    def success_share(self) -> Share:
        """Share of flights that passed."""
        return share(self.passed)

    @property
    def drawn_numbers(self) -> dict[str, Array]:
        """(N,) drawn values by dispersion name; numbers only."""
        columns = {name: self.columns[f"{DRAW_PREFIX}{name}"] for name in self.campaign.names}
        return {name: x for name, x in columns.items() if x.dtype != object}

    @cached_property
    def shown_metrics(self) -> list[str]:
        """Report metrics that have values: the metrics named in the campaign, and the main
        metrics."""
        names = dict.fromkeys([*self.campaign.named_metrics, *_MAIN_METRICS])
        return [name for name in names if np.isfinite(self.columns.get(name, np.nan)).any()]

    @property
    def refused(self) -> Flags:
        """(N,) whether each flight's goal was refused."""
        return np.asarray(self.columns["outcome"] == "refused")

    @property
    def shown_messages(self) -> list[tuple[str, int, str]]:
        """The most frequent messages of each outcome."""
        by_outcome = groupby(self.messages, key=itemgetter(0))
        return [each for _, found in by_outcome for each in islice(found, _MESSAGES_SHOWN)]

    @property
    def not_controlled(self) -> list[str]:
        """Goal components that successful flights did not control, according to their messages."""
        notes = [_NOT_CONTROLLED.search(text) for _, _, text in self.messages]
        named = {part for note in notes if note for part in note[1].split(" and ")}
        return sorted(named)

    @property
    def distributed_metrics(self) -> list[str]:
        """Report metrics, except for flags (yes or no)."""
        return [name for name in self.shown_metrics if not metric_of(name).yes_or_no]

    @property
    def sampler_shares(self) -> dict[str, Share]:
        """Shares of flights for which a flag (yes or no) is true, by metric name."""
        flags = {name: self.columns.get(name, np.full(1, np.nan)) for name in _FLAG_METRICS}
        return {name: share(x == 1.0) for name, x in flags.items() if np.isfinite(x).any()}

    def share_meeting(self, criterion: Criterion) -> Share:
        """Return the share of flights that meet a criterion."""
        values = self.columns[criterion.metric]
        return share((criterion.minimum <= values) & (values <= criterion.maximum))

    def influences(self) -> list[Influence]:
        """Return the sensitivities, strongest first, with Sobol indices if available."""
        shown = {name: self.columns[name] for name in self.shown_metrics}
        metrics = {PASSING: self.passed.astype(float), **shown}
        found = corrected_for_multiple_tests(influences(self.drawn_numbers, metrics))
        whole = self.campaign.sampler == "saltelli" and len(self) == self.planned_flights
        if whole and len(self.drawn_numbers) == len(self.campaign.dispersions):
            names = list(self.drawn_numbers)
            indices = {name: sobol_indices(names, values) for name, values in metrics.items()}
            found = [replace(each, **indices[each.metric].get(each.cause, {})) for each in found]
        return sorted(found, key=lambda each: -each.strength)

    def drawn_by_influence(self, found: Sequence[Influence]) -> list[str]:
        """Return the names of drawn values: strings first, then numbers in order of influence on
        passing."""
        causes = [each.cause for each in found if each.metric == PASSING]
        return [*(name for name in self.campaign.names if name not in self.drawn_numbers), *causes]

    def success_by_bins(self, name: str) -> list[Bin]:
        """Return the shares of flights that passed as a function of the values drawn for a given
        dispersion."""
        return success_by_bins(self.columns[f"{DRAW_PREFIX}{name}"], self.passed)

    def worst_rows(self) -> list[int]:
        """Return the rows of the worst flights: first failed flights, then flights that missed a
        criterion.

        Flights that passed are ordered by distance from the nearest bound of a criterion, in
        standard deviations.
        """
        badness = np.full(len(self), -_MAX_BOUND_DISTANCE)
        for criterion in self.campaign.criteria:
            x = self.columns[criterion.metric]
            spread = x[np.isfinite(x)].std() if np.isfinite(x).any() else 1.0
            over = np.maximum(x - criterion.maximum, criterion.minimum - x) / (spread or 1.0)
            # A missing metric counts as beyond its bounds.
            over = np.nan_to_num(over, nan=_MAX_BOUND_DISTANCE)
            badness = np.maximum(badness, np.clip(over, -_MAX_BOUND_DISTANCE, _MAX_BOUND_DISTANCE))
        if not self.campaign.criteria:
            badness = np.nan_to_num(self.columns["position_error_m"])
        badness += 1e6 * (self.columns["outcome"] != "reached")
        badness += 1e3 * ~self.passed
        order = np.lexsort((self.flight_numbers, -badness))
        return [int(row) for row in order[:_WORST_FLIGHTS_SHOWN]]


def _messages(table: Any) -> list[tuple[str, int, str]]:
    """Return the messages of :class:`Results` from a pyarrow table of outcomes and reasons."""
    compute = require_module("pyarrow.compute")
    reasons = compute.fill_null(table["reason"], "")
    forms = compute.replace_substring_regex(reasons, r"-?\d[\d.e+-]*", "…")
    table = table.select(["outcome"]).append_column("form", forms).append_column("reason", reasons)
    groups = table.group_by(["outcome", "form"], use_threads=False).aggregate(
        [("reason", "count"), ("reason", "min"), ("reason", "max")]
    )
    found, counts = [], Counter[str]()
    for group in groups.to_pylist():
        outcome, count, text = group["outcome"], group["reason_count"], group["reason_min"]
        found.append((outcome, count, text if text == group["reason_max"] else group["form"]))
        counts[outcome] += count
    places = {outcome: place for place, (outcome, _) in enumerate(counts.most_common())}
    return sorted(found, key=lambda each: (places[each[0]], -each[1]))


def _values(column: Any) -> npt.NDArray[Any]:
    """Return a pyarrow column as an array of numbers or strings; equal strings are one object."""
    arrow = require_module("pyarrow")
    if column.type == arrow.string():
        encoded = column.combine_chunks().dictionary_encode()
        return np.array(encoded.dictionary.to_pylist(), object)[encoded.indices.to_numpy()]
    # Missing numbers become NaN.
    return np.asarray(column.cast("double").to_numpy())
