"""Files whose schemas and qualities of service were made to harm their reader."""

from __future__ import annotations

import struct

from mcap.records import (
    Schema,
)
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

# -- schemas ----------------------------------------------------------------------------------


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


# -- quality of service -----------------------------------------------------------------------

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
