"""What a planner flies: a schedule, and the command that it gives for every state."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.nodes.common.cdr import stamp_bytes
from spacerobot_ros.nodes.common.joint_command import JointCommand
from spacerobot_ros.planning import GaitSchedule, RobotState
from spacerobot_ros.planning.execution.braking import BrakingFollower
from spacerobot_ros.planning.execution.follower import GaitFollower
from spacerobot_ros.planning.execution.path_deviation import DriftWatch
from spacerobot_ros.planning.execution.stuck_joints import StuckJointWatch

ANSWERED = "{:d} commands were published."
"""What a planner logs when it is deactivated."""


class GaitFlight:
    """Follows one schedule after the other, and holds the shape in between.

    Parameters
    ----------
    robot
        Whose joints are commanded.
    parameters
        Of the planner node.
    tick_period
        s.
    """

    def __init__(
        self, robot: SpaceRobot, parameters: Mapping[str, Any], tick_period: float
    ) -> None:
        self.stuck: list[int] = []
        """Joints that do not follow, and are commanded no more."""
        self.answers = 0
        """How many states were answered with a command."""
        self._values = parameters
        # A controller closes its own loop round the reference.
        self._commands_plant = parameters["output"] == "commands"
        self._command = JointCommand(robot.joint_names)
        self._follower: GaitFollower | BrakingFollower | None = None
        self._held: Array | None = None
        band = 2 * parameters["shape_deadband"]
        self._watch = StuckJointWatch(robot.n, parameters["stuck_ticks"], tick_period, band)

    @property
    def flying(self) -> bool:
        """Whether there is a schedule in the air, or one that comes to rest."""
        return self._follower is not None

    def begin(self, schedule: GaitSchedule, stamp_ns: int) -> None:
        """Fly a schedule from now on."""
        values = self._values
        gain = values["shape_gain"] if self._commands_plant else 0.0
        self._follower = GaitFollower(schedule, stamp_ns, gain, values["shape_deadband"])
        self._drift = DriftWatch(
            schedule, stamp_ns, values["drift_position"], values["drift_attitude"]
        )
        self._watch.restart()

    def coming_to_rest(self, stamp_ns: int) -> BrakingFollower | None:
        """Return what is flown as it would come to rest from now on, None where nothing is."""
        if isinstance(self._follower, GaitFollower):
            return self._follower.braking(stamp_ns, self._values["abort_time"])
        return self._follower

    def break_off(self, stamp_ns: int) -> None:
        """Come to rest along the gait."""
        self._follower = self.coming_to_rest(stamp_ns)

    def ended(self, stamp_ns: int, q: Array) -> bool:
        """Whether what is flown is over."""
        return self._follower is not None and self._follower.ended(stamp_ns, q)

    def end(self, *, at_last_shape: bool) -> GaitSchedule | None:
        """Fly no more; hold the schedule's last shape, or the one that is measured next.

        Returns the schedule that was flown.
        """
        if self._follower is None:
            return None
        braked = isinstance(self._follower, BrakingFollower)
        schedule, self._follower = self._follower.schedule, None
        self._held = schedule.positions[-1] if at_last_shape and not braked else None
        return schedule

    def drop(self) -> None:
        """Forget what is flown and held."""
        self._follower = self._held = None

    def drift_due(self, stamp_ns: int) -> bool:
        """Whether the pose at this time is to be compared with the predicted one."""
        return isinstance(self._follower, GaitFollower) and self._drift.due(stamp_ns)

    def drifted(self, state: RobotState) -> str:
        """Say how far a state that was due is off its path; empty if it is near enough."""
        distance, angle = self._drift.off(state.position, state.quaternion)
        if not self._drift.too_far(distance, angle):
            return ""
        return f"Off the path by {distance:.3g} m and {angle:.3g} rad"

    def follow(self, stamp_ns: int, q: Array) -> list[int]:
        """Set the command of a flight for the state now; return what joints are found stuck."""
        if self._follower is None:
            return []
        position, velocity = self._command.position, self._command.velocity
        self._follower.command(stamp_ns, q, position, velocity)
        self._held = None
        if self.stuck:
            velocity[self.stuck] = 0.0
        return self._watch.look(q, position, velocity)

    def answer(self, stamp_ns: int, q: Array) -> bytes:
        """Return the serialised command for the state now, after :meth:`follow`."""
        if self._follower is None:
            # A reference must stay where it is; what the plant makes of rest is its affair.
            if self._held is None or self._commands_plant:
                self._held = q.copy()
            self._command.position[:] = self._held
            self._command.velocity[:] = 0.0
        self.answers += 1
        return self._command.serialised(stamp_bytes(stamp_ns))
