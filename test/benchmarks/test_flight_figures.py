"""Benchmarks of flights by stand-ins for the clock and the stack: every figure and every line."""

from __future__ import annotations

import itertools
import math
import os
import random
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from matplotlib.figure import Figure
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from support.clocks import Clock, named
from support.made_bags import made_bag, stamped

from spacerobot_ros.bag import read_bag
from spacerobot_ros.benchmarks import real_time, soak, ticks
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.session.run import ros

# -- real time --------------------------------------------------------------------------------

FLOWN = real_time.RealTimeFigures(
    rate=12.5,
    duration_s=7.6,
    ticks=400,
    ticks_late=3,
    ticks_skipped=2,
    worst_tick_ms=4.56,
    commands_late=4,
    commands_missing=1,
    worst_command_ms=3.21,
    states_lost=6,
    commands_lost=5,
    memory_MiB=321.6,
    memory_growth_MiB=0.126,
    idle_late=9,
    idle_worst_ms=0.75,
    prioritised=True,
)


def test_the_lines_of_a_flight_in_real_time() -> None:
    assert FLOWN.missed == 10 / 800
    assert list(FLOWN.lines()) == [
        "12.5 commands a second for 8 s: 1.250 % of the deadlines missed, by 4.6 ms at most "
        "(with real-time priorities)",
        "  ticks late 3, skipped 2; commands late 4, missing 1, of 400 each",
        "  lost in the bag: 6 states, 5 commands; memory 322 MiB, grown by 0.13 MiB",
        "  beside it an idle process was late 9 times, by 0.8 ms at most",
    ]
    without = replace(FLOWN, prioritised=False, worst_tick_ms=0.5)
    assert next(without.lines()).endswith("by 3.2 ms at most (without real-time priorities)")
    figures = FLOWN.figures()
    assert len(figures) == 15
    assert figures["real_time_12.5_duration_s"] == 7.6
    assert figures["real_time_12.5_prioritised"] is True


def test_every_rate_is_flown_and_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    flown = []

    def fly(rate: float, duration: float) -> real_time.RealTimeFigures:
        flown.append((rate, duration))
        return replace(FLOWN, rate=rate)

    monkeypatch.setattr(real_time, "real_time_flight", fly)
    lines: list[str] = []
    figures = real_time.real_time_benchmark(7.5, [30.0, 50.0], lines.append)
    assert flown == [(30.0, 7.5), (50.0, 7.5)]
    assert figures.keys() == {
        *replace(FLOWN, rate=30.0).figures(),
        *replace(FLOWN, rate=50.0).figures(),
    }
    assert [line[:4] for line in lines[::4]] == ["30 c", "50 c"]
    assert len(lines) == 8


def report(skipped: int | None = None, name: str = "plant: timing", **values: object) -> Any:
    pairs = dict(values) if skipped is None else {"deadlines_missed": skipped}
    kind = name if skipped is None else "plant: states"
    status = DiagnosticStatus(name=kind)
    status.values = [KeyValue(key=key, value=str(value)) for key, value in pairs.items()]
    return status


def timing(ticks: int, late: int, commands_late: int, commands: int = 0) -> Any:
    return report(
        ticks=ticks,
        ticks_late=late,
        worst_tick_ms=1.5 * late,
        commands=commands,
        commands_late=commands_late,
        worst_command_ms=0.75,
    )


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of 5 s at 4 states a second: some are lost, and some deadlines are missed."""
    path = tmp_path_factory.mktemp("real_time") / "flight.mcap"
    with made_bag(path) as (_, say):
        for k in range(21):
            time = 10.0 + 0.25 * k
            say("/joint_states", stamped(JointState(), time), time)
            if k not in (3, 4, 5):
                say("/odom", stamped(Odometry(), time), time)
            if k != 7:
                say("/clock", ClockMessage(), time)
                say("/momentum", Float64MultiArray(), time)
            if k < 15:
                say("/joint_commands", stamped(JointState(), time), time)
        for time, parts in (
            (11.0, [report(skipped=0), timing(4, 0, 1)]),
            (12.0, [timing(8, 1, 1)]),
            (13.0, [report(skipped=2), report(name="plant: other", ticks=99), timing(12, 2, 1)]),
            (14.5, [timing(18, 2, 3, commands=15), report(skipped=3)]),
        ):
            say("/diagnostics", DiagnosticArray(status=parts), time)
    return path


def test_a_flight_is_measured_by_its_bag(bag: Path) -> None:
    memory = [1.0, 50.0, 60.0, 100.0, 102.0, 101.0, 110.0, 120.0, 106.0, 115.0]
    found = real_time._flight_figures(4.0, read_bag(bag), 17, memory, (2, 1.25), prioritised=False)
    assert found == real_time.RealTimeFigures(
        rate=4.0,
        duration_s=5.0,
        ticks=18,
        ticks_late=2,
        ticks_skipped=2,  # As reported until then.
        worst_tick_ms=3.0,
        commands_late=3,
        commands_missing=2,  # Of 17, as the last tick awaits one yet.
        worst_command_ms=0.75,
        states_lost=3,
        commands_lost=2,
        memory_MiB=115.0,
        # Of the last six of the eight after the first quarter, two at either end.
        memory_growth_MiB=110.5 - 80.0,
        idle_late=2,
        idle_worst_ms=1.25,
        prioritised=False,
    )
    few = real_time._flight_figures(4.0, read_bag(bag), 17, [7.0], (0, 0.0), prioritised=True)
    assert few.memory_growth_MiB == 0.0
    with pytest.raises(SpaceRobotError, match="ended before the planner had commanded anything"):
        real_time._flight_figures(4.0, read_bag(bag), 0, memory, (0, 0.0), prioritised=False)


def test_deadlines_are_counted_from_the_start(bag: Path, tmp_path: Path) -> None:
    table = real_time._read_deadline_counts(read_bag(bag))
    assert table.tolist() == [
        [11.0, 8.0, 1.0],
        [12.0, 16.0, 2.0],
        [13.0, 24.0, 5.0],
        [14.5, 36.0, 7.0],
    ]
    with made_bag(tmp_path / "short.mcap") as (_, say):
        say("/diagnostics", DiagnosticArray(status=[timing(4, 0, 1)]), 1.0)
    short = read_bag(tmp_path / "short.mcap")
    with pytest.raises(SpaceRobotError, match="too short to count its deadlines"):
        real_time._read_deadline_counts(short)
    with made_bag(tmp_path / "idle.mcap") as (_, say):
        say("/diagnostics", DiagnosticArray(status=[timing(0, 0, 0)]), 1.0)
    idle = read_bag(tmp_path / "idle.mcap")
    with pytest.raises(SpaceRobotError, match="before the planner had commanded anything"):
        real_time._flight_figures(4.0, idle, 5, [1.0], (0, 0.0), prioritised=False)


def test_an_idle_process_is_late_by_what_exceeds_a_period(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    # Beyond each sleep: less than a period, 2.5 periods (so the next two ticks are late, too), ...
    delays = iter([0.05, 0.25, *[0.0] * 20])

    def sleep(duration: float) -> None:
        clock.advance(duration + next(delays))

    monkeypatch.setattr(clock, "sleep", sleep)
    monkeypatch.setattr(real_time, "time", clock)
    monkeypatch.setattr(real_time, "Thread", lambda **_: named(start=lambda: None))
    late, worst = real_time._wait_for_ticks(0.1, 1.0)
    assert late == 2
    assert worst == pytest.approx(150.0)
    assert sum(1 for _ in delays) == 20 - 7, "nine ticks"


class Stack:
    """A stack without processes, whose executor's clock goes by what is waited for."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.sent, self.log = clock, [], []  # type: ignore[var-annotated]
        self.processes = {"plant": named(pid=os.getpid()), "recorder": named(pid=os.getpid())}
        self.statistics = named(commands_published=77)
        self.executor = named(spin_once=lambda timeout_sec: clock.advance(timeout_sec))
        publisher = named(publish=lambda message: self.sent.append((clock.now, message)))

        def create_publisher(kind: type, topic: str, qos: object) -> Any:
            self.log.append(topic)
            return publisher

        self.client = named(
            node=named(create_publisher=create_publisher),
            send=lambda goal: self.sent.append((clock.now, goal)),
            status=None,
        )

    @property
    def time_ns(self) -> int:
        return round(self.clock.now * 1e9)

    def start(self, goal: Any) -> None:
        self.log.append(("start", goal))

    def require_alive(self) -> None:
        pass

    def spin(self, done: Callable[[], bool]) -> None:
        while not done():
            self.clock.advance(0.4)

    def finish(self) -> None:
        self.log.append("finish")


@contextmanager
def in_processes(
    stack: Stack, scenarios: list[Any], bag: Path, stopped: bool = False
) -> Iterator[Callable[[Any], Any]]:
    @contextmanager
    def run(scenario: Any) -> Iterator[Any]:
        scenarios.append(scenario)
        yield stack, bag, lambda: stopped

    yield run


@pytest.mark.parametrize("ready", [True, False])
def test_a_flight_in_real_time(ready: bool, bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    stack, scenarios, idle, found = Stack(clock), [], [], {}  # type: ignore[var-annotated]

    def get(timeout: float) -> tuple[int, float]:
        assert timeout == 5.0
        if not ready:
            raise TimeoutError
        return 3, 0.25

    @contextmanager
    def pool(count: int) -> Iterator[Any]:
        def apply_async(function: Any, arguments: Any) -> Any:
            idle.append((count, function, arguments))
            return named(get=get)

        yield named(apply_async=apply_async)

    def figures(*arguments: Any, **named_ones: Any) -> Any:
        found.update(zip(("rate", "bag", "published", "memory", "idle"), arguments, strict=True))
        found.update(named_ones)
        return FLOWN

    context = named(get_context=lambda kind: named(Pool=pool), TimeoutError=TimeoutError)
    monkeypatch.setattr(real_time, "multiprocessing", context)
    monkeypatch.setattr(real_time, "time", clock)
    monkeypatch.setattr(real_time, "prioritise", lambda stack: True)
    monkeypatch.setattr(real_time, "_flight_figures", figures)
    monkeypatch.setattr(real_time, "_resident_memory", lambda stack: clock.now)
    with in_processes(stack, scenarios, bag) as run:
        monkeypatch.setattr(real_time, "stack_in_processes", run)
        assert real_time.real_time_flight(40.0, 6.5) is FLOWN
    (scenario,) = scenarios
    assert scenario.plant.tick_rate == scenario.planner.tick_rate == 40.0
    assert scenario.plant.diagnostics_period == 1.0
    assert scenario.planner.method == "lie_bracket"
    assert scenario.parameters("planner")["lie_bracket.cycles"] == 170
    assert not scenario.lockstep
    assert scenario.plant.real_time_factor == 1.0
    assert idle == [(1, real_time._wait_for_ticks, (0.025, 6.5))]
    ((_, goal), finished) = stack.log
    assert finished == "finish"
    np.testing.assert_allclose(goal.position, [0.2, -0.15, 0.05])
    np.testing.assert_allclose(2 * goal.quaternion[:3], [0.1, -0.05, 0.02], rtol=1e-2)
    assert (found["rate"], found["published"], found["prioritised"]) == (40.0, 77, True)
    # Memory is sampled each second, between the steps of 0.4 s.
    assert np.array(found["memory"]) - 1000.0 == pytest.approx([1.2, 2.4, 3.6, 4.8, 6.0])
    assert found["idle"] == ((3, 0.25) if ready else (0, pytest.approx(math.nan, nan_ok=True)))


def test_an_interrupted_flight_has_no_figures() -> None:
    ended = []
    stack: Any = named(finish=lambda: ended.append(True))
    real_time.finish(stack, lambda: False)
    with pytest.raises(SpaceRobotError, match="The flight in real time was interrupted"):
        real_time.finish(stack, lambda: True)
    assert ended == [True, True]


def test_the_plant_goes_before_its_commanders(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[int, tuple[int, int]] = {}

    def set_scheduler(thread: int, policy: int, parameter: os.sched_param) -> None:
        given[thread] = policy, parameter.sched_priority

    monkeypatch.setattr(os, "sched_setscheduler", set_scheduler)
    every = {int(name) for name in os.listdir(f"/proc/{os.getpid()}/task")}
    for name, priority in (
        ("plant", 30),
        ("planner", 20),
        ("coordinated_control", 20),
        ("recorder", 10),
    ):
        given.clear()
        stack: Any = named(processes={name: named(pid=os.getpid())})
        assert real_time.prioritise(stack)
        assert given.keys() >= every & given.keys()
        assert threading.main_thread().native_id in given
        assert set(given.values()) == {(os.SCHED_FIFO, priority)}

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    assert not real_time.prioritise(stack)
    monkeypatch.delattr(os, "sched_setscheduler")
    assert not real_time.prioritise(stack), "a system without it"


def test_memory_is_of_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    texts = {1: "Name:\tplant\nVmRSS:\t  2048 kB\n", 2: "VmRSS:\t 512 kB\nThreads:\t7\n"}

    def facts(pid: int, name: str = "status") -> dict[str, str]:
        monkeypatch.setattr(Path, "read_text", lambda path, encoding: texts[pid])
        found = read(pid, name)
        monkeypatch.undo()
        return found

    read = real_time.process_facts
    assert facts(1) == {"Name": "plant", "VmRSS": "2048 kB"}
    both = {pid: facts(pid) for pid in texts}
    monkeypatch.setattr(real_time, "process_facts", lambda pid: both[pid])
    stack: Any = named(processes={"a": named(pid=1), "b": named(pid=2)})
    assert real_time._resident_memory(stack) == 2.5


def test_goals_are_sent_in_turn_when_they_are_due(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(real_time, "time", clock)
    stack: Any = Stack(clock)
    goals = real_time._GoalSender(stack)
    goals.spin(40.0, lambda: False)
    assert clock.now == pytest.approx(1040.0, abs=0.06)
    assert stack.log == ["goal_pose"]
    times, messages = zip(*stack.sent, strict=True)
    assert np.array(times) - 1000.0 == pytest.approx([0.0, 15.0, 30.0], abs=0.11)
    places = [(m.pose.position.x, m.pose.position.y, m.pose.position.z) for m in messages]
    assert places == [(0.0, 0.0, 0.0), (0.3, 0.1, -0.1), (0.0, 0.0, 0.0)]
    assert [m.pose.orientation.w for m in messages] == [1.0, 1.0, 1.0]
    goals.spin(40.0, lambda: True)
    assert clock.now == pytest.approx(1040.0, abs=0.06)


@pytest.mark.parametrize("browser", [True, False])
def test_flights_beside_a_viewer(browser: bool, bag: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    stack, scenarios = Stack(clock), []  # type: ignore[var-annotated]
    opened: list[float] = []

    @contextmanager
    def viewer_and_browser(folder: Path) -> Iterator[Any]:
        assert folder == bag.parent
        opened.append(clock.now)
        rate = 4.0 if len(opened) == 1 else 3.0

        class Client:
            @property
            def count(self) -> int:
                return round(rate * (clock.now - opened[-1]))

        client = Client()
        client.browser = browser  # type: ignore[attr-defined]
        yield client

    # Deadlines at 10 a second; 1 in 10 is missed while a page is open (times 20 to 40, 60 to 80).
    times = np.arange(1000.0, 1090.0)
    missed = [sum(20 < t - 1000 <= 40 or 60 < t - 1000 for t in times[:k]) for k in range(90)]
    table = np.column_stack([times, 10 * (times - 1000.0), missed])
    monkeypatch.setattr(real_time, "time", clock)
    monkeypatch.setattr(real_time, "prioritise", lambda stack: browser)
    monkeypatch.setattr(real_time, "_viewer_and_browser", viewer_and_browser)
    monkeypatch.setattr(real_time, "_read_deadline_counts", lambda bag: table)
    lines: list[str] = []
    with in_processes(stack, scenarios, bag) as run:
        monkeypatch.setattr(real_time, "stack_in_processes", run)
        figures = real_time.viewer_benchmark(10.0, lines.append)
        if browser:
            no = real_time.viewer_benchmark(10.0, lambda line: None, priorities=False)
            assert no["viewer_prioritised"] == 0.0
    assert np.array(opened[:2]) - 1000.0 == pytest.approx([20.0, 60.0], abs=0.5)
    assert figures["viewer_updates_per_s"] == pytest.approx(3.0, abs=0.1), "the least of both turns"
    assert figures["viewer_deadlines_without"] == pytest.approx(200, abs=10)
    assert figures["viewer_deadlines_with"] == pytest.approx(200, abs=10)
    assert figures["viewer_missed_without_percent"] == pytest.approx(0.0, abs=0.6)
    assert figures["viewer_missed_with_percent"] == pytest.approx(10.0, abs=0.6)
    assert figures["viewer_browser"] == figures["viewer_prioritised"] == float(browser)
    clients = "a browser and a client" if browser else "a client (no browser is installed)"
    first, second = lines
    assert first == (
        f"viewer with {clients}: {figures['viewer_updates_per_s']:.1f} updates a second received"
    )
    percent = {name: figures[f"viewer_missed_{name}_percent"] for name in ("without", "with")}
    assert second == (
        f"deadlines missed: {percent['without']:.3f} % of "
        f"{figures['viewer_deadlines_without']:.0f} without it, {percent['with']:.3f} % of "
        f"{figures['viewer_deadlines_with']:.0f} with it "
        f"({'with' if browser else 'without'} real-time priorities)"
    )
    scenario = scenarios[0]
    assert not scenario.lockstep
    assert (scenario.plant.real_time_factor, scenario.plant.diagnostics_period) == (1.0, 1.0)


# -- long flights -----------------------------------------------------------------------------

TRENDS = [
    soak.Trend("plant", "rss", 101.234, 104.5, 2.25, 3.0),
    soak.Trend("recorder", "threads", 5.0, 6.0, 0.0, 0.5),
    soak.Trend("planner", "pss", 7.0, 7.0, 1.5, 1.25),
]


def test_the_table_of_a_long_flight() -> None:
    assert [trend.flat for trend in TRENDS] == [False, False, False]
    edge = replace(TRENDS[0], last=104.234, growth=3.0, allowed=3.0 + 1e-9)
    assert edge.flat
    assert list(soak._trend_lines([edge, *TRENDS[1:]], {"reached": 5, "failed": 1}, 59.6)) == [
        "60 s in separate processes, a goal every 12 s: 1 failed, 5 reached",
        "process                                first     last   growth  allowed",
        "plant                 rss             101.23   104.23     3.00     3.00 MiB ",
        "recorder              threads           5.00     6.00     0.00     0.50     GROWS",
        "planner               pss               7.00     7.00     1.50     1.25 MiB GROWS",
        "2 of 3 grow.",
    ]
    *_, last = soak._trend_lines([edge], {}, 1.0)
    assert last == "All are flat."


@pytest.mark.parametrize(
    ("quantity", "allowed"), [("rss", 7.0), ("pss", 7.0), ("descriptors", 0.5), ("threads", 0.5)]
)
def test_a_trend_is_of_the_last_three_quarters(quantity: str, allowed: float) -> None:
    times = 50.0 + np.arange(4801.0)
    values = np.where(times < 1250.0, 1e6, 3.0 + (times - 1250.0) / 1000.0)
    trend = soak.trend_of("plant", quantity, times, values)
    # 3600 s of 360 samples a tenth.
    assert trend.first == pytest.approx(3.0 + 0.1795)
    assert trend.last == pytest.approx(3.0 + 3.4205)
    assert trend.growth == pytest.approx(3.6)
    assert trend.allowed == pytest.approx(allowed)
    assert (trend.process, trend.quantity) == ("plant", quantity)


def test_slopes_of_few_samples_are_of_all_pairs() -> None:
    times, values = np.array([0.0, 1.0, 3.0, 7.0]), np.array([0.0, 5.0, 6.0, 6.0])
    # 5, 2, 6/7, 1/2, 1/6, 0: the median.
    assert soak.robust_slope(times, values) == pytest.approx((6 / 7 + 1 / 2) / 2)
    assert soak.robust_slope(times[:2], values[:2]) == 5.0
    many = np.arange(801.0)
    bent = np.where(many % 3 == 0, 2.0 * many, 0.0)
    assert soak.robust_slope(many, bent) == pytest.approx(2.0), "every third sample is taken"


def test_a_long_flight_is_sampled_and_gets_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    stack: Any = Stack(clock)
    states = iter(
        [PlannerState.IDLE, PlannerState.REACHED, PlannerState.FAILED, PlannerState.REACHED]
    )

    def send(goal: Any) -> None:
        stack.sent.append((clock.now - 1000.0, goal))
        stack.client.status = named(state=next(states))

    stack.client.send = send
    monkeypatch.setattr(soak, "time", clock)
    monkeypatch.setattr(soak, "_sample_process", lambda pid: iter([pid, clock.now, 3.0, 4.0]))
    times, samples, goals = soak._fly_and_sample(stack, 40.0, lambda: False)
    assert len(times) == 20
    assert np.diff(times) == pytest.approx(2.05, abs=0.06)
    assert times[0] == 0.0
    assert samples.keys() == {"plant", "recorder", "supervisor"}
    np.testing.assert_allclose(samples["plant"]["pss"], times + 1000.1, atol=1e-6)
    assert set(samples["supervisor"]["rss"]) == {os.getpid()}
    assert set(samples["recorder"]["descriptors"]) == {3.0}
    assert set(samples["recorder"]["threads"]) == {4.0}
    assert goals == {"reached": 2, "failed": 1}, "those that it had for each goal; idle is none"
    when = [time for time, _ in stack.sent]
    assert when == pytest.approx([0.1, 12.1, 24.1, 36.1], abs=0.11)
    _, none_sent, _ = soak._fly_and_sample(stack, 40.0, lambda: True)
    assert none_sent["plant"]["rss"].size == 0


def test_goals_of_a_long_flight_are_small() -> None:
    rng = random.Random(3)
    goals = [soak._random_goal(rng) for _ in range(300)]
    positions = np.array([goal.position for goal in goals])
    turns = 2 * np.array([goal.quaternion[:3] for goal in goals])
    for numbers, largest in ((positions, 0.05), (turns, 1e-4)):
        assert 0.97 * largest < numbers.max() <= largest
        assert -largest <= numbers.min() < -0.97 * largest


def test_a_process_is_sampled_by_its_files() -> None:
    rss, pss, descriptors, threads = soak._sample_process(os.getpid())
    assert 10.0 < pss <= rss * 1.05 < 20_000.0
    with open(os.devnull), open(os.devnull):
        assert list(soak._sample_process(os.getpid()))[2] == descriptors + 2
    assert threads == len(os.listdir("/proc/self/task"))
    with open("/proc/self/statm") as file:
        pages = int(file.read().split()[1])
    assert rss == pytest.approx(pages * os.sysconf("SC_PAGE_SIZE") / 2**20, rel=0.05)


SOAKED = {
    "method": "lie_bracket",
    "lie_bracket.t1": 3.0,
    "lie_bracket.cycle_period": 1.0,
    "lie_bracket.cycles": 0,
    "attitude_tolerance": 1e-2,
    "position_tolerance": 1e-2,
}


def test_a_long_flight_has_a_verdict_samples_and_a_picture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = np.linspace(0.0, 120.0, 61)
    flat = {name: np.full(61, 20.0) for name in soak.SAMPLED_QUANTITIES}
    samples = {"plant": dict(flat), "recorder": dict(flat)}
    stack, scenarios, drawn = Stack(Clock()), [], []  # type: ignore[var-annotated]
    monkeypatch.setattr(
        soak, "_fly_and_sample", lambda stack, duration, stopped: (times, samples, {"reached": 4})
    )
    monkeypatch.setattr(Figure, "savefig", lambda *arguments, **_: drawn.append(arguments))
    lines: list[str] = []
    file = tmp_path / "new" / "soak.png"
    with in_processes(stack, scenarios, tmp_path / "x.mcap") as run:
        monkeypatch.setattr(soak, "stack_in_processes", run)
        found = soak.soak_benchmark(120.0, lines.append, file)
        samples["recorder"]["threads"] = 20.0 + (times > 80.0)
        grown = soak.soak_benchmark(120.0, lines.append)
    assert found["flat"]
    assert not grown["flat"]
    assert (found["duration_s"], found["goals"]) == (120.0, {"reached": 4})
    assert found["samples"]["time_s"] == times.tolist()
    assert found["samples"]["plant"]["rss"] == [20.0] * 61
    assert [(t["process"], t["quantity"], t["flat"]) for t in grown["trends"]] == [
        (process, quantity, (process, quantity) != ("recorder", "threads"))
        for process in samples
        for quantity in ("rss", "pss", "descriptors", "threads")
    ]
    assert stack.log == [("start", None), "finish"] * 2
    assert (lines[10], lines[-1]) == ("All are flat.", "1 of 8 grow.")
    given = scenarios[0].parameters("planner")
    assert {name: given[name] for name in given if name in SOAKED} == SOAKED
    assert not scenarios[0].lockstep
    ((figure, where),) = drawn
    assert where == file
    assert file.parent.is_dir()
    assert [axes.get_ylabel() for axes in figure.axes] == [
        "rss [MiB]",
        "pss [MiB]",
        "descriptors",
        "threads",
    ]
    assert figure.axes[-1].get_xlabel() == "wall time [min]"
    assert figure.get_size_inches().tolist() == [9.0, 9.0]
    assert [text.get_text() for text in figure.axes[0].get_legend().get_texts()] == list(samples)
    for axes in figure.axes:
        assert [line.get_label() for line in axes.lines] == ["plant", "recorder"]
        assert axes.get_ylim()[0] == 0.0
        assert {line.get_linewidth() for line in axes.lines} == {1.0}
        assert axes.get_xgridlines()[0].get_alpha() == 0.3
        assert axes.lines[0].get_xdata()[-1] == 2.0
        assert np.all(axes.lines[1].get_ydata()[:30] == 20.0)


# -- ticks ------------------------------------------------------------------------------------


def test_the_lines_and_figures_of_ticks(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[str, int, bool]] = []

    def speeds(name: str, cpu: float) -> Callable[..., Any]:
        numbers = iter([9.0, 1.0, 3.0, 2.0, 8.0])

        def measure(ticks: int, path: Path | None, scenario: str = "") -> Any:
            asked.append((scenario or name, ticks, path is not None))
            if path is not None:
                assert not path.exists()
                path.touch()
            if scenario:
                return ticks_speed(50.0, next(numbers_of_servicer))
            unrecorded = 0.75 if path is None else 1.0
            number = next(numbers) if path is not None else 3.0
            return ticks_speed(100.0 * number * cpu, number * cpu * unrecorded)

        return measure

    ticks_speed = ticks._Speed
    numbers_of_servicer = iter([150.0, 90.0, 99.0, 300.0, 111.0])
    dynamics: dict[str, float | str] = {"compiler": "cc", "mujoco": "3"}
    dynamics["step_without_compiler_us"] = 9.0

    @contextmanager
    def no_ros(private: bool) -> Iterator[None]:
        assert private
        yield

    for name, value in {
        "ros": no_ros,
        "_stack_speed": speeds("stack", 40.0),
        "_exchange_speed": speeds("exchange", 15.0),
        "_replay_spacing": lambda folder: (0.00012, 0.00346),
        "_plant_tick_cpu_time": lambda: 4.56,
        "_planning_times": lambda: iter([("square_path", 0.5004, 0.1236)]),
        "dynamics_benchmark": lambda: dynamics,
        "c_compiler": lambda: None,
        "import_time": lambda module: {"spacerobot_ros.nodes.plant.node": 0.456}[module],
    }.items():
        monkeypatch.setattr(ticks, name, value)
    lines: list[str] = []
    figures = ticks.ticks_benchmark(2700, lines.append)
    turn = [("exchange", 2700, True), ("stack", 2700, True), ("stack", 2700, False)]
    assert asked == [*turn, ("servicer", 2000, True)] * 5
    assert lines[0] == (
        "round: 360.0 us of CPU time a tick with plant, planner and recorder, "
        "135.0 us minimal exchange"
    )
    assert lines[5:] == [
        "lockstep, recorded: 12000 ticks/s, 120.0 us of CPU time a tick (medians of 5)",
        "minimal exchange with as many topics and a raw recorder: 4500 ticks/s, "
        "45.0 us of CPU time a tick",
        "ratio of the CPU times: 0.38",
        "the recorder takes 25 % of the CPU time",
        "the servicer under control, recorded: 111.0 us of CPU time a tick",
        "the import of the plant's node: 0.46 s of CPU time",
        "replay at rate 1, 100 messages a second: spacing off by 0.12 ms (median), 3.5 ms at most",
        "one plant tick alone: 4.6 us (compiler: none (virtual machine))",
        "planning by square_path: 124 ms, the first time 500 ms",
        "... in the virtual machine: 9.0 us",
        "MuJoCo: 3",
    ]
    assert figures == {
        "ticks_per_s": 12000.0,
        "bare_ticks_per_s": 4500.0,
        "unrecorded_ticks_per_s": 12000.0,
        "tick_cpu_us": 120.0,
        "bare_tick_cpu_us": 45.0,
        "recorder_cost": 0.25,
        "ratio_to_bare": 0.375,
        "servicer_tick_cpu_us": 111.0,
        "plant_import_cpu_s": 0.456,
        "replay_spacing_error_s": 0.00012,
        "plant_tick_us": 4.56,
        "plan_square_path_first_s": 0.5004,
        "plan_square_path_s": 0.1236,
        **dynamics,
    }


@pytest.mark.parametrize(
    ("figures", "expected"),
    [
        (
            {"step_us": 2.04, "mujoco_step_us": 7.06, "ratio_to_mujoco": 3.46},
            [
                "one RK4 step of the servicer's dynamics: 2.0 us",
                "... in the virtual machine: 11.1 us",
                "MuJoCo 9.8, mj_step with RK4: 7.1 us",
                "times faster than MuJoCo: 3.5",
                "... without a compiler: 0.63",
            ],
        ),
        (
            {"mujoco_step_us": 7.06},
            [
                "... in the virtual machine: 11.1 us",
                "MuJoCo 9.8, mj_step with RK4: 7.1 us",
                "... without a compiler: 0.63",
            ],
        ),
    ],
)
def test_the_lines_of_the_dynamics(figures: dict[str, Any], expected: Sequence[str]) -> None:
    both: dict[str, Any] = {
        "mujoco": "9.8",
        "step_without_compiler_us": 11.14,
        "ratio_to_mujoco_without_compiler": 0.634,
    }
    assert list(ticks._dynamics_lines({**both, **figures})) == expected


def test_speeds_are_of_ticks() -> None:
    assert list(ticks._speed_of(500, 0.25, 0.01)) == [2000.0, pytest.approx(20.0)]


def test_one_tick_is_timed_over_many(monkeypatch: pytest.MonkeyPatch) -> None:
    steps: list[Any] = []

    def medians(runs: Any, rounds: int) -> dict[str, float]:
        ((name, (run, parts)),) = runs.items()
        run()
        assert (len(steps), rounds) == (parts, 5)
        return {name: 3.5}

    monkeypatch.setattr(ticks, "_PLANT_TICKS", 30)
    monkeypatch.setattr(ticks, "median_cpu_times", medians)
    monkeypatch.setattr(ticks, "VelocityPlant", lambda robot, period: named(step=steps.append))
    assert ticks._plant_tick_cpu_time() == 3.5
    assert all(0.0 < np.abs(command).max() <= 1e-5 for command in steps)


def test_methods_are_timed_first_and_later(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    planned: list[tuple[str, str, Any]] = []

    def scenario(name: str) -> Any:
        durations = iter([0.9, 0.1, 0.5, 0.2, 0.3, 0.15])

        def method(method_name: str) -> Any:
            def plan(request: Any) -> None:
                planned.append((name, method_name, request))
                clock.advance(next(durations))

            return named(plan=plan)

        config = named(tolerance=f"tolerance of {name}")
        problem = named(
            plant=lambda: f"plant of {name}", goal=f"goal of {name}", config=config, method=method
        )
        return named(problem=lambda: problem)

    monkeypatch.setattr(ticks, "time", clock)
    monkeypatch.setattr(ticks, "load_scenario", scenario)
    monkeypatch.setattr(ticks, "robot_state_of", lambda plant: f"state of the {plant}")
    monkeypatch.setattr(ticks, "PlanRequest", lambda *parts: parts)
    found = list(ticks._planning_times())
    assert [name for name, _, _ in found] == ["lie_bracket", "area_loop", "square_path"]
    for _, first, later in found:
        assert (first, later) == pytest.approx((0.9, 0.2))
    assert len(planned) == 18
    state, goal, tolerance = planned[0][2]
    assert state == "state of the plant of sliding_masses"
    assert (goal, tolerance) == ("goal of sliding_masses", "tolerance of sliding_masses")
    assert {(a, b) for a, b, _ in planned} == {
        ("sliding_masses", "lie_bracket"),
        ("arm_attitude", "area_loop"),
        ("planar_chain", "square_path"),
    }


def test_messages_of_the_exchange_are_as_long_as_the_stacks() -> None:
    joints = ticks._message_with_lists(JointState, 3)
    assert list(joints.name) == ["slider_1", "slider_2", "slider_3"]
    assert len(joints.position) == len(joints.velocity) == len(joints.effort) == 3
    assert len(ticks._message_with_lists(Float64MultiArray, 7).data) == 7
    assert isinstance(ticks._message_with_lists(Odometry, 0), Odometry)


def test_the_exchange_has_as_many_messages_as_the_stack(own_domain: None, tmp_path: Path) -> None:
    bag = tmp_path / "raw.mcap"
    with ros(private=True):
        speed = ticks._exchange_speed(41, bag)
    assert speed.ticks_per_s > 0
    assert speed.cpu_us > 0
    from mcap.reader import make_reader

    with bag.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    counts = summary.statistics.channel_message_counts
    topics = {summary.channels[key].topic: count for key, count in counts.items()}
    # Each tick all of them, the pose each twentieth; the last command ends the exchange.
    assert topics["base_pose"] == 3
    for topic in ("/clock", "odom", "momentum", "joint_states"):
        assert topics[topic] == 41
    assert topics["joint_commands"] in (40, 41)


def test_a_replay_is_timed_message_by_message(
    own_domain: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ticks, "_REPLAYED_MESSAGES", 9)
    steps = itertools.chain([0.0125] * 6, [0.017], itertools.repeat(0.0125))
    arrivals = itertools.accumulate(steps)
    monkeypatch.setattr(ticks, "time", named(perf_counter=lambda: next(arrivals)))
    with ros(private=True):
        median, worst = ticks._replay_spacing(tmp_path)
    bag = read_bag(tmp_path / "spacing.mcap")
    assert bag.message_count("/bench/joint_states") == 9
    stamps = [time for time, _ in bag["/bench/joint_states"].messages()]
    assert stamps == [k * 10_000_000 for k in range(9)]
    assert median == pytest.approx(0.0025), "beyond a hundredth of a second"
    assert worst > 0.0069


@pytest.mark.slow
def test_the_stack_is_timed_while_it_flies(
    own_domain: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def speed_of(count: int, wall: float, cpu: float) -> Any:
        asked.append((count, wall, cpu))
        return ticks._Speed(1.0, 2.0)

    monkeypatch.setattr(ticks, "_speed_of", speed_of)
    bag = tmp_path / "flight.mcap"
    with ros(private=True):
        assert ticks._stack_speed(60, bag) == (1.0, 2.0)
    ((count, wall, cpu),) = asked
    assert count >= 60
    assert 0.0 < cpu < 60.0
    assert 0.0 < wall < 60.0
    assert read_bag(bag).message_count("/odom") >= count
