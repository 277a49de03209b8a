"""The chains of calls on the page of the architecture are those of a flight, and short."""

from __future__ import annotations

from pathlib import Path

import pytest
from support.planner_flight import TURNED, Flight
from support.ros_harness import Harness
from support.walks import PACKAGE, Walk, chain

from spacerobot_ros.resources import robot_file

GOAL_TO_COMMAND = "From a goal pose to a command"
SCENARIO_TO_BAG = "From a scenario to a bag"
URDF_TO_FUNCTION = "From a URDF to a compiled function"


def test_from_a_goal_pose_to_a_command(harness: Harness) -> None:
    walk = Walk(chain(GOAL_TO_COMMAND))
    flight = Flight(harness, {"position_tolerance": 1e-3, "attitude_tolerance": 1e-3})
    flight.start()
    flight.ticks(3)
    with walk.watched():
        flight.send(TURNED)
        flight.wait("reached")
    assert walk.left_out() == set()


def test_from_a_scenario_to_a_bag(tmp_path: Path) -> None:
    from spacerobot_ros.scenario import load_scenario
    from spacerobot_ros.session.run import run_scenario

    walk = Walk(chain(SCENARIO_TO_BAG))
    bag = tmp_path / "flight.mcap"
    with walk.watched():
        run_scenario(load_scenario("planar_chain"), bag, longest=0.5)
    assert walk.left_out() == set()
    assert bag.is_file()


def test_from_a_urdf_to_a_compiled_function(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from spacerobot_ros.model import SpaceRobot
    from spacerobot_ros.model.urdf import load_robot

    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path / "cache"))
    # Of a robot that no other test has derived the equations of.
    urdf = robot_file("planar_chain").read_text("utf-8")
    assert 'xyz="0.45 0 0"' in urdf
    file = tmp_path / "robot.urdf"
    file.write_text(urdf.replace('xyz="0.45 0 0"', 'xyz="0.4375 0 0"'))
    walk = Walk(chain(URDF_TO_FUNCTION))
    with walk.watched():
        SpaceRobot(load_robot(file)).buffered("momentum")
    assert walk.left_out() == set()


@pytest.mark.parametrize(
    ("heading", "most"), [(GOAL_TO_COMMAND, 13), (SCENARIO_TO_BAG, 10), (URDF_TO_FUNCTION, 5)]
)
def test_chains_are_short(heading: str, most: int) -> None:
    files = {file for step in chain(heading) for file in step.files}
    assert len(files) <= most
    assert all((PACKAGE / file).is_file() for file in files)
