"""Parts of commanders without flights: stamps on a clock by hand, and a controller's answers."""

from __future__ import annotations

from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.commanding import controller
from spacerobot_ros.commanding.commander import CommanderActivity
from spacerobot_ros.commanding.controller import ControllerCommander
from spacerobot_ros.commanding.plant_state import (
    Pairing,
    PlantChange,
    Stamped,
    StampFilter,
    StateSynchroniser,
)
from spacerobot_ros.control import NotFiniteError, PoseReference
from spacerobot_ros.errors import CommandError, PlanningError
from spacerobot_ros.times import SECOND

UNIT = SECOND // 64
"""Times below are in units of 1/64 s, which add up without rounding."""


class Filter:
    """A filter of states every 4 units, on a wall clock in units."""

    def __init__(self) -> None:
        self.wall = 0.0
        self.made = StampFilter(4 / 64, lambda: self.wall / 64)

    def joints(self, wall: float, stamp: float) -> bool:
        self.wall = wall
        return self.made.accepts_joints(round(stamp * UNIT), f"joints {stamp:g}")

    def odom(self, wall: float, stamp: float) -> bool:
        self.wall = wall
        return self.made.accepts_odom(round(stamp * UNIT), f"odom {stamp:g}")

    def jump(self, wall: float) -> tuple[Stamped | None, Stamped] | None:
        self.wall = wall
        return self.made.accepted_jump()


@pytest.mark.parametrize(
    ("wall", "stamp", "admitted"),
    [
        # One and a half steps ahead without a loss, and not back.
        (8, 14, True), (8, 14.000001, False), (8, 8, True), (8, 7.999999, False),
        # With a loss by twice the time that has passed since: 14 + 2 * 10.
        (18, 34, True), (18, 34.000001, False),
    ],
)  # fmt: skip
def test_lost_states_are_explained_by_twice_their_time(
    wall: float, stamp: float, admitted: bool
) -> None:
    some = Filter()
    assert [some.joints(t, t) for t in (0, 4, 8)] == [True] * 3
    some.wall = wall
    assert some.made.would_accept(round(stamp * UNIT)) is admitted
    assert some.joints(wall, stamp) is admitted


@pytest.mark.parametrize(
    ("wall", "stamp", "admitted"),
    [(8, 14, True), (8, 14.1, False), (8, 2, True), (8, 1.9, False), (18, 34, True),
     (18, 34.1, False), (18, 2, True), (18, 1.9, False)],
)  # fmt: skip
def test_poses_come_before_or_after_their_joints(wall: float, stamp: float, admitted: bool) -> None:
    some = Filter()
    assert some.odom(0, 700), "nothing is known before the first state"
    for t in (0, 4, 8):
        some.joints(t, t)
    assert some.odom(wall, stamp) is admitted


def test_a_time_jump_is_believed_after_a_fifth_of_a_second_or_four_states() -> None:
    some = Filter()
    for t in (0, 4, 8):
        some.joints(t - 9, t)
    assert some.made.accepted_jump() is None
    assert not some.odom(0, 5000)
    assert not some.joints(0, 5000)
    assert [some.jump(15.99) for _ in range(3)] == [None] * 3, "four states are 16 units here"
    assert not some.joints(15.99, 5004)
    assert some.jump(16) == (None, Stamped(5004 * UNIT, "joints 5004"))
    assert some.made.now_ns == 5004 * UNIT
    assert some.made.ignored == 0
    fast = Filter()
    for t in (0, 4, 8):
        fast.joints((t - 10) / 4, t)
    fast.odom(0, 5000)
    fast.joints(0, 5000)
    assert [fast.jump(12.799) for _ in range(3)] == [None] * 3
    both = Stamped(5000 * UNIT, "odom 5000"), Stamped(5000 * UNIT, "joints 5000")
    assert fast.jump(12.8) == both, "0.2 s"


def test_a_jump_needs_two_checks_however_long_it_lasts() -> None:
    some = Filter()
    for t in (0, 4, 8):
        some.joints(t, t)
    some.joints(9, 5000)
    assert [some.jump(500) is None for _ in range(2)] == [True, False]


@pytest.mark.parametrize(("step", "known"), [(40, True), (400, True), (400.1, False)])
def test_a_plant_with_another_rate_is_known_by_two_equal_jumps(step: float, known: bool) -> None:
    some = Filter()
    some.joints(0, 0)
    for number in (1, 2):
        assert not some.joints(1000 * number, step * number)
        some.jump(1000 * number + 999)
        assert some.made.accepted_jump() is not None
    assert some.joints(2999, 3 * step) is known


def test_ignored_messages_are_counted_and_named() -> None:
    some = Filter()
    for t in (640, 644, 648):
        some.joints(t, t)
    some.odom(649, 652 + 128)
    some.joints(649, 20)
    assert some.made.ignored == 0
    assert some.joints(652, 652)
    assert some.made.ignored == 2
    assert some.made.last_ignored == (
        "A message on 'odom' is ignored: its stamp is 2 s ahead of the time of the states."
    )
    some.joints(653, 656 - 32)
    some.joints(656, 656)
    assert some.made.ignored == 3
    assert some.made.last_ignored == (
        "A message on 'joint_states' is ignored: its stamp is 0.5 s behind the time of the states."
    )


def test_a_state_that_is_withdrawn_has_not_been() -> None:
    some = Filter()
    some.joints(0, 0)
    some.made.undo_last()
    assert some.made.now_ns == 0
    assert some.joints(1, 7000), "it is the first again"
    some.joints(5, 7004)
    some.made.undo_last()
    assert some.made.now_ns == 7000 * UNIT
    assert some.joints(6, 7006)
    assert not some.joints(6, 7000)


# -- whole states -------------------------------------------------------------------------------


@pytest.mark.parametrize("pose_required", [False, True])
def test_pairs_are_handed_over_once(pose_required: bool) -> None:
    states = StateSynchroniser(pose_required=pose_required)
    assert states.take_ready() is None
    states.put_odom(5, "o5")
    assert states.take_ready() is None
    states.put_joints(5, "j5")
    assert [states.take_ready(), states.take_ready()] == [Pairing.WHOLE, None]
    states.put_joints(6, "j6")
    early = states.take_ready()
    assert early is (None if pose_required else Pairing.WITHOUT_POSE)
    assert not states.put_odom(6, "o6")
    late = Pairing.WHOLE if pose_required else Pairing.LATE_POSE
    assert [states.take_ready(), states.take_ready()] == [late, None]
    assert states.put_odom(6, "another")
    states.put_joints(6, "j6 again")
    assert states.take_ready() is Pairing.WITHOUT_POSE


@pytest.mark.parametrize("pose_required", [False, True])
def test_a_state_of_the_same_time_after_a_reset_is_new(pose_required: bool) -> None:
    states = StateSynchroniser(pose_required=pose_required)
    states.put_odom(5, "o5")
    states.put_joints(5, "j5")
    states.take_ready()
    states.forget_pose()
    assert (states.odom, states.joints) == (None, None)
    assert not states.put_odom(5, "another")
    assert states.take_ready() is None
    states.put_joints(5, "j5 anew")
    states.forget_pose()
    assert states.joints == "j5 anew", "it was not handed over yet"


def test_references_are_waited_for_where_they_are_published() -> None:
    states = StateSynchroniser(pose_required=True)
    states.require("a")
    states.require("b", required=False)
    for stamp, put in ((5, True), (6, False)):
        states.put_odom(stamp, f"o{stamp}")
        states.put_joints(stamp, f"j{stamp}")
        assert states.take_ready() is None
        if put:
            states.put_required("a", stamp, "message")
            states.require("a")
            assert states.latest("a") == "message", "it is not forgotten"
            assert states.take_ready() is Pairing.WHOLE
    states.require("a", required=False)
    assert states.latest("a") is None
    assert states.take_ready() is Pairing.WHOLE


# -- controller ---------------------------------------------------------------------------------


class Kept:
    """Keeps the calls of its methods with their arguments, in order."""

    def __init__(self, done: list[Any]) -> None:
        self.done = done

    def __getattr__(self, action: str) -> Any:
        return lambda *given, **named: self.done.append((action, *given, *named.values()))


def commander(**changes: Any) -> Any:
    """Return a stand-in for a controller that is active and has an executive."""
    done: list[Any] = []
    made: Any = SimpleNamespace(
        done=done,
        executive=Kept(done),
        active=True,
        activity=CommanderActivity.ACTIVE,
        host=SimpleNamespace(
            has_publisher=lambda topic: topic == "odom",
            send_command=lambda stamp: done.append(("send", stamp)),
            log=lambda *words: done.append(words),
        ),
        plant=SimpleNamespace(refusal_of_goals=""),
        stamps=SimpleNamespace(undo_last=lambda: done.append("withdraw")),
        _pose_has_come=False,
        _odom_was_connected=False,
        effort=np.zeros(2),
        wrench=np.zeros(6),
        _log_fault=lambda *words: done.append(words),
        _read_target=lambda decoder: None,
    )  # fmt: skip
    vars(made).update(changes)
    return made


def test_a_controller_without_a_robot_or_rest_dumps_no_momentum() -> None:
    said = (False, "The controller is not active, or has no robot yet.")
    for changes in ({"executive": None}, {"active": False}):
        assert ControllerCommander.dump_momentum(commander(**changes)) == said
    ready = commander()
    ready.executive = SimpleNamespace(dump_momentum=lambda: (True, "It is dumped."))
    assert ControllerCommander.dump_momentum(ready) == (True, "It is dumped.")


@pytest.mark.parametrize(
    ("change", "called"),
    [(change, "plant_reset" if change is PlantChange.RESET else "on_plant_obeying")
     for change in PlantChange],
)  # fmt: skip
def test_changes_of_the_plant_are_told_to_the_executive(change: PlantChange, called: str) -> None:
    made = commander()
    ControllerCommander._react_to_change(made, change)
    assert made.done == [(called,)]


@pytest.mark.parametrize("blocked", ["", "aborted"])
def test_a_blocked_plant_blocks_the_executive(blocked: str) -> None:
    made = commander(plant=SimpleNamespace(refusal_of_goals=blocked))
    ControllerCommander._forward_plant_state(made)
    assert made.executive.plant_blocked is bool(blocked)
    made.executive = None
    ControllerCommander._forward_plant_state(made)


def test_the_first_pose_is_waited_for_once_odom_is_connected() -> None:
    made = commander()
    waits = ControllerCommander._waits_for_first_pose
    assert [waits(made), waits(made), waits(made)] == [True, False, False]
    later = commander()
    later.host.has_publisher = lambda topic: False
    assert [waits(later), waits(later)] == [True, True]
    later.host.has_publisher = lambda topic: topic == "odom"
    assert [waits(later), waits(later)] == [True, False]
    assert waits(commander(_pose_has_come=True)) is False


@pytest.mark.parametrize("active", [False, True])
@pytest.mark.parametrize("waits", [False, True])
@pytest.mark.parametrize("overdue", [None, Pairing.WHOLE, Pairing.WITHOUT_POSE])
def test_a_state_without_its_odom_is_answered_when_the_next_comes(
    monkeypatch: pytest.MonkeyPatch, active: bool, waits: bool, overdue: Pairing | None
) -> None:
    made = commander(
        active=active,
        states=SimpleNamespace(take_overdue=lambda: overdue),
        _waits_for_first_pose=lambda: waits,
        _answered=True,
    )
    made._answer_state = lambda pairing, send: made.done.append((pairing, send))
    monkeypatch.setattr(controller, "super", lambda: Kept(made.done), raising=False)
    ControllerCommander.take_joints(made, 7, "joints")
    answered = active and not waits and overdue is not None
    assert made.done == [(overdue, overdue is Pairing.WHOLE)] * answered + [
        ("take_joints", 7, "joints")
    ]


def answering(pairing: Pairing, *, send: bool = True, fails: Exception | None = None) -> Any:
    """Return a controller that has answered one state at 1.5 s, whose efforts are 3 and 4."""
    made = commander(states=SimpleNamespace(joints="joints", odom="odom"))
    realised = SimpleNamespace(tau=[3.0, 4.0], wrench_B=np.arange(6.0))

    def command(*given: Any) -> Any:
        made.done.append(("command", *given))
        if fails is not None:
            raise fails
        return SimpleNamespace(realised=realised)

    made.executive = SimpleNamespace(
        command=command, evaluate=lambda now, result: made.done.append(("evaluate", now))
    )

    def decode_joints(joints: str) -> int:
        if isinstance(fails, CommandError):
            raise fails
        return 3 * SECOND // 2

    made._decoder = SimpleNamespace(
        decode_joints=decode_joints, q="q", qdot="qdot",
        measured_base=lambda odom: (np.arange(7.0), np.arange(10.0, 16.0)),
    )  # fmt: skip
    made._reference = lambda decoder: "reference"
    made._measured = None
    made._measured_state = partial(ControllerCommander._measured_state, made)
    ControllerCommander._answer_state(made, pairing, send=send)
    return made


@pytest.mark.parametrize("send", [False, True])
def test_a_whole_state_is_answered_with_its_pose(send: bool) -> None:
    made = answering(Pairing.WHOLE, send=send)
    (_, now, measured, q, qdot, reference), *rest = made.done
    assert (now, q, qdot, reference) == (1.5, "q", "qdot", "reference")
    parts = (measured.r_WB, measured.quaternion_WB, measured.v_WB_B, measured.omega_WB_B)
    assert [part.tolist() for part in parts] == [
        [0, 1, 2], [3, 4, 5, 6], [10, 11, 12], [13, 14, 15]]  # fmt: skip
    assert rest == [*([("send", 1_500_000_000)] if send else []), ("evaluate", 1.5)]
    assert made.effort.tolist() == [3.0, 4.0]
    assert made.wrench.tolist() == [0, 1, 2, 3, 4, 5]
    assert made._pose_has_come


def test_a_state_without_a_pose_is_answered_by_the_estimate() -> None:
    made = answering(Pairing.WITHOUT_POSE)
    assert made.done[0][:3] == ("command", 1.5, None)
    assert not made._pose_has_come


@pytest.mark.parametrize(
    "error", [CommandError("joint 'x' is unknown."), NotFiniteError("It is nan.")]
)
def test_a_state_that_is_refused_is_not_answered(error: Exception) -> None:
    made = answering(Pairing.WHOLE, fails=error)
    refused = ("state", f"The state is refused: {error}")
    if isinstance(error, CommandError):
        assert made.done == ["withdraw", refused]
    else:
        assert made.done[1:] == [refused]
    assert made.effort.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("executive", [False, True])
@pytest.mark.parametrize("activity", list(CommanderActivity))
@pytest.mark.parametrize("pairing", [None, Pairing.WHOLE])
def test_only_an_active_controller_with_a_robot_answers(
    executive: bool, activity: CommanderActivity, pairing: Pairing | None
) -> None:
    made = commander(activity=activity, states=SimpleNamespace(take_ready=lambda: pairing))
    made._answer_state = made.done.append
    if not executive:
        made.executive = None
    ControllerCommander.answer(made)
    answered = executive and activity is CommanderActivity.ACTIVE and pairing is not None
    assert made.done == [pairing] * answered


def test_goals_are_submitted_resumed_and_aborted() -> None:
    made = commander(_refuse_goal=None)
    made._refuse_goal = lambda *words: made.done.append(("refuse", *words))
    goal: Any = SimpleNamespace(goal_id="7.5")
    ControllerCommander._submit_goal(made, "base", goal)
    assert made.done == [("submit", "base", goal)]

    def refuse(key: str, goal: Any) -> None:
        raise PlanningError("It is too far.")

    made.executive = SimpleNamespace(submit=refuse)
    made._leaves_to_planner = lambda *words: False
    ControllerCommander._submit_goal(made, "base", goal)
    assert made.done[1:] == [("refuse", "It is too far.", "7.5")]
    for executive in (True, False):
        made = commander()
        if not executive:
            made.executive = None
        saved = {"base": goal}
        ControllerCommander._resume_goals(made, saved)
        line = ("info", "Resuming an earlier goal.")
        assert made.done == [*([("resume", saved)] if executive else []), line]
        if not executive:
            assert made._waiting_goals == saved
        made.done.clear()
        ControllerCommander._resume_goals(made, {})
        assert made.done == [("resume", {})] * executive
        made.done.clear()
        told = ControllerCommander._abort_goal(made, "after a while")
        assert told == ("The robot holds where it is." if executive else None)
        assert made.done == [("abort", "after a while")] * executive


@pytest.mark.parametrize("base", [None, "pose"])
@pytest.mark.parametrize("joints", [None, "shape"])
def test_references_of_others_have_a_base_or_joints(
    monkeypatch: pytest.MonkeyPatch, base: str | None, joints: str | None
) -> None:
    given = {controller.BASE_REFERENCE: base, controller.JOINT_REFERENCE: joints}
    made = commander(states=SimpleNamespace(latest=given.get))
    made._held_velocities = SimpleNamespace(at_command=lambda q, qdot: f"{q} and {qdot}")
    decoder: Any = SimpleNamespace(
        decode_base=lambda message: (np.arange(7.0), np.arange(10.0, 16.0)),
        joint_reference=lambda message: (message, "rates"),
    )
    monkeypatch.setattr(
        PoseReference,
        "with_body_twist",
        classmethod(lambda cls, *parts: [part.tolist() for part in parts]),
    )
    found: Any = ControllerCommander._reference(made, decoder)
    if base is None and joints is None:
        assert found is None
        return
    assert found is not None
    whole: Any = [[0, 1, 2], [3, 4, 5, 6], [10, 11, 12], [13, 14, 15]]
    assert found.base == (None if base is None else whole)
    assert found.joints == (None if joints is None else "shape and rates")


def test_the_latest_odometry_of_the_target_is_read_once() -> None:
    measured: list[Any] = []
    target = SimpleNamespace(measure=lambda *given: measured.append(given))
    made = commander(executive=SimpleNamespace(servicing=SimpleNamespace(target=target)))
    decoder: Any = SimpleNamespace(target=lambda message: (f"pose of {message}", "twist"))
    made._target_odometry = (2_500_000_000, "message")
    for _ in range(2):
        ControllerCommander._read_target(made, decoder)
    assert measured == [(2.5, "pose of message", "twist")]
    assert made._target_odometry is None
