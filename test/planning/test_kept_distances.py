"""The pairs that are kept apart in a search: their room, their limits, and where the world is."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.collision.rows import world_pose_parameters
from spacerobot_ros.planning import RobotState
from spacerobot_ros.planning.methods.optimal.kept_distances import DistanceLibrary, KeptDistances
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits

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
    made._rows = dict(enumerate(rows))
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
    np.testing.assert_allclose(found.distances, [0.012, 0.0199, 0.042])
    assert found.world.size == 0
    assert found.velocity is LIMITS.velocity
    only_start = kept(library(Rows(-1.0), Rows(0.2)), final=None)
    only_start.add([near(0, -1.0)])
    np.testing.assert_allclose(only_start.within(LIMITS).distances, [-0.1 - 1e-4])
    both = kept(library(Rows(-1.0), Rows(0.2)))
    both.add([near(0, -1.0)])
    np.testing.assert_allclose(both.within(LIMITS).distances, [-0.9 - 1e-4])


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
    np.testing.assert_allclose(found.world, world[:, 0])
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
