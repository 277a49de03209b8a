"""Progress bars of commands, by a stand-in for those of click."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import click
import pytest

import spacerobot_ros.planning.core.progress as searches
from spacerobot_ros.campaign.running import Progress
from spacerobot_ros.cli import campaign
from spacerobot_ros.cli.terminal import Display, display
from spacerobot_ros.planning.core.progress import SearchProgress


class Bar:
    """A progress bar that keeps what it was given."""

    def __init__(self, **given: Any) -> None:
        self.given, self.length, self.pos = given, given["length"], 0
        self.shown: list[tuple[int, str]] = []
        self.state = "made"

    def __enter__(self) -> Bar:
        self.state = "open"
        return self

    def __exit__(self, *of: object) -> None:
        self.state = "closed"

    def update(self, steps: int, text: str) -> None:
        self.pos += steps
        self.shown.append((self.pos, text))


@pytest.fixture
def bars(monkeypatch: pytest.MonkeyPatch) -> list[Bar]:
    """Return the bars that are made."""
    made: list[Bar] = []

    def make(**given: Any) -> Bar:
        made.append(Bar(**given))
        return made[-1]

    monkeypatch.setattr(click, "progressbar", make)
    return made


def search(starts: int, most: int) -> Any:
    return SimpleNamespace(starts=starts, max_starts=most, message=f"{starts} of {most}")


def test_a_search_has_a_bar_and_then_the_flight_one(
    bars: list[Bar], capsys: pytest.CaptureFixture[str]
) -> None:
    shown = Display("a robot", visible=True)
    for starts, most in ((1, 8), (3, 8), (4, 9)):
        shown.search(search(starts, most))
    (bar,) = bars
    assert bar.state == "open"
    assert bar.given == {
        "length": 8,
        "label": "planning a robot",
        "file": sys.stderr,
        "show_eta": False,
        "show_percent": False,
        "item_show_func": bar.given["item_show_func"],
        "bar_template": "%(label)s  [%(bar)s]  %(info)s",
        "width": 24,
    }
    assert [bar.given["item_show_func"](item) for item in (None, "", "so")] == ["", "", "so"]
    assert bar.length == 9
    assert bar.shown == [(1, "1 of 8"), (3, "3 of 8"), (4, "4 of 9")]
    # A search that begins again has another bar, as one that reports its first start again.
    shown.search(search(4, 9))
    assert [each.state for each in bars] == ["closed", "open"]
    assert bars[1].shown == [(4, "4 of 9")]
    shown.show_line("A line.")
    assert bars[1].state == "closed"
    assert capsys.readouterr().err == "A line.\n"
    # Without a schedule there is no end to fly to.
    shown.fly(0.5, 0.0)
    assert len(bars) == 2
    for now, end in ((0.0, 8.0), (1.0, 8.0), (3.003, 8.0), (3.0, 12.0), (16.0, 12.0)):
        shown.fly(now, end)
    bar = bars[2]
    assert (bar.given["label"], bar.given["length"]) == ("flying a robot", 1000)
    assert bar.shown == [
        (0, "0.0 of 8.0 s"),
        (125, "1.0 of 8.0 s"),
        (375, "3.0 of 8.0 s"),
        # A correction makes the flight longer: the bar does not go back.
        (375, "3.0 of 12.0 s"),
        (1000, "16.0 of 12.0 s"),
    ]
    shown.search(search(1, 8))
    assert len(bars) == 3
    shown.close()
    assert bar.state == "closed"
    shown.close()


def test_without_a_terminal_nothing_is_shown(
    bars: list[Bar], capsys: pytest.CaptureFixture[str]
) -> None:
    shown = Display("a robot", visible=False)
    shown.search(search(1, 8))
    shown.fly(1.0, 2.0)
    shown.show_line("A line.")
    shown.close()
    assert bars == []
    assert capsys.readouterr().err == ""
    with display("a robot") as quiet:
        quiet.fly(1.0, 2.0)
    assert bars == []


def test_in_a_terminal_searches_are_shown(bars: list[Bar], monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Any] = []

    @contextmanager
    def report_progress(
        show: Callable[[SearchProgress], None], say: Callable[[str], None]
    ) -> Iterator[None]:
        told.extend([show, say])
        yield

    monkeypatch.setattr(searches, "report_progress", report_progress)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with display("a robot") as shown:
        assert told == [shown.search, shown.show_line]
        told[0](search(2, 5))
    assert bars[0].state == "closed"
    assert bars[0].shown == [(2, "2 of 5")]


def test_a_campaign_shows_its_flights_its_rate_and_the_time_left(
    bars: list[Bar], monkeypatch: pytest.MonkeyPatch
) -> None:
    with campaign._progress_bar("many") as show:
        show(Progress(1, 2, 3.0, 4.0))
    assert bars == []
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with campaign._progress_bar("many") as show:
        for progress in (
            *(Progress(0, 400, 0.0, 1.0), Progress(3, 400, 1.5, 2.0)),
            *(Progress(2, 400, 0.12345, 3.0), Progress(400, 400, 100.0, 4.0)),
        ):
            show(progress)
    (bar,) = bars
    assert bar.given == {
        "length": 1000,
        "label": "many",
        "file": sys.stderr,
        "show_eta": False,
        "item_show_func": str,
    }
    assert bar.shown == [
        (0, "0/400, 0/s, ? left"),
        (7, "3/400, 1.5/s, 0:04:25 left"),
        (7, "2/400, 0.123/s, 0:53:44 left"),
        (1000, "400/400, 100/s, 0:00:00 left"),
    ]
    assert bar.state == "closed"
