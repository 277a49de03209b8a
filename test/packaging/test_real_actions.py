"""Real actions and /tf: packages of interfaces are built, and the tests of nodes run with them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.interface_package import (
    CONTROL_MSGS,
    NAV2_MSGS,
    SPACEROBOT_MSGS,
    TF2_MSGS,
    InterfacePackage,
    with_interfaces,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_actions_are_served_by_both_kinds_of_interface() -> None:
    _run("test_fly_to.py", SPACEROBOT_MSGS, NAV2_MSGS)


@pytest.mark.slow
def test_schedules_are_flown_by_a_trajectory_server() -> None:
    _run("test_trajectory_output.py", CONTROL_MSGS)


def _run(tests: str, *packages: InterfacePackage) -> None:
    """Run tests of nodes with packages that are built."""
    environment = {**os.environ, **with_interfaces(*packages)}
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "-rs", "-m", "slow",
         f"test/nodes/{tests}"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    told = [line for line in run.stdout.splitlines() if not line.startswith("[")]
    print("\n".join(told))
    assert run.returncode == 0, run.stdout[-3000:]
    assert "skipped" not in run.stdout


# -- the real /tf ------------------------------------------------------------------------------


@pytest.mark.slow
def test_frames_on_the_real_topic_are_those_of_odom_and_pinocchio() -> None:
    environment = {**os.environ, **with_interfaces(TF2_MSGS)}
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rs",
         "test/nodes/test_transforms.py"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:]
    assert "skipped" not in run.stdout
