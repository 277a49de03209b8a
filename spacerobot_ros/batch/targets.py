"""Targets on which flights run: vector registers of this processor, or threads of a CUDA device.

Both use the same sources: CasADi functions, ``driver.hpp``, and the declarations in :mod:`.native`.
Registers contain one flight per lane. On a device, each flight is a thread; the
local compiler can also compile that program, with a loop instead of threads.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.lazy import optional_module
from spacerobot_ros.model.compilation import NoLibraryError, load_library

_SOURCE_FOLDER = Path(__file__).resolve().parent

_SCHEDULING = ("-fschedule-insns", "-fsched-pressure")
"""GCC options, ignored by Clang: long sums of products are ordered such that they do not wait for
each other, which saves a fifth of the flight time and does not change results."""

_CASADI_SELECTION = re.compile(r"\((\w+|\(\*\w+\+\+\))\?(\w+(?:\[i\])?):0\)")
"""CasADi's code for a number, alone or in a loop, that is zero unless a condition holds."""

_CUDA_OPTIONS = ("-std=c++17", "-default-device", "--fmad=false", "-diag-suppress=177,550")
"""Products and sums are rounded as on the processor; warnings of unused variables are off."""

_THREADS = 64
"""Threads in a device block: with the registers that flights need, more would not be faster."""

Entries = Mapping[str, Sequence[Any]]
"""Driver functions by name, with their argument types."""


@dataclass(frozen=True)
class Target:
    """What flights run on, compiled by the C++ compiler of this machine."""

    name: str
    """For people."""
    lanes: int
    """Numbers in a register."""
    flags: tuple[str, ...] = ()
    """Options of the compiler."""
    libmvec: str = ""
    """Letter of its functions in the vector library of the C library; empty: none."""
    threads: bool = False
    """Whether each flight has a thread: the numbers of neighbours are then side by side in
    memory."""
    single: bool = False
    """Whether numbers have 32 bits in place of 64."""
    block_bytes: int = 32 * 2**20
    """Memory of the flights that are flown together, bytes."""

    @property
    def engine(self) -> str:
        """Engine name for results."""
        return self.name if self.threads else f"{self.lanes} lanes ({self.name})"

    @property
    def dtype(self) -> type[np.floating[Any]]:
        """Number type of states."""
        return np.float32 if self.single else np.float64

    @property
    def arrays(self) -> Any:
        """Array module used by the driver, with NumPy's functions."""
        return np

    def zeros(self, shape: tuple[int, ...]) -> Any:
        """Return a numeric array for the driver, aligned to its registers."""
        count, size = int(np.prod(shape)), np.dtype(self.dtype).itemsize
        memory = np.zeros(count + 64 // size, self.dtype)
        offset = (-memory.ctypes.data % 64) // size
        return memory[offset : offset + count].reshape(shape)

    def address(self, array: Any) -> int:
        """Return the address of an array for the driver."""
        return int(array.ctypes.data)

    def to_numpy(self, array: Any) -> npt.NDArray[Any]:
        """Return a driver array as a NumPy array."""
        return np.asarray(array)

    def compile(
        self, functions: Mapping[str, ca.Function], declarations: str, entries: Entries
    ) -> Any:
        """Return the driver functions as attributes; their first argument is a job.

        Parameters
        ----------
        functions CasADi functions by driver name: ``FLIGHT`` and ``REPORT``, the tick without and
            with report results; ``CONTROL``, the command for a state; ``HOLDING_STEP`` and
            ``SHAPE_EQUATIONS``, for joints on their stops.
        declarations
            Declarations from :mod:`.native`.
        entries
            Driver functions.

        Raises
        ------
        NoLibraryError
            They cannot be compiled here.
        """
        # Vectors as arguments between functions of this file: no other is called with them.
        flags = ("-O2", "-std=c++17", "-fno-math-errno", "-Wno-psabi", *_SCHEDULING, *self.flags)
        name = f"lanes_{next(iter(functions.values())).name()}"
        library = None
        if self.libmvec:
            source = self._source(functions, declarations, self.libmvec)
            with suppress(NoLibraryError):
                library = load_library(
                    name, source, ctypes.CDLL, flags=flags, libraries=("-lmvec",), language="cpp"
                )
        if library is None:
            source = self._source(functions, declarations)
            library = load_library(name, source, ctypes.CDLL, flags=flags, language="cpp")
        for entry, arguments in entries.items():
            function = getattr(library, entry)
            function.argtypes, function.restype = list(arguments), None
        return library

    def _source(
        self, functions: Mapping[str, ca.Function], declarations: str, libmvec: str = ""
    ) -> str:
        given = list(functions.values())
        parts = [
            self._definitions(given, libmvec),
            _read_source("lanes.hpp"),
            _CASADI_SELECTION.sub(r"where(\1,\2)", _vector_source(given)),
            *(f"#define {name} {function.name()}" for name, function in functions.items()),
            declarations,
            _read_source("driver.hpp").replace('#include "stops.hpp"\n', _read_source("stops.hpp")),
        ]
        return "\n".join(parts)

    def _definitions(self, functions: Sequence[ca.Function], libmvec: str) -> str:
        values: dict[str, Any] = {
            "LANES": self.lanes,
            "NUMBER": "float" if self.single else "double",
            "WORK_SIZE": max(function.sz_w() for function in functions) + 1,
            "ARGUMENT_POINTERS": max(function.sz_arg() for function in functions) + 1,
            "RESULT_POINTERS": max(function.sz_res() for function in functions) + 1,
            "INTEGER_SIZE": max(function.sz_iw() for function in functions) + 1,
        }
        if self.threads:
            values["THREADS"] = ""
        if libmvec:
            # The names of the x86-64 vector ABI: kind of registers, lanes, one vector argument.
            values["LIBMVEC"] = ""
            for name in ("sin", "cos"):
                values[f"VECTOR_{name.upper()}"] = f"_ZGV{libmvec}N{self.lanes}v_{name}"
        return "\n".join(f"#define {name} {value}" for name, value in values.items())


VECTOR_UNITS: dict[str, Target] = {
    "avx512f": Target("AVX-512", 8, ("-mavx512f", "-mprefer-vector-width=512"), "e"),
    "avx2": Target("AVX2", 4, ("-mavx2",), "d"),
    "sse2": Target("SSE2", 2, ("-msse2",), "b"),
}
"""Vector registers by processor flag name, widest first."""

_PORTABLE_UNIT = Target("two at a time", 2)
"""Registers on other processors, chosen by the compiler."""

THREADS_OF_HOST = Target("device threads in a loop", 1, ("-O1",), threads=True)
"""The device program, for tests on machines without a device."""


@lru_cache(maxsize=1)
def vector_unit() -> Target:
    """Return the widest registers that this processor and its kernel support."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8", errors="replace")
    except OSError:
        return _PORTABLE_UNIT
    flags = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    features = flags[1].split() if flags else []
    return next((unit for name, unit in VECTOR_UNITS.items() if name in features), _PORTABLE_UNIT)


@dataclass(frozen=True)
class CudaDevice(Target):
    """A CUDA device; arrays are CuPy arrays, which torch and JAX accept without copying (DLPack).

    Raises
    ------
    SpaceRobotError
        CuPy, a driver or the device is missing.
    """

    number: int = 0

    @classmethod
    def of(cls, number: int = 0, *, single: bool = False) -> CudaDevice:
        """Return the device with a number, using 64-bit or 32-bit numbers."""
        cupy = optional_module("cupy", "cuda", "Flights on a GPU require")
        runtime = cupy.cuda.runtime
        try:
            count = runtime.getDeviceCount()
        except runtime.CUDARuntimeError as error:
            raise SpaceRobotError(
                f"No CUDA device is usable: {error}. Install a driver, or fly in lanes."
            ) from error
        if not 0 <= number < count:
            raise ParameterError(f"There is no CUDA device {number}; there are {count}, from 0.")
        name = runtime.getDeviceProperties(number)["name"].decode()
        free, _ = cupy.cuda.Device(number).mem_info
        precision = "single" if single else "double"
        return cls(
            f"CUDA ({name}, {precision})",
            1,
            threads=True,
            single=single,
            block_bytes=free // 4,
            number=number,
        )

    @cached_property
    def arrays(self) -> Any:
        """CuPy."""
        return optional_module("cupy", "cuda", "Flights on a GPU require")

    def zeros(self, shape: tuple[int, ...]) -> Any:
        """Return an array on the device."""
        with self.arrays.cuda.Device(self.number):
            return self.arrays.zeros(shape, self.dtype)

    def address(self, array: Any) -> int:
        """Return the address of an array on the device."""
        return int(array.data.ptr)

    def to_numpy(self, array: Any) -> npt.NDArray[Any]:
        """Return a copy of an array in host memory."""
        return np.asarray(self.arrays.asnumpy(array))

    def compile(
        self, functions: Mapping[str, ca.Function], declarations: str, entries: Entries
    ) -> Any:
        """Return the driver's functions; CuPy caches them by source."""
        source = self._source(functions, declarations).replace("#include <math.h>", "")
        module = self.arrays.RawModule(code=source, options=_CUDA_OPTIONS, backend="nvrtc")
        try:
            kernels = {entry: module.get_function(entry) for entry in entries}
        except self.arrays.cuda.compiler.CompileException as error:
            raise NoLibraryError(f"NVRTC failed: {str(error).strip().splitlines()[0]}") from error
        return _Kernels(self, kernels)


class _Kernels:
    """The driver's functions as kernels, a thread for each flight."""

    def __init__(self, device: CudaDevice, kernels: Mapping[str, Any]) -> None:
        self._device, self._kernels = device, kernels

    def __getattr__(self, name: str) -> Callable[..., None]:
        kernel, cupy = self._kernels[name], self._device.arrays

        def launch(job: Any, *arguments: int) -> None:
            with cupy.cuda.Device(self._device.number) as device:
                on_device = cupy.asarray(np.frombuffer(bytes(job), np.uint8))
                blocks = -(-job.groups // _THREADS)
                kernel((blocks,), (_THREADS,), (on_device, *map(np.int64, arguments)))
                device.synchronize()

        return launch


def _vector_source(functions: Sequence[ca.Function]) -> str:
    """Return C++ of functions in which every number has the type ``V``."""
    options = {"with_header": False, "cpp": True, "casadi_real": "V"}
    generator = ca.CodeGenerator(functions[0].name(), options)
    for function in functions:
        generator.add(function)
    return str(generator.dump())


def _read_source(name: str) -> str:
    return (_SOURCE_FOLDER / name).read_text("utf-8")
