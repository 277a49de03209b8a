"""The coordinated-control node, from outside: flying, gains, goals, managed life."""

from __future__ import annotations

import math
import sys

import numpy as np
import numpy.typing as npt
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from std_msgs.msg import String
from support.control_loop import KD, KP, TICK_NS, TIP, URDF, Loop, pose
from support.ros_harness import LATCHED, Harness, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.control import ControlState, Reference
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.control.state import Actuation
from spacerobot_ros.nodes import FlightNode
from spacerobot_ros.planning import Goal
from spacerobot_ros.testing import Stack

Array = npt.NDArray[np.float64]


def torque_of(base: Array, tip: Array) -> tuple[float, Array]:
    """Return torque and efforts by virtual work of forces (x, y) at the base and at the tip."""
    elbow = np.array([0.5 + math.cos(-1.0), math.sin(-1.0)])
    points = np.array([[0.0, 0.0], [0.5, 0.0], elbow])
    arms = TIP[:2] - points
    moments = arms[:, 0] * tip[1] - arms[:, 1] * tip[0]
    return float(moments[0]), moments[1:]


# -- flying -----------------------------------------------------------------------------------


def test_without_a_goal_the_pose_of_the_first_state_is_held(harness: Harness) -> None:
    loop = Loop(harness)
    wrench, effort = loop.answer()
    np.testing.assert_allclose([*wrench, *effort], 0.0, atol=1e-12)
    assert loop.wait_for("holding").level == DiagnosticStatus.OK
    loop.place = np.array([0.1, -0.2, 0.0])
    wrench, effort = loop.answer()
    pull = -KP * loop.place
    np.testing.assert_allclose(wrench[:3], 2 * pull, atol=1e-12)
    torque, efforts = torque_of(pull[:2], pull[:2])
    np.testing.assert_allclose(wrench[3:], [0.0, 0.0, torque], atol=1e-12)
    np.testing.assert_allclose(effort, efforts, atol=1e-12)
    assert nanoseconds(loop.probe.last("base_wrench").header.stamp) == 2 * TICK_NS


def test_both_goals_are_pursued(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    aim = np.array([0.5, 0.25, 0.0])
    loop.aim(base=pose(aim), end_effector=pose(TIP + np.array([0.0, 1.0, 0.0])))
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], KP * (aim + np.array([0.0, 1.0, 0.0])), atol=1e-12)
    loop.wait_for("tracking")
    assert float(loop.status["error.base.x"]) == pytest.approx(0.5)
    assert float(loop.status["error.end_effector.y"]) == pytest.approx(1.0)


def test_the_status_carries_the_stamp_of_the_goal_as_its_id(harness: Harness) -> None:
    loop = Loop(harness, settle_time=0.0)
    loop.answer()
    loop.wait_for("holding")
    assert "goal_id" not in loop.status
    stamped, later = pose([0.5, 0.0, 0.0]), pose([0.5, 0.0, 0.0], frame="moon")
    stamped.header.stamp.sec, stamped.header.stamp.nanosec = 12, 345
    later.header.stamp.sec = 13
    loop.aim(base=stamped)
    loop.answer()
    loop.wait_for("tracking")
    assert loop.status["goal_id"] == "12.000000345"
    loop.goals["base"].publish(later)
    loop.wait_for("refused")
    assert loop.status["goal_id"] == "13.000000000"
    for n in (1, 2):
        loop.aim(base=pose(np.zeros(3)))
        loop.answer()
        harness.settle(loop.probe)
        assert (loop.status["state"], loop.status["goal_id"]) == ("reached", f"unstamped-{n}")


# -- gains ------------------------------------------------------------------------------------


def test_gains_that_change_in_flight_take_effect(harness: Harness) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]), end_effector=pose(TIP))
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)
    assert loop.set("gains.base_position.kp", 70.0).successful
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, 0.0, 0.0], atol=1e-12)
    loop.velocity = np.array([0.0, 0.5, 0.0])
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, -2 * KD * 0.5, 0.0], atol=1e-12)
    assert loop.set("gains.end_effector_position.kd", 10.0).successful
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, -(KD + 10.0) * 0.5, 0.0], atol=1e-12)


# -- goals ------------------------------------------------------------------------------------


REFUSED: dict[str, tuple[PoseStamped, tuple[str, ...]]] = {
    "wrong frame": (pose([1, 0, 0], frame="moon"), ("goal of the {} is in frame 'moon'", "world")),
    "not a number": (pose([math.nan, 0, 0]), ("finite",)),
    "infinite": (pose([0, math.inf, 0]), ("finite",)),
    "zero quaternion": (pose([1, 0, 0], w=0.0), ("orientation",)),
}


@pytest.mark.parametrize("group", ["base", "end_effector"])
@pytest.mark.parametrize(("goal", "mentions"), REFUSED.values(), ids=REFUSED)
def test_a_bad_goal_is_refused_and_the_earlier_one_goes_on(
    harness: Harness, group: str, goal: PoseStamped, mentions: tuple[str, ...]
) -> None:
    # A position alone will do for an end-effector whose attitude is free, which this one's is not.
    loop = Loop(harness, base_outputs="x y", end_effector_outputs="x y rz")
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    before = loop.answer()[0]
    loop.goals[group].publish(goal)
    status = loop.wait_for("refused")
    assert status.level == DiagnosticStatus.ERROR
    name = group.replace("_", "-")
    assert_one_sentence(status.message, *(each.format(name) for each in mentions))
    np.testing.assert_array_equal(loop.answer()[0], before)
    loop.wait_for("tracking")


class _Failing(TransposedJacobianLaw):
    name = "failing"

    def command(self, state: ControlState, reference: Reference) -> Actuation:
        if self.time > 0.035:
            sys.exit("no model")
        return super().command(state, reference)


def test_a_law_that_fails_is_the_reason_for_the_end_of_its_goal(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(LAWS, "failing", _Failing)
    loop = Loop(harness, law="failing")
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    for _ in range(3):
        loop.answer()
    goal_id = loop.status["goal_id"]
    assert (loop.status["state"], bool(goal_id)) == ("tracking", True)
    loop.show()
    message = loop.wait_for("aborted").message
    assert message.startswith(
        "Aborted: The law 'failing' has failed at 0.04 s: SystemExit: no model"
    )
    assert "deactivated" not in message
    assert loop.status["goal_id"] == goal_id
    loop.harness.spin_until(lambda: not loop.node.is_active, "the node is inactive")


# -- abort, life ------------------------------------------------------------------------------


def test_abort_holds_the_robot_where_it_is(harness: Harness) -> None:
    loop = Loop(harness, settle_time=0.0)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.answer()
    loop.place = np.array([0.25, 0.0, 0.0])
    assert loop.abort().success
    wrench, effort = loop.answer()
    np.testing.assert_allclose([*wrench, *effort], 0.0, atol=1e-12)
    assert loop.wait_for("aborted").level == DiagnosticStatus.WARN


def test_an_inactive_node_commands_nothing_and_then_answers_the_waiting_state(
    harness: Harness,
) -> None:
    loop = Loop(harness, activate=False)
    loop.show()
    loop.goals["base"].publish(pose([1.0, 0.0, 0.0]))
    harness.settle(loop.probe)
    assert loop.probe.count("base_wrench") == loop.probe.count("joint_commands") == 0
    assert not loop.abort().success
    loop.node.trigger_activate()
    harness.spin_until(lambda: loop.probe.count("joint_commands"), "the answer")
    harness.settle(loop.probe)
    wrench, effort = loop.last_command
    # A goal that came to an inactive node was not taken.
    np.testing.assert_allclose([*wrench, *effort], 0.0, atol=1e-12)


def test_goals_are_forgotten_by_a_deactivation(harness: Harness) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    assert loop.answer()[0][0] == pytest.approx(2 * KP)
    loop.node.trigger_deactivate()
    loop.wait_for("aborted")
    count = loop.probe.count("base_wrench")
    loop.place = np.array([0.5, 0.0, 0.0])
    loop.show()
    harness.settle(loop.probe)
    assert loop.probe.count("base_wrench") == count
    loop.node.trigger_activate()
    harness.spin_until(lambda: loop.probe.count("base_wrench") > count, "the answer")
    harness.settle(loop.probe)
    np.testing.assert_allclose(loop.last_command[0], 0.0, atol=1e-12)
    loop.wait_for("holding")


def test_the_robot_is_taken_from_the_description(harness: Harness) -> None:
    loop = Loop(harness, robot="")
    loop.show()
    harness.settle(loop.probe)
    assert loop.probe.count("base_wrench") == 0
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    description.publish(String(data="<robot"))
    harness.settle(loop.probe)
    assert loop.probe.count("base_wrench") == 0
    description.publish(String(data=URDF.read_text("utf-8")))
    harness.spin_until(lambda: loop.probe.count("joint_commands"), "the state that waited")
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(loop.answer()[0][:3], [2 * KP, 0.0, 0.0], atol=1e-12)


def test_another_description_replaces_the_robot_and_ends_its_goal(harness: Harness) -> None:
    """A goal of the robot before is not reached by the one that is there now."""
    loop = Loop(harness, robot="")
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    text = URDF.read_text("utf-8")
    description.publish(String(data=text))
    loop.answer()
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.answer()
    loop.wait_for("tracking")
    description.publish(String(data=text))
    harness.settle(loop.probe)
    assert loop.status["state"] == "tracking", "the same robot again changes nothing"
    description.publish(String(data=text.replace('"shoulder"', '"hip"')))
    assert "another robot" in loop.wait_for("aborted").message
    before = loop.probe.count("joint_commands")
    loop.show(joints=["hip", "elbow"])
    harness.spin_until(lambda: loop.probe.count("joint_commands") > before, "the answer")
    assert list(loop.probe.last("joint_commands").name) == ["hip", "elbow"]
    np.testing.assert_allclose(loop.probe.last("joint_commands").effort, 0.0, atol=1e-12)


FIRST = [1.2, -0.4, 0.2], [0.2, -0.1, 0.8]
SECOND = [0.3, -0.9, 0.6], [-0.4, 0.3, 0.2]
MASS, THRUST = 16.0, 0.4 * np.sqrt(3)
"""Of the cube, kg, and a bound of the force of its thrusters in any direction, N."""


def stamped_pose(node: Node, goal: tuple[list[float], list[float]]) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = "world"
    message.header.stamp = node.get_clock().now().to_msg()
    place, attitude = message.pose.position, message.pose.orientation
    place.x, place.y, place.z = goal[0]
    attitude.x, attitude.y, attitude.z, attitude.w = Rotation.from_rotvec(goal[1]).as_quat()
    return message


def mine(context: rclpy.Context) -> Node:
    return Node("mine", context=context)


def test_a_path_is_flown_pose_by_pose() -> None:
    states: list[Odometry] = []
    poses = [[0.5, -0.3, 0.2, 0.0, 0.0, 0.6, 0.8], [0.1, 0.2, -0.2, 0.0, 0.28, 0.0, 0.96]]
    rates = {"plant": {"tick_rate": 20.0}, "coordinated_control": {"tick_rate": 20.0}}
    rates["coordinated_control"] |= {"plan.duration": 0.0, "plan.time_factor": 1.2}
    nodes = ("plant", "coordinated_control", mine)
    with Stack("free_flyer", nodes, rates, timeout=200.0) as stack:
        stack.nodes["mine"].create_subscription(Odometry, "odom", states.append, 100)
        assert stack.fly_to(goal=Goal.through(poses)).reached
    places = np.array([[p.x, p.y, p.z] for p in (s.pose.pose.position for s in states)])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(stamps(states))
    for aim in poses:
        there = int(np.argmin(np.linalg.norm(places - aim[:3], axis=1)))
        o = states[there].pose.pose.orientation
        assert np.linalg.norm(places[there] - aim[:3]) < 5e-3
        apart = Rotation.from_quat([o.x, o.y, o.z, o.w]).inv() * Rotation.from_quat(aim[3:])
        assert apart.magnitude() < 2e-2
        assert speeds[there - 6 : there + 6].min() < 2e-3


def stamps(states: list[Odometry]) -> np.ndarray:
    return np.array([s.header.stamp.sec + 1e-9 * s.header.stamp.nanosec for s in states])


def test_a_goal_in_flight_is_flown_from_where_the_robot_is_without_a_stop() -> None:
    with Stack("free_flyer", nodes=("plant", "coordinated_control", mine)) as stack:
        node = stack.nodes["mine"]
        states: list[Odometry] = []
        reached: list[str] = []
        node.create_subscription(Odometry, "odom", states.append, 100)
        node.create_subscription(
            DiagnosticStatus,
            "controller/status",
            lambda status: reached.extend(v.key for v in status.values if v.value == "reached"),
            10,
        )
        goals = node.create_publisher(PoseStamped, "goal_pose", 10)
        for name in ("coordinated_control", "plant"):
            flown = stack.nodes[name]
            assert isinstance(flown, FlightNode)
            flown.require_transition(flown.trigger_activate)
        stack.spin_until(lambda: bool(states) and goals.get_subscription_count() > 0)
        goals.publish(stamped_pose(node, FIRST))
        stack.spin_until(lambda: states[-1].pose.pose.position.x > 0.4)
        flying = len(states)
        goals.publish(stamped_pose(node, SECOND))
        stack.spin_until(lambda: bool(reached))
    place, attitude = (
        states[-1].pose.pose.position,
        states[-1].pose.pose.orientation,
    )
    assert np.linalg.norm(np.array([place.x, place.y, place.z]) - SECOND[0]) < 5e-3
    ended = Rotation.from_quat([attitude.x, attitude.y, attitude.z, attitude.w])
    assert (ended.inv() * Rotation.from_rotvec(SECOND[1])).magnitude() < 1e-2
    twists = [each.twist.twist for each in states]
    omega = np.array([[t.angular.x, t.angular.y, t.angular.z] for t in twists])
    speeds = np.linalg.norm([[t.linear.x, t.linear.y, t.linear.z] for t in twists], axis=1)
    # The second motion begins at the speed of the first: it does not brake to rest before.
    assert speeds[flying] > 0.02
    assert speeds[flying : flying + 100].min() > 0.2 * speeds[flying]
    assert np.linalg.norm(omega[-1]) < 1e-2
    changes = np.abs(np.diff(speeds)) / np.diff(stamps(states))
    assert changes.max() < THRUST / MASS * 1.5
