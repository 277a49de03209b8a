"""Reports, pictures and results are written as a whole, or what was there before stays."""

from __future__ import annotations

import json
import os
import resource
import signal
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest
from support.command_line import CliRunner
from support.sentences import assert_one_sentence

from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.files import write_output


@pytest.fixture
def full_disk() -> Iterator[None]:
    """A disk that takes no more than 1000 bytes of a file."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    signal.signal(signal.SIGXFSZ, before)


@pytest.mark.usefixtures("full_disk")
def test_a_full_disk_leaves_the_older_file_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    write_output(file, "older")
    with pytest.raises(SpaceRobotError) as refused:
        write_output(file, "x" * 2000)
    assert_one_sentence(str(refused.value), str(file), "cannot be written: File too large")
    assert file.read_text() == "older"
    assert list(tmp_path.iterdir()) == [file]


def test_a_file_is_replaced_through_a_link_and_keeps_its_mode(tmp_path: Path) -> None:
    file, link = tmp_path / "a.html", tmp_path / "latest.html"
    write_output(file, "older")
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE(file.stat().st_mode) == 0o666 & ~mask
    file.chmod(0o600)
    link.symlink_to("a.html")
    write_output(link, "näwer")
    assert link.is_symlink()
    assert file.read_bytes() == "näwer".encode()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    write_output(tmp_path / "new" / "deep" / "b.html", b"\x00")
    assert (tmp_path / "new" / "deep" / "b.html").read_bytes() == b"\x00"


def test_what_is_no_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("older")
    for below in ("file/a.html", "file/deep/a.html"):
        with pytest.raises(SpaceRobotError, match="is no folder"):
            write_output(tmp_path / below, "newer")
    with pytest.raises(SpaceRobotError, match="Is a directory"):
        write_output(tmp_path, "newer")
    write_output(Path(os.devnull), "gone")
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)


@pytest.mark.parametrize("option", ["--json", "--picture"])
def test_a_result_that_cannot_be_written_is_one_sentence(option: str, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("older")
    target = str(tmp_path / "file" / "below.svg")
    words = ["analyze", "planar_chain", option, target]
    if option == "--json":
        words += ["--picture", str(tmp_path / "a.svg")]
    result = CliRunner().invoke(main, words)
    assert result.exit_code == 2
    assert_one_sentence(result.stderr, target, "cannot be written")
    assert result.stdout.startswith("planar_chain: 2 joint(s)")
    assert not list(tmp_path.glob("*.json"))


def test_json_is_written_whole(tmp_path: Path) -> None:
    file = tmp_path / "deep" / "found.json"
    words = ["analyze", "planar_chain", "--json", str(file), "--picture", str(tmp_path / "a.svg")]
    assert CliRunner().invoke(main, words).exit_code == 0
    assert json.loads(file.read_text())["robot"] == "planar_chain"
