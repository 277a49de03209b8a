"""What the commands print of a result, word for word, and the exit code that goes with it.

The results are made by hand, so that every number on a line is another one.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.command_line import Result, spacerobot

from spacerobot_ros.bag import salvage
from spacerobot_ros.bag.salvage import Salvaged
from spacerobot_ros.cli import flights as command
from spacerobot_ros.collision import CollisionGeometry
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.flight import trials, verification
from spacerobot_ros.flight.second_opinion import EngineComparison
from spacerobot_ros.flight.trials import PlanEvaluation, PlanningProblem
from spacerobot_ros.flight.verification import Difference, Verification
from spacerobot_ros.measures import Outcome
from spacerobot_ros.model import load_robot
from spacerobot_ros.planning import METHODS, BasePath, GaitSchedule, Goal, PoseError
from spacerobot_ros.resources import robot_file
from spacerobot_ros.session import live
from spacerobot_ros.session import run as flights
from spacerobot_ros.session.run import RunResult

SUMMARY: dict[str, Any] = {
    "scenario": "sliding_masses",
    "method": "lie_bracket",
    "message": "The goal is reached.",
    "verdict": "The goal is reached.",
    "state": "reached",
    "succeeded": True,
    "final_position_m": [0.1234567, -2.0, 0.5],
    "position_error_m": 0.0012345,
    "final_attitude_rotvec_rad": [0.1, 0.2, -0.3],
    "attitude_error_rad": 0.05,
    "position_tolerance_m": 0.02,
    "attitude_tolerance_rad": 0.06,
    "not_controlled": [],
    "has_thrust": False,
    "final_joint_positions": [0.4, -0.7, 1.5],
    "joint_names": ["slider_1", "slider_2", "slider_3"],
    "wheel_names": [],
    "manoeuvre_time_s": 12.5,
    "corrections": 3,
    "plan_time_s": 0.4567,
    "ticks": 260,
    "wall_time_s": 0.52,
    "sim_time_s": 13.0,
    "ticks_per_s": 500.0,
    "real_time_factor": 25.0,
    "linear_momentum_drift": 1.23e-15,
    "angular_momentum_drift": 3.45e-4,
    "momentum_drift": 3.45e-4,
    "bag": "out/a.mcap",
    "messages_recorded": 1234,
    "gait": {"zf": [-2.4, 1.7, -1.4]},
}

LINES = """\
sliding_masses, lie_bracket: The goal is reached.
position    (0.12346, -2.00000, 0.50000) m, 1.23 mm from the goal (tolerance 20 mm)
attitude    (0.10000, 0.20000, -0.30000) rad, 50 mrad = 2.865 deg from the goal (tolerance 60 mrad)
shape       (0.40000, -0.70000, 1.50000)
manoeuvre   12.5 s, 3 corrections, planned in 0.457 s
flight      260 ticks in 0.52 s: 500 ticks/s, 25 times real time
momentum    changed by < 1e-9 kg m/s and 0.000345 kg m^2/s
bag         out/a.mcap (1234 messages)
"""

NEXT = "next        `spacerobot report out/a.mcap` draws this flight\n"


PUBLISHED = """\
                            printed in the paper          here
  zf                        (-2.3784, 1.6873, -1.3377)    (-2.4000, 1.7000, -1.4000)
    -1.3377 is a misprint for -1.3771: eq. (9) gives that, and so does the printed c3
  final_attitude_rotvec_rad (0.5342, -0.1511, 0.0943)     (0.1000, 0.2000, -0.3000)
    carries integration error: its |r| is not the |r| of its own zf
  final_position_m          (0.2995, -0.2557, 0.0931)     (0.1235, -2.0000, 0.5000)
    likewise
"""


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def run(patch: pytest.MonkeyPatch, summary: dict[str, Any], *words: str) -> Result:
    """Run the command with a flight that comes to this summary."""
    patch.setattr(flights, "run_scenario", lambda *_, **__: RunResult(summary))
    return spacerobot("run", "sliding_masses", *words, code=None)


GOAL = ("--goal", "0", "0", "0", "0", "0", "0", "1")


def test_the_lines_of_a_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    result = run(monkeypatch, SUMMARY, *GOAL)
    assert result.stdout == LINES + NEXT
    assert result.stderr == ""
    assert result.exit_code == 0


def test_injected_faults_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    faults = "['joint_stuck slider_1 at 1', 'joint_slow slider_2 0.5 until 9']"
    words = ("--set", f"plant.faults={faults}")
    found = {"node": "planner", "time_s": 2.5, "message": "Stuck: slider_1."}
    summary = SUMMARY | {"detection": found}
    verdict, *lines = run(monkeypatch, summary, *GOAL, *words).stdout.splitlines()
    assert [verdict, *lines[3:]] == (LINES + NEXT).splitlines()
    assert lines[:3] == [
        "fault       joint_stuck slider_1 at 1 s",
        "fault       joint_slow slider_2 0.5 until 9 s",
        "detected    by planner at 2.5 s: Stuck: slider_1.",
    ]


def test_a_flight_beside_an_earlier_one_says_which_is_which(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    earlier = tmp_path / "out" / "sliding_masses.mcap"
    earlier.parent.mkdir()
    earlier.write_bytes(b"")
    found = run(monkeypatch, SUMMARY | {"bag": "out/sliding_masses-1.mcap"}, *GOAL)
    assert found.stdout.splitlines()[-3:] == [
        "bag         out/sliding_masses-1.mcap (1234 messages)",
        "            out/sliding_masses.mcap contains an earlier flight and is kept",
        "next        `spacerobot report out/sliding_masses-1.mcap` draws this flight",
    ]


TOOL = {
    "end_effector_final_position_m": [1.0, -2.0, 3.0],
    "end_effector_position_error_m": 0.045678,
}
PLACE = "end-effector (1.00000, -2.00000, 3.00000) m, 45.7 mm"
CLEARANCE = {"clearance_m": 0.01234, "clearance_links": ["a", "b"], "clearance_time_s": 2.5}
CAPTURED = {"captured": True, "time_s": 1.25}
PLANNED = {"planned_momentum_Nms": 0.5, "angular_momentum_Nms": [2.0, -1.0, 2.0]}
HANDS = {
    "left": {"position_error_m": 0.045678, "attitude_error_rad": 0.01},
    # Its attitude is free.
    "right": {"position_error_m": 0.5, "attitude_error_rad": None},
}


@pytest.mark.parametrize(
    ("more", "after", "added"),
    [
        (TOOL, 2, [f"{PLACE} from its goal (tolerance 20 mm)"]),
        (
            TOOL | {"end_effector_attitude_error_rad": 0.01},
            2,
            [f"{PLACE} and 10 mrad from its goal (tolerance 20 mm, 60 mrad)"],
        ),
        (
            {"end_effectors": HANDS},
            2,
            [
                "left: 45.7 mm and 10 mrad from its goal (tolerance 20 mm, 60 mrad)",
                "right: 0.5 m from its goal (tolerance 20 mm)",
            ],
        ),
        ({"propellant_kg": 0.01234}, 6, ["propellant  12.3 g"]),
        # None used is a number too.
        ({"propellant_kg": 0.0}, 6, ["propellant  0.0 g"]),
        (CLEARANCE, 6, ["clearance   'a' and 'b' come within 12.3 mm at 2.5 s"]),
        (
            CLEARANCE | {"clearance_m": -0.5},
            6,
            ["clearance   'a' and 'b' touch, 0.5 m deep, at 2.5 s"],
        ),
        ({"capture": CAPTURED}, 6, ["capture     at 1.25 s"]),
        ({"capture": CAPTURED | PLANNED}, 6, ["capture     at 1.25 s, planned to leave 0.5 N m s"]),
        ({"capture": {"captured": False}}, 6, ["capture     the target is not captured"]),
    ],
)
def test_what_only_some_flights_have_has_lines_of_its_own(
    monkeypatch: pytest.MonkeyPatch, more: dict[str, Any], after: int, added: list[str]
) -> None:
    lines = run(monkeypatch, SUMMARY | more, *GOAL).stdout.splitlines()
    usual = (LINES + NEXT).splitlines()
    assert lines == [*usual[: after + 1], *added, *usual[after + 1 :]]


@pytest.mark.parametrize(
    ("changed", "before", "after"),
    [
        ({"not_controlled": ["position", "shape"]}, "(tolerance 20 mm)", "(not controlled)"),
        ({"not_controlled": ["attitude"]}, "(tolerance 60 mrad)", "(not controlled)"),
        ({"position_tolerance_m": None}, " (tolerance 20 mm)", ""),
        ({"attitude_tolerance_rad": None}, " (tolerance 60 mrad)", ""),
        ({"wheel_names": ["slider_2"]}, "(0.40000, -0.70000, 1.50000)", "(0.40000, 1.50000)"),
        ({"has_thrust": True}, "changed by", "not explained by thrusters:"),
    ],
)
def test_what_changes_words_of_a_line(
    monkeypatch: pytest.MonkeyPatch, changed: dict[str, Any], before: str, after: str
) -> None:
    assert before in LINES
    found = run(monkeypatch, SUMMARY | changed, *GOAL).stdout
    assert found == LINES.replace(before, after) + NEXT


@pytest.mark.parametrize("kept", [False, True])
def test_a_refused_goal_is_told_once_and_leaves_no_bag_that_nobody_asked_for(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, kept: bool
) -> None:
    bag, found = tmp_path / "a.mcap", tmp_path / "a.json"
    bag.write_text("a bag")
    reason = "No loop of the joints turns the base."
    refused = {"state": "refused", "succeeded": False, "ticks": 0, "message": reason}
    options = ("--json", str(found), *(("--bag", str(bag)) if kept else ()))
    result = run(monkeypatch, SUMMARY | refused | {"bag": str(bag)}, *GOAL, *options)
    assert (result.exit_code, result.output) == (1, f"{reason}\n")
    assert bag.exists() is kept
    assert json.loads(found.read_text())["bag"] == (str(bag) if kept else None)


def test_a_flight_that_misses_its_goal_is_exit_1_and_the_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    missed = {"succeeded": False, "state": "reached", "verdict": "The true pose is 0.1 m off."}
    result = run(monkeypatch, SUMMARY | missed, *GOAL)
    assert result.exit_code == 1
    assert result.stdout.startswith("sliding_masses, lie_bracket: The true pose is 0.1 m off.\n")
    assert result.stderr == "", "it is said once"


def test_an_interrupted_flight_says_how_its_report_is_made(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(command, "termination", lambda: object())
    report = tmp_path / "ein Flug.html"
    result = run(monkeypatch, SUMMARY, *GOAL, "--report", str(report))
    line = result.stdout.removeprefix(LINES)
    words = shlex.split(line.partition("`")[2].partition("`")[0])
    assert words == ["spacerobot", "report", "out/a.mcap", "--out", str(report)]


@pytest.mark.parametrize("state", ["reached", "failed"])
def test_published_figures_stand_beside_those_of_the_published_flight(
    monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    result = run(monkeypatch, SUMMARY | {"state": state}, "--method", "lie_bracket")
    assert result.stdout == LINES + PUBLISHED + NEXT


@pytest.mark.parametrize(
    ("words", "state"),
    [
        (("--method", "lie_bracket", *GOAL), "reached"),
        (("--method", "lie_bracket", "--goal-rotvec", "0", "0", "0.1"), "reached"),
        (("--method", "optimal"), "reached"),
        ((), "reached"),
        (("--method", "lie_bracket"), "interrupted"),
        (("--method", "lie_bracket"), "refused"),
    ],
)
def test_no_published_figures_for_another_goal_another_method_or_no_flight(
    monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], state: str
) -> None:
    assert run(monkeypatch, SUMMARY | {"state": state}, *words).stdout == LINES + NEXT


def test_what_the_command_line_changes_reaches_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[Any] = []

    def fly(scenario: Any, bag: Path, progress: Any, *, nodes: bool, longest: float) -> RunResult:
        taken[:] = [scenario, bag, nodes, longest]
        return RunResult(SUMMARY)

    monkeypatch.setattr(flights, "run_scenario", fly)

    def called(line: str) -> list[Any]:
        spacerobot("run", *line.split())
        return taken

    scenario, bag, nodes, longest = called("sliding_masses")
    assert (str(bag), nodes, scenario.lockstep) == ("out/sliding_masses.mcap", False, True)
    assert longest == float("inf")
    scenario, bag, nodes, longest = called(
        "sliding_masses --goal 0 1 2 0 0 0 1 --goal-rotvec 0 0 1 --realtime --longest 7.5 "
        "--bag b.mcap --set plant.tick_rate=50 --method lie_bracket"
    )
    assert (str(bag), nodes, longest) == ("b.mcap", True, 7.5)
    assert scenario.plant.time_mode == "realtime"
    assert scenario.plant.real_time_factor == 1.0
    assert scenario.plant.tick_rate == 50.0
    assert scenario.planner.tick_rate == 50.0
    assert scenario.planner.method == "lie_bracket"
    assert scenario.planner.plan_in_background is True
    assert scenario.goal.position.tolist() == [0.0, 1.0, 2.0]
    half = math.sin(0.5), math.cos(0.5)
    assert scenario.goal.quaternion == pytest.approx([0.0, 0.0, *half])
    for word in ("--nodes", "--processes"):
        scenario, _, nodes, _ = called(f"sliding_masses {word}")
        assert (nodes, scenario.lockstep) == (True, True)
    assert called("sliding_masses --realtime 2.5")[0].plant.real_time_factor == 2.5
    # What is set goes before what real time brings with it.
    line = "sliding_masses --realtime --set recorder.diagnostics_period=3.0"
    assert called(line)[0].config("recorder").diagnostics_period == 3.0
    scenario = called("servicer --method transposed_jacobian")[0]
    assert scenario.controller.law == "transposed_jacobian"


# -- plans ------------------------------------------------------------------------------------


def trial(problem: PlanningProblem, name: str, reached: bool = True) -> PlanEvaluation:
    """Return a flight of two ticks and one more that ends 0.0123 m and 0.0456 rad off."""
    n, tool = problem.robot.n, METHODS[name]
    goal, pieces = Goal(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])), []
    for ticks, first in ((2, 0.0), (1, 2.0)):
        time = np.array([problem.control_period * k for k in range(ticks + 1)])
        attitudes = np.tile([0.0, 0.0, 0.0, 1.0], (ticks + 1, 1))
        # The joints are at the number of the tick.
        shapes = np.tile(first + np.arange(ticks + 1.0)[:, np.newaxis], (1, n))
        path = BasePath(time, np.zeros((ticks + 1, 3)), attitudes)
        names = problem.robot.joint_names
        notes: dict[str, list[float] | float | str] = {"ticks": float(ticks)}
        schedule = GaitSchedule(name, names, problem.control_period, shapes, path, goal, notes)
        pieces.append(schedule)
    pose = np.array([0.1, 0.2, 0.3, 0.0, 0.0, math.sin(0.2), math.cos(0.2)])
    error = PoseError(np.array([0.0, 0.0123, 0.0]), np.array([0.0, 0.0, 0.0456]))
    return PlanEvaluation(name, pieces, error, pose, 0.6789, reached, tool.controls)


def plan(patch: pytest.MonkeyPatch, reached: bool, *words: str) -> Result:
    """Run the command with plans that come to the trial above."""
    patch.setattr(trials, "try_method", lambda problem, name: trial(problem, name, reached))
    return spacerobot("plan", *words, code=None)


PLANAR = ("planar_chain", "--method", "square_path", "--set", "planner.tick_rate=50")


def test_the_lines_of_a_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    result = plan(monkeypatch, True, *PLANAR)
    assert result.exit_code == 0
    assert result.stderr == ""
    # Three ticks at 50 Hz.
    assert result.stdout == (
        "planar_chain, square_path: 0.06 s; 45.6 mrad from the goal "
        "(tolerance 0.2 mrad; position not controlled)\n"
        "planned in 0.679 s\n"
        "clearance   no link pairs are checked (1 disabled by the SRDF)\n"
    )
    silent = plan(monkeypatch, True, *PLANAR, "--set", "planner.clearance=0").stdout
    assert silent == "".join(result.stdout.splitlines(keepends=True)[:2])


def test_the_clearance_of_a_plan(monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("three_joint_arm", "--method", "area_loop")
    found = plan(monkeypatch, True, *words).stdout.splitlines()[-1]
    geometry = CollisionGeometry(load_robot(robot_file("three_joint_arm")))
    # All joints move together from one shape to the next.
    way = np.linspace(0, 1, 2001)[:, np.newaxis] * np.ones(3)
    nearest = geometry.nearest_along(np.concatenate([way + k for k in range(3)]))[0].min()
    assert nearest < 0
    said = re.fullmatch(r"clearance   links '\w+' and '\w+' touch, ([\d.]+) m deep", found)
    assert said is not None
    assert float(said[1]) == pytest.approx(-nearest, rel=6e-3)


def test_a_plan_that_misses_its_goal_is_exit_1_and_a_sentence(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = plan(monkeypatch, False, *PLANAR)
    assert result.exit_code == 1
    assert result.stderr == (
        "The goal is not reached: the plan ends 45.6 mrad from the goal "
        "(tolerance 0.2 mrad; position not controlled).\n"
    )


def test_a_plan_that_leaves_a_requested_position_is_exit_1(monkeypatch: pytest.MonkeyPatch) -> None:
    result = plan(monkeypatch, True, *PLANAR, "--goal", "0.1", "0", "0")
    assert result.exit_code == 1
    assert result.stderr.startswith("The goal is reached but for its position, which is 0.0123 m")
    assert result.stdout.splitlines()[0].endswith("position not controlled)")


def test_the_json_of_a_plan(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    target = tmp_path / "plan.json"
    result = plan(monkeypatch, False, *PLANAR, "--json", str(target))
    assert result.exit_code == 1, "what was planned is written before"
    written = json.loads(target.read_text())
    assert written["method"] == "square_path"
    assert written["succeeded"] is False
    assert written["manoeuvre_time_s"] == pytest.approx(0.06)
    assert written["plan_time_s"] == 0.6789
    assert written["final_position_m"] == [0.1, 0.2, 0.3]
    assert written["final_attitude_rotvec_rad"] == pytest.approx([0.0, 0.0, 0.4])
    assert written["position_error_m"] == pytest.approx(0.0123)
    assert written["attitude_error_rad"] == pytest.approx(0.0456)
    assert written["notes"] == {"ticks": 1.0}
    # The second piece goes on where the first ends.
    assert written["schedule"]["positions"] == [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 3.0]]
    assert written["schedule"]["tick_period_s"] == 0.02
    assert written["final_joint_positions"] == [3.0, 3.0]
    assert written["path"]["time_s"] == pytest.approx([0.0, 0.02, 0.04, 0.04, 0.06])


def test_a_comparison_has_a_row_for_each_method(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def compare(problem: PlanningProblem) -> dict[str, PlanEvaluation | PlanningError]:
        refusal = PlanningError("It has no slider.")
        found = {name: trial(problem, name) for name in ("square_path", "optimal")}
        return {"lie_bracket": refusal, **found}

    monkeypatch.setattr(trials, "compare", compare)
    target = tmp_path / "plan.json"
    result = plan(monkeypatch, True, *PLANAR, "--compare", "--json", str(target))
    assert result.exit_code == 0, result.output
    assert result.stdout.splitlines()[:5] == [
        "method           manoeuvre  planned in      attitude      position",
        "                         s           s       rad off         m off",
        "lie_bracket   It has no slider.",
        "square_path           0.06       0.679        0.0456      (0.0123)",
        "optimal               0.06       0.679        0.0456        0.0123",
    ]
    compared = json.loads(target.read_text())["compared"]
    assert compared["lie_bracket"] == "It has no slider."
    assert compared["optimal"] == pytest.approx(0.06)
    # The method that was asked for decides on the exit code.
    words = ("planar_chain", "--method", "lie_bracket", "--compare")
    assert plan(monkeypatch, True, *words).exit_code == 1


@pytest.mark.parametrize(
    ("missed", "missed_beside", "code"), [(1, 0, 1), (0, 1, 0), (0, 0, 0), (3, 2, 1)]
)
def test_random_goals_that_are_missed_are_exit_1(
    monkeypatch: pytest.MonkeyPatch, missed: int, missed_beside: int, code: int
) -> None:
    tried: list[Any] = []

    def random_goals(
        problem: PlanningProblem, count: int, distance: float, angle: float
    ) -> list[Goal]:
        tried[:] = [count, distance, angle]
        return [problem.goal] * count

    def try_goals(
        problem: PlanningProblem, goals: list[Goal], methods: list[str], show: Any
    ) -> dict[str, list[PlanEvaluation | PlanningError]]:
        tried.append(methods)
        like = trial(problem, methods[0])

        def flown(duration: float, plan_time: float, *, reached: bool) -> PlanEvaluation:
            piece = replace(like.pieces[0], control_period=duration / 2)  # Of two ticks.
            return replace(like, pieces=[piece], plan_time=plan_time, reached=reached)

        times = ((4.0, 0.1), (1.0, 0.5), (2.0, 0.2), (4.0, 0.2), (1.0, 0.2))
        met = [flown(*each, reached=True) for each in times]
        refused = [PlanningError(text) for text in ("Too far.", "Too near.", "Too far.")]
        return {
            methods[0]: [*met, *refused, *missed * [flown(2.0, 0.2, reached=False)]],
            methods[1]: [flown(1.0, 0.1, reached=False) for _ in range(missed_beside)],
        }

    monkeypatch.setattr(trials, "random_goals", random_goals)
    monkeypatch.setattr(trials, "try_goals", try_goals)
    words = ("--random", "9", "--within", "0.5", "90", "--beside", "optimal")
    result = plan(monkeypatch, True, *PLANAR, *words)
    assert result.exit_code == code
    assert tried == [9, 0.5, pytest.approx(math.pi / 2), ["square_path", "optimal"]]
    head, first, second, *reasons = result.stdout.splitlines()
    assert head.split() == [
        *("method", "goals", "met", "missed", "refused"),
        *("shortest", "median", "longest", "planned", "in", "at", "most"),
    ]
    counts = [str(n) for n in (5 + missed + 3, 5, missed, 3)]
    assert first.split() == ["square_path", *counts, "1", "2", "4", "0.2", "0.5"]
    assert second.split()[:5] == ["optimal", str(missed_beside), "0", str(missed_beside), "0"]
    assert len(second.split()) == (10 if missed_beside else 5)
    assert reasons == ["square_path refused: Too far.", "square_path refused: Too near."]


# -- bags -------------------------------------------------------------------------------------


def verified(patch: pytest.MonkeyPatch, *words: str, **changes: Any) -> Result:
    at = Difference(1.25, "/odom", "pose.pose.position.y", 0.5, 0.25)
    whole = Verification(340, 34.0, 1705, 1.5e-13, at, None, ("/joint_states", "/odom"))

    def verify(path: Path, tolerance: float, *, mujoco: bool) -> Verification:
        assert (str(path), tolerance) == ("a.mcap", changes.pop("tolerance", 1e-9))
        assert mujoco == ("second_opinion" in changes)
        return replace(whole, **changes)

    patch.setattr(verification, "verify_bag", verify)
    return spacerobot("verify", "a.mcap", *words, code=None)


def test_the_lines_of_a_verification(monkeypatch: pytest.MonkeyPatch) -> None:
    result = verified(monkeypatch)
    assert result.exit_code == 0
    assert result.stdout == (
        "flown again 340 ticks, 34 s\n"
        "compared    1705 messages on /joint_states, /odom\n"
        "largest     1.5e-13, pose.pose.position.y of /odom at 1.25 s\n"
        "verified    every published state follows from the commands\n"
    )
    nothing = verified(monkeypatch, largest=0.0, largest_at=None).stdout.splitlines()
    assert nothing[2] == "largest     0"
    lenient = verified(monkeypatch, "--tolerance", "0.01", tolerance=0.01)
    assert lenient.exit_code == 0, lenient.output


def test_the_lines_of_a_second_opinion(monkeypatch: pytest.MonkeyPatch) -> None:
    found = EngineComparison("MuJoCo 9.8", "by steps", 339, 2e-9, 3.2e-9, 9.8e-9, 17.5)

    def told(other: EngineComparison) -> Result:
        return verified(monkeypatch, "--engine", "mujoco", second_opinion=other)

    agrees = told(found)
    assert agrees.exit_code == 0
    assert agrees.stdout.splitlines()[4:] == [
        "engine      MuJoCo 9.8, by steps",
        "deviates    2e-09 m, 3.2e-09 rad, joints 9.8e-09 m or rad, largest at 17.5 s of 339 ticks",
    ]
    note = told(replace(found, stop_reason="a joint is held")).stdout.splitlines()[-1]
    assert note == "note        compared until a joint is held"
    for other in (
        replace(found, position=1.1e-8),
        replace(found, attitude=1.1e-8),
        replace(found, joints=1.1e-8),
    ):
        differs = told(other)
        assert differs.exit_code == 1
        assert differs.stderr == "MuJoCo 9.8 differs by more than 1e-08 m or rad.\n"


def test_a_difference_is_exit_1_and_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    at = Difference(2.5, "/odom", "twist.twist.linear.x", 0.5, 0.25, " (a remark)")
    result = verified(monkeypatch, difference=at)
    assert result.exit_code == 1
    assert "verified" not in result.stdout
    assert result.stderr == (
        "The bag differs: /odom at 2.5 s: twist.twist.linear.x is 0.5 in the bag "
        "and 0.25 according to the commands (a remark).\n"
    )


def test_states_that_a_bag_lacks_are_exit_1_and_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    result = verified(monkeypatch, missing="it holds less.")
    assert (result.exit_code, result.stderr) == (1, "The bag is incomplete: it holds less.\n")
    assert "verified" not in result.stdout


def test_the_lines_of_a_salvage(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[Any] = []

    def save(path: Path, out: Path | None) -> Salvaged:
        given[:] = [path, out]
        return Salvaged(Path("b.mcap"), 123, 4.5, 6, 789)

    monkeypatch.setattr(salvage, "salvage_bag", save)
    result = spacerobot("salvage", "a.mcap")
    assert result.stdout == (
        "saved       123 messages over 4.5 s\n"
        "lost        789 bytes after the last whole record, 6 damaged chunks\n"
        "bag         b.mcap\n"
    )
    assert given == [Path("a.mcap"), None]
    monkeypatch.setattr(salvage, "salvage_bag", lambda *_: Salvaged(Path("b.mcap"), 0, 0.0, 6, 0))
    assert spacerobot("salvage", "a.mcap", code=1).stderr == "No messages in a.mcap can be read.\n"


# -- goals ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("outcome", "code"),
    [("reached", 0), ("failed", 1), ("refused", 1), ("aborted", 1), ("interrupted", 1)],
)
def test_only_a_goal_that_is_reached_is_exit_0(
    monkeypatch: pytest.MonkeyPatch, outcome: str, code: int
) -> None:
    sent: list[Any] = []

    def send(goal: Goal, show: Any, *, namespace: str, timeout: float) -> Outcome:
        sent[:] = [goal.position.tolist(), goal.quaternion.tolist(), namespace, timeout]
        show("A sentence.")
        return Outcome(outcome)

    monkeypatch.setattr(live, "send_goal", send)

    def called(line: str) -> Result:
        return spacerobot("goal", *line.split(), code=code)

    result = called("1 -2 3 --namespace /a --timeout 7")
    assert result.stdout == "A sentence.\n"
    assert sent == [[1.0, -2.0, 3.0], [0.0, 0.0, 0.0, 1.0], "/a", 7.0]
    called("1 2 3 0.6 0 0.8 0")
    assert sent == [[1.0, 2.0, 3.0], [0.6, 0.0, 0.8, 0.0], "", 0.0]
    called("1 2 3 --goal-rotvec 0 0 1")
    assert sent[1] == pytest.approx([0.0, 0.0, math.sin(0.5), math.cos(0.5)])
    called("1 2 3 --goal-rpy-deg 0 90 90")
    assert sent[1] == pytest.approx([-0.5, 0.5, 0.5, 0.5])
    spacerobot("goal", *"1234", code=2)
