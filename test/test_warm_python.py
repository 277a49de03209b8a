"""Programs in forks of an interpreter that has imported everything are as programs of their own."""

from __future__ import annotations

import os
import signal
import subprocess
from functools import partial
from pathlib import Path

import pytest
from support.awaited import await_end
from support.warm_python import WarmPython

PATIENCE = 30.0


def test_a_program_has_arguments_variables_folder_streams_and_code_of_its_own(
    warm_python: WarmPython, tmp_path: Path
) -> None:
    (tmp_path / "beside.py").write_text("VALUE = 'imported'\n")
    (tmp_path / "program.py").write_text(
        "import os, sys, beside\n"
        "print(sys.argv[1:], os.getcwd(), os.environ['MARK'], beside.VALUE, sys.stdin.read())\n"
        "print('to the side', file=sys.stderr)\n"
        "sys.exit(7)\n"
    )
    done = warm_python.run(
        [tmp_path / "program.py", "a b", ""], tmp_path, {"MARK": "x=1"}, PATIENCE, input="typed"
    )
    assert done.returncode == 7
    assert done.stdout == f"['a b', ''] {tmp_path} x=1 imported typed\n"
    assert done.stderr == "to the side\n"
    assert "MARK" not in os.environ
    text = "import beside, os; print(os.environ)"
    again = warm_python.run(["-"], tmp_path, {}, PATIENCE, input=text)
    assert (again.returncode, again.stdout) == (0, "environ({})\n")


def test_an_exception_is_exit_code_1_and_a_warning_may_be_an_error(
    warm_python: WarmPython, tmp_path: Path
) -> None:
    text = "import warnings; warnings.warn('old', DeprecationWarning); 1 / 0"
    done = warm_python.run(["-"], tmp_path, {}, PATIENCE, input=text)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (
        1,
        "ZeroDivisionError: division by zero",
    )
    strict = {"PYTHONWARNINGS": "error,ignore:other"}
    done = warm_python.run(["-"], tmp_path, strict, PATIENCE, input=text)
    assert (done.returncode, done.stderr.splitlines()[-1]) == (1, "DeprecationWarning: old")


def test_signals_reach_it_and_nothing_of_it_is_left(
    warm_python: WarmPython, tmp_path: Path
) -> None:
    text = "import time; print('ready', flush=True); time.sleep(600)"
    (tmp_path / "program.py").write_text(text)
    for end in ("signal", "close"):
        with warm_python.start(
            [tmp_path / "program.py"],
            tmp_path,
            {},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        ) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == "ready\n"
            assert process.poll() is None
            with pytest.raises(subprocess.TimeoutExpired):
                process.wait(0.01)
            if end == "signal":
                process.send_signal(signal.SIGTERM)
                assert process.wait(PATIENCE) == -signal.SIGTERM
        assert not await_end(partial(alive, process.pid), PATIENCE)


def test_a_shell_runs_it_by_a_script(warm_python: WarmPython, tmp_path: Path) -> None:
    warm_python.script(tmp_path / "python3")
    warm_python.script(tmp_path / "spacerobot", "-m", "spacerobot_ros.cli.main")
    text = "spacerobot scenarios; python3 - <<EOF\nprint('by a shell')\nEOF\nspacerobot nothing"
    environment = {**os.environ, "PATH": f"{tmp_path}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["sh", "-c", text], env=environment, cwd=tmp_path, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "planar_chain" in done.stdout
    assert done.stdout.endswith("by a shell\n")
    assert "No such command 'nothing'" in done.stderr


def alive(pid: int) -> list[int]:
    """Return the process if it has not ended."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return []
    return [] if state in "ZX" else [pid]
