"""A flight as a table, with the columns and units of the tables of its bag."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from spacerobot_ros.bag.tables import (
    Field,
    TopicTable,
    array_field,
    number_field,
    with_euler_angles,
)
from spacerobot_ros.control.thrusters import IN_URDF, find_thrusters
from spacerobot_ros.flight.saved import topic_quantities
from spacerobot_ros.topics import Topic, state_topics

if TYPE_CHECKING:
    from spacerobot_ros.flight.flight import Flight

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
    if topic.entries_of != "thrusters":
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
