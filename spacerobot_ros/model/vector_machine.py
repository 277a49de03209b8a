"""CasADi functions at many places at once, in vector registers, without compiling each of them.

The derivatives of a robot's motion have ten thousands of operations: a compiler needs seconds for
them. Here a small C program (``vector_machine.c``), compiled once for all robots, reads the
operations of a function one after the other and computes each at as many places as a few registers
have numbers, which takes less time than compiled code. Without a C compiler the functions run in
CasADi's virtual machine, with the same numbers, bit for bit.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import numpy.typing as npt

from spacerobot_ros.files import warn_once
from spacerobot_ros.model.compilation import (
    NoLibraryError,
    c_compiler,
    compilation_settings,
    native_library,
    processor_features,
)
from spacerobot_ros.model.description import Array

_SOURCE_FILE = Path(__file__).with_name("vector_machine.c")

_OPERATIONS = {
    name[len("OP_") :]: int(getattr(ca, name)) for name in dir(ca) if name.startswith("OP_")
}
"""CasADi's numbers of operations by name."""

_INPUT, _OUTPUT, _CONST = (_OPERATIONS[name] for name in ("INPUT", "OUTPUT", "CONST"))

_FLAGS = ("-O1", "-fno-math-errno", "-fno-trapping-math")


@dataclass(frozen=True)
class VectorUnit:
    """Vector registers of a processor.

    Attributes
    ----------
    name
        For people.
    lanes
        Numbers of 64 bits in a register.
    flags
        Options of the compiler.
    libmvec
        Letter of its functions in the vector library of the C library; empty: none.
    """

    name: str
    lanes: int
    flags: tuple[str, ...]
    libmvec: str


VECTOR_UNITS: dict[str, VectorUnit] = {
    "avx512f": VectorUnit("AVX-512", 8, ("-mavx512f", "-mprefer-vector-width=512"), "e"),
    "avx2": VectorUnit("AVX2", 4, ("-mavx2",), "d"),
    "sse2": VectorUnit("SSE2", 2, ("-msse2",), "b"),
}
"""Vector registers by the name of the processor's flag, the widest first."""

_PORTABLE_UNIT = VectorUnit("two at a time", 2, (), "")
"""The vector unit of other processors, whose registers the compiler chooses."""


@lru_cache(maxsize=1)
def vector_unit() -> VectorUnit:
    """Return the widest registers that this processor and its kernel support."""
    features = processor_features()
    return next((unit for name, unit in VECTOR_UNITS.items() if name in features), _PORTABLE_UNIT)


_TRIAL = "vector_machine_trial"


class _OperationList:
    """The operations of a function of SX, as ``vector_machine.c`` takes them.

    Raises
    ------
    ValueError
        The function is none of SX, or has an operation that ``vector_machine.c`` does not know.
    """

    def __init__(self, function: ca.Function) -> None:
        if not function.is_a("SXFunction"):
            raise ValueError(f"{function.name()} is no function of SX")
        constants: list[float] = []
        steps = []
        for k in range(function.n_instructions()):
            operation = function.instruction_id(k)
            operands, result = function.instruction_input(k), function.instruction_output(k)
            if operation == _CONST:
                operands = [len(constants)]
                constants.append(function.instruction_constant(k))
            elif operation == _OUTPUT:
                # The result is that of the function, and the second operand the place in it.
                operands, result = [operands[0], result[1]], [result[0]]
            elif operation not in _known_operations():
                raise ValueError(f"{function.name()} has an operation {operation}")
            first = operands[0] if operands else 0
            steps.append((operation, result[0], first, operands[1] if len(operands) > 1 else first))
        self.steps: npt.NDArray[np.int32] = np.array(steps, dtype=np.int32).reshape(-1, 4)
        self.constants = np.array(constants, dtype=float)
        self.memory_size = int(function.sz_w())
        self.argument_sizes = np.array(
            [function.nnz_in(i) for i in range(function.n_in())], dtype=np.int64
        )
        self.result_sizes = np.array(
            [function.nnz_out(i) for i in range(function.n_out())], dtype=np.int64
        )


@lru_cache(maxsize=1)
def _known_operations() -> frozenset[int]:
    text = _SOURCE_FILE.read_text("utf-8")
    names = [*re.findall(r"case (\w+):", text), "INPUT", "OUTPUT", "CONST"]
    return frozenset(_OPERATIONS[name] for name in names)


def mapped(function: ca.Function, count: int) -> ca.Function:
    """Return a function at ``count`` places: arguments and results stand beside each other.

    It takes and gives what ``function.map(count)`` does, and the same numbers. It has no
    derivatives, and is to be kept as long as a function that calls it.
    """
    if count == 1 or not function.is_a("SXFunction"):
        return function.map(count)
    run = _compiled_runner(compilation_settings())
    if run is None:
        return function.map(count)
    tape = _operation_list_of(function)
    return function.map(count) if tape is None else _MappedFunction(function, tape, run, count)


_tape_by_function: dict[int, tuple[ca.Function, _OperationList | None]] = {}
"""The tapes of the functions that were mapped last, by their identity."""

_MAX_OPERATION_LISTS = 24


def _operation_list_of(function: ca.Function) -> _OperationList | None:
    """Return the operations of a function, read once; None where one is not known."""
    key = function.__hash__()
    if key in _tape_by_function:
        return _tape_by_function[key][1]
    try:
        tape: _OperationList | None = _OperationList(function)
    except ValueError:
        tape = None
    # The function is kept too: another one could have its identity.
    _tape_by_function[key] = function, tape
    if len(_tape_by_function) > _MAX_OPERATION_LISTS:
        del _tape_by_function[next(iter(_tape_by_function))]
    return tape


class _MappedFunction(ca.Callback):
    """A function at several places, run by ``vector_machine.c``."""

    def __init__(self, function: ca.Function, tape: _OperationList, run: Any, count: int) -> None:
        ca.Callback.__init__(self)
        self._function, self._tape, self._count = function, tape, count
        # Numbers are copied: that takes less time than to find out where CasADi keeps them.
        self._memories: tuple[list[Array], list[Array]] = (
            [np.zeros(count * size) for size in tape.argument_sizes],
            [np.zeros(count * size) for size in tape.result_sizes],
        )
        arguments, results = (_pointers(each) for each in self._memories)
        steps, constants = tape.steps.ctypes.data, tape.constants.ctypes.data
        of_arguments, of_results = tape.argument_sizes.ctypes.data, tape.result_sizes.ctypes.data
        self._run = partial(
            run,
            *(steps, len(tape.steps), constants, tape.memory_size),
            *(arguments, of_arguments, results, of_results, count),
        )
        self.construct(f"{function.name()}_at_{count}", {})

    def get_n_in(self) -> int:
        """Return the number of arguments."""
        return int(self._function.n_in())

    def get_n_out(self) -> int:
        """Return the number of results."""
        return int(self._function.n_out())

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the nonzeros of an argument."""
        return ca.repmat(self._function.sparsity_in(i), 1, self._count)

    def get_sparsity_out(self, i: int) -> ca.Sparsity:
        """Return the nonzeros of a result."""
        return ca.repmat(self._function.sparsity_out(i), 1, self._count)

    def has_eval_buffer(self) -> bool:
        """Return True, as numbers are read where CasADi keeps them."""
        return True

    def eval_buffer(
        self, arguments: tuple[memoryview | None, ...], results: tuple[memoryview | None, ...]
    ) -> int:
        """Compute the results at all places."""
        own_arguments, own_results = self._memories
        for own, given in zip(own_arguments, arguments, strict=True):
            # CasADi has no memory for zeros.
            own[:] = np.frombuffer(given) if given else 0.0
        failure = int(self._run())
        for own, asked in zip(own_results, results, strict=True):
            if asked:
                np.frombuffer(asked)[:] = own
        return failure


def _pointers(memories: Sequence[Array]) -> Any:
    """Return the addresses of memories."""
    return (ctypes.c_void_p * max(1, len(memories)))(*(each.ctypes.data for each in memories))


@lru_cache
def _compiled_runner(settings: tuple[str, ...]) -> Any:
    """Return ``run_at_places`` for a compiler and cache (``settings``); None without a compiler."""
    if c_compiler() is None:
        return None
    trial = _trial_function()
    source = _source(trial)
    try:
        # For any processor the compiler would take three times as long.
        unit = vector_unit()
        flags = [*_FLAGS, *unit.flags, f"-DGROUP={unit.lanes}"]
        library = native_library("vector_machine", source, flags, (), [trial], language="c")
    except NoLibraryError as reason:
        warn_once(f"Plans are searched for in CasADi's virtual machine, slower: {reason}.")
        return None
    run = library.run_at_places
    pointer, number = ctypes.c_void_p, ctypes.c_longlong
    run.argtypes = [pointer, number, pointer, number, *[pointer] * 4, number]
    run.restype = ctypes.c_int
    return run


def _trial_function() -> ca.Function:
    """Return a function of many operations, by which a new object is tried."""
    x = ca.SX.sym("x", 4)
    a, b, c, d = ca.vertsplit(x)
    rows = [a + b, a - c, b * d, c / d, -a, a**2, 2 * b, 1 / c, ca.sqrt(d), ca.sin(a), ca.cos(b)]
    rows += [ca.exp(a), ca.log(d), ca.fmin(a, b), ca.fmax(c, d), ca.atan2(a, d), ca.fabs(-b)]
    rows += [ca.if_else(a < b, c, d), ca.if_else(a >= b, c, d), ca.constpow(d, 3.5), a * 0.3 + 1.7]
    return ca.Function(_TRIAL, [x], [ca.vertcat(*rows)])


def _source(trial: ca.Function) -> str:
    """Return C of ``run_at_places``, and a function with CasADi's interface that runs a trial."""
    tape = _OperationList(trial)
    numbers = ", ".join(map(str, tape.steps.ravel().tolist()))
    constants = ", ".join(map(float.hex, [*tape.constants.tolist(), 0.0]))
    operations = _known_operations()
    return "\n".join(
        [
            *(f"#define {name} {k}" for name, k in _OPERATIONS.items() if k in operations),
            _SOURCE_FILE.read_text("utf-8"),
            f"int {_TRIAL}(const double **arg, double **res, long long *iw, double *w, int mem) {{",
            f"  static const int steps[] = {{{numbers}}};",
            f"  static const double constants[] = {{{constants}}};",
            f"  const long long in = {tape.argument_sizes[0]}, out = {tape.result_sizes[0]};",
            "  (void)iw; (void)w; (void)mem;",
            f"  return run_at_places((const Step *)steps, {len(tape.steps)}, constants, "
            f"{tape.memory_size}, arg, &in, res, &out, 1);",
            "}",
        ]
    )
