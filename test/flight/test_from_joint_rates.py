"""The laws of paper 3 begin at joint rates that are not zero (its property 3)."""

from __future__ import annotations

import numpy as np
import pytest
from support.oracles import PinocchioOracle

from spacerobot_ros import fly
from spacerobot_ros.scenario import load_scenario

AT_REST = 1e-12
"""Largest angular momentum in Pinocchio, kg m^2/s; the robot's links turn with up to 20."""


@pytest.mark.slow
@pytest.mark.parametrize("rates", [(0.1, -0.06), (-0.2, 0.15)])
def test_the_chain_is_turned_from_moving_joints(rates: tuple[float, float]) -> None:
    scenario = load_scenario("planar_chain")
    moving = scenario.with_overrides("plant", {"initial_joint_velocities": list(rates)})
    flight = fly(moving)
    assert flight.robot is not None
    np.testing.assert_allclose(flight.qdot[0], rates, atol=1e-12)
    assert np.abs(flight.twist[0, 5]) > 0.005, "the base turns at the start"
    assert flight.succeeded
    error = flight.measures.error
    assert error is not None
    assert error.angle < 2e-4
    assert flight.measures.corrections == 0
    oracle = PinocchioOracle(flight.robot.urdf, flight.robot.joint_names)
    for k in range(0, len(flight.time), 100):
        oracle.place(flight.q[k], flight.pose[k, 3:], flight.pose[k, :3])
        velocities = oracle.joint_velocities(flight.qdot[k])
        velocities[:6] = flight.twist[k]
        L = oracle.momentum_matrix_W()[3:] @ velocities
        assert np.abs(L).max() < AT_REST
