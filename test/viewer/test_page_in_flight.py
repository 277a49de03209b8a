"""The page beside `spacerobot up --processes`: paths, shadows, the past, and nodes that die."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from support.chromium import browser, chromium
from support.up import PATIENCE, Up
from support.viewer_page import Page

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(chromium() is None, reason="no Chromium to open the page with"),
]


@pytest.fixture
def up(tmp_path: Path, ros_domain: int) -> Iterator[Up]:
    stack = Up(tmp_path, ros_domain, "reach", "--processes")
    yield stack
    stack.close()


_SCENE = """
(() => {
  const nodes = window.__viserMutable.nodeRefFromName, found = {lines: [], ghosts: [], casts: []};
  for (const [name, node] of Object.entries(nodes)) {
    if (!node) continue;
    if (/_path/.test(name)) node.traverse(each => {
      if (each.isLineSegments2) found.lines.push([each.material.depthTest, each.renderOrder > 0]);
    });
    if (name === "/goal/ghost") node.traverse(each => {
      if (each.isMesh) found.ghosts.push([each.material.polygonOffset, each.material.depthWrite]);
    });
    if (/^\\/robot\\/\\d+$/.test(name)) node.traverse(each => {
      if (each.isMesh) found.casts.push(each.castShadow && each.receiveShadow);
    });
  }
  found.suns = window.__viserMutable.scene.children
    .filter(each => each.isDirectionalLight && each.castShadow).length;
  found.background = window.__viserMutable.scene.background;
  return found;
})()
"""


def test_paths_are_in_front_and_the_sun_casts_shadows(up: Up, tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as window:
        page = Page(window, up.url)
        page.wait_for_text("Waiting for a goal pose.")
        up.goal("--end-effector-position", "1.0", "0.6", "0.7", "--end-effector", "link_7")
        page.wait_for_text("reached", "link_7 is")
        page.press("Front")
        page.draw()
        found = window.evaluate(_SCENE)
        # Paths of the base and of the end-effector, planned and flown.
        assert len(found["lines"]) >= 4
        assert found["lines"] == [[False, True]] * len(found["lines"])
        assert found["ghosts"]
        assert found["ghosts"] == [[True, False]] * len(found["ghosts"])
        assert found["casts"]
        assert all(found["casts"])
        assert found["suns"] > 0

        # The flight is looked back at, and the present comes back.
        page.slide(0.02)
        page.wait_for_text("Looking back", "Back to the present", without="reached")
        page.press("Back to the present")
        page.wait_for_text("reached", without="Looking back")
        assert window.complaints == []


def test_nodes_that_die_are_started_again_and_the_page_says_so(up: Up, tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as window:
        page = Page(window, up.url)
        page.wait_for_text("Waiting for a goal pose.")
        up.goal("--end-effector-position", "1.0", "0.6", "0.7", "--end-effector", "link_7")
        page.wait_for_text("executing")
        up.kill("planner")
        words = "Node 'planner' was ended by SIGKILL. It is started again."
        up.wait_for(words)
        page.wait_for_text(words)
        # It goes on with its goal.
        page.wait_for_text("reached", "link_7 is", without="has been silent")

        # The page comes back to a viewer that was killed.
        window.evaluate("window.stale = true")
        up.kill("viewer")
        up.wait_for("Node 'viewer' was ended by SIGKILL. It is started again.")
        with suppress(AssertionError):  # A question during the change of pages has no answer.
            window.wait_for("window.stale === undefined")
        page.wait_for_text("reached", without="was ended by SIGKILL")

        # A crash has its cause on the terminal; a fourth death within a minute is the end.
        up.kill("planner", signal.SIGSEGV)
        up.wait_for("'planner' was ended by SIGSEGV: Fatal Python error: Segmentation fault.")
        page.wait_for_text("was ended by SIGSEGV")
        page.wait_for_text("Waiting for a goal pose.", without="has been silent")
        up.kill_until("planner", "3 times within a minute, which is the limit (--restarts).")
        assert up.process.wait(PATIENCE) == 2
        # By the last words of the viewer, or because nobody answers.
        page.wait_for_text("This page shows its last state, and steers nothing")
        assert "Planner executing" not in page.text()


def test_the_page_of_a_viewer_that_is_killed_is_grey(ros_domain: int, tmp_path: Path) -> None:
    up = Up(tmp_path, ros_domain, "sliding_masses", "--restarts", "0")
    try:
        with browser(tmp_path / "profile") as window:
            page = Page(window, up.url)
            page.wait_for_text("Waiting for a goal pose.")
            up.kill("viewer")
            page.wait_for_text(
                "The viewer does not answer. This page shows its last state, and steers nothing."
            )
            style = "getComputedStyle(document.documentElement).filter"
            assert window.evaluate(style) == "grayscale(1)"
        up.process.send_signal(signal.SIGINT)
        assert up.process.wait(PATIENCE) == 0
        up.wait_for("Node 'viewer' was ended by SIGKILL.")
    finally:
        up.close()
