"""Parameters as the ros2 command reads and sets them: all at once, and between two lives."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest
import yaml
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import Log
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState
from support.ros_harness import Harness, construction

from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.common.ros_parameters import declare
from spacerobot_ros.nodes.replay import ReplayNode
from spacerobot_ros.parameters import Parameter as Declaration

KINDS: dict[str, Any] = {**NODE_TYPES, "replay": ReplayNode}

LOCKSTEP = {"robot": "sliding_masses", "time_mode": "lockstep"}


class Remote:
    """What the parameter services of a node answer to a client."""

    def __init__(self, harness: Harness, node: FlightNode) -> None:
        self._harness, self._node = harness, node
        self._client = harness.probe({}, name=f"client_of_{node.get_name()}")

    def ask(self, kind: Any, service: str, **request: Any) -> Any:
        name = f"{self._node.get_fully_qualified_name()}/{service}"
        client = self._client.create_client(kind, name)
        return self._harness.call(client, kind.Request(**request))

    def names(self) -> list[str]:
        listed: list[str] = self.ask(ListParameters, "list_parameters").result.names
        return listed

    def values(self, names: Sequence[str]) -> dict[str, Any]:
        answer = self.ask(GetParameters, "get_parameters", names=list(names)).values
        return dict(zip(names, map(parameter_value_to_python, answer), strict=True))

    def is_read_only(self, name: str) -> bool:
        (described,) = self.ask(DescribeParameters, "describe_parameters", names=[name]).descriptors
        return bool(described.read_only)

    def set(self, **values: Any) -> list[Any]:
        given = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        results: list[Any] = self.ask(SetParameters, "set_parameters", parameters=given).results
        return results


@pytest.mark.parametrize("name", KINDS)
def test_all_parameters_are_answered_at_once(harness: Harness, name: str) -> None:
    node = harness.add(KINDS[name](autostart=False, context=harness.context))
    remote = Remote(harness, node)
    values = remote.values(remote.names())
    declared = node.parameter_values
    assert len(declared) >= 8
    for each, value in declared.items():
        assert values[each] == (list(value) if isinstance(value, tuple) else value)


STARTED: dict[str, dict[str, Any]] = {
    "plant": LOCKSTEP,
    "planner": {"robot": "sliding_masses"},
    "coordinated_control": {"robot": "servicer"},
    "recorder": {"bag": "mine.mcap"},
    "viewer": {"port": 0},
    "replay": {"bag": str(Path(__file__).resolve().parents[2] / "bags" / "planar_chain.mcap")},
}
"""Parameters with which nodes may be started."""


@pytest.mark.parametrize(
    "name",
    [pytest.param(each, marks=() if each == "plant" else pytest.mark.slow) for each in KINDS],
)
def test_a_dump_is_loaded_again_without_a_word(
    harness: Harness, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    node = harness.make(KINDS[name], STARTED[name], autostart=False)
    node.start()
    assert node.is_active
    remote = Remote(harness, node)
    values = remote.values(remote.names())
    # As the ros2 command writes it: lists for arrays, and groups within each other.
    tree: dict[str, Any] = {}
    for each, value in values.items():
        *groups, last = each.split(".")
        place = tree
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value.tolist() if hasattr(value, "tolist") else value
    dump = tmp_path / "dump.yaml"
    dump.write_text(yaml.dump({node.get_fully_qualified_name(): {"ros__parameters": tree}}))
    probe = harness.probe({"/rosout": Log})
    loader = AsyncParameterClient(probe, node.get_fully_qualified_name())
    harness.spin_until(loader.services_are_ready, "the services")
    loaded = loader.load_parameter_file(str(dump))
    harness.spin_until(loaded.done, "the answer")
    results = loaded.result().results
    assert [each.reason for each in results if not each.successful] == []
    assert len(results) == len(values) >= 8
    assert str(remote.values(list(values))) == str(values)
    harness.settle(probe)
    assert [log.msg for log in probe.messages["/rosout"] if log.level >= log.WARN] == []


def test_empty_lists_keep_their_type_through_the_services(harness: Harness) -> None:
    plant = harness.make(NODE_TYPES["plant"], {"faults": ["joint_stuck x"]}, autostart=False)
    remote = Remote(harness, plant)
    nothing = ParameterMessage(name="faults")
    nothing.value.type = Parameter.Type.STRING_ARRAY.value
    empty = ParameterMessage(name="initial_joint_positions")
    # What the ros2 command makes of `[]`, which says nothing of its entries.
    empty.value.type = Parameter.Type.BYTE_ARRAY.value
    result = remote.ask(
        SetParametersAtomically, "set_parameters_atomically", parameters=[nothing, empty]
    ).result
    assert result.successful, result.reason
    assert plant.config.faults == plant.config.initial_joint_positions == ()
    assert remote.set(initial_joint_positions=[1, 2, 0])[0].successful
    assert list(remote.values(["initial_joint_positions"]).values()) == [[1.0, 2.0, 0.0]]
    assert plant.config.initial_joint_positions == (1.0, 2.0, 0.0)


@pytest.mark.slow
def test_a_plant_is_another_after_its_cleanup(harness: Harness) -> None:
    plant = harness.make(NODE_TYPES["plant"], LOCKSTEP)
    remote = Remote(harness, plant)
    probe = harness.probe({"odom": Odometry, "joint_states": JointState})
    assert remote.is_read_only("robot")
    (refused,) = remote.set(robot="servicer")
    assert not refused.successful
    assert "'robot'" in refused.reason
    assert "clean it up" in refused.reason
    plant.trigger_deactivate()
    assert not remote.set(robot="servicer")[0].successful, "it is configured still"
    plant.trigger_cleanup()
    assert not remote.is_read_only("robot")
    results = remote.set(robot="servicer", tick_rate=50, initial_position=[1.0, 2.0, 3.0])
    assert all(result.successful for result in results), results
    harness.settle(probe)
    for kept in probe.messages.values():  # States of the plant as it was.
        kept.clear()
    plant.start()
    harness.spin_until(lambda: probe.messages["joint_states"] and probe.messages["odom"])
    assert len(probe.last("joint_states").name) == 6
    assert probe.last("odom").pose.pose.position.y == 2.0
    assert plant.config.control_period == 0.02
    assert not remote.set(tick_rate=20.0)[0].successful


def test_a_node_that_waits_is_set_up_before_it_starts(harness: Harness, tmp_path: Path) -> None:
    recorder = harness.make(NODE_TYPES["recorder"], {"autostart": False})
    remote = Remote(harness, recorder)
    assert remote.set(bag=str(tmp_path / "mine.mcap"))[0].successful
    (autostart,) = remote.set(autostart=True)
    assert not autostart.successful
    assert "autostart" in autostart.reason
    recorder.start()
    assert (tmp_path / "mine.mcap").is_file()


def test_what_is_set_is_checked_and_leaves_the_rest(harness: Harness) -> None:
    plant = harness.make(NODE_TYPES["plant"], LOCKSTEP, autostart=False)
    remote = Remote(harness, plant)
    for name, value in (
        ("tick_rate", -1.0), ("tick_rate", "fast"), ("time_mode", "soon"), ("robot", 3),
        ("initial_position", [1.0]), ("initial_position", [1.0, 2.0, float("nan")]),
        ("thrusters", False),
    ):  # fmt: skip
        (result,) = remote.set(**{name: value})
        assert not result.successful
        assert f"'{name}'" in result.reason
    assert plant.parameter_values == KINDS["plant"](
        autostart=False, context=harness.context, parameter_overrides=[
            Parameter(key, value=value) for key, value in LOCKSTEP.items()
        ],
    ).parameter_values  # fmt: skip


def test_a_bad_robot_fails_the_configuration_and_may_be_mended(harness: Harness) -> None:
    plant = harness.make(NODE_TYPES["plant"], {}, autostart=False)
    remote = Remote(harness, plant)
    plant.trigger_configure()
    assert "needs a robot" in str(plant.fault)
    assert not remote.is_read_only("robot")
    assert remote.set(robot="sliding_masses")[0].successful
    plant.start()
    assert plant.is_active


def test_a_watchdog_heeds_a_timeout_that_was_set_since(harness: Harness) -> None:
    plant = harness.make(NODE_TYPES["plant"], {**LOCKSTEP, "watchdog_timeout": 0.0})
    heard = {each.topic_name for each in plant.subscriptions}
    assert "/heartbeat" not in heard
    plant.trigger_deactivate()
    plant.trigger_cleanup()
    assert plant.set_parameters([Parameter("watchdog_timeout", value=2.0)])[0].successful
    plant.start()
    assert "/heartbeat" in {each.topic_name for each in plant.subscriptions}


def test_nodes_whose_watchdog_is_off_listen_to_no_heartbeats(harness: Harness) -> None:
    given = {"robot": "planar_manipulator", "watchdog_timeout": 0.0}
    node = harness.make(KINDS["planner"], given)
    assert node.is_active
    assert "/heartbeat" not in {each.topic_name for each in node.subscriptions}


@pytest.mark.parametrize("keeps", [dict, MappingProxyType])
def test_what_was_given_is_found_however_rclpy_keeps_it(
    harness: Harness, keeps: Callable[[Any], Any]
) -> None:
    given = {"rate": 20, "names": ["a", "b"]}
    node = harness.add(Node("any", **construction(harness.context, given)))
    node._parameter_overrides = keeps(node._parameter_overrides)
    declared = (
        Declaration("rate", 1.0, description="given as a whole number"),
        Declaration("left", 2.5, description="not given"),
        Declaration("names", (), description="given", texts=True),
    )
    values = declare(node, declared)
    assert values == {"rate": 20.0, "left": 2.5, "names": ("a", "b")}
    assert [node.get_parameter(name).value for name in values] == [20.0, 2.5, ["a", "b"]]


def test_descriptions_have_units_ranges_and_choices(harness: Harness) -> None:
    node = harness.add(Node("any", **construction(harness.context, {})))
    declare(
        node,
        [
            Declaration("rate", 2.5, "Hz", "It is.", minimum=0.5),
            Declaration("count", 2, minimum=1, maximum=9),
            Declaration("mode", "fast", choices=("fast", "slow")),
        ],
    )
    rate, count, mode = map(node.describe_parameter, ("rate", "count", "mode"))
    assert rate.description == "It is. [Hz]"
    (span,) = rate.floating_point_range
    assert (span.from_value, span.to_value) == (0.5, sys.float_info.max)
    (whole,) = count.integer_range
    assert (whole.from_value, whole.to_value) == (1, 9)
    assert mode.additional_constraints == "one of: fast, slow"
    assert not [*mode.integer_range, *mode.floating_point_range, *rate.integer_range]
