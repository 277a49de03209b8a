"""Thrusters of a controller: allocation, tables, and how long they fire."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog, lsq_linear
from support.oracles import Array

from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model.thrusters import (
    ThrusterAllocation,
    ThrusterModulator,
    ThrusterTable,
    find_thrusters,
)
from spacerobot_ros.model.urdf import load_robot, parse_robot
from spacerobot_ros.resources import share_directory

SERVICER = find_thrusters("urdf", load_robot(share_directory() / "urdf" / "servicer.urdf"))
ALWAYS = np.full(24, np.inf)


def random_table(rng: np.random.Generator, count: int) -> tuple[Array, Array]:
    """Return wrenches (6, count) of thrusters anywhere, and costs."""
    force = rng.normal(size=(count, 3)) * rng.uniform(0.5, 20.0, (count, 1))
    place = rng.uniform(-2.0, 2.0, (count, 3))
    return np.vstack([force.T, np.cross(place, force).T]), rng.uniform(0.5, 2.0, count)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**31), count=st.integers(1, 24), scale=st.sampled_from([1e-6, 1.0, 1e4])
)
def test_what_thrusters_can_give_is_given(seed: int, count: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    wrenches, cost = random_table(rng, count)
    # Some thrusters at random levels: a wrench of the cone, also of its faces.
    levels = scale * rng.uniform(0.0, 1.0, count) * rng.integers(0, 2, count)
    wanted = wrenches @ levels
    found = ThrusterAllocation(wrenches, cost).allocate(wanted, np.full(count, np.inf))
    assert found.levels.min() >= 0.0
    np.testing.assert_array_equal(found.achieved, wrenches @ found.levels)
    assert np.linalg.norm(found.achieved - wanted) <= 1e-9 * (np.linalg.norm(wanted) + scale)
    assert cost @ found.levels <= cost @ levels * (1 + 1e-9)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**31))
def test_every_wrench_of_the_servicer_is_given_at_the_least_propellant(seed: int) -> None:
    wanted = np.random.default_rng(seed).normal(size=6) * [5.0, 5.0, 5.0, 2.0, 2.0, 2.0]
    cost = SERVICER.mass_flow
    found = ThrusterAllocation(SERVICER.wrenches, cost).allocate(wanted, ALWAYS)
    cheapest = linprog(cost / cost[0], A_eq=SERVICER.wrenches, b_eq=wanted).fun * cost[0]
    assert np.abs(found.achieved - wanted).max() <= 1e-9
    assert found.levels.min() >= 0.0
    assert cost @ found.levels == pytest.approx(cheapest, rel=1e-7)


@pytest.mark.parametrize("seed", range(8))
def test_beyond_the_thrust_the_wrench_keeps_its_direction(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wanted = rng.normal(size=6) * [60.0, 60.0, 60.0, 30.0, 30.0, 30.0]
    most = rng.uniform(0.2, 1.0, 24)
    found = ThrusterAllocation(SERVICER.wrenches, SERVICER.mass_flow).allocate(wanted, most)
    assert np.all((found.levels >= 0.0) & (found.levels <= most))
    part = float(found.achieved @ wanted / (wanted @ wanted))
    np.testing.assert_allclose(
        found.achieved, part * wanted, atol=1e-9 * float(np.linalg.norm(wanted))
    )
    # max part subject to wrenches @ levels = part * wanted, scaled otherwise than in the package
    largest = linprog(
        np.append(np.zeros(24), -1.0),
        A_eq=np.column_stack([SERVICER.wrenches, -wanted]),
        b_eq=np.zeros(6),
        bounds=[*((0.0, x) for x in most), (0.0, None)],
    ).x[-1]
    assert part == pytest.approx(min(largest, 1.0), rel=1e-7)
    assert part < 1.0


def test_redundant_thrusters_share_what_is_too_much_for_the_cheapest() -> None:
    """Two push along x; the cheaper by the newton gives its 2 N, the rest is the other's."""
    wrenches = np.zeros((6, 2))
    wrenches[0] = 2.0, 1.0
    allocation = ThrusterAllocation(wrenches, np.array([1.0, 1.0]))
    np.testing.assert_allclose(
        allocation.allocate(np.array([1.5, 0, 0, 0, 0, 0]), np.ones(2)).levels,
        [0.75, 0.0],
        atol=1e-12,
    )
    np.testing.assert_allclose(
        allocation.allocate(np.array([2.5, 0, 0, 0, 0, 0]), np.ones(2)).levels,
        [1.0, 0.5],
        atol=1e-12,
    )


@pytest.mark.parametrize("seed", range(6))
def test_the_nearest_is_given_of_what_cannot_be_given(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    wrenches, cost = random_table(rng, 5)
    wanted = rng.normal(size=6)
    found = ThrusterAllocation(wrenches, cost).allocate(wanted, np.full(5, np.inf))
    weights = np.ones(6)
    weights[3:] = np.linalg.norm(wrenches[:3]) / np.linalg.norm(wrenches[3:])
    other = lsq_linear(
        weights[:, None] * wrenches, weights * wanted, (0.0, np.inf), method="bvls", tol=1e-14
    )
    np.testing.assert_allclose(found.achieved, wrenches @ other.x, atol=1e-6)
    assert np.linalg.norm(found.achieved - wanted) > 1e-3


def test_of_a_wrench_in_an_unreachable_direction_the_bounds_leave_what_can_be_given() -> None:
    """Two push along x, one weakly along y, none along z: z is lost, x and y keep their ratio."""
    wrenches = np.zeros((6, 3))
    wrenches[0, :2], wrenches[1, 2] = 2.0, 1.0
    allocation = ThrusterAllocation(wrenches, np.array([1.0, 1.5, 1.0]))
    for size in (1.0, 8.0, 1e3):
        found = allocation.allocate(size * np.array([1.0, 0.5, 0.7, 0, 0, 0]), np.ones(3))
        given_ = min(size, 2.0)
        np.testing.assert_allclose(found.achieved, [given_, given_ / 2, 0, 0, 0, 0], atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_bounded_thrusters_give_the_direction_that_unbounded_ones_would(seed: int) -> None:
    rng = np.random.default_rng(seed)
    wrenches, cost = random_table(rng, 5)
    allocation = ThrusterAllocation(wrenches, cost)
    wanted = rng.normal(size=6) * 100.0
    free = allocation.allocate(wanted, np.full(5, np.inf))
    most = rng.uniform(0.2, 1.0, 5) * float(free.levels.max()) / 3.0
    found = allocation.allocate(wanted, most)
    part = float(found.achieved @ free.achieved / (free.achieved @ free.achieved))
    np.testing.assert_allclose(found.achieved, part * free.achieved, atol=1e-6)
    used = free.levels > 1e-9 * free.levels.max()
    assert part == pytest.approx(min(1.0, *(most / np.maximum(free.levels, 1e-12))[used]), rel=1e-6)


def test_without_thrusters_there_is_nothing() -> None:
    allocation = ThrusterAllocation(np.ones((6, 1)), np.ones(1))
    allocation.exclude(0)
    assert allocation.allocate(np.ones(6), np.ones(1)).achieved.tolist() == [0.0] * 6
    assert allocation.allocate(np.zeros(6), np.ones(1)).levels.tolist() == [0.0]


# -- tables of thrusters from URDF and YAML, and what is refused ---------------------------------


URDF = """<robot name="tug">
  <link name="bus"><inertial><mass value="10"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="pod"/>
  <joint name="mount" type="fixed"><parent link="bus"/><child link="pod"/>
    <origin xyz="0 1 0" rpy="0 0 1.5707963267948966"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="bus"/><child link="arm"/></joint>
  {thrusters}
</robot>"""
GOOD: dict[str, Any] = {
    "name": "a",
    "link": "pod",
    "position": [2.0, 0.0, 0.0],
    "direction": [0.0, 3.0, 0.0],
    "force": 5.0,
    "min_on_time": 0.01,
    "isp": 200.0,
}


def of_yaml(folder: Path, entries: Any, **others: Any) -> ThrusterTable:
    path = folder / "table.yaml"
    path.write_text(yaml.safe_dump({"thrusters": entries, **others}), encoding="utf-8")
    return find_thrusters(path, parse_robot(URDF.format(thrusters="")))


def box() -> list[dict[str, Any]]:
    """A table that gives every wrench: three thrusters at each corner of a cube, inwards."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    return [
        {
            "name": f"{corner}{axis}".replace(" ", ""),
            "position": list(map(float, corner)),
            "direction": [-float(corner[axis]) if i == axis else 0.0 for i in range(3)],
            "force": 1.0,
            "isp": 200.0,
        }
        for corner in corners
        for axis in range(3)
    ]


def test_a_thruster_on_a_mounted_link_acts_on_the_base(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    element = (
        '<thruster name="a" link="pod"><origin xyz="2 0 0" rpy="0 0 1.5707963267948966"/>'
        '<axis xyz="2 0 0"/><thrust force="5" min_on_time="0.01" isp="200"/></thruster>'
    )
    for table in (
        find_thrusters("urdf", parse_robot(URDF.format(thrusters=element))),
        of_yaml(tmp_path, [GOOD]),
    ):
        # By hand: the pod is 1 m along y of the bus and turned by a quarter about z.
        np.testing.assert_allclose(table.r_B, [[0.0, 3.0, 0.0]], atol=1e-15)
        np.testing.assert_allclose(table.direction_B, [[-1.0, 0.0, 0.0]], atol=1e-15)
        np.testing.assert_allclose(table.wrenches[:, 0], [-5, 0, 0, 0, 0, 15], atol=1e-14)
        assert (table.names, table.min_on_time[0]) == (("a",), 0.01)
        assert table.mass_flow[0] == pytest.approx(5.0 / (9.80665 * 200.0), rel=1e-15)
    assert capfd.readouterr() == ("", "")


def test_defaults_are_what_a_thruster_does_not_say(tmp_path: Path) -> None:
    given = {key: GOOD[key] for key in ("name", "position")}
    table = of_yaml(tmp_path, [given, {**given, "name": "b", "force": 7}], defaults=GOOD)
    assert table.force.tolist() == [5.0, 7.0]
    assert table.isp.tolist() == [200.0, 200.0]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"force": 0.0}, "The force of thruster 'a' is 0.0; it must be a positive number."),
        ({"force": None}, "The force of thruster 'a' is missing; it must be a positive number."),
        ({"isp": float("nan")}, "The isp of thruster 'a' is nan; it must be a positive number."),
        ({"isp": "much"}, "The isp of thruster 'a' is much; it must be a positive number."),
        ({"min_on_time": -1}, "The min_on_time of thruster 'a' is -1; it must be zero or more."),
        ({"direction": [0, 0, 0]}, "The direction of thruster 'a' is zero"),
        ({"position": [1, 2]}, "must be three finite numbers"),
        ({"link": "wing"}, "The link of thruster 'a' is 'wing', but there is no such link."),
        ({"link": "arm"}, "on link 'arm', which moves with the joints"),
        ({"name": ""}, "The name of a thruster is missing."),
        ({"colour": "red"}, "The thruster 'a' has 'colour'; known keys"),
    ],
)
def test_refusals_name_the_thruster(change: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError) as refusal:
        of_yaml(tmp_path, [{**GOOD, **change}])
    assert sentence in str(refusal.value)
    assert "table.yaml" in str(refusal.value)


def test_a_name_is_used_once(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="'a' is used twice"):
        of_yaml(tmp_path, [GOOD, GOOD])


@pytest.mark.parametrize("entries", [[], 3, ["a"], {"a": 1}])
def test_files_without_thrusters_are_refused(entries: Any, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"table\.yaml"):
        of_yaml(tmp_path, entries)
    with pytest.raises(ParameterError, match="cannot be read"):
        find_thrusters(tmp_path / "none.yaml", parse_robot(URDF.format(thrusters="")))


def test_a_urdf_without_thrusters_is_refused() -> None:
    with pytest.raises(RobotDescriptionError, match="has no <thruster> elements"):
        find_thrusters("urdf", parse_robot(URDF.format(thrusters="")))
    with pytest.raises(RobotDescriptionError, match="'tug': The position of thruster 'a'"):
        find_thrusters("urdf", parse_robot(URDF.format(thrusters='<thruster name="a"/>')))


def test_what_a_table_cannot_give_is_named(tmp_path: Path) -> None:
    full = of_yaml(tmp_path, box())
    assert full.missing() == ""
    # At each corner there is one along each axis: any one may die, but not all that push one way.
    assert full.missing([full.names[0]]) == ""
    pulls = [n for n, d in zip(full.names, full.direction_B, strict=True) if d[1] < 0]
    assert full.missing(pulls) == "negative force along y"
    flat = of_yaml(tmp_path, [entry for entry in box() if entry["direction"][2] == 0.0])
    assert "force along z" in flat.missing()
    assert "torque about z" not in flat.missing()
    assert full.missing(full.names) == "any wrench"


def test_the_servicer_has_redundant_thrusters() -> None:
    assert len(SERVICER.names) == 24
    assert SERVICER.missing() == ""
    assert all(SERVICER.missing([name]) == "" for name in SERVICER.names[::5])
    # Each sits on a corner of the bus and pushes into it.
    assert np.all(np.abs(SERVICER.r_B) == [0.6, 0.5, 0.5])
    assert np.all(np.sum(SERVICER.r_B * SERVICER.direction_B, axis=1) < 0.0)


def test_what_a_thruster_leaves_open(tmp_path: Path) -> None:
    """It pushes along x, as the axis of a joint does, from the base, in pulses of any length."""
    entry = {"name": "a", "position": [1.0, 2.0, 3.0], "force": 5.0, "isp": 200.0}
    table = of_yaml(tmp_path, [entry, {**entry, "name": "b", "rpy": [0.0, 0.0, np.pi / 2]}])
    np.testing.assert_allclose(table.direction_B, np.eye(3)[:2], atol=1e-15)
    assert table.r_B.tolist() == [[1.0, 2.0, 3.0]] * 2
    assert table.min_on_time.tolist() == [0.0, 0.0]


# -- pulses of on/off thrusters: shortest on-times, mean impulse, what is dropped ----------------


TICK = 0.01


def pair(shortest: float) -> ThrusterTable:
    """Return two thrusters of 2 N through the origin, along x and against it."""
    return ThrusterTable(
        ("forth", "back"),
        np.zeros((2, 3)),
        np.array([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]]),
        np.array([2.0, 2.0]),
        np.full(2, shortest),
        np.array([100.0, 100.0]),
    )


def along_x(force: float) -> Array:
    return np.array([force, 0.0, 0.0, 0.0, 0.0, 0.0])


def pulse_lengths(on_times: Array) -> list[float]:
    """Return the lengths (s) of one thruster's complete pulses from its on-times by tick."""
    lengths, running = [], 0.0
    for on_time in on_times:
        running += on_time
        if running and on_time < TICK * (1 - 1e-6):
            lengths.append(running)
            running = 0.0
    return lengths


@pytest.mark.parametrize("force", [0.013, 0.5, 1.9, 2.0, -0.7])
@pytest.mark.parametrize("shortest", [0.0, 0.003, 0.025])
def test_mean_of_a_second_is_the_wanted_force(force: float, shortest: float) -> None:
    pulses = ThrusterModulator(pair(shortest), TICK)
    second = np.array([pulses.fire(along_x(force)) for _ in range(100)])
    impulse = float(np.sum(second @ [2.0, -2.0]))
    assert abs(impulse - force) <= 2.0 * shortest + 1e-9
    # Nothing is fired against the wanted force.
    assert not second[:, 1 if force > 0 else 0].any()


def test_little_wanted_both_ways_fires_nothing() -> None:
    pulses = ThrusterModulator(pair(0.02), TICK)
    fired = [pulses.fire(along_x(1.5 * (-1) ** tick)) for tick in range(200)]
    assert not np.any(fired)


def test_a_begun_pulse_is_ended_although_nothing_is_wanted_any_more() -> None:
    pulses = ThrusterModulator(pair(0.035), TICK)
    first = [pulses.fire(along_x(2.0))[0] for _ in range(4)]
    assert first == [0.0, 0.0, 0.0, pytest.approx(TICK)]
    assert pulses.begun.tolist() == [True, False]
    rest = [pulses.fire(np.zeros(6))[0] for _ in range(6)]
    # 40 ms were owed.
    assert TICK + sum(rest) == pytest.approx(0.04)
    assert not any(rest[rest.index(0.0) :]), "it does not begin again"
    assert pulses.begun.tolist() == [False, False]


def test_what_is_beyond_the_thrust_is_dropped_and_told() -> None:
    pulses = ThrusterModulator(pair(0.02), TICK)
    for _ in range(100):
        pulses.fire(along_x(5.0))
    assert pulses.unmet[0] == pytest.approx(3.0)
    later = np.array([pulses.fire(np.zeros(6)) for _ in range(20)])
    # A second of too much are not made up for: one tick and one shortest pulse at the most.
    assert later.sum() <= TICK + 0.02 + 1e-9
    assert pulses.unmet[0] == 0.0


@pytest.mark.parametrize("shortest", [0.012, 0.035, 0.05])
def test_pulses_under_way_count_towards_what_may_be_owed(shortest: float) -> None:
    """However much is wanted: once nothing is, a thruster gives a shortest pulse and a tick."""
    rng = np.random.default_rng(4)
    pulses = ThrusterModulator(pair(shortest), TICK)
    for wanted in range(1, 10):
        for _ in range(wanted):
            pulses.fire(along_x(float(rng.uniform(20.0, 500.0))))
        left = sum(pulses.fire(along_x(0.0))[0] for _ in range(10))
        assert left <= shortest + TICK + 1e-9, wanted
    assert pulses.pulses[0] > 1


def test_a_direction_without_thrusters_is_told() -> None:
    pulses = ThrusterModulator(pair(0.0), TICK)
    on_time = pulses.fire(np.array([1.0, 0.5, 0, 0, 0, -0.25]))
    assert on_time.tolist() == [pytest.approx(TICK / 2), 0.0]
    np.testing.assert_allclose(pulses.unmet, [0, 0.5, 0, 0, 0, -0.25], atol=1e-12)


def test_excluded_thrusters_stay_off() -> None:
    dead = [SERVICER.names[0], SERVICER.names[9]]
    pulses = ThrusterModulator(SERVICER, TICK, dead)
    rng = np.random.default_rng(5)
    fired = np.zeros(24)
    for _ in range(200):
        fired += pulses.fire(rng.normal(size=6) * 3.0)
        assert np.abs(pulses.unmet).max() < 1e-9
    assert fired[[0, 9]].tolist() == [0.0, 0.0]
    assert fired.sum() > 0.2
    with pytest.raises(ParameterError, match="no thruster 'nose'"):
        ThrusterModulator(SERVICER, TICK, ["nose"])


@pytest.mark.parametrize("seed", range(3))
def test_rounding_does_not_choose_the_thrusters(seed: int) -> None:
    """The servicer's are symmetric: many allocations of a wrench cost the same."""
    rng = np.random.default_rng(seed)
    pulses, others = ThrusterModulator(SERVICER, TICK), ThrusterModulator(SERVICER, TICK)
    for tick in range(150):
        if tick % 10 == 0:
            wrench = rng.uniform(-6.0, 6.0, 6) * rng.integers(0, 2, 6)
        rounded = wrench + 1e-13 * rng.normal(size=6)
        np.testing.assert_allclose(pulses.fire(wrench), others.fire(rounded), atol=1e-11)


def test_pulses_are_counted_from_the_commanded_on_times() -> None:
    modulator = ThrusterModulator(pair(0.02), TICK)
    fired = np.array([modulator.fire(along_x(0.5)) for _ in range(400)])
    assert modulator.pulses[0] == len(pulse_lengths(fired[:, 0])) > 10
    assert modulator.pulses[1] == 0
    modulator.reset()
    assert modulator.pulses[0] > 10, "what was used stays used"
