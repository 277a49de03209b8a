"""Grasp of a floating body by a floating robot, modelled as an inelastic impact.

The equations are derived in docs/theory/capture.md. The grasp impulse makes the velocities of the
end-effector and the grasped point equal. The joints are free: no motor or brake exerts an impulse.
Momentum is conserved, because the impulse acts on the robot and the body with opposite signs. The
formulation follows Yoshida and Nenchev, and Dimitrov and Yoshida.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.description import Array, Inertia, Pose, RobotDescription
from spacerobot_ros.model.inertial_parameters import INERTIA_ENTRIES, symmetric_of_entries
from spacerobot_ros.model.rotations import (
    cross,
    hat,
    matrix_from_quaternion,
    quaternion_from_matrix,
    rotvec_from_quaternion,
    unit_quaternion,
)
from spacerobot_ros.model.space_robot import SpaceRobot

_GENERIC_POSE = Pose(matrix_from_quaternion(unit_quaternion([0.1, 0.2, 0.3, 0.9])), np.ones(3))
"""A pose in which no inertia entry of a held body is zero."""


@dataclass(frozen=True)
class Payload:
    """A body held by a robot link.

    Attributes
    ----------
    link
        Name of the link.
    inertia
        Mass properties of the body in the link frame.
    """

    link: str
    inertia: Inertia

    @classmethod
    def in_generic_pose(cls, link: str, inertia: Inertia) -> Payload:
        """Return a body, with its inertia in its own frame, in a pose without zero inertia entries.

        Robots that hold the body in any pose use the functions that this one compiles.
        """
        return cls(link, inertia.moved(_GENERIC_POSE))

    def attached_to(self, robot: SpaceRobot) -> SpaceRobot:
        """Return the robot that holds the body: joints, links and limits are unchanged.

        Raises
        ------
        RobotDescriptionError
            The robot has no such link, or the inertia is not physical.
        """
        frames = robot.description.frames
        if self.link not in frames:
            raise RobotDescriptionError(
                f"The payload is held by link '{self.link}', but robot '{robot.description.name}' "
                f"has no such link; it has {', '.join(robot.link_names)}."
            )
        body, pose = frames[self.link]
        return robot.with_inertial(robot.inertial.with_payload(body, self.inertia.moved(pose)))

    def to_text(self) -> str:
        """Return the payload as JSON: ``link``, ``mass`` (kg), ``com`` (m), ``inertia`` (kg m^2),
        entries xx, yy, zz, xy, xz, yz about the centre of mass.
        """
        about = self.inertia.about_com
        return json.dumps(
            {
                "link": self.link,
                "mass": self.inertia.mass,
                "com": self.inertia.com.tolist(),
                "inertia": [float(about[i, j]) for i, j in INERTIA_ENTRIES],
            }
        )

    @classmethod
    def from_text(cls, text: str) -> Payload:
        """Return the payload from the output of :meth:`to_text`.

        Raises
        ------
        RobotDescriptionError
            The string does not describe a payload.
        """
        try:
            values = json.loads(text)
            about = symmetric_of_entries(values["inertia"])
            com = np.array([float(x) for x in values["com"]])
            if com.shape != (3,):
                raise ValueError(f"its centre of mass has {com.size} numbers")
            return cls(str(values["link"]), Inertia(float(values["mass"]), com, about))
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise RobotDescriptionError(
                f"The string does not describe a payload: {error}."
            ) from error


@dataclass(frozen=True)
class TargetBody:
    """A rigid body that can be captured.

    Attributes
    ----------
    inertia
        Mass properties in its root link frame T.
    grapple
        Pose of the grapple frame G in T.
    """

    inertia: Inertia
    grapple: Pose

    @cached_property
    def least_inertia(self) -> float:
        """Smallest principal moment of inertia, kg m^2."""
        return float(np.linalg.eigvalsh(self.inertia.about_com)[0])

    @cached_property
    def numbers(self) -> Array:
        """Mass, inertia (6,) about the centre of mass by rows of its upper triangle, and the
        grapple frame's position (3,) relative to that point and quaternion (4,), in T."""
        inertia, grapple = self.inertia, self.grapple
        about, arm = inertia.about_com[np.triu_indices(3)], grapple.r - inertia.com
        return np.concatenate([[inertia.mass], about, arm, quaternion_from_matrix(grapple.R)])

    @classmethod
    def of(cls, target: RobotDescription, grapple_frame: str) -> TargetBody:
        """Return the body from a robot description, with one of the links as the grapple frame.

        Raises
        ------
        RobotDescriptionError
            The description has movable joints, or no such link.
        """
        if target.joint_names:
            raise RobotDescriptionError(
                f"The target '{target.name}' has movable joints "
                f"({', '.join(target.joint_names)}); a target must be one rigid body: make them "
                "fixed."
            )
        if grapple_frame not in target.frames:
            raise RobotDescriptionError(
                f"The target '{target.name}' has no link '{grapple_frame}' to grasp; its links "
                f"are {', '.join(target.frames)}: set parameter 'target.grapple_frame', or add the "
                "link."
            )
        return cls(target.bodies[0].inertia, target.frames[grapple_frame][1])


@dataclass(frozen=True)
class RobotMotion:
    """A robot's state of motion.

    Attributes
    ----------
    pose
        (7,) base link position ``r_WB`` in m and quaternion ``R_WB`` (x, y, z, w).
    twist
        (6,) ``v_WB_B`` in m/s and ``omega_WB_B`` in rad/s.
    q, qdot
        (n,) joint positions (m or rad) and velocities (per second).
    """

    pose: Array
    twist: Array
    q: Array
    qdot: Array

    @classmethod
    def at_rest(cls, pose: Array, q: Array) -> RobotMotion:
        """Return a state at rest."""
        return cls(pose, np.zeros(6), q, np.zeros(len(q)))

    @property
    def R_WB(self) -> Array:
        """Base link attitude (3, 3)."""
        return matrix_from_quaternion(self.pose[3:])


@dataclass(frozen=True)
class BodyMotion:
    """A rigid body's state of motion, in W.

    Attributes
    ----------
    R_WT, r_WT
        Attitude (3, 3) and position (3,), m, of the body frame T.
    v, omega
        Velocity of the origin of T (3,), m/s, and angular velocity (3,), rad/s.
    """

    R_WT: Array
    r_WT: Array
    v: Array
    omega: Array

    @classmethod
    def of(cls, pose: Array, twist: Array) -> BodyMotion:
        """Return the motion from a pose (7,) in W and a twist (6,) in T, linear part first."""
        R = matrix_from_quaternion(pose[3:])
        return cls(R, pose[:3].copy(), R @ twist[:3], R @ twist[3:])

    def at(self, frame: Pose) -> BodyMotion:
        """Return the motion of a frame fixed to the body at the given pose in T."""
        arm = self.R_WT @ frame.r
        return BodyMotion(
            self.R_WT @ frame.R, self.r_WT + arm, self.v + cross(self.omega, arm), self.omega
        )

    def momenta(self, inertia: Inertia) -> tuple[Array, Array]:
        """Return the linear momentum (kg m/s), and the angular momentum (kg m^2/s) about the body's
        centre of mass, in W. ``inertia`` is given in T.
        """
        moving = self.at(Pose(r=inertia.com))
        return inertia.mass * moving.v, self.R_WT @ inertia.about_com @ self.R_WT.T @ self.omega

    def with_momenta(self, inertia: Inertia, momenta: Array) -> BodyMotion:
        """Return the motion at the same pose with different :meth:`momenta` (6,), linear first."""
        R = self.R_WT
        omega = R @ np.linalg.solve(inertia.about_com, R.T @ momenta[3:])
        v = momenta[:3] / inertia.mass - cross(omega, R @ inertia.com)
        return BodyMotion(R, self.r_WT, v, omega)


@dataclass(frozen=True)
class RelativeMotion:
    """Motion of one frame relative to another.

    Attributes
    ----------
    distance, angle
        Distance (m) between the frame origins, and angle (rad) between the frame attitudes.
    speed, rate
        Relative speed of the origins (m/s), and relative angular rate (rad/s).
    """

    distance: float
    angle: float
    speed: float
    rate: float

    @classmethod
    def between(cls, first: BodyMotion, second: BodyMotion) -> RelativeMotion:
        """Return the relative motion of two frames."""
        turn = quaternion_from_matrix(first.R_WT.T @ second.R_WT)
        return cls(
            float(np.linalg.norm(second.r_WT - first.r_WT)),
            float(np.linalg.norm(rotvec_from_quaternion(turn))),
            float(np.linalg.norm(second.v - first.v)),
            float(np.linalg.norm(second.omega - first.omega)),
        )


@dataclass(frozen=True)
class GraspImpact:
    """Result of a grasp.

    Attributes
    ----------
    twist, qdot
        Base twist (6,) and joint rates (n,) after the grasp, as in :class:`RobotMotion`.
    impulse
        (6,) impulse on the robot at the end-effector origin: N s and N m s, in W.
    joint_impulses
        (n,) ``J_q' L``, the impulses that motors or brakes would have to apply to the joints to
        keep their rates constant; N s or N m s.
    energy_before, energy_lost
        Total kinetic energy before the grasp, and the energy lost, J.
    """

    twist: Array
    qdot: Array
    impulse: Array
    joint_impulses: Array
    energy_before: float
    energy_lost: float


def frame_motion(robot: SpaceRobot, link: str, motion: RobotMotion) -> BodyMotion:
    """Return the motion of a link frame."""
    R_BL, r_BL = robot.link_pose(link, motion.q)
    R_WB = motion.R_WB
    velocities = np.concatenate([motion.twist, motion.qdot])
    twist = _jacobian_of_base_twist(robot, link, motion.q) @ velocities
    return BodyMotion(
        R_WB @ R_BL, motion.pose[:3] + R_WB @ r_BL, R_WB @ twist[:3], R_WB @ twist[3:]
    )


def grasp_impact(
    robot: SpaceRobot, link: str, motion: RobotMotion, body: BodyMotion, inertia: Inertia
) -> GraspImpact:
    """Return the impact of a link that grasps a floating body, both at their current poses.

    Parameters
    ----------
    robot
        The robot.
    link
        The end-effector; the impulse is given at the origin of the end-effector frame.
    motion, body
        The motions before the grasp.
    inertia
        Mass properties of the body in the body frame T.
    """
    q, n, R_WB = motion.q, robot.n, motion.R_WB
    to_cm = _to_velocity_of_cm(robot, q)
    H = to_cm.T @ robot.inertia_matrix(q) @ to_cm
    J, z = _jacobian_of_base_twist(robot, link, q), np.concatenate([motion.twist, motion.qdot])
    center, R_BT = body.at(Pose(r=inertia.com)), R_WB.T @ body.R_WT
    nu = np.concatenate([R_WB.T @ center.v, R_WB.T @ center.omega])
    M = np.zeros((6, 6))
    M[:3, :3] = inertia.mass * np.eye(3)
    M[3:, 3:] = R_BT @ inertia.about_com @ R_BT.T
    point = motion.pose[:3] + R_WB @ robot.link_pose(link, q)[1]
    G = np.eye(6)
    G[:3, 3:] = -hat(R_WB.T @ (point - center.r_WT))
    by_robot, by_body = np.linalg.solve(H, J.T), np.linalg.solve(M, G.T)
    approach = G @ nu - J @ z
    L = np.linalg.solve(J @ by_robot + G @ by_body, approach)
    after = z + by_robot @ L
    return GraspImpact(
        twist=after[:6],
        qdot=after[6:],
        impulse=np.concatenate([R_WB @ L[:3], R_WB @ L[3:]]),
        joint_impulses=J[:, 6 : 6 + n].T @ L,
        energy_before=float(z @ H @ z + nu @ M @ nu) / 2,
        energy_lost=float(approach @ L) / 2,
    )


def combined_momenta(
    masses: tuple[float, float], centers: tuple[Array, Array], momenta: tuple[Array, Array]
) -> Array:
    """Return the combined momenta (6,) of two systems.

    Parameters
    ----------
    masses
        Masses of the two systems, kg.
    centers
        Centres of mass of the two systems in W (3,), m.
    momenta
        Linear and angular momentum (6,) of each system about its own centre of mass, in W; the
        result is about the combined centre of mass.
    """
    first, second = momenta
    arm = centers[1] - centers[0]
    # About the common centre of mass, only the relative motion counts.
    share = masses[0] / (masses[0] + masses[1])
    relative = share * second[:3] - (1.0 - share) * first[:3]
    return np.concatenate([first[:3] + second[:3], first[3:] + second[3:] + cross(arm, relative)])


def separated_momenta(
    masses: tuple[float, float], centers: tuple[Array, Array], together: Array, second: Array
) -> Array:
    """Return the momenta (6,) of the first system from the combined momenta and the momenta of the
    second system.

    This is the inverse of :func:`combined_momenta`, with the same arguments.
    """
    share = masses[0] / (masses[0] + masses[1])
    linear = together[:3] - second[:3]
    relative = share * second[:3] - (1.0 - share) * linear
    arm = centers[1] - centers[0]
    return np.concatenate([linear, together[3:] - second[3:] - cross(arm, relative)])


def _to_velocity_of_cm(robot: SpaceRobot, q: npt.ArrayLike) -> Array:
    """Return the map (6 + n, 6 + n) of ``[v_WB_B; omega; qdot]`` to ``[v_cm; omega; qdot]``.

    The functions of the model take the velocity of the robot's centre of mass. The Jacobian of the
    base link's origin is the inverse map.
    """
    to_cm = np.eye(6 + robot.n)
    to_cm[:3, 3:] = -robot.jacobian(robot.base_link, q)[:3, 3:]
    return to_cm


def _jacobian_of_base_twist(robot: SpaceRobot, link: str, q: npt.ArrayLike) -> Array:
    return np.asarray(robot.jacobian(link, q) @ _to_velocity_of_cm(robot, q))
