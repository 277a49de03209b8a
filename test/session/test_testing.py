"""Stacks of nodes in one executor, as a user's own tests compose them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import rclpy
from nav_msgs.msg import Odometry

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.process import free_domain
from spacerobot_ros.planning import Goal
from spacerobot_ros.testing import Stack

ROOT = Path(__file__).parents[2]
QUICK = {"planner": {"method": "optimal"}}


class Recorder(rclpy.node.Node):
    """Keeps the positions of the base."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("positions", context=context)
        self.found: list[float] = []
        self.create_subscription(
            Odometry, "odom", lambda odom: self.found.append(odom.pose.pose.position.x), 100
        )


def test_a_goal_is_reached_and_another_one_refused() -> None:
    with Stack("sliding_masses", ["plant", "planner", Recorder], QUICK) as stack:
        arrival = stack.fly_to(x=0.05)
        assert arrival.reached
        assert "The goal is reached" in arrival.message
        assert stack.nodes["positions"].found[-1] == pytest.approx(0.05, abs=0.02)
        refused = stack.fly_to(Goal.from_rotvec([9.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
        assert (refused.reached, refused.outcome) == (False, Outcome.REFUSED)


def test_a_stack_flies_the_same_states_every_time() -> None:
    flown = []
    for _ in range(2):
        with Stack("sliding_masses", ["plant", "planner", Recorder], QUICK) as stack:
            stack.fly_to(x=0.03, rotvec=(0.0, 0.01, 0.0))
            flown.append(stack.nodes["positions"].found)
    count = min(map(len, flown))
    assert count > 50
    np.testing.assert_array_equal(flown[0][:count], flown[1][:count])


def test_a_controller_flies_without_a_planner() -> None:
    with Stack("planar_manipulator", ["plant", "coordinated_control"]) as stack:
        assert stack.fly_to(x=0.1, y=0.1).reached


def test_what_does_not_happen_in_time_is_an_error() -> None:
    with (
        Stack("sliding_masses", ["plant", "planner"], timeout=0.5) as stack,
        pytest.raises(SpaceRobotError, match=r"more than 0\.5 s"),
    ):
        stack.spin_until(lambda: False)


def test_two_stacks_have_domains_of_their_own() -> None:
    with Stack("sliding_masses") as one, Stack("sliding_masses") as other:
        assert one.domain != other.domain
        assert one.fly_to(x=0.01).reached
        assert other.fly_to(x=0.02).reached


def test_a_refused_robot_leaves_no_node() -> None:
    with pytest.raises(ParameterError, match="no_such"):
        Stack("no_such")
    with pytest.raises(SpaceRobotError, match="tick_rate"):
        Stack("sliding_masses", parameters={"plant": {"tick_rate": -1.0}})
    with free_domain() as domain:
        assert 1 <= domain <= 101


@pytest.mark.slow
def test_the_example_passes(tmp_path: Path) -> None:
    words = ["-m", "pytest", "-q", str(ROOT / "examples" / "test_nodes_in_one_executor.py")]
    done = subprocess.run(
        [sys.executable, *words, "-p", "no:cacheprovider", "--rootdir", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=tmp_path,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
