"""The servicing spacecraft and its six-joint arm, flown through ROS to two poses together."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import RunResult, run_scenario

Array = npt.NDArray[np.float64]

URDF = Path(__file__).parents[2] / "urdf" / "servicer.urdf"
MILLIMETRE = 1e-3
TENTH_OF_A_DEGREE = np.radians(0.1)
# As the scenario's file has them: position (m), rotation vector (rad).
GOALS = {
    "base_link": ([1.0, 0.4, -0.2], [0.1, -0.2, 0.5]),
    "end_effector": ([2.28, 1.85, 0.79], [-0.56, 0.95, 1.05]),
}
GAINS: dict[str, dict[str, Any]] = {
    "transposed_jacobian": {},
    "model_based": {
        f"gains.{group}_{kind}.{name}": value
        for group in ("base", "end_effector")
        for kind in ("position", "attitude")
        for name, value in (("kp", 1.0), ("kd", 2.0))
    },
}
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_domain")]


@pytest.fixture(params=["transposed_jacobian", "model_based"])
def law(request: pytest.FixtureRequest) -> str:
    """Return a law; the quick tests of the controller fly the other one without ROS."""
    return str(request.param)


@pytest.fixture
def unlimited(
    law: str, flown: dict[str, RunResult], tmp_path_factory: pytest.TempPathFactory
) -> RunResult:
    """Return the flight by a law without limits."""
    if law not in flown:
        flown[law] = fly(tmp_path_factory.mktemp(law) / "run.mcap", law)
    return flown[law]


def fly(bag: Path, law: str, robot: Path | None = None, **settings: Any) -> RunResult:
    """Fly with a law; ``robot`` is what the plant is, whatever the controller believes."""
    scenario = load_scenario("servicer").with_overrides(
        "coordinated_control", {"law": law, **GAINS[law], **settings}
    )
    if robot is not None:
        scenario = scenario.with_overrides("plant", {"robot": str(robot)})
    return run_scenario(scenario, bag)


def assert_arrived(result: RunResult) -> Bag:
    """Both poses, as Pinocchio has them from the last joint positions, are the goals."""
    bag = read_bag(result.summary["bag"])
    assert result.succeeded, result.message
    odom, joints = bag["/odom"], bag["/joint_states"]
    names = list(next(joints.messages())[1].name)
    oracle = PinocchioOracle(bag.attachments["robot_description.urdf"].decode(), names)
    oracle.set_configuration(
        np.asarray(joints.field("position"))[-1],
        [odom.field(f"pose.pose.orientation.{x}")[-1] for x in "xyzw"],
        [odom.field(f"pose.pose.position.{x}")[-1] for x in "xyz"],
    )
    for link, (position, rotvec) in GOALS.items():
        R, r = oracle.frame_W(link)
        turn = Rotation.from_rotvec(rotvec) * Rotation.from_matrix(R).inv()
        assert np.linalg.norm(r - position) <= MILLIMETRE, link
        assert turn.magnitude() <= TENTH_OF_A_DEGREE, link
    return bag


def peaks(bag: Bag) -> tuple[float, float]:
    """Return the largest thruster force (N) and torque (N m) of a flight."""
    wrench = bag["/base_wrench"]
    force, torque = (
        np.column_stack([wrench.field(f"wrench.{part}.{x}") for x in "xyz"])
        for part in ("force", "torque")
    )
    return (
        float(np.linalg.norm(force, axis=1).max()),
        float(np.linalg.norm(torque, axis=1).max()),
    )


def status_values(bag: Bag, key: str) -> list[float]:
    return [
        float(pair.value)
        for _, message in bag["/controller/status"].messages()
        for pair in message.values
        if pair.key == key
    ]


def scaled(path: Path, factor: Callable[[], float]) -> Path:
    """Write the servicer with every mass, and every inertia, times a factor of its own."""
    tree = ET.parse(URDF)
    for inertial in tree.iter("inertial"):
        for name in ("mass", "inertia"):
            element, by = inertial.find(name), factor()
            assert element is not None
            for key, value in element.attrib.items():
                element.set(key, repr(float(value) * by))
    tree.write(path)
    return path


def test_both_poses_are_reached(unlimited: RunResult, law: str) -> None:
    bag = assert_arrived(unlimited)
    summary = unlimited.summary
    assert summary["method"] == law
    assert summary["position_error_m"] <= MILLIMETRE
    assert summary["attitude_error_rad"] <= TENTH_OF_A_DEGREE
    assert summary["end_effector_position_error_m"] <= MILLIMETRE
    assert summary["end_effector_attitude_error_rad"] <= TENTH_OF_A_DEGREE
    # Nothing is limited by default: neither by thrusters, nor by the joints of the URDF.
    assert not any(status_values(bag, "lost_force_N"))
    assert not any(status_values(bag, "lost_effort"))


def test_momentum_is_what_the_thrusters_gave(unlimited: RunResult) -> None:
    bag = read_bag(unlimited.summary["bag"])
    momentum = np.asarray(bag["/momentum"].field("data"))[:, :6]
    expected = np.asarray(bag["/momentum_expected"].field("data"))
    for part in (slice(0, 3), slice(3, 6)):
        largest = np.linalg.norm(momentum[:, part], axis=1).max()
        off = np.linalg.norm(momentum[:, part] - expected[:, part], axis=1).max()
        assert off <= 1e-12 * largest


def test_lost_thrust_is_reported(law: str, tmp_path: Path) -> None:
    """The goal at once demands more than small thrusters give: status says how much is lost."""
    force, torque = 2.0, 0.5
    settings: dict[str, Any] = {
        "profile": "step",
        "max_force": force,
        "max_torque": torque,
        "time_limit": 5.0,
    }
    result = fly(tmp_path / "run.mcap", law, **settings)
    bag = read_bag(tmp_path / "run.mcap")
    given_force, given_torque = peaks(bag)
    assert given_force == pytest.approx(force, rel=1e-12)
    assert given_torque == pytest.approx(torque, rel=1e-12)
    assert status_values(bag, "lost_force_N")[0] > 10 * force
    assert status_values(bag, "lost_torque_Nm")[0] > 10 * torque
    assert result.summary["state"] == "failed"
    assert "not reached in time" in result.message


def test_both_poses_are_reached_with_a_tenth_of_the_thrust(
    unlimited: RunResult, law: str, tmp_path: Path
) -> None:
    """The scenario as it is, but for the thrusters: the reference becomes slower by itself."""
    force, torque = (peak / 10 for peak in peaks(read_bag(unlimited.summary["bag"])))
    result = fly(tmp_path / "run.mcap", law, max_force=force, max_torque=torque)
    bag = assert_arrived(result)
    given_force, given_torque = peaks(bag)
    assert force / 4 < given_force <= force * (1 + 1e-12)
    assert given_torque <= torque * (1 + 1e-12)
    assert result.summary["sim_time_s"] > 2 * unlimited.summary["sim_time_s"]


def heavier() -> Callable[[], float]:
    return lambda: 1.1


def either_way() -> Callable[[], float]:
    rng = np.random.default_rng(4)
    return lambda: float(rng.uniform(0.9, 1.1))


@pytest.mark.parametrize("error", [heavier, either_way])
def test_both_poses_are_reached_with_wrong_masses(
    law: str, error: Callable[[], Callable[[], float]], tmp_path: Path
) -> None:
    robot = scaled(tmp_path / "other.urdf", error())
    assert robot.read_text("utf-8") != URDF.read_text("utf-8")
    bag = assert_arrived(fly(tmp_path / "run.mcap", law, robot))
    assert 'mass value="400"' not in bag.attachments["robot_description.urdf"].decode()
