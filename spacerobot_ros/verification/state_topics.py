"""The topics on which a plant publishes its state, and what the plant says should be there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.series import TopicSeries
from spacerobot_ros.model.rotations import matrix_from_quaternion, quaternion_from_matrix
from spacerobot_ros.simulation.plant import Plant
from spacerobot_ros.simulation.sensors import Sensors

_POSITION = ("position.x", "position.y", "position.z")
_ORIENTATION = ("orientation.x", "orientation.y", "orientation.z", "orientation.w")
_LEDGER = ("linear x", "linear y", "linear z", "angular x", "angular y", "angular z")
_TWIST = tuple(f"twist.twist.{part}.{axis}" for part in ("linear", "angular") for axis in "xyz")
_MEASURED = ("measured_pose", "measured_twist")
_ARRAY = "std_msgs/msg/Float64MultiArray"
_POSE = "geometry_msgs/msg/PoseStamped"


@dataclass(frozen=True)
class StateTopic:
    """One topic of the state.

    `fields` are the paths of its numbers; `parts` which parts of `snapshot` they are, `labels` what
    each number is called, `quaternion` where one begins: its sign means nothing.
    """

    name: str
    type_name: str
    fields: tuple[str, ...]
    parts: tuple[str, ...]
    labels: tuple[str, ...]
    quaternion: int | None = None

    def recorded(self, series: TopicSeries) -> NDArray[np.float64]:
        """Read the numbers of every message, shape (N, len(labels)).

        A message with another number of values than it should have is all NaN.

        Raises:
            RecordingError: a message is damaged.
        """
        width = len(self.labels) // len(self.fields)
        columns = [_column(series.field(field), width) for field in self.fields]
        if not columns or not width:
            return np.empty((len(series), 0))
        table = np.column_stack(columns)
        table[np.isnan(table).any(axis=1)] = np.nan
        return table


def state_topics(joints: Sequence[str], end_effector: str) -> list[StateTopic]:
    """List the topics; a deviation of a joint is looked for first, for it explains the others.

    Args:
        joints: names of the joints, in the order of the plant.
        end_effector: name of the link whose pose is published; empty for none.
    """
    pose = (*_POSITION, *_ORIENTATION)
    odom = (*(f"pose.pose.{field}" for field in pose), *_TWIST)
    quantities = ("position", "velocity", "effort")
    joint_labels = tuple(f"{quantity} of {name}" for quantity in quantities for name in joints)
    topics = [
        StateTopic(
            "joint_states",
            "sensor_msgs/msg/JointState",
            quantities,
            ("measured_q", "measured_qdot", "effort"),
            joint_labels,
        ),
        StateTopic("odom", "nav_msgs/msg/Odometry", odom, _MEASURED, odom, 3),
        _pose_topic("base_pose", "pose"),
        StateTopic("momentum", _ARRAY, ("data",), ("momentum",), (*_LEDGER, "kinetic energy")),
        StateTopic("momentum_expected", _ARRAY, ("data",), ("expected",), _LEDGER),
    ]
    if end_effector:
        topics.append(_pose_topic("end_effector_pose", "end_effector"))
    return topics


def _pose_topic(name: str, part: str) -> StateTopic:
    fields = tuple(f"pose.{field}" for field in (*_POSITION, *_ORIENTATION))
    return StateTopic(name, _POSE, fields, (part,), fields, 3)


def snapshot(
    plant: Plant, sensors: Sensors, end_effector: int | None
) -> dict[str, NDArray[np.float64]]:
    """Give the parts of a plant's state that are published.

    Args:
        plant: the plant.
        sensors: what it has measured of itself.
        end_effector: number of the link whose pose is published, if one is.
    """
    source = sensors if sensors.used else plant
    parts = {
        "measured_q": source.q,
        "measured_qdot": source.qdot,
        "measured_pose": source.pose,
        "measured_twist": source.twist,
        "effort": plant.effort,
        "pose": plant.pose,
        "momentum": plant.momentum,
        "expected": plant.expected_momenta,
    }
    if end_effector is not None:
        R_WB, r_WB = matrix_from_quaternion(plant.pose[3:]), plant.pose[:3]
        r_WE = r_WB + R_WB @ plant.link_r[:, end_effector]
        R_WE = R_WB @ plant.link_R[:, 3 * end_effector : 3 * end_effector + 3]
        parts["end_effector"] = np.concatenate([r_WE, quaternion_from_matrix(R_WE)])
    return parts


def _column(values: NDArray[np.float64] | list[object], width: int) -> NDArray[np.float64]:
    if isinstance(values, np.ndarray) and values.size == len(values) * width:
        return np.asarray(values, dtype=float).reshape(len(values), width)
    rows = [np.asarray(v, dtype=float).reshape(-1) for v in values]
    return np.array([row if row.size == width else np.full(width, np.nan) for row in rows])
