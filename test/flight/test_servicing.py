"""A planar arm approaches a block, captures it, comes to rest and carries it, in few ticks."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.scenario import load_scenario


def test_a_planar_arm_fetches_a_block(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")
    target = {
        "tick_rate": 5.0,
        "integration_step": 0.1,
        "clearance_period": 0.0,
        "target.position": (2.2, -0.1, 0.0),
        "target.velocity": (0.004, -0.003, 0.0),
        "target.angular_velocity": (0.0, 0.0, 0.02),
        "capture.speed": 0.02,
    }
    control = {
        "tick_rate": 5.0,
        "tasks": "approach detumble",
        "target.standoff": (-0.1, 0.0, 0.0),
        "target.standoff_time": 0.5,
        # The arm grasps obliquely, past a corner of the block.
        "target.clearance": 0.0,
        "detumble.grapple_torque_limit": 0.5,
        "max_torque": 2.0,
        "max_force": 5.0,
        "gains.base_position.kp": 0.5,
        "gains.base_position.kd": 1.4,
        "gains.base_attitude.kp": 1.0,
        "gains.base_attitude.kd": 2.0,
        "gains.end_effector_position.kp": 4.0,
        "gains.end_effector_position.kd": 4.0,
        "settle_time": 0.5,
        "position_tolerance": 0.1,
        "attitude_tolerance": 0.1,
    }
    scenario = load_scenario("capture").with_overrides("plant", target)
    flight = fly_scenario(scenario.with_overrides("coordinated_control", control), longest=120.0)
    assert flight.succeeded, flight.message
    kinds = [each.kind for each in flight.events]
    assert kinds[-4:] == [
        EventKind.CAPTURED,
        EventKind.DETUMBLE_STARTED,
        EventKind.DETUMBLED,
        EventKind.GOAL_REACHED,
    ]
    detumbling = flight.summary()["detumbling"]
    assert detumbling == {"time_s": flight.events[-2].time_s, **detumbling}
    assert detumbling["largest_torque_Nm"] == 2.0
    assert 0.0 < detumbling["shortest_s"] < detumbling["took_s"] < 30.0
    assert detumbling["grasp_torque_Nm"] <= 0.5 + 1e-9
    summed, expected = flight.momentum[:, :6], flight.signal("expected_momenta").values
    assert np.abs(summed - expected).max() < 1e-11
    assert np.abs(expected).max() > 0.05
