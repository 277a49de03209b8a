"""The method that robot and goal allow."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from planning.flown import STEP, fly, plant_at
from scipy.spatial.transform import Rotation
from support.planners import Planner, planner_of

from spacerobot_ros.errors import PlanningError
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
from spacerobot_ros.planning.methods.auto import AutoGait, Candidate

FOLDER = Path(__file__).parents[2] / "urdf"
PERIOD = 0.25
TOLERANCE = Tolerance(0.02, 0.02)

START = {
    "sliding_masses": np.zeros(3),
    "three_joint_arm": np.radians([0, -45, 90]),
    "planar_chain": np.array([2.0, 1.5]),
}


def robot_named(name: str) -> SpaceRobot:
    return SpaceRobot.from_file(FOLDER / f"{name}.urdf")


def auto(robot: SpaceRobot, tolerance: Tolerance = TOLERANCE, **area_loop: Any) -> Planner:
    given = {"area_loop": method_options("area_loop", area_loop)}
    return Planner(build_method("auto", robot, PERIOD, STEP, given), tolerance)


def at(q: np.ndarray[Any, Any], **momenta: Any) -> RobotState:
    return RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q, **momenta)


def goal_of(rotvec: list[float], position: tuple[float, float, float] = (0, 0, 0)) -> Goal:
    return Goal.checked(position, Rotation.from_rotvec(rotvec).as_quat())


@pytest.mark.parametrize(
    ("name", "chosen", "controls"),
    [
        ("sliding_masses", "lie_bracket", {"position", "attitude"}),
        ("three_joint_arm", "area_loop", {"attitude", "shape"}),
        ("planar_chain", "square_path", {"attitude", "shape"}),
    ],
)
def test_the_robots_of_the_papers_get_their_papers_method(
    name: str, chosen: str, controls: set[str]
) -> None:
    robot = robot_named(name)
    method = auto(robot)
    schedule = method.plan(at(START[name]), goal_of([0.0, 0.0, 0.2]))
    assert schedule.method == chosen
    assert schedule.notes["chosen"] == chosen
    assert schedule.controls == controls
    reason = str(schedule.notes["because"])
    assert f"{chosen} suits robot '{name}'" in reason
    if chosen != "lie_bracket":
        assert "needs three sliders" in reason


def test_options_are_those_of_the_chosen_method() -> None:
    robot = robot_named("three_joint_arm")
    nominal = [0.5, -1.0, 1.0]
    method = auto(robot, nominal=nominal, edge_time=9.0)
    schedule = method.plan(at(np.array(nominal)), goal_of([0.0, 0.0, 0.2]))
    assert schedule.notes["nominal"] == nominal
    assert schedule.duration >= 4 * 9.0
    alone = planner_of("area_loop", robot, PERIOD, TOLERANCE, STEP, nominal=nominal)
    assert alone.plan(at(np.array(nominal)), goal_of([0, 0, 0.2])).notes["nominal"] == nominal


def test_the_goal_is_flown_with_the_tolerance_of_the_moment() -> None:
    robot = robot_named("three_joint_arm")
    method, goal = auto(robot, Tolerance(1.0, 0.005), k=0.5), goal_of([0.1, 0.0, 0.2])
    flight = fly(method, plant_at(robot, START["three_joint_arm"], PERIOD), goal)
    assert np.linalg.norm(flight.left(goal)[-1]) <= 0.005
    assert {piece.notes["chosen"] for piece in flight.pieces} == {"area_loop"}


# -- the choice, with methods made up --------------------------------------------------------


class Made(GaitMethod):
    """A method that plans nothing, or refuses every goal with its ``refusal``."""

    refusal: ClassVar[str] = ""
    built: ClassVar[list[str]] = []

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        if self.refusal:
            raise PlanningError(self.refusal)
        state = request.state
        path = BasePath(np.zeros(1), state.position[np.newaxis], state.quaternion[np.newaxis])
        q = state.q[np.newaxis]
        return self._schedule_of(request.goal, q, path, {})


def made(
    name: str,
    *,
    objection: str = "",
    refusal: str = "",
    controls: frozenset[Any] = GaitMethod.controls,
) -> type[Made]:
    def refuse(robot: SpaceRobot) -> None:
        if objection:
            raise PlanningError(objection)

    members = {"name": name, "refusal": refusal, "controls": controls}
    return type(name, (Made,), {**members, "require_suitable": staticmethod(refuse)})


def choice_of(*methods: type[Made]) -> tuple[Planner, list[str]]:
    robot, built = robot_named("planar_chain"), list[str]()

    def build(method: type[Made]) -> GaitMethod:
        built.append(method.name)
        return method(robot, PERIOD)

    candidates = {entry.name: Candidate(entry, partial(build, entry)) for entry in methods}
    return Planner(AutoGait(robot, PERIOD, candidates=candidates), TOLERANCE), built


ATTITUDE = frozenset({"attitude"})


def test_the_first_that_plans_is_taken_and_no_other_is_built() -> None:
    method, built = choice_of(
        made("a", objection="a wants wings."),
        made("b", refusal="b finds it too far."),
        made("c"),
        made("d"),
    )
    schedule = method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    assert schedule.notes["chosen"] == "c"
    assert built == ["b", "c"]
    because = str(schedule.notes["because"])
    assert "a wants wings." in because
    assert "b finds it too far." in because


def test_all_reasons_are_told_where_none_plans() -> None:
    method, _ = choice_of(made("a", objection="a wants wings."), made("b", refusal="Too far."))
    with pytest.raises(PlanningError, match=r"No method plans .* a: a wants wings\. b: Too far\."):
        method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))


def test_attitude_alone_is_no_substitute_for_a_pose() -> None:
    turns = made("turns", controls=ATTITUDE)
    method, built = choice_of(made("moves", refusal="Beyond stroke."), turns)
    with pytest.raises(PlanningError, match=r"Beyond stroke\..*leave the position of the base"):
        method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    # Where nothing moves the base, a turn is what there is.
    method, built = choice_of(made("moves", objection="moves wants sliders."), turns)
    schedule = method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    assert schedule.notes["chosen"] == "turns"
    assert built == ["turns"]
    assert schedule.controls == ATTITUDE


def test_a_goal_stays_with_its_method() -> None:
    first, second = made("first", refusal="Not now."), made("second")
    method, _ = choice_of(first, second)
    goal = goal_of([0, 0, 1])
    assert method.plan(at(np.zeros(2)), goal).notes["chosen"] == "second"
    first.refusal = ""
    correction = method.plan(at(np.zeros(2)), goal, correction=True)
    assert correction.notes["chosen"] == "second"
    other = method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    assert other.notes["chosen"] == "first"


def test_a_refused_goal_does_not_change_what_a_schedule_controls() -> None:
    turns = made("turns", controls=ATTITUDE)
    method, _ = choice_of(turns)
    schedule = method.plan(at(np.zeros(2)), goal_of([0, 0, 1]))
    turns.refusal = "Too far."
    with pytest.raises(PlanningError):
        method.plan(at(np.zeros(2)), goal_of([0, 0, 2]))
    assert schedule.controls == ATTITUDE


def test_every_method_of_the_registry_is_built_with_its_defaults() -> None:
    robot = robot_named("three_joint_arm")
    for name, entry in METHODS.items():
        assert type(build_method(name, robot, PERIOD, STEP, {})) is entry
