"""The steps of lie_bracket by themselves: slides, strokes, amplitudes, and cycles."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.sliding_robots import Slider, SlidingRobot
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal, RobotState
from spacerobot_ros.planning.methods import lie_bracket
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


@pytest.fixture(scope="module")
def method() -> Any:
    return gait()


@pytest.mark.parametrize(("period", "ticks"), [(1.3, 26), (0.63, 13), (0.5, 12), (0.1, 12)])
def test_a_cycle_has_whole_ticks_and_twelve_at_least(period: float, ticks: int) -> None:
    assert gait(cycle_period=period).ticks_a_cycle == ticks


def test_a_slide_follows_the_profile_of_the_paper(method: Any) -> None:
    z0, z_f = np.array([0.1, -0.2, 0.3]), np.array([0.4, -0.1, 0.3])
    shapes = method._slide_shapes(z0, z_f)
    t = np.linspace(0.0, 5.0, 101)
    # The integral of c sin^2(2 pi n1 t / t1), by the trapezoid rule on a fine grid.
    fine = np.linspace(0.0, 5.0, 100001)
    speed = np.sin(2 * np.pi * 3 * fine / 5.0) ** 2
    way = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2)]) * 5e-5
    for joint in range(3):
        c = 2 * (z_f - z0)[joint] / 5.0
        np.testing.assert_allclose(
            shapes[:, joint], z0[joint] + c * np.interp(t, fine, way), atol=1e-8
        )
    np.testing.assert_array_equal(shapes[-1], z_f)


@pytest.mark.parametrize(
    ("t1", "n1", "ticks"), [(5.0, 3, 100), (5.01, 3, 101), (5.0, 30, 120), (0.1, 1, 4)]
)
def test_a_slide_has_four_ticks_a_period_at_least(t1: float, n1: int, ticks: int) -> None:
    shapes = gait(t1=t1, n1=n1)._slide_shapes(np.zeros(3), np.array([1e-6, 0.0, 2e-6]))
    assert len(shapes) - 1 == ticks


def test_a_slide_of_nothing_is_one_shape(method: Any) -> None:
    z = np.array([0.1, -0.2, 0.3])
    assert method._slide_shapes(z, z + 0.9e-9).shape == (1, 3)
    assert len(method._slide_shapes(z, z + np.array([0.0, 1.1e-9, 0.0]))) == 101


def test_a_slide_takes_as_long_as_the_slowest_slider(method: Any) -> None:
    # Twice the mean speed at the peak: 2 * 1.2 / 0.3.
    assert method._slide_time(np.array([1.0, -1.2, 0.5])) == pytest.approx(8.0)
    assert method._slide_time(np.array([1.0, -0.7, 0.5])) == 5.0
    brief = gait(longest=7.9)
    with pytest.raises(PlanningError) as refusal:
        brief._slide_time(np.array([1.0, -1.2, 0.5]))
    assert str(refusal.value) == (
        "The slide would take more than 7.9 s: joint 's2' is to move 1.2 m at no more than 0.3 m/s."
    )


@pytest.mark.parametrize("ratios", [(1.0, 1.0), (1.7, 0.6)])
def test_amplitudes_have_the_products_of_the_paper(ratios: tuple[float, float]) -> None:
    method = gait(a22_ratio=ratios[0], a31_ratio=ratios[1])
    alpha = np.array([0.02, -0.03, 0.05])
    b11, b12, b21, a22, a31 = method._cycle_amplitudes(alpha)
    # Polygons of 26 ticks a cycle lose by the chords of once and twice the frequency.
    first, second = (np.sin(2 * np.pi * k / 26) / (2 * np.pi * k / 26) for k in (1, 2))
    assert a22 * b12 * second == pytest.approx(2 * 0.02 / np.pi)
    assert a31 * b21 * first == pytest.approx(-0.03 / np.pi)
    assert a31 * b11 * first == pytest.approx(0.05 / np.pi)
    assert a22 == pytest.approx(ratios[0] * np.sqrt(2 * 0.02 / np.pi))
    assert a31 == pytest.approx(ratios[1] * np.sqrt(np.hypot(0.03, 0.05) / np.pi))
    np.testing.assert_array_equal(method._cycle_amplitudes(np.zeros(3)), 0.0)
    only = method._cycle_amplitudes(np.array([-0.02, 0.0, 0.0]))
    np.testing.assert_array_equal(only[[0, 2, 4]], 0.0)
    assert only[1] * only[3] < 0


def test_a_cycle_is_the_integral_of_the_paper_s_velocities(method: Any) -> None:
    amplitudes = np.array([0.3, -0.2, 0.4, 0.25, -0.35])
    z_f = np.array([0.1, 0.2, -0.3])
    shapes = method._cycle_shapes(amplitudes, 4, (2, 0, 1), z_f)
    b11, b12, b21, a22, a31 = amplitudes / 2
    phi = np.linspace(0.0, 2 * np.pi, 26 * 400 + 1)
    velocities = (
        b11 * np.sin(phi) + b12 * np.sin(2 * phi),
        b21 * np.sin(phi) + a22 * (np.cos(2 * phi) - np.cos(3 * phi)),
        a31 * (np.cos(phi) - np.cos(3 * phi)),
    )
    for joint, v in zip((2, 0, 1), velocities, strict=True):
        way = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) / 2)]) * phi[1]
        np.testing.assert_allclose(shapes[:, joint], z_f[joint] + way[::400], atol=1e-6)
    np.testing.assert_array_equal(shapes[-1], z_f)


def test_the_first_number_of_cycles_is_by_the_area_of_loops() -> None:
    method = gait(loop_area=0.04)
    z_f = np.zeros(3)
    alpha = np.array([0.012, -0.016, 0.0])
    for scale, least, cycles in ((1.0, 0, 1), (1.99, 0, 1), (2.01, 0, 2), (1.0, 7, 7)):
        turn = gait(loop_area=0.04, cycle_period=60.0)._fit_to_limits(
            scale * alpha, (0, 1, 2), z_f, least
        )
        assert turn.cycles == cycles
        np.testing.assert_allclose(turn.alpha, scale * alpha)
    # With the slowest rate exceeded by a factor f, f^2 * 1.001 cycles and one more.
    amplitudes = method._cycle_amplitudes(alpha)
    shapes = method._cycle_shapes(amplitudes, 1, (0, 1, 2), z_f)
    rates = np.abs(np.diff(shapes, axis=0)).max(axis=0) / PERIOD
    excess = (rates / np.array([0.7, 0.3, 0.5])).max()
    assert excess > 1.5
    turn = method._fit_to_limits(alpha, (0, 1, 2), z_f, 0)
    assert turn.cycles == int(np.ceil(excess**2 * 1.001)) + 1


def test_a_turn_that_would_take_too_long_names_the_final_shape() -> None:
    method = gait(longest=1.29)
    with pytest.raises(PlanningError) as refusal:
        method._fit_to_limits(np.array([0.012, -0.016, 0.01]), (0, 1, 2), np.full(3, 0.12344), 0)
    assert str(refusal.value) == (
        "The turn would take more than 1.29 s within the strokes and rates of the sliders at the "
        "final shape [0.1234, 0.1234, 0.1234]; a goal that leaves the sliders more room takes less."
    )


@pytest.mark.parametrize(("slide", "cycles"), [(450, 0), (30, 250), (1, 7)])
def test_the_path_has_poses_of_the_slide_and_of_the_ends_of_cycles(
    method: Any, slide: int, cycles: int
) -> None:
    attitude = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_quat()
    state = RobotState(np.array([0.3, -0.1, 0.2]), attitude, np.zeros(3))
    shapes = np.linspace(np.zeros(3), np.array([0.2, -0.1, 0.3]), slide)
    attitudes = method._prediction.attitudes(shapes, state.quaternion, np.zeros(3))
    cycle = method._cycle_shapes(np.array([0.3, -0.2, 0.4, 0.25, -0.35]), 9, (0, 1, 2), shapes[-1])
    path = method._predict_path(state, shapes, attitudes, cycle, cycles)
    stride = max(1, slide // 100)
    ticks = [*range(0, slide - 1, stride), slide - 1]
    done = [*range(2, cycles, 2), cycles] if cycles == 250 else [*range(1, cycles + 1)]
    expected = [*ticks, *(slide - 1 + 26 * k for k in done)]
    np.testing.assert_allclose(path.time / PERIOD, expected)
    if cycles:
        once = method._prediction.attitudes(cycle, np.array([0.0, 0, 0, 1]), np.zeros(3))[-1]
        turned = Rotation.from_rotvec(cycles * Rotation.from_quat(once).as_rotvec())
        end = Rotation.from_quat(attitudes[-1]) * turned
        assert (end.inv() * Rotation.from_quat(path.quaternion[-1])).magnitude() < 1e-9
    # The centre of mass rests.
    for r, X, q in zip(
        path.position[[0, -1]], path.quaternion[[0, -1]], shapes[[0, -1]], strict=True
    ):
        center = r + Rotation.from_quat(X).apply(ROBOT.center_of_mass(q))
        first = state.position + Rotation.from_quat(state.quaternion).apply(
            ROBOT.center_of_mass(shapes[0])
        )
        np.testing.assert_allclose(center, first, atol=1e-9)


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


def test_brackets_are_minus_the_curvature_of_pairs(method: Any) -> None:
    z = np.array([0.3, -0.2, 0.4])
    triple, brackets = method._best_triple(z)
    assert triple == (0, 1, 2)
    # A small square of two sliders turns the base by its area times the bracket.
    side = 1e-3
    for column, (i, j) in enumerate(((0, 1), (1, 2), (0, 2))):
        u, v = side * np.eye(3)[i], side * np.eye(3)[j]
        corners = np.array([z, z + u, z + u + v, z + v, z]) - (u + v) / 2
        fine = np.vstack([np.linspace(a, b, 41)[:-1] for a, b in pairwise(corners)])
        fine = np.vstack([fine, corners[-1:]])
        turned = ROBOT.attitudes(fine, PERIOD, Rotation.identity())[-1].as_rotvec()
        np.testing.assert_allclose(-turned / side**2, brackets[:, column], atol=1e-4)


def test_brackets_of_too_large_a_condition_number_are_refused(
    method: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    z = np.array([0.3, -0.20004, 0.4])
    condition = float(np.linalg.cond(method._best_triple(z)[1]))
    monkeypatch.setattr(lie_bracket, "MAX_CONDITION", condition)
    with pytest.raises(PlanningError) as refusal:
        method._best_triple(z)
    assert str(refusal.value) == (
        "The first-order Lie brackets of the sliders do not span the three axes of rotation at the "
        f"final shape [0.3, -0.2, 0.4] (condition number {condition:.2g}): the attitude cannot be "
        "controlled there by lie_bracket."
    )
