"""The plant node: a robot that floats in space, behind ROS topics."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.serialization import deserialize_message
from rclpy.timer import Timer
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from visualization_msgs.msg import MarkerArray

from spacerobot_ros.errors import (
    CommandError,
    ParameterError,
    RobotDescriptionError,
    SpaceRobotError,
    printable,
)
from spacerobot_ros.events import Event
from spacerobot_ros.messages.builders import RobotMarkers
from spacerobot_ros.messages.diagnostics import StatusRecord
from spacerobot_ros.messages.readers import CommandReader, actuation_of
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.grasp import BodyMotion, Payload
from spacerobot_ros.model.shared_parameters import robot_of
from spacerobot_ros.model.urdf import obstacles_from_topic, with_world
from spacerobot_ros.nodes.common.messages import message_class
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, FlightNode, described_robot
from spacerobot_ros.nodes.common.process import run_node
from spacerobot_ros.nodes.common.watchdog import Role, SilenceReport
from spacerobot_ros.nodes.plant.publisher import (
    ClearancePublisher,
    PlantReport,
    StatePublisher,
    TransformPublisher,
)
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.actuators import PlantWithFaults, build_plant
from spacerobot_ros.simulation.capture import CapturePlant
from spacerobot_ros.simulation.commands import CommandValidator
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.sensors import ReportedState
from spacerobot_ros.simulation.status import PlantMonitor, PlantState, PlantStatus, latched_text
from spacerobot_ros.simulation.time_modes import RealTime
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import TOPICS

if TYPE_CHECKING:
    from spacerobot_ros.bag.salvage import LastState

_READER_CHECK_PERIOD = 0.1  # wall s

_MAX_UNCONFIRMED_TICKS = STREAM.depth // 2
"""Maximum number of lockstep ticks between confirmations of the states by all readers: a reader
that lags by more than the publisher queue would lose messages."""

_MAX_RATE_AT_REST = 1e-3  # m/s or rad/s
_LONGEST_REST = 0.8  # wall s, before the process ends

_REPORT_PERIOD_NS = 950_000_000
"""Wall time after which new diagnostics are due, ns (about one second)."""

_LONGEST_MARKER_PERIOD, _LONGEST_FRAME_PERIOD, _LONGEST_CLEARANCE_PERIOD = 0.5, 0.1, 0.5
"""Maximum wall time, s, between two publications of markers, /tf or clearances in real time."""

_CARRIED = {"velocity": "velocities", "effort": "efforts", "auto": "velocities or efforts"}
"""Commanded quantities, by the parameter ``actuation``."""


class PlantNode(FlightNode):
    """Integrates the momentum-conserving model and publishes the topics of a real robot.

    In ``lockstep``, it publishes the state of tick k and steps when the command stamped with that
    tick has arrived. In ``realtime``, the plant follows the wall clock, scaled by
    ``real_time_factor``, holds the last command, and brings the joints to rest if that command is
    older than ``command_timeout``.
    """

    Config: ClassVar = PlantConfig
    role = Role.PLANT
    depends_on = (Role.COMMANDER,)
    config: PlantConfig

    def __init__(self, name: str = "plant", **kwargs: Any) -> None:
        self._active = PlantState.INACTIVE
        self._when_active = PlantState.RUNNING
        self.tick, self._period_ns = 0, 1
        """Number of the tick whose state was published last, and the time, ns, between two
        ticks.
        """
        self._wall_timers: list[Timer] = []
        self._monitor: PlantMonitor | None = None
        self.status = PlantStatus(PlantState.INACTIVE)
        """Last status published on plant/status."""
        super().__init__(name, **kwargs)

    @property
    def time_ns(self) -> int:
        """Simulated time of the last published state, ns."""
        return self.tick * self._period_ns

    @property
    def simulated_time_s(self) -> float:
        """Simulated time of the last published state, s."""
        return self.time_ns / SECOND

    @property
    def state(self) -> PlantState:
        """Plant state: whether time runs, and whether commands take effect."""
        return self.status.state

    @property
    def _is_running_or_paused(self) -> bool:
        return self._active in (PlantState.RUNNING, PlantState.PAUSED)

    # -- life cycle ---------------------------------------------------------------------------

    def prepare(self) -> None:
        """Publish the status of an unconfigured plant, which is inactive."""
        self._status = self.create_publisher(DiagnosticStatus, "plant/status", LATCHED)
        self._publish_status(PlantStatus(PlantState.INACTIVE, "The plant is not configured."))

    def configure(self) -> None:
        """Build the plant and its topics; nothing is published yet."""
        config = self.config
        robot = robot_of(config)
        if robot is None:
            raise ParameterError(
                "The plant needs a robot: set parameter 'robot' to a URDF file or the name of a "
                "packaged robot, or 'robot_description' to a URDF string."
            )
        self._period_ns = config.period_ns
        decided = config.decided()
        # Moving joints or thrusters already require efforts.
        self._undecided = config.actuation == "auto" and decided.actuation == "velocity"
        self._under_efforts: PlantWithFaults | None = None
        """The effort plant in its initial state, kept as long as it may be needed."""
        if self._undecided:
            under_efforts = config.decided("effort")
            self._under_efforts = build_plant(robot, under_efforts)
            # Create its brake equations now: between two ticks, this would delay the plant.
            CommandValidator(self._under_efforts, under_efforts)
        last = self._last_state(robot)
        self.tick = 0 if last is None else round(last.time_ns / self._period_ns)
        if last is None:
            plant = build_plant(robot, decided)
        else:
            payload = Payload.from_text(last.payload) if last.payload else None
            plant = _resumed_plant(robot, decided, last.initial, last.target, payload)
        self._use_plant(plant, decided)
        self._real_time: RealTime | None = None
        """The wall clock; None in lockstep."""
        if config.time_mode == "realtime":
            self._real_time = RealTime(self._period_ns, config.real_time_factor)
        self._monitor = PlantMonitor(
            self.commands, self.plant, config if self._undecided else decided
        )
        self._publisher = StatePublisher(self)
        self._transforms = TransformPublisher(self)
        self._markers = RobotMarkers(robot.description, self.reported.target, config.world_frame)
        self._marker_stream = self.create_publisher(MarkerArray, "markers", STREAM)
        self._report = PlantReport(self, self._real_time)
        self._pose_ticks = (
            self._ticks_for_viewers(config.base_pose_period, _LONGEST_MARKER_PERIOD) or 1
        )
        self._marker_ticks = self._ticks_for_viewers(config.marker_period, _LONGEST_MARKER_PERIOD)
        self._tf_ticks = 0
        if self._transforms.publishes:
            self._tf_ticks = self._ticks_for_viewers(config.tf_period, _LONGEST_FRAME_PERIOD)
        self._report_ticks = config.ticks_of(config.diagnostics_period)
        self._clearance_ticks = self._ticks_for_viewers(
            config.clearance_period, _LONGEST_CLEARANCE_PERIOD
        )
        self._clearance = None
        if self._clearance_ticks:
            self._clearance = ClearancePublisher(self)
        self._obstacles: str | None = None
        """The last URDF on the topic obstacles; None if the robot's own obstacles are used."""
        self.create_subscription(String, "obstacles", self._on_obstacles, LATCHED)
        for topic in (*self._readers, *(["base_wrench"] if self._undecided else [])):
            kind = message_class(TOPICS[topic].type)
            take = partial(self._on_command, topic)
            self.create_subscription(kind, topic, take, STREAM, raw=True)
        for topic, inject in (
            ("fault_injection", lambda text: self.plant.inject(text)),
            ("disturbance_injection", lambda text: self.plant.disturb(text)),
        ):
            self.create_subscription(String, topic, partial(self._on_injection, inject), STREAM)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.offer("~/reset", self._reset)
        self.offer("~/abort", self._abort)
        self.offer("~/rearm", self._rearm)
        self.offer("~/capture", lambda: self._grasp(lambda capturing: capturing.capture()))
        self.offer("~/release", lambda: self._grasp(lambda capturing: capturing.release()))
        self._publish_status(self._monitor.status)

    def _use_plant(self, plant: PlantWithFaults, config: PlantConfig) -> None:
        self.plant = plant
        plant.start_at(self.tick)
        self.reported = ReportedState(plant, config)
        self.commands = CommandValidator(plant, config)
        self._readers = {
            source.topic: CommandReader(
                source, plant.robot, config.prefix_for(plant.robot.description)
            )
            for source in self.commands.sources
        }
        self._capturing = plant.capturing
        self._injected_seen = plant.injected
        self._looked_at = -1
        """Tick of the last check for subscribers."""

    def _decide_actuation(self, topic: str, raw: bytes) -> None:
        """Use the actuation of a command that moves anything as the plant's actuation."""
        actuation = "effort"
        if topic == "joint_commands":
            try:
                actuation = actuation_of(deserialize_message(raw, JointState))
            except RuntimeError:
                return  # The reader rejects what is not a message.
        if not actuation:
            return
        assert self._monitor is not None
        self._undecided, config = False, self.config.decided(actuation)
        if actuation == "effort":
            commands, before, after = self.commands, self.plant, self._under_efforts
            capturing = before.capturing
            # Without a motion so far, the prepared plant is in the current state.
            if capturing is not None or np.any(before.momentum[:6]) or self.config.resume_bag:
                motion = before.pose, before.q, before.qdot, before.momentum
                target = payload = None
                if capturing is not None:
                    target = BodyMotion.of(capturing.target_pose, capturing.target_twist)
                    payload = capturing.payload
                initial = InitialState.of_motion(*motion)
                after = _resumed_plant(before.robot, config, initial, target, payload)
            assert after is not None
            self._use_plant(after, config)
            self.plant.succeed(before)
            self.commands.succeed(commands)
            self._publisher.rebuild()
            self._report.observe_plant()
            self._count_commanders()
        self._under_efforts = None
        if self._real_time is not None:
            # Time stands still meanwhile: this command, and the wrench with it, answer its state.
            self._real_time.start(self._steady.now().nanoseconds, self.tick)
        self._monitor.observe(self.commands, self.plant, config)
        self.get_logger().info(
            f"Commands carry {_CARRIED[actuation]}: the plant uses this actuation."
        )
        self._publish_changed_status()

    def activate(self) -> None:
        """Publish the robot and its current state, and start stepping."""
        self._active = self._when_active
        self.commands.revoke_before(self.time_ns)
        self._publisher.publish_description()
        if self._tf_ticks:
            self._transforms.publish_static(self.time_ns)
        self._steady = steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._reported_ns = steady.now().nanoseconds
        if self._real_time is None:
            self._publisher.has_new_readers()
            self._check_for_commanders()
            self._wall_timers = [
                self.create_timer(_READER_CHECK_PERIOD, self._on_subscriber_check, clock=steady)
            ]
        else:
            self._real_time.start(steady.now().nanoseconds, self.tick)
            self._wall_timers = [
                self.create_timer(self._real_time.period, self._on_wall_tick, clock=steady),
                self.create_timer(_READER_CHECK_PERIOD, self._on_commander_check, clock=steady),
            ]
        self._publish_changed_status()
        self._publish()

    def deactivate(self) -> None:
        """Stop simulated time and drop the current commands."""
        self._stop_timers()
        if self._active in (PlantState.INACTIVE, PlantState.FAILED):
            return
        self._active = PlantState.INACTIVE
        self.commands.rest()
        self._publish_changed_status()

    def start_message(self) -> str:
        """Return a log message with the robot, actuation, rate and time mode."""
        config = self.config
        pace = "in lockstep"
        if self._real_time is not None:
            pace = f"at {config.real_time_factor:g} times real time"
        actuation = "effort" if self.plant.takes_wrench else "velocity"
        carried = _CARRIED["auto" if self._undecided else actuation]
        return (
            f"Simulates {described_robot(self.plant.robot)} at {config.tick_rate:g} Hz {pace}; "
            f"commands carry {carried}."
        )

    def on_failure(self, message: str, error: Exception) -> None:
        """Report the failure and drop the current commands, so that no command is active
        after a restart."""
        self._stop_timers()
        self._active = PlantState.FAILED
        reason = "model" if isinstance(error, SpaceRobotError) else "exception"
        if self._monitor is None:
            self._publish_status(PlantStatus(PlantState.FAILED, message, reason))
            return
        self._monitor.failure = reason, message
        self.commands.rest()
        self._publish_changed_status()

    def drain(self, executor: EventsExecutor) -> None:
        """Bring the joints to rest, because the commanders are also ending."""
        if self._active is not PlantState.RUNNING or self._real_time is None:
            return
        self._readers, self._undecided = {}, False  # Commands no longer count.
        self.commands.rest()
        self._publish_changed_status()
        end, began = time.monotonic() + _LONGEST_REST, self.tick

        def at_rest() -> bool:
            return self.tick > began and bool(np.all(np.abs(self.plant.qdot) <= _MAX_RATE_AT_REST))

        while not at_rest() and time.monotonic() < end and self.is_active:
            executor.spin_once(timeout_sec=0.02)
        if self.tick == began and self.is_active:
            self._step()  # In slow real time, one tick suffices, because servos stop in it.

    def _stop_timers(self) -> None:
        for timer in self._wall_timers:
            self.destroy_timer(timer)
        self._wall_timers = []

    def cleanup(self) -> None:
        """Release the plant and publish that the simulation has ended."""
        self._active, self._monitor = PlantState.INACTIVE, None
        self._publish_status(PlantStatus(PlantState.INACTIVE, "The simulation has ended.", "ended"))

    def _publish_changed_status(self) -> None:
        assert self._monitor is not None
        self._injected_seen = self.plant.injected
        events = self._monitor.update(self._active, self.time_ns / SECOND)
        if self._monitor.status is not self.status:
            self._publish_status(self._monitor.status)
        for event in events:
            self.report_event(event)

    def _publish_status(self, status: PlantStatus) -> None:
        self.status = status
        record = StatusRecord.of(self.get_fully_qualified_name(), status)
        self._status.publish(record.encoded())

    def _last_state(self, robot: SpaceRobot) -> LastState | None:
        path = self.config.resume_bag
        if not path:
            return None
        from spacerobot_ros.bag.salvage import last_state  # Few plants start from a bag.

        state = last_state(path, self.get_namespace().rstrip("/"))
        if state.joint_names != list(robot.joint_names):
            raise ParameterError(
                f"Parameter 'resume_bag' is '{path}', a bag recorded with a robot whose joints are "
                f"{', '.join(state.joint_names)}; this robot has {', '.join(robot.joint_names)}."
            )
        if self.config.target.given != (state.target is not None):
            other = "no target" if state.target is None else "a target"
            raise ParameterError(
                f"Parameter 'resume_bag' is '{path}', whose last state has {other}: set "
                "'target.robot' as in that flight."
            )
        return state

    # -- time ---------------------------------------------------------------------------------

    def _step(self) -> None:
        try:
            limited = self.plant.step(*self.commands.begin_step())
        except SpaceRobotError as error:
            time = self.time_ns / SECOND
            raise SpaceRobotError(f"The plant stops at {time:g} s: {error}") from error
        if limited:
            self._report.limited()
        if self._capturing is not None and self._capturing.events:
            # Commanders must know about the other robot before they answer its states.
            self._publish_changed_status()
        self.tick += 1
        self._publish()
        if self._real_time is None and self.tick % _MAX_UNCONFIRMED_TICKS == 0:
            self._publisher.await_readers()
        if self.plant.injected is not self._injected_seen:
            self._publish_changed_status()

    def _publish(self) -> None:
        now = self.tick * self._period_ns
        if self.reported.update():
            self._publisher.rebuild()
        self._publisher.publish(now, all_topics=self.tick % self._pose_ticks == 0)
        if self._clearance is not None:
            publishes = self.tick % self._clearance_ticks == 0
            looks = publishes or self.tick % self.config.contact_ticks == 0
            contacts = self._clearance.look(now, publishes=publishes) if looks else None
            if contacts is not None:
                assert self._monitor is not None
                self._monitor.contacts = contacts
                self._publish_changed_status()
        if self._tf_ticks and self.tick % self._tf_ticks == 0:
            self._transforms.publish(now)
        draws = self._markers.draws_anything and self._marker_ticks
        if draws and self.tick % self._marker_ticks == 0:
            plant = self.plant
            target = None if plant.capturing is None else plant.capturing.target_pose
            self._marker_stream.publish(
                self._markers.message(now, plant.pose, plant.link_R, plant.link_r, target)
            )
        if self._report_ticks and self.tick % self._report_ticks == 0:
            self._publish_report()

    def _publish_report(self) -> None:
        self._reported_ns = self._steady.now().nanoseconds
        self._report.publish(self.time_ns)

    def _report_on_wall_clock(self) -> None:
        """Publish diagnostics if none were published for a second of wall time."""
        if self._steady.now().nanoseconds - self._reported_ns >= _REPORT_PERIOD_NS:
            self._publish_report()

    def _ticks_for_viewers(self, seconds: float, longest_wall: float) -> int:
        if self._real_time is not None and seconds:
            seconds = min(seconds, longest_wall * self.config.real_time_factor)
        return self.config.ticks_of(seconds)

    def _on_wall_tick(self) -> None:
        real_time = self._real_time
        assert real_time is not None
        if self._active is not PlantState.RUNNING:
            return
        for _ in range(real_time.due_ticks(self._steady.now().nanoseconds, self.tick)):
            real_time.count_tick(self._steady.now().nanoseconds, self.tick)
            silent = self.commands.drop_old(self.time_ns)
            for source in silent:
                self._report.timed_out(source, self.config.command_timeout)
            if silent:
                self._publish_changed_status()
            self._step()

    def _on_subscriber_check(self) -> None:
        """Publish the last state again to new subscribers, whose command a lockstep plant needs.

        A state without a pose may receive no command: the commander only learns from the next state
        that the pose is missing. The plant steps without one if it waits since the last check.
        """
        if self._active is not PlantState.RUNNING:
            if self._report_ticks:
                self._report_on_wall_clock()
            return  # A new subscriber receives the state after the pause.
        self._check_for_commanders()
        waits, self._looked_at = self._looked_at == self.tick, self.tick
        if (waits and self.reported.sensors.dropout) or self.commands.complete:
            self._step()
        elif waits and self._publisher.has_new_readers():
            self._publisher.publish(self.time_ns, all_topics=True)

    def _on_commander_check(self) -> None:
        self._count_commanders()
        if self.status.reason == "no_command":
            self._publish_changed_status()
        self._report_on_wall_clock()

    def _check_for_commanders(self) -> None:
        self._count_commanders()
        self.commands.require_commanded()

    def _count_commanders(self) -> None:
        for source in self.commands.sources:
            # Publishers are counted by names that are already remapped.
            source.commanders = self.count_publishers(self.resolve_topic_name(source.topic))

    # -- commands -----------------------------------------------------------------------------

    def _on_command(self, topic: str, raw: bytes) -> None:
        if not self._is_running_or_paused:
            return
        if self._undecided:
            self._decide_actuation(topic, raw)
        reader = self._readers.get(topic)
        if reader is None:
            return  # Servos do not accept a wrench.
        refusal = reader.offer(self.commands, raw, self.tick * self._period_ns)
        if refusal is not None:
            self._report.refused(reader.source, refusal)
            if refusal.latches:
                self._publish_changed_status()
        elif self.status.state is PlantState.RESTING:
            self._publish_changed_status()
        if self._real_time is None:
            self._step_if_complete()
        elif reader.source is self.commands.sources[0]:
            now = self._steady.now().nanoseconds
            self._real_time.count_command(now, reader.source.stamp_ns)

    def _step_if_complete(self) -> None:
        if self._active is PlantState.RUNNING and self.commands.complete:
            self._step()

    def _on_injection(self, inject: Callable[[str], None], message: String) -> None:
        try:
            inject(message.data)
        except ParameterError as error:
            self.get_logger().warning(str(error))
            return
        self._publish_changed_status()

    def _on_obstacles(self, message: String) -> None:
        """Use the obstacles in a URDF string for distances and markers from now on."""
        if message.data == self._obstacles:
            return
        try:
            world = obstacles_from_topic(message.data)
        except RobotDescriptionError as refusal:
            kept = "The previous obstacles are kept."
            self.get_logger().error(printable(f"obstacles: {refusal} {kept}"))
            return
        self._obstacles = message.data
        self._markers.use_obstacles(world)
        if self._clearance is not None:
            described = with_world(self.plant.robot.description, world)
            with self.long_work():
                # The plant in MuJoCo has only the initial obstacles.
                links_could_touch = self._clearance.use(described)
            if not links_could_touch and self._monitor is not None and self._monitor.contacts:
                self._monitor.contacts = ()
                self._publish_changed_status()

    def on_silence(self, silence: SilenceReport) -> None:
        """Bring all joints to rest if a commander is silent and the parameters require this."""
        super().on_silence(silence)
        if self.config.watchdog_action == "latch" and not silence.over:
            self.commands.latch("watchdog", f"node '{silence.name}' is silent", self.time_ns)
            self._report.latched()
            self._publish_changed_status()

    # -- services -----------------------------------------------------------------------------

    def _reset(self) -> str:
        self.plant.reset()
        # The initial state has a later stamp than the state before: commands for that state, which
        # may be on their way, are stale.
        self.tick += 1
        self.plant.start_at(self.tick)
        self.commands.reset(self.time_ns)
        assert self._monitor is not None
        self._monitor.resets += 1
        # Commanders must know about the reset before they answer later states.
        self._publish_changed_status()
        if self._is_running_or_paused:
            self._publish()
        return "The robot is back in its initial state; time continues."

    def _abort(self) -> str:
        self.commands.latch("abort", "stopped on request", self.time_ns)
        self._report.latched()
        self._publish_changed_status()
        return f"{latched_text('stopped on request')}."

    def _rearm(self) -> str:
        fault = self.commands.rearm()
        if not fault:
            return "No fault was latched."
        assert self._monitor is not None
        self._monitor.rearms += 1
        self._publish_changed_status()
        return f"Commands are accepted again after: {fault}."

    def _grasp(self, act: Callable[[CapturePlant], Event]) -> str:
        """Capture or release the target; it takes effect in the next tick."""
        if self._capturing is None:
            raise CommandError("There is no target: set parameter 'target.robot' to its URDF.")
        if not self._is_running_or_paused:
            raise CommandError(f"The plant is {self._active.value}: nothing moves.")
        if self.commands.fault:
            raise CommandError(f"A fault is latched: {self.commands.fault}; rearm the plant first.")
        event = act(self._capturing)
        self._publish_changed_status()
        return event.message

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._when_active = PlantState.PAUSED if request.data else PlantState.RUNNING
        before = self._active
        if self._is_running_or_paused:
            self._active = self._when_active
        self._publish_changed_status()
        if (before, self._active) == (PlantState.PAUSED, PlantState.RUNNING):
            if self._real_time is None:
                self._step_if_complete()
            else:
                self._real_time.start(self._steady.now().nanoseconds, self.tick)
        response.success = True
        response.message = self._when_active.value
        return response


def _resumed_plant(
    robot: SpaceRobot,
    config: PlantConfig,
    initial: InitialState,
    target: BodyMotion | None = None,
    payload: Payload | None = None,
) -> PlantWithFaults:
    if config.actuation == "velocity":
        # Servos hold their commanded rates; only motors leave joints moving.
        initial = replace(initial, joint_velocities=None)
    if target is None:
        return build_plant(robot, config, initial)
    plant = build_plant(robot, config)
    assert plant.capturing is not None
    plant.capturing.resume(initial, payload, target)
    return plant


main = partial(run_node, PlantNode)
"""Run the plant until SIGINT or SIGTERM."""

if __name__ == "__main__":
    sys.exit(main())
