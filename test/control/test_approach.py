"""Approaches to a target: times within limits, its motion, and refusals with their figures."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.executive_loop import SHAPE, TIP, UPRIGHT, planar_manipulator
from support.oracles.integrated import tumbled_body
from support.sentences import assert_one_sentence

from spacerobot_ros.control import ControlState, MotionLimits, PoseReference
from spacerobot_ros.control.approach import ApproachOptions, ApproachPlan, ArmReach, plan_approach
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array, Inertia, Pose
from spacerobot_ros.model.grasp import BodyMotion, TargetBody
from spacerobot_ros.model.target_motion import (
    FrameMotion,
    RelativeMotionOverTime,
    RelativePath,
    TorqueFreeMotion,
)

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
    given: dict[str, Any] = {"options": OPTIONS, "limits": LIMITS, "reach": reach(), **changes}
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
    hand = made.hand(motion.grapple(times), times)
    np.testing.assert_allclose(hand.r[0], TIP, atol=1e-12)
    np.testing.assert_allclose(hand.v[0], 0.0, atol=1e-12)
    speed, acceleration = (np.linalg.norm(each, axis=1).max() for each in (hand.v, hand.a))
    assert 0.02 < speed <= 0.3
    assert 0.01 < acceleration <= 0.1 * 1.01
    waiting = motion.grapple([made.closing_time - 0.4])
    beside = made.hand(waiting, np.array([made.closing_time - 0.4]))
    offset = waiting.R[0].T @ (beside.r[0] - waiting.r[0])
    np.testing.assert_allclose(offset, OPTIONS.standoff, atol=1e-12)
    met = motion.grapple([made.contact])
    last = made.hand(met, np.array([made.contact]))
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
    assert_one_sentence(refused, "The target moves too fast to be reached", said)


def test_rotation_counts_only_where_it_is_controlled() -> None:
    limits = MotionLimits(speed=0.3, acceleration=0.1, angular_speed=0.01, angular_acceleration=9.0)
    assert plan(target((1.7, -0.5)), limits=limits).start == 0.0
    said = refusal(target((1.7, -0.5)), limits=limits, reach=reach(axes=("x", "rz")))
    assert "rad/s, and 'motion.angular_speed' is 0.01" in said


def test_joints_that_are_too_slow_are_named() -> None:
    said = refusal(target((1.7, -0.5)), reach=reach(0.005))
    assert_one_sentence(said, "The target cannot be met within the next 3 s", "limit is 0.005/s")
    assert re.search(r"joint '(shoulder|elbow)' would move at 0\.0\d+/s", said)


def test_a_hand_that_moves_sets_out_at_once_or_not() -> None:
    moving = PoseReference(TIP, UPRIGHT, np.array([0.05, -0.02, 0.0]))
    made = plan(target((1.7, -0.5)), held=moving)
    assert made.start == 0.0
    first = made.hand(target((1.7, -0.5)).grapple([0.0]), np.array([0.0]))
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


@pytest.mark.parametrize(("rate", "slow_enough"), [(0.85, True), (0.95, False)])
def test_an_arm_follows_within_nine_tenths_of_the_rates_of_its_joints(
    rate: float, slow_enough: bool
) -> None:
    """The shoulder turns by so much of its rate of 1 rad/s for 0.1 s: two links of 1 m."""
    arm, period = reach(1.0), 0.1
    turned = SHAPE[0] + period * rate * np.array([0.0, 1.0])
    tips = [
        [0.5 + math.cos(q) + math.cos(q + SHAPE[1]), math.sin(q) + math.sin(q + SHAPE[1]), 0.0]
        for q in turned
    ]
    zero = np.zeros((2, 3))
    motion = FrameMotion(np.tile(np.eye(3), (2, 1, 1)), np.array(tips), zero, zero, zero, zero)
    _, why = arm.shapes_along(motion, period)
    assert why == "" if slow_enough else why.startswith("joint 'shoulder' would move at 0.9")


# -- predictions of a free target against an independent integration, and paths beside it --------


INERTIA = np.array([[30.0, 2.0, -1.5], [2.0, 45.0, 3.0], [-1.5, 3.0, 22.0]])
GRAPPLE_R = Rotation.from_rotvec([0.4, -0.9, 0.3])
TUMBLER = TargetBody(
    Inertia(200.0, np.array([0.1, -0.05, 0.2]), INERTIA),
    Pose(GRAPPLE_R.as_matrix(), np.array([-0.6, 0.3, 0.25])),
)
START = BodyMotion(
    Rotation.from_rotvec([0.2, 0.5, -1.1]).as_matrix(),
    np.array([2.5, -0.4, 0.7]),
    np.array([0.02, -0.01, 0.015]),
    np.array([0.06, -0.05, 0.03]),
)
TIMES = np.array([0.0, 0.7, 13.3, 61.9, 140.0])


def test_the_grapple_frame_moves_as_an_independent_integration_has_it() -> None:
    R, r, omega_T = tumbled_body(TUMBLER.inertia, START, TIMES)
    motion = TorqueFreeMotion(TUMBLER, START).grapple(TIMES)
    np.testing.assert_allclose(motion.R, (R * GRAPPLE_R).as_matrix(), atol=2e-8)
    np.testing.assert_allclose(motion.r, r + R.apply(TUMBLER.grapple.r), atol=2e-8)
    np.testing.assert_allclose(motion.omega, R.apply(omega_T), atol=1e-9)
    np.testing.assert_allclose(motion.body_motion().v, START.at(TUMBLER.grapple).v, atol=1e-14)
    turned = np.linalg.norm(motion.R[3] - motion.R[0])
    assert turned > 1.0, "the target tumbles on the way"
    constant = START.r_WT + TIMES[3] * START.v
    assert np.linalg.norm(motion.r[3] - constant) > 0.3, "it is no motion at constant velocity"


def numerical(motion: FrameMotion, h: float) -> tuple[Array, Array, Array, Array]:
    """Return rates and accelerations in the middle of three samples."""
    v = (motion.r[2] - motion.r[0]) / (2 * h)
    a = (motion.r[2] - 2 * motion.r[1] + motion.r[0]) / h**2
    turn = Rotation.from_matrix(motion.R[2] @ motion.R[0].T).as_rotvec()
    return v, turn / (2 * h), a, (motion.omega[2] - motion.omega[0]) / (2 * h)


@pytest.mark.parametrize("time", [0.0, 3.3, 6.9])
def test_rates_and_accelerations_of_a_path_beside_the_target_are_those_of_its_poses(
    time: float,
) -> None:
    target, h = TorqueFreeMotion(TUMBLER, START), 1e-3
    held = PoseReference(np.array([1.0, 0.2, 0.3]), np.array([0.0, 0.6, 0.0, 0.8]))
    begin = RelativeMotionOverTime.between(target.grapple([2.0]), held.motion)
    path = RelativePath(begin, np.array([-0.3, 0.1, 0.05]), 7.0)
    times = np.array([time, time + h, time + 2 * h])
    motion = target.grapple(2.0 + times).with_relative_motion(path.at(times))
    v, omega, a, alpha = numerical(motion, h)
    np.testing.assert_allclose(motion.v[1], v, atol=1e-6)
    np.testing.assert_allclose(motion.omega[1], omega, atol=1e-6)
    np.testing.assert_allclose(motion.a[1], a, atol=1e-5)
    np.testing.assert_allclose(motion.alpha[1], alpha, atol=1e-5)


def test_a_path_begins_in_the_motion_of_the_held_pose_and_ends_with_the_grapple_frame() -> None:
    target = TorqueFreeMotion(TUMBLER, START)
    held = PoseReference(
        np.array([1.0, 0.2, 0.3]),
        np.array([0.0, 0.6, 0.0, 0.8]),
        np.array([0.01, 0.02, -0.03]),
        np.array([0.05, -0.02, 0.01]),
        np.array([0.003, -0.002, 0.001]),
        np.array([-0.004, 0.002, 0.003]),
    )
    begin = RelativeMotionOverTime.between(target.grapple([2.0]), held.motion)
    standoff = np.array([-0.3, 0.1, 0.05])
    path = RelativePath(begin, standoff, 7.0)
    begun = PoseReference.of_motion(target.grapple([2.0]).with_relative_motion(path.at([0.0])))
    for name in (
        "position",
        "velocity",
        "angular_velocity",
        "acceleration",
        "angular_acceleration",
    ):
        np.testing.assert_allclose(
            getattr(begun, name), getattr(held, name), atol=1e-12, err_msg=name
        )
    assert abs(begun.quaternion @ held.quaternion) == pytest.approx(1.0, abs=1e-14)
    for end in (7.0, 9.5):
        grapple = target.grapple([2.0 + end])
        last = grapple.with_relative_motion(path.at([end]))
        np.testing.assert_allclose(last.R, grapple.R, atol=1e-14)
        np.testing.assert_allclose(last.omega, grapple.omega, atol=1e-14)
        np.testing.assert_allclose(last.r[0], grapple.r[0] + grapple.R[0] @ standoff, atol=1e-14)
        arm = grapple.R[0] @ standoff
        np.testing.assert_allclose(
            last.v[0], grapple.v[0] + np.cross(grapple.omega[0], arm), atol=1e-14
        )


def test_small_and_large_turns_have_one_formula() -> None:
    """Near no turn, where the functions of the angle are series, nothing jumps."""
    phidot, phiddot = np.array([[0.3, -0.2, 0.5]]), np.array([[-0.1, 0.4, 0.2]])
    zero = np.zeros((1, 3))
    direction = np.array([[0.6, 0.0, -0.8]])
    found = [
        RelativeMotionOverTime(
            *(np.hstack([zero, each]) for each in (angle * direction, phidot, phiddot))
        )
        for angle in (0.9999e-3, 1.0001e-3)
    ]
    for before, after in zip(found[0].rotation, found[1].rotation, strict=True):
        np.testing.assert_allclose(before, after, atol=1e-6)
