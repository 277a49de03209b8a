"""A harness for the nodes of one test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from support.ros_harness import Harness


@pytest.fixture
def harness(ros_context: rclpy.Context) -> Iterator[Harness]:
    """Return an empty executor in a ROS domain of this test's own."""
    harness = Harness(ros_context)
    yield harness
    harness.close()
