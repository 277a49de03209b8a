"""What a viewer costs a plant in real time: one flight, with and without a viewer in turns."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from itertools import cycle
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
from geometry_msgs.msg import PoseStamped

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.benchmarks.real_time import prioritise
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.scenario import load_scenario
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.session.processes import MultiProcessStack
from spacerobot_ros.session.run import ros
from spacerobot_ros.session.viewing import viewing
from spacerobot_ros.termination import ended_on_request, tool
from spacerobot_ros.times import SECOND

_SCENARIO = "servicer"

_SETTLING = 10.0
"""Wall s after a viewer and its browser have been started, or ended, that count for neither."""

_GOAL_PERIOD = 15.0
"""Wall s from one goal to the next: what rests is not drawn again."""

_GOALS = ((0.0, 0.0, 0.0), (0.3, 0.1, -0.1))
"""Positions of the base in turns, m."""

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
_BROWSER_OPTIONS = (
    *("--headless=new", "--no-sandbox", "--no-first-run", "--disable-background-networking"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
    "--window-size=1000,700",
)


@dataclass(frozen=True)
class Phase:
    """Deadlines of a part of the flight: how many there were, and how many were missed."""

    deadlines: int = 0
    missed: int = 0

    def __add__(self, other: Phase) -> Phase:
        """Count two parts together."""
        return Phase(self.deadlines + other.deadlines, self.missed + other.missed)

    @property
    def percent(self) -> float:
        """The part that was missed, %."""
        return 100.0 * self.missed / max(self.deadlines, 1)


@dataclass(frozen=True)
class ViewerFigures:
    """What was measured.

    Attributes
    ----------
    updates_per_s
        Messages that a client beside the browser received a second while the robot moved.
    missed_without_percent, missed_with_percent
        Deadlines of plant and controller that were missed.
    deadlines_without, deadlines_with
        How many there were.
    browser
        Whether a browser had the page open as well.
    prioritised
        Whether the kernel let the plant and its controller go first.
    """

    updates_per_s: float
    missed_without_percent: float
    missed_with_percent: float
    deadlines_without: int
    deadlines_with: int
    browser: bool
    prioritised: bool

    def lines(self) -> Iterator[str]:
        """Yield the figures as lines for people."""
        client = "a browser and a client" if self.browser else "a client (no browser is installed)"
        priorities = f"{'with' if self.prioritised else 'without'} real-time priorities"
        yield f"viewer with {client}: {self.updates_per_s:.1f} updates a second received"
        yield (
            f"deadlines missed: {self.missed_without_percent:.3f} % of {self.deadlines_without} "
            f"without it, {self.missed_with_percent:.3f} % of {self.deadlines_with} with it "
            f"({priorities})"
        )


def run_viewer_benchmark(
    seconds: float, show: Callable[[str], None], *, priorities: bool = True
) -> dict[str, float]:
    """Fly the servicer in real time in separate processes, twice ``seconds`` without a viewer and
    twice with one, in turns, and return the figures by name.

    Parameters
    ----------
    seconds
        Wall time of a turn, s.
    show
        Shows a line to people.
    priorities
        Whether the kernel is asked to let the plant and its controller go first.

    Raises
    ------
    SpaceRobotError
        A node has ended by itself, viser is not installed, or the flight was interrupted.
    """
    scenario = (
        load_scenario(_SCENARIO)
        .in_real_time(1.0)
        .with_overrides("plant", {"diagnostics_period": 1.0})
    )
    with (
        ros(private=False),
        tempfile.TemporaryDirectory(prefix="spacerobot_") as folder,
        ExitStack() as closing,
    ):
        stack = MultiProcessStack(scenario, Path(folder, "flight.mcap"))
        spans: list[tuple[bool, float, float]] = []
        counts: list[float] = []
        browser = False
        try:
            stopped = closing.enter_context(ended_on_request())
            goals = _Goals(stack)
            prioritised = priorities and prioritise(stack)
            stack.start(None)
            for viewed in (False, True, False, True):
                with ExitStack() as beside:
                    client = None
                    if viewed:
                        client = beside.enter_context(_viewer_and_browser(Path(folder)))
                        browser = client.browser
                    goals.spin(_SETTLING, stopped)
                    before, began = client.count if client else 0, stack.time_ns / SECOND
                    goals.spin(seconds, stopped)
                    spans.append((viewed, began, stack.time_ns / SECOND))
                    if client is not None:
                        counts.append((client.count - before) / seconds)
            stack.finish()
        finally:
            stack.close()
        if stopped():
            raise SpaceRobotError("The flight in real time was interrupted.")
        table = _deadlines(read_bag(Path(folder, "flight.mcap")))
    phases = {False: Phase(), True: Phase()}
    for viewed, start, end in spans:
        phases[viewed] += _between(table, start, end)
    figures = ViewerFigures(
        updates_per_s=min(counts),
        missed_without_percent=phases[False].percent,
        missed_with_percent=phases[True].percent,
        deadlines_without=phases[False].deadlines,
        deadlines_with=phases[True].deadlines,
        browser=browser,
        prioritised=prioritised,
    )
    for line in figures.lines():
        show(line)
    return {f"viewer_{name}": float(value) for name, value in asdict(figures).items()}


class _Goals:
    """Sends goals in turns, so that the robot moves, while the stack is looked after."""

    def __init__(self, stack: MultiProcessStack) -> None:
        self._stack, self._positions = stack, cycle(_GOALS)
        self._topic = stack.client.node.create_publisher(PoseStamped, "goal_pose", STREAM)
        self._due = 0.0

    def spin(self, seconds: float, stopped: Callable[[], bool]) -> None:
        """Go on for a wall time."""
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


class _Client:
    """A client of the page that counts what it receives, as a browser's worker does.

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
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with suppress(Exception):  # It is closed.
            for _ in self._connection:
                self.count += 1

    def close(self) -> None:
        """Receive no more."""
        self._connection.close()
        self._thread.join(5.0)


@contextmanager
def _viewer_and_browser(folder: Path) -> Iterator[_Client]:
    """Have a viewer run, with a client and, where one is installed, a browser that draws."""
    said: list[str] = []
    with ExitStack() as closing:
        closing.enter_context(viewing({"port": 0}, said.append))
        url = said[0].split()[-1]
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
        client = _Client(url, browser=program is not None)
        closing.callback(client.close)
        yield client


def _deadlines(bag: Bag) -> Array:
    """Return a row (time s, deadlines, missed ones) for each report of the plant's timing, all
    counted from the beginning.
    """
    rows = []
    skipped = 0
    for time_ns, array in bag["/diagnostics"].messages():
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            skipped = int(values.get("deadlines_missed", skipped))
            if status.name.endswith(": timing"):
                late = int(values["ticks_late"]) + int(values["commands_late"]) + skipped
                rows.append((time_ns / SECOND, 2 * int(values["ticks"]), late))
    if len(rows) < 2:
        raise SpaceRobotError("The flight was too short to count its deadlines.")
    return np.array(rows, float)


def _between(table: Array, start: float, end: float) -> Phase:
    """Return the counts between two times, s, by a table of counts from the beginning."""
    time_s, deadlines, missed = table.T
    at = np.clip(np.searchsorted(time_s, (start, end)), 0, len(time_s) - 1)
    return Phase(int(np.ptp(deadlines[at])), int(np.ptp(missed[at])))
