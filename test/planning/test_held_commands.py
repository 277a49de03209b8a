"""Waves and ramps of held commands, their first variation, and how often paths are stretched."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

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


@pytest.fixture(scope="module")
def model() -> ManoeuvreModel:
    arm = SpaceRobot.from_file(robot_file("three_joint_arm"))
    prediction = BasePrediction(arm, PERIOD, 0.01)
    return ManoeuvreModel(arm, prediction, PERIOD, np.eye(3), PathConstraints())


@pytest.fixture(scope="module")
def holder(model: ManoeuvreModel) -> Any:
    return CommandHolder(model)


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
