"""The scenario `servicing`: approach, capture, detumbling and carrying in one flight."""

from __future__ import annotations

import numpy as np
import pytest

from spacerobot_ros import fly
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.scenario import load_scenario

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def flight() -> Flight:
    return fly(load_scenario("servicing"))


def test_a_tumbling_satellite_is_captured_brought_to_rest_and_carried(flight: Flight) -> None:
    assert flight.succeeded, flight.message
    phases = [
        each.kind
        for each in flight.events
        if each.kind.value.startswith(("approach", "captured", "detumbl", "goal"))
    ]
    assert phases == [
        EventKind.GOAL_ACCEPTED,
        EventKind.APPROACH_STARTED,
        EventKind.CAPTURED,
        EventKind.DETUMBLE_STARTED,
        EventKind.DETUMBLED,
        EventKind.GOAL_REACHED,
    ]
    tumbling = np.degrees(np.linalg.norm(flight.signal("target_twist").values[0, 3:]))
    assert tumbling == pytest.approx(3.0 * np.sqrt(2.0), rel=1e-6)
    summary = flight.summary()
    capture, detumbling = summary["capture"], summary["detumbling"]
    assert np.linalg.norm(capture["impulse_Ns"][:3]) < 0.5
    assert detumbling["shortest_s"] < detumbling["took_s"] < 4.0
    assert detumbling["grasp_torque_Nm"] <= 5.0 + 1e-9
    after = flight.time >= detumbling["time_s"]
    assert np.linalg.norm(flight.twist[after][0, 3:]) < 0.002
    turn = rotvec_from_quaternion(flight.pose[-1, 3:])
    np.testing.assert_allclose(flight.pose[-1, :3], [-0.8, 0.3, 0.2], atol=0.002)
    np.testing.assert_allclose(turn, [0.05, -0.04, 0.12], atol=0.002)


def test_the_momenta_are_those_of_the_thrust_to_the_last_digits(flight: Flight) -> None:
    """Of robot and target together, summed over the bodies: by the ledger of impulses."""
    summed = flight.signal("momentum").values[:, :6]
    expected = flight.signal("expected_momenta").values
    for part in (slice(0, 3), slice(3, 6)):
        largest = np.linalg.norm(expected[:, part], axis=1).max()
        assert largest > 1.0
        assert np.abs(summed[:, part] - expected[:, part]).max() <= 1e-12 * largest


def test_a_satellite_that_tumbles_too_fast_is_refused() -> None:
    fast = {"target.angular_velocity": (0.0, 0.5, -0.5)}
    flight = fly(load_scenario("servicing").with_overrides("plant", fast))
    assert flight.outcome.value == "refused"
    assert "The approach is refused: the target moves too fast to be met" in flight.message
