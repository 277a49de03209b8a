"""`run` and `plan` end with the same code for the same goal: 1 out of reach, 2 bad input."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from support.command_line import CliRunner

from spacerobot_ros.cli.main import main
from spacerobot_ros.scenario import load_scenario

SLIDING = ("sliding_masses", "--method", "lie_bracket")


@pytest.fixture(autouse=True)
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    # The events executor asks for the file behind standard error, which a captured one lacks.
    monkeypatch.setattr("faulthandler.enable", lambda: None)


@pytest.mark.parametrize("command", ["run", "plan"])
@pytest.mark.parametrize(
    ("words", "code"),
    [
        ((*SLIDING, "--goal", *"9000001"), 1),
        ((*SLIDING, "--goal", *"0000000"), 2),
        ((*SLIDING, "--goal", "nan", *"000001"), 2),
        ((*SLIDING, "--goal-rotvec", "inf", "0", "0"), 2),
        (("sliding_masses", "--method", "magic"), 2),
        (("sliding_masses", "--set", "planner.method=magic"), 2),
        ((*SLIDING, "--set", "planner.lie_bracket.t2=1"), 2),
        ((*SLIDING, "--set", "planner.tick_rte=1"), 2),
        ((*SLIDING, "--set", "planner.lie_bracket.t1=soon"), 2),
        ((*SLIDING, "--set", "moon.phase=1"), 2),
        ((*SLIDING, "--set", "plant.initial_joint_positions=[1, 2]"), 2),
        (("arm_attitude", "--method", "lie_bracket"), 1),
    ],
)
def test_the_same_code_by_both(
    command: str, words: tuple[str, ...], code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(main, [command, *words])
    assert result.exit_code == code, result.output
    assert "Traceback" not in result.output


@pytest.mark.parametrize("command", ["run", "plan"])
@pytest.mark.parametrize(
    ("section", "values", "sentence"),
    [
        ("scenario", {"goal_joint_positions": [0.1, 0.2]}, "The goal shape has 2 joint position"),
        ("planner", {"tick_rte": 20.0}, "Node 'planner' has no parameter 'tick_rte'"),
        ("planner", {"lie_bracket": {"t2": 1.0}}, "no parameter 'lie_bracket.t2'"),
        ("plant", {"tick_rate": "fast"}, "Parameter 'tick_rate' is 'fast'"),
    ],
)
def test_what_a_file_has_wrong_is_bad_input(
    command: str,
    section: str,
    values: dict[str, object],
    sentence: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    content = yaml.safe_load(load_scenario("sliding_masses").path.read_text("utf-8"))
    key = section if section == "scenario" else f"/**/{section}"
    content[key]["ros__parameters"] |= values
    Path("mine.yaml").write_text(yaml.safe_dump(content), "utf-8")
    result = CliRunner().invoke(main, [command, "mine.yaml"])
    assert result.exit_code == 2, result.output
    assert sentence in result.output
    assert len(result.output.strip().splitlines()) == 1
