"""The README's tables of parameters are the nodes' own."""

from __future__ import annotations

from pathlib import Path

import pytest

from spacerobot_ros.nodes import (
    CoordinatedControlNode,
    FlightNode,
    PlannerNode,
    PlantNode,
    RecorderNode,
    ReplayNode,
)
from spacerobot_ros.nodes.common.node import AUTOSTART
from spacerobot_ros.parameters import declared

README = Path(__file__).resolve().parents[2] / "README.md"


@pytest.mark.parametrize(
    ("heading", "node"),
    [
        ("plant", PlantNode),
        ("planner", PlannerNode),
        ("coordinated_control", CoordinatedControlNode),
        ("recorder", RecorderNode),
        ("replay", ReplayNode),
    ],
)
def test_parameters_are_documented_with_their_defaults(
    heading: str, node: type[FlightNode]
) -> None:
    section = README.read_text(encoding="utf-8").split(f"\n### {heading}\n")[1].split("\n#")[0]
    rows = [
        [cell.strip().strip("`") for cell in line.strip("|").split("|")]
        for line in section.splitlines()
        if line.startswith("| `")
    ]
    documented = {row[0]: row[1] for row in rows}
    for spec in (AUTOSTART, *declared(node.Config)):
        default: object = spec.default
        if isinstance(default, bool):
            default = str(default).lower()
        elif isinstance(default, tuple):
            default = list(default)
        assert documented.pop(spec.name) == (str(default) or "''"), spec.name
    assert documented == {}
