"""Message definitions and type hashes, from the share folders of the message packages."""

from __future__ import annotations

import json
import re
import sys
from functools import cache
from pathlib import Path

from spacerobot_ros.bag.errors import RecordingError

_TYPE_NAME = re.compile(r"([a-zA-Z]\w*)/(?:msg/)?([a-zA-Z]\w*)", re.ASCII)

# rosbag2's own expression for the type at the start of a field or constant: with any other one the
# text of a schema could differ from the text that `ros2 bag record` writes.
_FIELD_TYPE = re.compile(r"(?:^|\n)\s*([a-zA-Z0-9_/]+)(?:\[[^\]]*\])?\s+", re.ASCII)

_NUMBERS = {f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)}
_PRIMITIVES = {"bool", "byte", "char", "float32", "float64", "string", "wstring", *_NUMBERS}


@cache
def message_definition(type_name: str) -> str:
    """Give the full definition of a message type as rosbag2 writes it into a schema.

    That is the text of the `.msg` file, then for every type it uses, depth first, in alphabetical
    order and each once, a separator line, `MSG: package/Type` and its text.

    Args:
        type_name: such as `nav_msgs/msg/Odometry`.

    Returns:
        The concatenated definition (encoding `ros2msg`).

    Raises:
        RecordingError: the name is not one of a message type, or its package or one that it uses is
            not installed.
    """
    return _with_dependencies(type_name, set())


def _with_dependencies(type_name: str, seen: set[str]) -> str:
    package, name = _split(type_name)
    text = _message_file(package, name).read_bytes().decode()
    types = {
        found if "/" in found else f"{package}/{found}"
        for found in _FIELD_TYPE.findall(text)
        if found not in _PRIMITIVES
    }
    parts = [text]
    for dependency in sorted(types):
        if dependency not in seen:
            seen.add(dependency)
            definition = _with_dependencies(dependency, seen)
            parts.append(f"\n{'=' * 80}\nMSG: {dependency}\n{definition}")
    return "".join(parts)


@cache
def type_hash(type_name: str) -> str:
    """Give the hash by which ROS 2 tells apart versions of a message type.

    Args:
        type_name: such as `nav_msgs/msg/Odometry`.

    Returns:
        `RIHS01_` and 64 hexadecimal digits; empty where the package was installed without the
        description of its types (`share/<package>/msg/<Type>.json`).

    Raises:
        RecordingError: the name is not one of a message type, or its package is not installed.
    """
    package, name = _split(type_name)
    description = _message_file(package, name).with_suffix(".json")
    if not description.is_file():
        return ""
    hashes = json.loads(description.read_bytes())["type_hashes"]
    return next(
        (str(h["hash_string"]) for h in hashes if h["type_name"] == f"{package}/msg/{name}"), ""
    )


def _split(type_name: str) -> tuple[str, str]:
    match = _TYPE_NAME.fullmatch(type_name)
    if match is None:
        raise RecordingError(
            f"{type_name!r} is not the name of a message type: write it as 'package/msg/Type'."
        )
    return match[1], match[2]


def _message_file(package: str, name: str) -> Path:
    share = _share_folder(package)
    path = share / "msg" / f"{name}.msg"
    if not path.is_file():
        raise RecordingError(
            f"The package {package} in {share} has no message {name}: "
            "check the name, or install the version that has it."
        )
    return path


def _share_folder(package: str) -> Path:
    try:
        from ament_index_python.packages import get_package_share_directory

        return Path(get_package_share_directory(package))
    except (ImportError, LookupError, OSError, ValueError):
        # The wheels install into the environment's own prefix and set no search path.
        folder = Path(sys.prefix) / "share" / package
    if not folder.is_dir():
        raise RecordingError(
            f"The message package {package} is neither on AMENT_PREFIX_PATH nor in "
            f"{folder.parent}: install it, or source the workspace that has it."
        )
    return folder
