"""Signals and the end of a parent, on small processes of our own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from support.awaited import await_end

from spacerobot_ros.termination import (
    Terminated,
    announce,
    end_child,
    graceful_shutdown,
    guarded,
    start_child,
    termination,
    tool,
)

ROOT = Path(__file__).parents[1]
PATIENCE = 30.0
SOON = 2.0
"""Wall s within which everything ends."""

HEAD = """
import os, signal, subprocess, sys, time
from spacerobot_ros.termination import *
# The tests may have been started by nohup.
signal.signal(signal.SIGHUP, signal.SIG_DFL)
signal.alarm(20)
def ready():
    print("ready", flush=True)
"""
"""What the scripts below begin with."""


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
        process.wait()


def ended(process: subprocess.Popen[str], within: float = PATIENCE) -> tuple[int, str]:
    """Return exit code and standard error."""
    _, errors = process.communicate(timeout=within)
    return process.returncode, errors


def test_an_exception_that_is_swallowed_ends_the_process_all_the_same() -> None:
    text = """
with guarded():
    while True:
        try:
            ready()
            time.sleep(60)
        except KeyboardInterrupt:
            print("a warning of a library", file=sys.stderr)
"""
    with script(text) as process:
        process.send_signal(signal.SIGTERM)
        assert ended(process, SOON) == (143, "Terminated.\n")


def await_second_signal(process: subprocess.Popen[str], number: signal.Signals) -> None:
    """Send a signal until the process ends; within a second it still counts as the first."""
    for _ in range(50):
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.1)
            return
        process.send_signal(number)
    pytest.fail("the second signal was ignored")


REQUESTED = """
with guarded(), graceful_shutdown(lambda: print("told", flush=True)) as requested:
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
        await_second_signal(process, signal.SIGINT)
        assert process.returncode == 130


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
with guarded(), graceful_shutdown() as requested:
    ready()
    while not requested():
        time.sleep(0.01)
"""


@pytest.mark.parametrize("hangs", [False, True])
def test_a_child_ends_with_its_parent(hangs: bool) -> None:
    child = HEAD + CHILD + ("time.sleep(600)" if hangs else "")
    parent = f"""
print(start_child(["-c", {child!r}]).pid, file=sys.stderr, flush=True)
time.sleep(600)
"""
    with script(parent) as process:
        assert process.stderr is not None
        started = int(process.stderr.readline())
        process.kill()
        assert not await_end(lambda: [started] * is_alive(started), SOON)


def test_a_child_outlives_the_thread_that_started_it_and_is_killed_with_its_parent() -> None:
    """Between the start of the child and its guard, the parent may end, too."""
    child = f"{HEAD}\nsys.stdin.readline()\n{CHILD}"
    parent = f"""
import threading
pipe, writer = os.pipe()
def start():
    print(start_child(["-c", {child!r}], stdin=pipe).pid, file=sys.stderr, flush=True)
thread = threading.Thread(target=start)
thread.start()
thread.join()
os.write(writer, b"\\n")
time.sleep(600)
"""
    with script(parent) as process:
        assert process.stderr is not None
        started = int(process.stderr.readline())
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(0.3)
        assert is_alive(started)
        process.kill()
        assert not await_end(lambda: [started] * is_alive(started), SOON)


def is_alive(pid: int) -> bool:
    """Return whether there is such a process and it has not ended."""
    with suppress(OSError):
        text = Path(f"/proc/{pid}/stat").read_text()
        return text.rpartition(")")[2].split()[0] not in "ZX"
    return False


def test_a_process_of_somebody_else_outlives_what_has_started_it() -> None:
    """``ros2 run`` and ``nohup``: the end of a launcher or of its pipes is no end."""
    parent = f"""
child = subprocess.Popen([sys.executable, "-c", {HEAD + CHILD!r}], stdin=subprocess.PIPE)
print(child.pid, file=sys.stderr, flush=True)
os._exit(0)
"""
    with script(parent) as process:
        process.wait(PATIENCE)
        assert process.stderr is not None
        child = int(process.stderr.readline())
        with pytest.raises(subprocess.TimeoutExpired):
            process.communicate(timeout=0.3)
        os.kill(child, signal.SIGTERM)


@pytest.mark.parametrize(
    ("ignored", "code"), [((), -signal.SIGINT), ((2,), -signal.SIGTERM), ((2, 15), -signal.SIGKILL)]
)
def test_a_child_gets_one_signal_after_the_other(ignored: tuple[int, ...], code: int) -> None:
    text = f"""{HEAD}
signal.signal(signal.SIGINT, signal.SIG_DFL)
for number in {ignored}:
    signal.signal(number, signal.SIG_IGN)
ready()
time.sleep(600)
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    child = start_child(["-c", text], environment, stdout=subprocess.PIPE)
    assert child.stdout is not None
    assert child.stdout.readline() == b"ready\n"
    assert end_child(child, {signal.SIGINT: 0.3, signal.SIGTERM: 0.3}) == code


@pytest.mark.parametrize("first", ["", "kill -TERM $PPID; "])
def test_a_tool_and_what_it_starts_end_with_the_process(first: str) -> None:
    """Also if the signal comes while the tool starts."""
    command = f"echo ready; {first}sleep 600 & sleep 600"
    text = f"""
with guarded(), graceful_shutdown(), tool(["sh", "-c", {command!r}]) as process:
    process.wait()
"""
    with script(text) as process:
        if not first:
            os.kill(process.pid, signal.SIGTERM)
        # Its output ends with the last process that has it.
        process.communicate(timeout=SOON)
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
    with guarded() as new, guarded() as again, graceful_shutdown() as requested:
        assert new
        assert not again
        assert signal.getsignal(signal.SIGTERM) is not before
        assert not requested()
        assert termination() is None
    assert signal.getsignal(signal.SIGTERM) is before


def test_warnings_on_the_way_out_are_hidden_and_work_begins_no_more(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with guarded():
        with pytest.raises(Terminated) as caught:
            signal.raise_signal(signal.SIGINT)
        assert termination() is caught.value
        print("a warning of a library", file=sys.stderr)
        with pytest.raises(Terminated), graceful_shutdown():
            pytest.fail("a signal has come before")
        announce(caught.value)
    assert termination() is None
    assert capsys.readouterr().err == "Interrupted.\n"


def test_another_thread_has_no_signals() -> None:
    answers: list[bool] = []

    def work() -> None:
        with guarded() as new, graceful_shutdown() as requested:
            answers.extend((new, requested()))

    with guarded():
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert answers == [False, False]


# -- signals in this process -------------------------------------------------------------------

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@pytest.fixture
def noted() -> Iterator[list[int]]:
    """Note signals that nothing else handles: they would end the tests."""
    found: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: found.append(number)) for number in SIGNALS
    }
    yield found
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_flight_is_asked_to_end_by_each_signal(noted: list[int], number: signal.Signals) -> None:
    asked: list[str] = []
    try:
        with graceful_shutdown(lambda: asked.append("main")) as stopped:
            assert not stopped()
            os.kill(os.getpid(), number)
            assert stopped()
            assert asked == ["main"]
    except Terminated as end:
        # It is no Exception: pytest itself would end.
        pytest.fail(f"the flight was ended: {end}")
    assert noted == []
    # What was there before is there again.
    os.kill(os.getpid(), number)
    assert noted == [number]
    with graceful_shutdown() as stopped:
        assert not stopped(), "a signal of an earlier flight"


@pytest.mark.parametrize(
    ("number", "line"), [*zip(SIGNALS, ("Interrupted.", "Terminated.", "Hung up."), strict=True)]
)
def test_a_signal_raises_and_names_itself(
    noted: list[int], number: signal.Signals, line: str
) -> None:
    with pytest.raises(Terminated) as end, guarded(), suppress(Exception):
        os.kill(os.getpid(), number)
    assert (str(end.value), end.value.exit_code) == (line, 128 + number)
    assert noted == []


# -- programs of nodes -------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(path.name for path in (ROOT / "scripts").glob("*")))
def test_an_interrupt_while_a_node_imports_is_no_traceback(name: str) -> None:
    """The interpreter itself reports its imports, and so when the signal is to come."""
    with subprocess.Popen(
        [sys.executable, "-X", "importtime", str(ROOT / "scripts" / name)],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        assert process.stderr is not None
        for line in process.stderr:
            if "numpy" in line:
                process.send_signal(signal.SIGINT)
                break
        rest = process.stderr.read()
        assert process.wait(60.0) == 0
    assert "Traceback" not in rest
