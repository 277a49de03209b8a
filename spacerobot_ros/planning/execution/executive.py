"""Planner state machine: from goals and measured states to setpoints, without ROS.

:meth:`Executive.update` is called for every measured state. ``docs/planner_state_machine.md`` lists
the phases, the events that change them, and the table of all transitions.

Other modules do the work of the phases: :mod:`.tracker` computes the commands along a schedule,
:mod:`.worker` makes plans, and :mod:`.measured_states` averages measured states and compares the
measured base with its predicted path.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace

from spacerobot_ros.errors import PlanningError, counted, quantity, sentence_case
from spacerobot_ros.events import Event as FlightEvent
from spacerobot_ros.events import EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning.core.goal import Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.planning.core.schedule import GaitSchedule
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, IdentifiedGoal, PursuedGoals
from spacerobot_ros.planning.execution.measured_states import MeasuredState, StateAverage
from spacerobot_ros.planning.execution.status import (
    ActiveGoal,
    Event,
    LogLevel,
    Notice,
    Output,
    Phase,
    PlannerState,
    PlannerStatistics,
    PlannerStatus,
    PlanReason,
    ScheduleStart,
    Transition,
    describe_remaining_error,
)
from spacerobot_ros.planning.execution.teleoperation import Teleoperation, TwistCommand
from spacerobot_ros.planning.execution.tracker import Setpoint, TakeOver, TrajectoryTracker
from spacerobot_ros.planning.execution.worker import PlanJob, PlanningTask, PlanningWorker, Refused
from spacerobot_ros.times import SECOND

_MAX_IN_MOTION_ATTEMPTS = 2
"""Largest number of plans per goal that take over in motion, each after twice the delay."""


class Executive:
    """Moves a robot to successive goals, and computes a setpoint for every state.

    If the worker plans synchronously, the measured state is held until the plan is made, and a plan
    requested while the joints move begins with braking. If it plans in the background, the joints
    brake to rest before a plan is requested, and hold their shape until the plan is available. If
    the methods of the current and the new schedule allow it, no braking is needed: the new plan
    takes over in motion at a later tick. This tick depends on parameters and on the request's
    stamp, not on the planning time.
    """

    def __init__(self, robot: SpaceRobot, config: PlannerConfig, worker: PlanningWorker) -> None:
        self._robot, self.config, self._worker = robot, config, worker
        self._average = StateAverage(robot, config.averaging, config.rest_tolerance)
        self._tracker = TrajectoryTracker(robot, config)
        self.phase = Phase.IDLE
        """The current phase; changed only by :meth:`_change_phase`."""
        self.outputs: deque[Output] = deque()
        """Outputs to publish and log, in order; the owner removes published outputs."""
        self.plant_rests = False
        """Whether the plant reports that no command is in effect, as set by the owner."""
        self._stamp_ns = 0
        """Stamp of the state being processed by :meth:`update`, ns."""
        self._new_goal: IdentifiedGoal | None = None
        self._in_motion_attempts = 0
        self._job: PlanJob | None = None
        """The requested plan."""
        self._ready_plan: GaitSchedule | None = None
        """The plan from the job, until the tick at which it takes over (``TAKING_OVER``)."""
        self._active_goal: ActiveGoal | None = None
        self._replan_ns = 0
        """Stamp from which the remaining motion is replanned, ns."""
        self._commanded_from_ns = 0
        """Stamp of the first state of the current schedule or plan, ns."""
        self.statistics = PlannerStatistics()
        """Planning time and number of plans for the latest goal, and the number of commands."""
        self._teleoperation = Teleoperation(robot, config, worker.clearance)

    @property
    def setpoint(self) -> Setpoint:
        """The return value of every :meth:`update`; its arrays are reused."""
        return self._tracker.setpoint

    @property
    def measuring(self) -> bool:
        """Whether the executive will use the next measured base state to plan or evaluate."""
        return self._new_goal is not None or self.phase in (Phase.EVALUATING, Phase.TELEOPERATING)

    # -- requests of the owner ----------------------------------------------------------------

    def propose_goal(self, identified: IdentifiedGoal) -> None:
        """Plan for a goal from the next measured states; this goal replaces any other goal."""
        self._new_goal, self._in_motion_attempts = identified, 0
        self._average.restart()
        match self.phase:
            case Phase.IDLE | Phase.MEASURING | Phase.EVALUATING:
                self._change_phase(Event.NEW_GOAL, Phase.MEASURING)
            case Phase.REPLANNING | Phase.TAKING_OVER:
                self._drop_plan()
                self._change_phase(Event.NEW_GOAL, Phase.EXECUTING)

    def propose_twist(self, twist: TwistCommand) -> None:
        """Make an end-effector follow a twist from the next state on, until no more twists arrive.

        Raises
        ------
        PlanningError
            A goal is being pursued, or the twist is rejected by :class:`Teleoperation`.
        """
        if self.phase not in (Phase.IDLE, Phase.TELEOPERATING) or self._new_goal is not None:
            self._teleoperation.refuse(self._stamp_ns)
            raise PlanningError(
                "Twists are not followed while a goal is pursued: abort the goal first."
            )
        self._teleoperation.receive(twist, self._stamp_ns)
        if self.phase is Phase.IDLE:
            self._change_phase(Event.TWIST, Phase.TELEOPERATING)

    @property
    def unfinished_goals(self) -> frozenset[str]:
        """Ids of goals being pursued, being planned, or waiting for a plan."""
        return frozenset(goal.goal_id for goal in self._goals if goal is not None)

    @property
    def waiting_goals(self) -> frozenset[str]:
        """Ids of goals being planned or waiting for a plan, including a goal being replanned."""
        return frozenset(goal.goal_id for goal in self._goals[:2] if goal is not None)

    def progress(self, goal_id: str) -> tuple[str, float | None]:
        """Return the activity for a goal, and the expected time, s, until the goal is reached.

        None if no schedule leads to the goal yet.
        """
        active, job = self._active_goal, self._job
        if active is not None and active.identified.goal_id == goal_id:
            left = max(0.0, active.time_left(self._stamp_ns))
            return self.phase.value, left + active.schedule.remaining
        if job is not None and job.identified.goal_id == goal_id:
            return Phase.PLANNING.value, None
        return Phase.MEASURING.value, None

    def abort(self, why: str = "on request") -> str | None:
        """Abort all goals and come to rest.

        Returns a message about the joints; None if there is no goal.
        """
        latest, message = self._latest_goal, "The joints rest."
        match self.phase:
            case Phase.IDLE:
                return None
            case Phase.TELEOPERATING:
                self._new_goal = None
                self._teleoperation.abort(self._stamp_ns)
                message = "The joints brake."
                aborted = PlannerStatus(PlannerState.TELEOPERATING, f"Aborted {why}. {message}")
                self.outputs.append(aborted)
                return message
            case Phase.MEASURING | Phase.PLANNING | Phase.EVALUATING:
                self._change_phase(Event.ABORTED, Phase.IDLE)
            case Phase.EXECUTING | Phase.REPLANNING | Phase.TAKING_OVER | Phase.BRAKING:
                self._tracker.brake(self._stamp_ns)
                duration = self.config.abort_time
                message = f"The joints brake along the planned path within {duration:g} s."
                if self.config.output == "trajectory":
                    message = f"The joint controller has {duration:g} s to bring them to rest."
                self._change_phase(Event.ABORTED, Phase.BRAKING)
        self._forget_goals()
        self._add_abort(f"Aborted {why}. {message}", latest)
        return message

    def plant_stopped(self, why: str) -> None:
        """Abort all goals immediately, because the plant no longer accepts commands."""
        if self.phase is Phase.IDLE:
            return
        given_up = self._latest_goal
        self._forget_goals()
        self._stop_motion(Event.PLANT_STOPPED)
        if given_up is not None:
            self._add_abort(f"Aborted by the plant: {why}", given_up)

    def plant_rested(self, commanded_until_ns: int, since_ns: int) -> None:
        """Replan the motion for the current goal, because the plant brought the joints to rest
        after the command of ``commanded_until_ns``.

        Motions continue if they began later, or if their planning took so long that no state was
        processed.
        """
        active = self._active_goal
        if active is None or commanded_until_ns < active.begins_ns:
            return
        if commanded_until_ns >= self._commanded_from_ns:
            concerned = self._tracker.is_active
        else:
            concerned = since_ns <= self._commanded_from_ns
        if concerned:
            self._tracker.stuck = []  # The plant stopped joints that may be free.
            self._plan_again(
                "The joints were brought to rest, because no command arrived in time: the motion "
                "is replanned."
            )

    def schedule_ended(self, why: str = "", *, final: bool = False) -> None:
        """End the schedule at the next state, because the robot's own controller has ended it.

        The measured state is compared with the goal, as after any schedule, and the remaining
        motion is planned again; ``final``: there are no further plans. ``why`` is a clause with the
        reason for an early end; empty: the schedule was completed.
        """
        active = self._active_goal
        if active is None:
            return
        if final:
            active.not_flown_reason = why
        elif why:
            self._add_notice("warning", f"{sentence_case(why)}.")
        self._tracker.end_by_result()

    def configure(self, config: PlannerConfig) -> None:
        """Use new tolerances and correction settings from now on."""
        self.config = config

    def on_plant_obeying(self) -> None:
        """Do nothing: the next goal starts from the measured state anyway."""

    def plant_reset(self) -> None:
        """Replan for the current goal, if any, because the robot state has changed."""
        self._plan_again("The plant was reset: the motion is replanned from the initial state.")

    def use_robot(
        self, robot: SpaceRobot, worker: PlanningWorker, config: PlannerConfig | None = None
    ) -> None:
        """Plan again for the current goal, if any, with another worker.

        Either the robot has different mass properties, or ``config`` has a different plant rate.
        """
        if config is None:
            what = "The robot has a different mass now: the motion is replanned."
        elif self.config.tick_rate:
            what = "The plant has a different rate now: the motion is replanned."
        else:
            what = "The plant's rate is known: the motion is planned."
        self._plan_again(what)
        self._worker.close()
        self._robot, self._worker = robot, worker
        self._average = StateAverage(robot, self.config.averaging, self.config.rest_tolerance)
        if config is None:
            self._tracker.use_robot(robot)
        else:
            self.config, self._tracker = config, TrajectoryTracker(robot, config)
        self._teleoperation = Teleoperation(robot, self.config, worker.clearance)

    def plan_at_once(self) -> None:
        """From now on, let states wait during planning, because the plant runs in lockstep."""
        self.config = replace(self.config, plan_in_background=False)
        self._worker.plans_in_background = False

    def use_obstacles(self, make_worker: Callable[[], PlanningWorker]) -> None:
        """Plan around new obstacles from now on.

        A plan in progress is restarted. If the rest of the current schedule comes too close to
        obstacles, the joints brake, and the remaining motion is planned again. ``make_worker``
        returns the worker that avoids these obstacles, and is called when no plan is in progress.
        """
        self._drop_plan()
        self._worker.close()
        self._worker = make_worker()
        self._teleoperation.use_clearance(self._worker.clearance)
        active = self._active_goal
        match self.phase:
            case Phase.PLANNING:
                if active is not None:
                    active.next_plan = PlanReason.REPLAN
                self._average.restart()
                self._change_phase(Event.OBSTACLES, self._phase_at_rest())
            case Phase.REPLANNING | Phase.TAKING_OVER:
                self._change_phase(Event.OBSTACLES, Phase.EXECUTING)
        if self.phase is Phase.EXECUTING and active is not None:
            begins = active.ends_at - active.schedule.duration
            clause = self._worker.approach_ahead(active.schedule, begins, self._stamp_ns / SECOND)
            if clause:
                message = (
                    f"{sentence_case(clause)}: the joints brake, and the remaining motion is "
                    "replanned."
                )
                self._add_notice("warning", message)
                self.outputs.append(active.status(PlannerState.EXECUTING, message))
                self._brake_for_replan(Event.OBSTACLES)

    def _plan_again(self, message: str) -> None:
        self._average.forget()
        if self.phase is Phase.TELEOPERATING:
            self._end_teleoperation(
                Event.PLANT_RESET, "The plant was reset: the joints are at rest."
            )
        # The held shape and the schedule belong to the time before the reset.
        self._tracker.stop()
        self._tracker.forget_wheels()
        active = self._active_goal
        if active is not None:
            active.next_plan = PlanReason.REPLAN
        if self.phase not in (Phase.IDLE, Phase.MEASURING, Phase.EVALUATING):
            self._drop_plan()
            self._change_phase(Event.PLANT_RESET, self._phase_at_rest())
        about = PlannerState.PLANNING, message
        if self._new_goal is not None:
            self.outputs.append(PlannerStatus.of_goal(*about, self._new_goal))
        elif active is not None:
            self.outputs.append(active.status(*about))

    def cancel_plan(self) -> None:
        """Cancel the plan that the worker is computing; any thread may call this."""
        self._worker.cancel()

    def reset(self) -> None:
        """Drop all goals immediately, without a status, and wait for the worker to end."""
        self._tracker.stop()
        self._forget_goals()
        self._worker.close()
        self._change_phase(Event.DEACTIVATED, Phase.IDLE)
        if self.config.output != "trajectory":
            self._add_notice(
                "info", f"{self.statistics.commands_published} commands were published."
            )

    # -- measured states ----------------------------------------------------------------------

    def add_base_measurement(self, measured: MeasuredState) -> None:
        """Use a base measurement that arrived after its state had been processed."""
        if self.phase is Phase.TELEOPERATING:
            self._teleoperation.keep_base_pose(measured)
        elif self.measuring:
            # States of a moving robot are not averaged: only the last one is used.
            self._average.take(measured, alone=self._tracker.is_active)

    def update(self, measured: MeasuredState) -> Setpoint:
        """Return the setpoint for a measured state; see :attr:`setpoint`."""
        stamp, q, tracker = measured.stamp_ns, measured.q, self._tracker
        if not 0 <= stamp - self._stamp_ns <= self.config.longest_gap * SECOND:
            if tracker.is_active:
                self._handle_time_jump(stamp)
            elif self.phase is Phase.TELEOPERATING:
                self._end_teleoperation(Event.TIME_JUMPED, "The state time has jumped.")
        self._stamp_ns = stamp
        if tracker.has_ended(stamp, q):
            self._end_schedule(stamp)
        match self.phase:
            case Phase.MEASURING | Phase.EVALUATING:
                self._measure_at_rest(measured)
            case Phase.PLANNING:
                self._take_plan_result()
            case Phase.REPLANNING | Phase.TAKING_OVER:
                self._await_take_over()
            case Phase.EXECUTING | Phase.BRAKING if self._new_goal is not None:
                self._measure_in_motion(self._new_goal, measured)
            case Phase.EXECUTING if tracker.is_check_due(stamp):
                assert self._active_goal is not None
                self._check_path(self._active_goal, measured)
        if tracker.is_active:
            stuck = tracker.track(stamp, q, obeyed=not self.plant_rests)
            if stuck and self._active_goal is not None:
                self._handle_stuck_joints(self._active_goal, stuck)
        if self.phase is Phase.TELEOPERATING:
            self._follow_twist(measured)
        elif not tracker.is_active:
            qdot = None if measured.base is None else measured.base.qdot
            tracker.hold(q, qdot, obeyed=not self.plant_rests)
        self.statistics.commands_published += 1
        return tracker.setpoint

    # -- TELEOPERATING ------------------------------------------------------------------------

    def _follow_twist(self, measured: MeasuredState) -> None:
        goal_waits = self._new_goal is not None
        before = self._tracker.setpoint.velocity
        step = self._teleoperation.step(measured, before, goal_waits=goal_waits)
        if step.rates is not None:
            self._tracker.follow_velocity(measured.q, step.rates)
        if step.ended:
            self._end_teleoperation(Event.AT_REST, step.message)
        elif step.message:
            self.outputs.append(PlannerStatus(PlannerState.TELEOPERATING, step.message))
        if step.rates is None:
            self._tracker.hold(measured.q)

    def _end_teleoperation(self, event: Event, message: str) -> None:
        self._teleoperation.end()
        self._stop_motion(event)
        self.outputs.append(PlannerStatus(PlannerState.IDLE, message))

    # -- at rest: MEASURING and EVALUATING ----------------------------------------------------

    def _measure_at_rest(self, measured: MeasuredState) -> None:
        """Plan for a new goal, or evaluate the active one, once the state is known."""
        if not self._worker.is_free():
            return
        self._average.take(measured)
        if not self._average.complete:
            return
        if self.phase is Phase.MEASURING:
            assert self._new_goal is not None
            self._plan_new_goal(self._new_goal)
        # A refused plan leaves the averaged state valid, unless planning took time.
        if self.phase is Phase.EVALUATING:
            assert self._active_goal is not None
            self._evaluate(self._active_goal)
        self._average.restart()

    def _evaluate(self, active: ActiveGoal) -> None:
        """Compare the measured pose with the goal; plan the remaining motion, or end the goal."""
        try:
            state = self._average.state()
        except PlanningError as reason:
            failed = PlannerStatus.of_goal(PlannerState.FAILED, str(reason), active.identified)
            self._end_goal(failed, Event.FAILED)
            return
        goal = active.identified.goal
        error = PoseError.between(state.position, state.quaternion, goal, state.q, self._robot)
        tolerance, why = self._tolerance_of(active.identified), ""
        reached = active.reached(error, tolerance)
        if reached is not None:
            self._end_goal(reached, Event.REACHED)
            return
        corrects = active.next_plan is PlanReason.CORRECTION
        if active.not_flown_reason:
            why = f": {active.not_flown_reason}. Remaining"
        elif corrects and active.corrections >= self.config.max_corrections:
            why = f" after {counted(active.corrections, 'correction')}"
        if why:
            self._end_goal(active.failed(error, tolerance, why), Event.FAILED)
            return
        if corrects:
            off = describe_remaining_error(error, active.schedule.controls)
            active.corrections += 1
            message = f"The remaining motion is planned: {off}."
            self._add_event(EventKind.CORRECTION, message, active.identified, 1, **active.counted)
        self._request_plan(PlanJob(active.identified, active.next_plan, error), state)

    # -- in motion: EXECUTING and BRAKING -----------------------------------------------------

    def _measure_in_motion(self, waiting: IdentifiedGoal, measured: MeasuredState) -> None:
        """Plan for a new goal from the current state, or brake first if planning takes time."""
        take_over, attempts_left = None, self._in_motion_attempts < _MAX_IN_MOTION_ATTEMPTS
        if self.phase is Phase.EXECUTING and attempts_left and self._can_replan():
            after = self.config.takeover_time * 2**self._in_motion_attempts
            take_over = self._tracker.take_over(self._stamp_ns, measured.q, after)
        if take_over is None and self._worker.plans_in_background:
            if self.phase is Phase.EXECUTING:
                self._brake_for_replan(Event.NEW_GOAL)
            return
        if not self._worker.is_free():
            return
        if not self._average.take(measured, alone=True) and not self._average.count:
            return
        active = self._active_goal
        if take_over is None:
            self._plan_new_goal(waiting)
        elif active is not None and waiting.goal.equals(active.identified.goal):
            left, self._new_goal = active.time_left(self._stamp_ns), None
            active = replace(active, identified=waiting, corrections=0, manoeuvre_time=left)
            self._accept_goal(active)
            message = "The current schedule also leads to this goal."
            self.outputs.append(active.status(PlannerState.EXECUTING, message))
        elif self.config.averaging == 1 or self._tracker.is_check_due(self._stamp_ns):
            self._plan_new_goal(waiting, take_over)
        self._average.restart()

    def _check_path(self, active: ActiveGoal, measured: MeasuredState) -> None:
        """Plan the remaining motion periodically, and when the base is off its predicted path."""
        self._average.restart()
        corrected = active.corrections >= self.config.max_corrections
        replans = self.config.replanning > 0 and self._can_replan()
        if not self._worker.is_free() or (corrected and not replans):
            return
        if not self._average.take(measured):
            return
        try:
            state = self._average.state()
        except PlanningError as reason:
            self._add_notice("warning", f"The path is unknown: {reason}")
            return
        error = None if corrected else self._tracker.path_check.error(state)
        if error is None:
            if replans:
                self._replan_remaining(active, state)
        elif self._worker.plans_in_background:
            self._correct_path(active, error)
            self._brake_for_replan(Event.TRACKING_ERROR)
        else:
            self._request_plan(PlanJob(active.identified, PlanReason.TRACKING_ERROR, error), state)

    def _can_replan(self) -> bool:
        return (
            self._active_goal is not None
            and not self.plant_rests
            and self.config.takeover_time > 0
            and not self._tracker.stuck
            and self._worker.starts_in_motion(self._active_goal.schedule)
        )

    def _replan_remaining(self, active: ActiveGoal, state: RobotState) -> None:
        """Replan the remaining motion from the current state, at most once per period."""
        state = self._tracker.path_check.average_pose(state)
        if self._stamp_ns < self._replan_ns or active.schedule.partial:
            return
        self._replan_ns = self._stamp_ns + round(self.config.replanning * SECOND)
        aim = self._tracker.path_check.shift_goal(
            active.identified.goal,
            self._tolerance_of(active.identified),
            active.schedule.controls - {"shape"},
            late=active.is_late(self._stamp_ns),
        )
        if aim is None:
            return
        take_over = self._tracker.take_over(self._stamp_ns, state.q, self.config.takeover_time)
        if take_over is None:
            return
        job = PlanJob(active.identified, PlanReason.SHRINKING_HORIZON, take_over=take_over)
        self._request_plan(job, replace(state, q=take_over.shapes[0].copy()), aim)

    def _brake_for_replan(self, event: Event) -> None:
        """Come to rest along the planned path: background plans start from rest."""
        assert self._active_goal is not None
        self._active_goal.next_plan = PlanReason.REPLAN
        self._tracker.brake(self._stamp_ns)
        self._average.restart()
        self._change_phase(event, Phase.BRAKING)

    # -- in motion: REPLANNING and TAKING_OVER ------------------------------------------------

    def _await_take_over(self) -> None:
        if self.phase is Phase.REPLANNING:
            self._take_plan_result()
        job = self._job
        if job is None or job.take_over is None or self._stamp_ns < job.take_over.stamp_ns:
            return
        if self._ready_plan is not None:
            self._switch_schedule(self._ready_plan)
            return
        # The present schedule continues; a new goal is planned once more.
        self._drop_plan()
        self._in_motion_attempts += job.reason.is_for_new_goal
        self._change_phase(Event.PLAN_LATE, Phase.EXECUTING)
        message = "The plan was not ready in time to take over."
        self._add_warning(EventKind.PLAN_LATE, message, job.identified, reason=job.reason.value)

    def _switch_schedule(self, schedule: GaitSchedule) -> None:
        job, self._job, self._ready_plan = self._job, None, None
        assert job is not None
        assert job.take_over is not None
        begins_ns = job.take_over.stamp_ns
        if job.reason.is_for_new_goal:
            self._accept_goal(ActiveGoal(job.identified, schedule, begins_ns))
        reason = job.reason.value
        message = f"A plan takes over in motion: {reason}."
        about = {"reason": reason, **_about(schedule)}
        self._add_event(EventKind.PLAN_TAKEN_OVER, message, job.identified, 0, **about)
        self._execute_schedule(schedule, begins_ns, event=Event.TAKEN_OVER)

    # -- plans: request, result, schedule -----------------------------------------------------

    def _plan_new_goal(self, waiting: IdentifiedGoal, take_over: TakeOver | None = None) -> None:
        """Request a plan for a new goal: from rest, with braking, or in motion."""
        reason, state, refusal = PlanReason.NEW_GOAL, None, ""
        try:
            state = self._average.state()
        except PlanningError as error:
            refusal = str(error)
        if take_over is not None:
            reason = PlanReason.IN_MOTION
            if state is None:
                # A later state may allow a plan; otherwise the schedule ends first.
                return
            if self.config.averaging > 1:
                state = self._tracker.path_check.average_pose(state)
        elif self._tracker.is_active:
            reason = PlanReason.BLEND
        self._new_goal = None
        self.statistics.plan_time_s, self.statistics.plans = 0.0, 0
        if state is None:
            self._change_phase(Event.PLAN_REQUESTED, Phase.PLANNING)
            self._handle_refusal(PlanJob(waiting, reason), refusal)
        else:
            goal = waiting.goal.kept_at(state.position, state.quaternion)
            waiting = replace(waiting, goal=goal)
            self._request_plan(PlanJob(waiting, reason, take_over=take_over), state)

    def _request_plan(self, job: PlanJob, state: RobotState, aim: Goal | None = None) -> None:
        """Request a plan to the goal or another ``aim``; joints brake unless it is to take over."""
        active = None if job.reason.is_for_new_goal else self._active_goal
        if active is not None and len(active.stuck_positions) != len(self._tracker.stuck):
            names = self._robot.joint_names
            active.stuck_positions = {names[i]: float(state.q[i]) for i in self._tracker.stuck}
        braking, rates = None, None
        if job.take_over is not None:
            self._change_phase(Event.PLAN_REQUESTED, Phase.REPLANNING)
        else:
            braking, rates = self._tracker.braking(self._stamp_ns, state)
            self._commanded_from_ns = self._stamp_ns
            self._change_phase(Event.PLAN_REQUESTED, Phase.PLANNING)
        request = PlanRequest(
            state,
            aim or job.identified.goal,
            self._tolerance_of(job.identified),
            correction=job.reason in (PlanReason.CORRECTION, PlanReason.CONTINUATION),
            previous=None if active is None else active.schedule,
        )
        reason = job.reason.value
        message = f"Planning: {reason}."
        self._add_event(EventKind.PLAN_STARTED, message, job.identified, reason=reason)
        fresh = job.reason.is_for_new_goal or not self._tracker.is_active
        if fresh and self._worker.plans_in_background:
            about = PlannerState.PLANNING, message
            status = PlannerStatus.of_goal(*about, job.identified)
            self.outputs.append(status if active is None else active.status(*about))
        task = PlanningTask(
            request,
            {} if active is None else active.stuck_positions,
            frozenset() if active is None else active.required,
            braking=braking,
            rates_after_braking=rates,
            take_over=job.take_over,
        )
        self._job = job
        self._worker.submit(task, self._stamp_ns)
        self._take_plan_result()

    def _take_plan_result(self) -> None:
        """Execute a plan, or report its refusal; the job alone decides on the next phase."""
        result = self._worker.poll(self._stamp_ns)
        if result is None:
            return
        self.statistics.plan_time_s += result.wall_time
        job, self._job, active = self._job, None, self._active_goal
        assert job is not None
        self.statistics.plans += 1
        self._add_notice("info", f"Planned in {result.wall_time:.6f} s.")
        if isinstance(result, Refused):
            self._handle_refusal(job, result.reason)
            return
        # The goal of the plan may be a shifted one.
        goal, required = job.identified.goal, job.identified.required
        schedule, error = replace(result.schedule, goal=goal), None
        try:
            required.require_control(goal, schedule.controls, schedule.method)
        except PlanningError as refusal:
            self._handle_refusal(job, str(refusal))
            return
        message, about = f"The plan is {schedule.title}.", _about(schedule)
        self._add_event(EventKind.PLAN_READY, message, job.identified, 0, **about)
        if job.take_over is not None:
            self._job, self._ready_plan = job, schedule
            self._change_phase(Event.PLANNED, Phase.TAKING_OVER)
            return
        if job.reason.is_for_new_goal:
            self._accept_goal(ActiveGoal(job.identified, schedule, self._stamp_ns))
        elif job.reason is PlanReason.TRACKING_ERROR:
            assert active is not None
            self._correct_path(active, job.error)
        else:
            error = job.error
        self._execute_schedule(schedule, result.begins_ns, error)

    def _handle_refusal(self, job: PlanJob, why: str) -> None:
        """Report that there is no plan; an active goal at rest fails."""
        active, reason = self._active_goal, job.reason
        if reason is PlanReason.IN_MOTION:
            self._new_goal = self._new_goal or job.identified
            self._in_motion_attempts += 1
            last = self._in_motion_attempts == _MAX_IN_MOTION_ATTEMPTS
            again = "from rest" if last else "from a later tick"
            message = (
                f"No plan that begins in motion was found, so planning is repeated {again}: {why}"
            )
            self._add_notice("warning", message)
        elif reason is PlanReason.SHRINKING_HORIZON:
            message = f"The remaining motion is not planned again: {why}"
            self._add_notice("info", message)
        elif reason.is_for_new_goal:
            message = why if active is None else f"{why} The earlier goal is still pursued."
            refused = PlannerStatus.of_goal(PlannerState.REFUSED, message, job.identified)
            self.outputs.append(refused)
        elif reason is PlanReason.TRACKING_ERROR:
            off = _deviation(job.error)
            message = f"{off}, and the remaining motion cannot be planned again: {why}"
            self._add_notice("warning", message)
        else:
            assert active is not None
            assert job.error is not None
            tolerance = self._tolerance_of(active.identified)
            failed = active.failed(job.error, tolerance, f": {why} Remaining")
            self._end_goal(failed, Event.REFUSED)
            return
        target = self._phase_at_rest()
        if self._tracker.is_active:
            target = Phase.BRAKING if self._tracker.is_braking else Phase.EXECUTING
        self._change_phase(Event.REFUSED, target)

    def _accept_goal(self, active: ActiveGoal) -> None:
        self._active_goal, self._tracker.stuck = active, []
        self._add_event(EventKind.GOAL_ACCEPTED, "The goal is accepted.", active.identified)
        self.outputs.append(PursuedGoals({BASE_GOAL_KEY: active.identified}))

    def _execute_schedule(
        self,
        schedule: GaitSchedule,
        begins: int,
        remaining: PoseError | None = None,
        event: Event = Event.PLANNED,
    ) -> None:
        """Track a schedule for the active goal, from the stamp of its first tick on."""
        active, config = self._active_goal, self.config
        assert active is not None
        start = ", which begins in motion" if event is Event.TAKEN_OVER else ""
        active.begin(schedule, begins)
        self._replan_ns = begins + round(config.replanning * SECOND)
        averages = (config.replanning > 0 or config.averaging > 1) and config.takeover_time > 0
        averages = averages and self._worker.starts_in_motion(schedule)
        tolerance = self._tolerance_of(active.identified)
        self._tracker.start(schedule, begins, config.averaging if averages else 0, tolerance)
        self._commanded_from_ns = self._stamp_ns
        self._change_phase(event, Phase.EXECUTING)
        status = active.status(
            PlannerState.EXECUTING,
            f"Executing {schedule.title}{start}.",
            remaining,
            method=schedule.method,
            duration_s=schedule.duration,
            notes=schedule.notes,
        )
        self.outputs += [status, ScheduleStart(schedule, begins)]

    def _correct_path(self, active: ActiveGoal, error: PoseError | None) -> None:
        active.corrections += 1
        message = f"{_deviation(error)}: the remaining motion is replanned."
        self._add_warning(EventKind.CORRECTION, message, active.identified, **active.counted)

    # -- ends of schedules and goals ----------------------------------------------------------

    def _end_schedule(self, stamp_ns: int) -> None:
        """End the schedule; its result is evaluated unless its goal was given up."""
        ready = self._ready_plan
        if ready is not None:
            # No state arrived between the take-over tick and the end of the schedule.
            self._switch_schedule(ready)
            if not self._tracker.has_ended(stamp_ns, ready.positions[-1]):
                return
        at_rest = self.phase is Phase.BRAKING
        event = Event.AT_REST if at_rest else Event.SCHEDULE_ENDED
        self._stop_motion(event, at_last_shape=not at_rest)

    def _stop_motion(self, event: Event, *, at_last_shape: bool = False) -> None:
        """Drop the schedule and any plan; the next phase begins with measurements at rest."""
        self._drop_plan()
        self._tracker.stop(at_last_shape=at_last_shape)
        self._average.restart()
        self._change_phase(event, self._phase_at_rest())

    def _handle_time_jump(self, stamp_ns: int) -> None:
        """Plan the remaining motion if the schedule does not cover the current time."""
        if self._tracker.covers(stamp_ns):
            return
        if self._active_goal is not None:
            self._active_goal.next_plan = PlanReason.REPLAN
        self._stop_motion(Event.TIME_JUMPED)
        before, now = self._stamp_ns / SECOND, stamp_ns / SECOND
        self._add_notice(
            "warning",
            f"The state time has jumped from {before:.9g} s to {now:.9g} s; no motion is planned "
            f"for that time.",
        )

    def _handle_stuck_joints(self, active: ActiveGoal, stuck: Sequence[int]) -> None:
        """Stop the robot, and plan the remaining motion with the joints that are not stuck."""
        tracker = self._tracker
        tracker.stuck += stuck
        active.cut_off(self._stamp_ns)
        active.required = active.schedule.controls - {"shape"}
        active.next_plan = PlanReason.STUCK_JOINTS
        self._stop_motion(Event.JOINTS_STUCK)
        names = ", ".join(self._robot.joint_names[i] for i in tracker.stuck)
        message = f"Stuck: {names}. The remaining motion is planned without stuck joints."
        self._add_warning(EventKind.STUCK_JOINT, message, active.identified, joints=names)

    def _drop_plan(self) -> None:
        """Drop the requested or ready plan; its new goal, if any, waits again."""
        self._worker.cancel()
        job, self._job, self._ready_plan = self._job, None, None
        if job is not None and job.reason.is_for_new_goal:
            self._new_goal = self._new_goal or job.identified

    def _phase_at_rest(self) -> Phase:
        if self._new_goal is not None:
            return Phase.MEASURING
        return Phase.IDLE if self._active_goal is None else Phase.EVALUATING

    def _end_goal(self, status: PlannerStatus, event: Event) -> None:
        self.outputs.append(status)
        self._active_goal = None
        self._change_phase(event, self._phase_at_rest())

    def _forget_goals(self) -> None:
        self._drop_plan()
        self._teleoperation.end()
        self._new_goal = self._active_goal = None

    @property
    def _latest_goal(self) -> IdentifiedGoal | None:
        """The latest proposed goal that is not decided."""
        return next((goal for goal in self._goals if goal is not None), None)

    @property
    def _goals(self) -> tuple[IdentifiedGoal | None, ...]:
        """The waiting goal, the goal being planned, and the active goal; None: there is none."""
        pursued = (self._job, self._active_goal)
        return self._new_goal, *(None if each is None else each.identified for each in pursued)

    def _tolerance_of(self, identified: IdentifiedGoal) -> Tolerance:
        return identified.tolerance or self.config.tolerance

    # -- outputs ------------------------------------------------------------------------------

    def _change_phase(self, event: Event, target: Phase) -> None:
        """Change the phase and report the transition; no other method changes the phase."""
        self.outputs.append(Transition(self.phase, event, target))
        self.phase = target

    def _add_notice(self, level: LogLevel, message: str) -> None:
        self.outputs.append(Notice(level, message))

    def _add_warning(
        self, kind: EventKind, message: str, goal: IdentifiedGoal, **about: str
    ) -> None:
        self._add_notice("warning", message)
        self._add_event(kind, message, goal, 1, **about)

    def _add_event(
        self, kind: EventKind, message: str, goal: IdentifiedGoal, level: int = 0, **about: str
    ) -> None:
        now = self._stamp_ns / SECOND
        self.outputs.append(FlightEvent(kind, message, level, now, goal.goal_id, about))

    def _add_abort(self, message: str, goal: IdentifiedGoal | None) -> None:
        goal_id = "" if goal is None else goal.goal_id
        self.outputs.append(PlannerStatus(PlannerState.ABORTED, message, goal_id=goal_id))


def _deviation(error: PoseError | None) -> str:
    assert error is not None
    distance, angle = quantity(error.distance, "m"), quantity(error.angle, "rad")
    return f"Deviates from the path by {distance} and {angle}"


def _about(schedule: GaitSchedule) -> dict[str, str]:
    """Return method and duration of a schedule, for events."""
    return {"method": schedule.method, "duration_s": f"{schedule.duration:.9g}"}
