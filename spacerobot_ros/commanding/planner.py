"""The planner without ROS: a joint setpoint for every state, or schedules for the trajectory server
of the robot."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from enum import IntEnum
from typing import Any, Protocol

from spacerobot_ros.commanding.commander import Commander
from spacerobot_ros.commanding.host import CommanderHost, StateDecoder
from spacerobot_ros.commanding.plant_state import Pairing
from spacerobot_ros.errors import CommandError, PlanningError, printable
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.urdf import with_world
from spacerobot_ros.planning.core.method import GaitMethod
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Executive
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, IdentifiedGoal
from spacerobot_ros.planning.execution.measured_states import BaseMeasurement, MeasuredState
from spacerobot_ros.planning.execution.status import (
    Notice,
    Phase,
    PlannerState,
    PlannerStatistics,
    PlannerStatus,
    ScheduleStart,
    Transition,
)
from spacerobot_ros.planning.execution.teleoperation import TwistCommand
from spacerobot_ros.planning.execution.tracker import Setpoint
from spacerobot_ros.planning.execution.worker import PlanningWorker
from spacerobot_ros.simulation.status import PlantStatus
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import link_topic


class PlannerCommander(Commander):
    """Sends a joint setpoint for every state (:class:`Executive`).

    Parameters
    ----------
    config, host, clock
        See :class:`Commander`.
    method
        Gait method; None: the configured method.
    long_work
        Context for long planning.
    """

    config: PlannerConfig
    executive: Executive | None
    _without_goal = "idle", "Waiting for a goal pose."

    def __init__(
        self,
        config: PlannerConfig,
        host: CommanderHost,
        *,
        method: GaitMethod | None = None,
        long_work: Callable[[], AbstractContextManager[None]] = nullcontext,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        super().__init__(config, host, (BASE_GOAL_KEY,), pose_required=False, clock=clock)
        self._method, self._on_long_work = method, long_work
        self._last_goal: IdentifiedGoal | None = None
        self._status: PlannerStatus | None = None
        self._disturbances: tuple[str, ...] = ()
        self.trajectories: TrajectoryOutput | None = None
        """Receives schedules, for ``output: trajectory``."""

    def _make_status(self, state: str, message: str, goal_id: str) -> PlannerStatus:
        return PlannerStatus(PlannerState(state), message, goal_id)

    @property
    def statistics(self) -> PlannerStatistics:
        """Number of plans and commands so far."""
        return PlannerStatistics() if self.executive is None else self.executive.statistics

    @property
    def setpoint(self) -> Setpoint:
        """The command for the last state."""
        assert self.executive is not None
        return self.executive.setpoint

    def _build_executive(self, robot: SpaceRobot, decoder: StateDecoder) -> None:
        worker = self._make_worker(robot)
        self.executive = Executive(robot, self.config, worker)

    def _make_worker(self, robot: SpaceRobot) -> PlanningWorker:
        described = robot.description
        # A given method is for the robot without its payload.
        method = self._method if robot is self._described else None
        if self._obstacles is not None:
            described = with_world(described, self._world)
        return PlanningWorker(robot, self.config, method, self._on_long_work, described)

    def end_schedule(self, why: str, final: bool) -> None:
        """End the current schedule, because the controller that executes it has ended it."""
        if self.executive is not None:
            self.executive.schedule_ended(why, final=final)

    def _use_obstacles(self) -> None:
        executive, robot = self.executive, self.robot
        if executive is not None and robot is not None:
            with self._on_long_work():
                executive.use_obstacles(lambda: self._make_worker(robot))
            self._forward_outputs()

    def _rebuild(self, robot: SpaceRobot, *, rate_changed: bool) -> None:
        assert self.executive is not None
        with self._on_long_work():
            worker = self._make_worker(robot)
        self.executive.use_robot(robot, worker, self.config if rate_changed else None)
        self._forward_outputs()

    @property
    def _actuation_refusal(self) -> str:
        if self.config.output != "commands" or self.plant.status.actuation != "effort":
            return ""
        return (
            "The plant expects efforts, but this planner sends velocities: start the plant with "
            "actuation:=velocity, or the planner with output:=reference together with a "
            "coordinated_control."
        )

    def _resume_goals(self, saved: Mapping[str, IdentifiedGoal]) -> None:
        goal = saved.get(BASE_GOAL_KEY)
        if goal is None:
            if not self.missing:
                self._report_present_status()
            return
        state = PlannerState.WAITING if self.robot is None else PlannerState.PLANNING
        self._publish_status(PlannerStatus.of_goal(state, "Resuming an earlier goal.", goal))
        self._accept_goal(BASE_GOAL_KEY, goal)

    def _accept_goal(self, key: str, goal: IdentifiedGoal) -> None:
        """Accept a goal; base and end-effector goals with the same stamp form one goal."""
        refused_key, refused_id = self._refused
        if goal.goal_id == refused_id and key != refused_key:
            self._refuse_goal("Another pose of the goal is refused.", goal.goal_id)
            return
        last = self._last_goal
        if last is not None and last.goal_id == goal.goal_id and goal.goal_id:
            goal = replace(goal, goal=last.goal.joined_with(goal.goal))
        self._last_goal = goal
        super()._accept_goal(BASE_GOAL_KEY, goal)

    def _refuse_goal(self, message: str, goal_id: str) -> None:
        if goal_id in self._active_goal_ids():
            self.abort(f"because another pose of the goal is refused: {message.rstrip('.')}")
        else:
            super()._refuse_goal(message, goal_id)

    def receive_twist(self, link: str, frame: str, linear: Array, angular: Array) -> None:
        """Make a link follow a twist until no more twists arrive; if this is impossible, the reason
        is logged.

        Parameters
        ----------
        link
            Name of the link.
        frame
            Frame of the velocity and the angular velocity: world, base, or the link itself.
        linear, angular
            (3,) velocity of the link's origin, m/s, and angular velocity, rad/s.
        """
        try:
            if not self.active:
                raise PlanningError(f"This node is {self.activity.value}.")
            if self.plant.refusal_of_goals:
                raise PlanningError(self.plant.refusal_of_goals)
            if self.executive is None or self.robot is None:
                raise PlanningError("There is no robot on robot_description yet.")
            world = self.config.world_frame
            twist = TwistCommand.checked(self.robot, link, linear, angular, frame, world)
            with self._on_long_work():
                self.executive.propose_twist(twist)
        except PlanningError as refusal:
            self._log_fault("twist", f"{link_topic(link, 'twist')}: {refusal}")

    def _submit_goal(self, key: str, goal: IdentifiedGoal) -> None:
        assert self.executive is not None
        assert self.robot is not None
        try:
            named = replace(goal, goal=goal.goal.for_robot(self.robot.description))
        except PlanningError as refusal:
            self._refuse_goal(str(refusal), goal.goal_id)
            return
        self.executive.propose_goal(named)

    def receive_plant_status(self, status: PlantStatus, name: str = "plant") -> None:
        """React to a status of the named plant."""
        super().receive_plant_status(status, name)
        begun = [each for each in status.disturbances if each not in self._disturbances]
        self._disturbances = status.disturbances
        if self._status is not None and self._status.state is PlannerState.EXECUTING:
            self._warn_of_disturbances(begun)

    def _warn_of_disturbances(self, lines: Sequence[str]) -> None:
        """Report disturbances unknown to a schedule; with a controller, they are compensated."""
        if lines and self._status is not None and self.config.output != "reference":
            message = (
                "The plan assumes constant momenta, but a disturbance changes them: "
                f"{'; '.join(lines)}."
            )
            goal_id = self._status.goal_id
            self.host.report_event(Event(EventKind.PLAN_DISTURBED, message, 1, goal_id=goal_id))

    def _forward_plant_state(self) -> None:
        if self.executive is not None:
            self.executive.plant_rests = self.plant.has_no_command

    def _awaits_odom(self) -> bool:
        # Planning or evaluating a goal requires every pose, even if it arrives after its joints.
        return self.executive is not None and self.executive.measuring

    def _answer_state(self, pairing: Pairing) -> None:
        """Answer a state as soon as its joints have arrived; only plans need its pose."""
        executive, decoder, states = self.executive, self._decoder, self.states
        assert executive is not None
        assert decoder is not None
        try:
            stamp = decoder.decode_joints(states.joints)
        except CommandError as error:
            self._log_fault("state", f"joint_states: {error}.")
            return
        base = None
        if pairing is not Pairing.WITHOUT_POSE:
            try:
                base = BaseMeasurement(*decoder.decode_base(states.odom), decoder.qdot)
            except CommandError as error:
                self._log_fault("odom", f"odom: {error}.")
        measured = MeasuredState(stamp, decoder.q, base)
        if pairing is Pairing.LATE_POSE:
            # The state was answered without its pose; a plan uses the pose at the next joints.
            executive.add_base_measurement(measured)
            return
        if self.trajectories is not None:
            self.trajectories.check_server(stamp)
        executive.update(measured)
        self._forward_outputs()
        if self.active:
            self.host.send_command(stamp)

    def _forward(self, output: Any) -> None:
        host = self.host
        match output:
            case PlannerStatus() as status:
                self._status = status
                self._publish_decision(status)
            case ScheduleStart() as start:
                host.publish_plan(start.schedule.path, start.stamp_ns, start.schedule)
                if self.trajectories is not None:
                    self.trajectories.start(start)
                self._warn_of_disturbances(self._disturbances)
            case Notice(level, message):
                host.log(level, message)
            case Transition(source, event, target):
                host.log("debug", f"{source.value} -> {target.value}: {event.value}")
                if self.trajectories is not None:
                    self.trajectories.on_phase_change(target)


# -- schedules executed by a FollowJointTrajectory server, one at a time ----------------------

_ANSWER_TIMEOUT_NS = 5 * SECOND
_SERVER_CHECK_PERIOD_NS = SECOND

_PHASES_OF_MOTION = (Phase.EXECUTING, Phase.REPLANNING, Phase.TAKING_OVER, Phase.PLANNING)
"""Phases in which a schedule continues; in PLANNING, the next schedule replaces it."""


class ErrorCode(IntEnum):
    """``error_code`` in a control_msgs/action/FollowJointTrajectory result."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    INVALID_JOINTS = -2
    OLD_HEADER_TIMESTAMP = -3
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


class Outcome(IntEnum):
    """Final state of an action goal: ``status`` in action_msgs/GoalStatus."""

    SUCCEEDED = 4
    CANCELED = 5
    ABORTED = 6


class TrajectoryServer(Protocol):
    """The connection to the action server."""

    def is_available(self) -> bool:
        """Whether the server is available."""

    def send(self, number: int, start: ScheduleStart) -> None:
        """Send a schedule."""

    def cancel(self, number: int) -> None:
        """Cancel a schedule, whether or not it has been accepted."""


class TrajectoryOutput:
    """Sends each schedule to a server, evaluates its result, and cancels abandoned schedules.

    The responses of the server contain the schedule number; a response about a replaced or
    cancelled schedule is ignored.

    Parameters
    ----------
    server
        The connection.
    name
        Name of the action, for messages.
    on_end
        Called once for each schedule that ends without being replaced or cancelled, with the reason
        for an early end, as a clause (empty: the schedule was completed), and whether a correction
        would end in the same way; if so, none is planned.
    """

    def __init__(
        self, server: TrajectoryServer, name: str, on_end: Callable[[str, bool], None]
    ) -> None:
        self._server, self._name, self._on_end = server, name, on_end
        self._number = 0
        """Number of the latest schedule."""
        self._sent: int | None = None
        """Number of the schedule without a result."""
        self._replaced: int | None = None
        """Number of the schedule replaced by the latest schedule, until the latest schedule is
        accepted."""
        self._accepted = False
        self._watched_ns: int | None = None
        """Stamp of the first state after the latest schedule was sent, ns."""
        self._looked_ns = 0
        """Stamp of the last check for the server, ns."""

    def start(self, start: ScheduleStart) -> None:
        """Send a schedule; it replaces the current schedule."""
        self._number += 1
        self._replaced, self._sent, self._accepted = self._sent, self._number, False
        self._watched_ns = None
        if not self._server.is_available():
            self._end(f"the action '{self._name}' has no server")
            return
        self._server.send(self._number, start)

    def check_server(self, now_ns: int) -> None:
        """End a schedule if its server does not respond or no longer exists; called for every
        state."""
        if self._sent is None:
            return
        if self._watched_ns is None or now_ns < self._watched_ns:
            self._watched_ns = self._looked_ns = now_ns
        if not self._accepted and now_ns - self._watched_ns > _ANSWER_TIMEOUT_NS:
            self._give_up(f"the action '{self._name}' has not responded")
        elif now_ns - self._looked_ns >= _SERVER_CHECK_PERIOD_NS:
            self._looked_ns = now_ns
            if not self._server.is_available():
                self._give_up(f"the server of the action '{self._name}' is gone")

    def _give_up(self, why: str) -> None:
        assert self._sent is not None
        self._server.cancel(self._sent)
        self._end(why)

    def on_phase_change(self, phase: Phase) -> None:
        """Cancel the schedule if the planner has abandoned it."""
        sent = self._sent
        if sent is None or phase in _PHASES_OF_MOTION:
            return
        self._sent = self._replaced = None
        self._server.cancel(sent)

    def accepted(self, number: int) -> None:
        """Record that the server is now executing a schedule."""
        if number == self._sent:
            self._accepted, self._replaced = True, None

    def rejected(self, number: int) -> None:
        """End a schedule rejected by the server, and the schedule that it would have replaced."""
        if number != self._sent:
            return
        if self._replaced is not None:
            self._server.cancel(self._replaced)
        self._end(f"the action '{self._name}' has rejected the trajectory")

    def ended(self, number: int, outcome: int, code: int, text: str) -> None:
        """End a schedule with the result of the server: its :class:`Outcome`, ``error_code`` and
        ``error_string``."""
        if number == self._sent:
            self._end(*_motion_end(outcome, code, text))

    def _end(self, why: str, final: bool = True) -> None:
        self._sent = self._replaced = None
        self._on_end(why, final)


def _motion_end(outcome: int, code: int, text: str) -> tuple[str, bool]:
    if outcome == Outcome.SUCCEEDED and code == ErrorCode.SUCCESSFUL:
        return "", False
    text = printable(text).rstrip(".")
    told = f": {text}" if text else ""
    if outcome == Outcome.CANCELED:
        return f"another client has replaced or cancelled the trajectory{told}", True
    if code == ErrorCode.SUCCESSFUL:
        return f"the trajectory was aborted without an error code{told}", True
    try:
        name = ErrorCode(code).name
    except ValueError:
        name = f"error code {code}"
    violated = code in (ErrorCode.PATH_TOLERANCE_VIOLATED, ErrorCode.GOAL_TOLERANCE_VIOLATED)
    return f"the trajectory ended early with {name}{told}", not violated
