"""Bags of a recorder that asks the nodes for their parameters, as one under `ros2 run` does."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from rclpy.node import Node
from rclpy.parameter import Parameter
from support.altered_bags import altered
from support.command_line import CliRunner, Result
from support.recorded_stack import Stack
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

from spacerobot_ros import fly, load_scenario, read_bag
from spacerobot_ros.cli.main import main
from spacerobot_ros.flight.reading import open_flight_bag, read_flight
from spacerobot_ros.resources import share_directory
from spacerobot_ros.scenario import read_sections

REFERENCE_BAG = share_directory() / "bags" / "sliding_masses.mcap"
OF_ROS = {"use_sim_time", "start_type_description_service"}
QOS_OVERRIDE = "qos_overrides./clock.subscription.durability"


def dumped(node: Node) -> dict[str, Any]:
    """Return what ``ros2 param dump`` writes of a node: its parameters, in groups by the dots."""
    section: dict[str, Any] = {}
    for name, parameter in node.get_parameters_by_prefix("").items():
        *groups, last = name.split(".")
        inner = section
        for group in groups:
            inner = inner.setdefault(group, {})
        value = parameter.value
        plain = None | bool | int | float | str
        inner[last] = value if isinstance(value, plain) else list(value)
    return {node.get_fully_qualified_name(): {"ros__parameters": section}}


@dataclass
class Recorded:
    """A flight by nodes that the recorder does not compose: their parameters, its bag, a dump."""

    bag: Path
    dump: Path
    parameters: dict[str, dict[str, Any]]


@pytest.fixture
def recorded(harness: Harness, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recorded:
    monkeypatch.chdir(tmp_path)
    stack = Stack(harness, tmp_path / "flight.mcap")
    results = stack.planner.set_parameters([Parameter("use_sim_time", value=True)])
    assert all(result.successful for result in results)
    # As every subscription with qos_overriding_options does.
    stack.planner.declare_parameter(QOS_OVERRIDE, "volatile")
    stack.configure("/odom", "/planner/status", "/joint_commands", "/clock", "/goal_pose")
    stack.recorder.trigger_activate()
    stack.fly()
    harness.spin_until(lambda: not stack.recorder.questions, "the nodes' parameters")
    stack.stop()
    nodes = (stack.plant, stack.planner, stack.recorder)
    dump = tmp_path / "dump.yaml"
    dump.write_text("".join(yaml.safe_dump(dumped(node)) for node in nodes), "utf-8")
    metadata = stack.close_bag().metadata
    names = ("plant", "planner")
    given = {
        node: {name: json.loads(text) for name, text in metadata[f"parameters/{node}"].items()}
        for node in names
    }
    return Recorded(stack.bag, dump, given)


def told(*words: str | Path) -> Result:
    """Return what a command says."""
    return CliRunner().invoke(main, list(map(str, words)))


def test_bags_and_dumps_with_the_parameters_of_ros_are_read(recorded: Recorded) -> None:
    assert set(recorded.parameters["plant"]) >= {"robot", "autostart", *OF_ROS}
    assert set(recorded.parameters["planner"]) >= {QOS_OVERRIDE, *OF_ROS}
    for words in (
        ("report", recorded.bag, "-o", "out.html"),
        ("figures", recorded.bag, "--format", "png", "-o", "figures"),
        ("verify", recorded.bag),
        ("export", recorded.bag, "--format", "csv", "-o", "tables"),
    ):
        result = told(*words)
        assert result.exit_code == 0, (words, result.output)
    assert read_bag(recorded.bag)["/odom"].field("pose.pose.position.x")[-1] == pytest.approx(
        0.05, abs=2e-3
    )
    scenario = read_flight(open_flight_bag(recorded.bag)).scenario
    assert scenario.plant.tick_rate == 20.0
    assert (scenario.planner.method, scenario.planner.tick_rate) == ("lie_bracket", 20.0)

    sections = read_sections(recorded.dump)
    assert set(sections) == {"plant", "planner", "recorder"}
    assert sections["planner"]["use_sim_time"] is True
    assert sections["planner"][QOS_OVERRIDE] == "volatile"
    flight = fly(load_scenario(str(recorded.dump)), position=(0.05, 0.0, 0.0))
    assert flight.succeeded
    assert flight.scenario.planner.options["lie_bracket"].t1 == 2.0
    none = told("run", recorded.dump)
    assert none.exit_code == 2
    assert_one_sentence(none.stderr, "'dump' has no goal", "--goal-rpy-deg 0 0 10")
    text = recorded.dump.read_text("utf-8")
    recorded.dump.write_text(text.replace("tick_rate", "tick_rat"), "utf-8")
    misspelt = told("run", recorded.dump, "--goal", *["0.05", "0", "0", "0", "0", "0", "1"])
    assert misspelt.exit_code == 2
    assert_one_sentence(misspelt.stderr, "has no parameter 'tick_rat'")


@pytest.mark.parametrize("command", ["report", "figures", "verify"])
def test_parameters_of_a_newer_version_stop_no_command(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nor does a gait method of one's own, whose module is not there."""
    monkeypatch.chdir(tmp_path)
    newer = {"tidal_lag": "0.5", "sensors.star_tracker": '["a"]', "tick_jitter": "null"}
    plant = altered(REFERENCE_BAG, tmp_path / "plant.mcap", parameters=newer)
    own = {"method": '"sampling"', "sampling.gain": "3.0"}
    bag = altered(plant, tmp_path / "newer.mcap", parameters=own, node="planner")
    result = told(command, bag)
    assert result.exit_code == 0, result.output
