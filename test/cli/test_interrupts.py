"""Commands that a signal or the end of their terminal ends: soon, with one line and its code."""

from __future__ import annotations

import os
import pty
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from spacerobot_ros.bag import read_bag

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0
MULTIARRAY = ("numpy._core.multiarray", "numpy.core.multiarray")
"""In the midst of the imports, by its names since numpy 2 and before."""
SOON = 2.0
PLANS = ("plan", "sliding_masses", "--random", "100000")


@contextmanager
def command(
    *words: str, options: tuple[str, ...] = (), **more: object
) -> Iterator[subprocess.Popen[str]]:
    """Run the command in a session of its own, which is killed if it is left behind."""
    # Tests that run under nohup would have the command ignore SIGHUP, as it should there.
    inherited = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        process = subprocess.Popen(
            [sys.executable, *options, "-m", "spacerobot_ros", *words],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            text=True,
            start_new_session=True,
            **more,  # type: ignore[call-overload]
        )
    finally:
        signal.signal(signal.SIGHUP, inherited)
    with process:
        try:
            yield process
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.parametrize(
    ("number", "line"), [(signal.SIGINT, "Interrupted."), (signal.SIGHUP, "Hung up.")]
)
def test_a_command_that_still_imports_ends_with_one_line(
    tmp_path: Path, number: signal.Signals, line: str
) -> None:
    """The interpreter itself reports its imports, and so when the signal is to come."""
    with command(
        *PLANS,
        options=("-X", "importtime"),
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        assert process.stderr is not None
        while not process.stderr.readline().rstrip().endswith(MULTIARRAY):
            assert process.poll() is None
        process.send_signal(number)
        began = time.monotonic()
        output, errors = process.communicate(timeout=PATIENCE)
        assert time.monotonic() - began < SOON
    said = [each for each in errors.splitlines() if not each.startswith("import time:")]
    assert (process.returncode, said, output) == (128 + number, [line], "")


@pytest.mark.slow
@pytest.mark.parametrize("run", range(12))
def test_plans_are_ended_at_any_moment(tmp_path: Path, run: int) -> None:
    """While modules are imported, models are compiled, and gaits are searched for."""
    chance = random.Random(run)
    number = chance.choice([signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
    with command(
        *("plan", "servicer", "--random", "50"),
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    ) as process:
        maps = Path(f"/proc/{process.pid}/maps")
        while "casadi" not in maps.read_text("utf-8"):
            assert process.poll() is None
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(chance.uniform(0.0, 8.0))
        process.send_signal(number)
        began = time.monotonic()
        _, errors = process.communicate(timeout=PATIENCE)
        assert time.monotonic() - began < SOON
    assert process.returncode == 128 + number
    assert len(errors.splitlines()) == 1, errors


@pytest.mark.slow
def test_a_terminal_that_is_closed_ends_a_robot_that_is_up_in_order(
    own_domain: None, tmp_path: Path
) -> None:
    ours, theirs = pty.openpty()
    words = ("up", "sliding_masses", "--processes", "--bag", "up.mcap")
    with command(
        *words,
        cwd=tmp_path,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        # The terminal of its session is ours: closing it hangs up.
        preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),
    ) as process:
        os.close(theirs)
        said = b""
        while b"is up" not in said:
            said += os.read(ours, 1000)
        os.close(ours)
        assert process.wait(PATIENCE) in (0, 129)
        # Complete: nothing had to be killed.
        assert read_bag(tmp_path / "up.mcap").message_count("/clock") > 0
