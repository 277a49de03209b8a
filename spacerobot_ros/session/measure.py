"""What a run came to, measured from what the plant published."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spacerobot_ros.bag import Bag, RecordingError, TopicSeries
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.planning import Goal, PoseError

_POSE = [
    *(f"pose.pose.position.{axis}" for axis in "xyz"),
    *(f"pose.pose.orientation.{axis}" for axis in "xyzw"),
]


@dataclass(frozen=True)
class Measured:
    """Time series of a bag: ``time`` (N,) s, base ``position`` (N, 3) m and ``quaternion`` (N, 4),
    ``joints`` and ``joint_rates`` (N, n), ``momentum`` (N, 7) as on the topic. Of imperfect sensors
    they are the truth, which the plant publishes beside what is measured.
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
            if not (_holds(bag, topic) or _holds(bag, f"{topic}_true")):
                raise RecordingError(f"The bag holds no message on {topic}: no plant was recorded.")
        time, pose = _truth(bag, topics[0], _POSE)
        _, shapes = _truth(bag, topics[1], ["position", "velocity"])
        momentum = bag[topics[2]]
        n = shapes.shape[1] // 2
        return cls(
            time=time,
            position=pose[:, :3],
            quaternion=pose[:, 3:],
            joint_names=list(next(bag[topics[1]].messages())[1].name),
            joints=shapes[:, :n],
            joint_rates=shapes[:, n:],
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


def _holds(bag: Bag, topic: str) -> bool:
    return topic in bag.topics and bag.message_count(topic) > 0


def _truth(bag: Bag, topic: str, fields: Sequence[str]) -> tuple[Array, Array]:
    """Return times (N,) and fields (N, m): of ``<topic>_true`` from where that begins."""
    times: list[Array] = []
    rows: list[Array] = []
    begin = np.inf
    for name in (f"{topic}_true", topic):
        if _holds(bag, name):
            series = bag[name]
            before = series.stamp < begin
            values = np.column_stack([np.asarray(series.field(field)) for field in fields])
            times.insert(0, series.stamp[before])
            rows.insert(0, values[before])
            begin = series.stamp[0]
    return np.concatenate(times), np.concatenate(rows)


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
