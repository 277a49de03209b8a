"""Commanders without ROS: planners and controllers that command a plant state by state.

A commander receives messages as they arrive (goals, odom, joints, plant status) and passes
statuses, events, log lines and commands to its :class:`CommanderHost`, in order. Nodes are hosts
that convert messages; the loop without ROS is a host that passes arrays.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

from spacerobot_ros.commanding.fly_to import FlyTo, FlyToClient, FlyToGoals, GoalErrors, Progress
from spacerobot_ros.commanding.goal_follower import Status, decision_event
from spacerobot_ros.commanding.host import CommanderActivity, CommanderHost, StateDecoder
from spacerobot_ros.commanding.plant_state import (
    InputWatch,
    Pairing,
    PlantChange,
    PlantListener,
    PlantRested,
    PlantStopped,
    Stamped,
    StampFilter,
    StateSynchroniser,
)
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.errors import (
    CommandError,
    PlanningError,
    RobotDescriptionError,
    counted,
    printable,
)
from spacerobot_ros.events import Event
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array, RobotDescription
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.model.shared_parameters import DEFAULT_POSITION_TOLERANCE
from spacerobot_ros.model.urdf import links_with_shapes, obstacles_from_topic
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.core.goal import Tolerance
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import (
    BASE_GOAL_KEY,
    GoalFile,
    GoalIds,
    IdentifiedGoal,
    PursuedGoals,
)
from spacerobot_ros.simulation.status import PlantState, PlantStatus
from spacerobot_ros.times import SECOND

if TYPE_CHECKING:
    from spacerobot_ros.control.executive import ControlExecutive
    from spacerobot_ros.planning.execution.executive import Executive

_LONGEST_REPETITION = 1.0
"""Maximum simulated time between two contradictions that indicates two publishers, s."""

_NEVER_NS = -(10**20)

_REPORT_PERIOD = 1.0  # wall s, between warnings about ignored states

_EQUAL_RATES = 0.05
"""Maximum relative difference between two rates that are considered equal."""

_FAULT_LOG_PERIOD = 5.0  # wall s, of one kind of faulty message


class Commander(ABC):
    """Base class of the commanders: planner and controller.

    A commander sends commands only while it is active and the robot and the plant's rate are known,
    and only for states at the plant's current time (:class:`StampFilter`). Commands follow the
    plant's rate regardless of the configured rate. Goals received before the robot description wait
    for it. All goals are aborted if the plant reports that it ignores commands
    (:class:`PlantListener`).

    ``goal_keys``: the parts of the robot for which goals are accepted; ``pose_required``: whether a
    state waits for its odom message; ``clock`` returns the wall time, s.
    """

    executive: ControlExecutive | Executive | None = None

    _without_goal: ClassVar[tuple[str, str]]
    """State and message of a status without a goal."""

    def __init__(
        self,
        config: PlannerConfig | ControllerConfig,
        host: CommanderHost,
        goal_keys: tuple[str, ...],
        *,
        pose_required: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.config, self.host, self._clock = config, host, clock
        self._given = config
        """The configuration before adaptation to the robot and the plant."""
        self.activity = CommanderActivity.INACTIVE
        self.robot: SpaceRobot | None = None
        self.stamps = StampFilter(clock)
        self.states = StateSynchroniser(pose_required=pose_required)
        self._received: list[Stamped] = []
        """Joint states that are not processed yet, older than those that wait."""
        self._contradicted_ns = _NEVER_NS
        """Stamp of the last pose that contradicted another, ns."""
        self.plant = PlantListener()
        self._decoder: StateDecoder | None = None
        self._described: SpaceRobot | None = None
        """The robot as described, without a held body."""
        self._robot_refusal = ""
        """Why the described robot cannot be commanded; empty: it can, or none is described."""
        self._payload = ""
        self._held: Payload | None = None
        """The body that the robot holds, if its description is valid."""
        self._obstacles: str | None = None
        """The URDF on the topic obstacles; None: the robot's own obstacles apply."""
        self._world: RobotDescription | None = None
        """The obstacles described by that URDF."""
        self._goal_file = GoalFile(config.resume_file, goal_keys)
        self._goal_ids = GoalIds()
        self._refused = "", ""
        """Key and id of the last goal that was refused when it arrived."""
        self._waiting_goals: dict[str, IdentifiedGoal] = {}
        """Goals received before the robot description."""
        self._fly_to = FlyToGoals(self._goal_errors, self._report_aborted)
        self.inputs = InputWatch(self.states, self.plant, host.has_publisher, clock)
        self._reported_missing = "", ""
        """The missing topics in the last status, as a clause, and the goal that waits; empty:
        none."""
        self._last_status: Status | None = None
        """The last status that reported no missing messages."""
        self._ignored_reported, self._next_report = 0, 0.0
        self._fault_log_times: dict[str, float] = {}
        """Wall time of the last log line by kind of fault, s."""

    # -- life cycle ---------------------------------------------------------------------------

    @property
    def active(self) -> bool:
        """Whether states are handled and goals are accepted."""
        return self.activity is CommanderActivity.ACTIVE

    def use_robot(self, robot: SpaceRobot, decoder: StateDecoder) -> None:
        """Set the robot to command, and accept the goals waiting for it.

        Raises
        ------
        SpaceRobotError
            The configuration does not fit the robot.
        """
        self._described, self._payload = robot, self.plant.status.payload
        self.config = self._adapted(self._given)
        robot = self._with_payload(robot)
        self._build_executive(robot, decoder)
        self.robot, self._decoder = robot, decoder
        self._forward_plant_state()
        waiting, self._waiting_goals = self._waiting_goals, {}
        for key, goal in waiting.items():
            self._submit_goal(key, goal)

    def _follow_rate(self) -> None:
        """Command at the rate of the plant, as soon as it is known."""
        present = self.config.tick_rate
        rate = self.plant.status.tick_rate_hz or (
            self.stamps.steady_rate if present else self.stamps.rate
        )
        if not rate or abs(rate - present) <= _EQUAL_RATES * present:
            return
        self.config = replace(self.config, tick_rate=rate)
        given = self._given.tick_rate
        if given and abs(rate - given) > _EQUAL_RATES * given:
            self.host.log(
                "warning",
                f"Parameter 'tick_rate' is {given:g} Hz, but the plant runs at {rate:g} Hz: "
                f"commands follow the plant. Set it to {rate:g}, or omit it.",
            )
        if self.robot is not None and self.executive is not None:
            self._rebuild(self.robot, rate_changed=True)
        self.answer_latest()

    def drop_robot(self, why: str) -> None:
        """Discard the goals and the robot; later goals wait for another robot."""
        if self.executive is not None:
            self.give_up_goals(why)
            self._reset_executive()
        self.robot = self.executive = self._decoder = self._described = None
        self._robot_refusal = ""

    def refuse_robot(self, reason: str) -> None:
        """Report that the described robot cannot be commanded; goals are refused for this reason
        until another robot is described.
        """
        self._robot_refusal = f"The robot on 'robot_description' is refused: {reason}"
        refused, self._waiting_goals = self._waiting_goals, {}
        for goal in refused.values():
            self._refuse_goal(self._robot_refusal, goal.goal_id)
        self._report_missing()

    def activate(self) -> None:
        """Start handling states; resume unfinished goals from an earlier process.

        Raises
        ------
        ParameterError
            The goal file is invalid.
        """
        self.inputs.begin()
        self._reported_missing = "", ""
        self._resume_goals(self._goal_file.load())
        self.activity = CommanderActivity.ACTIVE
        self._report_missing()
        # A lockstep plant may already wait for an answer.
        self.answer()

    def deactivate(self, failure: str = "") -> None:
        """Discard the goals and stop commanding, but keep the goal file; ``failure`` is
        reported."""
        waited = f" while it waited for {missing}" if (missing := self.missing) else ""
        why = f"Aborted: {failure or f'this node was deactivated{waited}.'}"
        if self.config.resume_file:
            why += " A goal from a topic is resumed when the node is activated again."
        if self.activity is not CommanderActivity.INACTIVE:
            self._reset_executive()
        self.activity, self._waiting_goals = CommanderActivity.INACTIVE, {}
        self._fly_to.end_dropped_goals((), why)

    def _reset_executive(self) -> None:
        if self.executive is not None:
            self.executive.reset()
            self._forward_outputs()

    # -- goals --------------------------------------------------------------------------------

    def receive_goal(
        self, key: str, sec: int, nanosec: int, read: Callable[[], Goal]
    ) -> IdentifiedGoal | None:
        """Accept or reject a goal; a status reports the result.

        Parameters
        ----------
        key
            Link to which the goal applies.
        sec, nanosec
            Stamp of the goal's header, which identifies the goal.
        read
            Returns the goal, or raises PlanningError with the reason.

        Returns
        -------
        IdentifiedGoal | None
            The goal; None if it is rejected.
        """
        goal_id = self._goal_ids.of(sec, nanosec)
        try:
            goal = read()
            self._require_free()
        except PlanningError as error:
            self._refused = key, goal_id
            self._refuse_goal(str(error), goal_id)
            return None
        accepted = IdentifiedGoal(goal, goal_id)
        self._fly_to.begin(goal_id)
        self._accept_goal(key, accepted)
        return accepted

    def receive_fly_to(self, goal_id: str, read: Callable[[], FlyTo], client: FlyToClient) -> None:
        """Accept or reject an action goal; the client receives feedback and a result.

        ``read`` returns the goal, or raises PlanningError with the reason.
        """
        try:
            self._require_free()
            request = read()
        except PlanningError as error:
            self._fly_to.begin(goal_id, client, None)
            self._refuse_goal(str(error), goal_id)
            return
        self._fly_to.begin(goal_id, client, request)
        config = self.config
        position = config.position_tolerance or DEFAULT_POSITION_TOLERANCE
        default = Tolerance(position, config.attitude_tolerance, config.joint_tolerance)
        tolerance = request.tolerance_or(default)
        accepted = IdentifiedGoal(
            request.goal, goal_id, tolerance, resumes=False, required=request.tolerance
        )
        self._accept_goal(BASE_GOAL_KEY, accepted)

    def cancel_fly_to(self, goal_id: str) -> None:
        """Abort an action goal; a goal about to be replaced ends when it is replaced."""
        self._fly_to.request_abort(goal_id)
        self._abort_fly_to()

    def abort(self, why: str = "on request") -> str | None:
        """Abort all goals; return a message for the client, or None if there is no goal."""
        if self._waiting_goals:
            message = f"Aborted {why}, before the robot was known."
            self._abort_waiting(message)
            return message
        answer = None
        if self.active and self.executive is not None:
            answer = self.executive.abort(why)
            self._forward_outputs()
        self._goal_file.delete()
        return answer

    def _require_free(self) -> None:
        if not self.active:
            raise PlanningError(f"The goal is refused: this node is {self.activity.value}.")
        plant = self._actuation_refusal or self.plant.refusal_of_goals
        if refusal := self._robot_refusal or plant:
            raise PlanningError(refusal)

    def _accept_goal(self, key: str, goal: IdentifiedGoal) -> None:
        self._fly_to.accepted(goal.goal_id)
        self._goal_file.add_waiting(key, goal)
        if self.executive is None:
            self._waiting_goals[key] = goal
            self._report_missing()
        else:
            self._submit_goal(key, goal)
        if self._fly_to.end_dropped_goals(self._active_goal_ids()):
            # The last published status is about a goal that has ended.
            present, missing = self._last_status, self._reported_missing[0]
            self._reported_missing = "", ""
            if present is not None and present.goal_id in self._active_goal_ids() and not missing:
                self.host.publish_status(present)

    def _refuse_goal(self, message: str, goal_id: str) -> None:
        self._publish_decision(self._make_status("refused", message, goal_id))

    def _abort_waiting(self, message: str) -> None:
        *_, goal = self._waiting_goals.values()
        self._waiting_goals = {}
        self._publish_decision(self._make_status("aborted", message, goal.goal_id))

    def _publish_decision(self, status: Status) -> None:
        self._publish_status(status)
        if status.state.decided:
            self.host.report_event(decision_event(status))

    def _publish_status(self, status: Status) -> None:
        # A replaced goal ends before its successor begins: the last status is for the current goal.
        self._fly_to.end_dropped_goals(self._active_goal_ids() | {status.goal_id})
        self.host.publish_status(status)
        if status.state.value != "waiting":
            self._last_status = status
        if status.state.decided:
            self._goal_file.end(status.goal_id, refused=status.state.value == "refused")
        self._fly_to.update(status)
        if status.state.decided and self.config.stop_when_decided and self.active:
            self.activity = CommanderActivity.DECIDED

    # -- goals of actions ---------------------------------------------------------------------

    def _active_goal_ids(self) -> set[str]:
        pursued = {goal.goal_id for goal in self._waiting_goals.values()}
        if self.active and self.executive is not None:
            pursued |= self.executive.unfinished_goals
            # A status waiting for publication reports the end of its own goal.
            outputs = self.executive.outputs
            pursued |= {each.goal_id for each in outputs if isinstance(each, Status)}
        return pursued

    def _abort_fly_to(self) -> None:
        """Abort all goals if the client or the time limit of one of them requires it."""
        waiting = {goal.goal_id for goal in self._waiting_goals.values()}
        if self.executive is not None:
            waiting |= self.executive.waiting_goals
        why = self._fly_to.abort_reason(waiting)
        if why:
            self.abort(why)

    def _report_aborted(self, goal_id: str, message: str) -> Status:
        """Publish that an action goal was aborted; return the published status."""
        status = self._make_status("aborted", message, goal_id)
        self.host.publish_status(status)
        self.host.report_event(decision_event(status))
        return status

    def _progress(self, goal_id: str, goal: Goal, begun_ns: int) -> Progress:
        phase, remaining = "waiting", None
        if self.executive is not None:
            phase, remaining = self.executive.progress(goal_id)
        now = self.stamps.now_ns
        elapsed, errors = (now - begun_ns) / SECOND, self._goal_errors(goal)
        return Progress(phase, remaining, elapsed, now, self._base_pose(), errors)

    def _goal_errors(self, goal: Goal) -> GoalErrors:
        pose = self._base_pose()
        if pose is None or self.robot is None or self._decoder is None:
            return GoalErrors()
        try:
            return GoalErrors.between(self.robot, pose, self._decoder.q, goal)
        except PlanningError:  # The goal is rejected: the robot lacks a link.
            return GoalErrors()

    def _base_pose(self) -> Array | None:
        odom, decoder = self.states.odom, self._decoder
        # Before the first joint states, the robot's shape is unknown, too.
        if odom is None or decoder is None or self.states.joints is None:
            return None
        try:
            return decoder.decode_base(odom)[0].copy()
        except CommandError:
            return None

    # -- states -------------------------------------------------------------------------------

    def receive_odom(self, stamp_ns: int, odom: Any) -> None:
        """Process a received odom message; defer it if its stamp is not current."""
        if self.stamps.accepts_odom(stamp_ns, odom):
            self.take_odom(stamp_ns, odom)

    def receive_joints(self, stamp_ns: int, joints: Any) -> None:
        """Process received joint states; defer them if their stamp is not current, and skip late
        joint states."""
        self._received.append(Stamped(stamp_ns, joints))
        self._take_waiting()
        if self._fly_to:
            self._fly_to.advance(self.stamps.now_ns, self._progress)
            self._abort_fly_to()
            self._fly_to.end_dropped_goals(self._active_goal_ids())
        if not self.inputs.refusal:
            self.inputs.note_state()

    def take_odom(self, stamp_ns: int, odom: Any) -> None:
        """Process an odom message with a current stamp, and handle its state if complete."""
        if self.states.put_odom(stamp_ns, odom):
            # A single contradiction: the plant was reset or restarted; its status arrives later.
            since = (stamp_ns - self._contradicted_ns) / SECOND
            if 0.0 < since <= max(_LONGEST_REPETITION, 2 * self.config.control_period):
                self._log_fault(
                    "contradiction",
                    "odom: two messages with the same stamp differ; more than one node publishes "
                    "odom, and the poses in such messages are ignored.",
                )
            self._contradicted_ns = stamp_ns
        if self._awaits_odom():
            self.answer()

    def take_joints(self, stamp_ns: int, joints: Any) -> None:
        """Process joint states with a current stamp, and handle their state if complete."""
        self.states.put_joints(stamp_ns, joints)
        if not self.config.tick_rate:
            self._follow_rate()
        if self._reported_missing[0]:
            self.inputs.note_state()
            self._report_missing()
        self.answer()

    def take_accepted_jump(self) -> str:
        """Process the deferred state once its time is accepted; call this ten times per second.

        Return a warning about messages that were ignored, at most once a second; empty: none.
        """
        stamps = self.stamps
        self._follow_rate()
        self._report_missing()
        # A paused plant publishes no state that could contradict a jump.
        jump = None if self.plant.paused else stamps.accepted_jump()
        if jump is not None:
            odom, joints = jump
            if odom is not None:
                self.take_odom(*odom)
            self.take_joints(*joints)
        if stamps.ignored > self._ignored_reported and self._clock() >= self._next_report:
            self._ignored_reported = stamps.ignored
            self._next_report = self._clock() + _REPORT_PERIOD
            self.host.log("warning", stamps.last_ignored)
            return stamps.last_ignored
        return ""

    @property
    def missing(self) -> str:
        """Clause naming the messages for which states wait; empty: none."""
        if self.robot is None:
            if self._robot_refusal:
                return f"another robot. {self._robot_refusal.rstrip('.')}"
            return "a robot on 'robot_description'"
        return self.inputs.missing(self.config.control_period)

    def _report_missing(self) -> None:
        """Report missing messages, and their return, in the status."""
        self.inputs.excuse_suspension()
        missing = self.missing
        goal_id = self._pursued_goal_id if missing else ""
        if (missing, goal_id) == self._reported_missing or not self.active:
            return
        reported, reported_id = self._reported_missing
        if missing and reported and goal_id == reported_id and self.inputs.just_begun:
            return  # The other messages are on their way.
        self._reported_missing = missing, goal_id
        if missing:
            goes_on = " The goal is then pursued." if goal_id else ""
            message = f"Waiting for {missing}.{goes_on}"
            self._publish_status(self._make_status("waiting", message, goal_id))
        else:
            self._report_present_status()

    def answer_latest(self) -> None:
        """Handle the latest received state, after work that kept states waiting."""
        self._take_waiting()
        self.answer()

    def _take_waiting(self) -> None:
        """Process received and waiting states."""
        # A status that is processed before them may itself need the latest state.
        odoms, waiting = self.host.waiting_states()
        states = [*self._received, *waiting]
        self._received.clear()
        self._take_states(odoms, states)

    def _take_states(self, odoms: Sequence[Stamped], states: Sequence[Stamped]) -> None:
        """Process waiting messages; of the states at the current time, only the last one.

        An answer to an earlier state would be too late, and the joint motion before the first
        answer does not show whether the joints obey it.
        """
        states = [each for each in states if self._is_of_robot(each.message)]
        present = [each.stamp_ns for each in states if self.stamps.is_present(each.stamp_ns)]
        last = max(present, default=self.stamps.now_ns)
        later = [each for each in odoms if each.stamp_ns > last]
        for each in odoms:
            if each.stamp_ns <= last:
                self.receive_odom(*each)
        for each in states:
            skipped = each.stamp_ns in present and each.stamp_ns < last
            if not skipped and self.stamps.accepts_joints(*each):
                self.take_joints(*each)
        for each in later:
            self.receive_odom(*each)

    def _is_of_robot(self, joints: Any) -> bool:
        # Joint states of another robot neither set the time nor replace this robot's.
        try:
            if self._decoder is not None:
                self._decoder.check_robot(joints)
        except CommandError as error:
            self.inputs.refusal = str(error)
            self._log_fault("joints", f"joint_states: {error}.")
            return False
        self.inputs.refusal = ""
        return True

    def _log_fault(self, kind: str, message: str) -> None:
        now = self._clock()
        if now - self._fault_log_times.get(kind, -_FAULT_LOG_PERIOD) >= _FAULT_LOG_PERIOD:
            self._fault_log_times[kind] = now
            self.host.log("error", message)

    # -- the plant ----------------------------------------------------------------------------

    def interrupt(self) -> None:
        """Cancel the planning in progress; any thread may call this."""
        if self.executive is not None:
            self.executive.cancel_plan()

    def receive_plant_status(self, status: PlantStatus, name: str = "plant") -> None:
        """React to a status from the named plant."""
        executive, before = self.executive, self.plant.status.state
        changes = self.plant.update(status, name)
        if before in (PlantState.PAUSED, PlantState.INACTIVE) and status.state is not before:
            self.inputs.note_state()  # While time is stopped, states are not missing.
        for change in changes:
            if isinstance(change, PlantStopped):
                self.give_up_goals(change.reason)
            if change is PlantChange.RESET:
                self.states.forget_pose()
                self._contradicted_ns = _NEVER_NS
            if executive is not None:
                if isinstance(change, PlantRested):
                    executive.plant_rested(change.commanded_until_ns, change.since_ns)
                elif change is PlantChange.RESET:
                    executive.plant_reset()
                elif change is PlantChange.OBEYS:
                    executive.on_plant_obeying()
        if self.plant.in_lockstep and self.config.plan_in_background:
            self.config = self._adapted(self.config)
            if executive is not None:
                executive.plan_at_once()
        self._forward_outputs()
        self._forward_plant_state()
        if self._actuation_refusal:
            self._log_fault("actuation", self._actuation_refusal)
        self._follow_rate()
        if self.plant.status.payload != self._payload:
            self._payload = self.plant.status.payload
            if self._described is not None:
                self.robot = self._with_payload(self._described)
                self._rebuild(self.robot, rate_changed=False)

    def receive_obstacles(self, text: str) -> None:
        """Plan around the obstacles in a URDF string from now on, if valid; empty: no obstacles."""
        if text == self._obstacles:
            return
        try:
            self._world = obstacles_from_topic(text)
        except RobotDescriptionError as refusal:
            kept = "The previous obstacles are kept."
            self._log_fault("obstacles", printable(f"obstacles: {refusal} {kept}"))
            return
        self._obstacles = text
        links = [] if self._world is None else links_with_shapes(self._world)
        listed = f": {', '.join(links)}" if links else ""
        self.host.log("info", printable(f"Plans avoid {counted(len(links), 'obstacle')}{listed}."))
        self._use_obstacles()

    def _with_payload(self, robot: SpaceRobot) -> SpaceRobot:
        self._held = None
        if self._payload:
            try:
                held = Payload.from_text(self._payload)
                robot, self._held = held.attached_to(robot), held
            except RobotDescriptionError as error:
                self.host.log("error", f"plant/status: {error}")
        return robot

    def give_up_goals(self, why: str) -> None:
        """Abort the goals, because the plant ignores commands or is silent."""
        self._goal_file.delete()
        if self.executive is not None:
            self.executive.plant_stopped(why)
            self._forward_outputs()
        elif self._waiting_goals:
            self._abort_waiting(f"Aborted by the plant: {why}")

    # -- differences --------------------------------------------------------------------------

    @abstractmethod
    def _use_obstacles(self) -> None:
        """Make the executive plan around other obstacles."""

    @abstractmethod
    def _make_status(self, state: str, message: str, goal_id: str) -> Status:
        """Return a status for a goal that is unknown to the executive."""

    @abstractmethod
    def _build_executive(self, robot: SpaceRobot, decoder: StateDecoder) -> None:
        """Build the executive."""

    @abstractmethod
    def _rebuild(self, robot: SpaceRobot, *, rate_changed: bool) -> None:
        """Make the executive command a robot with the same joints but other masses, or at the
        changed rate in the current configuration."""

    def reconfigure(self, config: Any) -> None:
        """Copy the parameters that may change at run time from another configuration."""
        adapted = self._adapted(config)
        self._given, self.config = config, adapted
        if self.executive is not None:
            self.executive.configure(adapted)

    def _adapted(self, config: Any) -> Any:
        """Return a configuration for the robot and the plant; a lockstep plant waits for plans."""
        background = config.plan_in_background and not self.plant.in_lockstep
        config = replace(config, tick_rate=self.config.tick_rate, plan_in_background=background)
        return config if self._described is None else config.for_robot(self._described.description)

    @property
    def _pursued_goal_id(self) -> str:
        """Id of a pursued or waiting goal; empty: none."""
        return min(self._active_goal_ids(), default="")

    def _report_present_status(self) -> None:
        status, goal_id = self._last_status, self._pursued_goal_id
        if not goal_id:
            self._publish_status(self._make_status(*self._without_goal, ""))
        elif status is not None and status.goal_id == goal_id and not status.state.decided:
            self._publish_status(status)

    @property
    @abstractmethod
    def _actuation_refusal(self) -> str:
        """Message about a plant that expects other commands; empty: it accepts these commands."""

    @abstractmethod
    def _resume_goals(self, saved: Mapping[str, IdentifiedGoal]) -> None:
        """Accept the goals of an earlier commander."""

    @abstractmethod
    def _submit_goal(self, key: str, goal: IdentifiedGoal) -> None:
        """Pass a goal to the executive."""

    def answer(self) -> None:
        """Handle a ready state once, if the commander is active and the rate is known."""
        if self.executive is not None and self.active and self.config.tick_rate > 0:
            pairing = self.states.take_ready()
            if pairing is not None:
                self._answer_state(pairing)

    @abstractmethod
    def _answer_state(self, pairing: Pairing) -> None:
        """Handle the state of the latest messages."""

    @abstractmethod
    def _forward_plant_state(self) -> None:
        """Inform the executive whether the plant obeys commands."""

    def _awaits_odom(self) -> bool:
        """Whether the commander uses an odom message that arrives after its joint states."""
        return True

    def _forward_outputs(self) -> None:
        """Publish the outputs collected by the executive, and store its goals in the goal file."""
        while self.executive is not None and self.executive.outputs:
            match self.executive.outputs.popleft():
                case Event() as event:
                    self.host.report_event(event)
                case PursuedGoals() as pursued:
                    if problem := self._goal_file.pursue(pursued):
                        self.host.log("error", problem)
                case output:
                    self._forward(output)

    def _forward(self, output: Any) -> None:
        """Publish a status, or another output that only this executive has."""
        self._publish_status(output)
