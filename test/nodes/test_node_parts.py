"""Methods of nodes by themselves, with stand-ins for the node, its publishers and its clock."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.exceptions import InvalidTopicNameException
from std_srvs.srv import SetBool, Trigger

from spacerobot_ros.bag import RecordingState
from spacerobot_ros.errors import CommandError, ParameterError, RecordingError, SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.messages.builders import TRANSFORM_TYPE
from spacerobot_ros.nodes import recorder, replay
from spacerobot_ros.nodes.plant.node import PlantNode
from spacerobot_ros.nodes.recorder import RecorderNode
from spacerobot_ros.nodes.replay import ReplayNode
from spacerobot_ros.simulation.status import PlantState
from spacerobot_ros.times import LATEST_NS

S = 10**9


class Lines:
    """A logger that keeps its lines."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    def __getattr__(self, level: str) -> Callable[..., None]:
        return lambda message, **_: self.lines.append((level, message))


def reporting(**changes: Any) -> Any:
    """Return a stand-in for a recorder, which keeps its diagnostics, events and lines."""
    writer = SimpleNamespace(
        path=Path("/bags/flight_1.mcap"), splits=1, bytes_written=700, bytes_waiting=30
    )
    recording = SimpleNamespace(
        writer=writer,
        failure=None,
        running=True,
        state=RecordingState.WAITING,
        messages=41,
        lost=Counter({"/b": 2, "/a": 1}),
        now_ns=7 * S,
        check=lambda: None,
    )
    vars(recording).update(changes)
    node: Any = SimpleNamespace(
        recording=recording,
        shown=[],
        events=[],
        log=Lines(),
        _recorded=["/a", "/b", "/c"],
        _splits=1,
    )
    node._publish_diagnostics = lambda *said: node.shown.append(said)
    node.report_event = node.events.append
    node.get_logger = lambda: node.log
    for name in ("_publish_state", "_report_bag_event"):
        method = getattr(RecorderNode, name)
        setattr(node, name, lambda *given, _method=method, **named: _method(node, *given, **named))
    return node


@pytest.mark.parametrize(
    ("changes", "level", "message"),
    [
        ({}, DiagnosticStatus.OK, "recording"),
        ({"running": False}, DiagnosticStatus.OK, "paused"),
        ({"failure": RecordingError("It is full.")}, DiagnosticStatus.ERROR, "It is full."),
    ],
)
def test_a_recorder_tells_how_its_bag_does(
    changes: dict[str, Any], level: bytes, message: str
) -> None:
    node = reporting(**changes)
    RecorderNode._publish_state(node)
    values = {
        "messages": 41, "messages_lost": 3, "topics": 3, "bytes_written": 700, "bytes_waiting": 30,
    }  # fmt: skip
    assert node.shown == [("bag", level, message, values)]
    for silent in (reporting(state=RecordingState.CLOSED), reporting()):
        if silent.recording.state is not RecordingState.CLOSED:
            silent.recording = None
        RecorderNode._publish_state(silent)
        assert not silent.shown


def test_a_recorder_reports_lost_messages_in_order() -> None:
    node = reporting()
    RecorderNode._publish_losses(node, node.recording)
    said = "Messages were lost on their way to the recorder: 1 on '/a', 2 on '/b'."
    assert node.log.lines == [("warning", said)]
    ((what, level, message, counts),) = node.shown
    assert (what, level, message) == ("lost messages", DiagnosticStatus.WARN, said)
    assert list(counts.items()) == [("/a", 1), ("/b", 2)]
    node = reporting(lost=Counter())
    RecorderNode._publish_losses(node, node.recording)
    assert not node.shown


def test_a_recording_that_fails_or_goes_on_in_another_file_is_an_event() -> None:
    node = reporting(failure=RecordingError("full"))
    RecorderNode._on_failure(node, node.recording.failure)
    (event,) = node.events
    assert (event.kind, event.level) == (EventKind.RECORDING_FAILED, 2)
    assert event.message == "Recording has ended: full"
    assert event.about == {"bag": "/bags/flight_1.mcap"}
    assert node.log.lines == [("error", "Recording has ended: full")]
    assert len(node.shown) == 1
    RecorderNode._check_file(node)
    assert len(node.shown) == 2, "for those who subscribe late"
    node = reporting()
    RecorderNode._check_file(node)
    assert not node.shown
    assert not node.events
    node.recording.writer.splits = 2
    RecorderNode._check_file(node)
    RecorderNode._check_file(node)
    (event,) = node.events
    assert (event.kind, event.level) == (EventKind.FILE_SPLIT, 0)
    assert event.message == "Recording goes on in /bags/flight_1.mcap."


def test_transforms_are_written_once_a_period_of_whole_states(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(recorder, "first_time_ns", lambda raw: int(raw.split()[1]))
    monkeypatch.setattr(recorder, "HEADER_STAMP", slice(2, None))
    written: list[int] = []
    recording: Any = SimpleNamespace(
        running=True, record=lambda channel, message, time_ns: written.append(time_ns)
    )
    published = [False]
    topics = "/tf", "/tf_static"
    sources = "/odom", "/joint_states", "/robot_description"
    made: Any = recorder._RecordedTransforms(recording, 0.1, topics, lambda: published[0], sources)
    made._frames = SimpleNamespace(message=lambda time_ns, pose, q: b"")
    refused = [False]

    def accept(odom: bytes, joints: bytes) -> None:
        if refused[0]:
            raise CommandError("of another robot")

    def state(time_ns: int) -> None:
        made._on_odom(b"o %d" % time_ns)
        made._on_joint_states(b"j %d" % time_ns)

    state(0)
    assert not written, "there is no description yet"
    made._state = SimpleNamespace(accept=accept, pose=None, q=None)
    # The first state is at zero; then 0.1 s have to be over, or time has gone back.
    for time_ns in (0, 1, S // 10 - 1, S // 10, S // 10 + 5, S // 5, 3, 4, S // 10 + 3):
        state(time_ns)
    assert written == [0, S // 10, S // 5, 3, S // 10 + 3]
    made._on_odom(b"o %d" % S)
    assert len(written) == 5, "its joints are missing"
    for silent in ("running", "published", "refused"):
        recording.running = silent != "running"
        published[0], refused[0] = silent == "published", silent == "refused"
        state(2 * S)
    assert len(written) == 5
    refused[0] = False
    state(2 * S)
    assert written[-1] == 2 * S


# -- replay -------------------------------------------------------------------------------------


def topic(name: str, type_name: str = "std_msgs/msg/String") -> Any:
    return SimpleNamespace(name=name, type_name=type_name, qos=name)


def replaying(*topics: Any, clock: float = 0.0, meshes: object = None) -> Any:
    """Return a stand-in for a replay of topics, which keeps its publishers by name."""
    node: Any = SimpleNamespace(
        config=SimpleNamespace(clock=clock),
        _playback=SimpleNamespace(topics=topics),
        _outputs=[],
        _sends={},
        _meshes=meshes,
        log=Lines(),
        made=[],
    )
    node.get_logger = lambda: node.log
    node.resolve_topic_name = lambda name: "/replay/" + name.removeprefix("~/")

    def create(kind: object, name: str, qos: object) -> object:
        if " " in name:
            raise InvalidTopicNameException(name, "has a space", 0)
        node.made.append((kind, name, qos))
        return name

    node.create_publisher = create
    return node


@pytest.fixture
def types(monkeypatch: pytest.MonkeyPatch) -> None:
    def message_class(name: str) -> str:
        if name.startswith("tf2") or name == "gone/msg/Gone":
            raise SpaceRobotError(f"the type {name} is not installed.")
        return name

    monkeypatch.setattr(replay, "message_class", message_class)
    monkeypatch.setattr(replay, "_publisher_qos", lambda qos: f"qos of {qos}")
    monkeypatch.setattr(replay, "raw_publish", lambda publisher: f"send {publisher}")
    monkeypatch.setattr(replay, "_with_mesh_files", lambda send, meshes: f"{send} with {meshes}")


@pytest.mark.usefixtures("types")
def test_topics_of_a_bag_are_published_but_for_clocks_and_types_that_are_missing() -> None:
    node = replaying(
        topic("/clock"), topic("/a"), topic("/b"), topic("/tf", TRANSFORM_TYPE),
        topic("/gone", "gone/msg/Gone"), topic("/robot_description"), meshes="meshes",
    )  # fmt: skip
    ReplayNode._create_publishers(node, {"/a": "/c"})
    names = [name for _, name, _ in node.made]
    assert names == ["/clock", "/c", "/b", "/robot_description"] == node._outputs
    assert node.made[1] == ("std_msgs/msg/String", "/c", "qos of /a")
    assert node._sends == {
        "/clock": "send /clock", "/a": "send /c", "/b": "send /b",
        "/robot_description": "send /robot_description with meshes",
    }  # fmt: skip
    tail = "the type {} is not installed."
    assert node.log.lines == [
        ("info", f"Topic '/tf' is not replayed: {tail.format(TRANSFORM_TYPE)}"),
        ("warning", f"Topic '/gone' is not replayed: {tail.format('gone/msg/Gone')}"),
    ]
    own = replaying(topic("/clock"), topic("/a"), clock=20.0)
    ReplayNode._create_publishers(own, {})
    assert [name for _, name, _ in own.made] == ["/clock", "/a"]
    assert own._outputs == ["/a"]
    assert own._last_clock == -1
    plain = replaying(topic("/robot_description"), topic("/robot_description", "gone/msg/Gone"))
    ReplayNode._create_publishers(plain, {})
    assert plain._sends == {"/robot_description": "send /robot_description"}


@pytest.mark.usefixtures("types")
def test_a_replay_of_nothing_or_to_no_name_is_refused() -> None:
    nothing = replaying(topic("/gone", "gone/msg/Gone"))
    with pytest.raises(SpaceRobotError, match=r"^None of the bag's message types is installed"):
        ReplayNode._create_publishers(nothing, {})
    clock = replaying(topic("/gone", "gone/msg/Gone"), clock=20.0)
    ReplayNode._create_publishers(clock, {})
    with pytest.raises(ParameterError) as refusal:
        ReplayNode._create_publishers(replaying(topic("/a")), {"/a": "/a b"})
    assert str(refusal.value) == ("Topic '/a' cannot be replayed as '/a b': that is no topic name.")


def controlled(**changes: Any) -> Any:
    """Return a stand-in for a replay that has begun, of a bag from 100 s to 104 s."""
    node: Any = SimpleNamespace(
        _playback=SimpleNamespace(duration_s=4.0, start_ns=100 * S, ended=False),
        _begun=True, _paused=True, log=Lines(), done=[],
    )  # fmt: skip
    vars(node).update(changes)
    node.get_logger = lambda: node.log
    node._now = lambda: 5
    for name in ("_seek", "_set_timer", "_publish_status", "_send", "_end_if_done"):
        if not hasattr(node, name):
            setattr(node, name, lambda *given, _name=name: node.done.append((_name, *given)))
    return node


@pytest.mark.parametrize(
    ("offset", "bag_ns"),
    [(1.5, 101.5), (-3.0, 100.0), (9.0, 104.0), (0.0, 100.0), (4.0, 104.0)],
)
def test_a_replay_goes_to_an_instant_within_its_bag(offset: float, bag_ns: float) -> None:
    node = controlled()
    ReplayNode._on_seek(node, SimpleNamespace(data=offset))
    assert node.done == [("_seek", round(bag_ns * S)), ("_set_timer",), ("_publish_status",)]


def test_a_replay_goes_to_no_instant_that_is_none_or_before_it_has_begun() -> None:
    node = controlled()
    ReplayNode._on_seek(node, SimpleNamespace(data=math.nan))
    assert node.log.lines == [("warning", "A replay cannot go to nan s.")]
    waiting = controlled(_begun=False)
    ReplayNode._on_seek(waiting, SimpleNamespace(data=1.0))
    assert not node.done
    assert not waiting.done


def stepped(node: Any) -> tuple[bool, str]:
    response = ReplayNode._on_step(node, Trigger.Request(), Trigger.Response())
    return response.success, response.message


def test_steps_are_told_one_by_one() -> None:
    message = SimpleNamespace(topic="/a", log_time_ns=101_500_000_001)
    node = controlled()
    node._playback.step = lambda now: {5: message}.get(now)
    assert stepped(node) == (True, "/a at 101.500000001 s")
    assert node.done == [("_send", message), ("_end_if_done",)]
    node._playback.step = lambda now: None
    assert stepped(node) == (False, "The replay has ended.")
    refusal = (False, "Only a paused replay goes step by step; call ~/pause first.")
    assert stepped(controlled(_paused=False)) == refusal
    assert stepped(controlled(_begun=False)) == refusal

    def broken(now: int) -> None:
        raise RecordingError("the bag is cut off.")

    node._playback.step = broken
    assert stepped(node) == (False, "the bag is cut off.")


def test_a_replay_is_paused_as_it_is_asked_and_resumed() -> None:
    node = controlled(_set_paused=lambda paused: f"paused: {paused}")
    for wanted in (True, False):
        response = ReplayNode._on_pause(node, SetBool.Request(data=wanted), SetBool.Response())
        assert (response.success, response.message) == (True, f"paused: {wanted}")
    response = ReplayNode._on_resume(node, Trigger.Request(), Trigger.Response())
    assert (response.success, response.message) == (True, "paused: False")


def sending(clock: float) -> Any:
    node: Any = SimpleNamespace(
        config=SimpleNamespace(clock=clock), messages_replayed=0, sent=[], clocks=[]
    )
    node._sends = {"/a": node.sent.append}
    node._publish_clock = node.clocks.append
    return node


def test_messages_set_the_clock_and_are_counted() -> None:
    node = sending(20.0)
    for name in ("/a", "/unknown"):
        message: Any = SimpleNamespace(topic=name, log_time_ns=3 * S, data=b"x")
        ReplayNode._send(node, message)
    assert (node.sent, node.messages_replayed, node.clocks) == ([b"x"], 1, [3 * S, 3 * S])
    late: Any = SimpleNamespace(topic="/a", log_time_ns=LATEST_NS + 1, data=b"y")
    with pytest.raises(RecordingError) as refusal:
        ReplayNode._send(node, late)
    assert str(refusal.value) == (
        f"a message on /a is of {(LATEST_NS + 1) / S:.9g} s, and a clock ends at 2^31 s."
    )
    late.log_time_ns -= 1
    ReplayNode._send(node, late)
    plain = sending(0.0)
    late.log_time_ns += 1
    ReplayNode._send(plain, late)
    assert (plain.sent, plain.clocks) == ([b"y"], [])


# -- plant --------------------------------------------------------------------------------------


class Draining:
    """A plant in real time whose joints slow down by its ticks, on a clock by hand."""

    def __init__(self, rates: list[float], *, ticks: bool = True) -> None:
        self._active, self._real_time = PlantState.RUNNING, object()
        self.is_active = True
        self._tick, self.now, self.spun, self.stepped, self.rested = 5, 50.0, 0, 0, 0
        self.ticks, self.rates = ticks, iter(rates)
        self.plant = SimpleNamespace(qdot=np.array([0.0, -1.0]))
        self.raw_inputs: list[Any] = []
        self._commands = SimpleNamespace(rest=self._rest)

    def _rest(self) -> None:
        self.rested += 1

    def _publish_changed_status(self) -> None:
        assert self.rested == 1

    def _step(self) -> None:
        self.stepped += 1

    def spin_once(self, timeout_sec: float) -> None:
        self.spun += 1
        self.now += timeout_sec
        if self.ticks:
            self._tick += 1
            self.plant.qdot = np.array([0.0, -next(self.rates)])


def drained(node: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr("time.monotonic", lambda: node.now)
    PlantNode.drain(node, node)
    return node


def test_a_plant_that_ends_brings_its_joints_to_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    node = drained(Draining([0.5, 1.01e-3, 1e-3, 0.0]), monkeypatch)
    assert (node.spun, node.stepped, node.rested) == (3, 0, 1)
    # For no longer than 0.8 s.
    node = drained(Draining([0.5] * 99), monkeypatch)
    assert (node.spun, node.stepped) == (pytest.approx(40, abs=1), 0)
    # Without a tick in that time, by one step.
    node = drained(Draining([], ticks=False), monkeypatch)
    assert (node.spun, node.stepped) == (pytest.approx(40, abs=1), 1)
    gone = Draining([0.5] * 99)
    gone.is_active = False
    assert (drained(gone, monkeypatch).spun, gone.stepped) == (0, 0)
    for change in ({"_active": PlantState.FAILED}, {"_real_time": None}):
        still = Draining([])
        vars(still).update(change)
        assert (drained(still, monkeypatch).spun, still.rested) == (0, 0)
