"""Every column of a campaign's dataset has the value of its flight, and every metric its unit."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.campaigns import campaign, written

from spacerobot_ros.campaign.config import Criterion
from spacerobot_ros.campaign.dataset import Row
from spacerobot_ros.campaign.draws import Draws
from spacerobot_ros.campaign.report import metric_label
from spacerobot_ros.campaign.targets import description_of
from spacerobot_ros.measures import METRICS, Measures, Outcome, metrics_of_each
from spacerobot_ros.planning.core.goal import PoseError

FLOWN = Measures(
    outcome=Outcome.FAILED,
    message="Short of the goal.",
    duration=41.5,
    manoeuvre_time=39.25,
    error=PoseError(np.array([0.0075, 0.0, -0.01]), np.array([0.0, 0.0375, -0.05])),
    end_effector_distance=0.375,
    end_effector_angle=0.75,
    peak_rate=np.array([0.25, 0.5, 0.125]),
    peak_effort=np.array([20.0, 5.0, 15.0]),
    peak_wrench=np.array([7.0, 3.0]),
    lowest=np.array([-1.0, -2.25, -0.5]),
    highest=np.array([2.0, 1.0, 0.25]),
    momentum_drift=np.array([1e-6, 3e-6]),
    corrections=2,
    propellant=0.0625,
    plan_time=0.75,
    wall_time=1.5,
    clearance=-0.03125,
    capture={
        "captured": 1.0,
        "placed": 0.0,
        "capture_time_s": 30.5,
        "capture_distance_m": 0.0025,
        "capture_impulse_Ns": 0.375,
        "capture_angular_impulse_Nms": 0.0125,
        "capture_joint_impulse": 0.21875,
        "detumbling_time_s": 2.75,
        "detumbling_bound_s": 0.34375,
    },
)
"""Of sliders that move 2.5 m to both sides, 0.7 m/s fast and with up to 50 N."""

EXPECTED: dict[str, tuple[Any, str]] = {
    "position_error_m": (0.0125, "m"),
    "attitude_error_rad": (0.0625, "rad"),
    "end_effector_position_error_m": (0.375, "m"),
    "end_effector_attitude_error_rad": (0.75, "rad"),
    "duration_s": (41.5, "s"),
    "manoeuvre_time_s": (39.25, "s"),
    "corrections": (2.0, ""),
    "propellant_kg": (0.0625, "kg"),
    "peak_rate": ((0.5, 0.25, 0.5, 0.125), "m/s or rad/s"),
    "peak_effort": ((20.0, 20.0, 5.0, 15.0), "N or N m"),
    "peak_force_N": (7.0, "N"),
    "peak_torque_Nm": (3.0, "N m"),
    "joint_margin": ((0.25, 0.5, 0.25, 2.0), "m or rad"),
    "rate_margin": ((2 / 7, 4.5 / 7, 2 / 7, 5.75 / 7), ""),
    "effort_margin": ((0.6, 0.6, 0.9, 0.7), ""),
    "momentum_drift": (3e-6, "kg m/s, kg m^2/s"),
    "clearance_m": (-0.03125, "m"),
    "captured": (1.0, ""),
    "placed": (0.0, ""),
    "capture_time_s": (30.5, "s"),
    "capture_distance_m": (0.0025, "m"),
    "capture_impulse_Ns": (0.375, "N s"),
    "capture_angular_impulse_Nms": (0.0125, "N m s"),
    "capture_joint_impulse": (0.21875, "N m s or N s"),
    "detumbling_time_s": (2.75, "s"),
    "detumbling_bound_s": (0.34375, "s"),
}
"""Value and unit of each metric; with joints, the whole robot's, then that of each slider."""

OTHERS: dict[str, Any] = {
    "flight": 3,
    "passed": False,
    "outcome": "failed",
    "reason": "Short of the goal.",
    "wall_time_s": 1.5,
    "plan_time_s": 0.75,
    "engine": "lanes",
    "fallback": "",
}


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the row of a flight as another program reads it, beside the draw that it is of."""
    folder = tmp_path_factory.mktemp("columns") / "dataset"
    made = campaign(
        flights=4,
        seed=11,
        disperse={"mass.mass_2": {"uniform": {"loc": 0.9, "scale": 0.2}}},
        criteria={"position_error_m": {"max": 0.02}},
    )
    draw = Draws(made)[3]
    written(folder, made, Row.of_each(made, [(draw, FLOWN)], "lanes"))
    import pyarrow.parquet

    (file,) = Path(folder).rglob("*.parquet")
    (row,) = pyarrow.parquet.read_table(file).to_pylist()
    return {**row, "of": draw}


@pytest.mark.parametrize("metric", EXPECTED)
def test_a_metric_has_the_value_of_the_flight_and_its_unit(
    metric: str, record: dict[str, Any]
) -> None:
    value, unit = EXPECTED[metric]
    if isinstance(value, tuple):
        found = tuple(record[f"{metric}{of}"] for of in ("", ".slider_1", ".slider_2", ".slider_3"))
    else:
        found = record[metric]
    assert found == pytest.approx(value)
    line = str(Criterion(metric, -1.5, 2.25))
    assert line == f"{metric} at least -1.5 and at most 2.25 {unit}".rstrip()
    assert str(Criterion(metric, maximum=2.0)) == f"{metric} at most 2 {unit}".rstrip()
    named = metric.rpartition("_")[2] in ("m", "rad", "s", "kg", "N", "Nm", "Ns", "Nms")
    assert metric_label(metric) == (f"{metric}, {unit}" if unit and not named else metric)


def test_the_other_columns_have_the_values_of_the_flight(record: dict[str, Any]) -> None:
    draw = record["of"]
    assert {name: record[name] for name in OTHERS} == OTHERS
    assert record["seed"] == draw.seed
    assert 0.9 < record["draw.mass.mass_2"] == draw.values["mass.mass_2"] < 1.1
    assert json.loads(record["versions"])["numpy"] == np.__version__


def test_every_column_and_metric_is_expected(record: dict[str, Any]) -> None:
    found = {name.partition(".")[0] for name in record}
    assert found - {"of"} == {*EXPECTED, *OTHERS, "seed", "draw", "versions"}
    joints = {name.rpartition(".")[2] for name in record if name.startswith("peak_rate.")}
    assert joints == {"slider_1", "slider_2", "slider_3"}
    assert EXPECTED.keys() == METRICS.keys()


def test_what_a_flight_does_not_have_is_no_number(tmp_path: Path) -> None:
    made = campaign(flights=2)
    error = Row.of_error(Draws(made)[0], ValueError("no\n  way"), "flights")
    (row,) = written(tmp_path / "dataset", made, [error]).table().to_pylist()
    assert (row["outcome"], row["reason"]) == ("error", "ValueError: no way")
    assert (row["engine"], row["passed"]) == ("flights", False)
    assert row["position_error_m"] is None
    assert math.isnan(row["wall_time_s"])


def test_the_metrics_of_flights_are_those_of_each() -> None:
    robot = description_of(campaign().scenario)
    other = replace(FLOWN, duration=3.5, peak_rate=np.array([9.0, 0.0, math.nan]), error=None)
    found = metrics_of_each([FLOWN, other, FLOWN], robot)
    assert str(found) == str([metrics_of_each([each], robot)[0] for each in (FLOWN, other, FLOWN)])
    assert [each["duration_s"] for each in found] == [41.5, 3.5, 41.5]
    assert [each["peak_rate.slider_1"] for each in found] == [0.25, 9.0, 0.25]
    assert [str(each["peak_rate"]) for each in found] == ["0.5", "nan", "0.5"]
    assert metrics_of_each([], robot) == []
