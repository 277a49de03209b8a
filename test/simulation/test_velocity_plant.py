"""The plant under held joint velocities: conservation, another integration, starts, limits."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.spatial.transform import Rotation
from support.effort_flights import robot_of, tumbling
from support.oracles import Array, Motion, PinocchioOracle
from support.oracles.integrated import carried, tumbled_body
from support.random_robots import random_robot_urdf

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import find_compiler
from spacerobot_ros.model.description import Inertia
from spacerobot_ros.model.grasp import BodyMotion
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant
from spacerobot_ros.simulation.config import PlantConfig

TICK = 0.05
RATE, STROKE = 2.0, 3.0  # of the joints of random robots
SLIDING_MASSES = robot_file("sliding_masses")


class Case:
    """A random robot in a random state, and the engine that watches it."""

    def __init__(self, seed: int, *, momentum: bool) -> None:
        self.rng = rng = np.random.default_rng(seed)
        self.urdf = random_robot_urdf(rng, int(rng.integers(3, 7)))
        self.robot = robot_of(self.urdf)
        self.oracle = PinocchioOracle(self.urdf, self.robot.joint_names)
        n = self.robot.n
        quaternion = rng.normal(size=4)
        self.initial = InitialState(
            position=rng.uniform(-2.0, 2.0, 3),
            quaternion=quaternion / np.linalg.norm(quaternion),
            # Not far from the ends of the strokes.
            joint_positions=rng.uniform(2.0, 2.9, n) * rng.choice([-1.0, 1.0], n),
            linear_momentum=rng.normal(size=3) if momentum else np.zeros(3),
            angular_momentum=rng.normal(size=3) if momentum else np.zeros(3),
        )

    def plant(self, **options: Any) -> VelocityPlant:
        return VelocityPlant(self.robot, TICK, self.initial, **options)

    def command(self) -> Array:
        """Return random rates, many of them more than a joint can do."""
        return self.rng.uniform(-1.3 * RATE, 1.3 * RATE, self.robot.n)

    def body_momenta(self, plant: VelocityPlant) -> tuple[Array, Array]:
        """Return linear and angular momentum of every body (L, 3), world, the latter about the
        system's centre of mass.
        """
        oracle = self.oracle
        oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
        u = oracle.base_velocities(plant.twist) + oracle.joint_velocities(plant.qdot)
        pin.forwardKinematics(oracle.model, oracle.data, oracle.q, u)
        r_cm = oracle.center_of_mass_W()
        linear, angular = [], []
        for index in range(1, oracle.model.njoints):
            own = oracle.model.inertias[index] * oracle.data.v[index]
            about_origin = oracle.data.oMi[index].act(own)
            linear.append(np.array(about_origin.linear))
            angular.append(about_origin.angular - np.cross(r_cm, about_origin.linear))
        return np.array(linear), np.array(angular)


def sliding_masses(**initial: Any) -> VelocityPlant:
    """Return three sliders of 0.7 m/s and 2.5 m either way."""
    robot = robot_of(SLIDING_MASSES.read_text("utf-8"))
    return VelocityPlant(robot, TICK, InitialState(**initial))


# -- conservation -----------------------------------------------------------------------------


@pytest.mark.parametrize("momentum", [False, True], ids=["at rest", "drifting"])
@pytest.mark.parametrize("seed", range(4))
def test_momentum_is_conserved_and_the_centre_of_mass_goes_straight(
    seed: int, momentum: bool
) -> None:
    case = Case(seed, momentum=momentum)
    plant = case.plant()
    start = case.initial
    case.oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
    r_cm = case.oracle.center_of_mass_W()
    ledger, watched = [], []
    largest_p = largest_L = 0.0
    command = case.command()
    for tick in range(1, 121):
        if tick % 10 == 0:
            command = case.command()
        plant.step(command)
        linear, angular = case.body_momenta(plant)
        largest_p = max(largest_p, float(np.linalg.norm(linear, axis=1).sum()))
        largest_L = max(largest_L, float(np.linalg.norm(angular, axis=1).sum()))
        ledger.append(plant.momentum.copy())
        watched.append(np.concatenate([linear.sum(axis=0), angular.sum(axis=0)]))
        expected = r_cm + tick * TICK * start.linear_momentum / case.robot.total_mass
        np.testing.assert_allclose(case.oracle.center_of_mass_W(), expected, atol=1e-12)
    assert plant.limit_counts["rate"].sum() > 0
    assert plant.limit_counts["stroke"].sum() > 0
    for series in (np.array(ledger), np.array(watched)):
        drift_p = np.linalg.norm(series[:, :3] - start.linear_momentum, axis=1)
        drift_L = np.linalg.norm(series[:, 3:6] - start.angular_momentum, axis=1)
        assert drift_p.max() <= 1e-12 * largest_p
        assert drift_L.max() <= 1e-12 * largest_L


@pytest.mark.parametrize("seed", [0, 1])
def test_energy_twist_and_link_poses_are_those_of_pinocchio(seed: int) -> None:
    case = Case(seed, momentum=True)
    plant, oracle = case.plant(), case.oracle
    for _ in range(5):
        plant.step(case.command())
        oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
        momenta = np.concatenate([case.initial.linear_momentum, case.initial.angular_momentum])
        twist = oracle.base_twist(plant.q, plant.qdot, plant.pose[3:], momenta)
        np.testing.assert_allclose(plant.twist, twist, atol=1e-11)
        oracle.set_configuration(plant.q, plant.pose[3:], plant.pose[:3])
        oracle.move(oracle.base_velocities(plant.twist) + oracle.joint_velocities(plant.qdot))
        assert plant.momentum[6] == pytest.approx(oracle.momentum_W()[2], rel=1e-11)
        R_WB = Rotation.from_quat(plant.pose[3:]).as_matrix()
        for index, link in enumerate(case.robot.link_names):
            R_WL, r_WL = oracle.frame_W(link)
            R_BL, r_BL = plant.link_R[:, 3 * index : 3 * index + 3], plant.link_r[:, index]
            np.testing.assert_allclose(R_WB @ R_BL, R_WL, atol=1e-13)
            np.testing.assert_allclose(plant.pose[:3] + R_WB @ r_BL, r_WL, atol=1e-13)


@pytest.mark.parametrize("momentum", [False, True], ids=["at rest", "drifting"])
@pytest.mark.parametrize("seed", [0, 1])
def test_pinocchios_robot_accelerates_under_the_efforts_as_the_servos_did(
    seed: int, momentum: bool
) -> None:
    """They are those of the middle of the change of rates, at the state before the tick."""
    case = Case(seed, momentum=momentum)
    plant, oracle, start = case.plant(), case.oracle, case.initial
    momenta = np.concatenate([start.linear_momentum, start.angular_momentum])
    for _ in range(4):
        q, quaternion, before = plant.q.copy(), plant.pose[3:].copy(), plant.qdot.copy()
        plant.step(case.command())
        mean = (before + plant.qdot) / 2
        twist = oracle.base_twist(q, mean, quaternion, momenta)
        motion = Motion(q, mean, quaternion, np.zeros(3), np.ones(3), twist[3:])
        reached = oracle.forward_dynamics(motion, np.zeros(6), plant.effort)[6:]
        np.testing.assert_allclose(reached, (plant.qdot - before) / TICK, rtol=1e-9, atol=1e-8)
    plant.step(plant.qdot.copy())
    plant.reset()
    # On a spinning robot it takes efforts to stay in shape.
    assert np.any(np.abs(plant.effort) > 1e-3) == momentum


# -- another integration ----------------------------------------------------------------------


def integrated(case: Case, commands: list[Array]) -> tuple[Array, Array]:
    """Return pose and shape after held rates: base twist by Pinocchio, integrated by DOP853."""
    start = case.initial
    assert start.joint_positions is not None
    q, pose = start.joint_positions.copy(), np.append(start.position, start.quaternion)
    momenta = np.concatenate([start.linear_momentum, start.angular_momentum])
    kinds = [j.kind.value for j in case.robot.description.movable_joints]
    bounded = np.array([kind != "continuous" for kind in kinds])
    for command in commands:
        rates = np.clip(command, -RATE, RATE)
        lower = np.where(bounded, (-STROKE - q) / TICK, -np.inf)
        upper = np.where(bounded, (STROKE - q) / TICK, np.inf)
        rates = np.clip(rates, lower, upper)
        pose = carried(case.oracle, q, rates, TICK, pose, momenta)
        q = q + TICK * rates
    return pose, q


@pytest.mark.parametrize("momentum", [False, True], ids=["at rest", "drifting"])
@pytest.mark.parametrize("seed", [0, 1])
def test_motion_is_that_of_another_integration(seed: int, momentum: bool) -> None:
    case = Case(seed, momentum=momentum)
    plant = case.plant(integration_step=0.002)
    outwards = 1.2 * RATE * np.sign(plant.q)
    commands = [outwards] * 10 + [case.command() for _ in range(5)]
    for command in commands:
        plant.step(command)
    assert plant.limit_counts["rate"].all()
    assert plant.limit_counts["stroke"].any()
    pose, q = integrated(case, commands)
    np.testing.assert_allclose(plant.q, q, atol=1e-13)
    np.testing.assert_allclose(plant.pose[:3], pose[:3], rtol=0, atol=1e-9)
    turned = Rotation.from_quat(plant.pose[3:]).inv() * Rotation.from_quat(pose[3:])
    assert turned.magnitude() < 1e-9


@pytest.mark.parametrize("torque", [None, [0.3, -0.2, 0.1]], ids=["free", "under a torque"])
def test_a_body_without_joints_tumbles_as_euler_says(torque: list[float] | None) -> None:
    moments = np.array([1.0, 2.0, 2.5])
    urdf = (
        '<robot name="brick"><link name="brick"><inertial><mass value="4"/><inertia ixx="1" '
        'iyy="2" izz="2.5" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    L = np.array([0.3, 1.0, -0.4])
    initial = InitialState(linear_momentum=np.array([4.0, 0.0, -2.0]), angular_momentum=L)
    kind: Any = VelocityPlant if torque is None else EffortPlant
    commands = [np.zeros(0)]
    if torque is not None:
        commands.append(np.array([0.0, 0.0, 0.0, *torque]))
    plant = kind(SpaceRobot.from_urdf(urdf), TICK, initial)

    start = BodyMotion(np.eye(3), np.zeros(3), np.array([1.0, 0.0, -0.5]), L / moments)
    times = np.linspace(TICK, 100 * TICK, 100)
    inertia = Inertia(4.0, np.zeros(3), np.diag(moments))
    given = np.zeros(3) if torque is None else np.array(torque)
    _, r, omega = tumbled_body(inertia, start, times, lambda t, R: given)
    for tick in range(100):
        plant.step(*commands)
        np.testing.assert_allclose(plant.twist[3:], omega[tick], atol=1e-8)
        np.testing.assert_allclose(plant.pose[:3], r[tick], atol=1e-12)
        energy = float(moments @ omega[tick] ** 2) / 2 + float(np.sum([16.0, 4.0])) / 8
        assert plant.momentum[6] == pytest.approx(energy, rel=1e-8)


# -- start and reset --------------------------------------------------------------------------


def test_a_quaternion_of_any_length_is_taken() -> None:
    plant = sliding_masses(quaternion=np.array([0.0, 0.0, -3.0, 4.0]))
    np.testing.assert_allclose(plant.pose[3:], [0.0, 0.0, -0.6, 0.8])


def test_a_stroke_without_zero_starts_at_its_nearest_end() -> None:
    text = SLIDING_MASSES.read_text("utf-8")
    text = text.replace('lower="-2.5"', 'lower="0.5"', 1)
    plant = VelocityPlant(SpaceRobot.from_urdf(text), TICK)
    np.testing.assert_array_equal(plant.q, [0.5, 0.0, 0.0])


@pytest.mark.parametrize("momentum", [False, True])
def test_a_reset_is_a_new_start_to_the_last_bit(momentum: bool) -> None:
    case = Case(5, momentum=momentum)
    commands = [case.command() for _ in range(20)]
    plant, first = case.plant(), []
    begin = [x.copy() for x in (plant.pose, plant.twist, plant.q, plant.qdot, plant.momentum)]
    for command in commands:
        plant.step(command)
        first.append(plant.pose.copy())
    counted = plant.limit_counts["rate"].copy()
    plant.reset()
    for now, then in zip(
        (plant.pose, plant.twist, plant.q, plant.qdot, plant.momentum), begin, strict=True
    ):
        np.testing.assert_array_equal(now, then)
    np.testing.assert_array_equal(plant.limit_counts["rate"], counted)
    for command, pose in zip(commands, first, strict=True):
        plant.step(command)
        np.testing.assert_array_equal(plant.pose, pose)


def test_two_plants_of_one_robot_do_not_share_anything() -> None:
    case = Case(1, momentum=True)
    one, two = case.plant(), case.plant()
    before = two.pose.copy()
    for _ in range(5):
        one.step(case.command())
    np.testing.assert_array_equal(two.pose, before)


def test_compiled_it_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    momenta = {"linear_momentum": rng.normal(size=3), "angular_momentum": rng.normal(size=3)}
    interpreted = sliding_masses(**momenta)
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    if find_compiler() is None:
        pytest.skip("no C compiler")
    robot = SpaceRobot.from_file(SLIDING_MASSES)
    compiled = VelocityPlant(robot, TICK, interpreted.initial)
    for _ in range(50):
        command = rng.uniform(-1.0, 1.0, 3)
        interpreted.step(command)
        compiled.step(command)
        for one, other in (
            (interpreted.pose, compiled.pose),
            (interpreted.twist, compiled.twist),
            (interpreted.momentum, compiled.momentum),
        ):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)


# -- limits -----------------------------------------------------------------------------------


def test_a_rate_is_clipped_and_counted_once_a_tick() -> None:
    plant = sliding_masses()
    assert plant.step(np.array([0.70001, -0.7, 5.0]))
    np.testing.assert_array_equal(plant.qdot, [0.7, -0.7, 0.7])
    np.testing.assert_allclose(plant.q, [0.035, -0.035, 0.035])
    assert not plant.step(np.array([0.7, 0.0, -0.7]))
    assert plant.step(np.array([0.0, 0.0, -np.inf]))
    np.testing.assert_array_equal(plant.limit_counts["rate"], [1, 0, 2])
    np.testing.assert_array_equal(plant.limit_counts["stroke"], [0, 0, 0])


def test_a_joint_stops_at_the_end_of_its_stroke_and_comes_back() -> None:
    plant = sliding_masses(joint_positions=np.array([2.49, -2.5, 0.0]))
    assert plant.step(np.array([0.7, -0.3, 0.7]))
    np.testing.assert_allclose(plant.qdot, [0.2, 0.0, 0.7], atol=1e-12)
    np.testing.assert_allclose(plant.q, [2.5, -2.5, 0.035], rtol=1e-15)
    np.testing.assert_array_equal(plant.limit_counts["stroke"], [1, 1, 0])
    np.testing.assert_array_equal(plant.limit_counts["rate"], [0, 0, 0])
    # Too fast and too far at once counts as both.
    assert plant.step(np.array([1.0, 0.3, 0.0]))
    np.testing.assert_array_equal(plant.limit_counts["stroke"], [2, 1, 0])
    np.testing.assert_array_equal(plant.limit_counts["rate"], [1, 0, 0])
    assert plant.qdot[0] == pytest.approx(0.0, abs=1e-12)
    assert not plant.step(np.array([-0.7, 0.3, 0.0]))
    np.testing.assert_allclose(plant.q, [2.465, -2.47, 0.035], rtol=1e-14)


# -- where a run starts, and what is refused -----------------------------------------------------


TREE = random_robot_urdf(np.random.default_rng(0), joints=3)
PLANTS = (EffortPlant, VelocityPlant)


@pytest.mark.parametrize("plant", PLANTS)
def test_center_of_mass_is_where_it_is_put(plant: Any) -> None:
    rng = np.random.default_rng(1)
    center = np.array([1.0, -2.0, 0.5])
    start = InitialState(
        quaternion=rng.normal(size=4), joint_positions=rng.uniform(-1, 1, 3), center_of_mass=center
    )
    built = plant(robot_of(TREE), 0.01, start)
    oracle = PinocchioOracle(TREE, robot_of(TREE).joint_names)
    oracle.set_configuration(built.q, built.pose[3:], built.pose[:3])
    np.testing.assert_allclose(oracle.center_of_mass_W(), center, atol=1e-13)


@pytest.mark.parametrize("plant", PLANTS)
def test_a_start_is_as_given(plant: Any) -> None:
    robot, zero = robot_of(TREE), np.zeros(3)
    start = tumbling(robot, np.random.default_rng(95))
    if plant is VelocityPlant:
        start = replace(start, linear_momentum=zero, angular_momentum=zero, joint_velocities=zero)
    built = plant(robot, 0.01, start)
    turned = Rotation.from_quat(start.quaternion).inv() * Rotation.from_quat(built.pose[3:])
    assert turned.magnitude() < 1e-14
    np.testing.assert_allclose(built.pose[:3], start.position, atol=1e-14)
    np.testing.assert_array_equal(built.q, start.joint_positions)
    np.testing.assert_array_equal(built.qdot, start.joint_velocities)
    np.testing.assert_allclose(built.momentum[:6], start.momenta(), atol=1e-13)
    if plant is VelocityPlant:
        np.testing.assert_allclose([*built.twist, built.momentum[6]], 0.0, atol=1e-15)


def test_position_given_twice_is_refused() -> None:
    with pytest.raises(ParameterError, match="set for both"):
        InitialState(position=np.array([0.0, 0.1, 0.0]), center_of_mass=np.zeros(3))
    assert InitialState(center_of_mass=np.zeros(3)).center_of_mass is not None


def test_joints_under_velocity_commands_start_at_rest() -> None:
    with pytest.raises(ParameterError, match="start at rest"):
        VelocityPlant(
            robot_of(TREE), 0.01, InitialState(joint_velocities=np.array([0.0, 0.1, 0.0]))
        )
    plant = VelocityPlant(robot_of(TREE), 0.01, InitialState(joint_velocities=np.zeros(3)))
    assert plant.qdot.tolist() == [0.0] * 3


@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        ({"joint_positions": np.zeros(2)}, r"are 2 initial joint positions; robot 'random' has 3"),
        ({"joint_positions": np.zeros(4)}, "are 4 initial joint positions"),
        ({"joint_positions": np.full(3, 3.5)}, r"joint '.*', 3.5, is outside .* \[-3.0, 3.0\]"),
        ({"joint_positions": np.full(3, -3.5)}, r"-3.5, is outside its limits \[-3.0, 3.0\]"),
        ({"joint_positions": np.array([0.0, math.nan, 0.0])}, "positions must be finite"),
        ({"joint_positions": np.array([math.inf] * 3)}, "positions must be finite"),
        ({"joint_velocities": np.zeros(4)}, "are 4 initial joint velocities"),
        ({"joint_velocities": np.array([0.0, math.inf, 0.0])}, "velocities must be finite"),
        ({"quaternion": np.zeros(4)}, "initial orientation is refused"),
        ({"quaternion": np.array([0.0, math.nan, 0.0, 1.0])}, "initial orientation is refused"),
        ({"position": np.array([0.0, math.nan, 0.0])}, "initial position must be finite"),
        ({"center_of_mass": np.array([math.inf, 0.0, 0.0])}, "initial position must be finite"),
        ({"linear_momentum": np.array([0.0, math.nan, 0.0])}, "initial momenta must be finite"),
        ({"angular_momentum": np.array([0.0, 0.0, math.inf])}, "initial momenta must be finite"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else None,
)
def test_refusals(plant: Any, given: dict[str, Any], sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        plant(robot_of(TREE), 0.01, InitialState(**given))


def test_what_a_configuration_leaves_open_is_zero_and_the_identity() -> None:
    nothing = dict.fromkeys(
        ("initial_position", "initial_orientation", "linear_momentum", "angular_momentum"), ()
    )
    for config in (PlantConfig(), PlantConfig(**nothing)):  # type: ignore[arg-type]
        start = InitialState.of(config)
        assert start.position.tolist() == [0.0, 0.0, 0.0]
        assert start.quaternion.tolist() == [0.0, 0.0, 0.0, 1.0]
        assert start.linear_momentum.tolist() == [0.0, 0.0, 0.0]
        assert start.angular_momentum.tolist() == [0.0, 0.0, 0.0]
        assert start.joint_positions is start.joint_velocities is start.center_of_mass is None
