"""A planner node and the plant it flies, in one executor and in lockstep, with a probe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.lifecycle import TransitionCallbackReturn
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.ros_harness import Harness, nanoseconds
from trajectory_msgs.msg import JointTrajectory

from spacerobot_ros.nodes import PlannerNode, PlantNode

Array = npt.NDArray[np.float64]

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
    "method": "lie_bracket",
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

DECIDED = ("reached", "reached_partly", "failed", "refused", "aborted")
"""States of statuses that decide a goal."""

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


def position_goal(position: npt.ArrayLike, sec: int = 0) -> PoseStamped:
    """Return a goal position in the world; the orientation of zeros asks for no attitude."""
    message = goal_at((np.asarray(position).tolist(), [0.0, 0.0, 0.0]))
    message.header.stamp.sec, message.pose.orientation.w = sec, 0.0
    return message


def joint_values(
    messages: Sequence[JointState], names: Sequence[str], field: str = "position"
) -> Array:
    """Return a field (N, n) of messages, in the order of the names."""
    found = [dict(zip(m.name, getattr(m, field), strict=True)) for m in messages]
    return np.array([[each[name] for name in names] for each in found])


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

    def trigger(self, service: str) -> Any:
        client = self.probe.create_client(Trigger, service)
        return self.harness.call(client, Trigger.Request())

    @property
    def states(self) -> list[str]:
        """The published states: idle while states are waited for, and without those of planning."""
        found = ["idle" if state == "waiting" else state for state in self.all_states]
        return [
            state
            for before, state in zip(["", *found], found, strict=False)
            if state != "planning" and (state, before) != ("idle", "idle")
        ]

    @property
    def all_states(self) -> list[str]:
        """The states that the planner has been in, as published."""
        return [values_of(s)["state"] for s in self.probe.messages["planner/status"]]

    def wait(self, *states: str) -> DiagnosticStatus:
        """Wait until the planner's latest state is one of these."""
        self.harness.spin_until(
            lambda: self.all_states and self.all_states[-1] in states,
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
            lambda: any(s in ("reached", "failed", "refused") for s in self.all_states[before:]),
            "the goal is decided",
        )
        return self.probe.last("planner/status")

    def error_to(self, place: Place) -> tuple[float, float]:
        """Return how far the measured base is from a goal: m, rad."""
        position, attitude = pose_arrays(self.probe.last("odom").pose.pose)
        left = attitude.inv() * Rotation.from_rotvec(place[1])
        return float(np.linalg.norm(position - place[0])), float(left.magnitude())
