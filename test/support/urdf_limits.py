"""URDF texts with other limits."""

from __future__ import annotations

import re


def without_stops(urdf: str) -> str:
    """Return a URDF whose joints never come near the ends of their strokes."""
    return re.sub(r'lower="[^"]*" upper="[^"]*"', 'lower="-1e9" upper="1e9"', urdf)


def with_effort_limit(urdf: str, limit: float) -> str:
    """Return a URDF with one effort limit (N or N m) for all joints."""
    return re.sub(r'effort="[^"]*"', f'effort="{limit!r}"', urdf)
