"""Stacks in namespaces: each has a clock and a bag of its own, in one domain."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.planning import Goal
from spacerobot_ros.session.live import send_goal
from spacerobot_ros.session.processes import checked_namespace

ROOT = Path(__file__).parents[2]
COMMAND = (sys.executable, "-m", "spacerobot_ros.cli.main")
GAIT = (
    *("--set", "planner.method=lie_bracket"),
    *("--set", "planner.lie_bracket.t1=4", "--set", "planner.lie_bracket.cycles=0"),
    *("--set", "planner.attitude_tolerance=0.001", "--set", "planner.position_tolerance=0.001"),
)
PATIENCE = 120.0


@pytest.mark.slow
def test_two_stacks_of_the_command_fly_side_by_side(ros_domain: int, tmp_path: Path) -> None:
    """Each takes its own goal and records its own topics; the bag of each is verified."""
    environment = {**os.environ, "ROS_DOMAIN_ID": str(ros_domain), "PYTHONPATH": str(ROOT)}
    flown = {"one": "0.05", "two": "-0.04"}
    started = {
        name: subprocess.Popen(
            [
                *(*COMMAND, "up", "sliding_masses", "--rate", "20", "--bag", f"{name}.mcap"),
                *("--namespace", name, *GAIT),
            ],
            env=environment,
            cwd=tmp_path,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )
        for name in flown
    }
    try:
        for name, x in flown.items():
            sent = subprocess.run(
                [*COMMAND, "goal", x, "0", "0", "--namespace", name, "--timeout", "60"],
                env=environment,
                cwd=tmp_path,
                capture_output=True,
                text=True,
                timeout=PATIENCE,
                check=False,
            )
            assert sent.returncode == 0, sent.stdout + sent.stderr
            assert "The goal is reached" in sent.stdout
        for process in started.values():
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=PATIENCE)
            assert process.returncode == 0, errors
    finally:
        for process in started.values():
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(PATIENCE)
    for name, x in flown.items():
        bag = read_bag(tmp_path / f"{name}.mcap")
        outside = {topic for topic in bag.topics if not topic.startswith(f"/{name}/")}
        assert outside <= {"/diagnostics"}
        assert {f"/{name}/clock", f"/{name}/tf", f"/{name}/odom"} <= set(bag.topics)
        assert verify_bag(tmp_path / f"{name}.mcap").difference is None
        end = bag[f"/{name}/odom"].field("pose.pose.position.x")[-1]
        assert abs(end - float(x)) < 1e-3
        # One clock: time goes on in steps of one tick, and never back.
        steps = np.unique(np.diff(bag[f"/{name}/clock"].time_ns))
        assert steps.min() > 0
        assert steps.max() <= 2 * steps.min()


@pytest.mark.parametrize("name", ["my robot", "1", "a//b", "a-b", "~", "."])
def test_what_ros_does_not_take_as_a_namespace_is_refused(name: str) -> None:
    with pytest.raises(ParameterError, match="namespace"):
        checked_namespace(name)
    with pytest.raises(ParameterError, match="namespace"):
        send_goal(Goal.from_rotvec([1, 2, 3], [0.1, 0.2, 0]), print, namespace=name, timeout=1)


@pytest.mark.parametrize("name", ["a/b", "/a/b", "a/b/", "/a/b/"])
def test_slashes_at_the_ends_of_a_namespace_do_not_matter(name: str) -> None:
    assert checked_namespace(name) == "/a/b"
    assert checked_namespace("") == checked_namespace("/") == ""
