"""A plan follows from its request alone, says what it controls, and can be cancelled."""

from __future__ import annotations

import threading
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import robot_of
from support.slow import some_fast

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import (
    METHODS,
    Cancellation,
    GaitMethod,
    GaitSchedule,
    Goal,
    PlanningCancelled,
    PlanRequest,
    RobotState,
    Tolerance,
    build_method,
    method_options,
)
from spacerobot_ros.planning.methods.registry import RemainingJointsGait

PERIOD, STEP = 0.1, 0.02
SERVICER_SHAPE = (0.0, -1.2, 2.0, 0.0, 0.8, 0.0)
FEW_STARTS = {"cache": 0, "starts": 1, "answers": 1, "intervals": 12}


@dataclass(frozen=True)
class Case:
    """A method, a robot in a shape, and turns (rad) and a displacement (m) that it plans."""

    method: str
    robot: str
    shape: tuple[float, ...]
    turns: tuple[tuple[float, float, float], ...]
    displacement: float
    controls: frozenset[str]


ATTITUDE, POSE = frozenset({"attitude", "shape"}), frozenset({"attitude", "position"})
TURNS = ((0.03, -0.02, 0.04), (-0.05, 0.02, 0.01))
SLIDERS, ARM, CHAIN = (0.1, 0.0, -0.1), (0.0, -0.8, 1.5), (1.0, 1.0)
CASES = {
    "lie_bracket": Case("lie_bracket", "sliding_masses", SLIDERS, TURNS, 0.05, POSE),
    "square_path": Case(
        "square_path", "planar_chain", CHAIN, ((0, 0, 0.5), (0, 0, -1.0)), 0.0, ATTITUDE
    ),
    "area_loop": Case("area_loop", "three_joint_arm", ARM, TURNS, 0.0, ATTITUDE),
    "area_loop of six joints": Case("area_loop", "servicer", SERVICER_SHAPE, TURNS, 0.0, ATTITUDE),
    "optimal": Case("optimal", "three_joint_arm", ARM, TURNS, 0.0, ATTITUDE),
    "optimal with sliders": Case(
        "optimal", "sliding_masses", SLIDERS, TURNS, 0.05, POSE | {"shape"}
    ),
    "auto": Case("auto", "planar_chain", CHAIN, ((0, 0, 0.5), (0, 0, -1.0)), 0.0, ATTITUDE),
    "remaining_joints": Case("remaining_joints", "servicer", SERVICER_SHAPE, TURNS, 0.0, ATTITUDE),
}


def options_of(case: Case) -> dict[str, Any]:
    """Return options that make planning quick."""
    area_loop = {}
    if case.robot == "servicer":
        third = "elbow_pitch" if case.method == "area_loop" else "wrist_pitch"
        area_loop["joints"] = f"shoulder_yaw shoulder_pitch {third}"
    return {
        "optimal": method_options("optimal", FEW_STARTS),
        "area_loop": method_options("area_loop", area_loop),
    }


def without_elbow(robot: SpaceRobot, method: str, options: dict[str, Any]) -> GaitMethod:
    stuck = {"elbow_pitch": 2.0}
    return RemainingJointsGait(robot, PERIOD, STEP, stuck=stuck, method=method, options=options)


def built(case: Case, robot: SpaceRobot) -> GaitMethod:
    if case.method == "remaining_joints":
        return without_elbow(robot, "area_loop", options_of(case))
    return build_method(case.method, robot, PERIOD, STEP, options_of(case))


def requests(case: Case) -> list[PlanRequest]:
    """Return requests for two goals, and for the first one from elsewhere and within less."""
    start = Rotation.from_rotvec([0.2, 0.1, -0.3])
    state = RobotState(np.array([0.1, 0.2, 0.0]), start.as_quat(), np.array(case.shape))
    there = state.position + case.displacement * np.array([1.0, -0.5, 0.3])
    goals = [
        Goal.checked(there, (start * Rotation.from_rotvec(turn)).as_quat()) for turn in case.turns
    ]
    near, wide = Tolerance(1e-3, 1e-3), Tolerance(2e-2, 2e-2)
    moved = replace(state, q=state.q + 0.02 * (np.arange(len(state.q)) != 2))
    return [
        PlanRequest(state, goals[0], near),
        PlanRequest(state, goals[1], near),
        PlanRequest(moved, goals[0], wide, correction=True),
    ]


def content(schedule: GaitSchedule) -> dict[str, Any]:
    """Return all of a schedule that can be compared with ==; notes without times of the clock."""
    values = {field.name: getattr(schedule, field.name) for field in fields(schedule)}
    for name in ("goal", "progress", "path"):
        values.pop(name)
    values["positions"] = schedule.positions.tobytes()
    path = vars(schedule.path).items()
    values |= {f"path {name}": array.tobytes() for name, array in path if array is not None}
    return values


@pytest.mark.parametrize("name", some_fast(list(CASES), "square_path", "optimal"))
def test_equal_requests_have_equal_schedules_in_any_order(name: str) -> None:
    case = CASES[name]
    robot, asked = robot_of(case.robot), requests(case)
    # The plan that goes on from the first one belongs to the first goal.
    method = built(case, robot)
    first = method.plan(asked[0])
    asked.append(replace(asked[2], previous=first))
    there = [content(method.plan(request)) for request in asked]
    assert there[0] == content(first)
    back = [content(method.plan(request)) for request in reversed(asked)]
    assert back[::-1] == there
    # Another instance, which has seen nothing.
    for request, expected in zip(reversed(asked), there[::-1], strict=True):
        assert content(built(case, robot).plan(request)) == expected
    assert there[0] != there[1]


@pytest.mark.parametrize("name", CASES)
def test_a_schedule_says_what_it_controls_and_who_made_it(name: str) -> None:
    case = CASES[name]
    method = built(case, robot_of(case.robot))
    before = method.controls
    schedule = method.plan(requests(case)[0])
    assert schedule.controls == case.controls
    assert schedule.method in METHODS
    assert schedule.method != "auto"
    # What the method says of itself is the same as ever.
    assert method.controls == before


@pytest.mark.parametrize("correction", [False, True])
@pytest.mark.parametrize("name", CASES)
def test_a_goal_that_is_met_takes_no_time(name: str, correction: bool) -> None:
    case = CASES[name]
    first = requests(case)[0]
    state = first.state
    attitude = Rotation.from_quat(state.quaternion)
    if case.method == "area_loop":  # Within the tolerance will do.
        attitude = attitude * Rotation.from_rotvec([0.0, 0.0, 1e-4])
    goal = Goal.checked(state.position, attitude.as_quat())
    method = built(case, robot_of(case.robot))
    schedule = method.plan(replace(first, goal=goal, correction=correction))
    assert (schedule.ticks, schedule.duration, schedule.partial) == (0, 0.0, False)
    np.testing.assert_allclose(schedule.positions, [state.q], atol=1e-14)
    assert schedule.velocities.shape == (0, len(state.q))
    np.testing.assert_allclose(schedule.path.position, [state.position], atol=1e-14)


# -- pieces of one goal -----------------------------------------------------------------------


def test_a_goal_keeps_its_nominal_shape_while_the_other_joints_rest() -> None:
    case = CASES["area_loop of six joints"]
    method = built(case, robot_of(case.robot))
    request = requests(case)[0]
    first = method.plan(request)
    # As noise has it: the next plan begins a little elsewhere.
    q = request.state.q + 5e-4
    nearby = replace(request, state=replace(request.state, q=q))
    kept = method.plan(replace(nearby, previous=first)).notes["nominal"]
    assert kept == first.notes["nominal"]
    anew = method.plan(nearby).notes["nominal"]
    assert anew != kept


def test_what_was_planned_with_all_joints_is_not_gone_on_with_without_some() -> None:
    case = CASES["area_loop of six joints"]
    robot = robot_of(case.robot)
    request = requests(case)[0]
    of_all = built(case, robot).plan(request)
    without = built(CASES["remaining_joints"], robot)
    alone = without.plan(request)
    assert content(without.plan(replace(request, previous=of_all))) == content(alone)


# -- cancellation -----------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_a_cancelled_plan_is_not_made(name: str) -> None:
    case = CASES[name]
    method = built(case, robot_of(case.robot))
    cancellation = Cancellation()
    cancellation.cancel()
    with pytest.raises(PlanningCancelled, match=r"^Planning was cancelled\.$"):
        method.plan(requests(case)[0], cancellation)
    # The next one is.
    assert method.plan(requests(case)[0], Cancellation()).ticks > 0


class Watched(Cancellation):
    """Reports when a search has looked at it often enough to be in the middle."""

    def __init__(self) -> None:
        super().__init__()
        self.searched = threading.Event()
        self._looks = 0

    @property
    def requested(self) -> bool:
        self._looks += 1
        if self._looks == 20:
            self.searched.set()
        return super().requested


@pytest.mark.parametrize("remaining", [False, True], ids=["optimal", "with remaining joints"])
def test_a_search_is_cancelled_from_another_thread(remaining: bool) -> None:
    robot = robot_of("servicer")
    long = {"cache": 0, "intervals": 200, "starts": 1000, "answers": 1000}
    options = {"optimal": method_options("optimal", long)}
    if remaining:
        method = without_elbow(robot, "optimal", options)
    else:
        method = build_method("optimal", robot, PERIOD, STEP, options)
    case = replace(CASES["area_loop of six joints"], turns=((0.3, 0.2, -0.3),) * 2)
    cancellation, ended = Watched(), list[BaseException]()

    def search() -> None:
        try:
            method.plan(requests(case)[0], cancellation)
        except PlanningError as reason:
            ended.append(reason)

    thread = threading.Thread(target=search, daemon=True)
    thread.start()
    assert cancellation.searched.wait(60.0)
    assert thread.is_alive()
    cancellation.cancel()
    # A step of the solver takes a fraction of a second.
    thread.join(20.0)
    assert not thread.is_alive()
    assert [type(reason) for reason in ended] == [PlanningCancelled]
