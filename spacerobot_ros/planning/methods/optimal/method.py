"""Time-optimal manoeuvres within physical limits for any free-floating robot.

The manoeuvre is the solution of an optimal control problem (:mod:`.multiple_shooting`) that starts
from guesses with loops (:mod:`.initial_guesses`). It is converted to held commands that end at the
goal (:mod:`.held_commands`).
"""

from __future__ import annotations

import hashlib
import json
import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple

import casadi as ca
import numpy as np
from typing_extensions import override

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.errors import NotFoundError, PlanningError, UnreachableError, counted
from spacerobot_ros.files import Cache
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.compilation import cache_directory
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    matrices_from_quaternions,
    matrix_from_quaternion,
    quaternion_inverse,
    quaternion_multiply,
)
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.parameters import values_of
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation
from spacerobot_ros.planning.core.controllability import sliders_of
from spacerobot_ros.planning.core.goal import Controlled, Goal, PoseError, Tolerance
from spacerobot_ros.planning.core.method import GaitMethod, InitialMotion, PlanRequest
from spacerobot_ros.planning.core.progress import SearchClock
from spacerobot_ros.planning.core.schedule import GaitSchedule, HeldMotion, Notes
from spacerobot_ros.planning.methods.optimal.end_effectors import EndEffectorSpecification
from spacerobot_ros.planning.methods.optimal.goal_specification import GoalSpecification
from spacerobot_ros.planning.methods.optimal.held_commands import LimitedEfforts, ManoeuvreModel
from spacerobot_ros.planning.methods.optimal.motion_bounds import (
    ConnectionBounds,
    DurationBound,
    link_demands,
)
from spacerobot_ros.planning.methods.optimal.problem import (
    BoundaryConditions,
    MotionLimits,
    OptimalOptions,
    PathConstraints,
    UnusableCandidateError,
    per_joint,
)
from spacerobot_ros.planning.methods.optimal.search import (
    Manoeuvre,
    ManoeuvreSearch,
    NoClearPathError,
    SearchProblem,
)
from spacerobot_ros.resources import __version__

_MAX_STARTS_IN_MOTION = 12
"""Largest number of guesses for a manoeuvre that starts with moving joints, which keep moving
during planning."""

_ZERO_ERROR = 1e-10
"""Largest error considered zero, so that the robot is at the goal: rad, m and joint coordinates."""

_ACTIVE_LIMIT_SHARE = 0.95

_MAX_MOVING_AIMS = 4
"""Largest number of successive fastest manoeuvres if the centre of mass drifts: each ends at the
goal location, relative to the centre of mass, at the end of the previous one."""

_MOVING_AIM_FACTORS = (1.05, 1.2, 1.5)
"""Multiples of the last duration for which manoeuvres are planned if the durations do not agree."""

_STARTS_BEFORE_COASTING = 8
"""Number of guesses without a solution after which a drifting robot coasts with its joints at rest,
and number of guesses for the rotation that remains when its base passes the goal."""

_STARTS_AFTER_COASTING = 3
"""Number of guesses without a solution after which the next pass of the goal is tried."""

_MAX_ANGLE_WITHOUT_COASTING = math.radians(40.0)
"""Largest angle by which the drifting base may rotate during a manoeuvre that begins
immediately."""

_COASTING_ANGLE = math.radians(5.0)
"""Angle between the attitudes at which passes of the goal are checked."""

_COASTING_TURNS = 4.0

_MAX_COASTING_ENDS = 3
"""Largest number of instants tried at which the coasting base passes the goal."""

_MAX_DURATION_RATIO = 2.5
"""Longest duration of a manoeuvre that ends at a pass, as a multiple of the duration at zero
momentum."""

_STARTS_BEFORE_FASTEST = 8
"""Number of guesses without a manoeuvre in the requested time after which the fastest manoeuvre is
searched for."""

_MIN_HALVED_ANGLE = math.radians(20.0)
"""Smallest rotation that is planned in two halves if no single manoeuvre is found."""

_LIMIT_ROUNDING = 1e-8


@dataclass(frozen=True)
class _GoalKind:
    """Goals with the same parts: these parts, and the searches for their manoeuvres.

    Most manoeuvres of most robots satisfy the effort limits without ``within_efforts``.
    """

    specification: GoalSpecification | EndEffectorSpecification
    search: ManoeuvreSearch
    within_efforts: ManoeuvreSearch


class _Plan(NamedTuple):
    """Shapes (N + 1, n) at the ticks, notes on the search, and the final velocities (n,)."""

    positions: Array
    notes: Notes
    final_velocity: Array | float = 0.0


class OptimalGait(GaitMethod):
    """Plans manoeuvres of minimum time, or of least effort in a given time, from rest to rest.

    A manoeuvre reaches the attitude; the position, if sliders can move the base to any position,
    the goal requests nothing else, or the options request it; and the final shape, if the goal has
    one. For end-effector goals, it reaches these goals and the requested components of the base
    pose. The search has a budget of starts and solver steps, so identical requests yield identical
    schedules on any machine, idle or busy, unless the user also limits its wall time.
    """

    name: ClassVar[str] = "optimal"
    plans_for_end_effectors: ClassVar[bool] = True
    starts_in_motion: ClassVar[bool] = True
    Options: ClassVar[type[OptimalOptions]] = OptimalOptions
    options: OptimalOptions

    @override
    def setup(self) -> None:
        """Compute what depends only on the robot and the options; see :meth:`GaitMethod.setup`."""
        # A plan calls the model's functions a few times each.
        self.robot = robot = self.robot.interpreted
        chosen = self.options
        self._specification = GoalSpecification.of(robot, chosen)
        self.controls = self._specification.controls
        self._limits = MotionLimits.of(robot, chosen)
        self._margin = per_joint(robot, "joint_margin", chosen.joint_margin, np.zeros(robot.n))
        self._constraints = PathConstraints.of(robot, chosen)
        self._efforts = LimitedEfforts.of(robot, chosen)
        self._wheels = ReactionWheels.of(robot.description)
        self._model = ManoeuvreModel(
            robot,
            self._prediction,
            self.control_period,
            self._specification.axes,
            self._constraints,
            self._efforts,
            clearance=self.clearance,
        )
        self._kinds: dict[tuple[object, ...], _GoalKind] = {}
        self._cache = Cache(cache_directory() / "plans") if chosen.cache else None

    @override
    def controls_for(self, goal: Goal) -> frozenset[Controlled]:
        """Return the controlled components of a goal; see :meth:`GaitMethod.controls_for`."""
        return self._kind_of(goal).specification.controls

    def _kind_of(self, goal: Goal) -> _GoalKind:
        base, hands = self._specification, goal.end_effectors
        if self.options.base_position == 0 and not hands and goal.asked == {"position"}:
            # Without the position, there would be nothing to reach.
            base = replace(base, position=True)
        key = EndEffectorSpecification.key(goal) if hands else (base.position,)
        if key not in self._kinds:
            specification: GoalSpecification | EndEffectorSpecification = base
            model = self._model
            if hands:
                specification = of = EndEffectorSpecification.of(base, goal)
                # A motion to a given shape has no rows at its end: the attitude follows from it.
                rows = None if of.ends_in_one_shape else of.rows
                model = replace(model, axes=of.axes, end_effectors=rows)
            free, limited = ManoeuvreSearch(replace(model, efforts=None)), ManoeuvreSearch(model)
            self._kinds[key] = _GoalKind(specification, free, limited)
        return self._kinds[key]

    @classmethod
    @override
    def require_suitable(cls, robot: SpaceRobot) -> None:
        """Reject robots that cannot rotate their base; see :meth:`GaitMethod.require_suitable`."""
        GoalSpecification.of(robot, OptimalOptions()).require_suitable()

    @override
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan within the search budget; see :meth:`GaitMethod.plan`.

        A correction uses the smallest motion instead of the fastest, and may use the margins. If
        the centre of mass drifts, planning uses a frame that moves with it; goal positions move in
        this frame. So the goal location at the end of a manoeuvre depends on the duration of the
        manoeuvre.
        """
        self._require_suitable_setup()
        # Measured shapes may be a little beyond the joint limits.
        q = np.clip(request.state.q, self.robot.lower, self.robot.upper)
        goal = request.goal.for_robot(self.robot.description)
        if goal.joint_positions is not None and len(goal.joint_positions) == self.robot.n:
            # The angle of a wheel is not part of the shape.
            shape = goal.joint_positions.copy()
            shape[self._wheels.index] = q[self._wheels.index]
            goal = replace(goal, joint_positions=shape)
        self._require_no_path(goal)
        state = replace(
            request.state,
            q=q,
            linear_momentum=self.significant(request.state.linear_momentum),
            angular_momentum=self.significant(request.state.angular_momentum),
            qdot=self._wheel_rates(request.state.qdot),
        )
        turns_on = len(self._wheels) > 0 and bool(state.angular_momentum.any())
        if turns_on and goal.end_effectors and "attitude" not in goal.base:
            # The final wheel rates depend on the attitude: if it is free, the current one is kept.
            base: frozenset[Controlled] = goal.base | {"attitude"}
            goal = replace(goal, quaternion=state.quaternion, base=base)
        request = replace(request, state=state, goal=goal)
        clock = SearchClock(self.options.time_budget)
        coasts = state.linear_momentum.any()
        of = self._plan_while_coasting if coasts else self._plan_about_center
        return self._build_schedule(request, of(request, cancellation, clock))

    def _wheel_rates(self, qdot: Array | None) -> Array:
        """Return joint velocities (n,) that are zero except for spinning wheels."""
        rates, index = np.zeros(self.robot.n), self._wheels.index
        if qdot is not None and not np.all(np.isfinite(qdot[index])):
            raise PlanningError("The wheel velocities at the start are not finite.")
        if qdot is not None and self._wheels.are_spinning(qdot):
            rates[index] = qdot[index]
        return rates

    def _require_speeds(self, velocity: Array) -> None:
        too_fast = np.abs(velocity) > self._limits.velocity * (1 + _LIMIT_ROUNDING)
        if too_fast.any():
            names = ", ".join(np.array(self.robot.joint_names)[too_fast])
            raise PlanningError(f"Joints move faster than the velocity limits of optimal: {names}.")

    def _with_wheels(
        self, boundary: BoundaryConditions, request: PlanRequest
    ) -> BoundaryConditions:
        """Return boundary conditions with the rates of reaction wheels at both ends.

        The angle of a wheel is free at the end; its rate there is such that the wheels hold all
        momentum, and the base is at rest. UnreachableError if they cannot hold it; PlanningError if
        the goal does not fix the attitude, on which the rates depend, or wheels are too fast.
        """
        wheels, n, state = self._wheels, self.robot.n, request.state
        if not len(wheels):
            return boundary
        end, near = np.zeros(n), None
        begin = self._wheel_rates(state.qdot)
        if request.motion is None:
            near = begin[wheels.index]
        elif request.previous is not None and request.previous.end_velocities is not None:
            near = request.previous.end_velocities[wheels.index]
        limit = self._limits.velocity
        self._require_speeds(begin)
        begin = np.clip(begin, -limit, limit)
        L_B = boundary.angular_momentum
        if boundary.drifts:
            axes = self._kind_of(request.goal).specification.axes
            if not len(axes):
                raise PlanningError(
                    f"The robot has an angular momentum of {np.linalg.norm(L_B):.3g} kg m^2/s; "
                    f"the wheel rates that absorb it depend on the final attitude: give the goal a "
                    "base attitude (with optimal.base_attitude 1)."
                )
            L_B = matrix_from_quaternion(boundary.goal_rotation).T @ L_B
        try:
            end[wheels.index] = wheels.rates_for(L_B, near, limit[wheels.index])
        except UnreachableError as clause:
            raise UnreachableError(
                f"The wheels cannot hold the angular momentum of {np.linalg.norm(L_B):.4g} kg "
                f"m^2/s that the robot has at the goal attitude: {clause}. Without thrust "
                "the momentum is constant: dump it with thrusters, or choose another attitude.",
                clause.proof,
            ) from None
        final = boundary.final
        if final is not None:
            final = final.copy()
            final[wheels.index] = np.nan
        return replace(boundary, velocity=begin, final_velocity=end, final=final)

    def _plan_while_coasting(
        self, request: PlanRequest, cancellation: Cancellation, clock: SearchClock
    ) -> _Plan:
        """Plan for a robot whose centre of mass coasts, in a frame that moves with it.

        PlanningError if there are obstacles, or no manoeuvre ends where the goal is at that time.
        """
        state, goal = request.state, request.goal
        velocity = state.linear_momentum / self.robot.total_mass
        if self._has_obstacles:
            raise PlanningError(
                f"The robot drifts: its centre of mass moves at {np.linalg.norm(velocity):.3g} "
                "m/s, but optimal plans around obstacles only if the centre of mass is at rest."
            )
        in_frame = replace(request, state=replace(state, linear_momentum=np.zeros(3)))
        if not goal.end_effectors and "position" not in self.controls_for(goal):
            return self._plan_about_center(in_frame, cancellation, clock)
        if goal.joint_positions is not None and not goal.end_effectors:
            raise PlanningError(
                "The robot drifts: its centre of mass moves at "
                f"{np.linalg.norm(velocity):.3g} m/s, so with the goal attitude and shape, the "
                "base is at the goal position at one instant at most. Omit the shape, or ignore "
                "the position with optimal.base_position 2."
            )

        def plan_for_end(end: float, duration: float | None) -> _Plan:
            moved = goal.displaced(-velocity * end)
            aimed = replace(in_frame, goal=moved)
            return self._plan_about_center(aimed, cancellation, clock, duration)

        if self.options.duration > 0:
            ticks = max(round(self.options.duration / self.control_period), 1)
            return plan_for_end(ticks * self.control_period, None)
        refusal, end = "", 0.0
        try:
            for _ in range(_MAX_MOVING_AIMS):
                found = plan_for_end(end, None)
                takes = (len(found.positions) - 1) * self.control_period
                if takes == end:
                    return found
                end = takes
        except PlanningError as reason:
            refusal = str(reason)
        # The fastest manoeuvre ends too early or too late: one of a given duration does not.
        for factor in _MOVING_AIM_FACTORS:
            ticks = math.ceil(max(end * factor, 1.0) / self.control_period)
            try:
                duration = ticks * self.control_period
                return plan_for_end(duration, duration)
            except PlanningError as reason:
                refusal = str(reason)
        raise NotFoundError(
            "The robot drifts, and no manoeuvre was found that ends where the goal is at that "
            f"time, relative to the centre of mass: {refusal}"
        )

    def _plan_about_center(
        self,
        request: PlanRequest,
        cancellation: Cancellation,
        clock: SearchClock,
        duration: float | None = None,
    ) -> _Plan:
        """Plan with the centre of mass at rest, in ``duration``, s, or that of the options."""
        state, goal, correction = request.state, request.goal, request.correction
        q, motion, shape = state.q, request.motion, self.goal_shape(goal)
        margin = np.zeros(self.robot.n) if correction else self._margin
        same_shape = self._specification.same_shape and not goal.end_effectors
        if motion is not None and shape is None and same_shape:
            # The current shape is on the path.
            shape = motion.remaining[-1]
        boundary = self._with_wheels(self._boundary(request, shape), request)
        # A manoeuvre ends within the margin if its goal does.
        limits = self._limits.within(margin, q, boundary.likely_final_shape)
        chosen = replace(self.options, duration=0.0, answers=1) if correction else self.options
        if duration is not None:
            chosen = replace(chosen, duration=duration)
        elif motion is not None and request.previous is not None and chosen.duration > 0:
            # The previous manoeuvre continues, and keeps its end time.
            remaining = (len(motion.remaining) - 1) * self.control_period
            chosen = replace(chosen, duration=remaining)
        task = SearchProblem(request, boundary, limits, chosen, clock, cancellation)
        if motion is not None:
            return self._plan_in_motion(task, motion)
        end = boundary.final_velocity
        error = PoseError.between(state.position, state.quaternion, goal, state.q, self.robot)
        nothing = Tolerance(_ZERO_ERROR, _ZERO_ERROR, _ZERO_ERROR)
        is_reached = nothing.admits(error, self.controls_for(goal))
        if is_reached and np.allclose(end, boundary.velocity, rtol=_ZERO_ERROR):
            return _Plan(q[np.newaxis], {"starts": 0.0}, end)
        attitude = state.quaternion[np.newaxis]
        try:
            self._constraints.check(q[np.newaxis], attitude, self.control_period)
        except UnusableCandidateError as reason:
            raise PlanningError(f"The start violates a path constraint: {reason}.") from None
        cache = None if correction or duration is not None else self._cache
        key = "" if cache is None else self._request_key(request)
        name = f"{key[:32]}.json"
        if cache is not None and (kept := cache.load(name, key)):
            positions, notes = json.loads(kept[1])
            return _Plan(np.array(positions), {**notes, "from_cache": 1.0}, end)
        try:
            found = self._plan_from_rest(task, final_is_given=shape is not None or same_shape)
            plan, is_final = self._found(task, found), self._is_within_efforts(task, found)
        except NotFoundError as refusal:
            plan, is_final = self._plan_in_parts(task, refusal), True
        # A result of a busy machine is not cached, as an idle machine finds a better one.
        if cache is not None and is_final and "cut_short" not in plan.notes:
            cache.store(name, key, json.dumps([plan.positions.tolist(), plan.notes]).encode())
        return plan

    def _plan_in_parts(self, task: SearchProblem, refusal: NotFoundError) -> _Plan:
        """Plan a rotation in two halves, with the joints at rest between them, or a small one by
        loops that end at the current shape.

        A rotation by many loops is beyond the guesses of a single search. From all guesses for a
        small one, a search may arrive at the same direct path, which ends where links are too
        close. The ``refusal`` is raised if the duration is limited, or if this fails, too.
        """
        request, options = task.request, task.options
        state, goal = request.state, request.goal
        alike = math.copysign(1.0, state.quaternion @ goal.quaternion)
        between = state.quaternion + alike * goal.quaternion
        between /= np.linalg.norm(between)
        angle = 4.0 * math.acos(min(1.0, abs(float(state.quaternion @ between))))
        limited = options.duration > 0 or options.longest < OptimalOptions().longest
        timed = request.correction or task.boundary.drifts or limited
        free = goal.end_effectors or "attitude" not in self.controls_for(goal) & goal.base
        if timed or free:
            raise refusal
        if angle < _MIN_HALVED_ANGLE:
            if not isinstance(refusal, NoClearPathError) or task.boundary.final is not None:
                raise refusal
            back = replace(request, goal=replace(goal, joint_positions=state.q))
            with suppress(PlanningError):
                return self._plan_about_center(back, task.cancellation, task.clock)
            task.cancellation.raise_if_requested()
            raise refusal
        position = (state.position + goal.position) / 2
        halfway = replace(goal, position=position, quaternion=between, joint_positions=None)
        try:
            first = self._plan_about_center(
                replace(request, goal=halfway), task.cancellation, task.clock
            )
            base = self._prediction.poses(state, first.positions)
            rates = np.broadcast_to(first.final_velocity, self.robot.n)
            r_WB, attitude = base.position[-1], base.quaternion[-1]
            q = first.positions[-1]
            arrived = replace(state, position=r_WB, quaternion=attitude, q=q, qdot=rates)
            last = self._plan_about_center(
                replace(request, state=arrived), task.cancellation, task.clock
            )
        except PlanningError:
            task.cancellation.raise_if_requested()
            raise refusal from None
        # A tick of rest joins the halves, each of which begins and ends with its own velocities.
        shapes = np.vstack([first.positions, last.positions])
        notes: Notes = {**first.notes, **last.notes}
        for name in ("starts", "solution_time"):
            given = (each.notes.get(name, 0.0) for each in (first, last))
            notes[name] = sum(each for each in given if isinstance(each, float))
        return _Plan(shapes, notes, last.final_velocity)

    def _plan_from_rest(self, task: SearchProblem, *, final_is_given: bool) -> Manoeuvre:
        """Return a manoeuvre whose joints rest at the start; see :meth:`_require_enough_time`."""
        bound = self._require_enough_time(task, final_is_given=final_is_given)
        boundary, options = task.boundary, task.options
        # The clearance of a base that coasts on among obstacles is not checked.
        coasts = boundary.drifts and not len(self._wheels)
        try:
            if coasts and options.duration == 0 and not self._has_obstacles:
                return self._begin_now_or_coast(task)
            if task.request.correction or boundary.is_timed or options.time_budget > 0:
                return self._begin_now(task)
            return self._begin_in_asked_time(task)
        except NotFoundError as refusal:
            if bound.seconds == 0:
                raise
            raise type(refusal)(f"{refusal} It is proved that {bound}.") from None

    def _boundary(self, request: PlanRequest, shape: Array | None) -> BoundaryConditions:
        """Return the boundary conditions of a request with this goal shape (n,); None: any."""
        specification, state = self._kind_of(request.goal).specification, request.state
        ends = specification.boundary_conditions(request, shape, self._limits)
        R_BW = matrix_from_quaternion(state.quaternion).T
        direction_W = self._constraints.direction_W
        return replace(
            ends,
            direction=np.zeros(3) if direction_W is None else R_BW @ direction_W,
            state=state,
            angular_momentum=R_BW @ state.angular_momentum,
        )

    def _found(self, task: SearchProblem, found: Manoeuvre) -> _Plan:
        notes: Notes = {"starts": float(found.starts), "solution_time": found.solution.duration}
        if len(found.coasting):
            notes["coasting_time"] = len(found.coasting) * self.control_period
        if found.cut_short:
            notes["cut_short"] = (
                f"The search used up optimal.time_budget, {self.options.time_budget:g} s, after "
                f"{counted(found.starts, 'start')}; a larger budget may find a faster manoeuvre."
            )
        return _Plan(found.positions, notes, task.boundary.final_velocity)

    @cached_property
    def _connection_bounds(self) -> ConnectionBounds:
        return ConnectionBounds.of(self.robot, self._specification.base_rotations.axes)

    def _require_enough_time(self, task: SearchProblem, *, final_is_given: bool) -> DurationBound:
        """Return a bound on the duration of all manoeuvres from rest to the goal.

        ``final_is_given``: the goal has the last shape of the boundary conditions. PlanningError if
        the bound is longer than the options allow.
        """
        robot, boundary, bounds = self.robot, task.boundary, self._connection_bounds
        # The slots of three sliders determine the shape.
        only_sliders = self._specification.position and len(sliders_of(robot)) == robot.n == 3
        bound = DurationBound.of(
            robot,
            boundary,
            self._limits,
            self.control_period,
            self._kind_of(task.request.goal).specification.axes,
            bounds,
            final_is_given=final_is_given or only_sliders,
            base_rate_limit=task.options.max_base_rate,
            demands=link_demands(robot, task.request, boundary, bounds),
        )
        name, given = _asked_time(task.options)
        if bound.seconds > given + self.control_period / 2:
            raise PlanningError(
                f"The goal cannot be reached within optimal.{name} = {given:g} s: {bound}. Allow "
                "more time."
            )
        return bound

    def _begin_in_asked_time(self, task: SearchProblem) -> Manoeuvre:
        """Return a manoeuvre from rest that takes no longer than the options allow.

        NotFoundError if none was found; if a longer one was, the message has its duration.
        """
        chosen = task.options
        unlimited = replace(chosen, duration=0.0, longest=OptimalOptions().longest)
        name, given = _asked_time(chosen)
        if given >= unlimited.longest:
            return self._begin_now(task)
        try:
            return self._begin_now(replace(task, max_failed_starts=_STARTS_BEFORE_FASTEST))
        except NotFoundError as reason:
            none_found = reason
        try:
            found = self._begin_now(replace(task, options=unlimited))
        except NotFoundError:
            raise none_found from None
        if chosen.duration == 0 and found.duration <= given:
            return found
        raise NotFoundError(
            f"No manoeuvre to the goal was found within optimal.{name} = {given:g} s: the fastest "
            f"one found takes {found.duration:.6g} s. Allow more time."
        )

    def _begin_now(self, task: SearchProblem) -> Manoeuvre:
        """Return a manoeuvre that begins immediately.

        Effort limits are imposed only if they would be violated otherwise. If no manoeuvre within
        them is found, they are ignored, unless the options require them.
        """
        kind = self._kind_of(task.request.goal)
        found = kind.search.search(task)
        if not self._is_within_efforts(task, found):
            try:
                found = kind.within_efforts.search(task)
            except NotFoundError:
                if self._efforts_are_strict:
                    raise
        return found

    def _begin_now_or_coast(self, task: SearchProblem) -> Manoeuvre:
        """Return a manoeuvre of a robot that drifts: joints may rest until the goal is in reach.

        The base may drift away from the goal faster than the joints rotate it back; later, it
        passes the goal. The search is first for a manoeuvre that ends before the base has rotated
        far, then for one that ends when the base passes the goal, and finally for any.
        """
        state, longest = task.request.state, task.options.longest
        momenta, rest = (state.linear_momentum, state.angular_momentum), np.zeros(self.robot.n)
        _, omega = self.robot.base_twist(state.quaternion, state.q, rest, *momenta)
        rate = float(np.linalg.norm(omega))
        brief = task.within_time(_MAX_ANGLE_WITHOUT_COASTING / rate)
        try:
            return self._begin_now(replace(brief, max_failed_starts=_STARTS_BEFORE_COASTING))
        except NotFoundError as reason:
            refusal = reason
        last = min(longest, _COASTING_TURNS * 2 * math.pi / rate)
        ticks = math.ceil(last / self.control_period)
        coast = self._prediction.poses(state, np.tile(state.q, (ticks + 1, 1)))
        step = max(1, round(_COASTING_ANGLE / rate / self.control_period))
        for end in self._goal_passing_ticks(task, coast, step):
            try:
                return self._plan_for_coasting_time(task, coast, end)
            except (PlanningError, UnusableCandidateError):
                task.cancellation.raise_if_requested()
        if isinstance(refusal, NoClearPathError):
            raise refusal  # A search with more time begins with the same manoeuvres.
        return self._begin_now(task.within_time(last))

    def _later(self, task: SearchProblem, coast: BasePoses, ticks: int) -> SearchProblem:
        """Return the task of a manoeuvre that begins after some ticks of coasting."""
        r_WB, attitude = coast.position[ticks], coast.quaternion[ticks]
        state = replace(task.request.state, position=r_WB, quaternion=attitude)
        later = replace(task.request, state=state)
        aimed = self._boundary(later, self.goal_shape(later.goal))
        return replace(task, request=later, boundary=aimed)

    def _goal_passing_ticks(self, task: SearchProblem, coast: BasePoses, step: int) -> list[int]:
        """Return the ticks at which the coasting base passes the goal, the closest pass first."""
        grid = np.arange(0, len(coast.position), step)
        turns = np.array([self._later(task, coast, int(k)).boundary.goal_rotation for k in grid])
        # The cosine of half the remaining angle.
        near = np.abs(turns[:, 3])
        passes = 1 + np.flatnonzero((near[1:-1] > near[:-2]) & (near[1:-1] >= near[2:]))
        closest = passes[np.argsort(-near[passes], kind="stable")]
        return [int(tick) for tick in grid[closest][:_MAX_COASTING_ENDS]]

    def _plan_for_coasting_time(self, task: SearchProblem, coast: BasePoses, end: int) -> Manoeuvre:
        """Return a manoeuvre that ends about when the coasting base passes the goal, at tick
        ``end``.

        It begins earlier by the duration of a manoeuvre from there at zero momentum.
        PlanningError if none was found, UnusableCandidateError if coasting violates a path
        constraint.
        """
        h = self.control_period
        there = self._later(task, coast, end)
        at_rest = replace(there.boundary, angular_momentum=np.zeros(3))
        few = replace(task.options, starts=min(task.options.starts, _STARTS_BEFORE_COASTING))
        free = self._begin_now(replace(there, boundary=at_rest, options=few, keeps_clear=False))
        takes = len(free.held.positions) - 1
        begin = max(0, end - takes)
        later = self._later(task, coast, begin).within_time(_MAX_DURATION_RATIO * takes * h)
        few_failed = replace(later, max_failed_starts=_STARTS_AFTER_COASTING)
        coasting = np.tile(task.request.state.q, (begin, 1))
        self._constraints.check(coasting, coast.quaternion[:begin], h)
        return replace(self._begin_now(few_failed), coasting=coasting)

    def _plan_in_motion(self, task: SearchProblem, motion: InitialMotion) -> _Plan:
        """Plan from moving joints; the remaining previous motion is the first guess."""
        self._require_speeds(motion.velocity)
        again, chosen = task.request.previous is not None, task.options
        budget = replace(
            chosen,
            starts=1 if again else min(chosen.starts, _MAX_STARTS_IN_MOTION),
            answers=1 if again else chosen.answers,
        )
        try:
            found = self._begin_now(replace(task, options=budget))
        except NotFoundError as refusal:
            # The current manoeuvre continues if its goal is only replanned.
            rests = not len(self._wheels) and motion.velocity.any()
            if again or chosen.duration > 0 or not rests:
                raise
            return self._plan_with_braking(task, motion, refusal)
        return self._found(task, found)

    def _plan_with_braking(
        self, task: SearchProblem, motion: InitialMotion, refusal: NotFoundError
    ) -> _Plan:
        """Plan from the shape in which joints come to rest after braking as fast as allowed.

        NotFoundError if none was found; the ``refusal`` if braking itself is impossible.
        """
        state, limits, period = task.request.state, task.limits, self.control_period
        ticks = math.ceil(float((np.abs(motion.velocity) / limits.acceleration).max()) / period)
        # The joints rest in the last tick, so that the next command is within its limits.
        slowed = period * limits.acceleration * np.arange(1, ticks + 1)[:, np.newaxis]
        rates = np.sign(motion.velocity) * np.maximum(np.abs(motion.velocity) - slowed, 0.0)
        braking = state.q + np.vstack([np.zeros(self.robot.n), period * np.cumsum(rates, axis=0)])
        base = self._prediction.poses(state, braking)
        beyond = np.any(braking < limits.lower) or np.any(braking > limits.upper)
        if self._efforts is not None and self._efforts_are_strict:
            turns = quaternion_multiply(quaternion_inverse(state.quaternion), base.quaternion)
            L_B = task.boundary.momenta_in_base(turns)
            held = HeldMotion(braking, period, motion.velocity, L_B=L_B)
            beyond |= self._efforts.excess(held) > 1 + _LIMIT_ROUNDING
        if beyond or self._too_near(braking, base if self._has_obstacles else None):
            raise refusal
        try:
            self._constraints.check(braking, base.quaternion, period)
        except UnusableCandidateError:
            raise refusal from None
        r_WB, attitude = base.position[-1], base.quaternion[-1]
        at_rest = replace(state, position=r_WB, quaternion=attitude, q=braking[-1])
        request = replace(task.request, state=at_rest, motion=None)
        plan = self._plan_about_center(request, task.cancellation, task.clock)
        shapes = np.vstack([braking[:-1], plan.positions])
        return _Plan(shapes, {**plan.notes, "braking_time": ticks * period})

    @property
    def _efforts_are_strict(self) -> bool:
        """Whether effort limits are strict; otherwise, they are kept if a manoeuvre allows it."""
        return self.options.effort_limits != 0 or bool(self.options.max_effort)

    def _is_within_efforts(self, task: SearchProblem, found: Manoeuvre) -> bool:
        if self._efforts is None:
            return True
        shapes, after = found.held.positions, task.boundary.final_velocity
        L_B = task.boundary.momenta_in_base(found.held.quaternions)
        motion = HeldMotion(shapes, self.control_period, task.velocity, after, L_B)
        return self._efforts.excess(motion) <= 1 + _LIMIT_ROUNDING

    def _build_schedule(self, request: PlanRequest, plan: _Plan) -> GaitSchedule:
        """Return a plan as a schedule, with notes on its end."""
        state, goal, positions = request.state, request.goal, plan.positions
        after = np.broadcast_to(plan.final_velocity, self.robot.n)
        before = (
            self._wheel_rates(state.qdot) if request.motion is None else request.motion.velocity
        )
        attitudes = self._prediction.attitudes(positions, state.quaternion, state.angular_momentum)
        path = self._prediction.path(state, positions, attitudes)
        L_B: Array | None = None
        if state.angular_momentum.any():
            L_B = np.asarray(state.angular_momentum @ matrices_from_quaternions(attitudes))
        # Held commands end at the goal in the plant's integration, and share its error.
        true_end = self._prediction.true_end(positions, attitudes, state.angular_momentum)
        (true_position,) = self._prediction.positions(
            state, path.time[-1:], positions[-1:], true_end[np.newaxis]
        )
        controls = self.controls_for(goal)
        at_end = self._end_notes(goal, positions[-1], true_position, true_end, controls)
        notes = {**plan.notes, **at_end}
        if L_B is not None:
            momenta = state.linear_momentum, state.angular_momentum
            _, omega = self.robot.base_twist(attitudes[-1], positions[-1], after, *momenta)
            notes["final_base_rate"] = omega.tolist()
        if after.any():
            notes["final_wheel_rates"] = after[self._wheels.index].tolist()
        motion = HeldMotion(positions, self.control_period, before, after, L_B)
        notes["limited_by"] = self._list_active_limits(motion)
        schedule = self.schedule_of(
            goal,
            positions,
            path,
            notes,
            is_clear=True,
            motion=motion,
            end_velocities=after if after.any() else None,
        )
        return replace(schedule, controls=controls)

    def _list_active_limits(self, motion: HeldMotion) -> str:
        if len(motion.positions) < 2:
            return "nothing"
        speed, change = np.abs(motion.velocities), np.abs(motion.accelerations)
        limits = self._limits
        shares = {"velocity": speed / limits.velocity, "acceleration": change / limits.acceleration}
        if self._efforts is not None:
            shares["effort"] = np.abs(self._efforts.shares(motion))
        names = np.array(self.robot.joint_names)
        active = {
            limit: names[share.max(axis=0) > _ACTIVE_LIMIT_SHARE].tolist()
            for limit, share in shares.items()
        }
        parts = (f"{limit} of {' '.join(joints)}" for limit, joints in active.items() if joints)
        return ", ".join(parts) or "nothing"

    def _request_key(self, request: PlanRequest) -> str:
        """Return the name of a plan: a hash of the robot's equations and of the request."""
        robot, goal = self.robot, request.goal
        digest = hashlib.sha256(robot.equations_key.encode())
        facts: dict[str, object] = {
            "format": 4,
            "versions": [__version__, ca.__version__, np.__version__],
            "joints": robot.joint_names,
            "options": values_of(self.options),
            "time": [self.control_period, self.integration_step],
            "limits": vars(self._limits),
            "state": vars(request.state),
            "goal": [goal.position, goal.quaternion, goal.joint_positions, sorted(goal.base)],
            "controls": sorted(self.controls_for(goal)),
            "end_effectors": [[each.link, each.values] for each in goal.end_effectors],
            "tolerance": vars(request.tolerance),
        }
        if self._efforts is not None:
            digest.update(robot.function("joint_efforts", compile=False).serialize().encode())
            facts["efforts"] = self._efforts.limit
        if self.clearance is not None:
            facts["clearance"] = self.clearance.facts

        def listed(value: object) -> object:
            return value.tolist() if isinstance(value, np.ndarray) else repr(value)

        digest.update(json.dumps(facts, sort_keys=True, default=listed).encode())
        return digest.hexdigest()


def _asked_time(chosen: OptimalOptions) -> tuple[str, float]:
    """Return the option that limits the duration of a manoeuvre, and its value, s."""
    if chosen.duration > 0:
        return "duration", chosen.duration
    return "longest", chosen.longest
