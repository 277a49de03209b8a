"""A command with a page in a process of its own, with goals for it and signals to its nodes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

from support.viewer_page import ROOT

COMMAND = (sys.executable, "-m", "spacerobot_ros.cli.main")
PATIENCE = 60.0


class Viewed:
    """`spacerobot up` or `replay` with `--view`, and the lines that it prints."""

    def __init__(self, folder: Path, domain: int, *words: str) -> None:
        self._domain = domain
        self.environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), "PYTHONPATH": str(ROOT)}
        port = ("--set", "viewer.port=0") if words[0] == "up" else ()
        self.process = subprocess.Popen(
            [*COMMAND, *words, "--view", *port],
            env=self.environment,
            cwd=folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._goals: list[subprocess.Popen[bytes]] = []
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        try:
            self.url = self.wait_for("viewer  ").split()[1]
        except BaseException:
            self.close()
            raise

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.lines.extend(line.rstrip() for line in iter(self.process.stdout.readline, ""))

    def wait_for(self, words: str, count: int = 1) -> str:
        """Return the last of so many lines with some words."""
        end = time.monotonic() + PATIENCE
        while len(found := [line for line in self.lines if words in line]) < count:
            assert time.monotonic() < end, (words, self.lines)
            self._reader.join(0.05)
        return found[-1]

    def goal(self, *words: str) -> None:
        """Send a goal without waiting for its result."""
        command = [*COMMAND, "goal", *words]
        nothing = subprocess.DEVNULL
        self._goals.append(
            subprocess.Popen(command, env=self.environment, stdout=nothing, stderr=nothing)
        )

    def kill(self, name: str, signal_number: int = signal.SIGKILL) -> None:
        """Send a signal to the latest process of a node."""
        lines = self.left().items()
        os.kill(max(number for number, line in lines if f"__node:={name}" in line), signal_number)

    def kill_until(self, name: str, words: str) -> None:
        """Kill a node whenever it has begun again, until there is a line with some words.

        A slow machine starts fewer nodes within a minute.
        """
        end = time.monotonic() + PATIENCE
        while not any(words in line for line in self.lines):
            assert time.monotonic() < end, (words, self.lines)
            with suppress(ValueError, ProcessLookupError):  # Between two lives it has no process.
                self.kill(name)
            self._reader.join(0.5)

    def left(self) -> dict[int, str]:
        """Return the command lines of what runs in the ROS domain, by process."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
                ours = f"ROS_DOMAIN_ID={self._domain}\0" in (folder / "environ").read_text()
                if ours and state != "Z" and int(folder.name) != os.getpid():
                    found[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
        return found

    def wait_until_nothing_is_left(self) -> float:
        """Return how long it takes until no process is left in the domain, s."""
        began = time.monotonic()
        self.process.wait(20)
        while left := self.left():
            assert time.monotonic() - began < 20.0, left
        return time.monotonic() - began

    def end(self) -> float:
        """Send Ctrl-C, and return how long it takes until no process is left, s."""
        self.process.send_signal(signal.SIGINT)
        return self.wait_until_nothing_is_left()

    def close(self) -> None:
        for goal in self._goals:
            goal.kill()
            goal.wait()
        self.process.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(20)
        self.process.kill()
        self.process.wait()
        self._reader.join()
        assert self.process.stdout is not None
        self.process.stdout.close()
