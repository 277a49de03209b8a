"""Campaign rows as columns, and their statistics: shares with intervals, percentiles,
sensitivities, comparisons."""

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
from spacerobot_ros.campaign.dataset import DRAW_PREFIX, ERROR, Dataset
from spacerobot_ros.campaign.draws import Draws, require_module, sobol_problem
from spacerobot_ros.campaign.metrics import metric_of
from spacerobot_ros.measures import METRICS
from spacerobot_ros.model.description import Array

Flags = npt.NDArray[np.bool_]

CONFIDENCE = 0.95
"""Confidence level of all intervals."""

PERCENTILES = (5.0, 50.0, 95.0, 99.0)

_MAX_PERMUTED_VALUES = 8
"""Largest number of samples for which all permutations are counted."""

PASSING = "passing"
"""Name of the pseudo-metric for whether a flight passed."""

_WORST_FLIGHTS_SHOWN = 10
_MESSAGES_SHOWN = 4
_MAX_BOUND_DISTANCE = 100.0
"""Distance from a bound, in standard deviations, beyond which flights are considered equal in this
order."""

_ROW_COLUMNS = ("flight", "passed", "outcome", "reason", "engine", "fallback", "wall_time_s")

_MAIN_METRICS = (
    *("position_error_m", "attitude_error_rad"),
    *("end_effector_position_error_m", "end_effector_attitude_error_rad"),
    *("manoeuvre_time_s", "propellant_kg"),
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

    @property
    def warnings_on_criteria(self) -> list[str]:
        """A sentence for each criterion whose metric has no value, although flights ended without
        an error."""
        flown = self.columns["outcome"] != ERROR
        return [
            f"No flight has a value of '{name}', so no flight meets its criterion: remove the "
            "criterion, or choose a scenario in which this metric is measured."
            for name in dict.fromkeys(each.metric for each in self.campaign.criteria)
            if flown.any() and np.isnan(self.columns[name][flown]).all()
        ]

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


# -- statistics ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Share:
    """A share of flights with its Wilson interval (``interval_low`` to ``interval_high``) and
    Clopper-Pearson interval (``exact_interval``)."""

    count: int
    total: int
    interval_low: float
    interval_high: float
    exact_interval: tuple[float, float]

    @property
    def value(self) -> float:
        """The share, 0 to 1; NaN if there are no flights."""
        return self.count / self.total if self.total else float("nan")

    def __str__(self) -> str:
        return (
            f"{100 * self.value:.4g} % ({self.count} of {self.total}; 95 % interval "
            f"{100 * self.interval_low:.4g} to {100 * self.interval_high:.4g} %)"
        )


def share(flags: Flags) -> Share:
    """Return the share of flights (N,) with a flag; for no flights, its intervals are 0 to 1."""
    count, total = int(np.count_nonzero(flags)), len(flags)
    if not total:
        return Share(0, 0, 0.0, 1.0, (0.0, 1.0))
    from scipy.stats import binomtest

    test = binomtest(count, total)
    wilson, exact = (test.proportion_ci(CONFIDENCE, kind) for kind in ("wilson", "exact"))
    bounds = float(exact.low), float(exact.high)
    return Share(count, total, float(wilson.low), float(wilson.high), bounds)


_MAX_BINS, _FLIGHTS_OF_BIN = 8, 10
"""Largest number of bins, and desired number of flights per bin."""


@dataclass(frozen=True)
class Bin:
    """Flights with drawn values from ``low`` to ``high``, and the share that passed."""

    low: Any
    high: Any
    passed: Share


def success_by_bins(drawn: npt.NDArray[Any], passed: Flags) -> list[Bin]:
    """Return the shares of flights that passed, (N,), in bins of the drawn values (N,).

    Each string has its own bin, and so does each number if there are few different numbers; many
    numbers are binned with approximately the same number of flights per bin.
    """
    if drawn.dtype.kind == "f":
        finite = np.isfinite(drawn)
        drawn, passed = drawn[finite], passed[finite]
    values = np.unique(drawn)
    if len(values) <= _MAX_BINS or drawn.dtype.kind != "f":
        bins = [drawn == value for value in values]
    else:
        count = min(_MAX_BINS, max(2, len(drawn) // _FLIGHTS_OF_BIN))
        edges = np.quantile(drawn, np.linspace(0.0, 1.0, count + 1)[1:-1])
        bins = [np.searchsorted(edges, drawn) == place for place in range(count)]
    found = []
    for of in bins:
        if of.any():
            inside = np.unique(drawn[of])
            found.append(Bin(inside[0], inside[-1], share(passed[of])))
    return found


_SIGNIFICANCE = 0.05
"""Largest p-value of a significant influence after correction for multiple tests."""


@dataclass(frozen=True)
class Influence:
    """Sensitivity of a metric to a dispersion.

    Attributes
    ----------
    cause, metric
        Dispersion and metric names.
    correlation
        Spearman's rank correlation.
    p_value
        Probability that a correlation at least this large occurs by chance.
    distance_correlation, distance_p_value
        Correlation and p-value for the distance between the drawn value and its median; they reveal
        metrics that increase on both sides of the median.
    first_order_index, total_order_index
        Sobol indices and the half-widths of their intervals, if the sampler provides them.
    """

    cause: str
    metric: str
    correlation: float
    p_value: float
    distance_correlation: float = 0.0
    distance_p_value: float = 1.0
    first_order_index: tuple[float, float] | None = None
    total_order_index: tuple[float, float] | None = None

    @property
    def is_significant(self) -> bool:
        """Whether the total index is significant or, if there is none, the larger correlation."""
        if self.total_order_index is not None:
            return self.total_order_index[0] > self.total_order_index[1]
        nearer = abs(self.correlation) >= abs(self.distance_correlation)
        return (self.p_value if nearer else self.distance_p_value) < _SIGNIFICANCE

    @property
    def strength(self) -> float:
        """Sorting key: the total index or, if there is none, the larger correlation."""
        if self.total_order_index is not None:
            return self.total_order_index[0]
        return max(abs(self.correlation), abs(self.distance_correlation))

    def __str__(self) -> str:
        name = f"{self.cause} of {self.metric}"
        if self.total_order_index is not None:
            return f"{name}: total Sobol index {self.total_order_index[0]:.2f}"
        if abs(self.distance_correlation) > abs(self.correlation):
            return f"{name}: {self.distance_correlation:+.2f} with its distance from the median"
        return f"{name}: {self.correlation:+.2f}"


def influences(causes: Mapping[str, Array], metrics: Mapping[str, Array]) -> list[Influence]:
    """Return the sensitivity of each metric (N,) to each dispersion (N,).

    Flights without the metric are omitted, and so are pairs without variation.
    """
    found = []
    for metric, values in metrics.items():
        there = np.isfinite(values)
        if there.sum() < 3 or np.ptp(values[there]) == 0.0:
            continue
        for cause, drawn in causes.items():
            if np.ptp(drawn[there]) == 0.0:
                continue
            x, y = drawn[there], values[there]
            away = np.abs(x - np.median(x))
            departure = rank_correlation(away, y) if np.ptp(away) > 0.0 else (0.0, 1.0)
            found.append(Influence(cause, metric, *rank_correlation(x, y), *departure))
    return found


def rank_correlation(x: Array, y: Array) -> tuple[float, float]:
    """Return Spearman's correlation of non-constant samples (N,), and its p-value.

    For small samples, the p-value is computed by counting permutations. For three perfectly ordered
    samples, it is one third; the Student's t approximation used for many samples would yield a
    p-value of zero.
    """
    from scipy.stats import permutation_test, rankdata, spearmanr

    known = spearmanr(x, y)
    if len(x) > _MAX_PERMUTED_VALUES:
        return float(known.statistic), float(known.pvalue)
    others = rankdata(y) - (len(y) + 1) / 2
    counted = permutation_test(
        [rankdata(x)],
        lambda ranks, axis: np.sum(ranks * others, axis=axis),
        permutation_type="pairings",
        n_resamples=np.inf,
    )
    return float(known.statistic), float(counted.pvalue)


def corrected_for_multiple_tests(found: Sequence[Influence]) -> list[Influence]:
    """Return sensitivities with p-values corrected for multiple tests.

    Both kinds of p-values are corrected together by the Benjamini-Hochberg procedure: of the tests
    with a corrected p-value of at most p, at most a fraction p is expected to be significant only
    by chance.
    """
    if not found:
        return []
    from scipy.stats import false_discovery_control

    chances = np.array([[each.p_value, each.distance_p_value] for each in found])
    adjusted = false_discovery_control(np.nan_to_num(chances, nan=1.0).ravel()).reshape(-1, 2)
    return [
        replace(each, p_value=p, distance_p_value=p_of_distance)
        for each, (p, p_of_distance) in zip(found, adjusted.tolist(), strict=True)
    ]


def sobol_indices(names: Sequence[str], values: Array) -> dict[str, dict[str, Any]]:
    """Return the Sobol indices of :class:`Influence` by their names, by dispersion name.

    ``values`` (N,) are in Saltelli sample order. The result is empty if the metric is
    missing for a flight.
    """
    if not np.all(np.isfinite(values)) or np.ptp(values) == 0.0:
        return {}
    analyze, problem = require_module("SALib.analyze.sobol").analyze, sobol_problem(names)
    result = analyze(problem, values, calc_second_order=False, seed=1)
    rows = np.array([result[key] for key in ("S1", "S1_conf", "ST", "ST_conf")]).T.tolist()
    return {
        name: {"first_order_index": (a, b), "total_order_index": (c, d)}
        for name, (a, b, c, d) in zip(names, rows, strict=True)
    }


def percentiles(values: Array) -> list[float]:
    """Return the :data:`PERCENTILES` of the finite values; NaN if there are none."""
    there = values[np.isfinite(values)]
    if not there.size:
        return [float("nan")] * len(PERCENTILES)
    return [float(x) for x in np.percentile(there, PERCENTILES)]


@dataclass(frozen=True)
class PairedDifference:
    """Mean paired difference in a metric between two campaigns, with its interval."""

    metric: str
    count: int
    first: float
    second: float
    difference: float
    interval_low: float
    interval_high: float

    @property
    def is_significant(self) -> bool:
        """Whether the interval excludes zero."""
        return self.interval_low > 0.0 or self.interval_high < 0.0


def paired_difference(metric: str, first: Array, second: Array) -> PairedDifference | None:
    """Return the paired difference in a metric (N,), second campaign minus first.

    The interval is Student's t interval for the mean difference. None if there are fewer than two
    pairs.
    """
    there = np.isfinite(first) & np.isfinite(second)
    count = int(there.sum())
    if count < 2:
        return None
    from scipy.stats import t

    difference = second[there] - first[there]
    mean, spread = float(difference.mean()), float(difference.std(ddof=1))
    half = float(t.ppf(0.5 + CONFIDENCE / 2, count - 1)) * spread / np.sqrt(count)
    means = float(first[there].mean()), float(second[there].mean())
    return PairedDifference(metric, count, *means, mean, mean - half, mean + half)


def paired_success(first: Flags, second: Flags) -> tuple[int, int, float]:
    """Return the number of draws that passed only in the first campaign, the number that passed
    only in the second, and McNemar's exact p-value."""
    from scipy.stats import binomtest

    only_first, only_second = int((first & ~second).sum()), int((second & ~first).sum())
    total = only_first + only_second
    p = float(binomtest(only_first, total).pvalue) if total else 1.0
    return only_first, only_second, p
