"""Plans keep clear of obstacles in the world; the distances are those of coal and of balls."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import coal
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import ParameterError, PlanningError, Proof, UnreachableError
from spacerobot_ros.flight.trials import PlanningProblem
from spacerobot_ros.model import RobotDescription, SpaceRobot
from spacerobot_ros.model.description import Array, Pose
from spacerobot_ros.model.urdf import load_world, parse_world
from spacerobot_ros.model.world import with_world
from spacerobot_ros.planning import GaitSchedule, RobotState, plan
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.scenario import load_scenario

QUICK: dict[str, Any] = {"answers": 1, "intervals": 40, "cache": 0}
STRUT = share_directory() / "config" / "worlds" / "strut.urdf"
RADIUS, LENGTH = 0.06, 0.8

ELSEWHERE = RobotState(
    np.array([0.4, -1.3, 0.7]), Rotation.from_rotvec([0.5, -0.3, 1.1]).as_quat(), np.zeros(3)
)
"""A start whose base is not at the origin of the world."""


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("three_joint_arm"))


def moved(world: RobotDescription, state: RobotState) -> RobotDescription:
    """Return a world that is, seen from the base in a state, as it was from the world's frame."""
    R = Rotation.from_quat(state.quaternion)
    roll_pitch_yaw, joints = R.as_euler("xyz"), ""
    for number, (name, (_, pose)) in enumerate(world.frames.items()):
        if number:
            xyz, rpy = _numbers(pose.r), _numbers(Rotation.from_matrix(pose.R).as_euler("xyz"))
            joints += f'<joint name="f{number}" type="fixed"><parent link="seen"/>'
            joints += f'<child link="{name}"/><origin xyz="{xyz}" rpy="{rpy}"/></joint>'
    joints += '<joint name="s" type="fixed"><parent link="w"/><child link="seen"/>'
    joints += f'<origin xyz="{_numbers(state.position)}" rpy="{_numbers(roll_pitch_yaw)}"/></joint>'
    links = f'<link name="strut">{CYLINDER}</link>'
    return parse_world(
        f'<robot name="m"><link name="w"/><link name="seen"/>{links}{joints}</robot>'
    )


CYLINDER = (
    f'<collision><geometry><cylinder radius="{RADIUS}" length="{LENGTH}"/></geometry></collision>'
)


def _numbers(values: Array) -> str:
    return " ".join(repr(float(x)) for x in values)


def distances_to(
    pose: Pose, obstacle: Any, robot: SpaceRobot, schedule: GaitSchedule, state: RobotState
) -> list[float]:
    """Return the distances (N + 1) of the nearest link to a solid at the ticks, m, by coal.

    The poses of the base are those at which the centre of mass rests.
    """
    attitudes = robot_attitudes(robot, schedule, state)
    r_WC = state.position + Rotation.from_quat(state.quaternion).apply(
        robot.center_of_mass(state.q)
    )
    there = coal.Transform3s(pose.R, pose.r)
    found = []
    for q, R_WB in zip(schedule.positions, attitudes, strict=True):
        r_WB = r_WC - R_WB.apply(robot.center_of_mass(q))
        R_all, r_all = (np.array(each) for each in robot.function("link_poses", compile=False)(q))
        least = np.inf
        for link in robot.description.links:
            k = robot.link_names.index(link.name)
            R_BL, r_BL = R_all[:, 3 * k : 3 * k + 3], r_all[:, k]
            for shape in link.collisions or link.shapes:
                made = {"box": coal.Box, "cylinder": coal.Cylinder, "sphere": coal.Sphere}
                solid = made[shape.kind](*shape.size)
                R = R_WB.as_matrix() @ R_BL @ shape.pose.R
                r = r_WB + R_WB.apply(R_BL @ shape.pose.r + r_BL)
                here, result = coal.Transform3s(R, r), coal.DistanceResult()
                request = coal.DistanceRequest()
                least = min(least, coal.distance(solid, here, obstacle, there, request, result))
        found.append(least)
    return found


def robot_attitudes(robot: SpaceRobot, schedule: GaitSchedule, state: RobotState) -> list[Rotation]:
    """Return the attitudes at the ticks, by steps of the connection."""
    R, found, parts = Rotation.from_quat(state.quaternion), [], 10
    for before, after in zip(schedule.positions, schedule.positions[1:], strict=False):
        found.append(R)
        step = (after - before) / parts
        for k in range(parts):
            middle = before + (k + 0.5) * step
            R = R * Rotation.from_rotvec(-robot.connection(middle)[3:] @ step)
    return [*found, R]


def ball_at(place: npt.ArrayLike, radius: float) -> RobotDescription:
    """Return a world with a ball at a place (3,)."""
    ball = f'<collision><geometry><sphere radius="{radius}"/></geometry></collision>'
    return parse_world(
        f'<robot name="w"><link name="w"/><link name="rock">{ball}</link>'
        '<joint name="j" type="fixed"><parent link="w"/><child link="rock"/>'
        f'<origin xyz="{_numbers(np.array(place))}"/></joint></robot>'
    )


@pytest.mark.slow
def test_optimal_goes_round_a_strut(arm: SpaceRobot) -> None:
    world = moved(load_world(STRUT), ELSEWHERE)
    goal = Rotation.from_quat(ELSEWHERE.quaternion) * Rotation.from_rotvec([0, 0, 0.4])
    wanted: dict[str, Any] = {"rotvec": goal.as_rotvec(), "start": ELSEWHERE, **QUICK}
    strut = world.frames["strut"][1], coal.Cylinder(RADIUS, LENGTH)
    plain = plan(arm, **wanted)
    assert min(distances_to(*strut, arm, plain, ELSEWHERE)) < -0.02
    clear = plan(arm, world=world, clearance=0.03, **wanted)
    assert min(distances_to(*strut, arm, clear, ELSEWHERE)) >= 0.03 - 1e-4
    assert clear.duration < 1.5 * plain.duration
    error = clear.notes["predicted_attitude_error"]
    assert isinstance(error, float)
    assert error < 1e-9


def test_optimal_goes_round_a_rock(arm: SpaceRobot) -> None:
    start = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    place, solid = np.array([1.8, -0.2, 0.1]), coal.Sphere(0.12)
    quick = {"rotvec": (0, 0, 0.2), **QUICK, "intervals": 20}
    rock = Pose(np.eye(3), place), solid
    plain = plan(arm, **quick)
    assert -0.06 < min(distances_to(*rock, arm, plain, start)) < 0
    clear = plan(arm, world=ball_at(place, 0.12), **quick)
    assert min(distances_to(*rock, arm, clear, start)) >= 0.01 - 1e-4


@pytest.mark.slow
def test_other_methods_refuse_with_link_obstacle_and_place(arm: SpaceRobot) -> None:
    world = ball_at((1.5, 0, 0.2), 0.2)
    # The shape round which loops are best; no other is looked for where one is given.
    nominal = (0.0, -0.1, 1.88)
    with pytest.raises(PlanningError, match=r"link 'link_3' and obstacle 'rock' .* near \[.*\] m"):
        plan(arm, rotvec=(0, 0, 0.2), world=world, method="area_loop", nominal=nominal)
    elsewhere = plan(arm, rotvec=(0, 0, 0.2), world=world, method="area_loop")
    start = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    rock = Pose(np.eye(3), np.array([1.5, 0, 0.2])), coal.Sphere(0.2)
    assert min(distances_to(*rock, arm, elsewhere, start)) >= 0.01 - 1e-4


def test_the_pose_of_a_goal_in_an_obstacle_is_refused_before_a_search(arm: SpaceRobot) -> None:
    goal, shape = Rotation.from_rotvec([0.5, -0.3, 1.0]), np.array([0.3, -0.4, 0.5])
    start = Rotation.from_quat(ELSEWHERE.quaternion)
    r_WC = ELSEWHERE.position + start.apply(arm.center_of_mass(ELSEWHERE.q))
    _, r_all = arm.function("link_poses", compile=False)(shape)
    hand = np.array(r_all)[:, arm.link_names.index("end_effector")]
    world = ball_at(r_WC + goal.apply(hand - arm.center_of_mass(shape)), 0.05)
    wanted: dict[str, Any] = {"rotvec": goal.as_rotvec(), "joint_positions": shape, **QUICK}
    with pytest.raises(UnreachableError, match="The pose of the goal is in collision") as caught:
        plan(arm, start=ELSEWHERE, world=world, **wanted)
    assert caught.value.proof is Proof.COLLISION


def test_a_clearance_of_zero_is_a_centimetre_among_obstacles(arm: SpaceRobot) -> None:
    described = with_world(arm.description, load_world(STRUT))
    assert Clearance.wanted(arm.description, 0.0) is None
    wanted = Clearance.wanted(described, 0.0)
    assert wanted is not None
    assert wanted.distance == 0.01
    given = Clearance.wanted(described, 0.2)
    assert given is not None
    assert given.distance == 0.2


def test_the_world_of_a_scenario_is_that_of_plant_and_planner(tmp_path: Path) -> None:
    scenario = load_scenario("strut")
    assert scenario.plant.world == scenario.planner.world == str(STRUT)
    world = PlanningProblem.of(scenario).robot.description.world
    assert world is not None
    assert world.name == "strut"
    text = scenario.path.read_text("utf-8")
    file = tmp_path / "mine.yaml"
    file.write_text(text.replace("worlds/strut.urdf", "none.urdf"), "utf-8")
    with pytest.raises(ParameterError, match=r"The world of the scenario file .* cannot be read"):
        load_scenario(str(file))
    file.write_text(text.replace("worlds/strut.urdf", str(robot_file("free_flyer"))), "utf-8")
    with pytest.raises(ParameterError, match='give it type="fixed"'):
        load_scenario(str(file))
