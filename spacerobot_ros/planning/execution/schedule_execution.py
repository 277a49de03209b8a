"""What becomes of schedules: a goal that is pursued, what is tracked for it, and how that ends."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import replace

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.goal import POSE, PoseError
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE, GoalFile, IdentifiedGoal
from spacerobot_ros.planning.execution.in_motion import InMotion
from spacerobot_ros.planning.execution.outputs import (
    Output,
    OutputQueue,
    Pursuit,
    ScheduleStart,
    Severity,
    gait_by,
)
from spacerobot_ros.planning.execution.plan_desk import PlanDesk, ReadyPlan
from spacerobot_ros.planning.execution.state_average import StateAverage
from spacerobot_ros.planning.execution.state_machine import Event, Phase, PlanReason, StateMachine
from spacerobot_ros.planning.execution.status import PlannerState, remaining_error
from spacerobot_ros.planning.execution.tracker import Setpoint, TrackingError, TrajectoryTracker
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.times import SECOND

_GAP, _GAP_PERIODS = 1.0, 10
"""Longest time between two states beyond which time has jumped: s, or control periods."""


class ScheduleExecution:
    """Executes schedules for a goal, and reports on it; what every executive does.

    Parameters are those of :class:`~spacerobot_ros.planning.execution.executive.Executive`.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        config: PlannerConfig,
        worker: PlanningWorker | None = None,
        goal_file: GoalFile | None = None,
    ) -> None:
        self._robot, self.config = robot, config
        """``config`` may be replaced: tolerances and corrections then apply from now on."""
        self._worker = worker or PlanningWorker(robot, config)
        self._file = goal_file or GoalFile("")
        self._average = StateAverage(robot, config.averaging, config.rest_tolerance)
        self._tracker = TrajectoryTracker(robot, config)
        self._machine = StateMachine()
        self._proposed: IdentifiedGoal | None = None
        """A goal that is to be planned for."""
        self._pursuit: Pursuit | None = None
        """The goal that is executed or evaluated."""
        self._out = OutputQueue()
        self._desk = PlanDesk(self._worker, self._out)
        self._in_motion = InMotion(self._tracker, self._worker)
        self._commands = 0
        self._commanded_from_ns = 0
        """Stamp of the first state that the present schedule or plan answers, ns."""
        self.plant_rests = False
        """Whether the plant reports that no command is in force, for the owner to set."""
        self._longest_gap = round(max(_GAP, _GAP_PERIODS * config.control_period) * SECOND)

    @property
    def phase(self) -> Phase:
        """What is being done."""
        return self._machine.phase

    @property
    def outputs(self) -> deque[Output]:
        """What is to be published and logged, in order; the node takes it out."""
        return self._out.waiting

    @property
    def _stamp_ns(self) -> int:
        return self._out.stamp_ns

    @property
    def setpoint(self) -> Setpoint:
        """What :meth:`update` returns every time; its arrays stay in place."""
        return self._tracker.setpoint

    def _was_obeyed(self, commanded_until_ns: int, rests_since_ns: int) -> bool:
        """Whether a plant has obeyed the present goal before it came to rest."""
        pursuit, since = self._pursuit, self._commanded_from_ns
        if pursuit is None or commanded_until_ns < pursuit.begins_ns:
            return False
        return commanded_until_ns >= since or rests_since_ns <= since

    def _correct_tracking(self, pursuit: Pursuit, error: TrackingError) -> None:
        self._count_correction(pursuit, f"{error}: the remaining motion is planned again.")
        self._out.notice(Severity.WARNING, f"{error}: the remaining motion is planned again.")

    def _count_correction(self, pursuit: Pursuit, sentence: str) -> None:
        pursuit.corrections += 1
        about = {"corrections": str(pursuit.corrections)}
        self._out.happened(EventKind.CORRECTION, sentence, pursuit.identified, 1, **about)

    def _go_on_for(self, identified: IdentifiedGoal, pursuit: Pursuit) -> None:
        """Pursue another goal with the same pose and shape by the present schedule."""
        self._proposed = None
        self._pursuit = replace(
            pursuit,
            identified=identified,
            corrections=0,
            manoeuvre_time=pursuit.ends_at - self._stamp_ns / SECOND,
        )
        self._accepted(self._pursuit)
        sentence = "The schedule that is executed leads to this goal, too."
        self._out.report(PlannerState.EXECUTING, sentence, identified, self._pursuit)

    def _switch(self, ready: ReadyPlan) -> None:
        """Track the plan that is there from its first tick on."""
        ticket, schedule, begins_ns = ready.ticket, ready.schedule, ready.take_over.stamp_ns
        self._desk.ready = None
        if ticket.reason.for_new_goal:
            self._accept(Pursuit(ticket.identified, schedule, begins_ns))
        reason = ticket.reason.value
        self._out.happened(
            EventKind.PLAN_TAKEN_OVER,
            f"A plan takes over in motion: {reason}.",
            ticket.identified,
            reason=reason,
            method=schedule.method,
            duration_s=f"{schedule.duration:.9g}",
        )
        self._execute(schedule, start_ns=begins_ns)

    def _plan_again_for(self, dropped: IdentifiedGoal | None) -> None:
        """Plan for a new goal whose plan was dropped, unless there is a newer one."""
        self._proposed = self._proposed or dropped

    def _phase_without_plan(self) -> Phase:
        """Return the next phase where there is no plan."""
        if self._tracker.active:
            return Phase.BRAKING if self._tracker.braking else Phase.EXECUTING
        return self._phase_at_rest()

    def _phase_at_rest(self) -> Phase:
        """Return the next phase when the joints have come to rest."""
        if self._proposed is not None:
            return Phase.MEASURING
        return Phase.IDLE if self._pursuit is None else Phase.EVALUATING

    def _accept(self, pursuit: Pursuit) -> None:
        """Pursue a new goal, with all joints."""
        self._pursuit, self._tracker.stuck = pursuit, []
        self._accepted(pursuit)

    def _accepted(self, pursuit: Pursuit) -> None:
        """Report that a goal is pursued, and save it."""
        self._out.happened(EventKind.GOAL_ACCEPTED, "The goal is accepted.", pursuit.identified)
        try:
            self._file.save({BASE: pursuit.identified})
        except ParameterError as error:
            sentence = f"{error} The goal is pursued, but would not be resumed."
            self._out.notice(Severity.ERROR, sentence)

    def _execute(
        self,
        schedule: GaitSchedule,
        remaining: PoseError | None = None,
        start_ns: int | None = None,
    ) -> None:
        """Track a schedule for the present goal.

        ``remaining`` is where it begins from, ``start_ns`` its first tick where it takes over.
        """
        pursuit = self._pursuit
        assert pursuit is not None
        begins = self._stamp_ns if start_ns is None else start_ns
        self._cut_off(pursuit, begins)
        pursuit.schedule = schedule
        average = self._in_motion.begin_schedule(self.config, schedule, begins)
        self._tracker.start(schedule, begins, average)
        self._commanded_from_ns = self._stamp_ns
        pursuit.manoeuvre_time += schedule.duration
        pursuit.ends_at = begins / SECOND + schedule.duration
        pursuit.next_plan = PlanReason.CONTINUATION if schedule.partial else PlanReason.CORRECTION
        if start_ns is None:
            self._go(Event.PLANNED, Phase.EXECUTING)
        else:
            self._go(Event.TAKEN_OVER, Phase.EXECUTING)
        from_where = "" if start_ns is None else ", which begins in motion"
        self._out.report(
            PlannerState.EXECUTING,
            f"Executing {gait_by(schedule.method)} of {schedule.duration:.6g} s{from_where}.",
            pursuit.identified,
            pursuit,
            remaining,
            schedule,
        )
        self.outputs.append(ScheduleStart(schedule, begins))

    @staticmethod
    def _cut_off(pursuit: Pursuit, stamp_ns: int) -> None:
        """Subtract the rest of the present schedule from the duration of the manoeuvre."""
        remainder = pursuit.ends_at - stamp_ns / SECOND
        if remainder > 0:
            pursuit.manoeuvre_time -= min(remainder, pursuit.schedule.duration)
            pursuit.ends_at = stamp_ns / SECOND

    def _on_end(self, stamp_ns: int) -> None:
        """End the schedule; its result is evaluated unless its goal was cancelled."""
        ready = self._desk.ready
        if ready is not None:
            # No state was measured since the tick at which it takes over.
            self._switch(ready)
            if not self._tracker.ended(stamp_ns, ready.schedule.positions[-1]):
                return
        self._plan_again_for(self._desk.drop())
        at_rest = self.phase is Phase.BRAKING
        self._tracker.stop(at_last_shape=not at_rest)
        self._average.restart()
        self._go(Event.AT_REST if at_rest else Event.SCHEDULE_ENDED, self._phase_at_rest())

    def _on_time_jump(self, stamp_ns: int) -> None:
        """Plan the remaining motion where the schedule does not cover the present time."""
        if self._tracker.covers(stamp_ns):
            return
        self._plan_again_for(self._desk.drop())
        self._tracker.stop()
        self._average.restart()
        if self._pursuit is not None:
            self._pursuit.next_plan = PlanReason.REPLAN
        self._go(Event.TIME_JUMPED, self._phase_at_rest())
        before, now = self._stamp_ns / SECOND, stamp_ns / SECOND
        self._out.notice(
            Severity.WARNING,
            f"The time of the states has jumped from {before:.9g} s to {now:.9g} s, where no "
            "motion is planned.",
        )

    def _on_stuck(self, stuck: Sequence[int]) -> None:
        """Stop, and plan the remaining motion with the joints that are not stuck."""
        pursuit, tracker = self._pursuit, self._tracker
        assert pursuit is not None
        tracker.stuck += stuck
        self._plan_again_for(self._desk.drop())
        tracker.stop()
        self._cut_off(pursuit, self._stamp_ns)
        pursuit.stuck_at = None
        pursuit.required = pursuit.schedule.controls & POSE
        pursuit.next_plan = PlanReason.STUCK_JOINTS
        self._average.restart()
        self._go(Event.JOINTS_STUCK, self._phase_at_rest())
        names = ", ".join(self._robot.joint_names[i] for i in tracker.stuck)
        sentence = f"Stuck: {names}. The remaining motion is planned without."
        self._out.notice(Severity.WARNING, sentence)
        joints = {"joints": names}
        self._out.happened(EventKind.STUCK_JOINT, sentence, pursuit.identified, 1, **joints)

    def _fail(self, remaining: PoseError, why: str, event: Event) -> None:
        """Report that the present goal is not reached; ``why`` ends the sentence."""
        pursuit = self._pursuit
        assert pursuit is not None
        where = remaining_error(remaining, pursuit.schedule.controls)
        sentence = f"The goal is not reached: {where}{why}"
        self._out.report(PlannerState.FAILED, sentence, pursuit.identified, pursuit, remaining)
        self._forget_pursuit(event)

    def _forget_pursuit(self, event: Event) -> None:
        """Be done with the present goal: nothing is to be resumed."""
        self._file.delete()
        self._pursuit = None
        self._go(event, self._phase_at_rest())

    def _go(self, event: Event, target: Phase) -> None:
        """Change the phase; no other method does."""
        self.outputs.append(self._machine.go(event, target))

    def _goal_id(self) -> str:
        """Return the id of the latest goal, empty where there is none."""
        if self._proposed is not None:
            return self._proposed.goal_id
        current = self._desk.current or self._pursuit
        return "" if current is None else current.identified.goal_id
