"""Coordinated control without ROS: a wrench and joint efforts for every state."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from spacerobot_ros.commanding.commander import Commander
from spacerobot_ros.commanding.goal_follower import Status
from spacerobot_ros.commanding.host import CommanderHost, StateDecoder
from spacerobot_ros.commanding.plant_state import Pairing, Stamped
from spacerobot_ros.control import ControlState, NotFiniteError, PoseReference, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import CoordinatedController, build_controller
from spacerobot_ros.control.executive import ControlExecutive
from spacerobot_ros.control.goals import GOAL_KEYS
from spacerobot_ros.control.planned_reference import PlannedReference
from spacerobot_ros.control.reference import HeldVelocityReference, ReferenceProfile
from spacerobot_ros.control.servicing import Task
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import CommandError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.grasp import Payload
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.goal_file import BASE_GOAL_KEY, IdentifiedGoal
from spacerobot_ros.times import SECOND

JOINT_REFERENCE, BASE_REFERENCE = "joint_reference", "base_reference"
"""Reference topics for a controller; states wait for every topic with a publisher."""

TARGET_ODOMETRY = "target/odom"
"""Topic of the measured target motion."""

_LONGEST_CHECK_PERIOD = 0.2
"""Maximum wall time between two checks of waiting states, s: after a longer gap this process was
suspended."""


@dataclass
class _ReferenceWait:
    """How long states have waited for a reference topic since its last message."""

    missed_since_ns: int | None = None
    """Stamp of the first state without its reference, ns."""
    waited: float = 0.0
    """Wall time for which states have waited, s."""
    silent: bool = False
    """Whether states no longer wait for the topic."""


class ControllerCommander(Commander):
    """Commands a wrench and joint efforts for every state (:class:`ControlExecutive`).

    ``effort`` (n,), N m or N, and ``wrench`` (6,), N and N m in the base frame, are the values of
    the last command.

    Parameters
    ----------
    config, host, clock
        See :class:`Commander`.
    partner_is_busy
        Whether a planner has announced long planning; if so, states wait for its reference.
    """

    config: ControllerConfig
    executive: ControlExecutive | None
    _without_goal = "holding", "Waiting for a goal; the robot holds its pose."

    def __init__(
        self,
        config: ControllerConfig,
        host: CommanderHost,
        *,
        clock: Callable[[], float] = time.monotonic,
        partner_is_busy: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(config, host, GOAL_KEYS, pose_required=True, clock=clock)
        self._partner_is_busy = partner_is_busy
        self._references: dict[str, _ReferenceWait] = {}
        self._looked = clock()
        """Wall time of the last check of waiting states, s."""
        self._pose_has_come = self._odom_was_connected = False
        self.effort, self.wrench = np.zeros(0), np.zeros(6)
        self._target: RobotDescription | None = None
        self._target_odometry: Stamped | None = None
        """The latest target odometry, until it is read."""
        self._published_plan: ReferenceProfile | None = None

    def _make_status(self, state: str, message: str, goal_id: str) -> ControllerStatus:
        return ControllerStatus(ControllerState(state), message, goal_id)

    def activate(self) -> None:
        """Start handling states; each state waits for the references that have a publisher."""
        for topic in (JOINT_REFERENCE, BASE_REFERENCE):
            self.states.require(topic, required=self.host.has_publisher(topic))
            self._references[topic] = _ReferenceWait()
        super().activate()

    def dump_momentum(self) -> str:
        """Dump the reaction wheel momentum; return a message.

        Raises
        ------
        CommandError
            The momentum is not dumped; the message states the reason.
        """
        return self._active_executive().dump_momentum()

    def request(self, task: Task) -> str:
        """Start a task without a subsequent goal; return a message.

        Raises
        ------
        CommandError
            The task is rejected; the message states the reason.
        """
        executive = self._active_executive()
        if self.plant.refusal_of_goals:
            raise CommandError(self.plant.refusal_of_goals)
        if task is Task.APPROACH and self._target is None:
            raise CommandError(
                "There is no target to approach: no message has arrived on "
                "'target/robot_description'."
            )
        executive.request(task)
        return f"The task '{task.value}' has started; controller/status reports its progress."

    def _active_executive(self) -> ControlExecutive:
        if self.executive is None or not self.active:
            raise CommandError("The controller is not active, or has no robot yet.")
        return self.executive

    def use_target(self, target: RobotDescription) -> None:
        """Process the target description."""
        self._target = target
        if self.executive is not None:
            frame = self.config.target.grapple_frame
            self.executive.servicing.target.describe(target, frame)

    def receive_target(self, stamp_ns: int, message: Any) -> None:
        """Store target odometry; it is used at the next state if a task needs it.

        States do not wait for it: the motion since the last odometry is predicted.
        """
        if self.executive is not None and self.executive.servicing.needs_target:
            self._target_odometry = Stamped(stamp_ns, message)

    def receive_reference(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Process a reference, and handle its state if complete."""
        self.states.put_required(topic, stamp_ns, message)
        before = self._references.get(topic)
        self._references[topic] = _ReferenceWait()
        if before is not None and before.silent:
            self.host.log(
                "info", f"'{topic}' is no longer silent: the controller follows it again."
            )
        self.answer()

    def take_odom(self, stamp_ns: int, odom: Any) -> None:
        """Process an odom message with a current stamp, after handling any state whose reference
        never arrived."""
        missing = self.states.missing
        if missing and self.active and self.executive is not None:
            pairing = self.states.take_overdue()
            assert pairing is not None
            self._answer_state(pairing)
            # Continue without references missed for their timeout of simulated time.
            now, timeout = self.stamps.now_ns, self.config.reference_timeout
            for topic in missing:
                wait = self._references[topic]
                if wait.missed_since_ns is None:
                    wait.missed_since_ns = now
                if timeout and now - wait.missed_since_ns >= timeout * SECOND:
                    self._do_without(topic)
        super().take_odom(stamp_ns, odom)

    def take_accepted_jump(self) -> str:
        """Process a deferred state once its time is accepted, and continue without references that
        have stopped time for their timeout of wall time."""
        warning = super().take_accepted_jump()
        if not self.active:
            return warning
        now, timeout = self._clock(), self.config.reference_timeout
        elapsed, self._looked = min(now - self._looked, _LONGEST_CHECK_PERIOD), now
        missing = () if self.executive is None else self.states.missing
        for topic in missing:
            wait = self._references[topic]
            # A planner that plans for a long time answers afterwards, unless it is killed.
            if not (self._partner_is_busy() and self.host.has_publisher(topic)):
                wait.waited += elapsed
            if timeout and wait.waited >= timeout:
                self._do_without(topic)
        if missing:
            self.answer()
        return warning

    def _do_without(self, topic: str) -> None:
        assert self.executive is not None
        followed = self.states.latest(topic) is not None
        self.states.require(topic, required=False)
        self._references[topic] = _ReferenceWait(silent=True)
        if followed:
            self.executive.references_ended()
        self.host.log("warning", f"'{topic}' is silent: the controller continues without it.")

    def _publish_status(self, status: Status) -> None:
        silent = " and ".join(sorted(t for t, each in self._references.items() if each.silent))
        if silent and status.state is not ControllerState.REFUSED:
            status = replace(status, message=f"{status.message} There is no reference on {silent}.")
        super()._publish_status(status)

    def take_joints(self, stamp_ns: int, joints: Any) -> None:
        """Process joint states with a current stamp, after handling any state whose odom message
        never arrived."""
        overdue = None
        if self.active and self.executive is not None and not self._waits_for_first_pose():
            overdue = self.states.take_overdue()
        if overdue is not None:
            # An answer to a state whose pose was lost would come a tick late, so the state only
            # advances the estimate.
            self._answer_state(overdue, send=overdue is Pairing.WHOLE)
        super().take_joints(stamp_ns, joints)

    def rehearse(self) -> None:
        """Rehearse a goal and a pose loss, also with a captured target, so that no function is
        compiled in flight.

        Otherwise compilation could keep the plant waiting longer than its ``command_timeout``.
        """
        if self.robot is None:
            return
        self._rehearse_with(self.robot)
        link = self.robot.description.end_effector(self.config.end_effector_frame)
        if self._target is not None and link:
            inertia = self._target.bodies[0].inertia
            self._rehearse_with(Payload.in_generic_pose(link, inertia).attached_to(self.robot))

    def _rehearse_with(self, robot: SpaceRobot) -> None:
        controller = build_controller(robot, self.config)
        controller.gains_checked = True  # The first measured state is more informative.
        executive = ControlExecutive(controller, self.config)
        q, rates = np.clip(np.zeros(robot.n), robot.lower, robot.upper), np.zeros(robot.n)
        upright = np.array([0.0, 0.0, 0.0, 1.0])
        state = ControlState.at_rest(np.zeros(3), upright, q)
        for tick, measured in enumerate((state, state, None, None)):
            if tick == 1:
                with suppress(PlanningError):  # The law may not control the base.
                    goal = Goal(state.r_WB, upright)
                    executive.submit(BASE_GOAL_KEY, IdentifiedGoal(goal, resumes=False))
            now = tick * self.config.control_period
            executive.evaluate(now, executive.command(now, measured, q, rates))

    def _build_executive(self, robot: SpaceRobot, decoder: StateDecoder) -> None:
        self.executive = ControlExecutive(self._built_controller(robot), self.config)
        self.executive.servicing.hold(self._held)
        if self._target is not None:
            self.use_target(self._target)
        self.effort = np.zeros(robot.n)
        self._held_velocities = HeldVelocityReference(self.config.control_period)

    def _rebuild(self, robot: SpaceRobot, *, rate_changed: bool) -> None:
        assert self.executive is not None
        self.executive.use_controller(self._built_controller(robot), self._held)
        if rate_changed:
            self.executive.configure(self.config)
            self.rehearse()
            self._held_velocities = HeldVelocityReference(self.config.control_period)

    def _built_controller(self, robot: SpaceRobot) -> CoordinatedController:
        controller = build_controller(robot, self.config)
        if controller.planner is not None and self._obstacles is not None:
            controller.planner.use_obstacles(self._world)
        return controller

    def _use_obstacles(self) -> None:
        if self.executive is not None:
            self.executive.use_obstacles(self._world)

    @property
    def _actuation_refusal(self) -> str:
        if self.plant.status.actuation != "velocity":
            return ""
        return (
            "The plant expects velocities, but this controller sends efforts and a wrench: start "
            "the "
            "plant with actuation:=effort."
        )

    def _resume_goals(self, saved: Mapping[str, IdentifiedGoal]) -> None:
        if self.executive is None:
            self._waiting_goals = dict(saved)
        else:
            self.executive.resume(saved)
        if saved:
            self.host.log("info", "Resuming an earlier goal.")

    def _submit_goal(self, key: str, goal: IdentifiedGoal) -> None:
        assert self.executive is not None
        try:
            self.executive.submit(key, goal)
        except PlanningError as error:
            controlled = getattr(self.executive.controller.law.outputs.selection, key)
            # A goal that was sent to all commanders is for the planner whose reference the law
            # tracks; the client of an action waits for the controller's answer.
            if goal.resumes and not controlled and self.host.has_publisher(JOINT_REFERENCE):
                self._fly_to.leave(goal.goal_id)
                self._goal_file.end(goal.goal_id, refused=True)
                self.host.log("info", f"The goal is left to the planner. {error}")
            else:
                self._refuse_goal(str(error), goal.goal_id)

    def _forward_plant_state(self) -> None:
        if self.executive is not None:
            self.executive.plant_blocked = bool(self.plant.refusal_of_goals)
            self.executive.take_contacts(self.plant.status.contacts, self.plant.status.time_s)

    def _waits_for_first_pose(self) -> bool:
        """Whether the last state arrived before odom was connected; its pose is not lost."""
        if self._pose_has_come:
            return False
        before, self._odom_was_connected = self._odom_was_connected, self.host.has_publisher("odom")
        return not before

    def _answer_state(self, pairing: Pairing, *, send: bool = True) -> None:
        executive, decoder, states = self.executive, self._decoder, self.states
        assert executive is not None
        assert decoder is not None
        self._pose_has_come = self._pose_has_come or pairing is Pairing.WHOLE
        try:
            stamp = decoder.decode_joints(states.joints)
        except CommandError as error:
            self._log_fault("state", f"The state is rejected: {error}")
            return
        try:
            q, qdot, measured = decoder.q, decoder.qdot, None
            if pairing is Pairing.WHOLE:
                pose, twist = map(np.array, decoder.decode_base(states.odom))
                measured = ControlState(pose[:3], pose[3:], twist[:3], twist[3:], q, qdot)
            now = stamp / SECOND
            if self._target_odometry is not None:
                (measured_ns, message), self._target_odometry = self._target_odometry, None
                executive.servicing.target.measure(measured_ns / SECOND, *decoder.target(message))
            result = executive.command(now, measured, q, qdot, self._reference(decoder))
            profile = executive.controller.profile
            if profile is not self._published_plan and isinstance(profile, PlannedReference):
                self.host.publish_plan(profile.path, stamp)
            self._published_plan = profile
            self._forward_outputs()
        except (CommandError, NotFiniteError) as error:
            self._log_fault("state", f"The state is rejected: {error}")
            return
        self.effort[:], self.wrench[:] = result.realised.tau, result.realised.wrench_B
        if send:
            self.host.send_command(stamp)
        executive.evaluate(now, result)
        self._forward_outputs()

    def _reference(self, decoder: StateDecoder) -> Reference | None:
        base, joints = self.states.latest(BASE_REFERENCE), self.states.latest(JOINT_REFERENCE)
        if base is None and joints is None:
            return None
        base_reference, joint_reference = None, None
        if base is not None:
            pose, twist = decoder.decode_base(base)
            base_reference = PoseReference.with_body_twist(pose[:3], pose[3:], twist[:3], twist[3:])
        if joints is not None:
            joint_reference = self._held_velocities.at_command(*decoder.joint_reference(joints))
            assert self.executive is not None
            law = self.executive.controller.law
            if not law.outputs.selection.joints:
                self._log_fault(
                    "reference",
                    f"'{JOINT_REFERENCE}' is ignored, because the law '{law.name}' does not "
                    "control the joints: name them in joint_outputs.",
                )
        return Reference(base=base_reference, joints=joint_reference)
