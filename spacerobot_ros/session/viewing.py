"""A viewer process beside a command, of lower priority, so that it takes no time from the plant."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

import yaml

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes.common.process import use_loopback_discovery
from spacerobot_ros.nodes.viewer import node
from spacerobot_ros.parameters import Value
from spacerobot_ros.session.stack import checked_namespace, namespace_words
from spacerobot_ros.termination import child_options
from spacerobot_ros.viewer.server import require_viser

_START = 30.0
"""Wall time within which the page must be served, s."""

_END = 1.5
"""Wall time after SIGINT at which the process is killed, s."""

_NICENESS = 5

_CHILD = "spacerobot_ros.session.child"


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
        file, log = Path(folder, "viewer.yaml"), Path(folder, "viewer.txt")
        own = f"{namespace}/viewer" if namespace else "viewer"
        file.write_text(yaml.safe_dump({own: {"ros__parameters": dict(parameters)}}), "utf-8")
        with log.open("wb") as errors:
            process = subprocess.Popen(
                [
                    *(sys.executable, "-m", _CHILD, node.__name__),
                    *("--ros-args", "-r", "__node:=viewer", "--log-level", "WARN"),
                    *namespace_words(namespace),
                    *("--params-file", str(file)),
                ],
                **child_options(),
                stdout=subprocess.PIPE,
                stderr=errors,
                start_new_session=True,
            )
        yield_to_flight(process.pid)
        try:
            show(_announcement(process, log))
            for line in _lines(log):
                show(line)  # A warning about an address that others can reach.
            yield
            if process.poll() is not None:
                show(f"The viewer ended early: {(_lines(log) or ['it was killed.'])[-1]}")
        finally:
            _end(process)


def yield_to_flight(pid: int) -> None:
    """Lower the priority of a process below everything that flies."""
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, pid, _NICENESS)
    # Linux may divide the processor among sessions first; niceness counts within a session only.
    with suppress(OSError):
        Path(f"/proc/{pid}/autogroup").write_text(str(_NICENESS), "ascii")


def _lines(log: Path) -> list[str]:
    """Return the lines that the viewer has written to standard error."""
    return log.read_text("utf-8", errors="replace").strip().splitlines()


def _announcement(process: subprocess.Popen[bytes], log: Path) -> str:
    """Return the line that the viewer prints once its page is served."""
    assert process.stdout is not None
    text, deadline = b"", time.monotonic() + _START
    while not text.endswith(b"\n"):
        ready, _, _ = select.select([process.stdout], [], [], 0.1)
        if ready:
            more = os.read(process.stdout.fileno(), 4096)
            if not more:
                lines = _lines(log)
                raise SpaceRobotError(lines[-1] if lines else "The viewer ended at its start.")
            text += more
        elif time.monotonic() > deadline:
            raise SpaceRobotError(f"The viewer has not served its page within {_START:g} s.")
    return text.decode(errors="replace").strip()


def _end(process: subprocess.Popen[bytes]) -> None:
    process.send_signal(signal.SIGINT)
    try:
        process.wait(_END)
    except subprocess.TimeoutExpired:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if process.stdout is not None:
        process.stdout.close()
