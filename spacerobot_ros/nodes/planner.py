"""The planner node: goal poses in, joint velocities out."""

from __future__ import annotations

import sys
import time
from typing import Any, ClassVar

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry, Path
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.errors import CommandError, PlanningError, SpaceRobotError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.cdr import (
    NANOSECONDS,
    MessageTemplate,
    TemplateReader,
    raw_publish,
    stamp_bytes,
)
from spacerobot_ros.nodes.flight_node import LATCHED, STREAM, FlightNode, run_node
from spacerobot_ros.nodes.joint_command import JointReader
from spacerobot_ros.nodes.markers import goal_markers
from spacerobot_ros.nodes.parameters import ParameterSpec, option_specs
from spacerobot_ros.nodes.planner_status import PlannerState, PlannerStatus
from spacerobot_ros.nodes.robot_source import ROBOT_SPECS, robot_of
from spacerobot_ros.nodes.trajectory_message import path_message, serialised_trajectory
from spacerobot_ros.planning import METHODS, GaitSchedule, Goal, PoseError, RobotState, Tolerance
from spacerobot_ros.planning.follower import GaitFollower

_AT_REST = 1e-9
"""Joint rates below which the joints rest, m/s or rad/s."""


class PlannerNode(FlightNode):
    """Turns goal poses into gaits and streams their velocities, one command for every state.

    A goal is planned from the next measured state. When its schedule has ended the measured pose
    is compared with the goal, and the rest is planned again until the tolerance is met or
    ``max_corrections`` are used up; the pieces of a gait that its method plans one by one (a
    *partial* schedule) do not count. A new goal replaces the one that is being flown.
    """

    SPECS: ClassVar = (
        *ROBOT_SPECS,
        ParameterSpec("method", "lie_bracket", "", "gait method", choices=tuple(METHODS)),
        ParameterSpec("tick_rate", 20.0, "Hz", "commands a second; the plant's", 1e-3, 1e5),
        ParameterSpec("integration_step", 0.01, "s", "longest step of the prediction", 1e-6),
        ParameterSpec("world_frame", "world", "", "frame that goals must be given in"),
        ParameterSpec("position_tolerance", 1e-3, "m", "a goal is met within", 0.0, live=True),
        ParameterSpec("attitude_tolerance", 1e-3, "rad", "a goal is met within", 0.0, live=True),
        ParameterSpec("joint_tolerance", 1e-3, "m or rad", "a shape is met within", 0.0, live=True),
        ParameterSpec(
            "output",
            "commands",
            "",
            "joint_commands (velocities) for the plant, or joint_reference for a controller",
            choices=("commands", "reference"),
        ),
        ParameterSpec("max_corrections", 3, "", "new plans after the first", 0, 1000, live=True),
        ParameterSpec("shape_gain", 2.0, "1/s", "feedback on the shape while flying", 0.0, 1e3),
        *option_specs(METHODS),
    )

    def __init__(self, name: str = "planner", **kwargs: Any) -> None:
        self._running = False
        self._robot: SpaceRobot | None = None
        self.plan_time = 0.0
        """Wall time that planning took for the present goal, s."""
        self.flown_time = 0.0
        """Simulated time that the schedules flown for the present goal take together, s."""
        self.ends_at = 0.0
        """Simulated time at which the present schedule ends, s."""
        super().__init__(name, **kwargs)

    # -- life ---------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create the topics; without a robot of its own the planner waits for robot_description."""
        self._goal: Goal | None = None
        self._goal_shape: Array | None = None
        self._held: Array | None = None
        self._pending = False
        self._corrections = 0
        self._follower: GaitFollower | None = None
        self._momenta = np.zeros(3), np.zeros(3)
        self._odom_raw = b""
        self._joints_raw = b""
        self._odom_fresh = self._joints_fresh = False
        self._odom = TemplateReader(
            Odometry, lambda _: {"pose.pose.position.x": 7, "twist.twist.linear.x": 6}
        )
        self._commands_plant = self.parameters["output"] == "commands"
        topic = "joint_commands" if self._commands_plant else "joint_reference"
        self._send_command = raw_publish(self.create_publisher(JointState, topic, STREAM))
        self._schedule_topic = self.create_publisher(JointTrajectory, "gait_schedule", LATCHED)
        self._path_topic = self.create_publisher(Path, "planned_path", LATCHED)
        self._marker_topic = self.create_publisher(MarkerArray, "markers", STREAM)
        self._status = PlannerStatus(self)
        robot = robot_of(self.parameters)
        if robot is None:
            self.create_subscription(String, "robot_description", self._on_description, LATCHED)
        else:
            self._use(robot)
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal, STREAM)
        self.create_subscription(JointState, "goal_joint_states", self._on_goal_shape, STREAM)
        self.create_subscription(Odometry, "odom", self._on_odom, STREAM, raw=True)
        self.create_subscription(JointState, "joint_states", self._on_joints, STREAM, raw=True)
        self.create_service(Trigger, "~/abort", self._on_abort)

    def activate(self) -> None:
        """Answer states with commands from now on."""
        self._running = True
        self._status.publish(PlannerState.IDLE, "Waiting for a goal pose.")
        # A lockstep plant may have been waiting for an answer since before.
        self._on_part()

    def deactivate(self) -> None:
        """Give up the present goal and command nothing any more."""
        self._running = False
        self._follower = None
        self._goal = self._held = None

    def _use(self, robot: SpaceRobot) -> None:
        self._robot = robot
        values: dict[str, Any] = self.parameters
        self._method = METHODS[values["method"]](
            robot,
            round(NANOSECONDS / values["tick_rate"]) / NANOSECONDS,
            self._tolerance(),
            values["integration_step"],
            **{
                option.name: values[f"{values['method']}.{option.name}"]
                for option in METHODS[values["method"]].options
            },
        )
        n = robot.n
        self._joints = JointReader(robot.joint_names, ["position"], complete=True)
        self._motion = JointReader(robot.joint_names, ["position", "velocity"], complete=True)
        self._command = MessageTemplate(
            JointState(
                name=list(robot.joint_names),
                position=[0.0] * n,
                velocity=[0.0] * n,
                effort=[0.0] * n,
            )
        )
        self._command_position, self._command_velocity = np.zeros(n), np.zeros(n)
        if n:
            self._command.feed("position", self._command_position)
            self._command.feed("velocity", self._command_velocity)

    def _tolerance(self) -> Tolerance:
        values: dict[str, Any] = self.parameters
        return Tolerance(
            values["position_tolerance"], values["attitude_tolerance"], values["joint_tolerance"]
        )

    def parameters_changed(self) -> None:
        """Plan and judge with the new tolerances."""
        if self._robot is not None:
            self._method.tolerance = self._tolerance()

    # -- topics -------------------------------------------------------------------------------

    def _on_description(self, message: String) -> None:
        if self._robot is None:
            try:
                self._use(SpaceRobot.from_urdf(message.data))
            except SpaceRobotError as error:
                self.get_logger().error(f"robot_description: {error}")
                return
            self._on_part()

    def _on_goal(self, message: PoseStamped) -> None:
        if not self._running:
            return
        frame = str(self.parameters["world_frame"])
        p, o = message.pose.position, message.pose.orientation
        try:
            if message.header.frame_id not in ("", frame):
                raise PlanningError(
                    f"The goal pose is in frame '{message.header.frame_id}'; goals are taken in "
                    f"'{frame}'."
                )
            goal = Goal.checked([p.x, p.y, p.z], [o.x, o.y, o.z, o.w], self._goal_shape)
        except PlanningError as error:
            self._status.publish(PlannerState.REFUSED, str(error))
            return
        self._proposed = goal
        self._pending = True
        if self._robot is None:
            self._status.publish(
                PlannerState.PLANNING, "The goal waits for a robot on robot_description."
            )

    def _on_goal_shape(self, message: JointState) -> None:
        """Keep the shape that goals from now on are to end in, for methods that take one."""
        if self._robot is None:
            return
        missing = set(self._robot.joint_names) - set(message.name)
        values = dict(zip(message.name, message.position, strict=False))
        if missing or not np.all(np.isfinite(list(values.values()))):
            what = f"joint '{min(missing)}' is missing" if missing else "a position is not finite"
            self._status.publish(PlannerState.REFUSED, f"The goal shape is refused: {what}.")
            return
        self._goal_shape = np.array([values[name] for name in self._robot.joint_names])

    def _on_odom(self, raw: bytes) -> None:
        self._odom_raw = raw
        self._odom_fresh = True
        self._on_part()

    def _on_joints(self, raw: bytes) -> None:
        self._joints_raw = raw
        self._joints_fresh = True
        self._on_part()

    def _on_part(self) -> None:
        """Answer a state once, as soon as both of its messages are there and the planner is."""
        # Header first in both messages: bytes 4 to 12 are the stamp.
        if (
            self._running
            and self._odom_fresh
            and self._joints_fresh
            and self._robot is not None
            and self._odom_raw[4:12] == self._joints_raw[4:12]
        ):
            self._odom_fresh = self._joints_fresh = False
            self._on_state()

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._follower is not None
        response.message = "The joints come to rest." if self._follower else "Nothing is flown."
        if self._follower is not None:
            self._follower = None
            self._status.publish(PlannerState.ABORTED, "Aborted on request; the joints rest.")
        self._pending = False
        self._goal = None
        return response

    # -- flying -------------------------------------------------------------------------------

    def _on_state(self) -> None:
        """Answer one measured state with one command of the same stamp."""
        try:
            stamp = self._joints.accept(self._joints_raw)
        except CommandError as error:
            self.get_logger().error(f"joint_states: {error}.", throttle_duration_sec=5.0)
            return
        if self._pending:
            self._pending = False
            self._plan_proposed(stamp)
        q = self._joints.values["position"]
        if self._follower is not None and self._follower.ended(stamp, q):
            self._judge(stamp)
        if self._follower is not None:
            self._follower.command(stamp, q, self._command_position, self._command_velocity)
            self._held = None
        else:
            # A reference must stay where it is; what the plant makes of rest is its affair.
            if self._held is None or self._commands_plant:
                self._held = q.copy()
            self._command_position[:] = self._held
            self._command_velocity[:] = 0.0
        self._send_command(self._command.serialised(stamp_bytes(stamp)))

    def _measured(self) -> RobotState:
        assert self._robot is not None
        self._odom.accept(self._odom_raw)
        pose = self._odom.floats("pose.pose.position.x")
        twist = self._odom.floats("twist.twist.linear.x")
        self._motion.accept(self._joints_raw)
        q, qdot = self._motion.values["position"].copy(), self._motion.values["velocity"]
        if not np.all(np.isfinite(np.concatenate([pose, twist, q, qdot]))):
            raise PlanningError("The measured state is not finite; see odom and joint_states.")
        if np.abs(qdot).max(initial=0.0) <= _AT_REST:
            # While joints move, the momentum of a robot whose masses are not quite known is
            # uncertain; at rest the base alone shows it, and without thrust it stays.
            self._momenta = self._robot.momentum(pose[3:], q, twist[:3], twist[3:], qdot)[:2]
        return RobotState(pose[:3].copy(), pose[3:].copy(), q, *self._momenta)

    def _plan_proposed(self, stamp: int) -> None:
        self.plan_time = self.flown_time = 0.0
        try:
            schedule = self._plan(self._proposed, correction=False)
        except PlanningError as error:
            kept = " The earlier goal is still flown." if self._follower else ""
            self._status.publish(PlannerState.REFUSED, f"{error}{kept}", goal=self._proposed)
            return
        self._goal = self._proposed
        self._corrections = 0
        self._fly(schedule, stamp)

    def _plan(self, goal: Goal, *, correction: bool) -> GaitSchedule:
        began = time.perf_counter()
        try:
            return self._method.plan(self._measured(), goal, correction=correction)
        finally:
            self.plan_time += time.perf_counter() - began

    def _fly(self, schedule: GaitSchedule, stamp: int, error: PoseError | None = None) -> None:
        # A controller closes its own loop round the reference.
        gain = float(self.parameters["shape_gain"]) if self._commands_plant else 0.0  # type: ignore[arg-type]
        self._follower = GaitFollower(schedule, stamp, gain)
        self.flown_time += schedule.duration
        self.ends_at = stamp / NANOSECONDS + schedule.duration
        frame = str(self.parameters["world_frame"])
        self._status.publish(
            PlannerState.EXECUTING,
            f"Flying a {schedule.method} gait of {schedule.duration:.6g} s.",
            goal=schedule.goal,
            schedule=schedule,
            error=error,
            corrections=self._corrections,
        )
        assert self._robot is not None
        base_link = self._robot.base_link
        self._schedule_topic.publish(serialised_trajectory(schedule, stamp, base_link))
        self._path_topic.publish(path_message(schedule.path, stamp, frame))
        shapes = self._robot.description.links[0].shapes
        self._marker_topic.publish(goal_markers(schedule.goal, schedule.path, shapes, frame))

    def _judge(self, stamp: int) -> None:
        """Compare the measured pose with the goal; plan what is left, or be done."""
        assert self._goal is not None
        try:
            state = self._measured()
        except PlanningError as reason:
            self._follower = None
            self._status.publish(PlannerState.FAILED, str(reason), goal=self._goal)
            return
        error = PoseError.between(state.position, state.quaternion, self._goal, state.q)
        assert self._follower is not None
        flown, self._follower = self._follower.schedule, None
        self._held = flown.positions[-1]
        result: dict[str, Any] = {
            "goal": self._goal,
            "error": error,
            "corrections": self._corrections,
        }
        controls = self._method.controls
        parts = {
            "position": f"{error.distance:.3g} m",
            "attitude": f"{error.angle:.3g} rad",
            "shape": f"{error.farthest_joint:.3g} at the joints",
        }
        left = " and ".join(text for part, text in parts.items() if part in controls)
        left = f"{left} from the goal"
        if self._tolerance().admits(error, controls):
            self._status.publish(PlannerState.REACHED, f"The goal is met: {left}.", **result)
            return
        if not flown.partial and self._corrections >= int(self.parameters["max_corrections"]):  # type: ignore[arg-type]
            self._status.publish(
                PlannerState.FAILED,
                f"The goal is not met: {left} after {self._corrections} correction(s).",
                **result,
            )
            return
        self._corrections += not flown.partial
        try:
            self._fly(self._plan(self._goal, correction=True), stamp, error)
        except PlanningError as reason:
            self._status.publish(
                PlannerState.FAILED, f"The goal is not met: {left}, and {reason}", **result
            )


def main() -> None:
    """Run the planner until SIGINT or SIGTERM."""
    sys.exit(run_node(PlannerNode))


if __name__ == "__main__":
    main()
