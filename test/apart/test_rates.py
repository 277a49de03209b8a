"""Plants of other rates, which commanders with nothing but their defaults follow."""

from __future__ import annotations

import pytest
from support.nodes_apart import NodesApart
from support.planner_flight import Place
from support.slow import some_fast

SLIDE: Place = ([0.05, 0.0, 0.0], [0.0, 0.0, 0.0])
TURN: Place = ([0.1, 0.05, 0.0], [0.0, 0.0, 0.1])
FLIGHTS = {
    "planner": ("sliding_masses", SLIDE),
    "coordinated_control": ("planar_manipulator", TURN),
}
RATES = [(node, rate) for node in FLIGHTS for rate in (5.0, 10.0, 50.0, 200.0)]


@pytest.mark.parametrize(
    ("node", "rate"), some_fast(RATES, ("planner", 10.0), ("coordinated_control", 50.0))
)
def test_a_plant_of_any_rate_is_followed(apart: NodesApart, node: str, rate: float) -> None:
    robot, place = FLIGHTS[node]
    apart.start("plant", robot=robot, tick_rate=rate)
    apart.start(node)
    apart.start("recorder")
    apart.fly(node, place, readers=2)
    assert apart.status("plant")["tick_rate_hz"] == f"{rate:g}"
    apart.end()
    assert apart.complaints == []
