"""Every argument and option of `spacerobot campaign` reaches the campaign that is flown."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from support.campaigns import section
from support.command_line import CliRunner, Result

from spacerobot_ros.bag import read_bag
from spacerobot_ros.campaign.config import load_campaign
from spacerobot_ros.campaign.dataset import Dataset
from spacerobot_ros.cli.main import main

GIVEN = {"flights": 11, "disperse": {"mass.*": {"uniform": [0.9, 1.1]}}}


def test_options_of_a_campaign_its_report_and_its_flights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("first", "second"):
        given = {"campaign": section(**{**GIVEN, "flights": 4})}
        Path(f"{name}.yaml").write_text(yaml.safe_dump(given))

    def call(line: str) -> Result:
        result = CliRunner().invoke(main, ["campaign", *line.split()])
        assert result.exit_code == 0, result.output
        return result

    words = "--flights 2 --engine flights --workers 0"
    said = call(f"fly first.yaml {words} --out there --report r.html").output
    assert "first: 2 of 2 flights" in said
    table = Dataset(Path("there")).table()
    assert table["engine"].to_pylist() == ["flights"] * 2
    assert Path("r.html").is_file()
    call("report there --report other.html")
    assert Path("other.html").read_bytes() == Path("r.html").read_bytes()
    call("report there")
    assert Path("there/report.html").is_file()
    call("rerun there 1 --bag other.mcap")
    call("rerun there 0")
    assert read_bag("other.mcap").message_count("/odom") > 1
    assert Path("there/flight_0.mcap").is_file()
    call(f"fly --compare first.yaml second.yaml {words} --out both --report c.html")
    assert Path("c.html").is_file()
    for name in ("first", "second"):
        assert len(Dataset(Path("both", name)).table()) == 2
    call("first.yaml --flights 1 --workers 0")
    assert Path("out/first/report.html").is_file()


def test_a_campaign_of_errors_or_refused_goals_alone_fails(tmp_path: Path) -> None:
    """As the flight of one draw by `run` does: here starts and goals beyond the strokes."""
    start, goal = "plant.initial_joint_positions[0]", "goal.position.x"
    for name, beyond, code in ((start, 5.0, 1), (start, 0.0, 0), (goal, 9.0, 1)):
        values = {name: {"uniform": [beyond, beyond + 0.1]}}
        file = tmp_path / f"{name}_{beyond}.yaml"
        given = {"campaign": section(disperse=values, flights=2)}
        file.write_text(yaml.safe_dump(given), "utf-8")
        words = ["campaign", str(file), "--workers", "0", "--out", str(tmp_path / file.stem)]
        for _ in ("flown", "nothing left to fly"):
            result = CliRunner().invoke(main, words)
            assert result.exit_code == code, result.output
            assert ("None of the 2 draws could be flown" in result.output) == bool(code)


def test_the_range_of_what_is_drawn_is_said(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    disperse = {"mass.*": {"uniform": [0.95, 1.05]}, "goal.position.x": {"uniform": [-0.01, 0.01]}}
    file.write_text(yaml.safe_dump({"campaign": section(**{**GIVEN, "disperse": disperse})}))
    lines = sorted(load_campaign(file).description_lines, reverse=True)
    assert lines[0].endswith(" more: 0.951 to 1.049 in 98 % of the flights")
    assert lines[1:] == ["drawn       goal.position.x: -0.0098 to 0.0098 m in 98 % of the flights"]
