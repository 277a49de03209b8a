"""Files whose schemas, qualities of service, messages and robots were made to harm their reader."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import lru_cache
from io import BytesIO
from pathlib import Path

from mcap.reader import make_reader
from mcap.records import (
    Schema,
)
from mcap.writer import CompressionType, Writer
from support.hostile.records import (
    CASES,
    GOOD,
    SEPARATOR,
    STRING,
    bag,
    case,
    channel,
    encoded,
    message,
    plain,
    string,
)

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
for _title, (_text, _type) in SCHEMAS.items():
    CASES[f"schema: {_title}"] = lambda text=_text, name=_type: of_type(text, name)  # type: ignore[misc]


@case("schema: empty lists in lists")
def _() -> bytes:
    # Were elements without bytes believed, this would be 1e11 of them.
    text = f"C[] x\n{INNER}D[] y\n{SEPARATOR}MSG: a/D\nuint8[0] z\n"
    count = 200_000
    data = b"\0\1\0\0" + struct.pack("<I", count) + struct.pack("<I", 400_000) * count
    return of_type(text, data=data)


@case("schema: a list of 4e9 messages")
def _() -> bytes:
    text = f"C[] x\n{INNER}float64 y\n"
    return of_type(text, data=b"\0\1\0\0" + struct.pack("<I", 2**32 - 1) + bytes(100))


@case("schema: two definitions of one type")
def _() -> bytes:
    return bag(GOOD, summary=encoded(Schema(2, b"int32 x\n", "ros2msg", STRING.name)))


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
for _title, _text in QOS.items():
    CASES[f"QoS: {_title}"] = lambda text=_text: bag(  # type: ignore[misc]
        GOOD, channels=[channel(offered_qos_profiles=text)]
    )

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


@case("flight: cut messages")
def _() -> bytes:
    return flight(lambda topic, number, data: data[: number % 40])


@case("flight: empty messages")
def _() -> bytes:
    return flight(lambda topic, number, data: b"")


@case("flight: messages of 0xFF")
def _() -> bytes:
    return flight(lambda topic, number, data: data[:4] + b"\xff" * (len(data) - 4))


@case("flight: frames that are no text")
def _() -> bytes:
    return flight(on("/odom", lambda n, data: data.replace(b"world", b"\xff\xfe\xfd\xfc\xfb")))


@case("flight: a state in 2038")
def _() -> bytes:
    return flight(on("/joint_states", lambda n, data: stamped(data, 2**31 - 1) if n == 9 else data))


@case("flight: a state in 1901")
def _() -> bytes:
    return flight(on("/odom", lambda n, data: stamped(data, -(2**31)) if n == 9 else data))


@case("flight: 20000 joints")
def _() -> bytes:
    return flight(on("/joint_states", lambda n, data: joint_state(20_000) if n == 0 else data))


@case("flight: 3000 joints in every state")
def _() -> bytes:
    return flight(on("/joint_states", lambda n, data: joint_state(3_000)))


@case("flight: a status of three million values")
def _() -> bytes:
    pair = struct.pack("<I", 1) + bytes(4) + struct.pack("<I", 1) + bytes(4)
    count = 3_000_000
    head = b"\0\1\0\0" + b"\0" + bytes(3) + (struct.pack("<I", 1) + bytes(4)) * 3
    data = head + struct.pack("<I", count) + pair * count
    return flight(more=[("/planner/status", 10, data)])


@case("flight: log times up to 2^63")
def _() -> bytes:
    return flight(times=lambda time_ns: min(time_ns * 10**11, 2**63 - 1))


@case("flight: parameters nested 100000 deep")
def _() -> bytes:
    return flight(metadata={"parameters/plant": {"tick_rate": "[" * 100_000}})


@case("flight: parameters of 1e400 and 10^5000")
def _() -> bytes:
    given = {"tick_rate": "1e400", "position_mass": "1" + "0" * 5000}
    return flight(metadata={"parameters/plant": given})


@case("flight: a tick rate of 1e-3 and 1e5")
def _() -> bytes:
    return flight(metadata={"parameters/plant": {"tick_rate": "100000.0"}})


@case("flight: a scenario nested 100000 deep")
def _() -> bytes:
    nested = "[" * 100_000 + "]" * 100_000
    return flight(
        metadata={"scenario": {"published": nested}, "parameters/planner": {"method": nested}}
    )


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
for _title, _urdf in URDFS.items():
    CASES[f"URDF: {_title}"] = lambda urdf=_urdf: flight(urdf=urdf)  # type: ignore[misc]
