"""What a viewer knows of the stack: topics in, one state of everything out.

The plant publishes its state hundreds or thousands of times a second, and a page is drawn twenty
times. So streams are subscribed by a node that nobody spins: the middleware keeps the last message
of each, and only that one is taken and read, when the page is drawn. Readers that confirm nothing
hold nobody up.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any, Generic, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Pose, PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.messages.statuses import read_status
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.nodes.common.messages import goal_of
from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.nodes.common.watchdog import Pulse, Role
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND
from spacerobot_ros.viewer.port import Firing, Measured, Momenta, Part, StackState

LATEST = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""The last message alone; no publisher waits for its confirmation."""

_SILENT_AFTER = 1.5
"""Wall s without a heartbeat after which a node that was active is silent."""

_FORGOTTEN_AFTER = 60.0
"""Wall s after which nothing more is said of it, nor of what it reported last."""

_JITTER_NS = 200_000
"""By how many wall ns more than at best two messages of one tick may be published apart."""

_EXPECTED_NO_MORE_NS = SECOND
"""Wall ns after which a plant no longer publishes what its momenta should be."""

_MOST_POINTS = 1000
"""Of a planned path."""

M = TypeVar("M")


class Latest(Generic[M]):
    """The last message of a topic, read when it is asked for.

    Parameters
    ----------
    node
        Subscribes; nobody spins it.
    kind, topic
        Of the messages.
    """

    def __init__(self, node: Node, kind: type[M], topic: str) -> None:
        self._kind = kind
        self.sent_ns = 0
        """When the last message that was taken was published, wall ns."""
        self._subscription = node.create_subscription(
            kind, topic, lambda raw: None, LATEST, raw=True
        )

    def take(self) -> M | None:
        """Return the message that has come since the last time, None if none has."""
        handle = self._subscription.handle
        with handle:
            taken = handle.take_message(self._kind, True)
        if taken is None:
            return None
        try:
            message: M = deserialize_message(taken[0], self._kind)
        except RuntimeError:
            return None  # It is no message of that type.
        self.sent_ns = taken[1]["source_timestamp"]
        return message


class Listener:
    """Keeps what is known of the stack.

    Parameters
    ----------
    streams
        A node that nobody spins.
    node
        The viewer's own, whose callbacks take what must not be missed.
    frame
        In which goals are.
    on_status
        Called with ``plant``, ``planner``, ``controller`` or ``replay`` and the full name of the
        node that has reported, for every status.
    """

    def __init__(
        self, streams: Node, node: Node, frame: str, on_status: Callable[[str, str], None]
    ) -> None:
        self._frame, self._on_status = frame, on_status
        self._odom = Latest(streams, Odometry, "odom")
        self._joints = Latest(streams, JointState, "joint_states")
        self._tool = Latest(streams, PoseStamped, "end_effector_pose")
        self._momentum = Latest(streams, Float64MultiArray, "momentum")
        self._expected = Latest(streams, Float64MultiArray, "momentum_expected")
        self._thrusters = Latest(streams, JointState, "thrusters")
        self._names: Sequence[str] = ()
        self._beats: dict[str, _Beat] = {}
        self._statuses: dict[str, Any] = {}
        self._reporters: dict[str, str] = {}
        """The full name of the node that gave each status."""
        self._gone: dict[str, str] = {}
        """Nodes whose reports are not shown, by name; until the node that is named beats again."""
        self._looked = time.monotonic()
        self._planned: Array | None = None
        self._goals: dict[Part, Goal] = {}
        self.forget_state()
        for topic, key, read in (
            ("plant/status", "plant", PlantStatus.from_values),
            ("planner/status", "planner", PlannerStatus.from_values),
            ("controller/status", "controller", ControllerStatus.from_values),
            ("replay/status", "replay", lambda values, _: ReplayStatus.from_values(values)),
        ):
            node.create_subscription(
                DiagnosticStatus, topic, self._status_taker(key, read), LATCHED
            )
        node.create_subscription(Path, "planned_path", self._on_path, LATCHED)
        node.create_subscription(DiagnosticStatus, "heartbeat", self._on_heartbeat, STREAM)
        parts: dict[str, Part] = {"goal_pose": "base", "end_effector/goal_pose": "end_effector"}
        for topic, part in parts.items():
            node.create_subscription(
                PoseStamped, topic, lambda message, part=part: self._on_goal(part, message), STREAM
            )

    def forget_state(self) -> None:
        """Wait for a state of another robot."""
        self._pose: Array | None = None
        self._stamp_s, self._came_at = 0.0, -math.inf
        self._q: tuple[Array, Array, Array] | None = None
        self._measured: Measured | None = None
        self._tool_pose: Array | None = None
        self._momenta: Momenta | None = None
        self._expected_now: Array | None = None
        self._least_apart_ns = _EXPECTED_NO_MORE_NS
        self._firing: Firing | None = None

    def use(self, robot: RobotDescription) -> None:
        """Read the joints of a robot."""
        self._names = robot.joint_names
        self.forget_state()

    def state(self) -> StackState:
        """Take what has come, and return what is known now."""
        now = time.monotonic()
        self._take_streams(now)
        self._look_for_nodes_that_are_gone(now)
        beats = self._beats.items()
        silent = {
            name: now - beat.at
            for name, beat in beats
            if beat.pulse is Pulse.ACTIVE and now - beat.at > _SILENT_AFTER
        }
        inactive = tuple(name for name, beat in beats if beat.pulse is Pulse.INACTIVE and beat.role)
        statuses = {
            key: status
            for key, status in self._statuses.items()
            if self._reporters[key] not in self._gone
        }
        return StackState(
            measured=self._measured,
            tool=self._tool_pose,
            age_s=now - self._came_at,
            momenta=self._momenta,
            firing=self._firing,
            plant=statuses.get("plant"),
            planner=statuses.get("planner"),
            controller=statuses.get("controller"),
            replay=statuses.get("replay"),
            planned_path=None if self._reporters.get("planner") in self._gone else self._planned,
            goals=dict(self._goals),
            silent=silent,
            inactive=inactive,
            absent=frozenset(
                key for key in statuses if self._reporters[key] in (*silent, *inactive)
            ),
            busy=any(
                beat.pulse is Pulse.BUSY and beat.role == Role.COMMANDER.value for _, beat in beats
            ),
        )

    def time_ns(self) -> int:
        """Return the simulated time of the last state, ns; the wall's before the first."""
        if self._measured is None:
            return time.time_ns()
        return round(self._measured.time_s * SECOND)

    # -- streams --------------------------------------------------------------------------------

    def _take_streams(self, now: float) -> None:
        odom, joints = self._odom.take(), self._joints.take()
        if odom is not None:
            pose = _pose_of(odom.pose.pose)
            if pose is not None:
                self._pose = pose
        if joints is not None:
            self._take_joints(joints)
        if (odom is not None or joints is not None) and self._pose is not None and self._q:
            self._came_at = now
            self._measured = Measured(self._stamp_s, self._pose, *self._q)
        tool = self._tool.take()
        if tool is not None:
            self._tool_pose = _pose_of(tool.pose)
        self._take_momenta()
        thrusters = self._thrusters.take()
        if thrusters is not None and len(thrusters.name) == len(thrusters.velocity):
            self._firing = Firing(tuple(thrusters.name), np.array(thrusters.velocity))

    def _take_momenta(self) -> None:
        """Take the momenta and what they should be, if both are of one tick.

        They have no stamps. The plant publishes what they should be right after them: what was
        published before them is of an earlier tick, and what came much later than ever is of a
        later one.
        """
        self._take_expected()
        momentum = self._momentum.take()
        if momentum is None or len(momentum.data) < 7 or not np.all(np.isfinite(momentum.data)):
            return
        if self._expected_now is not None and self._expected.sent_ns < self._momentum.sent_ns:
            self._take_expected()
            late = self._momentum.sent_ns - self._expected.sent_ns
            if late > _EXPECTED_NO_MORE_NS:
                self._expected_now = None
            elif late > 0:
                return  # The next look has a pair.
        if self._expected_now is not None:
            apart = self._expected.sent_ns - self._momentum.sent_ns
            self._least_apart_ns = min(self._least_apart_ns, apart)
            if apart > 3 * self._least_apart_ns + _JITTER_NS:
                return
        numbers = np.array(momentum.data)
        self._momenta = Momenta(numbers[:6], self._expected_now, float(numbers[6]))

    def _take_expected(self) -> None:
        expected = self._expected.take()
        if expected is not None and len(expected.data) >= 6:
            self._expected_now = np.array(expected.data[:6])

    def _take_joints(self, message: JointState) -> None:
        places = {name: i for i, name in enumerate(message.name)}
        if any(name not in places for name in self._names):
            return  # Of another robot.
        order = [places[name] for name in self._names]

        def read(values: Any) -> Array:
            numbers = np.array(values, float)
            if len(numbers) != len(message.name):
                return np.zeros(len(order))
            return np.nan_to_num(numbers[order], nan=0.0, posinf=0.0, neginf=0.0)

        if len(message.position) == len(message.name) and np.all(np.isfinite(message.position)):
            self._q = read(message.position), read(message.velocity), read(message.effort)
            self._stamp_s = _seconds(message.header.stamp)

    # -- what must not be missed ----------------------------------------------------------------

    def _status_taker(
        self, key: str, read: Callable[[dict[str, str], str], Any]
    ) -> Callable[[DiagnosticStatus], None]:
        def take(received: DiagnosticStatus) -> None:
            message = read_status(received)
            try:
                status = read(dict(message.values), message.message)
            except SpaceRobotError:
                return  # A status of some other node, which has other keys.
            self._statuses[key] = status
            self._reporters[key] = message.name
            self._gone.pop(message.name, None)
            if isinstance(status, PlannerStatus) and len(status.goal) == 7:
                self._goals["base"] = Goal(np.array(status.goal[:3]), np.array(status.goal[3:]))
            self._on_status(key, message.name)

        return take

    def _on_path(self, message: Path) -> None:
        poses = message.poses
        step = max(1, len(poses) // _MOST_POINTS)
        kept = [*poses[:-1:step], *poses[-1:]]
        points = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in kept]
        path = np.array(points).reshape(-1, 3)
        self._planned = path if np.all(np.isfinite(path)) else None

    def _on_goal(self, part: Part, message: PoseStamped) -> None:
        try:
            self._goals[part] = goal_of(message, self._frame)
        except SpaceRobotError:
            self._goals.pop(part, None)  # Its commander reports why it is refused.

    def _on_heartbeat(self, message: DiagnosticStatus) -> None:
        with suppress(ValueError):  # Of no node of this package.
            pulse = Pulse(message.message)
            self._beats[message.name] = _Beat(time.monotonic(), pulse, message.hardware_id)
            self._gone = {name: by for name, by in self._gone.items() if by != message.name}

    def _look_for_nodes_that_are_gone(self, now: float) -> None:
        """Show nothing more of nodes without heartbeats for long, nor of a replay that is over."""
        if now - self._looked > _SILENT_AFTER:
            # This process stood still: nobody else did.
            gap = now - self._looked
            self._beats = {n: replace(b, at=b.at + gap) for n, b in self._beats.items()}
        self._looked = now
        a_plant_runs = any(
            beat.role == Role.PLANT.value and beat.is_alive(now) for beat in self._beats.values()
        )
        for name, beat in tuple(self._beats.items()):
            is_replay = beat.role == Role.REPLAY.value
            over = is_replay and a_plant_runs and not beat.is_alive(now)
            if not over and (beat.pulse is Pulse.BUSY or now - beat.at <= _FORGOTTEN_AFTER):
                continue
            del self._beats[name]
            self._gone[name] = name
            if is_replay:
                # What it has shown was reported by nodes that give no heartbeats here.
                recorded = set(self._reporters.values()) - set(self._beats)
                self._gone.update(dict.fromkeys(recorded, name))


@dataclass(frozen=True)
class _Beat:
    """The last heartbeat of a node: when it came, wall s, its pulse and role."""

    at: float
    pulse: Pulse
    role: str

    def is_alive(self, now: float) -> bool:
        """Whether the node is active and not silent."""
        return self.pulse is Pulse.BUSY or (
            self.pulse is Pulse.ACTIVE and now - self.at <= _SILENT_AFTER
        )


def _pose_of(pose: Pose) -> Array | None:
    p, o = pose.position, pose.orientation
    numbers = np.array([p.x, p.y, p.z, o.x, o.y, o.z, o.w])
    length = float(np.linalg.norm(numbers[3:]))
    if not np.all(np.isfinite(numbers)) or length < 1e-6:
        return None
    numbers[3:] /= length
    return numbers


def _seconds(stamp: Any) -> float:
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)
