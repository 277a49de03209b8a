"""The last state of a plant that a bag holds, whole or cut off: to go on from there."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.errors import RecordingError
from spacerobot_ros.bag.reader import Bag, read_bag
from spacerobot_ros.bag.salvage import is_complete, salvage_bag

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LastState:
    """A recorded state: `time_ns` is its stamp; `position` (3,) m and `quaternion` (x, y, z, w) are
    of the base link in the world, `joints` and `rates` by `joint_names`, `momenta` (6,) linear over
    angular momentum in the world.
    """

    time_ns: int
    position: Array
    quaternion: Array
    joint_names: list[str]
    joints: Array
    rates: Array
    momenta: Array


def last_state(path: str | os.PathLike[str], namespace: str = "") -> LastState:
    """Read the last state of which everything was recorded.

    Args:
        path: the bag; of one that was cut off, what can be read counts.
        namespace: of the plant's topics, such as `/robot_1`.

    Raises:
        RecordingError: there is no such bag, or no state in it.
    """
    source = Path(path)
    if is_complete(source):
        return _last_state(read_bag(source), namespace)
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        whole = Path(folder, source.name)
        salvage_bag(source, whole)
        return _last_state(read_bag(whole), namespace)


def _last_state(bag: Bag, namespace: str) -> LastState:
    topics = [f"{namespace}/{name}" for name in ("odom", "joint_states", "momentum")]
    for topic in topics:
        if topic not in bag.topics or not bag.message_count(topic):
            raise RecordingError(f"The bag {bag.path} holds no state: nothing is on {topic}.")
    odom, joints, momentum = (bag[topic] for topic in topics)
    # Momenta have no stamp; a state is published momenta first, and logged at its time.
    common = set(odom.stamp.tolist()) & set(joints.stamp.tolist())
    if not common:
        raise RecordingError(f"The bag {bag.path} holds no state of which all parts are there.")
    stamp = max(common)
    k, j = (int(np.flatnonzero(series.stamp == stamp)[-1]) for series in (odom, joints))
    m = min(k, len(momentum) - 1)
    pose = "pose.pose"
    return LastState(
        time_ns=round(stamp * 1e9),
        position=np.array([odom.field(f"{pose}.position.{x}")[k] for x in "xyz"]),
        quaternion=np.array([odom.field(f"{pose}.orientation.{x}")[k] for x in "xyzw"]),
        joint_names=list(next(joints.messages())[1].name),
        joints=np.asarray(joints.field("position"))[j],
        rates=np.asarray(joints.field("velocity"))[j],
        momenta=np.asarray(momentum.field("data"))[m, :6],
    )
