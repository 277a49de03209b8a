"""Which pairs are measured exactly until the nearest is known, by bounds made by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.collision.nearest import NearestPair


def pairs(bounds: list[float], distances: list[float]) -> tuple[Any, list[int]]:
    """Return the search among pairs, and the list of those that it measures."""
    measured: list[int] = []

    def distance(first: int, second: int) -> float:
        assert second == first + 100
        measured.append(first)
        return distances[first]

    made: Any = NearestPair.__new__(NearestPair)
    made._pairs = [(k, k + 100) for k in range(len(bounds))]
    made._place = SimpleNamespace(distance=distance)
    made._bounds = lambda *_: np.array(bounds)
    made.geometry = SimpleNamespace(links_of=lambda pair: f"pair {pair}")
    return made, measured


@pytest.mark.parametrize(
    ("bounds", "distances", "nearest", "looked_at"),
    [
        # By their bounds in order, until the next one cannot be nearer.
        ([0.5, 0.1, 0.3, 0.2], [0.6, 0.25, 0.4, 0.3], (0.25, 1), [1, 3]),
        ([0.5, 0.1, 0.3, 0.2], [0.6, 0.9, 0.35, 0.8], (0.35, 2), [1, 3, 2]),
        # Of equal ones the first.
        ([0.1, 0.1], [0.2, 0.2], (0.2, 0), [0, 1]),
        ([0.2, 0.1], [0.3, 0.2], (0.2, 1), [1]),
        ([-0.3, -0.1], [-0.01, 0.2], (-0.01, 0), [0, 1]),
    ],
)
def test_no_pair_is_measured_in_vain(
    bounds: list[float],
    distances: list[float],
    nearest: tuple[float, int],
    looked_at: list[int],
) -> None:
    made, measured = pairs(bounds, distances)
    assert made.nearest(None, None, None) == nearest
    assert measured == looked_at


def test_links_touch_at_a_distance_of_zero() -> None:
    made, measured = pairs([0.0, -0.1, 1e-9, -0.2], [0.0, 1e-12, -1.0, -0.1])
    assert made.links_in_contact(None, None, None) == {"pair 0", "pair 3"}
    assert measured == [0, 1, 3]
