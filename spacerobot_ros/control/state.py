"""Inputs and outputs of control laws (states, references, actuations), and dead reckoning."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP, count_steps, state_slices
from spacerobot_ros.model.rotations import (
    matrix_from_quaternion,
    quaternion_from_matrix,
    quaternion_from_rotvec,
    quaternion_multiply,
)
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.target_motion import FrameMotion


def _zero() -> Array:
    # A new array for each: callers' libraries reject read-only arrays.
    return np.zeros(3)


class TargetNotSetError(SpaceRobotError):
    """A controlled output has no reference; the message names it."""


class NotFiniteError(SpaceRobotError):
    """A state or reference contains a non-finite value; no command is computed."""


@dataclass(frozen=True)
class ControlState:
    """Measured (or estimated) state of a robot.

    ``r_WB`` (3,) base link position in W, m; ``quaternion_WB`` (4,) base attitude
    (x, y, z, w), a unit quaternion; ``v_WB_B`` (3,) in m/s and ``omega_WB_B`` (3,) in rad/s, base
    twist in the base frame; ``q``, ``qdot`` (n,) joint positions and velocities (m or rad, /s).
    """

    r_WB: Array
    quaternion_WB: Array
    v_WB_B: Array
    omega_WB_B: Array
    q: Array
    qdot: Array

    @classmethod
    def at_rest(cls, r_WB: Array, quaternion_WB: Array, q: Array) -> ControlState:
        """Return a state with zero velocities."""
        return cls(r_WB, quaternion_WB, np.zeros(3), np.zeros(3), q, np.zeros(len(q)))

    def stack(self, memory: Array) -> None:
        """Write the six components in sequence into ``memory`` (13 + 2 n,).

        Raises
        ------
        ValueError
            A component has the wrong length.
        """
        parts = self.r_WB, self.quaternion_WB, self.v_WB_B, self.omega_WB_B, self.q, self.qdot
        np.concatenate(parts, out=memory)

    def copied(self) -> ControlState:
        """Return a copy, because the memory of a state may be reused for the next state."""
        memory = np.empty(13 + 2 * len(self.q))
        self.stack(memory)
        return ControlState.unstack(memory)

    @classmethod
    def unstack(cls, memory: Array) -> ControlState:
        """Return a copy of the state from memory written by :meth:`stack`."""
        x = memory.copy()
        joints = 13 + (len(x) - 13) // 2
        return cls(x[:3], x[3:7], x[7:10], x[10:13], x[13:joints], x[joints:])


@dataclass(frozen=True)
class PoseReference:
    """Desired pose of a frame in W: position (m), attitude (unit quaternion x, y, z, w), and their
    velocities and accelerations (m, rad, s), all in the world frame; zero unless given.
    """

    position: Array
    quaternion: Array
    velocity: Array = field(default_factory=_zero)
    angular_velocity: Array = field(default_factory=_zero)
    acceleration: Array = field(default_factory=_zero)
    angular_acceleration: Array = field(default_factory=_zero)

    @classmethod
    def with_body_twist(
        cls, position: Array, quaternion_WB: Array, v_B: Array, omega_B: Array
    ) -> PoseReference:
        """Return the reference for a frame B from velocities in B components, as in odometry."""
        R_WB = matrix_from_quaternion(quaternion_WB)
        return cls(position, quaternion_WB, R_WB @ v_B, R_WB @ omega_B)

    @classmethod
    def of_motion(cls, motion: FrameMotion) -> PoseReference:
        """Return a frame's motion at the first time as a reference."""
        numbers = (motion.v, motion.omega, motion.a, motion.alpha)
        quaternion = quaternion_from_matrix(motion.R[0])
        return cls(motion.r[0], quaternion, *(each[0] for each in numbers))

    @property
    def values(self) -> Array:
        """The pose (7,): position, m, and quaternion."""
        return np.concatenate([self.position, self.quaternion])

    @property
    def motion(self) -> FrameMotion:
        """The reference as the motion of a frame at a single time."""
        R = matrix_from_quaternion(self.quaternion)
        numbers = (self.position, self.velocity, self.angular_velocity, self.acceleration)
        return FrameMotion(*(x[np.newaxis] for x in (R, *numbers, self.angular_acceleration)))


@dataclass(frozen=True)
class JointReference:
    """Positions, velocities and accelerations (n,) of all joints, in model order."""

    q: Array
    qdot: Array
    qddot: Array

    @classmethod
    def at_rest(cls, q: Array) -> JointReference:
        """Return a reference that holds a configuration."""
        return cls(q, np.zeros(len(q)), np.zeros(len(q)))


@dataclass(frozen=True)
class Reference:
    """Reference of the outputs; None for a group that is not controlled.

    ``of_one_motion``: whether the poses result from the joint motion.
    """

    base: PoseReference | None = None
    end_effector: PoseReference | None = None
    joints: JointReference | None = None
    of_one_motion: bool = False

    @classmethod
    def present(cls, robot: SpaceRobot, state: ControlState, end_effector: str = "") -> Reference:
        """Return the current poses and joint positions as a reference at rest.

        ``end_effector`` names the end-effector link; empty if the robot has none.

        Raises
        ------
        KeyError
            There is no such link.
        """
        pose = None
        if end_effector:
            R_WB = matrix_from_quaternion(state.quaternion_WB)
            R_BE, r_BE_B = robot.link_pose(end_effector, state.q)
            pose = PoseReference(state.r_WB + R_WB @ r_BE_B, quaternion_from_matrix(R_WB @ R_BE))
        # The arrays of a state may be reused for the next one.
        base = PoseReference(state.r_WB.copy(), state.quaternion_WB.copy())
        return cls(base, pose, JointReference.at_rest(state.q.copy()))


class Actuation(NamedTuple):
    """``wrench_B`` (6,): thruster force (N), then torque (N m) at the base link origin, in base
    components; ``tau`` (n,): joint efforts (N m or N).
    """

    wrench_B: Array
    tau: Array


class DeadReckoning:
    """Paper 4, end of section IV: the state obtained by integrating eq. (19) under the sent
    commands.

    Integration starts from the last measured state, and proceeds one control period at a time under
    held actuation (Runge-Kutta 4). Differences between the model and the real robot accumulate over
    :attr:`elapsed`.

    The integrated state is the state of :mod:`spacerobot_ros.model.integration`, with both
    momenta and the centre of mass, which joint motion does not change. Measured joint positions and
    rates replace the predicted ones, and the base rotates according to the connection ``A``. Errors
    then accumulate only in the effects of the thrusters.

    Parameters
    ----------
    robot
        The controller's robot model.
    control_period
        Duration of a step, s.
    integration_step
        Longest Runge-Kutta step, s.

    Raises
    ------
    ParameterError
        A duration is not positive.
    """

    def __init__(
        self,
        robot: SpaceRobot,
        control_period: float,
        integration_step: float = DEFAULT_INTEGRATION_STEP,
    ) -> None:
        self._substeps = count_steps(control_period, integration_step)
        self.robot = robot
        self.control_period = control_period
        self.elapsed = 0.0
        """Time since the last measured state, s."""
        self._step = robot.buffered("flight_step")
        self._x, self._command, h = self._step.inputs
        h[:] = control_period / self._substeps
        parts = (self._x[part] for part in state_slices(robot.n))
        self._q, self._quaternion, self._qdot, self._p_W, self._L_W, self._r_WC = parts

    def reset(self, measured: ControlState) -> None:
        """Start from a measured state."""
        quaternion, q, qdot = measured.quaternion_WB, measured.q, measured.qdot
        p_W, L_W, _ = self.robot.momentum(quaternion, q, measured.v_WB_B, measured.omega_WB_B, qdot)
        r_WC = measured.r_WB + matrix_from_quaternion(quaternion) @ self.robot.center_of_mass(q)
        self._x[:] = np.concatenate([q, quaternion, qdot, p_W, L_W, r_WC])
        self.elapsed = 0.0

    @property
    def state(self) -> ControlState:
        """The estimate."""
        q, quaternion, qdot = self._q.copy(), self._quaternion.copy(), self._qdot.copy()
        v, omega = self.robot.base_twist(quaternion, q, qdot, self._p_W, self._L_W)
        r = self._r_WC - matrix_from_quaternion(quaternion) @ self.robot.center_of_mass(q)
        return ControlState(r, quaternion, v, omega, q, qdot)

    def step(
        self, actuation: Actuation, q: Array | None = None, qdot: Array | None = None
    ) -> ControlState:
        """Advance one control period under held actuation and return the estimate at its end.

        ``q`` and ``qdot`` (n,) are the joint positions and rates measured at the end of the period,
        if available.
        """
        self._command[:] = np.concatenate([actuation.tau, actuation.wrench_B])
        for _ in range(self._substeps):
            self._step.evaluate()
            self._x[:] = self._step.outputs[0]
        if q is not None and qdot is not None:
            # At the midpoint of the difference, the connection is second-order accurate.
            A = self.robot.connection((self._q + q) / 2)
            turn = quaternion_from_rotvec(-A[3:] @ (q - self._q))
            self._quaternion[:] = quaternion_multiply(self._quaternion, turn)
            self._q[:], self._qdot[:] = q, qdot
        self.elapsed += self.control_period
        return self.state
