"""The planner node: goal poses in, joint velocities out. It only converts messages."""

from __future__ import annotations

import sys
from threading import Thread
from typing import Any, ClassVar

from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.commanding.goal_follower import decision_event
from spacerobot_ros.errors import CommandError, PlanningError
from spacerobot_ros.events import Event
from spacerobot_ros.flight.plant_listener import Change, Stopped
from spacerobot_ros.flight.state_synchroniser import CONTRADICTION, Pairing, StateSynchroniser
from spacerobot_ros.messages.builders import path_message, trajectory_message
from spacerobot_ros.messages.readers import StateReader, joint_template
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.commander import CommanderNode
from spacerobot_ros.nodes.common.messages import (
    diagnostic_status,
    goal_markers,
    goal_of,
    goal_sentence,
    shape_of,
)
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, described_robot
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.executive import Executive, Transition
from spacerobot_ros.planning.execution.goal_file import BASE, GoalFile, GoalIds, IdentifiedGoal
from spacerobot_ros.planning.execution.status import (
    Notice,
    PlannerState,
    PlannerStatistics,
    PlannerStatus,
    ScheduleStart,
    Severity,
    goal_values,
)
from spacerobot_ros.planning.execution.worker import LONGEST_END, PlanningWorker
from spacerobot_ros.times import stamp_bytes

# Python looks up the member of an enum as slowly as it calls a function; these are for every state.
_WITHOUT_POSE, _LATE_POSE = Pairing.WITHOUT_POSE, Pairing.LATE_POSE


class PlannerNode(CommanderNode):
    """Turns goal poses into gaits and publishes their velocities, one command for every state.

    A goal is planned from the next measured state. When its schedule has ended the measured pose
    is compared with the goal, and the remaining motion is planned again until the goal is reached
    within tolerance or ``max_corrections`` are used up; the pieces of a gait that its method plans
    one by one (a *partial* schedule) do not count. A new goal replaces the present one. When a
    joint does not follow, the remaining motion is planned with the other joints.

    All this is decided by an :class:`~spacerobot_ros.planning.execution.executive.Executive`.
    """

    Config: ClassVar = PlannerConfig
    config: PlannerConfig

    def __init__(self, name: str = "planner", **kwargs: Any) -> None:
        self._running = False
        self._executive: Executive | None = None
        super().__init__(name, **kwargs)

    @property
    def statistics(self) -> PlannerStatistics:
        """What the planner has done so far."""
        return PlannerStatistics() if self._executive is None else self._executive.statistics

    # -- life ---------------------------------------------------------------------------------

    def configure(self) -> None:
        """Create the topics; without a robot of its own the planner waits for robot_description."""
        config = self.config
        self._waiting: IdentifiedGoal | None = None
        """A goal that was received before the robot."""
        self._goal_shape: Array | None = None
        self._goal_ids = GoalIds()
        self._goal_file = GoalFile(config.resume_file)
        self._states = StateSynchroniser(pose_required=False)
        self._announcement: Thread | None = None
        self._executive = None
        topic = "joint_commands" if config.output == "commands" else "joint_reference"
        self._commands = self.send_raw(JointState, topic)
        self._schedule_topic = self.create_publisher(JointTrajectory, "gait_schedule", LATCHED)
        self._path_topic = self.create_publisher(Path, "planned_path", LATCHED)
        self._markers_topic = self.create_publisher(MarkerArray, "markers", STREAM)
        self._status_topic = self.create_publisher(DiagnosticStatus, "planner/status", LATCHED)
        self.listen(config.control_period)
        self.find_robot()
        self.create_subscription(PoseStamped, "goal_pose", self._on_goal, STREAM)
        self.create_subscription(JointState, "goal_joint_states", self._on_goal_shape, STREAM)
        self.create_service(Trigger, "~/abort", self._on_abort)
        self.create_service(Trigger, "~/statistics", self._on_statistics)

    def activate(self) -> None:
        """Answer states with commands from now on; resume the goal on file, if there is one."""
        resumed = self._goal_file.load().get(BASE)
        self._running = True
        if resumed is None:
            self._publish_status(PlannerStatus(PlannerState.IDLE, "Waiting for a goal pose."))
        else:
            self._propose(resumed)
            self._publish_waiting(resumed, "Resuming an earlier goal.")
        # A lockstep plant may have been waiting for an answer since before.
        self._on_part()

    def start_sentence(self) -> str:
        """Return how it plans, and where goals are taken."""
        config, topic = self.config, self.resolve_topic_name("goal_pose")
        return (
            f"Plans by '{config.method}' for {described_robot(self._robot)} at "
            f"{config.tick_rate:g} Hz; goals on '{topic}' in '{config.world_frame}'."
        )

    def deactivate(self) -> None:
        """Give up the present goal and command nothing any more; the goal file stays."""
        if self._running and self._executive is not None:
            commands = self.statistics.commands_published
            self.get_logger().info(f"{commands} commands were published.")
            self._executive.stop()
            self._publish_outputs(self._executive)
            if self._announcement is not None:
                self._announcement.join(LONGEST_END)
        self._running, self._waiting = False, None

    def interrupt(self) -> None:
        """Cancel the plan that is being made."""
        if self._executive is not None:
            self._executive.cancel_plan()

    def _use(self, robot: SpaceRobot) -> None:
        worker = PlanningWorker(robot, self.config, long_work=self.long_work)
        self._executive = executive = Executive(robot, self.config, worker, self._goal_file)
        self._robot = robot
        self._measured = StateReader(robot.joint_names)
        self._joint_reader = self._measured.shape_reader
        self._plant_reported()
        self._setpoint = joint_template(robot.joint_names)
        if robot.n:
            self._setpoint.feed("position", executive.setpoint.position)
            self._setpoint.feed("velocity", executive.setpoint.velocity)
        if self._waiting is not None:
            executive.propose(self._waiting)
            self._waiting = None

    def parameters_changed(self) -> None:
        """Plan and evaluate with the new tolerances."""
        if self._executive is not None:
            self._executive.config = self.config

    # -- goals --------------------------------------------------------------------------------

    def _on_goal(self, message: PoseStamped) -> None:
        if not self._running:
            return
        goal_id = self._goal_ids.of(message.header.stamp.sec, message.header.stamp.nanosec)
        try:
            goal = goal_of(
                message, self.config.world_frame, shape=self._goal_shape, pose_of=self._pose_of
            )
        except PlanningError as error:
            self._publish_status(PlannerStatus(PlannerState.REFUSED, str(error), goal_id=goal_id))
            return
        if self._plant.blocked:
            refusal = PlannerStatus(PlannerState.REFUSED, self._plant.blocked, goal_id=goal_id)
            self._publish_status(refusal)
            return
        identified = IdentifiedGoal(goal, goal_id)
        self.get_logger().info(goal_sentence("base", goal_id, message, goal))
        self._propose(identified)
        if self._executive is None:
            self._publish_waiting(identified, "The goal waits for a robot on robot_description.")

    def _propose(self, identified: IdentifiedGoal) -> None:
        if self._executive is None:
            self._waiting = identified
        else:
            self._executive.propose(identified)

    def _on_goal_shape(self, message: JointState) -> None:
        """Keep the shape that goals from now on are to end in, for methods that take one.

        A message without joints lets them end in any.
        """
        if self._robot is None:
            return
        try:
            names = self._robot.joint_names
            self._goal_shape = shape_of(message, names) if message.name else None
        except PlanningError as error:
            self._publish_status(PlannerStatus(PlannerState.REFUSED, str(error)))

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        sentence = None
        if self._executive is not None:
            sentence = self._executive.abort()
            self._publish_outputs(self._executive)
        waiting, self._waiting = self._waiting, None
        self._goal_file.delete()
        if waiting is not None:
            sentence = "Aborted on request, before the robot was known."
            self._publish_status(
                PlannerStatus(PlannerState.ABORTED, sentence, goal_id=waiting.goal_id)
            )
        response.success = sentence is not None
        response.message = sentence or "There is no goal to abort."
        return response

    def _on_statistics(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = True, self.statistics.to_json()
        return response

    # -- what the plant publishes -------------------------------------------------------------

    def _plant_stopped(self, stopped: Stopped) -> None:
        waiting, self._waiting = self._waiting, None
        if self._executive is not None:
            self._executive.plant_stopped(
                stopped.why, stopped.commanded_until_ns, stopped.rests_since_ns
            )
            self._publish_outputs(self._executive)
        elif waiting is not None and stopped.commanded_until_ns is None:
            self._goal_file.delete()
            sentence = f"Aborted by the plant: {stopped.why}"
            self._publish_status(
                PlannerStatus(PlannerState.ABORTED, sentence, goal_id=waiting.goal_id)
            )
        else:
            self._waiting = waiting

    def _plant_changed(self, change: Change) -> None:
        if change is not Change.RESET:
            return
        self._states.forget_pose()
        if self._executive is not None:
            self._executive.plant_reset()
            self._publish_outputs(self._executive)

    def _plant_reported(self) -> None:
        if self._executive is not None:
            self._executive.plant_rests = self._plant.rests

    def _take_odom(self, raw: bytes) -> None:
        if self._states.put_odom(raw):
            self.get_logger().error(CONTRADICTION, throttle_duration_sec=5.0)
        # With a goal to plan for or to evaluate, even a pose that comes after its joints counts.
        if self._executive is not None and self._executive.measuring:
            self._on_part()

    def _take_joints(self, raw: bytes) -> None:
        self._states.put_joint_states(raw)
        self._on_part()

    def _on_part(self) -> None:
        """Answer a state once, as soon as its joints are there; only plans need its pose."""
        executive = self._executive
        if not self._running or executive is None:
            return
        states, measured = self._states, self._measured
        pairing = states.ready()
        if pairing is None:
            return
        odom = states.odom if pairing is not _WITHOUT_POSE else None
        try:
            measured.accept(states.joint_states, odom)
        except CommandError as error:
            self._times.withdraw()
            self.get_logger().error(f"joint_states: {error}.", throttle_duration_sec=5.0)
            return
        if pairing is _LATE_POSE:
            # The state was answered without it, and is planned from when the next joints come.
            executive.observe(measured)
        else:
            executive.update(measured)
            if executive.outputs:
                self._publish_outputs(executive)
                if not self._running:
                    return
            self._commands.take(self._setpoint.serialised(stamp_bytes(measured.stamp_ns)))
        if measured.base_error is not None:
            self.get_logger().error(f"odom: {measured.base_error}.", throttle_duration_sec=5.0)
            measured.base_error = None

    # -- outputs ------------------------------------------------------------------------------

    def _publish_outputs(self, executive: Executive) -> None:
        """Publish and log what the executive hands out."""
        while executive.outputs:
            output, logger = executive.outputs.popleft(), self.get_logger()
            match output:
                case PlannerStatus():
                    self._publish_status(output)
                case ScheduleStart():
                    self._announce(output)
                case Event():
                    self.report_event(output)
                # Three calls: rclpy refuses one that changes its severity.
                case Notice(Severity.INFO, sentence):
                    logger.info(sentence)
                case Notice(Severity.WARNING, sentence):
                    logger.warning(sentence)
                case Notice(Severity.ERROR, sentence):
                    logger.error(sentence)
                case Transition(source, event, target):
                    logger.debug(f"{source.value} -> {target.value}: {event.value}")

    def _publish_waiting(self, identified: IdentifiedGoal, sentence: str) -> None:
        self._publish_status(
            PlannerStatus(
                PlannerState.PLANNING,
                sentence,
                goal_id=identified.goal_id,
                goal=goal_values(identified.goal),
            )
        )

    def _publish_status(self, status: PlannerStatus) -> None:
        """Publish a status, and an event where it decides a goal, and log its sentence."""
        name, level = self.get_fully_qualified_name(), bytes([status.state.level])
        self._said = diagnostic_status(name, level, status.message, status.to_values())
        self._status_topic.publish(self._said)
        event = decision_event(status)
        if event is not None:
            self.report_event(event)
        if status.state.decided and self.config.stop_when_decided:
            self._running = False
        if status.state.level:
            self.get_logger().warning(status.message)
        else:
            self.get_logger().info(status.message)

    def _announce(self, start: ScheduleStart) -> None:
        """Publish a schedule, its path and its goal; beside the flight where plans are made so."""
        if not self.config.plan_in_background:
            self._publish_schedule(start)
            return
        if self._announcement is not None:
            self._announcement.join(LONGEST_END)
        # Serialising a long schedule takes longer than a tick, and nothing waits for it.
        self._announcement = Thread(target=self._publish_schedule, args=(start,), daemon=True)
        self._announcement.start()

    def _publish_schedule(self, start: ScheduleStart) -> None:
        schedule, stamp, frame = start.schedule, start.stamp_ns, self.config.world_frame
        assert self._robot is not None
        base = self._robot.description
        self._schedule_topic.publish(trajectory_message(schedule, stamp, base.base_link))
        self._path_topic.publish(path_message(schedule.path, stamp, frame))
        shapes = base.links[0].shapes
        self._markers_topic.publish(goal_markers(schedule.goal, schedule.path, shapes, frame))


def main() -> None:
    """Run the planner until SIGINT or SIGTERM."""
    sys.exit(run_node(PlannerNode))


if __name__ == "__main__":
    main()
