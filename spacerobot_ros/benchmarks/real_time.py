"""Separate processes in real time: deadlines, losses and memory, also beside a viewer."""

from __future__ import annotations

import math
import multiprocessing
import os
import shutil
import statistics
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields
from itertools import cycle
from pathlib import Path
from threading import Thread
from urllib.parse import urlsplit

import numpy as np
from geometry_msgs.msg import PoseStamped

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.benchmarks.measurements import gait_cycles_for
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.messages.statuses import key_values
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.planning import Goal
from spacerobot_ros.scenario import Scenario, load_scenario
from spacerobot_ros.session.processes import MultiProcessStack
from spacerobot_ros.session.run import ros
from spacerobot_ros.session.viewing import viewing
from spacerobot_ros.termination import end_with_parent, ended_on_request, tool
from spacerobot_ros.times import SECOND

_MEMORY_PERIOD = 1.0
"""Wall time between two samples of the processes' memory, s."""

_LONGEST_IDLE_END = 5.0

_WARM_UP_SHARE = 0.25
"""Share of the flight after which memory must not grow."""

_PRIORITY_BY_NODE = {"plant": 30, "planner": 20, "coordinated_control": 20, "recorder": 10}
"""Priorities of the kernel's real-time scheduling, where it is allowed; `chrt -f` sets the same."""

_FLIGHT_GOAL = Goal.checked([0.2, -0.15, 0.05], quaternion_from_rotvec([0.1, -0.05, 0.02]))
_COUNTED_STATE_TOPICS = ("/clock", "/odom", "/joint_states", "/momentum")


@contextmanager
def stack_in_processes(
    scenario: Scenario,
) -> Iterator[tuple[MultiProcessStack, Path, Callable[[], bool]]]:
    """Run the nodes of a scenario in separate processes.

    Yields the stack, its bag, and a function that returns whether a signal has requested the end.
    """
    with ros(private=False), tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        bag = Path(folder, "flight.mcap")
        stack = MultiProcessStack(scenario, bag)
        try:
            with ended_on_request() as stopped:
                yield stack, bag, stopped
        finally:
            stack.close()


def finish(stack: MultiProcessStack, stopped: Callable[[], bool]) -> None:
    """End the flight and complete its bag.

    Raises
    ------
    SpaceRobotError
        A node did not end well, or a signal has interrupted the flight.
    """
    stack.finish()
    if stopped():
        raise SpaceRobotError("The flight in real time was interrupted.")


@dataclass(frozen=True)
class RealTimeFigures:
    """Figures of a flight in real time.

    Deadlines (:class:`~spacerobot_ros.simulation.time_modes.RealTime`): one a tick for the
    plant and one a state for its commander. Lost messages were published and are not in the
    bag; memory is the resident set of all processes. The idle process only waits for the same
    ticks: when it is late, the machine was busy.
    """

    rate: float
    duration_s: float
    ticks: int
    ticks_late: int
    ticks_skipped: int
    worst_tick_ms: float
    commands_late: int
    commands_missing: int
    worst_command_ms: float
    states_lost: int
    commands_lost: int
    memory_MiB: float
    memory_growth_MiB: float
    idle_late: int
    idle_worst_ms: float
    prioritised: bool

    @property
    def missed(self) -> float:
        """Share of all deadlines that was missed."""
        late = self.ticks_late + self.ticks_skipped + self.commands_late + self.commands_missing
        return late / (2 * self.ticks)

    def lines(self) -> Iterator[str]:
        """Yield the figures as lines for the user."""
        worst = max(self.worst_tick_ms, self.worst_command_ms)
        yield (
            f"{self.rate:g} commands a second for {self.duration_s:.0f} s: "
            f"{100 * self.missed:.3f} % of the deadlines missed, by {worst:.1f} ms at most "
            f"({'with' if self.prioritised else 'without'} real-time priorities)"
        )
        yield (
            f"  ticks late {self.ticks_late}, skipped {self.ticks_skipped}; commands late "
            f"{self.commands_late}, missing {self.commands_missing}, of {self.ticks} each"
        )
        yield (
            f"  lost in the bag: {self.states_lost} states, {self.commands_lost} commands; "
            f"memory {self.memory_MiB:.0f} MiB, grown by {self.memory_growth_MiB:.2f} MiB"
        )
        yield (
            f"  beside it an idle process was late {self.idle_late} times, by "
            f"{self.idle_worst_ms:.1f} ms at most"
        )

    def figures(self) -> dict[str, float]:
        """Return all figures by name; the names contain the rate."""
        return {
            f"real_time_{self.rate:g}_{each.name}": getattr(self, each.name)
            for each in fields(self)
            if each.name != "rate"
        }


def real_time_benchmark(
    duration: float, rates: Sequence[float], show: Callable[[str], None]
) -> dict[str, float]:
    """Fly for ``duration`` s at each rate, show lines and return the figures by name."""
    figures: dict[str, float] = {}
    for rate in rates:
        measured = real_time_flight(rate, duration)
        figures |= measured.figures()
        for line in measured.lines():
            show(line)
    return figures


def real_time_flight(rate: float, duration: float) -> RealTimeFigures:
    """Fly sliding masses in real time for ``duration`` s at ``rate`` commands a second.

    Plant, planner and recorder are processes of their own.

    Raises
    ------
    SpaceRobotError
        A node has ended by itself, or the flight was interrupted.
    """
    scenario = (
        load_scenario("sliding_masses")
        .in_real_time(1.0)
        .with_overrides("plant", {"tick_rate": rate, "diagnostics_period": 1.0})
        .with_method("lie_bracket")
        .with_overrides(
            "planner", {"tick_rate": rate, "lie_bracket.cycles": gait_cycles_for(duration)}
        )
    )
    memory: list[float] = []
    with (
        stack_in_processes(scenario) as (stack, bag, stopped),
        multiprocessing.get_context("spawn").Pool(1) as idle_process,
    ):
        idle = idle_process.apply_async(_wait_for_ticks, (1.0 / rate, duration))
        prioritised = prioritise(stack)
        stack.start(_FLIGHT_GOAL)
        began = sampled = time.monotonic()

        def sample_memory() -> bool:
            nonlocal sampled
            now = time.monotonic()
            if now - sampled >= _MEMORY_PERIOD:
                sampled = now
                memory.append(_resident_memory(stack))
            return stopped() or now - began >= duration

        stack.spin(sample_memory)
        finish(stack, stopped)
        published = stack.statistics.commands_published
        idle_delays = 0, math.nan
        with suppress(multiprocessing.TimeoutError):
            idle_delays = idle.get(_LONGEST_IDLE_END)
        return _flight_figures(
            rate, read_bag(bag), published, memory, idle_delays, prioritised=prioritised
        )


def _flight_figures(
    rate: float,
    bag: Bag,
    published: int,
    memory: list[float],
    idle_delays: tuple[int, float],
    *,
    prioritised: bool,
) -> RealTimeFigures:
    reports = list(_timing_reports(bag))
    if not published or not reports or reports[-1][2]["ticks"] == "0":
        raise SpaceRobotError("The flight ended before the planner had commanded anything.")
    _, skipped, timing = reports[-1]
    ticks = int(timing["ticks"])
    # Every tick publishes each state once, and the first one comes before the first tick.
    stamps = bag["/joint_states"].stamp
    states = round((stamps[-1] - stamps[0]) * rate) + 1
    lost = max(states - bag.message_count(topic) for topic in _COUNTED_STATE_TOPICS)
    settled = memory[int(_WARM_UP_SHARE * len(memory)) :]
    third = max(len(settled) // 3, 1)
    return RealTimeFigures(
        rate=rate,
        duration_s=float(np.ptp(stamps)),
        ticks=ticks,
        ticks_late=int(timing["ticks_late"]),
        ticks_skipped=skipped,
        worst_tick_ms=float(timing["worst_tick_ms"]),
        commands_late=int(timing["commands_late"]),
        commands_missing=max(ticks - 1 - int(timing["commands"]), 0),
        worst_command_ms=float(timing["worst_command_ms"]),
        states_lost=lost,
        commands_lost=published - bag.message_count("/joint_commands"),
        memory_MiB=memory[-1],
        memory_growth_MiB=statistics.median(settled[-third:]) - statistics.median(settled[:third]),
        idle_late=idle_delays[0],
        idle_worst_ms=idle_delays[1],
        prioritised=prioritised,
    )


def _timing_reports(bag: Bag) -> Iterator[tuple[float, int, dict[str, str]]]:
    """Yield time (s), ticks skipped so far and values of each report of the plant's timing."""
    skipped = 0
    for time_ns, array in bag["/diagnostics"].messages():
        for status in array.status:
            values = key_values(status.values)
            skipped = int(values.get("deadlines_missed", skipped))
            if status.name.endswith(": timing"):
                yield time_ns / SECOND, skipped, values


def prioritise(stack: MultiProcessStack) -> bool:
    """Have the kernel let the plant go first, then its commander; return whether it does."""
    try:
        for name, process in stack.processes.items():
            priority = os.sched_param(_PRIORITY_BY_NODE[name])
            for thread in Path(f"/proc/{process.pid}/task").iterdir():
                os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, priority)
    except (AttributeError, OSError):  # Not every system and user has real-time priorities.
        return False
    return True


def _wait_for_ticks(period: float, duration: float) -> tuple[int, float]:
    """Wait for ticks of a period for a duration, s, to measure the delays of the machine itself.

    Return the number of delays above a period, and the largest excess, ms.
    """
    Thread(target=end_with_parent, daemon=True).start()
    began = time.perf_counter()
    late, worst = 0, 0.0
    for tick in range(1, round(duration / period)):
        due = began + tick * period
        time.sleep(max(due - time.perf_counter(), 0.0))
        beyond = time.perf_counter() - due - period
        late += beyond > 0
        worst = max(worst, 1e3 * beyond)
    return late, worst


def process_facts(pid: int, name: str = "status") -> dict[str, str]:
    """Return the facts about a process in a file of ``/proc/PID``, by name."""
    text = Path(f"/proc/{pid}/{name}").read_text("utf-8")
    pairs = (line.partition(":") for line in text.splitlines())
    return {key: value.strip() for key, _, value in pairs}


def _resident_memory(stack: MultiProcessStack) -> float:
    """Return the resident memory of the stack's processes, MiB."""
    facts = (process_facts(process.pid) for process in stack.processes.values())
    return sum(int(each["VmRSS"].split()[0]) / 1024 for each in facts)


# -- beside a viewer -------------------------------------------------------------------------

_SETTLING_TIME = 10.0
"""Wall time without measurements after a viewer starts or ends, s."""

_GOAL_PERIOD = 15.0
"""Wall time between goals, s; goals keep the robot moving, so that it is drawn again."""

_GOAL_POSITIONS = ((0.0, 0.0, 0.0), (0.3, 0.1, -0.1))
"""Base positions of the goals, used in turn, m."""

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_BROWSER_OPTIONS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    "--window-size=1000,700",
)


def viewer_benchmark(
    seconds: float, show: Callable[[str], None], *, priorities: bool = True
) -> dict[str, float]:
    """Fly the servicer in real time in separate processes, in turns without and with a viewer.

    There are two turns of each. A browser opens the page as well, where one is installed.

    Parameters
    ----------
    seconds
        Wall time of a turn, s.
    show
        Called with lines for the user.
    priorities
        Whether the kernel is asked to let the plant and its controller go first.

    Returns
    -------
    By name: messages that a client beside the browser received a second while the robot moved, and
    number and missed share (%) of the deadlines of plant and controller with and without a viewer.

    Raises
    ------
    SpaceRobotError
        A node has ended by itself, viser is not installed, or the flight was interrupted.
    """
    scenario = (
        load_scenario("servicer")
        .in_real_time(1.0)
        .with_overrides("plant", {"diagnostics_period": 1.0})
    )
    spans: list[tuple[bool, float, float]] = []
    counts: list[float] = []
    browser = False
    with stack_in_processes(scenario) as (stack, bag, stopped):
        goals = _GoalSender(stack)
        prioritised = priorities and prioritise(stack)
        stack.start(None)
        for viewed in (False, True, False, True):
            with ExitStack() as closing:
                client = None
                if viewed:
                    client = closing.enter_context(_viewer_and_browser(bag.parent))
                    browser = client.browser
                goals.spin(_SETTLING_TIME, stopped)
                before, began = client.count if client else 0, stack.time_ns / SECOND
                goals.spin(seconds, stopped)
                spans.append((viewed, began, stack.time_ns / SECOND))
                if client is not None:
                    counts.append((client.count - before) / seconds)
        finish(stack, stopped)
        table = _read_deadline_counts(read_bag(bag))
    updates = min(counts)
    figures = {"viewer_updates_per_s": updates}
    shares = []
    for viewed, which in ((False, "without"), (True, "with")):
        turns = [_counts_between(table, start, end) for each, start, end in spans if each == viewed]
        deadlines, missed = np.sum(turns, axis=0)
        figures[f"viewer_missed_{which}_percent"] = percent = 100.0 * missed / max(deadlines, 1)
        figures[f"viewer_deadlines_{which}"] = deadlines
        shares.append(f"{percent:.3f} % of {deadlines:.0f} {which} it")
    clients = "a browser and a client" if browser else "a client (no browser is installed)"
    show(f"viewer with {clients}: {updates:.1f} updates a second received")
    with_priorities = f"{'with' if prioritised else 'without'} real-time priorities"
    show(f"deadlines missed: {', '.join(shares)} ({with_priorities})")
    switches = {"viewer_browser": float(browser), "viewer_prioritised": float(prioritised)}
    return {**figures, **switches}


class _GoalSender:
    """Sends goals periodically, so that the robot moves."""

    def __init__(self, stack: MultiProcessStack) -> None:
        self._stack, self._positions = stack, cycle(_GOAL_POSITIONS)
        self._topic = stack.client.node.create_publisher(PoseStamped, "goal_pose", STREAM)
        self._due = 0.0

    def spin(self, seconds: float, stopped: Callable[[], bool]) -> None:
        """Spin the stack for a wall time, s, and send the goals that are due."""
        end = time.monotonic() + seconds
        while (now := time.monotonic()) < end and not stopped():
            self._stack.require_alive()
            if now >= self._due:
                self._due = now + _GOAL_PERIOD
                message = PoseStamped()
                p = message.pose.position
                p.x, p.y, p.z = next(self._positions)
                message.pose.orientation.w = 1.0
                self._topic.publish(message)
            self._stack.executor.spin_once(timeout_sec=0.05)


class _CountingClient:
    """A client of the page that counts the messages that it receives.

    ``browser`` says whether there is a real one beside it.
    """

    def __init__(self, url: str, *, browser: bool) -> None:
        import viser
        from websockets.sync.client import connect
        from websockets.typing import Subprotocol

        self.count, self.browser = 0, browser
        self._connection = connect(
            f"ws://{urlsplit(url).netloc}",
            subprotocols=[Subprotocol(f"viser-v{viser.__version__}")],
            max_size=None,
        )
        self._thread = Thread(target=self._count_messages, daemon=True)
        self._thread.start()

    def _count_messages(self) -> None:
        with suppress(Exception):  # The connection is closed.
            for _ in self._connection:
                self.count += 1

    def close(self) -> None:
        """Disconnect from the page's server."""
        self._connection.close()
        self._thread.join(5.0)


@contextmanager
def _viewer_and_browser(folder: Path) -> Iterator[_CountingClient]:
    """Run a viewer with a client, and with a browser where one is installed."""
    lines: list[str] = []
    with ExitStack() as closing:
        closing.enter_context(viewing({"port": 0}, lines.append))
        url = lines[0].split()[-1]
        program = next((path for name in _BROWSERS if (path := shutil.which(name))), None)
        if program is not None:
            profile = tempfile.mkdtemp(prefix="browser_", dir=folder)
            closing.enter_context(
                tool(
                    [program, *_BROWSER_OPTIONS, f"--user-data-dir={profile}", url],
                    stdout=subprocess.DEVNULL,
                    stderr=subprocess.DEVNULL,
                )
            )
        client = _CountingClient(url, browser=program is not None)
        closing.callback(client.close)
        yield client


def _read_deadline_counts(bag: Bag) -> Array:
    """Return a row (time s, deadlines, missed ones) for each report of the plant's timing.

    All counts begin at the start of the flight.
    """
    rows = []
    for time_s, skipped, values in _timing_reports(bag):
        late = int(values["ticks_late"]) + int(values["commands_late"]) + skipped
        rows.append((time_s, 2 * int(values["ticks"]), late))
    if len(rows) < 2:
        raise SpaceRobotError("The flight was too short to count its deadlines.")
    return np.array(rows, float)


def _counts_between(table: Array, start: float, end: float) -> Array:
    """Return the counts (2,) between two times, s, by a table of counts from the beginning."""
    rows = np.clip(np.searchsorted(table[:, 0], (start, end)), 0, len(table) - 1)
    return np.asarray(np.ptp(table[rows, 1:], axis=0))
