"""Gains that nobody sets: they follow the masses, the shape and the control period."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest
from control.flights import Array, law_of, load, planar_start, pose
from support.executive_loop import AIM, KP, ExecutiveLoop, goal_at
from support.sentences import assert_one_sentence

from spacerobot_ros.control import LAWS, ControlState, GainPair, Gains, Reference
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.laws.law import ControlLaw
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.parameters import configured
from spacerobot_ros.simulation import EffortPlant, InitialState

FASTEST = 1.0
"""Natural frequency of errors under automatic gains, if the control period permits, rad/s."""


def accelerations(law: ControlLaw, state: ControlState, reference: Reference) -> Array:
    """Return the accelerations of the outputs under a command from rest, by the plant."""
    actuation, step = law.command(state, reference), 1e-4
    plant = EffortPlant(law.robot, step, InitialState(state.r_WB, state.quaternion_WB, state.q))
    plant.step(actuation.tau, actuation.wrench_B)
    moved = ControlState(
        plant.pose[:3], plant.pose[3:], plant.twist[:3], plant.twist[3:], plant.q, plant.qdot
    )
    law.command(moved, reference)
    return np.asarray(-law.error_rate / step)


@pytest.mark.parametrize("name", [*LAWS])
def test_from_rest_errors_are_accelerated_towards_zero_by_their_stiffness(name: str) -> None:
    robot, state = load("planar_manipulator"), planar_start()
    law = law_of(name, robot, Gains())
    present = Reference.present(robot, state, "end_effector")
    assert present.base is not None
    assert present.end_effector is not None
    assert present.joints is not None
    reference = Reference(
        replace(present.base, position=present.base.position + np.array([0.03, -0.02, 0.0])),
        replace(
            present.end_effector,
            position=present.end_effector.position + np.array([0.0, 0.05, 0.0]),
        ),
        replace(present.joints, q=present.joints.q + np.array([0.04, -0.03])),
    )
    found = accelerations(law, state, reference)
    law.command(state, reference)
    wanted = FASTEST**2 * law.error
    # The mass matrix of a law that commands forces is damped a little.
    np.testing.assert_allclose(found, wanted, atol=0.1 * np.abs(wanted).max())


@pytest.mark.parametrize("name", [*LAWS])
@pytest.mark.parametrize(("rate", "damping"), [(1.0, 0.4), (5.0, 2.0), (200.0, 2.0)])
def test_slow_controllers_have_low_gains(name: str, rate: float, damping: float) -> None:
    config = configured(ControllerConfig, {"law": name, "tick_rate": rate})
    law = build_controller(load("planar_manipulator"), config).law
    kp, kd = law.gain_diagonals
    np.testing.assert_allclose(kd, damping)
    np.testing.assert_allclose(kp, damping**2 / 4, err_msg="critical damping")


def test_at_a_singularity_commands_stay_bounded() -> None:
    robot = load("planar_manipulator")
    law = law_of("transposed_jacobian", robot, Gains())
    state = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(2))
    present = Reference.present(robot, state, "end_effector")
    assert present.end_effector is not None
    out = replace(
        present.end_effector, position=present.end_effector.position + np.array([1.0, 0.0, 0.0])
    )
    command = law.command(state, Reference(present.base, out))
    assert law.status.singular
    # No actuator moves it there. A force that gives the whole robot this acceleration is 47 N.
    assert np.linalg.norm(command.wrench_B) + np.linalg.norm(command.tau) < 47.0


def automatic_gains(*groups: str) -> dict[str, Any]:
    return {f"gains.{group}.{name}": 0.0 for group in groups for name in ("kp", "kd")}


def test_gains_become_automatic_in_flight_and_back() -> None:
    loop = ExecutiveLoop()
    loop.aim(base=goal_at(AIM))
    given = np.concatenate(loop.answer())
    loop.configure(gains=Gains())
    automatic = np.concatenate(loop.answer())
    assert np.linalg.norm(automatic - given) > 1.0
    fresh = ExecutiveLoop(**automatic_gains(*vars(Gains())))
    fresh.aim(base=goal_at(AIM))
    np.testing.assert_allclose(automatic, np.concatenate(fresh.answer()), rtol=1e-9)
    loop.configure(gains=Gains.uniform(KP, 2 * KP))
    np.testing.assert_allclose(np.concatenate(loop.answer()), given, rtol=1e-9, atol=1e-9)


def test_a_group_with_gains_keeps_them() -> None:
    """At rest the force on the base is the sum of those on both poses."""
    others = [group for group in vars(Gains()) if group != "base_position"]
    loop = ExecutiveLoop(**automatic_gains(*others))
    loop.aim(base=goal_at(AIM))
    np.testing.assert_allclose(loop.answer()[0][:3], KP * AIM, rtol=1e-9, atol=1e-9)


class _Spring(ControlLaw):
    """A law that pulls the base, as somebody else may write it."""

    name = "spring"
    gain_units = ("N/m", "N s/m")

    def _results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        z1 = self.outputs
        pull = symbols["kp"] * z1.error + symbols["kd"] * z1.error_rate
        return {"actuation": (z1.J_z @ z1.J_q_inverse).T @ pull}


def test_a_law_without_automatic_gains_says_which_it_needs() -> None:
    robot = load("planar_manipulator")
    outputs = _Spring.default_outputs(robot, "end_effector")
    with pytest.raises(ParameterError) as refused:
        _Spring(robot, outputs, replace(Gains.uniform(1.0, 2.0), base_attitude=GainPair(1.0)))
    assert_one_sentence(str(refused.value), "The law 'spring' has no automatic gains")
    _Spring(robot, outputs, Gains.uniform(1.0, 2.0))


def test_a_robot_without_joints_is_controlled() -> None:
    urdf = """<robot name="cube"><link name="hull"><inertial><mass value="16"/>
      <inertia ixx="0.18" iyy="0.18" izz="0.18" ixy="0" ixz="0" iyz="0"/></inertial></link>
      </robot>"""
    robot = type(load("planar_manipulator")).from_urdf(urdf)
    controller = build_controller(robot, ControllerConfig(profile="step"))
    state = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(0))
    controller.set_goals(0.0, state, base=pose([0.5, 0.0, -0.25], [0.0, 0.1, 0.0]))
    unseen = controller.command(0.0, None, state.q, state.qdot).realised
    np.testing.assert_array_equal(unseen.wrench_B, np.zeros(6))
    result = controller.command(0.0, state, state.q, state.qdot).realised
    wanted = [*(16 * np.array([0.5, 0.0, -0.25])), 0.0, 0.18 * 0.1, 0.0]
    np.testing.assert_allclose(result.wrench_B, np.array(wanted) / 1.02, rtol=1e-6, atol=1e-12)
