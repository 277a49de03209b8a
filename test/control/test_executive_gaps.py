"""What a controller's executive does without measurements of the base, and after a restart."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
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

from spacerobot_ros.control import (
    ControlState,
)
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.simulation import EffortPlant, InitialState

# -- without odom -----------------------------------------------------------------------------


def test_the_base_is_estimated_for_a_while_and_then_the_thrusters_are_off() -> None:
    loop = ExecutiveLoop(estimation_time=0.05)
    loop.aim(base=goal_at([1.0, 0.0, 0.0], "3"), end_effector=goal_at(TIP, "3"))
    measured = loop.answer()[0]
    for tick in range(5):
        wrench, _ = loop.answer(measured=False)
        np.testing.assert_allclose(wrench, measured, atol=0.15 * np.abs(measured).max())
        # A single pose may be late.
        reported = ("estimating", 1) if tick else ("tracking", 0)
        assert (loop.state, loop.status.state.level) == reported
        assert loop.status.goal_id == "3"
    loop.rates = np.array([0.1, -0.2])
    for _ in range(4):
        wrench, effort = loop.answer(measured=False)
        np.testing.assert_array_equal(wrench, np.zeros(6))
    # The joints are slowed: their efforts take energy out of them.
    assert effort @ loop.rates < 0.0
    assert (loop.state, loop.status.state.level) == ("stopped", 2)
    assert_one_sentence(loop.status.message, "thrusters off")
    loop.rates = np.zeros(2)
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)
    assert loop.state == "tracking"


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
    loop.executive.abort()
    loop.answer(2, measured=False)
    assert loop.state == "estimating"
    loop.place = np.array([0.25, 0.0, 0.0])
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)
    assert loop.state == "aborted"


def test_a_robot_that_held_still_holds_after_a_gap() -> None:
    loop = ExecutiveLoop()
    loop.answer()
    loop.answer(2, measured=False)
    assert loop.state == "estimating"
    loop.answer()
    assert loop.state == "holding"


def test_an_aborted_goal_is_not_reached_after_a_gap() -> None:
    loop = ExecutiveLoop(settle_time=0.0)
    loop.aim(base=goal_at([1.0, 0.0, 0.0]))
    loop.answer()
    loop.executive.abort()
    loop.answer()
    loop.answer(measured=False)
    loop.answer(4)
    assert loop.state == "aborted"


def test_a_reached_goal_does_not_fail_after_a_gap() -> None:
    loop = ExecutiveLoop(settle_time=0.01, time_limit=0.1)
    loop.aim(base=goal_at([0.0, 0.0, 0.0]))
    loop.answer(20)
    assert loop.state == "reached"
    loop.answer(2, measured=False)
    assert loop.state == "estimating"
    # It has drifted in the meantime.
    loop.place = np.array([0.01, 0.0, 0.0])
    loop.answer(4)
    assert loop.state == "reached"
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


@pytest.mark.parametrize("end", ["aborted", "reached", "failed"])
def test_a_goal_that_is_decided_is_not_kept(file: Path, end: str) -> None:
    loop = ExecutiveLoop(file, settle_time=0.02, time_limit=0.2)
    # The tip is to stay where it was: at another goal of the base the robot would not be at rest.
    loop.aim(base=goal_at(np.zeros(3) if end == "reached" else AIM))
    loop.answer()
    assert file.exists()
    if end == "aborted":
        loop.executive.abort()
        loop.answer()
        assert not file.exists()
    loop.answer(25)
    assert loop.state == end
    assert not file.exists()
    assert loop.file.load() == {}


@pytest.mark.parametrize(
    ("key", "shape", "settings", "mentions"),
    [
        ("end_effector", None, {"law": "computed_torque"}, ("computed_torque", "end-effector")),
        ("base", np.zeros(3), {}, ("3 joints", "planar_manipulator", "2")),
    ],
)
def test_goals_of_another_robot_or_law_are_refused(
    key: str, shape: np.ndarray | None, settings: dict[str, Any], mentions: tuple[str, ...]
) -> None:
    loop = ExecutiveLoop(**settings)
    with pytest.raises(ParameterError) as refusal:
        loop.executive.resume({key: goal_at(AIM, shape=shape)})
    assert_one_sentence(str(refusal.value), "resume_file", *mentions)
    loop.answer()
    assert loop.state == "holding"


def test_where_nothing_can_be_written_the_goal_is_flown(tmp_path: Path) -> None:
    loop = ExecutiveLoop(tmp_path / "nowhere" / "goals.json")
    loop.aim(base=goal_at(AIM))
    np.testing.assert_allclose(loop.answer()[0][:3], 2 * KP * AIM, atol=1e-12)
    assert loop.state == "tracking"
    (warning,) = loop.warnings
    assert "not resumed after a restart" in warning
