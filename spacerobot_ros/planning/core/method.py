"""Interface of gait methods: from a request to a schedule or an error."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.errors import GoalError, PlanningError, Proof, UnreachableError, counted
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import (
    POSE,
    Controlled,
    Goal,
    PoseError,
    RobotState,
    Tolerance,
    end_effector_pose,
)
from spacerobot_ros.planning.core.prediction import BasePrediction
from spacerobot_ros.planning.core.schedule import (
    BasePath,
    GaitSchedule,
    HeldMotion,
    JointEfforts,
    Notes,
    given_effort_limits,
)

_REST_MOMENTUM = 1e-9  # per mass: m/s and m^2/s

END_EFFECTOR_METHOD = "optimal"
"""Name of the method that plans for end-effector goals."""

PATH_METHOD = "resolved_rate"
"""Name of the method that moves end-effectors along given paths."""

_LIMIT_SLACK = 1e-9  # m or rad


@dataclass(frozen=True)
class InitialMotion:
    """Joint motion at the start of a gait.

    Attributes
    ----------
    velocity
        (n,) joint velocities held until the gait begins, m/s or rad/s.
    remaining
        (M + 1, n) shapes at the remaining ticks of the current plan; the gait begins at the first.
    """

    velocity: Array
    remaining: Array

    def mean_velocity(self, period: float) -> Array:
        """Return the mean of the velocities (n,) held before and after the start."""
        if len(self.remaining) < 2:
            return self.velocity
        return (self.velocity + (self.remaining[1] - self.remaining[0]) / period) / 2


@dataclass(frozen=True)
class PlanRequest:
    """Arguments of a plan request, in addition to the robot and the method options.

    Attributes
    ----------
    state
        The state from which the gait begins.
    goal
        The goal at which the gait ends.
    tolerance
        Largest errors at the goal.
    correction
        Whether an earlier schedule for the same goal has just ended. If so, the remaining error is
        small, and options that fix the size of the first manoeuvre do not apply.
    previous
        The last executed schedule for the same goal; None for the first. ``auto`` continues with
        this method, and methods that plan step by step continue from its ``progress``.
    motion
        Joint motion at the start, only for methods that declare ``starts_in_motion``; None: rest.
    """

    state: RobotState
    goal: Goal
    tolerance: Tolerance
    correction: bool = False
    previous: GaitSchedule | None = None
    motion: InitialMotion | None = None


@dataclass(frozen=True)
class EmptyOptions:
    """Options class for a method without options."""


BEYOND_EFFORT_LIMITS = "beyond_effort_limits"
"""Name of the note about joints that exceed their effort limits."""

NO_JOINTS = (
    "Robot '{}' has no joints that could move its base. If it has thrusters, use "
    "coordinated_control; `profile: planned` plans the motion."
)
"""Message that rejects a robot, to be formatted with the robot name."""


class GaitMethod(ABC):
    """An algorithm that turns a goal pose into a gait.

    A method is built once per robot for many plans, between which it keeps compiled functions.

    Parameters
    ----------
    robot
        The model.
    control_period
        Command duration, s.
    integration_step
        Longest Runge-Kutta step for the attitude, s; the plant's value gives the same results.
    options
        An instance of the method's ``Options``; None: the defaults.
    clearance
        Smallest distance between links in schedules; None: any.

    Attributes
    ----------
    name
        Registry name, and name of the parameter group ``<name>.<option>``.
    controls
        Components of a goal with position and attitude that the method's schedules control. A
        method that selects among other methods sets these components only in its schedules.
    plans_for_base, plans_for_end_effectors
        Whether the method plans for base goals, and for end-effector goals.
    follows_paths
        Whether it moves end-effectors along given paths.
    repeats_cycles
        Whether its gaits repeat a shape cycle, which reports then show.
    starts_in_motion
        Whether its gaits may begin with moving joints (``PlanRequest.motion``).
    Options
        A frozen dataclass with fields declared by :mod:`spacerobot_ros.parameters`.

    Raises
    ------
    ParameterError
        An option is incompatible with the robot or with another option.
    """

    name: ClassVar[str]
    controls: frozenset[Controlled] = POSE
    plans_for_base: ClassVar[bool] = True
    plans_for_end_effectors: ClassVar[bool] = False
    follows_paths: ClassVar[bool] = False
    repeats_cycles: ClassVar[bool] = False
    starts_in_motion: ClassVar[bool] = False
    Options: ClassVar[type[Any]] = EmptyOptions
    options: Any

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        options: Any = None,
        clearance: Clearance | None = None,
    ) -> None:
        self.robot = robot
        self.clearance = clearance
        self.control_period = control_period
        self.integration_step = integration_step
        self.options = self.Options() if options is None else options
        self._setup_refusal: PlanningError | None = None
        try:
            self.setup()
        except PlanningError as refusal:
            # A planner exists before its first goal, whose request rejects an unsuitable robot.
            self._setup_refusal = refusal

    def setup(self) -> None:  # noqa: B027 - methods that delegate have nothing to set up here
        """Compute all attributes that depend only on the robot and the options; called once.

        A `PlanningError` rejects the robot: :meth:`require_rest` raises it for every goal.
        """

    @cached_property
    def _prediction(self) -> BasePrediction:
        return BasePrediction(self.robot, self.control_period, self.integration_step)

    @cached_property
    def _joint_efforts(self) -> JointEfforts | None:
        """The efforts of held commands; None if the URDF does not limit efforts."""
        limit = given_effort_limits(self.robot)
        return None if limit is None else JointEfforts(self.robot, limit)

    @classmethod  # noqa: B027 - any robot is suitable by default
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Reject a robot for which the method cannot plan any goal, regardless of options.

        Raises
        ------
        PlanningError
            The method cannot plan for the robot; the message says why.
        """

    def controls_for(self, goal: Goal) -> frozenset[Controlled]:
        """Return the components of a goal that the method's schedules control."""
        return self.controls

    @abstractmethod
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Return a gait that ends at rest, for a request; identical requests yield identical gaits.

        Raises
        ------
        PlanningError
            The method cannot reach the goal; the message says why.
        PlanningCancelled
            Cancellation was requested during planning.
        """

    def schedule_of(
        self,
        goal: Goal,
        positions: Array,
        path: BasePath,
        notes: Notes,
        *,
        partial: bool = False,
        remaining: float = 0.0,
        progress: object = None,
        is_clear: bool = False,
        motion: HeldMotion | None = None,
        end_velocities: Array | None = None,
    ) -> GaitSchedule:
        """Return shapes (N + 1, n) at the ticks as a schedule of this method.

        A note reports efforts beyond the URDF limits in the ``motion``; None: from rest to rest at
        zero momentum. ``end_velocities`` (n,) are held after it.

        Raises
        ------
        PlanningError
            Links come too close to each other or to obstacles; not checked again if ``is_clear``.
        """
        if not self.plans_for_end_effectors:
            self.require_goal_of_base(goal)
        if not self.follows_paths:
            self._require_no_path(goal)
        if not is_clear:
            start = RobotState(path.position[0], path.quaternion[0], positions[0])
            self._require_clear(positions, self._base_poses(start, positions))
        if self._joint_efforts is not None:
            motion = motion or HeldMotion(positions, self.control_period)
            beyond = self._joint_efforts.beyond_limits(motion)
            notes = {**notes, BEYOND_EFFORT_LIMITS: beyond} if beyond else notes
        return GaitSchedule(
            method=self.name,
            joint_names=self.robot.joint_names,
            control_period=self.control_period,
            positions=positions,
            path=path,
            goal=goal,
            notes=notes,
            partial=partial,
            remaining=remaining,
            controls=self.controls,
            progress=progress,
            end_velocities=end_velocities,
        )

    def _end_notes(
        self,
        goal: Goal,
        q: Array,
        position: Array,
        quaternion: Array,
        controls: frozenset[Controlled],
    ) -> Notes:
        """Return notes on the end of a gait: the shape (n,), the poses of the base (3,), (4,) and
        of links named in the goal, and the errors of the controlled parts.
        """
        left = PoseError.between(position, quaternion, goal, q, self.robot)
        notes: Notes = {"final_shape": q.tolist(), "final_position": position.tolist()}
        if not goal.end_effectors or "attitude" in controls:
            notes["predicted_attitude_error"] = left.angle
        if not goal.end_effectors or "position" in controls:
            notes["predicted_position_error"] = left.distance
        for each in goal.end_effectors:
            r_WE, turned = end_effector_pose(self.robot, each.link, position, quaternion, q)
            notes[f"final_pose_of_{each.link}"] = [*r_WE.tolist(), *turned.tolist()]
        if goal.end_effectors:
            notes["predicted_end_effector_position_error"] = left.largest_end_effector_distance
            notes["predicted_end_effector_attitude_error"] = left.largest_end_effector_angle
        return notes

    def goal_shape(self, goal: Goal) -> Array | None:
        """Return the goal shape (n,) within the joint limits; None for a goal without a shape.

        Raises
        ------
        GoalError
            The shape belongs to another robot.
        UnreachableError
            The shape is outside the joint limits.
        """
        wanted, robot = goal.joint_positions, self.robot
        if wanted is None:
            return None
        if len(wanted) != robot.n:
            raise GoalError(
                f"The goal shape has {counted(len(wanted), 'joint position')}, but robot "
                f"'{robot.description.name}' has {counted(robot.n, 'joint')}."
            )
        beyond = np.maximum(robot.lower - wanted, wanted - robot.upper)
        worst = int(np.argmax(beyond))
        if beyond[worst] > _LIMIT_SLACK:
            joint = robot.description.movable_joints[worst]
            raise UnreachableError(
                f"The goal shape violates joint limits: joint '{joint.name}' at "
                f"{wanted[worst]:.4g} {joint.unit}, but its limits are [{robot.lower[worst]:.4g}, "
                f"{robot.upper[worst]:.4g}] {joint.unit}.",
                Proof.LIMITS,
            )
        return np.clip(wanted, robot.lower, robot.upper)

    def _clear_goal_shape(self, request: PlanRequest) -> Array | None:
        """Return the goal shape (n,) as :meth:`goal_shape`, and reject one in collision."""
        shape = self.goal_shape(request.goal)
        if shape is not None and self.clearance is not None:
            # The base pose among obstacles depends on the motion.
            self.clearance.require_shape(shape, self.clearance.required(request.state.q))
        return shape

    def require_goal_of_base(self, goal: Goal) -> None:
        """Raise PlanningError for end-effector goals or path goals."""
        self._require_no_path(goal)
        if goal.end_effectors:
            names = " and ".join(f"'{each.link}'" for each in goal.end_effectors)
            raise PlanningError(
                f"{self.name} plans for the base pose, but the goal is for {names}: "
                f"{END_EFFECTOR_METHOD} plans for end-effectors."
            )

    def _require_no_path(self, goal: Goal) -> None:
        if goal.waypoints is not None:
            raise PlanningError(
                f"{self.name} moves the base by the joints alone and does not stop at waypoints: "
                "coordinated control does, with the profile 'planned'."
            )
        for each in goal.end_effectors:
            if each.waypoints is not None:
                raise PlanningError(
                    f"{self.name} does not follow paths, but '{each.link}' must follow one: "
                    f"{PATH_METHOD} does."
                )

    @property
    def _has_obstacles(self) -> bool:
        return self.clearance is not None and self.clearance.has_obstacles

    def _base_poses(
        self, start: RobotState, positions: Array, attitudes: Array | None = None
    ) -> BasePoses | None:
        """Return the base poses for shapes (N + 1, n) at ticks; None without obstacles."""
        if not self._has_obstacles:
            return None
        return self._prediction.poses(start, positions, attitudes)

    def _require_clear(self, positions: Array, base: BasePoses | None = None) -> None:
        """Reject shapes (K, n) on the path that are too close; see :meth:`_too_near`."""
        if clause := self._too_near(positions, base):
            raise PlanningError(f"On the way {clause}.")

    def _too_near(
        self, positions: Array, base: BasePoses | None = None, *, at_ticks: bool = True
    ) -> str:
        """Return a clause that states where, on straight lines between shapes (K, n), links come
        too close to each other or, at the ``base`` poses, to obstacles; empty: nowhere.
        """
        if self.clearance is None:
            return ""
        found = self.clearance.approaches(positions, base=base)
        period = self.control_period if at_ticks else None
        return self.clearance.clause(found[0], period) if found else ""

    def _require_suitable_setup(self) -> None:
        if self._setup_refusal is not None:
            raise PlanningError(str(self._setup_refusal))

    def require_rest(self, state: RobotState) -> None:
        """Reject unsuitable robots, and robots with nonzero total momentum."""
        self._require_suitable_setup()
        p, L = np.linalg.norm(state.linear_momentum), np.linalg.norm(state.angular_momentum)
        if max(p, L) > _REST_MOMENTUM * self.robot.total_mass:
            raise PlanningError(
                "The robot drifts: its total momentum is not zero "
                f"({p:.3g} kg m/s, {L:.3g} kg m^2/s), but {self.name} plans for zero momentum, "
                "which joint motions cannot establish; use optimal for drifting robots."
            )
        wheels = ReactionWheels.of(self.robot.description)
        if state.qdot is not None and wheels.are_spinning(state.qdot):
            raise PlanningError(
                f"Reaction wheels spin, but {self.name} begins with all joints at rest; use "
                f"optimal if wheels spin at the start."
            )

    def significant(self, momentum: Array) -> Array:
        """Return a total momentum (3,), kg m/s or kg m^2/s; zero if it is negligible."""
        if np.linalg.norm(momentum) > _REST_MOMENTUM * self.robot.total_mass:
            return momentum
        return np.zeros(3)
