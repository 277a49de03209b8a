"""Nodes of one test, each a process of its own, in a ROS domain of this test's."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from support.nodes_apart import NodesApart
from support.ros_harness import Harness


@pytest.fixture
def apart(harness: Harness, ros_domain: int, tmp_path: Path) -> Iterator[NodesApart]:
    """Return nodes that are started apart; none of their processes outlives the test."""
    nodes = NodesApart(harness, tmp_path, ros_domain)
    yield nodes
    nodes.close()
