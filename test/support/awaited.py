"""Processes and events of the operating system: a process ends, a file grows."""

from __future__ import annotations

import ctypes
import os
import select
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from pathlib import Path

_IN_MODIFY, _IN_MOVED_TO, _IN_CREATE = 0x2, 0x80, 0x100
_CHANGES = _IN_MODIFY | _IN_MOVED_TO | _IN_CREATE
_IN_NONBLOCK, _IN_CLOEXEC = os.O_NONBLOCK, os.O_CLOEXEC


def processes_with(variable: str, command: str = "") -> dict[int, str]:
    """Return the command lines of living processes by their ids.

    Of those whose environment has ``NAME=value`` and whose command line has the words between
    zeros.
    """
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
            words = (folder / "cmdline").read_text()
            ours = f"{variable}\0" in (folder / "environ").read_text()
            if ours and state not in "ZX" and command in words:
                found[int(folder.name)] = words.replace("\0", " ")
    return found


def await_end(still: Callable[[], Iterable[int]], patience: float) -> list[int]:
    """Wait until no process is left of those that ``still`` names, and return those that are.

    Each is waited for by its descriptor (pidfd), then ``still`` is asked again: a process may have
    started another one before it ended.

    Parameters
    ----------
    still
        Returns process ids.
    patience
        Wall s after which it is given up.
    """
    deadline = time.monotonic() + patience
    while (left := list(still())) and time.monotonic() < deadline:
        with ExitStack() as opened:
            for pid in left:
                with suppress(ProcessLookupError):
                    descriptor = os.pidfd_open(pid)
                    opened.callback(os.close, descriptor)
                    select.select([descriptor], [], [], max(0.0, deadline - time.monotonic()))
    return left


def await_size(file: Path, size: int, writer: subprocess.Popen[bytes], patience: float) -> None:
    """Wait until a file has a size in bytes, or fail as soon as the process that writes it ends.

    The file need not be there yet, its folder must.
    """

    def grown() -> bool:
        return file.exists() and file.stat().st_size >= size

    await_files([file.parent], grown, writer, patience)


def await_files(
    folders: Iterable[Path],
    met: Callable[[], bool],
    writer: subprocess.Popen[bytes],
    patience: float,
) -> None:
    """Wait until what is in some folders is as ``met`` says, or fail when its writer ends before.

    The kernel tells of every change (inotify) in those of the folders that are there; one at least
    must be, and the others must appear in it or in each other.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    changes = libc.inotify_init1(_IN_NONBLOCK | _IN_CLOEXEC)
    assert changes >= 0, os.strerror(ctypes.get_errno())
    ended = os.pidfd_open(writer.pid)
    deadline = time.monotonic() + patience
    watched = list(folders)
    try:
        while True:
            for folder in watched:
                # Once more is no harm: a folder has one watch.
                added = libc.inotify_add_watch(changes, bytes(folder), _CHANGES)
                assert added >= 0 or not folder.exists(), os.strerror(ctypes.get_errno())
            if met():
                return
            left = deadline - time.monotonic()
            assert left > 0, f"not met in {watched[0]} within {patience:g} s"
            ready, _, _ = select.select([changes, ended], [], [], left)
            # What it wrote last may have come with its end.
            assert ended not in ready or met(), f"its writer has ended before, in {watched[0]}"
            if changes in ready:
                os.read(changes, 65536)
    finally:
        os.close(changes)
        os.close(ended)
