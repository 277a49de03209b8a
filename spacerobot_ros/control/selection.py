"""Which outputs are controlled, and which are by default."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model.description import Array, JointKind, RobotDescription

AXES: tuple[str, ...] = ("x", "y", "z", "rx", "ry", "rz")
"""Components in W of a position and of a rotation."""

_PARALLEL = 1e-6


@dataclass(frozen=True)
class OutputSelection:
    """The components of ``z1`` (paper 4, eqs 22 and 31), in this order.

    ``base`` and ``end_effector``: components in W of the pose of the base link and of the link
    ``end_effector_link``, out of :data:`AXES`; ``joints``: names of joints.
    """

    base: tuple[str, ...] = ()
    end_effector: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    end_effector_link: str = ""

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each output: ``base.x``, ``end_effector.rz``, ``joint.elbow``."""
        return (
            *(f"base.{axis}" for axis in self.base),
            *(f"end_effector.{axis}" for axis in self.end_effector),
            *(f"joint.{name}" for name in self.joints),
        )

    def require_valid(self, description: RobotDescription) -> None:
        """Refuse what a robot does not have.

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
            raise ParameterError("No output is selected: name axes of the base, or joints.")
        if count > freedom:
            raise ParameterError(
                f"{count} outputs are selected; robot '{description.name}' has "
                f"{freedom} degrees of freedom."
            )


def default_selection(description: RobotDescription, end_effector_link: str) -> OutputSelection:
    """Return the outputs of a robot and the link that is its end-effector (empty: none).

    * A planar robot (:func:`plane_normal`) whose plane is a coordinate plane of its base: the base
      in that plane (x, y, rz for the plane x-y), and with two joints or more the position of the
      end-effector in it. The axes are those of W, so that the base is to fly in that plane.
    * Any other robot: the whole pose of the base, and of the end-effector its whole pose with six
      joints or more, its position with three to five.
    * Without an end-effector, or with too few joints for one: the pose of the base and the joints.

    So there are never more outputs than degrees of freedom.

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
    if normal is not None and np.max(np.abs(normal)) > 1 - _PARALLEL:
        along = int(np.argmax(np.abs(normal)))
        point = tuple(axis for i, axis in enumerate(AXES[:3]) if i != along)
        base, fewest = (*point, AXES[3 + along]), 2
    elif len(names) >= 6:
        point = AXES
    if not end_effector_link or len(names) < fewest:
        return OutputSelection(base=base, joints=names)
    selection = OutputSelection(base, point, (), end_effector_link)
    selection.require_valid(description)
    return selection


def plane_normal(description: RobotDescription) -> Array | None:
    """Return the unit normal (3,), base components, of the plane a robot moves in; None: spatial.

    A robot is planar if it has a joint that turns, the axes of all such joints are parallel, and
    those of all prismatic joints are perpendicular to them. Its bodies then move in parallel
    planes of the base.
    """
    normal: Array | None = None
    rotations = [np.eye(3)]
    slides = []
    for body in description.bodies[1:]:
        assert body.joint is not None
        # All turns are about the one normal, or the robot is spatial: the shape q = 0 tells both.
        rotations.append(rotations[body.parent] @ body.origin.R)
        axis = rotations[-1] @ body.joint.axis
        if body.joint.kind is JointKind.PRISMATIC:
            slides.append(axis)
        elif normal is None:
            normal = axis
        elif np.linalg.norm(np.cross(normal, axis)) > _PARALLEL:
            return None
    if normal is None or any(abs(normal @ slide) > _PARALLEL for slide in slides):
        return None
    return normal


def _require_known(what: str, names: Sequence[str], known: Sequence[str]) -> None:
    for name in names:
        if name not in known:
            raise ParameterError(f"There is no {what} '{name}'; there are: {', '.join(known)}.")
        if names.count(name) > 1:
            raise ParameterError(f"The {what} '{name}' is named twice.")
