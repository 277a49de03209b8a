"""Converts a flight to a bag, with the messages that the nodes would publish, and to a table.

A table has the same columns and units as the bag's tables.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag import LATCHED, BagWriter, QosProfile
from spacerobot_ros.bag.tables import (
    Field,
    TopicTable,
    array_field,
    number_field,
    with_euler_angles,
)
from spacerobot_ros.commanding.goal_follower import STATUS_TOPICS
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.flight.data import FlightData
from spacerobot_ros.messages.builders import (
    RobotMarkers,
    RobotTransforms,
    goal_markers,
    goal_messages,
    path_message,
    state_message,
    trajectory_message,
)
from spacerobot_ros.messages.definitions import encode
from spacerobot_ros.messages.diagnostics import StatusRecord, encode_diagnostics
from spacerobot_ros.messages.readers import MessageTemplate
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.kinematics import ForwardKinematics
from spacerobot_ros.model.meshes import meshes_for_bag
from spacerobot_ros.model.thrusters import IN_URDF, find_thrusters
from spacerobot_ros.planning import GaitSchedule
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.resources import __version__
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import TOPICS, Topic, pose_topic, state_topics, topic_named

_GOAL_STAMP_NS = 1
"""Stamp of mission goals at time zero, ns."""


_BLOCK_NS = 60 * SECOND
"""Time span, in ns, of the messages created at once: all messages of a long flight would exhaust
the memory."""

_PUBLISHED_QOS = QosProfile(depth=100)
"""QoS offered by the nodes on topics that are not latched."""


@dataclass(frozen=True)
class _Stream:
    """The messages of a topic, published at ``time_ns`` (N,), ns, in ascending order.

    ``messages`` returns the bytes of some messages; ``stamp_ns`` is the stamp of all messages;
    None: each is stamped with its publication time.
    """

    topic: Topic
    time_ns: NDArray[np.int64]
    messages: Callable[[slice], Sequence[bytes]]
    stamp_ns: int | None = None

    @classmethod
    def of(
        cls, topic: Topic, messages: Iterable[tuple[int, bytes]], stamp_ns: int | None = None
    ) -> _Stream:
        """Return a stream of messages with their times; the messages may be in any order."""
        ordered = sorted(messages, key=lambda each: each[0])
        times = np.array([time for time, _ in ordered], dtype=np.int64)
        found = [message for _, message in ordered]
        return cls(topic, times, lambda rows: found[rows], stamp_ns)


def write_flight(flight: FlightData, writer: BagWriter) -> None:
    """Write a flight into an empty bag: every topic that the nodes publish.

    Raises
    ------
    RecordingError
        The bag cannot be written, or a message type is not installed.
    """
    scenario = flight.scenario
    chosen = {f"/{name.lstrip('/')}" for name in scenario.config("recorder").topics.split()}
    streams = []
    for stream in _streams(flight):
        name = f"/{stream.topic.name.lstrip('/')}"
        if len(stream.time_ns) and (not chosen or name in chosen):
            qos = LATCHED if stream.topic.latched else _PUBLISHED_QOS
            streams.append((writer.add_topic(name, stream.topic.type, qos), stream))
    writer.add_metadata("spacerobot", {"version": __version__})
    for title, values in scenario.records(["plant", *scenario.commanders]).items():
        writer.add_metadata(title, values)
    bodies = {"robot_description.urdf": flight.required_robot()}
    if flight.target is not None:
        bodies["target.robot_description.urdf"] = flight.target
    for name, body in bodies.items():
        writer.add_attachment(name, body.urdf.encode(), "application/xml", 0)
        for mesh, data in meshes_for_bag(body).items():
            writer.add_attachment(mesh, data, "model/stl", 0)
    end = max((int(stream.time_ns[-1]) for _, stream in streams), default=0)
    for begin in range(0, end + 1, _BLOCK_NS):
        entries: list[tuple[int, int, bytes, int]] = []
        for channel, stream in streams:
            rows = slice(*np.searchsorted(stream.time_ns, (begin, begin + _BLOCK_NS)).tolist())
            for time, message in zip(
                stream.time_ns[rows].tolist(), stream.messages(rows), strict=True
            ):
                stamp = time if stream.stamp_ns is None else stream.stamp_ns
                entries.append((time, channel, message, stamp))
        # The sort is stable: messages with equal times keep the order of the streams.
        for time, channel, message, stamp in sorted(entries, key=lambda entry: entry[0]):
            writer.write(channel, message, time, stamp)
    counts = {"messages": str(writer.messages_written), "messages_lost": "0"}
    writer.add_metadata("recorder", counts)


def _streams(flight: FlightData) -> Iterator[_Stream]:
    """Yield all topics; messages with equal times are in this order."""
    yield from _description_streams(flight)
    yield from _goal_streams(flight)
    yield from _state_streams(flight)
    yield from _clearance_streams(flight)
    yield from _frame_streams(flight)
    yield from _command_streams(flight)
    yield from _plan_streams(flight)
    yield from _status_streams(flight)


def _state_streams(flight: FlightData) -> Iterator[_Stream]:
    period = round(flight.control_period * SECOND)
    stamps: NDArray[np.int64] = np.arange(len(flight.time), dtype=np.int64) * period
    config, robot = flight.scenario.plant, flight.required_robot()
    quantities = topic_quantities(flight)
    thrusters: tuple[str, ...] = ()
    if "thruster_duty" in quantities:
        thrusters = tuple(find_thrusters(config.thrusters, robot).names)
    clock = TOPICS["/clock"]
    yield _stamped_stream(clock, stamps, encode(clock.type), {})
    every = config.ticks_of(config.base_pose_period) or 1
    lost = dict.fromkeys(("odom", *(pose_topic(x).name for x in config.end_effectors)), "pose_lost")
    lost["target/odom"] = "target_lost"
    for topic in state_topics(config.end_effectors):
        if not all(field.quantity in quantities for field in topic.state):
            continue
        names = thrusters if topic.array_entries_of == "thrusters" else flight.joint_names
        base = config.prefix_for(robot) + robot.base_link
        target = "" if flight.target is None else flight.target.base_link
        message = state_message(topic, names, config.world_frame, base, target)
        columns = {
            field.columns[0]: quantities[field.quantity]
            for field in topic.state
            if quantities[field.quantity].shape[1]
        }
        rows = np.ones(len(stamps), dtype=bool)
        missing = flight.quantities.get(lost.get(topic.name, ""))
        if missing is not None:
            rows = missing[:, 0] == 0
        if not topic.every_tick:
            rows = np.arange(len(stamps)) % every == 0
        if topic.name == "odom" and flight.covariances:
            since, covariances = zip(*flight.covariances, strict=True)
            at = np.array(covariances)[np.searchsorted(since, stamps, side="right") - 1]
            columns |= {"pose.covariance": at[:, :36], "twist.covariance": at[:, 36:]}
        chosen = {path: values[rows] for path, values in columns.items()}
        yield _stamped_stream(topic, stamps[rows], message, chosen)


def _stamped_stream(
    topic: Topic, stamps: NDArray[np.int64], message: bytes, columns: Mapping[str, Array]
) -> _Stream:
    """Return a stream of copies of a message with other stamps and numbers."""

    template = MessageTemplate(topic.type, message)

    def copies(rows: slice) -> list[bytes]:
        chosen = {path: values[rows] for path, values in columns.items()}
        return template.copies(stamps[rows], chosen)

    return _Stream(topic, stamps, copies)


def _clearance_streams(flight: FlightData) -> Iterator[_Stream]:
    """Yield the clearances if the distances are exact, as those of the plant node are."""
    if flight.clearance is None or not flight.clearance.geometry.exact:
        return
    plant = flight.scenario.plant
    statuses = flight.clearance.statuses(max(1, plant.ticks_of(plant.clearance_period)))
    records = [(round(x.time_s * SECOND), StatusRecord.of("/plant", x)) for x in statuses]
    yield _status_stream("clearance", records)


def _frame_streams(flight: FlightData) -> Iterator[_Stream]:
    """Yield the transforms of the measured frames, and the markers of the true frames."""
    config, robot = flight.scenario.plant, flight.required_robot()
    period, quantities = config.period_ns, topic_quantities(flight)
    # Like those that the recorder writes if no node publishes transforms.
    every = config.ticks_of(flight.scenario.config("recorder").tf_period)
    if every:
        frames = RobotTransforms(robot, config.world_frame, config.prefix_for(robot), links=True)
        ticks = np.arange(0, len(flight.time), every)
        lost = flight.quantities.get("pose_lost")
        if lost is not None:
            ticks = ticks[lost[ticks, 0] == 0]
        pose, q = (quantities[f"measured_{name}"][ticks] for name in ("pose", "q"))
        stamps = ticks * period

        def transforms(rows: slice) -> list[bytes]:
            return frames.messages(stamps[rows], pose[rows], q[rows])

        yield _Stream(TOPICS["/tf"], stamps, transforms)
        static = frames.static_message(0)
        if static is not None:
            yield _Stream.of(TOPICS["/tf_static"], [(0, static)])
    every = config.ticks_of(config.marker_period)
    if every:
        shown = np.arange(0, len(flight.time), every)
        markers = RobotMarkers(robot, flight.target, config.world_frame)
        kinematics = ForwardKinematics(robot)
        order = [kinematics.links.index(link.name) for link in robot.links]
        base, target = flight.pose, flight.target_pose.values

        def make_markers(rows: slice) -> list[bytes]:
            chosen = shown[rows]
            R, r = (each[:, order] for each in kinematics.link_poses(flight.q[chosen]))
            # The link attitudes are stacked side by side.
            R = R.transpose(0, 2, 1, 3).reshape(len(chosen), 3, -1)
            targets = target[chosen] if len(target) else [None] * len(chosen)
            return [
                markers.message(int(tick) * period, base[tick], R[k], r[k].T, targets[k])
                for k, tick in enumerate(chosen)
            ]

        if markers.draws_anything:
            yield _Stream(TOPICS["markers"], shown * period, make_markers)


def topic_quantities(flight: FlightData) -> dict[str, Array]:
    """Return all quantities by their names in the topic table."""
    found = {**flight.quantities, "effort": flight.effort, "momentum": flight.momentum}
    for name in ("pose", "twist", "q", "qdot"):
        values = flight.signal(name).values
        if "measured_pose" in flight.quantities:
            found[f"true_{name}"] = values
        found.setdefault(f"measured_{name}", values)
    return {**found, "pose": flight.pose}


def _description_streams(flight: FlightData) -> Iterator[_Stream]:
    robots = {"robot_description": flight.required_robot()}
    if flight.target is not None:
        robots["target/robot_description"] = flight.target
    for name, robot in robots.items():
        yield _Stream.of(TOPICS[name], [(0, encode(TOPICS[name].type, {"data": robot.urdf}))])


def _goal_streams(flight: FlightData) -> Iterator[_Stream]:
    """Yield the goals as a mission client sends them: before the first state."""
    scenario = flight.scenario
    world, goal = scenario.plant.world_frame, scenario.goal
    if goal.joint_positions is not None:
        topic = TOPICS["goal_joint_states"]
        values = {"name": flight.joint_names, "position": goal.joint_positions}
        yield _Stream.of(topic, [(0, encode(topic.type, values))])
    aims = goal_messages(goal, scenario.end_effector_goal, world, _GOAL_STAMP_NS)
    for name, message in aims.items():
        yield _Stream.of(topic_named(name), [(0, message)], _GOAL_STAMP_NS)


def _command_streams(flight: FlightData) -> Iterator[_Stream]:
    period = flight.scenario.plant.period_ns
    velocity = flight.scenario.plant.actuation == "velocity"
    for name, commands in flight.commands.items():
        ticks = np.rint(commands.time / flight.control_period).astype(np.int64)
        stamps, kind = ticks * period, TOPICS[name].type
        if name == "base_wrench":
            values: dict[str, Any] = {"header": {"frame_id": flight.required_robot().base_link}}
            path = "wrench.force.x"
        else:
            zeros = np.zeros(len(flight.joint_names))
            values = {"position": zeros, "velocity": zeros, "effort": zeros}
            values["name"] = flight.joint_names
            path = "velocity" if velocity or name == "joint_reference" else "effort"
        n = commands.values.shape[1]
        columns = {path: commands.values} if n else {}
        if n and commands.setpoints is not None:
            q, qdot = np.split(commands.setpoints, [n], axis=1)
            columns |= {"position": q, "velocity": qdot}
        yield _stamped_stream(TOPICS[name], stamps, encode(kind, values), columns)


def _plan_streams(flight: FlightData) -> Iterator[_Stream]:
    robot, world = flight.required_robot(), flight.scenario.plant.world_frame
    schedules = flight.schedules
    makers: dict[str, Callable[[int, GaitSchedule], bytes]] = {
        "gait_schedule": lambda time, plan: trajectory_message(plan, time, robot.base_link),
        "markers": lambda time, plan: goal_markers(plan.goal, plan.path, robot, world),
    }
    for name, make in makers.items():
        yield _Stream.of(TOPICS[name], [(time, make(time, plan)) for time, plan in schedules])
    paths = [(time, path_message(path, time, world)) for time, path in flight.paths]
    yield _Stream.of(TOPICS["planned_path"], paths)


def _status_streams(flight: FlightData) -> Iterator[_Stream]:
    of_plant = [(time, StatusRecord.of("/plant", each)) for time, each in flight.plant_statuses]
    yield _status_stream("plant/status", of_plant)
    for node, (name, _) in STATUS_TOPICS.items():
        kind = PlannerStatus if node == "planner" else ControllerStatus
        sent = [each for each in flight.statuses if isinstance(each[1], kind)]
        records = [(at, StatusRecord.of(f"/{node}", x, x.state.level)) for at, x in sent]
        yield _status_stream(name, records)
    events = []
    for each in flight.events:
        node, values = each.node and f"/{each.node}", each.to_values(None)
        record = StatusRecord(node, each.level, each.message, values)
        events.append((round((each.time_s or 0.0) * SECOND), record))
    yield _status_stream("events", events)
    diagnostics = ((time, encode_diagnostics(each, time)) for time, each in flight.diagnostics)
    yield _Stream.of(TOPICS["/diagnostics"], diagnostics)


def _status_stream(topic: str, records: Iterable[tuple[int, StatusRecord]]) -> _Stream:
    return _Stream.of(TOPICS[topic], ((time, each.encoded()) for time, each in records))


_MEASURED_STATE_TOPICS = ("odom", "joint_states")
"""Topics of the measured state; topics of the true state have the suffix ``_true``."""

_UNITS = {"propellant": "kg"}
"""Units of quantities that are not in a topic."""


def table_of_flight(flight: FlightData, *, euler: bool = False) -> TopicTable:
    """Return one row per state: the true state in the columns of ``odom`` and ``joint_states``.

    Columns of other topics have the topic as a prefix, such as ``momentum.data[linear_x]``. If
    sensors have errors, columns of the measured state have the prefix ``measured``.

    ``euler``: whether to add ``roll``, ``pitch`` and ``yaw`` for attitudes.
    """
    quantities, seen = topic_quantities(flight), set(flight.quantities)
    joints = flight.robot.movable_joints if flight.robot is not None else ()
    prismatic = {joint.name: joint.unit == "m" for joint in joints}
    truth: list[Field] = []
    others: list[Field] = []
    for topic in state_topics(flight.scenario.plant.end_effectors):
        for field in topic.state:
            values = quantities.get(field.quantity)
            seen.discard(field.quantity)
            if values is None or len(values) != len(flight.time) or not values.shape[1]:
                continue
            prefix = _prefix(topic, erred="measured_pose" in flight.quantities)
            if prefix is None:
                continue
            if field.members:
                pairs = zip(field.columns, values.T, strict=True)
                made = [number_field(path, column) for path, column in pairs]
            else:
                names = _names(flight, topic)
                made = [array_field(topic.name, field.path, values, names, prismatic)]
            found = others if prefix else truth
            found += [replace(each, path=prefix + each.path) for each in made]
    others += [
        Field(name, values[:, 0], (_UNITS.get(name, ""),))
        for name, values in flight.quantities.items()
        if name in seen and values.shape == (len(flight.time), 1)
    ]
    table = TopicTable("", "", flight.time, (*truth, *others))
    return with_euler_angles(table) if euler else table


def _prefix(topic: Topic, *, erred: bool) -> str | None:
    """Return the column prefix of a topic; None: its numbers are also in another topic."""
    if topic.name == "base_pose":
        return None
    if topic.name in _MEASURED_STATE_TOPICS:
        return "measured." if erred else ""
    if topic.name.removesuffix("_true") in _MEASURED_STATE_TOPICS:
        return "" if erred else None
    return f"{topic.name}."


def _names(flight: FlightData, topic: Topic) -> Sequence[str]:
    """Return the joint or thruster names in the messages of a topic."""
    if topic.short_type != "sensor_msgs/JointState":
        return ()
    if topic.array_entries_of != "thrusters":
        return flight.joint_names
    # A thruster table in a separate file is not read, because a bag may name any file.
    source, robot = flight.scenario.plant.thrusters, flight.robot
    return find_thrusters(source, robot).names if robot is not None and source == IN_URDF else ()
