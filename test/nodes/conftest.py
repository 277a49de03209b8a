"""A harness for the nodes of one test."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from support.ros_harness import Harness, Probe


@pytest.fixture
def one_plant(harness: Harness) -> Iterator[None]:
    """Check that a test was not disturbed by another plant in its domain."""
    yield
    stranger = Probe({}, context=harness.context, name="stranger")
    assert stranger.count_publishers("odom") <= 1
    stranger.destroy_node()
