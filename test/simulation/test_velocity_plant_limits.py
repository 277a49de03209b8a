"""The plant under held joint velocities: rates, strokes, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from support.velocity_flights import RATE, STROKE, TICK, URDF, Case, robot_of, sliding_masses

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.simulation import VelocityPlant

# -- limits -----------------------------------------------------------------------------------


def test_a_rate_is_clipped_and_counted_once_a_tick() -> None:
    plant = sliding_masses()
    assert plant.step(np.array([0.70001, -0.7, 5.0]))
    np.testing.assert_array_equal(plant.qdot, [0.7, -0.7, 0.7])
    np.testing.assert_allclose(plant.q, [0.035, -0.035, 0.035])
    assert not plant.step(np.array([0.7, 0.0, -0.7]))
    assert plant.step(np.array([0.0, 0.0, -np.inf]))
    np.testing.assert_array_equal(plant.velocity_limited, [1, 0, 2])
    np.testing.assert_array_equal(plant.stroke_limited, [0, 0, 0])


def test_a_joint_stops_at_the_end_of_its_stroke_and_comes_back() -> None:
    plant = sliding_masses(joint_positions=np.array([2.49, -2.5, 0.0]))
    assert plant.step(np.array([0.7, -0.3, 0.7]))
    np.testing.assert_allclose(plant.qdot, [0.2, 0.0, 0.7], atol=1e-12)
    np.testing.assert_allclose(plant.q, [2.5, -2.5, 0.035], rtol=1e-15)
    np.testing.assert_array_equal(plant.stroke_limited, [1, 1, 0])
    np.testing.assert_array_equal(plant.velocity_limited, [0, 0, 0])
    # Too fast and too far at once counts as both.
    assert plant.step(np.array([1.0, 0.3, 0.0]))
    np.testing.assert_array_equal(plant.stroke_limited, [2, 1, 0])
    np.testing.assert_array_equal(plant.velocity_limited, [1, 0, 0])
    assert plant.qdot[0] == pytest.approx(0.0, abs=1e-12)
    assert not plant.step(np.array([-0.7, 0.3, 0.0]))
    np.testing.assert_allclose(plant.q, [2.465, -2.47, 0.035], rtol=1e-14)


@pytest.mark.parametrize("seed", [0, 1])
def test_no_joint_ever_leaves_its_limits(seed: int) -> None:
    case = Case(seed, momentum=False)
    plant = case.plant()
    kinds = [j.kind.value for j in case.robot.description.movable_joints]
    free = np.array([kind == "continuous" for kind in kinds])
    push = RATE * np.sign(case.command())
    for tick in range(200):
        before = plant.q.copy()
        plant.step(1.2 * push if tick % 2 else push)
        assert np.all(np.abs(plant.qdot) <= RATE)
        assert np.all((np.abs(plant.q) <= STROKE + 1e-14) | free)
        np.testing.assert_allclose(plant.q, before + TICK * plant.qdot, atol=1e-12)
    np.testing.assert_allclose(plant.q[~free], (STROKE * np.sign(push))[~free], atol=1e-12)
    assert np.all(np.abs(plant.q[free]) > STROKE)
    np.testing.assert_array_equal(plant.velocity_limited, 100)
    assert np.all(plant.stroke_limited[~free] > 0)
    assert np.all(plant.stroke_limited[free] == 0)


# -- refusals ---------------------------------------------------------------------------------


@pytest.mark.parametrize("period", [0.0, -0.05, np.nan, np.inf])
def test_a_bad_tick_period_is_refused(period: float) -> None:
    robot = robot_of((URDF / "sliding_masses.urdf").read_text("utf-8"))
    with pytest.raises(ParameterError, match="control period"):
        VelocityPlant(robot, period)


@pytest.mark.parametrize(
    ("initial", "mentions"),
    [
        ({"joint_positions": [0.0, 0.0]}, ["2 numbers", "slider_1, slider_2, slider_3"]),
        ({"joint_positions": [0.0] * 4}, ["4 numbers", "3 joints"]),
        ({"joint_positions": [0.0, 2.6, 0.0]}, ["'slider_2'", "2.6", "[-2.5, 2.5]"]),
        ({"joint_positions": [0.0, 0.0, -2.51]}, ["'slider_3'", "-2.51"]),
        ({"joint_positions": [np.nan, 0.0, 0.0]}, ["joint positions", "nan"]),
        ({"quaternion": [0.0] * 4}, ["orientation"]),
        ({"quaternion": [0.0, np.nan, 0.0, 1.0]}, ["orientation"]),
        ({"position": [0.0, np.inf, 0.0]}, ["position"]),
        ({"linear_momentum": [np.nan, 0.0, 0.0]}, ["moment"]),
        ({"angular_momentum": [0.0, 0.0, np.inf]}, ["moment"]),
    ],
)
def test_a_bad_initial_state_is_refused(
    initial: dict[str, list[float]], mentions: list[str]
) -> None:
    with pytest.raises(ParameterError) as refusal:
        sliding_masses(**{name: np.array(value) for name, value in initial.items()})
    text = str(refusal.value)
    assert text.endswith(".")
    assert "\n" not in text
    for mention in mentions:
        assert mention in text
