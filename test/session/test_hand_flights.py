"""Random goals of end-effectors through ROS: reached by Pinocchio from the recorded joints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.hand_motion import end_of_motion

from spacerobot_ros.cli.main import main
from spacerobot_ros.flight.reading import read_run
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file


@pytest.fixture(autouse=True)
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))


@pytest.mark.slow
@pytest.mark.parametrize("number", range(5))
@pytest.mark.parametrize(
    ("name", "link"), [("three_joint_arm", "end_effector"), ("seven_joint_arm", "link_7")]
)
def test_goals_are_reached_through_topics(
    name: str, link: str, number: int, tmp_path: Path
) -> None:
    """Positions and poses by turns, where the link is after a straight way of the joints."""
    urdf, robot = robot_file(name).read_text("utf-8"), SpaceRobot.from_file(robot_file(name))
    rng = np.random.default_rng([number, 26])
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    q, end = (lower + (upper - lower) * rng.uniform(a, 1 - a, robot.n) for a in (0.3, 0.1))
    place, attitude = rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3))
    way = q + np.linspace(0, 1, 60)[:, np.newaxis] * (end - q)
    r, R = end_of_motion(urdf, robot.joint_names, way, [link], place, attitude)[link]
    goal: list[Any] = ["--end-effector-position", *r]
    if number % 2:
        goal = ["--end-effector-goal", *r, *R.as_quat()]
    settings = {
        "planner.clearance": 0.0,
        "planner.position_tolerance": 1e-6,
        "planner.attitude_tolerance": 1e-6,
        "plant.initial_joint_positions": q.tolist(),
        "plant.initial_position": place.tolist(),
        "plant.initial_orientation": attitude.as_quat().tolist(),
    }
    words = ["run", name, "--method", "optimal", "--end-effector", link, *map(str, goal)]
    words += [f"--set={each}={value}" for each, value in settings.items()]
    bag = tmp_path / "hand.mcap"
    with pytest.raises(SystemExit) as ended:
        main([*words, "--bag", str(bag)])
    assert ended.value.code == 0
    flown = read_run(bag).q
    reached, turned = end_of_motion(urdf, robot.joint_names, flown, [link], place, attitude)[link]
    np.testing.assert_allclose(reached, r, atol=1e-6)
    if number % 2:
        assert (turned.inv() * R).magnitude() < 1e-6
