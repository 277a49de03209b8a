"""CPU times of the plant, of SIMD lanes, of learning environments and of MuJoCo."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from spacerobot_ros.batch import (
    Flights,
    FollowedSchedule,
    HeldCommands,
    InitialStates,
    fly_lanes,
    fly_one_by_one,
)
from spacerobot_ros.environments import import_gymnasium
from spacerobot_ros.environments.episodes import EpisodeConfig, Episodes
from spacerobot_ros.environments.tasks import RobotStates, command_of
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import c_compiler
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant
from spacerobot_ros.simulation.mujoco_engine import mujoco_spec, without_environment

_INTEGRATION_STEP = 0.001
"""Integration step of the dynamics benchmark, s."""

_STEPS_PER_CALL = 1000
"""Number of steps in one call of an engine."""

_DYNAMICS_ROUNDS = 21


def median_cpu_times(
    runs: Mapping[str, tuple[Callable[[], object], int]], rounds: int
) -> dict[str, float]:
    """Return the median CPU time of a part of each run, us.

    The runs take turns, so that the machine's other load affects all alike.

    Parameters
    ----------
    runs
        By name: a function, and the number of equal parts (steps, ticks) of a call.
    rounds
        Number of calls of each.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds):
        for name, (run, parts) in runs.items():
            began = time.process_time()
            run()
            times[name].append(1e6 * (time.process_time() - began) / parts)
    return {name: statistics.median(values) for name, values in times.items()}


# -- steps of the dynamics --------------------------------------------------------------------


def dynamics_benchmark() -> dict[str, float | str]:
    """Return the CPU time of one RK4 step of 1 ms of ``servicer.urdf``, and ratios to MuJoCo.

    Each engine takes a thousand steps in one call, which loops in compiled code: one tick of
    :class:`EffortPlant` and ``mujoco.mj_step(model, data, nstep=1000)``. All start from the same
    drifting motion, without force and away from the joint limits. The plant integrates position,
    momenta and limits besides; MuJoCo runs without the parts that this robot does not need
    (constraints, contacts, sensors, its own check of the state).

    Returns
    -------
    ``step_us``, ``step_without_compiler_us`` (CasADi's virtual machine), ``mujoco_step_us``;
    ``ratio_to_mujoco`` and ``ratio_to_mujoco_without_compiler``: how many times faster than MuJoCo
    the plant is; ``compiler`` and ``mujoco``: name and version. Without a compiler or MuJoCo their
    figures are missing.
    """
    robot = SpaceRobot.from_file(robot_file("servicer"))
    compiler = c_compiler()
    result: dict[str, float | str] = {"compiler": compiler or "none (virtual machine)"}
    runs: dict[str, tuple[Callable[[], object], int]] = {}
    if compiler:
        runs["step_us"] = _plant_steps_function(robot), _STEPS_PER_CALL
    with _build_functions_for_virtual_machine():
        # The model is built again, because its functions are compiled at construction.
        runs["step_without_compiler_us"] = (
            _plant_steps_function(SpaceRobot(robot.description)),
            _STEPS_PER_CALL,
        )
    try:
        import mujoco
    except ImportError:
        result["mujoco"] = "not installed: no comparison"
    else:
        result["mujoco"] = mujoco.__version__
        runs["mujoco_step_us"] = _mujoco_steps_function(mujoco, robot), _STEPS_PER_CALL
    result |= median_cpu_times(runs, _DYNAMICS_ROUNDS)
    for ratio, name in (
        ("ratio_to_mujoco", "step_us"),
        ("ratio_to_mujoco_without_compiler", "step_without_compiler_us"),
    ):
        if name in runs and "mujoco_step_us" in runs:
            result[ratio] = float(result["mujoco_step_us"]) / float(result[name])
    return result


def _slow_joint_rates(n: int) -> Array:
    """Return joint rates (n,), rad/s: slow enough to stay within the limits in all rounds."""
    return 0.02 * np.cos(np.arange(n))


def _plant_steps_function(robot: SpaceRobot) -> Callable[[], None]:
    """Return a function that takes a thousand steps of the plant."""
    start = InitialState(joint_velocities=_slow_joint_rates(robot.n))
    plant = EffortPlant(robot, _STEPS_PER_CALL * _INTEGRATION_STEP, start, _INTEGRATION_STEP)
    nothing = np.zeros(robot.n)

    def run() -> None:
        if plant.step(nothing):
            raise RuntimeError("a joint has reached its stop: the benchmark measures free motion")

    return run


def _mujoco_steps_function(mujoco: Any, robot: SpaceRobot) -> Callable[[], None]:
    """Return a function that takes a thousand steps of MuJoCo in the same motion."""
    model = mujoco_model(mujoco, robot.description, _INTEGRATION_STEP)
    data = mujoco.MjData(model)
    rates = _slow_joint_rates(robot.n)
    twist = np.concatenate(robot.base_twist([0, 0, 0, 1], np.zeros(robot.n), rates))
    data.qvel[:6] = twist  # The base is not rotated: world and base components are the same.
    for name, rate in zip(robot.joint_names, rates, strict=True):
        data.joint(name).qvel[:] = rate
    return lambda: mujoco.mj_step(model, data, nstep=_STEPS_PER_CALL)


def mujoco_model(mujoco: Any, description: RobotDescription, step: float) -> Any:
    """Return MuJoCo's model of a robot in free space, without contacts, sensors and the like.

    It integrates by Runge-Kutta 4 with steps of ``step`` s, as the plant does.
    """
    model = mujoco_spec(mujoco, description).compile()
    without_environment(mujoco, model, step)
    return model


@contextmanager
def _build_functions_for_virtual_machine() -> Iterator[None]:
    """Have functions that are built in this context run in CasADi's virtual machine."""
    before = os.environ.get("SPACEROBOT_COMPILE")
    os.environ["SPACEROBOT_COMPILE"] = "0"
    try:
        yield
    finally:
        if before is None:
            del os.environ["SPACEROBOT_COMPILE"]
        else:
            os.environ["SPACEROBOT_COMPILE"] = before


# -- flights in SIMD lanes -------------------------------------------------------------------

_LANE_FLIGHTS = 2000
"""Number of flights in SIMD lanes in one round."""

_MUJOCO_FLIGHTS = 64
"""Number of flights of MuJoCo's rollout in one round."""

_LANE_ROUNDS = 5

_TIMED_FLIGHTS = 10_000
"""Number of flights whose total CPU time is measured."""

_MASS_SPREAD = 0.05
"""Largest relative change of masses and inertias."""

_COMPARED_FLIGHTS = 50
"""Number of flights compared with flights of the plant."""


@dataclass(frozen=True)
class _LaneCase:
    """A robot and its commands in the lanes benchmark.

    Attributes
    ----------
    name
        Prefix of the figures.
    robot, actuation
        The robot, and ``velocity`` or ``effort``.
    control_period
        Time of a tick, s.
    ticks
        Number of ticks of a flight.
    commands
        (ticks + 1, n) joint positions, or (ticks, n) efforts.
    """

    name: str
    robot: SpaceRobot
    actuation: str
    control_period: float
    ticks: int
    commands: Array

    def flights(self, count: int, seed: int) -> Flights:
        """Return flights with random masses, inertias and starts."""
        rng, robot = np.random.default_rng(seed), self.robot
        bodies = len(robot.description.bodies)
        low, high = 1 - _MASS_SPREAD, 1 + _MASS_SPREAD
        inertial = robot.inertial.scaled(
            rng.uniform(low, high, (count, bodies)), rng.uniform(low, high, (count, bodies))
        )
        starts = InitialStates.repeated(robot, InitialState(), count)
        starts.position[:] = 0.01 * rng.normal(size=(count, 3))
        program = (
            HeldCommands(self.commands)
            if self.actuation == "effort"
            else FollowedSchedule(self.commands)
        )
        return Flights(
            robot, self.actuation, self.control_period, self.ticks, starts, program, inertial
        )

    def campaign(self, count: int, seed: int) -> Array:
        """Draw and fly; return the final distances (count,) from the goal, m."""
        result = fly_lanes(self.flights(count, seed))
        return result.errors(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))[0][:, -1]


def lanes_benchmark(show: Callable[[str], None]) -> dict[str, float | str]:
    """Return CPU times of a tick and of flights, and how many times faster SIMD lanes are.

    Lanes include everything that a campaign does with a flight: drawing masses, inertias and
    starts, limits, peaks, and the error at the end. The plant and MuJoCo only step: the plant tick
    by tick as everywhere in this package, MuJoCo's ``rollout`` in one call for all its flights.
    Medians of runs in turns are compared.
    """
    figures: dict[str, float | str] = {}
    sliders, servicer = (
        SpaceRobot.from_file(robot_file(name)) for name in ("sliding_masses", "servicer")
    )
    phases = np.linspace(0.0, 6.0, 781)[:, None] + np.arange(3)
    shapes = 0.5 * (np.sin(phases) - np.sin(phases[0]))
    phases = np.linspace(0.0, 6.0, 781)[:, None] + np.arange(servicer.n)
    arm = 0.3 * (np.sin(phases) - np.sin(phases[0]))
    efforts = 2.0 * np.cos(np.linspace(0, 6, 50))[:, None] * np.ones(servicer.n)
    cases = (
        _LaneCase("sliders velocity", sliders, "velocity", 0.05, 780, shapes),
        _LaneCase("servicer velocity", servicer, "velocity", 0.05, 780, arm),
        _LaneCase("servicer effort", servicer, "effort", 0.01, 50, efforts),
        _LaneCase("sliders effort", sliders, "effort", 0.01, 50, efforts[:, :3]),
    )
    for case in cases:
        found = _measure_case(case)
        figures["engine"] = found.pop("engine")
        figures |= {f"{case.name}: {name}": value for name, value in found.items()}
        show(_lane_case_text(case.name, found))
    began = time.process_time()
    cases[0].campaign(_TIMED_FLIGHTS, 1)
    figures["sliders velocity: cpu_s_of_10000_flights_of_39_s"] = time.process_time() - began
    show(
        f"{_TIMED_FLIGHTS} open-loop flights of {cases[0].ticks * cases[0].control_period:g} s: "
        f"{time.process_time() - began:.2f} s of CPU time, drawing and errors among it"
    )
    show(f"engine: {figures['engine']}")
    return figures


def _measure_case(case: _LaneCase) -> dict[str, float | str]:
    few = case.flights(_COMPARED_FLIGHTS, 2)
    result, plant = fly_lanes(few), fly_one_by_one(few)
    largest = max(
        float(np.abs(getattr(result, name) - getattr(plant, name)).max()) for name in ("pose", "q")
    )
    runs: dict[str, tuple[Callable[[], object], int]] = {
        "lanes_us": (lambda: case.campaign(_LANE_FLIGHTS, 0), _LANE_FLIGHTS * case.ticks),
        "plant_us": (_plant_flight_function(case), case.ticks),
    }
    if case.actuation == "effort" and (rollout := _mujoco_rollout_function(case)) is not None:
        runs["mujoco_us"] = (rollout, _MUJOCO_FLIGHTS * case.ticks)
    found: dict[str, float | str] = {**median_cpu_times(runs, _LANE_ROUNDS)}
    for name in ("plant", "mujoco"):
        if f"{name}_us" in runs:
            found[f"ratio_to_{name}"] = float(found[f"{name}_us"]) / float(found["lanes_us"])
    found["largest_difference_to_plant"] = largest
    found["steps_a_tick"] = few.substeps
    found["engine"] = result.engine
    return found


def _lane_case_text(name: str, found: Mapping[str, Any]) -> str:
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


def _plant_flight_function(case: _LaneCase) -> Callable[[], None]:
    """Return a function that flies one flight by the plant, tick by tick."""
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


def _mujoco_rollout_function(case: _LaneCase) -> Callable[[], object] | None:
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
    starts = np.tile(start, (_MUJOCO_FLIGHTS, 1))
    spec = int(state.mjSTATE_QFRC_APPLIED)
    return lambda: rollout.rollout(model, data, starts, forces, control_spec=spec)


# -- learning environments ------------------------------------------------------------------------

_ROUNDS = 5

_STEPS, _SINGLE_STEPS = 40, 200
"""Steps of a round: of all lanes, and of one robot."""

CASES: Mapping[str, tuple[str, Mapping[str, Any], float]] = {
    "arm": ("ReorientArm-v0", {}, 0.2),
    "servicer": ("Reach-v0", {"scenario": "servicer"}, 1e-4),
}
"""Environment, arguments and largest action by robot: slow enough to stay within joint limits."""


def environments_benchmark(lanes: int, show: Callable[[str], None]) -> dict[str, float]:
    """Return steps a CPU second of environments, and how many times as many lanes take.

    A step is one tick of the plant with observation and reward. The environment of MuJoCo has the
    same robot, period, Runge-Kutta steps, observation and action; it is stepped by ``mj_step`` in
    one call, without contacts, sensors and limits. All take turns.

    Raises
    ------
    SpaceRobotError
        Gymnasium is not installed.
    """
    gymnasium = import_gymnasium()
    figures: dict[str, float] = {}
    for name, (environment, arguments, size) in CASES.items():
        endless = {**arguments, "time_limit": 1e6, "tolerance": 1e-9}
        vector = gymnasium.make_vec(f"spacerobot/{environment}", num_envs=lanes, **endless)
        single = gymnasium.make(f"spacerobot/{environment}", **endless).unwrapped
        vector.reset(seed=1)
        single.reset(seed=1)
        rng = np.random.default_rng(1)
        actions = size * rng.uniform(-1.0, 1.0, (lanes, single.action_space.shape[0]))
        runs: dict[str, tuple[Callable[[], object], int]] = {
            "lanes": (_repeated(vector.step, actions, _STEPS), _STEPS * lanes),
            "plant": (_repeated(single.step, actions[0], _SINGLE_STEPS), _SINGLE_STEPS),
        }
        config = EpisodeConfig.of(single.spec.kwargs)
        mujoco = _mujoco_step(config, single.episodes)
        if mujoco is not None:
            runs["mujoco"] = _repeated(mujoco, actions[0], _SINGLE_STEPS), _SINGLE_STEPS
        times = median_cpu_times(runs, _ROUNDS)
        for kind, us in times.items():
            figures[f"{name}: {kind}_steps_per_cpu_s"] = 1e6 / us
        text = ", ".join(f"{kind} {1e6 / us:.0f}" for kind, us in times.items())
        if "mujoco" in times:
            ratio = times["mujoco"] / times["lanes"]
            figures[f"{name}: ratio_to_mujoco"] = ratio
            text += f"; lanes take {ratio:.1f} times as many as MuJoCo"
        show(f"{name}, {lanes} {vector.episodes.engine}, steps a CPU second: {text}")
    return figures


def _repeated(step: Callable[[Any], object], action: Any, count: int) -> Callable[[], None]:
    """Return a function that steps to and fro, so that joints stay near their start."""
    signs = np.where(np.arange(count) % 2, -1.0, 1.0).tolist()

    def run() -> None:
        for sign in signs:
            step(sign * action)

    return run


def _mujoco_step(config: EpisodeConfig, episodes: Episodes) -> Callable[[Any], object] | None:
    """Return the step of an environment of MuJoCo; None where it is not installed."""
    try:
        import mujoco
    except ImportError:
        return None
    flights, task, robot = episodes.flights, episodes.task, episodes.robot
    velocity = flights.command_size == robot.n
    model = mujoco_model(mujoco, robot.description, flights.control_period / flights.substeps)
    data = mujoco.MjData(model)
    joints = [data.joint(name) for name in robot.joint_names]
    at_q = [model.joint(name).qposadr[0] for name in robot.joint_names]
    at_v = [model.joint(name).dofadr[0] for name in robot.joint_names]
    for joint, q in zip(joints, flights.q[0].tolist(), strict=True):
        joint.qpos[:] = q
    goals, order, nstep = episodes.goals, [4, 5, 6, 3], config.hold * flights.substeps
    error = float(episodes.errors[0])

    def step(action: Any) -> object:
        nonlocal error
        command = command_of(action[np.newaxis], episodes.scale, episodes.taken)[0]
        if velocity:
            data.qvel[at_v] = command
        else:
            data.qfrc_applied[at_v] = command[: robot.n]
        mujoco.mj_step(model, data, nstep=nstep)
        pose = np.concatenate([data.qpos[:3], data.qpos[order]])[np.newaxis]
        q, qdot = data.qpos[at_q][np.newaxis], data.qvel[at_v][np.newaxis]
        link = flights.link_r if flights.link_r.size else None
        states = RobotStates(pose, data.qvel[:6][np.newaxis].copy(), q, qdot, link)
        remaining = task.remaining(states, goals)
        before, error = error, float(task.errors(remaining)[0])
        return task.observe(states, remaining), 10.0 * (before - error)

    return step
