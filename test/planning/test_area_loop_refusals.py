"""What `area_loop` refuses, and the reason it gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.planners import Planner, planner_of

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import METHODS, Goal, PlanRequest, RobotState, Tolerance
from spacerobot_ros.planning.methods import area_loop
from spacerobot_ros.planning.methods.area_loop import EdgePath, edge_path
from spacerobot_ros.planning.methods.nominal_shape import NominalShape, NominalShapeChooser

Array = npt.NDArray[np.float64]

FOLDER = Path(__file__).parents[2] / "urdf"
NOMINAL = np.radians([0.0, -45.0, 90.0])
GOAL = Goal.checked([0, 0, 0], Rotation.from_rotvec([0.1, -0.2, 0.3]).as_quat())


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(FOLDER / "three_joint_arm.urdf")


def changed(*replacements: tuple[str, str]) -> SpaceRobot:
    """Return the three-joint arm with parts of its text replaced."""
    text = (FOLDER / "three_joint_arm.urdf").read_text()
    for old, new in replacements:
        assert old in text
        text = text.replace(old, new)
    return SpaceRobot.from_urdf(text)


def planner(robot: SpaceRobot, attitude: float = 1e-3, **options: Any) -> Planner:
    return planner_of("area_loop", robot, 0.25, Tolerance(1.0, attitude), 0.05, **options)


def at(q: npt.ArrayLike, **momenta: Array) -> RobotState:
    return RobotState(np.zeros(3), np.array([0, 0, 0, 1.0]), np.asarray(q, dtype=float), **momenta)


def test_two_joints_are_too_few() -> None:
    chain = SpaceRobot.from_file(FOLDER / "planar_chain.urdf")
    with pytest.raises(PlanningError, match=r"needs three joints .* 'planar_chain' has 2"):
        planner(chain).plan(at([1, 1]), GOAL)


def test_a_planar_robot_is_turned_about_one_axis_alone() -> None:
    flat = changed(('<axis xyz="0 0 1"/>', '<axis xyz="0 1 0"/>'))
    with pytest.raises(PlanningError, match="span 1 of the three axes"):
        planner(flat).plan(at([0, 0, 0]), GOAL)
    with pytest.raises(PlanningError, match="span 1 of the three axes"):
        METHODS["area_loop"].require_suitable(flat)


def test_a_singular_nominal_shape_is_named(arm: SpaceRobot) -> None:
    # The arm straight up along the yaw axis: yaw then moves no mass off its axis.
    straight = [0.0, -np.pi / 2, 0.0]
    with pytest.raises(PlanningError, match=r"singular at the nominal shape \[0.0, -1.5708, 0.0\]"):
        planner(arm, nominal=straight).plan(at(NOMINAL), GOAL)


def test_joints_that_do_not_move_are_no_choice() -> None:
    servo = 'lower="-2.8" upper="2.8" velocity="0.5"'
    stuck = changed((servo, 'lower="-2.8" upper="2.8" velocity="0"'))
    with pytest.raises(PlanningError, match=r"three joints that move; .* has 2 with a velocity"):
        planner(stuck).plan(at(NOMINAL), GOAL)


def test_limits_without_room_name_the_joint() -> None:
    narrow = changed(('lower="-2.8" upper="2.8"', 'lower="1.0" upper="1.00001"'))
    with pytest.raises(PlanningError, match="leave joint 'elbow_pitch' no room"):
        planner(narrow).plan(at([0, 0, 1]), GOAL)


@pytest.mark.parametrize("name", ["linear_momentum", "angular_momentum"])
def test_a_drifting_robot_is_refused(arm: SpaceRobot, name: str) -> None:
    with pytest.raises(PlanningError, match="total momentum is not zero"):
        planner(arm).plan(at(NOMINAL, **{name: np.array([0, 0, 0.1])}), GOAL)


def test_a_goal_that_takes_too_many_cycles_is_refused_at_once(arm: SpaceRobot) -> None:
    planner(arm, most_cycles=60).plan(at(NOMINAL), GOAL)
    with pytest.raises(PlanningError, match=r"takes about \d+\S* cycles, more than most_cycles"):
        planner(arm, most_cycles=20).plan(at(NOMINAL), GOAL)
    # Small loops, more of them.
    with pytest.raises(PlanningError, match="more than most_cycles"):
        planner(arm, most_cycles=60, largest_edge=0.05).plan(at(NOMINAL), GOAL)


def test_a_base_that_comes_no_nearer_is_given_up(arm: SpaceRobot) -> None:
    # A plant that does not turn at all: the same attitude is measured again and again.
    method, stuck = planner(arm, most_cycles=60), at(NOMINAL)
    needed = float(str(method.plan(stuck, GOAL).notes["expected_cycles"]))
    for _ in range(int(60 - needed)):
        method.plan(stuck, GOAL, correction=True)
    with pytest.raises(PlanningError, match=r"more than most_cycles = 60; \d+ are flown"):
        method.plan(stuck, GOAL, correction=True)
    # Another goal begins from nothing.
    again = Goal.checked(GOAL.position, GOAL.quaternion)
    assert method.plan(at(NOMINAL), again).partial


def test_no_tolerance_takes_for_ever(arm: SpaceRobot) -> None:
    with pytest.raises(PlanningError, match="about inf cycles"):
        planner(arm, 0.0).plan(at(NOMINAL), GOAL)


def test_a_manoeuvre_that_takes_too_long_is_refused_with_the_time(arm: SpaceRobot) -> None:
    with pytest.raises(PlanningError, match=r"cycles of \S+ s, more than longest = 600 s"):
        planner(arm, longest=600.0).plan(at(NOMINAL), GOAL)
    with pytest.raises(PlanningError, match="more than longest = 2 s; the slowest joint is"):
        planner(arm, longest=2.0).plan(at(NOMINAL + 1), GOAL)


@pytest.mark.parametrize(
    ("shape", "reason"),
    [([0.0, 0.0], r"has 2 joint position\(s\)"), ([0.0, 0.5, 0.0], "'shoulder_pitch' at 0.5 rad")],
)
def test_a_final_shape_that_is_none_is_refused(
    arm: SpaceRobot, shape: list[float], reason: str
) -> None:
    goal = Goal.checked(GOAL.position, GOAL.quaternion, shape)
    with pytest.raises(PlanningError, match=reason):
        planner(arm).plan(at(NOMINAL), goal)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"nominal": [0.0, 0.0]}, r"area_loop.nominal has 2 number\(s\)"),
        ({"nominal": [0.0, 1.0, 0.0]}, "'shoulder_pitch' at 1, and its limits"),
        ({"joints": "shoulder_yaw elbow_pitch"}, "must name three of the joints"),
        ({"joints": "shoulder_yaw elbow_pitch wrist"}, "must name three of the joints"),
        ({"joints": "elbow_pitch elbow_pitch shoulder_yaw"}, "must name three of the joints"),
    ],
)
def test_options_that_do_not_fit_the_robot(
    arm: SpaceRobot, options: dict[str, Any], reason: str
) -> None:
    with pytest.raises(ParameterError, match=reason):
        planner(arm, **options)


def test_loops_that_turn_the_wrong_way_are_given_up_however_small(
    arm: SpaceRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The method believes in the opposite of the true curvature."""
    method = METHODS["area_loop"](arm, 0.25, 0.05)
    choose = NominalShapeChooser.at

    def opposite(self: NominalShapeChooser, *args: Any) -> NominalShape:
        chosen = choose(self, *args)
        return replace(chosen, M=-chosen.M)

    tried: list[Array] = []

    def counted(areas: Array, longest: Array) -> EdgePath:
        tried.append(areas)
        assert len(tried) < 20, "it goes on for ever"
        return edge_path(areas, longest)

    monkeypatch.setattr(NominalShapeChooser, "at", opposite)
    monkeypatch.setattr(area_loop, "edge_path", counted)
    with pytest.raises(PlanningError, match=r"None of 6 cycles .* brings the base nearer"):
        method.plan(PlanRequest(at(NOMINAL), GOAL, Tolerance(1.0, 1e-3)))
