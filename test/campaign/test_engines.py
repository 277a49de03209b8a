"""What engines answer, batch and measure, by stand-ins for their flights."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.campaigns import campaign

from spacerobot_ros.batch import Decision
from spacerobot_ros.campaign import engines, lanes
from spacerobot_ros.campaign import one_by_one as engine_of_flights
from spacerobot_ros.campaign.config import Campaign, parse_campaign
from spacerobot_ros.campaign.draws import Draw, Draws
from spacerobot_ros.campaign.engines import fly_all, select_engine
from spacerobot_ros.campaign.lanes import (
    LanesEngine,
    _ControlledLanes,
    _PreparedDraw,
    _ScheduledLanes,
)
from spacerobot_ros.campaign.one_by_one import FlightsEngine
from spacerobot_ros.campaign.rows import Fallback, Row
from spacerobot_ros.campaign.targets import DrawnFlight
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.measures import Measures, Outcome
from spacerobot_ros.planning import Goal, PoseError

PLANNED = campaign(flights=8)
CONTROLLED = parse_campaign("controlled", {"scenario": "coordinated_control", "flights": 8})


def disperse(name: str, **given: Any) -> dict[str, Any]:
    return {"disperse": {name: {"uniform": [1.0, 2.0]}}, **given}


def controlled(**given: Any) -> Campaign:
    return parse_campaign("controlled", {"scenario": "coordinated_control", **given})


one_by_one: Any = engine_of_flights

# -- which campaigns lanes fly --------------------------------------------------------------------

SHARED = "is dispersed, and all lanes share it"


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({}, ""),
        (disperse("plant.sensors.position_noise"), ""),
        ({"set": {"planner.averaging": 2}}, "the planner averages states, or watches the path"),
        ({"set": {"planner.averaging": 1}}, ""),
        ({"set": {"planner.drift_position": 0.1}}, "the planner averages states, or watches"),
        ({"set": {"planner.drift_attitude": 0.1}}, "the planner averages states, or watches"),
        ({"set": {"planner.output": "reference"}}, "the planner plans again on the way"),
        ({"set": {"plant.sensors.joint_noise": 0.1}}, "the joints are measured with errors"),
        ({"set": {"plant.sensors.joint_bias": [0, 0, 0.1]}}, "the joints are measured with errors"),
        ({"set": {"plant.sensors.joint_bias": [0, 0, 0.0]}}, ""),
        (disperse("plant.sensors.joint_noise"), "the joints are measured with errors"),
        *(
            (disperse(name), f"'{name}' {SHARED}")
            for name in (
                *("plant.tick_rate", "plant.integration_step", "planner.tick_rate"),
                *("planner.averaging", "planner.drift_position", "planner.shape_gain"),
                *("planner.max_corrections", "planner.replan_period"),
            )
        ),
    ],
)
def test_which_planned_campaigns_are_flown_in_lanes(given: dict[str, Any], reason: str) -> None:
    found = _ScheduledLanes().refusal(campaign(**given))
    assert found.startswith(reason) if reason else not found, found


def test_a_goal_of_end_effectors_is_not_flown_in_lanes() -> None:
    scenario = SimpleNamespace(
        planner=SimpleNamespace(averaging=1, drift_position=0.0, drift_attitude=0.0),
        plant=SimpleNamespace(sensors=None),
        goal=SimpleNamespace(end_effectors=("hand",)),
    )
    made: Any = SimpleNamespace(scenario=scenario)
    assert _ScheduledLanes().refusal(made) == "the goal is for end-effectors"


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({}, ""),
        (disperse("coordinated_control.gains.base_position.kp"), ""),
        (disperse("plant.sensors.joint_noise"), ""),
        (
            disperse("coordinated_control.time_limit"),
            f"'coordinated_control.time_limit' {SHARED}",
        ),
        *(
            (disperse(name), f"'{name}' {SHARED}")
            for name in ("plant.tick_rate", "plant.integration_step")
        ),
        (
            {"set": {"plant.thrusters": "urdf"}},
            "its thrusters are on or off, which engine 'flights' flies",
        ),
        (
            {"set": {"plant.beyond_limits": "refuse"}},
            "the plant refuses commands beyond limits",
        ),
        (
            {"set": {"coordinated_control.tasks": "detumble"}},
            "its controller has tasks before goals, which engine 'flights' does",
        ),
    ],
)
def test_which_controlled_campaigns_are_flown_in_lanes(given: dict[str, Any], reason: str) -> None:
    assert _ControlledLanes().refusal(controlled(**given)) == reason


@pytest.mark.parametrize(
    ("fixed", "selection", "reason"),
    [
        (1, {"base": True, "end_effector": True}, ""),
        (None, {}, "the law 'own' with these options is more than one function"),
        (0, {"base": False}, "the law 'own' does not control the base"),
        (
            0,
            {"base": True, "end_effector": False},
            "the law 'own' does not control the end-effector",
        ),
    ],
)
def test_laws_of_lanes_are_one_function_and_control_the_goals(
    fixed: int | None, selection: dict[str, bool], reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    outputs = SimpleNamespace(selection=SimpleNamespace(**selection))
    law = SimpleNamespace(name="own", fixed_inputs=fixed, outputs=outputs, integrates=False)
    monkeypatch.setattr(lanes, "build_controller", lambda *_: SimpleNamespace(law=law))
    robot = SimpleNamespace(description=SimpleNamespace(wheel_names=()))
    monkeypatch.setattr(lanes, "nominal_robots", lambda _: SimpleNamespace(controller=robot))
    assert _ControlledLanes().refusal(CONTROLLED) == reason

    def refuse(*_: Any) -> Any:
        raise SpaceRobotError("No such law.")

    monkeypatch.setattr(lanes, "build_controller", refuse)
    assert _ControlledLanes().refusal(CONTROLLED) == "No such law."


def test_lanes_choose_between_a_planner_and_a_controller(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    engine = LanesEngine()
    monkeypatch.setattr(engine._flights, "refusal", lambda made: "")
    monkeypatch.setattr(engine._scheduled, "refusal", lambda made: f"scheduled {made.name}")

    monkeypatch.setattr(engine._controlled, "refusal", lambda made: f"controlled {made.name}")
    assert engine.refusal(PLANNED) == "scheduled short"
    assert engine.refusal(CONTROLLED) == "controlled controlled"
    both = replace(CONTROLLED.scenario, commanders=("planner", "coordinated_control"))
    assert engine.refusal(replace(CONTROLLED, scenario=both)) == (
        "lanes have velocities of a planner, or efforts of coordinated control"
    )
    faulty = replace(PLANNED, dispersions=(SimpleNamespace(name="faults[0].at"),))  # type: ignore[arg-type]
    assert engine.refusal(faulty) == "it has faults"
    monkeypatch.setattr(engine._flights, "refusal", lambda made: "no")
    assert engine.refusal(PLANNED) == "no"


def test_an_engine_is_chosen_by_name_or_the_first_that_can(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[str] = []

    def engine(name: str, reason: str) -> Callable[[], Any]:
        def refusal(made: Any) -> str:
            asked.append(name)
            return reason

        return lambda: SimpleNamespace(name=name, refusal=refusal)

    def choose(**reasons: str) -> None:
        made = {name: engine(name, reason) for name, reason in reasons.items()}
        monkeypatch.setattr(engines, "ENGINE_FACTORIES", made)

    choose(one="not one", two="", three="")
    assert select_engine(PLANNED, "auto").name == "two"
    assert asked == ["one", "two"]
    assert select_engine(PLANNED, "three").name == "three"
    assert asked[2:] == ["three"]
    with pytest.raises(SpaceRobotError) as refused:
        select_engine(PLANNED, "one")
    assert str(refused.value) == "The engine 'one' cannot fly this campaign: not one"
    choose(one="not one.", two="nor two.")
    with pytest.raises(SpaceRobotError) as refused:
        select_engine(PLANNED, "auto")
    assert str(refused.value) == ("No engine can fly this campaign. one: not one. two: nor two.")


# -- batches --------------------------------------------------------------------------------------


def ready(number: int, ticks: int = 0, plan_time: float = 0.5) -> _PreparedDraw:
    plan: Any = SimpleNamespace(schedule=SimpleNamespace(ticks=ticks)) if ticks else None
    return _PreparedDraw(Draw(number, 1, {}), None, plan, plan_time)  # type: ignore[arg-type]


@pytest.fixture
def batched(monkeypatch: pytest.MonkeyPatch) -> Callable[..., tuple[list[Any], list[list[int]]]]:
    """Return what flies draws in lanes of 3 at most, and says which were together.

    Draw 2 is refused, draw 4 left to another engine; a second passes with each.
    """

    def fly(
        made: Campaign, count: int, ticks: int = 1, pace: float = 0.0, stop: int = 99
    ) -> tuple[list[Any], list[list[int]]]:
        engine, batches, now = LanesEngine(), list[list[int]](), [0.0]

        def prepare(campaign: Campaign, draw: Draw, flight: Any) -> _PreparedDraw | Fallback:
            now[0] += pace
            if draw.number == 2:
                raise ValueError("no\n way")
            return Fallback(draw, "left") if draw.number == 4 else ready(draw.number, ticks)

        def flown(campaign: Campaign, of: Any, batch: list[_PreparedDraw]) -> Iterator[Any]:
            batches.append([each.draw.number for each in batch])
            yield from (each.draw.number for each in batch)

        monkeypatch.setattr(lanes, "time", SimpleNamespace(perf_counter=lambda: now[0]))
        monkeypatch.setattr(
            lanes, "drawn_flights", lambda made, draws, common: ((draw, None) for draw in draws)
        )
        monkeypatch.setattr(engine, "_fly_batch", flown)
        kinds = SimpleNamespace(max_batch_flights=3, prepare_draw=prepare)
        name = "_scheduled" if "planner" in made.scenario.commanders else "_controlled"
        other = "_controlled" if name == "_scheduled" else "_scheduled"
        monkeypatch.setattr(engine, name, kinds)
        monkeypatch.setattr(engine, other, None)
        draws = [Draw(number, 1, {}) for number in range(count)]
        looks = iter(range(100))
        return list(engine.fly(made, draws, lambda: next(looks) >= stop)), batches

    return fly


@pytest.mark.parametrize("made", [PLANNED, CONTROLLED], ids=lambda made: made.name)
def test_batches_are_of_as_many_draws_as_lanes_take(
    made: Campaign, batched: Callable[..., Any]
) -> None:
    found, batches = batched(made, 9)
    assert batches == [[0, 1, 3], [5, 6, 7], [8]]
    error, fallback = (each for each in found if not isinstance(each, int))
    assert (error.outcome, error.reason, error.engine) == ("error", "ValueError: no way", "lanes")
    assert (fallback.draw.number, fallback.reason) == (4, "left")
    # Whole batches leave nothing over, and a stop leaves what is ready.
    assert batched(made, 4)[1] == [[0, 1, 3]]
    assert batched(made, 9, stop=1)[1] == []


def test_batches_end_with_their_ticks_and_their_time(batched: Callable[..., Any]) -> None:
    assert batched(PLANNED, 6, ticks=2_000_000)[1] == [[0, 1, 3], [5]]
    assert batched(PLANNED, 6, ticks=2_000_001)[1] == [[0, 1], [3, 5]]
    # Batches begin with the time at which the last one was flown.
    assert batched(PLANNED, 8, pace=2.0)[1] == [[0, 1, 3], [5, 6], [7]]
    assert batched(PLANNED, 8, pace=2.5)[1] == [[0, 1], [3], [5], [6, 7]]
    assert batched(PLANNED, 4, pace=4.0)[1] == [[0, 1], [3]]
    assert batched(PLANNED, 2, pace=4.5)[1] == [[0], [1]]


def measures(**given: Any) -> Measures:
    n = 3
    numbers = {"peak_rate": n, "peak_effort": n, "peak_wrench": 2, "lowest": n, "highest": n}
    arrays = {name: np.zeros(size) for name, size in numbers.items()}
    wanted: dict[str, Any] = {"outcome": Outcome.REACHED, "message": "There.", "duration": 2.0}
    wanted |= {"manoeuvre_time": 1.5, "error": None}
    return Measures(**{**wanted, **arrays, "momentum_drift": np.zeros(2), **given})


def test_a_batch_is_rows_and_what_is_left_to_others(monkeypatch: pytest.MonkeyPatch) -> None:
    made = replace(PLANNED, max_flight_time=2.0)
    answers = [
        measures(duration=1.5, wall_time=0.8),
        "had a joint at its limit",
        measures(duration=2.25, wall_time=1.8),
        "lost control",
        "lost control",
    ]

    def measured(*given: Any) -> Any:
        assert given == (made, "result", batch, "flights", 0.8)
        return answers

    times = iter([10.0, 14.0])
    monkeypatch.setattr(lanes, "time", SimpleNamespace(perf_counter=lambda: next(times)))
    monkeypatch.setattr(lanes, "fly_lanes", lambda flights: "result")
    kind: Any = SimpleNamespace(flights=lambda made, batch: "flights", measures=measured)
    batch = [ready(n) for n in range(5)]
    *left, first, last = LanesEngine()._fly_batch(made, kind, batch)
    reasons = {1: "had a joint at its limit", 3: "lost control", 4: "lost control"}
    assert left == [Fallback(Draw(number, 1, {}), reason) for number, reason in reasons.items()]
    assert isinstance(first, Row)
    assert isinstance(last, Row)
    assert (first.wall_time, first.engine, first.outcome) == (0.8, "lanes", "reached")
    assert [each.draw.number for each in (first, last)] == [0, 2]
    assert [each.metrics["duration_s"] for each in (first, last)] == [1.5, 2.25]
    assert last.wall_time == 1.8


def test_a_batch_that_is_refused_is_left_to_another_engine(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(*_: Any) -> Any:
        raise SpaceRobotError("No robot.")

    found = list(LanesEngine()._fly_batch(PLANNED, SimpleNamespace(flights=refuse), [ready(3)]))  # type: ignore[arg-type]
    assert found == [Fallback(Draw(3, 1, {}), "No robot.")]


def test_sizes_of_batches_and_of_first_tasks() -> None:
    assert (_ScheduledLanes.max_batch_flights, _ControlledLanes.max_batch_flights) == (512, 128)
    found = {each.name: each.efficient_flights for each in (LanesEngine, FlightsEngine)}
    assert found == {"lanes": 64, "flights": 1}


# -- measures of lanes ----------------------------------------------------------------------------

START = PLANNED.scenario
UNIT = (0.0, 0.0, 0.0, 1.0)


def scheduled(**given: Any) -> Any:
    """Return what lanes measure of the second of two flights, along a schedule of two ticks.

    It ends 3 cm from the goal, of which 2 are measured.
    """
    goal = Goal.checked([0.0625, -0.5, 0.25], UNIT)
    end = np.array([*(goal.position - [0.0, 0.0, 0.03]), *goal.quaternion])
    sensed = np.array([*(goal.position - [0.0, 0.02, 0.0]), *goal.quaternion])
    shape = np.array([0.25, -0.5, 0.125])
    positions = np.array([[0.0, 0.0, 0.0], [0.5, -0.25, 0.0625], shape])
    poses = np.zeros((2, 3, 7))
    poses[1, 2] = end
    measured = np.zeros((2, 3, 7))
    measured[1, 2] = sensed
    momentum = np.zeros((2, 3, 7))
    momentum[1, :, 0] = 0.0, 3.0, 1.0
    momentum[1, :, 4] = 7.0, 5.0, 6.5
    limited = np.array(given.get("limited", [[1], [0]]))
    result = SimpleNamespace(
        limited_ticks={"position": np.zeros((2, 3), int), "rate": limited},
        measured_pose=measured,
        measured_q=np.broadcast_to(shape + given.get("off", 0.0), (2, 3, 3)),
        pose=poses,
        q=np.zeros((2, 3, 3)),
        time=np.array([1.0, 1.25, 3.5]),
        peak_rate=np.array([[9.0] * 3, [1.0, 2.0, 3.0]]),
        peak_effort=np.array([[9.0] * 3, [4.0, 5.0, 6.0]]),
        momentum=momentum,
    )
    schedule = SimpleNamespace(
        ticks=2, positions=positions, controls=frozenset(("position", "attitude"))
    )
    plan: Any = SimpleNamespace(schedule=schedule, status=SimpleNamespace(corrections=1))
    planner = {"max_corrections": 0, "position_tolerance": 0.02, **given.get("planner", {})}
    flight = DrawnFlight.of(START.with_poses(goal, None).with_overrides("planner", planner))
    draw = _PreparedDraw(Draw(1, 1, {}), flight, plan, 0.375)
    first = SimpleNamespace(ticks=1, positions=positions, controls=schedule.controls)
    plan = SimpleNamespace(schedule=first, status=plan.status)
    batch = [_PreparedDraw(Draw(0, 1, {}), flight, plan), draw]
    robot = SimpleNamespace(description=SimpleNamespace(end_effector=lambda frame: ""))
    flights: Any = SimpleNamespace(report_ticks=(0, 1, 2), robot=robot)
    made = replace(PLANNED, max_flight_time=given.get("longest", 2.5))
    one = SimpleNamespace(**vars(result), failures=given.get("failures", {}))
    _, found = _ScheduledLanes().measures(made, one, batch, flights, 0.25)  # type: ignore[arg-type]
    return found


def test_the_measures_along_a_schedule_are_those_of_its_end() -> None:
    found = scheduled(planner={"position_tolerance": 0.0201})
    assert (found.outcome, found.message) == (
        Outcome.REACHED,
        "The goal is reached: 0.02 m and 0 rad from the goal (tolerance 0.0201 m, 0.001 rad).",
    )
    assert (found.duration, found.manoeuvre_time) == (2.5, 2.5)
    assert found.error.distance == pytest.approx(0.03)
    assert math.isnan(found.end_effector_distance)
    assert math.isnan(found.end_effector_angle)
    assert (found.corrections, found.plan_time) == (1, 0.375)
    assert found.wall_time == 0.625
    np.testing.assert_array_equal(found.peak_rate, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(found.peak_effort, [4.0, 5.0, 6.0])
    np.testing.assert_array_equal(found.peak_wrench, [0.0, 0.0])
    np.testing.assert_array_equal(found.lowest, [0.0, -0.5, 0.0])
    np.testing.assert_array_equal(found.highest, [0.5, 0.0, 0.125])
    np.testing.assert_array_equal(found.momentum_drift, [3.0, 2.0])


@pytest.mark.parametrize(
    ("given", "reason"),
    [
        ({"limited": [[0], [2]]}, "had a joint at its limit"),
        ({"limited": [[0], [2]], "failures": {1: "no"}}, "was refused by the plant"),
        ({"failures": {0: "no"}}, None),
        ({"longest": 2.4}, "took longer than the campaign allows"),
        ({"off": 1.1e-6}, "had a joint that did not follow its schedule"),
        ({"off": 0.9e-6}, None),
        ({"off": 0.0009, "planner": {"shape_deadband": 0.001}}, None),
        ({"off": -0.0011, "planner": {"shape_deadband": 0.001}}, "had a joint that did not"),
        (
            {"planner": {"position_tolerance": 0.019, "max_corrections": 1}},
            "needed corrections",
        ),
    ],
)
def test_what_a_schedule_does_not_decide_is_left_to_the_planner(
    given: dict[str, Any], reason: str | None
) -> None:
    options = {"position_tolerance": 0.0201, **given.pop("planner", {})}
    found = scheduled(planner=options, **given)
    if reason is None:
        assert found.outcome is Outcome.REACHED
    else:
        assert isinstance(found, str)
        assert found.startswith(reason)


def test_a_goal_that_is_missed_without_corrections_has_failed() -> None:
    found = scheduled(planner={"position_tolerance": 0.0199})
    assert found.outcome is Outcome.FAILED
    assert found.message == (
        "The goal is not reached: 0.02 m and 0 rad from the goal (tolerance 0.0199 m, 0.001 rad) "
        "after 0 correction(s)."
    )


def test_the_batch_of_schedules_is_as_long_as_the_longest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Shorter ones rest at their ends; of each every fourth state and its last one are kept."""
    given: list[Any] = []

    def noted(*arguments: Any, **named: Any) -> None:
        given.append((arguments, named))

    monkeypatch.setattr(lanes, "_batch_of_flights", noted)
    long, short = np.arange(404.0).reshape(101, 4), np.arange(8.0).reshape(2, 4)

    def flown(positions: np.ndarray) -> Any:
        planner = SimpleNamespace(shape_gain=0.75, shape_deadband=0.125)
        schedule = SimpleNamespace(ticks=len(positions) - 1, positions=positions)
        flight = SimpleNamespace(scenario=SimpleNamespace(planner=planner))
        return SimpleNamespace(flight=flight, schedule=schedule)

    batch: list[Any] = [flown(long), flown(short)]
    _ScheduledLanes().flights(PLANNED, batch)
    (drawn, program, ticks), named = given[0]
    assert drawn == [each.flight for each in batch]
    assert (program.shape_gain, program.deadband) == (0.75, 0.125)
    assert ticks == 100
    np.testing.assert_array_equal(program.positions[0], long)
    np.testing.assert_array_equal(program.positions[1], [short[0], *[short[1]] * 100])
    expected = {*range(0, 100, 4), 100, 1}
    assert named == {"instants": tuple(sorted(expected))}
    # Equal schedules are one.
    _ScheduledLanes().flights(PLANNED, [batch[0], SimpleNamespace(**vars(batch[0]))])  # type: ignore[list-item]
    assert given[1][0][1].positions is long


def decided(decision: Decision, tick: int, **given: Any) -> Any:
    """Return what lanes measure of the second of two controlled flights of 30 ticks."""
    flight = DrawnFlight.of(CONTROLLED.scenario)
    n = 2
    end = np.zeros((2, 2 * n + 20))
    end[1, :n] = 0.75, -1.5
    goal = CONTROLLED.scenario.goal
    end[1, 2 * n : 2 * n + 7] = *(goal.position - [0.3, 0.0, 0.4]), *goal.quaternion

    def second(*values: float) -> np.ndarray:
        return np.array([[99.0] * len(values), values])

    result: Any = SimpleNamespace(
        decision=np.array([0, int(decision)]),
        decision_tick=np.array([5, tick]),
        end_state=end,
        end_tick=np.array([10, 30]),
        decision_distance=second(0.125, 0.25, math.nan),
        peak_rate=second(0.5, 1.0),
        peak_effort=second(2.0, 3.0),
        peak_wrench=second(4.0, 5.0),
        lowest=second(-0.5, -1.0),
        highest=second(0.5, 1.0),
        momentum_drift=second(6.0, 7.0),
        failures=given.get("failures", {0: "no"}),
    )
    robot = SimpleNamespace(n=n, description=SimpleNamespace(end_effector=lambda frame: ""))
    starts = SimpleNamespace(qdot=second(-0.75, 0.25))
    flights: Any = SimpleNamespace(robot=robot, initial_states=starts)
    batch = [_PreparedDraw(Draw(number, 1, {}), flight) for number in range(2)]
    made = replace(CONTROLLED, max_flight_time=0.0)  # A controller ends by itself after it.
    _, found = _ControlledLanes().measures(made, result, batch, flights, 0.25)
    return found


def test_the_measures_of_control_are_those_of_the_end_of_the_flight() -> None:
    found = decided(Decision.REACHED, 20)
    assert found.outcome is Outcome.REACHED
    tolerance = "(tolerance 0.001 m, 0.001 rad)"
    assert found.message == f"The goal is reached: 0.125 m, 0.25 rad from it {tolerance}."
    assert found.duration == pytest.approx(0.3)  # At 100 Hz.
    assert found.manoeuvre_time == pytest.approx(0.2)
    assert found.error.distance == pytest.approx(0.5)
    assert math.isnan(found.end_effector_distance)
    assert math.isnan(found.end_effector_angle)
    np.testing.assert_array_equal(found.peak_rate, [0.75, 1.0])
    np.testing.assert_array_equal(found.peak_effort, [2.0, 3.0])
    np.testing.assert_array_equal(found.peak_wrench, [4.0, 5.0])
    np.testing.assert_array_equal(found.lowest, [-0.5, -1.5])
    np.testing.assert_array_equal(found.highest, [0.75, 1.0])
    np.testing.assert_array_equal(found.momentum_drift, [6.0, 7.0])
    assert math.isnan(found.propellant)
    assert (found.corrections, found.plan_time) == (0, 0.0)


def test_how_control_ends() -> None:
    failed = decided(Decision.FAILED, 29)
    assert failed.outcome is Outcome.FAILED
    assert failed.message == (
        "The goal is not reached in time: 0.125 m, 0.25 rad from it (tolerance 0.001 m, 0.001 rad)."
    )
    cut = decided(Decision.NONE, -1)
    assert cut.outcome is Outcome.INTERRUPTED
    assert cut.message == "Interrupted after 0.3 s of simulated time."
    assert cut.manoeuvre_time == cut.duration == pytest.approx(0.3)
    assert decided(Decision.LOST, 3) == "lost control"
    assert decided(Decision.LOST, 3, failures={0: "", 1: "no"}) == "was refused by the plant"
    assert decided(Decision.REACHED, 0) == "ended at its first state"
    assert decided(Decision.REACHED, 1).outcome is Outcome.REACHED


@pytest.mark.parametrize(
    ("longest", "tick"),
    [(0.0, 1), (0.01, 1), (0.02, 2), (0.025, 3), (1.0, 100), (1.0001, 101), (0.3, 30), (0.07, 7)],
)
def test_the_tick_at_which_a_flight_is_interrupted(longest: float, tick: int) -> None:
    assert lanes._tick_of_interruption(longest, 10_000_000) == tick


def test_goals_are_rows_and_none_are_nothing() -> None:
    goals = [Goal.checked([1, 2, 3], [0, 0.6, 0, 0.8]), None, Goal.checked([4, 5, 6], UNIT)]
    found = lanes._goal_poses(goals)
    assert found is not None
    np.testing.assert_allclose(found, [[1, 2, 3, 0, 0.6, 0, 0.8], [4, 5, 6, *UNIT]])
    assert lanes._goal_poses([None]) is None


def test_the_error_of_an_end_effector_is_that_of_its_link() -> None:
    """The link is 0.5 m ahead of a base that is turned by a right angle about z."""
    c = math.sqrt(0.5)
    robot: Any = SimpleNamespace(
        description=SimpleNamespace(end_effector=lambda frame: frame and f"{frame} there"),
        link_pose=lambda link, q: (np.eye(3), np.array([0.5, 0.0, q[0]])),
    )

    def error(frame: str, goal: Goal | None) -> PoseError | None:
        plant = SimpleNamespace(end_effector_frame=frame)
        scenario = SimpleNamespace(end_effector_goal=goal, plant=plant)
        flight: Any = SimpleNamespace(scenario=scenario)
        pose = np.array([1.0, 2.0, 3.0, 0.0, 0.0, c, c])
        return lanes._end_effector_error(robot, flight, np.array([0.25]), pose)

    found = error("hand", Goal.checked([1.0, 2.5, 4.25], [0.0, 0.0, c, c]))
    assert found is not None
    np.testing.assert_allclose(found.position, [0.0, 0.0, 1.0], atol=1e-12)
    assert found.angle == pytest.approx(0.0, abs=1e-7)
    assert error("", Goal.checked([1, 1, 1], UNIT)) is None
    assert error("hand", None) is None


# -- plans of lanes -------------------------------------------------------------------------------


def test_a_plan_serves_all_draws_whose_values_are_those_that_determine_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plans: list[Any] = []

    def plan(flight: DrawnFlight) -> Any:
        plans.append(flight)
        return SimpleNamespace(schedule=SimpleNamespace(ticks=3))

    monkeypatch.setattr(lanes, "_first_plan", plan)
    way = _ScheduledLanes()
    flight = DrawnFlight.of(START)
    heavier = replace(flight, mass=flight.mass * 1.5)
    seeded = flight.with_overrides("plant", {"sensors.seed": 5})
    made = [way.prepare_draw(PLANNED, Draw(0, 1, {}), each) for each in (flight, heavier, seeded)]
    assert len(plans) == 1
    assert all(isinstance(each, _PreparedDraw) for each in made)
    others = [
        flight.with_overrides("planner", {"lie_bracket.t1": 3.0}),
        flight.with_overrides("plant", {"initial_joint_positions": [0.1, 0.0, 0.0]}),
        replace(flight, scenario=START.with_poses(Goal.checked([1, 2, 3], UNIT), None)),
        replace(flight, scenario=START.with_poses(Goal.checked(START.goal.position, UNIT), None)),
    ]
    moving = heavier.with_overrides("plant", {"linear_momentum": [0.0, 0.1, 0.0]})
    others += [moving, replace(moving, mass=flight.mass * 1.25)]
    turning = heavier.with_overrides("plant", {"angular_momentum": [0.0, 0.1, 0.0]})
    others += [turning, replace(turning, mass=flight.mass * 1.25)]
    centred = heavier.with_overrides("plant", {"initial_center_of_mass": [0.0, 0.1, 0.0]})
    others += [centred, replace(centred, mass=flight.mass * 1.25)]
    for count, each in enumerate(others, start=2):
        way.prepare_draw(PLANNED, Draw(0, 1, {}), each)
        assert len(plans) == count
    # With noise each has a first state of its own.
    noisy = flight.with_overrides("plant", {"sensors.position_noise": 0.01})
    for _ in range(2):
        way.prepare_draw(PLANNED, Draw(0, 1, {}), noisy)
    assert len(plans) == len(others) + 3
    monkeypatch.setattr(lanes, "_first_plan", lambda flight: None)
    left = way.prepare_draw(PLANNED, Draw(7, 1, {}), noisy)
    assert left == Fallback(Draw(7, 1, {}), "had no schedule at the first state")


@pytest.mark.parametrize(
    ("begins", "partial", "ticks", "count", "whole"),
    [
        (0, False, 3, 1, True),
        (1, False, 3, 1, False),
        (0, True, 3, 1, False),
        (0, False, 0, 1, False),
        (0, False, 3, 2, False),
        (0, False, 3, 0, False),
    ],
)
def test_lanes_follow_one_whole_schedule_from_the_first_state(
    begins: int,
    partial: bool,
    ticks: int,
    count: int,
    whole: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []

    def fly(scenario: Any, **options: Any) -> Any:
        asked.append(options)
        schedule = SimpleNamespace(partial=partial, ticks=ticks)
        return SimpleNamespace(schedules=((begins, schedule),) * count, gait="status")

    monkeypatch.setattr(lanes, "fly_scenario", fly)
    monkeypatch.setattr(lanes, "robots_of", lambda flight: "robots")
    found = lanes._first_plan(DrawnFlight.of(START))
    assert asked == [{"robots": "robots", "longest": 0.05, "contacts": False}]
    assert (found is not None) is whole
    if found is not None:
        assert (found.schedule.ticks, str(found.status)) == (3, "status")
    monkeypatch.setattr(
        lanes, "fly_scenario", lambda *_, **__: SimpleNamespace(schedules=(1,), gait=None)
    )
    assert lanes._first_plan(DrawnFlight.of(START)) is None


# -- one draw after the other ---------------------------------------------------------------------


class OneByOne(FlightsEngine):
    """Flies nothing, but says how."""

    def __init__(self, outcome: Outcome = Outcome.REACHED) -> None:
        self.flown: list[Any] = []
        self.outcome = outcome

    def fly_draw(self, campaign: Any, flight: Any, stopped: Any = None) -> Any:
        self.flown.append(flight)
        if len(self.flown) == 2:
            raise RuntimeError("no\n way")
        return SimpleNamespace(
            outcome=self.outcome, measured=lambda clearance: measures(clearance=float(clearance))
        )


def test_draws_are_flown_one_by_one_until_a_stop() -> None:
    engine = OneByOne()
    rows = list(engine.fly(PLANNED, list(Draws(PLANNED))[:3], lambda: False))
    assert [row.outcome for row in rows] == ["reached", "error", "reached"]
    assert rows[1].reason == "RuntimeError: no way"
    assert {row.engine for row in rows} == {"flights"}
    assert rows[0].metrics["clearance_m"] == 0.0
    required = campaign(flights=1, criteria={"clearance_m": {"min": 0.0}})
    (row,) = OneByOne().fly(required, list(Draws(required)), lambda: False)
    assert row.metrics["clearance_m"] == 1.0
    looks = iter([False, False, True])
    rows = list(OneByOne().fly(PLANNED, list(Draws(PLANNED)), lambda: next(looks)))
    assert len(rows) == 1
    # A flight that the stop has cut off is none; one that ended with it is.
    for outcome, count in ((Outcome.INTERRUPTED, 0), (Outcome.REACHED, 1)):
        stops = iter([False, True, True]).__next__
        found = list(OneByOne(outcome).fly(PLANNED, list(Draws(PLANNED)), stops))
        assert len(found) == count
    rows = list(OneByOne(Outcome.INTERRUPTED).fly(PLANNED, [Draws(PLANNED)[0]], lambda: False))
    assert len(rows) == 1


def test_a_flight_is_flown_with_the_limits_of_its_campaign(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(one_by_one, "robots_of", lambda flight: "robots")
    monkeypatch.setattr(
        one_by_one, "fly_scenario", lambda scenario, **given: asked.append((scenario, given))
    )
    flight = DrawnFlight.of(START)
    FlightsEngine().fly_draw(replace(PLANNED, max_flight_time=7.5), flight, lambda: True)
    FlightsEngine().fly_draw(PLANNED, flight)
    (scenario, given), (_, others) = asked
    assert scenario is START
    assert (given["robots"], given["longest"], given["contacts"]) == ("robots", 7.5, False)
    assert given["progress"](1.0, 2.0) is True
    assert others["progress"](1.0, 2.0) is False


def test_what_cannot_be_flown_without_nodes_is_said() -> None:
    kills = replace(START, kills=("planner at 1",))  # type: ignore[arg-type]
    refusal = FlightsEngine().refusal(replace(PLANNED, scenario=kills))
    assert "it kills nodes on the way" in refusal
    assert not FlightsEngine().refusal(PLANNED)


def test_equal_planners_share_a_method(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[Any] = []

    def build(*given: Any) -> Any:
        built.append(given)
        return len(built)

    monkeypatch.setattr(one_by_one, "build_method", build)
    monkeypatch.setattr(one_by_one.Clearance, "wanted", lambda *given: ("clearance", *given))
    monkeypatch.setattr(one_by_one, "_last_planner_method", None)
    config = START.planner
    robot: Any = SimpleNamespace(description="described")
    assert one_by_one._method_of_planner(robot, config) == 1
    assert one_by_one._method_of_planner(robot, config) == 1
    assert one_by_one._method_of_planner(robot, replace(config)) == 1
    assert built == [
        (
            *("lie_bracket", robot, 0.05, config.integration_step, config.method_options),
            ("clearance", "described", config.clearance),
        )
    ]
    assert one_by_one._method_of_planner(robot, replace(config, averaging=2)) == 2
    assert one_by_one._method_of_planner(SimpleNamespace(description=""), config) == 3


def test_nodes_of_a_flight_have_the_robots_that_they_are_given(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def build(*given: Any) -> Any:
        return given

    class Robots:
        @staticmethod
        def of(scenario: Any, make: Any) -> Any:
            return {node: make(node, scenario.config(node)) for node in ("plant", "planner")}

    monkeypatch.setattr(one_by_one, "_build_robot", build)
    monkeypatch.setattr(one_by_one, "Robots", Robots)
    own = START.with_overrides("planner", {"model_error": 0.125, "model_error_seed": 7})
    found: Any = one_by_one.nominal_robots(own)
    assert found == {
        "plant": ("plant", "", "sliding_masses", "", 0.0, 0),
        "planner": ("planner", "", "sliding_masses", "", 0.125, 7),
    }
    bare = own.with_overrides("planner", {"robot": ""})
    found = one_by_one.nominal_robots(bare)
    assert found["planner"][1].startswith("<?xml") or "<robot" in found["planner"][1]
    assert found["planner"][2:] == ("", "", 0.125, 7)


def test_believed_robots_have_their_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(one_by_one, "robot_of", lambda config: config)
    one_by_one._build_robot.cache_clear()
    believed: Any = one_by_one._build_robot("planner", "<a/>", "b", "c", 0.25, 3)
    plain: Any = one_by_one._build_robot("plant", "<a/>", "b", "c", 0.0, 3)
    one_by_one._build_robot.cache_clear()
    for each in (believed, plain):
        assert (each.robot_description, each.robot, each.world) == ("<a/>", "b", "c")
    assert (believed.model_error, believed.model_error_seed) == (0.25, 3)
    assert type(plain) is one_by_one.RobotConfig


def test_fallbacks_are_flown_after_the_others_and_keep_their_reasons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    draws, asked = list(Draws(PLANNED))[:4], list[str]()

    def fly(made: Any, given: Any, stopped: Any) -> Iterator[Any]:
        for draw in given:
            odd = draw.number % 2
            yield Fallback(draw, f"reason {draw.number}") if odd else Row(draw, "reached", ".")

    def fly_rest(made: Any, given: Any, stopped: Any) -> Iterator[Row]:
        yield from (Row(draw, "failed", ".", engine="flights") for draw in given)

    def named(name: str) -> Any:
        asked.append(name)
        return SimpleNamespace(fly=fly_rest)

    monkeypatch.setattr(engines, "engine_by_name", named)
    engine: Any = SimpleNamespace(fly=fly)
    rows = list(fly_all(engine, PLANNED, draws, lambda: False))
    assert [(row.draw.number, row.outcome, row.fallback) for row in rows] == [
        (0, "reached", ""),
        (2, "reached", ""),
        (1, "failed", "reason 1"),
        (3, "failed", "reason 3"),
    ]
    assert asked == ["flights"]
