"""The coordinated-control node and the plant under efforts, from outside."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.oracles import PinocchioOracle
from support.ros_harness import LATCHED, Harness, assert_one_sentence, nanoseconds

from spacerobot_ros.nodes import CoordinatedControlNode, PlantNode

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf" / "planar_manipulator.urdf"
JOINTS = ["shoulder", "elbow"]
TICK_NS = 10_000_000
SHAPE = np.array([-1.0, 1.0])
# The links are a metre long and the shoulder is half a metre from the centre of the base.
TIP = np.array([0.5 + math.cos(-1.0) + 1.0, math.sin(-1.0), 0.0])
KP, KD = 30.0, 60.0
MASS = 47.0
EFFORT_LIMIT = 200.0  # of both joints, as the URDF says
STATUS = "controller/status"


def pose(position: npt.ArrayLike, frame: str = "world", w: float = 1.0) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = frame
    p = message.pose.position
    p.x, p.y, p.z = np.asarray(position, dtype=float).tolist()
    message.pose.orientation.w = w
    return message


class Loop:
    """The node, and a probe in the place of the plant: a robot that is where it is put.

    Its axes are the world's. At rest the law (29) then commands the force ``Kp`` times the errors
    of base and end-effector together, since the work of a force on the base moves both.
    """

    def __init__(self, harness: Harness, *, activate: bool = True, **settings: Any) -> None:
        self.harness = harness
        defaults = {"robot": "planar_manipulator", "tick_rate": 100.0, "status_period": 0.01}
        self.node = harness.make(
            CoordinatedControlNode, {**defaults, **settings}, name="control", autostart=False
        )
        self.probe = harness.probe(
            {"base_wrench": WrenchStamped, "joint_commands": JointState, STATUS: DiagnosticStatus},
            latched=(STATUS,),
        )
        make = self.probe.create_publisher
        self.odom = make(Odometry, "odom", 100)
        self.joints = make(JointState, "joint_states", 100)
        self.goals = {
            "base": make(PoseStamped, "goal_pose", 10),
            "end_effector": make(PoseStamped, "end_effector/goal_pose", 10),
        }
        assert self.node.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        if activate:
            assert self.node.trigger_activate() is TransitionCallbackReturn.SUCCESS
        self.tick = 0
        self.place = np.zeros(3)
        self.velocity = np.zeros(3)
        self.rates = np.zeros(2)

    def show(self, *, odom: bool = True) -> None:
        """Publish the state of the next tick."""
        self.tick += 1
        state = Odometry(child_frame_id="base_link")
        state.header.frame_id = "world"
        p, v = state.pose.pose.position, state.twist.twist.linear
        p.x, p.y, p.z = self.place.tolist()
        v.x, v.y, v.z = self.velocity.tolist()
        state.pose.pose.orientation.w = 1.0
        joints = JointState(
            name=JOINTS,
            position=SHAPE.tolist(),
            velocity=self.rates.tolist(),
            effort=[0.0, 0.0],
        )
        for message in (state, joints):
            stamp = divmod(self.tick * TICK_NS, 1_000_000_000)
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
        if odom:
            self.odom.publish(state)
        self.joints.publish(joints)

    def answer(self, *, odom: bool = True) -> tuple[Array, Array]:
        """Show a state; return the wrench and the efforts that come for it, or one before."""
        before = {topic: self.probe.count(topic) for topic in ("base_wrench", "joint_commands")}
        self.show(odom=odom)
        self.harness.spin_until(
            lambda: all(self.probe.count(topic) > n for topic, n in before.items()), "a command"
        )
        return self.last_command

    @property
    def last_command(self) -> tuple[Array, Array]:
        wrench, joints = self.probe.last("base_wrench"), self.probe.last("joint_commands")
        assert wrench.header.stamp == joints.header.stamp
        assert wrench.header.frame_id == "base_link"
        assert list(joints.name) == JOINTS
        f, t = wrench.wrench.force, wrench.wrench.torque
        return np.array([f.x, f.y, f.z, t.x, t.y, t.z]), np.array(joints.effort)

    def aim(self, **goals: PoseStamped) -> None:
        """Send goals and let them arrive."""
        for group, message in goals.items():
            self.goals[group].publish(message)
        self.harness.settle(self.probe)

    def wait_for(self, state: str) -> DiagnosticStatus:
        self.harness.spin_until(
            lambda: self.probe.count(STATUS) and self.status["state"] == state, f"state {state}"
        )
        return self.probe.last(STATUS)

    @property
    def status(self) -> dict[str, str]:
        return {pair.key: pair.value for pair in self.probe.last(STATUS).values}

    def set(self, name: str, value: Any) -> Any:
        (result,) = self.node.set_parameters([Parameter(name, value=value)])
        return result

    def abort(self) -> Any:
        client = self.probe.create_client(Trigger, "control/abort")
        return self.harness.call(client, Trigger.Request())


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


@pytest.mark.parametrize("law", ["transposed_jacobian", "model_based"])
def test_a_drifting_robot_is_brought_back_to_where_it_was(harness: Harness, law: str) -> None:
    """The whole loop: a plant that drifts and tumbles, and nobody who gives a goal."""
    harness.make(
        PlantNode,
        {
            "robot": "planar_manipulator",
            "actuation": "effort",
            "time_mode": "lockstep",
            "tick_rate": 50.0,
            "initial_joint_positions": SHAPE.tolist(),
            "linear_momentum": [4.7, -2.35, 0.0],
            "angular_momentum": [0.0, 0.0, 1.0],
        },
        name="plant",
    )
    probe = harness.probe({"odom": Odometry, "joint_states": JointState})
    harness.spin_until(lambda: probe.count("joint_states"), "the first state")
    harness.make(
        CoordinatedControlNode,
        {"robot": "planar_manipulator", "tick_rate": 50.0, "law": law},
        name="control",
    )
    harness.spin_until(
        lambda: nanoseconds(probe.last("odom").header.stamp) >= 20_000_000_000, "20 s", 60.0
    )
    places = np.array(
        [[m.pose.pose.position.x, m.pose.pose.position.y] for m in probe.messages["odom"]]
    )
    assert np.abs(places).max() > 5e-4
    np.testing.assert_allclose(places[-1], 0.0, atol=1e-3)
    np.testing.assert_allclose(probe.last("joint_states").position, SHAPE, atol=2e-3)


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


def test_a_goal_is_reached_when_it_is_held_for_the_settling_time(harness: Harness) -> None:
    loop = Loop(harness, settle_time=0.03, time_limit=1.0)
    loop.aim(base=pose([0.5, 0.0, 0.0]), end_effector=pose(TIP + np.array([0.5, 0.0, 0.0])))
    loop.answer()
    loop.wait_for("tracking")
    loop.place = np.array([0.5, 0.0, 0.0])
    for _ in range(3):
        loop.answer()
        harness.settle(loop.probe)
        assert loop.status["state"] == "tracking"
    loop.answer()
    assert_one_sentence(loop.wait_for("reached").message, "met")


def test_a_goal_that_is_not_met_in_time_has_failed(harness: Harness) -> None:
    loop = Loop(harness, time_limit=0.05)
    loop.aim(base=pose([0.5, 0.0, 0.0]))
    for _ in range(7):
        loop.answer()
    assert loop.wait_for("failed").level == DiagnosticStatus.ERROR


# -- gains ------------------------------------------------------------------------------------


def test_gains_that_change_in_flight_take_effect(harness: Harness) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)
    assert loop.set("gains.base_position.kp", 70.0).successful
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, 0.0, 0.0], atol=1e-12)
    loop.velocity = np.array([0.0, 0.5, 0.0])
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, -2 * KD * 0.5, 0.0], atol=1e-12)
    assert loop.set("gains.end_effector_position.kd", 10.0).successful
    np.testing.assert_allclose(loop.answer()[0][:3], [70.0, -(KD + 10.0) * 0.5, 0.0], atol=1e-12)


@pytest.mark.parametrize("value", [-1.0, 0.0, math.nan, math.inf])
@pytest.mark.parametrize("name", ["gains.base_position.kp", "gains.end_effector_position.kd"])
def test_bad_gains_are_refused_and_the_loop_goes_on(
    harness: Harness, name: str, value: float
) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.velocity = np.array([0.0, 0.5, 0.0])
    before = loop.answer()[0]
    result = loop.set(name, value)
    assert not result.successful
    assert name in result.reason
    assert "\n" not in result.reason
    np.testing.assert_array_equal(loop.answer()[0], before)


# -- goals ------------------------------------------------------------------------------------

REFUSED: dict[str, tuple[PoseStamped, tuple[str, ...]]] = {
    "wrong frame": (pose([1, 0, 0], frame="moon"), ("frame", "moon", "world")),
    "not a number": (pose([math.nan, 0, 0]), ("finite",)),
    "infinite": (pose([0, math.inf, 0]), ("finite",)),
    "zero quaternion": (pose([1, 0, 0], w=0.0), ("orientation",)),
}


@pytest.mark.parametrize("group", ["base", "end_effector"])
@pytest.mark.parametrize(("goal", "mentions"), REFUSED.values(), ids=REFUSED)
def test_a_bad_goal_is_refused_and_the_earlier_one_goes_on(
    harness: Harness, group: str, goal: PoseStamped, mentions: tuple[str, ...]
) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    before = loop.answer()[0]
    loop.goals[group].publish(goal)
    status = loop.wait_for("refused")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, *mentions)
    np.testing.assert_array_equal(loop.answer()[0], before)
    loop.wait_for("tracking")


@pytest.mark.parametrize(
    ("group", "settings"),
    [
        ("base", {"law": "computed_torque"}),
        ("end_effector", {"law": "computed_torque"}),
        ("end_effector", {"base_outputs": "x y rz", "joint_outputs": "shoulder elbow"}),
    ],
)
def test_a_goal_for_what_is_not_controlled_is_refused(
    harness: Harness, group: str, settings: dict[str, Any]
) -> None:
    loop = Loop(harness, **settings)
    loop.answer()
    loop.goals[group].publish(pose([1.0, 0.0, 0.0]))
    law = settings.get("law", "transposed_jacobian")
    refusal = loop.wait_for("refused").message
    assert_one_sentence(refusal, law, group.replace("_", "-"), "joint.shoulder")
    wrench, effort = loop.answer()
    np.testing.assert_allclose([*wrench, *effort], 0.0, atol=1e-12)


def test_a_goal_without_a_frame_is_taken(harness: Harness) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0], frame=""))
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)


# -- measurements stop ------------------------------------------------------------------------


def test_without_odom_the_base_is_estimated_and_then_the_thrusters_are_off(
    harness: Harness,
) -> None:
    loop = Loop(harness, estimation_time=0.05)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    measured = loop.answer()[0]
    loop.wait_for("tracking")
    # The first state without odom is known to be one when the next joints come; those are answered
    # at once, and so are all that follow.
    loop.show(odom=False)
    for _ in range(4):
        wrench, _ = loop.answer(odom=False)
        assert nanoseconds(loop.probe.last("base_wrench").header.stamp) == loop.tick * TICK_NS
        # Hardly anything moves in five ticks, nor does the command.
        np.testing.assert_allclose(wrench, measured, atol=0.15 * np.abs(measured).max())
        assert wrench[0] < measured[0]
        status = loop.wait_for("estimating")
        assert status.level == DiagnosticStatus.WARN
    loop.rates = np.array([0.1, -0.2])
    loop.show(odom=False)
    harness.spin_until(lambda: loop.status["state"] == "stopped", "the stop")
    assert loop.probe.last(STATUS).level == DiagnosticStatus.ERROR
    for _ in range(3):
        wrench, effort = loop.answer(odom=False)
        np.testing.assert_array_equal(wrench, np.zeros(6))
    # The joints are slowed: their efforts take energy out of them.
    assert effort @ loop.rates < 0.0
    assert_one_sentence(loop.probe.last(STATUS).message, "thrusters off")
    loop.rates = np.zeros(2)
    loop.show(odom=True)
    harness.spin_until(lambda: loop.status["state"] == "tracking", "the loop again")
    wrench, _ = loop.answer()
    np.testing.assert_allclose(wrench[:3], [KP, 0.0, 0.0], atol=1e-12)


def test_without_odom_from_the_beginning_nothing_is_thrust(harness: Harness) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.show(odom=False)
    for _ in range(3):
        np.testing.assert_array_equal(loop.answer(odom=False)[0], np.zeros(6))
    loop.wait_for("stopped")
    loop.show(odom=True)
    loop.wait_for("tracking")
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)


def test_a_robot_that_held_still_holds_after_a_gap_in_odom(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    loop.wait_for("holding")
    loop.show(odom=False)
    loop.answer(odom=False)
    loop.wait_for("estimating")
    loop.show(odom=True)
    harness.spin_until(lambda: loop.status["state"] != "estimating", "the loop again")
    assert loop.status["state"] == "holding"


# -- abort, life ------------------------------------------------------------------------------


def test_abort_holds_the_robot_where_it_is(harness: Harness) -> None:
    loop = Loop(harness, settle_time=0.0)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.answer()
    loop.place = np.array([0.25, 0.0, 0.0])
    assert loop.abort().success
    wrench, effort = loop.answer()
    np.testing.assert_allclose([*wrench, *effort], 0.0, atol=1e-12)
    status = loop.wait_for("aborted")
    assert status.level == DiagnosticStatus.WARN
    for _ in range(3):
        loop.answer()
    harness.settle(loop.probe)
    assert loop.status["state"] == "aborted"
    # A new goal is taken up from there.
    loop.aim(base=pose([1.25, 0.0, 0.0]))
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)
    loop.wait_for("tracking")


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


def test_an_aborted_goal_is_not_reached_after_a_gap_in_odom(harness: Harness) -> None:
    loop = Loop(harness, settle_time=0.0)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.answer()
    assert loop.abort().success
    loop.answer()
    loop.wait_for("aborted")
    loop.show(odom=False)
    loop.answer(odom=False)
    loop.wait_for("estimating")
    loop.show(odom=True)
    for _ in range(3):
        loop.answer()
    harness.settle(loop.probe)
    assert loop.status["state"] == "aborted"


def test_a_reached_goal_does_not_fail_after_a_gap_in_odom(harness: Harness) -> None:
    loop = Loop(harness, settle_time=0.01, time_limit=0.1)
    loop.aim(base=pose([0.0, 0.0, 0.0]))
    for _ in range(20):
        loop.answer()
    loop.wait_for("reached")
    loop.show(odom=False)
    loop.answer(odom=False)
    loop.wait_for("estimating")
    # It has drifted in the meantime.
    loop.place = np.array([0.01, 0.0, 0.0])
    loop.show(odom=True)
    for _ in range(3):
        loop.answer()
    harness.settle(loop.probe)
    states = [pair.value for m in loop.probe.messages[STATUS] for pair in m.values]
    assert "failed" not in states
    assert loop.status["state"] == "reached"


def test_goals_are_forgotten_by_a_deactivation(harness: Harness) -> None:
    loop = Loop(harness)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    assert loop.answer()[0][0] == pytest.approx(KP)
    loop.node.trigger_deactivate()
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
    np.testing.assert_allclose(loop.answer()[0][:3], [KP, 0.0, 0.0], atol=1e-12)


# -- the plant under efforts ------------------------------------------------------------------


class Effort:
    """A plant under efforts in lockstep, and a probe that commands it."""

    def __init__(self, harness: Harness, *, wrench: bool) -> None:
        self.harness = harness
        self.plant = harness.make(
            PlantNode,
            {
                "robot": "planar_manipulator",
                "actuation": "effort",
                "time_mode": "lockstep",
                "tick_rate": 100.0,
                "diagnostics_period": 0.01,
            },
            name="plant",
            autostart=False,
        )
        self.probe = harness.probe(
            {"odom": Odometry, "joint_states": JointState, "/diagnostics": DiagnosticArray}
        )
        self.efforts = self.probe.create_publisher(JointState, "joint_commands", 100)
        self.wrenches: Any = None
        if wrench:
            self.wrenches = self.probe.create_publisher(WrenchStamped, "base_wrench", 100)
        assert self.plant.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS
        self.wait(1)

    def wait(self, count: int) -> None:
        self.harness.spin_until(
            lambda: all(self.probe.count(topic) >= count for topic in self.probe.messages),
            f"state {count}",
        )

    @property
    def ticks(self) -> int:
        """States seen so far, when nothing is under way."""
        self.harness.settle(self.probe)
        return self.probe.count("joint_states")

    def stamped(self, message: Any) -> Any:
        message.header.stamp = self.probe.last("joint_states").header.stamp
        return message

    def push(self, force: float, frame: str = "base_link") -> None:
        message = self.stamped(WrenchStamped())
        message.header.frame_id = frame
        message.wrench.force.x = force
        self.wrenches.publish(message)

    def turn(self, *efforts: float) -> None:
        self.efforts.publish(self.stamped(JointState(name=JOINTS, effort=list(efforts))))

    @property
    def speed(self) -> float:
        return float(self.probe.last("odom").twist.twist.linear.x)

    def diagnosed(self, what: str) -> dict[str, str]:
        (status,) = (
            s for s in self.probe.last("/diagnostics").status if s.name == f"/plant: {what}"
        )
        return {pair.key: pair.value for pair in status.values}


@pytest.mark.parametrize("first", ["wrench", "efforts"])
def test_a_lockstep_plant_waits_for_both_commands(harness: Harness, first: str) -> None:
    rig = Effort(harness, wrench=True)
    sends = [lambda: rig.push(4.7), lambda: rig.turn(0.0, 0.0)]
    if first == "efforts":
        sends.reverse()
    for tick in range(1, 4):
        sends[0]()
        assert rig.ticks == tick
        sends[1]()
        rig.wait(tick + 1)
    # All links lie along the force: no more than the whole mass is pushed.
    assert rig.speed == pytest.approx(3 * 0.01 * 4.7 / MASS, rel=1e-12)


def test_efforts_alone_do_where_nobody_gives_a_wrench(harness: Harness) -> None:
    rig = Effort(harness, wrench=False)
    for tick in range(1, 4):
        rig.turn(1.0, -1.0)
        rig.wait(tick + 1)
    assert list(rig.probe.last("joint_states").effort) == [1.0, -1.0]


def test_a_lockstep_plant_does_not_wait_for_a_commander_that_is_gone(harness: Harness) -> None:
    rig = Effort(harness, wrench=True)
    rig.turn(1.0, 0.0)
    assert rig.ticks == 1
    rig.probe.destroy_publisher(rig.wrenches)
    harness.spin_until(lambda: rig.probe.count("joint_states") > 1, "a step", 3.0)


def test_thrusters_are_off_when_their_commander_is_gone(harness: Harness) -> None:
    rig = Effort(harness, wrench=True)
    rig.push(4.7)
    rig.turn(0.0, 0.0)
    rig.wait(2)
    speed = rig.speed
    rig.probe.destroy_publisher(rig.wrenches)
    # The plant looks round for commanders every tenth of a second.
    harness.spin_for(0.5)
    rig.turn(0.0, 0.0)
    rig.wait(3)
    assert rig.speed == pytest.approx(speed, rel=1e-12)


def test_a_wrench_in_another_frame_is_refused_and_time_goes_on(harness: Harness) -> None:
    rig = Effort(harness, wrench=True)
    rig.push(4.7, frame="world")
    rig.turn(0.0, 0.0)
    rig.wait(2)
    assert rig.speed == 0.0
    assert rig.diagnosed("commands")["refused"] == "1"
    (status,) = (s for s in rig.probe.last("/diagnostics").status if s.name == "/plant: commands")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message, "base_wrench", "'world'", "base_link")
    rig.push(4.7, frame="")
    rig.turn(0.0, 0.0)
    rig.wait(3)
    assert rig.speed == pytest.approx(0.01 * 4.7 / MASS, rel=1e-12)


def test_efforts_beyond_the_limits_are_clipped_and_counted(harness: Harness) -> None:
    rig = Effort(harness, wrench=False)
    rig.turn(3 * EFFORT_LIMIT, -10.0)
    rig.wait(2)
    rig.turn(0.0, -1e6)
    rig.wait(3)
    efforts = [list(m.effort) for m in rig.probe.messages["joint_states"]]
    assert efforts == [[0.0, 0.0], [EFFORT_LIMIT, -10.0], [0.0, -EFFORT_LIMIT]]
    counted = rig.diagnosed("actuators")
    assert counted["effort_limited.shoulder"] == counted["effort_limited.elbow"] == "1"
    # The motion is that of the clipped efforts: energy is their work, by another engine.
    joints, odom = (rig.probe.messages[t][1] for t in ("joint_states", "odom"))
    oracle = PinocchioOracle(URDF.read_text("utf-8"), JOINTS)
    oracle.set_configuration(np.zeros(2))
    acceleration = oracle.own_acceleration(np.zeros(6), np.array([EFFORT_LIMIT, -10.0]))
    rates = np.array(joints.velocity) / 0.01
    np.testing.assert_allclose(rates, acceleration[6:], rtol=0.05)
    assert odom.twist.twist.angular.z == pytest.approx(0.01 * acceleration[5], rel=0.05)
