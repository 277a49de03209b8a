"""States of a plant that commanders take: pairs of messages, stamps, and the plant's status."""

from __future__ import annotations

from dataclasses import replace

import pytest
from support.sentences import assert_one_sentence

from spacerobot_ros.commanding.plant_state import (
    Pairing,
    PlantChange,
    PlantListener,
    PlantRested,
    PlantStopped,
    Stamped,
    StampFilter,
    StateSynchroniser,
)
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.times import SECOND

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


def test_a_pose_serves_once_and_for_its_own_state() -> None:
    plan = Commander(pose_required=False)
    plan.odom(1)
    plan.joints(1)
    plan.joints(1)
    assert plan.handed == [(WHOLE, 1), (WITHOUT_POSE, 1)]
    plan.odom(2)
    plan.joints(3)
    plan.odom(2)
    assert plan.handed[2:] == [(WITHOUT_POSE, 3)]


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


def test_a_topic_that_is_required_again_keeps_its_message_until_it_is_no_longer() -> None:
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
    states.put_odom(*stamped(odom(4)))
    states.put_joints(*stamped(joints(4)))
    assert states.take_ready() is WHOLE, "it waits for no reference"


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


PERIOD = 0.05


def message(topic: str, seconds: float) -> Stamped:
    return Stamped(round(seconds * SECOND), (topic, seconds))


class Listener:
    """States as they come in real time, and which of them are believed."""

    def __init__(self, pace: float = 1.0) -> None:
        self.wall, self.pace, self.time = 100.0, pace, 40.0
        self.times = StampFilter(clock=lambda: self.wall)
        self.believed: list[float] = []
        """The times of the states that were admitted, s."""

    def states(self, count: int) -> None:
        """Let the plant publish states, one a control period."""
        for _ in range(count):
            self.wait(PERIOD / self.pace)
            self.time += PERIOD
            assert self.odom(self.time)
            assert self.joints(self.time)

    def odom(self, seconds: float) -> bool:
        return self.times.accepts_odom(*message("odom", seconds))

    def joints(self, seconds: float) -> bool:
        admitted = self.times.accepts_joints(*message("joint_states", seconds))
        if admitted:
            self.believed.append(seconds)
        return admitted

    def wait(self, wall: float) -> None:
        """Let wall time pass, and look as often as a node does."""
        for _ in range(int(wall / 0.1)):
            self.wall += 0.1
            self.look()
        self.wall += wall % 0.1

    def look(self) -> tuple[Stamped | None, Stamped] | None:
        return self.times.accepted_jump()


@pytest.mark.parametrize("pace", [1.0, 500.0])
@pytest.mark.parametrize("ahead", [1e6, 0.493, -0.05, -39.0])
def test_one_state_of_another_time_is_ignored_and_counted(ahead: float, pace: float) -> None:
    listener = Listener(pace)
    listener.states(20)
    assert not listener.odom(listener.time + ahead) or abs(ahead) <= 1.5 * PERIOD
    assert not listener.joints(listener.time + ahead)
    assert listener.look() is None
    listener.states(20)
    assert len(listener.believed) == 40
    assert listener.times.ignored >= 1
    where = "ahead of" if ahead > 0 else "behind"
    assert where in listener.times.last_ignored
    assert "stamp" in listener.times.last_ignored


def test_late_poses_are_neither_used_nor_mentioned() -> None:
    """On a busy machine joints overtake several poses, which nobody can do anything about."""
    listener = Listener()
    listener.states(20)
    for late in (2, 5, 8):
        assert not listener.odom(listener.time - late * PERIOD)
        listener.states(1)
    assert listener.times.ignored == 0
    assert not listener.odom(listener.time - 20 * PERIOD)
    listener.states(1)
    assert listener.times.ignored == 1


def test_a_second_publisher_of_another_time_never_takes_over() -> None:
    listener = Listener()
    listener.states(5)
    for tick in range(100):
        listener.states(1)
        for part in range(3):
            assert not listener.joints(listener.time + 3.0 + part * 0.01)
            assert not listener.joints(1e6 + tick)
    assert len(listener.believed) == 105


def test_lost_states_are_explained_by_the_wall_time_without_them() -> None:
    listener = Listener()
    listener.states(20)
    # This node is stopped for 6 s: the first states of its queue are lost, and the rest come in a
    # burst.
    listener.wall += 6.0
    listener.time += 1.0
    for _ in range(100):
        listener.time += PERIOD
        assert listener.odom(listener.time)
        assert listener.joints(listener.time)
    listener.states(5)
    assert listener.times.ignored == 0


def test_a_stamp_that_is_shown_again_is_of_the_present_time() -> None:
    listener = Listener()
    listener.states(3)
    assert listener.joints(listener.time)
    listener.wall += 100.0
    assert listener.odom(listener.time)
    assert listener.joints(listener.time)


@pytest.mark.parametrize("at", [0.0, 39.8, 1e6])
def test_a_restarted_plant_is_believed_when_nothing_contradicts_it(at: float) -> None:
    """In lockstep it publishes one state, and waits for the answer."""
    listener = Listener()
    listener.states(20)
    listener.wall += 2.0
    assert not listener.odom(at)
    assert not listener.joints(at)
    looks = 0
    while (believed := listener.look()) is None:
        looks += 1
        listener.wall += 0.1
        assert looks < 8
    assert looks >= 4
    assert believed == (message("odom", at), message("joint_states", at))
    assert listener.joints(at + PERIOD)
    assert not listener.joints(listener.time + PERIOD)
    assert listener.times.ignored == 0


def test_a_plant_that_is_restarted_with_another_rate_is_followed() -> None:
    listener = Listener()
    listener.states(20)
    believed, time = 0, 0.0
    for _ in range(40):
        time += 10 * PERIOD
        listener.wait(10 * PERIOD)
        believed += listener.joints(time)
    assert believed >= 37
    assert listener.times.rate == pytest.approx(0.1 / PERIOD)


def test_the_first_state_is_believed_whatever_its_stamp() -> None:
    listener = Listener()
    assert listener.odom(1e6)
    assert listener.joints(1e6)
    # If it was not the plant's, the plant's are believed when it does not come again.
    assert not listener.joints(10.0)
    listener.wall += 0.5
    assert listener.look() is not None


RUNNING = PlantStatus(PlantState.RUNNING, "A command is active.")
LATCHED = PlantStatus(
    PlantState.LATCHED, "Nothing moves: a fuse.", "abort", "a fuse is blown", time_s=2.0
)
RESTING = PlantStatus(
    PlantState.RESTING, "It is too old.", "timeout", timeouts=1, last_command_s=1.5, time_s=2.0
)
AGAIN = replace(RUNNING, rearms=1, time_s=3.0)


def listener(*statuses: PlantStatus) -> PlantListener:
    made = PlantListener()
    for status in statuses:
        made.update(status, "/robot/plant")
    return made


def test_a_latched_plant_stops_commanders_once_and_goals_are_refused() -> None:
    one = listener(RUNNING)
    assert (one.refusal_of_goals, one.has_no_command) == ("", False)
    assert one.update(LATCHED, "/robot/plant") == [PlantStopped("a fuse is blown.")]
    assert one.update(replace(LATCHED, faults=("joint_stuck a",)), "/robot/plant") == []
    assert_one_sentence(one.refusal_of_goals, "a fuse is blown", "'/robot/plant'", "rearm it")
    # Paused or inactive it is latched as well.
    for state in (PlantState.PAUSED, PlantState.INACTIVE):
        assert one.update(replace(LATCHED, state=state), "/robot/plant") == []
        assert one.refusal_of_goals
        assert one.has_no_command, "no command is in force"
    assert one.update(AGAIN) == [PlantChange.OBEYS]
    assert (one.refusal_of_goals, one.has_no_command) == ("", False)


def test_a_commander_that_comes_later_learns_that_the_plant_is_latched() -> None:
    assert listener().update(LATCHED) == [PlantStopped("a fuse is blown.")]
    assert listener().update(RUNNING) == []
    assert listener().update(RESTING) == []


def test_a_latch_that_was_missed_is_noticed_by_the_rearming() -> None:
    (stopped, change) = listener(RUNNING).update(AGAIN)
    assert isinstance(stopped, PlantStopped)
    assert_one_sentence(stopped.reason, "latched")
    assert change is PlantChange.OBEYS
    assert listener(RUNNING, LATCHED).update(replace(LATCHED, rearms=1)) == []


def test_a_plant_that_fails_stops_commanders() -> None:
    one = listener(RUNNING)
    failed = PlantStatus(PlantState.FAILED, "Its model has no inertia.", "model")
    assert one.update(failed) == [PlantStopped("Its model has no inertia.")]
    assert_one_sentence(one.refusal_of_goals, "failed", "Its model has no inertia.")
    assert one.update(RUNNING) == [PlantChange.OBEYS]


def test_a_plant_that_rests_tells_until_when_it_was_commanded() -> None:
    assert listener(RUNNING).update(RESTING) == [PlantRested(1_500_000_000, 2_000_000_000)]
    assert listener(RUNNING, RESTING).update(replace(RUNNING, timeouts=1, time_s=2.5)) == []
    # Missed: it runs again.
    again = replace(RUNNING, timeouts=1, last_command_s=1.5)
    assert listener(RUNNING).update(again) == [PlantRested(1_500_000_000, 1_500_000_000)]
    # A plant without counters says when it came to rest.
    plain = PlantStatus(PlantState.RESTING, "It rests.", "timeout", time_s=2.0)
    assert listener(RUNNING).update(plain) == [PlantRested(2 * 10**9, 2 * 10**9)]
    assert listener(RUNNING).update(replace(plain, reason="no_command")) == []
    assert listener(RUNNING).update(replace(plain, time_s=float("nan"))) == []


def test_pauses_and_restarts_stop_nothing() -> None:
    one = listener(replace(RUNNING, rearms=2, resets=3, timeouts=4))
    assert (
        one.update(replace(RUNNING, state=PlantState.PAUSED, rearms=2, resets=3, timeouts=4)) == []
    )
    assert one.paused
    assert one.update(PlantStatus(PlantState.INACTIVE, "The plant is not configured.")) == []
    assert one.update(PlantStatus(PlantState.RESTING, "No command yet.", "no_command")) == []
    assert one.update(RUNNING) == []
    assert not one.paused


def test_a_plant_that_is_started_again_is_reset() -> None:
    one = listener(RUNNING, replace(RUNNING, time_s=9.0))
    assert one.update(PlantStatus(PlantState.INACTIVE, "The plant is inactive.")) == []
    assert one.update(replace(RUNNING, time_s=0.5)) == [PlantChange.RESET]
    assert one.update(replace(RUNNING, time_s=0.75)) == []


def test_a_reset_is_reported_once() -> None:
    one = listener(RUNNING)
    assert one.update(replace(RUNNING, resets=1)) == [PlantChange.RESET]
    assert one.update(replace(RUNNING, resets=1, time_s=1.0)) == []
    # A plant that obeys nothing is reset as well.
    assert PlantChange.RESET not in one.update(replace(LATCHED, resets=1))
    assert one.update(replace(LATCHED, resets=2)) == [PlantChange.RESET]
    assert one.update(replace(AGAIN, resets=2)) == [PlantChange.OBEYS]
    assert listener().update(replace(LATCHED, resets=3)) == [PlantStopped("a fuse is blown.")]
