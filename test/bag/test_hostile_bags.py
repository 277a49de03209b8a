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
from support.command_line import CliRunner
from support.hostile.records import CASES, Part, bag, message, string, zstd_zeros
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
