"""Plans of robots with momentum: from drifting bases, and made while the base drifts."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from planning.drifting import END_ERROR, angle_between, flown_by_pinocchio
from planning.test_optimal import ARM_START
from scipy.spatial.transform import Rotation
from support.planner_loop import TICK, TICK_NS, Loop, Place, StubMethod
from support.planner_phases import until
from support.planners import planner_of
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import NotFoundError, ParameterError, PlanningError, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrices_from_quaternions,
    quaternion_from_rotvec,
    quaternion_multiply,
    rotvec_from_quaternion,
)
from spacerobot_ros.planning import GaitSchedule, Goal, RobotState, plan
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.goal import EndEffectorGoal, Tolerance
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import HeldMotion, JointEfforts
from spacerobot_ros.planning.execution.status import Phase, PlannerState
from spacerobot_ros.planning.methods.optimal.held_commands import DriftVariation
from spacerobot_ros.planning.methods.optimal.problem import BoundaryConditions
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState

ATTITUDE = Rotation.from_rotvec([0.4, -0.3, 0.7]).as_quat()
NO_TURN = np.array([0.0, 0.0, 0.0, 1.0])
START = RobotState(
    np.array([0.3, -0.2, 0.5]),
    ATTITUDE,
    ARM_START,
    np.array([0.5, -0.4, 0.9]),
    np.array([1.5, -0.6, 1.1]),
)
TURN = Rotation.from_rotvec([0.1, -0.2, 0.15])
QUICK: dict[str, Any] = {"answers": 1, "starts": 2, "intervals": 20, "cache": 0}


@pytest.fixture(scope="module")
def schedule(arm: SpaceRobot) -> GaitSchedule:
    goal = (Rotation.from_quat(ATTITUDE) * TURN).as_rotvec()
    return plan(arm, rotvec=goal, start=START, **QUICK)


def test_a_robot_that_drifts_ends_where_its_plan_says(schedule: GaitSchedule) -> None:
    """By Pinocchio at that momentum: attitude and position at the end, joints at rest."""
    r_WB, quaternion = flown_by_pinocchio("three_joint_arm", schedule, START)
    goal = (Rotation.from_quat(ATTITUDE) * TURN).as_quat()
    assert angle_between(quaternion, goal) < END_ERROR
    np.testing.assert_allclose(r_WB, schedule.path.position[-1], atol=END_ERROR)
    np.testing.assert_array_equal(schedule.positions[0], ARM_START)
    limit = np.pi / 2  # No joint of the arm is faster, so the robot is not led along a jump.
    assert np.abs(schedule.velocities).max() < limit


def test_the_predicted_error_is_that_of_the_motion_and_not_of_the_integrator() -> None:
    """A joint turns by a fifth of a radian in a step of the integration, which is off."""
    turn = np.array([0.2, 0.1, -0.15])
    few = {**QUICK, "clearance": 0.0, "integration_step": 0.05}
    schedule = plan("quadruped", rotvec=turn, **few)
    state = RobotState(np.zeros(3), NO_TURN, schedule.positions[0])
    _, quaternion = flown_by_pinocchio("quadruped", schedule, state, longest_step=0.005)
    goal = quaternion_from_rotvec(turn)
    missed = angle_between(quaternion, goal)
    assert angle_between(schedule.path.quaternion[-1], goal) < 1e-10 < 1e-7 < missed
    assert schedule.notes["predicted_attitude_error"] == pytest.approx(missed, rel=0.05)


def test_the_base_turns_on_at_the_rate_that_the_momentum_gives(
    arm: SpaceRobot, schedule: GaitSchedule
) -> None:
    rate, last = np.array(schedule.notes["final_base_rate"]), schedule.positions[-1]
    attitude = schedule.path.quaternion[-1]
    momenta = arm.momentum(attitude, last, np.zeros(3), rate, np.zeros(arm.n))
    np.testing.assert_allclose(momenta[1], START.angular_momentum, atol=1e-12)


def test_the_first_variation_of_a_drifting_attitude_is_that_of_its_integration(
    arm: SpaceRobot,
) -> None:
    """Against differences of the prediction, for a change that vanishes at both ends."""
    period, N, L = 0.05, 60, np.array([1.5, -0.6, 1.1])
    s = np.linspace(0.0, 1.0, N + 1)[:, np.newaxis]
    positions = ARM_START + np.hstack([np.sin(2 * s), 0.5 * s**2, np.cos(3 * s) - 1])
    wave = np.hstack([np.sin(np.pi * s) ** 2, 0.3 * np.sin(2 * np.pi * s) ** 2, 0 * s])
    prediction = BasePrediction(arm, period, 0.01)

    def end(amount: float) -> Array:
        return prediction.attitudes(positions + amount * wave, NO_TURN, L)[-1]

    step = 1e-5
    expected = attitude_error(end(-step), end(step)) / (2 * step)
    quaternions = prediction.attitudes(positions, NO_TURN, L)
    R = matrices_from_quaternions(quaternions)
    K = arm.function("curvature", compile=False)(positions.T).full()
    K = K.reshape(6, N + 1, 3, 3)[3:]
    moved = np.gradient(positions, axis=0)
    turned = R @ np.einsum("akji,kj->kai", K, moved)
    variation = DriftVariation(arm)
    carried = variation.carried(positions, L @ R, R, turned, period)
    xi = np.einsum("kai,ki->a", carried, wave)
    np.testing.assert_allclose(R[-1].T @ xi, expected, rtol=0.01, atol=1e-4)
    still = np.einsum("kai,ki->a", turned, wave)
    assert np.linalg.norm(R[-1].T @ still - expected) > 10 * np.linalg.norm(R[-1].T @ xi - expected)


def test_efforts_of_a_robot_that_drifts_are_those_of_forward_dynamics(arm: SpaceRobot) -> None:
    q, qdot = np.array([0.3, -0.5, 0.8]), np.array([0.4, 0.2, -0.3])
    L_B, period = np.array([0.7, -1.2, 0.4]), 0.1
    positions = np.array([q - period * qdot / 2, q + period * qdot / 2])
    limit = np.array([2.0, 3.0, 5.0])
    efforts = JointEfforts(arm, limit)
    at_rest = HeldMotion(positions, period, qdot)
    drifting = replace(at_rest, L_B=np.array([L_B, L_B]))
    tau = efforts.shares(drifting)[0] * limit
    _, omega = arm.base_twist(NO_TURN, positions[0], qdot, L_W=L_B)
    rates = arm.forward_dynamics(positions[0], np.zeros(3), omega, qdot, np.zeros(6), tau)
    np.testing.assert_allclose(rates[6:], 0.0, atol=1e-10)
    still = efforts.shares(at_rest)[0] * limit
    assert np.abs(tau - still).max() > 0.01
    none = efforts.shares(replace(at_rest, L_B=np.zeros((2, 3))))[0] * limit
    np.testing.assert_allclose(none, still, atol=1e-12)
    peak = np.abs(efforts.shares(drifting)).max()
    assert efforts.excess(drifting) == pytest.approx(np.sqrt(peak))


def test_the_momentum_in_the_base_turns_against_it() -> None:
    L_0 = np.array([0.2, -0.7, 0.4])
    boundary = BoundaryConditions(ARM_START, NO_TURN, ARM_START, angular_momentum=L_0)
    assert boundary.drifts
    turns = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.3, -0.2, 0.9]])
    found = boundary.momenta_in_base(turns.as_quat())
    assert found is not None
    np.testing.assert_allclose(found, turns.inv().apply(L_0), atol=1e-15)
    at_rest = replace(boundary, angular_momentum=np.zeros(3))
    assert not at_rest.drifts
    assert at_rest.momenta_in_base(turns.as_quat()) is None


def test_all_places_of_a_goal_are_displaced() -> None:
    hand = EndEffectorGoal.along("hand", [[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]])
    goal = Goal.of_end_effectors([hand], position=[0.5, 0.25, -1.0])
    moved = goal.displaced(np.array([0.1, -0.2, 0.4]))
    np.testing.assert_allclose(moved.position, [0.6, 0.05, -0.6])
    way = moved.end_effectors[0].path_values
    np.testing.assert_allclose(way, [[0.2, 0.0, 0.7], [1.1, 1.8, 3.4]])
    np.testing.assert_array_equal(moved.quaternion, goal.quaternion)


def test_a_planar_robot_that_tumbles_is_refused() -> None:
    tumbling = [0.3, 0.0, 0.4]
    with pytest.raises(
        PlanningError, match=r"0\.5 kg m\^2/s, which rotates its base about an axis other"
    ):
        plan("planar_chain", rotvec=[0, 0, 0.1], angular_momentum=tumbling, **QUICK)


@pytest.mark.parametrize(
    ("robot", "method"),
    [
        ("sliding_masses", "lie_bracket"),
        ("planar_chain", "square_path"),
        ("three_joint_arm", "area_loop"),
    ],
)
@pytest.mark.parametrize(
    ("momentum", "shown"),
    [
        ({"linear_momentum": [0.0, 3e-3, 4e-3]}, "0.005 kg m/s"),
        ({"angular_momentum": [0.0, 0.0, -2e-3]}, "0.002 kg m^2/s"),
    ],
)
def test_methods_that_plan_at_rest_name_the_one_that_does_not(
    robot: str, method: str, momentum: dict[str, Any], shown: str
) -> None:
    with pytest.raises(PlanningError, match="The robot drifts: its total momentum") as refused:
        plan(robot, rotvec=(0.0, 0.0, 0.1), method=method, **momentum)
    assert_one_sentence(
        str(refused.value), shown, f"{method} plans for zero momentum", "use optimal"
    )


@pytest.mark.parametrize("given", [[1.0, 2.0], [0.0, np.nan, 1.0]])
def test_a_momentum_that_is_none_is_refused(given: list[float]) -> None:
    with pytest.raises(ParameterError, match=r"angular_momentum is .* three finite numbers"):
        plan("planar_chain", rotvec=[0, 0, 0.1], angular_momentum=given, **QUICK)


def test_shape_and_position_of_a_base_that_coasts_are_refused() -> None:
    asked = {**QUICK, "position": (0.1, 0, 0), "joint_positions": [0.1, 0.2, 0.3]}
    with pytest.raises(PlanningError, match="at one instant at most"):
        plan("sliding_masses", linear_momentum=[1.0, 0.0, 0.0], **asked)


@pytest.mark.parametrize("asked", [{}, {"duration": 2.0}])
def test_a_base_that_coasts_is_at_its_goal_when_the_plan_ends(asked: dict[str, float]) -> None:
    momentum = [0.3, -0.2, 0.1]
    few = {**QUICK, "starts": 4, **asked}
    schedule = plan("sliding_masses", position=(0.1, 0.05, 0), linear_momentum=momentum, **few)
    state = RobotState(np.zeros(3), NO_TURN, np.zeros(3), np.array(momentum))
    r_WB, quaternion = flown_by_pinocchio("sliding_masses", schedule, state)
    np.testing.assert_allclose(r_WB, [0.1, 0.05, 0.0], atol=END_ERROR)
    assert angle_between(quaternion, NO_TURN) < END_ERROR
    assert schedule.duration == pytest.approx(asked.get("duration", schedule.duration))


def test_where_nothing_is_found_the_passes_of_a_drifting_goal_are_tried_before(
    arm: SpaceRobot,
) -> None:
    """So few iterations find nothing: neither at once nor where the drift leads past the goal."""
    goal = (Rotation.from_quat(ATTITUDE) * TURN).as_rotvec()
    with pytest.raises(NotFoundError, match=r"was found from 2 starts.* It is proved"):
        plan(arm, rotvec=goal, start=START, base_position=2, iterations=2, **QUICK)


def test_a_base_that_coasts_turns_where_its_position_does_not_count() -> None:
    turn: dict[str, Any] = {"rotvec": (0.0, 0.0, 0.3), "base_position": 2, **QUICK}
    still = plan("planar_chain", **turn)
    coasting = plan("planar_chain", **turn, linear_momentum=[0.3, -0.2, 0.0])
    np.testing.assert_allclose(coasting.positions, still.positions, atol=1e-9)
    assert coasting.path.position[-1] @ [0.3, -0.2, 0.0] > still.path.position[-1] @ [0.3, -0.2, 0]


@pytest.mark.parametrize("kind", ["linear_momentum", "angular_momentum"])
def test_a_momentum_counts_where_a_method_for_robots_at_rest_refuses_it(
    arm: SpaceRobot, kind: str
) -> None:
    method = planner_of("area_loop", arm, 0.25, Tolerance(1.0, 1e-3)).method
    counts = []
    for speed in np.geomspace(1e-13, 1e-5, 17):
        momentum = speed * arm.total_mass * np.array([0.6, 0.0, -0.8])
        state = replace(RobotState(np.zeros(3), ATTITUDE, ARM_START), **{kind: momentum})
        refused = False
        try:
            method.require_rest(state)
        except PlanningError:
            refused = True
        np.testing.assert_array_equal(method.significant(momentum), refused * momentum)
        counts.append(refused)
    assert counts == sorted(counts)
    assert len(set(counts)) == 2


# -- plans in the background for robots that drift: each begins where the base is by then --------


VELOCITY = np.array([0.004, -0.003, 0.002])
"""Of the centre of mass, m/s: in 2 s it moves ten times as far as the tolerance."""

GOAL: Place = ([0.04, -0.03, 0.02], [0.0, 0.0, 0.0])


class Coasting(StubMethod):
    """Slides the base relative to a centre of mass that coasts."""

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        velocity = request.state.linear_momentum / self.robot.total_mass
        there = request.goal.position - velocity * self.ticks * TICK
        moved = replace(request, goal=replace(request.goal, position=there))
        schedule = super().plan(moved, cancellation)
        path = schedule.path
        drifted = path.position + np.outer(path.time, velocity)
        return replace(schedule, goal=request.goal, path=replace(path, position=drifted))


def loop_of(**parameters: object) -> Loop:
    mass = Coasting().robot.total_mass
    momentum = InitialState(linear_momentum=VELOCITY * mass)
    given = {"max_corrections": 0, "position_tolerance": 8e-4, **parameters}
    return Loop(given, method=Coasting(20), initial=momentum, held=True)


def reach(loop: Loop) -> None:
    status = loop.until(PlannerState.REACHED, PlannerState.FAILED)
    assert status.state is PlannerState.REACHED, status.message
    assert loop.error_to(GOAL)[0] < 8e-4


def test_a_plan_begins_with_a_rest_while_which_it_is_made() -> None:
    loop = loop_of()
    loop.tick(3)
    loop.propose_goal(GOAL)
    loop.tick(18)
    loop.held.release()
    reach(loop)
    (start,) = loop.starts
    assert start.stamp_ns == 3 * TICK_NS
    rests = 40
    positions = start.schedule.positions
    np.testing.assert_array_equal(positions[: rests + 1], np.tile(positions[0], (rests + 1, 1)))
    assert np.abs(positions[rests + 1] - positions[0]).max() > 0
    assert not any(loop.speeds[: 3 + rests])
    assert loop.speeds[3 + rests] > 0


@pytest.mark.parametrize("late", [41, 67])
def test_a_plan_that_comes_too_late_is_made_again(late: int) -> None:
    loop = loop_of()
    loop.propose_goal(GOAL)
    loop.tick(late + 1)
    loop.held.release()
    loop.tick(2)
    assert loop.states == []
    loop.held.release()
    reach(loop)
    (start,) = loop.starts
    assert start.stamp_ns == 0
    # Twice the time that planning took.
    assert len(start.schedule.positions) - 1 - 20 == 2 * (late + 1)


def test_planning_that_takes_too_long_is_refused() -> None:
    loop = loop_of()
    loop.propose_goal(GOAL)
    loop.tick(601 * 20)
    loop.held.release()
    loop.tick(2)
    status = loop.statuses[-1]
    assert status.state is PlannerState.REFUSED
    assert "601 s of planning were too short" in status.message


def test_a_correction_begins_with_a_rest_too() -> None:
    loop = loop_of(max_corrections=1)
    method = loop.method
    assert isinstance(method, Coasting)
    method.overshoot = 0.2
    loop.propose_goal(GOAL)
    loop.tick(2)
    loop.held.release()
    loop.tick()
    until(loop, Phase.PLANNING)
    method.overshoot = 0.0
    loop.tick(11)
    loop.held.release()
    reach(loop)
    second = loop.starts[1].schedule
    np.testing.assert_array_equal(second.positions[40], second.positions[0])
    assert len(second.positions) == 61


def test_a_robot_at_rest_begins_at_once() -> None:
    loop = Loop(method=StubMethod(), held=True)
    loop.propose_goal(GOAL)
    loop.tick(7)
    loop.held.release()
    loop.until(PlannerState.REACHED)
    (start,) = loop.starts
    assert (start.schedule.ticks, start.stamp_ns) == (8, 7 * TICK_NS)


# -- random cases of robots that drift: most are planned, and Pinocchio ends where plans ---------


CASES = int(os.environ.get("SPACEROBOT_DRIFTING_CASES", "1"))
"""Cases of each robot and drift."""

ROBOTS = ("three_joint_arm", "seven_joint_arm", "servicer")

LEAST_PLANNED = {3.0: 0.95, 10.0: 0.95, 30.0: 0.80}
"""Least share of planned cases by the drift over the manoeuvre, deg."""


def timed(robot: SpaceRobot, rotvec: Array, start: RobotState) -> tuple[GaitSchedule, float]:
    """Return the plan of a turn and its CPU time, s."""
    began = time.process_time()
    schedule = plan(robot, rotvec=rotvec, start=start, cache=0, base_position=2)
    return schedule, time.process_time() - began


@dataclass(frozen=True)
class Case:
    """A start that drifts and a goal; a robot at rest takes ``at_rest`` s, CPU ``cpu`` s."""

    robot: SpaceRobot
    state: RobotState
    rotvec: Array
    at_rest: float
    cpu: float


def cases(name: str, drift: float, count: int) -> Iterator[Case]:
    robot = SpaceRobot.from_file(robot_file(name))
    rng = np.random.default_rng([ROBOTS.index(name), round(drift), 2026])
    low, high = np.maximum(robot.lower, -0.6), np.minimum(robot.upper, 0.6)
    found = 0
    while found < count:
        q, quaternion = rng.uniform(low, high), quaternion_from_rotvec(rng.normal(size=3))
        turn, about = rng.normal(size=(2, 3))
        turn *= rng.uniform(0.05, 0.5) / np.linalg.norm(turn)
        goal = quaternion_from_rotvec(turn)
        p = rng.normal(size=3) * 0.01 * robot.total_mass
        rotvec = rotvec_from_quaternion(quaternion_multiply(quaternion, goal))
        rest = RobotState(rng.normal(size=3), quaternion, q)
        try:
            schedule, cpu = timed(robot, rotvec, rest)
        except PlanningError:
            continue
        omega = about / np.linalg.norm(about) * np.radians(drift) / schedule.duration
        L = robot.momentum(quaternion, q, np.zeros(3), omega, np.zeros(robot.n))[1]
        state = RobotState(rest.position, quaternion, q, p, L)
        found += 1
        yield Case(robot, state, rotvec, schedule.duration, cpu)


@pytest.mark.study
@pytest.mark.parametrize("drift", LEAST_PLANNED)
def test_robots_that_drift_are_planned_for(drift: float) -> None:
    planned, count = 0, 0
    for name in ROBOTS:
        for case in cases(name, drift, CASES):
            count += 1
            try:
                schedule, cpu = timed(case.robot, case.rotvec, case.state)
            except (NotFoundError, UnreachableError) as refusal:
                print(f"{name}, {drift:g} deg: {refusal}", flush=True)
                continue
            r_WB, quaternion = flown_by_pinocchio(name, schedule, case.state)
            off = angle_between(quaternion, schedule.path.quaternion[-1])
            missed = angle_between(quaternion, quaternion_from_rotvec(case.rotvec))
            print(
                f"{name}, {drift:g} deg: {schedule.duration:.4g} s, {case.at_rest:.4g} s at rest; "
                f"CPU {cpu:.3g} s, {case.cpu:.3g} s at rest; off by {off:.1e} rad",
                flush=True,
            )
            assert max(off, missed) < END_ERROR
            np.testing.assert_allclose(r_WB, schedule.path.position[-1], atol=END_ERROR)
            planned += 1
    print(f"{drift:g} deg: planned {planned} of {count}", flush=True)
    assert planned >= LEAST_PLANNED[drift] * count - (CASES < 7)
