"""``--view``: the page beside a command, and what is left when the command ends."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from support.chromium import browser, chromium
from support.viewer_page import ROOT, Page

from spacerobot_ros.cli.main import main
from spacerobot_ros.session import viewing
from spacerobot_ros.session.viewing import lower_priority

COMMAND = (sys.executable, "-m", "spacerobot_ros.cli.main")


def test_a_lockstep_flight_is_over_before_it_is_seen() -> None:
    from click.testing import CliRunner

    refused = CliRunner().invoke(main, ["run", "planar_chain", "--view"])
    assert refused.exit_code == 2
    assert "--view needs --realtime" in refused.output


def test_settings_of_a_page_that_is_not_served_are_refused() -> None:
    from click.testing import CliRunner

    for command in (["up", "planar_chain"], ["run", "planar_chain", "--realtime"]):
        refused = CliRunner().invoke(main, [*command, "--set", "viewer.host=0.0.0.0"])
        assert refused.exit_code == 2
        assert "'viewer.host=0.0.0.0' is a web page setting: add --view." in refused.output


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


@contextmanager
def viewed(domain: int, folder: Path, *words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A command with a page, and its address."""
    process = subprocess.Popen(
        [*COMMAND, *words, "--view"],
        env={**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": str(ROOT)},
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    try:
        found = None
        while found is None:
            line = process.stderr.readline()
            assert line, "it has ended"
            found = re.match(r"viewer +(http://127\.0\.0\.1:\d+/)$", line.strip())
        yield process, found[1]
    finally:
        process.kill()
        process.wait()
        process.stderr.close()


def left(domain: int) -> list[str]:
    """Return the command lines of the processes that are in a ROS domain, this one left out."""
    found = []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit() and int(folder.name) != os.getpid():
            with suppress(OSError):
                if f"ROS_DOMAIN_ID={domain}\0" in (folder / "environ").read_text():
                    found.append((folder / "cmdline").read_text().replace("\0", " "))
    return found


def ended(process: subprocess.Popen[str], domain: int) -> float:
    """Send Ctrl-C and return how long it took until no process was left, s."""
    began = time.monotonic()
    process.send_signal(signal.SIGINT)
    process.wait(20)
    while left(domain):
        assert time.monotonic() - began < 20.0, left(domain)
    return time.monotonic() - began


@pytest.mark.study
@pytest.mark.skipif(chromium() is None, reason="no Chromium to open the page with")
def test_a_recording_is_moved_in_time(ros_domain: int, tmp_path: Path) -> None:
    bag = ROOT / "bags" / "planar_chain.mcap"
    with viewed(ros_domain, tmp_path, "replay", str(bag)) as (process, url):
        with browser(tmp_path / "profile") as window:
            page = Page(window, url)
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
                other = Page(phone, url, 390, 780)
                other.wait_for_text("Replay paused: 6.")
                assert phone.evaluate("document.documentElement.scrollWidth") <= 390
                assert phone.complaints == []
            assert window.complaints == []
            assert page.requests_outside() == []
        assert ended(process, ros_domain) < 4.0


@pytest.mark.study
@pytest.mark.skipif(chromium() is None, reason="no Chromium to open the page with")
def test_the_momentum_budget_of_a_recording_is_seen(ros_domain: int, tmp_path: Path) -> None:
    bag = ROOT / "bags" / "wheels.mcap"
    with viewed(ros_domain, tmp_path, "replay", str(bag)) as (process, url):
        with browser(tmp_path / "profile") as window:
            page = Page(window, url)
            page.wait_for_text("Replay ended")
            page.press("Plots")
            page.press("Momentum")
            page.wait_for_text("Angular momentum", "base", "arm", "wheels", "sum", "N m s")
            page.wait_for_text("Momentum budget (N m s)", "wheel_plus_x")
            assert window.complaints == []
        assert ended(process, ros_domain) < 4.0


@pytest.mark.study
def test_a_stack_and_its_viewer_end_together(ros_domain: int, tmp_path: Path) -> None:
    words = ("up", "sliding_masses", "--processes", "--rate", "4")
    with viewed(ros_domain, tmp_path, *words) as (process, _):
        assert any("viewer" in line for line in left(ros_domain))
        assert ended(process, ros_domain) < 6.0


@pytest.mark.study
def test_a_command_that_is_killed_leaves_no_viewer(ros_domain: int, tmp_path: Path) -> None:
    with viewed(ros_domain, tmp_path, "up", "sliding_masses") as (process, _):
        process.kill()
        process.wait()
        end = time.monotonic() + 20.0
        while left(ros_domain):
            assert time.monotonic() < end, left(ros_domain)
