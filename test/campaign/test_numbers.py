"""Statistics, reruns and files of campaigns, each against numbers by hand or from scipy."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy import stats
from support.campaigns import campaign, written

from spacerobot_ros.campaign import draws as sampling
from spacerobot_ros.campaign.config import Criterion, passes_criteria
from spacerobot_ros.campaign.dataset import Dataset, Row
from spacerobot_ros.campaign.draws import Draw, Draws, drawn_flight, sobol_problem
from spacerobot_ros.campaign.results import (
    Influence,
    PairedDifference,
    corrected_for_multiple_tests,
    influences,
    paired_difference,
    paired_success,
    percentiles,
    share,
    sobol_indices,
)
from spacerobot_ros.campaign.running import Progress, Rerun, largest_deviation, stored_flight
from spacerobot_ros.campaign.targets import DrawnFlight
from spacerobot_ros.errors import ParameterError, SpaceRobotError

MADE = campaign(flights=6, disperse={"mass.mass_1": {"uniform": [0.5, 1.5]}})

# -- statistics -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("count", "total"), [(3, 11), (11, 11), (0, 7), (40, 41)])
def test_shares_have_intervals(count: int, total: int) -> None:
    found = share(np.arange(total) < count)
    assert found.value == count / total
    expected = stats.binomtest(count, total)
    wilson, exact = (tuple(expected.proportion_ci(0.95, kind)) for kind in ("wilson", "exact"))
    assert (found.interval_low, found.interval_high) == pytest.approx(wilson, abs=1e-12)
    assert found.exact_interval == pytest.approx(exact, abs=1e-9)
    assert str(found) == (
        f"{100 * count / total:.4g} % ({count} of {total}; 95 % interval "
        f"{100 * found.interval_low:.4g} to {100 * found.interval_high:.4g} %)"
    )


def test_a_share_of_nothing_is_between_none_and_all() -> None:
    nothing = share(np.zeros(0, bool))
    assert (nothing.interval_low, nothing.interval_high, nothing.exact_interval) == (
        0.0,
        1.0,
        (0.0, 1.0),
    )
    assert math.isnan(nothing.value)


def test_percentiles_are_of_finite_values() -> None:
    values = np.array([math.nan, *range(101), math.inf])
    assert percentiles(values) == [5.0, 50.0, 95.0, 99.0]
    assert all(math.isnan(x) for x in percentiles(np.array([math.nan])))


@pytest.mark.parametrize(
    ("given", "beyond"),
    [
        (Influence("a", "m", 0.5, 0.049, 0.25, 0.5), True),
        (Influence("a", "m", 0.5, 0.05, 0.25, 0.01), False),
        (Influence("a", "m", 0.2, 0.5, -0.4, 0.01), True),
        (Influence("a", "m", 0.2, 0.01, -0.4, 0.06), False),
        (Influence("a", "m", 0.0, 0.9, 0.0, 0.9, (0.1, 0.2), (0.3, 0.2)), True),
        (Influence("a", "m", 0.9, 0.0, 0.0, 0.9, (0.1, 0.2), (0.2, 0.3)), False),
    ],
)
def test_a_driver_is_what_is_unlikely_to_be_chance(given: Influence, beyond: bool) -> None:
    assert given.is_significant is beyond


def test_chances_are_corrected_for_the_number_of_tests() -> None:
    """By hand: the k-th smallest of n times n / k, and no larger than the ones above it."""
    given = [Influence("a", "m", 0.5, 0.01, 0.25, 0.04), Influence("b", "m", 0.25, 0.03, 0.1, 0.5)]
    first, second = corrected_for_multiple_tests(given)
    assert (first.p_value, first.distance_p_value) == pytest.approx((0.04, 0.16 / 3))
    assert (second.p_value, second.distance_p_value) == pytest.approx((0.16 / 3, 0.5))
    assert (first.cause, first.correlation, second.distance_correlation) == ("a", 0.5, 0.1)
    assert corrected_for_multiple_tests([]) == []
    (constant,) = corrected_for_multiple_tests([Influence("a", "m", 0.0, math.nan)])
    assert constant.p_value == 1.0


def test_influences_are_rank_correlations_of_finite_values() -> None:
    rng = np.random.default_rng(4)
    x, y = rng.normal(size=40), rng.exponential(size=40)
    metric = x**3 + 0.5 * rng.normal(size=40)
    metric[[3, 9]] = math.nan
    there = np.isfinite(metric)
    causes = {"x": x, "y": y, "same": np.ones(40)}
    metrics = {"m": metric, "constant": np.ones(40), "two": np.r_[1.0, 2.0, [math.nan] * 38]}
    found = influences(causes, metrics)
    assert [(each.cause, each.metric) for each in found] == [("x", "m"), ("y", "m")]
    for each, values in zip(found, (x, y), strict=True):
        expected = stats.spearmanr(values[there], metric[there])
        away = np.abs(values[there] - np.median(values[there]))
        departure = stats.spearmanr(away, metric[there])
        assert (each.correlation, each.p_value) == pytest.approx(tuple(expected))
        assert (each.distance_correlation, each.distance_p_value) == pytest.approx(tuple(departure))
    three = {"m": np.array([1.0, 3.0, 2.0])}
    (only,) = influences({"x": np.array([1.0, 2.0, 3.0])}, three)
    assert only.correlation == pytest.approx(0.5)
    # Two values are as far from their median: that distance says nothing.
    (sides,) = influences({"x": np.array([1.0, 2.0, 1.0, 2.0])}, {"m": np.arange(4.0)})
    assert (sides.distance_correlation, sides.distance_p_value) == (0.0, 1.0)


@pytest.mark.parametrize("ties", [False, True])
def test_the_chance_of_a_correlation_of_few_flights_is_that_of_their_permutations(
    ties: bool,
) -> None:
    rng = np.random.default_rng(8)
    x, y = rng.normal(size=6), rng.normal(size=6)
    if ties:
        y = np.round(y)
    found = stats.permutation_test(
        (x,), lambda drawn: stats.spearmanr(drawn, y).statistic, permutation_type="pairings",
    )  # fmt: skip
    (each,) = influences({"x": x}, {"m": y})
    assert (each.correlation, each.p_value) == pytest.approx((found.statistic, found.pvalue))
    (perfect,) = influences({"x": np.arange(3.0)}, {"m": np.array([1.0, 2.0, 4.0])})
    assert (perfect.correlation, perfect.p_value) == pytest.approx((1.0, 1 / 3))
    assert not perfect.is_significant


def test_indices_need_whole_samples() -> None:
    assert sobol_indices(["a"], np.array([1.0, math.nan, 2.0, 3.0])) == {}
    assert sobol_indices(["a"], np.ones(8)) == {}
    problem = sobol_problem(["a", "b"])
    assert (problem["num_vars"], problem["bounds"]) == (2, [[0, 1], [0, 1]])
    assert problem["names"].tolist() == ["a", "b"]


def test_paired_differences_are_those_of_student() -> None:
    first = np.array([1.0, 2.0, 4.0, math.nan, 5.0])
    second = np.array([1.5, 2.25, 5.5, 1.0, math.nan])
    found = paired_difference("m", first, second)
    assert found is not None
    expected = stats.ttest_rel(second[:3], first[:3])
    interval = expected.confidence_interval(0.95)
    assert (found.metric, found.count) == ("m", 3)
    assert (found.first, found.second) == pytest.approx((7 / 3, 9.25 / 3))
    assert found.difference == pytest.approx(0.75)
    assert (found.interval_low, found.interval_high) == pytest.approx(tuple(interval))
    assert not found.is_significant
    two = paired_difference("m", first[:2], second[:2])
    assert two is not None
    assert two.count == 2
    assert paired_difference("m", first[:1], second[:1]) is None


@pytest.mark.parametrize(
    ("low", "high", "certain"),
    [(0.1, 0.2, True), (-0.2, -0.1, True), (-0.1, 0.1, False), (0.0, 1.0, False), (-1, 0.0, False)],
)
def test_an_interval_that_excludes_zero_is_certain(low: float, high: float, certain: bool) -> None:
    assert PairedDifference("m", 3, 0.0, 0.0, 0.0, low, high).is_significant is certain


def test_paired_success_is_mcnemars() -> None:
    first = np.array([1, 1, 1, 1, 1, 0, 0, 1], bool)
    second = np.array([1, 0, 0, 0, 0, 1, 0, 1], bool)
    assert paired_success(first, second) == pytest.approx((4, 1, 2 * 6 / 32))
    assert paired_success(first, first) == (0, 0, 1.0)


# -- criteria and distributions -------------------------------------------------------------------


def test_criteria_include_their_bounds() -> None:
    criterion = Criterion("duration_s", 1.5, 2.5)
    for value, met in ((1.5, True), (2.5, True), (1.49, False), (2.51, False), (math.nan, False)):
        assert passes_criteria([criterion], "reached", {"duration_s": value}) is met
    assert not passes_criteria([criterion], "reached", {})
    assert not passes_criteria([criterion], "failed", {"duration_s": 2.0})


# -- draws ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sampler", ["sobol", "halton", "latin_hypercube"])
def test_samplers_are_those_of_scipy(sampler: str) -> None:
    values = {"mass.mass_1": {"uniform": [1.0, 3.0]}, "mass.mass_2": {"uniform": [0.0, 1.0]}}
    made = campaign(flights=6, seed=7, sampler=sampler, disperse=values)
    kind = {"sobol": "Sobol", "halton": "Halton", "latin_hypercube": "LatinHypercube"}[sampler]
    rng = np.random.default_rng(np.random.SeedSequence(7))
    engine = getattr(stats.qmc, kind)(d=2, seed=rng)
    expected = engine.random_base2(3)[:6] if sampler == "sobol" else engine.random(6)
    found = [list(draw.values.values()) for draw in Draws(made)]
    np.testing.assert_allclose(found, expected * [2.0, 1.0] + [1.0, 0.0], atol=1e-11)


def test_a_draw_changes_its_flight() -> None:
    flight = drawn_flight(MADE, Draw(3, 17, {"mass.mass_1": 1.25}))
    assert flight.seeded_scenario.plant.sensors.seed == 17
    assert flight.scenario_with_draws.plant.sensors.seed == 17
    assert flight.inertial is not None
    usual = [body.inertia.mass for body in flight.nominal.bodies]
    np.testing.assert_allclose(flight.inertial.masses / usual, [1.0, 1.25, 1.0, 1.0])
    with pytest.raises(ParameterError) as refused:
        drawn_flight(MADE, Draw(3, 17, {"mass.mass_1": math.inf}))
    assert str(refused.value) == "The value drawn for 'mass.mass_1' is inf."
    common = DrawnFlight.of(MADE.scenario)
    assert drawn_flight(MADE, Draw(3, 17, {"mass.mass_1": 1.5}), common).nominal is common.nominal


def test_a_seed_that_is_dispersed_is_that_of_the_flight() -> None:
    made = campaign(disperse={"plant.sensors.seed": {"choice": [41]}})
    flight = drawn_flight(made, Draws(made)[0])
    assert flight.seeded_scenario.plant.sensors.seed == 41


def test_a_package_that_is_missing_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("pyarrow", "pyarrow.parquet"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(SpaceRobotError) as refused:
        sampling.require_module("pyarrow.parquet")
    assert str(refused.value) == (
        "Campaigns need pyarrow, which is not installed: pip install '.[campaign]' in the clone."
    )


# -- running --------------------------------------------------------------------------------------


def test_progress_has_a_time_left() -> None:
    assert Progress(30, 100, 3.5, 10.0).seconds_left == 20.0
    assert Progress(30, 100, 0.0, 10.0).seconds_left == math.inf


DRAWN = Draw(7, 123, {"mass": 1.23456789, "planner.method": "optimal"})


def rerun(**given: Any) -> Rerun:
    row = Row(DRAWN, "reached", "There.")
    wanted = {"deviation": 1e-9, "worst_metric": "a_m", "outcome": "reached", "bag": Path("b.mcap")}
    return Rerun(row, **{**wanted, **given})


@pytest.mark.parametrize(
    ("given", "agrees", "last"),
    [
        ({}, True, "dataset     reached; largest deviation 1e-09 (a_m)"),
        ({"deviation": 1.1e-9}, False, "dataset     reached; largest deviation 1.1e-09 (a_m)"),
        ({"outcome": "failed"}, False, "dataset     failed; largest deviation 1e-09 (a_m)"),
        ({"deviation": 0.0, "worst_metric": ""}, True, "dataset     reached; largest deviation 0"),
        ({"deviation": None, "outcome": ""}, True, "dataset     has no such flight yet"),
        ({"deviation": 5.0, "note": "Because."}, True, "Because."),
    ],
)
def test_what_is_said_of_a_rerun(given: dict[str, Any], agrees: bool, last: str) -> None:
    found = rerun(**given)
    assert found.agrees is agrees
    assert found.report_lines[:3] == [
        "flight 7: reached, not passed. There.",
        "drawn       mass 1.23457, planner.method optimal; seed 123",
        "bag         b.mcap",
    ]
    assert found.report_lines[-1] == last
    assert len(found.report_lines) == (5 if "note" in given else 4)


def test_a_rerun_without_dispersions() -> None:
    row = Row(Draw(0, 5, {}), "failed", "Off.")
    assert Rerun(row, None, "", "", Path("b")).report_lines[1] == "drawn       nothing; seed 5"


def test_deviations_are_relative_above_one() -> None:
    nan = math.nan
    assert largest_deviation({"a": 0.5, "b": 4.0}, {"a": 0.25, "b": 5.0}) == (0.25, "a")
    assert largest_deviation({"a": 0.5, "b": -8.0}, {"a": 0.25, "b": -12.0}) == (0.5, "b")
    assert largest_deviation({"a": nan}, {"a": nan}) == (0.0, "")
    assert largest_deviation({"a": nan}, {}) == (0.0, "")
    assert largest_deviation({"a": nan}, {"a": 1.0}) == (math.inf, "a")
    assert largest_deviation({"a": 1.0}, {}) == (math.inf, "a")
    assert largest_deviation({"a": math.inf}, {"a": math.inf}) == (0.0, "")


def test_a_stored_flight_has_its_metrics(tmp_path: Path) -> None:
    draws, metrics = Draws(MADE), {"position_error_m": 0.25, "duration_s": 3.0}
    rows = [Row(draws[n], "reached", ".", metrics, True, "lanes", 1.0, 2.0) for n in (2, 4)]
    dataset = written(tmp_path, MADE, rows)
    assert stored_flight(dataset, 3) is None
    assert stored_flight(dataset, 4) == ("reached", "lanes", metrics)


# -- datasets -------------------------------------------------------------------------------------


def test_the_files_of_a_dataset(tmp_path: Path) -> None:
    dataset = Dataset(tmp_path)
    assert dataset.begin(replace(MADE, description="D")) == set()
    facts = json.loads((tmp_path / "about.json").read_text("utf-8"))
    assert (facts["name"], facts["scenario"]) == ("short", "stuck_slider")
    assert sorted(json.loads(facts["versions"])) == [
        *("numpy", "python", "source", "spacerobot_ros")
    ]
    assert len(facts["fingerprint"]) == 64
    text = (tmp_path / "campaign.yaml").read_text("utf-8")
    assert "scenario: scenario.yaml" in text
    assert "flights: 6" in text
    assert "set:" not in text
    draws = Draws(MADE)
    dataset.add([Row(draws[5], "reached", ".")])
    dataset.close()
    # Fewer flights than there are do not change the largest number.
    assert dataset.begin(replace(MADE, flights=2, section={**MADE.section, "flights": 2})) == {5}
    dataset.close()
    assert "flights: 6" in (tmp_path / "campaign.yaml").read_text("utf-8")
    assert dataset.begin(replace(MADE, flights=9)) == {5}
    dataset.close()
    assert "flights: 9" in (tmp_path / "campaign.yaml").read_text("utf-8")


def test_a_folder_without_a_campaign_or_flights_is_named(tmp_path: Path) -> None:
    with pytest.raises(ParameterError) as refused:
        Dataset(tmp_path / "none").campaign()
    assert str(refused.value) == (
        f"The folder {tmp_path / 'none'} contains no campaign: about.json: No such file or "
        "directory."
    )
    dataset = Dataset(tmp_path / "new")
    dataset.begin(MADE)
    with pytest.raises(ParameterError) as refused:
        dataset.table()
    assert str(refused.value) == f"The folder {tmp_path / 'new'} has no flights yet."
    dataset.close()
    (tmp_path / "new" / "campaign.yaml").write_text("campaign: {flights: 0}")
    with pytest.raises(ParameterError) as refused:
        dataset.campaign()
    assert str(refused.value).startswith(
        f"The campaign in {tmp_path / 'new'} is refused: 'flights' is 0;"
    )


def test_robots_that_are_files_travel_with_a_campaign(tmp_path: Path) -> None:
    from spacerobot_ros.resources import robot_file

    file = tmp_path / "own.urdf"
    text = robot_file("sliding_masses").read_text("utf-8")
    file.write_text(text)
    assert MADE.scenario.plant.robot == "sliding_masses"
    sent = campaign(set={"plant.robot": str(file), "planner.robot": ""}).scenario
    assert (sent.plant.robot, sent.plant.world) == ("", "")
    assert "slider_1" in sent.plant.robot_description
    assert (sent.planner.robot, sent.planner.robot_description) == ("", "")
    both = campaign(set={"plant.robot": str(file), "planner.robot": str(file)})
    assert both.scenario.planner.robot_description == sent.plant.robot_description
