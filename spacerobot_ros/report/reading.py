"""From a bag to a flight: whatever the bag holds of it, and nothing that it does not."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.bag import Bag, TopicSeries, read_bag
from spacerobot_ros.errors import PlanningError, RobotDescriptionError
from spacerobot_ros.model import RobotDescription, parse_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal
from spacerobot_ros.report.flight import Flight, Status
from spacerobot_ros.report.signals import Signal, rotvecs

_TYPES = {
    "odom": "nav_msgs/msg/Odometry",
    "joint_states": "sensor_msgs/msg/JointState",
    "momentum": "std_msgs/msg/Float64MultiArray",
    "momentum_expected": "std_msgs/msg/Float64MultiArray",
    "planner/status": "diagnostic_msgs/msg/DiagnosticStatus",
    "controller/status": "diagnostic_msgs/msg/DiagnosticStatus",
    "goal_pose": "geometry_msgs/msg/PoseStamped",
    "end_effector/goal_pose": "geometry_msgs/msg/PoseStamped",
    "end_effector_pose": "geometry_msgs/msg/PoseStamped",
    "base_wrench": "geometry_msgs/msg/WrenchStamped",
    "joint_commands": "sensor_msgs/msg/JointState",
    "planned_path": "nav_msgs/msg/Path",
    "robot_description": "std_msgs/msg/String",
}
"""The topics that are read; one of another type is another thing."""

_SAME_CLOCK = 1.0
"""Stamps this near to the log times, in s, come from the same clock."""


def read_flight(path: Path) -> Flight:
    """Read a bag.

    Raises
    ------
    RecordingError
        There is no such bag, or it is damaged.
    """
    bag = read_bag(path)
    prefixes = [
        topic.rpartition("/")[0]
        for topic, kind in bag.topics.items()
        if topic.endswith("/odom") and kind == _TYPES["odom"]
    ]
    space = _Namespace(bag, min(prefixes, default=""))
    odom, joints = space["odom"], space["joint_states"]
    first = next(joints.messages())[1] if joints is not None else None
    names = [str(name) for name in first.name] if first is not None else []
    base = space.signal(odom, _pose("pose.pose."), 7)
    twist = [f"twist.twist.{part}.{x}" for part in ("linear", "angular") for x in "xyz"]
    wrench = [f"wrench.{part}.{x}" for part in ("force", "torque") for x in "xyz"]
    attitude = Signal(base.time, rotvecs(base.values[:, 3:]))
    return Flight(
        file_name=bag.path.name,
        message_count=bag.message_count(),
        metadata=bag.metadata,
        robot=_robot(bag, space),
        joint_names=names,
        position=Signal(base.time, base.values[:, :3]),
        quaternion=base.values[:, 3:],
        attitude=attitude,
        shape=space.signal(joints, ["position"], len(names)),
        twist=space.signal(odom, twist, 6),
        rates=space.signal(joints, ["velocity"], len(names)),
        momentum=_ledger(space),
        tool=space.signal(space["end_effector_pose"], _pose("pose."), 7),
        wrench=space.signal(space["base_wrench"], wrench, 6),
        efforts=_efforts(space, names),
        statuses=[
            Status(time, message.message, {pair.key: pair.value for pair in message.values})
            for time, message in space.messages("planner/status")
            or space.messages("controller/status")
        ],
        sent=_goals(space, odom, "goal_pose"),
        tool_goals=_goals(space, odom, "end_effector/goal_pose"),
        outputs=_outputs(space),
        planned=[
            np.array([[getattr(p.pose.position, x) for x in "xyz"] for p in message.poses]).reshape(
                -1, 3
            )
            for _, message in space.messages("planned_path")
        ],
    )


class _Namespace:
    """The topics of one robot in a bag."""

    def __init__(self, bag: Bag, prefix: str) -> None:
        self._bag, self._prefix = bag, prefix
        states = [s for name in ("odom", "joint_states", "momentum") if (s := self[name])]
        self.actuation = bag.metadata.get("parameters/plant", {}).get("actuation", "").strip('"')
        self._stamped = all(abs(s.stamp[0] - s.time[0]) < _SAME_CLOCK for s in states)
        self._began = min((self._times(s)[0] for s in states), default=bag.start_time)

    def __getitem__(self, name: str) -> TopicSeries | None:
        topic = f"{self._prefix}/{name}"
        if self._bag.topics.get(topic) != _TYPES[name] or not self._bag.message_count(topic):
            return None
        return self._bag[topic]

    def messages(self, name: str) -> list[tuple[float, Any]]:
        """All messages of a topic, with the time since the first state."""
        series = self[name]
        if series is None:
            return []
        return [(ns / 1e9 - self._began, message) for ns, message in series.messages()]

    def signal(self, series: TopicSeries | None, fields: Sequence[str], width: int) -> Signal:
        """Return fields side by side, without the messages in which a number is missing."""
        if series is None:
            return Signal(np.empty(0), np.empty((0, width)))
        columns = [_column(series.field(field), width // len(fields)) for field in fields]
        values = np.column_stack(columns) if width else np.empty((len(series), 0))
        time = self._times(series) - self._began
        whole = np.isfinite(values).all(axis=1)
        order = np.argsort(time[whole], kind="stable")
        return Signal(time[whole][order], values[whole][order])

    def _times(self, series: TopicSeries) -> Array:
        return series.stamp if self._stamped else series.time


def _ledger(space: _Namespace) -> Signal:
    """Return momenta and energy (N, 7), without the momenta that thrusters have put in."""
    ledger = space.signal(space["momentum"], ["data"], 7)
    expected = space.signal(space["momentum_expected"], ["data"], 6)
    if len(expected) != len(ledger) or not len(ledger):
        return ledger
    values = ledger.values.copy()
    values[:, :6] -= expected.values - expected.values[0]
    return Signal(ledger.time, values)


def _column(values: Any, width: int) -> Array:
    """Return a field as (N, width), not a number where a message has another number of values."""
    if isinstance(values, np.ndarray) and values.size == len(values) * width:
        return np.asarray(values, dtype=float).reshape(len(values), width)
    return np.array([v if len(v) == width else np.full(width, np.nan) for v in values], dtype=float)


def _robot(bag: Bag, space: _Namespace) -> RobotDescription | None:
    texts = [data for name, data in bag.attachments.items() if name.endswith(".urdf")]
    texts += [message.data.encode() for _, message in space.messages("robot_description")[-1:]]
    for text in texts:
        try:
            return parse_robot(text.decode())
        except (RobotDescriptionError, UnicodeDecodeError):
            continue
    return None


def _pose(before: str) -> list[str]:
    """Fields of a pose: position, then quaternion x, y, z, w."""
    return [f"{before}position.{x}" for x in "xyz"] + [f"{before}orientation.{x}" for x in "xyzw"]


def _efforts(space: _Namespace, names: list[str]) -> Signal:
    """Return the commanded joint efforts (N, n), by the names of the states."""
    nothing = Signal(np.empty(0), np.empty((0, len(names))))
    # Commands of velocities hold no efforts, and reading them takes a while.
    commands = space["joint_commands"] if space.actuation != "velocity" else None
    if commands is None:
        return nothing
    given = [str(name) for name in next(commands.messages())[1].name]
    if sorted(given) != sorted(names):
        return nothing
    efforts = space.signal(commands, ["effort"], len(names))
    return Signal(efforts.time, efforts.values[:, [given.index(name) for name in names]])


def _outputs(space: _Namespace) -> frozenset[str]:
    """Names of what the controller says the errors of; none where a planner has the goals."""
    if space["planner/status"] is not None:
        return frozenset()
    return frozenset(
        pair.key.removeprefix("error.")
        for _, message in space.messages("controller/status")
        for pair in message.values
        if pair.key.startswith("error.")
    )


def _goals(space: _Namespace, odom: TopicSeries | None, topic: str) -> list[tuple[float, Goal]]:
    """Goal poses that are poses in the frame of the odometry."""
    world = next(odom.messages())[1].header.frame_id if odom is not None else ""
    goals = []
    for time, message in space.messages(topic):
        p, o = message.pose.position, message.pose.orientation
        try:
            goal = Goal.checked([p.x, p.y, p.z], [o.x, o.y, o.z, o.w])
        except PlanningError:
            continue
        if not world or message.header.frame_id in ("", world):
            goals.append((time, goal))
    return goals
