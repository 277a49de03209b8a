"""`spacerobot plan`: schedules and paths without ROS, compared, drawn, for many goals."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.command_line import Result, spacerobot
from support.flight_bags import urdf_of
from support.random_robots import random_robot_urdf

from spacerobot_ros import fly, load_scenario
from spacerobot_ros import plan as python_plan
from spacerobot_ros.cli.main import main
from spacerobot_ros.cli.robots import analysis_json, analysis_lines
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import METHODS
from spacerobot_ros.planning.analysis import analyze
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.resources import robot_file

URDF = Path(__file__).parents[2] / "urdf"
QUICK = ("--set", "planner.optimal.answers=1", "--set", "planner.optimal.intervals=30")


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


def plan(*arguments: str, code: int = 0) -> Result:
    return spacerobot("plan", *arguments, code=code)


def test_schedule_and_path_are_written_and_drawn(tmp_path: Path) -> None:
    target, picture = tmp_path / "a" / "plan.json", tmp_path / "b" / "plan.png"
    plan(
        *("planar_chain", "--goal-rotvec", "0", "0", "0.7", "--method", "optimal", *QUICK),
        *("--json", str(target), "--picture", str(picture)),
    )
    assert picture.read_bytes().startswith(b"\x89PNG")
    written = json.loads(target.read_text())
    assert written["method"] == "optimal"
    assert written["succeeded"] is True
    assert written["goal"] == pytest.approx([0, 0, 0, 0, 0, np.sin(0.35), np.cos(0.35)])
    assert written["attitude_error_rad"] < 1e-6
    assert written["final_attitude_rotvec_rad"] == pytest.approx([0, 0, 0.7], abs=1e-6)
    positions = np.array(written["schedule"]["positions"])
    # The scenario's start and final shape.
    np.testing.assert_allclose(positions[0], [np.pi, -np.pi])
    np.testing.assert_allclose(positions[-1], [0, 0], atol=1e-9)
    period = written["schedule"]["tick_period_s"]
    assert (len(positions) - 1) * period == pytest.approx(written["manoeuvre_time_s"])
    assert np.abs(np.diff(positions, axis=0)).max() <= 2.0 * period * (1 + 1e-9)
    last = Rotation.from_quat(written["path"]["quaternion"][-1])
    assert last.as_rotvec() == pytest.approx([0, 0, 0.7], abs=1e-6)
    assert written["path"]["time_s"][-1] == pytest.approx(written["manoeuvre_time_s"])


@pytest.mark.parametrize(
    ("words", "key", "text"),
    [
        (("plan", "planar_chain", "--method", "square_path"), "schedule", "planned in"),
        (("analyze", "sliding_masses"), "robot", "sliding_masses"),
    ],
)
def test_json_on_standard_output_is_alone_there(
    words: tuple[str, ...], key: str, text: str, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main([*words, "--json", "-"])
    out, err = capfd.readouterr()
    assert ended.value.code == 0, err
    assert key in json.loads(out)
    assert text in err
    assert not Path("-").exists()


def test_every_method_that_suits_is_compared() -> None:
    result = plan("planar_chain", "--compare", *QUICK)
    rows = {line.split()[0]: line.split() for line in result.output.splitlines() if line}
    assert float(rows["square_path"][1]) == pytest.approx(24.0)
    assert float(rows["optimal"][1]) < 6.0
    assert float(rows["optimal"][3]) < 1e-6
    # The base's position is left as it comes by both.
    assert rows["optimal"][4].startswith("(")
    assert "slider" in " ".join(rows["lie_bracket"])


def test_a_robot_by_its_file_needs_no_scenario() -> None:
    result = plan(
        *(str(URDF / "planar_chain.urdf"), "--goal-rotvec", "0", "0", "-0.2", *QUICK),
        *("--set", "plant.initial_joint_positions=[0.3, 0.2]"),
    )
    assert "optimal" in result.output or "auto" in result.output


def test_a_plan_is_flown_by_the_same_equations_without_a_compiler(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    target = tmp_path / "plan.json"
    arguments = ("planar_chain", "--method", "optimal", *QUICK, "--json", str(target))
    interpreted = plan(*arguments), json.loads(target.read_text())
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    enabled = plan(*arguments), json.loads(target.read_text())
    assert not list((tmp_path / "cache").glob("*.so"))
    for _, written in (interpreted, enabled):
        for at in ("plan_time_s", "notes"):
            del written[at]
    assert interpreted[1] == enabled[1]


@pytest.mark.parametrize("name", ["planar_chain", "faults/stuck_slider"])
def test_the_method_is_the_scenarios_in_plan_and_run_and_python(name: str, tmp_path: Path) -> None:
    """Their methods are square_path and lie_bracket, that of a robot alone is auto."""
    target = tmp_path / "plan.json"
    plan(name, "--json", str(target))
    written = json.loads(target.read_text())
    scenario = load_scenario(name)
    assert written["method"] == scenario.planner.method != PlannerConfig().method
    assert python_plan(scenario).method == written["method"]
    assert (
        fly(scenario.with_overrides("planner", {"max_corrections": 0})).method == written["method"]
    )


def test_the_method_of_a_robot_alone_is_chosen_in_plan_and_run_and_python(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chosen: list[str] = []

    def suitable(method: str, *_: Any, **__: Any) -> None:
        chosen.append(method)
        raise PlanningError("That is enough.")

    for module in ("flight.trials", "planning.api", "planning.execution.worker"):
        monkeypatch.setattr(f"spacerobot_ros.{module}.build_method", suitable)
    robot = URDF / "planar_chain.urdf"
    plan(str(robot), "--goal-rotvec", "0", "0", "-0.2", code=1)
    with pytest.raises(PlanningError, match="enough"):
        python_plan(robot, rotvec=(0, 0, -0.2))
    with pytest.raises(PlanningError, match="enough"):
        fly(robot, rotvec=(0, 0, -0.2))
    assert chosen == ["auto"] * 3


def test_many_goals_are_counted() -> None:
    words = ("--method", "optimal", "--beside", "square_path")
    result = plan("planar_chain", "--random", "2", *words, *QUICK)
    rows = {line.split()[0]: line.split() for line in result.output.splitlines()}
    assert rows["optimal"][1:5] == ["2", "2", "0", "0"]
    assert rows["square_path"][1:5] == ["2", "2", "0", "0"]
    assert float(rows["optimal"][6]) < float(rows["square_path"][6]) / 2


def analyzed(folder: Path, robot: str, *more: str) -> tuple[dict[str, Any], list[str], Path]:
    """Return the JSON, the printed lines and the picture of a robot."""
    picture, findings = folder / "sub" / "a.png", folder / "sub" / "a.json"
    result = spacerobot("analyze", robot, "--picture", picture, "--json", findings, *more)
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


def test_no_picture_is_drawn_of_joints_that_cannot_move(tmp_path: Path) -> None:
    """Exporters of URDFs write limits of 0 where none were given."""
    text = robot_file("three_joint_arm").read_text("utf-8")
    stiff = tmp_path / "stiff.urdf"
    stiff.write_text(re.sub(r'velocity="[^"]*"', 'velocity="0"', text))
    _, lines, picture = analyzed(tmp_path, str(stiff))
    assert not picture.exists()
    assert "picture      none: no loops of movable joints rotate the base" in lines
    assert any("has a velocity limit of 0, so it cannot move" in line for line in lines)


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


def test_limits_of_turning_joints_are_also_in_degrees() -> None:
    text = urdf_of(2).replace('upper="1.5"', 'upper="0.25"')
    robot = SpaceRobot.from_urdf(text.replace('velocity="0.8"', 'velocity="0.0123"'))
    lines = analysis_lines(analyze(robot))
    slides, turns = (next(x for x in lines if f"joint_{k}" in x) for k in (0, 1))
    assert "-1.5 .. 0.25 rad 0.0123 rad/s " in turns
    assert turns.endswith(" kg  -85.94 .. 14.32 deg  0.705 deg/s")
    assert slides.endswith(" 2 kg")


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


def test_a_robot_without_limits_and_without_an_end_effector(tmp_path: Path) -> None:
    found, lines, picture = analyzed(tmp_path, "planar_chain")
    assert found["mass_kg"] == pytest.approx(144.0)
    assert "144 kg, of which 120 kg for the base" in lines[0]
    assert [joint["name"] for joint in found["joints"]] == ["pin_1", "pin_2"]
    assert [joint["lower"] for joint in found["joints"]] == [None, None]
    assert found["workspaces"] == []
    assert "workspaces   none: no link is named 'end_effector': select one with" in "\n".join(lines)
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
