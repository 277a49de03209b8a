"""Twists on topics: the hand moves so by Pinocchio, and the joints brake when they stop."""

from __future__ import annotations

import numpy as np
import pytest
from geometry_msgs.msg import TwistStamped
from nodes.test_end_effector_goals import NAMES, URDF, flight_of, place, reachable
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.planner_flight import values_of
from support.ros_harness import Harness

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
    assert statuses[-1] == ("idle", "No twists come any more: the joints rest.")
    oracle = PinocchioOracle(URDF.read_text("utf-8"), NAMES)
    commands = [
        np.array([dict(zip(m.name, m.velocity, strict=True))[name] for name in NAMES])
        for m in heard["joint_commands"]
    ]
    states = [
        np.array([dict(zip(m.name, m.position, strict=True))[name] for name in NAMES])
        for m in heard["joint_states"]
    ]
    fastest = int(np.argmax([np.abs(rates).max() for rates in commands]))
    q, rates = (states[fastest] + states[fastest + 1]) / 2, commands[fastest]
    u = oracle.joint_velocities(rates)
    u[:6] = -oracle.connection(q) @ rates
    before, after = (heard["odom"][fastest + k].pose.pose.orientation for k in (0, 1))
    attitude = [getattr(before, x) + getattr(after, x) for x in "xyzw"]
    oracle.set_configuration(q, Rotation.from_quat(attitude).as_quat(), np.zeros(3))
    moved = (oracle.frame_jacobian_W("end_effector") @ u)[:3]
    np.testing.assert_allclose(moved, LINEAR, atol=1e-5)
    assert commands[-1].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.slow
def test_a_goal_ends_the_twists(harness: Harness) -> None:
    flight = flight_of(harness)
    sender = flight.probe.create_publisher(TwistStamped, "end_effector/twist", 10)
    goals = flight.probe.create_publisher(
        type(place([0.0, 0.0, 0.0])), "end_effector/goal_pose", 10
    )
    harness.connect()
    flight.start()
    sender.publish(twist("base_link"))

    def states() -> list[str]:
        return [values_of(each)["state"] for each in flight.probe.messages["planner/status"]]

    harness.spin_until(lambda: "teleoperating" in states(), "the twist is followed")
    goals.publish(place(reachable("end_effector"), 3))
    harness.spin_until(lambda: "reached" in states(), "the goal is reached")
    assert states()[-1] == "reached"
    assert states().index("teleoperating") < states().index("executing")
