"""Signals that end a process, and child processes that end with their parent.

A process installs its guard at its first import (:func:`guarded`). SIGINT, SIGTERM and SIGHUP then
raise :class:`Terminated` in the main thread; work that must be completed, such as a flight or a
bag, receives a request instead (:func:`graceful_shutdown`). A second signal, at least one second
later, ends the process immediately. A timer also ends the process if a library suppresses the
exception. Python handles signals once a call to C code has returned.

On Linux, when a process ends, the kernel sends a signal to the children that the process started
with :func:`start_child`.
"""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, TextIO

_MESSAGE_BY_SIGNAL = {
    signal.SIGINT: "Interrupted.",
    signal.SIGTERM: "Terminated.",
    signal.SIGHUP: "Hung up.",
}

_LONGEST_UNWINDING_TIME = 1.2
"""Wall time, s, within which the main thread must end after the exception raised by a signal."""

_SAME_SIGNAL_TIME = 1.0
"""Wall time, s, within which several signals are treated as one, because both a launcher and a
terminal send a signal.
"""

_TIME_AFTER_PARENT_END = 1.5
"""Wall time, s, from the end of the parent until the kernel kills this process."""

_PARENT_VARIABLE = "SPACEROBOT_PARENT"
"""Environment variable with which a child receives its parent's process id."""

_PARENT_ENDED_SIGNAL = signal.SIGUSR2

_PR_SET_PDEATHSIG = 1


class Terminated(KeyboardInterrupt):
    """A signal that ends the process. Like KeyboardInterrupt, this exception is not caught
    by ``except Exception``.

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
        """Exit code that shells report for this signal."""
        return 128 + self.number


class _Guard:
    def __init__(self) -> None:
        self.ending: Terminated | None = None
        """The first signal; None before one."""
        self.on_request: Callable[[], None] | None = None
        self._since = 0.0
        self._errors: TextIO | None = None
        # nohup makes a process ignore the end of its terminal.
        ignored = signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        numbers = [each for each in _MESSAGE_BY_SIGNAL if not (ignored and each == signal.SIGHUP)]
        self._parent = int(os.environ.pop(_PARENT_VARIABLE, "0"))
        if self._parent:
            numbers.append(_PARENT_ENDED_SIGNAL)
        self._handlers = {each: signal.signal(each, self._on_signal) for each in numbers}

    def remove(self) -> None:
        self.restore_stderr()
        if signal.getsignal(signal.SIGALRM) == self._end_process:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def restore_stderr(self) -> None:
        if self._errors is not None:
            self._errors, sys.stderr = None, self._errors

    def watch_parent(self) -> None:
        """Make the Linux kernel send a signal when the parent ends; the parent may have ended
        already.
        """
        if not self._parent:
            return
        with suppress(ImportError, OSError, AttributeError):
            import ctypes

            ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, int(_PARENT_ENDED_SIGNAL), 0, 0, 0)
        signal.raise_signal(_PARENT_ENDED_SIGNAL)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        parent_ended = number == _PARENT_ENDED_SIGNAL
        if parent_ended:
            if os.getppid() == self._parent:
                return  # Only the thread that has started this process has ended.
            number = signal.SIGTERM
            _set_timer(_TIME_AFTER_PARENT_END, signal.SIG_DFL)
        if self.ending is not None:
            if not parent_ended and time.monotonic() - self._since > _SAME_SIGNAL_TIME:
                self._end_process()
            return
        self.ending, self._since = Terminated(number), time.monotonic()
        if self.on_request is not None:
            self.on_request()
            return
        if not parent_ended:
            _set_timer(_LONGEST_UNWINDING_TIME, self._end_process)
        # Libraries such as a solver print warnings when the exception passes through them.
        self._errors, sys.stderr = sys.stderr, io.StringIO()
        raise self.ending

    def _end_process(self, *_: object) -> None:
        assert self.ending is not None
        announce(self.ending)
        os._exit(self.ending.exit_code)


def _set_timer(seconds: float, handler: Any) -> None:
    """Make a timer call a signal handler; ``SIG_DFL``: the kernel kills this process."""
    signal.signal(signal.SIGALRM, handler)
    signal.setitimer(signal.ITIMER_REAL, seconds)


_guard: _Guard | None = None


@contextmanager
def guarded() -> Iterator[bool]:
    """End the process on signals and when the parent ends, within this context.

    Yields whether the guard is new: a guard inside another guard has no effect. It also has no
    effect outside the main thread, because only that thread receives signals.

    Raises
    ------
    Terminated
        By a signal.
    """
    global _guard
    if _guard is not None or threading.current_thread() is not threading.main_thread():
        yield False
        return
    _guard = _Guard()
    try:
        _guard.watch_parent()
        yield True
    finally:
        _guard.remove()
        _guard = None


@contextmanager
def graceful_shutdown(
    on_request: Callable[[], None] = lambda: None,
) -> Iterator[Callable[[], bool]]:
    """Convert signals to a termination request while work is completed.

    Yields a function that returns whether termination was requested; the code in the context calls
    it regularly.

    Parameters
    ----------
    on_request
        Function called in the main thread on the first signal; it may cancel a computation.

    Raises
    ------
    Terminated
        A signal arrived earlier.
    """
    with guarded():
        if (ending := termination()) is not None:
            raise ending
        with _on_first_signal(on_request) as guard:
            yield lambda: guard is not None and guard.ending is not None


@contextmanager
def _on_first_signal(on_request: Callable[[], None] | None) -> Iterator[_Guard | None]:
    """Make the first signal in this context call a function; None: raise an exception."""
    guard = _guard
    if guard is None or threading.current_thread() is not threading.main_thread():
        yield None
        return
    before, guard.on_request = guard.on_request, on_request
    try:
        yield guard
    finally:
        guard.on_request = before


def termination() -> Terminated | None:
    """Return the signal that ends this process, or None."""
    return None if _guard is None else _guard.ending


def announce(ending: Terminated) -> None:
    """Write the signal that ends this process to standard error, if standard error is still
    open.
    """
    if _guard is not None:
        _guard.restore_stderr()
    with suppress(OSError):  # The terminal may be closed.
        sys.stderr.write(f"{ending}\n")
        sys.stderr.flush()


def start_child(
    words: Sequence[str], environment: Mapping[str, str] | None = None, **options: Any
) -> subprocess.Popen[bytes]:
    """Start Python with arguments ``words`` in a new session that ends together with this process.

    The child must be guarded. ``environment`` is the environment of the child, by default a
    copy of this process's environment; for ``options``, see ``subprocess.Popen``.
    """
    given = os.environ if environment is None else environment
    variables = {**given, _PARENT_VARIABLE: f"{os.getpid()}"}
    return subprocess.Popen(
        [sys.executable, *words], env=variables, start_new_session=True, **options
    )


def end_with_parent() -> None:
    """End a :mod:`multiprocessing` process when its parent ends; call this in a thread."""
    import multiprocessing  # This import takes a while, and few processes need it.

    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def end_child(process: subprocess.Popen[bytes], signals: Mapping[int, float]) -> int:
    """End a child started by :func:`start_child` and return its exit code.

    Parameters
    ----------
    process
        The child.
    signals
        Signals to send in turn, each with the maximum wall time, s, to wait for the child to
        end; signal 0 means only waiting. After that, the child is killed together with its whole
        session.
    """
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
    """Start a program, such as a compiler, and kill it together with its children at the end of
    the context.

    The program runs in its own session, without input. A signal raises :class:`Terminated` in this
    context, even within :func:`graceful_shutdown`.

    Parameters
    ----------
    words, options
        As for ``subprocess.Popen``.

    Raises
    ------
    FileNotFoundError
        There is no such program.
    """
    before, options = termination(), {"stdin": subprocess.DEVNULL, **options}
    # An exception while the program starts would leave it running.
    with (
        _on_first_signal(lambda: None) as guard,
        subprocess.Popen(words, start_new_session=True, **options) as process,
    ):
        try:
            if guard is not None:
                guard.on_request = None
                if guard.ending is not None and guard.ending is not before:
                    raise guard.ending
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
