"""The topics of a bag for other programs: pandas, xarray, and files in CSV, Parquet and MAT."""

from __future__ import annotations

import importlib
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spacerobot_ros.bag.tables import TopicTable
from spacerobot_ros.errors import RecordingError

if TYPE_CHECKING:
    import pandas
    import xarray

COLUMNS = "_columns.csv"
"""File beside tables in CSV: topic, file, column and unit of every column."""

_UNSAFE = re.compile(r"[^A-Za-z0-9_.-]+")
_LONGEST_NAME = 63
"""Longest name of a variable in MATLAB, characters."""

_KEYWORD = re.compile(
    "break|case|catch|classdef|continue|else|elseif|end|for|function|global|if|otherwise|parfor|"
    "persistent|return|spmd|switch|try|while"
)
"""Keywords of MATLAB, which no variable may be named by."""

_QUOTED = re.compile(r'[,"\r\n]')
"""What a text in CSV is in quotes for."""


class ExportFormat(str, Enum):
    """What :func:`export` writes."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"


@dataclass(frozen=True)
class Export:
    """What was written.

    Attributes
    ----------
    path
        The folder, or the file.
    rows
        Number of rows of each topic that is in it.
    """

    path: Path
    rows: dict[str, int]


def to_pandas(table: TopicTable) -> pandas.DataFrame:
    """Return a table as pandas has it, a copy; :meth:`Bag.to_pandas` says more.

    Raises
    ------
    RecordingError
        pandas is not installed.
    """
    pandas = _library("pandas")
    index = pandas.Index(table.time, name="time")
    frame = pandas.DataFrame(table.columns, index=index, copy=True)
    frame.attrs.update(topic=table.topic, type=table.type_name, units=table.units)
    return frame


def to_xarray(table: TopicTable) -> xarray.Dataset:
    """Return a table as xarray has it, a copy; :meth:`Bag.to_xarray` says more.

    Raises
    ------
    RecordingError
        xarray is not installed.
    """
    xarray = _library("xarray")
    variables: dict[str, Any] = {}
    coordinates: dict[str, Any] = {"time": ("time", table.time.copy(), {"units": "s"})}
    for field in table.fields:
        units: str | list[str] = list(field.units)
        if len(set(field.units)) == 1:
            units = field.units[0]
        dimensions = ["time"]
        if field.values.ndim == 2:
            name = field.of if field.of != "entry" else f"{field.path} entry"
            dimensions.append(name)
            coordinates[name] = (name, list(field.labels))
        variables[field.path] = (dimensions, field.values.copy(), {"units": units} if units else {})
    attributes = {"topic": table.topic, "type": table.type_name}
    return xarray.Dataset(variables, coordinates, attributes)


def export(
    tables: Iterable[TopicTable], path: str | os.PathLike[str], format: ExportFormat
) -> Export:
    """Write tables for other programs.

    CSV and Parquet make a folder with a file for each topic that has messages (``odom.csv``,
    ``planner.status.csv``); MAT makes one file with a struct for each. Nothing is ever written
    over, and what cannot be finished is removed.

    Parameters
    ----------
    tables
        What to write; :meth:`Bag.table` makes them.
    path
        The folder, or the file.
    format
        What to write.

    Raises
    ------
    RecordingError
        There is something at ``path``, its name is that of another format, a file cannot be
        written, or a library is not installed.
    """
    target = Path(path)
    _require_suffix(target, format)
    if os.path.lexists(target):
        raise RecordingError(f"There is something at {target} already: name another place.")
    write = {
        ExportFormat.CSV: _write_csv,
        ExportFormat.PARQUET: _write_parquet,
        ExportFormat.MAT: _write_mat,
    }[format]
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        made = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
        try:
            rows = write(_named(tables), made)
            result = made / "tables.mat" if format is ExportFormat.MAT else made
            result.chmod(0o777 & ~_umask() if result.is_dir() else 0o666 & ~_umask())
            _place(result, target)
        finally:
            shutil.rmtree(made, ignore_errors=True)
    except OSError as error:
        raise RecordingError(f"{target} cannot be written: {error.strerror}.") from error
    return Export(target, rows)


def _require_suffix(target: Path, format: ExportFormat) -> None:
    """Refuse names that belong to another format."""
    suffix = target.suffix.lower()
    if format is ExportFormat.MAT:
        if suffix not in ("", ".mat"):
            raise RecordingError(
                f"The name of a file for MATLAB ends in .mat; '{target.name}' does not."
            )
    elif suffix in {f".{each.value}" for each in ExportFormat}:
        raise RecordingError(
            f"Tables in {format.value} are a folder with a file for each topic; '{target.name}' is "
            "the name of one file."
        )


def _place(made: Path, target: Path) -> None:
    """Rename the finished file or folder, unless its name has been taken meanwhile."""
    if made.is_dir():
        # Takes the place of an empty folder at most.
        made.rename(target)
    else:
        # Links would do with one call, but no USB stick has them.
        os.close(os.open(target, os.O_CREAT | os.O_EXCL))
        made.replace(target)


def _umask() -> int:
    mask = os.umask(0o077)
    os.umask(mask)
    return mask


def _named(tables: Iterable[TopicTable]) -> dict[str, TopicTable]:
    """Return the tables that have rows, by names that are safe for files, each once."""
    found: dict[str, TopicTable] = {}
    for table in tables:
        if len(table):
            name = _UNSAFE.sub("_", table.topic.strip("/").replace("/", ".")).lstrip("._-")
            found[_free(name[:100] or "topic", found)] = table
    return found


def _free(name: str, taken: Mapping[str, Any]) -> str:
    """Return a name that no other differs from by case alone."""
    others = {each.lower() for each in taken}
    names = (name, *(f"{name}_{number}" for number in range(2, len(others) + 3)))
    return next(each for each in names if each.lower() not in others)


def _write_csv(tables: dict[str, TopicTable], folder: Path) -> dict[str, int]:
    def rows(file: Path, head: list[str], columns: list[Iterable[str]]) -> None:
        with file.open("w", encoding="utf-8", newline="") as stream:
            stream.write(",".join(map(_in_csv, head)) + "\n")
            stream.writelines(",".join(row) + "\n" for row in zip(*columns, strict=True))

    about: list[tuple[str, str, str, str]] = []
    for name, table in tables.items():
        columns = {"time": table.time, **table.columns}
        file = f"{name}.csv"
        rows(
            folder / file,
            list(columns),
            # Texts are objects, and numbers keep every digit.
            [map(_in_csv if x.dtype == object else repr, x.tolist()) for x in columns.values()],
        )
        units = {"time": "s", **table.units}
        about += [(table.topic, file, column, unit) for column, unit in units.items()]
    head = ["topic", "file", "column", "unit"]
    rows(folder / COLUMNS, head, [map(_in_csv, each) for each in zip(*about, strict=True)])
    return {table.topic: len(table) for table in tables.values()}


def _in_csv(text: str) -> str:
    """Return a text as CSV has it (RFC 4180); a lone carriage return ends a row for readers too."""
    return '"' + text.replace('"', '""') + '"' if _QUOTED.search(text) else text


def _write_parquet(tables: dict[str, TopicTable], folder: Path) -> dict[str, int]:
    arrow, parquet = _library("pyarrow"), _library("pyarrow.parquet")
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
    return {table.topic: len(table) for table in tables.values()}


def _write_mat(tables: dict[str, TopicTable], folder: Path) -> dict[str, int]:
    # Takes a tenth of a second, and only this format needs it.
    from scipy.io import savemat
    from scipy.io.matlab import MatWriteError

    variables: dict[str, Any] = {}
    about: dict[str, Any] = {}
    for table in tables.values():
        name = _identifier(table.topic.strip("/"), variables)
        variables[name] = _struct(table)
        about[name] = {
            "topic": table.topic,
            "type": table.type_name,
            "columns": _cells(["time", *table.columns]),
            "units": _cells(["s", *table.units.values()]),
        }
    variables[_identifier("about", variables)] = about
    try:
        savemat(folder / "tables.mat", variables, long_field_names=True, do_compression=True)
    except (MatWriteError, ValueError, OverflowError) as error:
        raise RecordingError(f"MAT cannot hold these tables: {error}.") from error
    return {table.topic: len(table) for table in tables.values()}


def _struct(table: TopicTable) -> dict[str, Any]:
    """Return a topic as MATLAB has it: its fields (N, k) in structs of structs."""
    struct: dict[str, Any] = {"time": table.time[:, np.newaxis]}
    places: dict[tuple[str, ...], dict[str, Any]] = {(): struct}
    for field in table.fields:
        *way, last = field.path.split(".")
        place = struct
        for depth, part in enumerate(way, 1):
            inner = places.setdefault(tuple(way[:depth]), {})
            if not inner:
                # Keys have dots too, and one may be called as a part of another is.
                place[_identifier(part, place)] = inner
            place = inner
        values = field.values[:, np.newaxis] if field.values.ndim == 1 else field.values
        place[_identifier(last, place)] = values
    return struct


def _identifier(name: str, taken: Mapping[str, Any]) -> str:
    """Return a name of a variable for MATLAB that is not taken."""
    made = re.sub(r"\W+", "_", name, flags=re.ASCII).strip("_")
    made = f"x{made}" if _KEYWORD.fullmatch(made) or not made[:1].isalpha() else made
    return _free(made[: _LONGEST_NAME - 4], taken)


def _cells(texts: list[str]) -> Any:
    made = np.empty((len(texts), 1), object)
    made[:, 0] = texts
    return made


def _library(name: str) -> Any:
    """Import a library of the extra ``data``."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        if error.name is None or error.name.split(".")[0] != name.split(".")[0]:
            raise
        raise RecordingError(
            f"This takes {name.split('.')[0]}, which is not installed: "
            "pip install 'spacerobot_ros[data]'."
        ) from error
