"""A viewer process that accompanies a command, at lower priority so that the plant is not
delayed.
"""

from __future__ import annotations

import os
import select
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.process import use_loopback_discovery
from spacerobot_ros.nodes.viewer import node
from spacerobot_ros.parameters import Value
from spacerobot_ros.session.processes import (
    RestartLimit,
    checked_namespace,
    end_message,
    node_arguments,
)
from spacerobot_ros.termination import end_child, start_child
from spacerobot_ros.viewer.server import require_viser

_LONGEST_START = 30.0  # wall s

_LONGEST_END = 1.5
"""Wall time, s, after SIGINT at which the process is killed."""

_NICENESS = 5


class Viewer:
    """A viewer process, restarted if it dies.

    Parameters
    ----------
    parameters, show, namespace
        As for :func:`viewing`.
    folder
        Folder for the log and the parameters of the viewer.
    """

    def __init__(
        self,
        parameters: Mapping[str, Value],
        show: Callable[[str], None],
        namespace: str,
        folder: Path,
    ) -> None:
        self._parameters, self._show = dict(parameters), show
        self._namespace, self._folder = namespace, folder
        self.log = folder / "viewer.txt"
        self.process = self._start()
        self._restarts = RestartLimit(0)
        self._announced = False

    def _start(self) -> subprocess.Popen[bytes]:
        with self.log.open("wb") as errors:
            words = node_arguments(
                "viewer", node.__name__, self._parameters, self._folder, self._namespace
            )
            process = start_child(
                [*words, "--log-level", "WARN"], stdout=subprocess.PIPE, stderr=errors
            )
        lower_priority(process.pid)
        return process

    def announce(self) -> None:
        """Show the page address once the page is served.

        Raises
        ------
        SpaceRobotError
            The page cannot be served.
        """
        announcement = _read_announcement(self.process, self.log)
        self._announced = True
        self._show(announcement)
        for line in _read_log_lines(self.log):
            self._show(line)  # The viewer warns of an address that other machines can reach.
        # Open pages reconnect to a viewer at the same address.
        port = urlsplit(announcement.split()[1]).port if " " in announcement else None
        if port is not None:
            self._parameters["port"] = port

    def restart_within(self, restarts: int) -> None:
        """Set the maximum number of restarts per minute."""
        self._restarts = RestartLimit(restarts)

    def supervise(self) -> None:
        """Restart the viewer if it has died and the limit allows it."""
        if self.process.poll() is None or not self._restarts.allows_restart(
            "viewer", time.monotonic()
        ):
            return
        message = self._end_message()
        end_child(self.process, {})
        self.process = self._start()
        with suppress(OSError):  # A closed terminal must not stop the robot.
            self._show(f"{message} It is restarted.")

    def end(self) -> None:
        """End the viewer; a line reports if the viewer had already ended."""
        if self._announced and self.process.poll() is not None:
            with suppress(OSError):
                self._show(f"{self._end_message()}{self._restarts.count_restart('viewer')}")
        end_child(self.process, {signal.SIGINT: _LONGEST_END})

    def _end_message(self) -> str:
        text = self.log.read_text("utf-8", errors="replace")
        return end_message("viewer", self.process.returncode, text)


@contextmanager
def viewing(
    parameters: Mapping[str, Value], show: Callable[[str], None], namespace: str = ""
) -> Iterator[Viewer]:
    """Run a viewer during the block; ``show`` receives the line with the viewer address.

    If the viewer ends early, the block continues, and a line at its end reports this.

    Parameters
    ----------
    parameters
        Viewer parameters, by name.
    show
        Function that shows a line to the user.
    namespace
        Namespace of the stack.

    Raises
    ------
    SpaceRobotError
        viser is not installed, or the page cannot be served.
    """
    require_viser()
    use_loopback_discovery()
    namespace = checked_namespace(namespace)
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        viewer = Viewer(parameters, show, namespace, Path(folder))
        try:
            viewer.announce()
            yield viewer
        finally:
            viewer.end()


def lower_priority(pid: int) -> None:
    """Lower a process's priority below the priority of all flight nodes."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _NICENESS)
    # Linux may divide the processor among sessions first; niceness counts within a session only.
    with suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(_NICENESS), "ascii")


def _read_log_lines(log: Path) -> list[str]:
    return log.read_text("utf-8", errors="replace").strip().splitlines()


def _read_announcement(process: subprocess.Popen[bytes], log: Path) -> str:
    assert process.stdout is not None
    text, deadline = b"", time.monotonic() + _LONGEST_START
    while not text.endswith(b"\n"):
        ready, _, _ = select.select([process.stdout], [], [], 0.1)
        if ready:
            more = os.read(process.stdout.fileno(), 4096)
            if not more:
                lines = _read_log_lines(log)
                raise SpaceRobotError(lines[-1] if lines else "The viewer ended at startup.")
            text += more
        elif time.monotonic() > deadline:
            raise SpaceRobotError(f"The viewer did not serve its page within {_LONGEST_START:g} s.")
    return text.decode(errors="replace").strip()
