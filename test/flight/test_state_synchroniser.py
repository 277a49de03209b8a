"""Which messages make a state, in every order they come in."""

from __future__ import annotations

import pytest
from nav_msgs.msg import Odometry
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState

from spacerobot_ros.flight.state_synchroniser import Pairing, StateSynchroniser

WHOLE, WITHOUT_POSE, LATE_POSE = Pairing.WHOLE, Pairing.WITHOUT_POSE, Pairing.LATE_POSE


def message(kind: type[Odometry] | type[JointState], tick: int) -> bytes:
    """Return a message of a tick; ticks are 0.4 s, so that both halves of the stamp matter."""
    made = kind()
    made.header.frame_id = "world"
    made.header.stamp.sec, made.header.stamp.nanosec = divmod(tick * 400_000_000, 1_000_000_000)
    return bytes(serialize_message(made))


def odom(tick: int) -> bytes:
    return message(Odometry, tick)


def joints(tick: int) -> bytes:
    return message(JointState, tick)


class Commander:
    """What both nodes do with each message, and what they are handed over."""

    def __init__(self, *, pose_required: bool) -> None:
        self.states = StateSynchroniser(pose_required=pose_required)
        self.handed: list[tuple[Pairing, int]] = []
        self._tick = -1

    def odom(self, tick: int) -> None:
        self.states.put_odom(odom(tick))
        self._poll()

    def joints(self, tick: int) -> None:
        overdue = self.states.overdue()
        if overdue is not None:
            self.handed.append((overdue, self._tick))
        self._tick = tick
        self.states.put_joint_states(joints(tick))
        self._poll()

    def reference(self, tick: int) -> None:
        self.states.put_required("joint_reference", joints(tick))
        self._poll()

    def _poll(self) -> None:
        pairing = self.states.ready()
        if pairing is not None:
            self.handed.append((pairing, self._tick))
        assert self.states.ready() is None, "a state is handed over once"


# -- pose required ----------------------------------------------------------------------------


@pytest.mark.parametrize("order", [("odom", "joints"), ("joints", "odom")])
def test_a_state_is_ready_with_its_second_message(order: tuple[str, str]) -> None:
    control = Commander(pose_required=True)
    for tick in range(1, 4):
        first, second = (getattr(control, name) for name in order)
        first(tick)
        assert len(control.handed) == tick - 1
        second(tick)
        assert control.handed[-1] == (WHOLE, tick)
    assert len(control.handed) == 3


def test_stamps_that_differ_in_seconds_or_nanoseconds_alone_are_two_states() -> None:
    control = Commander(pose_required=True)
    control.joints(0)
    control.odom(5)  # 2 s: the same nanoseconds.
    control.odom(1)  # 0.4 s: the same seconds.
    assert control.handed == []
    control.odom(0)
    assert control.handed == [(WHOLE, 0)]


def test_a_missing_pose_is_known_with_the_next_joints_and_from_then_on() -> None:
    control = Commander(pose_required=True)
    control.odom(1)
    control.joints(1)
    control.joints(2)
    assert control.handed == [(WHOLE, 1)], "its odom may still come"
    control.joints(3)
    assert control.handed[1:] == [(WITHOUT_POSE, 2), (WITHOUT_POSE, 3)]
    control.joints(4)
    assert control.handed[3:] == [(WITHOUT_POSE, 4)]
    control.odom(5)
    control.joints(5)
    assert control.handed[4:] == [(WHOLE, 5)]


def test_an_odom_that_comes_late_ends_the_estimation_and_is_not_answered() -> None:
    control = Commander(pose_required=True)
    control.joints(1)
    control.joints(2)
    control.odom(2)
    assert control.handed == [(WITHOUT_POSE, 1), (WITHOUT_POSE, 2)]
    control.joints(3)
    assert len(control.handed) == 2, "it waits for its odom again"
    control.odom(3)
    assert control.handed[2:] == [(WHOLE, 3)]


def test_a_state_that_is_shown_again_is_answered_again_when_it_is_whole() -> None:
    control = Commander(pose_required=True)
    control.odom(1)
    control.joints(1)
    control.joints(1)
    assert control.handed == [(WHOLE, 1)]
    control.odom(1)
    assert control.handed == [(WHOLE, 1)] * 2


def test_a_reference_of_the_same_stamp_is_waited_for() -> None:
    control = Commander(pose_required=True)
    control.states.require("joint_reference")
    control.odom(1)
    control.joints(1)
    assert control.handed == []
    control.reference(1)
    assert control.handed == [(WHOLE, 1)]
    assert control.states.latest("joint_reference") == joints(1)


def test_a_first_reference_makes_states_wait_for_the_next_ones() -> None:
    control = Commander(pose_required=True)
    control.reference(1)
    control.odom(2)
    control.joints(2)
    assert control.handed == []


def test_a_silent_reference_is_known_with_the_next_joints() -> None:
    control = Commander(pose_required=True)
    control.states.require("joint_reference")
    control.odom(1)
    control.joints(1)
    control.odom(1)
    control.joints(2)
    assert control.handed == [(WHOLE, 1)], "the pose is there: it is no loss of the pose"
    control.odom(2)
    control.reference(2)
    assert control.handed == [(WHOLE, 1), (WHOLE, 2)]


@pytest.mark.parametrize("late", ["joint_reference", "base_reference"])
def test_every_reference_must_be_of_the_same_tick(late: str) -> None:
    """One of two that is of the tick before: the state waits, and then goes without an answer."""
    control = Commander(pose_required=True)
    other = {"joint_reference": "base_reference"}.get(late, "joint_reference")
    for topic in (late, other):
        control.states.require(topic)
        control.states.put_required(topic, joints(1))
    control.odom(1)
    control.joints(1)
    assert control.handed == [(WHOLE, 1)]
    control.odom(2)
    control.states.put_required(other, joints(2))
    control.joints(2)
    assert control.handed == [(WHOLE, 1)], "the other reference is of tick 1"
    control.states.put_required(late, joints(2))
    assert control.states.ready() is WHOLE
    control.odom(3)
    control.states.put_required(other, joints(3))
    control.joints(3)
    # The pose is there: what is missing is no loss of the pose, now or later.
    assert control.states.overdue() is WHOLE
    control.states.put_required(late, joints(4))
    control.states.put_required(other, joints(4))
    control.joints(4)
    assert len(control.handed) == 1, "it waits for its odom"
    control.odom(4)
    assert control.handed[1:] == [(WHOLE, 4)]


def test_a_reference_that_is_no_longer_required_is_forgotten() -> None:
    control = Commander(pose_required=True)
    control.reference(1)
    control.states.require("joint_reference", required=False)
    assert control.states.latest("joint_reference") == b""
    control.odom(2)
    control.joints(2)
    assert control.handed == [(WHOLE, 2)]


# -- pose optional ----------------------------------------------------------------------------


def test_without_need_of_the_pose_joints_are_handed_over_at_once() -> None:
    plan = Commander(pose_required=False)
    plan.joints(1)
    assert plan.handed == [(WITHOUT_POSE, 1)]
    plan.odom(1)
    assert plan.handed[1:] == [(LATE_POSE, 1)]
    plan.odom(2)
    assert len(plan.handed) == 2, "its joints are still to come"
    plan.joints(2)
    assert plan.handed[2:] == [(WHOLE, 2)]


def test_a_pose_serves_once() -> None:
    plan = Commander(pose_required=False)
    plan.odom(1)
    plan.joints(1)
    plan.joints(1)
    assert plan.handed == [(WHOLE, 1), (WITHOUT_POSE, 1)]


def test_an_old_pose_is_no_pose_of_a_new_state() -> None:
    plan = Commander(pose_required=False)
    plan.odom(1)
    plan.joints(2)
    plan.odom(1)
    assert plan.handed == [(WITHOUT_POSE, 2)]


def test_the_messages_themselves_are_kept_as_they_came() -> None:
    states = StateSynchroniser(pose_required=True)
    assert (states.odom, states.joint_states, states.ready(), states.overdue()) == (
        b"",
        b"",
        None,
        None,
    )
    states.put_odom(odom(1))
    states.put_joint_states(joints(2))
    assert (states.odom, states.joint_states) == (odom(1), joints(2))


def test_another_pose_of_one_time_is_a_contradiction_unless_the_plant_was_reset() -> None:
    states = StateSynchroniser(pose_required=True)
    moved = Odometry()
    moved.header.stamp.nanosec, moved.pose.pose.position.x = 1, 0.5
    here = Odometry()
    here.header.stamp.nanosec = 1
    assert not states.put_odom(serialize_message(moved))
    assert states.put_odom(serialize_message(here))
    assert states.put_odom(serialize_message(moved))
    states.forget_pose()
    assert not states.put_odom(serialize_message(here))


@pytest.mark.parametrize("pose_required", [False, True])
def test_a_pose_after_a_reset_is_not_that_of_joints_before_it(*, pose_required: bool) -> None:
    states = StateSynchroniser(pose_required=pose_required)
    states.put_odom(odom(3))
    states.put_joint_states(joints(3))
    assert states.ready() is Pairing.WHOLE
    states.forget_pose()
    states.put_odom(odom(3))
    assert states.ready() is None
    states.put_joint_states(joints(3))
    assert states.ready() is Pairing.WHOLE
    # Joints that were not handed over may be those after the reset.
    states.put_joint_states(joints(4))
    states.forget_pose()
    states.put_odom(odom(4))
    assert states.ready() in (Pairing.WHOLE, Pairing.LATE_POSE)


def test_a_topic_that_is_required_again_keeps_its_message() -> None:
    states = StateSynchroniser(pose_required=True)
    states.require("joint_reference")
    assert states.latest("joint_reference") == b""
    states.put_odom(odom(3))
    states.put_joint_states(joints(3))
    assert states.ready() is None, "it waits for its reference"
    states.put_required("joint_reference", joints(3))
    states.require("joint_reference")
    assert states.latest("joint_reference") == joints(3)
    assert states.ready() is WHOLE
    states.require("joint_reference", required=False)
    assert states.latest("joint_reference") == b""
