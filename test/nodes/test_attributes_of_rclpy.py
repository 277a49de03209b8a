"""No node replaces an attribute of rclpy's Node, which would fail where rclpy uses it next."""

from __future__ import annotations

import ast
import inspect
import textwrap

import pytest
import rclpy
from rclpy.lifecycle import LifecycleNode

from spacerobot_ros.nodes import (
    CoordinatedControlNode,
    PlannerNode,
    PlantNode,
    RecorderNode,
    ReplayNode,
)
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.viewer.node import ViewerNode

NODES = (CoordinatedControlNode, PlannerNode, PlantNode, RecorderNode, ReplayNode, ViewerNode)

RELEASED = {"_state_machine"}
"""Set to None when the node is destroyed: it would keep the node in the graph."""


def own_classes(kind: type) -> list[type]:
    """Return a node's class and its bases down to rclpy's."""
    return [each for each in kind.__mro__ if issubclass(each, FlightNode)]


def assigned(kind: type) -> set[str]:
    """Return the attributes of ``self`` that the methods of a class assign."""
    tree = ast.parse(textwrap.dedent(inspect.getsource(kind)))
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.ctx, ast.Store)
        and isinstance(node.value, ast.Name)
        and node.value.id == "self"
    }


@pytest.fixture
def rclpy_attributes(ros_context: rclpy.Context) -> set[str]:
    """Return the attributes of a node that is rclpy's alone, and those of its class."""
    node = LifecycleNode("plain", context=ros_context)
    names = {*vars(node), *(name for name in dir(LifecycleNode) if not name.startswith("__"))}
    node.destroy_node()
    assert {"_clock", "_timers", "_parameters", "_logger"} <= names
    return names


@pytest.mark.parametrize("kind", NODES, ids=lambda kind: kind.__name__)
def test_no_attribute_of_rclpy_is_assigned(kind: type, rclpy_attributes: set[str]) -> None:
    found = {name for each in own_classes(kind) for name in assigned(each)}
    assert {"_failure", "fault"} <= found
    assert found & rclpy_attributes <= RELEASED


@pytest.mark.parametrize("kind", NODES, ids=lambda kind: kind.__name__)
def test_no_private_method_of_rclpy_is_replaced(kind: type, rclpy_attributes: set[str]) -> None:
    own = {name for each in own_classes(kind) for name in vars(each)}
    assert not {name for name in own & rclpy_attributes if name.startswith("_")} - {
        "__init__", "__module__", "__doc__", "__annotations__",
    }  # fmt: skip
