"""Every column of a campaign's dataset has the value of its flight, and every metric its unit."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.campaigns import campaign

from spacerobot_ros.campaign.config import Criterion
from spacerobot_ros.campaign.dataset import Dataset, Row
from spacerobot_ros.campaign.draws import Draws
from spacerobot_ros.campaign.report import metric_label
from spacerobot_ros.campaign.targets import description_of
from spacerobot_ros.measures import (
    METRICS,
    Measures,
    Outcome,
    metrics_of_each,
)
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

EXPECTED: dict[str, dict[str, Any]] = {
    "flight": {"flight": 3},
    "seed": {},
    "passed": {"passed": False},
    "outcome": {"outcome": "failed"},
    "reason": {"reason": "Short of the goal."},
    "draw": {},
    "wall_time_s": {"wall_time_s": 1.5},
    "plan_time_s": {"plan_time_s": 0.75},
    "engine": {"engine": "lanes"},
    "fallback": {"fallback": ""},
    "versions": {},
    "position_error_m": {"position_error_m": 0.0125},
    "attitude_error_rad": {"attitude_error_rad": 0.0625},
    "end_effector_position_error_m": {"end_effector_position_error_m": 0.375},
    "end_effector_attitude_error_rad": {"end_effector_attitude_error_rad": 0.75},
    "duration_s": {"duration_s": 41.5},
    "manoeuvre_time_s": {"manoeuvre_time_s": 39.25},
    "corrections": {"corrections": 2.0},
    "propellant_kg": {"propellant_kg": 0.0625},
    "peak_rate": {"": 0.5, ".slider_1": 0.25, ".slider_2": 0.5, ".slider_3": 0.125},
    "peak_effort": {"": 20.0, ".slider_1": 20.0, ".slider_2": 5.0, ".slider_3": 15.0},
    "peak_force_N": {"peak_force_N": 7.0},
    "peak_torque_Nm": {"peak_torque_Nm": 3.0},
    "joint_margin": {"": 0.25, ".slider_1": 0.5, ".slider_2": 0.25, ".slider_3": 2.0},
    "rate_margin": {"": 2 / 7, ".slider_1": 4.5 / 7, ".slider_2": 2 / 7, ".slider_3": 5.75 / 7},
    "effort_margin": {"": 0.6, ".slider_1": 0.6, ".slider_2": 0.9, ".slider_3": 0.7},
    "momentum_drift": {"momentum_drift": 3e-6},
    "clearance_m": {"clearance_m": -0.03125},
    "captured": {"captured": 1.0},
    "placed": {"placed": 0.0},
    "capture_time_s": {"capture_time_s": 30.5},
    "capture_distance_m": {"capture_distance_m": 0.0025},
    "capture_impulse_Ns": {"capture_impulse_Ns": 0.375},
    "capture_angular_impulse_Nms": {"capture_angular_impulse_Nms": 0.0125},
    "capture_joint_impulse": {"capture_joint_impulse": 0.21875},
    "detumbling_time_s": {"detumbling_time_s": 2.75},
    "detumbling_bound_s": {"detumbling_bound_s": 0.34375},
}
"""Each column, or the columns of the joints after the name that they have in common."""

UNITS = {
    "position_error_m": "m",
    "attitude_error_rad": "rad",
    "end_effector_position_error_m": "m",
    "end_effector_attitude_error_rad": "rad",
    "duration_s": "s",
    "manoeuvre_time_s": "s",
    "corrections": "",
    "propellant_kg": "kg",
    "peak_rate": "m/s or rad/s",
    "peak_effort": "N or N m",
    "peak_force_N": "N",
    "peak_torque_Nm": "N m",
    "joint_margin": "m or rad",
    "rate_margin": "",
    "effort_margin": "",
    "momentum_drift": "kg m/s, kg m^2/s",
    "clearance_m": "m",
    "captured": "",
    "placed": "",
    "capture_time_s": "s",
    "capture_distance_m": "m",
    "capture_impulse_Ns": "N s",
    "capture_angular_impulse_Nms": "N m s",
    "capture_joint_impulse": "N m s or N s",
    "detumbling_time_s": "s",
    "detumbling_bound_s": "s",
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
    dataset = Dataset(folder)
    dataset.begin(made)
    dataset.add(Row.of_each(made, [(draw, FLOWN)], "lanes"))
    dataset.close()
    import pyarrow.parquet

    (file,) = Path(folder).rglob("*.parquet")
    (row,) = pyarrow.parquet.read_table(file).to_pylist()
    return {**row, "of": draw}


@pytest.mark.parametrize("column", EXPECTED)
def test_a_column_has_the_value_of_the_flight(column: str, record: dict[str, Any]) -> None:
    draw = record["of"]
    expected = EXPECTED[column]
    if column == "seed":
        expected = {"seed": draw.seed}
    elif column == "draw":
        expected = {"draw.mass.mass_2": draw.values["mass.mass_2"]}
        assert 0.9 < draw.values["mass.mass_2"] < 1.1
    elif column == "versions":
        versions = json.loads(record["versions"])
        assert versions["numpy"] == np.__version__
    for name, value in expected.items():
        number = record[name if name in record else f"{column}{name}"]
        assert number == (value if isinstance(value, str) else pytest.approx(value)), name


def test_every_column_is_expected(record: dict[str, Any]) -> None:
    found = {name.partition(".")[0] for name in record}
    assert found - {"of"} == set(EXPECTED)
    joints = {name.rpartition(".")[2] for name in record if name.startswith("peak_rate.")}
    assert joints == {"slider_1", "slider_2", "slider_3"}


@pytest.mark.parametrize("metric", UNITS)
def test_a_requirement_and_the_axis_of_a_metric_have_its_unit(metric: str) -> None:
    unit = UNITS[metric]
    line = str(Criterion(metric, -1.5, 2.25))
    assert line == f"{metric} at least -1.5 and at most 2.25 {unit}".rstrip()
    assert str(Criterion(metric, maximum=2.0)) == f"{metric} at most 2 {unit}".rstrip()
    named = metric.rpartition("_")[2] in ("m", "rad", "s", "kg", "N", "Nm", "Ns", "Nms")
    assert metric_label(metric) == (f"{metric}, {unit}" if unit and not named else metric)


def test_every_metric_has_its_unit() -> None:
    assert UNITS.keys() == METRICS.keys()


def test_what_a_flight_does_not_have_is_no_number(tmp_path: Path) -> None:
    made = campaign(flights=2)
    dataset = Dataset(tmp_path / "dataset")
    dataset.begin(made)
    dataset.add([Row.of_error(Draws(made)[0], ValueError("no\n  way"), "flights")])
    dataset.close()
    (row,) = dataset.table().to_pylist()
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
