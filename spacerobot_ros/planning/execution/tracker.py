"""Schedule tracking: computes the setpoint at every tick from a schedule and the measured shape.

Joints that do not follow their commands are detected.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.goal import RobotState, Tolerance
from spacerobot_ros.planning.core.method import InitialMotion
from spacerobot_ros.planning.core.schedule import GaitSchedule, interpolated
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.execution.measured_states import (
    MassEstimate,
    PathCheck,
    PathSensitivity,
)
from spacerobot_ros.times import SECOND

_END_TOLERANCE, _END_SHARE = 1e-6, 0.05
"""Joint errors at which a schedule has ended: m or rad, or a fraction of the goal's tolerance if
that is more and no controller follows: after a late command, they decay with ``shape_gain``."""

_MAX_SETTLING_TIME = 5.0  # s


@dataclass(frozen=True)
class Setpoint:
    """Joint command; the tracker changes the arrays in place.

    ``position`` (n,) is the current desired shape, m or rad; ``velocity`` (n,) is held until the
    next tick, m/s or rad/s.
    """

    position: Array
    velocity: Array


@dataclass(frozen=True)
class TakeOver:
    """The tick of a schedule at which another schedule takes over.

    Attributes
    ----------
    stamp_ns
        Its stamp, ns.
    shapes
        (K + 1, n) shapes from the current tick to the takeover tick, m or rad.
    motion
        Joint motion at the takeover tick.
    """

    stamp_ns: int
    shapes: Array
    motion: InitialMotion


class ScheduleFollower:
    """Follows a schedule by time stamps, so that a missed tick does not delay later ticks.

    Parameters
    ----------
    schedule
        The schedule to follow.
    start_ns
        Stamp of the schedule's first tick, ns.
    shape_gain
        Feedback gain from shape error to velocity, 1/s.
    deadband
        Shape errors up to this value are treated as noise and not fed back, m or rad.
    end_error
        Shape error up to which the final shape counts as reached, m or rad.
    brakes
        Whether the schedule brakes along another one; its end does not wait for the joints.
    """

    def __init__(
        self,
        schedule: GaitSchedule,
        start_ns: int,
        shape_gain: float,
        deadband: float = 0.0,
        *,
        end_error: float = _END_TOLERANCE,
        brakes: bool = False,
    ) -> None:
        self.schedule, self.brakes = schedule, brakes
        self._settling_ns = 0 if brakes else round(_MAX_SETTLING_TIME * SECOND)
        self.start_ns = start_ns
        self._period_ns = round(schedule.control_period * SECOND)
        self._end_ns = start_ns + schedule.ticks * self._period_ns
        self.gain = min(shape_gain, 1.0 / schedule.control_period)
        self._positions = schedule.positions
        # The joints rest after the last tick, and wheels keep their rates. The part of the
        # feedback known beforehand is added here: qdot = qdot_k + gain (q_k - q), and only q is
        # measured.
        self._after = np.zeros(len(schedule.joint_names))
        if schedule.end_velocities is not None:
            self._after = schedule.end_velocities
        velocities = np.vstack([schedule.velocities, self._after])
        self._feedforward = velocities + self.gain * self._positions
        self._velocities, self._deadband = velocities, deadband
        self._end_error = max(end_error, deadband)

    def has_ended(self, stamp_ns: int, q: Array) -> bool:
        """Whether the schedule is over and the shape ``q`` (n,) has reached its final shape."""
        late = stamp_ns - self._end_ns
        if late < 0:
            return False
        last = self._positions[-1] + late / SECOND * self._after
        far = np.abs(last - q).max(initial=0.0) > self._end_error
        return not far or self.brakes or self.is_overdue(stamp_ns)

    def is_overdue(self, stamp_ns: int) -> bool:
        """Whether the schedule has been over for longer than any settling time."""
        return stamp_ns - self._end_ns > self._settling_ns

    def covers(self, stamp_ns: int) -> bool:
        """Whether a given time is within the schedule or the settling time after it."""
        return self.start_ns <= stamp_ns <= self._end_ns + self._settling_ns

    def braking(self, stamp_ns: int, duration: float) -> ScheduleFollower:
        """Return the follower that brakes along the schedule from a time on, within T seconds.

        Gait time runs at the rate ``1 - t/T``: the shape stays on the path of the gait. At zero
        momentum, the base path does not depend on speed, so the base also stays on its path. Wheels
        that keep spinning are brought to their final rates, at which the base rests at its goal.
        """
        schedule, last = self.schedule, self.schedule.ticks
        period, begins = schedule.control_period, (stamp_ns - self.start_ns) / SECOND
        since = period * np.arange(max(1, math.ceil(duration / period - 1e-9)) + 1, dtype=float)
        tau = np.minimum(since / duration, 1.0)
        ticks = (begins + duration * (tau - tau**2 / 2)) / period
        shapes = interpolated(ticks, np.arange(last + 1.0), schedule.positions)
        end = schedule.end_velocities
        if end is not None:
            # From the initial to the final rate, linearly.
            first = schedule.velocities[np.clip(int(ticks[0]), 0, last - 1)]
            t = np.minimum(since, duration)[:, np.newaxis]
            turned = shapes[0] + t * first + t**2 / (2 * duration) * (end - first)
            turned += (since[:, np.newaxis] - t) * end
            shapes = np.where(end != 0, turned, shapes)
        along = replace(schedule, positions=shapes)
        return ScheduleFollower(along, stamp_ns, self.gain, brakes=True)

    def shapes_from(self, stamp_ns: int) -> Array:
        """Return the shapes at the ticks from a time to the end, at least two."""
        tick = (stamp_ns - self.start_ns) // self._period_ns
        return self._positions[min(max(tick, 0), self.schedule.ticks - 1) :].copy()

    def take_over(self, stamp_ns: int, after: float) -> TakeOver | None:
        """Return the first tick at least ``after`` s from now; None if no tick is left."""
        now = max((stamp_ns - self.start_ns) // self._period_ns, 0)
        tick = now + max(1, math.ceil(after / self.schedule.control_period - 1e-9))
        if tick >= self.schedule.ticks:
            return None
        positions = self._positions
        motion = InitialMotion(self.schedule.velocities[tick - 1], positions[tick:])
        shapes = positions[now : tick + 1].copy()
        return TakeOver(self.start_ns + tick * self._period_ns, shapes, motion)

    def command(self, stamp_ns: int, q: Array, position: Array, velocity: Array) -> None:
        """Write the current desired shape (n,) and the velocities to hold from now on (n,)."""
        k = (stamp_ns - self.start_ns) // self._period_ns
        k = 0 if k < 0 else min(k, self.schedule.ticks)
        position[:] = self._positions[k]
        late = stamp_ns - self._end_ns
        if late > 0:
            position += late / SECOND * self._after
        if self._deadband:
            error = position - q
            error -= np.clip(error, -self._deadband, self._deadband)
            velocity[:] = self._velocities[k] + self.gain * error
            return
        np.multiply(q, -self.gain, out=velocity)
        velocity += self._feedforward[k]
        if late > 0:
            velocity += self.gain * (late / SECOND) * self._after


class TrajectoryTracker:
    """Tracks successive schedules, and holds the shape between them."""

    def __init__(self, robot: SpaceRobot, config: PlannerConfig) -> None:
        self.setpoint = Setpoint(np.zeros(robot.n), np.zeros(robot.n))
        self.stuck: list[int] = []
        """Stuck joints; their commands are zero."""
        self._config = config
        # No feedback here: a controller closes its own loop around the reference.
        self._commands_plant = config.output != "reference"
        self._ends_by_result = config.output == "trajectory"
        """Whether the robot's own controller executes schedules and reports when they end."""
        self._has_result = False
        self._follower: ScheduleFollower | None = None
        self._holds_position = False
        """Whether the setpoint position is the shape to hold."""
        self._wheels = ReactionWheels.of(robot.description).index
        self._spins = False
        """Whether the wheel velocities in the setpoint are to be kept."""
        self.use_robot(robot)
        band = 2 * config.shape_deadband
        self._stuck_watch = StuckJointWatch(
            # The robot's own controller detects joints that do not follow.
            robot.n,
            0 if self._ends_by_result else config.stuck_ticks,
            config.control_period,
            band,
        )

    def use_robot(self, robot: SpaceRobot) -> None:
        """Track subsequent schedules for a robot with the same joints but different masses."""
        self._robot = robot
        self._mass_estimate = MassEstimate(PathSensitivity(robot).count)

    @property
    def is_active(self) -> bool:
        """Whether the tracker follows a schedule or brakes along its path."""
        return self._follower is not None

    @property
    def is_braking(self) -> bool:
        """Whether the joints are braking along the path of a schedule."""
        return self._follower is not None and self._follower.brakes

    def start(
        self,
        schedule: GaitSchedule,
        stamp_ns: int,
        average: int = 0,
        tolerance: Tolerance | None = None,
    ) -> None:
        """Track a schedule whose first tick has this stamp, to a goal with a tolerance.

        ``average`` measured poses are averaged for plans that begin in motion; 0: none.
        """
        config, self._has_result = self._config, False
        gain, end_error = config.shape_gain if self._commands_plant else 0.0, _END_TOLERANCE
        if tolerance is not None and self._commands_plant:
            least = min(tolerance.position, tolerance.attitude, tolerance.shape)
            end_error = max(end_error, _END_SHARE * least)
        self._follower = ScheduleFollower(
            schedule, stamp_ns, gain, config.shape_deadband, end_error=end_error
        )
        self.path_check = PathCheck(
            self._robot, schedule, stamp_ns, config, average, self._mass_estimate
        )
        self._stuck_watch.restart()

    def brake(self, stamp_ns: int) -> None:
        """Brake along the planned path from now on."""
        self._follower = self._begin_braking(stamp_ns)

    def braking(self, stamp_ns: int, state: RobotState) -> tuple[Array | None, Array | None]:
        """Return the shapes (N + 1, n) that the joints would have at the ticks if braking started
        now, None at rest, and the velocities (n,) held afterwards, None if they are zero.

        At rest, these are the wheel velocities in the measured ``state``.
        """
        follower = self._begin_braking(stamp_ns)
        if follower is not None:
            return follower.shapes_from(stamp_ns), follower.schedule.end_velocities
        if not len(self._wheels) or state.qdot is None:
            return None, None
        rates = np.zeros(len(state.q))
        rates[self._wheels] = state.qdot[self._wheels]
        return None, rates

    def _begin_braking(self, stamp_ns: int) -> ScheduleFollower | None:
        if self._follower is None or self._follower.brakes:
            return self._follower
        return self._follower.braking(stamp_ns, self._config.abort_time)

    def take_over(self, stamp_ns: int, q: Array, after: float) -> TakeOver | None:
        """Return the earliest tick, at least ``after`` s from now, at which a plan may take over.

        The first shape is the desired shape, except for joints whose measured position in ``q``
        (n,) deviates by more than the noise. None if no schedule is tracked by then.
        """
        if self._follower is None or self._follower.brakes:
            return None
        take_over = self._follower.take_over(stamp_ns, after)
        if take_over is not None:
            first = take_over.shapes[0]
            first[:] = np.where(np.abs(q - first) > self._config.shape_deadband, q, first)
        return take_over

    def covers(self, stamp_ns: int) -> bool:
        """Whether a given time is within the schedule or the braking phase."""
        return self._follower is not None and self._follower.covers(stamp_ns)

    def has_ended(self, stamp_ns: int, q: Array) -> bool:
        """Whether the schedule or the braking is over."""
        follower = self._follower
        if follower is not None and self._ends_by_result and not follower.brakes:
            return self._has_result or follower.is_overdue(stamp_ns)
        return follower is not None and follower.has_ended(stamp_ns, q)

    def end_by_result(self) -> None:
        """End the schedule at the next state: the controller that executes it has ended it."""
        self._has_result = True

    def stop(self, *, at_last_shape: bool = False) -> None:
        """Stop tracking; hold the schedule's last shape, or the next measured shape."""
        self._holds_position = at_last_shape and self._follower is not None
        if at_last_shape and self._follower is not None:
            self.setpoint.position[:] = self._follower.schedule.positions[-1]
        if self._follower is not None and self._follower.schedule.end_velocities is not None:
            self.setpoint.velocity[:] = self._follower.schedule.end_velocities
        self._follower = None

    def is_check_due(self, stamp_ns: int) -> bool:
        """Whether the schedule has a predicted pose to check at this time."""
        follower = self._follower
        return follower is not None and not follower.brakes and self.path_check.due(stamp_ns)

    def track(self, stamp_ns: int, q: Array, *, obeyed: bool = True) -> list[int]:
        """Write the setpoint for the current shape ``q`` (n,), and return the stuck joints.

        If the shape is not finite, the setpoint commands zero velocities. While no command is in
        effect at the plant (``obeyed`` is false), joints that do not move are not considered stuck.
        """
        assert self._follower is not None
        position, velocity = self.setpoint.position, self.setpoint.velocity
        self._follower.command(stamp_ns, q, position, velocity)
        if not math.isfinite(velocity.dot(velocity)):
            velocity[:] = 0.0
            return []
        self._spins = True
        if self.stuck:
            velocity[self.stuck] = 0.0
        if not obeyed:
            self._stuck_watch.restart()
            return []
        return self._stuck_watch.find_stuck(q, position, velocity)

    def follow_velocity(self, q: Array, velocity: Array) -> None:
        """Write a setpoint with velocities (n,) that do not follow a schedule."""
        setpoint = self.setpoint
        if self._commands_plant or not self._holds_position:
            setpoint.position[:] = q
        else:
            # The reference of a controller follows the commands, not the measurements.
            setpoint.position[:] += setpoint.velocity * self._config.control_period
        setpoint.velocity[:] = velocity
        self._holds_position = True

    def forget_wheels(self) -> None:
        """In the next setpoint, use the measured wheel rates, not the commanded ones."""
        self._spins = False

    def hold(self, q: Array, qdot: Array | None = None, *, obeyed: bool = True) -> None:
        """Write the setpoint that keeps the shape without a schedule.

        Reaction wheels keep their last commanded rates, or initially the measured rates in ``qdot``
        (n,): braking the wheels would rotate the base.
        """
        # The reference of a controller must not follow the measured shape; for a plant, rest is any
        # shape. Motions while no command is in force are not undone afterwards.
        if self._commands_plant or not self._holds_position or not obeyed:
            if math.isfinite(q.dot(q)):
                self.setpoint.position[:] = q
            self._holds_position = True
            kept = self.setpoint.velocity[self._wheels]
            if not self._spins and qdot is not None and np.all(np.isfinite(qdot)):
                kept, self._spins = qdot[self._wheels], True
            self.setpoint.velocity[:] = 0.0
            self.setpoint.velocity[self._wheels] = kept


# -- stuck joints ---------------------------------------------------------------------------------

_STUCK_SHARE = 0.05

_MIN_FOLLOWED_SHARE = 0.5
"""Fraction of the commanded range above which a joint is considered to follow its commands. At
smaller fractions, a joint that is not stuck is slow, or its motion is hidden by noise."""

_MAX_STANDSTILL_WINDOWS = 8
"""Number of windows without any joint motion after which joints are considered stuck."""

_CHECK_PERIOD = 16
"""Number of ticks between checks while all joints follow their commands, to save time."""

_MIN_JOINT_ERROR = 1e-6  # m or rad


class StuckJointWatch:
    """Monitors the joints tick by tick while a schedule is tracked.

    For every joint, the range of positions since it last followed is compared with the commanded
    range. A joint is stuck if it was commanded to move in at least N ticks and the first range is a
    small fraction of the second. So joints that are not commanded to move, slow joints, and noisy
    measurements are not mistaken for stuck joints. If several joints are commanded to move and none
    does, they are monitored for longer, because commands may not arrive for a while.

    Parameters
    ----------
    joints
        Number of joints.
    ticks
        The number N above; 0: joints are never considered stuck.
    control_period
        Command duration, s.
    band
        Shape errors up to this value are treated as noise, m or rad.
    """

    def __init__(self, joints: int, ticks: int, control_period: float, band: float = 0.0) -> None:
        self._ticks, self._control_period = ticks, control_period
        self._band = max(band, _MIN_JOINT_ERROR)
        self._joints, self._max_window = joints, _MAX_STANDSTILL_WINDOWS * ticks
        self.restart()

    def restart(self) -> None:
        """Start monitoring the joints for a new schedule."""
        n = self._joints
        self._suspicious, self._ticks_without_check = False, 0
        self._moving_ticks = np.zeros(n, dtype=np.int64)
        self._window = np.full(n, self._ticks, dtype=np.int64)
        self._commanded = np.zeros(n)
        self._commanded_range, self._measured_range = np.zeros((2, n)), np.zeros((2, n))

    def find_stuck(self, q: Array, wanted: Array, velocity: Array) -> list[int]:
        """Return the indices of joints considered stuck from this tick on, usually none.

        ``q`` and ``wanted`` (n,) are measured and desired shapes, ``velocity`` (n,) the command.
        """
        if not self._suspicious:
            self._ticks_without_check += 1
            if self._ticks_without_check % _CHECK_PERIOD or not self._ticks:
                return []
            if np.abs(wanted - q).max(initial=0.0) <= self._band:
                return []
            self._suspicious = True
            self._restart_joints(np.ones(self._joints, dtype=np.bool_), q)
        _widen_ranges(self._measured_range, q)
        self._commanded += velocity * self._control_period
        _widen_ranges(self._commanded_range, self._commanded)
        self._moving_ticks += (
            np.abs(velocity) * self._control_period > _MIN_JOINT_ERROR * _STUCK_SHARE
        )
        due = self._moving_ticks >= self._window
        if not due.any():
            return []
        commanded, measured = (
            np.ptp(each, axis=0) for each in (self._commanded_range, self._measured_range)
        )
        moved, still = commanded > self._band, measured <= _STUCK_SHARE * commanded
        stuck = due & still & moved
        none_moves = np.count_nonzero(moved) > 1 and still[moved].all()
        if none_moves and self._window[due].max() < self._max_window:
            # Joints do not all jam at once: perhaps commands do not arrive for a while.
            stuck[:] = False
        follows = due & (measured >= _MIN_FOLLOWED_SHARE * commanded)
        # Joints between the two fractions are monitored for a window twice as long.
        self._window[due] *= 2
        self._restart_joints(follows | stuck, q)
        return [int(i) for i in np.flatnonzero(stuck)]

    def _restart_joints(self, joints: npt.NDArray[np.bool_], q: Array) -> None:
        self._moving_ticks[joints], self._window[joints] = 0, self._ticks
        self._commanded[joints] = 0.0
        self._commanded_range[:, joints], self._measured_range[:, joints] = 0.0, q[joints]


def _widen_ranges(ranges: Array, values: Array) -> None:
    np.minimum(ranges[0], values, out=ranges[0])
    np.maximum(ranges[1], values, out=ranges[1])
