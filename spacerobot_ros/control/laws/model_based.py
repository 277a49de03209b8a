"""Feedback linearisation of the outputs: every output error obeys a separate linear equation."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import numpy.typing as npt
from typing_extensions import override

from spacerobot_ros.control.laws.law import ACCELERATION_GAINS, ControlLaw, LawOptions
from spacerobot_ros.control.state import Actuation, JointReference, Reference
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.dynamics import solve_positive_definite
from spacerobot_ros.parameters import nonnegative


@dataclass(frozen=True)
class ModelBasedOptions(LawOptions):
    """The options of ``model_based``."""

    null_space_damping: float = nonnegative(
        1.0, "decay rate of joint motion that does not move any output", "1/s", maximum=1000000000.0
    )
    posture_stiffness: float = nonnegative(
        0.0,
        "stiffness that pulls joints that are not outputs towards the joint reference, without "
        "moving any output",
        "1/s^2",
        maximum=1000000000.0,
    )


class ModelBasedLaw(ControlLaw):
    """Paper 4, eq. (27), which gives the error dynamics ``eddot + Kd edot + Kp e = 0`` (eq. 28).

    In terms of the acceleration ``a = z1ddot_des + Kd edot + Kp e`` and the output mobility
    ``J_z H+^-1 J_z'``, whose inverse is the paper's ``Htilde`` (eq. 25) for a square J_z::

        Q = J_z' F + H+ xi + C+,    (J_z H+^-1 J_z') F = a - Jdot_z z0dot - J_z xi

    This also holds for fewer outputs than degrees of freedom: ``xi`` is the desired acceleration in
    the null space of ``J_z``, which does not move any output. It damps all velocities and
    optionally pulls the joints towards the joint reference. For a square J_z, ``xi`` cancels.

    Near a singularity of J_z (smallest singular value ``s`` below the threshold ``t``), no bounded
    force accelerates the outputs along the singular direction ``u``. There, the law is damped:

    * The mobility along u, ``s^2 v' H+^-1 v`` with ``J_z' u = s v``, is raised to its value for
      ``s = t``: damping ``d = sqrt(t^2 - s^2)``, which starts from zero at the threshold.
      Accelerations along v stay bounded; other directions are unaffected.
    * Velocity along v does not appear in the outputs, so the Kd of the outputs does not act on it.
      It is damped directly with the largest Kd. If the reference describes a single motion, motion
      along v follows the joints of that motion instead, with critical damping.

    Eq. (28) then holds for the other directions only, and :attr:`status` reports it.

    Parameters
    ----------
    robot, outputs, gains, options
        See :class:`ControlLaw`; Kp in 1/s^2, Kd in 1/s. ``posture_stiffness`` acts if the reference
        includes joints.
    """

    name: ClassVar[str] = "model_based"
    gain_units: ClassVar[tuple[str, str]] = ACCELERATION_GAINS
    Options: ClassVar[Any] = ModelBasedOptions

    @override
    def _damping(self, singular_value: float) -> float:
        return math.sqrt(max(0.0, self.singular_value_threshold**2 - singular_value**2))

    @override
    def inputs(self) -> Mapping[str, npt.ArrayLike]:
        return {
            "null_space": (self.options.posture_stiffness, self.options.null_space_damping),
            "posture": np.zeros(self.robot.n),
            "singular_damping": np.zeros(self.outputs.N),
        }

    @property
    @override
    def fixed_inputs(self) -> Mapping[str, npt.ArrayLike] | None:
        """The fixed arguments; None if there is a posture, which depends on the reference or the
        state."""
        return None if self.options.posture_stiffness else super().fixed_inputs

    @override
    def is_complete(self, results: Mapping[str, ca.SX]) -> ca.SX:
        """Return whether the outputs are far enough from a singularity."""
        return results["margin"] >= self.singular_value_threshold

    @override
    def results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        z1 = self.outputs
        H = z1.model("inertia_matrix", z1.q)
        C = z1.model("bias", z1.q, z1.v_cm, z1.omega, z1.qdot)
        stiffness, damping = ca.vertsplit(symbols["null_space"])
        pull = ca.vertcat(ca.SX(6, 1), stiffness * (symbols["posture"] - z1.q))
        xi = pull - damping * z1.z0dot + symbols["singular_damping"]
        a = z1.acceleration + symbols["kd"] * z1.error_rate + symbols["kp"] * z1.error
        a += symbols["integral"]
        acceleration = a - z1.bias_acceleration - z1.J_z @ xi
        mobility = z1.mobility(H)
        J_actuators = z1.J_z @ z1.J_q_inverse
        other = z1.J_q_inverse.T @ z1.without_force(H @ xi + C)
        force = solve_positive_definite(mobility, acceleration)
        # 1 / sqrt(sum of 1/s^2 over the singular values s), not above the smallest of them. Where
        # J_z is singular this is not a number, and neither is the undamped command.
        inverse = ca.solve(ca.chol(z1.J_z @ z1.J_z.T).T, ca.SX.eye(z1.m))
        return {
            "actuation": other + J_actuators.T @ force,
            "margin": 1 / ca.norm_fro(inverse),
            "mobility": mobility,
            "acceleration": acceleration,
            "J_actuators": J_actuators,
            "other": other,
            "z0dot": z1.z0dot,
        }

    @override
    def actuation(self, reference: Reference) -> Actuation:
        # Without a joint reference, the posture is the current one and exerts no pull.
        q = self._in["state"][13 : 13 + self.robot.n]
        self._in["posture"][:] = q if reference.joints is None else reference.joints.q
        self._in["singular_damping"][:] = 0.0
        self._function.evaluate()
        if self._out["margin"][0] >= self.singular_value_threshold:
            actuation = self._out["actuation"]
        else:
            actuation = self._damped_actuation(reference)
        return Actuation(actuation[:6].copy(), actuation[6:].copy())

    def _damped_actuation(self, reference: Reference) -> Array:
        out = self._out
        U, singular_values, V = np.linalg.svd(out["J_z"], full_matrices=False)
        mobility = out["mobility"].copy()
        H = self.robot.inertia_matrix(self._in["state"][13 : 13 + self.robot.n])
        z0dot, largest_kd = out["z0dot"], self._in["kd"].max()
        for u, s, v in zip(U.T, singular_values, V, strict=True):
            damping = self._damping(float(s))
            if damping > 0:
                along = np.linalg.solve(H, v)
                mobility += damping**2 * (v @ along) * np.outer(u, u)
                rate = (v @ z0dot) / (v @ along)
                self._in["singular_damping"][:] -= largest_kd * rate * along
        if reference.of_one_motion and reference.joints is not None:
            self._in["singular_damping"][:] = self._following(reference.joints)
        self._function.evaluate()
        force = np.linalg.solve(mobility, out["acceleration"])
        return out["other"] + force @ out["J_actuators"]

    def _following(self, joints: JointReference) -> Array:
        """Return the acceleration (6 + n,) with which joints follow their reference, and outputs,
        as far as the base moves them, follow theirs, minus the null-space damping.

        Outputs then need forces only for their remaining errors: damping also omits forces that
        support the motion along v.
        """
        out, kd = self._out, self._in["kd"].max()
        damped = self.options.null_space_damping * out["z0dot"]
        followed = np.zeros(6 + self.robot.n)
        q, qdot = self._in["state"][13 : 13 + self.robot.n], out["z0dot"][6:]
        followed[6:] = joints.qddot + kd * (joints.qdot - qdot) + kd**2 / 4 * (joints.q - q)
        rest = out["acceleration"] - out["J_z"] @ (damped + followed)
        followed[:6] = np.linalg.lstsq(out["J_z"][:, :6], rest, rcond=None)[0]
        return np.asarray(damped + followed)
