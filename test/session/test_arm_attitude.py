"""The scenario of paper 2 through ROS: cycle by cycle, by the attitude that is measured."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.bag import read_bag
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario


@pytest.fixture(autouse=True)
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))


@pytest.mark.slow
def test_five_degrees_about_each_axis(tmp_path: Path) -> None:
    result = run_scenario(load_scenario("arm_attitude"), tmp_path / "arm.mcap")
    assert result.succeeded
    summary = result.summary
    # Cycles are pieces of one gait, not corrections of it.
    assert summary["corrections"] == 0
    assert summary["attitude_error_rad"] <= 0.0012
    odom = read_bag(tmp_path / "arm.mcap")["/odom"]
    attitudes = np.column_stack([odom.field(f"pose.pose.orientation.{c}") for c in "xyzw"])
    goal = Rotation.from_rotvec(np.radians([5.0, 5.0, 5.0]))
    left = np.degrees(np.abs((Rotation.from_quat(attitudes).inv() * goal).as_rotvec()))
    # A cycle is six edges of 4 s, and 2 s to the first corner and back: 28 s at 20 Hz.
    per_cycle = 560
    assert left[20 * per_cycle].max() <= 0.22
    assert left[30 * per_cycle].max() <= 0.045
    assert summary["ticks"] == pytest.approx(30 * per_cycle, abs=per_cycle)
    # The arm is where it was: what turned the base is the way.
    np.testing.assert_allclose(
        summary["final_joint_positions"], np.radians([0.0, -45.0, 90.0]), atol=1e-6
    )
