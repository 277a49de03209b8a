"""Reports of campaigns: numbers, and pages that show them, in a browser."""

from __future__ import annotations

import math
import re
from base64 import b64decode
from collections.abc import Callable
from dataclasses import replace
from html import unescape
from itertools import pairwise
from pathlib import Path
from statistics import stdev
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as arrow
import pyarrow.parquet as parquet
import pytest
from scipy import stats
from support.campaigns import campaign, written
from support.chromium import browser, chromium

from spacerobot_ros.campaign.config import Campaign, passes_criteria
from spacerobot_ros.campaign.dataset import Dataset, Row
from spacerobot_ros.campaign.draws import Draw, Draws
from spacerobot_ros.campaign.report import (
    require_same_draws,
    write_campaign_report,
    write_comparison,
)
from spacerobot_ros.campaign.results import PASSING, Results, success_by_bins
from spacerobot_ros.campaign.running import run_campaign
from spacerobot_ros.errors import ParameterError

NAMES = ("com.base_link.x", "com.base_link.y", "com.base_link.z")

TURNS: dict[str, Any] = {
    name: {"uniform": {"loc": -math.pi, "scale": 2 * math.pi}} for name in NAMES
}


def ishigami(draw: Draw) -> float:
    """Ishigami and Homma's function, whose Sobol indices are known (a = 7, b = 0.1)."""
    x, y, z = (draw.values[name] for name in NAMES)
    return math.sin(x) + 7.0 * math.sin(y) ** 2 + 0.1 * z**4 * math.sin(x)


def filled(
    folder: Path,
    made: Campaign,
    error: Callable[[Draw], float],
    flown: Callable[[int], bool] = lambda number: True,
    refuses: Callable[[int], bool] = lambda number: False,
    **others: float,
) -> Path:
    """Write a dataset whose flights have such position errors, and nothing else."""
    rows = []
    for draw in (each for each in Draws(made) if flown(each.number)):
        metrics = {"position_error_m": error(draw), "manoeuvre_time_s": 4.0, **others}
        outcome = "reached" if metrics["position_error_m"] < 0.05 else "failed"
        reason = f"{outcome}."
        if refuses(draw.number):
            outcome, reason = "refused", "Too far."
        ok = passes_criteria(made.criteria, outcome, metrics)
        left = "needed corrections" if draw.number % 50 == 0 else ""
        draw = replace(draw, fallback=left)
        rows.append(Row(draw, outcome, reason, metrics, ok, "lanes", 0.01, 0.0))
    written(folder, made, rows)
    return folder


def test_a_report_of_flights_that_ended_early_says_that_late_ones_are_missing(
    tmp_path: Path,
) -> None:
    made = campaign(disperse=TURNS, flights=60, seed=3)
    first, quick = (
        filled(tmp_path / name, made, ishigami, flown=flown)
        for name, flown in (("first", lambda n: n < 40), ("quick", lambda n: n < 40 and n % 4))
    )
    assert not Results.of(first).incompleteness_warning
    page = tmp_path / "page.html"
    lines = write_campaign_report(quick, page)
    sentence = "10 draws are not flown yet although later draws have been"
    assert sentence in "\n".join(lines)
    assert sentence in unescape(page.read_text("utf-8"))


@pytest.mark.parametrize("driven", [True, False])
def test_only_correlations_beyond_chance_are_called_drivers(driven: bool, tmp_path: Path) -> None:
    noise = np.random.default_rng(11).uniform(0.0, 0.04, 60)

    def error(draw: Draw) -> float:
        return 0.01 * draw.values["mass.mass_1"] if driven else float(noise[draw.number])

    made = campaign(disperse=MASSES, flights=60, seed=2)
    page = tmp_path / "page.html"
    lines = write_campaign_report(filled(tmp_path / "made", made, error), page)
    told = [line for line in lines if line.startswith("driver")]
    sentence = "no correlation is significant (p < 0.05, corrected for multiple tests)."
    assert (sentence in unescape(page.read_text("utf-8"))) is not driven
    if driven:
        assert told == ["driver      mass.mass_1 of position_error_m: +1.00"]
    else:
        assert told == [f"driver      none: {sentence}"]


def test_shares_of_captures_have_their_intervals(tmp_path: Path) -> None:
    """Of 40 flights 40 approach, 30 capture and none places."""
    made = campaign(flights=40, criteria={"captured": {"min": 1}})
    folder, rows = tmp_path / "dataset", []
    for draw in Draws(made):
        captured = float(draw.number >= 10)
        metrics = {"end_effector_position_error_m": 0.01, "captured": captured, "placed": 0.0}
        metrics |= {"capture_impulse_Ns": 0.1 * draw.number if captured else math.nan}
        ok = passes_criteria(made.criteria, "reached", metrics)
        rows.append(Row(draw, "reached", "Reached.", metrics, ok, "flights"))
    written(folder, made, rows)
    results = Results.of(folder)
    assert list(results.sampler_shares) == ["captured", "placed"]
    found = results.sampler_shares["captured"]
    assert (found.count, found.total) == (30, 40)
    exact = stats.binomtest(30, 40).proportion_ci(0.95, "exact")
    assert found.exact_interval == pytest.approx((exact.low, exact.high))
    assert results.sampler_shares["placed"].count == 0
    assert results.distributed_metrics == ["end_effector_position_error_m", "capture_impulse_Ns"]
    assert results.shown_metrics[0] == "captured"
    lines = write_campaign_report(folder, tmp_path / "report.html")
    assert lines[1].startswith("captured    75 % (30 of 40; 95 % interval ")
    assert lines[2].startswith("placed      0 % (0 of 40; ")
    page = (tmp_path / "report.html").read_text("utf-8")
    low, high = (f"{100 * x:.4g}" for x in found.exact_interval)
    assert "<dt>captured</dt><dd>75 %<small>30 of 40</small></dd>" in page
    assert f"<dd>{low} to {high} %</dd>" in page
    assert f">{0.1 * stdev(range(10, 40)):.4g}</td>" in page


def test_sobol_indices_are_those_of_a_function_that_is_known(tmp_path: Path) -> None:
    made = campaign(disperse=TURNS, sampler="saltelli", flights=512 * 5, seed=3)
    results = Results.of(filled(tmp_path, made, ishigami))
    drivers = [each for each in results.influences() if each.metric != PASSING]
    found = {each.cause: each for each in drivers}
    first, total = (0.3139, 0.4424, 0.0), (0.5576, 0.4424, 0.2437)
    for name, one, all_together in zip(NAMES, first, total, strict=True):
        indices = found[name].first_order_index, found[name].total_order_index
        assert indices[0] is not None
        assert indices[1] is not None
        assert indices[0][0] == pytest.approx(one, abs=0.08)
        assert indices[1][0] == pytest.approx(all_together, abs=0.08)
        assert 0.0 < indices[1][1] < 0.15
    assert [each.cause for each in drivers] == list(NAMES)
    # An incomplete sample has none.
    few = campaign(disperse=TURNS, sampler="random", flights=40, seed=3)
    others = Results.of(filled(tmp_path / "few", few, ishigami)).influences()
    assert all(each.total_order_index is None for each in others)


def bowl(draw: Draw) -> float:
    """An error that grows to both sides of one mass, and a little with another."""
    mass, other = draw.values["mass.mass_1"], draw.values["mass.mass_2"]
    return float(0.01 + 0.4 * abs(mass - 1.0) + 0.02 * (other - 1.0))


MASSES: dict[str, Any] = {
    f"mass.mass_{i}": {"uniform": {"loc": 0.9, "scale": 0.2}} for i in (1, 2, 3)
}
CRITERIA = {"position_error_m": {"max": 0.03}}


def test_what_grows_to_both_sides_is_found(tmp_path: Path) -> None:
    made = campaign(disperse=MASSES, flights=200, seed=8, criteria=CRITERIA)
    results = Results.of(filled(tmp_path, made, bowl))
    strongest = results.influences()[0]
    (passing,) = (
        each
        for each in results.influences()
        if (each.metric, each.cause) == (PASSING, "mass.mass_1")
    )
    # The farther the mass is off, the fewer pass.
    assert passing.distance_correlation < -0.6
    assert (strongest.cause, strongest.metric) == ("mass.mass_1", "position_error_m")
    assert abs(strongest.correlation) < 0.3
    assert strongest.distance_correlation > 0.9
    assert "distance from the median" in str(strongest)
    worst = results.worst_rows()
    errors = results.columns["position_error_m"]
    assert [errors[row] for row in worst] == sorted(errors, reverse=True)[:10]


def test_success_is_counted_over_bins_of_what_was_drawn(tmp_path: Path) -> None:
    """As pandas bins and counts, with the interval by Wilson's formula."""
    disperse = {**MASSES, "planner.method": {"choice": ["optimal", "auto"]}}
    made = campaign(disperse=disperse, flights=97, seed=8, criteria=CRITERIA)

    def error(draw: Draw) -> float:
        return bowl(draw) * (0.5 if draw.values["planner.method"] == "auto" else 1.0)

    results = Results.of(filled(tmp_path, made, error))
    rows = pd.DataFrame(
        {"passed": results.passed, **{name: results.columns[f"draw.{name}"] for name in made.names}}
    )
    by_mass = rows.groupby(pd.qcut(rows["mass.mass_1"], 8), observed=True)
    by_method = rows.groupby("planner.method")
    for name, groups in (("mass.mass_1", by_mass), ("planner.method", by_method)):
        bins = success_by_bins(results.columns[f"draw.{name}"], results.passed)
        assert len(bins) == len(groups)
        for found, (_, group) in zip(bins, groups, strict=True):
            count, total = int(group["passed"].sum()), len(group)
            assert (found.passed.count, found.passed.total) == (count, total)
            assert (found.low, found.high) == (group[name].min(), group[name].max())
            interval = found.passed.interval_low, found.passed.interval_high
            wilson = stats.binomtest(count, total).proportion_ci(0.95, "wilson")
            assert interval == pytest.approx(tuple(wilson))
    # The text first, then the mass that drives the result.
    assert results.drawn_by_influence(results.influences())[:2] == ["planner.method", "mass.mass_1"]
    page = tmp_path / "page.html"
    write_campaign_report(tmp_path, page)
    assert "Success rate over the drawn values" in page.read_text("utf-8")


_LABEL = re.compile(r"<!-- (−?[0-9.]+) -->\n.*?translate\(([0-9.]+) ([0-9.]+)\) scale\(([0-9.]+) ")
_GLYPH_WIDTHS = {".": 0.318, "−": 0.838}
"""In DejaVu Sans, as fractions of the font size; those of digits are 0.636."""


def test_labels_of_small_draws_do_not_overlap(tmp_path: Path) -> None:
    spread = {f"initial.position.{axis}": {"norm": {"scale": 0.0025}} for axis in "xy"}
    made = campaign(disperse=spread, flights=40, seed=8, criteria=CRITERIA)
    page = tmp_path / "page.html"
    write_campaign_report(
        filled(tmp_path / "made", made, lambda draw: 0.03 + draw.values["initial.position.x"]), page
    )
    pictures = dict(re.findall(r'<figure id="(\w+)".*?base64,([^"]*)"', page.read_text("utf-8")))
    for name in ("scatter", "success"):
        rows: dict[float, list[tuple[float, float]]] = {}
        for text, x, y, size in _LABEL.findall(b64decode(pictures[name]).decode()):
            width = float(size) * 100 * sum(_GLYPH_WIDTHS.get(glyph, 0.636) for glyph in text)
            rows.setdefault(float(y), []).append((float(x), float(x) + width))
        ends = [(one[1], other[0]) for row in rows.values() for one, other in pairwise(sorted(row))]
        assert len(ends) > 3
        assert all(end + 2.0 < begin for end, begin in ends), name


def test_the_worst_flights_that_pass_are_those_next_to_their_bounds(tmp_path: Path) -> None:
    """Flights that did not pass are before them, and those that were not flown before all."""
    loose = {"position_error_m": {"max": 0.048}, "manoeuvre_time_s": {"min": 1.0}}
    made = campaign(disperse=MASSES, flights=40, seed=8, criteria=loose)
    results = Results.of(filled(tmp_path, made, lambda draw: 0.8 * bowl(draw)))
    assert results.passed.all()
    errors = results.columns["position_error_m"]
    assert [errors[row] for row in results.worst_rows()] == sorted(errors, reverse=True)[:10]
    mixed = campaign(disperse=MASSES, flights=43, seed=8, criteria=loose)
    draws, bad = Draws(mixed), {"position_error_m": 0.5, "manoeuvre_time_s": 4.0}
    late = Row(draws[42], "failed", ".", {**bad, "position_error_m": 0.06})
    written(
        tmp_path, mixed, [Row(draws[40], "error", "."), Row(draws[41], "reached", ".", bad), late]
    )
    assert Results.of(tmp_path).worst_rows()[:3] == [40, 42, 41]


def test_two_designs_are_compared_draw_by_draw(tmp_path: Path) -> None:
    """The second one is 2 mm better on the average, and much alike from draw to draw."""
    made = campaign(disperse=MASSES, flights=120, seed=8, criteria=CRITERIA)

    def better(draw: Draw) -> float:
        return bowl(draw) - 0.002 + 0.001 * math.sin(draw.number)

    one, two = filled(tmp_path / "one", made, bowl), filled(tmp_path / "two", made, better)
    page = tmp_path / "report.html"
    lines = write_comparison((one, two), page)
    draws = list(Draws(made))
    a, b = np.array([bowl(draw) for draw in draws]), np.array([better(draw) for draw in draws])
    interval = stats.ttest_rel(b, a).confidence_interval(0.95)
    (line,) = [line for line in lines if line.startswith("position_error_m")]
    numbers = [float(x) for x in re.findall(r"-?\d\.\d+(?:e-?\d+)?", line)]
    wanted = [a.mean(), b.mean(), (b - a).mean(), interval.low, interval.high]
    assert numbers == pytest.approx(wanted, rel=1e-3)
    only = int(((b <= 0.03) & (a > 0.03)).sum()), int(((a <= 0.03) & (b > 0.03)).sum())
    assert only[0] > 0
    assert f"{only[1]} only short, {only[0]} only short" in lines[0]
    p = stats.binomtest(only[1], sum(only)).pvalue
    assert f"p = {p:.2g}" in lines[0]
    # The other way round every difference has the other sign.
    again = write_comparison((two, one), tmp_path / "again.html")
    (line,) = [line for line in again if line.startswith("position_error_m")]
    assert f"{(a - b).mean():.4g}" in line
    # What one of them requires is compared, too.
    more = {**CRITERIA, "duration_s": {"max": 5.0}}
    three = filled(
        tmp_path / "three",
        campaign(disperse=MASSES, flights=120, seed=8, criteria=more),
        better,
        duration_s=4.5,
    )
    again = write_comparison((filled(tmp_path / "a", made, bowl, duration_s=4.0), three), page)
    assert (
        "duration_s: short 4, short 4.5; short minus short is 0.5 (95 % interval 0.5 to 0.5)"
    ) in again
    reordered = campaign(
        disperse=dict(reversed(MASSES.items())), flights=120, seed=8, criteria=CRITERIA
    )
    with pytest.raises(ParameterError, match=r"'disperse' has mass.mass_1: .* mass.mass_3"):
        write_comparison((one, filled(tmp_path / "b", reordered, bowl)), page)
    # Flights whose goal was refused have not moved: their numbers are no result.
    barred = filled(tmp_path / "barred", made, lambda draw: 0.0, refuses=lambda number: True)
    lines = write_comparison((one, barred), tmp_path / "barred.html")
    assert lines[-2:] == [
        "Of short, 120 of 120 flights have the outcome refused: Too far.",
        "Differences exclude draws whose goal was refused in one of the campaigns.",
    ]
    assert not any(line.startswith("position_error_m") for line in lines)
    half = filled(tmp_path / "half", made, better, refuses=lambda number: number < 60)
    lines = write_comparison((one, half), tmp_path / "half.html")
    (line,) = [line for line in lines if line.startswith("position_error_m")]
    assert f"minus short is {(b - a)[60:].mean():.4g} " in line
    other = campaign(disperse=MASSES, flights=120, seed=9, criteria=CRITERIA)
    four = filled(tmp_path / "four", other, bowl)
    with pytest.raises(ParameterError, match="do not have the same draws: 'seed' is 8 and 9"):
        write_comparison((one, four), tmp_path / "no.html")


def test_designs_of_another_covariance_or_table_have_other_draws() -> None:
    def of(covariance: float, mass: float) -> Campaign:
        normal = {"multivariate_normal": {"cov": [[1e-4, covariance], [covariance, 1e-4]]}}
        disperse = {"goal.position.x, goal.position.y": normal}
        return campaign(disperse=disperse, table=f"mass\n1.0\n{mass}\n")

    require_same_draws(of(5e-5, 1.1), of(5e-5, 1.1))
    for other in (of(6e-5, 1.1), of(5e-5, 1.2)):
        with pytest.raises(ParameterError, match="do not have the same draws"):
            require_same_draws(of(5e-5, 1.1), other)


def test_messages_are_counted_by_outcome_without_their_numbers(tmp_path: Path) -> None:
    made = campaign(disperse=MASSES, flights=9)
    reasons = [
        *[("reached", "At the goal after 3.5 s."), ("interrupted", "Interrupted after 9 s.")],
        *[("refused", "Too far by 2 m."), ("error", "No robot."), ("refused", "Too far by 3 m.")],
        *[("refused", "No way."), ("aborted", "Lost."), ("failed", "Off by 1 m."), ("error", "")],
    ]
    written(tmp_path, made, [Row(draw, *x) for draw, x in zip(Draws(made), reasons, strict=True)])
    lines = write_campaign_report(tmp_path, tmp_path / "report.html")
    assert [line for line in lines if " of 9: " in line] == [
        "refused     2 of 9: Too far by … m.",
        "refused     1 of 9: No way.",
        "error       1 of 9: No robot.",
        "interrupted 1 of 9: Interrupted after 9 s.",
        "aborted     1 of 9: Lost.",
    ]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("count", [1, 2, 7])
def test_flights_that_all_failed_have_a_report(tmp_path: Path, count: int) -> None:
    """And so has a single one, without a warning."""
    negative = {"mass": {"norm": {"loc": -1.0, "scale": 0.01}}}
    made = campaign(disperse=negative, flights=count, criteria=CRITERIA)
    written(tmp_path, made, [Row(draw, "error", "The mass is negative.") for draw in Draws(made)])
    lines = write_campaign_report(tmp_path, tmp_path / "report.html")
    assert lines[0].startswith(f"success     0 % (0 of {count};")
    assert lines.count(f"error       {count} of {count}: The mass is negative.") == 1
    text = (tmp_path / "report.html").read_text()
    assert "No metric is available for any flight." in text
    assert "The mass is negative." in text


def test_a_criterion_that_no_flight_can_meet_is_named(tmp_path: Path) -> None:
    """The flight has no end-effector goal; its base error has a value, though it is too large."""
    bounds = {name: {"max": 1e-3} for name in ("end_effector_position_error_m", "position_error_m")}
    made = campaign(disperse=MASSES, flights=3, criteria=bounds)
    page = tmp_path / "report.html"
    lines = write_campaign_report(filled(tmp_path / "made", made, lambda draw: 0.02), page)
    assert [line for line in lines if line.startswith("note")] == [
        "note        No flight has a value of 'end_effector_position_error_m', so no flight meets "
        "its criterion: remove the criterion, or choose a scenario in which this metric is "
        "measured."
    ]
    assert "No flight has a value of 'end_effector_position_error_m'" in unescape(page.read_text())


@pytest.mark.slow
@pytest.mark.skipif(chromium() is None, reason="no Chromium to look at the page with")
def test_the_pages_open_without_a_complaint_and_need_nothing_else(tmp_path: Path) -> None:
    made = campaign(disperse=MASSES, flights=120, seed=8, criteria=CRITERIA)
    one = filled(tmp_path / "one of two", made, bowl)
    two = filled(tmp_path / "two", made, lambda draw: bowl(draw) - 0.001)
    page, comparison = one / "report.html", tmp_path / "comparison.html"
    lines = write_campaign_report(one, page)
    write_comparison((one, two), comparison)
    share = sum(bowl(draw) <= 0.03 for draw in Draws(made))
    assert f"({share} of 120;" in lines[0]
    with browser(tmp_path / "profile") as window:
        for each, tables, figures in ((page, 6, 4), (comparison, 1, 1)):
            for width in (1280, 390):
                window.complaints.clear()
                window.requests.clear()
                window.open(each, width, 900)
                assert window.complaints == []
                outside = [url for url in window.requests if not url.startswith("data:")]
                assert outside == [each.as_uri()]
                assert window.evaluate("document.documentElement.scrollWidth") <= width
                assert window.evaluate("document.querySelectorAll('table').length") == tables
                drawn = "[...document.images].filter(x => x.complete && x.naturalWidth > 300)"
                assert window.evaluate(f"{drawn}.length") == figures
        window.open(page)
        words = unescape(window.evaluate("document.body.innerText"))
    assert f"{share} of 120" in words
    assert "3 flights needed corrections and used engine 'flights'" in words
    worst = max(Draws(made), key=bowl).number
    assert f"spacerobot campaign rerun '{one}' {worst}" in words


# -- the report of a million flights: its numbers, and the memory that it takes ------------------


DISPERSIONS = {
    "mass.*": {"norm": {"loc": 1.0, "scale": 0.03}},
    "plant.sensors.position_noise": {"uniform": [0.0, 0.001]},
}


def multiply(folder: Path, copies: int) -> None:
    """Write the rows of a dataset many times, with numbers and messages of their own, in an order
    that is not that of the numbers.
    """
    table = Dataset(folder).table()
    count = table.num_rows
    numbers, reasons = (table[name].to_pylist() for name in ("flight", "reason"))
    for part in (folder / "flights").glob("*.parquet"):
        part.unlink()
    for copy in range(copies):
        own = {
            "flight": [number + (copies - 1 - copy) * count for number in numbers],
            "reason": [f"{text} {copy}.{k}" for k, text in enumerate(reasons)],
        }
        made = table
        for name, values in own.items():
            place, kind = table.column_names.index(name), table.schema.field(name).type
            made = made.set_column(place, name, arrow.array(values, type=kind))
        parquet.write_table(made, folder / "flights" / f"part-{copy:06d}.parquet")


def test_columns_are_in_the_order_of_the_flights(tmp_path: Path) -> None:
    run_campaign(campaign(disperse=DISPERSIONS, flights=7, seed=3), tmp_path)
    multiply(tmp_path, 3)
    results, table = Results.of(tmp_path), Dataset(tmp_path).table()
    np.testing.assert_array_equal(results.flight_numbers, np.arange(21.0))
    for name in ("draw.mass.mass_2", "manoeuvre_time_s", "passed"):
        np.testing.assert_array_equal(results.columns[name], np.array(table[name], dtype=float))
    for name in ("outcome", "fallback"):
        assert results.columns[name].tolist() == table[name].to_pylist()
    assert {"no_column", "reason"}.isdisjoint(results.columns)
    assert sum(count for _, count, _ in results.messages) == 21
    assert all("…" in message for _, _, message in results.messages)
