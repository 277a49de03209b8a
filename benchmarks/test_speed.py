"""What users wait for, in processor time."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.conftest import CLOCK, Measure

pytestmark = pytest.mark.benchmark(timer=CLOCK)

PLANS: dict[str, dict[str, Any]] = {
    "planar_chain": {"rotvec": [0.0, 0.0, 0.9]},
    "sliding_masses": {"position": [0.1, -0.05, 0.08], "rotvec": [0.1, 0.05, -0.08]},
    "three_joint_arm": {"rotvec": [0.1, -0.2, 0.15]},
    "servicer": {"rotvec": [0.15, 0.1, -0.2]},
    "surveyor": {"rotvec": [0.1, 0.1, -0.1]},
}
"""Goals of ``optimal`` by robot."""


@pytest.mark.parametrize(
    ("scenario", "parameters"),
    [
        ("sliding_masses", {"planner.method": "lie_bracket"}),
        ("coordinated_control", {}),
        ("servicer", {}),
    ],
)
def test_tick_without_ros(measure: Measure, scenario: str, parameters: dict[str, Any]) -> None:
    """A tick of plant and commander, averaged over a flight."""
    measure("tick", scenario=scenario, parameters=parameters)


@pytest.mark.parametrize("scenario", ["sliding_masses", "coordinated_control"])
def test_run_in_lockstep_with_its_bag(measure: Measure, scenario: str) -> None:
    """A flight by command."""
    measure("run", scenario=scenario)


@pytest.mark.parametrize("robot", PLANS)
def test_first_plan(measure: Measure, robot: str) -> None:
    """The plan of a robot that is new to this machine."""
    measure("first_plan", rounds=3, robot=robot, method="optimal", cache=0, **PLANS[robot])


@pytest.mark.parametrize("robot", PLANS)
def test_next_plan(measure: Measure, robot: str) -> None:
    """A plan of a robot that is known."""
    measure("next_plan", robot=robot, method="optimal", cache=0, **PLANS[robot])


def test_ten_thousand_flights_in_open_loop(measure: Measure) -> None:
    """A campaign, with its report."""
    measure("campaign", rounds=3, flights=10_000)


@pytest.mark.parametrize("count", [256, 4096])
@pytest.mark.parametrize("name", ["ReorientArm-v0", "Reach-v0"])
def test_step_of_many_environments(measure: Measure, name: str, count: int) -> None:
    """A step of one of many robots with random actions, each held for five ticks."""
    measure("steps", environments=f"{count} {name}")


def test_reading_a_bag(measure: Measure) -> None:
    """All topics of a flight as arrays."""
    measure("read", scenario="coordinated_control")
