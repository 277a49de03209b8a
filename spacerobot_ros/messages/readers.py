"""Readers and writers of serialised messages that all have one layout; values are accessed in
place.

rclpy spends most of a tick converting Python objects to bytes and back. A state message has the
same layout every tick, so it is serialised once and its values are written into the bytes. A
command is read in the same way. If the layout of a message differs from the previous one, the
reader adapts to it.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from spacerobot_ros.errors import CommandError, counted
from spacerobot_ros.messages.definitions import (
    LITTLE_ENDIAN,
    Layout,
    encode,
    installed_type,
    seconds_and_nanoseconds,
)
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.simulation.commands import CommandSource, CommandValidator, Refusal
from spacerobot_ros.times import HEADER_STAMP, LATEST_NS, SECOND, unpack_stamp

JOINT_STATE = "sensor_msgs/msg/JointState"
ODOMETRY = "nav_msgs/msg/Odometry"
WRENCH = "geometry_msgs/msg/WrenchStamped"

_OTHER_JOINTS_BYTES = 65536
"""Size allowed for joints of other robots in a message, bytes."""

_NOT_FINITE_RATES = "velocities are not finite"

_HEADER_BYTES = 4096
POSE_PATH = "pose.pose.position.x"
"""First of the seven numbers of the pose in an Odometry message."""

Quantity = Literal["position", "velocity", "effort"]
"""Name of a numeric array in a JointState."""


class UnreadableError(CommandError):
    """The bytes are not a message of the expected type; the error message names the type."""


def read_text(raw: bytes, type_name: str, path: str) -> str:
    """Return a string in one serialised message.

    Raises
    ------
    UnreadableError
        The bytes are not a message of this type.
    """
    reader = TemplateReader(type_name)
    reader.accept(raw)
    return reader.text(path)


class MessageTemplate:
    """A serialised message whose values are overwritten in place.

    Parameters
    ----------
    type_name
        Such as ``nav_msgs/msg/Odometry``.
    prototype
        The serialised message; every list must have its final length and every string its final
        content.
    """

    def __init__(self, type_name: str, prototype: bytes) -> None:
        self._buffer = bytearray(prototype)
        self._leaves = Layout(prototype, installed_type(type_name), elements=True).leaves
        self._feeds: dict[str, tuple[slice, memoryview]] = {}
        size = HEADER_STAMP.stop - HEADER_STAMP.start
        self._stamps = [
            slice(leaf.offset, leaf.offset + size)
            for path, leaf in self._leaves.items()
            if path in ("header.stamp.sec", "clock.sec") or path.endswith(".header.stamp.sec")
        ]

    def feed(self, path: str, source: Array) -> None:
        """Copy ``source``, a contiguous array that is updated in place, to ``path`` in every
        message."""
        data, begin = source.data.cast("B"), self._leaves[path].offset
        self._feeds[path] = slice(begin, begin + len(data)), data

    def serialised(self, stamp: bytes) -> bytes:
        """Return the current message with ``stamp`` (:func:`stamp_bytes`) in every header."""
        for place, source in self._feeds.values():
            self._buffer[place] = source
        for place in self._stamps:
            self._buffer[place] = stamp
        return bytes(self._buffer)

    def copies(self, stamps_ns: npt.NDArray[np.int64], columns: Mapping[str, Array]) -> list[bytes]:
        """Return one message per stamp.

        Parameters
        ----------
        stamps_ns
            (N,) header or clock stamps, ns.
        columns
            Numbers (N, size), keyed by the path of their first field.
        """
        table = np.tile(np.frombuffer(self._buffer, np.uint8), (len(stamps_ns), 1))
        for place in self._stamps:
            table[:, place] = seconds_and_nanoseconds(stamps_ns).view(np.uint8)
        for path, values in columns.items():
            data = np.ascontiguousarray(values, dtype="<f8").view(np.uint8)
            begin = self._leaves[path].offset
            table[:, begin : begin + data.shape[1]] = data
        return [row.tobytes() for row in table]


def joint_template(joint_names: Sequence[str]) -> MessageTemplate:
    """Return a JointState template with zeros for all quantities of the given joints."""
    zeros = np.zeros(len(joint_names))
    values = {"name": joint_names, "position": zeros, "velocity": zeros, "effort": zeros}
    return MessageTemplate(JOINT_STATE, encode(JOINT_STATE, values))


class TemplateReader:
    """Reads float arrays and the stamp from serialised messages that all have one layout.

    Parameters
    ----------
    type_name
        Message type; to read the stamp, the type must begin with a header.
    max_size
        Largest size of messages with a different layout, bytes; larger messages are rejected
        without being read.
    """

    def __init__(self, type_name: str, max_size: float = math.inf) -> None:
        self._kind, self._max_size = installed_type(type_name), max_size
        self.raw = bytes(2)
        """The accepted message."""
        # Matches no message.
        self._fixed_spans: list[tuple[slice, bytes]] = [(slice(0, 2), b"")]
        self._layout: Layout

    def accept(self, raw: bytes) -> bool:
        """Use ``raw`` as the current message; return whether its layout or strings have changed.

        Raises
        ------
        UnreadableError
            The bytes are not a message of the expected type; the previous message is kept.
        """
        if raw is self.raw:
            return False
        same_size = len(raw) == len(self.raw)
        if same_size and all(raw[place] == text for place, text in self._fixed_spans):
            self.raw = raw
            return False
        if len(raw) > self._max_size:
            raise UnreadableError(f"it has {len(raw)} bytes; at most {self._max_size} are expected")
        try:
            if raw[:2] != LITTLE_ENDIAN:
                raise IndexError("it is not in little-endian CDR")
            layout = Layout(raw, self._kind, elements=True)
        except IndexError as error:
            short = self._kind.name.rpartition("/")[2]
            raise UnreadableError(f"its bytes are not a {short}") from error
        self.raw, self._layout = raw, layout
        fixed = [(0, len(LITTLE_ENDIAN)), *layout.fixed]
        self._fixed_spans = [(slice(a, b), raw[a:b]) for a, b in fixed]
        return True

    def floats(self, path: str, count: int | None = None) -> Array:
        """Return a read-only view of the ``count`` float64 values beginning at ``path``; by default
        those of the array at ``path``, which must not be empty."""
        number = self.value_count(path) if count is None else count
        return np.frombuffer(self.raw, np.float64, number, self._layout.leaves[path].offset)

    def value_count(self, path: str) -> int:
        """Return the number of values of the array at ``path`` in messages with this layout."""
        return self._layout.leaves[path].shape[0]

    def text(self, path: str) -> str:
        """Return a string in messages with this layout."""
        leaf = self._layout.leaves[path]
        return self.raw[leaf.offset : leaf.offset + leaf.size].decode(errors="replace")

    def texts(self, path: str) -> list[str]:
        """Return a list of strings in messages with this layout."""
        return [self.text(f"{path}[{i}]") for i in range(self._layout.counts[path])]

    @property
    def stamp_ns(self) -> int:
        """Header stamp of the accepted message, ns."""
        seconds, nanoseconds = unpack_stamp(self.raw)
        return int(seconds * SECOND + nanoseconds)


class JointReader:
    """Reads quantities from JointState messages in model joint order.

    A command names all joints, in any order. A measured state may also name other joints, for
    example if a broadcaster publishes the joints of a whole machine; these joints are ignored. A
    measured state may be split into several messages (:meth:`joined`).

    Parameters
    ----------
    joint_names
        The model's joints.
    quantities
        Quantities to read; the first is required in every message.
    measured
        Whether messages are measured states, which have bounded stamps.
    followers
        Names of mimic joints, which are not model coordinates.
    """

    def __init__(
        self,
        joint_names: Sequence[str],
        quantities: Sequence[Quantity],
        *,
        measured: bool = False,
        followers: Collection[str] = (),
    ) -> None:
        self._measured, self._joints, self._quantities = measured, list(joint_names), quantities
        self._followers = followers
        self.ignored: Counter[str] = Counter()
        """Number of ignored parts of accepted messages, by description."""
        # Each joint adds its name, a length and three numbers; a machine also has other joints.
        own = sum(len(name.encode()) + 32 for name in joint_names)
        max_size = _HEADER_BYTES + 2 * own + _OTHER_JOINTS_BYTES
        self.values: dict[str, Array] = {name: np.zeros(len(joint_names)) for name in quantities}
        self._reader = TemplateReader(JOINT_STATE, max_size)
        self._problem: tuple[type[CommandError], str] | None = None
        """Error to raise for messages with this layout."""
        self._of_message = self._of_model = np.zeros(0, np.intp)
        """Indices of the joints that a message and a model have in common, in each of them."""
        self._ignored: tuple[str, ...] = ()
        """Descriptions of the other joints of a message."""
        self._seen = np.zeros(len(joint_names), dtype=np.bool_)
        """Joints received since the last complete state; their values are in ``values``."""

    def accept(self, raw: bytes) -> int:
        """Read a message into ``values`` and return its stamp in ns.

        Raises
        ------
        CommandError
            A joint is unknown or named twice, a length is wrong, or the stamp of a measured state
            is too large for a command.
        """
        self.require(raw)
        stamp = self._reader.stamp_ns
        if stamp > LATEST_NS and self._measured:
            raise UnreadableError(
                f"its stamp of {stamp / SECOND:.10g} s is too large for a command"
            )
        self._copy_values()
        return stamp

    def _copy_values(self) -> None:
        for name, values in self.values.items():
            if self._reader.value_count(name):
                values[self._of_model] = self._reader.floats(name)[self._of_message]
        self.ignored.update(self._ignored)
        if self._measured and "velocity" in self.values:
            rates = self.values["velocity"]
            if not math.isfinite(sum(rates.tolist())):
                # Drivers without a measured rate report NaN.
                rates[~np.isfinite(rates)] = 0.0
                self.ignored[_NOT_FINITE_RATES] += 1

    def joined(self, raw: bytes) -> bytes | None:
        """Return a measured state of all joints: this message, or one merged from several messages.

        Returns None until every joint has arrived since the last complete state.

        Raises
        ------
        CommandError
            The message is rejected.
        """
        try:
            self.require(raw)
        except MissingJointError:
            pass
        else:
            return raw
        self._copy_values()
        self._seen[self._of_model] = True
        if not self._seen.all():
            return None
        self._seen[:] = False
        template = joint_template(self._joints)
        for name, values in self.values.items():
            template.feed(name, values)
        return template.serialised(bytes(self._reader.raw[HEADER_STAMP]))

    @property
    def incomplete(self) -> str:
        """Clause describing the joints missing since the last complete state."""
        absent = [n for n, seen in zip(self._joints, self._seen, strict=True) if not seen]
        return f"no message names {', '.join(absent)}"

    def require(self, raw: bytes) -> None:
        """Reject a message that :meth:`accept` would reject; ``values`` are not changed.

        Raises
        ------
        CommandError
            As :meth:`accept` does.
        MissingJointError
            A measured state lacks a joint.
        """
        if self._reader.accept(raw):
            self._problem = None
            try:
                self._match_joints(self._reader.texts("name"))
            except CommandError as error:
                self._problem = type(error), str(error)
        if self._problem is not None:
            kind, clause = self._problem
            raise kind(clause)

    @property
    def stamp_ns(self) -> int:
        """Stamp of the last message passed to :meth:`accept`, rejected or not, ns."""
        return self._reader.stamp_ns

    def _match_joints(self, named: Sequence[str]) -> None:
        """Find the joints of the model among the named joints of a message, or raise CommandError;
        a measured state may lack joints and name others, if it names at least one joint of the
        model."""
        joints = {name: i for i, name in enumerate(self._joints)}
        places = [i for i, name in enumerate(named) if name in joints]
        others = [name for name in named if name not in joints]
        whole = not self._measured or (joints and not places)
        if whole and others:
            known = ", ".join(joints)
            raise CommandError(f"joint '{others[0]}' is unknown; the robot has {known}")
        if len(set(named)) != len(named):
            raise CommandError(f"a joint is named twice in {list(named)}")
        if whole and len(named) < len(joints):
            missing = next(name for name in joints if name not in named)
            raise CommandError(f"joint '{missing}' is missing: each message must name all joints")
        self._of_message = np.array(places, dtype=np.intp)
        self._of_model = np.array([joints[named[i]] for i in places], dtype=np.intp)
        self._ignored = tuple(
            f"joint '{name}' {'mimics another' if name in self._followers else 'is unknown'}"
            for name in others
        )
        for i, quantity in enumerate(self._quantities):
            count = self._reader.value_count(quantity)
            if count != len(named) and (count or i == 0):
                raise CommandError(
                    f"the message has {counted(len(named), 'joint name')} and "
                    f"{counted(count, f'{quantity} value')}"
                )
        absent = [name for i, name in enumerate(self._joints) if i not in self._of_model]
        if absent:
            raise MissingJointError(f"joint '{absent[0]}' is missing")
        for values in self.values.values():
            values[:] = 0.0


class MissingJointError(CommandError):
    """A measured state lacks a joint; another message may contain it."""


class MessageDecoder(JointReader):
    """Reads measured states and references for one robot from serialised messages.

    The nodes use this class as their :class:`~spacerobot_ros.commanding.host.StateDecoder`.

    Parameters
    ----------
    joint_names
        Joints of the robot, in the robot's order.
    followers
        Names of mimic joints.
    """

    def __init__(self, joint_names: Sequence[str], followers: Collection[str] = ()) -> None:
        quantities: list[Quantity] = ["position", "velocity"]
        super().__init__(joint_names, quantities, measured=True, followers=followers)
        self._references = JointReader(joint_names, quantities)
        self._odom, self._target = TemplateReader(ODOMETRY), TemplateReader(ODOMETRY)
        self.q, self.qdot = self.values["position"], self.values["velocity"]
        self.check_robot, self.decode_joints = self.require, self.accept

    def decode_base(self, odom: bytes) -> tuple[Array, Array]:
        """Return the pose (7,) and twist (6,) in an Odometry message."""
        return _pose_and_twist(self._odom, odom)

    def target(self, odom: bytes) -> tuple[Array, Array]:
        """Return the pose (7,) and twist (6,) in a target Odometry message."""
        return _pose_and_twist(self._target, odom)

    def joint_reference(self, message: bytes) -> tuple[Array, Array]:
        """Return the positions and rates (n,) in a JointState; missing quantities are 0."""
        self._references.accept(message)
        return self._references.values["position"], self._references.values["velocity"]


def _pose_and_twist(reader: TemplateReader, odom: bytes) -> tuple[Array, Array]:
    reader.accept(odom)
    return reader.floats(POSE_PATH, 7), reader.floats("twist.twist.linear.x", 6)


class CommandReader:
    """Reads messages from one source and passes them to the validator.

    Parameters
    ----------
    source
        Command topic and type.
    robot
        The model.
    frame_prefix
        Prefix that the base link name may have in commands.
    """

    def __init__(self, source: CommandSource, robot: SpaceRobot, frame_prefix: str = "") -> None:
        self.source = source
        self._reader: JointReader | _WrenchReader
        if source.quantity == "wrench":
            self._reader = _WrenchReader(robot.base_link, frame_prefix)
            self._values = self._reader.values
        else:
            self._reader = JointReader(robot.joint_names, [source.quantity])
            self._values = self._reader.values[source.quantity]

    def offer(self, commands: CommandValidator, raw: bytes, now_ns: int) -> Refusal | None:
        """Pass a command message to the validator; return the refusal, or None if accepted."""
        try:
            stamp_ns, command = self.read(raw)
        except UnreadableError as error:
            return commands.unreadable(self.source, error, now_ns)
        return commands.accept_or_refuse(self.source, stamp_ns, command, now_ns)

    def read(self, raw: bytes) -> tuple[int, Array | CommandError]:
        """Return a message's stamp, ns, and its values, or the reason why it is malformed.

        The values are overwritten by the next message. Raises UnreadableError if the bytes are not
        a message of the expected type.
        """
        try:
            return self._reader.accept(raw), self._values
        except UnreadableError:
            raise
        except CommandError as error:
            return self._reader.stamp_ns, error


def actuation_of(message: Any) -> str:
    """Return the command type of a JointState, ``velocity`` or ``effort``; empty if it cannot be
    determined, e.g. at rest.

    The nodes in this package fill both arrays, one of them with zeros.
    """
    moves, pushes = any(message.velocity), any(message.effort)
    if moves == pushes:
        moves, pushes = len(message.velocity) > 0, len(message.effort) > 0
    if moves == pushes:
        return ""
    return "velocity" if moves else "effort"


class _WrenchReader:
    """Reads force and torque (6,) in the frame of the base link into ``values``."""

    def __init__(self, base_link: str, frame_prefix: str) -> None:
        self.values: Array = np.zeros(6)
        self._base_link, self._accepted = base_link, ("", base_link, frame_prefix + base_link)
        self._reader = TemplateReader(WRENCH)
        self._frame = ""

    def accept(self, raw: bytes) -> int:
        reader = self._reader
        if reader.accept(raw):
            self._frame = reader.text("header.frame_id")
        if self._frame not in self._accepted:
            raise CommandError(
                f"the wrench is in frame '{self._frame}'; it must be in '{self._base_link}'"
            )
        self.values[:] = reader.floats("wrench.force.x", 6)
        return reader.stamp_ns

    @property
    def stamp_ns(self) -> int:
        return self._reader.stamp_ns
