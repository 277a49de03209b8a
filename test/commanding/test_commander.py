"""Commanders without ROS: goals, states and plants that come in any order, and their answers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commanding.commanders import GOAL, METHOD, Client, Rig, TrajectoryServer, active, config
from support.executive_loop import planar_manipulator
from support.sentences import assert_one_sentence

from spacerobot_ros.commanding.controller import JOINT_REFERENCE, ControllerCommander
from spacerobot_ros.commanding.fly_to import FlyTo
from spacerobot_ros.commanding.host import ArrayDecoder, CommanderActivity, StateArrays
from spacerobot_ros.commanding.planner import PlannerCommander, TrajectoryOutput
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.goals import END_EFFECTOR, GOAL_KEYS
from spacerobot_ros.control.servicing import Task
from spacerobot_ros.errors import CommandError, ParameterError, PlanningError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import (
    BASE_GOAL_KEY,
    GoalFile,
    IdentifiedGoal,
    PursuedGoals,
)
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation.status import PlantState, PlantStatus

LATCHED = PlantStatus(PlantState.LATCHED, "Nothing moves.", "abort", "a fuse is blown")


@pytest.fixture(scope="module")
def robot() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("sliding_masses")))


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("planar_manipulator")))


@pytest.fixture
def planner(robot: SpaceRobot) -> Rig:
    return active(PlannerCommander, config(PlannerConfig, **METHOD), robot)


@pytest.fixture
def controller(arm: SpaceRobot) -> Rig:
    return active(ControllerCommander, config(ControllerConfig), arm)


def test_goals_of_the_base_are_left_to_a_planner_whose_reference_a_law_of_joints_tracks(
    arm: SpaceRobot, tmp_path: Path
) -> None:
    file = tmp_path / "goal.json"

    def told(*publishers: str) -> Rig:
        settings = {"law": "computed_torque", "resume_file": str(file)}
        rig = Rig(ControllerCommander, config(ControllerConfig, **settings), arm.n)
        rig.use(arm)
        rig.host.publishers |= {*publishers}
        rig.commander.activate()
        rig.goal()
        return rig

    left = told(JOINT_REFERENCE)
    assert left.host.states == ["waiting"]
    assert left.host.events == []
    assert left.host.lines[-1][1].startswith("The goal is left to the planner. The law 'computed_")
    assert not file.exists(), "the planner's goal is not resumed by the controller"
    refused = told()
    assert refused.host.states == ["waiting", "refused"]
    assert_one_sentence(refused.host.statuses[0].message)


# -- states -----------------------------------------------------------------------------------


def test_faults_of_messages_are_logged_from_the_start_of_the_clock_once_a_period(
    robot: SpaceRobot,
) -> None:
    rig = Rig(PlannerCommander, config(PlannerConfig, **METHOD), robot.n)
    rig.wall = 0.0
    rig.use(robot)
    rig.commander.activate()
    for wall, count in ((0.0, 1), (4.99, 1), (5.0, 2), (9.99, 2), (10.0, 3)):
        rig.wall = wall
        rig.joints(1, n=7)
        assert rig.host.lines == [("error", "joint_states: joint 'wing' is unknown.")] * count


def test_a_jump_is_answered_with_its_pose_once_its_time_is_accepted(controller: Rig) -> None:
    for tick in range(1, 4):
        controller.state(tick)
        controller.wall += 0.001
    controller.state(5000)
    assert controller.host.commands == [1, 2, 3]
    for _ in range(6):
        controller.wall += 0.1
        controller.commander.take_accepted_jump()
    assert controller.host.commands == [1, 2, 3, 5000]
    assert controller.commander.executive.state.value == "holding"


def test_while_the_plant_is_paused_no_jump_is_accepted_and_goals_say_so(planner: Rig) -> None:
    planner.state(0)
    planner.state(1)
    planner.commander.receive_plant_status(PlantStatus(PlantState.PAUSED, "Time stands still."))
    planner.state(5000)
    for _ in range(10):
        planner.wall += 0.1
        planner.commander.take_accepted_jump()
    assert planner.host.commands == [0, 1]
    planner.goal()
    for _ in range(20):
        planner.wall += 0.1
        planner.commander.take_accepted_jump()
    waiting = planner.host.statuses[-1]
    assert waiting.message == (
        "Waiting for the plant, which is paused: resume it. The goal is then pursued."
    )
    planner.commander.receive_plant_status(PlantStatus(PlantState.RUNNING, "A test."))
    planner.commander.take_accepted_jump()
    planner.state(2)
    assert planner.host.statuses[-1].state.value == "executing"
    assert "ceased" not in "".join(status.message for status in planner.host.statuses)


def test_a_goal_that_waits_for_a_robot_says_so_once(robot: SpaceRobot) -> None:
    rig = Rig(PlannerCommander, config(PlannerConfig, **METHOD), robot.n)
    rig.commander.activate()
    rig.goal()
    rig.commander.take_accepted_jump()
    pursued = [status.message for status in rig.host.statuses if status.goal_id]
    assert pursued == ["Waiting for a robot on 'robot_description'. The goal is then pursued."]


def test_ignored_states_are_reported_once_a_second(planner: Rig) -> None:
    planner.state(0)
    planner.state(1)
    warned = []
    for tick in range(2, 32):
        planner.wall += 0.05
        planner.joints(tick + 3000)
        planner.state(tick)
        warned += [text for text in [planner.commander.take_accepted_jump()] if text]
    assert 1 <= len(warned) <= 2
    assert "ahead of" in warned[0]
    assert ("warning", warned[0]) in planner.host.lines


# -- the references of a controller -----------------------------------------------------------


def test_goals_for_a_robot_that_is_refused_are_refused_for_the_same_reason(arm: SpaceRobot) -> None:
    rig = Rig(ControllerCommander, config(ControllerConfig), arm.n)
    rig.commander.activate()
    rig.goal(sec=1)
    rig.commander.refuse_robot("The thruster force limit is inf: set max_force.")
    rig.goal(sec=2)
    why = "The robot on 'robot_description' is refused: The thruster force limit is inf: set max_f"
    refused = [each for each in rig.host.statuses if each.state.value == "refused"]
    assert [each.goal_id for each in refused] == ["1.000000000", "2.000000000"]
    assert all(each.message.startswith(why) for each in refused)
    rig.wall += 2.0
    rig.commander.take_accepted_jump()
    waiting = [each.message for each in rig.host.statuses if each.state.value == "waiting"]
    assert waiting[-1].startswith(f"Waiting for another robot. {why}")
    rig.commander.drop_robot("robot_description now describes another robot.")
    rig.use(arm)
    assert rig.goal(sec=3) is not None


def test_a_controller_says_what_it_waits_for(arm: SpaceRobot) -> None:
    rig = Rig(ControllerCommander, config(ControllerConfig), arm.n)

    def said() -> str:
        rig.wall += 2.0
        rig.commander.take_accepted_jump()
        assert set(rig.host.states) == {"waiting"}
        assert {status.state.level for status in rig.host.statuses} == {0}
        return str(rig.host.statuses[-1].message)

    rig.commander.activate()
    assert rig.host.statuses[-1].message == "Waiting for a robot on 'robot_description'."
    rig.use(arm)
    rig.host.publishers |= {"joint_states"}
    assert said() == "Waiting for states on 'joint_states' and 'odom'."
    count = len(rig.host.statuses)
    assert said() == "Waiting for states on 'joint_states' and 'odom'."
    assert len(rig.host.statuses) == count, "it is said once"
    rig.host.publishers -= {"odom", "joint_states"}
    both = "'joint_states' and 'odom'"
    assert said() == f"Waiting for states on {both}, and no node publishes {both}."
    rig.host.publishers |= {"joint_states"}
    assert said() == f"Waiting for states on {both}, and no node publishes 'odom'."
    rig.odom(1)
    assert said() == "Waiting for states on 'joint_states'."
    rig.joints(1)
    assert rig.host.states[-1] == "holding"
    rig.commander.deactivate()
    rig.commander.activate()
    assert rig.host.states[-1] == "holding"
    rig.wall += 5.0
    rig.commander.take_accepted_jump()
    assert rig.host.states[-1] == "holding", "this process itself may have stood still"
    for _ in range(8):
        rig.wall += 0.3
        rig.commander.take_accepted_jump()
    ceased = "Waiting for states on 'joint_states', which have ceased."
    assert rig.host.statuses[-1].message == ceased
    rig.state(2)
    assert rig.host.states[-1] == "holding"
    for _ in range(8):
        rig.wall += 0.3
        rig.joints(3, n=7)
        rig.commander.take_accepted_jump()
    rejected = "whose messages are rejected: joint 'wing' is unknown"
    assert rig.host.statuses[-1].message == ceased.replace("which have ceased", rejected)


def referenced(arm: SpaceRobot, *, busy: bool, law: str = "computed_torque") -> Rig:
    """Return a controller with a state, and a planner whose reference is still to come."""
    settings = config(ControllerConfig, law=law, reference_timeout=1.0)
    rig = Rig(ControllerCommander, settings, arm.n, partner_is_busy=lambda: busy)
    rig.use(arm)
    rig.host.publishers.add(JOINT_REFERENCE)
    rig.commander.activate()
    rig.state(1)
    return rig


@pytest.mark.parametrize("busy", [False, True])
def test_states_wait_for_the_reference_of_a_planner_that_is_busy(
    arm: SpaceRobot, busy: bool
) -> None:
    rig = referenced(arm, busy=busy)
    for _ in range(30):
        rig.wall += 0.1
        rig.commander.take_accepted_jump()
    assert rig.host.commands == ([] if busy else [1])
    if busy:
        # It is killed while it plans.
        rig.host.publishers.discard(JOINT_REFERENCE)
        for _ in range(30):
            rig.wall += 0.1
            rig.commander.take_accepted_jump()
        assert rig.host.commands == [1]
    (line,) = (text for level, text in rig.host.lines if level == "warning")
    assert_one_sentence(line, "'joint_reference' is silent")


def test_a_process_that_slept_does_not_count_it_as_silence(arm: SpaceRobot) -> None:
    rig = referenced(arm, busy=False)
    rig.wall += 60.0
    rig.commander.take_accepted_jump()
    assert rig.host.commands == []
    rig.commander.receive_reference(JOINT_REFERENCE, *rig.stamped(1))
    assert rig.host.commands == [1]


@pytest.mark.parametrize("law", ["computed_torque", "model_based"])
def test_a_reference_of_joints_that_are_not_controlled_is_named(arm: SpaceRobot, law: str) -> None:
    """By default, a model-based law controls the base and the end-effector."""
    rig = referenced(arm, busy=False, law=law)
    rig.commander.receive_reference(JOINT_REFERENCE, *rig.stamped(1))
    errors = [text for level, text in rig.host.lines if level == "error"]
    assert len(errors) == (law == "model_based")
    for text in errors:
        assert_one_sentence(text, "'joint_reference' is ignored", "joint_outputs")


# -- goals ------------------------------------------------------------------------------------


def test_a_goal_is_never_lost_without_a_word(planner: Rig, controller: Rig) -> None:
    def unreadable() -> Goal:
        raise PlanningError("The goal is in another frame.")

    for rig in (planner, controller):
        commander, host = rig.commander, rig.host
        commander.receive_goal(BASE_GOAL_KEY, 1, 0, unreadable)
        commander.deactivate()
        rig.goal(sec=2)
        commander.activate()
        commander.receive_plant_status(LATCHED, "/a/plant")
        rig.goal(sec=3)
        refused = [status for status in host.statuses if status.state.value == "refused"]
        assert [each.goal_id for each in refused] == [f"{n}.000000000" for n in (1, 2, 3)]
        for status, word in zip(refused, ("frame", "inactive", "'/a/plant'"), strict=True):
            assert_one_sentence(status.message, word)
        told = [event.goal_id for event in host.events if event.kind is EventKind.GOAL_REFUSED]
        assert told == [status.goal_id for status in refused]


@pytest.mark.parametrize("kind", ["planner", "controller"])
def test_a_commander_that_is_to_stop_with_the_decision_answers_no_later_state(
    robot: SpaceRobot, arm: SpaceRobot, kind: str
) -> None:
    if kind == "planner":
        settings = config(PlannerConfig, **METHOD, stop_when_decided=True)
        rig = active(PlannerCommander, settings, robot)
    else:
        settings = config(ControllerConfig, stop_when_decided=True, settle_time=0.1)
        rig = active(ControllerCommander, settings, arm)
    rig.state(1)
    assert rig.commander.active
    rig.goal(goal=Goal.checked(np.zeros(3), [0.0, 0.0, 0.0, 1.0]))
    for tick in range(2, 12):
        rig.state(tick)
    assert rig.host.states[-1] == "reached"
    assert rig.commander.activity is CommanderActivity.DECIDED
    assert rig.host.commands[-1] < 11
    rig.commander.deactivate()
    rig.commander.activate()
    assert rig.commander.active


@pytest.mark.parametrize(
    ("goes", "words", "last"),
    [(10, "the server of the action '/arm' is gone", 24), (999, "has not responded", 106)],
)
def test_a_goal_fails_with_a_server_of_trajectories_that_goes_or_is_silent(
    robot: SpaceRobot, goes: int, words: str, last: int
) -> None:
    rig = active(PlannerCommander, config(PlannerConfig, **METHOD, output="trajectory"), robot)
    server = TrajectoryServer()
    rig.commander.trajectories = TrajectoryOutput(server, "/arm", rig.commander.end_schedule)
    rig.goal()
    tick = 0
    while "failed" not in rig.host.states:
        tick += 1
        server.present = tick < goes
        rig.state(tick)
        assert tick <= last
    assert tick > last - 4
    assert words in rig.host.statuses[-1].message
    assert (len(server.sent), server.cancelled) == (1, [1])


def test_a_goal_of_an_action_that_a_later_one_replaces_is_reported_as_aborted(planner: Rig) -> None:
    first, second = Client(), Client()
    for goal_id, client in (("a", first), ("b", second)):
        planner.commander.receive_fly_to(goal_id, lambda: FlyTo(GOAL), client)
    decided = [(each.state.value, each.goal_id) for each in planner.host.statuses if each.goal_id]
    assert decided == [("aborted", "a")]
    ended = [each.goal_id for each in planner.host.events if each.kind is EventKind.GOAL_ABORTED]
    assert ended == ["a"]
    assert first.end_of[0] == "aborted"
    assert not second.results


@pytest.mark.parametrize("first", ["refused", "accepted"])
def test_a_goal_of_which_a_pose_is_refused_moves_nothing(planner: Rig, first: str) -> None:
    def elsewhere() -> Goal:
        raise PlanningError("The goal is in another frame.")

    parts = [(BASE_GOAL_KEY, elsewhere), ("end_effector", lambda: GOAL)]
    for key, read in parts if first == "refused" else reversed(parts):
        planner.commander.receive_goal(key, 5, 0, read)
    for tick in range(1, 9):
        planner.state(tick)
    decided = [each for each in planner.host.statuses if each.goal_id == "5.000000000"]
    assert {each.state.value for each in decided} == {first.replace("accepted", "aborted")}
    assert "frame" in decided[0].message
    assert not planner.host.starts
    planner.goal(sec=5)  # once more, by the topic of the pose that was refused
    planner.state(9)
    planner.state(10)
    assert planner.host.states[-1] == "executing"


def test_after_the_end_of_a_waiting_goal_the_last_status_is_about_the_present_one(
    planner: Rig,
) -> None:
    planner.goal(sec=7)
    for tick in range(1, 4):
        planner.state(tick)
    planner.goal(sec=8)
    planner.goal(sec=9)  # before a state from which goal 8 could be planned
    told = [(each.state.value, each.goal_id[:1]) for each in planner.host.statuses]
    assert told[-3:] == [("executing", "7"), ("aborted", "8"), ("executing", "7")]
    planner.commander.receive_plant_status(PlantStatus(PlantState.PAUSED, "Time stands still."))
    for _ in range(20):
        planner.wall += 0.1
        planner.commander.take_accepted_jump()
    planner.goal(sec=10)
    planner.commander.take_accepted_jump()
    assert planner.host.states[-3:] == ["waiting", "aborted", "waiting"]


def test_goals_that_are_pursued_together_are_aborted_together(controller: Rig) -> None:
    rig = controller
    rig.state(1)
    client, flat = Client(), Goal.checked([0.05, -0.03, 0.0], [0.0, 0.0, 0.0, 1.0])
    rig.commander.receive_fly_to("a", lambda: FlyTo(flat), client)
    rig.state(2)
    rig.commander.receive_goal(END_EFFECTOR, 8, 0, lambda: flat)
    for tick in (3, 4):
        rig.state(tick)
    assert not client.results
    rig.commander.cancel_fly_to("a")
    rig.state(5)
    decided = [(each.state.value, each.goal_id) for each in rig.host.statuses]
    assert ("aborted", "a") in decided
    assert ("aborted", "8.000000000") in decided
    outcome, message = client.end_of
    assert outcome == "aborted"
    assert "replaced" not in message


def test_goals_on_file_are_resumed_and_deleted_when_they_are_aborted(
    robot: SpaceRobot, tmp_path: Path
) -> None:
    path = tmp_path / "goal.json"
    GoalFile(str(path)).pursue(PursuedGoals({BASE_GOAL_KEY: IdentifiedGoal(GOAL, "9.000000000")}))
    rig = Rig(PlannerCommander, config(PlannerConfig, resume_file=str(path), **METHOD), robot.n)
    rig.commander.activate()
    assert (rig.host.states[-1], rig.host.statuses[-1].goal_id) == ("waiting", "9.000000000")
    rig.commander.give_up_goals("Node '/plant' is silent.")
    assert_one_sentence(rig.host.statuses[-1].message, "Aborted", "silent")
    assert not path.exists()


@pytest.mark.parametrize("kind", [PlannerCommander, ControllerCommander])
def test_goals_that_wait_are_on_file(kind: type, robot: SpaceRobot, tmp_path: Path) -> None:
    path = tmp_path / "goal.json"
    given: dict[type, Any] = {
        PlannerCommander: (PlannerConfig, METHOD),
        ControllerCommander: (ControllerConfig, {}),
    }
    config_class, settings = given[kind]

    def restarted() -> Rig:
        rig = Rig(kind, config(config_class, resume_file=str(path), **settings), robot.n)
        rig.commander.activate()
        return rig

    def on_file() -> str:
        return GoalFile(str(path), GOAL_KEYS).load()[BASE_GOAL_KEY].goal_id

    first = restarted()
    for stamp in (7, 8):
        first.commander.receive_goal(BASE_GOAL_KEY, stamp, 0, lambda: GOAL)
        assert on_file() == f"{stamp}.000000000"
    # Neither has been pursued when this process is killed.
    second = restarted()
    assert second.host.statuses[-1].goal_id == "8.000000000"
    second.commander.receive_goal(BASE_GOAL_KEY, 9, 0, lambda: GOAL)
    assert on_file() == "9.000000000"
    second.commander.abort()
    assert not path.exists()


# -- the plant and its robot ------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["planner", "controller"])
@pytest.mark.parametrize("latched", [False, True])
def test_a_plant_that_is_reset_shows_another_pose_of_one_time(
    kind: str, *, latched: bool, request: pytest.FixtureRequest
) -> None:
    rig: Rig = request.getfixturevalue(kind)
    before = LATCHED if latched else PlantStatus(PlantState.RUNNING, "A command is active.")
    rig.state(1)
    rig.commander.receive_plant_status(before)
    rig.commander.receive_plant_status(replace(before, resets=1))
    rig.state(1)
    assert rig.host.commands == [1, 1]
    # The status of another reset comes after the pose.
    rig.odom(1)
    rig.commander.receive_plant_status(replace(before, resets=2))
    rig.state(2)
    rig.odom(2)
    assert not any("differ" in line for _, line in rig.host.lines)
    # Two nodes that publish odom go on with it.
    rig.state(3)
    rig.odom(3)
    assert any("differ" in line for _, line in rig.host.lines)


# -- a robot that captures a target -----------------------------------------------------------

HELD = Payload("link_1", Inertia(4.0, np.array([0.1, -0.2, 0.3]), np.diag([0.2, 0.3, 0.4])))
CAPTURED = PlantStatus(PlantState.RUNNING, "A command is active.", payload=HELD.to_text())


def test_a_planner_plans_again_for_the_robot_with_the_body_that_it_holds(
    planner: Rig, robot: SpaceRobot
) -> None:
    held = Payload(robot.link_names[1], HELD.inertia)
    planner.goal()
    for tick in range(1, 5):
        planner.state(tick)
    assert planner.host.states[-1] == "executing"
    planner.commander.receive_plant_status(replace(CAPTURED, payload=held.to_text()))
    assert planner.commander.robot.total_mass == pytest.approx(robot.total_mass + 4.0)
    told = planner.host.statuses[-1].message
    assert told == "The robot has a different mass now: the motion is replanned."
    plans = planner.commander.statistics.plans
    for tick in range(5, 9):
        planner.state(tick)
    assert planner.commander.statistics.plans == plans + 1
    assert planner.host.commands == list(range(1, 9))


def test_a_commander_that_comes_after_a_capture_knows_of_it(
    arm: SpaceRobot, robot: SpaceRobot
) -> None:
    rig = Rig(ControllerCommander, config(ControllerConfig), arm.n)
    rig.commander.receive_plant_status(CAPTURED)
    rig.use(arm)
    assert rig.commander.robot.total_mass == pytest.approx(arm.total_mass + 4.0)
    # Of a robot without that link nothing is believed.
    other = Rig(PlannerCommander, config(PlannerConfig, **METHOD), robot.n)
    other.commander.receive_plant_status(CAPTURED)
    other.use(robot)
    assert other.commander.robot is robot
    ((level, line),) = other.host.lines
    assert level == "error"
    assert line.startswith("plant/status: The payload is held by link 'link_1', but robot ")


# -- disturbances -----------------------------------------------------------------------------


@pytest.mark.parametrize("output", ["commands", "reference"])
def test_a_plan_that_a_disturbance_pushes_is_reported_with_a_warning(
    robot: SpaceRobot, output: str
) -> None:
    """Of a free-floating robot: a controller that tracks a reference has thrusters."""
    rig = active(PlannerCommander, config(PlannerConfig, output=output, **METHOD), robot)

    def pushed(*lines: str) -> None:
        rig.commander.receive_plant_status(
            PlantStatus(PlantState.RUNNING, "It runs.", disturbances=lines)
        )

    pushed("mass_1 force 1 0 0 in world at 0")
    assert not any(each.kind is EventKind.PLAN_DISTURBED for each in rig.host.events)
    rig.goal()
    for tick in range(1, 4):
        rig.state(tick)
    assert "executing" in rig.host.states
    pushed("mass_1 force 1 0 0 in world at 0", "mass_2 torque 0 0 1 in link at 0.2")
    pushed("mass_2 torque 0 0 1 in link at 0.2")
    pushed()
    found = [each for each in rig.host.events if each.kind is EventKind.PLAN_DISTURBED]
    if output == "reference":
        assert found == []
        return
    assert [each.message for each in found] == [
        f"The plan assumes constant momenta, but a disturbance changes them: {line}."
        for line in ("mass_1 force 1 0 0 in world at 0", "mass_2 torque 0 0 1 in link at 0.2")
    ]
    assert {(each.level, each.goal_id) for each in found} == {(1, rig.host.statuses[-1].goal_id)}
    assert found[0].goal_id


# -- obstacles --------------------------------------------------------------------------------

BALL = (
    '<robot name="w"><link name="w"/><link name="ball"><collision><geometry><sphere radius="0.3"/>'
    '</geometry></collision></link><joint name="a" type="fixed"><parent link="w"/>'
    '<child link="ball"/></joint></robot>'
)


def test_obstacles_are_told_of_once_and_refused_ones_leave_those_so_far(robot: SpaceRobot) -> None:
    rig = Rig(PlannerCommander, config(PlannerConfig, **METHOD), robot.n)
    rig.commander.receive_obstacles(BALL)
    rig.use(robot)
    rig.commander.receive_obstacles(BALL)
    rig.commander.receive_obstacles(BALL.replace('"fixed"', '"floating"'))
    rig.commander.receive_obstacles(BALL.replace("ball", "stone"))
    rig.commander.receive_obstacles("")
    told = [
        "1 obstacle: ball",
        "The previous obstacles are kept",
        "1 obstacle: stone",
        "0 obstacles",
    ]
    assert len(rig.host.lines) == len(told)
    for (level, line), words in zip(rig.host.lines, told, strict=True):
        assert words in line
        assert (level == "error") is ("are kept" in words)


# -- rates that are commanded ---------------------------------------------------------------------


KINDS = {
    "planner": (PlannerCommander, PlannerConfig, "sliding_masses", "velocity"),
    "controller": (ControllerCommander, ControllerConfig, "planar_manipulator", "effort"),
}


class RateRig(Rig):
    """A commander, and a robot at rest whose states come at a rate."""

    def __init__(self, kind: str, **settings: Any) -> None:
        make, kind_of_config, robot, self.actuation = KINDS[kind]
        model = SpaceRobot(load_robot(robot_file(robot)))
        super().__init__(make, configured(kind_of_config, settings), model.n)
        self.time = 40.0
        self.use(model)
        self.commander.activate()

    def states(self, count: int, rate: float) -> None:
        for _ in range(count):
            self.time += 1 / rate
            self.wall += 1 / rate
            state = replace(self.message(0), stamp_ns=round(self.time * 1e9))
            self.commander.receive_odom(state.stamp_ns, state)
            self.commander.receive_joints(state.stamp_ns, state)
            self.commander.take_accepted_jump()

    def plant_says(self, **about: Any) -> None:
        given = {"actuation": self.actuation, "time_mode": "realtime", **about}
        self.commander.receive_plant_status(PlantStatus(PlantState.RUNNING, "A test.", **given))

    @property
    def warnings(self) -> list[str]:
        return [line for level, line in self.host.lines if level in ("warning", "error")]


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rate", [2.0, 10.0, 50.0, 200.0])
def test_states_of_any_rate_are_answered_from_the_third_on(kind: str, rate: float) -> None:
    rig = RateRig(kind)
    rig.states(30, rate)
    assert len(rig.host.commands) == 28
    assert rig.commander.config.control_period == pytest.approx(1 / rate, rel=1e-6)
    assert not rig.warnings


@pytest.mark.parametrize("kind", KINDS)
def test_a_rate_that_differs_from_the_parameter_is_followed_and_said_once(kind: str) -> None:
    rig = RateRig(kind, tick_rate=100.0)
    rig.states(60, 20.0)
    assert len(rig.host.commands) == 60
    assert rig.commander.config.tick_rate == pytest.approx(20.0)
    (line,) = rig.warnings
    assert_one_sentence(line.split(". Set")[0] + ".", "'tick_rate'", "100 Hz", "20 Hz")


@pytest.mark.parametrize("kind", KINDS)
def test_states_that_are_skipped_do_not_change_the_rate(kind: str) -> None:
    """As under load, where only the last of several states is answered."""
    rig = RateRig(kind)
    rig.states(5, 20.0)
    for skipped in (2, 2, 3, 2, 2, 1, 2, 2, 1, 2):
        rig.states(1, 20.0 / skipped)
        assert rig.commander.config.tick_rate == pytest.approx(20.0)
    assert not rig.warnings


@pytest.mark.parametrize("kind", KINDS)
def test_a_rate_that_is_told_beside_the_first_states_leaves_their_order(kind: str) -> None:
    rig = RateRig(kind)
    rig.host.process_statuses = lambda: rig.plant_says(tick_rate_hz=20.0)
    waiting = [rig.stamped(tick) for tick in (2, 3)]
    rig.host.waiting = waiting, waiting
    rig.state(1)
    for tick in range(4, 30):
        rig.wall += 0.05
        rig.state(tick)
        rig.commander.take_accepted_jump()
    assert rig.commander.config.tick_rate == 20.0
    assert rig.host.commands == [3, *range(4, 30)]
    assert not rig.warnings


@pytest.mark.parametrize("kind", KINDS)
def test_the_first_state_of_a_plant_in_lockstep_is_answered(kind: str) -> None:
    rig = RateRig(kind)
    rig.plant_says(tick_rate_hz=25.0, time_mode="lockstep")
    rig.states(1, 25.0)
    assert len(rig.host.commands) == 1
    assert rig.commander.config.tick_rate == 25.0
    assert not rig.warnings


@pytest.mark.parametrize(("rate", "other"), [(5.0, 40.0), (40.0, 8.0)])
def test_plans_have_the_period_of_the_plant(rate: float, other: float) -> None:
    """Also one that is restarted with another rate."""
    method = {"method": "lie_bracket", "lie_bracket.t1": 2.0, "lie_bracket.n1": 1}
    rig = RateRig("planner", **method)
    for each in (rate, other):
        rig.plant_says(tick_rate_hz=each, time_mode="lockstep")
        rig.states(3, each)
        stamp = round(rig.time)
        rig.commander.receive_goal(BASE_GOAL_KEY, stamp, 0, lambda: GOAL)
        rig.states(2, each)
        assert rig.host.starts[-1].control_period == pytest.approx(1 / each)
    assert rig.host.statuses[-1].state.value == "executing"


def test_a_goal_that_comes_before_the_rate_is_not_called_planned_again() -> None:
    rig = RateRig("planner")
    rig.goal()
    rig.plant_says(tick_rate_hz=20.0, time_mode="lockstep")
    assert [status.message for status in rig.host.statuses[1:]] == [
        "The plant's rate is known: the motion is planned."
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_a_plant_of_other_commands_is_named_once_and_goals_are_refused(kind: str) -> None:
    rig = RateRig(kind)
    rig.plant_says(actuation="auto")
    assert not rig.warnings
    other = "velocity" if rig.actuation == "effort" else "effort"
    for _ in range(3):
        rig.plant_says(actuation=other, tick_rate_hz=20.0)
        rig.states(5, 20.0)
    (line,) = rig.warnings
    assert_one_sentence(line, "actuation:=")
    rig.commander.receive_goal(BASE_GOAL_KEY, 7, 0, lambda: GOAL)
    assert rig.host.statuses[-1].state.value == "refused"
    assert rig.host.statuses[-1].message == line


TICK = 10_000_000
TARGET = load_robot(share_directory() / "config" / "targets" / "block.urdf")
UPRIGHT = [0.0, 0.0, 0.0, 1.0]


class TargetRig(Rig):
    """A controller that hears of a target, every 10 ms."""

    def __init__(self, **settings: Any) -> None:
        given = {"tick_rate": 100.0, "status_period": 0.01, **settings}
        super().__init__(ControllerCommander, configured(ControllerConfig, given), 2)

    def begin(self) -> None:
        self.commander.use_robot(planar_manipulator(), ArrayDecoder())
        self.commander.activate()

    def target(self, tick: int) -> None:
        pose, twist = np.array([1.9, -0.6, 0.0, *UPRIGHT]), np.array([0.001, 0, 0, 0, 0, 0.002])
        message = StateArrays(tick * TICK, np.zeros(0), np.zeros(0), pose, twist)
        self.commander.receive_target(tick * TICK, message)

    def state(self, tick: int) -> None:
        q, pose = np.array([-1.0, 1.0]), np.array([0.0, 0.0, 0.0, *UPRIGHT])
        state = StateArrays(tick * TICK, q, np.zeros(2), pose, np.zeros(6))
        self.commander.receive_odom(tick * TICK, state)
        self.commander.receive_joints(tick * TICK, state)


def test_a_task_is_asked_of_an_active_controller() -> None:
    rig = TargetRig()
    with pytest.raises(CommandError, match="not active"):
        rig.commander.request(Task.DETUMBLE)
    rig.begin()
    assert_one_sentence(rig.commander.request(Task.DETUMBLE), "'detumble' has started")
    rig.state(1)
    assert rig.host.statuses[-1].task == "detumble"  # type: ignore[union-attr]
    rig.commander.receive_plant_status(LATCHED)
    with pytest.raises(CommandError, match="latched: a fuse is blown"):
        rig.commander.request(Task.APPROACH)


def test_a_task_that_does_not_exist_is_refused_with_the_robot() -> None:
    with pytest.raises(ParameterError) as refused:
        TargetRig(tasks="grab").begin()
    assert_one_sentence(str(refused.value), "Parameter 'tasks' names 'grab'")


def test_the_goal_waits_for_its_tasks_and_fails_with_a_target_that_is_lost() -> None:
    # The arm of this rig grasps obliquely, past a corner of the block.
    given = {"tasks": "approach", "target.clearance": 0.0, "target.timeout": 0.025}
    rig = TargetRig(**given)
    rig.begin()
    rig.commander.use_target(TARGET)
    rig.commander.receive_goal("base", 0, 7, lambda: Goal.checked([0.1, 0.0, 0.0], UPRIGHT))
    rig.target(1)
    rig.state(1)
    last = rig.host.statuses[-1]
    assert (last.state.value, last.goal_id) == ("tracking", "0.000000007")
    assert last.task == "approach"  # type: ignore[union-attr]
    for tick in range(2, 5):
        rig.state(tick)
    assert rig.host.statuses[-1].state.value == "aborted"
    assert "the target is lost: its odometry is 0.03 s old" in rig.host.statuses[-1].message
    assert len(rig.host.commands) == 4
