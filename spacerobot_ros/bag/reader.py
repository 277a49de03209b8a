"""Reads a bag as time series: all topics, or only the topics of one robot."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cached_property
from itertools import chain
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from mcap.records import Attachment, Metadata, Statistics
from numpy.typing import NDArray

from spacerobot_ros.bag.mcap_file import QosProfile
from spacerobot_ros.bag.mcap_reading import (
    LATEST_TIME_NS,
    BagFile,
    RecordedChannel,
    RecordT,
    blocks_in_time_order,
    read_record,
)
from spacerobot_ros.bag.series import TopicSeries
from spacerobot_ros.bag.tables import TopicTable, table_of, to_pandas, to_xarray, with_euler_angles
from spacerobot_ros.errors import RecordingError, RobotDescriptionError, counted, printable
from spacerobot_ros.files import load_yaml, warn_once
from spacerobot_ros.messages.definitions import MessageType, message_type
from spacerobot_ros.resources import suggestion
from spacerobot_ros.times import SECOND
from spacerobot_ros.topics import TOPICS, topic_named

if TYPE_CHECKING:
    import pandas
    import xarray

Array = NDArray[np.float64]

_STRING_TYPE = "std_msgs/msg/String"

_MAX_DECODED_BYTES, _MAX_DECODED_TO_FILE_RATIO = 16_000_000, 50
"""Largest topic to decode, in bytes or relative to the file size.
Decoded objects need ten times as much."""


def read_bag(path: str | os.PathLike[str]) -> Bag:
    """Open a bag for reading; initially, only its summary is read.

    ``path`` is an MCAP file, a folder with one bag, as created by ``ros2 bag record``, or the name
    ``NAME.mcap`` of a recording that was split into ``NAME_0.mcap``, ``NAME_1.mcap``, ... All files
    in a folder or split recording form one bag.

    Raises
    ------
    RecordingError
        The bag does not exist, is not in MCAP format, is truncated or is damaged.
    """
    given, files = Path(path), bag_files(Path(path))
    return Bag(given if len(files) > 1 else files[0], files)


def salvaged_copy(path: Path) -> Path:
    """Return the name of the salvaged copy of a file."""
    return path.with_name(f"{path.stem}-salvaged.mcap")


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag in order: all files in a folder or a split recording, or one file.

    If there are several files, salvaged copies replace truncated files.

    Raises
    ------
    RecordingError
        A folder contains no MCAP file, or several that are not listed in its ``metadata.yaml``; or
        a file of several that belong together is missing.
    """
    if path.is_dir():
        listed = _as_found([path / name for name in _listed_files(path)])
        missing = [file.name for file in listed if not os.path.isfile(file)]
        if listed and not missing:
            return listed
        if len(listed) > 1:
            raise _lacks(path, f"{_format_list(missing)}, listed in its metadata.yaml")
        # Files in other formats are rejected individually, with a remedy.
        found = (sorted(path.glob(f"*{suffix}")) for suffix in (".mcap", ".mcap.zst*", ".db3"))
        files = next(filter(None, found), [])
        if not files:
            raise RecordingError(f"The folder {path} contains no bag: name an MCAP file.")
        if len(files) != 1:
            raise RecordingError(
                f"The folder {path} contains {len(files)} MCAP files: name one of them."
            )
        return files
    if path.exists():
        whole = _listed_files(path.parent)
        if len(whole) > 1 and path.name in whole:
            warn_once(
                f"{path} is one of {len(whole)} files of the bag in {path.parent}: name the folder "
                "to read all of them."
            )
        return [path]
    name = re.compile(
        rf"{re.escape(path.stem)}_(0|[1-9]\d*)(-salvaged)?{re.escape(path.suffix)}(\.zstd)?"
    )
    matches = (name.fullmatch(file.name) for file in path.parent.glob("*"))
    numbers = {int(match[1]) for match in matches if match}
    if 0 not in numbers:
        return [path]
    parts = [path.with_name(f"{path.stem}_{n}{path.suffix}") for n in range(len(numbers))]
    if missing := [part.name for n, part in enumerate(parts) if n not in numbers]:
        raise _lacks(path, _format_list(missing))
    return _as_found(parts)


def _lacks(bag: Path, missing: str) -> RecordingError:
    return RecordingError(
        f"The bag {bag} lacks {missing}: restore what is missing, or name one of the other files "
        "to read it alone."
    )


def _as_found(files: list[Path]) -> list[Path]:
    """Return the files of a bag under the names they have now: salvaged, packed or unpacked."""
    found = []
    for file in files:
        plain = file.with_suffix("") if file.suffix == ".zstd" else file
        names = salvaged_copy(plain), file, plain, plain.with_name(f"{plain.name}.zstd")
        found.append(next(filter(os.path.exists, names), file))
    return found


def _listed_files(folder: Path) -> list[str]:
    """Return the names of a bag's files in a folder, as listed in rosbag2's metadata."""
    file = folder / "metadata.yaml"
    if not file.is_file():
        return []
    try:
        text = file.read_text("utf-8")
        listed = load_yaml(text)["rosbag2_bagfile_information"]["relative_file_paths"]
        # Old versions of rosbag2 include the folder; other paths may lead anywhere.
        return list(dict.fromkeys(filter(None, (PurePath(name).name for name in listed))))
    except (OSError, ValueError, TypeError, KeyError):
        return []


class Bag(Mapping[str, TopicSeries]):
    """A bag as time series: ``bag["odom"].field("pose.pose.position.x")``.

    A bag maps topic names, with or without the leading slash, to messages. A topic
    is read on first access and cached. The file is not kept open.

    Raises
    ------
    RecordingError
        In the constructor, as for :func:`read_bag`; in methods, if the topic does not exist, the
        bag is damaged, or pandas or xarray is not installed.
    """

    def __init__(self, path: Path, files: Sequence[Path] | None = None) -> None:
        self.path = path
        self._files = [BagFile(file) for file in files or [path]]
        size = sum(file.size for file in self._files)
        self._max_decoded_bytes = max(_MAX_DECODED_BYTES, _MAX_DECODED_TO_FILE_RATIO * size)
        self._series_by_topic: dict[str, TopicSeries] = {}
        self._prismatic_by_namespace: dict[str, dict[str, bool]] = {}

    @cached_property
    def _channels_by_topic(self) -> dict[str, list[RecordedChannel]]:
        found: dict[str, list[RecordedChannel]] = {}
        for each in (each for file in self._files for each in file.channels):
            found.setdefault(each.channel.topic, []).append(each)
        return found

    @cached_property
    def topics(self) -> dict[str, str]:
        """Type of every recorded topic by topic name, including topics without messages."""
        return {name: each[-1].schema.name for name, each in self._channels_by_topic.items()}

    def __iter__(self) -> Iterator[str]:
        return iter(self.topics)

    def __len__(self) -> int:
        return len(self.topics)

    def __bool__(self) -> bool:
        return True

    # Bags are not compared message by message.
    __eq__, __hash__ = object.__eq__, object.__hash__

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, [file.path for file in self._files])

    def __contains__(self, topic: object) -> bool:
        return isinstance(topic, str) and self._recorded_name(topic) in self.topics

    def get(self, topic: str, default: Any = None) -> Any:
        """Return the messages on a topic, or ``default`` if there is no such topic."""
        if topic in self:
            return self[topic]
        return default

    def __repr__(self) -> str:
        span = f", {self.end_time - self.start_time:.6g} s" if self.message_count() else ""
        head = f"Bag {self.path}: {self.message_count()} messages on {len(self)} topics{span}"
        wide = max(map(len, map(printable, self)), default=0)
        lines = [
            f"  {printable(topic):<{wide}}  {sum(each.message_count for each in channels):>7}  "
            f"{printable(self.topics[topic])}"
            for topic, channels in sorted(self._channels_by_topic.items())
        ]
        return "\n".join([f"{head}{':' if lines else ''}", *lines])

    def _recorded_name(self, topic: str) -> str:
        """Return the recorded name of a topic, which may be given without its leading slash."""
        if not isinstance(topic, str):
            raise TypeError(f"A topic name must be a string, such as 'odom', not {topic!r}.")
        other = topic[1:] if topic.startswith("/") else f"/{topic}"
        return other if topic not in self.topics and other in self.topics else topic

    @cached_property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Keys and values of every metadata record by name; if a name is repeated, the last record
        takes precedence."""
        return {each.name: each.metadata for each in self._records("metadata_indexes", Metadata)}

    @cached_property
    def attachments(self) -> dict[str, bytes]:
        """Content of every attachment by name; if a name is repeated, the last attachment takes
        precedence."""
        return {each.name: each.data for each in self._records("attachment_indexes", Attachment)}

    def _records(self, indexes: str, kind: type[RecordT]) -> Iterator[RecordT]:
        """Read the records of one kind that the summaries list, each once."""
        for file in self._files:
            places = (index.offset for index in getattr(file.summary, indexes))
            with file.open() as opened:
                for place in dict.fromkeys(places):
                    yield read_record(opened, place, kind)

    @property
    def start_time(self) -> float:
        """Log time of the earliest message in seconds; nan if there is none."""
        return self.start_time_ns / SECOND if self.message_count() else float("nan")

    @property
    def end_time(self) -> float:
        """Log time of the latest message in seconds; nan if there is none."""
        return self.end_time_ns / SECOND if self.message_count() else float("nan")

    @property
    def start_time_ns(self) -> int:
        """Log time of the earliest message in nanoseconds; 0 if there is none."""
        return min((int(each.message_start_time) for each in self._statistics), default=0)

    @property
    def end_time_ns(self) -> int:
        """Log time of the latest message in nanoseconds; 0 if there is none."""
        return max((int(each.message_end_time) for each in self._statistics), default=0)

    @property
    def _statistics(self) -> list[Statistics]:
        """Statistics of the files that have messages."""
        return [file.statistics for file in self._files if file.statistics.message_count]

    def message_count(self, topic: str | None = None) -> int:
        """Return the number of messages on a topic, or in the whole bag."""
        if topic is None:
            return sum(int(each.message_count) for each in self._statistics)
        return sum(channel.message_count for channel in self._channels(topic))

    def raw_messages(
        self, topics: Sequence[str], start_ns: int = 0, end_ns: int = LATEST_TIME_NS
    ) -> Iterator[tuple[str, int, bytes]]:
        """Iterate over the serialised messages on some topics, in log time order.

        Yields
        ------
        Topic, log time in nanoseconds, serialised message.
        """
        return chain.from_iterable(blocks_in_time_order(self._files, topics, start_ns, end_ns))

    def qos(self, topic: str) -> list[QosProfile]:
        """Return the recorded QoS of a topic's publishers."""
        channels = (each.channel for each in self._channels(topic))
        texts = [channel.metadata.get("offered_qos_profiles", "") for channel in channels]
        return [profile for text in texts for profile in QosProfile.from_yaml(text)]

    @overload
    def to_pandas(self, topic: str, *, euler: bool = False) -> pandas.DataFrame: ...
    @overload
    def to_pandas(
        self, topic: None = None, *, euler: bool = False
    ) -> dict[str, pandas.DataFrame]: ...
    def to_pandas(
        self, topic: str | None = None, *, euler: bool = False
    ) -> pandas.DataFrame | dict[str, pandas.DataFrame]:
        """Return a topic as a pandas DataFrame, or all readable topics by name.

        The index is the log time in seconds, and ``attrs["units"]`` contains the column units; see
        :func:`~spacerobot_ros.bag.tables.table_of` for the columns. If ``euler`` is set, the
        columns ``roll``, ``pitch`` and ``yaw`` contain each attitude as rotations about the fixed
        axes x, y, z (rad).
        """
        if topic is not None:
            return to_pandas(self.table(topic, euler=euler))
        return {name: to_pandas(table) for name, table in self.tables(euler=euler).items()}

    @overload
    def to_xarray(self, topic: str, *, euler: bool = False) -> xarray.Dataset: ...
    @overload
    def to_xarray(
        self, topic: None = None, *, euler: bool = False
    ) -> dict[str, xarray.Dataset]: ...
    def to_xarray(
        self, topic: str | None = None, *, euler: bool = False
    ) -> xarray.Dataset | dict[str, xarray.Dataset]:
        """Return a topic as an xarray Dataset, or all readable topics by name.

        Arrays are kept as arrays, with dimensions ``time`` and ``joint`` for joint states; every
        variable has ``units``. ``euler``: see :meth:`to_pandas`.
        """
        if topic is not None:
            return to_xarray(self.table(topic, euler=euler))
        return {name: to_xarray(table) for name, table in self.tables(euler=euler).items()}

    def table(self, topic: str, *, euler: bool = False) -> TopicTable:
        """Return a topic as a table; joint units are taken from the URDF in the bag.

        ``euler``: whether to add ``roll``, ``pitch`` and ``yaw`` for attitudes.
        """
        series = self[topic]
        namespace = series.topic.rpartition("/")[0]
        if namespace not in self._prismatic_by_namespace:
            # Importing the robot model doubles the import time of this module.
            from spacerobot_ros.model.description import JointKind
            from spacerobot_ros.model.urdf import parse_robot

            kinds = self._prismatic_by_namespace.setdefault(namespace, {})
            with suppress(RecordingError):
                for text in self.robot_descriptions(namespace):
                    with suppress(RobotDescriptionError, UnicodeDecodeError):
                        for joint in parse_robot(text.decode()).movable_joints:
                            kinds.setdefault(joint.name, joint.kind is JointKind.PRISMATIC)
        found = table_of(series, self._prismatic_by_namespace[namespace])
        return with_euler_angles(found) if euler else found

    def tables(self, *, euler: bool = False) -> dict[str, TopicTable]:
        """Return all readable topics as tables; a warning names the other topics.

        ``euler``: see :meth:`table`.

        Raises
        ------
        RecordingError
            No topic can be read.
        """
        found: dict[str, TopicTable] = {}
        refused: dict[str, RecordingError] = {}
        # One pass unpacks each chunk once; in a damaged bag, some topics may be intact.
        with suppress(RecordingError):
            self.load(self)
        for topic in self:
            try:
                found[topic] = self.table(topic, euler=euler)
            except RecordingError as error:
                refused[topic] = error
        if refused:
            reason = next(iter(refused.values()))
            if not found:
                raise reason
            warn_once(
                f"The bag {self.path} is read without {counted(len(refused), 'topic')}: "
                f"{_format_list(list(refused))}. {reason}"
            )
        return found

    def robot_descriptions(self, namespace: str = "", *, others: bool = True) -> list[bytes]:
        """Return candidate URDFs for the robot in a namespace, most likely first.

        The file attached for the robot comes first, then its last robot_description, then, if
        ``others`` is set, other attached files.
        """
        topic = f"{namespace}/robot_description"
        attached = {n: text for n, text in self.attachments.items() if n.endswith(".urdf")}
        own = attached.pop(f"{topic.strip('/').replace('/', '.')}.urdf", None)
        found = [] if own is None else [own]
        if self.topics.get(topic) == _STRING_TYPE:
            found += [text.encode() for text in self[topic].field("data")[-1:]]
        return [*found, *attached.values()] if others else found

    def __getitem__(self, topic: str) -> TopicSeries:
        topic = self._recorded_name(topic)
        if topic not in self._series_by_topic:
            self._read_together({topic: self._message_type(topic)})
        return self._series_by_topic[topic]

    def load(self, topics: Iterable[str]) -> None:
        """Read several topics in one pass over the file; unreadable topics are omitted.

        They stay in memory.
        """
        types = {}
        wanted = {self._recorded_name(topic) for topic in topics}
        for topic in wanted - self._series_by_topic.keys():
            with suppress(RecordingError):
                types[topic] = self._message_type(topic)
        if types:
            self._read_together(types)

    def _channels(self, topic: str) -> list[RecordedChannel]:
        channels = self._channels_by_topic.get(self._recorded_name(topic), [])
        if not channels:
            raise RecordingError(
                f"The bag {self.path} has no topic {topic}: it has "
                f"{_format_list(list(self.topics))}."
                f"{suggestion(topic, [*self.topics, *(name[1:] for name in self.topics)])}"
            )
        if len({(each.schema.name, each.schema.data) for each in channels}) > 1:
            raise RecordingError(f"The topic {topic} of the bag {self.path} has several types.")
        return channels

    def _message_type(self, topic: str) -> MessageType:
        channel, schema, _ = self._channels(topic)[0]
        if (channel.message_encoding, schema.encoding) != ("cdr", "ros2msg"):
            raise RecordingError(
                f"The topic {topic} of the bag {self.path} does not use ROS 2's encoding ('cdr' "
                f"defined by 'ros2msg'), but {channel.message_encoding!r} defined by "
                f"{schema.encoding!r}."
            )
        try:
            return message_type(schema.name, schema.data)
        except ValueError as error:
            raise RecordingError(
                f"The definition of {schema.name} in the bag {self.path} cannot be read: {error}."
            ) from error

    def _read_together(self, types: Mapping[str, MessageType]) -> None:
        times: dict[str, list[int]] = {topic: [] for topic in types}
        messages: dict[str, list[bytes]] = {topic: [] for topic in types}
        for topic, time_ns, data in self.raw_messages(list(types)):
            times[topic].append(time_ns)
            messages[topic].append(data)
        for topic, kind in types.items():
            time = np.array(times[topic], np.int64)
            self._series_by_topic[topic] = TopicSeries(
                topic, kind, time, messages[topic], self._max_decoded_bytes
            )


def _format_list(names: list[str], most: int = 40) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


# -- one robot --------------------------------------------------------------------------------


def columns(topic: str, path: str) -> list[str]:
    """Return the paths of a state topic's numeric fields nested under a message path."""
    return next(field.columns for field in TOPICS[topic].state if field.path == path)


class RecordedRobot:
    """The topics of one robot in a bag, by name relative to its namespace.

    Parameters
    ----------
    bag
        The recording.
    namespace
        Namespace of the robot's topics, such as ``/robot_1``; empty if there is no namespace.
    """

    def __init__(self, bag: Bag, namespace: str = "") -> None:
        self.bag = bag
        self.namespace = namespace

    def get(self, name: str) -> TopicSeries | None:
        """Return a topic of the stack; None if the topic has no messages or a different type."""
        topic = f"{self.namespace}/{name}"
        if self.bag.topics.get(topic) != topic_named(name).type or not self.bag.message_count(
            topic
        ):
            return None
        # The summary of a damaged bag may count messages that are missing.
        return self.bag[topic] if len(self.bag[topic]) else None

    def __contains__(self, name: str) -> bool:
        return self.get(name) is not None

    def instead_of(self, name: str) -> str:
        """Return what the bag has instead of a topic of the stack, as the end of a clause: messages
        of another type, or the type under other names; empty if it has neither."""
        topic, kind = f"{self.namespace}/{name}", topic_named(name).type
        recorded, found = self.bag.topics.get(topic, kind), []
        if recorded != kind:
            found.append(f"{topic} of type {recorded}, not {kind}")
        stack = tuple(f"/{each.lstrip('/')}" for each in TOPICS if each != name)
        others = [
            other
            for other, each in self.bag.topics.items()
            if each == kind and other != topic and not other.endswith(stack)
        ]
        if others:
            found.append(
                f"{_format_list(others)} of type {kind} (to rename it, record 'spacerobot replay "
                f"BAG --remap {others[0]}:={topic}')"
            )
        return printable(f", but {' and '.join(found)}") if found else ""

    def load(self, names: Iterable[str]) -> None:
        """Read all topics of the stack in the bag in one pass; see :meth:`Bag.load`."""
        types = {f"{self.namespace}/{name}": topic_named(name).type for name in names}
        self.bag.load(topic for topic, kind in types.items() if self.bag.topics.get(topic) == kind)

    def __getitem__(self, name: str) -> TopicSeries:
        """Return a topic of the stack.

        Raises
        ------
        RecordingError
            It has no messages, has a different type, or is damaged.
        """
        series = self.get(name)
        if series is None:
            topic = f"{self.namespace}/{name}"
            raise RecordingError(
                f"The bag {self.bag.path} contains no state: no messages on {topic}."
            )
        return series

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata records by name; this robot's nodes use ``parameters/NODE``.

        A recorder in the robot's namespace uses the same names.
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
        """Joint names in ``joint_states`` order; empty if there is no such topic."""
        return self.names("joint_states")

    def names(self, topic: str) -> list[str]:
        """Return the joint names in the first message of a topic; empty if there is no such
        topic."""
        series = self.get(topic)
        return list(map(str, next(series.messages())[1].name)) if series is not None else []

    @property
    def urdf(self) -> bytes | None:
        """Robot description: the attached file, otherwise the last robot_description."""
        return next(iter(self.bag.robot_descriptions(self.namespace, others=False)), None)
