"""Nodes killed in mid-manoeuvre and started again: each joins in, and the goal is met."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import WrenchStamped
from scipy.spatial.transform import Rotation
from support.awaited import await_end, await_size
from support.ros_harness import nanoseconds

from spacerobot_ros.bag import Bag, RecordingError, read_bag
from spacerobot_ros.bag.salvage import salvage_bag
from spacerobot_ros.measures import Outcome
from spacerobot_ros.nodes.common.node import STREAM
from spacerobot_ros.planning import Goal
from spacerobot_ros.scenario import Scenario, load_scenario
from spacerobot_ros.session.live import ros
from spacerobot_ros.session.processes import MultiProcessStack

KILLS = 20
TIMEOUT = 0.5
"""After which a plant does without commands, simulated s."""

PACE = 4.0
"""Simulated over wall time."""

PATIENCE = 300.0

Away = list[tuple[float, float]]
"""When a node was killed, and when it was started again, simulated s."""


class Flight:
    """A scenario in real time, and what kills and restarts its nodes.

    Parameters
    ----------
    folder
        Of the bags.
    scenario
        What is flown.
    timeout
        After which the plant does without commands, simulated s. Where no commander is killed it
        is longer than any busy machine makes one wait.
    """

    def __init__(self, folder: Path, scenario: Scenario, timeout: float = TIMEOUT) -> None:
        self.folder = folder
        self.bags = [folder / "flight.mcap"]
        plant = {"time_mode": "realtime", "real_time_factor": PACE, "command_timeout": timeout}
        scenario = scenario.with_overrides("plant", plant).with_overrides(
            "recorder", {"flush_period": 0.1}
        )
        self.stack = MultiProcessStack(scenario, self.bags[0])

    def restart(self, name: str) -> None:
        if name == "recorder":
            self.bags.append(self.folder / f"flight_{len(self.bags)}.mcap")
            self.stack.launch(name, bag=str(self.bags[-1]))
        elif name == "plant":
            self.stack.launch(name, resume_bag=str(self.bags[-1]), autostart=True)
        else:
            self.stack.launch(name)

    def leave(self, name: str, timeouts: int = 2) -> tuple[float, float]:
        """Kill a node, start it again after some timeouts, and return when it was away."""
        self.stack.kill(name)
        killed = self.stack.time_ns / 1e9
        self.pass_time(timeouts * TIMEOUT / PACE)
        started = self.stack.time_ns / 1e9
        self.restart(name)
        return killed, started

    def spin(self, condition: Callable[[], Any], what: str) -> None:
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline, what
            self.stack.executor.spin_once(timeout_sec=0.02)

    def pass_time(self, wall: float) -> None:
        end = time.monotonic() + wall
        self.spin(lambda: time.monotonic() >= end, "time")

    @property
    def decided(self) -> bool:
        return self.stack.client.outcome is not None


def whole(path: Path) -> Bag:
    """Read a bag; one whose recorder was killed is salvaged first."""
    try:
        return read_bag(path)
    except RecordingError:
        return read_bag(salvage_bag(path).path)


def assert_at_rest_while_away(bag: Bag, away: Away, braking: float, rest: float = 0.0) -> None:
    """Joints rest (rates up to ``rest``) from the timeout, and ``braking`` (s) after it, until
    their commander is started again.
    """
    states = bag["/joint_states"]
    speed = np.abs(np.asarray(states.field("velocity"))).max(axis=1)
    seen = 0
    for killed, started in away:
        chosen = (states.stamp > killed + TIMEOUT + braking) & (states.stamp <= started)
        seen += int(chosen.sum())
        assert speed[chosen].max(initial=0.0) <= rest
    assert seen > KILLS


TICK = 0.05
LATE = 5.0
"""Wall s within which a commander that was not killed answers on a machine that does other things,
the longest wait for a processor among them. Where it is killed it is given TIMEOUT, simulated."""

GOAL = Goal.checked([0.1, -0.05, 0.02], [0.0, 0.0, 0.1, 0.995])


def scenario(folder: Path) -> Scenario:
    """Sliding masses that take long, and a planner that keeps its goal."""
    planner = {
        "method": "lie_bracket",
        "resume_file": str(folder / "goal.json"),
        "position_tolerance": 1e-3,
        "attitude_tolerance": 1e-3,
        "max_corrections": 10,
        "lie_bracket.t1": 20.0,
        "lie_bracket.cycles": 160,
    }
    return load_scenario("sliding_masses").with_overrides("planner", planner)


@pytest.fixture
def flight(
    ros_domain: int,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    request: pytest.FixtureRequest,
) -> Iterator[Flight]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    with ros():
        commands_end = request.node.callspec.params.get("name") != "recorder"
        timeout = TIMEOUT if commands_end else PACE * LATE
        flight = Flight(tmp_path, scenario(tmp_path), timeout)
        try:
            yield flight
        finally:
            flight.stack.close()


def plant_reasons(bag: Bag) -> set[str]:
    """Return the reasons that the plant has given for what it does."""
    if "/plant/status" not in bag.topics:
        return set()
    said = [
        {pair.key: pair.value for pair in status.values}
        for _, status in bag["/plant/status"].messages()
    ]
    return {values.get("reason", "") for values in said}


def after(stack: MultiProcessStack, time: float) -> Callable[[], bool]:
    return lambda: stack.time_ns > round(time * 1e9)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["planner", "plant", "recorder"])
def test_a_node_killed_at_random_moments_joins_in_again(flight: Flight, name: str) -> None:
    rng = random.Random(name)
    stack = flight.stack
    stack.start(GOAL)
    flight.spin(lambda: stack.client.gait, "the goal is flown")
    away: Away = []
    for _ in range(KILLS):
        flight.pass_time(rng.uniform(0.1, 2.0))
        assert not flight.decided, f"in mid-manoeuvre: {stack.client.message}"
        away.append(flight.leave(name))
        if name == "plant":
            flight.spin(after(stack, away[-1][1]), "time goes on")
        elif name == "planner":
            flight.spin(lambda: stack.client.node.count_publishers("joint_commands"), "it is up")
        else:
            flight.spin(flight.bags[-1].exists, "the next bag")
    flight.spin(lambda: flight.decided, "the goal is decided")
    if name == "recorder":
        grown = flight.bags[-1].stat().st_size + 5000
        flight.spin(lambda: flight.bags[-1].stat().st_size > grown, "the last one records")
    assert stack.client.outcome is Outcome.REACHED, stack.client.message
    stack.finish()
    bags = [whole(bag) for bag in flight.bags]
    last = bags[-1]["/odom"]
    position = [last.field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    assert np.linalg.norm(position - GOAL.position) <= 1e-3
    spoken = [bag for bag in bags if "/joint_states" in bag.topics]
    assert len(spoken) > len(bags) / 2, "few recorders were killed before their first chunk"
    if name == "planner":
        for bag in spoken:
            assert_at_rest_while_away(bag, away, 3 * TICK)
    elif name == "recorder":
        # Nobody else notices: the plant has had a command for every tick.
        reasons = set().union(*map(plant_reasons, spoken))
        assert reasons
        assert reasons <= {"", "no_command"}


# -- coordinated control is killed -------------------------------------------------------------

CONTROL_GOAL = Goal.checked([3.0, 2.0, 0.0], Rotation.from_rotvec([0.0, 0.0, 0.8]).as_quat())
TIP = Goal.checked([3.4, 3.3, 0.0], [0.0, 0.0, 0.0, 1.0])
TOLERANCE = 1e-3
CONTROL_TICK = 0.02
BRAKING = 0.4
"""Rates fall by exp(-20 t/s): by a factor of 3000, s."""

REST = 1e-4
"""What is left of joint rates then, and what holds against a base that turns, rad/s."""

MOVING = 100 * REST


@pytest.fixture
def controlled(
    ros_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Iterator[Flight]:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    control = {
        "resume_file": str(tmp_path / "goals.json"),
        "tick_rate": 1 / CONTROL_TICK,
        "profile": "quintic",
        "motion.speed": 0.1,
        "motion.angular_speed": 0.1,
        "position_tolerance": TOLERANCE / 2,
        "attitude_tolerance": TOLERANCE,
        "time_limit": 0.0,
    }
    scenario = (
        replace(load_scenario("coordinated_control"), end_effector_goal=TIP)
        .with_overrides("plant", {"tick_rate": 1 / CONTROL_TICK})
        .with_overrides("coordinated_control", control)
    )
    with ros():
        flight = Flight(tmp_path, scenario)
        try:
            yield flight
        finally:
            flight.stack.close()


@pytest.mark.slow
def test_a_controller_killed_at_random_moments_goes_on(controlled: Flight, tmp_path: Path) -> None:
    rng = random.Random("coordinated_control")
    stack = controlled.stack
    commanded = [0]

    def on_wrench(message: WrenchStamped) -> None:
        commanded[0] = nanoseconds(message.header.stamp)

    stack.client.node.create_subscription(WrenchStamped, "base_wrench", on_wrench, STREAM)
    stack.start(CONTROL_GOAL)
    controlled.spin((tmp_path / "goals.json").exists, "the goal is flown")
    starts = [0.0]
    for _ in range(KILLS):
        controlled.pass_time(rng.uniform(0.1, 2.0))
        assert not controlled.decided, f"in mid-manoeuvre: {stack.client.message}"
        starts.append(controlled.leave("coordinated_control", timeouts=4)[1])
        controlled.spin(lambda: commanded[0] / 1e9 > starts[-1], "it commands again")
    controlled.spin(lambda: controlled.decided, "the goal is decided")
    assert stack.client.outcome is Outcome.REACHED, stack.client.message
    assert not (tmp_path / "goals.json").exists()
    stack.finish()
    bag = read_bag(controlled.bags[0])
    last = bag["/odom"].field
    place = [last(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    attitude = Rotation.from_quat([last(f"pose.pose.orientation.{x}")[-1] for x in "xyzw"])
    tip = [bag["/end_effector_pose"].field(f"pose.position.{x}")[-1] for x in "xyz"]
    assert np.linalg.norm(place - CONTROL_GOAL.position) <= TOLERANCE
    assert np.linalg.norm(tip - TIP.position) <= TOLERANCE
    assert (attitude.inv() * Rotation.from_quat(CONTROL_GOAL.quaternion)).magnitude() <= TOLERANCE
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
        chosen = (momentum.stamp > killed + TIMEOUT + 2 * CONTROL_TICK) & (
            momentum.stamp <= started
        )
        seen += int(chosen.sum())
        change = data[chosen] - data[chosen][:1]
        assert np.abs(change).max(initial=0.0) <= 1e-12 * largest
    assert seen > KILLS


# -- a supervisor that is killed ---------------------------------------------------------------

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
