"""`spacerobot new`: from a URDF to a scenario that reaches its goal, and what it remarks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.command_line import CliRunner
from support.oracles import PinocchioOracle

from spacerobot_ros.cli.main import main
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.description import JointLimits
from spacerobot_ros.planning.methods.optimal.goal_specification import Turning
from spacerobot_ros.resources import resource_names, robot_file
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.own_robot import first_shape, first_turn, urdf_remarks
from spacerobot_ros.simulation.trials import try_method


@pytest.fixture
def robot(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a robot of the user's own in the current folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    path = tmp_path / "mine.urdf"
    path.write_text(robot_file("planar_chain").read_text("utf-8"), "utf-8")
    return path


def test_a_new_robot_gets_a_scenario_that_reaches_its_goal(robot: Path) -> None:
    result = CliRunner().invoke(main, ["new", robot.name])
    assert result.exit_code == 0, result.output
    assert result.output.splitlines()[-1] == "  spacerobot run mine.yaml"
    scenario = load_scenario("mine.yaml")
    problem = scenario.problem()
    turned = Rotation.from_quat(problem.goal.quaternion).as_rotvec()
    assert np.degrees(np.linalg.norm(turned)) == pytest.approx(5.0)
    assert try_method(problem, scenario.planner.method).reached
    assert scenario.parameters("plant")["robot"] == str(robot)


def test_the_scenario_stands_where_it_is_wanted_and_finds_its_robot(robot: Path) -> None:
    out = robot.parent / "scenarios" / "turn.yaml"
    out.parent.mkdir()
    result = CliRunner().invoke(main, ["new", robot.name, "--out", str(out)])
    assert result.exit_code == 0, result.output
    assert load_scenario(str(out)).parameters("plant")["robot"] == str(robot)
    assert not (robot.parent / "mine.yaml").exists()


def test_no_scenario_is_overwritten(robot: Path) -> None:
    Path("mine.yaml").write_text("of the user", "utf-8")
    result = CliRunner().invoke(main, ["new", str(robot), "--out", "mine.yaml"])
    assert result.exit_code == 0, result.output
    assert Path("mine.yaml").read_text("utf-8") == "of the user"
    assert load_scenario("mine-1.yaml").problem().robot.n == 2


def test_a_robot_that_cannot_turn_its_base_is_told_so(robot: Path) -> None:
    text = robot.read_text("utf-8").replace('type="revolute"', 'type="fixed"')
    text = text.replace('type="continuous"', 'type="fixed"')
    robot.write_text(text, "utf-8")
    result = CliRunner().invoke(main, ["new", str(robot)])
    assert result.exit_code == 1, result.output
    assert "turn its base not at all" in result.output
    assert not Path("mine.yaml").exists()


def test_robots_are_listed_with_their_joints_and_masses() -> None:
    result = CliRunner().invoke(main, ["robots"])
    assert result.exit_code == 0, result.output
    rows = {line.split()[0]: line.split()[1:] for line in result.output.splitlines()[1:]}
    assert sorted(rows) == resource_names("urdf", ".urdf")
    assert rows["servicer"] == ["6", "453", "kg", "400", "kg"]


def limited(limits: JointLimits) -> SpaceRobot:
    """Return the planar chain with these limits of its first joint."""
    description = load_robot(robot_file("planar_chain"))
    first, *others = description.joints
    changed = (replace(first, limits=limits), *others)
    return SpaceRobot(description._with_tree(description.links, changed))


@pytest.mark.parametrize(
    ("lower", "upper", "first"),
    [(-2.0, 2.0, 0.0), (-1.0, 1.9, 0.0), (-3.0, -1.0, -2.0), (0.0, 2.0, 1.0), (-0.1, 2.0, 0.95)],
)
def test_the_first_shape_has_room_to_all_sides(lower: float, upper: float, first: float) -> None:
    shape = first_shape(limited(JointLimits(lower, upper, 1.0, 1.0)))
    assert shape[0] == pytest.approx(first)


@pytest.mark.parametrize("name", ["free_flyer", "surveyor", "planar_chain", "sliding_masses"])
def test_the_first_turn_is_one_that_the_joints_make_without_loops(name: str) -> None:
    """The shape goes straight somewhere within its room; Pinocchio integrates the turn."""
    path = robot_file(name)
    robot = SpaceRobot.from_file(path)
    shape = first_shape(robot)
    turn = first_turn(robot, shape, Turning.of(robot).axes)
    if name == "sliding_masses":  # Only loops turn it.
        assert turn == pytest.approx(np.radians([0.0, 0.0, 5.0]))
        return
    assert np.radians(0.2) <= np.linalg.norm(turn) <= np.radians(5.0) + 1e-12
    oracle = PinocchioOracle(path.read_text("utf-8"), robot.joint_names)
    F = np.column_stack([oracle.base_twist(shape, e)[3:] for e in np.eye(robot.n)])
    room = np.minimum(np.minimum(robot.upper - shape, shape - robot.lower), 1.0)
    way = room * (np.linalg.pinv(F * room, rcond=1e-6) @ turn)
    assert np.all(np.abs(way) <= 0.6 * room)
    end = Rotation.identity()
    for part in (np.arange(20) + 0.5) / 20:
        end = end * Rotation.from_rotvec(oracle.base_twist(shape + part * way, way / 20)[3:])
    off = (end.inv() * Rotation.from_rotvec(turn)).magnitude()
    assert off < 0.25 * np.linalg.norm(turn)


@pytest.mark.parametrize(
    ("before", "after", "remark"),
    [
        ('velocity="2"', 'velocity="0"', "velocity limit 0"),
        ('velocity="2"', 'velocity="90"', "check the unit of its velocity limit"),
        ('effort="', 'effort="0" was="', "effort limit 0"),
        ("<robot ", "<robot ", "No link is called 'end_effector'"),
    ],
)
def test_what_to_mind_is_remarked(before: str, after: str, remark: str) -> None:
    text = robot_file("planar_chain").read_text("utf-8")
    assert before in text
    assert any(remark in each for each in urdf_remarks(parse_robot(text.replace(before, after))))


def test_limits_in_degrees_are_remarked() -> None:
    text = robot_file("surveyor").read_text("utf-8").replace('lower="-2.9"', 'lower="-166"')
    found = [each for each in urdf_remarks(parse_robot(text)) if "not in degrees" in each]
    assert len(found) == 1
    assert "'shoulder_yaw' turns from -166 to 2.9 rad" in found[0]


def test_columns_of_the_list_of_robots_are_apart() -> None:
    lines = CliRunner().invoke(main, ["robots"]).output.splitlines()
    assert lines[0].split() == ["robot", "joints", "mass", "base"]
    for line in lines[1:]:
        name, joints, mass, first, base, second = line.split()
        assert (first, second) == ("kg", "kg"), name
        assert int(joints) > 0
        assert float(mass) > float(base) > 0
    assert len({len(line) for line in lines}) == 1
