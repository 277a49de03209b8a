"""The plant node: a free-floating robot behind ROS topics."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any, ClassVar

from rclpy.clock import Clock, ClockType
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.model.robot_source import robot_of
from spacerobot_ros.nodes.common.cdr import NANOSECONDS
from spacerobot_ros.nodes.common.node import LATCHED, STREAM, FlightNode, run_node
from spacerobot_ros.nodes.plant.actuation import CHANNELS
from spacerobot_ros.nodes.plant.command_channel import CommandChannel
from spacerobot_ros.nodes.plant.command_gate import CommandGate
from spacerobot_ros.nodes.plant.command_intake import CommandIntake
from spacerobot_ros.nodes.plant.deadlines import Deadlines
from spacerobot_ros.nodes.plant.diagnostics import PlantReport
from spacerobot_ros.nodes.plant.plant_topics import PlantTopics
from spacerobot_ros.nodes.plant.resumption import resumed
from spacerobot_ros.nodes.plant.thruster_topics import ThrusterTopics
from spacerobot_ros.simulation.brakes import JointBrakes
from spacerobot_ros.simulation.building import PLANTS, build_plant, period_ns
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.sensors import SensorModel, Sensors
from spacerobot_ros.simulation.thrusters import thrusters_in

_LATE_JOINER_CHECK = 0.1
"""How often a waiting lockstep plant looks for new subscribers, wall s."""

_LONGEST_LAG = 10
"""Ticks that a real-time plant may be late and still make up; what is beyond is lost for good."""

_CATCH_UP = 2
"""Ticks that a late plant takes at once: commands must get a word in between."""


class PlantNode(FlightNode):
    """Integrates the momentum-conserving model and publishes what a real robot would.

    In ``lockstep`` it publishes the state of tick k and steps when the command stamped with that
    tick is there. In ``realtime`` it runs on the wall clock times ``real_time_factor``, holds the
    last command, and brings the joints to rest when that is older than ``command_timeout``.
    """

    Config: ClassVar = PlantConfig

    def __init__(self, name: str = "plant", **kwargs: Any) -> None:
        self._running = self._paused = False
        self._tick = 0
        super().__init__(name, **kwargs)

    @property
    def tick(self) -> int:
        """The tick whose state was published last."""
        return self._tick

    @property
    def time_ns(self) -> int:
        """Simulated time of that tick, ns."""
        return self._tick * self._period_ns

    # -- life ---------------------------------------------------------------------------------

    def configure(self) -> None:
        """Build the plant and its topics; nothing is published yet."""
        values: dict[str, Any] = self.parameters
        robot = robot_of(self.config)
        if robot is None:
            raise ParameterError(
                "The plant needs a robot: set parameter 'robot' to a URDF file or the name of a "
                "robot of this package, or 'robot_description' to a URDF text."
            )
        self._lockstep = values["time_mode"] == "lockstep"
        self._period_ns = period_ns(values["tick_rate"])
        initial, tick = resumed(values, self.get_namespace(), robot)
        self.plant = build_plant(robot, values, initial)
        self._tick = self.plant.tick = tick
        self._looked_at = -1
        self._sensors = Sensors(self.plant, SensorModel.of(values), self._period_ns / NANOSECONDS)
        self._topics = PlantTopics(
            self,
            self.plant,
            self._sensors,
            values["world_frame"],
            values["end_effector_frame"],
            thrusters=PLANTS[values["actuation"]].thrusters,
        )
        self._gate = CommandGate(values["latched_faults"])
        self._report = PlantReport(self, self.plant, self._gate)
        thrusters = thrusters_in(self.plant)
        self._thrusters = ThrusterTopics(self, thrusters) if thrusters is not None else None
        if self._thrusters is not None:
            self._report.others.append(self._thrusters.status)
        self._intake = CommandIntake(
            self, CHANNELS[values["actuation"]](robot), self._gate, self._report, values
        )
        self._deadlines: Deadlines | None = None
        if not self._lockstep:
            self._pace_ns = self._period_ns / values["real_time_factor"]
            name = f"{self.get_fully_qualified_name()}: timing"
            self._deadlines = Deadlines(name, self._pace_ns)
            self._report.others.append(self._deadlines.status)
        # Velocity servos stop at once; motors have to be told how.
        self._brakes = None
        if values["actuation"] == "effort":
            self._brakes = JointBrakes(self.plant, self._period_ns / NANOSECONDS)
        self._pose_ticks = self._ticks(values["base_pose_period"]) or 1
        self._marker_ticks = self._ticks(values["marker_period"])
        self._report_ticks = self._ticks(values["diagnostics_period"])
        self._description = self.create_publisher(String, "robot_description", LATCHED)
        for channel in self._intake.channels:
            self.take_raw(channel.message_type, channel.topic, partial(self._on_command, channel))
        self.create_subscription(String, "fault_injection", self._on_fault, STREAM)
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(Trigger, "~/abort", self._on_abort)
        self.create_service(Trigger, "~/rearm", self._on_rearm)

    def activate(self) -> None:
        """Publish the robot and its present state, and from now on step."""
        self._running = True
        self._description.publish(String(data=self.plant.robot.description.urdf))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        if self._lockstep:
            self._look_round()
            self._own_timers = [
                self.create_timer(_LATE_JOINER_CHECK, self._on_late_joiner_check, clock=steady)
            ]
        else:
            self._steady = steady
            self._origin_ns = steady.now().nanoseconds - self._tick * self._pace_ns
            self._own_timers = [
                self.create_timer(self._pace_ns / NANOSECONDS, self._on_wall_tick, clock=steady),
                self.create_timer(_LATE_JOINER_CHECK, self._intake.count_commanders, clock=steady),
            ]
        self._publish()

    def deactivate(self) -> None:
        """Stop time; nothing is commanded when it goes on."""
        if self._running:
            for timer in self._own_timers:
                self.destroy_timer(timer)
        self._running = False
        self._intake.rest()

    # -- time ---------------------------------------------------------------------------------

    def _step(self) -> None:
        commands = self._intake.begin_step()
        if self._brakes is not None and self._intake.joints_rest:
            commands[0][:] = self._brakes.efforts()
        try:
            limited = self.plant.step(*commands)
        except SpaceRobotError as error:
            self.get_logger().error(f"The plant stops at {self.time_ns / NANOSECONDS:g} s: {error}")
            self.trigger_deactivate()
            return
        if limited:
            self._report.limited()
        self._tick += 1
        self._publish()

    def _publish(self) -> None:
        now = self._tick * self._period_ns
        self._sensors.measure()
        self._topics.publish(now, with_pose=self._tick % self._pose_ticks == 0)
        if self._thrusters is not None:
            self._thrusters.publish(now)
        if self._marker_ticks and self._tick % self._marker_ticks == 0:
            self._topics.publish_markers(now)
        if self._report_ticks and self._tick % self._report_ticks == 0:
            self._report.publish(now)

    def _ticks(self, seconds: float) -> int:
        return max(1, round(seconds * NANOSECONDS / self._period_ns)) if seconds else 0

    def _on_wall_tick(self) -> None:
        if not self._running or self._paused:
            return
        now = self._steady.now().nanoseconds
        behind = int((now - self._origin_ns) / self._pace_ns) - self._tick
        if behind > _LONGEST_LAG:
            self._report.deadlines_missed += behind - _LONGEST_LAG
            self._origin_ns += (behind - _LONGEST_LAG) * self._pace_ns
        for _ in range(min(behind, _CATCH_UP)):
            assert self._deadlines is not None
            now = self._steady.now().nanoseconds
            due = self._origin_ns + (self._tick + 1) * self._pace_ns
            self._deadlines.tick(now, due, self.time_ns)
            self._intake.drop_old(self.time_ns)
            self._step()

    def _on_late_joiner_check(self) -> None:
        """A lockstep plant waits for ever if nobody saw its last state: show it to newcomers."""
        if self._paused:
            return  # Who comes now is shown the state after the pause.
        before = self._readers
        self._look_round()
        if self._readers > before:
            self._topics.publish(self.time_ns, with_pose=True)
        waited, self._looked_at = self._looked_at == self._tick, self._tick
        if waited and self._sensors.dropout:
            # Who needs odom cannot know that none comes before another state does.
            self._step()
        else:
            self._step_if_complete()

    def _look_round(self) -> None:
        """See who listens and who commands."""
        self._readers = self._topics.readers()
        self._intake.look_round()

    # -- commands -----------------------------------------------------------------------------

    def _on_command(self, channel: CommandChannel, raw: bytes) -> None:
        if not self._running:
            return
        if self._intake.accept(channel, raw, self.time_ns):
            self._step_if_complete()
        elif self._deadlines is not None and channel is self._intake.channels[0]:
            now = self._steady.now().nanoseconds
            due = self._origin_ns + channel.stamp_ns * self._pace_ns / self._period_ns
            self._deadlines.answer(now, due, channel.stamp_ns)

    def _step_if_complete(self) -> None:
        if not self._paused and self._intake.complete:
            self._step()

    def _on_fault(self, message: String) -> None:
        """Inject the faults of a message, one a line, or repair everything: "clear"."""
        try:
            self.plant.inject(message.data)
        except ParameterError as error:
            self.get_logger().warning(str(error))

    # -- services -----------------------------------------------------------------------------

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.plant.reset()
        self._intake.rest()
        response.success = True
        response.message = "The robot is back in its initial state; time goes on."
        if self._running:
            self._publish()
        return response

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._intake.latch("aborted on request")
        response.success = True
        response.message = "The joints come to rest; nothing moves until '~/rearm' is called."
        return response

    def _on_rearm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        fault = self._gate.fault
        self._gate.rearm()
        response.success = True
        response.message = (
            f"Commands pass again after: {fault}." if fault else "No fault was latched."
        )
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        resumed = self._paused and not request.data
        self._paused = bool(request.data)
        if resumed and self._running:
            if self._lockstep:
                self._step_if_complete()
            else:
                self._origin_ns = self._steady.now().nanoseconds - self._tick * self._pace_ns
        response.success = True
        response.message = "paused" if self._paused else "running"
        return response


def main() -> None:
    """Run the plant until SIGINT or SIGTERM."""
    sys.exit(run_node(PlantNode))


if __name__ == "__main__":
    main()
