"""The output vector z1 that a law drives, as symbols (paper 4, eqs 22, 23 and 26).

The independent velocities are the paper's ``z0dot = [v_cm; omega; qdot]`` (eq. 8), the first two
in base components. The outputs are components in W of poses, and joints. The Jacobian here is eq.
(23) without its Euler-rate matrices: attitude is a quaternion, its error a rotation vector, and
the velocity of an attitude output is a component of the angular velocity. So the representation
has no singularity, and ``J_z`` loses rank only where the manipulator does.

With that, the rate of an attitude error is understood as ``omega_des - omega``. About one fixed
axis (every planar robot) it is the derivative of the error; in general it is so to first order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.control.errors import NotFiniteError, TargetNotSetError
from spacerobot_ros.control.selection import AXES, OutputSelection
from spacerobot_ros.control.state import (
    ControlState,
    JointReference,
    PoseReference,
    Reference,
)
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.kinematics import link_quaternion
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.symbolic_rotations import (
    matrix_from_quaternion,
    quaternion_multiply,
    rotation_error,
)

_POSE_REFERENCE = 19
"""Numbers of a pose reference: position 3, quaternion 4, two velocities and two accelerations."""


@dataclass(frozen=True)
class _Group:
    """Outputs of one kind: error, error rate, wanted acceleration, rows of J_z, bias."""

    error: ca.SX
    error_rate: ca.SX
    acceleration: ca.SX
    J: ca.SX
    bias: ca.SX

    def rows(self, chosen: list[int]) -> _Group:
        return _Group(
            self.error[chosen],
            self.error_rate[chosen],
            self.acceleration[chosen],
            self.J[chosen, :],
            self.bias[chosen],
        )


class OutputVector:
    """The selected outputs of a robot, as expressions for a law to build its function from.

    ``m`` outputs, ``N = 6 + n`` degrees of freedom. The symbols ``state`` and ``reference`` are
    what :meth:`pack` writes; the expressions, all functions of the two:

    ``q``, ``omega``, ``v_cm``, ``qdot``
        The state in the velocities z0dot, base components.
    ``J_z``
        (m, N) ``z1dot = J_z z0dot``, eq. (23).
    ``bias``
        (m,) ``Jdot_z z0dot``: the acceleration of the outputs at ``z0ddot = 0``.
    ``J_q_inverse``
        (N, N) inverse of the matrix of eq. (21): ``[f; n; tau] = J_q^-T Q``.
    ``error``, ``error_rate``
        (m,) ``e = z1_des - z1`` (eq. 26) and its rate; rotations as rotation vectors in W.
    ``acceleration``
        (m,) ``z1ddot_des``.

    Parameters
    ----------
    robot
        The model.
    selection
        Which outputs.

    Raises
    ------
    ParameterError
        The robot does not have what is selected; see :meth:`OutputSelection.require_valid`.
    """

    def __init__(self, robot: SpaceRobot, selection: OutputSelection) -> None:
        selection.require_valid(robot.description)
        self.robot = robot
        self.selection = selection
        self.labels = selection.labels
        self.m, self.N = len(self.labels), 6 + robot.n
        n = robot.n
        self.state = ca.SX.sym("state", 13 + 2 * n)
        r_WB, self._quaternion, v, self.omega, self.q, self.qdot = ca.vertsplit(
            self.state, [0, 3, 7, 10, 13, 13 + n, 13 + 2 * n]
        )
        self._R_WB = matrix_from_quaternion(self._quaternion)

        J_base = self._link_jacobian(robot.base_link)
        self.v_cm = v - J_base[:3, 3:6] @ self.omega - J_base[:3, 6:] @ self.qdot
        self.z0dot = ca.vertcat(self.v_cm, self.omega, self.qdot)
        self.J_q_inverse = ca.SX.eye(self.N)
        self.J_q_inverse[:3, 3:] = -J_base[:3, 3:]

        groups = []
        references = []
        if selection.base:
            target = ca.SX.sym("base_reference", _POSE_REFERENCE)
            references.append(target)
            pose = self._pose_group(J_base, r_WB, self._quaternion, target)
            groups.append(pose.rows([AXES.index(axis) for axis in selection.base]))
        if selection.end_effector:
            target = ca.SX.sym("end_effector_reference", _POSE_REFERENCE)
            references.append(target)
            pose = self._end_effector_group(r_WB, target)
            groups.append(pose.rows([AXES.index(axis) for axis in selection.end_effector]))
        if selection.joints:
            target = ca.SX.sym("joint_reference", 3 * n)
            references.append(target)
            shape = self._joint_group(target)
            groups.append(shape.rows([robot.joint_names.index(name) for name in selection.joints]))
        self.reference = ca.vertcat(*references)
        self.error = ca.vertcat(*(group.error for group in groups))
        self.error_rate = ca.vertcat(*(group.error_rate for group in groups))
        self.acceleration = ca.vertcat(*(group.acceleration for group in groups))
        self.J_z = ca.vertcat(*(group.J for group in groups))
        self.bias = ca.vertcat(*(group.bias for group in groups))

    def pack_state(self, state: ControlState, memory: Array) -> None:
        """Write a state into the memory (13 + 2 n,) of the symbol ``state``.

        Raises
        ------
        NotFiniteError
            A number of it is not finite.
        ValueError
            A part of it has the wrong length.
        """
        state.stack(memory)
        _require_finite("state", memory)

    def pack_reference(self, reference: Reference, memory: Array) -> None:
        """Write a reference into the memory of the symbol ``reference``.

        Raises
        ------
        TargetNotSetError
            The reference lacks a group that is selected.
        NotFiniteError
            A number of it is not finite.
        ValueError
            A part of it has the wrong length.
        """
        parts: list[Array] = []
        if self.selection.base:
            parts += _pose_parts("the base", reference.base)
        if self.selection.end_effector:
            parts += _pose_parts("the end-effector", reference.end_effector)
        if self.selection.joints:
            parts += _joint_parts(reference.joints)
        np.concatenate(parts, out=memory)
        _require_finite("reference", memory)

    # -- groups -------------------------------------------------------------------------------

    def _link_jacobian(self, link: str) -> ca.SX:
        return self.robot.function(f"jacobian:{link}", compile=False)(self.q)

    def _pose_group(self, J_B: ca.SX, position: ca.SX, quaternion: ca.SX, target: ca.SX) -> _Group:
        """Build the six outputs of a frame from its Jacobian in base components."""
        R = self._R_WB
        p_des, quaternion_des, v_des, omega_des, a_des, alpha_des = ca.vertsplit(
            target, [0, 3, 7, 10, 13, 16, 19]
        )
        # The rate of J_B(q) z0dot at constant z0dot, then that of the axes it is given along.
        z0dot = ca.SX.sym("z0dot", self.N)
        drift = ca.jtimes(J_B @ z0dot, self.q, self.qdot)
        drift = ca.substitute(drift, z0dot, self.z0dot)
        twist_B = J_B @ self.z0dot
        bias = [
            R @ (drift[part] + ca.cross(self.omega, twist_B[part]))
            for part in (slice(0, 3), slice(3, 6))
        ]
        J = ca.vertcat(R @ J_B[:3, :], R @ J_B[3:, :])
        velocity = J @ self.z0dot
        return _Group(
            ca.vertcat(p_des - position, rotation_error(quaternion, quaternion_des)),
            ca.vertcat(v_des, omega_des) - velocity,
            ca.vertcat(a_des, alpha_des),
            J,
            ca.vertcat(*bias),
        )

    def _end_effector_group(self, r_WB: ca.SX, target: ca.SX) -> _Group:
        link = self.selection.end_effector_link
        _, r_BL = self.robot.function("link_poses", compile=False)(self.q)
        position = r_WB + self._R_WB @ r_BL[:, self.robot.link_names.index(link)]
        attitude = link_quaternion(self.robot.description, link, self.q)
        quaternion = quaternion_multiply(self._quaternion, attitude)
        return self._pose_group(self._link_jacobian(link), position, quaternion, target)

    def _joint_group(self, target: ca.SX) -> _Group:
        n = self.robot.n
        q_des, qdot_des, qddot_des = ca.vertsplit(target, [0, n, 2 * n, 3 * n])
        J = ca.horzcat(ca.SX(n, 6), ca.SX.eye(n))
        return _Group(q_des - self.q, qdot_des - self.qdot, qddot_des, J, ca.SX(n, 1))


def _pose_parts(what: str, pose: PoseReference | None) -> list[Array]:
    if pose is None:
        raise TargetNotSetError(f"There is no reference for {what}, whose pose is controlled.")
    return [
        pose.position,
        pose.quaternion,
        pose.velocity,
        pose.angular_velocity,
        pose.acceleration,
        pose.angular_acceleration,
    ]


def _joint_parts(joints: JointReference | None) -> list[Array]:
    if joints is None:
        raise TargetNotSetError("There is no reference for the joints, which are controlled.")
    return [joints.q, joints.qdot, joints.qddot]


def _require_finite(what: str, memory: Array) -> None:
    # One call: the square sum of finite numbers of any sensible size is finite.
    if not math.isfinite(memory.dot(memory)):
        raise NotFiniteError(f"The {what} holds a number that is not finite.")
