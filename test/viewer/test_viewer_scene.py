"""What is drawn: links where Pinocchio has them, lines, plumes, layers, cameras and plots."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.page_elements import Element, Server
from support.random_robots import random_chain_urdf
from support.urdf_text import without_collisions
from support.viewer_page import FIELD_OF_VIEW

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.collision.distances import collision_visuals
from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.model import load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.model.urdf import parse_robot, parse_world, with_world
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Tolerance
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.viewer import content, scene
from spacerobot_ros.viewer.content import GoalErrors
from spacerobot_ros.viewer.page import CAMERA, Page, Plots, view_beside_panel
from spacerobot_ros.viewer.server import ViewerConfig
from spacerobot_ros.viewer.state import Firing, Measured, Momenta, Notice, StackState


@pytest.fixture
def server() -> Any:
    return Server()


def solids(server: Any) -> list[Element]:
    return [each for each in server.scene.elements if each.kind == "add_mesh_simple"]


def texts(server: Any) -> list[Element]:
    return [each for each in server.gui.elements if each.kind == "add_html"]


def paths_in(server: Any) -> list[str]:
    return [each.name for each in server.scene.elements]


def pose_of(server: Any, name: str) -> Array:
    """Return the pose (4, 4) in the world of a node, from those of all above it."""
    pose, parts = np.eye(4), name.strip("/").split("/")
    for depth in range(1, len(parts) + 1):
        handle = server.scene.named("/" + "/".join(parts[:depth]))
        local = np.eye(4)
        local[:3, :3] = matrix_from_quaternion(scene.xyzw(handle.wxyz))
        local[:3, 3] = handle.position
        pose = pose @ local
    return pose


@pytest.mark.parametrize("name", ["servicer", "sliding_masses", "surveyor"])
def test_links_are_drawn_where_pinocchio_has_them(server: Any, name: str) -> None:
    robot = load_robot(robot_file(name))
    said: list[str] = []
    drawing = scene.RobotDrawing(server.scene, "/robot", robot, on_note=said.append)
    rng = np.random.default_rng(3)
    turned = Rotation.from_rotvec(rng.normal(size=3))
    pose = np.concatenate([rng.normal(size=3), turned.as_quat()])
    q = rng.uniform(-0.5, 0.5, len(robot.joint_names))
    oracle = PinocchioOracle(robot.urdf, robot.joint_names)
    drawing.place(pose)
    drawing.set_joint_positions(q)
    drawing.show_names(visible=True)
    labels = [each for each in server.scene.elements if each.kind == "add_label"]
    paths = {each.text: each.name.removesuffix("/name") for each in labels}
    for link in robot.links:
        drawn, (R, r) = pose_of(server, paths[link.name]), oracle.link_pose(link.name, q, pose)
        np.testing.assert_allclose(drawn[:3], np.column_stack([R, r]), atol=1e-6)
    assert len(solids(server)) == sum(len(link.shapes) for link in robot.links)
    assert said == []
    drawing.paint((1, 2, 3))
    assert {solid.color for solid in solids(server)} == {(1, 2, 3)}


def test_a_mesh_that_is_not_there_is_said_and_the_rest_is_drawn(server: Any) -> None:
    robot = load_robot(robot_file("servicer"))
    lost = '<visual><geometry><mesh filename="package://none/lost.stl"/></geometry></visual>'
    text = robot.urdf.replace("<visual>", f"{lost}<visual>", 1)
    said: list[str] = []
    scene.RobotDrawing(server.scene, "/robot", parse_robot(text), on_note=said.append)
    assert len(said) == 1
    assert "lost.stl" in said[0]
    assert len(solids(server)) == sum(len(link.shapes) for link in robot.links)


def test_a_robot_without_shapes_is_seen(server: Any) -> None:
    robot = parse_robot(
        '<robot name="bare"><link name="a"><inertial><mass value="1"/><inertia ixx="1" iyy="1" '
        'izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link><link name="b"/><joint name="j" '
        'type="fixed"><parent link="a"/><child link="b"/><origin xyz="1 2 2"/></joint></robot>'
    )
    scene.RobotDrawing(server.scene, "/robot", robot)
    assert len(solids(server)) == 3, "two balls and the bar between them"
    assert scene.reach_of(robot) == pytest.approx(3.0)


def test_a_line_connects_the_points_that_it_is_given(server: Any) -> None:
    line = scene.Lines(server.scene, "/path", (1, 2, 3))
    points = np.cumsum(np.random.default_rng(1).normal(size=(100, 3)), axis=0)
    for count in (0, 1, 2, 3, 33, 34, 70, 100, 5, 1, 2):
        line.draw(points[:count])
        handle = server.scene.named("/path")
        assert handle.visible == (count >= 2)
        if count >= 2:
            assert handle.colors == (1, 2, 3), "one for all segments"
            np.testing.assert_allclose(handle.points[:, 0], points[: count - 1], atol=1e-5)
            np.testing.assert_allclose(handle.points[:, 1], points[1:count], atol=1e-5)


def test_a_robot_far_from_the_origin_is_looked_at_and_has_a_grid_below(server: Any) -> None:
    page = Page(server, ViewerConfig())
    robot = load_robot(robot_file("sliding_masses"))
    page.show_robot(robot)
    reach, zeros = scene.reach_of(robot), np.zeros(3)
    at, onward = np.array([1234.5, -67.0, 89.0]), np.array([50.0, 0.0, 0.0])
    first = Measured(0.0, np.concatenate([at, [0.0, 0.0, 0.0, 1.0]]), zeros, zeros, zeros)
    page.update(StackState(first, age_s=0.0), 1.0)
    position, look_at = view_beside_panel(at, reach * CAMERA, 1.6)
    np.testing.assert_allclose(server.initial_camera.look_at, look_at)
    np.testing.assert_allclose(server.initial_camera.position, position)
    grid = server.scene.named("/grid")
    assert np.abs(grid.position[:2] - at[:2]).max() < grid.width / 4
    np.testing.assert_allclose(np.remainder(grid.position[:2], grid.section_size), 0.0, atol=1e-9)
    assert at[2] - 2 * reach < grid.position[2] < at[2]
    # It goes on, and a user looks for it: only that camera is moved.
    later = replace(first, time_s=9.0, pose=first.pose + np.append(onward, np.zeros(4)))
    page.update(StackState(later, age_s=0.0), 2.0)
    np.testing.assert_allclose(server.initial_camera.look_at, look_at)
    server.gui.named("Look at the robot").use(server)
    page.update(StackState(later, age_s=0.0), 3.0)
    np.testing.assert_allclose(server.camera.look_at, look_at + onward)
    np.testing.assert_allclose(server.initial_camera.look_at, look_at)


def still(time_s: float, joints: int = 3, **more: Any) -> StackState:
    """Return a state of a robot that rests at the origin."""
    return StackState(Measured(time_s, np.eye(7)[6], *np.zeros((3, joints))), **more)


def test_curves_of_many_joints_differ(server: Any) -> None:
    robot = parse_robot(random_chain_urdf(np.random.default_rng(1), 30))
    Plots(server.gui).show_robot(robot)
    looks = {(each["stroke"], each.get("dash")) for each in server.gui.named("Joints").series[1:-1]}
    assert len(looks) == 30


def test_rounding_is_no_peak_and_numbers_of_a_flight_are_seen(server: Any) -> None:
    plots = Plots(server.gui)
    plots.show_robot(load_robot(robot_file("sliding_masses")))
    actual = np.array([1.0, 0.0, 0.0, 0.0, 2.0, 0.0])
    off = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    for time_s, size in ((0.0, 0.0), (1.0, 2e-16), (2.0, 3e-6)):
        plots.add(still(time_s, momenta=Momenta(actual + size * off, actual)), {})
    plots.draw()
    handle = server.gui.named("Momentum drift")
    assert [series["label"] for series in handle.series[1:]] == [
        "1e-6 kg m/s",
        "1e-6 kg m²/s",
        "shown",
    ]
    np.testing.assert_allclose(handle.data[1], [0.0, 0.0, 3.0], atol=1e-8)
    np.testing.assert_allclose(handle.data[2], [0.0, 0.0, 6.0], atol=1e-8)
    # The axis goes to 1 where everything is less, and from below zero where numbers have signs.
    ends = handle.scales["1e-6 kg m/s"]["range"]
    assert (ends["min"]["soft"], ends["max"]["soft"]) == (0.0, 1.0)
    ends = server.gui.named("Joints").scales["m"]["range"]
    assert (ends["min"]["soft"], ends["max"]["soft"]) == (-0.01, 0.01)


def test_the_momentum_budget_is_plotted_while_a_controller_reports_it(server: Any) -> None:
    plots = Plots(server.gui)
    robot = load_robot(robot_file("sliding_masses"))
    plots.show_robot(robot)
    handle = server.gui.named("Momentum budget (N m s)")
    assert not handle.visible
    parts = {"base": 0.5, "arm": 0.25, "wheels": 2.0, "sum": 1.75}
    command = CommandReport("model_based", False, 1.0, 0.0, 0.0, 0.0, 0.0, momentum=parts)
    status = ControllerStatus(ControllerState.TRACKING, command=command)
    for time_s, controller in ((1.0, None), (2.0, status)):
        state = still(time_s, controller=controller)
        plots.add(state, {})
        plots.show_budget(state)
        assert handle.visible is (controller is not None)
        said = any("2.000 N m s" in each.content for each in texts(server))
        assert said is (controller is not None)
    plots.draw()
    assert [series["label"] for series in handle.series[1:]] == [*parts, "shown"]
    assert [column.tolist() for column in handle.data[:-1]] == [[2.0], [0.5], [0.25], [2.0], [1.75]]
    plots.show_robot(robot)
    assert not handle.visible


def test_momenta_are_compared_with_what_they_should_be(server: Any) -> None:
    plots, actual = Plots(server.gui), np.arange(6.0)
    plots.show_robot(load_robot(robot_file("sliding_masses")))
    pushed = Momenta(actual, actual - [0, 0, 2, 0, 3, 0])
    for time_s, momenta in enumerate((Momenta(actual, None), Momenta(2 * actual, None), pushed)):
        plots.add(still(time_s, momenta=momenta), {})
    plots.draw()
    handle = server.gui.named("Momentum drift")
    np.testing.assert_allclose(handle.data[1], [0.0, 1e6 * np.sqrt(5), 2e6])
    np.testing.assert_allclose(handle.data[2], [0.0, 1e6 * np.sqrt(50), 3e6])


def test_each_link_with_a_goal_has_a_plot_of_its_own(server: Any) -> None:
    plots = Plots(server.gui)
    plots.show_robot(load_robot(robot_file("servicer")))
    hand = Goal.of_end_effectors([EndEffectorGoal("hand", np.ones(3))])
    base = Goal.checked(np.ones(3), [0.0, 0.0, 0.0, 1.0])

    def add(time_s: float, goals: dict[str, Goal], **errors: GoalErrors) -> None:
        plots.add(still(time_s, joints=6, goals=goals), errors)
        plots.draw()

    def handles() -> dict[str, Any]:
        every = [each for each in server.gui.elements if each.kind == "add_uplot"]
        every = [each for each in every if each.title.startswith("Error of")]
        return {each.title: each for each in every if each.visible}

    def shown() -> list[str]:
        return list(handles())

    def numbers(part: str) -> list[list[float]]:
        return [column.tolist() for column in handles()[f"Error of {part}"].data]

    add(0.0, {})
    assert shown() == []
    assert [each.visible for each in texts(server) if "No goal is" in each.content] == [True]
    add(1.0, {"hand": hand}, hand=(0.5,))
    assert shown() == ["Error of hand"], "the base is free"
    add(2.0, {"hand": hand}, hand=(0.25,))
    assert numbers("hand")[:2] == [[1.0, 2.0], [500.0, 250.0]], "in mm"
    add(3.0, {"hand": hand, "base": base}, hand=(0.2, 0.7), base=(3.0, 2.0))
    assert shown() == ["Error of hand", "Error of base"]
    assert numbers("hand")[:3] == [[3.0], [200.0], [700.0]]
    # Tolerances, and an upright line at the time that is looked back to.
    plots.draw(Tolerance(0.02, 0.005), 2.5)
    times, _, _, near, turned, line = numbers("base")
    assert (times, near, turned) == ([2.5, 2.5, 2.5, 3.0], [20.0] * 4, [5.0] * 4)
    assert line == [-1.0, 1.0, -1.0, -1.0]
    handle = handles()["Error of base"]
    assert [axis["scale"] for axis in handle.axes[1:]] == ["mm", "mrad"]
    # A logarithmic axis begins at a micrometre.
    server.gui.named("Logarithmic").value = True
    add(4.0, {"base": base}, base=(0.0, 2.0))
    assert handle.scales["mm"] == {"distr": 3}
    assert numbers("base")[1] == [3000.0, 1e-3]
    add(5.0, {"end_effector": base}, end_effector=(0.75, 0.5))
    assert shown() == ["Error of end_effector"], "that of a controller"
    plots.show_robot(None)
    assert shown() == []


def test_plumes_point_against_the_thrust() -> None:
    table = find_thrusters("urdf", load_robot(robot_file("servicer")))
    duty = np.zeros(len(table.names))
    assert scene.plume_lines(table, table.names, duty, 1.0).shape == (0, 2, 3)
    duty[[2, 5]] = 1.0, 0.5
    first, second = scene.plume_lines(table, table.names, duty, 1.0)
    np.testing.assert_allclose(first[0], table.r_B[2])
    np.testing.assert_allclose(first[1] - first[0], -table.direction_B[2])
    assert np.linalg.norm(second[1] - second[0]) < 1.0
    assert scene.plume_lines(table, ("unknown",), np.ones(1), 1.0).shape == (0, 2, 3)


def test_a_target_is_drawn_from_its_first_state_on_and_outlasts_a_new_robot(server: Any) -> None:
    page = Page(server, ViewerConfig())
    page.show_robot(None)
    page.show_target(load_robot(share_directory() / "config" / "targets" / "block.urdf"))
    frame = server.scene.named("/target")
    assert not frame.visible
    page.update(StackState(), 1.0)
    assert not frame.visible
    page.update(StackState(target=np.array([1.0, -2.0, 3.0, 0.5, -0.1, 0.7, 0.5])), 2.0)
    assert frame.visible
    np.testing.assert_allclose(frame.position, [1.0, -2.0, 3.0])
    np.testing.assert_allclose(frame.wxyz, [0.5, 0.5, -0.1, 0.7])
    page.show_robot(load_robot(robot_file("sliding_masses")))
    again = server.scene.named("/target")
    assert again is not frame
    assert not again.visible
    assert "/target/0" in paths_in(server)
    page.show_robot(None)
    assert "/target" not in paths_in(server)
    page.update(StackState(target=np.array([1.0, -2.0, 3.0, 0.0, 0.0, 0.0, 1.0])), 3.0)


def test_other_obstacles_take_the_place_of_those_of_the_robot(server: Any) -> None:
    def world(*names: str) -> Any:
        shape = '<collision><geometry><sphere radius="0.2"/></geometry></collision>'
        links = "".join(f'<link name="{name}">{shape}</link>' for name in names)
        joints = "".join(
            f'<joint name="of_{name}" type="fixed"><parent link="w"/><child link="{name}"/></joint>'
            for name in names
        )
        return parse_world(f'<robot name="w"><link name="w"/>{links}{joints}</robot>')

    def drawn() -> list[bool]:
        return [f"/obstacles/{number}" in paths_in(server) for number in range(3)]

    page, robot = Page(server, ViewerConfig()), load_robot(robot_file("planar_chain"))
    page.show_obstacles(world("a", "b", "c"))
    assert drawn() == [False] * 3
    page.show_robot(with_world(robot, world("d")))
    assert drawn() == [True] * 3
    page.show_obstacles(world("a", "b"))
    assert drawn() == [True, True, False]
    page.show_obstacles(None)
    assert drawn() == [False] * 3
    page.show_robot(with_world(robot, world("d")))
    assert drawn() == [False] * 3
    other = Page(server, ViewerConfig())
    other.show_robot(with_world(robot, world("d")))
    assert drawn() == [True, False, False]


def test_collision_shapes_are_shown_on_request(server: Any) -> None:
    robot = parse_robot(without_collisions(load_robot(robot_file("surveyor")).urdf))
    page = Page(server, ViewerConfig())
    page.show_robot(robot)
    layer = server.gui.named("Collision shapes")
    layer.use(server, True)
    page.update(StackState(), 1.0)
    shapes = [each for each in solids(server) if "/collision" in each.name]
    assert len(shapes) == sum(len(link.collisions or link.shapes) for link in robot.links)
    assert all(each.visible for each in shapes)
    # A mesh is drawn as its convex hull, whose faces point outward: its volume is that of the hull.
    for visual, drawn in zip(collision_visuals(robot), shapes, strict=True):
        a, b, c = (drawn.vertices[drawn.faces[:, k]].astype(float) for k in range(3))
        volume = float(np.einsum("ka,ka->", np.cross(a, b), c)) / 6
        whole = ConvexHull(visual.mesh.vertices).volume
        assert volume == pytest.approx(whole, rel=1e-5), visual.shape.kind
    assert {visual.shape.kind for visual in collision_visuals(robot)} >= {"mesh"}
    layer.use(server, False)
    page.update(StackState(), 2.0)
    assert not any(each.visible for each in shapes)
    # Another robot is drawn with its own.
    layer.use(server, True)
    robot = load_robot(robot_file("three_joint_arm"))
    page.show_robot(robot)
    shapes = [each for each in solids(server) if "/collision" in each.name]
    assert len(shapes) == len(collision_visuals(robot))


def test_obstacles_are_drawn_where_they_rest(server: Any) -> None:
    scene.draw_obstacles(server.scene, "/obstacles", None)
    assert not solids(server)
    world = parse_world(
        '<robot name="w"><link name="w"/><link name="post"><visual>'
        '<origin xyz="0.5 0 0"/><geometry><box size="1 2 3"/></geometry>'
        '<material name="m"><color rgba="0.2 0.4 1 1"/></material></visual></link>'
        '<joint name="j" type="fixed"><parent link="w"/><child link="post"/>'
        '<origin xyz="1 -2 4" rpy="0 0 1.5707963267948966"/></joint></robot>'
    )
    scene.draw_obstacles(server.scene, "/obstacles", world)
    (post,) = solids(server)
    assert (post.name, post.color) == ("/obstacles/0", (51, 102, 255))
    np.testing.assert_allclose(post.vertices.min(axis=0), [0.0, -2.0, 2.5], atol=1e-12)
    np.testing.assert_allclose(post.vertices.max(axis=0), [2.0, -1.0, 5.5], atol=1e-12)


# -- layers, settings and cameras -----------------------------------------------------------------


ROBOT = load_robot(robot_file("planar_manipulator"))
REACH = scene.reach_of(ROBOT)
COUNT = len(ROBOT.joint_names)


def measured(time: float, *at: float) -> Measured:
    zeros = np.zeros(COUNT)
    return Measured(time, np.array([*at, 0.0, 0.0, 0.0, 1.0]), zeros + 0.2, zeros, zeros)


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
    ghost = server.scene.named("/goal/ghost")
    assert ghost.visible
    lines = [
        server.scene.named(name)
        for name in ("/planned_path", "/flown_path", "/flown_path_of_end_effector1")
    ]
    np.testing.assert_allclose(lines[2].points[0], [[3.0, 2.0, 1.0], [3.5, 2.0, 1.0]])
    assert [each.visible for each in lines] == [True] * 3
    assert not base.show_axes
    assert not world.visible
    for name, shown in (("Paths", False), ("Frames", True), ("Names", True), ("Ghost", False)):
        server.gui.named(name).use(server, shown)
    page.update(LATER, 2.1)
    assert not ghost.visible
    page.update(replace(LATER, measured=measured(3.0, 1.75, 2.5, -0.5)), 3.0)
    assert [each.visible for each in lines] == [False] * 3
    assert not ghost.visible
    assert base.show_axes
    assert base.axes_length == pytest.approx(0.12 * REACH)
    assert base.axes_radius == pytest.approx(0.0036 * REACH)
    assert world.visible
    labels = [each for each in server.scene.elements if each.kind == "add_label"]
    assert {each.text for each in labels} == {link.name for link in ROBOT.links}
    assert all(each.visible for each in labels)
    for name, shown in (("Paths", True), ("Frames", False), ("Names", False), ("Ghost", True)):
        server.gui.named(name).use(server, shown)
    page.update(LATER, 4.0)
    assert ghost.visible
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
    _, offset = PinocchioOracle(ROBOT.urdf, ROBOT.joint_names).link_pose(link, np.zeros(COUNT))
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


def test_a_browser_that_moves_to_the_initial_camera_late_still_sees_the_robot(
    server: Server, page: Page
) -> None:
    camera = server.camera
    camera.aspect, camera.position = 0.46, np.full(3, 3.0)
    page.update(FIRST, 1.0)
    page.update(LATER, 2.0)
    server.open()
    page.update(LATER, 3.0)
    aimed = camera.position
    camera.position = server.initial_camera.position
    assert np.linalg.norm(camera.position - aimed) > REACH
    camera.tell(camera)
    page.update(LATER, 4.0)
    np.testing.assert_allclose(camera.position, aimed)
    # A user's own view stays.
    camera.position = own = aimed + 0.1
    camera.tell(camera)
    page.update(LATER, 5.0)
    np.testing.assert_allclose(camera.position, own)


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


def test_a_replay_shows_its_goals_and_plumes(server: Any) -> None:
    page = Page(server, ViewerConfig())
    robot = load_robot(robot_file("servicer_wheels"))
    page.show_robot(robot)
    names, q = find_thrusters("urdf", robot).names, np.zeros(len(robot.joint_names))
    at = np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0])
    replayed = StackState(
        Measured(1.0, at, q, q, q),
        firing=Firing(names, np.ones(len(names))),
        age_s=0.0,
        planner=PlannerStatus(PlannerState.EXECUTING, "Flies."),
        replay=ReplayStatus(1.0, 20.0, state="playing", rate=1.0),
    )
    page.update(replayed, 1.0)
    assert server.scene.named("/robot/plumes").visible
    assert not any("/goal" in each.name for each in server.scene.elements)

    to = np.array([4.0, 5.0, 6.0])
    later = replace(replayed, measured=Measured(2.0, at, q, q, q), goals={"base": Goal(to, at[3:])})
    page.update(later, 2.0)
    gizmo, ghost = map(server.scene.named, ("/goal", "/goal/ghost"))
    np.testing.assert_allclose(gizmo.position, to)
    assert gizmo.visible
    assert gizmo.disable_axes
    assert ghost.visible
    # A link that was sent somewhere, which a planner answers with its plan.
    aim = EndEffectorGoal.checked(robot.links[-1].name, [7.0, 8.0, 9.0])
    goals = {aim.link: Goal.of_end_effectors([aim])}
    for time in (3.0, 4.0):
        page.update(replace(later, measured=Measured(time, at, q, q, q), goals=goals), time)
    assert page.editor.shows_sent_goal
    assert not ghost.visible, "the base is free, and nothing is predicted"
    handles = [each for each in server.scene.elements if each.kind == "add_transform_controls"]
    assert [each.visible for each in handles] == [True, False]
    fields = ("Goal (m)", "Roll, pitch, yaw (deg)", "Goal to the robot", "Goal for", "Fly")
    assert not any(server.gui.named(name).visible for name in fields)


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
