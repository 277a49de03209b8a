"""The program of a device is accepted by NVIDIA's compiler, which needs no device."""

from __future__ import annotations

import ctypes
import site
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import casadi as ca
import numpy as np
import pytest

from spacerobot_ros.batch import ControlledGoals, Flights, HeldCommands, InitialStates
from spacerobot_ros.batch.lanes import symbolic_model_of
from spacerobot_ros.batch.native import CompiledTick
from spacerobot_ros.batch.targets import CUDA_OPTIONS, Entries, Target, device_named
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState


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

    def compile(
        self, functions: Mapping[str, ca.Function], declarations: str, entries: Entries
    ) -> Any:
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
        assert entry in tick.library


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
