"""The gait of sliding masses: paper 1's manoeuvre and its numbers."""

from __future__ import annotations

import numpy as np
import pytest
from planning.sliding_robots import paper_robot
from scipy.spatial.transform import Rotation
from support.planners import planner_of
from support.slides_and_turns import PERIOD, URDF, goal_at, misses, note, origin, state_at

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import METHODS, GaitSchedule, Tolerance
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait

PAPER_GOAL = goal_at([0.3, -0.25, 0.1], Rotation.from_rotvec([0.5, -0.15, 0.1]))
# a22 = 0.8 and a31 = 8.125, as ratios to the balanced amplitudes at the paper's alpha.
PAPER_OPTIONS = {
    "t1": 100.0,
    "n1": 10,
    "cycle_period": 3.0,
    "cycles": 1600,
    "a22_ratio": 0.8 / np.sqrt(2 * 0.84377 / np.pi),
    "a31_ratio": 8.125 / np.sqrt(np.hypot(61.0928, 18.8194) / np.pi),
}


@pytest.fixture(scope="module")
def paper_gait() -> GaitSchedule:
    """Return the manoeuvre of 4900 s, at a tolerance that admits the first order."""
    method = planner_of(
        "lie_bracket", SpaceRobot.from_file(URDF), PERIOD, Tolerance(0.02, 0.06), **PAPER_OPTIONS
    )
    return method.plan(origin(), PAPER_GOAL)


def test_the_symbols_of_the_paper_are_recomputed(paper_gait: GaitSchedule) -> None:
    assert METHODS["lie_bracket"] is LieBracketGait
    np.testing.assert_allclose(note(paper_gait, "zf"), [-2.378408, 1.687252, -1.377082], atol=1e-6)
    np.testing.assert_allclose(note(paper_gait, "c"), [-0.047568, 0.033745, -0.027542], atol=1e-6)
    # In the paper's sign convention; the printed 0.8438 lacks its sign.
    np.testing.assert_allclose(note(paper_gait, "alpha"), [-0.84377, -61.0928, -18.8194], rtol=1e-5)
    assert note(paper_gait, "cycles") == 1600
    np.testing.assert_allclose(note(paper_gait, "amplitudes")[3:], [0.8, 8.125], rtol=1e-5)


def test_the_manoeuvre_of_the_paper_takes_4900_s(paper_gait: GaitSchedule) -> None:
    assert paper_gait.ticks == 98_000
    assert paper_gait.duration == pytest.approx(4900.0)
    assert paper_gait.positions.shape == (98_001, 3)
    # Within the peaks of the printed controls, which are not held for ticks.
    rates = np.abs(paper_gait.velocities).max(axis=0)
    np.testing.assert_allclose(rates, [0.0647, 0.1871, 0.6550], rtol=0.03)
    reach = np.abs(paper_gait.positions).max(axis=0)
    np.testing.assert_allclose(reach, [2.419, 1.687, 1.648], atol=5e-3)


def test_the_manoeuvre_of_the_paper_ends_where_its_controls_end(paper_gait: GaitSchedule) -> None:
    position, quaternion = paper_gait.path.position[-1], paper_gait.path.quaternion[-1]
    attitude = Rotation.from_quat(quaternion)
    np.testing.assert_allclose(position, [0.30135, -0.25412, 0.08435], atol=0.002)
    np.testing.assert_allclose(attitude.as_rotvec(), [0.55055, -0.14255, 0.09554], atol=0.002)
    _, angle = misses(PAPER_GOAL, position, attitude)
    assert np.degrees(angle) == pytest.approx(2.93, abs=0.02)


def test_the_manoeuvre_of_the_paper_integrated_otherwise(paper_gait: GaitSchedule) -> None:
    robot, shapes = paper_robot(), paper_gait.positions
    # 100 s of slide, and one cycle of 60 ticks 1600 times over.
    slide, cycles = shapes[:2001], shapes[2000:]
    one = cycles[:61]
    np.testing.assert_array_equal(cycles[:-1].reshape(1600, 60, 3)[1:], [one[:-1]] * 1599)
    before = robot.attitudes(slide, PERIOD, Rotation.identity())[-1]
    turn = robot.attitudes(one, PERIOD, Rotation.identity())[-1]
    after = before * Rotation.from_rotvec(1600 * turn.as_rotvec())
    predicted = Rotation.from_quat(paper_gait.path.quaternion[-1])
    assert (predicted.inv() * after).magnitude() < 1e-8
    end = -after.apply(robot.center_of_mass(shapes[-1]))
    np.testing.assert_allclose(paper_gait.path.position[-1], end, atol=1e-8)


def test_a_tighter_tolerance_refines_the_manoeuvre_of_the_paper() -> None:
    method = planner_of(
        "lie_bracket", SpaceRobot.from_file(URDF), PERIOD, Tolerance(1e-4, 1e-5), **PAPER_OPTIONS
    )
    schedule = method.plan(origin(), PAPER_GOAL)
    assert schedule.ticks == 98_000
    end = Rotation.from_quat(schedule.path.quaternion[-1])
    distance, angle = misses(PAPER_GOAL, schedule.path.position[-1], end)
    assert angle <= 1e-5
    assert distance <= 1e-4


def test_a_correction_asks_for_little(paper_gait: GaitSchedule) -> None:
    method = planner_of(
        "lie_bracket", SpaceRobot.from_file(URDF), PERIOD, Tolerance(1e-3, 1e-3), **PAPER_OPTIONS
    )
    end = Rotation.from_quat(paper_gait.path.quaternion[-1])
    state = state_at(paper_gait.path.position[-1], end, paper_gait.positions[-1])
    correction = method.plan(state, PAPER_GOAL, correction=True)
    # 0.05 rad of the 0.54 that the paper's 1600 cycles turn.
    assert correction.duration < 0.3 * paper_gait.duration
    first, second = (np.ptp(s.positions[2000:], axis=0) for s in (paper_gait, correction))
    assert note(correction, "cycles") < 1600
    assert np.all(second < 2.0 * np.maximum(first, 0.1))
    distance, angle = misses(
        PAPER_GOAL,
        correction.path.position[-1],
        Rotation.from_quat(correction.path.quaternion[-1]),
    )
    assert distance <= 1e-3
    assert angle <= 1e-3
