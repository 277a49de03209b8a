"""Contrast, names and keyboard access of the live page, a report, a campaign and a comparison."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing
from itertools import product
from pathlib import Path

import pytest
from support.accessibility import AXE, ROOT, focus_order, press, problems
from support.chromium import browser, chromium, keep_picture
from support.command_line import spacerobot
from support.viewer_page import CUT, Page, Processes

from spacerobot_ros.report import write_report

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(chromium() is None, reason="no Chromium to open pages with"),
    pytest.mark.skipif(not AXE.exists(), reason="no axe-core: make accessibility"),
]

SERVICER = ("--params-file", str(ROOT / "config" / "servicer.yaml"))
SIZES = {"desktop": (1280, 900), "phone": (390, 780)}
LOOK_BACK = '[role=slider][aria-label="Look back to (s)"]'


@pytest.fixture
def nodes(tmp_path: Path, ros_domain: int) -> Iterator[Processes]:
    with closing(Processes(tmp_path, ros_domain)) as started:
        yield started


@pytest.mark.parametrize("dark", [True, False])
def test_the_live_page(dark: bool, nodes: Processes, tmp_path: Path) -> None:
    url = nodes.start_viewer(f"dark:={str(dark).lower()}")
    nodes.start("plant", "time_mode:=realtime", files=SERVICER)
    nodes.start("coordinated_control", files=SERVICER)
    for size, (width, height) in SIZES.items():
        with browser(tmp_path / size) as window:
            page = Page(window, url, width, height)
            page.wait_for_text("Goal reachable", "Look back to (s)")
            for tab in ("Plots", "Joints", "Faults", "Log", "Goal"):
                page.press(tab)
                page.draw()
                assert problems(window) == [], (size, tab)
                assert window.evaluate(CUT) == [], (size, tab)
                assert window.evaluate("document.documentElement.scrollWidth") <= width
                keep_picture(window, f"page-{tab}-{'dark' if dark else 'light'}-{size}")


def test_every_control_of_the_live_page_has_the_focus_in_turn_and_works_by_key(
    nodes: Processes, tmp_path: Path
) -> None:
    url = nodes.start_viewer()
    nodes.start("plant", "time_mode:=realtime", files=SERVICER)
    nodes.start("coordinated_control", files=SERVICER)
    with browser(tmp_path / "profile") as window:
        page = Page(window, url, 1280, 900)
        page.wait_for_text("Goal reachable")
        # The page names controls a moment after they appear.
        window.wait_for(f"!!document.querySelector('{LOOK_BACK}')")
        window.evaluate("document.activeElement.blur()")
        order = focus_order(window, 50)
        wanted = (
            *("Fly", "Abort goal", "Stop all", "Rearm", "Reset", "Pause", "Resume"),
            *("Look back to (s)", "Look back to (s), as a number"),
            *("Goal", "Plots", "Joints", "Faults", "Log"),
            *("Goal (m) x", "Goal (m) y", "Goal (m) z", "Roll, pitch, yaw (deg) z"),
            *("Goal for the end-effector", "Goal to the robot", "Look at the robot"),
            *("Front", "Side", "Top", "Follow the robot", "Setting", "Layers", "Dark or light"),
        )
        assert not {*wanted} - {*order}, order
        places = [order.index(name) for name in wanted]
        assert places == sorted(places), order

        def focus(name: str) -> None:
            while focus_order(window, 1) != [name]:
                pass

        # A folder opens, a button acts, a slider moves, without a mouse.
        focus("Layers")
        press(window, "Enter")
        page.wait_for_text("Collision shapes")
        focus("Pause")
        press(window, "Enter")
        page.wait_for_text("paused")
        focus("Look back to (s)")
        press(window, "Home")
        page.wait_for_text("Looking back")
        focus("Back to the present")
        press(window, " ")
        page.wait_for_text("paused", without="Looking back")
        focus("Resume")
        press(window, "Enter")
        page.wait_for_text("running", without="paused")
        assert window.complaints == []


@pytest.fixture(scope="module")
def pages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Return pages of one flight, of two, and of a campaign."""
    folder = tmp_path_factory.mktemp("pages")
    found = {name: folder / f"{name}.html" for name in ("report", "beside", "campaign")}
    bags = ROOT / "bags"
    write_report(bags / "servicing.mcap", found["report"])
    write_report(
        bags / "coordinated_control.mcap", found["beside"], beside=[bags / "planar_chain.mcap"]
    )
    words = ["campaign", str(ROOT / "examples" / "campaigns" / "first.yaml")]
    words += ["--flights", "12", "--workers", "0", "--out", str(folder / "first")]
    spacerobot(*words, "--report", str(found["campaign"]))
    return found


@pytest.mark.parametrize(("name", "scheme", "size"), [
    *product(("report", "beside", "campaign"), ("dark", "light"), SIZES),
])  # fmt: skip
def test_written_pages(
    name: str, scheme: str, size: str, pages: dict[str, Path], tmp_path: Path
) -> None:
    with browser(tmp_path / "profile") as window:
        wanted = {"name": "prefers-color-scheme", "value": scheme}
        window.call("Emulation.setEmulatedMedia", features=[wanted])
        window.open(pages[name], *SIZES[size])
        if name != "campaign":
            window.wait_for("document.getElementById('animation').className !== 'loading'")
        assert problems(window) == []
        keep_picture(window, f"{name}-{scheme}-{size}")
        assert window.complaints == []
