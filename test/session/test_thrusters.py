"""The servicing spacecraft flown through ROS on thrusters that are on or off."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario

MILLIMETRE = 1e-3
TENTH_OF_A_DEGREE = np.radians(0.1)


@pytest.fixture(autouse=True)
def own_domain(ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))


def status(bag: Bag, name: str) -> dict[str, str]:
    """Return the last values of one status in the diagnostics."""
    values: dict[str, str] = {}
    for _, message in bag["/diagnostics"].messages():
        for entry in message.status:
            if entry.name.endswith(name):
                values = {pair.key: pair.value for pair in entry.values}
    return values


@pytest.mark.slow
@pytest.mark.parametrize("excluded", ["", "plus_x_1 minus_y_4 plus_z_2"], ids=["all", "dead"])
def test_both_poses_are_reached_by_pulses(excluded: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    scenario = load_scenario("servicer_thrusters").with_overrides(
        "plant", {"thrusters_excluded": excluded}
    )
    result = run_scenario(scenario, path)
    summary, bag = result.summary, read_bag(path)
    assert result.succeeded, result.message
    assert summary["position_error_m"] <= MILLIMETRE
    assert summary["attitude_error_rad"] <= TENTH_OF_A_DEGREE
    assert summary["end_effector_position_error_m"] <= MILLIMETRE
    assert summary["end_effector_attitude_error_rad"] <= TENTH_OF_A_DEGREE

    momentum = np.asarray(bag["/momentum"].field("data"))[:, :6]
    expected = np.asarray(bag["/momentum_expected"].field("data"))
    largest = np.linalg.norm(momentum[:, :3], axis=1).max()
    assert np.abs(momentum - expected).max() <= 1e-12 * max(1.0, largest)

    series = bag["/thrusters"]
    names = list(next(series.messages())[1].name)
    on_time, duty = (np.asarray(series.field(name)) for name in ("position", "velocity"))
    thrust = np.asarray(series.field("effort"))
    # Ten newton and 290 s, as the URDF has them.
    used = on_time[-1].sum() * 10.0 / (9.80665 * 290.0)
    # The summary has it from the diagnostics, which come once a second.
    before = on_time[-101].sum() * 10.0 / (9.80665 * 290.0)
    assert before * (1 - 1e-8) <= summary["propellant_kg"] <= used * (1 + 1e-8)
    assert 0.01 < used < 0.1
    np.testing.assert_allclose(thrust, 10.0 * duty, atol=1e-12)
    assert np.mean((duty == 0.0) | (duty > 1.0 - 1e-9)) > 0.97
    for name in excluded.split():
        assert not on_time[:, names.index(name)].any()

    wrench = bag["/base_wrench_realised"]
    force_B = np.column_stack([wrench.field(f"wrench.force.{x}") for x in "xyz"])
    odom = bag["/odom"]
    turns = Rotation.from_quat(
        np.column_stack([odom.field(f"pose.pose.orientation.{x}") for x in "xyzw"])
    )
    impulse = 0.01 * turns.apply(force_B).sum(axis=0)
    # The last attitude of a tick instead of that of its middle.
    np.testing.assert_allclose(impulse, momentum[-1, :3], atol=0.05)
    counted = status(bag, "thrusters")
    assert float(counted["propellant_kg"]) == summary["propellant_kg"]
    assert int(counted["unmet_ticks"]) == 0
    assert int(counted["pulses"]) > 50
    assert verify_bag(path).difference is None


def test_thrusters_of_a_robot_that_nothing_pushes_are_refused(tmp_path: Path) -> None:
    scenario = load_scenario("servicer_thrusters").with_overrides(
        "plant", {"actuation": "velocity"}
    )
    with pytest.raises(ParameterError, match="has no wrench on the base"):
        run_scenario(scenario, tmp_path / "no.mcap")


@pytest.mark.slow
def test_a_short_flight_tells_what_thrusters_do(tmp_path: Path) -> None:
    """Two seconds of it: topics, diagnostics, and the warning of a direction that is missing."""
    path = tmp_path / "run.mcap"
    has_contact_forces = " ".join(f"minus_x_{number}" for number in range(1, 5))
    scenario = (
        load_scenario("servicer_thrusters")
        .with_overrides("plant", {"thrusters_excluded": has_contact_forces})
        .with_overrides("coordinated_control", {"time_limit": 2.0})
    )
    run_scenario(scenario, path)
    bag = read_bag(path)
    assert bag.topics["/thrusters"] == "sensor_msgs/msg/JointState"
    assert bag.message_count("/base_wrench_realised") == bag.message_count("/odom")
    sentences = [
        entry.message
        for _, message in bag["/diagnostics"].messages()
        for entry in message.status
        if entry.name.endswith("thrusters")
    ]
    assert sentences
    assert all("cannot give negative force along x" in sentence for sentence in sentences)
