"""Bags made to harm their reader: refused with a sentence, in little memory and time."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from mcap.writer import MCAP0_MAGIC
from support.command_line import CliRunner
from support.hostile.records import CASES, Part, bag, message, plain, raw, string, zstd_zeros
from support.hostile_bags import QUICK

import spacerobot_ros
from spacerobot_ros.bag import BagWriter, RecordingError, iterate_raw, read_bag
from spacerobot_ros.bag.mcap_reading import INFLATED_SIZE_VARIABLE
from spacerobot_ros.bag.salvage import last_state, salvage_bag
from spacerobot_ros.cli.main import main


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


@pytest.mark.slow
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


def make_pipe(path: Path) -> None:
    os.mkfifo(path)


def make_folder(path: Path) -> None:
    path.mkdir()


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
        (make_pipe, "it is a pipe"),
        (make_socket, "it is a socket"),
        (make_device, "it is a device"),
        (make_folder, "it is a folder|holds 0 MCAP files"),
    ],
)
def test_what_is_no_file_is_neither_read_nor_written(
    tmp_path: Path, make: Callable[[Path], None], words: str
) -> None:
    path = tmp_path / "a.mcap"
    make(path)
    acts: list[Callable[[Path], Any]] = [
        read_bag,
        lambda path: list(iterate_raw(path)),
        last_state,
        lambda path: salvage_bag(path, tmp_path / "out.mcap"),
        BagWriter,
        lambda path: BagWriter(path, overwrite=False),
    ]
    for act in acts:
        with pytest.raises(RecordingError, match=words):
            act(path)
    for name in ("verify", "report", "salvage"):
        result = CliRunner().invoke(main, [name, str(path)])
        assert result.exit_code == 2
        assert len(result.output.splitlines()) == 1


def test_a_message_may_hold_nothing_and_has_a_whole_head(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(bag(plain(message(string("text")), message(b""))))
    assert [data for *_, data in iterate_raw(path)] == [string("text"), b""]
    path.write_bytes(bag(plain(message(string("text")), raw(0x05, bytes(21)))))
    for read in (lambda: list(iterate_raw(path)), lambda: read_bag(path)["/a"]):
        with pytest.raises(RecordingError, match=r"is damaged: a message .* is shorter"):
            read()


def test_a_chunk_and_its_index_agree(tmp_path: Path) -> None:
    path, data = tmp_path / "a.mcap", message(string("x"))
    path.write_bytes(bag(Part("", data, len(data), indexed_size=len(data) + 1)))
    with pytest.raises(RecordingError, match="and its index claim different sizes"):
        read_bag(path)["/a"]


@pytest.mark.parametrize("length", [0, 20, 21, 28])
def test_a_file_that_is_too_short_for_a_footer_is_damaged_at_its_begin(
    tmp_path: Path, length: int
) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(MCAP0_MAGIC + bytes([1] * length) + MCAP0_MAGIC)
    # The footer takes 29 bytes, and what the file ends with 8.
    place = max(8 + length - 29, 0)
    with pytest.raises(RecordingError, match=f"is damaged: the record at byte {place} claims"):
        read_bag(path)
