"""``auto``: the method that robot and goal allow, chosen goal by goal."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning.core.cancellation import NEVER, Cancellation, PlanningCancelled
from spacerobot_ros.planning.core.goal import POSE
from spacerobot_ros.planning.core.method import GaitMethod, PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule


@dataclass(frozen=True)
class Candidate:
    """A method to choose, and how to build it for the robot, with its options, when it is tried."""

    method: type[GaitMethod]
    build: Callable[[], GaitMethod]


class AutoGait(GaitMethod):
    """Tries the methods that suit the robot, in a given order, and takes the first that plans.

    Where a method that suits the robot moves the base to a position, one that leaves the position
    as it comes does not stand in for it. The method of the schedule flown before for the same goal
    is tried first. A schedule is that of the chosen method, in all but its notes.

    Parameters
    ----------
    candidates
        The methods by name, in the order in which they are tried.
    """

    name: ClassVar[str] = "auto"
    starts_in_motion: ClassVar[bool] = True

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
        *,
        candidates: Mapping[str, Candidate],
    ) -> None:
        super().__init__(robot, control_period, integration_step)
        self._candidates = candidates
        self._unsuitable: dict[str, str] = {}
        for name, candidate in candidates.items():
            try:
                candidate.method.require_suitable(robot)
            except PlanningError as refusal:
                self._unsuitable[name] = str(refusal)
        self._built: dict[str, GaitMethod] = {}

    def plan(self, request: PlanRequest, cancellation: Cancellation = NEVER) -> GaitSchedule:
        """Plan by the first method that can; see :meth:`GaitMethod.plan`.

        ``notes`` name it (``chosen``) and why (``because``).

        Raises
        ------
        PlanningError
            No method plans; the sentences of all of them say why.
        """
        reasons = dict(self._unsuitable)
        parts = frozenset[str]()
        for name in self._order(request):
            if name in self._unsuitable:
                continue
            if request.motion is not None and not self._candidates[name].method.starts_in_motion:
                reasons[name] = f"{name} plans from rest only."
                continue
            method = self._method(name)
            pose = method.controls & POSE
            if not parts <= pose:
                lost = " and ".join(sorted(parts - pose))
                reasons[name] = f"{name} would leave the {lost} of the base as it comes."
                continue
            try:
                schedule = method.plan(request, cancellation)
            except PlanningCancelled:
                raise
            except PlanningError as refusal:
                reasons[name] = str(refusal)
                parts |= pose
                continue
            notes = {**schedule.notes, "chosen": name, "because": self._because(name, reasons)}
            return replace(schedule, notes=notes)
        raise PlanningError(
            f"No method plans this goal of robot '{self.robot.description.name}'. "
            + " ".join(f"{name}: {reasons[name]}" for name in self._candidates)
        )

    def _order(self, request: PlanRequest) -> list[str]:
        """Return the names in the order of trial: first that of the schedule before."""
        flying = "" if request.previous is None else request.previous.method
        return sorted(self._candidates, key=lambda name: name != flying)

    def _method(self, name: str) -> GaitMethod:
        if name not in self._built:
            self._built[name] = self._candidates[name].build()
        return self._built[name]

    def _because(self, chosen: str, reasons: Mapping[str, str]) -> str:
        """Return the reasons against what comes before the chosen method, and that it suits."""
        names = list(self._candidates)
        before = [reasons[name] for name in names[: names.index(chosen)] if name in reasons]
        suits = f"{chosen} suits robot '{self.robot.description.name}'"
        return " ".join([f"{suits} and is the first that plans this goal.", *before])
