"""Flights that are read from bags with all that bags of others may hold."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from sensor_msgs.msg import JointState
from support.flight_bags import urdf_of
from support.made_bags import array, joint_states, made_bag, odometry, pose, stamped, status

from spacerobot_ros.errors import RecordingError
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.flight.reading import FlightBag, impulse, open_flight_bag, read_flight, read_run
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.measures import Outcome

TURNED = (0.5, -0.1, 0.7, 0.5)
LATE = 0.25
"""From the stamp of a state to its arrival at the recorder, s."""


def wrench(time: float, *numbers: float) -> WrenchStamped:
    message = stamped(WrenchStamped(), time)
    force, torque = message.wrench.force, message.wrench.torque
    force.x, force.y, force.z, torque.x, torque.y, torque.z = map(float, numbers)
    return message


def write(path: Path, late: float = LATE, parameters: dict[str, Any] | None = None) -> Path:
    """Write two robots; messages of the first arrive ``late`` s after their stamps.

    Its sensors err from 1.5 s to 2 s; its x is -1 where it is measured, and the time otherwise.
    """
    with made_bag(path) as (bag, say):

        def sent(topic: str, message: Any, time: float) -> None:
            say(f"/a/{topic}", message, time + late)

        written = {"robot": '""', "tick_rate": "2.0"} | (parameters or {})
        bag.add_metadata("parameters/a/plant", written)
        bag.add_metadata("scenario", {"name": "made", "description": "It is made."})
        say("/b/odom", odometry(0.0, *range(13)), 0.5)
        for time in (1.0, 1.5, 2.0, 2.5, 3.0):
            x = time if time in (1.0, 2.5, 3.0) else -1.0
            sent("odom", odometry(time, x, 2, 3, *TURNED, 4, 5, 6, 7, 8, 9), time)
            names, values = ["j1", "j0"], [time + 0.1, time]
            if time == 2.5:
                names, values = ["j0", "j1"], values[::-1]
            if time == 3.0:
                names = ["j0", "j2"]
            sent("joint_states", joint_states(time, names, values, [10 * v for v in values]), time)
            sent("momentum", array(time, 0, 0, 0, 0, 0, 0.5), time)
        for time in (1.5, 2.0):
            sent("odom_true", odometry(time, time, 2, 3, *TURNED, 4, 5, 6, 7, 8, 9), time)
        broken = odometry(2.25, math.nan, 2, 3, *TURNED, 4, 5, 6, 7, 8, 9)
        sent("odom", broken, 2.25)
        for topic, frame, time, quaternion in (
            ("goal_pose", "elsewhere", 1.1, TURNED),
            ("goal_pose", "world", 1.2, TURNED),
            ("goal_pose", "", 1.3, TURNED),
            ("goal_pose", "world", 1.4, (0, 0, 0, 0)),
            ("end_effector/goal_pose", "world", 1.6, (0, 0, 0, 0)),
            ("end_effector/goal_pose", "world", 1.7, TURNED),
        ):
            message = pose(time, time, 0, 0, *quaternion)
            message.header.frame_id = frame
            sent(topic, message, time)
        first, last = "1.200000000", "1.300000000"
        for text, about in (
            ("Of another package.", {"mode": "x"}),
            ("It flies.", {"state": "executing", "goal_id": first, "method": "area_loop"}),
            ("It is there.", {"state": "reached", "goal_id": first}),
            ("It flies on.", {"state": "executing", "goal_id": last, "method": "lie_bracket"}),
            ("It is late.", {"state": "failed", "goal_id": last}),
            ("It rests.", {"state": "idle"}),
        ):
            sent("planner/status", status(about, text, "/a/planner"), 1.5)
        sent("events", status({"event": "unheard"}, "Of a later version.", "/a/planner"), 1.5)
        sent("events", status({"event": "running", "time": "1.5"}, "It runs.", "/a/plant"), 1.5)
        names = ["j0", "j1"]
        for time in (1.0, 1.5):
            command = JointState(name=names, velocity=[time, 7.0], effort=[8.0, 9.0])
            sent("joint_commands", stamped(command, time), time)
            sent("base_wrench", wrench(time, 1, 2, 3, 4, 5, time), time)
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bags")


@pytest.fixture(scope="module")
def bag(folder: Path) -> FlightBag:
    return open_flight_bag(write(folder / "two.mcap"))


@pytest.fixture(scope="module")
def flight(bag: FlightBag) -> Flight:
    return read_flight(bag)


def test_true_states_are_those_beside_sensors_that_err(flight: Flight) -> None:
    """A message with a number that is none is left out, as are joints of another robot."""
    assert flight.time.tolist() == [1.0, 1.5, 2.0, 2.5, 3.0]
    assert flight.pose[:, 0].tolist() == [1.0, 1.5, 2.0, 2.5, 3.0]
    assert flight.twist[0].tolist() == [4.0, 5.0, 6.0, 7.0, 8.0, 9.0]
    measured = flight.signal("measured_pose")
    assert measured.time.tolist() == [1.5, 2.0]
    assert measured.values[:, 0].tolist() == [-1.0, -1.0]
    assert len(flight.signal("measured_twist")) == 2
    assert flight.joint_names == ("j1", "j0")
    joints = flight.signal("q")
    assert joints.time.tolist() == [1.0, 1.5, 2.0, 2.5]
    assert joints.values.tolist() == [[time + 0.1, time] for time in joints.time]
    assert flight.qdot.tolist() == (10 * joints.values).tolist()
    assert flight.effort.shape == (0, 2)
    assert flight.momentum[:, 0].tolist() == [1.0, 1.5, 2.0, 2.5, 3.0]
    assert "measured_q" not in flight.series
    assert list(flight.series) == [
        *("pose", "measured_pose", "twist", "measured_twist", "q", "qdot", "effort", "momentum")
    ]
    assert len(flight.series) == 8


def test_reports_of_a_flight_are_those_of_its_last_goal(bag: FlightBag, flight: Flight) -> None:
    assert [goal.time for goal in flight.goals] == [1.2 + LATE, 1.3 + LATE]
    assert [goal.goal_id for goal in flight.goals] == ["1.200000000", "1.300000000"]
    assert flight.goal is not None
    assert [*flight.goal.position, *flight.goal.quaternion] == pytest.approx([1.3, 0, 0, *TURNED])
    first, last = flight.end_effector_goals
    assert first.goal.quaternion.tolist() == [0.0, 0.0, 0.0, 1.0]
    assert last.goal.quaternion == pytest.approx(TURNED)
    assert flight.end_effector_goal is last.goal
    assert flight.outcome is Outcome.FAILED
    assert flight.message == "It is late."
    assert flight.gait is not None
    assert (flight.gait.method, flight.method) == ("lie_bracket", "lie_bracket")
    assert [each.message for _, each in flight.statuses] == [
        *("It flies.", "It is there.", "It flies on.", "It is late.", "It rests.")
    ]
    assert [text for _, text in bag.statuses("planner") if isinstance(text, str)] == [
        "Of another package."
    ]
    assert [(event.message, event.time_s) for event in flight.events] == [("It runs.", 1.5)]
    assert [event.node for event in flight.events] == ["a/plant"]
    assert bag.began == 1.0
    assert bag.message_count == 37
    assert (flight.scenario.name, flight.scenario.description) == ("made", "It is made.")
    assert flight.scenario.commanders == ("planner",)
    assert flight.robot is None
    assert flight.scenario.published == ()


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize(
    ("node", "topic", "flies"),
    [("planner", "planner", "planning"), ("coordinated_control", "controller", "tracking")],
)
def test_a_goal_that_the_recorder_missed_is_read_from_statuses(
    folder: Path, recorded: bool, node: str, topic: str, flies: str
) -> None:
    """The attitude that a goal keeps is that in its statuses, else that when the goal arrived."""
    first, last, kept = "0.500000000", "1.200000000", (0.0, 0.6, 0.0, 0.8)
    file = folder / f"missed_{node}_{recorded}.mcap"
    with made_bag(file) as (_, say):
        for time, turned in (0.0, (0, 0, 0, 1)), (1.0, TURNED), (2.0, kept):
            say("/odom", odometry(time, time, 0, 0, *turned, *[0] * 6), time)
        say("/goal_pose", pose(0.5, 0.5, 0, 0, 0, 0, 0, 1), 0.5)
        if recorded:
            say("/goal_pose", pose(1.2, 0.2, 0.3, 0.4, *[math.nan] * 4), 1.2)
        about = [{"state": "reached", "goal_id": first}, {"state": flies, "goal_id": last}]
        if not recorded:
            named = " ".join(map(str, (0.2, 0.3, 0.4, *kept)))
            about.append({"state": "failed", "goal_id": last, "goal": named})
        for time, values in zip((1.0, 1.5, 2.0), about, strict=False):
            say(f"/{topic}/status", status(values, "", f"/{node}"), time)
    flight = read_flight(open_flight_bag(file))
    assert [each.goal_id for each in flight.goals] == [first, last]
    goal = flight.goals[-1].goal
    assert [*goal.position, *goal.quaternion] == [0.2, 0.3, 0.4, *(TURNED if recorded else kept)]
    assert flight.outcome is (Outcome.INTERRUPTED if recorded else Outcome.FAILED)


@pytest.mark.parametrize(
    ("actuation", "values"),
    [("velocity", [[7.0, 1.0], [7.0, 1.5]]), ("effort", [[9.0, 8.0], [9.0, 8.0]])],
)
def test_commands_are_of_the_actuation_and_in_the_order_of_the_joints(
    folder: Path, actuation: str, values: list[list[float]]
) -> None:
    """That of the joint states, j1 before j0, whatever that of the commands is."""
    path = write(folder / f"{actuation}.mcap", parameters={"actuation": json.dumps(actuation)})
    commands = read_flight(open_flight_bag(path, "/a/")).commands
    assert sorted(commands) == ["base_wrench", "joint_commands"]
    assert commands["joint_commands"].time.tolist() == [1.0, 1.5]
    assert commands["joint_commands"].values.tolist() == values
    wrenches = [[1.0, 2.0, 3.0, 4.0, 5.0, 1.0], [1.0, 2.0, 3.0, 4.0, 5.0, 1.5]]
    assert commands["base_wrench"].values.tolist() == wrenches


@pytest.mark.parametrize(
    ("late", "stamped"), [(0.0, True), (0.75, True), (1.25, False), (900.0, False)]
)
def test_times_are_stamps_unless_these_are_of_another_clock(
    folder: Path, late: float, stamped: bool
) -> None:
    bag = open_flight_bag(write(folder / f"{late}.mcap", late), "a")
    begin = 1.0 if stamped else 1.0 + late
    flight = read_flight(bag)
    assert flight.time.tolist() == [begin + k / 2 for k in range(5)]
    assert bag.began == pytest.approx(begin)
    assert [event.time_s for event in flight.events] == [begin + 0.5]
    assert [event.time_s for _, event in bag.events()] == [1.5], "the plant's own time"


def test_the_robot_of_a_namespace_is_read(folder: Path, bag: FlightBag) -> None:
    assert bag.namespace == "/a"
    assert read_flight(open_flight_bag(bag.path, "b/")).pose.tolist() == [[*range(7)]]
    with pytest.raises(RecordingError) as refused:
        open_flight_bag(bag.path, "c")
    named = f"The bag {bag.path} has no robot in the namespace 'c': it has /a, /b."
    assert str(refused.value) == named
    with made_bag(folder / "none.mcap") as (_, say):
        say("/joint_states", joint_states(0.0, ["j"], [0.0], [0.0]), 0.0)
    for namespace, known in (("", "no robot"), ("/x", "no robot")):
        with pytest.raises(RecordingError, match=f"it has {known}"):
            open_flight_bag(folder / "none.mcap", namespace)
    empty = read_flight(open_flight_bag(folder / "none.mcap"))
    assert (empty.duration, empty.goal) == (0.0, None)
    assert empty.outcome is Outcome.INTERRUPTED
    assert empty.scenario.name == "none"
    assert empty.scenario.goal.position.tolist() == [0.0, 0.0, 0.0]
    assert empty.scenario.goal.quaternion.tolist() == [0.0, 0.0, 0.0, 1.0]


def records(**changed: str | None) -> Iterator[tuple[str, dict[str, str]]]:
    """Yield the metadata records of a run, with changes of the one about its scenario."""
    about = {
        "name": "reached",
        "goal_position": "0.1 0.2 0.30000000000000004",
        "goal_orientation": "0 0 0 1",
        "published": json.dumps([{"quantity": "time", "printed": [1, 2], "note": "far"}]),
    }
    kept = {name: text for name, text in (about | changed).items() if text is not None}
    yield "scenario", kept
    yield "parameters/plant", {"robot": '""', "tick_rate": "2.0"}
    yield "parameters/coordinated_control", {"law": '"computed_torque"', "tick_rate": "2.0"}


def run_bag(
    path: Path,
    metadata: Sequence[tuple[str, dict[str, str]]],
    *,
    states: int = 3,
    joints: int = 3,
    urdf: bool = True,
    goals: bool = True,
) -> Path:
    with made_bag(path) as (bag, say):
        for name, values in metadata:
            bag.add_metadata(name, values)
        if urdf:
            bag.add_attachment("robot_description.urdf", urdf_of(1).encode(), "", 0)
        for k in range(states):
            time = 0.5 * k
            say("/odom", odometry(time, time, 0, 0, *TURNED, *[0] * 6), time)
            say("/momentum", array(*[0.0] * 7), time)
        for k in range(joints):
            say("/joint_states", joint_states(0.5 * k, ["joint_0"], [0.0], [0.0]), 0.5 * k)
        if goals:
            say("/goal_pose", pose(0.25, 0.1, 0.2, 0.3, 0, 0, 0, 1), 0.25)
            shape = JointState(name=["joint_0"], position=[0.125])
            say("/goal_joint_states", stamped(shape, 0.25), 0.25)
    return path


def test_a_run_has_the_goal_with_all_digits_as_it_was_sent(tmp_path: Path) -> None:
    flight = read_run(run_bag(tmp_path / "a.mcap", list(records())))
    goal = flight.goal
    assert goal is not None
    assert goal.position.tolist() == [0.1, 0.2, 0.30000000000000004]
    assert goal.joint_positions is not None
    assert goal.joint_positions.tolist() == [0.125]
    assert flight.scenario.commanders == ("coordinated_control",)
    (published,) = flight.scenario.published
    assert (published.quantity, published.printed, published.note) == ("time", [1.0, 2.0], "far")
    assert flight.required_robot().joint_names == ("joint_0",)
    assert flight.propellant is None
    assert flight.outcome is Outcome.INTERRUPTED


def test_a_run_to_another_goal_than_that_of_its_scenario_has_the_goal_that_was_flown(
    tmp_path: Path,
) -> None:
    """As in a bag of a stack that was kept running; its base ends at (1, 0, 0)."""
    about = list(records(goal_position="4 5 6", goal_asked="attitude position"))
    flight = read_run(run_bag(tmp_path / "a.mcap", about))
    assert flight.goal is not None
    assert flight.goal.position.tolist() == [0.1, 0.2, 0.3]
    assert flight.error is not None
    assert flight.error.distance == pytest.approx(math.sqrt(0.9**2 + 0.2**2 + 0.3**2))
    assert flight.scenario.published == ()


def test_goals_of_named_end_effectors_leave_the_base_free_unless_it_has_one(tmp_path: Path) -> None:
    hands = json.dumps({"left": [1, 2, 3], "right": [4, 5, 6, 0, 0, 0, 1]})
    for number, free in enumerate((True, False)):
        pose_of_base: dict[str, str | None] = dict.fromkeys(("goal_position",), None)
        about = records(end_effector_goals=hands, **(pose_of_base if free else {}))
        path = run_bag(tmp_path / f"{number}.mcap", list(about), goals=False)
        goal = read_run(path).scenario.goal
        assert [(each.link, each.position.tolist()) for each in goal.end_effectors] == [
            *(("left", [1.0, 2.0, 3.0]), ("right", [4.0, 5.0, 6.0]))
        ]
        assert goal.base == (frozenset() if free else {"position", "attitude"})
        assert goal.quaternion.tolist() == [0.0, 0.0, 0.0, 1.0]
        assert goal.position[2] == (0.0 if free else 0.30000000000000004)


@pytest.mark.parametrize(
    ("changed", "options", "reason"),
    [
        ({"goal_position": None}, {}, "lacks the goal or the parameters of its flight"),
        ({"goal_position": "a b c"}, {}, "lacks the goal"),
        ({}, {"urdf": False}, "contains no robot description."),
        ({}, {"states": 0}, "contains no states: there are no messages on /odom."),
        ({}, {"joints": 0}, "contains no states: there are no messages on /joint_states."),
        ({}, {"joints": 2}, "has 3 base poses and 2 joint states: the flight is"),
        ({}, {"goals": False}, "contains no goal pose."),
    ],
)
def test_a_run_that_is_not_whole_is_refused(
    tmp_path: Path, changed: dict[str, Any], options: dict[str, Any], reason: str
) -> None:
    path = run_bag(tmp_path / "a.mcap", list(records(**changed)), **options)
    with pytest.raises(RecordingError) as refused:
        read_run(path)
    assert reason in str(refused.value)
    assert str(refused.value).startswith(f"The bag {path} ")


def test_propellant_is_the_impulse_over_the_exhaust_speed() -> None:
    """The thrust of a state acts in the tick before it."""
    thrust = Signal(np.array([1.0, 1.5, 2.5]), np.array([[9.0, 9.0], [2.0, 0.0], [1.0, 4.0]]))
    used = impulse(thrust, np.array([0.5, 0.25]))
    assert used.time.tolist() == [1.0, 1.5, 2.5]
    assert used.values.tolist() == [[0.0], [0.5], [2.0]]


def test_totals_begin_anew_at_a_reset() -> None:
    """The states before and after it have the same stamp, or a reset is between two states."""
    time, force = np.array([1.0, 2.0, 2.0, 3.0]), np.array([[5.0], [1.0], [0.0], [4.0]])
    total = impulse(Signal(time, force), np.ones(1), [2.0])
    assert total.values.tolist() == [[0.0], [1.0], [0.0], [4.0]]
    broken = total.broken_at([2.0])
    assert broken.time.tolist() == [1.0, 2.0, 2.0, 2.0, 3.0]
    assert np.flatnonzero(np.isnan(broken.values)).tolist() == [2]
    np.testing.assert_array_equal(broken.at(time[[0, 1, 3]]), [[0.0], [np.nan], [4.0]])
    total = impulse(Signal(np.array([1.0, 2.0, 3.0]), np.full((3, 1), 5.0)), np.ones(1), [2.5])
    assert total.values.tolist() == [[0.0], [5.0], [5.0]]
    assert len(total.broken_at([0.5, 9.0])) == 3, "nothing was recorded before or after"
