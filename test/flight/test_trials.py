"""Plans that are tried in the plant: when a manoeuvre is at its end, and what random goals are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.planner_loop import QUICK, TICK, StubMethod, goal_at, robot_of

from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.flight.trials import (
    PlanEvaluation,
    PlanningProblem,
    random_goals,
    try_goals,
    try_method,
)
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitSchedule, Goal, PlanRequest
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.simulation import InitialState

AWAY = goal_at(([0.05, -0.03, 0.02], [0.0, 0.0, 0.0]))


def problem(robot: str = "sliding_masses", **start: Any) -> PlanningProblem:
    config = configured(PlannerConfig, {**QUICK, "position_tolerance": 1e-3})
    return PlanningProblem("a test", robot_of(robot), InitialState(**start), AWAY, config)


class Halves(StubMethod):
    """Goes half of the way with each schedule; ``enough`` of them reach the goal."""

    enough = 1000

    def plan(self, request: PlanRequest, *_: Any) -> GaitSchedule:
        self.partial = True
        self.overshoot = 1.0 if len(self.requests) + 1 >= self.enough else 0.0
        return super().plan(request)


def test_partial_schedules_follow_each_other_until_the_goal_is_reached() -> None:
    method = Halves(ticks=20)
    trial = try_method(problem(), "stub", method)
    # 0.0616 m halved six times is less than 1 mm.
    assert (len(trial.pieces), trial.reached, trial.limited) == (6, True, 0)
    assert trial.error.distance == pytest.approx(0.03082207 / 32, rel=1e-5)
    assert trial.duration == pytest.approx(6 * 20 * TICK)
    assert trial.positions.shape == (121, 3)
    assert [request.correction for request in method.requests] == [False] + 5 * [True]
    assert method.requests[0].previous is None
    assert [r.previous for r in method.requests[1:]] == [*trial.pieces[:-1]]
    time = trial.path.time
    assert (time[0], time[-1]) == (0.0, pytest.approx(6.0))
    assert np.all(np.diff(time) >= 0)


def test_what_has_reached_the_goal_goes_no_further_though_it_is_partial() -> None:
    method = Halves(ticks=40)
    method.enough = 1
    trial = try_method(problem(), "stub", method)
    assert (len(trial.pieces), trial.reached) == (1, True)


def test_a_whole_schedule_is_the_last_one_though_it_misses() -> None:
    method = StubMethod(ticks=40)
    method.overshoot = 0.1
    trial = try_method(problem(), "stub", method)
    assert (len(trial.pieces), trial.reached) == (1, False)
    assert trial.error.distance == pytest.approx(0.1 * np.linalg.norm(AWAY.position), rel=1e-6)


@pytest.mark.parametrize(("robot", "axes"), [("sliding_masses", 3), ("planar_chain", 1)])
def test_random_goals_are_spread_evenly_over_a_ball_and_over_angles(robot: str, axes: int) -> None:
    at = problem(robot, position=(0.3, -0.2, 0.5))
    pose = at.plant().pose
    goals = random_goals(at, 600, 0.4, 0.7)
    offsets = np.array([goal.position for goal in goals]) - pose[:3]
    radii = np.linalg.norm(offsets, axis=1)
    assert radii.max() <= 0.4
    # Of the volume: the share within r is (r / 0.4)^3.
    shares = np.sort((radii / 0.4) ** 3)
    assert np.abs(shares - (np.arange(600) + 0.5) / 600).max() < 0.06
    assert np.abs(offsets.mean(axis=0)).max() < 0.04
    turns = Rotation.from_quat(pose[3:]).inv() * Rotation.from_quat([g.quaternion for g in goals])
    angles = turns.magnitude()
    assert angles.max() <= 0.7
    assert np.abs(np.sort(angles / 0.7) - (np.arange(600) + 0.5) / 600).max() < 0.06
    spread = np.linalg.svd(turns.as_rotvec(), compute_uv=False)
    assert np.count_nonzero(spread > 0.1 * spread[0]) == axes
    # To either side.
    assert np.abs(turns.as_rotvec().mean(axis=0)).max() < 0.04
    again = random_goals(at, 3, 0.4, 0.7)
    assert all(np.array_equal(a.position, b.position) for a, b in zip(goals, again, strict=False))
    for bounds in ((np.nan, 0.7), (0.4, np.inf), (-0.1, 0.7), (0.4, -0.7)):
        with pytest.raises(ParameterError, match="Random goals lie within"):
            random_goals(at, 3, *bounds)


def test_goals_are_counted_by_what_became_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """They are reached within 1e-5, whatever the tolerance of the planner is."""
    method = StubMethod(ticks=40)
    monkeypatch.setattr(PlanningProblem, "method", lambda self, name: method)
    far = Goal(np.array([2.0, 0.0, 0.0]), AWAY.quaternion)
    lines: list[str] = []

    def show(line: str) -> None:
        lines.append(line)
        method.overshoot = 1e-2

    results = try_goals(problem(), [AWAY, far, AWAY], ["stub"], show)
    first, refused, last = results["stub"]
    assert isinstance(first, PlanEvaluation)
    assert isinstance(last, PlanEvaluation)
    assert (first.reached, str(refused), last.reached) == (True, "It is too far.", False)
    assert first.duration == last.duration == pytest.approx(2.0)
    assert lines[0].startswith("goal 1, stub: 2 s, ")
    assert lines[1] == "goal 2, stub: It is too far."
    assert lines[2].endswith(f" rad and {1e-2 * np.linalg.norm(AWAY.position):.2g} m off")


def test_a_method_that_refuses_is_no_trial() -> None:
    method = StubMethod()
    method.refusing = True
    with pytest.raises(PlanningError, match="too far"):
        try_method(problem(), "stub", method)
