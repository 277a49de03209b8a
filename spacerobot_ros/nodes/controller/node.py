"""The coordinated-control node: goal poses and references in, thruster wrench and efforts out."""

from __future__ import annotations

import sys
from typing import Any, ClassVar

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from spacerobot_ros.control import (
    ControlState,
    JointReference,
    PoseReference,
    Reference,
)
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.state import NotFiniteError
from spacerobot_ros.errors import CommandError, ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import matrix_from_quaternion
from spacerobot_ros.nodes.common.cdr import (
    NANOSECONDS,
    MessageTemplate,
    TemplateReader,
    stamp_bytes,
)
from spacerobot_ros.nodes.common.goal_messages import goal_of
from spacerobot_ros.nodes.common.joint_command import JointReader
from spacerobot_ros.nodes.common.node import STREAM, run_node
from spacerobot_ros.nodes.common.robot_node import RobotNode
from spacerobot_ros.nodes.common.state_synchroniser import Pairing, StateSynchroniser
from spacerobot_ros.nodes.controller.goals import END_EFFECTOR, ControlGoals, require_controlled
from spacerobot_ros.nodes.controller.status import ControllerState, ControllerStatus
from spacerobot_ros.planning.execution.goal_file import BASE

JOINT_REFERENCE, BASE_REFERENCE = "joint_reference", "base_reference"
"""Topics of references from outside; where one has a publisher, every state waits for it."""


class CoordinatedControlNode(RobotNode):
    """Closes the loop over spacecraft and arm (paper 4): one command for every measured state.

    ``goal_pose`` is where the base is to be, ``end_effector/goal_pose`` where the end-effector is.
    Where a planner publishes ``joint_reference`` (or ``base_reference``), those are tracked. Until
    there is a goal, the robot holds the pose of its first state.
    """

    Config: ClassVar = ControllerConfig

    def __init__(self, name: str = "coordinated_control", **kwargs: Any) -> None:
        self._running = False
        super().__init__(name, **kwargs)

    # -- life ---------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create the topics; without a robot of its own the node waits for robot_description."""
        self._states = StateSynchroniser(pose_required=True)
        self._hold = False
        self._goals = ControlGoals(str(self.parameters["resume_file"]))
        self._odom = TemplateReader(
            Odometry, lambda _: {"pose.pose.position.x": 7, "twist.twist.linear.x": 6}
        )
        self._base_reference = TemplateReader(
            Odometry, lambda _: {"pose.pose.position.x": 7, "twist.twist.linear.x": 6}
        )
        self._joint_commands = self.send_raw(JointState, "joint_commands")
        self._base_wrench = self.send_raw(WrenchStamped, "base_wrench")
        self._status = ControllerStatus(self)
        self.find_robot()
        self.create_subscription(PoseStamped, "goal_pose", self._on_base_goal, STREAM)
        self.create_subscription(
            PoseStamped, "end_effector/goal_pose", self._on_end_effector_goal, STREAM
        )
        self.create_subscription(Odometry, "odom", self._on_odom, STREAM, raw=True)
        self.create_subscription(JointState, "joint_states", self._on_joints, STREAM, raw=True)
        self.create_subscription(JointState, JOINT_REFERENCE, self._on_reference, STREAM, raw=True)
        self.create_subscription(
            Odometry, BASE_REFERENCE, self._on_base_reference, STREAM, raw=True
        )
        self.create_service(Trigger, "~/abort", self._on_abort)

    def activate(self) -> None:
        """Answer states with commands from now on; go on to goals that an earlier end cut off."""
        if self._goals.recall(None if self._robot is None else self.controller.law):
            self.get_logger().info("Going on to an earlier goal.")
        self._running = True
        for topic in (JOINT_REFERENCE, BASE_REFERENCE):
            self._states.require(topic, required=self.count_publishers(topic) > 0)
        self._status.begin()
        # A lockstep plant may have been waiting for an answer since before.
        self._on_part()

    def deactivate(self) -> None:
        """Command nothing any more; goals are forgotten, but for the file."""
        self._running = False
        self._goals.drop()
        if self._robot is not None:
            self.controller.forget()

    def _use(self, robot: SpaceRobot) -> None:
        self._robot = robot
        self.controller = build_controller(robot, self.config)
        n = robot.n
        self._joints = JointReader(robot.joint_names, ["position", "velocity"], complete=True)
        self._references = JointReader(robot.joint_names, ["position", "velocity"])
        self._reference_rate: Any = None
        self._effort, self._wrench = np.zeros(n), np.zeros(6)
        names = list(robot.joint_names)
        zeros = [0.0] * n
        self._joint_message = MessageTemplate(
            JointState(name=names, position=zeros, velocity=zeros, effort=zeros)
        )
        if n:
            self._joint_message.feed("effort", self._effort)
        wrench = WrenchStamped()
        wrench.header.frame_id = robot.base_link
        self._wrench_message = MessageTemplate(wrench)
        self._wrench_message.feed("wrench.force.x", self._wrench)
        try:
            self._goals.require_suited(self.controller.law)
        except PlanningError as error:
            self._status.refused(str(error))

    def parameters_changed(self) -> None:
        """Take over new gains."""
        if self._robot is not None:
            self.controller.set_gains(self.config.gains)

    # -- topics -------------------------------------------------------------------------------

    def _on_base_goal(self, message: PoseStamped) -> None:
        self._on_goal(BASE, message)

    def _on_end_effector_goal(self, message: PoseStamped) -> None:
        self._on_goal(END_EFFECTOR, message)

    def _on_goal(self, group: str, message: PoseStamped) -> None:
        if not self._running:
            return
        try:
            frame = str(self.parameters["world_frame"])
            goal = goal_of(message, frame, f"The goal of the {group.replace('_', '-')}")
            if self._robot is not None:
                require_controlled(self.controller.law, group)
        except PlanningError as error:
            self._status.refused(str(error))
            return
        self._goals.give(group, goal)

    def _on_odom(self, raw: bytes) -> None:
        self._states.put_odom(raw)
        self._on_part()

    def _on_joints(self, raw: bytes) -> None:
        overdue = self._states.overdue() if self._running and self._robot is not None else None
        if overdue is not None:
            # An answer to a lost pose would come a tick late; what it estimates goes on from there.
            self._on_state(overdue, send=overdue is Pairing.WHOLE)
        self._states.put_joint_states(raw)
        self._on_part()

    def _on_reference(self, raw: bytes) -> None:
        self._states.put_required(JOINT_REFERENCE, raw)
        self._on_part()

    def _on_base_reference(self, raw: bytes) -> None:
        self._states.put_required(BASE_REFERENCE, raw)
        self._on_part()

    def _on_part(self) -> None:
        """Answer a state once, as soon as all its messages are there and the node is."""
        if self._running and self._robot is not None:
            pairing = self._states.ready()
            if pairing is not None:
                self._on_state(pairing)

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._running and self._robot is not None
        response.message = "The robot holds where it is."
        if response.success:
            self._hold = True
            self._goals.drop()
            self._goals.forget()
        return response

    # -- flying -------------------------------------------------------------------------------

    def _on_state(self, pairing: Pairing, *, send: bool = True) -> None:
        """Answer one state with one command of the same stamp."""
        try:
            stamp = self._joints.accept(self._states.joint_states)
            q, qdot = self._joints.values["position"], self._joints.values["velocity"]
            now = stamp / NANOSECONDS
            state = self._measured(q, qdot) if pairing is Pairing.WHOLE else None
            if state is not None:
                self._take_goals(now, state)
            base, joints = self._states.latest(BASE_REFERENCE), self._states.latest(JOINT_REFERENCE)
            if base or joints:
                self.controller.follow(
                    Reference(base=self._given_base(base), joints=self._given_joints(joints))
                )
            result = self.controller.command(now, state, q, qdot)
        except (CommandError, NotFiniteError) as error:
            self.get_logger().error(f"The state is refused: {error}", throttle_duration_sec=5.0)
            return
        self._effort[:] = result.realised.tau
        self._wrench[:] = result.realised.wrench_B
        if send:
            stamped = stamp_bytes(stamp)
            self._base_wrench.take(self._wrench_message.serialised(stamped))
            self._joint_commands.take(self._joint_message.serialised(stamped))
        if self._status.update(now, self.controller, result):
            self._goals.forget()

    def _measured(self, q: Any, qdot: Any) -> ControlState:
        self._odom.accept(self._states.odom)
        pose = self._odom.floats("pose.pose.position.x")
        twist = self._odom.floats("twist.twist.linear.x")
        return ControlState(pose[:3], pose[3:], twist[:3], twist[3:], q, qdot)

    def _take_goals(self, now: float, state: ControlState) -> None:
        if self._hold:
            self._hold = False
            link = self.controller.law.outputs.selection.end_effector_link
            assert self._robot is not None
            here = Reference.present(self._robot, state, link)
            self.controller.set_goals(
                now, state, base=here.base, end_effector=here.end_effector, joints=state.q.copy()
            )
            self._status.state(ControllerState.ABORTED, "Aborted on request; the robot holds.")
        if self._goals.take(self.controller, now, state):
            self._status.started(now)
            try:
                self._goals.keep(self.controller)
            except ParameterError as error:
                self.get_logger().error(f"{error} The goal is flown, but would not be resumed.")

    def _given_joints(self, raw: bytes) -> JointReference | None:
        """Return the joint reference of this tick, whose velocities are held over it."""
        if not raw:
            return None
        self._references.accept(raw)
        held = self._references.values["velocity"].copy()
        before = self._reference_rate if self._reference_rate is not None else held
        self._reference_rate = held
        return JointReference(
            self._references.values["position"].copy(),
            (before + held) / 2,
            (held - before) / self.config.control_period,
        )

    def _given_base(self, raw: bytes) -> PoseReference | None:
        """Return the base reference of this tick; an Odometry's twist is in the base."""
        if not raw:
            return None
        self._base_reference.accept(raw)
        pose = self._base_reference.floats("pose.pose.position.x")
        twist = self._base_reference.floats("twist.twist.linear.x")
        R_WB = matrix_from_quaternion(pose[3:])
        return PoseReference(pose[:3], pose[3:], R_WB @ twist[:3], R_WB @ twist[3:])


def main() -> None:
    """Run coordinated control until SIGINT or SIGTERM."""
    sys.exit(run_node(CoordinatedControlNode))


if __name__ == "__main__":
    main()
