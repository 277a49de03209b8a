"""The clearance of a flight: its nearest approach, its contacts, its bag and its report."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Path as PathMessage
from std_msgs.msg import String
from support.crossing import LINKS, URDF, distance
from support.html_page import present
from support.made_bags import joint_states, made_bag, odometry, pose

from spacerobot_ros import fly, read_bag
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.reading import FlightBag, open_flight_bag, read_flight, read_run
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.measures import metrics_of_each
from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.report.events import event_text
from spacerobot_ros.report.figures_over_time import clearance_figure
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.tables import result_table
from spacerobot_ros.resources import robot_file
from spacerobot_ros.session.run import run_scenario
from spacerobot_ros.simulation.clearance import FlightClearance

RADIUS = 0.12
"""Of the balls of the sliding masses, m: without their SRDF they may touch."""

PAIRS = [(0, 1), (0, 2), (1, 2)]

PARAMETERS = {
    "plant.initial_joint_positions": [0.3, -0.25, 0.2],
    "plant.clearance_period": 0.1,
    "planner.clearance": 0.0,
    "planner.lie_bracket.t1": 2.0,
    "planner.lie_bracket.cycle_period": 1.0,
}


def distances_of_masses(q: Array) -> Array:
    """Return the distances (N, 3) of the pairs of masses on three axes, m."""
    return np.array([np.hypot(q[:, i], q[:, j]) - 2 * RADIUS for i, j in PAIRS]).T


@pytest.fixture(scope="module")
def through() -> Flight:
    """A flight whose masses slide into each other."""
    sliders = SpaceRobot(parse_robot(robot_file("sliding_masses").read_text()))
    goal = (0.04, -0.05, 0.01)
    turn = (0.01, 0.004, 0.0)
    return fly(sliders, goal, rotvec=turn, method="lie_bracket", parameters=PARAMETERS)


NO_POSES = (np.zeros(0), np.zeros((0, 7)))


def test_the_nearest_approach_of_a_flight_may_be_between_two_states() -> None:
    # The balls pass the middle at 1.3 s, between two states that are 1 s apart.
    shapes = np.array([[-0.65, -1.3], [-0.15, -0.3], [0.35, 0.7], [0.4, 0.7]])
    time = np.array([0.0, 1.0, 2.0, 5.0])
    robot = parse_robot(URDF)
    assert FlightClearance.of(robot, ("y", "z"), (time, shapes), NO_POSES) is None
    # A bag may have its joints in another order than the robot.
    found = FlightClearance.of(robot, ("x", "y"), (time, shapes[:, ::-1]), NO_POSES)
    assert found is not None
    assert list(found.nearest.links) == LINKS
    assert found.nearest.distance == pytest.approx(0.1 - 0.12, abs=1e-4)
    assert found.nearest_time == pytest.approx(1.3, abs=0.01)
    at, distances = found.over_time(3)
    np.testing.assert_allclose(at, [0.0, found.nearest_time, 2.0, 5.0])
    np.testing.assert_allclose(distances[[0, 2, 3]], distance(shapes)[[0, 2, 3]], atol=1e-6)


def test_clearances_of_states_are_those_of_the_balls() -> None:
    way = np.linspace(-1.0, 1.0, 21)[:, np.newaxis] * [0.15, 0.3]
    q = np.arange(21) / 4, way
    found = FlightClearance.of(parse_robot(URDF), ("y", "x"), q, NO_POSES)
    assert found is not None
    np.testing.assert_allclose(
        [each.distance for each in found.statuses(3)], distance(way)[::3], atol=1e-6
    )


def test_a_flight_through_contacts_has_events_and_a_clearance(through: Flight) -> None:
    assert through.succeeded
    truth = distances_of_masses(through.q)
    assert through.measures.clearance == pytest.approx(truth.min(), abs=1e-4)
    summary = through.summary()
    assert summary["clearance_m"] == through.measures.clearance
    deepest = PAIRS[int(truth.min(axis=0).argmin())]
    assert summary["clearance_links"] == [f"mass_{i + 1}" for i in deepest]
    at = through.time[truth.min(axis=1).argmin()]
    assert summary["clearance_time_s"] == pytest.approx(at, abs=0.05)
    robot = through.required_robot()
    assert metrics_of_each([through.measures], robot)[0]["clearance_m"] == summary["clearance_m"]
    assert math.isnan(through.measured(clearance=False).clearance)
    looked_at = truth[::2]  # Every 0.1 s, at 20 Hz.
    begins = {
        (f"mass_{i + 1}", f"mass_{j + 1}"): 0.1 * np.flatnonzero(looked_at[:, k] <= 0)[0]
        for k, (i, j) in enumerate(PAIRS)
    }
    assert min(begins.values()) > 0
    events = [each for each in through.events if each.kind is EventKind.CONTACT]
    assert {each.level for each in events} == {2}
    found = {(e.about["first"], e.about["second"]): e.time_s for e in events}
    assert found == {links: pytest.approx(time) for links, time in begins.items()}
    times = [event.time_s for event in through.events]
    assert times == sorted(times)  # type: ignore[type-var]


def test_its_bag_and_its_report_show_the_contacts(through: Flight, tmp_path: Path) -> None:
    through.save(tmp_path / "through.mcap")
    series = read_bag(tmp_path / "through.mcap")["/clearance"]
    read = [{pair.key: pair.value for pair in m.values} for _, m in series.messages()]
    truth = distances_of_masses(through.q)
    np.testing.assert_allclose(
        [float(each["distance"]) for each in read], truth.min(axis=1)[::2], atol=1e-4
    )
    again = read_run(tmp_path / "through.mcap")
    assert again.measures.clearance == pytest.approx(through.measures.clearance, abs=1e-9)
    report = read_report(tmp_path / "through.mcap")
    shown = [event_text(each) for each in report.events if each.kind is EventKind.CONTACT]
    assert shown == [
        f"contact: {pair}" for pair in ("mass_2, mass_3", "mass_1, mass_2", "mass_1, mass_3")
    ]
    figure = present(clearance_figure(report))
    assert "Links 'mass_1' and 'mass_2' touch, 0.186 m deep at " in figure.caption
    (group,) = figure.groups
    assert group.limits == [(0, 0.0)]
    assert group.signal.values.min() == pytest.approx(truth.min(), abs=1e-4)
    ((_, text),) = [row for row in result_table(report).rows if row[0] == "Clearance"]
    assert text.startswith("-0.186 m between 'mass_1' and 'mass_2' at ")


def test_a_flight_that_does_not_measure_it_has_no_clearance(
    through: Flight, tmp_path: Path
) -> None:
    goal, method = through.scenario.goal, "lie_bracket"
    parameters = {**PARAMETERS, "plant.clearance_period": 0.0}
    flight = fly(SpaceRobot(through.required_robot()), goal, method=method, parameters=parameters)
    assert flight.clearance is None
    assert math.isnan(flight.measures.clearance)
    assert "clearance_m" not in flight.summary()
    assert not [event for event in flight.events if event.kind is EventKind.CONTACT]
    flight.save(tmp_path / "silent.mcap")
    assert "/clearance" not in read_bag(tmp_path / "silent.mcap").topics
    assert clearance_figure(read_report(tmp_path / "silent.mcap")) is None
    # The SRDF beside the robot disables all pairs: the distance is infinite.
    sliders = fly("sliding_masses", goal, method=method, parameters=PARAMETERS)
    assert sliders.measures.clearance == math.inf
    assert "clearance_m" not in sliders.summary()


@pytest.mark.slow
@pytest.mark.usefixtures("own_domain")
def test_the_nodes_report_what_a_flight_without_ros_does(through: Flight, tmp_path: Path) -> None:
    summary = run_scenario(through.scenario, tmp_path / "ros.mcap", nodes=True).summary
    assert summary["clearance_m"] == pytest.approx(through.measures.clearance, abs=1e-9)
    through.save(tmp_path / "alone.mcap")
    said = []
    for name in ("ros", "alone"):
        bag = read_bag(tmp_path / f"{name}.mcap")
        events = [m.message for _, m in bag["/events"].messages() if "touch" in m.message]
        said.append([(m.name, m.message) for _, m in bag["/clearance"].messages()] + events)
    assert said[0] == said[1]
    assert len(said[0]) > 100


def test_flights_recorded_before_there_was_a_clearance_are_without() -> None:
    bag = Path(__file__).with_name("earlier_version.mcap")
    flight = read_run(bag)
    assert flight.scenario.planner.clearance == 0.0
    assert flight.scenario.plant.clearance_period == 0.0
    # Its masses overlap, and its robot knows no SRDF.
    assert flight.clearance is None
    assert PlannerConfig().clearance == 0.01
    # It has no events either, and is flown again all the same.
    assert flight.succeeded
    assert not flight.events
    assert verify_bag(bag).difference is None


ROBOT = Path(robot_file("planar_chain")).read_text("utf-8")


def world(name: str) -> String:
    return String(
        data=f'<robot name="w"><link name="w"/><link name="{name}"><collision><geometry>'
        '<sphere radius="0.3"/></geometry></collision></link><joint name="a" type="fixed">'
        f'<parent link="w"/><child link="{name}"/></joint></robot>'
    )


def bag_with(path: Path, *obstacles: tuple[float, String]) -> FlightBag:
    """Return a bag with states from 1 s on, and obstacles at some times."""
    with made_bag(path) as (_, say):
        say("/robot_description", String(data=ROBOT), 0.25)
        for time in (1.0, 1.5, 2.0):
            say("/odom", odometry(time, time, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0), time)
            say("/clearance", DiagnosticStatus(), time)
        for time, text in obstacles:
            say("/obstacles", text, time)
    return open_flight_bag(path)


def names_of(bag: FlightBag) -> list[str]:
    description = bag.description
    assert description is not None
    return [] if description.world is None else [each.name for each in description.world.links[1:]]


@pytest.mark.parametrize(
    ("obstacles", "names", "change"),
    [
        ([], [], False),
        ([(0.5, world("post"))], ["post"], False),
        ([(0.5, world("post")), (1.75, world("ball"))], ["ball"], True),
        ([(0.5, world("post")), (0.75, String(data=""))], [], False),
        ([(0.5, world("post")), (1.5, String(data="no URDF"))], ["post"], False),
    ],
)
def test_a_robot_is_among_the_last_obstacles_and_distances_are_to_one_set(
    tmp_path: Path, obstacles: Sequence[tuple[float, String]], names: list[str], *, change: bool
) -> None:
    bag = bag_with(tmp_path / "made.mcap", *obstacles)
    assert names_of(bag) == names
    assert bag.obstacles_change is change
    assert read_flight(bag).measures_clearance is not change


def test_goals_have_the_frame_of_their_pose_and_the_shape_that_was_sent_before(
    tmp_path: Path,
) -> None:
    """The last pose of a path is a goal, named by the stamp of the path."""
    names, path = ["pin_1", "pin_2"], tmp_path / "made.mcap"
    with made_bag(path) as (_, say):
        say("/robot_description", String(data=ROBOT), 0.25)
        for time in (1.0, 2.0):
            say("/odom", odometry(time, time, 2, 3, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0), time)
            say("/joint_states", joint_states(time, names, [0.0, 0.0], [0.0, 0.0]), time)
        for x, header, frame in ((1, "map", "world"), (2, "world", "map"), (3, "world", "")):
            last = pose(0.0, x, 5, 6, 0, 0, 0, 0)
            last.header.frame_id = frame
            sent = PathMessage(poses=[pose(0.0, 7, 8, 9, 0, 0, 0, 1), last])
            sent.header.frame_id, sent.header.stamp.sec = header, x
            say("/end_effector/path", sent, 1.0 + x / 10)
        say("/end_effector/path", PathMessage(), 1.75)
        say("/end_effector/goal_pose", pose(9.0, 1, 2, 3, 0, 0, 0, 1), 1.25)
        for time, shape in ((1.15, [0.3, -0.4]), (1.35, [])):
            given = joint_states(time, names[: len(shape)], shape, [])
            say("/goal_joint_states", given, time)
        for time in (1.1, 1.2, 1.3, 1.4):
            say("/goal_pose", pose(time, 10 * time, 0, 0, 0, 0, 0, 1), time)
    bag = open_flight_bag(path)
    hand = bag.goals("end_effector")
    assert [each.time for each in hand] == [1.1, 1.25, 1.3]
    assert [each.goal_id for each in hand] == ["1.000000000", "9.000000000", "3.000000000"]
    places = [each.goal.position.tolist() for each in hand]
    assert places == [[1, 5, 6], [1, 2, 3], [3, 5, 6]]
    assert hand[0].goal.quaternion.tolist() == [0, 0, 0, 1]
    shapes = [each.goal.joint_positions for each in bag.goals()]
    assert [None if each is None else each.tolist() for each in shapes] == [
        *(None, [0.3, -0.4], [0.3, -0.4], None)
    ]
