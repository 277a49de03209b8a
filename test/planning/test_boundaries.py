"""Boundaries of planning, exactly: limits that are just kept and just not."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.planning.core import clearance as module
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.joint_efforts import JointEfforts, given_effort_limits
from spacerobot_ros.planning.methods.optimal.problem import (
    MotionLimits,
    MotionOptions,
    PathConstraints,
    UnusableCandidateError,
)

Array = npt.NDArray[np.float64]


_WITHOUT_WHEELS = SimpleNamespace(
    wheel_names=(), joint_names=("a", "b"), limits=lambda _: np.zeros(2)
)


@pytest.mark.parametrize(
    ("velocity", "acceleration", "sentence"),
    [
        (0.0, 1.0, "'b' is limited to 0 a second and 1 a second squared; m needs a speed above "),
        (0.5, 0.0, "'b' is limited to 0.5 a second and 0 a second squared; m needs a speed above "),
        (0.5, np.inf, "'b' is limited to 0.5 a second and inf a second squared; m needs a speed "),
        (0.5, 1e-9, ""),
    ],
)
def test_a_joint_needs_a_speed_and_a_finite_acceleration(
    velocity: float, acceleration: float, sentence: str
) -> None:
    robot: Any = SimpleNamespace(
        velocity_limit=np.array([1.0, velocity]), joint_names=("a", "b"), n=2,
        lower=np.array([-1.0, -2.0]), upper=np.array([1.0, 2.0]), description=_WITHOUT_WHEELS,
    )  # fmt: skip
    options = MotionOptions(max_acceleration=(1.0, acceleration))
    if not sentence:
        assert MotionLimits.of(robot, options, "m").acceleration.tolist() == [1.0, 1e-9]
        return
    with pytest.raises(ParameterError) as refusal:
        MotionLimits.of(robot, options, "m")
    assert sentence in str(refusal.value)
    assert str(refusal.value).endswith("a finite acceleration: see m.max_acceleration.")


def test_a_joint_without_a_velocity_limit_is_refused_with_the_remedies() -> None:
    robot: Any = SimpleNamespace(
        velocity_limit=np.array([1.0, np.inf]), joint_names=("a", "b"), n=2,
        lower=np.array([-1.0, -2.0]), upper=np.array([1.0, 2.0]), description=_WITHOUT_WHEELS,
    )  # fmt: skip
    with pytest.raises(ParameterError) as refusal:
        MotionLimits.of(robot, MotionOptions(), "m")
    assert str(refusal.value) == (
        "Joint 'b' has no velocity limit, within which m plans: give it "
        '<limit velocity="..." effort="..."/> in the URDF, or m.max_velocity.'
    )
    # Either remedy is one.
    assert MotionLimits.of(robot, MotionOptions(max_velocity=(1.0, 0.5)), "m").velocity[1] == 0.5


def turning(rate: float) -> Array:
    """Return attitudes at three ticks of 0.5 s, the last two apart by a rate."""
    angles = np.array([0.0, 0.01, 0.01 + rate * 0.5])
    return Rotation.from_rotvec(angles[:, np.newaxis] * [0.6, 0.0, 0.8]).as_quat()


def test_a_base_may_turn_at_its_bound_and_a_millionth_more() -> None:
    bound = PathConstraints(base_rate_limit=0.2)
    shapes = np.zeros((3, 2))
    bound.check(shapes, turning(0.2 * (1 + 0.9e-6)), 0.5)
    with pytest.raises(UnusableCandidateError, match=r"^the base turns at 0\.2001 rad/s$"):
        bound.check(shapes, turning(0.2001), 0.5)
    PathConstraints().check(shapes, turning(9.0), 0.5)
    assert bound.imposed_base_rate == pytest.approx(0.196)


def test_an_axis_may_touch_its_cone() -> None:
    axis, sun = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    attitudes = Rotation.from_rotvec([[0, 0, 0.0], [0, 0, -0.9], [0, 0, -0.4]]).as_quat()
    shapes = np.zeros((3, 2))
    nearest = np.pi / 2 - 0.9
    PathConstraints(axis_B=axis, direction_W=sun, cone_half_angle=nearest).check(
        shapes, attitudes, 0.5
    )
    wider = PathConstraints(axis_B=axis, direction_W=sun, cone_half_angle=nearest + 1e-6)
    with pytest.raises(UnusableCandidateError) as refusal:
        wider.check(shapes, attitudes, 0.5)
    assert str(refusal.value) == f"the axis comes within {nearest:.4g} rad of keep_direction"


def test_shapes_may_touch_a_box_and_its_first_entry_is_told() -> None:
    boxes = np.array([[[0.1, -0.5], [0.4, 0.5]]])
    kept = PathConstraints(keep_out_boxes=boxes)
    attitudes = np.tile([0.0, 0.0, 0.0, 1.0], (4, 1))
    kept.check(np.array([[0.1, 0.0], [0.4, 0.0], [0.2, 0.5], [0.2, -0.5]]), attitudes, 0.5)
    inside = np.array([[0.0, 0.0], [0.05, 0.0], [0.2, 0.1], [0.3, 0.2]])
    with pytest.raises(
        UnusableCandidateError, match=r"^the shape enters a box of keep_out at 1 s$"
    ):
        kept.check(inside, attitudes, 0.5)


# -- clearance at the start ---------------------------------------------------------------------


class Geometry:
    """Pairs at given distances, of which a bound below is known."""

    def __init__(self, distances: list[float], bounds: list[float] | None = None) -> None:
        self._distances, self._bounds = distances, bounds or distances
        self.pairs = np.zeros((len(distances), 2))
        self.asked: list[int] = []
        self.unread_meshes: tuple[Any, ...] = ()

    def poses(self, shapes: Array, base: object = None) -> tuple[Array, Array]:
        return np.zeros((len(shapes), 1)), np.zeros((len(shapes), 1))

    def lower_bounds(self, poses: tuple[Array, Array]) -> Array:
        return np.tile(self._bounds, (len(poses[0]), 1))

    def distances(self, pair: int, poses: tuple[Array, Array]) -> Array:
        self.asked.append(pair)
        return np.full(len(poses[0]), self._distances[pair])

    def links_of(self, pair: int) -> Any:
        return SimpleNamespace(subject=f"links 'a' and '{pair}'")


def clearance(distances: list[float], bounds: list[float] | None = None) -> Any:
    robot: Any = SimpleNamespace(links=())
    made: Any = Clearance(robot, 0.02)
    made.__dict__["geometry"] = Geometry(distances, bounds)
    return made


def test_links_keep_the_clearance_or_the_distance_at_the_start(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    lines: list[tuple[Any, ...]] = []
    monkeypatch.setattr(module, "_LOG", SimpleNamespace(warning=lambda *said: lines.append(said)))
    made = clearance([0.5, 0.02, 0.015, 0.01, 0.0, -0.1], [0.021, 0.02, 0, 0, 0, -0.1])
    found = made.required(np.zeros(2))
    kept = [0.02, 0.02, 0.015, 0.01, -np.inf, -np.inf]
    np.testing.assert_allclose(found, np.array(kept) - 1e-6)
    assert made.geometry.asked == [1, 2, 3, 4, 5], "the first is far by its bound"
    made.required(np.zeros(2))
    assert [said[1] for said in lines] == ["Links 'a' and '4'", "Links 'a' and '5'"], "once each"
    with pytest.raises(PlanningError) as refusal:
        clearance([0.00999]).required(np.zeros(2))
    assert str(refusal.value) == (
        "Links 'a' and '0' are 0.00999 m apart at the start, nearer than planner.clearance = "
        "0.02 m: make it smaller, or have an SRDF disable the pair (planner.srdf)."
    )
    assert clearance([]).required(np.zeros(2)).shape == (0,)


def test_loops_have_room_at_five_clearances() -> None:
    for distance, bound, roomy in ((0.1, 0.0, True), (0.0999, 0.0, False), (0.0, 0.1, True)):
        found = clearance([distance], [bound]).is_roomy(np.zeros((3, 2)))
        assert found.tolist() == [roomy] * 3
    assert clearance([]).is_roomy(np.zeros((2, 2))).tolist() == [True, True]


# -- efforts ------------------------------------------------------------------------------------


class Function:
    """Efforts that are the accelerations; it counts the ticks that it is asked for."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def __call__(self, q: Array, qdot: Array, qddot: Array) -> Any:
        self.asked.append(q.shape[1])
        return SimpleNamespace(full=lambda: qddot + 0.01 * q)


def efforts(limit: list[float]) -> tuple[Any, Function]:
    joints = [SimpleNamespace(name="hip", unit="rad"), SimpleNamespace(name="slide", unit="m")]
    function = Function()
    robot: Any = SimpleNamespace(
        description=SimpleNamespace(movable_joints=joints), function=lambda *_, **__: function
    )
    return JointEfforts(robot, np.array(limit), 0.1), function


@pytest.mark.parametrize("tick", [0, 1, 1234, 8998, 8999])
def test_a_peak_in_a_long_gait_is_found_wherever_it_is(tick: int) -> None:
    made, function = efforts([2.0, 0.5])
    changes = np.zeros((9000, 2))
    changes[tick] = [3.0, 0.0]
    # Rates after each tick, and the shapes that they lead to; the last change stops the joints.
    rates = np.cumsum(changes, axis=0)[:-1] * 0.1
    positions = np.vstack([np.zeros(2), np.cumsum(rates, axis=0) * 0.1])
    positions -= positions[tick]
    said = made.beyond_limits(positions)
    if tick < 8999:
        assert said.startswith("hip takes 3 N m, 1.5 times its limit of 2 N m")
    assert function.asked[0] <= 4000


def test_efforts_beyond_limits_are_told_joint_by_joint() -> None:
    made, function = efforts([2.0, 0.5])
    # To and fro: velocities of 0.3 and -0.08 within a tick of 0.1 s, from rest to rest.
    positions = np.array([[0.0, 0.0], [0.03, -0.008], [0.03, -0.008]])
    shares = made.shares(positions)
    np.testing.assert_allclose(shares[0], [3.0 / 2.0, -0.8 / 0.5], atol=1e-3)
    assert made.excess(positions) == pytest.approx(np.sqrt(np.abs(shares).max()))
    assert made.beyond_limits(positions) == (
        "hip takes 3 N m, 1.5 times its limit of 2 N m, slide takes 0.8 N, 1.6 times its limit of "
        "0.5 N"
    )
    assert function.asked == [3] * 3
    held = made.shares(positions, np.array([0.3, -0.08]))
    np.testing.assert_allclose(held[0], 0.0, atol=1e-3)
    assert efforts([3.01, 0.81])[0].beyond_limits(positions) == ""


def test_limits_of_zero_are_not_known() -> None:
    def robot(*limits: float) -> Any:
        return SimpleNamespace(effort_limit=np.array(limits))

    np.testing.assert_array_equal(given_effort_limits(robot(3.0, 0.0)), [3.0, np.inf])
    assert given_effort_limits(robot(0.0, np.inf)) is None
