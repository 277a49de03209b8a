"""Parts of resolved_rate on made-up lines, whose ways, rates and singularities are known."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.cancellation import NEVER
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits
from spacerobot_ros.planning.methods.resolved_rate import (
    JointPath,
    ResolvedRateGait,
    _fastest_speeds,
    _LinkPath,
    _LinkPaths,
    _SmoothPath,
    _TimedPath,
    trace_joint_path,
)

Array = npt.NDArray[np.float64]

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])


# -- ways ---------------------------------------------------------------------------------------


def test_a_way_through_points_is_a_natural_spline_by_the_lengths_of_its_chords() -> None:
    points = np.array([[0.0, 0, 0], [0.3, 0.4, 0], [0.3, 0.4, 1.2], [1.3, 0.4, 1.2]])
    way = _SmoothPath(points)
    assert way.length == pytest.approx(0.5 + 1.2 + 1.0)
    assert not way.is_straight
    spline = CubicSpline(np.array([0.0, 0.5, 1.7, 2.7]) / 2.7, points, bc_type="natural")
    for share in (0.0, 0.1, 0.4, 0.9, 1.0):
        np.testing.assert_allclose(way.displacement(share), spline(share), atol=1e-12)
        np.testing.assert_allclose(way.displacement_derivative(share), spline(share, 1), atol=1e-12)


def test_points_that_come_twice_are_no_way_and_two_are_a_straight_one() -> None:
    points = np.array([[0.0, 0, 0], [0.0, 0, 0], [0.6, 0.0, -0.8], [0.6, 0.0, -0.8]])
    way = _SmoothPath(points)
    assert way.is_straight
    assert way.length == pytest.approx(1.0)
    np.testing.assert_allclose(way.displacement(0.25), [0.15, 0.0, -0.2], atol=1e-15)
    np.testing.assert_allclose(way.displacement_derivative(0.7), [0.6, 0.0, -0.8], atol=1e-14)
    none = _SmoothPath(points[:2])
    assert (none.is_straight, none.length) == (True, 0.0)
    np.testing.assert_array_equal(none.displacement(0.5), 0.0)
    np.testing.assert_array_equal(none.displacement_derivative(0.5), 0.0)
    three = _SmoothPath(np.array([[0.0, 0, 0], [1.0, 0, 0], [1.0, 0.2, 0]]))
    assert not three.is_straight


def test_the_error_of_a_link_is_seen_along_its_directions() -> None:
    turn = np.array([0.0, 0.0, 0.8])
    line = _LinkPath(
        "hand",
        np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
        np.array([[0.0, 0.0, 1.0]]),
        np.array([0.5, -0.2, 0.1]),
        Rotation.from_rotvec([0.3, 0.1, 0.0]).as_quat(),
        _SmoothPath(np.array([[0.0, 0, 0], [2.0, 1.0, 0.0]]), turn),
    )
    wanted = Rotation.from_rotvec(0.25 * turn) * Rotation.from_rotvec([0.3, 0.1, 0.0])
    off = Rotation.from_rotvec([0.0, 0.0, 0.05])
    found = line.tracking_error((off.inv() * wanted).as_matrix(), np.array([0.9, 0.1, 7.0]), 0.25)
    # At a quarter, 0.5 m and 0.25 m on: the y comes first, as the directions say.
    np.testing.assert_allclose(found, [-0.2 + 0.25 - 0.1, 0.5 + 0.5 - 0.9, 0.05], atol=1e-12)


# -- the trace ----------------------------------------------------------------------------------


class Arc:
    """A line along x that a joint follows by ``x = radius sin q``: singular at a quarter turn.

    A second joint moves along, with another weight, and its motion is no progress.
    """

    def __init__(self, length: float, radius: float = 1.0) -> None:
        self.length, self.radius = length, radius
        self.joint_scales, self.curvature_breaks = np.array([1.0, 0.25]), np.zeros(0)
        self.asked: list[float] = []

    def tangent(self, q: Array, X: Array, share: float) -> tuple[Array, Array, float]:
        self.asked.append(share)
        forward = math.copysign(1.0, math.cos(q[0]))
        omega = np.array([0.0, 0.0, 0.4 * forward])
        x, y, z, w = X
        X_rate = np.array([y * omega[2], -x * omega[2], w * omega[2], -z * omega[2]]) / 2
        return forward * np.array([1.0, 0.5]), X_rate, self.radius * abs(math.cos(q[0]))


def test_a_line_before_the_singularity_is_followed_to_its_end() -> None:
    arc: Any = Arc(0.5)
    path = trace_joint_path(arc, np.array([0.0, 0.2]), NEVER)
    assert path.is_complete
    assert path.path_fractions[-1] == 1.0
    assert path.shapes[-1] == pytest.approx([math.asin(0.5), 0.2 + 0.5 * math.asin(0.5)], abs=1e-7)
    assert path.arc_length[-1] == pytest.approx(math.asin(0.5), abs=1e-7)
    np.testing.assert_allclose(path.path_fractions, 2 * np.sin(path.shapes[:, 0]), atol=1e-7)
    np.testing.assert_allclose(path.progress_rate, np.cos(path.shapes[:, 0]), atol=1e-12)
    np.testing.assert_allclose(path.arc_length, path.shapes[:, 0], atol=1e-9)
    turned = [[0.0, 0.0, 0.4 * s] for s in path.arc_length]
    expected = Rotation.from_rotvec(turned)
    assert (expected.inv() * Rotation.from_quat(path.turns)).magnitude().max() < 1e-7
    np.testing.assert_allclose(np.linalg.norm(path.turns, axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(np.diff(path.arc_length)[:26], 0.02, atol=1e-12)
    assert max(arc.asked) <= 1.0


def test_a_short_line_is_followed_in_twenty_steps() -> None:
    path = trace_joint_path(Arc(0.3, radius=2.0), np.zeros(2), NEVER)  # type: ignore[arg-type]
    np.testing.assert_allclose(np.diff(path.arc_length)[:19], 0.3 / 20 / 2.0, atol=1e-12)
    assert path.is_complete


def test_a_trace_ends_at_the_singularity_and_never_beyond() -> None:
    arc: Any = Arc(3.0, radius=1.5)
    path = trace_joint_path(arc, np.array([0.1, 0.0]), NEVER)
    assert not path.is_complete
    assert path.shapes[-1, 0] == pytest.approx(math.pi / 2, abs=1e-6)
    assert path.shapes[:, 0].max() <= math.pi / 2 + 1e-9
    assert path.path_fractions[-1] == pytest.approx((1.5 - 1.5 * math.sin(0.1)) / 3.0, abs=1e-7)
    assert 0.0 <= path.progress_rate[-1] <= 1e-8
    steps = np.diff(path.arc_length)
    assert np.all(steps > 0)
    # On the way there no step is longer than a quarter of what is left.
    left = math.pi / 2 - path.shapes[:-1, 0]
    near = (left < 0.1) & (left > 1e-3)
    assert near.sum() > 5
    assert np.all(steps[near] < 0.3 * left[near])
    assert np.all(steps[near] > 0.15 * left[near])


def test_the_path_up_to_a_place_has_that_place() -> None:
    path = trace_joint_path(Arc(0.5), np.zeros(2), NEVER)  # type: ignore[arg-type]
    part = path.truncated(3)
    assert [len(x) for x in vars(part).values()] == [4] * 5
    np.testing.assert_array_equal(part.shapes[-1], path.shapes[3])
    assert not part.is_complete


# -- time ---------------------------------------------------------------------------------------

LIMITS = MotionLimits(
    np.array([-9.0, -9.0]), np.array([9.0, 9.0]), np.array([1.0, 0.6]), np.array([2.0, 3.0])
)


def test_a_straight_path_is_begun_and_ended_with_the_least_acceleration() -> None:
    """The first joint's acceleration of 0.99 * 2 to a cruise at the second one's speed, 0.6."""
    slopes = np.tile([1.0, 1.0], (41, 1))
    squares = _fastest_speeds(slopes, np.zeros((41, 2)), LIMITS, 0.02)
    s = np.minimum(np.arange(41), 40 - np.arange(41)) * 0.02
    np.testing.assert_allclose(squares, np.minimum(2 * 1.98 * s, 0.36), atol=1e-9)
    half = _fastest_speeds(0.5 * slopes, np.zeros((41, 2)), LIMITS, 0.02)
    np.testing.assert_allclose(half, np.minimum(4 * 1.98 * s, 1.44), atol=1e-9)


def test_a_bent_path_is_slower_where_it_bends() -> None:
    """On a circle of radius 0.5, centripetal acceleration alone is at the limits."""
    angle = np.linspace(0.0, 2 * np.pi, 161)
    slopes = np.column_stack([-np.sin(angle), np.cos(angle)])
    bends = np.column_stack([-np.cos(angle), -np.sin(angle)]) / 0.5
    interval = np.pi / 160
    equal = MotionLimits(LIMITS.lower, LIMITS.upper, np.full(2, 9.0), np.array([2.0, 3.0]))
    squares = _fastest_speeds(slopes, bends, equal, interval)
    assert squares[0] == squares[-1] == pytest.approx(0.0, abs=1e-9)
    # Both ends of each interval keep the limits, with x' constant in it.
    change = np.diff(squares)[:, np.newaxis] / (2 * interval)
    for at, x in ((slice(None, -1), squares[:-1]), (slice(1, None), squares[1:])):
        acceleration = bends[at] * x[:, np.newaxis] + slopes[at] * change
        assert np.all(np.abs(acceleration) <= 0.99 * equal.acceleration * (1 + 1e-7))
        assert np.abs(acceleration / equal.acceleration).max() > 0.98
    assert squares.max() > 0.9 * 0.99 * 2.0 * 0.5


def joint_path(length: float) -> JointPath:
    s: Array = np.array([length * k / 29 for k in range(30)])
    return JointPath(
        s, np.column_stack([s, 0.5 * s]), np.tile(IDENTITY, (30, 1)), s / length, np.ones(30)
    )


def test_shapes_at_ticks_are_those_of_the_fastest_motion() -> None:
    """0.3 s to the full speed of 0.6 along the first joint, and as long to brake."""
    limits = MotionLimits(
        LIMITS.lower, LIMITS.upper, np.array([0.6, 9.0]), np.array([2.0 / 0.99, 9.0])
    )
    timed = _TimedPath.of(joint_path(0.9), limits)
    total = 0.3 + 0.3 + (0.9 - 0.18) / 0.6
    assert timed.time[-1] == pytest.approx(total, rel=2e-3)
    assert timed.arc_length_step == pytest.approx(0.9 / 160)
    shapes, shares = timed.at_ticks(36)
    t = np.linspace(0.0, total, 37)
    r = np.minimum(t, total - t)
    ramp = np.where(r < 0.3, r**2, 0.6 * r - 0.09)
    exact = np.where(t <= total / 2, ramp, 0.9 - ramp)
    np.testing.assert_allclose(shapes[:, 0], exact, atol=2e-3)
    np.testing.assert_allclose(shapes[:, 1], 0.5 * shapes[:, 0], atol=1e-12)
    np.testing.assert_allclose(shares, shapes[:, 0] / 0.9, atol=1e-12)
    np.testing.assert_allclose(shapes[[0, -1], 0], [0.0, 0.9], atol=1e-12)
    assert shares[-1] == 1.0
    one, _ = timed.at_ticks(1)
    np.testing.assert_allclose(one, [[0.0, 0.0], [0.9, 0.45]], atol=1e-12)


# -- what is in the way -------------------------------------------------------------------------


def obstacle(
    progress: list[float],
    shapes: list[list[float]],
    *,
    complete: bool = False,
    straight: bool = True,
) -> tuple[int, str] | None:
    """Return what stands in the way of a path on lines that know their places."""
    joints = [SimpleNamespace(name="hip"), SimpleNamespace(name="knee")]
    robot = SimpleNamespace(
        lower=np.array([-1.0, -2.0]),
        upper=np.array([1.5, 2.5]),
        description=SimpleNamespace(movable_joints=joints),
    )
    K = len(progress)
    shares = np.linspace(0.0, 1.0 if complete else 0.8, K)
    path = JointPath(
        np.array([0.1 * k for k in range(K)]),
        np.array(shapes),
        np.arange(4.0 * K).reshape(K, 4),
        shares,
        np.array(progress),
    )

    def measure(q: Array, X: Array) -> tuple[str, float]:
        assert X[0] == 4 * np.flatnonzero((path.shapes == q).all(axis=1))[0]
        return "|det J*|", 10.0 + q[0]

    lines = SimpleNamespace(
        position_text=lambda share: f"after {share:.3g}",
        singularity_measure=measure,
        is_straight=straight,
    )
    method: Any = SimpleNamespace(robot=robot)
    return ResolvedRateGait._find_obstacle(method, lines, path)  # type: ignore[arg-type]


SHAPES = [[0.1 * k, 0.2 * k] for k in range(5)]


def test_a_free_way_has_nothing_in_it() -> None:
    assert obstacle([0.5, 0.4, 0.3, 0.2, 0.01], SHAPES) is None
    at_limits = [[1.5, 2.5], [-1.0, -2.0], [1.5, -2.0 - 1e-10]]
    assert obstacle([0.5] * 3, at_limits) is None


def test_a_joint_at_its_limit_is_named_with_its_place() -> None:
    shapes = [*SHAPES[:3], [0.4, 2.6], [1.6, 3.0]]
    assert obstacle([0.5, 0.4, 0.3, 0.2, 0.001], shapes) == (
        2,
        "Joint 'knee' is at its limit after 0.6: optimal may reach the goal off the line, as may a "
        "line from another shape.",
    )
    shapes = [*SHAPES[:3], [-1.6, -2.1], [0.0, 0.0]]
    found = obstacle([0.5] * 5, shapes)
    assert found is not None
    assert found[1].startswith("Joint 'hip' is at its limit after 0.6: ")


def test_a_singularity_is_described_by_its_measure_and_its_shape() -> None:
    tail = "optimal may reach the goal off the line, as may a line from another shape."
    assert obstacle([0.5, 0.4, 0.009, 0.003, 0.001], SHAPES) == (
        1,
        "The straight line meets a dynamic singularity after 0.8: |det J*| falls from 10 to zero "
        f"at the shape (0.4, 0.8), where no rates of the joints lead on. {tail}",
    )
    assert obstacle([0.5, 0.4, 0.009, 0.003, 0.2], SHAPES, complete=True, straight=False) == (
        1,
        "The path through the waypoints comes near to a dynamic singularity after 0.75: |det J*| "
        "falls from 10 to 10.3 at the shape (0.3, 0.6), where the joints would have to move fast "
        f"for little progress. {tail}",
    )


def test_the_measure_is_a_determinant_where_joints_are_as_many_as_rows() -> None:
    square, wide = np.array([[0.0, -2.0], [1.5, 9.0]]), np.array([[0, -2.0, 0], [1.5, 0, 0]])
    for J, name, value in (
        (square, "|det J*|", 3.0),
        (wide, "the smallest singular value of J* (scaled)", 15.0),
    ):
        lines: Any = SimpleNamespace(jacobian=lambda *_: J, scaled_jacobian=lambda *_: 10 * J)  # noqa: B023
        found = _LinkPaths.singularity_measure(lines, np.zeros(J.shape[1]), IDENTITY)
        assert (found[0], round(found[1], 12)) == (name, value)


def test_the_first_of_a_limit_and_a_singularity_counts() -> None:
    beyond = [*SHAPES[:2], [2.0, 0.0], [2.0, 0.1], [2.0, 0.2]]
    slow_first = obstacle([0.5, 0.001, 0.2, 0.2, 0.2], beyond)
    assert slow_first is not None
    assert (slow_first[0], "singularity" in slow_first[1]) == (0, True)
    limit_first = obstacle([0.5, 0.3, 0.2, 0.001, 0.2], beyond)
    assert limit_first is not None
    assert (limit_first[0], "'hip'" in limit_first[1]) == (1, True)


# -- ticks --------------------------------------------------------------------------------------


def held(needed: list[tuple[float, float]], end: float = 1.0) -> tuple[list[int], Any]:
    """Return the numbers of ticks that are tried, and the shapes or the refusal."""
    tried: list[int] = []
    answers = iter(needed)

    def at_ticks(ticks: int) -> tuple[Array, Array]:
        tried.append(ticks)
        return np.full((ticks + 1, 2), float(ticks)), np.zeros(ticks + 1)

    method: Any = SimpleNamespace(
        control_period=0.1,
        _limits=SimpleNamespace(excess=lambda positions, period: next(answers)),
        _shapes_on_lines=lambda lines, state, shapes, shares: shapes,
    )
    timed: Any = SimpleNamespace(time=np.array([0.0, 0.3, end]), at_ticks=at_ticks)
    lines: Any = None
    try:
        return tried, ResolvedRateGait._held_commands(method, lines, lines, timed)
    except PlanningError as error:
        return tried, str(error)


def test_commands_take_more_ticks_until_they_keep_the_limits() -> None:
    tried, positions = held([(1.3, 0.0), (1.01, 0.0), (1 + 0.9e-9, 0.9e-9)])
    assert tried == [10, 13, 14]
    assert positions.shape == (15, 2)
    assert held([(1.0, 0.0)], end=0.999)[0] == [10]
    assert held([(1.0, 0.0)], end=1.0 + 1e-12)[0] == [10]
    assert held([(1.0, 0.0)], end=1.01)[0] == [11]
    assert held([(1.0, 0.0)], end=1e-11)[0] == [1]


def test_commands_that_never_keep_the_limits_are_refused() -> None:
    sentence = (
        "Held commands of 0.1 s on the line do not keep the limits of the joints: a higher "
        "tick_rate of the planner may help, or lower limits."
    )
    tried, said = held([(1.0 + 2e-9, 0.0)] * 8)
    assert (tried, said) == ([10, 11, 12, 13, 14, 15, 16, 17], sentence)
    assert held([(1.0, 2e-9)]) == ([10], sentence)


def test_a_robot_without_joints_moves_no_hand() -> None:
    link = """<link name="{}"><inertial><mass value="2"/>
      <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
    joint = """<joint name="slide" type="prismatic"><parent link="hull"/><child link="rod"/>
      <limit lower="-1" upper="1" velocity="1" effort="1"/></joint>"""
    with pytest.raises(PlanningError, match="'stone' has no joints"):
        ResolvedRateGait.require_suitable(
            SpaceRobot.from_urdf(f'<robot name="stone">{link.format("hull")}</robot>')
        )
    parts = link.format("hull") + joint + link.format("rod")
    ResolvedRateGait.require_suitable(SpaceRobot.from_urdf(f'<robot name="one">{parts}</robot>'))
