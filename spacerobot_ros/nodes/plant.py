"""The plant node: a free-floating robot behind ROS topics."""

from __future__ import annotations

import sys
from functools import partial
from typing import Any, ClassVar

import numpy as np
from rclpy.clock import Clock, ClockType
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from spacerobot_ros.errors import ParameterError, SpaceRobotError
from spacerobot_ros.nodes.actuation import ACTUATIONS
from spacerobot_ros.nodes.cdr import NANOSECONDS
from spacerobot_ros.nodes.command_channel import NEVER, CommandChannel
from spacerobot_ros.nodes.flight_node import LATCHED, STREAM, FlightNode, run_node
from spacerobot_ros.nodes.parameters import ParameterSpec
from spacerobot_ros.nodes.plant_report import PlantReport
from spacerobot_ros.nodes.plant_topics import PlantTopics
from spacerobot_ros.nodes.robot_source import ROBOT_SPECS, robot_of
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.plant import Plant

_LATE_JOINER_CHECK = 0.1
"""How often a waiting lockstep plant looks for new subscribers, wall s."""

_SHORTEST_STEP = 1e-5
"""Shorter Runge-Kutta steps lose more to rounding than they gain, s."""

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

    SPECS: ClassVar = (
        *ROBOT_SPECS,
        ParameterSpec(
            "actuation", "velocity", "", "what joint_commands carry", choices=tuple(ACTUATIONS)
        ),
        ParameterSpec(
            "time_mode", "realtime", "", "who drives time", choices=("realtime", "lockstep")
        ),
        ParameterSpec("tick_rate", 20.0, "Hz", "ticks a second of simulated time", 1e-3, 1e5),
        ParameterSpec("real_time_factor", 1.0, "", "simulated over wall time", 1e-3, 1e3),
        ParameterSpec(
            "command_timeout", 0.5, "s", "realtime: older commands stop the joints; 0: never", 0.0
        ),
        ParameterSpec(
            "integration_step", 0.0, "s", "longest step; 0: 0.01 (velocity), 0.001 (effort)", 0.0
        ),
        ParameterSpec("world_frame", "world", "", "name of the inertial frame"),
        ParameterSpec(
            "end_effector_frame", "", "", "link of end_effector_pose; '': 'end_effector', if any"
        ),
        ParameterSpec(
            "base_pose_period", 0.0, "s", "simulated time between base_pose; 0: every tick", 0.0
        ),
        ParameterSpec("marker_period", 0.5, "s", "simulated time between markers; 0: none", 0.0),
        ParameterSpec(
            "diagnostics_period", 1.0, "s", "simulated time between diagnostics; 0: none", 0.0
        ),
        ParameterSpec("initial_position", [0.0, 0.0, 0.0], "m", "base link in the world", length=3),
        ParameterSpec(
            "initial_orientation", [0.0, 0.0, 0.0, 1.0], "", "quaternion x, y, z, w", length=4
        ),
        ParameterSpec(
            "initial_joint_positions", [], "m or rad", "by joint order of the URDF; []: zero"
        ),
        ParameterSpec(
            "initial_joint_velocities", [], "m/s or rad/s", "likewise, under efforts; []: zero"
        ),
        ParameterSpec(
            "initial_center_of_mass",
            [],
            "m",
            "of the system in the world, instead of initial_position",
            length=3,
        ),
        ParameterSpec("linear_momentum", [0.0, 0.0, 0.0], "kg m/s", "total, in world", length=3),
        ParameterSpec(
            "angular_momentum",
            [0.0, 0.0, 0.0],
            "kg m^2/s",
            "total, about the centre of mass, in world",
            length=3,
        ),
    )

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
        robot = robot_of(values)
        if robot is None:
            raise ParameterError(
                "The plant needs a robot: set parameter 'robot' to a URDF file or the name of a "
                "robot of this package, or 'robot_description' to a URDF text."
            )
        self._lockstep = values["time_mode"] == "lockstep"
        self._period_ns = round(NANOSECONDS / values["tick_rate"])
        actuation = ACTUATIONS[values["actuation"]]
        if 0.0 < values["integration_step"] < _SHORTEST_STEP:
            raise ParameterError(
                f"Parameter 'integration_step' is {values['integration_step']}; it must be 0 (by "
                f"the actuation) or at least {_SHORTEST_STEP:g} s."
            )
        self.plant: Plant = actuation.plant(
            robot,
            self._period_ns / NANOSECONDS,
            self._initial_state(),
            values["integration_step"] or actuation.integration_step,
        )
        self._tick = 0
        self._channels = actuation.channels(robot)
        self._commands = [channel.command for channel in self._channels]
        self._topics = PlantTopics(
            self,
            self.plant,
            values["world_frame"],
            values["end_effector_frame"],
            thrusters=actuation.thrusters,
        )
        self._report = PlantReport(self, self.plant)
        self._pose_ticks = self._ticks(values["base_pose_period"]) or 1
        self._marker_ticks = self._ticks(values["marker_period"])
        self._report_ticks = self._ticks(values["diagnostics_period"])
        self._description = self.create_publisher(String, "robot_description", LATCHED)
        for channel in self._channels:
            self.create_subscription(
                channel.message_type,
                channel.topic,
                partial(self._on_command, channel),
                STREAM,
                raw=True,
            )
        self.create_service(Trigger, "~/reset", self._on_reset)
        self.create_service(SetBool, "~/pause", self._on_pause)

    def _initial_state(self) -> InitialState:
        values: dict[str, Any] = self.parameters

        def optional(name: str) -> Any:
            return np.array(values[name]) if values[name] else None

        return InitialState(
            position=np.array(values["initial_position"]),
            quaternion=np.array(values["initial_orientation"]),
            joint_positions=optional("initial_joint_positions"),
            linear_momentum=np.array(values["linear_momentum"]),
            angular_momentum=np.array(values["angular_momentum"]),
            joint_velocities=optional("initial_joint_velocities"),
            center_of_mass=optional("initial_center_of_mass"),
        )

    def activate(self) -> None:
        """Publish the robot and its present state, and from now on step."""
        self._running = True
        self._description.publish(String(data=self.plant.robot.description.urdf))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        if self._lockstep:
            self._look_round()
            self._timer = self.create_timer(
                _LATE_JOINER_CHECK, self._on_late_joiner_check, clock=steady
            )
        else:
            pace = self._period_ns / float(self.parameters["real_time_factor"])  # type: ignore[arg-type]
            self._pace_ns, self._steady = pace, steady
            self._origin_ns = steady.now().nanoseconds - self._tick * pace
            self._timer = self.create_timer(pace / NANOSECONDS, self._on_wall_tick, clock=steady)
        self._publish()

    def deactivate(self) -> None:
        """Stop time; nothing is commanded when it goes on."""
        if self._running:
            self.destroy_timer(self._timer)
        self._running = False
        self._rest()

    # -- time ---------------------------------------------------------------------------------

    def _step(self) -> None:
        for channel in self._channels:
            channel.arrived = False
        try:
            limited = self.plant.step(*self._commands)
        except SpaceRobotError as error:
            self.get_logger().error(f"The plant stops at {self.time_ns / NANOSECONDS:g} s: {error}")
            self.trigger_deactivate()
            return
        if limited:
            self._report.limited()
        self._tick += 1
        self._publish()

    def _rest(self) -> None:
        for channel in self._channels:
            channel.rest()
            channel.arrived = False

    def _publish(self) -> None:
        now = self._tick * self._period_ns
        self._topics.publish(now, with_pose=self._tick % self._pose_ticks == 0)
        if self._marker_ticks and self._tick % self._marker_ticks == 0:
            self._topics.publish_markers(now)
        if self._report_ticks and self._tick % self._report_ticks == 0:
            self._report.publish(now)

    def _ticks(self, seconds: float) -> int:
        return max(1, round(seconds * NANOSECONDS / self._period_ns)) if seconds else 0

    def _on_wall_tick(self) -> None:
        if not self._running or self._paused:
            return
        due = int((self._steady.now().nanoseconds - self._origin_ns) / self._pace_ns) - self._tick
        if due > _LONGEST_LAG:
            self._report.deadlines_missed += due - _LONGEST_LAG
            self._origin_ns += (due - _LONGEST_LAG) * self._pace_ns
        for _ in range(min(due, _CATCH_UP)):
            self._drop_old_commands()
            self._step()

    def _drop_old_commands(self) -> None:
        """Bring to rest what nobody has commanded for the timeout."""
        timeout = float(self.parameters["command_timeout"])  # type: ignore[arg-type]
        for channel in self._channels:
            age = self._tick * self._period_ns - channel.stamp_ns
            if timeout and NEVER != channel.stamp_ns and age > timeout * NANOSECONDS:
                channel.rest()
                self._report.timed_out(channel.topic, timeout)

    def _on_late_joiner_check(self) -> None:
        """A lockstep plant waits for ever if nobody saw its last state: show it to newcomers."""
        if self._paused:
            return  # Who comes now is shown the state after the pause.
        before = self._readers
        self._look_round()
        if self._readers > before:
            self._topics.publish(self.time_ns, with_pose=True)
        self._step_if_complete()

    def _look_round(self) -> None:
        """See who listens and who commands; the joints are waited for, a wrench if one comes."""
        self._readers = self._topics.readers()
        for channel in self._channels[1:]:
            channel.required = self.count_publishers(channel.topic) > 0
            if not channel.required:
                # Nobody is left who could turn the thrusters off.
                channel.rest()
                channel.arrived = False

    # -- commands -----------------------------------------------------------------------------

    def _on_command(self, channel: CommandChannel, raw: bytes) -> None:
        if not self._running:
            return
        stamp, problem = channel.check(raw)
        if self._lockstep:
            self._on_lockstep_command(channel, stamp, problem)
        else:
            self._on_realtime_command(channel, stamp, problem)

    def _on_lockstep_command(self, channel: CommandChannel, stamp: int, problem: str) -> None:
        now = self._tick * self._period_ns
        if stamp != now or channel.arrived:
            kind = "stale" if stamp <= now else "ahead of time"
            self._report.refused(
                channel.topic,
                f"it is {kind}: stamped {stamp / NANOSECONDS:.9g} s, the plant is at "
                f"{now / NANOSECONDS:.9g} s",
            )
            return
        if problem:
            # Time must go on for the others: a bad command is a tick at rest.
            self._report.refused(channel.topic, problem)
            channel.rest()
        else:
            channel.take(stamp)
        self._step_if_complete()

    def _step_if_complete(self) -> None:
        if self._paused:
            return
        for channel in self._channels:
            if channel.required and not channel.arrived:
                return
        self._step()

    def _on_realtime_command(self, channel: CommandChannel, stamp: int, problem: str) -> None:
        now = self._tick * self._period_ns
        timeout = float(self.parameters["command_timeout"])  # type: ignore[arg-type]
        stamp = stamp or now  # An unset stamp means now, as everywhere in ROS.
        age = (now - stamp) / NANOSECONDS
        if timeout and abs(age) > timeout:
            problem = f"it is {abs(age):.3g} s {'old' if age > 0 else 'ahead of time'}"
        if problem:
            self._report.refused(channel.topic, problem)
            return
        channel.take(stamp)

    # -- services -----------------------------------------------------------------------------

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.plant.reset()
        self._rest()
        response.success = True
        response.message = "The robot is back in its initial state; time goes on."
        if self._running:
            self._publish()
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
