"""The pairs that are kept apart in a search: their room, their limits, and where the world is."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.collision.rows import world_pose_parameters
from spacerobot_ros.planning import RobotState
from spacerobot_ros.planning.methods.optimal.held_commands import HeldCommands
from spacerobot_ros.planning.methods.optimal.kept_distances import (
    DistanceLibrary,
    KeptByPlanes,
    KeptDistances,
    PathClearing,
    instants_of,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    Trajectory,
    UnusableCandidateError,
)

Array = npt.NDArray[np.float64]

IDENTITY = np.array([0.0, 0.0, 0.0, 1.0])
START, FINAL = np.array([0.3, -0.2]), np.array([0.5, 0.4])
TURN = Rotation.from_rotvec([0.1, -0.3, 0.2])
STATE = RobotState(
    np.array([0.4, -0.3, 0.2]), Rotation.from_rotvec([0.3, -0.5, 0.4]).as_quat(), START
)
REQUIRED = np.array([0.01, 0.02, 0.03, 0.04])
LIMITS = MotionLimits(-np.ones(2), np.ones(2), np.ones(2), np.ones(2))
CENTER = np.array([0.1, 0.02, -0.05])


class Rows:
    """Distances that are the sum of the shape times a factor; of obstacles, and of the turn."""

    def __init__(self, factor: float, *, is_of_obstacle: bool = False) -> None:
        self.factor, self.is_of_obstacle = factor, is_of_obstacle
        self.asked: list[tuple[Any, ...]] = []

    def values(self, *at: Array) -> ca.DM:
        self.asked.append(at)
        return ca.DM(self.factor * np.atleast_2d(np.asarray(at[0])[:2].sum(axis=0)))


def library(*rows: Rows) -> Any:
    """Return a library of rows, by the numbers of their pairs."""
    clearance: Any = SimpleNamespace(has_obstacles=any(x.is_of_obstacle for x in rows))
    robot: Any = SimpleNamespace(center_of_mass=lambda q: CENTER)
    made: Any = DistanceLibrary(clearance, robot, SimpleNamespace())  # type: ignore[arg-type]
    made._rows = {(pair, False): each for pair, each in enumerate(rows)}
    return made


def kept(library: Any, *, final: Array | None = FINAL, turn_is_known: bool = True) -> KeptDistances:
    boundary = BoundaryConditions(START, TURN.as_quat(), START, final, state=STATE)
    return KeptDistances(library, boundary, REQUIRED, turn_is_known=turn_is_known)


def near(pair: int, distance: float, shape: Array = FINAL) -> Any:
    return SimpleNamespace(pair=pair, distance=distance, shape=shape)


def test_pairs_get_room_and_more_by_what_they_lacked() -> None:
    pairs = kept(library(*[Rows(1.0)] * 4))
    assert not pairs.pairs
    pairs.add([near(2, 0.004), near(1, 0.001)])
    assert [*pairs.pairs] == [1, 2]
    # The first time, whatever they lack, 2 mm; then what they lack and 2 mm, and never less.
    assert pairs._room == pytest.approx({2: 0.002, 1: 0.002})
    pairs.add([near(2, 0.025), near(1, 0.03)])
    assert pairs._room == pytest.approx({2: 0.002 + 0.005 + 0.002, 1: 0.004})
    other = pairs.copy()
    other.add([near(3, 0.0)])
    assert [*pairs.pairs] == [1, 2]
    assert [*other.pairs] == [1, 2, 3]
    other._room[1] = 0.001
    pairs.include(other)
    assert pairs._room == pytest.approx({1: 0.004, 2: 0.009, 3: 0.002})
    assert other._turn_is_known is True
    assert kept(library(), turn_is_known=False).copy()._turn_is_known is False


def test_a_new_pair_has_room_for_the_error_of_its_row() -> None:
    """A row that is less than the distance already keeps more than is asked for."""
    rows = Rows(0.01), Rows(0.01), Rows(1.0, is_of_obstacle=True)
    pairs = kept(library(*rows))
    # The rows say 0.01 * (0.7 + 0.4) = 0.011, where the pairs are 0.015 and 0.004 m apart.
    shape = np.array([0.7, 0.4])
    pairs.add([near(0, 0.015, shape), near(1, 0.004, shape), near(2, 9.0, shape)])
    assert pairs._room == pytest.approx({0: 0.002 - 0.004, 1: 0.002, 2: 0.002})
    # From then on the margin increases by what the pair lacks of 0.01 m.
    pairs.add([near(0, 0.007, shape)])
    assert pairs._room[0] == pytest.approx(-0.002 + 0.003 + 0.002)


def test_pairs_that_rows_underestimate_spend_room() -> None:
    """Where rows say less than the distance is, they need less room by as much."""
    among = library(Rows(0.01), Rows(0.1), Rows(0.02), Rows(1.0, is_of_obstacle=True), Rows(1.0))
    among.clearance.geometry = SimpleNamespace(with_obstacles=np.arange(5) == 3)
    required = np.array([0.01, 0.02, 0.03, 0.04, 0.05])
    boundary = BoundaryConditions(START, TURN.as_quat(), START, FINAL, state=STATE)
    pairs: Any = KeptDistances(among, boundary, required, turn_is_known=True)
    shape, asked = np.array([0.5, 0.4]), list[Any]()

    def approaches(positions: Array, wanted: Array, base: Any) -> list[Any]:
        asked.append((positions, wanted, base))
        # Rows say 0.009, 0.09, 0.018, and 0.9 of the obstacle and of the pair that is not kept.
        distances = [0.03, 0.088, 0.019, 0.05, 0.06]
        return [
            SimpleNamespace(pair=pair, distance=d, shape=shape) for pair, d in enumerate(distances)
        ]

    among.clearance.approaches = approaches
    among.base_poses = lambda *_: "base"
    pairs.add([near(pair, 0.0) for pair in range(4)])
    positions = np.array([START, FINAL])
    assert pairs.reduce_margins(positions, np.array([IDENTITY, TURN.as_quat()])) is True
    # The second one is nearer than its rows say, and the third farther by 1 mm, less than the room.
    expected = {0: 0.009 - 0.03 + 0.002, 1: 0.002, 2: 0.002, 3: 0.002}
    assert pairs._room == pytest.approx(expected)
    ((looked_at, wanted, base),) = asked
    assert looked_at is positions
    np.testing.assert_allclose(wanted, required + 0.05)
    assert base == "base"
    # The same again spends nothing more.
    assert pairs.reduce_margins(positions, np.array([IDENTITY, TURN.as_quat()])) is False
    assert pairs._room == pytest.approx(expected)


def test_limits_are_the_required_distances_and_their_room_but_at_the_ends() -> None:
    pairs = kept(library(Rows(1.0), Rows(0.2), Rows(9.0), Rows(9.0)))
    pairs.add([near(0, 0.0), near(1, 0.0), near(3, 0.0)])
    found = pairs.within(LIMITS)
    # The sums of the shapes at the ends are 0.1 and 0.9: 0.2 * 0.1 - 0.0001 is less than 0.022.
    np.testing.assert_allclose(found.distances, [[0.012, 0.0199, 0.042]])
    assert found.velocity is LIMITS.velocity
    only_start = kept(library(Rows(-1.0), Rows(0.2)), final=None)
    only_start.add([near(0, -1.0)])
    np.testing.assert_allclose(only_start.within(LIMITS).distances, [[-0.1 - 1e-4]])
    both = kept(library(Rows(-1.0), Rows(0.2)))
    both.add([near(0, -1.0)])
    np.testing.assert_allclose(both.within(LIMITS).distances, [[-0.9 - 1e-4]])


@pytest.mark.parametrize(
    ("final", "known", "ends"), [(FINAL, True, 2), (FINAL, False, 1), (None, True, 1)]
)
def test_rows_of_obstacles_are_asked_where_the_turn_is_known(
    final: Array | None, known: bool, ends: int
) -> None:
    rows = Rows(1.0, is_of_obstacle=True)
    of_links = Rows(1.0)
    pairs = kept(library(of_links, rows), final=final, turn_is_known=known)
    pairs.add([near(0, 0.0), near(1, 0.0)])
    found = pairs.within(LIMITS)
    ((turned, world),) = rows.asked
    expected = np.array([[*START, *IDENTITY], [*FINAL, *TURN.as_quat()]])[:ends].T
    np.testing.assert_allclose(turned, expected)
    assert world.shape == (12, ends)
    R_0W = Rotation.from_quat(STATE.quaternion).inv()
    r_WC = STATE.position + R_0W.inv().apply(CENTER)
    # A point of the world, as it is seen from the centre of mass at the start.
    point = np.array([0.7, -1.1, 0.4])
    seen = R_0W.apply(point - r_WC)
    r_0W = -R_0W.apply(r_WC)
    np.testing.assert_allclose(
        world[:, 0], world_pose_parameters(R_0W.as_matrix(), r_0W), atol=1e-14
    )
    np.testing.assert_allclose(R_0W.apply(point) + r_0W, seen)
    np.testing.assert_allclose(found.distances[0, 2:], world[:, 0])
    # Of links the shapes at both ends count all the same.
    assert of_links.asked[-1][0].shape == (2, 1 if final is None else 2)


def test_poses_of_the_base_count_among_obstacles_alone() -> None:
    asked: list[tuple[Any, ...]] = []
    among = library(Rows(1.0, is_of_obstacle=True))

    def poses(*at: Any) -> str:
        asked.append(at)
        return "poses"

    among._prediction = SimpleNamespace(poses=poses)
    boundary = BoundaryConditions(START, TURN.as_quat(), START, state=STATE)
    shapes, turns = np.array([START, FINAL]), np.array([IDENTITY, TURN.as_quat()])
    assert among.base_poses(boundary, shapes, turns) == "poses"
    ((state, positions, attitudes),) = asked
    assert state is STATE
    assert positions is shapes
    found = Rotation.from_quat(attitudes)
    start = Rotation.from_quat(STATE.quaternion)
    assert (found.inv() * start * Rotation.from_quat(turns)).magnitude().max() < 1e-12
    assert library(Rows(1.0)).base_poses(boundary, shapes, turns) is None
    unknown = BoundaryConditions(START, TURN.as_quat(), START)
    assert among.base_poses(unknown, shapes, turns) is None


@pytest.mark.parametrize(
    ("final", "known", "looked_at"),
    [(FINAL, True, True), (FINAL, False, False), (None, True, None)],
)
def test_a_search_begins_with_both_ends_looked_at(
    final: Array | None, known: bool, looked_at: bool | None
) -> None:
    asked: list[tuple[str, Any, Any]] = []
    among = library(Rows(1.0, is_of_obstacle=True))

    def required(q: Array, base: Any) -> Array:
        asked.append(("start", q, base))
        return REQUIRED

    among.clearance.required = required
    among.clearance.require_shape = lambda q, required, base: asked.append(("end", q, base))
    among._prediction = SimpleNamespace(poses=lambda state, q, X: ("at", q.tolist(), len(X)))
    boundary = BoundaryConditions(START, TURN.as_quat(), START, final, state=STATE)
    begun = among.begin(boundary, turn_is_known=known)
    assert begun._required is REQUIRED
    assert begun._turn_is_known is known
    assert asked[0] == ("start", START, ("at", [START.tolist()], 1))
    if looked_at is None:
        assert len(asked) == 1
    else:
        expected = ("at", [FINAL.tolist()], 1) if looked_at else None
        assert (asked[1][0], asked[1][2]) == ("end", expected)
        assert asked[1][1] is FINAL


# -- planes ------------------------------------------------------------------------------------


class Geometry:
    """Pairs whose distances are the sum of the shape times a factor, of obstacles plus r_WB."""

    def __init__(self, *factors: float, obstacle: int = -1) -> None:
        self.factors = factors
        self.with_obstacles = np.arange(len(factors)) == obstacle

    def poses(self, shapes: Array, base: Any) -> Any:
        return shapes, base

    def planes(self, pair: int, poses: Any) -> tuple[Array, Array]:
        shapes, base = poses
        distances = self.factors[pair] * shapes.sum(axis=1)
        if self.with_obstacles[pair]:
            distances = distances + base
        planes = np.tile([0.6, 0.0, 0.8, 0.5 + pair, 1.0, 2.0, 3.0], (len(shapes), 1))
        return distances, planes


def planes_library(*factors: float, obstacle: int = -1) -> Any:
    """Return a library of pairs, by their factors."""
    clearance: Any = SimpleNamespace(
        has_obstacles=obstacle >= 0, geometry=Geometry(*factors, obstacle=obstacle)
    )
    robot: Any = SimpleNamespace(center_of_mass=lambda q: CENTER)
    prediction: Any = SimpleNamespace(poses=lambda state, q, X: 100.0)
    return DistanceLibrary(clearance, robot, prediction)


def by_planes(library: Any) -> KeptByPlanes:
    return kept(library).by_planes()


def trajectory(intervals: int = 40) -> Trajectory:
    """Return a path at steady speeds from the start to the end, in 2 s; its turns are not unit."""
    s = np.linspace(0.0, 1.0, intervals + 1)[:, np.newaxis]
    speed = np.tile((FINAL - START) / 2.0, (intervals + 1, 1))
    turns = (1 - s) * IDENTITY + s * TURN.as_quat()
    return Trajectory(2.0 / intervals, START + s * (FINAL - START), speed, turns)


def test_planes_get_room_and_more_by_the_distance_that_they_lacked() -> None:
    pairs = by_planes(planes_library(1.0, 1.0, 1.0, 1.0))
    assert not pairs.pairs
    pairs.add([near(2, 0.004), near(1, 0.001)])
    assert [*pairs.pairs] == [1, 2]
    assert pairs._room == pytest.approx({2: 0.002, 1: 0.002})
    # A pair that is kept already is not new, and keeps its room.
    pairs.add([near(2, 0.025)])
    assert pairs._room == pytest.approx({2: 0.002, 1: 0.002})
    pairs.widen([near(2, 0.025), near(3, 0.0)])
    assert pairs._room == pytest.approx({2: 0.002 + 0.005, 1: 0.002, 3: 0.002})
    other = pairs.copy()
    other.add([near(0, 0.0)])
    assert [*pairs.pairs] == [1, 2, 3]
    assert [*other.pairs] == [0, 1, 2, 3]


@pytest.mark.parametrize("intervals", [40, 16, 80, 200])
def test_instants_are_equally_spaced_on_the_path(intervals: int) -> None:
    instants = instants_of(intervals)
    assert instants == {40: 2, 16: 5, 80: 2, 200: 2}[intervals]
    shapes, turns = by_planes(planes_library(1.0)).along(trajectory(intervals))
    s = np.arange(1, instants * intervals + 1)[:, np.newaxis] / (instants * intervals)
    np.testing.assert_allclose(shapes, START + s * (FINAL - START), atol=1e-12)
    expected = (1 - s) * IDENTITY + s * TURN.as_quat()
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(turns, expected, atol=1e-12)


def test_between_the_knots_shapes_are_on_parabolas() -> None:
    velocities = np.array([[0.0, 0.4], [1.0, -0.2], [0.5, 0.0]])
    shapes = np.array([[0.3, -0.2], [0.4, -0.18], [0.55, -0.2]])
    moved = Trajectory(0.2, shapes, velocities, np.tile(IDENTITY, (3, 1)))
    found, _ = by_planes(planes_library(1.0)).along(moved)
    # A quarter of the first interval: 0.05 s of 0.2 s at accelerations of 5 and -3 rad/s^2.
    np.testing.assert_allclose(found[9], [0.3 + 0.00625, -0.2 + 0.02 - 0.00375], atol=1e-12)
    np.testing.assert_allclose(found[[39, 79]], shapes[1:], atol=1e-12)


def test_a_clear_path_keeps_to_its_own_planes() -> None:
    # Sums of shapes go from 0.1 to 0.9. The second pair has no room before 0.22, and is nearer than
    # 0.02 before 0.2.
    pairs = by_planes(planes_library(1.0, 0.1, 9.0))
    pairs.add([near(0, 0.0), near(1, 0.0)])
    path = trajectory()
    planes = pairs.within(LIMITS, path).distances
    assert planes.shape == (40, 2 * 2 * 7)
    by_instant = planes.reshape(80, 2, 7)
    np.testing.assert_allclose(
        by_instant[..., [0, 1, 2, 4, 5, 6]], [[[0.6, 0, 0.8, 1, 2, 3]] * 2] * 80
    )
    sums = 0.1 + 0.8 * np.arange(1, 81) / 80
    np.testing.assert_allclose(by_instant[:, 0, 3], 0.5 + 0.012, atol=1e-12)
    distance = 0.1 * sums
    wanted = np.where(distance >= 0.02, np.minimum(distance, 0.022), 0.022)
    np.testing.assert_allclose(by_instant[:, 1, 3], 1.5 + wanted, atol=1e-12)
    assert len(np.unique(np.round(wanted, 6))) > 2
    # Pushed, it is to have room everywhere but in the first and the last tenth.
    pushed = pairs.within(LIMITS, path, pushing=True).distances.reshape(80, 2, 7)
    at_ends = np.minimum(np.arange(80), 80 - np.arange(80)) < 8
    np.testing.assert_allclose(pushed[:, 1, 3], 1.5 + np.where(at_ends, wanted, 0.022), atol=1e-12)


def test_planes_of_obstacles_are_seen_from_the_center_of_mass_at_the_start() -> None:
    pairs = by_planes(planes_library(1.0, 1.0, obstacle=1))
    pairs.add([near(1, 0.0)])
    (plane,) = pairs.within(LIMITS, trajectory(80)).distances.reshape(160, 7)[40:41]
    R_0W = Rotation.from_quat(STATE.quaternion).inv()
    r_WC = STATE.position + R_0W.inv().apply(CENTER)
    # A point of W on the plane that was found, before it was shifted by the required distance.
    on_plane = np.array([0.6, 0.0, 0.8]) * 1.5 + np.array([-0.8, 3.0, 0.6])
    normal = R_0W.apply([0.6, 0.0, 0.8])
    np.testing.assert_allclose(plane[:3], normal, atol=1e-12)
    assert plane[3] == pytest.approx(normal @ R_0W.apply(on_plane - r_WC) + 0.022)
    np.testing.assert_allclose(plane[4:], [1.0, 2.0, 3.0])


def test_a_path_is_looked_at_from_its_start_to_its_end() -> None:
    among = planes_library(1.0)
    asked: list[tuple[Any, ...]] = []

    def approaches(*at: Any) -> list[Any]:
        asked.append(at)
        return ["near"]

    among.clearance.approaches = approaches
    pairs: Any = by_planes(among)
    assert pairs.approaches_of(trajectory(16)) == ["near"]
    ((shapes, required, base),) = asked
    np.testing.assert_allclose(shapes, START + np.linspace(0, 1, 81)[:, None] * (FINAL - START))
    assert required is REQUIRED
    assert base is None


# -- paths that become clear, and fast -----------------------------------------------------------


class Script:
    """Solutions by a script: durations, lacks of distance, and the distances of pairs there."""

    def __init__(self, *solutions: tuple[float, float, dict[int, float]] | None) -> None:
        self.solutions = iter(solutions)
        self.distances: dict[float, dict[int, float]] = {}
        self.asked: list[tuple[float, float | None, float, float]] = []
        self.rooms: list[dict[int, float]] = []
        self.held: list[float] = []
        among = planes_library(1.0, 1.0, 1.0, 1.0)
        among.clearance.approaches = self.approaches
        among.clearance.clause = lambda each, period: f"pair {each.pair} after {period}"
        self.kept = by_planes(among)

    def approaches(self, positions: Array, *_: Any) -> list[Any]:
        found = self.distances[round(float(positions[1:].sum()), 9)]
        return [near(pair, d) for pair, d in found.items()]

    def path(self, duration: float, near: dict[int, float]) -> Trajectory:
        """Return a path that is told by its shapes."""
        made = replace(trajectory(), shapes=trajectory().shapes + 0.01 * len(self.distances))
        shapes, _ = self.kept.along(made)
        self.distances[round(float(shapes.sum()), 9)] = near
        return replace(made, step=duration / 40, velocities=made.velocities * 2.0 / duration)

    def solve(self, guess: Trajectory, duration: float | None, around: Any) -> Any:
        self.asked.append((guess.duration, duration, float(around.reach[0]), around.largest_lack))
        self.rooms.append(dict(self.kept._room))
        solution = next(self.solutions)
        if solution is None:
            raise UnusableCandidateError("no path")
        time, lack, near = solution
        return self.path(duration or time, near), lack

    def hold(self, path: Trajectory) -> Any:
        self.held.append(path.duration)
        shapes, turns = self.kept.along(path)
        return HeldCommands(np.vstack([path.shapes[:1], shapes]), turns, 0.0)

    def clearing(self, *, held: bool = True) -> Any:
        return PathClearing(self.kept, LIMITS, self.solve, 0.05, self.hold if held else None)


def test_a_path_becomes_clear_in_the_time_that_is_given() -> None:
    script = Script((0, 0.02, {1: -0.01, 3: 0.02}), (0, 0.0, {1: 0.017}), (0, 0.0, {}))
    path, held = script.clearing().clear(script.path(2.0, {1: -0.07, 0: 0.0}), 5.0)
    assert path.duration == pytest.approx(5.0)
    np.testing.assert_allclose(held.positions[1:], script.kept.along(path)[0])
    assert [each[:2] for each in script.asked] == [pytest.approx((5.0, 5.0))] * 3
    # 0.3 rad at most, here 0.15 of the ranges of 2 rad. A lack of twice the depth is admitted.
    assert [each[2:] for each in script.asked] == [(0.3, 0.14), (0.3, 0.1), (0.3, 0.1)]
    # Where planes are kept, but not the distance, pairs get as much room as they lack.
    assert script.rooms[0] == {0: 0.002, 1: 0.002}
    assert script.rooms[1] == {0: 0.002, 1: 0.002, 3: 0.002}
    assert script.rooms[2] == pytest.approx({0: 0.002, 1: 0.002 + 0.02 - 0.017, 3: 0.002})


@pytest.mark.parametrize(
    ("lacks", "solved"),
    [([0.05, 0.049, 0.048, 0.047], 3), ([0.05, 0.04, 0.03, 0.02, 0.019, 0.018], 7)],
)
def test_a_path_that_comes_no_nearer_to_clear_is_given_up(lacks: list[float], solved: int) -> None:
    script = Script(*[(0.0, lack, {2: -0.03}) for lack in lacks], (0.0, 0.0175, {2: -0.03}))
    with pytest.raises(UnusableCandidateError, match=r"pair 2 after 0\.05"):
        script.clearing().clear(script.path(2.0, {2: -0.05}), 5.0)
    assert len(script.asked) == solved
    alone = Script(*[(0.0, 0.05, {2: -0.03})] * 9)
    with pytest.raises(UnusableCandidateError, match="pair 2 after None"):
        alone.clearing(held=False).clear(alone.path(2.0, {2: -0.05}), 5.0)


def test_a_clear_path_becomes_faster_by_changes_that_keep_it_clear() -> None:
    script = Script(
        (4.0, 0.0, {1: 0.01}),  # A new pair: the same once more.
        (3.9, 0.0, {1: 0.01}),  # No longer new: a third of the reach.
        None,  # A ninth.
        (4.5, 0.0, {}),  # Twice as much again, from here on, but it was not faster.
        (3.0, 0.0, {}),
        (2.5, 0.0, {}),
        (2.49, 0.0, {}),
        (2.485, 0.0, {}),  # At the full reach a hundredth is not worth another one.
    )
    start = script.path(5.0, {})
    path, held = script.clearing().shorten(start, "held")
    assert path.duration == pytest.approx(2.485)
    assert held != "held"
    reaches = [each[2] / 0.3 for each in script.asked]
    assert reaches == pytest.approx([1, 1, 1 / 3, 1 / 9, 2 / 9, 4 / 9, 8 / 9, 1])
    assert [each[0] for each in script.asked] == pytest.approx([5, 5, 5, 5, 4.5, 3, 2.5, 2.49])
    assert {each[1] for each in script.asked} == {None}
    assert {each[3] for each in script.asked} == {0.0}


def test_a_path_that_gains_less_than_a_hundredth_is_left() -> None:
    script = Script((4.0, 0.0, {}), (3.97, 0.0, {}), (1.0, 0.0, {}))
    path, _ = script.clearing().shorten(script.path(5.0, {}), None)
    assert path.duration == pytest.approx(3.97)
    none = Script(*[None] * 9)
    start = none.path(5.0, {})
    assert none.clearing().shorten(start, "held") == (start, "held")
    # Until the reach is less than a fiftieth: 1, 1/3, 1/9, 1/27.
    assert len(none.asked) == 4
