"""Joints stay within their rates, and a robot whose control is lost is brought to rest.

What the joints do under the efforts is Pinocchio's word.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from control.flights import PinocchioPlant, Reporting, load, planar_start, random_state
from support.executive_loop import KP, SHAPE, TIP, ExecutiveLoop, goal_at
from support.executive_loop import PERIOD as LOOP_PERIOD
from support.random_robots import random_robot_urdf

from spacerobot_ros.control import Actuation, ControlState, PoseReference, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.detumbling import Detumbling
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.limits import JointRateLimits
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal

PERIOD = 0.02


@cache
def random_robot(seed: int) -> SpaceRobot:
    return SpaceRobot.from_urdf(random_robot_urdf(np.random.default_rng(seed), joints=3 + seed % 3))


def to_rest(robot: SpaceRobot) -> Detumbling:
    return Detumbling(robot, None, math.inf, math.inf, 0.0, PERIOD)


# -- rates ------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_accelerations_are_those_that_lead_to_the_rates_and_others_stay(seed: int) -> None:
    robot, rng = random_robot(seed), np.random.default_rng(seed)
    state = random_state(rng, robot.n)
    rates = rng.uniform(0.6, 1.4, robot.n)
    given = Actuation(rng.uniform(-5, 5, 6), rng.uniform(-300, 300, robot.n))
    plant = PinocchioPlant(robot, state)
    without = plant.joint_accelerations(given)
    kept = JointRateLimits(robot, rates, PERIOD).apply(state, given, np.full(robot.n, np.inf))
    np.testing.assert_array_equal(kept.wrench_B, given.wrench_B)
    qddot = plant.joint_accelerations(kept)
    after_two = np.clip(state.qdot + without * 2 * PERIOD, -rates, rates)
    np.testing.assert_allclose(state.qdot + qddot * 2 * PERIOD, after_two, atol=1e-7)
    assert np.any(np.abs(without - qddot) > 1.0), "nothing was to be limited"


@pytest.mark.parametrize("periods", [1, 3])
def test_commands_that_are_held_longer_lead_to_the_rates_more_slowly(periods: int) -> None:
    """Where only every third state is answered, each command is expected to last as long."""
    loop = ExecutiveLoop(joint_rates=0.5, max_force=1.0)
    loop.answer()
    loop.tick += periods - 1
    loop.rates = np.array([0.0, 0.8])
    loop.aim(end_effector=goal_at(TIP + np.array([0.0, 9.0, 0.0])))
    state = ControlState(
        np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), SHAPE, loop.rates
    )
    wrench, tau = loop.answer()
    plant = PinocchioPlant(load("planar_manipulator"), state)
    qddot = plant.joint_accelerations(Actuation(wrench, tau))
    # 1 rad/s is the limit: 0.2 rad/s are left, for two commands.
    assert qddot[1] == pytest.approx(0.2 / (2 * periods * LOOP_PERIOD), rel=1e-6)


def test_a_command_that_keeps_the_rates_is_not_touched() -> None:
    robot = load("servicer")
    limits = JointRateLimits(robot, robot.velocity_limit, PERIOD)
    slow = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.full(6, 0.3))
    given = Actuation(np.ones(6), np.full(6, 0.01))
    assert limits.apply(slow, given, robot.effort_limit) is given
    # As fast as may be, and slowed down.
    fast = replace(slow, qdot=0.99 * robot.velocity_limit)
    braking = to_rest(robot).command(fast)
    qddot = PinocchioPlant(robot, fast).joint_accelerations(braking)
    np.testing.assert_allclose(qddot, -2.0 * fast.qdot, rtol=1e-6)
    assert limits.apply(fast, braking, np.full(6, np.inf)) is braking


@pytest.mark.parametrize("none", [0.0, math.inf])
def test_a_joint_without_a_rate_is_as_fast_as_it_is(none: float) -> None:
    robot = load("planar_manipulator")
    fast = replace(planar_start(), qdot=np.full(2, 50.0))
    given = Actuation(np.zeros(6), np.array([100.0, -100.0]))
    limits = JointRateLimits(robot, np.full(2, none), PERIOD)
    assert limits.apply(fast, given, robot.effort_limit) is given
    assert np.all(np.isinf(limits.rates))


def test_thrust_that_the_motors_cannot_bear_is_lowered_and_keeps_its_direction() -> None:
    robot, effort = load("planar_manipulator"), np.array([30.0, 12.0])
    limits = JointRateLimits(robot, np.array([0.5, 0.7]), PERIOD)
    given = Actuation(np.array([-210.0, 150.0, 0.0, 0.0, 0.0, 5.0]), np.array([30.0, -12.0]))
    fastest = {}
    for limited in (False, True):
        plant = PinocchioPlant(robot, planar_start())
        shares, rates = [], []
        for _ in range(150):
            kept = limits.apply(plant.state, given, effort) if limited else given
            shares.append(kept.wrench_B[0] / given.wrench_B[0])
            np.testing.assert_allclose(kept.wrench_B, shares[-1] * given.wrench_B, atol=1e-12)
            assert np.all(np.abs(kept.tau) <= effort)
            plant.step(kept, PERIOD)
            rates.append(np.max(np.abs(plant.state.qdot) / limits.rates))
        fastest[limited] = max(rates)
        assert limited == (min(shares) < 0.9)
        assert 0.0 <= min(shares) <= max(shares) == 1.0
    assert fastest[True] < 1.1 < 3.0 < fastest[False]


# -- coming to rest ---------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_momenta_and_rates_decay_and_energy_only_falls(seed: int) -> None:
    robot, rng = random_robot(seed), np.random.default_rng(seed)
    state, law = random_state(rng, robot.n), to_rest(robot)
    plant = PinocchioPlant(robot, state, PERIOD / 2)
    *momenta, energy = plant.momentum_W()
    began, rates, first = np.concatenate(momenta), state.qdot, energy
    for _ in range(50):
        plant.step(law.command(plant.state), PERIOD)
        last = energy
        *momenta, energy = plant.momentum_W()
        assert energy < last
    # One second at 2/s, the commands held for a period.
    ended = np.concatenate(momenta)
    np.testing.assert_allclose(ended, math.exp(-2) * began, atol=0.05 * abs(began).max())
    np.testing.assert_allclose(plant.state.qdot, math.exp(-2) * rates, atol=0.05)
    assert energy < 0.1 * first


def margins(position: float, attitude: float) -> dict[str, Any]:
    return {"error_margin.position": position, "error_margin.attitude": attitude}


# -- control that is lost ---------------------------------------------------------------------


class LateFlight(Reporting):
    """An executive and Pinocchio's plant; the pose of the base is that of a while ago."""

    def __init__(self, name: str, start: ControlState, late: float, **settings: Any) -> None:
        robot = load(name)
        self.config = configured(ControllerConfig, {"tick_rate": 1 / PERIOD, **settings})
        self.executive = ControlExecutive(build_controller(robot, self.config), self.config)
        self.plant = PinocchioPlant(robot, start, PERIOD / 2)
        self.past = [start] * (1 + round(late / PERIOD))
        self.rates = robot.velocity_limit
        self.fastest, self.tick = 0.0, 0

    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            now, base = self.plant.state, self.past[0]
            seen = replace(base, q=now.q, qdot=now.qdot)
            time = self.tick * PERIOD
            result = self.executive.command(time, seen, now.q, now.qdot)
            self.executive.evaluate(time, result)
            self.plant.step(result.realised, PERIOD)
            self.past = [*self.past[1:], self.plant.state]
            self.tick += 1
            self.fastest = max(self.fastest, float(np.max(np.abs(now.qdot) / self.rates)))

    def aim(self, offset: tuple[float, float, float], goal_id: str) -> None:
        state = self.plant.state
        goal = Goal(state.r_WB + np.array(offset), state.quaternion_WB)
        self.executive.submit("base", IdentifiedGoal(goal, goal_id))


PLANAR: dict[str, Any] = {"profile": "step"} | {
    f"gains.{group}.{name}": gain
    for group in ("base_position", "base_attitude", "end_effector_position")
    for name, gain in (("kp", 30.0), ("kd", 60.0))
}


def test_a_flight_that_late_measurements_make_unstable_ends_at_rest() -> None:
    """A dead time that no stamp shows: 0.24 s at a loop that damps within a second."""
    flight = LateFlight("planar_manipulator", planar_start(), 0.24, **PLANAR)
    flight.aim((-28.0, 29.0, 0.0), "far")
    flight.fly(6.0)
    assert flight.executive.state.value == "aborted"
    assert flight.executive.controller.coming_to_rest
    (aborted,) = [event for event in flight.events if event.kind is EventKind.GOAL_ABORTED]
    assert aborted.goal_id == "far"
    assert aborted.message.startswith("Aborted: control is lost, ")
    assert flight.fastest < 6.0
    assert flight.plant.momentum_W()[2] < 1e-3


def test_the_same_flight_without_these_limits_is_lost() -> None:
    """So the test above can fail."""
    without = margins(0.0, 0.0)
    flight = LateFlight(
        "planar_manipulator", planar_start(), 0.24, **PLANAR, joint_rates=0.0, **without
    )
    flight.aim((-28.0, 29.0, 0.0), "far")
    while flight.fastest < 20.0:
        assert flight.tick * PERIOD < 3.0, "it should be lost by now"
        flight.fly(PERIOD)


def test_measurements_in_time_reach_the_same_kind_of_goal() -> None:
    flight = LateFlight(
        "planar_manipulator", planar_start(), 0.0, **PLANAR, position_tolerance=0.01,
        attitude_tolerance=0.01,
    )  # fmt: skip
    flight.aim((0.3, -0.2, 0.0), "near")
    flight.fly(15.0)
    assert flight.statuses[-1].state.value == "reached"
    assert flight.fastest < 1.0


@pytest.mark.parametrize("law", ["transposed_jacobian", "computed_torque"])
def test_a_robot_that_holds_after_a_rearm_takes_no_energy(law: str) -> None:
    """What is held begins where the robot is: springs are not stretched, dampers only take."""
    start = replace(
        planar_start(),
        v_WB_B=np.array([0.2, -0.1, 0.0]),
        omega_WB_B=np.array([0.0, 0.0, 0.1]),
        qdot=np.array([0.3, -0.5]),
    )
    flight = LateFlight(
        "planar_manipulator", planar_start(), 0.0, **PLANAR, law=law,
        **{"gains.joints.kp": 4.0, "gains.joints.kd": 5.0},
    )  # fmt: skip
    flight.fly(PERIOD)
    # Latched, moved meanwhile, and rearmed; where it was held before is another place.
    flight.plant.state, flight.past = start, [start]
    flight.executive.plant_stopped("latched")
    flight.executive.on_plant_obeying()
    *momenta, first = flight.plant.momentum_W()
    energies = []
    for _ in range(100):
        flight.fly(PERIOD)
        energies.append(flight.plant.momentum_W()[2])
    assert max(energies) <= first
    assert energies[-1] < 0.95 * first
    if law == "computed_torque":  # The motors alone.
        np.testing.assert_allclose(flight.plant.momentum_W()[:2], momenta, atol=1e-6)
    assert flight.executive.state.value == "holding"


AIM = np.array([0.5, 0.25, 0.0])


def test_one_joint_that_is_too_fast_for_long_enough_ends_the_goal() -> None:
    loop = ExecutiveLoop(joint_rates=0.4)
    loop.aim(base=goal_at(AIM, "g"))
    loop.answer()
    # 0.8 rad/s are left of the URDF's 2 rad/s; half as much again is beyond.
    for rates in ([0.0, -1.19], [0.0, -1.21], [0.0, -1.21], [1.1, 0.0], [0.0, -1.21], [1.21, 0.0]):
        loop.rates = np.array(rates)
        loop.answer()
        assert loop.state == "tracking"
    loop.rates = np.array([0.3, -1.21])
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("aborted", "g")
    assert loop.status.message == (
        "Aborted: control is lost, joint 'elbow' moves at -1.21 rad/s instead of 0.8 rad/s; "
        "the robot is brought to rest."
    )
    (event,) = [event for event in loop.events if event.kind is EventKind.GOAL_ABORTED]
    assert (event.goal_id, event.message) == ("g", loop.status.message)
    loop.answer(10)
    assert [e.kind for e in loop.events].count(EventKind.GOAL_ABORTED) == 1, "it is lost once"


def test_control_that_is_lost_after_a_gap_between_states_says_so() -> None:
    loop = ExecutiveLoop(joint_rates=0.4)
    loop.aim(base=goal_at(AIM, "g"))
    loop.answer()
    loop.tick += 4
    loop.rates = np.array([0.3, -1.21])
    loop.answer(3)
    assert loop.status.message == (
        "Aborted: control is lost, joint 'elbow' moves at -1.21 rad/s instead of 0.8 rad/s "
        "(0.05 s without a state before: is the machine busy?); the robot is brought to rest."
    )


def test_a_robot_that_was_brought_to_rest_begins_its_next_goal_where_it_is() -> None:
    loop = ExecutiveLoop()
    loop.aim(base=goal_at(40 * AIM, "far"))
    loop.rates = np.array([0.0, 9.0])
    loop.answer(3)
    assert loop.state == "aborted"
    loop.rates, loop.place = np.zeros(2), np.array([3.0, 1.0, 0.0])
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)
    loop.velocity = np.array([0.2, 0.0, 0.0])
    mass = loop.executive.controller.law.robot.total_mass
    np.testing.assert_allclose(loop.answer()[0][:3], -2 * mass * loop.velocity, atol=1e-12)
    # The end-effector is to stay where it is by now, not where it was before all this.
    loop.velocity = np.zeros(3)
    loop.aim(base=goal_at(loop.place + AIM, "next"))
    np.testing.assert_allclose(loop.answer()[0][:3], 2 * KP * AIM, atol=1e-12)
    assert (loop.state, loop.status.goal_id) == ("tracking", "next")


def test_a_goal_waits_until_joints_are_slow_enough_again() -> None:
    loop = ExecutiveLoop()
    loop.rates = np.array([0.0, 9.0])
    loop.answer(3)
    loop.aim(base=goal_at(AIM, "next"))
    loop.answer(5)
    assert (loop.state, loop.status.goal_id) == ("aborted", "")
    loop.rates = np.array([0.0, 2.9])
    loop.answer(2)
    assert (loop.state, loop.status.goal_id) == ("tracking", "next")


@pytest.mark.parametrize("margin", [0.5, 0.7])
def test_errors_that_grow_beyond_twice_what_a_goal_asks_for_end_it(margin: float) -> None:
    loop = ExecutiveLoop(None, **margins(margin, 0.1))
    loop.aim(base=goal_at([1.0, 0.0, 0.0], "g"), end_effector=goal_at(TIP, "g"))
    loop.answer()
    loop.place = np.array([1.0 - 2.0 - margin + 0.01, 0.0, 0.0])
    loop.answer(10)
    assert loop.state == "tracking"
    loop.place = loop.place - np.array([0.02, 0.0, 0.0])
    loop.answer(2)
    assert loop.state == "tracking"
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("aborted", "g")
    away = f"{2 + margin + 0.01:.3g} m, 0 rad"
    assert loop.status.message == (
        f"Aborted: control is lost, the errors grow and the robot is {away} from the reference; "
        "the robot is brought to rest."
    )


def test_speed_that_there_is_when_a_goal_begins_may_take_the_robot_away_from_it() -> None:
    """With Kp = 30 and Kd = 60 a robot at 2 m/s stops within 4 m: 8 m are twice that."""
    loop = ExecutiveLoop()
    loop.velocity = np.array([-2.0, 0.0, 0.0])
    loop.aim(base=goal_at([0.1, 0.0, 0.0], "g"), end_effector=goal_at(TIP, "g"))
    loop.answer()
    loop.place = np.array([-9.0, 0.0, 0.0])
    loop.answer(5)
    assert loop.state == "tracking"
    loop.place = np.array([-9.2, 0.0, 0.0])
    loop.answer(5)
    assert loop.state == "aborted"


def test_without_margins_and_rates_a_goal_is_pursued_wherever_the_robot_is() -> None:
    loop = ExecutiveLoop(None, joint_rates=0.0, **margins(0.0, 0.0))
    loop.aim(base=goal_at(AIM, "g"))
    loop.answer()
    loop.place, loop.rates = np.array([1e4, 0.0, 0.0]), np.array([0.0, 1e4])
    loop.answer(10)
    assert loop.state == "tracking"


def test_without_a_goal_fast_joints_are_brought_to_rest_too() -> None:
    loop = ExecutiveLoop()
    loop.answer()
    loop.place, loop.rates = np.array([5.0, 0.0, 0.0]), np.array([0.0, 9.0])
    loop.answer(2)
    assert loop.state == "holding", "errors of what is held end nothing"
    loop.answer()
    assert (loop.state, loop.status.goal_id) == ("aborted", "")
    loop.rates = np.zeros(2)
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)


def test_references_from_outside_are_followed_however_fast_joints_are() -> None:
    loop = ExecutiveLoop()
    loop.rates = np.array([0.0, 9.0])
    pose = PoseReference(AIM, np.array([0.0, 0.0, 0.0, 1.0]))
    loop.answer(10, reference=Reference(base=pose))
    assert loop.state == "holding"
    loop.answer(3)
    assert loop.state == "aborted"
    loop.rates = np.zeros(2)
    wrench, _ = loop.answer(reference=Reference(base=pose))
    np.testing.assert_allclose(wrench[:3], KP * AIM, atol=1e-12)


# -- a plant that is reset --------------------------------------------------------------------


def test_a_goal_is_begun_anew_from_where_a_reset_puts_the_robot() -> None:
    """The reference goes on from there: from where it was before, it would pull at once."""
    pace: dict[str, Any] = {"motion.speed": 10.0, "motion.acceleration": 1.0}
    loop = ExecutiveLoop(None, profile="quintic", **pace)
    loop.aim(base=goal_at(4 * AIM, "g"), end_effector=goal_at(TIP + 4 * AIM, "g"))
    loop.answer()
    profile = loop.executive.controller.profile
    assert profile is not None
    middle = profile.duration / 2
    loop.place = 2 * AIM
    loop.answer(round(middle / LOOP_PERIOD))
    loop.place = -AIM
    loop.executive.plant_reset()
    message = "The plant was reset: the goal is pursued from the initial state."
    wrench, _ = loop.answer()
    assert (message, "g") in [(each.message, each.goal_id) for each in loop.statuses]
    np.testing.assert_allclose(wrench, 0.0, atol=1e-9)
    assert (loop.state, loop.status.goal_id) == ("tracking", "g")
    assert [event.kind for event in loop.events] == [EventKind.GOAL_ACCEPTED]
    goal = loop.executive.controller.goal
    assert goal.base is not None
    np.testing.assert_array_equal(goal.base.position, 4 * AIM)


def test_without_a_goal_a_reset_robot_stays_where_it_is() -> None:
    loop = ExecutiveLoop()
    loop.answer()
    loop.place = AIM
    loop.executive.plant_reset()
    np.testing.assert_allclose(np.concatenate(loop.answer()), 0.0, atol=1e-12)
    assert loop.state == "holding"
    loop.place = np.zeros(3)
    np.testing.assert_allclose(loop.answer()[0][:3], 2 * KP * AIM, atol=1e-12)


@pytest.mark.parametrize("stopped", ["abort", "rearm"])
def test_a_robot_with_smooth_references_is_held_where_it_is(stopped: str) -> None:
    """A reference that comes from where it was before would pull the robot back there."""
    loop = ExecutiveLoop(profile="quintic")
    loop.aim(base=goal_at(4 * AIM, "g"))
    loop.answer(5)
    loop.place = AIM
    if stopped == "abort":
        loop.executive.abort()
    else:
        loop.executive.plant_stopped("latched")
        loop.executive.on_plant_obeying()
    np.testing.assert_allclose(np.concatenate(loop.answer(20)), 0.0, atol=1e-9)
    loop.place = 2 * AIM
    np.testing.assert_allclose(loop.answer()[0][:3], -2 * KP * AIM, atol=1e-9)


def test_what_is_held_does_not_change_with_the_arrays_of_a_state() -> None:
    config = configured(
        ControllerConfig, {"law": "computed_torque", "tick_rate": 100.0, "gains.joints.kp": 4.0}
    )
    controller = build_controller(load("planar_manipulator"), config)
    q = np.array([-1.0, 1.0])
    state = replace(planar_start(), q=q)
    first = controller.command(0.0, state, q, state.qdot).realised.tau
    np.testing.assert_allclose(first, 0.0, atol=1e-9)
    q[1] += 0.1
    assert np.abs(controller.command(0.01, state, q, state.qdot).realised.tau).max() > 0.1


def test_a_reference_at_rest_does_not_change_with_the_arrays_of_a_state() -> None:
    state = planar_start()
    reference = Reference.present(load("planar_manipulator"), state)
    assert reference.base is not None
    assert reference.joints is not None
    parts = reference.base.position, reference.base.quaternion, reference.joints.q
    before = [part.copy() for part in parts]
    for part in (state.r_WB, state.quaternion_WB, state.q):
        part += 0.1
    for part, expected in zip(parts, before, strict=True):
        np.testing.assert_array_equal(part, expected)
