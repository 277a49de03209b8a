"""Workflows, and lines for a ROS machine, name what exists: they were never run in full here."""

from __future__ import annotations

import importlib
import itertools
import os
import re
import shlex
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from docs_build.blocks import blocks
from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.parameters import declared
from spacerobot_ros.resources import robot_file
from spacerobot_ros.topics import TOPICS

ROOT = Path(__file__).resolve().parents[2]
WORKFLOWS: dict[str, dict[str, Any]] = {
    path.stem: yaml.safe_load(path.read_text("utf-8"))
    for path in sorted(ROOT.glob(".github/workflows/*.yml"))
}
SCRIPTS = [ROOT / ".ci" / name for name in ("control_by_manager", "launch_stack", "run")]
PAGES = [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
TARGETS = {
    *re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE),
    *yaml.safe_load((ROOT / "test/studies.yaml").read_text("utf-8")),
}
TO_PUBLISH = {*("--once", "-w", "--keep-alive", "--rate", "--qos-durability", "--qos-reliability")}
"""Options of `ros2 topic pub` in the sources of ros2cli's branch jazzy, of those there are."""


def steps(workflow: str) -> Iterator[dict[str, Any]]:
    for job in WORKFLOWS[workflow]["jobs"].values():
        yield from job["steps"]


def lines_of(text: str) -> list[str]:
    """Return the commands of a shell's text, each in one line, without comments and `&`."""
    whole = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE)
    whole = re.sub(r"\\\n\s*", "", whole)
    # An argument in quotes may have several lines.
    whole = re.sub(r"'[^']*'", lambda match: " ".join(match[0].split()), whole)
    found = [re.sub(r"\s+(# .*|&|\|)$", "", line.strip()) for line in whole.splitlines()]
    return [line for line in found if line]


def shell_lines() -> list[tuple[str, str]]:
    """Return where each command of workflows, scripts and pages stands, and the command."""
    texts = [(name, each["run"]) for name in WORKFLOWS for each in steps(name) if "run" in each]
    texts += [(path.name, path.read_text("utf-8")) for path in SCRIPTS]
    for page in PAGES:
        found = blocks(page.read_text("utf-8"))
        texts += [(page.name, each.text) for each in found if each.language == "sh"]
    return [(where, line) for where, text in texts for line in lines_of(text)]


def lines_with(words: str) -> list[tuple[str, list[str]]]:
    """Return where each command with these words stands, and its words from there on."""
    return [
        (where, shlex.split(line[line.index(words) :].replace("$PWD", str(ROOT / "ros2_control"))))
        for where, line in shell_lines()
        if words in line
    ]


def block_with(page: Path, line: str) -> list[str]:
    """Return the commands of the block of a page that has this one."""
    found = [lines_of(each.text) for each in blocks(page.read_text("utf-8"))]
    (block,) = (each for each in found if line in each)
    return block


def test_the_main_job_has_the_python_and_the_versions_of_ubuntu() -> None:
    jobs = WORKFLOWS["test"]["jobs"]
    main, others = jobs.values()
    assert main["runs-on"] == "ubuntu-24.04"
    (python,) = (each["with"] for each in main["steps"] if "setup-python" in each.get("uses", ""))
    assert python["python-version"] == "3.12"
    assert "make test-oldest" in [each.get("run") for each in main["steps"]]
    assert jobs[others["needs"]] is main
    oldest = (ROOT / "Makefile").read_text("utf-8").split("\ntest-oldest:")[1].split("\n\n")[0]
    assert "constraints-oldest.txt" in oldest
    versions = others["strategy"]["matrix"]["python"]
    assert "3.12" in versions
    assert f'python_requires=">={versions[0]}"' in (ROOT / "setup.py").read_text("utf-8")


@pytest.mark.parametrize("workflow", WORKFLOWS)
def test_steps_are_shell_and_name_what_exists(workflow: str) -> None:
    for each in steps(workflow):
        assert ("run" in each) != ("uses" in each)
        if "uses" in each:
            assert re.fullmatch(r"actions/[a-z-]+@v\d+", each["uses"])
            continue
        text = each["run"]
        subprocess.run(["bash", "-n"], input=text.encode(), check=True)
        assert set(re.findall(r"\bmake ([a-z-]+)", text)) <= TARGETS
        for path in re.findall(r"src/spacerobot_ros/(\S+)", text):
            assert ROOT / path in SCRIPTS, path


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda path: path.name)
def test_scripts_are_shell_that_can_be_run(script: Path) -> None:
    assert os.access(script, os.X_OK)
    subprocess.run(["bash", "-n", script], check=True)


def test_what_the_container_builds_is_what_readers_build() -> None:
    wanted = block_with(ROOT / "docs" / "operation.md", "colcon build")
    done = [line for each in steps("ros") for line in lines_of(each.get("run", ""))]
    assert [line for line in done if line in wanted] == wanted
    link, *_ = wanted
    assert re.fullmatch(r"ln -s spacerobot_ros/(\w+) src/", link)
    assert (ROOT / link.split()[2].removeprefix("spacerobot_ros/") / "package.xml").is_file()
    for page in ("README.md", "docs/operation.md"):
        assert "never been run" in (ROOT / page).read_text("utf-8")
    assert "never" in (ROOT / "package.xml").read_text("utf-8")


def test_executables_and_their_parameters_exist() -> None:
    started = lines_with("ros2 run spacerobot_ros")
    assert {"README.md", "operation.md", "launch_stack", "control_by_manager"} <= {
        where for where, _ in started
    }
    programs = {path.name for path in ROOT.glob("scripts/*")} | {"spacerobot"}
    for where, words in started:
        program = words[3]
        assert program in programs, where
        if program == "spacerobot":
            continue
        known = {each.name for each in declared(NODE_TYPES[program].Config)}
        given = dict(words[i + 1].split(":=", 1) for i, word in enumerate(words) if word == "-p")
        assert set(given) <= known, (where, words)
        if "robot" in given and not given["robot"].startswith("my"):
            assert robot_file(given["robot"]).is_file()


def test_what_is_published_can_be_and_arrives() -> None:
    """`ros2 topic pub --once` ends 0.1 s after the message unless it is told otherwise."""
    published = lines_with("ros2 topic pub")
    assert len(published) >= 6
    for where, words in published:
        *options, topic, kind, text = words[3:]
        assert {word for word in options if word.startswith("-")} <= TO_PUBLISH, where
        given = dict(itertools.pairwise(options))
        assert given["-w"] in ("1", "2"), where
        assert "--once" not in options or float(given["--keep-alive"]) >= 1.0, where
        package, _, name = kind.split("/")
        message = getattr(importlib.import_module(f"{package}.msg"), name)()
        fill(message, yaml.safe_load(text))
        if topic.removeprefix("/") in TOPICS:
            assert TOPICS[topic.removeprefix("/")].type == kind


def fill(message: Any, values: dict[str, Any]) -> None:
    """Set fields of a message by name, as the command does: each is there and has its type."""
    for name, value in values.items():
        present = getattr(message, name)
        if isinstance(value, dict):
            fill(present, value)
        elif isinstance(value, list):
            assert isinstance(present, list)
        else:
            setattr(message, name, type(present)(value))
