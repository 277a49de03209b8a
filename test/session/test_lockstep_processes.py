"""Flights of a scenario in lockstep: the same messages without ROS and by nodes, every time."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import pytest
from rclpy.serialization import deserialize_message

from spacerobot_ros.bag import iterate_raw
from spacerobot_ros.nodes.common.messages import message_class
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_domain")]

ENDS = ("/events", "/plant/status")
"""Topics on which nodes say that they begin and end, as flights without ROS do not."""


def messages(bag: Path) -> dict[str, list[Any]]:
    """Return the messages of each topic, with their stamps; wall times are left out.

    When a message has come to the recorder is not compared: nodes do not wait for each other there.
    """
    found = defaultdict(list)
    for topic, kind, _, _, raw in iterate_raw(bag):
        message = deserialize_message(raw, message_class(kind))
        if topic == "/events":
            message.values = [pair for pair in message.values if pair.key != "wall_time"]
        found[topic].append(message)
    # Events of different nodes come in any order.
    found["/events"].sort(key=str)
    return found


@pytest.mark.parametrize("name", ["faults/stuck_elbow", "planar_chain"])
def test_every_run_is_the_same(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(name)
    bags = [tmp_path / f"{k}.mcap" for k in range(4)]
    for k, bag in enumerate(bags):
        run_scenario(scenario, bag, nodes=k > 0)
    one, first, *others = map(messages, bags)
    for other in others:
        assert other == first
    for topic in one.keys() - {*ENDS, "/diagnostics"}:
        # The last command is under way when the plant stops.
        count = min(len(one[topic]), len(first[topic]))
        assert count >= len(one[topic]) - 1
        assert one[topic][:count] == first[topic][:count], topic
