"""Methods of replay, recorder and watchdog, and of messages, with stand-ins for clocks and ROS."""

from __future__ import annotations

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, TransformStamped
from sensor_msgs.msg import JointState

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.errors import PlanningError, RecordingError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model.rotations import compose_poses
from spacerobot_ros.nodes import recorder, replay
from spacerobot_ros.nodes.common import messages, ros_parameters, watchdog
from spacerobot_ros.nodes.common.messages import KnownFrames
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.common.watchdog import (
    HeartbeatState,
    Liveness,
    Role,
    SilenceReport,
    Watchdog,
)
from spacerobot_ros.nodes.recorder import RecorderNode
from spacerobot_ros.nodes.replay import ReplayNode
from spacerobot_ros.planning import Goal
from spacerobot_ros.times import LATEST_NS

S = 10**9


class Calls:
    """Keeps the calls of its methods with their arguments, in order, under a name."""

    def __init__(self, done: list[Any], name: str) -> None:
        self._done, self._name = done, name

    def __getattr__(self, action: str) -> Callable[..., None]:
        return lambda *given, **named: self._done.append(
            (f"{self._name}.{action}", *given, *named.values())
        )


# -- replay -------------------------------------------------------------------------------------


class Playback:
    """A bag from 100 s to 104 s, of which 1.5 s have been replayed."""

    duration_s, start_ns, ended = 4.0, 100 * S, False
    bag_ns, due = 101_500_000_000, None

    def __init__(self, done: list[Any]) -> None:
        self.done = done

    def bag_time(self, now: int) -> int:
        assert now == 7
        return self.bag_ns

    def next_due_time(self) -> int | None:
        return self.due

    def __getattr__(self, action: str) -> Callable[..., None]:
        return lambda *given: self.done.append((action, *given))


def replaying(**changes: Any) -> Any:
    done: list[Any] = []
    node: Any = SimpleNamespace(
        done=done,
        config=SimpleNamespace(hold=False, rate=2.5, clock=20.0, wait=3.0),
        _playback=Playback(done),
        _timer=SimpleNamespace(
            cancel=lambda: done.append("cancel"), reset=lambda: done.append("reset")
        ),
        _waiting=SimpleNamespace(cancel=lambda: done.append("wait over")),
        _outputs=[],
        _paused=False, _begun=True, _last_clock=-1, messages_replayed=12,
        _clock_publisher=Calls(done, "clock"),
        _status_topic=Calls(done, "status"),
        _steady="steady",
        get_fully_qualified_name=lambda: "/replay",
        on_end=lambda code: done.append(("end", code)),
        _now=lambda: 7,
    )  # fmt: skip
    log = Calls(done, "log")
    node.get_logger = lambda: log
    for name in ("_set_timer", "_publish_status", "_seek", "_begin", "_publish_clock"):
        setattr(node, name, lambda *given, name=name: done.append((name, *given)))
    vars(node).update(changes)
    return node


@pytest.mark.parametrize(
    ("due", "period"),
    [(7 + 3 * S, 3 * S), (7, 1), (3, 1), (8, 1), (9, 2), (7 + 3600 * S, 3600 * S),
     (7 + 3601 * S, 3600 * S)],
)  # fmt: skip
def test_the_timer_of_a_replay_is_set_to_the_next_message(due: int, period: int) -> None:
    node = replaying()
    node._playback.due = due
    ReplayNode._set_timer(node)
    assert (node._timer.timer_period_ns, node.done) == (period, ["reset"])
    node._playback.due = None
    ReplayNode._set_timer(node)
    assert node.done == ["reset", "cancel"]


@pytest.mark.parametrize("paused", [False, True])
def test_a_replay_begins_when_its_readers_are_there(paused: bool) -> None:
    checked: list[Any] = []
    met = [False]

    def check(matched: list[int], known: list[int]) -> bool:
        checked.append((matched, known))
        return met[0]

    outputs = [
        SimpleNamespace(topic_name=name, get_subscription_count=lambda count=count: count)
        for name, count in (("/a", 1), ("/b", 0))
    ]
    node = replaying(_outputs=outputs, _wait=SimpleNamespace(may_begin=check), _paused=paused)
    node.count_subscribers = {"/a": 2, "/b": 3}.get
    ReplayNode._on_reader_check(node)
    assert node.done == []
    met[0] = True
    ReplayNode._on_reader_check(node)
    assert node.done == [("_begin",)]
    assert checked == [([1, 0], [2, 3])] * 2
    node.done.clear()
    node._begun = False
    ReplayNode._begin(node)
    assert node._begun
    assert node.done == ["wait over", *([] if paused else [("run", 7)]), ("_set_timer",)]


@pytest.mark.parametrize(
    ("wait", "rate", "periods"),
    [
        (3.0, 0.0, [1.0, 0.05, 0.2]),
        (3.0, 20.0, [1.0, 0.05, 0.2, 0.05]),
        (0.0, 4.0, [1.0, 0.05, 0.2, 0.25]),
    ],
)
def test_an_active_replay_has_its_timers(wait: float, rate: float, periods: list[float]) -> None:
    made: list[float] = []
    done: list[Any] = []

    def create(period: float, call: object, clock: str) -> Any:
        assert clock == "steady"
        made.append(period)
        return SimpleNamespace(cancel=lambda: done.append(period))

    node: Any = replaying(create_timer=create, _begun=True, done=done)
    node._begin = lambda: done.append(("_begin",))
    node._playback.done = done
    node.config.wait, node.config.clock = wait, rate
    for name in ("_send_due_messages", "_on_reader_check", "_on_clock"):
        setattr(node, name, None)
    ReplayNode.activate(node)
    assert made == periods
    assert len(node._playing_timers) == len(periods)
    assert node.done == [1.0, *([] if wait else [("_begin",)])]
    assert node._begun is False
    destroyed: list[Any] = []
    node.done.clear()
    node.destroy_timer = destroyed.append
    ReplayNode.deactivate(node)
    ReplayNode.deactivate(node)
    assert (len(destroyed), node.done) == (len(periods), [("pause", 7)])


def test_times_are_published_once_and_no_later_than_a_clock_can_show() -> None:
    node = replaying()
    for time_ns in (0, 5, 5, 3, LATEST_NS, LATEST_NS + 1, LATEST_NS + 9):
        ReplayNode._publish_clock(node, time_ns)
    stamps = [call[1].clock.sec * S + call[1].clock.nanosec for call in node.done]
    assert stamps == [0, 5, 3, LATEST_NS]
    ReplayNode._on_clock(node)
    assert node.done[-1] == ("_publish_clock", 101_500_000_000)
    node._begun = False
    ReplayNode._on_clock(node)
    assert len(node.done) == 5


@pytest.mark.parametrize(("hold", "ended"), [(False, False), (False, True), (True, True)])
def test_a_replay_ends_or_holds_at_its_end(hold: bool, ended: bool) -> None:
    node = replaying()
    node.config.hold, node._playback.ended = hold, ended
    node._outputs = [SimpleNamespace(wait_for_all_acked=lambda t: node.done.append(t.nanoseconds))]
    ReplayNode._end_if_done(node)
    said = ("log.info", "The replay has ended: 12 messages.")
    assert node.done == [
        *(["cancel"] if ended else []),
        *([("pause", 7), ("_publish_status",)] if hold else []),
        *([2 * S, said, ("end", 0)] if ended and not hold else []),
    ]
    assert node._paused is hold


@pytest.mark.parametrize("fails", [False, True])
def test_messages_that_are_due_are_sent_until_the_bag_is_bad(fails: bool) -> None:
    node: Any = replaying(sent=[], _end_if_done=lambda: node.done.append("maybe done"))

    def take(now: int, most: int) -> list[str]:
        assert (now, most) == (7, replay._MAX_MESSAGES_AT_ONCE)
        if fails:
            raise RecordingError("It is cut off.")
        return ["a", "b"]

    node._playback.take_due, node._send = take, node.sent.append
    node._end_with_error = lambda error: ReplayNode._end_with_error(node, error)
    ReplayNode._send_due_messages(node)
    said = ("log.error", "The replay has ended: It is cut off.")
    bad = ["cancel", said, ("end", replay._BAD_BAG_EXIT_CODE)]
    assert node.done == (bad if fails else [("_set_timer",), "maybe done"])
    assert node.sent == ([] if fails else ["a", "b"])
    assert replay._BAD_BAG_EXIT_CODE != 0


@pytest.mark.parametrize("ended", [False, True])
@pytest.mark.parametrize("begun", [False, True])
def test_a_replay_that_has_ended_begins_anew_when_it_is_resumed(begun: bool, ended: bool) -> None:
    node = replaying(_begun=begun, _paused=False)
    node._playback.ended = ended
    assert ReplayNode._set_paused(node, True) == "paused"
    assert node._paused
    timer = [("_set_timer",)]
    assert node.done == [*([("pause", 7), *timer] if begun else []), ("_publish_status",)]
    node.done.clear()
    assert ReplayNode._set_paused(node, False) == "running"
    seek = [("_seek", 100 * S)] if ended else []
    assert node.done == [*([*seek, ("run", 7), *timer] if begun else []), ("_publish_status",)]


@pytest.mark.parametrize(
    ("bag_ns", "position"), [(101_500_000_000, 1.5), (99 * S, 0.0), (109 * S, 4.0)]
)
@pytest.mark.parametrize("begun", [False, True])
def test_a_replay_tells_where_it_is(bag_ns: int, position: float, begun: bool) -> None:
    node = replaying(_begun=begun)
    node._playback.bag_ns = bag_ns
    ReplayNode._publish_status(node)
    ((_, status),) = node.done
    assert status.message == f"The replay is at {position:.3f} s of 4.000 s."
    assert (status.name, status.level) == ("/replay", b"\0")
    read = ReplayStatus.from_values({pair.key: pair.value for pair in status.values})
    assert read == ReplayStatus(position, 4.0, not begun, False, 2.5)


@pytest.mark.parametrize(
    ("depth", "durability", "kept"),
    [
        (7, "volatile", 7),
        (0, "volatile", 100),
        (0, "transient_local", 1),
        (3, "transient_local", 3),
    ],
)
@pytest.mark.parametrize("reliability", ["reliable", "best_effort"])
def test_a_replay_publishes_as_was_recorded(
    depth: int, durability: str, kept: int, reliability: str
) -> None:
    given: Any = SimpleNamespace(depth=depth, durability=durability, reliability=reliability)
    qos = replay._publisher_qos(given)
    found = (qos.depth, qos.durability.name.lower(), qos.reliability.name.lower())
    assert found == (kept, durability, reliability)
    given.depth = 10**9
    assert replay._publisher_qos(given).depth == replay._MAX_QUEUE_DEPTH


# -- recorder -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arrivals", "quiet", "spins", "end"),
    [
        ([], 0.3, 4, 50.4),  # 0.3 s are not enough: it waits for longer than that.
        ([50.2], 0.3, 6, 50.6),
        ([50.05 + 0.1 * i for i in range(40)], 0.3, 12, 51.2),
        ([], 0.9, 10, 51.0),
    ],
)
def test_a_recorder_waits_for_messages_that_are_on_their_way(
    monkeypatch: pytest.MonkeyPatch, arrivals: list[float], quiet: float, spins: int, end: float
) -> None:
    now = [500]  # tenths of a second
    steps: list[float] = []
    recording = SimpleNamespace(running=True, messages=3)

    def spin(*, timeout_sec: float) -> None:
        steps.append(timeout_sec)
        now[0] += 1
        recording.messages += sum(now[0] - 1 < 10 * at <= now[0] for at in arrivals)

    monkeypatch.setattr(recorder, "time", SimpleNamespace(monotonic=lambda: now[0] / 10))
    node: Any = SimpleNamespace(recording=recording)
    RecorderNode.drain(node, SimpleNamespace(spin_once=spin), quiet)
    assert len(steps) == pytest.approx(spins, abs=1)
    assert now[0] / 10 == pytest.approx(end, abs=0.101)
    assert set(steps) == {0.001}
    steps.clear()
    recording.running = False
    RecorderNode.drain(node, SimpleNamespace(spin_once=spin), quiet)
    node.recording = None
    RecorderNode.drain(node, SimpleNamespace(spin_once=spin), quiet)
    assert not steps


@pytest.mark.parametrize(
    ("failure", "code", "ended", "line"),
    [(None, 0, 0, ""), (None, 3, 3, ""), ("It is full.", 0, 1, "It is full.\n"),
     ("It is full.", 3, 3, "")],
)  # fmt: skip
def test_a_recording_that_has_failed_is_an_exit_code(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    failure: str | None,
    code: int,
    ended: int,
    line: str,
) -> None:
    made: list[Any] = []

    def make() -> Any:
        made.append(SimpleNamespace(failure=failure and RecordingError(failure)))
        return made[-1]

    def run(make: Callable[[], Any]) -> int:
        assert make() is made[0]
        return code

    monkeypatch.setattr(recorder, "RecorderNode", make)
    monkeypatch.setattr(recorder, "run_node", run)
    with pytest.raises(SystemExit) as exit_:
        recorder.main()
    assert exit_.value.code == ended
    assert capsys.readouterr().err == line
    monkeypatch.setattr(recorder, "run_node", lambda make: 4)
    with pytest.raises(SystemExit) as exit_:
        recorder.main()
    assert exit_.value.code == 4


@pytest.mark.parametrize(
    ("topic", "type_name", "chosen", "recorded"),
    [
        ("/left/odom", "nav_msgs/msg/Odometry", "", True),
        ("/right/odom", "nav_msgs/msg/Odometry", "", False),
        ("/leftover", "nav_msgs/msg/Odometry", "", False),
        ("/left/clock", "rosgraph_msgs/msg/Clock", "", False),
        ("/clock", "rosgraph_msgs/msg/Clock", "", True),
        ("/left/plant/transition_event", "lifecycle_msgs/msg/TransitionEvent", "", False),
        ("/left/odom", "nav_msgs/msg/Odometry", "/right/odom", False),
        ("/right/odom", "nav_msgs/msg/Odometry", "/right/odom", True),
        ("/clock", "rosgraph_msgs/msg/Clock", "/right/odom", False),
    ],
)
def test_a_recorder_takes_its_own_stack(
    topic: str, type_name: str, chosen: str, recorded: bool
) -> None:
    node: Any = SimpleNamespace(
        _chosen_topics=set(chosen.split()), _shared_topics={"/clock"},
        get_namespace=lambda: "/left/",
    )  # fmt: skip
    assert RecorderNode._is_chosen(node, topic, type_name) is recorded


# -- watchdog -----------------------------------------------------------------------------------


class Beating:
    """The liveness of a node, with what it publishes and does, on a clock by hand."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *depends_on: Role) -> None:
        self.now = 20.0
        self.published: list[Any] = []
        self.timers: list[Any] = []
        self.destroyed: list[Any] = []
        self.silences: list[SilenceReport] = []
        self.topics: list[str] = []
        monkeypatch.setattr(watchdog, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(
            watchdog, "Watchdog", lambda timeout: Watchdog(timeout, lambda: self.now)
        )
        self.contexts: list[Any] = []
        monkeypatch.setattr(watchdog, "compilation_contexts", self.contexts)
        publisher = SimpleNamespace(publish=self.published.append)
        node: Any = SimpleNamespace(
            create_publisher=lambda kind, topic, qos: self.topics.append(topic) or publisher,  # type: ignore[func-returns-value]
            create_subscription=lambda kind, topic, call, qos: self.topics.append(f"hears {topic}"),
            create_timer=self.create,
            destroy_timer=self.destroyed.append,
            get_fully_qualified_name=lambda: "/own",
        )
        self.liveness = Liveness(node, Role.PLANT, depends_on, self.silences.append)

    def create(self, period: float, call: Callable[[], None], clock: Any) -> str:
        self.timers.append((period, clock.clock_type.name))
        return f"timer {len(self.timers)}"

    def pulses(self) -> list[str]:
        found, self.published[:] = [each.message for each in self.published], []
        return found

    def hear(self, name: str, pulse: str = "active", role: str = "commander") -> None:
        self.liveness._on_heartbeat(DiagnosticStatus(name=name, message=pulse, hardware_id=role))


@pytest.mark.parametrize("timeout", [0.0, 0.75])
@pytest.mark.parametrize("depends_on", [(), (Role.COMMANDER,)])
def test_a_node_beats_while_it_is_active_and_says_when_it_is_busy(
    monkeypatch: pytest.MonkeyPatch, timeout: float, depends_on: tuple[Role, ...]
) -> None:
    node = Beating(monkeypatch, *depends_on)
    watches = bool(timeout and depends_on)
    node.liveness.configure(timeout)
    assert node.topics == ["heartbeat", *(["hears heartbeat", "/diagnostics"] if watches else [])]
    node.liveness.beat()
    node.liveness.end()
    assert node.pulses() == [], "it is not active"
    node.liveness.begin()
    assert node.timers == [(0.2, "STEADY_TIME"), *([(0.1, "STEADY_TIME")] if watches else [])]
    (beat,) = node.published
    assert (beat.name, beat.hardware_id) == ("/own", "plant")
    assert node.pulses() == ["active"]
    assert len(node.contexts) == 1
    with node.liveness.busy():
        with node.liveness.busy():
            pass
        node.liveness.beat()
    assert node.pulses() == ["busy"] * 4 + ["active"]
    assert (node.liveness._watchdog is not None) is watches
    node.liveness.end()
    node.liveness.end()
    assert node.pulses() == [HeartbeatState.INACTIVE.value]
    assert len(node.destroyed) == len(node.timers)
    assert node.contexts == []
    assert node.liveness._watchdog is None
    node.liveness._look()
    assert node.pulses() == []


def test_silent_nodes_are_in_the_diagnostics_every_second(monkeypatch: pytest.MonkeyPatch) -> None:
    node = Beating(monkeypatch, Role.COMMANDER)
    node.liveness.configure(0.75)
    node.liveness.begin()
    node.published.clear()
    for name, role in (
        ("/own", "commander"),
        ("/b", "commander"),
        ("/c", "plant"),
        ("/a", "commander"),
    ):
        node.hear(name, role=role)
    reports: list[float] = []
    for _ in range(30):
        node.now += 0.125
        node.hear("/b")
        node.liveness._look()
        reports += [node.now - 20.0] * len(node.published)
        for array in node.published:
            (status,) = array.status
            assert (status.level, status.hardware_id) == (DiagnosticStatus.ERROR, "plant")
            assert (status.name, status.message) == ("own: watchdog", "silent: /a")
            assert [(pair.key, pair.value) for pair in status.values] == [("/a", "silent")]
        node.published.clear()
    assert reports == [0.875, 1.875, 2.875]
    assert [(each.name, each.over) for each in node.silences] == [("/a", False)]
    node.hear("/a")
    ((status,),) = (array.status for array in node.published)
    assert (status.level, status.message) == (DiagnosticStatus.OK, "all nodes send heartbeats")
    assert [(pair.key, pair.value) for pair in status.values] == [("/a", "back")]
    assert node.silences[-1].over
    assert node.silences[-1].seconds == 3.75


@pytest.mark.parametrize(("gap", "found"), [(0.25, 1), (0.3125, 0)])
def test_a_node_that_was_suspended_gives_the_others_their_time_again(
    gap: float, found: int
) -> None:
    now = [10.0]
    dog = Watchdog(0.5, lambda: now[0])
    dog.hear("/a", "active")
    for seconds in (0.28125, gap):
        now[0] += seconds
        lost = dog.look()
    assert len(lost) == found
    assert SilenceReport("/a", 0.123).message == "Node '/a' is silent for 0.12 s."
    assert SilenceReport("/a", 12.6, over=True).message == "Node '/a' is back after 13 s."


@pytest.mark.parametrize("over", [False, True])
def test_a_node_that_is_silent_or_back_is_an_event(over: bool) -> None:
    done: list[Any] = []
    log = Calls(done, "log")
    node: Any = SimpleNamespace(get_logger=lambda: log, report_event=done.append)
    silence = SilenceReport("/plant", 1.23456, over=over)
    FlightNode.on_silence(node, silence)
    line, event = done
    assert line == ("log.info" if over else "log.error", silence.message)
    assert event.kind is (EventKind.NODE_BACK if over else EventKind.NODE_SILENT)
    assert (event.level, event.message) == (0 if over else 2, silence.message)
    assert event.about == {"node": "/plant", "silent_s": "1.235"}


# -- messages -----------------------------------------------------------------------------------


def vector(cls: Any, values: list[float]) -> Any:
    return cls(**dict(zip("xyzw", values, strict=False)))


@pytest.mark.parametrize(
    ("quaternion", "found"),
    [
        ([0.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]),
        ([0.0, 3.0, 0.0, 4.0], [0.0, 0.6, 0.0, 0.8]),
        ([0.0, 0.0, 1.5e-6, 0.0], [0.0, 0.0, 1.0, 0.0]),
        ([0.0, 0.0, 0.5e-6, 0.0], None),
        ([0.0, math.inf, 0.0, 1.0], None),
    ],
)
def test_poses_of_messages_have_quaternions_of_norm_one(
    quaternion: list[float], found: list[float] | None
) -> None:
    pose = messages.pose_array(
        vector(SimpleNamespace, [1.0, -2.0, 3.0]), vector(SimpleNamespace, quaternion)
    )
    if found is None:
        assert pose is None
    else:
        assert pose is not None
        np.testing.assert_allclose(pose, [1.0, -2.0, 3.0, *found], atol=1e-15)


QUARTER = math.sqrt(0.5)


def test_composed_poses_turn_the_inner_one() -> None:
    outer = np.array([1.0, 2.0, 3.0, 0.0, 0.0, QUARTER, QUARTER])  # a quarter about z
    inner = np.array([0.5, 0.25, -1.0, QUARTER, 0.0, 0.0, QUARTER])  # a quarter about x
    composed = compose_poses(outer, inner)
    np.testing.assert_allclose(composed, [0.75, 2.5, 2.0, 0.5, 0.5, 0.5, 0.5], atol=1e-15)


def goal_in(frame: str) -> PoseStamped:
    message = PoseStamped()
    message.header.frame_id = frame
    messages.set_pose(message.pose, np.array([0.5, 0.25, -1.0]), np.array([0.0, 0.0, 0.0, 1.0]))
    return message


@pytest.mark.parametrize("frame", ["", "world", "/world", "hand", "/hand", "wing"])
def test_goals_are_taken_in_the_frames_that_are_known(frame: str) -> None:
    known = {"hand": np.array([1.0, 2.0, 3.0, 0.0, 0.0, QUARTER, QUARTER])}
    if frame == "wing":
        with pytest.raises(PlanningError, match=r"^The tip is in frame 'wing'; goals"):
            messages.goal_of(goal_in(frame), "world", "The tip", None, known.get)
        return
    goal = messages.goal_of(goal_in(frame), "world", shape=np.ones(2), pose_of=known.get)
    moved = frame.endswith("hand")
    np.testing.assert_allclose(goal.position, [0.75, 2.5, 2.0] if moved else [0.5, 0.25, -1.0])
    turn = [0.0, 0.0, QUARTER, QUARTER] if moved else [0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(goal.quaternion, turn, atol=1e-15)
    assert goal.joint_positions is not None
    text = messages.goal_description("base", "1.5", goal_in(frame), goal)
    said = (
        "(0.75, 2.5, 2) m, (0, 0, 0.7071, 0.7071)" if moved else "(0.5, 0.25, -1) m, (0, 0, 0, 1)"
    )
    assert text.startswith(f"Goal 1.5 of the base: {said}")
    assert text.endswith(f", given in '{frame}'." if frame else ").")


def test_shapes_of_goals_are_in_the_order_of_the_robot() -> None:
    names = ["a", "b", "c"]
    message = JointState(name=["c", "x", "a", "b"], position=[3.0, 9.0, 1.0, 2.0])
    assert messages.shape_of(message, names).tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(PlanningError, match="joint 'c' is missing"):
        messages.shape_of(JointState(name=["a", "b"], position=[1.0, 2.0]), [*names, "d"])
    message.position[1] = math.nan
    with pytest.raises(PlanningError, match="is not finite"):
        messages.shape_of(message, names)
    goal = Goal.checked([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0], np.array([1.0, 2.0, 3.0]))
    sent = messages.shape_message(goal, names)
    assert (sent.name, list(sent.position)) == (names, [1.0, 2.0, 3.0])


def frames_of(*steps: tuple[str, str, list[float]]) -> KnownFrames:
    """Return the frames of steps: child, parent, and position in it."""
    frames = object.__new__(KnownFrames)
    parents = {
        child: (parent, np.array([*position, 0.0, 0.0, 0.0, 1.0]))
        for child, parent, position in steps
    }
    frames._received_parents = lambda: parents  # type: ignore[method-assign]
    return frames


def test_frames_are_chained_up_to_the_world_and_never_in_a_circle() -> None:
    frames = frames_of(
        ("hand", "arm", [1.0, 0.0, 0.0]), ("arm", "base", [0.0, 2.0, 0.0]),
        ("a", "b", [1.0, 0.0, 0.0]), ("b", "a", [1.0, 0.0, 0.0]), ("loose", "off", [1.0, 0.0, 0.0]),
    )  # fmt: skip
    own = {"base": ("world", np.array([0.0, 0.0, 3.0, 0.0, 0.0, QUARTER, QUARTER]))}
    pose = frames.pose("hand", "world", own)
    assert pose is not None
    np.testing.assert_allclose(pose[:3], [-2.0, 1.0, 3.0], atol=1e-15)
    assert frames.pose("world", "world", {}) is not None
    assert frames.pose("a", "world", own) is None
    assert frames.pose("loose", "world", own) is None
    own["arm"] = ("world", np.array([0.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0]))
    pose = frames.pose("hand", "world", own)
    assert pose is not None
    assert pose[:3].tolist() == [1.0, 0.0, 7.0], "its own frames override"


@pytest.mark.parametrize(("length", "found"), [(999, True), (1000, False)])
def test_chains_of_frames_are_limited(length: int, found: bool) -> None:
    chain = frames_of(*((f"{i}", f"{i + 1}", [1.0, 0.0, 0.0]) for i in range(length)))
    pose = chain.pose("0", str(length), {})
    assert (pose is not None) is found
    if pose is not None:
        assert pose[0] == length


def test_transforms_without_a_pose_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def transform(child: str, x: float, w: float) -> Any:
        message = TransformStamped(child_frame_id=child)
        message.header.frame_id = "world"
        message.transform.translation.x, message.transform.rotation.w = x, w
        return message

    batches = {
        b"static": [transform("a", 1.0, 1.0), transform("b", 2.0, 1.0)],
        b"recent": [
            transform("b", 3.0, 2.0),
            transform("c", math.nan, 1.0),
            transform("d", 1.0, 0.0),
        ],
    }

    def read(raw: bytes, kind: Any) -> Any:
        if raw not in batches:
            raise RuntimeError("no TFMessage")
        return SimpleNamespace(transforms=batches[raw])

    monkeypatch.setattr(messages, "deserialize_message", read)
    made: list[Any] = []
    node = SimpleNamespace(
        create_subscription=lambda kind, topic, call, qos, raw: made.append((topic, call, qos, raw))
    )
    monkeypatch.setattr(messages, "transform_class", lambda: "TFMessage")
    frames = KnownFrames(node)
    (recent, static) = made
    assert (recent[0], recent[2].depth, recent[3]) == ("/tf", 100, True)
    assert (static[0], static[2].depth, static[3]) == ("/tf_static", 100, True)
    assert static[2].durability.name == "TRANSIENT_LOCAL"
    for raw in (b"broken", b"recent"):
        recent[1](raw)
    static[1](b"static")
    found = frames._received_parents()
    assert {child: (parent, pose[0]) for child, (parent, pose) in found.items()} == {
        "a": ("world", 1.0), "b": ("world", 3.0),
    }  # fmt: skip
    for number in range(300):
        recent[1](b"%d" % number)
        static[1](b"%d" % number)
    assert (len(frames._recent), len(frames._static)) == (200, 100)
    monkeypatch.setattr(messages, "transform_class", lambda: None)
    KnownFrames(node)
    assert len(made) == 2


# -- parameters ---------------------------------------------------------------------------------


def described(default: Any, minimum: float = -math.inf, maximum: float = math.inf) -> Any:
    parameter: Any = SimpleNamespace(
        name="a", description="It is.", unit="m", choices=("x", "y"), default=default,
        minimum=minimum, maximum=maximum,
    )  # fmt: skip
    return ros_parameters._descriptor(parameter)


def test_descriptors_have_the_ranges_of_their_types() -> None:
    plain = described(1.5)
    assert (plain.description, plain.additional_constraints) == ("It is. [m]", "one of: x, y")
    assert not list(plain.floating_point_range)
    for low, high in ((0.5, math.inf), (-math.inf, 2.5), (-1.0, 3.0)):
        (span,) = described(1.5, low, high).floating_point_range
        largest = 1.7976931348623157e308
        assert (span.from_value, span.to_value) == (max(low, -largest), min(high, largest))
        (whole,) = described(2, round(max(low, -9.0)) if low > -9 else low, high).integer_range
        assert whole.from_value == (round(low) if low > -9 else -(2**63))
        assert whole.to_value == (int(high) if high < 9 else 2**63 - 1)
    for default in ("text", True, (1.0, 2.0)):
        spans = described(default, 0.0, 1.0)
        assert not [*spans.floating_point_range, *spans.integer_range]


class AskedNode:
    """A node whose services are ready from a look on, and answer some looks after the request."""

    def __init__(self, ready: int, delay: int, lost: int = 0) -> None:
        self.ready, self.delay, self.lost = ready, delay, lost
        self.looked, self.requests, self.destroyed = 0, [], 0  # type: ignore[var-annotated]

    def create_client(self, kind: Any, name: str) -> Any:
        return self

    def destroy_client(self, client: Any) -> None:
        self.destroyed += 1

    def service_is_ready(self) -> bool:
        return self.looked >= self.ready

    def call_async(self, request: Any) -> Any:
        self.requests.append(self.looked)
        at = self.looked + self.delay if len(self.requests) > self.lost else 10**9
        return SimpleNamespace(done=lambda: self.looked >= at, result=lambda: "answer")


@pytest.mark.parametrize(
    ("ready", "delay", "lost", "requests", "looks"),
    [
        (0, 2, 0, [3], 5),
        (7, 2, 0, [10], 12),
        (0, 49, 0, [3], 52),
        (0, 5, 1, [3, 53], 58),
        (0, 60, 2, [3, 53, 103, 153], 200),
        (300, 0, 0, [], 200),
    ],
)
def test_a_service_is_asked_once_it_is_connected_and_again_when_it_is_late(
    ready: int, delay: int, lost: int, requests: list[int], looks: int
) -> None:
    node = AskedNode(ready, delay, lost)
    asking: Any = SimpleNamespace(_node=node, name="/plant")
    call = ros_parameters.RemoteParameters._call(asking, None, "get_parameters", "request")
    answered = None
    while True:
        try:
            assert next(call) is False
        except StopIteration as end:
            answered = end.value
            break
        node.looked += 1
    assert (node.requests, node.looked, node.destroyed) == (requests, looks, 1)
    assert answered == ("answer" if looks < 200 else None)
