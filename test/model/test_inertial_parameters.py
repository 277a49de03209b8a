"""Robots that differ in what their bodies weigh, are believed to weigh, and hold."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.oracles import Array, PinocchioOracle, assert_agrees
from support.oracles.integrated import carried
from support.random_robots import random_robot_urdf
from support.slow import some_fast

from spacerobot_ros.control import LAWS, ControlState, Gains, Reference
from spacerobot_ros.model import (
    InertialParameters,
    SpaceRobot,
    load_robot,
    model_functions,
    parse_robot,
)
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.grasp import BodyMotion
from spacerobot_ros.model.model_functions import SymbolicModels
from spacerobot_ros.model.payload_estimation import (
    PAYLOAD_PARAMETERS,
    PayloadEstimate,
    estimate_payload,
    momentum_regressor,
)
from spacerobot_ros.resources import share_directory
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant


def drawn(robot: RobotDescription, rng: np.random.Generator) -> InertialParameters:
    """Return other masses, centres and inertias, products of inertia among them."""
    nominal = InertialParameters.of(robot)
    bodies = len(nominal.masses)
    halves = 0.1 * rng.normal(size=(bodies, 3, 3)) * nominal.masses[:, None, None] ** 0.5
    second = halves @ np.swapaxes(halves, 1, 2) + nominal.second_moments
    trace = np.trace(second, axis1=1, axis2=2)[:, None, None]
    return InertialParameters(
        nominal.masses * rng.uniform(0.8, 1.2, bodies),
        nominal.centers + rng.normal(scale=0.05, size=(bodies, 3)),
        trace * np.eye(3) - second,
    )


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_fast(range(2), 1))
def test_numbers_given_as_an_argument_are_those_compiled_in(seed: int) -> None:
    rng = np.random.default_rng(seed)
    description = parse_robot(random_robot_urdf(rng, joints=5))
    parameters = drawn(description, rng)
    robot = SpaceRobot(description).with_inertial(parameters)
    other = SpaceRobot(parameters.apply_to_description(description))
    q, qdot, qddot = rng.uniform(-1.0, 1.0, (3, 5))
    quaternion = np.array([0.1, -0.5, 0.3, 0.8]) / np.linalg.norm([0.1, -0.5, 0.3, 0.8])
    v, omega, wrench = rng.normal(size=3), rng.normal(size=3), rng.normal(size=6)
    x = np.concatenate([q, quaternion, qdot, rng.normal(size=9)])
    command = np.concatenate([qddot, wrench])
    for name, arguments in {
        "center_of_mass": (q,),
        "locked_inertia": (q,),
        "inertia_matrix": (q,),
        "connection": (q,),
        "bias": (q, v, omega, qdot),
        "forward_dynamics": (q, v, omega, qdot, wrench, qddot),
        "joint_efforts": (q, qdot, qddot),
        "momentum": (quaternion, q, v, omega, qdot),
        "base_twist": (quaternion, q, qdot, v, omega),
        "shape_equations": (x, command),
        "flight_step": (x, command, 0.01),
        "holding_step": (x, command, np.array([1.0, 0, 1, 1, 0]), 0.01),
        "velocity_step:2": (x[:9], qdot, omega, 0.1),
    }.items():
        here, there = robot.buffered(name)(*arguments), other.buffered(name)(*arguments)
        for one, two in zip(here, there, strict=True):
            np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12, err_msg=name)
    assert robot.total_mass == pytest.approx(other.total_mass, rel=1e-15)


def test_momentum_is_that_of_pinocchio() -> None:
    rng = np.random.default_rng(5)
    urdf = random_robot_urdf(rng, joints=4)
    description = parse_robot(urdf)
    factors = rng.uniform(0.5, 1.5, len(description.bodies))
    robot = SpaceRobot(description).with_inertial(
        InertialParameters.of(description).scaled(factors)
    )
    oracle = PinocchioOracle(urdf, list(description.joint_names))
    model = oracle.model
    by_joint = {
        body.joint.name: factor
        for body, factor in zip(description.bodies, factors, strict=True)
        if body.joint
    }
    for index, name in enumerate(model.names):
        factor = by_joint.get(name, factors[0])
        inertia = model.inertias[index]
        inertia.mass, inertia.inertia = factor * inertia.mass, factor * inertia.inertia
        model.inertias[index] = inertia
    q, qdot = rng.uniform(-1, 1, (2, 4))
    p, L = rng.normal(size=3), rng.normal(size=3)
    v, omega = robot.base_twist([0, 0, 0, 1], q, qdot, p, L)
    oracle.set_configuration(q, np.array([0.0, 0, 0, 1]), np.zeros(3))
    oracle.move(oracle.base_velocities(np.concatenate([v, omega])) + oracle.joint_velocities(qdot))
    assert_agrees(np.concatenate(oracle.momentum_W()[:2]), np.concatenate([p, L]))


def test_one_compilation_serves_every_draw(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []

    def counted(function: ca.Function) -> ca.Function:
        built.append(function.name())
        return function

    monkeypatch.setattr(model_functions, "compiled", counted)
    # By another name it is another robot, of which nothing is compiled yet.
    text = (share_directory() / "urdf" / "sliding_masses.urdf").read_text("utf-8")
    text = text.replace('name="sliding_masses"', 'name="sliding_anew"')
    robot = SpaceRobot(parse_robot(text))
    heavy = robot.inertial.scaled(1.5)
    poses = []
    for factor in (0.9, 1.0, 1.1):
        draw = robot.with_inertial(heavy.scaled(factor))
        plant = VelocityPlant(draw, 0.1)
        EffortPlant(draw, 0.1, InitialState())
        for _ in range(5):
            plant.step(np.array([0.1, 0.2, 0.3]))
        poses.append(plant.pose.copy())
    # Of another build's robot, read anew, as well.
    again = SpaceRobot(parse_robot(text))
    VelocityPlant(again.with_inertial(heavy), 0.1)
    ticks = [name for name in built if "tick" in name]
    assert sorted(ticks) == ["effort_tick_100", "velocity_tick_10"]
    assert len({tuple(pose) for pose in poses}) == 3


@pytest.mark.parametrize("law", ["model_based", "computed_torque"])
def test_a_controller_commands_by_what_it_believes_the_bodies_weigh(law: str) -> None:
    rng = np.random.default_rng(8)
    description = load_robot(share_directory() / "urdf" / "planar_manipulator.urdf")
    robot = SpaceRobot(description)
    believed = robot.with_inertial(robot.inertial.scaled([1.3, 0.8, 1.4]))
    compiled_in = SpaceRobot(believed.inertial.apply_to_description(description))
    state = ControlState(
        r_WB=rng.normal(size=3),
        quaternion_WB=np.array([0.0, 0.0, 0.6, 0.8]),
        v_WB_B=rng.normal(size=3),
        omega_WB_B=rng.normal(size=3),
        q=np.array([0.4, -0.9]),
        qdot=rng.normal(size=2),
    )
    commands = []
    for each in (believed, compiled_in, robot):
        outputs = LAWS[law].default_outputs(each, "end_effector")
        controller = LAWS[law](each, outputs, Gains.uniform(2.0, 3.0))
        other = dataclasses.replace(state, q=state.q + 0.1)
        reference = Reference.present(each, other, "end_effector")
        actuation = controller.command(state, reference)
        commands.append(np.concatenate([actuation.wrench_B, actuation.tau]))
    np.testing.assert_allclose(commands[0], commands[1], rtol=1e-12, atol=1e-12)
    assert np.abs(commands[0] - commands[2]).max() > 0.01


def test_a_robot_with_its_own_numbers_is_itself() -> None:
    robot = SpaceRobot(load_robot(share_directory() / "urdf" / "planar_chain.urdf"))
    assert robot.with_inertial(robot.inertial) is robot
    assert robot.with_inertial(robot.inertial.scaled(1.0)) is robot
    other = robot.with_inertial(robot.inertial.scaled(2.0))
    # The joints that are left when one is locked still carry the other masses.
    name = robot.joint_names[0]
    locked = SpaceRobot(other.description.with_locked({name: 0.0}))
    assert locked.total_mass == pytest.approx(2 * robot.total_mass)


# -- derived robots: masses that are believed wrong, joints that are locked ----------------------


def test_every_mass_and_every_inertia_is_off_by_a_factor_of_its_own() -> None:
    error = 0.3
    true = parse_robot(random_robot_urdf(np.random.default_rng(0), joints=6))
    factors = []
    for seed in range(40):
        believed = true.with_model_error(error, seed)
        assert believed.joint_names == true.joint_names
        for link, original in zip(believed.links, true.links, strict=True):
            if original.inertia.mass == 0.0:
                assert link.inertia.mass == 0.0
                continue
            np.testing.assert_array_equal(link.inertia.com, original.inertia.com)
            moments = link.inertia.about_com[np.nonzero(original.inertia.about_com)]
            ratios = moments / original.inertia.about_com[np.nonzero(original.inertia.about_com)]
            np.testing.assert_allclose(ratios, ratios[0], rtol=1e-12)
            assert np.linalg.eigvalsh(link.inertia.about_com)[0] > 0.0
            factors.append([link.inertia.mass / original.inertia.mass, ratios[0]])
        assert believed.total_mass == pytest.approx(sum(x.inertia.mass for x in believed.links))
    spread = np.array(factors)
    assert spread.min() >= 1 - error
    assert spread.max() <= 1 + error
    # Uniform: mean 1 and standard deviation error / sqrt 3; masses and inertias independent.
    np.testing.assert_allclose(spread.mean(axis=0), 1.0, atol=5 * error / np.sqrt(3 * len(spread)))
    np.testing.assert_allclose(spread.std(axis=0), error / np.sqrt(3), rtol=0.15)
    assert abs(np.corrcoef(spread.T)[0, 1]) < 5 / np.sqrt(len(spread))


def test_a_seed_is_a_robot_and_no_error_is_the_true_one() -> None:
    true = parse_robot(random_robot_urdf(np.random.default_rng(1), joints=4))
    masses = [
        [body.inertia.mass for body in true.with_model_error(error, seed).bodies]
        for error, seed in ((0.1, 3), (0.1, 3), (0.1, 4), (0.0, 3))
    ]
    assert masses[0] == masses[1] != masses[2]
    assert masses[3] == [body.inertia.mass for body in true.bodies]


@pytest.mark.parametrize("seed", range(4))
def test_a_locked_joint_is_one_that_does_not_move(seed: int) -> None:
    """Held against Pinocchio's model of the robot with all its joints."""
    rng = np.random.default_rng(seed)
    urdf = random_robot_urdf(rng, joints=6)
    whole = parse_robot(urdf)
    names = list(whole.joint_names)
    chosen = sorted(rng.choice(6, size=2, replace=False).tolist())
    q, qdot = rng.uniform(-1.0, 1.0, 6), rng.uniform(-1.0, 1.0, 6)
    qdot[chosen] = 0.0
    locked = SpaceRobot(whole.with_locked({names[i]: float(q[i]) for i in chosen}))
    left = [i for i in range(6) if i not in chosen]
    assert list(locked.joint_names) == [names[i] for i in left]
    assert locked.link_names == tuple(link.name for link in whole.links)
    np.testing.assert_array_equal(locked.velocity_limit, whole.limits("velocity")[left])

    oracle = PinocchioOracle(urdf, names)
    v, omega = locked.base_twist(
        [0, 0, 0, 1], q[left], qdot[left], [1.0, -2.0, 0.5], [0.3, 0.2, -1]
    )
    oracle.set_configuration(q, np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
    oracle.move(oracle.base_velocities(np.concatenate([v, omega])) + oracle.joint_velocities(qdot))
    p, L, _ = oracle.momentum_W()
    assert_agrees(np.concatenate([p, L]), [1.0, -2.0, 0.5, 0.3, 0.2, -1.0])
    for link in locked.link_names:
        R, r = locked.link_pose(link, q[left])
        R_W, r_W = oracle.frame_W(link)
        np.testing.assert_allclose(R, R_W, atol=1e-12)
        np.testing.assert_allclose(r, r_W, atol=1e-12)


def test_what_cannot_be_locked_is_named() -> None:
    robot = parse_robot((share_directory() / "urdf" / "three_joint_arm.urdf").read_text("utf-8"))
    for name in ("nose", "end_effector_mount"):
        with pytest.raises(KeyError, match=name):
            robot.with_locked({name: 0.0})


# -- parameters of a held body from momenta of point masses -------------------------------------


@dataclass(frozen=True)
class Body:
    """Point masses (K,), kg, at points (K, 3) in the frame of the body, m."""

    masses: Array
    points: Array

    def inertia_about(self, place: Array) -> Array:
        arms = self.points - place
        parts = zip(self.masses, arms, strict=True)
        return np.asarray(sum(m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in parts))

    @property
    def parameters(self) -> Array:
        about = self.inertia_about(np.zeros(3))
        six = [about[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
        return np.array([self.masses.sum(), *(self.masses @ self.points), *six])

    def momenta(self, moving: list[BodyMotion]) -> Array:
        """Return the momenta (N, 6) about a fixed point, point by point."""
        found = []
        for motion in moving:
            arms = self.points @ motion.R_WT.T
            p = self.masses[:, np.newaxis] * (motion.v + np.cross(motion.omega, arms))
            L = np.cross(motion.r_WT + arms - ABOUT, p)
            found.append([*p.sum(axis=0), *L.sum(axis=0)])
        return np.array(found)


BODY = Body(
    np.array([3.0, 1.5, 0.7, 2.2, 0.4]),
    np.array(
        [[0.3, -0.1, 0.2], [0.5, 0.4, -0.3], [-0.2, 0.6, 0.1], [0.1, -0.5, 0.6], [0.9, 0.2, -0.4]]
    ),
)

ABOUT = np.array([0.4, -1.2, 0.7])
TOTAL = np.array([0.3, -0.2, 0.5, 1.1, -0.7, 0.2])
ROBOT_MASS, RADIUS = 40.0, 0.6


def motions(count: int = 20, *, planar: bool = False) -> list[BodyMotion]:
    """Triples of successive states of a smooth motion."""
    rng = np.random.default_rng(3)
    phase, pace = rng.uniform(0.0, 6.0, (4, 3)), rng.uniform(0.5, 2.0, (4, 3))
    found = []
    for t in (np.linspace(0.0, 20.0, count)[:, np.newaxis] + [0.0, 0.01, 0.02]).ravel():
        r, v, turn, omega = np.sin(phase + pace * t) * [[1.0], [0.2], [1.0], [0.3]]
        if planar:
            r[2] = v[2] = 0.0
            turn[:2] = omega[:2] = 0.0
        found.append(BodyMotion(Rotation.from_rotvec(turn).as_matrix(), r, v, omega))
    return found


def regressors_of(moving: list[BodyMotion]) -> Array:
    return np.array([momentum_regressor(motion, ABOUT) for motion in moving])


def fitted(regressors: Array, known: Array) -> PayloadEstimate:
    return estimate_payload(
        "hand", regressors.reshape(-1, 3, 6, 10), known.reshape(-1, 3, 6), ROBOT_MASS, RADIUS
    )


def estimate(moving: list[BodyMotion], noise: float = 0.0) -> PayloadEstimate:
    known = TOTAL - BODY.momenta(moving)
    known += noise * np.random.default_rng(8).normal(size=known.shape) * [1, 1, 1, 0.5, 0.5, 0.5]
    return fitted(regressors_of(moving), known)


def test_all_ten_parameters_follow_from_motion_in_space() -> None:
    found = estimate(motions())
    np.testing.assert_allclose(found.parameters, BODY.parameters, rtol=1e-11, atol=1e-12)
    assert found.undetermined == ()
    assert found.directions.shape == (0, 10)
    assert not found.corrected
    assert found.deviations.max() < 1e-9
    payload = found.payload
    assert payload is not None
    assert payload.link == "hand"
    center = BODY.masses @ BODY.points / BODY.masses.sum()
    np.testing.assert_allclose(payload.inertia.com, center, rtol=1e-10)
    about = BODY.inertia_about(center)
    np.testing.assert_allclose(payload.inertia.about_com, about, atol=1e-10)
    assert payload.inertia.mass == pytest.approx(BODY.masses.sum(), rel=1e-10)


def test_noise_is_averaged_and_the_deviations_say_how_well() -> None:
    found = estimate(motions(130), noise=0.02)
    error = found.parameters - BODY.parameters
    assert found.undetermined == ()
    assert np.abs(error / found.deviations).max() < 3.5
    assert 0.5 < np.sqrt(np.mean((error / found.deviations) ** 2)) < 1.7
    assert abs(error[0]) < 0.02
    # By hand: the covariance of the linear problem at the noise that was added.
    A = regressors_of(motions(130))
    A = (A - A.mean(axis=0)) / (0.02 * np.array([1, 1, 1, 0.5, 0.5, 0.5]))[:, np.newaxis]
    covariance = np.linalg.inv(np.einsum("nij,nik->jk", A, A))
    np.testing.assert_allclose(found.deviations, np.sqrt(np.diag(covariance)), rtol=0.1)


@pytest.mark.parametrize("seeds", [20, pytest.param(200, marks=pytest.mark.slow)])
@pytest.mark.parametrize("noise", [0.0, 0.001, 0.01, 0.1])
def test_deviations_are_those_of_the_errors_where_momenta_drift(noise: float, seeds: int) -> None:
    """A random walk that ends at 0.01, beside white noise: none, less, as much, and more."""
    moving, error = motions(130), []
    regressors, exact = regressors_of(moving), TOTAL - BODY.momenta(moving)
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        walk = np.cumsum(rng.normal(size=(130, 6)), axis=0) * 0.01 / np.sqrt(130)
        off = noise * rng.normal(size=exact.shape) + np.repeat(walk, 3, axis=0)
        found = fitted(regressors, exact + off * [1, 1, 1, 0.5, 0.5, 0.5])
        error.append((found.parameters - BODY.parameters) / found.deviations)
    assert 0.7 < np.sqrt(np.mean(np.square(error))) < 1.5
    assert np.sqrt(np.mean(np.square(error), axis=0)).max() < 2.0


def test_parameters_that_a_planar_motion_does_not_show_are_named() -> None:
    found = estimate(motions(planar=True))
    assert found.undetermined == ("Ixx", "Iyy", "Ixy")
    assert found.payload is None
    assert found.directions.shape == (3, 10)
    np.testing.assert_allclose(found.directions @ found.directions.T, np.eye(3), atol=1e-12)
    assert not found.corrected
    shown = ~np.isnan(found.parameters)
    assert np.array_equal(shown, ~np.isnan(found.deviations))
    np.testing.assert_allclose(found.parameters[shown], BODY.parameters[shown], atol=1e-10)
    off = [PAYLOAD_PARAMETERS.index(name) for name in found.undetermined]
    np.testing.assert_allclose(np.delete(found.directions, off, axis=1), 0.0, atol=1e-9)


def test_bodies_that_a_planar_motion_shows_in_part_are_not_corrected() -> None:
    """The moments that it does not show can be those of a body, whatever the others are."""
    moving, shown = motions(60, planar=True), [0, 1, 2, 3, 6]
    regressors = regressors_of(moving)
    for seed in range(12):
        rng = np.random.default_rng(seed)
        masses = rng.uniform(1.0, 9.0, 4)
        body = Body(masses, rng.normal(size=(4, 3)) * 0.3 + rng.normal(size=3) * 0.8)
        known = TOTAL - body.momenta(moving)
        found = fitted(regressors, known + 1e-5 * rng.normal(size=known.shape))
        error = (found.parameters - body.parameters)[shown] / found.deviations[shown]
        assert not found.corrected
        assert np.abs(error).max() < 4.0


def test_a_body_at_rest_shows_nothing() -> None:
    still = [BodyMotion(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3))] * 6
    found = estimate(still)
    assert found.undetermined == PAYLOAD_PARAMETERS
    assert np.isnan(found.deviations).all()
    assert not found.corrected


def test_errors_of_the_velocities_of_the_body_do_not_bias_its_mass() -> None:
    """Both sides have them: the robot of 40 kg turns with the body that it holds."""
    rng, moving = np.random.default_rng(5), motions(300)
    off = 0.05 * rng.normal(size=(len(moving), 3))
    A = regressors_of([replace(x, v=x.v + by) for x, by in zip(moving, off, strict=True)])
    b = TOTAL - BODY.momenta(moving) + np.hstack([ROBOT_MASS * off, np.zeros_like(off)])
    found = fitted(A, b)
    (mass, *_), (spread, *_), true = found.parameters, found.deviations, BODY.masses.sum()
    assert spread < 1.0
    assert abs(mass - true) < 3.5 * spread
    # Without the correction the errors make it lighter by their share of 40 kg.
    plain = np.linalg.lstsq(
        (A - A.mean(axis=0)).reshape(-1, 10), -(b - b.mean(axis=0)).ravel(), rcond=None
    )[0]
    assert abs(plain[0] - true) > 6.0 * spread


def test_a_motion_that_drowns_in_errors_shows_nothing() -> None:
    rng = np.random.default_rng(6)
    regressors = rng.normal(size=(150, 6, 10))
    found = fitted(regressors, rng.normal(size=(150, 6)))
    assert found.undetermined == PAYLOAD_PARAMETERS
    assert found.payload is None


SEEDS = (70, 71, 72)
DURATION = 0.8


@dataclass(frozen=True)
class Case:
    """A robot, where it starts, and how its joints turn and slide."""

    robot: SpaceRobot
    oracle: PinocchioOracle
    q: Array
    quaternion_WB: Array
    qdot: Array
    spin_W: Array

    @property
    def x(self) -> Array:
        return np.concatenate([self.q, self.quaternion_WB])

    def step(self, L_W: Array, substeps: int) -> Array:
        (x,) = self.robot.buffered(f"velocity_step:{substeps}")(self.x, self.qdot, L_W, DURATION)
        return np.asarray(x)


@cache
def random_case(seed: int) -> Case:
    rng = np.random.default_rng(seed)
    urdf = random_robot_urdf(rng, joints=3 + seed % 2)
    robot = SpaceRobot.from_urdf(urdf)
    quaternion = rng.normal(size=4)
    return Case(
        robot=robot,
        oracle=PinocchioOracle(urdf, robot.joint_names),
        q=rng.uniform(-0.5, 0.5, robot.n),
        quaternion_WB=quaternion / np.linalg.norm(quaternion),
        qdot=rng.uniform(-1.0, 1.0, robot.n),
        spin_W=rng.uniform(-6.0, 6.0, 3),
    )


@pytest.mark.parametrize("spins", [0.0, 1.0], ids=["at_rest", "spinning"])
@pytest.mark.parametrize("seed", SEEDS)
def test_attitude_converges_at_fourth_order(seed: int, spins: float) -> None:
    case = random_case(seed)
    start, L_W = np.append(np.zeros(3), case.quaternion_WB), spins * case.spin_W
    expected = carried(case.oracle, case.q, case.qdot, DURATION, start, [0, 0, 0, *L_W])[3:]
    assert np.linalg.norm(case.quaternion_WB - expected) > 0.02, "the base turns"
    errors = [
        np.linalg.norm(case.step(L_W, substeps)[case.robot.n :] - expected)
        for substeps in (4, 8, 16)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert np.all(np.abs(orders - 4.0) < 0.3), f"orders {orders}, errors {errors}"


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("substeps", [1, 3, 16])
def test_shape_is_exact(seed: int, substeps: int) -> None:
    case = random_case(seed)
    shape = case.step(case.spin_W, substeps)[: case.robot.n]
    np.testing.assert_allclose(shape, case.q + DURATION * case.qdot, rtol=0.0, atol=1e-15)


def test_joints_at_rest_and_no_momentum_leave_everything_as_it_is() -> None:
    case = random_case(71)
    still = replace(case, qdot=np.zeros(case.robot.n))
    np.testing.assert_allclose(still.step(np.zeros(3), 2), case.x, rtol=0.0, atol=1e-15)


def test_a_robot_of_few_calls_is_not_compiled(compiled_code: Path) -> None:
    """The numbers are those of compiled functions, bit for bit."""
    case = random_case(71)
    description = case.robot.description
    # Its functions have the mass properties as their last argument.
    robot = SpaceRobot(description, SymbolicModels.of(description))
    for name, arguments in (
        ("velocity_step:3", (case.x, case.qdot, case.spin_W, DURATION)),
        ("link_poses", (case.x[: robot.n],)),
    ):
        interpreted, compiled = (each.buffered(name) for each in (robot.interpreted, robot))
        assert interpreted.function.class_name() != "External"
        assert compiled.function.class_name() == "External"
        for here, there in zip(interpreted(*arguments), compiled(*arguments), strict=True):
            np.testing.assert_array_equal(here, there)
