"""Controllers follow motions that are planned for their thrusters, around obstacles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import coal
import numpy as np
import pytest
from control.flights import Reporting, refusals
from scipy.spatial.transform import Rotation
from support.sentences import assert_one_sentence
from support.thrust_flights import obstacles

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.state import ControlState, PoseReference
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario

STRAIGHT: dict[str, Any] = {
    "profile": "quintic",
    "motion.speed": 0.1,
    "motion.angular_speed": 0.2,
    "motion.acceleration": 0.02,
    "motion.angular_acceleration": 0.05,
}
BEHIND = Goal.from_rotvec([1.6, 1.3, 0.2], [0.3, -0.4, 1.2])
"""Behind the panel of 1.8 x 0.02 x 0.8 m round (1.5, 0.7, 0) m."""

TOUCHED = (
    "The goal is not reached without contact, as link 'base_link' and obstacle 'panel' touched at "
    "{:.4g} s: "
)
PLACE = np.array([0.3, -0.2, 0.1])


def docked(goal: Goal | None = None, **controller: Any) -> Flight:
    quick = {"plan.intervals": 15, **controller}
    scenario = load_scenario("free_flyer").with_overrides("coordinated_control", quick)
    return fly_scenario(scenario if goal is None else scenario.with_other_goal(goal))


def distance_from_panel(flight: Flight) -> float:
    """Return the smallest distance of the cube from the panel in a flight by coal, m."""
    cube, panel = coal.Box(0.3, 0.3, 0.3), coal.Box(1.8, 0.02, 0.8)
    place = coal.Transform3s(np.eye(3), np.array([1.5, 0.7, 0.0]))
    poses, asked = flight.pose[::5], (coal.DistanceRequest(), coal.DistanceResult())
    turns = Rotation.from_quat(poses[:, 3:]).as_matrix()
    bodies = [coal.Transform3s(R, r) for R, r in zip(turns, poses[:, :3], strict=True)]
    return min(float(coal.distance(cube, at, panel, place, *asked)) for at in bodies)


def test_a_planned_docking_takes_less_propellant_in_the_same_time() -> None:
    planned, straight = docked(), docked(**STRAIGHT)
    for flight in (planned, straight):
        assert flight.outcome is Outcome.REACHED, flight.message
    assert len(planned.pose) < 1.02 * len(straight.pose)
    assert planned.propellant is not None
    assert straight.propellant is not None
    assert planned.propellant < 0.7 * straight.propellant
    ((begins_ns, path),) = planned.paths
    assert begins_ns == 0
    np.testing.assert_allclose(path.position[0], planned.pose[0, :3], atol=1e-9)
    np.testing.assert_allclose(path.position[-1], planned.pose[-1, :3], atol=5e-3)
    assert planned.planned_propellant is not None
    # Feedback takes the rest.
    assert 0.7 * planned.propellant < planned.planned_propellant < planned.propellant
    assert (straight.paths, straight.planned_propellant) == ((), None)
    thrust = straight.commands["base_wrench"].values
    assert np.linalg.norm(thrust[:, :3], axis=1).max() < 0.4 * (1 + 1e-9)
    # The near side of the panel is the plane y = 0.69 m, along all of the way.
    corners = 0.15 * np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)])
    for flight in (planned, straight):
        turns = Rotation.from_quat(flight.pose[:, 3:])
        edges = np.max([flight.pose[:, 1] + turns.apply(each)[:, 1] for each in corners], axis=0)
        assert flight.clearance is not None
        assert flight.clearance.nearest.distance == pytest.approx(0.69 - edges.max(), abs=2e-3)


def test_a_robot_that_drifts_and_turns_is_planned_from_its_motion() -> None:
    """The bound on the distance from the plan is 2 % of the drift during the flight."""
    drift, plan = [1.6, -0.8, 0.8], {"plan.intervals": 15, "plan.duration": 0.0}
    moving = {"linear_momentum": drift, "angular_momentum": [0.02, -0.03, 0.04]}
    scenario = load_scenario("free_flyer").with_overrides("coordinated_control", plan)
    goal = Goal.from_rotvec([0.5, -0.6, 0.2], [0.0, 0.2, 0.6])
    flight = fly_scenario(scenario.with_overrides("plant", moving).with_other_goal(goal))
    assert flight.outcome is Outcome.REACHED, flight.message
    ((_, path),) = flight.paths
    place, _ = path.at(flight.time[: len(flight.pose)])
    bound = 0.02 * np.linalg.norm(drift) / 16.0 * flight.time[-1]
    assert np.linalg.norm(place - flight.pose[:, :3], axis=1).max() < bound
    assert flight.planned_propellant == pytest.approx(flight.propellant, rel=0.3)


@pytest.mark.slow
def test_a_goal_behind_a_panel_is_reached_round_it() -> None:
    planned, straight = docked(BEHIND), docked(BEHIND, **STRAIGHT)
    assert planned.outcome is Outcome.REACHED, planned.message
    assert np.linalg.norm(planned.pose[-1, :3] - BEHIND.position) < 5e-3
    apart = Rotation.from_quat(planned.pose[-1, 3:]).inv() * Rotation.from_quat(BEHIND.quaternion)
    assert apart.magnitude() < 1e-2
    # Feedback and pulses take a part of the clearance of the plan, 0.01 m.
    assert distance_from_panel(planned) > 5e-3
    assert distance_from_panel(straight) < 0, "so that the test is sharp"
    # It ends at the goal, and has touched something.
    assert straight.outcome is Outcome.FAILED
    contact = next(each for each in straight.events if each.kind is EventKind.CONTACT)
    told = TOUCHED.format(contact.time_s)
    assert straight.message.startswith(told)
    assert straight.verdict.sentence.startswith(told)
    assert "settling" not in straight.verdict.sentence


def test_a_robot_that_touches_a_panel_from_the_start_fails_on_its_way() -> None:
    at_panel = {"initial_position": [1.5, 0.6, 0.0]}
    scenario = load_scenario("free_flyer").with_overrides("coordinated_control", STRAIGHT)
    goal = Goal.checked([1.5, 0.2, 0.0], [0.0, 0.0, 0.0, 1.0])
    flight = fly_scenario(scenario.with_overrides("plant", at_panel).with_other_goal(goal))
    assert np.linalg.norm(flight.pose[-1, :3] - goal.position) < 5e-3
    assert flight.outcome is Outcome.FAILED
    told = TOUCHED.format(0.0)
    assert flight.message.startswith(told)
    assert flight.verdict.sentence.startswith(told)


def test_a_goal_without_a_plan_is_refused_and_the_robot_holds() -> None:
    inside = Goal.from_rotvec([1.5, 0.75, 0.1], [0.0, 0.0, 0.4])
    for goal, settings, words in (
        (inside, {}, "in collision"),
        (BEHIND, {"plan.duration": 3.0}, " s, but plan.duration is 3 s"),
        (BEHIND, {"time_limit": 20.0}, " s, but time_limit is 20 s"),
    ):
        flight = docked(goal, **settings)
        states = [each for _, each in flight.statuses if isinstance(each, ControllerStatus)]
        (refused,) = refusals(states)
        assert words in refused.message
        assert flight.outcome is Outcome.REFUSED
        assert np.linalg.norm(flight.pose[-1, :3]) < 1e-6


class Follower(Reporting):
    """A cube that follows its reference exactly, answered by an executive."""

    def __init__(self, **config: Any) -> None:
        scenario = load_scenario("free_flyer")
        plan = replace(scenario.controller.plan, intervals=15)
        self.config = replace(scenario.controller, **{"plan": plan, "tick_rate": 50.0, **config})
        robot = SpaceRobot.from_file(robot_file("jet_cube"))
        self.executive = ControlExecutive(build_controller(robot, self.config), self.config)
        self.time, self.places = 0.0, list[np.ndarray]()
        self.state = ControlState.at_rest(PLACE, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(0))
        self.answer()

    def reference(self) -> PoseReference:
        base = self.executive.controller.reference_at(self.time, self.state).base
        assert base is not None
        return base

    def answer(self) -> None:
        measured, none = self.state, np.zeros(0)
        if self.executive.controller.profile is not None:
            pose = self.reference()
            R_BW = Rotation.from_quat(pose.quaternion).inv()
            twist = R_BW.apply(pose.velocity), R_BW.apply(pose.angular_velocity)
            measured = ControlState(pose.position, pose.quaternion, *twist, none, none)
        self.places.append(measured.r_WB.copy())
        result = self.executive.command(self.time, measured, none, none)
        self.executive.evaluate(self.time, result)
        self.time += 0.02

    def pursue(self, goal: Goal, name: str = "") -> None:
        self.executive.submit("base", IdentifiedGoal(goal, name))
        self.answer()

    def await_plan(self, goal: Goal) -> None:
        self.pursue(goal, "first")
        while self.executive.state is not ControllerState.TRACKING:
            self.answer()

    def fly(self, until: float = np.inf) -> ControllerState:
        """Answer states until the goal is decided, or a time; return the controller's state."""
        while self.executive.state is ControllerState.TRACKING and self.time < until:
            self.answer()
        return self.executive.state


def test_states_are_answered_while_a_thread_plans() -> None:
    """``plan_in_background``: the robot holds its pose, and later goes on to its last goal."""
    rig = Follower(plan_in_background=True)
    executive, first = rig.executive, Goal.from_rotvec([0.9, 0.1, 0.3], [0.2, 0.1, 0.4])
    executive.submit("base", IdentifiedGoal(first, "first"))
    held, second = 0, Goal.from_rotvec([0.5, -0.9, 0.4], [-0.3, 0.2, 0.1])
    while executive.state is not ControllerState.TRACKING:
        held += 1
        if held == 3:
            # Another goal while a plan for the first one is made.
            executive.submit("base", IdentifiedGoal(second, "second"))
        np.testing.assert_allclose(rig.reference().position, PLACE, atol=1e-12)
        rig.answer()
    planned = {each.goal_id for each in rig.statuses if "Planning a motion" in each.message}
    assert planned <= {"first", "second"}
    assert planned, "whoever has sent a goal learns that it is being planned"
    assert held > 5, "the test is sharp: planning takes longer than a state"
    ends = executive.controller.reference_ends
    assert ends is not None
    assert rig.fly() is ControllerState.REACHED
    assert rig.time < ends + 5.0
    np.testing.assert_allclose(rig.reference().position, second.position, atol=1e-9)


@pytest.mark.parametrize("in_background", [False, True])
def test_tasks_before_a_goal_are_done_once(in_background: bool) -> None:
    rig = Follower(
        plan_in_background=in_background, tasks="detumble", settle_time=0.04, status_period=0.02
    )
    executive, goal = rig.executive, Goal.from_rotvec([0.9, 0.1, 0.3], [0.2, 0.1, 0.4])
    rig.pursue(goal, "first")
    assert rig.fly(until=rig.time + 4000.0) is ControllerState.REACHED
    np.testing.assert_allclose(rig.reference().position, goal.position, atol=1e-9)
    kinds = [each.kind for each in rig.events]
    assert kinds.count(EventKind.DETUMBLE_STARTED) == kinds.count(EventKind.DETUMBLED) == 1
    # The motion to the same goal is planned again without the tasks, to another goal with them.
    rig.pursue(Goal.from_rotvec([0.5, -0.9, 0.4], [-0.3, 0.2, 0.1]), "second")
    rig.fly(until=rig.time + 6.0)
    assert executive.controller.profile is not None, "it is on its way"
    executive.plant_rested(round(1e9 * rig.time), round(1e9 * rig.time))
    assert rig.fly(until=rig.time + 4000.0) is ControllerState.REACHED
    kinds = [each.kind for each in rig.events]
    assert kinds.count(EventKind.DETUMBLE_STARTED) == kinds.count(EventKind.DETUMBLED) == 2


def test_a_goal_is_not_reached_while_its_motion_is_planned_again_after_a_reset() -> None:
    rig = Follower(plan_in_background=True, settle_time=0.04, status_period=0.02)
    goal = Goal.from_rotvec([1.3, 0.2, 0.1], [0.2, 0.1, 0.4])
    rig.await_plan(goal)
    rig.fly(until=rig.time + 4.0)
    left = float(np.linalg.norm(rig.reference().position - goal.position))
    rig.executive.plant_reset()
    assert rig.fly() is ControllerState.REACHED
    np.testing.assert_allclose(rig.reference().position, goal.position, atol=1e-9)
    for said in (each.goal for each in rig.statuses if each.goal):
        np.testing.assert_allclose(said, [*goal.position, *goal.quaternion], atol=1e-9)
    assert left > 0.1, "the test is sharp: the robot was on its way"


def test_motions_are_planned_anew_around_obstacles_that_come_in_flight() -> None:
    goal = Goal.from_rotvec([1.3, 0.2, 0.1], [0.0, 0.0, 0.0])
    middle = (PLACE + goal.position) / 2
    for place, state in (
        (middle, ControllerState.REACHED),
        (goal.position, ControllerState.ABORTED),
    ):
        rig = Follower()
        rig.pursue(goal)
        began = rig.time
        rig.fly(until=began + 6.0)
        # Something beside the way changes nothing.
        profile = rig.executive.controller.profile
        rig.executive.use_obstacles(ball(np.array([0.0, 3.0, 0.0])))
        rig.answer()
        assert rig.executive.controller.profile is profile
        rig.executive.use_obstacles(ball(place))
        assert rig.fly() is state
        # The cube of 0.3 m contains a ball of 0.15 m.
        nearest = np.linalg.norm(np.array(rig.places) - place, axis=1).min()
        assert nearest > 0.15 + 0.1 + 0.01
        assert nearest < 1.0
        if state is ControllerState.ABORTED:
            told = rig.statuses[-1].message
            assert told.startswith("Aborted: ")
            assert "'ball'" in told


def test_a_status_in_flight_says_for_what_another_motion_is_planned() -> None:
    rig = Follower(plan_in_background=True, status_period=0.02)
    goal, other = (Goal.from_rotvec(x, [0.0] * 3) for x in ([1.3, 0.2, 0.1], [0.5, -0.9, 0.4]))
    rig.await_plan(goal)
    between = ball((PLACE + goal.position) / 2)
    for event, words in (
        ("", "the reference."),
        ("obstacle", "planning another motion to it."),
        ("goal", "planning a motion to a later goal."),
    ):
        if event == "obstacle":
            rig.executive.use_obstacles(between)
        elif event == "goal":
            rig.executive.submit("base", IdentifiedGoal(other, "other"))
        for _ in range(3):
            rig.answer()
        status = rig.executive.outputs[-1]
        assert isinstance(status, ControllerStatus)
        assert status.message.endswith(words)
        assert (status.ends_at_s > 0.0) == (not event)
    rig.executive.reset()


def ball(place: np.ndarray) -> RobotDescription:
    return obstacles(ball=('<sphere radius="0.1"/>', place, np.zeros(3)))


def test_a_motion_is_blocked_when_it_first_comes_too_near() -> None:
    """To a ball in the middle of its way, through which it flies half a metre deep."""
    rig = Follower(plan=load_scenario("free_flyer").controller.plan)
    aim = PLACE + np.array([1.6, 0.3, -0.2])
    rig.pursue(Goal.from_rotvec(aim, [0.2, 0.1, 0.4]))
    controller, began = rig.executive.controller, rig.time
    profile, planner = controller.profile, controller.planner
    assert profile is not None
    assert planner is not None
    half = profile.at(profile.duration / 2).base
    assert half is not None
    planner.use_obstacles(ball(half.position))
    times = np.linspace(0.0, profile.duration, 2000)
    bases = [profile.at(time).base for time in times.tolist()]
    away = [np.linalg.norm(each.position - half.position) for each in bases if each is not None]
    # The cube of 0.3 m is between the balls in it and around it; the clearance is 0.01 m.
    earliest, latest = (times[np.argmax(np.array(away) < r + 0.11)] for r in (0.26, 0.15))
    assert latest - earliest < 0.1 * profile.duration
    assert earliest - 0.1 < controller.time_until_blocked(began) < latest + 0.1


def test_a_collision_of_a_cube_without_joints_is_at_no_shape() -> None:
    cube = replace(load_robot(robot_file("jet_cube")), world=ball(PLACE))
    clearance = Clearance(cube, 0.01, "plan.clearance")
    inside = BasePoses(PLACE[None], np.array([[0.0, 0.0, 0.0, 1.0]]))
    (found,) = clearance.approaches(np.zeros((1, 0)), np.full(1, 0.01), inside)
    assert "shape" not in clearance.clause(found, None)


WAYPOINTS = np.array(
    [
        [0.7, 0.2, 0.5, *Rotation.from_rotvec([0.0, 0.0, 1.2]).as_quat()],
        [0.9, -0.7, 0.0, *Rotation.from_rotvec([0.3, -0.2, -0.9]).as_quat()],
    ]
)


def through_waypoints() -> Goal:
    return Goal.through([*WAYPOINTS, [0.2, -0.8, -0.2, *Rotation.from_rotvec([0, 0, 2]).as_quat()]])


def stops(poses: np.ndarray, tick: float, within: float) -> list[int]:
    """Return the waypoints at which the cube of a flight rests, in their order."""
    speeds = np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) / tick
    found = []
    for number, waypoint in enumerate(WAYPOINTS):
        away = np.linalg.norm(poses[:, :3] - waypoint[:3], axis=1)
        turns = Rotation.from_quat(poses[:, 3:]).inv() * Rotation.from_quat(waypoint[3:])
        apart = turns.magnitude()
        nearest = int(np.argmin(away + apart))
        if away[nearest] < within and apart[nearest] < 2 * within:
            assert speeds[max(nearest - 15, 0) : nearest + 15].min() < 5e-3
            found.append((nearest, number))
    return [number for _, number in sorted(found)]


@pytest.mark.slow
def test_the_cube_rests_at_every_waypoint_of_a_path() -> None:
    """With thrusts beyond ``max_force``, which bounds what corrects the plan for the thrusters."""
    flight = docked(through_waypoints(), **{"plan.duration": 0.0, "plan.time_factor": 1.1})
    assert flight.outcome is Outcome.REACHED, flight.message
    assert stops(flight.pose, 0.02, 5e-3) == [0, 1]
    ((_, path),) = flight.paths
    place, _ = path.at(flight.time[: len(flight.pose)])
    assert np.linalg.norm(place - flight.pose[:, :3], axis=1).max() < 5e-3
    force = np.linalg.norm(flight.commands["base_wrench"].values[:, :3], axis=1)
    assert force.max() > 0.5, "so that the test is sharp: max_force is 0.4"


def test_a_robot_with_wheels_follows_a_plan_by_its_thrusters() -> None:
    """The plan's thrust is beyond ``max_force``, and no wheel gives a part of it."""
    shape = [*[0.0] * 4, 0.0, -1.2, 2.0, 0.0, 0.8, 0.0]
    plant = {"robot": "servicer_wheels", "initial_joint_positions": shape}
    limits = {"max_force": 8.0, "max_torque": 4.0, "plan.time_factor": 1.2, "plan.intervals": 10}
    scenario = load_scenario("servicer_thrusters").with_overrides("plant", plant)
    controller = {"robot": "servicer_wheels", **limits}
    flight = fly_scenario(scenario.with_overrides("coordinated_control", controller))
    assert flight.outcome is Outcome.REACHED, flight.message
    ((_, path),) = flight.paths
    place, _ = path.at(flight.time[: len(flight.pose)])
    assert np.linalg.norm(place - flight.pose[:, :3], axis=1).max() < 5e-3
    force = np.linalg.norm(flight.commands["base_wrench"].values[:, :3], axis=1)
    assert force.max() > 16.0, "so that the test is sharp"


def test_a_robot_that_is_brought_to_rest_keeps_to_its_limits_during_a_plan() -> None:
    rig = Follower(plan=replace(load_scenario("free_flyer").controller.plan, duration=0.0))
    rig.pursue(through_waypoints())
    rig.fly(until=1.0)
    rig.answer()
    controller = rig.executive.controller
    moving = replace(rig.state, v_WB_B=np.array([0.3, -0.4, 0.1]))
    controller.come_to_rest()
    wrench = controller.command(rig.time, moving, np.zeros(0), np.zeros(0)).realised.wrench_B
    assert np.linalg.norm(wrench[:3]) == pytest.approx(rig.config.max_force)
    assert wrench[:3] @ [0.3, -0.4, 0.1] < 0


def test_waypoints_that_were_passed_are_not_passed_again() -> None:
    rig = Follower(plan=replace(load_scenario("free_flyer").controller.plan, duration=0.0))
    goal = through_waypoints()
    rig.pursue(goal, "path")
    profile = rig.executive.controller.profile
    while np.linalg.norm(rig.places[-1] - WAYPOINTS[0, :3]) > 1e-3:
        rig.answer()
    left = (WAYPOINTS[1, :3] + goal.position) / 2
    rig.executive.use_obstacles(ball(left))
    for _ in range(100):
        rig.answer()
    assert rig.executive.controller.profile is not profile
    on = len(rig.places)
    assert rig.fly() is ControllerState.REACHED
    later = np.array(rig.places[on:])
    assert np.linalg.norm(later - WAYPOINTS[0, :3], axis=1).min() > 0.05
    away = np.linalg.norm(later - WAYPOINTS[1, :3], axis=1)
    assert away.min() < 1e-3
    speeds = np.linalg.norm(np.diff(later, axis=0), axis=1) / 0.02
    assert speeds[max(away.argmin() - 15, 0) : away.argmin() + 15].min() < 5e-3, "it rests there"
    assert np.linalg.norm(np.array(rig.places) - left, axis=1).min() > 0.15 + 0.1


def test_a_straight_profile_refuses_waypoints() -> None:
    flight = docked(through_waypoints(), **STRAIGHT)
    assert flight.outcome is Outcome.REFUSED
    assert_one_sentence(flight.message, "2 waypoints", "set profile to planned")


def test_a_start_within_an_obstacle_is_refused() -> None:
    rig = Follower()
    rig.executive.use_obstacles(ball(PLACE + np.array([0.2, 0.0, 0.0])))
    rig.pursue(Goal.from_rotvec([0.9, 0.1, 0.3], [0.2, 0, 0]))
    assert_one_sentence(refusals(rig.statuses)[-1].message, "obstacle 'ball' touch at the start")
