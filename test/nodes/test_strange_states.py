"""States that are none: of another robot, of another node, of a time that no stamp carries."""

from __future__ import annotations

import array
import copy

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry, Path
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import JointState
from support.control_loop import Loop
from support.planner_flight import NEAR, Flight
from support.ros_harness import Harness

from spacerobot_ros.errors import CommandError, SpaceRobotError
from spacerobot_ros.messages.builders import path_message
from spacerobot_ros.messages.readers import JointReader, UnreadableError
from spacerobot_ros.planning import BasePath
from spacerobot_ros.times import LATEST_NS, first_time_ns, set_stamp, stamp_bytes, stamp_to_ns

LAST = 2**31 - 1
SECOND = 1_000_000_000


def joints(names: list[str], stamp: tuple[int, int] = (1, 0), value: float = 0.5) -> JointState:
    values = [value] * len(names)
    message = JointState(name=names, position=values, velocity=values, effort=values)
    message.header.stamp.sec, message.header.stamp.nanosec = stamp
    return message


def raw(message: object) -> bytes:
    return bytes(serialize_message(message))


def reader() -> JointReader:
    return JointReader(["a", "b"], ["position", "velocity"], measured=True)


# -- stamps -----------------------------------------------------------------------------------


def test_times_up_to_the_last_second_of_stamps_are_carried() -> None:
    last_ns = LAST * SECOND + SECOND - 1
    assert first_time_ns(stamped(*divmod(last_ns, SECOND))) == last_ns
    assert last_ns == LATEST_NS
    stamp = Time()
    for time_ns, carried_ns in (
        (last_ns, last_ns),
        (last_ns + 1, last_ns),
        (10**30, last_ns),
        (5, 5),
    ):
        set_stamp(stamp, time_ns)
        assert stamp_to_ns(stamp) == carried_ns
    stamp_bytes(last_ns)
    with pytest.raises(SpaceRobotError, match=r"Stamps carry .* 2\^31 s.*not 2147483648 s"):
        stamp_bytes(last_ns + 1)


def stamped(sec: int, nanosec: int) -> bytes:
    return raw(joints(["a"], (sec, nanosec)))


@pytest.mark.parametrize("nanosec", [SECOND, 2**32 - 1])
def test_a_state_whose_stamp_no_answer_can_carry_is_refused(nanosec: int) -> None:
    """Seconds and nanoseconds that are more than one sum up to it."""
    read = reader()
    read.accept(raw(joints(["a", "b"], (LAST, SECOND - 1))))
    with pytest.raises(UnreadableError, match="no command can carry its stamp"):
        read.accept(raw(joints(["a", "b"], (LAST, nanosec), value=9.0)))
    assert read.values["position"].tolist() == [0.5, 0.5]
    assert first_time_ns(stamped(LAST, nanosec)) == LAST * SECOND + SECOND - 1
    assert read.accept(raw(joints(["a", "b"], (0, nanosec)))) == nanosec


def test_a_path_that_ends_beyond_all_stamps_ends_at_the_last() -> None:
    path = BasePath(np.array([0.0, 5.0]), np.zeros((2, 3)), np.tile([0.0, 0, 0, 1], (2, 1)))
    message = deserialize_message(path_message(path, LAST * SECOND, "world"), Path)
    assert [pose.header.stamp.sec for pose in message.poses] == [LAST, LAST]


# -- joints -----------------------------------------------------------------------------------


def test_a_message_of_a_million_joints_is_refused_unread() -> None:
    """Taken apart it would hold up a node for a minute and take a gigabyte."""
    many = 1_000_000
    zeros = array.array("d", bytes(8 * many))
    message = JointState(name=[""] * many, position=zeros)
    read = reader()
    read.accept(raw(joints(["a", "b"])))
    with pytest.raises(UnreadableError, match=r"has \d+ bytes, of which at most"):
        read.accept(raw(message))
    assert read.values["position"].tolist() == [0.5, 0.5]


@pytest.mark.parametrize("field", ["name", "velocity"])
def test_a_command_of_many_joints_is_refused_by_its_stamp(field: str) -> None:
    """As the bag of the flight has it refused; its names are not taken apart."""
    command = joints(["a", "b"], (3, 5))
    setattr(command, field, ["c"] * 20_000 if field == "name" else array.array("d", bytes(160_000)))
    read = JointReader(["a", "b"], ["velocity"])
    problem = "20000 entries" if field == "name" else "20000 velocity value"
    again = raw(command)
    for message, refused in (
        (again, True),
        (again, True),
        (raw(joints(["a", "b"], (4, 0))), False),
        (raw(command), True),
    ):
        if refused:
            with pytest.raises(CommandError, match=problem) as refusal:
                read.accept(message)
            assert not isinstance(refusal.value, UnreadableError)
            assert read.stamp_ns == 3 * SECOND + 5
        else:
            assert read.accept(message) == 4 * SECOND


def test_the_joints_of_another_robot_leave_the_state_before() -> None:
    read = reader()
    read.accept(raw(joints(["a", "b"])))
    for act in (read.require, read.accept):
        with pytest.raises(CommandError, match="'c' is unknown"):
            act(raw(joints(["c", "d"], value=9.0)))
        assert read.values["position"].tolist() == [0.5, 0.5]
    assert read.accept(raw(joints(["b", "a"], (2, 0), value=0.25))) == 2 * SECOND
    assert read.values["position"].tolist() == [0.25, 0.25]


def test_beside_another_robot_a_controller_sees_every_pose(harness: Harness) -> None:
    """The other's joint_states come between odom and joint_states, with the same stamp."""
    loop = Loop(harness)
    stranger = loop.probe.create_publisher(JointState, "joint_states", 10)
    harness.matched(stranger)
    alone = loop.answer()
    send = loop.odom.publish
    for number in range(3):

        def publish(message: Odometry, late: int = number % 2) -> None:
            send(message)
            stamp = message.header.stamp
            stranger.publish(joints(["wing"], (stamp.sec, stamp.nanosec + late)))

        loop.odom.publish = publish
        beside = loop.answer()
        np.testing.assert_array_equal(beside[0], alone[0])
        np.testing.assert_array_equal(beside[1], alone[1])
    state = loop.node.commander.states
    assert not state._without_pose


def test_beside_another_robot_a_goal_is_reached(harness: Harness) -> None:
    flight = Flight(harness)
    stranger = flight.probe.create_publisher(JointState, "joint_states", 100)
    harness.matched(stranger)

    def disturb(message: JointState) -> None:
        if list(message.name) != ["wing"]:
            stranger.publish(joints(["wing"], (message.header.stamp.sec, 0)))

    flight.probe.react["joint_states"] = disturb
    flight.send(NEAR)
    flight.start()
    flight.wait("reached")


# -- odom -------------------------------------------------------------------------------------


def test_a_planner_does_not_take_the_pose_of_a_second_node_for_its_own(harness: Harness) -> None:
    """It answers every odom at once with one of the same time, five metres away."""
    flight = Flight(harness)
    stranger = flight.probe.create_publisher(Odometry, "odom", 100)
    harness.matched(stranger)

    def contradict(message: Odometry) -> None:
        if message.pose.pose.position.x < 2:
            other = copy.deepcopy(message)
            other.pose.pose.position.x += 5.0
            stranger.publish(other)

    flight.probe.react["odom"] = contradict
    flight.send(NEAR)
    flight.start()
    flight.wait("reached")
    last = flight.probe.messages["odom"][-4:]
    nearest = min(abs(m.pose.pose.position.x - NEAR[0][0]) for m in last)
    assert nearest < 0.01
