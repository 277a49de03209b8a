"""A supervisor that is killed leaves no node, and the robot at rest."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import uuid
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from support.awaited import await_end, await_size

from spacerobot_ros.bag import Bag, RecordingError, read_bag
from spacerobot_ros.bag.salvage import salvage_bag

KILLS = 20
ROOT = Path(__file__).parents[2]
START_PATIENCE = 60.0
SOON = 2.0
"""Wall s after which no process is left."""

MARK = "SPACEROBOT_TEST_MARK"
FLIGHT = (
    *("run", "sliding_masses", "--processes", "--realtime", "--method", "lie_bracket"),
    *("--set", "planner.lie_bracket.t1=60", "--set", "recorder.flush_period=0.1"),
)
LATEST = 12.0
"""Wall s from the start of the supervisor, which flies by then."""


def whole(path: Path) -> Bag:
    """Read a bag; one whose recorder was killed is salvaged first."""
    try:
        return read_bag(path)
    except RecordingError:
        return read_bag(salvage_bag(path).path)


class Supervisor:
    """``spacerobot run --processes``, and what it has started."""

    def __init__(self, folder: Path, domain: int, *words: str) -> None:
        self.bag = folder / "flight.mcap"
        self._mark = uuid.uuid4().hex
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), MARK: self._mark}
        environment["PYTHONPATH"] = str(ROOT)
        with (folder / "output.txt").open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "spacerobot_ros", *FLIGHT, "--bag", str(self.bag), *words],
                env=environment,
                cwd=folder,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )

    def left(self) -> list[int]:
        """Return the processes that carry our mark and have not ended."""
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                state = (folder / "stat").read_text().rpartition(")")[2].split()[0]
                ours = f"{MARK}={self._mark}".encode() in (folder / "environ").read_bytes()
                if ours and state not in "ZX":
                    found.append(int(folder.name))
        return found

    def await_flight(self) -> None:
        """Wait until states of a robot that moves are in the bag."""
        await_size(self.bag, 30_000, self.process, START_PATIENCE)

    def kill(self) -> None:
        """End the supervisor as by a crash, and require that everything ends with it."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        left = await_end(self.left, SOON)
        for each in left:
            with suppress(ProcessLookupError):
                os.kill(each, signal.SIGKILL)
        assert not left

    def speeds(self) -> np.ndarray:
        """Return the largest joint rate of every recorded state; empty where none was recorded."""
        if not self.bag.exists() or not self.bag.stat().st_size:
            return np.zeros(0)
        bag, refusal = None, ""
        try:
            bag = whole(self.bag)
        except RecordingError as error:
            refusal = str(error)
        if bag is None:
            # Killed before anything was recorded.
            assert "no message" in refusal or "nothing" in refusal, refusal
            return np.zeros(0)
        if "/joint_states" not in bag.topics or not bag.message_count("/joint_states"):
            return np.zeros(0)
        return np.abs(np.asarray(bag["/joint_states"].field("velocity"))).max(axis=1)


@pytest.mark.slow
def test_nodes_end_with_their_supervisor_and_the_robot_at_rest(
    ros_domain: int, tmp_path: Path
) -> None:
    supervisor = Supervisor(tmp_path, ros_domain)
    supervisor.await_flight()
    supervisor.kill()
    speeds = supervisor.speeds()
    assert speeds[:-1].max() > 1e-5, "it moved"
    assert speeds[-1] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("run", range(KILLS))
def test_a_supervisor_killed_at_a_random_moment_leaves_nothing(
    ros_domain: int, tmp_path: Path, run: int
) -> None:
    """From its first import on: nodes that start, models that are compiled, plans, flights."""
    delay = random.Random(run).uniform(0.0, LATEST)
    supervisor = Supervisor(tmp_path, ros_domain)
    with suppress(subprocess.TimeoutExpired):
        supervisor.process.wait(delay)
    assert supervisor.process.returncode is None
    supervisor.kill()
    assert supervisor.speeds()[-1:].sum() == 0.0
