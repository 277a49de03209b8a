"""The laws against Pinocchio's accelerations and against the paper's own formulas."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from control.flights import (
    END_EFFECTOR,
    INVERTIBLE,
    Array,
    load,
    scaled_robot,
)
from control.servicer_motion import (
    GAINS,
    KD,
    KP,
    POSES,
    OutputMotion,
    random_reference,
    rates,
    well_conditioned_state,
)
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from spacerobot_ros.control import (
    LAWS,
    Actuation,
    ControlState,
)


@pytest.mark.parametrize("seed", range(5))
def test_model_based_law_gives_the_error_dynamics(seed: int) -> None:
    """Eq. (28), spatial: ``eddot + Kd edot + Kp e = 0``."""
    rng = np.random.default_rng(seed)
    robot = load("servicer")
    state, reference = well_conditioned_state(rng), random_reference(rng)
    law = LAWS["model_based"](robot, POSES, GAINS)
    motion = OutputMotion(robot, state, law.command(state, reference))
    velocity, acceleration = rates(reference)
    e, edot = motion.error(reference), velocity - motion.velocity
    np.testing.assert_allclose(
        acceleration - motion.acceleration + KD * edot + KP * e, 0.0, atol=1e-9
    )
    np.testing.assert_allclose(law.error, e, atol=1e-12)
    np.testing.assert_allclose(law.error_rate, edot, atol=1e-12)
    assert not law.status.singular
    assert law.status.damping == 0.0


class PaperMatrices:
    """The paper's matrices of the servicer, in numpy, from H+, C+ and J+ alone."""

    def __init__(self, state: ControlState) -> None:
        robot = load("servicer")
        R = Rotation.from_quat(state.quaternion_WB).as_matrix()
        self._of_base = robot.jacobian(robot.base_link, state.q)
        self.J_q = np.vstack([self._of_base, np.eye(12)[6:]])
        twist = np.concatenate([state.v_WB_B, state.omega_WB_B, state.qdot])
        self.z0dot = np.linalg.solve(self.J_q, twist)
        self.H = robot.inertia_matrix(state.q)
        self.C = robot.bias(state.q, self.z0dot[:3], state.omega_WB_B, state.qdot)
        in_base = np.vstack([self._of_base, robot.jacobian(END_EFFECTOR, state.q)])
        self.J_z = block_diag(R, R, R, R) @ in_base


def paper_actuation(Q: Array, matrices: PaperMatrices) -> Array:
    """Invert eq. (21)."""
    return np.asarray(np.linalg.solve(matrices.J_q.T, Q))


@pytest.mark.parametrize("seed", range(5))
def test_laws_are_the_printed_ones(seed: int) -> None:
    """Eqs (24), (25), (27), (29) and (30), with ``J_z^-1``, for a square J_z."""
    rng = np.random.default_rng(100 + seed)
    robot = load("servicer")
    state, reference = well_conditioned_state(rng), random_reference(rng)
    at = PaperMatrices(state)
    step = 1e-6

    def moved(time: float) -> PaperMatrices:
        turn = Rotation.from_quat(state.quaternion_WB) * Rotation.from_rotvec(
            time * state.omega_WB_B
        )
        return PaperMatrices(
            replace(state, quaternion_WB=turn.as_quat(), q=state.q + time * state.qdot)
        )

    J_z_dot = (moved(step).J_z - moved(-step).J_z) / (2 * step)
    motion = OutputMotion(robot, state, Actuation(np.zeros(6), np.zeros(6)))
    velocity, acceleration = rates(reference)
    e, edot = motion.error(reference), velocity - motion.velocity

    J_inverse = np.linalg.inv(at.J_z)
    H_tilde = J_inverse.T @ at.H @ J_inverse
    C_tilde = J_inverse.T @ at.C - H_tilde @ J_z_dot @ at.z0dot
    Q_27 = at.J_z.T @ (H_tilde @ (KP * e + KD * edot + acceleration) + C_tilde)
    Q_29 = at.J_z.T @ (KP * e + KD * edot)
    for name, Q, tolerance in (("model_based", Q_27, 1e-7), ("transposed_jacobian", Q_29, 1e-12)):
        command = LAWS[name](robot, POSES, GAINS).command(state, reference)
        expected = paper_actuation(Q, at)
        found = np.concatenate([command.wrench_B, command.tau])
        np.testing.assert_allclose(
            found, expected, atol=tolerance * float(np.linalg.norm(expected))
        )


def test_masses_cancel_from_the_transposed_jacobian() -> None:
    rng = np.random.default_rng(9)
    state, reference = well_conditioned_state(rng), random_reference(rng)
    true = load("servicer")
    wrong = scaled_robot(true, lambda: float(rng.uniform(0.5, 2.0)))
    commands = [
        LAWS["transposed_jacobian"](robot, POSES, GAINS).command(state, reference)
        for robot in (true, wrong)
    ]
    np.testing.assert_allclose(commands[0].wrench_B, commands[1].wrench_B, atol=1e-10)
    np.testing.assert_allclose(commands[0].tau, commands[1].tau, atol=1e-10)


def test_status_has_the_smallest_singular_value() -> None:
    rng = np.random.default_rng(12)
    state, reference = well_conditioned_state(rng), random_reference(rng)
    expected = np.linalg.svd(PaperMatrices(state).J_z, compute_uv=False)[-1]
    for name in INVERTIBLE:
        law = LAWS[name](load("servicer"), POSES, GAINS)
        law.command(state, reference)
        assert law.status.smallest_singular_value == pytest.approx(expected, rel=1e-9)


def test_eq_12_has_the_third_angle_in_its_second_column() -> None:
    """``omega = S d(Theta)/dt`` of the 321 sequence; the paper prints the first angle there."""
    first, second, third = angles = np.array([0.4, -0.3, 1.1])

    def rotation(angles: Array) -> Array:
        return np.asarray(Rotation.from_euler("ZYX", angles[::-1]).as_matrix())

    step, columns = 1e-6, []
    for axis in np.eye(3):
        rate = (rotation(angles + step * axis) - rotation(angles - step * axis)) / (2 * step)
        spin = rate @ rotation(angles).T
        columns.append([spin[2, 1], spin[0, 2], spin[1, 0]])
    S = np.array(columns).T
    np.testing.assert_allclose(S[:, 1], [-np.sin(third), np.cos(third), 0.0], atol=1e-9)
    roll = [np.cos(second) * np.cos(third), np.cos(second) * np.sin(third), -np.sin(second)]
    np.testing.assert_allclose(S[:, 0], roll, atol=1e-9)
    assert np.abs(S[:, 1] - [-np.sin(first), np.cos(first), 0.0]).max() > 0.4
