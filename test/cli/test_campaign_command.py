"""Every argument and option of `spacerobot campaign` reaches the campaign that is flown."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from support.campaigns import section
from support.command_line import CliRunner, Result

import spacerobot_ros.campaign.comparing as comparing
import spacerobot_ros.campaign.report as report
import spacerobot_ros.campaign.running as running
from spacerobot_ros.campaign.config import load_campaign
from spacerobot_ros.campaign.workers import Cluster
from spacerobot_ros.cli.main import main

GIVEN = {"flights": 11, "disperse": {"mass.*": {"uniform": [0.9, 1.1]}}}


class Campaigns:
    """Files of two campaigns, and what was asked of the functions that fly and report them."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.flown: list[Mapping[str, Any]] = []
        self.reported: list[tuple[Any, Path]] = []
        self.rerun: list[tuple[Path, int, Path]] = []
        for name in ("first", "second"):
            (folder / f"{name}.yaml").write_text(yaml.safe_dump({"campaign": section(**GIVEN)}))
        patch.chdir(folder)
        patch.setattr(running, "run_campaign", self._fly)
        patch.setattr(running, "rerun_flight", self._rerun)
        patch.setattr(report, "write_campaign_report", self._report)
        patch.setattr(comparing, "write_comparison", self._report)

    def _fly(self, campaign: Any, folder: Path, **named: Any) -> running.Progress:
        self.flown.append({"campaign": campaign, "folder": folder, **named})
        return running.Progress(
            flown=4, total=campaign.flights, flights_per_second=2.5, seconds=1.0
        )

    def _report(self, folder: Any, path: Path) -> list[str]:
        self.reported.append((folder, path))
        return ["success 75 %"]

    def _rerun(self, folder: Path, number: int, bag: Path) -> SimpleNamespace:
        self.rerun.append((folder, number, bag))
        return SimpleNamespace(report_lines=["rerun"], agrees=number != 9)

    def call(self, line: str) -> Result:
        return CliRunner().invoke(main, ["campaign", *line.split()])


@pytest.fixture
def campaigns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Campaigns:
    return Campaigns(tmp_path, monkeypatch)


def test_without_options(campaigns: Campaigns) -> None:
    result = campaigns.call("first.yaml")
    assert result.exit_code == 0, result.output
    (call,) = campaigns.flown
    assert (call["campaign"].flights, call["engine"]) == (11, "auto")
    assert call["cluster"] == Cluster(2, "")
    assert call["folder"] == Path("out/first")
    assert campaigns.reported == [(Path("out/first"), Path("out/first/report.html"))]
    assert "first: 4 of 11 flights, 2.5 a second; out/first" in result.output
    assert "success 75 %" in result.output
    drawn = [line for line in result.output.splitlines() if line.startswith("drawn ")]
    assert drawn == call["campaign"].description_lines


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


def test_every_option_reaches_the_campaign(campaigns: Campaigns) -> None:
    line = "fly first.yaml --flights 7 --engine flights --workers 3 --out there --report r.html"
    assert campaigns.call(line).exit_code == 0
    (call,) = campaigns.flown
    assert (call["campaign"].flights, call["engine"]) == (7, "flights")
    assert call["cluster"] == Cluster(3, "")
    assert call["folder"] == Path("there")
    assert campaigns.reported == [(Path("there"), Path("r.html"))]


def test_a_scheduler_takes_the_place_of_workers(campaigns: Campaigns) -> None:
    assert campaigns.call("first.yaml --workers 3 --scheduler tcp://[::1]:8786").exit_code == 0
    assert campaigns.flown[0]["cluster"] == Cluster(0, "tcp://[::1]:8786")


def test_two_designs_are_flown_with_the_same_options(campaigns: Campaigns) -> None:
    line = "fly --compare first.yaml second.yaml --flights 5 --engine lanes --workers 1"
    result = campaigns.call(f"{line} --out both --report c.html")
    assert result.exit_code == 0, result.output
    assert [call["campaign"].name for call in campaigns.flown] == ["first", "second"]
    folders = tuple(Path("both") / name for name in ("first", "second"))
    assert tuple(call["folder"] for call in campaigns.flown) == folders
    for call in campaigns.flown:
        assert (call["campaign"].flights, call["engine"]) == (5, "lanes")
        assert call["cluster"] == Cluster(1, "")
    assert campaigns.reported == [(folders, Path("c.html"))]


def test_a_report_is_written_again_where_it_is_wanted(campaigns: Campaigns) -> None:
    assert campaigns.call("report here --report other.html").exit_code == 0
    assert campaigns.call("report there").exit_code == 0
    expected = [(Path("here"), Path("other.html")), (Path("there"), Path("there/report.html"))]
    assert campaigns.reported == expected


def test_a_flight_is_flown_again_into_a_bag(campaigns: Campaigns) -> None:
    assert campaigns.call("rerun here 6 --bag other.mcap").exit_code == 0
    assert campaigns.call("rerun there 2").exit_code == 0
    result = campaigns.call("rerun there 9")
    assert result.exit_code == 1
    assert "is another one than that in the dataset" in result.output
    assert campaigns.rerun == [
        (Path("here"), 6, Path("other.mcap")),
        (Path("there"), 2, Path("there/flight_2.mcap")),
        (Path("there"), 9, Path("there/flight_9.mcap")),
    ]
