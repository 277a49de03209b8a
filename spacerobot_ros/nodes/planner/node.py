"""The planner node: goal poses in, joint velocities out."""

from __future__ import annotations

import sys
from typing import Any, ClassVar

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from spacerobot_ros.errors import CommandError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.goal_messages import goal_of, shape_of
from spacerobot_ros.nodes.common.joint_command import JointReader
from spacerobot_ros.nodes.common.node import STREAM, run_node
from spacerobot_ros.nodes.common.robot_node import RobotNode
from spacerobot_ros.nodes.planner.gait_flight import ANSWERED
from spacerobot_ros.nodes.planner.goal_pursuit import GoalPursuit
from spacerobot_ros.nodes.planner.plan_topics import PlanTopics
from spacerobot_ros.nodes.planner.status import PlannerState, PlannerStatus
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.goal_file import BASE, GoalFile


class PlannerNode(RobotNode):
    """Turns goal poses into gaits and streams their velocities, one command for every state.

    A goal is planned from the next measured state. When its schedule has ended the measured pose
    is compared with the goal, and the rest is planned again until the tolerance is met or
    ``max_corrections`` are used up; the pieces of a gait that its method plans one by one (a
    *partial* schedule) do not count. A new goal replaces the one that is being flown. When a joint
    does not follow, the rest is planned with the joints that remain.
    """

    Config: ClassVar = PlannerConfig

    def __init__(self, name: str = "planner", **kwargs: Any) -> None:
        self._running = False
        super().__init__(name, **kwargs)

    @property
    def plan_time(self) -> float:
        """Wall time that planning took for the present goal, s."""
        return self._pursuit.plan_time if self._robot is not None else 0.0

    # -- life ---------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create the topics; without a robot of its own the planner waits for robot_description."""
        self._waiting: Goal | None = None
        """A goal that has come before the robot."""
        self._goal_shape: Array | None = None
        self._odom_raw = self._joints_raw = b""
        self._odom_fresh = self._joints_fresh = False
        to_plant = self.parameters["output"] == "commands"
        topic = "joint_commands" if to_plant else "joint_reference"
        self._commands = self.send_raw(JointState, topic)
        self._plan_topics = PlanTopics(self, str(self.parameters["world_frame"]))
        self._status = PlannerStatus(self)
        self._memory = GoalFile(str(self.parameters["resume_file"]))
        self.find_robot()
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal, STREAM)
        self.create_subscription(JointState, "goal_joint_states", self._on_goal_shape, STREAM)
        self.create_subscription(Odometry, "odom", self._on_odom, STREAM, raw=True)
        self.create_subscription(JointState, "joint_states", self._on_joints, STREAM, raw=True)
        self.create_service(Trigger, "~/abort", self._on_abort)

    def activate(self) -> None:
        """Answer states with commands from now on."""
        found = self._memory.load().get(BASE)
        kept = found.goal if found is not None else None
        self._running = True
        if kept is None:
            self._status.publish(PlannerState.IDLE, "Waiting for a goal pose.")
        else:
            self._propose(kept)
            self._status.publish(PlannerState.PLANNING, "Going on to an earlier goal.", goal=kept)
        # A lockstep plant may have been waiting for an answer since before.
        self._on_part()

    def deactivate(self) -> None:
        """Give up the present goal and command nothing any more."""
        if self._running and self._robot is not None:
            self.get_logger().info(ANSWERED.format(self._pursuit.answers))
            self._pursuit.drop()
        self._running = False

    def _use(self, robot: SpaceRobot) -> None:
        self._robot = robot
        self._joints = JointReader(robot.joint_names, ["position"], complete=True)
        self._pursuit = GoalPursuit(self, robot, self._status, self._plan_topics, self._memory)
        if self._waiting is not None:
            self._pursuit.propose(self._waiting)

    # -- topics -------------------------------------------------------------------------------

    def _on_goal(self, message: PoseStamped) -> None:
        if not self._running:
            return
        try:
            frame = str(self.parameters["world_frame"])
            goal = goal_of(message, frame, shape=self._goal_shape)
        except PlanningError as error:
            self._status.publish(PlannerState.REFUSED, str(error))
            return
        self._propose(goal)
        if self._robot is None:
            self._status.publish(
                PlannerState.PLANNING, "The goal waits for a robot on robot_description."
            )

    def _propose(self, goal: Goal) -> None:
        """Plan for a goal from the next state that is measured."""
        if self._robot is None:
            self._waiting = goal
        else:
            self._pursuit.propose(goal)

    def _on_goal_shape(self, message: JointState) -> None:
        """Keep the shape that goals from now on are to end in, for methods that take one."""
        if self._robot is None:
            return
        try:
            self._goal_shape = shape_of(message, self._robot.joint_names)
        except PlanningError as error:
            self._status.publish(PlannerState.REFUSED, str(error))

    def _on_odom(self, raw: bytes) -> None:
        self._odom_raw = raw
        self._odom_fresh = True
        # In flight it is looked at with the joints, if at all.
        if self._joints_fresh or (self._robot is not None and self._pursuit.wants_pose):
            self._on_part()

    def _on_joints(self, raw: bytes) -> None:
        self._joints_raw = raw
        self._joints_fresh = True
        self._on_part()

    def _on_part(self) -> None:
        """Answer a state once, as soon as its joints are there; only plans need its pose."""
        if not self._running or self._robot is None:
            return
        # Header first in both messages: bytes 4 to 12 are the stamp.
        together = self._odom_raw[4:12] == self._joints_raw[4:12]
        if self._joints_fresh:
            self._joints_fresh = False
            self._answer(posed=together and self._odom_fresh)
        elif together and self._odom_fresh:
            # What was answered without the pose is planned from when the next joints come.
            self._pursuit.observe(self._odom_raw, self._joints_raw)
        self._odom_fresh = self._odom_fresh and not together

    def _answer(self, *, posed: bool) -> None:
        """Answer one state with one command of the same stamp; ``posed``: odom is there too."""
        try:
            stamp = self._joints.accept(self._joints_raw)
        except CommandError as error:
            self.get_logger().error(f"joint_states: {error}.", throttle_duration_sec=5.0)
            return
        q = self._joints.values["position"]
        command = self._pursuit.answer(stamp, q, self._odom_raw, self._joints_raw, posed)
        self._commands.take(command)

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        message = self._pursuit.abort() if self._robot is not None else ""
        self._waiting = None
        self._memory.delete()
        response.success = bool(message)
        response.message = message or "Nothing is flown."
        if message:
            self._status.publish(PlannerState.ABORTED, f"Aborted on request. {message}")
        return response


def main() -> None:
    """Run the planner until SIGINT or SIGTERM."""
    sys.exit(run_node(PlannerNode))


if __name__ == "__main__":
    main()
