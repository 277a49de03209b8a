"""Speed of the dynamics: one Runge-Kutta step of the effort plant beside one of MuJoCo."""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.compilation import c_compiler
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import EffortPlant, InitialState

_STEP = 0.001
"""s."""

_STEPS = 1000
"""In one call of either engine."""

_ROUNDS = 21

_LEAST_INERTIA = 1e-12
"""MuJoCo has no point masses, kg m^2."""


def dynamics_benchmark() -> dict[str, float | str]:
    """Return microseconds for one RK4 step of 1 ms of ``servicer.urdf``, and ratios to MuJoCo.

    Each engine takes a thousand steps in one call, which loops in compiled code: one tick of
    :class:`EffortPlant` and ``mujoco.mj_step(model, data, nstep=1000)``. All start from the same
    drifting motion, without force and away from the joint limits. The plant integrates position,
    momenta and limits besides; MuJoCo is spared what this robot does not need (constraints,
    contacts, sensors, its own check of the state). They take turns, and medians are compared: what
    else the machine does then falls on all.

    ``step_us``, ``step_without_compiler_us`` (CasADi's virtual machine) and ``mujoco_step_us`` are
    times, ``ratio_to_mujoco`` and ``ratio_to_mujoco_without_compiler`` say how many times faster
    than MuJoCo the plant is. ``compiler`` and ``mujoco`` name what was used; figures of what is
    not installed are left out.
    """
    description = load_robot(share_directory() / "urdf" / "servicer.urdf")
    compiler = c_compiler()
    result: dict[str, float | str] = {"compiler": compiler or "none (virtual machine)"}
    runs: dict[str, Callable[[], None]] = {}
    if compiler:
        runs["step_us"] = _plant_run(description)
    with _virtual_machine():
        runs["step_without_compiler_us"] = _plant_run(description)
    try:
        import mujoco
    except ImportError:
        result["mujoco"] = "not installed: no comparison"
    else:
        result["mujoco"] = mujoco.__version__
        runs["mujoco_step_us"] = _mujoco_run(mujoco, description)

    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(_ROUNDS):
        for name, run in runs.items():
            began = time.process_time()
            run()
            times[name].append(1e6 * (time.process_time() - began) / _STEPS)
    result |= {name: statistics.median(values) for name, values in times.items()}
    for ratio, name in (
        ("ratio_to_mujoco", "step_us"),
        ("ratio_to_mujoco_without_compiler", "step_without_compiler_us"),
    ):
        if name in times and "mujoco_step_us" in times:
            result[ratio] = float(result["mujoco_step_us"]) / float(result[name])
    return result


def _rates(n: int) -> Array:
    """Return joint rates (n,), rad/s: slow enough to stay within the limits in all rounds."""
    return 0.02 * np.cos(np.arange(n))


def _plant_run(description: RobotDescription) -> Callable[[], None]:
    """Return a thousand steps of the plant."""
    robot = SpaceRobot(description)
    start = InitialState(joint_velocities=_rates(robot.n))
    plant = EffortPlant(robot, _STEPS * _STEP, start, _STEP)
    nothing = np.zeros(robot.n)

    def run() -> None:
        if plant.step(nothing):
            raise RuntimeError("a joint has reached its stop: the benchmark measures free motion")

    return run


def _mujoco_run(mujoco: Any, description: RobotDescription) -> Callable[[], None]:
    """Return a thousand steps of MuJoCo with the same robot in the same motion."""
    robot = SpaceRobot(description)
    model = mujoco_model(mujoco, description, _STEP)
    data = mujoco.MjData(model)
    rates = _rates(robot.n)
    twist = np.concatenate(robot.base_twist([0, 0, 0, 1], np.zeros(robot.n), rates))
    data.qvel[:6] = twist  # The base is not turned: world and base components are the same.
    for name, rate in zip(robot.joint_names, rates, strict=True):
        data.joint(name).qvel[:] = rate
    return lambda: mujoco.mj_step(model, data, nstep=_STEPS)


def mujoco_model(mujoco: Any, description: RobotDescription, step: float) -> Any:
    """Return MuJoCo's model of a robot in free space, with nothing that the robot does not need.

    It integrates by Runge-Kutta 4 with steps of ``step`` s, as the plant does.
    """
    spec = mujoco.MjSpec.from_string(description.urdf)
    spec.worldbody.first_body().add_freejoint()
    spec.compiler.boundinertia = _LEAST_INERTIA
    model = spec.compile()
    for name in ("CONSTRAINT", "GRAVITY", "SENSOR", "SPRING", "DAMPER", "ISLAND", "AUTORESET"):
        model.opt.disableflags |= int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}"))
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.timestep = step
    return model


@contextmanager
def _virtual_machine() -> Iterator[None]:
    """Keep what is built inside from being compiled."""
    before = os.environ.get("SPACEROBOT_COMPILE")
    os.environ["SPACEROBOT_COMPILE"] = "0"
    try:
        yield
    finally:
        if before is None:
            del os.environ["SPACEROBOT_COMPILE"]
        else:
            os.environ["SPACEROBOT_COMPILE"] = before
