"""Workers of a scheduler: one is killed, the campaign is killed, and every draw is flown once."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.campaigns import campaign, section

from spacerobot_ros.campaign.dataset import Dataset
from spacerobot_ros.campaign.running import run_campaign

pytestmark = pytest.mark.slow

GIVEN: dict[str, Any] = {
    "disperse": {"mass.*": {"norm": {"loc": 1.0, "scale": 0.03}}},
    "flights": 120,
    "seed": 8,
}
_LONGEST = 300.0


@contextmanager
def started(*command: str) -> Iterator[subprocess.Popen[str]]:
    """Run a process of this Python while the block lasts."""
    process = subprocess.Popen(
        [sys.executable, "-m", *command],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def awaited(process: subprocess.Popen[str], pattern: str) -> str:
    """Return what a process prints of a pattern, and read on so that it does not stand still."""
    assert process.stdout is not None
    for line in process.stdout:
        found = re.search(pattern, line)
        if found:
            threading.Thread(target=process.stdout.read, daemon=True).start()
            return found[0]
    raise AssertionError(f"it ended without {pattern}")


def flown(folder: Path) -> int:
    return len(Dataset(folder).done()) if (folder / "flights").is_dir() else 0


def until(folder: Path, count: int) -> None:
    end = time.monotonic() + _LONGEST
    while flown(folder) < count:
        assert time.monotonic() < end
        time.sleep(0.1)


def rows(folder: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = Dataset(folder).table().to_pylist()
    return [{k: v for k, v in row.items() if not k.startswith(("wall_", "plan_"))} for row in found]


def test_workers_and_campaigns_that_are_killed(tmp_path: Path) -> None:
    file = tmp_path / "many.yaml"
    file.write_text(yaml.safe_dump({"campaign": section(**GIVEN)}))
    out = tmp_path / "out"
    scheduler = ("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
                 "--no-dashboard", "--no-jupyter")  # fmt: skip
    with started(*scheduler) as process:
        address = awaited(process, r"tcp://127\.0\.0\.1:\d+")
        worker = ("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny",
                  "--no-dashboard", "--host", "127.0.0.1")  # fmt: skip
        command = ("spacerobot_ros", "campaign", str(file), "--out", str(out), "--scheduler")
        with started(*worker) as first, started(*worker) as second:
            for each in (first, second):
                awaited(each, "Registered to")
            with started(*command, address) as run:
                assert run.stdout is not None
                threading.Thread(target=run.stdout.read, daemon=True).start()
                until(out, 10)
                os.kill(first.pid, signal.SIGKILL)
                until(out, flown(out) + 10)
                os.kill(run.pid, signal.SIGKILL)
                run.wait()
            before = flown(out)
            assert 20 <= before < 120
            with started(*command, address) as run:
                said = run.communicate(timeout=_LONGEST)[0]
            assert run.returncode == 0, said
    run_campaign(campaign(**GIVEN), tmp_path / "undisturbed")
    assert [row["flight"] for row in rows(out)] == list(range(120))
    assert str(rows(out)) == str(rows(tmp_path / "undisturbed"))


def test_a_flight_that_kills_its_worker_twice_is_reported(tmp_path: Path) -> None:
    """The plant of flight 7 ends its process; all other flights are flown, and once."""
    file, out = tmp_path / "many.yaml", tmp_path / "out"
    file.write_text(yaml.safe_dump({"campaign": section(**{**GIVEN, "flights": 24})}))
    (tmp_path / "sitecustomize.py").write_text(
        "import os\n"
        "def poison():\n"
        "    from spacerobot_ros.campaign import engines\n"
        "    fly = engines.drawn_flight\n"
        "    def flown(campaign, draw, common):\n"
        "        if draw.number == 7: os.kill(os.getpid(), 9)\n"
        "        return fly(campaign, draw, common)\n"
        "    engines.drawn_flight = flown\n"
        "poison()\n"
    )
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}"}
    command = ["spacerobot_ros", "campaign", str(file), "--out", str(out), "--workers", "2"]
    done = subprocess.run(
        [sys.executable, "-m", *command], env=environment, capture_output=True, text=True,
        timeout=_LONGEST, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = rows(out)
    assert [row["flight"] for row in found] == list(range(24))
    assert {row["flight"]: row["outcome"] for row in found if row["outcome"] != "reached"} == {
        7: "killed"
    }
    assert found[7]["reason"] == "The process that flew it died 2 times."


def test_what_was_flown_is_kept_after_ctrl_c(tmp_path: Path) -> None:
    file, out = tmp_path / "many.yaml", tmp_path / "out"
    file.write_text(yaml.safe_dump({"campaign": section(**{**GIVEN, "flights": 100000})}))
    command = ("spacerobot_ros", "campaign", str(file), "--out", str(out), "--workers", "2")
    with started(*command) as run:
        until(out, 8)
        os.kill(run.pid, signal.SIGINT)
        said = run.communicate(timeout=60)[0]
    assert run.returncode == 130, said
    numbers = [row["flight"] for row in rows(out)]
    assert len(numbers) >= 8
    assert len(numbers) == len(set(numbers))
    assert (out / "report.html").exists()
