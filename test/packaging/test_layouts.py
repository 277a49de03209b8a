"""The layouts for Foxglove and RViz name topics and fields that the stack's bags have."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import pytest
import yaml

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.resources import resource_names, share_directory

SHARE = share_directory()
SENT_BY_PEOPLE = {
    "/goal_pose": "geometry_msgs/msg/PoseStamped",
    "/end_effector/goal_pose": "geometry_msgs/msg/PoseStamped",
}
# Of rviz_default_plugins.
DISPLAYED = {
    "rviz_default_plugins/MarkerArray": "visualization_msgs/msg/MarkerArray",
    "rviz_default_plugins/Odometry": "nav_msgs/msg/Odometry",
    "rviz_default_plugins/Pose": "geometry_msgs/msg/PoseStamped",
    "rviz_default_plugins/Path": "nav_msgs/msg/Path",
}
PANELS = {"3D", "Plot", "DiagnosticSummary", "RawMessages"}


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
    assert types[panels["3D!robot"]["publish"]["poseTopic"]] == "geometry_msgs/msg/PoseStamped"
    assert types[panels["DiagnosticSummary!plant"]["topicToRender"]].endswith("DiagnosticArray")
    for name, panel in panels.items():
        if name.startswith("RawMessages!"):
            assert types[panel["topicPath"]].endswith("DiagnosticStatus")
        for path in panel.get("paths", ()):
            match = re.fullmatch(r"(/[\w/]+)\.([\w.]+?)(\[\d*:\d*\])?", path["value"])
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
    assert set(found) == set(DISPLAYED)
    for kind, topic in found.items():
        assert types[topic["Value"]] == DISPLAYED[kind]
        latched = topic["Value"] == "/planned_path"
        assert topic["Durability Policy"] == ("Transient Local" if latched else "Volatile")
    (goal,) = [tool["Topic"]["Value"] for tool in manager["Tools"] if "Topic" in tool]
    assert types[goal] == "geometry_msgs/msg/PoseStamped"
