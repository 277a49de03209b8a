"""Planning in CasADi's virtual machine: these tests are about numbers of many robots."""

from pathlib import Path

import pytest

from spacerobot_ros.model import SpaceRobot


@pytest.fixture(autouse=True)
def _interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


@pytest.fixture(scope="module")
def chain() -> SpaceRobot:
    """Return the robot of paper 3."""
    return SpaceRobot.from_file(Path(__file__).parents[2] / "urdf" / "planar_chain.urdf")


@pytest.fixture(scope="module")
def arm() -> SpaceRobot:
    """Return the robot of paper 2."""
    return SpaceRobot.from_file(Path(__file__).parents[2] / "urdf" / "three_joint_arm.urdf")
