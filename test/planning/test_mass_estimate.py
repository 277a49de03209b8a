"""What flights tell of masses, of the time to the end, and of progress."""

from __future__ import annotations

import io
import logging
from dataclasses import replace
from threading import Condition
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import TICK, robot_of

from spacerobot_ros import plan
from spacerobot_ros.cli.terminal import Display, display
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import BasePath, GaitSchedule, Goal, RobotState
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.progress import (
    SearchPhase,
    SearchProgress,
    log_progress,
    report_progress,
)
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.measured_states import (
    MassEstimate,
    PathCheck,
    PathSensitivity,
)
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus, time_to_end

ROBOTS = ("sliding_masses", "three_joint_arm", "servicer")
START = Rotation.from_rotvec([0.4, -0.2, 0.3])


class Trip:
    """A schedule that goes to and fro, each joint in its own time, and what is learnt on it."""

    def __init__(self, name: str, ticks: int) -> None:
        self.robot = robot_of(name)
        s = np.linspace(0.0, 1.0, ticks + 1)[:, np.newaxis]
        lower, upper = np.maximum(self.robot.lower, -2.0), np.minimum(self.robot.upper, 2.0)
        number: Array = np.arange(self.robot.n, dtype=float)
        swing = np.sin(2 * np.pi * s * (1 + number % 3) + number)
        self.shapes = lower + (upper - lower) * (0.5 + 0.3 * swing)
        sensitivity = PathSensitivity(self.robot)
        self.count = sensitivity.count
        goal, path = Goal(np.zeros(3), START.as_quat()), self.path(np.zeros(self.count))
        self.schedule = GaitSchedule("any", self.robot.joint_names, TICK, self.shapes, path, goal)
        self.derivatives = sensitivity.path_derivatives(self.schedule)
        path = replace(path, mass_derivatives=self.derivatives)
        self.schedule = replace(self.schedule, path=path)
        self.masses = MassEstimate(self.count)

    def path(self, errors: Array) -> BasePath:
        """Return the base path at every tick, integrated with masses and inertias that are off by
        relative errors, two a body.
        """
        weights = self.robot.inertial.scaled(*np.split(1 + errors, 2))
        true = SpaceRobot(weights.apply_to_description(self.robot.description))
        state = RobotState(np.array([0.3, -0.1, 0.2]), START.as_quat(), self.shapes[0])
        return BasePrediction(true, TICK, 0.01).path(state, self.shapes)

    def check(self, average: int) -> PathCheck:
        return PathCheck(self.robot, self.schedule, 0, PlannerConfig(), average, self.masses)

    def measure(self, check: PathCheck, k: int, position: Array, quaternion: Array) -> None:
        assert check.due(round(k * TICK * 1e9))
        check.average_pose(RobotState(position, quaternion, self.shapes[k]))


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
@pytest.mark.parametrize("ticks", [40, 300, 950])
def test_sensitivities_are_those_of_integrated_paths(name: str, ticks: int) -> None:
    trip = Trip(name, ticks)
    errors = 1e-4 * np.random.default_rng(3).normal(size=trip.count)
    path, plain = trip.path(errors), trip.schedule.path
    turns = Rotation.from_quat(path.quaternion) * Rotation.from_quat(plain.quaternion).inv()
    # Displacements over turns in the world.
    expected = np.hstack([path.position - plain.position, turns.as_rotvec()])
    found = trip.derivatives @ errors
    assert np.abs(expected[:, :3]).max() > 1e-6
    np.testing.assert_allclose(found, expected, atol=0.05 * np.abs(expected).max())


@pytest.mark.slow
def test_half_of_a_path_tells_where_it_ends() -> None:
    """Masses wrong by a tenth, poses with noise of a milliradian, and where it begins as well."""
    trip, missed, known = Trip("three_joint_arm", 120), list[float](), list[float]()
    for seed in range(10):
        rng = np.random.default_rng(seed)
        path = trip.path(rng.uniform(-0.1, 0.1, trip.count))
        trip.masses = MassEstimate(trip.count)
        off = Rotation.from_rotvec(2e-3 * rng.normal(size=3))
        check = trip.check(3)
        for k in range(60):
            noise = Rotation.from_rotvec(1e-3 * rng.normal(size=3))
            attitude = off * Rotation.from_quat(path.quaternion[k]) * noise
            position = path.position[k] + 1e-3 * rng.normal(size=3)
            trip.measure(check, k, position, attitude.as_quat())
        end = off * Rotation.from_quat(path.quaternion[-1])
        for where, errors in ((check.end, missed), (check.expected_end, known)):
            errors.append((end.inv() * Rotation.from_quat(where[1])).magnitude())
    assert np.median(missed) > 0.009
    assert np.median(known) < 0.2 * np.median(missed)
    assert max(known) < 0.002


def test_what_was_learnt_on_one_path_counts_on_the_next() -> None:
    trip = Trip("three_joint_arm", 100)
    path = trip.path(np.random.default_rng(8).uniform(-0.1, 0.1, trip.count))
    first = trip.check(1)
    for k in range(101):
        trip.measure(first, k, path.position[k], path.quaternion[k])
    learnt = trip.masses.errors.copy()
    assert np.abs(learnt).max() > 0.01
    second = trip.check(1)
    trip.measure(second, 0, path.position[0], path.quaternion[0])
    np.testing.assert_allclose(trip.masses.errors, learnt, rtol=1e-9)
    end = Rotation.from_quat(second.expected_end[1])
    unknown = Rotation.from_quat(second.end[1])
    true_end = Rotation.from_quat(path.quaternion[-1])
    assert (true_end.inv() * end).magnitude() < 0.1 * (true_end.inv() * unknown).magnitude()


@pytest.mark.parametrize("size", [1e-4, 1e-2, 1.0], ids="{:g}".format)
@pytest.mark.parametrize("name", ROBOTS)
def test_an_offset_of_all_poses_tells_nothing_of_masses(name: str, size: float) -> None:
    trip = Trip(name, 60)
    true = 0.02 * np.random.default_rng(5).normal(size=trip.count)
    offset = size * np.array([0.01, -0.02, 0.03, 0.02, 0.01, -0.01])
    plain, shifted = MassEstimate(trip.count), MassEstimate(trip.count)
    for derivative in trip.derivatives:
        plain.add(derivative, derivative @ true)
        shifted.add(derivative, derivative @ true + offset)
    # Not an implausible estimate, which is zero whatever the poses were.
    assert np.abs(plain.errors).max() > 1e-3
    np.testing.assert_allclose(shifted.errors, plain.errors, atol=1e-8)


@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("three_joint_arm", [0.1, 0.0, 0.0, 0.0, 0.0, 0.0]),
        ("servicer", [0.02, 0.0, 0.0, 0.0, 0.02, 0.0]),
    ],
)
def test_a_jump_of_what_is_measured_tells_nothing_of_masses(name: str, step: list[float]) -> None:
    trip = Trip(name, 120)
    path = trip.path(np.random.default_rng(8).uniform(-0.1, 0.1, trip.count))

    def follow(until: int, jump_at: int) -> PathCheck:
        check = trip.check(3)
        for k in range(until):
            off = np.array(step) * (k >= jump_at)
            attitude = Rotation.from_rotvec(off[3:]) * Rotation.from_quat(path.quaternion[k])
            trip.measure(check, k, path.position[k] + off[:3], attitude.as_quat())
        return check

    jumped = follow(60, jump_at=30)
    for found, plain in zip(jumped.expected_end, jumped.end, strict=True):
        np.testing.assert_allclose(found, plain, atol=1e-12)
    # The path of the jump is forgotten: what comes after it counts alone.
    following = follow(60, jump_at=60)
    end = Rotation.from_quat(following.expected_end[1])
    assert (Rotation.from_quat(path.quaternion[-1]).inv() * end).magnitude() < 1e-3


# -- how long a goal was flown to, from what its planner has reported ----------------------------


FLOWN = (
    "0 idle, 1 executing a, 4 reached a, 5 planning b, 7 executing b, 8 planning b, 9 executing b"
)


@pytest.mark.parametrize(
    ("reported", "now", "time"),
    [
        (FLOWN, 12.5, 5.5),
        # Another goal's refusal ends nothing.
        (f"{FLOWN}, 10 refused c", 12.5, 5.5),
        (f"{FLOWN}, 10 refused c, 11 aborted b", 12.5, 4.0),
        (
            "1 executing a, 3 planning b, 3.5 refused b, 6 planning a, 7 executing a, 9 aborted a",
            *(12.0, 8.0),
        ),
        # The planner was started again.
        ("0.25 executing a, 40.5 planning a, 46.5 executing a, 49 aborted a", 60.0, 48.75),
        ("0 idle, 1 refused a", 5.0, None),
    ],
)
def test_it_counts_from_the_first_schedule_for_the_last_goal(
    reported: str, now: float, time: float | None
) -> None:
    said = []
    for each in reported.split(", "):
        at, state, *goal = each.split()
        said.append((float(at), PlannerStatus(PlannerState(state), goal_id="".join(goal))))
    assert time_to_end(said, now) == time


# -- what a search reports of itself on the way, and what the command line shows of it -----------


_LOG = logging.getLogger("spacerobot_ros.planning.somewhere")


class Terminal(io.StringIO):
    """What is written to a terminal, or to a file."""

    def __init__(self, *, is_terminal: bool = True) -> None:
        super().__init__()
        self._is_terminal, self._written = is_terminal, Condition()

    def isatty(self) -> bool:
        return self._is_terminal

    def write(self, text: str) -> int:
        with self._written:
            count = super().write(text)
            self._written.notify_all()
        return count

    def await_words(self, words: str, times: int = 1) -> None:
        """Wait until words have been written some times."""
        with self._written:
            came = self._written.wait_for(lambda: self.getvalue().count(words) >= times, 20.0)
        assert came, (words, self.getvalue())


def test_a_search_reports_every_start_and_the_best_so_far() -> None:
    seen: list[SearchProgress] = []
    with report_progress(seen.append):
        few: dict[str, Any] = {
            "starts": 3,
            "answers": 3,
            "agreeing": 0,
            "intervals": 16,
            "cache": 0,
        }
        few |= {"position": (0.2, -0.1, 0.05), "rotvec": (0.1, 0.0, 0.1)}
        gait = plan("sliding_masses", control_period=0.1, **few)
    starts = [each.starts for each in seen]
    assert starts[:4] == [0, 1, 2, 3]
    assert starts == sorted(starts)
    assert all(each.max_starts >= each.starts for each in seen)
    best = [each.best_s for each in seen]
    assert best == sorted(best, reverse=True), "it is the best so far"
    # Held commands take a whole number of periods, and bring the gait to the goal exactly.
    assert gait.duration == pytest.approx(best[-1], rel=0.25)
    count = len(seen)
    with pytest.raises(PlanningError):
        plan("sliding_masses", position=(9.0, 0.0, 0.0), starts=1)
    assert len(seen) == count, "nothing is report_progress afterwards"


def test_a_long_search_and_flight_are_shown_by_a_line_that_stays_true(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setenv("COLUMNS", "60")
    shown = Display("arm", period=0.01)

    await_line = terminal.await_words
    await_line("preparing arm for 0 s")
    shown.show_line("Compiling.")
    shown.search(SearchProgress(1, 8))
    await_line("planning arm for 0 s: searching, start 1 of at most 8, none\r")
    shown.search(SearchProgress(8, 8, 12.1, SearchPhase.SHORTENING, 3.2))
    await_line("planning arm for 0 s: shortening, best 12.1 s\r")
    await_line("planning arm for 1 s: shortening, best 12.1 s\r")  # Without another report.
    shown.fly(0.0, 0.0)
    shown.fly(5.0, 20.0)
    shown.search(SearchProgress(1, 8))
    await_line("flying arm for 1 s: 5.0 of 20.0 s\r")
    shown.fly(20.5, 20.0)
    await_line("flying arm for 1 s: 20.5 s\r")
    shown.close()
    text = terminal.getvalue()
    assert text.endswith("\r\x1b[K"), "nothing of it stays"
    assert text.count("\n") == 1, "but for the line that is to stay"
    assert "planning" not in text[text.index("flying arm") :], "corrections disturb no flight"


def test_short_work_is_not_shown_and_without_a_terminal_there_are_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with display("arm") as shown:
        log_progress(_LOG, SearchProgress(1, 2), "start 1")
        shown.show_line("Compiling.")
        shown.fly(1.0, 2.0)
    assert capsys.readouterr() == ("", "")
    lines = Terminal(is_terminal=False)
    monkeypatch.setattr("sys.stderr", lines)
    shown = Display("arm", period=0.01)
    shown.fly(1.0, 2.0)
    lines.await_words("flying arm for 0 s: 1.0 of 2.0 s\n", times=2)
    shown.close()
    assert "\r" not in lines.getvalue()
