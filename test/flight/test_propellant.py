"""Propellant by the thrust of a flight, with a made table of thrusters."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.flight import reading
from spacerobot_ros.flight.flight import Signal
from spacerobot_ros.flight.reading import impulse, with_propellant

THRUST = Signal(np.array([1.0, 1.5, 3.5]), np.array([[9.0, 9.0], [2.0, 4.0], [6.0, 0.5]]))


@dataclass(frozen=True)
class Made:
    """What is read of a flight."""

    series: Any
    robot: Any = "robot"

    def signal(self, name: str) -> Signal:
        found: Signal = self.series[name]
        return found


@pytest.fixture(autouse=True)
def _table(monkeypatch: pytest.MonkeyPatch) -> None:
    def find_thrusters(source: str, robot: object) -> Any:
        if source != "table":
            raise SpaceRobotError("There is no table.")
        table = SimpleNamespace(names=("left", "right"), mass_flow=np.array([0.02, 0.01]))
        table.force = np.array([10.0, 20.0])
        return table

    monkeypatch.setattr(reading, "find_thrusters", find_thrusters)


def test_propellant_is_the_impulse_over_the_exhaust_speed() -> None:
    flight: Any = with_propellant(Made({"thruster_force": THRUST}), "table", ["left", "right"])  # type: ignore[arg-type]
    used = flight.series["propellant"]
    # Thrust acts in the time before its stamp: 0.5 s, then 2 s.
    first = 0.5 * (2.0 * 0.002 + 4.0 * 0.0005)
    second = 2.0 * (6.0 * 0.002 + 0.5 * 0.0005)
    np.testing.assert_allclose(used.values, [[0.0], [first], [first + second]])
    np.testing.assert_array_equal(used.time, THRUST.time)
    assert flight.series["thruster_force"] is THRUST
    assert impulse(THRUST, np.array([1.0, 0.0])).values[-1, 0] == pytest.approx(1.0 + 12.0)


@pytest.mark.parametrize(
    ("made", "source", "names"),
    [
        (Made({"thruster_force": THRUST}, None), "table", ["left", "right"]),
        (Made({"q": THRUST}), "table", ["left", "right"]),
        (Made({"thruster_force": THRUST, "propellant": THRUST}), "table", ["left", "right"]),
        (Made({"thruster_force": THRUST}), "elsewhere", ["left", "right"]),
        (Made({"thruster_force": THRUST}), "table", ["right", "left"]),
    ],
)
def test_a_flight_without_known_thrusters_stays_as_it_is(
    made: Made, source: str, names: list[str]
) -> None:
    assert with_propellant(made, source, names) is made  # type: ignore[arg-type, comparison-overlap]
