"""Approaches of a planar arm to a block: times within limits, and refusals with their figures."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.executive_loop import SHAPE, TIP, UPRIGHT, planar_manipulator
from support.sentences import assert_one_sentence

from spacerobot_ros.control import ControlState, MotionLimits, PoseReference
from spacerobot_ros.control.approach import (
    ApproachOptions,
    ApproachPlan,
    ArmReach,
    plan_approach,
)
from spacerobot_ros.control.target_motion import FrameMotion, TorqueFreeMotion
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array, Inertia, Pose
from spacerobot_ros.model.grasp import BodyMotion, TargetBody

GRAPPLE = np.array([-0.4, 0.1, 0.0])
BODY = TargetBody(
    Inertia(10.0, np.array([0.05, -0.02, 0.0]), np.diag([1.0, 1.5, 2.0])), Pose(r=GRAPPLE)
)
OPTIONS = ApproachOptions(
    standoff=(-0.2, 0.05, 0.0), standoff_time=1.5, closing_speed=0.05, horizon=3.0
)
LIMITS = MotionLimits(speed=0.3, acceleration=0.1, angular_speed=0.3, angular_acceleration=0.1)
HELD = PoseReference(TIP, UPRIGHT)


def target(
    grapple: tuple[float, float], v: tuple[float, float] = (0.0, 0.0), rate: float = 0.02
) -> TorqueFreeMotion:
    """Return a block with its grapple frame at a place, turned by 0.3 rad."""
    R = Rotation.from_rotvec([0, 0, 0.3]).as_matrix()
    r = np.array([*grapple, 0.0]) - R @ GRAPPLE
    motion = BodyMotion(R, r, np.array([*v, 0.0]), np.array([0.0, 0.0, rate]))
    return TorqueFreeMotion(BODY, motion)


def reach(rates: float = 1.0, axes: tuple[str, ...] = ("x", "y")) -> ArmReach:
    state = ControlState.at_rest(np.zeros(3), UPRIGHT, SHAPE)
    return ArmReach(planar_manipulator(), "end_effector", axes, state, np.full(2, rates))


def plan(motion: TorqueFreeMotion, **changes: Any) -> ApproachPlan:
    given: dict[str, Any] = {
        "options": OPTIONS,
        "limits": LIMITS,
        "reach": reach(),
        "axes": ("x", "y"),
    }
    given |= changes
    return plan_approach(motion, given.pop("held", HELD), **given)


def refusal(motion: TorqueFreeMotion, **changes: Any) -> str:
    with pytest.raises(PlanningError) as refused:
        plan(motion, **changes)
    return str(refused.value)


def at(pose: Array) -> FrameMotion:
    zero = np.zeros((1, 3))
    return FrameMotion(np.eye(3)[np.newaxis], pose[np.newaxis], zero, zero, zero, zero)


def test_an_approach_sets_out_at_once_and_keeps_all_limits_to_contact() -> None:
    motion = target((1.7, -0.5))
    made = plan(motion)
    assert made.start == 0.0
    assert made.closing_time == made.path_to_standoff.duration + 1.5
    # The closing path of 0.206 m takes 15/8 of its length over its speed.
    length = math.hypot(0.2, 0.05)
    assert made.contact - made.closing_time == pytest.approx(15 / 8 * length / 0.05)
    times = np.linspace(0.0, made.contact + 1.0, 2000)
    hand = motion.grapple(times).with_relative_motion(made.relative(times))
    np.testing.assert_allclose(hand.r[0], TIP, atol=1e-12)
    np.testing.assert_allclose(hand.v[0], 0.0, atol=1e-12)
    speed, acceleration = (np.linalg.norm(each, axis=1).max() for each in (hand.v, hand.a))
    assert 0.02 < speed <= 0.3
    assert 0.01 < acceleration <= 0.1 * 1.01
    waiting = motion.grapple([made.closing_time - 0.4])
    beside = waiting.with_relative_motion(made.relative(np.array([made.closing_time - 0.4])))
    offset = waiting.R[0].T @ (beside.r[0] - waiting.r[0])
    np.testing.assert_allclose(offset, OPTIONS.standoff, atol=1e-12)
    met = motion.grapple([made.contact])
    last = met.with_relative_motion(made.relative(np.array([made.contact])))
    for name in ("r", "R", "v", "omega"):
        np.testing.assert_allclose(getattr(last, name), getattr(met, name), atol=1e-12)


def test_the_hand_waits_until_a_target_that_comes_nearer_is_within_reach() -> None:
    patient = ApproachOptions(**{**vars(OPTIONS), "horizon": 40.0})
    made = plan(target((3.9, -0.5), (-0.06, 0.0)), options=patient)
    assert 3.0 < made.start < 35.0
    assert made.start == round(made.start)
    earlier = ApproachOptions(**{**vars(OPTIONS), "horizon": made.start})
    said = refusal(target((3.9, -0.5), (-0.06, 0.0)), options=earlier)
    assert "out of reach within the next" in said


def test_a_target_out_of_reach_is_refused_with_the_distance_that_is_left() -> None:
    """The arm's links are a metre long, and its shoulder is 0.5 m from the base's centre."""
    said = refusal(target((3.0, 0.0), rate=0.0))
    assert_one_sentence(said, "out of reach within the next 3 s", "while the base holds")
    (left,) = re.findall(r"stays ([\d.]+) m or rad", said)
    assert float(left) == pytest.approx(0.5, abs=0.01)
    (contact,) = re.findall(r"contact at ([\d.]+) s", said)
    assert 5.0 < float(contact) < 60.0


def test_a_target_that_leaves_is_out_of_reach() -> None:
    assert "out of reach" in refusal(target((2.3, -0.4), (0.09, 0.02)))


@pytest.mark.parametrize(
    ("motion", "limits", "said"),
    [
        (target((1.7, -0.5), (0.0, 0.4)), {}, "m/s, and 'motion.speed' is 0.3."),
        (
            target((1.7, -0.5), rate=0.1),
            {"acceleration": 0.002},
            "m/s^2, and 'motion.acceleration' is 0.002.",
        ),
        (
            target((1.7, -0.5), rate=0.1),
            {"acceleration": 9.0, "speed": 0.02},
            "m/s, and 'motion.speed' is 0.02.",
        ),
    ],
)
def test_a_target_that_is_too_fast_is_refused_with_the_limit(
    motion: TorqueFreeMotion, limits: dict[str, float], said: str
) -> None:
    refused = refusal(motion, limits=MotionLimits(**{**vars(LIMITS), **limits}))
    assert_one_sentence(refused, "The target moves too fast to be met", said)


def test_rotation_counts_only_where_it_is_controlled() -> None:
    limits = MotionLimits(speed=0.3, acceleration=0.1, angular_speed=0.01, angular_acceleration=9.0)
    assert plan(target((1.7, -0.5)), limits=limits).start == 0.0
    said = refusal(target((1.7, -0.5)), limits=limits, axes=("x", "rz"))
    assert "rad/s, and 'motion.angular_speed' is 0.01" in said


def test_joints_that_are_too_slow_are_named() -> None:
    said = refusal(target((1.7, -0.5)), reach=reach(0.005))
    assert_one_sentence(said, "The target cannot be met within the next 3 s", "of 0.005/s")
    assert re.search(r"joint '(shoulder|elbow)' would move at 0\.0\d+/s", said)


def test_a_hand_that_moves_sets_out_at_once_or_not() -> None:
    moving = PoseReference(TIP, UPRIGHT, np.array([0.05, -0.02, 0.0]))
    made = plan(target((1.7, -0.5)), held=moving)
    assert made.start == 0.0
    first = target((1.7, -0.5)).grapple([0.0]).with_relative_motion(made.relative(np.array([0.0])))
    np.testing.assert_allclose(first.v[0], moving.velocity, atol=1e-12)
    assert "out of reach" in refusal(target((3.9, -0.5), (-0.06, 0.0)), held=moving)


def test_the_distance_of_a_reach_is_that_of_two_links() -> None:
    arm = reach()
    assert arm.distance_to(at(np.array([1.2, 0.9, 0.0])), 0) < 1e-3
    # Straight to the left of the shoulder at (0.5, 0) the arm ends 2 m away.
    assert arm.distance_to(at(np.array([0.5, 2.4, 0.0])), 0) == pytest.approx(0.4, abs=0.02)
    shapes, why = arm.shapes_along(at(np.array([1.2, 0.9, 0.0])), 0.25)
    assert (why, shapes.shape) == ("", (1, 2))
    assert "stays 0.4" in arm.shapes_along(at(np.array([0.5, 2.4, 0.0])), 0.25)[1]
