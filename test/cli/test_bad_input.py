"""Bad input of every kind ends a command with one sentence and exit code 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.command_line import CliRunner
from support.sentences import assert_one_sentence

from spacerobot_ros.cli.main import main
from spacerobot_ros.files import load_yaml

ROOT = Path(__file__).resolve().parents[2]

LAUGHS = "a: &a [1, 2]\n" + "".join(
    f"{chr(98 + n)}: &{chr(98 + n)} [{', '.join(9 * [f'*{chr(97 + n)}'])}]\n" for n in range(20)
)
"""Some 1e19 values in 1 kB."""

LADDER = "a0: &a0 {b: 1}\n" + "".join(f"a{n}: &a{n} {{b: *a{n - 1}}}\n" for n in range(1, 2000))
"""Nested two thousand times, with two levels on a line."""

HARMFUL = {
    "nested": "scenario: " + 10_000 * "[",
    "alias of itself": "scenario: &a {ros__parameters: *a}",
    "aliases": LAUGHS,
    "ladder": LADDER,
    "date": "a: 2024-99-99",
    "number": "a: " + 5000 * "9",
    "long": "a: " + 1_000_001 * "x",
}
COMMANDS = ("plan", "run")
"""They read scenarios as `campaign fly` reads its file, by one function."""

REASONS = {
    "nested": "nested too deeply",
    "alias of itself": "more than 100000 values",
    "aliases": "more than 100000 values",
    "ladder": "more than 100000 values",
    "date": "month must be in",
    "number": "integer string conversion",
    "long": "more than 1000000 characters",
}


@pytest.mark.parametrize("name", HARMFUL)
@pytest.mark.parametrize(
    "words", [("campaign", "fly"), *(pytest.param((w,), marks=pytest.mark.slow) for w in COMMANDS)]
)
def test_harmful_yaml_is_one_sentence(words: tuple[str, ...], name: str, tmp_path: Path) -> None:
    file = tmp_path / "harmful.yaml"
    file.write_text(HARMFUL[name], "utf-8")
    result = CliRunner().invoke(main, [*words, str(file)])
    assert result.exit_code == 2, result.output
    assert_one_sentence(result.stderr, str(file))
    if name != "number" or sys.version_info >= (3, 11):
        assert REASONS[name] in result.stderr


def test_anchors_and_merged_mappings_are_read() -> None:
    text = "common: &c {rate: 20, names: [a, b]}\nfirst: {<<: *c, rate: 10}\nsecond: *c\n"
    content = load_yaml(text)
    assert content["first"] == {"rate": 10, "names": ["a", "b"]}
    assert content["second"] == {"rate": 20, "names": ["a", "b"]}
    assert load_yaml("") is None
    assert load_yaml("[1, 2.5, x, null]") == [1, 2.5, "x", None]


def started(*words: str | bytes, **variables: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "spacerobot_ros", *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run(
        command, env=environment, capture_output=True, text=True, timeout=120, check=False
    )


@pytest.mark.parametrize(
    ("words", "domain"),
    [
        (("run", "sliding_masses", "--nodes"), "abc"),
        pytest.param(("goal", "0", "0", "0"), "999", marks=pytest.mark.slow),
        pytest.param(("run", "sliding_masses", "--nodes"), "-1", marks=pytest.mark.slow),
        pytest.param(("goal", "0", "0", "0"), "1.5", marks=pytest.mark.slow),
    ],
)
def test_a_domain_that_is_none_is_one_sentence(words: tuple[str, ...], domain: str) -> None:
    ended = started(*words, ROS_DOMAIN_ID=domain)
    assert ended.returncode == 2, ended.stderr
    assert_one_sentence(ended.stderr, f"ROS_DOMAIN_ID is '{domain}'", "0 to 232")


@pytest.mark.parametrize("option", ["--bag", "--report"])
def test_a_dash_is_no_file_to_write(option: str) -> None:
    ended = started("run", "sliding_masses", option, "-")
    assert ended.returncode == 2
    assert f"Invalid value for '{option}': '-' stands for no file" in ended.stderr
    assert not Path("-").exists()


@pytest.mark.parametrize("option", ["--bag", "--json", "--report"])
def test_a_path_that_is_no_text_is_refused(option: str) -> None:
    ended = started("run", "sliding_masses", option, b"out/\xff")
    assert ended.returncode == 2
    assert "bytes that are not UTF-8" in ended.stderr
    assert "Traceback" not in ended.stderr
