"""Stamps and clock times in whole nanoseconds, split into seconds and a remainder."""

from __future__ import annotations

import struct
from functools import lru_cache
from typing import Any

from spacerobot_ros.errors import SpaceRobotError

SECOND = 1_000_000_000
"""Nanoseconds in a second."""

LATEST_NS = 2**31 * SECOND - 1
"""Latest time, ns, of a builtin_interfaces/Time, whose seconds have 32 bits."""

HEADER_STAMP = slice(4, 12)
"""Bytes of the stamp in a serialised message that begins with a header or a time."""

_TIME_LAYOUT = struct.Struct("<iI")

unpack_stamp = struct.Struct(f"<{HEADER_STAMP.start}xiI").unpack_from
"""Unpacks seconds and nanoseconds of the time at the beginning of a serialised message."""


@lru_cache(maxsize=1)
def stamp_bytes(time_ns: int) -> bytes:
    """Return a time as a serialised builtin_interfaces/Time.

    Raises
    ------
    SpaceRobotError
        The time is outside the range of stamps.
    """
    try:
        return _TIME_LAYOUT.pack(*divmod(time_ns, SECOND))
    except struct.error:
        raise SpaceRobotError(
            f"Stamps support times up to 2^31 s (68 years), not {time_ns / SECOND:.10g} s."
        ) from None


def first_time_ns(raw: bytes) -> int:
    """Return the time at the beginning of a serialised message, limited to 0 ... LATEST_NS, ns."""
    seconds, nanoseconds = unpack_stamp(raw)
    time_ns: int = seconds * SECOND + nanoseconds
    # This runs for every message: three comparisons take less time than min and max.
    return time_ns if 0 <= time_ns <= LATEST_NS else 0 if time_ns < 0 else LATEST_NS


def stamp_to_ns(stamp: Any) -> int:
    """Return a builtin_interfaces/Time or Duration object in nanoseconds."""
    return int(stamp.sec * SECOND + stamp.nanosec)
