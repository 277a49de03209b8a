"""The nodes of a scenario and the recorder, each its own process."""

from __future__ import annotations

from pathlib import Path

import yaml
from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

PACKAGE = "spacerobot_ros"


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes with the parameter file that the arguments name."""
    chosen = LaunchConfiguration("params_file").perform(context)
    scenario = LaunchConfiguration("scenario").perform(context)
    share = Path(get_package_share_directory(PACKAGE))
    common = {
        "package": PACKAGE,
        "namespace": LaunchConfiguration("namespace"),
        "output": "screen",
    }
    parameter_file = Path(chosen) if chosen else share / "config" / f"{scenario}.yaml"
    parameters = [
        str(parameter_file),
        {"use_sim_time": LaunchConfiguration("use_sim_time")},
    ]
    # The file has a section for each node that its scenario needs.
    sections = yaml.safe_load(parameter_file.read_text(encoding="utf-8"))
    wanted = [name for name in ("plant", "planner", "coordinated_control") if name in sections]
    recorder = Node(
        executable="recorder",
        name="recorder",
        parameters=parameters,
        condition=IfCondition(LaunchConfiguration("record")),
        **common,
    )
    plant = (sections.get("plant") or {}).get("ros__parameters") or {}
    # In real time states are answered while the planner plans; the file may say otherwise.
    live = plant.get("time_mode", "realtime") == "realtime"
    own = {"planner": [{"plan_in_background": live}]}
    return [
        *(
            Node(executable=name, name=name, parameters=own.get(name, []) + parameters, **common)
            for name in wanted
        ),
        recorder,
    ]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and the nodes."""
    arguments = (
        ("scenario", "sliding_masses", "name of a parameter file in the package's config/"),
        ("params_file", "", "another parameter file, before the scenario's"),
        ("namespace", "", "namespace of all nodes and relative topics"),
        ("use_sim_time", "false", "whether the nodes' own clocks follow /clock"),
        ("record", "true", "whether to record into an MCAP bag"),
    )
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(n, default_value=d, description=t) for n, d, t in arguments),
            OpaqueFunction(function=nodes),
        ]
    )
