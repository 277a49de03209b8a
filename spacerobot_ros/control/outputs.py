"""Outputs z1 of a law: selection and symbolic expressions (paper 4, eqs 22, 23, 26).

The independent velocities are the paper's ``z0dot = [v_cm; omega; qdot]`` (eq. 8), the first two
in the base frame. The outputs are pose components in W, and joint positions. The Jacobian here is
eq. (23) without its Euler-rate matrices: attitude is a quaternion, its error a rotation vector, and
the velocity of an attitude output is a component of the angular velocity. So the representation has
no singularity, and ``J_z`` loses rank only if the manipulator is singular.

The rate of an attitude error is ``omega_des - omega``. For rotation about one fixed axis (every
planar robot), it is exactly the derivative of the error; in general, this is true only to first
order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np

from spacerobot_ros.control.state import (
    ControlState,
    JointReference,
    NotFiniteError,
    PoseReference,
    Reference,
    TargetNotSetError,
)
from spacerobot_ros.errors import AT_JOINTS, ParameterError, RobotDescriptionError, quantity
from spacerobot_ros.model.description import Array, RobotDescription, plane_normal
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.inverse_kinematics import AXES
from spacerobot_ros.model.kinematics import link_quaternion
from spacerobot_ros.model.space_robot import SpaceRobot
from spacerobot_ros.model.symbolic_rotations import (
    matrix_from_quaternion,
    quaternion_multiply,
    rotation_error,
)
from spacerobot_ros.model.thrusters import IN_URDF, find_thrusters
from spacerobot_ros.planning.core.goal import Controlled

_PARALLEL_TOLERANCE = 1e-6
"""Sine of the largest angle between axes that are considered parallel."""


class OutputDistance(NamedTuple):
    """Distances between the outputs and a reference, by kind of output.

    ``position`` (m) and ``attitude`` (rad): distance and angle along the controlled axes, of the
    base or of the end-effector, whichever distance or angle is larger; ``joints``: the largest
    joint error, m or rad. Kinds that are not controlled are NaN in messages, and 0 where the
    distances are compared with limits of the same type.
    """

    position: float
    attitude: float
    joints: float

    def __str__(self) -> str:
        parts = zip(self, ("m", "rad", AT_JOINTS), strict=True)
        return ", ".join(quantity(*part) for part in parts if not math.isnan(part[0]))


@dataclass(frozen=True)
class OutputSelection:
    """Components of ``z1`` (paper 4, eqs 22 and 31), in this order.

    ``base`` and ``end_effector``: pose components in W of the base link and of
    ``end_effector_link``, from :data:`AXES`; ``joints``: names of joints.
    """

    base: tuple[str, ...] = ()
    end_effector: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    end_effector_link: str = ""

    @cached_property
    def distances(self) -> tuple[tuple[str, tuple[int, ...]], ...]:
        """Kind and indices of the outputs that together form a distance, angle or joint error."""
        count = len(self.base)
        found: list[tuple[str, tuple[int, ...]]] = []
        for axes, first in (self.base, 0), (self.end_effector, count):
            for kind, turns in ("position", False), ("attitude", True):
                places = [first + i for i, x in enumerate(axes) if x.startswith("r") is turns]
                if places:
                    found.append((kind, tuple(places)))
        first = count + len(self.end_effector)
        return (*found, *(("joints", (first + i,)) for i in range(len(self.joints))))

    def distance(self, errors: Array, other: float = math.nan) -> OutputDistance:
        """Return the distances for the output errors (m,); ``other`` is the value of kinds that are
        not controlled."""
        sizes: dict[str, float] = {}
        given = errors.tolist()
        for kind, places in self.distances:
            size = math.hypot(*[given[i] for i in places])
            sizes[kind] = max(size, sizes.get(kind, 0.0))
        return OutputDistance(*[sizes.get(kind, other) for kind in OutputDistance._fields])

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the outputs: ``base.x``, ``end_effector.rz``, ``joint.elbow``."""
        return (
            *(f"base.{axis}" for axis in self.base),
            *(f"end_effector.{axis}" for axis in self.end_effector),
            *(f"joint.{name}" for name in self.joints),
        )

    def require_valid(self, description: RobotDescription) -> None:
        """Check that a robot has these outputs.

        Raises
        ------
        ParameterError
            An axis, joint or link is unknown or named twice, nothing is selected, or there are
            more outputs than degrees of freedom.
        """
        _require_known("axis of the base", self.base, AXES)
        _require_known("axis of the end-effector", self.end_effector, AXES)
        _require_known("joint", self.joints, description.joint_names)
        if self.end_effector:
            links = [link.name for link in description.links]
            _require_known("end-effector link", (self.end_effector_link,), links)
        count, freedom = len(self.labels), 6 + len(description.joint_names)
        if count == 0:
            raise ParameterError(
                f"No output of robot '{description.name}' is selected: name base axes or joints."
            )
        if count > freedom:
            raise ParameterError(
                f"{count} outputs are selected; robot '{description.name}' has "
                f"{freedom} degrees of freedom."
            )


def default_selection(description: RobotDescription, end_effector_link: str) -> OutputSelection:
    """Return the default outputs of a robot with an end-effector link (empty: none).

    * A planar robot (:func:`plane_normal`) whose plane is a coordinate plane of its base: the base
      in that plane (x, y, rz for the plane x-y), and, with two or more joints, the end-effector
      position in it. The axes are those of W, so the base must move in that plane of W. A robot
      with thrusters in its URDF that push it out of the plane is not planar.
    * Any other robot: the full base pose, and the end-effector's pose (six or more joints) or
    position (three to five).
    * Without an end-effector, or with fewer joints: the base pose and the joints.

    This way, there are never more outputs than degrees of freedom.

    Raises
    ------
    ParameterError
        There is no such link.
    """
    names = description.joint_names
    base: tuple[str, ...] = AXES
    point: tuple[str, ...] = AXES[:3]
    fewest = 3
    normal = plane_normal(description)
    along = -1 if normal is None else int(np.argmax(np.abs(normal)))
    in_plane = normal is not None and abs(normal[along]) > 1 - _PARALLEL_TOLERANCE
    if in_plane and not _is_pushed_along(description, along):
        point = tuple(axis for i, axis in enumerate(AXES[:3]) if i != along)
        base, fewest = (*point, AXES[3 + along]), 2
    elif len(names) >= 6:
        point = AXES
    if not end_effector_link or len(names) < fewest:
        return OutputSelection(base=base, joints=names)
    selection = OutputSelection(base, point, (), end_effector_link)
    selection.require_valid(description)
    return selection


def _is_pushed_along(description: RobotDescription, axis: int) -> bool:
    """Whether thrusters in the URDF push the base along an axis of its frame."""
    try:
        table = find_thrusters(IN_URDF, description)
    except RobotDescriptionError:
        return False
    return bool(np.abs(table.direction_B[:, axis]).max() > _PARALLEL_TOLERANCE)


def controlled_parts(axes: Sequence[str], joints: Sequence[str] = ()) -> frozenset[Controlled]:
    """Return the goal components controlled by outputs: pose axes and joints."""
    parts: set[Controlled] = {"attitude" if axis.startswith("r") else "position" for axis in axes}
    return frozenset(parts | {"shape"} if joints else parts)


_POSE_REFERENCE_SIZE = 19
"""Number of values in a pose reference: 3 for the position, 4 for the quaternion, and 3 each for
two velocities and two accelerations."""


class _OutputGroup(NamedTuple):
    """Outputs of one kind: error, error rate, desired acceleration, rows of J_z, bias."""

    error: ca.SX
    error_rate: ca.SX
    acceleration: ca.SX
    J: ca.SX
    bias_acceleration: ca.SX


class OutputVector:
    """Selected outputs of a robot, as expressions from which a law builds its function.

    ``m`` outputs, ``N = 6 + n`` degrees of freedom. The expressions are functions of the symbols
    ``state`` and ``reference`` (see :meth:`pack_state` and :meth:`pack_reference`):

    ``model``
        Calls robot model functions by name.
    ``q``, ``omega``, ``v_cm``, ``qdot``
        The state, with velocities z0dot in the base frame.
    ``J_z``
        (m, N) ``z1dot = J_z z0dot``, eq. (23).
    ``bias``
        (m,) ``Jdot_z z0dot``: the output acceleration at ``z0ddot = 0``.
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
        The outputs.
    thrust
        Whether forces on the base move the centre of mass; if not, the first columns of ``J_z`` are
        zero.

    Raises
    ------
    ParameterError
        The robot lacks a selected output; see :meth:`OutputSelection.require_valid`.
    """

    def __init__(
        self, robot: SpaceRobot, selection: OutputSelection, *, thrust: bool = True
    ) -> None:
        selection.require_valid(robot.description)
        self.thrust = thrust
        self.robot, self.model = robot, robot.expressions()
        self.selection = selection
        self.labels = selection.labels
        self.m, self.N = len(self.labels), 6 + robot.n
        n = robot.n
        self.state = ca.SX.sym("state", 13 + 2 * n)
        r_WB, self._quaternion, v, self.omega, self.q, self.qdot = ca.vertsplit(
            self.state, [0, 3, 7, 10, 13, 13 + n, 13 + 2 * n]
        )
        self._R_WB = matrix_from_quaternion(self._quaternion)

        J_base = self.model(f"jacobian:{robot.base_link}", self.q)
        self.v_cm = v - J_base[:3, 3:6] @ self.omega - J_base[:3, 6:] @ self.qdot
        self.z0dot = ca.vertcat(self.v_cm, self.omega, self.qdot)
        self.J_q_inverse = ca.SX.eye(self.N)
        self.J_q_inverse[:3, 3:] = -J_base[:3, 3:]

        groups: list[_OutputGroup] = []
        references = []
        if selection.base:
            target = ca.SX.sym("base_reference", _POSE_REFERENCE_SIZE)
            references.append(target)
            pose = self._pose_group(J_base, r_WB, self._quaternion, target)
            groups.append(_selected(pose, AXES, selection.base))
        if selection.end_effector:
            target = ca.SX.sym("end_effector_reference", _POSE_REFERENCE_SIZE)
            references.append(target)
            pose = self._end_effector_group(r_WB, target)
            groups.append(_selected(pose, AXES, selection.end_effector))
        if selection.joints:
            target = ca.SX.sym("joint_reference", 3 * n)
            references.append(target)
            q_des, qdot_des, qddot_des = ca.vertsplit(target, [0, n, 2 * n, 3 * n])
            J = ca.horzcat(ca.SX(n, 6), ca.SX.eye(n))
            errors = q_des - self.q, qdot_des - self.qdot
            joints = _OutputGroup(*errors, qddot_des, J, ca.SX(n, 1))
            groups.append(_selected(joints, robot.joint_names, selection.joints))
        self.reference = ca.vertcat(*references)
        self._error_function: ca.Function | None = None
        self.error, self.error_rate, self.acceleration, self.J_z, self.bias_acceleration = (
            ca.vertcat(*parts) for parts in zip(*groups, strict=True)
        )
        if not thrust:
            # No actuator moves the centre of mass.
            self.J_z[:, :3] = 0

    def pack_state(self, state: ControlState, memory: Array) -> None:
        """Write a state into memory (13 + 2 n,) for the symbol ``state``.

        Raises
        ------
        NotFiniteError
            A value in the state is not finite.
        ValueError
            A component has the wrong length.
        """
        state.stack(memory)
        require_finite("state", memory)

    def pack_reference(self, reference: Reference, memory: Array) -> None:
        """Write a reference into memory for the symbol ``reference``.

        Raises
        ------
        TargetNotSetError
            The reference lacks a selected group.
        NotFiniteError
            A value in the reference is not finite.
        ValueError
            A component has the wrong length.
        """
        parts: list[Array] = []
        if self.selection.base:
            parts += _parts_of("the base, whose pose is", reference.base)
        if self.selection.end_effector:
            parts += _parts_of("the end-effector, whose pose is", reference.end_effector)
        if self.selection.joints:
            parts += _parts_of("the joints, which are", reference.joints)
        np.concatenate(parts, out=memory)
        require_finite("reference", memory)

    def mobility(self, H: ca.SX) -> ca.SX:
        """Return the accelerations (m, m) due to unit forces on each output; ``H`` is the inertia
        matrix."""
        # The translation of the centre of mass decouples (eq. 15).
        linear = self.J_z[:, :3].T / self.model.total_mass
        other = solve_positive_definite(H[3:, 3:], self.J_z[:, 3:].T)
        return self.J_z @ ca.vertcat(linear, other)

    def without_force(self, Q: ca.SX) -> ca.SX:
        """Return generalised forces or velocities (N,); those of the centre of mass are zero if no
        actuator can exert a force on it.
        """
        return Q if self.thrust else ca.vertcat(ca.SX.zeros(3), Q[3:])

    def errors(self, state: ControlState, reference: Reference) -> Array:
        """Return the errors (m,) of a state relative to a reference; see :meth:`pack_reference`."""
        if self._error_function is None:
            inputs = [self.state, self.reference, *self.model.inputs.values()]
            self._error_function = ca.Function("errors", inputs, [ca.densify(self.error)])
        x, wanted = np.empty(self.state.numel()), np.empty(self.reference.numel())
        self.pack_state(state, x)
        self.pack_reference(reference, wanted)
        found = self._error_function(x, wanted, *self.robot.mass_arguments.values())
        return np.asarray(found.full()[:, 0])

    # -- groups -------------------------------------------------------------------------------

    def _pose_group(
        self, J_B: ca.SX, position: ca.SX, quaternion: ca.SX, target: ca.SX
    ) -> _OutputGroup:
        """Build the six outputs of a frame from its Jacobian in the base frame."""
        R = self._R_WB
        p_des, quaternion_des, v_des, omega_des, a_des, alpha_des = ca.vertsplit(
            target, [0, 3, 7, 10, 13, 16, 19]
        )
        # The rate of J_B(q) z0dot at constant z0dot, then that of the axes it is expressed in.
        z0dot = ca.SX.sym("z0dot", self.N)
        twist_rate = ca.jtimes(J_B @ z0dot, self.q, self.qdot)
        # A centre of mass without thrust adds no acceleration.
        moving = self.without_force(self.z0dot)
        twist_rate = ca.substitute(twist_rate, z0dot, moving)
        twist_B = J_B @ moving
        bias = [
            R @ (twist_rate[part] + ca.cross(self.omega, twist_B[part]))
            for part in (slice(0, 3), slice(3, 6))
        ]
        J = ca.vertcat(R @ J_B[:3, :], R @ J_B[3:, :])
        velocity = J @ self.z0dot
        return _OutputGroup(
            ca.vertcat(p_des - position, rotation_error(quaternion, quaternion_des)),
            ca.vertcat(v_des, omega_des) - velocity,
            ca.vertcat(a_des, alpha_des),
            J,
            ca.vertcat(*bias),
        )

    def _end_effector_group(self, r_WB: ca.SX, target: ca.SX) -> _OutputGroup:
        link = self.selection.end_effector_link
        _, r_BL = self.model("link_poses", self.q)
        position = r_WB + self._R_WB @ r_BL[:, self.robot.link_names.index(link)]
        attitude = link_quaternion(self.robot.description, link, self.q)
        quaternion = quaternion_multiply(self._quaternion, attitude)
        J_B = self.model(f"jacobian:{link}", self.q)
        return self._pose_group(J_B, position, quaternion, target)


def _selected(group: _OutputGroup, names: Sequence[str], chosen: Sequence[str]) -> _OutputGroup:
    rows = [names.index(name) for name in chosen]
    return _OutputGroup(*(part[rows, :] for part in group))


def _parts_of(subject: str, group: PoseReference | JointReference | None) -> list[Array]:
    """Return the components of a group's reference, in the order of its fields."""
    if group is None:
        raise TargetNotSetError(f"There is no reference for {subject} controlled.")
    return list(vars(group).values())


def require_finite(name: str, memory: Array) -> None:
    """Raise NotFiniteError, with this name, if a value is not finite."""
    # One call: the square sum of finite numbers of any sensible size is finite.
    if not math.isfinite(memory.dot(memory)):
        raise NotFiniteError(f"The {name} contains a non-finite value.")


def _require_known(kind: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise ParameterError(f"There is no {kind} '{name}'; available: {', '.join(known)}.")
        if names.count(name) > 1:
            raise ParameterError(f"The {kind} '{name}' is named twice.")
