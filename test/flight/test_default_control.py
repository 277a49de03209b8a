"""Controllers with nothing but a robot and a rate: robots fly to goals, or say why they do not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.slow import some_fast

from spacerobot_ros import fly
from spacerobot_ros.control import ControlState, Reference
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario

CUBE = """<robot name="cube"><link name="hull"><inertial><mass value="16"/>
  <inertia ixx="0.18" iyy="0.18" izz="0.18" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
BASE, TURN = np.array([0.3, 0.1, 0.0]), np.array([0.0, 0.0, 0.3])

SHAPES: dict[str, list[float]] = {
    "planar_manipulator": [-1.0, 1.0],
    "servicer": [0.0, -1.2, 2.0, 0.0, 0.8, 0.0],
    "planar_chain": [1.0, 1.2],
    "three_joint_arm": [0.5, -0.8, 1.2],
    "dual_arm": [0.0] * 14,
    "free_flyer": [0.0] * 6,
    "cube": [],
}

LARGE = ("dual_arm", "free_flyer")

HANDS = ("planar_manipulator", "servicer", "three_joint_arm")
"""Robots whose end-effector is controlled by default."""


def flown(
    folder: Path,
    robot: str,
    rate: float,
    *,
    base: np.ndarray[Any, Any] = BASE,
    turn: np.ndarray[Any, Any] = TURN,
    hand: np.ndarray[Any, Any] | None = None,
    shape: list[float] | None = None,
    **settings: Any,
) -> Flight:
    """Fly the base to a pose, and the hand to where it is carried, away by ``hand``."""
    file = folder / "flight.yaml"
    shape = SHAPES[robot] if shape is None else shape
    if robot == "cube":
        (folder / "cube.urdf").write_text(CUBE, "utf-8")
        robot = str(folder / "cube.urdf")
    goals: dict[str, Any] = {"goal_position": base.tolist(), "goal_rotvec": turn.tolist()}
    if hand is not None:
        model = SpaceRobot.from_file(robot_file(robot))
        state = ControlState.at_rest(np.zeros(3), UPRIGHT, np.array(shape))
        now = Reference.present(model, state, "end_effector").end_effector
        assert now is not None
        turned = Rotation.from_rotvec(turn)
        attitude = turned * Rotation.from_quat(now.quaternion)
        goals["end_effector_goal_position"] = (base + turned.apply(now.position) + hand).tolist()
        goals["end_effector_goal_rotvec"] = attitude.as_rotvec().tolist()
    plant = {"robot": robot, "actuation": "effort", "tick_rate": rate}
    if shape:
        plant["initial_joint_positions"] = shape
    sections = {
        "scenario": {"description": "a goal", **goals},
        "/**/plant": plant,
        "/**/coordinated_control": {"robot": robot, "tick_rate": rate, **settings},
    }
    text = yaml.safe_dump({name: {"ros__parameters": of} for name, of in sections.items()})
    file.write_text(text, "utf-8")
    return fly_scenario(load_scenario(str(file)), longest=600.0)


def test_an_end_effector_is_brought_to_the_goal_of_the_caller_by_a_law() -> None:
    """In place of the scenario's goal; and a position alone where the law leaves attitudes free."""
    scenario = load_scenario("coordinated_control")
    goal = np.array([1.2, 1.4, 0.0])
    flight = fly(scenario, end_effector_position=goal)
    assert flight.succeeded
    assert flight.end_effector_errors["end_effector"].distance < 1e-3
    robot = SpaceRobot.from_file(robot_file("planar_manipulator"))
    R_BE, r_BE = robot.link_pose("end_effector", flight.q[-1])
    turn = Rotation.from_quat(flight.pose[-1, 3:])
    np.testing.assert_allclose(flight.pose[-1, :3] + turn.apply(r_BE), goal, atol=1e-3)
    assert abs((turn * Rotation.from_matrix(R_BE)).as_rotvec()[2]) > 0.5
    cases: tuple[tuple[dict[str, Any], str], ...] = (
        ({"end_effector_position": [1.2, 1.4, 2.0]}, "end-effector is 2 m from .* along z of"),
        ({"goal": [0.5, 0.5, 0.2]}, "base is 0.2 m from the current value along z of the world"),
        ({"end_effector_position": goal, "end_effector": "link_1"}, "'link_1', which the law"),
    )
    for given, named in cases:
        with pytest.raises(PlanningError, match=named):
            fly(scenario, **given)


def test_weak_motors_hold_an_arm_while_its_base_turns() -> None:
    """An arm of 15 m on a station: the turn takes as long as its motors need to carry it along."""
    turned = fly("station_arm", rotvec=(0.0, 0.08, 0.0), method="transposed_jacobian")
    assert turned.succeeded
    limits = SpaceRobot.from_file(robot_file("station_arm")).effort_limit
    assert np.abs(turned.effort / limits).max() < 0.9
    assert np.abs(turned.q - turned.q[0]).max() < 0.05


def test_a_part_that_is_not_asked_for_is_kept() -> None:
    """Where the base is at the start, by a law and by a gait method."""
    attitude = [0.0, 0.6, 0.0, 0.8]
    start = {"plant.initial_position": [0.4, -0.2, 0.1], "plant.initial_orientation": attitude}
    turned = fly(
        robot_file("three_joint_arm"),
        rotvec=[0, 0, 0.3],
        method="transposed_jacobian",
        parameters=start,
    )
    assert turned.succeeded
    np.testing.assert_allclose(turned.pose[-1, :3], [0.4, -0.2, 0.1], atol=2e-3)
    sliders = SpaceRobot.from_file(robot_file("sliding_masses"))
    quick = {"planner.lie_bracket.t1": 10.0, "planner.lie_bracket.cycle_period": 2.0}
    moved = fly(sliders, position=[0.42, -0.2, 0.1], method="lie_bracket", parameters=start | quick)
    assert moved.succeeded
    turn = Rotation.from_quat(attitude).inv() * Rotation.from_quat(moved.pose[-1, 3:])
    assert turn.magnitude() < 2e-3
    assert moved.goal is not None
    np.testing.assert_allclose(moved.goal.quaternion, attitude, atol=1e-12)


def statuses(flight: Flight) -> list[tuple[float, ControllerStatus]]:
    return [(t / 1e9, each) for t, each in flight.statuses if isinstance(each, ControllerStatus)]


def turns_of_sign(values: np.ndarray[Any, Any]) -> int:
    """Return how often large steps of a command are followed by large steps back."""
    steps = np.diff(values, axis=0) / (np.abs(values).max(axis=0) + 1e-12)
    large = np.abs(steps) > 0.05
    return int(((steps[1:] * steps[:-1] < 0) & large[1:] & large[:-1]).sum(axis=0).max(initial=0))


@pytest.mark.parametrize("rate", [5.0, 20.0, pytest.param(200.0, marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "robot", some_fast([*SHAPES], *(name for name in SHAPES if name not in LARGE))
)
def test_goals_are_reached_by_default(tmp_path: Path, robot: str, rate: float) -> None:
    hand = np.array([0.1, 0.1, 0.0]) if robot in HANDS else None
    flight = flown(tmp_path, robot, rate, hand=hand)
    assert flight.outcome is Outcome.REACHED, flight.message
    np.testing.assert_allclose(flight.pose[-1][:3], BASE, atol=1e-3)
    turned = Rotation.from_quat(flight.pose[-1][3:]) * Rotation.from_rotvec(TURN).inv()
    assert turned.magnitude() < 2e-3
    assert len(flight.pose) / rate < 30.0, "the reference takes 6 to 14 s"
    words = [each.state.value for _, each in statuses(flight)]
    assert words == ["waiting", *["tracking"] * (len(words) - 2), "reached"]
    assert all(each.state.level == 0 for _, each in statuses(flight))
    for given in flight.commands.values():
        assert turns_of_sign(given.values) <= 4, "it does not chatter"


def test_a_way_that_ends_early_is_no_stall(tmp_path: Path) -> None:
    """The reference rests after 6 s; the errors that it leaves behind fall to nothing."""
    base, turn = np.array([0.1, 0.05, 0.0]), np.array([0.0, 0.0, 0.1])
    flight = flown(tmp_path, "planar_chain", 100.0, base=base, turn=turn, shape=[])
    assert flight.outcome is Outcome.REACHED, flight.message
    assert not [each for _, each in statuses(flight) if each.state is ControllerState.STALLED]


def test_a_goal_that_only_the_settling_time_misses_says_so(tmp_path: Path) -> None:
    flight = flown(
        tmp_path, "cube", 5.0, base=np.array([0.1, 0.0, 0.0]), settle_time=50.0, time_limit=40.0
    )
    assert flight.outcome is Outcome.FAILED
    assert np.linalg.norm(flight.pose[-1][:3] - [0.1, 0.0, 0.0]) < 1e-3
    words = ", within tolerance for less than the settling time of 50 s."
    for sentence in (flight.message, flight.verdict.sentence):
        assert sentence.startswith("The goal is not reached in time: ")
        assert sentence.endswith(words)


# -- robots that come no nearer ---------------------------------------------------------------


def stalls(flight: Flight) -> tuple[float, ControllerStatus]:
    """Return time and status of the first stall; check the end of the flight."""
    found = [each for each in statuses(flight) if each[1].state is ControllerState.STALLED]
    assert {each.state.level for _, each in found} == {1}
    assert flight.outcome is Outcome.FAILED, flight.message
    cause = found[-1][1].message.removesuffix(".").partition("): ")[2]
    beginning = f"The goal is not reached in time, as {cause}: "
    assert flight.message.startswith(beginning)
    assert flight.verdict.sentence.startswith(beginning)
    if "at the joints" in flight.message:
        assert "at the joints" in flight.verdict.sentence
    return found[0]


@pytest.mark.parametrize("robot", ["planar_manipulator", "three_joint_arm"])
def test_a_hand_out_of_reach_is_stalled_with_its_cause(tmp_path: Path, robot: str) -> None:
    flight = flown(tmp_path, robot, 20.0, hand=np.array([2.0, 0.0, 0.0]), time_limit=100.0)
    time, _ = stalls(flight)
    assert time < 60.0
    last = [each for _, each in statuses(flight) if each.state is ControllerState.STALLED][-1]
    assert "the arm is stretched out or folded (singular)" in last.message


def test_a_base_takes_a_hand_without_a_goal_along(tmp_path: Path) -> None:
    """By more than the arm reaches: it keeps its shape."""
    away = np.array([-2.5, 0.0, 0.0])
    flight = flown(tmp_path, "planar_manipulator", 20.0, base=away, turn=np.zeros(3), time_limit=90)
    assert flight.outcome is Outcome.REACHED, flight.message
    shapes = flight.series["q"].values
    assert np.abs(shapes - shapes[0]).max() < 0.1


def test_a_robot_that_chatters_ends_with_its_cause(tmp_path: Path) -> None:
    """Gains far too high for a cube at 10 Hz: its torque flips at every tick."""
    gains: dict[str, Any] = {
        f"gains.{group}.{name}": value
        for group in ("base_position", "base_attitude")
        for name, value in (("kp", 30.0), ("kd", 60.0))
    }
    flight = flown(tmp_path, "cube", 10.0, profile="step", max_torque=2.0, **gains)
    assert turns_of_sign(flight.commands["base_wrench"].values) > 1000, "so the test is sharp"
    time, status = stalls(flight)
    assert time < 30.0
    assert status.message.endswith(": the base torque is at its limit.")
    assert len(flight.pose) / 10.0 == pytest.approx(300.0, abs=1.0), "the default limit"


def test_a_reference_that_takes_longer_extends_the_default_limit(tmp_path: Path) -> None:
    far = np.array([20.0, 0.0, 0.0])
    slow: dict[str, Any] = {"motion.speed": 0.1}
    flight = flown(tmp_path, "cube", 5.0, base=far, **slow)
    assert flight.outcome is Outcome.REACHED, flight.message
    assert len(flight.pose) / 5.0 > 300.0
