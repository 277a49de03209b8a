"""Signals ask a flight to end, or end what asks for nothing; what was there before comes back."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator

import pytest

from spacerobot_ros.termination import Terminated, graceful_shutdown, guarded

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture
def noted() -> Iterator[list[int]]:
    """Note signals that nothing else handles: they would end the tests."""
    found: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: found.append(number)) for number in SIGNALS
    }
    yield found
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_flight_is_asked_to_end_by_each_signal(noted: list[int], number: signal.Signals) -> None:
    asked: list[str] = []
    try:
        with graceful_shutdown(lambda: asked.append("main")) as stopped:
            assert not stopped()
            os.kill(os.getpid(), number)
            assert stopped()
            assert asked == ["main"]
    except Terminated as end:
        # It is no Exception: pytest itself would end.
        pytest.fail(f"the flight was ended: {end}")
    assert noted == []
    # What was there before is there again.
    os.kill(os.getpid(), number)
    assert noted == [number]
    with graceful_shutdown() as stopped:
        assert not stopped(), "a signal of an earlier flight"


@pytest.mark.parametrize("number", SIGNALS)
def test_what_asks_for_nothing_is_ended(noted: list[int], number: signal.Signals) -> None:
    with pytest.raises(Terminated) as end, guarded():
        os.kill(os.getpid(), number)
    assert end.value.exit_code == 128 + number
    assert noted == []
