"""Runs of scenarios and goals of a user, with stand-ins for the stack and its clients."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from rosgraph_msgs.msg import Clock
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.streams import MatchedEndpoints
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerStatistics
from spacerobot_ros.scenario import Scenario, load_scenario
from spacerobot_ros.session import run, stack
from spacerobot_ros.session.stack import InProcessStack, Stack

GOAL = Goal.from_rotvec([0.1, 0.2, -0.3], [0.0, 0.1, 0.0])


class Time:
    """Wall time that passes only when something waits."""

    def __init__(self) -> None:
        self.now = 50.0

    def monotonic(self) -> float:
        return self.now

    def perf_counter(self) -> float:
        return self.now

    def time_ns(self) -> int:
        return 1_700_000_000_000_000_000


class FakeStack:
    """A stack of which every spin calls ``flight`` with the function that looks at it."""

    def __init__(self, scenario: Scenario, time: Time, flight: Callable[..., None]) -> None:
        self.scenario, self.time, self.flight = scenario, time, flight
        self.namespace = ""
        self.bag = Path("recorded.mcap")
        self.time_ns = 0
        self.client = SimpleNamespace(ends_at=0.0, message="")
        self.done: list[Any] = []
        self.interrupted = threading.Event()
        self.interrupt = self.interrupted.set

    def start(self, goal: Goal | None) -> None:
        self.done.append(("start", goal))

    def spin(self, look: Callable[[], bool]) -> None:
        self.time.now += 0.75
        self.flight(self, look)

    def finish(self) -> None:
        self.time.now += 9.0
        self.done.append("finish")

    def close(self) -> None:
        self.done.append("close")


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(run, "time", time)
    monkeypatch.setattr(stack, "time", time)
    return time


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Return the calls of a run to ROS and to the function that makes stacks."""
    asked: list[Any] = []

    @contextmanager
    def no_ros(*, private: bool, one_process: bool = False) -> Iterator[None]:
        asked.append(("private", private))
        if one_process:
            asked.append("one process")
        yield

    monkeypatch.setattr(run, "ros", no_ros)
    return asked


def use(monkeypatch: pytest.MonkeyPatch, fake: FakeStack, asked: list[Any]) -> None:
    """Have runs fly a stand-in."""

    def make(scenario: Scenario, bag: Path | None, **options: Any) -> FakeStack:
        asked.append((bag, options))
        return fake

    monkeypatch.setattr(run, "make_stack", make)
    monkeypatch.setattr(
        run, "_summary", lambda flown, wall: {"succeeded": True, "message": f"{wall} s"}
    )


@pytest.mark.parametrize("private", [True, False])
def test_a_run_in_one_process_is_not_heard_elsewhere(
    monkeypatch: pytest.MonkeyPatch, private: bool
) -> None:
    seen: list[Any] = []
    for name in ("ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_DOMAIN_ID"):
        monkeypatch.setenv(name, "")
    monkeypatch.setattr(
        run, "start_ros", lambda words: seen.append(os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"])
    )
    with run.ros(private=private):
        assert seen == ["OFF" if private else "LOCALHOST"]


@pytest.mark.parametrize("processes", [False, True])
@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_only_lockstep_in_one_process_is_private(
    time: Time, asked: list[Any], monkeypatch: pytest.MonkeyPatch, mode: str, processes: bool
) -> None:
    scenario = load_scenario("planar_chain").with_overrides("plant", {"time_mode": mode})
    fake = FakeStack(scenario, time, lambda flown, look: look())
    use(monkeypatch, fake, asked)
    result = run.run_scenario(scenario, Path("a.mcap"), processes=processes)
    private = mode == "lockstep" and not processes
    settings = [] if processes else ["one process"]
    made = (Path("a.mcap"), {"processes": processes})
    assert asked == [("private", private), *settings, made]
    assert fake.done == [("start", scenario.goal), "finish", "close"]
    assert (result.succeeded, result.message) == (True, "0.75 s"), "wall time of the flight alone"


@pytest.mark.parametrize(
    ("name", "limit"), [("planar_chain", 300.0), ("sliding_masses", 0.0)], ids=["both", "planner"]
)
def test_progress_is_of_the_schedule_and_else_of_the_controllers_time_limit(
    time: Time, asked: list[Any], monkeypatch: pytest.MonkeyPatch, name: str, limit: float
) -> None:
    scenario = load_scenario(name)
    if limit:
        scenario = scenario.with_overrides("coordinated_control", {"time_limit": limit})
    looks: list[bool] = []

    def flight(flown: FakeStack, look: Callable[[], bool]) -> None:
        for now, ends_at in ((250_000_000, 0.0), (1_500_000_000, 7.0), (2_000_000_000, 7.0)):
            flown.time_ns, flown.client.ends_at = now, ends_at
            looks.append(look())

    shown: list[tuple[float, float]] = []

    def progress(now: float, end: float) -> None:
        shown.append((now, end))
        if now == 1.5:
            raise BrokenPipeError

    use(monkeypatch, FakeStack(scenario, time, flight), asked)
    run.run_scenario(scenario, Path("a.mcap"), progress, longest=2.0)
    assert shown == [(0.25, limit), (1.5, 7.0), (2.0, 7.0), (2.0, 2.0)]
    assert looks == [False, False, True]


def test_a_run_that_is_asked_to_end_shows_no_more_progress(
    time: Time, asked: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[bool] = []

    def flight(flown: FakeStack, look: Callable[[], bool]) -> None:
        os.kill(os.getpid(), signal.SIGINT)
        assert flown.interrupted.wait(60.0), "a plan that is being made is cancelled"
        looks.append(look())

    shown: list[tuple[float, float]] = []
    fake = FakeStack(load_scenario("sliding_masses"), time, flight)
    use(monkeypatch, fake, asked)
    run.run_scenario(fake.scenario, Path("a.mcap"), lambda *times: shown.append(times))
    assert looks == [True]
    assert shown == [(0.0, 0.0)]
    assert fake.done[-2:] == ["finish", "close"]


@pytest.mark.parametrize(("namespace", "topic"), [("", "goal_pose"), ("/left", "/left/goal_pose")])
def test_a_stack_that_is_up_shows_each_status_once(
    time: Time, asked: list[Any], monkeypatch: pytest.MonkeyPatch, namespace: str, topic: str
) -> None:
    looks: list[bool] = []

    def flight(flown: FakeStack, look: Callable[[], bool]) -> None:
        for message in ("", "Planning.", "Planning.", "Closed.", "Reached."):
            flown.client.message = message
            looks.append(look())

    shown: list[str] = []

    def show(text: str) -> None:
        shown.append(text)
        if text == "Closed.":
            raise BrokenPipeError

    fake = FakeStack(load_scenario("sliding_masses"), time, flight)
    fake.namespace = namespace
    use(monkeypatch, fake, asked)
    bag = run.run_until_stopped(fake.scenario, None, show, processes=True, namespace="left")
    assert bag == Path("recorded.mcap")
    options = {"processes": True, "namespace": "left", "restarts": 0, "show": show}
    assert asked == [("private", False), (None, options)]
    up = f"sliding_masses is up; goals on '{topic}', Ctrl-C ends it."
    assert shown == [up, "Planning.", "Closed.", "Reached."]
    assert looks == [False] * 5
    assert fake.done == [("start", None), "finish", "close"]
    asked.clear()
    again = FakeStack(load_scenario("sliding_masses"), time, lambda flown, look: None)
    use(monkeypatch, again, asked)
    run.run_until_stopped(again.scenario, None, show, processes=False)
    assert asked[:2] == [("private", False), "one process"]


# -- goals to a stack of others -----------------------------------------------------------------


class FakeClient:
    """A client that has found its commander from a wall time on.

    Attributes
    ----------
    connected, decides, known
        Wall time from which all readers of goals are met, and a commander is; wall time at which
        the first status comes.
    """

    connected = decides = known = 0.0

    def __init__(self, time: Time, *args: Any, **options: Any) -> None:
        self.time, self.args, self.options = time, args, options
        self.message = ""
        self.clocks: dict[str, Callable[[Clock], None]] = {}
        self.sent: list[Goal] = []
        self.looks: list[bool] = []
        self.node = SimpleNamespace(
            resolve_topic_name=lambda name: f"/left/{name}",
            create_subscription=lambda kind, topic, call, depth: self.clocks.update({topic: call}),
            destroy_node=lambda: None,
        )

    @property
    def status(self) -> object:
        return object() if self.time.now >= self.known else None

    def is_connected(self) -> bool:
        return self.time.now >= self.connected

    def has_goal_commander(self) -> bool:
        return self.time.now >= self.decides

    def send(self, goal: Goal) -> None:
        self.sent.append(goal)

    def follow(self, executor: Any, look: Callable[[], bool], period: float) -> Outcome:
        for seconds in (1.0, 1.0, 1.0):
            self.time.now += seconds
            self.message = f"Waiting at {self.time.now:g}."
            self.looks.append(look())
        self.message = "The end."
        return Outcome.INTERRUPTED


class FakeExecutor:
    def __init__(self, time: Time) -> None:
        self.time = time
        self.add_node = self.shutdown = lambda *_: None

    def spin_once(self, *, timeout_sec: float) -> None:
        self.time.now += timeout_sec


@pytest.fixture
def clients(time: Time, asked: list[Any], monkeypatch: pytest.MonkeyPatch) -> dict[str, FakeClient]:
    """Return the clients that are made, by their deciders; the controller is there at once."""
    made: dict[str, FakeClient] = {}

    def make(decider: str, *args: Any, **options: Any) -> FakeClient:
        made[decider] = FakeClient(time, *args, **options)
        if decider == "planner":
            made[decider].decides = 1e9
        return made[decider]

    monkeypatch.setattr(run, "MissionClient", make)
    monkeypatch.setattr(run, "EventsExecutor", lambda: FakeExecutor(time))
    return made


@pytest.mark.parametrize(("timeout", "looks"), [(0.0, [False] * 3), (2.5, [False, False, True])])
def test_a_goal_is_followed_no_longer_than_its_timeout(
    clients: dict[str, FakeClient], asked: list[Any], timeout: float, looks: list[bool]
) -> None:
    shown: list[str] = []
    hand = EndEffectorGoal("hand", GOAL.position, GOAL.quaternion)
    goal = replace(GOAL, end_effectors=(hand,))
    outcome = run.send_goal(goal, shown.append, namespace="left", timeout=timeout)
    assert outcome is Outcome.INTERRUPTED
    assert asked == [("private", False)]
    client = clients["coordinated_control"]
    assert (client.sent, client.looks) == ([goal], looks)
    assert len(shown) == 4
    assert shown[-1] == "The end."
    for decider, each in clients.items():
        assert each.options["namespace"] == "/left"
        assert each.options["end_effectors"] == ["hand"]
        names = each.options["joint_names"]
        assert (names and names()) == (() if decider == "planner" else None)


def test_a_goal_is_stamped_with_the_clock_of_its_namespace_and_else_with_the_global_one(
    clients: dict[str, FakeClient],
) -> None:
    run.send_goal(GOAL, lambda text: None, namespace="left", timeout=0.0)
    topics = clients["planner"].clocks

    def tick(topic: str, sec: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = sec, 5
        topics[topic](message)

    for client in clients.values():
        assert client.args[0] == "", "no frame: that of the commander"
    now = [client.args[1] for client in clients.values()]
    assert [each() for each in now] == [1_700_000_000_000_000_000] * 2
    tick("/clock", 3)
    assert [each() for each in now] == [3_000_000_005] * 2
    tick("/left/clock", 2)
    assert [each() for each in now] == [2_000_000_005] * 2


@pytest.mark.parametrize(("timeout", "patience"), [(0.0, 10.0), (3.0, 3.0), (60.0, 10.0)])
def test_a_commander_is_looked_for_ten_seconds_at_most(
    clients: dict[str, FakeClient],
    time: Time,
    monkeypatch: pytest.MonkeyPatch,
    timeout: float,
    patience: float,
) -> None:
    monkeypatch.setattr(FakeClient, "connected", 1e9)
    begin = time.now
    with pytest.raises(SpaceRobotError) as caught:
        run.send_goal(GOAL, lambda text: None, namespace="", timeout=timeout)
    assert time.now - begin == pytest.approx(patience, abs=0.051)
    assert_one_sentence(str(caught.value), f"takes goals on 'goal_pose' after {patience:g} s:")
    assert "end_effectors" not in str(caught.value)


def find(
    time: Time, times: dict[str, float], goal: Goal = GOAL
) -> tuple[FakeClient, FakeClient, FakeClient]:
    """Return the client that is found, and those of planner and controller."""
    planner, controller = FakeClient(time), FakeClient(time)
    for name, value in times.items():
        setattr(controller, name, 50.0 + value)
    planner.decides = 1e9
    found = run._find_goal_commander([planner, controller], FakeExecutor(time), 4.0, goal)  # type: ignore[list-item]
    return found, planner, controller  # type: ignore[return-value]


@pytest.mark.parametrize(
    ("times", "waited"),
    [
        ({"known": 0.0}, 0.0),
        # A status of earlier goals is waited for, and not for long.
        ({"known": 0.5}, 0.5),
        ({"known": 99.0}, 1.0),
        ({"connected": 2.0, "decides": 1.0, "known": 0.5}, 2.0),
        ({"connected": 1.0, "decides": 3.0, "known": 0.5}, 3.0),
    ],
)
def test_the_commander_is_found_once_everything_is_met(
    time: Time, times: dict[str, float], waited: float
) -> None:
    found, _, controller = find(time, times)
    assert found is controller
    assert time.now - 50.0 == pytest.approx(waited, abs=0.11)


def test_subscribers_that_come_while_the_status_is_awaited_are_waited_for(
    time: Time, monkeypatch: pytest.MonkeyPatch
) -> None:
    def met(client: FakeClient) -> bool:
        return not 0.5 < time.now - 50.0 < 2.0

    monkeypatch.setattr(FakeClient, "is_connected", met)
    find(time, {"known": 0.75})
    assert time.now - 50.0 == pytest.approx(2.0, abs=0.06)


def test_the_topics_of_end_effectors_that_nobody_takes_are_named(time: Time) -> None:
    hands = tuple(
        EndEffectorGoal(link, GOAL.position, GOAL.quaternion) for link in ("", "left_hand")
    )
    with pytest.raises(SpaceRobotError) as caught:
        find(time, {"connected": 99.0}, replace(GOAL, end_effectors=hands))
    topics = "'goal_pose' and 'end_effector/goal_pose' and 'left_hand/goal_pose'"
    assert_one_sentence(str(caught.value), topics, "after 4 s", "parameter end_effectors")


# -- the base class of stacks -------------------------------------------------------------------


def endpoints(
    publishers: dict[str, int] | None = None, subscriptions: dict[str, int] | None = None
) -> MatchedEndpoints:
    """Return the endpoints of a node, with the number of partners that each has met."""
    return MatchedEndpoints(tuple((publishers or {}).items()), tuple((subscriptions or {}).items()))


@pytest.mark.parametrize(
    ("recorded", "topics", "met", "connected"),
    [
        ({"/odom", "/goal_pose"}, "", 1, True),
        ({"/odom", "/goal_pose"}, "", 0, False),
        ({"/odom"}, "", 1, False),
        ({"/odom"}, "odom", 1, True),
        ({"/odom"}, "odom /absent", 1, True),
        ({"/odom"}, "/odom goal_pose", 1, False),
        ({"/odom", "/goal_pose"}, "odom /plant/transition_event", 1, False),
        (None, "", 1, True),
        (None, "", 0, False),
    ],
)
def test_a_flight_begins_when_every_topic_to_record_is_recorded(
    monkeypatch: pytest.MonkeyPatch,
    recorded: set[str] | None,
    topics: str,
    met: int,
    connected: bool,
) -> None:
    nodes = {
        "plant": endpoints({"/odom": met, "/plant/transition_event": 0}),
        "planner": endpoints(subscriptions={"/odom": 1}),
        "recorder": endpoints({"/recorder/heartbeat": 0, "/recorder/own": 0}),
    }
    node = SimpleNamespace(
        publishers=[SimpleNamespace(topic_name="/goal_pose", get_subscription_count=lambda: 0)],
        subscriptions=[],
        resolve_topic_name=lambda name: name if name.startswith("/") else f"/{name}",
    )
    scenario = load_scenario("sliding_masses").with_overrides("recorder", {"topics": topics})
    some = SimpleNamespace(
        client=SimpleNamespace(node=node),
        bag=None if recorded is None else Path("a.mcap"),
        scenario=scenario,
    )
    assert Stack._all_connected(some, nodes, recorded or ()) is connected  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("goal_id", "failures", "raised"),
    [
        (None, {"planner": "It has failed."}, False),
        ("1.5", {"planner": "It has failed."}, True),
        ("1.5", {"recorder": "It has failed."}, False),
        ("1.5", {}, False),
    ],
)
def test_a_commander_that_has_failed_with_a_goal_ends_the_flight(
    goal_id: str | None, failures: dict[str, str], raised: bool
) -> None:
    done: list[Any] = []

    def follow(executor: Any, look: Callable[[], bool]) -> None:
        done.append(look())

    def finish() -> None:
        done.append("finish")
        raise SpaceRobotError("It did not end well either.")

    some = SimpleNamespace(
        scenario=SimpleNamespace(commanders=("planner",)),
        client=SimpleNamespace(goal_id=goal_id, failures=failures, follow=follow, outcome=None),
        executor=None,
        finish=finish,
        _supervise=lambda: done.append("supervised"),
    )
    if raised:
        with pytest.raises(SpaceRobotError, match="It has failed"):
            Stack.spin(some, lambda: True)  # type: ignore[arg-type]
        assert done == ["supervised", "finish"]
    else:
        for answer in (True, False):
            Stack.spin(some, lambda answer=answer: answer)  # type: ignore[arg-type, misc]
        assert done == ["supervised", True, "supervised", False]


def connecting(time: Time, met_after: float, plants: int) -> Any:
    """Return a stack in one process whose nodes have met after a wall time, s."""
    begin, scans = time.now, []
    return SimpleNamespace(
        _connected=lambda: time.now - begin >= met_after,
        executor=FakeExecutor(time),
        _recorder=SimpleNamespace(scan=lambda: scans.append(time.now)),
        scans=scans,
        client=SimpleNamespace(node=SimpleNamespace(count_publishers=lambda topic: plants)),
    )


def test_nodes_that_do_not_find_each_other_are_given_up_after_ten_seconds(time: Time) -> None:
    some = connecting(time, 0.5, 1)
    InProcessStack._connect(some)
    assert len(some.scans) in range(49, 52), "the recorder looks for topics while it waits"
    lost = connecting(time, 99.0, 1)
    begin = time.now
    with pytest.raises(SpaceRobotError, match="within 10 s") as caught:
        InProcessStack._connect(lost)
    assert time.now - begin == pytest.approx(10.0, abs=0.02)
    assert str(caught.value) == (
        "The nodes did not find each other within 10 s; is the loopback interface up, and "
        "ROS_DOMAIN_ID between 0 and 101?"
    )


def test_another_plant_in_the_same_domain_is_refused(time: Time) -> None:
    with pytest.raises(SpaceRobotError) as caught:
        InProcessStack._connect(connecting(time, 0.0, 2))
    assert_one_sentence(str(caught.value), "Another plant", "ROS_DOMAIN_ID")


# -- the stack in one process -------------------------------------------------------------------


class FakeNode:
    """A node that notes what is done to it; ``fault`` and ``failure`` are errors to raise."""

    def __init__(self, name: str, done: list[Any], *, active: bool = True) -> None:
        self.name, self.done, self.is_active = name, done, active
        self.fault: Exception | None = None
        self.failure: Exception | None = None
        self.statistics = f"statistics of the {name}"
        self.time_ns = 1_500_000_000

    def __getattr__(self, action: str) -> Callable[..., None]:
        return lambda *given, **named: self.done.append((self.name, action, *named.values()))


def flying(*, active: bool = True, planner: bool = True, recorder: bool = True) -> Any:
    """Return a stand-in for a stack in one process with its nodes, which share ``done``."""
    done: list[Any] = []
    names = ("plant", "planner", "controller", "recorder")
    nodes = {name: FakeNode(name, done, active=active) for name in names}
    stack: Any = SimpleNamespace(
        done=done,
        nodes=nodes,
        plant=nodes["plant"],
        executor="executor",
        client=SimpleNamespace(outcome=Outcome.REACHED),
        _commanders=[nodes["planner"], nodes["controller"]],
        _planner=nodes["planner"] if planner else None,
        _recorder=nodes["recorder"] if recorder else None,
    )
    return stack


END = [("recorder", "drain", 0.1), ("recorder", "trigger_deactivate"),
       ("recorder", "trigger_cleanup")]  # fmt: skip
STOPS = [(name, "trigger_deactivate") for name in ("plant", "planner", "controller")]


@pytest.mark.parametrize(
    ("outcome", "options", "done"),
    [
        (Outcome.REACHED, {}, [*STOPS, *END]),
        (Outcome.INTERRUPTED, {}, [("plant", "drain"), *STOPS, *END]),
        (Outcome.INTERRUPTED, {"active": False}, END),
        (Outcome.REACHED, {"recorder": False}, STOPS),
    ],
)
def test_the_nodes_of_one_process_are_stopped_and_the_bag_completed(
    outcome: Outcome, options: dict[str, bool], done: list[Any]
) -> None:
    stack = flying(**options)
    stack.client.outcome = outcome
    InProcessStack.finish(stack)
    assert stack.done == done


@pytest.mark.parametrize("kind", ["failure", "fault"])
def test_a_bag_that_is_not_complete_is_an_error(kind: str) -> None:
    stack = flying()
    setattr(stack.nodes["recorder"], kind, SpaceRobotError(f"a {kind}"))
    with pytest.raises(SpaceRobotError, match=f"a {kind}"):
        InProcessStack.finish(stack)
    assert stack.done[-1] == END[-1]


def test_the_plan_of_a_planner_is_cancelled_and_its_figures_are_shown() -> None:
    stack, without = flying(), flying(planner=False)
    InProcessStack.interrupt(stack)
    InProcessStack.interrupt(without)
    assert (stack.done, without.done) == ([("planner", "interrupt")], [])
    statistics: Any = vars(InProcessStack)["statistics"]
    assert statistics.fget(stack) == "statistics of the planner"
    assert statistics.fget(without) == PlannerStatistics()
    time_ns: Any = vars(InProcessStack)["time_ns"]
    assert time_ns.fget(stack) == 1_500_000_000


def test_a_commander_whose_callback_has_failed_ends_the_run() -> None:
    stack = flying()
    InProcessStack._supervise(stack)
    stack.nodes["controller"].fault = SpaceRobotError("It has failed.")
    with pytest.raises(SpaceRobotError, match="It has failed"):
        InProcessStack._supervise(stack)
    stack.nodes["controller"].fault = None
    stack.nodes["plant"].fault = SpaceRobotError("not asked here")
    InProcessStack._supervise(stack)


@pytest.mark.parametrize("goal", [GOAL, None])
def test_the_plant_begins_last_and_the_goal_is_there_before(goal: Goal | None) -> None:
    stack = flying()
    timers: list[Any] = []

    def create(period: float, call: Callable[[], None], clock: Any) -> str:
        timers.append((period, clock.clock_type.name, call))
        return "timer"

    stack.client = SimpleNamespace(
        node=SimpleNamespace(
            create_timer=create, destroy_timer=lambda timer: stack.done.append(f"no {timer}")
        ),
        send=lambda *given: stack.done.append(given),
    )
    stack.plant.plant = SimpleNamespace(robot="robot")
    stack.scenario = SimpleNamespace(
        require_shape_of=lambda robot: stack.done.append(robot), end_effector_goal="hand"
    )
    InProcessStack.start(stack, goal)
    assert stack.done == ["robot"] * (goal is not None), "nothing begins before the next spin"
    ((period, clock, launch),) = timers
    assert (period, clock) == (0.001, "STEADY_TIME")
    stack.done.clear()
    launch()
    nodes = [(name, "trigger_activate") for name in ("recorder", "controller", "planner")]
    sent = [] if goal is None else [(goal, "hand")]
    assert stack.done == ["no timer", *nodes, *sent, ("plant", "trigger_activate")]


@pytest.mark.parametrize(
    ("given", "namespace"),
    [("", ""), ("/", ""), ("left", "/left"), ("/left/", "/left"), ("a/b", "/a/b")],
)
def test_namespaces_have_a_slash_before_and_none_behind(given: str, namespace: str) -> None:
    assert stack.checked_namespace(given) == namespace
    words = stack.namespace_arguments(namespace)
    if not namespace:
        assert words == []
        return
    assert words[:2] == ["-r", f"__ns:={namespace}"]
    assert set(words[2::2]) == {"-r"}
    assert words[3::2] == ["/clock:=clock", "/tf:=tf", "/tf_static:=tf_static"]


@pytest.mark.parametrize("name", ["1left", "le ft", "a//b"])
def test_a_namespace_that_ros_does_not_take_is_named(name: str) -> None:
    with pytest.raises(SpaceRobotError, match=f"The namespace '{name}' is not valid in ROS"):
        stack.checked_namespace(name)


class PlainStack(Stack):
    """The base class by itself."""

    time_ns = 0
    statistics = PlannerStatistics()
    start = finish = close = lambda *_: None  # type: ignore[assignment]


def test_what_a_stack_cannot_fly_is_refused_before_any_node_runs(tmp_path: Path) -> None:
    killed = load_scenario("faults/killed_nodes")
    for scenario in (killed, killed.with_overrides("plant", {"time_mode": "lockstep"})):
        with pytest.raises(SpaceRobotError) as caught:
            PlainStack(scenario, None)
        assert_one_sentence(str(caught.value), "kills nodes on the way", "--realtime")
    chain = load_scenario("planar_chain")
    refused = chain.with_overrides("coordinated_control", {"time_limit": -1.0})
    with pytest.raises(SpaceRobotError, match="time_limit"):
        PlainStack(refused, None)
    made = PlainStack(chain, tmp_path / "a.mcap")
    assert made.names == ("plant", *chain.commanders, "recorder")
    assert (made.when_exists, made.bag) == ("refuse", tmp_path / "a.mcap")
    assert PlainStack(chain, None).names == made.names[:-1]
    (tmp_path / "a.mcap").touch()
    following = chain.with_overrides("recorder", {"when_exists": "next"})
    assert PlainStack(following, tmp_path / "a.mcap").bag != tmp_path / "a.mcap"
    assert PlainStack(following, None).bag is None
