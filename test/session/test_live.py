"""Flights by the nodes, and stacks that stay up, through the command."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore
from support.warm_python import WarmProcess, WarmPython

from spacerobot_ros.bag import iterate_raw, read_bag
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning import Goal
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.live import ros, send_goal
from spacerobot_ros.session.processes import MultiProcessStack, checked_namespace
from spacerobot_ros.session.run import run_scenario

ROOT = Path(__file__).parents[2]
COMMAND = ("-m", "spacerobot_ros.cli.main")
GAIT = (
    *("--set", "planner.method=lie_bracket"),
    *("--set", "planner.lie_bracket.t1=4", "--set", "planner.lie_bracket.cycles=0"),
    *("--set", "planner.attitude_tolerance=0.001", "--set", "planner.position_tolerance=0.001"),
)
PATIENCE = 120.0


class Command:
    """The command ``spacerobot`` in a folder and a ROS domain."""

    def __init__(self, python: WarmPython, environment: dict[str, str], folder: Path) -> None:
        self._python, self._environment, self._folder = python, environment, folder

    def __call__(self, *words: str) -> subprocess.CompletedProcess[str]:
        return self._python.run(
            [*COMMAND, *words], self._folder, self._environment, timeout=PATIENCE
        )

    def start(self, *words: str) -> WarmProcess:
        return self._python.start(
            [*COMMAND, *words],
            self._folder,
            self._environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )


@pytest.fixture
def spacerobot(warm_python: WarmPython, ros_domain: int, tmp_path: Path) -> Command:
    # The commands run elsewhere, where their files are to go.
    environment = {**os.environ, "ROS_DOMAIN_ID": str(ros_domain), "PYTHONPATH": str(ROOT)}
    return Command(warm_python, environment, tmp_path)


@pytest.mark.slow
def test_each_node_in_a_process_of_its_own_flies_the_same_manoeuvre(
    spacerobot: Command, tmp_path: Path
) -> None:
    results = []
    for name, words in (("one", ()), ("many", ("--nodes",))):
        json_file = tmp_path / f"{name}.json"
        run = spacerobot(
            *("run", "planar_chain", *words, "--bag", f"{name}.mcap", "--json", str(json_file)),
        )
        assert run.returncode == 0, run.stderr
        results.append(json.loads(json_file.read_text("utf-8")))
    one, many = results
    assert one["succeeded"]
    assert many["succeeded"]
    assert many["manoeuvre_time_s"] == one["manoeuvre_time_s"]
    # The controller goes on until it is heard to have arrived, a tick or two longer.
    for key in ("final_attitude_rotvec_rad", "final_joint_positions"):
        np.testing.assert_allclose(many[key], one[key], atol=1e-6)
    bag = read_bag(tmp_path / "many.mcap")
    assert bag.message_count("/odom") == many["ticks"] + 1, "from the first state on, none lost"
    assert bag.metadata["scenario"]["name"] == "planar_chain"


def pid_of(node: str, domain: int, other: int = 0) -> int:
    """Return the process of a node in a ROS domain that is not another one, once there is one."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                ours = f"ROS_DOMAIN_ID={domain}\0" in (folder / "environ").read_text()
                named = f"__node:={node}\0" in (folder / "cmdline").read_text()
                if ours and named and int(folder.name) != other:
                    return int(folder.name)
    raise AssertionError(f"no process of {node}")


def test_a_planner_that_dies_is_started_again_within_the_limit(
    spacerobot: Command, ros_domain: int
) -> None:
    with spacerobot.start("up", "sliding_masses", "--restarts", "1") as robot:
        assert robot.stdout is not None
        lines = iter(robot.stdout.readline, "")
        next(line for line in lines if "Waiting for a goal pose" in line)
        first = pid_of("planner", ros_domain)
        environment = Path(f"/proc/{first}/environ").read_text()
        assert "FASTDDS_BUILTIN_TRANSPORTS=UDPv4" in environment
        os.kill(first, signal.SIGKILL)
        killed = "Node 'planner' was ended by SIGKILL."
        assert next(line for line in lines if "SIGKILL" in line).strip() == (
            f"{killed} It is started again."
        )
        os.kill(pid_of("planner", ros_domain, first), signal.SIGKILL)
        rest = "".join(lines)
        assert f"{killed} It was started again once within a minute" in rest
        assert robot.wait(PATIENCE) == 2


@pytest.mark.slow  # In real time, which a busy machine does not keep.
def test_a_robot_that_is_up_reports_changes_and_not_each_number(spacerobot: Command) -> None:
    settings = ("--rate", "5", "--set", "coordinated_control.time_limit=8")
    with spacerobot.start("up", "coordinated_control", *settings) as robot:
        assert robot.stdout is not None
        lines = iter(robot.stdout.readline, "")
        next(line for line in lines if "Waiting for a goal; holding" in line)
        missed = spacerobot("goal", "0.5", "0.3", "0")
        assert missed.returncode == 1, missed.stdout + missed.stderr
        robot.send_signal(signal.SIGINT)
        later = [line.split(";")[0].split(":")[0].strip() for line in lines]
    assert later == ["Flying to the goal", "The goal is not reached in time"]


@pytest.mark.slow
@pytest.mark.usefixtures("own_domain")
def test_a_flight_by_nodes_that_is_interrupted_says_so(tmp_path: Path) -> None:
    scenario = load_scenario("planar_chain").with_overrides("planner", {"method": "square_path"})
    result = run_scenario(scenario, tmp_path / "run.mcap", nodes=True, longest=1.0)
    assert not result.succeeded
    assert result.summary["state"] == "interrupted"
    flown = result.summary["sim_time_s"]
    assert result.message == f"Interrupted after {flown:.6g} s of simulated time."
    assert result.summary["method"] == "square_path"
    assert read_bag(tmp_path / "run.mcap").message_count("/odom") == result.summary["ticks"] + 1


@pytest.fixture
def robot(spacerobot: Command) -> Iterator[WarmProcess]:
    """Sliding masses that are up, five times as fast as real time."""
    words = ("up", "sliding_masses", "--rate", "5", "--bag", "up.mcap", *GAIT)
    with spacerobot.start(*words) as process:
        yield process


def test_goals_are_sent_to_a_robot_that_is_up(
    robot: WarmProcess, spacerobot: Command, tmp_path: Path
) -> None:
    refused = spacerobot("goal", "5", "0", "0")
    assert refused.returncode == 1, refused.stdout + refused.stderr
    assert "stroke" in refused.stdout
    reached = spacerobot("goal", "-0.05", "0.02", "0")
    assert reached.returncode == 0, reached.stdout + reached.stderr
    assert "The goal is reached" in reached.stdout
    # What is latched of the goal before is no answer to the next.
    again = spacerobot(
        *("goal", "0.02", "0", "0", "--rotvec", "0", "0", "0.01"),
    )
    assert again.returncode == 0, again.stdout + again.stderr
    assert "Executing" in again.stdout
    robot.send_signal(signal.SIGINT)
    assert robot.wait(PATIENCE) == 0
    assert robot.stdout is not None
    assert "The goal is reached" in robot.stdout.read()
    bag = read_bag(tmp_path / "up.mcap")
    last = [bag["/odom"].field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    np.testing.assert_allclose(last, [0.02, 0.0, 0.0], atol=1e-3)


def test_a_goal_that_nobody_takes_is_one_sentence(spacerobot: Command) -> None:
    words = ("goal", "0", "0", "0", "--timeout", "0.5")
    run = spacerobot(*words)
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert "after 0.5 s" in run.stderr
    assert "spacerobot up" in run.stderr


@pytest.mark.parametrize(
    ("words", "mention"),
    [
        (("goal", "1", "2"), "X Y Z"),
        (("goal", "0", "0", "0", "0", "0", "0", "0"), "zero quaternion"),
        (("up", "no_such"), "no_such"),
        (("up", "sliding_masses", "--set", "plant.tick_rate=-1"), "tick_rate"),
        (("run", "sliding_masses", "--processes", "--set", "plant.tick_rate=-1"), "tick_rate"),
    ],
)
def test_bad_words_are_refused(spacerobot: Command, words: tuple[str, ...], mention: str) -> None:
    run = spacerobot(*words)
    assert run.returncode == 2, run.stdout + run.stderr
    assert mention in run.stderr
    assert "Traceback" not in run.stderr


# -- stacks in namespaces ----------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.usefixtures("own_domain")
def test_a_stack_in_a_namespace_has_a_clock_and_a_bag_of_its_own(tmp_path: Path) -> None:
    scenario = load_scenario("planar_chain")
    with ros():
        stack = MultiProcessStack(scenario, tmp_path / "a.mcap", "/fleet/one/")
        try:
            stack.start(scenario.goal)
            stack.spin(lambda: False)
            stack.finish()
            assert stack.client.outcome is Outcome.REACHED
        finally:
            stack.close()
    bag = read_bag(tmp_path / "a.mcap")
    outside = {topic for topic in bag.topics if not topic.startswith("/fleet/one/")}
    assert outside <= {"/diagnostics"}
    assert {"/fleet/one/clock", "/fleet/one/tf", "/fleet/one/odom"} <= set(bag.topics)
    assert verify_bag(tmp_path / "a.mcap").difference is None


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


# -- flights of a scenario in lockstep ---------------------------------------------------------

OF_NODES = {"/events", "/plant/status", "/planner/status", "/controller/status", "/diagnostics"}
"""Topics on which nodes also say that they begin, wait and end, at wall times."""

TYPES = get_typestore(Stores.ROS2_JAZZY)


def messages(bag: Path) -> dict[str, list[str]]:
    """Return the messages of each topic as texts.

    When a message has come to the recorder is not compared: nodes do not wait for each other there.
    """
    found = defaultdict(list)
    with np.printoptions(threshold=10**9, floatmode="unique"):
        for topic, kind, _, _, raw in iterate_raw(bag):
            found[topic].append(repr(TYPES.deserialize_cdr(raw, kind)))
    return found


@pytest.mark.slow
@pytest.mark.usefixtures("own_domain")
@pytest.mark.parametrize("name", ["faults/stuck_elbow", "planar_chain"])
def test_every_run_is_the_same(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(name)
    bags = [tmp_path / f"{k}.mcap" for k in range(3)]
    for k, bag in enumerate(bags):
        run_scenario(scenario, bag, nodes=k > 0)
    loop, first, second = map(messages, bags)
    assert loop.keys() == first.keys() == second.keys()
    for topic in loop.keys() - OF_NODES:
        # The last command is under way when the plant stops; last digits of markers differ.
        for other in (second, *([loop] if topic != "/markers" else [])):
            count = min(len(other[topic]), len(first[topic]))
            assert count >= max(len(other[topic]), len(first[topic])) - 1, topic
            assert other[topic][: count - 1] == first[topic][: count - 1], topic
