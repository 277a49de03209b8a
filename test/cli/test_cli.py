"""The command line: exit codes, sentences, options."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.command_line import CliRunner, Result

from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.scenario import load_scenario, parse_setting, scenario_names

QUICK = [
    "--method",
    "lie_bracket",
    "--set",
    "planner.lie_bracket.t1=2",
    "--set",
    "planner.lie_bracket.cycles=0",
]


@pytest.fixture(autouse=True)
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    # The events executor asks for the file behind standard error, which a captured one lacks.
    monkeypatch.setattr("faulthandler.enable", lambda: None)


def spacerobot(*arguments: str) -> Result:
    return CliRunner().invoke(main, list(arguments))


def test_run_reaches_its_goal(tmp_path: Path) -> None:
    bag, summary = tmp_path / "a.mcap", tmp_path / "a.json"
    result = spacerobot(
        *("run", "sliding_masses", "--goal", "-1e-2", "0", "0", "0", "0", "0", "2"),
        *("--bag", str(bag), "--json", str(summary), *QUICK),
    )
    assert result.exit_code == 0, result.output
    assert bag.is_file()
    written = json.loads(summary.read_text())
    assert written["goal"] == [-0.01, 0, 0, 0, 0, 0, 1]
    assert written["succeeded"] is True
    assert written["manoeuvre_time_s"] == 2.0
    assert len(result.output.splitlines()) < 24


def test_goal_rotvec_replaces_the_attitude_alone(tmp_path: Path) -> None:
    summary = tmp_path / "a.json"
    result = spacerobot(
        *("run", "sliding_masses", "--goal", "0", "0", "0", "0", "0", "0", "1"),
        *("--goal-rotvec", "0", "0", "-0.02", "--bag", str(tmp_path / "a.mcap")),
        *("--json", str(summary), "--set", "planner.attitude_tolerance=1e-3", *QUICK),
    )
    assert result.exit_code == 0, result.output
    written = json.loads(summary.read_text())
    assert written["goal"][:3] == [0, 0, 0]
    assert written["final_attitude_rotvec_rad"] == pytest.approx([0, 0, -0.02], abs=1e-3)


def test_goal_out_of_reach_is_exit_1(tmp_path: Path) -> None:
    result = spacerobot(
        *("run", "sliding_masses", "--goal", "9", "0", "0", "0", "0", "0", "1"),
        *("--bag", str(tmp_path / "a.mcap")),
    )
    assert result.exit_code == 1
    assert "out of reach" in result.output


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["nowhere"], "There is no scenario 'nowhere'"),
        (["sliding_masses", "--goal", "nan", *"000001"], "is not finite"),
        (["sliding_masses", "--goal", *"0000000"], "zero quaternion"),
        (["sliding_masses", "--goal-rotvec", "inf", "0", "0"], "is not three finite numbers"),
        (["sliding_masses", "--set", "plant.tick_rate=fast"], "'tick_rate' is 'fast'"),
        (["sliding_masses", "--set", "tick_rate=1"], "is not node.parameter=value"),
        (["sliding_masses", "--set", "plant.nothing=1"], "no parameter 'nothing'"),
        (["sliding_masses", "--set", "plant.robot=x.urdf"], "no such URDF file"),
        (["sliding_masses", "--bag", "/dev/full"], "/dev/full: it is a device"),
    ],
)
def test_bad_input_is_exit_2_and_one_sentence(
    arguments: list[str], sentence: str, tmp_path: Path
) -> None:
    if "--bag" not in arguments:
        arguments = [*arguments, "--bag", str(tmp_path / "a.mcap")]
    result = spacerobot("run", *arguments)
    assert result.exit_code == 2, result.output
    assert sentence in result.output
    assert len(result.output.strip().splitlines()) == 1


def test_broken_scenario_file_is_named(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("plant: [")
    result = spacerobot("run", str(path))
    assert result.exit_code == 2
    assert "mine.yaml cannot be read" in result.output
    path.write_text("plant: {ros__parameters: {}}")
    assert "has no 'scenario" in spacerobot("run", str(path)).output
    path.write_text("scenario: {ros__parameters: {goal_positon: [0, 0, 0]}}")
    assert "unknown key 'goal_positon'" in spacerobot("run", str(path)).output
    path.write_text("scenario: {ros__parameters: {goal_position: [0, 0]}}")
    assert "is refused" in spacerobot("run", str(path)).output


@pytest.mark.slow
def test_own_robot_in_an_own_scenario(tmp_path: Path) -> None:
    """Another robot is a URDF and a parameter file, nothing else."""
    urdf = (
        load_scenario("sliding_masses").path.parent.parent / "urdf/sliding_masses.urdf"
    ).read_text()
    (tmp_path / "mine.urdf").write_text(urdf.replace('value="10"', 'value="5"'))
    (tmp_path / "mine.yaml").write_text(
        f"""
scenario: {{ros__parameters: {{goal_position: [0.1, 0.0, 0.05]}}}}
plant: {{ros__parameters: {{robot: {tmp_path}/mine.urdf, tick_rate: 10}}}}
planner:
  ros__parameters: {{robot: {tmp_path}/mine.urdf, tick_rate: 10, lie_bracket.t1: 4}}
"""
    )
    result = spacerobot("run", str(tmp_path / "mine.yaml"), "--bag", str(tmp_path / "a.mcap"))
    assert result.exit_code == 0, result.output


def test_scenarios_are_listed() -> None:
    output = spacerobot("scenarios").output
    assert all(name in output for name in scenario_names())
    assert "sliding_masses" in output


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("plant.tick_rate=20", 20),
        ("plant.tick_rate=1e-3", 0.001),
        ("plant.initial_position=[1, 2.5, 0]", [1, 2.5, 0]),
        ("planner.method=lie_bracket", "lie_bracket"),
        ("plant.autostart=false", False),
    ],
)
def test_settings(text: str, value: object) -> None:
    node, _, rest = text.partition(".")
    assert parse_setting(text) == (node, rest.partition("=")[0], value)


@pytest.mark.parametrize("text", ["", "plant", "plant.=1", "moon.x=1", "plant.x", "plant.x=["])
def test_bad_settings(text: str) -> None:
    with pytest.raises(ParameterError):
        parse_setting(text)
