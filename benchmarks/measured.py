"""Measurements of the package of any checkout, in a process of their own.

``PYTHONPATH=CHECKOUT python measured.py`` reads lines ``["NAME", {arguments}]`` of JSON, and
answers each with the processor time that was asked for, in s, or with the text of an error. So
functions here use commands and public functions alone, which other versions have as well.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

_CAMPAIGN = """
campaign:
  scenario: sliding_masses
  method: optimal
  flights: {flights}
  seed: 1
  engine: lanes
  set: {{planner.max_corrections: 0}}
  disperse:
    mass.*: {{uniform: {{loc: 0.95, scale: 0.1}}}}
  criteria:
    position_error_m: {{max: 0.02}}
"""

_FIRST_PLAN = """
import json, sys
from spacerobot_ros import plan
asked = json.loads(sys.argv[1])
plan(asked.pop("robot"), **asked)
"""

_memory: dict[str, Any] = {}
"""What the first call of a measurement leaves for the next ones."""


def of_process(call: Callable[[], object]) -> float:
    """Return the processor time of a call in this process."""
    began = time.process_time()
    call()
    return time.process_time() - began


def of_children(words: list[str], cache: str | None = None) -> float:
    """Return the processor time of Python with some arguments, and of what it starts."""
    variables = {} if cache is None else {"SPACEROBOT_CACHE_DIR": cache}
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, *words], env=os.environ | variables, capture_output=True, check=False
    )
    if done.returncode not in (0, 1):  # 1: a flight did not reach its goal.
        raise RuntimeError(done.stderr.decode()[-500:])
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def tick(scenario: str, parameters: dict[str, Any]) -> float:
    """Fly without ROS, and return the time of a tick, plan and report among it."""
    from spacerobot_ros import fly

    ticks = 0

    def run() -> None:
        nonlocal ticks
        ticks = len(fly(scenario, parameters=parameters).time) - 1

    return of_process(run) / ticks


def run(scenario: str) -> float:
    """Return the time of ``spacerobot run`` with its bag, imports and plan among it."""
    with tempfile.TemporaryDirectory() as folder:
        return of_children(["-m", "spacerobot_ros", "run", scenario, "--bag", f"{folder}/a.mcap"])


def first_plan(**asked: Any) -> float:
    """Return the time of a process with an empty cache until its first plan."""
    with tempfile.TemporaryDirectory() as cache:
        return of_children(["-c", _FIRST_PLAN, json.dumps(asked)], cache)


def next_plan(robot: str, **asked: Any) -> float:
    """Return the time of a plan in a process that has planned before."""
    from spacerobot_ros import plan

    return of_process(lambda: plan(robot, **asked))


def campaign(flights: int) -> float:
    """Return the time of a campaign in open loop, from command to report."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder, "open_loop.yaml")
        file.write_text(_CAMPAIGN.format(flights=flights), "utf-8")
        words = ["campaign", "fly", str(file), "--workers", "0", "--out", f"{folder}/out"]
        return of_children(["-m", "spacerobot_ros", *words])


def read(scenario: str) -> float:
    """Return the time in which a bag becomes arrays; this checkout flies it at the first call."""
    from spacerobot_ros import read_bag

    if scenario not in _memory:
        _memory[scenario] = tempfile.TemporaryDirectory()
        path = f"{_memory[scenario].name}/a.mcap"
        of_children(["-m", "spacerobot_ros", "run", scenario, "--bag", path])

    def run() -> None:
        bag = read_bag(f"{_memory[scenario].name}/a.mcap")
        for topic in bag:
            bag[topic]

    return of_process(run)


def steps(environments: str) -> float:
    """Return the time of a step of one of N environments ("N NAME"), restarts among it."""
    import gymnasium
    import numpy as np

    import spacerobot_ros.environments  # noqa: F401 - registers the environments

    count, name = environments.split()
    if environments not in _memory:
        settings = {"autoreset_mode": "SameStep", "hold": 5, "time_limit": 5.0}
        _memory[environments] = gymnasium.make_vec(f"spacerobot/{name}", int(count), **settings)
        _memory[environments].reset(seed=1)
    vector, rng, number = _memory[environments], np.random.default_rng(2), 40
    shape = (number, *vector.action_space.shape)
    actions = rng.uniform(-1.0, 1.0, shape)

    def run() -> None:
        for each in actions:
            vector.step(each)

    return of_process(run) / (number * int(count))


_MEASUREMENTS = (tick, run, first_plan, next_plan, campaign, read, steps)

if __name__ == "__main__":
    by_name = {each.__name__: each for each in _MEASUREMENTS}
    answers = sys.stdout
    for line in sys.stdin:
        name, arguments = json.loads(line)
        answer: float | str
        try:
            with contextlib.redirect_stdout(sys.stderr):
                answer = by_name[name](**arguments)
        except Exception as error:
            answer = repr(error)
        print(json.dumps(answer), file=answers, flush=True)
