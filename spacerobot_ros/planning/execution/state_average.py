"""Measured states, and the state of a robot at rest as their average."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import (
    attitude_error,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.model.wheels import ReactionWheels
from spacerobot_ros.planning.core.goal import RobotState

_REST_RATE = 1e-9  # m/s or rad/s


class BaseMeasurement(NamedTuple):
    """A measured base: ``pose`` (7,), ``twist`` (6,), and the joint rates ``qdot`` (n,)."""

    pose: Array
    twist: Array
    qdot: Array


class MeasuredState(NamedTuple):
    """A measured state: stamp, shape ``q`` (n,), m or rad, and base, if measured at this time."""

    stamp_ns: int
    q: Array
    base: BaseMeasurement | None


class StateAverage:
    """Averages measured states, and estimates the total momenta from states at rest.

    While joints move, the momentum of a robot with uncertain masses is uncertain; at rest, it
    follows from the base motion alone, and without thrust it is constant. So a state is given the
    last momenta measured at rest, if there are any.

    Parameters
    ----------
    robot
        The model.
    count
        States to average.
    rest_tolerance
        Averaged base and joint rates up to this value, m/s or rad/s, are treated as noise at rest,
        and the momentum as zero. 0: every measured momentum is used.
    """

    def __init__(self, robot: SpaceRobot, count: int = 1, rest_tolerance: float = 0.0) -> None:
        self._robot, self._full_count, self._tolerance = robot, count, rest_tolerance
        wheels = ReactionWheels.of(robot.description)
        self._wheels, self._braked = wheels.index, wheels.other
        self.forget()

    @property
    def count(self) -> int:
        """Number of states since the last restart."""
        return len(self._states)

    @property
    def complete(self) -> bool:
        """Whether the average includes as many states as requested."""
        return self.count >= self._full_count

    def restart(self) -> None:
        """Discard the averaged states, but keep the momenta."""
        self._states: list[tuple[Array, Array, Array]] = []
        """Poses (7,), rates (6 + n,) and shapes (n,)."""

    def forget(self) -> None:
        """Discard the states and the momenta, because the robot state has changed."""
        self.restart()
        self._momenta: tuple[Array, Array] | None = None
        """Momenta last measured at rest, (3,) each; None: none were."""

    def add(self, pose: Array, twist: Array, q: Array, qdot: Array) -> None:
        """Add a state: pose (7,), twist (6,), shape and joint rates (n,), as reported by plants."""
        self._states.append((pose.copy(), np.concatenate([twist, qdot]), q.copy()))

    def take(self, measured: MeasuredState, *, alone: bool = False) -> bool:
        """Add a state, or use it alone; return false if its base is not measured."""
        base = measured.base
        if base is None:
            return False
        if alone:
            self.restart()
        self.add(base.pose, base.twist, measured.q, base.qdot)
        return True

    def state(self) -> RobotState:
        """Return the average of the states, of which there must be at least one.

        Raises
        ------
        PlanningError
            The average is not finite.
        """
        poses, measured_rates, shapes = map(np.array, zip(*self._states, strict=True))
        rates, q = measured_rates.mean(axis=0), shapes.mean(axis=0)
        if not (np.all(np.isfinite(poses)) and np.all(np.isfinite(np.concatenate([q, rates])))):
            raise PlanningError("The measured state is not finite; see odom and joint_states.")
        # Attitudes differ by noise: the mean of small rotations from the first is exact enough.
        first = poses[0, 3:]
        quaternion = first
        if len(poses) > 1:
            turn = np.mean([attitude_error(first, pose[3:]) for pose in poses], axis=0)
            quaternion = quaternion_multiply(first, quaternion_from_rotvec(turn))
        twist, qdot = rates[:6], rates[6:]
        momenta = self._momenta
        # Wheels keep spinning at rest.
        at_rest = np.abs(qdot[self._braked]).max(initial=0.0) <= max(_REST_RATE, self._tolerance)
        if at_rest or momenta is None:
            noise = np.abs(np.concatenate([twist, qdot[self._wheels]])).max() <= self._tolerance
            if at_rest and self._tolerance and noise:
                momenta = np.zeros(3), np.zeros(3)
            else:
                momenta = self._robot.momentum(quaternion, q, twist[:3], twist[3:], qdot)[:2]
        if at_rest:
            self._momenta = momenta
        return RobotState(poses[:, :3].mean(axis=0), quaternion, q, *momenta, qdot)
