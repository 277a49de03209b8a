"""Parameters of nodes: checked, listed, set in flight, asked for by others."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
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
from rclpy.client import Client
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from sensor_msgs.msg import JointState
from support.control_loop import Loop, pose
from support.planner_flight import HERE, NEAR, Flight
from support.ros_harness import Harness, construction, dumped
from support.sentences import assert_one_sentence

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.common.ros_parameters import RemoteParameters, declare
from spacerobot_ros.nodes.replay import ReplayNode
from spacerobot_ros.parameters import Parameter as Declaration
from spacerobot_ros.parameters import declared, values_of

KINDS: dict[str, Any] = {**NODE_TYPES, "replay": ReplayNode}

SLIDES = {"robot": "sliding_masses"}
LOCKSTEP = {**SLIDES, "time_mode": "lockstep"}


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
    configured = values_of(node.config)
    assert len(configured) >= 7
    for each, value in configured.items():
        assert values[each] == (list(value) if isinstance(value, tuple) else value)


STARTED: dict[str, dict[str, Any]] = {
    "plant": LOCKSTEP,
    "planner": SLIDES,
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
    dump = tmp_path / "dump.yaml"
    dump.write_text(yaml.dump(dumped(node)))
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
    assert "clean up the node" in refused.reason
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


REFUSED: dict[str, tuple[str, dict[str, Any], tuple[str, ...]]] = {
    "no robot": ("plant", {"robot": ""}, ("robot",)),
    "unknown robot": ("plant", {"robot": "octopus"}, ("'robot'", "octopus", "sliding_masses")),
    "missing file": ("plant", {"robot": "nowhere/a.urdf"}, ("'robot'", "nowhere/a.urdf")),
    "broken description": ("plant", {"robot_description": "<robot"}, ("robot description",)),
    "joint positions of wrong length": (
        "plant",
        {"initial_joint_positions": [0.1, 0.2]},
        ("initial joint positions", "2", "slider_1, slider_2, slider_3"),
    ),
    "joint positions not finite": (
        "plant",
        {"initial_joint_positions": [0.0, math.nan, 0.0]},
        ("initial joint positions",),
    ),
    "no tick rate": ("plant", {"tick_rate": 0.0}, ("'tick_rate'", "0.001", "Hz")),
    "not a number": ("plant", {"tick_rate": math.nan}, ("'tick_rate'",)),
    "too small": ("plant", {"sensors.position_bias": [0.0, 1e-200, 0.0]}, ("0 or from 1e-100",)),
    "NUL": ("plant", {"world": "a\0b"}, ("a string without NUL characters",)),
    "choice": ("plant", {"time_mode": "foo"}, ("'time_mode'", "foo", "realtime", "lockstep")),
    "zero quaternion": ("plant", {"initial_orientation": [0.0] * 4}, ("initial orientation",)),
    "three quaternion entries": (
        "plant",
        {"initial_orientation": [0.0, 0.0, 1.0]},
        ("'initial_orientation'", "4 numbers"),
    ),
    "infinite": ("plant", {"linear_momentum": [0.0, math.inf, 0.0]}, ("'linear_momentum'",)),
    "end effector": (
        "plant",
        {"end_effector_frame": "claw"},
        ("'end_effector_frame'", "claw", "mass_1"),
    ),
    "method": ("planner", {"method": "wings"}, ("'method'", "wings", "lie_bracket")),
    "empty description": ("planner", {"robot_description": "<robot/>"}, ("robot",)),
    "rate of the planner": ("planner", {"tick_rate": 1e-4}, ("'tick_rate'", "0.001 Hz")),
    "fraction": ("planner", {"max_corrections": 1.5}, ("'max_corrections'", "whole number")),
    "option": ("planner", {"lie_bracket.t1": 0.0}, ("'lie_bracket.t1'", "s")),
    "compression": ("recorder", {"compression": "zip"}, ("'compression'", "zip")),
    "flush period": ("recorder", {"flush_period": 0.0}, ("'flush_period'", "0")),
}


@pytest.mark.parametrize(("node", "given", "mentions"), REFUSED.values(), ids=REFUSED)
def test_a_bad_parameter_is_refused_with_a_sentence_that_names_it(
    ros_context: rclpy.Context,
    node: str,
    given: dict[str, Any],
    mentions: tuple[str, ...],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    parameters = {**(SLIDES if node != "recorder" else {"bag": "flight.mcap"}), **given}
    with pytest.raises(SpaceRobotError) as refusal:
        KINDS[node](**construction(ros_context, parameters))
    plain = str(refusal.value).replace("_", " ")
    assert_one_sentence(plain, *(mention.replace("_", " ") for mention in mentions))
    assert list(tmp_path.iterdir()) == []


def test_what_is_set_is_checked_and_leaves_the_rest(harness: Harness) -> None:
    plant = harness.make(NODE_TYPES["plant"], LOCKSTEP, autostart=False)
    remote, before = Remote(harness, plant), plant.config
    for name, value in (
        ("tick_rate", -1.0), ("tick_rate", "fast"), ("time_mode", "soon"), ("robot", 3),
        ("initial_position", [1.0]), ("initial_position", [1.0, 2.0, float("nan")]),
        ("thrusters", False),
    ):  # fmt: skip
        (result,) = remote.set(**{name: value})
        assert not result.successful
        assert f"'{name}'" in result.reason
    assert plant.config == before


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


def test_setting_a_parameter_that_a_node_does_not_have_names_the_nearest(harness: Harness) -> None:
    remote = Remote(harness, harness.make(NODE_TYPES["plant"], LOCKSTEP))
    (unknown,) = remote.set(watchdog_timout=2.0)
    assert not unknown.successful
    assert_one_sentence(unknown.reason, "'watchdog_timout'", "'watchdog_timeout'")


def test_a_refused_list_is_shown_as_a_list_and_not_to_its_end(harness: Harness) -> None:
    planner = harness.make(KINDS["planner"], {"robot": "planar_manipulator"})
    (result,) = planner.set_parameters([Parameter("max_corrections", value=[2.5] * 50)])
    assert not result.successful
    assert "is [2.5, 2.5, 2.5, 2.5, 2.5, 2.5, ...]; it must be a number." in result.reason


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


NUMBERS = (0.0, 1e-300, 1e300, -1.0, math.nan, math.inf, -math.inf)


def attempts(parameter: Declaration) -> list[Any]:
    """Return values within, at and beyond the bounds of a parameter, and of other types."""
    if isinstance(parameter.default, float):
        return [parameter.minimum, parameter.maximum, *NUMBERS, "x", True]
    return [0, 1, -1, 2**62, -(2**62), 1.5, "x"]


def set_everything(node: FlightNode, fly: Any) -> tuple[int, int]:
    """Set each live parameter to each value, with a part of the flight after each that is taken.

    Return how many were accepted and refused; all are as before afterwards.
    """
    accepted = refused = 0
    for parameter in (each for each in declared(node.Config) if not each.read_only):
        before = node.get_parameter(parameter.name)
        for value in attempts(parameter):
            (result,) = node.set_parameters([Parameter(parameter.name, value=value)])
            if result.successful:
                accepted += 1
                fly()
            else:
                refused += 1
                assert result.reason
            assert node.is_active
            assert values_of(node.config)[parameter.name] == pytest.approx(
                node.get_parameter(parameter.name).value
            )
        assert node.set_parameters([before])[0].successful
    return accepted, refused


def test_a_planner_flies_on_whatever_its_parameters_are_set_to(harness: Harness) -> None:
    flight = Flight(harness)
    flight.start()
    flight.send(NEAR)
    flight.ticks(3)
    accepted, refused = set_everything(flight.planner, lambda: flight.ticks(2))
    assert accepted >= 8
    assert refused >= 16
    flight.send(HERE)
    flight.wait("reached")


@pytest.mark.filterwarnings("ignore:overflow encountered")  # Gains of 1e300 are accepted.
def test_a_controller_flies_on_whatever_its_parameters_are_set_to(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    loop.aim(base=pose([0.1, 0.0, 0.0]))
    before = loop.answer()
    accepted, refused = set_everything(loop.node, loop.answer)
    assert accepted >= 30
    assert refused >= 50
    wrench, efforts = loop.answer()
    assert np.all(np.isfinite(wrench))
    assert np.all(np.isfinite(efforts))
    assert np.sign(wrench[0]) == np.sign(before[0][0])


# -- parameters of another node ----------------------------------------------------------------


class Asking(Node):
    """A node that counts how often it finds a service before it calls it."""

    looks = 0

    def create_client(self, *arguments: Any, **options: Any) -> Client:
        client = super().create_client(*arguments, **options)
        is_ready, self.looks = client.service_is_ready, 0

        def counted() -> bool:
            self.looks += is_ready()
            return is_ready()

        def call(request: Any) -> Any:
            assert self.looks > 3, "the service may not have met the client yet"
            return type(client).call_async(client, request)

        client.service_is_ready, client.call_async = counted, call
        return client


def test_an_answer_that_is_lost_is_asked_for_again(harness: Harness) -> None:
    def plant() -> Node:
        node = Node("plant", context=harness.context)
        node.declare_parameter("rate", 2.5)
        return node

    asking_node = harness.add(Asking("asking", context=harness.context))
    clients = list(asking_node.clients)
    deaf = plant()  # It takes no request, as nobody runs its callbacks.
    asking = RemoteParameters(asking_node, "/plant")
    for _ in range(40):
        harness.executor.spin_once(timeout_sec=0.01)
        assert not asking.look()
    deaf.destroy_node()
    harness.add(plant())
    harness.spin_until(lambda: any(asking.look() for _ in range(4)), "an answer")
    assert asking.values is not None
    assert asking.values["rate"] == "2.5"
    assert list(asking_node.clients) == clients


def test_a_node_that_never_answers_is_given_up(harness: Harness) -> None:
    node = harness.add(Node("asking", context=harness.context))
    asking = RemoteParameters(node, "/nobody")
    assert any(asking.look() for _ in range(1000))
    assert asking.values is None
