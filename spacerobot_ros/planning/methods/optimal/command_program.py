"""The least change of held commands that moves an end within the limits: a quadratic program.

Its unknowns are the changes of all shapes at the ticks. The end is linear in them to first order, a
few programs one after the other reach it (sequential quadratic programming).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from spacerobot_ros.model.description import Array
from spacerobot_ros.planning.methods.optimal.problem import MotionLimits

_LIMIT_RESERVE = 1e-4
"""Share of velocity and acceleration limits that is left for the last, small correction."""

_OPTIONS = {
    "error_on_fail": False,
    "print_time": False,
    "osqp": {
        "verbose": False,
        "eps_abs": 1e-7,
        "eps_rel": 1e-7,
        "eps_prim_inf": 1e-6,
        "max_iter": 4000,
        # By default the solver adapts to its own computing time: results would depend on it.
        "adaptive_rho_interval": 25,
    },
}


def least_change(
    positions: Array,
    rows: Array,
    error: Array,
    limits: MotionLimits,
    period: float,
    before: Array | float,
    *,
    moves_end: bool,
) -> Array | None:
    """Return the least change (N + 1, n) of shapes at ticks with which they keep all limits.

    Parameters
    ----------
    positions
        (N + 1, n) shapes at the ticks, m or rad; the first one stays.
    rows, error
        (m, N + 1, n) derivatives of m numbers at the end by the shapes, and their change (m,).
    limits
        Limits of the joints.
    period
        Between ticks, s.
    before
        (n,) velocities that are held until the start; after the end, the joints rest.
    moves_end
        Whether the last shape may change.

    Returns
    -------
    :
        The change, least in the sum of squares of each joint's over its speed; None: there is none,
        or no solver of quadratic programs.
    """
    if not ca.has_conic("osqp"):
        return None
    N, n = len(positions) - 1, positions.shape[1]
    moving = slice(1, N + 1 if moves_end else N)
    count = N - 1 + moves_end
    if count < 1:
        return None
    _, half = limits.span(positions[0])
    # Unknowns are shares of a tick at full speed.
    scale = np.where(np.isfinite(limits.velocity), limits.velocity, half) * period
    scaled = (rows[:, moving] * scale).reshape(len(rows), -1)
    weight = 1.0 / np.maximum(np.linalg.norm(scaled, axis=1), 1e-12)

    steps = ca.DM.eye(N + 1)[:, moving]
    first = steps[1:, :] - steps[:-1, :]
    second = ca.vertcat(first, ca.DM(1, count)) - ca.vertcat(ca.DM(1, count), first)
    speed_share = scale / (limits.velocity * period)
    change_share = scale / (limits.acceleration * period**2)
    A = ca.vertcat(
        weight[:, np.newaxis] * scaled,
        ca.kron(first, ca.diag(speed_share)),
        ca.kron(second, ca.diag(change_share)),
    )
    rates = np.diff(positions, axis=0) / period
    ends = np.zeros((2, n))
    ends[0] = before
    changes = np.diff(np.vstack([ends[:1], rates, ends[1:]]), axis=0) / period
    shares = np.concatenate(
        [(rates / limits.velocity).ravel(), (changes / limits.acceleration).ravel()]
    )
    most = 1.0 - _LIMIT_RESERVE
    wanted = weight * error
    program = ca.conic(
        "commands", "osqp", {"h": ca.Sparsity.diag(count * n), "a": A.sparsity()}, _OPTIONS
    )
    found = program(
        h=ca.DM.eye(count * n),
        a=A,
        lba=np.concatenate([wanted, -most - shares]),
        uba=np.concatenate([wanted, most - shares]),
        lbx=((limits.lower - positions[moving]) / scale).ravel(),
        ubx=((limits.upper - positions[moving]) / scale).ravel(),
    )
    if not program.stats()["success"]:
        return None
    change = np.zeros_like(positions)
    change[moving] = found["x"].full().reshape(count, n) * scale
    return change
