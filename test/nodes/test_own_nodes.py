"""Nodes of the examples that take the place of ours: a planner, a robot, a commander by timer."""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import qos_profile_sensor_data
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from support.planner_flight import NEAR, PLANNER, PLANT, goal_at, pose_arrays, values_of
from support.plant_rig import SLIDERS, Rig
from support.ros_harness import Harness, nanoseconds

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes import PlannerNode, PlantNode
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def example(name: str) -> ModuleType:
    """Return the module of an example."""
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class Heard:
    """A publisher that keeps its messages."""

    def __init__(self) -> None:
        self.messages: list[Any] = []

    def publish(self, message: Any) -> None:
        self.messages.append(message)


def stamped(kind: Any, time: float, **fields: Any) -> Any:
    message = kind(**fields)
    sec, nanosec = divmod(round(time * 1e9), 1_000_000_000)
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    return message


# -- a planner of one's own ---------------------------------------------------------------------

TILT = Rotation.from_rotvec([0.3, -0.2, 0.5])


def sliding_masses() -> SpaceRobot:
    return SpaceRobot.from_file(robot_file("sliding_masses"))


def test_a_planner_of_state_feedback_flies_the_plant_to_its_goal(harness: Harness) -> None:
    planner = harness.add(
        example("fly_own_planner").FeedbackPlanner(sliding_masses(), context=harness.context)
    )
    start = np.array([0.4, -0.1, 0.2])
    plant = harness.make(
        PlantNode,
        {
            **PLANT,
            "initial_position": start.tolist(),
            "initial_orientation": TILT.as_quat().tolist(),
        },
    )
    probe = harness.probe({"planner/status": DiagnosticStatus, "odom": Odometry})
    goals = harness.matched(probe.create_publisher(PoseStamped, "goal_pose", 10))
    goal = start + TILT.apply([0.05, -0.03, 0.02])
    goals.publish(goal_at((goal.tolist(), TILT.as_rotvec().tolist())))
    harness.spin_until(lambda: planner.state == "reached", "the goal")
    position, attitude = plant.plant.pose[:3], Rotation.from_quat(plant.plant.pose[3:])
    assert np.linalg.norm(position - goal) <= 1e-3
    assert (attitude.inv() * TILT).magnitude() <= 1e-9
    # Each tick of 0.05 s leaves 95 % of the error, until it is below the tolerance.
    left = [
        np.linalg.norm(pose_arrays(each.pose.pose)[0] - goal) for each in probe.messages["odom"]
    ]
    moving = [error for error in left if 1e-3 < error < 0.999 * left[0]]
    assert len(moving) > 50
    np.testing.assert_allclose(np.array(moving[1:]) / moving[:-1], 0.95, rtol=1e-6)
    harness.spin_until(lambda: probe.count("planner/status") == 2, "both statuses")
    states = [
        PlannerStatus.from_values(values_of(each)).state
        for each in probe.messages["planner/status"]
    ]
    assert states == [PlannerState.EXECUTING, PlannerState.REACHED]


def test_it_answers_joints_in_any_order_and_rests_without_their_odom(harness: Harness) -> None:
    robot = sliding_masses()
    planner = harness.add(
        example("fly_own_planner").FeedbackPlanner(robot, context=harness.context)
    )
    planner.commands = planner.statuses = Heard()
    q = {"slider_3": 0.03, "slider_1": -0.02, "slider_2": 0.01}
    joints = stamped(JointState, 1.25, name=list(q), position=list(q.values()))
    planner.on_goal(goal_at(([0.1, 0.2, -0.1], [0.0, 0.0, 0.1])))
    planner.on_joints(joints)  # No odometry has come yet.
    planner.on_odom(stamped(Odometry, 1.25))
    planner.on_joints(joints)
    joints.header.stamp.nanosec += 1
    planner.on_joints(joints)
    _, rest, command, late = planner.commands.messages
    assert list(command.name) == list(robot.joint_names)
    A = robot.connection([-0.02, 0.01, 0.03])
    wanted = np.array([0.1, 0.2, -0.1, 0.0, 0.0, 0.1])
    best = -np.linalg.solve(A.T @ A, A.T @ wanted)
    np.testing.assert_allclose(command.velocity, best, rtol=1e-9)
    assert np.abs(best).min() > 0.01
    for resting in (rest, late):
        assert list(resting.velocity) == [0.0] * 3
    assert nanoseconds(late.header.stamp) == 1_250_000_001


# -- a robot of one's own -----------------------------------------------------------------------

V_W, OMEGA_B = np.array([0.04, -0.03, 0.02]), np.array([0.1, 0.2, -0.15])
START = np.array([1.0, 2.0, 3.0])


def truth(time: float) -> tuple[np.ndarray[Any, Any], Rotation]:
    """Return the pose of a base with constant rates."""
    return START + V_W * time, TILT * Rotation.from_rotvec(OMEGA_B * time)


def capture(time: float) -> PoseStamped:
    position, attitude = truth(time)
    message = goal_at((position.tolist(), attitude.as_rotvec().tolist()))
    sec, nanosec = divmod(round(time * 1e9), 1_000_000_000)
    message.header.stamp.sec, message.header.stamp.nanosec = sec, nanosec
    return message


@pytest.fixture
def driver(harness: Harness) -> Any:
    driver = harness.add(example("fly_own_robot").Driver(context=harness.context))
    driver.odoms, driver.joints = Heard(), Heard()
    return driver


def test_a_driver_estimates_twists_from_late_poses_of_which_some_are_lost(driver: Any) -> None:
    encoders = stamped(JointState, 0.02, name=["a"], position=[0.5])
    driver.on_encoders(encoders)
    assert driver.odoms.messages == []  # Nothing was captured yet.
    assert driver.joints.messages == [encoders]
    for number in range(60):
        if number % 5 != 3:
            driver.on_capture(capture(0.031 * number))
    last = driver.captured
    assert last == pytest.approx(0.031 * 59)
    driver.on_capture(capture(0.031 * 57 + 0.001))  # It was overtaken.
    assert driver.captured == last
    driver.on_encoders(stamped(JointState, last + 0.0371))
    (odom,) = driver.odoms.messages
    position, attitude = pose_arrays(odom.pose.pose)
    wanted, turned = truth(last + 0.0371)
    np.testing.assert_allclose(position, wanted, atol=1e-8)
    assert (attitude.inv() * turned).magnitude() < 1e-8
    v, omega = odom.twist.twist.linear, odom.twist.twist.angular
    np.testing.assert_allclose([v.x, v.y, v.z], turned.inv().apply(V_W), atol=1e-7)
    np.testing.assert_allclose([omega.x, omega.y, omega.z], OMEGA_B, atol=1e-7)
    assert (odom.header.frame_id, odom.child_frame_id) == ("world", "base_link")
    assert odom.header.stamp == driver.joints.messages[-1].header.stamp


def test_half_of_each_difference_enters_and_all_of_one_after_a_gap(driver: Any) -> None:
    driver.on_capture(capture(2.0))
    np.testing.assert_array_equal(driver.twist, 0.0)
    driver.on_capture(capture(2.25))
    np.testing.assert_allclose(driver.twist, [0.5 * V_W, 0.5 * OMEGA_B], atol=1e-12)
    driver.on_capture(capture(2.3))
    np.testing.assert_allclose(driver.twist, [0.75 * V_W, 0.75 * OMEGA_B], atol=1e-12)
    driver.on_capture(capture(2.6))
    np.testing.assert_allclose(driver.twist, [V_W, OMEGA_B], atol=1e-12)


def test_a_pose_that_is_too_old_is_no_odom(driver: Any) -> None:
    driver.on_capture(capture(1.0))
    for time in (1.25, 1.251):
        driver.on_encoders(stamped(JointState, time))
    assert len(driver.joints.messages) == 2
    assert [nanoseconds(each.header.stamp) for each in driver.odoms.messages] == [1_250_000_000]


def test_a_planner_flies_the_robot_of_a_driver(harness: Harness) -> None:
    driver = harness.add(example("fly_own_robot").Driver(context=harness.context))
    lab = harness.make(PlantNode, PLANT, namespace="lab")
    planner = harness.make(PlannerNode, PLANNER)
    rng, late = np.random.default_rng(7), list[PoseStamped]()

    def cameras(pose: PoseStamped) -> None:
        late.append(pose)
        if len(late) > 1:
            given = late.pop(0)
            if rng.random() > 0.2:
                pictures.publish(given)

    probe = harness.probe({"planner/status": DiagnosticStatus}, latched=("planner/status",))
    pictures = probe.create_publisher(PoseStamped, "lab/mocap", qos_profile_sensor_data)
    probe.create_subscription(PoseStamped, "lab/base_pose", cameras, 10)
    goals = harness.matched(probe.create_publisher(PoseStamped, "goal_pose", 10))
    harness.spin_until(lambda: lab.tick >= 8, "states")
    goals.publish(goal_at(NEAR))
    decided = ("reached", "failed", "refused")
    harness.spin_until(
        lambda: any(values_of(s)["state"] in decided for s in probe.messages["planner/status"]),
        "the end of the goal",
    )
    status = probe.last("planner/status")
    assert values_of(status)["state"] == "reached", status.message
    assert planner.is_active
    assert np.linalg.norm(lab.plant.pose[:3] - NEAR[0]) <= 2e-3
    assert driver.captured < lab.simulated_time_s


# -- a commander by timer -----------------------------------------------------------------------


def test_a_commander_by_timer_sends_stamps_of_zero(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    module = example("fly_by_timer")
    commander = harness.add(module.TimedCommander(context=harness.context))
    heard = commander.commands = Heard()
    commander.on_time()
    assert heard.messages == []  # It knows no joints yet.
    commander.on_state(JointState(name=["b", "a"]))
    now = rclpy.time.Time(seconds=3, nanoseconds=250_000_000)
    monkeypatch.setattr(commander, "get_clock", lambda: type("C", (), {"now": lambda _: now})())
    commander.on_time()
    commander.stamped = True
    commander.on_time()
    free, bound = heard.messages
    assert list(free.name) == ["b", "a"]
    np.testing.assert_allclose(free.velocity, [0.2 * math.sin(math.pi * 3.25), 0.0], atol=1e-12)
    assert nanoseconds(free.header.stamp) == 0
    assert nanoseconds(bound.header.stamp) == 3_250_000_000


def test_the_plant_takes_a_stamp_of_zero_and_refuses_the_wall_clock(harness: Harness) -> None:
    realtime = {"time_mode": "realtime", "real_time_factor": 10.0}
    rig = Rig(harness, realtime)
    rig.probe.destroy_publisher(rig.commands)
    commander = harness.add(example("fly_by_timer").TimedCommander(context=harness.context))
    harness.spin_until(lambda: commander.names == SLIDERS, "the joints")
    harness.spin_until(lambda: rig.now_ns > 500_000_000, "the plant's beginning")

    def commanded(until: Callable[[], Any], why: str) -> None:
        def look() -> Any:
            commander.on_time()
            return until()

        harness.spin_until(look, why)

    commanded(lambda: rig.probe.last("joint_states").velocity[0] != 0.0, "motion")
    assert commander.refused == 0
    commander.stamped = True
    commanded(lambda: commander.refused > 0, "refusals")
    assert rig.diagnosed("commands", "refused.early") > 0
