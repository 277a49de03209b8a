"""Nodes that fail, and nodes that fall silent."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.lifecycle import TransitionCallbackReturn
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from support.planner_flight import NEAR, PLANNER, Flight, values_of
from support.plant_rig import Rig
from support.ros_harness import Harness
from support.sentences import assert_one_sentence

from spacerobot_ros.nodes import RecorderNode
from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.nodes.common.watchdog import HeartbeatState, SilenceReport, Watchdog
from spacerobot_ros.simulation.status import PlantState, PlantStatus

REAL_TIME = {"time_mode": "realtime", "real_time_factor": 1.0, "command_timeout": 5.0}


class Watch:
    """A watchdog, its clock, and what it finds."""

    def __init__(self) -> None:
        self.now = 50.0
        self.watchdog = Watchdog(0.8, clock=lambda: self.now)
        self.found: list[SilenceReport] = []

    def spend(self, seconds: float, *beating: str) -> None:
        """Let time pass; these nodes give their heartbeats every 0.2 s."""
        for step in range(round(seconds / 0.1)):
            self.now += 0.1
            if step % 2 == 0:
                for name in beating:
                    self.hear(name)
            self.found += self.watchdog.look()

    def hear(self, name: str, pulse: str = "active") -> None:
        back = self.watchdog.hear(name, pulse)
        if back is not None:
            self.found.append(back)


def test_a_node_that_is_silent_is_named_once_within_a_second() -> None:
    watch = Watch()
    watch.spend(5.0, "/plant", "/planner")
    watch.spend(1.0, "/plant")
    (silence,) = watch.found
    assert (silence.name, silence.over) == ("/planner", False)
    assert 0.8 < silence.seconds <= 1.0
    watch.spend(5.0, "/plant")
    assert len(watch.found) == 1
    assert list(watch.watchdog.silent) == ["/planner"]
    watch.hear("/planner")
    back = watch.found[-1]
    assert (back.name, back.over) == ("/planner", True)
    assert back.seconds == pytest.approx(6.1, abs=0.2)
    watch.spend(5.0, "/plant", "/planner")
    assert len(watch.found) == 2
    assert not watch.watchdog.silent


@pytest.mark.parametrize("pulse", [HeartbeatState.INACTIVE, HeartbeatState.BUSY])
def test_nothing_is_expected_of_nodes_that_say_so(pulse: HeartbeatState) -> None:
    watch = Watch()
    watch.spend(1.0, "/planner")
    watch.hear("/planner", pulse.value)
    watch.spend(100.0)
    assert watch.found == []
    # It is watched again from its next heartbeat on.
    watch.hear("/planner")
    watch.spend(1.0)
    assert [silence.name for silence in watch.found] == ["/planner"]


def test_a_node_that_stood_still_itself_blames_no_other() -> None:
    watch = Watch()
    watch.spend(100.0)
    assert watch.found == [], "a node that was never heard is not missed"
    watch.spend(1.0, "/plant")
    for _ in range(5):
        watch.now += 30.0
        watch.found += watch.watchdog.look()
    assert watch.found == []
    watch.spend(1.0)
    assert [silence.name for silence in watch.found] == ["/plant"]


class Watched(Flight):
    """A flight whose heartbeats, events and diagnostics are heard."""

    def __init__(self, harness: Harness, **options: Any) -> None:
        super().__init__(harness, options.get("planner"), {**REAL_TIME, **options.get("plant", {})})
        self.doctor = harness.probe(
            {
                "/diagnostics": DiagnosticArray,
                "events": DiagnosticStatus,
                "heartbeat": DiagnosticStatus,
            },
            name="doctor",
        )
        harness.connect()
        self.start()

    def events(self, *kinds: str) -> list[tuple[str, str]]:
        """Return node and subject of the events of these kinds."""
        return [
            (message.name, values_of(message)["node"])
            for message in self.doctor.messages["events"]
            if values_of(message)["event"] in kinds
        ]

    def pulses(self, name: str) -> list[str]:
        """Return the states in the heartbeats of a node."""
        return [m.message for m in self.doctor.messages["heartbeat"] if m.name == name]

    def silence(self, node: Any) -> float:
        """Have nobody run a node's callbacks; return after how long that is noticed, wall s."""
        self.harness.executor.remove_node(node)
        began = time.monotonic()
        self.harness.spin_until(lambda: self.events("node_silent"), "the silence", timeout=5.0)
        return time.monotonic() - began


def test_a_silent_planner_is_noticed_by_the_plant_and_is_back(harness: Harness) -> None:
    flight = Watched(harness)
    flight.send(NEAR)
    flight.wait("executing")
    assert flight.silence(flight.planner) < 1.0
    assert flight.events("node_silent") == [("/plant", "/planner")]
    harness.spin_until(lambda: flight.doctor.diagnoses("plant: watchdog"), "the diagnostics")
    status = flight.doctor.diagnoses("plant: watchdog")[-1]
    assert status.level == DiagnosticStatus.ERROR
    assert "/planner" in status.message
    assert flight.plant.state is PlantState.RUNNING  # It is reported, and no more.
    harness.executor.add_node(flight.planner)
    harness.spin_until(lambda: flight.events("node_back"), "the planner")
    assert flight.events("node_back") == [("/plant", "/planner")]
    harness.spin_until(
        lambda: flight.doctor.diagnoses("plant: watchdog")[-1].level == DiagnosticStatus.OK, "an OK"
    )


def test_a_silent_commander_latches_a_plant_that_is_asked_to(harness: Harness) -> None:
    flight = Watched(harness, plant={"watchdog_action": "latch"})
    flight.send(NEAR)
    flight.wait("executing")
    flight.silence(flight.planner)
    harness.spin_until(lambda: flight.plant.state is PlantState.LATCHED, "the latch")
    assert flight.plant.status.reason == "watchdog"
    assert "/planner" in flight.plant.status.message
    # The planner learns why when it is back.
    harness.executor.add_node(flight.planner)
    assert "'/planner' is silent" in flight.wait("aborted").message


def test_a_silent_plant_is_noticed_by_commander_and_recorder(
    harness: Harness, tmp_path: Any
) -> None:
    flight = Watched(harness, planner={**PLANNER, "watchdog_action": "abort"})
    harness.make(RecorderNode, {"bag": str(tmp_path / "flight.mcap")})
    harness.connect()

    before = len(flight.pulses("/plant"))
    harness.spin_until(
        lambda: len(flight.pulses("/plant")) > before + 1 and flight.pulses("/recorder"), "beats"
    )
    flight.send(NEAR)
    flight.wait("executing")
    assert flight.silence(flight.plant) < 1.0
    harness.spin_until(lambda: len(flight.events("node_silent")) == 2, "both notice")
    assert sorted(flight.events("node_silent")) == [("/planner", "/plant"), ("/recorder", "/plant")]
    # The planner may wait for states again before the recorder notices.
    harness.spin_until(lambda: "aborted" in flight.all_states, "the abort")
    told = flight.probe.messages["planner/status"][flight.all_states.index("aborted")]
    assert "'/plant' is silent" in told.message


def test_nodes_that_end_or_rest_in_order_are_not_missed(harness: Harness) -> None:
    flight = Watched(harness)
    harness.spin_until(lambda: flight.doctor.count("heartbeat") > 4, "heartbeats")
    flight.planner.trigger_deactivate()
    harness.spin_for(1.2)
    assert flight.doctor.messages["heartbeat"][-1].name == "/plant"
    flight.planner.trigger_activate()
    harness.spin_for(0.3)
    harness.remove(flight.planner)
    flight.plant.trigger_deactivate()
    harness.spin_for(1.2)
    assert flight.events("node_silent") == []
    states = [(m.name, m.message) for m in flight.doctor.messages["heartbeat"]]
    assert ("/planner", "inactive") in states
    assert states[-1] == ("/plant", "inactive")


def test_a_planner_says_when_it_plans(harness: Harness) -> None:
    flight = Watched(harness, planner={**PLANNER, "plan_in_background": False})
    flight.send(NEAR)
    flight.wait("executing")
    harness.spin_until(lambda: "busy" in flight.pulses("/planner"), "that it is busy")
    harness.spin_until(lambda: flight.pulses("/planner")[-1] == "active", "that it is not any more")
    assert flight.events("node_silent") == []


@dataclass(frozen=True)
class NoParameters:
    """The node has none of its own."""


class Fragile(FlightNode):
    """A node whose callbacks raise."""

    Config = NoParameters
    said = ""

    def configure(self) -> None:
        self.create_subscription(JointState, "joints", self.fail, 10)
        self.create_subscription(JointState, "raw", self.fail, 10, raw=True)
        self.create_service(Trigger, "~/break", lambda request, response: self.fail(request))

    def on_failure(self, sentence: str, error: Exception) -> None:
        self.said = sentence

    def fail(self, _: Any) -> None:
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
        node.create_timer(0.001, lambda: node.fail(None))
    else:
        publisher.publish(JointState())
    harness.spin_until(lambda: node.said, "the failure")
    assert not node.is_active
    assert_one_sentence(node.said, "'fragile'", "OverflowError", "test_watchdog.py")
    harness.spin_until(lambda: probe.count("events") == 2, "both events")
    harness.settle(probe)
    failed, deactivated = (values_of(m)["event"] for m in probe.messages["events"])
    assert (failed, deactivated) == ("failed", "deactivated")
    assert probe.messages["events"][0].level == DiagnosticStatus.ERROR
    assert node.trigger_activate() is TransitionCallbackReturn.SUCCESS
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
