"""Findings of `analyze`, plans and flights as lines, from results made by hand."""

from __future__ import annotations

import pytest
from support.command_line import CliRunner

from spacerobot_ros.cli.main import main

# -- flights --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ["run", "sliding_masses", "--view"],
            "--view needs --realtime: a flight in lockstep is over soon.",
        ),
        (
            ["goal", "1", "2", "3", "--goal-rotvec", *"001", "--goal-rpy-deg", *"001"],
            "The attitude is given twice, in radians and in degrees.",
        ),
        (
            ["goal", "--goal-rotvec", *"001", "--end-effector-position", *"123"],
            "An attitude of the base is sent with its position X Y Z.",
        ),
        (["goal", "1", "2"], "A goal is X Y Z, or X Y Z QX QY QZ QW."),
        (["goal"], "A goal is X Y Z, or X Y Z QX QY QZ QW."),
    ],
)
def test_goals_and_flights_that_are_refused(words: list[str], sentence: str) -> None:
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 2
    assert sentence in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    "words", [("campaign", "fly"), ("campaign", "fly", "a.yaml", "--compare", "b.yaml", "c.yaml")]
)
def test_a_campaign_is_of_one_file_or_two(words: tuple[str, ...]) -> None:
    result = CliRunner().invoke(main, list(words))
    assert result.exit_code == 2
    assert result.stderr == "Give the FILE of a campaign, or two after --compare, not both.\n"
