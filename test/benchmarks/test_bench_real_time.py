"""The benchmarks in real time, for a few seconds: separate processes, without and with a viewer."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spacerobot_ros.benchmarks.real_time import _counts_between, real_time_flight

ROOT = Path(__file__).parents[2]


def test_deadlines_are_counted_between_two_times() -> None:
    table = np.array([[0.0, 0, 0], [1.0, 200, 1], [2.0, 400, 1], [3.0, 600, 5], [4.0, 800, 6]])
    assert _counts_between(table, 1.0, 3.0).tolist() == [400, 4]
    assert _counts_between(table, 0.5, 2.5).tolist() == [400, 4], "by whole reports"
    assert _counts_between(table, 3.5, 99.0).tolist() == [0, 0]


@pytest.mark.slow
def test_the_servicer_flies_beside_a_viewer(own_domain: None, tmp_path: Path) -> None:
    words = ("-m", "spacerobot_ros.cli.main", "bench", "viewer", "5", "--json", "figures.json")
    ran = subprocess.run(
        [sys.executable, *words],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert ran.returncode == 0, ran.stderr
    assert "updates a second received" in ran.stdout
    figures = json.loads((tmp_path / "figures.json").read_text("utf-8"))
    assert figures["viewer_updates_per_s"] > 1.0
    for which in ("with", "without"):
        assert figures[f"viewer_deadlines_{which}"] > 500
        assert 0.0 <= figures[f"viewer_missed_{which}_percent"] <= 100.0


@pytest.mark.slow
def test_a_short_flight_loses_nothing(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    measured = real_time_flight(50.0, 8.0)
    assert measured.ticks == pytest.approx(8 * 50, abs=60)
    assert measured.duration_s == pytest.approx(8.0, abs=1.0)
    assert measured.states_lost == measured.commands_lost == 0
    # Plant, planner and recorder: Python and its libraries in three processes.
    assert 100 < measured.memory_MiB < 2000
    assert 0 <= measured.missed < 0.5
