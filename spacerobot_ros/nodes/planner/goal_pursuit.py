"""What becomes of the goals of a planner: plans, flights, corrections, and how they end."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spacerobot_ros.errors import CommandError, ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.cdr import NANOSECONDS
from spacerobot_ros.nodes.common.measured_state import MeasuredState
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.planner.gait_flight import GaitFlight
from spacerobot_ros.nodes.planner.plan_topics import PlanTopics
from spacerobot_ros.nodes.planner.plan_work import Fly, PlanWork, Refuse
from spacerobot_ros.nodes.planner.status import PlannerState, PlannerStatus, what_is_left
from spacerobot_ros.parameters import configured
from spacerobot_ros.planning import GaitSchedule, Goal, PoseError, Tolerance
from spacerobot_ros.planning.core.goal import POSE
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE, GoalFile, IdentifiedGoal


class GoalPursuit:
    """Flies one robot to one goal after the other, and answers every state with a command.

    A plan is made while the states wait for their answers, which is right where time stands still
    for them; or in the background, from a robot that has come to rest.

    Parameters
    ----------
    node
        The planner; its parameters and its log are used.
    robot
        That flies.
    status, topics, memory
        Where states and plans are published, and the present goal is kept.
    """

    def __init__(
        self,
        node: FlightNode,
        robot: SpaceRobot,
        status: PlannerStatus,
        topics: PlanTopics,
        memory: GoalFile,
    ) -> None:
        values: Mapping[str, Any] = node.parameters
        self._values, self._logger, self._robot = values, node.get_logger(), robot
        self._status, self._plan_topics, self._memory = status, topics, memory
        tick_period = round(NANOSECONDS / values["tick_rate"]) / NANOSECONDS
        self._work = PlanWork(robot, values, tick_period, self._logger.info)
        self._state = MeasuredState(robot, values["averaging"], values["rest_tolerance"])
        self._flight = GaitFlight(robot, values, tick_period)
        self._goal: Goal | None = None
        self._pending = False
        self._corrections = 0
        self._landed: GaitSchedule | None = None
        """A schedule that has ended, and whose result is still to be judged."""
        self._previous: GaitSchedule | None = None
        """The schedule that was flown last for the present goal."""
        self._replanning = False
        """Whether the next plan takes the place of one that was broken off."""
        self._flown_time = 0.0
        """Simulated time that the schedules flown for the present goal take together, s."""
        self._ends_at = 0.0
        """Simulated time at which the present schedule ends, s."""
        self._stamp = 0

    @property
    def _tolerance(self) -> Tolerance:
        return configured(PlannerConfig, self._values).tolerance

    @property
    def plan_time(self) -> float:
        """Wall time that planning took for the present goal, s."""
        return self._work.plan_time

    @property
    def answers(self) -> int:
        """How many states were answered with a command."""
        return self._flight.answers

    @property
    def wants_pose(self) -> bool:
        """Whether the next state is planned from, or judged."""
        return self._pending or self._landed is not None

    def propose(self, goal: Goal) -> None:
        """Plan for a goal from the next state that is measured."""
        self._proposed = goal
        self._pending = True
        self._state.restart()

    def abort(self) -> str:
        """Give up the goal and come to rest; return what happens then, empty if nothing flew."""
        flying, planning = self._flight.flying, self._work.drop()
        message = "The joints rest." if planning or self._landed is not None else ""
        if flying:
            self._flight.break_off(self._stamp)
            message = (
                f"The joints come to rest along the gait within {self._values['abort_time']:g} s."
            )
        self._pending = False
        self._goal = self._landed = None
        return message

    def drop(self) -> None:
        """Forget the goal and what is flown and planned."""
        self._flight.drop()
        self._work.end()
        self._goal = self._landed = None

    def answer(self, stamp: int, q: Array, odom: bytes, joint_states: bytes, posed: bool) -> bytes:
        """Return the serialised command for one state, of the same stamp (ns).

        ``q`` (n,) are its joints, ``odom`` and ``joint_states`` its messages; ``posed``: they
        belong together.
        """
        self._stamp = stamp
        if self._flight.ended(stamp, q):
            self._land(arrived=self._goal is not None)
        if self._work.busy:
            self._work.poll()
        elif self._pending or self._landed is not None:
            if self._flight.flying and self._work.background:
                self._rest_first()
            elif posed:
                self.observe(odom, joint_states)
            self._decide()
        elif posed and self._flight.drift_due(stamp):
            self._look_for_drift(odom, joint_states)
        stuck = self._flight.follow(stamp, q)
        if stuck and self._goal is not None:
            self._go_on_without(stuck)
        return self._flight.answer(stamp, q)

    def observe(self, odom: bytes, joint_states: bytes) -> None:
        """Take a state to plan from, if one is; of a robot that moves only the last one counts."""
        if self.wants_pose:
            if self._flight.flying:
                self._state.restart()
            self._read(odom, joint_states)

    def _read(self, odom: bytes, joint_states: bytes) -> bool:
        """Add what is measured to the state; return whether it is a state of this robot."""
        try:
            self._state.read(odom, joint_states)
        except CommandError as error:
            self._logger.error(f"odom: {error}.", throttle_duration_sec=5.0)
            return False
        return True

    def _land(self, *, arrived: bool) -> None:
        """End what is flown; its result is judged unless it was broken off."""
        flown = self._flight.end(at_last_shape=arrived)
        if self._goal is not None:
            self._landed = flown
            self._state.restart()

    def _rest_first(self) -> None:
        """Come to rest along the gait: in the background a plan is made for where the robot is."""
        self._flight.break_off(self._stamp)
        self._replanning = True
        self._state.restart()

    def _decide(self) -> None:
        """Plan or judge when the state is known well enough."""
        if not (self._state.complete or (self._flight.flying and self._state.count)):
            return
        if self._pending:
            self._pending = False
            self._plan_proposed()
        if self._landed is not None and not self._work.busy:
            self._judge()
        self._state.restart()

    def _look_for_drift(self, odom: bytes, joint_states: bytes) -> None:
        """Plan what is left again when the base is too far off the path that was predicted."""
        assert self._goal is not None
        self._state.restart()
        left = self._corrections < self._values["max_corrections"]
        if not left or not self._read(odom, joint_states):
            return
        try:
            off = self._flight.drifted(self._state.state())
        except PlanningError as reason:
            self._logger.warning(f"The path is not known: {reason}")
            return
        if off:
            self._plan_rest(self._goal, off)

    def _plan_rest(self, goal: Goal, off: str) -> None:
        """Plan from where the robot is in flight: off its path, as ``off`` says."""

        def correct() -> None:
            self._corrections += 1
            self._logger.warning(f"{off}: the rest is planned again.")

        def fly(schedule: GaitSchedule) -> None:
            correct()
            self._fly(schedule)

        def go_on(reason: PlanningError) -> None:
            what = f"{off}, and the rest cannot be planned again: {reason}"
            self._logger.warning(what)

        if self._work.background:
            correct()
            self._rest_first()
        else:
            self._plan(goal, fly, go_on, correction=False)

    def _go_on_without(self, stuck: list[int]) -> None:
        """Come to rest, and plan what is left with the joints that are not stuck."""
        self._flight.stuck += stuck
        names = [self._robot.joint_names[i] for i in self._flight.stuck]
        assert self._previous is not None
        self._work.go_without(names, self._previous.controls & POSE)
        self._replanning = True
        self._land(arrived=False)
        self._logger.warning(f"Stuck: {', '.join(names)}. What is left is planned without.")

    def _plan_proposed(self) -> None:
        self._work.plan_time = self._flown_time = 0.0
        before, proposed = self._work.method, self._proposed
        self._work.use_all_joints()

        def fly(schedule: GaitSchedule) -> None:
            self._goal, self._landed = proposed, None
            try:
                self._memory.save({BASE: IdentifiedGoal(proposed)})
            except ParameterError as error:
                self._logger.error(f"{error} The goal is flown, but would not be resumed.")
            self._corrections, self._flight.stuck, self._replanning = 0, [], False
            self._fly(schedule)

        def refuse(reason: PlanningError) -> None:
            self._work.method = before
            flown = self._flight.flying or self._landed is not None
            kept = " The earlier goal is still flown." if flown else ""
            self._status.publish(PlannerState.REFUSED, f"{reason}{kept}", goal=proposed)

        self._plan(proposed, fly, refuse, correction=False)

    def _plan(self, goal: Goal, fly: Fly, refuse: Refuse, *, correction: bool) -> None:
        """Plan from the measured state; what is flown comes to rest along its gait first."""
        try:
            state = self._state.state()
        except PlanningError as reason:
            refuse(reason)
            return
        flown = self._flight.coming_to_rest(self._stamp)
        previous = self._previous if goal is self._goal else None
        self._work.begin(goal, state, fly, refuse, correction, previous, flown, self._stamp)

    def _fly(self, schedule: GaitSchedule, error: PoseError | None = None) -> None:
        stamp = self._stamp
        self._flight.begin(schedule, stamp)
        self._previous = schedule
        self._flown_time += schedule.duration
        self._ends_at = stamp / NANOSECONDS + schedule.duration
        self._status.publish(
            PlannerState.EXECUTING,
            f"Flying a {schedule.method} gait of {schedule.duration:.6g} s.",
            goal=schedule.goal,
            schedule=schedule,
            error=error,
            **self._account(),
        )
        description = self._robot.description
        self._work.announce(lambda: self._plan_topics.publish(description, schedule, stamp))

    def _account(self) -> dict[str, Any]:
        """Return what the present goal has cost so far, for the status."""
        return {
            "corrections": self._corrections,
            "flown_time": self._flown_time,
            "ends_at": self._ends_at,
        }

    def _judge(self) -> None:
        """Compare the measured pose with the goal; plan what is left, or be done."""
        assert self._goal is not None
        assert self._landed is not None
        flown, self._landed = self._landed, None
        replanned, self._replanning = self._replanning, False
        try:
            state = self._state.state()
        except PlanningError as reason:
            self._conclude(PlannerState.FAILED, str(reason), goal=self._goal)
            return
        error = PoseError.between(state.position, state.quaternion, self._goal, state.q)
        result: dict[str, Any] = {
            "goal": self._goal,
            "error": error,
            **self._account(),
        }
        left = what_is_left(error, flown.controls)
        if self._tolerance.admits(error, flown.controls):
            self._conclude(PlannerState.REACHED, f"The goal is met: {left}.", **result)
            return
        counts = not flown.partial and not replanned
        if counts and self._corrections >= self._values["max_corrections"]:
            missed = f"The goal is not met: {left} after {self._corrections} correction(s)."
            self._conclude(PlannerState.FAILED, missed, **result)
            return
        self._corrections += counts

        def fail(reason: PlanningError) -> None:
            missed = f"The goal is not met: {left}, and {reason}"
            self._conclude(PlannerState.FAILED, missed, **result)

        self._plan(
            self._goal,
            lambda schedule: self._fly(schedule, error),
            fail,
            correction=not replanned,
        )

    def _conclude(self, state: PlannerState, sentence: str, **values: Any) -> None:
        """Be done with the goal: nothing is to be resumed."""
        self._status.publish(state, sentence, **values)
        self._memory.delete()
