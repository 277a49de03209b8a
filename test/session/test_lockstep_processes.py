"""Flights of a scenario in lockstep: the same messages without ROS and by the nodes, every time."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from spacerobot_ros.bag import iterate_raw
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("own_domain")]

OF_NODES = {"/events", "/plant/status", "/planner/status", "/controller/status", "/diagnostics"}
"""Topics on which nodes also say that they begin, wait and end, at wall times."""

TYPES = get_typestore(Stores.ROS2_JAZZY)


def messages(bag: Path) -> dict[str, list[str]]:
    """Return the messages of each topic as texts.

    When a message has come to the recorder is not compared: nodes do not wait for each other there.
    """
    found = defaultdict(list)
    with np.printoptions(threshold=10**9, floatmode="unique"):
        for topic, kind, _, _, raw in iterate_raw(bag):
            found[topic].append(repr(TYPES.deserialize_cdr(raw, kind)))
    return found


@pytest.mark.parametrize("name", ["faults/stuck_elbow", "planar_chain"])
def test_every_run_is_the_same(name: str, tmp_path: Path) -> None:
    scenario = load_scenario(name)
    bags = [tmp_path / f"{k}.mcap" for k in range(3)]
    for k, bag in enumerate(bags):
        run_scenario(scenario, bag, nodes=k > 0)
    loop, first, second = map(messages, bags)
    assert loop.keys() == first.keys() == second.keys()
    for topic in loop.keys() - OF_NODES:
        # The last command is under way when the plant stops; last digits of markers differ.
        for other in (second, *([loop] if topic != "/markers" else [])):
            count = min(len(other[topic]), len(first[topic]))
            assert count >= max(len(other[topic]), len(first[topic])) - 1, topic
            assert other[topic][: count - 1] == first[topic][: count - 1], topic
