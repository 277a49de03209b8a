"""The scenarios in config/faults: flown, measured by the truth in their bags, flown again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.app.run import run_scenario
from spacerobot_ros.app.scenario import load_scenario
from spacerobot_ros.recording import read_bag
from spacerobot_ros.recording.verification import verify_bag
from spacerobot_ros.resources import share_directory

# Whether the goal is met, and to how many m and rad of the truth; None: not the method's to meet.
EXPECTED: dict[str, tuple[bool, float | None, float | None]] = {
    "noisy_sensors": (True, 3e-3, 2.6e-3),
    "wrong_masses": (True, 1e-3, 1e-3),
    "stuck_elbow": (True, None, 1e-3),
    "stuck_slider": (False, None, None),
    "broken_thrusters": (True, 4e-3, 4e-3),
}
FAST = ("noisy_sensors", "wrong_masses")


@pytest.fixture(autouse=True)
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))


def test_every_scenario_is_here() -> None:
    files = {path.stem for path in (share_directory() / "config" / "faults").glob("*.yaml")}
    assert files == set(EXPECTED)


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[] if n in FAST else pytest.mark.slow) for n in EXPECTED]
)
def test_a_scenario_ends_as_documented_and_can_be_flown_again(name: str, tmp_path: Path) -> None:
    met, distance, angle = EXPECTED[name]
    scenario = load_scenario(f"faults/{name}")
    result = run_scenario(scenario, tmp_path / "run.mcap")
    assert result.succeeded is met, result.sentence
    bag = read_bag(tmp_path / "run.mcap")
    odom = bag["/odom_true" if "/odom_true" in bag.topics else "/odom"]
    position = [odom.field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    quaternion = [odom.field(f"pose.pose.orientation.{x}")[-1] for x in "xyzw"]
    left = np.linalg.norm(position - scenario.goal.position)
    turn = Rotation.from_quat(quaternion).inv() * Rotation.from_quat(scenario.goal.quaternion)
    if distance is not None:
        assert left <= distance
    if angle is not None:
        assert turn.magnitude() <= angle
    if not met:
        assert "stuck" in result.sentence
    # The summary is of the truth.
    assert result.summary["position_error_m"] == pytest.approx(left, abs=1e-12)
    verification = verify_bag(tmp_path / "run.mcap")
    assert verification.difference is None, str(verification.difference)
