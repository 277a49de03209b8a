"""CasADi functions as generated C code, compiled once by the system's ``cc`` and cached.

Without a compiler, or with ``SPACEROBOT_COMPILE=0``, the same functions run in CasADi's virtual
machine, which is slower but uses the same formulas. Compiled objects are stored in
``SPACEROBOT_CACHE_DIR``, by default ``$XDG_CACHE_HOME/spacerobot_ros``
(``~/.cache/spacerobot_ros``), under a hash of the source, flags, compiler and C library. Only
complete objects owned by this user are loaded (:class:`.Cache`).
"""

from __future__ import annotations

import hashlib
import logging
import os
import platform
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, ExitStack
from functools import lru_cache
from pathlib import Path
from typing import Literal, TypeVar

import casadi as ca
import numpy as np

from spacerobot_ros.errors import SpaceRobotError, counted
from spacerobot_ros.files import Cache, warn_once
from spacerobot_ros.model.description import Array
from spacerobot_ros.termination import tool

_FLAGS = ("-Og", "-fPIC", "-shared", "-ffp-contract=off")
"""Compiler flags for all objects; with -O1, long functions take up to six times as long to compile
and run no faster. Fused multiply-adds are disabled, because with them results would depend on the
processor."""

Language = Literal["c", "cpp"]
_COMPILERS = {
    "c": ("C", "CC", "cc", "gcc", "clang"),
    "cpp": ("C++", "CXX", "c++", "g++", "clang++"),
}
"""Name, environment variable and commands of the compilers of each language."""

announcement_listeners: list[Callable[[str], None]] = []
"""Functions called with a message, which is also logged, when a long computation begins."""

_LOG = logging.getLogger(__name__)

_Loaded = TypeVar("_Loaded")

compilation_contexts: list[Callable[[], AbstractContextManager[None]]] = []
"""Contexts entered around each compiler run, for example to report a node as busy."""


class NoLibraryError(SpaceRobotError):
    """A source cannot be compiled, or its object cannot be loaded; the message is a clause."""


class BufferedFunction:
    """A CasADi function with fixed memory: fill ``inputs``, call
    :meth:`evaluate`, read ``outputs``.

    ``inputs`` and ``outputs`` are numpy arrays with the shapes of the function's arguments (vectors
    are 1-D), allocated once. The overhead of a call is well under a microsecond.

    ``held`` is the constant value of the last argument, if that argument is not among ``inputs``.
    The first ``inputs`` and ``outputs`` may be given, to share the memory of another function.
    """

    evaluate: Callable[[], None]
    """Computes the outputs."""

    def __init__(
        self,
        function: ca.Function,
        held: Array | None = None,
        inputs: Sequence[Array] = (),
        outputs: Sequence[Array] = (),
    ) -> None:
        self.function = function
        arguments = (function.sparsity_in(i) for i in range(len(inputs), function.n_in()))
        results = (function.sparsity_out(i) for i in range(len(outputs), function.n_out()))
        self.inputs = (*inputs, *map(_dense_memory, arguments))
        self.outputs = (*outputs, *map(_dense_memory, results))
        self._buffer, self.evaluate = function.buffer()
        for memories, setter in (
            (self.inputs, self._buffer.set_arg),
            (self.outputs, self._buffer.set_res),
        ):
            for i, memory in enumerate(memories):
                # CasADi stores matrices in column-major order.
                setter(i, memory.ravel(order="K").data)
        if held is not None:
            *inputs, self._held = self.inputs
            self._held[:], self.inputs = held, tuple(inputs)

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
                    f"{self.function.name()}: {name} has {counted(np.size(value), 'number')}, "
                    f"not {memory.size}"
                )
            memory[...] = value
        self.evaluate()
        return tuple(output.copy() for output in self.outputs)


def _dense_memory(sparsity: ca.Sparsity) -> Array:
    """Return zeros for an argument or a result; vectors are 1-D, matrices column-major."""
    if not sparsity.is_dense():
        raise ValueError("a buffered function has dense arguments and results")
    rows, columns = sparsity.shape
    return np.zeros(rows) if columns == 1 else np.zeros((rows, columns), order="F")


def dense_function(
    name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]
) -> ca.Function:
    """Return a CasADi function with dense results and shared common subexpressions.

    ``inputs`` and ``outputs`` map argument and result names to symbols and expressions.
    """
    dense = ca.cse([ca.densify(output) for output in outputs.values()])
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))


def compiled(function: ca.Function, *, builds: bool = True) -> ca.Function:
    """Return the compiled function, or the function unchanged if compilation is disabled or fails,
    or if it is not in the cache and ``builds`` is false."""
    if not _is_compilation_enabled():
        return function
    name = function.name()
    generator = ca.CodeGenerator(name, {"with_header": False})
    generator.add(function)
    source = str(generator.dump())
    try:
        return load_library(name, source, lambda path: ca.external(name, path), builds=builds)
    except NoLibraryError as reason:
        if builds:
            warn_once(
                "Functions run in CasADi's virtual machine, which is slower but uses the same "
                f"formulas (SPACEROBOT_COMPILE=0 selects it): {reason}."
            )
        return function


def load_library(
    name: str,
    source: str,
    load: Callable[[str], _Loaded],
    *,
    flags: Sequence[str] = (),
    libraries: Sequence[str] = (),
    language: Language = "c",
    builds: bool = True,
) -> _Loaded:
    """Load the shared object for a source, compiling it first if it is not cached.

    Parameters
    ----------
    name
        Prefix of the name of the cached file.
    source, language
        Source code and its language.
    load
        Loads an object from its path; raises ``OSError`` or ``RuntimeError`` on failure.
    flags, libraries
        Compiler arguments before and after the source. The arguments are part of the key, so flags
        may select processor-specific instructions.
    builds
        Whether an object that is not in the cache is compiled.

    Returns
    -------
    :
        What ``load`` returns.

    Raises
    ------
    NoLibraryError
        The object cannot be built or loaded; the message is a clause that states the reason.
    """
    compiler = find_compiler(language)
    if compiler is None:
        kind, variable, *names, last = _COMPILERS[language]
        raise NoLibraryError(
            f"no {kind} compiler (${variable}, {', '.join(names)} or {last}) was found"
        )
    words = [compiler, *_FLAGS, *flags]
    machine = [sysconfig.get_platform(), *platform.libc_ver()]
    key = _hash_text("\n".join([*machine, *words, *libraries, source]))
    file_name = f"{name}-{key[:32]}.so"
    cache = Cache(cache_directory())
    if kept := cache.load(file_name, key):
        return _loaded(load, kept[0])
    if not builds:
        raise NoLibraryError("the object is not in the cache")
    _announce_compilation()
    with tempfile.TemporaryDirectory(prefix="spacerobot_ros_") as folder:
        file, built = Path(folder, f"function.{language}"), Path(folder, "function.so")
        try:
            file.write_text(source, encoding="utf-8")
            _run_compiler([*words, "-o", str(built), str(file), *libraries, "-lm"], Path(folder))
            stored = cache.store(file_name, key, built.read_bytes())
        except OSError as error:
            raise NoLibraryError(error.strerror or str(error)) from None
        # An object stays loaded when its file is deleted.
        return _loaded(load, stored or built)


def _loaded(load: Callable[[str], _Loaded], path: Path) -> _Loaded:
    try:
        return load(str(path))
    except (OSError, RuntimeError):
        raise NoLibraryError(
            f"the objects in '{path.parent}' cannot be loaded, for example because the file system "
            "forbids execution; SPACEROBOT_CACHE_DIR selects another folder"
        ) from None


def _run_compiler(command: Sequence[str], folder: Path) -> None:
    """Run the compiler in the contexts of :data:`compilation_contexts`."""
    # The compiler's temporary files are deleted with the folder, also if it is killed.
    environment = {**os.environ, "TMPDIR": str(folder)}
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "env": environment}
    with ExitStack() as entered:
        for context in tuple(compilation_contexts):
            entered.enter_context(context())
        process = entered.enter_context(tool(command, **options))
        assert process.stdout is not None
        with process.stdout as said:
            lines = said.read().decode(errors="replace").strip().splitlines()
        code = process.wait()
    if code < 0:
        raise NoLibraryError(f"{command[0]} was ended by {signal.Signals(-code).name}")
    if code:
        reason = f"no reason given; is the disk of {folder.parent} full?"
        raise NoLibraryError(f"{command[0]} failed ({code}): {lines[0][:300] if lines else reason}")


@lru_cache(maxsize=1)
def _announce_compilation() -> None:
    """Log once per process that the first flight of a robot waits for the compiler."""
    message = "Compiling the equations of this robot: this takes some seconds, only once."
    _LOG.info(message)
    for announce in tuple(announcement_listeners):
        announce(message)


@lru_cache
def source_hash(*names: str) -> str:
    """Return a hash of package modules and the CasADi version, for function keys."""
    texts = [Path(str(sys.modules[name].__file__)).read_text("utf-8") for name in names]
    return _hash_text("\n".join([ca.__version__, *texts]))


def cached_function(name: str, key: str, build: Callable[[], ca.Function]) -> ca.Function:
    """Return an expensive function from the cache, or derive and cache it; both ways yield the same
    function.

    Parameters
    ----------
    name
        Name of the function.
    key
        Hash of everything the function depends on.
    build
        Derives it.
    """
    cache = Cache(cache_directory())
    serialised = f"{name}-{key[:32]}.casadi"
    if kept := cache.load(serialised, key):
        try:
            return ca.Function.deserialize(kept[1].decode())
        except (RuntimeError, ValueError) as error:
            cache.discard(serialised, str(error))
    function = build()
    cache.store(serialised, key, function.serialize().encode())
    return function


def compilation_settings() -> tuple[str, ...]:
    """Return the compiler and the cache folder, on which compiled functions depend."""
    return (find_compiler() or "", str(cache_directory()))


def find_compiler(language: Language = "c") -> str | None:
    """Return the compiler in use: ``$CC``, ``cc``, ``gcc`` or ``clang`` for C, and ``$CXX``,
    ``c++``, ``g++`` or ``clang++`` for C++; None if there is none."""
    _, variable, *names = _COMPILERS[language]
    candidates = [os.environ.get(variable), *names] if _is_compilation_enabled() else []
    return next((path for each in candidates if each and (path := shutil.which(each))), None)


def cache_directory() -> Path:
    """Return the cache folder for compiled objects; the folder may not exist."""
    chosen = os.environ.get("SPACEROBOT_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "spacerobot_ros"


def _is_compilation_enabled() -> bool:
    return os.environ.get("SPACEROBOT_COMPILE", "1") != "0"


def _hash_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()
