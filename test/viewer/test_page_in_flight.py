"""The page beside a stack, its accessibility, and what its users do in a browser."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from support.chromium import browser, chromium
from support.ros_harness import Harness, Probe
from support.viewed import PATIENCE, Viewed
from support.viewer_page import ROOT, Page, Processes

from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.viewer.page import CAMERA, view_beside_panel
from spacerobot_ros.viewer.scene import reach_of

pytestmark = [
    pytest.mark.study,
    pytest.mark.skipif(chromium() is None, reason="no Chromium to open the page with"),
]


@pytest.fixture
def up(tmp_path: Path, ros_domain: int) -> Iterator[Viewed]:
    with closing(Viewed(tmp_path, ros_domain, "up", "reach", "--processes")) as stack:
        yield stack


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


def test_paths_are_in_front_and_the_sun_casts_shadows(up: Viewed, tmp_path: Path) -> None:
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


_FROM_ROBOT = """
(() => {
  const viewer = window.__viserMutable, robot = viewer.nodeRefFromName["/robot"];
  const here = robot.getWorldPosition(robot.position.clone());
  const target = viewer.cameraControl.getTarget(here.clone());
  return [here.toArray(), target.sub(here).toArray()];
})()
"""
"""Where the robot is, and where the camera looks beside it."""


def test_the_goal_of_the_scenario_is_flown_by_a_press(ros_domain: int, tmp_path: Path) -> None:
    with (
        closing(Viewed(tmp_path, ros_domain, "up", "coordinated_control", "--rate", "4")) as up,
        browser(tmp_path / "profile") as window,
    ):
        page = Page(window, up.url)
        page.wait_for_text("coordinated_control, 4 times real time", "Drag", "holding")
        page.tick("Follow the robot")
        start, aside = window.evaluate(_FROM_ROBOT)
        page.press("Fly the scenario's goal")
        page.wait_for_text("The goal is accepted.", "tracking")
        arrow = "!!window.__viserMutable.nodeRefFromName['/end_effector_goal']?.visible"
        window.wait_for(f"!{arrow}")  # The arrows of the goal that is flown to.
        page.wait_for_text("The goal is reached", without="Drag the arrows")
        scenario = load_scenario("coordinated_control")
        np.testing.assert_allclose(page.numbers(POSITION), scenario.goal.position, atol=1e-4)
        window.wait_for(arrow)
        # The camera has followed the robot, and no step of it was lost.
        end, still = window.evaluate(_FROM_ROBOT)
        assert np.linalg.norm(np.subtract(end, start)) > 0.1
        np.testing.assert_allclose(still, aside, atol=1e-3)
        assert window.complaints == []


def test_nodes_that_die_are_started_again_and_the_page_says_so(up: Viewed, tmp_path: Path) -> None:
    with browser(tmp_path / "profile") as window:
        page = Page(window, up.url)
        page.wait_for_text("Waiting for a goal pose.")
        up.goal("--end-effector-position", "1.0", "0.6", "0.7", "--end-effector", "link_7")
        page.wait_for_text("executing")
        up.kill("planner")
        words = "Node 'planner' was ended by SIGKILL. It is restarted."
        up.wait_for(words)
        page.wait_for_text(words)
        # It goes on with its goal.
        page.wait_for_text("reached", "link_7 is", without="has been silent")

        # The page comes back to a viewer that was killed.
        window.evaluate("window.stale = true")
        up.kill("viewer")
        up.wait_for("Node 'viewer' was ended by SIGKILL. It is restarted.")
        with suppress(AssertionError):  # A question during the change of pages has no answer.
            window.wait_for("window.stale === undefined")
        page.wait_for_text("reached", without="was ended by SIGKILL")

        # A crash has its cause on the terminal; a fourth death within a minute is the end.
        up.kill("planner", signal.SIGSEGV)
        up.wait_for("'planner' was ended by SIGSEGV: Fatal Python error: Segmentation fault")
        page.wait_for_text("was ended by SIGSEGV")
        page.wait_for_text("Waiting for a goal pose.", without="has been silent")
        up.kill_until("planner", "3 times within a minute, which is the limit (--restarts).")
        assert up.process.wait(PATIENCE) == 2
        # By the last words of the viewer, or because nobody answers.
        page.wait_for_text("This page shows its last state and can no longer steer the robot.")
        assert "Planner executing" not in page.text()


def test_the_page_of_a_viewer_that_is_killed_is_grey(ros_domain: int, tmp_path: Path) -> None:
    with closing(Viewed(tmp_path, ros_domain, "up", "sliding_masses", "--restarts", "0")) as up:
        with browser(tmp_path / "profile") as window:
            page = Page(window, up.url)
            page.wait_for_text("Waiting for a goal pose.")
            up.kill("viewer")
            page.wait_for_text(
                "The viewer does not respond. This page shows its last state and can no longer "
                "steer the robot."
            )
            style = "getComputedStyle(document.documentElement).filter"
            assert window.evaluate(style) == "grayscale(1)"
        up.process.send_signal(signal.SIGINT)
        assert up.process.wait(PATIENCE) == 0
        up.wait_for("Node 'viewer' was ended by SIGKILL.")


# -- the page in a real browser: what its users do, against what the robot then does -------------


FILE = ("--params-file", str(ROOT / "config" / "sliding_masses.yaml"))
# A browser that draws without a graphics card leaves little of a processor to the planner.
PLANT = ("time_mode:=realtime", "real_time_factor:=4.0", "command_timeout:=60.0")
PLANNER = ("plan_in_background:=true",)
_QUEUED = 20
"""States: more than wait in a subscription."""
POSITION, ANGLES = "Goal (m)", "Roll, pitch, yaw (deg)"


@pytest.fixture
def nodes(tmp_path: Path, ros_domain: int) -> Iterator[Processes]:
    with closing(Processes(tmp_path, ros_domain)) as started:
        yield started


class Watched:
    """What the stack says, heard by a tool beside the viewer."""

    def __init__(self, harness: Harness) -> None:
        self._harness = harness
        topics: dict[str, Any] = {"odom": Odometry, "plant/status": DiagnosticStatus}
        topics |= {"planner/status": DiagnosticStatus, "joint_states": JointState}
        latched = ("plant/status", "planner/status")
        self.probe: Probe = harness.probe(topics, latched=latched)

    def hear(self) -> None:
        """Take a state that was published after this call, and what came before it."""
        enough = self.probe.count("odom") + _QUEUED
        self._harness.spin_until(
            lambda: self.probe.count("odom") >= enough and self.probe.count("planner/status"),
            "states come",
            timeout=60.0,
        )

    @property
    def position(self) -> Array:
        p = self.probe.last("odom").pose.pose.position
        return np.array([p.x, p.y, p.z])

    @property
    def joints(self) -> Array:
        return np.array(self.probe.last("joint_states").position)

    def value(self, topic: str, key: str) -> str:
        values = {pair.key: pair.value for pair in self.probe.last(topic).values}
        return str(values.get(key, ""))

    def wait(self, topic: str, key: str, value: str) -> None:
        try:
            self._harness.spin_until(
                lambda: self.probe.count(topic) and self.value(topic, key) == value,
                f"{key} of {topic} is {value}",
                timeout=120.0,  # A browser that draws in software may leave little to the planner.
            )
        except AssertionError as error:
            said = [each.message for each in self.probe.messages[topic][-3:]]
            raise AssertionError(f"{error}; last it said {said}") from error


def test_a_mission_is_flown_from_the_page(
    harness: Harness, nodes: Processes, tmp_path: Path
) -> None:
    # The page is opened before there is anything to see.
    url = nodes.start_viewer()
    with browser(tmp_path / "profile") as window:
        page = Page(window, url)
        page.wait_for_text("No state received yet")
        page.press("Fly")
        nodes.start("plant", *PLANT, files=FILE)
        nodes.start("planner", *PLANNER, files=FILE)
        watched = Watched(harness)
        page.wait_for_text("Waiting for a goal pose.", "Goal reachable")
        watched.hear()
        np.testing.assert_allclose(watched.position, 0.0, atol=1e-9)
        assert watched.value("planner/status", "state") == "idle", "opening it moves nothing"

        # The gizmo is dragged along the vertical axis, and the goal is checked anew.
        robot = load_robot(ROOT / "urdf" / "sliding_masses.urdf")
        reach = reach_of(robot)
        tip, to = (np.array([0.0, 0.0, z * reach]) for z in (0.178, 0.238))
        view = view_beside_panel(np.zeros(3), reach * CAMERA, 1.0)
        page.drag(page.pixel(tip, *view), page.pixel(to, *view))
        x, y, z = page.numbers(POSITION)
        assert (x, y) == (0.0, 0.0)
        assert z == pytest.approx(0.06 * reach, rel=0.2)
        page.wait_for_text("Goal reachable", "by 'optimal'", without="in 0 s")
        page.press("Fly")
        watched.wait("planner/status", "state", "reached")
        watched.hear()
        np.testing.assert_allclose(watched.position, [0, 0, z], atol=0.02)
        page.wait_for_text("reached")

        # A goal that no robot of these strokes reaches is red, and is refused when it is sent.
        page.type(POSITION, (9, 0, 0))
        page.wait_for_text("Goal refused")
        page.press("Fly")
        watched.wait("planner/status", "state", "refused")

        # A flight is aborted.
        page.type(POSITION, (0.3, -0.25, 0.1))
        page.wait_for_text("Goal reachable")
        page.press("Fly")
        watched.wait("planner/status", "state", "executing")
        page.press("Abort goal")
        watched.wait("planner/status", "state", "aborted")
        page.wait_for_text("aborted")
        watched.hear()
        stopped = watched.position
        assert np.linalg.norm(stopped - [0.3, -0.25, 0.1]) > 0.05

        # A fault is injected, seen and cleared.
        page.press("Faults")
        page.wait_for_text("No fault is active.")
        page.press("Inject")
        page.wait_for_text("joint_stuck", "for good")
        harness.spin_until(
            lambda: "joint_stuck" in watched.value("plant/status", "faults"), "a fault is active"
        )
        page.wait_for_text("joint_stuck slider", without="No fault is active.")
        page.press("Clear faults")
        page.wait_for_text("No fault is active.")
        watched.wait("plant/status", "faults", "")

        # The planner dies and comes again; the page goes on.
        nodes.kill("planner")
        page.wait_for_text("Node '/planner' has been silent")
        nodes.start("planner", *PLANNER, files=FILE)
        page.wait_for_text("Waiting for a goal pose.", without="has been silent")
        page.press("Goal")
        page.type(POSITION, (0, 0, 0))
        page.wait_for_text("Goal reachable")
        page.press("Fly")
        watched.wait("planner/status", "state", "reached")
        watched.hear()
        np.testing.assert_allclose(watched.position, 0.0, atol=0.02)

        # The next goal is reached in the joint positions that are asked for.
        page.tick("Final joint positions")
        page.wait_for_text("At the end")
        page.type("slider_1 (m)", (0.1,))
        # The centre of mass stays: the base moves by the part of the slider's mass.
        bodies = {body.name: body.inertia.mass for body in robot.bodies}
        x = round(-0.1 * bodies["mass_1"] / robot.total_mass, 4)
        page.type(POSITION, (x, 0, 0))
        page.wait_for_text("Goal reachable", "by 'optimal'", without="in 0 s")
        page.press("Fly")
        watched.wait("planner/status", "state", "executing")
        watched.wait("planner/status", "state", "reached")
        watched.hear()
        np.testing.assert_allclose(watched.joints, [0.1, 0, 0], atol=5e-3)

        assert page.frames_per_s(3.0) > 1.0
        assert window.complaints == []
        assert page.requests_outside() == []
    assert "Traceback" not in nodes.log("viewer")


def test_a_page_that_is_closed_in_the_middle_of_a_drag_leaves_a_goal_and_no_harm(
    harness: Harness, nodes: Processes, tmp_path: Path
) -> None:
    url = nodes.start_viewer()
    nodes.start("plant", *PLANT, files=FILE)
    nodes.start("planner", *PLANNER, files=FILE)
    watched = Watched(harness)
    reach = reach_of(load_robot(ROOT / "urdf" / "sliding_masses.urdf"))
    view = view_beside_panel(np.zeros(3), reach * CAMERA, 1.0)
    with browser(tmp_path / "first") as window:
        page = Page(window, url)
        page.wait_for_text("Goal reachable")
        tip, to = (np.array([0.0, 0.0, z * reach]) for z in (0.178, 0.238))
        page.drag(page.pixel(tip, *view), page.pixel(to, *view), release=False)
        moved = page.numbers(POSITION)
        assert moved[2] > 0.0
    with browser(tmp_path / "second") as window:
        page = Page(window, url)
        page.wait_for_text("Goal reachable")
        x, y, z = page.numbers(POSITION)
        assert (x, y) == (0.0, 0.0)
        # The last steps of the mouse may have come after the fields were read.
        assert moved[2] <= z <= 0.06 * reach * 1.2
        watched.hear()
        assert watched.value("planner/status", "state") == "idle"
        page.press("Goal to the robot")
        page.wait_for_text("Goal reachable", "Reachable in 0 s")
        assert window.complaints == []


def test_an_end_effector_is_sent_to_a_place_from_the_page(
    harness: Harness, nodes: Processes, tmp_path: Path
) -> None:
    arm = ("--params-file", str(ROOT / "config" / "reach.yaml"))
    url = nodes.start_viewer()
    nodes.start("plant", *PLANT, files=arm)
    nodes.start("planner", *PLANNER, files=arm)
    watched = Watched(harness)
    pose = harness.probe({"link_7/pose": PoseStamped}, name="hand")

    def place() -> Array:
        p = pose.last("link_7/pose").pose.position
        return np.array([p.x, p.y, p.z])

    with browser(tmp_path / "profile") as window:
        page = Page(window, url)
        page.wait_for_text("Goal reachable", "link_7")
        harness.spin_until(lambda: pose.count("link_7/pose") > 0, "the pose of the hand")
        page.choose("link_7", "position")
        page.wait_for_text("Goal reachable", "Reachable in 0 s")
        np.testing.assert_allclose(page.numbers(POSITION), place(), atol=6e-3)
        goal = np.add(place(), [-0.15, 0.1, 0.05]).round(2)
        page.type(POSITION, goal.tolist())
        page.wait_for_text("Goal reachable", "by 'optimal'", without="in 0 s")
        page.press("Fly")
        page.wait_for_text("link_7 is", "m from its goal")
        watched.wait("planner/status", "state", "reached")
        assert watched.value("planner/status", "goal") == "", "the base is free"
        watched.hear()
        np.testing.assert_allclose(place(), goal, atol=5e-3)
        page.type(POSITION, (9, 0, 0))
        page.wait_for_text("Goal refused")
        assert window.complaints == []
    assert "Traceback" not in nodes.log("viewer")
