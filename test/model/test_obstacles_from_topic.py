"""Obstacles in texts from topics, and robots among others than so far."""

from __future__ import annotations

import pytest

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.urdf import load_robot, parse_robot, parse_world
from spacerobot_ros.model.world import (
    links_with_shapes,
    obstacles_from_topic,
    with_world,
)
from spacerobot_ros.resources import robot_file

BALL = (
    '<robot name="w"><link name="w"/><link name="ball"><collision><geometry><sphere radius="0.3"/>'
    '</geometry></collision></link><link name="post"><visual><geometry><box size="1 2 3"/>'
    '</geometry></visual></link><joint name="a" type="fixed"><parent link="w"/>'
    '<child link="ball"/></joint><joint name="b" type="fixed"><parent link="ball"/>'
    '<child link="post"/></joint></robot>'
)


def test_a_text_is_obstacles_and_an_empty_one_is_none() -> None:
    world = obstacles_from_topic(BALL)
    assert world is not None
    assert links_with_shapes(world) == ["ball", "post"]
    for empty in ("", " \n"):
        assert obstacles_from_topic(empty) is None


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            BALL.replace('"a" type="fixed"', '"a" type="continuous"'),
            "joint 'a' is (floating|continuous): give it",
        ),
        ('<robot name="w"><link name="w"/></robot>', "The world 'w' has no obstacle"),
        ("<robot", "is no XML"),
        (
            BALL.replace("</robot>", f"<world>{BALL}</world></robot>"),
            "^Obstacles are not among others: leave the element <world> out",
        ),
        (BALL.replace("0.3", "${radius}"), "radius"),
    ],
)
def test_other_texts_are_refused(text: str, message: str) -> None:
    with pytest.raises(RobotDescriptionError, match=message):
        obstacles_from_topic(text)


def test_a_robot_is_among_the_obstacles_that_came_last() -> None:
    robot = load_robot(robot_file("planar_chain"))
    before = with_world(robot, parse_world(BALL.replace("ball", "stone")))
    other = with_world(before, parse_world(BALL))
    assert other.world is not None
    carried = parse_robot(other.urdf).world
    assert carried is not None
    assert links_with_shapes(carried) == ["ball", "post"]
    free = with_world(other, None)
    assert free.world is None
    assert parse_robot(free.urdf).world is None
    assert "<world" not in free.urdf
