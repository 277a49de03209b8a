"""Files that a user has asked for: reports, pictures, results."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

from spacerobot_ros.errors import SpaceRobotError

_MCAP = b"\x89MCAP"
"""What bags begin with."""


def write_output(path: Path, content: bytes | str) -> None:
    """Write a file, and the folders that it is in, as a whole or not at all.

    An older file is replaced once the new one is complete, but for a bag, which may be the only
    record of a flight. Devices and pipes are written to. A text is written as UTF-8.

    Raises
    ------
    SpaceRobotError
        It cannot be written, or is a bag; what was there before stays.
    """
    data = content.encode() if isinstance(content, str) else content
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _write(Path(os.path.realpath(path)), data)
    except OSError as error:
        reason = error.strerror
        if isinstance(error, FileExistsError | NotADirectoryError):
            reason = f"{path.parent} is no folder"
        raise SpaceRobotError(f"The file {path} cannot be written: {reason}.") from error


def _write(path: Path, data: bytes) -> None:
    before = path.stat() if path.exists() else None
    in_place = before is not None and not stat.S_ISREG(before.st_mode)
    if before is not None and not in_place and _is_bag(path):
        raise SpaceRobotError(f"The file {path} is a bag, which is not replaced: name another.")
    if in_place or not os.access(path.parent, os.W_OK):
        path.write_bytes(data)
        return
    # The umask applies, as it does to any new file; an old one keeps its mode.
    mode = 0o666 if before is None else stat.S_IMODE(before.st_mode)
    made = path.with_name(f".{path.name[:100]}.{os.getpid()}.new")
    with suppress(FileNotFoundError):
        made.unlink()  # Of a process that was killed.
    try:
        with os.fdopen(os.open(made, os.O_CREAT | os.O_WRONLY | os.O_EXCL, mode), "wb") as file:
            file.write(data)
        made.replace(path)
    except BaseException:
        with suppress(OSError):
            made.unlink()
        raise


def _is_bag(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(len(_MCAP)) == _MCAP
