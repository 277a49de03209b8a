"""Links with goals, obstacles, and several robots in reports."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation
from support.command_line import spacerobot
from support.flight_bags import TICK, Story, cyclic_shapes, rates_of, tell, urdf_of
from support.html_page import present
from support.made_bags import joint_states, made_bag, odometry
from support.made_bags import pose as pose_at
from support.oracles import PinocchioOracle
from support.sentences import assert_one_sentence

from spacerobot_ros.collision.distances import obstacle_visuals
from spacerobot_ros.errors import MeshError
from spacerobot_ros.flight import series
from spacerobot_ros.flight.series import SentGoal, Signal, goal_at_end, reported_goal
from spacerobot_ros.model.description import Array, Shape
from spacerobot_ros.model.meshes import TriangleMesh
from spacerobot_ros.model.rotations import quaternion_from_rotvec, rotvec_from_quaternion
from spacerobot_ros.model.urdf import parse_world
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import POSE
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.report.figures import ReportFigure, TraceGroup, log_range
from spacerobot_ros.report.figures_over_time import link_errors_figure
from spacerobot_ros.report.figures_space import configurations_figure, loops_figure, path_figure
from spacerobot_ros.report.flight import Cycles, FlightReport, find_cycles, read_report
from spacerobot_ros.report.page_parts import PagePart
from spacerobot_ros.report.player import WORLD, view_of_flight
from spacerobot_ros.report.scene import (
    Canvas,
    PlacedSolid,
    View,
    corner_points,
    obstacles_of,
    placed_solids,
)
from spacerobot_ros.report.tables import headline, result_table
from spacerobot_ros.report.writing import charts_of, page

BAGS = Path(__file__).parents[2] / "bags"
LEFT, RIGHT = "left_link_7", "right_link_7"
TURNED = (0.5, -0.1, 0.7, 0.5)


@pytest.fixture(scope="module")
def hands() -> FlightReport:
    return read_report(BAGS / "two_hands.mcap")


@pytest.fixture(scope="module")
def strut() -> FlightReport:
    return read_report(BAGS / "strut.mcap")


def other(report: FlightReport, **known: Any) -> FlightReport:
    """Return a report with some of its parts in place of those of its bag."""
    made = replace(report)
    made.__dict__.update(known)
    return made


def poses_by_pinocchio(report: FlightReport, link: str) -> tuple[Array, Array]:
    """Return R_WL (N, 3, 3) and r_WL (N, 3) of a link at the recorded states."""
    oracle = PinocchioOracle(report.required_robot().urdf, report.joint_names)
    states = zip(report.q, report.pose, strict=True)
    R, r = zip(*(oracle.link_pose(link, q, pose) for q, pose in states), strict=True)
    return np.array(R), np.array(r)


def test_errors_of_links_are_those_of_their_true_poses(hands: FlightReport) -> None:
    assert list(hands.link_errors) == [LEFT, RIGHT]
    for link, errors in hands.link_errors.items():
        R, r = poses_by_pinocchio(hands, link)
        goal = hands.link_goals[link]
        off = np.linalg.norm(r - goal.position, axis=1)
        np.testing.assert_array_equal(errors[0].time, hands.time)
        np.testing.assert_allclose(errors[0].values[:, 0], off, atol=1e-12)
        np.testing.assert_allclose(hands.link_poses[link].values[:, :3], r, atol=1e-12)
        if goal.quaternion is None:
            assert not len(errors[1])
            continue
        wanted = Rotation.from_quat(goal.quaternion).as_matrix()
        turned = (Rotation.from_matrix(wanted).inv() * Rotation.from_matrix(R)).magnitude()
        np.testing.assert_allclose(errors[1].values[:, 0], turned, atol=1e-8)
    assert hands.link_errors[LEFT][0].values[0, 0] > 0.3
    assert hands.link_errors[LEFT][1].values[0, 0] > 0.3


def flying(links: dict[str, tuple[float, ...]], goal_id: str = "") -> PlannerStatus:
    return PlannerStatus(PlannerState.EXECUTING, goal_id=goal_id, end_effector_goals=links)


def test_each_goal_counts_until_the_next(hands: FlightReport) -> None:
    left = np.array([1.0, -2.0, 3.0])
    base = SentGoal(0.4, Goal.checked([5.0, 6.0, 7.0], TURNED), "1.5")
    flown = [
        (0.0, flying({LEFT: (1.0, -2.0, 3.0), RIGHT: (1.0, -2.0, 4.0)})),
        (0.4, flying({}, "1.5")),
        (0.7, flying({LEFT: (0.0, 0.0, 0.0)}, "1.5")),
    ]
    report = other(replace(hands, goals=(base,)), reports=flown)
    spans = [(span.start, span.end, span.goal.position[1]) for span in report.targets]
    assert spans == [(0.4, 0.7, 6.0), (0.7, 1.35, 6.0)], "goals of the base"
    errors, time = report.link_errors, hands.time
    early, late = time <= 0.4, time >= 0.7
    np.testing.assert_allclose(errors[RIGHT][0].time, time[early])
    np.testing.assert_allclose(errors[LEFT][0].time, [*time[early], *time[late]])
    _, r = poses_by_pinocchio(hands, LEFT)
    off = [*np.linalg.norm(r[early] - left, axis=1), *np.linalg.norm(r[late], axis=1)]
    np.testing.assert_allclose(errors[LEFT][0].values[:, 0], off, atol=1e-12)
    for none in ([(0.0, flying({"nobody": (1.0, 2.0, 3.0)}))], []):
        assert other(hands, reports=none).link_errors == {}


def rows_of(report: FlightReport) -> dict[str, str]:
    return {row[0]: row[1] for row in result_table(report).rows}


def test_the_tables_have_goal_and_errors_of_each_link(hands: FlightReport) -> None:
    rows = rows_of(hands)
    assert rows["Goal of the base"] == "not controlled"
    assert not any(name.startswith(("Goal position", "Position error of the")) for name in rows)
    assert rows[f"Goal of {RIGHT}"] == "(1.10000, -0.80000, 0.30000) m, any attitude"
    attitude = "rotation vector (0.00000, 0.78540, 0.00000) rad, 45.000° in total"
    assert rows[f"Goal of {LEFT}"] == f"(1.00000, 0.90000, 0.40000) m, {attitude}"
    assert rows[f"Final position of {LEFT}"] == "(1.00000, 0.90000, 0.40000) m"
    tiles = {label: (value, note) for label, value, note in headline(hands)}
    assert tiles[f"Error of {LEFT}"][0] == "< 1 µm"
    assert tiles[f"Error of {LEFT}"][1].endswith(" µrad; tolerance 1 mm, 1 mrad")
    assert tiles[f"Error of {RIGHT}"][1] == "tolerance 1 mm"
    assert "no goal pose" not in page(hands, PagePart(), [])
    # A base with a goal beside those of links has rows as ever.
    rows = rows_of(replace(hands, goal=replace(hands.goal, base=POSE)))  # type: ignore[type-var]
    assert "Goal of the base" not in rows
    assert rows["Goal position"] == "(0.00000, 0.00000, 0.00000) m"


def test_the_figure_has_a_panel_for_each_error_with_the_tolerance(hands: FlightReport) -> None:
    figure = present(link_errors_figure(hands))
    assert [(each.label, each.unit) for each in figure.groups] == [
        (f"distance of {LEFT}", "m"), (f"angle of {LEFT}", "rad"), (f"distance of {RIGHT}", "m"),
    ]  # fmt: skip
    assert [each.limits for each in figure.groups] == [[(0, 0.001)]] * 3
    assert "the base is not controlled" in figure.caption
    # From 1 m down to a tenth of the tolerance.
    assert [each.decades for each in figure.groups] == [4, 4, 4]
    for group, axes in zip(figure.groups, figure.figure.axes, strict=False):
        assert axes.get_yscale() == "log"
        assert axes.get_ylim() == pytest.approx((1e-4, 1.0))
        assert axes.get_ylabel() == f"{group.label} ({group.unit})"
        heights = [np.asarray(line.get_ydata()) for line in axes.lines]
        assert any(np.all(each == 0.001) for each in heights), "the tolerance"
    path = present(path_figure(hands))
    assert "of links with goals" in path.caption


def test_flights_without_goals_of_links_have_no_figure_of_them(strut: FlightReport) -> None:
    assert strut.link_goals == {}
    assert link_errors_figure(strut) is None


def test_a_bag_without_states_says_why_there_are_no_errors(hands: FlightReport) -> None:
    blind = replace(hands, series={**hands.series, "pose": hands.signal("pose").between(9.0, 10.0)})
    sentence = link_errors_figure(blind)
    assert isinstance(sentence, str)
    assert sentence.startswith("The bag contains no base poses (odom)")


def test_a_logarithmic_axis_ends_at_the_power_of_ten_above_the_largest_value() -> None:
    assert log_range(np.array([[0.02], [np.nan], [3.0]]), 2) == pytest.approx((0.1, 10.0))
    assert log_range(np.zeros((2, 1)), 3) == pytest.approx((1e-18, 1e-15))


def test_charts_have_limits_on_logarithmic_axes_where_these_have_them(hands: FlightReport) -> None:
    signal = hands.link_errors[LEFT][0]
    group = TraceGroup(
        signal, ["d"], "distance", "m", ["#000000"], limits=[(0, 0.01), (0, 1e-5)], decades=4
    )
    linear = replace(group, decades=0, limits=[(0, 0.01), (0, 99.0)])
    figure = ReportFigure("errors", "Errors", "Errors.", Figure(), [group, linear])
    first, second = charts_of(hands, [figure]).data["charts"]["charts"]
    assert first["limits"] == [[0, pytest.approx(-2.0)]]
    assert second["limits"] == [[0, 0.01]]


def test_a_status_names_goals_of_links_and_of_the_base() -> None:
    pose = (1.0, 2.0, 3.0, *TURNED)
    base = Goal.checked(pose[:3], TURNED)
    sent = [SentGoal(0.5, base, "1.5")]

    def status(state: PlannerState = PlannerState.EXECUTING, **said: Any) -> PlannerStatus:
        return PlannerStatus(state, **said)

    links = {LEFT: (4.0, 5.0, 6.0), RIGHT: pose}
    free = present(reported_goal(status(end_effector_goals=links), sent))
    assert free.base == frozenset()
    assert [(each.link, each.values) for each in free.end_effectors] == [
        (LEFT, (4.0, 5.0, 6.0)), (RIGHT, pytest.approx(pose)),
    ]  # fmt: skip
    both = present(reported_goal(status(goal_id="1.5", end_effector_goals=links), sent))
    assert both.base == POSE
    assert both.end_effectors[0].link == LEFT
    assert reported_goal(status(goal_id="1.5"), sent) is base
    assert reported_goal(status(end_effector_goals={LEFT: (1.0,)}), sent) is None
    # A goal that was refused counts where no other was flown or sent.
    refused = status(PlannerState.REFUSED, end_effector_goals=links)
    last = present(goal_at_end([refused, status(PlannerState.IDLE)], []))
    assert len(last.end_effectors) == 2
    assert goal_at_end([refused], sent) is base
    assert goal_at_end([status(PlannerState.IDLE)], []) is None


def test_obstacles_stand_in_the_3d_view_where_the_world_has_them(strut: FlightReport) -> None:
    scene = present(view_of_flight(strut))
    path = f"{WORLD}/obstacle 0 strut"
    (placed,) = [c for c in scene.commands if c["type"] == "set_transform" and c["path"] == path]
    matrix = np.reshape(placed["matrix"], (4, 4)).T
    np.testing.assert_allclose(matrix[:3, 3], [1.6, 0.1, 0.0])
    turned = Rotation.from_euler("xyz", [1.2, 0.3, 0.1]).as_matrix()
    np.testing.assert_allclose(matrix[:3, :3], turned, atol=1e-8)
    (drawn,) = [c for c in scene.commands if c.get("path") == f"{path}/0/solid" and "object" in c]
    (cylinder,) = drawn["object"]["geometries"]
    corners = np.reshape(cylinder["data"]["attributes"]["position"]["array"], (-1, 3))
    np.testing.assert_allclose(np.ptp(corners, axis=0), [0.12, 0.12, 0.8], atol=1e-5)
    assert drawn["object"]["materials"][0]["color"] == 0x9999A6, "the color of its shape"
    assert "obstacles have the geometry used to measure distances" in scene.caption


def test_a_flight_without_obstacles_says_nothing_of_them(hands: FlightReport) -> None:
    scene = present(view_of_flight(hands))
    assert "obstacle" not in scene.caption
    assert not any("/obstacle" in command.get("path", "") for command in scene.commands)
    # The goals of links have marks, and axes where the attitude counts.
    marks = {f"{WORLD}/goal of {link}": link for link in (LEFT, RIGHT)}
    placed = {c["path"]: c["matrix"] for c in scene.commands if c["type"] == "set_transform"}
    for path, link in marks.items():
        assert placed[path][12:15] == pytest.approx(hands.link_goals[link].position)
    drawn = {command.get("path") for command in scene.commands}
    assert f"{WORLD}/goal of {LEFT}/x" in drawn
    assert f"{WORLD}/goal of {RIGHT}/x" not in drawn
    # The plant names the left hand its end-effector, whose path has a name of its own.
    assert f"{WORLD}/path of the end-effector" in drawn
    assert f"{WORLD}/path of {RIGHT}" in drawn
    assert f"{WORLD}/path of {LEFT}" not in drawn
    assert "of the end-effectors (pink)" in scene.caption


def test_pictures_of_configurations_have_the_obstacles(strut: FlightReport) -> None:
    around = placed_solids(obstacles_of(strut), 0)
    np.testing.assert_allclose(corner_points(around).mean(axis=0), [1.6, 0.1, 0.0], atol=1e-9)
    fills = np.array([solid.fill for solid in around])
    np.testing.assert_allclose(fills - [0.6, 0.6, 0.65], 0.0, atol=0.003)
    figure = present(configurations_figure(strut))
    assert "Obstacles are drawn with the geometry used to measure distances." in figure.caption


def test_meshes_of_obstacles_are_those_that_a_bag_carries(strut: FlightReport) -> None:
    world = parse_world(
        '<robot name="w"><link name="w"/><link name="rock"><collision><geometry>'
        '<mesh filename="file:///nowhere/rock.stl"/></geometry></collision></link>'
        '<joint name="j" type="fixed"><origin xyz="1 2 3"/><parent link="w"/><child link="rock"/>'
        "</joint></robot>"
    )
    rock = TriangleMesh(np.vstack([np.zeros(3), np.eye(3)]), np.array([[0, 1, 2]]))
    ((visual, pose),) = obstacle_visuals(world, lambda shape: rock)
    assert visual.link == "rock"
    np.testing.assert_array_equal(pose.r, [1.0, 2.0, 3.0])
    assert len(visual.mesh.faces) == 4, "the hull"

    def lost(shape: Shape) -> TriangleMesh:
        raise MeshError(shape.resource)

    assert obstacle_visuals(world, lost) == ()
    assert obstacle_visuals(None) == ()
    blind = replace(strut, robot=replace(strut.required_robot(), world=world))
    assert blind.obstacles == ()
    assert blind.missing_meshes == " Meshes are not drawn. The bag does not contain them."
    (carried,) = replace(blind, meshes={world.links[1].collisions[0].resource: rock}).obstacles
    assert len(carried[0].mesh.faces) == 4


# -- reports and figures of a bag with several robots, each in its own namespace -----------------


JOINTS = {"/fleet/a": 1, "/fleet/b": 3}
TOLERANCES = {"/fleet/a": 0.125, "/fleet/b": 0.25}


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two robots, of one and of three joints, that stand 1 m and 2 m from their goals."""
    path = tmp_path / "both.mcap"
    with made_bag(path) as (writer, say):
        for place, (name, n) in enumerate(JOINTS.items(), 1):
            values = {"position_tolerance": json.dumps(TOLERANCES[name]), "method": '"optimal"'}
            writer.add_metadata(f"parameters{name}/planner", values)
            urdf = urdf_of(n).replace("test_robot", f"robot_{n}").encode()
            title = f"{name.strip('/').replace('/', '.')}.robot_description.urdf"
            writer.add_attachment(title, urdf, "application/xml", 0)
            names = [f"joint_{i}" for i in range(n)]
            say(f"{name}/goal_pose", pose_at(0.0, 0, 0, 0, 0, 0, 0, 1), 0.0)
            for k in range(3):
                time = 0.5 * k
                at = (float(place), 0, 0, 0, 0, 0, 1)
                say(f"{name}/odom", odometry(time, *at, *np.zeros(6)), time)
                zeros = np.zeros(n).tolist()
                say(f"{name}/joint_states", joint_states(time, names, zeros, zeros), time)
    return path


@pytest.mark.parametrize("name", JOINTS)
def test_the_robot_that_is_named_is_the_one_that_is_shown(name: str, bag: Path) -> None:
    for given in (name, name.strip("/")):
        flight = read_report(bag, given)
        assert flight.required_robot().name == f"robot_{JOINTS[name]}"
        assert len(flight.joint_names) == JOINTS[name]
        (other,) = flight.other_robots
        assert {name, other} == set(JOINTS)
        distance = 1 + list(JOINTS).index(name)
        row = ("Position error", f"{distance} m", f"tolerance {TOLERANCES[name]} m")
        assert row in headline(flight)
    assert read_report(bag).bag.namespace == "/fleet/a"


def test_the_page_says_which_robot_it_shows_and_which_it_does_not(
    bag: Path, tmp_path: Path
) -> None:
    page = tmp_path / "b.html"
    words = ["report", str(bag), "-o", str(page), "--namespace", "fleet/b"]
    spacerobot(*words)
    text = page.read_text("utf-8")
    assert "<span>namespace /fleet/b</span><span>the bag also contains /fleet/a</span>" in text
    words = ["figures", str(bag), "--only", "joints", "--format", "svg", "-o", str(tmp_path)]
    spacerobot(*words, "--namespace", "/fleet/b")
    assert "joint_2" in (tmp_path / "joints.svg").read_text("utf-8")
    spacerobot(*words)
    assert "joint_2" not in (tmp_path / "joints.svg").read_text("utf-8")
    for command in ("report", "figures"):
        words = [command, str(bag), "--namespace", "c", "-o", str(tmp_path / "none")]
        result = spacerobot(*words, code=2)
        assert_one_sentence(result.stderr, "'c'", "/fleet/a, /fleet/b")
    assert not (tmp_path / "none").exists()


# -- what the picture report is made with: arithmetic on time series, and the drawing of ---------


def test_what_is_behind_is_hidden() -> None:
    view = View()
    right, up = view.paper_axes

    none = np.empty((0, 2, 3))

    def square(nearness: float, half: float, fill: list[float], facing: float = 1.0) -> PlacedSolid:
        corners = [x * right + y * up for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        normal = view.viewing_direction
        triangles = np.array([corners[:3], [*corners[2:], corners[0]]])
        placed, normals = half * triangles + nearness * normal, facing * np.array([normal] * 2)
        return PlacedSolid(placed, normals, none, none, np.array(fill))

    near, far = square(1.0, 0.5, [1.0, 0.0, 0.0]), square(0.0, 1.0, [0.0, 0.0, 1.0])
    backwards = square(2.0, 0.5, [0.0, 1.0, 0.0], facing=-1.0)
    line, normals = np.array([[-right, right]]) * 0.9, np.array([[view.viewing_direction] * 2])
    edged = PlacedSolid(np.empty((0, 3, 3)), np.empty((0, 3)), line, normals, np.zeros(3))
    canvas = Canvas(view, np.full(2, -2.0), np.full(2, 2.0), 80)
    canvas.draw([near, far, backwards, edged])
    image = canvas.image()
    assert image.shape == (80, 80, 4)
    assert image[40, 40, 0] > 0.5
    assert image[40, 40, 2] == 0.0
    far_blue = image[25, 25, 2]
    assert far_blue > 0.5
    assert image[39:41, 24, 2].min() < 0.7 * far_blue  # The edge is before the far square.
    assert not image[5:15].any()


def test_rotation_vectors_are_continuous_beyond_half_turns() -> None:
    angle = np.concatenate([np.linspace(0, 9, 400), np.linspace(9, -9, 800)])
    expected = angle[:, np.newaxis] * np.array([0.6, 0.0, -0.8])
    quaternions = np.array([quaternion_from_rotvec(r) for r in expected])
    quaternions[::7] *= -1  # The same attitudes.
    np.testing.assert_allclose(series.rotvecs(quaternions), expected, atol=1e-12)
    for k in (300, 700, 1150):  # More than a turn on, less, and more than a turn back.
        near = expected[k] + [0.01, -0.02, 0.015]
        found = series.nearest_rotvec(rotvec_from_quaternion(quaternions[k]), near)
        np.testing.assert_allclose(found, expected[k], atol=1e-12)


def ticks(values: Array) -> Signal:
    return Signal(np.linspace(0.0, TICK * (len(values) - 1), len(values)), values)


def test_cycles_are_found_where_there_are_some() -> None:
    shapes = cyclic_shapes(slide=100, cycles=40, period=60)
    cycles = present(find_cycles(ticks(rates_of(shapes))))
    assert cycles.period == pytest.approx(60 * TICK)
    assert cycles.start == pytest.approx(99 * TICK, abs=1.5 * TICK)
    assert cycles.count == 40
    ramp = np.linspace(0, 1, 500)[:, np.newaxis] ** 2
    assert find_cycles(ticks(ramp)) is None
    noise = np.random.default_rng(2).normal(size=(2000, 3))
    assert find_cycles(ticks(noise)) is None
    assert find_cycles(ticks(np.empty((0, 3)))) is None


def test_whole_cycles_are_counted_and_the_last_are_at_the_end() -> None:
    # A sample is missing at the end of a cycle now and then.
    for end, count in ((8.0, 3), (7.95, 3), (7.5, 2), (9.5, 3)):
        assert Cycles(2.0, end, 2.0).count == count
    assert Cycles(2.0, 20.0, 2.0).last(3) == (14.0, 20.0)


def test_the_robot_is_drawn_at_six_instants_though_it_rests_at_the_end(strut: FlightReport) -> None:
    def times(joints: Array) -> list[float]:
        time = np.arange(float(len(joints)))
        poses = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], (len(joints), 1))
        series = {"pose": Signal(time, poses), "q": Signal(time, joints)}
        figure = present(configurations_figure(replace(strut, series=series)))
        titles = [axes.get_title() for axes in figure.figure.axes if axes.get_visible()]
        return [float(title.split()[2]) for title in titles if title]

    n = len(strut.joint_names)
    moving = np.arange(101.0)[:, np.newaxis] * np.linspace(0.001, -0.002, n)
    rest = np.repeat(moving[-1:], 40, axis=0)
    np.testing.assert_allclose(times(np.vstack([moving, rest])), [0, 20, 40, 60, 80, 140], atol=1)
    assert times(rest) == [39]


def test_areas_are_positive_counter_clockwise(tmp_path: Path) -> None:
    """Two joints go round an ellipse with semi-axes of 0.1 m and 0.2 rad, clockwise."""
    bag = tell(tmp_path / "loops.mcap", Story(cyclic_shapes()))
    figure = present(loops_figure(read_report(bag)))
    title = figure.figure.axes[0].get_title()
    assert float(title.split()[1]) == pytest.approx(-np.pi * 0.1 * 0.2, rel=0.01)
