"""Bags as tables of pandas and xarray, and in files that other programs read."""

from __future__ import annotations

import csv
import json
import keyword
import math
import re
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from mcap.writer import Writer
from rclpy.serialization import serialize_message
from scipy.io import loadmat
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import Bool, Header, String, UInt64
from support.command_line import spacerobot
from support.flight_bags import urdf_of
from support.made_bags import array, status, write_message
from support.sentences import assert_one_sentence
from support.slow import some_fast

from spacerobot_ros.bag import Bag, BagWriter, RecordingError, read_bag
from spacerobot_ros.bag.tables import ExportFormat, TopicTable, export
from spacerobot_ros.resources import share_directory

SERVICER = share_directory() / "bags" / "servicer_thrusters.mcap"
JOINTS = "shoulder_yaw", "shoulder_pitch", "elbow_pitch", "wrist_roll", "wrist_pitch", "tool_roll"
NASTY = 'a "quoted" text, with\nlines, a µ and ; semicolons'


def written(path: Path, messages: list[tuple[str, int, Any]]) -> Bag:
    """Write (topic, log time in ns, message), as ``ros2 bag`` does: without any of our metadata."""
    with BagWriter(path) as bag:
        for topic, time_ns, message in messages:
            write_message(bag, topic, message, time_ns)
    return read_bag(path)


def said(**values: str) -> DiagnosticStatus:
    return status(values, NASTY, "plant")


def joints(names: list[str], *position: float) -> JointState:
    return JointState(name=names, position=position)


@pytest.fixture
def bag(tmp_path: Path) -> Bag:
    """Texts, keys that differ, arrays that differ in length, numbers that only exact text keeps."""
    tenth = 100_000_000
    return written(
        tmp_path / "small.mcap",
        [
            ("/joint_states", 1 * tenth, joints(["b", "a"], 0.1, 1 / 3)),
            ("/joint_states", 2 * tenth, joints(["b", "a"], -1e-300, math.nan)),
            ("/changing", 3 * tenth, joints(["x"], 1.0)),
            ("/changing", 4 * tenth, joints(["y", "x"], 2.0, 3.0)),
            ("/events", 5 * tenth, said(event="goal_accepted", goal_id="7")),
            ("/events", 5 * tenth, said(event="fault_injected", joint="a")),
            ("/About", 6 * tenth, String(data="1")),
            ("/about", 7 * tenth, String(data="2")),
            ("/a/b", 8 * tenth, array(1.0, 2.0)),
        ],
    )


def test_a_bag_is_a_mapping_of_topics_with_and_without_the_slash(bag: Bag) -> None:
    assert bag["joint_states"] is bag["/joint_states"]
    assert bag.message_count("events") == bag.message_count("/events") == 2
    assert "events" in bag
    assert "/events" in bag
    assert "event" not in bag
    assert list(bag) == list(bag.keys()) == list(bag.topics)
    assert len(bag) == 6
    assert dict(bag.items())["/a/b"] is bag["a/b"]
    assert list(bag.values()) == [bag[topic] for topic in bag.topics]
    assert bag.get("events") is bag["/events"]
    assert bag.get("event") is None
    assert bag.get("event", 7) == 7
    for no_name in (7, None, ["events"]):
        with pytest.raises(TypeError, match="A topic name must be a string"):
            bag.to_pandas(no_name) if no_name else bag[no_name]  # type: ignore[index,call-overload]
    with pytest.raises(RecordingError, match="no topic event: it has"):
        bag["event"]


def test_a_bag_and_a_topic_say_what_they_hold(bag: Bag) -> None:
    text = repr(bag)
    assert text.startswith(f"Bag {bag.path}: 9 messages on 6 topics, 0.7 s:\n")
    assert "/joint_states        2  sensor_msgs/msg/JointState" in text
    assert "2 sensor_msgs/msg/JointState, 0.1 to 0.2 s; fields: header.stamp.sec" in repr(
        bag["joint_states"]
    )


def test_what_is_handed_out_is_a_copy(bag: Bag) -> None:
    series = bag["joint_states"]
    for change in (series.time, series.stamp, series.field("position")):
        change += 1.0
    series.field("name")[0][0] = "other"
    bag["changing"].field("position")[0][:] = 7.0
    bag["events"].field("values")[0][0].key = "other"
    bag["events"].field("values.key")[0][0] = "other"
    frame = bag.to_pandas("joint_states")
    frame.loc[:, "position[b]"] = 5.0
    bag.to_xarray("joint_states")["position"][:] = 5.0
    assert series.time.tolist() == [0.1, 0.2]
    assert series.field("position")[0].tolist() == [0.1, 1 / 3]
    assert series.field("name")[0] == ["b", "a"]
    np.testing.assert_array_equal(bag["changing"].field("position")[0], [1.0, np.nan])
    assert bag["events"].field("values.key")[0] == ["event", "goal_id"]
    for kept in (series.time_ns, series.stamp_ns):
        with pytest.raises(ValueError, match="read-only"):
            kept += 1


def test_columns_have_the_names_of_joints_and_keys(bag: Bag) -> None:
    frame = bag.to_pandas("joint_states")
    assert frame.index.name == "time"
    assert frame.index.tolist() == [0.1, 0.2]
    assert frame["position[a]"].tolist()[0] == 1 / 3
    assert "name" not in frame
    changing = bag.to_pandas("changing")
    assert changing["position[x]"].tolist() == [1.0, 3.0]
    np.testing.assert_array_equal(changing["position[y]"], [np.nan, 2.0])
    assert "name" not in changing
    events = bag.to_pandas("events")
    assert events["values[goal_id]"].tolist() == ["7", ""]
    assert events["values[event]"].tolist() == ["goal_accepted", "fault_injected"]
    assert events["message"].tolist() == [NASTY] * 2


def test_units_are_those_of_the_robot_and_the_topic() -> None:
    opened = read_bag(SERVICER)
    units = {
        topic: opened.to_pandas(topic).attrs["units"]
        for topic in ("odom", "joint_states", "thrusters", "momentum", "base_wrench")
    }
    assert units["odom"]["pose.pose.position.x"] == "m"
    assert units["odom"]["twist.twist.angular.z"] == "rad/s"
    assert units["joint_states"]["position[wrist_roll]"] == "rad"
    assert units["joint_states"]["effort[wrist_roll]"] == "N m"
    assert set(units["thrusters"].values()) == {"ns", "s", "", "1", "N"}
    assert units["momentum"]["data[angular_x]"] == "kg m^2/s"
    assert units["momentum"]["data[kinetic_energy]"] == "J"
    assert units["base_wrench"]["wrench.torque.y"] == "N m"
    sliding = read_bag(share_directory() / "bags" / "sliding_masses.mcap").to_pandas("joint_states")
    assert sliding.attrs["units"]["velocity[slider_1]"] == "m/s"


def test_xarray_keeps_arrays_over_joints() -> None:
    opened = read_bag(SERVICER)
    states = opened.to_xarray("joint_states")
    assert states["position"].dims == ("time", "joint")
    assert states["joint"].values.tolist() == list(JOINTS)
    assert states["velocity"].attrs["units"] == "rad/s"
    np.testing.assert_array_equal(states["position"], opened["joint_states"].field("position"))
    momentum = opened.to_xarray("momentum")["data"]
    energy = momentum.sel({"data entry": "kinetic_energy"})
    np.testing.assert_array_equal(energy, opened["momentum"].field("data")[:, 6])


def test_all_topics_at_once_are_tables_by_name(bag: Bag) -> None:
    assert bag.to_xarray().keys() == bag.to_pandas().keys() == bag.topics.keys()


def from_csv(path: Path, like: pd.DataFrame) -> pd.DataFrame:
    """Read a table in CSV as the manual says."""
    numbers = like.select_dtypes("number").columns
    before_3_1 = tuple(int(part) for part in pd.__version__.split(".")[:2]) < (3, 1)
    exact: dict[str, Any] = {"float_precision": "round_trip"} if before_3_1 else {}
    return pd.read_csv(
        path,
        index_col="time",
        keep_default_na=False,
        na_values={name: ["nan"] for name in numbers},
        dtype=dict.fromkeys(like.columns.difference(numbers), str),
        **exact,
    )


def from_mat(struct: dict[str, Any], path: str) -> Any:
    """Return a field of a topic in MAT, whose names are those of a program."""
    for part in path.split("."):
        struct = struct[re.sub(r"\W+", "_", part).strip("_")]
    return struct


@pytest.mark.parametrize("which", some_fast(["small", "servicer"], "small"))
def test_the_same_bag_in_three_formats_is_equal(which: str, tmp_path: Path, bag: Bag) -> None:
    opened = bag if which == "small" else read_bag(SERVICER)
    tables = [opened.table(topic) for topic in opened]
    folder, parquet, mat, tree = (tmp_path / kind.value for kind in ExportFormat)
    for path, kind in zip((folder, parquet, mat, tree), ExportFormat, strict=True):
        assert export(tables, path, kind) == {t.topic: len(t) for t in tables}
    listed = pd.read_csv(folder / "_columns.csv", keep_default_na=False)
    structs = loadmat(mat, simplify_cells=True)
    names = {each["topic"]: name for name, each in next(find_about(structs)).items()}
    for table in tables:
        expected = opened.to_pandas(table.topic)
        units = {"time": "s", **table.units}
        rows = listed[listed["topic"] == table.topic]
        assert dict(zip(rows["column"], rows["unit"], strict=True)) == units
        (file,) = set(rows["file"])
        read = from_csv(folder / file, expected)
        pd.testing.assert_frame_equal(read, expected, check_exact=True, check_dtype=False)
        # PlotJuggler has a branch for each part between slashes.
        head, numbers = (tree / file).read_text("utf-8").split("\n", 1)
        first, *paths = next(csv.reader([head]))
        assert (first, len(paths)) == ("time", len(expected.columns))
        assert all(each.startswith(f"{table.topic.strip('/')}/") for each in paths)
        assert not set(head) & set(".[]")
        assert numbers == (folder / file).read_text("utf-8").split("\n", 1)[1]
        stored = parquet / Path(file).with_suffix(".parquet")
        read = pd.read_parquet(stored)
        pd.testing.assert_frame_equal(read, expected, check_exact=True)
        assert read.attrs == expected.attrs
        metadata = {each.name: each.metadata or {} for each in pq.read_schema(stored)}
        assert {name: kept.get(b"unit", b"").decode() for name, kept in metadata.items()} == units
        struct = structs[names[table.topic]]
        np.testing.assert_array_equal(np.atleast_1d(struct["time"]), table.time)
        for field in table.fields:
            values = np.asarray(from_mat(struct, field.path)).reshape(field.values.shape)
            if field.values.dtype == object:
                # An empty text is an empty array of characters.
                values = np.array([x if isinstance(x, str) else "".join(x) for x in values])
            np.testing.assert_array_equal(values, field.values)


def find_about(structs: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Yield the struct that says what the others are."""
    for each in structs.values():
        if isinstance(each, dict) and all(
            isinstance(x, dict) and {"columns", "units"} <= x.keys() for x in each.values()
        ):
            yield each


@pytest.mark.parametrize(
    ("name", "made"), [("csv", "b_csv"), ("parquet", "b_parquet"), ("mat", "b.mat")]
)
def test_the_command_writes_beside_the_bag_and_never_over_anything(
    name: str, made: str, tmp_path: Path
) -> None:
    copy = tmp_path / "b.mcap"
    copy.write_bytes(SERVICER.read_bytes())
    words = ["export", str(copy), "--format", name, "--topic", "odom", "--topic", "/thrusters"]
    result = spacerobot(*words)
    printed = [line.split()[0] for line in result.output.splitlines()]
    assert printed == ["/odom", "/thrusters", "tables"]
    before = {each: each.stat().st_mtime_ns for each in sorted(tmp_path.rglob("*"))}
    assert tmp_path / made in before
    again = spacerobot(*words, code=2)
    assert_one_sentence(again.stderr, made, "already")
    assert {each: each.stat().st_mtime_ns for each in sorted(tmp_path.rglob("*"))} == before


def test_what_cannot_be_exported_leaves_nothing_behind(tmp_path: Path, bag: Bag) -> None:
    (tmp_path / "taken").symlink_to("nowhere")
    with pytest.raises(RecordingError, match="already"):
        export([], tmp_path / "taken", ExportFormat.CSV)
    with pytest.raises(RecordingError, match="cannot be written"):
        export([], bag.path / "below", ExportFormat.CSV)

    for name, kind, mention in (
        ("flight.csv", ExportFormat.MAT, "must end in .mat; 'flight.csv' does not."),
        ("flight.xlsx", ExportFormat.MAT, "must end in .mat"),
        ("flight.CSV", ExportFormat.CSV, "in csv are written to a folder"),
        ("flight.mat", ExportFormat.PARQUET, "in parquet are written to a folder"),
    ):
        with pytest.raises(RecordingError) as refusal:
            export([], tmp_path / name, kind)
        assert_one_sentence(str(refusal.value), mention)
        assert not (tmp_path / name).exists()

    def damaged() -> Iterator[TopicTable]:
        yield bag.table("events")
        raise RecordingError("damaged")

    for kind in ExportFormat:
        with pytest.raises(RecordingError, match="damaged"):
            export(damaged(), tmp_path / "out" / "x", kind)
    assert not (tmp_path / "out").exists()


def test_names_of_topics_make_no_paths(tmp_path: Path) -> None:
    topics = ["/../../up", "/.hidden", "/Odom", "/odom", "/" + "long" * 60, "/1.2", "/_columns"]
    opened = written(tmp_path / "b.mcap", [(topic, 1, String(data="x")) for topic in topics])
    made = tmp_path / "x"
    export((opened.table(topic) for topic in opened), made, ExportFormat.CSV)
    files = {each.name for each in made.iterdir()}
    assert len(files) == len({name.lower() for name in files}) == len(topics) + 1
    assert {each.parent for each in tmp_path.rglob("*.csv")} == {made}
    export((opened.table(topic) for topic in opened), tmp_path / "x.mat", ExportFormat.MAT)
    found = loadmat(tmp_path / "x.mat", simplify_cells=True)
    assert all(name.isidentifier() for name in found)
    assert len([1 for each in found.values() if isinstance(each, dict)]) == len(topics) + 1


@pytest.mark.parametrize("library", ["pandas", "xarray"])
def test_a_missing_library_is_one_sentence(
    library: str, bag: Bag, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(RecordingError) as refused:
        bag.to_pandas("events") if library == "pandas" else bag.to_xarray("events")
    assert_one_sentence(str(refused.value), library, "pip install '.[data]' in the clone")


def test_csv_takes_no_library(bag: Bag, tmp_path: Path) -> None:
    code = (
        "import sys\n"
        "sys.modules.update(dict.fromkeys(('pandas', 'pyarrow', 'xarray', 'scipy')))\n"
        "from spacerobot_ros.cli.main import main\n"
        "main(sys.argv[1:], standalone_mode=False)"
    )
    words = ["export", str(bag.path), "--out", str(tmp_path / "tables")]
    subprocess.run([sys.executable, "-c", code, *words], check=True, capture_output=True)
    assert (tmp_path / "tables" / "joint_states.csv").is_file()


# -- tables of bags that others recorded -------------------------------------------------------

WALL = 1_763_817_000_123_456_789
"""Nanoseconds that float64 does not hold: its next neighbours are 256 away."""

FORMATS = [ExportFormat.CSV, ExportFormat.PARQUET, ExportFormat.MAT]


def exported(bag: Bag, format: ExportFormat, name: str = "") -> Any:
    """Export a bag; read a topic back as columns or as a struct, by default the only one."""
    target = bag.path.with_name(f"{bag.path.stem}_{format.value}")
    export((bag.table(topic) for topic in bag), target, format)
    name = name or next(iter(bag)).strip("/")
    match format:
        case ExportFormat.CSV:
            return pd.read_csv(target / f"{name}.csv", keep_default_na=False)
        case ExportFormat.PARQUET:
            return pd.read_parquet(target / f"{name}.parquet").reset_index()
        case ExportFormat.MAT:
            return loadmat(target, simplify_cells=True)[name]


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
    assert [int(x) for x in table["time_ns"]] == [WALL, WALL + 1]
    assert [int(x) for x in table["stamp_ns"]] == stamps
    assert np.asarray(table["time"]) == pytest.approx([WALL / 1e9, (WALL + 1) / 1e9], rel=1e-15)


@pytest.mark.parametrize("format", FORMATS)
def test_texts_and_large_numbers_come_back_as_they_were(
    format: ExportFormat, tmp_path: Path
) -> None:
    texts = ["one\rtwo", "a\r\nb\tc", '"quoted", with commas', "NA", " ", "ä µ 漢"]
    bag = written(tmp_path / "b.mcap", [("/t", k, String(data=x)) for k, x in enumerate(texts)])
    assert list(exported(bag, format)["data"]) == texts
    large = [2**64 - 1, 2**53 + 1]
    bag = written(tmp_path / "c.mcap", [("/n", k, UInt64(data=x)) for k, x in enumerate(large)])
    assert [int(x) for x in exported(bag, format)["data"]] == large


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
            ("/s", 4, said(**{"a": "1", "a.b": "2", "a.b.c": "3", f"{long}1": "4"})),
            ("/s", 5, said(**{"A": "5", "for": "6", "": "7", "7 of 9": "8", f"{long}2": "9"})),
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


def test_the_command_names_what_it_leaves_out_and_a_topic_once(tmp_path: Path) -> None:
    folder = tmp_path / "Bäge mit Lücken"
    folder.mkdir()
    with BagWriter(folder / "ein Flug.mcap") as bag:
        bag.add_topic("/silent", "std_msgs/msg/Bool")
        channel = bag.add_topic("/said", "std_msgs/msg/Bool")
        bag.write(channel, bytes(serialize_message(Bool(data=True))), 1, 1)
    source = str(folder / "ein Flug.mcap")
    result = spacerobot("export", source)
    lines = [line.split(maxsplit=1) for line in result.stdout.splitlines()]
    made = folder / "ein Flug_csv"
    left_out = "no messages, omitted"
    lines.sort()
    assert lines == [["/said", "1 rows"], ["/silent", left_out], ["tables", str(made)]]
    assert {each.name for each in made.iterdir()} == {"_columns.csv", "said.csv"}
    words = ["export", source, "-o", str(tmp_path / "one")]
    result = spacerobot(*words, "--topic", "said", "--topic", "/said")
    assert {each.name for each in (tmp_path / "one").iterdir()} == {"_columns.csv", "said.csv"}
