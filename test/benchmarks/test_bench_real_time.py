"""The benchmark of separate processes in real time, for a few seconds."""

from __future__ import annotations

import pytest

from spacerobot_ros.benchmarks.real_time import real_time_flight

pytestmark = pytest.mark.slow


def test_a_short_flight_loses_nothing(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    measured = real_time_flight(50.0, 8.0)
    assert measured.ticks == pytest.approx(8 * 50, abs=60)
    assert measured.duration_s == pytest.approx(8.0, abs=1.0)
    assert measured.states_lost == measured.commands_lost == 0
    # Plant, planner and recorder: Python and its libraries in three processes.
    assert 100 < measured.memory_MiB < 2000
    assert 0 <= measured.missed < 0.5
