"""What each name under ``disperse`` changes in a flight: exactly one number, in its unit."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.campaigns import campaign

from spacerobot_ros.campaign.draws import Draws, drawn_flight
from spacerobot_ros.campaign.targets import DrawnFlight, MassFactors, description_of, targets_of
from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model.inertial_parameters import InertialParameters
from spacerobot_ros.parameters import values_of
from spacerobot_ros.scenario import Scenario
from spacerobot_ros.simulation.capture import load_target

FAULTS = [
    "joint_stuck slider_2 at 5 until 9",
    "joint_slow slider_1 0.5 until 7",
    "actuator_bias slider_3 0.125",
]


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    """Return sliders that start askew, off the origin, with faults."""
    given = {
        "plant.faults": FAULTS,
        "plant.initial_position": [1.0, 2.0, 3.0],
        "plant.initial_orientation": [0.5, -0.1, 0.7, 0.5],
        "plant.initial_joint_positions": [0.5, -0.25, 0.125],
    }
    return campaign(set=given).scenario


def changes(scenario: Scenario, flight: DrawnFlight, factors: MassFactors) -> dict[str, Any]:
    """Return what differs from the scenario, by node and parameter, and the mass properties."""
    found: dict[str, Any] = {}
    for node in ("plant", *scenario.commanders):
        before, after = (values_of(each.config(node)) for each in (scenario, flight.scenario))
        found |= {f"{node}.{key}": after[key] for key in after if after[key] != before[key]}
    for name, usual in (("mass", 1.0), ("inertia", 1.0), ("com", 0.0)):
        (values,) = getattr(factors, name)
        if np.any(values != usual):
            found[name] = values.tolist()
    return found


def applied(name: str, scenario: Scenario, value: Any) -> tuple[list[Any], dict[str, Any]]:
    flight = DrawnFlight.of(scenario)
    factors = MassFactors.of(1, len(flight.nominal.bodies))
    targets = targets_of(name, scenario)
    for target in targets:
        flight = target.apply(flight, value)
        if target.weigh is not None:
            target.weigh(factors, np.array([value]))
    return targets, changes(scenario, flight, factors)


def with_fault(index: int, *lines: str) -> dict[str, Any]:
    """Return the faults of the scenario with others in place of one."""
    return {"plant.faults": (*FAULTS[:index], *lines, *FAULTS[index + 1 :])}


SHAPE, RATES = "plant.initial_joint_positions", "plant.initial_joint_velocities"
BY_EFFORT = {RATES: (0.25, 0.0, 0.0), "plant.actuation": "effort"}

CASES: dict[str, tuple[float | str, str, dict[str, Any]]] = {
    "plant.tick_rate": (12.5, "Hz", {"plant.tick_rate": 12.5, "planner.tick_rate": 12.5}),
    "planner.position_tolerance": (0.07, "m", {"planner.position_tolerance": 0.07}),
    f"{SHAPE}[1]": (0.75, "m or rad", {SHAPE: (0.5, 0.75, 0.125)}),
    f"{SHAPE}[slider_3]": (0.75, "m or rad", {SHAPE: (0.5, -0.25, 0.75)}),
    f"{RATES}[0]": (0.25, "m/s or rad/s", BY_EFFORT),
    "plant.initial_position[2]": (5.5, "m", {"plant.initial_position": (1.0, 2.0, 5.5)}),
    "initial.position.y": (0.25, "m", {"plant.initial_position": (1.0, 2.25, 3.0)}),
    "initial.joints.slider_2": (0.5, "m or rad", {SHAPE: (0.5, 0.25, 0.125)}),
    "faults[0].at": (6.5, "s", with_fault(0, "joint_stuck slider_2 at 6.5 until 9")),
    "faults[0].until": (8.5, "s", with_fault(0, "joint_stuck slider_2 at 5 until 8.5")),
    "faults[1].at": (2.5, "s", with_fault(1, "joint_slow slider_1 0.5 at 2.5 until 7")),
    "faults[1].value": (0.75, "", with_fault(1, "joint_slow slider_1 0.75 until 7")),
    "faults[1].target": ("slider_3", "", with_fault(1, "joint_slow slider_3 0.5 until 7")),
    "faults[1].kind": ("joint_stuck", "", with_fault(1, "joint_stuck slider_1 until 7")),
    "faults[1].present": (0.0, "", with_fault(1)),
    "faults[2].kind": ("actuator_noise", "", with_fault(2, "actuator_noise slider_3 0.125")),
    "faults[2].until": (4.5, "s", with_fault(2, "actuator_bias slider_3 0.125 until 4.5")),
    "mass": (1.25, "1", {"mass": [1.25, 1.25, 1.25, 1.25]}),
    "mass.mass_2": (0.75, "1", {"mass": [1.0, 1.0, 0.75, 1.0]}),
    "inertia.mass_3": (1.5, "1", {"inertia": [1.0, 1.0, 1.0, 1.5]}),
    "com.mass_1.y": (0.25, "m", {"com": [[0.0] * 3, [0.0, 0.25, 0.0], [0.0] * 3, [0.0] * 3]}),
    "com.*": (0.5, "m", {"com": [[0.5, 0.5, 0.5]] * 4}),
}
"""A value for each name, the unit of the name, and all that it changes."""


@pytest.mark.parametrize("name", CASES)
def test_a_name_changes_what_it_says_and_nothing_else(name: str, scenario: Scenario) -> None:
    value, unit, expected = CASES[name]
    targets, found = applied(name, scenario, value)
    assert found == expected
    assert {target.unit for target in targets} == {unit}
    assert {target.is_text for target in targets} == {isinstance(value, str)}


def test_several_bodies_have_a_target_each_or_one_together(scenario: Scenario) -> None:
    bodies = ["base_link", "mass_1", "mass_2", "mass_3"]
    assert [t.name for t in targets_of("mass.*", scenario)] == [f"mass.{each}" for each in bodies]
    assert [t.name for t in targets_of("mass", scenario)] == ["mass"]
    assert [t.name for t in targets_of("com.mass_2.*", scenario)] == [
        "com.mass_2.x",
        "com.mass_2.y",
        "com.mass_2.z",
    ]
    assert [t.name for t in targets_of("com.*.z", scenario)] == [f"com.{b}.z" for b in bodies]


TUMBLER = """<robot name="tumbler">
  <link name="hull"><inertial><origin xyz="0.1 -0.05 0.2"/><mass value="20"/>
    <inertia ixx="1.5" iyy="2" izz="2.5" ixy="0.1" ixz="0" iyz="0"/></inertial></link>
  <link name="grapple"/><joint name="mount" type="fixed"><parent link="hull"/>
    <child link="grapple"/><origin xyz="0.4 0.3 -0.1"/></joint></robot>"""


def test_the_target_weighs_otherwise(scenario: Scenario) -> None:
    scenario = scenario.with_overrides("plant", {"target.robot_description": TUMBLER})
    flight = DrawnFlight.of(scenario)
    assert not flight.has_target_masses
    drawn = {"target.mass": 1.25, "target.inertia": 0.8, "target.com.y": 0.02}
    units = {}
    for name, value in drawn.items():
        (target,) = targets_of(name, scenario)
        flight, units[name] = target.apply(flight, value), target.unit
        assert target.assigned_parameters == {name}
        assert not target.is_text
    assert units == {"target.mass": "1", "target.inertia": "1", "target.com.y": "m"}
    assert flight.has_target_masses
    found = load_target(flight.scenario.plant.target)
    assert found is not None
    inertia = found.bodies[0].inertia
    assert inertia.mass == pytest.approx(25.0)
    np.testing.assert_allclose(inertia.com, [0.1, -0.03, 0.2])
    expected = np.array([[1.5, 0.1, 0.0], [0.1, 2.0, 0.0], [0.0, 0.0, 2.5]])
    np.testing.assert_allclose(inertia.about_com, expected, atol=1e-12)
    np.testing.assert_allclose(found.frames["grapple"][1].r, [0.4, 0.3, -0.1])
    (target,) = targets_of("target.com.z", scenario)
    moved = load_target(target.apply(DrawnFlight.of(scenario), -0.5).scenario.plant.target)
    assert moved is not None
    np.testing.assert_allclose(moved.bodies[0].inertia.com, [0.1, -0.05, -0.3])
    with pytest.raises(ParameterError) as caught:
        targets_of("target.masss", scenario)
    assert str(caught.value) == (
        "'target.masss' is not one of target.mass, target.inertia, target.com.x, target.com.y, "
        "target.com.z. Did you mean 'target.mass'?"
    )
    (target,) = targets_of("target.mass", scenario)
    with pytest.raises(RobotDescriptionError, match="hull"):
        target.apply(DrawnFlight.of(scenario), -1.0)


def test_a_target_is_needed_to_weigh_it(scenario: Scenario) -> None:
    with pytest.raises(ParameterError) as caught:
        targets_of("target.mass", scenario)
    assert str(caught.value) == (
        f"'target.mass': there is no target: the scenario '{scenario.name}' has no "
        "plant.target.robot."
    )


def test_whole_numbers_stay_whole(scenario: Scenario) -> None:
    _, found = applied("plant.sensors.seed", scenario, 6.7)
    assert found == {"plant.sensors.seed": 7}


@pytest.mark.parametrize("name", ["initial.rotvec.y", "goal.rotvec.y"])
def test_turns_are_about_the_axes_of_the_robot(name: str, scenario: Scenario) -> None:
    flight = targets_of(name, scenario)[0].apply(DrawnFlight.of(scenario), 0.25)
    if name.startswith("initial"):
        before: Any = scenario.plant.initial_orientation
        after: Any = flight.scenario.plant.initial_orientation
    else:
        before, after = scenario.goal.quaternion, flight.scenario.goal.quaternion
    turn = Rotation.from_quat(before).inv() * Rotation.from_quat(after)
    np.testing.assert_allclose(turn.as_rotvec(), [0.0, 0.25, 0.0], atol=1e-12)


def test_a_start_without_an_attitude_is_turned_from_that_of_the_world(scenario: Scenario) -> None:
    upright = scenario.with_overrides("plant", {"initial_orientation": []})
    flight = targets_of("initial.rotvec.y", upright)[0].apply(DrawnFlight.of(upright), 0.25)
    turned: Any = flight.scenario.plant.initial_orientation
    np.testing.assert_allclose(turned, [0.0, np.sin(0.125), 0.0, np.cos(0.125)], atol=1e-15)


def test_goals_are_shifted_in_the_world(scenario: Scenario) -> None:
    flight = targets_of("goal.position.z", scenario)[0].apply(DrawnFlight.of(scenario), -0.5)
    moved = np.subtract(flight.scenario.goal.position, scenario.goal.position)
    np.testing.assert_allclose(moved, [0.0, 0.0, -0.5], atol=1e-15)


def test_joints_start_as_near_to_zero_as_their_limits_allow() -> None:
    plain = campaign().scenario
    urdf = description_of(plain).urdf.replace('lower="-2.5"', 'lower="0.5"', 1)
    beyond = plain.with_overrides("plant", {"robot_description": urdf})
    for name, start in (
        ("initial.joints.slider_1", (0.75, 0.0, 0.0)),
        (f"{SHAPE}[1]", (0.5, 0.25, 0)),
    ):
        flight = targets_of(name, beyond)[0].apply(DrawnFlight.of(beyond), 0.25)
        assert flight.scenario.plant.initial_joint_positions == start


def test_the_parts_of_a_fault_are_drawn_in_any_order(scenario: Scenario) -> None:
    def line(**parts: Any) -> str:
        flight = DrawnFlight.of(scenario)
        for part, value in parts.items():
            flight = targets_of(f"faults[1].{part}", scenario)[0].apply(flight, value)
        return flight.scenario.plant.faults[1]

    given = {"kind": "actuator_bias", "target": "slider_3", "value": 0.25, "at": 1.5}
    for names in (list(given), list(reversed(given))):
        drawn = {name: given[name] for name in names}
        assert line(**drawn) == "actuator_bias slider_3 0.25 at 1.5 until 7"
        # A kind without a value takes none.
        assert line(**drawn | {"kind": "joint_stuck"}) == "joint_stuck slider_3 at 1.5 until 7"


def test_masses_go_into_the_description_of_the_plant_alone(scenario: Scenario) -> None:
    """Commanders that have no robot of their own believe in the one without dispersions."""
    flight = DrawnFlight.of(scenario)
    assert flight.inertial is None
    assert flight.scenario_with_draws is scenario
    values = {"mass.mass_2": 1.5, "inertia.mass_2": 2.0, "com.mass_2.x": 0.25}
    drawn = campaign(disperse={name: {"choice": [value]} for name, value in values.items()})
    flight = drawn_flight(drawn, Draws(drawn)[0])
    heavier, usual = flight.inertial, InertialParameters.of(flight.nominal)
    assert heavier is not None
    described = InertialParameters.of(description_of(flight.scenario_with_draws))
    for found in (heavier, described):
        np.testing.assert_allclose(found.masses, usual.masses * [1.0, 1.0, 1.5, 1.0])
        np.testing.assert_allclose(found.inertias[2], 3.0 * usual.inertias[2])
        np.testing.assert_allclose(found.inertias[1], usual.inertias[1])
        np.testing.assert_allclose(found.centers[2], usual.centers[2] + [0.25, 0.0, 0.0])
