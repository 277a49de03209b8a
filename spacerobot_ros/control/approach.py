"""Approach to a target: start time and end-effector reference.

The reference is a path relative to the grapple frame, whose motion is predicted from the target's
torque-free motion (:mod:`spacerobot_ros.model.target_motion`). The path leads from the current pose
to a standoff; at the standoff, the end-effector moves with the grapple frame for a while, then
closes in along a straight line in that frame. At contact, the end-effector and this frame have the
same pose and velocity.

The approach starts at the earliest time for which the whole reference is within the limits. In
addition, an arm on a fixed base must be able to follow the reference within joint position and rate
limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import accumulate, product
from operator import mul

import numpy as np

from spacerobot_ros.collision import BasePoses, CollisionGeometry, LinkPair
from spacerobot_ros.control.limits import MotionLimits
from spacerobot_ros.control.reference import quintic_duration
from spacerobot_ros.control.state import ControlState, PoseReference
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model.description import Array, Pose, RobotDescription
from spacerobot_ros.model.inverse_kinematics import REACHED_DISTANCE, FixedBaseArm
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.target_motion import (
    FrameMotion,
    PathInWorld,
    RelativeMotionOverTime,
    RelativePath,
    TorqueFreeMotion,
)
from spacerobot_ros.parameters import parameter

_SAMPLE_PERIOD = 0.25  # s, between limit checks
_COARSE_STRIDE = 8

_START_PERIOD = 1.0  # s

_LONGEST_PATH = 60.0
_PATH_DURATIONS = tuple(accumulate([4.0] + [1.4] * 8, mul))
"""Longest duration of a path to the standoff, s, and trial durations, s, in a constant ratio."""

_CLOSING_SHARE = 0.5
"""Fraction of the acceleration limit used for closing in; the motion of the grapple frame needs the
rest."""

_STANDOFF_FACTORS = (1.0, 2.0, 3.0)
"""Multiples of the standoff distance tried if the target blocks the path."""

_MAX_BLOCKED_PATHS = 100

_ARM_RATE_SHARE = 0.9
"""Largest joint rates along an arm path, as a fraction of their limits."""


@dataclass(frozen=True)
class ApproachOptions:
    """Parameters of the approach to a target."""

    grapple_frame: str = parameter("grapple", "target link that the end-effector meets")
    standoff: tuple[float, ...] = parameter(
        (-0.3, 0.0, 0.0),
        "position of the end-effector in the grapple frame before it closes in, along the grasp "
        "axis",
        unit="m",
        minimum=-100.0,
        maximum=100.0,
        length=3,
    )
    standoff_time: float = parameter(
        3.0, "time at the standoff, moving with the grapple frame", unit="s", minimum=0.0
    )
    closing_speed: float = parameter(
        0.05,
        "largest end-effector speed relative to the grapple frame while closing in",
        unit="m/s",
        minimum=1e-4,
    )
    horizon: float = parameter(
        120.0, "time limit for the start of the approach", unit="s", minimum=0.0, maximum=3600.0
    )
    patience: float = parameter(
        3.0, "time after contact within which the target must be captured", unit="s", minimum=0.0
    )
    clearance: float = parameter(
        0.02,
        "smallest distance of the base and the arm from the target during the approach, and of "
        "the end-effector body until the standoff; 0 disables the checks",
        unit="m",
        minimum=0.0,
        maximum=100.0,
    )
    corridor_length: float = parameter(
        0.0,
        "distance from the grapple frame within which a planned approach (profile: planned) keeps "
        "the end-effector in a cone about the direction of the standoff; 0: none",
        unit="m",
        minimum=0.0,
        maximum=100.0,
    )
    corridor_angle: float = parameter(
        0.3, "half-angle of this cone", unit="rad", minimum=0.0, maximum=1.5
    )
    detumble: str = parameter(
        "after",
        "when the angular momentum of the robot and the target is removed: before the capture, by "
        "a planned approach that leaves no momentum (profile: planned); after the capture, by the "
        "task 'detumble'; none: that task is skipped",
        choices=("before", "after", "none"),
    )
    timeout: float = parameter(
        0.5,
        "age of the target's odometry above which the target is considered lost",
        unit="s",
        minimum=0.0,
    )


@dataclass(frozen=True)
class ApproachPlan:
    """Paths of an approach, and times since the state from which it was planned, s.

    Attributes
    ----------
    start
        Departure time of the end-effector.
    path_to_standoff, path_to_contact
        Paths relative to the grapple frame: to the standoff, and from there to contact.
    standoff_time
        Time at the standoff, s.
    distance
        Smallest distance between the robot and the target body during the approach, m; infinite if
        no bodies can touch.
    """

    start: float
    path_to_standoff: RelativePath | PathInWorld
    path_to_contact: RelativePath
    standoff_time: float
    distance: float = math.inf

    @property
    def closing_time(self) -> float:
        """Time at which the end-effector leaves the standoff, s."""
        return self.start + self.path_to_standoff.duration + self.standoff_time

    @property
    def contact(self) -> float:
        """Time at which the end-effector reaches the grapple frame, s."""
        return self.closing_time + self.path_to_contact.duration

    def hand(self, grapple: FrameMotion, times: Array) -> FrameMotion:
        """Return the motion of the end-effector at times (K,) since planning, given the motion of
        the grapple frame."""
        out = self.path_to_standoff.at(times - self.start)
        inward = self.path_to_contact.at(np.maximum(times - self.closing_time, 0.0))
        late = (times >= self.closing_time)[:, np.newaxis]
        relative = RelativeMotionOverTime(
            np.where(late, inward.values, out.values),
            np.where(late, inward.rates, out.rates),
            np.where(late, inward.accelerations, out.accelerations),
        )
        return grapple.with_relative_motion(relative)


class ArmReach(FixedBaseArm):
    """An arm on a fixed base, in the current state: whether it can follow end-effector motions.

    ``rates`` (n,) are the largest joint rates.
    """

    def __init__(
        self, robot: SpaceRobot, link: str, axes: tuple[str, ...], state: ControlState, rates: Array
    ) -> None:
        base = Pose(matrix_from_quaternion(state.quaternion_WB), state.r_WB.copy())
        super().__init__(robot, link, base, axes)
        self._rates = rates
        self.q = state.q.copy()
        """Current shape (n,)."""

    def distance_to(self, motion: FrameMotion, k: int) -> float:
        """Return the smallest distance (m or rad) of the arm from pose k of a motion."""
        return self.nearest_shape(self.q, Pose(motion.R[k], motion.r[k]))[1]

    def shapes_along(self, motion: FrameMotion, period: float) -> tuple[Array, str]:
        """Return the arm configurations (K, n) along a motion, from the current one, and the reason
        why the arm cannot follow; empty if it can follow.

        ``period`` is the time between successive poses of the motion, s.
        """
        q, shapes = self.q, np.empty((len(motion.r), len(self.q)))
        for k in range(len(motion.r)):
            before = q
            q, distance = self.nearest_shape(q, Pose(motion.R[k], motion.r[k]))
            shapes[k] = q
            if distance > REACHED_DISTANCE:
                return shapes, f"the end-effector stays {distance:.3g} m or rad away from it"
            rate = np.abs(q - before) / period
            share = rate / (_ARM_RATE_SHARE * self._rates)
            if k and share.max(initial=0.0) > 1.0:
                worst = int(share.argmax())
                return shapes, (
                    f"joint '{self.robot.joint_names[worst]}' would move at {rate[worst]:.3g}/s, "
                    f"but its limit is {self._rates[worst]:.3g}/s"
                )
        return shapes, ""


def plan_approach(
    target: TorqueFreeMotion,
    held: PoseReference,
    options: ApproachOptions,
    limits: MotionLimits,
    reach: ArmReach,
    clearance: TargetClearance | None = None,
) -> ApproachPlan:
    """Return the approach with the earliest start.

    If the target body blocks the way, the end-effector takes a path that is short in W, to the
    standoff or to a standoff at two or three times the distance, or starts later.

    Parameters
    ----------
    target
        The target's motion.
    held
        The end-effector reference before the approach; if it moves, the approach starts
        immediately.
    options, limits
        The standoff, and reference limits in W.
    reach
        The arm.
    clearance
        Distances from the target body; None if the body is unknown.

    Raises
    ------
    PlanningError
        No approach can start within the horizon; the message names the limit that prevents it.
    """
    moving = bool(held.velocity.any() or held.angular_velocity.any())
    starts = np.arange(0.0, 0.0 if moving else options.horizon, _START_PERIOD)
    standoffs = [factor * np.array(options.standoff) for factor in _STANDOFF_FACTORS]
    # From a standoff to contact, at rest relative to the grapple frame at both.
    limit = min(options.closing_speed, limits.speed), _CLOSING_SHARE * limits.acceleration
    lasts = [quintic_duration(float(np.linalg.norm(each)), *limit) for each in standoffs]
    ways = [
        (each, RelativePath(RelativeMotionOverTime.at_rest(each), np.zeros(3), T))
        for each, T in zip(standoffs, np.maximum(lasts, _SAMPLE_PERIOD).tolist(), strict=True)
    ]
    ways.insert(0, ways[0])  # Short relative to the grapple frame; the others are short in W.
    at_rest, within = held.motion, f"within the next {options.horizon:g} s"
    # The greater of two refusal reasons belongs to the approach that got farther.
    refused, blocked = (0, -math.inf, ""), 0
    longest = _LONGEST_PATH + options.standoff_time + ways[-1][1].duration + 2 * _SAMPLE_PERIOD
    samples = round((options.horizon + longest) / _SAMPLE_PERIOD)
    grapple = target.grapple(_SAMPLE_PERIOD * np.arange(samples))
    in_the_way = False
    for start in [0.0] if moving else starts.tolist():
        first = round(start / _SAMPLE_PERIOD)
        begin = RelativeMotionOverTime.between(grapple.rows(slice(first, first + 1)), at_rest)
        for duration, (way, (standoff, closing)) in product(_PATH_DURATIONS, enumerate(ways)):
            if not way:
                in_the_way = False
            elif not in_the_way:
                continue
            relative = RelativePath(begin, standoff, duration)
            outward: RelativePath | PathInWorld = relative
            if way:
                outward = PathInWorld(relative, target, start, at_rest, standoff)
            plan = ApproachPlan(start, outward, closing, options.standoff_time)
            last = first + math.ceil((plan.contact - start) / _SAMPLE_PERIOD) + 1
            times, rows = _SAMPLE_PERIOD * np.arange(first, last), slice(first, last)
            motion = plan.hand(grapple.rows(rows), times)
            share = _largest_limit_share(motion, limits, reach.axes)
            if share[0] > 1.0:
                sentence = (
                    "The target moves too fast to be reached: the end-effector's reference would "
                    f"need {share[1]}."
                )
                refused = max(refused, (0, -share[0], sentence))
                continue
            distance = reach.distance_to(motion, -1)
            if distance > REACHED_DISTANCE:
                sentence = (
                    f"The target is out of reach {within}: at best, with contact at "
                    f"{plan.contact:.4g} s, the end-effector stays {distance:.3g} m or rad away "
                    "from its grapple frame while the base holds its place."
                )
                refused = max(refused, (1, -distance, sentence))
                if way:
                    continue
                break  # A longer path meets the target later, as do other start times.
            near: NearestLinks | None = None
            # A few samples suffice to reject most blocked paths.
            for every in (_COARSE_STRIDE, 1):
                shapes, why = reach.shapes_along(
                    motion.rows(slice(None, None, every)), every * _SAMPLE_PERIOD
                )
                if clearance is None or why:
                    continue
                ticks = np.r_[0:first:every, first:last:every]
                waiting = np.tile(reach.q, (len(ticks) - len(shapes), 1))
                shapes = np.concatenate([waiting, shapes])
                # When planning in motion, the hand may already be next to the target.
                closes = 0 if moving else int(np.sum(ticks * _SAMPLE_PERIOD < plan.closing_time))
                near = clearance.nearest(reach.base, shapes, grapple.rows(ticks), closes)
                if near is not None and near.distance < clearance.min_distance:
                    break
            met = f"The target cannot be met {within}: with contact at {plan.contact:.4g} s, "
            if clearance and near and near.distance < clearance.min_distance:
                in_the_way, blocked = True, blocked + 1
                sentence = f"{met}{near.describe(clearance.min_distance)}."
                refused = max(refused, (3, near.distance, sentence))
            elif why:
                refused = max(refused, (2, plan.contact, f"{met}{why}."))
            else:
                return plan if near is None else replace(plan, distance=near.distance)
            if blocked == _MAX_BLOCKED_PATHS:
                raise PlanningError(refused[2])
    raise PlanningError(refused[2])


def _largest_limit_share(
    motion: FrameMotion, limits: MotionLimits, axes: tuple[str, ...]
) -> tuple[float, str]:
    """Return the largest fraction of a limit used by a motion, and a clause about it."""
    linear = any(not axis.startswith("r") for axis in axes)
    angular = any(axis.startswith("r") for axis in axes)
    shares = [(0.0, "")]
    for values, name, unit, counts in (
        (motion.v, "speed", "m/s", linear),
        (motion.a, "acceleration", "m/s^2", linear),
        (motion.omega, "angular_speed", "rad/s", angular),
        (motion.alpha, "angular_acceleration", "rad/s^2", angular),
    ):
        largest, limit = float(np.linalg.norm(values, axis=1).max()), getattr(limits, name)
        if counts:
            shares.append(
                (largest / limit, f"{largest:.4g} {unit}, and 'motion.{name}' is {limit:.3g}")
            )
    return max(shares)


# -- distances from the target's body -------------------------------------------------------------


@dataclass(frozen=True)
class NearestLinks:
    """Smallest distance during a motion, m, with the robot link and the target link."""

    distance: float
    links: LinkPair

    def describe(self, least: float) -> str:
        """Return a clause about a distance below the permitted one, m."""
        first, second = self.links
        if self.distance <= 0.0:
            return f"link '{first}' would touch '{second}' of the target"
        return (
            f"link '{first}' would come within {self.distance:.3g} m of '{second}' of the target, "
            f"and 'target.clearance' is {least:g} m"
        )


class TargetClearance:
    """Distances between robot links and target links.

    Relative to the target frame, the target body is a fixed obstacle. The collision checks
    therefore use the target as the robot's world, and the base pose relative to the target.

    ``link`` is the end-effector link, whose rigid body may touch the target while closing in;
    ``grapple`` is the pose of the grapple frame in the frame T of the target, and ``least`` the
    smallest permitted distance, m.
    """

    def __init__(
        self,
        robot: RobotDescription,
        link: str,
        target: RobotDescription,
        grapple: Pose,
        least: float,
    ) -> None:
        self.min_distance = least
        self._grapple = grapple
        self._geometry = CollisionGeometry(replace(robot, world=target), obstacles_alone=True)
        hand = robot.frames[link][0]
        bodies = np.array([self._geometry.solids[i].body for i, _ in self._geometry.pairs])
        self._is_pair_of_end_effector = bodies == hand

    def nearest(
        self, base: Pose, shapes: Array, grapple: FrameMotion, closes: int
    ) -> NearestLinks | None:
        """Return the smallest distance in a motion; None: nothing can touch.

        Parameters
        ----------
        base
            Pose of the fixed base in W.
        shapes
            (K, n) joint positions, m or rad.
        grapple
            Motion of the grapple frame at the same times.
        closes
            First sample of closing in.
        """
        geometry = self._geometry
        if not len(geometry.pairs):
            return None
        R_TW = self._grapple.R @ np.swapaxes(grapple.R, 1, 2)
        r_TB = np.einsum("kij,kj->ki", R_TW, base.r - grapple.r) + self._grapple.r
        turns = np.array([quaternion_from_matrix(R) for R in R_TW @ base.R])
        poses = geometry.poses(shapes, BasePoses(r_TB, turns))
        bounds = geometry.lower_bounds(poses)
        bounds[closes:, self._is_pair_of_end_effector] = np.inf
        found: NearestLinks | None = None
        for pair in np.argsort(bounds.min(axis=0), kind="stable").tolist():
            at = np.flatnonzero(bounds[:, pair] < (np.inf if found is None else found.distance))
            if len(at):
                distance = float(geometry.distances(pair, (poses[0][at], poses[1][at])).min())
                if found is None or distance < found.distance:
                    found = NearestLinks(distance, geometry.links_of(pair))
        return found
