"""Plans with reaction wheels: momentum stays in them, their bound refuses, they spin on after."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from planning.drifting import END_ERROR, angle_between, flown_by_pinocchio, turn_rate_in_pinocchio
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle
from support.planner_loop import Loop, robot_of
from support.wheels import ARM, ELBOW, HULL, WHEELS, text, wheel, wheeled_robot

from spacerobot_ros.errors import PlanningError, Proof, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_rotvec,
    quaternion_inverse,
    quaternion_multiply,
    rotvec_from_quaternion,
)
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState, plan
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.execution.executive import Executive
from spacerobot_ros.planning.execution.status import PlannerState
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.planning.methods.optimal.initial_guesses import InitialGuesses
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions, MotionLimits
from spacerobot_ros.planning.methods.optimal.transcription import turn_function
from spacerobot_ros.planning.methods.registry import build_method
from spacerobot_ros.simulation.plant import InitialState

THREE = text(HULL, *WHEELS[:2], ARM, ELBOW, WHEELS[2])
SKEWED = text(HULL, *WHEELS, wheel("spin_d", '<origin rpy="-0.7 0.5 0.2"/>'), ARM, ELBOW)
TWO = text(HULL, WHEELS[1], ARM, ELBOW, WHEELS[2])

BASE_RATE = 1e-8
"""Largest turn of a base that has come to rest, rad/s."""


def wheels_of(urdf: str) -> ReactionWheels:
    return ReactionWheels.of(SpaceRobot.from_urdf(urdf).description)


def capacity(wheels: ReactionWheels, direction: Array) -> float:
    """Return the largest angular momentum along a unit vector: the facets of the zonotope of all
    momenta are spanned by pairs of axes.
    """
    spins = wheels.axes_B * wheels.inertia * wheels.rate
    least = np.inf
    for i, j in combinations(range(len(wheels)), 2):
        normal = np.cross(spins[:, i], spins[:, j])
        along = abs(float(normal @ direction))
        if along > 0:
            least = min(least, float(np.abs(normal @ spins).sum()) / along)
    return least


def case(urdf: str, seed: int, share: float) -> tuple[SpaceRobot, RobotState, Array, Array]:
    """Return a robot, its state with a share of the momentum that wheels hold at the goal, the
    goal attitude, and that share of the momentum in W.
    """
    robot, rng = SpaceRobot.from_urdf(urdf), np.random.default_rng(seed)
    wheels = ReactionWheels.of(robot.description)
    q = np.zeros(robot.n)
    q[wheels.other] = rng.uniform(-0.5, 0.5, len(wheels.other))
    begins, turn = rng.normal(size=(2, 3)) * [[1.0], [0.3]]
    quaternion = quaternion_from_rotvec(begins)
    goal = quaternion_multiply(quaternion, quaternion_from_rotvec(turn))
    # Of two wheels, in the plane of their axes.
    stored = wheels.axes_B * wheels.inertia
    direction = stored @ rng.normal(size=len(wheels)) if len(wheels) < 3 else rng.normal(size=3)
    direction = direction / np.linalg.norm(direction)
    if len(wheels) < 3:
        shares = np.linalg.lstsq(stored * wheels.rate, direction, rcond=None)[0]
        L_B = share / np.abs(shares).max() * direction
    else:
        L_B = share * capacity(wheels, direction) * direction
    L_W = matrix_from_quaternion(goal) @ L_B
    return robot, RobotState(np.zeros(3), quaternion, q, np.zeros(3), L_W), goal, L_W


def turned(robot: SpaceRobot, state: RobotState, goal: Array, **options: Any) -> GaitSchedule:
    """Return the plan of an attitude (4,), wherever the base is then."""
    rotvec = rotvec_from_quaternion(goal)
    return plan(robot, rotvec=rotvec, start=state, cache=0, base_position=2, **options)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("urdf", "seed", "share"), [(THREE, 0, 0.53), (SKEWED, 1, 0.43), (THREE, 5, 0.99)]
)
def test_wheels_stop_a_base_that_turns(urdf: str, seed: int, share: float) -> None:
    robot, state, goal, L_W = case(urdf, seed, share)
    schedule = turned(robot, state, goal)
    wheels, end = ReactionWheels.of(robot.description), schedule.end_velocities
    assert end is not None
    assert not end[wheels.other].any()
    assert np.all(np.abs(schedule.velocities) <= robot.velocity_limit * (1 + 1e-8))
    assert np.all(np.abs(end) <= robot.velocity_limit)
    rates = np.vstack([np.zeros(robot.n), schedule.velocities, end])
    torque = np.abs(np.diff(rates, axis=0))[:, wheels.index] / schedule.control_period
    assert np.all(torque * wheels.inertia <= wheels.torque * (1 + 1e-6))
    _, reached = flown_by_pinocchio(urdf, schedule, state)
    assert angle_between(reached, goal) < END_ERROR
    turn = turn_rate_in_pinocchio(
        urdf, schedule.positions[-1], reached, end, L_W, schedule.joint_names
    )
    assert np.linalg.norm(turn) < BASE_RATE


def test_the_bound_of_the_rates_refuses_what_is_not_planned() -> None:
    robot, state, goal, _ = case(THREE, 5, 1.01)
    with pytest.raises(UnreachableError, match=r"1\.01 times the largest") as refusal:
        turned(robot, state, goal)
    assert refusal.value.proof is Proof.MOMENTUM


@pytest.mark.parametrize("urdf", [THREE, SKEWED], ids=["three", "skewed"])
def test_wheels_hold_all_that_the_zonotope_of_their_momenta_has(urdf: str) -> None:
    wheels, rng = wheels_of(urdf), np.random.default_rng(3)
    stored = wheels.axes_B * wheels.inertia
    for _ in range(5):
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        most = capacity(wheels, direction)
        rates = wheels.rates_for((1 - 1e-6) * most * direction)
        assert np.all(np.abs(rates) <= wheels.rate * (1 + 1e-9))
        np.testing.assert_allclose(stored @ rates, (1 - 1e-6) * most * direction, atol=1e-9)
        with pytest.raises(UnreachableError, match="1 times the largest"):
            wheels.rates_for((1 + 1e-6) * most * direction)


def test_redundant_wheels_keep_the_motion_that_has_no_momentum() -> None:
    wheels = wheels_of(SKEWED)
    stored = wheels.axes_B * wheels.inertia
    null = np.linalg.svd(stored)[2][-1]
    rates = wheels.rates_for(np.zeros(3), 40.0 * null)
    np.testing.assert_allclose(rates, 40.0 * null, atol=1e-9)


def test_a_direction_that_wheels_leave_out_is_refused() -> None:
    wheels = wheels_of(TWO)
    across = np.cross(*(wheels.axes_B.T))
    with pytest.raises(UnreachableError, match="do not span a direction") as refusal:
        wheels.rates_for(0.1 * across)
    assert refusal.value.proof is Proof.MOMENTUM


@pytest.mark.slow
def test_a_plan_begins_with_spinning_wheels() -> None:
    robot, state, goal, L_W = case(THREE, 2, 0.3)
    wheels = ReactionWheels.of(robot.description)
    qdot = np.zeros(robot.n)
    held = matrix_from_quaternion(state.quaternion).T @ L_W
    qdot[wheels.index] = np.linalg.solve(wheels.axes_B * wheels.inertia, held)
    shape = state.q + np.where(robot.effort_limit > 1, 0.3, -7.0)
    schedule = turned(robot, replace(state, qdot=qdot), goal, joint_positions=shape)
    _, reached = flown_by_pinocchio(THREE, schedule, state)
    assert angle_between(reached, goal) < END_ERROR
    np.testing.assert_allclose(schedule.velocities[0], qdot, atol=1.0)
    # The goal shape is that of the arm: wheels are where they are.
    other = wheels.other
    np.testing.assert_allclose(schedule.positions[-1, other], state.q[other] + 0.3, atol=1e-9)


def test_other_methods_do_not_begin_with_spinning_wheels() -> None:
    robot = wheeled_robot()
    qdot = np.where(robot.velocity_limit > 1, 30.0, 0.0)
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(robot.n), qdot=qdot)
    goal = Goal.from_rotvec([0, 0, 0], [0.1, 0, 0])
    method = build_method("area_loop", robot, 0.05, 0.0125, {})
    with pytest.raises(PlanningError, match="Reaction wheels spin"):
        method.plan(PlanRequest(state, goal, Tolerance(1e-3, 1e-3, 1e-3)))


def test_without_an_attitude_the_rates_of_wheels_are_not_known() -> None:
    robot, state, goal, _ = case(THREE, 1, 0.1)
    with pytest.raises(PlanningError, match="give the goal a base attitude"):
        turned(robot, state, goal, base_attitude=0)


@pytest.mark.slow
def test_wheels_spin_on_after_goals_at_restarts_and_after_an_abort(tmp_path: Path) -> None:
    file = tmp_path / "gyro.urdf"
    file.write_text(THREE)
    options = {"method": "optimal", "optimal.base_position": 2, "optimal.cache": 0}
    initial = InitialState(angular_momentum=np.array([0.5, -0.8, 0.3]))
    loop = Loop(options, robot=str(file), initial=initial)
    decided = loop.decide(([0.0, 0.0, 0.0], [0.2, 0.3, -0.1]))
    assert decided.state is PlannerState.REACHED_PARTLY
    loop.tick(100)
    held, kept = loop.poses[-1], loop.commands[-1]
    assert np.abs(kept[[0, 1, 3]]).max() > 10.0
    assert angle_between(loop.poses[-100][3:], held[3:]) < 1e-9
    # A planner that is started again has commanded nothing, and keeps what it measures.
    robot = robot_of(str(file))
    loop.executive = Executive(robot, loop.config, PlanningWorker(robot, loop.config))
    loop.tick(100)
    np.testing.assert_allclose(loop.commands[-1], kept, atol=1e-9)
    assert angle_between(loop.poses[-1][3:], held[3:]) < 1e-8
    loop.propose_goal(([0.0, 0.0, 0.0], [0.3, 0.25, -0.1]))
    loop.tick(20)
    loop.abort()
    loop.tick(100)
    # Near to the goal, at which its rates would have stopped the base.
    apart = angle_between(loop.poses[-1][3:], loop.poses[-51][3:])
    assert apart < 0.25 * 50 * 0.05 * float(np.linalg.norm(initial.angular_momentum)) / 4.0
    assert loop.decide(([0.0, 0.0, 0.0], [0.2, 0.3, -0.1])).state is PlannerState.REACHED_PARTLY


def test_guesses_keep_the_momentum_while_wheels_turn_the_base() -> None:
    """By Pinocchio, with the rates of the base by differences of the attitudes of the guess."""
    robot, state, goal, L_W = case(THREE, 3, 0.4)
    wheels = ReactionWheels.of(robot.description)
    R = matrix_from_quaternion(state.quaternion)
    turn = quaternion_multiply(quaternion_inverse(state.quaternion), goal)
    final = state.q + 0.4 * np.eye(robot.n)[wheels.other[0]]
    boundary = BoundaryConditions(state.q, turn, final, angular_momentum=L_W @ R)
    limits = MotionLimits(robot.lower, robot.upper, robot.velocity_limit, np.full(robot.n, 20.0))
    curvature = robot.function("curvature", compile=False)
    guesses = InitialGuesses(turn_function(robot, drifting=True), curvature, 8, L_W @ R)
    oracle = PinocchioOracle(THREE, robot.joint_names)
    for guess in islice(guesses.generate_with_wheels(wheels, boundary, limits, robot), 2):
        attitudes = Rotation.from_quat(guess.quaternions)
        assert attitudes[0].magnitude() < 1e-9
        assert angle_between(guess.quaternions[-1], turn) < 1e-9
        assert not guess.velocities[[0, -1]].any()
        halves = (attitudes[:-1].inv() * attitudes[1:]).as_rotvec() / guess.step
        for k in (1, 3, 5, 7):
            rates = oracle.base_twist(
                guess.shapes[k],
                guess.velocities[k],
                guess.quaternions[k],
                [0, 0, 0, *boundary.angular_momentum],
            )
            np.testing.assert_allclose(rates[3:], (halves[k - 1] + halves[k]) / 2, atol=1e-9)


def test_rates_that_are_not_finite_are_refused() -> None:
    robot, state, goal, _ = case(THREE, 1, 0.1)
    unknown = replace(state, qdot=np.full(robot.n, np.nan))
    with pytest.raises(PlanningError, match="velocities at the start are not finite"):
        turned(robot, unknown, goal)
