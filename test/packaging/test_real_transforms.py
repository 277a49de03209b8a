"""The real /tf: tf2_msgs is built, and the tests of frames run with it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.interface_package import TF2_MSGS, with_interfaces

ROOT = Path(__file__).resolve().parents[2]


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
