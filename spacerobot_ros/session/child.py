"""A node in a child process: the parent's side and the child's side.

``python -m spacerobot_ros.session.child MODULE ...`` starts a node that ends together with its
supervisor. Signal handlers are set first, because importing a node module takes a second.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import yaml

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.termination import Terminated, guarded, start_child
from spacerobot_ros.topics import GLOBAL_TOPICS

_RESTART_PERIOD = 60.0  # wall s, over which restarts are counted

_NO_ERROR_TEXT = (
    "it wrote no error. If another stack is running in this ROS domain, the nodes of that stack "
    "respond instead: set ROS_DOMAIN_ID to another number."
)

_LOG_PREFIX = re.compile(r"^\[(DEBUG|INFO|WARN|ERROR|FATAL)\] \[[\d.]+\] \[[^\]]*\]: ")
"""Level, time and name before a message in a node's log."""


_CRASH = re.compile(r"^Fatal Python error: .*$", re.MULTILINE)
_CRASHED_AT = re.compile(r"^Current thread .*\n  File (.*)$", re.MULTILINE)


def last_error(log: str) -> str:
    """Return the last error that a node logged, or the last line of a traceback; if there is
    neither, a sentence that says so."""
    found = ""
    for line in log.splitlines():
        prefix = _LOG_PREFIX.match(line)
        if prefix is not None:
            if prefix[1] in ("ERROR", "FATAL"):
                found = line[prefix.end() :]
        elif line.strip() and not line[0].isspace() and not line.startswith("Extension mod"):
            found = line.strip()
    return found or _NO_ERROR_TEXT


def end_message(name: str, code: int, log: str) -> str:
    """Return a sentence that explains why a node has ended: the signal and the crash, or the
    exit code and the error."""
    if code < 0:
        # For a signal, Python logs only a crash; other errors in the log are not the cause.
        how = f"Node '{name}' was ended by {signal.Signals(-code).name}"
        crash, at = _CRASH.search(log), _CRASHED_AT.search(log)
        if crash is None:
            return f"{how}."
        return f"{how}: {crash[0]} at {at[1]}." if at else f"{how}: {crash[0]}."
    return f"Node '{name}' has ended with exit code {code}: {last_error(log)}"


class NodeProcess:
    """A node in its own process, which ends together with this process.

    Parameters
    ----------
    name, module, namespace
        Name, module and namespace of the node.
    folder
        Folder for the node's parameters and its log.
    restarts
        Maximum number of restarts within a minute.
    """

    def __init__(
        self, name: str, module: str, folder: Path, namespace: str = "", restarts: int = 0
    ) -> None:
        self.name, self.restarts = name, restarts
        self._module, self._namespace = module, namespace
        self._parameter_file, self._log_file = folder / f"{name}.yaml", folder / f"{name}.txt"
        self._restarted: list[float] = []
        """Wall times of the restarts, s."""
        self.child: subprocess.Popen[bytes]
        """The process, once started."""

    def start(
        self,
        parameters: Mapping[str, Any],
        arguments: Sequence[str] = (),
        stdout: int | None = None,
    ) -> None:
        """Start the node with parameters and ROS arguments; standard output goes to the log unless
        ``stdout`` is given."""
        values = {k: list(v) if isinstance(v, tuple) else v for k, v in parameters.items()}
        own = f"{self._namespace}/{self.name}" if self._namespace else self.name
        self._parameter_file.write_text(yaml.safe_dump({own: {"ros__parameters": values}}), "utf-8")
        ros = ["--ros-args", "-r", f"__node:={self.name}"]
        if self._namespace:
            moved = [word for topic in GLOBAL_TOPICS for word in ("-r", f"{topic}:={topic[1:]}")]
            ros += ["-r", f"__ns:={self._namespace}", *moved]
        words = ["-m", __name__, self._module, *ros]
        words += ["--params-file", str(self._parameter_file), *arguments]
        with self._log_file.open("wb") as log:
            self.child = start_child(words, stdout=stdout or log, stderr=log)

    @property
    def exit_code(self) -> int | None:
        """Exit code; None if the node is running."""
        return self.child.poll()

    @property
    def log(self) -> str:
        """Standard error of the node, and standard output unless it is redirected."""
        return self._log_file.read_text("utf-8", errors="replace")

    @property
    def end_message(self) -> str:
        """A sentence that explains why the node has ended."""
        return end_message(self.name, self.exit_code or 0, self.log)

    def may_restart(self) -> bool:
        """Return whether the node has ended and may be restarted; if so, count the restart."""
        if self.exit_code is None:
            return False
        now = time.monotonic()
        self._restarted = [each for each in self._restarted if now - each < _RESTART_PERIOD]
        allowed = len(self._restarted) < self.restarts
        self._restarted += [now] * allowed
        return allowed

    @property
    def restart_note(self) -> str:
        """A sentence that states how often the node was restarted, with a leading space."""
        count = len(self._restarted)
        if not count:
            return ""
        times = "once" if count == 1 else f"{count} times"
        return f" It was restarted {times} within a minute, which is the limit (--restarts)."


def run_module(name: str) -> int | None:
    """Import a node module and run its ``main``; return the exit code.

    A signal ends the process without a traceback, even during the import.
    """
    with guarded():
        try:
            code: int | None = import_module(name).main()
            return code
        except Terminated:
            return 0
        except SpaceRobotError as error:  # Of a plugin, which is imported with the module.
            print(error, file=sys.stderr)
            return 2


if __name__ == "__main__":
    del sys.argv[0]
    sys.exit(run_module(sys.argv[0]))
