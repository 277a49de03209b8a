"""The method that robot and goal allow."""

from __future__ import annotations

import re
from typing import Any, ClassVar

import numpy as np
import pytest
from planning.flown import STEP, fly, plant_at
from scipy.spatial.transform import Rotation
from support.hand_motion import attitude_after
from support.oracles.pinocchio_oracle import PinocchioOracle
from support.planner_loop import robot_of
from support.planners import Planner, planner_of

from spacerobot_ros.errors import PlanningError, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import (
    METHODS,
    NEVER,
    BasePath,
    Cancellation,
    GaitMethod,
    GaitSchedule,
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
    build_method,
    method_options,
)
from spacerobot_ros.planning.core.goal import POSE
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.methods.registry import AutoGait

PERIOD = 0.25
TOLERANCE = Tolerance(0.02, 0.02)

QUICK = {"cache": 0, "answers": 1, "intervals": 40}

ANGLES = {"attitude", "shape"}
START = {
    "sliding_masses": np.zeros(3),
    "three_joint_arm": np.radians([0, -45, 90]),
    "planar_chain": np.array([2.0, 1.5]),
}


def auto(robot: SpaceRobot, tolerance: Tolerance = TOLERANCE, **area_loop: Any) -> Planner:
    given = {"area_loop": method_options("area_loop", area_loop)}
    return Planner(build_method("auto", robot, PERIOD, STEP, given), tolerance)


def at(q: np.ndarray[Any, Any], **momenta: Any) -> RobotState:
    return RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q, **momenta)


def goal_of(rotvec: list[float], position: tuple[float, float, float] = (0, 0, 0)) -> Goal:
    return Goal.checked(position, Rotation.from_rotvec(rotvec).as_quat())


@pytest.mark.parametrize(
    ("name", "others", "controls"),
    [
        pytest.param(
            "sliding_masses",
            ["lie_bracket"],
            {"position", "attitude", "shape"},
            marks=pytest.mark.slow,
        ),
        pytest.param("three_joint_arm", ["area_loop"], ANGLES, marks=pytest.mark.slow),
        ("planar_chain", ["square_path"], ANGLES),
    ],
)
def test_of_the_methods_that_suit_the_one_with_the_shortest_manoeuvre_is_taken(
    name: str, others: list[str], controls: set[str]
) -> None:
    robot, goal = robot_of(name), goal_of([0.0, 0.0, 0.2])
    method = auto(robot)
    schedule = method.plan(at(START[name]), goal)
    assert schedule.method == "optimal"
    assert schedule.notes["chosen"] == "optimal"
    assert schedule.controls == controls
    assert f"optimal suits robot '{name}'" in str(schedule.notes["because"])
    compared = str(schedule.notes["compared"])
    assert f"optimal: {schedule.duration:.6g} s." in compared
    for other in others:
        # What the paper's method takes: flown to the end, not as auto has it.
        plant = plant_at(robot, START[name], PERIOD)
        flight = fly(planner_of(other, robot, PERIOD, TOLERANCE, STEP), plant, goal)
        takes = sum(piece.duration for piece in flight.pieces)
        assert takes > schedule.duration
        found = re.search(rf"{other}: (?:about )?([0-9.]+) s\.", compared)
        assert found is not None, compared
        # Loops of later cycles are shorter than the first one may be.
        assert 0.9 * takes <= float(found[1]) <= 2 * takes
    if name != "sliding_masses":
        assert "lie_bracket: lie_bracket needs three sliders" in compared


def test_options_are_those_of_the_chosen_method() -> None:
    robot, state = robot_of("planar_chain"), at(START["planar_chain"])
    request = PlanRequest(state, goal_of([0.0, 0.0, 0.2]), TOLERANCE)
    # Where these make it slower than another method, that one is taken.
    for duration, chosen in ((5.0, "optimal"), (30.0, "square_path")):
        given = {"duration": duration, "starts": 2, "answers": 1, "cache": 0}
        options = {"optimal": method_options("optimal", given)}
        schedule = build_method("auto", robot, PERIOD, STEP, options).plan(request)
        assert schedule.method == chosen
        assert f"optimal: {duration:g} s." in str(schedule.notes["compared"])
        assert schedule.duration <= duration


def test_where_optimal_refuses_the_papers_method_flies_the_goal() -> None:
    robot = robot_of("three_joint_arm")
    options = {
        "optimal": method_options("optimal", {"starts": 1, "iterations": 1}),
        "area_loop": method_options("area_loop", {"k": 0.5}),
    }
    method = Planner(build_method("auto", robot, PERIOD, STEP, options), Tolerance(1.0, 0.005))
    goal = goal_of([0.1, 0.0, 0.2])
    flight = fly(method, plant_at(robot, START["three_joint_arm"], PERIOD), goal)
    assert np.linalg.norm(flight.left(goal)[-1]) <= 0.005
    assert {piece.notes["chosen"] for piece in flight.pieces} == {"area_loop"}
    assert "optimal: No manoeuvre to the goal was found" in str(flight.pieces[0].notes["compared"])
    # What is left is predicted all along.
    ends = np.cumsum([piece.duration for piece in flight.pieces])
    predicted = [piece.remaining for piece in flight.pieces]
    np.testing.assert_allclose(predicted, ends[-1] - ends, rtol=0.25, atol=1.5 * ends[0])
    assert predicted[-1] == 0.0


def test_a_method_whose_options_do_not_suit_the_robot_is_left_out() -> None:
    urdf = robot_of("planar_chain").description.urdf
    unlimited = re.sub(r' velocity="[^"]*"', ' velocity="0"', urdf, count=1)
    robot = SpaceRobot.from_urdf(unlimited)
    with pytest.raises(PlanningError, match=r"optimal: Joint 'pin_1' has a velocity limit of 0"):
        auto(robot).plan(at(START["planar_chain"]), goal_of([0.0, 0.0, 0.2]))


# -- the choice, with methods made up --------------------------------------------------------


class Made(GaitMethod):
    """A method whose schedule moves no joint for some ``ticks``, with ``left`` s to come, and ends
    ``off`` m beside the goal; or that refuses every goal with its ``refusal``.
    """

    refusal: ClassVar[str] = ""
    ticks: ClassVar[int] = 1
    off: ClassVar[float] = 0.0
    left: ClassVar[float] = 0.0

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        if self.refusal:
            raise PlanningError(self.refusal)
        goal = request.goal
        ends = goal.position + np.array([self.off, 0.0, 0.0])
        path = BasePath(np.zeros(1), ends[np.newaxis], goal.quaternion[np.newaxis])
        q = np.tile(request.state.q, (1 + self.ticks, 1))
        partial = self.left > 0
        return self.schedule_of(goal, q, path, {}, partial=partial, remaining=self.left)


def made(name: str, objection: str = "", **members: Any) -> type[Made]:
    def refuse(robot: SpaceRobot) -> None:
        if objection:
            raise PlanningError(objection)

    return type(name, (Made,), {"name": name, "require_suitable": staticmethod(refuse), **members})


def choice_of(*methods: type[Made]) -> tuple[Planner, list[str]]:
    robot, built = robot_of("planar_chain"), list[str]()

    candidates = {entry.name: entry for entry in methods}

    def build(name: str) -> GaitMethod:
        built.append(name)
        return candidates[name](robot, PERIOD)

    return Planner(AutoGait(robot, PERIOD, candidates=candidates, build=build), TOLERANCE), built


ATTITUDE = frozenset({"attitude"})


def planned(*methods: type[Made]) -> GaitSchedule:
    return choice_of(*methods)[0].plan(at(np.zeros(2)), goal_of([0, 0, 1]))


def test_the_shortest_of_those_that_plan_is_taken() -> None:
    method, built = choice_of(
        made("a", objection="a wants wings."),
        made("b", refusal="b finds it too far."),
        made("c", ticks=9),
        made("d", ticks=5),
        made("e", ticks=5),
        made("f", ticks=7),
    )
    schedule = method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    assert schedule.notes["chosen"] == "d"
    # What does not suit the robot is not built.
    assert built == ["b", "c", "d", "e", "f"]
    assert schedule.notes["compared"] == (
        "c: 2.25 s. d: 1.25 s. e: 1.25 s. f: 1.75 s. a: a wants wings. b: b finds it too far."
    )
    assert "d suits robot 'planar_chain' and plans the shortest of 4" in str(
        schedule.notes["because"]
    )
    only = planned(made("a", objection="No."), made("b"))
    assert "is the only method that can plan for this goal." in str(only.notes["because"])


def test_what_the_schedules_after_a_partial_one_take_counts() -> None:
    whole, piece = made("whole", ticks=9), made("piece", ticks=1, left=2.25)
    schedule = planned(piece, whole)
    assert schedule.notes["chosen"] == "whole"
    assert schedule.notes["compared"] == "piece: about 2.5 s. whole: 2.25 s."
    piece.left = 1.75
    assert planned(whole, piece).notes["chosen"] == "piece"


def test_a_manoeuvre_that_ends_off_the_goal_comes_last() -> None:
    misses, reaches = made("misses", off=0.03), made("reaches", ticks=90)
    schedule = planned(misses, reaches)
    assert schedule.notes["chosen"] == "reaches"
    assert "misses: 0.25 s, which misses the goal." in str(schedule.notes["compared"])
    # Without another one it is better than nothing; a measured state corrects it.
    assert planned(misses).notes["chosen"] == "misses"
    misses.off = 0.015
    assert planned(misses, reaches).notes["chosen"] == "misses"


def test_what_reaches_the_shape_of_a_goal_too_is_better() -> None:
    poses, whole = made("poses"), made("whole", controls=GaitMethod.controls | {"shape"}, ticks=9)
    shaped = Goal.checked([0, 0, 0], [0, 0, 0, 1], [0.0, 0.0])
    for goal, chosen in ((shaped, "whole"), (goal_of([0, 0, 1]), "poses")):
        method, _ = choice_of(poses, whole)
        assert method.plan(at(np.zeros(2)), goal).notes["chosen"] == chosen
    # A shape that cannot be had with the pose is given up for it, as before.
    whole.refusal = "Not in that shape."
    method, _ = choice_of(poses, whole)
    assert method.plan(at(np.zeros(2)), shaped).notes["chosen"] == "poses"


def test_all_reasons_are_told_where_none_plans() -> None:
    method, _ = choice_of(made("a", objection="a wants wings."), made("b", refusal="Too far."))
    with pytest.raises(
        PlanningError, match=r"No method can plan .* b: Too far\. a: a wants wings\."
    ):
        method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))


def test_attitude_alone_is_no_substitute_for_a_pose() -> None:
    turns = made("turns", controls=ATTITUDE)
    method, built = choice_of(made("moves", refusal="Beyond stroke."), turns)
    with pytest.raises(
        PlanningError, match=r"Beyond stroke\..*does not control the position of the base"
    ):
        method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    # A longer manoeuvre to the pose is no worse than a turn.
    assert planned(made("moves", ticks=9), turns).notes["chosen"] == "moves"
    # Where nothing moves the base, a turn is what there is.
    method, built = choice_of(made("moves", objection="moves wants sliders."), turns)
    schedule = method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    assert schedule.notes["chosen"] == "turns"
    assert built == ["turns"]
    assert schedule.controls == ATTITUDE


def test_a_goal_without_attitude_moves_an_arms_base_and_turns_it_back() -> None:
    robot, start = robot_of("three_joint_arm"), START["three_joint_arm"]
    begun, way = Rotation.from_rotvec([0.3, -0.5, 0.9]), np.array([0.03, -0.02, 0.04])
    state = RobotState(np.array([1.0, 2.0, 3.0]), begun.as_quat(), start)
    method = build_method("auto", robot, 0.1, STEP, {"optimal": method_options("optimal", QUICK)})
    for attitude, controls in ([np.nan] * 4, POSE), (begun.as_quat().tolist(), {"attitude"}):
        wanted = Goal.received((state.position + way).tolist(), attitude)
        goal = wanted.kept_at(state.position, state.quaternion)
        schedule = method.plan(PlanRequest(state, goal, TOLERANCE))
        assert schedule.controls & POSE == controls
        if controls != POSE:
            continue
        oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
        last = schedule.positions[-1]
        end = attitude_after(oracle, schedule.positions, begun)
        assert (end.inv() * begun).magnitude() <= 1e-6
        # The centre of mass rests.
        oracle.place(start, begun.as_quat(), state.position)
        center = oracle.center_of_mass_W()
        oracle.place(last, end.as_quat(), state.position + way)
        np.testing.assert_allclose(oracle.center_of_mass_W(), center, atol=1e-7)
    far = Goal.received([9.0, 0.0, 0.0], [np.nan] * 4).kept_at(state.position, state.quaternion)
    with pytest.raises(UnreachableError, match="centre of mass"):
        method.plan(PlanRequest(state, far, TOLERANCE))


def test_a_goal_stays_with_its_method() -> None:
    first, second = made("first", refusal="Not now."), made("second", ticks=2)
    method, _ = choice_of(first, second)
    goal = goal_of([0, 0, 1])
    assert method.plan(at(np.zeros(2)), goal).notes["chosen"] == "second"
    first.refusal = ""
    correction = method.plan(at(np.zeros(2)), goal, correction=True)
    assert correction.notes["chosen"] == "second"
    assert correction.notes["because"] == "second planned for this goal before."
    other = method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    assert other.notes["chosen"] == "first"
    # Unless it plans no more.
    first.refusal = "Not now."
    correction = method.plan(at(np.zeros(2)), other.goal, correction=True)
    assert correction.notes["chosen"] == "second"
    assert "first: Not now." in str(correction.notes["compared"])


def test_only_methods_that_start_in_motion_are_asked_for_moving_joints() -> None:
    rests, moves = made("rests"), made("moves", ticks=9)
    moves.starts_in_motion = True
    motion = InitialMotion(np.array([0.1, 0.0]), np.zeros((2, 2)))
    request = PlanRequest(at(np.zeros(2)), goal_of([0, 0, 1]), TOLERANCE, motion=motion)
    schedule = choice_of(rests, moves)[0].method.plan(request)
    assert schedule.notes["chosen"] == "moves"
    assert "rests: rests plans only from rest." in str(schedule.notes["compared"])
    with pytest.raises(PlanningError, match=r"rests plans only from rest\."):
        choice_of(rests)[0].method.plan(request)


def test_every_method_of_the_registry_is_built_with_its_defaults() -> None:
    robot = robot_of("three_joint_arm")
    for name, entry in METHODS.items():
        assert type(build_method(name, robot, PERIOD, STEP, {})) is entry
