"""Tables of bags that others recorded: names, times and texts that this stack never writes.

What they hold is compared with the messages as the libraries of mcap and of ROS read them.
"""

from __future__ import annotations

import json
import keyword
import os
import re
import shlex
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from mcap.reader import make_reader
from mcap.writer import Writer
from rclpy.serialization import deserialize_message, serialize_message
from scipy.io import loadmat
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Bool, Header, String, UInt64
from support.command_line import CliRunner
from support.flight_bags import urdf_of

from spacerobot_ros.bag import Bag, BagWriter, read_bag
from spacerobot_ros.bag.tables import ExportFormat, export
from spacerobot_ros.cli.main import main

WALL = 1_763_817_000_123_456_789
"""Nanoseconds that float64 does not hold: its next neighbours are 256 away."""

FORMATS = [ExportFormat.CSV, ExportFormat.PARQUET, ExportFormat.MAT]


def written(path: Path, messages: list[tuple[str, int, Any]]) -> Bag:
    """Write (topic, log time in ns, message), as ``ros2 bag`` does: without any of our metadata."""
    with BagWriter(path) as bag:
        for topic, time_ns, message in messages:
            kind = type(message)
            package = kind.__module__.split(".")[0]
            channel = bag.add_topic(topic, f"{package}/msg/{kind.__name__}")
            bag.write(channel, bytes(serialize_message(message)), time_ns, time_ns)
    return read_bag(path)


def recorded(path: Path, topic: str, kind: Any) -> Iterator[tuple[int, Any]]:
    """Yield log times and messages of a topic, read without this package."""
    with path.open("rb") as file:
        for _, _, message in make_reader(file).iter_messages(topics=[topic]):
            yield message.log_time, deserialize_message(message.data, kind)


def exported(bag: Bag, format: ExportFormat, name: str = "") -> Any:
    """Export a bag; read a topic back as columns or as a struct, by default the only one."""
    target = bag.path.with_name(f"out_{format.value}")
    export((bag.table(topic) for topic in bag), target, format)
    name = name or next(iter(bag)).strip("/")
    match format:
        case ExportFormat.CSV:
            return pd.read_csv(target / f"{name}.csv", keep_default_na=False)
        case ExportFormat.PARQUET:
            return pd.read_parquet(target / f"{name}.parquet").reset_index()
        case ExportFormat.MAT:
            return loadmat(target, simplify_cells=True)[name]


def status(**values: str) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(message="It is so.", values=pairs)


@pytest.mark.parametrize("format", FORMATS)
def test_times_keep_every_nanosecond_of_wall_time(format: ExportFormat, tmp_path: Path) -> None:
    stamps = [WALL - 7, WALL + 11]
    bag = written(
        tmp_path / "wall.mcap",
        [
            (
                "/joints",
                log,
                JointState(
                    header=Header(stamp=Time(sec=stamp // 10**9, nanosec=stamp % 10**9)),
                    name=["a"],
                    position=[0.5],
                ),
            )
            for log, stamp in zip((WALL, WALL + 1), stamps, strict=True)
        ],
    )
    table = exported(bag, format)
    logs = [log for log, _ in recorded(bag.path, "/joints", JointState)]
    assert [int(x) for x in table["time_ns"]] == logs == [WALL, WALL + 1]
    assert [int(x) for x in table["stamp_ns"]] == stamps
    assert np.asarray(table["time"]) == pytest.approx(np.array(logs) / 1e9, rel=1e-15)


@pytest.mark.parametrize("format", FORMATS)
def test_texts_and_large_numbers_come_back_as_they_were(
    format: ExportFormat, tmp_path: Path
) -> None:
    texts = ["one\rtwo", "a\r\nb\tc", '"quoted", with commas', "NA", " ", "ä µ 漢"]
    bag = written(tmp_path / "b.mcap", [("/t", k, String(data=x)) for k, x in enumerate(texts)])
    found = [message.data for _, message in recorded(bag.path, "/t", String)]
    assert list(exported(bag, format)["data"]) == found == texts
    large = [2**64 - 1, 2**53 + 1]
    bag = written(tmp_path / "c.mcap", [("/n", k, UInt64(data=x)) for k, x in enumerate(large)])
    target = tmp_path / "large"
    export([bag.table("n")], target, format)
    if format is ExportFormat.CSV:
        back = pd.read_csv(target / "n.csv")["data"]
    elif format is ExportFormat.PARQUET:
        back = pd.read_parquet(target / "n.parquet")["data"]
    else:
        back = loadmat(target, simplify_cells=True)["n"]["data"]
    assert [int(x) for x in back] == large


def leaves(struct_: dict[str, Any], *way: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield the names on the way to each value in structs of structs, and the value."""
    for name, value in struct_.items():
        if isinstance(value, dict):
            yield from leaves(value, *way, name)
        else:
            yield (*way, name), value


def test_every_name_in_mat_is_one_that_matlab_takes(tmp_path: Path) -> None:
    """A letter, then letters, digits and underscores, 63 at most, and no keyword: ``isvarname``."""
    long = "k" * 80
    bag = written(
        tmp_path / "b.mcap",
        [
            ("/end", 1, Bool(data=True)),
            ("/" + "t" * 80 + "1", 2, Bool(data=True)),
            ("/" + "t" * 80 + "2", 3, Bool(data=False)),
            ("/s", 4, status(**{"a": "1", "a.b": "2", "a.b.c": "3", f"{long}1": "4"})),
            ("/s", 5, status(**{"A": "5", "for": "6", "": "7", "7 of 9": "8", f"{long}2": "9"})),
        ],
    )
    export((bag.table(topic) for topic in bag), tmp_path / "b.mat", ExportFormat.MAT)
    found = loadmat(tmp_path / "b.mat", simplify_cells=True)
    topics = {name: each for name, each in found.items() if not name.startswith("__")}
    names = [name for way, _ in leaves(topics) for name in way]
    assert all(re.fullmatch(r"[A-Za-z]\w{0,62}", name, re.ASCII) for name in names)
    # Those of MATLAB's keywords that are Python's too are enough to see that there are none.
    assert not set(names) & {*keyword.kwlist, "end", "case", "function"}
    values = [each for way, each in leaves(topics["s"]) if way[0].startswith("values")]
    # Every key is a column of its own, whatever the dots in it: a text, and none in the other row.
    assert sorted("".join(map("".join, column)) for column in values) == list("123456789")
    assert sum(name.startswith("ttt") for name in topics) == 2


def test_fields_called_as_our_columns_are_kept_beside_them(tmp_path: Path) -> None:
    path = tmp_path / "b.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2")
        definition = b"float64 time\nfloat64 stamp\nfloat64[2] stamp_ns\n"
        schema = writer.register_schema("own_msgs/msg/Clocked", "ros2msg", definition)
        channel = writer.register_channel("/clocked", "cdr", schema)
        data = b"\0\1\0\0" + struct.pack("<4d", 11.0, 12.0, 13.0, 14.0)
        writer.add_message(channel, 5_000_000_000, data, 5_000_000_000)
        writer.finish()
    bag = read_bag(path)
    frame = bag.to_pandas("clocked")
    assert frame.index.tolist() == [5.0]
    columns = {name: frame[name].item() for name in frame.columns}
    assert columns == {
        "time_ns": 5_000_000_000,
        "message.time": 11.0,
        "message.stamp": 12.0,
        "message.stamp_ns[0]": 13.0,
        "message.stamp_ns[1]": 14.0,
    }
    assert bag.to_xarray("clocked")["message.time"].item() == 11.0
    assert exported(bag, ExportFormat.CSV)["time"].tolist() == [5.0]
    assert exported(bag, ExportFormat.MAT)["message"]["time"] == 11.0


def test_an_image_is_one_column(tmp_path: Path) -> None:
    pixels = bytes(range(256)) * 12
    image = Image(height=32, width=32, encoding="rgb8", step=96, data=pixels)
    bag = written(tmp_path / "b.mcap", [("/camera/image", k, image) for k in range(2)])
    frame = bag.to_pandas("camera/image")
    assert len(frame.columns) < 15
    assert [bytes(json.loads(text)) for text in frame["data"]] == [pixels] * 2


def test_units_are_those_of_the_robot_whose_topic_it_is(tmp_path: Path) -> None:
    """Two robots with joints of the same names; neither is attached, as in a bag of ros2 bag."""
    slider = urdf_of(1)
    turning = slider.replace('type="prismatic"', 'type="revolute"')
    messages: list[tuple[str, int, Any]] = [
        ("/a/robot_description", 0, String(data="nothing that is a robot")),
        ("/a/robot_description", 1, String(data=slider)),
        ("/b/robot_description", 1, String(data=turning)),
    ]
    joint = JointState(name=["joint_0"], position=[0.5])
    messages += [(f"/{name}/joint_states", 2, joint) for name in "abc"]
    bag = written(tmp_path / "b.mcap", messages)
    units = {x: bag.table(f"{x}/joint_states").units["position[joint_0]"] for x in "abc"}
    assert units == {"a": "m", "b": "rad", "c": ""}


def test_an_export_takes_no_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a USB stick, whose file system has none."""

    def refused(*words: Any, **options: Any) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    bag = written(tmp_path / "b.mcap", [("/t", 1, Bool(data=True))])
    export([bag.table("t")], tmp_path / "b.mat", ExportFormat.MAT)
    assert loadmat(tmp_path / "b.mat", simplify_cells=True)["t"]["data"] == 1


def test_the_command_names_what_it_leaves_out_and_a_topic_once(tmp_path: Path) -> None:
    folder = tmp_path / "Bäge mit Lücken"
    folder.mkdir()
    with BagWriter(folder / "ein Flug.mcap") as bag:
        bag.add_topic("/silent", "std_msgs/msg/Bool")
        channel = bag.add_topic("/said", "std_msgs/msg/Bool")
        bag.write(channel, bytes(serialize_message(Bool(data=True))), 1, 1)
    source = str(folder / "ein Flug.mcap")
    result = CliRunner().invoke(main, ["export", source])
    lines = [line.split(maxsplit=1) for line in result.stdout.splitlines()]
    made = folder / "ein Flug_csv"
    left_out = "no messages, left out"
    lines.sort()
    assert lines == [["/said", "1 rows"], ["/silent", left_out], ["tables", str(made)]]
    assert {each.name for each in made.iterdir()} == {"_columns.csv", "said.csv"}
    words = ["export", source, "-o", str(tmp_path / "one")]
    result = CliRunner().invoke(main, [*words, "--topic", "said", "--topic", "/said"])
    assert result.exit_code == 0, result.output
    assert {each.name for each in (tmp_path / "one").iterdir()} == {"_columns.csv", "said.csv"}


def test_the_command_that_a_cut_bag_asks_for_can_be_pasted(tmp_path: Path) -> None:
    bag = written(tmp_path / "ein Flug's Ende.mcap", [("/t", 1, Bool(data=True))])
    bag.path.write_bytes(bag.path.read_bytes()[:-40])
    result = CliRunner().invoke(main, ["export", str(bag.path)])
    assert result.exit_code == 2
    command = result.stderr.partition("'spacerobot")[2].rpartition("' makes")[0]
    assert shlex.split(f"spacerobot{command}") == ["spacerobot", "salvage", str(bag.path)]
