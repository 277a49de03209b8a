"""Lines, parameters and files that nobody would write: one sentence, or what they say."""

from __future__ import annotations

import copy
import math
import random
import struct
import xml.etree.ElementTree as ET
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
import yaml
from hypothesis import strategies as st
from mcap.reader import make_reader
from rclpy.parameter import Parameter as RosParameter
from rclpy.serialization import serialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from support.fuzzing import FINITE, MODEST, NUMBERS, TEXTS, VALUES, attempt, damaged, fuzz
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import BagWriter, read_bag
from spacerobot_ros.errors import (
    ParameterError,
    PlanningError,
    RobotDescriptionError,
    SpaceRobotError,
)
from spacerobot_ros.messages.readers import TemplateReader
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import RobotDescription
from spacerobot_ros.model.thrusters import find_thrusters
from spacerobot_ros.model.urdf import load_robot, parse_robot
from spacerobot_ros.nodes import NODE_TYPES, ReplayNode
from spacerobot_ros.nodes.common.node import AUTOSTART, FlightNode
from spacerobot_ros.parameters import Parameter, declared
from spacerobot_ros.planning import Goal
from spacerobot_ros.resources import resource_names, robot_file, share_directory
from spacerobot_ros.scenario import Scenario, load_scenario
from spacerobot_ros.scenario_files import NODES, parse_setting
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import (
    FAULT_KINDS,
    POSE_AXES,
    SENSOR_GROUPS,
    WRENCH_AXES,
    FaultTargets,
    Timeline,
    parse_fault,
)

JOINTS = ("slider_1", "slider_2", "slider_3")
TARGETS = (*JOINTS, *WRENCH_AXES, *POSE_AXES, *SENSOR_GROUPS, "odom", "all", "nozzle_1")
WORDS = st.one_of(
    st.sampled_from([*FAULT_KINDS, *TARGETS, "at", "until", "clear"]), NUMBERS.map(str), TEXTS
)
LINES = st.one_of(
    st.lists(WORDS, max_size=8).map(" ".join),
    st.tuples(
        st.sampled_from(list(FAULT_KINDS)), st.sampled_from(TARGETS), st.lists(WORDS, max_size=5)
    ).map(lambda parts: " ".join([parts[0], parts[1], *parts[2]])),
    st.builds(
        "{} {} at {}".format,
        st.sampled_from(["joint_stuck", "joint_slow", "actuator_bias", "actuator_noise"]),
        st.builds("{} {}".format, st.sampled_from(JOINTS), st.floats(0.0, 1.0)),
        st.floats(0.0, 1.0),
    ),
    st.builds(
        "{} {} {} until {}".format,
        st.sampled_from(["thruster_weak", "thruster_stuck"]),
        st.sampled_from(WRENCH_AXES),
        st.floats(0.0, 1.0) | NUMBERS,
        st.floats(3.5, 9.0) | NUMBERS,
    ),
    st.builds(
        "{} {} {} at {} until {}".format,
        st.sampled_from(list(FAULT_KINDS)),
        st.sampled_from(TARGETS),
        NUMBERS,
        NUMBERS,
        NUMBERS,
    ),
    TEXTS,
)


@fuzz("fault line", LINES, st.booleans(), fast=50, long=1500)
def test_a_line_is_refused_or_says_the_same_when_written_again(line: str, wrench: bool) -> None:
    targets = FaultTargets(JOINTS, wrench, ("nozzle_1",) if wrench else ())
    fault = attempt("fault line", parse_fault, line, targets, 3.0)
    if fault is not None:
        assert math.isfinite(fault.value)
        assert fault.start < fault.end
        assert parse_fault(str(fault), targets).kind == fault.kind


@fuzz(
    "fault timeline", st.lists(LINES, max_size=4), st.lists(NUMBERS, max_size=4), fast=20, long=400
)
def test_a_timeline_of_lines(lines: list[str], times: list[float]) -> None:
    targets = FaultTargets(JOINTS, True)
    timeline = attempt(
        "fault timeline", Timeline, lines, lambda line, now: parse_fault(line, targets, now)
    )
    if timeline is not None:
        for time in sorted(t for t in times if math.isfinite(t)):
            assert all(f.start <= time < f.end for f in timeline.at(time))


_ROBOT: list[SpaceRobot] = []


@fuzz(
    "faulty plant",
    st.lists(LINES, max_size=3),
    st.sampled_from(["velocity", "effort"]),
    fast=15,
    long=300,
)
def test_a_plant_under_any_faults_stays_finite_or_says_why_it_stops(
    lines: list[str], actuation: str
) -> None:
    if not _ROBOT:
        _ROBOT.append(SpaceRobot.from_file(robot_file("sliding_masses")))
    plant = build_plant(_ROBOT[0], PlantConfig(actuation=actuation))
    for line in lines:
        attempt("faulty plant", plant.inject, line)
    commands = [np.full(3, 0.1), *([np.zeros(6)] if actuation == "effort" else [])]

    def fly() -> None:
        for _ in range(5):
            plant.step(*commands)
            for numbers in (plant.pose, plant.twist, plant.q, plant.qdot, plant.momentum):
                assert np.all(np.isfinite(numbers)), lines

    attempt("faulty plant", fly)


# -- parameters of every node with any values: taken in their own type, or refused by name -----


KINDS: list[type[FlightNode]] = [*NODE_TYPES.values(), ReplayNode]
SPECS = [AUTOSTART, *(spec for kind in KINDS for spec in declared(kind.Config))]
WHOLE = st.integers(-(2**63), 2**63 - 1)
ROS_VALUES = st.one_of(
    st.booleans(),
    WHOLE,
    NUMBERS,
    MODEST,
    TEXTS,
    st.lists(NUMBERS | MODEST, min_size=1, max_size=7),
    st.lists(WHOLE, min_size=1, max_size=4),
    st.lists(TEXTS, min_size=1, max_size=3),
)
"""What a parameter of ROS may hold."""

BASES: dict[str, dict[str, Any]] = {
    "plant": {"robot": "sliding_masses"},
    "planner": {"robot": "sliding_masses"},
    "coordinated_control": {"robot": "planar_manipulator"},
}
"""With these alone a node configures."""


@fuzz("parameter", st.sampled_from(SPECS), st.one_of(VALUES, ROS_VALUES), fast=100, long=3000)
def test_every_parameter_takes_a_value_or_names_itself(spec: Parameter, value: object) -> None:
    taken = attempt("parameter", spec.checked, value)
    if taken is None:
        with pytest.raises(SpaceRobotError, match=spec.name):
            spec.checked(value)
        return
    assert type(taken) is type(spec.default)
    if isinstance(taken, (int, float)) and not isinstance(taken, bool):
        assert math.isfinite(taken)
        assert spec.minimum <= taken <= spec.maximum
    assert spec.checked(taken) == taken


def plausible(spec: Parameter) -> st.SearchStrategy[Any]:
    """Return values of a parameter's own type, at the ends of its range and anywhere."""
    if isinstance(spec.default, bool):
        return st.booleans()
    if isinstance(spec.default, str):
        return st.sampled_from([*spec.choices]) if spec.choices else TEXTS
    if isinstance(spec.default, tuple):
        return st.lists(TEXTS if spec.texts else MODEST | FINITE, min_size=1, max_size=4)
    ends = st.sampled_from([x for x in (spec.minimum, spec.maximum) if math.isfinite(x)] or [0.0])
    numbers = st.one_of(ends, MODEST, st.floats(spec.minimum, spec.maximum))
    if isinstance(spec.default, float):
        return numbers.map(float)
    return numbers.filter(math.isfinite).map(lambda x: max(min(int(x), 2**63 - 1), -(2**63)))


@st.composite
def overrides(draw: st.DrawFn, node: str) -> dict[str, Any]:
    specs = [
        spec for spec in declared(NODE_TYPES[node].Config) if spec.name not in ("path", "robot")
    ]
    chosen = draw(st.lists(st.sampled_from(specs), min_size=1, max_size=3, unique_by=id))
    return {spec.name: draw(st.one_of(plausible(spec), ROS_VALUES)) for spec in chosen}


@pytest.mark.parametrize("node", BASES)
def test_a_node_configures_or_says_what_is_wrong(node: str, ros_context: rclpy.Context) -> None:
    @fuzz("node", overrides(node), fast=8, long=15)
    def construct(given: dict[str, Any]) -> None:
        parameters = [
            RosParameter(name, value=value) for name, value in (BASES[node] | given).items()
        ]
        made = attempt(
            "node",
            NODE_TYPES[node],
            context=ros_context,
            parameter_overrides=parameters,
            autostart=True,
        )
        if made is not None:
            made.trigger_deactivate()
            made.destroy_node()

    construct()


# -- scenario files, settings and tables of thrusters with any YAML in them --------------------


FILES = [
    (share_directory() / "config" / f"{name}.yaml").read_text(encoding="utf-8")
    for name in resource_names("config", ".yaml")
]
TABLE = {
    "defaults": {"isp": 220.0, "force": 10.0},
    "thrusters": [
        {"name": "a", "position": [1.0, 0.0, 0.0], "direction": [0.0, 1.0, 0.0]},
        {"name": "b", "position": [1.0, 0.0, 0.0], "rpy": [0.0, 1.5, 0.0], "min_on_time": 0.01},
    ],
}


def places(content: Any) -> list[tuple[Any, Any]]:
    """Return every container of a YAML document with every key or index in it."""
    if isinstance(content, dict):
        keys: list[Any] = list(content)
    elif isinstance(content, list):
        keys = list(range(len(content)))
    else:
        return []
    found = [(content, key) for key in keys]
    for key in keys:
        found += places(content[key])
    return found


def with_changes(content: Any, changes: list[tuple[int, bool, Any]]) -> Any:
    """Return a document with values replaced, or with their keys gone."""
    content = copy.deepcopy(content)
    for seed, drop, value in changes:
        found = places(content)
        if not found:
            break
        container, key = random.Random(seed).choice(found)
        if drop:
            del container[key]
        else:
            container[key] = copy.deepcopy(value)
    return content


CHANGES = st.lists(
    st.tuples(
        st.integers(0, 10_000),
        st.booleans(),
        st.one_of(VALUES, st.lists(NUMBERS, min_size=3, max_size=4)),
    ),
    min_size=1,
    max_size=3,
)


def write(path: Path, content: Any) -> str:
    # Dates, sets and tags are YAML too, and what is written here is read as what it was.
    path.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")
    return str(path)


def use(scenario: Scenario | None) -> None:
    """Look at what a run looks at."""
    if scenario is None:
        return
    assert np.all(np.isfinite(scenario.goal.position))
    assert np.all(np.isfinite(scenario.goal.quaternion))
    for node in NODES:
        attempt("scenario", scenario.config, node)


@fuzz("scenario", st.sampled_from(FILES), CHANGES, fast=30, long=800)
def test_a_changed_scenario(tmp_path: Path, text: str, changes: Any) -> None:
    file = write(tmp_path / "s.yaml", with_changes(yaml.safe_load(text), changes))
    use(attempt("scenario", load_scenario, file))


@fuzz(
    "damaged scenario",
    st.sampled_from(FILES).flatmap(lambda text: damaged(text.encode())),
    fast=20,
    long=500,
)
def test_a_damaged_scenario(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "s.yaml"
    path.write_bytes(raw)
    use(attempt("damaged scenario", load_scenario, str(path)))


@fuzz("scenario name", TEXTS, fast=15, long=200)
def test_a_scenario_of_any_name(name: str) -> None:
    attempt("scenario name", load_scenario, name)


@fuzz(
    "setting",
    st.one_of(
        TEXTS,
        st.builds(
            "{}.{}={}".format,
            st.sampled_from(NODES),
            TEXTS,
            st.one_of(TEXTS, NUMBERS.map(str), VALUES.map(str)),
        ),
        st.text(max_size=20).map(lambda text: f"plant.robot={text}"),
    ),
    fast=40,
    long=1000,
)
def test_a_setting(text: str) -> None:
    setting = attempt("setting", parse_setting, text)
    assert setting is None or setting[0] in NODES


@lru_cache
def robot() -> RobotDescription:
    return load_robot(robot_file("servicer"))


@fuzz("thruster table", CHANGES, fast=40, long=800)
def test_a_changed_table_of_thrusters(tmp_path: Path, changes: Any) -> None:
    file = write(tmp_path / "t.yaml", with_changes(TABLE, changes))
    table = attempt("thruster table", find_thrusters, file, robot())
    if table is not None:
        assert np.all(np.isfinite(table.wrenches))
        assert np.all(np.isfinite(table.mass_flow))
        table.missing()


@fuzz("damaged thruster table", damaged(yaml.safe_dump(TABLE).encode()), fast=20, long=400)
def test_a_damaged_table_of_thrusters(tmp_path: Path, raw: bytes) -> None:
    path = tmp_path / "t.yaml"
    path.write_bytes(raw)
    attempt("damaged thruster table", find_thrusters, path, robot())


# -- URDFs with elements and attributes changed: a robot whose numbers are finite, or a --------


ROBOT_TEXTS = [
    robot_file(name).read_text(encoding="utf-8") for name in resource_names("urdf", ".urdf")
]
ODD_VALUES = ["nan", "inf", "-inf", "-1", "0", "x", "", "1e308", "-1e308", "1e-320", "1e12", "1 2",
          "1 2 3", "0 0 0", "1e308 1e308 1e308", "1 2 3 4", "base_link", "revolute", "prismatic",
          "floating", "planar", "continuous", "fixed", "0x10", "1,5", "é",
          "a b\nc", "1_0"]  # fmt: skip


def changed(text: str, seed: int, changes: int) -> str:
    """Return a URDF with some elements dropped, doubled, moved or given other attributes."""
    draw = random.Random(seed)
    root = ET.fromstring(text)
    for _ in range(changes):
        parent = draw.choice([e for e in root.iter() if len(e)])
        element = draw.choice(list(parent))
        kind = draw.choice(["attribute"] * 5 + ["swap", "drop", "double", "strip", "move"])
        if kind in ("attribute", "swap", "strip"):
            carriers = [e for e in element.iter() if e.attrib]
            if not carriers:
                continue
            carrier = draw.choice(carriers)
            name = draw.choice(list(carrier.attrib))
            if kind == "strip":
                del carrier.attrib[name]
            elif kind == "swap":
                values = [e.attrib[name] for e in root.iter() if name in e.attrib]
                carrier.attrib[name] = draw.choice(values)
            else:
                carrier.attrib[name] = draw.choice(ODD_VALUES)
        elif kind == "drop":
            parent.remove(element)
        elif kind == "double":
            parent.append(copy.deepcopy(element))
        else:
            parent.remove(element)
            draw.choice(list(root.iter())).append(element)
        if not any(len(e) for e in root.iter()):
            break
    return ET.tostring(root, encoding="unicode")


MUTANTS = st.builds(
    changed, st.sampled_from(ROBOT_TEXTS), st.integers(0, 2**32), st.sampled_from([1, 1, 2, 4])
)


@fuzz("URDF", MUTANTS, fast=50, long=1800)
def test_a_changed_urdf(text: str) -> None:
    robot = attempt("URDF", parse_robot, text)
    if robot is None:
        return
    for body in robot.bodies:
        assert np.all(np.isfinite(body.inertia.about_com))
        assert np.all(np.isfinite(body.inertia.com))
    for link in robot.links:
        for shape in link.shapes:
            assert np.all(np.isfinite([*shape.size, *shape.rgba]))
    attempt("URDF", find_thrusters, "urdf", robot)


@fuzz("model", MUTANTS, fast=8, long=150)
def test_a_model_of_a_changed_urdf(text: str) -> None:
    robot = attempt("model", SpaceRobot.from_urdf, text)
    if robot is None:
        return
    assert robot.total_mass > 0
    q = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
    assert np.all(np.isfinite(robot.center_of_mass(q)))


@fuzz(
    "damaged URDF",
    st.sampled_from(ROBOT_TEXTS).flatmap(lambda text: damaged(text.encode())),
    fast=30,
    long=800,
)
def test_a_damaged_urdf(raw: bytes) -> None:
    attempt("damaged URDF", parse_robot, raw.decode(errors="replace"))


# -- inputs that once ended in another exception than a refusal --------------------------------

CHUNK = 6
ORIGIN, ZERO_TURN_PER_AREA = [0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]


def reader() -> TemplateReader:
    return TemplateReader("sensor_msgs/msg/JointState")


@pytest.mark.parametrize("text", [b"\xff\xfe", b"a\0"], ids=["not UTF-8", "zero byte inside"])
def test_numbers_behind_a_broken_string_are_read_in_their_place(text: bytes) -> None:
    raw = bytes(serialize_message(JointState(name=["ab"], velocity=[2.0], effort=[3.0])))
    read = reader()
    read.accept(raw.replace(b"ab\0", text + b"\0"))
    assert read.floats("velocity").tolist() == [2.0]


def test_a_large_quaternion_is_scaled_without_overflow() -> None:
    goal = Goal.checked(ORIGIN, [0.0, 0.0, 1e300, 1e300])
    assert goal.quaternion == pytest.approx([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])


@pytest.mark.parametrize("position", [[1e200, 0.0, 0.0], ["", 0, 0], {"x": 1}, [10**400, 0, 0]])
def test_a_position_that_is_no_place_is_refused(position: Any) -> None:
    with pytest.raises(PlanningError) as caught:
        Goal.checked(position, ZERO_TURN_PER_AREA)
    assert_one_sentence(str(caught.value), "goal position")


def test_a_rotation_vector_of_absurd_length_is_refused() -> None:
    with pytest.raises(PlanningError, match="rotation vector"):
        Goal.from_rotvec(ORIGIN, [1e200, 0.0, 0.0])


@pytest.mark.parametrize("value", [10**400, [10**400]])
def test_a_whole_number_beyond_every_float_is_refused(value: Any) -> None:
    default: Any = [0.0] if isinstance(value, list) else 0.0
    with pytest.raises(ParameterError, match="'size'"):
        Parameter("size", default, "m", "").checked(value)


@pytest.mark.parametrize("number", ["nan", "1e300"])
def test_a_size_that_is_no_size_is_refused(number: str) -> None:
    text = robot_file("servicer").read_text(encoding="utf-8")
    start = text.index('size="') + len('size="')
    with pytest.raises(RobotDescriptionError) as caught:
        parse_robot(text[:start] + f"{number} 1 1" + text[text.index('"', start) :])
    assert_one_sentence(str(caught.value), "<box> of link")


def test_a_chunk_that_claims_to_be_larger_than_the_memory_takes_no_more(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with BagWriter(path) as writer:
        channel = writer.add_topic("/a", "std_msgs/msg/Float64")
        writer.write(channel, serialize_message(Float64(data=1.0)), 0, 0)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    data = bytearray(path.read_bytes())
    # Opcode and length, start, end, uncompressed size, checksum, "zstd": then the data's length.
    start = summary.chunk_indexes[0].chunk_start_offset
    assert data[start] == CHUNK
    struct.pack_into("<Q", data, start + 9 + 8 + 8 + 8 + 4 + 4 + len("zstd"), 2**45)
    path.write_bytes(data)
    assert read_bag(path)["/a"].field("data").tolist() == [1.0]
