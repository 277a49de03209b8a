"""Goals, paths and twists of end-effectors, and obstacles on their way."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TwistStamped
from nav_msgs.msg import Path as PathMessage
from nodes.test_verified_flights import Flight as RecordedFlight
from planning.test_given_paths import distance_from
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from support.hand_motion import end_of_motion
from support.oracles import PinocchioOracle
from support.planner_flight import Array, Flight, joint_values, position_goal, values_of
from support.ros_harness import LATCHED, Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.flight.reading import open_flight_bag, read_flight
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.nodes.common.messages import path_poses
from spacerobot_ros.report import write_report
from spacerobot_ros.resources import robot_file
from spacerobot_ros.topics import link_topic

URDF = robot_file("three_joint_arm").read_text("utf-8")
NAMES = ("shoulder_yaw", "shoulder_pitch", "elbow_pitch")
START, END = [0.4, -0.9, 1.1], [-0.2, -0.5, 1.6]
PLACE, ATTITUDE = [0.4, -0.3, 0.2], Rotation.from_rotvec([0.3, -0.5, 0.4])
TOLERANCE = 1e-6


def flight_of(harness: Harness, **planner: object) -> Flight:
    quick = {"optimal.answers": 1, "optimal.intervals": 30, "optimal.cache": 0}
    near = {"position_tolerance": TOLERANCE, "attitude_tolerance": TOLERANCE}
    start = {
        "initial_joint_positions": START,
        "initial_position": PLACE,
        "initial_orientation": ATTITUDE.as_quat().tolist(),
    }
    robot = {"robot": "three_joint_arm"}
    return Flight(
        harness,
        {**robot, **quick, **near, "method": "optimal", "end_effectors": ["link_3"], **planner},
        {**robot, **start},
    )


def end_of(shapes: Array, link: str) -> Array:
    """Return where a link is after shapes (N, n) of the arm."""
    return end_of_motion(URDF, NAMES, shapes, [link], PLACE, ATTITUDE)[link][0]


def reachable(link: str, end: npt.ArrayLike = END) -> Array:
    return end_of(START + np.linspace(0, 1, 40)[:, np.newaxis] * np.subtract(end, START), link)


def flown_to(flight: Flight, link: str) -> Array:
    """Return where the joint states that were published put a link."""
    return end_of(joint_values(flight.probe.messages["joint_states"], NAMES), link)


def await_reached(flight: Flight, goal_id: str) -> None:
    def is_reached() -> bool:
        found = [values_of(each) for each in flight.probe.messages["planner/status"]]
        return any(v.get("goal_id") == goal_id and v["state"] == "reached" for v in found)

    flight.harness.spin_until(is_reached, f"goal {goal_id} is reached")


def test_positions_on_the_topics_of_links_are_reached_one_after_the_other(harness: Harness) -> None:
    flight = flight_of(harness)
    aims = {
        "end_effector": reachable("end_effector"),
        "link_3": reachable("link_3", [0.5, -1.2, 0.6]),
    }
    topics = {
        link: flight.probe.create_publisher(PoseStamped, link_topic(link, "goal_pose"), 10)
        for link in aims
    }
    harness.connect()
    flight.start()
    for number, (link, aim) in enumerate(aims.items(), 1):
        message = position_goal(aim, number)
        if link == "link_3":  # NaN asks for no attitude either.
            o = message.pose.orientation
            o.x = o.y = o.z = o.w = np.nan
        topics[link].publish(message)
        await_reached(flight, f"{number}.000000000")
        np.testing.assert_allclose(flown_to(flight, link), aim, atol=1e-6)
        values = values_of(flight.probe.last("planner/status"))
        assert [float(x) for x in values[f"goal_of_{link}"].split()] == [
            float(f"{x:.9g}") for x in aim
        ]
        assert float(values["end_effector_position_error_m"]) <= TOLERANCE
        assert "goal" not in values, "the base is free"
        assert "position_error_m" not in values
    topics["link_3"].publish(position_goal(np.full(3, np.nan), 3))
    assert_one_sentence(flight.wait("refused").message, "'link_3' has no position", "NaN")


def test_goals_of_one_stamp_are_one_goal(harness: Harness) -> None:
    flight = flight_of(harness)
    hand = flight.probe.create_publisher(PoseStamped, "end_effector/goal_pose", 10)
    link = flight.probe.create_publisher(PoseStamped, "link_3/goal_pose", 10)
    harness.connect()
    # Each could be reached, in another shape than the other.
    hand.publish(position_goal(reachable("end_effector"), 7))
    link.publish(position_goal(reachable("link_3", [0.5, -1.2, 0.6]), 7))
    harness.settle(flight.probe)
    flight.start()
    status = flight.wait("refused")
    assert values_of(status)["goal_id"] == "7.000000000"
    assert_one_sentence(status.message, "'end_effector' and 'link_3'", "independent coordinates")
    # Both parts are bound to each other; one alone is no such goal.
    hand.publish(position_goal(reachable("end_effector"), 8))
    assert values_of(flight.wait("reached"))["goal_id"] == "8.000000000"
    aims = {each: reachable(each, [0.3, -1.0, 0.9]) for each in ("end_effector", "link_3")}
    hand.publish(position_goal(aims["end_effector"], 9))
    link.publish(position_goal(aims["link_3"], 9))
    await_reached(flight, "9.000000000")
    for each, aim in aims.items():
        np.testing.assert_allclose(flown_to(flight, each), aim, atol=1e-6)


def test_a_planner_for_a_controller_leaves_the_end_effector_to_it(harness: Harness) -> None:
    flight = flight_of(harness, output="reference", end_effectors=[])
    assert flight.probe.count_subscribers("end_effector/goal_pose") == 0


HAND = "end_effector"
ORIGIN = end_of(np.array([START]), HAND)
"""Where the hand is at the start, m."""

WAY = np.array([[0.05, 0.0, 0.02], [0.12, -0.1, 0.03], [0.12, -0.15, 0.08]])
"""From there, m."""


def path_through(positions: npt.ArrayLike, sec: int = 0, frame: str = "world") -> PathMessage:
    """Return a path of positions (K, 3); the orientations of zeros ask for no attitude."""
    message = PathMessage()
    message.header.frame_id, message.header.stamp.sec = frame, sec
    for x, y, z in np.reshape(positions, (-1, 3)).astype(float).tolist():
        each = PoseStamped()
        p, o = each.pose.position, each.pose.orientation
        p.x, p.y, p.z, o.w = x, y, z, 0.0
        message.poses.append(each)
    return message


def test_a_path_on_a_topic_is_followed_and_another_takes_its_place(harness: Harness) -> None:
    flight = flight_of(
        harness,
        method="auto",
        **{"resolved_rate.corner_tolerance": 0.01, "resolved_rate.ramp_time": 0.3},
    )
    sender = flight.probe.create_publisher(PathMessage, "end_effector/path", 10)
    harness.connect()
    flight.start()
    for message, said in (
        (path_through([]), "The path of 'end_effector' has no poses."),
        (
            path_through([ORIGIN, ORIGIN * np.nan]),
            "Pose 2 of the path of 'end_effector' is invalid",
        ),
        (
            path_through(ORIGIN + WAY, frame="moon"),
            "is in frame 'moon'; goals are accepted in 'world'",
        ),
    ):
        flight.probe.messages["planner/status"].clear()
        sender.publish(message)
        assert_one_sentence(flight.wait("refused").message, said)
    sender.publish(path_through(ORIGIN + WAY, 3))

    def executing() -> list[DiagnosticStatus]:
        found = flight.probe.messages["planner/status"]
        return [each for each in found if values_of(each)["state"] == "executing"]

    harness.spin_until(lambda: bool(executing()), "the path is followed")
    values = values_of(executing()[0])
    assert (values["method"], values["waypoints_of_end_effector"]) == ("resolved_rate", "2")
    assert values["goal_of_end_effector"].split() == [f"{x:.9g}" for x in ORIGIN + WAY[-1]]
    await_reached(flight, "3.000000000")
    lines = np.vstack([ORIGIN, ORIGIN + WAY])
    shapes = joint_values(flight.probe.messages["joint_states"], NAMES)
    ends = range(1, len(shapes) + 1, 3)
    off = [distance_from(lines, end_of(shapes[:k], HAND)) for k in ends]
    assert 1e-4 < max(off) < 0.01
    # The next path begins elsewhere; it is replaced while the hand moves to its first pose.
    sender.publish(path_through(ORIGIN + WAY + 0.05, 4))
    harness.spin_until(lambda: len(executing()) > 1, "the second path is followed")
    sender.publish(path_through([ORIGIN + WAY[1], ORIGIN + WAY[0]], 5))
    await_reached(flight, "5.000000000")
    np.testing.assert_allclose(flown_to(flight, HAND), ORIGIN + WAY[0], atol=TOLERANCE)
    decided = [values_of(each) for each in flight.probe.messages["planner/status"]]
    assert {v["goal_id"] for v in decided if v["state"] == "reached"} == {
        "3.000000000",
        "5.000000000",
    }


# -- messages -----------------------------------------------------------------------------------


def test_poses_of_a_path_are_moved_from_their_own_frames() -> None:
    message = path_through([[1, 2, 3], [4, 5, 6], [7, 8, 9]], frame="/world")
    message.poses[1].header.frame_id = "hub"
    turns = Rotation.from_rotvec([[0.1, 0.2, 0.3], [0.3, 0.0, -0.4], [0.0, 0.7, 0.0]])
    for each, (x, y, z, w) in zip(message.poses, turns.as_quat().tolist(), strict=True):
        o = each.pose.orientation
        o.x, o.y, o.z, o.w = x, y, z, w
    hub = np.array([0.5, -1.0, 2.0, *Rotation.from_rotvec([0.2, -0.6, 0.4]).as_quat()])
    found = path_poses(message, "world", "The path", {"hub": hub}.get)
    np.testing.assert_allclose(found[[0, 2], :3], [[1, 2, 3], [7, 8, 9]])
    np.testing.assert_allclose(
        found[1, :3], hub[:3] + Rotation.from_quat(hub[3:]).apply([4, 5, 6]), atol=1e-12
    )
    wanted = [turns[0], Rotation.from_quat(hub[3:]) * turns[1], turns[2]]
    for row, each in zip(found[:, 3:], wanted, strict=True):
        assert (each.inv() * Rotation.from_quat(row)).magnitude() < 1e-12


def test_orientations_of_zeros_ask_for_positions_alone() -> None:
    message = path_through([[1, 2, 3], [4, 5, 6]])
    np.testing.assert_array_equal(path_poses(message, "world", "It"), [[1, 2, 3], [4, 5, 6]])
    message.poses[0].pose.orientation.w = 2.0
    np.testing.assert_array_equal(
        path_poses(message, "world", "It"), [[1, 2, 3, 0, 0, 0, 2], [4, 5, 6, 0, 0, 0, 0]]
    )
    assert path_poses(path_through([]), "world", "It").shape == (0, 3)


def test_stamps_may_be_left_out_and_go_on_but_not_back() -> None:
    message = path_through([[1, 2, 3], [4, 5, 6], [7, 8, 9]])
    for each, (sec, nanosec) in zip(
        message.poses, ((2, 500_000_000), (2, 500_000_000), (3, 0)), strict=True
    ):
        each.header.stamp.sec, each.header.stamp.nanosec = sec, nanosec
    assert len(path_poses(message, "world", "It")) == 3
    message.poses[2].header.stamp.sec = 1
    message.poses[2].header.stamp.nanosec = 250_000_000
    with pytest.raises(PlanningError) as refusal:
        path_poses(message, "world", "The path")
    assert_one_sentence(
        str(refusal.value),
        "The path goes back in time: pose 3 is stamped 1.25 s, after 2.5 s; omit the "
        "stamps, or sort the poses by time.",
    )
    far = path_through([[1, 2, 3]], frame="moon")
    with pytest.raises(
        PlanningError, match=r"^It is in frame .moon.; goals are accepted in .world."
    ):
        path_poses(far, "world", "It")


LINEAR = np.array([0.01, -0.03, 0.02])


def twist(frame: str = "world", linear: object = LINEAR) -> TwistStamped:
    message = TwistStamped()
    message.header.frame_id = frame
    v = message.twist.linear
    v.x, v.y, v.z = np.asarray(linear, dtype=float).tolist()
    return message


def test_twists_on_a_topic_move_the_hand_until_they_stop(harness: Harness) -> None:
    flight = flight_of(harness, twist_timeout=0.4, **{"resolved_rate.max_acceleration": [1.0] * 3})
    sender = flight.probe.create_publisher(TwistStamped, "end_effector/twist", 10)
    harness.connect()
    flight.start()
    heard = flight.probe.messages
    sender.publish(twist("map"))
    for _ in range(12):
        sender.publish(twist())
        flight.ticks(2)
    harness.spin_until(
        lambda: values_of(flight.probe.last("planner/status"))["state"] == "idle", "rest"
    )
    flight.ticks(2)
    statuses = [(values_of(each)["state"], each.message) for each in heard["planner/status"]]
    assert ("teleoperating", "'end_effector' follows twists.") in statuses
    assert statuses[-1] == ("idle", "No more twists arrive: the joints are at rest.")
    oracle = PinocchioOracle(URDF, NAMES)
    commands = joint_values(heard["joint_commands"], NAMES, "velocity")
    states = joint_values(heard["joint_states"], NAMES)
    fastest = int(np.abs(commands).max(axis=1).argmax())
    q, rates = (states[fastest] + states[fastest + 1]) / 2, commands[fastest]
    u = oracle.joint_velocities(rates)
    u[:6] = -oracle.connection(q) @ rates
    before, after = (heard["odom"][fastest + k].pose.pose.orientation for k in (0, 1))
    attitude = [getattr(before, x) + getattr(after, x) for x in "xyzw"]
    oracle.set_configuration(q, Rotation.from_quat(attitude).as_quat(), np.zeros(3))
    moved = (oracle.frame_jacobian_W("end_effector") @ u)[:3]
    np.testing.assert_allclose(moved, LINEAR, atol=1e-5)
    assert commands[-1].tolist() == [0.0, 0.0, 0.0]


def box_at(position: Array) -> String:
    """Return a URDF with a cube of 6 cm about a place in the world."""
    xyz = " ".join(map(repr, position.tolist()))
    return String(
        data='<robot name="w"><link name="w"/><link name="crate"><collision><geometry>'
        '<box size="0.06 0.06 0.06"/></geometry></collision></link>'
        f'<joint name="j" type="fixed"><parent link="w"/><child link="crate"/>'
        f'<origin xyz="{xyz}"/></joint></robot>'
    )


def test_obstacles_that_come_in_flight_stop_it_and_may_go_again(harness: Harness) -> None:
    flight = flight_of(
        harness,
        method="resolved_rate",
        abort_time=0.3,
        **{"resolved_rate.max_velocity": [0.06] * 3},
    )
    probe = flight.probe
    goals = probe.create_publisher(PoseStamped, "end_effector/goal_pose", 10)
    obstacles = probe.create_publisher(String, "obstacles", LATCHED)
    probe.watch("clearance", DiagnosticStatus)
    harness.connect()
    flight.start()
    goal = np.add(ORIGIN, [0.14, -0.12, 0.05])
    goals.publish(position_goal(goal, 1))
    flight.wait("executing")
    obstacles.publish(box_at(goal))
    status = flight.wait("failed")
    said = [each.message for each in probe.messages["planner/status"]]
    (braking,) = [each for each in said if "the joints brake" in each]
    assert braking.startswith("Link '")
    assert "and obstacle 'crate' " in braking
    assert braking.endswith(": the joints brake, and the remaining motion is replanned.")
    assert "The goal is not reached: " in status.message
    assert "On the way link '" in status.message
    assert "planner.clearance is 0.01 m" in status.message
    # The plant measures the distance to the crate, and the hand has stopped before it.
    flight.ticks(21)
    near = values_of(probe.last("clearance"))
    assert (near["second"], near["second_is"]) == ("crate", "obstacle")
    assert float(near["distance"]) > 0.01
    # Without obstacles the goal is reached.
    obstacles.publish(String(data=""))
    flight.ticks(2)
    goals.publish(position_goal(goal, 2))
    assert values_of(flight.wait("reached"))["goal_id"] == "2.000000000"
    flight.ticks(21)
    assert "second_is" not in values_of(probe.last("clearance"))


@pytest.mark.slow
def test_a_bag_whose_obstacles_changed_is_verified_and_reported(
    harness: Harness, tmp_path: Path
) -> None:
    names = ["slider_1", "slider_2", "slider_3"]

    def answer(tick: int) -> Sequence[Any]:
        if tick in (13, 37):
            obstacles.publish(box_at(np.array([0.01 * tick, 0.0, 0.2])))
        flight.recorder.scan()
        return [JointState(name=names, velocity=[0.1, -0.05, 0.02])]

    plant = {"robot": "sliding_masses", "tick_rate": 20.0, "linear_momentum": [0.1, 0.0, -0.2]}
    flight = RecordedFlight(harness, tmp_path / "flown.mcap", plant, answer)
    obstacles = flight.probe.create_publisher(String, "obstacles", LATCHED)

    def heard() -> bool:
        flight.recorder.scan()
        return "/obstacles" in flight.recorder.topics

    harness.spin_until(heard, "the recorder hears obstacles")
    path = flight.fly()
    result = verify_bag(path)
    assert result.difference is None
    assert result.largest < 1e-12
    bag = open_flight_bag(path)
    assert bag.obstacles_change
    world = bag.obstacles[-1][1]
    assert world is not None
    np.testing.assert_allclose(world.frames["crate"][1].r, [0.37, 0.0, 0.2])
    assert read_flight(bag).clearance is None
    distances = [values_of(message) for _, message in bag.messages("clearance")]
    assert {each.get("second") for each in distances if "second_is" in each} == {"crate"}
    write_report(path, tmp_path / "report.html")
    assert "/obstacle 0 crate" in (tmp_path / "report.html").read_text("utf-8")
