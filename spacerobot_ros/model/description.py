"""Robot description: rigid links and the joints between them, as read from a URDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder, XMLParser, fromstring

import numpy as np

from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.model.rotations import Array as Array
from spacerobot_ros.model.rotations import matrix_about_axis

_PARALLEL_TOLERANCE = 1e-6
"""Sine of the largest angle between axes considered parallel."""

DEFAULT_END_EFFECTOR = "end_effector"
"""Default end-effector link name."""


class JointKind(str, Enum):
    """URDF joint types allowed in a free-floating tree."""

    REVOLUTE = "revolute"
    CONTINUOUS = "continuous"
    PRISMATIC = "prismatic"
    FIXED = "fixed"


@dataclass(frozen=True)
class JointLimits:
    """Joint position, rate and effort limits (m or rad, /s, N or N m); infinite if unlimited."""

    lower: float = -np.inf
    upper: float = np.inf
    velocity: float = np.inf
    effort: float = np.inf


@dataclass(frozen=True)
class Pose:
    """Pose of a frame in its parent: rotation matrix ``R`` (3, 3) and position ``r`` (3,) in m."""

    R: Array = field(default_factory=lambda: np.eye(3))
    r: Array = field(default_factory=lambda: np.zeros(3))

    def __matmul__(self, child: Pose) -> Pose:
        """Chain two poses."""
        return Pose(self.R @ child.R, self.r + self.R @ child.r)


@dataclass(frozen=True)
class Inertia:
    """Mass (kg), centre of mass (3,) in m, and inertia (3, 3) about the centre of mass in kg m^2,
    in a given frame."""

    mass: float = 0.0
    com: Array = field(default_factory=lambda: np.zeros(3))
    about_com: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def moved(self, pose: Pose) -> Inertia:
        """Return the inertia in another frame, in which the pose of the current frame is
        ``pose``."""
        return Inertia(self.mass, pose.r + pose.R @ self.com, pose.R @ self.about_com @ pose.R.T)

    def __add__(self, other: Inertia) -> Inertia:
        """Return the inertia of two welded bodies given in one frame (parallel-axis theorem)."""
        mass = self.mass + other.mass
        com = (self.mass * self.com + other.mass * other.com) / mass if mass > 0 else np.zeros(3)
        about = np.zeros((3, 3))
        for part in (self, other):
            d = part.com - com
            about = about + part.about_com + part.mass * (d @ d * np.eye(3) - np.outer(d, d))
        return Inertia(mass, com, about)


@dataclass(frozen=True)
class Shape:
    """A visual or collision primitive of a link.

    ``kind`` is ``box`` (sizes x, y, z), ``cylinder`` (radius, length), ``sphere`` (radius),
    ``capsule`` (radius, and length of its cylinder) or ``mesh`` (scale x, y, z; ``resource`` is its
    URI); sizes in m, ``rgba`` in 0..1.
    """

    kind: str
    size: tuple[float, ...]
    pose: Pose
    rgba: tuple[float, float, float, float] = (0.6, 0.6, 0.65, 1.0)
    resource: str = ""


@dataclass(frozen=True)
class Link:
    """A named frame with mass properties, visuals and collision shapes, all optional."""

    name: str
    inertia: Inertia = field(default_factory=Inertia)
    shapes: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()


@dataclass(frozen=True)
class Mimic:
    """Mimic joint coupling: position = ``multiplier`` times ``joint`` plus ``offset``."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint between two links; ``origin`` is the child's pose at joint position zero, ``axis`` a
    unit vector.

    A joint with ``mimic`` follows another joint, so the position of the mimic joint is not a
    coordinate. If ``wheel`` is set, the child link is a reaction wheel.
    """

    name: str
    kind: JointKind
    parent: str
    child: str
    origin: Pose
    axis: Array
    limits: JointLimits
    mimic: Mimic | None = None
    wheel: bool = False

    @property
    def unit(self) -> str:
        """Unit of the joint position: m or rad."""
        return "m" if self.kind is JointKind.PRISMATIC else "rad"

    def locked(self, position: float) -> Joint:
        """Return a fixed joint that holds the child link at this joint's ``position``."""
        moved = Pose(r=position * self.axis)
        if self.kind is not JointKind.PRISMATIC:
            moved = Pose(matrix_about_axis(self.axis, position))
        return replace(
            self,
            kind=JointKind.FIXED,
            origin=self.origin @ moved,
            limits=JointLimits(),
            mimic=None,
            wheel=False,
        )


@dataclass(frozen=True)
class Body:
    """A rigid body: links connected by fixed joints, in the frame of the first link.

    ``joint`` is the movable joint that carries the body (None for the base), ``parent`` is the
    index of the parent body, and ``origin`` is the pose of the body frame in the parent body's
    frame at joint position zero.
    """

    name: str
    inertia: Inertia
    joint: Joint | None
    parent: int
    origin: Pose


@dataclass(frozen=True)
class RobotDescription:
    """A free-floating link tree; the root link is the base body (the spacecraft).

    ``bodies`` are in topological order, with the base first; the movable joints are those of
    ``bodies[1:]`` that are not mimic joints, in that order. ``frames`` maps every link to its body
    and its pose in that body. ``disabled_collisions`` are link pairs excluded from collision
    checks. ``world`` contains the obstacles around the robot; its root link is the frame W; None if
    there are no obstacles.
    """

    name: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...]
    bodies: tuple[Body, ...]
    frames: dict[str, tuple[int, Pose]]
    urdf: str
    disabled_collisions: frozenset[frozenset[str]] = frozenset()
    world: RobotDescription | None = None

    @property
    def base_link(self) -> str:
        """Root link name."""
        return self.bodies[0].name

    @cached_property
    def movable_joints(self) -> tuple[Joint, ...]:
        """Joints that are neither fixed nor mimic, in coordinate order."""
        return tuple(joint for joint in self.moving_joints if joint.mimic is None)

    @cached_property
    def moving_joints(self) -> tuple[Joint, ...]:
        """The joints of ``bodies[1:]``, including mimic joints."""
        return tuple(body.joint for body in self.bodies[1:] if body.joint is not None)

    @property
    def has_mimic_joints(self) -> bool:
        """Whether joints follow others."""
        return any(joint.mimic is not None for joint in self.moving_joints)

    @property
    def coupling(self) -> tuple[Array, Array]:
        """``G`` (m, n) and ``b`` (m,), with which the positions of the moving joints are ``G q +
        b``, m or rad."""
        names, moving = self.joint_names, self.moving_joints
        G, b = np.zeros((len(moving), len(names))), np.zeros(len(moving))
        for row, joint in enumerate(moving):
            if joint.mimic is None:
                G[row, names.index(joint.name)] = 1.0
            else:
                G[row, names.index(joint.mimic.joint)] = joint.mimic.multiplier
                b[row] = joint.mimic.offset
        return G, b

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the coordinates q."""
        return tuple(joint.name for joint in self.movable_joints)

    @property
    def wheel_names(self) -> tuple[str, ...]:
        """Names of the reaction wheel joints, in coordinate order."""
        return tuple(joint.name for joint in self.movable_joints if joint.wheel)

    @property
    def total_mass(self) -> float:
        """Mass of the whole system, kg."""
        return float(sum(body.inertia.mass for body in self.bodies))

    @cached_property
    def size(self) -> float:
        """Diameter of gyration of the whole system at zero joint positions, m."""
        poses = [Pose()]
        for body in self.bodies[1:]:
            poses.append(poses[body.parent] @ body.origin)
        masses = np.array([body.inertia.mass for body in self.bodies])
        at = np.array([p.r + p.R @ b.inertia.com for p, b in zip(poses, self.bodies, strict=True)])
        away = at - masses @ at / masses.sum()
        moments = sum(np.trace(body.inertia.about_com) for body in self.bodies)
        return float(2 * np.sqrt((moments / 2 + masses @ np.sum(away**2, axis=1)) / masses.sum()))

    def limits(self, kind: str) -> Array:
        """Return one kind of joint limit (n,): lower, upper, velocity or effort.

        Except for effort, the limits of a mimic joint also restrict the joint that it follows.
        """
        values: list[Any] = [getattr(joint.limits, kind) for joint in self.movable_joints]
        for joint in self.moving_joints:
            if joint.mimic is not None and kind != "effort":
                i = self.joint_names.index(joint.mimic.joint)
                bound = leading_limit(joint.limits, joint.mimic, kind)
                values[i] = (max if kind == "lower" else min)(values[i], bound)
        return np.array(values, dtype=float)

    @property
    def shape_box(self) -> tuple[Array, Array]:
        """Finite lower and upper bounds (n,) of joint positions: one revolution or 2 m for
        unlimited joints."""
        joints = self.movable_joints
        half = np.array([1.0 if x.kind is JointKind.PRISMATIC else np.pi for x in joints])
        lower, upper = self.limits("lower"), self.limits("upper")
        lower = np.where(np.isfinite(lower), lower, np.minimum(upper, half) - 2 * half)
        return lower, np.where(np.isfinite(upper), upper, lower + 2 * half)

    def end_effector(self, link: str = "") -> str:
        """Return the name of the end-effector link: ``link`` if it is given; otherwise
        ``end_effector`` if the robot has such a link; otherwise an empty string.
        """
        names = [each.name for each in self.links]
        return link or (DEFAULT_END_EFFECTOR if DEFAULT_END_EFFECTOR in names else "")

    def with_links(self, links: tuple[Link, ...]) -> RobotDescription:
        """Return the robot with links replaced by other links with the same names; ``urdf`` is
        unchanged."""
        return self._with_tree(links, self.joints)

    def with_locked(self, positions: Mapping[str, float]) -> RobotDescription:
        """Return the robot with the named joints fixed at positions (m or rad).

        Links and other joints keep their names and order; ``urdf`` is not changed.

        Raises
        ------
        KeyError
            A name does not belong to a movable joint.
        """
        unknown = set(positions) - set(self.joint_names)
        if unknown:
            raise KeyError(f"robot '{self.name}' has no movable joint '{min(unknown)}'")
        joints = []
        for joint in self.joints:
            follows = joint.mimic
            if joint.name in positions:
                joints.append(joint.locked(positions[joint.name]))
            elif follows is not None and follows.joint in positions:
                at = follows.multiplier * positions[follows.joint] + follows.offset
                joints.append(joint.locked(at))
            else:
                joints.append(joint)
        return self._with_tree(self.links, tuple(joints))

    def with_model_error(self, error: float, seed: int) -> RobotDescription:
        """Return the robot with random errors in all masses and inertias.

        Each value is multiplied by an independent factor, drawn uniformly from
        ``[1 - error, 1 + error]``. There are two factors per link, in link order. Inertia tensors
        remain physical, because the ratios of their principal moments are preserved; centres of
        mass do not change.
        """
        factors = np.random.default_rng(seed).uniform(1 - error, 1 + error, (len(self.links), 2))
        links = []
        for link, (mass, moment) in zip(self.links, factors, strict=True):
            true = link.inertia
            believed = Inertia(true.mass * float(mass), true.com, true.about_com * moment)
            links.append(replace(link, inertia=believed))
        return self.with_links(tuple(links))

    def _with_tree(self, links: tuple[Link, ...], joints: tuple[Joint, ...]) -> RobotDescription:
        bodies, frames = weld_links({link.name: link for link in links}, joints)
        return replace(self, links=links, joints=joints, bodies=tuple(bodies), frames=frames)


def leading_limit(limits: JointLimits, mimic: Mimic, kind: str) -> float:
    """Return the limit of a leading joint implied by a limit of its mimic joint."""
    k = mimic.multiplier
    if kind == "velocity":
        return limits.velocity / abs(k)
    bounds = sorted(((limits.lower - mimic.offset) / k, (limits.upper - mimic.offset) / k))
    return bounds[0] if kind == "lower" else bounds[1]


def editable_root(urdf: str) -> Element:
    """Return the root element of a URDF string, including comments, for editing.

    Raises
    ------
    xml.etree.ElementTree.ParseError
        The string is not XML.
    """
    return fromstring(urdf, XMLParser(target=TreeBuilder(insert_comments=True)))


def weld_links(
    links: Mapping[str, Link], joints: Sequence[Joint]
) -> tuple[list[Body], dict[str, tuple[int, Pose]]]:
    """Order the tree from the root, and merge links connected by fixed joints.

    Returns ``bodies`` and ``frames`` for a :class:`RobotDescription`.

    Raises
    ------
    RobotDescriptionError
        The links and joints do not form a tree.
    """
    children: dict[str, list[Joint]] = {name: [] for name in links}
    parents: dict[str, str] = {}
    for joint in joints:
        if joint.child in parents:
            raise RobotDescriptionError(
                f"Link '{joint.child}' is the child of two joints ('{parents[joint.child]}' and "
                f"'{joint.name}'); a robot is a tree: remove one of the joints."
            )
        parents[joint.child] = joint.name
        children[joint.parent].append(joint)
    roots = [name for name in links if name not in parents]
    if len(roots) != 1:
        found = ", ".join(f"'{name}'" for name in roots) or "none"
        mend = (
            f"Connect '{roots[1]}' by a joint, or remove it."
            if roots
            else "Remove a joint from the loop: the base must not be the child of any joint."
            if links
            else "Give it a <link>."
        )
        raise RobotDescriptionError(
            f"A robot must have exactly one root link (the base); found: {found}. {mend}"
        )

    bodies = [Body(roots[0], links[roots[0]].inertia, None, -1, Pose())]
    frames = {roots[0]: (0, Pose())}
    queue = [roots[0]]
    while queue:
        parent = queue.pop(0)
        index, parent_pose = frames[parent]
        for joint in children[parent]:
            inertia = links[joint.child].inertia
            pose = parent_pose @ joint.origin
            if joint.kind is JointKind.FIXED:
                body = bodies[index]
                welded = body.inertia + inertia.moved(pose)
                bodies[index] = Body(body.name, welded, body.joint, body.parent, body.origin)
                frames[joint.child] = (index, pose)
            else:
                frames[joint.child] = (len(bodies), Pose())
                bodies.append(Body(joint.child, inertia, joint, index, pose))
            queue.append(joint.child)
    if len(frames) != len(links):
        lost = sorted(set(links) - set(frames))
        raise RobotDescriptionError(
            f"Link '{lost[0]}' is not connected to the root: its joints form a loop. Remove one "
            "of the joints, and connect the remaining links to the robot."
        )
    return bodies, frames


def plane_normal(description: RobotDescription) -> Array | None:
    """Return the unit normal (3,) of a planar robot's plane of motion, in the base frame; None:
    spatial.

    A robot is planar if it has a revolute joint, the axes of all such joints are parallel, and the
    axes of all prismatic joints are perpendicular to them. All its bodies then move in parallel
    planes fixed in the base.
    """
    normal: Array | None = None
    rotations = [np.eye(3)]
    slides = []
    for body, joint in zip(description.bodies[1:], description.moving_joints, strict=True):
        # All rotations are about the normal, or the robot is spatial: shape q = 0 shows both.
        rotations.append(rotations[body.parent] @ body.origin.R)
        axis = rotations[-1] @ joint.axis
        if joint.kind is JointKind.PRISMATIC:
            slides.append(axis)
        elif normal is None:
            normal = axis
        elif np.linalg.norm(np.cross(normal, axis)) > _PARALLEL_TOLERANCE:
            return None
    if normal is None or any(abs(normal @ slide) > _PARALLEL_TOLERANCE for slide in slides):
        return None
    return normal
