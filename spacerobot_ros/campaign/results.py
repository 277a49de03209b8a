"""Campaign rows as columns, and the report data."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.campaign.config import Campaign, Criterion, meets_criterion
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

_REASON = "reason"
_TEXT_COLUMNS = ("outcome", _REASON, "engine", "fallback")

_MAIN_METRICS = (
    *("position_error_m", "attitude_error_rad", "manoeuvre_time_s", "propellant_kg"),
    *("capture_time_s", "capture_distance_m", "capture_impulse_Ns"),
    *("detumbling_time_s", "detumbling_bound_s"),
)

_NOT_CONTROLLED = re.compile(r"[(; ]([a-z]+(?: and [a-z]+)*) not controlled\)")
"""Uncontrolled goal components in a flight's message."""


class Columns(Mapping[str, Any]):
    """Dataset columns by name, with values in flight order; columns are read on demand.

    Numbers are arrays (N,) with NaN for missing values; strings are lists with None for missing
    values.

    Parameters
    ----------
    dataset
        The dataset.

    Raises
    ------
    ParameterError
        It has no rows.
    """

    def __init__(self, dataset: Dataset) -> None:
        self._dataset = dataset
        self._known: dict[str, Any] = {}
        self._known["flight"] = dataset.table(["flight"])["flight"].to_numpy().astype(float)

    def read(self, names: Iterable[str]) -> None:
        """Read several columns, opening each file once."""
        left = [name for name in names if name not in self._known]
        table = self._dataset.table(left)
        text = require_module("pyarrow").string()
        for name in left:
            self._known[name] = None
            if name not in table.column_names:
                continue
            column = table[name]
            # Converted data is freed immediately: a million rows of a column take 8 MB.
            table = table.drop_columns([name])
            if name in _TEXT_COLUMNS or column.type == text:
                self._known[name] = self._texts(column.cast(text))
            else:
                # Missing numbers become NaN; seeds beyond 2^53 are rounded.
                self._known[name] = column.cast("double", safe=False).to_numpy()

    def _texts(self, column: Any) -> list[str | None]:
        """Return a string column; equal strings share one object."""
        known: dict[str | None, str | None] = {}
        return [known.setdefault(x, x) for chunk in column.chunks for x in chunk.to_pylist()]

    def __getitem__(self, name: str) -> Any:
        if name not in self._known:
            self.read([name])
        # The reasons of a million flights take 300 MB, and are not kept.
        values = self._known.pop(name) if name == _REASON else self._known[name]
        if values is None:
            raise KeyError(name)
        return values

    def __iter__(self) -> Iterator[str]:
        return (name for name, values in self._known.items() if values is not None)

    def __len__(self) -> int:
        return sum(1 for _ in self)


@dataclass(frozen=True)
class Results:
    """Campaign rows as columns.

    Attributes
    ----------
    campaign
        The campaign.
    folder
        Folder of the dataset.
    flight_numbers
        (N,) flight numbers.
    columns
        Columns by name: arrays of numbers, lists of strings.
    planned_flights
        Number of flights in the whole campaign.
    """

    campaign: Campaign
    folder: Path
    flight_numbers: Array
    columns: Mapping[str, Any]
    planned_flights: int

    @classmethod
    def of(cls, folder: Path) -> Results:
        """Read a dataset.

        Raises
        ------
        ParameterError
            The folder contains no campaign, or no flights yet.
        """
        dataset = Dataset(folder)
        campaign = dataset.campaign()
        columns = Columns(dataset)
        shown = {*_MAIN_METRICS, *campaign.named_metrics}
        shown |= {name for name, metric in METRICS.items() if metric.yes_or_no}
        drawn = [f"{DRAW_PREFIX}{name}" for name in campaign.names]
        columns.read(["passed", "wall_time_s", *drawn, *sorted(shown)])
        return cls(campaign, folder, columns["flight"], columns, len(Draws(campaign)))

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
        return share(int(self.passed.sum()), len(self))

    @property
    def drawn_numbers(self) -> dict[str, Array]:
        """(N,) drawn values by dispersion name; numbers only."""
        columns = {name: self.columns[f"{DRAW_PREFIX}{name}"] for name in self.campaign.names}
        return {name: x for name, x in columns.items() if isinstance(x, np.ndarray)}

    @property
    def shown_metrics(self) -> list[str]:
        """Report metrics that have values: the metrics named in the campaign, and the main
        metrics."""
        names = self.campaign.named_metrics
        names += [name for name in _MAIN_METRICS if name not in names]
        return [name for name in names if np.isfinite(self.columns.get(name, np.nan)).any()]

    @property
    def refused(self) -> Flags:
        """(N,) whether each flight's goal was refused."""
        return np.array([outcome == "refused" for outcome in self.columns["outcome"]], dtype=bool)

    @cached_property
    def messages(self) -> tuple[list[str], dict[str, str]]:
        """Each flight's message without numbers; and, for each such message, the message with
        numbers if the numbers are the same in all flights.
        """
        found: list[str] = []
        forms: dict[str, str] = {}
        for reason in self.columns[_REASON]:
            text = reason or ""
            # Equal messages are one object.
            message = sys.intern(re.sub(r"-?\d[\d.e+-]*", "…", text))
            found.append(message)
            if forms.setdefault(message, text) != text:
                forms[message] = message
        return found, forms

    @property
    def not_controlled(self) -> list[str]:
        """Goal components that successful flights did not control, according to their messages."""
        notes = [_NOT_CONTROLLED.search(text) for text in self.messages[1]]
        named = {part for note in notes if note for part in note[1].split(" and ")}
        return sorted(named)

    @property
    def distributed_metrics(self) -> list[str]:
        """Report metrics, except for flags (yes or no)."""
        return [name for name in self.shown_metrics if not metric_of(name).yes_or_no]

    @property
    def sampler_shares(self) -> dict[str, Share]:
        """Shares of flights for which a flag (yes or no) is true, by metric name."""
        found = {}
        for name, metric in METRICS.items():
            values = self.columns.get(name)
            if metric.yes_or_no and values is not None and np.isfinite(values).any():
                found[name] = share(int((values == 1.0).sum()), len(self))
        return found

    def metrics(self) -> dict[str, Array]:
        """Return the columns of the report metrics."""
        return {name: self.columns[name] for name in self.shown_metrics}

    def share_meeting(self, criterion: Criterion) -> Share:
        """Return the share of flights that meet a criterion."""
        values = self.columns[criterion.metric].tolist()
        met = sum(meets_criterion(criterion, {criterion.metric: value}) for value in values)
        return share(met, len(self))

    def influences(self) -> list[Influence]:
        """Return the sensitivities, strongest first, with Sobol indices if available."""
        passing = {PASSING: self.passed.astype(float)}
        found = corrected_for_multiple_tests(
            influences(self.drawn_numbers, passing | self.metrics())
        )
        whole = self.campaign.sampler == "saltelli" and len(self) == self.planned_flights
        if whole and len(self.drawn_numbers) == len(self.campaign.dispersions):
            names = list(self.drawn_numbers)
            indices = {PASSING: sobol_indices(names, self.passed.astype(float))}
            indices |= {name: sobol_indices(names, x) for name, x in self.metrics().items()}
            for place, each in enumerate(found):
                if known := indices[each.metric].get(each.cause):
                    first, total = known[:2], known[2:]
                    found[place] = replace(each, first_order_index=first, total_order_index=total)
        return sorted(found, key=lambda each: -each.strength)

    def drawn_by_influence(self, found: Sequence[Influence]) -> list[str]:
        """Return the names of drawn values: strings first, then numbers in order of influence on
        passing."""
        causes = [each.cause for each in found if each.metric == PASSING]
        return [*(name for name in self.campaign.names if name not in self.drawn_numbers), *causes]

    def success_by_bins(self, name: str) -> list[Bin]:
        """Return the shares of flights that passed as a function of the drawn values with a given
        name."""
        return success_by_bins(np.asarray(self.columns[f"{DRAW_PREFIX}{name}"]), self.passed)

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
            badness = np.maximum(
                badness,
                np.clip(
                    np.nan_to_num(over, nan=_MAX_BOUND_DISTANCE),
                    -_MAX_BOUND_DISTANCE,
                    _MAX_BOUND_DISTANCE,
                ),
            )
        if not self.campaign.criteria:
            badness = np.nan_to_num(self.columns["position_error_m"])
        badness += 1e6 * (np.array(self.columns["outcome"]) != "reached")
        badness += 1e3 * ~self.passed
        order = np.lexsort((self.flight_numbers, -badness))
        return [int(row) for row in order[:_WORST_FLIGHTS_SHOWN]]


def messages_of(results: Results) -> list[tuple[str, int, str]]:
    """Return the outcomes, each with its most frequent message and number of flights.

    Messages that differ only in numbers are merged, and the numbers are omitted.
    """
    messages, forms = results.messages
    kinds: dict[str, Counter[str]] = {}
    for outcome, message in zip(results.columns["outcome"], messages, strict=True):
        kinds.setdefault(outcome, Counter())[message] += 1
    return [
        (outcome, count, forms[message])
        for outcome, counts in sorted(kinds.items(), key=lambda kind: -kind[1].total())
        for message, count in counts.most_common(_MESSAGES_SHOWN)
    ]
