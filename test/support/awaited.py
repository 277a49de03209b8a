"""Events of the operating system that tests wait for: a process ends, a file grows."""

from __future__ import annotations

import ctypes
import os
import select
import subprocess
import time
from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from pathlib import Path

_IN_MODIFY, _IN_CREATE = 0x2, 0x100
_IN_NONBLOCK, _IN_CLOEXEC = os.O_NONBLOCK, os.O_CLOEXEC


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

    The file need not be there yet, its folder must. The kernel tells of every change (inotify).
    """
    libc = ctypes.CDLL(None, use_errno=True)
    changes = libc.inotify_init1(_IN_NONBLOCK | _IN_CLOEXEC)
    assert changes >= 0, os.strerror(ctypes.get_errno())
    ended = os.pidfd_open(writer.pid)
    deadline = time.monotonic() + patience
    try:
        added = libc.inotify_add_watch(changes, bytes(file.parent), _IN_MODIFY | _IN_CREATE)
        assert added >= 0, os.strerror(ctypes.get_errno())
        while not file.exists() or file.stat().st_size < size:
            left = deadline - time.monotonic()
            assert left > 0, f"{file.name} has not grown to {size} bytes within {patience:g} s"
            ready, _, _ = select.select([changes, ended], [], [], left)
            assert ended not in ready, f"its writer has ended before {file.name} had {size} bytes"
            if changes in ready:
                os.read(changes, 65536)
    finally:
        os.close(changes)
        os.close(ended)
