"""Collects the stack's topics into one :class:`~spacerobot_ros.viewer.state.StackState`.

The plant publishes its state hundreds or thousands of times per second; the page is drawn
twenty times per second. Therefore, a node that is not spun subscribes to the streams: the
middleware keeps only the last message of each stream, which is read when the page is drawn.
Subscriptions are best effort, so that no publisher waits for the viewer.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Generic, TypeVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from spacerobot_ros.bag.playback import ReplayStatus
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight.series import Signal
from spacerobot_ros.messages.diagnostics import read_status
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.nodes.common.messages import LatchedSubscription, goal_of, pose_array
from spacerobot_ros.nodes.common.node import LATCHED, STREAM
from spacerobot_ros.nodes.common.watchdog import HeartbeatState, Role
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.simulation.clearance import ClearanceStatus
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND, stamp_to_ns
from spacerobot_ros.viewer.state import Firing, Measured, Momenta, Part, StackState

LATEST_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
"""QoS of streams: only the last message is kept, without acknowledgement."""

_MAX_CALL_INTERVAL = 1.5
"""Wall time, s, between two calls above which this process is assumed to have been suspended."""

_TIME_UNTIL_SILENT_NODE_IS_HIDDEN = 60.0
"""Wall time, s, after which a silent node and its last reports are no longer shown."""

_JITTER_NS = 200_000
"""Jitter, ns of wall time, in the publication times of two messages from one tick."""

_LONGEST_EXPECTED_DELAY_NS = SECOND
"""Wall time, ns, after which a plant is assumed to publish no expected momenta."""

_REFUSED = " A later goal is refused: "
"""Text between the message about the pursued goal and the reason why a later goal was refused."""

_MAX_PATH_POINTS = 1000

_MAX_MOTION_POINTS = 200
"""Maximum number of configurations in a planned motion; link poses are computed for each of
them.
"""

M = TypeVar("M")


class LatestMessage(Generic[M]):
    """The last message of a topic, deserialized on demand."""

    def __init__(self, node: Node, kind: type[M], topic: str) -> None:
        self._kind = kind
        self.sent_ns = 0
        """Publication time of the last message taken, ns of wall time."""
        self._subscription = node.create_subscription(
            kind, topic, lambda raw: None, LATEST_QOS, raw=True
        )

    def take(self) -> M | None:
        """Return the message received since the last call; None if there is no new message."""
        handle = self._subscription.handle
        with handle:
            taken = handle.take_message(self._kind, True)
        if taken is None:
            return None
        try:
            message: M = deserialize_message(taken[0], self._kind)
        except RuntimeError:
            return None  # Not a message of that type.
        self.sent_ns = taken[1]["source_timestamp"]
        return message


class Listener:
    """Collects the stack state.

    The node ``streams``, which is not spun, receives states; callbacks of ``node`` receive
    statuses, goals (in ``frame``) and heartbeats. For every status, ``on_status`` is called with
    ``plant``, ``planner``, ``controller`` or ``replay``, and with the full name of the publishing
    node. An active node is silent if it has sent no heartbeat for ``silent_after`` (s of wall
    time; 0: never).
    """

    def __init__(
        self,
        streams: Node,
        node: Node,
        frame: str,
        on_status: Callable[[str, str], None],
        silent_after: float = 1.5,
    ) -> None:
        self._frame, self._on_status = frame, on_status
        self._silent_after = silent_after or math.inf
        self._odom = LatestMessage(streams, Odometry, "odom")
        self._joints = LatestMessage(streams, JointState, "joint_states")
        self._end_effector = LatestMessage(streams, PoseStamped, "end_effector_pose")
        self._target = LatestMessage(streams, Odometry, "target/odom")
        self._momentum = LatestMessage(streams, Float64MultiArray, "momentum")
        self._expected = LatestMessage(streams, Float64MultiArray, "momentum_expected")
        self._thrusters = LatestMessage(streams, JointState, "thrusters")
        self._clearances = LatestMessage(streams, DiagnosticStatus, "clearance")
        self._names: Sequence[str] = ()
        self._beats: dict[str, _Heartbeat] = {}
        self._statuses: dict[str, Any] = {}
        self._reporters: dict[str, str] = {}
        """Full name of the publishing node, by kind of status."""
        self._hidden: dict[str, str] = {}
        """Nodes whose reports are hidden, and, for each, the node whose next heartbeat shows the
        reports again.
        """
        self._last_call = time.monotonic()
        self._planned: Array | None = None
        self._path: tuple[int, Signal] | None = None
        """Start time, ns, and base poses (k, 7) predicted by a planner."""
        self._last_schedule: JointTrajectory | None = None
        """The path is latched, so it may arrive before the corresponding robot."""
        self._schedule: tuple[int, Signal] | None = None
        """Start time, ns, and planned joint positions (m, n)."""
        self._motion: Array | None = None
        self._goals: dict[Part, Goal] = {}
        self._pursued_goals: dict[Part, Goal] = {}
        """The goals that were set when the pursued goal started."""
        self._pursued: dict[str, Any] = {}
        """The last status of the pursued goal, by kind of status."""
        self.forget_state()
        self._status_topics = []
        for topic, key, read in (
            ("plant/status", "plant", PlantStatus.from_values),
            ("planner/status", "planner", PlannerStatus.from_values),
            ("controller/status", "controller", ControllerStatus.from_values),
            ("replay/status", "replay", lambda values, _: ReplayStatus.from_values(values)),
        ):
            take = partial(self._on_status_message, key, read)
            self._status_topics.append(LatchedSubscription(node, DiagnosticStatus, topic, take))
        node.create_subscription(Path, "planned_path", self._on_path, LATCHED)
        node.create_subscription(JointTrajectory, "gait_schedule", self._on_schedule, LATCHED)
        node.create_subscription(DiagnosticStatus, "heartbeat", self._on_heartbeat, STREAM)
        node.create_subscription(Path, "goal_path", self._on_goal_path, STREAM)
        parts: dict[str, Part] = {"goal_pose": "base", "end_effector/goal_pose": "end_effector"}
        for topic, part in parts.items():
            node.create_subscription(
                PoseStamped, topic, lambda message, part=part: self._on_goal(part, message), STREAM
            )

    def forget_state(self) -> None:
        """Drop the received state if the robot changes."""
        self._pose: Array | None = None
        self._twist = np.zeros(6)
        self._stamp_s, self._came_at = 0.0, -math.inf
        self._q: tuple[Array, Array, Array] | None = None
        self._measured: Measured | None = None
        self._tool_pose: Array | None = None
        self._target_pose: Array | None = None
        self._momenta: Momenta | None = None
        self._expected_momenta: Array | None = None
        self._least_apart_ns = _LONGEST_EXPECTED_DELAY_NS
        self._firing: Firing | None = None
        self._clearance: ClearanceStatus | None = None

    def use(self, robot: RobotDescription) -> None:
        """Start reading a robot's joint states."""
        self._names = robot.joint_names
        self.forget_state()
        if self._last_schedule is not None:
            self._on_schedule(self._last_schedule)

    def state(self) -> StackState:
        """Process the received messages and return the stack state."""
        for each in self._status_topics:
            each.renew()
        now = time.monotonic()
        self._take_streams(now)
        self._hide_long_silent_nodes(now)
        beats = self._beats.items()
        silent = {
            name: now - beat.at
            for name, beat in beats
            if beat.pulse is HeartbeatState.ACTIVE and now - beat.at > self._silent_after
        }
        inactive = tuple(
            name for name, beat in beats if beat.pulse is HeartbeatState.INACTIVE and beat.role
        )
        statuses = {
            key: status
            for key, status in self._statuses.items()
            if self._reporters[key] not in self._hidden
        }
        planner_hidden = self._reporters.get("planner") in self._hidden
        return StackState(
            measured=self._measured,
            tool=self._tool_pose,
            target=self._target_pose,
            age_s=now - self._came_at,
            momenta=self._momenta,
            firing=self._firing,
            clearance=self._clearance,
            **statuses,
            planned_path=None if planner_hidden else self._planned,
            planned_motion=None if planner_hidden else self._motion,
            goals=dict(self._goals),
            silent=silent,
            inactive=inactive,
            absent=frozenset(
                key for key in statuses if self._reporters[key] in (*silent, *inactive)
            ),
            busy=any(
                beat.pulse is HeartbeatState.BUSY and beat.role == Role.COMMANDER.value
                for _, beat in beats
            ),
        )

    def time_ns(self) -> int:
        """Return the simulated time of the last state, ns, or the wall time before the first
        state.
        """
        if self._measured is None:
            return time.time_ns()
        return round(self._measured.time_s * SECOND)

    # -- streams --------------------------------------------------------------------------------

    def _take_streams(self, now: float) -> None:
        odom, joints = self._odom.take(), self._joints.take()
        if odom is not None:
            pose = pose_array(odom.pose.pose.position, odom.pose.pose.orientation)
            if pose is not None:
                self._pose = pose
                moves, turns = odom.twist.twist.linear, odom.twist.twist.angular
                self._twist = np.nan_to_num([getattr(v, x) for v in (moves, turns) for x in "xyz"])
        if joints is not None:
            self._take_joints(joints)
        if (odom is not None or joints is not None) and self._pose is not None and self._q:
            self._came_at = now
            self._measured = Measured(self._stamp_s, self._pose, *self._q, self._twist)
        tool = self._end_effector.take()
        if tool is not None:
            self._tool_pose = pose_array(tool.pose.position, tool.pose.orientation)
        target = self._target.take()
        if target is not None:
            at = target.pose.pose
            self._target_pose = pose_array(at.position, at.orientation)
        self._take_momenta()
        thrusters = self._thrusters.take()
        if thrusters is not None and len(thrusters.name) == len(thrusters.velocity):
            self._firing = Firing(tuple(thrusters.name), np.array(thrusters.velocity))
        clearance = self._clearances.take()
        if clearance is not None:
            with suppress(SpaceRobotError):  # The message is from another package.
                self._clearance = ClearanceStatus.from_values(read_status(clearance).values)

    def _take_momenta(self) -> None:
        """Take the momenta and the expected momenta, if both are from the same tick.

        They have no stamps. The plant publishes the expected momenta right after the momenta:
        expected momenta published before them are from an earlier tick, and those published
        much later than usual are from a later tick.
        """
        self._take_expected_momenta()
        momentum = self._momentum.take()
        if momentum is None or len(momentum.data) < 7 or not np.all(np.isfinite(momentum.data)):
            return
        if self._expected_momenta is not None and self._expected.sent_ns < self._momentum.sent_ns:
            self._take_expected_momenta()
            late = self._momentum.sent_ns - self._expected.sent_ns
            if late > _LONGEST_EXPECTED_DELAY_NS:
                self._expected_momenta = None
            elif late > 0:
                return  # The next call receives a complete pair.
        if self._expected_momenta is not None:
            apart = self._expected.sent_ns - self._momentum.sent_ns
            self._least_apart_ns = min(self._least_apart_ns, apart)
            if apart > 3 * self._least_apart_ns + _JITTER_NS:
                return
        numbers = np.array(momentum.data)
        self._momenta = Momenta(numbers[:6], self._expected_momenta)

    def _take_expected_momenta(self) -> None:
        expected = self._expected.take()
        if expected is not None and len(expected.data) >= 6:
            self._expected_momenta = np.array(expected.data[:6])

    def _take_joints(self, message: JointState) -> None:
        places = {name: i for i, name in enumerate(message.name)}
        if any(name not in places for name in self._names):
            return  # The message is of another robot.
        order = [places[name] for name in self._names]

        def read(values: Any) -> Array:
            numbers = np.array(values, float)
            if len(numbers) != len(message.name):
                return np.zeros(len(order))
            return np.nan_to_num(numbers[order], nan=0.0, posinf=0.0, neginf=0.0)

        if len(message.position) == len(message.name) and np.all(np.isfinite(message.position)):
            self._q = read(message.position), read(message.velocity), read(message.effort)
            self._stamp_s = stamp_to_ns(message.header.stamp) / SECOND

    # -- statuses, goals, heartbeats ------------------------------------------------------------

    def _on_status_message(
        self, key: str, read: Callable[[dict[str, str], str], Any], received: DiagnosticStatus
    ) -> None:
        message = read_status(received)
        try:
            status = read(dict(message.values), message.message)
        except SpaceRobotError:
            return  # The status is from another kind of node.
        status = self._after_refusal(key, status)
        self._statuses[key] = status
        self._reporters[key] = message.name
        self._hidden.pop(message.name, None)
        if isinstance(status, PlannerStatus) and status.state is not PlannerState.REFUSED:
            with suppress(SpaceRobotError):  # An unreadable goal, from another package.
                self._take_planned_goal(status)
        self._on_status(key, message.name)

    def _after_refusal(self, key: str, status: Any) -> Any:
        """Return the status to show: if a goal is refused while another is pursued, the status of
        the pursued goal with the reason for the refusal; the pursued goal is also shown again.
        """
        pursued = self._pursued.get(key)
        match status:
            case (
                PlannerStatus(state=PlannerState.EXECUTING)
                | ControllerStatus(state=ControllerState.TRACKING | ControllerState.STALLED)
            ):
                if pursued is None or pursued.goal_id != status.goal_id:
                    self._pursued_goals = dict(self._goals)
                self._pursued[key] = status
            case (
                PlannerStatus(state=PlannerState.REFUSED)
                | ControllerStatus(state=ControllerState.REFUSED)
            ) if pursued is None or pursued.goal_id != status.goal_id:
                if pursued is None:
                    self._goals = {}
                    return status
                self._goals = dict(self._pursued_goals)
                return replace(pursued, message=f"{pursued.message}{_REFUSED}{status.message}")
            case PlannerStatus(state=PlannerState.PLANNING):
                pass  # Meanwhile, the flight continues.
            case _:
                self._pursued.pop(key, None)
        return status

    def _take_planned_goal(self, status: PlannerStatus) -> None:
        """Replace the previous goal with the planner's goal, if the status reports one."""
        links = {
            link: Goal.of_end_effectors([EndEffectorGoal.checked(link, values)])
            for link, values in status.end_effector_goals.items()
        }
        if not links and len(status.goal) != 7:
            return
        # The goal of a controller's end-effector is kept.
        self._goals = {part: g for part, g in self._goals.items() if not g.end_effectors}
        self._goals.pop(BASE_GOAL_KEY, None)
        if len(status.goal) == 7:
            pose = np.array(status.goal)
            self._goals[BASE_GOAL_KEY] = Goal(pose[:3], pose[3:])
        self._goals |= links

    def _on_path(self, message: Path) -> None:
        poses = message.poses
        step = max(1, len(poses) // _MAX_PATH_POINTS)
        kept = [*poses[:-1:step], *poses[-1:]]
        points = [(p.pose.position.x, p.pose.position.y, p.pose.position.z) for p in kept]
        path = np.array(points).reshape(-1, 3)
        self._planned = path if np.all(np.isfinite(path)) else None
        found = [pose_array(p.pose.position, p.pose.orientation) for p in kept]
        whole = [pose for pose in found if pose is not None]
        times = np.array([stamp_to_ns(p.header.stamp) for p in kept]) / SECOND
        begin = stamp_to_ns(message.header.stamp)
        complete = len(whole) == len(kept) > 1
        self._path = (begin, Signal(times, np.array(whole))) if complete else None
        self._combine_path_and_schedule()

    def _on_schedule(self, message: JointTrajectory) -> None:
        self._last_schedule = message
        places = [message.joint_names.index(n) for n in self._names if n in message.joint_names]
        positions = [list(point.positions) for point in message.points]
        complete = len(places) == len(self._names)
        fitting = all(len(each) == len(message.joint_names) for each in positions)
        self._schedule = None
        if positions and complete and fitting:
            begin = stamp_to_ns(message.header.stamp)
            since = [stamp_to_ns(point.time_from_start) for point in message.points]
            times = (np.array(since) + begin) / SECOND
            self._schedule = begin, Signal(times, np.array(positions)[:, places])
        self._combine_path_and_schedule()

    def _combine_path_and_schedule(self) -> None:
        self._motion = None
        if self._path is None or self._schedule is None or self._path[0] != self._schedule[0]:
            return
        (_, path), (_, schedule) = self._path, self._schedule
        step = -(-len(path) // _MAX_MOTION_POINTS)
        kept = [*range(0, len(path) - 1, step), len(path) - 1]
        shapes = [np.interp(path.time[kept], schedule.time, q) for q in schedule.values.T]
        motion = np.column_stack([path.values[kept], *shapes])
        self._motion = motion if np.all(np.isfinite(motion)) else None

    def _on_goal(self, part: Part, message: PoseStamped) -> None:
        try:
            self._goals[part] = goal_of(message, self._frame)
        except SpaceRobotError:
            # The planner or the controller reports the refusal of an invalid goal.
            self._goals.pop(part, None)

    def _on_goal_path(self, message: Path) -> None:
        if message.poses:
            last = message.poses[-1]
            last.header.frame_id = last.header.frame_id or message.header.frame_id
            self._on_goal("base", last)

    def _on_heartbeat(self, message: DiagnosticStatus) -> None:
        with suppress(ValueError):  # The heartbeat is from another package.
            pulse = HeartbeatState(message.message)
            self._beats[message.name] = _Heartbeat(time.monotonic(), pulse, message.hardware_id)
            self._hidden = {name: by for name, by in self._hidden.items() if by != message.name}

    def _hide_long_silent_nodes(self, now: float) -> None:
        if now - self._last_call > _MAX_CALL_INTERVAL:
            # This process was suspended, so the other nodes were not silent.
            gap = now - self._last_call
            self._beats = {n: replace(b, at=b.at + gap) for n, b in self._beats.items()}
        self._last_call = now
        a_plant_runs = any(
            beat.role == Role.PLANT.value and beat.is_alive(now, self._silent_after)
            for beat in self._beats.values()
        )
        for name, beat in tuple(self._beats.items()):
            is_replay = beat.role == Role.REPLAY.value
            over = is_replay and a_plant_runs and not beat.is_alive(now, self._silent_after)
            if not over and (
                beat.pulse is HeartbeatState.BUSY
                or now - beat.at <= _TIME_UNTIL_SILENT_NODE_IS_HIDDEN
            ):
                continue
            del self._beats[name]
            self._hidden[name] = name
            if is_replay:
                # The recorded reports are from nodes without heartbeats here.
                recorded = set(self._reporters.values()) - set(self._beats)
                self._hidden.update(dict.fromkeys(recorded, name))


@dataclass(frozen=True)
class _Heartbeat:
    at: float
    pulse: HeartbeatState
    role: str

    def is_alive(self, now: float, silent_after: float) -> bool:
        """Whether the node is busy, or active and silent for at most ``silent_after`` s."""
        return self.pulse is HeartbeatState.BUSY or (
            self.pulse is HeartbeatState.ACTIVE and now - self.at <= silent_after
        )
