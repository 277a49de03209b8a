"""Base motion from shape motion: the reconstruction equation, one held command at a time.

Joint velocities are constant over the step (servos hold them), so the shape is exact. The
position follows from the centre of mass, exactly. What is integrated is the attitude alone:
``R_WB_dot = R_WB hat(omega)``, ``omega = D^-1 (R_WB' L_W - D_q qdot)`` (paper 1, eq. 3, with an
angular momentum that need not be zero), as a quaternion in R^4 by Runge-Kutta 4, normalised.
"""

from __future__ import annotations

import casadi as ca

from spacerobot_ros.model.momentum import rotation_from_quaternion

DEFAULT_INTEGRATION_STEP = 0.01
"""Longest Runge-Kutta step of the attitude, s."""


def quaternion_rate(quaternion: ca.SX, omega_WB_B: ca.SX) -> ca.SX:
    """Return the rate (4,) of the quaternion (x, y, z, w) of ``R_WB`` at body rate ``omega``."""
    vector, scalar = quaternion[:3], quaternion[3]
    return 0.5 * ca.vertcat(
        scalar * omega_WB_B + ca.cross(vector, omega_WB_B), -ca.dot(vector, omega_WB_B)
    )


def attitude_step(locked_inertia: ca.Function) -> ca.Function:
    """Return one Runge-Kutta step ``(x, qdot, L_W, h) -> x`` of ``x = [q; quaternion]``.

    ``locked_inertia`` is the function ``q -> (D, D_q)``.
    """
    n = locked_inertia.size1_in(0)
    x = ca.SX.sym("x", n + 4)
    qdot, L_W, h = ca.SX.sym("qdot", n), ca.SX.sym("L_W", 3), ca.SX.sym("h")
    q, quaternion = x[:n], x[n:]
    # Start, middle and end of the step: the middle serves two of the four stages.
    shapes = [locked_inertia(q + fraction * h * qdot) for fraction in (0.0, 0.5, 1.0)]

    def rate(at: ca.SX, shape: tuple[ca.SX, ca.SX]) -> ca.SX:
        D, D_q = shape
        L_B = rotation_from_quaternion(at).T @ L_W
        omega = ca.solve(ca.chol(D), ca.solve(ca.chol(D).T, L_B - D_q @ qdot))
        return quaternion_rate(at, omega)

    k1 = rate(quaternion, shapes[0])
    k2 = rate(quaternion + h / 2 * k1, shapes[1])
    k3 = rate(quaternion + h / 2 * k2, shapes[1])
    k4 = rate(quaternion + h * k3, shapes[2])
    turned = quaternion + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x_next = ca.vertcat(q + h * qdot, turned / ca.norm_2(turned))
    return ca.Function("attitude_step", [x, qdot, L_W, h], [ca.cse(x_next)])
