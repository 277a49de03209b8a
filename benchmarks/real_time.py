"""Separate processes on the wall clock: their deadlines, and what they hold after half an hour.

``python benchmarks/real_time.py deadlines SECONDS RATE ...`` flies at each rate and prints how many
ticks and commands were late or lost; ``... soak SECONDS FOLDER`` sends goals and prints the trends
of memory, descriptors and threads. Exit code 1: one of them grows.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import numpy.typing as npt
import psutil
from matplotlib.figure import Figure
from scipy.stats import theilslopes

from spacerobot_ros.bag import Bag, read_bag

Floats = npt.NDArray[np.float64]

_COMMAND = [sys.executable, "-m", "spacerobot_ros"]
_GOAL = ["--goal", *map(str, (0.2, -0.15, 0.05, 0, 0, 0, 1))]

_MIN_CYCLES, _TIME_BEFORE_CYCLES, _CYCLE_PERIOD = 170, 100.0, 3.0
"""Of ``lie_bracket``: fewest cycles to the goal, and the times before them and of each, s."""

_LARGEST_GOAL, _GOAL_PERIOD, _SAMPLE_PERIOD = 0.05, 12.0, 2.0
"""Coordinates of goals, m; wall time between goals and between samples, s."""

_WARM_UP_SHARE = 0.25
"""Share of a flight that is not evaluated, while buffers fill and first plans are made."""

QUANTITIES = {
    **dict.fromkeys(("rss_MiB", "pss_MiB"), (1.0, 6.0)),
    **dict.fromkeys(("files", "threads"), (0.5, 0.0)),
}
"""Growth of a process that is allowed over the flight, and more an hour: the recorder keeps the
index of its bag."""


def settings(**values: object) -> list[str]:
    """Return parameters as words of a command; a name has two underscores for a dot."""
    return [f"--set={name.replace('__', '.')}={value}" for name, value in values.items()]


# -- deadlines --------------------------------------------------------------------------------


def fly_at_rate(rate: float, seconds: float) -> None:
    """Fly sliding masses in real time, and print what the plant counts of its deadlines."""
    cycles = max(_MIN_CYCLES, math.ceil((seconds - _TIME_BEFORE_CYCLES) / _CYCLE_PERIOD) + 1)
    words = ["run", "sliding_masses", "--method=lie_bracket", "--realtime", "--processes", *_GOAL]
    words += settings(
        plant__tick_rate=rate, plant__diagnostics_period=1.0, planner__lie_bracket__cycles=cycles
    )
    delays: list[float] = []
    idle = Thread(target=_wait_for_ticks, args=(1.0 / rate, seconds, delays), daemon=True)
    with tempfile.TemporaryDirectory() as folder:
        bag = f"{folder}/flight.mcap"
        idle.start()
        words += [f"--longest={seconds}", "--bag", bag]
        done = subprocess.run([*_COMMAND, *words], check=False)
        if done.returncode not in (0, 1):
            sys.exit(done.returncode)
        _print_deadlines(rate, read_bag(bag))
    late, worst = sum(delay > 0 for delay in delays), 1e3 * max([0.0, *delays])
    print(f"  an idle thread beside it: {late} late, by {worst:.1f} ms at most")


def _print_deadlines(rate: float, bag: Bag) -> None:
    values: dict[str, str] = {}
    for _, array in bag["/diagnostics"].messages():
        for status in array.status:
            found = {each.key: each.value for each in status.values}
            if status.name.endswith(": timing") or "deadlines_missed" in found:
                values |= found
    ticks, skipped = int(values["ticks"]), int(values.get("deadlines_missed", 0))
    late, missing = int(values["commands_late"]), max(ticks - 1 - int(values["commands"]), 0)
    missed = int(values["ticks_late"]) + skipped + late + missing
    worst = max(float(values["worst_tick_ms"]), float(values["worst_command_ms"]))
    # Every tick publishes each state once, and the first one comes before the first tick.
    stamps = bag["/joint_states"].stamp
    states = round((stamps[-1] - stamps[0]) * rate) + 1
    topics = ("/clock", "/odom", "/joint_states", "/momentum")
    lost = max(states - bag.message_count(topic) for topic in topics)
    share = 100 * missed / (2 * ticks)
    print(
        f"{rate:g} commands a second for {np.ptp(stamps):.0f} s: {share:.3f} % of the deadlines "
        f"missed, by {worst:.1f} ms at most; {lost} states lost in the bag\n"
        f"  ticks late {values['ticks_late']}, skipped {skipped}; commands late {late}, missing "
        f"{missing}, of {ticks} each"
    )


def _wait_for_ticks(period: float, seconds: float, delays: list[float]) -> None:
    """Wait for the same ticks, and add how late each was beyond a period, s."""
    began = time.perf_counter()
    for tick in range(1, round(seconds / period)):
        time.sleep(max(began + tick * period - time.perf_counter(), 0.0))
        delays.append(time.perf_counter() - began - (tick + 1) * period)


# -- what processes hold ----------------------------------------------------------------------


def soak(seconds: float, folder: Path) -> bool:
    """Fly with a goal every 12 s; print the trends, and return whether all are flat."""
    folder.mkdir(parents=True, exist_ok=True)
    words = ["up", "sliding_masses", "--processes", "--bag", f"{folder}/soak.mcap"]
    words += settings(
        planner__method="lie_bracket",
        planner__lie_bracket__t1=3.0,
        planner__lie_bracket__cycle_period=1.0,
        planner__lie_bracket__cycles=0,
        planner__attitude_tolerance=1e-2,
        planner__position_tolerance=1e-2,
    )
    (folder / "soak.mcap").unlink(missing_ok=True)
    samples: dict[str, list[list[float]]] = {}
    stack = subprocess.Popen([*_COMMAND, *words])
    try:
        with _goal_sender() as send:
            began, due = time.monotonic(), _GOAL_PERIOD
            while (now := time.monotonic() - began) < seconds:
                if stack.poll() is not None:
                    sys.exit(f"The stack has ended with exit code {stack.returncode}.")
                if now >= due:
                    due += _GOAL_PERIOD
                    send()
                _sample(psutil.Process(stack.pid), now, samples)
                time.sleep(_SAMPLE_PERIOD)
    finally:
        stack.send_signal(signal.SIGINT)
        stack.wait(60.0)
    by_process = {name: np.array(rows) for name, rows in samples.items() if len(rows) > 1}
    (folder / "soak.json").write_text(json.dumps(samples), "utf-8")
    _draw(by_process, folder / "soak.png")
    return _print_trends(by_process)


@contextmanager
def _goal_sender() -> Iterator[Any]:
    os.environ.setdefault("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    import rclpy
    from geometry_msgs.msg import PoseStamped

    rclpy.init()
    node, rng = rclpy.create_node("soak"), random.Random(13)
    topic = node.create_publisher(PoseStamped, "goal_pose", 10)

    def send() -> None:
        message = PoseStamped()
        p = message.pose.position
        p.x, p.y, p.z = (rng.uniform(-_LARGEST_GOAL, _LARGEST_GOAL) for _ in range(3))
        topic.publish(message)

    try:
        yield send
    finally:
        node.destroy_node()
        rclpy.shutdown()


def _sample(stack: psutil.Process, now: float, samples: dict[str, list[list[float]]]) -> None:
    """Add a row of time and quantities for each process of the stack."""
    for process in [stack, *stack.children(recursive=True)]:
        words = process.cmdline()
        name = next((x.split(".")[2] for x in words if ".nodes." in x), "supervisor")
        memory = process.memory_full_info()
        held = [memory.rss / 2**20, memory.pss / 2**20, process.num_fds(), process.num_threads()]
        samples.setdefault(f"{name} {process.pid}", []).append([now, *held])


def _print_trends(by_process: dict[str, Floats]) -> bool:
    print(f"{'process':<28}{'':<10}{'first':>9}{'last':>9}{'growth':>9}{'allowed':>9}")
    all_flat = True
    for name, rows in by_process.items():
        warm = rows[rows[:, 0] >= _WARM_UP_SHARE * rows[-1, 0]]
        t, tenth = warm[:, 0], max(1, len(warm) // 10)
        for (quantity, (allowed, hourly)), x in zip(QUANTITIES.items(), warm[:, 1:].T, strict=True):
            # The median of the slopes of all pairs of samples overlooks outliers, and a late step.
            step = max(1, len(x) // 400)
            growth = theilslopes(x[::step], t[::step])[0] * np.ptp(t) if len(x) > 1 else 0.0
            first, last = np.median(x[:tenth]), np.median(x[-tenth:])
            most = allowed + hourly * np.ptp(t) / 3600
            flat = max(growth, last - first) <= most
            all_flat &= bool(flat)
            print(
                f"{name:<28}{quantity:<10}{first:>9.2f}{last:>9.2f}{growth:>9.2f}{most:>9.2f}"
                f"{'' if flat else ' GROWS'}"
            )
    return all_flat


def _draw(by_process: dict[str, Floats], file: Path) -> None:
    figure = Figure(figsize=(9, 9), layout="constrained")
    axes = figure.subplots(len(QUANTITIES), sharex=True)
    for number, (panel, quantity) in enumerate(zip(axes, QUANTITIES, strict=True), 1):
        for name, rows in by_process.items():
            panel.plot(rows[:, 0] / 60, rows[:, number], label=name, linewidth=1)
        panel.set(ylabel=quantity, ylim=(0, None))
        panel.grid(alpha=0.3)
    axes[0].legend(loc="lower right", ncols=4, fontsize="small")
    axes[-1].set_xlabel("wall time [min]")
    figure.savefig(file, dpi=120)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    deadlines = commands.add_parser("deadlines")
    deadlines.add_argument("seconds", type=float)
    deadlines.add_argument("rates", type=float, nargs="+")
    soaking = commands.add_parser("soak")
    soaking.add_argument("seconds", type=float)
    soaking.add_argument("folder", type=Path)
    chosen = parser.parse_args()
    if chosen.command == "soak":
        sys.exit(not soak(chosen.seconds, chosen.folder))
    for rate in chosen.rates:
        fly_at_rate(rate, chosen.seconds)
