"""The summary of a flight, from a bag written by hand: every number is computed in the test."""

from __future__ import annotations

import html
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from support.made_bags import array, joint_states, made_bag, odometry, pose

from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.flight.reading import open_flight_bag, read_flown, read_run
from spacerobot_ros.measures import Outcome, flown_time
from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.report import write_report
from spacerobot_ros.resources import share_directory
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario

HALF = math.sin(0.05), math.cos(0.05)
"""Of a quaternion that turns by 0.1 rad."""

STILL = (0.0,) * 6
NAMES = ["slider_1", "slider_2"]
RATES = [[0.0, 0.0], [0.5, -0.25], [-0.75, 0.125], [0.25, 0.0]]
GOAL = Goal.checked([1.0, 2.0, 3.0], [0.0, 0.0, 0.0, 1.0])


def summary(path: Path, **options: Any) -> dict[str, Any]:
    """Write four ticks of 0.25 s from 2 s on, and sum them up.

    The base ends 0.1 rad and (0.3, 0, -0.4) m from the goal; momenta swing and come back.
    """
    scenario = options.pop("scenario", load_scenario("sliding_masses").with_goal(_pose(GOAL)))
    more = options.pop("more", lambda say, time, k: None)
    true, diagnosed = options.pop("true", False), options.pop("diagnosed", True)
    with made_bag(path) as (bag, say):
        bag.add_attachment("robot_description.urdf", options.pop("urdf", b""), "application/xml", 0)
        for k, rates in enumerate(RATES):
            time = 2.0 + 0.25 * k
            where = odometry(time, 0.7, 2.0, 3.4 * (k == 3), 0.0, HALF[0], 0.0, HALF[1], *STILL)
            joints = joint_states(time, NAMES, [0.1 * k, 0.2 * k], rates)
            for topic, message in (("odom", where), ("joint_states", joints)):
                if true:
                    say(f"/{topic}_true", message, time)
            if true:
                where = odometry(time, 99.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0, *STILL)
                joints = joint_states(time, NAMES, [9.0, 9.0], [9.0, 9.0])
            say("/odom", where, time)
            say("/joint_states", joints, time)
            swing = (0.0, 3.0, -4.0, 0.0)[k]
            say("/momentum", array(5.0 + 3 * swing, 4 * swing, 0, 0, -swing, 7.0, 1.0), time)
            more(say, time, k)
        if diagnosed:
            say("/diagnostics", DiagnosticArray(), 9.0)
    # What a client knows at the end.
    known = {"outcome": Outcome.REACHED, "message": "The goal is reached.", **options}
    recorded = open_flight_bag(path)
    flight = replace(read_flown(recorded, scenario), plan_time=0.75, wall_time=0.5, **known)
    return {**flight.summary(), "messages_recorded": recorded.message_count}


def _pose(goal: Goal) -> list[float]:
    return [*goal.position.tolist(), *goal.quaternion.tolist()]


@pytest.mark.parametrize("true", [False, True])
def test_the_numbers_of_a_flight(tmp_path: Path, true: bool) -> None:
    """Beside noisy sensors the truth counts; a bag need not have diagnostics."""
    found = summary(tmp_path / "a.mcap", true=true, diagnosed=true)
    assert found["scenario"] == "sliding_masses"
    assert found["goal"] == _pose(GOAL)
    assert found["final_position_m"] == [0.7, 2.0, 3.4]
    assert found["position_error_m"] == pytest.approx(0.5)
    assert found["final_attitude_rotvec_rad"] == pytest.approx([0.0, 0.1, 0.0])
    assert found["attitude_error_rad"] == pytest.approx(0.1)
    assert found["joint_names"] == NAMES
    assert found["final_joint_positions"] == pytest.approx([0.3, 0.6])
    assert found["peak_joint_velocities"] == [0.75, 0.25]
    assert found["sim_time_s"] == 0.75
    assert (found["ticks"], found["ticks_per_s"]) == (3, 6.0)
    assert found["real_time_factor"] == 1.5
    assert found["wall_time_s"] == 0.5
    # |(3, 4)| times the largest swing of 4; the angular momentum swings by that alone.
    assert found["linear_momentum_drift"] == pytest.approx(20.0)
    assert found["angular_momentum_drift"] == pytest.approx(4.0)
    assert found["momentum_drift"] == pytest.approx(20.0)
    assert found["messages_recorded"] == (4 * 5 + 1 if true else 4 * 3)
    assert found["plan_time_s"] == 0.75
    # The true pose is beyond the tolerance.
    assert (found["succeeded"], found["state"]) == (not true, "reached")
    assert found["succeeded_by_measurement"]
    assert "propellant_kg" not in found
    assert "end_effector_position_error_m" not in found


def test_momenta_that_thrusters_have_put_in_are_no_drift(tmp_path: Path) -> None:
    def more(say: Any, time: float, k: int) -> None:
        swing = (0.0, 3.0, -4.0, 0.0)[k]
        leak = 0.5 * (k == 2)
        expected = array(5.0 + 3 * swing, 4 * swing - leak, 0, 0, -swing, 7.0 - leak / 2)
        say("/momentum_expected", expected, time)

    found = summary(tmp_path / "a.mcap", more=more)
    assert found["linear_momentum_drift"] == pytest.approx(0.5)
    assert found["angular_momentum_drift"] == pytest.approx(0.25)
    assert found["momentum_drift"] == pytest.approx(0.5)


@pytest.mark.parametrize("turned", [False, True])
def test_the_end_effector_and_the_propellant(tmp_path: Path, turned: bool) -> None:
    urdf = (share_directory() / "urdf" / "servicer.urdf").read_bytes()
    table = find_thrusters("urdf", parse_robot(urdf.decode()))

    def more(say: Any, time: float, k: int) -> None:
        say("/end_effector_pose", pose(time, 0.0, 3.0 + k, 4.0, *(0.0, 0.0), *HALF), time)
        # The last diagnostics come before the end.
        status = DiagnosticStatus(values=[KeyValue(key="propellant_kg", value=f"{0.25 * k}")])
        say("/diagnostics", DiagnosticArray(status=[status] if k < 2 else []), time)
        force = [2.0 * k * (i == 3) + 1.0 * k * (i == 5) for i in range(len(table.names))]
        thrusters = joint_states(time, list(table.names), [0.0] * len(force), [0.0] * len(force))
        thrusters.effort = force
        say("/thrusters", thrusters, time)

    label = "end_effector.rx" if turned else "end_effector.x"
    command = CommandReport("a_law", False, 1.0, 0.0, 0.0, 0.0, 0.0, {label: 0.1, "base.rx": 1.0})
    status = ControllerStatus(ControllerState.REACHED, "Reached.", command=command)
    scenario = load_scenario("servicer_thrusters").with_goal(_pose(GOAL))
    goal = Goal.checked([0.0, 6.0, 3.0], [0.0, 0.0, 0.0, 1.0])
    scenario = replace(scenario, end_effector_goal=goal)
    found = summary(tmp_path / "a.mcap", scenario=scenario, more=more, status=status, urdf=urdf)
    assert found["end_effector_final_position_m"] == [0.0, 6.0, 4.0]
    assert found["end_effector_position_error_m"] == pytest.approx(1.0)
    assert ("end_effector_attitude_error_rad" in found) == turned
    if turned:
        assert found["end_effector_attitude_error_rad"] == pytest.approx(0.1)
    # Forces of 1, 2 and 3 times 2 N and 1 N, for 0.25 s each, over g0 times specific impulse.
    impulse = 0.25 * (1 + 2 + 3) * np.array([2.0, 1.0])
    used = float((impulse / (9.80665 * table.isp[[3, 5]])).sum())
    assert found["propellant_kg"] == pytest.approx(used, rel=1e-12)
    assert found["method"] == scenario.controller.law
    # Without schedules the manoeuvre is the flight.
    assert found["manoeuvre_time_s"] == 0.75


def test_what_the_planner_reports(tmp_path: Path) -> None:
    gait = PlannerStatus(
        PlannerState.EXECUTING, "Flying.", method="square_path", duration_s=3.5, notes={"c": 1.0}
    )
    last = PlannerStatus(
        PlannerState.FAILED, "Missed.", corrections=4, manoeuvre_time_s=12.5, duration_s=1.0
    )
    known = {"outcome": Outcome.FAILED, "status": last, "gait": gait, "message": "Missed."}
    found = summary(tmp_path / "a.mcap", **known)
    assert found["method"] == "square_path"
    assert found["gait"] == {"duration_s": 3.5, "c": 1.0}
    assert found["manoeuvre_time_s"] == 12.5
    assert found["corrections"] == 4
    assert (found["succeeded"], found["state"]) == (False, "failed")
    assert found["message"] == "Missed."


def test_a_schedule_that_begins_with_the_last_status_has_not_been_flown() -> None:
    """Its status comes after the last state: none of its 4 s counts."""
    statuses = [
        (0.0, PlannerStatus(PlannerState.EXECUTING, ".", manoeuvre_time_s=10.0, duration_s=10.0)),
        (12.0, PlannerStatus(PlannerState.EXECUTING, ".", manoeuvre_time_s=14.0, duration_s=4.0)),
    ]
    assert flown_time(statuses, 11.9) == pytest.approx(10.0)
    assert flown_time(statuses, 13.0) == pytest.approx(11.0)


@pytest.mark.slow
@pytest.mark.usefixtures("own_domain")
def test_status_events_and_summary_of_a_goal_that_is_reached_partly_agree(tmp_path: Path) -> None:
    """The message of the goal tells what is asked for, NaN what is not."""
    quick: dict[str, Any] = {"square_path.t1": 0.5, "square_path.t2": 0.75, "square_path.t3": 1.25}
    quick |= {"square_path.t4": 1.5, "method": "square_path"}
    scenario = load_scenario("planar_chain").with_overrides("planner", quick)
    cases: tuple[tuple[dict[str, Any], str, list[bool]], ...] = (
        ({"rotvec": [0.0, 0.0, 0.2]}, "reached", [True] * 3),
        ({"pose": [1.0, 0.0, 0.0], "rotvec": [0.0, 0.0, 0.2]}, "reached_partly", [False] * 3),
    )
    for number, (goal, state, unasked) in enumerate(cases):
        path = tmp_path / f"{number}.mcap"
        result = run_scenario(scenario.with_goal(**goal), path, nodes=True)
        assert (result.summary["state"], result.succeeded) == (state, state == "reached")
        assert result.summary["succeeded_by_measurement"] is (state == "reached")
        flight = read_run(path)
        assert (flight.outcome.value, flight.succeeded) == (state, result.succeeded)
        kinds = {event.kind.value for event in flight.events}
        assert f"goal_{state}" in kinds
        assert len(kinds & {"goal_reached", "goal_reached_partly"}) == 1
        ((_, message),) = open_flight_bag(path).messages("goal_pose")
        at = message.pose.position
        assert [math.isnan(each) for each in (at.x, at.y, at.z)] == unasked


def test_an_attitude_of_a_hand_that_was_asked_for_and_is_not_controlled_is_not_reached(
    tmp_path: Path,
) -> None:
    """Two joints place the hand, and its attitude follows from them."""
    scenario, place = load_scenario("coordinated_control"), [1.5, 1.5, 0.0]
    yaw, bag = 0.0, tmp_path / "run.mcap"
    for turn, state in ((None, "reached"), (0.0, "reached"), (0.7, "reached_partly")):
        half = (yaw + (turn or 0.0)) / 2
        turned = np.array([0.0, 0.0, math.sin(half), math.cos(half)])
        quaternion = None if turn is None else turned
        aim = EndEffectorGoal("end_effector", np.array(place), quaternion)
        result = run_scenario(scenario.with_end_effectors([aim]), bag)
        assert (result.summary["state"], result.succeeded) == (state, state == "reached")
        missed = "its end-effector's attitude, which is 0.7 rad off" in result.message
        assert missed is (state == "reached_partly")
        flight = read_run(bag)
        assert flight.outcome.value == state
        *_, z, w = flight.signal("end_effector_pose").values[-1]
        yaw, bag = 2 * math.atan2(z, w), tmp_path / f"{turn}.mcap"


def test_a_part_that_was_asked_for_and_is_not_controlled_is_not_reached(tmp_path: Path) -> None:
    """As numbers, that is: an attitude alone asks for no place of the base."""
    scenario = load_scenario("planar_chain").with_overrides("planner", {"method": "square_path"})
    turn = scenario.with_goal(rotvec=[0.0, 0.0, 0.1])
    assert run_scenario(turn, tmp_path / "turn.mcap").succeeded
    place = [1.0, 0.0, 0.0, 0.0, 0.0, math.sin(0.05), math.cos(0.05)]
    result = run_scenario(scenario.with_goal(place), tmp_path / "place.mcap")
    assert (result.summary["state"], result.succeeded) == ("reached_partly", False)
    assert "but for its position, which is 1.25 m off" in result.message  # It drifts by 0.25 m.
    assert result.summary["verdict"] == result.message


def test_an_axis_of_the_base_that_is_not_controlled_counts_for_its_goal(tmp_path: Path) -> None:
    """The robot flies in a plane, and this goal is beside it."""
    scenario = load_scenario("coordinated_control")
    off = 3 * scenario.controller.position_tolerance
    goal = scenario.with_goal(pose=[0.5, 0.5, off], rotvec=[0.0, 0.0, 0.262])
    result = run_scenario(goal, tmp_path / "run.mcap")
    assert (result.summary["state"], result.succeeded) == ("reached_partly", False)
    assert f"but for its position, which is {off:.3g} m off" in result.message
    assert f"but for its position, which is {off:.3g}" in result.summary["verdict"]
    assert read_run(tmp_path / "run.mcap").verdict.sentence == result.summary["verdict"]


@pytest.mark.parametrize(
    ("fault", "state", "named"),
    [
        ("thruster_off all at 1", "failed", "Thruster 'all' has been off since 1 s."),
        pytest.param(
            *("thruster_stuck force_x 400 at 1.5", "aborted", "has been stuck since 1.5 s."),
            marks=pytest.mark.slow,
        ),
        ("thruster_off all at 1 until 2", "failed", ""),
    ],
)
def test_a_fault_that_was_active_when_the_goal_failed_is_named(
    tmp_path: Path, fault: str, state: str, named: str
) -> None:
    """In the summary and in the report; a fault that has ended is not."""
    settings = ("coordinated_control.time_limit=4", f"plant.faults={fault}")
    scenario = load_scenario("coordinated_control").with_settings(settings)
    bag, page = tmp_path / "flight.mcap", tmp_path / "flight.html"
    found = run_scenario(scenario, bag).summary
    write_report(bag, page)
    assert found["state"] == state
    assert found["verdict"].endswith(named)
    assert ("has been" in found["verdict"]) == bool(named)
    (outcome,) = re.findall(r'<p class="outcome[^>]*>.*?</p>', page.read_text("utf-8"), re.DOTALL)
    said = html.unescape(outcome).replace("\N{NO-BREAK SPACE}", " ")
    assert named in said
    assert ("has been" in said) == bool(named)
