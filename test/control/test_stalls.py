"""Robots that come no nearer to their goals: said, with the cause, and taken back."""

from __future__ import annotations

from typing import Any

import numpy as np
from support.executive_loop import AIM, PERIOD, TIP, Array, ExecutiveLoop, goal_at
from support.sentences import assert_one_sentence

from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal

SECONDS = round(1 / PERIOD)


def aimed(**settings: Any) -> ExecutiveLoop:
    loop = ExecutiveLoop(**settings)
    loop.answer()
    move(loop, AIM, "7")
    return loop


def move(loop: ExecutiveLoop, by: Array, goal_id: str) -> None:
    """Give goals to the base and to the end-effector, which is carried along."""
    loop.aim(base=goal_at(by, goal_id), end_effector=goal_at(TIP + by, goal_id))


def wait_for_stall(loop: ExecutiveLoop, longest: float = 40.0) -> float:
    """Show states until the robot is stalled; return the simulated time that it takes, s."""
    began = loop.tick
    while loop.state != "stalled":
        assert (loop.tick - began) * PERIOD < longest, loop.status.message
        loop.answer(10)
    assert loop.status.state.level == 1
    return (loop.tick - began) * PERIOD


def test_a_robot_that_does_not_move_is_stalled_until_it_moves() -> None:
    loop = aimed()
    assert wait_for_stall(loop) < 25.0
    message = loop.status.message
    assert_one_sentence(message, "Stalled 0.559 m, 0 rad from the reference: its errors no longer")
    assert loop.status.goal_id == "7"
    assert loop.executive.unfinished_goals == {"7"}
    assert [event.kind.value for event in loop.events] == ["goal_accepted"], "it is no decision"
    loop.answer(5 * SECONDS)
    assert loop.state == "stalled"
    for share in np.linspace(0.0, 0.8, 30 * SECONDS):
        loop.place = share * AIM
        loop.answer()
    assert loop.state == "tracking"
    assert loop.status.message.startswith("Flying to the goal; ")


def test_a_new_goal_is_not_stalled_from_the_beginning() -> None:
    loop = aimed()
    wait_for_stall(loop)
    move(loop, -AIM, "8")
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("tracking", "8")
    wait_for_stall(loop)


def test_within_the_tolerances_nothing_is_stalled() -> None:
    loop = aimed(position_tolerance=1.0, settle_time=1000.0)
    loop.answer(40 * SECONDS)
    assert loop.state == "tracking"


def test_errors_that_shrink_slowly_are_no_stall() -> None:
    loop = aimed()
    for tick in range(60 * SECONDS):
        loop.place = (1 - np.exp(-tick * PERIOD / 30.0)) * AIM
        loop.answer()
        assert loop.state == "tracking"


def test_a_robot_that_starts_slowly_is_not_stalled() -> None:
    """With 1 mm/s^2, it makes 2 % of its way in 4.7 s at first, and more and more."""
    loop = aimed(max_force=0.05)
    for tick in range(25 * SECONDS):
        loop.place = 0.5 * 0.001 * (tick * PERIOD) ** 2 * AIM / np.linalg.norm(AIM)
        loop.answer()
        assert loop.state == "tracking"


def test_limits_that_hold_the_robot_back_are_named() -> None:
    loop = aimed(max_force=1.0)
    wait_for_stall(loop)
    assert loop.status.message.endswith(": the force of the thrusters is at its limit.")
    loop = ExecutiveLoop(max_torque=0.01, base_outputs="x y rz", end_effector_outputs="")
    turned = np.array([0.0, 0.0, np.sin(0.1), np.cos(0.1)])
    loop.aim(base=IdentifiedGoal(Goal(np.zeros(3), turned), "turned"))
    loop.answer()
    wait_for_stall(loop)
    assert loop.status.message.endswith(": the torque on the base is at its limit.")


def test_a_failure_names_the_cause() -> None:
    loop = aimed(max_force=1.0, time_limit=40.0)
    wait_for_stall(loop)
    loop.answer(41 * SECONDS)
    assert loop.state == "failed"
    message = (
        "The goal is not reached in time, as the force of the thrusters is at its limit: 0.559"
    )
    assert_one_sentence(loop.status.message, message)


def test_a_robot_that_stays_behind_its_reference_is_stalled_on_the_way() -> None:
    loop = ExecutiveLoop(profile="quintic")
    loop.answer()
    move(loop, np.array([10.0, 0.0, 0.0]), "far")
    loop.answer()
    ends = loop.executive.controller.reference_ends
    assert ends is not None
    assert wait_for_stall(loop, ends) < 0.8 * ends
    assert not loop.executive.controller.reference_at_rest(loop.tick * PERIOD)


def test_a_robot_that_is_behind_and_follows_is_not_stalled_on_the_way() -> None:
    loop = ExecutiveLoop(profile="quintic")
    loop.answer()
    move(loop, np.array([2.0, 0.0, 0.0]), "far")
    loop.answer()
    controller = loop.executive.controller
    while not controller.reference_at_rest(loop.tick * PERIOD):
        late = controller.profile.at(loop.tick * PERIOD - 4.0).base if controller.profile else None
        assert late is not None
        loop.place = late.position
        loop.answer()
        assert loop.state == "tracking"


def test_before_a_first_measurement_a_controller_waits() -> None:
    loop = ExecutiveLoop()
    loop.answer(measured=False)
    assert (loop.state, loop.status.state.level) == ("waiting", 0)
    assert_one_sentence(loop.status.message, "Waiting for states on 'odom'")
    loop.answer()
    assert loop.state == "holding"
    assert_one_sentence(loop.status.message, "Waiting for a goal; holding, 0 m")
    loop.executive.reset()
    loop.answer(measured=False)
    assert loop.state == "waiting"
