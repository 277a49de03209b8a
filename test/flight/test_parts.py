"""Parts of a flight by themselves: its loop, its bag, and what is read of it."""

from __future__ import annotations

import numpy as np

from spacerobot_ros.flight import reading
from spacerobot_ros.flight.flight import Signal

# -- what a bag holds ----------------------------------------------------------------------------


def test_an_impulse_is_the_sum_of_thrusts_times_the_ticks_before_them() -> None:
    thrust = Signal(np.array([0.5, 1.0, 3.0]), np.array([[9.0, 9.0], [1.0, 2.0], [3.0, 0.0]]))
    found = reading.impulse(thrust, np.array([2.0, 10.0]))
    assert found.time.tolist() == [0.5, 1.0, 3.0]
    # 0, then half a second of 22, then two seconds of 6.
    assert found.values.tolist() == [[0.0], [11.0], [23.0]]
