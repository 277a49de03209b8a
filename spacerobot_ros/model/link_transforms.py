"""Where the links of a robot are relative to each other: the transforms of its joints, in numbers.

Viewers want each link relative to its parent, and no equations: nothing is compiled here.
"""

from __future__ import annotations

import numpy as np

from spacerobot_ros.model.description import Array, Joint, JointKind, Mimic, RobotDescription
from spacerobot_ros.model.rotations import quaternion_from_matrix, quaternion_multiply

Frames = tuple[tuple[str, str], ...]
"""Names of parent and child of some transforms."""


class LinkTransforms:
    """The pose of each link in its parent's frame.

    Poses are positions (m) and quaternions (x, y, z, w) side by side: (k, 7). A quaternion turns
    by half the angle of its joint: it is continuous over several turns.

    Parameters
    ----------
    description
        The robot.

    Attributes
    ----------
    moving, fixed
        Names of parent and child of the joints that move, and of those that do not.
    poses, fixed_poses
        The poses of the same: (k, 7), which :meth:`update` changes in place, and (m, 7).
    """

    def __init__(self, description: RobotDescription) -> None:
        names = list(description.joint_names)
        moving = [joint for joint in description.joints if joint.kind is not JointKind.FIXED]
        fixed = [joint for joint in description.joints if joint.kind is JointKind.FIXED]
        self.moving: Frames = tuple((joint.parent, joint.child) for joint in moving)
        self.fixed: Frames = tuple((joint.parent, joint.child) for joint in fixed)
        self.fixed_poses = np.array([_at_zero(joint) for joint in fixed]).reshape(-1, 7)
        self.poses = np.array([_at_zero(joint) for joint in moving]).reshape(-1, 7)
        follows = [joint.mimic or Mimic(joint.name, 1.0, 0.0) for joint in moving]
        self._index = np.array([names.index(each.joint) for each in follows], dtype=int)
        self._factor = np.array([each.multiplier for each in follows])
        self._offset = np.array([each.offset for each in follows])
        slides = np.array([joint.kind is JointKind.PRISMATIC for joint in moving], dtype=bool)
        axes = np.array([joint.axis for joint in moving]).reshape(-1, 3)
        turned = np.array([joint.origin.R @ joint.axis for joint in moving]).reshape(-1, 3)
        self._position = self.poses[:, :3].copy()
        self._direction = np.where(slides[:, None], turned, 0.0)
        self._half = np.where(slides, 0.0, 0.5)
        self._cosine_part = self.poses[:, 3:].copy()
        about = np.hstack([axes, np.zeros((len(moving), 1))])
        self._sine_part = quaternion_multiply(self._cosine_part, about).reshape(-1, 4)

    def update(self, q: Array) -> None:
        """Place the links for the positions (n,) of the joints, m or rad."""
        moved = self._factor * q[self._index] + self._offset
        half = self._half * moved
        self.poses[:, :3] = self._position + moved[:, None] * self._direction
        self.poses[:, 3:] = (
            np.cos(half)[:, None] * self._cosine_part + np.sin(half)[:, None] * self._sine_part
        )


def _at_zero(joint: Joint) -> Array:
    return np.concatenate([joint.origin.r, quaternion_from_matrix(joint.origin.R)])
