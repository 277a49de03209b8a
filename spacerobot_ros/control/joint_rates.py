"""Joint efforts that keep joints within their rates, and what brings a whole robot to rest.

A law commands forces: what speeds follow, it does not ask. While an aim is far away, a measurement
is late or a thruster pushes by itself, joints would be flung around faster than their motors stand,
and faster than commands that are held for a control period can follow.
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from spacerobot_ros.control.state import Actuation, ControlState
from spacerobot_ros.model.compilation import BufferedFunction, dense_function
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.model.space_robot import SpaceRobot

_PERIODS = 2
"""Control periods within which a joint may come up to its largest rate at the earliest: held
efforts must not carry it beyond, nor those after them, should the model be a little wrong."""

_FREE = 0.5
"""Part of its rate below which, after the next period, a joint needs no look at its dynamics."""

_SHAPES = 16
"""Random shapes by which it is estimated how easily a joint is moved."""

_REST_RATE = 2.0
"""Rate at which joint rates and momenta decay while a robot is brought to rest, 1/s."""

_REST_RATE_PER_PERIOD = 0.5


class JointRateLimits:
    """Keeps the rates of joints within limits by what the dynamics say of the next moment.

    The joints obey ``Js(q) qddot + Fs = tau + G(q) wrench``: the last rows of paper 4, eq. (19),
    with the base's acceleration put in. A commanded acceleration that would bring a joint beyond
    its rate within some control periods is lowered to one that does not, and the efforts are those
    of the accelerations that are left. Where motors are too weak to hold joints against the thrust
    of the base, the thrust is lowered: it keeps its direction.

    Parameters
    ----------
    robot
        The model, as the controller believes it.
    rates
        Largest rates (n,), m/s or rad/s; zero or infinite: none is kept.
    control_period
        How long a command is held, s.
    """

    def __init__(self, robot: SpaceRobot, rates: Array, control_period: float) -> None:
        limited = (rates > 0) & np.isfinite(rates)
        self.rates = np.where(limited, rates, np.inf)
        """Largest rates (n,), infinite where there is none."""
        self._robot = robot
        self._control_period = control_period
        self._rest_rate = min(_REST_RATE, _REST_RATE_PER_PERIOD / control_period)
        self._dynamics = BufferedFunction(_joint_dynamics(robot))
        self._per_rate = 1 / (_FREE * self.rates)
        self._inverse = (1 / self.rates).tolist()
        self._per_effort = self._mobilities() * control_period * self._per_rate

    def apply(
        self, state: ControlState, given: Actuation, effort: Array, periods: int = 1
    ) -> Actuation:
        """Return a command that keeps the rates; the given one itself if that does.

        ``effort`` (n,) are the largest joint efforts, N m or N, which ``given`` keeps; ``periods``
        is for how many control periods it will probably be held.
        """
        gained = np.abs(given.tau) * (periods * self._per_effort)
        if not (np.abs(state.qdot) * self._per_rate + gained).max(initial=0.0) > 1.0:
            return given
        Js, Fs, G = self._at(state)
        pushed = G @ given.wrench_B
        qddot = np.linalg.solve(Js, given.tau + pushed - Fs)
        soonest = _PERIODS * periods * self._control_period
        lowest = (-self.rates - state.qdot) / soonest
        highest = (self.rates - state.qdot) / soonest
        if np.all((lowest <= qddot) & (qddot <= highest)):
            return given
        wanted = Js @ np.clip(qddot, lowest, highest) + Fs
        share = _largest_share(wanted, pushed, effort)
        tau = np.clip(wanted - share * pushed, -effort, effort)
        return Actuation(share * given.wrench_B, tau)

    def lowered(self, omega: ca.SX, q: ca.SX, qdot: ca.SX, actuation: ca.SX) -> ca.SX:
        """Return whether :meth:`apply` gives another command than ``[f; n; tau]`` (6 + n,)."""
        if not np.isfinite(self.rates).any():
            return ca.SX(0)
        n, tau = self._robot.n, actuation[6:]
        gained = ca.fabs(tau) * self._per_effort
        fast = ca.fabs(qdot) * self._per_rate + gained
        near = ca.sum1(fast > 1.0)
        flat, Fs, columns = self._dynamics.function(q, omega, qdot)
        Js, G = ca.reshape(flat, n, n).T, ca.reshape(columns, 6, n).T
        qddot = solve_positive_definite(Js, tau + G @ actuation[:6] - Fs)
        soonest = _PERIODS * self._control_period
        beyond = []
        for i, rate in enumerate(self.rates.tolist()):
            if np.isfinite(rate):
                lowest, highest = (-rate - qdot[i]) / soonest, (rate - qdot[i]) / soonest
                beyond.append(ca.logic_or(qddot[i] < lowest, qddot[i] > highest))
        return ca.logic_and(near > 0, ca.sum1(ca.vertcat(*beyond)) > 0)

    def largest_share(self, qdot: Array) -> float:
        """Return the largest of rates (n,) in parts of their limits."""
        # Numbers of Python: arrays of a few joints take longer, and this is asked at every state.
        share = 0.0
        for rate, inverse in zip(qdot.tolist(), self._inverse, strict=True):
            share = max(share, abs(rate * inverse))
        return share

    def to_rest(self, state: ControlState) -> Actuation:
        """Return the command under which joint rates and momenta of the robot decay, not limited.

        The thrusters take away both total momenta, which efforts of joints do not change, and the
        motors the joint rates: each decays by itself, wherever the base is.
        """
        robot, r = self._robot, self._rest_rate
        J = robot.jacobian(robot.base_link, state.q)
        v_cm = state.v_WB_B - J[:3, 3:6] @ state.omega_WB_B - J[:3, 6:] @ state.qdot
        H = robot.inertia_matrix(state.q)
        force = -r * robot.total_mass * v_cm
        torque = -r * (H[3:6, 3:6] @ state.omega_WB_B + H[3:6, 6:] @ state.qdot)
        # A force at the base has a moment about the center of mass.
        wrench = np.concatenate([force, torque + np.cross(robot.center_of_mass(state.q), force)])
        Js, Fs, G = self._at(state)
        return Actuation(wrench, -r * (Js @ state.qdot) + Fs - G @ wrench)

    def _at(self, state: ControlState) -> tuple[Array, Array, Array]:
        inputs = self._dynamics.inputs
        inputs[0][:], inputs[1][:], inputs[2][:] = state.q, state.omega_WB_B, state.qdot
        self._dynamics.evaluate()
        Js, Fs, G = self._dynamics.outputs
        n = self._robot.n
        return Js.reshape((n, n)), Fs, G.reshape((n, 6))

    def _mobilities(self) -> Array:
        """Return the largest acceleration (n,) of each joint by an effort of one of its own."""
        n, rng = self._robot.n, np.random.default_rng(1)
        lower = np.maximum(self._robot.lower, -np.pi)
        upper = np.maximum(np.minimum(self._robot.upper, np.pi), lower)
        zero, largest = np.zeros(3), np.zeros(n)
        for shape in rng.uniform(0.0, 1.0, (_SHAPES, n)):
            q = lower + shape * (upper - lower)
            Js, _, _ = self._at(ControlState(zero, zero, zero, zero, q, np.zeros(n)))
            largest = np.maximum(largest, np.diag(np.linalg.inv(Js)))
        return largest


def _largest_share(wanted: Array, pushed: Array, effort: Array) -> float:
    """Return the largest share in [0, 1] of a push with which ``wanted`` is within efforts.

    Zero where there is none: motors that cannot brake joints are not loaded any more.
    """
    low, high = 0.0, 1.0
    for tau, push, limit in zip(wanted.tolist(), pushed.tolist(), effort.tolist(), strict=True):
        if push == 0.0:
            if abs(tau) > limit:
                return 0.0
            continue
        ends = (tau - limit) / push, (tau + limit) / push
        low, high = max(low, min(ends)), min(high, max(ends))
    return high if low <= high else 0.0


def _joint_dynamics(robot: SpaceRobot) -> ca.Function:
    """Return ``(q, omega_WB_B, qdot) -> (Js, Fs, G)``; the velocity of the base is in none.

    It is not compiled: it is called where a joint is fast, and by itself takes microseconds.
    """
    q, qdot = ca.SX.sym("q", robot.n), ca.SX.sym("qdot", robot.n)
    omega = ca.SX.sym("omega", 3)
    H = robot.function("inertia_matrix", compile=False)(q)
    C = robot.function("bias", compile=False)(q, ca.SX(3, 1), omega, qdot)
    J = robot.function(f"jacobian:{robot.base_link}", compile=False)(q)
    D, D_q, D_qq = H[3:6, 3:6], H[3:6, 6:], H[6:, 6:]
    # What efforts of the base do to omega and to q, from force and torque at its origin.
    to_omega = ca.horzcat(J[:3, 3:6].T, ca.SX.eye(3))
    to_joints = ca.horzcat(J[:3, 6:].T, ca.SX(robot.n, 3))
    solved = solve_positive_definite(D, ca.horzcat(D_q, C[3:6], to_omega))
    n = robot.n
    outputs = {
        # By columns in memory: transposed, they are read by rows.
        "Js": ca.reshape((D_qq - D_q.T @ solved[:, :n]).T, n * n, 1),
        "Fs": C[6:] - D_q.T @ solved[:, n],
        "G": ca.reshape((to_joints - D_q.T @ solved[:, n + 1 :]).T, 6 * n, 1),
    }
    return dense_function("joint_dynamics", {"q": q, "omega": omega, "qdot": qdot}, outputs)
