"""What becomes of the goals of a planner: an explicit state machine, free of ROS.

A node gives it goals (:meth:`Executive.propose`) and measured states (:meth:`Executive.update`),
and gets a setpoint for every state and outputs to publish (:attr:`Executive.outputs`).
"""

from __future__ import annotations

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.events import EventKind
from spacerobot_ros.planning.core.goal import PoseError, RobotState
from spacerobot_ros.planning.execution.goal_file import IdentifiedGoal
from spacerobot_ros.planning.execution.in_motion import same_goal
from spacerobot_ros.planning.execution.outputs import Pursuit, Severity
from spacerobot_ros.planning.execution.plan_desk import ReadyPlan, Ticket
from spacerobot_ros.planning.execution.schedule_execution import ScheduleExecution
from spacerobot_ros.planning.execution.state_average import MeasuredState
from spacerobot_ros.planning.execution.state_machine import Event, Phase, PlanReason
from spacerobot_ros.planning.execution.status import (
    PlannerState,
    PlannerStatistics,
    PlannerStatus,
    remaining_error,
)
from spacerobot_ros.planning.execution.take_over import TakeOver
from spacerobot_ros.planning.execution.tracker import Setpoint
from spacerobot_ros.planning.execution.worker import Braking, Planned, Refused

# Python looks up the member of an enum as slowly as it calls a function; these are for every state.
_EXECUTING, _EVALUATING = Phase.EXECUTING, Phase.EVALUATING


class Executive(ScheduleExecution):
    """Brings one robot to one goal after the other, and answers every state with a setpoint.

    With a worker that plans at once, the measured state waits for its plan, and a plan that is
    requested while the joints move begins with their braking. With one that plans in the
    background, the joints brake to rest before a plan is requested, and hold their shape until it
    is there. Where the method allows for it, neither happens: a plan takes over in motion, at a
    tick ahead (:mod:`.in_motion`).

    Parameters
    ----------
    robot
        The model.
    config
        Of the planner.
    worker
        Makes the plans; None: a :class:`PlanningWorker`.
    goal_file
        Where the present goal is saved; None: nowhere.

    Raises
    ------
    ParameterError
        An option of the gait method does not go with the robot or with another option.
    """

    @property
    def measuring(self) -> bool:
        """Whether a base that is measured now will be planned from, or evaluated."""
        return self._proposed is not None or self._machine.phase is _EVALUATING

    @property
    def statistics(self) -> PlannerStatistics:
        """What was done so far."""
        return PlannerStatistics(self._desk.plan_time, self._desk.plans, self._commands)

    # -- what comes from outside --------------------------------------------------------------

    def propose(self, identified: IdentifiedGoal) -> None:
        """Plan for a goal from the states that are measured next; it replaces any other."""
        self._proposed = identified
        self._in_motion.begin_goal()
        self._average.restart()
        match self.phase:
            case Phase.IDLE | Phase.MEASURING | Phase.EVALUATING:
                self._go(Event.NEW_GOAL, Phase.MEASURING)
            case Phase.REPLANNING | Phase.TAKING_OVER:
                self._desk.drop()
                self._go(Event.NEW_GOAL, Phase.EXECUTING)

    def abort(self) -> str | None:
        """Give up all goals and come to rest.

        Returns what the joints do then, as a sentence; None where nothing was done for any goal.
        """
        goal_id, sentence = self._goal_id(), "The joints rest."
        self._file.delete()
        match self.phase:
            case Phase.IDLE:
                return None
            case Phase.EXECUTING | Phase.REPLANNING | Phase.TAKING_OVER | Phase.BRAKING:
                self._desk.drop()
                self._tracker.brake(self._stamp_ns)
                duration = self.config.abort_time
                sentence = f"The joints brake along the planned path within {duration:g} s."
                self._go(Event.ABORTED, Phase.BRAKING)
            case Phase.MEASURING | Phase.PLANNING | Phase.EVALUATING:
                waits_only = self.phase is Phase.MEASURING and self._pursuit is None
                self._go(Event.ABORTED, Phase.IDLE)
                if waits_only:
                    self._proposed = None
                    return None
                self._desk.drop()
        self._proposed = self._pursuit = None
        self.outputs.append(
            PlannerStatus(PlannerState.ABORTED, f"Aborted on request. {sentence}", goal_id=goal_id)
        )
        return sentence

    def plant_stopped(
        self, why: str, commanded_until_ns: int | None = None, rests_since_ns: int = 0
    ) -> bool:
        """Give up every goal at once: the plant does not obey commands any more.

        The goal file is deleted, and nothing is tracked or planned until there is a new goal.

        Parameters
        ----------
        why
            The sentence of the plant; it becomes part of the status.
        commanded_until_ns
            For a plant that rests because commands did not come: the stamp of the last one that it
            had. None: it obeys nothing.
        rests_since_ns
            Since when it rests then, ns. A goal goes on for which nothing was commanded until then,
            and one whose plan has taken so long that no state was answered.

        Returns
        -------
        bool
            Whether a goal was given up.
        """
        if commanded_until_ns is not None and not self._was_obeyed(
            commanded_until_ns, rests_since_ns
        ):
            return False
        self._file.delete()
        if self.phase is Phase.IDLE:
            return False
        goal_id, pursued = self._goal_id(), self._proposed or self._desk.current or self._pursuit
        self._tracker.stop()
        self._desk.drop()
        self._average.restart()
        self._proposed = self._pursuit = None
        self._go(Event.PLANT_STOPPED, Phase.IDLE)
        if pursued is None:
            return False
        sentence = f"Aborted by the plant: {why}"
        self.outputs.append(PlannerStatus(PlannerState.ABORTED, sentence, goal_id=goal_id))
        return True

    def plant_reset(self) -> None:
        """Plan again for the present goal, if any: the robot is in another state than before."""
        self._average.forget()
        # The shape that is held is one of before, like the schedule.
        self._tracker.stop()
        if self._pursuit is not None:
            self._pursuit.next_plan = PlanReason.REPLAN
        if self.phase in (Phase.IDLE, Phase.MEASURING, Phase.EVALUATING):
            return
        # What is planned begins at a state that is gone.
        self._plan_again_for(self._desk.drop())
        self._go(Event.PLANT_RESET, self._phase_at_rest())
        self._out.notice(Severity.WARNING, "The plant was reset: the motion is planned again.")

    def cancel_plan(self) -> None:
        """Have a plan that is being made end without a result; may be called in any thread."""
        self._worker.cancel()

    def stop(self) -> None:
        """Give up everything at once and wait for the worker to end; the goal file stays."""
        self._tracker.stop()
        self._desk.drop()
        self._worker.close()
        self._proposed = self._pursuit = None
        self._go(Event.DEACTIVATED, Phase.IDLE)

    def observe(self, measured: MeasuredState) -> None:
        """Take note of a base that was measured for a state after it was answered."""
        if self.measuring:
            if self._tracker.active:
                # Of a robot that moves only the last state counts.
                self._average.restart()
            self._add(measured)

    def update(self, measured: MeasuredState) -> Setpoint:
        """Return the setpoint for a measured state; see :attr:`setpoint`."""
        stamp, q, tracker = measured.stamp_ns, measured.q, self._tracker
        if not 0 <= stamp - self._stamp_ns <= self._longest_gap and tracker.active:
            self._on_time_jump(stamp)
        self._out.stamp_ns = stamp
        if tracker.ended(stamp, q):
            self._on_end(stamp)
        phase = self._machine.phase
        # In most states a schedule is tracked, and nothing else is to be done.
        if phase is not _EXECUTING or self._proposed is not None or tracker.check_due(stamp):
            self._act(phase, measured)
        if tracker.active:
            stuck = tracker.track(stamp, q, obeyed=not self.plant_rests)
            if stuck and self._pursuit is not None:
                self._on_stuck(stuck)
        if not tracker.active:
            tracker.hold(q, obeyed=not self.plant_rests)
        self._commands += 1
        return tracker.setpoint

    def _act(self, phase: Phase, measured: MeasuredState) -> None:
        """Do the work of a phase beside tracking."""
        match phase:
            case Phase.MEASURING | Phase.EVALUATING:
                self._measure_at_rest(measured)
            case Phase.PLANNING:
                self._take_result()
            case Phase.REPLANNING | Phase.TAKING_OVER:
                self._await_take_over()
            case Phase.EXECUTING | Phase.BRAKING if self._proposed is not None:
                self._measure_in_motion(measured)
            case Phase.EXECUTING:
                self._check_tracking(measured)

    # -- measuring ----------------------------------------------------------------------------

    def _add(self, measured: MeasuredState) -> bool:
        """Add a state to the average; return whether its base was measured."""
        base = measured.base()
        if base is None:
            return False
        self._average.add(base.pose, base.twist, measured.q, base.qdot)
        return True

    def _measure_at_rest(self, measured: MeasuredState) -> None:
        """Plan for a new goal, or evaluate the present one, once the state is known."""
        if self._worker.busy:
            # A plan that was cancelled has yet to end: it uses the functions of the robot.
            self._worker.poll()
            return
        self._add(measured)
        if not self._average.complete:
            return
        if self.phase is Phase.MEASURING:
            self._plan_for_new_goal()
        # Where that was refused the state is still known, unless it took time.
        if self.phase is Phase.EVALUATING:
            self._evaluate()
        self._average.restart()

    def _measure_in_motion(self, measured: MeasuredState) -> None:
        """Plan for a new goal from the state now, or from rest if the plan will take time.

        A plan takes over in motion where the methods allow for it.
        """
        take_over = None
        if self.phase is Phase.EXECUTING and not self.plant_rests:
            take_over = self._in_motion.take_over(
                self.config, self._pursuit, self._stamp_ns, measured.q
            )
        if take_over is None and self._worker.background:
            if self.phase is Phase.EXECUTING:
                self._brake_for_replan(Event.NEW_GOAL)
            return
        if not self._desk.free():
            return
        base = measured.base()
        if base is not None:
            self._average.restart()
            self._average.add(base.pose, base.twist, measured.q, base.qdot)
        if not self._average.count:
            return
        if take_over is None:
            self._plan_for_new_goal()
        else:
            self._plan_in_motion(take_over)
        self._average.restart()

    def _check_tracking(self, measured: MeasuredState) -> None:
        """Plan again when the base is too far off the path that was predicted, or in time."""
        pursuit = self._pursuit
        assert pursuit is not None
        self._average.restart()
        corrected = pursuit.corrections >= self.config.max_corrections
        if not self._desk.free():
            return
        if corrected and (self.plant_rests or not self._in_motion.replans(self.config, pursuit)):
            return
        if not self._add(measured):
            return
        try:
            state = self._average.state()
        except PlanningError as reason:
            self._out.notice(Severity.WARNING, f"The path is not known: {reason}")
            return
        error = None if corrected else self._tracker.error(state)
        if error is None:
            self._plan_remaining(pursuit, state)
        elif self._worker.background:
            self._correct_tracking(pursuit, error)
            self._brake_for_replan(Event.TRACKING_ERROR)
        else:
            ticket = Ticket(pursuit.identified, PlanReason.TRACKING_ERROR, tracking_error=error)
            self._request(ticket, state)

    # -- planning in motion -------------------------------------------------------------------

    def _plan_in_motion(self, take_over: TakeOver) -> None:
        """Have a plan made for the new goal that takes over without a stop."""
        identified, pursuit = self._proposed, self._pursuit
        assert identified is not None
        assert pursuit is not None
        if same_goal(identified.goal, pursuit.identified.goal):
            self._go_on_for(identified, pursuit)
            return
        averages = self.config.averaging > 1
        if averages and not self._tracker.check_due(self._stamp_ns):
            return
        try:
            state = self._average.state()
        except PlanningError:
            # The next state may be better; if none is, the schedule ends.
            return
        if averages:
            state = self._tracker.averaged(state)
        self._proposed = None
        self._desk.begin_goal()
        self._request(Ticket(identified, PlanReason.IN_MOTION, take_over=take_over), state)

    def _plan_remaining(self, pursuit: Pursuit, state: RobotState) -> None:
        """Have the remaining motion planned again from a state that is due, if it is time."""
        if self.plant_rests:
            return
        found = self._in_motion.remaining(self.config, pursuit, self._stamp_ns, state)
        if found is not None:
            ticket = Ticket(
                pursuit.identified,
                PlanReason.SHRINKING_HORIZON,
                take_over=found.take_over,
                aim=found.aim,
            )
            self._request(ticket, found.state)

    def _await_take_over(self) -> None:
        """Take the plan that is made in motion, and have it take over at its tick."""
        if self.phase is Phase.REPLANNING:
            self._take_result()
        ready, ticket = self._desk.ready, self._desk.ticket
        if ready is not None and self._stamp_ns >= ready.take_over.stamp_ns:
            self._switch(ready)
        elif ticket is not None and ticket.is_late(self._stamp_ns):
            self._on_late(ticket)

    def _on_late(self, ticket: Ticket) -> None:
        """Go on along the schedule of now: a new goal is planned for once more."""
        self._plan_again_for(self._desk.drop())
        if ticket.reason.for_new_goal:
            self._in_motion.attempt_failed()
        self._go(Event.PLAN_LATE, Phase.EXECUTING)
        sentence = "The plan was not ready when it was to take over."
        self._out.notice(Severity.WARNING, sentence)
        reason = ticket.reason.value
        self._out.happened(EventKind.PLAN_LATE, sentence, ticket.identified, 1, reason=reason)

    # -- planning -----------------------------------------------------------------------------

    def _plan_for_new_goal(self) -> None:
        assert self._proposed is not None
        reason = PlanReason.BLEND if self._tracker.active else PlanReason.NEW_GOAL
        ticket = Ticket(self._proposed, reason)
        self._proposed = None
        self._desk.begin_goal()
        try:
            state = self._average.state()
        except PlanningError as refusal:
            self._go(Event.PLAN_REQUESTED, Phase.PLANNING)
            self._conclude_plan(ticket, Refused(str(refusal)))
        else:
            self._request(ticket, state)

    def _request(self, ticket: Ticket, state: RobotState) -> None:
        """Request a plan from a measured state; unless it is to take over, the joints brake."""
        pursuit, braking = None if ticket.reason.for_new_goal else self._pursuit, None
        if pursuit is not None and pursuit.stuck_at is None:
            names = self._robot.joint_names
            pursuit.stuck_at = {names[i]: float(state.q[i]) for i in self._tracker.stuck}
        if ticket.take_over is not None:
            self._go(Event.PLAN_REQUESTED, Phase.REPLANNING)
        else:
            follower = self._tracker.braked(self._stamp_ns)
            braking = None if follower is None else Braking(follower, self._stamp_ns)
            self._commanded_from_ns = self._stamp_ns
            self._go(Event.PLAN_REQUESTED, Phase.PLANNING)
        self._desk.request(ticket, state, self.config.tolerance, pursuit, braking)
        self._take_result()

    def _take_result(self) -> None:
        """Act on the result of the plan that is being made, if it is there."""
        taken = self._desk.take()
        if taken is not None:
            self._conclude_plan(*taken)

    def _conclude_plan(self, ticket: Ticket, result: Planned | Refused) -> None:
        """Execute a plan, or report why there is none, depending on the reason of the request."""
        pursuit = self._pursuit
        match ticket.reason, result:
            case PlanReason.IN_MOTION | PlanReason.SHRINKING_HORIZON, Planned(schedule=schedule):
                assert ticket.take_over is not None
                self._desk.ready = ReadyPlan(ticket, ticket.take_over, schedule)
                self._go(Event.PLANNED, Phase.TAKING_OVER)
            case PlanReason.IN_MOTION, Refused(reason=reason):
                self._plan_again_for(ticket.identified)
                self._in_motion.attempt_failed()
                again = "from a later tick" if self._in_motion.tries_again else "from rest"
                sentence = f"No plan begins in motion, so the goal is planned for {again}: {reason}"
                self._out.notice(Severity.WARNING, sentence)
                self._go(Event.REFUSED, Phase.EXECUTING)
            case PlanReason.SHRINKING_HORIZON, Refused(reason=reason):
                sentence = f"The remaining motion is not planned again: {reason}"
                self._out.notice(Severity.INFO, sentence)
                self._go(Event.REFUSED, Phase.EXECUTING)
            case PlanReason.NEW_GOAL | PlanReason.BLEND, Planned(schedule=schedule):
                self._accept(Pursuit(ticket.identified, schedule, self._stamp_ns))
                self._execute(schedule)
            case PlanReason.NEW_GOAL | PlanReason.BLEND, Refused(reason=reason):
                earlier = " The earlier goal is still pursued." if pursuit is not None else ""
                self._out.report(PlannerState.REFUSED, f"{reason}{earlier}", ticket.identified)
                self._go(Event.REFUSED, self._phase_without_plan())
            case PlanReason.TRACKING_ERROR, Planned(schedule=schedule):
                assert pursuit is not None
                assert ticket.tracking_error is not None
                self._correct_tracking(pursuit, ticket.tracking_error)
                self._execute(schedule)
            case PlanReason.TRACKING_ERROR, Refused(reason=reason):
                self._out.notice(
                    Severity.WARNING,
                    f"{ticket.tracking_error}, and the remaining motion cannot be planned again: "
                    f"{reason}",
                )
                self._go(Event.REFUSED, self._phase_without_plan())
            # CORRECTION, CONTINUATION, REPLAN, STUCK_JOINTS: what remains after a schedule.
            case _, Planned(schedule=schedule):
                self._execute(schedule, ticket.remaining)
            case _, Refused(reason=reason):
                assert ticket.remaining is not None
                self._fail(ticket.remaining, f", and {reason}", Event.REFUSED)

    def _brake_for_replan(self, event: Event) -> None:
        """Come to rest along the planned path: in the background plans are made from rest."""
        assert self._pursuit is not None
        self._pursuit.next_plan = PlanReason.REPLAN
        self._tracker.brake(self._stamp_ns)
        self._average.restart()
        self._go(event, Phase.BRAKING)

    # -- evaluating ---------------------------------------------------------------------------

    def _evaluate(self) -> None:
        """Compare the measured pose with the goal; plan the remaining motion, or be done."""
        pursuit = self._pursuit
        assert pursuit is not None
        goal, controls = pursuit.identified.goal, pursuit.schedule.controls
        try:
            state = self._average.state()
        except PlanningError as reason:
            self._out.report(PlannerState.FAILED, str(reason), pursuit.identified)
            self._forget_pursuit(Event.FAILED)
            return
        error = PoseError.between(state.position, state.quaternion, goal, state.q)
        if self.config.tolerance.admits(error, controls):
            sentence = f"The goal is reached: {remaining_error(error, controls)}."
            self._out.report(PlannerState.REACHED, sentence, pursuit.identified, pursuit, error)
            self._forget_pursuit(Event.REACHED)
            return
        if pursuit.next_plan is PlanReason.CORRECTION:
            if pursuit.corrections >= self.config.max_corrections:
                self._fail(error, f" after {pursuit.corrections} correction(s).", Event.FAILED)
                return
            left = remaining_error(error, controls)
            self._count_correction(pursuit, f"The remaining motion is planned: {left}.")
        self._request(Ticket(pursuit.identified, pursuit.next_plan, remaining=error), state)
