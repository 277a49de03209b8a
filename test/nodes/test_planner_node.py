"""The planner node with the plant it flies, both in one executor and in lockstep."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path as FilePath
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import Log
from rcl_interfaces.srv import SetParameters
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.parameter import Parameter
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.ros_harness import (
    LATCHED,
    Harness,
    Probe,
    assert_one_sentence,
    construction,
    nanoseconds,
)
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import Marker, MarkerArray

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import PlannerNode, PlantNode

Array = npt.NDArray[np.float64]

URDF = FilePath(__file__).parents[2] / "urdf"
SLIDERS = ["slider_1", "slider_2", "slider_3"]
TICK_NS = 50_000_000

PLANT = {
    "robot": "sliding_masses",
    "time_mode": "lockstep",
    "tick_rate": 20.0,
    "marker_period": 0.0,
    "diagnostics_period": 0.0,
}
# A slide of 2 s in one swing and turns in cycles of 1 s: hundreds of ticks instead of 98,000.
PLANNER = {
    "robot": "sliding_masses",
    "tick_rate": 20.0,
    "lie_bracket.t1": 2.0,
    "lie_bracket.n1": 1,
    "lie_bracket.cycle_period": 1.0,
}
TOPICS = {
    "odom": Odometry,
    "joint_states": JointState,
    "joint_commands": JointState,
    "planner/status": DiagnosticStatus,
    "gait_schedule": JointTrajectory,
    "planned_path": Path,
}

HERE = ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0])
NEAR = ([0.05, -0.03, 0.02], [0.0, 0.0, 0.0])
TURNED = ([0.02, -0.03, 0.01], [0.01, -0.005, 0.015])
Place = tuple[Sequence[float], Sequence[float]]


def goal_at(place: Place, frame: str = "world") -> PoseStamped:
    """Return the goal pose at a position with a rotation vector."""
    position, rotvec = place
    message = PoseStamped()
    message.header.frame_id = frame
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = (float(x) for x in position)
    o.x, o.y, o.z, o.w = Rotation.from_rotvec(rotvec).as_quat().tolist()
    return message


def pose_arrays(pose: Any) -> tuple[Array, Rotation]:
    p, o = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z]), Rotation.from_quat([o.x, o.y, o.z, o.w])


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def stamp_of(message: Any) -> int:
    return nanoseconds(message.header.stamp)


class Flight:
    """A plant, a planner and a probe that sends goals and hears everything."""

    def __init__(
        self,
        harness: Harness,
        planner: dict[str, Any] | None = None,
        plant: dict[str, Any] | None = None,
    ) -> None:
        self.harness = harness
        self.plant = harness.make(PlantNode, {**PLANT, **(plant or {})}, autostart=False)
        self.planner = harness.make(PlannerNode, {**PLANNER, **(planner or {})}, autostart=False)
        self.probe = harness.probe(TOPICS)
        self.goals = self.probe.create_publisher(PoseStamped, "goal_pose", 10)
        for node in (self.plant, self.planner):
            assert node.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        assert self.planner.trigger_activate() is TransitionCallbackReturn.SUCCESS

    def start(self) -> None:
        """Let time run."""
        assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS

    def send(self, place: Place | PoseStamped) -> None:
        self.goals.publish(place if isinstance(place, PoseStamped) else goal_at(place))

    @property
    def states(self) -> list[str]:
        """The states that the planner has been in, as published."""
        return [values_of(s)["state"] for s in self.probe.messages["planner/status"]]

    def wait(self, *states: str) -> DiagnosticStatus:
        """Wait until the planner's latest state is one of these."""
        self.harness.spin_until(
            lambda: self.states and self.states[-1] in states,
            f"the planner is {' or '.join(states)}",
        )
        return self.probe.last("planner/status")

    def ticks(self, count: int) -> None:
        """Let this many ticks pass."""
        wanted = self.probe.count("joint_states") + count
        self.harness.spin_until(
            lambda: self.probe.count("joint_states") >= wanted, f"{count} more ticks"
        )

    def decide(self, place: Place | PoseStamped) -> DiagnosticStatus:
        """Send a goal and wait until it is decided; the status that decides it."""
        before = self.probe.count("planner/status")
        self.send(place)
        if not self.plant.is_active:
            self.start()
        self.harness.spin_until(
            lambda: any(s in ("reached", "failed", "refused") for s in self.states[before:]),
            "the goal is decided",
        )
        return self.probe.last("planner/status")

    def error_to(self, place: Place) -> tuple[float, float]:
        """Return how far the measured base is from a goal: m, rad."""
        position, attitude = pose_arrays(self.probe.last("odom").pose.pose)
        left = attitude.inv() * Rotation.from_rotvec(place[1])
        return float(np.linalg.norm(position - place[0])), float(left.magnitude())


# -- goals ------------------------------------------------------------------------------------


def test_a_goal_is_met_within_tolerance(harness: Harness) -> None:
    flight = Flight(harness, {"position_tolerance": 2e-3, "attitude_tolerance": 3e-4})
    status = flight.decide(TURNED)
    assert flight.states == ["idle", "executing", "reached"]
    distance, angle = flight.error_to(TURNED)
    assert distance <= 2e-3
    assert angle <= 3e-4
    values = values_of(status)
    assert status.level == DiagnosticStatus.OK
    assert status.name == "/planner"
    assert_one_sentence(status.message, "met")
    assert float(values["position_error_m"]) == pytest.approx(distance, rel=1e-3, abs=1e-9)
    assert float(values["attitude_error_rad"]) == pytest.approx(angle, rel=1e-3, abs=1e-9)
    assert [float(x) for x in values["goal"].split()[:3]] == TURNED[0]
    assert values["corrections"] == "0"
    # The robot stays there.
    flight.ticks(20)
    assert flight.error_to(TURNED) == pytest.approx((distance, angle), abs=1e-9)
    assert flight.states[-1] == "reached"


def test_every_state_is_answered_with_one_command_of_its_stamp(harness: Harness) -> None:
    flight = Flight(harness)
    flight.decide(NEAR)
    flight.ticks(5)
    states = [stamp_of(m) for m in flight.probe.messages["joint_states"]]
    commands = [stamp_of(m) for m in flight.probe.messages["joint_commands"]]
    assert states == [k * TICK_NS for k in range(len(states))]
    assert commands == states[: len(commands)]
    assert len(states) - len(commands) <= 1
    for message in flight.probe.messages["joint_commands"]:
        assert list(message.name) == SLIDERS
        assert np.all(np.isfinite([*message.position, *message.velocity]))


def test_goals_are_flown_one_after_the_other(harness: Harness) -> None:
    flight = Flight(harness)
    for place in (NEAR, TURNED, HERE):
        assert values_of(flight.decide(place))["state"] == "reached"
        distance, angle = flight.error_to(place)
        assert distance <= 1e-3
        assert angle <= 1e-3


def test_the_pose_that_is_already_there_is_reached(harness: Harness) -> None:
    flight = Flight(harness)
    status = flight.decide(HERE)
    assert flight.states[-1] == "reached"
    assert_one_sentence(status.message, "met")
    (schedule,) = flight.probe.messages["gait_schedule"]
    assert len(schedule.points) <= 2
    flight.ticks(5)
    assert not any(any(m.velocity) for m in flight.probe.messages["joint_states"])


def test_a_goal_without_a_frame_is_taken_in_the_world(harness: Harness) -> None:
    flight = Flight(harness, {"world_frame": "map"}, {"world_frame": "map"})
    flight.send(goal_at(NEAR, frame=""))
    flight.start()
    flight.wait("reached")
    assert flight.probe.last("planned_path").header.frame_id == "map"
    flight.send(goal_at(HERE, frame="world"))
    assert_one_sentence(flight.wait("refused").message, "'world'", "'map'")


def test_a_quaternion_of_any_length_is_an_attitude(harness: Harness) -> None:
    flight = Flight(harness)
    goal = goal_at(TURNED)
    o = goal.pose.orientation
    o.x, o.y, o.z, o.w = (-3.0 * value for value in (o.x, o.y, o.z, o.w))
    flight.send(goal)
    flight.start()
    flight.wait("reached")
    assert max(flight.error_to(TURNED)) <= 1e-3


def changed(place: Place = NEAR, frame: str = "world", **fields: float) -> PoseStamped:
    goal = goal_at(place, frame)
    for name, value in fields.items():
        part = goal.pose.orientation if name.startswith("q") else goal.pose.position
        setattr(part, name[-1], value)
    return goal


REFUSED = {
    "beyond stroke": (
        # 16 kg / 2 kg times 0.4 m is 3.2 m of slide.
        changed(x=-0.4, y=0.0, z=0.0),
        ("beyond stroke", "'slider_1'", "3.2 m", "[-2.5, 2.5] m"),
    ),
    "another frame": (changed(frame="moon"), ("'moon'", "'world'")),
    "position not a number": (changed(y=math.nan), ("position", "not finite")),
    "endless position": (changed(z=math.inf), ("position", "not finite")),
    "orientation not a number": (changed(qx=math.nan), ("orientation", "not finite")),
    "zero quaternion": (changed(qw=0.0), ("orientation", "zero quaternion")),
}


def test_what_cannot_be_done_is_refused_and_the_next_goal_flies(harness: Harness) -> None:
    flight = Flight(harness)
    flight.start()
    for goal, mentions in REFUSED.values():
        status = flight.decide(goal)
        assert flight.states[-1] == "refused"
        assert status.level == DiagnosticStatus.ERROR
        assert_one_sentence(status.message, *mentions)
    flight.ticks(3)
    assert not any(any(m.velocity) for m in flight.probe.messages["joint_states"])
    assert not flight.probe.messages["gait_schedule"]
    flight.decide(NEAR)
    assert flight.states == ["idle", *["refused"] * len(REFUSED), "executing", "reached"]
    assert max(flight.error_to(NEAR)) <= 1e-3


@pytest.mark.parametrize("case", ["beyond stroke", "another frame"])
def test_a_refused_goal_does_not_disturb_the_one_that_is_flown(harness: Harness, case: str) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(10)
    flight.send(REFUSED[case][0])
    flight.wait("refused")
    flight.wait("reached")
    assert flight.states == ["idle", "executing", "refused", "reached"]
    assert max(flight.error_to(NEAR)) <= 1e-3
    assert len(flight.probe.messages["gait_schedule"]) == 1


def test_a_drifting_robot_is_refused_with_the_true_reason(harness: Harness) -> None:
    flight = Flight(harness, plant={"linear_momentum": [0.3, -0.4, 0.0]})
    status = flight.decide(NEAR)
    assert flight.states == ["idle", "refused"]
    assert_one_sentence(status.message, "drifts", "momentum", "0.5 kg m/s")


def test_a_turning_robot_is_refused_with_the_true_reason(harness: Harness) -> None:
    flight = Flight(harness, plant={"angular_momentum": [0.0, 0.0, 0.25]})
    status = flight.decide(NEAR)
    assert flight.states == ["idle", "refused"]
    assert_one_sentence(status.message, "momentum", "0.25 kg m^2/s")


def test_a_robot_that_the_method_cannot_steer_is_refused(harness: Harness) -> None:
    flight = Flight(harness, {"robot": "planar_chain"}, {"robot": "planar_chain"})
    status = flight.decide(TURNED)
    assert flight.states == ["idle", "refused"]
    assert_one_sentence(status.message, "three sliders", "planar_chain")


# -- preemption and abortion ------------------------------------------------------------------


def test_a_new_goal_replaces_the_one_that_is_flown(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(([-0.1, 0.0, 0.05], [0.0, 0.0, 0.0]))
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    assert any(flight.probe.last("joint_states").velocity), "the first goal is being flown"
    flight.decide(TURNED)
    assert flight.states == ["idle", "executing", "executing", "reached"]
    distance, angle = flight.error_to(TURNED)
    assert max(distance, angle) <= 1e-3
    first, second = flight.probe.messages["gait_schedule"]
    ends = stamp_of(first) + nanoseconds(first.points[-1].time_from_start)
    assert stamp_of(first) < stamp_of(second) < ends
    # The second begins at the shape that the first had come to.
    at_switch = next(
        m for m in flight.probe.messages["joint_states"] if stamp_of(m) == stamp_of(second)
    )
    np.testing.assert_array_equal(second.points[0].positions, at_switch.position)
    # No joint stops dead: what was flown comes to rest before the second gait begins.
    after = next(
        m
        for m in flight.probe.messages["joint_states"]
        if stamp_of(m) == stamp_of(second) + TICK_NS
    )
    before, now = np.array(at_switch.velocity), np.array(after.velocity)
    assert np.abs(before).max() > 0.01
    assert np.abs(now - before).max() < 0.2 * np.abs(before).max()


def test_the_rest_is_planned_again_when_the_base_drifts_off_its_path(
    harness: Harness, tmp_path: FilePath
) -> None:
    """The base is heavier than the planner believes, so that it does not go where it should."""
    urdf = (URDF / "sliding_masses.urdf").read_text("utf-8")
    heavier = tmp_path / "heavier.urdf"
    heavier.write_text(urdf.replace('<mass value="10"/>', '<mass value="13"/>'), "utf-8")
    flight = Flight(
        harness, {"drift_position": 2e-3, "max_corrections": 10}, {"robot": str(heavier)}
    )
    flight.decide(NEAR)
    first, second = flight.probe.messages["gait_schedule"][:2]
    ends = stamp_of(first) + nanoseconds(first.points[-1].time_from_start)
    assert stamp_of(first) < stamp_of(second) < ends
    assert flight.states[-1] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


def test_small_drift_is_left_to_the_end(harness: Harness) -> None:
    flight = Flight(harness, {"drift_position": 2e-3, "drift_attitude": 2e-3})
    flight.decide(NEAR)
    assert flight.states == ["idle", "executing", "reached"]


def distance_from(path: Array, shape: Array) -> float:
    """Return how far a shape is from the polygon through the shapes of a path."""
    legs = np.diff(path, axis=0)
    lengths = np.maximum((legs**2).sum(axis=1), 1e-30)
    share = np.clip(((shape - path[:-1]) * legs).sum(axis=1) / lengths, 0.0, 1.0)
    nearest = path[:-1] + share[:, np.newaxis] * legs
    return float(np.linalg.norm(shape - nearest, axis=1).min())


def test_abortion_brings_the_joints_to_rest(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    assert any(flight.probe.last("joint_states").velocity)
    client = flight.probe.create_client(Trigger, "planner/abort")
    answer = harness.call(client, Trigger.Request())
    assert answer.success
    status = flight.wait("aborted")
    assert status.level == DiagnosticStatus.WARN
    assert_one_sentence(status.message)
    began = flight.probe.count("joint_states")
    flight.ticks(10**9 // TICK_NS + 3)  # abort_time, and commands that were on their way.
    braking = flight.probe.messages["joint_states"][began:]
    place = list(braking[-1].position)
    (schedule,) = flight.probe.messages["gait_schedule"]
    path = np.array([point.positions for point in schedule.points])
    for state in braking:
        assert distance_from(path, np.array(state.position)) < 1e-9, "it rests on its path"
    speeds = [np.abs(m.velocity).max() for m in braking]
    assert max(np.abs(np.diff(speeds))) < 0.5 * max(speeds), "and does not stop dead"
    flight.ticks(60)
    assert list(flight.probe.last("joint_states").position) == place
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3
    assert flight.states == ["idle", "executing", "aborted"]
    answer = harness.call(client, Trigger.Request())
    assert not answer.success
    assert answer.message
    flight.decide(NEAR)
    assert flight.states[-1] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


def test_a_goal_that_waits_for_a_state_can_be_aborted(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    harness.settle(flight.probe)
    harness.call(flight.probe.create_client(Trigger, "planner/abort"), Trigger.Request())
    flight.start()
    flight.ticks(10)
    assert not flight.probe.messages["gait_schedule"]


def test_a_reset_of_the_plant_does_not_keep_the_goal_from_being_met(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(15)
    harness.call(flight.probe.create_client(Trigger, "plant/reset"), Trigger.Request())
    flight.wait("reached", "failed")
    assert flight.states[-1] == "reached"
    assert max(flight.error_to(NEAR)) <= 1e-3


# -- what it announces ------------------------------------------------------------------------


@pytest.fixture
def flown(harness: Harness) -> Flight:
    """Return a flight with a slide and a turn, from a pose and a shape that are not zero."""
    flight = Flight(
        harness,
        {"position_tolerance": 2e-3, "attitude_tolerance": 2e-3},
        {
            "initial_position": [1.0, -0.5, 0.25],
            "initial_orientation": Rotation.from_rotvec([0.4, -0.3, 0.2]).as_quat().tolist(),
            "initial_joint_positions": [0.2, -0.1, 0.15],
        },
    )
    status = flight.decide(([1.01, -0.52, 0.26], [0.41, -0.31, 0.215]))
    assert values_of(status)["state"] == "reached", status.message
    return flight


def test_the_schedule_is_what_is_flown(flown: Flight) -> None:
    (schedule,) = flown.probe.messages["gait_schedule"]
    assert list(schedule.joint_names) == SLIDERS
    assert schedule.header.frame_id == "base_link"
    measured = {stamp_of(m): m for m in flown.probe.messages["joint_states"]}
    start = stamp_of(schedule)
    assert len(schedule.points) > 100
    for k, point in enumerate(schedule.points):
        assert nanoseconds(point.time_from_start) == k * TICK_NS
        state = measured[start + k * TICK_NS]
        np.testing.assert_allclose(point.positions, state.position, rtol=0, atol=1e-9)
        if k:
            held = schedule.points[k - 1].velocities
            np.testing.assert_allclose(held, state.velocity, rtol=0, atol=1e-9)
    assert list(schedule.points[-1].velocities) == [0.0] * 3


def test_the_path_is_what_is_flown(flown: Flight) -> None:
    (path,) = flown.probe.messages["planned_path"]
    measured = {stamp_of(m): m.pose.pose for m in flown.probe.messages["odom"]}
    assert path.header.frame_id == "world"
    assert len(path.poses) > 20
    for knot in path.poses:
        assert knot.header.frame_id == "world"
        planned, flown_there = pose_arrays(knot.pose), pose_arrays(measured[stamp_of(knot)])
        np.testing.assert_allclose(planned[0], flown_there[0], rtol=0, atol=1e-9)
        assert (planned[1].inv() * flown_there[1]).magnitude() <= 1e-9


def test_schedule_and_path_fit_each_other(flown: Flight) -> None:
    (schedule,), (path,) = (flown.probe.messages[t] for t in ("gait_schedule", "planned_path"))
    assert path.header.stamp == schedule.header.stamp
    assert stamp_of(path.poses[0]) == stamp_of(schedule)
    times = [stamp_of(knot) - stamp_of(schedule) for knot in path.poses]
    assert times == sorted(set(times))
    assert times[-1] == nanoseconds(schedule.points[-1].time_from_start)
    status = next(
        values_of(s)
        for s in flown.probe.messages["planner/status"]
        if values_of(s)["state"] == "executing"
    )
    assert float(status["duration_s"]) == pytest.approx(times[-1] / 1e9)
    assert status["method"] == "lie_bracket"
    # Three 2 kg masses on the axes of a 10 kg base: the centre of mass is at q / 8, and it rests.
    centres = []
    for time, knot in zip(times, path.poses, strict=True):
        position, attitude = pose_arrays(knot.pose)
        shape = np.array(schedule.points[time // TICK_NS].positions)
        centres.append(position + attitude.apply(shape / 8))
    np.testing.assert_allclose(centres, np.tile(centres[0], (len(centres), 1)), atol=1e-12)


def test_schedule_path_and_status_are_there_for_a_late_reader(flown: Flight) -> None:
    latched = ("gait_schedule", "planned_path", "planner/status")
    late = flown.harness.probe({t: TOPICS[t] for t in latched}, latched=latched, name="late")
    flown.harness.spin_until(lambda: all(late.count(t) for t in latched), "the latched topics")
    for topic in latched:
        assert late.count(topic) == 1
        assert late.last(topic) == flown.probe.last(topic)


def test_markers_show_the_goal_and_the_path(harness: Harness) -> None:
    flight = Flight(harness)
    flight.probe.watch("markers", MarkerArray)
    harness.connect()
    flight.decide(NEAR)
    (array,) = flight.probe.messages["markers"]
    ghosts = [m for m in array.markers if m.ns == "goal"]
    assert ghosts
    for ghost in ghosts:
        position, attitude = pose_arrays(ghost.pose)
        np.testing.assert_allclose(position, NEAR[0])
        assert attitude.magnitude() == 0.0
    (line,) = (m for m in array.markers if m.type == Marker.LINE_STRIP)
    path = flight.probe.last("planned_path")
    assert [(p.x, p.y, p.z) for p in line.points] == [
        (k.pose.position.x, k.pose.position.y, k.pose.position.z) for k in path.poses
    ]


# -- corrections ------------------------------------------------------------------------------


def test_a_tolerance_that_is_tightened_in_flight_makes_corrections_happen(harness: Harness) -> None:
    # Wide tolerances and one large cycle: a first order that is some way off.
    flight = Flight(
        harness,
        {
            "position_tolerance": 0.1,
            "attitude_tolerance": 0.1,
            "lie_bracket.loop_area": 10.0,
            "max_corrections": 5,
        },
    )
    flight.send(TURNED)
    flight.start()
    flight.wait("executing")
    request = SetParameters.Request(
        parameters=[
            Parameter(f"{what}_tolerance", value=1e-6).to_parameter_msg()
            for what in ("position", "attitude")
        ]
    )
    client = flight.probe.create_client(SetParameters, "planner/set_parameters")
    assert [r.successful for r in harness.call(client, request).results] == [True, True]
    status = flight.wait("reached", "failed")
    assert values_of(status)["state"] == "reached", status.message
    assert max(flight.error_to(TURNED)) <= 1e-6
    corrections = int(values_of(status)["corrections"])
    assert corrections >= 1
    assert flight.states == ["idle", "executing", *["executing"] * corrections, "reached"]
    assert len(flight.probe.messages["gait_schedule"]) == 1 + corrections


def test_a_goal_that_is_missed_fails_with_a_sentence(harness: Harness) -> None:
    flight = Flight(
        harness,
        {
            "position_tolerance": 0.1,
            "attitude_tolerance": 0.1,
            "lie_bracket.loop_area": 10.0,
            "max_corrections": 0,
        },
    )
    flight.send(TURNED)
    flight.start()
    flight.wait("executing")
    flight.planner.set_parameters([Parameter("attitude_tolerance", value=1e-9)])
    status = flight.wait("failed")
    assert status.level == DiagnosticStatus.ERROR
    assert_one_sentence(status.message, "not met", "0 correction(s)")
    flight.ticks(10)
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3


def test_a_bad_change_in_flight_is_refused(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    cases: list[tuple[str, Any, str]] = [
        ("position_tolerance", -1.0, "position_tolerance"),
        ("max_corrections", -1, "max_corrections"),
        # What follows rclpy itself refuses.
        ("attitude_tolerance", "small", "DOUBLE"),
        ("max_corrections", 2.5, "INTEGER"),
        ("tick_rate", 50.0, "tick_rate"),
    ]
    for name, value, mention in cases:
        before = flight.planner.get_parameter(name).value
        (result,) = flight.planner.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert mention in result.reason
        assert flight.planner.get_parameter(name).value == before
    flight.wait("reached")
    assert max(flight.error_to(NEAR)) <= 1e-3


# -- where the robot comes from ---------------------------------------------------------------


def test_without_a_robot_it_takes_the_one_of_the_plant(harness: Harness) -> None:
    planner = harness.make(PlannerNode, {**PLANNER, "robot": ""})
    probe = harness.probe(TOPICS)
    goals = probe.create_publisher(PoseStamped, "goal_pose", 10)
    harness.connect()
    assert planner.is_active
    goals.publish(goal_at(NEAR))
    harness.spin_until(
        lambda: any("robot_description" in s.message for s in probe.messages["planner/status"]),
        "a word that the goal waits for a robot",
    )
    harness.make(PlantNode, PLANT)
    harness.spin_until(
        lambda: values_of(probe.last("planner/status"))["state"] in ("reached", "failed"),
        "the goal is decided",
    )
    assert values_of(probe.last("planner/status"))["state"] == "reached"
    position, _ = pose_arrays(probe.last("odom").pose.pose)
    np.testing.assert_allclose(position, NEAR[0], atol=1e-3)


class FakePlant:
    """States and a description, published one by one as a test wants them."""

    def __init__(self, harness: Harness, parameters: dict[str, Any]) -> None:
        self.harness = harness
        self.planner = harness.make(PlannerNode, {**PLANNER, **parameters}, autostart=False)
        topics = {"joint_commands": JointState, "planner/status": DiagnosticStatus, "/rosout": Log}
        self.probe: Probe = harness.probe(topics)
        self.goals = self.probe.create_publisher(PoseStamped, "goal_pose", 10)
        self.description = self.probe.create_publisher(String, "robot_description", LATCHED)
        self.odom = self.probe.create_publisher(Odometry, "odom", 10)
        self.joints = self.probe.create_publisher(JointState, "joint_states", 10)
        assert self.planner.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()

    def describe(self, text: str | None = None) -> None:
        given = (URDF / "sliding_masses.urdf").read_text("utf-8") if text is None else text
        self.description.publish(String(data=given))

    def show(
        self,
        tick: int = 0,
        joints_first: bool = False,
        rates: bool = True,
        x: float = 0.0,
        **joints: float,
    ) -> None:
        odom = Odometry(child_frame_id="base_link")
        odom.pose.pose.position.x = x
        odom.header.frame_id = "world"
        odom.pose.pose.orientation.w = 1.0
        places = joints or dict.fromkeys(SLIDERS, 0.0)
        state = JointState(
            name=list(places),
            position=list(places.values()),
            velocity=[0.0] * len(places) if rates else [],
            effort=[0.0] * len(places),
        )
        for message in (odom, state):
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(tick * TICK_NS, 10**9)
        pairs = [(self.odom, odom), (self.joints, state)]
        for publisher, message in reversed(pairs) if joints_first else pairs:
            publisher.publish(message)

    def answers(self, count: int) -> list[JointState]:
        self.harness.spin_until(
            lambda: self.probe.count("joint_commands") >= count, f"{count} command(s)"
        )
        return list(self.probe.messages["joint_commands"])


@pytest.mark.parametrize("joints_first", [False, True])
def test_a_state_is_complete_with_odom_and_joints_in_any_order(
    harness: Harness, joints_first: bool
) -> None:
    fake = FakePlant(harness, {})
    fake.planner.trigger_activate()
    for tick in range(3):
        fake.show(tick, joints_first)
        fake.answers(tick + 1)
    harness.settle(fake.probe)
    assert [stamp_of(m) for m in fake.answers(3)] == [0, TICK_NS, 2 * TICK_NS]
    assert fake.probe.count("joint_commands") == 3


def test_a_state_that_is_shown_again_is_answered_once_and_whole(harness: Harness) -> None:
    # As after a reset of the plant: the same tick, another state.
    fake = FakePlant(harness, {})
    fake.planner.trigger_activate()
    fake.show(0)
    fake.answers(1)
    fake.show(0, slider_1=0.1, slider_2=0.2, slider_3=0.3)
    fake.answers(2)
    harness.settle(fake.probe)
    assert [list(m.position) for m in fake.answers(2)] == [[0.0, 0.0, 0.0], [0.1, 0.2, 0.3]]


def test_joint_states_go_by_name_and_not_by_place(harness: Harness) -> None:
    fake = FakePlant(harness, {})
    fake.planner.trigger_activate()
    fake.show(0, slider_3=0.3, slider_1=0.1, slider_2=0.2)
    (command,) = fake.answers(1)
    assert dict(zip(command.name, command.position, strict=True)) == {
        "slider_1": 0.1,
        "slider_2": 0.2,
        "slider_3": 0.3,
    }


def test_joint_states_of_another_robot_are_refused_with_a_reason(harness: Harness) -> None:
    fake = FakePlant(harness, {})
    fake.planner.trigger_activate()
    fake.show(0, elbow=0.3)
    harness.spin_until(
        lambda: any("elbow" in m.msg for m in fake.probe.messages["/rosout"]),
        "a word on the unknown joint",
    )
    fake.show(1)
    assert [stamp_of(m) for m in fake.answers(1)] == [TICK_NS]


def test_joint_states_that_lack_a_joint_are_refused_with_a_reason(harness: Harness) -> None:
    # Zero would be a guess, and the plan would start from it.
    fake = FakePlant(harness, {})
    fake.planner.trigger_activate()
    fake.show(0, slider_1=0.1, slider_3=0.3)
    harness.spin_until(
        lambda: any("slider_2" in m.msg for m in fake.probe.messages["/rosout"]),
        "a word on the joint that is missing",
    )
    fake.show(1)
    assert [stamp_of(m) for m in fake.answers(1)] == [TICK_NS]


def test_joint_states_without_velocities_do_not_end_the_planner(harness: Harness) -> None:
    fake = FakePlant(harness, {})
    fake.planner.trigger_activate()
    fake.goals.publish(goal_at(NEAR))
    harness.settle(fake.probe)
    fake.show(0, rates=False)
    # Flown as from rest, or refused with a reason.
    harness.spin_until(
        lambda: values_of(fake.probe.last("planner/status"))["state"] in ("executing", "refused"),
        "the goal is decided",
    )
    count = fake.probe.count("joint_commands")
    fake.show(1)
    fake.answers(count + 1)


@pytest.mark.parametrize("broken", [{"x": math.nan}, dict.fromkeys(SLIDERS, math.nan)])
def test_a_state_that_is_not_finite_does_not_end_the_planner(
    harness: Harness, broken: dict[str, float]
) -> None:
    fake = FakePlant(harness, {})
    fake.planner.trigger_activate()
    fake.goals.publish(goal_at(NEAR))
    harness.settle(fake.probe)
    fake.show(0, **broken)  # type: ignore[arg-type]
    harness.settle(fake.probe)
    assert values_of(fake.probe.last("planner/status"))["state"] != "executing"
    fake.goals.publish(goal_at(NEAR))
    harness.settle(fake.probe)
    fake.show(1)
    harness.spin_until(
        lambda: values_of(fake.probe.last("planner/status"))["state"] == "executing",
        "a plan from a state that is finite",
    )
    for command in fake.probe.messages["joint_commands"]:
        assert np.all(np.isfinite(command.velocity))


def test_a_broken_description_is_refused_and_the_next_is_taken(harness: Harness) -> None:
    fake = FakePlant(harness, {"robot": ""})
    fake.planner.trigger_activate()
    fake.describe("<robot")
    harness.spin_until(
        lambda: any("not valid URDF" in m.msg for m in fake.probe.messages["/rosout"]),
        "a word on the broken description",
    )
    fake.describe()
    harness.settle(fake.probe)
    fake.show(0)
    fake.answers(1)


def test_a_state_from_before_the_description_is_answered(harness: Harness) -> None:
    # In lockstep the plant waits for that answer.
    fake = FakePlant(harness, {"robot": ""})
    fake.planner.trigger_activate()
    fake.show(0)
    harness.settle(fake.probe)
    fake.describe()
    fake.answers(1)


def test_a_state_from_before_the_activation_is_answered(harness: Harness) -> None:
    fake = FakePlant(harness, {})
    fake.show(0)
    harness.settle(fake.probe)
    assert fake.probe.count("joint_commands") == 0
    fake.planner.trigger_activate()
    fake.answers(1)


# -- managed life -----------------------------------------------------------------------------


def test_a_deactivated_planner_is_silent_and_goes_on_when_activated(harness: Harness) -> None:
    flight = Flight(harness)
    flight.send(NEAR)
    flight.start()
    flight.wait("executing")
    flight.ticks(10)
    flight.planner.trigger_deactivate()
    harness.settle(flight.probe)
    commands = flight.probe.count("joint_commands")
    flight.send(TURNED)
    harness.settle(flight.probe)
    assert flight.probe.count("joint_commands") == commands
    flight.planner.trigger_activate()
    flight.ticks(5)
    assert list(flight.probe.last("joint_states").velocity) == [0.0] * 3, "the goal was given up"
    assert values_of(flight.decide(NEAR))["state"] == "reached"


def test_a_planner_is_cleaned_up_and_configured_again(harness: Harness) -> None:
    flight = Flight(harness)
    flight.decide(NEAR)
    flight.plant.trigger_deactivate()
    for name in ("deactivate", "cleanup"):
        getattr(flight.planner, f"trigger_{name}")()
    harness.spin_until(
        lambda: not flight.probe.count_publishers("joint_commands"), "the end of joint_commands"
    )
    for topic in ("planner/status", "gait_schedule", "planned_path"):
        assert flight.probe.count_publishers(topic) == 0
    assert flight.planner.trigger_configure() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    assert flight.planner.trigger_activate() is TransitionCallbackReturn.SUCCESS
    assert values_of(flight.decide(TURNED))["state"] == "reached"


# -- parameters -------------------------------------------------------------------------------

BAD: dict[str, tuple[dict[str, Any], tuple[str, ...]]] = {
    "method": ({"method": "wings"}, ("'method'", "wings", "lie_bracket")),
    "robot": ({"robot": "octopus"}, ("'robot'", "octopus")),
    "description": ({"robot_description": "<robot/>"}, ("robot",)),
    "tick rate": ({"tick_rate": 0}, ("'tick_rate'", "Hz")),
    "position tolerance": ({"position_tolerance": -1e-3}, ("'position_tolerance'", "m")),
    "attitude tolerance": ({"attitude_tolerance": math.nan}, ("'attitude_tolerance'",)),
    "corrections": ({"max_corrections": 1.5}, ("'max_corrections'", "whole number")),
    "shape gain": ({"shape_gain": "strong"}, ("'shape_gain'", "strong")),
    "option of the method": ({"lie_bracket.t1": 0.0}, ("'lie_bracket.t1'", "s")),
    "whole option": ({"lie_bracket.n1": 1.5}, ("'lie_bracket.n1'", "whole number")),
    "option as text": ({"lie_bracket.cycle_period": "3 s"}, ("'lie_bracket.cycle_period'",)),
}


@pytest.mark.parametrize(("parameters", "mentions"), BAD.values(), ids=BAD)
def test_a_bad_parameter_is_refused_with_a_sentence_that_names_it(
    ros_context: rclpy.Context, parameters: dict[str, Any], mentions: tuple[str, ...]
) -> None:
    with pytest.raises(SpaceRobotError) as refusal:
        PlannerNode(**construction(ros_context, {**PLANNER, **parameters}))
    assert_one_sentence(str(refusal.value), *mentions)


@pytest.fixture(autouse=True)
def _nobody_else(harness: Harness) -> Iterator[None]:
    """Check that no test was disturbed by another plant in its domain."""
    yield
    stranger = Probe({}, context=harness.context, name="stranger")
    assert stranger.count_publishers("odom") <= 1
    stranger.destroy_node()
