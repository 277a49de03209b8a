"""Paper 3: joint efforts make the shape a double integrator, and touch no momentum."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from control.flights import Array, load, plant_of, random_state
from support.random_robots import random_robot_urdf

from spacerobot_ros.control import (
    LAWS,
    ControlLaw,
    ControlState,
    Gains,
    JointReference,
    MotionLimits,
    OutputSelection,
    QuinticReference,
    Reference,
)
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot

ROBOTS = ("planar_chain", "random_0", "random_1", "random_2", "servicer")


def robot_of(name: str) -> SpaceRobot:
    if not name.startswith("random"):
        return load(name)
    seed = int(name[-1])
    return SpaceRobot.from_urdf(random_robot_urdf(np.random.default_rng(seed), 4 + seed))


def law_for(robot: SpaceRobot, kp: float, kd: float) -> ControlLaw:
    law = LAWS["computed_torque"]
    return law(robot, law.default_outputs(robot, ""), Gains.uniform(kp, kd))


@pytest.mark.parametrize("name", ROBOTS)
def test_shape_obeys_the_commanded_acceleration(name: str) -> None:
    """Eqs (7-9), at any momentum: ``qddot = u`` by Pinocchio."""
    rng = np.random.default_rng(30)
    robot = robot_of(name)
    state = random_state(rng, robot.n)
    joints = JointReference(*rng.uniform(-1, 1, (3, robot.n)))
    actuation = law_for(robot, 3.0, 2.0).command(state, Reference(joints=joints))
    u = joints.qddot + 2.0 * (joints.qdot - state.qdot) + 3.0 * (joints.q - state.q)
    _, qddot = plant_of(robot, state).acceleration(actuation)
    np.testing.assert_allclose(qddot, u, atol=1e-10)
    np.testing.assert_array_equal(actuation.wrench_B, 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("spinning", [False, True])
@pytest.mark.parametrize("name", ["planar_chain", "random_1"])
def test_shape_follows_its_reference_and_momentum_stays(name: str, spinning: bool) -> None:
    rng = np.random.default_rng(31)
    robot = robot_of(name)
    state = replace(random_state(rng, robot.n), qdot=np.zeros(robot.n))
    if not spinning:
        state = ControlState.at_rest(state.r_WB, state.quaternion_WB, state.q)
    goal = JointReference.at_rest(state.q + rng.uniform(-0.5, 0.5, robot.n))
    start = Reference(joints=JointReference.at_rest(state.q))
    profile = QuinticReference(
        start, Reference(joints=goal), MotionLimits(joint_speed=0.5, joint_acceleration=0.5)
    )
    law, plant = law_for(robot, 4.0, 4.0), plant_of(robot, state, longest_step=0.005)
    before = plant.momentum()
    lag: list[Array] = []
    for tick in range(round((profile.duration + 6.0) * 100)):
        plant.step(law.command(plant.state, profile.at(tick / 100)), 0.01)
        lag.append(law.error)
    # Commands are held for a tick: on the way the shape lags by that much, no more.
    assert np.abs(lag).max() < (1e-2 if spinning else 2e-3)
    np.testing.assert_allclose(plant.state.q, goal.q, atol=1e-3 if spinning else 1e-6)
    np.testing.assert_allclose(plant.momentum(), before, atol=1e-8)


def test_shape_settles_like_a_double_integrator() -> None:
    """Kp = 1, Kd = 2: ``e(t) = e0 (1 + t) exp(-t)``."""
    robot = load("planar_chain")
    start = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(2))
    goal = Reference(joints=JointReference.at_rest(np.array([1.0, -0.5])))
    law, plant = law_for(robot, 1.0, 2.0), plant_of(robot, start)
    for tick in range(1, 501):
        plant.step(law.command(plant.state, goal), 0.002)
        t = 0.002 * tick
        expected = np.array([1.0, -0.5]) * (1.0 - (1.0 + t) * np.exp(-t))
        np.testing.assert_allclose(plant.state.q, expected, atol=2e-3)


def test_outputs_are_all_joints_in_the_order_of_the_model() -> None:
    robot = load("planar_chain")
    law = LAWS["computed_torque"]
    gains = Gains.uniform(1.0, 2.0)
    assert law(robot, OutputSelection(joints=("pin_2", "pin_1")), gains).outputs.labels == (
        "joint.pin_1",
        "joint.pin_2",
    )
    for refused in (
        OutputSelection(joints=("pin_1",)),
        OutputSelection(base=("x",), joints=("pin_1", "pin_2")),
    ):
        with pytest.raises(ParameterError, match="the joints pin_1, pin_2"):
            law(robot, refused, gains)
