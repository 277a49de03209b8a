"""The scenarios in config/faults: flown, measured by the truth in their bags, flown again."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import read_bag
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.resources import share_directory
from spacerobot_ros.scenario import load_scenario, parse_kills
from spacerobot_ros.session.processes import KillTimeline
from spacerobot_ros.session.run import run_scenario

pytestmark = pytest.mark.usefixtures("own_domain")

# Whether the goal is met, and to how many m and rad of the truth; None: not the method's to meet.
EXPECTED: dict[str, tuple[bool, float | None, float | None]] = {
    "noisy_sensors": (True, 3e-3, 2.6e-3),
    "wrong_masses": (True, 1e-3, 1e-3),
    "stuck_elbow": (True, None, 1e-3),
    "stuck_slider": (False, None, None),
    "broken_thrusters": (True, 4e-3, 4e-3),
    "closed_nozzle": (True, 5e-3, 1e-2),
    "weak_motors": (True, 2e-3, 2e-3),
    "wheel_failure": (True, 4e-3, 4e-3),
    "late_poses": (True, 2e-3, 2e-3),
    "biased_pose": (False, 0.11, 2e-3),
    "missed_capture": (False, 1e-6, 1e-6),
}
KILLED = "killed_nodes"


def test_every_scenario_is_here() -> None:
    files = {path.stem for path in (share_directory() / "config" / "faults").glob("*.yaml")}
    assert files == {*EXPECTED, KILLED}


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPECTED)
def test_a_scenario_ends_as_documented_and_can_be_flown_again(name: str, tmp_path: Path) -> None:
    met, distance, angle = EXPECTED[name]
    scenario = load_scenario(f"faults/{name}")
    result = run_scenario(scenario, tmp_path / "run.mcap")
    assert result.succeeded is met, result.message
    bag = read_bag(tmp_path / "run.mcap")
    odom = bag["/odom_true" if "/odom_true" in bag.topics else "/odom"]
    position = [odom.field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    quaternion = [odom.field(f"pose.pose.orientation.{x}")[-1] for x in "xyzw"]
    left = np.linalg.norm(position - scenario.goal.position)
    turn = Rotation.from_quat(quaternion).inv() * Rotation.from_quat(scenario.goal.quaternion)
    if distance is not None:
        assert left <= distance
    if angle is not None:
        assert turn.magnitude() <= angle
    if name == "biased_pose":
        assert left >= 0.09, "it is believed"
    if name == "stuck_slider":
        assert "stuck" in result.message
    assert result.summary["succeeded_by_measurement"] is (name != "stuck_slider")
    # The summary is of the truth.
    assert result.summary["position_error_m"] == pytest.approx(left, abs=1e-12)
    verification = verify_bag(tmp_path / "run.mcap")
    assert verification.difference is None, str(verification.difference)


@pytest.mark.slow
def test_killed_nodes_go_on_to_the_goal(tmp_path: Path) -> None:
    scenario = load_scenario(f"faults/{KILLED}").in_real_time(4.0)
    result = run_scenario(scenario, tmp_path / "run.mcap", nodes=True)
    assert result.succeeded, result.message
    bag = read_bag(tmp_path / "run.mcap")
    end = [bag["/odom"].field(f"pose.pose.position.{x}")[-1] for x in "xyz"]
    assert np.linalg.norm(end - scenario.goal.position) <= 1e-3
    # While the planner was away the joints rested.
    states, commands = bag["/joint_states"], bag["/joint_commands"]
    silent = (states.stamp > 12.0) & (states.stamp <= 14.0)
    assert silent.sum() > 20
    assert not np.asarray(states.field("velocity"))[silent].any()
    assert not ((commands.stamp > 12.0) & (commands.stamp <= 14.0)).any()
    # The recorder needs a moment to find the plant again; the flight goes on to its end.
    assert states.stamp[-1] > 80.0


@pytest.mark.slow
def test_nodes_that_are_killed_between_capture_and_goal_go_on_with_the_held_body(
    tmp_path: Path,
) -> None:
    """First the controller, then the plant: the momenta are those of the thrust all the time."""
    kills = parse_kills(["coordinated_control at 2 until 3", "plant at 6 until 8"], "the test")
    scenario = (
        replace(load_scenario("capture").in_real_time(1.0), kills=kills)
        .with_overrides("plant", {"tick_rate": 50.0})
        .with_overrides("coordinated_control", {"tick_rate": 50.0, "settle_time": 8.0})
        .with_overrides("recorder", {"flush_period": 0.1})
    )
    result = run_scenario(scenario, tmp_path / "run.mcap", nodes=True)
    assert result.succeeded, result.message
    bag = read_bag(tmp_path / "run.mcap")
    momenta, expected = (
        np.array([each[:6] for each in bag[topic].field("data")])
        for topic in ("/momentum", "/momentum_expected")
    )
    # The robot is alone in the first state: the target's momentum is not its own.
    assert np.abs(momenta[1:2]).max() > 0.1
    count = min(len(momenta), len(expected))
    np.testing.assert_allclose(momenta[-count:], expected[-count:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("nodes", [False, True])
def test_kills_need_nodes_in_real_time(tmp_path: Path, nodes: bool) -> None:
    scenario = load_scenario(f"faults/{KILLED}")
    with pytest.raises(ParameterError) as caught:
        run_scenario(scenario, tmp_path / "run.mcap", nodes=nodes)
    assert_one_sentence(str(caught.value), "kills nodes on the way", "--nodes", "--realtime")
    assert not (tmp_path / "run.mcap").exists()


def test_kills_come_in_their_order() -> None:
    lines = ["plant at 5 until 6", "planner  at 1 until 4.5", "planner at 7"]
    kills = parse_kills(lines, "x.yaml")
    timeline = KillTimeline(kills)
    assert timeline.due(0.5) == ([], [])
    assert timeline.due(1.0) == (["planner"], [])
    assert timeline.away == {"planner"}
    assert timeline.due(4.5) == ([], ["planner"])
    assert timeline.away == set()
    assert timeline.due(5.5) == (["plant"], [])
    assert timeline.due(100.0) == (["planner"], ["plant"])
    assert timeline.due(200.0) == ([], [])
    assert timeline.away == {"planner"}
