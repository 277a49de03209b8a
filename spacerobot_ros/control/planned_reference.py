"""References from thrust-limited plans."""

from __future__ import annotations

import math
from bisect import bisect_right
from dataclasses import replace
from functools import lru_cache
from typing import ClassVar, NamedTuple, TypedDict

import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.limits import ActuatorLimits
from spacerobot_ros.control.outputs import OutputSelection
from spacerobot_ros.control.reference import PLANNED_PROFILE, ReferenceProfile
from spacerobot_ros.control.state import (
    Actuation,
    ControlState,
    JointReference,
    PoseReference,
    Reference,
)
from spacerobot_ros.errors import ParameterError, PlanningError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.grasp import RobotMotion
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.target_motion import FrameMotion, RelativeMotionOverTime
from spacerobot_ros.planning.core.cancellation import Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.schedule import BasePath
from spacerobot_ros.planning.methods.thrust.problem import (
    Grapple,
    Samples,
    ThrustGoal,
    ThrustMotion,
)
from spacerobot_ros.planning.methods.thrust.search import ThrustPlanner

PLANNING_TIME = 2.0
"""Time after which a plan takes over from a moving reference, s; doubled if planning takes
longer."""


class PlannedReference(ReferenceProfile):
    """A motion of the base and the joints, planned within the available thrust and around
    obstacles.

    Parameters
    ----------
    start, goal, carries
        See :class:`.ReferenceProfile`.
    *legs
        The plan: motions one after the other, all but the last to a waypoint.
    """

    name: ClassVar[str] = PLANNED_PROFILE

    def __init__(
        self, start: Reference, goal: Reference, *legs: ThrustMotion, carries: bool = False
    ) -> None:
        super().__init__(start, goal, carries=carries)
        self._legs = legs
        *self._begins, self.duration = np.cumsum([0.0, *(leg.duration for leg in legs)]).tolist()
        # The latest reference is read twice per state.
        self._latest = lru_cache(maxsize=1)(self._sampled)

    def _leg_at(self, time: float) -> tuple[ThrustMotion, float]:
        """Return the leg at a time since the start, s, and the time since its beginning."""
        k = self.waypoints_passed(time)
        return self._legs[k], time - self._begins[k]

    def waypoints_passed(self, time: float) -> int:
        """Return the number of waypoints reached ``time`` s after the start."""
        return bisect_right(self._begins[1:], time)

    def configurations(self) -> Samples:
        """Return samples of the plan."""
        paths = [leg.path() for leg in self._legs]
        times = [begin + path.times for begin, path in zip(self._begins, paths, strict=True)]
        base = zip(*(path.base for path in paths), strict=True)
        shapes = np.vstack([path.shapes for path in paths])
        return Samples(shapes, BasePoses(*map(np.vstack, base)), np.concatenate(times))

    @property
    def path(self) -> BasePath:
        """Planned base pose as a function of the time since the start."""
        _, base, times = self.configurations()
        return BasePath(times, *base)

    @property
    def uses_table(self) -> bool:
        """Whether the motion is planned for a thruster table."""
        return self._legs[0].propulsion.is_table

    @property
    def propellant(self) -> float | None:
        """Propellant required by the plan, kg; None if there is no thruster table."""
        return sum(leg.spent for leg in self._legs) if self.uses_table else None

    def at(self, time: float) -> Reference:
        """Return the reference at ``time`` s after the start."""
        return self.goal if time >= self.duration else self._latest(time)

    def _sampled(self, time: float) -> Reference:
        leg, since = self._leg_at(time)
        sample = leg.at(since)
        base, hand = PoseReference(*sample.base), PoseReference(*sample.end_effector)
        return Reference(
            base,
            None if self.goal.end_effector is None else hand,
            JointReference(sample.q, sample.qdot, sample.qddot),
            of_one_motion=True,
        )

    def actuation(self, time: float, period: float, joint_damping: float = 0.0) -> Actuation:
        """Return the mean wrench and efforts of the plan over a control period that begins ``time``
        s after the start of the plan; zero outside the plan.

        Sampled values would not suffice: efforts jump between intervals, so joints would reach
        different rates.

        Parameters
        ----------
        time, period
            Time since the start, and the time for which the command is held, s.
        joint_damping
            Joint friction added by the law and compensated for in the efforts, N m s/rad.
        """
        ends = min(time + period, self.duration)
        leg, since = self._leg_at(time)
        knot = time - since + leg.step * (math.floor(since / leg.step) + 1)
        wrench, tau = np.zeros(6), np.zeros(leg.joints)
        for begin, end in ((time, min(knot, ends)), (knot, ends)):
            if 0.0 <= begin < end:
                leg, since = self._leg_at((begin + end) / 2)
                sample, share = leg.at(since), (end - begin) / period
                wrench += share * sample.wrench_B
                tau += share * (sample.tau + joint_damping * sample.qdot)
        return Actuation(wrench, tau)


class GrappleReference(PlannedReference):
    """A planned motion to a target, followed by motion with the target.

    Parameters
    ----------
    start, motion
        See :class:`PlannedReference`.
    grapple
        The target; its motion starts at the same time as the plan.
    """

    name: ClassVar[str] = "grapple"

    def __init__(self, start: Reference, motion: ThrustMotion, grapple: Grapple) -> None:
        end = motion.at(motion.duration)
        joints = None if start.joints is None else JointReference.at_rest(end.q)
        base, hand = PoseReference(*end.base), PoseReference(*end.end_effector)
        super().__init__(start, Reference(base, hand, joints), motion)
        self.motion, self.grapple = motion, grapple
        frame = grapple.motion.grapple([motion.duration])
        beside, still = RelativeMotionOverTime.between(frame, base.motion), np.zeros((1, 6))
        self._base = RelativeMotionOverTime(beside.values, still, still)

    def hand(self, grapple: FrameMotion, times: Array) -> FrameMotion:
        """Return the motion of the end-effector at one time (1,) beside a measured grapple frame,
        as planned beside the predicted one."""
        hand = self.at(float(times[0])).end_effector
        assert hand is not None
        return grapple.with_motion_beside(self.grapple.motion.grapple(times), hand.motion)

    def at(self, time: float) -> Reference:
        """Return the reference at ``time`` s after the start."""
        if time < self.duration:
            return super().at(time)
        frame = self.grapple.motion.grapple([time])
        base = PoseReference.of_motion(frame.with_relative_motion(self._base))
        return Reference(base, PoseReference.of_motion(frame), self.goal.joints)


class Aims(TypedDict, total=False):
    """Poses and joint positions (n,) requested by goals; None: not requested. The base rests at
    each of the ``waypoints``, poses (7,), before its goal.
    """

    base: PoseReference | None
    waypoints: tuple[Array, ...]
    end_effector: PoseReference | None
    joints: Array | None


class GoalMotion(NamedTuple):
    """Start and goal of a motion; ``carries``: whether the arm keeps its shape; ``waypoints``: base
    poses (7,) on the way.
    """

    start: Reference
    goal: Reference
    carries: bool
    waypoints: tuple[Array, ...] = ()


class ReferencePlanner(ThrustPlanner):
    """Plans references for one controller, whose law controls the robot and the outputs.

    The robot has no wheels, as plans do not use wheel torque.

    Raises
    ------
    ParameterError
        The base pose is not controlled; or see :class:`.ThrustPlanner`.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        outputs: OutputSelection,
        limits: ActuatorLimits,
        config: ControllerConfig,
    ) -> None:
        if not outputs.base:
            raise ParameterError(
                "The profile 'planned' requires a controlled base pose: set base_outputs, or set "
                "profile to quintic."
            )
        link, force, torque = outputs.end_effector_link, limits.force, limits.torque
        super().__init__(robot, config.plan, link, force, torque)
        self._outputs, self.in_background = outputs, config.plan_in_background
        self._time_limit = config.time_limit

    def time_until_blocked(self, profile: PlannedReference, time: float) -> float:
        """Return the time, s, for which a reference stays clear of obstacles, from a given time
        after the start; infinite: until the end of the reference.
        """
        clearance, (shapes, base, times) = self.clearance, profile.configurations()
        if clearance is None or not clearance.has_obstacles:
            return math.inf
        geometry = clearance.geometry
        required = np.where(geometry.with_obstacles, clearance.distance, -np.inf)
        beyond, _ = geometry.nearest_along(shapes, base, required)
        return float(times[(beyond < 0) & (times >= time)].min(initial=math.inf)) - time

    def plan_motion(
        self, motion: GoalMotion, state: ControlState, cancellation: Cancellation
    ) -> PlannedReference:
        """Return the planned reference for a motion; ``state`` provides the positions of joints
        without a reference.

        Raises
        ------
        PlanningError
            No motion is found.
        """
        start, goal, carries, waypoints = motion
        assert goal.base is not None
        begin = self._begin(start, state)
        q, hand, shape = begin.q, None, None
        if self._outputs.joints and goal.joints is not None:
            shape = goal.joints.q
        elif carries or not self._outputs.end_effector:
            shape = q
        elif goal.end_effector is not None:
            hand = goal.end_effector.values
        ends = [ThrustGoal(pose, None, q, keeps_shape=carries) for pose in waypoints]
        ends.append(ThrustGoal(goal.base.values, hand, shape, keeps_shape=carries))
        if carries:
            begin = replace(begin, qdot=np.zeros(len(q)))
        legs = []
        for end in ends:
            try:
                legs.append(self.plan(begin, end, cancellation))
            except PlanningError as error:
                if not waypoints or isinstance(error, PlanningCancelled):
                    raise
                name = f"waypoint {len(legs) + 1}" if end is not ends[-1] else "the last pose"
                raise PlanningError(f"On the way to {name}: {error}") from error
            begin = RobotMotion.at_rest(end.base, q)
        planned = PlannedReference(start, goal, *legs, carries=carries)
        if 0.0 < self._time_limit <= planned.duration:
            raise PlanningError(
                f"The motion takes {planned.duration:.4g} s, but time_limit is "
                f"{self._time_limit:.4g} s: increase it, or reduce plan.duration or "
                "plan.time_factor."
            )
        return planned

    def plan_grapple(
        self, start: Reference, state: ControlState, grapple: Grapple, cancellation: Cancellation
    ) -> GrappleReference:
        """Return the planned reference to a target; the given target motion starts with the plan.

        Raises
        ------
        PlanningError
            No motion is found.
        """
        motion = self.plan(self._begin(start, state), grapple, cancellation)
        return GrappleReference(start, motion, grapple)

    def _begin(self, start: Reference, state: ControlState) -> RobotMotion:
        """Return where a plan from a reference begins."""
        base, joints = start.base, start.joints if self._outputs.joints else None
        assert base is not None
        R_BW = matrix_from_quaternion(base.quaternion).T
        twist = np.concatenate([R_BW @ base.velocity, R_BW @ base.angular_velocity])
        q, qdot = (state.q, state.qdot) if joints is None else (joints.q, joints.qdot)
        return RobotMotion(base.values, twist, q.copy(), qdot * bool(twist.any()))
