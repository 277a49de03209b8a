"""A viewer process beside a command, at lower priority so that it does not delay the plant."""

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

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.process import use_loopback_discovery
from spacerobot_ros.nodes.viewer import node
from spacerobot_ros.parameters import Value
from spacerobot_ros.session.processes import node_words
from spacerobot_ros.session.stack import checked_namespace
from spacerobot_ros.termination import end_child, start_child
from spacerobot_ros.viewer.server import require_viser

_LONGEST_START = 30.0
"""Wall time within which the page must be served, s."""

_LONGEST_END = 1.5
"""Wall time after SIGINT at which the process is killed, s."""

_NICENESS = 5


@contextmanager
def viewing(
    parameters: Mapping[str, Value], show: Callable[[str], None], namespace: str = ""
) -> Iterator[None]:
    """Run a viewer while the block lasts; ``show`` receives the line with its address.

    If the viewer ends early, the block goes on and a line at its end reports it.

    Parameters
    ----------
    parameters
        Parameters of the viewer, by name.
    show
        Shows a line to the user.
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
        log = Path(folder, "viewer.txt")
        with log.open("wb") as errors:
            words = node_words("viewer", node.__name__, parameters, Path(folder), namespace)
            process = start_child(
                [*words, "--log-level", "WARN"], stdout=subprocess.PIPE, stderr=errors
            )
        yield_to_flight(process.pid)
        try:
            show(_read_announcement(process, log))
            for line in _read_log_lines(log):
                show(line)  # The viewer warns of an address that other machines can reach.
            yield
            if process.poll() is not None:
                show(f"The viewer ended early: {(_read_log_lines(log) or ['it was killed.'])[-1]}")
        finally:
            end_child(process, {signal.SIGINT: _LONGEST_END})


def yield_to_flight(pid: int) -> None:
    """Lower the priority of a process below the priority of all flight nodes."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _NICENESS)
    # Linux may divide the processor among sessions first; niceness counts within a session only.
    with suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(_NICENESS), "ascii")


def _read_log_lines(log: Path) -> list[str]:
    """Return the lines that the viewer has written to standard error."""
    return log.read_text("utf-8", errors="replace").strip().splitlines()


def _read_announcement(process: subprocess.Popen[bytes], log: Path) -> str:
    """Return the line that the viewer prints once its page is served."""
    assert process.stdout is not None
    text, deadline = b"", time.monotonic() + _LONGEST_START
    while not text.endswith(b"\n"):
        ready, _, _ = select.select([process.stdout], [], [], 0.1)
        if ready:
            more = os.read(process.stdout.fileno(), 4096)
            if not more:
                lines = _read_log_lines(log)
                raise SpaceRobotError(lines[-1] if lines else "The viewer ended at its start.")
            text += more
        elif time.monotonic() > deadline:
            raise SpaceRobotError(
                f"The viewer has not served its page within {_LONGEST_START:g} s."
            )
    return text.decode(errors="replace").strip()
