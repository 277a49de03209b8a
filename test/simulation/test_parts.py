"""Parts of the plant by themselves: events of statuses, stops, approaches, reports and poses."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.model.grasp import BodyMotion, GraspImpact
from spacerobot_ros.parameters import configured
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import capture, effort_plant, sensors, status
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.capture import CaptureReport, GrappleMotion, ReleaseReport
from spacerobot_ros.simulation.config import CaptureConfig, PlantConfig, TargetConfig
from spacerobot_ros.simulation.status import PlantState, PlantStatus

RUNNING = PlantStatus(PlantState.RUNNING, "It runs.", time_s=7.5)

E = EventKind


# -- status -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("before", "now", "events"),
    [
        ({}, {"resets": 1}, [(E.RESET, 0, {})]),
        ({"rearms": 2}, {"rearms": 1}, [(E.REARMED, 0, {})]),
        ({}, {"latched_fault": "stuck", "reason": "abort"},
         [(E.LATCHED, 2, {"reason": "abort"})]),
        ({"latched_fault": "stuck"}, {"latched_fault": "hot", "reason": "watchdog"},
         [(E.LATCHED, 2, {"reason": "watchdog"})]),
        ({"latched_fault": "stuck"}, {"latched_fault": "stuck"}, []),
        ({"latched_fault": "stuck"}, {}, []),
        ({"faults": ("a", "b")}, {"faults": ("b", "c")},
         [(E.FAULT_INJECTED, 1, {"fault": "c"}), (E.FAULT_ENDED, 0, {"fault": "a"})]),
        ({"faults": ("a",)}, {},
         [(E.FAULT_ENDED, 0, {"fault": "a"}), (E.FAULTS_CLEARED, 0, {})]),
        ({"disturbances": ("a", "b")}, {"disturbances": ("b", "c")},
         [(E.DISTURBANCE, 1, {"disturbance": "c"}),
          (E.DISTURBANCE_ENDED, 0, {"disturbance": "a"})]),
        ({"state": PlantState.PAUSED}, {}, [(E.RESUMED, 0, {}), (E.RUNNING, 0, {})]),
        ({"state": PlantState.PAUSED}, {"state": PlantState.INACTIVE}, []),
        ({"state": PlantState.LATCHED}, {}, [(E.RUNNING, 0, {})]),
        ({}, {"state": PlantState.PAUSED}, [(E.PAUSED, 0, {})]),
        ({}, {"state": PlantState.FAILED, "reason": "model"}, []),
        ({}, {"state": PlantState.RESTING, "reason": "timeout"},
         [(E.RESTING, 1, {"reason": "timeout"})]),
        ({}, {"state": PlantState.RESTING, "reason": "no_command"},
         [(E.RESTING, 0, {"reason": "no_command"})]),
        ({"state": PlantState.RESTING, "reason": "no_command"},
         {"state": PlantState.RESTING, "reason": "timeout"},
         [(E.RESTING, 1, {"reason": "timeout"})]),
        ({"state": PlantState.RESTING, "reason": "timeout"},
         {"state": PlantState.RESTING, "reason": "no_command"},
         [(E.RESTING, 0, {"reason": "no_command"})]),
        ({"reason": "abort"}, {"reason": "watchdog"}, []),
    ],
)  # fmt: skip
def test_each_change_of_a_status_has_its_event(
    before: dict[str, Any], now: dict[str, Any], events: list[Any]
) -> None:
    found = status._events_between(replace(RUNNING, **before), replace(RUNNING, **now))
    assert [(each.kind, each.level, dict(each.about)) for each in found] == events
    assert {each.time_s for each in found} <= {7.5}


def test_events_of_a_status_are_sentences_in_a_plausible_order() -> None:
    before = PlantStatus(PlantState.PAUSED, faults=("a",), disturbances=("push",))
    now = PlantStatus(
        *(PlantState.RUNNING, "It runs.", "", "broken", 3.0, 1, 1, (), ("pull",)),
    )
    assert [each.message for each in status._events_between(before, now)] == [
        "The robot is back in its initial state.",
        "Commands pass again.",
        "A fault is latched: broken.",
        "A fault has ended: a.",
        "No fault is active any more.",
        "A disturbance begins: pull.",
        "A disturbance has ended: push.",
        "Time goes on.",
        "It runs.",
    ]
    (begun,) = status._events_between(now, replace(now, faults=("stuck",)))
    assert begun.message == "A fault begins: stuck."


@pytest.mark.parametrize(
    ("changes", "level"),
    [
        ({}, 0),
        ({"reason": "no_command", "state": PlantState.RESTING}, 0),
        ({"reason": "timeout", "state": PlantState.RESTING}, 1),
        ({"faults": ("a",)}, 1),
        ({"disturbances": ("a",)}, 1),
        ({"latched_fault": "a"}, 2),
        ({"state": PlantState.LATCHED}, 2),
        ({"state": PlantState.FAILED}, 2),
        ({"state": PlantState.PAUSED}, 0),
    ],
)
def test_a_status_has_the_level_of_its_worst_part(changes: dict[str, Any], level: int) -> None:
    assert replace(RUNNING, **changes).level == level


def test_a_status_is_pairs_of_words() -> None:
    bare = {
        "state": "running",
        "reason": "",
        "latched_fault": "",
        "time_s": "7.500000000",
        "rearms": "0",
        "resets": "0",
        "timeouts": "0",
        "faults": "",
    }
    assert RUNNING.to_values() == bare
    whole = PlantStatus(
        *(PlantState.RESTING, "", "timeout", "hot", 0.25, 3, 4, ("a", "b"), ("c", "d"), 5, 0.0, "x")
    )
    values = whole.to_values()
    assert values["faults"] == "a; b"
    assert {name: values[name] for name in ("rearms", "resets", "timeouts", "payload")} == {
        **{"rearms": "3", "resets": "4", "timeouts": "5", "payload": "x"}
    }
    assert (values["last_command_s"], values["latched_fault"]) == ("0.000000000", "hot")
    assert PlantStatus.from_values(values) == whole
    assert PlantStatus.from_values({"state": "failed"}, "m") == PlantStatus(PlantState.FAILED, "m")


@pytest.mark.parametrize(
    ("activity", "message", "latched"),
    [
        (PlantState.INACTIVE, "The plant is inactive", ", and a fault is latched: hot"),
        (PlantState.PAUSED, "Time is stopped until '~/pause' resumes it",
         ", and a fault is latched: hot"),
    ],
)  # fmt: skip
def test_a_plant_at_rest_says_whether_a_fault_is_latched(
    activity: PlantState, message: str, latched: str
) -> None:
    monitor: Any = object.__new__(status.PlantMonitor)
    for fault, wanted in (("", f"{message}."), ("hot", f"{message}{latched}.")):
        monitor._commands = SimpleNamespace(fault=fault, fault_reason="abort" if fault else "")
        found = monitor._status(activity)
        assert (found.message, found.latched_fault, found.state) == (wanted, fault, activity)
        assert found.reason == ("abort" if fault else "")


# -- stops of joints -----------------------------------------------------------------------------


def stops_of(lower: list[float], upper: list[float], step: Any, equations: Any = None) -> Any:
    functions = {"holding_step": step, "shape_equations": equations}
    robot = SimpleNamespace(
        n=len(lower),
        lower=np.array(lower),
        upper=np.array(upper),
        buffered=functions.__getitem__,
    )
    return effort_plant.JointStops(cast(Any, robot), 0.3)


def test_joints_are_outside_a_rounding_beyond_their_limits() -> None:
    stops = stops_of([-0.25, -8.0], [0.5, 4.0], None)
    for q, outside in (
        ([-0.25 - 0.9e-12, -8.0 - 7e-12], False),
        ([0.5 + 0.9e-12, 4.0 + 3.6e-12], False),
        ([-0.25 - 1.1e-12, 0.0], True),
        ([0.0, -8.0 - 9e-12], True),
        ([0.5 + 1.1e-12, 0.0], True),
        ([0.0, 4.0 + 4.5e-12], True),
    ):
        x = np.concatenate([q, np.zeros(15)])
        assert stops._is_outside_limits(x) is outside, q


def drifting_step(x: Any, command: Any, free: Any, step: float) -> list[Any]:
    """Move free joints at their rates, which stay."""
    after = x.copy()
    after[:2] += step * x[6:8] * free
    return [after]


def test_a_joint_arrives_at_its_stop_and_stays_while_another_goes_on() -> None:
    """Two joints without inertia between them, at 0.5 and -0.1 a second for 1.7 s."""
    equations = np.array([2.0, 0.0, 0.0, 3.0]), np.zeros(2)
    taken: list[float] = []

    def step(x: Any, command: Any, free: Any, duration: float) -> list[Any]:
        taken.append(duration)
        return drifting_step(x, command, free, duration)

    stops = stops_of([-1.0, -1.0], [0.4, 1.0], step, lambda *_: equations)
    x = np.zeros(17)
    x[6:8] = 0.5, -0.1
    after, stopped = stops.advance(x, np.zeros(8), 1.7)
    np.testing.assert_allclose(after[:2], [0.4, -0.17], atol=1e-12)
    assert after[0] == 0.4
    np.testing.assert_allclose(after[6:8], [0.0, -0.1])
    assert stopped.tolist() == [True, False]
    # Two whole steps, the third to the arrival at 0.8 s, three whole ones and what is left: 0 s.
    assert stops._time_to_stop(x, np.zeros(8), np.zeros(2, bool), 1.0) == pytest.approx(0.8)
    assert x[0] == 0.0
    # Without a stop the steps are the longest ones and the rest.
    taken.clear()
    stops.advance(x, np.zeros(8), 0.7)
    assert taken == pytest.approx([0.3, 0.3, 0.1])
    # A locked joint is at rest from the beginning.
    after, stopped = stops.advance(x, np.zeros(8), 0.7, np.array([True, False]))
    np.testing.assert_allclose(after[:2], [0.0, -0.07])
    np.testing.assert_allclose(after[6:8], [0.0, -0.1])
    assert stopped.tolist() == [False, False]


@pytest.mark.parametrize(
    ("q", "rate", "push", "held"),
    [
        ([0.4, 0.0], [0.0, 0.0], [1.0, 0.0], [True, False]),
        ([0.4, 0.0], [0.0, 0.0], [-1.0, 0.0], [False, False]),
        ([-1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [False, False]),
        ([-1.0, 0.0], [0.0, 0.0], [-1.0, 0.0], [True, False]),
        ([0.4, -1.0], [0.1, -0.2], [0.0, 0.0], [False, False]),
        ([0.4, -1.0], [0.0, 0.0], [2.0, -2.0], [True, True]),
        # Coupled by +1 in K: what pushes the first out pulls the second off its stop at -1.
        ([0.0, -1.0], [0.0, 0.0], [-2.0, 0.0], [False, False]),
        ([0.0, -1.0], [0.0, 0.0], [2.0, 0.0], [False, True]),
        ([0.0, 0.0], [5.0, 5.0], [9.0, 9.0], [False, False]),
    ],
)
def test_stops_hold_the_joints_that_something_pushes_outwards(
    q: list[float], rate: list[float], push: list[float], held: list[bool]
) -> None:
    K = np.array([2.0, 1.0, 1.0, 3.0])
    stops = stops_of([-1.0, -1.0], [0.4, 1.0], None, lambda *_: (K, np.array(push)))
    x = np.zeros(17)
    x[:2], x[6:8] = q, rate
    none = np.zeros(2, bool)
    found, touched = stops._bring_to_rest(x, np.zeros(8), none, none)
    assert found.tolist() == held
    # Rates outwards have been brought to rest: both arrive with the first and the fifth case's.
    arrived = [outward > 0 for outward in (rate[0] * (q[0] >= 0.4), -rate[1] * (q[1] <= -1.0))]
    assert touched.tolist() == [a or b for a, b in zip(held, arrived, strict=True)]
    if any(arrived):
        assert x[6:8].tolist() == [0.0, 0.0]
    else:
        assert x[6:8].tolist() == rate


def test_motion_that_is_not_finite_says_how_to_go_on() -> None:
    stops = stops_of([-1.0], [1.0], lambda x, *_: [x * math.nan])
    with pytest.raises(SpaceRobotError) as refusal:
        stops.advance(np.ones(15) * 0.1, np.zeros(7), 1.0)
    assert str(refusal.value) == (
        "The motion is no longer finite: the commands drive the robot too fast for the "
        "integration step. Reduce the commands, or parameter 'integration_step'."
    )


def test_wheels_at_their_largest_rate_are_made_no_faster() -> None:
    robot: Any = SimpleNamespace(
        effort_limit=np.array([5.0, 0.2, 0.3]),
        velocity_limit=np.array([1.0, 40.0, 50.0]),
        joint_names=("arm", "wheel_1", "wheel_2"),
        description=SimpleNamespace(wheel_names=("wheel_1", "wheel_2")),
    )
    qdot = ca.MX.sym("qdot", 3)
    bounds = ca.Function("bounds", [qdot], list(effort_plant._effort_bounds(robot, qdot)))
    for rates, lowest, highest in (
        ([9.0, 40.0, -50.0], [-5.0, -0.2, 0.0], [5.0, 0.0, 0.3]),
        ([-9.0, -40.0, 50.0], [-5.0, 0.0, -0.3], [5.0, 0.2, 0.0]),
        ([0.0, 39.9, -49.9], [-5.0, -0.2, -0.3], [5.0, 0.2, 0.3]),
    ):
        found = [np.array(each).ravel().tolist() for each in bounds(rates)]
        assert found == [lowest, highest]
    robot.description.wheel_names = ()
    least, most = effort_plant._effort_bounds(robot, qdot)
    assert (cast(Any, least).tolist(), cast(Any, most).tolist()) == (
        [-5.0, -0.2, -0.3],
        [5.0, 0.2, 0.3],
    )


# -- captures ------------------------------------------------------------------------------------


IMPACT = GraspImpact(
    twist=np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6]),
    qdot=np.array([0.7, -0.8]),
    impulse=np.array([2.0, -3.0, 6.0, 1.0, 2.0, -2.0]),
    joint_impulses=np.array([0.5, -1.25]),
    energy_before=4.5,
    energy_lost=1.5,
)


def report(limit: float, names: tuple[str, ...] = ("elbow", "wrist"), **others: Any) -> Any:
    turned = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    return CaptureReport(IMPACT, turned, np.arange(1.0, 7.0), 1e-15, True, names, limit, **others)


def test_a_capture_warns_of_the_joint_that_takes_most() -> None:
    plain = "The target is captured by an impulse of 7 N s and 3 N m s; 1.5 J of 4.5 J are lost"
    warning = (
        f"{plain}, and joint 'wrist' takes 1.25 N m s, more than "
        "'capture.joint_impulse_limit', 1.2."
    )
    for limit, message, level in (
        (0.0, f"{plain}.", 0),
        (1.25, f"{plain}.", 0),
        (1.2, warning, 1),
    ):
        event = report(limit).event(9.5)
        assert (event.message, event.level, event.time_s) == (message, level, 9.5)
        assert event.kind is EventKind.CAPTURED
    assert report(0.1, names=()).event(1.0).level == 0
    one = replace(
        report(0.1, names=("only",)), impact=replace(IMPACT, joint_impulses=np.array([-1]))
    )
    assert "joint 'only' takes 1 N m s" in one.event(1.0).message


def test_the_facts_of_a_capture_survive_their_event() -> None:
    made = report(2.5)
    values = made.to_values()
    np.testing.assert_allclose(values.pop("base_velocity_mps"), [-0.2, 0.1, 0.3])
    np.testing.assert_allclose(values.pop("base_rate_radps"), [-0.5, 0.4, 0.6])
    assert values == {
        "captured": True,
        "requested": True,
        "joint_rates_radps": [0.7, -0.8],
        "impulse_Ns": [2.0, -3.0, 6.0, 1.0, 2.0, -2.0],
        "joint_impulses_Nms": [0.5, -1.25],
        "joint_impulse_limit_Nms": 2.5,
        "energy_before_J": 4.5,
        "energy_lost_J": 1.5,
        "linear_momentum_kgmps": [1.0, 2.0, 3.0],
        "angular_momentum_Nms": [4.0, 5.0, 6.0],
        "total_momentum_residual": 1e-15,
    }
    assert capture.capture_values(made.event(0.0).about) == made.to_values()
    assert capture.capture_values({"a": "1", "b": "{"}) == {}
    default = CaptureReport(IMPACT, np.eye(3), np.zeros(6), 0.0, requested=False)
    assert (default.joint_names, default.joint_impulse_limit) == ((), 0.0)


def test_a_release_says_how_the_target_moves() -> None:
    event = ReleaseReport(np.array([0.3, 0.0, -0.4]), np.array([0.0, -1.2, 0.5])).event(2.0)
    assert event.message == "The target is released; it moves at 0.5 m/s and 1.3 rad/s."
    assert (event.kind, event.level, event.time_s) == (EventKind.RELEASED, 0, 2.0)
    assert json.loads(event.about["velocity_mps"]) == [0.3, 0.0, -0.4]
    assert json.loads(event.about["rate_radps"]) == [0.0, -1.2, 0.5]


def test_an_approach_may_be_at_its_limits() -> None:
    limits = CaptureConfig(distance=0.5, angle=0.25, speed=0.125, rate=0.0625)
    assert GrappleMotion(0.5, 0.25, 0.125, 0.0625).misses(limits) == []
    assert GrappleMotion(0.75, 0.2, 0.375, math.nan).misses(limits) == [
        "distance is 0.75 m, 0.25 m more than 'capture.distance', 0.5",
        "speed is 0.375 m/s, 0.25 m/s more than 'capture.speed', 0.125",
        "rate is nan rad/s, nan rad/s more than 'capture.rate', 0.0625",
    ]
    assert GrappleMotion(0.0, 0.5, 0.0, 0.125).misses(limits) == [
        "angle is 0.5 rad, 0.25 rad more than 'capture.angle', 0.25",
        "rate is 0.125 rad/s, 0.0625 rad/s more than 'capture.rate', 0.0625",
    ]


def test_relative_differences_are_of_the_larger_momentum() -> None:
    expected = np.array([3.0, 0.0, 4.0, 0.0, 2.0, 0.0])
    for change, wanted in (
        ([0.0] * 6, 0.0),
        ([0.0, 1.0, 0.0, 0.0, 0.0, 0.0], 0.2),
        ([0.0, 0.0, 0.0, 0.5, 0.0, 0.0], 0.25),
        ([0.3, 0.0, 0.4, 0.0, 0.0, 0.6], 0.3),
    ):
        assert capture._relative_difference(expected + change, expected) == pytest.approx(wanted)
    still = np.array([0.0, 0.0, 0.0, 0.0, 2.0, 0.0])
    assert capture._relative_difference(still, still) == 0.0
    assert capture._relative_difference(still + np.eye(6)[0], still) == math.inf
    # A small momentum counts as a large one.
    assert capture._relative_difference(still / 1e4, still / 2e4) == pytest.approx(1.0)


def test_poses_are_relative_to_the_first_frame() -> None:
    first, second = Rotation.random(2, random_state=4)
    r, s = np.array([1.0, 2.0, -3.0]), np.array([0.5, -1.0, 4.0])
    still = np.zeros(3)
    pose = capture._relative_pose(
        BodyMotion(first.as_matrix(), r, still, still),
        BodyMotion(second.as_matrix(), s, still, still),
    )
    np.testing.assert_allclose(pose.R, (first.inv() * second).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(pose.r, first.inv().apply(s - r), atol=1e-12)


def test_targets_float_where_no_parameter_says_otherwise() -> None:
    config = configured(TargetConfig, {})
    assert not config.given
    assert (config.position, config.velocity, config.angular_velocity) == ((0.0, 0.0, 0.0),) * 3
    assert config.orientation == (0.0, 0.0, 0.0, 1.0)
    assert configured(TargetConfig, {"robot": "a.urdf"}).given
    assert configured(TargetConfig, {"robot_description": "<robot/>"}).given
    body = parse_robot(
        '<robot name="b"><link name="hull"><inertial><mass value="2"/><inertia ixx="1" iyy="1" '
        'izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    made = capture.Target(
        body,
        replace(config, orientation=(), grapple_frame="hull", velocity=(1.0, 0.0, -2.0)),
        0.1,
        0.1,
    )
    assert made.pose.tolist() == [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_allclose(made.twist, [1.0, 0.0, -2.0, 0.0, 0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(made.momenta, [2.0, 0.0, -4.0, 0.0, 0.0, 0.0], atol=1e-15)
    made.step()
    np.testing.assert_allclose(made.pose[:3], [0.1, 0.0, -0.2], atol=1e-15)
    made.reset()
    assert not made.pose[:3].any()


# -- sensors -------------------------------------------------------------------------------------


def test_covariances_are_those_of_the_noise_on_the_diagonals() -> None:
    config = PlantConfig(
        robot="sliding_masses",
        sensors=replace(
            PlantConfig().sensors,
            position_noise=2.0,
            attitude_noise=3.0,
            velocity_noise=4.0,
            angular_velocity_noise=5.0,
        ),
    )
    plant = build_plant(SpaceRobot.from_file(robot_file("sliding_masses")), config)
    made = sensors.Sensors(plant, config.sensors, 0.05)
    for found, diagonal in (
        (made.pose_covariance, [4.0] * 3 + [9.0] * 3),
        (made.twist_covariance, [16.0] * 3 + [25.0] * 3),
    ):
        np.testing.assert_array_equal(found.reshape(6, 6), np.diag(diagonal))
    assert made.used
    assert not made.dropout


def test_links_that_a_robot_has_not_are_refused() -> None:
    robot = SpaceRobot.from_file(robot_file("sliding_masses"))
    links = list(robot.link_names)
    assert sensors._link_indices(robot, (links[2], links[0])) == [2, 0]
    assert sensors._link_indices(robot, ()) == []
    known = ", ".join(links)
    for call, sentence in (
        (lambda: sensors._link_indices(robot, ("claw",)),
         f"Parameter 'end_effectors' names 'claw', but the robot has no such link; "
         f"it has {known}."),
        (lambda: sensors._link_indices(robot, (links[1], links[1])),
         "Parameter 'end_effectors' names links with one topic NAME/pose: "
         f"{links[1]}, {links[1]}; name each once."),
        (lambda: sensors._end_effector_index(robot, "claw"),
         f"Parameter 'end_effector_frame' is 'claw', but the robot has no such link; "
         f"it has {known}."),
    ):  # fmt: skip
        with pytest.raises(ParameterError) as refusal:
            call()
        assert str(refusal.value) == sentence
    assert sensors._end_effector_index(robot, links[2]) == 2
