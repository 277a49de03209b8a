"""Reference profiles: quintics of poses and joints, held velocities, and their expressions."""

from __future__ import annotations

import math

import casadi as ca
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.control import reference
from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.reference import HeldVelocityReference, QuinticReference, StepReference
from spacerobot_ros.control.state import (
    JointReference,
    PoseReference,
    Reference,
    TargetNotSetError,
)

LIMITS = MotionLimits(0.5, 0.25, 0.75, 0.5, 0.2, 0.1)


def pose(position: list[float], rotvec: list[float]) -> PoseReference:
    return PoseReference(np.array(position), Rotation.from_rotvec(rotvec).as_quat())


def joints(*q: float) -> JointReference:
    return JointReference(np.array(q), np.zeros(len(q)), np.zeros(len(q)))


START = Reference(
    pose([0.1, -0.2, 0.3], [0.2, 0.1, -0.4]),
    pose([1.0, 0.5, 0.0], [0.0, 0.9, 0.0]),
    joints(0.3, -1),
)
GOAL = Reference(
    pose([0.6, 0.4, 0.1], [-0.3, 0.5, 0.1]),
    pose([1.2, 0.9, -0.4], [0.4, 0.3, 0.2]),
    joints(-0.1, 0),
)


def numbers(found: Reference) -> np.ndarray:
    parts: list[np.ndarray] = []
    for each in (found.base, found.end_effector):
        assert each is not None
        parts += [each.position, each.quaternion, each.velocity, each.angular_velocity]
        parts += [each.acceleration, each.angular_acceleration]
    assert found.joints is not None
    return np.concatenate([*parts, found.joints.q, found.joints.qdot, found.joints.qddot])


def test_a_profile_lasts_as_long_as_its_slowest_part() -> None:
    made = QuinticReference(START, GOAL, LIMITS)
    peak, share = 15 / 8, 10 / math.sqrt(3)

    def least(distance: float, speed: float, acceleration: float) -> float:
        return max(peak * distance / speed, math.sqrt(share * distance / acceleration))

    parts = {
        "base": least(math.sqrt(0.65), 0.5, 0.25),
        "end_effector": least(0.6, 0.5, 0.25),
        "joints": least(1.0, 0.2, 0.1),
    }
    for name in ("base", "end_effector"):
        begin, end = getattr(START, name), getattr(GOAL, name)
        turn = Rotation.from_quat(begin.quaternion).inv() * Rotation.from_quat(end.quaternion)
        parts[name] = max(parts[name], least(turn.magnitude(), 0.75, 0.5))
    assert made.duration == pytest.approx(max(parts.values()))
    for name, duration in parts.items():
        kept = {each: None for each in parts if each != name}
        one = QuinticReference(_without(START, kept), _without(GOAL, kept), LIMITS)
        assert one.duration == pytest.approx(duration)
    # Two poses or shapes that are equal need no time.
    assert QuinticReference(START, START, LIMITS).duration == 0.0
    assert QuinticReference(Reference(), Reference(), LIMITS).duration == 0.0
    with pytest.raises(TargetNotSetError, match=r"^The base has a goal, but no pose to start"):
        QuinticReference(Reference(), GOAL, LIMITS)


def _without(given: Reference, parts: dict[str, None]) -> Reference:
    names = ("base", "end_effector", "joints")
    return Reference(*(None if name in parts else getattr(given, name) for name in names))


def test_a_profile_leads_from_start_to_goal_and_its_rates_are_its_slopes() -> None:
    made = QuinticReference(START, GOAL, LIMITS)
    T, h = made.duration, 1e-5
    np.testing.assert_allclose(numbers(made.at(-1.0)), numbers(START), atol=1e-12)
    assert made.at(T) is made.goal
    for t in (0.2 * T, 0.7 * T):
        before, now, after = made.at(t - h), made.at(t), made.at(t + h)
        for name in ("base", "end_effector"):
            a, m, b = (getattr(each, name) for each in (before, now, after))
            np.testing.assert_allclose(m.velocity, (b.position - a.position) / (2 * h), atol=1e-8)
            np.testing.assert_allclose(
                m.acceleration, (b.velocity - a.velocity) / (2 * h), atol=1e-8
            )
            turn = Rotation.from_quat(b.quaternion) * Rotation.from_quat(a.quaternion).inv()
            np.testing.assert_allclose(m.angular_velocity, turn.as_rotvec() / (2 * h), atol=1e-8)
            np.testing.assert_allclose(
                m.angular_acceleration,
                (b.angular_velocity - a.angular_velocity) / (2 * h),
                atol=1e-8,
            )
        a, m, b = before.joints, now.joints, after.joints
        assert a is not None
        assert m is not None
        assert b is not None
        np.testing.assert_allclose(m.qdot, (b.q - a.q) / (2 * h), atol=1e-8)
        np.testing.assert_allclose(m.qddot, (b.qdot - a.qdot) / (2 * h), atol=1e-8)


@pytest.mark.parametrize("kind", [QuinticReference, StepReference])
def test_the_expression_of_a_profile_is_the_profile(kind: type) -> None:
    made = kind(START, GOAL, LIMITS)
    for base, hand, n in ((True, True, 2), (True, False, 0), (False, True, 2), (False, False, 2)):
        given = reference.profile_numbers(made, base, hand, n)
        size = reference.profile_size(base, hand, n)
        assert len(given) == size == 1 + 25 * (base + hand) + 3 * n
        symbols, time = ca.SX.sym("p", size), ca.SX.sym("t")
        expression = reference.profile_expression(symbols, time, base, hand, n)
        function = ca.Function("f", [symbols, time], [expression])
        kept = np.repeat([base, hand], 19).tolist() + [n > 0] * 6
        for t in (-1e4, 0.0, 0.3 * made.duration, 0.999 * made.duration, made.duration, 99.0):
            found = np.array(function(given, t)).ravel()
            np.testing.assert_allclose(found, numbers(made.at(t))[kept], atol=1e-12)


def test_one_function_evaluates_one_profile_after_the_other() -> None:
    function = reference.ProfileFunction(True, False, 2)
    kept = np.repeat([True, False], 19).tolist() + [True] * 6
    back = QuinticReference(GOAL, START, LIMITS)
    for made, share in ((QuinticReference(START, GOAL, LIMITS), 0.3), (back, 0.3), (back, 0.8)):
        time = share * made.duration
        found = function.at(made, time)
        assert found is not None
        np.testing.assert_allclose(found, numbers(made.at(time))[kept], atol=1e-12)
    without = QuinticReference(START, _without(GOAL, {"joints": None}), LIMITS)
    assert function.at(without, 0.0) is None
    assert function.at(back, 0.0) is not None


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
