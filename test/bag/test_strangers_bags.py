"""Bags of other programs: split, compressed, in SQLite, in other encodings, of changing joints."""

from __future__ import annotations

import html
import json
import os
import shlex
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
import zstandard
from mcap.writer import MCAP0_MAGIC
from mcap.writer import Writer as McapWriter
from rosbags.highlevel import AnyReader
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore
from support.altered_bags import altered
from support.command_line import spacerobot
from support.hostile.records import CASES, Part, bag, message, plain, raw, string, zstd_zeros
from support.hostile_bags import QUICK
from support.sentences import assert_one_sentence

import spacerobot_ros
from spacerobot_ros.bag import (
    BagWriter,
    Playback,
    RecorderConfig,
    RecordingError,
    ReplayConfig,
    message_definition,
    read_bag,
)
from spacerobot_ros.bag.mcap_reading import INFLATED_SIZE_VARIABLE
from spacerobot_ros.bag.salvage import last_state, salvage_bag
from spacerobot_ros.flight.reading import open_flight_bag
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.resources import share_directory

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
ODOMETRY = "nav_msgs/msg/Odometry"
FLIGHT = share_directory() / "bags" / "sliding_masses.mcap"


def joint_states(k: int, names: Sequence[str]) -> bytes:
    """Return joint states in which joint ``jN`` is at 100 N + k."""
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=k, nanosec=0)
    message = types[JOINT_STATE](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id=""),
        name=list(names),
        position=np.array([100.0 * int(name[1:]) + k for name in names]),
        velocity=np.empty(0),
        effort=np.empty(0),
    )
    return bytes(STORE.serialize_cdr(message, JOINT_STATE))


def rosbag2(
    folder: Path,
    counts: range,
    *,
    plugin: StoragePlugin = StoragePlugin.MCAP,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """Write joint states by rosbags; return the folder."""
    writer = Writer(folder, version=9, storage_plugin=plugin)
    writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection("/joint_states", JOINT_STATE, typestore=STORE)
        for k in counts:
            writer.write(connection, k * 10**9, joint_states(k, ("j1", "j2")))
    return folder


def odometry(k: int) -> bytes:
    """Return odometry of a body at x = k."""
    types = STORE.types
    time = types["builtin_interfaces/msg/Time"](sec=k, nanosec=0)
    point, vector = types["geometry_msgs/msg/Point"], types["geometry_msgs/msg/Vector3"]
    pose = types["geometry_msgs/msg/Pose"](
        position=point(x=float(k), y=0.0, z=0.0),
        orientation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
    )
    still = vector(x=0.0, y=0.0, z=0.0)
    twist = types["geometry_msgs/msg/Twist"](linear=still, angular=still)
    unknown = np.zeros(36)
    message = types[ODOMETRY](
        header=types["std_msgs/msg/Header"](stamp=time, frame_id="world"),
        child_frame_id="base",
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=unknown),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=unknown),
    )
    return bytes(STORE.serialize_cdr(message, ODOMETRY))


@pytest.fixture
def split_bag(tmp_path: Path) -> Path:
    """A folder as rosbag2 leaves it after a split: eleven files, whose numbers sort as numbers."""
    folder = tmp_path / "split"
    folder.mkdir()
    parts = [f"split_{n}.mcap" for n in range(11)]
    for n, name in enumerate(parts):
        made = rosbag2(tmp_path / f"part_{n}", range(2 * n, 2 * n + 2))
        (made / f"{made.name}.mcap").rename(folder / name)
    metadata = yaml.safe_load((made / "metadata.yaml").read_text())
    metadata["rosbag2_bagfile_information"]["relative_file_paths"] = parts
    metadata["rosbag2_bagfile_information"]["files"] = []
    (folder / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    return folder


def exported(bag: Path, folder: Path) -> dict[str, pd.DataFrame]:
    """Export by the command; return the tables as pandas reads them."""
    spacerobot("export", bag, "-o", folder)
    files = [file for file in folder.glob("*.csv") if file.name != "_columns.csv"]
    return {file.stem: pd.read_csv(file) for file in files}


def assert_has_all_that_rosbags_reads(table: pd.DataFrame, folder: Path) -> None:
    with AnyReader([folder]) as reader:
        rows = [
            (time, *vars(reader.deserialize(data, connection.msgtype))["position"])
            for connection, time, data in reader.messages()
        ]
    np.testing.assert_array_equal(table[["time_ns", "position[j1]", "position[j2]"]], rows)


def test_a_split_bag_is_one_bag(split_bag: Path, tmp_path: Path) -> None:
    table = exported(split_bag, tmp_path / "out")["joint_states"]
    assert len(table) == 22
    with AnyReader([split_bag / f"split_{n}.mcap" for n in range(11)]) as reader:
        assert table["time_ns"].tolist() == [time for _, time, _ in reader.messages()]
    bag = read_bag(split_bag)
    assert (bag.path, bag.message_count(), bag.start_time, bag.end_time) == (split_bag, 22, 0, 21)
    playback = Playback(bag, ReplayConfig(start=1.5))
    playback.run(0)
    replayed = [playback.step(0) for _ in range(20)]
    assert [each.log_time_ns for each in replayed if each] == [k * 10**9 for k in range(2, 22)]
    assert playback.ended
    for words in (["report"], ["figures", "--format", "svg"]):
        out = str(tmp_path / words[0])
        spacerobot(*words, split_bag, "-o", out)
    (split_bag / "metadata.yaml").unlink()
    with pytest.raises(RecordingError, match="contains 11 MCAP files: name one of them"):
        read_bag(split_bag)


def test_a_file_of_a_split_bag_says_so(split_bag: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert read_bag(split_bag / "split_3.mcap").message_count() == 2
    (said,) = caplog.messages
    assert said == (
        f"{split_bag / 'split_3.mcap'} is one of 11 files of the bag in {split_bag}: name the "
        "folder to read all of them."
    )


def test_a_file_of_a_split_bag_that_was_cut_is_replaced_by_its_salvaged_copy(
    split_bag: Path,
) -> None:
    last = split_bag / "split_10.mcap"
    last.write_bytes(last.read_bytes()[:-20])
    with pytest.raises(RecordingError, match=f"{last} was cut short.*'spacerobot salvage {last}'"):
        read_bag(split_bag)
    assert salvage_bag(split_bag).path == split_bag / "split_10-salvaged.mcap"
    assert read_bag(split_bag).message_count() == 22
    with pytest.raises(RecordingError, match="is complete: there is nothing to salvage"):
        salvage_bag(split_bag)


@pytest.mark.parametrize("packed", [False, True])
def test_a_split_bag_that_lacks_a_file_is_refused(
    split_bag: Path, packed: bool, own_domain: None, tmp_path: Path
) -> None:
    lost = split_bag / "split_3.mcap"
    if packed:
        metadata = split_bag / "metadata.yaml"
        metadata.write_text(metadata.read_text().replace(".mcap", ".mcap.zstd"))
        for file in split_bag.glob("*.mcap"):
            file.with_name(f"{file.name}.zstd").write_bytes(zstandard.compress(file.read_bytes()))
            file.unlink()
        # What a user has unpacked is there, under another name.
        file = lost.with_name(f"{lost.name}.zstd")
        lost.write_bytes(zstandard.decompress(file.read_bytes()))
        file.unlink()
    assert read_bag(split_bag).message_count() == 22
    lost.rename(tmp_path / lost.name)
    sentence = (
        f"The bag {split_bag} lacks {lost.name}{'.zstd' * packed}, listed in its metadata.yaml: "
        "restore what is missing, or name one of the other files to read it alone."
    )
    with pytest.raises(RecordingError) as caught:
        read_bag(split_bag)
    assert str(caught.value) == sentence
    for command in ("report", "export", "figures", "verify", "salvage", "replay"):
        assert_one_sentence(spacerobot(command, split_bag, code=2).stderr, sentence)
    assert {each.name for each in tmp_path.glob("split*")} == {"split", lost.name}


def test_a_split_flight_is_verified_as_the_whole(tmp_path: Path) -> None:
    """Its commands, and the states between two files, are in both."""
    folder = tmp_path / "flight"
    folder.mkdir()
    middle = 17 * 10**9
    altered(FLIGHT, folder / "flight_0.mcap", end_ns=middle)
    # Numbers of channels differ between the files.
    altered(FLIGHT, folder / "flight_1.mcap", begin_ns=middle)
    files = {"relative_file_paths": ["flight_0.mcap", "flight_1.mcap"]}
    text = yaml.safe_dump({"rosbag2_bagfile_information": files})
    (folder / "metadata.yaml").write_text(text)
    assert verify_bag(folder) == verify_bag(FLIGHT)


def test_the_name_of_a_split_recording_is_all_of_its_files(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.mcap", RecorderConfig(max_duration=1.0), chunk_size=1) as writer:
        channel = writer.add_topic("/joint_states", JOINT_STATE)
        for k in range(5):
            writer.write(channel, joint_states(k, ("j1",)), k * 10**9, k * 10**9)
    assert len(list(tmp_path.iterdir())) > 2
    bag = read_bag(tmp_path / "a.mcap")
    assert bag["joint_states"].field("position").tolist() == [[100 + k] for k in range(5)]
    assert bag.metadata["rosbag2"] == read_bag(sorted(tmp_path.iterdir())[-1]).metadata["rosbag2"]
    (tmp_path / "a_1.mcap").rename(tmp_path / "a_1-salvaged.mcap")
    assert read_bag(tmp_path / "a.mcap").message_count() == 5
    (tmp_path / "a_1-salvaged.mcap").unlink()
    lacks = r"The bag \S+a\.mcap lacks a_1\.mcap: restore what is missing, or name one of the other"
    with pytest.raises(RecordingError, match=lacks):
        read_bag(tmp_path / "a.mcap")


def test_a_compressed_file_is_read(tmp_path: Path) -> None:
    folder = rosbag2(tmp_path / "zst", range(20), compression=CompressionMode.FILE)
    (file,) = folder.glob("*.zstd")
    for number, path in enumerate((folder, file)):
        table = exported(path, tmp_path / f"out_{number}")["joint_states"]
        assert_has_all_that_rosbags_reads(table, folder)
    assert read_bag(file).path == file
    file.write_bytes(zstandard.compress(bytes(40_000_000)))
    with pytest.raises(RecordingError, match=r"inflates to .*more than the 32000000 allowed"):
        read_bag(file)
    refused = spacerobot("salvage", file, code=2).stderr
    assert_one_sentence(refused, "is compressed: unpack it with 'zstd -d'")


def test_messages_that_were_compressed_one_by_one_are_read(tmp_path: Path) -> None:
    folder = rosbag2(tmp_path / "zst", range(20), compression=CompressionMode.MESSAGE)
    table = exported(folder, tmp_path / "out")["joint_states"]
    assert_has_all_that_rosbags_reads(table, folder)
    playback = Playback(read_bag(folder))
    playback.run(0)
    replayed = [each.data for _ in range(20) if (each := playback.step(0))]
    assert replayed == [joint_states(k, ("j1", "j2")) for k in range(20)]
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes()[:-20])
    with AnyReader([salvage_bag(file).path]) as reader:
        assert [data for *_, data in reader.messages()] == replayed
    flight = altered(FLIGHT, tmp_path / "flight.mcap", packed=zstandard.compress)
    assert verify_bag(flight) == verify_bag(FLIGHT)


def test_all_messages_together_are_bounded(tmp_path: Path) -> None:
    path, size = tmp_path / "a.mcap", 20 * 2**20
    packed = message(zstd_zeros(size, claims=size))
    path.write_bytes(bag(plain(packed)))
    assert sum(len(data) for *_, data in read_bag(path).raw_messages(["/a"])) == size
    path.write_bytes(bag(plain(packed), plain(packed)))
    with pytest.raises(RecordingError, match=f"inflates to {2 * size} bytes"):
        list(read_bag(path).raw_messages(["/a"]))
    path.write_bytes(bag(plain(message(zstd_zeros(size)))))
    with pytest.raises(RecordingError, match=r"a.mcap is damaged: .*content size"):
        list(read_bag(path).raw_messages(["/a"]))


def test_a_bag_in_sqlite_says_how_to_convert_it(tmp_path: Path) -> None:
    folder = rosbag2(tmp_path / "a bag", range(5), plugin=StoragePlugin.SQLITE3)
    (file,) = folder.glob("*.db3")
    for path in (folder, file):
        with pytest.raises(RecordingError, match=f"The bag {file} is in SQLite: ") as caught:
            read_bag(path)
    command = str(caught.value).split("convert it with '")[1].split("', or")[0]
    if "'" in command:
        command = command.partition(" --dst ")[0] + " --dst NEW_FOLDER --dst-storage mcap"
    program, *words = shlex.split(command.replace("NEW_FOLDER", shlex.quote(f"{tmp_path}/new")))
    subprocess.run([Path(sys.executable).with_name(program), *words], check=True)
    table = exported(tmp_path / "new", tmp_path / "out")["joint_states"]
    assert_has_all_that_rosbags_reads(table, folder)


@pytest.fixture
def mixed(tmp_path: Path) -> Path:
    """A bag with joint states, and topics in JSON, in protobuf, and defined in IDL."""
    path = tmp_path / "mixed.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start("")
        for topic, name, encoding, schema, data in (
            ("/cfg", "Thing", "json", "jsonschema", b"{}"),
            ("/joint_states", JOINT_STATE, "cdr", "ros2msg", joint_states(1, ("j1", "j2"))),
            ("/proto", "a.B", "protobuf", "protobuf", b"\n\0"),
            ("/chatter", "std_msgs/msg/String", "cdr", "ros2idl", b"\0\1\0\0\1\0\0\0\0"),
        ):
            text = message_definition(JOINT_STATE).encode() if schema == "ros2msg" else b"{}"
            number = writer.register_schema(name, schema, text)
            writer.add_message(writer.register_channel(topic, encoding, number), 1, data, 1)
        writer.finish()
    return path


def test_topics_that_cannot_be_read_are_named_and_the_rest_is_written(
    mixed: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tables = exported(mixed, tmp_path / "out")
    assert tables.keys() == {"joint_states"}
    assert tables["joint_states"]["position[j2]"].tolist() == [201.0]
    (said,) = caplog.messages
    assert said == (
        f"The bag {mixed} is read without 3 topics: /cfg, /proto, /chatter. The topic /cfg of "
        f"the bag {mixed} does not use ROS 2's encoding ('cdr' defined by 'ros2msg'), but 'json' "
        "defined by 'jsonschema'."
    )
    bag = read_bag(mixed)
    assert bag.to_pandas().keys() == bag.to_xarray().keys() == {"/joint_states"}
    refused = spacerobot("export", mixed, "--topic", "chatter", code=2).stderr
    assert_one_sentence(refused, "'cdr' defined by 'ros2idl'")


def test_states_under_other_names_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, names = tmp_path / "chaser", ("j1", "j2")
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        for topic, kind, make in (
            ("/chaser/odometry/filtered", ODOMETRY, odometry),
            ("/odom", JOINT_STATE, lambda k: joint_states(k, names)),
            ("/chaser/arm/joint_states", JOINT_STATE, lambda k: joint_states(k, names)),
            ("/joint_commands", JOINT_STATE, lambda k: joint_states(k, names)),
        ):
            connection = writer.add_connection(topic, kind, typestore=STORE)
            for k in range(5):
                writer.write(connection, k * 10**9, make(k))
    as_odom = (
        f", but /odom of type {JOINT_STATE}, not {ODOMETRY} and /chaser/odometry/filtered of type "
        f"{ODOMETRY} (to rename it, record 'spacerobot replay BAG --remap "
        "/chaser/odometry/filtered:=/odom')"
    )
    no_poses = f"The bag contains no base poses (odom){as_odom}; base figures are missing."
    report = tmp_path / "a.html"
    spacerobot("report", folder, "-o", report)
    assert no_poses in html.unescape(report.read_text("utf-8"))
    assert caplog.messages == [
        f"The bag {folder} contains no odom{as_odom}.",
        f"The bag {folder} contains no joint_states, but /chaser/arm/joint_states of type "
        f"{JOINT_STATE} (to rename it, record 'spacerobot replay BAG --remap "
        "/chaser/arm/joint_states:=/joint_states').",
    ]
    refused = spacerobot("figures", folder, "--only", "pose", "-o", tmp_path / "f", code=1).stderr
    assert refused == f"pose        none: {no_poses}\n"
    refused = spacerobot("report", folder, "--namespace", "chaser", code=2).stderr
    assert_one_sentence(refused, "/chaser/odometry/filtered:=/chaser/odom'")


def test_columns_of_joints_follow_names(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    orders = [("j1", "j2", "j3"), ("j3", "j1", "j2"), ("j2", "j3", "j1")]
    with BagWriter(path) as writer:
        channel = writer.add_topic("/joint_states", JOINT_STATE)
        for k in range(9):
            writer.write(channel, joint_states(k, orders[k % 3]), k * 10**9, k * 10**9)
    series = read_bag(path)["joint_states"]
    expected = [[100 + k, 200 + k, 300 + k] for k in range(9)]
    np.testing.assert_array_equal(series.field("position"), expected)
    assert series.field("name") == [["j1", "j2", "j3"]] * 9
    assert series.field("velocity").shape == (9, 0)
    table = exported(path, tmp_path / "out")["joint_states"]
    np.testing.assert_array_equal(table[[f"position[j{n}]" for n in (1, 2, 3)]], expected)
    q = open_flight_bag(path).signal("joint_states", ["position"], 3)
    np.testing.assert_array_equal(q.values, expected)


def test_a_joint_that_a_message_lacks_is_nan(tmp_path: Path) -> None:
    """As of two drivers that publish on one topic; a flight has the joints of the first."""
    path = tmp_path / "a.mcap"
    with BagWriter(path) as writer:
        channel = writer.add_topic("/joint_states", JOINT_STATE)
        for k in range(4):
            names = ("j2", "j1") if k % 2 else ("j7",)
            writer.write(channel, joint_states(k, names), k * 10**9, k * 10**9)
    series, nan = read_bag(path)["joint_states"], np.nan
    assert series.joint_names == ["j7", "j2", "j1"]
    expected = [[700, nan, nan], [nan, 201, 101], [702, nan, nan], [nan, 203, 103]]
    np.testing.assert_array_equal(series.field("position"), expected)
    np.testing.assert_array_equal(
        series.of_joints("position", ["j1", "j9"]), [[nan, nan], [101, nan], [nan, nan], [103, nan]]
    )
    q = open_flight_bag(path).signal("joint_states", ["position"], 1)
    np.testing.assert_array_equal(q.values, [[700], [702]])


def attempts(folder: Path, operations: str, words: str) -> list[dict[str, Any]]:
    """Return what came of the bags with some words in their names, each in its own process."""
    paths = (Path(spacerobot_ros.__file__).parents[1], Path(__file__).parents[1])
    done = subprocess.run(
        [sys.executable, "-m", "support.hostile_bags", str(folder), operations, words],
        env={
            **os.environ,
            "PYTHONPATH": os.pathsep.join([*map(str, paths), os.environ.get("PYTHONPATH", "")]),
            "SPACEROBOT_COMPILE": "0",
        },
        stdout=subprocess.PIPE,
        check=True,
    )
    return [json.loads(line) for line in done.stdout.splitlines()]


def assert_all_refused(found: list[dict[str, Any]]) -> None:
    faults = [f"{o['operation']}, {o['case']}: {o['fault']}" for o in found if o["fault"]]
    assert not faults, "\n".join(faults)


@pytest.mark.slow
def test_hostile_bags_do_no_harm(tmp_path: Path) -> None:
    found = attempts(tmp_path, "everything", "QUICK")
    assert {o["case"] for o in found} == set(QUICK)
    assert_all_refused(found)
    assert all(o["code"] == 2 for o in found)


@pytest.mark.study
@pytest.mark.parametrize("operations", ["read,resume,play,salvage", "verify", "report", "replay"])
def test_nothing_that_is_done_with_hostile_bags_does_harm(
    tmp_path: Path, own_domain: None, operations: str
) -> None:
    found = attempts(tmp_path, operations, "")
    assert len(CASES) >= 40
    assert len(found) == len(CASES) * len(operations.split(","))
    assert_all_refused(found)
    print(f"{operations}: {len(found)} attempts, at most {max(o['seconds'] for o in found):.1f} s")
    print(f"and {max(o['megabytes'] for o in found):.0f} MB")


def test_what_inflates_much_is_read_where_the_user_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.mcap"
    size = 40 * 2**20
    path.write_bytes(bag(Part("zstd", zstd_zeros(size, claims=size), size)))
    with pytest.raises(RecordingError, match=f"inflates to {size} bytes.*{INFLATED_SIZE_VARIABLE}"):
        read_bag(path)
    monkeypatch.setenv(INFLATED_SIZE_VARIABLE, "50")
    assert read_bag(path).message_count() == 1


def test_all_chunks_together_are_bounded(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    size = 20 * 2**20
    part = Part("zstd", zstd_zeros(size, claims=size), size)
    path.write_bytes(bag(part))
    assert read_bag(path).message_count() == 1
    path.write_bytes(bag(part, part))
    with pytest.raises(RecordingError, match=f"inflates to {2 * size} bytes"):
        read_bag(path)


def test_a_sentence_names_the_place(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    content = bag(Part("", message(string("x")), 2**63))
    path.write_bytes(content)
    place = content.index(b"\x06" + (len(message(string("x"))) + 40).to_bytes(8, "little"))
    with pytest.raises(RecordingError, match=f"{path} is damaged: .*chunk at byte {place} "):
        read_bag(path)


def make_socket(path: Path) -> None:
    home = os.getcwd()
    try:
        os.chdir(path.parent)  # The names of sockets have at most 107 characters.
        with socket.socket(socket.AF_UNIX) as opened:
            opened.bind(path.name)
    finally:
        os.chdir(home)


def make_device(path: Path) -> None:
    path.symlink_to("/dev/full")


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (os.mkfifo, "it is a pipe"),
        (make_socket, "it is a socket"),
        (make_device, "it is a device"),
        (Path.mkdir, "it is a folder|contains no bag"),
    ],
)
def test_what_is_no_file_is_neither_read_nor_written(
    tmp_path: Path, make: Callable[[Path], None], words: str
) -> None:
    path = tmp_path / "a.mcap"
    make(path)
    acts: list[Callable[[Path], Any]] = [
        read_bag,
        lambda path: list(read_bag(path).raw_messages(["/a"])),
        last_state,
        lambda path: salvage_bag(path, tmp_path / "out.mcap"),
        BagWriter,
        lambda path: BagWriter(path, overwrite=False),
    ]
    for act in acts:
        with pytest.raises(RecordingError, match=words):
            act(path)
    for name in ("verify", "report", "salvage"):
        result = spacerobot(name, path, code=2)
        assert len(result.output.splitlines()) == 1


def test_a_message_may_hold_nothing_and_has_a_whole_head(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(bag(plain(message(string("text")), message(b""))))
    assert [data for *_, data in read_bag(path).raw_messages(["/a"])] == [string("text"), b""]
    path.write_bytes(bag(plain(message(string("text")), raw(0x05, bytes(21)))))
    with pytest.raises(RecordingError, match=r"is damaged: a message .* is shorter"):
        read_bag(path)["/a"]


def test_a_chunk_and_its_index_agree(tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", message(string("x"))
    path.write_bytes(bag(Part("", data, len(data), indexed_size=len(data) + 1)))
    with pytest.raises(RecordingError, match="and its index specify different sizes"):
        read_bag(path)["/a"]


@pytest.mark.parametrize("length", [0, 20, 21, 28])
def test_a_file_that_is_too_short_for_a_footer_is_damaged_at_its_begin(
    tmp_path: Path, length: int
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(MCAP0_MAGIC + bytes([1] * length) + MCAP0_MAGIC)
    # The footer takes 29 bytes, and what the file ends with 8.
    place = max(8 + length - 29, 0)
    with pytest.raises(RecordingError, match=f"is damaged: the record at byte {place} declares"):
        read_bag(path)
