"""What the launch file asks of ROS's launch, with stand-ins for it that only take notes."""

from __future__ import annotations

import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import yaml
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.parameters import declared
from spacerobot_ros.scenario import load_scenario, scenario_names

FILE = Path(__file__).parents[2] / "launch" / "flight_stack.launch.py"


class Noted:
    """Anything that launch offers: keeps what it was made with."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self.args, self.options = args, options

    def perform(self, context: dict[str, str]) -> str:
        return context[self.args[0]]


@pytest.fixture
def description(monkeypatch: pytest.MonkeyPatch) -> Noted:
    offered = {
        "launch": ("LaunchContext", "LaunchDescription"),
        "launch.actions": ("DeclareLaunchArgument", "OpaqueFunction", "Shutdown"),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
    }
    for name, classes in offered.items():
        module = ModuleType(name)
        for each in classes:
            setattr(module, each, type(each, (Noted,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    made: Noted = runpy.run_path(str(FILE))["generate_launch_description"]()
    return made


def launched(description: Noted, **chosen: str) -> dict[str, Noted]:
    """Return the nodes by name, for the arguments chosen and the defaults of the others."""
    *arguments, act = description.args[0]
    context = {a.args[0]: a.options["default_value"] for a in arguments} | chosen
    assert set(chosen) <= {a.args[0] for a in arguments}
    function: Callable[[dict[str, str]], list[Noted]] = act.options["function"]
    return {node.options["name"]: node for node in function(context)}


def given(node: Noted) -> dict[str, Any]:
    """Return the parameters that a node is given beside those of a file, which go before them."""
    values: dict[str, Any] = node.options["parameters"][-1]
    return values


def test_arguments_are_those_that_the_docs_name(description: Noted) -> None:
    names = {argument.args[0] for argument in description.args[0][:-1]}
    assert names == {
        "scenario", "robot", "params_file", "bag", "record", "namespace", "autostart",
        "use_sim_time", "log_level", "respawn", "rviz", "view",
    }  # fmt: skip
    text = (FILE.parents[1] / "docs" / "operation.md").read_text(encoding="utf-8")
    for name in names:
        assert f"`{name}`" in text


@pytest.mark.parametrize("scenario", scenario_names())
def test_every_scenario_starts_its_nodes(description: Noted, scenario: str) -> None:
    nodes = launched(description, scenario=scenario)
    assert {"plant", "recorder", *load_scenario(scenario).commanders} == set(nodes)
    for name, node in nodes.items():
        assert node.options["executable"] == name
        assert (FILE.parents[1] / "scripts" / name).is_file(), "what `ros2 run` would start"
        file, values = node.options["parameters"]
        assert Path(file).is_file()
        names = {s.name for s in declared(NODE_TYPES[name].Config)} | {"use_sim_time", "autostart"}
        assert set(values) <= names
        assert set(load_scenario(scenario).in_file.get(name, {})) <= set(values)
    assert "recorder" not in launched(description, scenario=scenario, record="false")


@pytest.mark.parametrize("key", ["plant", "/**/plant", "/robot_1/plant", "/elsewhere/plant"])
@pytest.mark.parametrize("namespace", ["", "robot_1", "/robot_1"])
def test_a_file_is_obeyed_in_any_namespace(
    description: Noted, tmp_path: Path, key: str, namespace: str
) -> None:
    file = tmp_path / "mine.yaml"
    of_plant = {"robot": "servicer", "sensors": {"seed": 3}, "faults": []}
    file.write_text(yaml.safe_dump({key: {"ros__parameters": of_plant}}))
    plant = launched(description, params_file=str(file), namespace=namespace)["plant"]
    assert plant.options["namespace"] == namespace.strip("/")
    values = given(plant)
    assert values["robot"] == "servicer"
    assert values["sensors.seed"] == 3
    assert "faults" not in values, "launch cannot tell the type of an empty list"


def test_each_namespace_has_a_clock_of_its_own(description: Noted) -> None:
    for name, node in launched(description, namespace="a", rviz="true", view="true").items():
        if name == "viewer":
            assert node.options["namespace"] == "a"
            continue  # It reads no clock and no transforms.
        renamed = dict(node.options["remappings"])
        assert renamed["/clock"] == "clock", name
        assert renamed["/tf"] == "tf"
    for node in launched(description).values():
        assert node.options["remappings"] == []


def test_a_launch_ends_or_goes_on_when_a_node_dies(description: Noted) -> None:
    for name, node in launched(description, rviz="true", view="true").items():
        if name in ("rviz", "viewer"):
            assert "on_exit" not in node.options
            continue
        assert type(node.options["on_exit"]).__name__ == "Shutdown"
        assert name in node.options["on_exit"].options["reason"]
        assert "respawn" not in node.options
    for name, node in launched(description, respawn="true").items():
        assert node.options["respawn"] is True, name
        assert "on_exit" not in node.options


def test_arguments_reach_the_nodes(description: Noted, tmp_path: Path) -> None:
    nodes = launched(
        description, scenario="planar_chain", bag="x.mcap", autostart="false", log_level="warn",
        use_sim_time="true",
    )  # fmt: skip
    assert given(nodes["recorder"])["bag"] == "x.mcap"
    for node in nodes.values():
        assert given(node)["autostart"] is False
        assert given(node)["use_sim_time"] is True
        assert node.options["ros_arguments"] == ["--log-level", "warn"]
    robots = launched(description, robot="servicer")
    assert set(robots) == {"plant", "planner", "recorder"}, "no scenario, but a robot"
    for name in ("plant", "planner"):
        assert Path(given(robots[name])["robot"]).name == "servicer.urdf"
    both = launched(description, robot="servicer", scenario="coordinated_control")
    assert Path(given(both["coordinated_control"])["robot"]).name == "servicer.urdf"
    assert given(both["plant"])["actuation"] == "effort"


@pytest.mark.parametrize(
    "chosen", [{"scenario": "nonsense"}, {"robot": "nonsense"}, {"params_file": "nonsense.yaml"}]
)
def test_what_is_not_there_is_one_sentence(description: Noted, chosen: dict[str, str]) -> None:
    with pytest.raises(ParameterError) as caught:
        launched(description, **chosen)
    assert_one_sentence(str(caught.value), "nonsense")
