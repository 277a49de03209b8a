"""The real actions: packages of interfaces are built, and the tests of actions run with them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.interface_package import NAV2_MSGS, SPACEROBOT_MSGS, with_interfaces

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_actions_are_served_by_both_kinds_of_interface() -> None:
    environment = {**os.environ, **with_interfaces(SPACEROBOT_MSGS, NAV2_MSGS)}
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rs", "-m", "slow",
         "test/nodes/test_fly_to.py"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:]
    assert "skipped" not in run.stdout
