"""References from start to goal."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from control.flights import END_EFFECTOR, load, pose, servicer_start
from scipy.spatial.transform import Rotation

from spacerobot_ros.control import (
    PROFILES,
    JointReference,
    MotionLimits,
    PoseReference,
    QuinticReference,
    Reference,
    StepReference,
    TargetNotSetError,
)
from spacerobot_ros.errors import ParameterError

LIMITS = MotionLimits(0.3, 0.2, 0.5, 0.4, 0.6, 0.7)
STEP = 1e-4


def random_pose(rng: np.random.Generator) -> PoseReference:
    return PoseReference(rng.uniform(-2, 2, 3), Rotation.random(random_state=rng).as_quat())


def random_profile(seed: int) -> QuinticReference:
    rng = np.random.default_rng(seed)
    start, goal = (
        Reference(random_pose(rng), random_pose(rng), JointReference.at_rest(rng.uniform(-1, 1, 4)))
        for _ in range(2)
    )
    return QuinticReference(start, goal, LIMITS)


def parts(reference: Reference) -> tuple[PoseReference, PoseReference, JointReference]:
    assert reference.base is not None
    assert reference.end_effector is not None
    assert reference.joints is not None
    return reference.base, reference.end_effector, reference.joints


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
        for i in (0, 1):
            b, n, a = before[i], now[i], after[i]
            assert isinstance(b, PoseReference)
            assert isinstance(n, PoseReference)
            assert isinstance(a, PoseReference)
            np.testing.assert_allclose(
                n.velocity, (a.position - b.position) / (2 * STEP), atol=1e-6
            )
            turn = Rotation.from_quat(a.quaternion) * Rotation.from_quat(b.quaternion).inv()
            np.testing.assert_allclose(n.angular_velocity, turn.as_rotvec() / (2 * STEP), atol=1e-6)
            for value, rate in (
                ("velocity", n.acceleration),
                ("angular_velocity", n.angular_acceleration),
            ):
                change = getattr(a, value) - getattr(b, value)
                np.testing.assert_allclose(rate, change / (2 * STEP), atol=1e-6)
        joints = [found[2] for found in (before, now, after)]
        np.testing.assert_allclose(
            joints[1].qdot, (joints[2].q - joints[0].q) / (2 * STEP), atol=1e-6
        )
        np.testing.assert_allclose(
            joints[1].qddot, (joints[2].qdot - joints[0].qdot) / (2 * STEP), atol=1e-6
        )


@pytest.mark.parametrize("seed", range(4))
def test_limits_are_kept_and_one_is_used_up(seed: int) -> None:
    profile = random_profile(seed)
    used = []
    for time in np.linspace(0.0, profile.duration, 1001):
        base, end_effector, joints = parts(profile.at(float(time)))
        demands = [
            *np.abs(joints.qdot) / LIMITS.joint_speed,
            *np.abs(joints.qddot) / LIMITS.joint_acceleration,
        ]
        for frame in (base, end_effector):
            demands += [
                np.linalg.norm(frame.velocity) / LIMITS.speed,
                np.linalg.norm(frame.acceleration) / LIMITS.acceleration,
                np.linalg.norm(frame.angular_velocity) / LIMITS.angular_speed,
                np.linalg.norm(frame.angular_acceleration) / LIMITS.angular_acceleration,
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
    far = {"base": pose([1, 2, -2], [0.6, 0, 0]), "end_effector": pose([0, 5, 0], [0, 0, 0.8])}
    still = pose([0, 0, 0])
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
    start = Reference(base=pose([1, 2, 3], [0.3, -0.2, 0.1]))
    goal = Reference(base=pose([2, 0, 3], [-0.4, 0.5, 1.1]))
    profile = QuinticReference(start, goal, LIMITS)
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
    start, goal = Reference(base=pose([0, 0, 0])), Reference(base=pose([1, 0, 0]))
    profile = StepReference(start, goal, LIMITS)
    assert profile.duration == 0.0
    assert profile.at(0.0) is goal
    assert set(PROFILES) == {"step", "quintic"}


def test_goal_at_the_start_takes_no_time() -> None:
    there = Reference(base=pose([1, 2, 3], [0.1, 0.2, 0.3]))
    profile = QuinticReference(there, there, LIMITS)
    assert profile.duration < 1e-6
    assert profile.at(1e-6) is there


def test_what_has_no_goal_is_not_in_the_reference() -> None:
    robot, start = load("servicer"), servicer_start()
    present = Reference.present(robot, start, END_EFFECTOR)
    profile = QuinticReference(present, Reference(base=pose([1, 0, 0])), LIMITS)
    reference = profile.at(0.5)
    assert reference.base is not None
    assert reference.end_effector is None
    assert reference.joints is None


def test_goal_without_a_start_is_refused() -> None:
    present = Reference.present(load("servicer"), servicer_start())
    assert present.end_effector is None
    with pytest.raises(TargetNotSetError, match="end-effector has a goal"):
        QuinticReference(present, Reference(end_effector=pose([1, 0, 0])), LIMITS)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan])
def test_limits_that_are_refused(value: float) -> None:
    with pytest.raises(ParameterError, match="'angular_speed'"):
        replace(LIMITS, angular_speed=value)
