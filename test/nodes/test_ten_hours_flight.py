"""Ten hours of a stack under efforts, goal after goal: in lockstep, and by stamps in real time.

``TEN_HOURS=SECONDS`` flies a part of them.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from rclpy.lifecycle import TransitionCallbackReturn
from rclpy.node import Node
from support.oracles import Array, Motion, PinocchioOracle
from support.ros_harness import DEEP_LATCHED, Harness

from spacerobot_ros.nodes import CoordinatedControlNode, PlantNode
from spacerobot_ros.simulation.plant import Plant

DURATION = float(os.environ.get("TEN_HOURS", "36000"))
FASTER = 60.0
"""Simulated over wall time in real time: ten hours in ten minutes."""

RATE = 20.0
_DECIDED = ("reached", "failed", "refused", "aborted")
# Commands that are held for five ticks on a busy machine leave the loops stable: the lightest load,
# the second link of 3 kg, has a damper of 3 N s/m over 0.25 s.
GAINS = {
    f"gains.{group}.{name}": gain
    for group in ("base_position", "base_attitude", "end_effector_position")
    for name, gain in (("kp", 1.0), ("kd", 3.0))
}
PLANT: dict[str, Any] = {
    "robot": "planar_manipulator",
    "actuation": "effort",
    "tick_rate": RATE,
    "initial_joint_positions": [-1.0, 1.1],
    "marker_period": 0.0,
}
CONTROLLER: dict[str, Any] = {
    "robot": "planar_manipulator",
    "tick_rate": RATE,
    "law": "transposed_jacobian",
    "position_tolerance": 0.005,
    "attitude_tolerance": 0.01,
    "settle_time": 0.5,
    "time_limit": 300.0,
    **GAINS,
}


class Operator:
    """Sends a goal as soon as the one before is decided, and counts what became of them."""

    def __init__(self, harness: Harness) -> None:
        node = harness.add(Node("operator", context=harness.context))
        self._rng = np.random.default_rng(7)
        self._goals = node.create_publisher(PoseStamped, "goal_pose", 10)
        self._last = ""
        self.decided: dict[str, int] = {}
        node.create_subscription(
            DiagnosticStatus, "controller/status", self._on_status, DEEP_LATCHED
        )

    def send(self) -> None:
        goal = PoseStamped()
        goal.header.frame_id = "world"
        p = goal.pose.position
        p.x, p.y = self._rng.uniform(-0.1, 0.1, 2).tolist()
        goal.pose.orientation.w = 1.0
        self._goals.publish(goal)

    def _on_status(self, status: DiagnosticStatus) -> None:
        said = {pair.key: pair.value for pair in status.values}
        state, goal = said["state"], said.get("goal_id", "")
        if state in _DECIDED and goal and goal != self._last:
            self._last = goal
            self.decided[state] = self.decided.get(state, 0) + 1
            self.send()


def resident() -> float:
    """Return the memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def fly_until(harness: Harness, plant: PlantNode, end: float) -> None:
    """Run callbacks until a simulated time, s."""
    harness.spin_until(lambda: plant.time_ns >= end * 1e9, f"{end:g} s", timeout=7200.0)


def by_pinocchio(oracle: PinocchioOracle, plant: Plant) -> Array:
    """Return both momenta (6,) of the state that a plant reports."""
    v_WB_B, omega_WB_B = plant.twist[:3], plant.twist[3:]
    motion = Motion(plant.q, plant.qdot, plant.pose[3:], plant.pose[:3], np.zeros(3), omega_WB_B)
    p, L, _ = oracle.momentum(motion, v_WB_B=v_WB_B)
    return np.concatenate([p, L])


@pytest.mark.slow
@pytest.mark.parametrize("real_time", [False, True], ids=["lockstep", "real_time"])
def test_ten_hours_of_goals(harness: Harness, real_time: bool) -> None:
    mode: dict[str, Any] = {"time_mode": "lockstep"}
    if real_time:
        mode = {"time_mode": "realtime", "real_time_factor": FASTER, "command_timeout": 10.0}
    plant = harness.make(PlantNode, {**PLANT, **mode}, name="plant", autostart=False)
    control = harness.make(
        CoordinatedControlNode, CONTROLLER, name="coordinated_control", autostart=False
    )
    operator = Operator(harness)
    for node in (plant, control):
        assert node.trigger_configure() is TransitionCallbackReturn.SUCCESS
    harness.connect()
    for node in (control, plant):
        assert node.trigger_activate() is TransitionCallbackReturn.SUCCESS
    operator.send()
    robot = plant.plant.robot
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    memory, worst = [], 0.0
    began = time.process_time()
    for hour in range(1, 11):
        fly_until(harness, plant, hour * DURATION / 10.0)
        drift = np.abs(by_pinocchio(oracle, plant.plant) - plant.plant.expected_momenta).max()
        worst = max(worst, float(drift))
        memory.append(resident())
        print(
            f"\n{plant.time_ns / 1e9:.0f} s, {time.process_time() - began:.0f} s of CPU: "
            f"{operator.decided}, {memory[-1]:.1f} MiB, momentum {drift:.2g}",
            end="",
        )
    assert set(operator.decided) == {"reached"}
    assert operator.decided["reached"] > DURATION / 100.0
    assert worst < 1e-9
    assert memory[-1] - memory[1] < 2.0
    assert np.abs(np.asarray(plant.plant.pose)[:3]).max() < 0.2
