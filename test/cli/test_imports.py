"""What the command and the package load: little, until it is needed."""

from __future__ import annotations

import subprocess
import sys

import pytest
from support.command_line import CliRunner

from spacerobot_ros.cli.main import COMMANDS, main

LIBRARIES = ("numpy", "casadi", "scipy", "matplotlib", "rclpy", "yaml", "rosbags", "mcap")


def loaded(code: str) -> set[str]:
    """Return the modules that a fresh interpreter has loaded after some code."""
    report = "import sys; sys.stderr.write(' '.join(sys.modules))"
    run = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return set(run.stderr.split())


@pytest.mark.parametrize("words", [["--help"], ["-h"], ["--version"], ["up", "--help"]])
def test_help_loads_no_library(words: list[str]) -> None:
    code = f"from spacerobot_ros.cli.main import main\nmain({words!r}, standalone_mode=False)"
    modules = loaded(code)
    assert "spacerobot_ros.cli.main" in modules
    assert not modules.intersection(LIBRARIES)


def test_the_package_loads_neither_scipy_nor_matplotlib() -> None:
    assert not loaded("import spacerobot_ros").intersection(LIBRARIES)


def test_planning_loads_neither_scipy_nor_matplotlib_nor_ros() -> None:
    modules = loaded("import spacerobot_ros\nspacerobot_ros.plan")
    assert "spacerobot_ros.planning.api" in modules
    assert not modules.intersection({"matplotlib", "rclpy", "scipy"})


def test_every_command_is_listed_and_has_help() -> None:
    listed = CliRunner().invoke(main, ["--help"])
    assert listed.exit_code == 0
    _, _, table = listed.output.partition("Commands:\n")
    names = tuple(line.split()[0] for line in table.splitlines())
    assert names == tuple(sorted(COMMANDS))
    for name in COMMANDS:
        shown = CliRunner().invoke(main, [name, "--help"], prog_name="spacerobot")
        assert shown.exit_code == 0
        assert shown.output.startswith(f"Usage: spacerobot {name} ")


def test_methods_and_laws_are_offered_by_name() -> None:
    shown = CliRunner().invoke(main, ["run", "--help"]).output
    assert "[area_loop|auto|computed_torque|lie_bracket|" in shown
    refused = CliRunner().invoke(main, ["plan", "planar_chain", "--method", "magic"])
    assert refused.exit_code == 2
    assert "'magic' is not one of" in refused.output
    missing = CliRunner().invoke(main, ["nothing"])
    assert missing.exit_code == 2
    assert "No such command 'nothing'" in missing.output
