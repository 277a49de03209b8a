"""The nodes as processes of their own, started, signalled and watched from outside."""

from __future__ import annotations

import json
import os
import resource
import signal
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml
from diagnostic_msgs.msg import DiagnosticStatus
from support.nodes_apart import START, NodesApart
from support.planner_flight import stamp_of
from support.sentences import assert_one_sentence
from support.warm_python import WarmPython

from spacerobot_ros.nodes import NODE_TYPES

ROOT = Path(__file__).parents[2]

FAST: dict[str, Any] = {"robot": "sliding_masses", "tick_rate": 20, "real_time_factor": 5.0}


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
            (
                "planner",
                (*robot, "-p", "output:=trajectory"),
                ["'output'", "requires the package control_msgs: install it"],
            )
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


@pytest.mark.parametrize("words", [("--bag", "a.mcap"), ("bag:=a.mcap",)])
def test_an_argument_that_ros_would_ignore_is_refused(
    warm_python: WarmPython, tmp_path: Path, words: tuple[str, ...]
) -> None:
    module, environment = NODE_TYPES["recorder"].__module__, dict(os.environ)
    ended = warm_python.run(("-m", module, *words), tmp_path, environment, timeout=START)
    assert (ended.returncode, [*tmp_path.iterdir()]) == (2, [])
    assert_one_sentence(ended.stderr.strip(), f"'{words[0]}'", "--ros-args -p NAME:=VALUE")


@pytest.mark.parametrize("node", sorted(NODE_TYPES))
def test_the_help_of_an_executable_names_its_parameters(warm_python: WarmPython, node: str) -> None:
    known = json.loads((ROOT / "test" / "expected" / "parameters.json").read_text("utf-8"))
    words = ("-m", NODE_TYPES[node].__module__, "--help")
    ended = warm_python.run(words, ROOT, dict(os.environ), timeout=START)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert ended.stdout.startswith("Usage: ros2 run spacerobot_ros")
    assert set(known[node]) <= set(ended.stdout.split())


def test_a_parameter_that_a_node_does_not_have_is_named_with_the_nearest(
    apart: NodesApart, tmp_path: Path
) -> None:
    file = tmp_path / "control.yaml"
    given = {"gains": {"base_positon": {"kp": 1.0}}, "fuel": 2}
    file.write_text(yaml.safe_dump({"coordinated_control": {"ros__parameters": given}}), "utf-8")
    words = ["--params-file", str(file), "-p", "use_sim_time:=false"]
    process = apart.start("coordinated_control", arguments=words)
    apart.wait(lambda: "[WARN]" in process.said, "a warning")
    (warning,) = (line for line in process.said.splitlines() if line.startswith("[WARN]"))
    named = "'gains.base_positon.kp'", "'gains.base_position.kp'", "'fuel'"
    assert_one_sentence(warning.partition("]: ")[2], *named)


@pytest.mark.slow
def test_a_plant_that_is_killed_and_started_again_is_one_clock(apart: NodesApart) -> None:
    recorder = apart.start("recorder", bag="flight.mcap", flush_period=0.1)
    apart.start("plant", **FAST)
    assert apart.life("recorder") == apart.life("plant") == "active"
    apart.wait_states(1)
    # So late that the probe meets the next plant before that time.
    late = 40 * 10**9
    apart.wait(lambda: stamp_of(apart.probe.last("odom")) > late, "some seconds of flight")
    apart.kill("plant")
    apart.start("plant", **FAST)
    apart.wait(lambda: stamp_of(apart.probe.last("odom")) < late, "the plant again")
    # The middleware lists the killed one, too, until its lease is over.
    assert apart.probe.count_publishers("/clock") == 2
    apart.wait(lambda: stamp_of(apart.probe.last("odom")) > late, "ten looks of the recorder")
    assert "clock" not in recorder.said, recorder.said


@pytest.mark.slow
def test_a_full_disk_ends_the_recording_and_nothing_else(apart: NodesApart, tmp_path: Path) -> None:
    # A file may not grow beyond this: what a full disk looks like to the process.
    room = 40_000

    def prepare() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (room, room))

    bag = tmp_path / "flight.mcap"
    recorder = apart.start("recorder", bag=bag, flush_period=0.1, prepare=prepare)
    plant = apart.start("plant", **{**FAST, "real_time_factor": 20})
    assert apart.life("recorder") == apart.life("plant") == "active"
    apart.wait(lambda: "has ended" in recorder.said, "the sentence")
    apart.wait_states(200)
    for process in (plant, recorder):
        process.signal(signal.SIGTERM)
    assert plant.end() == 0, plant.said
    assert recorder.end() == 1, "its bag is cut short"
    (sentence,) = (line for line in recorder.said.splitlines() if "has ended" in line)
    assert_one_sentence(sentence, str(bag))
    assert "Traceback" not in recorder.said


def test_two_nodes_with_one_name_warn_each_other(apart: NodesApart) -> None:
    first = apart.start("plant", **FAST)
    apart.probe.watch("heartbeat", DiagnosticStatus)
    apart.wait(lambda: apart.probe.count("heartbeat") > 5, "heartbeats")
    assert "Another node" not in first.said
    second = apart.start("plant", robot="planar_manipulator")
    warning = "Another node '/plant' runs in this ROS domain"
    apart.wait(lambda: warning in first.said and warning in second.said, "both warnings")
