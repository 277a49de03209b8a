"""The target of a capture in the 3D view of a report: its solids, and its motion by the bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from spacerobot_ros.bag import read_bag
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.model.visuals import visuals_of
from spacerobot_ros.report.figures import ReportFigure, short
from spacerobot_ros.report.figures_over_time import shape_groups
from spacerobot_ros.report.figures_space import configurations_figure
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.scene import TARGET, Scene, scene_of
from spacerobot_ros.report.tables import joint_table

BAG = Path(__file__).parents[2] / "bags" / "capture.mcap"


@pytest.fixture(scope="module")
def scene() -> Scene:
    made = scene_of(read_report(BAG))
    assert isinstance(made, Scene)
    return made


def odometry_in(bag: Path) -> tuple[Any, Any, Any]:
    """Times (s), positions and attitudes of the target, read message by message."""
    found = [
        (message.header.stamp, message.pose.pose)
        for _, message in read_bag(bag).messages("/target/odom")
    ]
    times = np.array([stamp.sec + stamp.nanosec * 1e-9 for stamp, _ in found])
    positions = np.array([[pose.position.x, pose.position.y, pose.position.z] for _, pose in found])
    turned = [[getattr(pose.orientation, x) for x in "xyzw"] for _, pose in found]
    return times, positions, Rotation.from_quat(turned)


@pytest.fixture(scope="module")
def odometry() -> tuple[Any, Any, Any]:
    return odometry_in(BAG)


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


def test_pictures_draw_the_target_where_it_is_held() -> None:
    """Corners of its solids about its odometry, as the corners of its URDF about its origin."""
    bag = BAG.with_name("servicing.mcap")
    report, (times, positions, attitudes) = read_report(bag), odometry_in(bag)
    assert report.target is not None
    corners = np.concatenate(
        [
            visual.mesh.vertices @ frame.R.T + frame.r
            for visual in visuals_of(report.target, {}, 10_000)
            for frame in [report.target.frames[visual.link][1]]
        ]
    )
    gone = np.linalg.norm(positions - positions[0], axis=1)
    assert gone[-1] > 0.5
    for k in (0, len(times) // 2, len(times) - 1):
        drawn = np.concatenate([face.corners for face in report.target_solids_at(times[k]).faces])
        wanted = positions[k] + attitudes[k].apply(corners)
        assert np.abs(drawn[:, None] - wanted[None]).max(axis=2).min(axis=1).max() < 1e-9
    figure = configurations_figure(report)
    assert isinstance(figure, ReportFigure)
    assert "free or held" in figure.caption


def test_reaction_wheels_have_rates_and_no_angles() -> None:
    report = read_report(BAG.with_name("servicing.mcap"))
    wheels = {"wheel_plus_x", "wheel_plus_y", "wheel_minus_x", "wheel_minus_y"}
    assert {report.joint_names[i] for i in report.wheel_columns} == wheels
    bag = read_bag(BAG.with_name("servicing.mcap"))
    recorded = [message for _, message in bag.messages("/joint_states")]
    angles = {name: [m.position[list(m.name).index(name)] for m in recorded] for name in wheels}
    assert max(abs(x) for each in angles.values() for x in each) > 1000
    groups = shape_groups(report)
    assert [group.unit for group in groups] == ["rad", "rad/s"]
    assert not set(map(short, wheels)) & set(groups[0].names)
    assert set(groups[1].names) == set(map(short, wheels))
    for k, name in enumerate(groups[1].names):
        full = next(each for each in wheels if short(each) == name)
        rates = [m.velocity[list(m.name).index(full)] for m in recorded]
        assert np.abs(groups[1].signal.values[:, k]).max() == pytest.approx(np.abs(rates).max())
    # Pictures hold them still: at any angle they look the same.
    assert np.abs(report.joints).max() < np.pi
    table = joint_table(report)
    assert table is not None
    ends = {row[0]: row[3:5] for row in table.rows}
    assert all((ends[name] == ("–", "–")) is (name in wheels) for name in ends)
