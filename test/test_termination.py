"""Signals and the end of a parent, on small processes of our own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from support.awaited import await_end

from spacerobot_ros.termination import Terminated, ended_on_request, guarded, tool

ROOT = Path(__file__).parents[1]
PATIENCE = 30.0
SOON = 2.0
"""Wall s within which everything ends."""

HEAD = """
import hashlib, os, signal, subprocess, sys, time
from spacerobot_ros.termination import *
# The tests may have been started by nohup.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
def ready():
    print("ready", flush=True)
"""
"""What the scripts below begin with."""

COMPUTE = "hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)"
"""Computes for minutes without running Python, as a solver does."""


@contextmanager
def script(text: str, **options: object) -> Iterator[subprocess.Popen[str]]:
    """Run a script up to its first line of output."""
    process = subprocess.Popen(
        [sys.executable, "-c", HEAD + text],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **options,  # type: ignore[call-overload]
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n", process.communicate()[1]
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        with suppress(subprocess.TimeoutExpired):  # What it has left behind may hold its output.
            process.communicate(timeout=SOON)


def ended(process: subprocess.Popen[str], within: float = PATIENCE) -> tuple[int, str]:
    """Return exit code and standard error."""
    _, errors = process.communicate(timeout=within)
    return process.returncode, errors


@pytest.mark.parametrize(
    ("number", "line"),
    [
        (signal.SIGINT, "Interrupted."),
        (signal.SIGTERM, "Terminated."),
        (signal.SIGHUP, "Hung up."),
    ],
)
def test_a_signal_raises_and_names_itself(number: signal.Signals, line: str) -> None:
    text = """
try:
    with guarded():
        ready()
        try:
            time.sleep(60)
        except Exception:
            pass
except Terminated as ending:
    sys.exit(f"{ending} {ending.exit_code}")
"""
    with script(text) as process:
        process.send_signal(number)
        assert ended(process) == (1, f"{line} {128 + number}\n")


def test_a_computation_that_runs_no_python_is_ended_with_one_line() -> None:
    text = f"""
with guarded(announcing=True):
    try:
        ready()
        {COMPUTE}
    except Terminated:  # The signal came before.
        {COMPUTE}
"""
    with script(text) as process:
        process.send_signal(signal.SIGINT)
        assert ended(process) == (130, "Interrupted.\n")


def test_an_exception_that_is_swallowed_ends_the_process_all_the_same() -> None:
    text = """
with guarded(announcing=True):
    while True:
        try:
            ready()
            time.sleep(60)
        except KeyboardInterrupt:
            pass
"""
    with script(text) as process:
        process.send_signal(signal.SIGTERM)
        assert ended(process) == (143, "Terminated.\n")


REQUESTED = """
with guarded(), ended_on_request(at_once=lambda: print("told", flush=True)) as requested:
    ready()
    while not requested():
        time.sleep(0.01)
    time.sleep({work})
sys.exit(5)
"""


def test_what_has_work_to_complete_completes_it() -> None:
    with script(REQUESTED.format(work=0.05)) as process:
        process.send_signal(signal.SIGHUP)
        # Launchers send one signal twice: beside the terminal.
        process.send_signal(signal.SIGINT)
        output, errors = process.communicate(timeout=PATIENCE)
        assert (process.returncode, output, errors) == (5, "told\n", "")


def test_a_second_signal_ends_it_at_once() -> None:
    with script(REQUESTED.format(work=600)) as process:
        process.send_signal(signal.SIGINT)
        # Those that come in the same moment as the first are still the first.
        for _ in range(50):
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.1)
                break
            process.send_signal(signal.SIGINT)
        assert process.returncode == 130


def test_a_request_that_nobody_notices_ends_the_process() -> None:
    text = """
from spacerobot_ros import termination
termination._LONGEST_NOTICE_TIME = 0.2
with guarded(), ended_on_request() as requested:
    ready()
    time.sleep(600)
"""
    with script(text) as process:
        process.send_signal(signal.SIGTERM)
        assert ended(process)[0] == 143


def test_the_end_of_the_terminal_is_ignored_under_nohup() -> None:
    text = """
with guarded():
    ready()
    signal.raise_signal(signal.SIGHUP)
sys.exit(7)
"""
    with script(f"signal.signal(signal.SIGHUP, signal.SIG_IGN)\n{text}") as process:
        assert ended(process)[0] == 7


CHILD = """
with guarded(), ended_on_request() as requested:
    print("ready", flush=True)
    while not requested():
        time.sleep(0.01)
"""
PARENT = """
subprocess.Popen([sys.executable, "-c", {child!r}], **{options})
{more}
time.sleep(600)
"""


@pytest.mark.parametrize(
    ("before", "more"),
    [
        # Without the signal of the kernel, which only Linux sends.
        ("from spacerobot_ros import termination; termination._die_with_parent = int", ""),
        # A fork of the parent has its end of the pipe, too.
        ("", "print(os.fork(), file=sys.stderr, flush=True)"),
    ],
)
def test_a_child_ends_with_its_parent(before: str, more: str) -> None:
    child = f"{HEAD}\n{before}\n{CHILD}"
    parent = PARENT.format(child=child, options="child_options()", more=more)
    with script(parent) as process:
        assert process.stderr is not None
        # The fork prints 0, and its parent the fork.
        fork = max(int(process.stderr.readline()) for _ in range(2)) if more else 0
        os.kill(process.pid, signal.SIGKILL)
        assert not await_end(lambda: set(processes_of(process.pid)) - {fork}, SOON)
        assert (fork in processes_of(process.pid)) == bool(more)


def processes_of(session: int) -> list[int]:
    """Return the processes of a session that have not ended."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
            if int(fields[3]) == session and fields[0] not in "ZX":
                found.append(int(folder.name))
    return found


def test_a_process_of_somebody_else_outlives_what_has_started_it() -> None:
    """``ros2 run`` and ``nohup``: the end of a launcher or of its pipes is no end."""
    parent = PARENT.format(
        child=HEAD + CHILD, options="dict(stdin=subprocess.PIPE)", more="os._exit(0)"
    )
    with script(parent) as process:
        process.wait(PATIENCE)
        (child,) = processes_of(process.pid)
        with pytest.raises(subprocess.TimeoutExpired):
            process.communicate(timeout=0.3)
        os.kill(child, signal.SIGTERM)


TOOL = ["sh", "-c", "echo ready; sleep 600 & sleep 600"]


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_tool_and_what_it_starts_end_with_the_process(number: signal.Signals) -> None:
    text = f"""
with guarded(), ended_on_request(), tool({TOOL!r}) as process:
    process.wait()
"""
    with script(text) as process:
        os.kill(process.pid, number)
        # Its output ends with the last process that has it.
        process.communicate(timeout=SOON)
        if number == signal.SIGTERM:
            assert process.returncode == 1, "the exception is not caught"


def test_a_tool_reports_how_it_ended(tmp_path: Path) -> None:
    codes = []
    for command in ("exit 3", "kill -SEGV $$", "true"):
        with tool(["sh", "-c", command]) as process:
            codes.append(process.wait(PATIENCE))
    assert codes == [3, -signal.SIGSEGV, 0]
    with pytest.raises(FileNotFoundError), tool([str(tmp_path / "nothing")]):
        pass
    with tool(["sleep", "600"]) as process:
        pass
    assert process.returncode == -signal.SIGKILL


def test_signals_are_given_back() -> None:
    before = signal.getsignal(signal.SIGTERM)
    with guarded() as new, guarded() as again, ended_on_request() as requested:
        assert new
        assert not again
        assert signal.getsignal(signal.SIGTERM) is not before
        assert not requested()
    assert signal.getsignal(signal.SIGTERM) is before
    assert Terminated(signal.SIGINT).exit_code == 130
