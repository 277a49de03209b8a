"""The messages of a topic as a table: one row a message, one column a number or a text.

A table knows what its numbers are: their units, and the joints that the entries of an array stand
for. :mod:`~spacerobot_ros.bag.export` writes tables for other programs.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.series import TopicSeries
from spacerobot_ros.messages.statuses import key_values
from spacerobot_ros.topics import TOPICS

_KEY_VALUES = "diagnostic_msgs/msg/KeyValue"
_JOINT_STATE = "sensor_msgs/msg/JointState"
_HEADER_STAMP = ("header.stamp.sec", "header.stamp.nanosec")
_TIMES = ("time", "time_ns", "stamp", "stamp_ns")
"""Columns of every table; a field of these names is below ``message``."""

_MOST_ENTRIES = 1000
"""Longest array that becomes columns; longer ones, such as the bytes of an image, do not."""

_JOINT_UNITS = {
    "position": ("m", "rad"),
    "velocity": ("m/s", "rad/s"),
    "effort": ("N", "N m"),
}
"""Units of a sliding joint and of a turning one."""

_THRUSTER_UNITS = {"position": "s", "velocity": "1", "effort": "N"}
_MOMENTUM_UNITS = {"linear": "kg m/s", "angular": "kg m^2/s", "kinetic": "J"}

_UNITS = tuple(
    (re.compile(rf"(?:^|\.){ending}$"), unit)
    for ending, unit in (
        (r"(?:position|translation|point)\.[xyz]", "m"),
        (r"(?:orientation|rotation)\.[xyzw]", "1"),
        (r"linear\.[xyz]", "m/s"),
        (r"angular\.[xyz]", "rad/s"),
        (r"force\.[xyz]", "N"),
        (r"torque\.[xyz]", "N m"),
    )
)
"""By the ends of paths: ROS has SI units (REP 103), and no field for them."""


@dataclass(frozen=True)
class Field:
    """What all messages of a topic have at one place.

    Attributes
    ----------
    path
        The place, such as ``pose.pose.position.x``, or ``position`` for an array.
    values
        Numbers (N,), numbers (N, k), or texts (N,) as objects.
    units
        One for each column; empty where it is not known or there is none.
    labels
        What the k entries of an array are called; empty for one value a message.
    of
        What the entries are: ``joint``, ``thruster``, or ``entry``.
    """

    path: str
    values: NDArray[Any]
    units: tuple[str, ...]
    labels: tuple[str, ...] = ()
    of: str = "entry"

    @property
    def columns(self) -> list[str]:
        """Names of the columns: the path, and in brackets the entry of an array."""
        if self.values.ndim == 1:
            return [self.path]
        return [f"{self.path}[{label}]" for label in self.labels]


@dataclass(frozen=True)
class TopicTable:
    """The messages of a topic as a table, a row each, in the order of their log times.

    Attributes
    ----------
    topic, type_name
        Name of the topic and of the type of its messages.
    time
        Log times in seconds, shape (N,): simulated time in a bag of this stack.
    fields
        The columns, arrays in one piece. The first is ``time_ns``, the log time in whole
        nanoseconds. Where the messages have a header, its time follows: ``stamp`` in seconds and
        ``stamp_ns``.
    """

    topic: str
    type_name: str
    time: NDArray[np.float64]
    fields: tuple[Field, ...]

    def __len__(self) -> int:
        return len(self.time)

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """Every column (N,) by its name; ``time`` is none of them."""
        found: dict[str, NDArray[Any]] = {}
        for field in self.fields:
            parts = [field.values] if field.values.ndim == 1 else field.values.T
            found.update(zip(field.columns, parts, strict=True))
        return found

    @property
    def units(self) -> dict[str, str]:
        """Unit of every column by its name; empty where it is not known or there is none."""
        pairs = (zip(field.columns, field.units, strict=True) for field in self.fields)
        return {name: unit for each in pairs for name, unit in each}


def table_of(series: TopicSeries, sliding: Mapping[str, bool] | None = None) -> TopicTable:
    """Return the messages of a topic as a table.

    Numbers and texts become columns; an array that has the same length in every message, of at most
    a thousand entries, becomes a column for each, called by the joint or thruster where the
    messages name them; keys and values of a status become a column for each key, empty where a
    message lacks it. All else, such as the points of a path, is JSON in one column of texts.

    Seconds are float64, which lose the last digits of wall time; nanoseconds are whole numbers.

    Parameters
    ----------
    series
        The topic.
    sliding
        Of each joint whether it slides, which decides on units; one that is not there has none.

    Raises
    ------
    RecordingError
        A message is damaged, or there is more than can be decoded.
    """
    names = _names(series)
    found = [Field("time_ns", series.time_ns, ("ns",))]
    if series.stamped:
        found.append(Field("stamp", series.stamp, ("s",)))
        found.append(Field("stamp_ns", series.stamp_ns, ("ns",)))
    for path in series.paths:
        if path in _HEADER_STAMP or (path == "name" and names):
            continue
        found += _fields(series, path, names, sliding or {})
    return TopicTable(series.topic, series.type_name, series.time, tuple(found))


def _names(series: TopicSeries) -> tuple[str, ...]:
    """Return the names in joint states, where all messages have the same."""
    if series.type_name != _JOINT_STATE or not len(series):
        return ()
    found = {tuple(names) for names in series.field("name")}
    names = found.pop()
    return names if not found and len(set(names)) == len(names) else ()


def _fields(
    series: TopicSeries, path: str, names: tuple[str, ...], sliding: Mapping[str, bool]
) -> list[Field]:
    values = series.field(path)
    if series.element_type(path) == _KEY_VALUES:
        return _key_values(path, values)
    if path in _TIMES:
        path = f"message.{path}"
    if not isinstance(values, np.ndarray) or values[:1].size > _MOST_ENTRIES:
        texts = [x if isinstance(x, str) else json.dumps(_plain(x)) for x in values]
        return [Field(path, _objects(texts), ("",))]
    if values.ndim == 1:
        return [Field(path, values, (_unit(path),))]
    width = values.shape[1]
    if not width:
        return []
    short = series.topic.rpartition("/")[2]
    if names and width == len(names):
        thrusters = short == "thrusters"
        of = "thruster" if thrusters else "joint"
        units = tuple(
            _THRUSTER_UNITS.get(path, "") if thrusters else _joint_unit(path, sliding.get(name))
            for name in names
        )
        return [Field(path, values, units, names, of)]
    stack = TOPICS.get(short)
    labels = stack.state[0].entries if stack is not None and stack.state else ()
    if path != "data" or len(labels) != width:
        return [Field(path, values, ("",) * width, tuple(map(str, range(width))))]
    units = tuple(_MOMENTUM_UNITS.get(label.partition("_")[0], "") for label in labels)
    return [Field(path, values, units, labels)]


def _key_values(path: str, values: list[Any]) -> list[Field]:
    """Return a column of texts for each key of lists of keys and values."""
    rows = [key_values(pairs) for pairs in values]
    keys = dict.fromkeys(key for row in rows for key in row)
    return [Field(f"{path}[{k}]", _objects([r.get(k, "") for r in rows]), ("",)) for k in keys]


def _joint_unit(path: str, slides: bool | None) -> str:
    if path not in _JOINT_UNITS or slides is None:
        return ""
    return _JOINT_UNITS[path][0 if slides else 1]


def _unit(path: str) -> str:
    return next((unit for ending, unit in _UNITS if ending.search(path)), "")


def _objects(values: list[str]) -> NDArray[Any]:
    made = np.empty(len(values), object)
    made[:] = values
    return made


def _plain(value: Any) -> Any:
    """Return a part of a message as JSON has it."""
    if is_dataclass(value):
        # Constants are in capitals, and fields never are.
        names = (each.name for each in fields(value) if not each.name.isupper())
        return {name: _plain(getattr(value, name)) for name in names if name[0] != "_"}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_plain(each) for each in value] if isinstance(value, list) else value
