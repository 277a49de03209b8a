"""Workers of a scheduler: one is killed, the campaign is killed, and every draw is flown once."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml
from support.awaited import await_files
from support.campaigns import campaign, section

from spacerobot_ros.campaign.dataset import Dataset, Row
from spacerobot_ros.campaign.draws import Draws
from spacerobot_ros.campaign.running import run_campaign
from spacerobot_ros.campaign.workers import open_workers, serialise_campaign, this_code

pytestmark = pytest.mark.slow

GIVEN: dict[str, Any] = {
    "disperse": {"mass.*": {"norm": {"loc": 1.0, "scale": 0.03}}},
    "flights": 3000,  # So many that a quick machine is not done with them before the kills
    "seed": 8,
    "engine": "flights",
}
_LONGEST = 900.0


@dataclass(frozen=True)
class Started:
    """A process, and the file that it prints into."""

    process: subprocess.Popen[bytes]
    log: Path

    def awaited(self, pattern: str) -> str:
        """Return what it prints of a pattern."""

        def printed() -> re.Match[str] | None:
            return re.search(pattern, self.log.read_text())

        await_files([self.log.parent], lambda: bool(printed()), self.process, _LONGEST)
        found = printed()
        assert found is not None
        return found[0]

    def kill(self, number: signal.Signals = signal.SIGKILL, *, all_of_it: bool = False) -> int:
        """Send a signal, wait for the end, and return its code.

        ``all_of_it``: to what it has started, too, as a terminal does.
        """
        (os.killpg if all_of_it else os.kill)(self.process.pid, number)
        return self.process.wait(timeout=_LONGEST)


@contextmanager
def started(folder: Path, *command: str, path: Path | None = None) -> Iterator[Started]:
    """Run a process of this Python while the block lasts; ``path`` is a folder of modules."""
    environment = dict(os.environ)
    if path is not None:
        environment["PYTHONPATH"] = f"{path}:{environment.get('PYTHONPATH', '')}"
    log = folder / f"{command[0]}-{len(list(folder.glob('*.log')))}.log"
    with log.open("wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", *command], stdout=output, stderr=subprocess.STDOUT,
            env=environment, start_new_session=True,
        )  # fmt: skip
        try:
            yield Started(process, log)
        finally:
            process.kill()
            process.wait()


def command_of(folder: Path, **changes: Any) -> tuple[tuple[str, ...], Path]:
    """Write a campaign; return the command that flies it, and the folder that this fills."""
    file, out = folder / "many.yaml", folder / "out"
    file.write_text(yaml.safe_dump({"campaign": section(**{**GIVEN, **changes})}))
    return ("spacerobot_ros", "campaign", str(file), "--out", str(out)), out


def flown(folder: Path) -> int:
    return len(Dataset(folder).flown_numbers()) if (folder / "flights").is_dir() else 0


def until(folder: Path, count: int, run: Started) -> None:
    """Wait until so many flights of a campaign are in its dataset."""
    folders = [folder.parent, folder, folder / "flights"]
    await_files(folders, lambda: flown(folder) >= count, run.process, _LONGEST)


def rows(folder: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = Dataset(folder).table().to_pylist()
    return [{k: v for k, v in row.items() if not k.startswith(("wall_", "plan_"))} for row in found]


SCHEDULER = ("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0",
             "--no-dashboard", "--no-jupyter")  # fmt: skip
ADDRESS = r"tcp://127\.0\.0\.1:\d+"


def worker_of(address: str) -> tuple[str, ...]:
    return ("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny",
            "--no-dashboard", "--host", "127.0.0.1")  # fmt: skip


def test_a_scheduler_that_goes_away_is_said_and_takes_no_flight_with_it(tmp_path: Path) -> None:
    """No flight is taken for one that kills its worker."""
    command, out = command_of(tmp_path)
    with started(tmp_path, *SCHEDULER) as scheduler:
        address = scheduler.awaited(ADDRESS)
        with started(tmp_path, *worker_of(address)) as worker:
            worker.awaited("Registered to")
            with started(tmp_path, *command, "--scheduler", address) as run:
                until(out, 10, run)
                scheduler.kill()
                assert run.process.wait(timeout=_LONGEST) == 2
                assert run.log.read_text().endswith(
                    "The scheduler is gone. Finished flights are kept; repeat the command to "
                    "continue.\n"
                )
    found = rows(out)
    assert {row["outcome"] for row in found} == {"reached"}
    numbers = [row["flight"] for row in found]
    assert len(numbers) == len(set(numbers)) >= 10


def test_a_worker_that_has_no_package_is_refused(tmp_path: Path) -> None:
    command, _ = command_of(tmp_path)
    (tmp_path / "sitecustomize.py").write_text("import sys\nsys.modules['spacerobot_ros'] = None\n")
    with started(tmp_path, *SCHEDULER) as scheduler:
        address = scheduler.awaited(ADDRESS)
        with started(tmp_path, *worker_of(address), path=tmp_path) as worker:
            worker.awaited("Registered to")
            with started(tmp_path, *command, "--scheduler", address) as run:
                assert run.process.wait(timeout=_LONGEST) == 2
                expected = (
                    rf"The worker at {ADDRESS} does not have spacerobot_ros: install it there\.\n"
                )
                assert re.fullmatch(f"drawn .*\n{expected}", run.log.read_text())


@pytest.mark.study
def test_workers_and_campaigns_that_are_killed(tmp_path: Path) -> None:
    command, out = command_of(tmp_path)
    with started(tmp_path, *SCHEDULER) as process:
        address = process.awaited(ADDRESS)
        worker, command = worker_of(address), (*command, "--scheduler", address)
        with started(tmp_path, *worker) as first, started(tmp_path, *worker) as second:
            for each in (first, second):
                each.awaited("Registered to")
            with started(tmp_path, *command) as run:
                until(out, 10, run)
                first.kill()
                until(out, flown(out) + 10, run)
                run.kill()
            assert 20 <= flown(out) < GIVEN["flights"]
            with started(tmp_path, *command) as run:
                assert run.process.wait(timeout=_LONGEST) == 0, run.log.read_text()
    run_campaign(campaign(**GIVEN), tmp_path / "undisturbed")
    assert [row["flight"] for row in rows(out)] == list(range(GIVEN["flights"]))
    assert str(rows(out)) == str(rows(tmp_path / "undisturbed"))


def test_a_flight_that_kills_its_worker_twice_is_reported(tmp_path: Path) -> None:
    """The plant of flight 7 ends its process; all other flights are flown, and once."""
    command, out = command_of(tmp_path, flights=24)
    (tmp_path / "sitecustomize.py").write_text(
        "import os\n"
        "def poison():\n"
        "    from spacerobot_ros.campaign import one_by_one as engines\n"
        "    fly = engines.drawn_flight\n"
        "    def flown(campaign, draw, common):\n"
        "        if draw.number == 7: os.kill(os.getpid(), 9)\n"
        "        return fly(campaign, draw, common)\n"
        "    engines.drawn_flight = flown\n"
        "poison()\n"
    )
    with started(tmp_path, *command, "--workers", "2", path=tmp_path) as run:
        assert run.process.wait(timeout=_LONGEST) == 0, run.log.read_text()
    found = rows(out)
    assert [row["flight"] for row in found] == list(range(24))
    assert {row["flight"]: row["outcome"] for row in found if row["outcome"] != "reached"} == {
        7: "killed"
    }
    assert found[7]["reason"] == "Its process died 2 times."


def test_workers_of_this_machine_listen_nowhere() -> None:
    """No user of this machine can send them code: neither they nor this process have a port."""
    here = psutil.Process()

    def listening() -> list[Any]:
        return [
            connection.laddr
            for process in [here, *here.children(recursive=True)]
            for connection in process.net_connections("all")
            if connection.status == psutil.CONN_LISTEN
            or (connection.laddr and not connection.raddr)
        ]

    before = listening()
    made = campaign(**{**GIVEN, "flights": 2})
    with open_workers(2, workers=2) as workers:
        tasks = [
            workers.submit(serialise_campaign(made), this_code(), [draw], "flights", True)
            for draw in Draws(made)
        ]
        for number, task in enumerate(tasks):
            (row,) = workers.result(task)
            assert isinstance(row, Row)
            assert row.draw.number == number
        assert len(here.children()) >= 2
        assert listening() == before


def test_what_was_flown_is_kept_after_ctrl_c(tmp_path: Path) -> None:
    command, out = command_of(tmp_path, flights=100_000)
    with started(tmp_path, *command, "--workers", "2") as run:
        until(out, 8, run)
        assert run.kill(signal.SIGINT, all_of_it=True) == 130, run.log.read_text()
        assert "Traceback" not in run.log.read_text()
    numbers = [row["flight"] for row in rows(out)]
    assert len(numbers) >= 8
    assert len(numbers) == len(set(numbers))
    assert (out / "report.html").exists()


def test_workers_end_with_a_campaign_that_is_killed(tmp_path: Path) -> None:
    command, out = command_of(tmp_path)
    with started(tmp_path, *command, "--workers", "2") as run:
        until(out, 8, run)
        workers = psutil.Process(run.process.pid).children(recursive=True)
        assert len(workers) >= 2
        run.kill()
        _, alive = psutil.wait_procs(workers, timeout=60.0)
    assert not alive
