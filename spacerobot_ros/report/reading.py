"""A flight read from its bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from spacerobot_ros.bag import Bag, RecordedRobot, TopicSeries, read_bag
from spacerobot_ros.bag.recorded_robot import columns
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.errors import (
    PlanningError,
    RecordingError,
    RobotDescriptionError,
    SpaceRobotError,
)
from spacerobot_ros.model import RobotDescription, parse_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.visuals import meshes_in
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import GoalIds
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.report.events import FlightEvent, read_events
from spacerobot_ros.report.flight import Flight, SentGoal, Status
from spacerobot_ros.report.signals import Signal, rotvecs
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import TOPICS

_SAME_CLOCK = 1.0
"""Stamps this near to the log times, in s, come from the same clock."""


def read_flight(path: Path, namespace: str | None = None) -> Flight:
    """Read a bag.

    Parameters
    ----------
    path
        The bag.
    namespace
        Of the robot's topics, with or without the slash before it; None: the first in the order of
        the alphabet of those that the bag has an ``odom`` of.

    Raises
    ------
    RecordingError
        There is no such bag or robot, or it is damaged.
    """
    bag = read_bag(path)
    prefixes = sorted(
        topic.rpartition("/")[0]
        for topic, kind in bag.topics.items()
        if topic.endswith("/odom") and kind == TOPICS["odom"].type
    )
    chosen = prefixes[0] if prefixes else ""
    if namespace is not None:
        chosen = f"/{namespace.strip('/')}".rstrip("/")
        if chosen not in prefixes:
            known = ", ".join(name or "/" for name in prefixes) or "no robot"
            raise RecordingError(
                f"The bag {bag.path} has no robot in the namespace '{namespace}': it has {known}."
            )
    robot = _Recorded(bag, chosen)
    names, nozzles = robot.joint_names, robot.names("thrusters")
    base = robot.true("odom", "pose.pose")
    shape = robot.true("joint_states", "position", len(names))
    position, quaternion = Signal(base.time, base.values[:, :3]), base.values[:, 3:]
    description = _description(robot)
    return Flight(
        file_name=bag.path.name,
        message_count=bag.message_count(),
        metadata=robot.metadata,
        namespace=chosen,
        other_robots=[name or "/" for name in prefixes if name != chosen],
        robot=description,
        joint_names=names,
        position=position,
        quaternion=quaternion,
        attitude=Signal(base.time, rotvecs(quaternion)),
        shape=shape,
        twist=robot.true("odom", "twist.twist"),
        rates=robot.true("joint_states", "velocity", len(names)),
        momentum=_momentum_balance(robot),
        tool=robot.signal("end_effector_pose", "pose"),
        wrench=robot.signal("base_wrench", "wrench"),
        efforts=_efforts(robot, names),
        duty=robot.signal("thrusters", "velocity", len(nozzles)),
        thrust=robot.signal("thrusters", "effort", len(nozzles)),
        thruster_names=nozzles,
        statuses=_statuses(robot),
        sent=_goals(robot, "goal_pose"),
        tool_goals=_goals(robot, "end_effector/goal_pose"),
        planned=[
            np.array([[getattr(p.pose.position, x) for x in "xyz"] for p in message.poses]).reshape(
                -1, 3
            )
            for _, message in robot.messages("planned_path")
        ],
        events=robot.events(),
        meshes=meshes_in(description, bag.attachments) if description is not None else {},
        sensed_pose=robot.sensed("odom", "pose.pose"),
        sensed_shape=robot.sensed("joint_states", "position", len(names)),
    )


class _Recorded(RecordedRobot):
    """The topics of a robot with the time since its first state."""

    def __init__(self, bag: Bag, namespace: str) -> None:
        super().__init__(bag, namespace)
        states = [s for name in ("odom", "joint_states", "momentum") if (s := self.get(name))]
        self._stamped = all(abs(s.stamp[0] - s.time[0]) < _SAME_CLOCK for s in states)
        self._began = min((self._times(s)[0] for s in states), default=bag.start_time)

    def messages(self, name: str) -> list[tuple[float, Any]]:
        """Return all messages of a topic, with their log times."""
        series = self.get(name)
        if series is None:
            return []
        return [(ns / SECOND - self._began, message) for ns, message in series.messages()]

    def signal(self, name: str, path: str, width: int | None = None) -> Signal:
        """Return numbers of a topic, without the messages in which one is missing.

        They are those of an array with ``width`` numbers, or of the message at ``path``.
        """
        fields = [path] if width is not None else columns(_SAME_MESSAGE.get(name, name), path)
        series = self.get(name)
        if series is None:
            return Signal(np.empty(0), np.empty((0, len(fields) if width is None else width)))
        values = series.table(fields, width)
        if width is not None and TOPICS[name].type == TOPICS["joint_states"].type:
            values = _by_name(values, series, self.names(name))
        whole = np.isfinite(values).all(axis=1)
        time = (self._times(series) - self._began)[whole]
        order = np.argsort(time, kind="stable")
        return Signal(time[order], values[whole][order])

    def true(self, name: str, path: str, width: int | None = None) -> Signal:
        """Return :meth:`signal` as it would be with perfect sensors, where these erred."""
        measured = self.signal(name, path, width)
        true = self.signal(f"{name}_true", path, width)
        if not len(true):
            return measured
        before = measured.time < true.time[0]
        return Signal(
            np.concatenate([measured.time[before], true.time]),
            np.concatenate([measured.values[before], true.values]),
        )

    def sensed(self, name: str, path: str, width: int | None = None) -> Signal:
        """Return :meth:`signal` where sensors erred: only then, and while they did."""
        true, measured = self.get(f"{name}_true"), self.signal(name, path, width)
        if true is None:
            return Signal.none(measured.width)
        began = self._times(true)[0] - self._began
        since = measured.time >= began - 1e-9
        return Signal(measured.time[since], measured.values[since])

    def events(self) -> list[FlightEvent]:
        """Return the events that figures show."""
        return read_events(self, self._began, stamped=self._stamped)

    def _times(self, series: TopicSeries) -> Array:
        return series.stamp if self._stamped else series.time


def _by_name(values: Array, series: TopicSeries, names: list[str]) -> Array:
    """Return numbers (N, n) of joints in the order of ``names``; nan of those that lack one."""
    if series.constant("name"):
        return values
    made = np.full_like(values, np.nan)
    for row, given in enumerate(series.field("name")):
        if sorted(given) == sorted(names):
            made[row] = values[row, [given.index(name) for name in names]]
    return made


_SAME_MESSAGE = {"base_wrench": "base_wrench_realised"}
"""State topics whose messages have the fields of another topic's."""


def _momentum_balance(robot: _Recorded) -> Signal:
    """Return momenta and energy (N, 7), without the momenta that thrusters have put in."""
    balance = robot.signal("momentum", "data", 7)
    expected = robot.signal("momentum_expected", "data", 6)
    if len(expected) != len(balance) or not len(balance):
        return balance
    values = balance.values.copy()
    values[:, :6] -= expected.values - expected.values[0]
    return Signal(balance.time, values)


def _description(robot: _Recorded) -> RobotDescription | None:
    for text in robot.bag.robot_descriptions(robot.namespace):
        try:
            return parse_robot(text.decode())
        except (RobotDescriptionError, UnicodeDecodeError):
            continue
    return None


def _efforts(robot: _Recorded, names: list[str]) -> Signal:
    """Return the commanded joint efforts (N, n), by the names of the states."""
    # Commands of velocities hold no efforts, and reading them takes a while.
    actuation = robot.metadata.get("parameters/plant", {}).get("actuation", "").strip('"')
    commands = robot.get("joint_commands") if actuation != "velocity" else None
    given = list(map(str, next(commands.messages())[1].name)) if commands is not None else []
    if commands is None or sorted(given) != sorted(names):
        return Signal(np.empty(0), np.empty((0, len(names))))
    efforts = robot.signal("joint_commands", "effort", len(names))
    return Signal(efforts.time, efforts.values[:, [given.index(name) for name in names]])


def _statuses(robot: _Recorded) -> list[Status]:
    """Return the statuses of the planner, or else of the controller."""
    planned = robot.messages("planner/status")
    kind: type[PlannerStatus | ControllerStatus] = PlannerStatus if planned else ControllerStatus
    statuses = []
    for time, message in planned or robot.messages("controller/status"):
        values = {pair.key: pair.value for pair in message.values}
        try:
            report = kind.from_values(values, message.message)
        except SpaceRobotError:
            report = None
        statuses.append(Status(time, message.message, report))
    return statuses


def _goals(robot: _Recorded, topic: str) -> list[SentGoal]:
    """Return the goal poses that are poses in the frame of the odometry."""
    odom = robot.get("odom")
    world = next(odom.messages())[1].header.frame_id if odom is not None else ""
    goals, ids = [], GoalIds()
    for time, message in robot.messages(topic):
        stamp = message.header.stamp
        goal_id = ids.of(stamp.sec, stamp.nanosec)
        p, o = message.pose.position, message.pose.orientation
        try:
            goal = Goal.checked([p.x, p.y, p.z], [o.x, o.y, o.z, o.w])
        except PlanningError:
            continue
        if not world or message.header.frame_id in ("", world):
            goals.append(SentGoal(time, goal, goal_id))
    return goals
