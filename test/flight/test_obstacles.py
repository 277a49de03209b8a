"""Flights in bags whose obstacles came on a topic, and goals that came as paths."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path as File

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Path
from std_msgs.msg import String
from support.made_bags import joint_states, made_bag, odometry, pose

from spacerobot_ros.flight.reading import FlightBag, open_flight_bag, read_flight
from spacerobot_ros.resources import robot_file

ROBOT = File(robot_file("planar_chain")).read_text("utf-8")


def world(name: str) -> String:
    return String(
        data=f'<robot name="w"><link name="w"/><link name="{name}"><collision><geometry>'
        '<sphere radius="0.3"/></geometry></collision></link><joint name="a" type="fixed">'
        f'<parent link="w"/><child link="{name}"/></joint></robot>'
    )


def bag_with(path: File, *obstacles: tuple[float, String]) -> FlightBag:
    """Return a bag with states from 1 s on, a path at 1.5 s, and obstacles at some times."""
    with made_bag(path) as (_, say):
        say("/robot_description", String(data=ROBOT), 0.25)
        for time in (1.0, 1.5, 2.0):
            say("/odom", odometry(time, time, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0), time)
            say("/clearance", DiagnosticStatus(), time)
        for time, text in obstacles:
            say("/obstacles", text, time)
        given = Path(poses=[pose(0.0, 7, 8, 9, 0, 0, 0, 1), pose(0.0, 4, 5, 6, 0, 0, 0, 0)])
        given.header.stamp.sec = 5
        say("/end_effector/path", given, 1.5)
        say("/end_effector/path", Path(), 1.75)
        say("/end_effector/goal_pose", pose(9.0, 1, 2, 3, 0, 0, 0, 1), 1.25)
    return open_flight_bag(path)


def names_of(bag: FlightBag) -> list[str]:
    description = bag.description
    assert description is not None
    return [] if description.world is None else [each.name for each in description.world.links[1:]]


@pytest.mark.parametrize(
    ("obstacles", "names", "change"),
    [
        ([], [], False),
        ([(0.5, world("post"))], ["post"], False),
        ([(0.5, world("post")), (1.75, world("ball"))], ["ball"], True),
        ([(0.5, world("post")), (0.75, String(data=""))], [], False),
        ([(0.5, world("post")), (1.5, String(data="no URDF"))], ["post"], False),
    ],
)
def test_a_robot_is_among_the_last_obstacles_and_distances_are_to_one_set(
    tmp_path: File, obstacles: Sequence[tuple[float, String]], names: list[str], *, change: bool
) -> None:
    bag = bag_with(tmp_path / "made.mcap", *obstacles)
    assert names_of(bag) == names
    assert bag.obstacles_change is change
    assert read_flight(bag).measures_clearance is not change


def test_the_last_pose_of_a_path_is_a_goal(tmp_path: File) -> None:
    sent = read_flight(bag_with(tmp_path / "made.mcap")).end_effector_goals
    assert [each.time for each in sent] == [1.25, 1.5]
    assert [each.goal_id for each in sent] == ["9.000000000", "5.000000000"]
    assert [each.goal.position.tolist() for each in sent] == [[1, 2, 3], [4, 5, 6]]
    assert sent[1].goal.quaternion.tolist() == [0, 0, 0, 1]


def test_goals_have_the_frame_of_their_pose_and_the_shape_that_was_sent_before(
    tmp_path: File,
) -> None:
    names, path = ["pin_1", "pin_2"], tmp_path / "made.mcap"
    with made_bag(path) as (_, say):
        say("/robot_description", String(data=ROBOT), 0.25)
        for time in (1.0, 2.0):
            say("/odom", odometry(time, time, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0), time)
            say("/joint_states", joint_states(time, names, [0.0, 0.0], [0.0, 0.0]), time)
        for x, header, frame in ((1, "map", "world"), (2, "world", "map"), (3, "world", "")):
            last = pose(0.0, x, 0, 0, 0, 0, 0, 1)
            last.header.frame_id = frame
            sent = Path(poses=[pose(0.0, 7, 8, 9, 0, 0, 0, 1), last])
            sent.header.frame_id = header
            say("/end_effector/path", sent, 1.0 + x / 10)
        for time, shape in ((1.15, [0.3, -0.4]), (1.35, [])):
            given = joint_states(time, names[: len(shape)], shape, [])
            say("/goal_joint_states", given, time)
        for time in (1.1, 1.2, 1.3, 1.4):
            say("/goal_pose", pose(time, 10 * time, 0, 0, 0, 0, 0, 1), time)
    bag = open_flight_bag(path)
    assert [each.goal.position[0] for each in bag.goals("end_effector/path")] == [1.0, 3.0]
    shapes = [each.goal.joint_positions for each in bag.goals("goal_pose")]
    assert [None if each is None else each.tolist() for each in shapes] == [
        *(None, [0.3, -0.4], [0.3, -0.4], None)
    ]
