"""Errors at rest under a constant wrench, and the integral term that removes them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from control.flights import (
    END_EFFECTOR,
    INVERTIBLE,
    PLANAR_GAINS,
    law_of,
    load,
    planar_start,
    pose,
)
from control.servicer_motion import GAINS, KP, well_conditioned_state
from scipy.spatial.transform import Rotation
from support.oracles import PinocchioOracle, assert_agrees

from spacerobot_ros.control import ControlLaw, ControlState, GainPair, Gains, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.steady_state import steady_errors
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.api import fly
from spacerobot_ros.simulation import EffortPlant, InitialState
from spacerobot_ros.simulation.loads import PlantLoads

Array = npt.NDArray[np.float64]

PUSH = np.array([0.6, -0.8, 0.3, 0.2, -0.1, 0.4])


def at_rest(state: ControlState) -> ControlState:
    return ControlState.at_rest(state.r_WB, state.quaternion_WB, state.q)


@pytest.mark.parametrize("name", INVERTIBLE)
def test_the_papers_laws_give_way_by_their_formulas(name: str) -> None:
    """With Jacobians and masses of Pinocchio: eq. (29) by Kp alone, eq. (27) by mobility."""
    robot, state = load("servicer"), well_conditioned_state(np.random.default_rng(3))
    oracle = PinocchioOracle(robot.description.urdf, robot.joint_names)
    oracle.set_configuration(state.q, state.quaternion_WB, state.r_WB)
    J_z = np.vstack([oracle.frame_jacobian_W(link) for link in (robot.base_link, END_EFFECTOR)])
    Q_d = oracle.frame_jacobian_W("forearm_link").T @ PUSH
    expected = -np.linalg.solve(J_z.T, Q_d) / KP
    if name == "model_based":
        expected = -J_z @ np.linalg.solve(oracle.own_mass_matrix(), Q_d) / KP
    assert np.abs(expected).min() > 1e-4
    found = steady_errors(law_of(name, robot, GAINS), state, "forearm_link", PUSH)
    assert_agrees(found, expected, 1e-9)


@pytest.mark.parametrize(
    ("name", "link", "force", "expected"),
    [
        ("transposed_jacobian", "base_link", [1, 0], [-33.333, 0, 0, 0, 0]),
        ("transposed_jacobian", "end_effector", [0, 1], [0, 0, 0, 0, -33.333]),
        ("model_based", "base_link", [1, 0], [-0.773, -0.029, -0.145, 0.054, -0.293]),
    ],
)
def test_one_newton_on_the_papers_robot(
    name: str, link: str, force: list[float], expected: list[float]
) -> None:
    """33.3 mm with eq. (29), 0.8 mm with eq. (27), at the start of the paper's example."""
    law = law_of(name, load("planar_manipulator"), PLANAR_GAINS)
    found = steady_errors(law, planar_start(), link, [*force, 0, 0, 0, 0])
    np.testing.assert_allclose(1e3 * found, expected, atol=6e-4)


def displaced(law: ControlLaw, state: ControlState, errors: Array) -> Reference:
    """Return the planar reference from which a state has these errors."""
    present = Reference.present(law.robot, state, END_EFFECTOR)
    assert present.base is not None
    assert present.end_effector is not None
    turn = Rotation.from_rotvec([0.0, 0.0, errors[2]]) * Rotation.from_quat(state.quaternion_WB)
    base = present.base.position + np.append(errors[:2], 0.0)
    return Reference(
        replace(pose(base), quaternion=turn.as_quat()),
        pose(present.end_effector.position + np.append(errors[3:], 0.0)),
    )


@pytest.mark.parametrize("name", INVERTIBLE)
@pytest.mark.parametrize("ki", [0.0, 2.0])
def test_the_robot_rests_where_it_is_said_to(name: str, ki: float) -> None:
    """The plant stays at rest under the command for these errors, or for their integral."""
    robot, state = load("planar_manipulator"), planar_start()
    wrench = np.array([0.7, -0.4, 0.0, 0.0, 0.0, 0.3])
    law = law_of(name, robot, PLANAR_GAINS)
    errors = steady_errors(law, state, "link_1", wrench)
    assert np.abs(errors).max() > 1e-4
    if ki:
        law.set_gains(Gains.uniform(30.0, 60.0, ki))
        law.command(state, displaced(law, state, errors))
        law.integrate_error(30.0 / ki)
        np.testing.assert_allclose(steady_errors(law, state, "link_1", wrench), 0.0)
        errors = np.zeros(5)
    assert_rests(law, errors, wrench)


@pytest.mark.parametrize("given", [{}, {"base_position": GainPair(30.0, 60.0)}])
def test_the_robot_rests_where_it_is_said_to_with_automatic_gains(given: dict[str, Any]) -> None:
    robot, wrench = load("planar_manipulator"), np.array([0.7, -0.4, 0.0, 0.0, 0.0, 0.3])
    law = law_of("transposed_jacobian", robot, Gains(**given))
    errors = steady_errors(law, planar_start(), "link_1", wrench)
    assert np.abs(errors).max() > 1e-4
    assert_rests(law, errors, wrench)


def assert_rests(law: ControlLaw, errors: Array, wrench: Array) -> None:
    """The plant stays at rest under the command for errors, and a wrench on a link."""
    robot, state = law.robot, planar_start()
    actuation = law.command(state, displaced(law, state, errors))
    start = InitialState(state.r_WB, state.quaternion_WB, state.q)
    plant, loads = EffortPlant(robot, 0.01, start), PlantLoads(robot)
    loads.in_world[robot.link_names.index("link_1")] = wrench
    plant.load(loads)
    plant.step(actuation.tau, actuation.wrench_B)
    np.testing.assert_allclose(plant.twist, 0.0, atol=1e-13)
    np.testing.assert_allclose(plant.qdot, 0.0, atol=1e-13)


@pytest.mark.parametrize(
    ("name", "wrench"),
    [("transposed_jacobian", [0, 0, 1, 0, 0, 0]), ("computed_torque", [1, 0, 0, 0, 0, 0])],
)
def test_wrenches_that_nothing_holds_are_refused(name: str, wrench: list[float]) -> None:
    law = law_of(name, load("planar_manipulator"), PLANAR_GAINS)
    with pytest.raises(ParameterError) as refused:
        steady_errors(law, planar_start(), "link_2", wrench)
    assert str(refused.value) == (
        f"The wrench on link 'link_2' moves what the outputs of the law '{name}' do not hold: "
        f"there is no steady state. The outputs are {', '.join(law.outputs.labels)}."
    )


# -- the integral term ------------------------------------------------------------------------

MIXED = Gains(GainPair(30.0, 60.0, 2.0), GainPair(30.0, 60.0), GainPair(30.0, 60.0, 0.5))


def law_with_error(errors: Array, gains: Gains = MIXED) -> ControlLaw:
    law = law_of("transposed_jacobian", load("planar_manipulator"), gains)
    law.command(planar_start(), displaced(law, planar_start(), errors))
    return law


ERRORS = np.array([0.1, -0.2, 0.3, 0.4, -0.5])


def integral_of(law: ControlLaw) -> Array:
    """Return the integral term by its effect: commands differ by it times the law's stiffness."""
    base = displaced(law, planar_start(), np.zeros(5))
    with_it = law.command(planar_start(), base)
    stiffness = law.command_per_error(planar_start())
    command = np.append(with_it.wrench_B, with_it.tau)
    return np.asarray(np.linalg.lstsq(stiffness, command, rcond=None)[0])


def test_errors_with_a_gain_are_integrated() -> None:
    law = law_with_error(ERRORS)
    assert law.integrates
    np.testing.assert_array_equal(law.integral_gains, [2.0, 2.0, 0.0, 0.5, 0.5])
    law.integrate_error(0.25)
    law.integrate_error(0.5)
    expected = 0.75 * ERRORS * [2.0, 2.0, 0.0, 0.5, 0.5]
    np.testing.assert_allclose(integral_of(law), expected, atol=1e-12)


def test_gains_of_the_integral_change_in_flight() -> None:
    law = law_with_error(ERRORS)
    law.integrate_error(1.0)
    law.set_gains(Gains(GainPair(30.0, 60.0, 4.0), GainPair(30.0, 60.0, 1.0), GainPair(30.0, 60.0)))
    expected = ERRORS * [4.0, 4.0, 0.0, 0.0, 0.0]
    np.testing.assert_allclose(integral_of(law), expected, atol=1e-12)
    law.set_gains(MIXED)
    np.testing.assert_allclose(integral_of(law)[3:], 0.0, atol=1e-12)
    law.reset_integral()
    np.testing.assert_allclose(integral_of(law), 0.0, atol=1e-12)


def test_without_integral_gains_nothing_is_integrated() -> None:
    law = law_with_error(ERRORS, PLANAR_GAINS)
    law.integrate_error(1.0)
    assert not law.integrates
    np.testing.assert_allclose(integral_of(law), 0.0, atol=1e-12)


def test_a_limited_command_lets_integrals_shrink_only() -> None:
    law = law_with_error(ERRORS)
    law.integrate_error(1.0, limited=True)
    np.testing.assert_allclose(integral_of(law), 0.0, atol=1e-12)
    law = law_with_error(ERRORS)
    law.integrate_error(1.0)
    law.command(planar_start(), displaced(law, planar_start(), ERRORS * [-1, 1, 1, -1, 1]))
    law.integrate_error(0.5, limited=True)
    expected = ERRORS * [1.0, 2.0, 0.0, 0.25, 0.5]
    np.testing.assert_allclose(integral_of(law), expected, atol=1e-12)


def test_a_law_without_an_integral_term_says_so() -> None:
    class Proportional(ControlLaw):
        name = "proportional"
        gain_units = ("N/m", "N s/m")

        def _results(self, symbols: dict[str, object]) -> dict[str, object]:
            z1 = self.outputs
            return {"actuation": (z1.J_z @ z1.J_q_inverse).T @ (symbols["kp"] * z1.error)}

    robot = load("planar_manipulator")
    outputs = Proportional.default_outputs(robot, END_EFFECTOR)
    law = Proportional(robot, outputs, PLANAR_GAINS)
    with pytest.raises(ParameterError) as refused:
        law.set_gains(Gains.uniform(1.0, 1.0, 0.1))
    assert str(refused.value) == (
        "The law 'proportional' has no integral term: its gains ki must be 0."
    )


@pytest.mark.parametrize("ki", [-0.1, np.inf, np.nan])
def test_integral_gains_are_not_negative(ki: float) -> None:
    with pytest.raises(ParameterError) as refused:
        Gains(joints=GainPair(1.0, 2.0, ki))
    assert str(refused.value) == f"The gain joints.ki is {ki}; it must be finite and not negative."


def test_a_new_goal_and_a_reset_begin_the_integral_anew() -> None:
    gains = Gains.uniform(30.0, 60.0, 1.0)
    config = ControllerConfig(profile="step", gains=gains, tick_rate=100.0, max_force=1e3)
    controller, state = build_controller(load("planar_manipulator"), config), planar_start()
    far = replace(pose(state.r_WB + np.array([0.02, 0.0, 0.0])), quaternion=state.quaternion_WB)

    def term() -> float:
        return float(np.abs(controller.law._in["integral"]).max())

    controller.set_goals(0.0, state, base=far)
    for tick in (0, 1, 2, 5):
        controller.command(tick / 100, state, state.q, state.qdot)
    # The last command follows a gap of three control periods, and is expected to be held so.
    assert term() == pytest.approx(0.02 * (0.01 * 3 + 0.03))
    controller.set_goals(0.05, state, base=far)
    assert term() == 0.0
    controller.command(0.06, state, state.q, state.qdot)
    assert term() == pytest.approx(0.0002)
    controller.come_to_rest()
    controller.command(0.07, state, state.q, state.qdot)
    assert term() == pytest.approx(0.0002)
    controller.reset()
    assert term() == 0.0


def test_saturated_thrusters_do_not_wind_the_integral_up() -> None:
    gains = Gains.uniform(30.0, 60.0, 1.0)
    config = ControllerConfig(profile="step", gains=gains, tick_rate=100.0, max_force=0.1)
    controller, state = build_controller(load("planar_manipulator"), config), planar_start()
    far = replace(pose(state.r_WB + np.array([0.5, 0.0, 0.0])), quaternion=state.quaternion_WB)
    controller.set_goals(0.0, state, base=far)
    assert controller.command(0.0, state, state.q, state.qdot).limited
    assert not controller.law._in["integral"].any()


@pytest.mark.slow
@pytest.mark.parametrize("law", INVERTIBLE)
@pytest.mark.parametrize("ki", [0.0, 10.0])
def test_the_papers_robot_flies_into_its_steady_state(law: str, ki: float) -> None:
    """A goal that counts as reached by no error: the errors after a minute."""
    groups = ("base_position", "base_attitude", "end_effector_position")
    flight = fly(
        "coordinated_control",
        method=law,
        parameters={
            "plant.disturbances": ["base_link force 1 0 0 at 1"],
            "coordinated_control.position_tolerance": 1e-14,
            "coordinated_control.time_limit": 90.0,
            **{f"coordinated_control.gains.{group}.ki": ki for group in groups},
        },
    )
    pose_WB, q = (flight.series[name].values[-1] for name in ("pose", "q"))
    last = ControlState.at_rest(pose_WB[:3], pose_WB[3:], q)
    goal = Reference(pose([0.5, 0.5, 0.0], [0.0, 0.0, np.radians(15.0)]), pose([1.5, 1.5, 0.0]))
    controller = law_of(law, load("planar_manipulator"), Gains.uniform(30.0, 60.0, ki))
    controller.command(last, goal)
    predicted = steady_errors(controller, last, "base_link", [1, 0, 0, 0, 0, 0])
    np.testing.assert_allclose(controller.error, predicted, atol=1e-6)
    if not ki:
        expected = 0.0333333 if law == "transposed_jacobian" else 0.000773
        assert np.linalg.norm(controller.error[:2]) == pytest.approx(expected, rel=0.05)
