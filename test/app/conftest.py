"""What flights through ROS share: a domain of their own, and the laws that fly them."""

from __future__ import annotations

from typing import Any

import pytest


@pytest.fixture
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have the test's nodes in a ROS domain of its own."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))


@pytest.fixture(params=["transposed_jacobian", "model_based"])
def law(request: pytest.FixtureRequest) -> str:
    """Return a law that flies spacecraft and end-effector together."""
    return str(request.param)


@pytest.fixture(scope="module")
def flown() -> dict[str, Any]:
    """Return what has been flown, by law: each flies once, for the test that asks first."""
    return {}
