"""Paper 4's example: spacecraft and two-joint manipulator in a plane, commands held over a tick."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from control.flights import (
    INVERTIBLE,
    PLANAR_GAINS,
    PLANAR_GOAL,
    Array,
    Flight,
    fly,
    law_of,
    load,
    planar_start,
    plant_of,
)
from scipy.spatial.transform import Rotation
from support.slow import some_fast

# Recomputed at high accuracy (Runge-Kutta 4, commands not held): thruster force in inertial
# components, thruster torque and joint efforts at t = 0.
START_ACTUATION = {
    "transposed_jacobian": [5.5116, 59.3298, 94.8818, 74.2964, 47.3296],
    "model_based": [864.58, 642.76, 102.367, 97.397, 43.226],
}
# xS, yS, theta, xE, yE.
ERROR_AT_5_S = {
    "transposed_jacobian": [0.0031, 0.0106, -0.0062, -0.0377, 0.1155],
    "model_based": [0.0554, 0.0385, -0.0085, -0.0405, 0.1218],
}
# From the line through the printed start, (2.0, 0.0), to the goal, mm. The true start is 0.7 mm
# beside that line.
OFF_THE_LINE = {"transposed_jacobian": 15.8, "model_based": 0.7}


@cache
def flight(name: str, rate: float, duration: float) -> Flight:
    robot = load("planar_manipulator")
    plant = plant_of(robot, planar_start(), longest_step=0.01)
    law = law_of(name, robot, PLANAR_GAINS)
    return fly(plant, law, lambda _: PLANAR_GOAL, duration, rate, every=5)


def test_start() -> None:
    plant = plant_of(load("planar_manipulator"), planar_start())
    assert np.round(plant.state.r_WB, 5).tolist() == [-0.18380, 0.02471, 0.0]
    assert np.round(plant.frame("end_effector")[0], 5).tolist() == [2.00008, -0.00237, 0.0]


@pytest.mark.parametrize("name", INVERTIBLE)
def test_actuators_at_the_start(name: str) -> None:
    law = law_of(name, load("planar_manipulator"), PLANAR_GAINS)
    start = planar_start()
    actuation = law.command(start, PLANAR_GOAL)
    force_W = Rotation.from_quat(start.quaternion_WB).apply(actuation.wrench_B[:3])
    found = np.concatenate([force_W[:2], actuation.wrench_B[5:], actuation.tau])
    np.testing.assert_allclose(found, START_ACTUATION[name], rtol=1e-3)
    np.testing.assert_allclose([force_W[2], *actuation.wrench_B[3:5]], 0.0, atol=1e-12)
    if name == "transposed_jacobian":
        np.testing.assert_allclose(actuation.wrench_B[:2], [26.408, 53.414], rtol=1e-3)
        np.testing.assert_allclose(found, START_ACTUATION[name], rtol=1e-5)


@pytest.mark.parametrize("name", INVERTIBLE)
@pytest.mark.parametrize(
    ("rate", "tolerance"),
    # Held commands move the errors at 5 s by at most 7e-4 at 50 Hz and 4e-4 at 100 Hz; the
    # reference values have four decimals.
    some_fast([(50.0, 7.5e-4), (100.0, 4.5e-4), (1000.0, 1.2e-4)], (50.0, 7.5e-4), (100.0, 4.5e-4)),
)
def test_errors_at_5_s(name: str, rate: float, tolerance: float) -> None:
    flown = flight(name, rate, 5.0 if rate == 1000.0 else 12.0)
    error = flown.errors[flown.at(5.0)]
    np.testing.assert_allclose(error, ERROR_AT_5_S[name], atol=tolerance)


@pytest.mark.parametrize("name", INVERTIBLE)
@pytest.mark.parametrize("rate", [50.0, 100.0])
def test_errors_are_gone_in_12_s(name: str, rate: float) -> None:
    flown = flight(name, rate, 12.0)
    assert np.abs(flown.errors[flown.at(12.0)]).max() <= 0.004
    assert not any(status.singular for status in flown.statuses)


@pytest.mark.parametrize("name", INVERTIBLE)
def test_end_effector_path_is_a_straight_line(name: str) -> None:
    path = np.array(flight(name, 100.0, 12.0).end_effector)[:, :2]
    # Commands held for a tick move the path by half a millimetre.
    assert largest_distance(path, np.array([2.0, 0.0])) == pytest.approx(
        OFF_THE_LINE[name] * 1e-3, abs=5e-4
    )
    own = largest_distance(path, path[0])
    assert own == pytest.approx(15.3e-3 if name == "transposed_jacobian" else 0.0, abs=1e-4)


def largest_distance(path: Array, start: Array) -> float:
    """Return the largest distance of a path from the line from ``start`` to the goal."""
    along = np.array([1.5, 1.5]) - start
    normal = np.array([-along[1], along[0]]) / np.linalg.norm(along)
    return float(np.abs((path - start) @ normal).max())
