"""`colcon test` with the packages that package.xml names, and with no others."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from support.colcon import COLCON, new_environment, run
from support.rosdep import ROOT, keys_of

WHEELS = {
    "casadi-pip": "casadi",
    "mcap-ros2-support": "mcap-ros2-support",
    "pinocchio": "pin",
    "python3-catkin-pkg": "catkin_pkg",
    "python3-click": "click",
    "python3-hypothesis": "hypothesis",
    "python3-matplotlib": "matplotlib",
    "python3-mujoco-pip": "mujoco",
    "python3-numpy": "numpy",
    "python3-pytest": "pytest",
    "python3-rosbags-pip": "rosbags",
    "python3-scipy": "scipy",
    "python3-yaml": "PyYAML",
    "rclpy": "ros-jazzy-rclpy[fastrtps]",
    "xacro": "xacro",
}
"""Wheels of keys whose packages have other names there."""

NO_WHEELS = {"launch", "launch_ros", "tf2_msgs"}


@pytest.mark.slow
def test_colcon_collects_the_tests_and_says_what_is_skipped(tmp_path: Path) -> None:
    keys = set(keys_of("package.xml")) - NO_WHEELS
    wheels = [WHEELS.get(key, f"ros-jazzy-{key.replace('_', '-')}") for key in sorted(keys)]
    environment = tmp_path / "environment"
    python = new_environment(environment)
    run([python, "-m", "pip", "install", "-q", *wheels, *COLCON])
    found = run([python, "-m", "pip", "list", "--format=freeze"])
    for other in ("pandas", "dask", "gymnasium", "viser", "xdist", "psutil"):
        assert f"\n{other}=" not in found, f"{other} is there"

    source = tmp_path / "src" / "spacerobot_ros"
    left_out = shutil.ignore_patterns(".*", "out", "build", "*.egg-info", "__pycache__")
    shutil.copytree(ROOT, source, ignore=left_out)
    colcon, path = environment / "bin" / "colcon", str(environment / "bin")
    run([colcon, "build", "--base-paths", "src"], cwd=tmp_path, path=path)
    options = "--base-paths src --event-handlers console_direct+ --return-code-on-test-failure"
    line = f". install/setup.sh; {colcon} test {options} --pytest-args --collect-only -qq"
    told = run(["sh", "-e", "-c", line], cwd=tmp_path, path=path)
    assert "ERROR" not in told, told[-3000:]
    collected = [line for line in told.splitlines() if re.fullmatch(r"test/\S+\.py: \d+", line)]
    assert len(collected) > 300
    skipped = [line for line in told.splitlines() if line.startswith("SKIPPED")]
    reason = re.compile(
        r"is not installed \(pip install 'spacerobot_ros\[test\]'\)|could not import"
    )
    assert skipped
    assert [line for line in skipped if not reason.search(line)] == []
    print(
        f"{len(collected)} modules of tests collected, {len(skipped)} skipped:", *skipped, sep="\n"
    )
