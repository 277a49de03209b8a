"""Memory, descriptors and threads of separate processes over a long flight."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from spacerobot_ros.benchmarks.real_time import finish, process_facts, stack_in_processes
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.rotations import quaternion_from_rotvec
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.processes import MultiProcessStack

GOAL_PERIOD = 12.0
"""Wall time between goals, s."""

_SAMPLE_PERIOD = 2.0
_WARM_UP_SHARE = 0.25
"""Share of the flight that is not evaluated, while buffers fill and first plans are made."""

_MAX_SLOPE_SAMPLES = 400
"""Largest number of samples for a slope, which is a median over pairs; more are thinned out."""

_GOAL_SEED = 13
_MAX_GOAL_DISTANCE, _MAX_GOAL_ROTATION = 0.05, 0.0001
"""Largest coordinates of goals, m and rad."""

_KIB_PER_MIB = 1024.0

SAMPLED_QUANTITIES: Mapping[str, tuple[str, float, float]] = {
    "rss": ("MiB", 1.0, 6.0),
    "pss": ("MiB", 1.0, 6.0),
    "descriptors": ("", 0.5, 0.0),
    "threads": ("", 0.5, 0.0),
}
"""Sampled quantities of a process: unit, allowed growth over the flight, and more an hour.

A recorder keeps the index of its bag in memory: about 1 MiB an hour."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Trend:
    """Trend of one quantity of one process after the warm-up.

    Attributes
    ----------
    process, quantity
        Names of the process and of the quantity.
    first, last
        Medians of the first and of the last tenth of the samples.
    growth
        Growth by the robust slope.
    allowed
        Growth up to which the trend is flat.
    """

    process: str
    quantity: str
    first: float
    last: float
    growth: float
    allowed: float

    @property
    def flat(self) -> bool:
        """Whether neither the slope nor a late step, which a median overlooks, shows growth."""
        return max(self.growth, self.last - self.first) <= self.allowed


def robust_slope(times: Floats, values: Floats) -> float:
    """Return the median of the slopes of all pairs of samples (Theil 1950, Sen 1968).

    A third of the samples may be outliers.

    Parameters
    ----------
    times
        (n,) increasing, s.
    values
        (n,) samples.
    """
    step = max(1, -(-len(times) // _MAX_SLOPE_SAMPLES))
    t, x = times[::step], values[::step]
    if len(t) < 2:
        return 0.0
    i, j = np.triu_indices(len(t), k=1)
    return float(np.median((x[j] - x[i]) / (t[j] - t[i])))


def trend_of(process: str, quantity: str, times: Floats, values: Floats) -> Trend:
    """Return the trend of the samples (n,) of one quantity at times (n,), s, after the warm-up."""
    is_warm = times >= times[0] + _WARM_UP_SHARE * (times[-1] - times[0])
    t, x = times[is_warm], values[is_warm]
    tenth = max(1, len(t) // 10)
    duration = float(t[-1] - t[0])
    _, allowed_growth, hourly_growth = SAMPLED_QUANTITIES[quantity]
    return Trend(
        process,
        quantity,
        first=float(np.median(x[:tenth])),
        last=float(np.median(x[-tenth:])),
        growth=robust_slope(t, x) * duration,
        allowed=allowed_growth + hourly_growth * duration / 3600,
    )


def soak_benchmark(
    duration: float, show: Callable[[str], None], picture: Path | None = None
) -> dict[str, Any]:
    """Fly for ``duration`` wall s with a goal every 12 s; show a table and return all samples.

    The key ``flat`` is the verdict; ``samples`` has times and values by process and quantity.

    Raises
    ------
    SpaceRobotError
        A node has ended by itself, the flight was interrupted, or the system has no ``/proc``.
    """
    if not Path("/proc/self/smaps_rollup").exists():
        raise SpaceRobotError("Memory is sampled from /proc, which this system does not have.")
    scenario = (
        load_scenario("sliding_masses")
        .in_real_time(1.0)
        .with_overrides(
            "planner",
            {
                "method": "lie_bracket",
                "lie_bracket.t1": 3.0,
                "lie_bracket.cycle_period": 1.0,
                "lie_bracket.cycles": 0,
                "attitude_tolerance": 1e-2,
                "position_tolerance": 1e-2,
            },
        )
    )
    with stack_in_processes(scenario) as (stack, _, stopped):
        stack.start(None)
        times, samples, goals = _fly_and_sample(stack, duration, stopped)
        finish(stack, stopped)
    trends = [
        trend_of(process, quantity, times, samples[process][quantity])
        for process in samples
        for quantity in SAMPLED_QUANTITIES
    ]
    for line in _trend_lines(trends, goals, float(times[-1])):
        show(line)
    if picture is not None:
        _draw_samples(picture, times, samples)
    return {
        "duration_s": float(times[-1]),
        "goals": goals,
        "flat": all(trend.flat for trend in trends),
        "trends": [{**vars(trend), "flat": trend.flat} for trend in trends],
        "samples": {
            "time_s": times.tolist(),
            **{
                process: {quantity: values.tolist() for quantity, values in of.items()}
                for process, of in samples.items()
            },
        },
    }


def _fly_and_sample(
    stack: MultiProcessStack, duration: float, stopped: Callable[[], bool]
) -> tuple[Floats, dict[str, dict[str, Floats]], dict[str, int]]:
    """Return the times, the samples by process and quantity, and counts of the goals' results."""
    rng = random.Random(_GOAL_SEED)
    pids = {name: process.pid for name, process in stack.processes.items()}
    pids["supervisor"] = os.getpid()
    times: list[float] = []
    samples: dict[str, dict[str, list[float]]] = {
        name: {quantity: [] for quantity in SAMPLED_QUANTITIES} for name in pids
    }
    goals: dict[str, int] = {}
    began = time.monotonic()
    next_goal = next_sample = 0.0
    while (now := time.monotonic() - began) < duration and not stopped():
        stack.executor.spin_once(timeout_sec=0.1)
        stack.require_alive()
        if now >= next_sample:
            next_sample = now + _SAMPLE_PERIOD
            times.append(now)
            for name, pid in pids.items():
                for quantity, value in zip(SAMPLED_QUANTITIES, _sample_process(pid), strict=True):
                    samples[name][quantity].append(value)
        if now >= next_goal:
            next_goal += GOAL_PERIOD
            _count_result(stack, goals)
            stack.client.send(_random_goal(rng))
    _count_result(stack, goals)
    arrays = {
        name: {quantity: np.array(values) for quantity, values in of.items()}
        for name, of in samples.items()
    }
    return np.array(times), arrays, goals


def _random_goal(rng: random.Random) -> Goal:
    position = [rng.uniform(-_MAX_GOAL_DISTANCE, _MAX_GOAL_DISTANCE) for _ in range(3)]
    rotvec = [rng.uniform(-_MAX_GOAL_ROTATION, _MAX_GOAL_ROTATION) for _ in range(3)]
    return Goal.checked(position, quaternion_from_rotvec(np.array(rotvec)))


def _count_result(stack: MultiProcessStack, goals: dict[str, int]) -> None:
    """Count the result of the goal that was sent last."""
    status = stack.client.status
    if status is not None and status.state is not PlannerState.IDLE:
        goals[status.state.value] = goals.get(status.state.value, 0) + 1


def _sample_process(pid: int) -> Iterator[float]:
    """Yield the quantities of a process in their order."""
    status = process_facts(pid)
    yield int(status["VmRSS"].split()[0]) / _KIB_PER_MIB
    yield int(process_facts(pid, "smaps_rollup")["Pss"].split()[0]) / _KIB_PER_MIB
    yield len(os.listdir(f"/proc/{pid}/fd"))
    yield int(status["Threads"])


def _trend_lines(
    trends: Sequence[Trend], goals: Mapping[str, int], duration: float
) -> Iterator[str]:
    """Yield the trends as lines for the user."""
    results = ", ".join(f"{count} {state}" for state, count in sorted(goals.items()))
    yield f"{duration:.0f} s in separate processes, a goal every {GOAL_PERIOD:g} s: {results}"
    yield f"{'process':<22}{'':<13}{'first':>9}{'last':>9}{'growth':>9}{'allowed':>9}"
    for trend in trends:
        unit = SAMPLED_QUANTITIES[trend.quantity][0]
        yield (
            f"{trend.process:<22}{trend.quantity:<13}{trend.first:>9.2f}{trend.last:>9.2f}"
            f"{trend.growth:>9.2f}{trend.allowed:>9.2f} {unit:<4}{'' if trend.flat else 'GROWS'}"
        )
    growing = [trend for trend in trends if not trend.flat]
    yield f"{len(growing)} of {len(trends)} grow." if growing else "All are flat."


def _draw_samples(file: Path, times: Floats, samples: Mapping[str, Mapping[str, Floats]]) -> None:
    """Draw the samples, one panel for each quantity."""
    from matplotlib.figure import Figure  # It takes half a second to import.

    figure = Figure(figsize=(9, 9), layout="constrained")
    for axes, (quantity, (unit, _, _)) in zip(
        figure.subplots(len(SAMPLED_QUANTITIES), sharex=True),
        SAMPLED_QUANTITIES.items(),
        strict=True,
    ):
        for process, of in samples.items():
            axes.plot(times / 60, of[quantity], label=process, linewidth=1)
        axes.set_ylabel(f"{quantity} [{unit}]" if unit else quantity)
        axes.set_ylim(bottom=0)
        axes.grid(alpha=0.3)
    axes.set_xlabel("wall time [min]")
    figure.axes[0].legend(loc="lower right", ncols=4, fontsize="small")
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=120)
