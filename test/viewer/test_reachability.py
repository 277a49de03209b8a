"""Goals that are checked in the background: against the planner of a stack, and by its process."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from threading import Event

import numpy as np
import psutil
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle

from spacerobot_ros import plan
from spacerobot_ros.errors import GoalError
from spacerobot_ros.model import load_robot
from spacerobot_ros.parameters import values_of
from spacerobot_ros.planning import Goal, RobotState
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Tolerance
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.viewer.reachability import (
    GoalCheck,
    GoalChecker,
    GoalQuestion,
    Verdict,
    answer_question,
    goal_tolerance,
    make_question,
    planned_goal,
    planned_links,
    planner_config,
)
from spacerobot_ros.viewer.state import Measured, Momenta, StackState

URDF = load_robot(robot_file("sliding_masses")).urdf
ORIGIN = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
SPEED = {"method": "lie_bracket", "lie_bracket.t1": 4.0, "lie_bracket.cycles": 0}


def question(*position: float, **parameters: object) -> GoalQuestion:
    """Ask for a position, of a planner with such parameters."""
    values = {**values_of(PlannerConfig()), **SPEED, **parameters, "robot": "elsewhere.urdf"}
    texts = {name: json.dumps(value) for name, value in values.items()}
    goal = Goal.checked(position, [0.0, 0.0, 0.0, 1.0])
    return GoalQuestion(URDF, texts, ORIGIN, goal)


def test_an_answer_is_what_the_planner_would_plan() -> None:
    answer = answer_question(question(0.1, 0.0, 0.05, tick_rate=10.0), Cancellation())
    own = plan(
        "sliding_masses", position=(0.1, 0.0, 0.05), method="lie_bracket", t1=4.0, cycles=0,
        control_period=0.1,
    )  # fmt: skip
    assert answer.verdict == Verdict.REACHABLE
    assert f"Reachable in {own.duration:.4g} s" in answer.message
    assert answer.shape is not None
    np.testing.assert_allclose(answer.shape, own.positions[-1], atol=1e-9)
    end = np.concatenate([own.path.position[-1], own.path.quaternion[-1]])
    assert answer.base is not None
    np.testing.assert_allclose(answer.base, end, atol=1e-12)


def test_joint_positions_of_a_goal_are_asked_for_and_a_method_without_them_says_so() -> None:
    asked = question(0.1, 0.0, 0.05)
    wanted = replace(asked, goal=replace(asked.goal, joint_positions=np.array([0.1, -0.05, 0.2])))
    answer = answer_question(wanted, Cancellation())
    assert answer.verdict == Verdict.PARTLY
    assert "'lie_bracket' does not control the final joint positions" in answer.message


def arm_question(*position: float) -> GoalQuestion:
    """Ask for a position of an arm, of a planner whose method controls the attitude alone."""
    urdf = load_robot(robot_file("three_joint_arm")).urdf
    return replace(question(*position, method="area_loop"), urdf=urdf)


def test_goal_components_that_a_method_does_not_control_are_named_with_their_errors() -> None:
    chain = arm_question(0.3, -0.4, 0.0)
    answer = answer_question(chain, Cancellation())
    assert answer.verdict == Verdict.PARTLY, answer
    assert "'area_loop' does not control the position: it ends 0.5 m off." in answer.message
    hand = Goal.of_end_effectors([EndEffectorGoal("link_3", np.ones(3))])
    refused = answer_question(replace(chain, goal=hand), Cancellation())
    assert refused.verdict == Verdict.REFUSED
    assert refused.message.startswith("area_loop plans for the base pose")
    here = replace(chain, goal=Goal.checked([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]))
    answer = answer_question(here, Cancellation())
    assert answer.verdict == Verdict.REACHABLE
    assert "control" not in answer.message


def test_a_base_whose_position_is_not_controlled_ends_where_the_centre_of_mass_stays() -> None:
    """The goal takes many pieces, of which one is planned: the attitude will be that of the goal,
    and the position follows from the centre of mass, by Pinocchio.
    """
    asked = arm_question(0.3, -0.4, 0.0)
    turned = Goal.from_rotvec([0.3, -0.4, 0.0], [0.05, -0.03, 0.09])
    state = replace(asked.state, q=np.array([0.4, -0.9, 1.1]))
    answer = answer_question(replace(asked, goal=turned, state=state), Cancellation())
    assert answer.verdict == Verdict.PARTLY, answer
    assert answer.base is not None
    assert answer.shape is not None
    np.testing.assert_allclose(answer.base[3:], turned.quaternion, atol=1e-12)
    oracle = PinocchioOracle(asked.urdf, load_robot(robot_file("three_joint_arm")).joint_names)
    oracle.set_configuration(state.q, state.quaternion, state.position)
    before = oracle.center_of_mass_W()
    oracle.set_configuration(answer.shape, answer.base[3:], answer.base[:3])
    np.testing.assert_allclose(oracle.center_of_mass_W(), before, atol=1e-9)
    left = np.linalg.norm(turned.position - answer.base[:3])
    assert left > 0.1
    assert f"does not control the position: it ends {left:.3g} m off." in answer.message


def test_a_refusal_has_the_sentence_of_the_planner_and_the_next_goal_is_planned() -> None:
    refused = answer_question(question(9.0, 0.0, 0.0), Cancellation())
    assert refused.verdict == Verdict.REFUSED
    assert "slider" in refused.message or "limits" in refused.message
    wrong = answer_question(question(0.1, 0.0, 0.0, method="none"), Cancellation())
    assert (wrong.verdict, "method" in wrong.message) == (Verdict.REFUSED, True)
    assert answer_question(question(0.1, 0.0, 0.0), Cancellation()).verdict == (Verdict.REACHABLE)


def test_a_cancelled_check_has_no_answer() -> None:
    cancellation = Cancellation()
    cancellation.cancel()
    with pytest.raises(PlanningCancelled):
        answer_question(question(0.1, 0.0, 0.0, method="optimal"), cancellation)


@pytest.mark.slow
def test_goals_of_links_are_planned_for_and_the_base_ends_where_the_plan_has_it() -> None:
    robot = load_robot(robot_file("three_joint_arm"))
    link, q = robot.links[-1].name, np.array([0.4, -0.9, 1.1])
    values = {**values_of(PlannerConfig()), "end_effectors": [link], "method": "resolved_rate"}
    texts = {name: json.dumps(value) for name, value in values.items()}
    aim = EndEffectorGoal(link, np.array([1.3, 0.9, 0.8]))
    start = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
    asked = GoalQuestion(robot.urdf, texts, start, Goal.of_end_effectors([aim]))
    answer = answer_question(asked, Cancellation())
    assert answer.verdict == Verdict.REACHABLE, answer
    assert re.fullmatch(r"Reachable in [\d.]+ s with 'resolved_rate'\.", answer.message)
    assert answer.shape is not None
    assert answer.base is not None
    # By Pinocchio the link is at its goal then, with the base off its place.
    oracle = PinocchioOracle(robot.urdf, robot.joint_names)
    _, at = oracle.link_pose(link, answer.shape, answer.base)
    np.testing.assert_allclose(at, aim.position, atol=5e-3)
    assert np.linalg.norm(answer.base[:3]) > 0.01
    far = Goal.of_end_effectors([replace(aim, position=np.array([9.0, 0.0, 0.0]))])
    assert answer_question(replace(asked, goal=far), Cancellation()).verdict == Verdict.REFUSED


def test_goals_by_part_are_one_goal_of_a_planner() -> None:
    base = Goal.checked([1.0, 2.0, 3.0], [0.5, -0.1, 0.7, 0.5], [0.25, 0.5])
    place, pose = (
        EndEffectorGoal("left", np.array([4.0, 5.0, 6.0])),
        EndEffectorGoal("right", np.array([7.0, 8.0, 9.0]), base.quaternion),
    )
    hands = {each.link: Goal.of_end_effectors([each]) for each in (place, pose)}
    tool = Goal(base.position, base.quaternion)
    free = planned_goal(hands)
    assert free.equals(Goal.of_end_effectors([place, pose]))
    both = planned_goal({"base": base, "end_effector": tool, **hands})
    assert both.equals(replace(base, end_effectors=(place, pose)))
    assert planned_goal({"base": base, "end_effector": tool}).equals(base)
    with pytest.raises(GoalError, match="for a controller's end-effector only"):
        planned_goal({"end_effector": tool})


def test_links_with_goals_are_those_of_the_planner_and_of_the_robot() -> None:
    servicer, dual_arm = (load_robot(robot_file(name)) for name in ("servicer", "dual_arm"))
    both = '["left_link_7", "right_link_7", "nobody"]'
    assert planned_links({}, servicer) == ("end_effector",)
    assert planned_links({"output": '"reference"'}, servicer) == ()
    assert planned_links({"end_effectors": both}, dual_arm) == ("left_link_7", "right_link_7")
    base = json.dumps([servicer.base_link, "end_effector"])
    assert planned_links({"end_effectors": base}, servicer) == ("end_effector",)
    assert planned_links({"tick_rate": "-1.0"}, servicer) == ()
    assert planned_links(None, servicer) == planned_links({}, None) == ()


def test_a_goal_of_a_link_is_not_for_a_controller() -> None:
    servicer = load_robot(robot_file("servicer"))
    measured = Measured(0.0, np.eye(7)[6], *np.zeros((3, 6)))
    state = StackState(measured)
    hand = Goal.of_end_effectors([EndEffectorGoal("end_effector", np.ones(3))])
    base = Goal.checked(np.ones(3), [0, 0, 0, 1])
    answer = make_question(state, {"end_effector": hand}, servicer, {})
    assert answer == "The goal is for a planner, but none is running."
    answer = make_question(state, {"base": base, "end_effector": hand}, servicer, {})
    assert answer == "No planner is running: a controller flies the base to any pose."
    planning = replace(state, planner=PlannerStatus(PlannerState.IDLE))
    asked = make_question(planning, {"end_effector": hand}, servicer, {"planner": {"a": "1"}})
    assert isinstance(asked, GoalQuestion)
    assert (asked.goal.end_effectors, asked.goal.base) == (hand.end_effectors, frozenset())
    assert asked.tool is None


@pytest.fixture
def checker() -> Iterator[GoalChecker]:
    checker = GoalChecker()
    yield checker
    checker.close()


def processes() -> list[psutil.Process]:
    """Return those that check goals."""
    children = psutil.Process().children()
    return [each for each in children if "viewer.reachability" in " ".join(each.cmdline())]


def looked(checker: GoalChecker, until: Callable[[GoalCheck], bool]) -> list[GoalCheck]:
    """Look until an answer is as wanted; return all that were there."""
    found: list[GoalCheck] = []
    end = time.monotonic() + 60.0
    while not (found and until(found[-1])):
        assert time.monotonic() < end, found[-3:]
        check = checker.latest_answer()
        if check is not None:
            found.append(check)
        Event().wait(0.005)  # The process needs the processor.
    return found


def test_the_last_goal_is_the_one_that_is_answered(checker: GoalChecker) -> None:
    for x in (0.1, 0.2, 9.0, 0.05):
        checker.ask(question(x, 0.0, 0.0))
    seen = looked(checker, lambda check: check.verdict is not Verdict.PLANNING)
    assert seen[-1].verdict is Verdict.REACHABLE
    assert seen[-1].base is not None
    assert seen[-1].base[0] == pytest.approx(0.05, abs=1e-3)
    assert {check.verdict for check in seen[:-1]} <= {Verdict.PLANNING}
    assert checker.latest_answer() is None
    # One that is cancelled has no answer, and a process that is killed has a successor.
    checker.ask(question(0.1, 0.0, 0.0))
    checker.cancel()
    assert checker.latest_answer() is None
    (process,) = processes()
    process.kill()
    process.wait()
    checker.ask(question(9.0, 0.0, 0.0))
    seen = looked(checker, lambda check: check.verdict is not Verdict.PLANNING)
    assert seen[-1].verdict is Verdict.REFUSED
    checker.close()
    assert not processes()


def test_the_arm_of_a_controlled_robot_reaches_its_goal_or_not() -> None:
    robot = load_robot(robot_file("servicer"))
    urdf, link = robot.urdf, robot.end_effector()
    oracle = PinocchioOracle(urdf, robot.joint_names)
    rng = np.random.default_rng(5)
    lower, upper = robot.limits("lower"), robot.limits("upper")
    for _ in range(3):
        # Where Pinocchio has the end-effector in some shape, it can be.
        q = rng.uniform(0.9 * lower, 0.9 * upper)
        turned = Rotation.from_rotvec(rng.normal(size=3)).as_quat()
        at = np.concatenate([rng.normal(size=3), turned])
        R, r = oracle.link_pose(link, q, at)
        base, tool = Goal(at[:3], turned), Goal(r, Rotation.from_matrix(R).as_quat())
        start = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(6))
        near = GoalQuestion(urdf, {}, start, base, tool, link)
        answer = answer_question(near, Cancellation())
        assert answer.verdict == Verdict.REACHABLE, answer
        shape = np.array(answer.shape)
        assert np.all((lower - 1e-6 <= shape) & (shape <= upper + 1e-6))
        _, reached = oracle.link_pose(link, shape, at)
        np.testing.assert_allclose(reached, tool.position, atol=1e-3)
    far = Goal(tool.position + np.array([9.0, 0.0, 0.0]), tool.quaternion)
    answer = answer_question(replace(near, tool=far), Cancellation())
    assert answer.verdict == Verdict.REFUSED
    assert "m and" in answer.message


def test_an_attitude_that_the_law_leaves_free_refuses_no_goal() -> None:
    """The scenario's own goals: of the hand of two joints, the law controls the place alone."""
    scenario = load_scenario("coordinated_control")
    robot, tool = load_robot(robot_file("planar_manipulator")), scenario.end_effector_goal
    assert tool is not None
    measured = replace(MEASURED, q=np.array([-1.0, 1.05]))
    state, goals = StackState(measured), {"base": scenario.goal, "end_effector": tool}
    verdicts = {}
    for outputs in ("", "x y", "x y rz"):
        texts = {"end_effector_outputs": json.dumps(outputs)}
        asked = make_question(state, goals, robot, {"controller": texts})
        assert isinstance(asked, GoalQuestion)
        verdicts[outputs] = answer_question(asked, Cancellation()).verdict
    assert verdicts == {"": Verdict.REACHABLE, "x y": Verdict.REACHABLE, "x y rz": Verdict.REFUSED}


# -- the checks of goals with a stand-in for their process, their time, and the schedules --------


ATTITUDE = np.array([0.5, -0.1, 0.7, 0.5]) / np.linalg.norm([0.5, -0.1, 0.7, 0.5])
PLACE = np.array([0.3, -1.2, 2.0])
GOAL = Goal.checked([1.0, 2.0, 3.0], ATTITUDE)
HAND = Goal.checked([1.5, 2.5, 3.5], ATTITUDE)


# -- the question -------------------------------------------------------------------------------


SERVICER = load_robot(robot_file("servicer"))
MEASURED = Measured(3.0, np.concatenate([PLACE, ATTITUDE]), *np.arange(18.0).reshape(3, 6))
PLANNING = StackState(MEASURED, planner=PlannerStatus(PlannerState.IDLE))


@pytest.mark.parametrize(
    ("state", "known", "reason"),
    [
        (StackState(), True, "No state received yet."),
        (replace(PLANNING, absent=frozenset({"planner"})), True, "The planner is offline."),
        (
            replace(PLANNING, planner=PlannerStatus(PlannerState.PLANNING)),
            True,
            "The planner is busy planning.",
        ),
        (PLANNING, False, "The planner's parameters have not been received yet."),
    ],
)
def test_why_no_question_is_asked(state: StackState, known: bool, reason: str) -> None:
    parameters = {"planner": {"tick_rate": "20.0"}} if known else {"controller": {}}
    assert make_question(state, {"base": GOAL}, SERVICER, parameters) == reason
    assert make_question(state, {"base": GOAL}, None, parameters) == "No state received yet."


def test_a_question_has_the_measured_state_and_the_momenta() -> None:
    momenta = Momenta(np.arange(6.0), np.zeros(6))
    parameters = {"planner": {"tick_rate": "20.0"}, "controller": {"law": '"step"'}}
    for given, expected in ((momenta, np.arange(6.0)), (None, np.zeros(6))):
        question = make_question(
            replace(PLANNING, momenta=given), {"base": GOAL}, SERVICER, parameters
        )
        assert isinstance(question, GoalQuestion)
        start = question.state
        np.testing.assert_array_equal(start.position, PLACE)
        np.testing.assert_array_equal(start.quaternion, ATTITUDE)
        np.testing.assert_array_equal(start.q, MEASURED.q)
        found = np.concatenate([start.linear_momentum, start.angular_momentum])
        np.testing.assert_array_equal(found, expected)
        assert (question.urdf, question.parameters) == (SERVICER.urdf, parameters["planner"])
        assert (question.goal, question.tool, question.link) == (GOAL, None, "")


def test_the_question_of_a_controller_is_for_its_end_effector() -> None:
    state = StackState(MEASURED, momenta=Momenta(np.ones(6), None))
    goals = {"base": GOAL, "end_effector": HAND}
    question = make_question(state, goals, SERVICER, {})
    assert isinstance(question, GoalQuestion)
    assert (question.goal, question.tool, question.link) == (GOAL, HAND, SERVICER.end_effector())
    elbow = {"controller": {"end_effector_frame": '"forearm"'}, "planner": {"a": "1"}}
    known = [name for name in SERVICER.frames if name != SERVICER.end_effector()][-1]
    elbow["controller"]["end_effector_frame"] = f'"{known}"'
    other = make_question(state, goals, SERVICER, elbow)
    assert isinstance(other, GoalQuestion)
    assert (other.link, other.parameters) == (known, {})
    absent = {"controller": {"end_effector_frame": '"nobody"'}}
    answer = make_question(state, goals, SERVICER, absent)
    assert answer == "The end-effector is not a robot link."


def test_the_robot_of_a_planner_is_that_of_the_page() -> None:
    texts = {"robot": '"other"', "world": '"strut.urdf"', "robot_description": '"<robot/>"'}
    config = planner_config(
        {**texts, "tick_rate": "17.0", "averaging": "null", "no_parameter": "{"}
    )
    assert (config.robot, config.world, config.robot_description) == ("", "", "")
    assert config.tick_rate == 17.0
    assert config.averaging == type(config)().averaging


def test_the_tolerances_of_goals_are_those_of_the_commander() -> None:
    texts = {"position_tolerance": "0.01", "attitude_tolerance": "0.02", "joint_tolerance": "0.03"}
    assert goal_tolerance(texts, SERVICER) == Tolerance(0.01, 0.02, 0.03)
    automatic = goal_tolerance({**texts, "position_tolerance": "0.0"}, SERVICER)
    assert automatic == Tolerance(
        PlannerConfig().for_robot(SERVICER).position_tolerance, 0.02, 0.03
    )
    assert goal_tolerance({"position_tolerance": "0.01"}, SERVICER) is None
