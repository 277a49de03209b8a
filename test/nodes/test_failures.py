"""An exception of one message, timer, service or step ends no process: the node says why."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.plant_rig import Rig
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.simulation.status import PlantState, PlantStatus


def values_of(message: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in message.values}


@dataclass(frozen=True)
class NoParameters:
    """The node has none of its own."""


class Fragile(FlightNode):
    """A node whose callbacks raise."""

    Config = NoParameters
    said = ""

    def configure(self) -> None:
        self.create_subscription(JointState, "joints", self._raise, 10)
        self.create_subscription(JointState, "raw", self._raise, 10, raw=True)
        self.create_service(Trigger, "~/break", lambda request, response: self._raise(request))

    def on_failure(self, sentence: str, error: Exception) -> None:
        self.said = sentence

    def _raise(self, _: Any) -> None:
        raise OverflowError(34, "Numerical result out of range")


@pytest.mark.parametrize("what", ["joints", "raw", "break", "timer"])
def test_an_exception_of_a_callback_deactivates_the_node_which_says_why(
    harness: Harness, what: str
) -> None:
    node = harness.add(Fragile("fragile", context=harness.context))
    probe = harness.probe({"events": DiagnosticStatus})
    publisher = probe.create_publisher(JointState, what, 10)
    harness.connect()
    assert node.is_active
    if what == "break":
        answer = harness.call(probe.create_client(Trigger, "fragile/break"), Trigger.Request())
        assert not answer.success
        assert answer.message == node.said
    elif what == "timer":
        node.create_timer(0.001, lambda: node._raise(None))
    else:
        publisher.publish(JointState())
    harness.spin_until(lambda: node.said, "the failure")
    assert not node.is_active
    assert_one_sentence(node.said, "'fragile'", "OverflowError", "test_failures.py")
    harness.spin_until(lambda: probe.count("events") == 2, "both events")
    harness.settle(probe)
    failed, deactivated = (values_of(m)["event"] for m in probe.messages["events"])
    assert (failed, deactivated) == ("failed", "deactivated")
    assert probe.messages["events"][0].level == DiagnosticStatus.ERROR
    assert node.trigger_activate() is TransitionCallbackReturn.SUCCESS
    assert node.is_active


def test_a_timer_that_is_destroyed_fires_no_more_though_it_is_due(harness: Harness) -> None:
    node = harness.add(Fragile("fragile", context=harness.context))
    fired: list[str] = []

    def first() -> None:
        fired.append("first")
        for timer in timers:
            node.destroy_timer(timer)

    # Both are due when the executor looks: whichever comes first destroys the other.
    timers = [node.create_timer(0.001, first) for _ in range(2)]
    due = time.monotonic() + 0.01
    while time.monotonic() < due:
        pass
    harness.spin_for(0.05)
    assert fired == ["first"]
    assert node.is_active


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_a_step_that_raises_leaves_a_plant_that_says_why_and_can_be_started_again(
    harness: Harness, mode: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(harness, {"time_mode": mode, "real_time_factor": 10.0})
    status = harness.probe({"plant/status": DiagnosticStatus}, latched=("plant/status",), name="s")
    rig.send([0.1, 0.0, 0.0])
    rig.wait("joint_states", 2)

    def step(*_: Any) -> bool:
        raise ZeroDivisionError("no luck")

    monkeypatch.setattr(rig.plant.plant, "step", step)
    rig.send([0.1, 0.0, 0.0])
    harness.spin_until(lambda: rig.plant.state is PlantState.FAILED, "the failure")
    assert not rig.plant.is_active
    harness.settle(rig.probe, status)
    message = status.last("plant/status")
    shown = PlantStatus.from_values(values_of(message), message.message)
    assert (shown.state, shown.reason) == (PlantState.FAILED, "exception")
    assert message.level == DiagnosticStatus.ERROR
    assert_one_sentence(shown.message, "plant", "ZeroDivisionError", "no luck")
    monkeypatch.undo()
    before = rig.probe.count("joint_states")
    rig.activate()
    assert rig.plant.state in (PlantState.RUNNING, PlantState.RESTING)
    rig.wait("joint_states", before + 1)
    # In real time the next state may be one of before the command.
    rig.send([0.2, 0.0, 0.0])
    harness.spin_until(
        lambda: list(rig.probe.last("joint_states").velocity) == [0.2, 0.0, 0.0],
        "joints that move as commanded",
    )


@pytest.mark.parametrize(
    "line", ["sensor_noise position 1e200", "sensor_noise joints 1e155", "sensor_delay odom 1e9"]
)
def test_a_fault_of_any_size_stops_no_plant(harness: Harness, line: str) -> None:
    rig = Rig(harness)
    faults = rig.probe.create_publisher(String, "fault_injection", 10)
    harness.connect()
    faults.publish(String(data=line))
    rig.wait_for_log("is refused")
    assert list(rig.step([0.2, 0.0, 0.0]).velocity) == [0.2, 0.0, 0.0]
    assert rig.plant.state is PlantState.RUNNING


def test_a_callback_that_was_queued_when_its_subscription_was_destroyed_is_no_failure(
    harness: Harness,
) -> None:
    node = harness.add(Fragile("fragile", context=harness.context))
    subscription = next(each for each in node.subscriptions if each.topic_name == "/joints")
    queued = node.guarded(lambda _: subscription.handle.__enter__(), "a message on 'joints'")
    assert node.trigger_deactivate() is TransitionCallbackReturn.SUCCESS
    assert node.trigger_cleanup() is TransitionCallbackReturn.SUCCESS
    queued(None)
    assert node.said == ""
    assert node.fault is None
    assert node.trigger_configure() is TransitionCallbackReturn.SUCCESS
    queued(None)
    assert "cannot use Destroyable" in node.said
