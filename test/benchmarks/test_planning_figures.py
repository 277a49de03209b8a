"""Benchmarks of planning by stand-ins for the checkouts and the clock: figures and lines."""

from __future__ import annotations

import json
import logging
import math
import runpy
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from support.clocks import Clock, named

from spacerobot_ros.benchmarks import measurements, planning
from spacerobot_ros.campaign.config import parse_campaign
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_rotvec
from spacerobot_ros.planning.core.progress import SearchProgress, log_progress
from spacerobot_ros.planning.methods.optimal import method as optimal
from spacerobot_ros.planning.methods.optimal.problem import OptimalOptions
from spacerobot_ros.resources import robot_file

CASES = ("planar_chain", "sliding_masses", "three_joint_arm", "servicer")


class Checkout:
    """Plans in a time that its name and the arguments decide, and writes down what is asked."""

    def __init__(self, factor: float, longer: float = 0.0) -> None:
        self.factor, self.longer = factor, longer
        self.asked: list[tuple[str, dict[str, Any]]] = []

    def measure(self, name: str, **arguments: Any) -> Any:
        self.asked.append((name, arguments))
        if name == "refusals":
            cpu, sign = ([self.factor * x for x in each] for each in ((2, 9, 1), (0.2, 8, 0.4)))
            far = f"no nearer than {self.factor} m to it."
            reasons = [far, "", "far"] if arguments["case"] != "planar_chain" else [""] * 3
            return {"cpu_s": cpu, "sign_s": sign, "reason": reasons}
        if name == "first_plan":
            robot, process = divmod(len(self.asked) - 1, 5)
            return {
                "joints": 5 + robot,
                "cpu_s": self.factor * (99.0, 12.34, 1.5, 1.75, 1.0)[process],
                "plan_cpu_s": self.factor * 0.5,
            }
        each = self.factor
        longer = self.longer - (0.025 if arguments["options"] else 0.0)
        return {
            "cpu_s": [each * x for x in (0.1, 0.25, 7.0)],
            "duration_s": [d * (1 + longer) for d in (4.0, 5.0, 6.0)],
        }


def stand_in(monkeypatch: pytest.MonkeyPatch, ours: Checkout, theirs: Checkout | None) -> None:
    given: list[Path | None] = []

    def pair(other: Path | None) -> tuple[Checkout, Checkout | None]:
        given.append(other)
        return ours, None if other is None else theirs

    monkeypatch.setattr(planning, "Checkout", named(pair=pair))


def test_goals_are_counted_and_compared_with_everything(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = Checkout(1.0), Checkout(3.0, longer=-0.015)
    stand_in(monkeypatch, ours, theirs)
    lines: list[str] = []
    figures = planning.planning_benchmark(3, Path("there"), 17, lines.append)
    percent = "0 % at most 1 %, 100 % at most 2 %, 100 % at most 3 % longer; at most 1.015"
    assert lines[:4] == [
        "planar_chain: 0.250 s of CPU time in the median of 3 goals, the slowest 28.0 times as "
        "long",
        "... there 0.750 s: 3.00 times faster here",
        f"... durations beside those there: {percent}",
        "... durations beside those by a search from 17 guesses: 0 % at most 1 %, 0 % at most 2 %, "
        "100 % at most 3 % longer; at most 1.026",
    ]
    assert len(lines) == 16
    assert tuple(figures) == CASES
    for name, robot in figures.items():
        assert robot["median_cpu_s"] == 0.25
        assert robot["slowest_to_median"] == 28.0
        assert robot["times_faster"] == pytest.approx(3.0)
        assert robot["durations_to_there"]["worst"] == pytest.approx(1 / 0.985)
        assert robot["durations_to_long_search"]["best"] == pytest.approx(1 / 0.975)
        about = {"urdf": str(robot_file(name)), "case": name, "count": 3, "seed": 7}
        search = {"starts": 17, "answers": 17, "agreeing": 0}
        asked = [arguments for _, arguments in ours.asked if arguments["case"] == name]
        plain = about | {"options": {}}
        assert asked == [plain, about | {"options": search}]
        assert ("plans", plain) in theirs.asked


def test_goals_alone_are_one_line_a_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    stand_in(monkeypatch, Checkout(2.0), None)
    lines: list[str] = []
    figures = planning.planning_benchmark(3, None, None, lines.append)
    line = "0.500 s of CPU time in the median of 3 goals, the slowest 28.0 times as long"
    assert lines == [f"{name}: {line}" for name in CASES]
    names = {"median_cpu_s", "slowest_to_median", "cpu_s", "duration_s"}
    assert all(each.keys() == names for each in figures.values())


def test_first_plans_here_and_there(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = Checkout(1.0), Checkout(2.0)
    stand_in(monkeypatch, ours, theirs)
    lines: list[str] = []
    figures = planning.first_plan_benchmark(Path("there"), lines.append)
    assert list(figures) == ["seven_joint_arm", "quadruped", "dual_arm"]
    assert lines[:2] == [
        "seven_joint_arm, 5 joints: 12.3 s of CPU time from an empty cache to the first plan, "
        "1.50 s in the next process, 1.00 s more than the plan itself",
        "... there 24.7 s of CPU time from an empty cache to the first plan, "
        "3.00 s in the next process, 2.00 s more than the plan itself",
    ]
    # One process writes byte code, then one has an empty cache; of the others the median counts.
    assert figures["quadruped"] == {
        "joints": 6,
        "first_cpu_s": 12.34,
        "next_cpu_s": 1.5,
        "more_cpu_s": 1.0,
        "there": {"joints": 6, "first_cpu_s": 24.68, "next_cpu_s": 3.0, "more_cpu_s": 2.0},
    }
    caches = [arguments["cache"] for _, arguments in ours.asked]
    own = [caches.index(each) for each in caches]
    assert own == [0, 1, 1, 1, 1, 5, 6, 6, 6, 6, 10, 11, 11, 11, 11]
    of_modules = [arguments["byte_code"] for _, arguments in ours.asked]
    assert [of_modules.index(each) for each in of_modules] == [0] * 5 + [5] * 5 + [10] * 5
    assert not any(Path(each).exists() for each in [*caches, *of_modules])
    lines.clear()
    assert "there" not in planning.first_plan_benchmark(None, lines.append)["quadruped"]
    assert len(lines) == 3


def test_refusals_here_and_there(monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = Checkout(1.0), Checkout(3.0)
    stand_in(monkeypatch, ours, theirs)
    lines: list[str] = []
    figures = planning.refusals_benchmark(2, Path("there"), lines.append)
    assert tuple(figures) == CASES
    assert lines[:4] == [
        "planar_chain: none of 3 goals refused",
        "... there none of 3 goals refused",
        "sliding_masses: 2 of 3 goals refused, the slowest after 2.00 s of CPU time, a first line "
        "after 0.40 s at most, 1 with a bound",
        "... there 2 of 3 goals refused, the slowest after 6.00 s of CPU time, a first line after "
        "1.20 s at most, 1 with a bound",
    ]
    assert lines[4:6] == ["... no nearer than 1.0 m to it.", "... far"]
    assert len(lines) == 14
    assert figures["sliding_masses"]["there"]["bound"] == ["no nearer than 3.0 m", "", ""]
    about = {"urdf": str(robot_file("servicer")), "case": "servicer", "count": 2, "seed": 7}
    assert ours.asked[-1] == theirs.asked[-1] == ("refusals", about)
    assert figures["servicer"]["there"]["cpu_s"] == [6.0, 27.0, 3.0]
    lines.clear()
    assert "there" not in planning.refusals_benchmark(2, None, lines.append)["servicer"]
    assert len(lines) == 10


def test_goals_and_starts_are_within_their_bounds() -> None:
    for name, case in measurements.CASES.items():
        robot = SpaceRobot.from_file(robot_file(name))
        requests = list(measurements.requests(robot, case, 40, 11))
        turns = 2 * np.arccos([abs(each.goal.quaternion[3]) for each in requests])
        assert 0.05 <= turns.min() < turns.max() <= case.angle
        assert np.ptp(turns) > 0.7 * case.angle, "of all angles"
        axes = np.array([each.goal.quaternion[:3] for each in requests])
        assert np.all((np.abs(axes[:, :2]).max(axis=0) < 1e-12) == (name == "planar_chain"))
        starts = np.array([each.state.q for each in requests])
        inside = np.clip(np.array(case.start), robot.lower, robot.upper)
        assert 0.25 < np.abs(starts - inside).max() <= 0.3
        positions = np.array([each.goal.position for each in requests])
        if not case.sliding:
            np.testing.assert_array_equal(positions, 0.0)
        for each in requests:
            tolerance = each.tolerance
            assert (tolerance.attitude, tolerance.position) == (2e-3, 2e-3)
            np.testing.assert_array_equal(each.state.quaternion, [0, 0, 0, 1])
            np.testing.assert_array_equal(each.state.position, 0.0)
    assert measurements.CASES["servicer"].start == (0.0, -1.2, 2.0, 0.0, 0.8, 0.0)
    assert measurements.CASES["three_joint_arm"].start == (0.0, -math.pi / 4, math.pi / 2)
    assert [case.angle for case in measurements.CASES.values()] == [3.0, 1.0, 1.0, 1.0]


def test_positions_of_sliding_goals_can_be_reached() -> None:
    """The centre of mass stays: masses within their ranges put the base there."""
    robot = SpaceRobot.from_file(robot_file("sliding_masses"))
    for each in measurements.requests(robot, measurements.CASES["sliding_masses"], 20, 3):
        goal = each.goal
        turn = matrix_from_quaternion(goal.quaternion)
        wanted = turn.T @ (robot.center_of_mass(each.state.q) - goal.position)
        # A mass moves the common centre along its axis, as far as its share of all.
        ranges = np.sort([robot.center_of_mass(q) for q in (robot.lower, robot.upper)], axis=0)
        assert np.all((ranges[0] - 1e-12 <= wanted) & (wanted <= ranges[1] + 1e-12))
        assert np.linalg.norm(goal.position) > 1e-3


class Gait:
    """A method that takes 0.2 s of its clock for the first plan, 0.1 s more for each next one."""

    clock: Clock
    made: list[Gait]

    def __init__(self, robot: SpaceRobot, period: float, *, options: Any) -> None:
        self.robot, self.period, self.options = robot, period, options
        self.requests: list[Any] = []
        type(self).made.append(self)

    def plan(self, request: Any) -> Any:
        self.requests.append(request)
        self.clock.advance(0.1 + 0.1 * len(self.requests))
        if len(self.requests) == 3:
            raise PlanningError("too far")
        return named(duration=10.0 * len(self.requests))


@pytest.fixture
def gait(monkeypatch: pytest.MonkeyPatch) -> type[Gait]:
    Gait.clock, Gait.made = Clock(), []
    monkeypatch.setattr(measurements, "time", Gait.clock)
    monkeypatch.setattr(optimal, "OptimalGait", Gait)
    return Gait


def test_plans_are_timed_after_the_first_goal(gait: type[Gait]) -> None:
    urdf = str(robot_file("sliding_masses"))
    found = measurements.plans(urdf, "sliding_masses", 3, 7, {"starts": 4})
    assert found["cpu_s"] == pytest.approx([0.3, 0.4, 0.5])
    assert found["duration_s"] == pytest.approx([20.0, math.nan, 40.0], nan_ok=True)
    *_, last = gait.made
    assert last.period == 0.05
    assert (last.options.starts, last.options.cache) == (4, 0)
    assert tuple(last.options.max_velocity) == (0.0647, 0.1871, 0.6550)
    assert tuple(last.options.max_acceleration) == (0.228, 0.643, 3.564)
    assert len(gait.made) == 1
    case, robot = measurements.CASES["sliding_masses"], SpaceRobot.from_file(urdf)
    first, *_ = measurements.requests(robot, case, 1, 7)
    np.testing.assert_array_equal(first.goal.quaternion, last.requests[0].goal.quaternion)


def test_a_first_plan_and_the_same_again(gait: type[Gait], monkeypatch: pytest.MonkeyPatch) -> None:
    used = iter([named(ru_utime=1.0, ru_stime=0.25), named(ru_utime=8.0, ru_stime=0.5)])
    monkeypatch.setattr(
        measurements,
        "resource",
        named(RUSAGE_SELF=0, RUSAGE_CHILDREN=-1, getrusage=lambda who: next(used)),
    )
    found = measurements.first_plan(str(robot_file("three_joint_arm")))
    assert found == {"joints": 3, "cpu_s": 9.75, "plan_cpu_s": pytest.approx(0.3)}
    (method,) = gait.made
    first, again = method.requests
    assert first is again
    assert (method.period, method.options.cache) == (0.05, 0)
    assert np.all((first.state.q >= method.robot.lower) & (first.state.q <= method.robot.upper))
    turn = quaternion_from_rotvec(np.array([0.1, -0.15, 0.2]))
    np.testing.assert_allclose(first.goal.quaternion, turn)
    np.testing.assert_array_equal(first.goal.position, 0.0)
    np.testing.assert_array_equal(first.state.quaternion, [0, 0, 0, 1])
    assert (first.tolerance.attitude, first.tolerance.position) == (2e-3, 2e-3)


def test_the_script_writes_the_result_of_a_measurement(
    gait: type[Gait], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "result.json"
    words = [
        "plans",
        json.dumps(
            {
                "urdf": str(robot_file("planar_chain")),
                "count": 1,
                "seed": 3,
                "case": "planar_chain",
                "options": {},
            }
        ),
        str(file),
    ]
    monkeypatch.setattr(sys, "argv", ["measurements.py", *words])
    runpy.run_path(str(measurements.__file__), run_name="__main__")
    assert json.loads(file.read_text())["duration_s"] == [20.0]


# -- ticks ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("duration", "cycles"), [(0.0, 170), (607.0, 170), (607.1, 171), (610.0, 171), (3100.0, 1001)]
)
def test_a_gait_lasts_as_long_as_the_flight(duration: float, cycles: int) -> None:
    """It takes 100 s before its cycles of 3 s, of which there are at least 170."""
    assert measurements.gait_cycles_for(duration) == cycles


def test_ticks_are_the_difference_of_two_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, flown, calls = Clock(), [], []

    def by_command(words: list[str], longest: float) -> tuple[float, int]:
        flown.append((words, longest))
        factor = {"sliding_masses": 1, "coordinated_control": 2, "servicer": 3}[words[0]]
        ticks = 500 if math.isinf(longest) else round(longest / 0.05)
        # 3 s to start, and more the first time; 250 us a tick, more under control.
        return 3.0 + 9.0 * (len(flown) % 3 == 1) + 250e-6 * factor * ticks, ticks

    def fly(scenario: str, **arguments: Any) -> Any:
        calls.append(("fly", scenario, arguments))
        clock.advance(0.040 + 2.0 * (len(calls) % 7 == 0) if arguments else 0.030)
        return named(time=list(range(201)))

    def plan(scenario: str, **arguments: Any) -> None:
        calls.append(("plan", scenario, arguments))
        clock.advance(0.008)

    monkeypatch.setattr(measurements, "time", clock)
    monkeypatch.setattr(measurements, "_fly_by_command", by_command)
    monkeypatch.setattr(measurements, "_imported_package", lambda: named(fly=fly, plan=plan))
    times = {"spacerobot_ros.nodes.plant.node": 0.456}
    monkeypatch.setattr(measurements, "import_time", times.__getitem__)
    found = measurements.tick_times(20_000)
    assert found == {
        "stack_us": pytest.approx(250.0),
        "controlled_stack_us": pytest.approx(500.0),
        "servicer_stack_us": pytest.approx(750.0),
        "import_plant_ms": pytest.approx(456.0),
        "loop_us": pytest.approx(1e6 * (0.040 - 0.008) / 200),
        "controlled_loop_us": pytest.approx(1e6 * 0.030 / 200),
        **{
            f"plan_{name}_ms": pytest.approx(8.0)
            for name in ("lie_bracket", "area_loop", "square_path", "optimal")
        },
    }
    sliding = ["sliding_masses", "--method", "lie_bracket", "--set=planner.lie_bracket.cycles=301"]
    assert flown[:3] == [(sliding, 5.0), (sliding, 5.0), (sliding, 1000.0)]
    controlled = ["coordinated_control", "--set=coordinated_control.settle_time=55"]
    assert flown[3:6] == [(controlled, t) for t in (5.0, 5.0, math.inf)]
    assert flown[6:] == [(["servicer"], t) for t in (5.0, 5.0, math.inf)]
    plans = [call for call in calls if call[0] == "plan"]
    gait = ("plan", "sliding_masses", {"method": "lie_bracket", "cycles": 301})
    assert plans[:16] == [gait] * 16, "15 after the first one"
    assert plans[-16:] == [("plan", "planar_chain", {"method": "optimal", "cache": 0})] * 16
    flights = [call for call in calls if call[0] == "fly"]
    assert len(flights) == 2 * (1 + 1 + 3), "once for the ticks, three times after the first one"
    assert flights[0][2] == {
        "method": "lie_bracket",
        "parameters": {"planner.lie_bracket.cycles": 301},
    }


def test_an_import_is_timed_in_new_processes_after_the_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The module, which has byte code, burns 0.2 s of CPU time at first, 20 ms later."""
    (tmp_path / "burning.py").write_text(
        "import pathlib, time\n"
        "folder = pathlib.Path(__file__).parent\n"
        "assert pathlib.Path(__cached__).exists()\n"
        "burnt = 0.02 if (folder / 'seen').exists() else 0.2\n"
        "(folder / 'seen').open('a').write('x')\n"
        "end = time.process_time() + burnt\n"
        "while time.process_time() < end: pass\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    assert 0.02 <= measurements.import_time("burning") < 0.15
    assert (tmp_path / "seen").read_text() == "x" * 6


def test_a_refusal_is_timed_to_its_end_and_to_the_first_line(
    gait: type[Gait], monkeypatch: pytest.MonkeyPatch
) -> None:
    clock, urdf = gait.clock, str(robot_file("sliding_masses"))

    class Refusing(Gait):
        made: list[Gait] = []  # noqa: RUF012

        def plan(self, request: Any) -> Any:
            self.requests.append(request)
            asked = self.options.duration > 0 or self.options.longest < 100.0
            if not asked and len(self.requests) == 1:
                return named(duration=12.0)
            for count in (1, 2):
                clock.advance(0.25)
                progress = SearchProgress(count, 9)
                log_progress(logging.getLogger("spacerobot_ros.any"), progress, "searching")
            clock.advance(1.0)
            raise PlanningError(f"{self.options.longest:g} s")

    Refusing.clock = clock
    monkeypatch.setattr(optimal, "OptimalGait", Refusing)
    longest = OptimalOptions().longest
    assert longest > 100.0
    found = measurements.refusals(urdf, "sliding_masses", 2, 7)
    assert found["cpu_s"] == pytest.approx([1.5] * 6)
    assert found["sign_s"] == pytest.approx([0.25] * 6)
    assert found["reason"] == ["6 s", f"{longest:g} s", f"{longest:g} s"] * 2
    easy, short, timed, *_ = Refusing.made
    assert (timed.options.duration, short.options.duration) == (6.0, 0.0)
    reached, moved = easy.requests
    assert short.requests == timed.requests == [reached]
    shift = moved.goal.position - reached.goal.position
    np.testing.assert_allclose(shift, [2.0, 0.0, 0.0], atol=1e-12)
    assert (easy.options.cache, short.options.cache) == (0, 0)


def test_a_campaign_is_timed_with_its_report_and_by_the_flight(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock, flown = Clock(), []

    def run_module(name: str, run_name: str) -> None:
        assert (name, run_name) == ("spacerobot_ros", "__main__")
        _, *words = sys.argv
        assert words[:2] == ["campaign", "fly"]
        assert words[3:6] == ["--workers", "0", "--out"]
        section = yaml.safe_load(Path(words[2]).read_text())["campaign"]
        flown.append(section["flights"])
        # 3 s for plan and report, more the first time, and 0.5 ms a flight.
        clock.advance(3.0 + 5.0 * (len(flown) == 1) + 0.5e-3 * section["flights"])

    monkeypatch.setattr(measurements, "time", clock)
    monkeypatch.setattr(measurements, "runpy", named(run_module=run_module))
    monkeypatch.setattr(sys, "argv", ["pytest"])
    found = measurements.campaign_times(2000)
    assert flown == [200, 200, 2000]
    assert found == {
        "campaign_s": pytest.approx(4.0),
        "campaign_flight_ms": pytest.approx(0.5),
    }
    text = measurements._OPEN_LOOP_CAMPAIGN.format(flights=9)
    assert parse_campaign("open_loop", yaml.safe_load(text)["campaign"]).flights == 9


@pytest.mark.slow
def test_a_report_of_many_rows_has_memory_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["pytest"])
    found = measurements.report_figures(1200)
    assert found["rows"] == 1500.0
    assert 50.0 < found["report_peak_MB"] < 1000.0
    assert 0.5 < found["report_cpu_s"] < 60.0


@pytest.mark.parametrize("longest", [7.5, math.inf])
def test_a_flight_by_command_is_timed(longest: float, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    ran: list[list[str]] = []

    def run_module(name: str, run_name: str) -> None:
        assert (name, run_name) == ("spacerobot_ros", "__main__")
        ran.append(sys.argv)
        print("nobody sees this")
        clock.advance(1.75)
        Path(sys.argv[sys.argv.index("--json") + 1]).write_text(json.dumps({"ticks": 321}))
        raise SystemExit(0)

    monkeypatch.setattr(measurements, "time", clock)
    monkeypatch.setattr(measurements, "runpy", named(run_module=run_module))
    monkeypatch.setattr(sys, "argv", ["pytest"])
    assert measurements._fly_by_command(["servicer", "--x"], longest) == (1.75, 321)
    ((program, command, *words),) = ran
    assert (program, command, words[:2]) == ("spacerobot", "run", ["servicer", "--x"])
    assert words[2:-4] == ([] if math.isinf(longest) else ["--longest", "7.5"])
    assert Path(words[-3]).suffix == ".mcap"
