"""`spacerobot analyze`: what it says, writes and draws."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import CliRunner, Result
from support.random_robots import random_robot_urdf

from spacerobot_ros.cli.main import main
from spacerobot_ros.cli.robots import (
    _degree_warnings,
    _joint_rows,
    analysis_json,
    analysis_lines,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import METHODS
from spacerobot_ros.planning.analysis import analyze
from spacerobot_ros.resources import robot_file


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


def spacerobot(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def analyzed(folder: Path, robot: str, *more: str) -> tuple[dict[str, Any], list[str], Path]:
    """Return the JSON, the printed lines and the picture of a robot."""
    picture, findings = folder / "sub" / "a.png", folder / "sub" / "a.json"
    result = spacerobot("analyze", robot, "--picture", str(picture), "--json", str(findings), *more)
    assert result.exit_code == 0, result.output
    # Not a number and infinity are no JSON.
    content = json.loads(findings.read_text(), parse_constant=pytest.fail)
    return content, result.output.splitlines(), picture


@pytest.mark.parametrize(
    ("robot", "suits", "rank", "first"),
    [
        ("sliding_masses", {"lie_bracket", "area_loop"}, 3, "optimal"),
        pytest.param("three_joint_arm", {"area_loop"}, 3, "optimal", marks=pytest.mark.slow),
        ("planar_chain", {"square_path"}, 1, "optimal"),
    ],
)
def test_the_robots_of_the_papers(
    tmp_path: Path, robot: str, suits: set[str], rank: int, first: str
) -> None:
    found, lines, picture = analyzed(tmp_path, robot)
    assert len(lines) <= 35
    methods = found["methods"]
    assert {*methods, "auto"} == set(METHODS)
    paper_methods = {"lie_bracket", "square_path", "area_loop"}
    assert {name for name in paper_methods if methods[name] is None} == suits
    assert found["anywhere"]["rank"] == rank
    assert found["auto"] == first
    assert any(line.split() == ["auto", first] for line in lines)
    for name in paper_methods - suits:
        assert any(line.startswith(name) and methods[name] in line for line in lines)
    content = picture.read_bytes()
    assert content.startswith(b"\x89PNG")
    assert len(content) > 20_000


@pytest.mark.slow
def test_the_papers_nominal_shape() -> None:
    shape = [0.0, -math.pi / 4, math.pi / 2]
    findings = analyze(SpaceRobot.from_file(robot_file("three_joint_arm")), shape)
    found = analysis_json(findings)
    M = np.array(found["curvature_matrix"])
    assert np.linalg.cond(M) == pytest.approx(3.60, abs=5e-3)
    assert found["at_shape"]["condition"] == pytest.approx(3.60, abs=5e-3)
    assert found["shape"] == shape
    assert any("condition 3.6" in line for line in analysis_lines(findings))


def jointed(*limits: str) -> SpaceRobot:
    """Return a robot with a revolute joint for each text of limits, and a slider."""
    body = '<link name="{}"><inertial><mass value="2"/><inertia ixx="1" iyy="1" izz="1" '
    body += 'ixy="0" ixz="0" iyz="0"/></inertial></link>'
    names = ["base", *(f"link_{i}" for i in range(len(limits) + 1))]
    kinds = [*("revolute" for _ in limits), "prismatic"]
    joints = [
        f'<joint name="joint_{i}" type="{kind}"><parent link="{names[i]}"/>'
        f'<child link="{names[i + 1]}"/><axis xyz="0 0 1"/><limit {limit}/></joint>'
        for i, (kind, limit) in enumerate(
            zip(kinds, [*limits, 'lower="-90" upper="90" velocity="30" effort="4"'], strict=True)
        )
    ]
    links = "".join(body.format(name) for name in names)
    return SpaceRobot.from_urdf(f'<robot name="odd">{links}{"".join(joints)}</robot>')


def test_limits_of_turning_joints_are_also_in_degrees() -> None:
    robot = jointed('lower="-1.5" upper="0.25" velocity="0.5" effort="3"')
    turns, slides = _joint_rows(robot)[1:]
    assert "-1.5 .. 0.25 rad" in turns
    assert turns.endswith(" kg  -85.94 .. 14.32 deg  28.6 deg/s")
    assert slides.endswith(" 2 kg")
    assert _degree_warnings(robot.description) == []


def test_limits_that_look_like_degrees_are_pointed_out() -> None:
    robot = jointed(
        'lower="-1" upper="90" velocity="0.5" effort="3"',
        'lower="-19" upper="19.9" velocity="0.5" effort="3"',
        'lower="-20.1" upper="1" velocity="0.5" effort="3"',
    )
    assert _degree_warnings(robot.description) == [
        "warning: the limits of 'joint_0', 'joint_2' are beyond 20 rad, several turns. Those of a "
        "URDF are in radians: if these are degrees, divide them by 57.2958."
    ]
    fast = jointed(
        'lower="-1" upper="1" velocity="30" effort="3"',
        'lower="-1" upper="1" velocity="24" effort="3"',
    )
    (warning,) = _degree_warnings(fast.description)
    assert warning.startswith("warning: the speed of 'joint_0' is beyond 25 rad/s, some four turns")
    # Reaction wheels turn faster.
    assert _degree_warnings(SpaceRobot.from_file(robot_file("tender")).description) == []


def test_masses_and_limits_are_those_of_the_urdf() -> None:
    findings = analyze(SpaceRobot.from_file(robot_file("planar_chain")))
    found = analysis_json(findings)
    assert found["mass_kg"] == pytest.approx(144.0)
    assert [joint["name"] for joint in found["joints"]] == ["pin_1", "pin_2"]
    # A joint without limits has none.
    assert [joint["lower"] for joint in found["joints"]] == [None, None]
    assert "144 kg, of which the base 120 kg" in analysis_lines(findings)[0]


@pytest.mark.slow
def test_the_workspaces_of_paper_4(tmp_path: Path) -> None:
    found, lines, picture = analyzed(tmp_path, "planar_manipulator")
    free, limited = found["workspaces"]
    assert (free["within_limits"], limited["within_limits"]) == (False, True)
    # Computed independently of this program, from the paper's Table I.
    for kind, ends in (
        ("path_dependent_m", [[0.35106, 0.55368], [1.43617, 2.28723]]),
        ("path_independent_m", [[0.0, 0.35106], [0.55368, 1.43617]]),
    ):
        np.testing.assert_allclose(free[kind], ends, rtol=0, atol=6e-6)
    text = "\n".join(lines)
    assert "path-dependent    0.35106 to 0.55368 and 1.43617 to 2.28723 m" in text
    assert "path-independent  0 to 0.35106 and 0.55368 to 1.43617 m" in text
    drawn = picture.with_name("a_workspaces.png")
    assert lines[-1].split() == [str(drawn)]
    assert len(drawn.read_bytes()) > 20_000


def test_workspaces_need_a_link(tmp_path: Path) -> None:
    found, lines, picture = analyzed(tmp_path, "planar_chain")
    assert found["workspaces"] == []
    assert "workspaces   none: no link is called 'end_effector': name one with" in "\n".join(lines)
    assert not picture.with_name("a_workspaces.png").exists()


def test_the_workspaces_of_a_named_link(tmp_path: Path) -> None:
    named, lines, _ = analyzed(tmp_path, "planar_chain", "--end-effector", "segment_2")
    (only,) = named["workspaces"]  # Its joints have no limits.
    assert only["link"] == "segment_2"
    assert "'segment_2', joints turn freely: " in "\n".join(lines)


def test_a_robot_whose_loops_turn_nothing_has_no_picture(tmp_path: Path) -> None:
    urdf = tmp_path / "one.urdf"
    urdf.write_text(random_robot_urdf(np.random.default_rng(7), 1))
    found, lines, picture = analyzed(tmp_path, str(urdf))
    assert found["anywhere"]["rank"] == 0
    assert found["curvature_matrix"] is None
    assert not picture.exists()
    assert lines[-1].startswith("picture      none")
    assert any(line.startswith("workspaces   none: ") for line in lines)


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nobody"], "There is no robot 'nobody'"),
        (["nobody.urdf"], "no such URDF file"),
        (["three_joint_arm", "--shape", "0 1"], "The shape has 2 number(s)"),
        (["three_joint_arm", "--shape", "0 1 nan"], "The shape has 3 number(s)"),
        (["three_joint_arm", "--shape", "0 1 two"], "it must be one number for each joint"),
        (["planar_chain", "--end-effector", "hand"], "has no link 'hand' besides its base; its "),
        (["planar_chain", "--end-effector", "base_link"], "has no link 'base_link' besides"),
    ],
)
def test_what_is_refused_with_a_sentence(arguments: list[str], sentence: str) -> None:
    result = spacerobot("analyze", *arguments)
    assert result.exit_code == 2
    assert sentence in result.output
    assert len(result.output.splitlines()) == 1
