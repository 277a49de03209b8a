"""The planner's long work: plans, made while time stands still or beside the flight."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from functools import partial
from threading import Thread
from typing import Any

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitMethod, GaitSchedule, Goal, PlanRequest, RobotState
from spacerobot_ros.planning.core.cancellation import Cancellation
from spacerobot_ros.planning.core.goal import Controlled
from spacerobot_ros.planning.execution.braking import BrakingFollower
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.stitching import stitched
from spacerobot_ros.planning.methods.registry import build_method
from spacerobot_ros.planning.methods.remaining_joints import RemainingJointsGait

_LONGEST_END = 1.5
"""Wall s that work in the background may take to end when it is told to."""

PLANNED = "Planned in {:.6f} s."
"""What is logged when a plan is made, or refused."""

Fly = Callable[[GaitSchedule], None]
Refuse = Callable[[PlanningError], None]
_Outcome = tuple[Callable[[], None], float]


class PlanWork:
    """Plans with the method of a planner node, one plan at a time.

    With ``plan_in_background`` a thread plans while the node goes on answering states: CasADi and
    numpy let go of Python's lock for most of it. The thread uses the robot's functions, whose
    buffers are shared: as long as it is ``busy`` nobody else may.

    Parameters
    ----------
    robot
        For which is planned.
    parameters
        Of the planner node.
    tick_period
        s.
    log
        Is told how long each plan took, which no topic tells: what is published is the same in
        every run.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        parameters: Mapping[str, Any],
        tick_period: float,
        log: Callable[[str], object],
    ) -> None:
        self.plan_time = 0.0
        """Wall time that the plans have taken together, s."""
        self._log = log
        self._robot, self._values, self._tick_period = robot, parameters, tick_period
        self.background: bool = parameters["plan_in_background"]
        self._all_joints = build_method(
            parameters["method"],
            robot,
            tick_period,
            parameters["integration_step"],
            configured(PlannerConfig, parameters).options,
        )
        self.method: GaitMethod | None = self._all_joints
        """What plans now: with all joints, or with those that are not stuck; None: to be built."""
        self._stuck: list[str] = []
        self._required: frozenset[Controlled] = frozenset()
        self._cancellation = Cancellation()
        self._future: Future[_Outcome] | None = None
        self._dropped = False
        self._thread: Thread | None = None
        self._announcement: Thread | None = None

    @property
    def busy(self) -> bool:
        """Whether a plan is being made in the background."""
        return self._future is not None

    def use_all_joints(self) -> None:
        """Plan with all joints again."""
        self.method = self._all_joints

    def go_without(self, stuck: list[str], required: frozenset[Controlled]) -> None:
        """Plan without these joints from now on, and for these parts of the goal at least."""
        self.method, self._stuck, self._required = None, stuck, required

    def _method(self, state: RobotState) -> GaitMethod:
        if self.method is None:
            places = dict(zip(self._robot.joint_names, state.q.tolist(), strict=True))
            self.method = RemainingJointsGait(
                self._robot,
                self._tick_period,
                self._values["integration_step"],
                stuck={name: places[name] for name in self._stuck},
                method=self._values["method"],
                options=configured(PlannerConfig, self._values).options,
                required=self._required,
            )
        return self.method

    def begin(
        self,
        goal: Goal,
        state: RobotState,
        fly: Fly,
        refuse: Refuse,
        correction: bool,
        previous: GaitSchedule | None,
        flown: BrakingFollower | None,
        stamp_ns: int,
    ) -> None:
        """Plan from a state, and hand the plan or the reason on: at once, or by :meth:`poll`.

        ``flown`` comes to rest first, from ``stamp_ns`` on.
        """

        tolerance = configured(PlannerConfig, self._values).tolerance
        cancellation = self._cancellation = Cancellation()

        def plan(start: RobotState) -> GaitSchedule:
            request = PlanRequest(start, goal, tolerance, correction, previous)
            return self._method(start).plan(request, cancellation)

        def work() -> _Outcome:
            began = time.perf_counter()
            try:
                if flown is None:
                    schedule = plan(state)
                else:
                    step = self._values["integration_step"]
                    schedule = stitched(flown, stamp_ns, state, self._robot, step, plan)
            except PlanningError as reason:
                return partial(refuse, reason), time.perf_counter() - began
            return partial(fly, schedule), time.perf_counter() - began

        self._dropped = False
        if not self.background:
            self._hand_on(work())
            return
        self._future = Future()
        self._thread = Thread(target=_fulfil, args=(self._future, work), daemon=True)
        self._thread.start()

    def poll(self) -> None:
        """Hand on what has come of a plan in the background, if it is there."""
        if self._future is not None and self._future.done():
            future, self._future = self._future, None
            if not self._dropped:
                self._hand_on(future.result())

    def _hand_on(self, outcome: _Outcome) -> None:
        act, took = outcome
        self.plan_time += took
        self._log(PLANNED.format(took))
        act()

    def announce(self, act: Callable[[], None]) -> None:
        """Do something that takes long and that nothing waits for."""
        if not self.background:
            act()
            return
        if self._announcement is not None:
            self._announcement.join(_LONGEST_END)
        self._announcement = Thread(target=act, daemon=True)
        self._announcement.start()

    def drop(self) -> bool:
        """Fly nothing of what is being planned, and return whether something is."""
        dropped = self.busy and not self._dropped
        self._dropped = True
        self._cancellation.cancel()
        return dropped

    def end(self) -> None:
        """Drop what is being planned, and wait until nothing goes on in the background."""
        self.drop()
        for thread in (self._thread, self._announcement):
            if thread is not None:
                # It would crash a process that ends, in the middle of CasADi.
                thread.join(_LONGEST_END)


def _fulfil(future: Future[_Outcome], work: Callable[[], _Outcome]) -> None:
    try:
        future.set_result(work())
    except BaseException as defect:
        # To be raised where it is seen: in the node's own thread.
        future.set_exception(defect)
