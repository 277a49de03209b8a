"""The method that robot and goal allow, chosen goal by goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning.core.goal import POSE, Goal, RobotState, Tolerance
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.core.schedule import GaitSchedule


@dataclass(frozen=True)
class Candidate:
    """A method to choose, and how to build it for the robot, with its options, when it is tried."""

    method: type[GaitMethod]
    build: Callable[[], GaitMethod]


class AutoGait(GaitMethod):
    """Tries the methods that suit the robot, in a given order, and takes the first that plans.

    Where a method that suits the robot moves the base to a position, one that leaves the position
    as it comes does not stand in for it. ``controls`` is that of the method last chosen, which
    also corrects what is left of its goal.

    Parameters
    ----------
    candidates
        The methods by name, in the order in which they are tried.
    """

    name: ClassVar[str] = "auto"

    def __init__(
        self,
        robot: SpaceRobot,
        tick_period: float,
        tolerance: Tolerance,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        *,
        candidates: Mapping[str, Candidate],
    ) -> None:
        super().__init__(robot, tick_period, tolerance, integration_step)
        self._candidates = candidates
        self._objections = {
            name: candidate.method.objection(robot) for name, candidate in candidates.items()
        }
        self._built: dict[str, GaitMethod] = {}
        self._goal: Goal | None = None
        self._chosen = ""

    def plan(self, state: RobotState, goal: Goal, *, correction: bool = False) -> GaitSchedule:
        """Plan by the first method that can; see :meth:`GaitMethod.plan`.

        ``notes`` say which (``chosen``) and why (``because``).

        Raises
        ------
        PlanningError
            No method plans; the sentences of all of them say why.
        """
        reasons = dict(self._objections)
        parts = frozenset[str]()
        for name in self._order(goal):
            if self._objections[name]:
                continue
            method = self._method(name)
            pose = method.controls & POSE
            if not parts <= pose:
                lost = " and ".join(sorted(parts - pose))
                reasons[name] = f"{name} would leave the {lost} of the base as it comes."
                continue
            try:
                schedule = method.plan(state, goal, correction=correction)
            except PlanningError as refusal:
                reasons[name] = str(refusal)
                parts |= pose
                continue
            self.controls = method.controls
            self._goal, self._chosen = goal, name
            notes = {**schedule.notes, "chosen": name, "because": self._because(name, reasons)}
            return replace(schedule, notes=notes)
        raise PlanningError(
            f"No method plans this goal of robot '{self.robot.description.name}'. "
            + " ".join(f"{name}: {reason}" for name, reason in reasons.items())
        )

    def _order(self, goal: Goal) -> list[str]:
        """Return the names in the order of trial: first the method that flies this goal already."""
        names = list(self._candidates)
        if goal is self._goal:
            names.sort(key=lambda name: name != self._chosen)
        return names

    def _method(self, name: str) -> GaitMethod:
        if name not in self._built:
            self._built[name] = self._candidates[name].build()
        method = self._built[name]
        method.tolerance = self.tolerance
        return method

    def _because(self, chosen: str, reasons: Mapping[str, str]) -> str:
        """Return the reasons against what comes before the chosen method, and that it suits."""
        names = list(self._candidates)
        before = [reasons[name] for name in names[: names.index(chosen)] if reasons[name]]
        suits = f"{chosen} suits robot '{self.robot.description.name}'"
        return " ".join([f"{suits} and is the first that plans this goal.", *before])
