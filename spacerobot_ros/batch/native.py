"""The tick of a plant compiled for vector registers: a flight in each lane."""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import casadi as ca

from spacerobot_ros.model.compilation import NoLibraryError, native_library, vector_source

_HERE = Path(__file__).resolve().parent

_SELECTION = re.compile(r"\((\w+)\?(\w+):0\)")
"""How CasADi writes a number that is zero unless a condition holds."""


@dataclass(frozen=True)
class VectorUnit:
    """A kind of vector registers.

    Attributes
    ----------
    name
        For people.
    lanes
        Numbers of 64 bits in a register.
    flags
        What tells the compiler.
    libmvec
        Letter of its functions in the vector library of the C library; empty: none.
    """

    name: str
    lanes: int
    flags: tuple[str, ...]
    libmvec: str


UNITS: dict[str, VectorUnit] = {
    "avx512f": VectorUnit("AVX-512", 8, ("-mavx512f", "-mprefer-vector-width=512"), "e"),
    "avx2": VectorUnit("AVX2", 4, ("-mavx2",), "d"),
    "sse2": VectorUnit("SSE2", 2, ("-msse2",), "b"),
}
"""By the name of the processor's flag, the widest first."""

_PLAIN = VectorUnit("two at a time", 2, (), "")
"""For processors of other kinds: the compiler makes of it what there is."""


@lru_cache(maxsize=1)
def vector_unit() -> VectorUnit:
    """Return the widest kind that this processor and its kernel have."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8", errors="replace")
    except OSError:
        return _PLAIN
    found = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    flags = found[1].split() if found else []
    return next((unit for flag, unit in UNITS.items() if flag in flags), _PLAIN)


class Span(ctypes.Structure):
    """Rows that are copied, added or compared: from, to, count."""

    _fields_ = [(name, ctypes.c_longlong) for name in ("start", "to", "count")]


_POINTER, _WHOLE, _REAL = ctypes.c_void_p, ctypes.c_longlong, ctypes.c_double


class Job(ctypes.Structure):
    """What ``driver.hpp`` takes, in its order."""

    _fields_ = [
        ("memory", _POINTER),
        *((name, _WHOLE) for name in ("groups", "rows")),
        *((name, _POINTER) for name in ("at", "pending")),
        *((name, _POINTER) for name in ("arguments", "flight_results", "report_results")),
        *((f"{name}_count", _WHOLE) for name in ("argument", "flight_result", "report_result")),
        *((name, _POINTER) for name in ("copies", "sums", "peaks")),
        *((f"{name}_count", _WHOLE) for name in ("copy", "sum", "peak")),
        *((name, _WHOLE) for name in ("stop_row", "alive_row")),
        *((name, _WHOLE) for name in ("wrench_row", "wrench_peak_row", "impulse_row")),
        ("period", _REAL),
        ("period_ns", _WHOLE),
        *((name, _WHOLE) for name in ("program", "command_row", "command_count")),
        ("table", _POINTER),
        *((name, _WHOLE) for name in ("table_ticks", "each_table")),
        *((name, _WHOLE) for name in ("q_row", "measured_row", "bias_row", "noise_row")),
        *((name, _WHOLE) for name in ("n", "noisy")),
        ("normals", _POINTER),
        *((f"normals_{name}", _WHOLE) for name in ("from", "ticks", "width")),
        *((name, _REAL) for name in ("gain", "deadband")),
        ("instants", _POINTER),
        ("instant_count", _WHOLE),
        ("reports", _POINTER),
        ("reported", _POINTER),
        *((name, _WHOLE) for name in ("reported_count", "report_rows")),
        *((name, _POINTER) for name in ("control_arguments", "control_results")),
        *((f"control_{name}_count", _WHOLE) for name in ("argument", "result")),
        *(
            (f"{name}_row", _WHOLE)
            for name in ("normals", "time", "since", "begun", "exact", "settled", "reached")
        ),
        ("reached", _POINTER),
        *((f"{name}_row", _WHOLE) for name in ("lowest", "highest")),
        *((f"{name}_row", _WHOLE) for name in ("wild", "wild_count", "errors")),
        *((f"{name}_row", _WHOLE) for name in ("decision", "decided", "decided_errors")),
        *((name, _WHOLE) for name in ("lost_states", "last_tick", "ends", "ended_row")),
        ("ended", _POINTER),
        *((f"{name}_row", _WHOLE) for name in ("momentum", "expected", "first_momenta", "drift")),
        *((f"thruster_{name}", _POINTER) for name in ("matrix", "wrenches", "weights")),
        *((f"thruster_{name}", _POINTER) for name in ("shortest", "flow")),
        *((f"{name}_row", _WHOLE) for name in ("wanted", "owed", "left", "on", "levels")),
        *((f"{name}_row", _WHOLE) for name in ("unallocated", "propellant")),
    ]


class Driver:
    """The compiled loop over ticks and groups of lanes.

    Parameters
    ----------
    flight, report
        The tick with the results that every tick needs, and with those of reports as well.
    control
        The command for a state; None: it follows from tables.
    thrusters
        How many give its wrench; 0: it is given as it is commanded.

    Raises
    ------
    NoLibraryError
        It cannot be compiled here.
    """

    def __init__(
        self,
        flight: ca.Function,
        report: ca.Function,
        control: ca.Function | None = None,
        thrusters: int = 0,
    ) -> None:
        self.unit = vector_unit()
        functions = [flight, report] if control is None else [flight, report, control]
        self._library = _library(functions, self.unit, thrusters)
        self._start = self._library.start_flights
        self._fly = self._library.fly_until
        for function in (self._start, self._fly):
            function.argtypes = [ctypes.POINTER(Job)]
        self._start.restype = None
        self._fly.argtypes = [ctypes.POINTER(Job), _WHOLE]
        self._fly.restype = _WHOLE

    def start(self, job: Job) -> None:
        """Fill what is reported at the start."""
        self._start(ctypes.byref(job))

    def measure_starts(self, job: Job) -> None:
        """Fill what is measured at the start, with a control function."""
        measure = self._library.measure_starts
        measure.argtypes, measure.restype = [ctypes.POINTER(Job)], None
        measure(ctypes.byref(job))

    def fly_until(self, job: Job, tick: int) -> int:
        """Fly to a tick; return how many groups wait for one of their lanes before it."""
        return int(self._fly(ctypes.byref(job), tick))


def _library(functions: Sequence[ca.Function], unit: VectorUnit, thrusters: int) -> ctypes.CDLL:
    """Return the library, with the vector functions of the C library if it has them."""
    try:
        return _compiled(functions, unit, unit.libmvec, thrusters)
    except NoLibraryError:
        if not unit.libmvec:
            raise
        return _compiled(functions, unit, "", thrusters)


def _compiled(
    functions: Sequence[ca.Function], unit: VectorUnit, libmvec: str, thrusters: int
) -> ctypes.CDLL:
    renamed = [_renamed(function, f"vector_{function.name()}") for function in functions]
    body = _SELECTION.sub(r"where(\1,\2)", vector_source(renamed, "V"))
    parts = [_definitions(functions, unit, libmvec, thrusters), _file("lanes.hpp"), body]
    parts += [
        f"#define {name} {function.name()}"
        for name, function in zip(("FLIGHT", "REPORT", "CONTROL"), renamed, strict=False)
    ]
    driver = _file("driver.hpp").replace('#include "thrusters.hpp"\n', _file("thrusters.hpp"))
    parts += [driver, *(_trial(function) for function in functions)]
    # Vectors as arguments between functions of this file: no other is called with them.
    flags = ("-O2", "-std=c++17", "-fno-math-errno", "-Wno-psabi", *unit.flags)
    libraries = ("-lmvec",) if libmvec else ()
    name = f"lanes_{functions[0].name()}"
    return native_library(name, "\n".join(parts), flags, libraries, functions)


def _renamed(function: ca.Function, name: str) -> ca.Function:
    inputs = function.sx_in() if function.is_a("SXFunction") else function.mx_in()
    outputs = function.call(inputs, True, False)
    return ca.Function(name, inputs, outputs, function.name_in(), function.name_out())


def _definitions(
    functions: Sequence[ca.Function], unit: VectorUnit, libmvec: str, thrusters: int
) -> str:
    numbers = {
        "THRUSTERS": thrusters,
        "LANES": unit.lanes,
        "WORK_SIZE": max(function.sz_w() for function in functions) + 1,
        "ARGUMENT_POINTERS": max(function.sz_arg() for function in functions) + 1,
        "RESULT_POINTERS": max(function.sz_res() for function in functions) + 1,
        "INTEGER_SIZE": max(function.sz_iw() for function in functions) + 1,
        "TRIAL_SIZE": max(function.nnz_in() + function.nnz_out() for function in functions) + 1,
    }
    lines = [f"#define {name} {value}" for name, value in numbers.items()]
    if libmvec:
        # The names of the x86-64 vector ABI: kind of registers, lanes, one vector argument.
        lines += ["#define LIBMVEC"]
        lines += [
            f"#define VECTOR_{name.upper()} _ZGV{libmvec}N{unit.lanes}v_{name}"
            for name in ("sin", "cos")
        ]
    return "\n".join(lines)


def _trial(function: ca.Function) -> str:
    """Return the C++ that gives the vector function CasADi's interface for single numbers."""
    name = function.name()
    inputs = [function.nnz_in(i) for i in range(function.n_in())]
    outputs = [function.nnz_out(i) for i in range(function.n_out())]
    return (
        f'extern "C" int {name}(const double **arguments, double **results, long long *, double *, '
        f"int) {{\n  static const long long in[] = {_braces(inputs)}, out[] = {_braces(outputs)};\n"
        f"  return trial(vector_{name}, in, {len(inputs)}, out, {len(outputs)}, arguments, "
        "results);\n}\n"
    )


def _braces(numbers: Sequence[int]) -> str:
    return "{" + ", ".join(map(str, numbers)) + "}"


def _file(name: str) -> str:
    return (_HERE / name).read_text("utf-8")
