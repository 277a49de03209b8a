"""The layouts for Foxglove and RViz name topics and fields that the stack's bags have."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from support.interface_package import (
    CONTROL_MSGS,
    NAV2_MSGS,
    SPACEROBOT_MSGS,
    TF2_MSGS,
    InterfacePackage,
    with_interfaces,
)

from spacerobot_ros.bag import Bag, message_definition, read_bag
from spacerobot_ros.model.urdf import load_robot
from spacerobot_ros.resources import resource_names, robot_file, share_directory
from spacerobot_ros.topics import TOPICS

SHARE = share_directory()
SENT_BY_PEOPLE = {
    "/goal_pose": "geometry_msgs/msg/PoseStamped",
    "/end_effector/goal_pose": "geometry_msgs/msg/PoseStamped",
}
# Of rviz_default_plugins.
DISPLAYED = {
    "rviz_default_plugins/RobotModel": "std_msgs/msg/String",
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
    "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
}


KEYS = {
    # RendererConfig of panels/ThreeDeeRender/IRenderer.ts
    "3D": {
        "cameraState", "followTf", "followMode", "scene", "publish", "transforms", "topics",
        "layers", "imageMode",
    },
    # PlotConfig of panels/Plot/utils/config.ts
    "Plot": {
        "paths", "minXValue?", "maxXValue?", "minYValue?", "maxYValue?", "showLegend",
        "legendDisplay", "showPlotValuesInLegend", "showXAxisLabels", "showYAxisLabels",
        "isSynced", "xAxisVal", "xAxisPath?", "xAxisLabel?", "yAxisLabel?", "followingViewWidth?",
        "sidebarDimension",
    },
    # DiagnosticSummaryConfig of panels/DiagnosticSummary/types.ts
    "DiagnosticSummary": {
        "minLevel", "pinnedIds", "topicToRender", "hardwareIdFilter", "sortByLevel?",
        "secondsUntilStale?",
    },
    # RawMessagesPanelConfig of panels/RawMessagesCommon/types.ts
    "RawMessages": {
        "diffEnabled", "diffMethod", "diffTopicPath", "expansion?", "showFullMessageForDiff",
        "topicPath", "fontSize?",
    },
    # Config of panels/CallService/types.ts: buttons that abort, rearm and pause, where the layout
    # could only look on.
    "CallService": {
        "serviceName?", "requestPayload?", "layout?", "buttonText?", "buttonTooltip?",
        "buttonColor?",
    },
    # PublishConfig of panels/Publish/types.ts: goals of base and end-effector with three axes,
    # and faults.
    "Publish": {
        "topicName?", "datatype?", "buttonText?", "buttonTooltip?", "buttonColor?", "advancedView",
        "value?",
    },
    # StateTransitionConfig of panels/StateTransitions/types.ts: when plant, planner and controller
    # were in which state.
    "StateTransitions": {
        "isSynced", "paths", "xAxisMaxValue?", "xAxisMinValue?", "xAxisRange?", "xAxisLabel?",
        "showPoints?",
    },
}  # fmt: skip
PANELS = set(KEYS)


@pytest.fixture(scope="module")
def bags() -> list[Bag]:
    return [read_bag(SHARE / "bags" / f"{name}.mcap") for name in resource_names("bags", ".mcap")]


@pytest.fixture(scope="module")
def types(bags: list[Bag]) -> dict[str, str]:
    return {**SENT_BY_PEOPLE, **{name: kind for bag in bags for name, kind in bag.topics.items()}}


@pytest.fixture(scope="module")
def foxglove() -> dict[str, Any]:
    return json.loads((SHARE / "foxglove" / "spacerobot.json").read_text())


def leaves(node: Any) -> Iterator[str]:
    """Go through the panels of a layout: a panel, or two nodes in a row or a column."""
    if isinstance(node, str):
        yield node
        return
    assert set(node) <= {"direction", "first", "second", "splitPercentage"}
    assert node["direction"] in ("row", "column")
    assert 0 < node.get("splitPercentage", 50) < 100
    for side in ("first", "second"):
        yield from leaves(node[side])


def test_foxglove_has_every_panel_in_its_place_once(foxglove: dict[str, Any]) -> None:
    assert set(foxglove) == {
        "configById", "globalVariables", "userNodes", "playbackConfig", "layout",
    }  # fmt: skip
    placed = list(leaves(foxglove["layout"]))
    assert sorted(placed) == sorted(foxglove["configById"])
    assert {name.split("!")[0] for name in placed} == PANELS


def test_foxglove_names_topics_and_fields_of_the_stack(
    foxglove: dict[str, Any], bags: list[Bag], types: dict[str, str]
) -> None:
    panels = foxglove["configById"]
    shown = panels["3D!robot"]["topics"]
    kinds = {
        "geometry_msgs/msg/PoseStamped",
        "nav_msgs/msg/Path",
        "visualization_msgs/msg/MarkerArray",
    }
    assert {types[topic] for topic in shown} == kinds
    # The robot itself is drawn from its description, with /tf.
    assert shown["/markers"]["namespaces"] == {"robot": {"visible": False}}
    assert types[panels["3D!robot"]["publish"]["poseTopic"]] == "geometry_msgs/msg/PoseStamped"
    assert types[panels["DiagnosticSummary!plant"]["topicToRender"]].endswith("DiagnosticArray")
    for name, panel in panels.items():
        if name.startswith("RawMessages!"):
            assert types[panel["topicPath"]].endswith("DiagnosticStatus")
        for path in panel.get("paths", ()):
            if name.startswith("StateTransitions!"):
                continue
            match = re.fullmatch(r"(/[\w/]+)\.([\w.]+?)(\[\d+\])?", path["value"])
            assert match is not None
            topic, field, is_array = match.groups()
            bag = next(bag for bag in bags if topic in bag.topics)
            series = bag[topic]
            assert series.field(field).ndim == (2 if is_array else 1)
            # Where messages have no header, Foxglove would draw nothing by their stamps.
            assert series.stamped == (path["timestampMethod"] == "headerStamp")


def test_rviz_names_topics_of_the_type_that_its_displays_take(types: dict[str, str]) -> None:
    config = yaml.safe_load((SHARE / "rviz" / "spacerobot.rviz").read_text())
    manager = config["Visualization Manager"]
    assert manager["Global Options"]["Fixed Frame"] == "world"
    found = {d["Class"]: d["Topic"] for d in manager["Displays"] if "Topic" in d}
    robot = next(d for d in manager["Displays"] if d["Class"].endswith("/RobotModel"))
    found["rviz_default_plugins/RobotModel"] = robot["Description Topic"]
    assert any(d["Class"] == "rviz_default_plugins/TF" for d in manager["Displays"])
    assert [d["Namespaces"] for d in manager["Displays"] if "Namespaces" in d] == [{"robot": False}]
    assert set(found) == set(DISPLAYED)
    for kind, topic in found.items():
        assert types[topic["Value"]] == DISPLAYED[kind]
        latched = topic["Value"] in ("/planned_path", "/robot_description")
        assert topic["Durability Policy"] == ("Transient Local" if latched else "Volatile")
    goals = [tool["Topic"]["Value"] for tool in manager["Tools"] if "Topic" in tool]
    assert set(goals) == set(SENT_BY_PEOPLE)


def test_foxglove_draws_a_line_for_each_joint_of_every_robot(foxglove: dict[str, Any]) -> None:
    most = max(
        len(load_robot(robot_file(name)).joint_names) for name in resource_names("urdf", ".urdf")
    )
    for panel, field in (("joints", "position"), ("rates", "velocity")):
        values = [path["value"] for path in foxglove["configById"][f"Plot!{panel}"]["paths"]]
        assert values[:most] == [f"/joint_states.{field}[{i}]" for i in range(most)]
        # A slice of an array is one line that zig-zags through all its entries.
        assert len(
            {path["label"] for path in foxglove["configById"][f"Plot!{panel}"]["paths"]}
        ) == len(values)


def test_foxglove_commands_what_the_nodes_offer(foxglove: dict[str, Any]) -> None:
    panels = foxglove["configById"]
    services = {p["serviceName"] for n, p in panels.items() if n.startswith("CallService!")}
    of_plant = {f"/plant/{service}" for service in ("abort", "rearm", "pause")}
    assert services == of_plant | {"/planner/abort", "/coordinated_control/abort"}
    for name, panel in panels.items():
        if name.startswith("CallService!"):
            json.loads(panel["requestPayload"])
        if name.startswith("Publish!"):
            topic = TOPICS[panel["topicName"][1:]]
            assert panel["datatype"] == topic.type
            fields = json.loads(panel["value"])
            known = message_definition(topic.type)
            assert all(re.search(rf"\b{field}\b", known) for field in fields)
    states = panels["StateTransitions!states"]["paths"]
    for path in states:
        match = re.fullmatch(r'/([\w/]+)\.values\[:\]\{key=="state"\}\.value', path["value"])
        assert match is not None
        assert TOPICS[match[1]].type.endswith("DiagnosticStatus")


ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.study
def test_actions_are_served_by_both_kinds_of_interface() -> None:
    _run("test_fly_to.py", SPACEROBOT_MSGS, NAV2_MSGS)


@pytest.mark.study
def test_schedules_are_flown_by_a_trajectory_server() -> None:
    _run("test_trajectory_output.py", CONTROL_MSGS)


def _run(tests: str, *packages: InterfacePackage) -> None:
    """Run tests of nodes with packages that are built."""
    environment = {**os.environ, **with_interfaces(*packages)}
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", "-rs", "-m", "study",
         f"test/nodes/{tests}"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    told = [line for line in run.stdout.splitlines() if not line.startswith("[")]
    print("\n".join(told))
    assert run.returncode == 0, run.stdout[-3000:]
    assert "skipped" not in run.stdout


# -- the real /tf ------------------------------------------------------------------------------


@pytest.mark.study
def test_frames_on_the_real_topic_are_those_of_odom_and_pinocchio() -> None:
    environment = {**os.environ, **with_interfaces(TF2_MSGS)}
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rs",
         "test/nodes/test_transforms.py"],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert run.returncode == 0, run.stdout[-3000:]
    assert "skipped" not in run.stdout
