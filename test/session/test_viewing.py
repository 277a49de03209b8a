"""The viewer beside a command, by a stand-in for its process."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.session import viewing as module

viewing: Any = module


class Viewer:
    """A process that prints some texts, one each time that it is read."""

    def __init__(self, *texts: bytes) -> None:
        self.texts, self.pid, self.code = list(texts), 4711, None
        self.returncode = 1
        self.stdout = SimpleNamespace(fileno=lambda: 5)

    def poll(self) -> int | None:
        return self.code


@pytest.fixture
def process(monkeypatch: pytest.MonkeyPatch) -> Viewer:
    """Return a viewer whose texts are read from a pipe, a minute apart where there is none."""
    viewer, now = Viewer(), [100.0]

    def select(files: list[Any], *_: Any) -> Any:
        assert files == [viewer.stdout]
        assert _ == ([], [], 0.1)
        if viewer.texts:
            return files, [], []
        now[0] += 10.0
        return [], [], []

    monkeypatch.setattr(viewing, "select", SimpleNamespace(select=select))
    monkeypatch.setattr(viewing, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(viewing.os, "read", lambda file, count: viewer.texts.pop(0))
    return viewer


def test_the_line_of_a_viewer_is_read_to_its_end(process: Viewer, tmp_path: Path) -> None:
    process.texts = [b"http://", b"127.0.0.1:80", b"80 \xff\n"]
    found = viewing._read_announcement(process, tmp_path / "log")
    assert found == "http://127.0.0.1:8080 \ufffd"


@pytest.mark.parametrize(
    ("log", "sentence"),
    [(b"a\nNo port is free.\n", "No port is free."), (b" \n", "The viewer ended at its start.")],
)
def test_a_viewer_that_ends_at_its_start_says_why(
    log: bytes, sentence: str, process: Viewer, tmp_path: Path
) -> None:
    (tmp_path / "log").write_bytes(log)
    process.texts = [b"http", b""]
    with pytest.raises(SpaceRobotError) as ended:
        viewing._read_announcement(process, tmp_path / "log")
    assert str(ended.value) == sentence


def test_a_viewer_that_serves_nothing_is_given_up(process: Viewer, tmp_path: Path) -> None:
    with pytest.raises(SpaceRobotError) as late:
        viewing._read_announcement(process, tmp_path / "log")
    assert str(late.value) == "The viewer has not served its page within 30 s."


@pytest.mark.parametrize("code", [None, 1])
def test_a_viewer_runs_while_the_block_lasts(
    code: int | None, process: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []
    logs: list[Path] = []

    def words(name: str, of: str, parameters: Any, folder: Path, namespace: str) -> list[str]:
        asked.append((name, of, parameters, namespace))
        logs.append(folder / "viewer.txt")
        return ["-m", of]

    def start(given: list[str], **options: Any) -> Viewer:
        asked.append((given, options["stdout"]))
        return process

    process.texts = [b"http://here\n"]
    monkeypatch.setattr(viewing, "require_viser", lambda: asked.append("viser"))
    monkeypatch.setattr(viewing, "use_loopback_discovery", lambda: asked.append("loopback"))
    monkeypatch.setattr(viewing, "checked_namespace", lambda name: f"/{name}")
    monkeypatch.setattr(viewing, "node_arguments", words)
    monkeypatch.setattr(viewing, "start_child", start)
    monkeypatch.setattr(viewing, "lower_priority", lambda pid: asked.append(pid))
    monkeypatch.setattr(viewing, "end_child", lambda *given: asked.append(given))
    said: list[str] = []
    with viewing.viewing({"port": 1}, said.append, "left"):
        assert said == ["http://here"]
        logs[0].write_text("first\nIt broke.\n")
        process.code = code  # type: ignore[assignment]
    of = "spacerobot_ros.nodes.viewer.node"
    assert asked == [
        "viser",
        "loopback",
        ("viewer", of, {"port": 1}, "/left"),
        (["-m", of, "--log-level", "WARN"], -1),
        4711,
        (process, {signal.SIGINT: 1.5}),
    ]
    assert said[1:] == (["Node 'viewer' has ended with exit code 1: It broke."] if code else [])
    assert not logs[0].exists()


def test_a_viewer_that_dies_is_started_again_at_its_address(
    process: Viewer, monkeypatch: pytest.MonkeyPatch
) -> None:
    ports: list[int] = []
    ended: list[Any] = []

    def words(name: str, of: str, given: Any, folder: Path, namespace: str) -> list[str]:
        ports.append(given["port"])
        return []

    process.texts = [b"viewer      http://127.0.0.1:8091/\n"]
    monkeypatch.setattr(viewing, "node_arguments", words)
    monkeypatch.setattr(viewing, "start_child", lambda *_, **options: process)
    monkeypatch.setattr(viewing, "lower_priority", lambda pid: None)
    monkeypatch.setattr(viewing, "end_child", lambda *given: ended.append(given))
    said: list[str] = []
    with viewing.viewing({"port": 8080}, said.append) as viewer:
        viewer.restart_within(2)
        for _ in range(2):
            viewer.supervise()
        process.code = process.returncode = -9  # type: ignore[assignment]
        for count in (2, 3, 3):
            viewer.supervise()
            assert len(ports) == count
    assert ports == [8080, 8091, 8091]
    killed = "Node 'viewer' was ended by SIGKILL."
    again = f"{killed} It is started again."
    limit = " It was started again 2 times within a minute, which is the limit (--restarts)."
    assert said[1:] == [again, again, f"{killed}{limit}"]


def test_a_viewer_yields_to_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(os, "setpriority", lambda *given: asked.append(given))

    def file(name: str) -> Any:
        return SimpleNamespace(write_text=lambda *text: asked.append((name, *text)))

    monkeypatch.setattr(viewing, "Path", file)
    viewing.lower_priority(7)
    assert asked == [(os.PRIO_PROCESS, 7, 5), ("/proc/7/autogroup", "5", "ascii")]
