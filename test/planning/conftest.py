"""Planning in CasADi's virtual machine: these tests are about numbers of many robots."""

from pathlib import Path
from typing import Any

import pytest

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.methods.optimal.search import ManoeuvreSearch


@pytest.fixture(autouse=True)
def _interpreted(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    # Studies measure the processor time that users have.
    if request.node.get_closest_marker("study") is None:
        monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


@pytest.fixture(scope="module")
def chain() -> SpaceRobot:
    """Return the robot of paper 3."""
    return SpaceRobot.from_file(Path(__file__).parents[2] / "urdf" / "planar_chain.urdf")


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    """Return the robot of paper 2."""
    return SpaceRobot.from_file(Path(__file__).parents[2] / "urdf" / "three_joint_arm.urdf")


@pytest.fixture
def no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refuse every search of an optimal manoeuvre, with words of no other refusal."""

    def refuse(*arguments: Any, **options: Any) -> None:
        raise PlanningError("A search was begun.")

    monkeypatch.setattr(ManoeuvreSearch, "search", refuse)
