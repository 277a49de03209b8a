"""Attacks on the command line end in time, with a sentence, and leave nothing (``attacks.py``)."""

from __future__ import annotations

import os
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from attacks.attacks import ATTACKS, Attack
from support.sentences import assert_one_sentence

TIME_LIMIT = 60
"""Processor time of a command, s."""

MEMORY_LIMIT = 8 * 2**30
"""Address space of a command, bytes: a Python with all libraries takes two to three GiB."""

WALL_LIMIT = 300.0
"""Wall time after which a command that only waits is ended, s."""

ROWS = ["| area | attack | ends with | s | last line |", "|---|---|---|---|---|"]
OUTPUT = Path(__file__).resolve().parents[2] / "out" / "attacks.md"


def limit() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (TIME_LIMIT, TIME_LIMIT))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_LIMIT, MEMORY_LIMIT))


@pytest.fixture(scope="module")
def rows() -> Iterator[list[str]]:
    """Return the lines of the table, which is written at the end."""
    rows = ROWS.copy()
    yield rows
    OUTPUT.parent.mkdir(exist_ok=True)
    OUTPUT.write_text("\n".join(rows) + "\n", "utf-8")


def put_files(attack: Attack, folder: Path) -> None:
    for name, content in attack.files.items():
        data = content.encode() if isinstance(content, str) else content
        (folder / name).write_bytes(data)


def test_attacks_are_at_least_forty_and_each_has_a_name_of_its_own() -> None:
    assert len({(each.area, each.name) for each in ATTACKS}) == len(ATTACKS) >= 40
    assert all(each.says for each in ATTACKS)


@pytest.mark.slow
@pytest.mark.parametrize("attack", ATTACKS, ids=lambda each: f"{each.area}: {each.name}")
def test_an_attack_ends_with_a_sentence(attack: Attack, tmp_path: Path, rows: list[str]) -> None:
    put_files(attack, tmp_path)
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "spacerobot_ros", *attack.words],
        cwd=tmp_path,
        env={**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF", **attack.environment},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        timeout=WALL_LIMIT,
        preexec_fn=limit,
        check=False,
    )
    took = time.perf_counter() - start
    output = (done.stdout + done.stderr).decode("utf-8")
    last = output.strip().splitlines()[-1] if output.strip() else ""
    shown = last.replace("|", "\\|") if len(last) < 300 else f"{last[:150]} ... {last[-100:]}"
    rows.append(f"| {attack.area} | {attack.name} | {done.returncode} | {took:.1f} | {shown} |")
    assert done.returncode == attack.exit_code, output
    assert re.search(attack.says, last), output
    assert "Traceback" not in output
    assert not re.search(r"[^\n -\U0010ffff]", output)
    if attack.exit_code == 2:
        assert_one_sentence(re.sub(r" Did you mean '\w+'\?$", "", last))
        said = re.sub(r"^drawn .*\n", "", output, flags=re.M).strip()
        assert attack.area == "outputs" or last == said
        written = {path.name for path in tmp_path.iterdir()} - set(attack.files)
        # The folder of a campaign is there before its scheduler is looked for, if there may be one.
        looked_for = "--scheduler" in attack.words and attack.name != "a file as its scheduler"
        assert written == ({"out"} if looked_for else set())
