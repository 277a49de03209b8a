"""The clearance of a plant: distances of balls on sliders, and events of their contacts."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
from support.crossing import URDF, distance

from spacerobot_ros.collision import CollisionGeometry, LinkPair, NearestPair, ObstaclePair
from spacerobot_ros.collision import distances as distances_module
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.urdf import parse_world
from spacerobot_ros.model.world import with_world
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.clearance import ClearanceMonitor, ClearanceStatus
from spacerobot_ros.simulation.config import PlantConfig


def test_a_plant_goes_on_through_a_contact_and_says_so() -> None:
    start = (-0.15, -0.3)
    config = PlantConfig(initial_joint_positions=start, tick_rate=20.0)
    plant = build_plant(SpaceRobot(parse_robot(URDF)), config)
    monitor = ClearanceMonitor.of(plant.robot.description, plant.robot.link_names)
    assert monitor is not None
    found: list[ClearanceStatus] = []
    events: list[Event] = []
    shapes = []
    for tick in range(13):
        status, news = monitor.measure(plant.link_R, plant.link_r, plant.pose, tick / 20)
        found.append(status)
        events += news
        shapes.append(plant.q.copy())
        plant.step(np.array([0.5, 1.0]))
    truth = distance(np.array(shapes))
    np.testing.assert_allclose([each.distance for each in found], truth, atol=1e-6)
    touching = np.flatnonzero(truth <= 0)
    assert 1 < len(touching) < 6
    assert [(each.kind, each.time_s, each.level) for each in events] == [
        (EventKind.CONTACT, touching[0] / 20, 2),
        (EventKind.CONTACT_ENDED, (touching[-1] + 1) / 20, 0),
    ]
    assert events[0].about == {"first": "left", "second": "right"}
    assert events[0].message == (
        "Links 'left' and 'right' touch; the simulation goes on through the contact."
    )
    assert [each.level for each in found] == [2 if d <= 0 else 0 for d in truth]
    assert found[0].message == f"Links 'left' and 'right' are {truth[0]:.3g} m apart."
    deepest = found[int(truth.argmin())]
    assert deepest.message == f"Links 'left' and 'right' touch, {-1e3 * truth.min():.3g} mm deep."


def test_a_plant_whose_bodies_push_each_other_says_so() -> None:
    config = PlantConfig(initial_joint_positions=(0.0, 0.0))
    plant = build_plant(SpaceRobot(parse_robot(URDF)), config)
    links = tuple(plant.robot.link_names)
    monitor = ClearanceMonitor.of(plant.robot.description, links, has_contact_forces=True)
    assert monitor is not None
    shapes = np.linspace(-0.6, 0.6, 60)
    messages = []
    for x in shapes:
        plant.q[:] = 0.0
        link_R, link_r = plant.robot.buffered("link_poses")(np.array([x, -x]))
        messages += [e.message for e in monitor.measure(link_R, link_r, plant.pose, 0.0)[1]]
    assert messages[:1] == ["Links 'left' and 'right' touch and push each other."]


def test_a_clearance_is_read_again_from_its_message() -> None:
    status = ClearanceStatus(-0.0125, LinkPair("a", "b"), 12.75)
    assert ClearanceStatus.from_values(status.to_values()) == status
    assert type(ClearanceStatus.from_values(status.to_values()).links) is LinkPair
    assert set(status.to_values()) == {"time", "distance", "first", "second"}
    beside = ClearanceStatus(0.25, ObstaclePair("a", "b"), 12.75)
    assert beside.to_values()["second_is"] == "obstacle"
    again = ClearanceStatus.from_values(beside.to_values())
    assert again.message == "Link 'a' and obstacle 'b' are 0.25 m apart."
    assert type(again.links) is ObstaclePair
    for flaw in ({"distance": "near"}, {"first": None}):
        values = {k: v for k, v in (status.to_values() | flaw).items() if v is not None}
        with pytest.raises(SpaceRobotError, match="are no clearance"):
            ClearanceStatus.from_values(values)


@pytest.mark.parametrize("name", ["servicer", "seven_joint_arm"])
def test_the_nearest_pair_is_that_of_all_distances(name: str) -> None:
    robot = load_robot(robot_file(name))
    geometry = CollisionGeometry(robot)
    low, high = robot.limits("lower"), robot.limits("upper")
    shapes = np.random.default_rng(5).uniform(low, high, (40, len(low)))
    R, r = geometry.poses(shapes)
    each = np.array([geometry.distances(p, (R, r)) for p in range(len(geometry.pairs))])
    together, pairs = geometry.nearest_along(shapes)
    np.testing.assert_allclose(together, each.min(axis=0), atol=1e-9)
    np.testing.assert_array_equal(pairs, each.argmin(axis=0))
    nearest, pose = (
        NearestPair(geometry, geometry.links),
        np.array([0.3, -0.2, 0.1, 0, 0, 0.6, 0.8]),
    )
    for k in range(len(shapes)):
        poses = R[k].transpose(1, 0, 2).reshape(3, -1), r[k].T
        found, _ = nearest.nearest(poses[0], poses[1], pose)
        assert found == pytest.approx(together[k], abs=1e-9)
        touching = {geometry.links_of(p) for p in np.flatnonzero(each[:, k] <= 0).tolist()}
        assert nearest.links_in_contact(poses[0], poses[1], pose) == touching
    assert (each.min(axis=0) < 0).any()


def test_without_coal_or_pairs_a_plant_measures_no_clearance(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, tmp_path: Path
) -> None:
    sliders = load_robot(robot_file("sliding_masses"))
    assert ClearanceMonitor.of(sliders, ()) is None
    monkeypatch.setitem(sys.modules, "coal", None)
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path / "cache"))
    distances_module._coal.cache_clear()
    try:
        with caplog.at_level(logging.WARNING):
            assert ClearanceMonitor.of(parse_robot(URDF), ("base", "left", "right")) is None
    finally:
        monkeypatch.undo()
        distances_module._coal.cache_clear()
    assert "The plant measures no clearance without the package coal." in caplog.messages


def ball_at(x: float, name: str = "ball") -> str:
    return (
        f'<robot name="w"><link name="w"/><link name="{name}"><collision><geometry>'
        '<sphere radius="0.01"/></geometry></collision></link><joint name="a" type="fixed">'
        f'<parent link="w"/><child link="{name}"/><origin xyz="{x} 0 0"/></joint></robot>'
    )


def test_contacts_go_on_or_end_among_other_obstacles() -> None:
    robot = SpaceRobot(load_robot(robot_file("planar_chain")))
    plant = build_plant(robot, PlantConfig())
    monitor: ClearanceMonitor | None = None
    events = []
    for time, text in ((1.0, ball_at(0.0)), (2.0, ball_at(0.001)), (3.0, ball_at(40.0))):
        described = with_world(robot.description, parse_world(text))
        monitor = ClearanceMonitor.of(described, tuple(robot.link_names), monitor)
        assert monitor is not None
        status, news = monitor.measure(plant.link_R, plant.link_r, plant.pose, time)
        events += [(each.kind.value, each.time_s, each.about["second"]) for each in news]
        touches = np.sign(status.distance) < 0
        assert touches == (time < 3)
    assert events == [("contact", 1.0, "ball"), ("contact_ended", 3.0, "ball")]
