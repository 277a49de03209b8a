"""Parameters that are set while a robot flies: every live one, to everything it may be told."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from rclpy.parameter import Parameter as RosParameter
from support.control_loop import Loop, pose
from support.planner_flight import HERE, NEAR, Flight
from support.ros_harness import Harness

from spacerobot_ros.nodes.common.node import FlightNode
from spacerobot_ros.parameters import Parameter, declared

NUMBERS = (0.0, 1e-300, 1e300, -1.0, math.nan, math.inf, -math.inf)


def attempts(parameter: Parameter) -> list[Any]:
    """Return values within, at and beyond the bounds of a parameter, and of other types."""
    if isinstance(parameter.default, float):
        return [parameter.minimum, parameter.maximum, *NUMBERS, "x", True]
    return [0, 1, -1, 2**62, -(2**62), 1.5, "x"]


def set_everything(node: FlightNode, fly: Any) -> tuple[int, int]:
    """Set each live parameter to each value, with a part of the flight after each that is taken.

    Return how many were accepted and refused; all are as before afterwards.
    """
    accepted = refused = 0
    for parameter in (each for each in declared(node.Config) if not each.read_only):
        before = node.get_parameter(parameter.name)
        for value in attempts(parameter):
            (result,) = node.set_parameters([RosParameter(parameter.name, value=value)])
            if result.successful:
                accepted += 1
                fly()
            else:
                refused += 1
                assert result.reason
            assert node.is_active
            assert node.parameter_values[parameter.name] == pytest.approx(
                node.get_parameter(parameter.name).value
            )
        assert node.set_parameters([before])[0].successful
    return accepted, refused


def test_a_planner_flies_on_whatever_its_parameters_are_set_to(harness: Harness) -> None:
    flight = Flight(harness)
    flight.start()
    flight.send(NEAR)
    flight.ticks(3)
    accepted, refused = set_everything(flight.planner, lambda: flight.ticks(2))
    assert accepted >= 8
    assert refused >= 16
    flight.send(HERE)
    flight.wait("reached")


@pytest.mark.filterwarnings("ignore:overflow encountered")  # Gains of 1e300 are accepted.
def test_a_controller_flies_on_whatever_its_parameters_are_set_to(harness: Harness) -> None:
    loop = Loop(harness)
    loop.answer()
    loop.aim(base=pose([0.1, 0.0, 0.0]))
    before = loop.answer()
    accepted, refused = set_everything(loop.node, loop.answer)
    assert accepted >= 30
    assert refused >= 50
    wrench, efforts = loop.answer()
    assert np.all(np.isfinite(wrench))
    assert np.all(np.isfinite(efforts))
    assert np.sign(wrench[0]) == np.sign(before[0][0])
