"""The scenario `servicing`: approach, capture, detumbling and carrying in one flight."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from spacerobot_ros import fly
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.events import EventKind
from spacerobot_ros.flight.flight import Flight
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import rotvec_from_quaternion
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.simulation.actuators import build_plant

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


def commanded(flight: Flight, engine: str) -> tuple[dict[str, np.ndarray], int]:
    """Return states of a plant under the recorded efforts and thrust, and the tick of capture."""
    scenario = load_scenario("servicing")
    # The wrench is that of the thrusters.
    config = replace(scenario.plant, engine=engine, thrusters="")
    plant = build_plant(SpaceRobot.from_file(robot_file("servicer_wheels")), config)
    capturing = plant.capturing
    assert capturing is not None
    effort = flight.commands["joint_commands"].values
    wrench = flight.signal("thruster_wrench").values[1:]
    rows: dict[str, list[np.ndarray]] = {}
    captured = 0
    for tick in range(len(flight.time)):
        for name, values in (
            ("pose", plant.pose),
            ("q", plant.q),
            ("target", capturing.target_pose),
            ("momentum", plant.momentum[:6]),
            ("expected", plant.expected_momenta),
        ):
            rows.setdefault(name, []).append(values.copy())
        if capturing.payload is None:
            captured = tick
        if tick < len(effort):
            plant.step(effort[tick], wrench[tick])
    return {name: np.array(values) for name, values in rows.items()}, captured


def test_mujoco_flies_the_same_flight_from_its_commands(flight: Flight) -> None:
    """Approach, capture by a weld, detumbling by wheels and thrusters, carrying: no feedback."""
    pytest.importorskip("mujoco")
    flown, captured = commanded(flight, "mujoco")
    exact, also = commanded(flight, "exact")
    assert captured == also
    np.testing.assert_array_equal(exact["pose"], flight.pose)
    arm = [k for k, name in enumerate(flight.joint_names) if "wheel" not in name]
    for until, base, turn, joints, target in (
        (captured, 1e-12, 1e-11, 1e-9, 1e-11),
        (captured + 100, 2e-6, 2e-5, 1e-3, 5e-5),
        (len(flight.time), 5e-3, 5e-2, 0.3, 5e-3),
    ):
        part = slice(0, until)
        off = {name: np.abs(flown[name][part] - exact[name][part]) for name in flown}
        figures = (
            off["pose"][:, :3].max(),
            2 * off["pose"][:, 3:].max(),
            off["q"][:, arm].max(),
            off["target"][:, :3].max(),
        )
        print(f"until {until / 100:g} s:", *(f"{x:.1e}" for x in figures))
        assert np.all(np.array(figures) < (base, turn, joints, target))
    for part in (slice(0, 3), slice(3, 6)):
        largest = np.linalg.norm(flown["expected"][:, part], axis=1).max()
        left = np.abs(flown["momentum"] - flown["expected"])[:, part].max() / largest
        print(f"momentum: {left:.1e} of the largest")
        assert left < 1e-6


def test_in_mujoco_the_satellite_is_placed_as_well() -> None:
    pytest.importorskip("mujoco")
    flown = fly(load_scenario("servicing").with_overrides("plant", {"engine": "mujoco"}))
    assert flown.succeeded, flown.message
    assert not [each for each in flown.events if each.kind is EventKind.CONTACT]
    np.testing.assert_allclose(flown.pose[-1, :3], [-0.8, 0.3, 0.2], atol=0.002)


def test_a_satellite_that_tumbles_too_fast_is_refused() -> None:
    fast = {"target.angular_velocity": (0.0, 0.5, -0.5)}
    words = "The approach is refused: the target moves too fast to be met"
    with pytest.raises(PlanningError, match=words):
        fly(load_scenario("servicing").with_overrides("plant", fast))
