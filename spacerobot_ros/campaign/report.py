"""Reports on one campaign, or comparing two with the same draws: self-contained HTML files."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from html import escape
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.dataset import DRAW_PREFIX, ERROR, Dataset
from spacerobot_ros.campaign.metrics import metric_of
from spacerobot_ros.campaign.results import (
    PASSING,
    PERCENTILES,
    Influence,
    PairedDifference,
    Results,
    Share,
    paired_difference,
    paired_success,
    percentiles,
    share,
    success_by_bins,
)
from spacerobot_ros.errors import ParameterError, counted
from spacerobot_ros.files import write_output
from spacerobot_ros.measures import Outcome
from spacerobot_ros.report.figures import (
    LINE_COLOUR,
    PALETTE,
    TEXT_COLOUR,
    PictureFormat,
    drawing,
    picture_of,
)
from spacerobot_ros.report.page_parts import facts, figure, html_page, missing, table, tiles
from spacerobot_ros.resources import __version__
from spacerobot_ros.scenario import different_parameters

_FOOTER = f"Made by spacerobot_ros {__version__}."

_MAX_HISTOGRAMS, _MAX_SCATTER_PLOTS = 9, 6
"""Largest number of metric histograms and of scatter plots."""

_NO_INFLUENCES = "no correlation is significant (p < 0.05, corrected for multiple tests)."

_QUANTILES_SHOWN = (0.01, 0.5, 0.99)
_MAX_CURVE_STEPS = 2000
_PART_OF_METRIC = {"position_error_m": "position", "attitude_error_rad": "attitude"}
"""Base goal component, by the metric for its error."""


def write_campaign_report(folder: Path, path: Path) -> list[str]:
    """Write a dataset's report; return the terminal output lines.

    Raises
    ------
    ParameterError
        The folder contains no campaign, or no flights yet.
    SpaceRobotError
        The file cannot be written.
    """
    results = Results.of(folder)
    title, found = f"Campaign {results.campaign.name}", results.influences()
    write_output(path, html_page(title, _page_body(results, found), _FOOTER))
    lines = [f"success     {share(results.passed)}"]
    lines += [f"{name:<11} {each}" for name, each in results.sampler_shares.items()]
    notes = [results.incompleteness_warning, *results.warnings_on_criteria]
    lines += [f"note        {note}" for note in notes if note]
    lines += [f"required    {c}: {results.share_meeting(c)}" for c in results.campaign.criteria]
    lines += [
        f"{outcome:<11} {count} of {len(results)}: {message}"
        for outcome, count, message in results.shown_messages
        if message and outcome in (ERROR, Outcome.REFUSED, Outcome.ABORTED, Outcome.INTERRUPTED)
    ]
    drivers = [each for each in found if each.is_significant]
    lines += [f"driver      {each}" for each in _sort_passing_first(drivers)[:3]]
    if found and not drivers:
        lines.append(f"driver      none: {_NO_INFLUENCES}")
    return lines


def _sort_passing_first(found: Sequence[Influence]) -> list[Influence]:
    return sorted(found, key=lambda each: each.metric != PASSING)


def _picture_part(drawn: Figure, name: str, caption: str) -> str:
    """Return a figure for the page."""
    return figure(name, picture_of(drawn, PictureFormat.SVG), caption, escape(caption))


def _figure_with_axes(count: int, across: int, height: float = 2.2) -> tuple[Figure, list[Any]]:
    """Return a figure and its axes, with ``across`` axes per row."""
    rows = -(-count // across)
    figure = Figure(figsize=(9.6, height * rows + 0.2), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = list(np.ravel(figure.subplots(rows, across, squeeze=False)))
    for unused in axes[count:]:
        unused.set_visible(False)
    return figure, axes[:count]


def metric_label(metric: str, not_controlled: Sequence[str] = ()) -> str:
    """Return the name of a metric, with its unit unless the name includes the unit; errors of
    uncontrolled goal components are marked.
    """
    unit = metric_of(metric).unit
    named = metric.endswith(("_m", "_rad", "_s", "_kg", "_N", "_Nm", "_Ns", "_Nms"))
    label = f"{metric}, {unit}" if unit and not named else metric
    free = _PART_OF_METRIC.get(metric) in not_controlled
    return f"{label} (not controlled)" if free else label


# -- parts of the page ------------------------------------------------------------------------


def _page_body(results: Results, found: Sequence[Influence]) -> list[str]:
    campaign = results.campaign
    with drawing():
        return [
            f"<header><h1>{escape(campaign.name)}</h1>",
            f"<p>{escape(campaign.description)}</p>" if campaign.description else "",
            _facts_section(results),
            _success_section(results),
            "</header>",
            "<h2>Requirements</h2>",
            _criteria_section(results),
            "<h2>Outcomes</h2>",
            _outcomes_section(results),
            "<h2>Distributions</h2>",
            _percentiles_section(results),
            _histograms_section(results),
            "<h2>Drivers of the result</h2>",
            _sensitivity_section(found),
            _scatter_section(results, found),
            _success_by_bins_section(results, found),
            "<h2>The worst flights</h2>",
            _worst_flights_section(results),
            *_convergence_section(results),
            "<h2>Dispersions</h2>",
            _dispersions_section(campaign),
        ]


def _facts_section(results: Results) -> str:
    campaign = results.campaign
    engines = Counter(results.columns["engine"])
    found = [
        f"scenario {campaign.scenario.name}",
        f"{len(results)} of {results.planned_flights} flights",
        f"sampler {campaign.sampler}, seed {campaign.seed}",
        "engine " + ", ".join(f"{name} ({count})" for name, count in engines.items()),
    ]
    found += [f"not controlled: {part}" for part in results.not_controlled]
    return facts(found) + missing(results.incompleteness_warning)


def _success_section(results: Results) -> str:
    wall = float(np.nansum(results.columns["wall_time_s"]))
    rows = []
    for name, found in {"success": share(results.passed), **results.sampler_shares}.items():
        low, high = found.exact_interval
        rows += [
            (name, f"{100 * found.value:.4g} %", f"{found.count} of {found.total}"),
            ("95 % interval (Wilson)", _share_cells(found)[1], ""),
            ("95 % interval (Clopper-Pearson)", f"{100 * low:.4g} to {100 * high:.4g} %", ""),
        ]
    return tiles([*rows, ("flown", f"{wall:.4g} s", "of workers' time")])


def _criteria_section(results: Results) -> str:
    reached = share(results.columns["outcome"] == "reached")
    rows = [["the goal is reached", *_share_cells(reached), "", ""]]
    for criterion in results.campaign.criteria:
        values = percentiles(results.columns[criterion.metric])
        middle, high = values[PERCENTILES.index(50.0)], values[PERCENTILES.index(95.0)]
        met = results.share_meeting(criterion)
        rows.append([str(criterion), *_share_cells(met), f"{middle:.4g}", f"{high:.4g}"])
    rows.append(["all together", *_share_cells(share(results.passed)), "", ""])
    head = ["requirement", "met by", "95 % interval", "median", "95 percentile"]
    return table("requirements", head, rows) + "".join(map(missing, results.warnings_on_criteria))


def _share_cells(met: Share) -> list[str]:
    return [
        f"{100 * met.value:.4g} % ({met.count} of {met.total})",
        f"{100 * met.interval_low:.4g} to {100 * met.interval_high:.4g} %",
    ]


def _outcomes_section(results: Results) -> str:
    rows = [[outcome, f"{count}", reason] for outcome, count, reason in results.shown_messages]
    made = table("outcomes", ["outcome", "flights", "message"], rows)
    fallbacks = Counter(text for text in results.columns.get("fallback", ()) if text)
    for reason, count in fallbacks.most_common(6):
        # A reason is a clause or an error message.
        used = f"used engine 'flights': {reason}"
        what = used if reason.endswith(".") else f"{reason} and used engine 'flights'"
        line = f"{counted(count, 'flight')} {what}"
        made += f'<p class="facts">{escape(line)}</p>'
    return made


def _percentiles_section(results: Results) -> str:
    if not results.distributed_metrics:
        return missing("No metric is available for any flight.")
    rows, free = [], results.not_controlled
    for name in results.distributed_metrics:
        values = results.columns[name]
        there = values[np.isfinite(values)]
        # As an estimate from a sample: the campaign's flights are drawn from all possible ones.
        spread = there.std(ddof=min(1, len(there) - 1))
        numbers = [there.min(), *percentiles(values), there.max(), there.mean(), spread]
        rows.append([metric_label(name, free), *(f"{x:.4g}" for x in numbers)])
    head = ["metric", "minimum", *(f"{p:g} %" for p in PERCENTILES), "maximum", "mean", "std"]
    return table("percentiles", head, rows)


def _histograms_section(results: Results) -> str:
    names = results.distributed_metrics[:_MAX_HISTOGRAMS]
    if not names:
        return ""
    figure, axes = _figure_with_axes(len(names), 2)
    bounds = {criterion.metric: criterion for criterion in results.campaign.criteria}
    for panel, name in zip(axes, names, strict=True):
        values = results.columns[name]
        there = values[np.isfinite(values)]
        bins = min(60, max(8, int(np.sqrt(len(there)))))
        panel.hist(there, bins=bins, color=PALETTE[0], alpha=0.75)
        for level in np.percentile(there, (5, 50, 95)):
            panel.axvline(level, color=TEXT_COLOUR, linewidth=0.8, linestyle=":")
        if name in bounds:
            for bound in (bounds[name].minimum, bounds[name].maximum):
                if np.isfinite(bound) and abs(bound) < 10 * (np.abs(there).max() + 1e-12):
                    panel.axvline(bound, color=PALETTE[1], linewidth=1.5)
        panel.locator_params(axis="x", nbins=6)
        panel.set_xlabel(metric_label(name))
        panel.set_ylabel("flights")
        shares = panel.twinx()
        # A curve through more points looks the same.
        few = np.unique(np.linspace(0, len(there) - 1, _MAX_CURVE_STEPS).astype(int))
        shares.step(np.sort(there)[few], (few + 1) / len(there), color=TEXT_COLOUR, where="post")
        shares.set_ylim(0.0, 1.02)
        shares.set_ylabel("cumulative share")
    caption = (
        "Distributions of the metrics. Dotted lines: percentiles 5, 50 and 95; orange: "
        "requirements; black: cumulative share of flights."
    )
    return _picture_part(figure, "distributions", caption)


def _sensitivity_section(found: Sequence[Influence]) -> str:
    if not found:
        return missing("No drawn value is correlated with a metric.")
    sobol = any(each.total_order_index is not None for each in found)
    rows = []
    for each in _sort_passing_first(found)[:15]:
        cells = [each.cause, each.metric, f"{each.correlation:+.3f}", f"{each.p_value:.2g}"]
        cells += [f"{each.distance_correlation:+.3f}", f"{each.distance_p_value:.2g}"]
        if sobol:
            for index in (each.first_order_index, each.total_order_index):
                cells.append("" if index is None else f"{index[0]:.3f} ± {index[1]:.3f}")
        rows.append(cells)
    head = ["drawn", "metric", "rank correlation", "p", "of its distance from the median", "p"]
    head += ["Sobol, first order", "Sobol, total"] if sobol else []
    note = "Spearman's rank correlations: first those with passing, then the others in order of "
    note += "strength; p: p-value corrected for multiple tests (Benjamini-Hochberg). A metric that "
    note += "increases on both sides of the median correlates with the distance between the draw "
    note += "and the median."
    if not sobol:
        note += " Sampler 'saltelli' adds Sobol indices."
    if not any(each.is_significant for each in found):
        note += f" Here {_NO_INFLUENCES}"
    return f'<p class="facts">{escape(note)}</p>' + table("drivers", head, rows)


def _scatter_section(results: Results, found: Sequence[Influence]) -> str:
    chosen = [each for each in found if each.metric != PASSING][:_MAX_SCATTER_PLOTS]
    if not chosen:
        return ""
    figure, axes = _figure_with_axes(len(chosen), 3, 2.4)
    passed = results.passed
    # At most 2000 points, drawn at random, are plotted.
    few = np.random.default_rng(0).permutation(len(results))[:2000]
    for panel, each in zip(axes, chosen, strict=True):
        x, y = results.drawn_numbers[each.cause][few], results.columns[each.metric][few]
        for ok, colour in ((True, PALETTE[0]), (False, PALETTE[1])):
            of = passed[few] == ok
            panel.plot(x[of], y[of], ".", ms=3, alpha=0.5, color=colour, rasterized=True)
        panel.set_xlabel(each.cause)
        panel.set_ylabel(metric_label(each.metric))
        panel.locator_params(axis="x", nbins=4)
    caption = "The strongest correlations. Flights that did not pass are orange."
    return _picture_part(figure, "scatter", caption)


def _success_by_bins_section(results: Results, found: Sequence[Influence]) -> str:
    drawn = results.drawn_by_influence(found)[:_MAX_SCATTER_PLOTS]
    if not drawn or results.passed.all() or not results.passed.any():
        return ""
    figure, axes = _figure_with_axes(len(drawn), 3, 2.4)
    for panel, name in zip(axes, drawn, strict=True):
        bins = success_by_bins(results.columns[f"{DRAW_PREFIX}{name}"], results.passed)
        passed = [each.passed for each in bins]
        shares, low, high = np.array(
            [(each.value, each.interval_low, each.interval_high) for each in passed]
        ).T
        at: Any = [each.low for each in bins]
        half = None
        if not isinstance(at[0], str):
            half = np.array([(each.high - each.low) / 2.0 for each in bins])
            at = np.array(at, dtype=float) + half
            panel.locator_params(axis="x", nbins=4)
        panel.errorbar(at, shares, [shares - low, high - shares], half, ".", color=PALETTE[0])
        panel.set_ylim(-0.03, 1.03)
        panel.margins(x=0.08)
        panel.set_xlabel(name)
        panel.set_ylabel("success")
        panel.tick_params(axis="x", labelsize=7)
    caption = (
        "Success rate over the drawn values, in bins with approximately equal numbers of flights; "
        "95 % intervals."
    )
    return _picture_part(figure, "success", caption)


def _worst_flights_section(results: Results) -> str:
    names = results.shown_metrics
    rows = []
    for row in results.worst_rows():
        number = int(results.flight_numbers[row])
        values = [f"{results.columns[name][row]:.4g}" for name in names]
        command = f"spacerobot campaign rerun {shlex.quote(str(results.folder))} {number}"
        rows.append([str(number), command, results.columns["outcome"][row], *values])
    head = ["flight", "command to repeat it and record a bag", "outcome", *map(metric_label, names)]
    return table("worst", head, rows)


def _convergence_section(results: Results) -> list[str]:
    """Return a heading and a figure; nothing if the figure would have only one point."""
    count = len(results)
    at = np.unique(np.geomspace(min(10, count), count, 60).astype(int))
    if len(at) < 2:
        return []
    shares = [share(results.passed[:k]) for k in at]
    figure, axes = _figure_with_axes(2, 2, 2.4)
    low, high = [s.interval_low for s in shares], [s.interval_high for s in shares]
    axes[0].fill_between(at, low, high, color=LINE_COLOUR, alpha=0.6)
    axes[0].plot(at, [s.value for s in shares], color=PALETTE[0])
    axes[0].set_ylabel("success, with 95 % interval")
    for i, name in enumerate(results.distributed_metrics[:3]):
        values, place = results.columns[name], PERCENTILES.index(95.0)
        line = np.array([percentiles(values[:k])[place] for k in at])
        axes[1].plot(at, line / (line[-1] or 1.0), color=PALETTE[i], label=name)
    axes[1].set_ylabel("95th percentile / final value")
    if results.distributed_metrics:
        axes[1].legend(fontsize=7, frameon=False)
    for panel in axes:
        panel.set_xlabel("flights")
        panel.set_xscale("log")
        panel.set_xlim(0.9 * at[0], 1.1 * at[-1])
        panel.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        panel.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        panel.xaxis.set_minor_formatter(NullFormatter())
    caption = "Convergence of the results with the number of flights."
    return ["<h2>Convergence</h2>", _picture_part(figure, "convergence", caption)]


def _dispersions_section(campaign: Campaign) -> str:
    rows = []
    for each in campaign.dispersions:
        numbers = [""] * len(_QUANTILES_SHOWN)
        if not each.distribution.choices:
            values = each.distribution.quantiles(np.array(_QUANTILES_SHOWN))
            numbers = [f"{value:.4g}" for value in values]
        rows.append([each.name, str(each), each.target.unit or "", *numbers])
    if not rows:
        return missing("There are no dispersions: the flights differ only in noise.")
    shares = [f"{100 * share:g} %" for share in _QUANTILES_SHOWN]
    return table("dispersed", ["parameter", "distribution", "unit", *shares], rows)


# -- two campaigns ----------------------------------------------------------------------------


def require_same_draws(first: Campaign, second: Campaign) -> None:
    """Check that two campaigns have the same draws.

    Raises
    ------
    ParameterError
        The seeds, samplers, numbers of flights or dispersions differ.
    """
    sentence = f"The campaigns '{first.name}' and '{second.name}' do not have the same draws: "
    for key in ("seed", "sampler", "flights"):
        ours, theirs = getattr(first, key), getattr(second, key)
        if ours != theirs:
            raise ParameterError(f"{sentence}'{key}' is {ours} and {theirs}.")
    # The order matters, because numbers are assigned to dispersions in order.
    for pair in zip_longest(first.dispersions, second.dispersions):
        a, b = ("nothing" if each is None else f"{each.name}: {each}" for each in pair)
        ours, theirs = (each and (each.name, each.distribution, each.weights) for each in pair)
        if ours != theirs:
            raise ParameterError(f"{sentence}'disperse' has {a} and {b} in the same position.")


def write_comparison(folders: tuple[Path, Path], path: Path) -> list[str]:
    """Write a comparison report of two datasets with the same draws; return the terminal output
    lines.

    Raises
    ------
    ParameterError
        A folder contains no flights, or the draws differ.
    SpaceRobotError
        The file cannot be written.
    """
    # Metrics required by only one campaign are also compared if both have them.
    required = [name for each in folders for name in Dataset(each).campaign().named_metrics]
    first, second = (Results.of(folder, required) for folder in folders)
    require_same_draws(first.campaign, second.campaign)
    common = np.intersect1d(first.flight_numbers, second.flight_numbers)
    rows_a = np.searchsorted(first.flight_numbers, common)
    rows_b = np.searchsorted(second.flight_numbers, common)
    if not common.size:
        raise ParameterError(
            f"'{first.campaign.name}' and '{second.campaign.name}' have no flown draws in common: "
            "fly more flights of one of them."
        )
    names = list(dict.fromkeys([*first.shown_metrics, *second.shown_metrics]))
    names = [name for name in names if name in first.columns and name in second.columns]
    # A flight whose goal was refused has not moved: its numbers are those of the start.
    flew = ~(first.refused[rows_a] | second.refused[rows_b])
    flown_a, flown_b = rows_a[flew], rows_b[flew]
    pairs = (
        paired_difference(name, first.columns[name][flown_a], second.columns[name][flown_b])
        for name in names
    )
    found = [difference for difference in pairs if difference is not None]
    compared = [each.metric for each in found]
    passed_a, passed_b = first.passed[rows_a], second.passed[rows_b]
    only_a, only_b, p = paired_success(passed_a, passed_b)
    a, b = first.campaign.name, second.campaign.name
    sentence = (
        f"{a} passes {int(passed_a.sum())} and {b} {int(passed_b.sum())} of {len(common)} draws; "
        f"{only_a} only {a}, {only_b} only {b} (McNemar's exact test: p = {p:.2g})."
    )
    notes = _notes(first, second)
    rows = different_parameters([first.campaign.scenario, second.campaign.scenario])
    with drawing():
        body = [
            f"<header><h1>{escape(a)} and {escape(b)}</h1>",
            facts([f"{len(common)} common draws"]),
            f'<p class="outcome">{escape(sentence)}</p></header>',
            *map(missing, notes),
            "<h2>Parameters that differ</h2>",
            table("parameters", ["parameter", a, b], rows) if rows else missing("None differ."),
            "<h2>Paired differences</h2>",
            _difference_table(found, first, second),
            _difference_figure(first, second, flown_a, flown_b, compared[:6]),
        ]
    write_output(path, html_page(f"{a} and {b}", body, _FOOTER))
    lines = [
        f"{metric_label(each.metric)}: {a} {each.first:.4g}, {b} {each.second:.4g}; {b} minus {a} "
        f"is {each.difference:.4g} (95 % interval {each.interval_low:.4g} to "
        f"{each.interval_high:.4g})"
        for each in found
    ]
    return [sentence, *lines, *notes]


def _notes(first: Results, second: Results) -> list[str]:
    notes = []
    for each in (first, second):
        missed = [found for found in each.messages if found[0] != "reached"]
        for outcome, count, message in sorted(missed, key=lambda found: -found[1])[:1]:
            share = f"{count} of {len(each)} flights"
            notes.append(f"Of {each.campaign.name}, {share} have the outcome {outcome}: {message}")
    if first.refused.any() or second.refused.any():
        notes.append("Differences exclude draws whose goal was refused in one of the campaigns.")
    return notes + [
        f"{each.campaign.name} does not control the {' and '.join(parts)}: this error is ignored "
        "unless it is named in a criterion."
        for each in (first, second)
        if (parts := each.not_controlled)
    ]


def _difference_table(found: list[PairedDifference], first: Results, second: Results) -> str:
    free = [part for part in first.not_controlled if part in second.not_controlled]
    rows = []
    for each in found:
        cells = [metric_label(each.metric, free), str(each.count)]
        cells += [f"{each.first:.5g}", f"{each.second:.5g}", f"{each.difference:+.4g}"]
        cells.append(f"{each.interval_low:+.4g} to {each.interval_high:+.4g}")
        rows.append([*cells, "yes" if each.is_significant else "no"])
    names = [f"mean of {each.campaign.name}" for each in (first, second)]
    head = ["metric", "pairs", *names, "difference"]
    return table("paired", [*head, "95 % interval", "interval excludes 0"], rows)


def _difference_figure(
    first: Results, second: Results, rows_a: np.ndarray, rows_b: np.ndarray, names: list[str]
) -> str:
    if not names:
        return ""
    figure, axes = _figure_with_axes(len(names), 3, 2.6)
    for panel, name in zip(axes, names, strict=True):
        x, y = first.columns[name][rows_a], second.columns[name][rows_b]
        panel.plot(x, y, ".", ms=3, alpha=0.5, color=PALETTE[0], rasterized=True)
        both = np.concatenate([x[np.isfinite(x)], y[np.isfinite(y)]])
        if both.size:
            ends = [both.min(), both.max()]
            panel.plot(ends, ends, color=TEXT_COLOUR, linewidth=0.8, linestyle=":")
        panel.locator_params(nbins=5)
        panel.set_xlabel(f"{first.campaign.name}: {name}")
        panel.set_ylabel(second.campaign.name)
    return _picture_part(figure, "pairs", "Each draw in both campaigns; dotted: no difference.")
