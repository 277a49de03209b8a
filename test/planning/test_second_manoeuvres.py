"""Manoeuvres after the first one: from a moved and turned base, in another shape."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from planning.flown import fly, plant_at
from scipy.spatial.transform import Rotation
from support.planner_loop import NEAR, Loop, MovingStub, Place, StubMethod, goal_at, robot_of
from support.planner_phases import OTHER, executing, quick_without_joints, stub_of, stuck, until
from support.planners import planner_of
from support.slow import some_fast

from spacerobot_ros.errors import UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import GaitSchedule, Goal, Tolerance
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Phase
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import VelocityPlant

Array = npt.NDArray[np.float64]

TICK = 0.05
TOLERANCE = Tolerance(2e-3, 2e-3, 1e-6)
SIXTH: Place = ([0.03, 0.05, -0.02], [0.0, 0.0, 0.0])


# -- methods ----------------------------------------------------------------------------------

OPTIONS: dict[str, tuple[str, dict[str, Any]]] = {
    "lie_bracket": ("sliding_masses", {"t1": 10.0, "n1": 1, "loop_area": 0.2}),
    "area_loop": ("three_joint_arm", {"k": 0.9, "cycles_per_plan": 4}),
    "square_path": ("planar_chain", {}),
    "optimal": ("planar_chain", {"starts": 3, "answers": 1}),
}


def mass_centre(plant: VelocityPlant, robot: SpaceRobot) -> Array:
    """Return where the centre of mass of the system is in the world, which no joint can change."""
    attitude = Rotation.from_quat(plant.pose[3:])
    return np.asarray(plant.pose[:3] + attitude.apply(robot.center_of_mass(plant.q)))


def goals_of(name: str, robot: SpaceRobot, start: VelocityPlant) -> list[Goal]:
    """Return two goals that the method reaches one after the other."""
    attitude = Rotation.from_quat(start.pose[3:])
    turns = [[0.0, 0.0, 0.4], [0.0, 0.0, -0.9]]
    if name in ("lie_bracket", "area_loop"):
        turns = [[0.05, -0.1, 0.08], [-0.12, 0.03, -0.06]]
    shapes = {
        "lie_bracket": [[0.4, -0.6, 0.2], [-0.3, 0.5, 0.7]],
        "area_loop": [[0.3, -0.5, 1.1], [-0.2, -0.9, 1.6]],
    }.get(name, [[0.5, -0.7], [-0.3, 1.1]])
    goals = []
    for turn, shape in zip(turns, shapes, strict=True):
        attitude = attitude * Rotation.from_rotvec(turn)
        c = attitude.apply(robot.center_of_mass(np.array(shape)))
        position = mass_centre(start, robot) - c
        final = None if name == "lie_bracket" else shape
        goals.append(Goal.checked(position, attitude.as_quat(), final))
    return goals


@pytest.mark.parametrize("name", OPTIONS)
def test_a_second_goal_is_reached_from_where_the_first_manoeuvre_ended(name: str) -> None:
    robot_name, options = OPTIONS[name]
    robot = robot_of(robot_name)
    q = {"lie_bracket": [0.3, -0.2, 0.5], "area_loop": [0.2, -0.6, 1.3]}.get(name, [0.9, -1.2])
    planar = robot_name == "planar_chain"
    turned = Rotation.from_rotvec([0.0, 0.0, 1.1] if planar else [0.4, -0.7, 1.1])
    plant = plant_at(robot, q, TICK, turned)
    method = planner_of(name, robot, TICK, TOLERANCE, TICK, **options)
    centre = mass_centre(plant, robot)
    for goal in goals_of(name, robot, plant):
        path = fly(method, plant, goal).pieces[-1].path
        np.testing.assert_allclose(path.position[-1], plant.pose[:3], atol=1e-6)
        np.testing.assert_allclose(path.quaternion[-1] @ plant.pose[3:], 1.0, atol=1e-6)
        left = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(goal.quaternion)
        assert left.magnitude() <= TOLERANCE.attitude + 1e-9
        assert np.linalg.norm(plant.pose[:3] - goal.position) <= 2 * TOLERANCE.position
        np.testing.assert_allclose(mass_centre(plant, robot), centre, atol=1e-6)
        if goal.joint_positions is not None:
            np.testing.assert_allclose(plant.q, goal.joint_positions, atol=1e-6)


# -- corrections ------------------------------------------------------------------------------


def test_corrections_of_one_goal_are_not_counted_for_the_next() -> None:
    """Every goal has all of its corrections, and its statuses count them from zero."""
    loop = Loop({"max_corrections": 2}, method=StubMethod(8))
    stub_of(loop).overshoot = 0.1
    for place in (NEAR, OTHER, SIXTH):
        before = len(loop.statuses)
        status = loop.decide(place)
        assert status.state is PlannerState.REACHED
        counted = [each.corrections for each in loop.statuses[before:]]
        assert counted[0] == 0
        assert counted[-1] == max(counted) > 0
    # Without any left the next one fails, though the ones before have used none of them.
    loop.set(max_corrections=0)
    assert loop.decide(NEAR).state is PlannerState.FAILED
    assert loop.statuses[-1].corrections == 0


def test_a_goal_that_takes_over_a_schedule_begins_with_no_correction() -> None:
    loop = Loop({"takeover_time": 0.3}, method=MovingStub(40))
    stub_of(loop).overshoot = 0.1
    loop.propose_goal(NEAR)
    while not loop.statuses or loop.statuses[-1].corrections == 0:
        loop.tick()
    assert loop.executive.phase is Phase.EXECUTING
    loop.propose_goal(NEAR)
    loop.tick()
    last = loop.statuses[-1]
    assert (last.goal_id, last.corrections) == ("goal-2", 0)
    # Another goal in motion: its plan takes over, and nothing of the first is counted for it.
    loop.propose_goal(OTHER)
    while (loop.statuses[-1].goal_id, loop.statuses[-1].state.value) != ("goal-3", "executing"):
        loop.tick()
    assert loop.statuses[-1].corrections == 0
    assert loop.statuses[-1].manoeuvre_time_s == pytest.approx(40 * TICK)


# -- stuck joints -----------------------------------------------------------------------------


def test_a_second_stuck_joint_is_planned_without_beside_the_first() -> None:
    """The third slider sticks after the first: both rest from then on, where they are measured."""
    loop = executing(held=True, ticks=400, stuck_ticks=5)
    quick_without_joints(loop)
    stuck(loop)
    first_at = loop.plant.q[0]
    until(loop, Phase.PLANNING)
    assert dict(loop.held.tasks[-1].stuck_joint_positions) == {"slider_1": first_at}
    loop.held.release()
    until(loop, Phase.EXECUTING)
    # Let the first go on a little: it slips, and is found where it is then.
    loop.plant.q[0] += 1e-4
    loop.plant.hold(np.array([True, False, True]))
    until(loop, Phase.PLANNING)
    q = loop.plant.q.copy()
    task = loop.held.tasks[-1]
    assert dict(task.stuck_joint_positions) == {"slider_1": q[0], "slider_3": q[2]}
    assert task.required == {"position"}
    loop.held.release()
    until(loop, Phase.EXECUTING)
    loop.tick(20)
    commands = np.array(loop.commands[-20:])
    assert not commands[:, [0, 2]].any()
    assert commands[:, 1].any()
    assert [n.split(":")[1] for n in loop.notices if n.startswith("Stuck")] == [
        " slider_1. The remaining motion is planned without.",
        " slider_1, slider_3. The remaining motion is planned without.",
    ]
    # The next goal is planned for with all joints again.
    loop.plant.hold(np.zeros(3, dtype=np.bool_))
    loop.propose_goal(OTHER)
    until(loop, Phase.PLANNING)
    assert not loop.held.tasks[-1].stuck_joint_positions
    assert not loop.held.tasks[-1].required
    loop.held.release()
    until(loop, Phase.EXECUTING)
    loop.tick(20)
    assert np.all(np.array(loop.commands[-20:]).any(axis=0))


# -- limits that differ -----------------------------------------------------------------------


LIMITS = (
    '<limit lower="-2.9" upper="1.3" velocity="0.7" effort="11"/>',
    '<limit lower="-0.8" upper="2.6" velocity="0.4" effort="5"/>',
)


def unequal(tmp_path: Path) -> SpaceRobot:
    """Return the chain with limits that differ by joint, side and kind."""
    urdf = (share_directory() / "urdf" / "planar_chain.urdf").read_text("utf-8")
    limits = iter(LIMITS)
    changed = re.sub(r"<limit [^>]*/>", lambda _: next(limits), urdf)
    path = tmp_path / "unequal.urdf"
    path.write_text(changed.replace('type="continuous"', 'type="revolute"'), "utf-8")
    return SpaceRobot.from_file(path)


@pytest.mark.parametrize(
    ("shape", "joint", "at", "limits"),
    [
        ([-2.95, 0.0], 0, "-2.95", "[-2.9, 1.3]"),
        ([1.35, 0.0], 0, "1.35", "[-2.9, 1.3]"),
        ([0.0, -0.85], 1, "-0.85", "[-0.8, 2.6]"),
        ([0.0, 2.65], 1, "2.65", "[-0.8, 2.6]"),
    ],
)
def test_a_goal_shape_is_held_against_the_limits_of_its_own_joint(
    shape: list[float], joint: int, at: str, limits: str, tmp_path: Path
) -> None:
    robot = unequal(tmp_path)
    method = planner_of("square_path", robot, TICK, TOLERANCE, TICK).method
    name = robot.joint_names[joint]
    with pytest.raises(UnreachableError, match="beyond limits") as refusal:
        method.goal_shape(replace(goal_at(NEAR), joint_positions=np.array(shape)))
    assert f"joint '{name}' at {at} rad, and its limits are {limits} rad" in str(refusal.value)
    within = np.array([-2.85, 2.55])
    found = method.goal_shape(replace(goal_at(NEAR), joint_positions=within))
    np.testing.assert_array_equal(found, within)


@pytest.mark.parametrize("name", some_fast(["square_path", "optimal"], "square_path"))
def test_every_joint_keeps_its_own_limits_in_both_directions(name: str, tmp_path: Path) -> None:
    robot = unequal(tmp_path)
    options: dict[str, Any] = {"starts": 3, "answers": 1, "cache": 0} if name == "optimal" else {}
    plant = plant_at(robot, [0.4, 0.3], TICK, Rotation.from_rotvec([0.0, 0.0, -0.8]))
    method = planner_of(name, robot, TICK, TOLERANCE, TICK, **options)
    fastest = np.zeros(2)

    def watch(schedule: GaitSchedule) -> None:
        nonlocal fastest
        assert np.all(schedule.positions >= robot.lower - 1e-9)
        assert np.all(schedule.positions <= robot.upper + 1e-9)
        fastest = np.maximum(fastest, np.abs(schedule.velocities).max(axis=0))

    for turn, shape in ((0.3, [-2.5, 2.2]), (-0.2, [1.1, -0.6])):
        attitude = Rotation.from_quat(plant.pose[3:]) * Rotation.from_rotvec([0.0, 0.0, turn])
        goal = Goal.checked(plant.pose[:3], attitude.as_quat(), shape)
        fly(method, plant, goal, watch=watch)
        np.testing.assert_allclose(plant.q, shape, atol=1e-6)
    assert np.all(fastest <= np.array([0.7, 0.4]) * (1 + 1e-9))
    if name == "optimal":
        assert np.all(fastest >= 0.95 * np.array([0.7, 0.4])), "each is as fast as it may be"


@pytest.mark.parametrize(
    ("parameter", "field"),
    [
        ("position_tolerance", "position"),
        ("attitude_tolerance", "attitude"),
        ("joint_tolerance", "shape"),
    ],
)
def test_each_tolerance_is_that_of_its_own_parameter(parameter: str, field: str) -> None:
    given: dict[str, Any] = {parameter: 0.0123}
    changed = PlannerConfig(**given).tolerance
    assert changed == replace(PlannerConfig().tolerance, **{field: 0.0123})
    assert getattr(changed, field) == 0.0123
