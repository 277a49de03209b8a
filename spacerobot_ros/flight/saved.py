"""A flight as a bag, as the nodes would have published it, and as a table.

A table has the columns and units of the tables of the bag.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag import LATCHED, BagWriter
from spacerobot_ros.bag.tables import (
    Field,
    TopicTable,
    array_field,
    number_field,
    with_euler_angles,
)
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.messages.builders import (
    goal_message,
    path_message,
    state_message,
    trajectory_message,
)
from spacerobot_ros.messages.layout import encode, stamped_copies
from spacerobot_ros.messages.statuses import StatusRecord
from spacerobot_ros.model.description import DEFAULT_END_EFFECTOR, Array
from spacerobot_ros.model.thrusters import IN_URDF, find_thrusters
from spacerobot_ros.model.visuals import meshes_for_bag
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import TOPICS, Topic, goal_topic, pose_topic, state_topics, topic_named
from spacerobot_ros.version import __version__

if TYPE_CHECKING:
    from spacerobot_ros.flight.flight import Flight


@dataclass(frozen=True)
class _Stream:
    """The messages of a topic: when each was published, ns, and its bytes."""

    topic: Topic
    time_ns: NDArray[np.int64]
    messages: list[bytes]


def save_flight(flight: Flight, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a bag that ``spacerobot verify`` and ``spacerobot report`` take.

    Raises
    ------
    RecordingError
        The file is there and is not to be replaced, or cannot be written; a type of message is not
        installed.
    """
    scenario, robot = flight.scenario, flight.required_robot()
    streams = [*_state_streams(flight), *_clearance_streams(flight), *_other_streams(flight)]
    with BagWriter(path, overwrite=overwrite) as writer:
        writer.add_metadata("spacerobot", {"version": __version__})
        nodes = ["plant", *scenario.commanders]
        for title, values in scenario.records(nodes).items():
            writer.add_metadata(title, values)
        urdf = robot.urdf.encode()
        writer.add_attachment("robot_description.urdf", urdf, "application/xml", 0)
        for name, mesh in meshes_for_bag(robot).items():
            writer.add_attachment(name, mesh, "model/stl", 0)
        entries = []
        for place, stream in enumerate(streams):
            name = stream.topic.name
            full = name if name.startswith("/") else f"/{name}"
            qos = LATCHED if stream.topic.latched else None
            channel = writer.add_topic(full, stream.topic.type, qos)
            entries += [
                (time, place, channel, data)
                for time, data in zip(stream.time_ns.tolist(), stream.messages, strict=True)
            ]
        for time, _, channel, data in sorted(entries, key=lambda entry: entry[:2]):
            writer.write(channel, data, time, time)


def _state_streams(flight: Flight) -> Iterator[_Stream]:
    """Yield the topics of the plant's state, in the order of their publication."""
    period = round(flight.control_period * SECOND)
    stamps: NDArray[np.int64] = np.arange(len(flight.time), dtype=np.int64) * period
    config, robot = flight.scenario.plant, flight.required_robot()
    quantities = topic_quantities(flight)
    thrusters: tuple[str, ...] = ()
    if "thruster_duty" in quantities:
        thrusters = tuple(find_thrusters(config.thrusters, robot).names)
    clock = TOPICS["/clock"]
    yield _Stream(clock, stamps, stamped_copies(encode(clock.type), clock.type, stamps, {}))
    lost = {name: flight.quantities.get(name) for name in ("pose_lost", "target_lost")}
    every = max(1, round(config.base_pose_period * SECOND / period))
    poses = {"odom", *(pose_topic(name).name for name in config.end_effectors)}
    for topic in state_topics(config.end_effectors):
        if not all(field.quantity in quantities for field in topic.state):
            continue
        names = thrusters if topic.array_entries_of == "thrusters" else flight.joint_names
        base = config.frame_prefix + robot.base_link
        target = "" if flight.target is None else flight.target.base_link
        message = state_message(topic, names, config.world_frame, base, target)
        columns = {
            field.columns[0]: quantities[field.quantity]
            for field in topic.state
            if quantities[field.quantity].shape[1]
        }
        rows = np.ones(len(stamps), dtype=bool)
        name = "target_lost" if topic.name == "target/odom" else "pose_lost"
        missing = lost[name] if topic.name in (*poses, "target/odom") else None
        if missing is not None:
            rows = missing[:, 0] == 0
        if not topic.every_tick:
            rows = np.arange(len(stamps)) % every == 0
        chosen = {path: values[rows] for path, values in columns.items()}
        yield _Stream(
            topic, stamps[rows], stamped_copies(message, topic.type, stamps[rows], chosen)
        )


def _clearance_streams(flight: Flight) -> Iterator[_Stream]:
    """Yield the clearances, where distances are exact, as those of the plant's node are."""
    if flight.clearance is None or not flight.clearance.geometry.exact:
        return
    statuses = flight.clearance.statuses(max(1, flight.scenario.plant.clearance_ticks))
    times = np.array([round(each.time_s * SECOND) for each in statuses], dtype=np.int64)
    messages = [
        StatusRecord("/plant", each.level, each.message, each.to_values()).encoded()
        for each in statuses
    ]
    yield _Stream(TOPICS["clearance"], times, messages)


def topic_quantities(flight: Flight) -> dict[str, Array]:
    """Return all quantities by the names of the table of topics."""
    true = {"pose": flight.pose, "twist": flight.twist, "q": flight.q, "qdot": flight.qdot}
    found = {**flight.quantities, "effort": flight.effort, "momentum": flight.momentum}
    erred = "measured_pose" in flight.quantities
    for name, values in true.items():
        found.setdefault(f"measured_{name}", values)
        if erred:
            found[f"true_{name}"] = values
    return {**found, "pose": flight.pose}


def _other_streams(flight: Flight) -> Iterator[_Stream]:
    """Yield goals, commands, plans, statuses, events and the description of the robot."""
    scenario, zero = flight.scenario, np.zeros(1, dtype=np.int64)
    world = scenario.plant.world_frame
    described = encode("std_msgs/msg/String", {"data": flight.required_robot().urdf})
    yield _Stream(TOPICS["robot_description"], zero, [described])
    if flight.target is not None:
        described = encode("std_msgs/msg/String", {"data": flight.target.urdf})
        yield _Stream(TOPICS["target/robot_description"], zero, [described])
    shape = scenario.goal.joint_positions
    if shape is not None:
        topic = TOPICS["goal_joint_states"]
        message = encode(topic.type, {"name": flight.joint_names, "position": shape})
        yield _Stream(topic, zero, [message])
    goals = {"goal_pose": scenario.goal, "end_effector/goal_pose": scenario.end_effector_goal}
    for each in scenario.goal.end_effectors:
        goals[goal_topic(each.link or DEFAULT_END_EFFECTOR)] = each.as_goal()
    for name, goal in goals.items():
        if goal is not None and goal.base:
            yield _Stream(topic_named(name), zero, [goal_message(goal, world, stamp_ns=1)])
    yield from _command_streams(flight)
    yield from _plan_streams(flight, world)
    named = {"planner/status": PlannerStatus, "controller/status": ControllerStatus}
    for name, kind in named.items():
        found = [(time, status) for time, status in flight.statuses if isinstance(status, kind)]
        if found:
            node = "/planner" if kind is PlannerStatus else "/coordinated_control"
            messages = [
                StatusRecord(node, status.state.level, status.message, status.to_values()).encoded()
                for _, status in found
            ]
            times = np.array([time for time, _ in found], dtype=np.int64)
            yield _Stream(TOPICS[name], times, messages)
    times = np.array([round((e.time_s or 0.0) * SECOND) for e in flight.events], dtype=np.int64)
    events = [
        StatusRecord("", event.level, event.message, event.to_values(None)).encoded()
        for event in flight.events
    ]
    yield _Stream(TOPICS["events"], times, events)


def _command_streams(flight: Flight) -> Iterator[_Stream]:
    period = round(flight.control_period * SECOND)
    velocity = flight.scenario.plant.actuation == "velocity"
    for name, commands in flight.commands.items():
        stamps, kind = commands.tick * period, TOPICS[name].type
        if name == "base_wrench":
            values: dict[str, Any] = {"header": {"frame_id": flight.required_robot().base_link}}
            path = "wrench.force.x"
        else:
            zeros = np.zeros(len(flight.joint_names))
            values = {"position": zeros, "velocity": zeros, "effort": zeros}
            values["name"] = flight.joint_names
            path = "velocity" if velocity or name == "joint_reference" else "effort"
        if len(stamps) and commands.values.shape[1]:
            columns = {path: commands.values}
            yield _Stream(
                TOPICS[name], stamps, stamped_copies(encode(kind, values), kind, stamps, columns)
            )


def _plan_streams(flight: Flight, world: str) -> Iterator[_Stream]:
    if not flight.schedules:
        return
    times = np.array([time for time, _ in flight.schedules], dtype=np.int64)
    base = flight.required_robot().base_link
    plans = [trajectory_message(schedule, time, base) for time, schedule in flight.schedules]
    paths = [path_message(schedule.path, time, world) for time, schedule in flight.schedules]
    yield _Stream(TOPICS["gait_schedule"], times, plans)
    yield _Stream(TOPICS["planned_path"], times, paths)


_MEASURED_STATE_TOPICS = ("odom", "joint_states")
"""Topics of a measured state; the truth beside it has the ending ``_true``."""

_UNITS = {"propellant": "kg"}
"""Units of quantities that are in no topic."""


def table_of_flight(flight: Flight, *, euler: bool = False) -> TopicTable:
    """Return a row a state: the true state by the columns of ``odom`` and ``joint_states``.

    The columns of other topics have the topic before them, as ``momentum.data[linear_x]``. Where
    sensors err, ``measured`` stands before those of the measured state.

    ``euler``: whether attitudes have ``roll``, ``pitch`` and ``yaw`` as well.
    """
    quantities, seen = topic_quantities(flight), set(flight.quantities)
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
                made = [
                    array_field(
                        topic.name, field.path, values, _names(flight, topic), _prismatic(flight)
                    )
                ]
            found = others if prefix else truth
            found += [replace(each, path=prefix + each.path) for each in made]
    others += _single_numbers(flight, seen)
    table = TopicTable("", "", flight.time, (*truth, *others))
    return with_euler_angles(table) if euler else table


def _prefix(topic: Topic, *, erred: bool) -> str | None:
    """Return the words before the columns of a topic; None: its numbers are in another one too."""
    if topic.name == "base_pose":
        return None
    if topic.name in _MEASURED_STATE_TOPICS:
        return "measured." if erred else ""
    if topic.name.removesuffix("_true") in _MEASURED_STATE_TOPICS:
        return "" if erred else None
    return f"{topic.name}."


def _names(flight: Flight, topic: Topic) -> Sequence[str]:
    """Return the names in the messages of a topic, of joints or thrusters."""
    if topic.short_type != "sensor_msgs/JointState":
        return ()
    if topic.array_entries_of != "thrusters":
        return flight.joint_names
    # A table of thrusters that is a file of its own is not looked for: a bag may name any file.
    source, robot = flight.scenario.plant.thrusters, flight.robot
    return find_thrusters(source, robot).names if robot is not None and source == IN_URDF else ()


def _prismatic(flight: Flight) -> dict[str, bool]:
    joints = flight.robot.movable_joints if flight.robot is not None else ()
    return {joint.name: joint.unit == "m" for joint in joints}


def _single_numbers(flight: Flight, names: set[str]) -> Iterator[Field]:
    """Yield the quantities of one number that no topic has."""
    for name, values in flight.quantities.items():
        if name in names and values.shape == (len(flight.time), 1):
            yield Field(name, values[:, 0], (_UNITS.get(name, ""),))
