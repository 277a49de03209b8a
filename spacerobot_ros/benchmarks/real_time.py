"""How well separate processes keep up with real time, and whether anything is lost or grows."""

from __future__ import annotations

import math
import multiprocessing
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, fields
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Thread

import numpy as np

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.scenario import load_scenario
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.planning import Goal
from spacerobot_ros.session.processes import MultiProcessStack
from spacerobot_ros.session.run import ros
from spacerobot_ros.termination import ended_on_request

_MEMORY_PERIOD = 1.0
"""Wall s between two looks at the processes' memory."""

_LONGEST_IDLE_END = 5.0

_WARM_UP = 0.25
"""Part of the time after which memory is to grow no more."""

_PRIORITIES = {"plant": 30, "planner": 20, "coordinated_control": 20, "recorder": 10}
"""Priorities of the kernel's real-time scheduling, where it is allowed; `chrt -f` sets the same."""

_GOAL = Goal.checked([0.2, -0.15, 0.05], quaternion_from_rotvec([0.1, -0.05, 0.02]))
_FEWEST_CYCLES = 170
"""Fewer have too large loops for the turn."""

_STATES = ("/clock", "/odom", "/joint_states", "/momentum")


@dataclass(frozen=True)
class RealTimeFigures:
    """What a flight in real time came to.

    Deadlines (:class:`~spacerobot_ros.simulation.time_modes.RealTime`): one a tick for the
    plant and one a state for its commander. Lost are messages that were published and are not in
    the bag; memory is the resident set of all processes. The idle process does nothing but wait for
    the same ticks: when it is late, the machine was.
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
        """Part of all deadlines that was missed."""
        late = self.ticks_late + self.ticks_skipped + self.commands_late + self.commands_missing
        return late / (2 * self.ticks)

    def lines(self) -> Iterator[str]:
        """Yield the figures as lines for people."""
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
        """Return all numbers by name, with the rate in it."""
        return {
            f"real_time_{self.rate:g}_{each.name}": getattr(self, each.name)
            for each in fields(self)
            if each.name != "rate"
        }


def run_benchmark(
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
        .with_overrides("planner", {"tick_rate": rate, **_gait(duration)})
    )
    memory: list[float] = []
    with (
        ros(private=False),
        tempfile.TemporaryDirectory(prefix="spacerobot_") as folder,
        ExitStack() as closing,
    ):
        bag = Path(folder, "flight.mcap")
        stack = MultiProcessStack(scenario, bag)
        idle = _IdleProcess(1.0 / rate, duration)
        prioritised = prioritise(stack)
        try:
            stopped = closing.enter_context(ended_on_request())
            stack.start(_GOAL)
            began = looked = time.monotonic()

            def look() -> bool:
                nonlocal looked
                now = time.monotonic()
                if now - looked >= _MEMORY_PERIOD:
                    looked = now
                    memory.append(_resident(stack))
                return stopped() or now - began >= duration

            stack.spin(look)
            stack.finish()
            published = stack.statistics.commands_published
        finally:
            stack.close()
            late = idle.end()
        if stopped():
            raise SpaceRobotError("The flight in real time was interrupted.")
        return _figures(rate, read_bag(bag), published, memory, late, prioritised=prioritised)


def _gait(duration: float) -> dict[str, object]:
    """Return the planner's parameters for a gait that lasts longer: 100 s, and cycles of 3 s."""
    cycles = max(_FEWEST_CYCLES, math.ceil((duration - 100.0) / 3.0) + 1)
    return {"method": "lie_bracket", "lie_bracket.cycles": cycles}


def _figures(
    rate: float,
    bag: Bag,
    published: int,
    memory: list[float],
    idle: tuple[int, float],
    *,
    prioritised: bool,
) -> RealTimeFigures:
    timing: dict[str, str] = {}
    skipped = 0
    for _, array in bag["/diagnostics"].messages():
        for status in array.status:
            values = {pair.key: pair.value for pair in status.values}
            if status.name.endswith(": timing"):
                timing = values
            skipped = int(values.get("deadlines_missed", skipped))
    if not published or not timing or timing["ticks"] == "0":
        raise SpaceRobotError("The flight ended before the planner had commanded anything.")
    ticks = int(timing["ticks"])
    # Every tick publishes each state once, and the first one comes before the first tick.
    stamps = bag["/joint_states"].stamp
    states = round((stamps[-1] - stamps[0]) * rate) + 1
    lost = max(states - bag.message_count(topic) for topic in _STATES)
    settled = memory[int(_WARM_UP * len(memory)) :]
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
        idle_late=idle[0],
        idle_worst_ms=idle[1],
        prioritised=prioritised,
    )


def prioritise(stack: MultiProcessStack) -> bool:
    """Have the kernel let the plant go first, then its commander; return whether it does."""
    try:
        for name, process in stack.processes.items():
            priority = os.sched_param(_PRIORITIES[name])
            for thread in Path(f"/proc/{process.pid}/task").iterdir():
                os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, priority)
    except (AttributeError, OSError):  # Not on every system, and not for everybody.
        return False
    return True


class _IdleProcess:
    """Waits for ticks and does nothing at them: its delays are those of the machine.

    Parameters
    ----------
    period
        s.
    duration
        s.
    """

    def __init__(self, period: float, duration: float) -> None:
        context = multiprocessing.get_context("spawn")
        self._receiver, sender = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_wait_for_ticks, args=(period, duration, sender), daemon=True
        )
        self._process.start()
        sender.close()

    def end(self) -> tuple[int, float]:
        """Return how often it was late by more than a period, and beyond that at most, in ms."""
        counts: tuple[int, float] = 0, math.nan
        if self._receiver.poll(_LONGEST_IDLE_END):
            counts = self._receiver.recv()
        self._process.kill()
        self._process.join()
        return counts


def _wait_for_ticks(period: float, duration: float, sender: Connection) -> None:
    Thread(target=_end_with_parent, daemon=True).start()
    began = time.perf_counter()
    late, worst = 0, 0.0
    for tick in range(1, round(duration / period)):
        due = began + tick * period
        time.sleep(max(due - time.perf_counter(), 0.0))
        beyond = time.perf_counter() - due - period
        late += beyond > 0
        worst = max(worst, 1e3 * beyond)
    sender.send((late, worst))


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _resident(stack: MultiProcessStack) -> float:
    """Return the resident memory of the stack's processes, MiB."""
    return sum(
        int(line.split()[1]) / 1024
        for process in stack.processes.values()
        for line in Path(f"/proc/{process.pid}/status").read_text("utf-8").splitlines()
        if line.startswith("VmRSS:")
    )
