"""Waves and ramps of held commands, their first variation, and how often paths are stretched."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal.held_commands import (
    CommandHolder,
    HeldCommands,
    ManoeuvreModel,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    PathConstraints,
    Trajectory,
)
from spacerobot_ros.resources import robot_file

Array = npt.NDArray[np.float64]

PERIOD = 0.1
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
LIMITS = MotionLimits(
    np.array([-1.0, -2.0, -np.inf]),
    np.array([1.4, 2.0, np.inf]),
    np.array([0.5, np.inf, 1.1]),
    np.array([0.9, 0.7, 1.3]),
)
START, FINAL = np.array([0.3, -0.5, 0.2]), np.array([-0.4, 0.9, 0.8])


@pytest.fixture(scope="module")
def model() -> ManoeuvreModel:
    arm = SpaceRobot.from_file(robot_file("three_joint_arm"))
    prediction = BasePrediction(arm, PERIOD, 0.01)
    return ManoeuvreModel(arm, prediction, PERIOD, np.eye(3), PathConstraints())


@pytest.fixture(scope="module")
def holder(model: ManoeuvreModel) -> Any:
    return CommandHolder(model)


def smooth(ticks: int) -> Array:
    s = np.linspace(0.0, 1.0, ticks + 1)[:, np.newaxis]
    return np.asarray(START + (FINAL - START) * s**3 * (10 - 15 * s + 6 * s**2))


def test_waves_are_sines_of_each_joint_by_its_speed(holder: Any) -> None:
    positions = smooth(40)
    waves = holder._build_waves(positions, LIMITS)
    assert waves.shape == (41, 18, 3)
    s = np.linspace(0.0, 1.0, 41)
    # A joint without a speed limit has half its range for one.
    speeds = [0.5, 2.0, 1.1]
    for order in range(1, 7):
        for joint in range(3):
            wave = waves[:, 3 * (order - 1) + joint]
            expected = np.sin(math.pi * s) * np.sin(order * math.pi * s) / order * speeds[joint]
            np.testing.assert_allclose(wave[:, joint], expected, atol=1e-12)
            assert not np.delete(wave, joint, axis=1).any()


def test_waves_fade_where_joints_are_near_their_ends(holder: Any) -> None:
    """Within 0.02 of half a range of 1.2 or 2: by a cubic from nothing at the end."""
    near, at = [1.4 - 0.006, -2.0 + 0.04, 50.0], [-1.0, 2.0 + 1e-3, -50.0]
    q = np.array([near, at, [1.4 - 0.024, 0.0, 0.0]])
    found = holder._smooth_weights(q, LIMITS)
    x = 0.006 / 0.024
    np.testing.assert_allclose(
        found, [[x**2 * (3 - 2 * x), 1.0, 1.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0]], atol=1e-9
    )
    np.testing.assert_allclose(holder._smooth_weights(q[0], LIMITS), found[0])
    still = MotionLimits(np.zeros(3), np.zeros(3), np.ones(3), np.ones(3))
    np.testing.assert_array_equal(holder._smooth_weights(np.zeros(3), still), 0.0)


def test_ramps_move_the_last_shape_alone(holder: Any) -> None:
    s = np.linspace(0.0, 1.0, 11)[:, np.newaxis]
    ramps = holder._build_ramps(s, LIMITS)
    for joint, speed in enumerate([0.5, 2.0, 1.1]):
        expected = np.zeros((11, 3))
        expected[:, joint] = speed * (s**2 * (3 - 2 * s))[:, 0]
        np.testing.assert_allclose(ramps[:, joint], expected, atol=1e-15)


@pytest.mark.parametrize("ticks", [60, 450])
def test_the_first_variation_is_that_of_the_prediction(
    model: ManoeuvreModel, holder: Any, ticks: int
) -> None:
    positions = smooth(ticks)
    s = np.linspace(0.0, 1.0, ticks + 1)[:, np.newaxis]
    waves = np.hstack([holder._build_waves(positions, LIMITS), holder._build_ramps(s, LIMITS)])

    def end(q: Array) -> Rotation:
        return Rotation.from_quat(model.prediction.attitudes(q, IDENTITY, np.zeros(3))[-1])

    quaternions = model.prediction.attitudes(positions, IDENTITY, np.zeros(3))
    boundary = BoundaryConditions(positions[0], IDENTITY, positions[-1])
    by_shapes = holder._turns_by_shapes(positions, quaternions, boundary)
    assert by_shapes.shape == (3, ticks + 1, 3)
    turns = np.einsum("akn,kwn->aw", by_shapes, waves)
    size = float(np.abs(turns).max())
    for number in (0, 1, 5, 8, 13, 18, 19, 20):
        h = 1e-4
        after, before = (end(positions + sign * h * waves[:, number]) for sign in (1, -1))
        exact = (before.inv() * after).as_rotvec() / (2 * h)
        np.testing.assert_allclose(turns[:, number], exact, atol=0.02 * size)


def test_commands_end_on_the_goal_by_another_integration(
    model: ManoeuvreModel, holder: Any
) -> None:
    """The goal is a little off the turn of the path, and its last shape a little off, too."""
    positions = smooth(40)
    turn = Rotation.from_quat(model.prediction.attitudes(positions, IDENTITY, np.zeros(3))[-1])
    goal = turn * Rotation.from_rotvec([2e-3, -1e-3, 1.5e-3])
    final = FINAL + np.array([1e-3, -2e-3, 5e-4])
    boundary = BoundaryConditions(START, goal.as_quat(), final, final)
    held = holder._adjust_to_goal(positions, boundary, final, LIMITS, moves_end=False)
    np.testing.assert_array_equal(held.positions[[0, -1]], [START, final])
    assert held.end_error <= 1e-11
    attitude = Rotation.identity()
    for q, q_next in zip(held.positions[:-1], held.positions[1:], strict=True):
        for k in range(10):
            A = model.robot.connection(q + (k + 0.5) / 10 * (q_next - q))[3:]
            attitude *= Rotation.from_rotvec(-A @ (q_next - q) / 10)
    assert (attitude.inv() * goal).magnitude() < 1e-5
    far = turn * Rotation.from_rotvec([2.0, -1.0, 1.5])
    unreached = replace(boundary, goal_rotation=far.as_quat())
    assert holder._adjust_to_goal(positions, unreached, final, LIMITS, moves_end=False) is None


# -- stretching ---------------------------------------------------------------------------------


class Stretched(CommandHolder):
    """A holder whose adjustments are scripted, and which says in how many ticks it was asked."""

    def __init__(self, model: ManoeuvreModel, found: bool = True) -> None:
        super().__init__(model)
        self.found, self.asked = found, []  # type: ignore[var-annotated]
        self.fitted: list[tuple[int, bool]] = []

    def _fit_to_limits(self, positions: Array, *_: object, moves_end: bool) -> HeldCommands | None:
        self.fitted.append((len(positions) - 1, moves_end))
        return None

    def _adjust_to_goal(
        self, positions: Array, *_: object, moves_end: bool, clipped: bool = False
    ) -> HeldCommands | None:
        self.asked.append((len(positions) - 1, moves_end, clipped))
        if not self.found:
            return None
        return HeldCommands(positions, np.tile(IDENTITY, (len(positions), 1)), 0.0)


def straight(duration: float, speed: float) -> Trajectory:
    """Return a path of the first joint at a speed, in one step."""
    shapes = np.array([[0.0, 0, 0], [speed * duration, 0, 0]])
    velocities = np.array([[speed, 0.0, 0.0]] * 2)
    return Trajectory(duration, shapes, velocities, np.tile(IDENTITY, (2, 1)))


WIDE = MotionLimits(np.full(3, -99.0), np.full(3, 99.0), np.full(3, 1.0), np.full(3, 1e9))
FREE = BoundaryConditions(np.zeros(3), IDENTITY, np.zeros(3))
GIVEN = BoundaryConditions(np.zeros(3), IDENTITY, np.zeros(3), np.zeros(3))


@pytest.mark.parametrize(("boundary", "ends"), [(FREE, [False, True]), (GIVEN, [False])])
def test_the_end_moves_where_it_is_free_and_all_else_fails(
    model: ManoeuvreModel, boundary: BoundaryConditions, ends: list[bool]
) -> None:
    holder = Stretched(model, found=False)
    assert holder.hold(straight(4.0, 0.9), boundary, WIDE, fixed=True) is None
    assert [moves_end for _, moves_end, _ in holder.asked] == ends


def ticks_of(holder: Stretched) -> list[int]:
    return list(dict.fromkeys(ticks for ticks, _, _ in holder.asked))


@pytest.mark.parametrize(
    ("duration", "speed", "ticks"),
    [
        (4.0, 1.0, [40]),
        # 0.019 of a tick is rounding, 0.021 is not.
        (4.0019, 1.0, [40, 41]),
        (4.0021, 0.99, [41]),
        (0.01, 0.01, [1]),
        # All shapes are changed at four numbers of ticks, a hundredth apart, in vain. 1.2 times too
        # fast: 48 ticks; 1.24 times: 50 of the 54 that are allowed.
        (4.0, 1.2, [40, 41, 42, 43, 48]),
        (4.0, 1.24, [40, 41, 42, 43, 50]),
        (12.0, 1.24, [120, 122, 124, 126, 149]),
        (4.0, 1.36, [40, 41, 42, 43]),
    ],
)
def test_paths_are_stretched_by_as_much_as_they_are_too_fast(
    model: ManoeuvreModel, duration: float, speed: float, ticks: list[int]
) -> None:
    holder = Stretched(model)
    held = holder.hold(straight(duration, speed), GIVEN, WIDE)
    assert ticks_of(holder) == ticks
    assert (held is None) == (speed > 1.3)
    if held is not None:
        assert len(held.positions) - 1 == ticks[-1]
    assert holder.fitted == [(each, False) for each in ticks[: min(4, len(ticks) - (speed < 1.3))]]


def test_a_given_time_is_not_stretched(model: ManoeuvreModel) -> None:
    holder = Stretched(model)
    assert holder.hold(straight(4.0, 1.01), GIVEN, WIDE, fixed=True) is None
    assert ticks_of(holder) == [40]


def test_short_polygons_get_corners_until_they_are_smooth(model: ManoeuvreModel) -> None:
    holder = Stretched(model, found=False)
    assert holder.hold(straight(1.6, 1.0), GIVEN, WIDE) is None
    assert ticks_of(holder) == [16, 17, 18, 19, 20]
    smooth = Stretched(model, found=False)
    assert smooth.hold(straight(2.0, 1.0), GIVEN, WIDE) is None
    assert ticks_of(smooth) == [20]


def test_a_free_last_shape_is_moved_where_the_path_alone_fails(model: ManoeuvreModel) -> None:
    for boundary, moves in ((GIVEN, [False]), (FREE, [False, True])):
        holder = Stretched(model, found=False)
        assert holder.hold(straight(4.0, 1.0), boundary, WIDE) is None
        assert [each[1] for each in holder.asked] == moves


def test_shapes_beyond_the_ends_of_joints_are_clipped_once_more(model: ManoeuvreModel) -> None:
    holder = Stretched(model)
    tight = replace(WIDE, upper=np.array([3.9, 99.0, 99.0]))
    assert holder.hold(straight(4.0, 1.0), GIVEN, tight) is None
    assert holder.asked == [(40, False, False), (40, False, True)]


def test_efforts_stretch_a_path_too(model: ManoeuvreModel) -> None:
    class Efforts:
        def excess(self, positions: Array, before: object, L_B: object, after: object) -> float:
            return 46.0 / (len(positions) - 1)

    limited: Any = replace(model, efforts=Efforts())  # type: ignore[arg-type]
    holder = Stretched(limited)
    held = holder.hold(straight(4.0, 1.0), GIVEN, WIDE)
    assert held is not None
    assert ticks_of(holder) == [40, 46]
    assert holder.fitted == []


@pytest.mark.parametrize(("free", "before"), [(False, 0.0), (True, np.array([0.02, 0.0, -0.03]))])
def test_all_shapes_are_changed_where_waves_exceed_a_limit(
    model: ManoeuvreModel, holder: Any, free: bool, before: Any
) -> None:
    """One joint moves at the limit of its velocity, to a goal 3 mrad from the turn of the path."""
    positions = START + np.linspace(0.0, 1.0, 41)[:, np.newaxis] * (FINAL - START)
    speed = np.abs(FINAL - START) / 4.0
    fast = replace(LIMITS, velocity=speed * [1.01, 1.8, 2.1], acceleration=np.full(3, 1e3))
    turn = Rotation.from_quat(model.prediction.attitudes(positions, IDENTITY, np.zeros(3))[-1])
    goal = (turn * Rotation.from_rotvec([1e-3, -2e-3, 2e-3])).as_quat()
    final = None if free else FINAL
    boundary = BoundaryConditions(START, goal, FINAL, final)
    velocities = np.tile((FINAL - START) / 4.0, (41, 1))
    trajectory = Trajectory(PERIOD, positions, velocities, np.tile(IDENTITY, (41, 1)))
    by_waves = holder._adjust_to_goal(positions, boundary, FINAL, fast, moves_end=False)
    assert fast.excess(by_waves.positions, PERIOD, before)[0] > 1
    held = holder.hold(trajectory, boundary, fast, fixed=True, before=before)
    assert held is not None
    assert len(held.positions) == 41
    assert held.end_error <= 1e-8
    factor, overrun = fast.excess(held.positions, PERIOD, before)
    assert factor <= 1 + 1e-9
    assert overrun <= 1e-9
    np.testing.assert_array_equal(held.positions[0], START)
    assert free != bool(np.all(held.positions[-1] == FINAL))
    end = model.prediction.attitudes(held.positions, IDENTITY, np.zeros(3))[-1]
    assert (Rotation.from_quat(goal).inv() * Rotation.from_quat(end)).magnitude() < 1e-8
    slow = replace(fast, velocity=speed * [0.999, 1.8, 2.1])
    assert holder.hold(trajectory, replace(boundary, final=FINAL), slow, fixed=True) is None
