"""The page in flight, desktop and phone, dark and light: the robot is visible, no text is cut off.

`make page-pictures` keeps the pictures in out/pages.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.chromium import Browser, browser, chromium, keep_picture
from support.viewed import PATIENCE, Viewed
from support.viewer_page import CUT, Page

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(chromium() is None, reason="no Chromium to open the page with"),
]

SIZES = {"desktop": (1440, 900), "phone": (390, 844)}

# A browser without a graphics card leaves little of the processor: it draws less often.
RATE = ("--set", "viewer.update_rate=8")

_NODE = """
(name => {
  const viewer = window.__viserMutable, node = viewer.nodeRefFromName[name];
  node.updateWorldMatrix(true, false);
  return node.matrixWorld.elements.slice(12, 15);
})
"""

_UNDER = """
(([x, y, z]) => {
  const {camera} = window.__viserMutable;
  camera.updateMatrixWorld();
  const at = camera.position.clone().set(x, y, z).project(camera);
  const [px, py] = [(at.x + 1) / 2 * innerWidth, (1 - at.y) / 2 * innerHeight];
  const element = document.elementFromPoint(px, py);
  return [px, py, element ? element.tagName : "nothing"];
})
"""
"""The pixel of a point of the scene, and the element that is seen there."""


class Looked:
    """A page that is looked at in both sizes and both themes."""

    def __init__(self, window: Browser, url: str) -> None:
        self.window = window
        self.page = Page(window, url, *SIZES["desktop"])
        # A notice of browsers without a graphics card, which covers the scene.
        window.evaluate("document.querySelector('.mantine-Notification-root button')?.click()")

    def at(self, node: str) -> np.ndarray:
        """Return where a node of the scene is in the world, m."""
        return np.array(self.window.evaluate(f"{_NODE}({node!r})"))

    def element_at(self, point: np.ndarray) -> str:
        """Return the kind of element that is seen where a point of the scene is."""
        x, y, element = self.window.evaluate(f"{_UNDER}({point.tolist()})")
        assert x >= 0
        assert y >= 0
        return str(element)

    def keep(self, name: str, *, tab: str = "Goal") -> None:
        """Check and keep the page in both sizes and both themes."""
        for size, (width, height) in SIZES.items():
            self.window.resize(width, height)
            self.page.draw()
            self.page.press(tab)  # Another size begins with the first one.
            self.page.press("Look at the robot")
            self.window.wait_for(
                f"({_UNDER}({_NODE}('/robot')))[2] === 'CANVAS'"  # Not below the panel.
            )
            assert self.window.evaluate("document.documentElement.scrollWidth") <= width
            for theme in ("dark", "light"):
                self.window.wait_for(
                    "document.documentElement.dataset.mantineColorScheme === " + repr(theme)
                )
                self.window.evaluate(
                    "document.querySelectorAll('.mantine-ScrollArea-viewport')"
                    ".forEach(each => each.scrollTo(0, 0))"
                )
                self.page.draw()
                assert self.window.evaluate(CUT) == [], (name, size, theme)
                keep_picture(self.window, f"{name}-{theme}-{size}")
                self.page.press("Dark or light")
        self.window.resize(*SIZES["desktop"])


@contextmanager
def flying(folder: Path, domain: int, *words: str) -> Iterator[tuple[Viewed, Looked]]:
    with (
        closing(Viewed(folder, domain, "up", *words, *RATE)) as up,
        browser(folder / "profile") as window,
    ):
        yield up, Looked(window, up.url)
        assert window.complaints == []


def ghost_color(looked: Looked) -> list[float]:
    """Return red, green and blue of the ghost, 0 to 1."""
    return list(
        looked.window.evaluate(
            "(() => { let found = null; window.__viserMutable.nodeRefFromName['/goal/ghost']"
            ".traverse(each => { if (each.isMesh) found = each.material.color; });"
            "return [found.r, found.g, found.b]; })()"
        )
    )


def test_a_goal_that_is_partly_controlled_is_amber_and_the_ghost_is_where_the_robot_ends(
    tmp_path: Path, ros_domain: int
) -> None:
    with flying(tmp_path, ros_domain, "arm_attitude") as (_, looked):
        page = looked.page
        page.wait_for_text("Waiting for a goal pose.", "Goal reachable")
        page.type("Roll, pitch, yaw (deg)", [4, 3, 8])
        page.type("Goal (m)", [0.3, 0.16, 0.0])
        page.wait_for_text(
            "Goal partly reachable", "'area_loop' does not control the position: it ends 0.3"
        )
        looked.keep("partly-reachable")
        red, green, blue = ghost_color(looked)
        assert red > green > blue
        left = np.linalg.norm(looked.at("/goal") - looked.at("/goal/ghost"))
        assert left == pytest.approx(0.34, abs=0.01)
        assert np.linalg.norm(looked.at("/goal/ghost") - looked.at("/robot")) < 0.03
        page.press("Fly")
        page.wait_for_text("executing", "Not controlled: position.", " m (not controlled) and ")
        looked.keep("partly-controlled")
        assert ghost_color(looked) == [red, green, blue]


def test_layers_settings_and_views_of_a_flight_of_an_end_effector(
    tmp_path: Path, ros_domain: int
) -> None:
    with flying(tmp_path, ros_domain, "reach") as (up, looked):
        page = looked.page
        page.wait_for_text("Waiting for a goal pose.")
        up.goal("--end-effector-position", "1.0", "0.6", "0.7", "--end-effector", "link_7")
        # The page shows the goal of others, and where the plan ends.
        page.wait_for_text("The robot flies to the ghost.", "link_7 is")
        assert page.numbers("Goal (m)") == [1.0, 0.6, 0.7]
        page.wait_for_text("reached")
        looked.keep("end-effector")
        page.press("Layers")
        for layer in ("Frames", "Collision shapes", "Names"):
            page.tick(layer)
        looked.window.wait_for(
            "Object.keys(window.__viserMutable.nodeRefFromName).some(n => n.includes('collision'))"
        )
        looked.keep("layers")
        for layer in ("Frames", "Collision shapes", "Names"):
            page.tick(layer)
        page.press("Layers")
        page.choose("Setting", "Grid")
        looked.keep("grid")
        page.choose("Setting", "Space")
        for view in ("Front", "Side", "Top"):
            page.press(view)
            page.draw()
            assert looked.element_at(looked.at("/robot")) == "CANVAS"
            keep_picture(looked.window, f"view-{view.lower()}")
        for tab in ("Plots", "Joints", "Log"):
            looked.keep(f"tab-{tab.lower()}", tab=tab)


def test_a_controlled_flight_that_is_looked_back_at_aborted_and_stopped(
    tmp_path: Path, ros_domain: int
) -> None:
    with flying(tmp_path, ros_domain, "servicer_thrusters") as (_, looked):
        page = looked.page
        page.wait_for_text("Goal reachable")
        page.type("Goal (m)", [0.8, 0.4, 0.2])
        page.wait_for_text("Goal reachable", without="being moved")
        page.press("Fly")
        page.wait_for_text("s to go.", "from the reference", "(tolerance 0.5 mm, 1 mrad)")
        looked.keep("controlled")
        page.slide(0.3)
        page.wait_for_text("Looking back")
        looked.keep("look-back")
        page.press("Back to the present")
        page.press("Abort goal")
        page.wait_for_text("Aborted on request; the robot holds its pose.", "Plant running")
        looked.keep("aborted")
        page.press("Stop all")
        page.wait_for_text(
            "Plant latched", "stopped on request", "The base drifts at", "Press Rearm."
        )
        looked.keep("stopped")
        page.press("Fly")
        page.wait_for_text("'/plant' is latched: stopped on request; rearm it first by its ")
        page.press("Rearm")
        page.wait_for_text(
            "Commands are accepted again", "Plant running", without="until the plant is rearmed"
        )


def test_goals_in_flight_that_are_refused_typed_or_seen_by_a_page_that_is_loaded_again(
    tmp_path: Path, ros_domain: int
) -> None:
    with flying(tmp_path, ros_domain, "sliding_masses", "--rate", "0.1") as (up, looked):
        page = looked.page
        page.wait_for_text(
            "Goal reachable", "sliding_masses, 0.1 times real time", "Drag the arrows"
        )
        page.type("Goal (m)", [0.3, -0.25, 0.1])
        page.wait_for_text("Goal reachable", without="Drag the arrows")
        page.press("Fly")
        page.wait_for_text("executing", "s to go", "(tolerance 20 mm, 60 mrad)")
        # A goal that is refused leaves the first one as it is.
        up.goal("9", "0", "0", "0", "0", "0", "1")
        # The planner says so for a moment, before it plans the rest again; the page for longer.
        page.wait_for_text("The goal position is out of reach", "executing", "s to go")
        assert page.numbers("Goal (m)") == [0.3, -0.25, 0.1]
        looked.keep("refused-in-flight")
        # Another goal is typed while the robot flies to the last one.
        page.type("Goal (m)", [0.1, 0.0, 0.05])
        page.wait_for_text("Goal reachable", without="being moved")
        page.press("Fly")
        page.wait_for_text("The goal is accepted.", "executing", "s to go")
        # A page that is loaded again, or by somebody else, shows the flight as it is.
        again = Looked(looked.window, up.url)
        again.page.wait_for_text("executing", "s to go", "base is ", "(tolerance 20 mm, 60 mrad)")
        assert again.page.numbers("Goal (m)") == [0.1, 0.0, 0.05]
        assert np.linalg.norm(again.at("/goal/ghost") - again.at("/goal")) < 0.02
        again.keep("loaded-again")


@pytest.mark.parametrize("scenario", ["planar_chain", "coordinated_control"])
def test_a_planar_robot(scenario: str, tmp_path: Path, ros_domain: int) -> None:
    with flying(tmp_path, ros_domain, scenario) as (_, looked):
        page = looked.page
        page.wait_for_text("Goal reachable")
        page.type("Roll, pitch, yaw (deg)", [0, 0, 25])
        page.wait_for_text("reachable", without="being moved")
        page.press("Fly")
        if scenario == "planar_chain":
            page.wait_for_text("executing", "Not controlled: position.", "s to go")
        else:
            page.wait_for_text("s to go.", "from the reference", "(tolerance 1 mm, 1 mrad)")
        assert "refused" not in page.text()
        looked.keep(f"planar-{scenario}")


def test_a_slow_phone(tmp_path: Path, ros_domain: int) -> None:
    """A processor four times slower behind 1.6 Mbit/s with 150 ms: the page is usable."""
    with (
        closing(Viewed(tmp_path, ros_domain, "up", "sliding_masses", *RATE)) as up,
        browser(tmp_path / "profile") as window,
    ):
        window.call("Emulation.setCPUThrottlingRate", rate=4)
        window.call(
            "Network.emulateNetworkConditions",
            offline=False, latency=150, downloadThroughput=2e5, uploadThroughput=9e4,
        )  # fmt: skip
        began = time.monotonic()
        page = Page(window, up.url, *SIZES["phone"])
        page.wait_for_text("Goal reachable")
        window.wait_for("!!window.__viserMutable?.nodeRefFromName?.['/robot']")
        print(f"slow phone: robot and status after {time.monotonic() - began:.1f} s")
        window.evaluate("document.querySelector('.mantine-Notification-root button')?.click()")
        page.type("Goal (m)", [0.3, -0.25, 0.1])
        page.wait_for_text("Goal reachable", without="being moved")
        page.press("Fly")
        page.wait_for_text("executing", "s to go", "base is ")
        page.press("Look at the robot")
        window.wait_for(f"({_UNDER}({_NODE}('/robot')))[2] === 'CANVAS'")
        assert window.evaluate("document.documentElement.scrollWidth") <= SIZES["phone"][0]
        keep_picture(window, "slow-phone")
        assert window.complaints == []


def test_nodes_that_die_and_the_end_of_the_stack(tmp_path: Path, ros_domain: int) -> None:
    with flying(tmp_path, ros_domain, "reach", "--processes") as (up, looked):
        page = looked.page
        page.wait_for_text("Waiting for a goal pose.")
        up.kill("planner")
        page.wait_for_text("Node 'planner' was ended by SIGKILL. It is restarted.")
        looked.keep("restarted")
        up.kill_until("planner", "3 times within a minute, which is the limit (--restarts).")
        assert up.process.wait(PATIENCE) == 2
        page.wait_for_text("This page shows its last state and can no longer steer the robot.")
        # Buttons do nothing any more: one picture.
        keep_picture(looked.window, "ended-light-desktop")
        ended: Any = looked.window.evaluate("document.body.innerText")
        assert "Planner executing" not in ended
        looked.window.complaints.clear()  # The page asks for its viewer.
