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
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import yaml
from support.campaigns import section
from support.command_line import Result, spacerobot

from spacerobot_ros.bag import read_bag
from spacerobot_ros.campaign.config import load_campaign
from spacerobot_ros.campaign.dataset import Dataset

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0
MULTIARRAY = ("numpy._core.multiarray", "numpy.core.multiarray")
"""In the midst of the imports, by its names since numpy 2 and before."""
SOON = 20.0
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


def test_a_reader_that_has_ended_ends_the_command_quietly() -> None:
    """As in `spacerobot scenarios | head -1`; a shell reports 128 + SIGPIPE."""
    end, pipe = os.pipe()
    os.close(end)
    with command("scenarios", stdout=pipe, stderr=subprocess.PIPE) as process:
        os.close(pipe)
        assert process.communicate(timeout=PATIENCE)[1] == ""
    assert process.returncode == 128 + signal.SIGPIPE


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
@pytest.mark.parametrize("run", range(3))
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


def test_a_sentence_is_wrapped_on_a_terminal_and_one_line_elsewhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("plan", "sliding_masses", "--goal", *"9000001")
    elsewhere = spacerobot(*words, code=1)
    (sentence,) = elsewhere.stderr.splitlines()
    ours, theirs = pty.openpty()
    monkeypatch.setenv("COLUMNS", "50")
    with command(*words, cwd=tmp_path, stderr=theirs) as process:
        os.close(theirs)
        said = b""
        with suppress(OSError):  # The last writer has closed the terminal.
            while received := os.read(ours, 1000):
                said += received
        os.close(ours)
        assert process.wait(PATIENCE) == 1
    lines = said.decode().rpartition("\x1b[K")[2].split("\r\n")
    assert max(map(len, lines)) <= 50
    assert " ".join(lines).strip() == sentence


GIVEN = {"flights": 11, "disperse": {"mass.*": {"uniform": [0.9, 1.1]}}}


def test_options_of_a_campaign_its_report_and_its_flights(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("first", "second"):
        given = {"campaign": section(**{**GIVEN, "flights": 4})}
        Path(f"{name}.yaml").write_text(yaml.safe_dump(given))

    def call(line: str) -> Result:
        return spacerobot("campaign", *line.split())

    words = "--flights 2 --engine flights --workers 0"
    said = call(f"fly first.yaml {words} --out there --report r.html").output
    assert "first: 2 of 2 flights" in said
    table = Dataset(Path("there")).table()
    assert table["engine"].to_pylist() == ["flights"] * 2
    assert Path("r.html").is_file()
    call("report there --report other.html")
    assert Path("other.html").read_bytes() == Path("r.html").read_bytes()
    call("report there")
    assert Path("there/report.html").is_file()
    call("rerun there 1 --bag other.mcap")
    call("rerun there 0")
    assert read_bag("other.mcap").message_count("/odom") > 1
    assert Path("there/flight_0.mcap").is_file()
    call(f"fly --compare first.yaml second.yaml {words} --out both --report c.html")
    assert Path("c.html").is_file()
    for name in ("first", "second"):
        assert len(Dataset(Path("both", name)).table()) == 2
    call("first.yaml --flights 1 --workers 0")
    assert Path("out/first/report.html").is_file()


def test_a_campaign_of_errors_or_refused_goals_alone_fails(tmp_path: Path) -> None:
    """As the flight of one draw by `run` does: here starts and goals beyond the strokes."""
    start, goal = "plant.initial_joint_positions[0]", "goal.position.x"
    for name, beyond, code in ((start, 5.0, 1), (start, 0.0, 0), (goal, 9.0, 1)):
        values = {name: {"uniform": [beyond, beyond + 0.1]}}
        file = tmp_path / f"{name}_{beyond}.yaml"
        given = {"campaign": section(disperse=values, flights=2)}
        file.write_text(yaml.safe_dump(given), "utf-8")
        words = ["campaign", str(file), "--workers", "0", "--out", str(tmp_path / file.stem)]
        for _ in ("flown", "nothing left to fly"):
            result = spacerobot(*words, code=code)
            assert ("None of the 2 draws could be flown" in result.output) == bool(code)


def test_the_range_of_what_is_drawn_is_said(tmp_path: Path) -> None:
    file = tmp_path / "c.yaml"
    disperse = {"mass.*": {"uniform": [0.95, 1.05]}, "goal.position.x": {"uniform": [-0.01, 0.01]}}
    file.write_text(yaml.safe_dump({"campaign": section(**{**GIVEN, "disperse": disperse})}))
    lines = sorted(load_campaign(file).description_lines, reverse=True)
    assert lines[0].endswith(" more: 0.951 to 1.049 in 98 % of the flights")
    assert lines[1:] == ["drawn       goal.position.x: -0.0098 to 0.0098 m in 98 % of the flights"]
