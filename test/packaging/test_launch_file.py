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

from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.parameters import declared
from spacerobot_ros.resources import share_directory
from spacerobot_ros.session.scenario import scenario_names

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
        "launch.actions": ("DeclareLaunchArgument", "OpaqueFunction"),
        "launch.conditions": ("IfCondition",),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros": (),
        "launch_ros.actions": ("Node",),
        "ament_index_python.packages": (),
    }
    for name, classes in offered.items():
        module = ModuleType(name)
        for each in classes:
            setattr(module, each, type(each, (Noted,), {}))
        monkeypatch.setitem(sys.modules, name, module)
    packages: Any = sys.modules["ament_index_python.packages"]
    packages.get_package_share_directory = lambda _: str(share_directory())
    made: Noted = runpy.run_path(str(FILE))["generate_launch_description"]()
    return made


def launched(description: Noted, **chosen: str) -> dict[str, Noted]:
    """Return the nodes by name, for the arguments chosen and the defaults of the others."""
    *arguments, act = description.args[0]
    context = {a.args[0]: a.options["default_value"] for a in arguments} | chosen
    assert set(chosen) <= {a.args[0] for a in arguments}
    function: Callable[[dict[str, str]], list[Noted]] = act.options["function"]
    return {node.options["name"]: node for node in function(context)}


def test_arguments_are_those_that_the_docs_name(description: Noted) -> None:
    names = {argument.args[0] for argument in description.args[0][:-1]}
    assert names == {"scenario", "params_file", "namespace", "use_sim_time", "record"}


@pytest.mark.parametrize("scenario", scenario_names())
def test_every_scenario_starts_its_nodes(description: Noted, scenario: str) -> None:
    nodes = launched(description, scenario=scenario)
    assert "plant" in nodes
    assert len(nodes) >= 3
    for name, node in nodes.items():
        assert node.options["executable"] == name
        assert (FILE.parents[1] / "scripts" / name).is_file(), "what `ros2 run` would start"
        for given in node.options["parameters"]:
            if isinstance(given, str):
                assert Path(given).is_file()
            else:
                assert set(given) <= {s.name for s in declared(NODE_TYPES[name].Config)} | {
                    "use_sim_time"
                }
    assert nodes["recorder"].options["condition"].args[0].args == ("record",)


def test_the_planner_answers_while_it_plans_in_real_time_only(
    description: Noted, tmp_path: Path
) -> None:
    planner = launched(description)["planner"].options["parameters"]
    # Before the file, which may say otherwise.
    assert planner[0] == {"plan_in_background": True}
    held = tmp_path / "held.yaml"
    sections = {
        "plant": {"ros__parameters": {"time_mode": "lockstep", "robot": "sliding_masses"}},
        "planner": {"ros__parameters": {"robot": "sliding_masses"}},
    }
    held.write_text(yaml.safe_dump(sections))
    nodes = launched(description, params_file=str(held))
    assert nodes["planner"].options["parameters"][:2] == [{"plan_in_background": False}, str(held)]
