"""The nodes as processes of their own, started, signalled and watched from outside."""

from __future__ import annotations

import json
import os
import resource
import signal
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from lifecycle_msgs.srv import GetState
from nav_msgs.msg import Odometry
from support.nodes_apart import START, NodeProcess
from support.ros_harness import Harness, Probe, nanoseconds
from support.sentences import assert_one_sentence
from support.warm_python import WarmPython

from spacerobot_ros.nodes import NODE_TYPES

ROOT = Path(__file__).parents[2]

FAST = {"robot": "sliding_masses", "tick_rate": "20", "real_time_factor": "5.0"}
Start = Callable[..., NodeProcess]


@pytest.fixture
def start(tmp_path: Path, ros_domain: int) -> Iterator[Start]:
    """Return what starts a node in this test's domain; nothing of it outlives the test."""
    processes: list[NodeProcess] = []

    def start(node: str, parameters: dict[str, str], **options: Any) -> NodeProcess:
        process = NodeProcess(tmp_path, ros_domain, node, parameters, **options)
        processes.append(process)
        return process

    try:
        yield start
    finally:
        for process in processes:
            process.kill()


def test_a_bad_start_ends_with_a_sentence_and_exit_code_2(
    warm_python: WarmPython, ros_domain: int, tmp_path: Path
) -> None:
    broken = tmp_path / "broken.urdf"
    broken.write_text("<robot name='half'><link name='base_link'>", "utf-8")
    missing = str(tmp_path / "missing.yaml")
    robot = ("-p", "robot:=sliding_masses")
    cases: list[tuple[str, tuple[str, ...], list[str]]] = [
        ("plant", (*robot, "-p", "tick_rate:=0.0"), ["'tick_rate'"]),
        ("plant", ("-p", f"robot:={broken}"), [str(broken), "not valid URDF"]),
        ("planner", (*robot, "--params-file", missing), [missing]),
        ("recorder", ("-p", f"bag:={tmp_path}"), [str(tmp_path)]),
    ]
    if find_spec("control_msgs") is None:
        cases.append(
            ("planner", (*robot, "-p", "output:=trajectory"), ["'output'", "control_msgs"])
        )
    environment = {**os.environ, "ROS_DOMAIN_ID": str(ros_domain)}
    cases.append(("plant", ("-p", "robott:=sliding_masses"), ["The plant needs a robot"]))
    for node, arguments, mentions in cases:
        words = ("-m", NODE_TYPES[node].__module__, "--ros-args", *arguments)
        ended = warm_python.run(words, ROOT, environment, timeout=START)
        assert ended.returncode == 2, ended.stderr
        assert "Traceback" not in ended.stderr
        # What ROS itself refuses, it says in its own words.
        sentence = ended.stderr.strip().splitlines()[-1].removesuffix(".") + "."
        assert_one_sentence(sentence, *mentions)
    assert "has no parameter 'robott' (did you mean 'robot'?)" in ended.stderr


@pytest.mark.parametrize("node", sorted(NODE_TYPES))
def test_the_help_of_an_executable_names_its_parameters(warm_python: WarmPython, node: str) -> None:
    known = json.loads((ROOT / "test" / "expected" / "parameters.json").read_text("utf-8"))
    words = ("-m", NODE_TYPES[node].__module__, "--help")
    ended = warm_python.run(words, ROOT, dict(os.environ), timeout=START)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("Usage: ros2 run spacerobot_ros")
    assert set(known[node]) <= set(ended.stdout.split())


def test_a_parameter_that_a_node_does_not_have_is_named_with_the_nearest(
    start: Start, tmp_path: Path, harness: Harness
) -> None:
    file = tmp_path / "control.yaml"
    given = {"gains": {"base_positon": {"kp": 1.0}}, "fuel": 2}
    file.write_text(yaml.safe_dump({"coordinated_control": {"ros__parameters": given}}), "utf-8")
    words = ["--params-file", str(file), "-p", "use_sim_time:=false"]
    process = start("coordinated_control", {}, arguments=words)
    harness.spin_until(lambda: "[WARN]" in process.said, "a warning", timeout=START)
    (warning,) = (line for line in process.said.splitlines() if line.startswith("[WARN]"))
    named = "'gains.base_positon.kp'", "'gains.base_position.kp'", "'fuel'"
    assert_one_sentence(warning.partition("]: ")[2], *named)


@pytest.mark.parametrize(
    "node", ["planner", pytest.param("coordinated_control", marks=pytest.mark.slow)]
)
def test_a_commander_without_a_robot_says_once_what_it_waits_for(
    start: Start, harness: Harness, node: str
) -> None:
    process = start(node, {})
    harness.spin_until(lambda: "goals on '/goal_pose'" in process.said, "it is up", timeout=START)
    assert process.said.count("Waiting for a robot on 'robot_description'.") == 1


def await_nodes(harness: Harness, probe: Probe, processes: list[NodeProcess]) -> None:
    """Wait until every process answers as a node that is active."""
    for process in processes:
        await_node(harness, probe, process)


def await_node(harness: Harness, probe: Probe, process: NodeProcess) -> None:
    client = probe.create_client(GetState, f"{process.name}/get_state")
    harness.spin_until(
        lambda: process.process.poll() is not None or client.service_is_ready(),
        f"{process.name} is up",
        timeout=START,
    )
    assert process.process.poll() is None, process.said
    state = harness.call(client, GetState.Request()).current_state
    assert state.label == "active", process.said


@pytest.mark.slow
def test_a_plant_that_is_killed_and_started_again_is_one_clock(
    start: Start, harness: Harness, tmp_path: Path
) -> None:
    probe = harness.probe({"odom": Odometry})
    recorder = start("recorder", {"bag": str(tmp_path / "flight.mcap"), "flush_period": "0.1"})
    plant = start("plant", FAST)
    await_nodes(harness, probe, [recorder, plant])
    # So late that the probe meets the next plant before that time.
    late = 40.0
    harness.spin_until(lambda: stamp_of(probe) > late, "some seconds of flight")
    plant.signal(signal.SIGKILL)
    plant.end()
    start("plant", FAST)
    harness.spin_until(lambda: stamp_of(probe) < late, "the plant again", timeout=START)
    # The middleware lists the killed one, too, until its lease is over.
    assert probe.count_publishers("/clock") == 2
    harness.spin_until(lambda: stamp_of(probe) > late, "ten looks of the recorder")
    assert "clock" not in recorder.said, recorder.said


def stamp_of(probe: Probe) -> float:
    """Return the stamp of the last state, s; 0 before the first."""
    states = probe.messages["odom"]
    return nanoseconds(states[-1].header.stamp) / 1e9 if states else 0.0


@pytest.mark.slow
def test_a_full_disk_ends_the_recording_and_nothing_else(
    start: Start, harness: Harness, tmp_path: Path
) -> None:
    # A file may not grow beyond this: what a full disk looks like to the process.
    room = 40_000

    def prepare() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    bag = tmp_path / "flight.mcap"
    probe = harness.probe({"odom": Odometry})
    recorder = start("recorder", {"bag": str(bag), "flush_period": "0.1"}, prepare=prepare)
    plant = start("plant", {**FAST, "real_time_factor": "20"})
    await_nodes(harness, probe, [recorder, plant])
    harness.spin_until(lambda: "has ended" in recorder.said, "the sentence", timeout=START)
    count = probe.count("odom")
    harness.spin_until(lambda: probe.count("odom") >= count + 200, "the flight goes on")
    for process in (plant, recorder):
        assert process.process.poll() is None, process.said
        process.signal(signal.SIGTERM)
    assert plant.end() == 0, plant.said
    assert recorder.end() == 1, "its bag is cut short"
    (sentence,) = (line for line in recorder.said.splitlines() if "has ended" in line)
    assert_one_sentence(sentence, str(bag))
    assert "Traceback" not in recorder.said


def test_two_nodes_with_one_name_warn_each_other(start: Start, harness: Harness) -> None:
    first = start("plant", FAST)
    probe = harness.probe({"heartbeat": DiagnosticStatus})
    harness.spin_until(lambda: probe.count("heartbeat") > 5)
    assert "Another node" not in first.said
    second = start("plant", {"robot": "planar_manipulator"})
    warning = "Another node '/plant' runs in this ROS domain"
    harness.spin_until(lambda: warning in first.said and warning in second.said, timeout=START)
