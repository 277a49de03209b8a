"""The benchmarks of the engines by a stand-in for the clock: every figure and every line."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.clocks import Clock, named

from spacerobot_ros.batch import FollowedSchedule, HeldCommands, fly_one_by_one
from spacerobot_ros.benchmarks import engines
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState

SLIDERS = SpaceRobot.from_file(robot_file("sliding_masses"))


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    clock = Clock()
    monkeypatch.setattr(engines, "time", clock)
    return clock


def test_medians_are_of_parts_and_runs_take_turns(clock: Clock) -> None:
    order = ""

    def run(name: str, durations: list[float]) -> Callable[[], None]:
        left = iter(durations)

        def once() -> None:
            nonlocal order
            order += name
            clock.advance(next(left))

        return once

    runs = {"a": (run("a", [0.5, 9.0, 0.2, 0.1, 1.0]), 4), "b": (run("b", [1, 2, 3, 4, 5]), 1000)}
    found = engines.median_cpu_times(runs, 5)
    assert order == "ababababab"
    assert found == {"a": pytest.approx(125_000.0), "b": pytest.approx(3000.0)}


@pytest.mark.parametrize("before", [None, "1"])
@pytest.mark.parametrize(
    ("compiler", "with_mujoco", "expected"),
    [
        (
            "cc",
            True,
            {
                "compiler": "cc",
                "mujoco": "9.8",
                "step_us": 2.0,
                "step_without_compiler_us": 10.0,
                "mujoco_step_us": 7.0,
                "ratio_to_mujoco": 3.5,
                "ratio_to_mujoco_without_compiler": 0.7,
            },
        ),
        (
            None,
            True,
            {
                "compiler": "none (virtual machine)",
                "mujoco": "9.8",
                "step_without_compiler_us": 10.0,
                "mujoco_step_us": 7.0,
                "ratio_to_mujoco_without_compiler": 0.7,
            },
        ),
        (
            "cc",
            False,
            {
                "compiler": "cc",
                "mujoco": "not installed: no comparison",
                "step_us": 2.0,
                "step_without_compiler_us": 10.0,
            },
        ),
    ],
)
def test_the_dynamics_are_compared_with_mujoco(
    compiler: str | None,
    with_mujoco: bool,
    expected: dict[str, Any],
    before: str | None,
    clock: Clock,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    runs = []

    def takes(name: str, microseconds: float) -> Callable[[], None]:
        def run() -> None:
            runs.append(name)
            clock.advance(1e-6 * microseconds * 1000)  # A thousand steps.

        return run

    def plant_steps(robot: SpaceRobot) -> Callable[[], None]:
        interpreted = os.environ.get("SPACEROBOT_COMPILE") == "0"
        return takes("interpreted", 10.0) if interpreted else takes("compiled", 2.0)

    if before is None:
        monkeypatch.delenv("SPACEROBOT_COMPILE", raising=False)
    else:
        monkeypatch.setenv("SPACEROBOT_COMPILE", before)

    class Robot:
        def __new__(cls, description: object) -> Any:
            return SLIDERS

        @classmethod
        def from_file(cls, path: Path) -> SpaceRobot:
            return SLIDERS

    monkeypatch.setattr(engines, "SpaceRobot", Robot)
    monkeypatch.setattr(engines, "c_compiler", lambda: compiler)
    monkeypatch.setattr(engines, "_plant_steps_function", plant_steps)
    monkeypatch.setattr(engines, "_mujoco_steps_function", lambda *_: takes("mujoco", 7.0))
    mujoco = type("mujoco", (), {"__version__": "9.8"}) if with_mujoco else None
    monkeypatch.setitem(sys.modules, "mujoco", mujoco)
    found = engines.dynamics_benchmark()
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert found[name] == (value if isinstance(value, str) else pytest.approx(value)), name
    assert len(runs) == 21 * len(set(runs)), "so many calls of each, of which medians are taken"
    assert os.environ.get("SPACEROBOT_COMPILE") == before


def test_plant_and_mujoco_take_the_same_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    mujoco = pytest.importorskip("mujoco")
    monkeypatch.setattr(engines, "_STEPS_PER_CALL", 40)
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    robot = SpaceRobot.from_file(robot_file("planar_chain"))
    plants, states = [], []

    class Plant(EffortPlant):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            plants.append(self)

    class MuJoCo:
        def __getattr__(self, name: str) -> Any:
            return getattr(mujoco, name)

        def mj_step(self, model: Any, data: Any, nstep: int) -> None:
            states.append(data)
            mujoco.mj_step(model, data, nstep=nstep)

    monkeypatch.setattr(engines, "EffortPlant", Plant)
    engines._plant_steps_function(robot)()
    engines._mujoco_steps_function(MuJoCo(), robot)()
    (plant,), (data,) = plants, states
    assert data.time == pytest.approx(0.04)
    joints = [data.joint(name).qpos[0] for name in robot.joint_names]
    np.testing.assert_allclose(joints, plant.q, atol=1e-9)
    assert np.abs(plant.q).min() > 1e-4, "it moves"
    np.testing.assert_allclose(data.qpos[:3], plant.pose[:3], atol=1e-9)
    np.testing.assert_allclose(data.qpos[[4, 5, 6, 3]], plant.pose[3:], atol=1e-9)


def test_a_joint_that_stops_ends_the_benchmark(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "EffortPlant", lambda *_: named(step=lambda efforts: True))
    with pytest.raises(RuntimeError, match="a joint has reached its stop"):
        engines._plant_steps_function(SLIDERS)()


FOUND = {
    "lanes_us": 0.0321,
    "plant_us": 2.5,
    "ratio_to_plant": 77.88,
    "largest_difference_to_plant": 3.2e-14,
    "steps_a_tick": 3,
    "engine": "8 lanes of doubles",
}
WITH_MUJOCO = FOUND | {"mujoco_us": 12.3, "ratio_to_mujoco": 383.2}


def test_the_cases_of_lanes_and_their_lines(clock: Clock, monkeypatch: pytest.MonkeyPatch) -> None:
    cases = []

    def measure(case: Any) -> dict[str, Any]:
        cases.append(case)
        return dict(WITH_MUJOCO if case.actuation == "effort" else FOUND)

    monkeypatch.setattr(engines, "_measure_case", measure)
    flown = []

    def campaign(case: Any, count: int, seed: int) -> None:
        flown.append((case.name, count, seed))
        clock.advance(2.504)

    monkeypatch.setattr(engines._LaneCase, "campaign", campaign)
    lines: list[str] = []
    figures = engines.lanes_benchmark(lines.append)
    in_lanes = "0.032 us a tick of 3 step(s) in lanes, 2.500 us by the plant (77.9 times)"
    beside = ", 12.3 us by MuJoCo's rollout (383.2 times)"
    assert lines == [
        f"sliders velocity: {in_lanes}; largest difference 3.2e-14",
        f"servicer velocity: {in_lanes}; largest difference 3.2e-14",
        f"servicer effort: {in_lanes}{beside}; largest difference 3.2e-14",
        f"sliders effort: {in_lanes}{beside}; largest difference 3.2e-14",
        "10000 open-loop flights of 39 s: 2.50 s of CPU time, drawing and errors among it",
        "engine: 8 lanes of doubles",
    ]
    assert flown == [("sliders velocity", 10_000, 1)]
    assert figures.pop("sliders velocity: cpu_s_of_10000_flights_of_39_s") == pytest.approx(2.504)
    assert figures.pop("engine") == "8 lanes of doubles"
    assert figures == {
        f"{name}: {key}": value
        for name in ("sliders velocity", "servicer velocity", "servicer effort", "sliders effort")
        for key, value in (WITH_MUJOCO if "effort" in name else FOUND).items()
        if key != "engine"
    }
    for case in cases:
        effort = case.actuation == "effort"
        assert case.name.endswith(case.actuation)
        assert case.robot.n == (3 if case.name.startswith("sliders") else 6)
        assert case.control_period * case.ticks == pytest.approx(0.5 if effort else 39.0)
        assert case.commands.shape == (case.ticks + (not effort), case.robot.n)
        if effort:
            times = np.linspace(0.0, 6.0, 50)
            for column in case.commands.T:
                np.testing.assert_allclose(column, 2.0 * np.cos(times))
        else:
            # Sines of 6 rad in all, of which each joint is one radian ahead of the last.
            k, j = np.mgrid[0:781, 0 : case.robot.n]
            largest = 0.5 if case.name.startswith("sliders") else 0.3
            swing = largest * (np.sin(k * 6 / 780 + j) - np.sin(j))
            np.testing.assert_allclose(case.commands, swing, atol=1e-12)
            assert np.all((case.robot.lower < case.commands) & (case.commands < case.robot.upper))
            assert np.ptp(case.commands, axis=0).min() > 0.5


def lane_case(actuation: str) -> Any:
    k = np.arange(5)[:, None]
    commands = 4e-4 * np.sin(k + np.arange(3)) - 4e-4 * np.sin(np.arange(3))
    if actuation == "effort":
        commands = 1.5 * np.cos(k[:4] + np.arange(3))
    return engines._LaneCase("case", SLIDERS, actuation, 0.01, 4, commands)


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_flights_are_drawn_about_the_robot(actuation: str) -> None:
    case = lane_case(actuation)
    flights = case.flights(400, 3)
    kind = HeldCommands if actuation == "effort" else FollowedSchedule
    assert isinstance(flights.program, kind)
    np.testing.assert_allclose(flights.initial_states.position.std(axis=0), 0.01, rtol=0.2)
    assert np.abs(flights.initial_states.position.mean(axis=0)).max() < 0.002
    shares = flights.inertial.masses / SLIDERS.inertial.masses
    assert shares.min() == pytest.approx(0.95, abs=0.002)
    assert shares.max() == pytest.approx(1.05, abs=0.002)
    assert (flights.control_period, flights.ticks, flights.actuation) == (0.01, 4, actuation)
    again, other = case.flights(400, 3), case.flights(400, 4)
    np.testing.assert_array_equal(flights.initial_states.position, again.initial_states.position)
    assert np.any(flights.initial_states.position != other.initial_states.position)


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_a_case_is_measured(actuation: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    counts: list[int] = []
    asked: dict[str, Any] = {}

    def fly(flights: Any) -> Any:
        counts.append(len(flights.initial_states.position))
        result = fly_one_by_one(flights)
        result.q[0, -1, 1] += 3e-6
        return result

    def medians(runs: Any, rounds: int) -> dict[str, float]:
        asked.update(runs, rounds=rounds)
        return {"lanes_us": 0.5, "plant_us": 8.0, "mujoco_us": 3.0}

    monkeypatch.setattr(engines, "fly_lanes", fly)
    monkeypatch.setattr(engines, "_COMPARED_FLIGHTS", 2)
    monkeypatch.setattr(engines, "median_cpu_times", medians)
    case = lane_case(actuation)
    found = engines._measure_case(case)
    assert found["largest_difference_to_plant"] == pytest.approx(3e-6)
    assert found["ratio_to_plant"] == 16.0
    assert found["steps_a_tick"] == case.flights(1, 0).substeps
    assert counts == [2]
    assert asked.pop("rounds") == 5
    # By name: how many ticks one call flies.
    ticks = {name: parts for name, (_, parts) in asked.items()}
    mujoco = actuation == "effort" and "mujoco_us" in asked
    assert ticks == {"lanes_us": 8000, "plant_us": 4} | ({"mujoco_us": 256} if mujoco else {})
    assert ("ratio_to_mujoco" in found) == mujoco
    if mujoco:
        assert found["ratio_to_mujoco"] == 6.0


def test_distances_of_a_campaign_are_those_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    results = []

    def fly(flights: Any) -> Any:
        results.append(fly_one_by_one(flights))
        return results[-1]

    monkeypatch.setattr(engines, "fly_lanes", fly)
    found = lane_case("velocity").campaign(2, 5)
    np.testing.assert_allclose(found, np.linalg.norm(results[0].pose[:, -1, :3], axis=1))


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_the_plant_flies_the_same_flight_each_time(
    actuation: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    plants = []
    for name in ("EffortPlant", "VelocityPlant"):
        kind = getattr(engines, name)

        def make(*arguments: Any, kind: Any = kind) -> Any:
            plants.append(kind(*arguments))
            return plants[-1]

        monkeypatch.setattr(engines, name, make)
    case = lane_case(actuation)
    run = engines._plant_flight_function(case)
    run()
    (plant,) = plants
    first = plant.q.copy(), plant.pose.copy()
    if actuation == "velocity":
        np.testing.assert_allclose(first[0], case.commands[-1], atol=1e-12)
    run()
    np.testing.assert_array_equal(plant.q, first[0])
    np.testing.assert_array_equal(plant.pose, first[1])


def test_mujoco_flies_the_efforts_of_the_plant(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mujoco")
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    monkeypatch.setattr(engines, "_MUJOCO_FLIGHTS", 2)
    case = lane_case("effort")
    rollout: Any = engines._mujoco_rollout_function(case)
    states, _ = rollout()
    plant = EffortPlant(case.robot, case.control_period, InitialState())
    for efforts in case.commands:
        plant.step(efforts)
    # A row of MuJoCo's state: time, positions (base: 3 + 4, joints), velocities.
    assert states.shape[0] == 2
    np.testing.assert_allclose(states[:, -1, 0], 0.04)
    np.testing.assert_allclose(states[1, -1, 1:4], plant.pose[:3], atol=1e-8)
    np.testing.assert_allclose(np.sort(states[1, -1, 8:11]), np.sort(plant.q), atol=1e-8)
    assert np.abs(plant.q).min() > 1e-5


def test_without_mujoco_nothing_is_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert engines._mujoco_rollout_function(lane_case("effort")) is None
