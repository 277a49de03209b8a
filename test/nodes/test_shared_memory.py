"""Machines without shared memory, or with none left."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

import spacerobot_ros
from spacerobot_ros.nodes.common import process

KILOBYTE = 1024


@pytest.fixture(autouse=True)
def _no_choices(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in process._TRANSPORT_CHOICES:
        monkeypatch.setenv(name, "")


def with_free(monkeypatch: pytest.MonkeyPatch, free: int | None) -> None:
    """Let shared memory have so many bytes left; None: let there be none."""

    def statvfs(_: object) -> SimpleNamespace:
        if free is None:
            raise FileNotFoundError
        return SimpleNamespace(f_bavail=free // KILOBYTE, f_frsize=KILOBYTE, f_blocks=1)

    monkeypatch.setattr("os.statvfs", statvfs)


@pytest.mark.parametrize(
    ("free", "transport"),
    [(None, "UDPv4"), (0, "UDPv4"), (2**20, "UDPv4"), (2**21, ""), (2**30, "")],
)
def test_without_shared_memory_messages_go_through_sockets(
    free: int | None,
    transport: str,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with_free(monkeypatch, free)
    process.use_loopback_discovery()
    assert os.environ["FASTDDS_BUILTIN_TRANSPORTS"] == transport
    assert ("messages go through sockets" in caplog.text) == bool(transport)


def test_memory_that_cannot_be_written_is_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_free(monkeypatch, 2**30)
    monkeypatch.setattr("os.access", lambda *_: False)
    process.use_loopback_discovery()
    assert os.environ["FASTDDS_BUILTIN_TRANSPORTS"] == "UDPv4"


def test_a_choice_of_the_user_stays(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with_free(monkeypatch, 0)
    monkeypatch.setenv("FASTDDS_BUILTIN_TRANSPORTS", "LARGE_DATA")
    process.use_loopback_discovery()
    assert os.environ["FASTDDS_BUILTIN_TRANSPORTS"] == "LARGE_DATA"
    assert not caplog.text


@pytest.mark.parametrize(("free", "warned"), [(None, False), (0, True), (2**20, False)])
def test_full_memory_is_said_before_a_library_is_ended_by_it(
    free: int | None,
    warned: bool,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    with_free(monkeypatch, free)
    spacerobot_ros._warn_of_full_shared_memory()
    assert ("SIGBUS" in caplog.text) == warned


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    ["ro", "size=256k"],
)
def test_a_flight_without_shared_memory_reaches_its_goal(
    options: str, tmp_path: Path, own_domain: None
) -> None:
    """In a mount namespace of its own, which takes the rights of root."""
    unshare = shutil.which("unshare")
    if unshare is None or subprocess.run([unshare, "-m", "true"], check=False).returncode:
        pytest.skip("no mount namespaces here")
    command = " ".join(
        [
            f"mount -t tmpfs -o {options} none /dev/shm && exec {sys.executable} -m spacerobot_ros",
            "run sliding_masses --bag",
            str(tmp_path / "flight.mcap"),
            "--nodes",
        ]
    )
    ended = subprocess.run(
        [unshare, "-m", "sh", "-c", command],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert ended.returncode == 0, ended.stdout + ended.stderr
    assert "The goal is reached" in ended.stdout
