"""Python that has imported the package already, and forks for each program that tests run.

Starting an interpreter and importing ROS, CasADi and the package takes a second of CPU time, more
than what most programs of a test do afterwards. Where the start itself is not what is tested, a
test runs its program here: by :class:`WarmPython`, or by a script that :meth:`WarmPython.script`
writes, for a shell. Programs get arguments, variables, folder, standard streams, session, process
id and exit code of their own.

This file is also the server and the client that the scripts run, which imports next to nothing.
"""

from __future__ import annotations

import array
import os
import socket
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import subprocess
    from collections.abc import Mapping, Sequence
    from pathlib import Path
    from typing import IO, Any

_LARGEST_JOB = 1 << 17
"""Bytes of arguments, folder and variables."""

_FIELD, _PART = b"\x1e", b"\x1f"
"""Separators in a job."""

_STREAM_OPTIONS = ("stdin", "stdout", "stderr")


def _connect(
    path: str, words: list[str], folder: str, variables: Mapping[str, str], streams: list[int]
) -> socket.socket:
    """Ask the server at ``path`` for a program; it answers with its pid, then with its exit code.

    The program is killed when the connection is closed before.
    """
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    connection.connect(path)
    pairs = [f"{name}={value}" for name, value in variables.items()]
    parts = (words, [folder], pairs)
    job = _FIELD.join(_PART.join(os.fsencode(each) for each in part) for part in parts)
    rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, array.array("i", streams))
    connection.sendmsg([job], [rights])
    return connection


def _client(path: str, words: list[str]) -> int:
    """Run a program in the place of this process; return its exit code as shells do."""
    other = words[0].startswith("-") and words[0] not in ("-", "-m")
    if other or words[:2] == ["-m", "pytest"]:  # Which is to import everything by itself.
        os.execv(sys.executable, [sys.executable, *words])
    with _connect(path, words, os.getcwd(), os.environ, [0, 1, 2]) as connection:
        connection.recv(64)
        code = int(connection.recv(64) or 255)
    return code if code >= 0 else 128 - code


# -- the server ---------------------------------------------------------------------------------


def _import_everything() -> None:
    """Import what programs of tests import: all commands, all nodes, what plans, what draws."""
    import warnings
    from importlib import import_module

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in (
            *("matplotlib.pyplot", "scipy.optimize", "spacerobot_ros.nodes"),
            *("spacerobot_ros.session.live", "spacerobot_ros.session.processes"),
            "spacerobot_ros.report",
            "spacerobot_ros.flight.verification",
        ):
            import_module(name)
        for module in set(import_module("spacerobot_ros.cli.main").COMMANDS.values()):
            import_module(f"spacerobot_ros.cli.{module}")


def _serve(path: str) -> None:
    """Fork for each connection until standard input ends; return in each fork, and at the end."""
    import gc
    import selectors
    import signal

    del sys.path[0]  # The folder of this file.
    _import_everything()
    gc.collect()
    gc.freeze()
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(path)
    listener.listen(64)
    selector = selectors.DefaultSelector()
    selector.register(listener, selectors.EVENT_READ)
    selector.register(sys.stdin, selectors.EVENT_READ)
    running: dict[int, tuple[int, socket.socket]] = {}
    """By the descriptor of the process: its id, and who waits for it."""
    os.write(1, b"ready\n")
    while True:
        for key, _ in selector.select():
            if selector.get_map().get(key.fd) is not key:
                continue  # Its program's end stood before it in the list.
            if key.fileobj is sys.stdin:
                for pid, _ in running.values():
                    os.killpg(pid, signal.SIGKILL)
                sys.exit()
            if key.fileobj is listener:
                connection, _ = listener.accept()
                job, rights, _, _ = connection.recvmsg(_LARGEST_JOB, socket.CMSG_SPACE(3 * 4))
                streams = array.array("i", rights[0][2])
                pid = os.fork()
                if pid == 0:
                    listener.close()
                    selector.close()
                    for descriptor, (_, other) in running.items():
                        os.close(descriptor)
                        other.close()
                    connection.close()
                    os.setsid()
                    _become(job, streams.tolist())
                    return
                for stream in streams:
                    os.close(stream)
                descriptor = os.pidfd_open(pid)
                running[descriptor] = pid, connection
                selector.register(descriptor, selectors.EVENT_READ, pid)
                selector.register(connection, selectors.EVENT_READ, pid)
                connection.send(str(pid).encode())
            elif isinstance(key.fileobj, socket.socket):  # Who waited has gone.
                selector.unregister(key.fileobj)
                os.kill(key.data, signal.SIGKILL)
            else:
                selector.unregister(key.fileobj)
                _, connection = running.pop(key.fd)
                os.close(key.fd)
                _, status = os.waitpid(key.data, 0)
                if connection in selector.get_map():
                    selector.unregister(connection)
                    # Who waited may have gone since.
                    with suppress(BrokenPipeError, ConnectionResetError):
                        connection.send(str(os.waitstatus_to_exitcode(status)).encode())
                connection.close()


_job: list[str] = []
"""In a fork: what it is to run."""


def _become(job: bytes, streams: list[int]) -> None:
    """Take over streams, folder and variables of a job."""
    import builtins
    import warnings

    for number, stream in enumerate(streams):
        os.dup2(stream, number)
    for stream in streams:
        if stream > 2:
            os.close(stream)
    words, (folder,), pairs = (
        [os.fsdecode(each) for each in part.split(_PART)] for part in job.split(_FIELD)
    )
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(pair.partition("=")[::2] for pair in pairs if pair)
    paths = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    sys.path[:0] = [path for path in paths if path and path not in sys.path]
    for each in filter(None, os.environ.get("PYTHONWARNINGS", "").split(",")):
        action, message, category = (*each.split(":"), "", "")[:3]
        kind = getattr(builtins, category, Warning)
        warnings.filterwarnings(action, message, kind)  # type: ignore[arg-type]
    # What runs by its name has been imported by another before.
    warnings.filterwarnings("ignore", category=RuntimeWarning, module="runpy")
    _job.extend(words)


def _run(words: list[str]) -> None:
    """Run what follows ``python`` on a command line: ``-m MODULE``, ``-`` or a file."""
    import runpy

    if words[0] == "-m":
        sys.argv = words[1:]
        sys.path.insert(0, os.getcwd())
        runpy.run_module(words[1], run_name="__main__", alter_sys=True)
    elif words[0] == "-":
        sys.argv = words
        sys.path.insert(0, "")
        own: dict[str, Any] = {"__name__": "__main__"}
        exec(compile(sys.stdin.read(), "<stdin>", "exec"), own)
    else:
        sys.argv = words
        sys.path.insert(0, os.path.dirname(os.path.abspath(words[0])))
        runpy.run_path(words[0], run_name="__main__")


# -- for tests ----------------------------------------------------------------------------------


class WarmProcess:
    """A program that runs in a fork, with what tests use of :class:`subprocess.Popen`."""

    def __init__(self, connection: socket.socket, pipes: dict[str, IO[str]]) -> None:
        self._connection = connection
        self.pid = int(connection.recv(64))
        self.returncode: int | None = None
        self.stdin, self.stdout, self.stderr = (pipes.get(name) for name in _STREAM_OPTIONS)

    def poll(self) -> int | None:
        """Return the exit code if it has ended, as Popen does."""
        import subprocess

        try:
            return self.wait(0.0)
        except subprocess.TimeoutExpired:
            return None

    def wait(self, timeout: float | None = None) -> int:
        """Wait for its end and return the exit code, negative for a signal.

        Raises
        ------
        subprocess.TimeoutExpired
            It has not ended within ``timeout`` wall s.
        """
        import select
        import subprocess

        if self.returncode is None:
            ready, _, _ = select.select([self._connection], [], [], timeout)
            if not ready:
                raise subprocess.TimeoutExpired("a program in a fork", timeout or 0.0)
            self.returncode = int(self._connection.recv(64))
        return self.returncode

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, number)

    def __enter__(self) -> WarmProcess:
        return self

    def __exit__(self, *_: object) -> None:
        """Kill it if it still runs, and close its pipes."""
        self._connection.close()
        for pipe in (self.stdin, self.stdout, self.stderr):
            if pipe is not None:
                pipe.close()


class WarmPython:
    """The server, in a process that ends with this one.

    Parameters
    ----------
    folder
        Where its socket is.
    project
        Where the package is imported from.
    """

    def __init__(self, folder: Path, project: Path) -> None:
        import subprocess

        self._path = str(folder / "socket")
        self._server = subprocess.Popen(
            [sys.executable, __file__, "serve", self._path],
            cwd=project,
            env={**os.environ, "PYTHONPATH": str(project), "MPLBACKEND": "agg"},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        assert self._server.stdout is not None
        assert self._server.stdout.readline() == b"ready\n"

    def start(
        self, words: Sequence[object], cwd: Path, env: Mapping[str, str], **streams: Any
    ) -> WarmProcess:
        """Start a program; ``streams`` as of :class:`subprocess.Popen`, pipes are text."""
        import subprocess

        given: list[int] = []
        ours: dict[str, IO[str]] = {}
        for number, name in enumerate(_STREAM_OPTIONS):
            stream = streams.get(name)
            if stream == subprocess.PIPE:
                reader, writer = os.pipe()
                theirs, mine = (reader, writer) if number == 0 else (writer, reader)
                ours[name] = os.fdopen(mine, "w" if number == 0 else "r", encoding="utf-8")
            elif stream == subprocess.STDOUT:
                theirs = os.dup(given[1])
            elif stream is None:
                theirs = os.open(os.devnull, os.O_RDWR)
            else:
                theirs = os.dup(stream if isinstance(stream, int) else stream.fileno())
            given.append(theirs)
        texts = [str(each) for each in words]
        connection = _connect(self._path, texts, str(cwd), env, given)
        for each in given:
            os.close(each)
        return WarmProcess(connection, ours)

    def run(
        self,
        words: Sequence[object],
        cwd: Path,
        env: Mapping[str, str],
        timeout: float,
        input: str = "",
    ) -> subprocess.CompletedProcess[str]:
        """Run a program to its end as :func:`subprocess.run` with ``capture_output`` does."""
        import subprocess
        from contextlib import ExitStack
        from tempfile import TemporaryFile

        with ExitStack() as opened:
            files = {name: opened.enter_context(TemporaryFile("w+")) for name in _STREAM_OPTIONS}
            files["stdin"].write(input)
            files["stdin"].seek(0)
            with self.start(words, cwd, env, **files) as process:
                code = process.wait(timeout)
            for name in ("stdout", "stderr"):
                files[name].seek(0)
            output, errors = files["stdout"].read(), files["stderr"].read()
        return subprocess.CompletedProcess(list(map(str, words)), code, output, errors)

    def script(self, file: Path, *words: str) -> None:
        """Write a program for a shell that runs ``python WORDS`` with its own words after them."""
        ours = " ".join(f'"{word}"' for word in (__file__, "run", self._path, *words))
        file.write_text(f'#!/bin/sh\nexec "{sys.executable}" -I -S {ours} "$@"\n')
        file.chmod(0o755)

    def close(self) -> None:
        """End it, and what still runs."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.close()
        self._server.wait()
        self._server.stdout.close()


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        _serve(sys.argv[2])
        _run(_job)
    else:
        sys.exit(_client(sys.argv[2], sys.argv[3:]))
