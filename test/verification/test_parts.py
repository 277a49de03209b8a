"""Parts of a verification by themselves: what is compared, what is missing, and why."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np

from spacerobot_ros.flight import second_opinion
from spacerobot_ros.flight.second_opinion import EngineComparison
from spacerobot_ros.flight.verification import Difference, _PublishedTopic
from spacerobot_ros.topics import TOPICS


def published(name: str, ticks: list[int], values: Any) -> _PublishedTopic:
    table = np.array(values, dtype=float)
    labels = [f"number {i}" for i in range(table.shape[1])]
    return _PublishedTopic(TOPICS[name], f"/{name}", np.array(ticks, np.int64), table, labels)


def joints(ticks: list[int], values: Any) -> _PublishedTopic:
    return published("joint_states", ticks, values)


def test_a_difference_is_a_sentence() -> None:
    found = Difference(0.15, "/odom", "x", 1.5, 2.25, " (why)")
    assert str(found) == "/odom at 0.15 s: x is 1.5 in the bag and 2.25 by its commands (why)."


# -- the second engine ---------------------------------------------------------------------------


def test_an_engine_agrees_within_a_bound_in_each_quantity() -> None:
    at = second_opinion.AGREEMENT_TOLERANCE
    same = EngineComparison("e", "i", 1, at, at, at, 0.0)
    assert same.agrees
    assert same.stop_reason == ""
    for name in ("position", "attitude", "joints"):
        assert not replace(same, **cast(Any, {name: at * 1.001})).agrees
