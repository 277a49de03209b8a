"""What a bag says of the scenario that was flown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict

from spacerobot_ros.model.description import Array
from spacerobot_ros.parameters import Parameter
from spacerobot_ros.planning import Goal
from spacerobot_ros.session.scenario import Scenario

Specs = Mapping[str, Sequence[Parameter]]
"""The parameters of nodes by the nodes' names."""


def scenario_record(scenario: Scenario) -> dict[str, str]:
    """Return the metadata record ``scenario``: name, description, goals, published figures."""
    return {
        "name": scenario.name,
        "description": scenario.description,
        **_goal_record("goal", scenario.goal),
        **_goal_record("end_effector_goal", scenario.end_effector_goal),
        "published": json.dumps([asdict(row) for row in scenario.comparable]),
    }


def parameter_records(scenario: Scenario, specs: Specs) -> dict[str, dict[str, str]]:
    """Return the metadata records ``parameters/<node>``: every parameter as a JSON text.

    They are what the nodes take them to be: defaults, the scenario's file, its overrides.
    """
    return {
        f"parameters/{node}": {
            spec.name: json.dumps(spec.checked(scenario.parameter(node, spec.name, spec.default)))
            for spec in specs[node]
        }
        for node in specs
    }


def _goal_record(name: str, goal: Goal | None) -> dict[str, str]:
    if goal is None:
        return {}
    return {
        f"{name}_position": _words(goal.position),
        f"{name}_orientation": _words(goal.quaternion),
    }


def _words(values: Array) -> str:
    return " ".join(repr(x) for x in values.tolist())
