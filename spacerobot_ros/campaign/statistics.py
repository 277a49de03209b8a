"""Statistics of many flights: shares with intervals, percentiles, sensitivities, comparisons."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.campaign.draws import require_module, sobol_problem
from spacerobot_ros.model.description import Array

Flags = npt.NDArray[np.bool_]

CONFIDENCE = 0.95
"""Confidence level of all intervals."""

PERCENTILES = (5.0, 50.0, 95.0, 99.0)

_MAX_PERMUTED_VALUES = 8
"""Largest number of samples for which all permutations are counted."""


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
