"""Steps of learning environments in SIMD lanes, in one plant, and of MuJoCo."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from spacerobot_ros.benchmarks.engines import median_cpu_times, mujoco_model
from spacerobot_ros.environments.episodes import EpisodeConfig, Episodes
from spacerobot_ros.environments.registration import import_gymnasium
from spacerobot_ros.environments.tasks import RobotStates, command_of

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
