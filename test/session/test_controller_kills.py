"""Coordinated control killed in mid-manoeuvre and started again: it goes on, the goals are met."""

from __future__ import annotations

import random
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from scipy.spatial.transform import Rotation
from support.killed_flight import (
    KILLS,
    TIMEOUT,
    Away,
    Flight,
    assert_at_rest_while_away,
)
from support.ros_harness import nanoseconds

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.planning import Goal
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.live import ros

pytestmark = pytest.mark.slow

GOAL = Goal.checked([3.0, 2.0, 0.0], Rotation.from_rotvec([0.0, 0.0, 0.8]).as_quat())
TIP = Goal.checked([3.4, 3.3, 0.0], [0.0, 0.0, 0.0, 1.0])
TOLERANCE = 1e-3
TICK = 0.02
BRAKING = 0.4
"""Rates fall by exp(-20 t/s): by a factor of 3000, s."""

REST = 1e-4
"""What is left of joint rates then, and what holds against a base that turns, rad/s."""

MOVING = 100 * REST


@pytest.fixture
def flight(ros_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Flight]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    control = {
        "resume_file": str(tmp_path / "goals.json"),
        "tick_rate": 1 / TICK,
        "profile": "quintic",
        "motion.speed": 0.1,
        "motion.angular_speed": 0.1,
        "position_tolerance": TOLERANCE / 2,
        "attitude_tolerance": TOLERANCE,
        "time_limit": 0.0,
    }
    scenario = (
        replace(load_scenario("coordinated_control"), end_effector_goal=TIP)
        .with_overrides("plant", {"tick_rate": 1 / TICK})
        .with_overrides("coordinated_control", control)
    )
    with ros():
        flight = Flight(tmp_path, scenario)
        try:
            yield flight
        finally:
            flight.stack.close()


def test_a_controller_killed_at_random_moments_goes_on(flight: Flight, tmp_path: Path) -> None:
    rng = random.Random("coordinated_control")
    stack = flight.stack
    commanded = [0]

    def on_wrench(message: WrenchStamped) -> None:
        commanded[0] = nanoseconds(message.header.stamp)

    stack.client.node.create_subscription(WrenchStamped, "base_wrench", on_wrench, STREAM)
    stack.start(GOAL)
    flight.spin((tmp_path / "goals.json").exists, "the goal is flown")
    starts = [0.0]
    for _ in range(KILLS):
        flight.pass_time(rng.uniform(0.1, 2.0))
        assert not flight.decided, f"in mid-manoeuvre: {stack.client.message}"
        starts.append(flight.leave("coordinated_control", timeouts=4)[1])
        flight.spin(lambda: commanded[0] / 1e9 > starts[-1], "it commands again")
    flight.spin(lambda: flight.decided, "the goal is decided")
    assert stack.client.outcome is Outcome.REACHED, stack.client.message
    assert not (tmp_path / "goals.json").exists()
    stack.finish()
    bag = read_bag(flight.bags[0])
    last = bag["/odom"].field
    place = [last(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    attitude = Rotation.from_quat([last(f"pose.pose.orientation.{x}")[-1] for x in "xyzw"])
    tip = [bag["/end_effector_pose"].field(f"pose.position.{x}")[-1] for x in "xyz"]
    assert np.linalg.norm(place - GOAL.position) <= TOLERANCE
    assert np.linalg.norm(tip - TIP.position) <= TOLERANCE
    assert (attitude.inv() * Rotation.from_quat(GOAL.quaternion)).magnitude() <= TOLERANCE
    away = silences(bag, starts)
    assert len(away) > KILLS / 2, "the recorder finds most of them in time"
    assert_at_rest_while_away(bag, away, BRAKING, REST)
    assert_joints_moved_when_it_was_killed(bag, away)
    assert_no_thrust_while_away(bag, away)


def silences(bag: Bag, starts: list[float]) -> Away:
    """Return from its last command to its next start when a controller was silent, s; without
    those of which the recorder had not found the topics yet.
    """
    commands = bag["/base_wrench"].stamp
    lives = [
        (commands[(commands > began) & (commands <= next_start)], next_start)
        for began, next_start in pairwise(starts)
    ]
    return [(float(life[-1]), next_start) for life, next_start in lives if len(life)]


def assert_joints_moved_when_it_was_killed(bag: Bag, away: Away) -> None:
    """There was something to bring to rest."""
    states = bag["/joint_states"]
    speed = np.abs(np.asarray(states.field("velocity"))).max(axis=1)
    assert max(speed[states.stamp <= killed][-1] for killed, _ in away) > MOVING


def assert_no_thrust_while_away(bag: Bag, away: Away) -> None:
    """Momenta do not change from the timeout on: brakes are inner forces."""
    momentum = bag["/momentum"]
    data = np.asarray(momentum.field("data"))[:, :6]
    largest = np.abs(data).max()
    seen = 0
    for killed, started in away:
        chosen = (momentum.stamp > killed + TIMEOUT + 2 * TICK) & (momentum.stamp <= started)
        seen += int(chosen.sum())
        change = data[chosen] - data[chosen][:1]
        assert np.abs(change).max(initial=0.0) <= 1e-12 * largest
    assert seen > KILLS
