"""Controllers follow motions that are planned for their thrusters, around obstacles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import coal
import numpy as np
from scipy.spatial.transform import Rotation

from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.state import ControlState
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal
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


def docked(goal: Goal | None = None, **controller: Any) -> Flight:
    scenario = load_scenario("free_flyer").with_overrides("coordinated_control", controller)
    return fly_scenario(scenario if goal is None else scenario.with_other_goal(goal))


def distance_from_panel(flight: Flight) -> float:
    """Return the smallest distance of the cube from the panel in a flight by coal, m."""
    cube, panel = coal.Box(0.3, 0.3, 0.3), coal.Box(1.8, 0.02, 0.8)
    place = coal.Transform3s(np.eye(3), np.array([1.5, 0.7, 0.0]))
    distances = []
    for pose in flight.pose[::5]:
        at = coal.Transform3s(Rotation.from_quat(pose[3:]).as_matrix(), pose[:3])
        request, result = coal.DistanceRequest(), coal.DistanceResult()
        distances.append(coal.distance(cube, at, panel, place, request, result))
    return float(min(distances))


def test_a_planned_docking_takes_less_propellant_in_the_same_time() -> None:
    planned, straight = docked(), docked(**STRAIGHT)
    for flight in (planned, straight):
        assert flight.outcome is Outcome.REACHED, flight.message
    assert len(planned.pose) < 1.02 * len(straight.pose)
    assert planned.propellant is not None
    assert straight.propellant is not None
    assert planned.propellant < 0.7 * straight.propellant


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
    told = (
        "The goal is not reached without contact, as link 'base_link' and obstacle 'panel' touched "
        f"at {contact.time_s:.4g} s: "
    )
    assert straight.message.startswith(told)
    assert straight.verdict.sentence.startswith(told)
    assert "settling" not in straight.verdict.sentence


def test_a_goal_without_a_plan_is_refused_and_the_robot_holds() -> None:
    inside = Goal.from_rotvec([1.5, 0.75, 0.1], [0.0, 0.0, 0.4])
    for goal, settings, words in (
        (inside, {}, "in collision"),
        (BEHIND, {"plan.duration": 3.0}, "s at least, and plan.duration is 3 s"),
    ):
        flight = docked(goal, **settings)
        states = [each for _, each in flight.statuses if isinstance(each, ControllerStatus)]
        refusals = [each for each in states if each.state is ControllerState.REFUSED]
        assert len(refusals) == 1
        assert words in refusals[0].message
        assert flight.outcome is Outcome.REFUSED
        assert np.linalg.norm(flight.pose[-1, :3]) < 1e-6


def test_states_are_answered_while_a_thread_plans() -> None:
    """``plan_in_background``: the robot holds its pose, and later goes on to its last goal."""
    scenario = load_scenario("free_flyer")
    config = replace(scenario.controller, plan_in_background=True, tick_rate=50.0)
    robot = SpaceRobot.from_file(robot_file("jet_cube"))
    executive = ControlExecutive(build_controller(robot, config), config)
    place, upright = np.array([0.3, -0.2, 0.1]), np.array([0.0, 0.0, 0.0, 1.0])
    none, time = np.zeros(0), 0.0

    def answer() -> None:
        """Answer the state of a robot that follows its reference exactly."""
        nonlocal time
        profile = executive.controller.profile
        pose = None if profile is None else executive.controller.reference_at(time, state).base
        if pose is None:
            measured = state
        else:
            R_BW = Rotation.from_quat(pose.quaternion).inv()
            twist = R_BW.apply(pose.velocity), R_BW.apply(pose.angular_velocity)
            measured = ControlState(pose.position, pose.quaternion, *twist, none, none)
        executive.evaluate(time, executive.command(time, measured, none, none))
        time += 0.02

    state = ControlState.at_rest(place, upright, none)
    answer()
    executive.submit("base", IdentifiedGoal(Goal.from_rotvec([0.9, 0.1, 0.3], [0.2, 0.1, 0.4])))
    held, second = 0, Goal.from_rotvec([0.5, -0.9, 0.4], [-0.3, 0.2, 0.1])
    while executive.state is not ControllerState.TRACKING:
        held += 1
        if held == 3:
            # Another goal while a plan for the first one is made.
            executive.submit("base", IdentifiedGoal(second))
        still = executive.controller.reference_at(time, state).base
        assert still is not None
        np.testing.assert_allclose(still.position, place, atol=1e-12)
        answer()
    assert held > 5, "the test is sharp: planning takes longer than a state"
    ends = executive.controller.reference_ends
    assert ends is not None
    while executive.state is ControllerState.TRACKING:
        answer()
    assert executive.state is ControllerState.REACHED
    assert time < ends + 5.0
    ended = executive.controller.reference_at(time, state).base
    assert ended is not None
    np.testing.assert_allclose(ended.position, second.position, atol=1e-9)
