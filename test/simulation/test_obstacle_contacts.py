"""Contacts with obstacles that come, move and go while a plant runs."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.urdf import load_robot, parse_world
from spacerobot_ros.model.world import with_world
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.clearance import ClearanceMonitor
from spacerobot_ros.simulation.config import PlantConfig


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
