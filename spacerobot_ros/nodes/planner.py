"""The planner node: goal poses in, joint velocities out."""

from __future__ import annotations

import sys
import time
from typing import Any, ClassVar

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from spacerobot_ros.errors import CommandError, ParameterError, PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.cdr import NANOSECONDS
from spacerobot_ros.nodes.flight_node import STREAM, run_node
from spacerobot_ros.nodes.gait_flight import ANSWERED, GaitFlight
from spacerobot_ros.nodes.goal_memory import GoalMemory
from spacerobot_ros.nodes.goal_messages import goal_of, shape_of
from spacerobot_ros.nodes.joint_command import JointReader
from spacerobot_ros.nodes.measured_state import MeasuredState
from spacerobot_ros.nodes.plan_topics import PlanTopics
from spacerobot_ros.nodes.planner_parameters import PLANNER_SPECS, tolerance_of
from spacerobot_ros.nodes.planner_status import PlannerState, PlannerStatus, what_is_left
from spacerobot_ros.nodes.robot_node import RobotNode
from spacerobot_ros.planning import GaitSchedule, Goal, PoseError, RobotState
from spacerobot_ros.planning.registry import build_method
from spacerobot_ros.planning.stitching import stitched
from spacerobot_ros.planning.stuck_joints import RemainingJointsGait

PLANNED = "Planned in {:.6f} s."
"""What is logged when a plan is made."""


class PlannerNode(RobotNode):
    """Turns goal poses into gaits and streams their velocities, one command for every state.

    A goal is planned from the next measured state. When its schedule has ended the measured pose
    is compared with the goal, and the rest is planned again until the tolerance is met or
    ``max_corrections`` are used up; the pieces of a gait that its method plans one by one (a
    *partial* schedule) do not count. A new goal replaces the one that is being flown. When a joint
    does not follow, the rest is planned with the joints that remain.
    """

    SPECS: ClassVar = PLANNER_SPECS

    def __init__(self, name: str = "planner", **kwargs: Any) -> None:
        self._running = False
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
        self._pending = False
        self._corrections = 0
        self._landed: GaitSchedule | None = None
        """A schedule that has ended, and whose result is still to be judged."""
        self._replanning = False
        """Whether the next plan is the first without a joint that was found stuck."""
        self._odom_raw = self._joints_raw = b""
        self._stamp = 0
        self._odom_fresh = self._joints_fresh = False
        to_plant = self.parameters["output"] == "commands"
        topic = "joint_commands" if to_plant else "joint_reference"
        self._commands = self.send_raw(JointState, topic)
        self._plan_topics = PlanTopics(self, str(self.parameters["world_frame"]))
        self._status = PlannerStatus(self)
        self._memory = GoalMemory(str(self.parameters["resume_file"]))
        self.find_robot()
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal, STREAM)
        self.create_subscription(JointState, "goal_joint_states", self._on_goal_shape, STREAM)
        self.create_subscription(Odometry, "odom", self._on_odom, STREAM, raw=True)
        self.create_subscription(JointState, "joint_states", self._on_joints, STREAM, raw=True)
        self.create_service(Trigger, "~/abort", self._on_abort)

    def activate(self) -> None:
        """Answer states with commands from now on."""
        self._running = True
        kept = self._memory.recall()
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
            self.get_logger().info(ANSWERED.format(self._flight.answers))
            self._flight.drop()
        self._running = False
        self._goal = self._landed = None

    def _use(self, robot: SpaceRobot) -> None:
        self._robot = robot
        values: dict[str, Any] = self.parameters
        tick_period = round(NANOSECONDS / values["tick_rate"]) / NANOSECONDS
        self._all_joints = self._method = build_method(
            values["method"],
            robot,
            tick_period,
            tolerance_of(values),
            values["integration_step"],
            values,
        )
        self._state = MeasuredState(robot, values["averaging"], values["rest_tolerance"])
        self._flight = GaitFlight(robot, values, tick_period)
        self._joints = JointReader(robot.joint_names, ["position"], complete=True)

    def parameters_changed(self) -> None:
        """Plan and judge with the new tolerances."""
        if self._robot is not None:
            self._method.tolerance = self._all_joints.tolerance = tolerance_of(self.parameters)

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
        self._proposed = goal
        self._pending = True
        if self._robot is not None:
            self._state.restart()

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
        if self._joints_fresh or self._pending or self._landed is not None:
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
            self._on_state(posed=together and self._odom_fresh)
        elif together and self._odom_fresh:
            # What was answered without the pose is planned from when the next joints come.
            self._observe()
        self._odom_fresh = self._odom_fresh and not together

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        flying = self._robot is not None and self._flight.flying
        response.success = flying or self._landed is not None
        response.message = "Nothing is flown." if not response.success else "The joints rest."
        if flying:
            self._flight.break_off(self._stamp)
            response.message = (
                "The joints come to rest along the gait within "
                f"{self.parameters['abort_time']:g} s."
            )
        if response.success:
            self._status.publish(PlannerState.ABORTED, f"Aborted on request. {response.message}")
        self._pending = False
        self._goal = self._landed = None
        self._memory.forget()
        return response

    # -- flying -------------------------------------------------------------------------------

    def _on_state(self, *, posed: bool) -> None:
        """Answer one state with one command of the same stamp; ``posed``: odom is there too."""
        try:
            stamp = self._joints.accept(self._joints_raw)
        except CommandError as error:
            self.get_logger().error(f"joint_states: {error}.", throttle_duration_sec=5.0)
            return
        self._stamp = stamp
        q = self._joints.values["position"]
        if self._flight.ended(stamp, q):
            self._land(arrived=self._goal is not None)
        if self._pending or self._landed is not None:
            if posed:
                self._observe()
            self._decide(stamp)
        elif posed and self._flight.drift_due(stamp):
            self._look_for_drift(stamp)
        stuck = self._flight.follow(stamp, q)
        if stuck and self._goal is not None:
            self._go_on_without(stuck)
        self._commands.take(self._flight.answer(stamp, q))

    def _land(self, *, arrived: bool) -> None:
        """End what is flown; its result is judged unless it was broken off."""
        flown = self._flight.end(at_last_shape=arrived)
        if self._goal is not None:
            self._landed = flown
            self._state.restart()

    def _observe(self) -> None:
        """Take the measured state to plan from; of a robot that moves only the last one counts."""
        if self._pending or self._landed is not None:
            if self._flight.flying:
                self._state.restart()
            self._read()

    def _read(self) -> bool:
        """Add what is measured to the state; return whether it is a state of this robot."""
        try:
            self._state.read(self._odom_raw, self._joints_raw)
        except CommandError as error:
            self.get_logger().error(f"odom: {error}.", throttle_duration_sec=5.0)
            return False
        return True

    def _decide(self, stamp: int) -> None:
        """Plan or judge when the state is known well enough."""
        if not (self._state.complete or (self._flight.flying and self._state.count)):
            return
        if self._pending:
            self._pending = False
            self._plan_proposed(stamp)
        if self._landed is not None:
            self._judge(stamp)
        self._state.restart()

    def _look_for_drift(self, stamp: int) -> None:
        """Plan what is left again when the base is too far off the path that was predicted."""
        assert self._goal is not None
        self._state.restart()
        left = self._corrections < int(self.parameters["max_corrections"])  # type: ignore[arg-type]
        if not left or not self._read():
            return
        off = ""
        try:
            off = self._flight.drifted(self._state.state())
            if not off:
                return
            schedule = self._plan(self._goal, correction=False)
        except PlanningError as reason:
            off = off or "The path is not known"
            self.get_logger().warning(f"{off}, and the rest cannot be planned again: {reason}")
            return
        self._corrections += 1
        self.get_logger().warning(f"{off}: the rest is planned again.")
        self._fly(schedule, stamp)

    def _go_on_without(self, stuck: list[int]) -> None:
        """Come to rest, and plan what is left with the joints that are not stuck."""
        assert self._robot is not None
        self._flight.stuck += stuck
        names = [self._robot.joint_names[i] for i in self._flight.stuck]
        self._method = RemainingJointsGait.instead_of(
            self._all_joints, names, str(self.parameters["method"]), self.parameters
        )
        self._replanning = True
        self._land(arrived=False)
        self.get_logger().warning(f"Stuck: {', '.join(names)}. What is left is planned without.")

    def _plan_proposed(self, stamp: int) -> None:
        self.plan_time = self.flown_time = 0.0
        before, self._method = self._method, self._all_joints
        try:
            schedule = self._plan(self._proposed, correction=False)
        except PlanningError as error:
            self._method = before
            kept = " The earlier goal is still flown." if self._flight.flying else ""
            self._status.publish(PlannerState.REFUSED, f"{error}{kept}", goal=self._proposed)
            return
        self._goal, self._landed = self._proposed, None
        try:
            self._memory.keep(self._goal)
        except ParameterError as error:
            self.get_logger().error(f"{error} The goal is flown, but would not be resumed.")
        self._corrections, self._flight.stuck, self._replanning = 0, [], False
        self._fly(schedule, stamp)

    def _plan(self, goal: Goal, *, correction: bool) -> GaitSchedule:
        """Plan from the measured state; what is flown comes to rest along its gait first."""

        def plan(state: RobotState) -> GaitSchedule:
            return self._method.plan(state, goal, correction=correction)

        began = time.perf_counter()
        try:
            flown = self._flight.coming_to_rest(self._stamp)
            if flown is None or self._robot is None:
                return plan(self._state.state())
            step = float(self.parameters["integration_step"])  # type: ignore[arg-type]
            return stitched(flown, self._stamp, self._state.state(), self._robot, step, plan)
        finally:
            took = time.perf_counter() - began
            self.plan_time += took
            # Not in the status: what is published is the same in every run.
            self.get_logger().info(PLANNED.format(took))

    def _fly(self, schedule: GaitSchedule, stamp: int, error: PoseError | None = None) -> None:
        self._flight.begin(schedule, stamp)
        self.flown_time += schedule.duration
        self.ends_at = stamp / NANOSECONDS + schedule.duration
        self._status.publish(
            PlannerState.EXECUTING,
            f"Flying a {schedule.method} gait of {schedule.duration:.6g} s.",
            goal=schedule.goal,
            schedule=schedule,
            error=error,
            **self._account(),
        )
        assert self._robot is not None
        self._plan_topics.publish(self._robot.description, schedule, stamp)

    def _account(self) -> dict[str, Any]:
        """Return what the present goal has cost so far, for the status."""
        return {
            "corrections": self._corrections,
            "flown_time": self.flown_time,
            "ends_at": self.ends_at,
        }

    def _judge(self, stamp: int) -> None:
        """Compare the measured pose with the goal; plan what is left, or be done."""
        assert self._goal is not None
        assert self._landed is not None
        flown, self._landed = self._landed, None
        replanned, self._replanning = self._replanning, False
        try:
            state = self._state.state()
        except PlanningError as reason:
            self._conclude(PlannerState.FAILED, str(reason), goal=self._goal)
            return
        error = PoseError.between(state.position, state.quaternion, self._goal, state.q)
        result: dict[str, Any] = {
            "goal": self._goal,
            "error": error,
            **self._account(),
        }
        left = what_is_left(error, self._method.controls)
        if tolerance_of(self.parameters).admits(error, self._method.controls):
            self._conclude(PlannerState.REACHED, f"The goal is met: {left}.", **result)
            return
        counts = not flown.partial and not replanned
        if counts and self._corrections >= int(self.parameters["max_corrections"]):  # type: ignore[arg-type]
            missed = f"The goal is not met: {left} after {self._corrections} correction(s)."
            self._conclude(PlannerState.FAILED, missed, **result)
            return
        self._corrections += counts
        try:
            self._fly(self._plan(self._goal, correction=not replanned), stamp, error)
        except PlanningError as reason:
            missed = f"The goal is not met: {left}, and {reason}"
            self._conclude(PlannerState.FAILED, missed, **result)

    def _conclude(self, state: PlannerState, sentence: str, **values: Any) -> None:
        """Be done with the goal: nothing is to be resumed."""
        self._status.publish(state, sentence, **values)
        self._memory.forget()


def main() -> None:
    """Run the planner until SIGINT or SIGTERM."""
    sys.exit(run_node(PlannerNode))


if __name__ == "__main__":
    main()
