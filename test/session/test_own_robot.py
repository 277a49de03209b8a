"""What `spacerobot new` says of a robot's joints."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.command_line import CliRunner

from spacerobot_ros.cli.main import main
from spacerobot_ros.resources import robot_file

RATES = '<limit velocity="2" effort="100"/>'


@pytest.mark.parametrize(
    ("limit", "code", "said"),
    [
        ("", 1, "'pin_1' has no velocity limit, within which gaits are planned"),
        (RATES.replace("2", "60"), 0, "velocity limit. The same holds for 1 other joint."),
    ],
)
def test_joints_of_a_new_robot_are_remarked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, limit: str, code: int, said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    text = robot_file("planar_chain").read_text("utf-8")
    assert RATES in text
    Path("mine.urdf").write_text(text.replace(RATES, limit), "utf-8")
    result = CliRunner().invoke(main, ["new", "mine.urdf"])
    assert result.exit_code == code, result.output
    assert said in " ".join(result.output.split())
