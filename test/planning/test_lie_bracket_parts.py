"""The steps of lie_bracket by themselves: slides, strokes, amplitudes, and cycles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.sliding_robots import Slider, SlidingRobot

from spacerobot_ros.errors import Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal, RobotState
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait, LieBracketOptions
from spacerobot_ros.planning.methods.registry import build_method

Array = npt.NDArray[np.float64]

PERIOD = 0.05
ROBOT = SlidingRobot(
    10.0,
    np.diag([1.0, 1.5, 1.2]),
    np.array([0.05, -0.02, 0.03]),
    (
        Slider(2.0, np.array([0.0, 1.0, 0.0]), np.array([0.1, 0.0, 0.2]), rate=0.7),
        Slider(1.5, np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.2, 0.0]), rate=0.3),
        Slider(3.0, np.array([0.8, 0.0, -0.6]), np.array([0.0, 0.1, -0.1]), rate=0.5),
    ),
)


def gait(robot: SlidingRobot = ROBOT, **options: Any) -> Any:
    chosen = LieBracketOptions(**{"t1": 5.0, "n1": 3, "cycle_period": 1.3, **options})
    model = SpaceRobot.from_urdf(robot.urdf)
    made = build_method("lie_bracket", model, PERIOD, 0.01, {"lie_bracket": chosen})
    assert isinstance(made, LieBracketGait)
    return made


@pytest.mark.parametrize(("period", "ticks"), [(1.3, 26), (0.63, 13), (0.5, 12), (0.1, 12)])
def test_a_cycle_has_whole_ticks_and_twelve_at_least(period: float, ticks: int) -> None:
    assert gait(cycle_period=period).ticks_a_cycle == ticks


# -- strokes ------------------------------------------------------------------------------------


def beyond(robot: SlidingRobot, z_f: Array, enough: float = 0.0) -> Array:
    """Return the final shape for the pose in which the robot has a shape."""
    z0 = np.full(len(robot.sliders), 0.1)
    shift = robot.center_of_mass(z0) - robot.center_of_mass(z_f)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), z0)
    found: Array = gait(robot).final_shape(state, Goal.checked(shift, [0.0, 0, 0, 1]), enough)
    return found


def test_a_stroke_that_is_too_short_is_named_with_its_ends() -> None:
    short = replace(ROBOT.sliders[1], stroke=(-0.7, 0.4))
    robot = replace(ROBOT, sliders=(ROBOT.sliders[0], short, ROBOT.sliders[2]))
    np.testing.assert_allclose(beyond(robot, np.array([0.5, 0.4, -1.0])), [0.5, 0.4, -1.0])
    with pytest.raises(UnreachableError) as refusal:
        beyond(robot, np.array([0.5, 0.45, -1.0]))
    assert refusal.value.proof is Proof.LIMITS
    assert str(refusal.value) == (
        "The goal is beyond stroke: it needs joint 's2' at 0.45 m, and its stroke is [-0.7, 0.4] m."
    )
    # 0.05 m of 1.5 of 16.5 kg: where the position may miss by that, the stroke is used up.
    near = beyond(robot, np.array([0.5, 0.45, -1.0]), 0.0046)
    np.testing.assert_allclose(near[1], 0.4, atol=1e-9)
    with pytest.raises(UnreachableError):
        beyond(robot, np.array([0.5, 0.45, -1.0]), 0.0045)


def test_four_sliders_share_a_way_within_their_strokes_or_say_how_near_they_come() -> None:
    fourth = Slider(2.5, np.array([0.0, 0.8, 0.6]), np.array([0.0, 0.0, 0.1]), stroke=(-0.2, 0.3))
    sliders = tuple(replace(each, stroke=(-0.4, 0.6)) for each in ROBOT.sliders)
    robot = replace(ROBOT, sliders=(*sliders, fourth))
    z = np.array([0.55, -0.35, 0.5, 0.25])
    found = beyond(robot, z)
    np.testing.assert_allclose(robot.center_of_mass(found), robot.center_of_mass(z), atol=1e-9)
    lower, upper = np.array([-0.4, -0.4, -0.4, -0.2]), np.array([0.6, 0.6, 0.6, 0.3])
    assert np.all((found >= lower) & (found <= upper))
    with pytest.raises(
        UnreachableError, match=r"^The goal is beyond stroke: 4 sliders put"
    ) as said:
        beyond(robot, np.array([0.9, -0.35, 0.5, 0.3]))
    # By another solver: bounded least squares, gradient by gradient.
    P = np.column_stack([s.mass * s.direction for s in robot.sliders]) / robot.total_mass
    aim = P @ (np.array([0.9, -0.35, 0.5, 0.3]) - 0.1)
    x = np.zeros(4)
    for _ in range(2000):
        x = np.clip(x - 5.0 * P.T @ (P @ x - aim), lower - 0.1, upper - 0.1)
    gap = float(np.linalg.norm(P @ x - aim))
    assert str(said.value).endswith(f"put the base no nearer than {gap:.3g} m to it.")
