"""What a planner says when it refuses a goal."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from spacerobot_ros.errors import PlanningError


def refusal_in(plan: Callable[[], object]) -> str:
    """Return the one sentence with which a plan is refused."""
    with pytest.raises(PlanningError) as refusal:
        plan()
    text = str(refusal.value)
    assert text.endswith(".")
    assert "\n" not in text
    return text
