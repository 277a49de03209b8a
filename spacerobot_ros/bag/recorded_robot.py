"""The topics of one robot in a bag: its measurements, and the last state to resume from."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from spacerobot_ros.bag.reader import Bag, read_bag
from spacerobot_ros.bag.salvage import is_complete, salvage_bag
from spacerobot_ros.bag.series import TopicSeries
from spacerobot_ros.errors import RecordingError
from spacerobot_ros.topics import TOPICS

Array = NDArray[np.float64]

_STATE = ("odom", "joint_states", "momentum")


def columns(topic: str, path: str) -> list[str]:
    """Return the paths of the numbers of a state topic below a path, for ``TopicSeries.table``."""
    return next(field.columns for field in TOPICS[topic].state if field.path == path)


class RecordedRobot:
    """The topics of one robot in a bag, by their names without its namespace.

    Parameters
    ----------
    bag
        What was recorded.
    namespace
        Of the robot's topics, such as ``/robot_1``; empty for none.
    """

    def __init__(self, bag: Bag, namespace: str = "") -> None:
        self.bag = bag
        self.namespace = namespace

    def get(self, name: str) -> TopicSeries | None:
        """Return a topic of the stack; None where it has no message, or is of another type."""
        topic = f"{self.namespace}/{name}"
        if self.bag.topics.get(topic) != TOPICS[name].type or not self.bag.message_count(topic):
            return None
        # What the summary counts need not be there.
        return self.bag[topic] if len(self.bag[topic]) else None

    def __getitem__(self, name: str) -> TopicSeries:
        """Return a topic of the stack.

        Raises
        ------
        RecordingError
            It has no message, is of another type, or is damaged.
        """
        series = self.get(name)
        if series is None:
            topic = f"{self.namespace}/{name}"
            raise RecordingError(f"The bag {self.bag.path} holds no state: nothing is on {topic}.")
        return series

    def truth(self, name: str, fields: list[str], width: int | None = None) -> tuple[Array, Array]:
        """Return what ``odom`` or ``joint_states`` would be with perfect sensors.

        That is ``<name>_true``, which a plant publishes while its sensors err, and ``name`` before
        that begins.

        Parameters
        ----------
        name
            ``odom`` or ``joint_states``.
        fields, width
            See :meth:`TopicSeries.table`.

        Returns
        -------
        Stamps (N,) in s, numbers (N, width).

        Raises
        ------
        RecordingError
            Neither has a message, or one is damaged.
        """
        true = self.get(f"{name}_true")
        if true is None:
            return self[name].stamp, self[name].table(fields, width)
        measured = self.get(name)
        if measured is None:
            return true.stamp, true.table(fields, width)
        before = measured.stamp < true.stamp[0]
        return (
            np.concatenate([measured.stamp[before], true.stamp]),
            np.concatenate([measured.table(fields, width)[before], true.table(fields, width)]),
        )

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records of the bag by name, those of this robot's nodes as ``parameters/NODE``.

        A recorder in the namespace of the robot calls them so itself.
        """
        before = f"parameters{self.namespace}/"
        return {
            **self.bag.metadata,
            **{
                f"parameters/{name.removeprefix(before)}": values
                for name, values in self.bag.metadata.items()
                if self.namespace and name.startswith(before)
            },
        }

    @property
    def joint_names(self) -> list[str]:
        """Names of the joints in the order of ``joint_states``; none where that is missing."""
        return self.names("joint_states")

    def names(self, topic: str) -> list[str]:
        """Return the names in the first joint states of a topic; none where it is missing."""
        series = self.get(topic)
        return list(map(str, next(series.messages())[1].name)) if series is not None else []

    @property
    def urdf(self) -> bytes | None:
        """The description of the robot: the attached file, or else the last message about it."""
        name = f"{self.namespace}/robot_description".strip("/").replace("/", ".")
        attached = self.bag.attachments.get(f"{name}.urdf")
        if attached is not None:
            return attached
        series = self.get("robot_description")
        return None if series is None else str(series.field("data")[-1]).encode()


@dataclass(frozen=True)
class LastState:
    """The last recorded state of a robot.

    Attributes
    ----------
    time_ns
        Its stamp.
    position, quaternion
        Of the base link in the world: (3,) m and (x, y, z, w).
    joint_names, joints, rates
        Names, positions and velocities (n,) of the joints.
    momenta
        Linear over angular momentum in the world (6,).
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

    Of a bag that was cut off, what can be read counts; ``namespace`` is that of the plant's topics.

    Raises
    ------
    RecordingError
        There is no such bag, or no state in it.
    """
    source = Path(path)
    if is_complete(source):
        return _last_state(RecordedRobot(read_bag(source), namespace))
    with tempfile.TemporaryDirectory(prefix="spacerobot_") as folder:
        whole = Path(folder, source.name)
        salvage_bag(source, whole)
        return _last_state(RecordedRobot(read_bag(whole), namespace))


def _last_state(robot: RecordedRobot) -> LastState:
    odom, joints, momentum = (robot[name] for name in _STATE)
    # Momenta have no stamp; a state is published momenta first, and logged at its time.
    common = np.intersect1d(odom.stamp_ns, joints.stamp_ns)
    if not len(common):
        raise RecordingError(
            f"The bag {robot.bag.path} holds no state of which all parts are there."
        )
    k, j = (int(np.flatnonzero(series.stamp_ns == common[-1])[-1]) for series in (odom, joints))
    pose = odom.table(columns("odom", "pose.pose"))[k]
    names = robot.joint_names
    positions = np.asarray(joints.field("position")[j])
    rates = np.asarray(joints.field("velocity")[j])
    momenta = np.asarray(momentum.field("data")[min(k, len(momentum) - 1)])[:6]
    numbers = np.concatenate([pose, positions, rates, momenta])
    whole = len(positions) == len(rates) == len(names) and len(momenta) == 6
    if not (whole and np.isfinite(numbers).all()):
        raise RecordingError(
            f"The last state in the bag {robot.bag.path} lacks numbers, or they are not finite."
        )
    return LastState(
        time_ns=int(common[-1]),
        position=pose[:3],
        quaternion=pose[3:],
        joint_names=names,
        joints=positions,
        rates=rates,
        momenta=momenta,
    )
