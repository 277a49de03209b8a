"""Which cached manoeuvres are refused, at the boundaries, and the budgets of plans in motion."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import NotFoundError, PlanningError
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.methods.optimal.method import OptimalGait
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    UnusableCandidateError,
)

Array = npt.NDArray[np.float64]

PERIOD = 0.1
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
START, FINAL = np.array([0.3, -0.2]), np.array([0.5, 0.4])
TURN = Rotation.from_rotvec([0.1, -0.3, 0.2])
STATE: Any = SimpleNamespace(
    quaternion=Rotation.from_rotvec([0.3, 0.2, -0.4]).as_quat(), angular_momentum=np.zeros(3)
)
LIMITS = MotionLimits(np.full(2, -9.0), np.full(2, 9.0), np.full(2, 1e6), np.full(2, 1e6))


def shapes(ticks: int) -> Array:
    return np.linspace(START, FINAL, ticks + 1)


def method(**options: Any) -> Any:
    """Return a stand-in for the method, whose base turns as the goal asks for."""
    made: Any = SimpleNamespace(
        control_period=PERIOD,
        robot=SimpleNamespace(n=2, center_of_mass=lambda q: np.array([q[0], q[1], 0.0])),
        options=replace(OptimalOptions(longest=4.0), **options),
        off=np.zeros(3),
        rows=None,
        near="",
        excess=0.0,
    )
    made._efforts = SimpleNamespace(excess=lambda *_, **__: made.excess)

    def attitudes(positions: Array, quaternion: Array, _: Array) -> Array:
        end = Rotation.from_quat(quaternion) * TURN * Rotation.from_rotvec(made.off)
        return np.vstack([np.tile(quaternion, (len(positions) - 1, 1)), end.as_quat()])

    made._prediction = SimpleNamespace(attitudes=attitudes)
    kind = SimpleNamespace(
        specification=SimpleNamespace(axes=np.eye(3)),
        model=SimpleNamespace(end_effectors=None),
    )
    made._kind_of = lambda goal: kind
    made._constraints = SimpleNamespace(check=lambda *_: None)
    made._too_near = lambda *_: made.near
    made._base_poses = lambda *_: None
    made.kind = kind
    return made


def refusal(made: Any, positions: Array, **changes: Any) -> str:
    """Return why a manoeuvre is refused; empty: it is not."""
    boundary = replace(BoundaryConditions(START, TURN.as_quat(), FINAL, FINAL), **changes)
    goal = SimpleNamespace(
        end_effectors=(), quaternion=(Rotation.from_quat(STATE.quaternion) * TURN).as_quat()
    )
    request: Any = SimpleNamespace(state=STATE, goal=goal)
    try:
        OptimalGait._require_valid_manoeuvre(made, positions, request, boundary, LIMITS)
    except UnusableCandidateError as error:
        return str(error)
    return ""


def test_a_manoeuvre_for_the_request_is_taken() -> None:
    assert not refusal(method(), shapes(30))
    assert not refusal(method(duration=3.04), shapes(30))
    assert not refusal(method(duration=3.04), shapes(31))
    assert refusal(method(duration=3.04), shapes(32)) == "it takes 3.2 s, not 3.04 s"
    assert refusal(method(duration=3.04), shapes(29)) == "it takes 2.9 s, not 3.04 s"


def test_a_manoeuvre_may_be_a_quarter_and_twenty_ticks_longer_than_the_longest() -> None:
    assert not refusal(method(), shapes(70))
    assert refusal(method(), shapes(71)) == "it takes 7.1 s"


@pytest.mark.parametrize(
    ("positions", "sentence"),
    [
        (shapes(30)[:, :1], "it is of shape (31, 1), not of 2 joints"),
        (shapes(30)[:1], "it is of shape (1, 2), not of 2 joints"),
        (shapes(30)[0], "it is of shape (2,), not of 2 joints"),
        (shapes(30) * np.nan, "it is not finite"),
    ],
)
def test_what_is_no_manoeuvre_of_the_robot_is_refused(positions: Array, sentence: str) -> None:
    assert refusal(method(), positions) == sentence


def test_the_ends_are_met_within_a_ten_millionth() -> None:
    near, beside = np.array([0.0, 0.9e-7]), np.array([0.0, -1.1e-7])
    assert not refusal(method(), shapes(30), start=START + near, final=FINAL + near)
    assert refusal(method(), shapes(30), start=START + beside) == "it begins in another shape"
    assert refusal(method(), shapes(30), final=FINAL + beside) == "it ends in another shape"
    assert not refusal(method(), shapes(30), final=None)
    center = np.array([0.5, 0.4, 0.0])
    assert not refusal(method(), shapes(30), final=None, center=center + 0.5e-7)
    said = refusal(method(), shapes(30), final=None, center=center + 0.9e-7)
    assert said == "it ends in another position"
    made = method()
    made.off = np.array([0.0, 0.9e-7, 0.0])
    assert not refusal(made, shapes(30))
    made.off = np.array([0.0, 1.1e-7, 0.0])
    assert refusal(made, shapes(30)) == "it ends in another attitude"
    made.kind.specification.axes = np.array([[1.0, 0.0, 0.0]])
    assert not refusal(made, shapes(30)), "along the axes that are reached"


def test_limits_efforts_and_distances_are_kept() -> None:
    for excess, refused in ((1 + 0.9e-8, False), (1 + 1.1e-8, True)):
        made = method()
        made.excess = excess
        said = "it exceeds a limit of the joints" if refused else ""
        assert refusal(made, shapes(30)) == said
    made = method()
    made.near = "links 'a' and 'b' are near"
    assert refusal(made, shapes(30)) == "links 'a' and 'b' are near"

    def evaluate(turn: Array, q: Array, _: Any) -> tuple[Array, int, int]:
        assert (Rotation.from_quat(turn[0]).inv() * TURN).magnitude() < 1e-9, "at the end"
        np.testing.assert_array_equal(q, [FINAL])
        return np.array([[0.0, made.miss]]), 0, 0

    rows = SimpleNamespace(evaluate=evaluate)
    made = method()
    made.kind.model.end_effectors = rows
    made.miss = 0.9e-7
    assert not refusal(made, shapes(30))
    made.miss = -1.1e-7
    assert refusal(made, shapes(30)) == "it ends with end-effectors elsewhere"


# -- budgets ------------------------------------------------------------------------------------


def planned(velocity: list[float], previous: object = None, **options: Any) -> Any:
    """Return the budget of a plan in motion, whose search is a stand-in."""
    asked: list[Any] = []
    made: Any = SimpleNamespace(
        control_period=PERIOD,
        robot=SimpleNamespace(joint_names=("hip", "knee", "hand")),
        options=replace(OptimalOptions(starts=24, answers=5), **options),
        _kind_of=lambda goal: None,
        _count_intervals=lambda correction: 77,
        _build_schedule=lambda *given: given,
    )
    held = SimpleNamespace(positions=shapes(3))
    found = SimpleNamespace(starts=4, solutions=[5.0, 6.0], held=held)

    def within(kind: object, search: Any, velocity: Array, boundary: object) -> Any:
        def given_to(*given: Any) -> Any:
            asked.append(given)
            return found

        return search(SimpleNamespace(in_motion=SimpleNamespace(search=given_to)))

    made._within_efforts = within
    request: Any = SimpleNamespace(previous=previous, goal=None, state=STATE)
    motion = InitialMotion(np.array(velocity), np.zeros((42, 3)))
    limits = SimpleNamespace(velocity=np.array([0.5, 1.0, 2.0]))
    never: Any = None
    plan_in_motion: Any = OptimalGait._plan_in_motion
    boundary = SimpleNamespace(final_velocity=0.0)
    schedule = plan_in_motion(made, request, motion, boundary, limits, never)
    assert schedule[3] == {"starts": 4.0, "durations": [5.0, 6.0]}
    ((_, _, quaternion, intervals, budget, given, _),) = asked
    assert quaternion is STATE.quaternion
    assert given is motion
    assert intervals == 77
    return budget


def test_a_plan_in_motion_has_twelve_guesses_at_most() -> None:
    budget = planned([0.5, -1.0, 2.0])
    assert (budget.starts, budget.answers, budget.duration) == (12, 5, 0.0)
    assert planned([0.0] * 3, starts=7).starts == 7
    assert planned([0.0] * 3, duration=3.0).duration == 3.0
    again = planned([0.0] * 3, previous="goal")
    assert (again.starts, again.answers, again.duration) == (1, 1, 0.0)
    # What was to take 3 s goes on for the 41 ticks that are left.
    assert planned([0.0] * 3, previous="goal", duration=3.0).duration == pytest.approx(4.1)


def test_joints_that_are_too_fast_are_named() -> None:
    planned([0.5 * (1 + 0.9e-8), 0.0, 0.0])
    with pytest.raises(PlanningError) as said:
        planned([-0.5 * (1 + 1.1e-8), 0.0, 2.1])
    assert str(said.value) == ("Joints move faster than the velocity limits of optimal: hip, hand.")


@pytest.mark.parametrize(
    ("correction", "given", "used"), [(True, 80, 40), (True, 30, 30), (False, 80, 80)]
)
def test_corrections_have_forty_intervals_at_most(correction: bool, given: int, used: int) -> None:
    made: Any = SimpleNamespace(options=SimpleNamespace(intervals=given))
    assert OptimalGait._count_intervals(made, correction) == used


def test_limits_count_as_active_from_nineteen_twentieths_on() -> None:
    limits = SimpleNamespace(
        limit_shares=lambda *_: (np.array([[0.951, 0.9], [0.1, 0.949]]), np.array([[0.2, 1.0]]))
    )
    efforts = SimpleNamespace(shares=lambda *_: np.array([[-0.96, 0.0], [0.1, -1.0]]))
    made: Any = SimpleNamespace(
        _limits=limits,
        _efforts=efforts,
        control_period=PERIOD,
        robot=SimpleNamespace(joint_names=("hip", "knee")),
    )
    said = OptimalGait._list_active_limits(made, shapes(3), 0.0)
    assert said == "velocity of hip, acceleration of knee, effort of hip knee"
    made._efforts = None
    assert OptimalGait._list_active_limits(made, shapes(3), 0.0).endswith("of knee")
    assert OptimalGait._list_active_limits(made, shapes(3)[:1], 0.0) == "nothing"
    limits.limit_shares = lambda *_: (np.zeros((2, 2)), np.zeros((2, 2)))
    assert OptimalGait._list_active_limits(made, shapes(3), 0.0) == "nothing"


def test_limits_of_efforts_are_searched_for_where_they_are_exceeded() -> None:
    kind: Any = SimpleNamespace(without_effort_limits="free", within_efforts="limited")
    asked: list[str] = []
    is_hard = [False]

    def search(searches: Any) -> Any:
        asked.append(searches)
        if searches == "limited" and is_hard[0]:
            raise NotFoundError("none")
        return searches

    for excess, hard, chosen, found in (
        (1.0, False, {}, "free"),
        (1.1, False, {}, "limited"),
        (1.1, True, {}, "free"),
        (1.1, True, {"effort_limits": 1}, None),
        (1.1, True, {"max_effort": (1.0, 2.0)}, None),
    ):
        is_hard[0] = hard
        made: Any = SimpleNamespace(options=replace(OptimalOptions(), **chosen))
        made._is_within_efforts = lambda found, velocity, boundary, excess=excess: excess <= 1.0
        if found is None:
            with pytest.raises(NotFoundError):
                OptimalGait._within_efforts(made, kind, search)
        else:
            taken: Any = OptimalGait._within_efforts(made, kind, search)
            assert taken == found
    assert asked == ["free", *["free", "limited"] * 4]
