"""CasADi functions made fast: generated C, compiled once with the machine's ``cc`` and cached.

Without a compiler, or with ``SPACEROBOT_COMPILE=0``, the same functions run in CasADi's virtual
machine: slower, with the same formulas. Compiled objects live in ``SPACEROBOT_CACHE_DIR``, by
default ``$XDG_CACHE_HOME/spacerobot_ros`` (``~/.cache/spacerobot_ros``), named by their content.

An object from the cache is whole, of this user and of this function (:class:`.Cache`). Compilers
fail, hang, and run out of disk: a new object must give the virtual machine's numbers in a process
of its own, which may crash, and the compiler has a time limit, ``SPACEROBOT_COMPILE_TIMEOUT``.
"""

from __future__ import annotations

import ctypes
import hashlib
import json
import logging
import math
import os
import re
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, TypeVar

import casadi as ca
import numpy as np

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.files import Cache, warn_once
from spacerobot_ros.model.description import Array
from spacerobot_ros.termination import tool

# With fused multiply-adds, results would depend on the processor.
_COMMON_FLAGS = ("-fPIC", "-shared", "-ffp-contract=off")

_COMPILER_FLAGS = ("-O1", *_COMMON_FLAGS)

_LASTING_FLAGS = ("-O2", *_COMMON_FLAGS)
"""Flags for functions that run for a long time: they take half as long again to compile."""

_SOURCE_FLAGS = ("-O2", *_COMMON_FLAGS)
"""Flags for C that was written by hand: short, with loops."""

_MIN_OPERATIONS_TO_KEEP = 200
"""Fewest operations of a function for the cache: it takes less to read than to derive, also where
functions are derived together, of which only some are missing."""

_COMPILE_TIMEOUT = 120.0
"""Time limit for compiling one function, s: ten times that of the largest."""

_TRIAL_TIMEOUT = 20.0
"""Time limit for trying a new object, s."""

_MAX_DIFFERENCE = 1e-6
"""Largest relative difference between a compiled function and the virtual machine."""

_MAX_COMPARED_RESULT = 1e9
"""Largest compared result; larger results are near a singularity and depend on rounding."""

_MAX_FUNCTIONS_IN_MEMORY = 12

_EVALUATIONS_BEFORE_COMPILING = 10_000
"""Evaluations in the virtual machine that take as long as compiling, whatever the function: both
take longer in proportion to its operations."""

_functions_in_memory: dict[tuple[str, ...], ca.Function] = {}
"""The latest used functions of the cache, by name, key and folder of the cache."""

ANNOUNCEMENT_ATTRIBUTE = "announcement"
"""Attribute of log records that announce a long computation."""

_LOG = logging.getLogger(__name__)

_Loaded = TypeVar("_Loaded")

compilation_contexts: list[Callable[[], AbstractContextManager[None]]] = []
"""Contexts around every run of the compiler, such as one in which a node reports to be busy."""

_hung_compilations: set[str] = set()
"""Calls of compilers that exceeded the time limit: they are not called again."""


class _CompilationError(Exception):
    """An object file cannot be compiled or loaded; the text is the reason, a clause."""


class NoLibraryError(SpaceRobotError):
    """A library cannot be compiled or loaded; the text is the reason, a clause."""


class BufferedFunction:
    """A CasADi function with fixed memory: fill ``inputs``, call
    :meth:`evaluate`, read ``outputs``.

    ``inputs`` and ``outputs`` are numpy arrays shaped like the function's arguments (vectors are
    1-D) that stay in place for the life of the object; a call costs well under a microsecond
    beside the computation itself.

    ``held`` are the numbers of a last argument that stays the same: it is not among ``inputs``.

    ``often`` returns the same function compiled, with the same numbers, bit for bit. It is called
    after so many evaluations that compiling pays.
    """

    evaluate: Callable[[], None]
    """Computes the outputs."""

    def __init__(
        self,
        function: ca.Function,
        held: Array | None = None,
        often: Callable[[], ca.Function] | None = None,
    ) -> None:
        of_inputs = [(function.size_in(i), function.sparsity_in(i)) for i in range(function.n_in())]
        of_outputs = [
            (function.size_out(i), function.sparsity_out(i)) for i in range(function.n_out())
        ]
        self.inputs, self.outputs = (
            tuple(_dense_memory(size, sparsity) for size, sparsity in each)
            for each in (of_inputs, of_outputs)
        )
        self._memories = self.inputs, self.outputs
        if held is not None:
            *inputs, last = self.inputs
            last[:], self.inputs = held, tuple(inputs)
        self._bind(function)
        if often is not None:
            self._interpret, self.evaluate = self.evaluate, self._interpret_and_count
            self._often, self._evaluations = often, 0

    def _bind(self, function: ca.Function) -> None:
        """Have a function read and write the memory."""
        self.function = function
        self._buffer, self.evaluate = function.buffer()
        for memories, setter in zip(
            self._memories, (self._buffer.set_arg, self._buffer.set_res), strict=True
        ):
            for i, memory in enumerate(memories):
                # CasADi stores matrices by columns.
                setter(i, memory.ravel(order="K").data)

    def _interpret_and_count(self) -> None:
        """Evaluate in the virtual machine; once that has been done often, in compiled code."""
        self._evaluations += 1
        if self._evaluations > _EVALUATIONS_BEFORE_COMPILING:
            self._bind(self._often())
            self._interpret = self.evaluate
        self._interpret()

    def __call__(self, *arguments: Array | float) -> tuple[Array, ...]:
        """Evaluate at the given arguments and return copies of the results.

        Raises
        ------
        ValueError
            An argument has the wrong size; the message names it.
        """
        for index, (memory, value) in enumerate(zip(self.inputs, arguments, strict=True)):
            if np.size(value) != memory.size:
                name = self.function.name_in(index)
                raise ValueError(
                    f"{self.function.name()}: {name} has {np.size(value)} number(s), "
                    f"not {memory.size}"
                )
            memory[...] = value
        self.evaluate()
        return tuple(output.copy() for output in self.outputs)


def _dense_memory(size: tuple[int, int], sparsity: ca.Sparsity) -> Array:
    """Return zeros for an argument or a result; of vectors 1-D, of matrices by columns."""
    if not sparsity.is_dense():
        raise ValueError("a buffered function has dense arguments and results")
    memory = np.zeros(size[0] * size[1])
    return memory if size[1] == 1 else memory.reshape(size, order="F")


def dense_function(
    name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]
) -> ca.Function:
    """Return a CasADi function with dense results and shared common subexpressions.

    ``inputs`` and ``outputs`` are symbols and expressions by the names of arguments and results.
    """
    dense = ca.cse([ca.densify(output) for output in outputs.values()])
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))


def compiled(function: ca.Function, *, lasting: bool = False) -> ca.Function:
    """Return the function as compiled C, or unchanged if it is not or cannot be compiled.

    One that is ``lasting`` is compiled for this processor's vector registers, with the same
    numbers, bit for bit: it runs for long enough that the compiler may take longer.

    Raises
    ------
    ParameterError
        ``SPACEROBOT_COMPILE_TIMEOUT`` is not a number of seconds.
    """
    if not _is_compilation_enabled():
        return function
    compiler = c_compiler()
    _compile_time_limit()
    try:
        if compiler is None:
            raise _CompilationError("no C compiler (cc, gcc, clang or $CC) was found")
        flags, key = _flags_and_key(function, compiler, lasting=lasting)
        if found := _load_compiled(Cache(cache_directory()), function.name(), key):
            return found
        return _compile_function(function, key, flags, compiler)
    except _CompilationError as reason:
        _warn_of_virtual_machine(reason)
        return function


def compiled_before(function: ca.Function) -> ca.Function | None:
    """Return the function as the compiled C that the cache has of it; None: it has none."""
    compiler = c_compiler()
    if compiler is None:
        return None
    _, key = _flags_and_key(function, compiler, lasting=False)
    return _load_compiled(Cache(cache_directory()), function.name(), key)


def _flags_and_key(
    function: ca.Function, compiler: str, *, lasting: bool
) -> tuple[tuple[str, ...], str]:
    """Return the flags that a function is compiled with, and its key in the cache."""
    flags = _COMPILER_FLAGS
    if lasting:
        vectors = ("-mavx2",) if "avx2" in processor_features() else ()
        flags = (*_LASTING_FLAGS, *vectors)
    return flags, _hash_text(f"{_platform_key(compiler, flags)}\n{_c_source(function)}")


def compiled_functions(
    source: str, names: Sequence[str], trial: Callable[[], Sequence[ca.Function]]
) -> list[ca.Function] | None:
    """Return functions of a C source, compiled, tried and cached like single functions.

    Parameters
    ----------
    source
        C, which has functions by these ``names`` with CasADi's interface.
    names
        Names of the functions.
    trial
        Derives the same functions for the virtual machine, at least near the values at which they
        are tried: called before something is compiled.

    Returns
    -------
    :
        Those of the source, in the order of ``names``; None: compiling is off, or impossible, with
        a warning.

    Raises
    ------
    ParameterError
        ``SPACEROBOT_COMPILE_TIMEOUT`` is not a number of seconds.
    """
    compiler = c_compiler()
    if compiler is None:
        return None
    key = _hash_text(f"{_platform_key(compiler, _SOURCE_FLAGS)}\n{source}")

    def load(path: str) -> list[ca.Function]:
        return [ca.external(name, path) for name in names]

    if kept := Cache(cache_directory()).load(_object_file_name(names[0], key), key):
        with suppress(RuntimeError):
            return load(str(kept[0]))
    try:
        call = _CompilerCall(source, compiler, _SOURCE_FLAGS)
        return _make_object(names[0], key, call, trial(), load)
    except _CompilationError as reason:
        _warn_of_virtual_machine(reason)
        return None


@lru_cache
def source_hash(*names: str) -> str:
    """Return a hash of modules of this package, and of CasADi's version, for keys of functions."""
    texts = [Path(str(sys.modules[name].__file__)).read_text("utf-8") for name in names]
    return _hash_text("\n".join([ca.__version__, *texts]))


def _warn_of_virtual_machine(reason: _CompilationError) -> None:
    warn_once(
        "Functions run in CasADi's virtual machine, slower and with the same formulas "
        f"(SPACEROBOT_COMPILE=0 asks for it): {reason}."
    )


def cached_function(name: str, key: str, build: Callable[[], ca.Function]) -> ca.Function:
    """Return an expensive function from the cache, or derive and cache it.

    This process has those at hand that it has used last. The same numbers come out whether a
    function is read or derived.

    Parameters
    ----------
    name
        The function's own.
    key
        A hash of everything that the function is derived from.
    build
        Derives it.
    """
    place = (name, key, str(cache_directory()))
    function = _functions_in_memory.pop(place, None) or _load_or_derive(name, key, build)
    _functions_in_memory[place] = function
    if len(_functions_in_memory) > _MAX_FUNCTIONS_IN_MEMORY:
        del _functions_in_memory[next(iter(_functions_in_memory))]
    return function


def _load_or_derive(name: str, key: str, build: Callable[[], ca.Function]) -> ca.Function:
    cache = Cache(cache_directory())
    serialised = f"{name}-{key[:32]}.casadi"
    if kept := cache.load(serialised, key):
        try:
            return ca.Function.deserialize(kept[1].decode())
        except (RuntimeError, ValueError) as error:
            cache.discard(serialised, str(error))
    function = build()
    if function.n_instructions() >= _MIN_OPERATIONS_TO_KEEP:
        cache.store(serialised, key, function.serialize().encode())
    return function


def native_library(
    name: str,
    source: str,
    flags: Sequence[str],
    libraries: Sequence[str],
    tried: Sequence[ca.Function],
    *,
    language: Literal["c", "cpp"] = "cpp",
) -> ctypes.CDLL:
    """Return the library of a C or C++ source, compiled, tried and cached like single functions.

    Parameters
    ----------
    name
        For the file in the cache.
    source
        It has the functions ``tried`` by their names with CasADi's interface.
    flags, libraries
        Arguments of the compiler. The flags choose the processor's instructions; they are part of
        the key.
    tried
        Functions of the library that must give the virtual machine's numbers in a process.
    language
        That of the source.

    Raises
    ------
    NoLibraryError
        There is none; the text is a clause that says why.
    ParameterError
        ``SPACEROBOT_COMPILE_TIMEOUT`` is not a number of seconds.
    """
    compiler = cxx_compiler() if language == "cpp" else c_compiler()
    if compiler is None:
        names = "C++ compiler (c++, g++, clang++ or $CXX)"
        if language == "c":
            names = "C compiler (cc, gcc, clang or $CC)"
        raise NoLibraryError(f"no {names} was found")
    flags = [*flags, *_COMMON_FLAGS]
    key = _hash_text(f"{_platform_key(compiler, flags)} {' '.join(libraries)}\n{source}")
    if kept := Cache(cache_directory()).load(_object_file_name(name, key), key):
        with suppress(OSError):
            return ctypes.CDLL(str(kept[0]))
    try:
        return _make_object(
            name,
            key,
            _CompilerCall(source, compiler, flags, libraries, language),
            tried,
            ctypes.CDLL,
        )
    except _CompilationError as reason:
        raise NoLibraryError(str(reason)) from None


def vector_source(functions: Sequence[ca.Function], kind: str) -> str:
    """Return C++ of functions in which every number has the type ``kind``."""
    options = {"with_header": False, "cpp": True, "casadi_real": kind}
    generator = ca.CodeGenerator(functions[0].name(), options)
    for function in functions:
        generator.add(function)
    return str(generator.dump())


def compilation_settings() -> tuple[str, ...]:
    """Return the compiler and the cache's folder, on which compiled functions depend."""
    return (c_compiler() or "", str(cache_directory()))


def c_compiler() -> str | None:
    """Return the C compiler in use: ``$CC``, ``cc``, ``gcc`` or ``clang``; None without one."""
    return _compiler(os.environ.get("CC"), "cc", "gcc", "clang")


def cxx_compiler() -> str | None:
    """Return the C++ compiler in use: ``$CXX``, ``c++``, ``g++`` or ``clang++``, or None."""
    return _compiler(os.environ.get("CXX"), "c++", "g++", "clang++")


def _compiler(*candidates: str | None) -> str | None:
    if not _is_compilation_enabled():
        return None
    for candidate in candidates:
        found = shutil.which(candidate) if candidate else None
        if found:
            return found
    return None


@lru_cache(maxsize=1)
def processor_features() -> frozenset[str]:
    """Return the features of this processor, by Linux's names; empty where it names none."""
    try:
        text = Path("/proc/cpuinfo").read_text("utf-8", errors="replace")
    except OSError:
        return frozenset()
    found = re.search(r"^flags\s*:(.*)$", text, re.MULTILINE)
    return frozenset(found[1].split() if found else ())


def cache_directory() -> Path:
    """Return the folder of compiled objects (not created)."""
    chosen = os.environ.get("SPACEROBOT_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "spacerobot_ros"


def _is_compilation_enabled() -> bool:
    return os.environ.get("SPACEROBOT_COMPILE", "1") != "0"


def _compile_time_limit() -> float:
    text = os.environ.get("SPACEROBOT_COMPILE_TIMEOUT")
    if not text:
        return _COMPILE_TIMEOUT
    try:
        limit = float(text)
    except ValueError:
        limit = math.nan
    if not 0.0 < limit <= 1e6:
        raise ParameterError(
            f"SPACEROBOT_COMPILE_TIMEOUT is '{text}'; it must be a number of seconds above 0, at "
            "most 1e6."
        )
    return limit


def _hash_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def _platform_key(compiler: str, flags: Sequence[str]) -> str:
    return f"{sysconfig.get_platform()} {_c_library_version()} {compiler} {' '.join(flags)}"


def _c_source(function: ca.Function) -> str:
    generator = ca.CodeGenerator(function.name(), {"with_header": False})
    generator.add(function)
    return str(generator.dump())


def _object_file_name(name: str, key: str) -> str:
    return f"{name}-{key[:32]}.so"


def _load_compiled(cache: Cache, name: str, key: str) -> ca.Function | None:
    """Return a compiled function from the cache, None if the cache lacks it."""
    if kept := cache.load(_object_file_name(name, key), key):
        try:
            return ca.external(name, str(kept[0]))
        except RuntimeError:
            warn_once(
                f"The compiled functions in '{kept[0].parent}' are whole but cannot be loaded, as "
                "on a file system that forbids execution; they are compiled at each start."
            )
    return None


def _compile_function(
    function: ca.Function, key: str, flags: Sequence[str], compiler: str
) -> ca.Function:
    """Compile a function, and keep it in the cache.

    Raises
    ------
    _CompilationError
        It cannot be compiled.
    """
    name = function.name()
    _announce_compilation()
    build = _CompilerCall(_c_source(function), compiler, flags)
    return _make_object(name, key, build, [function], lambda path: ca.external(name, path))


@dataclass(frozen=True)
class _CompilerCall:
    """A source, and the call of the compiler for its shared object.

    Attributes
    ----------
    source
        Text of the source.
    compiler, flags, libraries
        Program, and arguments before and after the names of the files.
    suffix
        Suffix of the source file.
    """

    source: str
    compiler: str
    flags: Sequence[str]
    libraries: Sequence[str] = ()
    suffix: str = "c"


def _make_object(
    name: str,
    key: str,
    build: _CompilerCall,
    tried: Sequence[ca.Function],
    load: Callable[[str], _Loaded],
) -> _Loaded:
    """Compile a shared object, try its functions in a process, keep it in the cache, and load it.

    Raises
    ------
    _CompilationError
        There is no object that can be used.
    """
    limit = _compile_time_limit()
    if build.compiler in _hung_compilations:
        raise _CompilationError(f"{build.compiler} did not end before, and is not called again")
    try:
        with (
            ExitStack() as entered,
            tempfile.TemporaryDirectory(prefix="spacerobot_ros_") as folder,
        ):
            for context in tuple(compilation_contexts):
                entered.enter_context(context())
            built = _compile_object(build, Path(folder), limit)
            for each in tried:
                _test_object(each, built)
            stored = Cache(cache_directory()).store(
                _object_file_name(name, key), key, built.read_bytes()
            )
            for path in (stored, built):
                # The cache's folder may forbid execution; the temporary file is then loaded, and
                # a loaded object stays when its file is deleted.
                with suppress(OSError, RuntimeError):
                    if path is not None:
                        return load(str(path))
    except OSError as error:
        raise _CompilationError(error.strerror or str(error)) from None
    raise _CompilationError("the compiled object cannot be loaded")


@lru_cache(maxsize=1)
def _announce_compilation() -> None:
    """Log once per process that the first flight of a robot waits for the compiler."""
    _LOG.info(
        "Compiling the equations of this robot: once, some seconds.",
        extra={ANNOUNCEMENT_ATTRIBUTE: True},
    )


@lru_cache(maxsize=1)
def _c_library_version() -> str:
    """Return name and version of the C library, which objects refer to."""
    with suppress(AttributeError, ValueError, OSError):
        return os.confstr("CS_GNU_LIBC_VERSION") or ""
    return ""


def _compile_object(build: _CompilerCall, folder: Path, limit: float) -> Path:
    """Compile an object file in a folder, and return its path."""
    source, built, output = (
        folder / f"function.{build.suffix}",
        folder / "function.so",
        folder / "output",
    )
    source.write_text(build.source, encoding="utf-8")
    compiler = build.compiler
    command = [compiler, *build.flags, "-o", str(built), str(source), *build.libraries, "-lm"]
    code = _run_compiler(command, output, limit)
    if code is None:
        _hung_compilations.add(compiler)
        raise _CompilationError(
            f"{compiler} did not end within {limit:g} s (SPACEROBOT_COMPILE_TIMEOUT)"
        )
    if code < 0:
        raise _CompilationError(f"{compiler} was ended by {signal.Signals(-code).name}")
    if code:
        said = output.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        reason = said[0][:300] if said else f"no reason given; is the disk of {folder.parent} full?"
        raise _CompilationError(f"{compiler} failed ({code}): {reason}")
    return built


def _run_compiler(command: list[str], output: Path, limit: float) -> int | None:
    """Run a command that ends with this process; return its exit code, None beyond the limit."""
    # Into a file: children of the command may hold a pipe open longer than the command runs. Its
    # temporary files are deleted with the folder.
    environment = {**os.environ, "TMPDIR": str(output.parent)}
    with (
        output.open("wb") as file,
        tool(command, stdout=file, stderr=subprocess.STDOUT, env=environment) as process,
    ):
        try:
            return process.wait(limit)
        except subprocess.TimeoutExpired:
            return None


# -- new objects ------------------------------------------------------------------------------

_TRIAL_SCRIPT = """
import ctypes, json, sys
path, name, sizes, values, work = json.loads(sys.argv[1])
library = ctypes.CDLL(path)
real, integer = ctypes.c_double, ctypes.c_longlong
inputs = [(real * len(v))(*v) for v in values]
outputs = [(real * n)() for n in sizes]
def pointers(arrays, count):
    held = (ctypes.POINTER(real) * max(count, 1))()
    for i, array in enumerate(arrays):
        held[i] = ctypes.cast(array, ctypes.POINTER(real))
    return held
code = getattr(library, name)(
    pointers(inputs, work[0]), pointers(outputs, work[1]),
    (integer * max(work[2], 1))(), (real * max(work[3], 1))(), 0)
print(json.dumps([code, [list(o) for o in outputs]]))
"""


def _test_object(function: ca.Function, path: Path) -> None:
    """Have another process call a new object, and compare with the virtual machine.

    Raises
    ------
    _CompilationError
        The process crashed or hung, or the numbers differ.
    """
    values = [
        (0.1 + 0.03 * np.arange(function.nnz_in(i)) + 0.07 * i) for i in range(function.n_in())
    ]
    expected = function.call([ca.DM(function.sparsity_in(i), v) for i, v in enumerate(values)])
    sizes = [function.nnz_out(i) for i in range(function.n_out())]
    work = [function.sz_arg(), function.sz_res(), function.sz_iw(), function.sz_w()]
    task = json.dumps([str(path), function.name(), sizes, [v.tolist() for v in values], work])
    output = path.with_name("trial")
    # Python starts in a few hundredths of a second with -I and -S.
    code = _run_compiler(
        [sys.executable, "-I", "-S", "-c", _TRIAL_SCRIPT, task], output, _TRIAL_TIMEOUT
    )
    new = f"the compiled object of {function.name()}"
    if code != 0:
        raise _CompilationError(f"{new} failed when it was tried")
    try:
        failed, results = json.loads(output.read_text(encoding="utf-8"))
    except ValueError:
        raise _CompilationError(f"{new} gave no numbers when it was tried") from None
    for result, wanted in zip(results, expected, strict=True):
        there, here = np.array(result), np.array(wanted.nonzeros())
        with np.errstate(invalid="ignore"):
            judged = np.isfinite(here) & (np.abs(here) < _MAX_COMPARED_RESULT)
            near = np.abs(there - here) <= _MAX_DIFFERENCE * (
                1 + np.abs(here).max(initial=0, where=judged)
            )
        if failed or not np.all(near[judged]):
            raise _CompilationError(f"{new} gives other numbers than it should")
