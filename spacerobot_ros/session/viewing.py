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
from spacerobot_ros.session.child import NodeProcess
from spacerobot_ros.session.processes import checked_namespace
from spacerobot_ros.termination import end_child
from spacerobot_ros.viewer.server import require_viser

_LONGEST_START = 30.0  # wall s

_LONGEST_END = 1.5
"""Wall time, s, after SIGINT at which the process is killed."""

_NICENESS = 5


class Viewer(NodeProcess):
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
        super().__init__("viewer", node.__name__, folder, namespace)
        self._parameters, self._show = dict(parameters), show
        self._announced = False
        self._serve()

    def _serve(self) -> None:
        self.start(self._parameters, ["--log-level", "WARN"], stdout=subprocess.PIPE)
        lower_priority(self.child.pid)

    def announce(self) -> None:
        """Show the page address once the page is served.

        Raises
        ------
        SpaceRobotError
            The page cannot be served.
        """
        output = self.child.stdout
        assert output is not None
        text, deadline = b"", time.monotonic() + _LONGEST_START
        while not text.endswith(b"\n"):
            ready, _, _ = select.select([output], [], [], 0.1)
            if ready:
                more = os.read(output.fileno(), 4096)
                if not more:
                    lines = self.log.strip().splitlines()
                    raise SpaceRobotError(lines[-1] if lines else "The viewer ended at startup.")
                text += more
            elif time.monotonic() > deadline:
                raise SpaceRobotError(
                    f"The viewer did not serve its page within {_LONGEST_START:g} s."
                )
        announcement, self._announced = text.decode(errors="replace").strip(), True
        for line in (announcement, *self.log.strip().splitlines()):
            self._show(line)  # The viewer warns of an address that other machines can reach.
        # Open pages reconnect to a viewer at the same address.
        port = urlsplit(announcement.split()[1]).port if " " in announcement else None
        if port is not None:
            self._parameters["port"] = port

    def supervise(self) -> None:
        """Restart the viewer if it has died and the limit allows it."""
        if not self.may_restart():
            return
        message = self.end_message
        end_child(self.child, {})
        self._serve()
        with suppress(OSError):  # A closed terminal must not stop the robot.
            self._show(f"{message} It is restarted.")

    def close(self) -> None:
        """End the viewer; a line reports if the viewer had already ended."""
        if self._announced and self.exit_code is not None:
            with suppress(OSError):
                self._show(f"{self.end_message}{self.restart_note}")
        end_child(self.child, {signal.SIGINT: _LONGEST_END})


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
            viewer.close()


def lower_priority(pid: int) -> None:
    """Lower a process's priority below the priority of all flight nodes."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _NICENESS)
    # Linux may divide the processor among sessions first; niceness counts within a session only.
    with suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(_NICENESS), "ascii")
