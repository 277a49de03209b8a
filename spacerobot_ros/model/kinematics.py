"""Forward kinematics of the link tree in the base frame, symbolic and numeric (paper 4, section
II).

The base frame B is the root link frame. All vectors here are expressed in B, so every quantity is a
function of the configuration q only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from spacerobot_ros.model.compilation import BufferedFunction, dense_function
from spacerobot_ros.model.description import Array, Joint, JointKind, Mimic, Pose, RobotDescription
from spacerobot_ros.model.inertial_parameters import MassProperties, sparse_constant
from spacerobot_ros.model.rotations import matrices_from_quaternions, quaternion_from_matrix
from spacerobot_ros.model.rotations import quaternion_multiply as numeric_multiply
from spacerobot_ros.model.symbolic_rotations import (
    matrix_about_axis,
    matrix_from_quaternion,
    quaternion_multiply,
)
from spacerobot_ros.model.symbolic_rotations import quaternion_from_matrix as symbolic_quaternion


@dataclass(frozen=True)
class TreeKinematics:
    """Body poses and centres of mass as functions of the configuration q.

    For body k, in the base frame: ``R[k]`` attitude ``R_BBk`` (paper 4: ``0T_k``), ``p[k]``
    origin, ``com[k]`` centre of mass, ``axis[k]`` the unit axis of the joint that carries it (zero
    for the base). ``theta`` (m,) are the positions of the joints that carry ``bodies[1:]``: equal
    to q unless there are mimic joints. ``mass_properties`` are constants or symbols.
    """

    robot: RobotDescription
    q: ca.SX
    theta: ca.SX
    R: tuple[ca.SX, ...]
    p: tuple[ca.SX, ...]
    com: tuple[ca.SX, ...]
    axis: tuple[ca.SX, ...]
    r_BC_B: ca.SX
    mass_properties: MassProperties

    @property
    def n(self) -> int:
        """Number of joint coordinates."""
        return len(self.robot.joint_names)

    @property
    def moving_body_count(self) -> int:
        """Number of bodies moved by joints; more than ``n`` for robots with mimic joints."""
        return len(self.robot.bodies) - 1

    def spread(self, rates: ca.SX) -> ca.SX:
        """Return joint rates (m, ...) for coordinate rates (n, ...): ``G rates``."""
        return self._coupling @ rates

    def gather(self, forces: ca.SX) -> ca.SX:
        """Return generalised forces (n, ...) for joint forces (m, ...): ``G' forces``."""
        return self._coupling.T @ forces

    @property
    def _coupling(self) -> ca.DM:
        return sparse_constant(self.robot.coupling[0])

    def mass(self, k: int) -> float | ca.SX:
        """Mass of body k, kg."""
        return self.mass_properties.masses[k]

    @property
    def total_mass(self) -> float | ca.SX:
        """Mass of the system, kg."""
        return self.mass_properties.total

    @property
    def per_mass(self) -> float | ca.SX:
        """Inverse of the system mass, 1/kg."""
        # CasADi rewrites x * (1/d) as x/d; it leaves |1/d| as it is.
        per: float | ca.SX = 1 / self.mass_properties.total
        return per if isinstance(per, float) else ca.fabs(per)

    def parent(self, k: int) -> int:
        """Parent index of body k; -1 for the base."""
        return self.robot.bodies[k].parent

    def is_revolute(self, k: int) -> bool:
        """Whether the joint that carries body k is revolute or continuous, not prismatic."""
        return self.robot.moving_joints[k - 1].kind is not JointKind.PRISMATIC

    def ancestors(self, k: int) -> list[int]:
        """Return the bodies on the path from the base (excluded) to body k (included)."""
        chain = []
        while k > 0:
            chain.append(k)
            k = self.parent(k)
        return chain[::-1]

    def frame(self, link: str) -> tuple[ca.SX, ca.SX, int]:
        """Return the attitude (3, 3), position (3,) in B, and body index of a link frame."""
        body, pose = self.robot.frames[link]
        R, r = _chain_pose(self.R[body], self.p[body], pose)
        return R, r, body

    def angular_jacobian(self, k: int) -> ca.SX:
        """Return ``0F_k`` (3, n), which maps joint rates to the angular velocity of body k (eq.
        6)."""
        F = ca.SX(3, self.moving_body_count)
        for j in self.ancestors(k):
            if self.is_revolute(j):
                F[:, j - 1] = self.axis[j]
        return self.gather(F.T).T


def _chain_pose(R: ca.SX, p: ca.SX, pose: Pose) -> tuple[ca.SX, ca.SX]:
    return R @ sparse_constant(pose.R), p + R @ sparse_constant(pose.r)


def joint_positions(robot: RobotDescription, q: ca.SX) -> ca.SX:
    """Return the positions (m,) of the joints that carry ``bodies[1:]``, given coordinates q
    (n,)."""
    G, b = robot.coupling
    return sparse_constant(G) @ q + sparse_constant(b)


def tree_kinematics(
    robot: RobotDescription, mass_properties: MassProperties | None = None
) -> TreeKinematics:
    """Build the symbolic kinematics of a robot.

    Parameters
    ----------
    robot
        The robot.
    mass_properties
        Mass properties of the bodies; by default, constants from the description.
    """
    mass_properties = mass_properties or MassProperties(robot)
    q = ca.SX.sym("q", len(robot.joint_names))
    theta = joint_positions(robot, q)
    R: list[ca.SX] = [ca.SX.eye(3)]
    p: list[ca.SX] = [ca.SX(3, 1)]
    axis: list[ca.SX] = [ca.SX(3, 1)]
    moving = zip(robot.bodies[1:], robot.moving_joints, strict=True)
    for k, (body, joint) in enumerate(moving, start=1):
        R_joint, p_joint = _chain_pose(R[body.parent], p[body.parent], body.origin)
        direction = R_joint @ sparse_constant(joint.axis)
        if joint.kind is JointKind.PRISMATIC:
            R.append(R_joint)
            p.append(p_joint + direction * theta[k - 1])
        else:
            R.append(R_joint @ matrix_about_axis(joint.axis, theta[k - 1]))
            p.append(p_joint)
        axis.append(direction)
    com = [p[k] + R[k] @ mass_properties.centers[k] for k in range(len(robot.bodies))]
    r_BC_B = sum((m * c for m, c in zip(mass_properties.masses, com, strict=True)), ca.SX(3, 1))
    r_BC_B = r_BC_B / mass_properties.total
    frames = tuple(R), tuple(p), tuple(com), tuple(axis)
    return TreeKinematics(robot, q, theta, *frames, r_BC_B, mass_properties)


def link_quaternion(description: RobotDescription, link: str, q: ca.SX) -> ca.SX:
    """Return the quaternion (4,) of ``R_BL``, smooth in q because it is not converted from a
    matrix."""
    index, pose = description.frames[link]
    quaternion = sparse_constant(quaternion_from_matrix(pose.R))
    theta = joint_positions(description, q)
    while index > 0:
        body, joint = description.bodies[index], description.moving_joints[index - 1]
        if joint.kind is not JointKind.PRISMATIC:
            half = theta[index - 1] / 2
            turn = ca.vertcat(ca.sin(half) * ca.DM(joint.axis), ca.cos(half))
            quaternion = quaternion_multiply(turn, quaternion)
        turned = sparse_constant(quaternion_from_matrix(body.origin.R))
        quaternion = quaternion_multiply(turned, quaternion)
        index = body.parent
    return quaternion


class LinkPlacement:
    """Poses in W of frames fixed to links, from the base pose and the link poses.

    The poses are evaluated in CasADi's virtual machine: the few hundred operations take less time
    than one matrix product in numpy.

    Parameters
    ----------
    links
        Number of links.
    frames
        Link index of each frame, and the frame's pose in the link.

    Attributes
    ----------
    poses
        (k, 7) frame positions, m, and quaternions, updated in place by :meth:`update`.
    """

    def __init__(self, links: int, frames: Sequence[tuple[int, Pose]]) -> None:
        base, R, r = ca.SX.sym("base", 7), ca.SX.sym("R", 3, 3 * links), ca.SX.sym("r", 3, links)
        R_WB, placed = matrix_from_quaternion(base[3:]), []
        for index, pose in frames:
            R_BL = R[:, 3 * index : 3 * index + 3]
            r_BF_B = r[:, index] + R_BL @ sparse_constant(pose.r)
            R_BF = R_BL @ sparse_constant(pose.R)
            placed += [base[:3] + R_WB @ r_BF_B, symbolic_quaternion(R_WB @ R_BF)]
        inputs = {"base": base, "link_R": R, "link_r": r}
        function = dense_function("placed", inputs, {"poses": ca.vertcat(*placed)})
        self._function = BufferedFunction(function)
        self._base, self._R, self._r = self._function.inputs
        self._r = self._r.reshape(3, links)  # For a single link, it is a vector.
        self.poses = self._function.outputs[0].reshape(len(frames), 7)

    def update(self, base: Array, link_R: Array, link_r: Array) -> None:
        """Place the frames.

        Parameters
        ----------
        base
            (7,) base link pose in W.
        link_R, link_r
            (3, 3 L) attitudes side by side and (3, L) link positions in B, m.
        """
        self._base[:], self._R[...], self._r[...] = base, link_R, link_r.reshape(self._r.shape)
        self._function.evaluate()


# -- numeric ------------------------------------------------------------------------------------

Frames = tuple[tuple[str, str], ...]
"""Names of each joint's parent and child links."""


def joints_outward(robot: RobotDescription) -> list[Joint]:
    """Return all joints, including fixed ones, from the base outward."""
    above = {joint.child: joint for joint in robot.joints}
    # The links of ``frames`` are in topological order.
    return [above[link] for link in robot.frames if link in above]


class ForwardKinematics:
    """Link poses of a robot from its joint positions.

    Transforms (k, 7) are rows of a position (m) followed by a quaternion (x, y, z, w). Quaternions
    depend on half the joint angle, so they are continuous over several revolutions.

    Parameters
    ----------
    robot
        The robot.

    Attributes
    ----------
    links
        Link names, with the base link first and each link after its parent.
    moving, fixed
        Parent and child of each moving joint, and of each fixed joint.
    fixed_transforms
        Poses (m, 7) of the fixed children in their parents.
    """

    def __init__(self, robot: RobotDescription) -> None:
        names = list(robot.joint_names)
        moving = [joint for joint in robot.joints if joint.kind is not JointKind.FIXED]
        fixed = [joint for joint in robot.joints if joint.kind is JointKind.FIXED]
        self.moving: Frames = tuple((joint.parent, joint.child) for joint in moving)
        self.fixed: Frames = tuple((joint.parent, joint.child) for joint in fixed)
        self.fixed_transforms = _transforms_at_zero(fixed)
        at_zero = _transforms_at_zero(moving)
        follows = [joint.mimic or Mimic(joint.name, 1.0, 0.0) for joint in moving]
        self._index = np.array([names.index(each.joint) for each in follows], dtype=int)
        self._factor = np.array([each.multiplier for each in follows])
        self._offset = np.array([each.offset for each in follows])
        slides = np.array([joint.kind is JointKind.PRISMATIC for joint in moving], dtype=bool)
        axes = np.array([joint.axis for joint in moving]).reshape(-1, 3)
        turned = np.array([joint.origin.R @ joint.axis for joint in moving]).reshape(-1, 3)
        self._position, self._cosine_part = at_zero[:, :3], at_zero[:, 3:]
        self._direction = np.where(slides[:, None], turned, 0.0)
        self._half = np.where(slides, 0.0, 0.5)
        about = np.hstack([axes, np.zeros((len(moving), 1))])
        self._sine_part = numeric_multiply(self._cosine_part, about).reshape(-1, 4)
        self.links = tuple(robot.frames)
        rows = {joint.child: row for row, joint in enumerate([*moving, *fixed])}
        self._tree = [
            (self.links.index(joint.parent), rows[joint.child]) for joint in joints_outward(robot)
        ]

    def transforms_at(self, q: Array) -> Array:
        """Return the poses (..., k, 7) of the moving child links in their parent frames at joint
        positions (..., n), m or rad.
        """
        moved = self._factor * q[..., self._index] + self._offset
        half = (self._half * moved)[..., None]
        position = self._position + moved[..., None] * self._direction
        attitude = np.cos(half) * self._cosine_part + np.sin(half) * self._sine_part
        return np.concatenate([position, attitude], axis=-1)

    def link_poses(self, q: Array) -> tuple[Array, Array]:
        """Return ``R_BL`` (..., L, 3, 3) and ``r_BL_B`` (..., L, 3), m, of all :attr:`links`.

        Parameters
        ----------
        q
            Joint positions (..., n), m or rad.
        """
        many = q.shape[:-1]
        fixed = np.broadcast_to(self.fixed_transforms, (*many, *self.fixed_transforms.shape))
        steps = np.concatenate([self.transforms_at(q), fixed], axis=-2)
        steps_R = matrices_from_quaternions(steps[..., 3:])
        R, r = np.zeros((*many, len(self.links), 3, 3)), np.zeros((*many, len(self.links), 3))
        R[..., 0, :, :] = np.eye(3)
        for link, (parent, row) in enumerate(self._tree, start=1):
            R[..., link, :, :] = R[..., parent, :, :] @ steps_R[..., row, :, :]
            step = R[..., parent, :, :] @ steps[..., row, :3, None]
            r[..., link, :] = r[..., parent, :] + step[..., 0]
        return R, r

    def poses_in_world(self, base: Array, q: Array) -> tuple[Array, Array]:
        """Return ``R_WL`` (..., L, 3, 3) and ``r_WL`` (..., L, 3), m, of all :attr:`links`.

        Parameters
        ----------
        base, q
            Base poses (..., 7) in the world, and joint positions (..., n).
        """
        R_BL, r_BL_B = self.link_poses(q)
        R_WB = matrices_from_quaternions(base[..., 3:])[..., None, :, :]
        return R_WB @ R_BL, base[..., None, :3] + (R_WB @ r_BL_B[..., None])[..., 0]

    def link_in_world(self, link: str, base: Array, q: Array) -> Array:
        """Return the pose (7,) of a link in the world, given a base pose (7,) and ``q`` (n,)."""
        R_WL, r_WL = self.poses_in_world(base, q)
        number = self.links.index(link)
        return np.concatenate([r_WL[number], quaternion_from_matrix(R_WL[number])])


def _transforms_at_zero(joints: Sequence[Joint]) -> Array:
    poses = [[*joint.origin.r, *quaternion_from_matrix(joint.origin.R)] for joint in joints]
    return np.array(poses, dtype=float).reshape(-1, 7)
