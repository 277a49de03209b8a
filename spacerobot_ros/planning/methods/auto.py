"""``auto``: the shortest manoeuvre among all suitable methods, compared for each goal."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import ClassVar

from typing_extensions import override

from spacerobot_ros.errors import (
    ParameterError,
    PlanningError,
    SpaceRobotError,
    UnreachableError,
    UnreadMeshError,
    refusal_of_all,
)
from spacerobot_ros.files import warn_once
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.goal import POSE, Controlled, PoseError
from spacerobot_ros.planning.core.method import NO_JOINTS, GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule


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
        names = self._comparable_methods(refusals)
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
        for name in self._candidates:
            if name in refusals:
                names_by_reason.setdefault(str(refusals[name]), []).append(name)
        reasons = " ".join(f"{', '.join(each)}: {why}" for why, each in names_by_reason.items())
        message = (
            f"No method can plan for this goal with robot '{self.robot.description.name}'. "
            f"{reasons}"
        )
        return refusal_of_all(message, of_goal)

    def _comparable_methods(self, refusals: dict[str, SpaceRobotError]) -> list[str]:
        """Return the methods to compare; add the refusals of the other methods."""
        pose: dict[str, frozenset[Controlled]] = {}
        for name in self._candidates:
            if name in refusals or not self._candidates[name].plans_for_base:
                continue
            try:
                pose[name] = self._get_method(name).controls & POSE
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
