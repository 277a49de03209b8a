"""The nodes of a scenario and the recorder, each its own process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.scenario_files import read_sections
from spacerobot_ros.topics import GLOBAL_TOPICS

PACKAGE = "spacerobot_ros"

ARGUMENTS = (
    ("scenario", "", "a scenario of the package, or a YAML file [sliding_masses, if no robot]"),
    ("robot", "", "a robot of the package, or a URDF file, instead of the scenario's"),
    ("params_file", "", "a parameter file instead of a scenario's"),
    ("bag", "", "file to record into [spacerobot-<date>-<time>.mcap here]"),
    ("record", "true", "whether to record into an MCAP bag"),
    ("namespace", "", "of all nodes and topics; /clock, /tf and /tf_static are in it then, too"),
    ("autostart", "true", "whether the nodes configure and activate themselves"),
    ("use_sim_time", "false", "whether the nodes' own clocks follow the simulated clock"),
    ("log_level", "info", "debug, info, warn, error or fatal"),
    ("respawn", "false", "whether a node that dies is started again; else everything ends with it"),
    ("rviz", "false", "whether to start RViz"),
    ("view", "false", "whether to serve the page that shows the robot and steers it"),
)

VIEWED = 0.1
"""Longest time between transforms that are recorded in real time, s."""

RESPAWN_DELAY = 1.0
"""Wall s from the death of a node to its next start."""


def nodes(context: LaunchContext) -> list[Node]:
    """Return the nodes with the parameters that the arguments name."""
    chosen = {name: LaunchConfiguration(name).perform(context) for name, _, _ in ARGUMENTS}
    namespace, files = chosen["namespace"].strip("/"), parameter_files(chosen)
    # The file has a section for each node that its scenario needs.
    sections = read_sections(files[-1]) if files else {"plant": {}, "planner": {}}
    wanted = [name for name in ("plant", "planner", "coordinated_control") if name in sections]
    if is_true(chosen["record"]):
        wanted.append("recorder")
    remappings = [(name, name[1:]) for name in GLOBAL_TOPICS] if namespace else []
    started = [
        Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=namespace,
            output="screen",
            parameters=[*map(str, files), parameters(name, chosen, sections)],
            remappings=remappings,
            ros_arguments=["--log-level", chosen["log_level"]],
            **at_its_end(name, respawn=is_true(chosen["respawn"])),
        )
        for name in wanted
    ]
    if is_true(chosen["view"]):
        started.append(viewer(namespace, files, chosen))
    return [*started, rviz(namespace)] if is_true(chosen["rviz"]) else started


def parameter_files(chosen: dict[str, str]) -> list[Path]:
    """Return the parameter file, if there is one: a robot alone has none."""
    if chosen["params_file"]:
        return [Path(chosen["params_file"])]
    if chosen["scenario"] or not chosen["robot"]:
        return [load_scenario(chosen["scenario"] or "sliding_masses").path]
    return []


def parameters(
    name: str, chosen: dict[str, str], sections: dict[str, dict[str, Any]]
) -> dict[str, Any]:
    """Return the parameters of a node: those of its section, and what the arguments change.

    ROS itself takes a section ``plant:`` for nodes without a namespace only. It cannot tell of
    what an empty list in a dictionary is; that one stays in the file.
    """
    section = sections.get(name, {})
    given: dict[str, Any] = {
        **{key: value for key, value in section.items() if value != []},
        "use_sim_time": is_true(chosen["use_sim_time"]),
        "autostart": is_true(chosen["autostart"]) and section.get("autostart", True),
    }
    # In real time viewers want to see something.
    live = sections.get("plant", {}).get("time_mode", "realtime") == "realtime"
    if name == "recorder":
        if chosen["bag"]:
            given["bag"] = chosen["bag"]
        if live:
            given["diagnostics_period"] = section.get("diagnostics_period", 1.0)
            given["tf_period"] = min(section.get("tf_period", VIEWED), VIEWED)
        return given
    if chosen["robot"]:
        robot = robot_file(chosen["robot"])  # Refused here, with one sentence.
        given["robot"] = str(robot.resolve())
    return given


def at_its_end(name: str, *, respawn: bool) -> dict[str, Any]:
    """Return what launch is to do when a node has ended."""
    if respawn:
        return {"respawn": True, "respawn_delay": RESPAWN_DELAY}
    return {"on_exit": Shutdown(reason=f"the node '{name}' has ended")}


def viewer(namespace: str, files: list[Path], chosen: dict[str, str]) -> Node:
    """Return the page of the robot; the flight goes on when it ends."""
    return Node(
        package=PACKAGE,
        executable="viewer",
        name="viewer",
        namespace=namespace,
        output="screen",
        parameters=list(map(str, files)),
        ros_arguments=["--log-level", chosen["log_level"]],
    )


def rviz(namespace: str) -> Node:
    """Return RViz with the view of this package; it may be closed without an end to the flight."""
    file = share_directory() / "rviz" / "spacerobot.rviz"
    shown = [
        *("/markers", "/odom", "/end_effector_pose", "/planned_path", "/robot_description"),
        *("/goal_pose", "/end_effector/goal_pose"),
    ]
    return Node(
        package="rviz2",
        executable="rviz2",
        name="rviz",
        namespace=namespace,
        arguments=["-d", str(file)],
        # Stamps are of simulated time, and transforms are looked up by it.
        parameters=[{"use_sim_time": True}],
        remappings=[(name, name[1:]) for name in (*GLOBAL_TOPICS, *shown)] if namespace else [],
    )


def is_true(text: str) -> bool:
    """Return whether an argument says yes, in the words that launch takes."""
    return text.lower() in ("true", "1", "yes", "on")


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments and the nodes."""
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(n, default_value=d, description=t) for n, d, t in ARGUMENTS),
            OpaqueFunction(function=nodes),
        ]
    )
