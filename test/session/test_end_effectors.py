"""Scenarios that reach with end-effectors: flown, by the command, and from their bags."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.hand_motion import end_of_motion

from spacerobot_ros import fly
from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.reading import read_run
from spacerobot_ros.measures import Outcome
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import Scenario, load_scenario, scenario_or_robot, scenario_text
from spacerobot_ros.session.run import run_scenario

QUICK = {"optimal.answers": 1, "optimal.intervals": 20, "optimal.cache": 0}


def quick(name: str) -> Scenario:
    return load_scenario(name).with_overrides("planner", QUICK)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["reach", "two_hands"])
def test_the_hands_end_at_their_goals(name: str, tmp_path: Path) -> None:
    scenario, bag = quick(name), tmp_path / "run.mcap"
    result = run_scenario(scenario, bag)
    assert result.succeeded
    flight = read_run(bag)
    aims = {each.link: each for each in scenario.goal.end_effectors}
    robot = str(scenario.plant.robot)
    found = end_of_motion(
        *(robot_file(robot).read_text("utf-8"), flight.joint_names, flight.q, list(aims))
    )
    for link, (r, R) in found.items():
        np.testing.assert_allclose(r, aims[link].position, atol=1e-6)
        quaternion = aims[link].quaternion
        if quaternion is not None:
            assert (R.inv() * Rotation.from_quat(quaternion)).magnitude() < 1e-6
        assert result.summary["end_effectors"][link]["position_error_m"] < 1e-9
    assert result.summary["goal"] is None
    assert result.summary["position_error_m"] is None
    # Without ROS, bit for bit, and saved.
    flown = fly(scenario)
    np.testing.assert_array_equal(flown.q, flight.q)
    np.testing.assert_array_equal(flown.pose, flight.pose)
    flown.save(tmp_path / "saved.mcap")
    saved = read_run(tmp_path / "saved.mcap")
    for each in (flight, saved):
        assert each.outcome is flown.outcome
        assert each.end_effector_errors.keys() == aims.keys()
        assert each.error is None


def test_a_scenario_is_written_with_its_end_effectors(tmp_path: Path) -> None:
    file = tmp_path / "again.yaml"
    file.write_text(scenario_text(load_scenario("two_hands")), "utf-8")
    again = load_scenario(str(file))
    assert again.goal.equals(load_scenario("two_hands").goal)
    assert again.planner.end_effectors == ("left_link_7", "right_link_7")


def test_a_scenario_may_have_paths_of_end_effectors(tmp_path: Path) -> None:
    """A list of positions or poses: as it is written, and in the records of a bag."""
    way = [[0.4, 0.1, 0.8], [0.5, -0.1, 0.7]]
    aims = [
        EndEffectorGoal.along("link_5", way),
        EndEffectorGoal.checked("link_7", [0.4, 0.1, 1.8]),
    ]
    scenario, file = load_scenario("reach").with_end_effectors(aims), tmp_path / "again.yaml"
    file.write_text(scenario_text(scenario), "utf-8")
    for again in (scenario, load_scenario(str(file))):
        assert again.goal.links_with_paths == {"link_5"}
        given = json.loads(again.records(())["scenario"]["end_effector_goals"])
        assert given == {"link_5": way, "link_7": [0.4, 0.1, 1.8]}


@pytest.mark.usefixtures("own_domain")
@pytest.mark.slow
@pytest.mark.parametrize("nodes", [False, True])
def test_a_path_is_flown_and_in_the_bag(tmp_path: Path, nodes: bool) -> None:
    """Nodes are sent it as a path; the hand passes its corner, by the poses of the bag."""
    way = [[1.5, 0.7, 1.3], [1.3, 0.9, 0.8]]
    robot = scenario_or_robot("three_joint_arm").with_overrides(
        "plant", {"initial_joint_positions": [0.4, -0.9, 1.1]}
    )
    scenario = robot.with_end_effectors([EndEffectorGoal.along("", way)])
    result = run_scenario(scenario, tmp_path / "path.mcap", nodes=nodes)
    assert result.succeeded
    series = read_bag(tmp_path / "path.mcap")["/end_effector_pose"]
    places = series.table([f"pose.position.{axis}" for axis in "xyz"], 3)
    assert np.linalg.norm(places[-1] - way[1]) < 1e-6
    assert np.linalg.norm(places - way[0], axis=1).min() < 0.03
    flight = read_run(tmp_path / "path.mcap")
    assert flight.scenario.goal.links_with_paths
    assert flight.outcome is Outcome.REACHED


def test_another_end_effector_is_heard_by_the_planner_without_being_listed() -> None:
    aim = EndEffectorGoal.checked("link_5", [0.4, 0.1, 0.8])
    scenario = load_scenario("reach").with_end_effectors([aim])
    assert scenario.planner.end_effectors == ("link_7", "link_5")
    assert scenario.end_effectors == ("link_5",)
    # Another goal of the base takes its place.
    assert not scenario.with_goal(rotvec=[0.0, 0.0, 0.1]).goal.end_effectors


@pytest.mark.parametrize(
    ("goals", "message"),
    [
        ("{link_7: [1.0, 2.0]}", "takes 3, a position, or 7"),
        ("{link_7: [0, 0, 1, 0, 0, 0, 0]}", "zero quaternion"),
        ("[1.0, 2.0, 3.0]", r"has no poses by name: \[1.0, 2.0, 3.0\]\.$"),
        ("1.5", r"has no poses by name: 1.5\.$"),
        ("{link_7: far}", "is not a list of numbers"),
        ("{link_7: [[0, 0, 1], [0, 0, 1, 0]]}", "is not a list of numbers"),
        ("{link_7: [[0, 0, 1, 0], [0, 0, 1, 0]]}", "each of its poses takes 3 numbers"),
    ],
)
def test_goals_of_a_file_that_are_none_are_refused(
    tmp_path: Path, goals: str, message: str
) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(
        f"scenario: {{ros__parameters: {{end_effector_goals: {goals}}}}}\n"
        "plant: {ros__parameters: {robot: seven_joint_arm}}\n"
    )
    with pytest.raises(ParameterError, match=message):
        load_scenario(str(file))


@pytest.mark.usefixtures("own_domain")
def test_a_part_of_the_base_is_not_sent_with_an_end_effector(tmp_path: Path) -> None:
    aim = EndEffectorGoal.checked("link_7", [0.4, 0.1, 0.8])
    scenario = load_scenario("reach").with_end_effectors([aim], frozenset({"attitude"}))
    with pytest.raises(ParameterError, match="whole pose of the base or with none"):
        run_scenario(scenario, tmp_path / "run.mcap", nodes=True)
