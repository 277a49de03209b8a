"""The plant under held joint velocities: conservation, another integration, start and reset."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.oracles.oracle import Motion
from support.velocity_flights import RATE, STROKE, TICK, URDF, Case, sliding_masses

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import c_compiler
from spacerobot_ros.simulation import InitialState, VelocityPlant

Array = npt.NDArray[np.float64]

SEEDS = range(4)


# -- conservation -----------------------------------------------------------------------------


@pytest.mark.parametrize("momentum", [False, True], ids=["at rest", "drifting"])
@pytest.mark.parametrize("seed", SEEDS)
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
    assert plant.velocity_limited.sum() > 0
    assert plant.stroke_limited.sum() > 0
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


def integrated(
    case: Case, commands: list[Array], tick: float = TICK
) -> tuple[Array, Rotation, Array]:
    """Return pose and shape after held rates: base twist by Pinocchio, integrated by DOP853."""
    start, oracle = case.initial, case.oracle
    assert start.joint_positions is not None
    q = start.joint_positions.copy()
    state = np.concatenate([start.position, start.quaternion])
    momenta = np.concatenate([start.linear_momentum, start.angular_momentum])
    kinds = [j.kind.value for j in case.robot.description.movable_joints]
    bounded = np.array([kind != "continuous" for kind in kinds])
    for command in commands:
        rates = np.clip(command, -RATE, RATE)
        lower = np.where(bounded, (-STROKE - q) / tick, -np.inf)
        upper = np.where(bounded, (STROKE - q) / tick, np.inf)
        rates = np.clip(rates, lower, upper)

        def derivative(t: float, y: Array, q: Array = q, rates: Array = rates) -> Array:
            quaternion = y[3:] / np.linalg.norm(y[3:])
            twist = oracle.base_twist(q + t * rates, rates, quaternion, momenta)
            turn = Rotation.from_quat(quaternion)
            x, w = y[3:6], y[6]
            rate = 0.5 * np.append(w * twist[3:] + np.cross(x, twist[3:]), -x @ twist[3:])
            return np.concatenate([turn.apply(twist[:3]), rate])

        solution = solve_ivp(
            derivative, (0.0, tick), state, method="DOP853", rtol=1e-12, atol=1e-13
        )
        state = solution.y[:, -1]
        q = q + tick * rates
    return state[:3], Rotation.from_quat(state[3:]), q


def deviation(plant: VelocityPlant, position: Array, attitude: Rotation) -> float:
    turned = (Rotation.from_quat(plant.pose[3:]).inv() * attitude).magnitude()
    return float(max(np.abs(plant.pose[:3] - position).max(), turned))


@pytest.mark.parametrize("momentum", [False, True], ids=["at rest", "drifting"])
@pytest.mark.parametrize("seed", [0, 1])
def test_motion_is_that_of_another_integration(seed: int, momentum: bool) -> None:
    case = Case(seed, momentum=momentum)
    plant = case.plant(integration_step=0.002)
    commands = [case.command() for _ in range(15)]
    for command in commands:
        plant.step(command)
    position, attitude, q = integrated(case, commands)
    np.testing.assert_allclose(plant.q, q, atol=1e-13)
    assert deviation(plant, position, attitude) < 1e-9


def test_the_attitude_is_integrated_to_fourth_order() -> None:
    case, tick = Case(3, momentum=True), 0.4
    commands = [case.command() for _ in range(4)]
    position, attitude, _ = integrated(case, commands, tick)
    errors = []
    for step in (tick / 2, tick / 4):
        plant = VelocityPlant(case.robot, tick, case.initial, step)
        for command in commands:
            plant.step(command)
        errors.append(deviation(plant, position, attitude))
    assert errors[1] > 1e-9, "nothing to compare"
    assert errors[0] / errors[1] == pytest.approx(16.0, rel=0.5)


def test_a_body_without_joints_tumbles_as_euler_says() -> None:
    moments = np.array([1.0, 2.0, 2.5])
    urdf = (
        '<robot name="brick"><link name="brick"><inertial><mass value="4"/><inertia ixx="1" '
        'iyy="2" izz="2.5" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    L = np.array([0.3, 1.0, -0.4])
    initial = InitialState(linear_momentum=np.array([4.0, 0.0, -2.0]), angular_momentum=L)
    plant = VelocityPlant(SpaceRobot.from_urdf(urdf), TICK, initial)

    def euler(_: float, omega: Array) -> Array:
        return np.asarray(-np.cross(omega, moments * omega) / moments)

    solution = solve_ivp(
        euler, (0.0, 5.0), L / moments, method="DOP853", rtol=1e-12, atol=1e-12, dense_output=True
    )
    energy = float(np.sum(L**2 / moments)) / 2 + float(np.sum([16.0, 4.0])) / 8
    for tick in range(1, 101):
        plant.step(np.zeros(0))
        np.testing.assert_allclose(plant.twist[3:], solution.sol(tick * TICK), atol=1e-8)
        np.testing.assert_allclose(
            plant.pose[:3], tick * TICK * np.array([1.0, 0.0, -0.5]), atol=1e-12
        )
        assert plant.momentum[6] == pytest.approx(energy, rel=1e-8)


# -- start and reset --------------------------------------------------------------------------


def test_it_starts_at_rest_where_it_is_told() -> None:
    case = Case(4, momentum=False)
    plant = case.plant()
    np.testing.assert_array_equal(plant.q, case.initial.joint_positions)
    np.testing.assert_allclose(plant.pose[:3], case.initial.position, atol=1e-14)
    np.testing.assert_allclose(plant.pose[3:], case.initial.quaternion, atol=1e-15)
    np.testing.assert_array_equal(plant.qdot, np.zeros(case.robot.n))
    np.testing.assert_allclose(plant.twist, np.zeros(6), atol=1e-15)
    np.testing.assert_allclose(plant.momentum, np.zeros(7), atol=1e-15)


def test_a_quaternion_of_any_length_is_taken() -> None:
    plant = sliding_masses(quaternion=np.array([0.0, 0.0, -3.0, 4.0]))
    np.testing.assert_allclose(plant.pose[3:], [0.0, 0.0, -0.6, 0.8])


def test_a_stroke_without_zero_starts_at_its_nearest_end() -> None:
    text = (URDF / "sliding_masses.urdf").read_text("utf-8")
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
    counted = plant.velocity_limited.copy()
    plant.reset()
    for now, then in zip(
        (plant.pose, plant.twist, plant.q, plant.qdot, plant.momentum), begin, strict=True
    ):
        np.testing.assert_array_equal(now, then)
    np.testing.assert_array_equal(plant.velocity_limited, counted)
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
    if c_compiler() is None:
        pytest.skip("no C compiler")
    robot = SpaceRobot.from_file(URDF / "sliding_masses.urdf")
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
