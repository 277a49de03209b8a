"""Comparison of two campaigns with the same draws: paired differences with confidence intervals."""

from __future__ import annotations

from html import escape
from itertools import zip_longest
from pathlib import Path

import numpy as np

from spacerobot_ros.campaign.config import Campaign
from spacerobot_ros.campaign.report import (
    FOOTER_TEXT,
    figure_with_axes,
    metric_label,
    picture_part,
)
from spacerobot_ros.campaign.results import Results, messages_of
from spacerobot_ros.campaign.statistics import PairedDifference, paired_difference, paired_success
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.files import write_output
from spacerobot_ros.report.figures import PALETTE, TEXT_COLOUR, drawing
from spacerobot_ros.report.page_parts import facts, html_page, table
from spacerobot_ros.scenario import different_parameters


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
    # The order counts, because numbers are assigned to dispersions in order.
    for ours_is, theirs_is in zip_longest(first.dispersions, second.dispersions):
        a, b = (
            "nothing" if each is None else f"{each.name}: {each}" for each in (ours_is, theirs_is)
        )
        same = a == b and all(
            getattr(ours_is, key) == getattr(theirs_is, key) for key in ("distribution", "weights")
        )
        if not same:
            raise ParameterError(f"{sentence}'disperse' has {a} and {b} at the same place.")


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
    first, second = (Results.of(folder) for folder in folders)
    require_same_draws(first.campaign, second.campaign)
    common = np.intersect1d(first.flight_numbers, second.flight_numbers)
    rows_a = np.searchsorted(first.flight_numbers, common)
    rows_b = np.searchsorted(second.flight_numbers, common)
    if not common.size:
        raise ParameterError(
            f"'{first.campaign.name}' and '{second.campaign.name}' share no flown draws: fly more "
            "flights of one of them."
        )
    # Metrics required by one campaign only are compared too, if both have them.
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
    notes = [*_notes_on_failures(first, second), *_notes_on_control(first, second)]
    with drawing():
        body = [
            f"<header><h1>{escape(a)} and {escape(b)}</h1>",
            facts([f"{len(common)} common draws"]),
            f'<p class="outcome">{escape(sentence)}</p></header>',
            *(f'<p class="missing">{escape(note)}</p>' for note in notes),
            *_parameters_part(first.campaign, second.campaign),
            "<h2>Paired differences</h2>",
            _difference_table(found, first, second),
            _difference_figure(first, second, flown_a, flown_b, compared[:6]),
        ]
    write_output(path, html_page(f"{a} and {b}", body, FOOTER_TEXT))
    return [sentence, *(_difference_line(each, b, a) for each in found), *notes]


def _parameters_part(first: Campaign, second: Campaign) -> list[str]:
    rows = [list(row) for row in different_parameters([first.scenario, second.scenario])]
    if not rows:
        return ["<h2>Parameters that differ</h2>", '<p class="missing">None differ.</p>']
    head = ["parameter", first.name, second.name]
    return ["<h2>Parameters that differ</h2>", table("parameters", head, rows)]


def _difference_line(each: PairedDifference, second: str, first: str) -> str:
    return (
        f"{metric_label(each.metric)}: {first} {each.first:.4g}, {second} {each.second:.4g}; "
        f"{second} minus {first} is {each.difference:.4g} "
        f"(95 % interval {each.interval_low:.4g} to {each.interval_high:.4g})"
    )


def _notes_on_failures(first: Results, second: Results) -> list[str]:
    notes = []
    for each in (first, second):
        missed = [found for found in messages_of(each) if found[0] != "reached"]
        for outcome, count, message in sorted(missed, key=lambda found: -found[1])[:1]:
            share = f"{count} of {len(each)} flights"
            notes.append(f"Of {each.campaign.name}, {share} have the outcome {outcome}: {message}")
    if first.refused.any() or second.refused.any():
        notes.append("Differences exclude draws whose goal was refused in one of the campaigns.")
    return notes


def _notes_on_control(first: Results, second: Results) -> list[str]:
    return [
        f"{each.campaign.name} does not control the {' and '.join(parts)}: the error is ignored "
        "unless a criterion names it."
        for each in (first, second)
        if (parts := each.not_controlled)
    ]


def _difference_table(found: list[PairedDifference], first: Results, second: Results) -> str:
    free = [part for part in first.not_controlled if part in second.not_controlled]
    rows = [
        [
            metric_label(each.metric, free),
            str(each.count),
            f"{each.first:.5g}",
            f"{each.second:.5g}",
            f"{each.difference:+.4g}",
            f"{each.interval_low:+.4g} to {each.interval_high:+.4g}",
            "yes" if each.is_significant else "no",
        ]
        for each in found
    ]
    names = [f"mean of {each.campaign.name}" for each in (first, second)]
    head = ["metric", "pairs", *names, "difference"]
    return table("paired", [*head, "95 % interval", "interval excludes 0"], rows)


def _difference_figure(
    first: Results, second: Results, rows_a: np.ndarray, rows_b: np.ndarray, names: list[str]
) -> str:
    if not names:
        return ""
    figure, axes = figure_with_axes(len(names), 3, 2.6)
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
    return picture_part(figure, "pairs", "Each draw in both campaigns; dotted: no difference.")
