"""What becomes of a controller's goals: its executive, without measurements too, and restarted."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control.flights import refusals
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from support.executive_loop import (
    AIM,
    KP,
    PERIOD,
    SHAPE,
    SHAPE_IS_CONTROLLED,
    TIP,
    UPRIGHT,
    ExecutiveLoop,
    goal_at,
    planar_manipulator,
)
from support.sentences import assert_one_sentence

from spacerobot_ros.control import ControlState, JointReference, PoseReference, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.errors import PlanningError, SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState

# -- goals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "position", "rotvec", "named"),
    [
        (
            "base",
            [0.1, 0.05, 0.051],
            [0.0, 0.0, 0.1],
            "position of the base is 0.051 m .* along z ",
        ),
        ("base", AIM, [0.3, 0.4, 0.0], "attitude of the base is 0.5 rad .* along rx and ry "),
        ("end_effector", TIP - [0, 0, 3], [0.3, 0, 0], "position of the end-effector is 3 m .* z "),
    ],
)
def test_a_goal_out_of_the_plane_is_refused_and_the_earlier_one_goes_on(
    key: str, position: Any, rotvec: Any, named: str
) -> None:
    """Tolerances are 0.01 m and 0.02 rad; the law leaves the end-effector's attitude free."""
    loop = ExecutiveLoop(position_tolerance=0.01, attitude_tolerance=0.02)
    loop.answer()
    loop.aim(base=goal_at(AIM, "first"))
    commanded = loop.answer()
    goal = Goal(np.array(position), Rotation.from_rotvec(rotvec).as_quat())
    loop.aim(**{key: IdentifiedGoal(goal, "second")})
    np.testing.assert_array_equal(np.concatenate(loop.answer()), np.concatenate(commanded))
    (refused,) = refusals(loop.statuses)
    assert refused.goal_id == "second"
    assert_one_sentence(refused.message, "transposed_jacobian", "base.rz")
    assert re.search(named, refused.message)
    assert (loop.state, loop.status.goal_id) == ("tracking", "first")
    # Noise takes a measured pose as far out of the plane as this.
    goal = Goal(np.array([0.5, 0.25, 0.045]), Rotation.from_rotvec([0.05, 0.075, 0.0]).as_quat())
    loop.aim(base=IdentifiedGoal(goal, "third"))
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("tracking", "third")


@pytest.mark.parametrize(
    ("way", "force", "refused"), [(1e11, 1e12, True), (1e6, 1e12, False), (1.0, 1e-30, True)]
)
def test_a_goal_to_which_no_flight_lasts_long_enough_is_refused(
    way: float, force: float, refused: bool
) -> None:
    """At 0.1 m/s, 1e11 m take more than 30,000 years; so does 1 m by 1e-30 N."""
    loop = ExecutiveLoop(profile="quintic", max_force=force, max_torque=1e12)
    loop.answer()
    loop.aim(base=goal_at(np.array([way, 0.0, 0.0]), "far"))
    loop.answer()
    assert loop.state == ("holding" if refused else "tracking")
    if refused:
        (status,) = refusals(loop.statuses)
        assert status.goal_id == "far"
        assert_one_sentence(status.message, " s, and the longest is 1e+09 s", "motion.speed")


@pytest.mark.parametrize("between", [True, False], ids=["after a state", "at once"])
def test_the_other_goal_stays_when_one_is_replaced_and_the_status_is_about_the_latest(
    between: bool,
) -> None:
    loop = ExecutiveLoop()
    loop.answer()
    up = np.array([0.0, 1.0, 0.0])
    loop.aim(base=goal_at(AIM, "a"), end_effector=goal_at(TIP + up, "b"))
    if between:
        loop.answer()
        assert (loop.status.goal_id, loop.status.goal) == ("b", ()), "that of the base is a"
    loop.aim(base=goal_at(-AIM, "c"))
    np.testing.assert_allclose(loop.answer()[0][:3], KP * (up - AIM), atol=1e-12)
    assert (loop.status.goal_id, loop.status.goal) == ("c", (*-AIM, *UPRIGHT))


def test_a_base_without_a_goal_of_the_hand_carries_it() -> None:
    """The force is that of both errors; the reference of the hand turns about the base."""
    loop = ExecutiveLoop(profile="quintic")
    loop.answer()
    half = math.sqrt(0.5)
    there = Goal(AIM, np.array([0.0, 0.0, half, half]))
    loop.aim(base=IdentifiedGoal(there, "a"))
    loop.answer()
    profile = loop.executive.controller.profile
    assert profile is not None
    for share in (0.0, 0.3, 0.7, 1.0):
        now = profile.at(share * profile.duration)
        assert now.base is not None
        assert now.end_effector is not None
        turned = Rotation.from_quat(now.base.quaternion)
        arm = now.end_effector.position - now.base.position
        np.testing.assert_allclose(arm, turned.apply(TIP), atol=1e-12)
    # The next goal of the base goes on from there, a goal of the hand ends it.
    loop.aim(base=goal_at(-AIM, "b"))
    loop.answer()
    hand = loop.executive.controller.goal.end_effector
    assert hand is not None
    np.testing.assert_allclose(hand.position, TIP - AIM, atol=1e-12)
    loop.aim(end_effector=goal_at(TIP, "c"))
    loop.answer()
    loop.aim(base=goal_at(AIM, "d"))
    loop.answer()
    hand = loop.executive.controller.goal.end_effector
    assert hand is not None
    np.testing.assert_allclose(hand.position, TIP, atol=1e-12)


def test_a_base_that_only_turns_carries_the_hand_about_the_centre_of_mass() -> None:
    loop = ExecutiveLoop(base_outputs="rz", end_effector_outputs="x y")
    loop.answer()
    turn = Rotation.from_euler("z", 0.5)
    loop.aim(base=IdentifiedGoal(Goal(AIM, turn.as_quat()), "a"))
    loop.answer()
    hand = loop.executive.controller.goal.end_effector
    assert hand is not None
    center = planar_manipulator().center_of_mass(SHAPE)
    np.testing.assert_allclose(hand.position, center + turn.apply(TIP - center), atol=1e-12)


@pytest.mark.parametrize("end", ["reached", "failed", "aborted"])
def test_goals_of_base_and_hand_end_together_and_each_once(file: Path, end: str) -> None:
    loop = ExecutiveLoop(file, settle_time=0.02, time_limit=0.2)
    loop.aim(base=goal_at(AIM, "a"))
    loop.answer(2)
    loop.aim(end_effector=goal_at(TIP + AIM, "b"))
    loop.answer(2)
    assert loop.executive.unfinished_goals == {"a", "b"}
    assert loop.file.load().keys() == {"base", "end_effector"}
    if end == "reached":
        loop.place = AIM
    if end == "aborted":
        loop.executive.abort()
        loop.answer()
        assert not file.exists()
    loop.answer(30)
    assert loop.state == end
    assert not file.exists()
    assert loop.file.load() == {}
    ended = [each for each in loop.events if each.kind is EventKind(f"goal_{end}")]
    assert [each.goal_id for each in ended] == ["a", "b"]
    decided = [each.goal_id for each in loop.statuses if each.state.value == end]
    assert decided[:2] == ["a", "b"]
    assert "a" not in decided[1:]
    assert not loop.executive.unfinished_goals


@pytest.mark.parametrize("begun", [0, 2])
def test_a_goal_of_base_and_hand_ends_when_a_later_one_replaces_the_base(begun: int) -> None:
    """The hand keeps its pose: the robot comes to rest where both goals are met."""
    loop = ExecutiveLoop(settle_time=0.02)
    loop.answer()
    loop.aim(base=goal_at(-AIM, "a"), end_effector=goal_at(TIP + AIM, "a"))
    if begun:
        loop.answer(begun)
    loop.aim(base=goal_at(AIM, "b"))
    loop.answer()
    assert loop.executive.unfinished_goals == {"b"}
    hand = loop.executive.controller.goal.end_effector
    assert hand is not None
    np.testing.assert_allclose(hand.position, TIP + AIM)
    loop.place = AIM
    loop.answer(10)
    reached = [each.goal_id for each in loop.events if each.kind is EventKind.GOAL_REACHED]
    assert reached == ["b"]


def test_a_goal_is_reached_when_it_is_held_for_the_settling_time() -> None:
    loop = ExecutiveLoop(settle_time=0.03, time_limit=1.0)
    right = np.array([0.5, 0.0, 0.0])
    loop.aim(base=goal_at(right, "7"), end_effector=goal_at(TIP + right, "7"))
    loop.answer()
    loop.place = right
    for _ in range(3):
        loop.answer()
        assert loop.state == "tracking"
    loop.place = right + np.array([0.002, 0.0, 0.0])
    loop.answer()
    loop.place = right
    for _ in range(3):
        loop.answer()
        assert loop.state == "tracking", "the time begins anew"
    loop.answer()
    assert loop.state == "reached"
    assert_one_sentence(loop.status.message, "reached")
    assert (loop.status.goal_id, loop.status.state.level) == ("7", 0)
    said, message = len(loop.statuses), loop.status.message
    loop.place = np.zeros(3)
    loop.answer(5)
    assert loop.state == "reached", "it was reached, wherever the robot is pushed to later"
    assert {each.message for each in loop.statuses[said:]} == {message}


@pytest.mark.parametrize(("link", "state"), [("", "reached"), ("end_effector", "reached_partly")])
def test_an_attitude_that_follows_from_the_joints_counts_for_a_hand_that_is_named(
    link: str, state: str
) -> None:
    """A pose on the topic of the end-effector, which names none, has an attitude in any case."""
    loop = ExecutiveLoop(settle_time=0.0)
    turned = Rotation.from_rotvec([0.0, 0.0, 0.7]).as_quat()
    goal = Goal.of_end_effectors([EndEffectorGoal(link, TIP, turned)])
    loop.aim(end_effector=IdentifiedGoal(goal, "7"))
    loop.answer(4)
    assert loop.state == state


def test_the_settling_time_of_a_goal_begins_with_the_goal() -> None:
    """Where one goal was nearly settled, the next one at the same place settles all over."""
    loop = ExecutiveLoop(settle_time=0.03, time_limit=1.0)
    loop.aim(base=goal_at([0.0, 0.0, 0.0], "first"))
    loop.answer(3)
    loop.aim(base=goal_at([0.0, 0.0, 0.0], "second"))
    for _ in range(3):
        loop.answer()
        assert (loop.state, loop.status.goal_id) == ("tracking", "second")
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("reached", "second")


TOLERANCES = {"position_tolerance": 1e-3, "attitude_tolerance": 4e-3, "joint_tolerance": 16e-3}


def beside(kind: str, by: float) -> tuple[dict[str, Any], dict[str, IdentifiedGoal]]:
    """Return settings, and goals that the robot misses by so much in one kind of error alone."""
    turned = np.array([0.0, 0.0, math.sin(by / 2), math.cos(by / 2)])
    match kind:
        case "position":
            return {}, {"end_effector": goal_at(TIP + np.array([0.0, by, 0.0]))}
        case "attitude":
            base = IdentifiedGoal(Goal(np.zeros(3), turned))
            return {}, {"base": base, "end_effector": goal_at(TIP)}
    return SHAPE_IS_CONTROLLED, {"base": goal_at(np.zeros(3), shape=SHAPE + np.array([0.0, -by]))}


@pytest.mark.parametrize("kind", ["position", "attitude", "joint"])
def test_each_kind_of_error_has_a_tolerance_of_its_own(kind: str) -> None:
    names = list(TOLERANCES)
    # Each tolerance is once the smallest, once in the middle, once the largest of the three.
    for turn in range(3):
        values = [*TOLERANCES.values()][turn:] + [*TOLERANCES.values()][:turn]
        limits: dict[str, Any] = dict(zip(names, values, strict=True))
        limit = limits[f"{kind}_tolerance"]
        for share, state in ((0.99, "reached"), (1.01, "tracking")):
            settings, goals = beside(kind, share * limit)
            loop = ExecutiveLoop(settle_time=0.0, **settings, **limits)
            loop.answer()
            loop.aim(**goals)
            loop.answer()
            assert loop.state == state, (limits, share)


def test_a_goal_is_not_reached_before_the_reference_is() -> None:
    settings: dict[str, Any] = {"profile": "quintic", "motion.acceleration": 0.5}
    loop = ExecutiveLoop(settle_time=0.0, **settings)
    loop.aim(base=goal_at([0.0005, 0.0, 0.0]))
    loop.answer()
    assert loop.state == "tracking", "already within the tolerance, but on its way"
    # The largest acceleration of a quintic of length d and duration T is 10 d / (sqrt(3) T^2).
    duration = math.sqrt(10.0 * 0.0005 / (math.sqrt(3.0) * 0.5))
    assert loop.status.ends_at_s == pytest.approx(duration, abs=0.011)
    loop.answer(40)
    assert loop.state == "reached"
    assert loop.status.ends_at_s == 0.0


def test_the_settling_time_counts_until_a_goal_is_to_be_reached() -> None:
    loop = ExecutiveLoop(settle_time=7.0)
    loop.aim(base=goal_at(AIM))
    loop.answer()
    assert loop.status.ends_at_s == pytest.approx(7.0, abs=0.011)


def test_a_goal_that_is_not_met_in_time_has_failed() -> None:
    loop = ExecutiveLoop(time_limit=0.05)
    loop.aim(base=goal_at(AIM))
    loop.answer(5)
    assert loop.state == "tracking"
    loop.answer()
    assert (loop.state, loop.status.state.level) == ("failed", 2)
    loop.aim(base=goal_at([0.0, 0.0, 0.0]))
    loop.answer()
    assert loop.state == "tracking", "the next goal has its own time"


@pytest.mark.parametrize("key", ["base", "end_effector"])
def test_tolerances_that_change_in_flight_take_effect(key: str) -> None:
    loop = ExecutiveLoop(settle_time=0.0)
    start = np.zeros(3) if key == "base" else TIP
    loop.aim(**{key: goal_at(start + np.array([0.0, 0.2, 0.0]))})
    loop.answer(3)
    assert loop.state == "tracking"
    loop.configure(position_tolerance=0.25)
    loop.answer()
    assert loop.state == "reached"


@pytest.mark.parametrize(
    ("key", "settings"),
    [
        ("base", {"law": "computed_torque"}),
        ("end_effector", {"law": "computed_torque"}),
        ("end_effector", SHAPE_IS_CONTROLLED),
    ],
)
def test_a_goal_for_what_is_not_controlled_is_refused(key: str, settings: dict[str, Any]) -> None:
    loop = ExecutiveLoop(**settings)
    law = settings.get("law", "transposed_jacobian")
    with pytest.raises(PlanningError) as refusal:
        loop.aim(**{key: goal_at(AIM)})
    assert_one_sentence(str(refusal.value), law, key.replace("_", "-"), "joint.shoulder")
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)


# -- abort ------------------------------------------------------------------------------------


@pytest.mark.parametrize("key", ["base", "end_effector"])
def test_an_abort_gives_up_every_goal(key: str) -> None:
    """Also the other of two, and one that still waits for a state: nothing moves afterwards."""
    loop = ExecutiveLoop()
    loop.answer()
    up = np.array([0.0, 1.0, 0.0])
    loop.aim(base=goal_at(AIM), end_effector=goal_at(TIP + up))
    loop.answer()
    loop.aim(**{key: goal_at(-AIM, "waiting")})
    loop.executive.abort()
    for _ in range(2):
        np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)
        assert (loop.state, loop.status.goal_id) == ("aborted", "waiting")
    # A goal of one alone does not bring back that of the other.
    loop.aim(base=goal_at(AIM))
    np.testing.assert_allclose(loop.answer()[0][:3], 2 * KP * AIM, atol=1e-12)


def test_an_abort_holds_the_shape_that_the_joints_have() -> None:
    loop = ExecutiveLoop(**SHAPE_IS_CONTROLLED)
    loop.aim(base=goal_at(np.zeros(3), shape=SHAPE + 0.5))
    assert np.all(loop.answer()[1] > 0.0)
    loop.executive.abort()
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)


def test_an_abort_after_a_goal_was_reached_does_not_decide_it_again() -> None:
    loop = ExecutiveLoop(settle_time=0.0)
    loop.aim(base=goal_at(np.zeros(3), "4"))
    loop.answer(3)
    assert (loop.state, loop.status.goal_id) == ("reached", "4")
    loop.executive.abort()
    loop.answer(3)
    assert (loop.state, loop.status.goal_id) == ("aborted", "")
    loop.aim(base=goal_at(AIM, "5"))
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("tracking", "5")


def test_a_goal_before_an_abort_is_dropped_and_one_after_it_is_flown(file: Path) -> None:
    loop = ExecutiveLoop(file)
    loop.answer()
    loop.aim(base=goal_at(AIM))
    loop.executive.abort()
    loop.aim(base=goal_at([-0.5, 0.0, 0.0]))
    np.testing.assert_allclose(loop.answer()[0][:3], [-KP, 0.0, 0.0], atol=1e-12)
    assert json.loads(file.read_text())["base"]["position"] == [-0.5, 0.0, 0.0]
    assert [status.state.value for status in loop.statuses[-2:]] == ["aborted", "tracking"]


def test_a_reset_drops_goals_and_the_first_state_is_held_again() -> None:
    loop = ExecutiveLoop()
    loop.aim(base=goal_at(AIM, "1"))
    loop.answer()
    loop.aim(base=goal_at(-AIM, "2"))
    loop.executive.reset()
    loop.place = np.array([0.5, 0.0, 0.0])
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)
    assert (loop.state, loop.status.goal_id) == ("holding", "")
    assert_one_sentence(loop.status.message, "Waiting for a goal; holding, 0 m")
    loop.executive.reset()
    loop.answer(measured=False)
    assert loop.state == "waiting"


# -- references from outside -----------------------------------------------------------------


def test_a_reference_from_outside_is_followed_and_what_it_lacks_is_held() -> None:
    loop = ExecutiveLoop(**SHAPE_IS_CONTROLLED)
    loop.answer()
    reference = Reference(base=PoseReference(AIM, UPRIGHT))
    np.testing.assert_allclose(loop.answer(reference=reference)[0][:3], KP * AIM, atol=1e-12)
    bent = Reference(joints=JointReference.at_rest(SHAPE + 0.1))
    wrench, effort = loop.answer(reference=bent)
    assert np.abs(wrench).max() < 1e-12
    assert np.all(effort > 0.0)


def test_a_reference_of_the_end_effector_from_outside_is_followed() -> None:
    loop = ExecutiveLoop()
    loop.answer()
    up = np.array([0.0, 0.5, 0.0])
    reference = Reference(end_effector=PoseReference(TIP + up, UPRIGHT))
    np.testing.assert_allclose(loop.answer(reference=reference)[0][:3], KP * up, atol=1e-12)
    # The base's own goal goes on beside it.
    loop.aim(base=goal_at(AIM))
    np.testing.assert_allclose(loop.answer(reference=reference)[0][:3], KP * (AIM + up), atol=1e-12)


# -- statuses, construction -------------------------------------------------------------------


def test_a_status_is_reported_on_changes_and_every_period() -> None:
    loop = ExecutiveLoop(status_period=0.1, max_force=KP)
    loop.answer(25)
    assert len(loop.statuses) == 3
    loop.aim(base=goal_at([1.0, 0.0, 0.0]))
    loop.answer()
    assert loop.state == "tracking"
    count = len(loop.statuses)
    report = loop.status.command
    assert report is not None
    assert report.lost_force_N == pytest.approx(KP)
    # Base and tip pull by 0.4 of it each: within the limit, reported at once.
    loop.place = np.array([0.6, 0.0, 0.0])
    loop.answer()
    assert len(loop.statuses) == count + 1
    report = loop.status.command
    assert report is not None
    assert report.lost_force_N == 0.0
    loop.answer()
    assert len(loop.statuses) == count + 1


_DECIDED = ("reached", "reached_partly", "failed", "refused", "aborted")


@given(
    state=st.sampled_from(ControllerState),
    goal_id=st.sampled_from(["", "12.000000345", "unstamped-2"]),
    errors=st.none() | st.fixed_dictionaries({"base.x": st.floats(-9, 9), "joint.a": st.just(1.0)}),
    wheels=st.sampled_from([{}, {"w": -0.25}]),
    task=st.sampled_from(["", "approach"]),
    ends_at=st.sampled_from([0.0, 86_400.125]),
    goal=st.sampled_from([(), (0.1, -0.25, 1234.5, 0.0, 0.6, 0.0, 0.8)]),
)
def test_a_status_survives_its_values(
    state: ControllerState,
    goal_id: str,
    errors: dict[str, float] | None,
    wheels: dict[str, float],
    task: str,
    ends_at: float,
    goal: tuple[float, ...],
) -> None:
    report, momentum, dumping = None, {"sum": 2.0} if wheels else {}, bool(wheels)
    if errors is not None:
        numbers = (0.01, 0.5, 0.0, 1.5, 2.25)
        report = CommandReport("model_based", True, *numbers, errors, wheels, momentum, dumping)
    status = ControllerStatus(state, "A sentence.", goal_id, report, task, ends_at, goal)
    values = status.to_values()
    assert all(isinstance(value, str) for value in values.values())
    again = ControllerStatus.from_values(values, "A sentence.")
    assert again.to_values() == values
    assert replace(again, command=None) == replace(status, command=None)
    assert values.get("task", "") == task
    if again.command is not None:
        found = again.command.wheels, again.command.momentum, again.command.dumping
        assert found == (wheels, momentum, dumping)
    assert ("dumping" in values) == (dumping and report is not None)
    assert state.decided == (state.value in _DECIDED)


@pytest.mark.parametrize("values", [{}, {"state": "flying"}, {"state": "holding", "law": "a"}])
def test_other_values_are_no_status_of_a_controller(values: dict[str, str]) -> None:
    with pytest.raises(SpaceRobotError, match="No status of a controller"):
        ControllerStatus.from_values(values)


# -- events, and a plant that does not obey ---------------------------------------------------


def kinds(loop: ExecutiveLoop) -> list[tuple[str, str]]:
    return [(event.kind.value, event.goal_id) for event in loop.events]


def test_each_change_of_a_goal_is_one_event() -> None:
    loop = ExecutiveLoop(settle_time=0.02, time_limit=0.2)
    loop.answer(3)
    assert loop.events == []
    loop.aim(base=goal_at([0.0, 0.0, 0.0], "here"))
    loop.answer(5)
    loop.aim(base=goal_at([1.0, 0.0, 0.0], "there"))
    loop.answer(30)
    loop.aim(base=goal_at([2.0, 0.0, 0.0], "beyond"))
    loop.answer(3)
    loop.executive.abort()
    loop.answer(30)
    loop.executive.refuse("It is too far.", "far")
    assert kinds(loop) == [
        ("goal_accepted", "here"),
        ("goal_reached", "here"),
        ("goal_accepted", "there"),
        ("goal_failed", "there"),
        ("goal_accepted", "beyond"),
        ("goal_aborted", "beyond"),
        ("goal_refused", "far"),
    ]


def test_a_plant_that_stops_ends_the_goal_at_once_and_once(file: Path) -> None:
    loop = ExecutiveLoop(file)
    loop.aim(base=goal_at([1.0, 0.0, 0.0], "there"))
    loop.answer(3)
    assert file.exists()
    loop.executive.plant_stopped("The plant is latched.")
    assert (loop.state, loop.status.goal_id) == ("aborted", "there")
    assert loop.status.message == "Aborted by the plant: The plant is latched."
    assert not file.exists()
    loop.place = np.array([0.4, 0.0, 0.0])
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench, 0.0, atol=1e-12)
    loop.answer(5)
    assert loop.status.message == "Aborted by the plant: The plant is latched."
    loop.executive.plant_stopped("The plant is latched.")
    assert kinds(loop) == [("goal_accepted", "there"), ("goal_aborted", "there")]
    # A goal that waits for its first state is given up as well.
    loop.aim(base=goal_at([2.0, 0.0, 0.0], "beyond"))
    loop.executive.plant_stopped("The plant has failed.")
    assert loop.status.goal_id == "beyond"
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench, 0.0, atol=1e-12)


def test_a_plant_that_stops_before_an_abort_is_answered_decides_the_goal_once() -> None:
    loop = ExecutiveLoop()
    loop.aim(base=goal_at([1.0, 0.0, 0.0], "there"))
    loop.answer(3)
    loop.executive.abort()
    loop.executive.plant_stopped("The plant is latched.")
    loop.answer(3)
    assert kinds(loop) == [("goal_accepted", "there"), ("goal_aborted", "there")]


def test_a_motion_starts_again_if_the_plant_rested_during_it() -> None:
    loop = ExecutiveLoop(profile="quintic")
    loop.answer(3)
    loop.aim(base=goal_at([1.0, 0.0, 0.0], "there"))
    loop.answer(3)
    before = loop.status
    loop.executive.plant_rested(30_000_000, 10**12)
    assert loop.status is before
    loop.executive.plant_rested(40_000_000, 10**12)
    assert (loop.state, loop.status.goal_id) == ("tracking", "there")
    assert_one_sentence(loop.status.message, "no command arrived in time", "starts again")
    # The reference leads from where the robot is now: it is not pulled back.
    loop.place = np.array([0.0, 0.4, 0.0])
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], 0.0, atol=1e-3)
    loop.place = np.array([0.0, 0.8, 0.0])
    assert loop.answer()[0][1] < -1.0
    assert kinds(loop) == [("goal_accepted", "there")]


def test_a_held_pose_is_not_flown_back_to_after_a_latch() -> None:
    loop = ExecutiveLoop(settle_time=0.02)
    loop.aim(base=goal_at([0.0, 0.0, 0.0], "here"))
    loop.answer(5)
    assert loop.state == "reached"
    loop.executive.plant_stopped("The plant is latched.")
    loop.place = np.array([0.4, 0.0, 0.0])
    loop.executive.on_plant_obeying()
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench, 0.0, atol=1e-12)
    assert (loop.state, loop.status.goal_id) == ("holding", "")


def test_every_answer_to_a_plant_that_does_not_obey_holds_the_robot_where_it_is() -> None:
    loop = ExecutiveLoop()
    loop.answer()
    loop.executive.plant_blocked = True
    for x in (0.4, 0.9):
        loop.place = np.array([x, 0.0, 0.0])
        wrench, _ = loop.answer()
        np.testing.assert_allclose(wrench, 0.0, atol=1e-12)
    loop.executive.plant_blocked = False
    loop.place = np.array([1.0, 0.0, 0.0])
    wrench, _ = loop.answer()
    assert wrench[0] < 0.0  # Back to where it was held last.


@pytest.mark.parametrize("ticks", [10**8, -3 * 10**5])
def test_a_jump_of_time_is_no_progress_of_a_goal(ticks: int) -> None:
    loop = ExecutiveLoop(settle_time=0.05, time_limit=0.1)
    loop.tick = 4 * 10**5
    loop.aim(base=goal_at([0.0, 0.0, 0.0], "here"))
    loop.answer(3)
    loop.tick += ticks
    loop.answer()
    assert loop.state == "tracking"
    loop.answer(3)
    assert loop.state == "tracking"
    loop.answer(3)
    assert loop.state == "reached"


def test_force_and_torque_that_thrusters_cannot_give_are_reported_apart() -> None:
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    turned = Goal(np.array([0.3, -0.2, 0.1]), Rotation.from_rotvec([0.5, -0.3, 0.2]).as_quat())
    rest = ControlState.at_rest(np.zeros(3), UPRIGHT, np.zeros(3))
    wrenches, statuses = list[Any](), list[ControllerStatus]()
    for limits in ({}, {"max_force": 0.5, "max_torque": 0.25}):
        config = configured(
            ControllerConfig,
            {"status_period": 0.01, "profile": "step", "tick_rate": 100.0, **limits},
        )
        executive = ControlExecutive(build_controller(robot, config), config)
        executive.submit("base", IdentifiedGoal(turned))
        result = executive.command(0.01, rest, rest.q, rest.qdot, None)
        executive.evaluate(0.01, result)
        wrenches.append(result.realised.wrench_B)
        statuses += [each for each in executive.outputs if isinstance(each, ControllerStatus)]
    lost, report = wrenches[0] - wrenches[1], statuses[-1].command
    assert report is not None
    assert np.linalg.norm(wrenches[1][:3]) == pytest.approx(0.5)
    assert report.lost_force_N == pytest.approx(np.linalg.norm(lost[:3]))
    assert report.lost_torque_Nm == pytest.approx(np.linalg.norm(lost[3:]))
    assert abs(lost[3]) > 1e-3


# -- without odom -----------------------------------------------------------------------------


def test_the_estimate_takes_what_the_thrusters_gave_and_not_what_was_wanted() -> None:
    """Of 300 N that a far goal wants they give 5: so much the momentum grows, and no more."""
    robot, force = planar_manipulator(), 5.0
    loop = ExecutiveLoop(estimation_time=1.0, max_force=force)
    loop.aim(base=goal_at([10.0, 0.0, 0.0]), end_effector=goal_at(TIP))
    assert np.linalg.norm(loop.answer()[0][:3]) == pytest.approx(force)
    for ticks in range(1, 6):
        loop.answer(measured=False)
        state = loop.executive.controller.law.state
        momentum, _, _ = robot.momentum(
            state.quaternion_WB, state.q, state.v_WB_B, state.omega_WB_B, state.qdot
        )
        np.testing.assert_allclose(momentum, [force * ticks * PERIOD, 0.0, 0.0], atol=1e-3)


def test_joints_that_are_stopped_do_not_swing_back() -> None:
    """Critically damped from where they are: the rates decay as exp(-2 t/s), over qdot / 2."""
    loop = ExecutiveLoop()
    rates = np.array([0.3, -0.2])
    plant = EffortPlant(
        planar_manipulator(), PERIOD, InitialState(joint_positions=SHAPE, joint_velocities=rates)
    )
    for tick in range(300):
        result = loop.executive.command(tick * PERIOD, None, plant.q, plant.qdot)
        assert not result.realised.wrench_B.any()
        plant.step(result.realised.tau, np.zeros(6))
        expected = rates * math.exp(-2.0 * (tick + 1) * PERIOD)
        np.testing.assert_allclose(plant.qdot, expected, atol=0.01)
        assert np.all(plant.qdot * rates > 0.0), "no joint turns back"
    np.testing.assert_allclose(plant.q, SHAPE + rates / 2.0, atol=0.01)


def test_without_odom_from_the_beginning_nothing_is_thrust_and_the_goal_waits() -> None:
    loop = ExecutiveLoop()
    loop.aim(base=goal_at([1.0, 0.0, 0.0]))
    for _ in range(3):
        np.testing.assert_array_equal(loop.answer(measured=False)[0], np.zeros(6))
    assert (loop.state, loop.status.state.level) == ("waiting", 0)
    assert_one_sentence(loop.status.message, "Waiting for states on 'odom'")
    np.testing.assert_allclose(loop.answer()[0][:3], [2 * KP, 0.0, 0.0], atol=1e-12)
    assert loop.state == "tracking"


def test_an_abort_without_odom_holds_where_the_robot_is_seen_again() -> None:
    loop = ExecutiveLoop()
    loop.aim(base=goal_at([1.0, 0.0, 0.0]))
    loop.answer()
    loop.answer(measured=False)
    assert loop.state == "tracking", "a single pose may be late"
    loop.executive.abort()
    loop.answer(11, measured=False)
    assert loop.state == "estimating"
    loop.place = np.array([0.25, 0.0, 0.0])
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)
    assert loop.state == "aborted"


@pytest.mark.parametrize("before", ["holding", "aborted", "reached"])
def test_a_gap_between_states_decides_nothing(before: str) -> None:
    loop = ExecutiveLoop(settle_time=0.01, time_limit=0.1)
    if before != "holding":
        loop.aim(base=goal_at([1.0 if before == "aborted" else 0.0, 0.0, 0.0]))
    loop.answer()
    if before == "aborted":
        loop.executive.abort()
    loop.answer(20)
    assert loop.state == before
    loop.answer(12, measured=False)
    assert loop.state == "estimating"
    if before == "reached":
        # It has drifted in the meantime.
        loop.place = np.array([0.01, 0.0, 0.0])
    loop.answer(4)
    assert loop.state == before
    assert "failed" not in [status.state.value for status in loop.statuses]


def test_the_estimate_begins_at_the_last_measured_state_whatever_becomes_of_its_memory() -> None:
    """A node reads every state into the same arrays: what is kept of one must be a copy."""
    commands = []
    for reused in (False, True):
        controller = build_controller(planar_manipulator(), ControllerConfig())
        q, qdot = np.zeros(2), np.array([0.4, -0.3])
        for tick in range(4):
            joints = SHAPE + PERIOD * tick * qdot
            if reused:
                q[:] = joints
            else:
                q = joints
            base = np.array([0.1, 0.0, 0.0])
            state = ControlState(base, UPRIGHT, np.zeros(3), np.zeros(3), q, qdot)
            result = controller.command(PERIOD * tick, state if tick < 2 else None, q, qdot)
        commands.append(np.concatenate([result.realised.wrench_B, result.realised.tau]))
    np.testing.assert_array_equal(commands[0], commands[1])


# -- the file ---------------------------------------------------------------------------------


def resumed(file: Path, **settings: Any) -> ExecutiveLoop:
    """Return another loop that resumes the goals of the file."""
    loop = ExecutiveLoop(file, **settings)
    loop.executive.resume(loop.file.load())
    return loop


def test_it_goes_on_from_where_the_robot_is_and_what_was_held_is_still_held(file: Path) -> None:
    first = ExecutiveLoop(file)
    first.answer()
    first.aim(base=goal_at(AIM, "9.000000001"))
    first.answer()
    loop = resumed(file)
    # Meanwhile all of it has drifted: the base, that has a goal, and the tip, that it carries.
    loop.place = np.array([0.125, -0.25, 0.0])
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], 2 * KP * (AIM - loop.place), atol=1e-12)
    assert (loop.state, loop.status.goal_id) == ("tracking", "9.000000001")


def test_a_law_that_holds_the_shape_goes_on_to_the_shape(file: Path) -> None:
    first = ExecutiveLoop(file, **SHAPE_IS_CONTROLLED)
    first.aim(base=goal_at(AIM))
    first.answer()
    assert json.loads(file.read_text())["base"]["joint_positions"] == SHAPE.tolist()
    resumed(file, **SHAPE_IS_CONTROLLED).answer()
    kept = json.loads(file.read_text())["base"]
    assert (kept["position"], kept["joint_positions"]) == (AIM.tolist(), SHAPE.tolist())


def test_a_goal_that_comes_at_once_replaces_the_saved_one(file: Path) -> None:
    far = TIP + np.array([0.0, 1.0, 0.0])
    first = ExecutiveLoop(file)
    first.aim(base=goal_at(AIM), end_effector=goal_at(far))
    first.answer()
    loop = resumed(file)
    loop.aim(base=goal_at([-0.5, 0.0, 0.0]))
    np.testing.assert_allclose(loop.answer()[0][:3], KP * np.array([-0.5, 1.0, 0.0]), atol=1e-12)
    kept = json.loads(file.read_text())
    assert kept["base"]["position"] == [-0.5, 0.0, 0.0]
    assert kept["end_effector"]["position"] == far.tolist()


def test_where_nothing_can_be_written_the_goal_is_flown(tmp_path: Path) -> None:
    loop = ExecutiveLoop(tmp_path / "nowhere" / "goals.json")
    loop.aim(base=goal_at(AIM))
    np.testing.assert_allclose(loop.answer()[0][:3], 2 * KP * AIM, atol=1e-12)
    assert loop.state == "tracking"
    (warning,) = loop.warnings
    assert "will not be resumed after a restart" in warning
