"""The modules that all others use: errors, events, times, topics, parameters, scenarios."""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from builtin_interfaces.msg import Time

from spacerobot_ros import errors, measures, resources, times
from spacerobot_ros.bag import message_definition
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import (
    GoalError,
    NotFoundError,
    ParameterError,
    PlanningError,
    Proof,
    SpaceRobotError,
    UnreachableError,
    printable,
    refusal_of_all,
    sentence_case,
)
from spacerobot_ros.events import Event, EventKind
from spacerobot_ros.flight.trials import PlanningProblem
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.scenario import (
    Kill,
    Scenario,
    load_scenario,
    number_in,
    parse_kills,
    parse_setting,
    read_sections,
    scenario_of,
    scenario_or_robot,
    scenario_text,
)
from spacerobot_ros.topics import TOPICS, Topic, goal_topic, pose_topic, state_topics, topic_named

# -- errors ------------------------------------------------------------------------------------


def test_messages_are_lines_of_at_most_two_thousand_characters() -> None:
    assert str(SpaceRobotError("a\nb\x1bc")) == "a b\ufffdc"
    assert str(SpaceRobotError()) == ""
    assert str(SpaceRobotError("x" * 2000)) == "x" * 2000
    long = "a" * 1000 + "!" + "b" * 1000
    assert str(SpaceRobotError(long)) == "a" * 1000 + " ... " + "b" * 1000
    assert (printable("a\n b"), sentence_case("no way"), sentence_case("")) == (
        "a  b",
        "No way",
        "",
    )


def test_a_proof_by_one_method_holds_for_all() -> None:
    proof = UnreachableError("far", Proof.MOMENTUM)
    lost, other = NotFoundError("lost"), PlanningError("other")
    found = refusal_of_all("All.", [other, lost, proof])
    assert isinstance(found, UnreachableError)
    assert (str(found), found.proof) == ("All.", Proof.MOMENTUM)
    assert type(refusal_of_all("All.", iter([other, lost]))) is NotFoundError
    assert type(refusal_of_all("All.", [other])) is PlanningError
    assert errors.PlanningError is PlanningError


# -- times and events --------------------------------------------------------------------------


def test_times_are_split_into_seconds_and_the_rest() -> None:
    raw = bytes(4) + times.stamp_bytes(3_000_000_007) + b"rest"
    assert times.first_time_ns(raw) == 3_000_000_007
    assert times.stamp_bytes(-1) == b"\xff\xff\xff\xff\xff\xc9\x9a\x3b"
    assert times.first_time_ns(bytes(4) + times.stamp_bytes(-1)) == 0
    latest = 2**31 * 10**9 - 1
    assert times.LATEST_NS == latest
    assert times.first_time_ns(bytes(4) + times.stamp_bytes(latest)) == latest
    beyond = bytes(4) + b"\xff\xff\xff\x7f\xff\xff\xff\xff"
    assert times.first_time_ns(beyond) == latest
    with pytest.raises(SpaceRobotError) as refused:
        times.stamp_bytes(latest + 1)
    assert str(refused.value) == ("Stamps support times up to 2^31 s (68 years), not 2147483648 s.")
    stamp = Time()
    times.set_stamp(stamp, 5_000_000_001)
    assert (stamp.sec, stamp.nanosec, times.stamp_to_ns(stamp)) == (5, 1, 5_000_000_001)
    times.set_stamp(stamp, latest + 5)
    assert (stamp.sec, stamp.nanosec) == (2**31 - 1, 999_999_999)


def test_events_are_pairs_and_back() -> None:
    event = Event(EventKind.LATCHED, "So.", 2, 1.5, "7.5", {"reason": "a"})
    values = event.to_values(12.25)
    assert values == {
        "event": "latched",
        "time": "1.500000000",
        "wall_time": "12.250000",
        "goal_id": "7.5",
        "reason": "a",
    }
    read = Event.from_values(values, "So.", 2)
    assert (read.kind, read.message, read.level) == (EventKind.LATCHED, "So.", 2)
    assert (read.time_s, read.goal_id, read.about["reason"]) == (1.5, "7.5", "a")
    bare = Event.from_values({"event": "reset"})
    assert (bare.message, bare.level, bare.time_s, bare.goal_id, dict(bare.about)) == (
        *("", 0, None, "", {}),
    )
    assert bare.to_values(None) == {"event": "reset"}
    plain = Event(EventKind.RESET, "m")
    assert (plain.level, plain.time_s, plain.goal_id, plain.about) == (0, None, "", {})
    for wrong in ({}, {"event": "no"}, {"event": "reset", "time": "x"}):
        with pytest.raises(SpaceRobotError):
            Event.from_values(wrong)


def test_topics_of_end_effectors() -> None:
    assert goal_topic("left hand/1") == "left_hand_1/goal_pose"
    pose = pose_topic("hand")
    assert (pose.name, pose.state[0].quantity) == ("hand/pose", "pose_of_hand")
    assert topic_named("a/goal_pose") == replace(
        TOPICS["end_effector/goal_pose"], name="a/goal_pose"
    )
    assert topic_named("hand/pose") == pose
    assert topic_named("odom") is TOPICS["odom"]
    with pytest.raises(KeyError):
        topic_named("nothing")


# -- parameters --------------------------------------------------------------------------------


# -- resources ---------------------------------------------------------------------------------


def test_names_of_robots_and_paths() -> None:
    paths = {"a": False, "a.urdf": True, "b/a": True, "a.xacro": True, "a.yaml": False}
    assert {name: resources.is_path(name) for name in paths} == paths
    assert resources.suggestion("servicr", ["servicer", "service"]) == " Did you mean 'servicer'?"
    assert resources.suggestion("zzz", ["servicer"]) == ""


def test_robots_that_are_no_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.urdf").mkdir()
    (tmp_path / "robot.urdf").write_text("x")
    assert resources.robot_file("robot.urdf") == Path("robot.urdf")
    for name, sentence in (
        ("folder.urdf", "'folder.urdf' is a folder; name the URDF file in it."),
        (
            "robt.urdf",
            "There is no robot 'robt.urdf': no such URDF file exists. Did you mean 'robot.urdf'?",
        ),
    ):
        with pytest.raises(ParameterError) as refused:
            resources.robot_file(name)
        assert str(refused.value) == sentence
    with pytest.raises(ParameterError) as refused:
        resources.robot_file("servicr")
    assert str(refused.value).startswith(
        "There is no robot 'servicr': there is no URDF file or robot with that name (known: "
    )
    assert str(refused.value).endswith("Did you mean 'servicer'?")


def test_data_files_are_in_the_checkout_or_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find = resources.share_directory.__wrapped__
    checkout, prefix = tmp_path / "checkout", tmp_path / "prefix"
    (checkout / "package").mkdir(parents=True)
    (checkout / "urdf").mkdir()
    monkeypatch.setattr(resources, "__file__", str(checkout / "package" / "resources.py"))
    monkeypatch.setattr(sys, "prefix", str(prefix))
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", None)
    with pytest.raises(SpaceRobotError) as refused:
        find()
    share = prefix / "share" / "spacerobot_ros"
    assert str(refused.value) == (
        f"The data files of spacerobot_ros (urdf, config) were not found in {share}; install the "
        "package with pip or colcon."
    )
    (share / "urdf").mkdir(parents=True)
    assert find() == share
    index: Any = SimpleNamespace(get_package_share_directory=lambda name: str(tmp_path / name))
    monkeypatch.setitem(sys.modules, "ament_index_python.packages", index)
    assert find() == share
    (tmp_path / "spacerobot_ros" / "urdf").mkdir(parents=True)
    assert find() == tmp_path / "spacerobot_ros"
    (checkout / "package.xml").touch()
    assert find() == checkout


# -- measures ----------------------------------------------------------------------------------


def test_the_time_of_a_session_with_several_goals_is_that_of_the_last_one() -> None:
    def status(state: ControllerState, goal_id: str) -> ControllerStatus:
        return ControllerStatus(state, goal_id=goal_id)

    tracking, reached, failed = (
        *(ControllerState.TRACKING, ControllerState.REACHED),
        ControllerState.FAILED,
    )
    session = [
        (1.0, status(tracking, "first")),
        (5.0, status(reached, "first")),
        (20.0, status(tracking, "second")),
        (23.5, status(failed, "second")),
        (25.0, status(ControllerState.REFUSED, "third")),
    ]
    assert measures.flown_time(session, 30.0) == 3.5
    assert measures.flown_time(session[:2], 30.0) == 4.0
    # Bags of version 0.1 have no ids.
    unnamed = [(time, replace(each, goal_id="")) for time, each in session[:2]]
    assert measures.flown_time(unnamed, 30.0) == 4.0


def test_momenta_of_a_flight() -> None:
    momenta = np.zeros((4, 7))
    momenta[:, 0], momenta[:, 1], momenta[:, 5] = [1, 4, 1, 1], [1, 5, 1, 1], [0, 0, -2, 1]
    momenta[:, 6] = 99.0
    np.testing.assert_allclose(measures.momentum_drift(momenta), [5.0, 2.0])
    expected = np.zeros((4, 6))
    expected[:, 0] = [7, 10, 7, 7]
    np.testing.assert_allclose(measures.momentum_drift(momenta, expected), [4.0, 2.0])
    np.testing.assert_allclose(measures.momentum_drift(momenta, expected[:3]), [5.0, 2.0])
    momenta[0, 3] = math.nan
    np.testing.assert_allclose(measures.momentum_drift(momenta), [5.0, 2.0])
    assert np.isnan(measures.momentum_drift(momenta[:1])).tolist() == [True, True]
    # Flights that have rows of their own that count.
    late = np.array([momenta, momenta[[0, 0, 0, 0]], momenta[[2, 0, 3, 0]]])
    found = measures.momentum_drift(late)
    np.testing.assert_allclose(found, [[5.0, 2.0], [np.nan] * 2, [0.0, 3.0]])
    np.testing.assert_array_equal(measures.peak(np.array([[1.0, -3.0], [-2.0, 0.0]])), [2.0, 3.0])
    np.testing.assert_array_equal(measures.peak(np.empty((0, 2))), [0.0, 0.0])
    wrenches = np.array([[3.0, 0, 4, 0, 0, 1], [0, 0, 0, 0, -5, 12]])
    np.testing.assert_allclose(measures.peak_wrench(wrenches), [5.0, 13.0])


# -- scenarios ---------------------------------------------------------------------------------


def text_of(*goal: str, **nodes: Any) -> str:
    """Return a scenario file of lines of its goal and parameters by node."""
    plant = {"robot": "sliding_masses", **nodes.pop("plant", {})}
    content = {"plant": {"ros__parameters": plant}, **nodes}
    lines = "".join(f"    {line}\n" for line in goal or ("goal_position: [1, 2, 3]",))
    return f"scenario:\n  ros__parameters:\n{lines}{yaml.safe_dump(content)}"


def written(folder: Path, text: str) -> Scenario:
    path = folder / "own.yaml"
    path.write_text(text)
    return load_scenario(str(path))


@pytest.mark.parametrize(
    ("line", "kills"),
    [
        ("planner at 1", (Kill("planner", 1.0, math.inf),)),
        ("plant  at 0 until 2.5", (Kill("plant", 0.0, 2.5),)),
    ],
)
def test_kills_of_nodes(line: str, kills: tuple[Kill, ...]) -> None:
    assert parse_kills([line], "here") == kills


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ("planner at 1", "'kills' in here is 'planner at 1', not a list of lines NODE at SECONDS."),
        *(
            ([line], f"The kill in here '{line}' is refused: {reason}.")
            for line, reason in {
                "planner": "it must be NODE at SECONDS [until SECONDS]",
                "planner until 5": "it must be NODE at SECONDS [until SECONDS]",
                "recorder at 5": "its node is one of plant, planner, coordinated_control",
                "viewer at 1": "its node is one of plant, planner, coordinated_control",
                "plant at x": "'x' is not a finite number",
                "plant at inf": "'inf' is not a finite number",
                "plant at nan": "'nan' is not a finite number",
                "plant at -1": "it is at -1 s, before the start of the flight",
                "plant at 2 until 2": "it ends at 2 s but begins at 2 s",
                "plant at 2 until 1": "it ends at 1 s but begins at 2 s",
            }.items()
        ),
    ],
)
def test_kills_that_are_refused(lines: Any, sentence: str) -> None:
    with pytest.raises(ParameterError) as refused:
        parse_kills(lines, "here")
    assert str(refused.value) == sentence


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("plant.tick_rate=1e-3", ("plant", "tick_rate", 1e-3)),
        (" planner.method =optimal", ("planner", "method ", "optimal")),
        ("plant.a.b=[1, 2]", ("plant", "a.b", [1, 2])),
        ("plant.a=b=c", ("plant", "a", "b=c")),
    ],
)
def test_settings(text: str, found: tuple[str, str, Any]) -> None:
    node, name, value = parse_setting(text)
    assert (node, name.strip(), value) == (found[0], found[1].strip(), found[2])


@pytest.mark.parametrize("text", ["plant.a", "plant=1", "nobody.a=1", "plant.=1", "=1"])
def test_settings_that_are_none(text: str) -> None:
    with pytest.raises(ParameterError) as refused:
        parse_setting(text)
    assert str(refused.value) == (
        f"'{text}' is not node.parameter=value with one of the nodes plant, planner, "
        "coordinated_control, recorder, viewer."
    )
    with pytest.raises(ParameterError) as refused:
        parse_setting("plant.a=[")
    assert str(refused.value) == "The value in 'plant.a=[' cannot be read."
    assert (number_in("1e3"), number_in("a")) == (1000.0, "a")


def test_sections_of_files(tmp_path: Path) -> None:
    path = tmp_path / "a.yaml"
    path.write_text(
        "/**:\n  ros__parameters: {tick_rate: 5.0, method: optimal}\n"
        "/**/plant:\n  ros__parameters: {sensors: {seed: 3}, tick_rate: 7.0}\n"
        "/robot_1/plant:\n  ros__parameters: {actuation: effort}\n"
        "planner:\n"
        "else:\n  ros__parameters: {a: 1}\n"
    )
    assert read_sections(path) == {
        "plant": {"tick_rate": 7.0, "sensors.seed": 3, "actuation": "effort"},
        "planner": {"tick_rate": 5.0, "method": "optimal"},
    }
    for content in ("plant: [1]", "plant: {ros__parameters: 3}"):
        path.write_text(content)
        with pytest.raises(ParameterError) as refused:
            read_sections(path)
        assert str(refused.value) == (
            f"The section 'plant' of the scenario file {path} is not 'ros__parameters:' with "
            "parameters under it."
        )
    path.write_text("[1]")
    assert read_sections(path) == {}
    with pytest.raises(ParameterError, match="cannot be read"):
        read_sections(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("goal", "sentence"),
    [
        (("goal_positon: [1, 2, 3]",), "has an unknown key 'goal_positon' in its scenario section"),
        (("goal_position: [1, 2]",), "The goal in the scenario file"),
        (("goal_rotvec: [1, 2]",), "The goal in the scenario file"),
        (
            ("published: {a: 3}",),
            "The section 'published' in the scenario file FILE is not quantity: {printed: "
            "[numbers], note: text}: ",
        ),
        (("kills: 3",), "'kills' in the file FILE is 3, not a list of lines NODE at SECONDS."),
        (("world: none.urdf",), "The world in the scenario file FILE is invalid: "),
        (("end_effector_goals: 3",), "The goal in the scenario file FILE is invalid: "),
    ],
)
def test_scenarios_that_are_refused(goal: tuple[str, ...], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError) as refused:
        written(tmp_path, text_of(*goal))
    assert sentence.replace("FILE", str(tmp_path / "own.yaml")) in str(refused.value)


def test_a_scenario_without_a_section_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ParameterError) as refused:
        written(tmp_path, "plant: {ros__parameters: {}}")
    assert str(refused.value) == (
        f"The scenario file {tmp_path / 'own.yaml'} has no 'scenario: ros__parameters:' section "
        "with a goal."
    )


def test_a_scenario_is_read_and_written(tmp_path: Path) -> None:
    found = written(
        tmp_path,
        text_of(
            *("description: It is", "goal_position: [1, 2, 3]", "goal_rotvec: [0, 0, 0.5]"),
            *("goal_joint_positions: [0.1, 0.2, 0.3]", "published_method: optimal"),
            *("published: {a: {printed: [1, 2.5], note: so}, b: {printed: [3]}}",),
            planner={"ros__parameters": {"method": "lie_bracket"}},
        ),
    )
    assert (found.name, found.description, found.commanders) == ("own", "It is", ("planner",))
    assert found.path == (tmp_path / "own.yaml").resolve()
    assert found.goal.position.tolist() == [1.0, 2.0, 3.0]
    assert found.goal.quaternion == pytest.approx([0, 0, math.sin(0.25), math.cos(0.25)])
    assert found.goal.joint_positions is not None
    first, second = found.published
    assert (first.quantity, first.printed, first.note) == ("a", [1.0, 2.5], "so")
    assert (second.quantity, second.printed, second.note) == ("b", [3.0], "")
    assert found.comparable == ()
    assert found.with_method("optimal").comparable == found.published
    assert replace(found, published_method="").comparable == found.published
    assert (found.end_effector_goal, found.kills, found.has_goal) == (None, (), True)
    text = scenario_text(found.with_overrides("planner", {"averaging": 3}))
    content = yaml.safe_load(text)
    assert list(content) == ["scenario", "/**/plant", "/**/planner"]
    about = content["scenario"]["ros__parameters"]
    assert about["description"] == "It is"
    assert about["goal_position"] == [1.0, 2.0, 3.0]
    assert about["goal_joint_positions"] == [0.1, 0.2, 0.3]
    planner = content["/**/planner"]["ros__parameters"]
    assert planner == {"method": "lie_bracket", "averaging": 3}
    recorded = scenario_text(found.with_overrides("recorder", {"tf_period": 0.5}))
    assert list(yaml.safe_load(recorded)) == [
        *("scenario", "/**/plant", "/**/planner", "/**/recorder"),
    ]
    again = written(tmp_path, text)
    assert again.goal.joint_positions is not None
    assert again.planner.averaging == 3


def test_what_a_scenario_needs_is_said(tmp_path: Path) -> None:
    found = written(tmp_path, text_of(planner={"ros__parameters": {}}))
    with pytest.raises(ParameterError) as refused:
        found.with_method("transposed_jacobian")
    assert str(refused.value) == (
        "'transposed_jacobian' is a control law, and the scenario 'own' has no section "
        "'coordinated_control' that could use it: this scenario flies with planner."
    )
    with pytest.raises(ParameterError) as unused:
        found.with_settings(["coordinated_control.law=model_based"])
    assert str(unused.value) == (
        "'coordinated_control.law=model_based' is for the node 'coordinated_control', which is "
        "not running: the scenario 'own' flies with planner."
    )
    with pytest.raises(GoalError) as twice:
        found.with_goal(None, (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    assert str(twice.value) == "The goal attitude is given twice, in radians and in degrees."
    assert found.with_goal() is found
    bare = written(tmp_path, text_of(plant={"robot": ""}, planner={"ros__parameters": {}}))
    with pytest.raises(ParameterError) as refused:
        PlanningProblem.of(bare)
    assert str(refused.value) == "The scenario 'own' has no robot; see plant.robot."
    with pytest.raises(ParameterError) as refused:
        found.with_overrides("plant", {"tick_rat": 1}).config("plant")
    misspelt = "Node 'plant' has no parameter 'tick_rat'. Did you mean 'tick_rate'?"
    assert str(refused.value) == misspelt
    with pytest.raises(ParameterError) as refused:
        found.with_overrides("plant", {"tick_rate": -1}).config("plant")
    assert str(refused.value).startswith("Node 'plant': Parameter 'tick_rate' is -1")
    robot = scenario_or_robot("planar_manipulator")
    if not robot.has_goal:
        with pytest.raises(ParameterError) as refused:
            robot.require_goal()
        assert str(refused.value) == (
            "'planar_manipulator' has no goal: give one, for instance --goal-rpy-deg 0 0 10, or "
            "write a scenario with a goal (`spacerobot new` writes one for a robot)."
        )


def test_a_robot_alone_is_a_scenario_without_a_goal() -> None:
    description = SpaceRobot.from_file(resources.robot_file("sliding_masses")).description
    found = scenario_of(description)
    assert (found.name, found.has_goal, found.path) == (description.name, False, Path())
    assert found.plant.robot_description == found.planner.robot_description == description.urdf
    shape = Goal.checked([0, 0, 0], [0, 0, 0, 1], [0.0])
    with pytest.raises(GoalError) as refused:
        replace(found, goal=shape).require_shape_of(SpaceRobot(description))
    assert str(refused.value) == (
        f"The goal has 1 joint position(s); robot '{description.name}' has 3 joints."
    )


def test_parameters_of_a_scenario_have_their_types(tmp_path: Path) -> None:
    found = written(
        tmp_path,
        text_of(
            planner={"ros__parameters": {"averaging": "3", "use_sim_time": 1, "method": "auto"}}
        ),
    )
    assert found.parameters("planner") == {"averaging": 3, "method": "auto", "use_sim_time": True}
    assert found.planner.averaging == 3
    assert found.lockstep
    fast = found.in_real_time(0.25)
    assert (fast.plant.time_mode, fast.plant.real_time_factor) == ("realtime", 0.25)
    assert fast.planner.plan_in_background
    recorder = fast.config("recorder")
    assert recorder.diagnostics_period == 1.0
    assert recorder.tf_period == pytest.approx(min(found.config("recorder").tf_period, 0.025))
    silent = found.with_overrides("recorder", {"tf_period": 0.0}).in_real_time(2.0)
    assert silent.config("recorder").tf_period == 0.0
    assert not fast.lockstep
    assert isinstance(fast.planner, PlannerConfig)


@pytest.mark.parametrize(
    "package",
    ["spacerobot_ros", "spacerobot_ros.nodes", "spacerobot_ros.planning", "spacerobot_ros.control"],
)
def test_packages_have_the_names_that_they_list(package: str) -> None:
    """Names are imported when they are used first; others are refused as by any module."""
    module = importlib.import_module(package)
    for name in module.__all__:
        assert getattr(module, name) is not None
    with pytest.raises(AttributeError, match=f"module '{package}' has no attribute 'plann'"):
        module.plann  # noqa: B018


def test_a_plant_node_imports_no_planner_and_no_page() -> None:
    """It begins in half of the time."""
    script = "import sys, spacerobot_ros.nodes.plant.node; print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    loaded = set(found.stdout.split())
    assert "spacerobot_ros.simulation.velocity_plant" in loaded
    for module in ("planning", "control.laws", "control.outputs", "viewer", "bag", "commanding"):
        assert f"spacerobot_ros.{module}" not in loaded


# -- the table of topics -----------------------------------------------------------------------


def message_of(topic: Topic) -> Any:
    package, _, name = topic.type.split("/")
    return getattr(import_module(f"{package}.msg"), name)()


@pytest.mark.parametrize("topic", TOPICS.values(), ids=TOPICS)
def test_every_topic_has_a_type_that_is_installed_and_says_what_it_is(topic: Topic) -> None:
    if topic.name in ("/tf", "/tf_static"):
        # Its package is not everywhere; its definition is in the bags.
        assert "TransformStamped[] transforms" in message_definition(topic.type)
    else:
        message_of(topic)
    assert topic.publishers
    assert topic.meaning
    assert "\n" not in topic.meaning + topic.condition


@pytest.mark.parametrize("topic", state_topics(), ids=lambda topic: topic.name)
def test_state_topics_name_numbers_of_their_messages(topic: Topic) -> None:
    message = message_of(topic)
    names = ["elbow", "wrist"]
    for entry in topic.state:
        for column in entry.columns:
            value = message
            for part in column.split("."):
                value = getattr(value, part)
            if entry.members:
                assert isinstance(value, float), column
            else:
                assert len(value) == 0
                assert value.typecode == "d"
        width = len(entry.members or entry.array_entry_names) or len(names)
        assert len(entry.labels(names)) == width


def test_labels_and_quaternions() -> None:
    odom, joints = TOPICS["odom"].state, TOPICS["joint_states"].state
    assert [field.quaternion for field in odom] == [3, None]
    assert joints[0].labels(["elbow"]) == ["position of elbow"]
    assert TOPICS["momentum"].state[0].labels([])[-1] == "kinetic energy"
    assert TOPICS["odom"].short_type == "nav_msgs/Odometry"


def test_the_plant_publishes_the_clock_first_and_what_sets_commanders_off_late() -> None:
    names = list(TOPICS)
    assert names[0] == "/clock"
    measured = [names.index("odom"), names.index("joint_states")]
    before = ["base_pose", "end_effector_pose", "momentum", "momentum_expected", "odom_true"]
    assert max(map(names.index, before)) < min(measured)
