"""Plans for robots with stuck joints, using the other joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
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
    refusal_of_all,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.parameters import declared
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.clearance import Clearance
from spacerobot_ros.planning.core.goal import Controlled, RobotState
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.methods.registry import build_method
from spacerobot_ros.planning.methods.resolved_rate import PathProgress


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
                self._require_stuck_at(state, shape, request.tolerance.shape)
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

    def _require_stuck_at(self, state: RobotState, shape: Array, tolerance: float) -> None:
        far = np.abs(shape - state.q) * self._is_stuck
        worst = int(np.argmax(far))
        if far[worst] > tolerance:
            raise UnreachableError(
                f"the goal requires joint '{self.robot.joint_names[worst]}' at {shape[worst]:.4g}.",
                Proof.LIMITS,
            )


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
