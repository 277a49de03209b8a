"""Faults and imperfect sensors of the plant node, from outside."""

from __future__ import annotations

import re
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from support.control_loop import Loop
from support.planner_flight import NEAR, Flight, values_of
from support.plant_rig import TICK, Rig, pose_of
from support.ros_harness import Harness, nanoseconds
from support.sentences import assert_one_sentence
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.nodes import PlannerNode, PlantNode
from spacerobot_ros.resources import robot_file

Array = npt.NDArray[np.float64]

TRUE_TOPICS = {
    "odom_true": Odometry,
    "joint_states_true": JointState,
    "momentum_expected": Float64MultiArray,
}
RATES = np.array([0.1, -0.2, 0.05])


class Commanded(Rig):
    """A plant whose every state is answered with the same joint velocities."""

    def __init__(self, harness: Harness, *faults: str, **parameters: Any) -> None:
        given = {"faults": list(faults), **parameters}
        super().__init__(harness, given, topics=TRUE_TOPICS, activate=False)
        self.faults = self.probe.create_publisher(String, "fault_injection", 10)
        harness.matched(self.faults)
        self.activate()

    def run(self, ticks: int) -> None:
        """Step so many times, and hear all of it."""
        for _ in range(ticks):
            self.step(RATES.tolist())
        self.harness.settle(self.probe)

    def inject(self, text: str) -> None:
        """Send a message to fault_injection, and wait until the plant has it."""
        before = [str(fault) for fault in self.plant.plant.active]
        self.faults.publish(String(data=text))
        self.harness.spin_until(
            lambda: [str(fault) for fault in self.plant.plant.active] != before, "the injection"
        )

    def series(self, topic: str) -> tuple[Array, Array]:
        """Return stamps (N,) in s and poses (N, 7), or shapes (N, n), of a topic."""
        messages = self.probe.messages[topic]
        stamps = np.array([nanoseconds(m.header.stamp) / 1e9 for m in messages])
        if topic.startswith("joint"):
            return stamps, np.array([m.position for m in messages])
        return stamps, np.array([np.concatenate(pose_of(m)) for m in messages])


# -- sensors ----------------------------------------------------------------------------------


def test_imperfect_ones_publish_what_they_measure_and_the_truth(harness: Harness) -> None:
    flight = Commanded(
        harness,
        **{
            "sensors.position_noise": 0.01,
            "sensors.joint_bias": [0.0, 0.5, 0.0],
            "sensors.seed": 4,
        },
    )
    flight.run(40)
    stamps, measured = flight.series("odom")
    true_stamps, true = flight.series("odom_true")
    np.testing.assert_array_equal(stamps, true_stamps)
    assert len(stamps) == 41
    off = measured[:, :3] - true[:, :3]
    assert 0.005 < off.std() < 0.015
    np.testing.assert_array_equal(measured[:, 3:], true[:, 3:])
    shapes, truth = flight.series("joint_states")[1], flight.series("joint_states_true")[1]
    np.testing.assert_allclose(truth, np.arange(41)[:, None] * TICK * RATES, atol=1e-14)
    np.testing.assert_allclose(shapes - truth, np.tile([0.0, 0.5, 0.0], (41, 1)), atol=1e-15)
    # The truth before what is measured of it: who hears a state has heard what it is.
    order = [t for t in flight.probe.order if t.startswith(("odom", "joint_states"))]
    assert order[-4:] == ["odom_true", "joint_states_true", "odom", "joint_states"]


def test_a_lost_pose_is_not_published_and_a_late_one_is(harness: Harness) -> None:
    flight = Commanded(
        harness, "sensor_dropout odom at 0.5 until 1", "sensor_delay odom 0.1 at 1.5 until 3"
    )
    flight.run(50)
    stamps, measured = flight.series("odom")
    ticks = np.round(stamps / TICK).astype(int)
    assert ticks.tolist() == [*range(10), *range(20, 51)]
    true = flight.series("odom_true")[1]
    assert len(true) == 51
    late = (ticks >= 32) & (ticks < 50)
    np.testing.assert_array_equal(measured[late], true[ticks[late] - 2])
    np.testing.assert_array_equal(measured[~late & (ticks < 30)], true[ticks[~late & (ticks < 30)]])


def test_a_lockstep_plant_does_not_wait_for_an_answer_to_a_lost_pose(harness: Harness) -> None:
    flight = Commanded(harness, "sensor_dropout odom at 0.1 until 0.25")
    flight.run(2)
    # Nobody answers any more: what was commanded holds until the pose is there again.
    flight.harness.spin_until(lambda: flight.plant.tick == 5, "the end of the dropout")
    flight.harness.spin_for(0.3)
    assert flight.plant.tick == 5
    np.testing.assert_allclose(flight.plant.plant.q, 5 * TICK * RATES)


# -- injection --------------------------------------------------------------------------------


def test_faults_are_injected_reported_and_cleared(harness: Harness) -> None:
    flight = Commanded(harness, "joint_slow slider_3 0.5 at 0.1")
    flight.run(2)
    for topic in ("odom_true", "joint_states_true"):
        assert flight.probe.count_publishers(topic) == 0, "perfect sensors publish nothing more"
    assert flight.diagnosis("faults").level == DiagnosticStatus.WARN
    flight.inject("joint_stuck slider_2\nsensor_bias position_x 0.25")
    flight.run(4)
    status = flight.diagnosis("faults")
    assert set(values_of(status).values()) == {
        "joint_slow slider_3 0.5 at 0.1",
        "joint_stuck slider_2 at 0.1",
        "sensor_bias position_x 0.25 at 0.1",
    }
    assert "joint_stuck slider_2" in status.message
    stamps, measured = flight.series("odom")
    true_stamps, true = flight.series("odom_true")
    assert true_stamps[0] > stamps[0], "the truth is told apart from when it differs"
    assert measured[-1, 0] - true[-1, 0] == pytest.approx(0.25)
    np.testing.assert_allclose(flight.plant.plant.q, TICK * RATES * [6, 2, 2 + 4 * 0.5])
    flight.inject("clear")
    flight.run(1)
    assert flight.diagnosis("faults").level == DiagnosticStatus.OK
    assert flight.diagnosis("faults").message == "no fault is injected"
    np.testing.assert_allclose(flight.plant.plant.q, TICK * RATES * [7, 3, 5])
    assert flight.diagnosis("momentum").level == DiagnosticStatus.OK


def test_an_injection_that_is_no_fault_is_refused_with_a_sentence(harness: Harness) -> None:
    flight = Commanded(harness)
    flight.probe.watch("/rosout", Log)
    flight.harness.connect()
    flight.run(1)
    flight.faults.publish(String(data="joint_stuck elbow"))
    flight.harness.spin_until(
        lambda: any("joint_stuck elbow" in m.msg for m in flight.probe.messages["/rosout"]),
        "a word on the refusal",
    )
    line = next(m.msg for m in flight.probe.messages["/rosout"] if "elbow" in m.msg)
    assert_one_sentence(line, "slider_1, slider_2, slider_3")
    assert not flight.plant.plant.active


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


def test_planner_and_plant_are_in_the_diagnostics_as_aggregators_want(harness: Harness) -> None:
    flight = Flight(harness, {"diagnostics_period": 0.2}, {"diagnostics_period": 0.2})
    probe = harness.probe({"/diagnostics": DiagnosticArray})
    harness.connect()
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(10)
    for name in ("planner: goal", "planner: states", "plant: commands"):
        harness.spin_until(partial(probe.diagnoses, name), name)
        assert {status.hardware_id for status in probe.diagnoses(name)} == {"sliding_masses"}
    harness.spin_until(
        lambda: values_of(probe.diagnoses("planner: goal")[-1])["state"] == "executing"
    )
    for array in probe.messages["/diagnostics"]:
        for status in array.status:
            assert re.fullmatch(r"\w[\w/]*: [\w ]+", status.name)


def test_the_controller_is_in_the_diagnostics(harness: Harness) -> None:
    loop = Loop(harness)
    probe = harness.probe({"/diagnostics": DiagnosticArray})
    harness.connect()
    harness.spin_until(lambda: loop.answer() and probe.diagnoses("control: goal"))
    assert probe.diagnoses("control: states")


def test_every_node_says_what_it_does_when_it_starts(harness: Harness) -> None:
    flight = Flight(harness)
    flight.probe.watch("/rosout", Log, latched=True)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    heard = flight.probe.messages["/rosout"]
    for line in (
        r"Simulates 'sliding_masses' \(3 joint.* 20 Hz in lockstep",
        r"Plans by 'lie_bracket' for 'sliding_masses'.*/goal_pose",
        r"Goal .* of the base: \(0.05, -0.03, 0.02\) m",
    ):
        harness.spin_until(lambda line=line: any(re.search(line, m.msg) for m in heard), line)  # type: ignore[misc]


def test_a_stack_in_real_time_is_alive_whatever_its_file_says(harness: Harness) -> None:
    slow = {"marker_period": 1000.0, "base_pose_period": 1000.0, "diagnostics_period": 1000.0}
    plant = harness.make(
        PlantNode, {"robot": "sliding_masses", "time_mode": "realtime", "tick_rate": 20.0, **slow}
    )
    probe = harness.probe({"markers": MarkerArray, "/diagnostics": DiagnosticArray})
    harness.spin_until(
        lambda: probe.count("markers") >= 3 and probe.count("/diagnostics") >= 2, "a sign of life"
    )
    assert plant.is_active


@pytest.mark.parametrize("choice", ["auto", "best_effort", "reliable"])
def test_a_driver_that_publishes_with_best_effort_is_heard(harness: Harness, choice: str) -> None:
    planner = harness.make(
        PlannerNode, {"robot": "planar_chain", "tick_rate": 20.0, "state_reliability": choice}
    )
    probe = harness.probe({"joint_commands": JointState})
    drivers = QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT)
    joints = probe.create_publisher(JointState, "joint_states", drivers)
    names, zeros = list(load_robot(robot_file("planar_chain")).joint_names), [0.0, 0.0]
    message = JointState(name=names, position=zeros, velocity=zeros, effort=zeros)
    for tick in range(1, 60):
        message.header.stamp.nanosec = 10_000_000 * tick
        joints.publish(message)
        harness.spin_for(0.02)
        if probe.count("joint_commands"):
            break
    assert bool(probe.count("joint_commands")) == (choice != "reliable")
    assert planner.is_active
