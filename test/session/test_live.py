"""Flights by the nodes, and stacks that stay up, through the command."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from support.awaited import processes_with
from support.nodes_apart import NodesApart
from support.raw_messages import iterate_raw
from support.ros_harness import LATCHED, Harness
from support.warm_python import WarmProcess, WarmPython

from spacerobot_ros import __version__
from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import ParameterError, RecordingError, SpaceRobotError
from spacerobot_ros.flight.reading import read_run
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.progress import report_progress
from spacerobot_ros.planning.execution.executive import Executive
from spacerobot_ros.planning.execution.status import PlannerState, PlannerStatus
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import Scenario, load_scenario
from spacerobot_ros.session.live import ros, send_goal
from spacerobot_ros.session.processes import MultiProcessStack, checked_namespace
from spacerobot_ros.session.run import run_scenario
from spacerobot_ros.testing import Stack

ROOT = Path(__file__).parents[2]
COMMAND = ("-m", "spacerobot_ros.cli.main")
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
        files = ("--bag", f"{name}.mcap", "--json", str(json_file))
        run = spacerobot("run", "planar_chain", *words, *files)
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
        found = processes_with(f"ROS_DOMAIN_ID={domain}", f"__node:={node}\0")
        for pid in found.keys() - {other}:
            return pid
    raise AssertionError(f"no process of {node}")


def test_a_planner_that_dies_is_started_again_within_the_limit(
    spacerobot: Command, ros_domain: int
) -> None:
    with spacerobot.start("up", "sliding_masses", "--restarts", "1") as robot:
        assert robot.stdout is not None
        lines = iter(robot.stdout.readline, "")
        next(line for line in lines if "Waiting for a goal pose" in line)
        first = pid_of("planner", ros_domain)
        # Fast DDS replaces shared memory that is not read for a second, and its reader is deaf.
        assert "fastrtps_port" not in Path(f"/proc/{first}/maps").read_text()
        os.kill(first, signal.SIGKILL)
        killed = "Node 'planner' was ended by SIGKILL."
        assert next(line for line in lines if "SIGKILL" in line).strip() == (
            f"{killed} It is restarted."
        )
        os.kill(pid_of("planner", ros_domain, first), signal.SIGKILL)
        rest = "".join(lines)
        assert f"{killed} It was restarted once within a minute" in rest
        assert robot.wait(PATIENCE) == 2


@pytest.mark.study  # In real time, which a busy machine does not keep.
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
    gait = {"method": "lie_bracket", "lie_bracket.t1": 4, "lie_bracket.cycles": 0}
    gait |= {"attitude_tolerance": 0.001, "position_tolerance": 0.001}
    settings = [word for key in gait for word in ("--set", f"planner.{key}={gait[key]}")]
    words = ("up", "sliding_masses", "--rate", "5", "--bag", "up.mcap", *settings)
    with spacerobot.start(*words) as process:
        yield process


@pytest.mark.slow
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
    again = spacerobot("goal", "0.02", "0", "0", "--rotvec", "0", "0", "0.01")
    assert again.returncode == 0, again.stdout + again.stderr
    assert "Executing" in again.stdout
    stopped = spacerobot("request", "stop")
    assert (stopped.returncode, stopped.stderr) == (0, "")
    latched = spacerobot("goal", "0", "0", "0")
    assert latched.returncode == 1
    assert "is latched: stopped on request" in latched.stdout
    rearmed = spacerobot("request", "rearm")
    assert (rearmed.returncode, rearmed.stderr) == (0, "")
    nothing = spacerobot("request", "abort")
    assert (nothing.returncode, nothing.stderr) == (1, ""), "there is no goal"
    assert nothing.stdout.count("\n") == 1
    nobody = spacerobot("request", "hold")
    assert nobody.returncode == 2
    assert nobody.stderr.startswith("No node offered 'replay/pause' within 10 s")
    robot.send_signal(signal.SIGINT)
    assert robot.wait(PATIENCE) == 0
    assert robot.stdout is not None
    assert "The goal is reached" in robot.stdout.read()
    bag = read_bag(tmp_path / "up.mcap")
    last = [bag["/odom"].field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    np.testing.assert_allclose(last, [0.02, 0.0, 0.0], atol=1e-3)


@pytest.mark.slow
def test_a_goal_for_the_link_of_a_controller_arrives_by_its_name(
    spacerobot: Command, tmp_path: Path
) -> None:
    """The servicer's, which has another name; of a link that is not controlled, none arrives."""
    named = robot_file("servicer").read_text("utf-8")
    (tmp_path / "servicer.urdf").write_text(named.replace("end_effector", "tool_tip"))
    text = load_scenario("servicer").path.read_text("utf-8")
    text = text.replace("robot: servicer", "robot: servicer.urdf")
    (tmp_path / "own.yaml").write_text(
        text.replace("law:", "end_effector_frame: tool_tip\n    law:")
    )
    hand = ["2.28", "1.85", "0.79", *map(str, Rotation.from_rotvec([-0.56, 0.95, 1.05]).as_quat())]
    base = ["1", "0.4", "-0.2", *map(str, Rotation.from_rotvec([0.1, -0.2, 0.5]).as_quat())]
    words = ("--end-effector-goal", *hand, "--end-effector")
    # In lockstep, a busy machine loses no state.
    up = ("up", "own.yaml", "--set", "plant.time_mode=lockstep", "--bag", "up.mcap")
    with spacerobot.start(*up) as robot:
        reached = spacerobot("goal", *base, *words, "tool_tip", "--timeout", "60")
        assert reached.returncode == 0, reached.stdout + reached.stderr
        other = spacerobot("goal", *words, "wrist_roll_link", "--timeout", "3")
        assert other.returncode == 2, other.stdout + other.stderr
        assert "or the controller's end_effector_frame" in other.stderr
        robot.send_signal(signal.SIGINT)
        assert robot.wait(PATIENCE) == 0
    bag = read_bag(tmp_path / "up.mcap")
    last = [bag["/end_effector_pose"].field(f"pose.position.{x}")[-1] for x in "xyz"]
    left = float(np.linalg.norm(np.array(last) - [2.28, 1.85, 0.79]))
    assert left < 1e-3
    error = read_run(tmp_path / "up.mcap").end_effector_error
    assert error is not None
    assert error.distance == pytest.approx(left, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["sliding_masses", "coordinated_control"])
def test_a_run_whose_goal_another_one_replaces_says_so_and_has_not_reached_it(
    spacerobot: Command, tmp_path: Path, scenario: str
) -> None:
    """With a planner, and with a controller that pursues a goal of base and end-effector."""
    slow = ["--realtime", "0.2", "--json", "result.json"]
    with spacerobot.start("run", scenario, *slow, "--bag", "run.mcap") as run:
        assert run.stdout is not None
        next(line for line in iter(run.stdout.readline, "") if line.startswith("flying"))
        goal = spacerobot("goal", "0.02", "0.01", "0", "0", "0", "0", "1", "--timeout", "30")
        assert goal.returncode == 1, goal.stdout + goal.stderr
        said = run.stdout.read()
        assert run.wait(PATIENCE) == 1, said
    assert "Aborted: replaced by goal " in said
    result = json.loads((tmp_path / "result.json").read_text("utf-8"))
    assert (result["state"], result["succeeded"]) == ("aborted", False)


@pytest.mark.parametrize(
    ("seconds", "told"),
    [
        ("0.5", ""),
        ("1.5", "Waiting for a planner or a controller on '/robot_1/goal_pose'"),
        pytest.param("10.5", "Waiting for a planner", marks=pytest.mark.slow),
    ],
)
def test_a_goal_that_nobody_takes_is_one_sentence(
    spacerobot: Command, seconds: str, told: str
) -> None:
    run = spacerobot("goal", "0", "0", "0", "--timeout", seconds, "--namespace", "robot_1")
    assert run.returncode == 2
    assert run.stdout.startswith(told)
    assert run.stdout.count("\n") == bool(told)
    assert run.stderr.count("\n") == 1
    assert f"within {seconds} s" in run.stderr
    assert "spacerobot up" in run.stderr


@dataclass
class Listener:
    """A planner that only listens to goals, beside a clock that stands still."""

    harness: Harness

    def __post_init__(self) -> None:
        self.node = self.harness.probe({}, name="planner")
        self._status = self.node.create_publisher(DiagnosticStatus, "planner/status", LATCHED)
        clock = self.node.create_publisher(Clock, "/clock", 10)
        time = Clock(clock=Time(sec=5))
        self.node.create_timer(0.01, lambda: clock.publish(time))

    def decide(self, goal: PoseStamped) -> None:
        """Report that a goal is reached."""
        status = PlannerStatus(PlannerState.REACHED, "Reached.", goal_id=goal_id(goal))
        self._status.publish(
            DiagnosticStatus(
                message=status.message,
                values=[KeyValue(key=k, value=v) for k, v in status.to_values().items()],
            )
        )


def goal_id(goal: PoseStamped) -> str:
    return f"{goal.header.stamp.sec}.{goal.header.stamp.nanosec:09d}"


def test_a_goal_waits_for_a_planner_that_is_known_rather_than_for_its_controller(
    spacerobot: Command, harness: Harness
) -> None:
    """A controller leaves the goals to the planner and says nothing about them."""
    planner = Listener(harness)
    controller = harness.probe({"goal_pose": PoseStamped}, name="coordinated_control")
    controller.create_publisher(DiagnosticStatus, "controller/status", LATCHED)
    with spacerobot.start("goal", "1", "0", "0", "--timeout", "30") as goal:
        assert goal.stdout is not None
        next(line for line in iter(goal.stdout.readline, "") if line.startswith("Waiting for a"))
        planner.node.react["goal_pose"] = planner.decide
        planner.node.watch("goal_pose", PoseStamped)
        harness.spin_until(lambda: goal.poll() is not None, timeout=PATIENCE)
        assert goal.wait(PATIENCE) == 0, goal.stdout.read()


def test_goals_that_two_commands_send_at_the_same_simulated_time_are_two(
    spacerobot: Command, harness: Harness
) -> None:
    planner = Listener(harness)
    planner.node.watch("goal_pose", PoseStamped)
    goals = planner.node.messages["goal_pose"]
    words = ("goal", "1", "0", "0", "--timeout", "30")
    with spacerobot.start(*words) as first, spacerobot.start(*words) as second:
        harness.spin_until(lambda: len(goals) == 2, timeout=PATIENCE)
        for goal in goals:
            planner.decide(goal)
        harness.spin_until(lambda: None not in (first.poll(), second.poll()), timeout=PATIENCE)
        assert (first.wait(), second.wait()) == (0, 0)
    assert len(set(map(goal_id, goals))) == 2


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


def test_a_second_stack_in_a_domain_leaves_the_first_one_alone(
    spacerobot: Command, apart: NodesApart
) -> None:
    apart.start("plant", robot="sliding_masses")
    assert apart.life("plant") == "active"
    run = spacerobot("run", "planar_chain", "--nodes")
    assert run.returncode == 2
    assert run.stderr.splitlines()[-1] == (
        f"Node '/plant' already runs in ROS domain {apart.domain}: end its stack, or set "
        "ROS_DOMAIN_ID to another number."
    )
    apart.end()


@pytest.mark.slow
def test_a_viewer_in_the_domain_is_no_other_stack(spacerobot: Command, apart: NodesApart) -> None:
    apart.start("viewer", port=0)
    assert apart.life("viewer") == "active"
    run = spacerobot("run", "planar_chain", "--nodes")
    assert run.returncode == 0, run.stdout + run.stderr


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
    """Return the messages on each topic as texts.

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


SHORT = {
    "method": "lie_bracket",
    "lie_bracket.t1": 5.0,
    "lie_bracket.cycle_period": 1.0,
    "lie_bracket.cycles": 0,
}


def short(**settings: Any) -> Scenario:
    """Return a flight of about ten seconds that moves and turns the base."""
    scenario = load_scenario("sliding_masses").with_overrides("planner", {**SHORT, **settings})
    return replace(scenario, goal=Goal.from_rotvec([0.02, -0.01, 0.01], [0.02, 0.01, -0.015]))


def papers_own() -> Scenario:
    """Return the published flight of 4900 s."""
    return load_scenario("sliding_masses").with_overrides("planner", {"method": "lie_bracket"})


def test_a_bag_lacks_nothing_and_says_how_it_was_made(tmp_path: Path) -> None:
    result = run_scenario(short(attitude_tolerance=1e-4), tmp_path / "run.mcap")
    bag = read_bag(result.summary["bag"])
    ticks = result.summary["ticks"]
    # The scenario asks for base_pose once a second, that is every 20 ticks.
    assert len(bag["/base_pose"].time) == ticks // 20 + 1
    for topic in ("/clock", "/odom", "/joint_states", "/momentum"):
        times = bag[topic].time
        assert len(times) == ticks + 1, topic
        np.testing.assert_allclose(times, np.arange(ticks + 1) * 0.05, atol=1e-9)
    np.testing.assert_allclose(bag["/odom"].stamp, bag["/odom"].time, atol=1e-9)
    assert bag.metadata["scenario"]["name"] == "sliding_masses"
    assert json.loads(bag.metadata["parameters/plant"]["tick_rate"]) == 20.0
    assert json.loads(bag.metadata["parameters/planner"]["lie_bracket.t1"]) == 5.0
    assert bag.metadata["spacerobot"]["version"] == __version__
    assert b'<robot name="sliding_masses">' in bag.attachments["robot_description.urdf"]


def test_two_runs_are_the_same_to_the_last_message(tmp_path: Path) -> None:
    bags = [tmp_path / f"{i}.mcap" for i in range(2)]
    for bag in bags:
        run_scenario(short(), bag)
    first, second = ([each[:4] for each in iterate_raw(bag)] for bag in bags)
    assert len(first) > 500
    assert first == second
    # Padding is not initialised, so that bytes may differ.
    assert messages(bags[0]) == messages(bags[1])


def test_interrupted_run_leaves_a_complete_bag(tmp_path: Path) -> None:
    """The signal comes from the run's own progress, so it hits in mid-flight for certain."""
    looks = []

    def progress(now: float, end: float) -> None:
        looks.append(now)
        if now > 0 and len(looks) < 50:
            os.kill(os.getpid(), signal.SIGINT)

    result = run_scenario(papers_own(), tmp_path / "run.mcap", progress)
    assert result.summary["state"] == "interrupted"
    assert not result.succeeded
    assert result.summary["verdict"] == result.message
    assert 0 < result.summary["sim_time_s"] < 4900
    assert read_bag(tmp_path / "run.mcap").message_count("/odom") == result.summary["ticks"] + 1


def test_a_plan_that_is_being_made_is_interrupted(tmp_path: Path) -> None:
    """The signal comes from the search's own progress."""
    scenario = load_scenario("sliding_masses").with_overrides("planner", {"optimal.cache": 0})
    with report_progress(lambda progress: os.kill(os.getpid(), signal.SIGINT), lambda line: None):
        result = run_scenario(scenario, tmp_path / "run.mcap")
    assert result.summary["state"] == "interrupted"
    assert result.message == "Interrupted after 0 s of simulated time."
    assert read_bag(tmp_path / "run.mcap").message_count("/odom") == 1


def test_a_run_takes_the_next_name_if_its_recorder_is_to(tmp_path: Path) -> None:
    bag = tmp_path / "run.mcap"
    bag.write_bytes(b"earlier")
    with pytest.raises(RecordingError, match="exists"):
        run_scenario(short(), bag)
    following = short().with_overrides("recorder", {"when_exists": "next"})
    assert run_scenario(following, bag, longest=1.0).summary["bag"] == str(tmp_path / "run-1.mcap")
    assert bag.read_bytes() == b"earlier"


@pytest.mark.slow
def test_the_published_manoeuvre(tmp_path: Path) -> None:
    """4900 s: the end state that was recomputed at high accuracy from the printed controls."""
    result = run_scenario(papers_own(), tmp_path / "run.mcap")
    summary = result.summary
    attitude = np.array(summary["final_attitude_rotvec_rad"])
    position = np.array(summary["final_position_m"])
    assert np.abs(attitude - [0.55055, -0.14255, 0.09554]).max() <= 0.002
    assert np.abs(position - [0.30135, -0.25412, 0.08435]).max() <= 0.002
    zf = [-2.378408, 1.687252, -1.377082]
    np.testing.assert_allclose(summary["final_joint_positions"], zf, atol=1e-4)
    np.testing.assert_allclose(summary["gait"]["c"], [-0.047568, 0.033745, -0.027542], atol=1e-6)
    np.testing.assert_allclose(summary["gait"]["alpha"], [-0.84377, -61.0928, -18.8194], atol=1e-4)
    assert summary["sim_time_s"] == pytest.approx(4900.0)
    assert summary["ticks"] == 98_000
    assert summary["momentum_drift"] <= 1e-12
    assert result.succeeded


@pytest.mark.parametrize("error", [RuntimeError("the gait is no number"), MemoryError()])
def test_a_run_whose_commander_fails_ends_with_the_reason_and_a_whole_bag(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    """The bag has the states and commands until then."""
    update, states = Executive.update, iter(range(1000))

    def failing(self: Executive, measured: Any) -> Any:
        if next(states) == 40:
            raise error
        return update(self, measured)

    monkeypatch.setattr(Executive, "update", failing)
    with pytest.raises(SpaceRobotError, match=rf"has failed at 2 s: {type(error).__name__}"):
        run_scenario(short(), tmp_path / "run.mcap")
    bag = read_bag(tmp_path / "run.mcap")
    with AnyReader([bag.path]) as reader:
        counts = {c.topic: c.msgcount for c in reader.connections}
    assert counts["/joint_states"] == 41
    assert counts["/joint_commands"] == 40
    assert (tmp_path / "run.mcap").read_bytes().endswith(b"\x89MCAP0\r\n")


# -- stacks of nodes in one executor -----------------------------------------------------------

QUICK = {"planner": {"method": "optimal"}}


class Recorder(rclpy.node.Node):
    """Keeps the positions of the base."""

    def __init__(self, context: rclpy.Context) -> None:
        super().__init__("positions", context=context)
        self.found: list[float] = []
        self.create_subscription(
            Odometry, "odom", lambda odom: self.found.append(odom.pose.pose.position.x), 100
        )


def test_a_goal_is_reached_by_the_same_states_every_time_and_another_one_refused() -> None:
    flown = []
    for _ in range(2):
        with Stack("sliding_masses", ["plant", "planner", Recorder], QUICK) as stack:
            arrival = stack.fly_to(x=0.03, rotvec=(0.0, 0.01, 0.0))
            assert arrival.reached
            assert "The goal is reached" in arrival.message
            flown.append(list(stack.nodes["positions"].found))
            refused = stack.fly_to(Goal.from_rotvec([9.0, 0.0, 0.0], [0.0, 0.0, 0.0]))
            assert (refused.reached, refused.outcome) == (False, Outcome.REFUSED)
    assert flown[0][-1] == pytest.approx(0.03, abs=0.02)
    count = min(map(len, flown))
    assert count > 50
    np.testing.assert_array_equal(flown[0][:count], flown[1][:count])


def test_a_controller_flies_without_a_planner() -> None:
    with Stack("planar_manipulator", ["plant", "coordinated_control"]) as stack:
        assert stack.fly_to(x=0.1, y=0.1).reached


def test_a_stack_has_the_commanders_of_its_scenario_and_takes_goals_as_numbers() -> None:
    with Stack("jet_cube") as stack:
        assert set(stack.nodes) == {"plant", "coordinated_control"}
        assert stack.fly_to([0.01, 0.02, 0.0]).reached
        plant = stack.nodes["plant"].plant
        np.testing.assert_allclose(plant.pose[:3], [0.01, 0.02, 0.0], atol=1e-3)
        assert stack.fly_to([0.0, 0.02, 0.0, 0.0, 0.0, 0.0, 1.0], x=0.01, y=0.01).reached
        np.testing.assert_allclose(plant.pose[:3], [0.01, 0.01, 0.0], atol=1e-3)


def test_the_bag_of_a_stack_is_complete_when_the_stack_is_closed(tmp_path: Path) -> None:
    bag, nodes = tmp_path / "a.mcap", ["plant", "planner", "recorder"]
    with Stack("sliding_masses", nodes, QUICK | {"recorder": {"bag": str(bag)}}) as stack:
        assert stack.fly_to(x=0.03).reached
    assert len(read_bag(bag)["/goal_pose"].time_ns) == 1
    assert verify_bag(bag).difference is None


def test_a_started_stack_flies_to_the_goals_of_other_nodes() -> None:
    reached: list[DiagnosticStatus] = []
    with Stack("sliding_masses", ["plant", "planner", Recorder], QUICK) as stack:
        own = stack.nodes["positions"]
        own.create_subscription(DiagnosticStatus, "planner/status", reached.append, LATCHED)
        goals = own.create_publisher(PoseStamped, "goal_pose", 10)
        stack.start()
        goal = PoseStamped()
        goal.pose.position.x = 0.03
        goal.pose.orientation.w = 1.0
        goals.publish(goal)
        stack.spin_until(lambda: any("is reached" in each.message for each in reached))
        assert own.found[-1] == pytest.approx(0.03, abs=0.02)


@pytest.mark.slow
def test_endpoints_of_a_stack_that_cannot_meet_are_named() -> None:
    with Stack("sliding_masses", ["plant", "planner", Recorder], timeout=20.0) as stack:
        best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        stack.nodes["positions"].create_publisher(PoseStamped, "goal_pose", best_effort)
        with pytest.raises(SpaceRobotError, match=r"quality of service: /goal_pose\."):
            stack.start()


def test_what_does_not_happen_in_time_is_an_error() -> None:
    with (
        Stack("sliding_masses", ["plant", "planner"], timeout=0.5) as stack,
        pytest.raises(SpaceRobotError, match=r"more than 0\.5 s"),
    ):
        stack.spin_until(lambda: False)


def test_a_goal_without_an_outcome_says_what_is_missing() -> None:
    with (
        Stack("sliding_masses", ["planner"], timeout=3.0) as stack,
        pytest.raises(SpaceRobotError, match=r"no outcome: .*'joint_states'.* more than 3 s"),
    ):
        stack.fly_to(x=0.05)
    with (
        Stack("planar_manipulator", ["plant"], timeout=1.0) as stack,
        pytest.raises(SpaceRobotError, match=r"No planner or controller has reported on it\."),
    ):
        stack.fly_to(x=0.05)


@pytest.mark.parametrize(
    ("nodes", "parameters", "named"),
    [
        (["plant", "planer"], {}, "no node 'planer'. Did you mean 'planner'"),
        (["plant", "planner"], {"planer": {"method": "optimal"}}, "'planer', which is not in"),
        (["plant", "plant", "planner"], {}, "Two of the nodes are named 'plant'"),
        (["plant", Recorder, Recorder], {}, "Two of the nodes are named 'positions'"),
        (["plant", lambda context: None], {}, "returned None"),
    ],
)
def test_mistakes_in_the_nodes_of_a_stack_are_named(
    nodes: list[Any], parameters: dict[str, Any], named: str
) -> None:
    with pytest.raises(SpaceRobotError, match=re.escape(named)):
        Stack("sliding_masses", nodes, parameters)


def test_a_node_in_another_context_is_refused() -> None:
    other = rclpy.Context()
    rclpy.init(context=other)
    try:
        with pytest.raises(SpaceRobotError, match="another rclpy context"):
            Stack("sliding_masses", ["plant", lambda _: rclpy.node.Node("mine", context=other)])
    finally:
        rclpy.shutdown(context=other)


@pytest.mark.parametrize(
    ("trigger", "state"), [("cleanup", "unconfigured"), ("shutdown", "finalized")]
)
def test_a_goal_for_a_node_that_cannot_be_activated_names_its_state(
    trigger: str, state: str
) -> None:
    with Stack("sliding_masses") as stack:
        getattr(stack.nodes["planner"], f"trigger_{trigger}")()
        with pytest.raises(SpaceRobotError, match=f"'planner' cannot activate: .*'{state}'"):
            stack.fly_to(x=0.05)


def test_two_stacks_have_domains_of_their_own() -> None:
    with Stack("sliding_masses") as one, Stack("sliding_masses") as other:
        assert one.domain != other.domain
        assert one.fly_to(x=0.01).reached
        assert other.fly_to(x=0.02).reached


def test_a_robot_and_a_parameter_that_are_none_are_refused() -> None:
    with pytest.raises(ParameterError, match="no_such"):
        Stack("no_such")
    with pytest.raises(SpaceRobotError, match="tick_rate"):
        Stack("sliding_masses", parameters={"plant": {"tick_rate": -1.0}})


@pytest.mark.slow
def test_the_example_passes(tmp_path: Path) -> None:
    words = ["-m", "pytest", "-q", str(ROOT / "examples" / "test_nodes_in_one_executor.py")]
    done = subprocess.run(
        [sys.executable, *words, "-p", "no:cacheprovider", "--rootdir", str(tmp_path)],
        env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=tmp_path,
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout
