"""Flights in lanes are those of the plant, on the devices that there are."""

from __future__ import annotations

import ctypes
import dataclasses
import site
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from support.plant_flights import fly_one_by_one
from support.slow import some_fast
from support.targets import needs_compiler, on_targets, target_named

from spacerobot_ros.batch import (
    BatchResult,
    ControlledGoals,
    Decision,
    Flights,
    FollowedSchedule,
    HeldCommands,
    InitialStates,
    SensorErrors,
    SteppedFlights,
    fly_lanes,
    targets,
)
from spacerobot_ros.batch.lanes import symbolic_model_of
from spacerobot_ros.batch.native import CompiledTick
from spacerobot_ros.batch.targets import CUDA_OPTIONS, CudaDevice, Target, device_named
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.laws.law import GainPair, Gains
from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.model import InertialParameters, SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.compilation import find_compiler
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.config import SensorConfig

pytestmark = pytest.mark.usefixtures("compiled")

NUMBERS = (
    *("pose", "twist", "q", "qdot", "momentum", "measured_pose", "measured_q", "momentum_drift"),
    *("peak_rate", "peak_effort", "peak_wrench", "lowest", "highest"),
    *("decision", "decision_tick", "decision_distance", "end_tick", "end_state"),
)


@pytest.fixture(scope="module")
def robots() -> dict[str, SpaceRobot]:
    urdf = share_directory() / "urdf"
    names = "sliding_masses", "servicer"
    return {name: SpaceRobot(load_robot(urdf / f"{name}.urdf")) for name in names}


def assert_equal_flights(here: BatchResult, there: BatchResult, rtol: float = 1e-12) -> None:
    for name in NUMBERS:
        one, two = getattr(here, name), getattr(there, name)
        # An attitude has no size of its own: numbers below one are compared absolutely.
        np.testing.assert_allclose(one, two, rtol=rtol, atol=rtol, err_msg=name)
    for name, counts in there.limited_ticks.items():
        np.testing.assert_array_equal(here.limited_ticks[name], counts)
    assert here.failures == there.failures


def draws(
    robot: SpaceRobot, count: int, rng: np.random.Generator, *, moving: bool
) -> tuple[InitialStates, SensorErrors, InertialParameters]:
    """Return starts, sensors and masses that all differ, some without noise, some without bias."""
    n, bodies = robot.n, len(robot.description.bodies)
    quaternion = rng.normal(size=(count, 4))
    lower, upper = np.maximum(robot.lower, -1.0), np.minimum(robot.upper, 1.0)
    starts = InitialStates(
        rng.normal(size=(count, 3)),
        quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True),
        lower + (upper - lower) * rng.uniform(0.3, 0.7, (count, n)),
        0.02 * rng.normal(size=(count, n)) * moving,
        0.1 * rng.normal(size=(count, 6)),
        rng.uniform(size=count) < 0.3,
    )
    noise = 1e-3 * np.abs(rng.normal(size=(count, 6)))
    noise[::3] = 0.0
    bias = 1e-3 * rng.normal(size=(count, 6 + n))
    bias[::2] = 0.0
    seeds = rng.integers(0, 1000, count)
    sensors = SensorErrors(noise, bias[:, :6], bias[:, 6:], seeds)
    factors = rng.uniform(0.9, 1.1, (2, count, bodies))
    return starts, sensors, robot.inertial.scaled(*factors)


def velocity_flights(robot: SpaceRobot, count: int, *, each: bool, deadband: float) -> Flights:
    """Return flights along a schedule that runs into rate limits and ends of travel."""
    rng = np.random.default_rng(3)
    starts, sensors, inertial = draws(robot, count, rng, moving=False)
    near = np.minimum(robot.upper, 3.0) - rng.uniform(0.01, 1.0, (count, robot.n))
    starts = dataclasses.replace(starts, q=np.maximum(near, robot.lower))
    # At 0.5 to 1.5 of the largest rate, back and forth.
    rates = robot.velocity_limit * np.linspace(0.5, 1.5, robot.n) * np.ones((60, 1))
    rates[25:] *= -0.8
    positions = np.vstack([np.zeros(robot.n), 0.05 * np.cumsum(rates, axis=0)])
    positions = positions + (starts.q[:, None] if each else starts.q[0])
    program = FollowedSchedule(positions, shape_gain=2.0, deadband=deadband)
    return Flights(
        *(robot, "velocity", 0.05, 70, starts, program),
        inertial,
        sensors,
        report_ticks=(0, 7, 61, 70),
    )


def effort_flights(robot: SpaceRobot, count: int) -> Flights:
    """Return flights under efforts beyond their limits, of which some drive joints to stops."""
    rng = np.random.default_rng(4)
    starts, sensors, inertial = draws(robot, count, rng, moving=True)
    starts.q[::3, 0], starts.qdot[::3, 0] = robot.upper[0] - 0.005, 0.1
    effort = np.minimum(robot.effort_limit, 5.0)
    joints = 0.03 * effort * rng.normal(size=(count, 30, robot.n))
    # Of the first joint alone: such efforts would spin a light wrist beyond all rates, and rounding
    # would decide where it ends.
    joints[:, 5, 0] *= 3000.0
    joints[:, 6, 0] = -joints[:, 5, 0]
    table = np.zeros((count, 40, robot.n + 6))
    table[:, :30, : robot.n], table[..., robot.n :] = joints, rng.normal(size=(40, 6))
    program = HeldCommands(table)
    return Flights(
        *(robot, "effort", 0.01, 45, starts, program),
        inertial,
        sensors,
        report_ticks=(0, 3, 44, 45),
    )


@on_targets("registers")
@pytest.mark.parametrize(
    ("each", "deadband"), some_fast([(False, 0.0), (True, 0.003)], (True, 0.003))
)
def test_velocity_flights_in_lanes_are_those_of_the_plant(
    robots: dict[str, SpaceRobot], target_name: str, each: bool, deadband: float
) -> None:
    flights = velocity_flights(robots["sliding_masses"], 19, each=each, deadband=deadband)
    target = target_named(target_name)
    here, there = fly_lanes(flights, target), fly_one_by_one(flights)
    assert here.engine == target.engine
    assert_equal_flights(here, there)
    assert there.limited_ticks["rate"].any(axis=1).sum() > 10
    assert there.limited_ticks["stroke"].any(axis=1).sum() > 10
    assert not here.fallback_ticks.any()


@on_targets("threads")
def test_flights_fit_into_memory_block_by_block(
    robots: dict[str, SpaceRobot], target_name: str
) -> None:
    """Each block has its own seeds, masses, schedules and reports."""
    flights = velocity_flights(robots["sliding_masses"], 19, each=True, deadband=0.0)
    target = target_named(target_name)
    small = dataclasses.replace(target, block_bytes=30_000)
    assert_equal_flights(fly_lanes(flights, small), fly_lanes(flights, target), rtol=0.0)


@on_targets()
def test_effort_flights_in_lanes_are_those_of_the_plant(
    robots: dict[str, SpaceRobot], target_name: str
) -> None:
    flights = effort_flights(robots["sliding_masses"], 19)
    here, there = fly_lanes(flights, target_named(target_name)), fly_one_by_one(flights)
    assert_equal_flights(here, there)
    assert there.limited_ticks["effort"].any(axis=1).sum() > 10
    assert 0 < there.limited_ticks["stroke"].any(axis=1).sum() < 19
    assert not here.fallback_ticks.any()


@on_targets("registers")
def test_a_flight_that_fails_says_why_and_leaves_its_neighbours_alone(
    robots: dict[str, SpaceRobot], target_name: str
) -> None:
    target = target_named(target_name)
    flights = effort_flights(robots["sliding_masses"], 9)
    momenta, q = flights.initial_states.momenta.copy(), flights.initial_states.q.copy()
    momenta[4] = 1e80
    q[7, 0] = 50.0
    starts = dataclasses.replace(flights.initial_states, momenta=momenta, q=q)
    broken = dataclasses.replace(flights, initial_states=starts)
    here, there = fly_lanes(broken, target), fly_one_by_one(broken)
    assert here.failures == there.failures
    assert sorted(here.failures) == [4, 7]
    assert "no longer finite" in here.failures[4]
    assert "outside its limits" in here.failures[7]
    assert np.isnan(here.pose[4, -1]).all()
    others = [i for i in range(9) if i not in (4, 7)]
    alone = fly_lanes(flights, target)
    np.testing.assert_array_equal(here.pose[others], alone.pose[others])


def test_without_a_compiler_lanes_say_so(
    robots: dict[str, SpaceRobot], monkeypatch: pytest.MonkeyPatch
) -> None:
    flights = velocity_flights(robots["sliding_masses"], 2, each=False, deadband=0.0)
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    with pytest.raises(SpaceRobotError, match=r"^Lanes need a C\+\+ compiler: .*\.$"):
        fly_lanes(flights)


def test_the_widest_registers_that_there_are_are_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    for flags, name in (
        ("fpu sse2 avx2 avx512f", "AVX-512"),
        ("fpu sse2 avx avx2", "AVX2"),
        ("fpu sse2", "SSE2"),
        ("asimd", "two at a time"),
        (None, "two at a time"),
    ):
        targets.vector_unit.cache_clear()
        text = f"model name : avx512f\nflags\t\t: {flags}\n" if flags else "no processor\n"
        monkeypatch.setattr(Path, "read_text", lambda *_, text=text, **__: text)
        assert targets.vector_unit().name == name
    monkeypatch.undo()
    targets.vector_unit.cache_clear()


@needs_compiler
@pytest.mark.slow
def test_without_vector_functions_of_the_c_library_lanes_fly_as_well(
    robots: dict[str, SpaceRobot], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    flights = velocity_flights(robots["servicer"], 9, each=True, deadband=0.0)
    with_functions = fly_lanes(flights)
    compiler = tmp_path / "c++"
    script = f'#!/bin/sh\ncase "$*" in *-lmvec*) exit 1;; esac\nexec {find_compiler("cpp")} "$@"\n'
    compiler.write_text(script, encoding="utf-8")
    compiler.chmod(0o700)
    monkeypatch.setenv("CXX", str(compiler))
    here = fly_lanes(flights)
    assert here.engine == with_functions.engine
    assert_equal_flights(here, with_functions)


SHAPE = np.array([-1.0, 1.05])
BASE = np.array([0.05, -0.03, 0.0, 0.0, 0.0, 0.02, 0.9998])


def controlled(
    name: str,
    shape: Array,
    *,
    ticks: int,
    count: int = 9,
    end_effector: Array | None = None,
    **parameters: Any,
) -> Flights:
    """Return flights to a pose nearby, each with other masses, noise, start and gains."""
    rng = np.random.default_rng(2)
    robot = SpaceRobot(load_robot(share_directory() / "urdf" / f"{name}.urdf"))
    wanted: dict[str, Any] = {"tick_rate": 100.0, "settle_time": 0.2, "profile": "quintic"}
    config = dataclasses.replace(ControllerConfig(), **(wanted | parameters))
    starts = InitialStates.repeated(robot, InitialState(joint_positions=shape), count)
    starts.position[:, :2] = 0.01 * rng.normal(size=(count, 2))
    sensors = SensorErrors.of(robot, [SensorConfig()] * count)
    sensors.noise[1:] = 1e-5
    sensors.pose_bias[2:] = 1e-4
    sensors.seeds[:] = np.arange(count)
    pair = config.gains.base_position
    gains = tuple(
        dataclasses.replace(config.gains, base_position=GainPair(pair.kp * f, pair.kd))
        for f in rng.uniform(0.9, 1.1, count)
    )
    return Flights(
        *(robot, "effort", 0.01, ticks, starts),
        ControlledGoals(config, base=BASE, end_effector=end_effector, gains=gains),
        robot.inertial.scaled(rng.uniform(0.95, 1.05, (count, len(robot.inertial.masses)))),
        sensors,
        report_ticks=(0, ticks // 2, ticks),
    )


CUBE = """<robot name="cube"><link name="hull"><inertial><mass value="12"/>
  <inertia ixx="0.2" iyy="0.25" izz="0.3" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""


def test_a_robot_without_joints_has_rows_of_no_joint_in_each_flight() -> None:
    robot = SpaceRobot(parse_robot(CUBE))
    starts = InitialStates.of(
        robot, [InitialState(position=np.array([0.1, 0.2, k])) for k in range(3)]
    )
    assert starts.position[:, 2].tolist() == [0.0, 1.0, 2.0]
    assert starts.q.shape == starts.qdot.shape == (3, 0)
    sensors = SensorErrors.of(robot, [SensorConfig(seed=k) for k in range(3)])
    assert sensors.joint_bias.shape == (3, 0)
    assert sensors.seeds.tolist() == [0, 1, 2]


@on_targets("registers", "threads")
def test_control_in_lanes_is_that_of_the_controller(target_name: str) -> None:
    target = target_named(target_name)
    flights = controlled(
        *("planar_manipulator", SHAPE),
        ticks=220,
        count=5,
        law="transposed_jacobian",
        position_tolerance=0.01,
        attitude_tolerance=0.02,
        gains=Gains.uniform(1000.0, 60.0),
        max_force=10.0,
        motion=MotionLimits(1.0, 1.0, 1.0, 1.0),
    )
    assert flights.sensors is not None
    flights.sensors.noise[4, 5] = 20.0  # Its joints seem to race.
    here, there = fly_lanes(flights, target), fly_one_by_one(flights)
    assert here.engine == target.engine
    assert_equal_flights(here, there)
    assert not here.failures
    assert not here.fallback_ticks[:4].any()
    # Goals are reached at times of their own, and the force was at its limit.
    assert there.decision.tolist() == [Decision.REACHED] * 4 + [Decision.LOST]
    assert len(set(there.decision_tick[:4].tolist())) > 1
    np.testing.assert_allclose(there.peak_wrench[:, 0].max(), 10.0)


@needs_compiler
def test_automatic_gains_in_lanes_are_those_of_the_controller() -> None:
    """Of all flights, or of some: the others have gains of their own."""
    chosen: dict[str, Any] = {
        "law": "transposed_jacobian",
        "ticks": 150,
        "count": 5,
        "max_force": 10.0,
    }
    flights = controlled("planar_manipulator", SHAPE, **chosen, gains=Gains())
    here, there = fly_lanes(flights), fly_one_by_one(flights)
    assert "lanes" in here.engine
    assert_equal_flights(here, there)
    assert not here.failures
    given = controlled("planar_manipulator", SHAPE, **chosen, gains=Gains.uniform(30.0, 60.0))
    program = given.program
    assert isinstance(program, ControlledGoals)
    mixed = dataclasses.replace(program, gains=(*program.gains[:2], *[Gains()] * 3))
    flights = dataclasses.replace(given, program=mixed)
    here, there = fly_lanes(flights), fly_one_by_one(flights)
    assert_equal_flights(here, there)
    assert not here.failures
    assert np.abs(there.q[2:, -1] - fly_one_by_one(given).q[2:, -1]).max() > 1e-6


@on_targets("registers")
@pytest.mark.parametrize(
    ("shape", "limits"),
    [
        (np.array([0.3, 0.02]), {}),
        pytest.param(SHAPE, {"joint_rates": 0.02, "profile": "step"}, marks=pytest.mark.slow),
    ],
    ids=["singular", "slow joints"],
)
def test_what_the_law_cannot_give_in_one_step_is_given_by_the_controller(
    target_name: str, shape: Array, limits: dict[str, Any]
) -> None:
    """Through a singularity, and with joints that are held within a small rate."""
    planar = share_directory() / "urdf" / "planar_manipulator.urdf"
    tip = SpaceRobot.from_file(planar).link_pose("end_effector", shape)[1]
    case = {"law": "model_based", "gains": Gains.uniform(4.0, 4.0), **limits}
    case["end_effector"] = np.array([*tip, *BASE[3:]])
    flights = controlled("planar_manipulator", shape, ticks=120, **case)
    here, there = fly_lanes(flights, target_named(target_name)), fly_one_by_one(flights)
    assert_equal_flights(here, there)
    assert not here.failures
    assert 0 < here.fallback_ticks.sum() <= 9 * 120


def test_a_controller_at_another_rate_is_refused() -> None:
    flights = controlled("planar_manipulator", SHAPE, ticks=5)
    with pytest.raises(ParameterError, match="different rates"):
        dataclasses.replace(flights, control_period=0.02)


@pytest.mark.slow
@pytest.mark.gpu
@pytest.mark.parametrize(
    ("name", "actuation", "period", "ticks"),
    [("servicer", "effort", 0.001, 200), ("three_joint_arm", "velocity", 0.001, 4000)],
)
def test_a_device_flies_faster_than_registers_to_the_same_states(
    name: str, actuation: str, period: float, ticks: int, capsys: pytest.CaptureFixture[str]
) -> None:
    device, robot = target_named("device"), SpaceRobot(load_robot(robot_file(name)))
    assert isinstance(device, CudaDevice)
    rng, count = np.random.default_rng(6), 131_072
    starts = InitialStates.repeated(robot, InitialState(), count)
    limits = robot.velocity_limit if actuation == "velocity" else 0.02 * robot.effort_limit
    commands = 0.05 * limits * rng.uniform(-1.0, 1.0, (count, robot.n))
    if actuation == "effort":
        commands = np.hstack([commands, np.zeros((count, 6))])
    last, rates = {}, {}
    for target in (targets.vector_unit(), device, CudaDevice.of(single=True)):
        number = count if target.threads else 512
        flights = SteppedFlights(robot, actuation, period, starts[np.arange(number)], target=target)
        flights.step(commands[:number])  # The first call loads what it needs.
        began = time.perf_counter()
        flights.step(commands[:number], ticks)
        rates[target.name] = number * ticks / (time.perf_counter() - began)
        last[target.name] = flights.pose[:512].copy()
    with capsys.disabled():
        print(f"\n{name}, {actuation}:", *(f"{k}: {v:.3g} ticks/s" for k, v in rates.items()))
    registers, double, single = last.values()
    np.testing.assert_allclose(double, registers, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(single, registers, rtol=0.0, atol=1e-4)
    slow, *fast = rates.values()
    assert min(fast) > slow


# -- devices --------------------------------------------------------------------------------------


def nvrtc() -> Any:
    """Return the library of the run-time compiler, of a wheel or of the system; None without."""
    folders = [Path(each) for each in (*site.getsitepackages(), *sys.path)]
    found = [each for folder in folders for each in folder.glob("nvidia/*/lib/libnvrtc.so.*")]
    for name in (*map(str, found), "libnvrtc.so"):
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    return None


@dataclass(frozen=True)
class Compiler(Target):
    """Compiles the program of a device for an architecture, and keeps its size alone."""

    architecture: str = ""

    def compile(self, functions: Mapping[str, ca.Function], declarations: str) -> Any:
        library, program = nvrtc(), ctypes.c_void_p()
        code = self.source(functions, declarations).replace("#include <math.h>", "").encode()
        options = [each.encode() for each in (*CUDA_OPTIONS, f"-arch={self.architecture}")]
        made = library.nvrtcCreateProgram(ctypes.byref(program), code, b"", 0, None, None)
        assert made == 0
        compiled = library.nvrtcCompileProgram(
            program, len(options), (ctypes.c_char_p * len(options))(*options)
        )
        size = ctypes.c_size_t()
        library.nvrtcGetProgramLogSize(program, ctypes.byref(size))
        log = ctypes.create_string_buffer(size.value)
        library.nvrtcGetProgramLog(program, log)
        assert compiled == 0, log.value.decode()
        assert library.nvrtcGetCUBINSize(program, ctypes.byref(size)) == 0
        binary = ctypes.create_string_buffer(size.value)
        assert library.nvrtcGetCUBIN(program, binary) == 0
        return binary.raw


def flights_of(name: str, actuation: str, *, controlled: bool) -> Flights:
    robot = SpaceRobot(load_robot(robot_file(name)))
    starts = InitialStates.repeated(robot, InitialState(), 1)
    program: Any = HeldCommands(np.zeros((1, robot.n + 6 * (actuation == "effort"))))
    if controlled:
        base = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])
        law = "transposed_jacobian"
        program = ControlledGoals(ControllerConfig(tick_rate=100.0, law=law), base=base)
    return Flights(robot, actuation, 0.01, 1, starts, program)


@pytest.mark.slow
@pytest.mark.skipif(nvrtc() is None, reason="there is no NVRTC (pip install nvidia-cuda-nvrtc)")
@pytest.mark.parametrize("single", [False, True], ids=["double", "single"])
@pytest.mark.parametrize("architecture", ["sm_80", "sm_90"])
@pytest.mark.parametrize(
    ("name", "actuation", "controlled"),
    [
        ("three_joint_arm", "velocity", False),
        ("servicer", "effort", False),
        ("servicer", "effort", True),
    ],
)
def test_devices_have_a_binary_of_the_program(
    name: str, actuation: str, controlled: bool, architecture: str, single: bool
) -> None:
    target = Compiler("", 1, threads=True, single=single, architecture=architecture)
    flights = flights_of(name, actuation, controlled=controlled)
    tick = CompiledTick.of(flights, symbolic_model_of(flights)[0], target)
    for entry in (b"start_flights", b"fly_until"):
        assert entry in tick.driver


class _CupyError(Exception):
    """Raised by CuPy's runtime."""


class _FullError(MemoryError):
    """Raised by CuPy if the memory of a device is full."""


def cupy_with(devices: int | str) -> Any:
    """Return what stands for CuPy on a machine with so many devices, or without a driver."""

    def count() -> int:
        if isinstance(devices, str):
            raise _CupyError(devices)
        return devices

    runtime = SimpleNamespace(
        CUDARuntimeError=_CupyError,
        getDeviceCount=count,
        runtimeGetVersion=lambda: 12090,
        getDeviceProperties=lambda number: {"name": f"card {number}".encode()},
    )

    def zeros(shape: tuple[int, ...], dtype: Any) -> None:
        raise _FullError(f"Out of memory allocating {np.prod(shape)} numbers")

    device = SimpleNamespace(mem_info=(8 * 2**30, 2**33), use=lambda: None)
    cuda = SimpleNamespace(
        runtime=runtime,
        Device=lambda number: device,
        driver=SimpleNamespace(CUDADriverError=_CupyError),
        memory=SimpleNamespace(OutOfMemoryError=_FullError),
    )
    return SimpleNamespace(cuda=cuda, zeros=zeros)


@pytest.mark.parametrize(
    ("name", "devices", "sentence"),
    [
        ("cuda", None, "Flights on a GPU require cupy, which is not installed: pip install "),
        ("cuda", "cudaErrorInsufficientDriver", "No CUDA device is usable (cudaErrorInsufficient"
         "Driver): install NVIDIA's driver for CUDA 12.9 or later, or use the processor."),
        ("cuda:2", 2, "There is no CUDA device 2; the number of devices is 2, counted from 0."),
        ("cuda:x", 2, "There is no device 'cuda:x': use cuda, cuda:1, cuda:single, cuda:1:single "),
    ],
)  # fmt: skip
def test_a_device_that_is_not_there_is_refused_in_one_sentence(
    monkeypatch: pytest.MonkeyPatch, name: str, devices: int | str | None, sentence: str
) -> None:
    monkeypatch.setitem(sys.modules, "cupy", None if devices is None else cupy_with(devices))
    with pytest.raises(SpaceRobotError) as refusal:
        device_named(name)
    assert str(refusal.value).startswith(sentence)


def test_a_device_that_is_full_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", cupy_with(1))
    with pytest.raises(SpaceRobotError) as refusal:
        device_named("cuda").zeros((10, 20))
    assert str(refusal.value) == (
        "CUDA device 0 failed (Out of memory allocating 200 numbers): if its memory is too small, "
        "use fewer robots."
    )


def test_devices_have_names(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cupy", cupy_with(2))
    for name, engine, size in (
        ("cuda", "CUDA (card 0, double)", 8),
        ("cuda:1", "CUDA (card 1, double)", 8),
        ("cuda:1:single", "CUDA (card 1, single)", 4),
        ("host", "device threads in a loop", 8),
    ):
        target = device_named(name)
        assert (target.engine, np.dtype(target.dtype).itemsize) == (engine, size)
        assert target.threads
