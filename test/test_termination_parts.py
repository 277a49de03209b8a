"""Parts of the guard of a process, with stand-ins for its signals, pipes, clock and end."""

from __future__ import annotations

import io
import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest

from spacerobot_ros import termination
from spacerobot_ros.termination import Terminated, ended_on_request, guarded

LIFELINE = 1_000_001
"""A file that no process has."""
PARENT = os.getppid()


class EndedError(Exception):
    """Stands in for the end of the process."""


class Time:
    def __init__(self) -> None:
        self.now = 40.0

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def time(monkeypatch: pytest.MonkeyPatch) -> Time:
    time = Time()
    monkeypatch.setattr(termination, "time", time)
    return time


@pytest.fixture
def guard(monkeypatch: pytest.MonkeyPatch, time: Time) -> Iterator[Any]:
    """Return a guard that is not at work; ``raised`` keeps the signals that it sends itself."""
    guard: Any = object.__new__(termination._Guard)
    reader, writer = os.pipe()
    vars(guard).update(
        number=None, request=None, tools=set(), raised=[], killed=[], _announcing=False,
        _raised=False, _errors=None, _since=0.0, _notice_by=None, _end_by=None,
        _lifeline_read_end=LIFELINE, _parent=PARENT, _reader=reader, _writer=writer,
    )  # fmt: skip

    def end() -> None:
        raise EndedError

    guard._end_process = end
    guard._kill_tools = lambda: guard.killed.append(time.now)
    monkeypatch.setattr(signal, "raise_signal", guard.raised.append)
    yield guard
    os.close(reader)
    os.close(writer)


def watch(
    monkeypatch: pytest.MonkeyPatch, guard: Any, time: Time, events: list[tuple[float, Any]]
) -> tuple[list[float | None], bool]:
    """Run the thread of a guard on events: seconds that pass, and signals, the pipe, or a call.

    Returns the times (ms) for which it has waited, and whether it has ended the process.
    """
    waits: list[float | None] = []
    files: set[int] = set()

    def poll(wait: float | None) -> list[tuple[int, int]]:
        waits.append(None if wait is None else round(wait, 6))
        if not events:
            os.write(guard._writer, b"\0")
            return [(guard._reader, 1)]
        seconds, what = events.pop(0)
        time.now += seconds
        if what == "pipe":
            assert LIFELINE in files
            return [(LIFELINE, 16)]
        if callable(what):
            what()
        elif what:
            os.write(guard._writer, bytes(what))
            return [(guard._reader, 1)]
        return []

    fake = SimpleNamespace(
        poll=poll, register=lambda file, _: files.add(file), unregister=files.remove
    )
    monkeypatch.setattr(select, "poll", lambda: fake)
    try:
        guard._watch_for_end()
    except EndedError:
        return waits, True
    return waits, False


INT, TERM = int(signal.SIGINT), int(signal.SIGTERM)


@pytest.mark.parametrize(
    ("events", "waits", "ended"),
    [
        ([], [None], False),
        ([(9.0, [signal.SIGCHLD])], [None, None], False),
        # The main thread has 1.2 s to end.
        ([(1.0, [TERM]), (1.125, None)], [None, 1200, 75], False),
        ([(1.0, [TERM]), (1.25, None)], [None, 1200], True),
        # Signals within a second are one; then another ends it at once, also in one reading.
        ([(1.0, [INT, TERM]), (0.5, [INT])], [None, 1200, 700], False),
        ([(1.0, [INT]), (0.25, [TERM]), (0.875, [TERM])], [None, 1200, 950], True),
        # The end of the parent gives 1.7 s; the signal of the kernel says the same again.
        ([(1.0, "pipe"), (1.5, None)], [None, 1700, 200], False),
        ([(1.0, "pipe"), (1.75, None)], [None, 1700], True),
        ([(1.0, "pipe"), (0.5, [TERM]), (1.0, None)], [None, 1700, 1200, 200], False),
        ([(1.0, [signal.SIGUSR2])], [None, None], False),
    ],
)
def test_the_thread_ends_the_process_in_time(
    monkeypatch: pytest.MonkeyPatch,
    guard: Any,
    time: Time,
    events: list[tuple[float, Any]],
    waits: list[float | None],
    ended: bool,
) -> None:
    by_parent = any(what == "pipe" for _, what in events)
    signalled = any(what not in ("pipe", None) and {INT, TERM} & {*what} for _, what in events)
    assert watch(monkeypatch, guard, time, list(events)) == (waits, ended)
    assert guard.raised == [signal.SIGTERM] * by_parent
    assert len(guard.killed) == int(signalled), "tools are ended with the first signal"


def test_the_kernel_tells_that_the_parent_has_ended(
    monkeypatch: pytest.MonkeyPatch, guard: Any, time: Time
) -> None:
    monkeypatch.setattr(os, "getppid", lambda: PARENT + 1)
    again = [(0.5, [signal.SIGUSR2])] * 2
    assert watch(monkeypatch, guard, time, again) == ([None, 1700, 1200], False)
    assert guard.raised == [signal.SIGTERM]


@pytest.mark.parametrize("notices", [False, True])
def test_work_is_told_at_once_and_has_five_seconds_to_notice(
    monkeypatch: pytest.MonkeyPatch, guard: Any, time: Time, notices: bool
) -> None:
    told: list[float] = []
    guard.request = termination._Request(lambda: None, lambda: told.append(time.now))
    assert not guard.signal_received()
    look = guard.signal_received if notices else None
    events = [(1.0, [INT]), (0.25, None), (0.5, look), (4.0, None), (0.375, None)]
    first, waits = [None, 5000.0, 4750.0], [None] * 3 if notices else [4250.0, 250.0]
    assert watch(monkeypatch, guard, time, events) == ([*first, *waits], not notices)
    assert told == [41.0] == guard.killed
    assert guard.signal_received()


def test_a_signal_is_raised_once_or_handed_to_what_has_asked_for_it(guard: Any) -> None:
    called: list[str] = []
    guard.request = termination._Request(lambda: called.append("main"), lambda: None)
    guard._on_signal(INT, None)
    assert (guard.number, called) == (INT, ["main"])
    guard.request = None
    with pytest.raises(Terminated, match="Terminated") as caught:
        guard._on_signal(TERM, None)
    assert caught.value.exit_code == 143
    guard._on_signal(TERM, None)
    assert guard.number == INT, "the first one counts"
    assert guard._note_signal(TERM) is False
    guard.number = None
    assert guard._note_signal(TERM) is True


@pytest.mark.parametrize(
    ("number", "announcing", "line", "code"),
    [(INT, True, b"Interrupted.\n", 130), (None, True, b"Terminated.\n", 143),
     (int(signal.SIGHUP), False, b"", 129)],
)  # fmt: skip
def test_the_end_is_announced_where_it_is_to_be(
    monkeypatch: pytest.MonkeyPatch, number: int | None, announcing: bool, line: bytes, code: int
) -> None:
    written = bytearray()
    codes: list[int] = []
    killed: list[int] = []
    fake: Any = SimpleNamespace(
        number=number, _announcing=announcing, _kill_tools=lambda: killed.append(1)
    )

    def write(file: int, data: bytes) -> None:
        assert file == 2
        written.extend(data)

    monkeypatch.setattr(os, "write", write)
    monkeypatch.setattr(os, "_exit", codes.append)
    termination._Guard._end_process(fake)
    assert (bytes(written), codes, killed) == (line, [code], [1])


class Started:
    def __init__(self, pid: int) -> None:
        self.pid = pid


def test_tools_are_killed_with_their_sessions(monkeypatch: pytest.MonkeyPatch) -> None:
    killed: list[tuple[int, int]] = []

    def kill(group: int, number: int) -> None:
        killed.append((group, number))
        raise ProcessLookupError

    monkeypatch.setattr(os, "killpg", kill)
    fake: Any = SimpleNamespace(tools={Started(31), Started(32)})
    termination._Guard._kill_tools(fake)
    assert sorted(killed) == [(31, signal.SIGKILL), (32, signal.SIGKILL)]


@pytest.fixture
def free(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process that nothing guards yet."""
    monkeypatch.setattr(termination, "_guard", None)


@pytest.mark.usefixtures("free")
@pytest.mark.parametrize("ignored", [False, True])
def test_only_the_end_of_the_terminal_may_be_ignored(ignored: bool) -> None:
    numbers = (signal.SIGHUP, signal.SIGINT)
    before = [signal.getsignal(number) for number in numbers]
    try:
        for number in numbers:
            signal.signal(number, signal.SIG_IGN if ignored else signal.SIG_DFL)
        earlier = signal.getsignal(signal.SIGINT)
        with guarded():
            assert (signal.getsignal(signal.SIGHUP) is signal.SIG_IGN) is ignored
            assert callable(signal.getsignal(signal.SIGINT))
        assert [signal.getsignal(number) for number in numbers] == [earlier] * 2
    finally:
        for number, handler in zip(numbers, before, strict=True):
            signal.signal(number, handler)


@pytest.mark.usefixtures("free")
@pytest.mark.parametrize(("parent", "ended"), [(PARENT, 0), (PARENT + 1, 1), (None, 0)])
def test_a_parent_that_has_ended_before_the_guard_is_missed(
    monkeypatch: pytest.MonkeyPatch, parent: int | None, ended: int
) -> None:
    calls: list[str] = []
    monkeypatch.setattr(termination._Guard, "_on_parent_end", lambda self: calls.append("end"))
    monkeypatch.setattr(termination, "_die_with_parent", lambda: calls.append("die"))
    before = signal.getsignal(signal.SIGUSR2)
    reader, writer = os.pipe()
    os.set_inheritable(reader, True)
    if parent is not None:
        monkeypatch.setenv("SPACEROBOT_LIFELINE", f"{reader}:{parent}")
    try:
        with guarded():
            assert "SPACEROBOT_LIFELINE" not in os.environ, "its children have another parent"
            assert os.get_inheritable(reader) is (parent is None)
            if parent == PARENT:
                signal.raise_signal(signal.SIGUSR2)  # It ends nothing by itself.
        assert calls == ["die"] * (parent is not None) + ["end"] * ended
    finally:
        signal.signal(signal.SIGUSR2, before)
        os.close(reader)
        os.close(writer)


@pytest.mark.usefixtures("free")
@pytest.mark.parametrize("announcing", [False, True])
def test_warnings_on_the_way_out_are_hidden_where_the_end_is_announced(
    monkeypatch: pytest.MonkeyPatch, announcing: bool
) -> None:
    shown = io.StringIO()
    monkeypatch.setattr(sys, "stderr", shown)
    assert termination.termination() is None
    with guarded(announcing=announcing) as new:
        assert new
        assert termination.termination() is None
        with pytest.raises(Terminated) as caught:
            signal.raise_signal(signal.SIGINT)
        assert (sys.stderr is shown) is not announcing
        ending = termination.termination()
        assert ending is not None
        assert ending.number == caught.value.number == signal.SIGINT
        with pytest.raises(Terminated), ended_on_request():
            pytest.fail("a signal has come before")
        termination.announce(ending)
        assert sys.stderr is shown
    assert shown.getvalue() == "Interrupted.\n"
    assert termination.termination() is None


@pytest.mark.usefixtures("free")
def test_requests_are_nested_and_given_back() -> None:
    calls: list[str] = []
    with guarded(), ended_on_request(lambda: calls.append("outer")) as outer:
        with ended_on_request(lambda: calls.append("inner")) as inner:
            assert not inner()
        assert not outer()
        signal.raise_signal(signal.SIGTERM)
        assert outer()
        assert calls == ["outer"]


def test_another_thread_has_no_signals() -> None:
    answers: list[bool] = []

    def work() -> None:
        with guarded() as new, ended_on_request() as requested:
            answers.extend((new, requested()))

    with guarded():
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    assert answers == [False, False]


def test_a_child_knows_its_parent_and_the_pipe(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[list[str], dict[str, Any]]] = []

    def start(words: list[str], **options: Any) -> None:
        started.append((words, options))

    monkeypatch.setattr(subprocess, "Popen", start)
    monkeypatch.setattr(subprocess, "run", start)
    monkeypatch.setenv("SOME", "thing")
    termination.start_child(["-c", "pass"], {"A": "b"}, cwd="/")
    termination.run_child(["-m", "some"], timeout=3)
    (words, options), (run_words, run_options) = started
    (reader,) = options["pass_fds"]
    os.fstat(reader)
    life = f"{reader}:{os.getpid()}"
    assert options.pop("env") == {"A": "b", "SPACEROBOT_LIFELINE": life}
    assert options == {"start_new_session": True, "pass_fds": (reader,), "cwd": "/"}
    assert run_options.pop("env") == {**os.environ, "SPACEROBOT_LIFELINE": life}
    assert run_options == {
        "capture_output": True, "text": True, "check": False, "pass_fds": (reader,), "timeout": 3,
    }  # fmt: skip
    assert words == [sys.executable, "-c", "pass"]
    assert run_words == [sys.executable, "-m", "some"]


class Child:
    """A process that ends by the signal ``deadly``; ``done`` keeps what is done to it."""

    pid, returncode = 77, -5

    def __init__(self, deadly: int) -> None:
        self.deadly, self.ended, self.done = deadly, False, []  # type: ignore[var-annotated]
        self.stdin = SimpleNamespace(close=self._break)
        self.stdout = SimpleNamespace(close=lambda: self.done.append("out closed"))

    def _break(self) -> None:
        self.done.append("in closed")
        raise BrokenPipeError

    def send_signal(self, number: int) -> None:
        self.done.append(number)
        self.ended |= number == self.deadly

    def poll(self) -> int | None:
        return self.returncode if self.ended else None

    def wait(self, patience: float | None = None) -> int:
        self.done.append(f"wait {patience}")
        if patience is not None and not self.ended:
            raise subprocess.TimeoutExpired("words", patience)
        return self.returncode

    def kill(self) -> None:
        self.done.append("kill")


@pytest.mark.parametrize(
    ("deadly", "done"),
    [(2, [2, "wait 3.5"]), (15, [2, "wait 3.5", 15, "wait 1.25"]),
     (9, [2, "wait 3.5", 15, "wait 1.25", (77, 9)])],
)  # fmt: skip
def test_a_child_gets_one_signal_after_the_other_and_is_killed_at_last(
    monkeypatch: pytest.MonkeyPatch, deadly: int, done: list[Any]
) -> None:
    child: Any = Child(deadly)
    monkeypatch.setattr(os, "killpg", lambda *given: child.done.append(given))
    assert termination.end_child(child, {2: 3.5, 15: 1.25}) == -5
    assert child.done == [*done, "in closed", "out closed", "wait None"]
    child.stdin = child.stdout = None
    assert termination.end_child(child, {}) == -5


@pytest.mark.parametrize(("gone_after", "waited"), [(0.0, 0.0), (0.1, 0.1), (9.0, 0.3)])
def test_the_end_of_a_tools_children_is_awaited_for_a_moment(
    monkeypatch: pytest.MonkeyPatch, time: Time, gone_after: float, waited: float
) -> None:
    child: Any = Child(9)
    begin = time.now

    def kill(group: int, number: int) -> None:
        assert group == 77
        if number == 0 and time.now - begin >= gone_after:
            raise ProcessLookupError
        if number:
            child.done.append(number)

    monkeypatch.setattr(os, "killpg", kill)
    termination._kill_tool(child)
    assert child.done == [signal.SIGKILL, "kill", "wait None"]
    assert time.now - begin == pytest.approx(waited, abs=0.0051)


@pytest.mark.usefixtures("free")
@pytest.mark.parametrize(("signalled", "code", "raised"), [(True, -9, True), (True, 0, False),
                                                           (False, -9, False)])  # fmt: skip
def test_a_tool_that_was_ended_by_a_signal_raises_it(
    monkeypatch: pytest.MonkeyPatch, signalled: bool, code: int, raised: bool
) -> None:
    started: list[tuple[list[str], dict[str, Any]]] = []
    child: Any = Child(0)
    child.returncode, child.ended = code, True

    def start(words: list[str], **options: Any) -> Any:
        started.append((words, options))
        return child

    monkeypatch.setattr(subprocess, "Popen", start)
    ending: Terminated | None = None
    with guarded():
        try:
            with termination.tool(["sh", "-c", "true"], bufsize=7) as process:
                assert process is child
                assert termination._guard is not None
                assert termination._guard.tools == {child}
                termination._guard.number = INT if signalled else None
        except Terminated as error:
            ending = error
        assert termination._guard is not None
        assert termination._guard.tools == set()
    assert (ending is not None) is raised
    ((words, options),) = started
    (reader,) = options["pass_fds"]
    assert words[:4] == [sys.executable, "-I", "-S", "-c"]
    assert words[5:] == [str(reader), "sh", "-c", "true"]
    assert (options["stdin"], options["bufsize"]) == (subprocess.DEVNULL, 7)
    with pytest.raises(OSError, match="Bad file"):
        os.fstat(reader)
