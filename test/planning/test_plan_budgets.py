"""Budgets of plans in motion and of corrections, and limits that count as active."""

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
from spacerobot_ros.planning.methods.optimal.problem import OptimalOptions

Array = npt.NDArray[np.float64]

PERIOD = 0.1
START, FINAL = np.array([0.3, -0.2]), np.array([0.5, 0.4])
STATE: Any = SimpleNamespace(
    quaternion=Rotation.from_rotvec([0.3, 0.2, -0.4]).as_quat(), angular_momentum=np.zeros(3)
)


def shapes(ticks: int) -> Array:
    return np.linspace(START, FINAL, ticks + 1)


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
