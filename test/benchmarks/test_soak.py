"""Whether growth is found in samples, and the flight that takes them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.command_line import CliRunner

from spacerobot_ros.benchmarks.soak import SAMPLED_QUANTITIES, robust_slope, trend_of
from spacerobot_ros.cli.main import main

TIMES = np.arange(0.0, 1800.0, 2.0)


def noise(scale: float) -> np.ndarray:
    return np.random.default_rng(5).normal(0.0, scale, len(TIMES))


def test_the_slope_is_that_of_the_samples_but_for_outliers() -> None:
    values = 3.0 + 0.01 * TIMES + noise(0.1)
    values[::4] = 1e6
    assert robust_slope(TIMES, values) == pytest.approx(0.01, rel=0.05)
    assert robust_slope(TIMES[:1], values[:1]) == 0.0


def test_a_leak_grows_and_a_warm_up_does_not() -> None:
    flat = 100.0 + noise(1.0) + 20.0 * (TIMES > 200)
    assert trend_of("plant", "rss", TIMES, flat).flat
    # 10 MiB in the half hour, under noise.
    leaking = flat + 10.0 * TIMES / TIMES[-1]
    trend = trend_of("plant", "rss", TIMES, leaking)
    assert trend.growth == pytest.approx(7.5, abs=0.6), "in the three quarters that count"
    assert not trend.flat


@pytest.mark.parametrize("quantity", ["descriptors", "threads"])
def test_one_descriptor_or_thread_more_grows(quantity: str) -> None:
    values = np.full(len(TIMES), 20.0)
    assert trend_of("plant", quantity, TIMES, values).flat
    values[7::9] += 1  # Open for a moment, now and then.
    assert trend_of("plant", quantity, TIMES, values).flat
    late = values + (TIMES > 1500)
    assert not trend_of("plant", quantity, TIMES, late).flat


@pytest.mark.slow
def test_a_short_soak_samples_every_process(
    tmp_path: Path, ros_domain: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    monkeypatch.setattr("faulthandler.enable", lambda: None)
    file = tmp_path / "soak.json"
    result = CliRunner().invoke(main, ["bench", "soak", "40", "--json", str(file)])
    figures = json.loads(file.read_text("utf-8"))
    assert result.exit_code == (0 if figures["flat"] else 1), result.output
    processes = {"plant", "planner", "recorder", "supervisor"}
    samples = figures["samples"]
    assert samples.keys() == {"time_s", *processes}
    assert samples["time_s"][-1] > 30
    for process in processes:
        assert samples[process].keys() == SAMPLED_QUANTITIES.keys()
        assert min(samples[process]["rss"]) > 20
        assert min(samples[process]["threads"]) >= 1
    assert sum(figures["goals"].values()) == 4
    assert figures["goals"].get("reached", 0) >= 2, result.output
    assert (tmp_path / "soak.png").stat().st_size > 10_000
