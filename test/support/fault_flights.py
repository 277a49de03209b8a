"""Plant and commanders in lockstep, faults injected, everything heard."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.lifecycle import TransitionCallbackReturn
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, String
from support.ros_harness import Harness, nanoseconds
from trajectory_msgs.msg import JointTrajectory

from spacerobot_ros.nodes import CoordinatedControlNode, PlannerNode, PlantNode

Array = npt.NDArray[np.float64]

TOPICS = {
    "odom": Odometry,
    "odom_true": Odometry,
    "joint_states": JointState,
    "joint_states_true": JointState,
    "joint_commands": JointState,
    "gait_schedule": JointTrajectory,
    "momentum": Float64MultiArray,
    "momentum_expected": Float64MultiArray,
    "planner/status": DiagnosticStatus,
    "controller/status": DiagnosticStatus,
    "/diagnostics": DiagnosticArray,
}
_DECIDED = ("reached", "reached_partly", "failed", "refused", "aborted")


class FaultFlight:
    """A plant with what commands it; ``commanders`` maps node names to parameters."""

    def __init__(
        self, harness: Harness, plant: dict[str, Any], **commanders: dict[str, Any]
    ) -> None:
        self.harness = harness
        shared = {"tick_rate": plant.get("tick_rate", 20.0), "robot": plant["robot"]}
        self.plant = harness.make(
            PlantNode,
            {"time_mode": "lockstep", "marker_period": 0.0, "diagnostics_period": 0.05, **plant},
            autostart=False,
        )
        kinds = {"planner": PlannerNode, "coordinated_control": CoordinatedControlNode}
        self.nodes = [
            harness.make(kinds[name], {**shared, **values}, autostart=False)
            for name, values in commanders.items()
        ]
        self.decider = "planner/status" if "planner" in commanders else "controller/status"
        self.probe = harness.probe(TOPICS)
        self.goals = self.probe.create_publisher(PoseStamped, "goal_pose", 10)
        self.faults = self.probe.create_publisher(String, "fault_injection", 10)
        for node in (self.plant, *self.nodes):
            assert node.trigger_configure() is TransitionCallbackReturn.SUCCESS
        harness.connect()
        for node in self.nodes:
            assert node.trigger_activate() is TransitionCallbackReturn.SUCCESS

    def send(self, position: Sequence[float], rotvec: Sequence[float]) -> None:
        """Send a goal, and let time run."""
        message = PoseStamped()
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z = (float(x) for x in position)
        o.x, o.y, o.z, o.w = Rotation.from_rotvec(rotvec).as_quat().tolist()
        self.goals.publish(message)
        if not self.plant.is_active:
            assert self.plant.trigger_activate() is TransitionCallbackReturn.SUCCESS

    def fly(self, position: Sequence[float], rotvec: Sequence[float]) -> DiagnosticStatus:
        """Send a goal, and return the status that decides it."""
        before = self.probe.count(self.decider)
        self.send(position, rotvec)
        self.harness.spin_until(
            lambda: any(s in _DECIDED for s in self.states[before:]), "the goal is decided", 60.0
        )
        return self.probe.last(self.decider)

    def inject(self, text: str) -> None:
        """Send a message to fault_injection, and wait until the plant has it."""
        before = [str(fault) for fault in self.plant.plant.active]
        self.faults.publish(String(data=text))
        self.harness.spin_until(
            lambda: [str(fault) for fault in self.plant.plant.active] != before, "the injection"
        )

    def ticks(self, count: int) -> None:
        """Let ticks pass."""
        wanted = self.probe.count("joint_states") + count
        self.harness.spin_until(
            lambda: self.probe.count("joint_states") >= wanted, f"{count} more ticks"
        )

    @property
    def states(self) -> list[str]:
        """The states that the decider has been in, as published."""
        return [values_of(s)["state"] for s in self.probe.messages[self.decider]]

    def left(self, position: Sequence[float], rotvec: Sequence[float]) -> tuple[float, float]:
        """Return how far the plant's true base is from a pose: m, rad."""
        pose = self.plant.plant.pose
        turn = Rotation.from_quat(pose[3:]).inv() * Rotation.from_rotvec(rotvec)
        return float(np.linalg.norm(pose[:3] - position)), float(turn.magnitude())

    def series(self, topic: str) -> tuple[Array, Array]:
        """Return stamps (N,) in s and poses (N, 7), or shapes (N, n), of a topic."""
        messages = self.probe.messages[topic]
        stamps = np.array([nanoseconds(m.header.stamp) / 1e9 for m in messages])
        if TOPICS[topic] is JointState:
            return stamps, np.array([m.position for m in messages])
        rows = []
        for message in messages:
            p, o = message.pose.pose.position, message.pose.pose.orientation
            rows.append([p.x, p.y, p.z, o.x, o.y, o.z, o.w])
        return stamps, np.array(rows)

    def diagnosis(self, what: str) -> DiagnosticStatus:
        """Return the plant's latest diagnostic status of a kind."""
        (status,) = (
            s for s in self.probe.last("/diagnostics").status if s.name == f"plant: {what}"
        )
        return status


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}
