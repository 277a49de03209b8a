"""The coordinated-control node, from outside: flying, gains, goals, gaps, managed life."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from scipy.spatial.transform import Rotation
from std_msgs.msg import String
from support.control_loop import KD, KP, STATUS, TICK_NS, TIP, URDF, Loop, pose
from support.executive_loop import STEP, Array
from support.planner_flight import goal_at, pose_arrays, stamp_of
from support.ros_harness import LATCHED, Harness, construction, nanoseconds
from support.sentences import assert_one_sentence

from spacerobot_ros.control import ControlState, Reference
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.control.state import Actuation
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.nodes import CoordinatedControlNode, FlightNode, PlannerNode
from spacerobot_ros.planning import Goal
from spacerobot_ros.testing import Stack


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


def test_both_goals_are_pursued_and_gains_that_change_in_flight_take_effect(
    harness: Harness,
) -> None:
    loop = Loop(harness)
    loop.answer()
    aim = np.array([0.5, 0.25, 0.0])
    loop.aim(base=pose(aim), end_effector=pose(TIP + np.array([0.0, 1.0, 0.0])))
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], KP * (aim + np.array([0.0, 1.0, 0.0])), atol=1e-12)
    loop.wait_for("tracking")
    assert float(loop.status["error.base.x"]) == pytest.approx(0.5)
    assert float(loop.status["error.end_effector.y"]) == pytest.approx(1.0)
    loop.aim(base=pose([1.0, 0.0, 0.0]), end_effector=pose(TIP))
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)
    assert loop.set("gains.base_position.kp", 70.0).successful
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, 0.0, 0.0], atol=1e-12)
    loop.velocity = np.array([0.0, 0.5, 0.0])
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, -2 * KD * 0.5, 0.0], atol=1e-12)
    assert loop.set("gains.end_effector_position.kd", 10.0).successful
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, -(KD + 10.0) * 0.5, 0.0], atol=1e-12)


REFUSED: dict[str, tuple[PoseStamped, tuple[str, ...]]] = {
    "wrong frame": (pose([1, 0, 0], frame="moon"), ("goal of the {} is in frame 'moon'", "world")),
    "not a number": (pose([math.nan, 0, 0]), ("finite",)),
    "infinite": (pose([0, math.inf, 0]), ("finite",)),
    "zero quaternion": (pose([1, 0, 0], w=0.0), ("orientation",)),
}


@pytest.mark.parametrize(
    ("group", "case"), [*(("base", case) for case in REFUSED), ("end_effector", "wrong frame")]
)
def test_a_bad_goal_is_refused_and_the_earlier_one_goes_on(
    harness: Harness, group: str, case: str
) -> None:
    goal, mentions = REFUSED[case]
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


def test_an_earlier_goal_is_not_logged_again_after_a_refusal(
    harness: Harness, capfd: pytest.CaptureFixture[str]
) -> None:
    loop = Loop(harness, settle_time=0.0)
    loop.aim(base=pose(np.zeros(3)))
    loop.answer()
    said = loop.wait_for("reached").message
    loop.goals["base"].publish(pose([1.0, 0.0, 0.0], frame="moon"))
    loop.wait_for("refused")
    loop.answer()
    loop.wait_for("reached")
    logged = capfd.readouterr().err
    assert (logged.count(said), logged.count("in frame 'moon'")) == (1, 1)


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
    assert loop.trigger("abort").success
    wrench, effort = loop.answer()
    np.testing.assert_allclose([*wrench, *effort], 0.0, atol=1e-12)
    assert loop.wait_for("aborted").level == DiagnosticStatus.WARN


def test_an_inactive_node_forgets_goals_and_then_answers_the_waiting_state(
    harness: Harness,
) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    assert loop.answer()[0][0] == pytest.approx(2 * KP)
    loop.node.trigger_deactivate()
    loop.wait_for("aborted")
    commands = {topic: loop.probe.count(topic) for topic in ("base_wrench", "joint_commands")}
    loop.place = np.array([0.5, 0.0, 0.0])
    loop.show()
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    assert {topic: loop.probe.count(topic) for topic in commands} == commands
    assert not loop.trigger("abort").success
    loop.node.trigger_activate()
    harness.spin_until(
        lambda: loop.probe.count("joint_commands") > commands["joint_commands"], "the answer"
    )
    harness.settle(loop.probe)
    np.testing.assert_allclose(np.concatenate(loop.last_command), 0.0, atol=1e-12)
    loop.wait_for("holding")


def test_the_robot_is_taken_from_the_description_and_replaced_by_another(harness: Harness) -> None:
    """A goal of the robot before is not reached by the one that is there now."""
    loop = Loop(harness, robot="")
    loop.show()
    harness.settle(loop.probe)
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    description.publish(String(data="<robot"))
    harness.settle(loop.probe)
    assert loop.probe.count("base_wrench") == 0
    text = URDF.read_text("utf-8")
    description.publish(String(data=text))
    harness.spin_until(lambda: loop.probe.count("joint_commands"), "the state that waited")
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(loop.answer()[0][:3], [2 * KP, 0.0, 0.0], atol=1e-12)
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


def mine(context: rclpy.Context) -> Node:
    return Node("mine", context=context)


@pytest.mark.slow
def test_a_path_is_flown_pose_by_pose() -> None:
    states: list[Odometry] = []
    poses = [[0.5, -0.3, 0.2, 0.0, 0.0, 0.6, 0.8], [0.1, 0.2, -0.2, 0.0, 0.28, 0.0, 0.96]]
    rates = {"plant": {"tick_rate": 20.0}, "coordinated_control": {"tick_rate": 20.0}}
    rates["coordinated_control"] |= {"plan.duration": 0.0, "plan.time_factor": 1.2}
    nodes = ("plant", "coordinated_control", mine)
    with Stack("free_flyer", nodes, rates, timeout=200.0) as stack:
        stack.nodes["mine"].create_subscription(Odometry, "odom", states.append, 100)
        assert stack.fly_to(goal=Goal.through(poses)).reached
    places = np.array([pose_arrays(s.pose.pose)[0] for s in states])
    speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(stamps(states))
    for aim in poses:
        there = int(np.argmin(np.linalg.norm(places - aim[:3], axis=1)))
        _, attitude = pose_arrays(states[there].pose.pose)
        assert np.linalg.norm(places[there] - aim[:3]) < 5e-3
        assert (attitude.inv() * Rotation.from_quat(aim[3:])).magnitude() < 2e-2
        assert speeds[there - 6 : there + 6].min() < 2e-3


def stamps(states: list[Odometry]) -> np.ndarray:
    return np.array([stamp_of(state) / 1e9 for state in states])


@pytest.mark.slow
def test_a_goal_in_flight_is_flown_from_where_the_robot_is_without_a_stop() -> None:
    quick = {"coordinated_control": {"plan.intervals": 15}}
    with Stack("free_flyer", ("plant", "coordinated_control", mine), quick) as stack:
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
        stack.start()
        stack.spin_until(lambda: bool(states))
        goals.publish(goal_at(FIRST))
        stack.spin_until(lambda: states[-1].pose.pose.position.x > 0.4)
        flying = len(states)
        goals.publish(goal_at(SECOND))
        stack.spin_until(lambda: bool(reached))
    place, attitude = pose_arrays(states[-1].pose.pose)
    assert np.linalg.norm(place - SECOND[0]) < 5e-3
    assert (attitude.inv() * Rotation.from_rotvec(SECOND[1])).magnitude() < 1e-2
    twists = [each.twist.twist for each in states]
    omega = np.array([[t.angular.x, t.angular.y, t.angular.z] for t in twists])
    speeds = np.linalg.norm([[t.linear.x, t.linear.y, t.linear.z] for t in twists], axis=1)
    # The second motion begins at the speed of the first: it does not brake to rest before.
    assert speeds[flying] > 0.02
    assert speeds[flying : flying + 100].min() > 0.2 * speeds[flying]
    assert np.linalg.norm(omega[-1]) < 1e-2
    changes = np.abs(np.diff(speeds)) / np.diff(stamps(states))
    assert changes.max() < THRUST / MASS * 1.5


# -- gaps in what is measured ---------------------------------------------------------------------


def test_without_odom_the_base_is_estimated_and_then_the_thrusters_are_off(
    harness: Harness,
) -> None:
    loop = Loop(harness, estimation_time=0.05)
    loop.aim(base=pose([1.0, 0.0, 0.0]), end_effector=pose(TIP))
    loop.answer()
    loop.wait_for("tracking")
    # The first state without odom is known to be one when the next joints come; those are answered
    # at once, and so are all that follow.
    loop.show(odom=False)
    harness.settle(loop.probe)
    for _ in range(4):
        loop.answer(odom=False)
        assert nanoseconds(loop.probe.last("base_wrench").header.stamp) == loop.tick * TICK_NS
        assert loop.wait_for("estimating").level == DiagnosticStatus.WARN
    loop.show(odom=False)
    harness.spin_until(lambda: loop.status["state"] == "stopped", "the stop")
    assert loop.probe.last(STATUS).level == DiagnosticStatus.ERROR
    np.testing.assert_array_equal(loop.answer(odom=False)[0], np.zeros(6))
    loop.show(odom=True)
    harness.spin_until(lambda: loop.status["state"] == "tracking", "the loop again")
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], [KP, 0.0, 0.0], atol=1e-12)


class Referenced(Loop):
    """A loop in which somebody publishes a reference of the base before the node is active."""

    def __init__(self, harness: Harness, **settings: Any) -> None:
        super().__init__(harness, activate=False, **settings)
        self.references = self.probe.create_publisher(Odometry, "base_reference", 10)
        harness.spin_until(lambda: self.node.count_publishers("base_reference"), "its discovery")
        harness.connect()
        assert self.node.trigger_activate() is TransitionCallbackReturn.SUCCESS

    def refer(self, tick: int, speed: float) -> None:
        """Publish the pose of the robot turned by 90 deg about z, moving along its own x."""
        message = Odometry()
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(tick * TICK_NS, 10**9)
        message.pose.pose.orientation.z = message.pose.pose.orientation.w = math.sqrt(0.5)
        message.twist.twist.linear.x = speed
        self.references.publish(message)

    def force(self, speed: float) -> Array:
        """Show a state and its reference; return the force on the base."""
        before = self.probe.count("joint_commands")
        self.show()
        self.harness.settle(self.probe)
        assert self.probe.count("joint_commands") == before, "it waits for the reference"
        self.refer(self.tick, speed)
        # The wrench is published first.
        self.harness.spin_until(lambda: self.probe.count("joint_commands") > before, "a command")
        return self.last_command[0][:3]


def test_a_moving_reference_is_waited_for_and_moves_along_its_own_axes(harness: Harness) -> None:
    loop = Referenced(harness)
    still, moving = loop.force(0.0), loop.force(0.2)
    # Its x is the y of the world, along which the robot has to be pushed.
    push = moving - still
    assert push[1] > 0.1 * 0.2 * KD
    np.testing.assert_allclose(push[[0, 2]], 0.0, atol=1e-9)


def test_a_silent_reference_is_done_without_until_it_comes_again(harness: Harness) -> None:
    """A plant in lockstep: its time stands still until each state is answered."""
    loop = Referenced(harness, reference_timeout=0.3)
    # Its publisher has sent nothing yet.
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-9)
    said = " There is no reference on base_reference."
    harness.spin_until(lambda: loop.probe.last(STATUS).message.endswith(said), "a status")
    assert loop.status["state"] == "holding"
    loop.place = np.array([0.1, 0.0, 0.0])
    assert abs(loop.answer()[0][0]) > 1.0, "the pose of the first state is held, without a delay"
    loop.refer(loop.tick, 0.0)
    harness.settle(loop.probe)
    assert abs(loop.force(0.2)[1]) > 0.1 * 0.2 * KD
    harness.spin_until(
        lambda: loop.probe.last(STATUS).message.startswith("Following references; "), "a status"
    )
    # It is silent again: the robot holds where it is.
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-9)
    harness.spin_until(
        lambda: loop.probe.last(STATUS).message.startswith("Waiting for a goal; holding, 0 m"),
        "a status",
    )


def test_a_node_that_is_activated_again_or_killed_goes_on(harness: Harness, file: Path) -> None:
    """Another node in its place may be told the robot later."""
    loop = Loop(harness, resume_file=str(file))
    loop.aim(base=pose([0.5, 0.25, 0.0]))
    before, _ = loop.answer()
    loop.node.trigger_deactivate()
    loop.node.trigger_activate()
    np.testing.assert_allclose(loop.answer()[0], before, atol=1e-12)
    # Without any of its cleanup, when it hears nothing any more.
    harness.executor.remove_node(loop.node)
    harness.settle(loop.probe)
    harness.remove(loop.node)
    settings = {"tick_rate": 100.0, "status_period": 0.01, **STEP, "resume_file": str(file)}
    loop.node = harness.make(CoordinatedControlNode, settings, name="control")
    harness.connect()
    loop.show()
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    count = loop.probe.count("joint_commands")
    description.publish(String(data=URDF.read_text("utf-8")))
    harness.spin_until(lambda: loop.probe.count("joint_commands") > count, "the answer")
    harness.settle(loop.probe)
    np.testing.assert_allclose(loop.last_command[0], before, atol=1e-12)


def written(name: str = "base", **values: Any) -> str:
    goal = {"position": [0, 0, 0], "quaternion": [0, 0, 0, 1], "joint_positions": None}
    return json.dumps({name: {**goal, **values}})


@pytest.mark.parametrize("node", [CoordinatedControlNode, PlannerNode])
def test_a_file_that_holds_no_goal_is_refused(
    harness: Harness, file: Path, node: type[FlightNode]
) -> None:
    file.write_text("{}")
    parameters = {"robot": "planar_manipulator", "resume_file": str(file)}
    with pytest.raises(ParameterError) as refusal:
        node(**construction(harness.context, parameters))
    assert_one_sentence(str(refusal.value), "resume_file", str(file), "no valid goals")


@pytest.mark.parametrize(
    ("content", "settings", "mentions"),
    [
        (written("end_effector"), {"law": "computed_torque"}, ("computed_torque", "end-effector")),
        (written(joint_positions=[0.0] * 3), {}, ("3 joint positions", "planar_manipulator", "2")),
    ],
)
def test_goals_of_another_robot_or_law_are_refused(
    harness: Harness, file: Path, content: str, settings: dict[str, str], mentions: tuple[str, ...]
) -> None:
    file.write_text(content)
    parameters = {"robot": "planar_manipulator", "resume_file": str(file), **settings}
    with pytest.raises(ParameterError) as refusal:
        CoordinatedControlNode(**construction(harness.context, parameters))
    assert_one_sentence(str(refusal.value), "resume_file", *mentions)


def test_a_robot_that_comes_later_and_cannot_go_on_says_so_and_holds(
    harness: Harness, file: Path
) -> None:
    file.write_text(written("end_effector"))
    loop = Loop(harness, robot="", resume_file=str(file), law="computed_torque")
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    description.publish(String(data=URDF.read_text("utf-8")))
    assert_one_sentence(loop.wait_for("refused").message, "computed_torque", "end-effector")
    np.testing.assert_allclose(loop.answer()[0], 0.0, atol=1e-12)


def test_a_goal_that_is_aborted_before_the_robot_is_known_is_not_flown_to(
    harness: Harness, file: Path
) -> None:
    file.write_text(written("base", position=[0.5, 0.25, 0.0]))
    loop = Loop(harness, robot="", resume_file=str(file))
    description = loop.probe.create_publisher(String, "robot_description", LATCHED)
    harness.connect()
    answer = loop.trigger("abort")
    assert answer.success
    assert loop.wait_for("aborted").message == answer.message
    assert not file.exists()
    assert not loop.trigger("abort").success, "nothing waits any more"
    description.publish(String(data=URDF.read_text("utf-8")))
    harness.spin_until(lambda: loop.node.commander.robot is not None, "the robot is known")
    np.testing.assert_allclose(loop.answer()[0], 0.0, atol=1e-12)
