"""``--view``: the page beside a command, and what is left when the command ends."""

from __future__ import annotations

import os
import subprocess
import time
from contextlib import closing
from pathlib import Path

import pytest
from support.chromium import browser, chromium
from support.viewed import Viewed
from support.viewer_page import ROOT, Page

from spacerobot_ros.session import viewing
from spacerobot_ros.session.viewing import lower_priority


def test_the_viewer_gives_way_to_what_flies_within_its_session_and_among_sessions() -> None:
    with subprocess.Popen(["sleep", "60"], start_new_session=True) as process:
        try:
            lower_priority(process.pid)
            assert os.getpriority(os.PRIO_PROCESS, process.pid) > 0
            among = Path(f"/proc/{process.pid}/autogroup")
            if among.exists() and (text := among.read_text("ascii")):
                assert int(text.split()[-1]) > 0
        finally:
            process.kill()


def test_a_viewer_that_has_ended_by_itself_is_mentioned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Python runs this file before what it is asked to.
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\n"
        "print('viewer      http://127.0.0.1:1/', os.getpid(), flush=True)\n"
        "while not os.path.exists('end'): pass\n"
        "print('It has lost its way.', file=sys.stderr, flush=True)\n"
        "os._exit(1)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    said: list[str] = []
    with viewing.viewing({}, said.append):
        Path("end").touch()
        stat = Path("/proc", said[0].split()[-1], "stat")
        end = time.monotonic() + 20.0
        while stat.read_text().split()[2] != "Z":
            assert time.monotonic() < end
    assert said[1:] == ["Node 'viewer' has ended with exit code 1: It has lost its way."]


@pytest.mark.study
@pytest.mark.skipif(chromium() is None, reason="no Chromium to open the page with")
def test_a_recording_is_moved_in_time(ros_domain: int, tmp_path: Path) -> None:
    bag = ROOT / "bags" / "planar_chain.mcap"
    with closing(Viewed(tmp_path, ros_domain, "replay", str(bag))) as replay:
        with browser(tmp_path / "profile") as window:
            page = Page(window, replay.url)
            page.wait_for_text("planar_chain.mcap, replay", "Replay ended", without="No state")
            assert "Fly" not in page.text(), "a recording takes no goals"
            page.press("Play")
            page.wait_for_text("Replay playing")
            page.press("Hold")
            page.wait_for_text("Replay paused")
            page.slide(0.5)
            page.wait_for_text("Replay paused: 12.", "t = 12.")
            page.slide(0.25)
            page.wait_for_text("Replay paused: 6.", "t = 6.")
            # A second page, of a phone, shows the same.
            with browser(tmp_path / "phone") as phone:
                other = Page(phone, replay.url, 390, 780)
                other.wait_for_text("Replay paused: 6.")
                assert phone.evaluate("document.documentElement.scrollWidth") <= 390
                assert phone.complaints == []
            assert window.complaints == []
            assert page.requests_outside() == []
        assert replay.end() < 4.0


@pytest.mark.study
@pytest.mark.skipif(chromium() is None, reason="no Chromium to open the page with")
def test_the_momentum_budget_of_a_recording_is_seen(ros_domain: int, tmp_path: Path) -> None:
    bag = ROOT / "bags" / "wheels.mcap"
    with (
        closing(Viewed(tmp_path, ros_domain, "replay", str(bag))) as replay,
        browser(tmp_path / "profile") as window,
    ):
        page = Page(window, replay.url)
        page.wait_for_text("Replay ended")
        page.press("Plots")
        page.press("Momentum")
        page.wait_for_text("Angular momentum", "base", "arm", "wheels", "sum", "N m s")
        page.wait_for_text("Momentum budget (N m s)", "wheel_plus_x")
        assert window.complaints == []


@pytest.mark.study
def test_a_stack_and_its_viewer_end_together(ros_domain: int, tmp_path: Path) -> None:
    words = ("up", "sliding_masses", "--processes", "--rate", "4")
    with closing(Viewed(tmp_path, ros_domain, *words)) as up:
        assert any("viewer" in line for line in up.left().values())
        assert up.end() < 6.0


@pytest.mark.study
def test_a_command_that_is_killed_leaves_no_viewer(ros_domain: int, tmp_path: Path) -> None:
    with closing(Viewed(tmp_path, ros_domain, "up", "sliding_masses")) as up:
        up.process.kill()
        up.wait_until_nothing_is_left()
