"""How near two arrays have to be."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-10


def relative_deviation(actual: npt.ArrayLike, expected: npt.ArrayLike) -> float:
    """Return ``|actual - expected| / |expected|``, Euclidean (Frobenius) norms of the whole array.

    Where next to nothing is expected (a norm below 1e-3 in SI units) it is ``|actual - expected|``
    over 1e-3.
    """
    a, e = np.asarray(actual, dtype=float), np.asarray(expected, dtype=float)
    if a.shape != e.shape:
        raise AssertionError(f"shape {a.shape} where {e.shape} is expected")
    return float(np.linalg.norm(a - e) / max(float(np.linalg.norm(e)), 1e-3))


def assert_agrees(
    actual: npt.ArrayLike, expected: npt.ArrayLike, tolerance: float = TOLERANCE
) -> None:
    """Assert that two arrays agree norm-wise, by default to 1e-10 relative."""
    deviation = relative_deviation(actual, expected)
    assert deviation <= tolerance, (
        f"relative deviation {deviation:.3g} > {tolerance:.3g}\n"
        f"actual: {actual!r}\nexpected: {expected!r}"
    )
