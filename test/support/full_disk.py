"""A disk of some bytes, on which the writer of bags meets no room."""

from __future__ import annotations

import errno
import io
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeAlias

import pytest


class Disk:
    """A disk of some bytes, in place of the one that `open` opens files on."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, size: int) -> None:
        self.size = size
        disk = self

        class File(io.FileIO):
            def write(self, data: Any) -> int:
                free = disk.size - self.tell()
                if free <= 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                return super().write(bytes(data)[:free])

        def fake_open(path: Path, mode: str, buffering: int) -> File:
            assert buffering == 0
            return File(path, mode)

        monkeypatch.setattr("spacerobot_ros.bag.mcap_file.open", fake_open, raising=False)


MakeDisk: TypeAlias = Callable[[int], Disk]
"""Returns a disk of some bytes, which is in place of the real one from then on."""
