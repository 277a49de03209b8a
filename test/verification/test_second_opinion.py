"""Bags flown again: reference bags by the plant, and commands by MuJoCo."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import Result
from scipy.spatial.transform import Rotation
from support.command_line import CliRunner
from support.sentences import assert_one_sentence
from support.slow import some_fast
from support.urdf_text import link

from spacerobot_ros import fly
from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.flight.second_opinion import EngineComparison, EngineFlight
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.resources import resource_names, robot_file, share_directory
from spacerobot_ros.simulation import mujoco_model
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.loads import Surroundings
from spacerobot_ros.simulation.plant import InitialState
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

mujoco = pytest.importorskip("mujoco")

BAGS = Path(__file__).resolve().parents[2] / "bags"
QUICK = ("coordinated_control",)
LARGEST = {"reach": 1e-9, "two_hands": 2e-10, "gravity_gradient": 1e-10}
"""Errors by steps of 1 ms in fast motions or of 80 ms, m or rad; all others are below 2e-11."""


def opinion_of(path: Path) -> EngineComparison:
    found = verify_bag(path, mujoco=True)
    assert found.difference is None
    assert found.second_opinion is not None
    return found.second_opinion


def verify(path: Path) -> Result:
    return CliRunner().invoke(main, ["verify", str(path), "--engine", "mujoco"])


CAPTURES = ("capture", "servicing")
"""Bags with a target, which MuJoCo does not model here."""


@pytest.mark.parametrize(
    "name",
    some_fast([each for each in resource_names("bags", ".mcap") if each not in CAPTURES], *QUICK),
)
def test_mujoco_flies_reference_bags_to_the_same_states(name: str) -> None:
    path = BAGS / f"{name}.mcap"
    found = opinion_of(path)
    assert (found.agrees, found.stop_reason) == (True, "")
    assert max(found.position, found.attitude, found.joints) <= LARGEST.get(name, 2e-11)
    assert found.ticks == verify_bag(path).ticks
    assert found.engine.startswith("MuJoCo ")


@pytest.mark.parametrize(
    ("name", "link"),
    some_fast(
        [("coordinated_control", "link_1"), ("reach", "link_2")], ("coordinated_control", "link_1")
    ),
)
def test_a_thousandth_of_a_mass_is_noticed(
    name: str, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_urdf = mujoco_model.robot_spec

    def heavier(mujoco: Any, description: Any) -> Any:
        spec = of_urdf(mujoco, description)
        (body,) = (each for each in spec.bodies if each.name == link)
        body.mass *= 1.001
        return spec

    monkeypatch.setattr(mujoco_model, "robot_spec", heavier)
    result = verify(BAGS / f"{name}.mcap")
    assert result.exit_code == 1
    assert_one_sentence(result.stderr, "differs by more than 1e-08 m or rad")


def flown(tmp_path: Path, duration: float, **plant: Any) -> Path:
    """Fly paper 4's robot; return its bag."""
    path = tmp_path / "flown.mcap"
    settings = {f"plant.{name}": value for name, value in plant.items()}
    limit = {"coordinated_control.time_limit": duration}
    fly("coordinated_control", parameters={**settings, **limit}).save(path)
    return path


def test_faults_are_flown_and_held_joints_end_the_comparison(tmp_path: Path) -> None:
    """A slow joint moves as its actuator realises it; a brake is a force that nobody commands."""
    faults = ["joint_slow elbow 0.6 at 0.1", "joint_stuck shoulder at 0.47"]
    turned = [0.0, 0.0, 0.6, 0.8]
    path = flown(tmp_path, 0.8, faults=faults, initial_orientation=turned)
    result = verify(path)
    assert result.exit_code == 0, result.output
    note = result.stdout.splitlines()[-1]
    assert note.startswith("note        compared until joint 'shoulder' is held at 0.4")
    found = opinion_of(path)
    assert 40 <= found.ticks <= 48
    assert max(found.position, found.attitude, found.joints) < 1e-10


@pytest.mark.parametrize(
    "plant",
    [
        {
            "disturbances": [
                "link_1 force 0.4 2 0 at 0.13 until 0.37",
                "link_2 torque 0 0 -0.3 in link at 0.2",
            ]
        },
        {"orbit.mean_motion": 0.7, "orbit.orientation": [0.0, 0.6, 0.0, 0.8]},
        {"table.tilt": 0.02, "table.direction": 0.7, "table.friction": 0.3},
    ],
    ids=["wrenches", "gradient", "table"],
)
def test_external_loads_are_flown(tmp_path: Path, plant: dict[str, Any]) -> None:
    path = flown(tmp_path, 0.5, **plant)
    found = opinion_of(path)
    assert (found.stop_reason, found.ticks) == ("", 51)
    assert max(found.position, found.attitude, found.joints) < 1e-10


@pytest.mark.parametrize(
    "surroundings",
    some_fast(
        {
            "gradient": Surroundings(mean_motion=0.7, quaternion_WO=(0.0, 0.6, 0.0, 0.8)),
            "table": Surroundings(gravity_W=(0.3, -0.1, 0.2), friction=0.4),
        },
        "table",
    ),
)
def test_external_loads_are_flown_under_velocities(surroundings: Surroundings) -> None:
    """Where joint rates are given, loads change the momenta."""
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    start = InitialState(
        position=np.array([0.3, -0.2, 0.5]),
        quaternion=np.array([0.1, -0.5, 0.5, 0.7]),
        joint_positions=np.array([-0.4, -0.5, 0.2]),
        angular_momentum=np.array([0.2, -0.3, 0.1]),
    )
    period, pushed = 0.013, (f"{robot.link_names[2]} force 0 2 0.5 at 0.1",)
    config = PlantConfig(actuation="velocity", tick_rate=1 / period, disturbances=pushed)
    plant = PlantWithFaults(VelocityPlant(robot, period, start), config, surroundings)
    flight = EngineFlight(plant, period)
    poses, shapes = [plant.pose.copy()], [plant.q.copy()]
    for tick in range(30):
        plant.step(0.2 * np.cos(np.arange(robot.n) + 0.1 * tick))
        flight.fly_next_tick()
        poses.append(plant.pose.copy())
        shapes.append(plant.q.copy())
    found = flight.comparison(np.arange(31), np.array(poses), np.array(shapes))
    assert (found.stop_reason, found.ticks) == ("", 30)
    assert np.linalg.norm(plant.momentum[:3]) > 0.1
    assert max(found.position, found.attitude, found.joints) < 1e-10
    # Differences of a bag, which has further ticks.
    poses[7] = poses[7] + np.array([0.001, 0.002, -0.002, 0, 0, 0, 0])
    turn = Rotation.from_rotvec([0.0, 0.003, 0.004])
    poses[9][3:] = (Rotation.from_quat(poses[9][3:]) * turn).as_quat()
    shapes[8] = shapes[8] - np.array([0.0, 0.006, 0.0])
    bag = [np.append(each, each[-1:], axis=0) for each in (np.array(poses), np.array(shapes))]
    found = flight.comparison(np.arange(32), *bag)
    assert found.ticks == 30
    assert found.time == pytest.approx(8 * period)
    assert found.position == pytest.approx(0.003)
    assert found.attitude == pytest.approx(0.005)
    assert found.joints == pytest.approx(0.006)


def test_a_joint_at_its_stop_ends_the_comparison(tmp_path: Path) -> None:
    pushed = ["actuator_bias elbow 20 at 0"]
    found = opinion_of(flown(tmp_path, 1.2, faults=pushed, initial_joint_positions=[-1.0, 2.78]))
    assert found.stop_reason.startswith("joint 'elbow' is at its stop at ")
    assert found.ticks > 20
    assert found.joints < 1e-8


def test_without_mujoco_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    result = verify(BAGS / "reach.mcap")
    assert result.exit_code == 2
    assert_one_sentence(result.stderr, "pip install '.[mujoco]' in the clone")


def test_joints_that_follow_others_are_refused() -> None:
    text = robot_file("planar_chain").read_text("utf-8")
    mimic = '<mimic joint="pin_1" multiplier="-0.5"/>'
    before, joint, after = text.partition('<joint name="pin_2" type="continuous">')
    robot = parse_robot(f"{before}{joint}{mimic}{after}")
    assert robot.has_mimic_joints
    with pytest.raises(RobotDescriptionError, match="<mimic>"):
        mujoco_model.build_model(mujoco, robot, None, 0.001)
    # An impossible inertia, for which the base makes up.
    rod = link("rod", 0.1, np.diag([0.01, 0.01, 0.03]), np.zeros(3))
    weld = '<joint name="weld" type="fixed"><parent link="base_link"/><child link="rod"/></joint>'
    robot = parse_robot(text.replace("</robot>", f"{rod}{weld}</robot>"))
    with pytest.raises(RobotDescriptionError, match="`spacerobot new URDF --nearest-inertia`"):
        mujoco_model.build_model(mujoco, robot, None, 0.001, contacts=False)


# -- the reference bags: every scenario has one, every reader reads it, and it can be ------------


SHARED_BAGS = share_directory() / "bags"
NAMES = resource_names("config", ".yaml")

QUICK_BAGS = ("sliding_masses", "arm_attitude", "planar_chain", "coordinated_control")
"""Bags of which all tests are quick."""

MIN_TICKS = {"reach": 30, "two_hands": 25, "strut": 50, "capture": 150, "gravity_gradient": 200}
MIN_TICKS |= {"free_flyer": 200, "wheels": 250}
"""Flights of these are short, or have few ticks a second."""


def test_every_scenario_has_a_bag_and_they_are_small() -> None:
    assert resource_names("bags", ".mcap") == NAMES
    assert sum(path.stat().st_size for path in SHARED_BAGS.iterdir()) < 5_500_000


@pytest.mark.parametrize("name", some_fast(NAMES, *QUICK_BAGS))
def test_the_commands_in_it_give_the_states_in_it(name: str) -> None:
    # Where this fails, the plant behaves in another way than before: `make bags` if that is meant.
    result = verify_bag(SHARED_BAGS / f"{name}.mcap")
    assert result.difference is None, str(result.difference)
    assert result.ticks > MIN_TICKS.get(name, 300)
    # Clock, end-effector and base pose apart, three messages tell the state of every tick.
    assert result.messages > 3 * result.ticks
