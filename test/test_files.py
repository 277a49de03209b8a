"""Files are written as a whole, read within limits, and trusted where nobody else writes them."""

from __future__ import annotations

import logging
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
from spacerobot_ros.files import (
    Cache,
    UntrustedFileError,
    load_yaml,
    read_private,
    write_output,
    write_whole,
)


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
        with pytest.raises(SpaceRobotError, match="is not a folder"):
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
    assert result.stdout.startswith("planar_chain: 2 joints")
    assert not list(tmp_path.glob("*.json"))


def test_a_whole_file_is_of_this_user_alone(tmp_path: Path) -> None:
    path = tmp_path / ("n" * 150)
    write_whole(path, b"content")
    assert path.read_bytes() == b"content"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert os.listdir(tmp_path) == [path.name]
    with pytest.raises(OSError, match="No such file"):
        write_whole(tmp_path / "none" / "a", b"")


def test_a_bag_is_not_replaced(tmp_path: Path) -> None:
    bag = tmp_path / "c.mcap"
    bag.write_bytes(b"\x89MCAP and more")
    with pytest.raises(SpaceRobotError) as refused:
        write_output(bag, b"x")
    assert (
        str(refused.value)
        == f"The file {bag} is a bag, which is not overwritten: choose another file."
    )
    bag.write_bytes(b"\x89MCA")
    write_output(bag, b"x")


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("a" * 1_000_001, "it has more than 1000000 characters"),
        ("[" * 10_000, "it is nested too deeply"),
        ("&a [*a]", "it has more than 100000 values"),
        (f"[&a [{'1, ' * 1000}], {'*a, ' * 100}]", "it has more than 100000 values"),
        ("a: [", "while parsing a flow node"),
        ("b: {a: 1,\n  a: 1}", "the key 'a' appears twice, the second time in line 2"),
        ("? [1, 2]\n: 3", "while constructing a mapping"),
    ],
)
def test_yaml_of_unknown_origin_is_limited(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=r"\w") as refused:
        load_yaml(text)
    assert str(refused.value).startswith(reason)
    assert "\n" not in str(refused.value)


def test_yaml_up_to_its_limits_is_read() -> None:
    assert load_yaml("a" * 1_000_000) == "a" * 1_000_000
    assert len(load_yaml(f"[&a [{'1, ' * 1000}], {'*a, ' * 98}]")) == 99
    assert load_yaml("") is None
    assert load_yaml("[&a [1, 2], *a]") == [[1, 2], [1, 2]]
    assert load_yaml("{a: 1, 2: b}") == {"a": 1, 2: "b"}
    # A value beside a merge replaces what it merges: that is no key twice.
    assert load_yaml("[&a {b: 1, c: 2}, {<<: *a, b: 3}]")[1] == {"b": 3, "c": 2}


def test_a_private_file_is_of_this_user_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    for mode in (0o600, 0o644):
        path.chmod(mode)
        assert read_private(path) == b"12345"
    for mode in (0o620, 0o602):
        path.chmod(mode)
        with pytest.raises(UntrustedFileError) as refused:
            read_private(path)
        assert str(refused.value) == (
            f"others can write to '{path}' (mode {mode:o}); remove their permission with "
            f"chmod go-w '{path}'."
        )
    path.chmod(0o600)
    if (owner := path.stat().st_uid) == 0:
        os.chown(path, 4_000_001, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: owner + 1)
    with pytest.raises(UntrustedFileError, match=r"belongs to user \d+; use your own\.$"):
        read_private(path)


def test_a_cache_gives_what_was_stored_under_a_key(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    cache = Cache(tmp_path / "a" / "b")
    assert cache.load("x", "key") is None
    path = cache.store("x", "key", b"content")
    assert path == tmp_path / "a" / "b" / "x"
    assert stat.S_IMODE((tmp_path / "a" / "b").stat().st_mode) == 0o700
    assert cache.load("x", "key") == (path, b"content")
    assert path.read_bytes().splitlines()[-1].startswith(b"spacerobot_ros cache 2 key 7 ")
    with caplog.at_level(logging.WARNING):
        assert cache.load("x", "other") is None
    assert not path.exists()
    assert caplog.messages == [
        f"'{path}' is deleted and recomputed: it is damaged, or stored under another key."
    ]
    damaged = cache.store("y", "key", b"content")
    assert damaged is not None
    damaged.write_bytes(damaged.read_bytes().replace(b"content", b"contents"))
    assert cache.load("y", "key") is None
    empty = cache.store("z", "key", b"")
    assert empty is not None
    assert cache.load("z", "key") == (empty, b"")


@pytest.mark.parametrize(
    ("words", "kind"),
    [
        ("plan three_joint_arm --goal-rotvec 0 0 0.01 --set planner.srdf={}", "SRDF"),
        ("run planar_manipulator --goal-rotvec 0 0 0.1 --set plant.world={}", "URDF"),
        ("run servicer_thrusters --set plant.thrusters={}", "thruster file"),
    ],
)
def test_a_file_that_would_never_end_is_refused(tmp_path: Path, words: str, kind: str) -> None:
    """A pipe that nobody writes, and a device without an end."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, is_what in ((pipe, "a pipe"), (Path("/dev/zero"), "a device")):
        result = CliRunner().invoke(main, words.format(path).split())
        assert result.exit_code == 2
        assert f"{kind} {path} cannot be read: it is {is_what}." in result.stderr


def test_an_srdf_in_an_encoding_that_is_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "e.srdf").write_text('<?xml version="1.0" encoding="foo-9"?>\n<robot name="x"/>')
    words = f"plan three_joint_arm --goal-rotvec 0 0 1 --set planner.srdf={tmp_path}/e.srdf"
    result = CliRunner().invoke(main, words.split())
    assert result.exit_code == 2
    assert "e.srdf is not XML (unknown encoding: foo-9)." in result.stderr
