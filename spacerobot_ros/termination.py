"""Signals that end a process, and child processes that end with it.

A process is guarded from its first import on (:func:`guarded`). SIGINT, SIGTERM and SIGHUP then
raise :class:`Terminated` in the main thread; work that must be completed, such as a flight or a
bag, receives a request instead (:func:`ended_on_request`). A thread ends the process when the main
thread does not react, and at once on a second signal.

Processes that are started with :func:`child_options` end when this one does, however that ends:
the kernel closes a pipe that they read, and on Linux sends them a signal as well.
"""

from __future__ import annotations

import io
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from functools import cache
from types import FrameType
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

if TYPE_CHECKING:
    import subprocess

_MESSAGE_BY_SIGNAL = {
    signal.SIGINT: "Interrupted.",
    signal.SIGTERM: "Terminated.",
    signal.SIGHUP: "Hung up.",
}

_LONGEST_UNWINDING_TIME = 1.2
"""Wall time within which the main thread must end after a signal's exception, s."""

_LONGEST_NOTICE_TIME = 5.0
"""Wall time in which work must notice a request, s: a plan may have to end first."""

_TIME_AFTER_PARENT_END = 1.7
"""Wall time within which a process must end after its parent has ended, s."""

_SAME_SIGNAL_TIME = 1.0
"""Wall time between signals that count as one, s: launcher and terminal both send a signal."""

_KILL_WAIT = 0.3
"""Longest wait for the end of killed processes, wall s."""

_LIFELINE_VARIABLE = "SPACEROBOT_LIFELINE"
"""Environment variable of a child: process id of its parent, and a pipe held open by the parent."""

_PARENT_ENDED_SIGNAL = signal.SIGUSR2
"""Signal of the kernel to a child whose parent has ended (Linux)."""

_PR_SET_PDEATHSIG = 1

_END_BYTE = b"\0"


class Terminated(KeyboardInterrupt):
    """A signal that ends the process. As an interrupt it passes ``except Exception``.

    Parameters
    ----------
    number
        The signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(_MESSAGE_BY_SIGNAL.get(signal.Signals(number), "Terminated."))
        self.number = number

    @property
    def exit_code(self) -> int:
        """Exit code by which shells report such a signal."""
        return 128 + self.number


class _Request(NamedTuple):
    """Functions called on a signal: one in the main thread, one at once in the guard's thread."""

    main: Callable[[], None]
    at_once: Callable[[], None]


class _Guard:
    """The signal handlers of this process and the thread that watches over its end."""

    def __init__(self, *, announcing: bool) -> None:
        self.number: int | None = None
        """Number of the signal that ends the process; None before a signal."""
        self.request: _Request | None = None
        self.tools: set[subprocess.Popen[bytes]] = set()
        self._announcing = announcing
        self._raised = False
        self._errors: TextIO | None = None
        self._since = 0.0
        self._notice_by: float | None = None
        self._end_by: float | None = None
        self._lifeline_read_end, self._parent = _parent_lifeline()
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._handlers = {
            number: signal.signal(number, self._on_signal)
            for number in _MESSAGE_BY_SIGNAL
            # nohup has a process ignore the end of its terminal.
            if number != signal.SIGHUP or signal.getsignal(number) is not signal.SIG_IGN
        }
        if self._lifeline_read_end is not None:
            signal.signal(_PARENT_ENDED_SIGNAL, lambda *_: None)
            _die_with_parent()
        self._wakeup = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._watch_for_end, name="termination", daemon=True)
        self._thread.start()
        if self._lifeline_read_end is not None and os.getppid() != self._parent:
            self._on_parent_end()

    def remove(self) -> None:
        """Restore the earlier signal handlers."""
        self.restore_stderr()
        signal.set_wakeup_fd(self._wakeup)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        os.write(self._writer, _END_BYTE)
        self._thread.join()
        os.close(self._reader)
        os.close(self._writer)

    def signal_received(self) -> bool:
        """Return whether a signal has come; the caller then completes its work."""
        if self.number is not None:
            self._notice_by = None
        return self.number is not None

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        """Handle a signal in the main thread, as soon as it executes Python code."""
        self._note_signal(number)
        if self.request is not None:
            self.request.main()
        elif not self._raised:
            self._raised = True
            if self._announcing:
                # Libraries such as a solver print warnings when the exception passes through them.
                self._errors, sys.stderr = sys.stderr, io.StringIO()
            raise Terminated(number)

    def restore_stderr(self) -> None:
        """Restore standard error."""
        if self._errors is not None:
            self._errors, sys.stderr = None, self._errors

    def _note_signal(self, number: int) -> bool:
        """Take note of a signal; return whether it is the first."""
        if self.number is not None:
            return False
        self._since = time.monotonic()
        self.number = number
        grace = _LONGEST_UNWINDING_TIME if self.request is None else _LONGEST_NOTICE_TIME
        self._notice_by = self._since + grace
        return True

    def _watch_for_end(self) -> None:
        poll = select.poll()
        poll.register(self._reader, select.POLLIN)
        if self._lifeline_read_end is not None:
            poll.register(self._lifeline_read_end, select.POLLIN | select.POLLHUP)
        handled = False
        while True:
            deadline = self._deadline()
            wait = None if deadline is None else max(0.0, 1e3 * (deadline - time.monotonic()))
            for file, _ in poll.poll(wait):
                if file == self._lifeline_read_end:
                    poll.unregister(file)
                    self._on_parent_end()
                    continue
                for number in os.read(self._reader, 64):
                    if number == _END_BYTE[0]:
                        return
                    if number == _PARENT_ENDED_SIGNAL and os.getppid() != self._parent:
                        self._on_parent_end()
                    elif number in _MESSAGE_BY_SIGNAL:
                        self._note_signal(number)
                        if handled and time.monotonic() - self._since > _SAME_SIGNAL_TIME:
                            self._end_process()
            if self.number is not None and not handled:
                handled = True
                self._kill_tools()
                if self.request is not None:
                    self.request.at_once()
            deadline = self._deadline()
            if deadline is not None and time.monotonic() >= deadline:
                self._end_process()

    def _deadline(self) -> float | None:
        """Return the time (monotonic, s) at which this process is ended, None without one."""
        deadlines = [by for by in (self._notice_by, self._end_by) if by is not None]
        return min(deadlines, default=None)

    def _on_parent_end(self) -> None:
        """End this process soon, as by SIGTERM."""
        if self._end_by is None:
            self._end_by = time.monotonic() + _TIME_AFTER_PARENT_END
            signal.raise_signal(signal.SIGTERM)

    def _kill_tools(self) -> None:
        for tool in tuple(self.tools):
            with suppress(OSError):
                os.killpg(tool.pid, signal.SIGKILL)

    def _end_process(self) -> None:
        """End the process now, whatever the main thread does."""
        self._kill_tools()
        error = Terminated(self.number or signal.SIGTERM)
        if self._announcing:
            with suppress(OSError):
                os.write(2, f"{error}\n".encode())
        os._exit(error.exit_code)


_guard: _Guard | None = None


@contextmanager
def guarded(*, announcing: bool = False) -> Iterator[bool]:
    """Have signals, and the end of the parent, end the process in this context.

    Yields whether the guard is new: inside another one nothing changes. Outside the main thread,
    which alone has signals, nothing is done.

    Parameters
    ----------
    announcing
        Whether one line on standard error says so when the main thread cannot.

    Raises
    ------
    Terminated
        By a signal.
    """
    global _guard
    if _guard is not None or threading.current_thread() is not threading.main_thread():
        yield False
        return
    _guard = _Guard(announcing=announcing)
    try:
        yield True
    finally:
        _guard.remove()
        _guard = None


@contextmanager
def ended_on_request(
    main: Callable[[], None] = lambda: None, at_once: Callable[[], None] = lambda: None
) -> Iterator[Callable[[], bool]]:
    """Turn signals into a request while work is completed.

    Yields a function that returns whether the end was requested. It must be called now and then;
    once it has returned True there is no time limit. A second signal ends the process at once.

    Parameters
    ----------
    main
        Called in the main thread, as soon as that runs Python again.
    at_once
        Called in another thread, also while the main one computes: may cancel a computation.

    Raises
    ------
    Terminated
        A signal has come before.
    """
    with guarded():
        guard = _guard
        if guard is None or threading.current_thread() is not threading.main_thread():
            yield lambda: False
            return
        if guard.number is not None:
            raise Terminated(guard.number)
        before, guard.request = guard.request, _Request(main, at_once)
        try:
            yield guard.signal_received
        finally:
            guard.request = before


def termination() -> Terminated | None:
    """Return the signal that ends this process, None without one."""
    return None if _guard is None or _guard.number is None else Terminated(_guard.number)


def announce(ending: Terminated) -> None:
    """Write the signal that ends this process to standard error, if that is still open."""
    if _guard is not None:
        _guard.restore_stderr()
    with suppress(OSError):  # The terminal may be closed.
        sys.stderr.write(f"{ending}\n")
        sys.stderr.flush()


def child_options(environment: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Return arguments of ``subprocess.Popen`` for a process that ends with this one.

    The child has to be guarded. ``environment`` is its own, else that of this process.
    """
    reader = _lifeline_read_end()
    variables = os.environ if environment is None else environment
    return {
        "env": {**variables, _LIFELINE_VARIABLE: f"{reader}:{os.getpid()}"},
        "pass_fds": (reader,),
    }


def start_child(
    words: Sequence[str], environment: Mapping[str, str] | None = None, **options: Any
) -> subprocess.Popen[bytes]:
    """Start Python with arguments ``words`` as a new session, which ends with this process.

    ``options`` are those of ``subprocess.Popen``; see :func:`child_options` for ``environment``.
    """
    import subprocess

    own = child_options(environment)
    return subprocess.Popen([sys.executable, *words], start_new_session=True, **own, **options)


def run_child(
    words: Sequence[str], environment: Mapping[str, str] | None = None, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run Python with arguments ``words`` until it or this process ends; return its output."""
    import subprocess

    own = child_options(environment)
    return subprocess.run(
        [sys.executable, *words], capture_output=True, text=True, check=False, **own, **options
    )


def end_with_parent() -> None:
    """End a process of :mod:`multiprocessing` when its parent ends; call it in a thread."""
    import multiprocessing  # It takes a while, and few processes are of it.

    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def end_child(process: subprocess.Popen[bytes], signals: Mapping[int, float]) -> int:
    """End a child of :func:`start_child` and return its exit code.

    Parameters
    ----------
    process
        The child.
    signals
        Signals to send one after the other, each with the longest wait for the end, wall s; signal
        0 only waits. Then the child is killed with all of its session.
    """
    import subprocess

    for number, patience in signals.items():
        process.send_signal(number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(patience)
            break
    if process.poll() is None:
        with suppress(OSError):
            os.killpg(process.pid, signal.SIGKILL)
    for stream in (process.stdin, process.stdout):
        if stream is not None:
            with suppress(OSError):
                stream.close()
    return process.wait()


@contextmanager
def tool(words: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    """Start a program that does not end by itself with this process, and kill it at the end.

    The program and its children are also killed when this process is asked to end or is gone.
    It is in a session of its own and has no input.

    Parameters
    ----------
    words, options
        As of ``subprocess.Popen``.

    Raises
    ------
    OSError
        There is no such program.
    Terminated
        This process is to end, and has ended the program.
    """
    import shutil
    import subprocess

    if shutil.which(words[0]) is None:
        raise FileNotFoundError(f"There is no program '{words[0]}'.")
    reader, writer = os.pipe()
    try:
        process = subprocess.Popen(
            [sys.executable, "-I", "-S", "-c", _TOOL_KEEPER_SCRIPT, str(reader), *words],
            stdin=subprocess.DEVNULL,
            pass_fds=(reader,),
            **options,
        )
        guard = _guard
        if guard is not None:
            guard.tools.add(process)
        try:
            yield process
        finally:
            if guard is not None:
                guard.tools.discard(process)
            if process.poll() is None:
                _kill_tool(process)
    finally:
        os.close(writer)
        os.close(reader)
    ending = termination()
    if ending is not None and process.returncode:
        raise ending


def _kill_tool(process: subprocess.Popen[bytes]) -> None:
    """Kill a tool and its children."""
    # If the session does not exist yet, closing the pipe ends the tool.
    with suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.wait()
    end = time.monotonic() + _KILL_WAIT
    with suppress(OSError):
        while time.monotonic() < end:
            os.killpg(process.pid, 0)
            time.sleep(0.005)


_TOOL_KEEPER_SCRIPT = """
import os, signal, sys
lifeline, words = int(sys.argv[1]), sys.argv[2:]
os.setsid()
watcher = os.fork()
if not watcher:
    null = os.open(os.devnull, os.O_RDWR)
    os.dup2(null, 1)
    os.dup2(null, 2)
    os.read(lifeline, 1)
    os.killpg(0, signal.SIGKILL)
code = os.spawnvp(os.P_WAIT, words[0], words)
os.kill(watcher, signal.SIGKILL)
os.waitpid(watcher, 0)
if code < 0:
    signal.signal(-code, signal.SIG_DFL) if -code != signal.SIGKILL else None
    os.kill(os.getpid(), -code)
os._exit(code)
"""
"""Runs a program in a session of its own, which is killed when the pipe breaks."""


@cache
def _lifeline_read_end() -> int:
    """Return the read end of a pipe for children; its write end closes when this process ends."""
    reader, _ = os.pipe()
    return reader


def _parent_lifeline() -> tuple[int | None, int]:
    """Return the pipe (None: no pipe) that the parent process holds open, and the parent's id."""
    text = os.environ.pop(_LIFELINE_VARIABLE, "")
    if not text:
        return None, 0
    file, _, parent = text.partition(":")
    os.set_inheritable(int(file), False)
    return int(file), int(parent)


def _die_with_parent() -> None:
    """Let the kernel (Linux) send a signal to this process when its parent ends."""
    with suppress(ImportError, OSError, AttributeError):
        import ctypes

        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(_PARENT_ENDED_SIGNAL), 0, 0, 0)
