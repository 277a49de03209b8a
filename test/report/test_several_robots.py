"""Reports and figures of a bag with several robots, each in its own namespace."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from support.command_line import CliRunner
from support.flight_bags import urdf_of
from support.made_bags import joint_states, made_bag, odometry
from support.made_bags import pose as pose_at
from support.sentences import assert_one_sentence

from spacerobot_ros.cli.main import main
from spacerobot_ros.report.flight import read_report
from spacerobot_ros.report.tables import result_table

JOINTS = {"/fleet/a": 1, "/fleet/b": 3}
TOLERANCES = {"/fleet/a": 0.125, "/fleet/b": 0.25}


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Two robots, of one and of three joints, that stand 1 m and 2 m from their goals."""
    path = tmp_path / "both.mcap"
    with made_bag(path) as (writer, say):
        for place, (name, n) in enumerate(JOINTS.items(), 1):
            values = {"position_tolerance": json.dumps(TOLERANCES[name]), "method": '"optimal"'}
            writer.add_metadata(f"parameters{name}/planner", values)
            urdf = urdf_of(n).replace("test_robot", f"robot_{n}").encode()
            title = f"{name.strip('/').replace('/', '.')}.robot_description.urdf"
            writer.add_attachment(title, urdf, "application/xml", 0)
            names = [f"joint_{i}" for i in range(n)]
            say(f"{name}/goal_pose", pose_at(0.0, 0, 0, 0, 0, 0, 0, 1), 0.0)
            for k in range(3):
                time = 0.5 * k
                at = (float(place), 0, 0, 0, 0, 0, 1)
                say(f"{name}/odom", odometry(time, *at, *np.zeros(6)), time)
                zeros = np.zeros(n).tolist()
                say(f"{name}/joint_states", joint_states(time, names, zeros, zeros), time)
    return path


@pytest.mark.parametrize("name", JOINTS)
def test_the_robot_that_is_named_is_the_one_that_is_shown(name: str, bag: Path) -> None:
    for given in (name, name.strip("/")):
        flight = read_report(bag, given)
        assert flight.robot is not None
        assert flight.robot.name == f"robot_{JOINTS[name]}"
        assert len(flight.joint_names) == JOINTS[name]
        (other,) = flight.other_robots
        assert {name, other} == set(JOINTS)
        distance = 1 + list(JOINTS).index(name)
        row = ("Position error", f"{distance} m (tolerance {TOLERANCES[name]} m)")
        assert row in result_table(flight).rows
    assert read_report(bag).bag.namespace == "/fleet/a"


def test_the_page_says_which_robot_it_shows_and_which_it_does_not(
    bag: Path, tmp_path: Path
) -> None:
    page = tmp_path / "b.html"
    words = ["report", str(bag), "-o", str(page), "--namespace", "fleet/b"]
    assert CliRunner().invoke(main, words).exit_code == 0
    text = page.read_text("utf-8")
    assert "<span>namespace /fleet/b</span><span>the bag also has /fleet/a</span>" in text
    words = ["figures", str(bag), "--only", "joints", "--format", "svg", "-o", str(tmp_path)]
    assert CliRunner().invoke(main, [*words, "--namespace", "/fleet/b"]).exit_code == 0
    assert "joint_2" in (tmp_path / "joints.svg").read_text("utf-8")
    assert CliRunner().invoke(main, words).exit_code == 0
    assert "joint_2" not in (tmp_path / "joints.svg").read_text("utf-8")


def test_a_namespace_without_a_robot_is_refused(bag: Path, tmp_path: Path) -> None:
    for command in ("report", "figures"):
        out = ["-o", str(tmp_path / "none")]
        result = CliRunner().invoke(main, [command, str(bag), "--namespace", "c", *out])
        assert result.exit_code == 2
        assert_one_sentence(result.stderr, "'c'", "/fleet/a, /fleet/b")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("fewer", [["a", "b"], ["a", "b", "z"]])
def test_joints_are_known_by_their_names_and_not_by_their_places(
    fewer: list[str], tmp_path: Path
) -> None:
    """As from publishers that have another order each, and two that have other joints."""
    orders = [["a", "b", "c"], ["c", "a", "b"], ["x", "y", "z"], ["b", "c", "a"], fewer]
    numbers = {"a": 1.0, "b": 2.0, "c": 3.0, "x": 7.0, "y": 8.0, "z": 9.0}
    path = tmp_path / "b.mcap"
    with made_bag(path) as (_, say):
        for k, names in enumerate(orders * 2):
            time = 0.5 * k
            position = [numbers[name] + time for name in names]
            velocity = [10.0 * numbers[name] for name in names]
            say("/joint_states", joint_states(time, names, position, velocity), time)
    flight = read_report(path)
    assert flight.joint_names == ("a", "b", "c")
    times = [0.0, 0.5, 1.5, 2.5, 3.0, 4.0]
    assert flight.shape.time.tolist() == times
    expected = np.array([1.0, 2.0, 3.0]) + np.array(times)[:, np.newaxis]
    np.testing.assert_array_equal(flight.shape.values, expected)
    np.testing.assert_array_equal(flight.rates.values, np.tile([10.0, 20.0, 30.0], (6, 1)))
