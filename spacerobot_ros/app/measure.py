"""What a run came to, measured from what the plant published."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spacerobot_ros.model.attitude import rotvec_from_quaternion
from spacerobot_ros.model.description import Array
from spacerobot_ros.planning import Goal, PoseError
from spacerobot_ros.recording import Bag, RecordingError, TopicSeries


@dataclass(frozen=True)
class Measured:
    """Time series of a bag: ``time`` (N,) s, base ``position`` (N, 3) m and ``quaternion`` (N, 4),
    ``joints`` and ``joint_rates`` (N, n), ``momentum`` (N, 7) as on the topic.
    """

    time: Array
    position: Array
    quaternion: Array
    joint_names: list[str]
    joints: Array
    joint_rates: Array
    momentum: Array
    expected: Array
    """Momenta (N, 6) by what the run began with and the thrusters gave."""
    end_effector: tuple[Array, Array] | None = None
    """Its last position (3,) and quaternion (4,), where it was published."""

    @classmethod
    def of(cls, bag: Bag, namespace: str = "") -> Measured:
        """Take the series out of a bag.

        Raises
        ------
        RecordingError
            A topic is missing or empty.
        """
        topics = [f"{namespace}/{name}" for name in ("odom", "joint_states", "momentum")]
        for topic in topics:
            if topic not in bag.topics or not bag.message_count(topic):
                raise RecordingError(f"The bag holds no message on {topic}: no plant was recorded.")
        odom, joints, momentum = (bag[topic] for topic in topics)
        pose = "pose.pose"
        return cls(
            time=odom.stamp,
            position=np.column_stack([odom.field(f"{pose}.position.{x}") for x in "xyz"]),
            quaternion=np.column_stack([odom.field(f"{pose}.orientation.{x}") for x in "xyzw"]),
            joint_names=list(next(joints.messages())[1].name),
            joints=np.asarray(joints.field("position")),
            joint_rates=np.asarray(joints.field("velocity")),
            momentum=np.asarray(momentum.field("data")),
            expected=_expected(bag, f"{namespace}/momentum_expected", momentum),
            end_effector=_last_pose(bag, f"{namespace}/end_effector_pose"),
        )

    @property
    def linear_drift(self) -> float:
        """Largest change of the total linear momentum without thrust, kg m/s."""
        return _largest_change(self.momentum[:, :3] - self.expected[:, :3])

    @property
    def angular_drift(self) -> float:
        """Largest change of the total angular momentum without thrust, kg m^2/s."""
        return _largest_change(self.momentum[:, 3:6] - self.expected[:, 3:6])

    def rotvecs(self) -> Array:
        """Return the attitude as exponential coordinates (N, 3), rad."""
        return np.array([rotvec_from_quaternion(q) for q in self.quaternion])

    def final_error(self, goal: Goal) -> PoseError:
        """Return what the last pose leaves to the goal."""
        return PoseError.between(self.position[-1], self.quaternion[-1], goal)


def _expected(bag: Bag, topic: str, momentum: TopicSeries) -> Array:
    """Where there are no thrusters nothing is published, and nothing is to change."""
    if topic in bag.topics and bag.message_count(topic) == len(momentum):
        return np.asarray(bag[topic].field("data"))
    return np.zeros((len(momentum), 6))


def _last_pose(bag: Bag, topic: str) -> tuple[Array, Array] | None:
    if topic not in bag.topics or not bag.message_count(topic):
        return None
    series = bag[topic]
    position = np.array([series.field(f"pose.position.{x}")[-1] for x in "xyz"])
    return position, np.array([series.field(f"pose.orientation.{x}")[-1] for x in "xyzw"])


def _largest_change(vectors: Array) -> float:
    return float(np.linalg.norm(vectors - vectors[0], axis=1).max())
