"""Joints at the ends of their strokes: arrival, holding, leaving, momentum and energy."""

from __future__ import annotations

import itertools
import math
import time
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from support.effort_flights import robot_of, thrusts, tumbling
from support.oracles import Array
from support.random_robots import random_robot_urdf
from support.slow import some_fast

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import EffortPlant, InitialState
from spacerobot_ros.simulation.effort_plant import joints_stopped, stop_joints

TICK = 0.01
MASS, SLIDER, STROKE = 10.0, 2.0, 0.3  # kg, kg, m

SLEDGE = f"""<robot name="sledge">
  <link name="base"><inertial><mass value="{MASS}"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="slider"><inertial><mass value="{SLIDER}"/>
    <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="base"/><child link="slider"/>
    <axis xyz="1 0 0"/><limit lower="-{STROKE}" upper="{STROKE}" velocity="1" effort="100"/></joint>
</robot>"""
REDUCED = MASS * SLIDER / (MASS + SLIDER)  # kg: of the slide, momentum given


@cache
def random_robot(seed: int) -> SpaceRobot:
    return robot_of(random_robot_urdf(np.random.default_rng(seed), joints=3 + seed % 4))


def shape_inertia(robot: SpaceRobot, q: Array) -> Array:
    """Return K (n, n) out of the paper's ``H+``."""
    H = robot.inertia_matrix(q)
    return np.asarray(H[6:, 6:] - H[6:, :6] @ np.linalg.solve(H[:6, :6], H[:6, 6:]))


# -- one slider, everything known -------------------------------------------------------------


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_slider_arrives_stays_and_leaves(side: float) -> None:
    force = 4.1
    plant = EffortPlant(robot_of(SLEDGE), TICK)
    arrival = math.sqrt(2 * STROKE * REDUCED / force)
    for tick in range(1, 80):
        limited = plant.step([side * force])
        time = tick * TICK
        if time < arrival:
            assert not limited
            assert plant.q[0] == pytest.approx(side * force / REDUCED * time**2 / 2, rel=1e-12)
        else:
            assert limited
            assert plant.q.tolist() == [side * STROKE]
            assert plant.qdot.tolist() == [0.0]
            # Without momentum all is at rest, and the centre of mass where it was.
            np.testing.assert_allclose(plant.twist, 0.0, atol=1e-15)
            reaction = -side * STROKE * SLIDER / (MASS + SLIDER)
            assert plant.pose[0] == pytest.approx(reaction, rel=1e-12)
    ticks = 79 - math.floor(arrival / TICK)
    assert plant.limit_counts["stroke"].tolist() == [ticks]
    assert plant.effort.tolist() == [side * force]

    for tick in range(1, 20):
        assert plant.step([-side * force]) is False
        way = force / REDUCED * (tick * TICK) ** 2 / 2
        assert plant.q[0] == pytest.approx(side * (STROKE - way), rel=1e-12)
    assert plant.limit_counts["stroke"].tolist() == [ticks]


def test_arrival_within_a_step_is_found_to_rounding() -> None:
    """The slider drifts; its momentum is the base's after the stop, from the right moment on."""
    rate = 0.1 + 1e-3 * math.pi
    start = InitialState(
        joint_velocities=np.array([rate]), linear_momentum=np.array([6.0, 0.0, 0.0])
    )
    plant = EffortPlant(robot_of(SLEDGE), 5.0, start, integration_step=0.7)
    assert plant.step([0.0]) is True
    arrival, drift = STROKE / rate, 6.0 / (MASS + SLIDER)
    before = drift - rate * SLIDER / (MASS + SLIDER)
    assert plant.pose[0] == pytest.approx(arrival * before + (5.0 - arrival) * drift, rel=1e-11)
    assert plant.qdot.tolist() == [0.0]
    assert plant.momentum[6] == pytest.approx((MASS + SLIDER) * drift**2 / 2, rel=1e-12)


def test_start_on_the_stop() -> None:
    at_end = InitialState(joint_positions=np.array([STROKE]))
    plant = EffortPlant(robot_of(SLEDGE), TICK, at_end)
    assert plant.step([0.0]) is False  # nothing pushes it
    assert plant.step([1.0]) is True
    assert plant.step([-1.0]) is False
    assert plant.limit_counts["stroke"].tolist() == [1]
    moving = InitialState(joint_positions=np.array([STROKE]), joint_velocities=np.array([0.2]))
    plant = EffortPlant(robot_of(SLEDGE), TICK, moving)
    assert plant.momentum[6] == pytest.approx(REDUCED * 0.2**2 / 2)
    assert plant.step([0.0]) is True
    assert (plant.q.tolist(), plant.momentum[6]) == ([STROKE], pytest.approx(0.0, abs=1e-30))


def test_spin_keeps_the_slider_out_until_effort_draws_it_in() -> None:
    start = InitialState(
        joint_positions=np.array([STROKE]), angular_momentum=np.array([0.0, 0.0, 3.0])
    )
    plant = EffortPlant(robot_of(SLEDGE), TICK, start)
    pull = REDUCED * STROKE * plant.twist[5] ** 2
    for _ in range(20):
        assert plant.step([-0.999 * pull]) is True
    assert plant.q.tolist() == [STROKE]
    assert plant.step([-1.001 * pull]) is False
    assert plant.q[0] < STROKE
    np.testing.assert_allclose(plant.momentum[3:6], [0.0, 0.0, 3.0], atol=1e-14)


# -- many joints ------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("seed", some_fast(range(4), 0))
def test_stops_change_no_momentum_and_only_take_energy(seed: int) -> None:
    robot, rng = random_robot(seed), np.random.default_rng(200 + seed)
    side = rng.choice([-1.0, 1.0], robot.n)
    start = InitialState(
        quaternion=rng.normal(size=4),
        joint_positions=side * rng.uniform(2.5, 2.9, robot.n),
        linear_momentum=rng.uniform(-1.0, 1.0, 3),
        angular_momentum=rng.uniform(-1.0, 1.0, 3),
        joint_velocities=side * rng.uniform(0.5, 1.5, robot.n),
    )
    plant = EffortPlant(robot, 0.02, start)
    before, hits = plant.momentum.copy(), 0
    nothing = np.zeros(robot.n)
    for _ in range(150):
        energy = plant.momentum[6]
        hit = plant.step(nothing)
        hits += hit
        assert plant.momentum[6] <= energy * (1 + 1e-9)
        assert hit or plant.momentum[6] == pytest.approx(energy, rel=1e-9)
        np.testing.assert_allclose(plant.momentum[:6], before[:6], rtol=0, atol=1e-12)
        assert np.all((plant.q >= robot.lower) & (plant.q <= robot.upper))
    assert hits > 0
    assert plant.momentum[6] < before[6]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_energy_of_an_arrival_is_carnots(seed: int) -> None:
    """A joint on its stop moves outwards; momentum, shape and attitude are those of before."""
    robot, rng = random_robot(seed), np.random.default_rng(210 + seed)
    q = rng.uniform(-1.0, 1.0, robot.n)
    joint = int(np.flatnonzero(np.isfinite(robot.upper))[0])
    q[joint] = robot.upper[joint]
    qdot = rng.uniform(-0.5, 0.5, robot.n)
    qdot[joint] = 0.4
    momenta = rng.uniform(-1.0, 1.0, 6)
    start = InitialState(
        joint_positions=q,
        joint_velocities=qdot,
        linear_momentum=momenta[:3],
        angular_momentum=momenta[3:],
    )
    tiny = 1e-9
    plant = EffortPlant(robot, tiny, start)
    before = plant.momentum.copy()
    assert plant.step(np.zeros(robot.n)) is True
    assert abs(plant.qdot[joint]) < 1e-8
    assert plant.limit_counts["stroke"].tolist() == np.eye(robot.n, dtype=int)[joint].tolist()
    jump, K = plant.qdot - qdot, shape_inertia(robot, q)
    # Only the stop of that joint gave an impulse.
    impulse = K @ jump
    assert np.abs(np.delete(impulse, joint)).max() < 1e-7 * abs(impulse[joint])
    assert before[6] - plant.momentum[6] == pytest.approx(jump @ K @ jump / 2, rel=1e-7)
    np.testing.assert_allclose(plant.momentum[:6], before[:6], atol=1e-13)


@pytest.mark.slow
def test_a_held_joint_feels_no_work_and_the_others_move_as_if_welded() -> None:
    """Servicer, its first joint pushed against its stop: a robot with that joint fixed."""
    urdf = (Path(__file__).parents[2] / "urdf" / "servicer.urdf").read_text(encoding="utf-8")
    stroke = 3.0
    robot = robot_of(urdf)
    fixed = urdf.replace(
        '<joint name="shoulder_yaw" type="revolute">', '<joint name="shoulder_yaw" type="fixed">'
    ).replace('<origin xyz="0.5 0 0.5"/>', f'<origin xyz="0.5 0 0.5" rpy="0 0 {stroke!r}"/>')
    rng = np.random.default_rng(220)
    effort = np.append(50.0, rng.uniform(-0.2, 0.2, 5))
    at_end = InitialState(joint_positions=np.append(stroke, np.zeros(5)))
    plant, welded = EffortPlant(robot, TICK, at_end), EffortPlant(robot_of(fixed), TICK)
    for _ in range(40):
        assert plant.step(effort) is True
        assert welded.step(effort[1:]) is False
    assert plant.limit_counts["stroke"].tolist() == [40, 0, 0, 0, 0, 0]
    np.testing.assert_allclose(plant.q[1:], welded.q, atol=1e-12)
    np.testing.assert_allclose(plant.pose, welded.pose, atol=1e-12)


def test_joints_that_knock_each_other_off_their_stops_come_to_rest() -> None:
    """Two roll joints of an arm, both driven into their stops: hops shorter and shorter."""
    robot = SpaceRobot.from_file(Path(__file__).parents[2] / "urdf" / "servicer.urdf")
    start = InitialState(
        joint_positions=np.array([0.1, -0.27, 0.51, 2.999, 2.0, 2.999]),
        joint_velocities=np.array([0.1, -0.19, 0.42, 0.3, -0.32, 0.0]),
    )
    plant = EffortPlant(robot, TICK, start)
    for _ in range(30):
        plant.step(np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.5]))
        np.testing.assert_allclose(plant.momentum[:6], 0.0, atol=1e-12)
    assert plant.q[[3, 5]].tolist() == [3.0, 3.0]
    assert plant.qdot[[3, 5]].tolist() == [0.0, 0.0]


def test_joints_that_hit_their_stops_without_end_are_refused_soon() -> None:
    """The arm of the free-flyer is thrown about by a force of 1e6 to 1e12 N on its base."""
    plant = EffortPlant(SpaceRobot.from_file(robot_file("free_flyer")), 0.02)
    plant.step(np.zeros(6), [1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    before = plant.state.copy()

    def push(force: float) -> None:
        for _ in range(10):
            plant.step(np.zeros(6), [force, 0.0, 0.0, 0.0, force, 0.0])

    began = time.process_time()
    for force in (1e6, 1e9, 1e12):
        with pytest.raises(SpaceRobotError, match="drive the robot too fast"):
            push(force)
        plant.state[:] = before
    assert time.process_time() - began < 10.0


def test_a_reset_brings_the_same_flight_again() -> None:
    """With joints that run onto their stops."""
    robot, rng = random_robot(1), np.random.default_rng(230)
    plant = EffortPlant(robot, 0.02, tumbling(robot, rng))
    commands = [(15.0 * effort, wrench) for effort, wrench in thrusts(rng, robot.n, 60)]
    flights = []
    for _ in range(2):
        plant.reset()
        assert plant.effort.tolist() == [0.0] * robot.n
        flights.append([plant.pose.tolist()])
        for effort, wrench in commands:
            plant.step(effort, wrench)
            flights[-1].append([*plant.pose.tolist(), *plant.qdot.tolist(), *plant.momentum])
    assert flights[0] == flights[1]
    assert plant.limit_counts["stroke"].sum() > 0


# -- the projection ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(20))
def test_stops_bring_the_rates_to_the_nearest_admissible(seed: int) -> None:
    """Against all ways to choose which joints are stopped."""
    rng = np.random.default_rng(seed)
    n = 2 + seed % 4
    root = rng.normal(size=(n, n))
    K = root @ root.T + 0.05 * np.eye(n)
    inward = rng.choice([-1.0, 0.0, 1.0], size=n, p=[0.4, 0.2, 0.4])
    rates = rng.normal(size=n)
    guess = rng.uniform(size=n) < 0.5
    compliance: Array = np.asarray(np.linalg.inv(K))

    best = math.inf
    for choice in itertools.product([False, True], repeat=n):
        stopped = np.array(choice) & (inward != 0.0)
        free = ~stopped
        x = np.zeros(n)
        # Free joints keep their momenta: K_ff x_f = (K rates)_f.
        if free.any():
            x[free] = np.linalg.solve(K[np.ix_(free, free)], (K @ rates)[free])
        distance = float((x - rates) @ K @ (x - rates))
        if np.all(inward * x >= -1e-12) and distance < best:
            best, nearest = distance, x
    chosen = joints_stopped(compliance, rates, inward, guess & (inward != 0.0))
    found, impulses = stop_joints(compliance, rates, chosen)
    np.testing.assert_allclose(found, nearest, atol=1e-10)
    np.testing.assert_allclose(K @ (found - rates), impulses, atol=1e-10)


def test_the_moment_of_arrival_within_a_step_counts_where_the_base_spins() -> None:
    """What the base turns until then depends on the moving joint: one long step is like many."""
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    rates, shape = np.array([0.4, 0.0, 0.0]), np.array([2.99, -0.8, 1.5])
    ends = []
    for step in (0.05, 1e-3):
        start = InitialState(
            joint_positions=shape,
            joint_velocities=rates,
            angular_momentum=np.array([5.0, -8.0, 7.0]),
        )
        plant = EffortPlant(robot, 0.2, start, integration_step=step)
        assert plant.step(np.zeros(3))
        ends.append(np.concatenate([plant.pose, plant.q, plant.qdot, plant.twist]))
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)
