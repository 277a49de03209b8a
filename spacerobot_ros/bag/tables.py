"""Topic messages as a table, for pandas, xarray, CSV, Parquet and MATLAB.

Each row is a message, and each column contains numbers or strings. A table includes units, and the
names of the joints that array entries belong to.
"""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import Enum
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.series import TopicSeries
from spacerobot_ros.errors import RecordingError, reason
from spacerobot_ros.files import write_output
from spacerobot_ros.messages.diagnostics import key_values
from spacerobot_ros.resources import optional_module
from spacerobot_ros.topics import TOPICS

if TYPE_CHECKING:
    import pandas
    import xarray

_KEY_VALUES = "diagnostic_msgs/msg/KeyValue"
_HEADER_STAMP = ("header.stamp.sec", "header.stamp.nanosec")
_TIME_COLUMNS = ("time", "time_ns", "stamp", "stamp_ns")
"""Time columns in every table; a message field with the same name gets the prefix ``message``."""

_MAX_ARRAY_COLUMNS = 1000
"""Largest array that is split into columns; images, for example, are larger and are not split."""

_JOINT_UNITS = {
    "position": {True: "m", False: "rad"},
    "velocity": {True: "m/s", False: "rad/s"},
    "effort": {True: "N", False: "N m"},
}
"""Joint state units, by whether the joint is prismatic."""

_THRUSTER_UNITS = {"position": "s", "velocity": "1", "effort": "N"}
_MOMENTUM_UNITS = {"linear": "kg m/s", "angular": "kg m^2/s", "kinetic": "J"}

_UNITS_BY_PATH_ENDING = tuple(
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
"""SI unit (REP 103) of a field by path suffix, because messages contain no units."""


@dataclass(frozen=True)
class Field:
    """One field of all messages on a topic.

    Attributes
    ----------
    path
        Path in a message, such as ``pose.pose.position.x``, or ``position`` for an array.
    values
        Numbers (N,) or (N, k), or strings (N,) as objects.
    units
        Units, one per column; empty if unknown or not applicable.
    labels
        Names of the k array entries; empty for one value per message.
    column_kind
        Kind of the entries: ``joint``, ``thruster``, or ``entry``.
    """

    path: str
    values: NDArray[Any]
    units: tuple[str, ...]
    labels: tuple[str, ...] = ()
    column_kind: str = "entry"

    @property
    def columns(self) -> list[str]:
        """Column names: the path, with the array entry in brackets."""
        if self.values.ndim == 1:
            return [self.path]
        return [f"{self.path}[{label}]" for label in self.labels]


@dataclass(frozen=True)
class TopicTable:
    """The messages on a topic as a table, one row per message, in log time order.

    Attributes
    ----------
    topic, type_name
        Topic name and message type.
    time
        Log times in seconds, shape (N,): simulated time in bags from this stack.
    fields
        The fields; an array is one field. The first field is ``time_ns``, the log time in whole
        nanoseconds. If the messages have a header, its stamp follows: ``stamp`` in seconds and
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
        """Every column (N,) by name, without ``time``."""
        found: dict[str, NDArray[Any]] = {}
        for field in self.fields:
            parts = [field.values] if field.values.ndim == 1 else field.values.T
            found.update(zip(field.columns, parts, strict=True))
        return found

    @property
    def units(self) -> dict[str, str]:
        """Unit of every column by name; empty if unknown or not applicable."""
        pairs = (zip(field.columns, field.units, strict=True) for field in self.fields)
        return {name: unit for each in pairs for name, unit in each}


def table_of(series: TopicSeries, prismatic: Mapping[str, bool] | None = None) -> TopicTable:
    """Return the messages on a topic as a table.

    Numbers and strings become columns. If an array has the same length in every message (at most a
    thousand), each entry becomes a column, named after the joint or thruster if the messages
    contain names. Each status key becomes a column, whose entry is empty for a message that lacks
    the key. Everything else, such as path points, is stored as JSON in one string column.

    Seconds are float64 and lose the last digits of wall time; nanoseconds are integers.

    Parameters
    ----------
    series
        The topic.
    prismatic
        Whether each joint is prismatic, which determines the units of the joint; joints that are
        not listed have no units.

    Raises
    ------
    RecordingError
        A message is damaged, or the topic is too large to decode.
    """
    names = series.joint_names
    found = [Field("time_ns", series.time_ns, ("ns",))]
    if series.stamped:
        found.append(Field("stamp", series.stamp, ("s",)))
        found.append(Field("stamp_ns", series.stamp_ns, ("ns",)))
    for path in series.paths:
        if path in _HEADER_STAMP or (path == "name" and names):
            continue
        found += _table_fields(series, path, names, prismatic or {})
    return TopicTable(series.topic, series.type_name, series.time, tuple(found))


def _table_fields(
    series: TopicSeries, path: str, names: Sequence[str], prismatic: Mapping[str, bool]
) -> list[Field]:
    values = series.field(path)
    if series.element_type(path) == _KEY_VALUES:
        rows = [key_values(pairs) for pairs in values]
        return [
            Field(f"{path}[{key}]", np.array([row.get(key, "") for row in rows], object), ("",))
            for key in dict.fromkeys(key for row in rows for key in row)
        ]
    if path in _TIME_COLUMNS:
        path = f"message.{path}"
    if not isinstance(values, np.ndarray) or values[:1].size > _MAX_ARRAY_COLUMNS:
        texts = [x if isinstance(x, str) else json.dumps(_json_value(x)) for x in values]
        return [Field(path, np.array(texts, object), ("",))]
    if values.ndim == 1:
        return [number_field(path, values)]
    if not values.shape[1]:
        return []
    short = series.topic.rpartition("/")[2]
    return [array_field(short, path, values, names, prismatic)]


def array_field(
    topic: str, path: str, values: NDArray[Any], names: Sequence[str], prismatic: Mapping[str, bool]
) -> Field:
    """Return an array in a topic's messages as a field, with labels and units.

    Parameters
    ----------
    topic
        Topic name without its namespace.
    values
        Numbers (N, k).
    names
        Joint or thruster names in joint states.
    prismatic
        As for :func:`table_of`.
    """
    width = values.shape[1]
    if names and width == len(names):
        if topic == "thrusters":
            units = (_THRUSTER_UNITS.get(path, ""),) * width
            return Field(path, values, units, tuple(names), "thruster")
        by_kind = _JOINT_UNITS.get(path, {})
        units = tuple(by_kind.get(prismatic[n], "") if n in prismatic else "" for n in names)
        return Field(path, values, units, tuple(names), "joint")
    stack = TOPICS.get(topic)
    labels = stack.state[0].array_entry_names if stack is not None and stack.state else ()
    if path != "data" or len(labels) != width:
        return Field(path, values, ("",) * width, tuple(map(str, range(width))))
    units = tuple(_MOMENTUM_UNITS.get(label.partition("_")[0], "") for label in labels)
    return Field(path, values, units, labels)


def number_field(path: str, values: NDArray[Any]) -> Field:
    """Return one number per message (N,) as a field, with the unit of its path."""
    units = (unit for ending, unit in _UNITS_BY_PATH_ENDING if ending.search(path))
    return Field(path, values, (next(units, ""),))


def with_euler_angles(table: TopicTable) -> TopicTable:
    """Return a table that also contains each attitude as rotations about the fixed axes x, y, z.

    The fields ``roll``, ``pitch`` and ``yaw`` (rad) are siblings of ``orientation``:
    ``pose.pose.yaw`` and ``pose.pose.orientation.z``.
    """
    values = {field.path: field.values for field in table.fields}
    found = list(table.fields)
    for path in values:
        head, _, last = path.rpartition("orientation.")
        parts = [values.get(f"{head}orientation.{axis}") for axis in "xyzw"]
        if last != "x" or any(part is None for part in parts):
            continue
        quaternions = np.array(parts, float)
        with np.errstate(invalid="ignore"):
            x, y, z, w = quaternions / np.linalg.norm(quaternions, axis=0)
        across, along = 2 * (x * y + w * z), 1 - 2 * (y * y + z * z)
        turns = {
            "roll": np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
            "pitch": np.arctan2(2 * (w * y - x * z), np.hypot(along, across)),
            "yaw": np.arctan2(across, along),
        }
        found += [Field(f"{head}{name}", angle, ("rad",)) for name, angle in turns.items()]
    return replace(table, fields=tuple(found))


def _json_value(value: Any) -> Any:
    if is_dataclass(value):
        # Constants have upper-case names; fields never do.
        names = (each.name for each in fields(value) if not each.name.isupper())
        return {name: _json_value(getattr(value, name)) for name in names if name[0] != "_"}
    if isinstance(value, np.ndarray):
        return value.tolist()
    return [_json_value(each) for each in value] if isinstance(value, list) else value


COLUMNS = "_columns.csv"
"""Index file stored with CSV tables; it lists the topic, file, name and unit of every column."""

_UNSAFE_CHARACTERS = re.compile(r"[^A-Za-z0-9_.-]+")
_MAX_VARIABLE_NAME = 63
"""Longest variable name in MATLAB, characters."""

_MATLAB_KEYWORD = re.compile(
    "break|case|catch|classdef|continue|else|elseif|end|for|function|global|if|otherwise|parfor|"
    "persistent|return|spmd|switch|try|while"
)


class ExportFormat(str, Enum):
    """File formats of :func:`export`."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"
    TREE = "tree"
    """CSV with columns that PlotJuggler shows as a tree: ``joint_states/position/elbow``."""


def to_pandas(table: TopicTable) -> pandas.DataFrame:
    """Return a table as a new pandas DataFrame; see :meth:`Bag.to_pandas`.

    Raises
    ------
    RecordingError
        pandas is not installed.
    """
    pandas = _import_library("pandas")
    index = pandas.Index(table.time, name="time")
    frame = pandas.DataFrame(table.columns, index=index, copy=True)
    frame.attrs.update(topic=table.topic, type=table.type_name, units=table.units)
    return frame


def to_xarray(table: TopicTable) -> xarray.Dataset:
    """Return a table as a new xarray Dataset; see :meth:`Bag.to_xarray`.

    Raises
    ------
    RecordingError
        xarray is not installed.
    """
    xarray = _import_library("xarray")
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {"time": ("time", table.time.copy(), {"units": "s"})}
    for field in table.fields:
        units: str | list[str] = list(field.units)
        if len(set(field.units)) == 1:
            units = field.units[0]
        dimensions = ["time"]
        if field.values.ndim == 2:
            name = field.column_kind if field.column_kind != "entry" else f"{field.path} entry"
            dimensions.append(name)
            coordinates[name] = (name, list(field.labels))
        variables[field.path] = (dimensions, field.values.copy(), {"units": units} if units else {})
    attributes = {"topic": table.topic, "type": table.type_name}
    return xarray.Dataset(variables, coordinates, attributes)


def export(
    tables: Iterable[TopicTable], path: str | os.PathLike[str], format: ExportFormat
) -> dict[str, int]:
    """Write tables for other programs; return the number of rows written per topic.

    CSV, tree and Parquet create a folder with one file per topic that has messages (``odom.csv``,
    ``planner.status.csv``); MAT creates one file with a struct per topic. Nothing is overwritten,
    and incomplete output is removed.

    Parameters
    ----------
    tables
        The tables, from :meth:`Bag.table`.
    path
        Output folder or file.
    format
        What to write.

    Raises
    ------
    SpaceRobotError
        ``path`` exists, its suffix does not match the format, a file cannot be
        written, or a library is not installed.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if format is ExportFormat.MAT:
        if suffix not in ("", ".mat"):
            raise RecordingError(
                f"The name of a MATLAB file must end in .mat; '{target.name}' does not."
            )
    elif suffix in {f".{each.value}" for each in ExportFormat}:
        raise RecordingError(
            f"Tables in {format.value} are written to a folder with one file per topic; "
            f"'{target.name}' is a file name."
        )
    if os.path.lexists(target):
        raise RecordingError(f"{target} already exists: name another file or folder.")
    named: dict[str, TopicTable] = {}
    for table in filter(len, tables):
        topic = table.topic.strip("/").replace("/", ".")
        name = _UNSAFE_CHARACTERS.sub("_", topic).lstrip("._-")
        named[_unused_name(name[:100] or "topic", named)] = table
    if format is ExportFormat.MAT:
        write_output(target, _mat_content(named))
    else:
        write = _write_parquet if format is ExportFormat.PARQUET else _write_csv
        if format is ExportFormat.TREE:
            named = {name: _as_tree(table) for name, table in named.items()}
        try:
            target.mkdir(parents=True)
            write(named, target)
        except BaseException as error:
            shutil.rmtree(target, ignore_errors=True)
            if not isinstance(error, OSError):
                raise
            raise RecordingError(f"{target} cannot be written: {reason(error)}.") from error
    return {table.topic: len(table) for table in named.values()}


def _unused_name(name: str, taken: Mapping[str, Any]) -> str:
    """Return a file name that is unique even if case is ignored."""
    others = {each.lower() for each in taken}
    names = (name, *(f"{name}_{number}" for number in range(2, len(others) + 3)))
    return next(each for each in names if each.lower() not in others)


def _as_tree(table: TopicTable) -> TopicTable:
    """Return a table whose columns are paths: ``odom/pose/pose/position/x``."""

    def path(name: str) -> str:
        return "/".join([table.topic.strip("/"), *re.split(r"[.\[]+", name.replace("]", ""))])

    units, columns = table.units, table.columns.items()
    fields = tuple(Field(path(name), values, (units[name],)) for name, values in columns)
    return replace(table, fields=fields)


def _write_csv(tables: dict[str, TopicTable], folder: Path) -> None:
    about: list[tuple[str, ...]] = [("topic", "file", "column", "unit")]
    for name, table in tables.items():
        columns = {"time": table.time, **table.columns}
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        _write_rows(folder / f"{name}.csv", (columns, *rows))
        units = {"time": "s", **table.units}
        about += [(table.topic, f"{name}.csv", column, unit) for column, unit in units.items()]
    _write_rows(folder / COLUMNS, about)


def _write_rows(file: Path, rows: Iterable[Iterable[Any]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as stream:
        # All strings are quoted, as some contain commas or line breaks. Numbers keep all digits.
        csv.writer(stream, quoting=csv.QUOTE_NONNUMERIC, lineterminator="\n").writerows(rows)


def _write_parquet(tables: dict[str, TopicTable], folder: Path) -> None:
    arrow, parquet = _import_library("pyarrow"), _import_library("pyarrow.parquet")
    for name, table in tables.items():
        made = arrow.Table.from_pandas(to_pandas(table), preserve_index=True)
        units = {"time": "s", **table.units}
        described = [
            each.with_metadata({"unit": units[each.name]}) if units.get(each.name) else each
            for each in made.schema
        ]
        about = {"topic": table.topic, "type": table.type_name, **(made.schema.metadata or {})}
        made = made.cast(arrow.schema(described, metadata=about))
        parquet.write_table(made, folder / f"{name}.parquet")


def _mat_content(tables: dict[str, TopicTable]) -> bytes:
    # Importing scipy.io takes 0.1 s, and only this format needs it.
    from scipy.io import savemat
    from scipy.io.matlab import MatWriteError

    variables: dict[str, Any] = {}
    about: dict[str, Any] = {}
    for table in tables.values():
        name = _matlab_variable(table.topic.strip("/"), variables)
        variables[name] = _matlab_struct(table)
        about[name] = {
            "topic": table.topic,
            "type": table.type_name,
            "columns": _cell_array(["time", *table.columns]),
            "units": _cell_array(["s", *table.units.values()]),
        }
    variables[_matlab_variable("about", variables)] = about
    content = BytesIO()
    try:
        savemat(content, variables, long_field_names=True, do_compression=True)
    except (MatWriteError, ValueError, OverflowError) as error:
        raise RecordingError(f"MAT files cannot contain these tables: {error}.") from error
    return content.getvalue()


def _matlab_struct(table: TopicTable) -> dict[str, Any]:
    """Return a topic as MATLAB structs: fields (N, k), nested by their paths."""
    struct: dict[str, Any] = {"time": table.time[:, np.newaxis]}
    places: dict[tuple[str, ...], dict[str, Any]] = {(): struct}
    for field in table.fields:
        *way, last = field.path.split(".")
        place = struct
        for depth, part in enumerate(way, 1):
            inner = places.setdefault(tuple(way[:depth]), {})
            if not inner:
                # Keys contain dots, and one key may equal the beginning of another key.
                place[_matlab_variable(part, place)] = inner
            place = inner
        values = field.values[:, np.newaxis] if field.values.ndim == 1 else field.values
        place[_matlab_variable(last, place)] = values
    return struct


def _matlab_variable(name: str, taken: Mapping[str, Any]) -> str:
    made = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
    made = f"x{made}" if _MATLAB_KEYWORD.fullmatch(made) or not made[:1].isalpha() else made
    return _unused_name(made[: _MAX_VARIABLE_NAME - 4], taken)


def _cell_array(texts: list[str]) -> Any:
    return np.array(texts, object)[:, np.newaxis]


def _import_library(name: str) -> Any:
    return optional_module(name, "data", "Tables need", RecordingError)
