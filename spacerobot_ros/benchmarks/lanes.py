"""Speed of flights in lanes, beside the plant's own tick and MuJoCo's rollout of the same robot."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.batch import (
    Flights,
    FollowedSchedule,
    HeldCommands,
    Starts,
    fly_lanes,
    fly_one_by_one,
)
from spacerobot_ros.benchmarks.dynamics import mujoco_model
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant

_COUNT = 2000
"""Flights in lanes, in one round."""

_ROLLED = 64
"""Flights of MuJoCo's rollout, in one round: it is one thread, and takes them one after another."""

_ROUNDS = 5

_MANY = 10_000

_SPREAD = 0.05
"""Masses and inertias are drawn within this share."""

_AGREED = 50
"""Number of flights that the plant flies, too, for comparison."""


@dataclass(frozen=True)
class _Case:
    """A robot and how it is flown.

    Attributes
    ----------
    name
        Of its figures.
    robot, actuation
        What flies.
    control_period
        s.
    ticks
        Of each flight.
    commands
        (ticks + 1, n) shapes, or (ticks, n) efforts.
    """

    name: str
    robot: SpaceRobot
    actuation: str
    control_period: float
    ticks: int
    commands: Array

    def flights(self, count: int, seed: int) -> Flights:
        """Draw flights with other masses, inertias and starts."""
        rng, robot = np.random.default_rng(seed), self.robot
        bodies = len(robot.description.bodies)
        low, high = 1 - _SPREAD, 1 + _SPREAD
        inertial = robot.inertial.scaled(
            rng.uniform(low, high, (count, bodies)), rng.uniform(low, high, (count, bodies))
        )
        starts = Starts.alike(robot, InitialState(), count)
        starts.position[:] = 0.01 * rng.normal(size=(count, 3))
        program = (
            HeldCommands(self.commands)
            if self.actuation == "effort"
            else FollowedSchedule(self.commands)
        )
        return Flights(
            *(robot, self.actuation, self.control_period, self.ticks, starts, program, inertial)
        )

    def campaign(self, count: int, seed: int) -> Array:
        """Draw, fly, and return the distances (count,) of the ends from the goal, m."""
        result = fly_lanes(self.flights(count, seed))
        return result.errors(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))[0][:, -1]


def lanes_benchmark(show: Callable[[str], None]) -> dict[str, float | str]:
    """Return CPU times of a tick and flight, and how many times faster lanes are.

    Lanes include everything that a campaign does with a flight: drawing masses, inertias and
    starts, limits, peaks, and the error at the end. The plant and MuJoCo only step: the plant tick
    by tick as everywhere in this package, MuJoCo's ``rollout`` in one call for all its flights.
    They take turns, medians are compared.
    """
    figures: dict[str, float | str] = {}
    urdf = share_directory() / "urdf"
    sliders = SpaceRobot(load_robot(urdf / "sliding_masses.urdf"))
    servicer = SpaceRobot(load_robot(urdf / "servicer.urdf"))
    phases = np.linspace(0.0, 6.0, 781)[:, None] + np.arange(3)
    shapes = 0.5 * (np.sin(phases) - np.sin(phases[0]))
    phases = np.linspace(0.0, 6.0, 781)[:, None] + np.arange(servicer.n)
    arm = 0.3 * (np.sin(phases) - np.sin(phases[0]))
    efforts = 2.0 * np.cos(np.linspace(0, 6, 50))[:, None] * np.ones(servicer.n)
    cases = (
        _Case("sliders velocity", sliders, "velocity", 0.05, 780, shapes),
        _Case("servicer velocity", servicer, "velocity", 0.05, 780, arm),
        _Case("servicer effort", servicer, "effort", 0.01, 50, efforts),
        _Case("sliders effort", sliders, "effort", 0.01, 50, efforts[:, :3]),
    )
    for case in cases:
        found = _measured(case)
        figures["engine"] = found.pop("engine")
        figures |= {f"{case.name}: {name}": value for name, value in found.items()}
        show(_line(case.name, found))
    began = time.process_time()
    cases[0].campaign(_MANY, 1)
    figures["sliders velocity: cpu_s_of_10000_flights_of_39_s"] = time.process_time() - began
    show(
        f"{_MANY} open-loop flights of {cases[0].ticks * cases[0].control_period:g} s: "
        f"{time.process_time() - began:.2f} s of CPU time, drawing and errors among it"
    )
    show(f"engine: {figures['engine']}")
    return figures


def _measured(case: _Case) -> dict[str, float | str]:
    few = case.flights(_AGREED, 2)
    result, plant = fly_lanes(few), fly_one_by_one(few)
    largest = max(
        float(np.abs(getattr(result, name) - getattr(plant, name)).max()) for name in ("pose", "q")
    )
    runs: dict[str, tuple[Callable[[], object], int]] = {
        "lanes_us": (lambda: case.campaign(_COUNT, 0), _COUNT * case.ticks),
        "plant_us": (_plant_run(case), case.ticks),
    }
    if case.actuation == "effort" and (rollout := _rollout(case)) is not None:
        runs["mujoco_us"] = (rollout, _ROLLED * case.ticks)
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(_ROUNDS):
        for name, (run, ticks) in runs.items():
            began = time.process_time()
            run()
            times[name].append(1e6 * (time.process_time() - began) / ticks)
    found: dict[str, float | str] = {
        name: statistics.median(values) for name, values in times.items()
    }
    for name in ("plant", "mujoco"):
        if f"{name}_us" in times:
            found[f"ratio_to_{name}"] = float(found[f"{name}_us"]) / float(found["lanes_us"])
    found["largest_difference_to_plant"] = largest
    found["steps_a_tick"] = few.substeps
    found["engine"] = result.engine
    return found


def _line(name: str, found: Mapping[str, Any]) -> str:
    text = (
        f"{name}: {found['lanes_us']:.3f} us a tick of {found['steps_a_tick']} step(s) in lanes, "
        f"{found['plant_us']:.3f} us by the plant ({found['ratio_to_plant']:.1f} times)"
    )
    if "mujoco_us" in found:
        text += (
            f", {found['mujoco_us']:.1f} us by MuJoCo's rollout "
            f"({found['ratio_to_mujoco']:.1f} times)"
        )
    return f"{text}; largest difference {found['largest_difference_to_plant']:.1e}"


def _plant_run(case: _Case) -> Callable[[], None]:
    """Return the ticks of one flight by the plant, one after the other."""
    kind: Callable[..., VelocityPlant | EffortPlant]
    kind = EffortPlant if case.actuation == "effort" else VelocityPlant
    plant = kind(case.robot, case.control_period, InitialState())
    commands = case.commands
    if case.actuation == "velocity":
        commands = np.diff(commands, axis=0) / case.control_period
    ticks = list(commands)

    def run() -> None:
        plant.reset()
        for command in ticks:
            plant.step(command)

    return run


def _rollout(case: _Case) -> Callable[[], object] | None:
    """Return the flights by MuJoCo's rollout under the same efforts; None without MuJoCo."""
    try:
        import mujoco
        from mujoco import rollout
    except ImportError:
        return None
    steps = case.flights(1, 0).substeps
    model = mujoco_model(mujoco, case.robot.description, case.control_period / steps)
    data = mujoco.MjData(model)
    order = [model.joint(name).dofadr[0] for name in case.robot.joint_names]
    forces = np.zeros((1, case.ticks * steps, model.nv))
    forces[0][:, order] = np.repeat(case.commands, steps, axis=0)
    state = mujoco.mjtState
    size = mujoco.mj_stateSize(model, state.mjSTATE_FULLPHYSICS)
    start = np.zeros(size)
    mujoco.mj_getState(model, data, start, state.mjSTATE_FULLPHYSICS)
    starts = np.tile(start, (_ROLLED, 1))
    spec = int(state.mjSTATE_QFRC_APPLIED)
    return lambda: rollout.rollout(model, data, starts, forces, control_spec=spec)
