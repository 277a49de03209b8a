"""The target of a capture in the 3D view of a report: its solids, and its motion by the bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from spacerobot_ros.bag import read_bag
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.scene import TARGET, Scene, scene_of

BAG = Path(__file__).parents[2] / "bags" / "capture.mcap"


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = scene_of(read_report(BAG))
    assert isinstance(made, Scene)
    return made


@pytest.fixture(scope="module")
def odometry() -> tuple[Any, Any, Any]:
    """Times (s), positions and attitudes of the target, read message by message."""
    found = [
        (message.header.stamp, message.pose.pose)
        for _, message in read_bag(BAG).messages("/target/odom")
    ]
    times = np.array([stamp.sec + stamp.nanosec * 1e-9 for stamp, _ in found])
    positions = np.array([[pose.position.x, pose.position.y, pose.position.z] for _, pose in found])
    turned = [[getattr(pose.orientation, x) for x in "xyzw"] for _, pose in found]
    return times, positions, Rotation.from_quat(turned)


def test_the_target_has_the_solids_of_its_urdf(scene: Scene) -> None:
    (described,) = (
        message.data for _, message in read_bag(BAG).messages("/target/robot_description")
    )
    visuals = [v for link in parse_robot(described).links for v in link.shapes]
    drawn = [
        command
        for command in scene.commands
        if command.get("path", "").startswith(f"{TARGET}/")
        and "object" in command
        and command["object"]["geometries"][0]["type"] not in ("BufferGeometry", "LineSegments")
    ]
    assert len(drawn) == len(visuals) > 0
    assert "the target moves as target/odom says" in scene.caption


def test_the_target_moves_as_its_odometry_says(scene: Scene, odometry: Any) -> None:
    times, positions, attitudes = odometry
    (animation,) = [c for c in scene.commands if c["type"] == "set_animation"]
    (moved,) = [c for c in animation["animations"] if c["path"] == TARGET]
    tracks = {track["name"]: track for track in moved["clip"]["tracks"]}
    at = np.array(tracks[".position"]["times"])
    assert tracks[".quaternion"]["times"] == tracks[".position"]["times"]
    assert 2 < len(at) <= 1000
    assert at[0] == 0.0
    assert at[-1] == pytest.approx(times[-1] - times[0], abs=1e-3)
    shown = np.reshape(tracks[".position"]["values"], (-1, 3))
    turned = Rotation.from_quat(np.reshape(tracks[".quaternion"]["values"], (-1, 4)))
    # Between key frames, too: within the tolerance of the caption.
    now = times - times[0]
    near = np.column_stack([np.interp(now, at, column) for column in shown.T])
    assert np.abs(near - positions).max() < 5e-3
    inside = np.clip(now, at[0], at[-1])
    assert (Slerp(at, turned)(inside).inv() * attitudes).magnitude().max() < 8e-3
    (placed,) = [c for c in scene.commands if c["type"] == "set_transform" and c["path"] == TARGET]
    matrix = np.reshape(placed["matrix"], (4, 4)).T
    np.testing.assert_allclose(matrix[:3, 3], positions[0], atol=1e-8)
    np.testing.assert_allclose(matrix[:3, :3], attitudes[0].as_matrix(), atol=1e-8)


def test_other_flights_have_no_target() -> None:
    report = read_report(BAG.with_name("planar_chain.mcap"))
    assert report.target is None
    assert len(report.target_pose) == 0
    made = scene_of(report)
    assert isinstance(made, Scene)
    assert "target" not in made.caption
    assert not any(command.get("path") == TARGET for command in made.commands)
