"""Measurements that run with the package of any checkout, in a process of their own.

``python measurements.py FUNCTION ARGUMENTS FILE`` calls a function of :data:`MEASUREMENTS` with
keyword arguments (JSON), and writes its result to FILE as JSON. PYTHONPATH chooses the checkout.
So functions here import only names that both checkouts have, and nothing of this folder.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import resource
import runpy
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_rotvec
from spacerobot_ros.planning import Goal, PlanRequest, RobotState, Tolerance

_PLAN_CONTROL_PERIOD = 0.05
"""Control period of the plans, s."""

_MIN_GOAL_ANGLE = 0.05
"""Smallest rotation of a goal, rad."""

_START_SCATTER = 0.3
"""Largest difference of a start's joint position from the case's, m or rad."""

# -- flights ----------------------------------------------------------------------------------

_SUBTRACTED_FLIGHT_TIME = 5.0
"""Simulated time of a short flight, which is subtracted from a long one, s."""

_SLIDING_PERIOD, _TIME_BEFORE_CYCLES, _CYCLE_PERIOD = 0.05, 100.0, 3.0
"""Of sliding_masses with ``lie_bracket``: control period, time before the cycles, one cycle, s."""

_CONTROLLED_FLIGHT = ["coordinated_control", "--set=coordinated_control.settle_time=55"]
"""Words of a flight under control that lasts longer than the first look at it takes."""

_SERVICER_FLIGHT = ["servicer"]
"""Words of a flight with a six-joint arm, thrusters and an end-effector under control."""

_MIN_CYCLES = 170
"""Least number of cycles; with fewer, the loops are too large for the rotation of the goal."""

_PLANNED_SCENARIOS: tuple[tuple[str, str, dict[str, Any]], ...] = (
    ("sliding_masses", "lie_bracket", {}),
    ("arm_attitude", "area_loop", {}),
    ("planar_chain", "square_path", {}),
    ("planar_chain", "optimal", {"cache": 0}),
)
"""Scenarios, methods and options of the plans."""

_PLANS_PER_MEDIAN = 15
_IMPORTS_PER_MEDIAN = 5
_FLIGHTS_PER_MEDIAN = 3
"""Number of flights without ROS of which medians are taken."""


def gait_cycles_for(duration: float) -> int:
    """Return the cycles of ``lie_bracket`` with which sliding_masses moves for a time, s."""
    return max(_MIN_CYCLES, math.ceil((duration - _TIME_BEFORE_CYCLES) / _CYCLE_PERIOD) + 1)


def tick_times(ticks: int) -> dict[str, float]:
    """Return CPU times of flights and plans; only public functions and commands are used.

    A tick's time is the difference of a long and a short flight over the difference of their
    ticks, so that start, planning and end do not count.

    Parameters
    ----------
    ticks
        Number of ticks of the long flights of sliding_masses.

    Returns
    -------
    In us a tick: ``stack_us`` (plant, planner and recorder as nodes), ``controlled_stack_us``
    (with coordinated control), ``servicer_stack_us`` (of the six-joint servicer), ``loop_us`` and
    ``controlled_loop_us`` (without ROS); in ms a plan: ``plan_METHOD_ms``; in ms:
    ``import_plant_ms`` (the plant's node in a new process).
    """
    package = _imported_package()
    cycles = gait_cycles_for(ticks * _SLIDING_PERIOD)
    gait = {"planner.lie_bracket.cycles": cycles}
    words = ["sliding_masses", "--method", "lie_bracket"]
    words += [f"--set={name}={value}" for name, value in gait.items()]
    figures = {
        "stack_us": _stack_tick_time(words, ticks * _SLIDING_PERIOD),
        "controlled_stack_us": _stack_tick_time(_CONTROLLED_FLIGHT, math.inf),
        "servicer_stack_us": _stack_tick_time(_SERVICER_FLIGHT, math.inf),
        "import_plant_ms": 1e3 * import_time("spacerobot_ros.nodes.plant.node"),
    }
    scenario = "sliding_masses"
    planning = _cpu_time(lambda: package.plan(scenario, method="lie_bracket", cycles=cycles))
    figures["loop_us"] = _lockstep_tick_time(
        planning, scenario, method="lie_bracket", parameters=gait
    )
    figures["controlled_loop_us"] = _lockstep_tick_time(0.0, "coordinated_control")
    for scenario, method, options in _PLANNED_SCENARIOS:
        plan = partial(package.plan, scenario, method=method, **options)
        figures[f"plan_{method}_ms"] = 1e3 * _cpu_time(plan)
    return figures


_OPEN_LOOP_CAMPAIGN = """
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

_SMALL_SHARE = 10
"""How many times smaller the campaign is that is subtracted from a larger one."""


def campaign_times(flights: int) -> dict[str, float]:
    """Return CPU times of a campaign in open loop, in this process; only the command is used.

    Parameters
    ----------
    flights
        Number of flights of the campaign.

    Returns
    -------
    ``campaign_s`` with its report, s; ``campaign_flight_ms``, ms a flight: the difference of this
    campaign and one of a tenth of the flights, so that plan and report do not count.
    """
    few = max(1, flights // _SMALL_SHARE)
    # The first campaign imports modules and compiles functions.
    _fly_campaign(few)
    short, whole = _fly_campaign(few), _fly_campaign(flights)
    each = 1e3 * (whole - short) / (flights - few)
    return {"campaign_s": whole, "campaign_flight_ms": each}


def _fly_campaign(flights: int) -> float:
    """Return the CPU time of a campaign with its report, s."""
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        file = Path(folder, "open_loop.yaml")
        file.write_text(_OPEN_LOOP_CAMPAIGN.format(flights=flights), "utf-8")
        words = ["campaign", "fly", str(file), "--workers", "0", "--out", str(Path(folder, "out"))]
        return _run_command(words)


_FLOWN_ROWS = 500
"""Number of flights whose rows are repeated in the dataset of a large report."""


def report_figures(rows: int) -> dict[str, float]:
    """Return figures of the report of a dataset of many rows, made of the rows of few flights.

    Returns
    -------
    ``rows`` of the dataset; ``report_peak_MB``, the largest memory of the process that makes the
    report, MB; ``report_cpu_s``, its CPU time, s.
    """
    arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        file, out = Path(folder, "open_loop.yaml"), Path(folder, "out")
        count = min(rows, _FLOWN_ROWS)
        file.write_text(_OPEN_LOOP_CAMPAIGN.format(flights=count), "utf-8")
        _run_command(["campaign", "fly", str(file), "--workers", "0", "--out", str(out)])
        parts = sorted((out / "flights").glob("*.parquet"))
        table = arrow.concat_tables([parquet.read_table(part) for part in parts])
        for part in parts:
            part.unlink()
        numbers, place = np.array(table["flight"]), table.column_names.index("flight")
        copies = -(-rows // count)
        for copy in range(copies):
            column = arrow.array(numbers + copy * count, type=table.schema.field("flight").type)
            made = table.set_column(place, "flight", column)
            parquet.write_table(made, out / "flights" / f"part-{copy:06d}.parquet")
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        words = [sys.executable, "-m", "spacerobot_ros", "campaign", "report", str(out)]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return {
        "rows": float(copies * count),
        "report_peak_MB": after.ru_maxrss * 1024 / 1e6,
        "report_cpu_s": after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime,
    }


def _stack_tick_time(words: list[str], longest: float) -> float:
    """Return the CPU time of a tick of ``spacerobot run`` in this process, us."""
    # The first flight imports modules and compiles functions.
    _fly_by_command(words, _SUBTRACTED_FLIGHT_TIME)
    short_time, short_ticks = _fly_by_command(words, _SUBTRACTED_FLIGHT_TIME)
    long_time, long_ticks = _fly_by_command(words, longest)
    return 1e6 * (long_time - short_time) / (long_ticks - short_ticks)


def _fly_by_command(words: list[str], longest: float) -> tuple[float, int]:
    """Run a flight by command; return its CPU time, s, and its number of ticks."""
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        result = Path(folder, "result.json")
        if math.isfinite(longest):
            words = [*words, "--longest", str(longest)]
        bag = str(Path(folder, "flight.mcap"))
        used = _run_command(["run", *words, "--bag", bag, "--json", str(result)])
        return used, json.loads(result.read_text("utf-8"))["ticks"]


def _run_command(words: list[str]) -> float:
    """Run a command of ``spacerobot`` in this process; return its CPU time, s."""
    sys.argv = ["spacerobot", *words]
    began = time.process_time()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
        runpy.run_module("spacerobot_ros", run_name="__main__")
    return time.process_time() - began


_IMPORT_PROGRAM = (
    "import time; began = time.process_time(); import {module}; print(time.process_time() - began)"
)


def import_time(module: str) -> float:
    """Return the CPU time of the import of a module from byte code in a new process, s: a median.

    The byte code is written by a process before, also where PYTHONDONTWRITEBYTECODE is set.
    """
    words = [sys.executable, "-c", _IMPORT_PROGRAM.format(module=module)]
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        variables = {**os.environ, "PYTHONPYCACHEPREFIX": folder, "PYTHONDONTWRITEBYTECODE": ""}
        times = [
            float(subprocess.check_output(words, env=variables))
            for _ in range(1 + _IMPORTS_PER_MEDIAN)
        ]
    return statistics.median(times[1:])


def _imported_package() -> Any:
    """Return the package, imported as in a user's program."""
    return import_module("spacerobot_ros")


def _lockstep_tick_time(planning: float, scenario: str, **arguments: Any) -> float:
    """Return the CPU time of a tick of a flight without ROS, us; ``planning`` s are subtracted."""
    fly = _imported_package().fly
    ticks = len(fly(scenario, **arguments).time) - 1
    flying = _cpu_time(lambda: fly(scenario, **arguments), _FLIGHTS_PER_MEDIAN)
    return 1e6 * (flying - planning) / ticks


def _cpu_time(run: Callable[[], object], count: int = _PLANS_PER_MEDIAN) -> float:
    """Return the median CPU time of a call after the first one, s."""
    times = []
    for _ in range(1 + count):
        began = time.process_time()
        run()
        times.append(time.process_time() - began)
    return statistics.median(times[1:])


# -- plans of `optimal` -----------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A robot's start, options, and kind of goals.

    Attributes
    ----------
    start
        Joint positions, m or rad, near which the plans start.
    options
        Options of the method.
    angle
        Largest rotation of a goal, rad.
    planar
        Whether goals are rotated about the third axis only.
    sliding
        Whether the position of a goal counts as well.
    """

    start: tuple[float, ...]
    options: dict[str, Any]
    angle: float = 1.0
    planar: bool = False
    sliding: bool = False


CASES = {
    "planar_chain": Case((0.0, 0.0), {}, angle=3.0, planar=True),
    "sliding_masses": Case(
        (0.0, 0.0, 0.0),
        {"max_velocity": (0.0647, 0.1871, 0.6550), "max_acceleration": (0.228, 0.643, 3.564)},
        sliding=True,
    ),
    "three_joint_arm": Case((0.0, -math.pi / 4, math.pi / 2), {}),
    "servicer": Case((0.0, -1.2, 2.0, 0.0, 0.8, 0.0), {}),
}
"""Cases by the names of their robots."""


def requests(robot: SpaceRobot, case: Case, count: int, seed: int) -> Iterator[PlanRequest]:
    """Yield random plan requests of a case; the same seed gives the same ones."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        scattered = np.array(case.start) + rng.uniform(-_START_SCATTER, _START_SCATTER, robot.n)
        q = np.clip(scattered, robot.lower, robot.upper)
        axis = rng.normal(size=3)
        if case.planar:
            axis = np.array([0.0, 0.0, axis[2]])
        angle = rng.uniform(_MIN_GOAL_ANGLE, case.angle)
        turn = quaternion_from_rotvec(axis / np.linalg.norm(axis) * angle)
        position = np.zeros(3)
        if case.sliding:
            last = np.clip(q + rng.uniform(-1.0, 1.0, robot.n), robot.lower, robot.upper)
            there = matrix_from_quaternion(turn) @ robot.center_of_mass(last)
            position = robot.center_of_mass(q) - there
        state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
        yield PlanRequest(state, Goal.checked(position, turn), Tolerance(2e-3, 2e-3))


def plans(
    urdf: str, case: str, count: int, seed: int, options: dict[str, Any]
) -> dict[str, list[float]]:
    """Return the CPU time (s) and the duration (s; NaN: refused) of each plan of a case.

    Functions that are built for the first goal do not count.
    """
    from spacerobot_ros.planning.methods.optimal.method import OptimalGait
    from spacerobot_ros.planning.methods.optimal.problem import OptimalOptions

    robot, chosen_case = SpaceRobot.from_file(urdf), CASES[case]
    chosen = {**chosen_case.options, **options, "cache": 0}
    if OptimalOptions().time_budget > 0:
        # Plans of older versions depend on the machine's speed: assume a fast machine.
        chosen["time_budget"] = 1e6
    method = OptimalGait(robot, _PLAN_CONTROL_PERIOD, options=OptimalOptions(**chosen))
    goals = list(requests(robot, chosen_case, count + 1, seed))
    times: list[float] = []
    durations: list[float] = []
    for request in goals:
        began = time.process_time()
        try:
            duration = method.plan(request).duration
        except PlanningError:
            duration = math.nan
        times.append(time.process_time() - began)
        durations.append(duration)
    return {"cpu_s": times[1:], "duration_s": durations[1:]}


_TOO_SHORT = 0.5
"""Share of a plan's duration within which its goal is asked for, and refused."""

_TOO_FAR = 2.0
"""Distance by which goals are moved out of reach, m."""


def refusals(urdf: str, case: str, count: int, seed: int) -> dict[str, list[Any]]:
    """Plan for goals that cannot be reached, and return the CPU time and message of each refusal.

    Goals of a case are to be reached within half of their plan's time, then in that time exactly,
    and then moved out of reach.

    Returns
    -------
    Of each goal: ``cpu_s``, CPU time of the plan, s; ``sign_s``, CPU time to the first line about
    the search, or to the end of the plan; ``reason``, the message; empty: the goal was not refused.
    """
    from spacerobot_ros.planning.core.progress import report_progress
    from spacerobot_ros.planning.methods.optimal.method import OptimalGait
    from spacerobot_ros.planning.methods.optimal.problem import OptimalOptions

    robot, chosen = SpaceRobot.from_file(urdf), CASES[case]
    found: dict[str, list[Any]] = {"cpu_s": [], "sign_s": [], "reason": []}

    def gait(**options: float) -> Any:
        given = OptimalOptions(**{**chosen.options, **options, "cache": 0})
        return OptimalGait(robot, _PLAN_CONTROL_PERIOD, options=given)

    def refuse(method: Any, request: PlanRequest) -> None:
        signs, reason, began = list[float](), "", time.process_time()
        with report_progress(lambda _: signs.append(time.process_time() - began)):
            try:
                method.plan(request)
            except PlanningError as error:
                reason = str(error)
        used = time.process_time() - began
        values = {"cpu_s": used, "sign_s": min([*signs, used]), "reason": reason}
        for name, value in values.items():
            found[name].append(value)

    for request in requests(robot, chosen, count, seed):
        method = gait()
        duration = method.plan(request).duration
        refuse(gait(longest=_TOO_SHORT * duration), request)
        refuse(gait(duration=_TOO_SHORT * duration), request)
        position = request.goal.position + np.array([_TOO_FAR, 0.0, 0.0])
        moved = Goal.checked(position, request.goal.quaternion)
        refuse(method, PlanRequest(request.state, moved, request.tolerance))
    return found


_FIRST_GOAL_ROTVEC = (0.1, -0.15, 0.2)
"""Rotation vector of the goal of a first plan, rad."""


def first_plan(urdf: str) -> dict[str, float]:
    """Return figures of the first plan in this process.

    Returns
    -------
    The number of ``joints``; the CPU time of this process and of its compilers until the plan is
    there, ``cpu_s``; that of the same plan again, ``plan_cpu_s``.
    """
    from spacerobot_ros.planning.methods.optimal.method import OptimalGait
    from spacerobot_ros.planning.methods.optimal.problem import OptimalOptions

    robot = SpaceRobot.from_file(urdf)
    method = OptimalGait(robot, _PLAN_CONTROL_PERIOD, options=OptimalOptions(cache=0))
    q = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
    goal = Goal.checked(np.zeros(3), quaternion_from_rotvec(_FIRST_GOAL_ROTVEC))
    request = PlanRequest(state, goal, Tolerance(2e-3, 2e-3))
    method.plan(request)
    used = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    total = sum(each.ru_utime + each.ru_stime for each in used)
    began = time.process_time()
    method.plan(request)
    return {"joints": robot.n, "cpu_s": total, "plan_cpu_s": time.process_time() - began}


MEASUREMENTS = {
    "tick_times": tick_times,
    "campaign_times": campaign_times,
    "report_figures": report_figures,
    "plans": plans,
    "refusals": refusals,
    "first_plan": first_plan,
}

if __name__ == "__main__":
    _, name_of, arguments, file_of = sys.argv
    result: Any = MEASUREMENTS[name_of](**json.loads(arguments))  # type: ignore[operator]
    Path(file_of).write_text(json.dumps(result), encoding="utf-8")
