"""Draws in lanes beside the same draws one by one."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import casadi as ca
import pytest
from support.campaigns import campaign
from support.slow import some_fast

from spacerobot_ros.batch import targets
from spacerobot_ros.campaign import lanes, workers
from spacerobot_ros.campaign.config import Campaign, parse_campaign
from spacerobot_ros.campaign.dataset import Row
from spacerobot_ros.campaign.draws import Draws
from spacerobot_ros.campaign.lanes import LanesEngine
from spacerobot_ros.campaign.one_by_one import FlightsEngine
from spacerobot_ros.campaign.running import RERUN_TOLERANCE, largest_deviation
from spacerobot_ros.campaign.workers import fly_all, select_engine
from spacerobot_ros.control.laws.registry import LAWS
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.control.state import Actuation, Reference
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.planning import Goal
from spacerobot_ros.resources import share_directory

pytestmark = pytest.mark.usefixtures("compiled")

DISPERSED: dict[str, Any] = {
    "mass.*": {"norm": {"loc": 1.0, "scale": 0.03}},
    "inertia.*": {"norm": {"loc": 1.0, "scale": 0.03}},
    "com.*": {"norm": {"scale": 0.002}},
    "plant.sensors.position_noise": {"uniform": [0.0, 0.001]},
    "goal.position.z": {"norm": {"scale": 0.002}},
    "initial.position.x": {"norm": {"scale": 0.002}},
    "initial.rotvec.y": {"norm": {"scale": 0.002}},
}


def on_engines(*fast: str) -> Any:
    """Parametrise a test by the engine: lanes, or the program of a device, here or on one."""
    marks = {"lanes": [], "host": [], "cuda": [pytest.mark.gpu]}
    for name, each in marks.items():
        if name not in fast:
            each.append(pytest.mark.slow)
    return pytest.mark.parametrize(
        "engine", [pytest.param(name, marks=each) for name, each in marks.items()]
    )


def engine_named(name: str) -> LanesEngine:
    """Return an engine; the test is skipped if there is no such device."""
    try:
        return LanesEngine(name)
    except SpaceRobotError as error:
        pytest.skip(str(error))


def flown(engine: LanesEngine | FlightsEngine, made: Campaign) -> dict[int, Row]:
    rows = fly_all(engine, made, list(Draws(made)), lambda: False)
    return {row.draw.number: row for row in rows}


def assert_same_flights(made: Campaign, engine: str) -> tuple[dict[int, Row], dict[int, Row]]:
    of_lanes, one_by_one = flown(engine_named(engine), made), flown(FlightsEngine(), made)
    assert of_lanes.keys() == one_by_one.keys() == set(range(made.flights))
    for number, row in one_by_one.items():
        other = of_lanes[number]
        deviation, at = largest_deviation(row.metrics, other.metrics)
        assert deviation < RERUN_TOLERANCE, (number, at, deviation)
        assert (row.outcome, row.reason) == (other.outcome, other.reason)
        assert row.passed is other.passed
    return of_lanes, one_by_one


@on_engines()
@pytest.mark.parametrize(("tolerance", "most"), [(0.05, 3), (0.0012, 3), (0.0012, 0)])
def test_the_same_draw_is_the_same_flight_in_every_engine(
    engine: str, tolerance: float, most: int
) -> None:
    """A tight tolerance makes some need a correction, which lanes leave to the planner."""
    settings = {
        "planner.position_tolerance": 0.05,
        "planner.attitude_tolerance": tolerance,
        "planner.max_corrections": most,
    }
    made = campaign(disperse=DISPERSED, flights=12, seed=1, set=settings)
    of_lanes, one_by_one = assert_same_flights(made, engine)
    engines = [row.engine for row in of_lanes.values()]
    corrected = sum(row.metrics["corrections"] > 0 for row in one_by_one.values())
    assert engines.count("flights") == corrected
    assert 0 < corrected < 12 if tolerance < 0.01 and most else not corrected
    failed = [row.outcome for row in of_lanes.values()].count("failed")
    assert 0 < failed < 12 if not most else not failed


CONTROL: dict[str, Any] = {
    "plant.initial_joint_velocities": [0.1, -0.05],
    "coordinated_control.profile": "quintic",
    "coordinated_control.settle_time": 0.2,
    "coordinated_control.time_limit": 1.8,
    "coordinated_control.position_tolerance": 0.022,
    "coordinated_control.attitude_tolerance": 0.01,
    **{f"coordinated_control.motion.{name}": 5.0 for name in ("speed", "acceleration")},
    **{f"coordinated_control.motion.angular_{name}": 5.0 for name in ("speed", "acceleration")},
    **{
        f"coordinated_control.gains.{of}.{name}": value
        for of in ("base_position", "base_attitude", "end_effector_position")
        for name, value in (("kp", 3000.0), ("kd", 400.0))
    },
}
"""A spacecraft and its arm fly to their goals in two seconds, or do not."""

CONTROLLED: dict[str, Any] = {
    "mass.*": {"norm": {"loc": 1.0, "scale": 0.03}},
    "com.base_link.x": {"norm": {"scale": 0.01}},
    "goal.position.x": {"norm": {"scale": 0.02}},
    "initial.rotvec.z": {"norm": {"scale": 0.02}},
    "end_effector_goal.position.y": {"norm": {"scale": 0.02}},
    "plant.sensors.position_noise": {"uniform": [0.0, 0.002]},
    "plant.sensors.joint_rate_noise": {"uniform": [0.0, 0.0001]},
    "plant.sensors.position_bias[0]": {"uniform": [0.0, 0.001]},
    "coordinated_control.gains.base_position.kd": {"uniform": [400.0, 460.0]},
}


def controlled(**given: Any) -> Campaign:
    """Return a campaign of coordinated control, of flights that are short."""
    wanted = {"scenario": "coordinated_control", "disperse": CONTROLLED, "seed": 3, **given}
    return parse_campaign("controlled", {**wanted, "set": {**CONTROL, **given.get("set", {})}})


@on_engines()
def test_coordinated_control_in_lanes_is_that_of_the_plant_and_the_controller(engine: str) -> None:
    """Masses, noise, biases, goals, starts and gains differ; some come too late."""
    made = controlled(flights=9)
    assert select_engine(made, "auto").name == "lanes"
    of_lanes, _ = assert_same_flights(made, engine)
    assert {row.engine for row in of_lanes.values()} == {engine}
    assert {row.outcome for row in of_lanes.values()} == {"reached", "failed"}
    assert len({row.metrics["duration_s"] for row in of_lanes.values()}) > 3


@pytest.mark.parametrize("engine", some_fast([LanesEngine, FlightsEngine], LanesEngine))
def test_every_flight_has_noise_of_its_own(engine: type[LanesEngine | FlightsEngine]) -> None:
    """Nothing but the noise differs: the campaign's seed and the number of the flight decide it."""
    same = {"goal.position.x": {"choice": [0.5]}}
    noisy = {"plant.sensors.position_noise": 0.002, "plant.sensors.joint_rate_noise": 1e-4}

    def ends(seed: int) -> list[float]:
        made = controlled(flights=3, seed=seed, disperse=same, set=noisy, longest=0.3)
        rows = flown(engine(), made)
        return [rows[number].metrics["position_error_m"] for number in range(3)]

    first, again, other = ends(3), ends(3), ends(4)
    assert first == again
    assert len({*first, *other}) == 6


@on_engines()
def test_flights_in_lanes_are_interrupted_or_left_to_the_controller(engine: str) -> None:
    """The longest time ends them all; joints that seem to race have control given up."""
    of_lanes, _ = assert_same_flights(controlled(flights=3, longest=0.305), engine)
    assert {row.outcome for row in of_lanes.values()} == {"interrupted"}
    wild = {**CONTROLLED, "plant.sensors.joint_rate_noise": {"choice": [0.0, 8.0]}}
    of_lanes, one_by_one = assert_same_flights(
        controlled(flights=6, disperse=wild, longest=0.5), engine
    )
    lost = {number for number, row in one_by_one.items() if row.outcome == "aborted"}
    assert 0 < len(lost) < 6
    assert {n for n, row in of_lanes.items() if row.engine == "flights"} == lost
    assert {of_lanes[number].draw.fallback for number in lost} == {"lost control"}


@on_engines("lanes")
def test_a_goal_out_of_the_plane_is_refused_in_lanes_as_elsewhere(engine: str) -> None:
    disperse = {"goal.position.z": {"choice": [0.0, 0.4]}}
    of_lanes, _ = assert_same_flights(controlled(flights=6, disperse=disperse, longest=0.2), engine)
    assert {row.outcome for row in of_lanes.values()} == {"interrupted", "refused"}
    for row in of_lanes.values():
        refused = row.outcome == "refused"
        assert row.engine == ("flights" if refused else engine)
        assert ("along z of the world" in row.reason) is refused


@on_engines("lanes")
def test_a_part_that_is_asked_for_and_not_controlled_is_missed_in_lanes_as_elsewhere(
    engine: str,
) -> None:
    """An arm turns its spacecraft, and leaves the place that a draw asks for."""
    settings = {"planner.max_corrections": 0, "planner.method": "optimal"}
    for disperse, outcome in (
        ({"goal.position.x": {"uniform": [0.1, 0.2]}}, "reached_partly"),
        ({"goal.rotvec.x": {"uniform": [0.0, 1e-3]}}, "reached"),
    ):
        wanted = {"scenario": "arm_attitude", "seed": 2, "flights": 3, "set": settings}
        made = parse_campaign("arm", {**wanted, "disperse": disperse})
        of_lanes, _ = assert_same_flights(made, engine)
        assert {(row.engine, row.outcome) for row in of_lanes.values()} == {(engine, outcome)}
        assert all(row.passed is (outcome == "reached") for row in of_lanes.values())


@on_engines()
def test_a_draw_that_is_refused_leaves_the_others_of_its_batch_in_lanes(engine: str) -> None:
    """Each has its own reason: a start beyond the joint limits, noise below zero."""
    refused: dict[str, Any] = {
        "initial.joints.elbow": {"choice": [0.0, 9.0]},
        "plant.sensors.joint_noise": {"uniform": {"loc": -0.0001, "scale": 0.0003}},
    }
    made = controlled(flights=12, disperse=refused, longest=0.2)
    of_lanes, _ = assert_same_flights(made, engine)
    reasons = {number: row.reason for number, row in of_lanes.items() if row.outcome == "error"}
    for part in ("is outside its limits", "must be a number from 0"):
        assert any(part in reason for reason in reasons.values()), (part, reasons)
    assert 3 <= len(reasons) < 12
    flown_in_lanes = {number for number, row in of_lanes.items() if row.engine == engine}
    assert set(of_lanes) - set(reasons) <= flown_in_lanes
    assert all(x.draw.fallback in ("", x.reason) for x in of_lanes.values())


@on_engines()
def test_lanes_measure_the_end_effector_that_a_planner_does_not_move(engine: str) -> None:
    """Its goal is one of the scenario: the criterion is of where it is, in every engine."""
    made = campaign(
        disperse={"mass.*": {"norm": {"loc": 1.0, "scale": 0.03}}},
        flights=2,
        set={"plant.end_effector_frame": "mass_2", "planner.max_corrections": 0},
    )
    goal = Goal.checked([0.4, 0.1, 0.2], [0.0, 0.0, 0.0, 1.0])
    scenario = replace(made.scenario, end_effector_goal=goal)
    of_lanes, one_by_one = assert_same_flights(replace(made, scenario=scenario), engine)
    for row in (*of_lanes.values(), *one_by_one.values()):
        assert 0.0 < row.metrics["end_effector_position_error_m"] < 5.0
    assert {row.engine for row in of_lanes.values()} == {engine}


@on_engines("lanes")
def test_draws_that_are_no_robot_and_no_number_end_no_other_flight(engine: str) -> None:
    nothing = {"mass": {"choice": [0.0, 1.0]}}
    of_lanes, _ = assert_same_flights(controlled(flights=6, disperse=nothing, longest=0.2), engine)
    infinite = {"plant.sensors.seed": {"pareto": {"b": 0.001}}}
    of_none, _ = assert_same_flights(controlled(flights=4, disperse=infinite), engine)
    sentence = "The value drawn for 'plant.sensors.seed' is inf."
    assert sentence in {row.reason for row in of_none.values()}
    # Some are finite, and larger than a ROS parameter can be.
    assert any("a 64-bit integer" in row.reason for row in of_none.values())
    assert {row.outcome for row in of_none.values()} == {"error"}
    weightless = [row.reason for row in of_lanes.values() if not row.draw.values["mass"]]
    assert 0 < len(weightless) < 6
    assert set(weightless) == {"The total robot mass is zero."}
    assert {row.engine for row in of_lanes.values()} == {engine}


class HalfLaw(TransposedJacobianLaw):
    """A law of one's own, whose command is more than its function."""

    def actuation(self, reference: Reference) -> Actuation:
        whole = super().actuation(reference)
        return Actuation(0.5 * whole.wrench_B, 0.5 * whole.tau)


class SaidHalfLaw(HalfLaw):
    """The same law, which says so."""

    def is_complete(self, results: Mapping[str, ca.SX]) -> ca.SX:
        return ca.SX(0)


def test_lanes_fly_the_whole_command_of_a_law_or_leave_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made = controlled(flights=2, longest=0.2)
    monkeypatch.setitem(LAWS, "transposed_jacobian", HalfLaw)
    assert select_engine(made, "auto").name == "flights"
    with pytest.raises(SpaceRobotError, match=r"'transposed_jacobian' .* not a single function"):
        select_engine(made, "lanes")
    monkeypatch.setitem(LAWS, "transposed_jacobian", SaidHalfLaw)
    of_lanes, _ = assert_same_flights(made, "lanes")
    assert {row.engine for row in of_lanes.values()} == {"lanes"}


class WeakLaw(TransposedJacobianLaw):
    """A law of one's own that is changed in place, as notebooks do."""

    share = 1.0

    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        found = super().results(symbols)
        return {**found, "actuation": self.share * found["actuation"]}


def test_a_law_that_was_changed_is_another_law(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(LAWS, "transposed_jacobian", WeakLaw)
    made, forces = controlled(flights=1, longest=0.2), []
    for share in (1.0, 0.5):
        monkeypatch.setattr(WeakLaw, "share", share)
        of_lanes, _ = assert_same_flights(made, "lanes")
        forces.append(of_lanes[0].metrics["peak_force_N"])
    assert forces[1] < forces[0]


TARGET = str(share_directory() / "config" / "targets" / "block.urdf")
OUTSIDE = "it has disturbances, an orbit or a table; use engine 'flights'"
AVERAGES = "the planner averages states, or monitors the path"
MEASURED = "the joints are measured with errors"
STEADY = "coordinated_control.gains.base_position.ki"
NOT_IN_LANES: list[tuple[Callable[..., Campaign], dict[str, Any], str]] = [
    (campaign, {"set": {"plant.faults": ["joint_stuck slider_1 at 1"]}}, "it has faults"),
    (campaign, {"set": {"plant.disturbances": ["mass_1 force 1 0 0 at 1"]}}, OUTSIDE),
    (campaign, {"set": {"plant.orbit.altitude": 4e5}}, OUTSIDE),
    (campaign, {"disperse": {"plant.table.friction": {"uniform": [0.0, 0.1]}}}, OUTSIDE),
    (controlled, {"set": {STEADY: 0.5}}, "integral gains; use engine 'flights'"),
    (controlled, {"disperse": {STEADY: {"uniform": [0.0, 0.5]}}}, "integral gains; use engine"),
    (campaign, {"set": {"plant.target.robot": TARGET}}, "it has a target"),
    (campaign, {"set": {"plant.engine": "mujoco"}}, "its plant uses the engine 'mujoco'"),
    (
        campaign,
        {"criteria": {"clearance_m": {"min": 0.0}}},
        "lanes measure no distances between links",
    ),
    (
        controlled,
        {"set": {"plant.world": str(share_directory() / "config" / "worlds" / "panel.urdf")}},
        "it has obstacles, and lanes do not detect contacts",
    ),
    (campaign, {"set": {"plant.sensors.joint_noise": 1e-3}}, MEASURED),
    (campaign, {"set": {"plant.sensors.joint_bias": [0, 0, 0.1]}}, MEASURED),
    (campaign, {"set": {"planner.averaging": 3}}, AVERAGES),
    (campaign, {"set": {"planner.drift_position": 0.1}}, AVERAGES),
    (campaign, {"set": {"planner.drift_attitude": 0.1}}, AVERAGES),
    (campaign, {"set": {"planner.output": "reference"}}, "the planner replans during the motion"),
    (
        controlled,
        {"set": {"plant.beyond_limits": "refuse"}},
        "the plant refuses commands beyond limits",
    ),
    (
        controlled,
        {"set": {"coordinated_control.tasks": "detumble"}},
        "its controller performs tasks before goals; use engine 'flights'",
    ),
    *(
        (
            campaign,
            {"disperse": {name: {"choice": values}}},
            f"'{name}' is dispersed, but shared by all lanes",
        )
        for name, values in (
            # What would be another kind of flight is not flown as the nominal one.
            ("plant.actuation", ["velocity", "effort"]),
            ("plant.engine", ["exact", "mujoco"]),
            ("plant.tick_rate", [20]),
            ("plant.integration_step", [1.0, 3.0]),
            ("planner.tick_rate", [1.0, 3.0]),
            ("planner.averaging", [1.0, 3.0]),
            ("planner.shape_gain", [1.0, 3.0]),
            ("planner.drift_position", [1.0, 3.0]),
            ("planner.max_corrections", [1.0, 3.0]),
            ("planner.replan_period", [1.0, 3.0]),
        )
    ),
]


@pytest.mark.parametrize(("make", "given", "why"), NOT_IN_LANES)
def test_campaigns_that_lanes_cannot_fly_are_flown_one_by_one(
    make: Callable[..., Campaign], given: dict[str, Any], why: str
) -> None:
    made = make(**given)
    assert select_engine(made, "auto").name == "flights"
    with pytest.raises(SpaceRobotError) as refused:
        select_engine(made, "lanes")
    assert str(refused.value).startswith("The engine 'lanes' cannot fly this campaign: ")
    assert why in str(refused.value)


def test_the_engine_is_chosen() -> None:
    made = campaign(disperse=DISPERSED)
    assert select_engine(made, "auto").name == "lanes"
    assert select_engine(made, "flights").name == "flights"
    for made in (
        campaign(set={"planner.averaging": 1}),
        campaign(set={"plant.sensors.joint_bias": [0, 0, 0.0]}),
        controlled(),
        controlled(set={"coordinated_control.law": "transposed_jacobian"}),
    ):
        assert select_engine(made, "lanes").name == "lanes"


def test_a_device_flies_large_campaigns_of_controllers_where_there_is_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    large = replace(controlled(), flights=100_000)
    assert select_engine(large, "auto").name == "lanes"
    with pytest.raises(SpaceRobotError, match="require cupy, which is not installed: pip install"):
        select_engine(large, "cuda:3")
    with pytest.raises(SpaceRobotError, match="There is no device 'cuda:x': use cuda, cuda:1, "):
        select_engine(large, "cuda:x")
    monkeypatch.setattr(workers, "find_spec", lambda name: name == "cupy")
    for module in (workers, lanes):
        monkeypatch.setattr(module, "device_named", lambda name: targets.THREADS_OF_HOST)
    workers.engine_by_name.cache_clear()
    assert select_engine(large, "auto").name == "cuda"
    assert select_engine(large, "auto", local=False).name == "lanes"
    assert select_engine(replace(large, flights=99_999), "auto").name == "lanes"
    assert select_engine(replace(campaign(), flights=100_000), "auto").name == "lanes"
    workers.engine_by_name.cache_clear()


@on_engines("lanes")
def test_a_campaign_that_is_stopped_in_flight_has_no_rows_of_that_batch(engine: str) -> None:
    """It is stopped by the second check in the batch, after 2000 of 3000 ticks."""
    far = {"coordinated_control.time_limit": 40.0, "coordinated_control.position_tolerance": 1e-9}
    made, asked = controlled(flights=2, set=far, longest=30.0), 0

    def stopped() -> bool:
        nonlocal asked
        asked += 1
        return asked > made.flights + 1

    assert not list(engine_named(engine).fly(made, list(Draws(made)), stopped))
    assert asked == made.flights + 2


@on_engines("lanes")
@pytest.mark.parametrize(
    ("corrections", "longest", "outcome", "fallback"),
    [
        (0, 300.0, "failed", ""),
        (3, 300.0, "failed", "needed corrections"),
        (0, 1.0, "interrupted", "took longer than the campaign allows"),
    ],
)
def test_what_a_first_schedule_does_not_decide_is_left_to_the_planner(
    engine: str, corrections: int, longest: float, outcome: str, fallback: str
) -> None:
    """The tolerance is smaller than what noise and gaits of first order leave."""
    tight = {"planner.position_tolerance": 1e-9, "planner.attitude_tolerance": 1e-9}
    given = {**tight, "planner.max_corrections": corrections}
    made = campaign(disperse=DISPERSED, flights=2, set=given, longest=longest)
    rows = flown(engine_named(engine), made)
    assert {row.outcome for row in rows.values()} == {outcome}
    assert {row.draw.fallback for row in rows.values()} == {fallback}


def test_a_batch_that_is_complete_when_the_campaign_is_stopped_is_kept() -> None:
    """Flights of less than 2000 ticks are looked at once before each draw and once in flight."""
    made, looks = campaign(disperse=DISPERSED, flights=3), itertools.count(1)
    rows = list(LanesEngine("lanes").fly(made, list(Draws(made)), lambda: next(looks) > 4))
    draws = [each.draw if isinstance(each, Row) else each for each in rows]
    assert sorted(draw.number for draw in draws) == [0, 1, 2]
    looks = itertools.count(1)
    assert list(LanesEngine("lanes").fly(made, list(Draws(made)), lambda: next(looks) > 3)) == []
