"""Which messages make a state, in every order they come in."""

from __future__ import annotations

import pytest

from spacerobot_ros.commanding.plant_state import Pairing, StateSynchroniser

WHOLE, WITHOUT_POSE, LATE_POSE = Pairing.WHOLE, Pairing.WITHOUT_POSE, Pairing.LATE_POSE


Message = tuple[str, int, float]


def odom(tick: int, x: float = 0.0) -> Message:
    return "odom", tick, x


def joints(tick: int) -> Message:
    return "joint_states", tick, 0.0


def stamped(message: Message) -> tuple[int, Message]:
    """Return the stamp of a message of a tick of 0.4 s, and the message, as a commander puts it."""
    return message[1] * 400_000_000, message


class Commander:
    """A commander that records the states that it is handed."""

    def __init__(self, *, pose_required: bool) -> None:
        self.states = StateSynchroniser(pose_required=pose_required)
        self.handed: list[tuple[Pairing, int]] = []
        self._tick = -1

    def odom(self, tick: int) -> None:
        self.states.put_odom(*stamped(odom(tick)))
        self._poll()

    def joints(self, tick: int) -> None:
        overdue = self.states.take_overdue()
        if overdue is not None:
            self.handed.append((overdue, self._tick))
        self._tick = tick
        self.states.put_joints(*stamped(joints(tick)))
        self._poll()

    def reference(self, tick: int) -> None:
        self.states.put_required("joint_reference", *stamped(joints(tick)))
        self._poll()

    def _poll(self) -> None:
        pairing = self.states.take_ready()
        if pairing is not None:
            self.handed.append((pairing, self._tick))
        assert self.states.take_ready() is None, "a state is handed over once"


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


def test_poses_of_other_stamps_complete_no_state() -> None:
    control = Commander(pose_required=True)
    control.joints(0)
    control.odom(5)
    control.odom(1)
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
        control.states.put_required(topic, *stamped(joints(1)))
    control.odom(1)
    control.joints(1)
    assert control.handed == [(WHOLE, 1)]
    control.odom(2)
    control.states.put_required(other, *stamped(joints(2)))
    control.joints(2)
    assert control.handed == [(WHOLE, 1)], "the other reference is of tick 1"
    control.states.put_required(late, *stamped(joints(2)))
    assert control.states.take_ready() is WHOLE
    control.odom(3)
    control.states.put_required(other, *stamped(joints(3)))
    control.joints(3)
    # The pose is there: what is missing is no loss of the pose, now or later.
    assert control.states.take_overdue() is WHOLE
    control.states.put_required(late, *stamped(joints(4)))
    control.states.put_required(other, *stamped(joints(4)))
    control.joints(4)
    assert len(control.handed) == 1, "it waits for its odom"
    control.odom(4)
    assert control.handed[1:] == [(WHOLE, 4)]


def test_a_reference_that_is_no_longer_required_is_forgotten() -> None:
    control = Commander(pose_required=True)
    control.reference(1)
    control.states.require("joint_reference", required=False)
    assert control.states.latest("joint_reference") is None
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
    assert (states.odom, states.joints, states.take_ready(), states.take_overdue()) == (
        None,
        None,
        None,
        None,
    )
    states.put_odom(*stamped(odom(1)))
    states.put_joints(*stamped(joints(2)))
    assert (states.odom, states.joints) == (odom(1), joints(2))


def test_another_pose_of_one_time_is_a_contradiction_unless_the_plant_was_reset() -> None:
    states = StateSynchroniser(pose_required=True)
    assert not states.put_odom(*stamped(odom(1, 0.5)))
    assert states.put_odom(*stamped(odom(1)))
    assert states.put_odom(*stamped(odom(1, 0.5)))
    states.forget_pose()
    assert not states.put_odom(*stamped(odom(1)))


@pytest.mark.parametrize("pose_required", [False, True])
def test_a_pose_after_a_reset_is_not_that_of_joints_before_it(*, pose_required: bool) -> None:
    states = StateSynchroniser(pose_required=pose_required)
    states.put_odom(*stamped(odom(3)))
    states.put_joints(*stamped(joints(3)))
    assert states.take_ready() is Pairing.WHOLE
    states.forget_pose()
    states.put_odom(*stamped(odom(3)))
    assert states.take_ready() is None
    states.put_joints(*stamped(joints(3)))
    assert states.take_ready() is Pairing.WHOLE
    # Joints that were not handed over may be those after the reset.
    states.put_joints(*stamped(joints(4)))
    states.forget_pose()
    states.put_odom(*stamped(odom(4)))
    assert states.take_ready() in (Pairing.WHOLE, Pairing.LATE_POSE)


def test_a_topic_that_is_required_again_keeps_its_message() -> None:
    states = StateSynchroniser(pose_required=True)
    states.require("joint_reference")
    assert states.latest("joint_reference") is None
    states.put_odom(*stamped(odom(3)))
    states.put_joints(*stamped(joints(3)))
    assert states.take_ready() is None, "it waits for its reference"
    states.put_required("joint_reference", *stamped(joints(3)))
    states.require("joint_reference")
    assert states.latest("joint_reference") == joints(3)
    assert states.take_ready() is WHOLE
    states.require("joint_reference", required=False)
    assert states.latest("joint_reference") is None


@pytest.mark.parametrize("pose_required", [True, False])
def test_poses_that_contradict_each_other_are_not_used(*, pose_required: bool) -> None:
    states = StateSynchroniser(pose_required=pose_required)
    assert not states.put_odom(*stamped(odom(1, 0.1)))
    assert states.put_odom(*stamped(odom(1, 9.0)))
    states.put_joints(*stamped(joints(1)))
    assert states.take_ready() is Pairing.WITHOUT_POSE
    assert not states.put_odom(*stamped(odom(2, 0.2)))
    states.put_joints(*stamped(joints(2)))
    assert states.take_ready() is Pairing.WHOLE
    assert states.put_odom(*stamped(odom(2, 9.0)))
    assert states.take_ready() is None
    assert not states.put_odom(*stamped(odom(3, 0.3)))
    assert not states.put_odom(*stamped(odom(3, 0.3)))  # The same again, as for a new subscriber.
    states.put_joints(*stamped(joints(3)))
    assert states.take_ready() is Pairing.WHOLE
