"""Executive of coordinated control: accepts, pursues, evaluates, aborts and saves goals."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from enum import IntEnum

from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import CoordinatedController, Mode
from spacerobot_ros.control.goals import (
    GoalPlanning,
    GoalWatch,
    aims_of,
    config_with,
    goal_parts,
    goals_to_save,
    require_controlled_axes,
    tolerance_of,
    with_later_goals,
)
from spacerobot_ros.control.limits import Saturated
from spacerobot_ros.control.planned_reference import PLANNING_TIME, PlannedReference
from spacerobot_ros.control.servicing import Servicing, Task, TaskProgress, TaskState
from spacerobot_ros.control.state import Actuation, ControlState, PoseReference, Reference
from spacerobot_ros.control.status import CommandReport, ControllerState, ControllerStatus
from spacerobot_ros.errors import CommandError, ParameterError, PlanningError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, IdentifiedGoal, PursuedGoals
from spacerobot_ros.times import SECOND

Output = ControllerStatus | Event | PursuedGoals
"""Output of an executive other than commands."""


class _Next(IntEnum):
    """Reaction to the next measured state; a greater one takes precedence."""

    GO_ON = 0
    BEGIN_ANEW = 1
    """The goal restarts from the measured pose."""
    HOLD = 2
    """The robot holds the measured pose, without a goal."""
    ABORT = 3
    """Like ``HOLD``, but the abort is also reported."""


class ControlExecutive:
    """Sets the goals of a :class:`CoordinatedController`, and reports their outcome.

    For every state, the owner calls :meth:`command`, sends the result to the actuators, and then
    calls :meth:`evaluate`. The goal state is one of

    * ``WAITING``: the base has not been measured yet.
    * ``HOLDING``: no goal was accepted; the robot holds its pose in the first state.
    * ``TRACKING``: a goal is being pursued; ``STALLED`` while the robot makes no progress
      (:class:`.StallMonitor`). ``REACHED`` once all errors have stayed within tolerance for the
      settling time after the reference has come to rest; ``FAILED`` if this does not happen
      within the time limit. In both cases the robot then holds the goal.
    * ``ABORTED``: the goal was given up; the robot holds its pose in the next measured state. After
    a loss of control (a joint far exceeds its rate limit, or goal errors grow instead of
    shrinking), the robot is brought to rest instead.

    :class:`.GoalMonitor` decides the outcome of a goal.

    While there is no base measurement, the reported state is ``ESTIMATING`` or ``STOPPED`` instead,
    and the goal state does not change. ``REFUSED`` is reported for a single goal; it is not a goal
    state.
    """

    def __init__(self, controller: CoordinatedController, config: ControllerConfig) -> None:
        self.controller = controller
        config = config.for_robot(controller.law.robot.description)
        self._config = self._goal_config = config
        self._goal_tolerance: Tolerance | None = None
        """Tolerances of the current goal; None: the parameters'."""
        self.outputs: deque[Output] = deque()
        """Outputs to publish, in order; the owner removes published outputs. A status is added when
        the state changes, when commands start or stop being limited, and every ``status_period``.
        """
        self.servicing = Servicing(config, self._report_task)
        self._planning = GoalPlanning()
        self.reset()

    def reset(self) -> None:
        """Discard goals and measurements, without a status; the next state is treated as the
        first."""
        self.controller.reset()
        self._planning.close()
        self._time: float | None = None
        """Time of the last state, s."""
        self._gap = -math.inf, 0.0
        """Time of the last state that came after a gap, and the gap, s."""
        self._next = _Next.GO_ON
        self.plant_blocked = False
        """Whether the plant ignores commands, as set by the owner. If so, each command holds the
        current pose, so that the robot does not move when the plant accepts commands again."""
        self._end_message = ""
        """Message about the end of the goal, which later errors do not change."""
        self._pending: dict[str, IdentifiedGoal] = {}
        """Accepted goals that wait for the next measured state."""
        self._goal_state = self._reported_state = ControllerState.HOLDING
        self._goals: dict[str, IdentifiedGoal] = {}
        """Goals pursued together, by frame."""
        self._goal_id = ""
        """Id of the latest goal, included in status messages."""
        self._holds_until_planned = False
        """Whether the robot holds its pose until a motion to the restarted goal is planned."""
        self._watch = GoalWatch()
        self._was_measured = False
        self.servicing.end()
        self._after_tasks: dict[str, IdentifiedGoal] = {}
        self._carried_id: str | None = None
        """Id of the goals whose tasks are done; None: no goals have had tasks."""
        self._requested: tuple[Task, ...] | None = None
        """Tasks requested without a goal, waiting for the next measured state."""
        self._guided = False
        """Whether the last command followed an external reference."""
        self._next_report = 0.0
        self._limited = False
        self._command_report: CommandReport | None = None

    def cancel_plan(self) -> None:
        """Cancel the reference being planned; any thread may call this."""
        self._planning.cancel()

    def plan_at_once(self) -> None:
        """Compute later plans synchronously, because the plant is in lockstep and states wait for
        them."""
        if self.controller.planner is not None:
            self.controller.planner.in_background = False

    @property
    def plan_time(self) -> float:
        """Total wall time spent planning references, s."""
        return self._planning.time

    def configure(self, config: ControllerConfig) -> None:
        """Use other tolerances, times and gains from the next state on."""
        config = config.for_robot(self.controller.law.robot.description)
        self._config = config
        self._take_tolerance(self._goal_tolerance)
        self.servicing.configure(config)
        self.controller.set_gains(config.gains)
        self._watch.stall.restart()

    @property
    def _pursues(self) -> bool:
        """Whether a goal is pursued, or the tasks before one."""
        return self._goal_state is ControllerState.TRACKING

    @property
    def state(self) -> ControllerState:
        """State reported in status messages."""
        mode = self.controller.mode
        if not self._was_measured:
            return ControllerState.WAITING
        if mode is Mode.MEASURED:
            stalled = self._watch.stall.cause and self._pursues
            return ControllerState.STALLED if stalled else self._goal_state
        if mode is not Mode.ESTIMATED:
            return ControllerState.STOPPED
        # Poses may arrive a few periods late, for example on a busy machine.
        config, elapsed = self._config, self.controller.time_since_measurement
        unreported = max(1.5 * config.control_period, _UNREPORTED_SHARE * config.estimation_time)
        return self._goal_state if elapsed <= unreported else ControllerState.ESTIMATING

    # -- goals --------------------------------------------------------------------------------

    @property
    def unfinished_goals(self) -> frozenset[str]:
        """Ids of pursued and waiting goals, including aborted goals not reported yet."""
        present = self._next is _Next.ABORT or self._pursues
        pursued = self._goals.values() if present else ()
        return self.waiting_goals.union(goal.goal_id for goal in pursued)

    @property
    def waiting_goals(self) -> frozenset[str]:
        """Ids of goals that begin at the next measured state or after tasks."""
        return frozenset(goal.goal_id for goal in self._pending.values())

    def progress(self, goal_id: str) -> tuple[str, float | None]:
        """Return the current activity for a goal, and the predicted time, s, until the current
        motion ends."""
        task, ends = self.servicing.task, self.controller.reference_ends
        if self._planning.active and goal_id in self.waiting_goals:
            return "planning", None
        if task is not None:
            return task.value, None
        if goal_id != self._goal_id or self._time is None or ends is None:
            return "waiting", None
        return self.state.value, max(0.0, ends - self._time) + self._config.settle_time

    def submit(self, key: str, goal: IdentifiedGoal) -> None:
        """Accept a goal for the ``base`` or the ``end_effector``, effective from the next state.

        The other frame keeps its goal.

        Raises PlanningError; see :func:`goal_parts`.
        """
        parts = goal_parts(self.controller, key, goal)
        self._pending = with_later_goals(self._pending, parts)

    def request(self, task: Task) -> None:
        """Begin a task at the next measured state, without a subsequent goal."""
        self._requested = (task,)

    def refuse(self, message: str, goal_id: str = "") -> None:
        """Report that a goal was refused; an earlier goal is still pursued."""
        self._publish_decision(ControllerState.REFUSED, message, goal_id)

    def resume(self, saved: Mapping[str, IdentifiedGoal]) -> None:
        """Accept goals saved by an earlier controller.

        Raises
        ------
        ParameterError
            The goals belong to another robot or law, and none is accepted.
        """
        try:
            for key, goal in saved.items():
                self.submit(key, goal)
        except PlanningError as error:
            self._pending.clear()
            raise ParameterError(
                f"Parameter 'resume_file' contains goals of another robot or law: {error}"
            ) from error

    def abort(self, why: str = "on request") -> str:
        """Abort all goals; the robot holds its pose in the next measured state.

        Returns a message that describes the robot's reaction.
        """
        self._give_up(f"Aborted {why}; the robot holds its pose.")
        self._next = _Next.ABORT
        return "The robot holds its pose."

    def plant_stopped(self, why: str) -> None:
        """Abort all goals immediately, because the plant ignores commands from now on."""
        if self._pursues or self._pending:
            self._give_up(f"Aborted by the plant: {why}")
            # Reported immediately, as the next measured state may be late; so is an earlier abort.
            self._next = _Next.HOLD
            self._report_abort()

    def plant_rested(self, commanded_until_ns: int, since_ns: int) -> None:
        """Restart the motion to the goal at the next measured state, because the plant brought the
        joints to rest after the command of ``commanded_until_ns``; later motions continue."""
        began_ns = round(self._watch.monitor.started * SECOND)
        if not self._pursues or commanded_until_ns < began_ns:
            return
        if self.servicing.task is None:
            self._plan_next(_Next.BEGIN_ANEW)
        else:
            self.servicing.restart()
        message = (
            "The joints were brought to rest, because no command arrived in time: the motion "
            "starts again."
        )
        self._publish(ControllerState.TRACKING, message, self._goal_id)

    def take_contacts(self, contacts: tuple[str, ...], time: float) -> None:
        """Set the links in contact from a given time (s) on; a new contact during the motion
        makes a goal fail."""
        self._watch.take_contacts(contacts, time, pursues=self._pursues)

    def on_plant_obeying(self) -> None:
        """Hold the pose in the next measured state, not an earlier pose."""
        self._plan_next(_Next.HOLD)

    def use_obstacles(self, world: RobotDescription | None) -> None:
        """Plan around other obstacles from now on; None: no obstacles.

        A plan in progress is restarted. If the rest of the current motion comes too close to an
        obstacle, the motion is replanned: while moving if there is time, otherwise from a held
        pose.
        """
        planner = self.controller.planner
        if planner is None:
            return
        planner.use_obstacles(world)
        self._planning.drop()
        if not self._pursues or self._time is None or self.servicing.task:
            return
        left = self.controller.time_until_blocked(self._time)
        if left < 2 * PLANNING_TIME:
            self._plan_next(_Next.BEGIN_ANEW)
        elif left < math.inf:
            # Until the plan takes over, the robot continues.
            self._plan_anew(self._time + PLANNING_TIME * planner.in_background)

    def _plan_anew(self, time: float) -> None:
        """Plan the rest of the motion to the pursued goals again."""
        passed = self.controller.waypoints_passed(time)
        self._goals = {
            part: replace(each, goal=each.goal.after_waypoints(passed))
            for part, each in self._goals.items()
        }
        self._pending = {**self._goals, **self._pending}

    def references_ended(self) -> None:
        """Continue without external references: restart the goal or, without a goal, hold the
        measured pose."""
        self.controller.follow(Reference())
        self._begin_anew_or_hold()

    def plant_reset(self) -> None:
        """Restart the goal at the next measured state, or hold the pose of that state if there is
        no goal."""
        self.servicing.end()
        self._carried_id = None
        if self._pursues and self._after_tasks:
            self._pending = {**self._after_tasks, **self._pending}
        self._begin_anew_or_hold()
        if self._pursues:
            message = "The plant was reset: the goal is pursued from the initial state."
            self._publish(ControllerState.TRACKING, message, self._goal_id)

    def _begin_anew_or_hold(self) -> None:
        self._plan_next(_Next.BEGIN_ANEW if self._pursues else _Next.HOLD)

    def _plan_next(self, reaction: _Next) -> None:
        """Set the reaction to the next measured state, unless a stronger one is pending."""
        self._next = max(self._next, reaction)

    def use_controller(
        self, controller: CoordinatedController, payload: Payload | None = None
    ) -> None:
        """Use another controller with the same outputs, because the robot's masses have changed.

        The goal restarts at the next measured state; without a goal, the robot continues to hold
        its pose. ``payload`` is the body held from now on.
        """
        controller.take_over_goals(self.controller)
        self.controller = controller
        self.servicing.hold(payload)
        if self._pursues:
            self._plan_next(_Next.BEGIN_ANEW)

    def _give_up(self, message: str) -> None:
        """Drop all goals; the message becomes that of the status."""
        pursued = self._pending or self._pursues
        # A decided goal stays decided: an abort without an undecided goal has no goal id.
        self._goal_id = self._latest_id() if pursued else ""
        self._goals = {**self._goals, **self._pending} if pursued else {}
        self._requested = None
        if self.servicing.task is not None:
            self.servicing.end()
            self.controller.follow(Reference())
        self._pending.clear()
        self._planning.drop()
        self._end_message = message

    def _report_abort(self) -> None:
        self._goal_state = self._reported_state = ControllerState.ABORTED
        self._end_goals(ControllerState.ABORTED, self._end_message)
        self._publish_decision(ControllerState.ABORTED, self._end_message, self._goal_id)

    # -- states -------------------------------------------------------------------------------

    def command(
        self,
        time: float,
        measured: ControlState | None,
        q: Array,
        qdot: Array,
        reference: Reference | None = None,
    ) -> Saturated:
        """Return the actuation for a state; see :meth:`CoordinatedController.command`.

        ``reference`` is a planner's reference for this state; groups missing from the reference
        hold their pose.

        Raises
        ------
        NotFiniteError
            A measurement is not finite.
        """
        if self._time is not None and not 0 <= time - self._time <= self._config.longest_gap:
            # After a jump of time, the goal continues as before the jump.
            jump = time - self._time
            self.controller.shift_time(jump)
            self.servicing.restart()
            self._watch.shift_time(jump)
            self._next_report += jump
        if self._time is not None and time - self._time > 1.5 * self._config.control_period:
            self._gap = time, time - self._time
        self._time = time
        wheels = self.controller.wheels
        if wheels is not None:
            if self.plant_blocked:
                wheels.reset_response_check()
            measured, q, qdot = wheels.observe(measured, q, qdot)
            reference = wheels.reference(reference)
        self._guided = reference is not None
        if measured is not None:
            self._was_measured = True
            reaction, self._next = self._next, _Next.GO_ON
            if reaction >= _Next.HOLD or self.plant_blocked:
                self._hold_pose(time, measured, aborted=reaction is _Next.ABORT)
            elif reaction is _Next.BEGIN_ANEW and self.controller.planner is not None:
                self._plan_anew(time)
                self.controller.hold_here(time, measured)
                self._holds_until_planned = True
            elif reaction is _Next.BEGIN_ANEW:
                self.controller.restart_motion(time, measured)
                self._watch.begin_anew()
            too_fast = self.controller.coming_to_rest and self._watch.monitor.fast_states
            if not too_fast:
                self._follow_goals(time, measured)
            lost = self._watch.loss_by_rates(self.controller, qdot)
            if lost and not self._is_moved_otherwise:
                self._abort_on_lost_control(lost)
        if reference is not None:
            self.controller.follow(reference)
        result = self.controller.command(time, measured, q, qdot)
        if wheels is None:
            return result
        excess = Actuation(result.excess.wrench_B, wheels.shape_with_wheels(result.excess.tau))
        return Saturated(wheels.actuation(result.realised), excess)

    def dump_momentum(self) -> str:
        """Dump the reaction wheel momentum and return a message, or raise CommandError."""
        if self.controller.wheels is None:
            name = self.controller.law.robot.description.name
            raise CommandError(f"Robot '{name}' has no reaction wheels.")
        return self.controller.wheels.request_dump()

    def evaluate(self, time: float, result: Saturated) -> None:
        """Evaluate the errors after the command ``result``, and report state changes."""
        if self.controller.wheels is not None:
            for event in self.controller.wheels.events():
                self.outputs.append(event)
                self._next_report = time
        if self.controller.mode is Mode.MEASURED and self._pursues:
            self._judge(time, result)
        state = self.state
        if (
            state is self._reported_state
            and result.limited == self._limited
            and time < self._next_report
        ):
            return
        self._next_report = time + self._config.status_period
        self._reported_state, self._limited = state, result.limited
        self._command_report = CommandReport.of(self.controller, result)
        # The sender of a goal is informed that it is being planned.
        planned = state is ControllerState.HOLDING and self._planning.active
        self._publish(state, self._message(state), self._latest_id() if planned else self._goal_id)

    def _judge(self, time: float, result: Saturated) -> None:
        """Report a decision about the goal, a loss of control over it, or that it stalls."""
        watch, config = self._watch, self._goal_config
        if not self._is_moved_otherwise:
            lost = watch.loss_by_errors(self.controller, self._config)
            if lost:
                self._abort_on_lost_control(lost)
                return
        if self.servicing.task is not None or self._holds_until_planned:
            return
        decided = watch.decision(self.controller, time, config)
        if decided is not None:
            self._end_message = watch.message(decided, self.controller, config)
            self._goal_state = decided
            self._end_goals(decided, self._end_message)
            self._report_decision(decided, self._end_message, self._goal_id)
        elif not self._is_moved_otherwise:
            watch.stall.observe(time, self.controller, result, config)

    def _end_goals(self, state: ControllerState, message: str) -> None:
        """Report the end of all goals but the latest, whose status continues."""
        for goal_id in sorted({goal.goal_id for goal in self._goals.values()} - {self._goal_id}):
            self._publish_decision(state, message, goal_id)
        self._goals = {}

    @property
    def _is_moved_otherwise(self) -> bool:
        """Whether something other than this controller's goals moves the robot."""
        return bool(self._guided or self.plant_blocked or self.controller.coming_to_rest)

    def _abort_on_lost_control(self, why: str) -> None:
        at, gap = self._gap
        if self._time is not None and self._time - at < _GAP_REPORT_TIME:
            why += f" ({gap:.2g} s without a state before: is the machine busy?)"
        self._give_up(f"Aborted: control is lost, {why}; the robot is brought to rest.")
        self.controller.come_to_rest()
        self._report_abort()

    def _hold_pose(self, time: float, state: ControlState, *, aborted: bool) -> None:
        self.controller.hold_here(time, state)
        if aborted:
            self._report_abort()
        elif self._goal_state is not ControllerState.ABORTED:
            self._goal_state, self._goal_id = ControllerState.HOLDING, ""

    def _follow_goals(self, time: float, state: ControlState) -> None:
        """Continue the tasks before the pending goals, and start towards the goals after them."""
        servicing = self.servicing
        # Goals are checked once before the tasks, and once after them.
        waits = servicing.task is not None and self._latest_id() == self._goal_id
        if self._pending and not (waits or self._planning.is_for(self._pending)):
            self._refuse_goals_by_state(state)
        if self._requested is not None:
            self._begin_tasks(time, self._requested)
            self._requested = None
        elif self._pending and servicing.task is None:
            if not servicing.before_goals or self._carries_pending:
                self._begin_goals(time, state)
                return
            self._begin_tasks(time, servicing.before_goals)
        elif self._pending and self._latest_id() != self._goal_id:
            self._wait_for_tasks()
        if servicing.task is None:
            return
        progress = servicing.step(time, state, self.controller)
        match progress.state:
            case TaskState.ACTIVE:
                pass
            case TaskState.DONE if self._pending:
                self._refuse_goals_by_state(state)
                if self._pending:
                    self._carried_id = self._latest_id()
                    # Until the motion is planned, the pose is held.
                    self._holds_until_planned = True
                    self._begin_goals(time, state)
                else:
                    self._hold_pose(time, state, aborted=False)
            case TaskState.DONE:
                touched = bool(self._watch.touched)
                ended = ControllerState.FAILED if touched else ControllerState.REACHED
                self._goal_state = ended
                self._end_message = self._watch.message(ended, self.controller, self._goal_config)
                self._report_decision(ended, self._end_message, self._goal_id)
            case TaskState.REFUSED | TaskState.FAILED:
                self._end_tasks(time, state, progress)

    def _refuse_goals_by_state(self, state: ControlState) -> None:
        """Reject pending goals that the law cannot meet along an axis, or that are out of reach."""
        for key, pending in list(self._pending.items()):
            goal = pending.goal.kept_at(state.r_WB, state.quaternion_WB)
            pose = PoseReference(goal.position, goal.quaternion)
            goals = Reference(pose) if key == BASE_GOAL_KEY else Reference(end_effector=pose)
            config = config_with(self._config, pending.tolerance)
            try:
                require_controlled_axes(self.controller.law, state, config, goals)
                self.controller.require_bounded_duration(state, goals)
            except PlanningError as error:
                refused = [p for p, g in self._pending.items() if g.goal_id == pending.goal_id]
                for part in refused:
                    del self._pending[part]
                self.refuse(str(error), pending.goal_id)
                break

    def _begin_tasks(self, time: float, tasks: tuple[Task, ...]) -> None:
        self.servicing.begin(tasks)
        self._carried_id = None
        self._watch.forget_touch(time)
        self._begin_tracking(time)
        self._wait_for_tasks()

    def _begin_tracking(self, time: float) -> None:
        self._goal_state, self._holds_until_planned = ControllerState.TRACKING, False
        self._watch.begin(time)
        self._next_report = time

    def _wait_for_tasks(self) -> None:
        """Report and save the pending goals, which begin after the tasks."""
        reported, self._goal_id = self._goal_id, self._latest_id() if self._pending else ""
        self._goals = {}
        if self._pending and self._goal_id != reported:
            self._report_acceptance()
        self.outputs.append(PursuedGoals(dict(self._pending)))

    def _end_tasks(self, time: float, state: ControlState, progress: TaskProgress) -> None:
        goal_id = self._latest_id() if self._pending else self._goal_id
        self._give_up(progress.message)
        self._goal_id = goal_id
        self.controller.hold_here(time, state)
        if progress.state is TaskState.REFUSED:
            self._end_goals(ControllerState.REFUSED, progress.message)
            self._goal_state, self._goal_id = ControllerState.HOLDING, ""
            self.refuse(progress.message, goal_id)
        else:
            self._report_abort()

    @property
    def _carries_pending(self) -> bool:
        """Whether the tasks before the pending goals are done."""
        return self._latest_id() == self._carried_id

    def _begin_goals(self, time: float, state: ControlState) -> None:
        """Start towards the pending goals, after tasks from the measured pose."""
        pending, controller, carried = self._pending, self.controller, self._carries_pending
        if carried and not (self._goals or self._planning.active):
            # The tasks have moved the robot away from the earlier reference.
            controller.hold_here(time, state)
        job = None
        if controller.planner is not None:
            try:
                job = self._planning.planned(time, state, controller, pending)
            except PlanningError as error:
                goal_id = self._latest_id()
                if all(goal is self._goals.get(part) for part, goal in pending.items()):
                    self._give_up(f"Aborted: {error}")
                    self._hold_pose(time, state, aborted=True)
                else:
                    pending.clear()
                    self.refuse(str(error), goal_id)
            if job is None:
                return
        pursued = self._goals if self._pursues else {}
        again = self._pursues and self._goal_id == self._latest_id()
        self._goal_id = self._latest_id()
        self._goals = with_later_goals(pursued, pending)
        if not (again and pursued):
            self._after_tasks = dict(pending) if carried else {}
        self._take_tolerance(next(reversed(pending.values())).tolerance)
        if BASE_GOAL_KEY not in pursued:
            self._watch.asked[BASE_GOAL_KEY] = frozenset()
        self._watch.asked |= {part: each.goal.asked for part, each in pending.items()}
        resumes = all(each.resumes for each in pending.values())
        if job is not None:
            controller.begin(max(job.begins, time), job.result())
        else:
            controller.set_goals(time, state, **aims_of(controller, pending, state))
        self._pending = {}
        if not again:
            self._report_acceptance(None if job is None else job.result())
            self._watch.forget_touch(time)
        self._begin_tracking(time)
        of_base = self._goals.get(BASE_GOAL_KEY)
        saved = goals_to_save(
            controller,
            self._watch.asked,
            self._goal_id,
            waypoints=None if of_base is None else of_base.goal.waypoints,
            resumes=resumes,
        )
        self.outputs.append(PursuedGoals(saved))

    def _take_tolerance(self, tolerance: Tolerance | None) -> None:
        self._goal_tolerance = tolerance
        self._goal_config = config_with(self._config, tolerance)

    def _report_acceptance(self, plan: PlannedReference | None = None) -> None:
        message, about = "The goal is accepted.", {}
        if plan is not None:
            message += f" The planned motion takes {plan.duration:.3g} s"
            if (spent := plan.propellant) is not None:
                message += f" and {1e3 * spent:.3g} g of propellant"
                about["planned_propellant_kg"] = f"{spent:.6g}"
            message += "."
        goal_id = self._goal_id
        self.outputs.append(Event(EventKind.GOAL_ACCEPTED, message, goal_id=goal_id, about=about))

    def _latest_id(self) -> str:
        return next(reversed(self._pending.values())).goal_id if self._pending else self._goal_id

    # -- status -------------------------------------------------------------------------------

    def _publish(self, state: ControllerState, message: str, goal_id: str) -> None:
        task = self.servicing.task
        name = "" if task is None else task.value
        ends = self.controller.reference_ends
        settled = 0.0  # Also while another motion is planned, whose end time is unknown.
        flies = state is ControllerState.TRACKING and task is None and not self._planning.active
        if flies and ends is not None:
            settled = ends + self._config.settle_time
        report, pose = self._command_report, self.controller.goal.base
        leads = self._pursues and not self._holds_until_planned  # The reference, to the goals.
        of_base = self._goals.get(BASE_GOAL_KEY) if leads else None
        told = pose if of_base is not None and of_base.goal_id == goal_id else None
        goal = () if told is None else tuple(told.values.tolist())
        status = ControllerStatus(state, message, goal_id, report, name, settled, goal)
        self.outputs.append(status)

    def _publish_decision(self, state: ControllerState, message: str, goal_id: str) -> None:
        self._publish(state, message, goal_id)
        self._report_decision(state, message, goal_id)

    def _report_task(self, event: Event) -> None:
        """Report an event of a task, and the state of the controller after it."""
        self.outputs.append(replace(event, goal_id=self._goal_id))
        self._next_report = -math.inf

    def _report_decision(self, state: ControllerState, message: str, goal_id: str) -> None:
        kind = EventKind(f"goal_{state.value}")
        self.outputs.append(Event(kind, message, state.level, goal_id=goal_id))

    def _message(self, state: ControllerState) -> str:
        match state:
            case ControllerState.WAITING:
                return "Waiting for states on 'odom'."
            case ControllerState.HOLDING:
                away = self.controller.distance_from_reference()
                if self._guided:
                    return f"Following references; {away} from them."
                if self._planning.active:
                    return f"Planning a motion to the goal; holding, {away} from the reference."
                return f"Waiting for a goal; holding, {away} from the reference."
            case ControllerState.TRACKING if self.servicing.task is not None:
                return self.servicing.message
            case ControllerState.TRACKING:
                away = self.controller.distance_from_reference()
                later = "; planning a motion to a later goal"
                if self._latest_id() == self._goal_id:
                    later = "; planning another motion to it"
                later *= self._planning.active
                if self._holds_until_planned:
                    return (
                        f"Planning a motion to the goal again; holding, {away} from the reference."
                    )
                return f"Flying to the goal; {away} from the reference{later}."
            case ControllerState.STALLED:
                away = self.controller.distance_from_reference()
                limits = tolerance_of(away, self._goal_config)
                return f"Stalled {away} from the reference ({limits}): {self._watch.stall.cause}."
            case (
                ControllerState.REACHED
                | ControllerState.REACHED_PARTLY
                | ControllerState.FAILED
                | ControllerState.ABORTED
            ):
                return self._end_message
            case ControllerState.ESTIMATING:
                elapsed = self.controller.time_since_measurement
                return (
                    f"The base motion is not measured; it has been estimated for {elapsed:.3g} s."
                )
            case ControllerState.STOPPED:
                return (
                    "The base motion is no longer measured: thrusters off, joints brought to rest."
                )
            case ControllerState.REFUSED:
                raise ValueError("a refusal has its own message")


_GAP_REPORT_TIME = 1.0
"""Time, s, for which a gap between states is a possible cause of a loss of control."""

_UNREPORTED_SHARE = 0.1
"""Longest unreported time without a base measurement, as a fraction of ``estimation_time``."""
