"""Methods by name; a new method needs one file and one line here.

Two methods plan with the others: ``auto`` selects the shortest manoeuvre, compared for each goal,
and :class:`RemainingJointsGait` plans for robots with stuck joints.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, ClassVar

import numpy as np
from typing_extensions import override

from spacerobot_ros.errors import (
    ParameterError,
    PlanningError,
    Proof,
    RobotDescriptionError,
    SpaceRobotError,
    UnreachableError,
    UnreadMeshError,
    refusal_of_all,
)
from spacerobot_ros.files import warn_once
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.parameters import configured, declared, require_known
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import POSE, Controlled, Goal, PoseError
from spacerobot_ros.planning.core.method import NO_JOINTS, GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.methods.area_loop import AreaLoopGait
from spacerobot_ros.planning.methods.lie_bracket import LieBracketGait
from spacerobot_ros.planning.methods.optimal import OptimalGait
from spacerobot_ros.planning.methods.resolved_rate import PathProgress, ResolvedRateGait
from spacerobot_ros.planning.methods.square_path import SquarePathGait
from spacerobot_ros.registry import Registry

# -- auto -----------------------------------------------------------------------------------------


class AutoGait(GaitMethod):
    """Plans with all methods that suit the robot, and returns the shortest manoeuvre.

    If a method that suits the robot controls the position, methods that do not control it are
    omitted. A manoeuvre that misses the goal, or controls fewer goal components than another, is
    selected only if there is no better one. The method of the last schedule flown for a goal is
    kept for that goal as long as it finds a plan. Notes are added to the chosen schedule.

    Parameters
    ----------
    candidates
        Methods by name; among equally long manoeuvres, that of the first method is selected.
    build
        Returns the named method with its options for the robot.
    """

    name: ClassVar[str] = "auto"
    starts_in_motion: ClassVar[bool] = True

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        *,
        candidates: Mapping[str, type[GaitMethod]],
        build: Callable[[str], GaitMethod],
    ) -> None:
        super().__init__(robot, control_period, integration_step)
        self._candidates, self._get_method = candidates, cache(build)
        self._unsuitable: dict[str, SpaceRobotError] = {}
        for name, method in candidates.items():
            try:
                method.require_suitable(robot)
            except PlanningError as refusal:
                self._unsuitable[name] = refusal

    @override
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan with all suitable methods, and return the best plan; see :meth:`GaitMethod.plan`.

        ``notes`` name the method (``chosen``), the reason (``because``), and all (``compared``).

        Raises
        ------
        PlanningError
            No method finds a plan; the message contains the reasons of all methods. The error is an
            `UnreachableError` if one method proves that the goal is unreachable, else a
            `NotFoundError` if at least one method searched for a plan.
        """
        if not self.robot.n:
            raise PlanningError(NO_JOINTS.format(self.robot.description.name))
        refusals = dict(self._unsuitable)
        names = self._comparable_methods(request.goal, refusals)
        if request.goal.end_effectors:
            names = [name for name in self._candidates if name not in self._unsuitable]
        if request.goal.has_path:
            names = [name for name in names if self._candidates[name].follows_paths]
        if request.motion is not None:
            for name in names:
                if not self._candidates[name].starts_in_motion:
                    refusals[name] = PlanningError(f"{name} plans only from rest.")
            names = [name for name in names if name not in refusals]
        flying = "" if request.previous is None else request.previous.method
        results: dict[str, _MethodResult] = {}
        for name in sorted(names, key=lambda name: name != flying):
            try:
                schedule = self._get_method(name).plan(request, cancellation)
            except PlanningCancelled:
                raise
            except (ParameterError, PlanningError) as refusal:
                refusals[name] = refusal
                continue
            results[name] = _MethodResult.of(self.robot, schedule, request)
            if name == flying:
                because = f"{flying} planned for this goal before."
                return _add_notes(schedule, flying, because, results, {})
        if not results:
            raise self._refuse_goal(refusals)
        for each in refusals.values():
            if isinstance(each, UnreadMeshError):
                warn_once(str(each))
        chosen = min(results, key=lambda name: results[name].rank(results.values()))
        because = f"{chosen} suits robot '{self.robot.description.name}' and " + (
            f"plans the shortest of {len(results)} manoeuvres to this goal."
            if len(results) > 1
            else "is the only method that can plan for this goal."
        )
        return _add_notes(results[chosen].schedule, chosen, because, results, refusals)

    def _refuse_goal(self, refusals: Mapping[str, SpaceRobotError]) -> PlanningError:
        """Return the error for a goal that no method plans: the proof by one, or all reasons."""
        # Refusals of the robot do not depend on the goal.
        of_goal = [refusals[name] for name in refusals if name not in self._unsuitable]
        for refusal in of_goal:
            if isinstance(refusal, UnreachableError):
                return refusal
        names_by_reason: dict[str, list[str]] = {}
        # What other goals could change comes first.
        for name in sorted(self._candidates, key=self._unsuitable.__contains__):
            if name in refusals:
                names_by_reason.setdefault(str(refusals[name]), []).append(name)
        reasons = " ".join(f"{', '.join(each)}: {why}" for why, each in names_by_reason.items())
        message = (
            f"No method can plan for this goal with robot '{self.robot.description.name}'. "
            f"{reasons}"
        )
        return refusal_of_all(message, of_goal)

    def _comparable_methods(self, goal: Goal, refusals: dict[str, SpaceRobotError]) -> list[str]:
        """Return the methods to compare; add the refusals of the other methods."""
        pose: dict[str, frozenset[Controlled]] = {}
        for name in self._candidates:
            if name in refusals or not self._candidates[name].plans_for_base:
                continue
            try:
                pose[name] = self._get_method(name).controls_for(goal) & POSE
            except ParameterError as refusal:
                refusals[name] = refusal
        for name, parts in pose.items():
            more = [other for other in pose.values() if parts < other]
            if more:
                lost = " and ".join(sorted(frozenset[str]().union(*more) - parts))
                refusals[name] = PlanningError(
                    f"{name} does not control the {lost} of the base; another method does."
                )
        return [name for name in pose if name not in refusals]


@dataclass(frozen=True)
class _MethodResult:
    """A schedule, its goal components, and whether it or its successors reach the goal."""

    schedule: GaitSchedule
    parts: frozenset[Controlled]
    reaches_goal: bool

    @classmethod
    def of(cls, robot: SpaceRobot, schedule: GaitSchedule, request: PlanRequest) -> _MethodResult:
        goal, path = request.goal, schedule.path
        asked = goal.base if goal.joint_positions is None else goal.base | {"shape"}
        q = schedule.positions[-1]
        error = PoseError.between(path.position[-1], path.quaternion[-1], goal, q, robot)
        reaches = schedule.partial or request.tolerance.admits(error, schedule.controls)
        return cls(schedule, schedule.controls & asked, reaches)

    def rank(self, others: Collection[_MethodResult]) -> tuple[bool, bool, float]:
        """Return the sort key: the better of two results has the smaller key."""
        less = any(self.parts < other.parts and other.reaches_goal for other in others)
        return not self.reaches_goal, less, self.schedule.expected_duration

    @property
    def message(self) -> str:
        about = "about " if self.schedule.partial else ""
        off = "" if self.reaches_goal else ", which misses the goal"
        return f"{about}{self.schedule.expected_duration:.6g} s{off}"


def _add_notes(
    schedule: GaitSchedule,
    chosen: str,
    because: str,
    results: Mapping[str, _MethodResult],
    refusals: Mapping[str, SpaceRobotError],
) -> GaitSchedule:
    compared = [f"{name}: {result.message}." for name, result in results.items()]
    compared += [f"{name}: {refusal}" for name, refusal in refusals.items()]
    notes = {"chosen": chosen, "because": because, "compared": " ".join(compared)}
    return replace(schedule, notes={**schedule.notes, **notes})


# -- the joints that are not stuck ----------------------------------------------------------------


@dataclass(frozen=True)
class _RemainingProgress:
    """Progress of a schedule of the method ``planner`` without the ``stuck`` joints."""

    stuck: frozenset[str]
    planner: str
    inner: object


class RemainingJointsGait(GaitMethod):
    """Plans for a robot with stuck joints, each of which rigidly connects two bodies.

    The schedules include every joint; stuck joints are at rest.

    Parameters
    ----------
    robot, control_period, integration_step
        As for any :class:`GaitMethod`.
    stuck
        Positions of the stuck joints, m or rad, by name, at which the model holds them fixed.
    method, options
        Method for the other joints, as for :func:`build_method`, or ``auto`` if it rejects them.
    required
        Goal components that a schedule must control.
    clearance
        As for any :class:`GaitMethod`.
    """

    name: ClassVar[str] = "remaining_joints"

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float,
        *,
        stuck: Mapping[str, float],
        method: str,
        options: Mapping[str, Any],
        required: frozenset[Controlled] = frozenset(),
        clearance: Clearance | None = None,
    ) -> None:
        super().__init__(robot, control_period, integration_step, clearance=clearance)
        self._stuck = dict(stuck)
        self._is_stuck = np.array([name in stuck for name in robot.joint_names], dtype=np.bool_)
        self._names = list(dict.fromkeys((method, "auto")))
        self._required = required
        self._options = {
            name: _options_of_remaining(chosen, stuck.keys(), robot.joint_names)
            for name, chosen in options.items()
        }
        self._remaining: SpaceRobot | None = None
        self._methods: dict[str, GaitMethod] = {}

    @override
    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan with the joints that are not stuck; see :meth:`GaitMethod.plan`."""
        try:
            return self._plan_without_stuck(request, cancellation)
        except PlanningCancelled:
            raise
        except PlanningError as refusal:
            stuck = " and ".join(
                f"joint '{joint.name}' is stuck at {self._stuck[joint.name]:.4g} {joint.unit}"
                for joint in self.robot.description.movable_joints
                if joint.name in self._stuck
            )
            raise refusal_of_all(f"{stuck}; {refusal}", [refusal]) from None

    def _plan_without_stuck(self, request: PlanRequest, cancellation: Cancellation) -> GaitSchedule:
        moving, state, shape = ~self._is_stuck, request.state, request.goal.joint_positions
        if not moving.any():
            raise PlanningError(
                "no joint follows its commands; see /diagnostics for commands that the plant "
                "refuses."
            )
        names, previous = self._methods_to_try(request.previous)
        inner = replace(
            request,
            state=replace(
                state, q=state.q[moving], qdot=None if state.qdot is None else state.qdot[moving]
            ),
            goal=replace(request.goal, joint_positions=None if shape is None else shape[moving]),
            previous=previous,
        )
        reasons: list[SpaceRobotError] = []
        for name in names:
            try:
                schedule = self._get_method(name).plan(inner, cancellation)
            except PlanningCancelled:
                raise
            except (PlanningError, ParameterError, RobotDescriptionError) as refusal:
                reasons.append(refusal)
                continue
            if lost := self._required - schedule.controls:
                parts = " and ".join(sorted(lost))
                left = f"{schedule.method} does not control the {parts} of the base."
                reasons.append(PlanningError(left))
                continue
            if "shape" in schedule.controls and shape is not None:
                far = np.abs(shape - state.q) * self._is_stuck
                if far.max() > request.tolerance.shape:
                    joint, at = self.robot.joint_names[far.argmax()], shape[far.argmax()]
                    raise UnreachableError(
                        f"the goal requires joint '{joint}' at {at:.4g}.", Proof.LIMITS
                    )
            positions = np.tile(state.q, (len(schedule.positions), 1))
            positions[:, moving] = schedule.positions
            end = None
            if schedule.end_velocities is not None:
                end = np.zeros(self.robot.n)
                end[moving] = schedule.end_velocities
            return replace(
                schedule,
                end_velocities=end,
                joint_names=self.robot.joint_names,
                positions=positions,
                goal=request.goal,
                progress=_RemainingProgress(frozenset(self._stuck), name, schedule.progress),
            )
        sentences = " ".join(dict.fromkeys(map(str, reasons)))
        raise refusal_of_all(f"with the remaining joints: {sentences}", reasons)

    def _methods_to_try(
        self, previous: GaitSchedule | None
    ) -> tuple[list[str], GaitSchedule | None]:
        """Return the names of the methods to try, and the previous schedule for these methods."""
        if previous is None:
            return self._names, None
        progress = previous.progress
        inner = progress.inner if isinstance(progress, _RemainingProgress) else progress
        if isinstance(inner, PathProgress):
            moving = previous.positions[:, ~self._is_stuck]
            return self._names, replace(previous, positions=moving, progress=inner)
        if isinstance(progress, _RemainingProgress) and progress.stuck == self._stuck.keys():
            return [progress.planner], replace(previous, progress=inner)
        return self._names, None

    def _get_method(self, name: str) -> GaitMethod:
        if self._remaining is None:
            self._remaining = SpaceRobot(self.robot.description.with_locked(self._stuck))
        if name not in self._methods:
            self._methods[name] = build_method(
                name,
                self._remaining,
                self.control_period,
                self.integration_step,
                self._options,
                self.clearance and self.clearance.of(self._remaining.description),
            )
        return self._methods[name]


def _options_of_remaining(options: Any, gone: Set[str], names: Sequence[str]) -> Any:
    """Return options for the joints that are not stuck: lists with one number per joint lose those
    of the stuck ones, and joint names are left to the method if one of them is stuck.
    """
    kept: dict[str, Any] = {}
    for option in declared(options):
        value = option.default
        if not option.of_joints:
            continue
        if isinstance(value, str):
            kept[option.name] = "" if gone & set(value.split()) else value
        elif isinstance(value, tuple) and any(isinstance(each, str) for each in value):
            kept[option.name] = tuple(
                each for each in value if str(each).rpartition(":")[0] not in gone
            )
        elif isinstance(value, tuple) and len(value) == len(names):
            left = (x for x, name in zip(value, names, strict=True) if name not in gone)
            kept[option.name] = tuple(left)
    return replace(options, **kept)


# -- registry -------------------------------------------------------------------------------------

METHODS: Registry[GaitMethod] = Registry(
    "gait method",
    "spacerobot_ros.gait_methods",
    GaitMethod,
    (
        # Specialised methods come first: `auto` takes the first of equally long manoeuvres.
        LieBracketGait,
        SquarePathGait,
        AreaLoopGait,
        OptimalGait,
        ResolvedRateGait,
        AutoGait,
    ),
)


def build_method(
    name: str,
    robot: SpaceRobot,
    control_period: float,
    integration_step: float,
    options: Mapping[str, Any],
    clearance: Clearance | None = None,
) -> GaitMethod:
    """Return a method for a robot; ``options`` contains instances of ``Options`` by method.

    A method without an entry uses its defaults. Schedules keep the clearance, if given.

    Raises
    ------
    KeyError
        There is no such method.
    ParameterError
        An option is incompatible with the robot or with another option.
    """
    method = METHODS[name]
    if method is not AutoGait:
        return method(robot, control_period, integration_step, options.get(name), clearance)
    return AutoGait(
        robot,
        control_period,
        integration_step,
        candidates={other: each for other, each in METHODS.items() if each is not AutoGait},
        build=lambda other: build_method(
            other, robot, control_period, integration_step, options, clearance
        ),
    )


def method_options(name: str, values: Mapping[str, Any]) -> Any:
    """Return a method's ``Options`` from values by name, with defaults for missing names.

    Raises
    ------
    ParameterError
        There is no such method or option, or a value is invalid.
    """
    if name not in METHODS:
        raise ParameterError(
            f"There is no gait method '{name}'; the methods are: {', '.join(METHODS)}."
        )
    require_known(name, METHODS[name].Options, values)
    return configured(METHODS[name].Options, values)


# Last: a plugin may import this module.
METHODS.load()
