"""Limits of actuators and of references."""

from __future__ import annotations

from dataclasses import fields, replace

import casadi as ca
import numpy as np
import pytest
from control.flights import END_EFFECTOR, load, servicer_start
from control.flights import pose as flown_pose
from scipy.spatial.transform import Rotation

from spacerobot_ros.control import PROFILES, Actuation, ActuatorLimits, MotionLimits, reference
from spacerobot_ros.control.reference import HeldVelocityReference, QuinticReference, StepReference
from spacerobot_ros.control.state import JointReference, PoseReference, Reference
from spacerobot_ros.model import SpaceRobot

COMMAND = Actuation(np.array([3.0, 4.0, 12.0, -1.0, 2.0, 2.0]), np.array([5.0, -7.0]))


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(
    ("limits", "efforts", "force", "torque", "tau"),
    [
        # Force and torque keep their directions.
        ((6.5, 1.5), (6.0, 6.0), 1 / 2, 1 / 2, (5.0, -6.0)),
        ((1.3, np.inf), (np.inf, np.inf), 1 / 10, 1.0, (5.0, -7.0)),
        ((np.inf, np.inf), (2.0, 3.0), 1.0, 1.0, (2.0, -3.0)),
        ((13.0, 3.0), (7.0, 7.0), 1.0, 1.0, (5.0, -7.0)),
        ((np.inf, np.inf), (np.inf, np.inf), 1.0, 1.0, (5.0, -7.0)),
        ((0.0, 0.0), (0.0, 0.0), 0.0, 0.0, (0.0, 0.0)),
    ],
)
def test_what_is_beyond_a_limit_is_cut_off(
    limits: tuple[float, float],
    efforts: tuple[float, float],
    force: float,
    torque: float,
    tau: tuple[float, float],
    sign: float,
) -> None:
    """``force`` and ``torque`` are the shares of the command that the limits leave."""
    command = Actuation(sign * COMMAND.wrench_B, sign * COMMAND.tau)
    saturated = ActuatorLimits(*limits, np.array(efforts)).apply(command)
    realised, excess = saturated.realised, saturated.excess
    shares = np.repeat([force, torque], 3)
    np.testing.assert_allclose(realised.wrench_B, shares * command.wrench_B, rtol=1e-15)
    np.testing.assert_array_equal(realised.tau, sign * np.array(tau))
    np.testing.assert_allclose(excess.wrench_B, command.wrench_B - realised.wrench_B)
    np.testing.assert_array_equal(excess.tau, command.tau - realised.tau)
    assert saturated.limited == ((force, torque, tau) != (1.0, 1.0, (5.0, -7.0)))


def test_nothing_is_limited_at_rest_without_thrusters_or_motors() -> None:
    still = ActuatorLimits(0.0, 0.0, np.zeros(2)).apply(Actuation(np.zeros(6), np.zeros(2)))
    assert not still.limited


# -- references that small thrusters can follow, against Pinocchio's rigid-body inertia ----------


def test_strong_thrusters_and_none_at_all_leave_the_limits_as_they_are() -> None:
    motion, robot = MotionLimits(), load("servicer")
    q = np.zeros(robot.n)
    for force, torque in ((np.inf, np.inf), (1e9, 1e9), (0.0, 0.0)):
        limits = ActuatorLimits(force, torque, robot.effort_limit)
        assert motion.within_thruster_limits(limits, robot, q) == motion


# -- reference profiles: quintics of poses and joints, held velocities, and their ----------------


def test_held_velocities_have_their_mean_and_their_jump_at_a_command() -> None:
    held = HeldVelocityReference(0.25)
    velocity = np.array([1.0, -2.0])
    first = held.at_command(np.array([0.5, 0.25]), velocity)
    assert (first.qdot.tolist(), first.qddot.tolist()) == ([1.0, -2.0], [0.0, 0.0])
    velocity[:] = 3.0, 1.0
    second = held.at_command(np.array([0.75, -0.25]), velocity)
    assert second.q.tolist() == [0.75, -0.25]
    assert (second.qdot.tolist(), second.qddot.tolist()) == ([2.0, -0.5], [8.0, 12.0])
    assert first.qdot.tolist() == [1.0, -2.0]


# -- references from start to goal ---------------------------------------------------------------


SIX_LIMITS = MotionLimits(0.3, 0.2, 0.5, 0.4, 0.6, 0.7)
STEP = 1e-4


def random_pose(rng: np.random.Generator) -> PoseReference:
    return PoseReference(rng.uniform(-2, 2, 3), Rotation.random(random_state=rng).as_quat())


def random_ends(seed: int) -> list[Reference]:
    rng = np.random.default_rng(seed)
    return [
        Reference(random_pose(rng), random_pose(rng), JointReference.at_rest(rng.uniform(-1, 1, 4)))
        for _ in range(2)
    ]


def random_profile(seed: int) -> QuinticReference:
    start, goal = random_ends(seed)
    return QuinticReference(start, goal, SIX_LIMITS)


def parts(reference: Reference) -> tuple[PoseReference, PoseReference, JointReference]:
    assert reference.base is not None
    assert reference.end_effector is not None
    assert reference.joints is not None
    return reference.base, reference.end_effector, reference.joints


def numbers(found: Reference) -> np.ndarray:
    parts: list[np.ndarray] = []
    for each in (found.base, found.end_effector):
        assert each is not None
        parts += [each.position, each.quaternion, each.velocity, each.angular_velocity]
        parts += [each.acceleration, each.angular_acceleration]
    assert found.joints is not None
    return np.concatenate([*parts, found.joints.q, found.joints.qdot, found.joints.qddot])


@pytest.mark.parametrize("kind", [QuinticReference, StepReference])
def test_the_expression_of_a_profile_is_the_profile(kind: type) -> None:
    made = kind(*random_ends(5), SIX_LIMITS)
    for base, hand, n in ((True, True, 4), (True, False, 0), (False, True, 4), (False, False, 4)):
        given = reference.profile_numbers(made, base, hand, n)
        size = reference.profile_size(base, hand, n)
        assert len(given) == size == 1 + 31 * (base + hand) + 3 * n
        symbols, time = ca.SX.sym("p", size), ca.SX.sym("t")
        expression = reference.profile_expression(symbols, time, base, hand, n)
        function = ca.Function("f", [symbols, time], [expression])
        kept = np.repeat([base, hand], 19).tolist() + [n > 0] * 12
        for t in (-1e4, 0.0, 0.3 * made.duration, 0.999 * made.duration, made.duration, 99.0):
            found = np.array(function(given, t)).ravel()
            np.testing.assert_allclose(found, numbers(made.at(t))[kept], atol=1e-12)


@pytest.mark.parametrize("seed", range(4))
def test_quintic_goes_from_rest_at_the_start_to_rest_at_the_goal(seed: int) -> None:
    profile = random_profile(seed)
    for time, wanted in ((0.0, profile.start), (profile.duration * (1 - 1e-9), profile.goal)):
        for found, end in zip(parts(profile.at(time))[:2], parts(wanted)[:2], strict=True):
            np.testing.assert_allclose(found.position, end.position, atol=1e-9)
            turn = Rotation.from_quat(found.quaternion).inv() * Rotation.from_quat(end.quaternion)
            assert turn.magnitude() < 1e-9
            for rate in (found.velocity, found.angular_velocity, found.acceleration):
                np.testing.assert_allclose(rate, 0.0, atol=1e-7)
        joints = parts(profile.at(time))[2]
        np.testing.assert_allclose(joints.q, parts(wanted)[2].q, atol=1e-9)
        np.testing.assert_allclose(joints.qddot, 0.0, atol=1e-7)
    assert profile.at(profile.duration) is profile.goal
    np.testing.assert_array_equal(
        parts(profile.at(-1.0))[0].position, parts(profile.start)[0].position
    )


@pytest.mark.parametrize("seed", range(4))
def test_velocities_and_accelerations_are_derivatives(seed: int) -> None:
    profile = random_profile(seed)
    for fraction in (0.1, 0.5, 0.83):
        time = fraction * profile.duration
        before, now, after = (parts(profile.at(time + dt)) for dt in (-STEP, 0.0, STEP))
        rates = [now[2].qdot, now[2].qddot]
        changes = [after[2].q - before[2].q, after[2].qdot - before[2].qdot]
        for n, b, a in zip(now[:2], before[:2], after[:2], strict=True):
            turn = Rotation.from_quat(a.quaternion) * Rotation.from_quat(b.quaternion).inv()
            rates += [n.velocity, n.angular_velocity, n.acceleration, n.angular_acceleration]
            changes += [a.position - b.position, turn.as_rotvec()]
            changes += [a.velocity - b.velocity, a.angular_velocity - b.angular_velocity]
        for rate, change in zip(rates, changes, strict=True):
            np.testing.assert_allclose(rate, change / (2 * STEP), atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_limits_are_kept_and_one_is_used_up(seed: int) -> None:
    profile = random_profile(seed)
    used = []
    for time in np.linspace(0.0, profile.duration, 1001):
        base, end_effector, joints = parts(profile.at(float(time)))
        demands = [
            *np.abs(joints.qdot) / SIX_LIMITS.joint_speed,
            *np.abs(joints.qddot) / SIX_LIMITS.joint_acceleration,
        ]
        for frame in (base, end_effector):
            demands += [
                np.linalg.norm(frame.velocity) / SIX_LIMITS.speed,
                np.linalg.norm(frame.acceleration) / SIX_LIMITS.acceleration,
                np.linalg.norm(frame.angular_velocity) / SIX_LIMITS.angular_speed,
                np.linalg.norm(frame.angular_acceleration) / SIX_LIMITS.angular_acceleration,
            ]
        used.append(max(demands))
    assert 0.999 < max(used) <= 1.0 + 1e-9


@pytest.mark.parametrize("group", ["base", "end_effector", "joints"])
@pytest.mark.parametrize("kind", ["position", "attitude"])
@pytest.mark.parametrize("bound", ["speed", "acceleration"])
def test_every_limit_sets_the_pace_where_it_alone_is_small(
    group: str, kind: str, bound: str
) -> None:
    """The duration by hand: a quintic over d has rates up to 15/8 d/T, and 10/sqrt(3) d/T^2."""
    prefix = "joint_" if group == "joints" else "angular_" if kind == "attitude" else ""
    wide = {limit.name: 1e3 for limit in fields(MotionLimits)}
    small = 0.05
    limits = MotionLimits(**{**wide, prefix + bound: small})
    # Distance and angle differ, and so do those of base and end-effector.
    far = {
        "base": flown_pose([1, 2, -2], [0.6, 0, 0]),
        "end_effector": flown_pose([0, 5, 0], [0, 0, 0.8]),
    }
    still = flown_pose([0, 0, 0])
    d = {"base": (3.0, 0.6), "end_effector": (5.0, 0.8)}.get(group, (0.7, 0.7))
    start = Reference(still, still, JointReference.at_rest(np.zeros(2)))
    goal = replace(start, joints=JointReference.at_rest(np.array([-0.7, 0.2])))
    if group != "joints":
        base, end_effector = (far[n] if n == group else still for n in far)
        goal = Reference(base, end_effector, start.joints)
    length = d[1] if kind == "attitude" else d[0]
    wanted = 15 / 8 * length / small
    if bound == "acceleration":
        wanted = np.sqrt(10 / np.sqrt(3) * length / small)
    assert QuinticReference(start, goal, limits).duration == pytest.approx(wanted, rel=1e-12)


def test_positions_move_on_a_line_and_attitudes_about_one_axis() -> None:
    start = Reference(base=flown_pose([1, 2, 3], [0.3, -0.2, 0.1]))
    goal = Reference(base=flown_pose([2, 0, 3], [-0.4, 0.5, 1.1]))
    profile = QuinticReference(start, goal, SIX_LIMITS)
    first = Rotation.from_rotvec([0.3, -0.2, 0.1])
    whole = Rotation.from_rotvec([-0.4, 0.5, 1.1]) * first.inv()
    for fraction in (0.2, 0.5, 0.7):
        base = profile.at(fraction * profile.duration).base
        assert base is not None
        s = fraction**3 * (10 - 15 * fraction + 6 * fraction**2)
        np.testing.assert_allclose(base.position, np.array([1 + s, 2 - 2 * s, 3]), atol=1e-12)
        turn = Rotation.from_quat(base.quaternion) * first.inv()
        np.testing.assert_allclose(turn.as_rotvec(), s * whole.as_rotvec(), atol=1e-12)


def test_step_is_the_goal_at_once() -> None:
    start, goal = (Reference(base=flown_pose([0, 0, 0])), Reference(base=flown_pose([1, 0, 0])))
    profile = StepReference(start, goal, SIX_LIMITS)
    assert profile.duration == 0.0
    assert profile.at(0.0) is goal
    assert set(PROFILES) == {"step", "quintic"}


def test_goal_at_the_start_takes_no_time() -> None:
    there = Reference(base=flown_pose([1, 2, 3], [0.1, 0.2, 0.3]))
    profile = QuinticReference(there, there, SIX_LIMITS)
    assert profile.duration < 1e-6
    assert profile.at(1e-6) is there


def test_what_has_no_goal_is_not_in_the_reference() -> None:
    robot, start = load("servicer"), servicer_start()
    present = Reference.present(robot, start, END_EFFECTOR)
    profile = QuinticReference(present, Reference(base=flown_pose([1, 0, 0])), SIX_LIMITS)
    reference = profile.at(0.5)
    assert reference.base is not None
    assert reference.end_effector is None
    assert reference.joints is None


def test_references_accelerate_as_the_thrust_can_move_a_rigid_body() -> None:
    """Newton and Euler of a body of 4 kg, whose centre of mass is 0.3 m from its base frame."""
    text = """<robot name="brick"><link name="hull"><inertial><origin xyz="0 0.3 0"/>
      <mass value="4"/><inertia ixx="3" iyy="4" izz="5" ixy="0" ixz="0" iyz="0"/></inertial></link>
      </robot>"""
    robot, q = SpaceRobot.from_urdf(text), np.zeros(0)
    given = MotionLimits(speed=9.0, acceleration=90.0, angular_speed=9.0, angular_acceleration=90.0)

    def lowered(force: float, torque: float) -> tuple[float, float]:
        found = given.within_thruster_limits(ActuatorLimits(force, torque, np.zeros(0)), robot, q)
        return found.acceleration, found.angular_acceleration

    by_force, _ = lowered(2.0, 1e6)
    share = by_force / (2.0 / 4.0)
    assert 0.3 < share <= 1.0
    by_torque, turning = lowered(1e6, 0.6)
    assert turning == pytest.approx(share * 0.6 / 5.0)
    # A force at the base turns the body, which the torque makes up for.
    assert by_torque == pytest.approx(share * 0.6 / (4.0 * 0.3))
    assert lowered(0.0, 0.0) == (90.0, 90.0)
