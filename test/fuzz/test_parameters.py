"""Parameters of every node with any values: taken in their own type, or refused by name."""

from __future__ import annotations

import math
from typing import Any

import pytest
import rclpy
from hypothesis import strategies as st
from rclpy.parameter import Parameter as RosParameter
from support.fuzzing import FINITE, MODEST, NUMBERS, TEXTS, VALUES, attempt, fuzz

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.nodes import NODE_TYPES, ReplayNode
from spacerobot_ros.nodes.common.node import AUTOSTART, FlightNode
from spacerobot_ros.parameters import Parameter, declared

KINDS: list[type[FlightNode]] = [*NODE_TYPES.values(), ReplayNode]
SPECS = [AUTOSTART, *(spec for kind in KINDS for spec in declared(kind.Config))]
WHOLE = st.integers(-(2**63), 2**63 - 1)
ROS_VALUES = st.one_of(
    st.booleans(),
    WHOLE,
    NUMBERS,
    MODEST,
    TEXTS,
    st.lists(NUMBERS | MODEST, min_size=1, max_size=7),
    st.lists(WHOLE, min_size=1, max_size=4),
    st.lists(TEXTS, min_size=1, max_size=3),
)
"""What a parameter of ROS may hold."""

BASES: dict[str, dict[str, Any]] = {
    "plant": {"robot": "sliding_masses"},
    "planner": {"robot": "sliding_masses"},
    "coordinated_control": {"robot": "planar_manipulator"},
}
"""With these alone a node configures."""


@fuzz("parameter", st.sampled_from(SPECS), st.one_of(VALUES, ROS_VALUES), fast=100, long=3000)
def test_every_parameter_takes_a_value_or_names_itself(spec: Parameter, value: object) -> None:
    taken = attempt("parameter", spec.checked, value)
    if taken is None:
        with pytest.raises(SpaceRobotError, match=spec.name):
            spec.checked(value)
        return
    assert type(taken) is type(spec.default)
    if isinstance(taken, (int, float)) and not isinstance(taken, bool):
        assert math.isfinite(taken)
        assert spec.minimum <= taken <= spec.maximum
    assert spec.checked(taken) == taken


def plausible(spec: Parameter) -> st.SearchStrategy[Any]:
    """Return values of a parameter's own type, at the ends of its range and anywhere."""
    if isinstance(spec.default, bool):
        return st.booleans()
    if isinstance(spec.default, str):
        return st.sampled_from([*spec.choices]) if spec.choices else TEXTS
    if isinstance(spec.default, tuple):
        return st.lists(TEXTS if spec.texts else MODEST | FINITE, min_size=1, max_size=4)
    ends = st.sampled_from([x for x in (spec.minimum, spec.maximum) if math.isfinite(x)] or [0.0])
    numbers = st.one_of(ends, MODEST, st.floats(spec.minimum, spec.maximum))
    if isinstance(spec.default, float):
        return numbers.map(float)
    return numbers.filter(math.isfinite).map(lambda x: max(min(int(x), 2**63 - 1), -(2**63)))


@st.composite
def overrides(draw: st.DrawFn, node: str) -> dict[str, Any]:
    specs = [
        spec for spec in declared(NODE_TYPES[node].Config) if spec.name not in ("path", "robot")
    ]
    chosen = draw(st.lists(st.sampled_from(specs), min_size=1, max_size=3, unique_by=id))
    return {spec.name: draw(st.one_of(plausible(spec), ROS_VALUES)) for spec in chosen}


@pytest.mark.parametrize("node", BASES)
def test_a_node_configures_or_says_what_is_wrong(node: str, ros_context: rclpy.Context) -> None:
    @fuzz("node", overrides(node), fast=8, long=15)
    def construct(given: dict[str, Any]) -> None:
        parameters = [
            RosParameter(name, value=value) for name, value in (BASES[node] | given).items()
        ]
        made = attempt(
            "node",
            NODE_TYPES[node],
            context=ros_context,
            parameter_overrides=parameters,
            autostart=True,
        )
        if made is not None:
            made.trigger_deactivate()
            made.destroy_node()

    construct()
