"""Signals end what runs in order, and what was there before is there again."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from spacerobot_ros.session.run import stop_on_signals


@pytest.fixture
def noted() -> Iterator[list[int]]:
    """Note signals that nothing else handles: they would end the tests."""
    found: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: found.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    yield found
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_flight_is_stopped_by_either_signal(noted: list[int], number: signal.Signals) -> None:
    with stop_on_signals() as stopped:
        assert not stopped()
        os.kill(os.getpid(), number)
        assert stopped()
    assert noted == []
    # What was there before is there again.
    os.kill(os.getpid(), number)
    assert noted == [number]
    with stop_on_signals() as stopped:
        assert not stopped(), "a signal of an earlier flight"
