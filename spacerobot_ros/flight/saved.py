"""Writes a flight that was flown without ROS into a bag, as the nodes would have published it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag import LATCHED, BagWriter
from spacerobot_ros.bag.making import MessageMaker
from spacerobot_ros.control.status import ControllerStatus
from spacerobot_ros.control.thrusters import find_thrusters
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.visuals import carried_meshes
from spacerobot_ros.planning import GaitSchedule, Goal
from spacerobot_ros.planning.execution.status import PlannerStatus
from spacerobot_ros.times import SECOND, set_stamp
from spacerobot_ros.topics import TOPICS, Topic, state_topics
from spacerobot_ros.version import __version__

if TYPE_CHECKING:
    from spacerobot_ros.flight.flight import Flight


@dataclass(frozen=True)
class _Stream:
    """The messages of a topic: when each was published, ns, its place in a tick, its bytes."""

    topic: Topic
    time_ns: NDArray[np.int64]
    messages: list[bytes]
    name: str = ""


def save_flight(flight: Flight, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write a bag that ``spacerobot verify`` and ``spacerobot report`` take.

    Raises
    ------
    RecordingError
        The file is there and is not to be replaced, or cannot be written; a type of message is not
        installed.
    """
    maker, scenario, robot = MessageMaker(), flight.scenario, flight.required_robot()
    streams = [*_states(flight, maker), *_others(flight, maker)]
    with BagWriter(path, overwrite=overwrite) as writer:
        writer.add_metadata("spacerobot", {"version": __version__})
        nodes = ["plant", *scenario.commanders]
        for title, values in scenario.records(nodes).items():
            writer.add_metadata(title, values)
        urdf = robot.urdf.encode()
        writer.add_attachment("robot_description.urdf", urdf, "application/xml", 0)
        for name, mesh in carried_meshes(robot).items():
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


def _states(flight: Flight, maker: MessageMaker) -> Iterator[_Stream]:
    """Yield the topics of the plant's state, in the order of their publication."""
    period = round(flight.control_period * SECOND)
    stamps: NDArray[np.int64] = np.arange(len(flight.time), dtype=np.int64) * period
    config, robot = flight.scenario.plant, flight.required_robot()
    quantities = _quantities(flight)
    thrusters: tuple[str, ...] = ()
    if "thruster_duty" in quantities:
        thrusters = tuple(find_thrusters(config.thrusters, robot).names)
    clock = TOPICS["/clock"]
    yield _Stream(clock, stamps, maker.stamped(maker.blank(clock.type), stamps, {}))
    lost = flight.quantities["pose_lost"][:, 0] > 0 if "pose_lost" in flight.quantities else None
    every = max(1, round(config.base_pose_period * SECOND / period))
    for topic in state_topics():
        if not all(field.quantity in quantities for field in topic.state):
            continue
        message = maker.blank(topic.type)
        names = list(thrusters if topic.of == "thrusters" else flight.joint_names)
        base = config.frame_prefix + robot.base_link
        if hasattr(message, "header"):
            message.header.frame_id = base if topic.frame == "base" else config.world_frame
        if hasattr(message, "child_frame_id"):
            message.child_frame_id = base
        if hasattr(message, "name"):
            message.name = names
        for field in topic.state:
            if not field.members:
                setattr(message, field.path, np.zeros(len(field.entries or names)))
        columns = {
            field.columns[0]: quantities[field.quantity]
            for field in topic.state
            if quantities[field.quantity].shape[1]
        }
        rows = np.ones(len(stamps), dtype=bool)
        if topic.name == "odom" and lost is not None:
            rows = ~lost
        if not topic.every_tick:
            rows = np.arange(len(stamps)) % every == 0
        chosen = {path: values[rows] for path, values in columns.items()}
        yield _Stream(topic, stamps[rows], maker.stamped(message, stamps[rows], chosen))


def _quantities(flight: Flight) -> dict[str, Array]:
    """Return all quantities by the names of the table of topics."""
    true = {"pose": flight.pose, "twist": flight.twist, "q": flight.q, "qdot": flight.qdot}
    found = {**flight.quantities, "effort": flight.effort, "momentum": flight.momentum}
    erred = "measured_pose" in flight.quantities
    for name, values in true.items():
        found.setdefault(f"measured_{name}", values)
        if erred:
            found[f"true_{name}"] = values
    return {**found, "pose": flight.pose}


def _others(flight: Flight, maker: MessageMaker) -> Iterator[_Stream]:
    """Yield goals, commands, plans, statuses, events and the description of the robot."""
    scenario, zero = flight.scenario, np.zeros(1, dtype=np.int64)
    world = scenario.plant.world_frame
    described = maker.made("std_msgs/msg/String", data=flight.required_robot().urdf)
    yield _Stream(TOPICS["robot_description"], zero, [maker.serialised(described)])
    goals: list[tuple[str, Goal | None]] = [("goal_pose", scenario.goal)]
    goals.append(("end_effector/goal_pose", scenario.end_effector_goal))
    if scenario.goal.joint_positions is not None:
        message = maker.blank("sensor_msgs/msg/JointState")
        message.name = list(flight.joint_names)
        message.position = np.array(scenario.goal.joint_positions, dtype=float)
        yield _Stream(TOPICS["goal_joint_states"], zero, [maker.serialised(message)])
    for name, goal in goals:
        if goal is not None:
            message = _posed(maker, goal, world)
            message.header.stamp.nanosec = 1
            yield _Stream(TOPICS[name], zero, [maker.serialised(message)])
    yield from _commands(flight, maker)
    yield from _plans(flight, maker, world)
    named = {"planner/status": PlannerStatus, "controller/status": ControllerStatus}
    for name, kind in named.items():
        found = [(time, status) for time, status in flight.statuses if isinstance(status, kind)]
        if found:
            node = "/planner" if kind is PlannerStatus else "/coordinated_control"
            messages = [
                _status(maker, node, status.message, status.state.level, status.to_values())
                for _, status in found
            ]
            times = np.array([time for time, _ in found], dtype=np.int64)
            yield _Stream(TOPICS[name], times, messages)
    times = np.array([round((e.time_s or 0.0) * SECOND) for e in flight.events], dtype=np.int64)
    events = [
        _status(maker, "", event.sentence, event.level, event.to_values(None))
        for event in flight.events
    ]
    yield _Stream(TOPICS["events"], times, events)


def _commands(flight: Flight, maker: MessageMaker) -> Iterator[_Stream]:
    period = round(flight.control_period * SECOND)
    velocity = flight.scenario.plant.actuation == "velocity"
    for name, commands in flight.commands.items():
        stamps = commands.tick * period
        message = maker.blank(TOPICS[name].type)
        if name == "base_wrench":
            message.header.frame_id = flight.required_robot().base_link
            columns = {"wrench.force.x": commands.values}
        else:
            message.name = list(flight.joint_names)
            zeros = np.zeros(len(flight.joint_names))
            message.position = message.velocity = message.effort = zeros
            kind = "velocity" if velocity or name == "joint_reference" else "effort"
            columns = {kind: commands.values}
        if len(stamps) and commands.values.shape[1]:
            yield _Stream(TOPICS[name], stamps, maker.stamped(message, stamps, columns))


def _plans(flight: Flight, maker: MessageMaker, world: str) -> Iterator[_Stream]:
    if not flight.schedules:
        return
    times = np.array([time for time, _ in flight.schedules], dtype=np.int64)
    frame = flight.required_robot().base_link
    schedules = [_trajectory(maker, s, time, frame) for time, s in flight.schedules]
    paths = [_path(maker, schedule, time, world) for time, schedule in flight.schedules]
    yield _Stream(TOPICS["gait_schedule"], times, schedules)
    yield _Stream(TOPICS["planned_path"], times, paths)


def _trajectory(maker: MessageMaker, schedule: GaitSchedule, start_ns: int, frame: str) -> bytes:
    message = maker.blank("trajectory_msgs/msg/JointTrajectory")
    message.header.frame_id = frame
    set_stamp(message.header.stamp, start_ns)
    message.joint_names = list(schedule.joint_names)
    velocities = np.vstack([schedule.velocities, np.zeros(len(schedule.joint_names))])
    period = round(schedule.control_period * SECOND)
    for k, (q, qdot) in enumerate(zip(schedule.positions, velocities, strict=True)):
        point = maker.blank("trajectory_msgs/msg/JointTrajectoryPoint")
        point.positions, point.velocities = np.array(q), np.array(qdot)
        set_stamp(point.time_from_start, k * period)
        message.points.append(point)
    return maker.serialised(message)


def _path(maker: MessageMaker, schedule: GaitSchedule, start_ns: int, world: str) -> bytes:
    message, path = maker.blank("nav_msgs/msg/Path"), schedule.path
    message.header.frame_id = world
    set_stamp(message.header.stamp, start_ns)
    for time, r, o in zip(path.time, path.position, path.quaternion, strict=True):
        pose = _posed(maker, Goal(r, o), world)
        set_stamp(pose.header.stamp, start_ns + round(float(time) * SECOND))
        message.poses.append(pose)
    return maker.serialised(message)


def _posed(maker: MessageMaker, goal: Goal, frame: str) -> Any:
    message = maker.blank("geometry_msgs/msg/PoseStamped")
    message.header.frame_id = frame
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = map(float, goal.position)
    o.x, o.y, o.z, o.w = map(float, goal.quaternion)
    return message


def _status(
    maker: MessageMaker, name: str, sentence: str, level: int, values: dict[str, str]
) -> bytes:
    message = maker.made(
        "diagnostic_msgs/msg/DiagnosticStatus", name=name, message=sentence, level=level
    )
    for key, value in values.items():
        message.values.append(maker.made("diagnostic_msgs/msg/KeyValue", key=key, value=value))
    return maker.serialised(message)
