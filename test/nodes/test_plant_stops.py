"""Goals of planner and controller when the plant does not obey, and states of other times."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import Log
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool, Trigger
from support.control_loop import Loop, pose
from support.planner_flight import NEAR, PLANNER, Flight, stamp_of
from support.ros_harness import LATCHED, Harness, Probe
from support.sentences import assert_one_sentence

from spacerobot_ros.messages.statuses import StatusRecord
from spacerobot_ros.simulation.status import PlantState, PlantStatus

pytestmark = pytest.mark.usefixtures("one_plant")

REAL_TIME = {"time_mode": "realtime", "real_time_factor": 10.0, "command_timeout": 0.5}
BACKGROUND = {"plan_in_background": True}
OTHER = ([-0.03, 0.0, 0.01], [0.0, 0.0, 0.0])
SLOW = {**PLANNER, "lie_bracket.t1": 4.0}
"""A slide of 4 s."""


def call(flight: Flight, service: str) -> Any:
    client = flight.probe.create_client(Trigger, f"plant/{service}")
    return flight.harness.call(client, Trigger.Request())


def pause(flight: Flight, paused: bool) -> None:
    client = flight.probe.create_client(SetBool, "plant/pause")
    assert flight.harness.call(client, SetBool.Request(data=paused)).success


def place(flight: Flight) -> list[float]:
    return list(flight.probe.last("joint_states").position)


def stays(flight: Flight) -> None:
    """Check that nothing moves, as long as any watch for joints that do not follow could take."""
    rest = place(flight)
    flight.ticks(60)
    assert place(flight) == rest


def flies_again(flight: Flight, *states: str) -> None:
    """Check which states there have been, and that the next goal is reached."""
    assert flight.states == list(states)
    flight.decide(NEAR)
    assert flight.states[-1] == "reached"


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_an_abort_of_the_plant_ends_the_goal_until_there_is_another(
    harness: Harness, tmp_path: Path, mode: str
) -> None:
    plant = REAL_TIME if mode == "realtime" else {}
    file = tmp_path / "goal.json"
    flight = Flight(harness, {**SLOW, "resume_file": str(file)}, plant)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(15)
    assert file.exists()
    call(flight, "abort")
    status = flight.wait("aborted")
    assert_one_sentence(status.message, "Aborted by the plant: stopped on request.")
    assert not file.exists()
    flight.ticks(60)
    rest = place(flight)
    flight.send(OTHER)
    refused = flight.wait("refused")
    assert_one_sentence(refused.message, "'/plant' is latched", "rearm it")
    call(flight, "rearm")
    stays(flight)
    assert place(flight) == rest
    flies_again(flight, "idle", "executing", "aborted", "refused")


def test_only_the_last_of_the_states_that_wait_is_answered(
    harness: Harness, monkeypatch: pytest.MonkeyPatch
) -> None:
    # On a loaded machine the plant makes up for late ticks: that is no jump of its time here.
    monkeypatch.setattr("spacerobot_ros.commanding.plant_state._PACE_SLACK", 1000.0)
    flight = Flight(harness, {**SLOW, **BACKGROUND}, REAL_TIME)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(10)
    seen = stamp_of(flight.probe.last("joint_states"))
    harness.executor.remove_node(flight.planner)
    flight.ticks(12)
    before = flight.probe.count("joint_commands")
    harness.executor.add_node(flight.planner)

    def answered() -> list[int]:
        stamps = [stamp_of(m) for m in flight.probe.messages["joint_commands"][before:]]
        # Answers to earlier states were on their way.
        return [stamp for stamp in stamps if stamp > seen]

    harness.spin_until(lambda: len(answered()) > 2, "commands after a standstill")
    # The last ones may be on their way to the planner still.
    waiting = [s for s in map(stamp_of, flight.probe.messages["joint_states"]) if s > seen]
    assert min(answered()) >= waiting[6]
    assert answered() == sorted(set(answered()))


def test_a_goal_on_file_is_not_resumed_while_the_plant_is_latched(
    harness: Harness, tmp_path: Path
) -> None:
    file = tmp_path / "goal.json"
    file.write_text('{"base": {"position": [0.05, 0, 0], "quaternion": [0, 0, 0, 1], '
                    '"joint_positions": null, "id": "7.000000000"}}')  # fmt: skip
    flight = Flight(harness, {"resume_file": str(file)})
    flight.start()
    call(flight, "abort")
    flight.planner.trigger_deactivate()
    flight.planner.trigger_activate()
    flight.ticks(5)
    assert not file.exists()
    assert not np.any(place(flight))


# -- statuses of others -----------------------------------------------------------------------


def forged(harness: Harness, name: str) -> tuple[Probe, Publisher]:
    """Return a node that publishes statuses in the name of the plant, and its publisher."""
    forger = harness.probe({}, name=name)
    topic = forger.create_publisher(DiagnosticStatus, "plant/status", LATCHED)
    harness.matched(topic)
    return forger, topic


LATCHED_PLANT = PlantStatus(PlantState.LATCHED, "Nothing moves: a fuse.", "abort", "a fuse")


def message_of(status: PlantStatus) -> bytes:
    return StatusRecord("/plant", status.level, status.message, status.to_values()).encoded()


def test_a_status_of_another_node_stops_nothing_and_is_reported(harness: Harness) -> None:
    flight = Flight(harness, SLOW)
    flight.probe.watch("/rosout", Log, latched=True)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(5)
    pause(flight, True)  # In lockstep the goal may be reached before the forger is connected.
    forger, topic = forged(harness, "forger")
    topic.publish(message_of(LATCHED_PLANT))
    harness.spin_until(
        lambda: any(
            "more publishers than odom" in line.msg for line in flight.probe.messages["/rosout"]
        )
    )
    pause(flight, False)
    flight.ticks(5)
    assert flight.states == ["idle", "executing"]
    pause(flight, True)
    # The plant's own statuses count again, the one that was not heard first, once it is alone.
    call(flight, "abort")
    harness.remove(forger)
    status = flight.wait("aborted")
    assert_one_sentence(status.message, "stopped on request")
    call(flight, "rearm")
    pause(flight, False)
    flies_again(flight, "idle", "executing", "aborted")


def test_a_status_of_a_node_that_has_left_locks_nothing(harness: Harness) -> None:
    """It ends the goal if it is heard after its node has left; the plant's last one counts then."""
    flight = Flight(harness, SLOW)
    flight.start()
    flight.send(NEAR)
    flight.wait("executing")
    flight.ticks(5)
    harness.executor.remove_node(flight.planner)
    forger, topic = forged(harness, "forger")
    topic.publish(message_of(LATCHED_PLANT))
    harness.remove(forger)
    own = flight.planner.resolve_topic_name("plant/status")
    harness.spin_until(lambda: len(flight.planner.get_publishers_info_by_topic(own)) == 1)
    harness.executor.add_node(flight.planner)
    flight.wait("aborted", "reached")
    plant = flight.planner.commander.plant
    harness.spin_until(lambda: not plant.refusal_of_goals, "the plant's own status")
    flies_again(flight, *flight.states)


# -- the controller ---------------------------------------------------------------------------


HOSTILE = "A fuse: \x1b[2J\x1b]0;title\x07 it is\rblown.\n"
"""Clears the terminal of whoever reads the controller's log."""


@pytest.mark.parametrize(
    "stopped",
    [
        PlantStatus(PlantState.FAILED, HOSTILE, "model"),
        PlantStatus(PlantState.LATCHED, "Nothing moves.", "abort", HOSTILE),
    ],
)
def test_control_characters_of_a_status_reach_no_status_and_no_log(
    harness: Harness, stopped: PlantStatus
) -> None:
    loop = Loop(harness)
    logs = harness.probe({"/rosout": Log}, name="reader")
    topic = loop.probe.create_publisher(DiagnosticStatus, "plant/status", LATCHED)
    harness.matched(topic)
    loop.aim(base=pose([1.0, 0.0, 0.0]))
    loop.answer()
    loop.wait_for("tracking")
    topic.publish(message_of(stopped))
    status = loop.wait_for("aborted")
    assert_one_sentence(status.message, "Aborted by the plant: A fuse")
    harness.spin_until(
        lambda: any("blown" in line.msg for line in logs.messages["/rosout"]), "the log of the end"
    )
    texts = [status.message, *(line.msg for line in logs.messages["/rosout"])]
    texts += [text for pair in status.values for text in (pair.key, pair.value)]
    assert all(text.isprintable() for text in texts)
