"""The coordinated-control node: goal poses and references in, thruster wrench and efforts out."""

from __future__ import annotations

import sys
from typing import Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from spacerobot_ros.control import ControlState, NotFiniteError, PoseReference, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.executive import END_EFFECTOR, GOAL_KEYS, ControlExecutive
from spacerobot_ros.control.reference import HeldVelocityReference
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import CommandError, PlanningError
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.plant_listener import Change, Stopped
from spacerobot_ros.flight.state_synchroniser import CONTRADICTION, Pairing, StateSynchroniser
from spacerobot_ros.messages.layout import encode
from spacerobot_ros.messages.readers import (
    ODOMETRY,
    WRENCH,
    JointReader,
    MessageTemplate,
    TemplateReader,
    joint_template,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.commander import CommanderNode
from spacerobot_ros.nodes.common.messages import diagnostic_status, goal_of, goal_sentence
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, described_robot
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.planning.execution.goal_file import BASE, GoalFile, GoalIds, IdentifiedGoal
from spacerobot_ros.times import SECOND, stamp_bytes

JOINT_REFERENCE, BASE_REFERENCE = "joint_reference", "base_reference"
"""Topics of references from outside; where one has a publisher, every state waits for it."""


class CoordinatedControlNode(CommanderNode):
    """Closes the loop over spacecraft and arm (paper 4): one command for every measured state.

    ``goal_pose`` is where the base is to be, ``end_effector/goal_pose`` where the end-effector is.
    Where a planner publishes ``joint_reference`` (or ``base_reference``), those are tracked. Until
    there is a goal, the robot holds the pose of its first state. The node converts messages; what
    becomes of goals is decided by :class:`ControlExecutive`.
    """

    Config: ClassVar = ControllerConfig
    config: ControllerConfig

    def __init__(self, name: str = "coordinated_control", **kwargs: Any) -> None:
        self._running = False
        super().__init__(name, **kwargs)

    # -- life ---------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create the topics; without a robot of its own the node waits for robot_description."""
        self._states = StateSynchroniser(pose_required=True)
        self._odom, self._base_reference = _odometry_reader(), _odometry_reader()
        self._goal_file = GoalFile(self.config.resume_file, GOAL_KEYS)
        self._goal_ids = GoalIds()
        self._posed = self._odom_met = False
        self._waiting: dict[str, IdentifiedGoal] = {}
        """Goals that have come before the robot."""
        self._joint_commands = self.send_raw(JointState, "joint_commands")
        self._base_wrench = self.send_raw(WrenchStamped, "base_wrench")
        self._status = self.create_publisher(DiagnosticStatus, "controller/status", LATCHED)
        self.listen(self.config.control_period)
        self.find_robot()
        for topic, key in (("goal_pose", BASE), ("end_effector/goal_pose", END_EFFECTOR)):
            self.create_subscription(
                PoseStamped, topic, lambda message, key=key: self._on_goal(key, message), STREAM
            )
        for kind, topic in ((JointState, JOINT_REFERENCE), (Odometry, BASE_REFERENCE)):
            self.create_subscription(
                kind, topic, lambda raw, topic=topic: self._on_reference(topic, raw), STREAM,
                raw=True,
            )  # fmt: skip
        self.create_service(Trigger, "~/abort", self._on_abort)

    def activate(self) -> None:
        """Answer states with commands from now on; resume goals that an earlier end cut off."""
        saved = self._goal_file.load()
        if self._robot is None:
            self._waiting = saved
        else:
            self._executive.resume(saved)
        if saved:
            self.get_logger().info("Going on to an earlier goal.")
        self._running = True
        for topic in (JOINT_REFERENCE, BASE_REFERENCE):
            self._states.require(topic, required=self.count_publishers(topic) > 0)
        # A lockstep plant may have been waiting for an answer since before.
        self._on_part()

    def start_sentence(self) -> str:
        """Return what it controls by which law, and where goals are taken."""
        config, topic = self.config, self.resolve_topic_name("goal_pose")
        return (
            f"Controls {described_robot(self._robot)} by '{config.law}' at {config.tick_rate:g} "
            f"Hz; goals on '{topic}' in '{config.world_frame}'."
        )

    def deactivate(self) -> None:
        """Command nothing any more; goals are dropped, but not those in the file."""
        self._running = False
        self._waiting = {}
        if self._robot is not None:
            self._executive.reset()

    def _use(self, robot: SpaceRobot) -> None:
        self._robot = robot
        self._executive = ControlExecutive(
            build_controller(robot, self.config),
            self.config,
            self._publish_status,
            self._goal_file,
            self.get_logger().error,
            self.report_event,
        )
        self._joints = JointReader(robot.joint_names, ["position", "velocity"], complete=True)
        self._joint_reader = self._joints
        self._plant_reported()
        self._references = JointReader(robot.joint_names, ["position", "velocity"])
        self._held_velocities = HeldVelocityReference(self.config.control_period)
        self._effort, self._wrench = np.zeros(robot.n), np.zeros(6)
        self._joint_message = joint_template(robot.joint_names)
        if robot.n:
            self._joint_message.feed("effort", self._effort)
        header = {"frame_id": robot.base_link}
        self._wrench_message = MessageTemplate(WRENCH, encode(WRENCH, {"header": header}))
        self._wrench_message.feed("wrench.force.x", self._wrench)
        waiting, self._waiting = self._waiting, {}
        for key, goal in waiting.items():
            self._submit(key, goal)

    def parameters_changed(self) -> None:
        """Use new gains, tolerances and times."""
        if self._robot is not None:
            self._executive.configure(self.config)

    # -- goals and statuses -------------------------------------------------------------------

    def _on_goal(self, key: str, message: PoseStamped) -> None:
        if not self._running:
            return
        stamp = message.header.stamp
        goal_id = self._goal_ids.of(stamp.sec, stamp.nanosec)
        what = f"The goal of the {key.replace('_', '-')}"
        try:
            goal = goal_of(message, self.config.world_frame, what, pose_of=self._pose_of)
        except PlanningError as error:
            self._refuse(error, goal_id)
            return
        if self._plant.blocked:
            self._refuse(PlanningError(self._plant.blocked), goal_id)
            return
        identified = IdentifiedGoal(goal, goal_id)
        part = key.replace("_", "-")
        self.get_logger().info(goal_sentence(part, goal_id, message, goal))
        if self._robot is None:
            self._waiting[key] = identified
        else:
            self._submit(key, identified)

    def _submit(self, key: str, goal: IdentifiedGoal) -> None:
        try:
            self._executive.submit(key, goal)
        except PlanningError as error:
            self._refuse(error, goal.goal_id)

    def _refuse(self, error: PlanningError, goal_id: str) -> None:
        if self._robot is None:
            self._publish_status(ControllerStatus(ControllerState.REFUSED, str(error), goal_id))
            event = Event(EventKind.GOAL_REFUSED, str(error), level=2, goal_id=goal_id)
            self.report_event(event)
        else:
            self._executive.refuse(str(error), goal_id)

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._running and (self._robot is not None or bool(self._waiting))
        response.message = "The robot holds where it is."
        if not response.success:
            response.message = "There is no goal to abort."
        elif self._robot is not None:
            self._executive.abort()
        else:
            response.message = "Aborted on request, before the robot was known."
            self._abort_waiting(response.message)
        return response

    def _abort_waiting(self, sentence: str) -> None:
        """Give up the goals that wait for the robot."""
        *_, goal = self._waiting.values()
        self._waiting = {}
        self._goal_file.delete()
        self._publish_status(ControllerStatus(ControllerState.ABORTED, sentence, goal.goal_id))

    def _publish_status(self, status: ControllerStatus) -> None:
        name, level = self.get_fully_qualified_name(), bytes([status.state.level])
        self._said = diagnostic_status(name, level, status.message, status.to_values())
        self._status.publish(self._said)
        if status.state.decided and self.config.stop_when_decided:
            self._running = False
        if status.state.level:
            self.get_logger().warning(status.message, throttle_duration_sec=5.0)

    # -- what the plant publishes -------------------------------------------------------------

    def _plant_stopped(self, stopped: Stopped) -> None:
        if self._robot is not None:
            self._executive.plant_stopped(
                stopped.why, stopped.commanded_until_ns, stopped.rests_since_ns
            )
        elif self._waiting and stopped.commanded_until_ns is None:
            self._abort_waiting(f"Aborted by the plant: {stopped.why}")

    def _plant_changed(self, change: Change) -> None:
        if change is Change.RESET:
            self._states.forget_pose()
            if self._robot is not None:
                self._executive.plant_reset()
        if change is Change.OBEYS and self._robot is not None:
            self._executive.plant_obeys_again()

    def _plant_reported(self) -> None:
        if self._robot is not None:
            self._executive.plant_blocked = bool(self._plant.blocked)

    def _take_odom(self, raw: bytes) -> None:
        if self._states.put_odom(raw):
            self.get_logger().error(CONTRADICTION, throttle_duration_sec=5.0)
        self._on_part()

    def _take_joints(self, raw: bytes) -> None:
        overdue = None
        if self._running and self._robot is not None and not self._waits_for_first_pose():
            overdue = self._states.overdue()
        if overdue is not None:
            # An answer to a lost pose would come a tick late; what it estimates goes on from there.
            self._on_state(overdue, send=overdue is Pairing.WHOLE)
        self._states.put_joint_states(raw)
        self._on_part()

    def _waits_for_first_pose(self) -> bool:
        """Whether the state before came when odom was not met yet: its pose is not lost."""
        if self._posed:
            return False
        before, self._odom_met = self._odom_met, self._odom_input.get_publisher_count() > 0
        return not before

    def _on_reference(self, topic: str, raw: bytes) -> None:
        self._states.put_required(topic, raw)
        self._on_part()

    def _on_part(self) -> None:
        """Answer a state once, as soon as all its messages are there and the node is."""
        if self._running and self._robot is not None:
            pairing = self._states.ready()
            if pairing is not None:
                self._on_state(pairing)

    def _on_state(self, pairing: Pairing, *, send: bool = True) -> None:
        """Answer one state with one command of the same stamp."""
        self._posed = self._posed or pairing is Pairing.WHOLE
        try:
            stamp = self._joints.accept(self._states.joint_states)
        except CommandError as error:
            self._times.withdraw()
            self._log_refusal(error)
            return
        try:
            q, qdot = self._joints.values["position"], self._joints.values["velocity"]
            measured = self._measured(q, qdot) if pairing is Pairing.WHOLE else None
            now = stamp / SECOND
            result = self._executive.command(now, measured, q, qdot, self._reference())
        except (CommandError, NotFiniteError) as error:
            self._log_refusal(error)
            return
        self._effort[:] = result.realised.tau
        self._wrench[:] = result.realised.wrench_B
        if send:
            stamped = stamp_bytes(stamp)
            self._base_wrench.take(self._wrench_message.serialised(stamped))
            self._joint_commands.take(self._joint_message.serialised(stamped))
        self._executive.evaluate(now, result)

    def _log_refusal(self, error: CommandError | NotFiniteError) -> None:
        self.get_logger().error(f"The state is refused: {error}", throttle_duration_sec=5.0)

    def _measured(self, q: Array, qdot: Array) -> ControlState:
        pose, twist = _pose_and_twist(self._odom, self._states.odom)
        return ControlState(pose[:3], pose[3:], twist[:3], twist[3:], q, qdot)

    def _reference(self) -> Reference | None:
        """Return the reference from outside for this state; None if there is none."""
        base, joints = self._states.latest(BASE_REFERENCE), self._states.latest(JOINT_REFERENCE)
        if not base and not joints:
            return None
        base_reference, joint_reference = None, None
        if base:
            pose, twist = _pose_and_twist(self._base_reference, base)
            base_reference = PoseReference.with_body_twist(pose[:3], pose[3:], twist[:3], twist[3:])
        if joints:
            self._references.accept(joints)
            values = self._references.values
            joint_reference = self._held_velocities.at_command(
                values["position"], values["velocity"]
            )
        return Reference(base=base_reference, joints=joint_reference)


_POSE, _TWIST = "pose.pose.position.x", "twist.twist.linear.x"


def _odometry_reader() -> TemplateReader:
    return TemplateReader(ODOMETRY, {_POSE: 7, _TWIST: 6})


def _pose_and_twist(reader: TemplateReader, raw: bytes) -> tuple[Array, Array]:
    reader.accept(raw)
    return reader.floats(_POSE), reader.floats(_TWIST)


def main() -> None:
    """Run coordinated control until SIGINT or SIGTERM."""
    sys.exit(run_node(CoordinatedControlNode))


if __name__ == "__main__":
    main()
