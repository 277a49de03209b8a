"""Fewer outputs than degrees of freedom: what the other motion does."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from control.flights import (
    END_EFFECTOR,
    SERVICER_GAINS,
    SERVICER_SHAPE,
    fly,
    load,
    plant_of,
    pose,
)
from control.servicer_motion import (
    GAINS,
    KD,
    KP,
    OutputMotion,
    random_reference,
    rates,
    well_conditioned_state,
)

from spacerobot_ros.control import (
    ControlState,
    Gains,
    JointReference,
    OutputSelection,
    Reference,
)
from spacerobot_ros.control.laws.model_based import ModelBasedLaw
from spacerobot_ros.control.laws.transposed_jacobian import TransposedJacobianLaw
from spacerobot_ros.control.outputs import AXES


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_fewer_outputs_keep_their_error_dynamics(seed: int) -> None:
    """Operational space: what is left free does not show in the outputs, however it is used."""
    rng = np.random.default_rng(200 + seed)
    robot = load("servicer")
    state, reference = well_conditioned_state(rng), random_reference(rng)
    reference = replace(reference, joints=JointReference.at_rest(rng.uniform(-1, 1, 6)))
    selection = OutputSelection(("x", "y", "z"), ("x", "y", "z", "rx"), (), END_EFFECTOR)
    rows = [0, 1, 2, 6, 7, 8, 9]
    commands = []
    for options in ({"null_space_damping": 0.0}, {"null_space_damping": 3.0}, {}):
        extra = {"posture_stiffness": 2.0} if not options else {}
        chosen = ModelBasedLaw.Options(**options, **extra)
        law = ModelBasedLaw(robot, selection, GAINS, chosen)
        command = law.command(state, reference)
        commands.append(command)
        motion = OutputMotion(robot, state, command)
        velocity, acceleration = rates(reference)
        e, edot = motion.error(reference), velocity - motion.velocity
        residual = acceleration - motion.acceleration + KD * edot + KP * e
        np.testing.assert_allclose(residual[rows], 0.0, atol=1e-9)
    for one, other in itertools.combinations(commands, 2):
        assert np.abs(one.tau - other.tau).max() > 1e-3


def test_null_space_damping_and_posture() -> None:
    """Three outputs of twelve: the rest comes to rest, or moves towards the posture."""
    robot = load("servicer")
    rng = np.random.default_rng(5)
    start = ControlState(
        np.zeros(3),
        np.array([0.0, 0.0, 0.0, 1.0]),
        rng.uniform(-0.05, 0.05, 3),
        rng.uniform(-0.05, 0.05, 3),
        SERVICER_SHAPE,
        rng.uniform(-0.1, 0.1, 6),
    )
    posture = SERVICER_SHAPE + np.array([0.2, 0.2, -0.3, 0.1, 0.2, 0.4])
    goal = Reference(end_effector=pose([1.8, 0.2, 0.4]), joints=JointReference.at_rest(posture))
    selection = OutputSelection(end_effector=("x", "y", "z"), end_effector_link=END_EFFECTOR)
    away = {}
    for stiffness in (0.0, 1.0):
        law = ModelBasedLaw(
            robot,
            selection,
            Gains.uniform(1.0, 2.0),
            ModelBasedLaw.Options(null_space_damping=2.0, posture_stiffness=stiffness),
        )
        flight = fly(plant_of(robot, start), law, lambda _: goal, 12.0, rate=25.0, every=10)
        last = flight.states[-1]
        assert np.abs(flight.errors[-1]).max() < 1e-3
        speed = np.abs(np.concatenate([last.v_WB_B, last.omega_WB_B, last.qdot])).max()
        assert speed < (5e-3 if stiffness else 1e-4)
        away[stiffness] = last.q - posture
    # The pull is weighed by inertia: the heavy inner joints follow it first.
    assert np.abs(away[1.0][:3]).max() < 0.1
    assert np.abs(away[0.0][:3]).max() > 0.2
    assert np.linalg.norm(away[1.0]) < 0.7 * np.linalg.norm(away[0.0])


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_joint_damping_of_the_transposed_jacobian(damping: float) -> None:
    """Nine outputs of twelve: the wrist swings on unless it is damped."""
    robot = load("servicer")
    still = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), SERVICER_SHAPE)
    start = replace(still, qdot=np.array([0.0, 0.0, 0.0, 0.4, -0.3, 0.5]))
    law = TransposedJacobianLaw(
        robot,
        OutputSelection(AXES, ("x", "y", "z"), (), END_EFFECTOR),
        SERVICER_GAINS["transposed_jacobian"],
        TransposedJacobianLaw.Options(joint_damping=damping),
    )
    goal = Reference.present(robot, still, END_EFFECTOR)
    flight = fly(plant_of(robot, start), law, lambda _: goal, 12.0, rate=50.0, every=10)
    moving = np.abs(flight.states[-1].qdot).max()
    assert moving < 0.01 if damping else moving > 0.1
