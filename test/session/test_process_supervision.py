"""Node processes as their supervisor starts and ends them.

The children here are stand-ins that note each call: nothing is started.
"""

from __future__ import annotations

import json
import re
import signal
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.msg import Transition
from rosgraph_msgs.msg import Clock
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning.execution.status import PlannerStatistics
from spacerobot_ros.scenario import Scenario, load_scenario
from spacerobot_ros.session import processes
from spacerobot_ros.session.live import ros
from spacerobot_ros.session.processes import MultiProcessStack

KILLED = "faults/killed_nodes"
"""A scenario with a planner, of which nodes are killed."""

RUNNING = ("plant", "planner", "coordinated_control")
"""The nodes of the scenario ``planar_chain``."""


@dataclass
class Child:
    """A process that never was: ``returncode`` is None while it runs."""

    words: Sequence[str]
    environment: Mapping[str, str]
    options: Mapping[str, Any]
    returncode: int | None = None
    signals: list[int] = field(default_factory=list)

    def poll(self) -> int | None:
        return self.returncode

    def send_signal(self, number: int) -> None:
        self.signals.append(number)


@dataclass
class Record:
    """Actions of a stack, in their order."""

    done: list[tuple[Any, ...]] = field(default_factory=list)
    codes: dict[str, int] = field(default_factory=dict)
    """Exit codes of the children by their names; else 0."""


@pytest.fixture
def record(own_domain: None, monkeypatch: pytest.MonkeyPatch) -> Iterator[Record]:
    """Have stacks start stand-ins, and note the changes of their states."""
    record = Record()

    def start(words: Sequence[str], environment: Mapping[str, str], **options: Any) -> Child:
        return Child(words, environment, options)

    def end(child: Child, waits: Mapping[int, float]) -> int:
        name = next(word for word in child.words if word.startswith("__node:="))[8:]
        record.done.append(("end", name, dict(waits)))
        child.returncode = record.codes.get(name, 0)
        return child.returncode

    def change(stack: MultiProcessStack, transition: int, names: Sequence[str]) -> None:
        record.done.append((transition, *names))

    monkeypatch.setattr(processes, "start_child", start)
    monkeypatch.setattr(processes, "end_child", end)
    monkeypatch.setattr(MultiProcessStack, "_change_states", change)
    monkeypatch.setattr(MultiProcessStack, "_connected", lambda stack: True)
    monkeypatch.setattr(
        MultiProcessStack, "_spin_for", lambda stack, s: record.done.append(("spin", s))
    )
    with ros():
        yield record


@pytest.fixture
def make(record: Record, tmp_path: Path) -> Iterator[Callable[..., MultiProcessStack]]:
    """Return a function that makes a stack of a scenario; it is closed at the end."""
    made: list[MultiProcessStack] = []

    def make(scenario: Scenario | str, **options: Any) -> MultiProcessStack:
        loaded = load_scenario(scenario) if isinstance(scenario, str) else scenario
        made.append(MultiProcessStack(loaded, options.pop("bag", tmp_path / "a.mcap"), **options))
        return made[-1]

    yield make
    for stack in made:
        stack.close()


def real_time(name: str, **settings: Any) -> Scenario:
    return load_scenario(name).with_overrides("plant", {"time_mode": "realtime", **settings})


def folder_of(stack: MultiProcessStack) -> Path:
    return Path(stack._folder.name)


def parameters(stack: MultiProcessStack, name: str) -> dict[str, Any]:
    """Read the parameter file that a node is started with."""
    words = list(stack.processes[name].words)  # type: ignore[attr-defined]
    file = Path(words[words.index("--params-file") + 1])
    ((node, section),) = yaml.safe_load(file.read_text("utf-8")).items()
    assert node == (f"{stack.namespace}/{name}" if stack.namespace else name)
    return dict(section["ros__parameters"])


def child(stack: MultiProcessStack, name: str) -> Child:
    process = stack.processes[name]
    assert isinstance(process, Child)
    return process


def test_every_node_is_started_with_its_parameters_and_configured_at_once(
    make: Callable[..., MultiProcessStack], record: Record, tmp_path: Path
) -> None:
    stack = make("planar_chain", namespace="left")
    assert list(stack.processes) == [*RUNNING, "recorder"]
    assert record.done == [(Transition.TRANSITION_CONFIGURE, *RUNNING, "recorder")]
    for name in stack.processes:
        assert parameters(stack, name)["autostart"] is False
        words = " ".join(child(stack, name).words)
        module = {"plant": "plant.node", "coordinated_control": "controller"}.get(name, name)
        begin = f"-m spacerobot_ros.session.child spacerobot_ros.nodes.{module} --ros-args"
        assert words.startswith(f"{begin} -r __node:={name} -r __ns:=/left -r /clock:=clock ")
    assert parameters(stack, "planner")["stop_when_decided"] is True
    recorder = parameters(stack, "recorder")
    assert (recorder["bag"], recorder["when_exists"]) == (str(tmp_path / "a.mcap"), "refuse")
    described = json.loads(Path(recorder["describe"]).read_text("utf-8"))
    wanted = json.loads(json.dumps(stack.scenario.records(RUNNING)))
    assert described == wanted
    for name in ("plant", "coordinated_control", "recorder"):
        assert not {"resume_file", "stop_when_decided"} & parameters(stack, name).keys()
    assert "resume_file" not in parameters(stack, "planner")


def test_a_commander_that_is_killed_keeps_its_goal_in_a_file(
    make: Callable[..., MultiProcessStack],
) -> None:
    scenario = real_time(KILLED)
    stack = make(scenario)
    assert parameters(stack, "planner")["resume_file"] == str(
        folder_of(stack) / "planner_goal.json"
    )
    assert "stop_when_decided" not in parameters(stack, "planner"), "real time goes on"
    assert "resume_file" not in parameters(stack, "plant")
    own = make(scenario.with_overrides("planner", {"resume_file": "mine.json"}))
    assert parameters(own, "planner")["resume_file"] == "mine.json"


@pytest.mark.parametrize("variable", ["FASTDDS_DEFAULT_PROFILES_FILE", None])
def test_lost_messages_are_repeated_soon_unless_the_user_chose_otherwise(
    make: Callable[..., MultiProcessStack], monkeypatch: pytest.MonkeyPatch, variable: str | None
) -> None:
    files = ("FASTDDS_DEFAULT_PROFILES_FILE", "FASTRTPS_DEFAULT_PROFILES_FILE")
    for name in (*files, "FASTDDS_BUILTIN_TRANSPORTS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("MINE", "7")
    if variable:
        monkeypatch.setenv(variable, "/mine.xml")
        monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "SHM")
    environment = child(make("planar_chain", bag=None), "plant").environment
    assert environment["MINE"] == "7"
    assert environment["FASTDDS_BUILTIN_TRANSPORTS"] == ("SHM" if variable else "UDPv4")
    if variable:
        assert {name: environment[name] for name in files if name in environment} == {
            variable: "/mine.xml"
        }
        return
    assert environment[files[0]] == environment[files[1]]
    root = ElementTree.parse(environment[files[0]]).getroot()
    times = {
        re.sub("{.*}", "", each.tag): [float(part.text or "") for part in each]
        for each in next(node for node in root.iter() if node.tag.endswith("}times"))
    }
    assert times == {"initialHeartbeatDelay": [0, 5e6], "heartbeatPeriod": [0, 1e7]}


INFO = "[INFO] [1795476705.350247186] [planner]: Waiting for a goal pose."
ERROR = "[ERROR] [1795476705.350247186] [planner]: The robot has no joints."
TRACE = "Traceback (most recent call last):\n  File a, line 1\nValueError: no such joint"
CRASH = (
    f"{INFO}\nFatal Python error: Segmentation fault\n\nThread 7:\n  File a\nExtension modules: a"
)


@pytest.mark.parametrize(
    ("code", "written", "sentence"),
    [
        (-9, INFO, "was ended by SIGKILL."),
        (-9, "", "was ended by SIGKILL."),
        (-11, CRASH, "was ended by SIGSEGV: Fatal Python error: Segmentation fault."),
        (1, f"{INFO}\n{TRACE}\n", "has ended with exit code 1: ValueError: no such joint"),
        (2, f"{ERROR}\n{INFO}\n", "has ended with exit code 2: The robot has no joints."),
        (2, "one\ntwo \n\n", "has ended with exit code 2: two"),
        (0, INFO, "has ended with exit code 0: it wrote no error."),
        (3, "broken \udcff", "has ended with exit code 3: broken \N{REPLACEMENT CHARACTER}"),
    ],
)
def test_a_node_that_has_ended_is_reported_with_the_cause(
    make: Callable[..., MultiProcessStack], code: int, written: str, sentence: str
) -> None:
    stack = make("planar_chain", bag=None)
    stack.require_alive()
    (folder_of(stack) / "planner.txt").write_text(written, "utf-8", errors="surrogateescape")
    child(stack, "planner").returncode = code
    with pytest.raises(SpaceRobotError) as caught:
        stack.require_alive()
    assert str(caught.value) == f"Node 'planner' {sentence}"


def test_commanders_that_die_are_started_again_within_the_limit(
    make: Callable[..., MultiProcessStack], monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []
    events: list[DiagnosticStatus] = []
    stack = make(real_time("planar_chain"), bag=None, restarts=2, show=said.append)
    topic: Any = SimpleNamespace(publish=events.append)
    monkeypatch.setattr(stack, "_events", topic)
    wall = [1000.0]
    clock = SimpleNamespace(monotonic=lambda: wall[0], time=lambda: 5.0)
    monkeypatch.setattr(processes, "time", clock)
    assert parameters(stack, "planner")["resume_file"], "it goes on with its goal"

    def die(name: str, code: int = -9) -> None:
        child(stack, name).returncode = code
        stack._supervise()

    for seconds in (0.0, 1.0):
        wall[0] += seconds
        before = child(stack, "planner")
        die("planner")
        assert child(stack, "planner") is not before
        assert child(stack, "planner").returncode is None
        assert parameters(stack, "planner")["autostart"] is True
    die("coordinated_control", -11)
    killed = "Node 'planner' was ended by SIGKILL. It is started again."
    crashed = "Node 'coordinated_control' was ended by SIGSEGV. It is started again."
    assert said == [killed, killed, crashed]
    values = [{pair.key: pair.value for pair in event.values} for event in events]
    assert [each["event"] for each in values] == ["node_restarted"] * 3
    assert [event.message for event in events] == said
    assert events[0].level == b"\x01"
    with pytest.raises(SpaceRobotError) as caught:
        die("planner")
    assert str(caught.value) == (
        "Node 'planner' was ended by SIGKILL. It was started again 2 times within a minute, which "
        "is the limit (--restarts)."
    )
    wall[0] += 59.5
    stack._supervise()
    assert child(stack, "planner").returncode is None, "the first one was a minute ago"
    with pytest.raises(SpaceRobotError, match=r"^Node 'plant' was ended by SIGKILL\.$"):
        die("plant")


def test_nothing_is_started_again_unless_asked(make: Callable[..., MultiProcessStack]) -> None:
    stack = make(real_time("planar_chain"), bag=None)
    assert "resume_file" not in parameters(stack, "planner")
    child(stack, "planner").returncode = -9
    with pytest.raises(SpaceRobotError, match=r"^Node 'planner' was ended by SIGKILL\.$"):
        stack._supervise()


def test_nodes_are_activated_from_the_last_to_the_plant(
    make: Callable[..., MultiProcessStack], record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = make("planar_chain")
    record.done.clear()
    monkeypatch.setattr(stack.client, "send", lambda *goals: record.done.append(("send", *goals)))
    monkeypatch.setattr(stack.client, "await_delivery", lambda: record.done.append(("wait",)))
    activate = Transition.TRANSITION_ACTIVATE
    nodes = [(activate, name) for name in ("recorder", "coordinated_control", "planner")]
    stack.start(stack.scenario.goal)
    sent = [("send", stack.scenario.goal, None), ("wait",)]
    assert record.done == [*nodes, *sent, (activate, "plant")]
    record.done.clear()
    stack.start(None)
    assert record.done == [*nodes, (activate, "plant")]


def test_nodes_are_killed_and_started_by_the_simulated_time(
    make: Callable[..., MultiProcessStack], record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The planner is killed at 10 s until 14 s, the plant at 40 s until 44 s, at 3 times the rate.

    Between two messages of the clock, and without a plant, wall time counts.
    """
    wall = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: wall[0])
    stack = make(real_time(KILLED, real_time_factor=3.0))
    stack._supervise()
    record.done.clear()

    def clock(sec: int, nanosec: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = sec, nanosec
        stack._on_clock(message)

    first = {name: child(stack, name) for name in stack.processes}
    clock(9, 500_000_000)
    assert stack.time_ns == 9_500_000_000
    wall[0] += 0.125
    stack._supervise()
    assert record.done == []
    wall[0] += 0.125
    stack._supervise()
    assert record.done == [("end", "planner", {})], "9.5 s and 3 times a quarter"
    child(stack, "planner").returncode = -9
    stack._supervise()  # The planner is away as it should be.
    clock(14, 0)
    stack._supervise()
    assert child(stack, "planner") is not first["planner"]
    assert "resume_bag" not in parameters(stack, "planner")
    clock(40, 0)
    stack._supervise()
    assert record.done[1:] == [("end", "plant", {})]
    wall[0] += 1.25
    stack._supervise()
    assert child(stack, "plant") is first["plant"]
    wall[0] += 0.125
    stack._supervise()
    assert child(stack, "plant") is not first["plant"], "44 s have come without a clock"
    again = parameters(stack, "plant")
    assert (again["resume_bag"], again["autostart"]) == (str(stack.bag), True)
    assert child(stack, "recorder") is first["recorder"]


WAITS = {0: 10.0, signal.SIGABRT: 1.0}
STOP = (Transition.TRANSITION_DEACTIVATE, "plant")


@pytest.mark.parametrize(
    ("name", "outcome", "begin", "patience"),
    [
        ("planar_chain", Outcome.REACHED, [STOP, ("spin", 1.0)], 60.0),
        ("planar_chain", Outcome.INTERRUPTED, [STOP, ("spin", 0.0)], 0.5),
        (KILLED, Outcome.REACHED, [STOP, ("spin", 1.0)], 60.0),
        # The plant itself brings its joints to rest when it is asked to end.
        (KILLED, Outcome.INTERRUPTED, [("spin", 0.0)], 0.5),
    ],
)
def test_the_recorder_ends_last(
    make: Callable[..., MultiProcessStack],
    record: Record,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    outcome: Outcome,
    begin: list[tuple[Any, ...]],
    patience: float,
) -> None:
    stack = make(real_time(name) if name == KILLED else name)
    record.done.clear()
    monkeypatch.setattr(
        stack, "_ask_statistics", lambda patience: record.done.append(("ask", patience))
    )
    stack.client._done.set_result(outcome)
    stack.finish()
    running = RUNNING if name == "planar_chain" else ("plant", "planner")
    ends = [("end", node, WAITS) for node in (*running, "recorder")]
    assert record.done == [*begin, ("ask", patience), *ends]
    assert all(child(stack, node).signals == [signal.SIGINT] for node in stack.processes)


def test_nodes_that_are_away_are_not_asked_to_end(
    make: Callable[..., MultiProcessStack], record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = make(real_time(KILLED))
    monkeypatch.setattr(stack, "_time_ns", 12_000_000_000)
    monkeypatch.setattr(stack, "_clock_seen", time.monotonic())
    stack._supervise()
    assert stack._timeline.away == {"planner"}
    record.done.clear()
    stack.client._done.set_result(Outcome.REACHED)
    stack.finish()
    ends = [("end", node, WAITS) for node in ("plant", "recorder")]
    assert record.done == [STOP, ("spin", 1.0), *ends]


def test_a_node_that_did_not_end_well_is_named(
    make: Callable[..., MultiProcessStack], record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = make("planar_chain")
    monkeypatch.setattr(stack, "_ask_statistics", lambda patience: None)
    record.codes["recorder"] = 3
    (folder_of(stack) / "recorder.txt").write_text("It began.\nNo space is left.\n")
    with pytest.raises(SpaceRobotError) as caught:
        stack.finish()
    assert str(caught.value) == ("Node 'recorder' has ended with exit code 3: No space is left.")


def test_closing_ends_only_what_still_runs(
    make: Callable[..., MultiProcessStack], record: Record, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = make("planar_chain")
    folder = folder_of(stack)
    child(stack, "plant").returncode = 0
    wall = iter([100.0, 100.125, 100.375, 102.0])
    monkeypatch.setattr(time, "monotonic", lambda: next(wall))
    record.done.clear()
    stack.close()
    monkeypatch.undo()
    ends = zip((*RUNNING[1:], "recorder"), (0.375, 0.125, 0.0), strict=True)
    assert record.done == [("end", name, {0: wait}) for name, wait in ends], "half a second in all"
    first, *others = (child(stack, node).signals for node in stack.processes)
    assert (first, others) == ([], [[signal.SIGTERM]] * 3)
    assert not folder.exists()


def test_a_planner_that_does_not_answer_is_waited_for_only_after_an_interrupt(
    make: Callable[..., MultiProcessStack], monkeypatch: pytest.MonkeyPatch
) -> None:
    stack = make("planar_chain", bag=None)
    with pytest.raises(SpaceRobotError) as caught:
        stack._call_services({"planner": stack._get_statistics}, {"planner": None}, 0.01)
    assert str(caught.value) == "Timed out after 0.01 s waiting for the planner."
    asked: list[float] = []

    def late(services: Any, requests: Any, patience: float) -> Any:
        asked.append(patience)
        raise processes._ServiceTimeoutError("It is late.")

    monkeypatch.setattr(stack, "_call_services", late)
    stack._ask_statistics(0.5)
    assert stack.statistics == PlannerStatistics()
    with pytest.raises(SpaceRobotError, match="late"):
        stack._ask_statistics(60.0)
    assert asked == [0.5, 60.0]
    counted = PlannerStatistics(1.5, 3, 200)
    answer = {"planner": SimpleNamespace(message=counted.to_json())}
    monkeypatch.setattr(stack, "_call_services", lambda *given: answer)
    stack._ask_statistics(0.5)
    assert stack.statistics == counted


def test_a_node_that_refuses_is_named_with_its_last_error(
    own_domain: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers = {"plant": SimpleNamespace(success=True), "planner": SimpleNamespace(success=False)}
    stack = SimpleNamespace(
        _change_state={}, _call_services=lambda *_: answers, _read_log=lambda name: f"{name} ends."
    )
    with pytest.raises(SpaceRobotError) as caught:
        MultiProcessStack._change_states(stack, 1, ["plant", "planner"])  # type: ignore[arg-type]
    assert_one_sentence(str(caught.value), "The planner refuses: planner ends.")


def test_a_wait_ends_at_once_when_a_node_has_ended(
    make: Callable[..., MultiProcessStack],
) -> None:
    stack = make("planar_chain", bag=None)
    child(stack, "plant").returncode = 2
    with pytest.raises(SpaceRobotError, match="Node 'plant' has ended"):
        stack._wait_for(lambda: False, "nothing")


class Executor:
    """An executor of which every spin takes its whole time, and is kept."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.spins: list[float] = []
        monkeypatch.setattr(processes, "time", SimpleNamespace(monotonic=lambda: self.now))

    def spin_once(self, *, timeout_sec: float) -> None:
        self.spins.append(timeout_sec)
        self.now += timeout_sec


@pytest.mark.parametrize("met_at", [100.0, 100.05, 102.5, 103.1])
def test_waiting_spins_in_short_steps_until_it_is_met_or_late(
    monkeypatch: pytest.MonkeyPatch, met_at: float
) -> None:
    executor = Executor(monkeypatch)
    alive: list[int] = []
    stack: Any = SimpleNamespace(executor=executor, require_alive=lambda: alive.append(1))
    if met_at > 103:
        with pytest.raises(SpaceRobotError) as caught:
            MultiProcessStack._wait_for(stack, lambda: False, "the planner", 2.5)
        assert str(caught.value) == "Timed out after 2.5 s waiting for the planner."
        met_at = 102.5
        assert executor.now > met_at
    else:
        MultiProcessStack._wait_for(stack, lambda: executor.now >= met_at, "it", 2.5)
        assert len(alive) == len(executor.spins)
    assert executor.now == pytest.approx(met_at, abs=0.021)
    assert set(executor.spins) <= {0.02}


@pytest.mark.parametrize("seconds", [0.0, 0.05, 1.0])
def test_spinning_takes_its_time(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    executor = Executor(monkeypatch)
    stack: Any = SimpleNamespace(executor=executor)
    MultiProcessStack._spin_for(stack, seconds)
    assert executor.now - 100.0 == pytest.approx(seconds, abs=0.0201)
    assert executor.now - 100.0 >= seconds - 1e-9
    assert len(executor.spins) == pytest.approx(seconds / 0.02, abs=1.0)


class Service:
    """A service that is found at the second look, and answers at the third."""

    def __init__(self, answer: str) -> None:
        self.looks, self.answer, self.asked = 0, answer, []  # type: ignore[var-annotated]

    def service_is_ready(self) -> bool:
        self.looks += 1
        return self.looks >= 2

    def call_async(self, request: str) -> Any:
        self.asked.append(request)
        return SimpleNamespace(done=self.done, result=lambda: f"{self.answer} of {request}")

    def done(self) -> bool:
        self.looks += 1
        return self.looks >= 4


def test_each_node_is_asked_once_it_is_there_and_all_answers_are_awaited() -> None:
    waited: list[tuple[str, float]] = []

    def wait_for(condition: Callable[[], bool], what: str, patience: float) -> None:
        waited.append((what, patience))
        assert not condition()
        while not condition():
            pass

    stack: Any = SimpleNamespace(_wait_for=wait_for)
    services: Any = {name: Service(f"answer {name}") for name in ("plant", "planner", "recorder")}
    requests = {"planner": "P", "plant": "Q"}
    answers = MultiProcessStack._call_services(stack, services, requests)
    assert answers == {"planner": "answer planner of P", "plant": "answer plant of Q"}
    assert [services[name].asked for name in services] == [["Q"], ["P"], []]
    both = "planner, plant"
    assert waited == [(f"the {both}", 60.0), (f"an answer of the {both}", 60.0)]
