"""What a search reports of itself on the way, and what the command line shows of it."""

from __future__ import annotations

import io
import logging

import pytest

from spacerobot_ros import plan
from spacerobot_ros.cli.terminal import Display, display
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.compilation import ANNOUNCEMENT_ATTRIBUTE
from spacerobot_ros.planning.core.progress import SearchProgress, log_progress, report_progress

_LOG = logging.getLogger("spacerobot_ros.planning.somewhere")


class Terminal(io.StringIO):
    """What is written to a terminal."""

    def isatty(self) -> bool:
        return True


def test_a_search_reports_every_start_and_the_best_so_far() -> None:
    seen: list[SearchProgress] = []
    with report_progress(seen.append):
        gait = plan(
            "sliding_masses", position=(0.2, -0.1, 0.05), rotvec=(0.1, 0.0, 0.1), starts=3,
            answers=3, agreeing=0, intervals=16, control_period=0.1, cache=0,
        )  # fmt: skip
    starts = [each.starts for each in seen]
    assert starts[:3] == [1, 2, 3]
    assert starts == sorted(starts)
    assert all(each.max_starts >= each.starts for each in seen)
    best = [each.best_s for each in seen]
    assert best == sorted(best, reverse=True), "it is the best so far"
    # Held commands take a whole number of periods, and bring the gait to the goal exactly.
    assert gait.duration == pytest.approx(best[-1], rel=0.25)
    count = len(seen)
    with pytest.raises(PlanningError):
        plan("sliding_masses", position=(9.0, 0.0, 0.0), starts=1)
    assert len(seen) == count, "nothing is report_progress afterwards"


def test_listening_changes_nothing_for_others() -> None:
    package = logging.getLogger("spacerobot_ros")
    before, handlers = package.level, list(package.handlers)
    sentences: list[str] = []
    with report_progress(lambda progress: None, sentences.append):
        _LOG.info("something")
        _LOG.info("It takes long.", extra={ANNOUNCEMENT_ATTRIBUTE: True})
        log_progress(_LOG, SearchProgress(1, 2), "start 1")
    assert sentences == ["It takes long."]
    assert (package.level, package.handlers) == (before, handlers)


def test_what_is_shown_of_a_search_and_of_a_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    shown = Display("arm", visible=True)
    shown.show_line("Compiling.")
    shown.search(SearchProgress(1, 8))
    shown.search(SearchProgress(8, 8, 12.34567))
    shown.fly(0.0, 0.0)
    shown.fly(5.0, 20.0)
    shown.search(SearchProgress(1, 8))
    shown.fly(20.0, 20.0)
    shown.close()
    text = terminal.getvalue()
    assert text.startswith("Compiling.\n")
    assert "start 1 of at most 8, none found yet" in text
    assert "start 8 of at most 8, best 12.35 s" in text
    assert "5.0 of 20.0 s" in text
    assert text.index("planning arm") < text.index("flying arm")
    assert "planning" not in text[text.index("flying arm") :], "corrections disturb no flight"
    assert "20.0 of 20.0 s" in text


def test_nobody_is_shown_anything_where_nobody_looks(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with display("arm") as shown:
        log_progress(_LOG, SearchProgress(1, 2), "start 1")
        shown.show_line("Compiling.")
        shown.search(SearchProgress(1, 2))
        shown.fly(1.0, 2.0)
    assert capsys.readouterr() == ("", "")
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with display("arm"):
        log_progress(_LOG, SearchProgress(1, 2), "start 1")
    assert "start 1 of at most 2" in terminal.getvalue()
