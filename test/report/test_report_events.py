"""Events, momentum budgets and targets in reports."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation, Slerp
from support.command_line import spacerobot
from support.flight_bags import GOAL, TICK, Story, goal_value, still, tell
from support.html_page import present

from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import RobotDescriptionError, SpaceRobotError, shortened
from spacerobot_ros.flight.captures import momentum_budget_over_time
from spacerobot_ros.model.meshes import visuals_of
from spacerobot_ros.model.payload_estimation import PayloadEstimate
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.report import figures_over_time
from spacerobot_ros.report import tables as report_tables
from spacerobot_ros.report.figures import ReportFigure, drawing
from spacerobot_ros.report.figures_over_time import momentum_budget_figure, shape_groups
from spacerobot_ros.report.figures_space import configurations_figure
from spacerobot_ros.report.flight import FlightReport, read_report
from spacerobot_ros.report.player import WORLD, View3D, view_of_flight
from spacerobot_ros.report.scene import bodies_of, corner_points, placed_solids
from spacerobot_ros.report.tables import joint_table, payload_text, result_table

EVENTS = [
    (0.05, {"event": "goal_accepted", "time": "0.05"}),
    (0.10, {"event": "plan_ready", "time": "0.1", "wall_time": "1.7e9"}),
    # The recorder was late: the node knows when it was.
    (0.90, {"event": "fault_injected", "time": "0.4"}),
    (0.60, {"event": "latched"}),
    (0.70, {"event": "rearmed", "time": "0.7"}),
    (0.72, {"event": "plan_taken_over", "time": "0.72"}),
    (0.75, {"event": "goal_aborted", "time": "0.75"}),
    (0.80, {"event": "activated", "time": "0.8"}),
    (0.80, {"event": "of another version", "time": "0.8"}),
    (0.80, {"event": "latched", "time": "nan"}),
    (0.80, {"event": "latched", "time": "1e300"}),
    (0.80, {}),
]
TIMES = {
    "goal_accepted": 0.05,
    "plan_ready": 0.1,
    "fault_injected": 0.4,
    "latched": 0.6,
    "rearmed": 0.7,
    "plan_taken_over": 0.72,
    "goal_aborted": 0.75,
}
LABELS = {"goal", "plan", "fault on", "latched", "rearmed", "takeover", "aborted"}


def story(tmp_path: Path, events: Any = EVENTS, **options: Any) -> Path:
    executing = {"state": "executing", "method": "lie_bracket", **goal_value()}
    shapes = still(count=21)
    shapes[:, 0] = [0.01 * k for k in range(21)]
    return tell(
        tmp_path / "a.mcap",
        Story(
            shapes,
            statuses=[(0.1, "Executing.", executing)],
            goals=[(0.05, *GOAL)],
            events=events,
            **options,
        ),
    )


def lanes(figure: Figure) -> list[Any]:
    return [axes for axes in figure.axes if axes.get_label() == "events"]


def test_events_have_the_time_that_their_node_gave(tmp_path: Path) -> None:
    flight = read_report(story(tmp_path))
    found = {each.kind.value: time for time, each in flight.timed_events}
    assert found == pytest.approx(TIMES)
    assert {each.node for _, each in flight.timed_events} == {"node"}


@pytest.mark.parametrize(
    "draw",
    [
        figures_over_time.position_figure,
        figures_over_time.attitude_figure,
        figures_over_time.shape_figure,
        figures_over_time.rates_figure,
        figures_over_time.momentum_figure,
    ],
)
def test_a_lane_below_every_time_axis_has_every_event(
    tmp_path: Path, draw: Callable[[FlightReport], Any]
) -> None:
    made = draw(read_report(story(tmp_path)))
    figure = made.figure
    timed = [axes for axes in figure.axes if axes.get_xlabel() == "time (s)"]
    below = lanes(figure)
    assert len(below) == len(timed) >= 1
    for lane, axes in zip(below, timed, strict=True):
        assert lane.get_xlim() == axes.get_xlim() == pytest.approx((0.0, 20 * TICK))
        assert lane.get_position().y1 < axes.get_position().y0
        assert lane.get_position().y0 > 0
        drawn = sorted(x for line in lane.lines for x in line.get_xdata())
        assert drawn == pytest.approx(sorted(TIMES.values()))
        labels = {text.get_text() for text in lane.get_legend().get_texts()}
        assert labels == LABELS


@pytest.mark.parametrize("events", [[], EVENTS[7:]])
def test_a_bag_without_events_has_no_lane(tmp_path: Path, events: list[Any]) -> None:
    made = figures_over_time.position_figure(read_report(story(tmp_path, events)))
    assert not isinstance(made, str)
    assert not lanes(made.figure)


def test_figures_for_papers_show_events_only_if_asked(tmp_path: Path) -> None:
    words = ["figures", str(story(tmp_path)), "--only", "position", "--format", "svg"]
    for option in ([], ["--events"]):
        folder = tmp_path / "_".join(["figures", *option])
        spacerobot(*words, *option, "-o", str(folder))
        text = (folder / "position.svg").read_text("utf-8")
        for label in LABELS - {"goal"}:  # That is in the legend of the figure itself.
            assert (f">{label}<" in text) == bool(option), (label, option)


# -- the figure of the momentum budget, and the flights that have it -----------------------------


BAGS = Path(__file__).parents[2] / "bags"


def figure_of(name: str) -> ReportFigure | str | None:
    with drawing():
        return momentum_budget_figure(read_report(BAGS / f"{name}.mcap"))


def test_a_robot_with_wheels_has_four_traces() -> None:
    figure = present(figure_of("wheels"))
    assert (figure.name, figure.heading) == ("momentum_budget", "Momentum budget")
    (group,) = figure.groups
    assert list(group.names) == ["base", "arm", "wheels", "sum"]
    assert (group.label, group.unit) == ("angular momentum", "N m s")
    assert len(set(group.colours)) == 4
    assert len(group.signal) == 256
    assert group.signal.time[0] == 0.0
    assert "of the wheels about their axes" in figure.caption


def test_a_robot_that_captures_has_no_trace_of_wheels_that_it_lacks() -> None:
    figure = present(figure_of("capture"))
    (group,) = figure.groups
    assert list(group.names) == ["base", "arm", "sum"]
    assert "wheels" not in figure.caption
    report = read_report(BAGS / "capture.mcap")
    budget = momentum_budget_over_time(report, 2000)
    np.testing.assert_array_equal(group.signal.values, budget.values[:, [0, 1, 3]])


def test_the_table_has_the_estimated_body(monkeypatch: pytest.MonkeyPatch) -> None:
    report = read_report(BAGS / "capture.mcap")
    (text,) = (value for name, value in result_table(report).rows if name == "Held body, estimated")
    assert re.fullmatch(
        r"mass (10|9\.9999\d*) kg; centre of mass \(0\.27\d+, -0\.1\d+, -?0[.0]*\) m in "
        "end_effector; not determined by the motion: Ixx, Iyy, Ixy",
        text,
    ), text

    def refuse(*_: object) -> None:
        raise SpaceRobotError("Loads acted.")

    monkeypatch.setattr(report_tables, "payload_estimates", refuse)
    rows = result_table(read_report(BAGS / "capture.mcap")).rows
    assert ("Held body, estimated", "Loads acted.") in rows


def test_the_text_of_an_estimate_leaves_out_unknown_parameters() -> None:
    numbers = np.array([2.0, 0.2, -0.4, 0.6, 1.2, 1.4, 1.3, 0.05, -0.1, 0.2])
    spread = np.full(10, 0.03)
    whole = PayloadEstimate("hand", numbers, spread, np.zeros((0, 10)), True)
    # By the parallel-axis theorem: centre (0.1, -0.2, 0.3) m.
    assert payload_text(whole) == (
        "mass 2 ± 0.03 kg; centre of mass (0.10000, -0.20000, 0.30000) m in hand; inertia "
        "about the centre of mass (0.94, 1.2, 1.2, 0.01, -0.04, 0.08) kg m² "
        "(xx, yy, zz, xy, xz, yz); corrected to the nearest physical parameters"
    )
    some = np.where(np.arange(10) == 2, np.nan, numbers)
    assert payload_text(PayloadEstimate("hand", some, spread, np.zeros((0, 10)), False)) == (
        "mass 2 ± 0.03 kg; not determined by the motion: m cy"
    )
    none = np.full(10, np.nan)
    assert payload_text(PayloadEstimate("hand", none, none, np.eye(10), False)).startswith(
        "not determined by the motion: m, m cx"
    )


def test_waypoints_are_listed_before_the_goal() -> None:
    rows = result_table(read_report(BAGS / "inspection.mcap")).rows
    places = ("(2.20000, 2.30000, 0.20000)", "(3.70000, 0.10000, -0.30000)")
    for number, place in enumerate((*places, "(2.20000, -2.30000, 0.00000)")):
        label, text = rows[number]
        assert label == f"Goal waypoint {number + 1}"
        assert text.startswith(f"{place} m, rotation vector ")
    assert rows[3][0] == "Goal position"


def test_a_robot_without_inertia_has_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise RobotDescriptionError("The robot has no inertia.")

    monkeypatch.setattr(figures_over_time, "momentum_budget_over_time", refuse)
    assert figure_of("capture") == "The momentum budget is not drawn. The robot has no inertia."


# -- the target of a capture in the 3D view of a report: its solids, and its motion by -----------


BAG = BAGS / "capture.mcap"
TARGET = f"{WORLD}/target"


@pytest.fixture(scope="module")
def scene() -> View3D:
    made = present(view_of_flight(read_report(BAG)))
    return made


def odometry_in(bag: Path) -> tuple[Any, Any, Any]:
    """Times (s), positions and attitudes of the target, read message by message."""
    found = [
        (message.header.stamp, message.pose.pose)
        for _, message in read_bag(bag)["/target/odom"].messages()
    ]
    times = np.array([stamp.sec + stamp.nanosec * 1e-9 for stamp, _ in found])
    positions = np.array([[pose.position.x, pose.position.y, pose.position.z] for _, pose in found])
    turned = [[getattr(pose.orientation, x) for x in "xyzw"] for _, pose in found]
    return times, positions, Rotation.from_quat(turned)


@pytest.fixture(scope="module")
def odometry() -> tuple[Any, Any, Any]:
    return odometry_in(BAG)


def test_the_target_has_the_solids_of_its_urdf(scene: View3D) -> None:
    (described,) = (
        message.data for _, message in read_bag(BAG)["/target/robot_description"].messages()
    )
    visuals = [v for link in parse_robot(described).links for v in link.shapes]
    drawn = [
        command
        for command in scene.commands
        if command.get("path", "").startswith(TARGET) and command["path"].endswith("/solid")
    ]
    assert len(drawn) == len(visuals) > 0
    assert "the target moves according to target/odom" in scene.caption


def test_the_target_moves_as_its_odometry_says(scene: View3D, odometry: Any) -> None:
    times, positions, attitudes = odometry
    (animation,) = [c for c in scene.commands if c["type"] == "set_animation"]
    (moved,) = [c for c in animation["animations"] if c["path"] == TARGET]
    tracks = {track["name"]: track for track in moved["clip"]["tracks"]}
    at = np.array(tracks[".position"]["times"])
    assert tracks[".quaternion"]["times"] == tracks[".position"]["times"]
    assert 2 < len(at) <= 1000
    assert at[0] == 0.0
    assert at[-1] == pytest.approx(times[-1] - times[0], abs=1e-3)
    shown = np.reshape(tracks[".position"]["values"], (-1, 3))
    turned = Rotation.from_quat(np.reshape(tracks[".quaternion"]["values"], (-1, 4)))
    # Between key frames, too: within the tolerance of the caption.
    now = times - times[0]
    near = np.column_stack([np.interp(now, at, column) for column in shown.T])
    assert np.abs(near - positions).max() < 5e-3
    inside = np.clip(now, at[0], at[-1])
    assert (Slerp(at, turned)(inside).inv() * attitudes).magnitude().max() < 8e-3
    (placed,) = [c for c in scene.commands if c["type"] == "set_transform" and c["path"] == TARGET]
    matrix = np.reshape(placed["matrix"], (4, 4)).T
    np.testing.assert_allclose(matrix[:3, 3], positions[0], atol=1e-8)
    np.testing.assert_allclose(matrix[:3, :3], attitudes[0].as_matrix(), atol=1e-8)


def test_other_flights_have_neither_budget_nor_target() -> None:
    assert figure_of("planar_chain") is None
    report = read_report(BAGS / "planar_chain.mcap")
    assert report.target is None
    assert len(report.target_pose) == 0
    made = present(view_of_flight(report))
    assert "target" not in made.caption
    assert not any(command.get("path") == TARGET for command in made.commands)


def test_pictures_draw_the_target_where_it_is_held() -> None:
    """Corners of its solids about its odometry, as the corners of its URDF about its origin."""
    bag = BAGS / "servicing.mcap"
    report, (times, positions, attitudes) = read_report(bag), odometry_in(bag)
    assert report.target is not None
    corners = np.concatenate(
        [
            visual.mesh.vertices @ frame.R.T + frame.r
            for visual in visuals_of(report.target, {}, 10_000)
            for frame in [report.target.frames[visual.link][1]]
        ]
    )
    gone = np.linalg.norm(positions - positions[0], axis=1)
    assert gone[-1] > 0.5
    rows = (0, len(times) // 2, len(times) - 1)
    target = [each for each in bodies_of(report, rows, 10_000) if each.name == "target"]
    for instant, k in enumerate(rows):
        drawn = corner_points(placed_solids(target, instant))
        wanted = positions[k] + attitudes[k].apply(corners)
        assert np.abs(drawn[:, None] - wanted[None]).max(axis=2).min(axis=1).max() < 1e-9
    figure = present(configurations_figure(report))
    assert "free or held" in figure.caption


def test_reaction_wheels_have_rates_and_no_angles() -> None:
    report = read_report(BAGS / "servicing.mcap")
    wheels = {"wheel_plus_x", "wheel_plus_y", "wheel_minus_x", "wheel_minus_y"}
    assert {report.joint_names[i] for i in report.wheel_columns} == wheels
    bag = read_bag(BAGS / "servicing.mcap")
    recorded = [message for _, message in bag["/joint_states"].messages()]
    angles = {name: [m.position[list(m.name).index(name)] for m in recorded] for name in wheels}
    assert max(abs(x) for each in angles.values() for x in each) > 1000
    groups = shape_groups(report)
    assert [group.unit for group in groups] == ["rad", "rad/s"]
    assert not set(map(shortened, wheels)) & set(groups[0].names)
    assert set(groups[1].names) == set(map(shortened, wheels))
    for k, name in enumerate(groups[1].names):
        full = next(each for each in wheels if shortened(each) == name)
        rates = [m.velocity[list(m.name).index(full)] for m in recorded]
        assert np.abs(groups[1].signal.values[:, k]).max() == pytest.approx(np.abs(rates).max())
    # Pictures hold them still: at any angle they look the same.
    assert np.abs(report.joints).max() < np.pi
    table = present(joint_table(report))
    ends = {row[0]: row[3:5] for row in table.rows}
    assert all((ends[name] == ("–", "–")) is (name in wheels) for name in ends)
