"""Files that were made to harm their reader, by name: chunks, places, contents, whole flights."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache, partial
from io import BytesIO
from pathlib import Path

import lz4.frame
import zstandard
from mcap.reader import make_reader
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Chunk,
    Footer,
    Header,
    McapRecord,
    MetadataIndex,
    Schema,
)
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer
from support.hostile.records import (
    CASES,
    GIB,
    GOOD,
    MOST,
    SEPARATOR,
    STRING,
    Part,
    bag,
    channel,
    encoded,
    lz4_zeros,
    message,
    plain,
    raw,
    string,
    zstd_zeros,
)

# -- chunks that inflate ---------------------------------------------------------------------

TEXT = message(string("x"))
MUCH = zstd_zeros(6 * GIB, claims=6 * GIB)
"""6 GiB in 197 kB."""
ALLOWED = Part("zstd", zstd_zeros(60 * 2**20, claims=60 * 2**20), 60 * 2**20)

CHUNKS = {
    "zstd: 6 GiB in 197 kB, claimed": Part("zstd", MUCH, 6 * GIB),
    "zstd: 6 GiB in 197 kB, claimed by the chunk alone": Part("zstd", zstd_zeros(6 * GIB), 6 * GIB),
    "zstd: 6 GiB in 197 kB, 1000 bytes claimed": Part("zstd", zstd_zeros(6 * GIB), 1000),
    "zstd: 6 GiB claimed by the frame, 1000 bytes by the chunk": Part("zstd", MUCH, 1000),
    "zstd: 6 GiB claimed by the chunk, 1000 bytes by its index": Part("zstd", MUCH, 6 * GIB, 1000),
    "zstd: a frame that claims 2^62 bytes": Part("zstd", zstd_zeros(GIB, claims=2**62), 2**62),
    "zstd: 60 MB of zeros, which is allowed": ALLOWED,
    "lz4: 1 GiB in 4 MB, claimed": Part("lz4", lz4_zeros(GIB), GIB),
    "lz4: 1 GiB in 4 MB, 1000 bytes claimed": Part("lz4", lz4_zeros(GIB), 1000),
    "a compression of no name": Part("\u202erar", TEXT, 100),
    "a chunk of noise": Part("zstd", bytes(range(256)), 1000),
    "an empty chunk": Part("zstd", b"", 0),
    "chunks in a chunk": plain(TEXT, encoded(Chunk("zstd", MUCH, 5, 5, 0, 6 * GIB))),
    "messages at byte 2^64 - 1 of a chunk": plain(TEXT, entries=[(5, MOST), (5, 0)]),
    "one message, half a million times in the index": plain(
        message(string("x" * 1_000_000)), entries=[(5, 0)] * 500_000
    ),
    "a message that reaches out of its chunk": plain(raw(0x05, bytes(22), MOST)),
    "a message shorter than its header": plain(raw(0x05, b"xy"), bytes(60)),
}
for _size in (MOST, 2**63, 2**63 - 1, 2**40):
    for _name, _data in (
        ("zstd", zstandard.compress(TEXT)),
        ("lz4", lz4.frame.compress(TEXT)),
        ("", TEXT),
    ):
        _title = f"{_name or 'no compression'}: a chunk claims {_size} bytes"
        CHUNKS[_title] = Part(_name, _data, _size)
CASES |= {title: partial(bag, part) for title, part in CHUNKS.items()}


def nested() -> bytes:
    """Return a bag with messages inside of messages."""
    count, size = 30_000, 31
    records = [
        struct.pack("<BQHIQQ", 5, 22 + size * (count - k - 1), 1, 0, 5, 5) for k in range(count)
    ]
    return bag(plain(*records, entries=[(5, size * k) for k in range(count)]))


def apart() -> bytes:
    """Return a bag with messages 292 years apart."""
    last, one = 2**63 - 1, message(string("x"), 0)
    entries = [(0, 0), (last, len(one))]
    part = plain(one, message(string("y"), last), entries=entries, times=(0, last))
    return bag(part, statistics={"message_count": 2, "message_end_time": last})


# -- places and lengths -----------------------------------------------------------------------

FIRST_RECORD = len(MCAP0_MAGIC + encoded(Header("ros2", "hostile")))


def with_record(record: bytes, index: McapRecord, repeat: int = 1) -> bytes:
    """Return a bag with a record before its chunk, and the index of that record in its summary."""
    return bag(GOOD, records=record, summary=encoded(index) * repeat)


_LONG = bytes(24) + struct.pack("<Q", MOST) + b"abcd"
_LARGE = encoded(Attachment(0, 0, "a.urdf", "", bytes(5_000_000)))
_METADATA = struct.pack("<I", 1) + b"a" + struct.pack("<I", 2**32 - 1) + bytes(50)
_COUNTS = ("message_count", "message_start_time", "message_end_time")

CASES |= {
    "zstd: two hundred chunks of 60 MB": lambda: bag(*[ALLOWED] * 200),
    "messages: 6 GiB in 197 kB, claimed": lambda: bag(plain(message(MUCH))),
    "messages: 6 GiB in 197 kB": lambda: bag(plain(message(zstd_zeros(6 * GIB)))),
    "messages: two hundred of 60 MB": lambda: bag(*[plain(message(ALLOWED.data))] * 200),
    "one chunk, a thousand times in the index": lambda: bag(ALLOWED, repeat=1000),
    "one small chunk, ten thousand times in the index": lambda: bag(
        plain(message(string("x" * 50_000))), repeat=10_000
    ),
    "a record of 2^64 - 1 bytes": lambda: bag(GOOD, records=raw(0x0C, b"xyz", MOST)),
    "a record of 2^63 bytes in the summary": lambda: bag(GOOD, summary=raw(0x04, b"xyz", 2**63)),
    "a chunk at byte 2^64 - 1": lambda: bag(GOOD, chunk_offset=MOST),
    "a message index at byte 2^64 - 1": lambda: bag(GOOD, index_offset=MOST),
    "a message index of 4 GiB": lambda: bag(GOOD, index_size=2**32 - 16),
    "messages inside of messages": nested,
    "a footer that names byte 2^64 - 1": lambda: bag(GOOD, footer=Footer(MOST, MOST, 0)),
    "a footer that names a chunk as the summary": lambda: bag(
        Part("zstd", MUCH, 6 * GIB), footer=Footer(8, 0, 0)
    ),
    "an attachment of 2^64 - 1 bytes": lambda: with_record(
        raw(0x09, _LONG), AttachmentIndex(FIRST_RECORD, len(_LONG) + 9, 0, 0, 4, "a.urdf", "")
    ),
    "attachments and metadata at byte 2^64 - 1": lambda: bag(
        GOOD,
        summary=encoded(AttachmentIndex(MOST, MOST, 0, 0, MOST, "a.urdf", ""))
        + encoded(MetadataIndex(MOST, MOST, "a")),
    ),
    "an attachment of 5 MB, ten thousand times in the index": lambda: with_record(
        _LARGE,
        AttachmentIndex(FIRST_RECORD, len(_LARGE), 0, 0, 5_000_000, "a.urdf", ""),
        repeat=10_000,
    ),
    "metadata of 4 GiB": lambda: with_record(
        raw(0x0C, _METADATA), MetadataIndex(FIRST_RECORD, len(_METADATA) + 9, "a")
    ),
    "a channel with a name of 4 GiB": lambda: bag(
        GOOD, summary=raw(0x04, struct.pack("<HHI", 3, 1, 2**32 - 1) + b"x")
    ),
    "65534 channels": lambda: bag(GOOD, channels=[channel(k + 1, f"/t{k}") for k in range(65_534)]),
    "65534 channels of one topic": lambda: bag(
        GOOD, channels=[channel(k + 1, "/a") for k in range(65_534)]
    ),
    "statistics of 2^64 - 1": lambda: bag(
        GOOD, statistics=dict.fromkeys(_COUNTS, MOST) | {"channel_message_counts": {1: MOST}}
    ),
    "statistics of messages that are not there": lambda: bag(
        statistics={"message_count": 10, "channel_message_counts": {1: 10}}
    ),
    "messages at 2^64 - 1 ns": lambda: bag(
        plain(message(string("x"), MOST), entries=[(MOST, 0)], times=(5, MOST)),
        statistics={"message_end_time": MOST},
    ),
    "messages 292 years apart": apart,
}

# -- schemas -----------------------------------------------------------------------------------


def of_type(text: str | bytes, name: str = "a/msg/B", data: bytes | None = None) -> bytes:
    content = text if isinstance(text, bytes) else text.encode()
    schema = Schema(id=1, data=content, encoding="ros2msg", name=name)
    return bag(plain(message(string("x" * 50) if data is None else data)), schema=schema)


INNER = SEPARATOR + "MSG: a/C\n"
SCHEMAS: dict[str, tuple[str | bytes, str]] = {
    "an array of 3e7 messages": (f"C[30000000] x\n{INNER}int32 y\n", "a/msg/B"),
    "an array of 3e7 strings": ("string[30000000] x\n", "a/msg/B"),
    "an array of 3e7 numbers": ("float64[30000000] x\n", "a/msg/B"),
    "an array of 1e300 numbers": (f"float64[{'9' * 300}] x\n", "a/msg/B"),
    "an array of no elements": (f"C[] x\n{INNER}uint8[0] y\n", "a/msg/B"),
    "a type in itself": ("B x\n", "a/msg/B"),
    "a type in itself by a list": ("B[] x\n", "a/msg/B"),
    "two types in each other": (f"C x\n{INNER}B y\n", "a/msg/B"),
    "types that double twenty times": (
        "T0 x\nT0 y\n"
        + "".join(f"{SEPARATOR}MSG: a/T{k}\nT{k + 1} x\nT{k + 1} y\n" for k in range(20))
        + f"{SEPARATOR}MSG: a/T20\nint8 x\n",
        "a/msg/B",
    ),
    "types 900 deep": (
        "T0 x\n"
        + "".join(f"{SEPARATOR}MSG: a/T{k}\nT{k + 1} x\n" for k in range(900))
        + f"{SEPARATOR}MSG: a/T900\nint8 x\n",
        "a/msg/B",
    ),
    "a type that is not defined": ("Q x\n", "a/msg/B"),
    "no text": ("", "a/msg/B"),
    "text that is no text": (b"\xff\xfe\x00", "a/msg/B"),
    "text of 3 MB": ("int32 x\n" * 400_000, "a/msg/B"),
    "comments of 200 kB": ("# hello\n" * 25_000 + "int32 x\n", "a/msg/B"),
    "five thousand fields": ("".join(f"int32 x{k}\n" for k in range(4_999)), "a/msg/B"),
    "a constant of 1e999": ("float32 X=1e999\nint32 y\n", "a/msg/B"),
    "fields with the names of keywords": ("int32 class\nint32 class_\nint32 None\n", "a/msg/B"),
    "fields with the names of methods": ("int32 __init__\nint32 __class__\n", "a/msg/B"),
    "two fields of one name": ("int32 x\nint32 x\n", "a/msg/B"),
    "a type called ../../x": ("int32 x\n", "../../x"),
    "a type called nothing": ("int32 x\n", ""),
    "a type of two lines": ("int32 x\n", "a/msg/B\nint32 y"),
    "a type of one part": ("int32 x\n", "B"),
    "a type of nine parts": ("int32 x\n", "a/b/c/d/e/f/g/h/i"),
    "a type with code in it": ("int32 x\n", 'a/msg/B"""\nimport os\n"""'),
    "a type with a control character": ("int32 x\n", "a/msg/\x1b[31mB\x00"),
    "a type of 100 kB": ("int32 x\n", "a/msg/" + "B" * 100_000),
}
CASES |= {f"schema: {title}": partial(of_type, *given) for title, given in SCHEMAS.items()}


LIST = f"C[] x\n{INNER}"
CASES |= {
    # Were elements without bytes believed, this would be 1e11 of them.
    "schema: empty lists in lists": lambda: of_type(
        f"{LIST}D[] y\n{SEPARATOR}MSG: a/D\nuint8[0] z\n",
        data=struct.pack("<II", 256, 200_000) + struct.pack("<I", 400_000) * 200_000,
    ),
    "schema: a list of 4e9 messages": lambda: of_type(
        f"{LIST}float64 y\n", data=struct.pack("<II", 256, 2**32 - 1) + bytes(100)
    ),
    "schema: two definitions of one type": lambda: bag(
        GOOD, summary=encoded(Schema(2, b"int32 x\n", "ros2msg", STRING.name))
    ),
}


# -- quality of service ------------------------------------------------------------------------

QOS = {
    "sixty thousand brackets": "[" * 60_000,
    "sixty thousand braces": "{" * 60_000 + "}" * 60_000,
    "two thousand levels": "".join(f"{' ' * k}-\n" for k in range(300)) + "[" * 2000 + "]" * 2000,
    "references that multiply": "- &a0 {x: 1}\n"
    + "".join(f"- &a{k + 1} {{<<: [*a{k}, *a{k}, *a{k}]}}\n" for k in range(30)),
    "a list in itself": "&a [*a]",
    "a depth of 10^30": "- depth: 1" + "0" * 30,
    "a depth of 2^62": f"- depth: {2**62}",
    "a depth of -1": "- depth: -1",
    "a depth of yes": "- depth: yes",
    "a depth of a list": "- depth: [1]",
    "a deadline without end": "- deadline: {sec: .inf, nsec: 0}",
    "a deadline of no number": "- deadline: {sec: .nan, nsec: x}",
    "a deadline without seconds": "- deadline: {nsec: 0}",
    "a history that is a list": "- history: [keep_last]",
    "python objects": "- !!python/object/apply:os.system ['false']",
    "a megabyte": "- history: keep_last\n" * 50_000,
    "a tab and a zero": "-\t\0",
}
CASES |= {
    f"QoS: {title}": partial(bag, GOOD, channels=[channel(offered_qos_profiles=text)])
    for title, text in QOS.items()
}

REFERENCE = Path(__file__).parents[3] / "bags" / "sliding_masses.mcap"


# -- flights that are altered ------------------------------------------------------------------


def flight(
    change: Callable[[str, int, bytes], bytes | None] = lambda topic, number, data: data,
    *,
    urdf: bytes | None = None,
    metadata: dict[str, dict[str, str]] | None = None,
    most: int = 200,
    more: list[tuple[str, int, bytes]] | None = None,
    times: Callable[[int], int] = lambda time_ns: time_ns,
) -> bytes:
    """Return the first messages of a reference bag, altered."""
    out = BytesIO()
    reader = make_reader(BytesIO(_reference()))
    writer = Writer(out, compression=CompressionType.ZSTD)
    writer.start("ros2")
    for attachment in reader.iter_attachments():
        data = attachment.data if urdf is None else urdf
        writer.add_attachment(0, 0, attachment.name, attachment.media_type, data)
    for each in reader.iter_metadata():
        given = (metadata or {}).get(each.name, {})
        writer.add_metadata(each.name, {**each.metadata, **given})
    channels: dict[str, int] = {}
    counts: dict[str, int] = {}
    for number, (schema, source, each_message) in enumerate(reader.iter_messages()):
        if number == most:
            break
        assert schema is not None
        topic = source.topic
        if topic not in channels:
            identifier = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[topic] = writer.register_channel(
                topic, source.message_encoding, identifier, source.metadata
            )
        counts[topic] = counts.get(topic, -1) + 1
        changed = change(topic, counts[topic], each_message.data)
        if changed is not None:
            time_ns = times(each_message.log_time)
            writer.add_message(channels[topic], time_ns, changed, time_ns)
    for topic, time_ns, data in more or []:
        writer.add_message(channels[topic], time_ns, data, time_ns)
    writer.finish()
    return out.getvalue()


@lru_cache
def _reference() -> bytes:
    return REFERENCE.read_bytes()


def on(topic: str, edit: Callable[[int, bytes], bytes | None]) -> Callable[..., bytes | None]:
    def change(name: str, number: int, data: bytes) -> bytes | None:
        return edit(number, data) if name == topic else data

    return change


def stamped(data: bytes, sec: int) -> bytes:
    return data[:4] + struct.pack("<i", sec) + data[8:]


def joint_state(names: int) -> bytes:
    """Return a serialised JointState of so many joints without a position."""
    texts = b"".join(struct.pack("<I", 2) + b"j\0" + bytes(2) for _ in range(names))
    head = b"\0\1\0\0" + bytes(8) + struct.pack("<I", 1) + bytes(4) + struct.pack("<I", names)
    return head + texts + struct.pack("<III", 0, 0, 0)


NUMBERS = {
    "1e308": struct.pack("<d", 1e308),
    "nan": struct.pack("<d", float("nan")),
    "inf": struct.pack("<d", float("inf")),
    "5e-324": struct.pack("<d", 5e-324),
}
for _title, _number in NUMBERS.items():
    # The last numbers of a pose lie before its covariance.
    CASES[f"flight: every number of joint_states is {_title}"] = (
        lambda number=_number: flight(  # type: ignore[misc]
            on("/joint_states", lambda n, data: data[:-56] + number * 7)
        )
    )
    CASES[f"flight: poses of {_title}"] = (
        lambda number=_number: flight(  # type: ignore[misc]
            on("/odom", lambda n, data: data[:-700] + number * 7 + data[-644:])
        )
    )


NESTED = "[" * 100_000
_PAIR = struct.pack("<IBxxx", 1, 0)
"""An empty text, padded."""
_STATUS_HEAD = b"\0\1\0\0" + bytes(4) + _PAIR * 3 + struct.pack("<I", 3_000_000)

CASES |= {
    "flight: cut messages": lambda: flight(lambda topic, number, data: data[: number % 40]),
    "flight: empty messages": lambda: flight(lambda topic, number, data: b""),
    "flight: messages of 0xFF": lambda: flight(
        lambda topic, number, data: data[:4] + b"\xff" * (len(data) - 4)
    ),
    "flight: frames that are no text": lambda: flight(
        on("/odom", lambda n, data: data.replace(b"world", b"\xff\xfe\xfd\xfc\xfb"))
    ),
    "flight: a state in 2038": lambda: flight(
        on("/joint_states", lambda n, data: stamped(data, 2**31 - 1) if n == 9 else data)
    ),
    "flight: a state in 1901": lambda: flight(
        on("/odom", lambda n, data: stamped(data, -(2**31)) if n == 9 else data)
    ),
    "flight: 20000 joints": lambda: flight(
        on("/joint_states", lambda n, data: joint_state(20_000) if n == 0 else data)
    ),
    "flight: 3000 joints in every state": lambda: flight(
        on("/joint_states", lambda n, data: joint_state(3_000))
    ),
    "flight: a status of three million values": lambda: flight(
        more=[("/planner/status", 10, _STATUS_HEAD + _PAIR * 2 * 3_000_000)]
    ),
    "flight: log times up to 2^63": lambda: flight(
        times=lambda time_ns: min(time_ns * 10**11, 2**63 - 1)
    ),
    "flight: parameters nested 100000 deep": lambda: flight(
        metadata={"parameters/plant": {"tick_rate": NESTED}}
    ),
    "flight: parameters of 1e400 and 10^5000": lambda: flight(
        metadata={"parameters/plant": {"tick_rate": "1e400", "position_mass": "1" + "0" * 5000}}
    ),
    "flight: a tick rate of 1e-3 and 1e5": lambda: flight(
        metadata={"parameters/plant": {"tick_rate": "100000.0"}}
    ),
    "flight: a scenario nested 100000 deep": lambda: flight(
        metadata={
            "scenario": {"published": NESTED + "]" * 100_000},
            "parameters/planner": {"method": NESTED + "]" * 100_000},
        }
    ),
}


def robot(joints: int, *, chain: bool = True) -> bytes:
    parts = ['<robot name="r"><link name="l0"><inertial><mass value="1"/>']
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>'
    parts.append(inertia)
    for k in range(joints):
        parts.append(f'<link name="l{k + 1}"><inertial><mass value="1"/>{inertia}')
        parts.append(
            f'<joint name="j{k}" type="revolute"><parent link="l{k if chain else 0}"/>'
            f'<child link="l{k + 1}"/><axis xyz="0 0 1"/>'
            '<limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        )
    return ("".join(parts) + "</robot>").encode()


LAUGHS = (
    '<!DOCTYPE r [<!ENTITY a0 "ha">'
    + "".join(f'<!ENTITY a{k + 1} "{f"&a{k};" * 10}">' for k in range(10))
    + "]>"
)
URDFS = {
    "empty": b"",
    "noise": bytes(range(256)) * 40,
    "references that multiply": f'{LAUGHS}<robot name="&a10;"><link name="x"/></robot>'.encode(),
    "references that multiply in text": f'{LAUGHS}<robot name="r">&a10;</robot>'.encode(),
    "a file of the machine": (
        b'<!DOCTYPE r [<!ENTITY f SYSTEM "file:///etc/passwd">]>'
        b'<robot name="r"><link name="x">&f;</link></robot>'
    ),
    "100000 elements deep": b"<robot>" + b"<link>" * 100_000 + b"</link>" * 100_000 + b"</robot>",
    "a chain of 2000 joints": robot(2_000),
    "a chain of 60 joints": robot(60),
    "a chain of 190 joints": robot(190),
    "a star of 20000 joints": robot(20_000, chain=False),
    "a name of 5 MB": b'<robot name="' + b"r" * 5_000_000 + b'"><link name="x"/></robot>',
    "in a loop": (
        b'<robot name="r"><link name="a"/><link name="b"/>'
        b'<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'
        b'<joint name="k" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
    ),
}
CASES |= {f"URDF: {title}": partial(flight, urdf=urdf) for title, urdf in URDFS.items()}
