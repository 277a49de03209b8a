"""What nodes say of themselves: diagnostics for an aggregator, covariances, a line at the start."""

from __future__ import annotations

import re
from functools import partial

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from support.control_loop import Loop
from support.planner_flight import NEAR, Flight
from support.plant_rig import Rig
from support.ros_harness import Harness, Probe
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.nodes import PlannerNode, PlantNode
from spacerobot_ros.resources import robot_file

# Each noise is another one, so that one that is taken for another is noticed.
NOISES = {
    "sensors.position_noise": 0.002,
    "sensors.attitude_noise": 0.003,
    "sensors.velocity_noise": 0.005,
    "sensors.angular_velocity_noise": 0.007,
}


def test_odom_has_the_covariances_of_its_noise(harness: Harness) -> None:
    rig = Rig(harness, NOISES)
    rig.step([0.0, 0.0, 0.0])
    odom = rig.probe.last("odom")
    position, attitude, velocity, turn = (value**2 for value in NOISES.values())
    for covariance, linear, angular in (
        (odom.pose.covariance, position, attitude),
        (odom.twist.covariance, velocity, turn),
    ):
        expected = np.diag([linear] * 3 + [angular] * 3)
        assert np.asarray(covariance).reshape(6, 6) == pytest.approx(expected, rel=1e-12)
    # A fault adds to it, and goes again; the truth beside it has none.
    rig.plant.plant.inject("sensor_noise position 0.01")
    rig.step([0.0, 0.0, 0.0])
    assert rig.probe.last("odom").pose.covariance[7] == pytest.approx(position + 1e-4)
    rig.plant.plant.inject("clear")
    rig.step([0.0, 0.0, 0.0])
    assert rig.probe.last("odom").pose.covariance[7] == pytest.approx(position)


def test_perfect_sensors_have_no_covariance(harness: Harness) -> None:
    rig = Rig(harness)
    rig.step([0.0, 0.0, 0.0])
    assert not np.any(rig.probe.last("odom").pose.covariance)


def diagnosed(probe: Probe, name: str) -> list[DiagnosticStatus]:
    messages = probe.messages["/diagnostics"]
    return [status for array in messages for status in array.status if status.name == name]


def test_planner_and_plant_are_in_the_diagnostics_as_aggregators_want(harness: Harness) -> None:
    flight = Flight(harness, {"diagnostics_period": 0.2}, {"diagnostics_period": 0.2})
    probe = harness.probe({"/diagnostics": DiagnosticArray})
    harness.connect()
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(10)
    for name in ("planner: goal", "planner: states", "plant: commands"):
        harness.spin_until(partial(diagnosed, probe, name), name)
        assert {status.hardware_id for status in diagnosed(probe, name)} == {"sliding_masses"}
    harness.spin_until(
        lambda: {pair.key: pair.value for pair in diagnosed(probe, "planner: goal")[-1].values}[
            "state"
        ] == "executing"
    )  # fmt: skip
    for array in probe.messages["/diagnostics"]:
        for status in array.status:
            assert re.fullmatch(r"\w[\w/]*: [\w ]+", status.name)


def test_the_controller_is_in_the_diagnostics(harness: Harness) -> None:
    loop = Loop(harness)
    probe = harness.probe({"/diagnostics": DiagnosticArray})
    harness.connect()
    harness.spin_until(lambda: loop.answer() and diagnosed(probe, "control: goal"))
    assert diagnosed(probe, "control: states")


def logged(probe: Probe, line: str) -> bool:
    return any(re.search(line, message.msg) for message in probe.messages["/rosout"])


def test_every_node_says_what_it_does_when_it_starts(harness: Harness) -> None:
    flight = Flight(harness)
    flight.probe.watch("/rosout", Log, latched=True)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    for line in (
        r"Simulates 'sliding_masses' \(3 joint.* 20 Hz in lockstep",
        r"Plans by 'lie_bracket' for 'sliding_masses'.*/goal_pose",
        r"Goal .* of the base: \(0.05, -0.03, 0.02\) m",
    ):
        harness.spin_until(partial(logged, flight.probe, line), line)


def test_a_stack_in_real_time_is_alive_whatever_its_file_says(harness: Harness) -> None:
    slow = {"marker_period": 1000.0, "base_pose_period": 1000.0, "diagnostics_period": 1000.0}
    plant = harness.make(
        PlantNode, {"robot": "sliding_masses", "time_mode": "realtime", "tick_rate": 20.0, **slow}
    )
    probe = harness.probe(
        {
            "markers": MarkerArray, "/diagnostics": DiagnosticArray, "odom": Odometry,
            "joint_states": JointState,
        }
    )  # fmt: skip
    harness.spin_until(
        lambda: probe.count("markers") >= 3 and probe.count("/diagnostics") >= 2, "a sign of life"
    )
    assert plant.is_active


@pytest.mark.parametrize("choice", ["auto", "best_effort", "reliable"])
def test_a_driver_that_publishes_with_best_effort_is_heard(harness: Harness, choice: str) -> None:
    planner = harness.make(
        PlannerNode,
        {"robot": "planar_chain", "tick_rate": 20.0, "state_reliability": choice},
    )
    probe = harness.probe({"joint_commands": JointState})
    drivers = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    joints = probe.create_publisher(JointState, "joint_states", drivers)
    message = JointState(
        name=["joint_1", "joint_2"], position=[0.0, 0.0], velocity=[0.0, 0.0], effort=[0.0, 0.0]
    )
    message.name = list(load_robot(robot_file("planar_chain")).joint_names)
    heard = False
    for tick in range(1, 60):
        message.header.stamp.nanosec = 10_000_000 * tick
        joints.publish(message)
        harness.spin_for(0.02)
        heard = heard or bool(probe.messages["joint_commands"])
        if heard:
            break
    assert heard == (choice != "reliable")
    assert planner.is_active
