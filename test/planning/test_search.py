"""Which guesses a search tries, with which bounds, and which solutions it refines: by a script.

Solvers, guesses and held commands are stand-ins, so every count and bound is a number of the table.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from spacerobot_ros.errors import NotFoundError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.cancellation import NEVER
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal import search as module
from spacerobot_ros.planning.methods.optimal.held_commands import HeldCommands, ManoeuvreModel
from spacerobot_ros.planning.methods.optimal.multiple_shooting import (
    TOLERANCE,
    DurationBounds,
    Neighbourhood,
    StopRule,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    Trajectory,
)
from spacerobot_ros.planning.methods.optimal.search import (
    ManoeuvreSearch,
    MotionSearch,
    _durations_agree,
    _SearchState,
)
from spacerobot_ros.resources import robot_file

Array = npt.NDArray[np.float64]

PERIOD = 0.05
IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
START, FINAL = np.array([0.3, -0.2]), np.array([0.5, 0.4])
BOUNDARY = BoundaryConditions(START, IDENTITY, FINAL)
LIMITS = MotionLimits(
    np.array([-2.0, -3.0]), np.array([2.5, 3.5]), np.array([0.8, 1.2]), np.array([1.6, 0.9])
)
OPTIONS = replace(OptimalOptions(), starts=7, answers=4, agreeing=3, iterations=55, longest=90.0)


def path(duration: float) -> Trajectory:
    """Return a rest-to-rest trajectory of two steps that keeps far from its limits."""
    shapes = np.array([START, (START + FINAL) / 2, FINAL])
    velocities = np.zeros((3, 2))
    velocities[1] = (FINAL - START) / duration
    return Trajectory(duration / 2, shapes, velocities, np.tile(IDENTITY, (3, 1)))


@dataclass
class Call:
    """What a solver was asked."""

    limits: MotionLimits
    guess: Trajectory
    stop: StopRule
    bounds: DurationBounds
    near: Neighbourhood | None = None


@dataclass
class Solver:
    """A solver whose answers are a script: durations, or None for no solution."""

    intervals: int
    script: Iterator[float | None] = field(default_factory=lambda: iter(()))
    converged: bool = True
    iterations: int = 3
    turn: Any = None
    lack: float = 0.0
    calls: list[Call] = field(default_factory=list)

    def solve(
        self,
        _: object,
        limits: MotionLimits,
        guess: Trajectory,
        stop: StopRule,
        bounds: Any,
        near: Neighbourhood | None = None,
    ) -> Trajectory | None:
        self.calls.append(Call(limits, guess, stop, bounds, near))
        duration = next(self.script, None)
        return None if duration is None else path(duration)


class Guesses:
    """Guesses that go on for ever, of 10 s each, and one of 6 s from what is given."""

    def generate(self, *_: object) -> Iterator[Trajectory]:
        while True:
            yield path(10.0)

    def from_shapes(self, *_: object) -> Trajectory:
        return path(6.0)

    def from_ticks(self, *_: object) -> Trajectory:
        return path(6.0)

    def with_initial_velocity(self, guess: Trajectory, *_: object) -> Trajectory:
        return guess

    def resample(self, solution: Trajectory) -> Trajectory:
        return solution


class Holder:
    """Commands that take the time of a trajectory, rounded up to ticks; or none, by a script."""

    def __init__(self) -> None:
        self.refused = 0
        self.asked: list[dict[str, Any]] = []

    def hold(self, trajectory: Trajectory, *_: object, **asked: Any) -> HeldCommands | None:
        self.asked.append(asked)
        if self.refused > 0:
            self.refused -= 1
            return None
        ticks = math.ceil(trajectory.duration / PERIOD - 1e-6)
        return HeldCommands(trajectory.at_ticks(ticks), np.tile(IDENTITY, (ticks + 1, 1)), 0.0)


@pytest.fixture(scope="module")
def model() -> ManoeuvreModel:
    chain = SpaceRobot.from_file(robot_file("planar_chain"))
    constraints = PathConstraints.of(chain, OptimalOptions())
    return ManoeuvreModel(
        chain, BasePrediction(chain, PERIOD, 0.01), PERIOD, np.eye(3)[2:], constraints
    )


@pytest.fixture(autouse=True)
def _scripted_guesses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_build_guesses", lambda *_: Guesses())


class Search(ManoeuvreSearch):
    """A search from rest with scripted solvers, by their intervals."""

    def __init__(self, model: ManoeuvreModel, **scripts: Sequence[float | None]) -> None:
        super().__init__(model)
        self.holder = Holder()
        self._holder = self.holder  # type: ignore[assignment]
        self.scripted = {
            int(name[1:]): Solver(int(name[1:]), iter(script)) for name, script in scripts.items()
        }
        self.tolerances: list[tuple[int, float]] = []

    def solver(  # type: ignore[override]
        self,
        intervals: int,
        position: bool,
        tolerance: float = TOLERANCE,
        pairs: tuple[int, ...] = (),
        *,
        drifting: bool = False,
        planes: bool = False,
    ) -> Solver:
        assert not drifting
        self.tolerances.append((intervals, tolerance))
        return self.scripted.setdefault(intervals, Solver(intervals))


# -- from rest ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("intervals", "answers", "grids"),
    [
        (80, 4, [(80, 1e-5), (16, 1e-4)]),
        (40, 2, [(40, 1e-5), (8, 1e-4)]),
        (39, 2, [(39, 1e-5)]),
        (80, 1, [(80, 1e-5)]),
    ],
)
def test_several_answers_are_sought_on_a_fifth_of_the_intervals(
    model: ManoeuvreModel, intervals: int, answers: int, grids: list[tuple[int, float]]
) -> None:
    fine, coarse = grids[0][0], grids[-1][0]
    scripts = {f"n{fine}": [9.0, 9.5], f"n{coarse}": [5.0] * 9}
    search = Search(model, **scripts)
    options = replace(OPTIONS, answers=answers, agreeing=0)
    found = search.search(BOUNDARY, LIMITS, IDENTITY, intervals, options)
    assert search.tolerances == grids
    assert found.starts == answers
    # Solutions of the same time are the same: one is refined.
    refined = 0 if fine == coarse else 1
    assert len(search.scripted[coarse].calls) == answers
    assert len(search.scripted[fine].calls) == (refined or answers)
    assert found.solutions == [pytest.approx(9.0 if refined else 5.0)]


@pytest.mark.parametrize(("starts", "more"), [(7, 3), (2, 2)])
def test_a_coarse_grid_without_solutions_is_followed_by_three_guesses_on_the_full_one(
    model: ManoeuvreModel, starts: int, more: int
) -> None:
    search = Search(model)
    with pytest.raises(NotFoundError) as refusal:
        search.search(BOUNDARY, LIMITS, IDENTITY, 80, replace(OPTIONS, starts=starts))
    assert str(refusal.value) == (
        f"No manoeuvre to the goal was found from {starts + more} start(s): the solver found no "
        "path within the limits. More optimal.starts, optimal.iterations or optimal.intervals, a "
        "longer optimal.longest, or a smaller goal may help."
    )
    assert [len(search.scripted[n].calls) for n in (16, 80)] == [starts, more]


def test_a_refusal_names_the_last_reason_and_the_limits_that_were_in_the_way(
    model: ManoeuvreModel,
) -> None:
    search = Search(model, n20=[5.0, None, 6.0])
    search.holder.refused = 9
    options = replace(OPTIONS, starts=3, answers=3, duration=6.0, time_budget=1e-9)
    with pytest.raises(NotFoundError) as refusal:
        search.search(BOUNDARY, LIMITS, IDENTITY, 20, options)
    # The time was up after the first start.
    assert str(refusal.value) == (
        "No manoeuvre to the goal was found from 1 start(s) within optimal.time_budget 1e-09 s: "
        "held commands could not be brought to the goal within the limits. A longer "
        "optimal.time_budget, more optimal.starts, optimal.iterations or optimal.intervals, a "
        "longer optimal.duration, or a smaller goal may help."
    )


def test_solutions_that_cannot_be_commanded_are_followed_by_guesses_one_by_one(
    model: ManoeuvreModel,
) -> None:
    search = Search(model, n20=[5.0, 5.1, 6.0, 7.0, 8.0])
    search.holder.refused = 3
    options = replace(OPTIONS, starts=7, answers=3, agreeing=0)
    found = search.search(BOUNDARY, LIMITS, IDENTITY, 20, options)
    # The three of the first round are refused; the fourth guess alone makes the next round.
    assert found.starts == 4
    assert found.duration == pytest.approx(7.0)


def test_the_shortest_manoeuvre_of_two_control_periods_must_be_allowed(
    model: ManoeuvreModel,
) -> None:
    search = Search(model, n20=[0.1])
    exact = replace(OPTIONS, answers=1)
    object.__setattr__(exact, "longest", 0.1)
    assert search.search(BOUNDARY, LIMITS, IDENTITY, 20, exact).duration == pytest.approx(0.1)
    object.__setattr__(exact, "longest", 0.09)
    with pytest.raises(PlanningError) as refusal:
        search.search(BOUNDARY, LIMITS, IDENTITY, 20, exact)
    assert str(refusal.value) == (
        "Manoeuvres take at least 2 control periods of 0.05 s, more than optimal.longest = 0.09 s."
    )


@pytest.mark.parametrize(
    ("coarse", "fine", "refined"),
    [
        # Costs within a tenth of the best, and two at most.
        ([5.0, 5.4, 5.45, 5.49], [6.0, 6.5], 2),
        ([5.0, 5.51, 5.6, 5.7], [6.0], 1),
        # 5.004 is the same solution as 5.0; 5.006 is another one.
        ([5.0, 5.004, 5.6, 5.7], [6.0], 1),
        ([5.0, 5.006, 5.6, 5.7], [6.0, 6.1], 2),
    ],
)
def test_solutions_nearly_as_good_as_the_best_are_refined(
    model: ManoeuvreModel, coarse: list[float], fine: list[float], refined: int
) -> None:
    search = Search(model, n16=coarse, n80=fine)
    options = replace(OPTIONS, agreeing=0)
    found = search.search(BOUNDARY, LIMITS, IDENTITY, 80, options)
    assert len(search.scripted[80].calls) == refined == len(found.solutions)
    assert found.duration == pytest.approx(min(fine))
    assert (found.starts, found.cut_short, found.separated_pairs) == (4, False, 0)


@pytest.mark.parametrize(
    ("durations", "starts"),
    [
        ([5.0, 5.014, 5.0149, 5.3], 3),
        ([5.0, 5.014, 5.016, 5.3], 4),
        ([5.3, 5.01, 5.0, 5.0], 4),
    ],
)
def test_three_solutions_within_three_thousandths_end_a_search(
    model: ManoeuvreModel, durations: list[float], starts: int
) -> None:
    search = Search(model, n20=durations)
    found = search.search(BOUNDARY, LIMITS, IDENTITY, 20, replace(OPTIONS, answers=4))
    assert found.starts == starts


def progress(**changes: Any) -> _SearchState:
    options = replace(OPTIONS, **changes)
    return _SearchState(BOUNDARY, LIMITS, IDENTITY, options, NEVER, None, gentle=False)


def test_solutions_agree_by_number_and_two_are_enough_with_a_guess() -> None:
    same = [path(5.0)] * 5
    assert progress(agreeing=5).solutions_agree(same)
    assert not progress(agreeing=5).solutions_agree(same[1:])
    assert not progress(agreeing=0).solutions_agree(same)
    assert not progress(agreeing=1).solutions_agree([])
    with_guess = progress(agreeing=5)
    with_guess.guess = np.zeros((4, 2))
    assert with_guess.solutions_agree(same[:2])
    assert not with_guess.solutions_agree(same[:1])
    one = progress(agreeing=1)
    one.guess = with_guess.guess
    assert one.solutions_agree(same[:1])


def test_a_given_guess_is_the_first(model: ManoeuvreModel) -> None:
    search = Search(model, n20=[5.0, 5.5, 5.8])
    options = replace(OPTIONS, starts=3, answers=9)
    search.search(BOUNDARY, LIMITS, IDENTITY, 20, options, guess=np.zeros((4, 2)))
    guessed = [call.guess.duration for call in search.scripted[20].calls]
    np.testing.assert_allclose(guessed, [6.0, 10.0, 10.0])


def test_the_cost_is_the_time_or_the_effort_in_a_given_time() -> None:
    trajectory = path(4.0)
    assert progress().cost(trajectory) == 4.0
    # The change of 0.05 and 0.15 a second in 2 s, over the speeds, to and fro.
    effort = (0.05 / 2 / 0.8) ** 2 + (0.15 / 2 / 1.2) ** 2
    given = progress(duration=4.0)
    assert given.cost(trajectory) == pytest.approx(effort)
    given.limits = replace(LIMITS, velocity=np.array([0.8, np.inf]))
    effort = (0.05 / 2 / 0.8) ** 2 + (0.15 / 2) ** 2
    assert given.cost(trajectory) == pytest.approx(effort)


def test_wall_time_is_unlimited_or_five_times_as_long_without_a_solution() -> None:
    free = progress().stop_rule(found=False)
    assert (free.iterations, free.deadline, free.last_call) == (55, math.inf, math.inf)
    limited = progress(time_budget=8.0)
    limited._began = 100.0
    before, after = (limited.stop_rule(found=found) for found in (False, True))
    assert (before.deadline, before.last_call) == (108.0, 140.0)
    assert (after.deadline, after.last_call) == (108.0, 108.0)


def test_wall_time_is_up_after_its_instant(monkeypatch: pytest.MonkeyPatch) -> None:
    limited = progress(time_budget=8.0)
    limited._began = 100.0
    for now, found, late in (
        (108.0, True, False), (108.1, True, True), (139.9, False, False), (140.1, False, True),
    ):  # fmt: skip
        monkeypatch.setattr("time.monotonic", lambda now=now: now)
        assert limited.cut_short(found=found) is late


@pytest.mark.parametrize(
    ("changes", "gentle", "guess", "bounds", "guess_duration", "share"),
    [
        # As fast as possible: from two ticks to the longest.
        ({}, False, 10.0, (0.1, 90.0), 10.0, 1.0),
        # In a given time, in whole periods: limits have a reserve of a hundredth.
        ({"duration": 7.03}, False, 10.0, (7.05, 7.05), 7.05, 0.99),
        ({"duration": 0.01}, False, 10.0, (0.05, 0.05), 0.05, 0.99),
        # Gently: in four times the time of the guess, in a second at least.
        ({}, True, 10.0, (40.0, 40.0), 40.0, 1.0),
        ({}, True, 0.1, (1.0, 1.0), 1.0, 1.0),
        ({"duration": 7.03}, True, 10.0, (7.05, 7.05), 7.05, 0.99),
    ],
)
def test_a_guess_is_solved_for_within_bounds_of_its_duration(
    model: ManoeuvreModel,
    changes: dict[str, Any],
    gentle: bool,
    guess: float,
    bounds: tuple[float, float],
    guess_duration: float,
    share: float,
) -> None:
    search, solver = Search(model), Solver(20, iter([5.0]))
    asked = progress(**changes)
    asked.gentle = gentle
    solution = search._solve_from_guess(asked, solver, path(guess), StopRule(9))  # type: ignore[arg-type]
    (call,) = solver.calls
    assert (call.bounds.shortest, call.bounds.longest) == pytest.approx(bounds)
    assert call.guess.duration == pytest.approx(guess_duration)
    np.testing.assert_allclose(call.limits.velocity, share * LIMITS.velocity)
    np.testing.assert_allclose(call.limits.acceleration, share * LIMITS.acceleration)
    assert solution is not None
    if not gentle:
        assert solution.duration == pytest.approx(5.0)
        return
    # At full speed along the same path, in a second at least.
    velocity = 0.6 / 5.0
    change = velocity / 2.5 / (0.99 * 0.9 if changes else 0.9)
    speed = velocity / (0.99 * 1.2 if changes else 1.2)
    fastest = 5.0 * max(speed, math.sqrt(change), 1.0 / 5.0)
    assert solution.duration == pytest.approx(fastest)


def test_a_solution_without_convergence_is_flown_at_full_speed(model: ManoeuvreModel) -> None:
    for converged, duration in ((True, 5.0), (False, 5.0 * math.sqrt(0.12 / 2.5 / 0.9))):
        solver = Solver(20, iter([5.0]), converged=converged)
        found = Search(model)._solve_from_guess(progress(), solver, path(9.0), StopRule(9))  # type: ignore[arg-type]
        assert found is not None
        assert found.duration == pytest.approx(duration)
    turns_slowly = replace(model, constraints=replace(model.constraints, base_rate_limit=0.3))
    solver = Solver(20, iter([5.0]), converged=False)
    found = Search(turns_slowly)._solve_from_guess(progress(), solver, path(9.0), StopRule(9))  # type: ignore[arg-type]
    assert found is not None
    assert found.duration == pytest.approx(5.0), "a faster one would turn the base faster"


def test_a_given_time_fixes_the_commands(model: ManoeuvreModel) -> None:
    for duration, fixed in ((0.0, False), (5.0, True)):
        search = Search(model, n20=[5.0])
        options = replace(OPTIONS, answers=1, duration=duration)
        search.search(BOUNDARY, LIMITS, IDENTITY, 20, options)
        assert search.holder.asked == [{"fixed": fixed}]


@pytest.mark.parametrize(("intervals", "instants"), [(80, 2), (30, 3), (20, 4), (16, 5), (100, 2)])
def test_links_are_kept_apart_at_eighty_instants_at_least(
    model: ManoeuvreModel, monkeypatch: pytest.MonkeyPatch, intervals: int, instants: int
) -> None:
    asked: list[tuple[Any, ...]] = []

    class Stages:
        @classmethod
        def of(cls, *_: object, **__: object) -> Stages:
            return cls()

        def with_distances(self, rows: object, instants: int) -> str:
            asked.append((rows, instants))
            return "kept apart"

    monkeypatch.setattr(module, "Stages", Stages)
    monkeypatch.setattr(module, "MultipleShooting", lambda *made: made)
    library = SimpleNamespace(of=lambda pairs, planes: [*pairs, planes])
    apart = replace(model, distances=library)  # type: ignore[arg-type]
    search: Any = ManoeuvreSearch(apart)
    made = search.solver(intervals, False, 1e-4, (3, 5))
    assert made == ("kept apart", intervals, 1e-4)
    assert asked == [([3, 5, False], instants)]
    assert search.solver(intervals, False, 1e-4, (3, 5), planes=True) is not made
    assert asked[1] == ([3, 5, True], instants)
    assert search.solver(intervals, False, 1e-4, (3, 5)) is made
    assert search.solver(intervals, True, 1e-4, (3, 5)) is not made
    assert isinstance(search.solver(intervals, False)[0], Stages)
    assert search.solver(intervals, False)[1:] == (intervals, 1e-5)


# -- in motion ----------------------------------------------------------------------------------


REMAINING = np.array([START, [0.31, -0.17], FINAL])
MOTION = InitialMotion(np.array([0.1, 0.5]), REMAINING)


class InMotion(MotionSearch):
    """A search in motion with scripted solvers, by their intervals."""

    def __init__(self, model: ManoeuvreModel, **scripts: Sequence[float | None]) -> None:
        self.scripted = {
            int(name[1:]): Solver(int(name[1:]), iter(script)) for name, script in scripts.items()
        }
        self.asked: list[tuple[Any, ...]] = []

        def solver(*asked: Any, drifting: bool = False) -> Any:
            assert not drifting
            self.asked.append(asked)
            return self.scripted.setdefault(asked[0], Solver(asked[0]))

        super().__init__(model, solver)
        self.holder = Holder()
        self._holder = self.holder  # type: ignore[assignment]


def test_planned_speeds_leave_a_fiftieth_or_a_quarter_of_a_periods_braking(
    model: ManoeuvreModel,
) -> None:
    search = InMotion(model)
    limits = replace(LIMITS, acceleration=np.array([1.6, 0.9]))
    # 0.02 * 0.8 < 1.6 * 0.05 / 4, and 0.9 * 0.05 / 4 < 0.02 * 1.2.
    planned = search._planned_speed_limit(limits)
    np.testing.assert_allclose(planned, [0.8 - 0.016, 1.2 - 0.01125])
    endless = replace(limits, velocity=np.array([np.inf, 1.2]))
    np.testing.assert_allclose(search._planned_speed_limit(endless), [np.inf, 1.2 - 0.01125])
    narrowed = search._narrow_limits(limits, 0.7)
    np.testing.assert_allclose(narrowed.velocity, planned)
    np.testing.assert_allclose(narrowed.acceleration, 0.7 * limits.acceleration)


def test_a_motion_begins_between_the_velocities_before_and_after(model: ManoeuvreModel) -> None:
    search = InMotion(model)
    begins = search._initial_velocity(MOTION, LIMITS)
    np.testing.assert_allclose(begins, [(0.1 + 0.2) / 2, (0.5 + 0.6) / 2])
    ends = InitialMotion(np.array([0.1, 0.5]), REMAINING[:1])
    np.testing.assert_allclose(search._initial_velocity(ends, LIMITS), [0.1, 0.5])
    fast = InitialMotion(np.array([-0.8, 1.2]), REMAINING[:1])
    np.testing.assert_allclose(
        search._initial_velocity(fast, LIMITS), [-(0.8 - 0.016), 1.2 - 0.01125]
    )


@pytest.mark.parametrize(
    ("intervals", "answers", "grids"),
    [(44, 1, (11, 11)), (40, 2, (10, 40)), (39, 2, (39, 39)), (47, 2, (11, 47))],
)
def test_in_motion_a_quarter_of_the_intervals_is_enough_for_the_way(
    model: ManoeuvreModel, intervals: int, answers: int, grids: tuple[int, int]
) -> None:
    scripts = {f"n{n}": [5.0, 5.3, 5.2, 5.2] for n in grids}
    search = InMotion(model, **scripts)
    options = replace(OPTIONS, answers=answers)
    found = search.search(BOUNDARY, LIMITS, IDENTITY, intervals, options, MOTION)
    assert search.asked == [(n, False, TOLERANCE, ()) for n in grids]
    assert found.starts == answers
    # The rest of the motion so far is the first guess.
    guesses = [each.guess.duration for each in search.scripted[grids[0]].calls[:answers]]
    np.testing.assert_allclose(guesses, [6.0, 10.0][:answers])
    first = search.scripted[grids[0]].calls[0]
    assert (first.bounds.shortest, first.bounds.longest) == pytest.approx((4 * PERIOD, 90.0))
    np.testing.assert_allclose(first.limits.acceleration, 0.98 * LIMITS.acceleration)
    assert search.holder.asked[0]["fixed"] is True
    np.testing.assert_array_equal(search.holder.asked[0]["before"], MOTION.velocity)


def test_all_acceleration_is_used_where_less_finds_no_way(model: ManoeuvreModel) -> None:
    search: Any = InMotion(model)
    solver = Solver(11, iter([None, 5.0]))
    asked: tuple[Any, ...] = (BOUNDARY, LIMITS, path(6.0), StopRule(9))
    found = search._find_fastest(solver, *asked, replace(OPTIONS, longest=1.0))
    assert found is not None
    shares = [call.limits.acceleration / LIMITS.acceleration for call in solver.calls]
    np.testing.assert_allclose(shares, [[0.98, 0.98], [1.0, 1.0]])
    assert search._find_fastest(solver, *asked, OPTIONS) is None
    assert len(solver.calls) == 4
    short = replace(OPTIONS)
    object.__setattr__(short, "longest", 0.15)
    search._find_fastest(solver, *asked, short)
    assert solver.calls[-1].bounds == DurationBounds(0.15, 0.15)


def test_commands_in_motion_take_a_few_ticks_more_where_they_must(model: ManoeuvreModel) -> None:
    search: Any = InMotion(model)
    search.holder.refused = 99
    solver = Solver(11, iter([2.51] + [2.6] * 20))
    asked: tuple[Any, ...] = (BOUNDARY, LIMITS, path(6.0), MOTION)
    with pytest.raises(PlanningError, match=r"^held commands could not be brought to the goal"):
        search._make_held_commands(solver, *asked, OPTIONS, StopRule(9))
    calls = solver.calls[1:]
    # 51 ticks, then 1, 3 and 7 more, each with two shares of the accelerations.
    np.testing.assert_allclose(
        [call.bounds.shortest / PERIOD for call in calls], [51, 51, 52, 52, 54, 54, 58, 58]
    )
    assert all(call.bounds.fixed for call in calls)
    np.testing.assert_allclose(
        [c.guess.step * 11 for c in calls], [c.bounds.shortest for c in calls]
    )
    shares = [float(call.limits.acceleration[0] / LIMITS.acceleration[0]) for call in calls]
    np.testing.assert_allclose(shares, [0.98, 1.0] * 4)


def test_a_given_time_in_motion_has_no_more_ticks(model: ManoeuvreModel) -> None:
    search: Any = InMotion(model)
    search.holder.refused = 99
    solver = Solver(11, iter([2.6] * 20))
    options = replace(OPTIONS, duration=2.48)
    asked: tuple[Any, ...] = (BOUNDARY, LIMITS, path(6.0), MOTION)
    with pytest.raises(PlanningError, match=r"^held commands could not be brought to the goal"):
        search._make_held_commands(solver, *asked, options, StopRule(9))
    np.testing.assert_allclose([c.bounds.shortest for c in solver.calls], [2.5, 2.5])


def test_of_the_ways_in_motion_the_three_fastest_are_made_into_commands(
    model: ManoeuvreModel,
) -> None:
    search = InMotion(model, n20=[5.0, 4.0, 6.0, 7.0])
    search.holder.refused = 999
    options = replace(OPTIONS, starts=5, answers=4)
    with pytest.raises(NotFoundError) as refusal:
        search.search(BOUNDARY, LIMITS, IDENTITY, 20, options, MOTION)
    assert str(refusal.value) == (
        "No manoeuvre to the goal that begins in motion was found from 4 start(s): held commands "
        "could not be brought to the goal within the limits."
    )
    bounds = [c.bounds for c in search.scripted[20].calls]
    # Each is solved for once more at its own start, which the script does not answer.
    assert sum(not each.fixed for each in bounds[4:]) == 2 * 3
    fixed = list(dict.fromkeys(round(b.shortest / PERIOD) for b in bounds[4:] if b.fixed))
    assert fixed == [80, 81, 83, 87, 100, 101, 103, 107, 120, 121, 123, 127]


def test_a_search_in_motion_without_any_way_says_so(model: ManoeuvreModel) -> None:
    with pytest.raises(NotFoundError) as refusal:
        InMotion(model).search(BOUNDARY, LIMITS, IDENTITY, 20, replace(OPTIONS, starts=2), MOTION)
    assert str(refusal.value) == (
        "No manoeuvre to the goal that begins in motion was found from 2 start(s): the solver "
        "found no path within the limits."
    )


def test_the_fastest_way_in_motion_is_taken(model: ManoeuvreModel) -> None:
    search = InMotion(model, n20=[5.0, 4.0, 4.5, 4.0, 3.9])
    options = replace(OPTIONS, answers=3)
    found = search.search(BOUNDARY, LIMITS, IDENTITY, 20, options, MOTION)
    assert found.starts == 3
    assert found.solutions == pytest.approx([5.0, 4.0, 4.5])
    assert found.solution_time == pytest.approx(4.0)
    # It was solved for again, in 4 s, and then in as many ticks, 3.9 s of the script.
    assert found.duration == pytest.approx(3.9)
    assert len(search.scripted[20].calls) == 5


@pytest.mark.parametrize(
    ("durations", "agree"),
    [
        ([4.0, 4.0, 4.0], True),
        ([4.0, 4.0], False),
        ([4.004, 4.0, 4.0039], True),
        ([4.005, 4.0, 4.0], False),
        ([5.0, 4.0, 5.0, 4.0, 4.0], True),
        ([], False),
    ],
)
def test_three_ways_of_the_same_time_agree_in_motion(durations: list[float], agree: bool) -> None:
    assert _durations_agree([path(each) for each in durations]) is agree
