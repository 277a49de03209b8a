"""Robots in an orbit and on an air table: closed forms, and point masses in their fields."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from support.crossing import URDF
from support.effort_flights import random_urdf, robot_of, tumbling
from support.oracles import Array, PinocchioOracle, assert_agrees, random_motion
from support.oracles.orbit import relative_motion

from spacerobot_ros.collision import CollisionGeometry, LinkPair, ObstaclePair
from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot, load_robot, parse_robot
from spacerobot_ros.model.urdf import parse_world, with_world
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState, VelocityPlant
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.clearance import ClearanceMonitor, ClearanceStatus
from spacerobot_ros.simulation.config import OrbitConfig, PlantConfig, TableConfig
from spacerobot_ros.simulation.loads import EARTH_GRAVITATION, PlantLoads, Surroundings

DUMBBELL = (
    '<robot name="dumbbell"><link name="bar"><inertial><mass value="2.0"/><inertia ixx="0.3" '
    'iyy="1.2" izz="1.1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
)
N = 0.0011


def point_masses(oracle: PinocchioOracle) -> tuple[Array, Array]:
    """Return masses (k,) and places in W (k, 3) that have the inertia of every body."""
    masses, places = [], []
    for index in range(1, oracle.model.njoints):
        body, joint = oracle.model.inertias[index], oracle.data.oMi[index]
        moment = np.trace(body.inertia) / 2 * np.eye(3) - body.inertia
        values, vectors = np.linalg.eigh(moment)
        for value, axis in zip(values, vectors.T, strict=True):
            for sign in (-1.0, 1.0):
                arm = sign * math.sqrt(3 * max(value, 0.0) / body.mass) * axis
                masses.append(body.mass / 6)
                places.append(joint.act(body.lever + arm))
    return np.array(masses), np.array(places)


def potential(oracle: PinocchioOracle, q: Array, n: float, o: Array) -> float:
    """Return the energy of a robot of point masses in the tide of an orbit, J."""
    pin.forwardKinematics(oracle.model, oracle.data, q)
    masses, r = point_masses(oracle)
    return float(-(n**2) / 2 * masses @ (3 * (r @ o) ** 2 - np.sum(r * r, axis=1)))


def tide(oracle: PinocchioOracle, n: float, o: Array) -> Array:
    """Return its forces (6 + n,) along the engine's velocities, by central differences."""
    q, forces = oracle.q.copy(), []
    for direction in 1e-5 * np.eye(oracle.model.nv):
        ends = [pin.integrate(oracle.model, q, sign * direction) for sign in (-1.0, 1.0)]
        below, above = (potential(oracle, end, n, o) for end in ends)
        forces.append((below - above) / 2e-5)
    return np.array(forces)


@pytest.mark.parametrize("seed", [1, 6])
def test_the_tide_is_that_of_point_masses(seed: int) -> None:
    """Joints and base accelerate by the gradient of the potential, with Pinocchio's masses."""
    rng, urdf = np.random.default_rng(seed), random_urdf(seed)
    robot, n, time = robot_of(urdf), 1.3, 0.7
    oracle = PinocchioOracle(urdf, robot.joint_names)
    motion, R_WO = random_motion(rng, robot.n), Rotation.from_rotvec(rng.normal(size=3))
    loads = PlantLoads(robot, Surroundings(n, tuple(R_WO.as_quat())))
    tau, wrench = rng.uniform(-1.0, 1.0, robot.n), rng.uniform(-1.0, 1.0, 6)
    bare = oracle.forward_dynamics(motion, wrench, tau)
    (p_W, L_W, _), center = oracle.momentum_W(), oracle.center_of_mass_W()
    to_z0dot, M = oracle.to_z0dot(), oracle.own_mass_matrix()
    o = R_WO.apply([math.cos(n * time), math.sin(n * time), 0.0])
    forces = tide(oracle, n, o)
    expected = bare + to_z0dot @ np.linalg.solve(M, forces)
    state = [motion.q, motion.quaternion_WB, motion.qdot, p_W, L_W, center]
    x, command = np.append(np.concatenate(state), time), np.concatenate([tau, wrench, loads.vector])
    K, Q = robot.buffered("loaded_shape_equations")(x, command)
    assert_agrees(np.linalg.solve(K.reshape(robot.n, -1), Q), expected[6:], 1e-7)
    # The momenta change by the force on the centre of mass and the moment 3 n^2 o x D o.
    step = robot.buffered("loaded_flight_step")
    command[: robot.n + 6] = 0.0
    after, before = step(x, command, 1e-6)[0], step(x, command, 0.0)[0]
    gained = (after - before)[2 * robot.n + 4 : 2 * robot.n + 10] / 1e-6
    force = robot.total_mass * n**2 * (3 * (o @ center) * o - center)
    oracle.set_configuration(motion.q, motion.quaternion_WB, motion.r_WB_W)
    R_WB = oracle.R_WB
    D_W = R_WB @ robot.inertia_matrix(motion.q)[3:6, 3:6] @ R_WB.T
    assert_agrees(gained, np.append(force, 3 * n**2 * np.cross(o, D_W @ o)), 1e-5)


def test_the_moment_is_that_of_an_inverse_square_field() -> None:
    """Six point masses, 6,700 km from the centre of the Earth."""
    radius = 6.7e6
    o = np.array([0.6, -0.48, 0.64])
    arms = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 2.0, 0], [0, -2.0, 0], [0, 0, 3.0], [0, 0, -3]])
    places = radius * o + arms
    fields = -EARTH_GRAVITATION * places / np.linalg.norm(places, axis=1)[:, None] ** 3
    moment = np.cross(arms, 5.0 * fields).sum(axis=0)
    inertia = 10.0 * np.diag([4.0 + 9.0, 1.0 + 9.0, 1.0 + 4.0])
    urdf = DUMBBELL.replace('"2.0"', '"30.0"')
    for name, value in zip(("ixx", "iyy", "izz"), np.diag(inertia), strict=True):
        old = {"ixx": "0.3", "iyy": "1.2", "izz": "1.1"}[name]
        urdf = urdf.replace(f'{name}="{old}"', f'{name}="{value}"')
    n = math.sqrt(EARTH_GRAVITATION / radius**3)
    axis = np.cross([1.0, 0.0, 0.0], o)
    turn = Rotation.from_rotvec(math.acos(o[0]) * axis / np.linalg.norm(axis))
    plant = VelocityPlant(SpaceRobot.from_urdf(urdf), 1e-3)
    plant.load(PlantLoads(plant.robot, Surroundings(n, tuple(turn.as_quat()))))
    plant.step(np.zeros(0))
    np.testing.assert_allclose(plant.expected_momenta[3:] / 1e-3, moment, rtol=1e-5)


@pytest.mark.parametrize("kind", [EffortPlant, VelocityPlant])
def test_a_dumbbell_swings_like_a_pendulum_and_drifts_as_clohessy_and_wiltshire_say(
    kind: Any,
) -> None:
    """Libration in the plane of the orbit: ``theta'' = -3/2 n^2 (Iy - Ix)/Iz sin 2 theta``."""
    angle, r0, v0 = 0.4, np.array([10.0, -20.0, 5.0]), np.array([0.01, 0.02, -0.01])
    start = InitialState(
        position=r0,
        quaternion=Rotation.from_rotvec([0.0, 0.0, angle]).as_quat(),
        linear_momentum=2.0 * v0,
        angular_momentum=np.array([0.0, 0.0, 1.1 * N]),
    )
    robot = robot_of(DUMBBELL)
    plant, loads = kind(robot, 20.0, start, 20.0), PlantLoads(robot, Surroundings(N))
    plant.load(loads)
    times = np.arange(0.0, 2001.0, 20.0)
    angles = []
    for time in times:
        turn = 2 * math.atan2(plant.pose[5], plant.pose[6]) - N * time
        angles.append(math.remainder(turn, 2 * math.pi))
        loads.time = time
        plant.step(np.zeros(0))
    swing = solve_ivp(
        lambda _, y: [y[1], -1.5 * N**2 * 0.9 / 1.1 * math.sin(2 * y[0])],
        (0.0, times[-1]),
        [angle, 0.0],
        t_eval=times,
        rtol=1e-11,
        atol=1e-13,
    ).y[0]
    np.testing.assert_allclose(angles, swing, atol=1e-8)
    assert min(angles) < -0.39
    end = times[-1] + 20.0
    r_O, _ = relative_motion(N, r0, v0 - np.cross([0.0, 0.0, N], r0), end)
    turned = Rotation.from_rotvec([0.0, 0.0, N * end])
    np.testing.assert_allclose(plant.pose[:3], turned.apply(r_O), atol=1e-5)


# -- the table --------------------------------------------------------------------------------


@pytest.mark.slow
def test_friction_slows_every_motion_down_alike() -> None:
    """Friction on every body by its momentum: the free motion, in the time (1 - exp(-d t))/d."""
    friction, t = 0.8, 0.9
    robot = robot_of(random_urdf(3))
    start = tumbling(robot, np.random.default_rng(7))
    slow = (1 - math.exp(-friction * t)) / friction
    rubbed, free = (EffortPlant(robot, whole / 9, start, 0.01) for whole in (t, slow))
    rubbed.load(PlantLoads(robot, Surroundings(friction=friction)))
    for _ in range(9):
        rubbed.step(np.zeros(robot.n))
        free.step(np.zeros(robot.n))
    scale = math.exp(-friction * t)
    np.testing.assert_allclose(rubbed.pose, free.pose, atol=1e-9)
    np.testing.assert_allclose(rubbed.q, free.q, atol=1e-9)
    np.testing.assert_allclose(rubbed.qdot, scale * free.qdot, atol=1e-9)
    np.testing.assert_allclose(rubbed.momentum[:6], scale * free.momentum[:6], atol=1e-9)
    assert np.abs(free.pose[:3] - start.position).max() > 0.01


def test_a_robot_slides_down_a_table_with_friction() -> None:
    """``v = g/d (1 - exp(-d t))`` downhill, under efforts and velocities; joints do not feel it."""
    table = TableConfig(tilt=0.02, direction=2.0, gravity=9.0, friction=0.5)
    for actuation in ("effort", "velocity"):
        config = PlantConfig(
            actuation=actuation, tick_rate=10.0, table=table, initial_joint_positions=(0.3, -0.7)
        )
        plant = build_plant(SpaceRobot.from_file(robot_file("planar_manipulator")), config)
        commands = (np.zeros(2), np.zeros(6)) if plant.takes_wrench else (np.zeros(2),)
        for _ in range(20):
            plant.step(*commands)
        speed = 9.0 * math.sin(0.02) / 0.5 * (1 - math.exp(-1.0))
        velocity = plant.momentum[:3] / plant.robot.total_mass
        expected = [speed * math.cos(2.0), speed * math.sin(2.0), 0.0]
        np.testing.assert_allclose(velocity, expected, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(plant.q, [0.3, -0.7], atol=1e-12)
        np.testing.assert_allclose(plant.effort, 0.0, atol=1e-9)
        np.testing.assert_allclose(plant.twist[3:], 0.0, atol=1e-12)


def test_servos_work_against_friction() -> None:
    """Held rates at zero momentum: the efforts' power is friction times twice the energy."""
    robot = robot_of(random_urdf(2))
    plant = VelocityPlant(robot, 1e-6)
    plant.load(PlantLoads(robot, Surroundings(friction=0.7)))
    rates = np.linspace(0.2, -0.3, robot.n)
    plant.step(rates)
    before = plant.momentum[6]
    plant.step(rates)
    power = plant.effort @ rates - (plant.momentum[6] - before) / 1e-6
    assert power == pytest.approx(0.7 * 2 * plant.momentum[6], rel=1e-3)


# -- parameters -------------------------------------------------------------------------------


def test_an_altitude_is_a_mean_motion() -> None:
    found = Surroundings.of(OrbitConfig(altitude=400e3, orientation=(0, 0, 3, 4)), TableConfig())
    assert 2 * math.pi / found.mean_motion == pytest.approx(5553.6, abs=0.1)
    assert found.quaternion_WO == pytest.approx((0.0, 0.0, 0.6, 0.8))
    assert found.has_loads
    assert not found.on_table
    assert Surroundings.of(OrbitConfig(mean_motion=0.5), TableConfig()).mean_motion == 0.5
    assert not Surroundings.of(OrbitConfig(), TableConfig()).has_loads
    assert Surroundings.of(OrbitConfig(), TableConfig(friction=0.1)).on_table
    steep = Surroundings.of(OrbitConfig(), TableConfig(tilt=0.1, direction=0.5, gravity=2.0))
    expected = 2 * math.sin(0.1) * np.array([math.cos(0.5), math.sin(0.5), 0.0])
    np.testing.assert_allclose(steep.gravity_W, expected)
    assert PlantLoads(robot_of(DUMBBELL), steep).has_loads


TABLE = TableConfig(tilt=0.01)


@pytest.mark.parametrize(
    ("robot", "parameters", "message"),
    [
        (
            "servicer",
            {"orbit": OrbitConfig(altitude=4e5, mean_motion=0.001)},
            "Parameters 'orbit.altitude' (400000 m) and 'orbit.mean_motion' (0.001 rad/s) both "
            "define the orbit: set one of them to 0.",
        ),
        (
            "servicer",
            {"orbit": OrbitConfig(altitude=400.0)},
            "Parameter 'orbit.altitude' is 400 m, but no orbit is below 100000 m: give it in m, "
            "not in km, or set it to 0.",
        ),
        (
            "servicer",
            {"orbit": OrbitConfig(mean_motion=0.001, orientation=(0, 0, 0, 0))},
            "Parameter 'orbit.orientation' is refused: ",
        ),
        (
            "planar_manipulator",
            {"orbit": OrbitConfig(mean_motion=0.001), "table": TABLE},
            "Parameters 'table.*' and 'orbit.*' are both set: a robot can be either on a table or "
            "in an orbit.",
        ),
        (
            "servicer",
            {"table": TABLE},
            "Parameters 'table.*' are set, but robot 'servicer' is not planar: on an air-bearing "
            "table, all joints must move in the table plane.",
        ),
        (
            "planar_manipulator",
            {"table": TableConfig(friction=0.1), "initial_orientation": (0.1, 0.0, 0.0, 0.99)},
            "Parameters 'table.*' are set, but the plane of robot 'planar_manipulator' is not the "
            "world's x-y plane: change 'initial_orientation'.",
        ),
    ],
)
def test_surroundings_that_do_not_suit_are_refused(
    robot: str, parameters: dict[str, Any], message: str
) -> None:
    model = SpaceRobot.from_file(robot_file(robot))
    with pytest.raises(ParameterError) as refused:
        build_plant(model, PlantConfig(actuation="effort", **parameters))
    assert str(refused.value).startswith(message)


def test_a_plant_whose_bodies_push_each_other_says_so() -> None:
    config = PlantConfig(initial_joint_positions=(0.0, 0.0))
    plant = build_plant(SpaceRobot(parse_robot(URDF)), config)
    links = tuple(plant.robot.link_names)
    monitor = ClearanceMonitor.of(plant.robot.description, links, has_contact_forces=True)
    assert monitor is not None
    shapes = np.linspace(-0.6, 0.6, 60)
    messages = []
    for x in shapes:
        plant.q[:] = 0.0
        link_R, link_r = plant.robot.buffered("link_poses")(np.array([x, -x]))
        messages += [e.message for e in monitor.measure(link_R, link_r, plant.pose, 0.0)[1]]
    assert messages[:1] == ["Links 'left' and 'right' touch and push each other."]


def test_a_clearance_is_read_again_from_its_message() -> None:
    status = ClearanceStatus(-0.0125, LinkPair("a", "b"), 12.75)
    assert ClearanceStatus.from_values(status.to_values()) == status
    assert type(ClearanceStatus.from_values(status.to_values()).links) is LinkPair
    assert set(status.to_values()) == {"time", "distance", "first", "second"}
    beside = ClearanceStatus(0.25, ObstaclePair("a", "b"), 12.75)
    assert beside.to_values()["second_is"] == "obstacle"
    again = ClearanceStatus.from_values(beside.to_values())
    assert again.message == "Link 'a' and obstacle 'b' are 0.25 m apart."
    assert type(again.links) is ObstaclePair
    for flaw in ({"distance": "near"}, {"first": None}):
        values = {k: v for k, v in (status.to_values() | flaw).items() if v is not None}
        with pytest.raises(SpaceRobotError, match="No clearance can be read"):
            ClearanceStatus.from_values(values)


@pytest.mark.parametrize("name", ["servicer", "seven_joint_arm"])
def test_the_nearest_pair_is_that_of_all_distances(name: str) -> None:
    robot = load_robot(robot_file(name))
    geometry = CollisionGeometry(robot)
    low, high = robot.limits("lower"), robot.limits("upper")
    shapes = np.random.default_rng(5).uniform(low, high, (40, len(low)))
    R, r = geometry.poses(shapes)
    each = np.array([geometry.distances(p, (R, r)) for p in range(len(geometry.pairs))])
    together, pairs = geometry.nearest_along(shapes)
    np.testing.assert_allclose(together, each.min(axis=0), atol=1e-9)
    np.testing.assert_array_equal(pairs, each.argmin(axis=0))
    monitor = ClearanceMonitor(geometry, geometry.links)
    pose = np.array([0.3, -0.2, 0.1, 0, 0, 0.6, 0.8])
    for k in range(len(shapes)):
        poses = R[k].transpose(1, 0, 2).reshape(3, -1), r[k].T
        status, _ = monitor.measure(*poses, pose, 0.0)
        assert status.distance == pytest.approx(together[k], abs=1e-9)
        touching = {geometry.links_of(p) for p in np.flatnonzero(each[:, k] <= 0).tolist()}
        assert monitor.touching == touching
    assert (each.min(axis=0) < 0).any()


def test_without_pairs_a_plant_measures_no_clearance() -> None:
    assert ClearanceMonitor.of(load_robot(robot_file("sliding_masses")), ()) is None


def ball_at(x: float) -> str:
    return (
        '<robot name="w"><link name="w"/><link name="ball"><collision><geometry>'
        '<sphere radius="0.01"/></geometry></collision></link><joint name="a" type="fixed">'
        f'<parent link="w"/><child link="ball"/><origin xyz="{x} 0 0"/></joint></robot>'
    )


def test_contacts_go_on_or_end_among_other_obstacles() -> None:
    robot = SpaceRobot(load_robot(robot_file("planar_chain")))
    plant = build_plant(robot, PlantConfig())
    monitor: ClearanceMonitor | None = None
    events = []
    for time, text in ((1.0, ball_at(0.0)), (2.0, ball_at(0.001)), (3.0, ball_at(40.0))):
        described = with_world(robot.description, parse_world(text))
        monitor = ClearanceMonitor.of(described, tuple(robot.link_names), monitor)
        assert monitor is not None
        status, news = monitor.measure(plant.link_R, plant.link_r, plant.pose, time)
        events += [(each.kind.value, each.time_s, each.about["second"]) for each in news]
        touches = np.sign(status.distance) < 0
        assert touches == (time < 3)
    assert events == [("contact", 1.0, "ball"), ("contact_ended", 3.0, "ball")]
