"""Definitions and hashes of message types, and columns cut out of serialised messages."""

from __future__ import annotations

import importlib
import json
import struct
import sys
from collections.abc import Callable, Iterator
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import deserialize_message, serialize_message
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from visualization_msgs.msg import Marker

from spacerobot_ros.bag import RecordingError, message_definition, type_hash
from spacerobot_ros.bag.series import read_columns
from spacerobot_ros.messages.definitions import installed_type, message_type
from spacerobot_ros.nodes.common.messages import message_class

TYPES = [
    "diagnostic_msgs/msg/DiagnosticArray",
    "diagnostic_msgs/msg/DiagnosticStatus",
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/WrenchStamped",
    "nav_msgs/msg/Odometry",
    "nav_msgs/msg/Path",
    "rosgraph_msgs/msg/Clock",
    "sensor_msgs/msg/JointState",
    "std_msgs/msg/Float64MultiArray",
    "std_msgs/msg/String",
    "trajectory_msgs/msg/JointTrajectory",
    "visualization_msgs/msg/MarkerArray",
]

Install = Callable[[str, dict[str, str]], None]


@pytest.mark.parametrize("type_name", TYPES)
def test_a_definition_names_the_types_that_its_package_says_it_uses(type_name: str) -> None:
    description = json.loads(_installed(f"{type_name}.json").read_text())
    used = description["type_description_msg"]["referenced_type_descriptions"]
    expected = sorted(entry["type_name"].replace("/msg/", "/") for entry in used)
    assert sorted(_sections(message_definition(type_name))) == expected


@pytest.fixture
def without_packages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Find no message package that is installed."""
    functions = (message_definition, type_hash)
    with monkeypatch.context() as patched:
        patched.delenv("AMENT_PREFIX_PATH", raising=False)
        patched.setattr(sys, "prefix", str(tmp_path))
        for function in functions:
            function.cache_clear()
        yield
    for function in functions:
        function.cache_clear()


@pytest.mark.parametrize("installed", [True, False])
@pytest.mark.parametrize("type_name", [*TYPES, "tf2_msgs/msg/TFMessage"])
def test_types_of_jazzy_need_no_package(
    type_name: str, installed: bool, request: pytest.FixtureRequest
) -> None:
    if not installed:
        request.getfixturevalue("without_packages")
        with pytest.raises(RecordingError, match="own_msgs is neither on AMENT_PREFIX_PATH nor in"):
            message_definition("own_msgs/msg/A")
    jazzy = get_typestore(Stores.ROS2_JAZZY)
    types = get_types_from_msg(message_definition(type_name), type_name)
    assert {name: fields for name, (_, fields) in types.items()} == {
        name: jazzy.fielddefs[name][1] for name in types
    }
    assert type_hash(type_name) == jazzy.hash_rihs01(type_name)


def test_types_follow_depth_first_and_sorted() -> None:
    assert _sections(message_definition("nav_msgs/msg/Odometry")) == [
        "geometry_msgs/PoseWithCovariance",
        "geometry_msgs/Pose",
        "geometry_msgs/Point",
        "geometry_msgs/Quaternion",
        "geometry_msgs/TwistWithCovariance",
        "geometry_msgs/Twist",
        "geometry_msgs/Vector3",
        "std_msgs/Header",
        "builtin_interfaces/Time",
    ]


def test_the_text_is_that_of_rosbag2(prefix_with_package: Install) -> None:
    # The expectation of rosbag2's own test of its message definitions.
    prefix_with_package(
        "rosbag2_like_a", {"ComplexMsg": "rosbag2_like_a/BasicMsg b\n", "BasicMsg": "float32 c\n"}
    )
    assert message_definition("rosbag2_like_a/msg/ComplexMsg") == (
        "rosbag2_like_a/BasicMsg b\n"
        "\n"
        "================================================================================\n"
        "MSG: rosbag2_like_a/BasicMsg\n"
        "float32 c\n"
    )


def test_only_types_of_fields_count_as_dependencies(prefix_with_package: Install) -> None:
    text = (
        "# Leaf in a comment\r\n"
        "uint8 CONSTANT=1  # Leaf\n"
        "string<=10 bounded\n"
        "string<=10[<=3] bounded_list\n"
        "wstring wide\n"
        "float64[<=3] numbers\n"
        "Leaf[2] leaves\n"
        "  Leaf indented\n"
        "std_msgs/Header header\n"
    )
    prefix_with_package("rosbag2_like_b", {"Tree": text, "Leaf": "bool green"})
    definition = message_definition("rosbag2_like_b/msg/Tree")
    assert definition.startswith(text + f"\n{'=' * 80}\nMSG: rosbag2_like_b/Leaf\nbool green\n===")
    assert _sections(definition) == [
        "rosbag2_like_b/Leaf",
        "std_msgs/Header",
        "builtin_interfaces/Time",
    ]


ACTION = """\
# Where to.
Leaf goal
---
uint8 NONE=0
bool arrived
---
float64 distance
Leaf[] passed
"""


@pytest.mark.parametrize(
    ("part", "text", "used"),
    [
        ("Goal", "# Where to.\nLeaf goal\n", ["Leaf"]),
        ("Result", "uint8 NONE=0\nbool arrived\n", []),
        ("Feedback", "float64 distance\nLeaf[] passed\n", ["Leaf"]),
        (
            "FeedbackMessage",
            "unique_identifier_msgs/UUID goal_id\nrosbag2_like_e/Move_Feedback feedback\n",
            ["Move_Feedback", "Leaf"],
        ),
        (
            "SendGoal_Request",
            "unique_identifier_msgs/UUID goal_id\nrosbag2_like_e/Move_Goal goal\n",
            ["Move_Goal", "Leaf"],
        ),
    ],
)
def test_messages_of_actions_are_defined_by_their_files(
    part: str, text: str, used: list[str], prefix_with_package: Install
) -> None:
    prefix_with_package("rosbag2_like_e", {"Leaf": "bool green\n", "action/Move.action": ACTION})
    name = f"rosbag2_like_e/action/Move_{part}"
    message_definition.cache_clear()
    definition = message_definition(name)
    assert definition == message_definition(f"rosbag2_like_e/Move_{part}")
    assert definition.startswith(text)
    own = [each for each in _sections(definition) if each.startswith("rosbag2_like_e")]
    assert own == [f"rosbag2_like_e/{each}" for each in used]
    assert set(get_types_from_msg(definition, name)) >= {name}
    assert type_hash(name) == ""


@pytest.mark.parametrize("service", ["std_srvs/srv/SetBool", "nav_msgs/srv/GetMap"])
@pytest.mark.parametrize("part", ["Request", "Response", "Event"])
def test_messages_of_services_have_the_fields_of_their_classes(service: str, part: str) -> None:
    package, _, name = service.split("/")
    kind = getattr(getattr(importlib.import_module(f"{package}.srv"), name), part)
    type_name = f"{service}_{part}"
    plain = type_name.replace("/srv/", "/msg/")
    _, fields = get_types_from_msg(message_definition(type_name), plain)[plain]
    dummy = {"structure_needs_at_least_one_member"}
    assert {name for name, _ in fields} - dummy == set(kind.get_fields_and_field_types())
    assert message_class(type_name) is kind
    described = json.loads(_installed(f"{service}.json").read_text())["type_hashes"]
    assert {"type_name": type_name, "hash_string": type_hash(type_name)} in described


def test_a_type_may_be_named_without_its_folder() -> None:
    assert message_definition("std_msgs/String") == message_definition("std_msgs/msg/String")
    assert type_hash("std_msgs/String") == type_hash("std_msgs/msg/String")


def test_the_environment_is_searched_without_a_search_path(monkeypatch: pytest.MonkeyPatch) -> None:
    if not (Path(sys.prefix) / "share" / "std_msgs").is_dir():
        pytest.skip("the messages are not installed in this environment")
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    message_definition.cache_clear()
    assert message_definition("std_msgs/msg/String").endswith("string data\n")


def test_a_package_without_descriptions_has_no_hashes(prefix_with_package: Install) -> None:
    prefix_with_package("rosbag2_like_c", {"Leaf": "bool green\n"})
    assert type_hash("rosbag2_like_c/msg/Leaf") == ""


@pytest.mark.parametrize("function", [message_definition, type_hash])
@pytest.mark.parametrize(
    ("type_name", "words"),
    [
        ("Odometry", "'Odometry' is not the name of a message type"),
        ("std_srvs/action/SetBool_Event", "'std_srvs/action/SetBool_Event' is not the name of"),
        ("nav_msgs/srv/NoSuch_Event", "has no message NoSuch_Event"),
        ("nav_msgs/srv/GetMap", "'nav_msgs/srv/GetMap' is not the name of a message type"),
        ("../etc/msg/passwd", "is not the name of a message type"),
        ("no_such_msgs/msg/A", "no_such_msgs is neither on AMENT_PREFIX_PATH nor in"),
        ("nav_msgs/msg/NoSuch", "has no message NoSuch"),
    ],
)
def test_what_is_not_there_is_said(
    function: Callable[[str], Any], type_name: str, words: str
) -> None:
    with pytest.raises(RecordingError, match=words) as caught:
        function(type_name)
    assert str(caught.value).endswith(".")
    assert "\n" not in str(caught.value)


def test_a_missing_dependency_is_named(prefix_with_package: Install) -> None:
    prefix_with_package("rosbag2_like_d", {"Tree": "no_such_msgs/Leaf leaf\n"})
    with pytest.raises(RecordingError, match="no_such_msgs"):
        message_definition("rosbag2_like_d/msg/Tree")


def _sections(text: str) -> list[str]:
    return [line.removeprefix("MSG: ") for line in text.splitlines() if line.startswith("MSG: ")]


def _installed(path: str) -> Path:
    # The message classes tell where their package is: <prefix>/lib/.../<package>/msg.
    package = path.split("/")[0]
    module = Path(__import__(package).__file__ or "")
    return next(p for p in (q / "share" / path for q in module.parents) if p.is_file())


def test_two_topics_may_mean_other_types_by_one_name() -> None:
    text = b"float64 x\nother/Part part\n" + b"=" * 80 + b"\nMSG: other/Part\nint32 %s\n"
    data = bytes([0, 1, 0, 0]) + struct.pack("<di", 2.5, 7)
    one = message_type("own/msg/Whole", text % b"count").decode(data)
    other = message_type("own/msg/Another", text % b"number").decode(data)
    assert (one.x, one.part.count, other.part.number) == (2.5, 7, 7)


# -- columns cut out of serialised messages ----------------------------------------------------

Sample = tuple[str, str, Any]

TYPESTORE = get_typestore(Stores.ROS2_JAZZY)

# Fields outside of lists of messages and of strings, counted in the definitions by hand.
FIELD_COUNTS = {
    "/odom": 4 + 7 + 1 + 6 + 1,
    "/base_pose": 3 + 7,
    "/joint_states": 3 + 3,
    "/momentum": 2,
    "/gait_schedule": 3,
    "/planned_path": 3,
    "/base_wrench": 3 + 6,
    "/planner/status": 4,
    "/diagnostics": 3,
    "/robot_description": 1,
    "/markers": 0,
    "/clock": 2,
}


def check(messages: list[bytes], type_name: str, decoded: list[Any] | None = None) -> int:
    """Compare every column with the decoded messages; return how many columns there are."""
    found = read_columns(messages, installed_type(type_name))
    assert found is not None
    if decoded is None:
        decoded = [TYPESTORE.deserialize_cdr(message, type_name) for message in messages]
    for path in found.paths:
        expected = list(map(attrgetter(path), decoded))
        column = found[path]
        if isinstance(column, list):
            assert column == expected
        else:
            assert len(column) == len(messages)
            # Equal to the bit, not-a-number and signed zeros included.
            expected_array = np.array(expected).astype(column.dtype)
            assert column.shape == expected_array.shape
            assert column.tobytes() == expected_array.tobytes()
    return len(found.paths)


def test_every_type(samples: list[Sample]) -> None:
    for topic, type_name, message in samples:
        assert check([serialize_message(message)] * 3, type_name) == FIELD_COUNTS[topic], topic


words = st.text(st.characters(codec="utf-8", exclude_characters="\0"), max_size=6)
numbers = st.floats(allow_nan=True, width=64)


@st.composite
def joint_states(draw: st.DrawFn) -> list[JointState]:
    """Messages of one layout and with different values; any of the lists may be empty."""
    names = draw(st.lists(words, max_size=4))
    frame_id = draw(words)
    sizes = draw(st.tuples(*[st.integers(0, 3)] * 3))
    values = [st.lists(numbers, min_size=size, max_size=size) for size in sizes]
    return [
        JointState(
            header=Header(frame_id=frame_id),
            name=names,
            position=draw(values[0]),
            velocity=draw(values[1]),
            effort=draw(values[2]),
        )
        for _ in range(draw(st.integers(1, 5)))
    ]


@settings(deadline=None, max_examples=100)
@given(joint_states())
def test_joint_states(messages: list[JointState]) -> None:
    data = [serialize_message(message) for message in messages]
    decoded = [deserialize_message(message, JointState) for message in data]
    assert check(data, "sensor_msgs/msg/JointState", decoded) == 6


@settings(deadline=None, max_examples=50)
@given(words, words, words, st.booleans(), st.integers(0, 3))
def test_markers(ns: str, text: str, mesh: str, locked: bool, count: int) -> None:
    marker = Marker(ns=ns, text=text, mesh_resource=mesh, frame_locked=locked, type=count)
    assert check([serialize_message(marker)] * 2, "visualization_msgs/msg/Marker") == 35


def test_strings_of_one_length_may_differ() -> None:
    states = [DiagnosticStatus(name="plan", message=m) for m in ("idle", "busy", "Δok")]
    data = [serialize_message(state) for state in states]
    assert check(data, "diagnostic_msgs/msg/DiagnosticStatus") == 4


@pytest.mark.parametrize(
    "messages",
    [
        # As long as the other one, with another layout.
        [JointState(name=["ab", "c"]), JointState(name=["a", "bc"])],
        [JointState(position=[1.0], velocity=[]), JointState(position=[], velocity=[1.0])],
        [JointState(name=["a"]), JointState(name=["a", "b"])],
        [],
    ],
)
def test_there_are_no_columns_where_layouts_differ(messages: list[JointState]) -> None:
    data = [serialize_message(message).ljust(80, b"\0") for message in messages]
    assert read_columns(data, installed_type("sensor_msgs/msg/JointState")) is None


def test_there_are_no_columns_in_what_is_no_message() -> None:
    data = serialize_message(JointState(name=["a"]))
    for broken in (b"", data[:3], data[:10], data[:-12], b"\0\0" + data[2:]):
        assert read_columns([broken], installed_type("sensor_msgs/msg/JointState")) is None


def test_there_are_no_columns_where_the_order_of_bytes_changes() -> None:
    little, big = (bytes([0, order, 0, 0]) + bytes(8) for order in (1, 0))
    time = installed_type("builtin_interfaces/msg/Time")
    assert read_columns([little, little], time) is not None
    assert read_columns([little, big], time) is None


def test_numbers_beyond_int64_stay_as_they_are() -> None:
    message = bytes([0, 1, 0, 0]) + (2**63 + 5).to_bytes(8, "little")
    found = read_columns([message] * 2, installed_type("std_msgs/msg/UInt64"))
    assert found is not None
    assert [int(each) for each in found["data"]] == [2**63 + 5] * 2
