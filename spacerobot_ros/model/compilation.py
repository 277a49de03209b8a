"""CasADi functions made fast: generated C, compiled once with the machine's ``cc`` and cached.

Without a compiler, or with ``SPACEROBOT_COMPILE=0``, the same functions run in CasADi's virtual
machine: slower, with the same formulas. Compiled objects live in ``SPACEROBOT_CACHE_DIR``, by
default ``$XDG_CACHE_HOME/spacerobot_ros`` (``~/.cache/spacerobot_ros``), named by what is in them.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import subprocess
import sysconfig
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path

import casadi as ca
import numpy as np

from spacerobot_ros.model.description import Array

_LOG = logging.getLogger(__name__)
# Contraction into fused multiply-adds would make the numbers depend on the processor.
_FLAGS = ("-O2", "-fPIC", "-shared", "-ffp-contract=off")


class BufferedFunction:
    """A CasADi function on fixed memory: fill ``inputs``, call :meth:`evaluate`, read ``outputs``.

    ``inputs`` and ``outputs`` are numpy arrays shaped like the function's arguments (vectors are
    1-D) that stay in place for the life of the object; a call costs well under a microsecond
    beside the computation itself.
    """

    def __init__(self, function: ca.Function) -> None:
        self.function = function
        self._buffer, self.evaluate = function.buffer()
        self.inputs: tuple[Array, ...] = tuple(
            self._attach(function.size_in(i), function.sparsity_in(i), i, self._buffer.set_arg)
            for i in range(function.n_in())
        )
        self.outputs: tuple[Array, ...] = tuple(
            self._attach(function.size_out(i), function.sparsity_out(i), i, self._buffer.set_res)
            for i in range(function.n_out())
        )

    @staticmethod
    def _attach(
        size: tuple[int, int], sparsity: ca.Sparsity, index: int, setter: Callable[..., None]
    ) -> Array:
        if not sparsity.is_dense():
            raise ValueError("a buffered function has dense arguments and results")
        memory = np.zeros(size[0] * size[1])
        setter(index, memory.data)
        # CasADi stores matrices by columns.
        return memory if size[1] == 1 else memory.reshape(size, order="F")

    def __call__(self, *arguments: Array | float) -> tuple[Array, ...]:
        """Evaluate at the given arguments and return copies of the results.

        Raises
        ------
        ValueError
            An argument has the wrong size; the sentence names it.
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


def dense_function(
    name: str, inputs: Mapping[str, ca.SX], outputs: Mapping[str, ca.SX]
) -> ca.Function:
    """Return a CasADi function with dense results and shared common subexpressions.

    ``inputs`` and ``outputs`` are symbols and expressions by the names of arguments and results.
    """
    dense = ca.cse([ca.densify(output) for output in outputs.values()])
    return ca.Function(name, list(inputs.values()), dense, list(inputs), list(outputs))


def compiled(function: ca.Function) -> ca.Function:
    """Return the function as compiled C, or unchanged where that is not possible."""
    compiler = c_compiler()
    if compiler is None:
        return function
    library = _library(function, compiler)
    if library is None:
        return function
    return ca.external(function.name(), str(library))


def c_compiler() -> str | None:
    """Return the C compiler in use: ``$CC``, ``cc``, ``gcc`` or ``clang``; None without one."""
    if os.environ.get("SPACEROBOT_COMPILE", "1") == "0":
        return None
    for candidate in (os.environ.get("CC"), "cc", "gcc", "clang"):
        found = shutil.which(candidate) if candidate else None
        if found:
            return found
    return None


def cache_directory() -> Path:
    """Return the folder of compiled objects (not created)."""
    chosen = os.environ.get("SPACEROBOT_CACHE_DIR")
    if chosen:
        return Path(chosen)
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(base).expanduser() / "spacerobot_ros"


def _library(function: ca.Function, compiler: str) -> Path | None:
    generator = ca.CodeGenerator(function.name(), {"with_header": False})
    generator.add(function)
    source = generator.dump()
    platform = f"{sysconfig.get_platform()} {compiler} {' '.join(_FLAGS)}"
    digest = hashlib.sha256(f"{platform}\n{source}".encode()).hexdigest()[:24]
    library = cache_directory() / f"{function.name()}-{digest}.so"
    if library.exists():
        return library
    try:
        library.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=library.parent) as folder:
            c_file = Path(folder, "function.c")
            c_file.write_text(source, encoding="utf-8")
            built = Path(folder, "function.so")
            subprocess.run(
                [compiler, *_FLAGS, "-o", str(built), str(c_file), "-lm"],
                check=True,
                capture_output=True,
                text=True,
            )
            # Another process may build the same object: the last rename wins, both are whole.
            built.replace(library)
    except (OSError, subprocess.CalledProcessError) as error:
        reason = getattr(error, "stderr", None) or error
        _LOG.warning(
            "The function %s could not be compiled and runs in the virtual machine, slower: %s",
            function.name(),
            str(reason).strip().splitlines()[:1],
        )
        return None
    return library
