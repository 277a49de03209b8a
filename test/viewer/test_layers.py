"""Layers, settings and cameras of the page, and its words about nodes that have ended."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.page_elements import Server
from support.viewer_page import FIELD_OF_VIEW

from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer import content, scene
from spacerobot_ros.viewer.page import CAMERA, Page, view_beside_panel
from spacerobot_ros.viewer.server import ViewerConfig
from spacerobot_ros.viewer.state import Measured, Notice, StackState

ROBOT = load_robot(robot_file("planar_manipulator"))
REACH = scene.reach_of(ROBOT)
COUNT = len(ROBOT.joint_names)


def measured(time: float, *at: float) -> Measured:
    zeros = np.zeros(COUNT)
    return Measured(time, np.array([*at, 0.0, 0.0, 0.0, 1.0]), zeros + 0.2, zeros, zeros)


@pytest.fixture
def server() -> Server:
    return Server()


@pytest.fixture
def page(server: Any) -> Page:
    page = Page(server, ViewerConfig())
    page.show_robot(ROBOT)
    return page


def said(server: Server) -> str:
    """Return the first text of the page, which is that of the state."""
    return next(each.content for each in server.gui.elements if each.kind == "add_html")


FIRST = StackState(
    measured=measured(1.0, 1.0, 2.0, 0.5),
    tool=np.array([3.0, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
    age_s=0.0,
    planned_path=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.5]]),
)
LATER = replace(
    FIRST,
    measured=measured(2.0, 1.5, 2.25, -0.5),
    tool=np.array([3.5, 2.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
)


def test_space_is_the_setting_and_the_grid_an_option(server: Server, page: Page) -> None:
    page.update(FIRST, 1.0)

    def seen() -> dict[str, bool]:
        names = ("/stars", "/sun", "/sunlight", "/skylight", "/grid")
        return {name: server.scene.named(name).visible for name in names}

    space = dict.fromkeys(("/stars", "/sun", "/sunlight", "/skylight"), True) | {"/grid": False}
    assert seen() == space
    assert (server.scene.lights, server.scene.environment) == ({"enabled": False}, None)
    assert server.scene.background.max() < 20, "dark on a light page too"
    assert server.scene.named("/sunlight").cast_shadow
    solids = [each for each in server.scene.elements if each.kind == "add_mesh_simple"]
    shaded = {str(each.name).startswith("/robot"): each.cast_shadow for each in solids}
    assert shaded == {True: True, False: False}, "the ghost has no shadow"
    stars, sun = server.scene.named("/stars"), server.scene.named("/sun")
    for points in (stars.points, sun.points):
        np.testing.assert_allclose(np.linalg.norm(points, axis=1), 40 * REACH, rtol=1e-5)
    np.testing.assert_allclose(stars.position, [1.0, 2.0, 0.5])
    toward = np.array(server.scene.named("/sunlight").position)
    np.testing.assert_allclose(sun.points[0], 40 * REACH * toward, rtol=1e-5)
    server.gui.named("Setting").use(server, "Grid")
    page.update(FIRST, 1.1)
    assert seen() == {name: not shown for name, shown in space.items()}
    assert (server.scene.lights, server.scene.environment) == ({"enabled": True}, "city")
    assert server.scene.background is None
    assert server.gui.themes[0]["dark_mode"] is True


def test_each_layer_is_shown_and_hidden_alone(server: Server, page: Page) -> None:
    page.update(FIRST, 1.0)
    page.update(LATER, 2.0)
    base, world = server.scene.named("/robot"), server.scene.named("/world")
    lines = [
        server.scene.named(name)
        for name in ("/planned_path", "/flown_path", "/flown_path_of_end_effector1")
    ]
    np.testing.assert_allclose(lines[2].points[0], [[3.0, 2.0, 1.0], [3.5, 2.0, 1.0]])
    assert [each.visible for each in lines] == [True] * 3
    assert not base.show_axes
    assert not world.visible
    for name, shown in (("Paths", False), ("Frames", True), ("Names", True)):
        server.gui.named(name).use(server, shown)
    page.update(replace(LATER, measured=measured(3.0, 1.75, 2.5, -0.5)), 3.0)
    assert [each.visible for each in lines] == [False] * 3
    assert base.show_axes
    assert base.axes_length == pytest.approx(0.12 * REACH)
    assert base.axes_radius == pytest.approx(0.0036 * REACH)
    assert world.visible
    labels = [each for each in server.scene.elements if each.kind == "add_label"]
    assert {each.text for each in labels} == {link.name for link in ROBOT.links}
    assert all(each.visible for each in labels)
    for name, shown in (("Paths", True), ("Frames", False), ("Names", False)):
        server.gui.named(name).use(server, shown)
    page.update(LATER, 4.0)
    assert [each.visible for each in lines] == [True] * 3
    assert not base.show_axes
    assert not any(each.visible for each in labels)


def test_planned_paths_of_end_effectors_are_drawn(server: Server, page: Page) -> None:
    link = ROBOT.links[-1].name
    aim = EndEffectorGoal.checked(link, [1.0, 0.0, 0.0])
    poses = np.array([[0.0, 0, 0, 0, 0, 0, 1], [1.0, 2, 3, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]])
    motion = np.column_stack([poses, np.zeros((2, COUNT))])
    page.update(
        replace(FIRST, goals={link: Goal.of_end_effectors([aim])}, planned_motion=motion), 1.0
    )
    # At zero the links of this robot lie one behind the other: a chain of offsets.
    offset = np.zeros(3)
    child = {joint.child: joint for joint in ROBOT.joints}
    at = link
    while at in child:
        offset = child[at].origin.R @ offset + child[at].origin.r
        at = child[at].parent
    turned = np.array([1.0 - offset[1], 2.0 + offset[0], 3.0 + offset[2]])
    found = server.scene.named("/planned_path_of_end_effector2")
    np.testing.assert_allclose(found.points[0], [offset, turned], atol=1e-6)
    assert np.linalg.norm(offset) > 0.1
    assert found.visible
    page.update(replace(LATER, planned_motion=None), 2.0)
    assert not server.scene.named("/planned_path_of_end_effector2").visible


# -- the past -------------------------------------------------------------------------------------


def flight(page: Page, times: Array) -> StackState:
    """Have a page draw a robot that moves along x by 1 m/s; return the last state."""
    state = FIRST
    for time in times:
        state = replace(FIRST, measured=measured(time, time, 0.0, 0.0))
        page.update(state, float(time))
    return state


def farthest_flown(server: Server) -> float:
    """Return the largest x of the flown path that is shown, m."""
    # A longer path replaces a shorter one.
    path = [each for each in server.scene.elements if each.shown.get("name") == "/flown_path"][-1]
    return float(np.max(path.points[..., 0]))


def test_a_user_looks_back_at_the_last_five_minutes(server: Server, page: Page) -> None:
    last = flight(page, np.arange(0.0, 400.0, 0.5))
    slider, back = server.gui.named("Look back to (s)"), server.gui.named("Back to the present")
    assert slider.visible
    assert not back.visible
    # The texts are drawn five times a second of wall time: a state before may be shown.
    assert slider.min == pytest.approx(99.5, abs=0.5)
    assert slider.max == slider.value == pytest.approx(399.5, abs=0.5)
    slider.use(server, 250.2)
    page.update(last, 400.0)
    page.update(last, 401.0)
    robot, status = server.scene.named("/robot"), said(server)
    np.testing.assert_allclose(robot.position, [250.0, 0.0, 0.0])
    assert back.visible
    assert "Looking back 149.5 s. The robot is now at t = 399.50 s." in status
    assert "t = 250.00 s" in status
    assert 245.0 < farthest_flown(server) <= 250.0
    # New states change nothing of it; the earliest ones go in time.
    flight(page, np.arange(400.0, 600.0, 0.5))
    page.update(last, 601.0)
    assert robot.position[0] == pytest.approx(299.5, abs=1.0)
    back.use(server)
    page.update(replace(FIRST, measured=measured(600.0, 600.0, 0.0, 0.0)), 602.0)
    assert robot.position[0] == 600.0
    assert "Looking back" not in said(server)
    assert farthest_flown(server) > 595.0


def test_the_end_of_the_past_is_the_present(server: Server, page: Page) -> None:
    last = flight(page, np.arange(0.0, 10.0, 0.25))
    slider = server.gui.named("Look back to (s)")
    slider.use(server, slider.max)
    page.update(replace(last, measured=measured(11.0, 11.0, 0.0, 0.0)), 11.0)
    assert server.scene.named("/robot").position[0] == 11.0
    slider.use(server, 5.0)
    ended = replace(
        last,
        measured=measured(12.0, 12.0, 0.0, 0.0),
        plant=PlantStatus(PlantState.RUNNING, "It flies."),
        absent=frozenset({"plant"}),
        silent={"/plant": 9.0},
    )
    page.update(ended, 12.0)
    page.update(ended, 13.0)
    assert server.scene.named("/robot").position[0] == 5.0
    assert ENDED in said(server)
    page.show_robot(ROBOT)
    page.update(ended, 14.0)
    assert server.scene.named("/robot").position[0] == 12.0, "another robot has no such past"


def test_a_past_of_many_states_is_evenly_thinned() -> None:
    recent: content.RecentItems[int] = content.RecentItems(span_s=300.0, most=600)
    for k in range(20_000):
        recent.add(0.05 * k, k)
    assert recent.span is not None
    first, last = recent.span
    assert last == pytest.approx(0.05 * 19_999)
    assert first == pytest.approx(last - 300.0, abs=1.5)
    steps = np.diff(recent.items) * 0.05
    assert 250 <= len(recent.items) <= 600
    assert steps[:-1].max() < 2.2 * steps[:-1].min()
    assert recent.at(first - 1.0) == recent.items[0]
    assert recent.at(last + 1.0) == 19_999


def test_a_past_that_begins_late_is_thinned_as_one_from_zero() -> None:
    kept = []
    for began in (0.0, 4096.0):
        recent: content.RecentItems[int] = content.RecentItems(span_s=256.0, most=64)
        for k in range(1000):
            recent.add(began + 0.125 * k, k)
        kept.append(list(recent.items))
    assert kept[0] == kept[1]
    assert 32 <= len(kept[0]) <= 64


def test_an_empty_line_stays_hidden_when_its_layer_is_shown(server: Any) -> None:
    line = scene.Lines(server.scene, "/line", (1, 2, 3))
    line.show(visible=True)
    points = np.array([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]])
    line.draw(points)
    handle = server.scene.named("/line")
    line.draw(points[:1])
    line.show(visible=True)
    assert not handle.visible
    line.show(visible=False)
    line.draw(points)
    assert not handle.visible
    line.show(visible=True)
    assert handle.visible


def test_the_ghost_is_a_layer(server: Server, page: Page) -> None:
    page.update(FIRST, 1.0)
    page.update(LATER, 2.0)
    ghost = server.scene.named("/goal/ghost")
    assert ghost.visible
    server.gui.named("Ghost").use(server, False)
    page.update(LATER, 2.1)
    assert not ghost.visible
    page.update(replace(LATER, measured=measured(3.0, 1.75, 2.5, -0.5)), 3.0)
    assert not ghost.visible
    server.gui.named("Ghost").use(server, True)
    page.update(LATER, 4.0)
    assert ghost.visible


@pytest.mark.parametrize(
    ("name", "offset"),
    [("Front", (1.9, 0.0, 0.3)), ("Side", (0.0, 1.9, 0.3)), ("Top", (0.0, 0.01, 1.9))],
)
def test_the_camera_looks_from_a_side(
    name: str, offset: tuple[float, ...], server: Server, page: Page
) -> None:
    page.update(FIRST, 1.0)
    server.gui.named("View from").use(server, name)
    page.update(FIRST, 1.1)
    at = np.array([1.0, 2.0, 0.5])
    position, look_at = view_beside_panel(at, REACH * np.array(offset), 1.6)
    np.testing.assert_allclose(server.camera.look_at, look_at)
    np.testing.assert_allclose(server.camera.position, position)


def test_a_robot_with_thrusters_is_followed_until_a_user_says_otherwise(
    server: Server, page: Page
) -> None:
    follow = server.gui.named("Follow the robot")
    assert not follow.value
    table = find_thrusters("urdf", load_robot(robot_file("jet_cube")))
    page.show_thrusters(table)
    assert follow.value
    follow.use(server, False)
    page.show_thrusters(table)
    assert not follow.value


@pytest.mark.parametrize(("aspect", "phone"), [(0.46, True), (0.8, False), (1.5, False)])
def test_the_panel_does_not_cover_the_robot(
    aspect: float, phone: bool, server: Server, page: Page
) -> None:
    camera = server.camera
    camera.aspect = aspect
    page.update(FIRST, 1.0)
    server.gui.named("Look at the robot").use(server)
    page.update(FIRST, 2.0)
    at, away = np.array([1.0, 2.0, 0.5]), camera.position - camera.look_at
    np.testing.assert_allclose(away, (1.75 if phone else 1.0) * REACH * CAMERA)
    # The panel covers the lower 60 % on a phone, else the right 400 of at least 1200 pixels.
    half = np.tan(0.5 * FIELD_OF_VIEW) * np.linalg.norm(away)
    aside = at - camera.look_at
    right = np.cross([0.0, 0.0, 1.0], away) / np.linalg.norm(np.cross([0.0, 0.0, 1.0], away))
    up = np.cross(away, right) / np.linalg.norm(away)
    seen = np.array([aside @ right, aside @ up]) / half
    np.testing.assert_allclose(seen, [0.0, 0.47] if phone else [-0.42, 0.0], atol=0.02)


# -- nodes that have ended ------------------------------------------------------------------------

FLYING = StackState(
    measured=measured(1.0, 0.0, 0.0, 0.0),
    age_s=0.1,
    plant=PlantStatus(PlantState.RUNNING, "It flies."),
    planner=PlannerStatus(PlannerState.EXECUTING, "Flies."),
)
GREEN, ENDED = "#2a9d5c", "The stack has ended"


@pytest.mark.parametrize(
    ("absent", "silent", "ended", "greens"),
    [
        ((), (), False, 2),
        (("planner",), ("/planner",), False, 1),
        (("plant", "planner"), ("/plant", "/planner"), True, 0),
        (("plant", "planner"), (), False, 0),
    ],
)
def test_nodes_that_have_ended_are_never_green(
    absent: tuple[str, ...], silent: tuple[str, ...], ended: bool, greens: int
) -> None:
    state = replace(FLYING, absent=frozenset(absent), silent=dict.fromkeys(silent, 3.0))
    head = content.status_html(state)
    assert (ENDED in head) is content.has_stack_ended(state) is ended
    assert head.count(GREEN) == greens
    assert ("offline, last executing:" in head) is ("planner" in absent)


def test_news_stay_ten_seconds_or_until_the_stack_has_ended(server: Server, page: Page) -> None:
    again = Notice("Node 'planner' was ended by SIGKILL. It is restarted.", 1)
    page.update(FLYING, 1.0)
    page.announce(again)
    page.update(FLYING, 9.0)
    assert "It is restarted." in said(server)
    page.update(FLYING, 11.5)
    assert "It is restarted." not in said(server)
    page.announce(again)
    page.update(FLYING, 12.0)
    assert "It is restarted." in said(server)
    ended = replace(
        FLYING, absent=frozenset({"plant", "planner"}), silent={"/plant": 3.0, "/planner": 3.0}
    )
    page.update(ended, 13.0)
    assert ENDED in said(server)
    assert "It is restarted." not in said(server)


def test_what_a_node_publishes_and_logs_is_one_line_with_its_time(
    server: Server, page: Page
) -> None:
    page.update(FLYING, 1.0)
    assert FLYING.measured is not None
    time_s = FLYING.measured.time_s
    page.note(Notice("The plan is late.", 1, time_s, "/planner"))
    page.note(Notice("No command.", 1, None, "plant"))
    page.note(Notice("The plan is late.", 1, None, "planner"))
    page.update(FLYING, 2.0)
    log = next(
        str(each.content) for each in server.gui.elements if "No command." in str(each.shown)
    )
    assert log.count("The plan is late.") == 1
    assert log.count(f"{time_s:.2f} s") == 2
    page.note(Notice("The plan is late.", 1, time_s + 5.0, "/planner"))
    page.update(FLYING, 3.0)
    log = next(
        str(each.content) for each in server.gui.elements if "No command." in str(each.shown)
    )
    assert log.count("The plan is late.") == 2


def test_nothing_has_ended_where_nothing_has_begun() -> None:
    assert not content.has_stack_ended(StackState(silent={"/recorder": 3.0}))


def test_a_viewer_that_ends_says_so_on_its_page(server: Server, page: Page) -> None:
    page.update(FLYING, 1.0)
    page.end()
    status = next(each for each in server.gui.elements if "cannot steer" in str(each.shown))
    assert "The viewer has ended." in status.content
    assert "It flies." not in status.content
    assert server.flushed


def test_a_controller_has_the_distances_of_base_and_end_effector() -> None:
    goal = Goal.checked([0.0, 3.0, 4.0], [0.0, 0.0, 0.0, 1.0])
    state = replace(
        FLYING,
        planner=None,
        controller=ControllerStatus(ControllerState.TRACKING, "Tracks."),
        goals={"base": goal},
    )
    errors = {"base": (5.0, 0.0)}
    assert "base is 5 m and 0 rad from its goal." in content.status_html(state, errors)
    due = replace(state, controller=ControllerStatus(ControllerState.TRACKING, ends_at_s=4.25))
    assert content.time_to_go(due) == 3.25
    head = content.status_html(due, errors)
    assert "base is 5 m and 0 rad from its goal, 3.2 s to go." in head
    # An approach comes before the goal, from which the robot may then move away.
    approach = replace(due, controller=ControllerStatus(ControllerState.TRACKING, task="approach"))
    kinematics = ForwardKinematics(ROBOT)
    assert set(content.goal_errors(due, kinematics)) == {"base"}
    assert content.goal_errors(approach, kinematics) == {}
    assert "pursued once the task &#x27;approach&#x27; has ended." in content.status_html(approach)
    gone = replace(due, absent=frozenset({"controller"}))
    assert "to go" not in content.status_html(gone, errors)
    assert content.progress(due) is None
    assert "from its goal" not in content.status_html(state)


def test_end_effectors_with_paths_are_that_of_the_plant_and_those_with_goals() -> None:
    kinematics = ForwardKinematics(ROBOT)
    link = ROBOT.links[1].name
    aims = [EndEffectorGoal.checked(each, [1.0, 0.0, 0.0]) for each in (link, "no_such_link")]
    goals = {aim.link: Goal.of_end_effectors([aim]) for aim in aims}
    state = replace(FIRST, goals=goals)
    found = content.end_effector_positions(state, kinematics)
    assert set(found) == {"end_effector", link}
    np.testing.assert_allclose(found["end_effector"], [3.0, 2.0, 1.0])
    now = state.measured
    assert now is not None
    expected = kinematics.link_in_world(link, now.pose, now.q)[:3]
    np.testing.assert_allclose(found[link], expected)
    assert content.end_effector_positions(StackState(goals=goals), kinematics) == {}
