"""Archives of arrays that store manoeuvres."""

from __future__ import annotations

import io
import zipfile
from typing import Any

import numpy as np

from spacerobot_ros.model.description import Array


def archive_name(key: str) -> str:
    """Return the file name of an archive from the hash of its key."""
    return f"{key[:32]}.npz"


def pack_arrays(**arrays: Any) -> bytes:
    """Return arrays and texts as the bytes of a numpy archive."""
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def unpack_arrays(content: bytes, kind: str, *names: str) -> list[Array]:
    """Return the named arrays of an archive.

    Raises
    ------
    ValueError
        It holds no such arrays; the message names the ``kind`` of thing that they would be.
    """
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return [arrays[name] for name in names]
    except (OSError, EOFError, KeyError, MemoryError, ValueError, zipfile.BadZipFile):
        # The message of numpy recommends to trust the file.
        raise ValueError(f"it holds no {kind}") from None
