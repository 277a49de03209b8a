"""Streams of serialised messages, and whether all nodes of a stack have met."""

from __future__ import annotations

from typing import Any

import pytest
from lifecycle_msgs.msg import State
from std_msgs.msg import String
from std_srvs.srv import Trigger
from support.ros_harness import Harness

from spacerobot_ros.nodes import PlantNode
from spacerobot_ros.nodes.common.streams import (
    MatchedEndpoints,
    topics_without_all_matches,
)

PLANT = MatchedEndpoints((("/odom", 2), ("/clock", 1)), (("/joint_commands", 1),))
PLANNER = MatchedEndpoints((("/joint_commands", 2),), (("/odom", 1),))
RECORDER = MatchedEndpoints((), (("/odom", 1), ("/clock", 1), ("/joint_commands", 1)))


def test_all_have_met_or_the_topics_say_who_has_not() -> None:
    assert topics_without_all_matches([PLANT, PLANNER, RECORDER]) == set()
    early = MatchedEndpoints((("/odom", 1), ("/clock", 1)), PLANT.subscriptions)
    assert topics_without_all_matches([early, PLANNER, RECORDER]) == {"/odom"}, (
        "a publisher knows one reader"
    )
    deaf = MatchedEndpoints((), (("/odom", 1), ("/clock", 0), ("/joint_commands", 1)))
    assert topics_without_all_matches([PLANT, PLANNER, deaf]) == {"/clock"}, (
        "a reader knows no publisher"
    )
    # Readers from elsewhere are no matter.
    more = MatchedEndpoints((("/odom", 7), ("/clock", 7)), PLANT.subscriptions)
    assert topics_without_all_matches([more, PLANNER, RECORDER]) == set()


def test_two_readers_of_one_node_are_two() -> None:
    twice = MatchedEndpoints((), (("/clock", 1), ("/clock", 1)))
    assert topics_without_all_matches([PLANT, PLANNER, RECORDER, twice]) == {"/clock"}


@pytest.fixture
def plant(harness: Harness) -> PlantNode:
    return harness.make(PlantNode, {"robot": "sliding_masses", "autostart": False})


def test_a_node_answers_with_its_endpoints(harness: Harness, plant: PlantNode) -> None:
    plant.trigger_configure()
    probe = harness.probe({"odom": _odometry()})
    harness.connect()
    client = probe.create_client(Trigger, "plant/connections")
    found = MatchedEndpoints.from_json(harness.call(client, Trigger.Request()).message)
    assert found == MatchedEndpoints.of(plant)
    assert ("/odom", 1) in found.publishers
    assert ("/joint_commands", 0) in found.subscriptions
    assert not {"/rosout", "/parameter_events"} & {topic for topic, _ in found.publishers}
    probe.create_publisher(String, "fault_injection", 10)
    harness.connect()
    assert (
        topics_without_all_matches([MatchedEndpoints.of(plant), MatchedEndpoints.of(probe)])
        == set()
    )


def _odometry() -> Any:
    from nav_msgs.msg import Odometry

    return Odometry


def test_a_node_that_was_shut_down_ends_without_another_transition(
    harness: Harness, plant: PlantNode
) -> None:
    plant.trigger_shutdown()
    plant.drain(harness.executor)
    plant.finalize()
    plant.finalize()
    assert plant.lifecycle_state == State.PRIMARY_STATE_FINALIZED


def test_a_plant_in_real_time_rests_before_its_process_ends(harness: Harness) -> None:
    import numpy as np
    from sensor_msgs.msg import JointState

    plant = harness.make(PlantNode, {"robot": "sliding_masses", "tick_rate": 100.0})
    probe = harness.probe({"joint_states": JointState})
    commands = probe.create_publisher(JointState, "joint_commands", 10)
    harness.connect()
    names = list(plant.plant.robot.joint_names)

    def answer(state: JointState) -> None:
        message = JointState(name=names, velocity=[0.01] * len(names))
        message.header.stamp = state.header.stamp
        commands.publish(message)

    probe.react["joint_states"] = answer
    harness.spin_until(
        lambda: (
            probe.messages["joint_states"][-1:] and max(probe.last("joint_states").velocity) > 0
        ),
        "it moves",
    )
    plant.drain(harness.executor)
    np.testing.assert_array_equal(plant.plant.qdot, 0.0)
    harness.spin_until(lambda: max(probe.last("joint_states").velocity) == 0, "it is published")
    assert plant.is_active
