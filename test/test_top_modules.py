"""The modules that all others use: errors, events, times, topics and measures."""

from __future__ import annotations

import importlib
import math
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time

from spacerobot_ros import errors, measures, resources, times
from spacerobot_ros.bag import message_definition
from spacerobot_ros.control.status import ControllerState, ControllerStatus
from spacerobot_ros.errors import (
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
from spacerobot_ros.topics import TOPICS, Topic, link_topic, pose_topic, state_topics, topic_named

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
    assert times.stamp_to_ns(Time(sec=5, nanosec=1)) == 5_000_000_001


def test_events_are_pairs_and_back() -> None:
    event = Event(EventKind.LATCHED, "So.", 2, 1.5, "7.5", {"reason": "a"})
    values = event.to_values(12.25)
    pairs = {"event": "latched", "time": "1.500000000", "wall_time": "12.250000"}
    assert list(values.items()) == list({**pairs, "goal_id": "7.5", "reason": "a"}.items())
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
    assert link_topic("left hand/1", "goal_pose") == "left_hand_1/goal_pose"
    pose = pose_topic("hand")
    assert (pose.name, pose.state[0].quantity) == ("hand/pose", "pose_of_hand")
    assert topic_named("a/goal_pose") == replace(
        TOPICS["end_effector/goal_pose"], name="a/goal_pose"
    )
    assert topic_named("hand/pose") == pose
    assert topic_named("odom") is TOPICS["odom"]
    with pytest.raises(KeyError):
        topic_named("nothing")


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
            f"There is no robot 'robt.urdf': no such URDF file exists in {tmp_path}. "
            "Did you mean 'robot.urdf'?",
        ),
    ):
        with pytest.raises(ParameterError) as refused:
            resources.robot_file(name)
        assert str(refused.value) == sentence
    with pytest.raises(ParameterError) as refused:
        resources.robot_file("servicr")
    assert str(refused.value).startswith(
        "There is no robot 'servicr'. Did you mean 'servicer'? There are: dual_arm, "
    )
    assert str(refused.value).endswith("or any URDF file.")


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
    index: Any = ModuleType("ament_index_python.packages")
    index.get_package_share_directory = lambda name: str(tmp_path / name)
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
        (24.5, status(failed, "second")),  # Nodes repeat their status.
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


@pytest.mark.parametrize(
    "package",
    ["spacerobot_ros", "spacerobot_ros.nodes", "spacerobot_ros.planning", "spacerobot_ros.control"],
)
def test_packages_have_the_names_that_they_list(package: str) -> None:
    """Names are imported when they are used first; others are refused as by any module."""
    module = importlib.import_module(package)
    assert {*module.__all__, "__name__"} <= {*dir(module)}
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
