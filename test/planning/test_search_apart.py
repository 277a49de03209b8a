"""Manoeuvres that come too near, and drifting ones in whole ticks: which problems are solved.

Solvers, distances and held commands are stand-ins; a manoeuvre is told by its duration.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from planning.test_search import (
    BOUNDARY,
    IDENTITY,
    LIMITS,
    OPTIONS,
    PERIOD,
    Array,
    Guesses,
    Holder,
    Search,
    Solver,
    path,
)

from spacerobot_ros.collision import Approach, LinkPair
from spacerobot_ros.errors import NotFoundError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.cancellation import NEVER
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.methods.optimal import search as module
from spacerobot_ros.planning.methods.optimal.held_commands import (
    CommandHolder,
    HeldCommands,
    ManoeuvreModel,
)
from spacerobot_ros.planning.methods.optimal.multiple_shooting import TOLERANCE, Neighbourhood
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    PathConstraints,
    Trajectory,
    UnusableCandidateError,
)
from spacerobot_ros.planning.methods.optimal.search import (
    Manoeuvre,
    _SearchState,
)
from spacerobot_ros.resources import robot_file


@pytest.fixture(scope="module")
def model() -> ManoeuvreModel:
    chain = SpaceRobot.from_file(robot_file("planar_chain"))
    prediction = BasePrediction(chain, PERIOD, 0.01)
    return ManoeuvreModel(chain, prediction, PERIOD, np.eye(3)[2:], PathConstraints())


@pytest.fixture(autouse=True)
def _scripted_guesses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_build_guesses", lambda *_: Guesses())


class Kept:
    """Pairs that are kept apart; distances of manoeuvres by their duration.

    ``too_far``: the pairs that keep more distance than they need to, by the duration.
    """

    def __init__(
        self,
        distances: dict[float, list[float]],
        rooms: dict[int, int],
        too_far: dict[float, list[int]] | None = None,
    ) -> None:
        self.distances, self.rooms, self.too_far = distances, rooms, too_far or {}
        self.spent: list[float] = []
        self.has_planes = False

    @property
    def pairs(self) -> tuple[int, ...]:
        return tuple(sorted(self.rooms))

    def approaches(self, positions: Array, _: Array) -> list[Approach]:
        duration = round((len(positions) - 1) * PERIOD, 6)
        near = self.distances.get(duration, [])
        return [
            Approach(LinkPair("a", "b"), pair, d, 3.0, positions[0]) for pair, d in enumerate(near)
        ]

    def message(self, approach: Approach, period: float) -> str:
        return f"pair {approach.pair} is {approach.distance} m apart, {period} s"

    def include(self, other: Kept) -> None:
        self.rooms |= other.rooms

    def copy(self) -> Kept:
        return Kept(self.distances, dict(self.rooms), self.too_far)

    def add(self, near: Sequence[Approach]) -> None:
        for each in near:
            self.rooms[each.pair] = self.rooms.get(each.pair, 0) + 1

    def reduce_margins(self, positions: Array, _: Array) -> bool:
        duration = round((len(positions) - 1) * PERIOD, 6)
        self.spent.append(duration)
        less = self.too_far.get(duration, [])
        for pair in less:
            self.rooms[pair] -= 1
        return bool(less)

    def by_planes(self) -> Kept:
        other = Kept(self.distances, {})
        other.has_planes = True
        return other

    def within(self, limits: MotionLimits, _: object = None) -> MotionLimits:
        return replace(limits, distances=np.array([float(self.rooms[p]) for p in self.pairs]))


scripted_path = path


class Apart(Search):
    """A search with scripted solvers that notes which pairs they keep apart."""

    def __init__(self, model: ManoeuvreModel, kept: Kept, **scripts: Any) -> None:
        super().__init__(model, **scripts)
        self._begin = lambda _: kept  # type: ignore[assignment, return-value]
        self.separated_pairs: list[tuple[int, float, tuple[int, ...]]] = []
        self.coarse: list[tuple[float, bool]] = []
        self.by_planes: list[float | None] = []

    def _clear_coarsely(self, state: Any, path: Trajectory, intervals: int) -> Any:
        """Return a path by planes, by a script; none without one."""
        self.coarse.append((round(path.duration, 6), state.kept.has_planes))
        duration = self.by_planes.pop(0) if self.by_planes else None
        if duration is None:
            raise UnusableCandidateError("planes are in the way")
        return state, scripted_path(duration)

    def _clear_finely(self, state: Any, path: Trajectory, intervals: int) -> Manoeuvre:
        assert state.kept.has_planes
        return replace(made(path.duration), separated_pairs=7)

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
        assert not planes
        if pairs:
            self.separated_pairs.append((intervals, tolerance, pairs))
        return super().solver(intervals, position, tolerance, drifting=False)


def made(duration: float) -> Manoeuvre:
    held = Holder().hold(path(duration))
    assert held is not None
    return Manoeuvre(held, duration, path(duration))


def progress(kept: Kept, boundary: BoundaryConditions = BOUNDARY, **changes: Any) -> Any:
    options = replace(OPTIONS, **changes)
    asked = _SearchState(boundary, LIMITS, IDENTITY, options, NEVER, None, gentle=False)
    asked.kept = kept  # type: ignore[assignment]
    return asked


def test_what_keeps_clear_is_left_as_it_is(model: ManoeuvreModel) -> None:
    kept = Kept({9.0: [-0.01]}, {})
    search = Apart(model, kept, n40=[1.0])
    found = [made(9.0), made(8.0)]
    assert search._keep_clear(progress(kept), found, 40) is found
    assert not search.separated_pairs


def test_a_shallow_contact_is_solved_for_on_the_full_grid_with_a_pair_more_each_time(
    model: ManoeuvreModel,
) -> None:
    kept = Kept({8.0: [-0.019], 8.2: [0.004, -0.01], 8.4: [-0.01]}, {})
    search = Apart(model, kept, n40=[8.2, 8.4, 8.6])
    found = search._keep_clear(progress(kept), [made(8.0), made(8.65), made(8.5)], 40)
    assert search.separated_pairs == [(40, 1e-5, (0,)), (40, 1e-5, (0, 1)), (40, 1e-5, (0, 1))]
    # Each solution is the guess of the next one, and distances have room for what was missing.
    calls = search.scripted[40].calls
    assert [call.guess.duration for call in calls] == pytest.approx([8.0, 8.2, 8.4])
    assert [list(call.limits.distances) for call in calls] == [[1], [2, 1], [3, 1]]
    # One that was found, keeps clear and is faster than the first freed one counts, too.
    assert [each.duration for each in found] == pytest.approx([8.6, 8.5])
    assert [each.separated_pairs for each in found] == [2, 0]
    # Pairs of one manoeuvre are not those of the next.
    assert kept.rooms == {}


@pytest.mark.parametrize(
    ("solutions", "rooms", "expected"),
    [
        # Too near, so it gets room again; then farther than it need, and a third solution.
        ([8.5, 8.6, 8.3], [[2, 1], [3, 2], [3, 1]], 8.3),
        ([8.5, 8.6, 8.56], [[2, 1], [3, 2], [3, 1]], 8.6),
        # Not a period faster than the best one; none; no more rooms to spend.
        ([8.79], [[2, 1]], 8.8),
        ([None], [[2, 1]], 8.8),
        ([8.4], [[2, 1]], 8.4),
    ],
)
def test_a_manoeuvre_that_keeps_more_distance_than_it_needs_to_is_made_faster(
    model: ManoeuvreModel, solutions: list[float | None], rooms: list[list[int]], expected: float
) -> None:
    kept = Kept({8.5: [0.009, 0.008]}, {0: 2, 1: 2}, {8.8: [1], 8.6: [1]})
    search = Apart(model, kept, n40=solutions)
    asked = progress(kept, iterations=90)
    found = search._shorten_with_less_clearance(asked, made(8.8), 40)
    assert found.duration == pytest.approx(expected)
    calls = search.scripted[40].calls
    assert [list(call.limits.distances) for call in calls] == rooms
    assert kept.rooms == {0: 2, 1: 2}


def test_no_slower_manoeuvre_is_freed_than_the_first(model: ManoeuvreModel) -> None:
    kept = Kept({8.0: [0.0], 8.3: [0.0]}, {})
    search = Apart(model, kept, n40=[8.2])
    (only,) = search._keep_clear(progress(kept), [made(8.3), made(8.0)], 40)
    assert only.duration == pytest.approx(8.2)


@pytest.mark.parametrize(
    ("fine", "expected"),
    [([8.4], 8.4), ([8.9], 8.7), ([None], 8.7), ([8.5] * 6, 8.7)],
)
def test_the_way_round_a_deep_contact_is_found_on_a_coarse_grid(
    model: ManoeuvreModel, fine: list[float | None], expected: float
) -> None:
    kept = Kept({8.0: [-0.02], 8.5: [-0.001]}, {})
    search = Apart(model, kept, n40=fine, n8=[8.7])
    (found,) = search._keep_clear(progress(kept, iterations=90), [made(8.0)], 40)
    assert search.separated_pairs[0] == (8, 1e-4, (0,))
    assert all(each == (40, 1e-5, (0,)) for each in search.separated_pairs[1:])
    assert found.duration == pytest.approx(expected)
    # What is solved for on the full grid begins near it: it takes few steps.
    (coarse,), (first, *_) = search.scripted[8].calls, search.scripted[40].calls
    assert (coarse.stop.iterations, first.stop.iterations) == (90, 80)
    assert first.guess.duration == pytest.approx(8.7)
    # Where the coarse one keeps clear already, no pair is new: it has the room that it had.
    assert list(first.limits.distances) == [1]


@pytest.mark.parametrize(("intervals", "drifts"), [(39, False), (40, True)])
def test_small_problems_and_drifting_robots_have_no_coarse_grid(
    model: ManoeuvreModel, intervals: int, drifts: bool
) -> None:
    kept = Kept({8.0: [-0.3]}, {})
    search: Any = Apart(model, kept, **{f"n{intervals}": [8.7, 8.7]})
    momentum = np.array([0.0, 0.0, 0.1]) if drifts else np.zeros(3)
    boundary = replace(BOUNDARY, angular_momentum=momentum)
    assert boundary.drifts is drifts
    search._hold_in_whole_ticks = lambda _, trajectory: Holder().hold(trajectory)
    (found,) = search._keep_clear(progress(kept, boundary), [made(8.0)], intervals)
    assert {each[0] for each in search.separated_pairs} == {intervals}
    assert found.duration == pytest.approx(8.7)


def test_after_six_solutions_that_are_too_near_new_guesses_keep_their_pairs_apart(
    model: ManoeuvreModel,
) -> None:
    kept = Kept({8.0: [-0.01, 0.001], 8.1: [0.002]}, {})
    # Six that are too near; seven guesses that need not keep clear, without a solution; then those
    # that must on the coarse grid, and one of them on the full grid.
    search = Apart(model, kept, n40=[8.1] * 6 + [9.0], n8=[None] * 7 + [8.8] * 3)
    asked = progress(kept)
    (found,) = search._keep_clear(asked, [made(8.0)], 40)
    assert search.separated_pairs[:6] == [(40, 1e-5, (0, 1))] * 6
    assert search.separated_pairs[6:8] == [(40, 1e-5, (0, 1)), (8, 1e-4, (0, 1))]
    assert kept.rooms == {0: 6, 1: 1}
    assert list(asked.limits.distances) == [6, 1]
    assert asked.starts == 7 + 2
    assert asked.options.answers == 2
    assert found.duration == pytest.approx(9.0)


@pytest.mark.parametrize(
    ("smooth", "by_planes", "expected", "asked"),
    [
        # Within a twentieth no other is looked for.
        ([8.4], [], [8.4], []),
        ([8.45], [8.3], [8.45, 8.3], [8.0]),
        ([8.45], [None], [8.45], [8.0]),
        ([None], [8.3], [8.3], [8.0]),
    ],
)
def test_planes_are_for_manoeuvres_that_smooth_rows_make_slow(
    model: ManoeuvreModel,
    smooth: list[float | None],
    by_planes: list[float | None],
    expected: list[float],
    asked: list[float],
) -> None:
    kept = Kept({8.0: [-0.01]}, {})
    search = Apart(model, kept, n40=smooth)
    search.by_planes = by_planes
    found = search._make_clear(progress(kept), made(8.0), 40)
    assert [each.duration for each in found] == pytest.approx(expected)
    assert search.coarse == [(duration, True) for duration in asked]


def test_a_manoeuvre_in_a_given_time_is_not_to_be_faster(model: ManoeuvreModel) -> None:
    kept = Kept({8.0: [-0.01]}, {})
    search: Any = Apart(model, kept, n40=[9.9])
    search._make_held_commands = lambda _, path: made(path.duration)
    (found,) = search._make_clear(progress(kept, duration=9.9), made(8.0), 40)
    assert found.duration == pytest.approx(9.9)
    assert search.coarse == []


def test_other_paths_that_need_not_keep_clear_are_made_clear_by_planes(
    model: ManoeuvreModel,
) -> None:
    kept = Kept({8.0: [-0.01]}, {})
    # The second is known, and the fourth the same as the third within a thousandth.
    search = Apart(model, kept, n40=[None], n8=[8.8, 8.001, 8.5, 8.504, 8.3, 8.2, 8.1])
    search.by_planes = [None, None, 9.6, 9.4, 9.2]
    asked = progress(kept)
    (found,) = search._keep_clear(asked, [made(8.0)], 40)
    assert [duration for duration, _ in search.coarse] == [8.0, 8.8, 8.5, 8.3]
    # Two are enough, and the faster one is made fine.
    assert found.duration == pytest.approx(9.4)
    assert found.separated_pairs == 7
    assert asked.starts == 5


def test_guesses_that_lead_to_known_paths_come_last(model: ManoeuvreModel) -> None:
    kept = Kept({8.0: [-0.01]}, {})
    search = Apart(model, kept, n40=[None], n8=[8.001, 8.8, 8.0, None, 8.801, 7.999, 8.0])
    search.by_planes = [None, None, None, 9.6, 9.4]
    (found,) = search._keep_clear(progress(kept), [made(8.0)], 40)
    # The path, the only other one, and guesses of 10 s.
    assert [duration for duration, _ in search.coarse] == [8.0, 8.8, 10.0, 10.0, 10.0]
    assert found.duration == pytest.approx(9.4)


class Clearing:
    """A clearing of paths that notes the grids and times it is asked for."""

    def __init__(self, *made: Any) -> None:
        self.made = made

    def _named(self) -> tuple[int, float, bool]:
        intervals, tolerance = self.made[2].args[1:]
        return intervals, tolerance, self.made[4] is not None

    def clear(self, path: Trajectory, duration: float) -> Any:
        CALLS.append(("clear", *self._named(), round(path.duration, 6), round(duration, 6)))
        return scripted_path(duration), made(duration) if self.made[4] else None

    def shorten(self, path: Trajectory, held: Any) -> Any:
        CALLS.append(("shorten", *self._named(), round(path.duration, 6), held and held.duration))
        return scripted_path(path.duration / 2), made(path.duration / 2) if held else None


CALLS: list[tuple[Any, ...]] = []


@pytest.mark.parametrize(
    ("intervals", "changes", "calls", "expected"),
    [
        (
            40,
            {},
            [
                ("clear", 8, 1e-4, False, 8.0, 16.0),
                ("shorten", 8, 1e-4, False, 16.0, None),
                ("clear", 40, 1e-5, True, 9.6, 9.6),
                ("shorten", 40, 1e-5, True, 9.6, 9.6),
            ],
            4.8,
        ),
        # No coarse grid.
        (
            39,
            {},
            [("clear", 39, 1e-5, True, 8.0, 16.0), ("shorten", 39, 1e-5, True, 16.0, 16.0)],
            8.0,
        ),
        # In a given time, in whole ticks.
        (40, {"duration": 11.03}, [("clear", 40, 1e-5, True, 8.0, 11.05)], 11.05),
    ],
)
def test_paths_become_clear_and_fast_on_both_grids(
    model: ManoeuvreModel,
    monkeypatch: pytest.MonkeyPatch,
    intervals: int,
    changes: dict[str, Any],
    calls: list[tuple[Any, ...]],
    expected: float,
) -> None:
    monkeypatch.setattr(module, "PathClearing", Clearing)
    monkeypatch.setattr(module, "KeptByPlanes", Kept)
    CALLS.clear()
    kept = Kept({}, {3: 1})
    search = Search(model)
    asked = progress(kept, **changes)
    # Pairs of a path that has become clear on the coarse grid are kept apart.
    asked.kept = Kept({}, {3: 1} if "duration" in changes or intervals == 40 else {})
    coarse = search._clear_coarsely(asked, path(8.0), intervals)
    found = search._clear_finely(*coarse, intervals)
    assert calls == CALLS
    assert found.duration == pytest.approx(expected)
    assert found.separated_pairs == len(asked.kept.pairs)


def test_a_clear_manoeuvre_that_takes_too_long_is_none(
    model: ManoeuvreModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "PathClearing", Clearing)
    monkeypatch.setattr(module, "KeptByPlanes", Kept)
    asked = progress(Kept({}, {}), longest=7.9)
    with pytest.raises(UnusableCandidateError, match="no path"):
        Search(model)._clear_finely(asked, path(8.0), 40)


@pytest.mark.parametrize(("duration", "bounds"), [(9.3, (9.3, 9.3)), (None, (0.1, 90.0))])
def test_a_path_by_planes_is_solved_for_near_its_guess(
    model: ManoeuvreModel,
    monkeypatch: pytest.MonkeyPatch,
    duration: float | None,
    bounds: tuple[float, float],
) -> None:
    class Planes(Kept):
        def within(self, limits: MotionLimits, guess: Any = None, *, pushing: bool = False) -> Any:
            assert guess.duration == pytest.approx(8.0)
            return replace(limits, distances=np.array([[1.0 + pushing]]))

    monkeypatch.setattr(module, "KeptByPlanes", Planes)
    search = Search(model, n40=[8.6, None])
    solver = search.scripted[40]
    solver.lack = 0.004
    asked = progress(Planes({}, {3: 1}))
    near = Neighbourhood.within(LIMITS, 0.5, 0.1 if duration else 0.0)
    # Ranges are 4.5 and 6.5 rad: 0.3 rad of each.
    np.testing.assert_allclose(near.reach, [0.15, 0.15])
    solved, lack = search._solve_apart(asked, 40, 1e-4, grid_path(40, 8.0), duration, near)
    assert solved.duration == pytest.approx(8.6)
    assert lack == 0.004
    (call,) = solver.calls
    assert call.near is near
    assert (call.bounds.shortest, call.bounds.longest) == pytest.approx(bounds)
    assert call.limits.distances.item() == (2.0 if duration else 1.0)
    with pytest.raises(UnusableCandidateError, match="no path within the limits"):
        search._solve_apart(asked, 40, 1e-4, grid_path(40, 8.0), duration, near)


def grid_path(intervals: int, duration: float) -> Trajectory:
    """Return a path of as many intervals."""
    velocities = np.zeros((intervals + 1, 2))
    shapes = np.tile(BOUNDARY.start, (intervals + 1, 1))
    return Trajectory(
        duration / intervals, shapes, velocities, np.tile(IDENTITY, (intervals + 1, 1))
    )


def test_nothing_is_begun_anew_after_the_time_budget(model: ManoeuvreModel) -> None:
    kept = Kept({8.0: [-0.01]}, {})
    search = Apart(model, kept, n40=[None, 9.0], n8=[8.8] * 4)
    late = progress(kept, time_budget=1e-9)
    assert search._keep_clear(late, [made(8.0)], 40) == []
    assert late.rejection == "planes are in the way"
    assert late.starts == 0


def test_a_search_without_room_says_which_pair_is_in_the_way(model: ManoeuvreModel) -> None:
    kept = Kept({8.0: [-0.01]}, {})
    search = Apart(model, kept, n40=[8.0] * 99, n8=[7.9] * 99)
    with pytest.raises(NotFoundError, match=r"planes are in the way\. More optimal"):
        search.search(BOUNDARY, LIMITS, IDENTITY, 40, OPTIONS)


# -- robots that drift ---------------------------------------------------------------------------


class Ticks(Search):
    """A search whose solver and commands for whole ticks are scripted."""

    def __init__(self, model: ManoeuvreModel, solutions: Any, held: Iterator[bool]) -> None:
        super().__init__(model)
        self.solutions, self.held = solutions, held
        self.calls: list[tuple[Any, ...]] = []
        self.aims: list[tuple[float, int]] = []
        self._holder = self  # type: ignore[assignment]

    def _get_solver(self, *asked: Any) -> Any:
        self.grid = asked[1]
        return self

    def solve(self, aim: Any, limits: Any, guess: Any, stop: Any, bounds: Any, near: Any) -> Any:
        self.near = near
        self.calls.append((aim, limits, round(guess.duration, 6), bounds.shortest, bounds.longest))
        return path(bounds.longest) if next(self.solutions) else None

    def hold(self, trajectory: Trajectory, boundary: Any, limits: Any, *, fixed: bool) -> Any:
        assert fixed
        assert boundary == "goal"
        assert limits is LIMITS
        return f"held for {trajectory.duration:.2f} s" if next(self.held) else None

    def corrected_end(self, trajectory: Trajectory, boundary: Any, ticks: int) -> str:
        assert boundary == "goal"
        self.aims.append((round(trajectory.duration, 6), ticks))
        return f"aim {len(self.aims)}"


@pytest.mark.parametrize(
    ("duration", "solutions", "held", "result", "times", "aims"),
    [
        # 8.03 s are 160.6 periods: 161, and the same again with a corrected aim.
        (0.0, "+", "+", "held for 8.05 s", [8.05], []),
        (0.0, "++", "-+", "held for 8.05 s", [8.05, 8.05], [(8.05, 161)]),
        # One, three and seven periods more; without a solution the aim stays.
        (0.0, "+-+", "-+", "held for 8.10 s", [8.05, 8.05, 8.10], [(8.05, 161)]),
        (
            0.0,
            "+++++",
            "-----",
            None,
            [8.05, 8.05, 8.10, 8.20, 8.40],
            [(8.05, 161), (8.05, 161), (8.10, 162), (8.20, 164), (8.40, 168)],
        ),
        # In a given time there are no others.
        (0.5, "++", "--", None, [8.05, 8.05], [(8.05, 161), (8.05, 161)]),
    ],
)
def test_a_drifting_manoeuvre_is_solved_for_in_whole_ticks(
    model: ManoeuvreModel,
    duration: float,
    solutions: str,
    held: str,
    result: str | None,
    times: list[float],
    aims: list[tuple[float, int]],
) -> None:
    search: Any = Ticks(model, (x == "+" for x in solutions), (x == "+" for x in held))
    asked: Any = SimpleNamespace(
        boundary="goal",
        limits=LIMITS,
        kept=Kept({}, {0: 4}),
        options=replace(OPTIONS, duration=duration),
        cancellation=NEVER,
        stop_rule=lambda found: found,
    )
    assert search._hold_in_whole_ticks(asked, path(8.03)) == result
    assert search.grid == 2
    assert [call[3:] for call in search.calls] == [pytest.approx((T, T)) for T in times]
    assert [call[2] for call in search.calls] == pytest.approx(times)
    goals = ["goal"]
    for solved, aim in zip(solutions, [f"aim {k + 1}" for k in range(9)], strict=False):
        goals.append(aim if solved == "+" else goals[-1])
    assert [call[0] for call in search.calls] == goals[: len(times)]
    assert search.aims == aims
    assert search.near is None
    limits = search.calls[0][1]
    np.testing.assert_allclose(limits.velocity, 0.99 * LIMITS.velocity)
    np.testing.assert_allclose(limits.acceleration, 0.99 * LIMITS.acceleration)
    assert list(limits.distances) == [4]


def test_drifting_robots_hold_whole_ticks_and_others_stretch(model: ManoeuvreModel) -> None:
    search: Any = Search(model)
    search._hold_in_whole_ticks = lambda *_: HeldCommands(
        path(5.0).at_ticks(3), np.tile(IDENTITY, (4, 1)), 0.0
    )
    at_rest, drifting = (
        progress(Kept({}, {}), replace(BOUNDARY, angular_momentum=np.array([0, 0, L])))
        for L in (0.0, 0.1)
    )
    assert search._make_held_commands(at_rest, path(5.0)).duration == pytest.approx(5.0)
    assert search._make_held_commands(drifting, path(5.0)).duration == pytest.approx(0.15)
    search._hold_in_whole_ticks = lambda *_: None
    with pytest.raises(
        UnusableCandidateError, match="held commands could not be brought to the goal"
    ):
        search._make_held_commands(drifting, path(5.0))
    with pytest.raises(UnusableCandidateError, match="no path"):
        search._make_held_commands(drifting, None)


@pytest.mark.parametrize(
    ("rate", "duration", "given", "expected"),
    [
        # The bound is 0.1 rad/s.
        (0.0999, 5.0, 0.0, 5.0),
        (0.104, 5.0, 0.0, 5.25),
        (0.109, 5.0, 0.0, 5.5),
        (0.111, 5.0, 0.0, None),
        (0.104, 5.0, 5.0, None),
    ],
)
def test_commands_that_turn_the_base_a_little_too_fast_are_made_slower(
    model: ManoeuvreModel, rate: float, duration: float, given: float, expected: float | None
) -> None:
    """5 s times 1.04 and a reserve of 2 in 1000 are 5.21 s, in ticks of 0.05 s: 5.25 s."""
    search: Any = Search(model)
    search._constraints = PathConstraints(base_rate_limit=0.1)

    class Turning:
        def hold(self, trajectory: Trajectory, *_: object, **__: object) -> HeldCommands:
            ticks = math.ceil(trajectory.duration / 0.05 - 1e-9)
            about = rate * duration / trajectory.duration * 0.05 * np.arange(ticks + 1) / 2
            turns = np.column_stack([np.zeros((ticks + 1, 2)), np.sin(about), np.cos(about)])
            return HeldCommands(trajectory.at_ticks(ticks), turns, 0.0)

    search._holder = Turning()
    asked = progress(Kept({}, {}), duration=given)
    if expected is None:
        with pytest.raises(UnusableCandidateError, match="the base turns at"):
            search._make_held_commands(asked, path(duration))
    else:
        found = search._make_held_commands(asked, path(duration))
        assert found.duration == pytest.approx(expected)


def test_the_aim_is_turned_by_the_difference_of_solution_and_commands() -> None:
    from scipy.spatial.transform import Rotation

    arm = SpaceRobot.from_file(robot_file("three_joint_arm"))
    reached = Rotation.from_rotvec([0.3, -0.2, 0.5])
    asked: list[Any] = []

    class Prediction:
        def attitudes(self, positions: Array, start: Array, L_0: Array) -> Array:
            asked.extend([len(positions), start, L_0])
            return np.array([IDENTITY, [0.5, 0.5, 0.5, 0.5], reached.as_quat()])

    holder: Any = object.__new__(CommandHolder)
    holder._prediction = Prediction()
    solved, goal = Rotation.from_rotvec([0.28, -0.21, 0.52]), Rotation.from_rotvec([0.3, -0.2, 0.4])
    ends = np.tile(IDENTITY, (3, 1))
    ends[-1] = solved.as_quat()
    shapes = np.zeros((3, arm.n))
    L_0 = np.array([0.1, -0.3, 0.2])
    boundary = BoundaryConditions(shapes[0], goal.as_quat(), shapes[0], angular_momentum=L_0)
    trajectory = Trajectory(0.5, shapes, shapes, ends)
    found = CommandHolder.corrected_end(holder, trajectory, boundary, 17)
    expected = goal * (reached.inv() * solved)
    assert (Rotation.from_quat(found.goal_rotation).inv() * expected).magnitude() < 1e-12
    assert asked[0] == 18
    np.testing.assert_array_equal(asked[1], IDENTITY)
    np.testing.assert_array_equal(asked[2], L_0)


def test_a_drifting_path_between_planes_changes_little_in_whole_ticks(
    model: ManoeuvreModel,
) -> None:
    search: Any = Ticks(model, iter([True]), iter([True]))
    kept = Kept({}, {0: 4}).by_planes()
    kept.rooms = {0: 4}
    asked: Any = SimpleNamespace(
        boundary="goal",
        limits=LIMITS,
        kept=kept,
        options=OPTIONS,
        cancellation=NEVER,
        stop_rule=lambda found: found,
    )
    assert search._hold_in_whole_ticks(asked, path(8.03)) == "held for 8.05 s"
    assert search.near.largest_lack == 0
    np.testing.assert_allclose(search.near.reach, [0.09, 0.09])
